"""Splines through samples (quintic, cubic), the minimum-jerk motion, and the path of a base on rolling wheels.

These splines are used instead of scipy's, because importing scipy takes longer than a short run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.dynamics.banded import solve_banded
from dynsim.jit.kernel import reals
from dynsim.model.mobile_base import MobileBase

Array = NDArray[np.float64]

# Values of a quintic B-spline at its knots, and coefficients of the sixth difference.
_VALUE = np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0
_DIFFERENCE = np.array([1.0, -6.0, 15.0, -20.0, 15.0, -6.0, 1.0])
# Half bandwidth of the equations: a row of sixth differences has up to six unknowns on one side of the diagonal.
_HALF_BAND = 6
# Weights of the five B-splines at a knot for the first and second derivatives there, up to a scale factor.
_SLOPE, _CURVATURE = np.array([-1.0, -10.0, 0.0, 10.0, 1.0]), np.array([1.0, 2.0, -6.0, 2.0, 1.0])
# Constant samples at an end are kept exactly constant if the spline through them would move there by more than this
# fraction of its span per knot. The ringing of a kink decays by a factor of 0.43 per knot and falls below this within
# about ten knots.
_CREEP = 4e-6
# Minimum number of segments of the motion between such constant ends.
_FEWEST = 6


def quintic_rates(spacing: float, values: Array) -> tuple[Array, Array]:
    """Return first and second derivatives at the knots of the C⁴ quintic spline through equally spaced samples, (T, m).

    The fifth derivative does not jump at the second and third samples from each end (not-a-knot), so that quintics are
    reproduced exactly. If samples are constant at an end and the motion starts so soon that the spline would not be at
    rest there, they are kept exactly constant: the spline covers only the motion and ends with zero rates (C²).

    Parameters
    ----------
    spacing : float
        Spacing of the samples [s].
    values : (T, m) ndarray
        Samples, T ≥ 6.
    """
    slope, curvature = _rates(spacing, values)
    creeps = spacing * np.abs(slope[[0, -1]]) > _CREEP * np.ptp(values, axis=0)
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
        # Rounding must not leave small rates at the knots at rest.
        resting = [knot for knot, still in ((first, creeps[0, column]), (last, creeps[1, column])) if still]
        slope[resting, column], curvature[resting, column] = 0.0, 0.0
    return slope, curvature


def _rates(spacing: float, values: Array, at_rest: tuple[bool, bool] = (False, False)) -> tuple[Array, Array]:
    """Return the derivatives of a spline with zero rates at the ends in ``at_rest``, and not-a-knot at the others."""
    count = len(values)
    band, right = np.zeros((count + 4, 3 * _HALF_BAND + 1)), np.zeros((count + 4, values.shape[1]))
    for offset in range(5):  # sample k is in row k + 2, and B-splines k to k + 4 overlap it
        band[2 : count + 2, _HALF_BAND - 2 + offset] = _VALUE[offset]
    right[2:-2] = values
    # Each entry: row, first B-spline that overlaps the sample, sample, whether it is at rest, and derivative.
    for row, first, sample, still, rate in (
        (0, 0, 0, at_rest[0], _SLOPE),
        (1, 1, 0, at_rest[0], _CURVATURE),
        (count + 2, count - 4, count - 1, at_rest[1], _SLOPE),
        (count + 3, count - 3, count - 1, at_rest[1], _CURVATURE),
    ):
        begin = _HALF_BAND + (sample if still else first) - row
        weights = rate if still else _DIFFERENCE
        band[row, begin : begin + len(weights)] = weights
    solve_banded(band, _HALF_BAND, _HALF_BAND, right)
    a, b, c, d, e = (right[k : k + count] for k in range(5))
    slope = (e - a + 10.0 * (d - b)) / (24.0 * spacing)
    curvature = (a + e + 2.0 * (b + d) - 6.0 * c) / (6.0 * spacing**2)
    return slope, curvature


def quintic_coefficients(spacing: float, values: Array) -> Array:
    """Return the quintic spline through samples as ascending powers of the time in each segment, (T − 1, m, 6).

    Value, slope and curvature at both ends determine the polynomial of a segment.
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
    """Return values of the C² cubic spline through samples, with zero slope at both ends and constant beyond them.

    Parameters
    ----------
    knots : array_like, shape (K,)
        Increasing times of the samples [s], K ≥ 2.
    values : (K, ...) ndarray
        Samples.
    times : (T,) ndarray
        Times to evaluate [s].
    level : bool, optional
        If False, zero curvature instead of zero slope at both ends (a natural spline).

    Returns
    -------
    (T, ...) ndarray
        Values of the spline.
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
    """Return s(x) = 10x³ − 15x⁴ + 6x⁵ with x = (t − start)/duration, 0 before and 1 after the motion.

    Of all motions from rest to rest, this one minimizes the integral of the squared jerk.
    """
    x = np.clip((np.asarray(t) - start) / duration, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


# Kinematics of a base on two driven wheels: wheel angles from its path, and its pose from wheel angles.


# Number of nodes of the Gauss–Legendre rule in one piece of a spline; the result is exact up to rounding unless the
# base turns by radians within a piece.
NODES = 8


def wheel_angles(base: MobileBase, motion: Array) -> Array:
    """Return angles of the left and right wheel [rad] after a distance ahead [m] and a turn [rad], (T, 2) → (T, 2)."""
    distance, half = motion[:, 0], 0.5 * base.track * motion[:, 1]
    return np.stack([distance - half, distance + half], axis=1) / base.wheel_radius


def rolled(base: MobileBase, start: Array, coefficients: Array, spacing: float, pieces: int = 1) -> Array:
    """Return the position of a base whose wheels follow splines without slip, in the frame of its joint [m].

    Parameters
    ----------
    base : MobileBase
        The base.
    start : (2,) ndarray
        x and y at the start of the splines [m].
    coefficients : (segments, 2, 6) ndarray
        Ascending powers of the angles of the left and the right wheel [rad].
    spacing : float
        Length of the segments [s].
    pieces : int, optional
        Equal parts of a segment; x and y are returned at their ends.

    Returns
    -------
    (segments, pieces + 1, 2) ndarray
        Positions [m]; the end of a segment is the start of the next.
    """
    h = spacing / pieces
    begins = np.broadcast_to(h * np.arange(pieces), (len(coefficients), pieces))
    steps = _steps(base, coefficients, begins, np.full(len(coefficients), h)).reshape(-1, 2)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) + start
    return places[pieces * np.arange(len(coefficients))[:, None] + np.arange(pieces + 1)]


def coordinates(base: MobileBase, start: Array, coefficients: Array, spacing: float, times: Array) -> Array:
    """Return wheel angles [rad], x and y [m] at times [s] since the start of the splines, (T,) → (T, 4); see
    :func:`rolled`.

    Before and after the splines all values are constant.
    """
    count = len(coefficients)
    knots = rolled(base, start, coefficients, spacing)[:, 0]
    times = np.clip(times, 0.0, count * spacing)
    segment = np.minimum((times / spacing).astype(int), count - 1)
    # Rounding may place a time slightly before the start of its segment.
    within = np.maximum(times - segment * spacing, 0.0)
    angles = np.einsum("swc,sc->sw", coefficients[segment], within[:, None] ** np.arange(6))
    steps = _steps(base, coefficients[segment], np.zeros((len(times), 1)), within)
    return np.hstack([angles, knots[segment] + steps[:, 0]])


def _steps(base: MobileBase, coefficients: Array, begins: Array, lengths: Array) -> Array:
    """Return the displacements, (s, p, 2) [m], over times ``lengths``, (s,) [s], from ``begins``, (s, p) [s].

    ``begins`` are times since the start of each segment.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    t = begins[..., None] + 0.5 * lengths[:, None, None] * (1.0 + nodes)
    angles = np.einsum("swc,spgc->spgw", coefficients, t[..., None] ** np.arange(6))
    rates = np.einsum("swc,spgc->spgw", coefficients[..., 1:] * np.arange(1, 6), t[..., None] ** np.arange(5))
    speed = 0.5 * base.wheel_radius * (rates[..., 0] + rates[..., 1])
    heading = base.wheel_radius / base.track * (angles[..., 1] - angles[..., 0])
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1)
    return np.einsum("spgx,g,s->spx", velocity, weights, 0.5 * lengths)
