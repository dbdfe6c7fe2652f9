"""Plane: C(r) = n·(r − r_0)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Direction, SurfaceConfig, Vector3, default, unit_vector
from dynsim.model.description import Quadric


class Config(SurfaceConfig):
    """Plane through `point_m`; the robot is on the side of `normal`."""

    type: Literal["plane"]
    point_m: Vector3 = default([0.0, 0.0, 0.0], "point on the plane, in the world")
    normal: Direction = default([0.0, 0.0, 1.0], "normal towards the robot")


def build(config: Config, context: BuildContext) -> Quadric:
    """Return the plane as a quadric with Q = 0."""
    normal = unit_vector(config.normal, "normal")
    return Quadric(np.zeros((3, 3)), normal, -float(normal @ config.point_m), middle=np.array(config.point_m))
