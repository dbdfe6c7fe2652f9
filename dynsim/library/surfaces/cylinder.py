"""An infinite circular cylinder: C(r) = (|P (r − c)|² − R²)/(2R) with P = 1 − a aᵀ."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, StrictConfig, Vector3, unit_vector
from dynsim.model.description import Quadric


class Config(StrictConfig):
    """Cylinder about the line through ``point_m`` along ``axis``; ``inside: true`` makes it a pipe."""

    type: Literal["cylinder"]
    point_m: Vector3
    axis: Vector3
    radius_m: Positive
    inside: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        unit_vector(self.axis, "axis")
        return self


def build(config: Config, context: BuildContext) -> Quadric:
    """The cylinder as a quadric with |∇C| = 1 on it."""
    sign = -1.0 if config.inside else 1.0
    axis, point, radius = unit_vector(config.axis, "axis"), np.array(config.point_m), config.radius_m
    Q = sign / radius * (np.eye(3) - np.outer(axis, axis))
    b = -Q @ point
    return Quadric(Q, b, 0.5 * float(point @ Q @ point) - 0.5 * sign * radius)
