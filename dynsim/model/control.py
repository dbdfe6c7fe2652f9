"""What a joint controller hands to the simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.kernels.arrays import ReferenceArrays
from dynsim.kernels.jit import integers, reals

# Samples in a segment of the reference splines, and segments that are looked at together.
_PER_SEGMENT = 4
_PIECE = 4096


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

    def positions(self, q: NDArray[np.float64], places: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.float64], ...]]:
        """Times, (T,) [s], and the joint positions, (T, nq), of the references, in pieces of some thousand samples.

        Taken at the knots and at three times between two of them.

        Parameters
        ----------
        q : (nq,) positions of all joints at the start; those without a moving reference stay there
        places : (na,) where in q the joint of each motor is
        """
        reference = self.reference
        begin, spacing = reference.grid
        segments, columns = len(reference.coefficients), reference.spline[reference.spline >= 0]
        moved = places[reference.spline >= 0]
        x = spacing * np.arange(_PER_SEGMENT + 1) / _PER_SEGMENT
        powers = x[:, None] ** np.arange(6)
        for first in range(0, segments, _PIECE):
            piece = reference.coefficients[first : first + _PIECE, columns]
            times = begin + spacing * np.arange(first, first + len(piece))[:, None] + x
            positions = np.tile(q, (times.size, 1))
            positions[:, moved] = np.einsum("scp,xp->sxc", piece, powers).reshape(times.size, len(columns))
            yield times.ravel(), positions

    def target(self, t: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Target of the hand at times t, (T, 3) [m]; None without a path."""
        return None if self.path is None else self.path.position(t)
