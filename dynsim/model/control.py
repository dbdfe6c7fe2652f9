"""What a joint controller hands to the simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.kernels.arrays import ReferenceArrays
from dynsim.kernels.jit import integers, reals


class HandPath(Protocol):
    """A path in space."""

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions at times t [s], shape (T,) → (T, 3) [m]."""


@dataclass(frozen=True)
class JointControl:
    """Gains of the voltage PD per motor [V/rad, V s/rad], joint references, and the path the hand is to follow."""

    k_p: NDArray[np.float64]
    k_d: NDArray[np.float64]
    reference: ReferenceArrays
    path: HandPath | None

    @classmethod
    def short_circuit(cls, motors: int) -> JointControl:
        """No controller: every motor has zero volts on its terminals, so it brakes."""
        reference = ReferenceArrays(
            spline=integers(np.full(motors, -1)),
            held=reals(np.zeros(motors)),
            grid=reals([0.0, 1.0]),
            coefficients=reals(np.zeros((1, 0, 6))),
        )
        return cls(np.zeros(motors), np.zeros(motors), reference, None)

    def target(self, t: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Target of the hand at times t, (T, 3) [m]; None without a path."""
        return None if self.path is None else self.path.position(t)
