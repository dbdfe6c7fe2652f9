"""Parallel work in worker processes: results in the order of completion, interruption, and loss of workers.

On Ctrl-C the workers return the results that they have. If a worker is killed or stops responding, only its current
task is lost.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import time as clock
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from dynsim.studies import worker as messages
from dynsim.studies.worker import LOOK_S, START, STOP_LOOK_S, WorkerError, packed
from dynsim.system import interruption
from dynsim.system.interruption import STOP_SIGNALS

if TYPE_CHECKING:
    from dynsim.engine import Progress  # imports numba, which not all work needs

Task = TypeVar("Task")
Result = TypeVar("Result")

# Longest time between heartbeats of a worker, and until its first one [s]. A thread of the worker sends them, so that
# they do not depend on the duration of its work; they end if the process is stopped, or if compiled code never releases
# the global interpreter lock.
SILENT_S, START_S = 60.0, 600.0
# Longest time until a worker confirms Ctrl-C [s]; then it may take any time to return its results. Its heartbeats
# measure that time, so that no result is lost if the machine is busy; the second value is the limit without heartbeats.
_PATIENCE_S, _STALLED_S = 0.7, 10.0
# Interval of the checks for signals [s].
_SIGNAL_S = 0.1
# Longest task that is sent to a worker while it is busy [s]: for longer tasks another worker may be free sooner.
_QUICK_S = 0.5
# Lines of a worker's stderr that are reported when it cannot start.
_LAST_LINES = 12


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerLost(Exception):
    """The worker process of a task ended; the message is a clause that begins with ``its process``."""

    def __init__(self, how: str = "its process was killed from outside; if memory is short, use fewer jobs") -> None:
        super().__init__(how)


class WorkerSilent(WorkerLost):
    """The parent killed the worker process because its heartbeats stopped."""

    def __init__(self) -> None:
        super().__init__(f"its process did not respond for {SILENT_S:g} s and was killed")


class WorkerInterrupted(WorkerLost):
    """The parent killed the worker process because it did not react to Ctrl-C while it was starting its work."""


@dataclass(eq=False)
class _Worker:
    """Worker process and the threads that use its pipes, so that the main thread never waits for a pipe.

    Attributes
    ----------
    process : Popen
        The process, with pipes to its three standard streams.
    outbox : SimpleQueue
        Messages to the worker; None allows it to end.
    tasks : deque
        Tasks sent to it, each with the number of processes that have lost it. The first is in progress, the others wait
        in the pipe.
    ready : bool
        Whether it has sent its first heartbeat.
    confirmed : bool
        Whether it has confirmed Ctrl-C.
    heartbeats : int
        Number of heartbeats that arrived after Ctrl-C without a confirmation.
    since : float
        Time at which it began the first task [s].
    last_duration : float
        Duration of its last task [s].
    silent : float
        Time since its last message [s].
    stderr_lines : deque of str
        The last lines of its stderr.
    """

    process: subprocess.Popen[bytes]
    outbox: SimpleQueue[bytes | None] = field(default_factory=SimpleQueue)
    tasks: deque[tuple[Any, int]] = field(default_factory=deque)
    ready: bool = False
    confirmed: bool = False
    heartbeats: int = 0
    since: float = 0.0
    last_duration: float = math.inf
    silent: float = 0.0
    stderr_lines: deque[str] = field(default_factory=lambda: deque(maxlen=_LAST_LINES))
    threads: list[threading.Thread] = field(default_factory=list)
    printing: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> None:
        """Start the threads; they put the messages of the worker into the inbox, and None at their end."""
        for talk, *arguments in ((self._send,), (self._receive, inbox), (self._forward_stderr,)):
            self.threads.append(threading.Thread(target=talk, args=arguments, name="worker", daemon=True))
            self.threads[-1].start()

    def _send(self) -> None:
        assert self.process.stdin is not None
        # The thread that reads the answers notices if the process has ended.
        with suppress(OSError), self.process.stdin as stream:
            while (content := self.outbox.get()) is not None:
                stream.write(content)
                stream.flush()

    def _receive(self, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> None:
        assert self.process.stdout is not None
        # The end of the process may cut off a message.
        with suppress(EOFError, OSError, pickle.UnpicklingError), self.process.stdout as stream:
            while True:
                inbox.put((self, pickle.load(stream)))
        inbox.put((self, None))

    def _forward_stderr(self) -> None:
        """Forward the stderr of the worker; before it is ready, only keep the lines for the error of a failed start."""
        assert self.process.stderr is not None
        with suppress(OSError, ValueError), self.process.stderr as stream:
            for line in stream:
                with self.printing:
                    self.stderr_lines.append(line.decode("utf-8", "replace").rstrip())
                    if self.ready:
                        _print(self.stderr_lines[-1])

    def is_ready(self) -> None:
        """Mark the worker as ready after its first heartbeat, and print the stderr lines kept until then."""
        with self.printing:
            self.ready = True
            for line in self.stderr_lines:
                _print(line)

    @property
    def room(self) -> int:
        """Number of further tasks to send; a quick task is sent early, so that the worker need not wait for it."""
        return (2 if self.last_duration < _QUICK_S else 1) - len(self.tasks)

    def leave(self) -> None:
        """End the process, which has no more tasks or has already ended."""
        self.outbox.put(None)
        try:
            self.process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        # A child process of the worker may still hold its streams open.
        for thread in self.threads:
            thread.join(_PATIENCE_S)


def _print(line: str) -> None:
    if sys.stderr is not None:
        print(line, file=sys.stderr, flush=True)


def run_in_processes(
    work: Callable[[Task, Progress], Result],
    tasks: Iterable[Task],
    jobs: int,
    take: Callable[[Task, Callable[[], Result]], None],
    *,
    attempts: int = 1,
) -> bool:
    """Do ``work(task, look)`` for every task, in several processes.

    Parameters
    ----------
    work : callable
        Function of an importable module. It must call ``look`` often, which raises KeyboardInterrupt to stop it.
    tasks : iterable
        Tasks; they are sent to the processes one at a time as these become free, or one ahead if tasks are quick.
    jobs : int
        Number of processes.
    take : callable
        Called in this process with each task and a function that returns its result, or raises the exception of the
        work or :class:`WorkerLost`. The result is None if Ctrl-C came before the task began. ``take`` is not called for
        tasks that had not been sent to a process at Ctrl-C.
    attempts : int, optional
        Number of processes that a task may lose before it is given up; a task whose process stopped responding is given
        up immediately.

    Returns
    -------
    bool
        True if Ctrl-C made the workers stop early.

    Raises
    ------
    WorkerError
        If a process cannot start, or a task cannot be sent to it.
    """
    pool = _Pool(work, tasks, jobs, take, attempts)
    try:
        try:
            pool.collect()
        except KeyboardInterrupt:
            interruption.answered()
            pool.stop()
            pool.collect()
            return True
    except BaseException:
        # If a result cannot be saved, or after a second Ctrl-C, do not wait for the other workers.
        for worker in pool.workers:
            worker.process.kill()
        raise
    finally:
        interruption.heed()
        for worker in pool.workers:
            worker.outbox.put(None)
        for worker in pool.workers:
            worker.leave()
    return False


class _Pool:
    """Workers and their tasks, see :func:`run_in_processes`."""

    def __init__(self, work: Any, tasks: Iterable[Any], jobs: int, take: Any, attempts: int) -> None:
        self.workers: list[_Worker] = []
        self._jobs, self._take, self._attempts = jobs, take, attempts
        self._beginning = _beginning(work)
        self._waiting = ((task, 0) for task in tasks)
        # Tasks to retry after a worker died, with the number of losses; they are sent before new tasks.
        self._again: list[tuple[Any, int]] = []
        self._inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]] = SimpleQueue()
        self._stopped: float | None = None

    def stop(self) -> None:
        """Send the stop message to all workers, and hand out no more tasks."""
        self._stopped = clock.monotonic()
        for worker in self.workers:
            worker.outbox.put(pickle.dumps((messages.STOP,)))

    def collect(self) -> None:
        """Send tasks and take results until no more are expected; signals are deferred while this process works."""
        looked = clock.monotonic()
        while True:
            interruption.keep()
            if self._stopped is None:
                self._hand_out()
            if not any(worker.tasks for worker in self.workers):
                interruption.heed()
                return
            with suppress(Empty):
                worker, message = self._inbox.get(timeout=_SIGNAL_S)
                # A worker that this process has ended may have left messages.
                if worker in self.workers:
                    self._handle(worker, message)
            # If this process was stopped for a while, for example by Ctrl-Z, it has not looked for messages either.
            passed, looked = min(clock.monotonic() - looked, 2.0 * LOOK_S), clock.monotonic()
            self._end_unresponsive(passed)
            interruption.heed()
            interruption.check()

    def _hand_out(self) -> None:
        while True:
            worker = min(self.workers, key=lambda worker: len(worker.tasks), default=None)
            full = worker is None or worker.tasks
            if len(self.workers) == self._jobs and (worker is None or worker.room < 1):
                return
            task = self._again.pop() if self._again else next(self._waiting, None)
            if task is None:
                return
            content = packed(task[0])
            if worker is None or (full and len(self.workers) < self._jobs):
                worker = _start(self._beginning, self._inbox)
                self.workers.append(worker)
            if not worker.tasks:
                worker.since = clock.monotonic()
            worker.tasks.append(task)
            worker.outbox.put(pickle.dumps((messages.TASK, content)))

    def _handle(self, worker: _Worker, message: tuple[Any, ...] | None) -> None:
        """Handle a message of a worker; None at the end of its output."""
        worker.silent = 0.0
        match message:
            case (messages.READY,):
                worker.is_ready()
            case (messages.CONFIRMED,):
                worker.confirmed = True
            case (messages.ALIVE,):
                worker.heartbeats += self._stopped is not None
            case (messages.LOG, name, level, text):
                logging.getLogger(name).log(level, "%s", text)
            case (messages.ANSWER, good, content, leaves):
                now = clock.monotonic()
                worker.since, worker.last_duration = now, now - worker.since
                task, _ = worker.tasks.popleft()
                if leaves:
                    self._dismiss(worker)
                self._take(task, partial(_result, good, content))
            case None:
                self._lose(worker)

    def _lose(self, worker: _Worker) -> None:
        lost = worker.tasks.popleft() if worker.tasks else None
        self._dismiss(worker)
        if not worker.ready and self._stopped is None:
            raise WorkerError(_no_start(worker))
        if lost is None:
            return
        task, losses = lost
        if self._stopped is None and losses + 1 < self._attempts:
            self._again.append((task, losses + 1))
        else:
            self._take(task, partial(_raise, WorkerLost if worker.ready else WorkerInterrupted))

    def _dismiss(self, worker: _Worker) -> None:
        """Remove a worker that has ended or will end, and return the tasks that wait in its pipe to the queue."""
        self.workers.remove(worker)
        worker.leave()
        self._again.extend(worker.tasks)
        worker.tasks.clear()

    def _end_unresponsive(self, passed: float) -> None:
        """End workers that stopped responding or do not confirm Ctrl-C in time.

        ``passed`` is the time since the last call [s].
        """
        for worker in [worker for worker in self.workers if worker.tasks]:
            worker.silent += passed
            if worker.silent > (SILENT_S if worker.ready else START_S):
                kind: type[WorkerLost] = WorkerSilent
            elif self._stopped is not None and not worker.confirmed and self._is_unresponsive(worker, self._stopped):
                kind = WorkerInterrupted
            else:
                continue
            task, _ = worker.tasks.popleft()
            worker.process.kill()
            self._dismiss(worker)
            self._take(task, partial(_raise, kind))

    @staticmethod
    def _is_unresponsive(worker: _Worker, stopped: float) -> bool:
        """Return whether a worker had enough time to confirm Ctrl-C, which came at ``stopped`` [s]."""
        waited = clock.monotonic() - stopped
        if not worker.ready:
            return waited > _PATIENCE_S
        return worker.heartbeats * STOP_LOOK_S > _PATIENCE_S or waited > _STALLED_S


def _raise(kind: type[WorkerLost]) -> NoReturn:
    raise kind


def _result(good: bool, content: bytes) -> Any:
    value = pickle.loads(content)
    if not good:
        raise value
    return value


def _beginning(work: Any) -> bytes:
    """Return the first messages to a worker, see :func:`dynsim.studies.worker.serve`.

    The worker searches for dynsim in the working directory last, so that a ``json.py`` there does not replace the
    standard module.
    """
    here = ("", os.curdir, os.getcwd() if os.path.isdir(os.curdir) else "")
    path = [folder for folder in sys.path if isinstance(folder, str)]
    safe = sorted(path, key=lambda folder: folder in here)
    return pickle.dumps(safe) + pickle.dumps((path, _log_level(), packed(work)))


def _start(beginning: bytes, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> _Worker:
    if not sys.executable:
        raise WorkerError("no Python interpreter found to start worker processes; use jobs=1")
    try:
        with signals_held():
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", START],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            )  # fmt: skip
    except OSError as error:
        raise WorkerError(f"cannot start a worker process ({error}); use fewer jobs") from error
    worker = _Worker(process)
    worker.outbox.put(beginning)
    worker.begin(inbox)
    return worker


def _no_start(worker: _Worker) -> str:
    code = worker.process.returncode
    how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
    output = "".join(f"\n  {line}" for line in worker.stderr_lines) or " nothing"
    return f"a worker process {how} while starting; if memory is short, use fewer jobs; its output:{output}"


def _log_level() -> int:
    """Return the lowest log level for which a handler exists; workers need not create messages below it."""
    library = logging.getLogger("dynsim")
    logger: logging.Logger | None = library
    while logger is not None:
        if any(not isinstance(handler, logging.NullHandler) for handler in logger.handlers):
            return library.getEffectiveLevel()
        logger = logger.parent if logger.propagate else None
    return logging.CRITICAL + 1


@contextmanager
def signals_held() -> Iterator[None]:
    """Shield processes that start in the block from Ctrl-C in the terminal; this process receives it after the block.

    Only the parent reacts to Ctrl-C and informs the workers; the same applies to the other ``STOP_SIGNALS``.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
