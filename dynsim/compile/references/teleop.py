"""Velocity commands from an operator for the hand and the mobile base: sources, scripts, and reference options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.model.description import Contact

Array = NDArray[np.float64]

# Components of a velocity: hand along x, y, z [m/s]; base forward [m/s] and about z [rad/s].
HAND, BASE = slice(0, 3), slice(3, 5)
VELOCITIES = 5


class VelocitySource(Protocol):
    """Velocity commands of a live operator or a script."""

    def read(self, tick: int) -> Array:
        """Return the velocities from a tick to the next, (5,): see ``HAND`` and ``BASE``."""
        ...


@dataclass(frozen=True)
class VelocityScript:
    """Piecewise constant velocities.

    Attributes
    ----------
    ticks : (K,) ndarray of int
        Start ticks, not decreasing.
    velocity : (K, 5) ndarray
        Velocities from these ticks on [m/s, rad/s].
    """

    ticks: NDArray[np.int64]
    velocity: Array

    def read(self, tick: int) -> Array:
        """Return the velocity that applies at ``tick``, shape (5,); zeros before the first entry."""
        k = int(np.searchsorted(self.ticks, tick, side="right")) - 1
        return self.velocity[k] if k >= 0 else np.zeros(VELOCITIES)


@dataclass(frozen=True)
class TeleopOptions:
    """Motions that an operator controls, and their limits.

    Attributes
    ----------
    rate : float
        Tick rate [1/s].
    joints : sequence of str
        Joints that follow the hand velocity.
    braces : sequence of Contact
        Contact points that these joints keep on their surfaces.
    rate_limit : float
        Maximum joint rate [rad/s or m/s].
    acceleration_limit : float
        Maximum joint acceleration [rad/s² or m/s²].
    hand_acceleration : float
        Maximum hand acceleration [m/s²].
    base_acceleration : (float, float)
        Maximum acceleration of the base, forward and about z [m/s², rad/s²].
    tolerance : float
        Distance from its target at which the hand counts as there [m].
    script : VelocityScript
        Velocities set in the scenario.
    """

    rate: float
    joints: Sequence[str]
    braces: Sequence[Contact]
    rate_limit: float
    acceleration_limit: float
    hand_acceleration: float
    base_acceleration: tuple[float, float]
    tolerance: float
    script: VelocityScript
