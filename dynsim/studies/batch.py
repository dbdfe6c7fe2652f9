"""Many runs: each ends as a summary, or as the reason why there is none."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, Literal, TypeVar, get_args

from dynsim.engine import SIMULATION, Progress, simulate
from dynsim.errors import DynsimError, ScenarioError, SimulationInterrupted, SimulationStopped, shown
from dynsim.record import Record
from dynsim.scenario import Scenario, require_scenario
from dynsim.studies.outcome import LOST, RunResult
from dynsim.studies.processes import SILENT, WorkerInterrupted, WorkerLost, WorkerSilent, run_in_processes
from dynsim.system import interruption
from dynsim.system.memo import Memo, remembering

Keep = Literal["none", "failed", "all"]
Task = TypeVar("Task")

# Processes that a run may take with it before it is given up: the first may have been ended for another's memory.
ATTEMPTS = 2


def simulate_batch(
    scenarios: Iterable[Scenario],
    *,
    jobs: int = 1,
    keep_records: Keep = "none",
    scheduler: str | None = None,
    finished: Callable[[int, RunResult], None] | None = None,
) -> list[RunResult]:
    """Simulate many scenarios; one that fails does not keep the others from running.

    Every run is that of :func:`dynsim.simulate` to the bit, whatever ``jobs`` and whichever runs are beside it.

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

    if run_all(Work(_numbered, keep_records), list(enumerate(runs)), take, jobs=jobs, scheduler=scheduler):
        raise SimulationInterrupted(f"interrupted when {len(results)} of {len(runs)} runs were done")
    return [results[k] for k in range(len(runs))]


def _numbered(task: tuple[int, Scenario]) -> Scenario:
    return task[1]


class Work(Generic[Task]):
    """What is done for tasks, in a process of its own too: what their runs have in common stays there with it.

    Parameters
    ----------
    load : a task's scenario; of a module, or bound to what can be sent to processes
    keep : whose records are kept, see :func:`simulate_batch`
    """

    def __init__(self, load: Callable[[Task], Scenario], keep: Keep) -> None:
        self._load, self._keep, self._memo = load, keep, Memo()

    def __call__(self, task: Task, look: Progress | None) -> RunResult:
        """Load and simulate a task; see :func:`run_one`."""
        with remembering(self._memo):
            try:
                scenario = self._load(task)
            except Exception as error:
                return _failed(error)
            return run_one(scenario, self._keep, look)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._load, self._keep)


def run_one(scenario: Scenario, keep: Keep, look: Progress | None) -> RunResult:
    """Simulate a scenario, whatever becomes of it.

    Raises
    ------
    SimulationInterrupted
        ``look`` raised KeyboardInterrupt.
    """
    started = clock.perf_counter()
    try:
        ended: Record | DynsimError = simulate(scenario, look, pictured=keep != "none")
    except SimulationInterrupted:
        raise
    except DynsimError as error:
        ended = error
    except Exception as error:
        # Hours of other runs must not go for a fault of dynsim in one.
        return _failed(error)
    return _ended(ended, keep, clock.perf_counter() - started)


def _ended(ended: Record | DynsimError, keep: Keep, wall: float) -> RunResult:
    """The record of a run that came to its end, or the error of one that did not, as its result."""
    if isinstance(ended, Record):
        return RunResult(ended.summary, record=ended if keep == "all" else None, wall_s=wall)
    record = ended.record if isinstance(ended, SimulationStopped) else None
    summary = {} if record is None else record.summary
    return RunResult(summary, _line(ended), record=None if keep == "none" else record, wall_s=wall)


def _failed(error: Exception) -> RunResult:
    """Without anything simulated; a fault of dynsim by its kind."""
    return RunResult({}, _line(error) if isinstance(error, DynsimError) else f"{type(error).__name__}: {_line(error)}")


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
                ended = result()
            except (SimulationInterrupted, WorkerInterrupted):
                return
            except WorkerSilent:
                ended = RunResult({}, SILENT, lost=True)
            except WorkerLost:
                ended = RunResult({}, f"{LOST}; is memory short for so many jobs?", lost=True)
            if ended is not None:
                take(task, ended)

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
