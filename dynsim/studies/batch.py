"""Batch of independent runs, in processes or on a cluster; each returns a summary or the reason for its failure."""

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
from dynsim.system.arguments import names_wrong_types
from dynsim.system.memo import Memo, remembering

Keep = Literal["none", "failed", "all"]
Task = TypeVar("Task")

# Number of attempts at a run whose process is lost. The process may have been killed because another run used up the
# memory.
ATTEMPTS = 2


@names_wrong_types
def simulate_batch(
    scenarios: Iterable[Scenario],
    *,
    jobs: int = 1,
    keep_records: Keep = "none",
    scheduler: str | None = None,
    finished: Callable[[int, RunResult], None] | None = None,
) -> list[RunResult]:
    """Simulate many scenarios in parallel and return a result for each; a failed run does not stop the other runs.

    Each run is bit-identical to :func:`dynsim.simulate`, whatever ``jobs`` is and whichever other runs are in the
    batch.

    Parameters
    ----------
    scenarios : iterable of Scenario
        Scenarios to simulate; their plants may differ.
    jobs : int, optional
        Number of processes, including this process while runs are short; default: 1.
    keep_records : {"none", "failed", "all"}, optional
        Results that keep their record: none (default), only the results of runs that stopped early, or all.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers then run the simulations.
    finished : callable, optional
        Called with the index of a run and its result as soon as the result is available.

    Returns
    -------
    list of RunResult
        Results in the order of ``scenarios``; each has ``ok``, ``summary``, ``reason`` and ``record``.

    Raises
    ------
    ScenarioError
        If an entry is not a Scenario, or ``jobs`` or ``keep_records`` is invalid.
    ClusterError
        If no scheduler answers at the address, or a worker cannot run dynsim.
    WorkerError
        If a worker process cannot start.
    SimulationInterrupted
        On Ctrl-C; ``finished`` has been called for all runs completed until then.

    Examples
    --------
    >>> import dynsim
    >>> names, short = ("two_elbows", "no_elbow"), {"duration_s": 0.1}
    >>> scenarios = [dynsim.load_scenario("elbow_comparison", name, short) for name in names]
    >>> results = dynsim.simulate_batch(scenarios)
    >>> [result.ok for result in results]
    [True, True]
    >>> results[0].summary["variant"], results[0].summary["duration_s"]
    ('two_elbows', 0.1)
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
        raise SimulationInterrupted(f"interrupted after {len(results)} of {len(runs)} runs")
    return [results[k] for k in range(len(runs))]


class BatchWork(Generic[Task]):
    """Function object that processes the tasks of a batch; each process has one memo for results that its runs share.

    Parameters
    ----------
    load : callable
        Function that returns the scenario of a task. It must be picklable: a module-level function, or a method of a
        picklable object.
    keep : {"none", "failed", "all"}
        Runs whose records are kept, see :func:`simulate_batch`.
    """

    def __init__(self, load: Callable[[Task], Scenario], keep: Keep) -> None:
        self._load, self._keep, self._memo = load, keep, Memo()

    def __call__(self, task: Task, look: Progress | None) -> RunResult:
        """Load and simulate a task, and return a failure as a result.

        Raises
        ------
        SimulationInterrupted
            If ``look`` raises KeyboardInterrupt.
        """
        started, record, reason = clock.perf_counter(), None, ""
        try:
            with remembering(self._memo):
                record = simulate(self._load(task), look, pictured=self._keep != "none")
        except SimulationInterrupted:
            raise
        except Exception as error:
            # A bug in dynsim that affects one run must not destroy hours of other runs. The reason of such a failure
            # starts with the error type.
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
    """Call ``work`` for all tasks here, in processes or on a cluster; pass each result to ``take`` when it arrives.

    Parameters
    ----------
    work : callable
        Called with a task and its progress function; returns its result.
    tasks : sequence
        Tasks; they must be picklable if ``jobs`` > 1 or if there is a scheduler.
    take : callable
        Called in this process with a task and its result.
    jobs, scheduler
        See :func:`simulate_batch`.

    Returns
    -------
    bool
        True if Ctrl-C was pressed before all tasks were done.

    Raises
    ------
    ScenarioError
        If ``jobs`` is invalid.
    ClusterError
        If no scheduler answers at the address, or a worker cannot run dynsim.
    """
    if not isinstance(jobs, int) or jobs < 1:
        raise ScenarioError(f"jobs = {brief(jobs)}: must be an integer of at least 1")
    if scheduler is not None:
        from dynsim.studies.cluster import run_on_cluster

        return run_on_cluster(work, tasks, take, scheduler)

    def take_late(task: Task, result: Callable[[], RunResult | None]) -> None:
        try:
            ended = result()
        except (SimulationInterrupted, WorkerInterrupted):
            return
        except WorkerLost as lost:
            ended = RunResult({}, str(lost), lost=True)
        if ended is not None:
            take(task, ended)

    return run_in_processes(work, tasks, jobs, take_late, attempts=ATTEMPTS, here=lambda task: None)
