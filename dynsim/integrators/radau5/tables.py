"""Coefficients of RADAU5, and the data that it keeps between steps: Jacobian, factors, stages and counters."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.integrators.simd.forms import StageLanes, aligned
from dynsim.jit.kernel import internal_kernel

# Coefficients of Radau IIA of order 5 from Hairer and Wanner (Solving Ordinary Differential Equations II, IV.8). The
# diagonal blocks of T⁻¹ A⁻¹ T are γ and [[α, −β], [β, α]]. ERROR_RADAU: weights of the stages in h times the right-hand
# side of the error estimate.
_ROOT = math.sqrt(6.0)
A_RADAU = np.array(
    [
        [(88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225],
        [(296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225],
        [(16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9],
    ]
)
NODE_RADAU = np.array([(4 - _ROOT) / 10, (4 + _ROOT) / 10, 1.0])
GAMMA_RADAU, ALPHA_RADAU, BETA_RADAU = 3.6378342527444957, 2.6810828736277523, 3.0504301992474105
T_RADAU = np.array(
    [
        [9.1232394870892942792e-02, -0.14125529502095420843, -3.0029194105147424492e-02],
        [0.24171793270710701896, 0.20412935229379993199, 0.38294211275726193779],
        [0.96604818261509293619, 1.0, 0.0],
    ]
)
T_INVERSE_RADAU = np.array(
    [
        [4.3255798900631553510, 0.33919925181580986954, 0.54177053993587487119],
        [-4.1787185915519047273, -0.32768282076106238708, 0.47662355450055045196],
        [-0.50287263494578687595, 2.5719269498556054292, -0.59603920482822492497],
    ]
)
ERROR_RADAU = np.array([-(13 + 7 * _ROOT) / 3, (-13 + 7 * _ROOT) / 3, -1 / 3])

# NewtonArrays.clock: step sizes of the factors, the stages and the extrapolation [s]; contraction of Newton's method,
# and the resulting bound on the error of the last iterate; admissible error of the last iterate, relative to the
# tolerance; largest change of rates for the finite differences of a Jacobian [rad/s or m/s].
FACTORED, TRIED, KEPT, CONTRACTION, LEVER, CLOSE, CHANGE = 0, 1, 2, 3, 4, 5, 6
NEWTON_CLOCK_SIZE = 7
# Without circuits, the remaining error may be undamped and accumulate over the steps.
CLOSE_ENOUGH, CLOSE_UNDAMPED = 0.03, 0.003
# NewtonArrays.count, int: flag that the Jacobian must be recomputed; numbers of accepted steps when it was computed and
# when the stages were saved for extrapolation; flag that stages are saved; numbers of Jacobians, factorisations, Newton
# iterations and steps in which these diverged; number of samples whose states are known but not yet recorded; number of
# computed Jacobian columns, which shows an observer that a large Jacobian is progressing.
STALE, MADE_AT, SEEN, EXTRAPOLATES, JACOBIANS, FACTORS, ITERATIONS, DIVERGED, WAITING = 0, 1, 2, 3, 4, 5, 6, 7, 8
COLUMNS = 9
NEWTON_COUNT_SIZE = 10


class NewtonArrays(NamedTuple):
    """Working arrays of RADAU5: n rates, na motors, k circuits, m state entries, of which s have a tolerance."""

    along: np.ndarray  # (2 n + k, n) ∂v̇/∂(θ, v, i), where θ are displacements along the rates
    linear: np.ndarray  # (na, BLOCK_SIZE) linear blocks of the drives
    real_inverse: np.ndarray  # (n, n) inverse of the real reduced matrix; used without lanes, like the next three
    complex_inverse: np.ndarray  # (n, n) complex
    real_room: np.ndarray  # (2, s)
    complex_room: np.ndarray  # (2, s) complex
    pivot: np.ndarray  # (n,) int
    z: np.ndarray  # (3, m) stages of the step being tried, relative to y
    w: np.ndarray  # (3, s) transformed stages T⁻¹ z
    f: np.ndarray  # (3, m) derivatives at the stages
    kept: np.ndarray  # (4, s) coefficients of the polynomial of the accepted stages, and error estimate of their step
    error: np.ndarray  # (s,) error estimate of the step being tried
    weight: np.ndarray  # (s,) 1 / tolerance
    one: np.ndarray  # (s,) right-hand side and solution of the real system
    two: np.ndarray  # (s,) right-hand side and solution of the complex system
    direct: np.ndarray  # (n, n, 4) inverses of both matrices on lanes; used like the next five, see simd.radau5
    crossed: np.ndarray  # (n, n, 4)
    over: np.ndarray  # (2, 4) 1/g
    circuit: np.ndarray  # (na, 2, 4) 1/(g − ∂(di/dt)/∂i)
    x: np.ndarray  # (s, 4)
    room: np.ndarray  # (3, s, 4)
    clock: np.ndarray  # (NEWTON_CLOCK_SIZE,)
    count: np.ndarray  # (NEWTON_COUNT_SIZE,) int
    lanes: StageLanes | None = None  # None: right-hand sides are evaluated one by one


def newton_arrays(n: int, na: int, circuits: int, tracked: int, m: int) -> NewtonArrays:
    """Allocate :class:`NewtonArrays`."""
    count = np.zeros(NEWTON_COUNT_SIZE, dtype=np.int64)
    count[STALE] = 1
    clock = np.zeros(NEWTON_CLOCK_SIZE)
    clock[CLOSE] = CLOSE_ENOUGH if circuits > 0 else CLOSE_UNDAMPED
    return NewtonArrays(
        along=np.zeros((2 * n + circuits, n)),
        linear=np.zeros((na, ka.BLOCK_SIZE)),
        real_inverse=np.zeros((n, n)),
        complex_inverse=np.zeros((n, n), dtype=np.complex128),
        real_room=np.zeros((2, tracked)),
        complex_room=np.zeros((2, tracked), dtype=np.complex128),
        pivot=np.zeros(n, dtype=np.int64),
        z=np.zeros((3, m)),
        w=np.zeros((3, tracked)),
        f=np.zeros((3, m)),
        kept=np.zeros((4, tracked)),
        error=np.zeros(tracked),
        weight=np.zeros(tracked),
        one=np.zeros(tracked),
        two=np.zeros(tracked, dtype=np.complex128),
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
def discard_history(newton: NewtonArrays | None, steps):
    """Discard data about the right-hand side after ``steps`` accepted steps, because it has jumped."""
    if newton is None:  # resolved at compile time
        return
    newton.count[STALE], newton.count[SEEN], newton.count[EXTRAPOLATES] = 1, steps, 0
