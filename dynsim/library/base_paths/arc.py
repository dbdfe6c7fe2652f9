"""Circular arc of a mobile base, from rest to rest with minimum jerk."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.splines import minimum_jerk
from dynsim.config.base import NonNegative, Positive, StrictConfig, default
from dynsim.model.description import Array


class Config(StrictConfig):
    """Arc about a centre at distance `radius_m` from the middle of the axle; the heading turns by `angle_deg`."""

    type: Literal["arc"]
    radius_m: float = Field(
        description="radius of the arc; positive: centre on the left, negative: on the right, 0: turn on the spot"
    )
    angle_deg: float = Field(
        description="change of heading, positive to the left; the base reverses if its sign differs from radius_m"
    )
    duration_s: Positive = Field(description="duration of the motion")
    start_s: NonNegative = default(0.0, "start time of the motion")

    def motion(self, t: Array) -> Array:
        """Return distance R ψ [m] and turn ψ = α s [rad] at times t [s], shape (T, 2); s is the minimum-jerk curve."""
        turn = np.deg2rad(self.angle_deg) * minimum_jerk(t, self.start_s, self.duration_s)
        return np.stack([self.radius_m * turn, turn], axis=1)


def build(config: Config, context: BuildContext) -> BasePath:
    """Return the configuration itself, which implements the `BasePath` interface."""
    return config
