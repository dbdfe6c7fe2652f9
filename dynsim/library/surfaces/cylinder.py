"""Infinite circular cylinder: C(r) = (|P (r − c)|² − R²)/(2R) with P = 1 − a aᵀ."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Direction, Positive, SurfaceConfig, Vector3, default, unit_vector
from dynsim.model.description import Quadric


class Config(SurfaceConfig):
    """Cylinder about the line through `point_m` along `axis`; with `inside: true` the robot is in a pipe."""

    type: Literal["cylinder"]
    point_m: Vector3 = Field(description="point on the axis, in the world")
    axis: Direction = Field(description="direction of the axis")
    radius_m: Positive = Field(description="radius")
    inside: bool = default(False, "whether the robot is inside")


def build(config: Config, context: BuildContext) -> Quadric:
    """Return the cylinder as a quadric with |∇C| = 1 on the surface."""
    sign = -1.0 if config.inside else 1.0
    axis, point, radius = unit_vector(config.axis, "axis"), np.array(config.point_m), config.radius_m
    Q = sign / radius * (np.eye(3) - np.outer(axis, axis))
    b = -Q @ point
    return Quadric(Q, b, 0.5 * float(point @ Q @ point) - 0.5 * sign * radius)
