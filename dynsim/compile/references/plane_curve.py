"""A smooth plane curve through points, heading along its tangent, for a base with two driven wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BPoly, CubicSpline, PchipInterpolator

from dynsim.errors import ModelError
from dynsim.model.base_pose import base_row
from dynsim.model.description import Robot

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
