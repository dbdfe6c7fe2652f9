"""An arm on a wheeled base with power wheeled steering (PWS): two wheels, each may be driven, and a caster.

The wheels roll without slip ([WM] II.E, eqs 36–50).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import BASE_WHEEL_WIDTH
from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3, error_at
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
    """Both wheels: solid discs at axle height r, each on its own motor."""

    mass_kg: NonNegative = 0.25
    radius_m: Positive = 0.05
    inertia_axle_kg_m2: NonNegative | None = Field(default=None, description="about the axle; default: m r²/2")
    inertia_across_kg_m2: NonNegative | None = Field(default=None, description="across it; default: m r²/4")
    damping_N_m_s_per_rad: NonNegative = Field(default=0.0, description="viscous loss of each wheel's joint")
    motor: MotorChoice | None = Field(default=None, description="of each wheel; none: it rolls free")

    @model_validator(mode="after")
    def _check_moments(self) -> Self:
        axle, across = self.moments
        if axle > 2.0 * across * (1.0 + 1e-9):
            key = "inertia_axle_kg_m2" if self.inertia_axle_kg_m2 is not None else "inertia_across_kg_m2"
            raise error_at(key, f"{axle:g} about the axle is more than twice {across:g} across it, as of no real wheel")
        return self

    @property
    def moments(self) -> tuple[float, float]:
        """Moments of inertia about the axle and across it [kg m²]."""
        square = self.mass_kg * self.radius_m**2
        axle, across = self.inertia_axle_kg_m2, self.inertia_across_kg_m2
        return 0.5 * square if axle is None else axle, 0.25 * square if across is None else across


class Mount(StrictConfig):
    """Where the arm stands on the base, in the base's frame."""

    position_m: Vector3 = [0.0, 0.0, 0.1]
    yaw_deg: float = 0.0


class Base(StrictConfig):
    """The base; its frame lies on the floor below the middle of the axle, x ahead, z up."""

    position_m: list[float] = Field(default=[0.0, 0.0], min_length=2, max_length=2, description="where it starts")
    heading_deg: float = Field(default=0.0, description="heading at the start")
    mass_kg: NonNegative = Field(default=4.0, description="of the body, without wheels")
    com_m: Vector3 = [0.05, 0.0, 0.08]
    inertia_kg_m2: list[float] = Field(
        default=[0.03, 0.0, 0.0, 0.05, 0.0, 0.06],
        min_length=6,
        max_length=6,
        description="xx xy xz yy yz zz of the body about its com",
    )
    wheel: WheelConfig = WheelConfig()
    track_m: Positive = Field(default=0.3, description="distance of the wheels")
    caster_m: Vector3 = Field(default=[0.15, 0.0, 0.0], description="where the caster touches the floor: no friction")
    wheel_friction: Positive = Field(default=0.8, description="between wheels and floor, for the traction demand")
    on_overturn: Literal["warn", "stop"] = Field(
        default="warn", description="go on as if held down, and say so, or stop the run there (exit code 3)"
    )
    mount: Mount = Mount()

    @field_validator("caster_m")
    @classmethod
    def _check_caster(cls, caster: list[float]) -> list[float]:
        if caster[2] != 0.0:
            raise ValueError(f"it touches the floor: its third coordinate must be 0, not {caster[2]:g}")
        if abs(caster[0]) < 1e-9:
            raise ValueError("it lies on the axle's line, so that the base has no triangle to stand on")
        return caster


class Config(StrictConfig):
    """The base, and an arm with keys of its own."""

    type: Literal["pws_arm"]
    base: Base = Base()
    arm: ArmChoice

    @model_validator(mode="after")
    def _check_arm(self) -> Self:
        # Resolved scenarios have it all; the place of an arm that was given none is no other than that of its mount.
        own = getattr(self.arm, "base", None)
        if own is not None and own != type(own)():
            raise error_at("arm.base", "on a mobile base the arm stands at plant.base.mount; remove arm.base")
        return self


def build(config: Config, context: BuildContext) -> Robot:
    """The base as a joint with the rates of its wheels, and the arm's bodies on it.

    The wheels' masses, and their moments across the axle, are part of the base; their spin is inertia of their joints:
    on flat ground that is the energy of real wheels, T = ½ I_a φ̇² + ½ I_t ω² + ½ m v². Their motors sit on the base.

    Raises
    ------
    ModelError
        The arm says so, one of its bodies has the name of the base or of a part of it, or no real body or wheel can
        have such an inertia.
    """
    arm = families.build("plant", config.arm, context, Robot)
    base, wheel = config.base, config.base.wheel
    axle, across = wheel.moments
    mount = _turn(np.deg2rad(base.mount.yaw_deg)), np.array(base.mount.position_m)
    parts, wheels, motors = [_body(base), arm.fixed_inertia.placed(*mount)], (f"{BASE}.left", f"{BASE}.right"), []
    for joint, side in zip(wheels, (0.5, -0.5), strict=True):
        hub = vector(0.0, side * base.track_m, wheel.radius_m)
        parts.append(Inertia(wheel.mass_kg, hub, np.diag([across, axle, across])))
        if wheel.motor is not None:
            motor: Drive = families.build("motor", wheel.motor, context.at_joint(joint), Drive)
            # The rows of the base carry no body: what the motor weighs cannot be left to its joint.
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
        shapes=(*_shapes(base), *(shape.placed(mount[1], _quaternion(base)) for shape in arm.fixed_shapes)),
        armature=axle,
    )
    rows = wheeled(body, wheel.radius_m, base.track_m)
    taken = {name for row in rows for name in (row.name, row.joint)}
    for name in (name for link in arm.links for name in (link.name, link.joint)):
        if name in taken:
            raise ModelError(
                f"plant.arm: {name!r} is a name of the mobile base too; rename it in the arm", keys=("plant", "arm")
            )
    return replace(
        arm,
        name="pws_arm",
        links=(*rows, *(_mounted(link, *mount) for link in arm.links)),
        motors=(*motors, *arm.motors),
        frames=tuple(_framed(frame, *mount) for frame in arm.frames if frame.name not in taken),
        fixed_shapes=(),
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


def _quaternion(base: Base) -> Any:
    return tuple(of_turn((0.0, 0.0, 1.0), np.deg2rad(base.mount.yaw_deg)).tolist())


def _mounted(link: Link, R: Array, p: Array) -> Link:
    """A link of the arm, standing on the base where it stood on the ground."""
    if link.parent is not None:
        return link
    # R_PJ stays the identity, known to the kernels, where the mount is not turned.
    return replace(link, parent=BASE, R_PJ=R @ link.R_PJ, p_PJ=p + R @ link.p_PJ)


def _framed(frame: Frame, R: Array, p: Array) -> Frame:
    return frame if frame.body is not None else Frame(frame.name, BASE, R @ frame.R, p + R @ frame.p)


def _shapes(base: Base) -> tuple[Shape, ...]:
    """A plate from axle to caster, between the wheels, and the caster's ball; wheels are bodies of the scene."""
    r, x, y = base.wheel.radius_m, base.caster_m[0], base.caster_m[1]
    front, back = max(x, 0.0) + 0.5 * r, min(x, 0.0) - r
    low, high = 0.6 * r, max(base.mount.position_m[2], 1.6 * r)
    size = (front - back, base.track_m - BASE_WHEEL_WIDTH * r, high - low)
    plate = Shape("box", size, (0.5 * (front + back), 0.0, 0.5 * (low + high)))
    return plate, Shape("sphere", (0.3 * r,), (x, y, 0.3 * r))
