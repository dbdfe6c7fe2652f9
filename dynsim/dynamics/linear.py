"""Small dense systems of linear equations: elimination, symmetric factors, orthonormal bases, least-norm solutions."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel

# A pivot or row below this fraction of the largest entry counts as dependent: far above rounding (1e-16 times a few
# dozen operations), far below the pivots of independent elbows (> 1e-6).
RANK_TOLERANCE = 1e-10
# Smallest pivot of a definite row, relative to its diagonal entry before elimination: smaller pivots have no digits
# left. The pivot of a dependent row among the others, which suppresses its unknown.
PIVOT_MIN, HUGE = 1e-14, 1e100
# The smallest part of a unit direction in the leading rows that counts. A smaller one changes other rows only:
# couplings behind closed brakes.
LEAST_LEADING = 1e-10


@internal_kernel
def affine_row(A, x, b, size, i):
    """Return (A x + b)_i."""
    total = b[i]
    for j in range(size):
        total += A[i, j] * x[j]
    return total


@internal_kernel
def eliminate(A, x, size, least):
    """Solve the leading ``size`` rows of A y = x in place, with partial pivoting.

    Returns the sign of the determinant, or 0 without a solution if no pivot of a column is above ``least``. NaN is kept
    in the solution.
    """
    sign = 1.0
    for k in range(size):
        best, largest = k, abs(A[k, k])
        for i in range(k + 1, size):
            if abs(A[i, k]) > largest:
                best, largest = i, abs(A[i, k])
        if largest <= least:
            return 0.0
        if best != k:
            sign = -sign
            x[k], x[best] = x[best], x[k]
            for j in range(k, size):
                A[k, j], A[best, j] = A[best, j], A[k, j]
        sign = sign if A[k, k] > 0.0 else -sign
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, size):
            factor = A[i, k] * inverse
            if factor != 0.0:
                # Slices that begin at index zero: only such loops are vectorised.
                row, pivot = A[i, k + 1 : size], A[k, k + 1 : size]
                for j in range(row.shape[0]):
                    row[j] -= factor * pivot[j]
                x[i] -= factor * x[k]
    for i in range(size - 1, -1, -1):
        total = x[i]
        for j in range(i + 1, size):
            total -= A[i, j] * x[j]
        x[i] = total / A[i, i]
    return sign


@internal_kernel
def factor_symmetric(A, size, definite):
    """Factor A = L D Lᵀ in its lower triangle, with D on the diagonal.

    The ``definite`` rows, which come first, have positive pivots, the others negative ones. A row of the others that
    depends on the preceding rows gets a pivot that suppresses its unknown.
    """
    for k in range(size):
        for j in range(k):
            for i in range(j):
                A[k, j] -= A[k, i] * A[j, i]
        # So far the entries are L D.
        removed = 0.0
        least = PIVOT_MIN * A[k, k]
        for j in range(k):
            whole = A[k, j]
            A[k, j] = whole / A[j, j]
            A[k, k] -= whole * A[k, j]
            removed += abs(whole * A[k, j])
        if k < definite:
            A[k, k] = max(A[k, k], least)
        elif -A[k, k] <= RANK_TOLERANCE * removed:
            A[k, k] = -HUGE


@internal_kernel
def solve_symmetric(A, x, size):
    """Solve L D Lᵀ y = x in place, with the factors of :func:`factor_symmetric`."""
    for i in range(size):
        for k in range(i):
            x[i] -= A[i, k] * x[k]
    for i in range(size - 1, -1, -1):
        x[i] /= A[i, i]
        for k in range(i + 1, size):
            x[i] -= A[k, i] * x[k]


@internal_kernel
def orthonormalise(V, size, leading, least):
    """Replace the rows of V, (size, size), by an orthonormal basis of them, the largest row first; return its size.

    Rows of which no more than ``least`` is left count as dependent. Products include only the ``leading`` entries.
    """
    for k in range(size):
        best, largest = k, -1.0
        for i in range(k, size):
            square = product(V, i, i, leading)
            if square > largest:
                best, largest = i, square
        if largest <= least * least:
            return k
        for m in range(size):
            V[k, m], V[best, m] = V[best, m], V[k, m]
        # Again, since rounding is large where little is left; orthogonalising twice is enough (Kahan, Parlett).
        for j in range(k):
            remove(V, j, k, size, leading)
        scale = 1.0 / math.sqrt(product(V, k, k, leading))
        for m in range(size):
            V[k, m] *= scale
        for i in range(k + 1, size):
            remove(V, k, i, size, leading)
    return size


@internal_kernel
def product(V, i, j, leading):
    """Return the product of the leading entries of rows i and j."""
    total = 0.0
    for m in range(leading):
        total += V[i, m] * V[j, m]
    return total


@internal_kernel
def remove(V, j, i, size, leading):
    """Remove the part along row j, of unit length, from row i."""
    part = product(V, i, j, leading)
    for m in range(size):
        V[i, m] -= part * V[j, m]


@internal_kernel
def least_norm(room, b, x, size, least):
    """Write the least-squares solution of least norm of A x = b to x; return the rank of A, (size, size).

    With orthonormal bases P of the columns of A and Q of its rows it is x = Qᵀ (P A Qᵀ)⁻¹ P b. A is ``room[0]``, which
    is kept; the next three matrices of ``room`` are scratch. ``least`` is the size of a row that counts as zero.
    """
    A, Q, P, scratch = room[0], room[1], room[2], room[3, 0]
    for i in range(size):
        for j in range(size):
            Q[i, j], P[i, j] = A[i, j], A[j, i]
    rank = min(orthonormalise(Q, size, size, least), orthonormalise(P, size, size, least))
    for k in range(rank):
        x[k] = 0.0
        for m in range(size):
            x[k] += P[k, m] * b[m]
            scratch[m] = 0.0
        for i in range(size):
            for m in range(size):
                scratch[m] += P[k, i] * A[i, m]
        # This row of P is free now.
        for j in range(rank):
            P[k, j] = 0.0
            for m in range(size):
                P[k, j] += scratch[m] * Q[j, m]
    eliminate(P, x, rank, -1.0)
    for m in range(size):
        scratch[m] = 0.0
        for k in range(rank):
            scratch[m] += Q[k, m] * x[k]
    for m in range(size):
        x[m] = scratch[m]
    return rank


@internal_kernel
def null_space(W, size, N, leading):
    """Write a basis of the null space of W, (size, size), symmetric and positive semidefinite, to N, (size, width).

    It is orthonormal in its ``leading`` rows. W is overwritten by an orthonormal basis of its range.

    Returns
    -------
    width : int
        ``size`` minus the rank, minus the directions that change nothing in the leading rows.
    """
    largest = 0.0
    for i in range(size):
        largest = max(largest, W[i, i])
    rank = orthonormalise(W, size, size, RANK_TOLERANCE * largest)
    # The projection onto the null space.
    for i in range(size):
        for j in range(size):
            N[i, j] = 1.0 if i == j else 0.0
            for k in range(rank):
                N[i, j] -= W[k, i] * W[k, j]
    width = orthonormalise(N, size, leading, LEAST_LEADING)
    for i in range(size):
        for j in range(i):
            N[i, j], N[j, i] = N[j, i], N[i, j]
    return width
