"""A straight line from one point to another, at rest at both ends."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.control import HandPath
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.plane_curve import minimum_jerk
from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3


class Config(StrictConfig):
    """From ``from_m`` to ``to_m`` in ``duration_s``, along a quintic (no velocity or acceleration at the ends)."""

    type: Literal["line"]
    from_m: Vector3
    to_m: Vector3
    start_s: NonNegative = 0.0
    duration_s: Positive

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """a + (b − a) s(x) with s = 10x³ − 15x⁴ + 6x⁵ at times t [s], shape (T, 3) [m]."""
        a, b = np.array(self.from_m), np.array(self.to_m)
        return a + np.outer(minimum_jerk(t, self.start_s, self.duration_s), b - a)


def build(config: Config, context: BuildContext) -> HandPath:
    """The path, which its configuration is."""
    return config
