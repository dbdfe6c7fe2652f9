"""PD voltage control of joints, continuous or sampled (Wang and Minami, eq 56): u = k_p (q_d − q) + k_d (v_d − v)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from dynsim.compile.bracing import MIN_N, RAMP, PressingBrace
from dynsim.compile.control import PLANNED, BasePath, HandPath, JointControl, MovedPath, targets_on
from dynsim.compile.hand_posture import hand_turn
from dynsim.compile.model import Model
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.inverse_kinematics import follow, planned_voltages
from dynsim.compile.references.splines import clamped_cubic, quintic_coefficients, rolled, wheel_angles
from dynsim.compile.references.teleop import TeleopOptions
from dynsim.config.base import NonNegative, Pair, Positive, StrictConfig, Vector3, check_waypoints, default, error_at
from dynsim.config.problems import errors_at, suggest
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.library.controllers.operator import OperatorConfig
from dynsim.model.base_pose import base_row
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource
from dynsim.system.memo import recall

ENGINE = "dynamics"

PathChoice: Any = families.union("path")
BasePathChoice: Any = families.union("base_path")

# Maximum number of segments of the reference splines; this many segments take half a gigabyte per joint.
SEGMENTS_MAX = 10_000_000
# Minimum number of knots between waypoints; maximum factor by which they may be closer than ``knot_spacing_s``.
KNOTS_BETWEEN, MOST_FINER = 5.0, 100.0
# Maximum turn of a base between two knots [rad]; beyond it the spline would deviate from the path.
TURN_MAX = 0.2


class Orientation(StrictConfig):
    """Attitude of a body in the world."""

    rpy_deg: Vector3 = Field(description="rotation about x, y, z of the world, in this order")

    def matrix(self) -> Array:
        """Return the axes of the body as columns, shape (3, 3)."""
        from dynsim.model.urdf.reader import rotation

        return np.asarray(rotation(*np.deg2rad(self.rpy_deg).tolist()))


class HandReference(StrictConfig):
    """Hand path, which inverse kinematics converts to references for `joints`."""

    path: PathChoice = Field(description="path of the hand")
    orientation: Orientation | None = default(None, "constant attitude of the hand's body or frame; default: free")
    joints: list[str] = Field(
        description="joints that follow the path, while the other joints hold; empty if the waypoints in "
        "`controller.joints` move the hand along the path"
    )
    braces: list[str] = default([], "contact points that the joints keep on their surfaces")
    tolerance_m: Positive = default(1e-6, "maximum position error; a larger error means that the path is out of reach")

    @property
    def from_start(self) -> bool:
        """Whether path and orientation are relative to the hand in the start posture."""
        return getattr(self.path, "frame", "world") == "start"

    def path_in_world(self, context: BuildContext) -> HandPath:
        """Build the path, and move it to its origin in the world."""
        path = families.build("path", self.path, context, HandPath)
        origin = np.array(getattr(self.path, "origin_m", np.zeros(3)))
        if self.from_start:
            origin = origin + context.model.point_position(*context.model.robot.hand, context.planned_start)
        return MovedPath(path, origin) if self.from_start or origin.any() else path

    def turn_in_world(self, context: BuildContext) -> Array | None:
        """Return the target axes of the hand in the world as columns, shape (3, 3); None without an orientation."""
        if self.orientation is None:
            return None
        turn = self.orientation.matrix()
        return np.asarray(turn @ hand_turn(context.model, context.planned_start)) if self.from_start else turn


class BaseReference(StrictConfig):
    """Path of the mobile base, which is converted to references for its wheels."""

    path: BasePathChoice = Field(description="path of the base")


class JointPath(StrictConfig):
    """Waypoints of one joint, joined by a cubic spline with zero rate at both ends; the joint holds beyond them."""

    times_s: list[float] = Field(min_length=2, description="times of the waypoints, increasing")
    angles_deg: list[float] | None = default(None, "angles of a revolute joint", min_length=2)
    positions_m: list[float] | None = default(None, "positions of a prismatic joint", min_length=2)
    ends: Literal["rest", "free"] = default("rest", "ends of the spline: `rest` (zero rate) or `free` (zero curvature)")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.angles_deg is None) == (self.positions_m is None):
            raise error_at("angles_deg", "requires either angles_deg or, for a prismatic joint, positions_m")
        if self.angles_deg is not None:
            check_waypoints(self.times_s, self.angles_deg, "angles_deg")
        elif self.positions_m is not None:
            check_waypoints(self.times_s, self.positions_m, "positions_m")
        return self

    @property
    def values(self) -> Array:
        """Positions at the waypoints [rad or m]."""
        return np.array(self.positions_m) if self.angles_deg is None else np.deg2rad(self.angles_deg)

    def positions(self, times: Array) -> Array:
        """Return the spline [rad or m] at times [s]."""
        return clamped_cubic(self.times_s, self.values, times, self.ends == "rest")


class TorquePath(StrictConfig):
    """Waypoints of one torque, joined by a cubic spline with zero slope at both ends and constant beyond them."""

    times_s: list[float] = Field(min_length=2, description="times of the waypoints, increasing")
    torques_N_m: list[float] = Field(min_length=2, description="torques at the waypoints; N at a prismatic joint")

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_waypoints(self.times_s, self.torques_N_m, "torques_N_m")
        return self


class BraceForce(StrictConfig):
    """Planned normal force of one brace."""

    force_N: Positive | None = default(None, "normal force; default: the force of least heat, at least `min_N`")
    during_s: list[Pair] | None = default(
        None,
        "intervals in which the brace presses, increasing and apart; the force rises and falls within 0.1 s at their "
        "ends; default: the whole run",
        min_length=1,
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        intervals = self.during_s or []
        ends = [0.0, *(time for interval in intervals for time in interval)]
        if any(later < time for time, later in pairwise(ends)) or any(b - a < 2.0 * RAMP for a, b in intervals):
            raise error_at(
                "during_s", f"must be increasing intervals of at least {2.0 * RAMP:g} s, e.g. [[0, 2], [3, 5]]"
            )
        return self


def _kind(value: Any) -> str:
    """Return the tag of a branch of a union; the branch of mappings has the tag "", which messages omit."""
    return "" if isinstance(value, Mapping | BraceForce) else "other"


BraceForces = dict[
    str, Annotated[Annotated[Positive, Tag("other")] | Annotated[BraceForce, Tag("")], Discriminator(_kind)]
]
BraceChoice = Annotated[
    Annotated[Literal["optimal"], Tag("other")] | Annotated[BraceForces, Tag("")], Discriminator(_kind)
]


class Config(StrictConfig):
    """PD controller of the joints; joints without a reference hold their initial position.

    The gains are for DC motors. Servos follow the references with their own gains; torque sources follow `torques`.
    """

    type: Literal["joint_pd"]
    k_p_V_per_rad: NonNegative | list[NonNegative] | None = default(
        None, "position gain, one value or one per DC motor; V/m at a prismatic joint; default: 500"
    )
    k_d_V_s_per_rad: NonNegative | list[NonNegative] | None = default(
        None, "rate gain, one value or one per DC motor; V s/m at a prismatic joint; default: 20"
    )
    hand: HandReference | None = default(None, "path of the hand; default: no path")
    base: BaseReference | None = default(None, "path of the mobile base; default: it holds")
    operator: OperatorConfig | None = default(
        None, "velocities of hand and mobile base, instead of paths; default: no operator"
    )
    joints: dict[str, JointPath] = default({}, "waypoints of the named joints")
    torques: dict[str, TorquePath] = default({}, "torques of the named joints with motors of type torque")
    feed_forward: Literal["none", "gravity", "dynamics"] = default(
        "none",
        "planned voltages of DC motors along the references, added to the PD: none, for gravity, or for "
        "the full dynamics",
    )
    brace: BraceChoice | None = default(
        None,
        "normal forces [N] of the named contacts, or `optimal` for forces of least heat of all contacts; voltages are "
        "then planned for the full dynamics with these forces; default: no planned forces",
    )
    min_N: NonNegative = default(MIN_N, "minimum normal force of each brace whose force is of least heat")
    sample_time_s: Positive | None = default(
        None, "sampling period of the commands, held in between; default: continuous"
    )
    knot_spacing_s: Positive = default(0.02, "knot spacing of the reference splines")

    @field_validator("brace", mode="before")
    @classmethod
    def _check_brace(cls, value: Any) -> Any:
        """Raise one error for a value of an invalid type, and a different error that names an invalid force."""
        if isinstance(value, Mapping) and value:
            for name, force in value.items():
                if isinstance(force, Mapping | BraceForce):
                    continue
                if isinstance(force, bool) or not isinstance(force, int | float) or not 0.0 < force < np.inf:
                    raise error_at(str(name), "must be a normal force above 0 N; remove contacts that must not press")
        elif value not in (None, "optimal"):
            raise ValueError("must be `optimal`, or a mapping of contacts to normal forces [N], e.g. {elbow_4: 3.0}")
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        both = [name for name in self.joints if self.hand is not None and name in self.hand.joints]
        if both:
            raise ValueError(f"{both[0]} cannot follow both the hand path and waypoints in joints; remove one of them")
        if self.hand is not None and not self.hand.joints and not self.joints:
            raise error_at("hand.joints", "must list at least one joint; add joints here, or set controller.joints")
        if self.operator is not None:
            planned = [name for name in PLANNED if name in self.model_fields_set and getattr(self, name)]
            planned = [name for name in planned if getattr(self, name) != "none"]
            if planned:
                raise error_at(
                    planned[0], f"conflicts with operator, which changes the references; remove {planned[0]}"
                )
        if self.brace is not None and self.feed_forward != "none":
            raise error_at("feed_forward", "conflicts with brace, which plans the full dynamics; remove feed_forward")
        forces = self.brace.values() if isinstance(self.brace, dict) else ()
        optimal = self.brace == "optimal" or any(isinstance(f, BraceForce) and f.force_N is None for f in forces)
        if self.min_N != MIN_N and not optimal:
            raise error_at("min_N", "requires brace: optimal, or a brace without force_N; remove min_N")
        return self


def build(config: Config, context: BuildContext) -> JointControl:
    """Resolve gains and references for the context's model; inverse kinematics reports to ``context.progress``.

    Raises
    ------
    ModelError
        If a joint does not exist or has no motor, or if the number of gains differs from the number of motors.
    UnreachableReference
        If the hand cannot follow its path.
    """
    model = context.model
    robot = model.robot
    _check_names(config, model)
    path, turn = None, None
    if config.hand is not None:
        hand_config = config.hand
        known = hand_config.path, context.duration, *([model, context.start] if hand_config.from_start else ())
        path = recall("path", lambda: hand_config.path_in_world(context), *known)
        turn = hand_config.turn_in_world(context)
    base_path = None
    if config.base is not None:
        with errors_at("controller", "base", "path"):
            base_path = families.build("base_path", config.base.path, context, BasePath)
    times, positions = np.zeros(0), dict[str, Array]()
    planned = config.brace is not None or config.feed_forward != "none"
    if config.joints or config.torques or path is not None or base_path is not None or planned:
        times = _knots(_spacing(config), context.duration)
        for name, joint in config.joints.items():
            positions[name] = joint.positions(times)
        for name, torque in config.torques.items():
            positions[name] = clamped_cubic(torque.times_s, np.array(torque.torques_N_m), times)
        if base_path is not None:
            positions |= _wheel_angles(robot, base_path, times)
        if config.hand is not None and config.hand.joints and path is not None:
            hand, targets = config.hand, targets_on(path, times)
            base = _base_coordinates(robot, positions, times)
            braces = [_contact(context, name, "hand.braces") for name in hand.braces]
            start, tolerance = robot.initial, hand.tolerance_m
            followed = follow(
                model, times, targets, hand.joints, start, tolerance, context.progress, base, braces, turn
            )
            positions |= dict(zip(hand.joints, followed.T, strict=True))
    control = JointControl.following(
        robot,
        k_p=_gains(config, robot, "k_p"),
        k_d=_gains(config, robot, "k_d"),
        times=times,
        positions=positions,
        path=path,
        sample_time=config.sample_time_s,
        voltages=_planned(config, context, times, positions) if planned else None,
    )
    control = replace(control, orientation=turn)
    return control if config.operator is None else replace(control, teleop=_teleop(config.operator, context))


def _teleop(operator: OperatorConfig, context: BuildContext) -> TeleopOptions:
    robot = context.model.robot
    if any(command.base is not None for command in operator.commands):
        _check_base(robot, ("controller", "operator"))
    return TeleopOptions(
        rate=operator.rate_hz,
        joints=tuple(operator.joints),
        braces=tuple(_contact(context, name, "operator.braces") for name in operator.braces),
        rate_limit=operator.rate_limit_rad_s,
        acceleration_limit=operator.acceleration_limit_rad_s2,
        hand_acceleration=operator.hand_acceleration_m_s2,
        base_acceleration=(operator.base_acceleration_m_s2, operator.base_acceleration_rad_s2),
        tolerance=operator.tolerance_m,
        script=operator.script(),
    )


def _planned(config: Config, context: BuildContext, times: Array, positions: dict[str, Array]) -> Array:
    """Return the voltages of the motors along the references, (T, na)."""
    if config.brace is None:
        return planned_voltages(context.model, times, positions, {}, whole=config.feed_forward == "dynamics")
    forces: dict[str, Any] = dict.fromkeys(context.declared, BraceForce())
    if config.brace != "optimal":
        forces = {n: f if isinstance(f, BraceForce) else BraceForce(force_N=f) for n, f in config.brace.items()}
    for name in context.disabled:
        if name in forces:
            text = f"controller.brace: contact {name!r} is disabled and cannot press; enable it, or remove it here"
            raise ModelError(text, keys=("controller",))
    braces = {
        name: PressingBrace(_contact(context, name, "brace"), force.force_N, _intervals(force))
        for name, force in forces.items()
    }
    return planned_voltages(context.model, times, positions, braces, config.min_N)


def _intervals(force: BraceForce) -> tuple[tuple[float, float], ...] | None:
    return None if force.during_s is None else tuple((start, end) for start, end in force.during_s)


def _contact(context: BuildContext, name: str, key: str) -> Contact:
    if name not in context.contacts:
        known = ", ".join(context.contacts) or "none"
        raise ModelError(f"controller.{key}: unknown contact {name!r} (contacts: {known})", keys=("controller",))
    return context.contacts[name]


def _check_names(config: Config, model: Model) -> None:
    """Raise ModelError if a reference names an unknown joint, or a joint without a motor or with an unsuitable one."""
    robot = model.robot
    driven = [motor.joint for motor in robot.motors]
    in_hand = config.hand.joints if config.hand else config.operator.joints if config.operator else []
    hand = ("hand" if config.hand else "operator", "joints")
    for keys, names in ((("joints",), config.joints), (("torques",), config.torques), (hand, in_hand)):
        for name in names:
            if name not in driven:
                raise ModelError(
                    f"controller.{'.'.join(keys)}: {name!r} is not a joint with a motor{suggest(name, driven)}; "
                    f"joints with a motor: {', '.join(driven) or 'none'}",
                    keys=("controller", *keys),
                )
    sources = {motor.joint for motor in robot.motors if isinstance(motor, TorqueSource)}
    for name in [*config.joints, *in_hand]:
        if name in sources:
            raise ModelError(f"controller: {name!r} has a motor of type torque; use controller.torques.{name}")
    for name in config.torques:
        if name not in sources:
            raise ModelError(f"controller: torques.{name}: requires a motor of type torque; remove it")
    for name in config.joints:
        revolute = robot.links[model.joint_names.index(name)].units[0] == "rad"
        if revolute != (config.joints[name].positions_m is None):
            kind, key = ("revolute", "angles_deg") if revolute else ("prismatic", "positions_m")
            raise ModelError(f"controller: {name!r} is {kind}; use {key} for its waypoints")
    wheels = () if robot.base is None else robot.base.wheels
    for wheel in wheels:
        if wheel in in_hand:
            raise ModelError(f"controller: {wheel!r} is a wheel; only joints of the arm can follow the hand path")
    if config.base is None:
        return
    _check_base(robot, ("controller", "base"))
    for wheel in wheels:
        if wheel in config.joints:
            raise ModelError(
                f"controller: {wheel!r} cannot follow both the base path and waypoints; remove one of them"
            )


def _check_base(robot: Robot, keys: tuple[str, ...]) -> None:
    """Raise ModelError if the plant has no mobile base, or if its wheels cannot follow references."""
    key, motors = ".".join(keys), {motor.joint: motor for motor in robot.motors}
    if robot.base is None:
        raise ModelError(f"{key}: requires a plant with a mobile base, such as pws_arm", keys=keys)
    for wheel in robot.base.wheels:
        if wheel not in motors:
            raise ModelError(f"{key}: {wheel!r} has no motor; set plant.base.wheel.motor", keys=keys)
        if isinstance(motors[wheel], TorqueSource):
            raise ModelError(f"{key}: {wheel!r} has a motor of type torque, which cannot follow a path", keys=keys)


def _spacing(config: Config) -> float:
    """Return the knot spacing [s]: ``knot_spacing_s``, or less if waypoints are closer together.

    A spline whose knots are as far apart as the waypoints misses the waypoints by up to half the change between them.
    """
    waypoints = [path.times_s for path in config.joints.values()] + [path.times_s for path in config.torques.values()]
    nearest = min((float(np.diff(times).min()) for times in waypoints if len(times) > 1), default=np.inf)
    return min(config.knot_spacing_s, max(nearest / KNOTS_BETWEEN, config.knot_spacing_s / MOST_FINER))


def _knots(spacing: float, duration: float) -> Array:
    """Return the sampling times of the reference splines [s]."""
    segments = duration / spacing
    if segments > SEGMENTS_MAX:
        raise ModelError(
            f"controller.knot_spacing_s = {spacing:g}: needs {segments:.3g} knots for {duration:g} s "
            f"(limit {SEGMENTS_MAX:g}); use at least {duration / SEGMENTS_MAX:.3g}"
        )
    # A quintic spline needs six knots.
    return np.linspace(0.0, duration, max(int(np.ceil(segments)), 6) + 1)


def _wheel_angles(robot: Robot, path: BasePath, times: Array) -> dict[str, Array]:
    """Return references for the two wheels [rad]; empty if the base does not move, so that the wheels hold."""
    assert robot.base is not None
    keys = ("controller", "base", "path")
    motion = np.asarray(path.motion(times), dtype=np.float64)
    if motion.shape != (len(times), 2) or not np.isfinite(motion).all():
        raise ModelError(f"controller.base.path: must return {len(times)} finite distances and turns", keys=keys)
    if not motion.any():
        return {}
    turns = np.abs(np.diff(motion[:, 1]))
    if turns.max() > TURN_MAX:
        raise ModelError(
            f"controller.base.path: at t = {times[turns.argmax()]:.3f} s the heading turns by {turns.max():.3g} rad "
            f"between two knots of the references, {times[1]:.3g} s apart (limit {TURN_MAX:g} rad); slow down, "
            "round off the path, or lower controller.knot_spacing_s",
            keys=keys,
        )
    first, _ = base_row(robot)
    angles = robot.initial[first : first + 2] + wheel_angles(robot.base, motion)
    return dict(zip(robot.base.wheels, angles.T, strict=True))


def _base_coordinates(robot: Robot, positions: dict[str, Array], times: Array) -> Array | None:
    """Return wheel angles [rad], x and y [m] of the base at the reference times, (T, 4); None if the base holds."""
    if robot.base is None or not any(wheel in positions for wheel in robot.base.wheels):
        return None
    first, _ = base_row(robot)
    start = robot.initial[first : first + 4]
    angles = np.tile(start[:2], (len(times), 1))
    for k, wheel in enumerate(robot.base.wheels):
        angles[:, k] = positions.get(wheel, angles[:, k])
    spacing = float(times[1] - times[0])
    ways = rolled(robot.base, start[2:], quintic_coefficients(spacing, angles), spacing)
    return np.hstack([angles, np.vstack([start[2:], ways[:, -1]])])


# Keys and defaults of the gains. The schema has no defaults because setting these keys for servos is an error.
_GAINS = {"k_p": ("k_p_V_per_rad", 500.0), "k_d": ("k_d_V_s_per_rad", 20.0)}


def _gains(config: Config, robot: Robot, name: str) -> Array:
    """Return one gain per motor, (na,): the controller's for a DC motor, its own for a servo, 0 for a torque source."""
    (key, default), motors = _GAINS[name], robot.motors
    gain, circuits = getattr(config, key), [isinstance(motor, Motor) for motor in motors]
    if gain is None:
        gain = default
    elif motors and not any(circuits):
        raise ModelError(f"controller: {key} requires DC motors (servos have their own gains); remove it")
    if isinstance(gain, list) and len(gain) != sum(circuits):
        kind = "motors" if all(circuits) else "DC motors"
        raise ModelError(f"controller: {key} has {len(gain)} values for {sum(circuits)} {kind}; use one per motor")
    gains = np.array([getattr(motor, name) if isinstance(motor, Servo) else 0.0 for motor in motors])
    gains[np.array(circuits, dtype=bool)] = gain
    return gains
