"""Interrupt signals: handled at once, or postponed while a result is computed or saved.

Python raises KeyboardInterrupt at any point of a program. Within a callback of the garbage collector it is lost, within
a callback of the compiler it crashes the process, and between the last step and the saved record the record would be
lost. A signal is therefore also stored, long work checks for it (:func:`check`), and within a callback of the compiler,
and between :func:`keep` and :func:`heed`, it is postponed.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Callbacks of llvmlite by which LLVM reads and writes its cache of compiled code; exceptions in them are not handled.
_OF_THE_COMPILER = ("_raw_object_cache_notify", "_raw_object_cache_getbuffer")

_pending = False
_kept = False
_left = False


def _compiler_waits(frame: FrameType | None) -> bool:
    """True within a callback of the compiler."""
    while frame is not None:
        if frame.f_code.co_name in _OF_THE_COMPILER:
            return True
        frame = frame.f_back
    return False


@contextmanager
def handled() -> Iterator[list[int]]:
    """Let the ``STOP_SIGNALS`` raise KeyboardInterrupt within the block, see above; yield the list of received signals.

    A signal that is ignored (``nohup``) or has another handler is left alone.
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
    """Return the exit code of a process ended by signals: 128 plus the first signal; by default SIGINT (Ctrl-C)."""
    return 128 + (received[0] if received else signal.SIGINT)


def keep() -> None:
    """Postpone signals from here on, because a result is being computed or saved."""
    global _kept
    _kept = True


def heed() -> None:
    """Handle signals again; the next :func:`check` raises for a signal received in between."""
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
    """Record that a thread of this process cannot be ended and is not waited for: it ends with the process."""
    global _left
    _left = True


def is_left() -> bool:
    """Return whether there is such a thread."""
    return _left
