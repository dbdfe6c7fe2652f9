"""The ``ties:`` section of a scenario: springs, dampers and bounds between two bodies, of the robot or of objects.

ties:
  spring: {type: linear, body: link_3, other: box, axis: [0, 0, 1], stiffness_N_per_m: 500, damping_N_s_per_m: 2}
  twist: {type: torsion, body: link_3, other: box, axis: [0, 0, 1], stiffness_N_m_per_rad: 4, bound_N_m: 0.8}
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3, error_at, unit_vector
from dynsim.model.description import Tie


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
