"""Kinematics of a snake's base part with lifted wheel pairs: pitch angles of plates that are hinged at the axles.

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

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import CheckRefused
from dynsim.record import Record
from dynsim.snake.geometry import wheels_of

Array = NDArray[np.float64]
Coefficients = tuple[float, float, float]
NEWTON_STEPS = 12
FLAT = 1e-12
"""A height that changes by less with a pitch angle cannot be reached by it [m]."""
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
        hinge, lower, tilt = np.zeros_like(yaw), np.zeros_like(height), np.zeros_like(height)
        before, behind, half_track = self.before.tolist(), self.behind.tolist(), self.half_track.tolist()
        for row in range(len(yaw)):
            ux, uy, uz = 0.0, 0.0, 1.0  # e_z in the frame of the plate
            z = self.radius
            for j, (angle, above) in enumerate(zip(yaw[row].tolist(), height[row, 1:].tolist(), strict=True)):
                cos, sin, half = math.cos(angle), math.sin(angle), half_track[j + 1]
                x, y = -before[j] - behind[j] * cos, -behind[j] * sin
                # Coefficients of 1, cos psi, sin psi in up . Ry(psi) vector: the way to the next axle, and that axle.
                rise, slope = (uy * y, ux * x, -uz * x), (uy * cos, -ux * sin, uz * sin)
                needed = [self._angle(z - above, rise, slope, lever) for lever in (half, -half)]
                if any(map(math.isnan, needed)):
                    raise ArithmeticError(row, j + 1)
                psi = max(needed)
                c, s = math.cos(psi), math.sin(psi)
                z += rise[0] + rise[1] * c + rise[2] * s
                incline = slope[0] + slope[1] * c + slope[2] * s
                hinge[row, j], tilt[row, j + 1] = psi, 2.0 * half * abs(incline)
                lower[row, j + 1] = z - half * abs(incline) - self.radius * math.sqrt(1.0 - incline**2)
                x, uz = c * ux - s * uz, s * ux + c * uz  # Ry(psi)^T up, then Rz(theta)^T of it
                ux, uy = cos * x + sin * uy, cos * uy - sin * x
        return Fold(hinge, lower, tilt)

    def _angle(self, above: float, rise: Coefficients, slope: Coefficients, lever: float) -> float:
        """psi where above + rise + lever slope - r sqrt(1 - slope^2) = 0, by Newton's method; NaN where it is lost."""
        psi = 0.0
        for _ in range(NEWTON_STEPS):
            c, s = math.cos(psi), math.sin(psi)
            incline, rate = slope[0] + slope[1] * c + slope[2] * s, slope[2] * c - slope[1] * s
            if not abs(incline) < 1.0:
                break
            disc = math.sqrt(1.0 - incline**2)
            change = rise[2] * c - rise[1] * s + lever * rate + self.radius * incline * rate / disc
            if not abs(change) > FLAT:
                break
            step = (above + rise[0] + rise[1] * c + rise[2] * s + lever * incline - self.radius * disc) / change
            psi -= step
            # The next one would be of its square.
            if abs(step) < CONVERGED:
                return psi
        return math.nan


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
