"""Spline interpolation of samples (quintic, cubic), and the minimum-jerk motion from rest to rest.

scipy is not used here because its import takes 0.3 s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.dynamics.banded import solve_banded
from dynsim.jit.kernel import reals

Array = NDArray[np.float64]

# Quintic B-splines at their knots, and their sixth difference.
_VALUE = np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0
_DIFFERENCE = np.array([1.0, -6.0, 15.0, -20.0, 15.0, -6.0, 1.0])
# Half bandwidth of the equations: a row of sixth differences has up to six unknowns on one side of the diagonal.
_BESIDE = 6


def quintic_rates(spacing: float, values: Array) -> tuple[Array, Array]:
    """First and second derivatives at its knots of the C⁴ quintic spline through equally spaced samples, (T, m).

    The fifth derivative does not jump at the second and third samples from each end (not-a-knot), so that quintics are
    kept exactly.

    Parameters
    ----------
    spacing : of the samples [s]
    values : (T, m), T ≥ 6
    """
    count = len(values)
    band, right = np.zeros((count + 4, 3 * _BESIDE + 1)), np.zeros((count + 4, values.shape[1]))
    for offset in range(5):  # sample k is row k + 2, its B-splines are k to k + 4
        band[2 : count + 2, _BESIDE - 2 + offset] = _VALUE[offset]
    right[2:-2] = values
    # Row, and the first of the seven B-splines that meet at the sample there.
    for row, first in ((0, 0), (1, 1), (count + 2, count - 4), (count + 3, count - 3)):
        begin = _BESIDE + first - row
        band[row, begin : begin + 7] = _DIFFERENCE
    solve_banded(band, _BESIDE, _BESIDE, right)
    a, b, c, d, e = (right[k : k + count] for k in range(5))
    slope = (e - a + 10.0 * (d - b)) / (24.0 * spacing)
    curvature = (a + e + 2.0 * (b + d) - 6.0 * c) / (6.0 * spacing**2)
    return slope, curvature


def quintic_coefficients(spacing: float, values: Array) -> Array:
    """That spline as ascending powers of the time since the beginning of a segment, (T − 1, m, 6).

    Inside a segment the polynomial is the one that value, slope and curvature at both ends determine.
    """
    h = spacing
    slope, curvature = quintic_rates(h, values)
    y, s, c = values, slope * h, curvature * h**2
    dy = y[1:] - y[:-1] - s[:-1] - 0.5 * c[:-1]
    ds = s[1:] - s[:-1] - c[:-1]
    dc = c[1:] - c[:-1]
    a3 = 10.0 * dy - 4.0 * ds + 0.5 * dc
    a4 = -15.0 * dy + 7.0 * ds - dc
    a5 = 6.0 * dy - 3.0 * ds + 0.5 * dc
    powers = np.stack([y[:-1], s[:-1], 0.5 * c[:-1], a3, a4, a5], axis=-1)
    return reals(powers / h ** np.arange(6))


def clamped_cubic(knots: ArrayLike, values: Array, times: Array, level: bool = True) -> Array:
    """The C² cubic spline through samples, level at both ends and held beyond them, at some times.

    Parameters
    ----------
    knots : (K,), K ≥ 2, increasing [s]
    values : (K, ...)
    times : (T,) [s]
    level : else it is not bent at both ends (a natural spline)

    Returns
    -------
    array, shape (T, ...)
    """
    at = np.asarray(knots, dtype=np.float64)
    y = values.reshape(len(at), -1)
    h = np.diff(at)[:, None]
    mean = np.diff(y, axis=0) / h
    # Slopes s: h_i s_{i−1} + 2 (h_{i−1} + h_i) s_i + h_{i−1} s_{i+1} = 3 (h_i d_{i−1} + h_{i−1} d_i), zero at the ends.
    band, slope = np.zeros((len(at), 4)), np.zeros(y.shape)
    band[:, 1] = 1.0
    band[1:-1, 0], band[1:-1, 1], band[1:-1, 2] = h[1:, 0], 2.0 * (h[:-1, 0] + h[1:, 0]), h[:-1, 0]
    slope[1:-1] = 3.0 * (h[1:] * mean[:-1] + h[:-1] * mean[1:])
    if not level:
        band[0, 1:3], band[-1, 0:2] = (2.0, 1.0), (1.0, 2.0)
        slope[0], slope[-1] = 3.0 * mean[0], 3.0 * mean[-1]
    solve_banded(band, 1, 1, slope)
    t = np.clip(times, at[0], at[-1])
    k = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(at) - 2)
    x, a, b, d = (t - at[k])[:, None], slope[k], slope[k + 1], mean[k]
    third = (a + b - 2.0 * d) / h[k]
    curve = y[k] + x * (a + x * ((d - a) / h[k] - third + x * (third / h[k])))
    return np.asarray(curve.reshape(len(t), *values.shape[1:]))


def minimum_jerk(t: Array, start: float, duration: float) -> Array:
    """s(x) = 10x³ − 15x⁴ + 6x⁵ with x = (t − start)/duration, 0 before and 1 after: least integral of squared jerk."""
    x = np.clip((np.asarray(t) - start) / duration, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
