"""Coupled joints: a gripper whose second finger mimics the first, a chain of couplings, and impossible couplings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import raises
from support.random_robots import assemble, random_robot

from dynsim.compile.model import Model
from dynsim.dynamics.state import CONSTRAINT
from dynsim.engine import simulate
from dynsim.errors import ModelError
from dynsim.model.description import Coupling
from dynsim.model.urdf.reader import read_urdf
from dynsim.scenario import build_model, load_scenario

BODY = '<inertial><mass value="{}"/><origin xyz="0 0 0.1"/>' + (
    '<inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>'
)
GRIPPER = f"""<robot name="gripper">
<link name="base"/><link name="wrist">{BODY.format(1.0)}</link>
<link name="left">{BODY.format(0.2)}</link><link name="right">{BODY.format(0.3)}</link>
<joint name="turn" type="continuous"><parent link="base"/><child link="wrist"/><axis xyz="0 1 0"/>
<dynamics damping="0.01"/></joint>
<joint name="left_finger" type="prismatic"><parent link="wrist"/><child link="left"/><axis xyz="1 0 0"/>
<limit lower="-0.5" upper="0.5" effort="10" velocity="10"/><dynamics damping="0.1"/></joint>
<joint name="right_finger" type="prismatic"><parent link="wrist"/><child link="right"/><axis xyz="-1 0 0"/>
<limit lower="-1" upper="1" effort="10" velocity="10"/>
<mimic joint="left_finger" multiplier="1.5" offset="0.01"/></joint>
</robot>
"""


@pytest.fixture
def gripper(tmp_path: Path) -> Path:
    (tmp_path / "gripper.urdf").write_text(GRIPPER)
    motor = {
        "type": "dc",
        "torque_constant_N_m_per_A": 0.5,
        "resistance_ohm": 1.0,
        "inductance_H": 0.001,
        "rotor_inertia_kg_m2": 1e-4,
        "gear_ratio": 5,
        "gear_damping_N_m_s_per_rad": 1e-4,
    }
    scenario: dict[str, Any] = {
        "duration_s": 1.0,
        "plant": {"type": "urdf_arm", "file": "gripper.urdf", "motor": motor, "initial_deg": {"turn": 70}},
        "controller": {"type": "joint_pd", "k_p_V_per_rad": 20, "k_d_V_s_per_rad": 1},
    }
    path = tmp_path / "gripper.yaml"
    path.write_text(json.dumps(scenario))
    return path


# A program of its own to compile; its right-hand sides are compared in tests/oracle.
M_STAR = pytest.param({"method": "dopri5", "solver": "m_star"}, marks=pytest.mark.long)


@pytest.mark.parametrize("integrator", [{"method": "dopri5"}, {"method": "radau5"}, M_STAR])
def test_a_finger_that_mimics_the_other(gripper: Path, integrator: dict[str, str]):
    """It starts and stays where it is led, carries no motor, and takes no energy."""
    overrides = {f"integrator.{key}": value for key, value in integrator.items()}
    record = simulate(load_scenario(gripper, overrides=overrides))
    left, right = record["q"][:, 1], record["q"][:, 2]
    assert record["current"].shape[1] == 2
    assert right[0] == 0.01
    assert np.ptp(left) > 1e-4
    assert np.abs(right - 1.5 * left - 0.01).max() <= 1e-10
    assert np.abs(record["v"][:, 2] - 1.5 * record["v"][:, 1]).max() <= 1e-7
    np.testing.assert_allclose(record["vdot"][:, 2], 1.5 * record["vdot"][:, 1], rtol=0, atol=1e-9)
    assert abs(record.summary["energy_residual_relative"]) < 1e-6
    assert np.abs(record["work_constraint"]).max() < 1e-9


def test_a_coupling_may_close_over_an_undriven_joint(gripper: Path):
    """No motors at all: the two fingers fall as one mass, m_1 + r² m_2 along the slope of 30°."""
    record = simulate(load_scenario(gripper, overrides={"plant.lock_deg": {"turn": 30}, "plant.motor": None,
        "plant.initial_deg": {}, "controller": None, "duration_s": 0.05, "plant.damping_N_s_per_m": 0.0}))  # fmt: skip
    mass = 0.2 + 1.5**2 * 0.3
    # x of the turned wrist points down by sin 30°; the right finger's axis the other way.
    acceleration = 9.81 * 0.5 * (0.2 - 1.5 * 0.3) / mass
    np.testing.assert_allclose(record["vdot"][:, 0], acceleration, rtol=1e-9)


def test_a_locked_leader_locks_its_follower(gripper: Path):
    robot = read_urdf(gripper.parent / "gripper.urdf", {"left_finger": 0.1})
    assert robot.joint_names == ("turn",)
    assert not robot.couplings
    model = Model(robot)
    assert model.point_position("right", [0, 0, 0], [0.0])[0] == pytest.approx(-0.16, abs=1e-15)


def test_a_motor_that_is_named_is_there(gripper: Path):
    model = build_model(load_scenario(gripper))
    assert [motor.joint for motor in model.robot.motors] == ["turn", "left_finger"]
    motor = {**json.loads(gripper.read_text())["plant"]["motor"], "gear_ratio": 2}
    model = build_model(load_scenario(gripper, overrides={"plant.motors": {"right_finger": motor}}))
    assert [motor.joint for motor in model.robot.motors] == ["turn", "left_finger", "right_finger"]


def test_written_and_read_again_it_is_the_same(gripper: Path):
    robot = read_urdf(gripper.parent / "gripper.urdf")
    (gripper.parent / "again.urdf").write_text(Model(robot).to_urdf())
    assert read_urdf(gripper.parent / "again.urdf").couplings == robot.couplings


def test_an_initial_position_that_breaks_the_coupling_is_refused(gripper: Path):
    with raises(ModelError, "right_finger", "0.2", "left_finger", "0.1", "0.16"):
        build_model(load_scenario(gripper, overrides={"plant.initial_m": {"left_finger": 0.1, "right_finger": 0.2}}))
    exact = {"plant.initial_m": {"left_finger": 0.1, "right_finger": 0.16}}
    np.testing.assert_allclose(build_model(load_scenario(gripper, overrides=exact)).robot.initial[1:], [0.1, 0.16])


@pytest.mark.parametrize(
    ("couplings", "names"),
    [
        ([Coupling("joint_9", "joint_0")], ["joint_9", "joint_0, joint_1, joint_2"]),
        ([Coupling("joint_1", "elbow")], ["joint_1", "'elbow'", "joint_0, joint_1, joint_2"]),
        ([Coupling("joint_1", "joint_0"), Coupling("joint_1", "joint_2")], ["joint_1", "'joint_0'"]),
        ([Coupling("joint_1", "joint_1")], ["joint_1 → joint_1"]),
        ([Coupling("joint_1", "joint_2"), Coupling("joint_2", "joint_1")], ["joint_1 → joint_2 → joint_1"]),
        ([Coupling("joint_1", "joint_0", np.nan)], ["joint_1", "ratio nan"]),
    ],
)
def test_couplings_that_cannot_be_are_refused(couplings: list[Coupling], names: list[str]):
    robot = random_robot(np.random.default_rng(0), 3)
    with raises(ModelError, *names):
        Model(replace(robot, couplings=tuple(couplings)))


@pytest.mark.parametrize(
    ("mimic", "names"),
    [
        ('joint="thumb"', ["gripper.urdf:8", "'right_finger'", "'thumb'"]),
        ('joint="right_finger"', ["gripper.urdf:8", "'right_finger'"]),
    ],
)
def test_mimic_joints_without_a_leader_are_refused(gripper: Path, mimic: str, names: list[str]):
    path = gripper.parent / "gripper.urdf"
    path.write_text(GRIPPER.replace('joint="left_finger"', mimic))
    with raises(ModelError, *names):
        read_urdf(path)


def test_a_chain_of_couplings_holds_in_a_run():
    """joint_3 follows joint_1, which follows joint_0; joints on one path to the world and on others."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        robot = replace(
            random_robot(rng, 6, motors=False),
            couplings=(Coupling("joint_3", "joint_1", -0.7, 0.2), Coupling("joint_1", "joint_0", 1.3, -0.1)),
        )
        b = assemble(robot)
        run = b.simulate(b.state(robot.initial, np.zeros(6)), np.linspace(0.0, 0.5, 6), rtol=1e-8)
        q = run.states("q")
        assert np.ptp(q[:, 0]) > 1e-3
        assert np.abs(q[:, 1] - 1.3 * q[:, 0] + 0.1).max() <= 1e-9
        assert np.abs(q[:, 3] + 0.7 * q[:, 1] - 0.2).max() <= 1e-9
        assert np.abs(run.states("ledger")[:, CONSTRAINT]).max() < 1e-8


def test_a_follower_starts_where_the_first_reference_of_its_leader_has_it(gripper: Path):
    path = {"times_s": [0, 1], "positions_m": [0.02, 0.04]}
    changes = {"initial": {"on_references": True}, "controller.joints": {"left_finger": path}}
    robot = build_model(load_scenario(gripper, overrides=changes)).robot
    np.testing.assert_allclose(robot.initial, [np.radians(70), 0.02, 1.5 * 0.02 + 0.01], rtol=0, atol=1e-15)


FINGERS = f"""<robot name="fingers">
<link name="base"/><link name="left">{BODY.format(0.2)}</link><link name="right">{BODY.format(0.3)}</link>
<joint name="left_finger" type="prismatic"><parent link="base"/><child link="left"/><axis xyz="1 0 0"/>
<limit lower="-0.5" upper="0.5" effort="10" velocity="10"/></joint>
<joint name="right_finger" type="prismatic"><parent link="base"/><child link="right"/><axis xyz="-1 0 0"/>
<limit lower="-1" upper="1" effort="10" velocity="10"/><mimic joint="left_finger" multiplier="1.5"/></joint>
</robot>
"""
RUBBING = """\
duration_s: 1.0
plant: {type: urdf_arm, file: fingers.urdf, friction_N: 2.0}
contacts: {law: unilateral}
loads:
  push: {type: samples, body: left, times_s: [0, 1], force_N: [[0, 0, 0], [6, 0, 0]], interpolation: linear}
integrator: {method: METHOD}
"""


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_coupled_joints_that_rub_slip_when_both_are_at_their_bounds(tmp_path: Path, method: str):
    """A rising push on a finger that another mimics at 1.5 times its rate: it slips at (1 + 1.5) times the friction."""
    (tmp_path / "fingers.urdf").write_text(FINGERS)
    path = tmp_path / "fingers.yaml"
    path.write_text(RUBBING.replace("METHOD", method))
    record = simulate(load_scenario(path))
    slips = {event.name: event.time for event in record.events if event.kind == "slip_start"}
    # The choice of modes is asked with friction less by 1e-5.
    assert slips == pytest.approx({"left_finger": 5.0 / 6.0, "right_finger": 5.0 / 6.0}, rel=2e-5)
    friction = record["joint_friction"]
    assert np.abs(friction).max() <= 2.0 + 1e-6
    # Coupling and friction hold what pushes, at every time, each within its bound.
    resting = record.time < 0.83
    balance = 6.0 * record.time + friction[:, 0] + 1.5 * friction[:, 1]
    np.testing.assert_allclose(balance[resting], 0.0, rtol=0, atol=1e-9)
    # (0.2 + 1.5² 0.3) kg are pushed by 6 t − 5 N.
    t = record.time[-1] - 5.0 / 6.0
    assert record["v"][-1, 0] == pytest.approx(3.0 * t * t / 0.875, rel=1e-3)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_joint_that_another_moves_slowly_is_not_held_at_rest(tmp_path: Path, method: str):
    """A finger at 1e-5 times the rate of its leader, with dry friction, as a third one hits its stop: both go on."""
    thumb = (
        f'<link name="thumb">{BODY.format(0.2)}</link><joint name="up" type="prismatic"><parent link="base"/>'
        '<child link="thumb"/><axis xyz="0 1 0"/><limit lower="-1" upper="0.01" effort="10" velocity="10"/></joint>'
    )
    (tmp_path / "fingers.urdf").write_text(FINGERS.replace("1.5", "1e-5").replace("</robot>", f"{thumb}</robot>"))
    push = "{type: constant, body: BODY, force_N: FORCE}"
    loads = f"loads:\n  push: {push}\n".replace("BODY", "left").replace("FORCE", "[6, 0, 0]")
    loads += f"  lift: {push}\n".replace("BODY", "thumb").replace("FORCE", "[0, 6, 0]")
    lines = [
        line for line in RUBBING.replace("METHOD", method).splitlines() if "push" not in line and "loads" not in line
    ]
    path = tmp_path / "fingers.yaml"
    path.write_text("\n".join(lines).replace("1.0", "0.1") + "\n" + loads)
    record = simulate(load_scenario(path))
    assert any(event.kind == "stop_hit" for event in record.events)
    # (6 − 2 (1 + 1e-5)) N push (0.2 + 0.3e-10) kg.
    assert record["v"][-1, 0] == pytest.approx(0.1 * 3.99998 / 0.2, rel=1e-6)
    assert abs(record.summary["energy_residual_relative"]) < 1e-6
