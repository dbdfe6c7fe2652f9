"""Articulated mobile robot with a raised head: T2 Snake-3 by default (Tanaka et al. 2019, Table I).

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019. Values that [T] does not give are marked "assumed".
The robot is kinematic by default; ``level: dynamic`` builds a tree of bodies with masses, servos and tyres.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.compile.snake_tree import GROUND, SnakeTree, lifting_joints, snake_tree
from dynsim.config.base import NonNegative, Positive, StrictConfig, default
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.model.drives import Drive
from dynsim.model.gripper import Gripper, HoldingLaw
from dynsim.snake.description import SnakeDescription
from dynsim.snake.lifting import Lifts

ENGINE = "kinematic"
# Type of the controller for which `section_defaults` has defaults.
TASK_SPACE = "task_space"

# Compliant tyres (assumed); with rigid tyres, the loads on the left and right wheel of a pair would be indeterminate.
TYRES = {"stiffness_N_per_m": 1e5, "damping_N_s_per_m": 200.0}
MotorChoice: Any = families.union("motor")
DrivenSide = Literal["left", "right", "none"]


class JointLimits(StrictConfig):
    """Joint limits, symmetric about zero ([T] Table I)."""

    yaw: Positive = default(65.0, "limit of yaw joints [deg]", lt=180)
    pitch: Positive = default(113.0, "limit of pitch joints [deg]", lt=180)


class JointStops(StrictConfig):
    """Mechanical stops of the joints, symmetric about zero."""

    yaw: Positive | None = default(None, "stop of yaw joints [deg]; default: `limits_deg.yaw`", lt=180)
    pitch: Positive | None = default(None, "stop of pitch joints [deg]; default: `limits_deg.pitch`", lt=180)


class Lifting(StrictConfig):
    """Lifting of wheel pairs."""

    clearance_m: Positive = default(0.010, "height of the lower wheel above the ground (assumed)")
    blend_s: Positive = default(0.25, "time to lift or lower a pair (assumed)")
    sag_compensation: bool = default(True, "add the predicted deflection of the servos to the commands of pitch joints")


class Dynamics(StrictConfig):
    """Additional parameters of the plant for `level: dynamic`."""

    joint_servo: MotorChoice = default({"type": "mx_106"}, "servo of each joint ([T] IV.A)")
    wheel_servo: MotorChoice = default({"type": "mx_28"}, "servo of each driven wheel ([T] IV.A)")
    wheel_inertia_kg_m2: Positive = default(
        4e-5, "moment of inertia of each wheel about its axle, without servo (assumed)"
    )
    bearing_drag_N_m_s_per_rad: NonNegative = default(1e-4, "viscous friction of each wheel (assumed)")
    passive_wheels: Literal["bodies", "massless"] = default(
        "bodies", "model of passive wheels: rotating `bodies`, or `massless` points without rolling friction"
    )
    stops_deg: JointStops = Field(
        default_factory=JointStops,
        description="mechanical stops, not narrower than `limits_deg`, which limits the commands",
    )
    lifting: Lifting = Field(default_factory=Lifting, description="lifting of wheel pairs")
    start: Literal["soft", "released"] = default(
        "soft", "initial state: `soft`, with the head raised from below and settled, or `released`, dropped at t = 0"
    )


class GripperConfig(StrictConfig):
    """Soft gripper that hardens around an object; all values are assumed, see docs/snake.md."""

    capture_m: Positive = default(0.015, "maximum distance from an object's grasp frame to capture it")
    capture_deg: Positive = default(23.0, "maximum angle to an object's grasp axis to capture it", lt=180)
    hardening_s: Positive = default(1.0, "time to harden")
    softening_s: Positive = default(0.5, "time to soften")
    stiffness_N_per_m: Positive = default(5e3, "stiffness along each axis when hardened")
    damping_N_s_per_m: Positive = default(20.0, "damping along each axis when hardened")
    bound_N: Positive = default(20.0, "force along an axis beyond which the object slips")
    turning_stiffness_N_m_per_rad: Positive = default(5.0, "stiffness about each axis when hardened")
    turning_damping_N_m_s_per_rad: Positive = default(0.05, "damping about each axis when hardened")
    turning_bound_N_m: Positive = default(0.8, "torque about an axis beyond which the object slips")
    lost_m: Positive = default(0.015, "slip beyond which the object is lost")
    lost_deg: Positive = default(29.0, "rotation beyond which the object is lost", lt=180)

    def gripper(self, length: float) -> Gripper:
        """Return the gripper whose tip is ``length`` [m] ahead of the head point."""
        turning = self.turning_stiffness_N_m_per_rad, self.turning_damping_N_m_s_per_rad, self.turning_bound_N_m
        return Gripper(
            body="head",
            tip=np.array([length, 0.0, 0.0]),
            capture_distance=self.capture_m,
            capture_angle=float(np.deg2rad(self.capture_deg)),
            hardening=self.hardening_s,
            softening=self.softening_s,
            along=HoldingLaw(self.stiffness_N_per_m, self.damping_N_s_per_m, self.bound_N),
            about=HoldingLaw(*turning),
            lost_distance=self.lost_m,
            lost_angle=float(np.deg2rad(self.lost_deg)),
        )


class Config(StrictConfig):
    """Snake robot; SI units unless the key has another unit."""

    type: Literal["snake"] = "snake"
    level: Literal["kinematic", "dynamic"] = default(
        "kinematic", "model; `kinematic`: no wheel slip and exact joints, `dynamic`: a tree of bodies with forces"
    )
    dynamics: Dynamics = Field(default_factory=Dynamics, description="parameters of `level: dynamic`")
    yaw_joints: int = default(9, "number n of yaw joints of the whole robot", ge=2, le=200)
    head_joints: int = default(6, "number n_h of joints of the raised head part (yaw, pitch, yaw, ...), even", ge=0)
    link_length_m: Positive = default(0.0905, "distance l between neighbouring joint axes")
    wheel_radius_m: Positive = default(0.05, "wheel radius r")
    wheel_gap_m: Positive | list[Positive] | None = default(
        None,
        "distance between the wheels of a pair: one value, or one per pair of the base part; "
        "default (assumed): 0.15 m for pairs 1, 3, 5, which carry batteries, and 0.12 m for the other pairs",
    )
    driven_side: DrivenSide | list[DrivenSide] | None = default(
        None, "side of the active wheel: one value, or one per pair; default (assumed): left, right, left, ..."
    )
    limits_deg: JointLimits = Field(
        default_factory=JointLimits, description="limits of the commanded joint angles; see `dynamics.stops_deg`"
    )
    gripper_length_m: NonNegative = default(0.09, "distance of the gripper tip ahead of the head point ([T] IV.B)")
    gripper: GripperConfig = Field(default_factory=GripperConfig, description="parameters of the gripper")
    mass_kg: Positive = default(10.0, "mass of the whole robot, distributed evenly over its links (assumed)")
    controlled_point: Literal["head", "gripper"] = default(
        "head", "controlled point: head point ([T] V.A) or gripper tip ([T] V.D)"
    )
    initial_joints_rad: list[float] | None = default(
        None,
        "initial joint angles theta_1, psi_1, ...; zero yaw angles of the base part may be omitted; "
        "default: [T] V.A, or a similar posture for other head parts",
    )
    initial_base_pose: tuple[float, float, float] = default(
        (0.0, 0.0, 0.0), "initial x [m] and y [m] of wheel pair 1, and yaw [rad] of the base part"
    )


def engine(config: Config) -> str:
    """Return the engine that simulates the configured plant."""
    return "dynamics" if config.level == "dynamic" else ENGINE


def section_defaults(plant: Mapping[str, Any], sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plant's defaults for other sections of a scenario; both arguments are unvalidated."""
    if plant.get("level") != "dynamic":
        return {}
    defaults: dict[str, Any] = {
        "surfaces": {GROUND: {"type": "plane"}},
        "contacts": {"law": "unilateral", "friction": 0.6, "candidates": "links"},
    }
    integrator, contacts = sections.get("integrator"), sections.get("contacts")
    if not isinstance(integrator, Mapping) or integrator.get("method", "time_stepping") == "time_stepping":
        defaults["integrator"] = {"method": "time_stepping", "step_s": 0.0025}
        if not isinstance(contacts, Mapping) or contacts.get("stiffness_N_per_m", TYRES) is not None:
            defaults["contacts"] |= TYRES
    controller = sections.get("controller")
    # Other controllers get no defaults, so that no error is about a key that the user did not write.
    if isinstance(controller, Mapping) and controller.get("type") == TASK_SPACE:
        defaults["controller"] = {"state": "feedforward"}  # [T] IV.C.2
        sensor = {"measured": "motion_capture", "estimated": "encoders"}.get(str(controller.get("state")))
        if sensor is not None:
            defaults["sensors"] = {sensor: {}}
    return defaults


def build(config: Config, context: BuildContext) -> SnakeDescription | SnakeTree:
    """Build the configured robot: a description, or a tree of bodies for ``level: dynamic``.

    Raises
    ------
    ModelError
        If :func:`describe` fails, or the stops are narrower than the limits of the commands.
    """
    description = describe(config)
    if config.level == "kinematic":
        return description
    dynamics = config.dynamics
    lifting = dynamics.lifting

    def servo(choice: Any, joint: str) -> Drive:
        return families.build("motor", choice, context.at_joint(joint), Drive)

    return snake_tree(
        description,
        lambda joint: servo(dynamics.joint_servo, joint),
        lambda joint: servo(dynamics.wheel_servo, joint),
        yaw_stop=_stop("yaw", dynamics.stops_deg.yaw, config.limits_deg.yaw),
        pitch_stop=_stop("pitch", dynamics.stops_deg.pitch, config.limits_deg.pitch),
        wheel_inertia=dynamics.wheel_inertia_kg_m2,
        bearing_drag=dynamics.bearing_drag_N_m_s_per_rad,
        massless_wheels=dynamics.passive_wheels == "massless",
        lifts=Lifts(
            joints=lifting_joints(description), clearance_mm=1e3 * lifting.clearance_m, blend_s=lifting.blend_s
        ),
        sag_compensation=lifting.sag_compensation,
        raised=dynamics.start == "soft",
        gripper=config.gripper.gripper(config.gripper_length_m),
    )


def start_keys(config: Config, positions: Mapping[str, float]) -> dict[str, Any]:
    """Return the keys for a start at the given joint angles [rad], and x, y [m] and yaw [rad] of the base part."""
    names = describe(config).joint_names
    angles = [positions[name] for name in names]
    count = len(names) if any(angles[config.head_joints :]) else config.head_joints
    pose = [positions[f"base.{name}"] for name in ("x", "y", "yaw")]
    return {"initial_joints_rad": angles[:count], "initial_base_pose": pose}


def _stop(kind: str, stop_deg: float | None, limit_deg: float) -> float:
    """Return the stop of yaw or pitch joints [rad]; raise ModelError if it is within the limit of the commands."""
    if stop_deg is None:
        return float(np.deg2rad(limit_deg))
    if stop_deg < limit_deg:
        raise ModelError(
            f"plant.dynamics.stops_deg.{kind} = {stop_deg:g}: must not be less than plant.limits_deg.{kind} = "
            f"{limit_deg:g}, otherwise commands could exceed the stop",
            keys=("plant", "dynamics", "stops_deg", kind),
        )
    return float(np.deg2rad(stop_deg))


def describe(config: Config) -> SnakeDescription:
    """Build the description of the configured robot.

    Raises
    ------
    ModelError
        If the head part is not controllable in six coordinates (n_h odd or n_h < 4, [T] eq 1), there are too few wheel
        rows (n_b + n_w >= 2 is required, [T] eq 16 with all wheels on the ground), or a list has the wrong length for
        the joints or wheel pairs. The controller checks conditions on lifted wheels and shape controllable points.
    """
    n, n_h = config.yaw_joints, config.head_joints
    if n_h % 2:
        raise ModelError(f"plant.head_joints = {n_h}: must be even, because yaw and pitch joints alternate")
    if n_h < 4:
        raise ModelError(
            f"plant.head_joints = {n_h}: must be at least 4 ([T] eq 1), because the three ground-contact rows and the "
            "side-slip row of wheel pair 1 contain head joints only"
        )
    n_b = n - n_h // 2
    if n_b < 1:
        raise ModelError(f"plant: yaw_joints = {n} and head_joints = {n_h} leave no base part (n_b = {n_b})")
    pairs, joints = n_b + 1, n_h + n_b

    gap = config.wheel_gap_m
    if gap is None:
        gap = [0.15 if i in (0, 2, 4) else 0.12 for i in range(pairs)]
    gaps = _per_pair("wheel_gap_m", gap, pairs)
    side = config.driven_side
    if side is None:
        side = ["left" if i % 2 == 0 else "right" for i in range(pairs)]
    driven_side = np.array([{"left": 1, "right": -1, "none": 0}[s] for s in _per_pair("driven_side", side, pairs)])
    n_w = int(np.count_nonzero(driven_side))
    if n_b + n_w < 2:
        raise ModelError(
            f"plant: n_b + n_w = {n_b} + {n_w} must be at least 2, or A does not have full column rank and the head "
            "cannot be tracked ([T] eq 16); add yaw joints or driven wheels"
        )

    pitch = np.array([j < n_h and j % 2 == 1 for j in range(joints)])
    upper = np.deg2rad(np.where(pitch, config.limits_deg.pitch, config.limits_deg.yaw))
    names = tuple(f"{'psi' if j % 2 else 'theta'}{j // 2 + 1}" for j in range(n_h))
    names += tuple(f"theta{n_h // 2 + i + 1}" for i in range(n_b))

    # The posture of [T] V.A; for other lengths of the head part, a similar S shape that keeps the head level.
    raised = [0.0, -0.8, 0.0, -1.1, 0.0, 1.9] if n_h == 6 else [0.0, 0.0] * (n_h // 2 - 2) + [0.0, -0.8, 0.0, 0.8]
    angles = raised if config.initial_joints_rad is None else config.initial_joints_rad
    if len(angles) not in (n_h, joints):
        raise ModelError(
            f"plant.initial_joints_rad has {len(angles)} angles; set n_h = {n_h} angles (base straight) or all "
            f"{joints}: {', '.join(names)}"
        )
    initial = np.concatenate([angles, np.zeros(joints - len(angles))])
    for name, angle, limit in zip(names, initial, upper, strict=True):
        if abs(angle) > limit:
            raise ModelError(
                f"plant.initial_joints_rad: {name} = {angle:.4f} rad exceeds its limit of {limit:.4f} rad "
                f"({np.rad2deg(limit):g} deg, plant.limits_deg)"
            )
    links = n_h + 2 * n_b
    return SnakeDescription(
        head_joints=n_h,
        base_joints=n_b,
        link_length=config.link_length_m,
        wheel_radius=config.wheel_radius_m,
        point_offset=config.gripper_length_m if config.controlled_point == "gripper" else 0.0,
        reference_joints=np.concatenate([raised, np.zeros(n_b)]),
        joint_names=names,
        pitch=pitch,
        lower=-upper,
        upper=upper,
        half_track=np.array(gaps) / 2.0,
        driven_side=driven_side,
        link_mass=np.full(links, config.mass_kg / links),
        initial_joints=initial,
        initial_base_pose=np.array(config.initial_base_pose),
    )


def _per_pair(key: str, value: object, pairs: int) -> list:
    if not isinstance(value, list):
        return [value] * pairs
    if len(value) != pairs:
        raise ModelError(f"plant.{key} has {len(value)} entries for {pairs} wheel pairs; use one per pair")
    return value
