"""The ``objects:`` section of a scenario: bodies beside the robot, each a tree of its own, rooted in the world.

    objects:
      box: {mass_kg: 0.3, size_m: [0.06, 0.06, 0.06], position_m: [0.4, 0.0, 0.03]}
      valve: {mass_kg: 1.0, shape: sphere, radius_m: 0.1, position_m: [0.5, 0, 0.4], hinge: {friction_N_m: 0.5}}

A free object can touch all surfaces, with its corners or as a sphere, and roll on wheels; one on a hinge turns about
its centre and touches nothing. There is no contact between bodies.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import WHEEL_WIDTH, turn_from_z
from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3, error_at, unit_vector
from dynsim.library.families import build, union
from dynsim.model.description import Array, Foot, Inertia, Link
from dynsim.model.drives import Drive
from dynsim.model.joints.ball import floating
from dynsim.record.scene import Shape, quaternion

Edges = Annotated[list[Positive], Field(min_length=3, max_length=3)]


class Hinge(StrictConfig):
    """What an object turns on."""

    axis: Vector3 = Field([0.0, 0.0, 1.0], description="through its centre, in its own axes")
    friction_N_m: NonNegative = Field(0.0, description="that holds it at rest; unilateral law")
    damping_N_m_s_per_rad: NonNegative = 0.0
    limits_deg: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        None, description="lower and upper; default: none"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit_vector(self.axis, "axis")
        if self.limits_deg is not None and not self.limits_deg[0] < self.limits_deg[1]:
            raise error_at("limits_deg", "the lower limit must be below the upper one")
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
    """A solid box or sphere."""

    mass_kg: Positive
    shape: Literal["box", "sphere"] = "box"
    size_m: Edges | None = Field(None, description="edges of a box along its axes")
    radius_m: Positive | None = Field(None, description="of a sphere")
    position_m: Vector3 = Field(description="of its centre at the start, in the world")
    rpy_deg: Vector3 = Field([0.0, 0.0, 0.0], description="attitude at the start, Rz(yaw) Ry(pitch) Rx(roll)")
    hinge: Hinge | None = Field(None, description="default: it is free")
    wheels: dict[str, ObjectWheel] = Field({}, description="wheels of a free one, by name")

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        if self.hinge is not None and self.wheels:
            raise error_at("wheels", "are of free objects, this one is on a hinge; remove one of the two")
        needed, other = ("size_m", "radius_m") if self.shape == "box" else ("radius_m", "size_m")
        if getattr(self, needed) is None:
            raise error_at(needed, f"is needed for a {self.shape}")
        if getattr(self, other) is not None:
            raise error_at(other, f"is none of a {self.shape}; remove it")
        return self

    @property
    def inertia(self) -> Inertia:
        """Of the solid about its centre: box I_x = m (b² + c²)/12, sphere I = 2 m r²/5."""
        if self.size_m is None:
            return Inertia.solid_sphere(self.mass_kg, self.radius_m or 0.0, np.zeros(3))
        squares = np.array(self.size_m) ** 2
        return Inertia(self.mass_kg, np.zeros(3), np.diag(self.mass_kg * (squares.sum() - squares) / 12.0))

    @property
    def solid(self) -> Shape:
        """What it looks like."""
        if self.size_m is None:
            return Shape("sphere", (float(self.radius_m or 0.0),))
        return Shape("box", tuple(self.size_m))

    @property
    def _turn(self) -> Array:
        # The reader of URDF waits until somebody turns something.
        from dynsim.model.urdf.reader import rotation

        return rotation(*np.deg2rad(self.rpy_deg))

    def links(self, name: str) -> tuple[Link, ...]:
        """Its tree; joint and body have the name of the object."""
        link = Link(name, name, None, "revolute", np.array([0.0, 0.0, 1.0]), self.inertia, shapes=(self.solid,))
        if self.hinge is None:
            return (*floating(link), *(wheel.link(f"{name}.{own}", name) for own, wheel in self.wheels.items()))
        hinge = self.hinge
        lower, upper = np.deg2rad(hinge.limits_deg).tolist() if hinge.limits_deg else (-math.inf, math.inf)
        return (
            replace(
                link,
                axis=unit_vector(hinge.axis, "axis"),
                R_PJ=self._turn,
                p_PJ=np.array(self.position_m),
                damping=hinge.damping_N_m_s_per_rad,
                friction=hinge.friction_N_m,
                lower=lower,
                upper=upper,
            ),
        )

    def start(self) -> list[float]:
        """Its coordinates at the start."""
        if self.hinge is not None:
            return [0.0]
        return [*self.position_m, *quaternion(self._turn), *(0.0 for _ in self.wheels)]

    def motors(self, name: str, context: BuildContext) -> list[Drive]:
        """Those of its wheels."""
        joints = {f"{name}.{own}": wheel.motor for own, wheel in self.wheels.items() if wheel.motor is not None}
        return [build("motor", motor, context.at_joint(joint), Drive) for joint, motor in joints.items()]

    def feet(self, name: str, surfaces: list[str]) -> list[Foot]:
        """With what it can touch each of these surfaces."""
        if self.hinge is not None:
            return []
        if self.size_m is None:
            points, radius = np.zeros((1, 3)), float(self.radius_m or 0.0)
        else:
            signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
            points, radius = signs * self.size_m, 0.0
        several = len(points) > 1
        feet = [
            Foot(f"{name}{k + 1 if several else ''}.{surface}", name, point, radius, surface)
            for surface in surfaces
            for k, point in enumerate(points)
        ]
        return feet + [
            Foot(f"{name}.{own}.{surface}", f"{name}.{own}", np.zeros(3), wheel.radius_m, surface)
            for own, wheel in self.wheels.items()
            for surface in surfaces
        ]
