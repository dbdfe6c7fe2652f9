"""The energy ledger of radau5 closes for stiff drives, on fixed and mobile bases, and the better the smaller rtol.

Where a stiff drive holds a joint, the last correction of Newton's method changes the power with the same sign in every
step: integrals of derivatives from before it missed 5e-5 of the energy at every tolerance.
"""

from __future__ import annotations

from typing import Any

import pytest

from dynsim import simulate
from dynsim.scenario import scenario_from_resolved

BOUND = 1e-6
"""Of the energy turned over, at the default tolerances."""

DC = {
    "type": "dc", "torque_constant_N_m_per_A": 0.03, "resistance_ohm": 0.3, "inductance_H": 8e-5,
    "rotor_inertia_kg_m2": 1.4e-5, "gear_ratio": 100.0, "gear_damping_N_m_s_per_rad": 3e-6,
}  # fmt: skip
MOTORS: dict[str, dict[str, Any]] = {
    "servo": {"type": "servo", "voltage_V": 12, "stall_torque_N_m": 10, "no_load_speed_rad_per_s": 6},
    "mx_28": {"type": "mx_28", "mode": "position"},
    "mx_106": {"type": "mx_106"},
    "dc": DC,
    "wang_minami": {"type": "wang_minami"},
}
GAINS = (20.0, 500.0, 2500.0)


def arm(motor: str, gain: float, mobile: bool, rtol: float) -> Any:
    """Three joints lifted along splines and held, the base at rest if there is one."""
    chosen = dict(MOTORS[motor])
    controller: dict[str, Any] = {
        "type": "joint_pd",
        "joints": {f"joint_{k}": {"times_s": [0.3, 1.2], "angles_deg": [0, 30 * k]} for k in (1, 2, 3)},
    }
    if motor in ("servo", "mx_28", "mx_106"):
        chosen |= {"k_p_V_per_rad": gain, "k_d_V_s_per_rad": 0.02 * gain}
    else:
        controller |= {"k_p_V_per_rad": gain, "k_d_V_s_per_rad": 0.02 * gain}
    plant: dict[str, Any] = {
        "type": "serial_arm",
        "chain": [{"axis": "y", "length_m": 0.15, "mass_kg": 0.3, "motor": chosen} for _ in range(3)],
    }
    if mobile:
        wheel = {"mass_kg": 0.25, "radius_m": 0.05, "damping_N_m_s_per_rad": 0.05, "motor": {"type": "wang_minami"}}
        base = {
            "position_m": [0, 0], "heading_deg": 0, "mass_kg": 8, "com_m": [0.05, 0, 0.08], "wheel": wheel,
            "inertia_kg_m2": [0.03, 0, 0, 0.05, 0, 0.06], "track_m": 0.3, "caster_m": [0.15, 0, 0],
            "mount": {"position_m": [0, 0, 0.12]}, "on_overturn": "warn",
        }  # fmt: skip
        plant = {"type": "pws_arm", "base": base, "arm": plant}
    return scenario_from_resolved(
        {
            "name": "stiff",
            "duration_s": 1.6,
            "plant": plant,
            "controller": controller,
            "integrator": {"method": "radau5", "rtol": rtol},
        }
    )


def residual(motor: str, gain: float, mobile: bool, rtol: float) -> float:
    return float(simulate(arm(motor, gain, mobile, rtol)).summary["energy_residual_relative"])


FEW = {("servo", 500.0, False), ("mx_106", 2500.0, False), ("dc", 2500.0, True)}


@pytest.mark.parametrize(
    ("motor", "gain", "mobile"),
    [
        pytest.param(motor, gain, mobile, marks=() if (motor, gain, mobile) in FEW else pytest.mark.long)
        for motor in MOTORS
        for gain in GAINS
        for mobile in (False, True)
    ],
)
def test_the_ledger_closes_and_follows_the_tolerance(motor: str, gain: float, mobile: bool) -> None:
    default = residual(motor, gain, mobile, 1e-6)
    assert default <= BOUND
    # Not below what rounding leaves.
    assert residual(motor, gain, mobile, 1e-8) <= max(0.1 * default, 1e-9)
