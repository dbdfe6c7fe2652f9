"""Arm on a fixed base with bodies and joints from a URDF file and motors from the scenario."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import BodyPoint, NonNegative, StrictConfig, Vector3, default, error_at
from dynsim.config.problems import errors_at, suggest
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.model.description import Array, Robot
from dynsim.model.drives import Drive
from dynsim.system.inputs import is_file

ENGINE = "dynamics"

MotorChoice: Any = families.union("motor")


class PoseConfig(StrictConfig):
    """Pose of a body in the frame of its joint, R = Rz(yaw) Ry(pitch) Rx(roll)."""

    position_m: Vector3 = default([0.0, 0.0, 0.0], "position of the body")
    rpy_deg: Vector3 = default([0.0, 0.0, 0.0], "attitude of the body: roll, pitch, yaw")


class Config(StrictConfig):
    """Robot from a URDF file, with one motor model for all joints or one per joint."""

    type: Literal["urdf_arm"]
    file: str = Field(description="path of a URDF file, relative to the scenario file")
    gravity_m_s2: Vector3 = default([0.0, 0.0, -9.81], "gravitational acceleration")
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
        {}, "initial angles of the named revolute joints; default: 0, or the value of the coupling"
    )
    initial_m: dict[str, float] = default(
        {}, "initial positions of the named prismatic joints; default: 0, or the value of the coupling"
    )
    initial_pose: dict[str, PoseConfig] = default(
        {}, "initial poses of the bodies of the named floating and planar joints"
    )
    lock_deg: dict[str, float] = default({}, "angles of the named revolute joints that are locked")
    lock_m: dict[str, float] = default({}, "positions of the named prismatic joints that are locked")
    hand: BodyPoint | None = default(
        None, "controlled point on a body or in a frame; default: the tip of the longest chain"
    )

    @model_validator(mode="after")
    def _check_joints(self) -> Self:
        """Check the names and kinds of joints here, so that errors include a line; ``build`` reports all others."""
        from dynsim.model.urdf.reader import MOVING, SEVERAL, read_tree

        try:
            if not is_file(self.file, ModelError):
                raise error_at("file", "file not found")
            joints = read_tree(Path(self.file)).joints
        except ModelError:
            return self
        locked = {*self.lock_deg, *self.lock_m}
        units = {"revolute": "deg", "prismatic": "m"}
        for key in ("motors", "initial_deg", "initial_m", "initial_pose", "lock_deg", "lock_m"):
            for name in getattr(self, key):
                path = f"{key}.{name}"
                if name not in joints:
                    moving = ", ".join(joint.name for joint in joints.values() if joint.kind != "fixed")
                    raise error_at(path, f"unknown joint {name!r}{suggest(name, joints)}; joints in the file: {moving}")
                kind = MOVING.get(joints[name].kind, joints[name].kind)
                if kind in SEVERAL:
                    if key == "initial_pose":
                        continue
                    start = "" if key == "motors" else f"; set its start in plant.initial_pose.{name}"
                    raise error_at(path, f"{name!r} is {kind} and cannot have a motor, angle or distance{start}")
                if kind not in units:
                    raise error_at(path, f"{name!r} is {kind} and cannot have a motor or position; remove it")
                if key == "initial_pose":
                    raise error_at(path, f"{name!r} is {kind}; use plant.initial_{units[kind]}")
                family, _, unit = key.partition("_")
                if unit and unit != units[kind]:
                    raise error_at(path, f"{name!r} is {kind}; use plant.{family}_{units[kind]}")
                if name in locked and family != "lock":
                    raise error_at(path, f"{name!r} is locked by plant.lock_{units[kind]}; remove one of the two")
        return self


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
    robot = read_urdf(Path(config.file), lock)
    initial = {**{name: np.deg2rad(angle) for name, angle in config.initial_deg.items()}, **config.initial_m}
    stated: dict[str, dict[str, Any]] = {
        "revolute": {"damping": config.damping_N_m_s_per_rad, "friction": config.friction_N_m},
        "prismatic": {"damping": config.damping_N_s_per_m, "friction": config.friction_N},
    }
    # Joints with several degrees of freedom have no damping, friction or motors.
    single = [link for link in robot.links if link.joint_of_rows is None]
    links = tuple(
        dataclasses.replace(link, **{key: loss for key, loss in stated[link.kind].items() if loss is not None})
        if link.joint_of_rows is None
        else link
        for link in robot.links
    )
    followers = {coupling.joint for coupling in robot.couplings}
    chosen = {
        link.joint: config.motors.get(link.joint, None if link.joint in followers else config.motor) for link in single
    }
    hand, axes = robot.hand, robot.hand_frame
    if config.hand is not None:
        with errors_at("plant", "hand", "body"):
            body, point = robot.attach(config.hand.body, np.array(config.hand.point_m))
        hand, axes = (robot.links[body].name, point), robot.attached_axes(config.hand.body)
    return dataclasses.replace(
        robot,
        links=links,
        motors=tuple(
            families.build("motor", motor, context.at_joint(joint), Drive)
            for joint, motor in chosen.items()
            if motor is not None
        ),
        hand=hand,
        hand_frame=axes,
        gravity=np.array(config.gravity_m_s2),
        q0=_initial(robot, initial, config.initial_pose),
    )


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
