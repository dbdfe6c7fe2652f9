"""The ``objects:`` section of a scenario: bodies in addition to the robot, each a separate tree rooted in the world.

    objects:
      box: {mass_kg: 0.3, size_m: [0.06, 0.06, 0.06], position_m: [0.4, 0.0, 0.03]}
      valve: {mass_kg: 1.0, shape: sphere, radius_m: 0.1, position_m: [0.5, 0, 0.4], hinge: {friction_N_m: 0.5}}
      door:
        {mass_kg: 5, size_m: [0.04, 0.4, 0.8], position_m: [1, 0.2, 0.4], hinge: {point_m: [0, 0.2, 0]}}

A free object can touch all surfaces, with its corners or as a sphere, and roll on wheels; one on a hinge or on a rail
touches nothing. There is no contact between bodies. A gripper holds an object at its grasp frame.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import WHEEL_WIDTH, turn_from_z
from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3, error_at, unit_vector
from dynsim.library.families import build, union
from dynsim.model.description import WORLD, Array, Foot, Frame, Inertia, Link, Tie
from dynsim.model.drives import Drive
from dynsim.model.gripper import grasp_frame
from dynsim.model.joints.ball import floating
from dynsim.record.scene import HERE, Shape, quaternion

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
