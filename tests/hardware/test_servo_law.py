"""The virtual servos' torque is the position servo of the simulation with data-sheet parameters."""

from __future__ import annotations

import numpy as np
import pytest

from dynsim.hardware.bus.control_table import MX_28, MX_106
from dynsim.hardware.virtual.servo_plant import FREE_DAMPING, VELOCITY_TIME_CONSTANT, Drive, MotorLaw


@pytest.mark.parametrize("voltage", [12.0, 9.5, 0.0, -1.0])
def test_torque_is_stiffness_within_the_stall_torque_less_back_emf(voltage):
    """clip(k e, ±τ_stall V/12) − d ω; clip(J/T (ω_set − ω) + d ω, …) − d ω; off a tenth of d ω."""
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
