"""Straight ahead or back by a distance, from rest to rest with minimum jerk."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.plane_curve import minimum_jerk
from dynsim.config.base import NonNegative, Positive, StrictConfig


class Config(StrictConfig):
    """By ``distance_m`` along the heading in ``duration_s``."""

    type: Literal["straight"]
    distance_m: float = Field(description="negative: back")
    duration_s: Positive
    start_s: NonNegative = 0.0

    def motion(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance d s(x) [m] and no turn at times t [s], (T, 2)."""
        distance = self.distance_m * minimum_jerk(t, self.start_s, self.duration_s)
        return np.stack([distance, np.zeros_like(distance)], axis=1)


def build(config: Config, context: BuildContext) -> BasePath:
    """The path, which its configuration is."""
    return config
