"""Velocities of hand and mobile base from an operator: their source, a script of them, options of the references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.model.description import Contact

Array = NDArray[np.float64]

# Within a velocity: of the hand along x, y, z [m/s]; of a base ahead [m/s] and about z [rad/s].
HAND, BASE = slice(0, 3), slice(3, 5)
VELOCITIES = 5


class VelocitySource(Protocol):
    """An operator, live or a script."""

    def read(self, tick: int) -> Array:
        """Velocities from a tick to the next, (5,): see ``HAND`` and ``BASE``."""
        ...


@dataclass(frozen=True)
class VelocityScript:
    """Velocities that hold from their ticks on, and none before the first.

    Attributes
    ----------
    ticks : (K,) increasing or equal; velocity : (K, 5) [m/s, rad/s]
    """

    ticks: NDArray[np.int64]
    velocity: Array

    def read(self, tick: int) -> Array:
        """The last one that has begun."""
        k = int(np.searchsorted(self.ticks, tick, side="right")) - 1
        return self.velocity[k] if k >= 0 else np.zeros(VELOCITIES)


@dataclass(frozen=True)
class TeleopOptions:
    """What an operator moves, and how.

    Attributes
    ----------
    rate : of the ticks [1/s]
    joints : names of those that follow the hand's velocity; braces : contact points that they keep on their surfaces
    rate_limit : fastest joint rate [rad/s or m/s]; acceleration_limit : fastest change of it [rad/s² or m/s²]
    hand_acceleration : of the hand [m/s²]; base_acceleration : of the base ahead and about z [m/s², rad/s²]
    tolerance : distance from its target at which the hand counts as there [m]
    script : velocities of the scenario
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
