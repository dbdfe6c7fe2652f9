"""All variants of a scenario side by side."""

from __future__ import annotations

import csv
import io
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import active_children, connection, get_context, parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

from dynsim import interruption
from dynsim.engine import SIMULATION, simulate
from dynsim.errors import ScenarioError, SimulationInterrupted, SimulationStopped, shown
from dynsim.files import json_text, replace_together
from dynsim.interruption import STOP_SIGNALS
from dynsim.record import Record
from dynsim.scenario import Scenario, load_scenario, variant_names

log = logging.getLogger(__name__)


# Between two looks for a signal that was lost [s].
_LOOK_S = 0.5

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
        The file has no variants, one of them is not valid (all are checked before the first runs), or no such ``jobs``.
    SimulationStopped, SimulationInterrupted
        A variant stopped (after the others have run) or Ctrl-C. Names all that stopped and, after Ctrl-C, all that were
        not started; holds the record of the first.
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise ScenarioError(f"jobs = {shown(jobs)}: must be a whole number of processes, 1 or more")
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
            for future in wait(waiting, timeout=_LOOK_S, return_when=FIRST_COMPLETED).done:
                interruption.keep()
                take(waiting[future], future.result)
                del waiting[future]
                interruption.heed()
            interruption.check()

    workers = min(jobs, len(scenarios))
    with (
        _logged_here(context) as sender,
        ProcessPoolExecutor(
            workers,
            mp_context=context,
            initializer=_start_worker,
            initargs=(interrupt, sender, log.getEffectiveLevel()),
        ) as pool,
    ):
        try:
            try:
                with _signals_held():
                    for name, scenario in scenarios.items():
                        waiting[pool.submit(_simulate, scenario)] = name
                collect()
            except KeyboardInterrupt:
                interruption.answered()
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


class _ToParent(logging.Handler):
    """In a worker: hands what is logged to the parent by one write to a pipe. A killed worker leaves no lock behind."""

    LONGEST = 1000  # characters; with their frame less than what a pipe takes in one piece

    def __init__(self, sender: Connection) -> None:
        super().__init__()
        self.sender = sender

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):
            self.sender.send((record.name, record.levelno, record.getMessage()[: self.LONGEST]))


@contextmanager
def _logged_here(context: Any) -> Iterator[Connection]:
    """Log what the workers log, until all of them have ended; yields what they send it by."""
    receiver, sender = context.Pipe(duplex=False)

    def listen() -> None:
        with suppress(EOFError, OSError):
            while True:
                name, level, text = receiver.recv()
                logging.getLogger(name).log(level, "%s", text)

    listener = threading.Thread(target=listen, name="log of the workers", daemon=True)
    listener.start()
    try:
        yield sender
    finally:
        # Without this end the pipe ends with the last worker.
        sender.close()
        listener.join(timeout=1.0)


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


def _start_worker(interrupt: Any, sender: Connection, level: int) -> None:
    global _interrupt
    _interrupt = interrupt
    # A terminal or a service manager sends these to every process of a group: only the parent heeds them.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    library = logging.getLogger("dynsim")
    library.setLevel(level)
    library.addHandler(_ToParent(sender))


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


def _flat(summary: dict[str, Any]) -> dict[str, Any]:
    """A summary whose numbers of a mobile base stand beside the others, under ``base.…``."""
    base = dict(summary.get("base", {}))
    for key in [key for key, value in base.items() if isinstance(value, dict)]:
        base.update({f"{key}.{name}": value for name, value in base.pop(key).items()})
    return summary | {f"base.{key}": value for key, value in base.items()}


def save_comparison(records: Mapping[str, Record], folder: Path) -> None:
    """Write ``comparison.json`` and ``comparison.csv``."""
    summaries = {name: record.summary for name, record in records.items()}
    flat = {name: _flat(summary) for name, summary in summaries.items()}
    # A number that one variant lacks, another may have.
    columns = ["variant"] + [key for one in flat.values() for key, value in one.items() if _is_scalar(value)]
    columns = list(dict.fromkeys(columns))
    contacts = list(dict.fromkeys(c["name"] for s in summaries.values() for c in s.get("contacts", ())))
    # Those of the unilateral law are there if some variant has it.
    keys = [key for s in summaries.values() for c in s.get("contacts", ()) for key, v in c.items() if not _is_text(v)]
    contact_keys = list(dict.fromkeys(keys))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*columns, *(f"{name}.{key}" for name in contacts for key in contact_keys)])
    for name, summary in summaries.items():
        by_name = {c["name"]: c for c in summary.get("contacts", ())}
        row = [name if key == "variant" else flat[name].get(key, "") for key in columns]
        row += [by_name.get(contact, {}).get(key, "") for contact in contacts for key in contact_keys]
        writer.writerow(row)
    table = json_text({"variants": summaries})
    replace_together(
        folder, {"comparison.json": table.encode("utf-8"), "comparison.csv": stream.getvalue().encode("utf-8")}
    )


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, (int, float, str))
