"""A smooth plane curve through points, heading along its tangent, for a base with two driven wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BPoly, CubicSpline, PchipInterpolator

from dynsim.dynamics.banded import solve_banded
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.base_pose import base_row
from dynsim.model.description import Robot
from dynsim.model.mobile_base import MobileBase

Array = NDArray[np.float64]

# A turn of the tangent between two samples that counts as a corner, which no base follows [rad].
JUMP = 0.2
# A first point this far off the base's start is refused [m].
START_TOLERANCE = 1e-6
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


def seen_from_start(robot: Robot, points: ArrayLike, frame: str) -> Array:
    """Points in the frame of the robot's mobile base at its start, x ahead, (N, 2) [m].

    ``frame`` : "start", that they are in already, or "world"
    """
    rows = np.asarray(points, dtype=np.float64)
    if frame == "start":
        return rows
    # The coordinates of the base are zero at the start, so it stands in the frame of its joint.
    _, joint = base_row(robot)
    return (rows - joint.p_PJ[:2]) @ joint.R_PJ[:2, :2]


class PlaneCurve:
    """Cubic spline r(u) through points, u the distance along their chords, that leaves the first one along +x.

    Parameters
    ----------
    points : (N, 2) no two neighbours equal, the first at the origin [m]
    names : of the points, with place and time, for messages
    start_limit, turn_limit : largest angle between +x and the first chord, and between neighbouring chords [rad]
    samples : of the tangent between two points, to find where it jumps

    Raises
    ------
    ModelError
        It does not begin at the origin, leaves it sideways, or has a corner: with the point where.
    """

    def __init__(self, points: Array, names: list[str], start_limit: float, turn_limit: float, samples: int) -> None:
        if not np.hypot(*points[0]) <= START_TOLERANCE:
            raise ModelError(f"{names[0]} is {np.hypot(*points[0]):.4g} m from where the base starts; begin there")
        chords = np.diff(points, axis=0)
        lengths = np.hypot(*chords.T)
        angles = np.arctan2(chords[:, 1], chords[:, 0])
        first = abs(float(angles[0]))
        if first >= start_limit:
            raise ModelError(
                f"{names[1]} lies {np.rad2deg(first):.4g}° off the heading at the start (limit "
                f"{np.rad2deg(start_limit):.4g}°): a base on two driven wheels cannot move sideways; "
                "turn its heading, or change the path"
            )
        turns = np.abs((np.diff(angles) + np.pi) % (2.0 * np.pi) - np.pi)
        if (turns >= turn_limit).any():
            _refuse_corner(names[1 + int(turns.argmax())], float(turns.max()))
        self.nodes = np.concatenate([[0.0], np.cumsum(lengths)])
        if not (np.diff(self.nodes) > 0.0).all():
            short = names[1 + int(np.argmin(np.diff(self.nodes)))]
            raise ModelError(f"{short} is too near the point before it, beside the length of the path")
        spline = CubicSpline(self.nodes, points, bc_type=((1, np.array([1.0, 0.0])), (2, np.zeros(2))))
        self._tangent = spline.derivative()
        # Tangent's angle and the length so far, at samples from which both are continued.
        parts = np.arange(samples) / samples
        self._u = np.append((self.nodes[:-1, None] + lengths[:, None] * parts).ravel(), self.nodes[-1])
        steps = np.diff(self._angle(self._u))
        steps = (steps + np.pi) % (2.0 * np.pi) - np.pi
        if np.abs(steps).max() > JUMP:
            worst = int(np.abs(steps).argmax())
            _refuse_corner(names[int(np.abs(self.nodes - self._u[worst]).argmin())], float(abs(steps[worst])))
        self._turn = np.concatenate([[0.0], np.cumsum(steps)])
        self._length = np.concatenate([[0.0], np.cumsum(self._between(self._u[:-1], self._u[1:]))])

    def motion(self, u: Array) -> Array:
        """Length of the curve [m] and turn of its tangent [rad] from its begin to u, (T,) → (T, 2)."""
        cell = np.clip(np.searchsorted(self._u, u, side="right") - 1, 0, len(self._u) - 2)
        near, angle = self._turn[cell], self._angle(u)
        turn = angle + 2.0 * np.pi * np.round((near - angle) / (2.0 * np.pi))
        return np.stack([self._length[cell] + self._between(self._u[cell], u), turn], axis=1)

    def _angle(self, u: Array) -> Array:
        x, y = self._tangent(u).T
        return np.asarray(np.arctan2(y, x))

    def _between(self, a: Array, b: Array) -> Array:
        """Length from a to b, within one sample."""
        half = 0.5 * (b - a)
        slopes = self._tangent(a[:, None] + half[:, None] * (1.0 + _NODES))
        return np.asarray(half * (np.hypot(slopes[..., 0], slopes[..., 1]) @ _WEIGHTS))


@dataclass(frozen=True)
class AlongCurve:
    """A base path along a curve r(u), with u as piecewise polynomials of time."""

    curve: PlaneCurve
    way: BPoly | PchipInterpolator

    def motion(self, t: Array) -> Array:
        """Distance [m] and turn [rad] at times t [s], (T, 2)."""
        return self.curve.motion(np.clip(self.way(np.clip(t, *self.way.x[[0, -1]])), 0.0, self.curve.nodes[-1]))


def _refuse_corner(name: str, turn: float) -> None:
    raise ModelError(
        f"a corner at {name}: the heading would have to turn by {np.rad2deg(turn):.3g}° at once, which no base on two "
        "driven wheels follows; round it off"
    )


# Spline interpolation of samples (quintic, cubic), and the minimum-jerk motion from rest to rest.


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


# Kinematics of a base on two driven wheels: wheel angles from its path, and its pose from wheel angles.


# Of the Gauss–Legendre rule within one piece of a spline: exact to rounding unless it turns by radians in a piece.
NODES = 8


def wheel_angles(base: MobileBase, motion: Array) -> Array:
    """Angles of the left and the right wheel [rad] after a distance ahead [m] and a turn [rad], (T, 2) → (T, 2)."""
    distance, half = motion[:, 0], 0.5 * base.track * motion[:, 1]
    return np.stack([distance - half, distance + half], axis=1) / base.wheel_radius


def rolled(base: MobileBase, start: Array, coefficients: Array, spacing: float, pieces: int = 1) -> Array:
    """Where a base comes whose wheels turn as splines say, without slip, in the axes of the frame of its joint [m].

    Parameters
    ----------
    start : (2,) x and y where the splines begin [m]
    coefficients : (segments, 2, 6) ascending powers of the angles of the left and the right wheel [rad]
    spacing : of the segments [s]
    pieces : equal parts of a segment, at whose ends x and y are given

    Returns
    -------
    array, shape (segments, pieces + 1, 2) [m]; the end of a segment is the begin of the next
    """
    h = spacing / pieces
    begins = np.broadcast_to(h * np.arange(pieces), (len(coefficients), pieces))
    steps = _steps(base, coefficients, begins, np.full(len(coefficients), h)).reshape(-1, 2)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) + start
    return places[pieces * np.arange(len(coefficients))[:, None] + np.arange(pieces + 1)]


def coordinates(base: MobileBase, start: Array, coefficients: Array, spacing: float, times: Array) -> Array:
    """Wheel angles [rad], x and y [m] at times [s] since the splines begin, (T,) → (T, 4); see :func:`rolled`.

    Before and after the splines everything stays where they begin and end.
    """
    count = len(coefficients)
    knots = rolled(base, start, coefficients, spacing)[:, 0]
    times = np.clip(times, 0.0, count * spacing)
    segment = np.minimum((times / spacing).astype(int), count - 1)
    # Rounding may take a time into the segment before its own.
    within = np.maximum(times - segment * spacing, 0.0)
    angles = np.einsum("swc,sc->sw", coefficients[segment], within[:, None] ** np.arange(6))
    steps = _steps(base, coefficients[segment], np.zeros((len(times), 1)), within)
    return np.hstack([angles, knots[segment] + steps[:, 0]])


def _steps(base: MobileBase, coefficients: Array, begins: Array, lengths: Array) -> Array:
    """Ways from ``begins``, (s, p) [s] since each of the segments does, in ``lengths``, (s,) [s], (s, p, 2) [m]."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    t = begins[..., None] + 0.5 * lengths[:, None, None] * (1.0 + nodes)
    angles = np.einsum("swc,spgc->spgw", coefficients, t[..., None] ** np.arange(6))
    rates = np.einsum("swc,spgc->spgw", coefficients[..., 1:] * np.arange(1, 6), t[..., None] ** np.arange(5))
    speed = 0.5 * base.wheel_radius * (rates[..., 0] + rates[..., 1])
    heading = base.wheel_radius / base.track * (angles[..., 1] - angles[..., 0])
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1)
    return np.einsum("spgx,g,s->spx", velocity, weights, 0.5 * lengths)
