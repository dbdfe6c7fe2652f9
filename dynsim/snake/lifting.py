"""Lifted wheel pairs of a record as angles of the pitch joints on their axles.

The record has each pair on the ground or off it, 1 or 0; a lift takes time. The height of a pair follows

    eta(t) = clearance s((t - t_up)/blend) s((t_down - t)/blend),   s(u) = 10 u^3 - 15 u^4 + 6 u^5

from the first sample t_up at which it is lifted; it is zero again at t_down, the first at which it is grounded. So a
pair is in the air only while the record has it off the ground. Pitch angles are computed from the heights and the yaw
angles of every sample (:mod:`dynsim.snake.lifting`), before anything moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dynsim.config.base import Positive, StrictConfig
from dynsim.errors import CheckRefused, MissingEntry
from dynsim.record import TIME, Record
from dynsim.record.scene import Scene

# Geometry of a snake (joint axes and limits, head joints, wheels) from the scene of its record.


@dataclass(frozen=True)
class SnakeGeometry:
    """Geometry of a snake.

    Attributes
    ----------
    head_joints : number of joints in the head part; they are the first columns of ``phi``, the joint angles
    pitch : (n_phi,) true where a joint turns about y (pitch), false about z (yaw)
    lower, upper : (n_phi,) limits of the joints [rad]
    wheel_radius : of the first pair [m]
    half_track : (number of wheel pairs,) distance from the middle of an axle to its wheels [m]
    """

    head_joints: int
    pitch: NDArray[np.bool_]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    wheel_radius: float
    half_track: NDArray[np.float64]


def snake_geometry(record: Record) -> SnakeGeometry:
    """Geometry of the snake of a record.

    Raises
    ------
    MissingEntry
        The record has no scene.
    """
    if record.scene is None:
        raise MissingEntry("the record has no scene, which says what the snake is like")
    names = record.labels["phi"]
    joints = {body.joint.name: body.joint for body in record.scene.bodies}
    lower, upper = np.array([[joints[name].lower, joints[name].upper] for name in names], dtype=np.float64).T
    wheels = [wheels_of(record.scene, pair) for pair in record.labels["grounded"]]
    return SnakeGeometry(
        head_joints=len(names) - len(wheels) + 1,
        pitch=np.array([abs(joints[name].axis[1]) > 0.5 for name in names]),
        lower=lower,
        upper=upper,
        wheel_radius=wheels[0][0].radius,
        half_track=np.array([max(wheel.beside for wheel in pair) for pair in wheels]),
    )


class WheelOfPair(NamedTuple):
    """Of a wheel pair: where along its body the axle is, how far beside the middle of the body it is, radius [m]."""

    along: float
    beside: float
    radius: float


def wheels_of(scene: Scene, pair: str) -> list[WheelOfPair]:
    """Wheels on a body: shapes of its own, and bodies that turn on it."""
    index = {body.name: k for k, body in enumerate(scene.bodies)}[pair]
    places = [(shape.position, shape) for shape in scene.bodies[index].shapes]
    places += [(body.joint.position, body.shapes[0]) for body in scene.bodies if body.parent == index and body.shapes]
    return [
        WheelOfPair(position[0], abs(position[1]), shape.size[0]) for position, shape in places if position[1] != 0.0
    ]


# Kinematics of a snake's base part with lifted wheel pairs: pitch angles of plates that are hinged at the axles.


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


Array = NDArray[np.float64]
SAMPLES_PER_BLEND = 20
"""Fewer of them, and the path between two samples is no longer at the heights of the samples."""
TIME_ROUNDING = 1e-9
"""By so much less a time may be than it must [s]."""


class Lifts(StrictConfig):
    """How wheel pairs that the record lifts are lifted.

    Every pair but the last has a pitch joint on its axle. Lifting is added to what these do otherwise; the first, on
    the axle that carries the head, follows the record and keeps the head where it is.
    """

    signal: str = Field(
        "grounded", description="of the record, with 1 where a wheel pair is on the ground, 0 where it is lifted"
    )
    joints: tuple[str, ...] = Field(min_length=1, description="pitch joints on the axles of the first, second, … pair")
    clearance_mm: Positive = Field(5.0, description="height of the lower wheel of a lifted pair above the floor")
    blend_s: Positive = Field(0.3, description="time to lift a pair, and to put it down, in record time")
    tilt_mm: Positive = Field(
        2.5, description="a record is refused where one wheel of a grounded pair would be higher: a bent base twists"
    )


def lifted(record: Record, lifts: Lifts) -> Fold:
    """How the base part of a record is folded at every sample.

    Raises
    ------
    CheckRefused
        No such signal, or it lifts pairs that cannot be lifted, or not for so short a time; with pair and time.
    """
    grounded = grounded_pairs(record, lifts.signal)
    pairs = record.labels[lifts.signal]
    refuse_other_joints(lifts, pairs)
    time = record.time - record.time[0]
    refuse_what_cannot_stand(grounded, pairs, time)
    height = np.column_stack(
        [_height(column, time, lifts, name) for column, name in zip(grounded.T, pairs, strict=True)]
    )
    if not height.any():
        return Fold(np.zeros_like(height[:, 1:]), height, np.zeros_like(height))
    refuse_long_steps(lifts, float(np.diff(time).max()))
    part = base_part(record, pairs)
    return fold_to_heights(part, part.yaw_angles(record), height, lifts, time)


def fold_to_heights(part: BasePart, yaw: Array, height: Array, lifts: Lifts, time: Array) -> Fold:
    """The base part with its pairs at heights above the floor.

    Parameters
    ----------
    yaw : (T, pairs - 1) [rad]
    height : (T, pairs) [m]
    time : (T,) [s], for what is refused

    Raises
    ------
    CheckRefused
        No pitch angles do that, or a pair would stand on one wheel; with pair and time.
    """
    try:
        fold = part.fold(yaw, height)
    except ArithmeticError as lost:
        row, pair = lost.args
        raise CheckRefused(
            f"no pitch angle brings {part.pairs[pair]} to {1e3 * height[row, pair]:g} mm above the floor at "
            f"t = {time[row]:.3f} s"
        ) from None
    _refuse_twist(np.where(height == 0.0, fold.tilt, 0.0), lifts, part.pairs, time)
    return fold


def refuse_other_joints(lifts: Lifts, pairs: tuple[str, ...]) -> None:
    """CheckRefused unless every pair but the last has its pitch joint."""
    if len(lifts.joints) != len(pairs) - 1:
        raise CheckRefused(
            f"lifts.joints names {len(lifts.joints)} pitch joints; the record has {len(pairs)} wheel pairs, with one "
            "on the axle of each but the last"
        )


def refuse_long_steps(lifts: Lifts, step: float) -> None:
    """CheckRefused where samples are too far apart [s] for the path between them."""
    if step * SAMPLES_PER_BLEND > lifts.blend_s:
        raise CheckRefused(
            f"wheels are lifted in blend_s = {lifts.blend_s:g} s, and the record has a sample every {step:g} s: record "
            f"at {SAMPLES_PER_BLEND / lifts.blend_s:.0f} Hz or more, or lift them slower"
        )


def grounded_pairs(record: Record, name: str) -> Array:
    """1 where a pair is on the ground, shape (T, pairs)."""
    if name not in record:
        raise CheckRefused(f"lifts.signal: the record has no {name!r}; it has {', '.join(record)}")
    data = np.asarray(record[name])
    if data.ndim != 2 or record.signals[name].axis != TIME or not np.isin(data, (0, 1)).all():
        raise CheckRefused(f"signal {name!r} must be 0 or 1 for each wheel pair, at the times of the record")
    return data.astype(np.float64)


def refuse_what_cannot_stand(grounded: Array, pairs: tuple[str, ...], time: Array) -> None:
    """CheckRefused where pair 1 is lifted, or all others are; ``grounded`` has the shape (T, pairs)."""
    if not (grounded[:, 0] == 1).all():
        row = int(np.argmin(grounded[:, 0]))
        raise CheckRefused(
            f"{pairs[0]} is lifted at t = {time[row]:.3f} s: it carries the raised head, which would move with it"
        )
    standing = grounded.sum(axis=1)
    if standing.min() < 2:
        row = int(np.argmin(standing))
        raise CheckRefused(f"only {pairs[0]} is on the ground at t = {time[row]:.3f} s: the robot does not stand on it")


def _height(grounded: Array, time: Array, lifts: Lifts, name: str) -> Array:
    """Height of one pair over time, shape (T,) [m]."""
    height = np.zeros_like(time)
    edges = np.flatnonzero(np.diff(grounded, prepend=1.0, append=1.0))
    for first, end in edges.reshape(-1, 2):
        up, down = time[first], time[min(end, len(time) - 1)]
        # What is lifted from the beginning is lifted in the start posture, what is at the end stays so.
        blends = int(first > 0) + int(end < len(time))
        refuse_short_lift(lifts, name, up, down, blends)
        height[first:end] = height_of(
            time[first:end], up if first > 0 else -np.inf, down if end < len(time) else np.inf, lifts
        )
    return height


def refuse_short_lift(lifts: Lifts, name: str, up: float, down: float, blends: int) -> None:
    """CheckRefused where a pair is not lifted for as long as so many blends take; times in [s]."""
    if down - up < blends * lifts.blend_s - TIME_ROUNDING:
        raise CheckRefused(
            f"{name} is lifted for {down - up:.3f} s only, from t = {up:.3f} s on; up and down take "
            f"{blends * lifts.blend_s:g} s (lifts.blend_s)"
        )


def height_of(time: Array, up: Array | float, down: Array | float, lifts: Lifts) -> Array:
    """Height [m] at a time of what is lifted from ``up`` to ``down`` [s]; infinite ones are for ever."""
    since, until = (time - up) / lifts.blend_s, (down - time) / lifts.blend_s
    return 1e-3 * lifts.clearance_mm * _smooth(since) * _smooth(until)


def _smooth(u: Array) -> Array:
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 + u * (-15.0 + 6.0 * u))


def _refuse_twist(tilt: Array, lifts: Lifts, pairs: tuple[str, ...], time: Array) -> None:
    """A grounded pair whose other wheel is high in the air does not roll as the record's kinematics has it."""
    row, pair = np.unravel_index(int(tilt.argmax()), tilt.shape)
    if tilt[row, pair] > 1e-3 * lifts.tilt_mm:
        raise CheckRefused(
            f"{pairs[pair]} would stand on one wheel at t = {time[row]:.3f} s, the other "
            f"{1e3 * tilt[row, pair]:.1f} mm above the floor (lifts.tilt_mm: {lifts.tilt_mm:g}): the axles before it "
            "do not meet in one point, so that one between them cannot be lifted without a twist. Less clearance, or a "
            "base that is bent less"
        )
