"""Batch of runs on a Dask cluster: tasks are sent to its workers, and results are received in the order of completion.

Dask starts the cluster, retries tasks after the loss of a worker, and scales the cluster adaptively.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from dynsim._version import __version__
from dynsim.engine import Progress
from dynsim.errors import DynsimError
from dynsim.studies.outcome import RunResult
from dynsim.system import interruption

Task = TypeVar("Task")

# Maximum waiting time for an answer from the scheduler [s].
_CONNECT_S = 10.0
# Duration of one piece of work [s]. It is short, to balance the load of the cluster, but long enough for scheduler and
# client to handle one piece for each thread in that time; they need a few milliseconds per piece (docs/sweeps.md).
_PIECE_S, _PIECE_S_PER_THREAD = 1.0, 0.015
_PIECE_MAX_TASKS = 2048
# Number of pending pieces: several per thread, and enough for adaptive scaling to add workers.
_PENDING_PER_THREAD, _PENDING_MIN = 3, 64

# Only one run at a time is simulated in a process, because other threads of a worker would only wait for the global
# interpreter lock.
_one_at_a_time = threading.Lock()


class ClusterError(DynsimError):
    """Raised if Dask is missing, no scheduler answers, or a worker cannot do the work."""


def run_on_cluster(
    work: Callable[[Task, Progress | None], RunResult],
    tasks: Sequence[Task],
    take: Callable[[Task, RunResult], None],
    address: str,
) -> bool:
    """Call ``work`` for all tasks on the workers of a scheduler, see :func:`dynsim.studies.batch.run_all`.

    Tasks are sent in pieces that take about a second, according to measured durations. A piece whose workers die
    repeatedly is split into its tasks; a task whose workers die again is lost.

    Raises
    ------
    ClusterError
        If Dask is not installed, no scheduler answers at the address (any more), or a worker has no dynsim or a
        different version of it.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker, as_completed
        from distributed.comm import resolve_address
    except ImportError as error:
        raise ClusterError("a scheduler requires Dask: pip install 'dynsim[cluster]'") from error
    try:
        # A client with an invalid address would print an error when it is garbage-collected.
        resolve_address(address)
        client: Any = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:
        raise ClusterError(f"no Dask scheduler answers at {address} ({' '.join(str(error).split())})") from error
    waiting, out = deque(tasks), dict[Any, list[Task]]()
    wall = _PIECE_S

    def submit(piece: list[Task]) -> Any:
        future = client.submit(_run_piece, work, piece, __version__, pure=False)
        out[future] = piece
        return future

    def hand_out() -> list[Any]:
        threads = sum(worker["nthreads"] for worker in client.scheduler_info(n_workers=-1)["workers"].values())
        size = min(max(round(max(_PIECE_S, _PIECE_S_PER_THREAD * threads) / max(wall, 1e-9)), 1), _PIECE_MAX_TASKS)
        # The last pieces are smaller, so that all workers finish at about the same time.
        size = min(size, max(len(waiting) // (2 * max(threads, 1)), 1))
        futures = []
        while waiting and len(out) < max(_PENDING_MIN, _PENDING_PER_THREAD * threads):
            futures.append(submit([waiting.popleft() for _ in range(min(size, len(waiting)))]))
        return futures

    with _quiet(), client:
        try:
            queue = as_completed(hand_out(), loop=client.loop)
            for future in queue:
                interruption.keep()
                piece = out.pop(future)
                try:
                    results = future.result()
                except KilledWorker:
                    if len(piece) == 1:
                        take(
                            piece[0],
                            RunResult({}, "its process was killed from outside on several workers", lost=True),
                        )
                    else:
                        queue.update([submit([task]) for task in piece])
                except CancelledError as error:
                    raise ClusterError(f"the Dask scheduler at {address} no longer answers") from error
                except ImportError as error:
                    raise ClusterError(
                        f"a worker of {address} cannot load dynsim ({error}); install it there"
                    ) from error
                else:
                    wall = sum(result.wall_s for result in results) / len(results)
                    for task, result in zip(piece, results, strict=True):
                        take(task, result)
                future.release()
                queue.update(hand_out())
                interruption.heed()
                interruption.check()
        except KeyboardInterrupt:
            interruption.answered()
            client.cancel(list(out))
            return True
    return False


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Dask's log messages in the block; its problems are reported once, as errors."""
    # These are the loggers whose level Dask sets separately.
    before = {logger: logger.level for logger in map(logging.getLogger, ("distributed", "distributed.client"))}
    for logger in before:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in before.items():
            logger.setLevel(level)


def _run_piece(
    work: Callable[[Task, Progress | None], RunResult], tasks: Sequence[Task], version: str
) -> list[RunResult]:
    """Call the work function for each task, on a worker."""
    if version != __version__:
        raise ClusterError(f"a worker has dynsim {__version__}, but this is {version}; install the same version")
    with _one_at_a_time:
        return [work(task, None) for task in tasks]
