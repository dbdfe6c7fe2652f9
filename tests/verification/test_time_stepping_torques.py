"""Shaft torques under time stepping: without impulses, as by the methods with events."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.messages import lines_with

import dynsim

# Its rotor is heavy for its arm: the mean acceleration of a landing, Δv/h, gave torques of 50 N m at steps of 2 ms, and
# of 770 N m at 0.125 ms.
SERVO = {
    "type": "servo",
    "voltage_V": 12.0,
    "stall_torque_N_m": 8.0,
    "no_load_speed_rad_per_s": 5.0,
    "k_p_V_per_rad": 60.0,
    "k_d_V_s_per_rad": 0.5,
    "rotor_inertia_kg_m2": 0.02,
    "gear_damping_N_m_s_per_rad": 0.01,
    "nominal_torque_N_m": 5.0,
}


def landing_arm(folder: Path, restitution: float, rate: float, integrator: dict[str, Any]) -> dynsim.Scenario:
    """A planar arm that is driven onto a floor and up again, twice, and against a stop."""
    first = {"length_m": 0.3, "mass_kg": 0.4, "initial_deg": 60.0, "limit_deg": [0, 110]}
    second = {"length_m": 0.25, "mass_kg": 0.3, "initial_deg": 20.0, "limit_deg": [-60, 60]}
    config = {
        "name": "landing",
        "duration_s": 1.0,
        "plant": {
            "type": "serial_arm",
            "link": {"axis": "y", "radius_m": 0.02, "motor": SERVO},
            "chain": [first, second],
        },
        "controller": {
            "type": "joint_pd",
            "joints": {
                "joint_1": {"times_s": [0, 0.25, 0.5, 0.75, 1.0], "angles_deg": [60, 105, 60, 105, 60]},
                "joint_2": {"times_s": [0, 0.3, 0.6, 1.0], "angles_deg": [20, 70, -20, 70]},
            },
        },
        "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -0.05]}},
        "contacts": {
            "law": "unilateral",
            "friction": 0.3,
            "restitution": restitution,
            "points": {"tip": {"body": "link_2", "point_m": [0, 0, 0.25], "surface": "floor"}},
        },
        "integrator": integrator,
        "record": {"rate_hz": rate},
    }
    file = folder / "landing.yaml"
    file.write_text(json.dumps(config))
    return dynsim.load_scenario(str(file))


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_torques_converge_to_those_of_radau5_as_steps_become_shorter(tmp_path: Path, restitution: float) -> None:
    events = dynsim.simulate(landing_arm(tmp_path, restitution, 8000.0, {"method": "radau5", "rtol": 1e-9}))
    strikes = [event for event in events.events if event.kind in ("landing", "bounce", "stop_hit")]
    assert len(strikes) >= 2
    for step in (2e-3, 1e-3, 5e-4):
        options = {"method": "time_stepping", "step_s": step}
        steps = dynsim.simulate(landing_arm(tmp_path, restitution, 1.0 / step, options))
        for ours, theirs in zip(steps.summary["motors"], events.summary["motors"], strict=True):
            # Of first order; measured: up to 52 h.
            assert ours["torque_rms_N_m"] == pytest.approx(theirs["torque_rms_N_m"], abs=80.0 * step)
            # A landing within a step has its peak at the next one. Measured: 7 % at 2 ms.
            assert ours["torque_max_N_m"] == pytest.approx(theirs["torque_max_N_m"], rel=0.1)
        assert not lines_with(steps.summary["warnings"], phrase="overload")
