"""Solver of small dense (Delassus) systems for the forces of constraint rows, which may be linearly dependent.

One row format for every constraint: up to two links, ROW (the constrained motion is ROW · V), TARGET (what J vdot must
be) and DIRECTION (the wrench of a unit force). Under sliding friction row and direction differ, so the p×p matrix is
not symmetric then.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# A pivot below this fraction of the largest entry counts as a dependent row: far above rounding (1e-16 times a few
# dozen operations), far below what independent elbows give (> 1e-6).
RANK_TOLERANCE = 1e-10


@internal_kernel
def solve_small(small, state, active, p):
    """Solve the leading p×p of ``small[0]`` f = RHS for the constraint forces f, into the FORCE column of ``state``.

    Gaussian elimination with partial pivoting. If a pivot vanishes, :func:`least_norm` solves the system again and
    gives the split of least norm among dependent rows. Returns 1 in that case, otherwise 0.

    Parameters
    ----------
    small : (4, p or more, p or more)
        Matrix, not symmetric under friction, and scratch.
    state, active : (p or more, ROW_STATE_SIZE), (p or more, ACTIVE_SIZE) int
    """
    if p == 1 and abs(small[0, 0, 0]) > state[0, ka.ROW_FLOOR]:
        state[0, ka.FORCE] = state[0, ka.RHS] / small[0, 0, 0]
        return 0
    if p == 1 and abs(small[0, 0, 0]) <= state[0, ka.ROW_FLOOR]:
        state[0, ka.FORCE] = 0.0
        return 0
    if p == 2:
        a, b, c, d = small[0, 0, 0], small[0, 0, 1], small[0, 1, 0], small[0, 1, 1]
        determinant = a * d - b * c
        # Well conditioned: Cramer's rule loses no more than the elimination.
        floors = state[0, ka.ROW_FLOOR] * state[1, ka.ROW_FLOOR]
        if abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)) + floors:
            x, y = state[0, ka.RHS] / determinant, state[1, ka.RHS] / determinant
            state[0, ka.FORCE], state[1, ka.FORCE] = d * x - b * y, a * y - c * x
            return 0
    return eliminate(small, state, active, p)


@noinline_kernel
def eliminate(small, state, active, p):
    """:func:`solve_small` for any number of rows, without the closed forms."""
    largest = largest_entry(small, state, p)
    for i in range(p):
        state[i, ka.FORCE] = state[i, ka.RHS]
        for j in range(p):
            small[1, i, j] = small[0, i, j]
    for k in range(p):
        best = k
        for i in range(k + 1, p):
            if abs(small[1, i, k]) > abs(small[1, best, k]):
                best = i
        # Written so that NaN falls through to the plain elimination and is seen by the integrator.
        if abs(small[1, best, k]) <= RANK_TOLERANCE * largest:
            return least_norm(small, state, active, p, largest)
        if best != k:
            for j in range(p):
                small[1, k, j], small[1, best, j] = small[1, best, j], small[1, k, j]
            state[k, ka.FORCE], state[best, ka.FORCE] = state[best, ka.FORCE], state[k, ka.FORCE]
        inverse = 1.0 / small[1, k, k]
        for i in range(k + 1, p):
            factor = small[1, i, k] * inverse
            small[1, i, k] = factor
            for j in range(k + 1, p):
                small[1, i, j] -= factor * small[1, k, j]
            state[i, ka.FORCE] -= factor * state[k, ka.FORCE]
    for i in range(p - 1, -1, -1):
        total = state[i, ka.FORCE]
        for j in range(i + 1, p):
            total -= small[1, i, j] * state[j, ka.FORCE]
        state[i, ka.FORCE] = total / small[1, i, i]
    return 0


@noinline_kernel
def solve_dependent(small, state, active, p):
    """:func:`solve_small` of rows that are known to depend on each other.

    Pivots of columns in their order may not show it: the last one is the inverse of an entry of the inverse, large for
    a row with almost no part in the dependence. Forces would be as large as rounding allows.
    """
    return least_norm(small, state, active, p, largest_entry(small, state, p))


@internal_kernel
def largest_entry(small, state, p):
    """Return the size that pivots are compared with."""
    largest = 0.0
    for i in range(p):
        # A row without mobility is dependent even if no other row has more.
        largest = max(largest, state[i, ka.ROW_FLOOR] / RANK_TOLERANCE)
        for j in range(p):
            largest = max(largest, abs(small[0, i, j]))
    return largest


@internal_kernel
def least_norm(small, state, active, p, largest):
    """Find the least-squares solution of least norm; return 1 if rows depend on each other, otherwise 0.

    Elimination with rook pivoting (the largest entry of its row and of its column) leaves P A Q = [L1; L2] [U1, U2] of
    rank r. With W = L2 L1⁻¹ and Z = U1⁻¹ U2, whose entries such pivots keep small, unlike the pivots of
    :func:`eliminate`,

        [L1; L2]⁺ b = L1⁻¹ (b1 + N(Wᵀ) (b2 − W b1)),    [U1, U2]⁺ c = (x1, Zᵀ x1),  x1 = s − N(Z) Zᵀ s,  s = U1⁻¹ c

    with N(X) = X (1 + Xᵀ X)⁻¹, and x = Q [U1, U2]⁺ [L1; L2]⁺ P b. Elimination turns b into L1⁻¹ b1 and b2 − W b1.
    """
    matrix, wide, part = small[1], small[2], small[3, p - 1]
    for i in range(p):
        state[i, ka.FORCE] = state[i, ka.RHS]
        for j in range(p):
            matrix[i, j] = small[0, i, j]
    r = eliminate_to_rank(small, state, active, p, largest)
    d = p - r
    # Wᵀ = L1⁻ᵀ L2ᵀ, (r, d).
    for k in range(r - 1, -1, -1):
        for a in range(d):
            wide[k, a] = matrix[r + a, k]
        for i in range(k + 1, r):
            factor = matrix[i, k]
            for a in range(d):
                wide[k, a] -= factor * wide[i, a]
    apply_normal(small, state, p, r)
    for k in range(r):
        for j in range(k):
            part[k] -= matrix[k, j] * part[j]
        state[k, ka.FORCE] += part[k]
    # s and Z, (r, d), together.
    for k in range(r - 1, -1, -1):
        inverse = 1.0 / matrix[k, k]
        total = state[k, ka.FORCE]
        for a in range(d):
            wide[k, a] = matrix[k, r + a]
        for j in range(k + 1, r):
            factor = matrix[k, j]
            total -= factor * state[j, ka.FORCE]
            for a in range(d):
                wide[k, a] -= factor * wide[j, a]
        state[k, ka.FORCE] = total * inverse
        for a in range(d):
            wide[k, a] *= inverse
    multiply_transposed(wide, state, r, d)
    apply_normal(small, state, p, r)
    for k in range(r):
        state[k, ka.FORCE] -= part[k]
    multiply_transposed(wide, state, r, d)
    # Back to the order of the rows.
    for k in range(p):
        part[k] = state[k, ka.FORCE]
    for k in range(p):
        state[active[k, ka.ORDER], ka.FORCE] = part[k]
    return 1 if d > 0 else 0


@internal_kernel
def eliminate_to_rank(small, state, active, p, largest):
    """Rank of ``small[1]`` by its elimination; multipliers stay below the diagonal.

    ``largest``: size of the largest entry of ``small[0]``, see :func:`largest_entry`.

    A column without a pivot goes to the end and is finished: elimination would not add larger terms to it.
    """
    matrix = small[1]
    for i in range(p):
        active[i, ka.ORDER] = i
    k, last = 0, p
    while k < last:
        column, row = k, largest_in_column(matrix, k, k, p)
        if abs(matrix[row, column]) <= RANK_TOLERANCE * largest:
            last -= 1
            while last > k and abs(matrix[largest_in_column(matrix, last, k, p), last]) <= RANK_TOLERANCE * largest:
                last -= 1
            swap_columns(matrix, active, p, k, last)
            continue
        for _ in range(p):
            other = column
            for j in range(k, last):
                if abs(matrix[row, j]) > abs(matrix[row, other]):
                    other = j
            if other == column:
                break
            column = other
            other = largest_in_column(matrix, column, k, p)
            if other == row:
                break
            row = other
        swap_columns(matrix, active, p, k, column)
        if row != k:
            for j in range(p):
                matrix[k, j], matrix[row, j] = matrix[row, j], matrix[k, j]
            state[k, ka.FORCE], state[row, ka.FORCE] = state[row, ka.FORCE], state[k, ka.FORCE]
        inverse = 1.0 / matrix[k, k]
        for i in range(k + 1, p):
            factor = matrix[i, k] * inverse
            matrix[i, k] = factor
            for j in range(k + 1, last):
                matrix[i, j] -= factor * matrix[k, j]
            state[i, ka.FORCE] -= factor * state[k, ka.FORCE]
        k += 1
    return k


@internal_kernel
def largest_in_column(matrix, column, start, p):
    """Row of the largest entry of a column from row ``start`` on."""
    best = start
    for i in range(start + 1, p):
        if abs(matrix[i, column]) > abs(matrix[best, column]):
            best = i
    return best


@internal_kernel
def swap_columns(matrix, active, p, j, k):
    """Exchange two columns, and their places in ORDER."""
    if j != k:
        for i in range(p):
            matrix[i, j], matrix[i, k] = matrix[i, k], matrix[i, j]
        active[j, ka.ORDER], active[k, ka.ORDER] = active[k, ka.ORDER], active[j, ka.ORDER]


@internal_kernel
def multiply_transposed(wide, state, r, d):
    """wideᵀ x of the first r forces x into the d forces behind them; wide: (r, d)."""
    for a in range(d):
        state[r + a, ka.FORCE] = 0.0
    for k in range(r):
        x = state[k, ka.FORCE]
        for a in range(d):
            state[r + a, ka.FORCE] += wide[k, a] * x


@internal_kernel
def apply_normal(small, state, p, r):
    """X (1 + Xᵀ X)⁻¹ t = (1 + X Xᵀ)⁻¹ X t by the smaller of the two; X: ``small[2]``, (r, p − r), t: FORCE from r on.

    The result, (r,), goes into the last row of ``small[3]``; the last row of ``small[2]``, free of X, is scratch.
    """
    X, gram, x, t, d = small[2], small[3], small[3, p - 1], small[2, p - 1], p - r
    if d == 1:  # as two braces that stick on a planar arm have it
        total = 1.0
        for k in range(r):
            total += X[k, 0] * X[k, 0]
        factor = state[r, ka.FORCE] / total
        for k in range(r):
            x[k] = factor * X[k, 0]
        return
    for a in range(d):
        t[a] = state[r + a, ka.FORCE]
    if d <= r:
        for a in range(d):
            for b in range(a, d):
                gram[a, b] = 1.0 if a == b else 0.0
        for k in range(r):
            for a in range(d):
                factor = X[k, a]
                for b in range(a, d):
                    gram[a, b] += factor * X[k, b]
        solve_definite(gram, t, d)
    for k in range(r):
        x[k] = 0.0
        for a in range(d):
            x[k] += X[k, a] * t[a]
    if d > r:
        for a in range(r):
            for b in range(a, r):
                total = 1.0 if a == b else 0.0
                for c in range(d):
                    total += X[a, c] * X[b, c]
                gram[a, b] = total
        solve_definite(gram, x, r)


@internal_kernel
def solve_definite(gram, x, size):
    """Solve gram y = x in place by Cholesky, Rᵀ R of the upper triangle; by outer products, loops run along rows."""
    for a in range(size):
        inverse = 1.0 / math.sqrt(gram[a, a])
        for b in range(a, size):
            gram[a, b] *= inverse
        for c in range(a + 1, size):
            factor = gram[a, c]
            for b in range(c, size):
                gram[c, b] -= factor * gram[a, b]
    for a in range(size):
        x[a] /= gram[a, a]
        for b in range(a + 1, size):
            x[b] -= gram[a, b] * x[a]
    for a in range(size - 1, -1, -1):
        for b in range(a + 1, size):
            x[a] -= gram[a, b] * x[b]
        x[a] /= gram[a, a]
