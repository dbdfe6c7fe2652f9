"""What a robot can be led along: anything with a posture at every time, and the move to where a path begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

QUINTIC_PEAK = 1.875
"""Top speed of :func:`quintic`, times its duration."""


class Motion(Protocol):
    """Something to follow, over its own time."""

    def at(self, time: float) -> tuple[Array, Array]:
        """Joint angles [rad] and their derivatives with respect to ``time``, shape (N,)."""
        ...


@dataclass(frozen=True)
class Approach:
    """Rest-to-rest move between two postures on a quintic, all joints in step.

    Attributes
    ----------
    start, goal : array, shape (N,)
        [rad].
    duration : float
        [s].
    """

    start: Array
    goal: Array
    duration: float

    def at(self, time: float) -> tuple[Array, Array]:
        fraction, rate = quintic(self.duration, time)
        return self.start + fraction * (self.goal - self.start), rate * (self.goal - self.start)


def quintic(duration: float, time: float) -> tuple[float, float]:
    """Fraction of a rest-to-rest move and its rate [1/s] at ``time`` [s]: s = 10u³ − 15u⁴ + 6u⁵, u = time/duration."""
    if duration <= 0:
        return 1.0, 0.0
    u = min(max(time / duration, 0.0), 1.0)
    return u**3 * (10 + u * (-15 + 6 * u)), 30 * u * u * (1 - u) ** 2 / duration
