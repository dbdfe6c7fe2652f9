"""The joint motors of Wang and Minami's arm (their section IV, "actual motor's specifications"); no voltage limit."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive
from dynsim.model.drives import Motor, MotorParameters


class Config(MotorParameters):
    """K = 0.203 N m/A, R = 1.1 Ω, L = 1.7 mH, I_m = 1.64e-4 kg m², k = 3, d_m = 0.01 N m s/rad."""

    type: Literal["wang_minami"]
    torque_constant_N_m_per_A: Positive = 0.203
    resistance_ohm: Positive = 1.1
    inductance_H: Positive = 0.0017
    rotor_inertia_kg_m2: NonNegative = 1.64e-4
    gear_ratio: Positive = 3.0
    gear_damping_N_m_s_per_rad: NonNegative = 0.01


def build(config: Config, context: BuildContext) -> Motor:
    """The motor on ``context.joint``."""
    return config.motor(context.joint)
