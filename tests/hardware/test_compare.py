"""Simulation, replay on virtual servos and comparison in one chain; and the exports."""

from __future__ import annotations

import csv
import json
import re
import sys
import time

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.messages import check_message, mentions, raises

from dynsim import cli
from dynsim.draw.figures import style
from dynsim.errors import RecordError
from dynsim.hardware.bus.control_table import MX_106
from dynsim.hardware.errors import ComparisonGateFailed, ServoMapError
from dynsim.hardware.replay.compare import Gate, check_gate, compare_records, draw_comparison, load_gate
from dynsim.hardware.virtual.line import ADAPTER_LATENCY
from dynsim.hardware.virtual.simulated_plant import MotorLaw
from dynsim.record import Record
from dynsim.record.joint_motion import export_record

from .conftest import swing


def test_the_following_error_is_explained_by_the_motor_law(rig, clean_run) -> None:
    """A critically damped loop at frequency ω = 4 rad/s lags by d/k·(1 + O(ω²)); goals are held one cycle, half on
    average."""
    run = clean_run
    comparison = compare_records(rig.record, run.result.record)
    law = MotorLaw([MX_106])
    lag = law.damping[0] / law.stiffness[0]
    period = 1 / run.map.bus.rate
    assert comparison.delay == pytest.approx(lag, abs=period + ADAPTER_LATENCY)
    assert comparison.worst.rms == pytest.approx(2.4 / np.sqrt(2) * lag, rel=0.25)
    # What is left without the delay: second order in ω·lag, and the transient of the run-up.
    assert max(joint.rms_delay_removed for joint in comparison.joints) < 0.35 * comparison.worst.rms


def test_half_speed_halves_the_error_in_angle_not_the_delay(rig, clean_run) -> None:
    full = compare_records(rig.record, clean_run.result.record)
    half = compare_records(rig.record, rig.run(motion=rig.motion(speed=0.5)).result.record)
    assert half.delay == pytest.approx(full.delay, abs=0.01)
    assert half.worst.rms == pytest.approx(full.worst.rms / 2, rel=0.2)


def test_joints_that_nearly_stand_tell_no_delay() -> None:
    """Two encoder steps of motion, and a joint that moves but is off by something else than delay."""
    t, random = np.linspace(0, 4, 2001), np.random.default_rng(1)
    simulated, measured = Record(t), Record(t)
    still, moved = 1.5e-3 * np.sin(t), 0.5 * np.sin(t)
    shaken = moved + 0.02 * np.sin(31.0 * t) + 1e-3 * random.normal(size=len(t))
    late = 1.5e-3 * np.sin(t - 0.129)
    simulated.add("q", np.stack([still, moved], axis=1), "rad", labels=("still", "moved"))
    measured.add("q", np.stack([late, shaken], axis=1), "rad", labels=("still", "moved"))
    comparison = compare_records(simulated, measured)
    assert all(np.isnan(joint.delay) for joint in comparison.joints)
    assert np.isnan(comparison.delay)
    assert [joint.rms_delay_removed for joint in comparison.joints] == [joint.rms for joint in comparison.joints]
    assert comparison.summary()["delay_s"] is None
    check_gate(comparison, Gate(delay_s=1e-6))


def test_where_no_delay_is_common_nothing_says_zero(tmp_path, monkeypatch, capsys) -> None:
    """A joint that lags by 50 ms, and another with a larger error of another kind."""
    t = np.linspace(0, 4, 2001)
    simulated, measured = Record(t), Record(t)
    simulated.add("q", np.stack([np.sin(t), np.sin(t)], axis=1), "rad", labels=("late", "sagging"))
    sagging = np.sin(t) + 0.2 * np.sin(7.0 * t)
    measured.add("q", np.stack([np.sin(t - 0.05), sagging], axis=1), "rad", labels=("late", "sagging"))
    ours, theirs = simulated.save(tmp_path / "record.h5"), measured.save(tmp_path / "measured.h5")
    monkeypatch.setattr(sys, "argv", ["dynsim", "hw", "compare", str(ours), str(theirs)])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert not leaving.value.code
    *table, headline, _ = capsys.readouterr().out.splitlines()
    check_message(headline)
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in table if "│" in line]
    assert [(row[0], row[4], row[5]) for row in cells] == [("late", "-", "50.1"), ("sagging", "-", "-")]


def test_a_known_delay_and_error_are_found() -> None:
    t = np.linspace(0, 4, 2001)
    simulated, measured = Record(t), Record(t)
    simulated.add("q", np.stack([np.sin(t), 0 * t], axis=1), "rad", labels=("a", "b"))
    measured.add("q", np.stack([np.sin(t - 0.05), 0 * t + 0.01], axis=1), "rad", labels=("a", "b"))
    comparison = compare_records(simulated, measured)
    assert comparison.delay == pytest.approx(0.05, abs=2e-4)
    a, b = comparison.joints
    assert b.rms == pytest.approx(0.01)
    assert np.isnan(b.delay)
    # All but the first 50 ms, for which the simulated record holds nothing to compare with.
    assert a.rms_delay_removed < 5e-3
    assert comparison.worst is a


def test_the_gate_fails_with_every_bound_exceeded(rig, clean_run, tmp_path) -> None:
    comparison = compare_records(rig.record, clean_run.result.record)
    check_gate(comparison, Gate(rms_rad=0.2, delay_s=0.1))
    with raises(
        ComparisonGateFailed, re.compile(r"\brms_rad 0\.\d+ > 0\.001\b"), re.compile(r"\bdelay_s 0\.\d+ > 0\.01\b")
    ) as failure:
        check_gate(comparison, Gate(rms_rad=0.001, delay_s=0.01))
    assert failure.value.exit_code == 5
    (tmp_path / "gate.yaml").write_text("rms: 0.1\n", encoding="utf-8")
    with raises(ServoMapError, "gate.yaml:1: rms", "'rms_rad'"):
        load_gate(tmp_path / "gate.yaml")
    assert draw_comparison(comparison, tmp_path / "figures" / "comparison.png").stat().st_size > 10_000
    assert json.loads(json.dumps(comparison.summary()))["rms_rad"] == comparison.worst.rms


def test_records_without_common_angles_are_refused(rig) -> None:
    other = Record([0.0, 1.0])
    other.add("q", np.zeros((2, 1)), "rad", labels=("knee",))
    with raises(RecordError):
        compare_records(rig.record, other)


def test_a_measured_run_is_a_record_like_a_simulated_one(clean_run, tmp_path) -> None:
    path = clean_run.result.record.save(tmp_path / "measured.h5")
    again = Record.load(path)
    assert again.labels["q"] == ("shoulder", "elbow")
    assert again.units["rho_dot"] == "rad/s"
    for name in ("supply_voltage", "temperature", "missed", "alert", "lateness", "torque_estimate", "q_goal"):
        assert name in again
    assert again.summary["timing"]["cycles"] == len(again)
    assert np.isfinite(again["supply_voltage"][-1]).all()


def test_csv_holds_the_samples_with_units_in_the_header(tmp_path) -> None:
    record = swing()
    path = export_record(record, tmp_path / "a.csv", "csv")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][:4] == ["time [s]", "shoulder [rad]", "elbow [rad]", "wheel [rad]"]
    data = np.array(rows[1:], dtype=float)
    assert np.allclose(data[:, 1:3], record["q"], atol=1e-8)
    assert np.allclose(data[:, 4:6], record["v"], atol=1e-8)


def test_csv_of_a_sliding_joint_says_metres(tmp_path) -> None:
    record = Record([0.0, 1.0])
    record.add("q", np.zeros((2, 1)), "m", labels=("slide",))
    record.add("v", np.zeros((2, 1)), "m/s", labels=("slide",))
    record.add("rho", np.zeros((2, 1)), "rad", labels=("wheel",))
    record.add("rho_dot", np.zeros((2, 1)), "rad/s", labels=("wheel",))
    (heading, *_) = export_record(record, tmp_path / "a.csv", "csv").read_text(encoding="utf-8").splitlines()
    assert heading == "time [s],slide [m],wheel [rad],slide [m/s],wheel [rad/s]"


def test_joint_trajectory_resampled_is_valid_yaml_in_order(tmp_path) -> None:
    path = export_record(swing(), tmp_path / "t.yaml", "joint-trajectory", rate=50)
    message = YAML(typ="safe").load(path)
    assert message["joint_names"] == ["shoulder", "elbow", "wheel"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    run_up = swing()["v"][0].max() / 2.0  # it starts in motion, and gets a run-up and a run-out of 2 rad/s²
    assert times[1] == pytest.approx(run_up, abs=1e-9)
    assert np.allclose(np.diff(times)[1:-2], 0.02)
    assert message["points"][11]["positions"][0] == pytest.approx(0.6 * np.sin(4 * 0.2), abs=1e-6)


def test_urdf_log_is_one_json_object_per_line(tmp_path) -> None:
    path = export_record(swing(), tmp_path / "t.jsonl", "urdf-log", rate=10)
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert lines[1]["time"] == pytest.approx(0.1)
    assert set(lines[1]["position"]) == {"shoulder", "elbow", "wheel"}


def test_exports_refuse_records_without_motion_and_bad_rates(tmp_path) -> None:
    record = Record([0.0, 1.0])
    record.add("energy", [0.0, 1.0], "J")
    with raises(RecordError, "energy"):
        export_record(record, tmp_path / "x.csv", "csv")
    with raises(RecordError, "--rate", "0"):
        export_record(swing(), tmp_path / "x.csv", "csv", rate=0)
    with raises(RecordError, str(tmp_path)):
        export_record(swing(), tmp_path, "csv")


def test_a_late_loop_skips_samples_and_sends_no_burst(rig) -> None:
    """A hiccup of five periods: one cycle late, four skipped, goals jump ahead on the path."""
    run = rig.prepare()
    calls = 0

    def hiccup(progress) -> None:
        nonlocal calls
        calls += 1
        if calls == 150:
            run.clock.sleep_until(run.clock.now() + 0.055)

    run.replay.journal.observer = hiccup
    result = run.replay.run()
    assert result.fault is None
    assert result.timing["skipped_cycles"] in (4, 5)
    starts = result.record.time
    assert np.diff(starts).min() > 0.4 / run.map.bus.rate
    assert result.timing["period_max_s"] == pytest.approx(0.06, abs=0.01)


def test_a_loop_that_stays_late_aborts_within_its_bound(rig) -> None:
    from dynsim.hardware.replay.rules import Cause

    run = rig.prepare()
    run.replay.journal.observer = lambda progress: run.clock.sleep_until(run.clock.now() + 0.025)
    result = run.replay.run()
    assert result.fault.cause == Cause.DEADLINE
    late = (result.record["lateness"] > 1 / run.map.bus.rate).sum()
    assert run.map.safety.late_cycles <= late <= run.map.safety.late_cycles + 1


def test_no_wall_clock_enters_a_virtual_replay(rig, clean_run, monkeypatch) -> None:
    first = clean_run.result.record

    def looked_at(*_: object) -> float:
        raise AssertionError("a wall clock was looked at")

    for name in ("time", "monotonic", "perf_counter", "sleep"):
        monkeypatch.setattr(time, name, looked_at)
    second = rig.run().result.record
    assert np.array_equal(first["q"], second["q"])


def turning(drift: float, start: float, speed: float = 1.0) -> tuple[Record, Record]:
    """A wheel at 2 rad/s + sin, and what was measured of it: another start, too fast by ``drift`` [rad/s]."""
    t = np.linspace(0, 4, 801)
    simulated, measured = Record(t), Record(t / speed, provenance={"speed": speed})
    simulated.add("q", np.sin(t)[:, None], "rad", labels=("a",))
    measured.add("q", np.sin(t)[:, None], "rad", labels=("a",))
    measured.add("record_time", t, "s")
    simulated.add("rho", (2 * t - np.cos(t))[:, None], "rad", labels=("rho1",))
    simulated.add("rho_dot", (2 + np.sin(t))[:, None], "rad/s", labels=("rho1",))
    measured.add("rho", (start + 2 * t - np.cos(t) + drift * t / speed)[:, None], "rad", labels=("rho1",))
    measured.add("rho_dot", (speed * (2 + np.sin(t)) + drift)[:, None], "rad/s", labels=("rho1",))
    return simulated, measured


def test_wheels_are_drawn(tmp_path, monkeypatch) -> None:
    """Their rates, measured over simulated, and what lies between, below those of the joints."""
    comparison = compare_records(*turning(0.01, start=37.0))
    np.testing.assert_allclose(comparison.wheel_rates[1] - comparison.wheel_rates[0], 0.01)
    figures = []
    monkeypatch.setattr(style, "save", lambda figure, path: figures.append(figure) or path)
    draw_comparison(comparison, tmp_path / "wheels.png", ["rho1"])
    labels = [axes.get_ylabel() for axes in figures[0].axes]
    assert [re.search(r"\[.*\]", label)[0] for label in labels] == ["[rad]", "[mrad]", "[rad/s]", "[rad/s]"]
    rates, errors = figures[0].axes[2:]
    drawn = [line for line in rates.get_lines() if len(line.get_xdata())]
    for line, values in zip(drawn, comparison.wheel_rates[::-1, :, 0], strict=True):
        np.testing.assert_allclose(line.get_ydata(), values)
    np.testing.assert_allclose(errors.get_lines()[0].get_ydata(), 0.01)
    assert mentions(errors.get_legend().get_texts()[0].get_text(), "rho1", "0.01 rad/s")


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_wheels_are_compared_in_rate_and_in_how_far_they_turned(speed: float) -> None:
    """Where a wheel stood at the start has no part in it; rates are those of the replay's own speed."""
    comparison = compare_records(*turning(0.01, start=37.0, speed=speed))
    (wheel,) = comparison.wheels
    assert wheel.wheel == "rho1"
    assert (wheel.rate_rms, wheel.rate_max) == pytest.approx((0.01, 0.01))
    assert wheel.turned == pytest.approx(8 - np.cos(4) + 1, abs=1e-6)
    assert (wheel.angle_max, wheel.angle_end) == pytest.approx((0.04 / speed, 0.04 / speed), abs=1e-6)
    assert [joint.joint for joint in comparison.joints] == ["a"]
    summary = comparison.summary()
    assert summary["wheels"]["rho1"]["angle_end_rad"] == wheel.angle_end
    assert summary["wheel_rate_rms_rad_s"] == wheel.rate_rms


def test_missed_answers_of_a_wheel_are_left_out() -> None:
    simulated, measured = turning(0.0, start=5.0)
    for name in ("rho", "rho_dot"):
        measured[name][:3] = measured[name][-2:] = measured[name][100] = np.nan
    (wheel,) = compare_records(simulated, measured).wheels
    assert wheel.rate_max < 1e-9
    assert wheel.angle_max < 1e-9


def test_the_gate_knows_wheels() -> None:
    comparison = compare_records(*turning(0.01, start=0.0))
    check_gate(comparison, Gate(wheel_rate_rms_rad_s=0.02, wheel_angle_max_rad=0.05))
    with raises(
        ComparisonGateFailed, "wheel_rate_rms_rad_s 0.01 > 0.009", re.compile(r"\bwheel_angle_max_rad 0\.04 > 0")
    ):
        check_gate(comparison, Gate(wheel_rate_rms_rad_s=0.009, wheel_angle_max_rad=0.03))


def test_a_gate_for_wheels_fails_where_there_are_none() -> None:
    t = np.linspace(0, 1, 101)
    record = Record(t)
    record.add("q", np.sin(t)[:, None], "rad", labels=("a",))
    with raises(ComparisonGateFailed, "wheel_angle_max_rad"):
        check_gate(compare_records(record, record), Gate(wheel_angle_max_rad=1.0))


def test_the_wheel_of_a_replay_follows_its_rate(rig, clean_run) -> None:
    """At up to 3 rad/s; it lags by a cycle and the motor's own time, and ends where the path led."""
    (wheel,) = compare_records(rig.record, clean_run.result.record).wheels
    assert 0 < wheel.rate_rms < 0.5
    assert wheel.angle_max < 0.25
    assert wheel.turned == pytest.approx(rig.record["rho"][-1, 0] - rig.record["rho"][0, 0], abs=0.05)


def test_any_joint_can_be_drawn(tmp_path) -> None:
    t = np.linspace(0, 4, 201)
    simulated, measured = Record(t), Record(t)
    names = tuple("abcdef")
    simulated.add("q", np.outer(np.sin(t), np.ones(6)), "rad", labels=names)
    measured.add("q", np.outer(np.sin(t), np.linspace(1.0, 1.1, 6)), "rad", labels=names)
    comparison = compare_records(simulated, measured)
    worst = draw_comparison(comparison, tmp_path / "worst.png").read_bytes()
    assert draw_comparison(comparison, tmp_path / "named.png", ["f", "e", "d", "c"]).read_bytes() == worst
    assert draw_comparison(comparison, tmp_path / "a.png", ["a"]).read_bytes() != worst
    with raises(RecordError, "'knee'", "a, b, c, d, e, f"):
        draw_comparison(comparison, tmp_path / "none.png", ["knee"])
