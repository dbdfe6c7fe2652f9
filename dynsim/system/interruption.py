"""Handling of interrupt signals: immediately, or later if a result is being computed or saved.

Python may raise KeyboardInterrupt at any point of a program. In a callback from the garbage collector the exception is
lost, in a callback from the compiler it crashes the process, and between the last step and the saving of a record it
would lose the record. Therefore each signal is also stored, and long computations check for it (:func:`check`). In a
callback from the compiler, and between :func:`keep` and :func:`heed`, a signal is postponed.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Callbacks in llvmlite through which LLVM reads and writes its cache of compiled code; they must not raise exceptions.
_OF_THE_COMPILER = ("_raw_object_cache_notify", "_raw_object_cache_getbuffer")

_pending = False
_kept = False
_left = False


def _compiler_waits(frame: FrameType | None) -> bool:
    """Return True if the frame is within a callback from the compiler."""
    while frame is not None:
        if frame.f_code.co_name in _OF_THE_COMPILER:
            return True
        frame = frame.f_back
    return False


@contextmanager
def handled() -> Iterator[list[int]]:
    """Raise KeyboardInterrupt for the ``STOP_SIGNALS`` within the block; yield the list of received signals.

    A signal may be postponed, as described at the top of this module. A signal that is ignored (``nohup``) or has
    another handler is left alone.
    """
    global _pending, _kept
    received: list[int] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        global _pending
        received.append(number)
        _pending = True
        if not (_kept or _compiler_waits(frame)):
            raise KeyboardInterrupt

    before = {}
    for number in STOP_SIGNALS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            before[number] = signal.signal(number, on_signal)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _pending = _kept = False


def exit_code(received: Sequence[int]) -> int:
    """Return the exit code after signals: 128 plus the number of the first; SIGINT (Ctrl-C) if the list is empty."""
    return 128 + (received[0] if received else signal.SIGINT)


def keep() -> None:
    """Postpone signals from here on, because a result is being computed or saved."""
    global _kept
    _kept = True


def heed() -> None:
    """Handle signals again; the next :func:`check` raises KeyboardInterrupt for a signal that was postponed."""
    global _kept
    _kept = False


def check() -> None:
    """Raise KeyboardInterrupt for a signal that was postponed or whose exception was lost."""
    if _pending:
        raise KeyboardInterrupt


def answered() -> None:
    """Mark the last signal as handled: :func:`check` no longer raises for it."""
    global _pending
    _pending = False


def is_kept() -> bool:
    """Return whether signals are postponed, because a result is being computed or saved."""
    return _kept


def leave() -> None:
    """Record that a thread of this process cannot be stopped; the process must exit without waiting for it."""
    global _left
    _left = True


def is_left() -> bool:
    """Return whether a thread of this process cannot be stopped, see :func:`leave`."""
    return _left
