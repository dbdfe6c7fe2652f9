"""Solver of banded systems of linear equations."""

from __future__ import annotations

from dynsim.jit.kernel import kernel


@kernel
def solve_banded(band, lower, upper, right):
    """Solve A x = b by elimination with row exchanges, which fill up to ``lower`` additional diagonals above the band.

    Parameters
    ----------
    band : (n, 2 lower + upper + 1) ndarray
        Entry (i, j) of A at [i, lower + j − i]; the last columns are zero. Overwritten.
    lower, upper : int
        Numbers of diagonals below and above the main diagonal.
    right : (n, m) ndarray
        Right-hand side b; overwritten with x.
    """
    n, m = right.shape
    for k in range(n):
        beyond, end = min(n, k + lower + 1), min(n, k + lower + upper + 1)
        p = k
        for i in range(k + 1, beyond):
            if abs(band[i, lower + k - i]) > abs(band[p, lower + k - p]):
                p = i
        if p != k:
            for j in range(k, end):
                a, b = lower + j - k, lower + j - p
                band[k, a], band[p, b] = band[p, b], band[k, a]
            for c in range(m):
                right[k, c], right[p, c] = right[p, c], right[k, c]
        for i in range(k + 1, beyond):
            factor = band[i, lower + k - i] / band[k, lower]
            for j in range(k + 1, end):
                band[i, lower + j - i] -= factor * band[k, lower + j - k]
            for c in range(m):
                right[i, c] -= factor * right[k, c]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, min(n, k + lower + upper + 1)):
            for c in range(m):
                right[k, c] -= band[k, lower + j - k] * right[j, c]
        for c in range(m):
            right[k, c] /= band[k, lower]
