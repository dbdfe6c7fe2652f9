"""Torque of virtual servos (``MotorLaw``) against its formula in position mode, velocity mode and off."""

from __future__ import annotations

import numpy as np
import pytest

from dynsim.hardware.bus.control_table import MX_28, MX_106
from dynsim.hardware.virtual.simulated_plant import FREE_DAMPING, VELOCITY_TIME_CONSTANT, Drive, MotorLaw


@pytest.mark.parametrize("voltage", [12.0, 9.5, 0.0, -1.0])
def test_torque_is_stiffness_within_the_stall_torque_less_back_emf(voltage):
    """Position τ = clip(k e, ±τ_max) − d ω; velocity τ = clip(J/T (ω_set − ω) + d ω, ±τ_max) − d ω; off τ = −0.1 d ω.

    τ torque [N m], e angle to the set position [rad], ω speed, ω_set its set value [rad/s]; k stiffness [N m/rad],
    d damping by back-EMF [N m s/rad], J inertia d²/(4k) [kg m²], T = VELOCITY_TIME_CONSTANT [s]; τ_max = τ_stall V/12
    with the stall torque τ_stall at 12 V [N m] and the supply V [V], zero where V < 0.
    """
    rng = np.random.default_rng(7)
    law = MotorLaw([MX_106, MX_28, MX_106])
    available = law.stall_torque * max(voltage, 0.0) / 12.0
    for _ in range(200):
        q, v, q_set, v_set = rng.normal(size=(4, 3)) * [[0.3], [3.0], [0.3], [3.0]]
        enabled, in_position_mode = rng.random((2, 3)) < 0.7
        wanted = np.where(
            in_position_mode,
            law.stiffness * (q_set - q),
            law.inertia / VELOCITY_TIME_CONSTANT * (v_set - v) + law.damping * v,
        )
        driven = np.clip(wanted, -available, available) - law.damping * v
        expected = np.where(enabled, driven, -FREE_DAMPING * law.damping * v)
        torque = law.torque(q, v, Drive(enabled, in_position_mode, q_set, v_set, voltage))
        np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12)
