"""ROBOTIS Dynamixel MX-106 at 12 V in position mode with its default gain: the joint servo of T2 Snake-3.

Data sheet (emanual.robotis.com, MX-106R): stall torque 8.4 N m at 12 V and 5.2 A, no-load speed 45 rpm, gear 225 : 1,
153 g. These values give K_m = U / ω_0 = 2.55 V s/rad, R = 3.64 Ω and a stall current of 3.3 A. The current in the data
sheet is 1.58 times as large, so simulated electrical energies are too small by this factor. Nominal torque: a fifth of
the stall torque, the continuous torque estimated by ROBOTIS (robotis.us, Torque Ratings, 2020).
"""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive, default
from dynsim.model.drives import Servo, ServoParameters


class Config(ServoParameters):
    """Servo with 8.4 N m and 45 rpm; the gain, gear friction and rotor inertia are not from the data sheet."""

    type: Literal["mx_106"]
    voltage_V: Positive = default(12.0, "supply voltage of the data sheet; also limits the voltage")
    stall_torque_N_m: Positive = default(8.4, "stall torque (data sheet)")
    no_load_speed_rad_per_s: Positive = default(4.71, "no-load speed, 45 rpm (data sheet)")
    nominal_torque_N_m: Positive | None = default(1.68, "continuous torque: a fifth of the stall torque")
    k_p_V_per_rad: NonNegative = default(
        58.6, "gain in position mode: 41 N m/rad, fitted to the measured sag of T2 Snake-3"
    )
    coulomb_friction_N_m: NonNegative = default(0.8, "gear friction, fitted to the measured sag of T2 Snake-3")
    rotor_inertia_kg_m2: NonNegative = default(0.01, "rotor inertia at the output shaft (assumed)")


def build(config: Config, context: BuildContext) -> Servo:
    """Return the servo of ``context.joint``."""
    return config.servo(context.joint)
