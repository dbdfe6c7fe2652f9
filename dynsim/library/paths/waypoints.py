"""Smooth hand path through points at specified times."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.control import HandPath, HandPathConfig
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.splines import clamped_cubic
from dynsim.config.base import Vector3, check_waypoints
from dynsim.model.description import Array


class Config(HandPathConfig):
    """Cubic spline through `points_m` at `times_s`, at rest at both ends and constant beyond them."""

    type: Literal["waypoints"]
    times_s: list[float] = Field(min_length=2, description="times of the points, increasing")
    points_m: list[Vector3] = Field(min_length=2, description="points")

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_waypoints(self.times_s, self.points_m, "points_m")
        return self

    def position(self, t: Array) -> Array:
        """Return the positions at times t [s], shape (T, 3) [m]."""
        return clamped_cubic(self.times_s, np.array(self.points_m), t)


def starting_at(config: Config, point: list[float]) -> dict[str, Any]:
    """Return the keys of a path whose first point is moved to another point [m]."""
    return {"points_m": [point, *config.points_m[1:]]}


def build(config: Config, context: BuildContext) -> HandPath:
    """Return the configuration itself, which implements the `HandPath` interface."""
    return config
