"""Batch of independent runs, in processes or on a cluster: each yields a summary, or the reason for its failure."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from typing import Any, Generic, Literal, TypeVar, get_args

from dynsim.engine import Progress, simulate
from dynsim.errors import DynsimError, ScenarioError, SimulationInterrupted, SimulationStopped, brief
from dynsim.scenario import Scenario, require_scenario
from dynsim.studies.outcome import RunResult
from dynsim.studies.processes import WorkerInterrupted, WorkerLost, run_in_processes
from dynsim.system import interruption
from dynsim.system.memo import Memo, remembering

Keep = Literal["none", "failed", "all"]
Task = TypeVar("Task")

# Attempts of a run whose process is lost: the first may have been ended because another run used up the memory.
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
        raise ScenarioError(f"keep_records = {brief(keep_records)}: must be one of {', '.join(get_args(Keep))}")
    results: dict[int, RunResult] = {}

    def take(task: tuple[int, Scenario], result: RunResult) -> None:
        results[task[0]] = result
        if finished is not None:
            finished(task[0], result)

    if run_all(BatchWork(itemgetter(1), keep_records), list(enumerate(runs)), take, jobs=jobs, scheduler=scheduler):
        raise SimulationInterrupted(f"interrupted when {len(results)} of {len(runs)} runs were done")
    return [results[k] for k in range(len(runs))]


class BatchWork(Generic[Task]):
    """What is done for tasks, in a process of its own too: what their runs have in common stays there with it.

    Parameters
    ----------
    load : a task's scenario; of a module, or bound to what can be sent to processes
    keep : whose records are kept, see :func:`simulate_batch`
    """

    def __init__(self, load: Callable[[Task], Scenario], keep: Keep) -> None:
        self._load, self._keep, self._memo = load, keep, Memo()

    def __call__(self, task: Task, look: Progress | None) -> RunResult:
        """Load and simulate a task, whatever becomes of it.

        Raises
        ------
        SimulationInterrupted
            ``look`` raised KeyboardInterrupt.
        """
        started, record, reason = clock.perf_counter(), None, ""
        try:
            with remembering(self._memo):
                record = simulate(self._load(task), look, pictured=self._keep != "none")
        except SimulationInterrupted:
            raise
        except Exception as error:
            # Hours of other runs must not go for a fault of dynsim in one, which is told by its kind.
            kind = "" if isinstance(error, DynsimError) else f"{type(error).__name__}: "
            reason = " ".join(f"{kind}{error}".split())
            record = error.record if isinstance(error, SimulationStopped) else None
        kept = self._keep == "all" or (self._keep == "failed" and reason)
        return RunResult(
            {} if record is None else record.summary,
            reason,
            record=record if kept else None,
            wall_s=clock.perf_counter() - started,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._load, self._keep)


def run_all(
    work: Callable[[Task, Progress | None], RunResult],
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
        raise ScenarioError(f"jobs = {brief(jobs)}: must be a whole number of processes, 1 or more")
    if scheduler is not None:
        from dynsim.studies.cluster import run_on_cluster

        return run_on_cluster(work, tasks, take, scheduler)
    if jobs > 1:

        def take_late(task: Task, result: Callable[[], RunResult | None]) -> None:
            try:
                ended = result()
            except (SimulationInterrupted, WorkerInterrupted):
                return
            except WorkerLost as lost:
                ended = RunResult({}, str(lost), lost=True)
            if ended is not None:
                take(task, ended)

        return run_in_processes(work, tasks, jobs, take_late, attempts=ATTEMPTS)
    try:
        for task in tasks:
            result = work(task, None)
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
