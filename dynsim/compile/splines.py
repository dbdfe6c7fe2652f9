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
# First and second derivatives at a knot, but for their scale, by the five B-splines there.
_SLOPE, _CURVATURE = np.array([-1.0, -10.0, 0.0, 10.0, 1.0]), np.array([1.0, 2.0, -6.0, 2.0, 1.0])
# Samples that hold at an end are held exactly if the spline through them would move there by more than this part of
# its span per knot. The ringing of a kink decays by 0.43 per knot, and falls below this within about ten.
_STANDS = 4e-6
# Segments that the motion between has at least.
_FEWEST = 6


def quintic_rates(spacing: float, values: Array) -> tuple[Array, Array]:
    """First and second derivatives at its knots of the C⁴ quintic spline through equally spaced samples, (T, m).

    The fifth derivative does not jump at the second and third samples from each end (not-a-knot), so that quintics are
    kept exactly. Samples that are the same at an end, before a motion that begins so soon that the spline would not be
    at rest there, are held exactly: the spline is that of the motion, at rest where it meets them (C²).

    Parameters
    ----------
    spacing : of the samples [s]
    values : (T, m), T ≥ 6
    """
    slope, curvature = _rates(spacing, values)
    creeps = spacing * np.abs(slope[[0, -1]]) > _STANDS * np.ptp(values, axis=0)
    creeps &= np.stack([values[0] == values[1], values[-1] == values[-2]]) & (np.ptp(values, axis=0) > 0.0)
    for column in np.flatnonzero(creeps.any(axis=0)):
        moved = np.flatnonzero(np.diff(values[:, column]))
        first = int(moved[0]) if creeps[0, column] else 0
        last = int(moved[-1]) + 1 if creeps[1, column] else len(values) - 1
        if last - first < _FEWEST:
            continue
        part = slice(first, last + 1)
        slope[:, column], curvature[:, column] = 0.0, 0.0
        rates = _rates(spacing, values[part, column : column + 1], (bool(creeps[0, column]), bool(creeps[1, column])))
        slope[part, column], curvature[part, column] = rates[0][:, 0], rates[1][:, 0]
        # To the last bit, too.
        stands = [knot for knot, still in ((first, creeps[0, column]), (last, creeps[1, column])) if still]
        slope[stands, column], curvature[stands, column] = 0.0, 0.0
    return slope, curvature


def _rates(spacing: float, values: Array, at_rest: tuple[bool, bool] = (False, False)) -> tuple[Array, Array]:
    """Those of the spline whose beginning and end are at rest, where they are to be, else not-a-knot."""
    count = len(values)
    band, right = np.zeros((count + 4, 3 * _BESIDE + 1)), np.zeros((count + 4, values.shape[1]))
    for offset in range(5):  # sample k is row k + 2, its B-splines are k to k + 4
        band[2 : count + 2, _BESIDE - 2 + offset] = _VALUE[offset]
    right[2:-2] = values
    # Rows, the first of the B-splines that meet at the sample there, and whether it is to be at rest.
    for row, first, sample, still, rate in (
        (0, 0, 0, at_rest[0], _SLOPE),
        (1, 1, 0, at_rest[0], _CURVATURE),
        (count + 2, count - 4, count - 1, at_rest[1], _SLOPE),
        (count + 3, count - 3, count - 1, at_rest[1], _CURVATURE),
    ):
        begin = _BESIDE + (sample if still else first) - row
        weights = rate if still else _DIFFERENCE
        band[row, begin : begin + len(weights)] = weights
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
