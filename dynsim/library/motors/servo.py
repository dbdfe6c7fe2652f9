"""Position servo with data-sheet values: voltage loop, voltage, current and torque limits, and gear friction."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.model.drives import Servo, ServoParameters


class Config(ServoParameters):
    """Servo with all values at the output shaft: K_m = U / ω_0 and R = U K_m / τ_stall at `voltage_V`.

    `voltage_V` is also the voltage limit. A servo uses its own gains; the gains of the controller are for DC motors.
    """

    type: Literal["servo"]


def build(config: Config, context: BuildContext) -> Servo:
    """Return the servo of ``context.joint``."""
    return config.servo(context.joint)
