"""Brushed DC motor with all parameters from the scenario."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.model.drives import Motor, MotorParameters


class Config(MotorParameters):
    """Brushed DC motor without assumed parameter values."""

    type: Literal["dc"]


def build(config: Config, context: BuildContext) -> Motor:
    """Return the motor of ``context.joint``."""
    return config.motor(context.joint)
