"""A box with rounded edges: its signed distance is C¹, flat on the faces, round over edges and corners."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.config import Positive, StrictConfig, Vector3, error_at
from dynsim.model.protocols import BuildContext
from dynsim.model.surfaces import Box


class Config(StrictConfig):
    """Box about ``center_m``, turned by ``rpy_deg``; the free side is outside."""

    type: Literal["box"]
    center_m: Vector3
    edges_m: Annotated[list[Positive], Field(min_length=3, max_length=3)]
    rpy_deg: Vector3 = Field(default=[0.0, 0.0, 0.0], description="about x, y, z of the world, in this order")
    edge_radius_m: Positive = Field(default=0.005, description="of the rounded edges, within the box")

    @model_validator(mode="after")
    def _check(self) -> Self:
        most = 0.5 * min(self.edges_m)
        if self.edge_radius_m > most:
            raise error_at(
                "edge_radius_m",
                f"{self.edge_radius_m:g} m; it must not be more than half the shortest edge, {most:g} m",
            )
        return self


def build(config: Config, context: BuildContext) -> Box:
    """The box with the edges of its core and its rounding."""
    roll, pitch, yaw = np.deg2rad(config.rpy_deg)
    R = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    return Box(np.array(config.center_m), R.T, np.array(config.edges_m), config.edge_radius_m)


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation about x, y or z."""
    R = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    R[a, a] = R[b, b] = np.cos(angle)
    R[a, b], R[b, a] = -np.sin(angle), np.sin(angle)
    return R
