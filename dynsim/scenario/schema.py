"""Schema of a scenario: its keys with types, units, limits and defaults, as frozen data; the validated scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PrivateAttr, StrictInt, field_validator, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import WHEEL_WIDTH, turn_from_z
from dynsim.config.base import BodyPoint, NonNegative, Positive, StrictConfig, Vector3, error_at, unit_vector
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

# The ``sensors:`` section of a scenario: rate, delay, resolution and noise of a sampled controller's inputs.


# Rate of a sensor [Hz]; limited because each sample is a call of Python.
Rate = Annotated[float, Field(gt=0.0, le=1e5)]
# Resolution of the MX series [deg]: 4096 positions in a turn (data sheet).
MX_RESOLUTION = math.degrees(2.0 * math.pi / 4096)


class Sensor(StrictConfig):
    """What all sensors have: the last sample that has arrived is held."""

    rate_hz: Rate | None = Field(None, description="of its samples; default: one at every tick of the controller")
    delay_s: NonNegative = Field(0.0, description="from a sample to its arrival")


class Encoders(Sensor):
    """Positions of joints; their rates are differences of samples."""

    resolution_deg: NonNegative = Field(
        MX_RESOLUTION, description="angles are rounded to it; default: 4096 positions in a turn, as MX servos have"
    )
    noise_deg: NonNegative = Field(0.0, description="standard deviation, before rounding")
    resolution_m: NonNegative = Field(0.0, description="the same of prismatic joints")
    noise_m: NonNegative = Field(0.0, description="the same of prismatic joints")


class MotionCapture(Sensor):
    """Position and attitude of the controlled point of a snake ([T] V.A)."""

    rate_hz: Rate | None = Field(100.0, description="of its samples (assumed)")
    delay_s: NonNegative = Field(0.01, description="from a sample to its arrival (assumed)")
    position_noise_m: NonNegative = Field(2e-4, description="standard deviation of each coordinate (assumed)")
    attitude_noise_rad: NonNegative = Field(5e-4, description="standard deviation of each angle (assumed)")


class Sensors(StrictConfig):
    """Sensors of the robot; one that is not there tells the truth at once."""

    seed: StrictInt = Field(0, ge=0, description="of all noise: the same seed, the same noise")
    encoders: Encoders | None = None
    motion_capture: MotionCapture | None = None


# The ``ties:`` section of a scenario: springs, dampers and bounds between two bodies, of the robot or of objects.


class TieConfig(StrictConfig):
    """What it ties, and in which direction; the keys of ``LAW`` name stiffness, damping and bound with their units."""

    LAW: ClassVar[tuple[str, str, str]]

    body: str = Field(description="name of a body, or of a frame fixed on one")
    other: str = Field(description="the same, of the other end, or `world`")
    axis: Vector3 = Field(description="in the axes of body")
    pushes: bool = Field(default=False, description="it only pushes body along the axis, away from other")
    holds: bool = Field(default=True, description="from the start on; `Simulation.set_tie` changes it")

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit_vector(self.axis, "axis")
        if self.body == self.other:
            raise error_at("other", f"is {self.body!r}, as body is; a tie has two ends")
        stiffness, damping, bound = self.LAW
        if not getattr(self, stiffness) + getattr(self, damping) > 0.0:
            raise error_at(stiffness, f"is needed, or {damping}")
        if self.pushes and getattr(self, bound) is not None:
            raise error_at(bound, "is none of a tie that only pushes; remove it")
        return self

    def tie(self, name: str) -> Tie:
        """The tie of that name."""
        stiffness, damping, bound = (getattr(self, key) for key in self.LAW)
        bound = math.inf if bound is None else bound
        ends = self.body, self.other, np.array(self.axis)
        return Tie(name, *ends, stiffness, damping, bound, pushes=self.pushes, rest=math.nan, holds=self.holds)


class Linear(TieConfig):
    """Along the axis: f = −k (x − x_0) − c dx/dt on body, x = axis · (point − other point)."""

    LAW = "stiffness_N_per_m", "damping_N_s_per_m", "bound_N"

    type: Literal["linear"]
    point_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="in body's axes, from its origin")
    other_point_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="in those of other")
    stiffness_N_per_m: NonNegative = 0.0
    damping_N_s_per_m: NonNegative = 0.0
    bound_N: Positive | None = Field(default=None, description="beyond it x_0 moves; default: none")
    rest_m: float | None = Field(default=None, description="x_0; default: x at the start")

    def tie(self, name: str) -> Tie:
        """The tie of that name."""
        start = math.nan if self.rest_m is None else self.rest_m
        return replace(
            super().tie(name), point=np.array(self.point_m), other_point=np.array(self.other_point_m), rest=start
        )


class Torsion(TieConfig):
    """About the axis: the same of the rotation of body against other."""

    LAW = "stiffness_N_m_per_rad", "damping_N_m_s_per_rad", "bound_N_m"

    type: Literal["torsion"]
    stiffness_N_m_per_rad: NonNegative = 0.0
    damping_N_m_s_per_rad: NonNegative = 0.0
    bound_N_m: Positive | None = Field(default=None, description="beyond it x_0 moves; default: none")

    def tie(self, name: str) -> Tie:
        """The tie of that name."""
        return replace(super().tie(name), turns=True)


TieChoice = Annotated[Linear | Torsion, Field(discriminator="type")]


# The ``loads:`` section of a scenario: forces and torques on bodies, and payloads fixed to them.


FORCE_COLUMNS = ("t_s", "fx_N", "fy_N", "fz_N")
TORQUE_COLUMNS = ("mx_N_m", "my_N_m", "mz_N_m")

# Times, (K + 1,) [s], and coefficients of cubic polynomials of the six components between them, (K, 6, 4).
Pieces = tuple[NDArray[np.float64], NDArray[np.float64]]


class WrenchConfig(BodyPoint):
    """Where a wrench acts, and in which axes it is given."""

    frame: Literal["world", "body"] = Field(default="world", description="axes of force and torque")


class Constant(WrenchConfig):
    """A constant force and torque."""

    type: Literal["constant"]
    force_N: Vector3 = [0.0, 0.0, 0.0]
    torque_N_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="about the point")

    @property
    def hold(self) -> bool:
        """It has no end."""
        return True

    def pieces(self, duration: float) -> Pieces:
        """One constant piece from 0 to ``duration`` [s]."""
        coefficients = np.zeros((1, 6, 4))
        coefficients[0, :, 0] = [*self.force_N, *self.torque_N_m]
        return np.array([0.0, duration]), coefficients


class Sampled(WrenchConfig):
    """A force and a torque through samples."""

    interpolation: Literal["spline", "linear"] = Field(
        default="spline", description="spline: cubic, not-a-knot (of two samples a line, of three a parabola)"
    )
    hold: bool = Field(default=False, description="first and last sample go on beyond the times, else it is zero there")
    # Of all columns, made once: an edit of a file does not change a scenario that is already loaded.
    _pieces: Pieces = PrivateAttr()

    def pieces(self, duration: float) -> Pieces:
        """Times and polynomials through the samples."""
        return self._pieces

    def _interpolate(self, times: list[float], values: NDArray[np.float64]) -> Pieces:
        """Polynomials through ``values``, (T, 6); ValueError where rounding leaves them not finite or off these."""
        knots = np.array(times)
        try:
            with np.errstate(all="ignore"):
                coefficients = self._coefficients(knots, values)
                step = np.diff(knots)[:, None] ** np.arange(4)
                met = np.allclose(np.einsum("kcp,kp->kc", coefficients, step), values[1:], rtol=1e-9, atol=1e-12)
        except ValueError:  # slopes that overflow
            met = False
        if not (met and np.isfinite(coefficients).all()):
            raise ValueError("numbers too large, or samples too close in time, for a curve through them")
        return knots, coefficients

    def _coefficients(self, knots: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.interpolation == "spline":
            from scipy.interpolate import CubicSpline  # takes 0.3 s

            return np.ascontiguousarray(CubicSpline(knots, values).c[::-1].transpose(1, 2, 0))
        coefficients = np.zeros((len(knots) - 1, 6, 4))
        coefficients[:, :, 0] = values[:-1]
        coefficients[:, :, 1] = np.diff(values, axis=0) / np.diff(knots)[:, None]
        return coefficients


class Samples(Sampled):
    """Force and torque at ``times_s``."""

    type: Literal["samples"]
    times_s: list[float] = Field(min_length=2)
    force_N: list[Vector3] | None = Field(default=None, description="one vector for each time; default: no force")
    torque_N_m: list[Vector3] | None = Field(default=None, description="about the point, likewise")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.any(np.diff(self.times_s) <= 0.0):
            raise error_at("times_s", "must increase")
        values = {"force_N": self.force_N, "torque_N_m": self.torque_N_m}
        for key, vectors in values.items():
            if vectors is not None and len(vectors) != len(self.times_s):
                raise error_at(key, f"{len(vectors)} vectors and {len(self.times_s)} times_s: there must be as many")
        if self.force_N is None and self.torque_N_m is None:
            raise ValueError("has neither force_N nor torque_N_m")
        nothing = np.zeros((len(self.times_s), 3))
        columns = [nothing if vectors is None else np.array(vectors) for vectors in values.values()]
        self._pieces = self._interpolate(self.times_s, np.hstack(columns))
        return self


class Table(Sampled):
    """Force and torque from a CSV file."""

    type: Literal["csv"]
    file: str = Field(
        description=f"CSV file, relative to the scenario file, with a header {','.join(FORCE_COLUMNS)}, "
        f"or that and {','.join(TORQUE_COLUMNS)}"
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
    """A body that is fixed to one of the robot's; its centre of mass is at ``point_m``; without mass it is none."""

    type: Literal["payload"]
    mass_kg: NonNegative
    radius_m: NonNegative = Field(default=0.0, description="of a solid sphere; zero: a point mass")
    inertia_kg_m2: Annotated[list[NonNegative], Field(min_length=3, max_length=3)] | None = Field(
        default=None, description="xx yy zz about the centre of mass, in the axes of body; default: the sphere's"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.inertia_kg_m2 is not None and self.radius_m > 0.0:
            raise error_at("inertia_kg_m2", "cannot be given together with radius_m; remove one of the two")
        if self.inertia_kg_m2 is not None and self.mass_kg == 0.0:
            raise error_at("inertia_kg_m2", "cannot be that of mass_kg = 0; remove it, or give radius_m instead")
        return self


LoadConfig = Annotated[Constant | Samples | Table | Payload, Field(discriminator="type")]


# The ``objects:`` section of a scenario: bodies in addition to the robot, each a separate tree rooted in the world.


# Of wood, so that no object is taken for a part of the robot.
COLOUR = (0.91, 0.81, 0.65, 1.0)
Edges = Annotated[list[Positive], Field(min_length=3, max_length=3)]


Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class Guide(StrictConfig):
    """What lets an object move in one way; ``KIND`` is that of its joint."""

    KIND: ClassVar[str]

    axis: Vector3 = Field([0.0, 0.0, 1.0], description="in the object's own axes")

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit_vector(self.axis, "axis")
        return self

    def _joint(self, link: Link, damping: float, friction: float, limits: list[float] | None) -> Link:
        """The link on this joint, with limits [rad or m]."""
        lower, upper = limits or (-math.inf, math.inf)
        axis = unit_vector(self.axis, "axis")
        return replace(link, kind=self.KIND, axis=axis, damping=damping, friction=friction, lower=lower, upper=upper)


class Hinge(Guide):
    """An axis about which an object turns."""

    KIND = "revolute"

    point_m: Vector3 = Field(
        [0.0, 0.0, 0.0], description="a point of the axis, from the object's centre; it is the origin of the body"
    )
    friction_N_m: NonNegative = Field(0.0, description="that holds it at rest; unilateral law")
    damping_N_m_s_per_rad: NonNegative = 0.0
    limits_deg: Pair | None = Field(None, description="lower and upper; default: none")
    spring_N_m_per_rad: NonNegative = Field(0.0, description="stiffness of a closer; time stepping only")
    rest_deg: float = Field(0.0, gt=-180.0, lt=180.0, description="angle at which the spring has no torque")

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        _ordered(self.limits_deg, "limits_deg")
        return self

    def joint(self, link: Link) -> Link:
        """The link on this joint."""
        limits = None if self.limits_deg is None else np.deg2rad(self.limits_deg).tolist()
        return self._joint(link, self.damping_N_m_s_per_rad, self.friction_N_m, limits)

    def spring(self, name: str, link: Link) -> Tie | None:
        """Its closer, between the link and the world."""
        angle, law = math.radians(self.rest_deg), (self.spring_N_m_per_rad, 0.0)
        tie = Tie(f"{name}.spring", link.name, WORLD, link.axis, *law, turns=True, rest=angle, attitude=link.R_PJ.T)
        return tie if self.spring_N_m_per_rad > 0.0 else None


class Slide(Guide):
    """Rails on which an object moves along a straight line, as a drawer does."""

    KIND = "prismatic"

    axis: Vector3 = Field([1.0, 0.0, 0.0], description="in the object's own axes")
    friction_N: NonNegative = Field(0.0, description="that holds it at rest; unilateral law")
    damping_N_s_per_m: NonNegative = 0.0
    limits_m: Pair | None = Field(None, description="lower and upper; default: none")
    spring_N_per_m: NonNegative = Field(0.0, description="time stepping only")
    rest_m: float = Field(0.0, description="displacement at which the spring has no force")

    @property
    def point_m(self) -> list[float]:
        """The joint is at the centre."""
        return [0.0, 0.0, 0.0]

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        _ordered(self.limits_m, "limits_m")
        return self

    def joint(self, link: Link) -> Link:
        """The link on this joint."""
        return self._joint(link, self.damping_N_s_per_m, self.friction_N, self.limits_m)

    def spring(self, name: str, link: Link) -> Tie | None:
        """Its spring, between the link and the world."""
        law, at = (self.spring_N_per_m, 0.0), link.p_PJ
        tie = Tie(f"{name}.spring", link.name, WORLD, link.axis, *law, other_point=at, rest=self.rest_m)
        return tie if self.spring_N_per_m > 0.0 else None


def _ordered(limits: list[float] | None, key: str) -> None:
    if limits is not None and not limits[0] < limits[1]:
        raise error_at(key, "the lower limit must be below the upper one")


class Solid(StrictConfig):
    """A shape with mass: a box, a sphere, or a cylinder along its own z axis."""

    mass_kg: Positive
    shape: Literal["box", "sphere", "cylinder"] = "box"
    size_m: Edges | None = Field(None, description="edges of a box along its axes")
    radius_m: Positive | None = Field(None, description="of a sphere or a cylinder")
    length_m: Positive | None = Field(None, description="of a cylinder, along its z axis")

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        _check_sizes(self)
        return self

    @property
    def inertia(self) -> Inertia:
        """Inertia about the centre: box I_x = m (b² + c²)/12, sphere I = 2 m r²/5, cylinder I_z = m r²/2."""
        if self.size_m is not None:
            squares = np.array(self.size_m) ** 2
            return Inertia(self.mass_kg, np.zeros(3), np.diag(self.mass_kg * (squares.sum() - squares) / 12.0))
        radius = float(self.radius_m or 0.0)
        if self.length_m is None:
            return Inertia.solid_sphere(self.mass_kg, radius, np.zeros(3))
        return replace(Inertia.solid_cylinder(self.mass_kg, radius, self.length_m), com=np.zeros(3))

    @property
    def solid(self) -> Shape:
        """What it looks like."""
        if self.size_m is not None:
            return Shape("box", tuple(self.size_m), colour=COLOUR)
        radius = float(self.radius_m or 0.0)
        if self.length_m is None:
            return Shape("sphere", (radius,), colour=COLOUR)
        return Shape("cylinder", (radius, self.length_m), colour=COLOUR)

    @property
    def spheres(self) -> tuple[Array, float]:
        """Centres (k, 3) and radius of spheres that touch surfaces [m]: corners, the sphere, or ends of a cylinder.

        Ends of a cylinder are spheres within it: a pipe that lies touches as it should, one that stands stands on a
        sphere.
        """
        if self.size_m is not None:
            signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
            return signs * self.size_m, 0.0
        radius = float(self.radius_m or 0.0)
        if self.length_m is None:
            return np.zeros((1, 3)), radius
        end = max(0.5 * self.length_m - radius, 0.0)
        return np.array([[0.0, 0.0, -end], [0.0, 0.0, end]]), radius


SIZES = {"box": ("size_m",), "sphere": ("radius_m",), "cylinder": ("radius_m", "length_m")}


def _check_sizes(solid: Solid | SceneObject) -> None:
    """Raise an error for a size that the shape needs and has not, or has and does not need."""
    needed = SIZES[solid.shape]
    for key in ("size_m", "radius_m", "length_m"):
        if (getattr(solid, key) is None) == (key in needed):
            text = (
                f"is needed for a {solid.shape}" if key in needed else f"does not apply to a {solid.shape}; remove it"
            )
            raise error_at(key, text)


class Part(Solid):
    """One of several solids of which an object is made."""

    position_m: Vector3 = Field([0.0, 0.0, 0.0], description="position of its centre, in the object's axes")
    rpy_deg: Vector3 = Field([0.0, 0.0, 0.0], description="attitude in the object's axes, Rz(yaw) Ry(pitch) Rx(roll)")


class Grasp(StrictConfig):
    """Where and from where a gripper can hold an object."""

    position_m: Vector3 = Field(
        [0.0, 0.0, 0.0], description="where the tip of the gripper is then, in the object's axes from its centre"
    )
    axis: Vector3 = Field(
        [1.0, 0.0, 0.0], description="direction in which the gripper points then, in the object's axes"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit_vector(self.axis, "axis")
        return self


class ObjectWheel(StrictConfig):
    """A body that turns on an object and rolls on surfaces: a sphere where it touches, with the inertia of a disc."""

    position_m: Vector3 = Field(description="of its centre, in the object's axes from its centre")
    axis: Vector3 = Field([0.0, 1.0, 0.0], description="in the object's axes")
    radius_m: Positive
    mass_kg: Positive
    friction_N_m: NonNegative = Field(0.0, description="of its bearing, that holds it at rest; unilateral law")
    damping_N_m_s_per_rad: NonNegative = 0.0
    motor: union("motor") | None = Field(None, description="default: it turns freely")  # type: ignore[valid-type]

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit_vector(self.axis, "axis")
        return self

    def link(self, name: str, carrier: str) -> Link:
        """Its body and joint, on the object's body; the disc has I = m r²/2 about its axis, half of that across."""
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
        )


class SceneObject(StrictConfig):
    """A solid box, sphere or cylinder, or a body of several parts."""

    mass_kg: Positive | None = Field(None, description="default: the sum of those of its parts")
    shape: Literal["box", "sphere", "cylinder", "parts"] = "box"
    size_m: Edges | None = Field(None, description="edges of a box along its axes")
    radius_m: Positive | None = Field(None, description="of a sphere or a cylinder")
    length_m: Positive | None = Field(None, description="of a cylinder, along its z axis")
    parts: Annotated[dict[str, Part], Field(min_length=1)] | None = Field(
        None, description="solids by name, fixed to each other, of `shape: parts`"
    )
    position_m: Vector3 = Field(description="of its centre at the start, in the world; of parts: of their origin")
    rpy_deg: Vector3 = Field([0.0, 0.0, 0.0], description="attitude at the start, Rz(yaw) Ry(pitch) Rx(roll)")
    hinge: Hinge | None = Field(None, description="default: it is free")
    slide: Slide | None = Field(None, description="default: it is free")
    wheels: dict[str, ObjectWheel] = Field({}, description="wheels of a free one, by name")
    grasp: Grasp | None = Field(None, description="where a gripper can hold it; default: nowhere")

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        if self.hinge is not None and self.slide is not None:
            raise error_at("slide", "this object is on a hinge already; remove one of the two")
        if self.joint is not None and self.wheels:
            on = "hinge" if self.hinge is not None else "slide"
            raise error_at("wheels", f"are of free objects, this one is on a {on}; remove one of the two")
        if self.shape == "parts":
            for key in ("mass_kg", "size_m", "radius_m", "length_m"):
                if getattr(self, key) is not None:
                    raise error_at(key, "does not apply to an object of parts, each of which has its own; remove it")
            if self.parts is None:
                raise error_at("parts", "is needed for shape: parts")
            return self
        if self.parts is not None:
            raise error_at("parts", f"does not apply to a {self.shape}; remove it, or set shape: parts")
        if self.mass_kg is None:
            raise error_at("mass_kg", f"is needed for a {self.shape}")
        _check_sizes(self)
        return self

    @property
    def joint(self) -> Hinge | Slide | None:
        """The joint between the object and the world; None: it is free."""
        return self.hinge if self.hinge is not None else self.slide

    @property
    def solids(self) -> dict[str, Part]:
        """Its parts; a single solid is one part."""
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
        """What it looks like, in its axes from its centre."""
        parts = self.solids.values()
        return tuple(part.solid.placed(part.position_m, quaternion(_turn(part.rpy_deg))) for part in parts)

    @property
    def _origin(self) -> Array:
        """Origin of its body, in its axes from its centre: on its hinge [m]."""
        return np.zeros(3) if self.joint is None else np.array(self.joint.point_m)

    def links(self, name: str) -> tuple[Link, ...]:
        """Its tree; joint and body have the name of the object."""
        back = -self._origin
        shapes = tuple(shape.placed(back, HERE) for shape in self.shapes)
        inertia = self.inertia.placed(np.eye(3), back)
        link = Link(name, name, None, "revolute", np.array([0.0, 0.0, 1.0]), inertia, shapes=shapes)
        if self.joint is None:
            return (*floating(link), *(wheel.link(f"{name}.{own}", name) for own, wheel in self.wheels.items()))
        R = _turn(self.rpy_deg)
        return (replace(self.joint.joint(link), R_PJ=R, p_PJ=np.array(self.position_m) + R @ self._origin),)

    def ties(self, name: str) -> list[Tie]:
        """The spring of its hinge or rails."""
        spring = None if self.joint is None else self.joint.spring(name, self.links(name)[0])
        return [] if spring is None else [spring]

    def frames(self, name: str) -> list[Frame]:
        """Its grasp frame, whose x axis is the direction in which a gripper points."""
        if self.grasp is None:
            return []
        R = frame_along(unit_vector(self.grasp.axis, "axis"))
        return [Frame(grasp_frame(name), name, R, np.array(self.grasp.position_m) - self._origin)]

    def start(self) -> list[float]:
        """Its coordinates at the start."""
        if self.joint is not None:
            return [0.0]
        return [*self.position_m, *quaternion(_turn(self.rpy_deg)), *(0.0 for _ in self.wheels)]

    def motors(self, name: str, context: BuildContext) -> list[Drive]:
        """Those of its wheels."""
        joints = {f"{name}.{own}": wheel.motor for own, wheel in self.wheels.items() if wheel.motor is not None}
        return [build("motor", motor, context.at_joint(joint), Drive) for joint, motor in joints.items()]

    def feet(self, name: str, surfaces: list[str]) -> list[Foot]:
        """With what it can touch each of these surfaces."""
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
    # Imported here: the reader of URDF takes long to load.
    if not any(rpy_deg):
        return np.eye(3)
    from dynsim.model.urdf.reader import rotation

    return rotation(*np.deg2rad(rpy_deg))


def frame_along(axis: Array) -> Array:
    """Rotation (3, 3) whose x axis is a unit vector, with its y axis level if it can be."""
    side = np.cross([0.0, 0.0, 1.0], axis)
    if np.linalg.norm(side) < 1e-9:
        side = np.array([0.0, 1.0, 0.0])
    side = side / np.linalg.norm(side)
    return np.column_stack([axis, side, np.cross(axis, side)])


# Nulls of a resolved scenario: those in whose place a default would come where they were left out.


def write_nulls(config: BaseModel, written: dict[str, Any], defaults: Any = None) -> None:
    """Write ``null`` where a configuration has it and its member, or the plant, has another default.

    ``written`` : the configuration as it was dumped without nulls; ``defaults`` : those of the plant, of the same form
    """
    for key, member in type(config).model_fields.items():
        value, of_plant = getattr(config, key), _entry(defaults, key)
        if value is not None:
            _write_within(value, written.get(key), of_plant)
        elif not member.exclude and (member.default is not None or of_plant is not None):
            written[key] = None


def _write_within(value: Any, written: Any, defaults: Any) -> None:
    """The same for a value: a configuration, or several of them in a mapping or list."""
    if isinstance(value, BaseModel):
        if isinstance(written, dict):
            write_nulls(value, written, defaults)
    elif isinstance(value, Mapping) and isinstance(written, Mapping):
        for name, part in value.items():
            _write_within(part, _entry(written, name), _entry(defaults, name))
    elif isinstance(value, (list, tuple)) and isinstance(written, list):
        for part, dumped in zip(value, written, strict=True):
            _write_within(part, dumped, None)


def _entry(mapping: Any, key: Any) -> Any:
    return mapping.get(key) if isinstance(mapping, Mapping) else None


# Most bytes in the name of a folder on common file systems.
NAME_LIMIT = 255

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Grip(StrictConfig):
    """Friction that differs along and across an axis of the body, as that of a wheel."""

    axis: Vector3 = Field(description="in the axes of the body or frame: along it, as far as it lies in the surface")
    ratio: Share = Field(description="friction along the axis as a fraction of that across; 0: it rolls freely")

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, value: list[float]) -> list[float]:
        if not any(value):
            raise ValueError("has no direction")
        return value


class ContactPoint(BodyPoint):
    """A point fixed on a body, or a sphere about it, held to a surface."""

    surface: str = "floor"
    radius_m: NonNegative = Field(default=0.0, description="of a sphere about the point, which touches instead of it")
    friction: NonNegative | None = Field(default=None, description="kinetic coefficient; default: that of contacts")
    static_friction: NonNegative | None = Field(default=None, description="default: that of contacts; unilateral law")
    restitution: Share | None = Field(default=None, description="default: that of contacts; unilateral law")
    grip: Grip | None = Field(default=None, description="anisotropic friction; only of integrator.method time_stepping")
    stiffness_N_per_m: Positive | None = Field(
        default=None, description="default: that of contacts; time_stepping only"
    )
    damping_N_s_per_m: NonNegative | None = Field(default=None, description="default: that of contacts")
    enabled: bool = True


class Contacts(StrictConfig):
    """Contact law and contact points."""

    law: Literal["bilateral", "unilateral"] = Field(
        default="bilateral",
        description="points stay on their surfaces, f_n of any sign; or they are pushed only, stick, slip and lift off",
    )
    friction: NonNegative = Field(default=0.1, description="kinetic coefficient μ")
    static_friction: NonNegative | None = Field(
        default=None, description="coefficient that holds at rest, at least friction (the default); unilateral law"
    )
    stribeck_m_s: Positive | None = Field(
        default=None,
        description="v_s of μ + (μ_s − μ) exp(−(v/v_s)²); default: μ from the first slip on; unilateral law",
    )
    viscous_friction_s_per_m: NonNegative = Field(
        default=0.0, description="what each m/s of slip adds to the coefficient; unilateral law"
    )
    restitution: Share = Field(
        default=0.0, description="share of the normal speed that an impact turns round; unilateral law"
    )
    stiffness_N_per_m: Positive | None = Field(
        default=None, description="of body and surface along the normal; default: rigid; time_stepping only"
    )
    damping_N_s_per_m: NonNegative = Field(default=0.0, description="along the normal, beside the stiffness")
    slip_smoothing_m_s: Positive = Field(default=1e-3, description="v_s of the slip direction v_t/√(v_t² + v_s²)")
    pulling_friction: Literal["signed", "dissipative"] = Field(
        default="dissipative", description="f_t = μ f_n as printed in the paper, or μ |f_n|"
    )
    reference_tolerance_m: Positive = Field(
        default=2e-3, description="references that take a contact point further off its surface than this are refused"
    )
    candidates: Literal["points", "joints", "links"] = Field(
        default="points",
        description="what can touch beside the points: nothing, all joints and the hand, or the links as capsules",
    )
    points: dict[str, ContactPoint] = {}

    def coefficients(self, point: ContactPoint | None = None) -> tuple[float, float]:
        """Kinetic and static coefficient of a point: its own, else those of contacts; static defaults to kinetic."""
        kinetic, static = (
            getattr(self, key) if point is None or getattr(point, key) is None else getattr(point, key)
            for key in ("friction", "static_friction")
        )
        return kinetic, kinetic if static is None else static

    def compliance(self, point: ContactPoint | None = None) -> tuple[float, float]:
        """Stiffness [N/m], 0 of a rigid one, and damping [N s/m] of a point: its own, else those of contacts."""
        stiffness, damping = (
            getattr(self, key) if point is None or getattr(point, key) is None else getattr(point, key)
            for key in ("stiffness_N_per_m", "damping_N_s_per_m")
        )
        return stiffness or 0.0, damping

    @property
    def other_keys(self) -> tuple[str, ...]:
        """Keys that only the other law reads."""
        return BILATERAL_KEYS if self.law == "unilateral" else UNILATERAL_KEYS

    @model_validator(mode="after")
    def _check_coefficients(self) -> Self:
        self._check_compliance()
        kinetic, static = self.coefficients()
        if static < kinetic:
            raise error_at("static_friction", f"is less than friction {self.friction:g}; it must hold as much or more")
        for name, point in self.points.items():
            kinetic, static = self.coefficients(point)
            if static < kinetic:
                key = "friction" if point.static_friction is None else "static_friction"
                raise error_at(
                    f"points.{name}.{key}",
                    f"static_friction {static:g} is less than friction {kinetic:g}; it must hold as much or more",
                )
        return self

    def _check_compliance(self) -> None:
        """Refuse damping where nothing gives way, and restitution where something does."""
        for where, point in {"": None, **{f"points.{name}.": point for name, point in self.points.items()}}.items():
            config = self if point is None else point
            soft = self.compliance(point)[0] > 0.0
            anywhere = soft or (point is None and not all(p.stiffness_N_per_m is None for p in self.points.values()))
            if config.damping_N_s_per_m and not anywhere:
                raise error_at(f"{where}damping_N_s_per_m", "is that of what gives way: give stiffness_N_per_m too")
            restitution = self.restitution if point is None or point.restitution is None else point.restitution
            if soft and restitution > 0.0:
                key = "restitution" if config.restitution else "stiffness_N_per_m"
                raise error_at(f"{where}{key}", f"what gives way has no restitution ({restitution:g}), but a damping")


class Initial(StrictConfig):
    """The start: what the initial posture is changed by, as little as possible, and what holds it."""

    on_surface: list[str] = Field(
        default=[], description="contact points, also disabled ones, that start exactly on their surfaces"
    )
    keep: list[str] = Field(default=[], description="joints that do not move for it, and `hand` for the hand's place")
    on_references: bool = Field(default=False, description="joints with waypoints start where those begin")
    equilibrium: bool = Field(
        default=False, description="currents that hold posture, weight, loads and braces at rest, with the least heat"
    )

    @model_validator(mode="after")
    def _check_effect(self) -> Self:
        if not self.on_surface and not self.equilibrium and not self.on_references:
            raise error_at(
                "on_surface",
                "names no contact point; name some, set equilibrium or on_references: true, or leave initial out",
            )
        if self.keep and not self.on_surface:
            raise error_at("keep", "has no effect without on_surface, for which joints move; remove it")
        return self


class SurfaceError(StrictConfig):
    """By what surfaces differ from those that the controller plans with: how well a plan bears it."""

    shift_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="of all surfaces, in the world")
    friction_factor: NonNegative = Field(default=1.0, description="times every coefficient of friction")


class Integrator(StrictConfig):
    """Time integration."""

    method: Literal[METHODS] = Field(  # type: ignore[valid-type]
        default="auto",
        description="auto: one of the adaptive ones, by the system; adaptive 5(4), adaptive implicit (where motors "
        "hold the steps of the other), or fixed step with contacts that open and close",
    )
    solver: Literal["articulated", "m_star"] = Field(default="articulated", description="O(n) sweeps or the dense M*")
    rtol: float = Field(default=1e-6, ge=1e-13, le=1e-1)
    atol: float | None = Field(
        default=None,
        ge=1e-16,
        le=1e-1,
        description="default: rtol/100, at most 1e-8, so that a smaller rtol has its effect",
    )
    step_s: Positive | None = Field(
        default=None, description="fixed step of time_stepping (default 0.001), else the first step"
    )
    theta: float = Field(
        default=THETA, ge=0.5, le=1.0, description="time_stepping: 0.5 is second order between events, 1 damps"
    )
    step_max_s: Positive | None = None
    wall_limit_s: Positive | None = Field(
        default=None, description="wall time that the integration may take; ten times as much by estimate is refused"
    )

    @field_validator("method", mode="before")
    @classmethod
    def _replaced(cls, value: object) -> object:
        if value in ("rk4", "rk43"):
            raise ValueError("is no longer there; take dopri5, or time_stepping where steps are to be fixed")
        return value

    @property
    def absolute_tolerance(self) -> float:
        """``atol``, or its default: a fixed one would limit the accuracy at small ``rtol``."""
        return min(1e-8, 1e-2 * self.rtol) if self.atol is None else self.atol


class RecordOptions(StrictConfig):
    """What is recorded."""

    rate_hz: Positive = 200.0
    size_limit_GB: Positive = 2.0


class Metrics(StrictConfig):
    """How the summary is computed."""

    settle_s: NonNegative = Field(default=2.0, description="tracking errors count from this time on")


def laid_under(defaults: Any, said: Any) -> Any:
    """``said`` with ``defaults`` where it says nothing; mappings merge."""
    if not (isinstance(defaults, Mapping) and isinstance(said, Mapping)):
        return said
    return {**defaults, **{key: laid_under(defaults.get(key), value) for key, value in said.items()}}


class ScenarioConfig(StrictConfig):
    """A dynsim scenario."""

    name: str = Field(default="", description="default: the name of the file")
    variant: str = Field(default="", description="written into resolved scenarios")
    description: str = ""
    duration_s: Positive
    plant: union("plant")  # type: ignore[valid-type]
    controller: union("controller") | None = None  # type: ignore[valid-type]
    surfaces: dict[str, union("surface")] = {}  # type: ignore[valid-type]
    contacts: Contacts = Contacts()
    surface_error: SurfaceError | None = Field(
        default=None, description="by what surfaces and friction differ from those that the controller plans with"
    )
    initial: Initial | None = Field(default=None, description="posture and currents of the start")
    loads: dict[str, LoadConfig] = Field(default={}, description="forces, torques and payloads by name")
    objects: dict[str, SceneObject] = Field(default={}, description="bodies beside the robot, by name")
    ties: dict[str, TieChoice] = Field(default={}, description="springs and dampers between two bodies, by name")
    sensors: Sensors | None = Field(default=None, description="what a sampled controller is told of the robot")
    integrator: Integrator = Integrator()
    record: RecordOptions = RecordOptions()
    metrics: Metrics = Metrics()

    @model_validator(mode="before")
    @classmethod
    def _of_plant(cls, data: Any) -> Any:
        """Some plants want other defaults in other sections."""
        if not isinstance(data, Mapping):
            return data
        return laid_under(section_defaults(data.get("plant"), data), data)

    @model_validator(mode="after")
    def _check_combinations(self) -> Self:
        check_keys(self)
        return self

    @field_validator("name", "variant")
    @classmethod
    def _check_folder(cls, value: str) -> str:
        """Both name folders of the results: neither may lead out of them."""
        if value in (".", "..") or any(sign in value for sign in "/\\\0"):
            raise ValueError("names a folder of the results, so it must not have slashes or be dots")
        if not value.isprintable():
            raise ValueError("names a folder of the results, so it must be printable in one line")
        if len(value.encode()) > NAME_LIMIT:
            raise ValueError(f"names a folder of the results, so it must not be longer than {NAME_LIMIT} bytes")
        return value


@dataclass(frozen=True)
class Scenario:
    """One validated simulation.

    Attributes
    ----------
    name, variant : str
        The variant is "" for a scenario without variants.
    config : ScenarioConfig
    source : Path or None
        The file it came from.
    origin : Origin or None
        Lines of its keys in that file.
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
        """Name and variant, for a line of text."""
        return f"{self.name} ({self.variant})" if self.variant else self.name

    @property
    def duration_s(self) -> float:
        """Simulated time [s]."""
        return self.config.duration_s

    @property
    def plant(self) -> Any:
        """Configuration of the machine, the ``Config`` of its module."""
        return self.config.plant

    @property
    def controller(self) -> Any:
        """Configuration of the controller, None without one."""
        return self.config.controller

    @property
    def integrator(self) -> Integrator:
        """Method, solver and tolerances."""
        return self.config.integrator

    @property
    def record(self) -> RecordOptions:
        """Rate [Hz] and size limit [GB] of the record."""
        return self.config.record

    @property
    def metrics(self) -> Metrics:
        """How the summary is computed."""
        return self.config.metrics

    @property
    def engine(self) -> str:
        """What simulates the plant."""
        return engine(self.plant)

    @property
    def resolved(self) -> dict[str, Any]:
        """The scenario with defaults and overrides written out; reading it again gives the same simulation.

        Defaults that change nothing are left out.
        """
        resolved = self.config.model_dump(mode="json", exclude_none=True)
        write_nulls(self.config, resolved, section_defaults(resolved["plant"], resolved))
        for section in ("loads", "objects", "ties"):
            if not getattr(self.config, section):
                del resolved[section]
        contacts = self.config.contacts
        for part in (resolved["contacts"], *resolved["contacts"]["points"].values()):
            for key in contacts.other_keys:
                part.pop(key, None)
        # What changes nothing is not there, unless it was said.
        for keys in idle_keys(self.config):
            section, *inner = map(str, keys)
            if len(inner) == 1 and not is_set(self.config, keys) and isinstance(resolved.get(section), dict):
                resolved[section].pop(inner[0], None)
                if not resolved[section]:
                    del resolved[section]
        return resolved

    def location(self, keys: Sequence[int | str] = (), variant: str = "") -> str:
        """``file:line`` of a key, the text for ``variant``, and how the key was overridden."""
        line, overridden = 0, ""
        if keys and self.origin is not None:
            overridden = f": {self.origin.overriding}" if self.origin.sets(keys) else ""
            line = 0 if overridden else self.origin.line(keys)
        return f"{self.source or self.name}{f':{line}' if line else ''}{variant}{overridden}"
