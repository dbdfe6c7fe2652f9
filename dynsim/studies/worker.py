"""Worker process for :mod:`dynsim.studies.processes`: carries out tasks until there are no more.

Messages are pickles in sequence: tasks on the worker's standard input, answers on its standard output.
Python's own multiprocessing would run the caller's script once more in every worker, and before it a ``signal.py`` of
the working directory.
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

# Program of a new process. Only the worker uses the pipes: output of its tasks goes to stderr. The first message has
# the folders in which dynsim is searched for.
START = """
import os, pickle, sys
tasks, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
os.dup2(2, 1)
sys.path[:] = pickle.load(tasks)
from dynsim.studies.worker import serve
serve(tasks, answers)
"""

# Kinds of messages to a worker and from it.
TASK, STOP = "task", "stop"
READY, ALIVE, HEARD, LOG, ANSWER = "ready", "alive", "heard", "log", "answer"

# Between two signs of life of a worker, and between two looks for what is to be told when it shall stop [s].
LOOK_S, STOP_LOOK_S = 0.5, 0.05


class WorkerError(DynsimError):
    """No process can be started, or a task or its result cannot be sent from one to the other."""


def packed(value: Any) -> bytes:
    """A pickle for another process.

    Raises
    ------
    WorkerError
        Something in it cannot be sent, or is of the module that this process runs as its script.
    """
    stream = io.BytesIO()
    try:
        _Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(value)
    except (pickle.PicklingError, TypeError, AttributeError, RecursionError) as error:
        raise WorkerError(f"cannot be sent to or from another process: {error}; jobs=1 does without") from error
    return stream.getvalue()


def _unpacked(content: bytes) -> Any:
    try:
        return pickle.loads(content)
    except Exception as error:
        raise WorkerError(f"a task cannot be loaded in another process: {type(error).__name__}: {error}") from error


class _Pickler(pickle.Pickler):
    """Refuses what another process does not find: it does not run the script."""

    def reducer_override(self, value: Any) -> Any:
        if callable(value) and getattr(value, "__module__", None) == "__main__" and hasattr(value, "__qualname__"):
            raise WorkerError(
                f"{value.__qualname__} is defined in the script or notebook itself, which other processes do not run: "
                "put it into a module beside it and import it from there; or take jobs=1"
            )
        return NotImplemented


class _Answers:
    """Messages to the parent, each in one piece whatever thread it comes from."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._lock = stream, threading.Lock()

    def send(self, *message: Any) -> None:
        """Nobody reads any more: this process is ended by :func:`_listen`."""
        content = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
        with suppress(OSError), self._lock:
            self._stream.write(content)
            self._stream.flush()


class _Log(logging.Handler):
    """Hands what is logged to the parent."""

    def __init__(self, answers: _Answers) -> None:
        super().__init__()
        self._answers = answers

    def emit(self, record: logging.LogRecord) -> None:
        self._answers.send(LOG, record.name, record.levelno, record.getMessage())


@cache
def keep_memory() -> None:
    """Let this process keep the memory of a run for the next one: fresh pages for each cost a tenth of it.

    By glibc's ``mallopt``, see its manual: M_MMAP_THRESHOLD and M_TRIM_THRESHOLD. Other systems do as they do.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(-3, 32 << 20)
        library.mallopt(-1, 512 << 20)


def serve(source: BinaryIO, sink: BinaryIO) -> None:
    """Do tasks until there is nobody to send more."""
    # A terminal or a service manager sends these to every process of a group: only the parent heeds them.
    for number in interruption.STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    answers, stop, tasks = _Answers(sink), threading.Event(), SimpleQueue[bytes]()
    path, level, content = pickle.load(source)
    work: Callable[[Any, Any], Any] = pickle.loads(content)
    # Tasks may need modules beside the script. What dynsim and the work import is not looked for there: see above.
    sys.path[:] = path
    keep_memory()
    library = logging.getLogger("dynsim")
    library.setLevel(level)
    library.addHandler(_Log(answers))
    answers.send(READY)
    threading.Thread(target=_listen, args=(source, tasks, stop), daemon=True).start()
    threading.Thread(target=_give_signs, args=(answers, stop), daemon=True).start()

    def look(time: float, stage: str = "") -> None:
        # Where Ctrl-C would have stopped it in the parent, with what there is.
        if stop.is_set():
            answers.send(HEARD)
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
            # For good: the thread that it cannot end would take the time of others.
            _end()


def _packed_error(error: Exception) -> bytes:
    error.add_note("".join(traceback.format_exception(error)))
    try:
        return packed(error)
    except WorkerError:
        return packed(WorkerError(f"{type(error).__name__}: {error}"))


def _listen(source: BinaryIO, tasks: SimpleQueue[bytes], stop: threading.Event) -> None:
    """Messages as they come, so that the parent never waits to send one; without a parent nobody wants an answer."""
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


def _give_signs(answers: _Answers, stop: threading.Event) -> None:
    """Signs of life, for as long as it lives. A result that is being made is handed back too."""
    while True:
        answers.send(HEARD if stop.is_set() and interruption.is_kept() else ALIVE)
        if stop.is_set():
            clock.sleep(STOP_LOOK_S)
        else:
            stop.wait(LOOK_S)


def _end() -> NoReturn:
    """At once: there is nothing to be tidied up but what was printed."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(0)
