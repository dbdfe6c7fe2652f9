"""A brushed DC motor of which the scenario gives every parameter."""

from __future__ import annotations

from typing import Literal

from dynsim.model.motor_parameters import MotorParameters


class Config(MotorParameters):
    """All parameters of the motor, none assumed."""

    type: Literal["dc"]
