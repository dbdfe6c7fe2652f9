"""An arm on a fixed base whose bodies and joints come from a URDF file; motors are added by the scenario."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from dynsim.config import BodyPoint, NonNegative, StrictConfig, Vector3
from dynsim.errors import ModelError
from dynsim.families import union
from dynsim.inputs import check_file
from dynsim.model.description import Robot
from dynsim.model.motor_parameters import MotorParameters

ENGINE = "dynamics"

if TYPE_CHECKING:
    MotorChoice = MotorParameters
else:
    MotorChoice = union("motor")


class Config(StrictConfig):
    """A robot from ``file`` (relative to the scenario), one motor model for all joints or one per joint."""

    type: Literal["urdf_arm"]
    file: str = Field(description="URDF file, relative to the scenario file")
    gravity_m_s2: Vector3 = [0.0, 0.0, -9.81]
    motor: MotorChoice | None = Field(default=None, description="motor of every joint that `motors` does not name")
    motors: dict[str, MotorChoice] = Field(default={}, description="motors by joint name")
    damping_N_m_s_per_rad: NonNegative | None = Field(
        default=None, description="loss of every revolute joint; default: the URDF's"
    )
    damping_N_s_per_m: NonNegative | None = Field(
        default=None, description="loss of every prismatic joint; default: the URDF's"
    )
    initial_deg: dict[str, float] = Field(default={}, description="initial angles of revolute joints by name; others 0")
    initial_m: dict[str, float] = Field(default={}, description="initial positions of prismatic joints; others 0")
    hand: BodyPoint | None = Field(default=None, description="controlled point; default: the tip of the longest chain")


def build(config: Config) -> Robot:
    """The robot of the file with the scenario's motors.

    Raises
    ------
    ModelError
        Unreadable file, a joint name that the file does not have, or an initial position in the other kind's unit.
    """
    from dynsim.model.urdf import read_urdf

    check_file(config.file, partial(ModelError, keys=("plant", "file")))
    robot = read_urdf(Path(config.file))
    kinds = {link.joint: link.kind for link in robot.links}
    for name in [*config.motors, *config.initial_deg, *config.initial_m]:
        if name not in kinds:
            raise ModelError(f"{config.file}: no joint {name!r}; joints: {', '.join(kinds)}")
    for name in config.initial_deg:
        if kinds[name] == "prismatic":
            raise ModelError(f"plant.initial_deg: {name!r} is prismatic; give it in plant.initial_m")
    for name in config.initial_m:
        if kinds[name] == "revolute":
            raise ModelError(f"plant.initial_m: {name!r} is revolute; give it in plant.initial_deg")
    initial = {**{name: np.deg2rad(angle) for name, angle in config.initial_deg.items()}, **config.initial_m}
    given = {"revolute": config.damping_N_m_s_per_rad, "prismatic": config.damping_N_s_per_m}
    links = tuple(
        link if (loss := given[link.kind]) is None else dataclasses.replace(link, damping=loss) for link in robot.links
    )
    chosen = {joint: config.motors.get(joint, config.motor) for joint in kinds}
    return dataclasses.replace(
        robot,
        links=links,
        motors=tuple(motor.motor(joint) for joint, motor in chosen.items() if motor is not None),
        hand=robot.hand if config.hand is None else (config.hand.body, np.array(config.hand.point_m)),
        gravity=np.array(config.gravity_m_s2),
        q0=np.array([initial.get(joint, 0.0) for joint in kinds]),
    )
