"""A helix about a vertical axis."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.control import HandPath, HandPathConfig
from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, Vector3


class Config(HandPathConfig):
    """Counter-clockwise about the vertical through ``center_m``, rising ``pitch_m`` in a turn."""

    type: Literal["helix"]
    center_m: Vector3
    radius_m: Positive
    pitch_m: float
    period_s: Positive = 10.0

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """c + (R cos ωt, R sin ωt, pitch t/T) at times t [s], shape (T, 3) [m]."""
        turns = np.asarray(t) / self.period_s
        angle = 2.0 * np.pi * turns
        offset = np.stack([self.radius_m * np.cos(angle), self.radius_m * np.sin(angle), self.pitch_m * turns], axis=-1)
        return np.array(self.center_m) + offset


def build(config: Config, context: BuildContext) -> HandPath:
    """The path, which its configuration is."""
    return config
