"""A serial chain of cylindrical links on a fixed base, with a motor at every joint ([WM] section IV)."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.config import NonNegative, Positive, StrictConfig, Vector3, unit_vector
from dynsim.families import union
from dynsim.model.description import Inertia, Link, Motor, Robot, vector

ENGINE = "dynamics"

MotorChoice = union("motor")
AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}


class LinkConfig(StrictConfig):
    """One joint and the link it carries, or ``count`` equal ones. The link lies along its own +z from the joint."""

    count: int = Field(default=1, ge=1, le=100_000)
    kind: Literal["revolute", "prismatic"] = "revolute"
    axis: Literal["x", "y", "z"] | Vector3 = "y"
    length_m: NonNegative = 0.3
    radius_m: Positive = 0.01
    mass_kg: NonNegative = 0.1
    com_m: Vector3 | None = Field(default=None, description="default: the middle of the link")
    inertia_kg_m2: list[float] | None = Field(
        default=None, min_length=6, max_length=6, description="xx xy xz yy yz zz about the com; default: solid cylinder"
    )
    damping_N_m_s_per_rad: NonNegative = 0.0
    motor: MotorChoice | None = Field(default=None, description="motor of the joint; none: the joint swings free")
    initial_deg: float = 0.0
    initial_m: float = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind == "prismatic" and self.initial_deg != 0.0:
            raise ValueError("a prismatic joint starts at initial_m, not initial_deg")
        if self.kind == "revolute" and self.initial_m != 0.0:
            raise ValueError("a revolute joint starts at initial_deg, not initial_m")
        return self

    def unit_axis(self) -> np.ndarray:
        return unit_vector(AXES[self.axis] if isinstance(self.axis, str) else self.axis, "axis")

    def inertia(self) -> Inertia:
        solid = Inertia.solid_cylinder(self.mass_kg, self.radius_m, self.length_m)
        com = solid.com if self.com_m is None else np.array(self.com_m)
        tensor = solid.tensor
        if self.inertia_kg_m2 is not None:
            xx, xy, xz, yy, yz, zz = self.inertia_kg_m2
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return Inertia(self.mass_kg, com, tensor)


class BaseConfig(StrictConfig):
    """Where the chain stands."""

    position_m: Vector3 = [0.0, 0.0, 0.0]
    yaw_deg: float = 0.0


class HandConfig(StrictConfig):
    """The controlled point."""

    body: str
    point_m: Vector3 = [0.0, 0.0, 0.0]


class Config(StrictConfig):
    """A serial chain: ``chain`` lists its links from the base on; ``link`` gives what all of them share."""

    type: Literal["serial_arm"]
    base: BaseConfig = BaseConfig()
    gravity_m_s2: Vector3 = [0.0, 0.0, -9.81]
    link: dict[str, Any] = Field(default={}, description="defaults for every entry of chain")
    chain: list[LinkConfig] = Field(min_length=1, description="links from the base to the hand")
    initial_deg: list[float] | None = Field(default=None, description="initial angles of all joints")
    hand: HandConfig | None = Field(default=None, description="controlled point; default: the end of the last link")

    @model_validator(mode="before")
    @classmethod
    def _share(cls, data: Any) -> Any:
        """Lay ``link`` under every entry of ``chain``."""
        if isinstance(data, dict) and isinstance(data.get("link"), dict) and isinstance(data.get("chain"), list):
            chain = [{**data["link"], **entry} if isinstance(entry, dict) else entry for entry in data["chain"]]
            # What was laid under is kept out of ``link``, so that a resolved scenario can be read again.
            return {**data, "chain": chain, "link": {}}
        return data

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = sum(link.count for link in self.chain)
        if self.initial_deg is not None:
            if len(self.initial_deg) != n:
                raise ValueError(f"initial_deg has {len(self.initial_deg)} angles, the chain has {n} joints")
            if any(link.kind == "prismatic" for link in self.chain):
                raise ValueError(
                    "initial_deg is for chains of revolute joints; give initial_m and initial_deg per link"
                )
        return self


def build(config: Config) -> Robot:
    """The chain as a tree of bodies ``link_1``…, with joints ``joint_1``… and initial positions.

    The link's own frame sits in its joint, +z along the link; the base is turned by ``base.yaw_deg`` about +z.
    """
    yaw = np.deg2rad(config.base.yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    links: list[Link] = []
    motors: list[Motor] = []
    initial: list[float] = []
    reach = 0.0
    for group in config.chain:
        for _ in range(group.count):
            number = len(links) + 1
            first = not links
            links.append(
                Link(
                    name=f"link_{number}",
                    joint=f"joint_{number}",
                    parent=None if first else links[-1].name,
                    kind=group.kind,
                    axis=group.unit_axis(),
                    inertia=group.inertia(),
                    R_PJ=turn if first else np.eye(3),
                    p_PJ=np.array(config.base.position_m) if first else vector(0.0, 0.0, reach),
                    damping=group.damping_N_m_s_per_rad,
                )
            )
            if group.motor is not None:
                motors.append(group.motor.motor(f"joint_{number}"))
            initial.append(group.initial_m if group.kind == "prismatic" else np.deg2rad(group.initial_deg))
            reach = group.length_m
    if config.initial_deg is not None:
        initial = list(np.deg2rad(config.initial_deg))
    hand = (links[-1].name, vector(0.0, 0.0, reach))
    if config.hand is not None:
        hand = (config.hand.body, np.array(config.hand.point_m))
    return Robot(
        name="serial_arm",
        links=tuple(links),
        motors=tuple(motors),
        hand=hand,
        gravity=np.array(config.gravity_m_s2),
        q0=np.array(initial),
    )
