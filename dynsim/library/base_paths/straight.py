"""Straight motion of a mobile base, forward or backward, from rest to rest with minimum jerk."""

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
    """Motion by `distance_m` along the heading within `duration_s`."""

    type: Literal["straight"]
    distance_m: float = Field(description="distance along the heading; negative: backward")
    duration_s: Positive = Field(description="duration of the motion")
    start_s: NonNegative = default(0.0, "start time of the motion")

    def motion(self, t: Array) -> Array:
        """Return distance d s [m] and zero turn at times t [s], shape (T, 2); s is the minimum-jerk profile."""
        distance = self.distance_m * minimum_jerk(t, self.start_s, self.duration_s)
        return np.stack([distance, np.zeros_like(distance)], axis=1)


def build(config: Config, context: BuildContext) -> BasePath:
    """Return the configuration itself, which implements the `BasePath` interface."""
    return config
