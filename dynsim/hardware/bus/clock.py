"""Clocks of a replay: their interface, wall time for serial ports, virtual time for servos in memory."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time."""

    def now(self) -> float:
        """Seconds since an arbitrary origin [s]."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` [s], at once if it has passed."""
        ...


class WallClock:
    """The computer's monotonic clock, from an ``origin`` of it on [s]."""

    def __init__(self, origin: float = 0.0) -> None:
        self._origin = origin

    def now(self) -> float:
        return time.monotonic() - self._origin

    def sleep_until(self, deadline: float) -> None:
        remaining = deadline - self.now()
        if remaining > 0:
            time.sleep(remaining)


class VirtualClock:
    """Time that passes only when somebody waits: a replay on it is deterministic and as fast as the computer allows."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, deadline)
