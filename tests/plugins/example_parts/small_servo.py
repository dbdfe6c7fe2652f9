"""Motor of a small servo, from its data sheet (source, page)."""

from __future__ import annotations

from typing import Literal

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive
from dynsim.model.drives import Motor, MotorParameters


class Config(MotorParameters):
    """K = 0.01 N m/A, R = 2 Ω, L = 0.2 mH, I_m = 1e-6 kg m², k = 200; 12 V."""

    type: Literal["small_servo"]
    torque_constant_N_m_per_A: Positive = 0.01
    resistance_ohm: Positive = 2.0
    inductance_H: Positive = 2e-4
    rotor_inertia_kg_m2: NonNegative = 1e-6
    gear_ratio: Positive = 200.0
    voltage_limit_V: Positive | None = 12.0


def build(config: Config, context: BuildContext) -> Motor:
    """The motor on ``context.joint``."""
    return config.motor(context.joint)
