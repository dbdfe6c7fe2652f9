"""Straight hand path between two points, from rest to rest."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field

from dynsim.compile.control import HandPath, HandPathConfig
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.splines import minimum_jerk
from dynsim.config.base import NonNegative, Positive, Vector3, default
from dynsim.model.description import Array


class Config(HandPathConfig):
    """Line from `from_m` to `to_m` within `duration_s`: a quintic with zero velocity and acceleration at the ends."""

    type: Literal["line"]
    from_m: Vector3 = Field(description="first point")
    to_m: Vector3 = Field(description="last point")
    start_s: NonNegative = default(0.0, "start time of the motion")
    duration_s: Positive = Field(description="duration of the motion")

    def position(self, t: Array) -> Array:
        """Return a + (b − a) s(x) with s = 10x³ − 15x⁴ + 6x⁵ at times t [s], shape (T, 3) [m]."""
        a, b = np.array(self.from_m), np.array(self.to_m)
        return a + np.outer(minimum_jerk(t, self.start_s, self.duration_s), b - a)


def starting_at(config: Config, point: list[float]) -> dict[str, Any]:
    """Return the keys of a line that starts at a point [m]."""
    return {"from_m": point}


def build(config: Config, context: BuildContext) -> HandPath:
    """Return the configuration itself, which implements the `HandPath` interface."""
    return config
