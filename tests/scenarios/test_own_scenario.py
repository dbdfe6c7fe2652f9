"""The ``scenario.yaml`` that a run writes is a scenario: it passes the checks and gives the same run, bit for bit.

For every kind of motor, controller and plant; and the same motion can be written with and without a brace.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.engine import check
from dynsim.engine.prepare import prepare
from dynsim.errors import ModelError
from dynsim.scenario.reading import scenario_from_resolved, to_yaml
from dynsim.teleop.snake import begin

MOTORS: dict[str, dict[str, Any]] = {
    "dc": {
        "type": "dc",
        "torque_constant_N_m_per_A": 0.1,
        "resistance_ohm": 1.0,
        "inductance_H": 1e-3,
        "rotor_inertia_kg_m2": 1e-5,
        "gear_ratio": 10,
    },
    "wang_minami": {"type": "wang_minami"},
    "mx_28": {"type": "mx_28", "mode": "position", "k_p_V_per_rad": 40.0},
    "mx_106": {"type": "mx_106"},
    "servo": {
        "type": "servo",
        "voltage_V": 12,
        "stall_torque_N_m": 4.1,
        "no_load_speed_rad_per_s": 4.8,
        "k_p_V_per_rad": 40,
    },
    "torque": {"type": "torque", "limit_N_m": 5},
}
CONTROLLERS: dict[str, dict[str, Any]] = {
    "hold": {},
    "waypoints": {"joints": {"joint_1": {"times_s": [0.0, 0.02], "angles_deg": [60.0, 61.0]}}},
    "sampled": {"sample_time_s": 5e-5},
    "operator": {"sample_time_s": 5e-5, "operator": {"joints": ["joint_1", "joint_2"], "rate_hz": 100}},
    "torques": {"torques": {"joint_1": {"times_s": [0.0, 0.02], "torques_N_m": [0.1, 0.2]}}},
}


def scenario(motor: str, controller: str, plant: str) -> dict[str, Any]:
    """An arm of two joints, alone or on a mobile base."""
    link = {"mass_kg": 0.1, "length_m": 0.1, "motor": MOTORS[motor], "initial_deg": 60}
    arm: dict[str, Any] = {"type": "serial_arm", "chain": [{"axis": "y", **link}, {"axis": "y", **link}]}
    return {
        "name": "arm",
        "duration_s": 0.02,
        "plant": arm if plant == "fixed" else {"type": "pws_arm", "arm": arm},
        "controller": {"type": "joint_pd", **CONTROLLERS[controller]},
    }


@pytest.mark.parametrize("plant", ["fixed", pytest.param("mobile", marks=pytest.mark.long)])
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("motor", MOTORS)
def test_what_a_run_writes_is_accepted_and_gives_the_same_run(
    tmp_path: Path, motor: str, controller: str, plant: str
) -> None:
    data = scenario(motor, controller, plant)
    if (motor == "torque") != (controller == "torques") and controller in ("waypoints", "operator", "torques"):
        with pytest.raises(ModelError):  # a torque source follows no reference, and other motors no torques
            check(scenario_from_resolved(data))
        return
    written = scenario_from_resolved(data)
    path = tmp_path / "scenario.yaml"
    path.write_text(to_yaml(written.resolved), encoding="utf-8")
    again = dynsim.load_scenario(path)
    # Some of the sampled loops are unstable, which both are told.
    assert check(again).warnings == check(written).warnings
    first, second = dynsim.simulate(written), dynsim.simulate(again)
    for name in ("q", "v", "current", "voltage"):
        np.testing.assert_array_equal(first[name], second[name])
    if motor != "torque":
        session = begin(again, longest=1.0)
        assert session is not None


BRACED: dict[str, Any] = {
    "name": "braced",
    "duration_s": 0.2,
    "plant": {
        "type": "serial_arm",
        "link": {"length_m": 0.3, "mass_kg": 0.2, "motor": {"type": "wang_minami"}},
        "chain": [
            {"axis": "y", "initial_deg": 70},
            {"axis": "y", "initial_deg": 50},
            {"axis": "y", "initial_deg": -70},
            {"axis": "y", "initial_deg": -10},
            {"axis": "y", "initial_deg": 20},
        ],
    },
    "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -0.05]}},
    "contacts": {"law": "unilateral", "friction": 0.2, "points": {"elbow": {"body": "link_3"}}},
    "initial": {"on_surface": ["elbow"]},
    "controller": {
        "type": "joint_pd",
        "hand": {
            "joints": ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5"],
            "braces": ["elbow"],
            "path": {"type": "line", "duration_s": 0.2},
        },
    },
}


def on_path(enabled: bool, **controller: Any) -> dynsim.Scenario:
    """The braced arm whose hand goes up by 10 mm from where it starts."""
    data = copy.deepcopy(BRACED)
    data["controller"] |= controller
    data["contacts"]["points"]["elbow"]["enabled"] = enabled
    path = data["controller"]["hand"].pop("path")
    model = dynsim.build_model(scenario_from_resolved({**data, "controller": None}))
    hand = model.point_position(*model.robot.hand, model.robot.initial)
    up = hand + np.array([0.0, 0.0, 0.01])
    data["controller"]["hand"]["path"] = {**path, "from_m": hand.tolist(), "to_m": up.tolist()}
    return scenario_from_resolved(data)


def test_the_same_motion_can_be_commanded_with_and_without_the_brace() -> None:
    braced, free = on_path(True), on_path(False)
    splines = [prepare(case).control.reference for case in (braced, free)]
    np.testing.assert_array_equal(splines[0].coefficients, splines[1].coefficients)
    records = [dynsim.simulate(case) for case in (braced, free)]
    assert [contact["name"] for contact in records[0].summary["contacts"]] == ["elbow"]
    assert records[1].summary["contacts"] == []
    assert records[1].summary["electrical_energy_J"] > records[0].summary["electrical_energy_J"]


def test_a_disabled_point_cannot_press() -> None:
    with raises(ModelError, "'elbow'"):
        check(on_path(False, brace={"elbow": 2.0}))
