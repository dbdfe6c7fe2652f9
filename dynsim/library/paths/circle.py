"""Circular hand path in an arbitrary plane."""

from __future__ import annotations

from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.control import HandPath, HandPathConfig
from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, Vector3, default, unit_vector
from dynsim.model.description import Array


class Config(HandPathConfig):
    """Circle about `center_m`, counter-clockwise about `normal`; `start` points from the centre to the first point."""

    type: Literal["circle"]
    center_m: Vector3 = Field(description="centre")
    radius_m: Positive = Field(description="radius")
    normal: Vector3 = default([0.0, 0.0, 1.0], "normal of the plane")
    start: Vector3 = default([1.0, 0.0, 0.0], "direction from the centre to the first point, projected onto the plane")
    period_s: Positive = default(10.0, "duration of one turn")
    clockwise: bool = default(False, "clockwise about the normal")

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._directions()
        return self

    def _directions(self) -> tuple[Array, Array]:
        normal = unit_vector(self.normal, "normal")
        start = np.array(self.start)
        first = unit_vector(list(start - normal * float(normal @ start)), "start, projected onto the plane,")
        return first, np.cross(normal, first)

    def position(self, t: Array) -> Array:
        """Return c + R (e₁ cos ωt ± e₂ sin ωt) at times t [s], shape (T, 3) [m]."""
        first, second = self._directions()
        angle = 2.0 * np.pi / self.period_s * np.asarray(t) * (-1.0 if self.clockwise else 1.0)
        return np.array(self.center_m) + self.radius_m * (
            np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
        )


def starting_at(config: Config, point: list[float]) -> dict[str, Any]:
    """Return the keys of the circle, shifted so that it starts at a point [m]."""
    shift = np.array(point) - config.position(np.zeros(1))[0]
    return {"center_m": (np.array(config.center_m) + shift).tolist()}


def build(config: Config, context: BuildContext) -> HandPath:
    """Return the configuration itself, which implements the `HandPath` interface."""
    return config
