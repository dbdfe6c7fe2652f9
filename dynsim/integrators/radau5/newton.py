"""What RADAU5 keeps from step to step: Jacobian, factors, stages."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.simd.system import FOUR, lane_workspace
from dynsim.dynamics.simd.tables import aligned
from dynsim.dynamics.tables import Workspace
from dynsim.jit.kernel import internal_kernel

# NewtonArrays.clock: step that the factors are of, that the stages are of, that the extrapolation is of [s];
# contraction of Newton's method, and what it says of the error of the last iterate; the error
# that the last one may have, per tolerance.
FACTORED, TRIED, KEPT, CONTRACTION, LEVER, CLOSE = 0, 1, 2, 3, 4, 5
NEWTON_CLOCK_SIZE = 6
# Without circuits nothing may damp what is left of it, and it adds up over the steps.
CLOSE_ENOUGH, CLOSE_UNDAMPED = 0.03, 0.003
# NewtonArrays.count, int: the Jacobian must be made anew; accepted steps when it was made, and when the stages were
# kept for extrapolation; there are such; Jacobians, factorisations, Newton iterations, steps in which they diverged;
# samples whose states are there and that are not recorded yet; columns of Jacobians, by which whoever listens sees that
# a large one comes on.
STALE, MADE_AT, SEEN, EXTRAPOLATES, JACOBIANS, FACTORS, ITERATIONS, DIVERGED, WAITING = 0, 1, 2, 3, 4, 5, 6, 7, 8
COLUMNS = 9
NEWTON_COUNT_SIZE = 10


class StageLanes(NamedTuple):
    """Room for right-hand sides that are evaluated four at a time."""

    ws: Workspace
    t: np.ndarray  # (4,)
    y: np.ndarray  # (m, 4)
    f: np.ndarray  # (m, 4)
    delta: np.ndarray  # (4,)
    output: np.ndarray  # (columns.size, 4), see dynsim.dynamics.state.OutputLayout


def stage_lanes(ws: Workspace, m: int, columns: int) -> StageLanes:
    """Allocate :class:`StageLanes` beside a workspace, whose rows are taken whenever the Jacobian is made anew."""
    return StageLanes(
        lane_workspace(ws, FOUR), aligned(4), aligned(m, 4), aligned(m, 4), aligned(4), aligned(columns, 4)
    )


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
    kept: np.ndarray  # (4, s) coefficients of the accepted stages' polynomial, and the error estimate of their step
    error: np.ndarray  # (s,) that of the step tried
    weight: np.ndarray  # (s,) 1 / tolerance
    one: np.ndarray  # (s,) right side and solution of the real system
    two: np.ndarray  # (s,) complex
    room_one: np.ndarray  # (2, s)
    room_two: np.ndarray  # (2, s) complex
    direct: np.ndarray  # (n, n, 4) inverses of both matrices, see dynsim.integrators.radau5.linear_systems
    crossed: np.ndarray  # (n, n, 4)
    over: np.ndarray  # (2, 4) 1/g
    circuit: np.ndarray  # (na, 2, 4) and 1/(g − ∂(di/dt)/∂i)
    x: np.ndarray  # (s, 4)
    room: np.ndarray  # (3, s, 4)
    clock: np.ndarray  # (NEWTON_CLOCK_SIZE,)
    count: np.ndarray  # (NEWTON_COUNT_SIZE,) int
    lanes: StageLanes | None = None  # None: right-hand sides one by one


def newton_arrays(n: int, na: int, circuits: int, tracked: int, m: int) -> NewtonArrays:
    """Allocate :class:`NewtonArrays`."""
    count = np.zeros(NEWTON_COUNT_SIZE, dtype=np.int64)
    count[STALE] = 1
    clock = np.zeros(NEWTON_CLOCK_SIZE)
    clock[CLOSE] = CLOSE_ENOUGH if circuits > 0 else CLOSE_UNDAMPED
    return NewtonArrays(
        along=np.zeros((2 * n + circuits, n)),
        linear=np.zeros((na, ka.BLOCK_SIZE)),
        real=np.zeros((n, n)),
        complex=np.zeros((n, n), dtype=np.complex128),
        pivot=np.zeros((2, n), dtype=np.int64),
        z=np.zeros((3, m)),
        w=np.zeros((3, tracked)),
        f=np.zeros((3, m)),
        kept=np.zeros((4, tracked)),
        error=np.zeros(tracked),
        weight=np.zeros(tracked),
        one=np.zeros(tracked),
        two=np.zeros(tracked, dtype=np.complex128),
        room_one=np.zeros((2, tracked)),
        room_two=np.zeros((2, tracked), dtype=np.complex128),
        direct=aligned(n, n, 4),
        crossed=aligned(n, n, 4),
        over=aligned(2, 4),
        circuit=aligned(na, 2, 4),
        x=aligned(tracked, 4),
        room=aligned(3, tracked, 4),
        clock=clock,
        count=count,
    )


@internal_kernel
def forget(newton: NewtonArrays | None, steps):
    """What was known of the right-hand side, when ``steps`` were accepted, is so no longer: it has jumped."""
    if newton is None:  # known to the compiler
        return
    newton.count[STALE], newton.count[SEEN], newton.count[EXTRAPOLATES] = 1, steps, 0
