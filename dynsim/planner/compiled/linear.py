"""Linear algebra: Cholesky factors with a skyline, and quadratic programs with nonnegative unknowns."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel
from dynsim.planner.compiled.tables import Work

# Threshold, relative to the scale of multipliers and forces, below which it is not worthwhile to release a bound.
NO_GAIN = 1e-11


@internal_kernel
def copy(source, target):
    """Copy the entries of a matrix to another matrix."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@internal_kernel
def dot(a, b):
    """Return the scalar product of two vectors."""
    s = 0.0
    for i in range(a.shape[0]):
        s += a[i] * b[i]
    return s


@internal_kernel
def factor(A, skyline, done, n):
    """Factorise the leading n × n part of A = L Lᵀ (Cholesky) in its lower half; vanishing pivots become very large.

    Parameters
    ----------
    A : ndarray
        Symmetric matrix; its lower half is overwritten by L.
    skyline : (n,) ndarray of int
        Output: first nonzero column of each row of A; L is also zero to the left of it.
    done : int
        Number of leading rows that already contain L.
    n : int
        Size of the leading part.
    """
    for i in range(done, n):
        first = 0
        while first < i and A[i, first] == 0.0:
            first += 1
        skyline[i] = first
        for j in range(first, i + 1):
            s = A[i, j]
            for k in range(max(first, skyline[j]), j):
                s -= A[i, k] * A[j, k]
            if i == j:
                A[i, i] = math.sqrt(s) if s > 1e-300 else 1e150
            else:
                A[i, j] = s / A[j, j]


@internal_kernel
def forward(L, skyline, b, n):
    """Compute b ← L⁻¹ b."""
    for i in range(n):
        s = b[i]
        for k in range(skyline[i], i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@internal_kernel
def backward(L, skyline, b, n):
    """Compute b ← L⁻ᵀ b."""
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(skyline[i], i):
            b[k] -= L[i, k] * b[i]


@internal_kernel
def nonnegative(work: Work, G, h, x, known, m):
    """Minimise ½ xᵀGx − hᵀx over x ≥ 0 with the active-set method of Lawson and Hanson.

    Parameters
    ----------
    work : Work
        Workspace.
    G : (m, m) ndarray
        Positive semidefinite matrix with a small positive diagonal.
    h, x : (m,) ndarray
        Linear term, and the solution.
    known : int
        Number of leading entries of x that already solve the problem without the remaining entries; ``work.passive``
        marks the positive ones.
    m : int
        Number of unknowns.
    """
    passive, small, right, index, skyline = work.passive, work.small, work.small_right, work.index, work.small_skyline
    scale, count, done = 1e-300, 0, 0
    for i in range(m):
        scale = max(scale, abs(h[i]))
        if i >= known:
            x[i], passive[i] = 0.0, 0
        elif passive[i]:
            index[count] = i
            count += 1
    for _ in range(3 * m + 10):
        best, most = -1, NO_GAIN * scale
        for i in range(m):
            if passive[i] == 0:
                gain = h[i]
                for a in range(count):
                    gain -= G[i, index[a]] * x[index[a]]
                if gain > most:
                    best, most = i, gain
        if best < 0:
            return
        passive[best], index[count] = 1, best
        count += 1
        while count > 0:
            for a in range(done, count):
                for b in range(a + 1):
                    small[a, b] = G[index[a], index[b]]
                small[a, a] *= 1.0 + 1e-12
            factor(small, skyline, done, count)
            done = count
            for a in range(count):
                right[a] = h[index[a]]
            forward(small, skyline, right, count)
            backward(small, skyline, right, count)
            share, first = 1.0, -1
            for a in range(count):
                i = index[a]
                if right[a] <= 0.0:
                    reached = x[i] / (x[i] - right[a]) if x[i] > right[a] else 0.0
                    if reached < share:
                        share, first = reached, a
            left = 0
            for a in range(count):
                i = index[a]
                x[i] += share * (right[a] - x[i])
                if a == first or (first >= 0 and right[a] <= 0.0 and x[i] <= 1e-13 * scale):
                    x[i], passive[i], done = 0.0, 0, min(done, a)
                else:
                    index[left] = i
                    left += 1
            count = left
            if first < 0:
                break
