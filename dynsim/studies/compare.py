"""All variants of a scenario side by side."""

from __future__ import annotations

import csv
import io
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import active_children, connection, get_context, parent_process
from pathlib import Path
from typing import Any, Protocol

from dynsim.engine import SIMULATION, simulate
from dynsim.errors import ScenarioError, SimulationInterrupted, SimulationStopped
from dynsim.files import write_json, write_text
from dynsim.record import Record
from dynsim.scenario import Scenario, load_scenario, variant_names

# A terminal or a service manager sends these to every process of a group: only the parent heeds them.
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# In a worker process: set when it shall stop and hand back what it has.
_interrupt: Any = None


class VariantProgress(Protocol):
    """A :class:`dynsim.engine.Progress` that also gets the variant's name."""

    def __call__(self, variant: str, time: float, stage: str = SIMULATION) -> None: ...


def compare(
    path: str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    jobs: int = 1,
    progress: VariantProgress | None = None,
    finished: Callable[[str, Record], None] | None = None,
    stopped: Callable[[str, SimulationStopped], None] | None = None,
) -> dict[str, Record]:
    """Simulate every variant of a scenario. A variant that stops does not keep the others from running; Ctrl-C does.

    Parameters
    ----------
    path : scenario file or name of a shipped one
    overrides : values by dotted key, for all variants
    jobs : processes; one runs the variants here, one after the other
    progress : see :class:`VariantProgress` (with several processes it is called only at a variant's end)
    finished : called with variant and record as soon as a variant is done, so that it can be saved
    stopped : called with variant and exception as soon as a variant stops or is interrupted

    Returns
    -------
    dict of Record by variant, in the order of the file

    Raises
    ------
    ScenarioError
        The file has no variants, or one of them is not valid; all are checked before the first runs.
    SimulationStopped, SimulationInterrupted
        A variant stopped (after the others have run) or Ctrl-C. Names all that stopped and, after Ctrl-C, all that were
        not started; holds the record of the first.
    """
    names = variant_names(path)
    if not names:
        raise ScenarioError(f"{path}: has no variants to compare; use `dynsim run`")
    scenarios = {name: load_scenario(path, name, overrides) for name in names}
    records: dict[str, Record] = {}
    stops: dict[str, SimulationStopped] = {}

    def take(name: str, result: Callable[[], Record | None]) -> None:
        try:
            record = result()
        except BrokenProcessPool:
            # The operating system has ended it; a record would have come with a stop.
            stops[name] = SimulationStopped(f"{name}: its process was ended from outside; is memory short for --jobs?")
            return
        except SimulationStopped as stop:
            if stopped is not None:
                stopped(name, stop)
            stops[name] = stop
            return
        if record is None:
            return
        if finished is not None:
            finished(name, record)
        records[name] = record

    if jobs > 1:

        def take_late(name: str, result: Callable[[], Record | None]) -> None:
            take(name, result)
            if progress is not None and name in records:
                progress(name, scenarios[name].duration_s)

        interrupted = _run_in_processes(scenarios, jobs, take_late)
    else:
        interrupted = False
        for name, scenario in scenarios.items():
            take(name, partial(simulate, scenario, None if progress is None else partial(progress, name)))
            if isinstance(stops.get(name), SimulationInterrupted):
                interrupted = True
                break
    if stops or interrupted:
        left = [name for name in names if name not in records and name not in stops]
        raise _summed_up({name: stops[name] for name in names if name in stops}, left, interrupted)
    return {name: records[name] for name in names}


def _summed_up(stops: Mapping[str, SimulationStopped], left: list[str], interrupted: bool) -> SimulationStopped:
    """One exception for all variants that stopped, and those that were left when the user stopped it all."""
    # Without a record the message names the variant already.
    texts = [str(stop) if stop.record is None else f"{name}: {stop}" for name, stop in stops.items()]
    if left:
        texts.append(f"interrupted before {', '.join(left)} {'was' if len(left) == 1 else 'were'} started")
    first = next(iter(stops.values()), SimulationStopped(""))
    kind = SimulationInterrupted if interrupted else SimulationStopped
    summed_up = kind("; ".join(texts), time=first.time, state=first.state)
    summed_up.record = next((stop.record for stop in stops.values() if stop.record is not None), None)
    return summed_up


def _run_in_processes(
    scenarios: Mapping[str, Scenario], jobs: int, take: Callable[[str, Callable[[], Record | None]], None]
) -> bool:
    """Hand every result to ``take`` as it comes; True if Ctrl-C made the workers stop early."""
    # Spawned, not forked: the parent may hold threads and an open progress display.
    context = get_context("spawn")
    # Also of multiprocessing's own helper, which the first shared object starts and which knows nothing of SIGHUP.
    with _signals_held():
        interrupt = context.Event()
    waiting: dict[Future[Record | None], str] = {}

    def collect() -> None:
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                take(waiting[future], future.result)
                del waiting[future]

    workers = min(jobs, len(scenarios))
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(interrupt,)) as pool:
        try:
            try:
                with _signals_held():
                    for name, scenario in scenarios.items():
                        waiting[pool.submit(_simulate, scenario)] = name
                collect()
            except KeyboardInterrupt:
                interrupt.set()
                for future in [future for future in waiting if future.cancel()]:
                    del waiting[future]
                collect()
                return True
        except BaseException:
            # A result that cannot be saved, or a second Ctrl-C: nobody waits for the others.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.kill()  # they ignore the signal of terminate()
            raise
    return False


@contextmanager
def _signals_held() -> Iterator[None]:
    """Processes started here do not get the Ctrl-C of the terminal, not even while they start; this one gets it after.

    Only the parent reacts to it, wherever it was sent, and tells the workers. So with the other ``STOP_SIGNALS``.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(interrupt: Any) -> None:
    global _interrupt
    _interrupt = interrupt
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """In a worker: wait until the parent is gone, however it ended, and end too; nobody waits for the result."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _simulate(scenario: Scenario) -> Record | None:
    """In a worker: stop where Ctrl-C would have stopped it here, with what there is; None when it came before."""

    def look(time: float, stage: str = SIMULATION) -> None:
        if _interrupt.is_set():
            raise KeyboardInterrupt

    return None if _interrupt.is_set() else simulate(scenario, look)


def save_comparison(records: Mapping[str, Record], folder: Path) -> None:
    """Write ``comparison.json`` and ``comparison.csv``."""
    summaries = {name: record.summary for name, record in records.items()}
    write_json(folder / "comparison.json", {"variants": summaries})
    columns = ["variant"] + [key for key, value in next(iter(summaries.values())).items() if _is_scalar(value)]
    columns = list(dict.fromkeys(columns))
    contacts = list(dict.fromkeys(c["name"] for s in summaries.values() for c in s.get("contacts", ())))
    contact_keys = (
        "normal_force_min_N", "normal_force_mean_N", "normal_force_max_N", "closed_fraction", "pulling_fraction",
        "slip_distance_m",
    )  # fmt: skip
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*columns, *(f"{name}.{key}" for name in contacts for key in contact_keys)])
    for name, summary in summaries.items():
        by_name = {c["name"]: c for c in summary.get("contacts", ())}
        row = [name if key == "variant" else summary.get(key, "") for key in columns]
        row += [by_name.get(contact, {}).get(key, "") for contact in contacts for key in contact_keys]
        writer.writerow(row)
    write_text(folder / "comparison.csv", stream.getvalue())


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, (int, float, str))
