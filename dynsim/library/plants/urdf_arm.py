"""Arm on a fixed or floating base with bodies and joints from a URDF file and motors from the scenario."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import BodyPoint, Limits, NonNegative, Positive, StrictConfig, Vector3, default, error_at
from dynsim.config.problems import errors_at, suggest
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.model.description import Array, Link, Robot
from dynsim.model.drives import Drive
from dynsim.system.inputs import is_file

if TYPE_CHECKING:
    from dynsim.model.urdf.reader import Corrections

ENGINE = "dynamics"

MotorChoice: Any = families.union("motor")
POSITIONS = ("initial_deg", "initial_m", "lock_deg", "lock_m")


class PoseConfig(StrictConfig):
    """Pose of a body in the frame of its joint, R = Rz(yaw) Ry(pitch) Rx(roll)."""

    position_m: Vector3 = default([0.0, 0.0, 0.0], "position of the body")
    rpy_deg: Vector3 = default([0.0, 0.0, 0.0], "attitude of the body: roll, pitch, yaw")


class LinkCorrection(StrictConfig):
    """Mass properties that replace those of a link in the file, or of its shapes with a density."""

    mass_kg: NonNegative | None = default(None, "mass of the link; default: as in the file")
    com_m: Vector3 | None = default(None, "centre of mass in the link's frame; default: as in the file")
    inertia_kg_m2: list[float] | None = default(
        None,
        "inertia tensor xx, xy, xz, yy, yz, zz about the centre of mass, in the link's axes; default: as in the file",
        min_length=6,
        max_length=6,
    )
    density_kg_m3: Positive | None = default(None, "density of the link's shapes, which then give mass and inertia")
    radius_m: Positive | None = default(
        None, "radius of a capsule about the link's axis, which replaces its collision shapes; default: the shapes"
    )

    @model_validator(mode="after")
    def _check_density(self) -> Self:
        if self.density_kg_m3 is not None and (self.mass_kg is not None or self.inertia_kg_m2 is not None):
            raise error_at("density_kg_m3", "conflicts with mass_kg and inertia_kg_m2; remove it or both of them")
        return self

    def values(self) -> dict[str, Any]:
        """Return the keywords of :class:`~dynsim.model.urdf.reader.Corrections`."""
        stated: dict[str, Any] = {"mass": self.mass_kg, "density": self.density_kg_m3}
        if self.com_m is not None:
            stated["com"] = np.array(self.com_m)
        if self.inertia_kg_m2 is not None:
            stated["tensor"] = np.array(self.inertia_kg_m2)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        return {key: value for key, value in stated.items() if value is not None}


class JointCorrection(StrictConfig):
    """Values that replace those of a joint in the file."""

    limit_deg: Limits | None = default(None, "lower and upper limit of a revolute joint; default: as in the file")
    limit_m: Limits | None = default(None, "lower and upper limit of a prismatic joint; default: as in the file")
    damping: NonNegative | None = default(
        None, "viscous damping [N m s/rad, prismatic: N s/m]; default: as for all joints or in the file"
    )
    friction: NonNegative | None = default(
        None, "dry friction [N m, prismatic: N]; default: as for all joints or in the file"
    )
    motor: MotorChoice | None = default(None, "motor of the joint; default: as in `motors`, otherwise `motor`")

    def values(self) -> dict[str, float]:
        """Return the keywords of :class:`~dynsim.model.urdf.reader.Corrections`."""
        stated = {"damping": self.damping, "friction": self.friction}
        limits = self.limit_m if self.limit_deg is None else np.deg2rad(self.limit_deg).tolist()
        if limits is not None:
            stated["lower"], stated["upper"] = limits
        return {key: value for key, value in stated.items() if value is not None}


class Config(StrictConfig):
    """Robot from a URDF file, with one motor model for all joints or one per joint."""

    type: Literal["urdf_arm"]
    file: str = Field(description="path of a URDF file, relative to the scenario file")
    base: Literal["fixed", "floating"] = default(
        "fixed", "whether the root link is the world, or floats on a joint named `root`"
    )
    gravity_m_s2: Vector3 = default([0.0, 0.0, -9.81], "gravitational acceleration")
    links: dict[str, LinkCorrection] = default({}, "corrections of the named links")
    joints: dict[str, JointCorrection] = default({}, "corrections of the named joints, and their motors")
    inertia: Literal["strict", "nearest"] = default(
        "strict", "impossible moments of inertia: refused, or replaced by the nearest possible ones with a warning"
    )
    motor: MotorChoice | None = default(
        None, "motor of all joints that are not in `motors` and not coupled to a leader; default: no motor"
    )
    motors: dict[str, MotorChoice] = default({}, "motors of the named joints")
    damping_N_m_s_per_rad: NonNegative | None = default(
        None, "viscous damping of all revolute joints; default: from the URDF"
    )
    damping_N_s_per_m: NonNegative | None = default(
        None, "viscous damping of all prismatic joints; default: from the URDF"
    )
    friction_N_m: NonNegative | None = default(None, "dry friction of all revolute joints; default: from the URDF")
    friction_N: NonNegative | None = default(None, "dry friction of all prismatic joints; default: from the URDF")
    initial_deg: dict[str, float] = default(
        {}, "initial angles of the named revolute joints; default: the coupling, or the legal angle nearest to 0"
    )
    initial_m: dict[str, float] = default(
        {}, "initial positions of the named prismatic joints; default: the coupling, or the legal position nearest to 0"
    )
    initial_pose: dict[str, PoseConfig] = default(
        {}, "initial poses of the bodies of the named floating and planar joints"
    )
    lock_deg: dict[str, float] = default({}, "angles of the named revolute joints that are locked")
    lock_m: dict[str, float] = default({}, "positions of the named prismatic joints that are locked")
    hand: BodyPoint | None = default(
        None,
        "controlled point on a body or in a frame; default: the link `hand` if it moves, "
        "otherwise the tip with the most moving joints",
    )

    @model_validator(mode="after")
    def _check_joints(self) -> Self:
        """Check the names and kinds of joints here, so that errors include a line; ``build`` reports all others."""
        from dynsim.model.urdf.reader import MOVING, SEVERAL, read_tree

        for name, joint in self.joints.items():
            if joint.motor is not None and name in self.motors:
                raise error_at(f"joints.{name}.motor", f"conflicts with plant.motors.{name}; remove one of the two")
        try:
            if not is_file(self.file, ModelError):
                raise error_at("file", "file not found")
            tree = read_tree(Path(self.file), self.corrections())
        except ModelError:
            return self
        joints = tree.joints
        locked = {*self.lock_deg, *self.lock_m}
        units = {"revolute": "deg", "prismatic": "m"}
        stated = [
            (key, name, f"{key}.{name}")
            for key in ("motors", *POSITIONS, "initial_pose")
            for name in getattr(self, key)
        ]
        stated += [
            (member, name, f"joints.{name}.{member}")
            for name, joint in self.joints.items()
            for member in JointCorrection.model_fields
            if getattr(joint, member) is not None
        ]
        for name in self.links:
            if name not in tree.links:
                raise error_at(f"links.{name}", f"unknown link {name!r}{suggest(name, tree.links)}")
        for key, name, path in stated:
            if name not in joints:
                moving = ", ".join(joint.name for joint in joints.values() if joint.kind != "fixed")
                raise error_at(path, f"unknown joint {name!r}{suggest(name, joints)}; joints in the file: {moving}")
            kind = MOVING.get(joints[name].kind, joints[name].kind)
            if kind in SEVERAL:
                if key == "initial_pose":
                    continue
                start = f"; set its start in plant.initial_pose.{name}" if key in POSITIONS else ""
                raise error_at(path, f"{name!r} is {kind} and cannot have a motor, losses, angle or distance{start}")
            if kind not in units:
                raise error_at(path, f"{name!r} is {kind} and cannot have a motor, losses or position; remove it")
            if key == "initial_pose":
                raise error_at(path, f"{name!r} is {kind}; use plant.initial_{units[kind]}")
            family, _, unit = key.partition("_")
            if unit and unit != units[kind]:
                instead = path.replace(key, f"{family}_{units[kind]}").removesuffix(f".{name}")
                raise error_at(path, f"{name!r} is {kind}; use plant.{instead}")
            if name in locked and family in ("motors", "initial", "motor"):
                raise error_at(path, f"{name!r} is locked by plant.lock_{units[kind]}; remove one of the two")
        return self

    def corrections(self) -> Corrections:
        """Return the corrections of the file."""
        from dynsim.model.urdf.reader import Corrections

        return Corrections(
            {name: link.values() for name, link in self.links.items()},
            {name: values for name, joint in self.joints.items() if (values := joint.values())},
            nearest=self.inertia == "nearest",
            floating=self.base == "floating",
        )


def build(config: Config, context: BuildContext) -> Robot:
    """Build the robot described in the URDF file, with the motors of the scenario.

    Raises
    ------
    ModelError
        If the file is invalid (see :func:`dynsim.model.urdf.reader.read_urdf`), or the body of the hand does not
        exist.
    """
    from dynsim.model.urdf.reader import read_urdf

    lock = {**{name: float(np.deg2rad(angle)) for name, angle in config.lock_deg.items()}, **config.lock_m}
    robot = read_urdf(Path(config.file), lock, config.corrections())
    initial = {**{name: np.deg2rad(angle) for name, angle in config.initial_deg.items()}, **config.initial_m}
    stated: dict[str, dict[str, Any]] = {
        "revolute": {"damping": config.damping_N_m_s_per_rad, "friction": config.friction_N_m},
        "prismatic": {"damping": config.damping_N_s_per_m, "friction": config.friction_N},
    }
    # Joints with several degrees of freedom have no damping, friction or motors.
    single = [link for link in robot.links if link.joint_of_rows is None]

    def losses(link: Link) -> dict[str, Any]:
        own = getattr(config.joints.get(link.joint), "__dict__", {})
        return {key: loss for key, loss in stated[link.kind].items() if loss is not None and own.get(key) is None}

    links = tuple(
        dataclasses.replace(link, **losses(link)) if link.joint_of_rows is None else link for link in robot.links
    )
    radii = {name: link.radius_m for name, link in config.links.items() if link.radius_m is not None}
    for name in radii:
        with errors_at("plant", "links", name, "radius_m"):
            carrier = robot.links[robot.attach(name, np.zeros(3))[0]].name
            if carrier != name:
                raise ModelError(f"{name!r} is fixed to {carrier!r}; set plant.links.{carrier}.radius_m")
    links = tuple(dataclasses.replace(link, radius=radii.get(link.name, link.radius)) for link in links)
    followers = {coupling.joint for coupling in robot.couplings}
    motors = config.motors | {name: joint.motor for name, joint in config.joints.items() if joint.motor is not None}
    chosen = {link.joint: motors.get(link.joint, None if link.joint in followers else config.motor) for link in single}
    hand, axes = robot.hand, robot.hand_frame
    q0 = _initial(robot, initial, config.initial_pose)
    if config.hand is not None:
        with errors_at("plant", "hand", "body"):
            body, point = robot.attach(config.hand.body, np.array(config.hand.point_m))
        hand, axes = (robot.links[body].name, point), robot.attached_axes(config.hand.body)
    return dataclasses.replace(
        robot,
        links=links,
        motors=tuple(
            _mounted(families.build("motor", motor, context.at_joint(joint), Drive), robot, config)
            for joint, motor in chosen.items()
            if motor is not None
        ),
        hand=hand,
        hand_frame=axes,
        gravity=np.array(config.gravity_m_s2),
        q0=q0,
        nearest=tuple(
            link.joint
            for link, k in zip(robot.links, robot.position_index, strict=True)
            if link in single and q0[k] and link.joint not in {*initial, *followers}
        ),
    )


def _mounted(motor: Drive, robot: Robot, config: Config) -> Drive:
    """Return the motor with its mass in the axes of the body to which the link before its joint belongs."""
    from dynsim.model.urdf.reader import read_tree

    if motor.mass_point is None:
        return motor
    parent = read_tree(Path(config.file), config.corrections()).joints[motor.joint].parent
    frame = next((frame for frame in robot.frames if frame.name == parent), None)
    if frame is None:
        return motor
    return dataclasses.replace(motor, mass_point=frame.R @ motor.mass_point + frame.p)


def _initial(robot: Robot, positions: dict[str, float], poses: dict[str, PoseConfig]) -> Array:
    """Return the coordinates of all joints, (nq,); floating and planar joints use the poses of their bodies."""
    from dynsim.model.urdf.reader import rotation
    from dynsim.record.scene import quaternion

    q, index = robot.configuration(positions), robot.position_index
    for name, pose in poses.items():
        rows = [i for i, link in enumerate(robot.links) if link.joint_of_rows == name]
        p, R = np.array(pose.position_m), rotation(*np.deg2rad(pose.rpy_deg))
        if len(rows) == 6:
            q[index[rows[0]] : index[rows[0]] + 7] = *p, *quaternion(R)
            continue
        x, y, normal = (robot.links[i].axis for i in rows)
        path = f"plant.initial_pose.{name}"
        for key, off in (("position_m", abs(normal @ p)), ("rpy_deg", float(np.abs(R @ normal - normal).max()))):
            if off > 1e-9:
                raise ModelError(f"{path}.{key}: must lie in the plane of the joint (normal {normal.tolist()})")
        q[index[rows[0]] : index[rows[0]] + 3] = x @ p, y @ p, np.arctan2(y @ R @ x, x @ R @ x)
    return q


def start_keys(config: Config, positions: Mapping[str, float]) -> dict[str, Any]:
    """Return the keys that start the robot at the given coordinates [rad, m, or 1 for quaternions].

    Joints without a position, such as followers, are omitted.
    """
    from dynsim.model.joints.planar import planar
    from dynsim.model.urdf.reader import MOVING, read_tree
    from dynsim.record.quaternion import of_turn
    from dynsim.record.urdf_text import roll_pitch_yaw, rotation

    keys: dict[str, dict[str, Any]] = {"initial_deg": {}, "initial_m": {}, "initial_pose": {}}
    for name, joint in read_tree(Path(config.file), config.corrections()).joints.items():
        if name in positions:
            angle = MOVING[joint.kind] == "revolute"
            value = float(np.rad2deg(positions[name])) if angle else positions[name]
            keys["initial_deg" if angle else "initial_m"][name] = value
            continue
        if f"{name}.x" not in positions:
            continue
        if joint.kind == "planar":
            x, y, normal = (row.axis for row in planar(joint.link))
            point = positions[f"{name}.x"] * x + positions[f"{name}.y"] * y
            turn = of_turn(normal, positions[f"{name}.angle"])
        else:
            point = np.array([positions[f"{name}.{axis}"] for axis in "xyz"])
            turn = np.array([positions[f"{name}.q{part}"] for part in "wxyz"])
        rpy = np.rad2deg(roll_pitch_yaw(rotation(turn))).tolist()
        keys["initial_pose"][name] = {"position_m": point.tolist(), "rpy_deg": rpy}
    return {key: values for key, values in keys.items() if values}
