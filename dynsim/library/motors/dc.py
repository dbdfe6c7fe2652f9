"""A brushed DC motor of which the scenario gives every parameter."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.model.drives import Motor, MotorParameters


class Config(MotorParameters):
    """All parameters of the motor, none assumed."""

    type: Literal["dc"]


def build(config: Config, context: BuildContext) -> Motor:
    """The motor on ``context.joint``."""
    return config.motor(context.joint)
