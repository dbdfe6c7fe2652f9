"""Smooth plane curves through points, as paths of a base with two driven wheels.

This module imports scipy, so only the base paths that need scipy import this module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BPoly, CubicSpline, PchipInterpolator

from dynsim.errors import ModelError
from dynsim.model.base_pose import base_row
from dynsim.model.description import Robot

Array = NDArray[np.float64]

# Rotation of the tangent between two samples [rad] above which a curve has a corner, which a base cannot follow.
JUMP = 0.2
# Maximum distance of the first point from the start of the base [m].
START_TOLERANCE = 1e-6
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


def seen_from_start(robot: Robot, points: ArrayLike, frame: str) -> Array:
    """Return points in the frame of the robot's mobile base at its start, x ahead, (N, 2) [m].

    ``frame`` is the frame of the input: "start" (no change) or "world".
    """
    rows = np.asarray(points, dtype=np.float64)
    if frame == "start":
        return rows
    # The coordinates of the base are zero at the start, so it is at the frame of its joint.
    _, joint = base_row(robot)
    return (rows - joint.p_PJ[:2]) @ joint.R_PJ[:2, :2]


class PlaneCurve:
    """Cubic spline r(u) through points that starts along +x; u is the distance along the chords.

    Parameters
    ----------
    points : (N, 2) ndarray
        Points [m]. The first must be at the origin, and consecutive points must differ.
    names : list of str
        Point names with position and time, for messages.
    start_limit : float
        Maximum angle between +x and the first chord [rad].
    turn_limit : float
        Maximum angle between neighbouring chords [rad].
    samples : int
        Samples of the tangent between two points, to detect jumps.

    Raises
    ------
    ModelError
        If the curve does not start at the origin, starts sideways, or has a corner; the message contains the point.
    """

    def __init__(self, points: Array, names: list[str], start_limit: float, turn_limit: float, samples: int) -> None:
        if not np.hypot(*points[0]) <= START_TOLERANCE:
            raise ModelError(
                f"{names[0]} is {np.hypot(*points[0]):.4g} m from the start of the base; start the path at the base"
            )
        chords = np.diff(points, axis=0)
        lengths = np.hypot(*chords.T)
        angles = np.arctan2(chords[:, 1], chords[:, 0])
        first = abs(float(angles[0]))
        if first >= start_limit:
            raise ModelError(
                f"{names[1]} is {np.rad2deg(first):.4g}° off the initial heading (limit "
                f"{np.rad2deg(start_limit):.4g}°); a two-wheeled base cannot move sideways: "
                "change the heading or the path"
            )
        turns = np.abs((np.diff(angles) + np.pi) % (2.0 * np.pi) - np.pi)
        if (turns >= turn_limit).any():
            _refuse_corner(names[1 + int(turns.argmax())], float(turns.max()))
        self.nodes = np.concatenate([[0.0], np.cumsum(lengths)])
        if not (np.diff(self.nodes) > 0.0).all():
            short = names[1 + int(np.argmin(np.diff(self.nodes)))]
            raise ModelError(f"{short} is too close to the previous point for a path of this length; remove it")
        spline = CubicSpline(self.nodes, points, bc_type=((1, np.array([1.0, 0.0])), (2, np.zeros(2))))
        self._tangent = spline.derivative()
        # Tangent angle and arc length at samples, from which `motion` continues both.
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
        """Return length of the curve [m] and rotation of its tangent [rad] from its start to u, (T,) → (T, 2)."""
        cell = np.clip(np.searchsorted(self._u, u, side="right") - 1, 0, len(self._u) - 2)
        near, angle = self._turn[cell], self._angle(u)
        turn = angle + 2.0 * np.pi * np.round((near - angle) / (2.0 * np.pi))
        return np.stack([self._length[cell] + self._between(self._u[cell], u), turn], axis=1)

    def _angle(self, u: Array) -> Array:
        x, y = self._tangent(u).T
        return np.asarray(np.arctan2(y, x))

    def _between(self, a: Array, b: Array) -> Array:
        """Return the length from a to b, within one sample."""
        half = 0.5 * (b - a)
        slopes = self._tangent(a[:, None] + half[:, None] * (1.0 + _NODES))
        return np.asarray(half * (np.hypot(slopes[..., 0], slopes[..., 1]) @ _WEIGHTS))


@dataclass(frozen=True)
class AlongCurve:
    """A base path along a curve r(u), where u is a piecewise polynomial of time."""

    curve: PlaneCurve
    way: BPoly | PchipInterpolator

    def motion(self, t: Array) -> Array:
        """Return distance [m] and rotation [rad] at times t [s], (T, 2)."""
        return self.curve.motion(np.clip(self.way(np.clip(t, *self.way.x[[0, -1]])), 0.0, self.curve.nodes[-1]))


def _refuse_corner(name: str, turn: float) -> None:
    raise ModelError(
        f"corner at {name}: the heading would have to turn by {np.rad2deg(turn):.3g}° instantly, which a two-wheeled "
        "base cannot do; round off the corner"
    )
