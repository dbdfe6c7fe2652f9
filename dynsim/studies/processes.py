"""Work in processes: every result as it comes, Ctrl-C lets the workers hand back what they have, a killed one costs
only the task that it had in hand, and so does one that gives no sign of life.
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

from dynsim.system import garbage, interruption
from dynsim.system.interruption import STOP_SIGNALS

if TYPE_CHECKING:
    from dynsim.engine import Progress  # numba, which not every work needs

Task = TypeVar("Task")
Result = TypeVar("Result")

# Between two looks for a signal that was lost, and between two signs of life of a worker [s].
_LOOK_S = 0.5
# A worker that gives none for so long is given up [s]. A thread of it gives them, so that they say nothing of how long
# its work takes: they end where the process is stopped, or compiled code holds the interpreter's lock for good.
SILENT_S, START_S = 60.0, 600.0
SILENT = f"its process gave no sign of life for {SILENT_S:g} s and was ended"
# So long a worker may take to hear of Ctrl-C; one that has heard may take any time to hand back what it has [s].
_PATIENCE_S = 0.7
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


class WorkerSilent(WorkerLost):
    """It gave no sign of life any more, and was ended here."""


class WorkerInterrupted(WorkerLost):
    """It was ended here, because it did not hear of Ctrl-C in what it had just begun with."""


# Places of ``life``.
_SIGNS, _HEARD = 0, 1


@dataclass
class _Worker:
    """A process and this end of its pipe.

    Attributes
    ----------
    tasks : what it has, each with how many processes have lost it: the first in hand, the others wait in the pipe
    since : when it began with the first
    took : how long the last one took [s]
    life : signs of life so far, and 1 where it has heard of Ctrl-C; shared with the process
    signs, silent : of ``life`` at the last look, and for how long there were no more [s]
    """

    process: Any
    pipe: Connection
    life: Any
    tasks: deque[tuple[Any, int]] = field(default_factory=deque)
    since: float = 0.0
    took: float = math.inf
    signs: int = 0
    silent: float = 0.0

    def is_silent(self, passed: float) -> bool:
        """Look for signs of life, so long [s] after the last look; True when there were none for too long."""
        self.silent = self.silent + passed if self.life[_SIGNS] == self.signs else 0.0
        self.signs = self.life[_SIGNS]
        return self.silent > (SILENT_S if self.signs > 0 else START_S)

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
        :class:`WorkerLost`; None for a task that Ctrl-C came before, and no call for those that nobody had then. A task
        whose process was silent is given up at once
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
        with signals_held():
            life = context.RawArray("q", 2)
            process = context.Process(target=_serve, args=(work, there, stop, life, sender, _heard_from()))
            process.start()
        there.close()
        return _Worker(process, here, life)

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

    def dismiss(worker: _Worker) -> None:
        """It is gone, or will be; what waited in its pipe nobody has begun with."""
        workers.remove(worker)
        worker.process.join()
        again.extend(worker.tasks)
        worker.tasks.clear()

    def end(worker: _Worker, answer: Callable[[], Any]) -> None:
        """End a worker that will not answer; ``answer`` in its stead."""
        worker.process.kill()
        task, _ = worker.tasks.popleft()
        dismiss(worker)
        take(task, answer)

    def collect(sender: Connection | None) -> None:
        """Take results until there are none to come; new tasks are only handed out with a ``sender``.

        Without one the workers are to stop: who has not heard of it in time is ended.
        """
        begun = looked = clock.monotonic()
        while True:
            if sender is not None:
                interruption.keep()
                hand_out(sender)
                interruption.heed()
            busy = {worker.pipe: worker for worker in workers if worker.tasks}
            if not busy:
                return
            for pipe in connection.wait(busy, timeout=_LOOK_S if sender is not None else 0.1):
                interruption.keep()
                worker = busy[pipe]  # type: ignore[index]
                task, losses = worker.tasks.popleft()
                try:
                    good, value, leaves = worker.pipe.recv()
                except (EOFError, OSError):
                    dismiss(worker)
                    if sender is not None and losses + 1 < attempts:
                        again.append((task, losses + 1))
                    else:
                        take(task, _raise_lost)
                else:
                    now = clock.monotonic()
                    worker.since, worker.took, worker.silent = now, now - worker.since, 0.0
                    if leaves:
                        dismiss(worker)
                    take(task, partial(_result, good, value))
                interruption.heed()
            interruption.check()
            # A process that was stopped for a while, as by Ctrl-Z, has not looked either.
            passed, looked = min(clock.monotonic() - looked, 2.0 * _LOOK_S), clock.monotonic()
            interruption.keep()
            for worker in [worker for worker in workers if worker.tasks]:
                if worker.is_silent(passed):
                    end(worker, _raise_silent)
                elif sender is None and not worker.life[_HEARD] and looked - begun > _PATIENCE_S:
                    end(worker, _raise_interrupted)
            interruption.heed()

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


def _raise_silent() -> NoReturn:
    raise WorkerSilent


def _raise_interrupted() -> NoReturn:
    raise WorkerInterrupted


def _result(good: bool, value: Any) -> Any:
    if not good:
        raise value
    return value


def _serve(
    work: Callable[[Any, Progress], Any], pipe: Connection, stop: Any, life: Any, sender: Connection, level: int
) -> None:
    """In a worker: tasks in, results out, until the parent closes the pipe."""
    # A terminal or a service manager sends these to every process of a group: only the parent heeds them.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threading.Thread(target=_give_signs, args=(stop, life), daemon=True).start()
    keep_memory()
    garbage.look_rarely()
    garbage.keep_all()
    library = logging.getLogger("dynsim")
    library.setLevel(level)
    library.addHandler(_ToParent(sender))

    def look(time: float, stage: str = "") -> None:
        # Where Ctrl-C would have stopped it in the parent, with what there is.
        if stop.value:
            life[_HEARD] = 1
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
            leaves = interruption.is_left()
            pipe.send((*answer, leaves))
            if leaves:
                # For good: the thread that it cannot end would take the time of others.
                os._exit(0)


def _give_signs(stop: Any, life: Any) -> None:
    """In a worker, for as long as it lives: signs of that. A result that is being made is handed back too."""
    while True:
        life[_SIGNS] += 1
        if stop.value and interruption.is_kept():
            life[_HEARD] = 1
        clock.sleep(_LOOK_S if not stop.value else 0.05)


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
