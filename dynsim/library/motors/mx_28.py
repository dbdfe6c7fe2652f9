"""ROBOTIS Dynamixel MX-28 at 12 V, velocity mode: the driven wheels of T2 Snake-3.

Data sheet (emanual.robotis.com, MX-28AR): stall torque 2.5 N m at 12 V and 1.4 A, no-load speed 55 rpm, gear 193 : 1,
77 g. With these K_m = U / ω_0 = 2.08 V s/rad and R = 10 Ω, so that this motor stalls at 1.2 A. Nominal
torque: a fifth of the stall torque, as of the MX-106.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive
from dynsim.model.drives import Servo, ServoParameters


class Config(ServoParameters):
    """2.5 N m, 55 rpm; gain and rotor inertia are not in the data sheet."""

    type: Literal["mx_28"]
    voltage_V: Positive = 12.0
    stall_torque_N_m: Positive = 2.5
    no_load_speed_rad_per_s: Positive = 5.76
    nominal_torque_N_m: Positive | None = 0.5
    mode: Literal["position", "velocity"] = "velocity"
    k_v_V_s_per_rad: NonNegative = Field(default=20.0, description="velocity mode (assumed)")
    rotor_inertia_kg_m2: NonNegative = Field(default=2e-4, description="at the output shaft (assumed)")


def build(config: Config, context: BuildContext) -> Servo:
    """The servo on ``context.joint``."""
    return config.servo(context.joint)
