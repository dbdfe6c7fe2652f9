"""Worker process for :mod:`dynsim.studies.processes`: it carries out tasks until no more arrive.

Messages are a sequence of pickles: tasks on the standard input of the worker, answers on its standard output.
The multiprocessing module of Python would run the script of the caller again in every worker, and before it a
``signal.py`` in the working directory.
"""

from __future__ import annotations

import ctypes
import io
import logging
import os
import pickle
import platform
import signal
import sys
import threading
import time as clock
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from queue import SimpleQueue
from typing import Any, BinaryIO, NoReturn

from dynsim.errors import DynsimError
from dynsim.system import interruption

# Program of a new process. Only the worker itself uses the pipes; output of its tasks goes to stderr. The first message
# lists the folders in which Python searches for dynsim.
START = """
import os, pickle, sys
tasks, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
os.dup2(2, 1)
sys.path[:] = pickle.load(tasks)
from dynsim.studies.worker import serve
serve(tasks, answers)
"""

# Kinds of messages to and from a worker.
TASK, STOP = "task", "stop"
READY, ALIVE, CONFIRMED, LOG, ANSWER = "ready", "alive", "confirmed", "log", "answer"

# Interval of the heartbeats of a worker, and their shorter interval after a stop request [s].
LOOK_S, STOP_LOOK_S = 0.5, 0.05


class WorkerError(DynsimError):
    """A process cannot be started, or a task or its result cannot be sent between processes."""


def packed(value: Any) -> bytes:
    """Return a pickle of a value for another process.

    Raises
    ------
    WorkerError
        If a part of it cannot be sent, or is defined in the module that this process runs as its script.
    """
    stream = io.BytesIO()
    try:
        _Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(value)
    except (pickle.PicklingError, TypeError, AttributeError, RecursionError) as error:
        raise WorkerError(f"cannot be sent to another process: {error}; use jobs=1") from error
    return stream.getvalue()


def _unpacked(content: bytes) -> Any:
    try:
        return pickle.loads(content)
    except Exception as error:
        raise WorkerError(f"a task cannot be loaded in another process: {type(error).__name__}: {error}") from error


class _Pickler(pickle.Pickler):
    """Pickler that rejects objects defined in the script, because other processes do not run the script."""

    def reducer_override(self, value: Any) -> Any:
        if callable(value) and getattr(value, "__module__", None) == "__main__" and hasattr(value, "__qualname__"):
            raise WorkerError(
                f"{value.__qualname__} is defined in the script or notebook itself, which other processes do not run; "
                "move it to a module and import it, or use jobs=1"
            )
        return NotImplemented


class _Answers:
    """Messages to the parent; each is written in one piece, from any thread."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._lock = stream, threading.Lock()

    def send(self, *message: Any) -> None:
        """Send a message; ignore a closed pipe, because then :func:`_listen` ends this process."""
        content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        with suppress(OSError), self._lock:
            self._stream.write(content)
            self._stream.flush()


class _Log(logging.Handler):
    """Log handler that sends log messages to the parent."""

    def __init__(self, answers: _Answers) -> None:
        super().__init__()
        self._answers = answers

    def emit(self, record: logging.LogRecord) -> None:
        self._answers.send(LOG, record.name, record.levelno, record.getMessage())


@cache
def keep_memory() -> None:
    """Let this process reuse the memory of one run for the next; new pages would cost a tenth of each run.

    Sets M_MMAP_THRESHOLD and M_TRIM_THRESHOLD with the ``mallopt`` of glibc, see its manual; no effect without glibc.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(-3, 32 << 20)
        library.mallopt(-1, 512 << 20)


def serve(source: BinaryIO, sink: BinaryIO) -> None:
    """Do tasks until the parent ends."""
    # A terminal or a service manager sends these signals to every process of a group; only the parent handles them.
    for number in interruption.STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    answers, stop, tasks = _Answers(sink), threading.Event(), SimpleQueue[bytes]()
    path, level, content = pickle.load(source)
    work: Callable[[Any, Any], Any] = pickle.loads(content)
    # Tasks may need modules from the folder of the script. Imports of dynsim and of the work do not use it, see above.
    sys.path[:] = path
    keep_memory()
    library = logging.getLogger("dynsim")
    library.setLevel(level)
    library.addHandler(_Log(answers))
    answers.send(READY)
    threading.Thread(target=_listen, args=(source, tasks, stop), daemon=True).start()
    threading.Thread(target=_send_heartbeats, args=(answers, stop), daemon=True).start()

    def look(time: float, stage: str = "") -> None:
        # In the parent, Ctrl-C would stop the work here, with a partial result.
        if stop.is_set():
            answers.send(CONFIRMED)
            raise KeyboardInterrupt

    while True:
        task, leaves = tasks.get(), False
        good, content = True, packed(None)
        if not stop.is_set():
            try:
                content = packed(work(_unpacked(task), look))
            except Exception as error:
                good, content = False, _packed_error(error)
            leaves = interruption.is_left()
        answers.send(ANSWER, good, content, leaves)
        if leaves:
            # End the process: there is no other way to end the remaining thread, which would slow down other tasks.
            _end()


def _packed_error(error: Exception) -> bytes:
    error.add_note("".join(traceback.format_exception(error)))
    try:
        return packed(error)
    except WorkerError:
        return packed(WorkerError(f"{type(error).__name__}: {error}"))


def _listen(source: BinaryIO, tasks: SimpleQueue[bytes], stop: threading.Event) -> None:
    """Read messages as they arrive, so that the parent never waits to send one; end with the parent."""
    try:
        with suppress(EOFError, OSError, pickle.UnpicklingError):
            while True:
                kind, *content = pickle.load(source)
                if kind == STOP:
                    stop.set()
                else:
                    tasks.put(*content)
    finally:
        _end()


def _send_heartbeats(answers: _Answers, stop: threading.Event) -> None:
    """Send heartbeats as long as the process runs; confirm a stop also while a result is being computed."""
    while True:
        answers.send(CONFIRMED if stop.is_set() and interruption.is_kept() else ALIVE)
        if stop.is_set():
            clock.sleep(STOP_LOOK_S)
        else:
            stop.wait(LOOK_S)


def _end() -> NoReturn:
    """End the process immediately; only printed output needs to be flushed first."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(0)
