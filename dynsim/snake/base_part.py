"""The part of a snake that stands on its wheels, folded along its axles.

Between two axles there are two links and a yaw joint, whose axis is normal to both: a segment is a flat plate, whatever
its yaw angle. A pitch joint turns about the axle it sits on, so the base part is a strip of plates hinged at its axles.
With R_j the attitude of the plate behind axle j, a_j and b_j its links before and behind its yaw joint theta_j,

    R_j = R_(j-1) Rz(theta_(j-1)) Ry(psi_j),     R_1 = Ry(psi_1)
    p_(j+1) = p_j - R_j (a_j e_x + b_j Rz(theta_j) e_x),     y_(j+1) = R_j Rz(theta_j) e_y

and the wheel beside axle j at s h_j (s = +1 left, -1 right), a thin disc of radius r, is above the floor by

    z_j + s h_j e_z.y_j - r sqrt(1 - (e_z.y_j)^2)

psi_j alone sets the height of axle j+1, given all before. Going tailward, every psi_j is the smallest that leaves no
wheel of pair j+1 below the height asked for: the lower one is exactly there. Pair 1 stays flat on the floor; its pitch
joint takes psi_1 back from the head's side, so that the head does not move.

Both wheels of a grounded pair are on the floor only where the strip folds without a twist. A line on a plate meets the
axle before it in a point that stays where it is when the plate turns about that axle. With one axle lifted between two
on the floor, the lifted one passes through its meeting points with both, and lies on the floor with them, unless the
three axles meet in one point or are parallel (a straight base, or one bent in an arc). Otherwise one wheel of the next
pair stays above the floor by :attr:`Fold.tilt`, whatever the pitch angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import CheckRefused
from dynsim.record import Record
from dynsim.snake.geometry import wheels_of

Array = NDArray[np.float64]
NEWTON_STEPS = 12
CONVERGED = 1e-9
"""Last Newton step of a pitch angle [rad]; a wheel is then at its height to 2e-10 m."""


@dataclass(frozen=True)
class Fold:
    """A folded base part at T instants.

    Attributes
    ----------
    hinge : array, shape (T, pairs - 1)
        Angles of the pitch joints on the axles of pair 1, 2, ... [rad].
    lower, tilt : array, shape (T, pairs)
        Height of the lower wheel of every pair above the floor, and of the other above it [m].
    """

    hinge: Array
    lower: Array
    tilt: Array


@dataclass(frozen=True)
class BasePart:
    """Lengths of the base part [m] and the columns of the joint angles that bend it.

    Attributes
    ----------
    pairs : tuple of str
        Names of the wheel pairs, from the head tailward.
    before, behind : array, shape (pairs - 1,)
        Axle to yaw joint, and yaw joint to the next axle.
    half_track : array, shape (pairs,)
        Middle of the axle to either wheel.
    radius : float
        Of the wheels.
    signal, yaw : str, tuple of str
        Signal of the record and its columns with the yaw angles between the axles.
    """

    pairs: tuple[str, ...]
    before: Array
    behind: Array
    half_track: Array
    radius: float
    signal: str
    yaw: tuple[str, ...]

    def yaw_angles(self, record: Record) -> Array:
        """Shape (T, pairs - 1) [rad]."""
        columns = [record.labels[self.signal].index(name) for name in self.yaw]
        return np.asarray(record[self.signal][:, columns], dtype=np.float64)

    def fold(self, yaw: Array, height: Array) -> Fold:
        """Pitch angles with the lower wheel of every pair at a height above the floor.

        Parameters
        ----------
        yaw : (T, pairs - 1) [rad]
        height : (T, pairs) [m], 0 for pair 1

        Raises
        ------
        ArithmeticError
            No angle brings a pair to its height; the arguments are the instant's index and the pair's.
        """
        count = len(yaw)
        hinge, lower, tilt = np.zeros_like(yaw), np.zeros_like(height), np.zeros_like(height)
        up = np.tile([0.0, 0.0, 1.0], (count, 1))  # e_z in the frame of the plate
        z = np.full(count, self.radius)
        for j in range(len(self.pairs) - 1):
            cos, sin, zero = np.cos(yaw[:, j]), np.sin(yaw[:, j]), np.zeros(count)
            reach = np.column_stack([-self.before[j] - self.behind[j] * cos, -self.behind[j] * sin, zero])
            axle = np.column_stack([-sin, cos, zero])
            rise, slope, half = _turned(up, reach), _turned(up, axle), self.half_track[j + 1]
            needed = self._angle(z - height[:, j + 1], rise, slope, np.array([[half], [-half]]))
            hinge[:, j] = psi = needed.max(axis=0)
            if not np.isfinite(psi).all():
                raise ArithmeticError(int(np.flatnonzero(~np.isfinite(psi))[0]), j + 1)
            z = z + _at(rise, psi)
            incline = _at(slope, psi)
            tilt[:, j + 1] = 2.0 * half * np.abs(incline)
            lower[:, j + 1] = z - 0.5 * tilt[:, j + 1] - self.radius * np.sqrt(1.0 - incline**2)
            c, s = np.cos(psi), np.sin(psi)
            x, y, up_z = c * up[:, 0] - s * up[:, 2], up[:, 1], s * up[:, 0] + c * up[:, 2]  # Ry(psi)^T up
            up = np.column_stack([cos * x + sin * y, cos * y - sin * x, up_z])  # Rz(theta)^T
        return Fold(hinge, lower, tilt)

    def _angle(self, above: Array, rise: tuple[Array, ...], slope: tuple[Array, ...], lever: Array) -> Array:
        """psi where above + rise + lever slope - r sqrt(1 - slope^2) = 0, by Newton's method; NaN where it is lost.

        For several levers, shape (M, 1): shape (M, T).
        """
        psi = np.zeros((len(lever), len(above)))
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                incline, rate = _at(slope, psi), _rate(slope, psi)
                disc = np.sqrt(1.0 - incline**2)
                value = above + _at(rise, psi) + lever * incline - self.radius * disc
                step = value / (_rate(rise, psi) + lever * rate + self.radius * incline * rate / disc)
                psi = psi - step
                # The next one would be of its square.
                if (np.abs(step) < CONVERGED).all():
                    break
        return np.where(np.abs(step) < CONVERGED, psi, np.nan)


def _turned(up: Array, vector: Array) -> tuple[Array, ...]:
    """Coefficients of 1, cos psi and sin psi in up . Ry(psi) vector."""
    (ux, uy, uz), (x, y, z) = up.T, vector.T
    return uy * y, ux * x + uz * z, ux * z - uz * x


def _at(coefficients: tuple[Array, ...], psi: Array) -> Array:
    constant, cosine, sine = coefficients
    return constant + cosine * np.cos(psi) + sine * np.sin(psi)


def _rate(coefficients: tuple[Array, ...], psi: Array) -> Array:
    _, cosine, sine = coefficients
    return sine * np.cos(psi) - cosine * np.sin(psi)


def base_part(record: Record, pairs: tuple[str, ...]) -> BasePart:
    """The base part of the snake of a record, from its scene.

    Raises
    ------
    CheckRefused
        There is no scene, or it is not that of a chain of wheel pairs on yaw joints.
    """
    scene = record.scene
    if scene is None:
        raise CheckRefused("the record has no scene to take the robot's lengths from: simulate again")
    index = {body.name: k for k, body in enumerate(scene.bodies)}
    missing = [name for name in pairs if name not in index]
    if missing or len(pairs) < 2:
        raise CheckRefused(f"the record's scene has no wheel pair {', '.join(missing)}; {len(pairs)} are in the record")
    bodies = [scene.bodies[index[name]] for name in pairs]
    # Between a pair and the yaw joint behind it there may be a pitch joint on the axle, with a body of its own.
    plates = [scene.bodies[body.parent] for body in bodies[1:]]
    plates = [plate if plate.joint.axis == (0.0, 1.0, 0.0) else None for plate in plates]
    for ahead, body, plate in zip(pairs, bodies[1:], plates, strict=False):
        joint = body.joint
        parent = body.parent if plate is None else plate.parent
        if joint.kind != "revolute" or joint.axis != (0.0, 0.0, 1.0) or parent != index[ahead]:
            raise CheckRefused(f"{body.name} is not behind {ahead} on a yaw joint: its wheels cannot be lifted")
    wheels = [wheels_of(scene, name) for name in pairs]
    if bare := [name for name, on_body in zip(pairs, wheels, strict=True) if not on_body]:
        raise CheckRefused(f"the record's scene has no wheels on {bare[0]}")
    axle = np.array([on_body[0].along for on_body in wheels])
    joints = np.array([body.joint.position[0] for body in bodies[1:]])
    joints += [0.0 if plate is None else plate.joint.position[0] for plate in plates]
    return BasePart(
        pairs=pairs,
        before=axle[:-1] - joints,
        behind=-axle[1:],
        half_track=np.array([on_body[0].beside for on_body in wheels]),
        radius=wheels[0][0].radius,
        signal=bodies[1].joint.signal,
        yaw=tuple(body.joint.labels[0] for body in bodies[1:]),
    )
