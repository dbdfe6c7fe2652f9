"""Simulation of all variants of a scenario, and the files that compare their summaries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from dynsim.engine import SIMULATION, Progress, simulate
from dynsim.errors import ScenarioError, SimulationInterrupted, SimulationStopped, brief
from dynsim.record import Record
from dynsim.record.csv_rows import csv_table
from dynsim.scenario import Scenario, load_scenario, variant_names
from dynsim.studies.processes import WorkerInterrupted, WorkerLost, run_in_processes
from dynsim.studies.sweep import FAILED, OK, flat
from dynsim.system.arguments import names_wrong_types
from dynsim.system.files import json_text, replace_together
from dynsim.system.memo import Memo, remembering


class _Sharing:
    """Function object that simulates scenarios; in each process, the runs share intermediate results."""

    def __init__(self) -> None:
        self._memo = Memo()

    def __call__(self, scenario: Scenario, look: Progress | None) -> Record:
        with remembering(self._memo):
            return simulate(scenario, look)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), ()


class VariantProgress(Protocol):
    """A :class:`dynsim.engine.Progress` that also receives the name of the variant."""

    def __call__(self, variant: str, time: float, stage: str = SIMULATION) -> None: ...


@names_wrong_types
def compare(
    path: str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    jobs: int = 1,
    progress: VariantProgress | None = None,
    finished: Callable[[str, Record], None] | None = None,
    stopped: Callable[[str, SimulationStopped], None] | None = None,
) -> dict[str, Record]:
    """Simulate every variant of a scenario; a failed variant does not stop the other variants.

    Parameters
    ----------
    path : str or Path
        Scenario file, or the name of a shipped scenario.
    overrides : mapping, optional
        Values by dotted key, for all variants.
    jobs : int, optional
        Number of processes, including this process while runs are short; default: 1.
    progress : callable, optional
        See :class:`VariantProgress`. With several processes, it is called only when a variant ends.
    finished : callable, optional
        Called with variant and record as soon as a variant is done, for example to save the record.
    stopped : callable, optional
        Called with variant and exception as soon as a variant stops or is interrupted.

    Returns
    -------
    dict of str to Record
        Records by variant, in the order of the file.

    Raises
    ------
    ScenarioError
        If the file has no variants, a variant is invalid (all are checked before the first runs), or ``jobs`` is
        invalid.
    SimulationStopped
        If a variant stopped; raised after all other variants have run. The message lists all stopped variants;
        ``record`` is the record of the first of them.
    SimulationInterrupted
        On Ctrl-C. The message also lists the variants that were not started.

    Examples
    --------
    >>> import dynsim
    >>> records = dynsim.compare("elbow_comparison", overrides={"duration_s": 0.1})
    >>> list(records)
    ['two_elbows', 'elbow_7', 'elbow_4', 'no_elbow']
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise ScenarioError(f"jobs = {brief(jobs)}: must be an integer of at least 1")
    names = variant_names(path)
    if not names:
        raise ScenarioError(f"{path}: has no variants to compare; use `dynsim run`")
    scenarios = {name: load_scenario(path, name, overrides) for name in names}
    records: dict[str, Record] = {}
    stops: dict[str, SimulationStopped] = {}

    def take_record(name: str, result: Callable[[], Record | None]) -> None:
        try:
            record = result()
        except WorkerInterrupted:
            location = scenarios[name].location(variant=f" ({name})")
            stops[name] = SimulationInterrupted(f"{location}: interrupted before there were results to save")
        except WorkerLost as lost:
            stops[name] = SimulationStopped(f"{name}: {lost}")
        except SimulationStopped as stop:
            stops[name] = stop
        else:
            if record is not None:
                if finished is not None:
                    finished(name, record)
                records[name] = record
        if name in stops and stopped is not None:
            stopped(name, stops[name])

    def take(scenario: Scenario, result: Callable[[], Record | None]) -> None:
        name = scenario.variant
        take_record(name, result)
        if progress is not None and name in records:
            progress(name, scenario.duration_s)

    def here(scenario: Scenario) -> Progress | None:
        return None if progress is None or jobs > 1 else partial(progress, scenario.variant)

    interrupted = run_in_processes(_Sharing(), scenarios.values(), jobs, take, here=here)
    if stops or interrupted:
        left = [name for name in names if name not in records and name not in stops]
        raise _combined_stop({name: stops[name] for name in names if name in stops}, left, interrupted)
    return {name: records[name] for name in names}


def _combined_stop(stops: Mapping[str, SimulationStopped], left: list[str], interrupted: bool) -> SimulationStopped:
    """Combine the exceptions of all stopped variants, and list the variants that Ctrl-C prevented from starting."""
    # If there is no record, the message already contains the variant.
    texts = [str(stop) if stop.record is None else f"{name}: {stop}" for name, stop in stops.items()]
    if left:
        texts.append(f"interrupted before {', '.join(left)} {'was' if len(left) == 1 else 'were'} started")
    first = next(iter(stops.values()), SimulationStopped(""))
    kind = SimulationInterrupted if interrupted else SimulationStopped
    combined = kind("; ".join(texts), time=first.time, state=first.state)
    combined.record = next((stop.record for stop in stops.values() if stop.record is not None), None)
    return combined


def save_comparison(results: Mapping[str, Record | SimulationStopped], folder: Path) -> None:
    """Write ``comparison.json``, ``comparison.csv``, and the tables that compare a shipped snake scenario with [T].

    Parameters
    ----------
    results : mapping of str to Record or SimulationStopped
        Variants in the order of the file. A variant that stopped has the numbers up to the stop in the CSV file only.
    folder : Path
        Output folder.

    Raises
    ------
    RecordError
        If a file cannot be written.
    """
    records = {name: result for name, result in results.items() if isinstance(result, Record)}
    reasons = {name: str(result) for name, result in results.items() if not isinstance(result, Record)}
    runs = []
    for name, result in results.items():
        record = result if isinstance(result, Record) else result.record
        ended = {"variant": name, "status": FAILED if name in reasons else OK, "reason": reasons.get(name, "")}
        runs.append((flat(record.summary) if record else {}) | ended)
    # Variants may have different entries, because the entries of contacts depend on the contact law.
    names = dict.fromkeys(["variant", "status", "reason", *(key for run in runs for key in run if key != "warnings")])
    table = csv_table([*names, "warnings"], runs)
    failed = {"failed": reasons} if reasons else {}
    content = json_text({"variants": {name: record.summary for name, record in records.items()}, **failed})
    replace_together(folder, {"comparison.json": content.encode("utf-8"), "comparison.csv": table.encode("utf-8")})
    if records and all("mode" in record for record in records.values()):
        from dynsim.snake.published import write_tables  # the import takes 0.15 s

        write_tables(records, folder)
