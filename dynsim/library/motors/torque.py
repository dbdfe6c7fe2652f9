"""Ideal torque source that the controller commands; it has no circuit and no gear, and its power is τ v."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, default
from dynsim.model.drives import DriveParameters, TorqueSource, limit


class Config(DriveParameters):
    """Torque source that follows `controller.torques` within its limit."""

    type: Literal["torque"]
    limit_N_m: Positive | None = default(None, "torque limit; N at a prismatic joint; default: no limit")


def build(config: Config, context: BuildContext) -> TorqueSource:
    """Return the torque source of ``context.joint``."""
    torque_limit, nominal = limit(config.limit_N_m), config.nominal_torque
    return TorqueSource(context.joint, torque_limit, config.mass_kg, config.mass_point, nominal)
