"""Output calls of dynsim (files, terminal, pipes), found while it runs, and made to fail one at a time."""

from __future__ import annotations

import builtins
import contextlib
import io
import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import pytest
from rich.console import Console

import dynsim
from dynsim.hardware.replay import output, session
from dynsim.hardware.replay.machine import Loop, Replay
from dynsim.hardware.replay.output import Background, Journal

PACKAGE = str(Path(dynsim.__file__).parent)
OS_CALLS = ("open", "write", "fsync", "replace", "rename", "mkdir", "unlink", "close", "fdopen", "scandir", "readlink")
STREAM_CALLS = ("write", "flush", "close", "seek", "truncate", "fileno")
BEFORE, LEFT, AFTER = "BEFORE", "LEFT", "AFTER"
"""Before the replay begins, once the robot has been left, and when the replay is over."""


ERRORS: dict[str, Exception] = {
    "Thread.start": RuntimeError("can't start new thread"),
    "h5py.File": MemoryError(),
    "stream.close": OSError(5, "Input/output error"),
}
"""Errors of calls that fail otherwise than by a full disk."""


@dataclass(frozen=True)
class Call:
    """One call of the operating system or of a library, and where in a replay it happened.

    ``place`` is the innermost function of dynsim that led to it, ``looping``: on the thread of the loop.
    """

    what: str
    place: str
    state: str
    looping: bool


@dataclass
class Outputs:
    """Watches all calls; from the first one equal to ``failing`` on, those of its kind and place fail."""

    failing: Call | None = None
    seen: dict[Call, None] = field(default_factory=dict)
    state: str = BEFORE
    failed: int = 0
    _owner: threading.Thread = field(default_factory=threading.current_thread)
    _inside: threading.local = field(default_factory=threading.local)

    def passed(self, operation: str) -> None:
        """A call is about to be made."""
        frame = sys._getframe(1)
        while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
            frame = frame.f_back
        if frame is None:
            return
        code = frame.f_code
        location = f"{Path(code.co_filename).name}:{code.co_qualname if sys.version_info >= (3, 11) else code.co_name}"
        call = Call(operation, location, self.state, threading.current_thread() is self._owner)
        self.seen[call] = None
        wanted = self.failing
        if wanted and (operation, location) == (wanted.what, wanted.place) and (self.failed or call == wanted):
            self.failed += 1
            raise ERRORS.get(operation, OSError(28, "No space left on device"))


class Stream:
    """A file whose calls are watched."""

    def __init__(self, outputs: Outputs, stream: Any) -> None:
        self._outputs, self._stream = outputs, stream

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._stream, name)
        if name not in STREAM_CALLS:
            return method

        def call(*arguments: Any) -> Any:
            try:
                self._outputs.passed(f"stream.{name}")
            except OSError:
                if name == "close":
                    self._stream.close()  # as the system does: it says that it failed, and has closed
                raise
            return method(*arguments)

        return call

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def __iter__(self) -> Iterator[Any]:
        return iter(self._stream)


@contextlib.contextmanager
def watched(outputs: Outputs) -> Iterator[Console]:
    """Within the block all calls are watched; gives a console on a watched terminal.

    Whenever a replay enters a state, and a few cycles later, it waits until its threads have had their turn: so all
    their calls happen in every state.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in OS_CALLS:
            patch.setattr(os, name, _watched(outputs, f"os.{name}", getattr(os, name), wrap=name == "fdopen"))
        opened = _watched(outputs, "open", io.open, wrap=True)
        patch.setattr(io, "open", opened)
        patch.setattr(builtins, "open", opened)
        patch.setattr(h5py, "File", _watched(outputs, "h5py.File", h5py.File))
        patch.setattr(threading.Thread, "start", _watched(outputs, "Thread.start", threading.Thread.start))
        patch.setattr(session, "INTERVAL", 0.001)
        patch.setattr(output, "DRAWING_INTERVAL", 0.001)
        _take_turns(outputs, patch)
        yield Console(file=Stream(outputs, io.StringIO()), force_terminal=True, width=100)  # type: ignore[arg-type]


def _watched(outputs: Outputs, operation: str, call: Any, *, wrap: bool = False) -> Any:
    def passed(*arguments: Any, **options: Any) -> Any:
        outputs.passed(operation)
        result = call(*arguments, **options)
        return Stream(outputs, result) if wrap else result

    return passed


def _take_turns(outputs: Outputs, patch: pytest.MonkeyPatch) -> None:
    turns: dict[Background, int] = {}
    make, each = Background.__init__, Background._each
    enter, exchange = Journal.enter, Loop.exchange
    log_end, run = Replay._log_end, Replay.run

    def made(self: Background, *arguments: Any) -> None:
        turns[self] = 0
        make(self, *arguments)

    def counted(self: Background, method: str) -> None:
        each(self, method)
        turns[self] += 1

    def wait() -> None:
        for background, count in dict(turns).items():
            end = time.monotonic() + 5.0
            while turns[background] < count + 2 and background._thread.is_alive() and time.monotonic() < end:
                background.wake()
                time.sleep(0)

    cycles = 0

    def entered(self: Journal, state: Any) -> None:
        nonlocal cycles
        cycles = 0
        wait()
        outputs.state = state.name
        enter(self, state)
        wait()

    def exchanged(self: Loop, *arguments: Any, **options: Any) -> Any:
        nonlocal cycles
        cycles += 1
        result = exchange(self, *arguments, **options)
        if cycles in (3, 6):
            wait()
        return result

    def left(self: Replay) -> None:
        wait()
        outputs.state = LEFT
        log_end(self)
        wait()

    def finished(self: Replay) -> Any:
        try:
            return run(self)
        finally:
            wait()
            outputs.state = AFTER

    patch.setattr(Background, "__init__", made)
    patch.setattr(Background, "_each", counted)
    patch.setattr(Journal, "enter", entered)
    patch.setattr(Loop, "exchange", exchanged)
    patch.setattr(Replay, "_log_end", left)
    patch.setattr(Replay, "run", finished)
