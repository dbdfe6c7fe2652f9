"""Arm on a wheeled base with power wheeled steering (PWS): two wheels with optional motors, and a caster.

The wheels roll without slip ([WM] II.E, eqs 36–50).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import BASE_WHEEL_WIDTH
from dynsim.config.base import NonNegative, Pair, Positive, StrictConfig, Vector3, default, error_at
from dynsim.errors import ModelError
from dynsim.library import families
from dynsim.model.description import Array, Frame, Inertia, Link, Robot, vector
from dynsim.model.drives import Drive
from dynsim.model.joints.wheels import wheeled
from dynsim.model.mobile_base import MobileBase
from dynsim.record.quaternion import of_turn
from dynsim.record.scene import Shape

ENGINE = "dynamics"
BASE = "base"

MotorChoice: Any = families.union("motor")
ArmChoice: Any = families.union("plant", only=("serial_arm", "urdf_arm"))


class WheelConfig(StrictConfig):
    """Parameters of both wheels: solid discs with separate motors and their axle at height r."""

    mass_kg: NonNegative = default(0.25, "mass of each wheel")
    radius_m: Positive = default(0.05, "radius r of each wheel")
    inertia_axle_kg_m2: NonNegative | None = default(None, "moment of inertia about the axle; default: m r²/2")
    inertia_across_kg_m2: NonNegative | None = default(None, "moment of inertia across the axle; default: m r²/4")
    damping_N_m_s_per_rad: NonNegative = default(0.0, "viscous damping of each wheel")
    motor: MotorChoice | None = default(None, "motor of each wheel; default: no motor")

    @model_validator(mode="after")
    def _check_moments(self) -> Self:
        axle, across = self.moments
        if axle > 2.0 * across * (1.0 + 1e-9):
            key = "inertia_axle_kg_m2" if self.inertia_axle_kg_m2 is not None else "inertia_across_kg_m2"
            raise error_at(
                key, f"{axle:g} about the axle must not exceed twice the transverse moment ({across:g}); change one"
            )
        return self

    @property
    def moments(self) -> tuple[float, float]:
        """Moments of inertia about the axle and perpendicular to it [kg m²]."""
        square = self.mass_kg * self.radius_m**2
        axle, across = self.inertia_axle_kg_m2, self.inertia_across_kg_m2
        return 0.5 * square if axle is None else axle, 0.25 * square if across is None else across


class Mount(StrictConfig):
    """Mounting pose of the arm in the frame of the base."""

    position_m: Vector3 = default([0.0, 0.0, 0.1], "position of the arm's base")
    yaw_deg: float = default(0.0, "rotation about the vertical axis")


class Base(StrictConfig):
    """Mobile base; its frame is on the floor below the middle of the axle, with x forward and z up."""

    position_m: Pair = default([0.0, 0.0], "initial x and y in the world")
    heading_deg: float = default(0.0, "initial heading")
    mass_kg: NonNegative = default(4.0, "mass of the body without wheels")
    com_m: Vector3 = default([0.05, 0.0, 0.08], "centre of mass of the body without wheels")
    inertia_kg_m2: list[float] = default(
        [0.03, 0.0, 0.0, 0.05, 0.0, 0.06],
        "inertia tensor xx, xy, xz, yy, yz, zz of the body without wheels, about its centre of mass",
        min_length=6,
        max_length=6,
    )
    wheel: WheelConfig = default(WheelConfig(), "both wheels")
    track_m: Positive = default(0.3, "distance between the wheels")
    caster_m: Vector3 = default([0.15, 0.0, 0.0], "contact point of the caster with the floor, without friction")
    wheel_friction: Positive = default(0.8, "coefficient of friction between wheels and floor, for the traction demand")
    on_overturn: Literal["warn", "stop"] = default(
        "warn",
        "reaction to overturning: `warn` and continue as if the base were held down, or `stop` the run (exit code 3)",
    )
    mount: Mount = default(Mount(), "mounting pose of the arm")

    @field_validator("caster_m")
    @classmethod
    def _check_caster(cls, caster: list[float]) -> list[float]:
        if caster[2] != 0.0:
            raise ValueError(f"the third coordinate must be 0 (the caster touches the floor), got {caster[2]:g}")
        if abs(caster[0]) < 1e-9:
            raise ValueError(
                "must not be on the axle, otherwise the base has no support triangle; change the first coordinate"
            )
        return caster


class Config(StrictConfig):
    """Mobile base with an arm."""

    type: Literal["pws_arm"]
    base: Base = default(Base(), "mobile base")
    arm: ArmChoice = Field(description="arm on the base: a `serial_arm` or `urdf_arm`")

    @model_validator(mode="after")
    def _check_arm(self) -> Self:
        # Accept the default pose, because resolved scenarios contain it.
        if self.arm.base not in ("fixed", type(self.arm).model_fields["base"].default):
            raise error_at("arm.base", "conflicts with plant.base.mount, the pose of the arm; remove arm.base")
        return self


def build(config: Config, context: BuildContext) -> Robot:
    """Build the base as a joint whose rates are the wheel rates, with the arm's bodies on it.

    The mass and transverse inertia of the wheels belong to the base, and their inertia about the axle belongs to the
    wheel joints. On flat ground this gives the energy of real wheels, T = ½ I_a φ̇² + ½ I_t ω² + ½ m v². The motors of
    the wheels are fixed to the base.

    Raises
    ------
    ModelError
        If the arm is invalid, a body of the arm has the same name as the base or one of its parts, or an inertia is
        not physical.
    """
    arm = families.build("plant", config.arm, context, Robot)
    base, wheel = config.base, config.base.wheel
    axle, across = wheel.moments
    yaw = np.deg2rad(base.mount.yaw_deg)
    mount, turned = (_turn(yaw), np.array(base.mount.position_m)), of_turn((0.0, 0.0, 1.0), yaw)
    parts, wheels, motors = [_body(base), arm.fixed_inertia.placed(*mount)], (f"{BASE}.left", f"{BASE}.right"), []
    for joint, side in zip(wheels, (0.5, -0.5), strict=True):
        hub = vector(0.0, side * base.track_m, wheel.radius_m)
        parts.append(Inertia(wheel.mass_kg, hub, np.diag([across, axle, across])))
        if wheel.motor is not None:
            motor: Drive = families.build("motor", wheel.motor, context.at_joint(joint), Drive)
            # The wheel joints do not have separate bodies, so the mass of the motor is added to the base.
            parts.append(Inertia(motor.mass, hub if motor.mass_point is None else motor.mass_point))
            motors.append(replace(motor, mass=0.0, mass_point=None))
    body = Link(
        name=BASE,
        joint=BASE,
        parent=None,
        kind="left_wheel",
        axis=vector(1.0, 0.0, 0.0),
        inertia=Inertia.merged(parts),
        R_PJ=_turn(np.deg2rad(base.heading_deg)),
        p_PJ=np.array([*base.position_m, 0.0]),
        damping=wheel.damping_N_m_s_per_rad,
        shapes=(*_shapes(base), *(shape.placed(mount[1], turned) for shape in arm.fixed_shapes)),
        solids=(_shapes(base)[0], *(shape.placed(mount[1], turned) for shape in arm.fixed_solids)),
        armature=axle,
    )
    rows = wheeled(body, wheel.radius_m, base.track_m)
    taken = {name for row in rows for name in (row.name, row.joint)}
    for name in (name for link in arm.links for name in (link.name, link.joint)):
        if name in taken:
            raise ModelError(
                f"plant.arm: {name!r} is also a name of the mobile base; rename it in the arm", keys=("plant", "arm")
            )
    return replace(
        arm,
        name="pws_arm",
        links=(*rows, *(_mounted(link, *mount) for link in arm.links)),
        motors=(*motors, *arm.motors),
        frames=tuple(_framed(frame, *mount) for frame in arm.frames if frame.name not in taken),
        fixed_shapes=(),
        fixed_solids=(),
        fixed_inertia=Inertia(0.0),
        q0=np.concatenate([np.zeros(4), arm.initial]),
        base=MobileBase(
            body=BASE,
            wheels=wheels,
            wheel_radius=wheel.radius_m,
            track=base.track_m,
            caster=np.array(base.caster_m),
            spin_inertia=axle,
            wheel_friction=base.wheel_friction,
            stop_on_overturn=base.on_overturn == "stop",
        ),
    )


def start_keys(config: Config, positions: Mapping[str, float]) -> dict[str, Any]:
    """Return the keys that start the robot at the given coordinates [rad or m], with unwound wheels."""
    base, yaw = config.base, math.radians(config.base.heading_deg)
    left, right, x, y = (positions[f"{BASE}.{name}"] for name in ("left", "right", "x", "y"))
    heading = base.heading_deg + math.degrees(base.wheel.radius_m / base.track_m * (right - left))
    position = np.array(base.position_m) + _turn(yaw)[:2, :2] @ [x, y]
    arm = families.member("plant", config.arm.type).start_keys(config.arm, positions)
    return {"base": {"position_m": position.tolist(), "heading_deg": heading}, "arm": arm}


def _body(base: Base) -> Inertia:
    xx, xy, xz, yy, yz, zz = base.inertia_kg_m2
    body = Inertia(base.mass_kg, np.array(base.com_m), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    try:
        body.check("plant.base")
    except ModelError as error:
        raise ModelError(str(error), keys=("plant", "base", "inertia_kg_m2")) from None
    return body


def _turn(yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _mounted(link: Link, R: Array, p: Array) -> Link:
    """Return a link of the arm, moved from the ground to the base."""
    if link.parent is not None:
        return link
    # If the mount is not rotated, R_PJ remains exactly the identity, which the kernels exploit.
    return replace(link, parent=BASE, R_PJ=R @ link.R_PJ, p_PJ=p + R @ link.p_PJ)


def _framed(frame: Frame, R: Array, p: Array) -> Frame:
    return frame if frame.body is not None else Frame(frame.name, BASE, R @ frame.R, p + R @ frame.p)


def _shapes(base: Base) -> tuple[Shape, ...]:
    """Return the shapes to display: a plate from axle to caster, and the caster's ball; wheels are separate bodies."""
    r, x, y = base.wheel.radius_m, base.caster_m[0], base.caster_m[1]
    front, back = max(x, 0.0) + 0.5 * r, min(x, 0.0) - r
    low, high = 0.6 * r, max(base.mount.position_m[2], 1.6 * r)
    size = (front - back, base.track_m - BASE_WHEEL_WIDTH * r, high - low)
    plate = Shape("box", size, (0.5 * (front + back), 0.0, 0.5 * (low + high)))
    return plate, Shape("sphere", (0.3 * r,), (x, y, 0.3 * r))
