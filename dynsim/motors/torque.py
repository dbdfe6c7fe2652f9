"""A torque that the controller gives directly: no circuit, no gear; an ideal source whose power is τ v."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from dynsim.config import Positive
from dynsim.model.drives import TorqueSource
from dynsim.model.motor_parameters import DriveParameters
from dynsim.model.protocols import BuildContext


class Config(DriveParameters):
    """The torque is the reference of the motor (``controller.torques``), within the limit."""

    type: Literal["torque"]
    limit_N_m: Positive | None = Field(default=None, description="N at a prismatic joint")

    def motor(self, joint: str) -> TorqueSource:
        """The torque on the joint of that name."""
        limit = np.inf if self.limit_N_m is None else self.limit_N_m
        return TorqueSource(joint, limit, self.mass_kg, self.mass_point)


def build(config: Config, context: BuildContext) -> TorqueSource:
    """The torque on ``context.joint``."""
    return config.motor(context.joint)
