"""Work in processes: every result as it comes, Ctrl-C lets the workers hand back what they have, a killed one costs
only the task that it had in hand.
"""

from __future__ import annotations

import itertools
import logging
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, get_context, parent_process
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from dynsim import interruption
from dynsim.interruption import STOP_SIGNALS

if TYPE_CHECKING:
    from dynsim.engine import Progress  # numba, which not every work needs

Task = TypeVar("Task")
Result = TypeVar("Result")

# Between two looks for a signal that was lost [s].
_LOOK_S = 0.5


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerLost(Exception):
    """The process that had a task was ended from outside."""


@dataclass
class _Worker:
    """A process, this end of its pipe, and what it has in hand: a task, and how many processes have lost that."""

    process: Any
    pipe: Connection
    task: Any = None
    losses: int = 0
    busy: bool = False


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
    tasks : sent to the processes one by one, as they come to have time
    jobs : processes
    take : called here with every task and a function that returns the result or raises what the work raised, or
        :class:`WorkerLost`; None for a task that Ctrl-C came before, and no call for those that nobody had then
    attempts : how many processes a task may lose before it is given up

    Returns
    -------
    bool
        True if Ctrl-C made the workers stop early.
    """
    # Spawned, not forked: the parent may hold threads and an open progress display.
    context = get_context("spawn")
    waiting = zip(tasks, itertools.repeat(0))
    workers: list[_Worker] = []
    # Tasks whose process was lost, and how often: they come before those that nobody has had.
    again: list[tuple[Task, int]] = []
    with _signals_held():
        # Without a lock, which a killed worker would leave closed.
        stop = context.RawValue("b", 0)

    def start(sender: Connection) -> _Worker:
        here, there = context.Pipe()
        arguments = (work, there, stop, sender, logging.getLogger("dynsim").getEffectiveLevel())
        with _signals_held():
            process = context.Process(target=_serve, args=arguments)
            process.start()
        there.close()
        return _Worker(process, here)

    def hand_out(sender: Connection) -> None:
        while True:
            worker = next((worker for worker in workers if not worker.busy), None)
            if worker is None and len(workers) == jobs:
                return
            task = again.pop() if again else next(waiting, None)
            if task is None:
                return
            if worker is None:
                worker = start(sender)
                workers.append(worker)
            (worker.task, worker.losses), worker.busy = task, True
            # A process that is gone shows when its answer is read.
            with suppress(OSError):
                worker.pipe.send(worker.task)

    def collect(sender: Connection | None) -> None:
        """Take results until there are none to come; new tasks are only handed out with a ``sender``."""
        while True:
            if sender is not None:
                interruption.keep()
                hand_out(sender)
                interruption.heed()
            busy = {worker.pipe: worker for worker in workers if worker.busy}
            if not busy:
                return
            for pipe in connection.wait(busy, timeout=_LOOK_S):
                interruption.keep()
                worker = busy[pipe]  # type: ignore[index]
                task = worker.task
                try:
                    good, value = worker.pipe.recv()
                except (EOFError, OSError):
                    workers.remove(worker)
                    worker.process.join()
                    if sender is not None and worker.losses + 1 < attempts:
                        again.append((task, worker.losses + 1))
                    else:
                        take(task, _raise_lost)
                else:
                    worker.task, worker.busy = None, False
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
    library = logging.getLogger("dynsim")
    library.setLevel(level)
    library.addHandler(_ToParent(sender))

    def look(time: float, stage: str = "") -> None:
        # Where Ctrl-C would have stopped it in the parent, with what there is.
        if stop.value:
            raise KeyboardInterrupt

    with suppress(EOFError, OSError):
        while True:
            task = pipe.recv()
            answer: tuple[bool, Any]
            try:
                answer = (True, None if stop.value else work(task, look))
            except Exception as error:
                error.add_note("".join(traceback.format_exception(error)))
                answer = (False, error)
            pipe.send(answer)


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
def _signals_held() -> Iterator[None]:
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


def _end_with_parent() -> None:
    """In a worker: wait until the parent is gone, however it ended, and end too; nobody waits for the result."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
