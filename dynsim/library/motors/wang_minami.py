"""Joint motor of Wang and Minami's arm (their section IV, "actual motor's specifications"), without voltage limit."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive, default
from dynsim.model.drives import Motor, MotorParameters


class Config(MotorParameters):
    """DC motor: K = 0.203 N m/A, R = 1.1 Ω, L = 1.7 mH, I_m = 1.64e-4 kg m², k = 3, d_m = 0.01 N m s/rad."""

    type: Literal["wang_minami"]
    torque_constant_N_m_per_A: Positive = default(0.203, "torque constant K")
    resistance_ohm: Positive = default(1.1, "armature resistance R")
    inductance_H: Positive = default(0.0017, "armature inductance L")
    rotor_inertia_kg_m2: NonNegative = default(1.64e-4, "rotor inertia I_m, on the motor side")
    gear_ratio: Positive = default(3.0, "gear ratio k: motor turns per joint turn")
    gear_damping_N_m_s_per_rad: NonNegative = default(0.01, "viscous damping d_m of the gear, on the motor side")


def build(config: Config, context: BuildContext) -> Motor:
    """Return the motor of ``context.joint``."""
    return config.motor(context.joint)
