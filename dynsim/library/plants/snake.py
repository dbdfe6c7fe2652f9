"""Articulated mobile robot that raises its head: T2 Snake-3 by default (Tanaka et al. 2019, Table I).

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019. Values that [T] does not give are marked "assumed".
Kinematic by default; ``level: dynamic`` gives a tree of bodies with masses, servos and tyres.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.compile.snake_tree import GROUND, SnakeTree, lifting_joints, snake_tree
from dynsim.config.base import NonNegative, Positive, StrictConfig
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.model.drives import Drive
from dynsim.model.gripper import Gripper, HoldingLaw
from dynsim.snake.description import SnakeDescription
from dynsim.snake.lifting import Lifts

ENGINE = "kinematic"
# The controller whose keys `section_defaults` knows.
TASK_SPACE = "task_space"

# Compliant tyres (assumed): with rigid ones the loads of the left and right wheel of a pair are not determined.
TYRES = {"stiffness_N_per_m": 1e5, "damping_N_s_per_m": 200.0}
MotorChoice: Any = families.union("motor")
DrivenSide = Literal["left", "right", "none"]


class JointLimits(StrictConfig):
    """Joint limits, symmetric about zero ([T] Table I)."""

    yaw: Positive = Field(65.0, lt=180, description="[deg]")
    pitch: Positive = Field(113.0, lt=180, description="[deg]")


class JointStops(StrictConfig):
    """Mechanical stops of the joints, symmetric about zero; default: at the limits of the command."""

    yaw: Positive | None = Field(None, lt=180, description="[deg]")
    pitch: Positive | None = Field(None, lt=180, description="[deg]")


class Lifting(StrictConfig):
    """How wheel pairs are lifted."""

    clearance_m: Positive = Field(0.010, description="of the lower wheel above the ground (assumed)")
    blend_s: Positive = Field(0.25, description="time to lift a pair, and to put it down (assumed)")
    sag_compensation: bool = Field(True, description="pitch joints are told by so much more as their servos give way")


class Dynamics(StrictConfig):
    """What the plant is beside its lengths where it has forces: ``level: dynamic``."""

    joint_servo: MotorChoice = Field({"type": "mx_106"}, description="of every joint ([T] IV.A)")
    wheel_servo: MotorChoice = Field({"type": "mx_28"}, description="of every driven wheel ([T] IV.A)")
    wheel_inertia_kg_m2: Positive = Field(4e-5, description="about its axle, of each wheel without its servo (assumed)")
    bearing_drag_N_m_s_per_rad: NonNegative = Field(1e-4, description="of each wheel (assumed)")
    passive_wheels: Literal["bodies", "massless"] = Field(
        "bodies", description="massless: no friction along their way, instead of bodies that turn"
    )
    stops_deg: JointStops = Field(
        default_factory=JointStops, description="mechanical stops, no narrower than limits_deg, which are the command's"
    )
    lifting: Lifting = Field(default_factory=Lifting)
    start: Literal["soft", "released"] = Field(
        "soft", description="soft: the head has been raised from below and has settled; released: it is let go at t = 0"
    )


class GripperConfig(StrictConfig):
    """The soft gripper that hardens around an object; all values are assumed, see docs/snake.md."""

    capture_m: Positive = Field(0.015, description="it captures an object whose grasp frame is within this")
    capture_deg: Positive = Field(23.0, lt=180, description="and whose axis is within this of its own")
    hardening_s: Positive = 1.0
    softening_s: Positive = 0.5
    stiffness_N_per_m: Positive = Field(5e3, description="hardened, along each axis")
    damping_N_s_per_m: Positive = 20.0
    bound_N: Positive = Field(20.0, description="beyond it the object slips")
    turning_stiffness_N_m_per_rad: Positive = Field(5.0, description="hardened, about each axis")
    turning_damping_N_m_s_per_rad: Positive = 0.05
    turning_bound_N_m: Positive = Field(0.8, description="beyond it the object slips")
    lost_m: Positive = Field(0.015, description="an object that has slipped further is lost")
    lost_deg: Positive = Field(29.0, lt=180)

    def gripper(self, length: float) -> Gripper:
        """The gripper, its tip that far ahead of the head point [m]."""
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
    """The ``plant:`` section of a scenario; SI units where the key names no other."""

    type: Literal["snake"] = "snake"
    level: Literal["kinematic", "dynamic"] = Field(
        "kinematic", description="kinematic: wheels do not slip and joints follow exactly; dynamic: a tree of bodies"
    )
    dynamics: Dynamics = Field(default_factory=Dynamics, description="level: dynamic only")
    yaw_joints: int = Field(9, ge=2, le=200, description="n: yaw joints of the whole robot")
    head_joints: int = Field(6, ge=0, description="n_h: joints of the raised head part, yaw, pitch, yaw, ..., even")
    link_length_m: Positive = Field(0.0905, description="l [m], between neighbouring joint axes")
    wheel_radius_m: Positive = Field(0.05, description="r [m]")
    wheel_gap_m: Positive | list[Positive] | None = Field(
        None,
        description="distance between the wheels of a pair [m]: one for all, or one per pair of the base part. "
        "Default (assumed): 0.15 m for pairs 1, 3, 5, which carry batteries, and 0.12 m for the others",
    )
    driven_side: DrivenSide | list[DrivenSide] | None = Field(
        None, description="side of the active wheel of each pair. Default (assumed): left, right, left, ..."
    )
    limits_deg: JointLimits = Field(default_factory=JointLimits, description="of the command; see dynamics.stops_deg")
    gripper_length_m: NonNegative = Field(0.09, description="gripper tip ahead of the head point [m] ([T] IV.B)")
    gripper: GripperConfig = Field(default_factory=GripperConfig, description="how it holds objects")
    mass_kg: Positive = Field(10.0, description="of the whole robot [kg], spread evenly over its links (assumed)")
    controlled_point: Literal["head", "gripper"] = Field(
        "head", description="head point ([T] V.A) or gripper tip ([T] V.D)"
    )
    initial_joints_rad: list[float] | None = Field(
        None,
        description="theta_1, psi_1, ... [rad] at t = 0, the base's yaw joints may be left out when zero. Default: "
        "[T] V.A, where it fits",
    )
    initial_base_pose: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="x [m], y [m] of wheel pair 1 and yaw [rad] of the base part"
    )


def engine(config: Config) -> str:
    """What simulates the plant of a configuration."""
    return "dynamics" if config.level == "dynamic" else ENGINE


def section_defaults(plant: Mapping[str, Any], sections: Mapping[str, Any]) -> dict[str, Any]:
    """What other sections of a scenario say where they do not say otherwise; both as they were read."""
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
    # Another controller is refused as such, not for a key that the user did not write.
    if isinstance(controller, Mapping) and controller.get("type") == TASK_SPACE:
        defaults["controller"] = {"state": "feedforward"}  # [T] IV.C.2
        sensor = {"measured": "motion_capture", "estimated": "encoders"}.get(str(controller.get("state")))
        if sensor is not None:
            defaults["sensors"] = {sensor: {}}
    return defaults


def build(config: Config, context: BuildContext) -> SnakeDescription | SnakeTree:
    """The configured robot: its description, or the tree of its bodies.

    Raises
    ------
    ModelError
        What :func:`describe` raises; stops that are narrower than the limits of the command.
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


def _stop(kind: str, stop_deg: float | None, limit_deg: float) -> float:
    """Angle [rad] at which joints of a kind stop mechanically; ModelError if that is within the command's limit."""
    if stop_deg is None:
        return float(np.deg2rad(limit_deg))
    if stop_deg < limit_deg:
        raise ModelError(
            f"plant.dynamics.stops_deg.{kind} = {stop_deg:g} is narrower than plant.limits_deg.{kind} = {limit_deg:g}: "
            "the command would go beyond the stop",
            keys=("plant", "dynamics", "stops_deg", kind),
        )
    return float(np.deg2rad(stop_deg))


def describe(config: Config) -> SnakeDescription:
    """Description of the configured robot.

    Raises
    ------
    ModelError
        The head part cannot be controlled in six coordinates (n_h odd or n_h < 4, [T] eq 1), too few wheel rows
        (n_b + n_w >= 2, [T] eq 16 with every wheel on the ground), or lists that do not fit the number of joints or
        wheel pairs. What depends on the wheels lifted and on shape controllable points is checked by the controller.
    """
    n, n_h = config.yaw_joints, config.head_joints
    if n_h % 2:
        raise ModelError(f"plant.head_joints = {n_h}: yaw and pitch joints alternate, n_h must be even")
    if n_h < 4:
        raise ModelError(
            f"plant.head_joints = {n_h}: six coordinates of the head need n_h >= 4 ([T] eq 1), because the three "
            "ground-contact rows and the side-slip row of wheel pair 1 contain no other joints"
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
            f"plant: n_b + n_w = {n_b} + {n_w} < 2: with so few wheel rows A loses its full column rank and the head "
            "cannot be tracked ([T] eq 16)"
        )

    pitch = np.array([j < n_h and j % 2 == 1 for j in range(joints)])
    upper = np.deg2rad(np.where(pitch, config.limits_deg.pitch, config.limits_deg.yaw))
    names = tuple(f"{'psi' if j % 2 else 'theta'}{j // 2 + 1}" for j in range(n_h))
    names += tuple(f"theta{n_h // 2 + i + 1}" for i in range(n_b))

    # [T] V.A; a head part of another length starts with a similar S that keeps the head level
    raised = [0.0, -0.8, 0.0, -1.1, 0.0, 1.9] if n_h == 6 else [0.0, 0.0] * (n_h // 2 - 2) + [0.0, -0.8, 0.0, 0.8]
    angles = raised if config.initial_joints_rad is None else config.initial_joints_rad
    if len(angles) not in (n_h, joints):
        raise ModelError(
            f"plant.initial_joints_rad has {len(angles)} angles; give n_h = {n_h} (base straight) or all {joints}: "
            f"{', '.join(names)}"
        )
    initial = np.concatenate([angles, np.zeros(joints - len(angles))])
    for name, angle, limit in zip(names, initial, upper, strict=True):
        if abs(angle) > limit:
            raise ModelError(
                f"plant.initial_joints_rad: {name} = {angle:.4f} rad is beyond its limit of {limit:.4f} rad "
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
        raise ModelError(f"plant.{key} has {len(value)} entries, the base part has {pairs} wheel pairs")
    return value
