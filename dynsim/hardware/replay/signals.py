"""Signals of a replay: those that ask for a stop, and those that must not touch it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from dynsim.hardware.replay.states import StopRequest


def _there(*names: str) -> list[signal.Signals]:
    return [getattr(signal, name) for name in names if hasattr(signal, name)]


# Of these only the first counts. When a terminal is closed both the system and the shell send SIGHUP, and `timeout`
# sends SIGTERM to the process and to its group: nobody has asked twice, and a robot that is let go falls.
# The others would end the process, and leave a moving robot to its watchdogs.
_ONCE = _there(
    "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU",
    "SIGIO", "SIGPWR", "SIGSTKFLT",
)  # fmt: skip
# Of a terminal that the process may not write to or that is gone, and of a disk quota: the write fails, nothing else.
_PASSED_OVER = _there("SIGTTOU", "SIGTTIN", "SIGPIPE", "SIGXFSZ")


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Signals only count up ``stop``: an exception out of a handler would tear a bus transaction in two.

    Ctrl-C counts every time; SIGTERM, SIGHUP, SIGQUIT (Ctrl-\\), SIGTSTP (Ctrl-Z, which would leave a moving robot
    without goals) and all others by which a process ends ask for the controlled stop only. A SIGHUP
    that is ignored (``nohup``) stays so.
    """

    def ask_once(*_: Any) -> None:
        stop.count = max(stop.count, 1)

    handlers: dict[signal.Signals, Any] = {signal.SIGINT: stop}
    handlers |= dict.fromkeys(_ONCE, ask_once) | dict.fromkeys(_PASSED_OVER, signal.SIG_IGN)
    for number in _there("SIGHUP"):
        if signal.getsignal(number) == signal.SIG_IGN:
            del handlers[number]
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            # None: set by C code, which Python cannot give back.
            if handler is not None:
                signal.signal(number, handler)


def ignore_stops() -> None:
    """Of a process that ends when another one says so: the signals that ask that one for a stop mean nothing here."""
    for number in (signal.SIGINT, *_ONCE):
        signal.signal(number, signal.SIG_IGN)
