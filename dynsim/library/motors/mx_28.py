"""ROBOTIS Dynamixel MX-28 at 12 V, velocity mode: the driven wheels of T2 Snake-3.

Data sheet (emanual.robotis.com, MX-28AR): stall torque 2.5 N m at 12 V and 1.4 A, no-load speed 55 rpm, gear 193 : 1,
77 g. These values give K_m = U / ω_0 = 2.08 V s/rad, R = 10 Ω and a stall current of 1.2 A. Nominal torque: a fifth of
the stall torque, as for the MX-106.
"""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive, default
from dynsim.model.drives import Servo, ServoParameters


class Config(ServoParameters):
    """Servo with 2.5 N m and 55 rpm; the gain and rotor inertia are not from the data sheet."""

    type: Literal["mx_28"]
    voltage_V: Positive = default(12.0, "supply voltage of the data sheet; also limits the voltage")
    stall_torque_N_m: Positive = default(2.5, "stall torque (data sheet)")
    no_load_speed_rad_per_s: Positive = default(5.76, "no-load speed, 55 rpm (data sheet)")
    nominal_torque_N_m: Positive | None = default(0.5, "continuous torque: a fifth of the stall torque")
    mode: Literal["position", "velocity"] = default("velocity", "quantity that the servo controls")
    k_v_V_s_per_rad: NonNegative = default(20.0, "gain in velocity mode (assumed)")
    rotor_inertia_kg_m2: NonNegative = default(2e-4, "rotor inertia at the output shaft (assumed)")


def build(config: Config, context: BuildContext) -> Servo:
    """Return the servo of ``context.joint``."""
    return config.servo(context.joint)
