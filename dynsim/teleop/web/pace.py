"""Real time: ticks that begin when they are due, late rather than crowded."""

from __future__ import annotations

from collections.abc import Callable


class Pace:
    """Says when the next tick is due.

    A tick that begins late makes the later ones late: at most one of them follows without a pause, whatever is lost
    beyond that is lost, and the clock of the simulation falls behind that of the wall. So no motion is ever faster than
    it was asked for, and no pilot sees his commands in a burst.

    Attributes
    ----------
    late : of the tick that has begun last [s]; lost : wall time that the simulation did not follow [s]
    """

    def __init__(self, period: float, clock: Callable[[], float], wait: Callable[[float], object]) -> None:
        self._period, self._clock, self._wait = period, clock, wait
        self._due: float | None = None
        self.late = self.lost = 0.0

    def next(self) -> None:
        """Wait until the next tick is due."""
        now = self._clock()
        if self._due is None:
            self._due = now
        if now < self._due:
            self._wait(self._due - now)
            now = self._clock()
        self.late = max(now - self._due, 0.0)
        beyond = max(self.late - self._period, 0.0)
        self.lost += beyond
        self._due += self._period + beyond
