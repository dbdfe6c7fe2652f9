"""An ideal torque source commanded by the controller: no circuit, no gear; its power is τ v."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive
from dynsim.model.drives import DriveParameters, TorqueSource, limit


class Config(DriveParameters):
    """The torque is the reference of the motor (``controller.torques``), within the limit."""

    type: Literal["torque"]
    limit_N_m: Positive | None = Field(default=None, description="N at a prismatic joint")


def build(config: Config, context: BuildContext) -> TorqueSource:
    """The torque on ``context.joint``."""
    torque_limit, nominal = limit(config.limit_N_m), config.nominal_torque
    return TorqueSource(context.joint, torque_limit, config.mass_kg, config.mass_point, nominal)
