"""What RADAU5 keeps from step to step: Jacobian, factors, stages."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.kernels.arrays import BLOCK_SIZE
from dynsim.kernels.jit import internal_kernel

# NewtonArrays.clock: step that the factors are of, that the stages are of, that the extrapolation is of [s];
# contraction of Newton's method, and what it says of the error of the last iterate; the error
# that the last one may have, per tolerance.
FACTORED, TRIED, KEPT, CONTRACTION, LEVER, CLOSE = 0, 1, 2, 3, 4, 5
NEWTON_CLOCK_SIZE = 6
CLOSE_ENOUGH = 0.03
# NewtonArrays.count, int: the Jacobian must be made anew; accepted steps when it was made, and when the stages were
# kept for extrapolation; there are such; Jacobians, factorisations, Newton iterations, steps in which they diverged.
STALE, MADE_AT, SEEN, EXTRAPOLATES, JACOBIANS, FACTORS, ITERATIONS, DIVERGED = 0, 1, 2, 3, 4, 5, 6, 7
NEWTON_COUNT_SIZE = 8


class NewtonArrays(NamedTuple):
    """Room of RADAU5: n rates, na motors, k circuits, s entries of the state with a tolerance, m in all."""

    along: np.ndarray  # (2 n + k, n) ∂v̇/∂(θ, v, i), θ being displacements along the rates
    linear: np.ndarray  # (na, BLOCK_SIZE) linear blocks of the drives
    real: np.ndarray  # (n, n) factors of the real Newton matrix
    complex: np.ndarray  # (n, n) and of the complex one
    pivot: np.ndarray  # (2, n) int
    z: np.ndarray  # (3, m) stages of the step tried, from y on
    w: np.ndarray  # (3, s) the same, T⁻¹ z
    f: np.ndarray  # (3, m) derivatives at the stages
    kept: np.ndarray  # (3, s) coefficients of the accepted stages' polynomial
    weight: np.ndarray  # (s,) 1 / tolerance
    one: np.ndarray  # (s,) right side and solution of the real system
    two: np.ndarray  # (s,) complex
    room_one: np.ndarray  # (2, s)
    room_two: np.ndarray  # (2, s) complex
    clock: np.ndarray  # (NEWTON_CLOCK_SIZE,)
    count: np.ndarray  # (NEWTON_COUNT_SIZE,) int


def newton_arrays(n: int, na: int, circuits: int, tracked: int, m: int) -> NewtonArrays:
    """Allocate :class:`NewtonArrays`."""
    count = np.zeros(NEWTON_COUNT_SIZE, dtype=np.int64)
    count[STALE] = 1
    clock = np.zeros(NEWTON_CLOCK_SIZE)
    clock[CLOSE] = CLOSE_ENOUGH
    return NewtonArrays(
        along=np.zeros((2 * n + circuits, n)),
        linear=np.zeros((na, BLOCK_SIZE)),
        real=np.zeros((n, n)),
        complex=np.zeros((n, n), dtype=np.complex128),
        pivot=np.zeros((2, n), dtype=np.int64),
        z=np.zeros((3, m)),
        w=np.zeros((3, tracked)),
        f=np.zeros((3, m)),
        kept=np.zeros((3, tracked)),
        weight=np.zeros(tracked),
        one=np.zeros(tracked),
        two=np.zeros(tracked, dtype=np.complex128),
        room_one=np.zeros((2, tracked)),
        room_two=np.zeros((2, tracked), dtype=np.complex128),
        clock=clock,
        count=count,
    )


@internal_kernel
def forget(newton: NewtonArrays | None, steps):
    """What was known of the right-hand side, when ``steps`` were accepted, is so no longer: it has jumped."""
    if newton is None:  # known to the compiler
        return
    newton.count[STALE], newton.count[SEEN], newton.count[EXTRAPOLATES] = 1, steps, 0
