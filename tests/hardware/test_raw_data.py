"""Raw data of the servos in measured records, and their comparison with simulated torques and currents."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.messages import raises

from dynsim import cli
from dynsim.errors import RecordError
from dynsim.hardware.bus.control_table import MX_106, RAW_BLOCK, STATE_BLOCK
from dynsim.hardware.replay.check import plan_cycle
from dynsim.hardware.replay.compare import compare_records
from dynsim.hardware.servo_map import load_servo_map
from dynsim.hardware.virtual.servos import CURRENT_NOISE
from dynsim.hardware.virtual.simulated_plant import Drive, InertialLoad
from dynsim.record import Record

from .conftest import Rig, Run

BYTES = 11 + RAW_BLOCK[1]


def test_current_and_pwm_of_every_servo_are_recorded(clean_run: Run) -> None:
    record = clean_run.result.record
    assert record.labels["current"] == record.labels["load"] == ("shoulder", "elbow", "wheel")
    measures = np.array([servo.model.measures_current for servo in clean_run.map.servos])
    assert np.isfinite(record["current"]).any(axis=0).tolist() == measures.tolist()
    assert np.isfinite(record["load"]).any(axis=0).tolist() == (~measures).tolist()
    torque = record["torque_estimate"][:, 0]
    assert np.allclose(record["current"][:, 0] * MX_106.torque_constant, torque, atol=1e-12)
    # The voltage drives the torque and the back-EMF: u/u_rated = τ/τ_stall + ω/ω_0.
    voltage = record["pwm"] * record["supply_voltage"] / MX_106.rated_voltage
    motion = record["state"] == 5
    for column, servo in enumerate(clean_run.map.servos[:2]):
        rate = record["v"][:, column] / servo.model.no_load_speed
        expected = record["torque_estimate"][:, column] / servo.model.stall_torque + rate
        error = (voltage[:, column] - expected)[motion]
        assert np.nanstd(error) < 3 * CURRENT_NOISE
        assert np.nanmax(np.abs(expected[motion])) > 10 * CURRENT_NOISE


def test_goals_are_recorded_in_ticks(clean_run: Run) -> None:
    record, servos = clean_run.result.record, clean_run.map.servos
    motion = record["state"] == 5
    for column, servo in enumerate(servos[:2]):
        goals = [servo.to_ticks(angle) for angle in record["q_goal"][motion, column]]
        assert record["goal_register"][motion, column].tolist() == goals
    rates = [servos[2].to_velocity_units(rate) for rate in record["rho_dot_goal"][motion, 0]]
    assert record["goal_register"][motion, 2].tolist() == rates


def test_every_read_has_a_time(clean_run: Run) -> None:
    record = clean_run.result.record
    delay = record["read_time"] - record.time[:, None]
    assert (delay > 0).all()
    assert (delay <= record["exchange"][:, None] + 1e-9).all()
    # The servos answer one after another, a status of 23 bytes at 1 Mbit/s and the turnaround of 20 µs apart.
    assert np.allclose(np.diff(record["read_time"], axis=1), BYTES * 10e-6 + 20e-6, atol=2e-5)


def test_the_pwm_is_read_only_if_health_reads_stay_as_frequent() -> None:
    arm, snake = (load_servo_map(name) for name in ("arm", "snake"))
    plan = plan_cycle(arm, arm.bus.rate)
    assert (plan.state_block, plan.health_every) == (RAW_BLOCK, 1)
    plan = plan_cycle(snake, snake.bus.rate)
    assert (plan.state_block, plan.health_every) == (STATE_BLOCK, 5)
    assert plan_cycle(snake, 100.0).state_block == RAW_BLOCK


def test_the_pwm_of_a_busy_line_comes_from_the_health_reads(rig: Rig) -> None:
    motion = rig.motion()
    slow = replace(motion, plan=replace(motion.plan, state_block=STATE_BLOCK))
    record = rig.run(motion=slow).result.record
    known = np.isfinite(record["pwm"])
    assert (known.sum(axis=1) <= 1).all()
    assert known.any(axis=0).all()


def test_gear_friction_holds_a_shaft_off_its_goal() -> None:
    load = InertialLoad([MX_106], np.zeros(1))
    law, goal = load.law, 0.2
    drive = Drive(np.ones(1, bool), np.ones(1, bool), np.array([goal]), np.zeros(1), 12.0)
    for _ in range(2000):
        load.step(2e-3, drive)
    left = goal - float(load.position[0])
    assert load.velocity[0] == pytest.approx(0.0, abs=1e-9)
    assert left == pytest.approx(float(law.friction[0] / law.stiffness[0]))
    # The motor still pushes against the friction, and its current shows that.
    assert load.torque[0] == pytest.approx(law.stiffness[0] * left)
    inside = 0.9 * float(law.friction[0] / law.stiffness[0])
    drive.set_position[:] = load.position + inside
    before = float(load.position[0])
    for _ in range(100):
        load.step(2e-3, drive)
    assert load.position[0] == before


def test_torques_and_currents_are_compared(clean_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured = clean_run.result.record
    time = np.arange(0.0, measured.time[-1], 0.005)
    simulated = Record(time)
    motion = measured["state"] == 5
    for name, label in (("q", "q"), ("torque", "torque_estimate"), ("current", "current")):
        columns = [np.interp(time, measured["record_time"][motion], column[motion]) for column in measured[label].T[:2]]
        labels = ("shoulder", "elbow")
        unit = {"q": "rad", "torque": "N m", "current": "A"}[name]
        offset = {"q": 0.0, "torque": 0.5, "current": 0.1}[name]
        simulated.add(name, np.column_stack(columns) - offset, unit, labels=labels)
    comparison = compare_records(simulated, measured)
    errors = {(error.joint, error.quantity): error for error in comparison.efforts}
    assert set(errors) == {(joint, name) for joint in ("shoulder", "elbow") for name in ("torque", "current")}
    assert errors["elbow", "torque"].rms == pytest.approx(0.5, abs=0.05)
    assert errors["shoulder", "current"].rms == pytest.approx(0.1, abs=0.02)
    summary = comparison.summary()
    assert summary["torques"]["elbow"]["rms_N_m"] == errors["elbow", "torque"].rms
    assert summary["currents"]["elbow"]["max_A"] == errors["elbow", "current"].max
    simulated.save(tmp_path / "record.h5")
    measured.save(tmp_path / "measured.h5")
    monkeypatch.setattr(
        sys, "argv", ["dynsim", "hw", "compare", *(str(tmp_path / n) for n in ("record.h5", "measured.h5"))]
    )
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert not leaving.value.code
    assert (tmp_path / "comparison.png").stat().st_size > 10_000


def test_a_joint_with_a_label_is_compared_by_its_label(rig: Rig) -> None:
    measured = rig.run().result.record
    measured.provenance = {**measured.provenance, "labels": {"elbow": "joint_2"}}
    simulated = Record(np.linspace(0.0, 1.0, 101))
    simulated.add("q", np.zeros((101, 2)), "rad", labels=("shoulder", "elbow"))
    simulated.add("torque", np.zeros((101, 1)), "N m", labels=("joint_2",))
    assert [(error.joint, error.quantity) for error in compare_records(simulated, measured).efforts] == [
        ("joint_2", "torque")
    ]


def test_the_torques_of_a_pair_act_together(rig: Rig) -> None:
    measured = rig.run().result.record
    measured.provenance = {**measured.provenance, "labels": {"elbow": "shoulder"}}
    simulated = Record(np.linspace(0.0, 1.0, 101))
    simulated.add("q", np.zeros((101, 2)), "rad", labels=("shoulder", "elbow"))
    simulated.add("torque", np.zeros((101, 1)), "N m", labels=("shoulder",))
    (error,) = compare_records(simulated, measured).efforts
    rows = (measured["state"] == 5) & (measured["record_time"] >= 0.0) & (measured["record_time"] <= 1.0)
    both = measured["torque_estimate"][rows, :2].sum(axis=1)
    assert error.measured_rms == pytest.approx(np.sqrt(np.nanmean(both**2)), rel=1e-9)


def test_exchanged_records_are_refused(rig: Rig) -> None:
    with raises(RecordError, "first record", "exchange"):
        compare_records(rig.run().result.record, rig.record)
