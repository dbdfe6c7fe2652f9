"""An ellipsoid: C(r) = (|A (r − c)|² − 1)/2 with A = diag(1/a, 1/b, 1/c) in axes turned by ``yaw_deg`` about z."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, StrictConfig, Vector3
from dynsim.model.description import Quadric


class Config(StrictConfig):
    """Ellipsoid about ``center_m`` with the half axes ``half_axes_m``; the free side is outside."""

    type: Literal["ellipsoid"]
    center_m: Vector3
    half_axes_m: Annotated[list[Positive], Field(min_length=3, max_length=3)]
    yaw_deg: float = 0.0


def build(config: Config, context: BuildContext) -> Quadric:
    """The ellipsoid as a quadric, scaled by its smallest half axis to keep C near metres."""
    yaw, scale = np.deg2rad(config.yaw_deg), min(config.half_axes_m)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    Q = scale * turn @ np.diag(1.0 / np.square(config.half_axes_m)) @ turn.T
    center = np.array(config.center_m)
    return Quadric(Q, -Q @ center, 0.5 * float(center @ Q @ center) - 0.5 * scale)
