"""Constraint rows: the small dense systems of their forces, also when rows depend on each other.

One row format for every constraint: up to two links, ROW (the constrained motion is ROW · V), TARGET (what J vdot must
be) and DIRECTION (the wrench of a unit force). Row and direction differ under sliding friction, so the p×p matrix is
not symmetric.
"""

from __future__ import annotations

import math

from dynsim.kernels.arrays import FORCE, RHS
from dynsim.kernels.jit import inlined_kernel, internal_kernel

# A pivot below this fraction of the largest entry counts as a dependent row: far above rounding (1e-16 times a few
# dozen operations), far below what independent elbows give (> 1e-6).
RANK_TOLERANCE = 1e-11


@inlined_kernel
def solve_small(small, state, active, p):
    """Solve the leading p×p of ``small[0]`` f = RHS for the constraint forces f, into the FORCE column of ``state``.

    Gaussian elimination with partial pivoting; a vanishing pivot switches to the solution of least norm, which is the
    split of forces among dependent rows. Returns 1 in that case, else 0.

    Parameters
    ----------
    small : (4, p or more, p or more)
        Matrix, not symmetric under friction, and scratch.
    state, active : (p or more, ROW_STATE_SIZE), (p or more, ACTIVE_SIZE) int
    """
    if p == 1 and small[0, 0, 0] != 0.0:
        state[0, FORCE] = state[0, RHS] / small[0, 0, 0]
        return 0
    if p == 2:
        a, b, c, d = small[0, 0, 0], small[0, 0, 1], small[0, 1, 0], small[0, 1, 1]
        determinant = a * d - b * c
        # Well conditioned: Cramer's rule loses no more than the elimination.
        if abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)):
            x, y = state[0, RHS] / determinant, state[1, RHS] / determinant
            state[0, FORCE], state[1, FORCE] = d * x - b * y, a * y - c * x
            return 0
    largest = 0.0
    for i in range(p):
        state[i, FORCE] = state[i, RHS]
        for j in range(p):
            small[1, i, j] = small[0, i, j]
            largest = max(largest, abs(small[0, i, j]))
    for k in range(p):
        best = k
        for i in range(k + 1, p):
            if abs(small[1, i, k]) > abs(small[1, best, k]):
                best = i
        # Written so that NaN falls through to the plain elimination and is seen by the integrator.
        if abs(small[1, best, k]) <= RANK_TOLERANCE * largest:
            least_norm(small, state, p)
            return 1
        if best != k:
            for j in range(k, p):
                small[1, k, j], small[1, best, j] = small[1, best, j], small[1, k, j]
            state[k, FORCE], state[best, FORCE] = state[best, FORCE], state[k, FORCE]
        inverse = 1.0 / small[1, k, k]
        for i in range(k + 1, p):
            factor = small[1, i, k] * inverse
            for j in range(k + 1, p):
                small[1, i, j] -= factor * small[1, k, j]
            state[i, FORCE] -= factor * state[k, FORCE]
    for i in range(p - 1, -1, -1):
        total = state[i, FORCE]
        for j in range(i + 1, p):
            total -= small[1, i, j] * state[j, FORCE]
        state[i, FORCE] = total / small[1, i, i]
    return 0


@internal_kernel
def least_norm(small, state, p):
    """Least-squares solution of least norm by a one-sided Jacobi singular value decomposition, W = A V."""
    for i in range(p):
        for j in range(p):
            small[1, i, j] = small[0, i, j]
            small[2, i, j] = 1.0 if i == j else 0.0
    for _ in range(60):
        off = 0.0
        for i in range(p - 1):
            for j in range(i + 1, p):
                alpha, beta, gamma = 0.0, 0.0, 0.0
                for k in range(p):
                    alpha += small[1, k, i] * small[1, k, i]
                    beta += small[1, k, j] * small[1, k, j]
                    gamma += small[1, k, i] * small[1, k, j]
                scale = math.sqrt(alpha * beta)
                if scale == 0.0 or abs(gamma) <= 1e-15 * scale:
                    continue
                off = max(off, abs(gamma) / scale)
                zeta = (beta - alpha) / (2.0 * gamma)
                t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = c * t
                for k in range(p):
                    small[1, k, i], small[1, k, j] = (
                        c * small[1, k, i] - s * small[1, k, j],
                        s * small[1, k, i] + c * small[1, k, j],
                    )
                    small[2, k, i], small[2, k, j] = (
                        c * small[2, k, i] - s * small[2, k, j],
                        s * small[2, k, i] + c * small[2, k, j],
                    )
        if off <= 1e-14:
            break
    largest = 0.0
    for j in range(p):
        total = 0.0
        for k in range(p):
            total += small[1, k, j] * small[1, k, j]
        small[3, 0, j] = total
        largest = max(largest, total)
    for i in range(p):
        state[i, FORCE] = 0.0
    for j in range(p):
        square = small[3, 0, j]
        if square > RANK_TOLERANCE * RANK_TOLERANCE * largest:
            total = 0.0
            for k in range(p):
                total += small[1, k, j] * state[k, RHS]
            for i in range(p):
                state[i, FORCE] += small[2, i, j] * (total / square)
