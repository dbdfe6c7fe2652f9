"""Work in processes: every result as it comes, Ctrl-C lets the workers hand back what they have, a killed one costs
only the task that it had in hand.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
import math
import os
import platform
import signal
import sys
import threading
import time as clock
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from multiprocessing import connection, get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from dynsim import garbage, interruption
from dynsim.interruption import STOP_SIGNALS

if TYPE_CHECKING:
    from dynsim.engine import Progress  # numba, which not every work needs

Task = TypeVar("Task")
Result = TypeVar("Result")

# Between two looks for a signal that was lost [s].
_LOOK_S = 0.5
# Of a task, to be sent before the worker has time for it: with longer ones another worker may have time sooner [s].
_QUICK_S = 0.5
# How processes begin. Spawned, not forked: the parent may hold threads and an open progress display.
_SPAWN, _FORK_SERVER = "spawn", "forkserver"
_method = _SPAWN


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def begin_early(*modules: str) -> None:
    """Load modules in a process of their own, while this one does other things: workers will be copies of that.

    For commands, at their beginning: workers get the environment that there was then. Only Linux has what it takes;
    elsewhere every worker loads for itself.
    """
    global _method
    if platform.system() != "Linux":
        return
    from multiprocessing import forkserver

    forkserver.set_forkserver_preload(["dynsim.studies.preloaded", *modules])
    # No room for its socket (a long TMPDIR), no working directory, too many open files: workers load for themselves.
    with suppress(OSError):
        with signals_held(), _own_modules():
            forkserver.ensure_running()
        _method = _FORK_SERVER


@contextmanager
def _own_modules() -> Iterator[None]:
    """What is started here finds the modules that this process does, not a ``json.py`` of the working directory."""
    name = "PYTHONSAFEPATH"
    if name in os.environ or {"", os.getcwd()} & set(sys.path):
        yield
        return
    os.environ[name] = "1"
    try:
        yield
    finally:
        del os.environ[name]


class WorkerLost(Exception):
    """The process that had a task was ended from outside."""


@dataclass
class _Worker:
    """A process and this end of its pipe.

    Attributes
    ----------
    tasks : what it has, each with how many processes have lost it: the first in hand, the others wait in the pipe
    since : when it began with the first
    took : how long the last one took [s]
    """

    process: Any
    pipe: Connection
    tasks: deque[tuple[Any, int]] = field(default_factory=deque)
    since: float = 0.0
    took: float = math.inf

    @property
    def room(self) -> int:
        """For how many more tasks: quick ones are there when it has time, so that it need not wait for them."""
        return (2 if self.took < _QUICK_S else 1) - len(self.tasks)


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
        :class:`WorkerLost`; None for a task that Ctrl-C came before, and no call for those that nobody had then
    attempts : how many processes a task may lose before it is given up

    Returns
    -------
    bool
        True if Ctrl-C made the workers stop early.
    """
    context: Any = get_context(_method)
    waiting = zip(tasks, itertools.repeat(0))
    workers: list[_Worker] = []
    # Tasks whose process was lost, and how often: they come before those that nobody has had.
    again: list[tuple[Task, int]] = []
    with signals_held():
        # Without a lock, which a killed worker would leave closed.
        stop = context.RawValue("b", 0)

    def start(sender: Connection) -> _Worker:
        here, there = context.Pipe()
        arguments = (work, there, stop, sender, _heard_from())
        with signals_held():
            process = context.Process(target=_serve, args=arguments)
            process.start()
        there.close()
        return _Worker(process, here)

    def hand_out(sender: Connection) -> None:
        while True:
            worker = min(workers, key=lambda worker: len(worker.tasks), default=None)
            full = worker is None or worker.tasks
            if len(workers) == jobs and (worker is None or worker.room < 1):
                return
            task = again.pop() if again else next(waiting, None)
            if task is None:
                return
            if worker is None or (full and len(workers) < jobs):
                worker = start(sender)
                workers.append(worker)
            if not worker.tasks:
                worker.since = clock.monotonic()
            worker.tasks.append(task)
            # A process that is gone shows when its answer is read.
            with suppress(OSError):
                worker.pipe.send(task[0])

    def collect(sender: Connection | None) -> None:
        """Take results until there are none to come; new tasks are only handed out with a ``sender``."""
        while True:
            if sender is not None:
                interruption.keep()
                hand_out(sender)
                interruption.heed()
            busy = {worker.pipe: worker for worker in workers if worker.tasks}
            if not busy:
                return
            for pipe in connection.wait(busy, timeout=_LOOK_S):
                interruption.keep()
                worker = busy[pipe]  # type: ignore[index]
                task, losses = worker.tasks.popleft()
                try:
                    good, value = worker.pipe.recv()
                except (EOFError, OSError):
                    workers.remove(worker)
                    worker.process.join()
                    # What waited in its pipe nobody has begun with.
                    again.extend(worker.tasks)
                    if sender is not None and losses + 1 < attempts:
                        again.append((task, losses + 1))
                    else:
                        take(task, _raise_lost)
                else:
                    now = clock.monotonic()
                    worker.since, worker.took = now, now - worker.since
                    take(task, partial(_result, good, value))
                interruption.heed()
            interruption.check()

    with _logged_here(context) as sender:
        try:
            try:
                collect(sender)
            except KeyboardInterrupt:
                interruption.answered()
                stop.value = 1
                collect(None)
                return True
        except BaseException:
            # A result that cannot be saved, or a second Ctrl-C: nobody waits for the others.
            for worker in workers:
                worker.process.kill()
            raise
        finally:
            for worker in workers:
                worker.pipe.close()
            for worker in workers:
                worker.process.join()
    return False


def _raise_lost() -> NoReturn:
    raise WorkerLost


def _result(good: bool, value: Any) -> Any:
    if not good:
        raise value
    return value


def _serve(work: Callable[[Any, Progress], Any], pipe: Connection, stop: Any, sender: Connection, level: int) -> None:
    """In a worker: tasks in, results out, until the parent closes the pipe."""
    # A terminal or a service manager sends these to every process of a group: only the parent heeds them.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_memory()
    garbage.look_rarely()
    garbage.keep_all()
    library = logging.getLogger("dynsim")
    library.setLevel(level)
    library.addHandler(_ToParent(sender))

    def look(time: float, stage: str = "") -> None:
        # Where Ctrl-C would have stopped it in the parent, with what there is.
        if stop.value:
            raise KeyboardInterrupt

    tasks: SimpleQueue[tuple[Any] | None] = SimpleQueue()
    # Read at once: else the parent could wait to send a task, and this process to send an answer, both for ever.
    threading.Thread(target=_read, args=(pipe, tasks), daemon=True).start()
    with suppress(OSError):
        while (got := tasks.get()) is not None:
            answer: tuple[bool, Any]
            try:
                answer = (True, None if stop.value else work(got[0], look))
            except Exception as error:
                error.add_note("".join(traceback.format_exception(error)))
                answer = (False, error)
            pipe.send(answer)


def _read(pipe: Connection, tasks: SimpleQueue[tuple[Any] | None]) -> None:
    """Tasks as they come, None when there are no more."""
    try:
        with suppress(EOFError, OSError):
            while True:
                tasks.put((pipe.recv(),))
    finally:
        tasks.put(None)


@cache
def keep_memory() -> None:
    """Let this process keep the memory of a run for the next one: fresh pages for each cost a tenth of it.

    By glibc's ``mallopt``, see its manual: M_MMAP_THRESHOLD and M_TRIM_THRESHOLD. Other systems do as they do.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(-3, 32 << 20)
        library.mallopt(-1, 512 << 20)


def _heard_from() -> int:
    """Level from which on anybody hears what is logged here: workers need not even make other messages."""
    library = logging.getLogger("dynsim")
    asked: logging.Logger | None = library
    while asked is not None:
        if any(not isinstance(handler, logging.NullHandler) for handler in asked.handlers):
            return library.getEffectiveLevel()
        asked = asked.parent if asked.propagate else None
    return logging.CRITICAL + 1


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
def signals_held() -> Iterator[None]:
    """Processes started here do not get the Ctrl-C of the terminal, not even while they start; this one gets it after.

    Only the parent reacts to it, wherever it was sent, and tells the workers. So with the other ``STOP_SIGNALS``.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Python's own helper lets them through again when it is started: not within.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """In a worker: wait until the parent is gone, however it ended, and end too; nobody waits for the result."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
