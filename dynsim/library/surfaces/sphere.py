"""Sphere: C(r) = (|r − c|² − R²)/(2R)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, SurfaceConfig, Vector3, default
from dynsim.model.description import Quadric


class Config(SurfaceConfig):
    """Sphere about `center_m`; with `inside: true` the robot is in a bowl."""

    type: Literal["sphere"]
    center_m: Vector3 = Field(description="centre in the world")
    radius_m: Positive = Field(description="radius")
    inside: bool = default(False, "whether the robot is inside")


def build(config: Config, context: BuildContext) -> Quadric:
    """Return the sphere as a quadric with |∇C| = 1 on the surface."""
    sign = -1.0 if config.inside else 1.0
    center, radius = np.array(config.center_m), config.radius_m
    scale = sign / radius
    return Quadric(scale * np.eye(3), -scale * center, 0.5 * scale * float(center @ center - radius**2))
