"""ROBOTIS Dynamixel MX-106 at 12 V, position mode at its default gain: the joints of T2 Snake-3.

Data sheet (emanual.robotis.com, MX-106R): stall torque 8.4 N m at 12 V and 5.2 A, no-load speed 45 rpm, gear 225 : 1,
153 g. With these K_m = U / ω_0 = 2.55 V s/rad and R = 3.64 Ω, so that this motor stalls at 3.3 A: the current of the
data sheet is 1.58 times as much, and electrical energies come out too small by as much. Nominal torque: a fifth of the
stall torque, as ROBOTIS estimates the continuous torque (robotis.us, Torque Ratings, 2020).
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive
from dynsim.model.drives import Servo, ServoParameters


class Config(ServoParameters):
    """8.4 N m, 45 rpm; 41 N m/rad; gear friction 0.8 N m; the last three numbers are not in the data sheet."""

    type: Literal["mx_106"]
    voltage_V: Positive = 12.0
    stall_torque_N_m: Positive = 8.4
    no_load_speed_rad_per_s: Positive = 4.71
    nominal_torque_N_m: Positive | None = 1.68
    k_p_V_per_rad: NonNegative = Field(
        default=58.6, description="41 N m/rad, with which the sag of T2 Snake-3 comes out as measured"
    )
    coulomb_friction_N_m: NonNegative = Field(default=0.8, description="of the gear, likewise")
    rotor_inertia_kg_m2: NonNegative = Field(default=0.01, description="at the output shaft (assumed)")


def build(config: Config, context: BuildContext) -> Servo:
    """The servo on ``context.joint``."""
    return config.servo(context.joint)
