"""Box with rounded edges; its signed distance is C¹, with flat faces and rounded edges and corners."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Lengths, Positive, SurfaceConfig, Vector3, default, error_at
from dynsim.model.surfaces import Box
from dynsim.model.urdf.reader import rotation


class Config(SurfaceConfig):
    """Box centred at `center_m` and rotated by `rpy_deg`; the robot is outside."""

    type: Literal["box"]
    center_m: Vector3 = Field(description="centre in the world")
    edges_m: Lengths = Field(description="edge lengths along x, y, z of the box")
    rpy_deg: Vector3 = default([0.0, 0.0, 0.0], "rotation about x, y, z of the world, in this order")
    edge_radius_m: Positive = default(0.005, "radius of the rounded edges, within the box")

    @model_validator(mode="after")
    def _check(self) -> Self:
        most = 0.5 * min(self.edges_m)
        if self.edge_radius_m > most:
            raise error_at(
                "edge_radius_m",
                f"must not exceed half the shortest edge ({most:g} m)",
            )
        return self


def build(config: Config, context: BuildContext) -> Box:
    """Return the box."""
    axes = rotation(*np.deg2rad(config.rpy_deg).tolist()).T
    return Box(np.array(config.center_m), axes, np.array(config.edges_m), config.edge_radius_m)
