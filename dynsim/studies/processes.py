"""Pool of worker processes that returns results in the order of completion and handles Ctrl-C and lost workers.

A worker is a new Python process. The parent sends it pickled tasks on its standard input and reads pickled messages
from its standard output. A worker ends when its standard input ends, so it never outlives the parent. Workers are kept
for the next call, because the start of a worker takes as long as a hundred short runs.

The pools of Python and loky are not sufficient. ``multiprocessing`` runs the script of the caller again in every
worker, and imports a ``signal.py`` of the working directory before that. In ``concurrent.futures`` and loky, the death
of one worker fails all pending tasks. ``multiprocessing.Pool`` never returns the task of a worker that died. None of
them lets runs return their partial results on Ctrl-C.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import io
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time as clock
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

from dynsim.errors import DynsimError, SimulationInterrupted
from dynsim.system import interruption
from dynsim.system.interruption import STOP_SIGNALS

if TYPE_CHECKING:
    from dynsim.engine import Progress  # imports numba, which some work does not need

Task = TypeVar("Task")
Result = TypeVar("Result")

# Number of workers in a row that may die during their start before the pool gives up: the first and three more.
STARTS = 4
# After Ctrl-C, a worker checks this many times, at this interval [s], whether its work reacts. If it does not, the
# worker ends. The worker counts the checks itself, so that no result is lost if the machine is busy.
_CHECKS, _CHECK_S = 14, 0.05
# Maximum time until a worker must report that its work reacts to Ctrl-C [s]; needed if the process is suspended.
_STALLED_S = 10.0
# Interval at which the parent checks for signals, and maximum waiting time for the end of a process and of its threads
# [s].
_SIGNAL_S, _JOIN_S = 0.1, 0.7
# Number of lines of a worker's stderr that are reported if it cannot start.
_LAST_LINES = 12
# The parent starts a worker for each ALONE_S of remaining work [s of processor time]. The start of a worker takes about
# one second of time and of processor time; with less work, it would save less time than it costs processor time. The
# parent leaves a task to the workers after HERE_S of processor time, or STUCK_S.
ALONE_S, HERE_S, STUCK_S = 3.0, 0.5, 5.0
# Number of tasks that a worker has if the parent works too: it gets the next one while the parent is busy.
_AHEAD = 2
# Time after which unused workers end [s].
IDLE_S = 60.0
# Options of glibc (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD) with which a process reuses the memory of one run for the next,
# because new pages cost up to a seventh of the time of each run.
_MEMORY = {-3: 32 << 20, -1: 512 << 20}

# Program of a worker. Only the worker itself uses the pipes; output of its tasks goes to stderr. The first message
# contains the folders in which Python searches for dynsim. Garbage collection begins after the first task, because it
# would take an eighth of the start, and free nothing.
START = """
import gc, os, pickle, sys
gc.disable()
tasks, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
os.dup2(2, 1)
sys.path[:] = pickle.load(tasks)
from dynsim.studies.processes import serve
serve(tasks, answers)
"""


class WorkerError(DynsimError):
    """Raised if a process cannot be started, or if a task or its result cannot be sent between processes."""


class WorkerLost(Exception):
    """Raised if the worker process of a task ended; the message is a clause that begins with ``its process``."""

    def __init__(self, how: str = "its process was killed from outside; if memory is short, use fewer jobs") -> None:
        super().__init__(how)


class WorkerInterrupted(WorkerLost):
    """Raised if the worker process ended after Ctrl-C without a result, because its work did not react."""


class _TooLong(BaseException):
    """Raised in work of the parent that a worker will repeat, because the parent must remain responsive."""


def reuse_memory() -> None:
    """Let this process reuse freed memory, if its C library is glibc."""
    with suppress(AttributeError, OSError, TypeError):
        for option, size in _MEMORY.items():
            ctypes.CDLL(None).mallopt(option, size)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def signals_held() -> Iterator[None]:
    """Shield processes started in the block from Ctrl-C in the terminal; this process receives it after the block.

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


def run_in_processes(
    work: Callable[[Task, Progress], Result],
    tasks: Iterable[Task],
    jobs: int,
    take: Callable[[Task, Callable[[], Result]], None],
    *,
    attempts: int = 1,
    here: Callable[[Task], Progress | None] | None = None,
) -> bool:
    """Call ``work(task, look)`` for every task, in several processes.

    With ``here``, this process works too as long as its tasks are short, and starts other processes only if much work
    remains. A task that takes longer than ``HERE_S`` is repeated by a worker, unless ``jobs`` is 1; from then on, this
    process only distributes the tasks.

    Parameters
    ----------
    work : callable
        Function of an importable module. It must often call ``look``, which raises KeyboardInterrupt to stop the work.
    tasks : iterable
        Tasks, which are sent to the processes one at a time as processes become free.
    jobs : int
        Number of processes, including this process while it works.
    take : callable
        Called in this process with each task and a function that returns its result, or raises the exception of the
        work or :class:`WorkerLost`. The result is None if Ctrl-C was pressed before the task began. ``take`` is not
        called for tasks that had not been sent to a process when Ctrl-C was pressed.
    attempts : int, optional
        Number of processes that may die during a task before it is given up.
    here : callable, optional
        Returns the progress function of a task, or None, for tasks in this process; default: only workers work.

    Returns
    -------
    bool
        True if Ctrl-C made the workers stop early.

    Raises
    ------
    WorkerError
        If a task cannot be sent to a process, or if no process can start, because ``STARTS`` processes in a row die
        while they start.
    KeyboardInterrupt
        On a second Ctrl-C; the processes are killed.
    """
    if here is not None:
        reuse_memory()
    staff = _staff()
    pool = _Pool(staff, work, tasks, jobs, take, attempts, here)
    done = False
    try:
        try:
            pool.collect()
            done = True
        except KeyboardInterrupt:
            interruption.answered()
            pool.stop()
            pool.collect()
    finally:
        interruption.heed()
        if done and staff.workers:
            _kept.append(staff)
        else:
            staff.end()
    return not done


@dataclass(frozen=True)
class _Staff:
    """Workers, their inbox, the surroundings in which they were started, and the time of the first start [s]."""

    surroundings: tuple[Any, ...] = field(default_factory=lambda: _surroundings())
    started: float = field(default_factory=clock.time)
    workers: list[_Worker] = field(default_factory=list)
    inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]] = field(default_factory=SimpleQueue)

    def is_current(self) -> bool:
        """Return whether new workers would have the same environment, working directory and modules."""
        return self.surroundings == _surroundings() and all(map(self._is_unchanged, list(sys.modules.values())))

    def _is_unchanged(self, module: Any) -> bool:
        try:
            return os.stat(module.__file__).st_mtime < self.started
        except (AttributeError, TypeError, OSError):  # a module without a file
            return True

    def end(self) -> None:
        """Kill all workers."""
        for worker in self.workers:
            worker.process.kill()
        for worker in self.workers:
            worker.end()


# Staff that waits for the next call. Workers of two calls at the same time belong to different staff.
_kept: list[_Staff] = []


def _surroundings() -> tuple[Any, ...]:
    with suppress(FileNotFoundError):
        return os.getcwd(), dict(os.environ), sys.executable, START
    return dict(os.environ), sys.executable, START


def _staff() -> _Staff:
    """Return workers that wait for the next call, or a staff without workers."""
    with suppress(IndexError):
        staff = _kept.pop()
        if staff.is_current():
            return staff
        staff.end()
    return _Staff()


@atexit.register
def end_workers() -> None:
    """End the workers that wait for the next call."""
    while _kept:
        _kept.pop().end()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_kept.clear)


class _Worker:
    """Worker process, and the threads that use its pipes, so that the main thread never waits for a pipe.

    One thread sends messages from ``outbox`` until it finds an empty one. Another thread puts the messages of the
    worker into the inbox of the pool, followed by None. ``tasks`` are the task in progress and the tasks that were sent
    in advance, each with the number of processes that have died during it; ``confirmed`` is True if the work has
    reacted to Ctrl-C.
    """

    def __init__(self, inbox: SimpleQueue[tuple[_Worker, tuple[Any, ...] | None]]) -> None:
        if not sys.executable:
            raise WorkerError("no Python interpreter found to start worker processes; use jobs=1")
        try:
            with signals_held():
                self.process = subprocess.Popen(
                    [sys.executable, "-u", "-P", "-c", START],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                )  # fmt: skip
        except OSError as error:
            raise WorkerError(f"cannot start a worker process ({error}); use fewer jobs") from error
        from dynsim.record.isolated import search_path  # imports numpy, which not all work needs

        self.tasks = deque[tuple[Any, int]]()
        self.ready = self.confirmed = False
        self._inbox, self.outbox = inbox, SimpleQueue[bytes]()
        self._lines = deque[str](maxlen=_LAST_LINES)
        self.outbox.put(pickle.dumps(search_path()))
        streams = self.process.stdin, self.process.stdout, self.process.stderr
        talks = zip((self._write, self._read, self._forward), streams, strict=True)
        self._threads = [threading.Thread(target=talk, args=(stream,), daemon=True) for talk, stream in talks]
        for thread in self._threads:
            thread.start()

    def _write(self, stream: BinaryIO) -> None:
        # If the process has ended, the thread that reads the answers notices it.
        with suppress(OSError), stream:
            while content := self.outbox.get():
                stream.write(content)
                stream.flush()

    def _read(self, stream: BinaryIO) -> None:
        # The last message may be incomplete if the process ends.
        with suppress(EOFError, OSError, pickle.UnpicklingError), stream:
            while True:
                self._inbox.put((self, pickle.load(stream)))
        self._inbox.put((self, None))

    def _forward(self, stream: BinaryIO) -> None:
        """Forward the worker's stderr; until the worker is ready, only keep its lines to report a failed start."""
        with suppress(OSError, ValueError), stream:
            for line in stream:
                self._lines.append(line.decode("utf-8", "replace").rstrip())
                if self.ready:
                    self.show()

    def show(self) -> None:
        """Print the lines of stderr that have not been printed yet."""
        with suppress(IndexError):
            while sys.stderr is not None:
                print(self._lines.popleft(), file=sys.stderr, flush=True)

    def end(self) -> None:
        """Kill the process, and wait until its threads have ended."""
        self.process.kill()
        self.process.wait()
        self.outbox.put(b"")
        # A child process of the worker may keep the worker's streams open.
        for thread in self._threads:
            thread.join(_JOIN_S)

    def failed_start(self) -> str:
        """Describe how the process ended before it was ready, with the last lines of its output."""
        code = self.process.returncode
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        output = "".join(f"\n  {line}" for line in self._lines) or " nothing"
        return f"a worker process {how} while starting; if memory is short, use fewer jobs; its output:{output}"


class _Pool:
    """Workers and their tasks, see :func:`run_in_processes`."""

    def __init__(
        self, staff: _Staff, work: Any, tasks: Iterable[Any], jobs: int, take: Any, attempts: int, here: Any
    ) -> None:
        self.workers: list[_Worker] = []
        self._staff, self._work, self._jobs, self._take, self._attempts = staff, work, jobs, take, attempts
        self._unused = [worker for worker in staff.workers if worker.process.poll() is None]
        # Tasks that no process has yet, each with the number of workers that have died during it.
        self._waiting = deque((task, 0) for task in tasks)
        self._failed_starts = 0
        self._stopped: float | None = None
        # Progress functions while this process works too, and the processor times of its tasks [s].
        self._here, self._spent = here, list[float]()

    def stop(self) -> None:
        """Request all workers to stop, and hand out no more tasks."""
        self._stopped = clock.monotonic()
        self._waiting.clear()
        for worker in self.workers:
            worker.outbox.put(pickle.dumps(None))

    def collect(self) -> None:
        """Send tasks and receive results until no more are expected.

        Signals are deferred while this process works, and are still deferred on return.
        """
        while True:
            interruption.keep()
            self._hand_out()
            if not self._waiting and not any(worker.tasks for worker in self.workers):
                return
            here = bool(self._waiting) and self._here is not None
            try:
                worker, message = self._staff.inbox.get(not here, _SIGNAL_S)
            except Empty:
                if here:
                    self._work_here()
            else:
                # A worker that was ended by this process may have left messages.
                if worker in self.workers:
                    self._handle(worker, message)
            if self._stopped is not None and clock.monotonic() > self._stopped + _STALLED_S:
                for worker in self.workers:
                    if not worker.confirmed:
                        worker.process.kill()
            interruption.heed()
            interruption.check()

    def _hand_out(self) -> None:
        """Send tasks to the workers that are ready, and provide workers for the waiting tasks."""
        ahead = 1 if self._here is None else _AHEAD
        for worker in self.workers:
            while self._waiting and worker.ready and len(worker.tasks) < ahead:
                content = packed(self._waiting[0][0])
                worker.tasks.append(self._waiting.popleft())
                worker.outbox.put(pickle.dumps(content))
        free = sum(not worker.tasks for worker in self.workers)
        wanted, most = len(self._waiting) - free, self._jobs
        if self._here is not None:
            # The first task also loads modules and kernels.
            each = sum(self._spent[1:]) / max(len(self._spent) - 1, 1)
            useful = int(each * len(self._waiting) / ALONE_S) - len(self.workers)
            wanted, most = min(wanted, max(useful, len(self._unused))), self._jobs - 1
        for _ in range(min(wanted, most - len(self.workers))):
            self._employ()

    def _employ(self) -> None:
        """Provide a worker: one that is not used, or a new one."""
        if self._unused:
            worker = self._unused.pop()
        else:
            worker = _Worker(self._staff.inbox)
            self._staff.workers.append(worker)
        worker.ready = False
        path = [folder for folder in sys.path if isinstance(folder, str)]
        worker.outbox.put(pickle.dumps((path, _log_level(), packed(self._work))))
        self.workers.append(worker)

    def _work_here(self) -> None:
        """Do a task in this process, unless it takes too long."""
        task, losses = self._waiting.popleft()
        report, worked, began = self._here(task), clock.process_time(), clock.monotonic()

        def look(time: float, stage: str = "") -> None:
            if report is not None:
                report(time, stage)
            long = clock.process_time() > worked + HERE_S or clock.monotonic() > began + STUCK_S
            if long and self._jobs > 1:
                raise _TooLong

        interruption.heed()
        try:
            result = partial(_returned, self._work(task, look))
        except _TooLong:
            self._here = None
            self._waiting.appendleft((task, losses))
            return
        except Exception as error:
            result = partial(_raised, error)
        interruption.keep()
        self._spent.append(clock.process_time() - worked)
        self._take(task, result)
        if isinstance(result.args[0], SimulationInterrupted):
            raise KeyboardInterrupt

    def _handle(self, worker: _Worker, message: tuple[Any, ...] | None) -> None:
        """Handle a message from a worker; the message is None at the end of its output."""
        match message:
            case ("ready",):
                worker.ready, self._failed_starts = True, 0
                worker.show()
            case ("confirmed",):
                worker.confirmed = True
            case ("log", name, level, text):
                logging.getLogger(name).log(level, "%s", text)
            case ("answer", good, content, leaves):
                task, _ = worker.tasks.popleft()
                if leaves:
                    self._dismiss(worker)
                self._take(task, partial(_result, good, content))
            case None:
                self._lose(worker)

    def _dismiss(self, worker: _Worker) -> None:
        """End a worker; other processes do the tasks that it has not begun."""
        self.workers.remove(worker)
        self._staff.workers.remove(worker)
        worker.end()
        if self._stopped is None:
            self._waiting.extendleft(reversed(worker.tasks))

    def _lose(self, worker: _Worker) -> None:
        with suppress(subprocess.TimeoutExpired):
            worker.process.wait(_JOIN_S)  # needed for the exit code, because the output ends slightly earlier
        begun = worker.tasks.popleft() if worker.tasks else None
        self._dismiss(worker)
        if begun is not None:
            task, losses = begun
            if self._stopped is None and losses + 1 < self._attempts:
                self._waiting.appendleft((task, losses + 1))
            else:
                lost = WorkerLost() if self._stopped is None else WorkerInterrupted()
                self._take(task, partial(_raised, lost))
        elif not worker.ready:
            self._failed_starts += 1
            if self._failed_starts == STARTS and self._stopped is None:
                raise WorkerError(worker.failed_start())


def _returned(value: Any) -> Any:
    return value


def _raised(error: Exception) -> Any:
    raise error


def _result(good: bool, content: bytes) -> Any:
    value = pickle.loads(content)
    if not good:
        raise value
    return value


def _log_level() -> int:
    """Return the lowest log level for which a handler exists; workers need not create messages below it."""
    library = logging.getLogger("dynsim")
    logger: logging.Logger | None = library
    while logger is not None:
        if any(not isinstance(handler, logging.NullHandler) for handler in logger.handlers):
            return library.getEffectiveLevel()
        logger = logger.parent if logger.propagate else None
    return logging.CRITICAL + 1


class _Pickler(pickle.Pickler):
    """Pickler that rejects objects defined in the script, because other processes do not run the script."""

    def reducer_override(self, value: Any) -> Any:
        if callable(value) and getattr(value, "__module__", None) == "__main__" and hasattr(value, "__qualname__"):
            raise WorkerError(
                f"{value.__qualname__} is defined in the script or notebook itself, which other processes do not run; "
                "move it to a module and import it, or use jobs=1"
            )
        return NotImplemented


def packed(value: Any) -> bytes:
    """Return a value as a pickle for another process.

    Raises
    ------
    WorkerError
        If a part of the value cannot be sent, or is defined in the module that this process runs as its script.
    """
    stream = io.BytesIO()
    try:
        _Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(value)
    except (pickle.PicklingError, TypeError, AttributeError, RecursionError) as error:
        raise WorkerError(f"cannot be sent to another process: {error}; use jobs=1") from error
    return stream.getvalue()


# The rest of this file runs in a worker.


class _LogToParent(logging.Handler):
    """Log handler that sends log messages to the parent."""

    def __init__(self, send: Callable[..., None]) -> None:
        super().__init__()
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        self._send("log", record.name, record.levelno, record.getMessage())


def serve(source: BinaryIO, sink: BinaryIO) -> None:
    """Process tasks until the parent ends this process or ends itself."""
    reuse_memory()
    # A terminal or a service manager sends these signals to every process of a group; only the parent handles them.
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    folders, tasks, writing = list(sys.path), SimpleQueue[Any](), threading.Lock()
    # ``reacted`` is cleared while a task is in progress that has not yet noticed a stop.
    stop, reacted = threading.Event(), threading.Event()
    reacted.set()

    def send(*message: Any) -> None:
        # If the parent has ended, the other thread will end this process.
        with suppress(OSError), writing:
            sink.write(pickle.dumps(message))
            sink.flush()

    def listen() -> None:
        with suppress(EOFError, OSError, pickle.UnpicklingError):
            while (task := pickle.load(source)) is not None:
                tasks.put(task)
            stop.set()
            for _ in range(_CHECKS):
                clock.sleep(_CHECK_S)
                if reacted.is_set() or interruption.is_kept():
                    send("confirmed")
                    source.read()  # returns when the parent has ended
                    break
        os._exit(0)

    def look(time: float, stage: str = "") -> None:
        # In the parent, Ctrl-C would stop the work here, with a partial result.
        if stop.is_set():
            reacted.set()
            raise KeyboardInterrupt

    library = logging.getLogger("dynsim")
    library.addHandler(_LogToParent(send))
    threading.Thread(target=listen, daemon=True).start()
    while True:
        try:
            task = tasks.get(timeout=IDLE_S)
        except Empty:
            os._exit(0)
        if isinstance(task, tuple):
            path, level, content = task
            # Tasks may need modules from the folder of the script. The imports of dynsim and of the work itself do not
            # use that folder.
            sys.path[:] = folders
            work: Callable[[Any, Any], Any] = pickle.loads(content)
            sys.path[:] = path
            library.setLevel(level)
            send("ready")
            continue
        reacted.clear()
        try:
            result = None if stop.is_set() else work(_unpacked(task), look)
            reacted.set()
            good, content = True, packed(result)
        except Exception as error:
            reacted.set()
            good, content = False, _packed_error(error)
        # If a thread of the work is still running, the parent ends this process, because the thread would slow down
        # other tasks.
        send("answer", good, content, interruption.is_left())
        if not gc.isenabled():
            gc.freeze()
            gc.enable()


def _unpacked(content: bytes) -> Any:
    try:
        return pickle.loads(content)
    except Exception as error:
        raise WorkerError(f"a task cannot be loaded in another process: {type(error).__name__}: {error}") from error


def _packed_error(error: Exception) -> bytes:
    error.add_note("".join(traceback.format_exception(error)))
    try:
        return packed(error)
    except WorkerError:
        return packed(WorkerError(f"{type(error).__name__}: {error}"))
