"""A position servo from its data sheet: voltage loop, limits of voltage, current and torque, friction of the gear."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.model.drives import Servo, ServoParameters


class Config(ServoParameters):
    """Everything at the output shaft: K_m = U / ω_0 and R = U K_m / τ_stall at ``voltage_V``, which limits the voltage.

    The gains are the servo's own; those of the controller are for DC motors.
    """

    type: Literal["servo"]


def build(config: Config, context: BuildContext) -> Servo:
    """The servo on ``context.joint``."""
    return config.servo(context.joint)
