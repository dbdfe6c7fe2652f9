"""Along a circle by an angle, from rest to rest with minimum jerk."""

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
    """The heading turns by ``angle_deg``; the middle of the axle stays ``radius_m`` from the centre of the circle."""

    type: Literal["arc"]
    radius_m: float = Field(description="positive: the centre is on the left; negative: on the right; 0: on the spot")
    angle_deg: float = Field(description="turn of the heading, positive to the left; against the radius: driving back")
    duration_s: Positive
    start_s: NonNegative = 0.0

    def motion(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance R ψ [m] and turn ψ = α s(x) [rad] at times t [s], (T, 2)."""
        turn = np.deg2rad(self.angle_deg) * minimum_jerk(t, self.start_s, self.duration_s)
        return np.stack([self.radius_m * turn, turn], axis=1)


def build(config: Config, context: BuildContext) -> BasePath:
    """The path, which its configuration is."""
    return config
