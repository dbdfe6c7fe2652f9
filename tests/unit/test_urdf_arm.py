"""An arm from a URDF file in a scenario: units of its two kinds of joints, and its limits."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynsim.engine import simulate
from dynsim.errors import ModelError
from dynsim.record import Record
from dynsim.scenario import build_model, load_scenario

# A car of 1 kg on a rail along x, and an arm of 1 kg hinged to it at its centre of mass: neither disturbs the other.
SLIDE = """<robot name="r"><link name="base"/>
<link name="car"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="car"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="20" velocity="0.5"/></joint>
<joint name="hinge" type="continuous"><parent link="car"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""
SCENARIO = """duration_s: 0.5
plant: {type: urdf_arm, file: slide.urdf, gravity_m_s2: [9.81, 0, 0]}
integrator: {rtol: 1.0e-10, atol: 1.0e-12}
record: {rate_hz: 1000}
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    (tmp_path / "slide.urdf").write_text(SLIDE)
    (tmp_path / "case.yaml").write_text(SCENARIO)
    return tmp_path / "case.yaml"


def run(scenario: Path, overrides: dict[str, Any]) -> Record:
    return simulate(load_scenario(scenario, overrides=overrides))


def test_joints_start_and_lose_in_the_units_of_their_kind(scenario: Path):
    plant = {
        "initial_deg": {"hinge": 90},
        "initial_m": {"slide": 0.2},
        "damping_N_m_s_per_rad": 0.5,
        "damping_N_s_per_m": 3,
    }
    overrides = {f"plant.{key}": value for key, value in plant.items()}
    robot = build_model(load_scenario(scenario, overrides=overrides)).robot
    assert robot.initial == pytest.approx([0.2, np.pi / 2])
    assert [link.damping for link in robot.links] == [3.0, 0.5]
    for key, joint in (("initial_deg", "slide"), ("initial_m", "hinge")):
        with pytest.raises(ModelError, match=rf"plant.{key}: '{joint}' is"):
            build_model(load_scenario(scenario, overrides={f"plant.{key}.{joint}": 1}))


def test_signals_are_in_the_units_of_both_kinds(scenario: Path):
    units = run(scenario, {"plant.motors": {"slide": {"type": "wang_minami"}}}).units
    assert [units[name] for name in ("q", "v", "vdot")] == ["rad or m", "rad/s or m/s", "rad/s² or m/s²"]
    assert units["torque"] == "N"


def test_passed_limits_are_warned_of_with_joint_time_and_amount(scenario: Path):
    warnings = run(scenario, {}).summary["warnings"]
    # Falling along the rail: x = g t²/2 is 1 m at 0.4515 s and 1.226 m at 0.5 s; v = g t is 0.5 m/s at 0.05097 s and
    # 4.905 m/s at the end. The first sample after it counts.
    assert [warning.split(";")[0] for warning in warnings] == [
        "slide: passes its upper position limit of 1 m by up to 0.226 m, first at t = 0.452 s",
        "slide: passes its velocity limit of 0.5 m/s by up to 4.41 m/s, first at t = 0.051 s",
    ]


def test_passed_effort_is_warned_of(scenario: Path):
    # Held against gravity, the motor swings in to 2 kg · 11 m/s² = 22 N; the limit is 20 N.
    overrides = {
        "plant.gravity_m_s2": [11.0, 0, 0],
        "plant.motors": {"slide": {"type": "wang_minami"}},
        "controller": {"type": "joint_pd", "k_p_V_per_rad": 5000, "k_d_V_s_per_rad": 500},
    }
    record = run(scenario, overrides)
    passed = next(warning for warning in record.summary["warnings"] if "effort" in warning)
    amount = np.abs(record["torque"][:, 0]).max() - 20.0
    assert 1.5 < amount < 4.0
    assert passed.startswith(f"slide: passes its effort limit of 20 N by up to {amount:.3g} N, first at t = 0.")


def test_within_limits_and_at_a_rounded_limit_nothing_is_said(scenario: Path):
    rest = {"plant.gravity_m_s2": [0.0, 0, 0]}
    assert run(scenario, rest).summary["warnings"] == []
    text = SLIDE.replace('upper="1"', 'upper="0.1999999"')
    (scenario.parent / "slide.urdf").write_text(text)
    assert run(scenario, {**rest, "plant.initial_m": {"slide": 0.2}}).summary["warnings"] == []


def test_zero_velocity_and_effort_mean_no_limit(scenario: Path):
    (scenario.parent / "slide.urdf").write_text(SLIDE.replace('effort="20" velocity="0.5"', 'effort="0" velocity="0"'))
    link = build_model(load_scenario(scenario)).robot.links[0]
    assert (link.velocity_limit, link.effort_limit) == (np.inf, np.inf)
