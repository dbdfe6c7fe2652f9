"""Many runs: each ends as a summary, or as the reason why there is none."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, TypeVar, get_args

from dynsim import interruption
from dynsim.engine import SIMULATION, Progress, simulate
from dynsim.errors import DynsimError, ScenarioError, SimulationInterrupted, SimulationStopped, shown
from dynsim.record import Record
from dynsim.scenario import Scenario, require_scenario
from dynsim.studies.processes import WorkerLost, run_in_processes

Keep = Literal["none", "failed", "all"]
Task = TypeVar("Task")

# Processes that a run may take with it before it is given up: the first may have been ended for another's memory.
ATTEMPTS = 2
LOST = "its process was ended from outside"


@dataclass(frozen=True)
class RunResult:
    """How one run of many ended.

    Attributes
    ----------
    summary : numbers of the run; of one that stopped, what was simulated until then; empty when nothing was
    reason : why it failed, "" when it did not
    lost : its process was ended from outside, so that another attempt may do better
    record : where it was asked for
    wall_s : time that it took, all in all [s]
    """

    summary: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    lost: bool = False
    record: Record | None = field(default=None, repr=False)
    wall_s: float = 0.0

    @property
    def ok(self) -> bool:
        """True for a run that came to its end."""
        return not self.reason


def simulate_batch(
    scenarios: Iterable[Scenario],
    *,
    jobs: int = 1,
    keep_records: Keep = "none",
    scheduler: str | None = None,
    finished: Callable[[int, RunResult], None] | None = None,
) -> list[RunResult]:
    """Simulate many scenarios; one that fails does not keep the others from running.

    Every run is that of :func:`dynsim.simulate`, to the bit, whatever ``jobs`` and whichever runs are beside it.

    Parameters
    ----------
    scenarios : of any plants
    jobs : processes; one simulates here, one after the other
    keep_records : which results hold their records: none, those of runs that stopped, or all
    scheduler : address of a Dask scheduler, such as ``tcp://host:8786``, whose workers simulate instead
    finished : called with the number of a run and its result, as soon as it is there

    Returns
    -------
    list of RunResult
        In the order of ``scenarios``.

    Raises
    ------
    ScenarioError
        No scenarios, no such ``jobs`` or ``keep_records``, or no such scheduler.
    SimulationInterrupted
        Ctrl-C; ``finished`` has had what was done until then.
    """
    runs = list(scenarios)
    for scenario in runs:
        require_scenario(scenario)
    if keep_records not in get_args(Keep):
        raise ScenarioError(f"keep_records = {shown(keep_records)}: must be one of {', '.join(get_args(Keep))}")
    results: dict[int, RunResult] = {}

    def take(task: tuple[int, Scenario], result: RunResult) -> None:
        results[task[0]] = result
        if finished is not None:
            finished(task[0], result)

    if run_all(partial(_numbered, keep_records), list(enumerate(runs)), take, jobs=jobs, scheduler=scheduler):
        raise SimulationInterrupted(f"interrupted when {len(results)} of {len(runs)} runs were done")
    return [results[k] for k in range(len(runs))]


def _numbered(keep: Keep, task: tuple[int, Scenario], look: Progress) -> RunResult:
    return run_one(lambda: task[1], keep, look)


def run_one(load: Callable[[], Scenario], keep: Keep, look: Progress | None) -> RunResult:
    """Load a scenario and simulate it, whatever becomes of it.

    Raises
    ------
    SimulationInterrupted
        ``look`` raised KeyboardInterrupt.
    """
    started = clock.perf_counter()
    try:
        record = simulate(load(), look, pictured=keep != "none")
    except SimulationInterrupted:
        raise
    except SimulationStopped as stop:
        kept = None if keep == "none" else stop.record
        summary = stop.record.summary if stop.record is not None else {}
        return RunResult(summary, _line(stop), record=kept, wall_s=clock.perf_counter() - started)
    except DynsimError as error:
        return RunResult({}, _line(error), wall_s=clock.perf_counter() - started)
    except Exception as error:
        # Hours of other runs must not go for a fault of dynsim in one.
        return RunResult({}, f"{type(error).__name__}: {_line(error)}", wall_s=clock.perf_counter() - started)
    wall = clock.perf_counter() - started
    return RunResult(record.summary, record=record if keep == "all" else None, wall_s=wall)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def run_all(
    work: Callable[[Task, Progress], RunResult],
    tasks: Sequence[Task],
    take: Callable[[Task, RunResult], None],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> bool:
    """Do ``work`` for all tasks here, in processes or on a cluster, and hand every result to ``take`` as it comes.

    Returns
    -------
    bool
        True if Ctrl-C came before all were done.

    Raises
    ------
    ScenarioError
        No such ``jobs``, or no such scheduler.
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise ScenarioError(f"jobs = {shown(jobs)}: must be a whole number of processes, 1 or more")
    if scheduler is not None:
        from dynsim.studies.cluster import run_on_cluster

        return run_on_cluster(work, tasks, take, scheduler)
    if jobs > 1:

        def take_late(task: Task, result: Callable[[], RunResult | None]) -> None:
            try:
                found = result()
            except WorkerLost:
                take(task, RunResult({}, f"{LOST}; is memory short for so many jobs?", lost=True))
            except SimulationInterrupted:
                return
            else:
                if found is not None:
                    take(task, found)

        return run_in_processes(work, tasks, jobs, take_late, attempts=ATTEMPTS)
    try:
        for task in tasks:
            result = work(task, _no_look)
            interruption.keep()
            take(task, result)
            interruption.heed()
            interruption.check()
    except SimulationInterrupted:
        return True
    except KeyboardInterrupt:
        interruption.answered()
        return True
    return False


def _no_look(time: float, stage: str = SIMULATION) -> None:
    """Runs here heed signals by themselves."""
