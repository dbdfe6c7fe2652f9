"""Recorded positions become a smooth motion that passes the checks of a replay, or are refused with their line."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dynsim import cli
from dynsim.errors import CheckRefused, RecordError
from dynsim.hardware.imported import import_motion, outliers
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.servo_map import ServoMap, load_servo_map
from dynsim.record import Record
from dynsim.record.mcap_file import write_mcap

RATE = 30.0
TICK = 2 * np.pi / 4096
MAP = """
robot: taught
bus: {baud: 1000000, rate: 100}
kinds:
  joint: {model: XM430-W350, mode: position, follows: {position: q, velocity: v}, following_error: 0.3,
          limits: {position_deg: [-100, 100], velocity: 4.0, torque: 1.2}}
servos:
  pan: {kind: joint, id: 1, sign: -1, zero_tick: 2000}
  lift: {kind: joint, id: 2}
"""


@pytest.fixture
def servo_map(tmp_path: Path) -> ServoMap:
    path = tmp_path / "taught.yaml"
    path.write_text(MAP, encoding="utf-8")
    return load_servo_map(path)


def exact(time: np.ndarray, order: int = 0) -> np.ndarray:
    """Two joints at 0.2 and 0.5 Hz, which begin and end slowly; derivative ``order`` of their angles."""
    turn = 2 * np.pi * np.array([0.2, 0.5])
    return 0.5 * turn**order * np.cos(np.outer(time, turn) + order * np.pi / 2)


def demonstration(duration: float = 10.0) -> list[list[float]]:
    """Rows of time and two angles [rad] at 30 Hz, rounded to ticks as an encoder does."""
    time = np.arange(0.0, duration, 1 / RATE)
    return np.column_stack([time, np.round(exact(time) / TICK) * TICK]).tolist()


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write_csv(rows: list[list[object]], header: str = "time [s],pan [rad],lift [rad]") -> Path:
        path = tmp_path / "taught.csv"
        path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n", encoding="utf-8")
        return path

    return write_csv


def test_rates_and_accelerations_of_a_recording(servo_map: ServoMap, write: Callable[..., Path]) -> None:
    record, joints, notes = import_motion(write(demonstration()), servo_map)
    within = (record.time > 0.5) & (record.time < 9.4)
    errors = {
        name: np.abs(record[name] - exact(record.time, order))[within].max()
        for order, name in enumerate(("q", "v", "vdot"))
    }
    # Bounds: a tick is 1.5 mrad; differences of the rounded positions would be wrong by up to 46 mrad/s and 2.8 rad/s².
    assert errors["q"] < 1.0e-3
    assert errors["v"] < 0.02
    assert errors["vdot"] < 0.4
    assert notes == []
    assert [joint.bandwidth for joint in joints] == pytest.approx([5.0, 5.0])
    assert record.summary["import"]["bandwidth_Hz"] == pytest.approx(5.0)
    motion = check_motion(record, servo_map)
    assert motion.duration == pytest.approx(record.time[-1], abs=1.0)


def test_the_amplitude_is_halved_at_the_bandwidth(servo_map: ServoMap, write: Callable[..., Path]) -> None:
    time = np.arange(0.0, 10.0, 1 / RATE)
    wave = 0.08 * np.sin(2 * np.pi * 3.0 * time)
    rows = np.column_stack([time, wave, wave]).tolist()
    record, _, _ = import_motion(write(rows), servo_map, bandwidth=3.0, rate=RATE)
    within = slice(30, -30)
    gain = np.linalg.norm(record["q"][within, 0]) / np.linalg.norm(wave[within])
    assert gain == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("unit", ["deg", "tick"])
def test_units_of_columns(servo_map: ServoMap, write: Callable[..., Path], unit: str) -> None:
    rows = demonstration()
    scaled = [
        [t, math.degrees(pan), math.degrees(lift)]
        if unit == "deg"
        else [t, servo_map.servos[0].to_ticks(pan), servo_map.servos[1].to_ticks(lift)]
        for t, pan, lift in rows
    ]
    expected, _, _ = import_motion(write(rows), servo_map)
    named, _, _ = import_motion(
        write(scaled, f"timestamp,pan.pos [{unit}],/joint_states/lift/position"), servo_map, unit=unit
    )
    assert np.allclose(named["q"], expected["q"], atol=1e-9)
    assert np.allclose(named["v"], expected["v"], atol=1e-9)


def test_joint_states_of_a_bag(servo_map: ServoMap, tmp_path: Path) -> None:
    time = np.arange(0.0, 5.0, 1 / RATE)
    record = Record(time)
    record.add("q", exact(time), "rad", labels=("pan", "lift"))
    record.add("v", 0 * exact(time), "rad/s", labels=("pan", "lift"))
    path = write_mcap(record, tmp_path / "taught.mcap")
    imported, _, _ = import_motion(path, servo_map)
    record.save(tmp_path / "taught.h5")
    direct, _, _ = import_motion(tmp_path / "taught.h5", servo_map)
    within = slice(50, -50)
    assert np.abs(imported["v"] - exact(imported.time, 1))[within].max() < 2e-3
    assert np.allclose(imported["v"], direct["v"], atol=1e-6)
    with pytest.raises(RecordError, match="no joint states in /arm; topics: /joint_states"):
        import_motion(path, servo_map, topic="/arm")
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(RecordError, match="cannot be read as MCAP"):
        import_motion(path, servo_map)


def test_faults_that_an_import_repairs_are_reported(servo_map: ServoMap, write: Callable[..., Path]) -> None:
    rows: list[list[object]] = list(demonstration())
    clean, _, _ = import_motion(write(rows), servo_map)
    rows[50] = [rows[50][0], float(rows[50][1]) + 0.3, rows[50][2]]  # a read error
    rows[80] = [rows[80][0], "", "nan"]  # a lost status
    rows[120] = rows[119]  # written twice
    del rows[200:203]
    record, _, notes = import_motion(write([*rows]), servo_map)
    text = "\n".join(notes)
    assert "taught.csv:52: pan =" in text
    assert "taught.csv:202: no sample for 0.133 s after 201" in text
    assert "1 repeated sample(s) merged, first at" in text
    assert "taught.csv:122" in text
    assert np.abs(record["q"] - clean["q"]).max() < 3e-3


def test_two_bad_samples_in_a_row_are_outliers() -> None:
    time = np.arange(0.0, 3.0, 1 / RATE)
    value = 0.5 * np.sin(2 * np.pi * 0.8 * time)
    assert not outliers(time, value).any()
    value[40:42] += 0.4
    assert np.flatnonzero(outliers(time, value)).tolist() == [40, 41]


def test_a_step_is_not_an_outlier() -> None:
    time = np.arange(0.0, 3.0, 1 / RATE)
    value = 0.1 * np.sin(2 * np.pi * 0.5 * time) + 0.4 * (time > 1.5)
    assert not outliers(time, value).any()


def shifted(rows: list[list[object]], line: int, column: int, value: object) -> list[list[object]]:
    rows[line - 2] = [*rows[line - 2]]
    rows[line - 2][column] = value
    return rows


HEAD = "time [s],pan [rad],lift [rad]"
REFUSED: dict[str, tuple[Callable[[list[list[object]]], list[list[object]]], str, str]] = {
    "gap": (lambda rows: [*rows[:99], *rows[120:]], HEAD, r":101: no sample for 0\.733 s after 100"),
    "time": (lambda rows: shifted(rows, 40, 0, rows[20][0]), HEAD, r":40: the time decreases by 0\.567 s after .*:39"),
    "same time": (lambda rows: shifted(rows, 40, 0, rows[37][0]), HEAD, r":40: pan has the same time as at .*:39, but"),
    "jump": (
        lambda rows: [[row[0], float(row[1]) + (k > 100), row[2]] for k, row in enumerate(rows)],  # type: ignore[arg-type]
        HEAD,
        r":10\d: the smooth motion of pan would deviate by .* \(limit 0\.05 rad\)",
    ),
    "comma": (lambda rows: shifted(rows, 9, 1, '"0,5"'), HEAD, r":9: pan \[rad\] = '0,5': must be a finite number"),
    "cells": (lambda rows: shifted(rows, 9, 1, "0,5"), HEAD, r":9: has 4 values; the header has 3 columns"),
    "milliseconds": (
        lambda rows: rows,
        "time [min],pan [rad],lift [rad]",
        r":1: .*unknown unit of time; choices: s, ms",
    ),
    "seconds": (lambda rows: rows, "time [ms],pan [rad],lift [rad]", r"pan is sampled at 3e\+04 Hz .*correct the unit"),
    "unit": (lambda rows: rows, "time,pan,lift", r":1: column 'pan' has no unit; use --unit rad"),
    "no time": (
        lambda rows: rows,
        "a,pan [rad],lift [rad]",
        r":1: no column with the time .*; rename that column to 'time \[s\]'",
    ),
    "twice": (lambda rows: rows, "time,lift.pos [rad],lift [rad]", r":1: columns .* are positions of the same joint"),
    "joint": (lambda rows: rows, "time,pan [rad],lfit [rad]", r"no positions of lift \(.*:9: servos\.lift\); did you"),
    "short": (lambda rows: rows[:5], HEAD, r"pan has 5 samples; a motion requires 8 or more"),
    "noise": (
        lambda rows: [[r[0], float(r[1]) + 0.9 * (k % 9 == 4), r[2]] for k, r in enumerate(rows)],  # type: ignore[arg-type]
        HEAD,
        r":4: 34 of 300 samples of pan are outliers \(limit 5%\)",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_recordings_without_a_known_motion_are_refused(
    servo_map: ServoMap, write: Callable[..., Path], case: str
) -> None:
    change, header, message = REFUSED[case]
    path = write(change([list(row) for row in demonstration()]), header)
    with pytest.raises(RecordError, match=message):
        import_motion(path, servo_map)


def test_a_low_bandwidth_does_not_hide_a_gap(servo_map: ServoMap, write: Callable[..., Path]) -> None:
    rows = [[row[0], 0.0, 0.0] for row in demonstration()]
    with pytest.raises(RecordError, match=r":101: no sample for 0\.733 s after 100.* \(limit 0\.2 s\)"):
        import_motion(write([*rows[:99], *rows[120:]]), servo_map, bandwidth=0.5)


def test_a_record_without_velocities_names_the_import(servo_map: ServoMap, tmp_path: Path) -> None:
    time = np.arange(0.0, 5.0, 1 / RATE)
    record = Record(time)
    record.add("q", exact(time), "rad", labels=("pan", "lift"))
    with pytest.raises(CheckRefused, match=r"no velocities 'v', only q; add velocities .*`dynsim import"):
        check_motion(record, servo_map)


def test_an_imported_recording_is_replayed(
    servo_map: ServoMap, write: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(demonstration(2.0))
    for arguments in (
        ("import", path, "--map", servo_map.path),
        (
            "hw",
            "replay",
            path.with_suffix(".h5"),
            "--map",
            servo_map.path,
            "--port",
            "virtual",
            "--out",
            tmp_path / "out",
        ),
    ):
        monkeypatch.setattr(sys, "argv", ["dynsim", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            cli.main()
        assert not leaving.value.code
    measured = Record.load(tmp_path / "out" / "measured.h5")
    moved = measured["record_time"] > 0.5
    assert np.nanmax(np.abs(measured["q"] - measured["q_goal"])[moved]) < 0.1


def test_a_name_of_the_map_may_contain_a_slash(tmp_path: Path, write: Callable[..., Path]) -> None:
    (tmp_path / "map.yaml").write_text(MAP.replace("  lift:", "  left/lift:"), encoding="utf-8")
    path = write(demonstration(), "time [s],pan [rad],left/lift [rad]")
    record, *_ = import_motion(path, load_servo_map(tmp_path / "map.yaml"))
    assert record.labels["q"] == ("pan", "left/lift")
