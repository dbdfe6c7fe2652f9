"""Schema of a scenario file: keys with types, units, limits and defaults as frozen pydantic models, and `Scenario`.

This file has one section for each section of a scenario: sensors, ties, loads, objects, contacts, start, integrator.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, StrictInt, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import WHEEL_WIDTH, turn_from_z
from dynsim.config.base import (
    BodyPoint,
    Direction,
    Lengths,
    Limits,
    NonNegative,
    Positive,
    StrictConfig,
    Vector3,
    default,
    error_at,
    unit_vector,
)
from dynsim.config.problems import Origin, listed
from dynsim.library.families import build, engine, section_defaults, union
from dynsim.model.description import WORLD, Array, Foot, Frame, Inertia, Link, Tie
from dynsim.model.drives import Drive
from dynsim.model.gripper import grasp_frame
from dynsim.model.joints.ball import floating
from dynsim.record import record
from dynsim.record.csv_rows import read_rows
from dynsim.record.scene import HERE, Shape, quaternion
from dynsim.scenario.combinations import BILATERAL_KEYS, METHODS, THETA, UNILATERAL_KEYS, check_keys
from dynsim.scenario.effect import idle_keys, is_set

# Section `sensors`: sampling rate, delay, resolution and noise of the controller's inputs; recorded sensors on links.

# Rate of a sensor [Hz]; it is limited because each sample requires a Python call.
Rate = Annotated[float, Field(gt=0.0, le=1e5)]
# Resolution of MX-series servos [deg]: 4096 positions per turn (data sheet).
MX_RESOLUTION = math.degrees(2.0 * math.pi / 4096)


class Sensor(StrictConfig):
    """Sampled sensor; the controller reads the last sample that has arrived."""

    rate_hz: Rate | None = default(None, "sampling rate; default: one sample per controller tick")
    delay_s: NonNegative = default(0.0, "delay between a sample and its arrival")


class Encoders(Sensor):
    """Joint encoders; joint rates are computed from differences of samples."""

    resolution_deg: NonNegative = default(
        MX_RESOLUTION, "resolution of joint angles; default: 4096 positions per turn, as in MX servos"
    )
    noise_deg: NonNegative = default(0.0, "standard deviation of the noise of joint angles, before rounding")
    resolution_m: NonNegative = default(0.0, "resolution of prismatic joints")
    noise_m: NonNegative = default(0.0, "standard deviation of the noise of prismatic joints, before rounding")


class MotionCapture(Sensor):
    """Motion capture of the position and attitude of a snake's controlled point ([T] V.A)."""

    rate_hz: Rate | None = default(100.0, "sampling rate (assumed)")
    delay_s: NonNegative = default(0.01, "delay between a sample and its arrival (assumed)")
    position_noise_m: NonNegative = default(2e-4, "standard deviation of the noise of each coordinate (assumed)")
    attitude_noise_rad: NonNegative = default(5e-4, "standard deviation of the noise of each angle (assumed)")


class LinkSensorConfig(StrictConfig):
    """Recorded sensor on a link: the body that carries it, and its position and axes on this body."""

    body: str = Field(description="name of the body that carries the sensor")
    frame: str | None = default(
        None, "frame fixed to `body`, from which the sensor has its axes; default: the frame of `body`"
    )
    point_m: Vector3 = default([0.0, 0.0, 0.0], "point of the sensor, in the axes of `frame`")


class WrenchSensor(LinkSensorConfig):
    """Exact force and torque that the parent of `body` exerts on it; the torque is about the point of the sensor.

    They act across the joint that carries `body`, not across a fixed joint of `frame`.
    """


class Sensors(StrictConfig):
    """Sensors of the robot; without a sensor the controller reads the exact state without delay."""

    seed: StrictInt = default(0, "seed of the noise of all sensors; equal seeds give equal noise", ge=0)
    encoders: Encoders | None = default(None, "joint encoders; default: exact joint angles and rates")
    motion_capture: MotionCapture | None = default(
        None, "motion capture of a snake's controlled point; default: the exact pose"
    )
    wrench: dict[str, WrenchSensor] | None = default(
        None, "named six-axis force/torque sensors at joints, recorded; default: no such sensors"
    )


# Section `ties`: bounded springs and dampers between two bodies of the robot or of objects.


class TieConfig(StrictConfig):
    """Ends and direction of a tie; `LAW` contains the keys of its stiffness, damping and bound."""

    LAW: ClassVar[tuple[str, str, str]]

    body: str = Field(description="first end: a body, or a frame fixed to a body")
    other: str = Field(description="second end: a body, a frame fixed to a body, or `world`")
    axis: Direction = Field(description="direction of the tie, in the axes of `body`")
    pushes: bool = default(False, "only push `body` along the axis, away from `other`")
    holds: bool = default(True, "active at the start; `Simulation.set_tie` changes it")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.body == self.other:
            raise error_at("other", f"must differ from body ({self.body!r}); a tie connects two bodies")
        stiffness, damping, bound = self.LAW
        if not getattr(self, stiffness) + getattr(self, damping) > 0.0:
            raise error_at(stiffness, f"must be positive if {damping} is 0; set one of the two")
        if self.pushes and getattr(self, bound) is not None:
            raise error_at(bound, "is not available for a tie that only pushes; remove it")
        return self

    def tie(self, name: str) -> Tie:
        """Return the tie."""
        stiffness, damping, bound = (getattr(self, key) for key in self.LAW)
        bound = math.inf if bound is None else bound
        ends = self.body, self.other, np.array(self.axis)
        return Tie(name, *ends, stiffness, damping, bound, pushes=self.pushes, rest=math.nan, holds=self.holds)


class Linear(TieConfig):
    """Linear tie along the axis: f = −k (x − x_0) − c dx/dt on `body`, with x = axis · (point − other point)."""

    LAW = "stiffness_N_per_m", "damping_N_s_per_m", "bound_N"

    type: Literal["linear"]
    point_m: Vector3 = default([0.0, 0.0, 0.0], "point of `body`, in its axes from its origin")
    other_point_m: Vector3 = default([0.0, 0.0, 0.0], "point of `other`, in its axes from its origin")
    stiffness_N_per_m: NonNegative = default(0.0, "stiffness k")
    damping_N_s_per_m: NonNegative = default(0.0, "damping c")
    bound_N: Positive | None = default(None, "force limit, beyond which x_0 moves; default: no limit")
    rest_m: float | None = default(None, "rest length x_0; default: x at the start")

    def tie(self, name: str) -> Tie:
        """Return the tie."""
        start = math.nan if self.rest_m is None else self.rest_m
        return replace(
            super().tie(name), point=np.array(self.point_m), other_point=np.array(self.other_point_m), rest=start
        )


class Torsion(TieConfig):
    """Torsional tie about the axis: the law of a linear tie applies to the rotation of `body` relative to `other`."""

    LAW = "stiffness_N_m_per_rad", "damping_N_m_s_per_rad", "bound_N_m"

    type: Literal["torsion"]
    stiffness_N_m_per_rad: NonNegative = default(0.0, "stiffness k")
    damping_N_m_s_per_rad: NonNegative = default(0.0, "damping c")
    bound_N_m: Positive | None = default(None, "torque limit, beyond which x_0 moves; default: no limit")

    def tie(self, name: str) -> Tie:
        """Return the tie."""
        return replace(super().tie(name), turns=True)


TieChoice = Annotated[Linear | Torsion, Field(discriminator="type")]


# Section `loads`: forces and torques on bodies, and payloads fixed to bodies.

FORCE_COLUMNS = ("t_s", "fx_N", "fy_N", "fz_N")
TORQUE_COLUMNS = ("mx_N_m", "my_N_m", "mz_N_m")

# Times, shape (K + 1,) [s], and coefficients of the cubic polynomials between them for the six components, (K, 6, 4).
Pieces = tuple[Array, Array]


class WrenchConfig(BodyPoint):
    """Point of application of a wrench, and the axes of its components."""

    frame: Literal["world", "body"] = default("world", "axes of the force and torque components")


class Constant(WrenchConfig):
    """Constant force and torque."""

    type: Literal["constant"]
    force_N: Vector3 = default([0.0, 0.0, 0.0], "force at the point")
    torque_N_m: Vector3 = default([0.0, 0.0, 0.0], "torque about the point")

    @property
    def hold(self) -> bool:
        """True: the wrench lasts until the end of the run."""
        return True

    def pieces(self, duration: float) -> Pieces:
        """Return one constant piece from 0 to ``duration`` [s]."""
        coefficients = np.zeros((1, 6, 4))
        coefficients[0, :, 0] = [*self.force_N, *self.torque_N_m]
        return np.array([0.0, duration]), coefficients


class Sampled(WrenchConfig):
    """Force and torque interpolated between samples."""

    interpolation: Literal["spline", "linear"] = default(
        "spline", "`spline`: cubic, not-a-knot (a line for two samples, a parabola for three); or `linear`"
    )
    hold: bool = default(False, "hold the first and last sample outside the sampled times; default: zero there")
    # The pieces are computed at load time, so that a later edit of the file does not change a loaded scenario.
    _pieces: Pieces = PrivateAttr()

    def pieces(self, duration: float) -> Pieces:
        """Return the sample times and the polynomials between them."""
        return self._pieces

    def _interpolate(self, times: list[float], values: Array) -> Pieces:
        """Interpolate ``values``, shape (T, 6); raise ValueError if rounding makes the curve inaccurate or infinite."""
        knots = np.array(times)
        try:
            with np.errstate(all="ignore"):
                coefficients = self._coefficients(knots, values)
                step = np.diff(knots)[:, None] ** np.arange(4)
                met = np.allclose(np.einsum("kcp,kp->kc", coefficients, step), values[1:], rtol=1e-9, atol=1e-12)
        except ValueError:  # slopes that overflow
            met = False
        if not (met and np.isfinite(coefficients).all()):
            raise ValueError("cannot be interpolated: numbers are too large, or samples are too close in time")
        return knots, coefficients

    def _coefficients(self, knots: Array, values: Array) -> Array:
        if self.interpolation == "spline":
            from scipy.interpolate import CubicSpline  # the import takes 0.3 s

            return np.ascontiguousarray(CubicSpline(knots, values).c[::-1].transpose(1, 2, 0))
        coefficients = np.zeros((len(knots) - 1, 6, 4))
        coefficients[:, :, 0] = values[:-1]
        coefficients[:, :, 1] = np.diff(values, axis=0) / np.diff(knots)[:, None]
        return coefficients


class Samples(Sampled):
    """Force and torque sampled at `times_s`."""

    type: Literal["samples"]
    times_s: list[float] = Field(min_length=2, description="sample times, increasing")
    force_N: list[Vector3] | None = default(None, "force at each time; default: no force")
    torque_N_m: list[Vector3] | None = default(None, "torque about the point at each time; default: no torque")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.any(np.diff(self.times_s) <= 0.0):
            raise error_at("times_s", "must increase")
        values = {"force_N": self.force_N, "torque_N_m": self.torque_N_m}
        for key, vectors in values.items():
            if vectors is not None and len(vectors) != len(self.times_s):
                raise error_at(key, f"has {len(vectors)} vectors for {len(self.times_s)} times_s; make them equal")
        if self.force_N is None and self.torque_N_m is None:
            raise ValueError("requires force_N or torque_N_m; add one of them")
        nothing = np.zeros((len(self.times_s), 3))
        columns = [nothing if vectors is None else np.array(vectors) for vectors in values.values()]
        self._pieces = self._interpolate(self.times_s, np.hstack(columns))
        return self


class Table(Sampled):
    """Force and torque read from a CSV file."""

    type: Literal["csv"]
    file: str = Field(
        description="path of a CSV file, relative to the scenario file, with the header "
        f"{','.join(FORCE_COLUMNS)}, optionally followed by {','.join(TORQUE_COLUMNS)}"
    )

    @model_validator(mode="after")
    def _read(self) -> Self:
        rows = np.array(read_rows(self.file, FORCE_COLUMNS, FORCE_COLUMNS + TORQUE_COLUMNS, kind="a load"))
        values = np.zeros((len(rows), 6))
        values[:, : rows.shape[1] - 1] = rows[:, 1:]
        try:
            self._pieces = self._interpolate(rows[:, 0].tolist(), values)
        except ValueError as error:
            raise ValueError(f"{self.file}: {error}") from None
        return self


class Payload(BodyPoint):
    """Mass fixed to a body of the robot, with its centre of mass at `point_m`; a payload of 0 kg has no effect."""

    type: Literal["payload"]
    mass_kg: NonNegative = Field(description="mass")
    radius_m: NonNegative = default(0.0, "radius of a solid sphere; 0: a point mass")
    inertia_kg_m2: Annotated[list[NonNegative], Field(min_length=3, max_length=3)] | None = default(
        None,
        "moments of inertia xx, yy, zz about the centre of mass, in the axes of `body`; "
        "default: solid sphere of `radius_m`",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.inertia_kg_m2 is not None and self.radius_m > 0.0:
            raise error_at("inertia_kg_m2", "conflicts with radius_m; remove one of the two")
        if self.inertia_kg_m2 is not None and self.mass_kg == 0.0:
            raise error_at("inertia_kg_m2", "requires a positive mass_kg; remove it, or use radius_m instead")
        return self


LoadConfig = Annotated[Constant | Samples | Table | Payload, Field(discriminator="type")]


# Section `objects`: bodies in addition to the robot, each a separate tree rooted in the world.


# Objects have the colour of wood, so that they differ from the robot.
COLOUR = (0.91, 0.81, 0.65, 1.0)


class Guide(StrictConfig):
    """Joint with one degree of freedom between an object and the world; `KIND` is its type."""

    KIND: ClassVar[str]

    axis: Direction = default([0.0, 0.0, 1.0], "axis of the joint, in the object's axes")

    def _joint(self, link: Link, damping: float, friction: float, limits: list[float] | None) -> Link:
        """Return the link on this joint, with limits [rad or m]."""
        lower, upper = limits or (-math.inf, math.inf)
        axis = unit_vector(self.axis, "axis")
        return replace(link, kind=self.KIND, axis=axis, damping=damping, friction=friction, lower=lower, upper=upper)

    def _spring(self, name: str, link: Link, stiffness: float, **ends: Any) -> Tie | None:
        """Return the spring of an object between its link and the world; None without stiffness."""
        tie = Tie(f"{name}.spring", link.name, WORLD, link.axis, stiffness, 0.0, **ends)
        return tie if stiffness > 0.0 else None


class Hinge(Guide):
    """Hinge of an object, such as a door."""

    KIND = "revolute"

    point_m: Vector3 = default(
        [0.0, 0.0, 0.0], "point on the axis, from the object's centre; it becomes the origin of the body"
    )
    friction_N_m: NonNegative = default(0.0, "dry friction torque; unilateral law")
    damping_N_m_s_per_rad: NonNegative = default(0.0, "viscous damping")
    limits_deg: Limits | None = default(None, "lower and upper limit; default: no limits")
    spring_N_m_per_rad: NonNegative = default(0.0, "stiffness of a return spring; time_stepping only")
    rest_deg: float = default(0.0, "angle at which the spring torque is zero", gt=-180.0, lt=180.0)

    def joint(self, link: Link) -> Link:
        """Return the link on this joint."""
        limits = None if self.limits_deg is None else np.deg2rad(self.limits_deg).tolist()
        return self._joint(link, self.damping_N_m_s_per_rad, self.friction_N_m, limits)

    def spring(self, name: str, link: Link) -> Tie | None:
        """Return the return spring between the link and the world; None without stiffness."""
        angle = math.radians(self.rest_deg)
        return self._spring(name, link, self.spring_N_m_per_rad, turns=True, rest=angle, attitude=link.R_PJ.T)


class Slide(Guide):
    """Straight rails of an object, such as a drawer."""

    KIND = "prismatic"

    axis: Direction = default([1.0, 0.0, 0.0], "direction of the rails, in the object's axes")
    friction_N: NonNegative = default(0.0, "dry friction force; unilateral law")
    damping_N_s_per_m: NonNegative = default(0.0, "viscous damping")
    limits_m: Limits | None = default(None, "lower and upper limit; default: no limits")
    spring_N_per_m: NonNegative = default(0.0, "stiffness of a return spring; time_stepping only")
    rest_m: float = default(0.0, "displacement at which the spring force is zero")

    @property
    def point_m(self) -> list[float]:
        """Position of the joint: the object's centre."""
        return [0.0, 0.0, 0.0]

    def joint(self, link: Link) -> Link:
        """Return the link on this joint."""
        return self._joint(link, self.damping_N_s_per_m, self.friction_N, self.limits_m)

    def spring(self, name: str, link: Link) -> Tie | None:
        """Return the spring between the link and the world; None without stiffness."""
        return self._spring(name, link, self.spring_N_per_m, other_point=link.p_PJ, rest=self.rest_m)


# Keys of mass and size that each shape requires; the other keys do not apply to it.
SIZES = {
    "box": ("mass_kg", "size_m"),
    "sphere": ("mass_kg", "radius_m"),
    "cylinder": ("mass_kg", "radius_m", "length_m"),
    "parts": ("parts",),
}


class Sized(StrictConfig):
    """Mass, shape and size of an object or a part."""

    mass_kg: Positive | None = default(None, "mass; with `shape: parts` the sum of the masses of the parts")
    shape: Literal["box", "sphere", "cylinder", "parts"] = default("box", "shape")
    size_m: Lengths | None = default(None, "edge lengths of a box along its axes")
    radius_m: Positive | None = default(None, "radius of a sphere or cylinder")
    length_m: Positive | None = default(None, "length of a cylinder along its z axis")

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        subject, remedy = f"a {self.shape}", "remove it"
        if self.shape == "parts":
            subject, remedy = "shape: parts", "set it for each part and remove it here"
        for key in ("parts", "mass_kg", "size_m", "radius_m", "length_m"):
            needed, missing = key in SIZES[self.shape], getattr(self, key, None) is None
            if needed and missing:
                raise error_at(key, f"is required for {subject}")
            if not needed and not missing:
                remedy = "remove it, or set shape: parts" if key == "parts" else remedy
                raise error_at(key, f"does not apply to {subject}; {remedy}")
        return self


class Solid(Sized):
    """Homogeneous solid: a box, a sphere, or a cylinder along its z axis."""

    mass_kg: Positive = Field(description="mass")
    shape: Literal["box", "sphere", "cylinder"] = default("box", "shape")

    @property
    def inertia(self) -> Inertia:
        """Inertia about the centre: I_x = m (b² + c²)/12 (box), I = 2 m r²/5 (sphere), I_z = m r²/2 (cylinder)."""
        if self.shape == "box":
            squares = np.array(self.dimensions) ** 2
            return Inertia(self.mass_kg, np.zeros(3), np.diag(self.mass_kg * (squares.sum() - squares) / 12.0))
        radius, *length = self.dimensions
        if self.shape == "sphere":
            return Inertia.solid_sphere(self.mass_kg, radius, np.zeros(3))
        return replace(Inertia.solid_cylinder(self.mass_kg, radius, *length), com=np.zeros(3))

    @property
    def dimensions(self) -> tuple[float, ...]:
        """Edges of a box, radius of a sphere, radius and length of a cylinder [m]."""
        return tuple(self.size_m or [x for x in (self.radius_m, self.length_m) if x is not None])

    @property
    def solid(self) -> Shape:
        """Shape for display."""
        return Shape(self.shape, self.dimensions, colour=COLOUR)

    @property
    def spheres(self) -> tuple[Array, float]:
        """Centres, shape (k, 3), and radius of the spheres that can touch surfaces [m].

        A box touches with its corners, a cylinder with a sphere inside each end. Contact is exact for a pipe that lies
        on its side; an upright pipe stands on a sphere.
        """
        if self.shape == "box":
            signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
            return signs * self.dimensions, 0.0
        radius, *length = self.dimensions
        end = max(0.5 * sum(length) - radius, 0.0)
        if self.shape == "sphere":
            return np.zeros((1, 3)), radius
        return np.array([[0.0, 0.0, -end], [0.0, 0.0, end]]), radius


class Part(Solid):
    """Solid that is part of an object."""

    position_m: Vector3 = default([0.0, 0.0, 0.0], "position of the part's centre, in the object's axes")
    rpy_deg: Vector3 = default([0.0, 0.0, 0.0], "attitude in the object's axes, Rz(yaw) Ry(pitch) Rx(roll)")


class Grasp(StrictConfig):
    """Pose that a gripper must have to hold an object."""

    position_m: Vector3 = default(
        [0.0, 0.0, 0.0], "position of the gripper's tip, in the object's axes from its centre"
    )
    axis: Direction = default([1.0, 0.0, 0.0], "pointing direction of the gripper, in the object's axes")


class ObjectWheel(StrictConfig):
    """Wheel of an object: it touches surfaces as a sphere and has the inertia of a disc."""

    position_m: Vector3 = Field(description="position of the wheel's centre, in the object's axes from its centre")
    axis: Direction = default([0.0, 1.0, 0.0], "axle, in the object's axes")
    radius_m: Positive = Field(description="radius")
    mass_kg: Positive = Field(description="mass")
    friction_N_m: NonNegative = default(0.0, "dry friction torque of the bearing; unilateral law")
    damping_N_m_s_per_rad: NonNegative = default(0.0, "viscous damping")
    motor: union("motor") | None = default(None, "motor; default: no motor")  # type: ignore[valid-type]

    def link(self, name: str, carrier: str) -> Link:
        """Return the wheel's link on the body `carrier`; I = m r²/2 about the axle, m r²/4 across it."""
        axis, across = unit_vector(self.axis, "axis"), 0.25 * self.mass_kg * self.radius_m**2
        inertia = Inertia(self.mass_kg, np.zeros(3), across * (np.eye(3) + np.outer(axis, axis)))
        width = (self.radius_m, WHEEL_WIDTH * self.radius_m)
        return Link(
            name,
            name,
            carrier,
            "revolute",
            axis,
            inertia,
            p_PJ=np.array(self.position_m),
            damping=self.damping_N_m_s_per_rad,
            friction=self.friction_N_m,
            shapes=(Shape("cylinder", width, orientation=turn_from_z(axis)),),
            solids=(Shape("sphere", (self.radius_m,)),),
        )


class SceneObject(Sized):
    """Object: a solid box, sphere or cylinder, or a rigid body of several parts."""

    parts: Annotated[dict[str, Part], Field(min_length=1)] | None = default(
        None, "named solids, fixed to each other, for `shape: parts`"
    )
    position_m: Vector3 = Field(
        description="initial world position of the centre, or of the origin of the parts for `shape: parts`"
    )
    rpy_deg: Vector3 = default([0.0, 0.0, 0.0], "initial attitude, Rz(yaw) Ry(pitch) Rx(roll)")
    hinge: Hinge | None = default(None, "hinge to the world; default: the object is free")
    slide: Slide | None = default(None, "rails in the world; default: the object is free")
    wheels: dict[str, ObjectWheel] = default({}, "named wheels of a free object")
    grasp: Grasp | None = default(None, "grasp pose for a gripper; default: it cannot be gripped")

    @model_validator(mode="after")
    def _check_joint(self) -> Self:
        if self.hinge is not None and self.slide is not None:
            raise error_at("slide", "conflicts with hinge; remove one of the two")
        if self.joint is not None and self.wheels:
            on = "hinge" if self.hinge is not None else "slide"
            raise error_at("wheels", f"requires a free object, but this object has a {on}; remove one of the two")
        return self

    @property
    def joint(self) -> Hinge | Slide | None:
        """Joint between the object and the world; None if the object is free."""
        return self.hinge if self.hinge is not None else self.slide

    @property
    def solids(self) -> dict[str, Part]:
        """Parts of the object; a single solid counts as one part."""
        if self.parts is not None:
            return self.parts
        keys = ("mass_kg", "shape", "size_m", "radius_m", "length_m")
        return {"": Part.model_construct(**{key: getattr(self, key) for key in keys})}

    @property
    def inertia(self) -> Inertia:
        """Inertia of all parts about the origin of the object."""
        parts = [(part, _turn(part.rpy_deg), np.array(part.position_m)) for part in self.solids.values()]
        return Inertia.merged([part.inertia.placed(R, p) for part, R, p in parts])

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Shapes for display, relative to the object's centre, in its axes."""
        parts = self.solids.values()
        return tuple(part.solid.placed(part.position_m, quaternion(_turn(part.rpy_deg))) for part in parts)

    @property
    def _origin(self) -> Array:
        """Origin of the body from the object's centre, in its axes [m]; if there is a hinge, on its axis."""
        return np.zeros(3) if self.joint is None else np.array(self.joint.point_m)

    def links(self, name: str) -> tuple[Link, ...]:
        """Return the tree of links; its joint and body are named after the object."""
        back = -self._origin
        shapes = tuple(shape.placed(back, HERE) for shape in self.shapes)
        inertia = self.inertia.placed(np.eye(3), back)
        link = Link(name, name, None, "revolute", np.array([0.0, 0.0, 1.0]), inertia, shapes=shapes, solids=shapes)
        if self.joint is None:
            return (*floating(link), *(wheel.link(f"{name}.{own}", name) for own, wheel in self.wheels.items()))
        R = _turn(self.rpy_deg)
        return (replace(self.joint.joint(link), R_PJ=R, p_PJ=np.array(self.position_m) + R @ self._origin),)

    def ties(self, name: str) -> list[Tie]:
        """Return the spring of the hinge or rails, if any."""
        spring = None if self.joint is None else self.joint.spring(name, self.links(name)[0])
        return [] if spring is None else [spring]

    def frames(self, name: str) -> list[Frame]:
        """Return the grasp frame, if any; its x axis is the pointing direction of the gripper."""
        if self.grasp is None:
            return []
        R = frame_along(unit_vector(self.grasp.axis, "axis"))
        return [Frame(grasp_frame(name), name, R, np.array(self.grasp.position_m) - self._origin)]

    def start(self) -> list[float]:
        """Return the initial coordinates [m, quaternion or rad]."""
        if self.joint is not None:
            return [0.0]
        return [*self.position_m, *quaternion(_turn(self.rpy_deg)), *(0.0 for _ in self.wheels)]

    def motors(self, name: str, context: BuildContext) -> list[Drive]:
        """Return the motors of the wheels."""
        joints = {f"{name}.{own}": wheel.motor for own, wheel in self.wheels.items() if wheel.motor is not None}
        return [build("motor", motor, context.at_joint(joint), Drive) for joint, motor in joints.items()]

    def feet(self, name: str, surfaces: list[str]) -> list[Foot]:
        """Return the points and spheres that can touch each of these surfaces."""
        if self.joint is not None:
            return []
        touching: list[tuple[str, Array, float]] = []
        for own, part in self.solids.items():
            points, radius = part.spheres
            R, p = _turn(part.rpy_deg), np.array(part.position_m)
            stem, several = f"{name}.{own}" if own else name, len(points) > 1
            touching += [(f"{stem}{k + 1 if several else ''}", p + R @ x, radius) for k, x in enumerate(points)]
        feet = [
            Foot(f"{point_name}.{surface}", name, point, radius, surface)
            for surface in surfaces
            for point_name, point, radius in touching
        ]
        return feet + [
            Foot(f"{name}.{own}.{surface}", f"{name}.{own}", np.zeros(3), wheel.radius_m, surface)
            for own, wheel in self.wheels.items()
            for surface in surfaces
        ]


def _turn(rpy_deg: list[float]) -> Array:
    # Imported here because the URDF reader takes a long time to load.
    if not any(rpy_deg):
        return np.eye(3)
    from dynsim.model.urdf.reader import rotation

    return rotation(*np.deg2rad(rpy_deg))


def frame_along(axis: Array) -> Array:
    """Return a rotation, shape (3, 3), with the unit vector ``axis`` as x axis and, if possible, a level y axis."""
    side = np.cross([0.0, 0.0, 1.0], axis)
    if np.linalg.norm(side) < 1e-9:
        side = np.array([0.0, 1.0, 0.0])
    side = side / np.linalg.norm(side)
    return np.column_stack([axis, side, np.cross(axis, side)])


def _write_nulls(written: dict[str, Any], defaults: Mapping[str, Any]) -> None:
    """Write ``null`` for each key without value that has a default of the plant, which would replace the None."""
    for key, value in defaults.items():
        if key not in written:
            written[key] = None
        elif isinstance(value, Mapping):
            _write_nulls(written[key], value)


# Maximum length of a folder name on common file systems [bytes].
NAME_LIMIT = 255

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Grip(StrictConfig):
    """Friction that differs along and across an axis of the body, like the friction of a wheel."""

    axis: Direction = Field(
        description="direction of reduced friction, in the axes of the body or frame; it is projected onto the surface"
    )
    ratio: Share = Field(
        description="friction along the axis as a fraction of the friction across the axis; 0: free rolling"
    )


class ContactLaw(StrictConfig):
    """Friction, restitution and compliance of a contact, which default to those of all contacts."""

    friction: NonNegative | None = default(None, "kinetic coefficient μ; default: `contacts.friction`")
    static_friction: NonNegative | None = default(
        None, "static coefficient μ_s; default: `contacts.static_friction`; unilateral law"
    )
    restitution: Share | None = default(
        None, "coefficient of restitution; default: `contacts.restitution`; unilateral law"
    )
    stiffness_N_per_m: Positive | None = default(
        None, "stiffness along the normal; default: `contacts.stiffness_N_per_m`; time_stepping only"
    )
    damping_N_s_per_m: NonNegative | None = default(
        None, "damping along the normal; default: `contacts.damping_N_s_per_m`; time_stepping only"
    )


class ContactPoint(ContactLaw, BodyPoint):
    """Contact of a surface with a point fixed to a body, or with a sphere around this point."""

    surface: str = default("floor", "name of a surface")
    radius_m: NonNegative = default(0.0, "radius of a sphere around the point; 0: the point touches")
    grip: Grip | None = default(None, "anisotropic friction; default: isotropic; time_stepping only")
    enabled: bool = default(True, "whether the point can touch")


class BodyPair(ContactLaw):
    """Bodies that touch each other."""

    bodies: Literal["self"] | list[str] = Field(
        description="`self`: all links of the robot; or two entries, each a body or the group `links` or `objects`"
    )
    ignore: list[list[str]] = default([], "pairs of bodies that do not touch")

    @model_validator(mode="after")
    def _check_pairs(self) -> Self:
        if self.bodies != "self" and len(self.bodies) != 2:
            raise error_at("bodies", "must be `self`, or two bodies or groups")
        if any(len(pair) != 2 for pair in self.ignore):
            raise error_at("ignore", "must list pairs of two bodies")
        return self


class Contacts(StrictConfig):
    """Contact law, friction and contact points."""

    law: Literal["bilateral", "unilateral"] = default(
        "bilateral",
        "`bilateral`: points stay on their surfaces, with normal forces of any sign; "
        "`unilateral`: surfaces only push, and points stick, slip and lift off",
    )
    friction: NonNegative = default(0.1, "kinetic coefficient μ")
    static_friction: NonNegative | None = default(
        None, "static coefficient μ_s, at least `friction`; default: `friction`; unilateral law"
    )
    stribeck_m_s: Positive | None = default(
        None,
        "Stribeck speed v_s of μ + (μ_s − μ) exp(−(v/v_s)²); default: μ as soon as the point slips; unilateral law",
    )
    viscous_friction_s_per_m: NonNegative = default(0.0, "increase of the coefficient per m/s of slip; unilateral law")
    restitution: Share = default(0.0, "coefficient of restitution for the normal speed; unilateral law")
    stiffness_N_per_m: Positive | None = default(
        None, "contact stiffness along the normal; default: rigid; time_stepping only"
    )
    damping_N_s_per_m: NonNegative = default(0.0, "damping of compliant contacts along the normal; time_stepping only")
    slip_smoothing_m_s: Positive = default(1e-3, "v_s of the smoothed slip direction v_t/√(v_t² + v_s²); bilateral law")
    pulling_friction: Literal["signed", "dissipative"] = default(
        "dissipative",
        "friction of a pulling contact: `signed` f_t = μ f_n as printed in the paper, "
        "`dissipative` f_t = μ |f_n|; bilateral law",
    )
    reference_tolerance_m: Positive = default(
        2e-3,
        "maximum distance of a contact point from its surface along the references; "
        "an error if exceeded; bilateral law",
    )
    candidates: Literal["points", "joints", "links"] = default(
        "points",
        "contacts in addition to `points`: none (`points`), all joints and the hand (`joints`), "
        "or the links as capsules (`links`)",
    )
    points: dict[str, ContactPoint] = default({}, "named contact points")
    between: list[BodyPair] = default([], "bodies that touch each other; default: none; unilateral law")

    def of(self, point: ContactLaw | None, key: str) -> Any:
        """Return a key of a point, or the key of `contacts` if the point does not set it."""
        value = getattr(point, key, None)
        return getattr(self, key) if value is None else value

    def coefficients(self, point: ContactLaw | None = None) -> tuple[float, float]:
        """Return the kinetic and static friction coefficients of a point, or the values for all contacts.

        Keys of the point take precedence over keys of `contacts`. The static coefficient defaults to the kinetic
        coefficient.
        """
        kinetic, static = self.of(point, "friction"), self.of(point, "static_friction")
        return kinetic, kinetic if static is None else static

    def compliance(self, point: ContactLaw | None = None) -> tuple[float, float]:
        """Return stiffness [N/m] (0: rigid) and damping [N s/m] of a point, or the values for all contacts."""
        return self.of(point, "stiffness_N_per_m") or 0.0, self.of(point, "damping_N_s_per_m")

    @model_validator(mode="after")
    def _check_coefficients(self) -> Self:
        self._check_compliance()
        kinetic, static = self.coefficients()
        if static < kinetic:
            raise error_at(
                "static_friction", f"must not be less than friction ({self.friction:g}); raise it or lower friction"
            )
        for name, point in self.points.items():
            kinetic, static = self.coefficients(point)
            if static < kinetic:
                key = "friction" if point.static_friction is None else "static_friction"
                raise error_at(
                    f"points.{name}.{key}",
                    f"static_friction ({static:g}) must not be less than friction ({kinetic:g}); change one of them",
                )
        return self

    def _check_compliance(self) -> None:
        """Raise an error if a rigid contact has damping or a compliant contact has restitution."""
        for where, point in {"": None, **{f"points.{name}.": point for name, point in self.points.items()}}.items():
            config = self if point is None else point
            soft = self.compliance(point)[0] > 0.0
            anywhere = soft or (point is None and not all(p.stiffness_N_per_m is None for p in self.points.values()))
            if config.damping_N_s_per_m and not anywhere:
                raise error_at(f"{where}damping_N_s_per_m", "requires stiffness_N_per_m; add it or remove this key")
            restitution = self.of(point, "restitution")
            if soft and restitution > 0.0:
                key = "restitution" if config.restitution else "stiffness_N_per_m"
                raise error_at(
                    f"{where}{key}",
                    f"compliant contacts cannot have restitution (here {restitution:g}); use damping_N_s_per_m instead",
                )


class Initial(StrictConfig):
    """Start of a run: a minimal change of the plant's initial posture, and the initial motor currents."""

    on_surface: list[str] = default([], "contact points, enabled or disabled, that start exactly on their surfaces")
    keep: list[str] = default([], "joints that `on_surface` must not move; `hand` keeps the position of the hand")
    on_references: bool = default(False, "start joints with waypoints at their first waypoint")
    equilibrium: bool = default(False, "start with the motor currents of least heat that hold the robot at rest")

    @model_validator(mode="after")
    def _check_effect(self) -> Self:
        if not self.on_surface and not self.equilibrium and not self.on_references:
            raise error_at(
                "on_surface",
                "must list at least one contact point; add one, set equilibrium or on_references: true, "
                "or remove initial",
            )
        if self.keep and not self.on_surface:
            raise error_at("keep", "has no effect without on_surface; remove it")
        return self


class SurfaceError(StrictConfig):
    """Difference between the simulated surfaces and the surfaces that the controller assumes."""

    shift_m: Vector3 = default([0.0, 0.0, 0.0], "displacement of all surfaces in the world")
    friction_factor: NonNegative = default(1.0, "factor on all coefficients of friction")


class MassError(StrictConfig):
    """Difference between the simulated masses and the masses that the controller assumes."""

    robot_factor: NonNegative = default(1.0, "factor on masses and moments of inertia of all links and motors")
    payload_factor: NonNegative = default(1.0, "factor on masses and moments of inertia of all payloads")


class Requirements(StrictConfig):
    """Requirements that a plan of braces must meet; simulations do not use them."""

    hand_sag_m: Positive | None = default(
        None, "maximum displacement of the hand under hand_force_N, with the gains of the plan"
    )
    hand_force_N: Vector3 | None = default(None, "additional force on the hand, in the world, for hand_sag_m")
    gear_stiffness_N_m_per_rad: Positive | None = default(
        None,
        "stiffness of every gear, in series with the gains, for hand_sag_m; N/m at a prismatic joint; default: rigid",
    )
    rating_share: Positive | None = default(
        None, "maximum rms torque of every motor, as a fraction of its continuous rating"
    )
    hand_error_m: Positive | None = default(
        None, "maximum rms error of the hand in simulated runs, in addition to the error of the surfaces"
    )
    heat_ratio: float | None = default(
        None,
        "maximum heat of the simulated runs, as a multiple of the heat of the run without errors; default: 1.5",
        gt=1.0,
    )
    payload_error: float | None = default(
        None, "relative error of the masses of all payloads that a plan must tolerate", gt=0.0, lt=1.0
    )
    mass_error: float | None = default(
        None, "relative error of the masses of all links and motors that a plan must tolerate", gt=0.0, lt=1.0
    )

    @model_validator(mode="after")
    def _check_force(self) -> Self:
        if self.hand_sag_m is not None and not any(self.hand_force_N or ()):
            raise error_at("hand_sag_m", "requires hand_force_N, such as [0, 0, -30]; add a force")
        if self.hand_sag_m is None:
            for key in ("hand_force_N", "gear_stiffness_N_m_per_rad"):
                if getattr(self, key) is not None:
                    raise error_at(key, "requires hand_sag_m, such as 0.001; add it, or remove this key")
        return self


class Integrator(StrictConfig):
    """Time integration."""

    method: Literal[METHODS] = default(  # type: ignore[valid-type]
        "auto",
        "integration method; `auto`: `dopri5` or `radau5`, depending on the system; `dopri5`: adaptive, "
        "explicit 5(4); `radau5`: adaptive, implicit (for stiff motors); `time_stepping`: fixed step, with contacts "
        "that open and close",
    )
    solver: Literal["articulated", "m_star"] = default(
        "articulated", "equations of motion by O(n) sweeps (`articulated`) or the dense matrix M* (`m_star`)"
    )
    rtol: float = default(1e-6, "relative tolerance of adaptive methods", ge=1e-13, le=1e-1)
    atol: float | None = default(None, "absolute tolerance; default: rtol/100, at most 1e-8", ge=1e-16, le=1e-1)
    step_s: Positive | None = default(
        None, "fixed step of time_stepping, default: 0.001; first step of adaptive methods, default: automatic"
    )
    theta: float = default(
        THETA,
        "implicitness of time_stepping: 0.5 is second order between events, 1 adds numerical damping",
        ge=0.5,
        le=1.0,
    )
    step_max_s: Positive | None = default(None, "maximum step of adaptive methods; default: no limit")
    wall_limit_s: Positive | None = default(
        None,
        "maximum wall-clock time of the integration; default: no limit; "
        "an error if the estimate exceeds ten times the limit",
    )

    @field_validator("method", mode="before")
    @classmethod
    def _replaced(cls, value: object) -> object:
        if value in ("rk4", "rk43"):
            raise ValueError("unknown method (removed); use dopri5, or time_stepping for fixed steps")
        return value

    @property
    def absolute_tolerance(self) -> float:
        """``atol`` or its default, which depends on ``rtol``, because a fixed default would limit the accuracy."""
        return min(1e-8, 1e-2 * self.rtol) if self.atol is None else self.atol


class RecordOptions(StrictConfig):
    """Sampling rate and size limit of the record."""

    rate_hz: Positive = default(200.0, "sampling rate of the record")
    size_limit_GB: Positive = default(2.0, "maximum size of the record; a larger record is an error")


class Metrics(StrictConfig):
    """Options of the summary."""

    settle_s: NonNegative = default(2.0, "time from which tracking errors are evaluated")


def merge_defaults(defaults: Any, values: Any) -> Any:
    """Return ``values`` with missing keys filled in from ``defaults``, recursively for mappings."""
    if not (isinstance(defaults, Mapping) and isinstance(values, Mapping)):
        return values
    return {**defaults, **{key: merge_defaults(defaults.get(key), value) for key, value in values.items()}}


class ScenarioConfig(StrictConfig):
    """Scenario file of dynsim."""

    name: str = default("", "name of the scenario; default: the file name without extension")
    variant: str = default("", "name of the variant; written into resolved scenarios")
    description: str = default("", "text about the scenario")
    duration_s: Positive = Field(description="simulated time")
    plant: union("plant") = Field(description="robot")  # type: ignore[valid-type]
    controller: union("controller") | None = default(  # type: ignore[valid-type]
        None, "controller; default: none, with the motors short-circuited"
    )
    surfaces: dict[str, union("surface")] = default({}, "named surfaces")  # type: ignore[valid-type]
    contacts: Contacts = default(Contacts(), "contact law, friction and contact points")
    surface_error: SurfaceError | None = default(
        None, "difference between the surfaces and the controller's assumptions; default: none"
    )
    mass_error: MassError | None = default(
        None, "difference between the masses and the controller's assumptions; default: none"
    )
    requirements: Requirements | None = default(None, "requirements for plans of braces; default: none")
    initial: Initial | None = default(
        None, "changes to the initial posture and motor currents; default: as in the plant"
    )
    loads: dict[str, LoadConfig] = default({}, "named forces, torques and payloads")
    objects: dict[str, SceneObject] = default({}, "named bodies in addition to the robot")
    ties: dict[str, TieChoice] = default({}, "named springs and dampers between two bodies")
    sensors: Sensors | None = default(
        None, "sensors of a sampled controller (default: the exact state without delay), and recorded sensors"
    )
    integrator: Integrator = default(Integrator(), "time integration")
    record: RecordOptions = default(RecordOptions(), "sampling rate and size limit of the record")
    metrics: Metrics = default(Metrics(), "options of the summary")

    @model_validator(mode="before")
    @classmethod
    def _of_plant(cls, data: Any) -> Any:
        """Apply the plant's defaults for other sections."""
        if not isinstance(data, Mapping):
            return data
        return merge_defaults(section_defaults(data.get("plant"), data), data)

    @model_validator(mode="after")
    def _check_combinations(self) -> Self:
        check_keys(self)
        payloads = any(isinstance(load, Payload) for load in self.loads.values())
        if self.requirements is not None and self.requirements.payload_error is not None and not payloads:
            raise error_at("requirements.payload_error", "requires a load of type payload; add it, or remove this key")
        return self

    @field_validator("name", "variant")
    @classmethod
    def _check_folder(cls, value: str) -> str:
        """Check that the value is a valid folder name, which cannot lead out of the results folder."""
        if value in (".", "..") or any(sign in value for sign in "/\\\0"):
            raise ValueError("becomes a folder name, so it must not contain slashes or consist only of dots")
        if not value.isprintable():
            raise ValueError("becomes a folder name, so it must be printable and on one line")
        if len(value.encode()) > NAME_LIMIT:
            raise ValueError(f"becomes a folder name, so it must not be longer than {NAME_LIMIT} bytes")
        return value


@dataclass(frozen=True)
class Scenario:
    """Validated scenario: plant, controller, contacts, integrator and recording.

    Scenarios are immutable; :func:`load_scenario` reads them from files.

    Attributes
    ----------
    name : str
        Name of the scenario; default: the name of its file.
    variant : str
        Name of the variant; empty for a scenario without variants.
    config : ScenarioConfig
        All keys of the scenario, with defaults; numbers have the units in their keys.
    source : Path or None
        Scenario file; None if the scenario was not read from a file.
    origin : Origin or None
        Lines of the keys in that file.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows")
    >>> scenario.title
    'elbow_comparison (two_elbows)'
    >>> scenario.duration_s, scenario.plant.type, scenario.config.contacts.law
    (10.0, 'serial_arm', 'bilateral')
    """

    name: str
    variant: str
    config: ScenarioConfig
    source: Path | None = None
    origin: Origin | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        config = self.config
        parts = [config.plant.type, config.controller.type if config.controller else "no controller"]
        parts.append(f"{config.duration_s:g} s")
        contacts = [name for name, point in config.contacts.points.items() if point.enabled]
        if contacts:
            parts.append(f"contacts {listed(contacts)}")
        return f"<Scenario {self.title}: {', '.join(parts)}>"

    def _repr_html_(self) -> str:
        config = self.config
        contacts = [name for name, point in config.contacts.points.items() if point.enabled]
        rows = [
            ("plant", config.plant.type),
            ("controller", config.controller.type if config.controller else "–"),
            ("duration", f"{config.duration_s:g} s"),
            ("surfaces", ", ".join(config.surfaces) or "–"),
            ("contacts", f"{', '.join(contacts)} ({config.contacts.law})" if contacts else "–"),
            ("loads", ", ".join(config.loads) or "–"),
            ("integrator", config.integrator.method),
        ]
        about = [("", " ".join(config.description.split()))] if config.description else []
        return record.table(self.title, [*about, *rows])

    @property
    def title(self) -> str:
        """Name and variant as one line of text."""
        return f"{self.name} ({self.variant})" if self.variant else self.name

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return self.config.duration_s

    @property
    def plant(self) -> Any:
        """Configuration of the plant: the ``Config`` of its module in `dynsim.library.plants`."""
        return self.config.plant

    @property
    def controller(self) -> Any:
        """Configuration of the controller; None without a controller."""
        return self.config.controller

    @property
    def integrator(self) -> Integrator:
        """Integration method, solver and tolerances."""
        return self.config.integrator

    @property
    def record(self) -> RecordOptions:
        """Sampling rate [Hz] and size limit [GB] of the record."""
        return self.config.record

    @property
    def metrics(self) -> Metrics:
        """Options of the summary."""
        return self.config.metrics

    @property
    def engine(self) -> str:
        """Engine that simulates the plant: ``"dynamics"`` or ``"kinematic"``."""
        return engine(self.plant)

    @property
    def resolved(self) -> dict[str, Any]:
        """Scenario with defaults and overrides written out; loading it gives the same simulation.

        Defaults without effect are omitted.

        Returns
        -------
        dict
            Plain values by key, as in a scenario file.

        Examples
        --------
        >>> import dynsim
        >>> resolved = dynsim.load_scenario("elbow_comparison", overrides={"integrator.rtol": 1e-8}).resolved
        >>> resolved["integrator"]["rtol"]
        1e-08
        """
        resolved = self.config.model_dump(mode="json", exclude_none=True)
        _write_nulls(resolved, section_defaults(resolved["plant"], resolved))
        for section in ("loads", "objects", "ties"):
            if not getattr(self.config, section):
                del resolved[section]
        contacts = self.config.contacts
        for part in (resolved["contacts"], *resolved["contacts"]["points"].values()):
            for key in BILATERAL_KEYS if contacts.law == "unilateral" else UNILATERAL_KEYS:
                part.pop(key, None)
        # Omit keys without effect, unless the scenario sets them.
        for keys in idle_keys(self.config):
            section, *inner = map(str, keys)
            if len(inner) == 1 and not is_set(self.config, keys) and isinstance(resolved.get(section), dict):
                resolved[section].pop(inner[0], None)
                if not resolved[section]:
                    del resolved[section]
        return resolved

    def location(self, keys: Sequence[int | str] = (), variant: str = "") -> str:
        """Return the location at which a key was set, for messages.

        Parameters
        ----------
        keys : sequence of str or int, optional
            Path to the key, e.g. ``("contacts", "friction")``; default: the scenario as a whole.
        variant : str, optional
            Text to insert after the file and line.

        Returns
        -------
        str
            ``file:line``, or only ``file`` if the key is not in the file; for an overridden key, ``file: --set`` or
            ``file: overrides``.

        Examples
        --------
        >>> import dynsim
        >>> scenario = dynsim.load_scenario("elbow_comparison", overrides={"duration_s": 2.0})
        >>> scenario.location(("duration_s",)).endswith("elbow_comparison.yaml: overrides")
        True
        """
        line, overridden = 0, ""
        if keys and self.origin is not None:
            overridden = f": {how}" if (how := self.origin.overriding(keys)) else ""
            line = 0 if overridden else self.origin.line(keys)
        return f"{self.source or self.name}{f':{line}' if line else ''}{variant}{overridden}"
