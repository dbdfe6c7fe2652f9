"""Lifting of wheel pairs: geometry of a snake from its record, and pitch angles that lift the pairs.

A record contains 1 for each pair on the ground and 0 for each lifted pair, but lifting takes time. The height of a pair
is

    eta(t) = clearance s((t - t_up)/blend) s((t_down - t)/blend),   s(u) = 10 u^3 - 15 u^4 + 6 u^5

from the first sample t_up at which it is lifted to the first sample t_down at which it is grounded again. A pair is
thus in the air only while it is lifted in the record. The pitch angles follow from the heights and yaw angles of each
sample and are computed before any motion starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dynsim.config.base import Positive, StrictConfig
from dynsim.errors import CheckRefused, MissingEntry
from dynsim.record import TIME, Record
from dynsim.record.scene import Scene

# Geometry of a snake, from the scene of its record.


@dataclass(frozen=True)
class SnakeGeometry:
    """Geometry of a snake.

    Attributes
    ----------
    head_joints : int
        Number of joints of the head part, the first columns of the joint angles ``phi``.
    pitch : (n_phi,) ndarray of bool
        True for pitch joints (about y), False for yaw joints (about z).
    lower, upper : (n_phi,) ndarray
        Joint limits [rad].
    wheel_radius : float
        Wheel radius of the first pair [m].
    half_track : (pairs,) ndarray
        Distance from the middle of an axle to its wheels [m].
    """

    head_joints: int
    pitch: NDArray[np.bool_]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    wheel_radius: float
    half_track: NDArray[np.float64]


def snake_geometry(record: Record) -> SnakeGeometry:
    """Return the geometry of the snake in a record.

    Raises
    ------
    MissingEntry
        If the record has no scene.
    """
    if record.scene is None:
        raise MissingEntry("the record has no scene with the geometry of the snake; simulate again")
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
    """Position of a wheel along its body, its lateral distance from the middle of the body, and its radius [m]."""

    along: float
    beside: float
    radius: float


def wheels_of(scene: Scene, pair: str) -> list[WheelOfPair]:
    """Return the wheels of a wheel pair's body: shapes of the body itself, and bodies that rotate on it."""
    index = {body.name: k for k, body in enumerate(scene.bodies)}[pair]
    places = [(shape.position, shape) for shape in scene.bodies[index].shapes]
    places += [(body.joint.position, body.shapes[0]) for body in scene.bodies if body.parent == index and body.shapes]
    return [
        WheelOfPair(position[0], abs(position[1]), shape.size[0]) for position, shape in places if position[1] != 0.0
    ]


# Kinematics of the base part with lifted wheel pairs: pitch angles of the plates that are hinged at the axles.


@dataclass(frozen=True)
class Fold:
    """Base part folded about its axles, at T instants.

    Attributes
    ----------
    hinge : (T, pairs - 1) ndarray
        Angles of the pitch joints on the axles of pair 1, 2, ... [rad].
    lower : (T, pairs) ndarray
        Height of the lower wheel of each pair above the floor [m].
    tilt : (T, pairs) ndarray
        Height of the other wheel above the lower wheel [m].
    """

    hinge: Array
    lower: Array
    tilt: Array


@dataclass(frozen=True)
class BasePart:
    """Lengths of the base part, and the columns of a record that contain its yaw angles.

    Attributes
    ----------
    pairs : tuple of str
        Names of the wheel pairs, from head to tail.
    before, behind : (pairs - 1,) ndarray
        Distance from an axle to the yaw joint behind it, and from this joint to the next axle [m].
    half_track : (pairs,) ndarray
        Distance from the middle of the axle to a wheel [m].
    radius : float
        Radius of the wheels [m].
    signal : str
        Signal of the record with the yaw angles between the axles.
    yaw : tuple of str
        Columns of this signal.
    """

    pairs: tuple[str, ...]
    before: Array
    behind: Array
    half_track: Array
    radius: float
    signal: str
    yaw: tuple[str, ...]

    def yaw_angles(self, record: Record) -> Array:
        """Return the yaw angles between the axles, shape (T, pairs - 1) [rad]."""
        columns = [record.labels[self.signal].index(name) for name in self.yaw]
        return np.asarray(record[self.signal][:, columns], dtype=np.float64)

    def fold(self, yaw: Array, height: Array) -> Fold:
        """Compute the pitch angles that put the lower wheel of each pair at its height above the floor.

        Parameters
        ----------
        yaw : (T, pairs - 1) ndarray
            Yaw angles [rad].
        height : (T, pairs) ndarray
            Heights [m]; 0 for pair 1.

        Raises
        ------
        ArithmeticError
            If a height is out of reach; the exception's arguments are the indices of the instant and of the pair.
        """
        # Imported here because the commands for servos must not import numba.
        from dynsim.jit.kernel import reals
        from dynsim.snake.fold import fold_rows

        hinge, lower, tilt = np.zeros(yaw.shape), np.zeros(height.shape), np.zeros(height.shape)
        arrays = map(reals, (self.before, self.behind, self.half_track, yaw, height))
        row, pair = fold_rows(*arrays, float(self.radius), hinge, lower, tilt)
        if pair > 0:
            raise ArithmeticError(row, pair)
        return Fold(hinge, lower, tilt)


def base_part(record: Record, pairs: tuple[str, ...]) -> BasePart:
    """Return the base part of the snake in a record, from its scene.

    Raises
    ------
    CheckRefused
        If the record has no scene, or its robot is not a chain of wheel pairs on yaw joints.
    """
    scene = record.scene
    if scene is None:
        raise CheckRefused("the record has no scene with the lengths of the robot; simulate again")
    index = {body.name: k for k, body in enumerate(scene.bodies)}
    missing = [name for name in pairs if name not in index]
    if missing or len(pairs) < 2:
        raise CheckRefused(
            f"the record's scene has no wheel pair {', '.join(missing)} (wheel pairs in the record: {len(pairs)})"
        )
    bodies = [scene.bodies[index[name]] for name in pairs]
    # A pitch joint on the axle may carry a separate body between a pair and the yaw joint behind it.
    plates = [scene.bodies[body.parent] for body in bodies[1:]]
    plates = [plate if plate.joint.axis == (0.0, 1.0, 0.0) else None for plate in plates]
    for ahead, body, plate in zip(pairs, bodies[1:], plates, strict=False):
        joint = body.joint
        parent = body.parent if plate is None else plate.parent
        if joint.kind != "revolute" or joint.axis != (0.0, 0.0, 1.0) or parent != index[ahead]:
            raise CheckRefused(f"{body.name} is not behind {ahead} on a yaw joint, so its wheels cannot be lifted")
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


# Heights and pitch angles of a record.


Array = NDArray[np.float64]
# Minimum number of samples per blend; with fewer samples, the path between two samples would deviate from their
# heights.
SAMPLES_PER_BLEND = 20
# Tolerance of comparisons between times [s].
TIME_ROUNDING = 1e-9


class Lifts(StrictConfig):
    """Options for lifting the wheel pairs that are lifted in a record.

    All pairs except the last have a pitch joint on the axle. Lifting adds to the angles of these joints; the first
    joint, on the axle that carries the head, follows the record and keeps the head in place.
    """

    signal: str = Field(
        "grounded", description="recorded signal that is 1 for wheel pairs on the ground and 0 for lifted pairs"
    )
    joints: tuple[str, ...] = Field(min_length=1, description="pitch joints on the axles of the first, second, … pair")
    clearance_mm: Positive = Field(5.0, description="height of the lower wheel of a lifted pair above the floor")
    blend_s: Positive = Field(0.3, description="time to lift or lower a pair, in record time")
    tilt_mm: Positive = Field(
        2.5,
        description="maximum height difference between the wheels of a grounded pair, due to the twist of a bent base; "
        "a larger difference is an error",
    )


def lifted(record: Record, lifts: Lifts) -> Fold:
    """Compute how the base part of a record is folded at each sample.

    Raises
    ------
    CheckRefused
        If the signal does not exist, a pair cannot be lifted, or a lift is too short. The message contains the pair and
        the time.
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
    """Fold the base part so that its pairs are at heights above the floor.

    Parameters
    ----------
    part : BasePart
        Lengths of the base part.
    yaw : (T, pairs - 1) ndarray
        Yaw angles between the axles [rad].
    height : (T, pairs) ndarray
        Heights of the pairs [m].
    lifts : Lifts
        Options for lifting.
    time : (T,) ndarray
        Times [s], for error messages.

    Raises
    ------
    CheckRefused
        If a height is out of reach, or a pair would stand on one wheel. The message contains the pair and the time.
    """
    try:
        fold = part.fold(yaw, height)
    except ArithmeticError as lost:
        row, pair = lost.args
        raise CheckRefused(
            f"{part.pairs[pair]} cannot reach {1e3 * height[row, pair]:g} mm above the floor with any pitch angle at "
            f"t = {time[row]:.3f} s"
        ) from None
    _refuse_twist(np.where(height == 0.0, fold.tilt, 0.0), lifts, part.pairs, time)
    return fold


def refuse_other_joints(lifts: Lifts, pairs: tuple[str, ...]) -> None:
    """Raise CheckRefused unless every pair except the last has a pitch joint."""
    if len(lifts.joints) != len(pairs) - 1:
        raise CheckRefused(
            f"lifts.joints must list {len(pairs) - 1} pitch joints, one for each of the record's {len(pairs)} wheel "
            f"pairs except the last; got {len(lifts.joints)}"
        )


def refuse_long_steps(lifts: Lifts, step: float) -> None:
    """Raise CheckRefused if the sampling interval [s] is too long for the path between two samples."""
    if step * SAMPLES_PER_BLEND > lifts.blend_s:
        raise CheckRefused(
            f"wheels are lifted within blend_s = {lifts.blend_s:g} s, but the record has one sample per {step:g} s; "
            f"record at {SAMPLES_PER_BLEND / lifts.blend_s:.0f} Hz or more, or raise blend_s"
        )


def grounded_pairs(record: Record, name: str) -> Array:
    """Return 1 for pairs on the ground and 0 for lifted pairs, shape (T, pairs)."""
    if name not in record:
        raise CheckRefused(f"lifts.signal: unknown signal {name!r} (signals of the record: {', '.join(record)})")
    data = np.asarray(record[name])
    if data.ndim != 2 or record.signals[name].axis != TIME or not np.isin(data, (0, 1)).all():
        raise CheckRefused(f"signal {name!r} must be 0 or 1 for each wheel pair at each time of the record")
    return data.astype(np.float64)


def refuse_what_cannot_stand(grounded: Array, pairs: tuple[str, ...], time: Array) -> None:
    """Raise CheckRefused if pair 1, or every other pair, is lifted; ``grounded`` has shape (T, pairs)."""
    if not (grounded[:, 0] == 1).all():
        row = int(np.argmin(grounded[:, 0]))
        raise CheckRefused(
            f"{pairs[0]} is lifted at t = {time[row]:.3f} s, but it carries the raised head, which would move with it"
        )
    standing = grounded.sum(axis=1)
    if standing.min() < 2:
        row = int(np.argmin(standing))
        raise CheckRefused(f"only {pairs[0]} is on the ground at t = {time[row]:.3f} s; the robot would tip over")


def _height(grounded: Array, time: Array, lifts: Lifts, name: str) -> Array:
    """Return the height of one pair over time, shape (T,) [m]."""
    height = np.zeros_like(time)
    edges = np.flatnonzero(np.diff(grounded, prepend=1.0, append=1.0))
    for first, end in edges.reshape(-1, 2):
        up, down = time[first], time[min(end, len(time) - 1)]
        # A pair lifted in the first sample starts in the air; a pair lifted in the last sample stays in the air.
        blends = int(first > 0) + int(end < len(time))
        refuse_short_lift(lifts, name, up, down, blends)
        height[first:end] = height_of(
            time[first:end], up if first > 0 else -np.inf, down if end < len(time) else np.inf, lifts
        )
    return height


def refuse_short_lift(lifts: Lifts, name: str, up: float, down: float, blends: int) -> None:
    """Raise CheckRefused if a lift from ``up`` to ``down`` [s] is shorter than ``blends`` blends."""
    if down - up < blends * lifts.blend_s - TIME_ROUNDING:
        raise CheckRefused(
            f"{name} is lifted for {down - up:.3f} s from t = {up:.3f} s, but raising and lowering it take "
            f"{blends * lifts.blend_s:g} s (lifts.blend_s); lift it for longer, or reduce blend_s"
        )


def height_of(time: Array | float, up: Array | float, down: Array | float, lifts: Lifts) -> Array:
    """Return the height [m] at ``time`` of a pair that is lifted from ``up`` to ``down`` [s], which may be infinite."""
    from dynsim.jit.kernel import reals
    from dynsim.snake.fold import lift_heights

    times = [reals(x) for x in np.broadcast_arrays(np.atleast_1d(time), up, down)]
    height = np.zeros(times[0].shape)
    lift_heights(*times, 1e-3 * lifts.clearance_mm, lifts.blend_s, height)
    return height


def _refuse_twist(tilt: Array, lifts: Lifts, pairs: tuple[str, ...], time: Array) -> None:
    """Raise CheckRefused if a wheel of a grounded pair is too high to roll as the record's kinematics assume."""
    row, pair = np.unravel_index(int(tilt.argmax()), tilt.shape)
    if tilt[row, pair] > 1e-3 * lifts.tilt_mm:
        raise CheckRefused(
            f"{pairs[pair]} would stand on one wheel at t = {time[row]:.3f} s, with the other wheel "
            f"{1e3 * tilt[row, pair]:.1f} mm above the floor (lifts.tilt_mm: {lifts.tilt_mm:g}): the axles in front of "
            "it do not meet in one point, so a pair between them cannot be lifted without twisting the base; reduce "
            "the clearance, or bend the base less"
        )
