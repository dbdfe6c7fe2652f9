"""Parallel work in worker processes: results in the order of completion, interruption, and loss of workers.

Ctrl-C lets the workers return the results that they have. A worker that is killed, or gives no sign of life, costs only
the task that it was doing.
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
    from dynsim.engine import Progress  # numba, which not every work needs

Task = TypeVar("Task")
Result = TypeVar("Result")

# Longest time between signs of life of a worker, and until its first one [s]. A thread of the worker sends them, so
# they do not depend on the duration of its work; they end where the process is stopped, or compiled code never releases
# the interpreter's lock.
SILENT_S, START_S = 60.0, 600.0
# Longest time until a worker confirms Ctrl-C [s]; then it may take any time to return its results. Its signs of life
# measure that time, so that no result is lost where the machine is busy; the second is the limit without signs.
_PATIENCE_S, _STALLED_S = 0.7, 10.0
# Interval of the checks for signals [s].
_SIGNAL_S = 0.1
# Longest task that is sent to a worker still busy [s]: for longer ones another worker may be free sooner.
_QUICK_S = 0.5
# Lines of a worker's stderr that are reported when it cannot start.
_LAST_LINES = 12


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerLost(Exception):
    """The process that had a task is gone; the message says how, in a sentence that begins with ``its process``."""

    def __init__(self, how: str = "its process was ended from outside; is memory short for so many jobs?") -> None:
        super().__init__(how)


class WorkerSilent(WorkerLost):
    """It gave no sign of life any more, and was ended here."""

    def __init__(self) -> None:
        super().__init__(f"its process gave no sign of life for {SILENT_S:g} s and was ended")


class WorkerInterrupted(WorkerLost):
    """It was ended here, because it did not hear of Ctrl-C in what it had just begun with."""


@dataclass(eq=False)
class _Worker:
    """A process and the threads that talk with it: none of its pipes is ever waited for here.

    Attributes
    ----------
    process : with pipes to all three of its standard streams
    outbox : messages for it, None: it may end
    tasks : what it has, each with how many processes have lost it: the first in hand, the others wait in the pipe
    ready : after its first sign of life
    heard : of Ctrl-C
    signs : of life that came after Ctrl-C and did not confirm it
    since : when it began with the first task
    took : how long the last one took [s]
    silent : for how long there were no messages from it [s]
    said : the last lines of its stderr
    """

    process: subprocess.Popen[bytes]
    outbox: SimpleQueue[bytes | None] = field(default_factory=SimpleQueue)
    tasks: deque[tuple[Any, int]] = field(default_factory=deque)
    ready: bool = False
    heard: bool = False
    signs: int = 0
    since: float = 0.0
    took: float = math.inf
    silent: float = 0.0
    said: deque[str] = field(default_factory=lambda: deque(maxlen=_LAST_LINES))
    threads: list[threading.Thread] = field(default_factory=list)
    printing: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> None:
        """Start the threads; what it sends comes to the inbox, None at its end."""
        for talk, *arguments in ((self._send,), (self._receive, inbox), (self._hear,)):
            self.threads.append(threading.Thread(target=talk, args=arguments, name="worker", daemon=True))
            self.threads[-1].start()

    def _send(self) -> None:
        assert self.process.stdin is not None
        # A process that is gone shows when its answer is read.
        with suppress(OSError), self.process.stdin as stream:
            while (content := self.outbox.get()) is not None:
                stream.write(content)
                stream.flush()

    def _receive(self, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> None:
        assert self.process.stdout is not None
        # A message that its end has cut off.
        with suppress(EOFError, OSError, pickle.UnpicklingError), self.process.stdout as stream:
            while True:
                inbox.put((self, pickle.load(stream)))
        inbox.put((self, None))

    def _hear(self) -> None:
        """What it writes to stderr is written here; until it is ready it is kept, for the error if it never is."""
        assert self.process.stderr is not None
        with suppress(OSError, ValueError), self.process.stderr as stream:
            for line in stream:
                with self.printing:
                    self.said.append(line.decode("utf-8", "replace").rstrip())
                    if self.ready:
                        _print(self.said[-1])

    def is_ready(self) -> None:
        """It has given its first sign of life: what it has written to stderr until then is written too."""
        with self.printing:
            self.ready = True
            for line in self.said:
                _print(line)

    @property
    def room(self) -> int:
        """For how many more tasks: quick ones are there when it has time, so that it need not wait for them."""
        return (2 if self.took < _QUICK_S else 1) - len(self.tasks)

    def leave(self) -> None:
        """Let it end: it has nothing to do, or is gone."""
        self.outbox.put(None)
        try:
            self.process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        # A process that it has started may have its streams open.
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
    """Do ``work(task, look)`` for every task, each in one of several processes.

    Parameters
    ----------
    work : of a module; it calls ``look`` often, which raises KeyboardInterrupt when it shall stop
    tasks : sent to the processes one by one, as they come to have time; of quick ones, one before that
    jobs : processes
    take : called here with every task and a function that returns the result or raises what the work raised, or
        :class:`WorkerLost`; None for a task that Ctrl-C came before, and no call for those that nobody had then. A task
        whose process was silent is given up at once
    attempts : how many processes a task may lose before it is given up

    Returns
    -------
    bool
        True if Ctrl-C made the workers stop early.

    Raises
    ------
    WorkerError
        A process cannot start, or a task cannot be sent to one.
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
        # A result that cannot be saved, or a second Ctrl-C: nobody waits for the others.
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
    """Workers and what they do, see :func:`run_in_processes`."""

    def __init__(self, work: Any, tasks: Iterable[Any], jobs: int, take: Any, attempts: int) -> None:
        self.workers: list[_Worker] = []
        self._jobs, self._take, self._attempts = jobs, take, attempts
        self._beginning = _beginning(work)
        self._waiting = ((task, 0) for task in tasks)
        # Tasks whose process was lost, and how often: they come before those that nobody has had.
        self._again: list[tuple[Any, int]] = []
        self._inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]] = SimpleQueue()
        self._stopped: float | None = None

    def stop(self) -> None:
        """Tell all workers, and hand out no more."""
        self._stopped = clock.monotonic()
        for worker in self.workers:
            worker.outbox.put(pickle.dumps((messages.STOP,)))

    def collect(self) -> None:
        """Hand out tasks and take results until there are none to come; signals wait while something is done here."""
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
                # Of one that was ended here there may be some left.
                if worker in self.workers:
                    self._heed(worker, message)
            # A process that was stopped for a while, as by Ctrl-Z, has not looked either.
            passed, looked = min(clock.monotonic() - looked, 2.0 * LOOK_S), clock.monotonic()
            self._give_up(passed)
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

    def _heed(self, worker: _Worker, message: tuple[Any, ...] | None) -> None:
        """A message of a worker, None at its end."""
        worker.silent = 0.0
        match message:
            case (messages.READY,):
                worker.is_ready()
            case (messages.HEARD,):
                worker.heard = True
            case (messages.ALIVE,):
                worker.signs += self._stopped is not None
            case (messages.LOG, name, level, text):
                logging.getLogger(name).log(level, "%s", text)
            case (messages.ANSWER, good, content, leaves):
                now = clock.monotonic()
                worker.since, worker.took = now, now - worker.since
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
        """It is gone, or will be; what waited in its pipe nobody has begun with."""
        self.workers.remove(worker)
        worker.leave()
        self._again.extend(worker.tasks)
        worker.tasks.clear()

    def _give_up(self, passed: float) -> None:
        """End workers that give no sign of life, so long [s] after the last look, or do not hear of Ctrl-C in time."""
        for worker in [worker for worker in self.workers if worker.tasks]:
            worker.silent += passed
            if worker.silent > (SILENT_S if worker.ready else START_S):
                kind: type[WorkerLost] = WorkerSilent
            elif self._stopped is not None and not worker.heard and self._is_deaf(worker, self._stopped):
                kind = WorkerInterrupted
            else:
                continue
            task, _ = worker.tasks.popleft()
            worker.process.kill()
            self._dismiss(worker)
            self._take(task, partial(_raise, kind))

    @staticmethod
    def _is_deaf(worker: _Worker, stopped: float) -> bool:
        """Whether a worker that has not confirmed Ctrl-C, which came at ``stopped`` [s], has had the time to do so."""
        waited = clock.monotonic() - stopped
        if not worker.ready:
            return waited > _PATIENCE_S
        return worker.signs * STOP_LOOK_S > _PATIENCE_S or waited > _STALLED_S


def _raise(kind: type[WorkerLost]) -> NoReturn:
    raise kind


def _result(good: bool, content: bytes) -> Any:
    value = pickle.loads(content)
    if not good:
        raise value
    return value


def _beginning(work: Any) -> bytes:
    """The first messages to a worker, see :func:`dynsim.studies.worker.serve`.

    dynsim itself is looked for in the working directory last: a ``json.py`` there is not what it means.
    """
    here = ("", os.curdir, os.getcwd() if os.path.isdir(os.curdir) else "")
    path = [folder for folder in sys.path if isinstance(folder, str)]
    safe = sorted(path, key=lambda folder: folder in here)
    return pickle.dumps(safe) + pickle.dumps((path, _heard_from(), packed(work)))


def _start(beginning: bytes, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> _Worker:
    if not sys.executable:
        raise WorkerError("no Python is known that processes could be started with; take one job")
    try:
        with signals_held():
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", START],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            )  # fmt: skip
    except OSError as error:
        raise WorkerError(f"no process can be started ({error}); take fewer jobs") from error
    worker = _Worker(process)
    worker.outbox.put(beginning)
    worker.begin(inbox)
    return worker


def _no_start(worker: _Worker) -> str:
    code = worker.process.returncode
    how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
    said = "".join(f"\n  {line}" for line in worker.said) or " nothing"
    return f"a process that was started for the jobs {how} before it could work; is memory short? It said:{said}"


def _heard_from() -> int:
    """Level from which on anybody hears what is logged here: workers need not even make other messages."""
    library = logging.getLogger("dynsim")
    asked: logging.Logger | None = library
    while asked is not None:
        if any(not isinstance(handler, logging.NullHandler) for handler in asked.handlers):
            return library.getEffectiveLevel()
        asked = asked.parent if asked.propagate else None
    return logging.CRITICAL + 1


@contextmanager
def signals_held() -> Iterator[None]:
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
