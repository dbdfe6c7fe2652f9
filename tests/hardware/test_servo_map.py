"""Servo maps: the shipped ones, conversions, and errors that name file, line and fix."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from ruamel.yaml import YAML
from support.messages import raises

from dynsim.hardware.errors import ServoMapError, VerificationFailed
from dynsim.hardware.servo_map import json_schema, load_servo_map, read_zero_ticks, write_into_map

SHIPPED = Path(__file__).parents[2] / "scenarios" / "hardware"


def test_the_shipped_arm_map_names_ten_joints() -> None:
    servo_map = load_servo_map(SHIPPED / "arm.yaml")
    assert servo_map.joints == tuple(f"joint_{k}" for k in range(1, 11))
    assert {servo.model.name for servo in servo_map.servos} == {"MX-106"}
    assert all(servo.kind.follows.position == "q" for servo in servo_map.servos)


def test_the_shipped_snake_map_names_joints_held_joints_and_wheels() -> None:
    servo_map = load_servo_map(SHIPPED / "snake.yaml")
    followed = [servo.label for servo in servo_map.servos if servo.kind.mode == "position" and servo.hold_at is None]
    assert followed == ["theta1", "psi1", "theta2", "psi2", "theta3", "psi3", *(f"theta{k}" for k in range(4, 10))]
    assert [servo.joint for servo in servo_map.servos if servo.hold_at == 0.0] == [f"psi{k}" for k in range(4, 9)]
    wheels = [servo for servo in servo_map.servos if servo.kind.mode == "velocity"]
    assert [servo.joint for servo in wheels] == [f"wheel{k}" for k in range(1, 8)]
    assert {servo.model.name for servo in wheels} == {"MX-28"}


@pytest.mark.parametrize("name", ["arm", "snake.yaml", "scenarios/hardware/arm.yaml"])
def test_shipped_maps_are_found_by_name_from_anywhere(name: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_servo_map(name).path.parent == SHIPPED


@given(st.integers(0, 4095))
def test_ticks_and_angles_convert_both_ways(rig, tick: int) -> None:
    for servo in rig.map.servos[:2]:
        assert servo.to_ticks(servo.to_angle(tick)) == tick


def test_sense_zero_and_limits(rig) -> None:
    shoulder, elbow, wheel = rig.map.servos
    assert shoulder.to_ticks(math.pi / 2) == 2048 + 1024
    assert elbow.to_ticks(math.pi / 2) == 1900 - 1024
    assert elbow.to_velocity_units(1.0) < 0 < shoulder.to_velocity_units(1.0)
    assert shoulder.tick_limits == (2048 - 683, 2048 + 683)
    assert wheel.position_limits == (-math.inf, math.inf)


# What is replaced in the rig's map, by what, and the names in the error; a JSON schema refuses it too.
MISTAKES = [
    ("robot: rig", "robott: rig", ["map.yaml:1: robott", "'robot'"]),
    ("baud: 1000000", "baud: 1234", ["map.yaml:2: bus.baud = 1234", "9600, 57600, 115200"]),
    ("position_deg: [-60, 60], ", "", ["map.yaml:9: kinds.joint.limits", "limits.position_deg"]),
    ("sign: -1", "sign: true", ["map.yaml:19: servos.elbow.sign = True", "1", "-1"]),
    ("sign: -1", "sign: 2", ["map.yaml:19: servos.elbow.sign = 2", "1", "-1"]),
    (
        "velocity: 3.0, torque: 6.0}",
        "velocity: -3.0, torque: 6.0}",
        ["map.yaml:9: kinds.joint.limits.velocity = -3.0", "0"],
    ),
    ("policy: decelerate", "policy: panic", ["map.yaml:3: safety.policy = 'panic'", "'hold'", "'decelerate'", "'off'"]),
    ("torque: 6.0}", "torque: 6.0, torqe: 1}", ["map.yaml:9: kinds.joint.limits.torqe", "'torque'"]),
    ("id: 1}", "id: 254}", ["map.yaml:18: servos.shoulder.id = 254", "252"]),
    ("run_up: 20", "run_up: 20, watchdog: 60", ["map.yaml:3: safety.watchdog = 60", "2.54"]),
    ("run_up: 20", "run_up: 20, missed_cycles: 100000", ["map.yaml:3: safety.missed_cycles = 100000", "100"]),
    ("run_up: 20", "run_up: 20, stop_time: 60", ["map.yaml:3: safety.stop_time = 60", "3"]),
    (
        "torque: 6.0",
        "torque: 6.0, acceleration: 1e300",
        ["map.yaml:9: kinds.joint.limits.acceleration = 1e+300", "0.01", "100000 rad/s²"],
    ),
    (
        "torque: 6.0",
        "torque: 6.0, jerk: 1.0e+8",
        ["map.yaml:9: kinds.joint.limits.jerk = 100000000.0", "0.01", "1e+07 rad/s³"],
    ),
    (
        "torque: 6.0",
        "torque: 6.0, shaking: 1e3",
        ["map.yaml:9: kinds.joint.limits.shaking = 1000.0", "0.01", "100 rad/s"],
    ),
    ("run_up: 20", "start_distance: 1e9", ["map.yaml:3: safety.start_distance = 1000000000.0", "0.001", "6.28319 rad"]),
    ("run_up: 20", "approach_velocity: 50", ["map.yaml:3: safety.approach_velocity = 50", "0.001", "1 rad/s"]),
    ("run_up: 20", "run_up: 1e12", ["map.yaml:3: safety.run_up = 1000000000000.0", "0.01", "100000 rad/s²"]),
    ("run_up: 20", "run_up: 1e-12", ["map.yaml:3: safety.run_up = 1e-12", "0.01", "100000 rad/s²"]),
    ("rate: 100", "rate: 100, latency: 1e-12", ["map.yaml:2: bus.latency = 1e-12", "0.0001", "2.54 s"]),
]
# What ties entries together, or to a data sheet, is beyond a schema.
TIED = [
    ("id: 7", "id: 2", ["map.yaml:20: servos.wheel.id = 2", "elbow"]),
    ("kind: wheel, id: 7", "kind: whel, id: 7", ["map.yaml:20: servos.wheel.kind = 'whel'", "joint, wheel", "'wheel'"]),
    ("[-60, 60]", "[60, -60]", ["map.yaml:9: kinds.joint.limits.position_deg", "60.0", "-60.0"]),
    ("kinds:", "kinds: [", ["map.yaml:6", "YAML"]),
    ("id: 2, sign", "id: 2, label: shoulder, sign", ["map.yaml:19: servos.elbow.label = 'shoulder'", "'q'"]),
    ("velocity: 3.0", "velocity: 0.2", ["map.yaml:3: safety.approach_velocity", "kinds.joint.limits.velocity", "0.2"]),
    (
        "run_up: 20",
        "run_up: 3000",
        ["map.yaml:3: safety.run_up = 3000", "kinds.joint.limits.acceleration", "2000 rad/s²"],
    ),
    ("run_up: 20", "stop_time: 0.02", ["map.yaml:3: safety.stop_time = 0.02", "3", "100 Hz", "0.03"]),
    ("run_up: 20", "late_cycles: 51", ["map.yaml:3: safety.late_cycles = 51", "0.51 s", "100 Hz", "50"]),
    ("run_up: 20", "following_cycles: 51", ["map.yaml:3: safety.following_cycles = 51", "0.51 s", "100 Hz", "50"]),
    ("run_up: 20", "torque_cycles: 51", ["map.yaml:3: safety.torque_cycles = 51", "0.51 s", "100 Hz", "50"]),
    (
        "run_up: 20",
        "missed_cycles: 51, watchdog: 1",
        ["map.yaml:3: safety.missed_cycles = 51", "0.51 s", "100 Hz", "50"],
    ),
    (
        "run_up: 20",
        "missed_cycles: 20",
        ["map.yaml:3: safety.missed_cycles = 20", "0.2 s", "100 Hz", "safety.watchdog"],
    ),
    ("rate: 100", "rate: 1", ["map.yaml:3: safety.missed_cycles", "3 s", "1 Hz", "bus.rate"]),
    ("run_up: 20", "temperature_max: 1e-9", ["map.yaml:3: safety.temperature_max = 1e-09", "20 °C"]),
    ("torque: 6.0", "torque: 1e-9", ["map.yaml:9: kinds.joint.limits.torque = 1e-09", "MX-106", "0.0055 N m"]),
    ("error: 0.2", "error: 1e-12", ["map.yaml:10: kinds.joint.following_error = 1e-12", "0.0016 rad"]),
    ("error: 1.0", "error: 0.02", ["map.yaml:16: kinds.wheel.following_error = 0.02", "0.024 rad/s"]),
    (
        "{velocity: 5.0",
        "{position_deg: [-9, 9], velocity: 5.0",
        ["map.yaml:15: kinds.wheel.limits.position_deg", "mode: position"],
    ),
    (
        "id: 1}",
        "id: 1, hold_at_deg: 61}",
        ["map.yaml:18: servos.shoulder.hold_at_deg = 61", "limits.position_deg", "-60", "60"],
    ),
    (
        "id: 1}",
        "id: 1, zero_tick: 4779}",
        ["map.yaml:18: servos.shoulder.zero_tick = 4779", "0", "4095", "dynsim hw calibrate"],
    ),
    (
        "id: 1}",
        "id: 1, zero_tick: -684}",
        ["map.yaml:18: servos.shoulder.zero_tick = -684", "0", "4095", "dynsim hw calibrate"],
    ),
    ("robot: rig", "robot: ../rig", ["map.yaml:1: robot = '../rig'", "'_rig'"]),
    ("robot: rig", "robot: ''", ["map.yaml:1: robot = ''", "'unnamed'"]),
    ("run_up: 20", "temperature_max: 500", ["map.yaml:3: safety.temperature_max = 500", "MX-106", "80 °C"]),
    ("lowest: 10.5", "lowest: 5.0", ["map.yaml:3: safety.supply.lowest = 5.0", "MX-106", "9.5 V"]),
    ("highest: 14.0", "highest: 24.0", ["map.yaml:3: safety.supply.highest = 24.0", "MX-106", "16 V"]),
    ("lowest: 10.5", "lowest: 14.0", ["map.yaml:3: safety.supply.lowest = 14.0", "supply.highest"]),
    (
        "run_up: 20",
        "stop_time: 0.001",
        ["map.yaml:3: safety.stop_time = 0.001", "kinds.joint", "3000 rad/s²", "0.0015"],
    ),
    ("rate: 100", "rate: 100, latency: 0.3", ["map.yaml:2: bus.latency = 0.3", "safety.watchdog"]),
    ("velocity: 3.0", "velocity: 30.0", ["map.yaml:9: kinds.joint.limits.velocity = 30.0", "MX-106", "5.81 rad/s"]),
    ("torque: 6.0", "torque: 60.0", ["map.yaml:9: kinds.joint.limits.torque = 60.0", "MX-106", "10.4 N m"]),
    ("torque: 1.8", "torque: 6.0", ["map.yaml:15: kinds.wheel.limits.torque = 6.0", "MX-28", "3.08 N m"]),
    ("[-60, 60]", "[-600, 60]", ["map.yaml:9: kinds.joint.limits.position_deg", "360°"]),
    ("error: 0.2", "error: 2.0", ["map.yaml:10: kinds.joint.following_error = 2.0", "1 rad"]),
    ("error: 1.0", "error: 9.0", ["map.yaml:16: kinds.wheel.following_error = 9.0", "limits.velocity"]),
]


def test_values_just_within_the_bounds_load(write_map) -> None:
    """The mistakes above, each less by one: what is refused begins where the message says."""
    fine = [
        ("run_up: 20", "run_up: 2000, stop_time: 0.03, late_cycles: 50, following_cycles: 50, torque_cycles: 50"),
        (
            "run_up: 20",
            "run_up: 0.01, missed_cycles: 19, start_distance: 6.28, approach_velocity: 1, temperature_max: 21",
        ),
        ("torque: 6.0", "torque: 0.0055, acceleration: 1e5, jerk: 1.0e+7, shaking: 100"),
        ("error: 0.2", "error: 0.0016"),
        ("error: 1.0", "error: 0.024"),
        ("id: 1}", "id: 1, zero_tick: 4778, hold_at_deg: -60}"),
        ("rate: 100", "rate: 20, latency: 1e-4"),
        ("robot: rig", "robot: rig 2_b"),
    ]
    for change in fine:
        load_servo_map(write_map(change))


def test_a_gear_moves_what_a_joint_can_do(write_map) -> None:
    """Ten servo turns to a joint turn: a tenth of the speed, ten times the torque, 36° in a turn of the servo."""
    load_servo_map(write_map(("error: 0.2", "error: 0.2\n    gear: 1.9")))
    with raises(ServoMapError, "kinds.joint.limits.velocity = 3.0", "0.581 rad/s"):
        load_servo_map(write_map(("error: 0.2", "error: 0.2\n    gear: 10")))
    slow = ("[-60, 60], velocity: 3.0, torque: 6.0", "[-60, 60], velocity: 0.5, torque: 100")
    with raises(ServoMapError, "kinds.joint.limits.position_deg", "36°"):
        load_servo_map(write_map(("error: 0.2", "error: 0.2\n    gear: 10"), slow))
    slow = (slow[0], slow[1].replace("60", "18"))
    servo_map = load_servo_map(write_map(("error: 0.2", "error: 0.2\n    gear: 10"), slow))
    assert servo_map.servos[0].kind.limits.torque == 100


def invalid(path: Path) -> list[str]:
    """What a validator of JSON schemas finds in a map."""
    validator = Draft202012Validator(json_schema())
    return [error.message for error in validator.iter_errors(YAML(typ="safe").load(path.read_text(encoding="utf-8")))]


def test_the_schema_is_one_and_every_shipped_map_follows_it(write_map) -> None:
    Draft202012Validator.check_schema(json_schema())
    assert invalid(write_map()) == []
    maps = sorted(SHIPPED.glob("*.yaml"))
    assert [path.stem for path in maps] == ["arm", "snake"]
    for path in maps:
        assert invalid(path) == []


@pytest.mark.parametrize(("old", "new", "names"), MISTAKES + TIED)
def test_mistakes_are_named_with_file_and_line(write_map, old: str, new: str, names: list[str]) -> None:
    """The schema refuses them too, where it can."""
    path = write_map((old, new))
    with raises(ServoMapError, *names):
        load_servo_map(path)
    assert (old, new, names) in TIED or invalid(path)


def test_missing_empty_and_binary_files(tmp_path: Path) -> None:
    with raises(ServoMapError, "nowhere.yaml"):
        load_servo_map(tmp_path / "nowhere.yaml")
    (tmp_path / "empty.yaml").touch()
    with raises(ServoMapError, "empty.yaml", "robot, bus, safety, lifts, kinds, servos"):
        load_servo_map(tmp_path / "empty.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\x89HDF\r\n\x1a\n\xff")
    with raises(ServoMapError, "binary.yaml:1", "0x89"):
        load_servo_map(tmp_path / "binary.yaml")


def test_calibration_writes_zero_ticks_and_keeps_the_rest(rig, write_map) -> None:
    path = write_map(("id: 7}", "id: 7}  # left"))
    run = rig.prepare()
    ticks = read_zero_ticks(run.replay.bus, rig.map.servos[:2])
    assert ticks == {"shoulder": rig.map.servos[0].to_ticks(0.1), "elbow": rig.map.servos[1].to_ticks(0.2)}
    write_into_map(load_servo_map(path), "zero_tick", ticks, path)
    again = load_servo_map(path)
    assert [servo.zero_tick for servo in again.servos[:2]] == list(ticks.values())
    assert "# left" in path.read_text(encoding="utf-8")


def test_calibration_refuses_torque_movement_and_impossible_zeros(rig, write_map) -> None:
    run = rig.prepare()
    run.line.servos.write(1, 64, b"\1")
    with raises(VerificationFailed, "shoulder (ID 1)", "dynsim hw stop"):
        read_zero_ticks(run.replay.bus, rig.map.servos[:2])
    run = rig.prepare()
    run.line.servos.plant.velocity[0] = 2.0
    with raises(VerificationFailed, "shoulder", "2116", "2146"):
        read_zero_ticks(run.replay.bus, rig.map.servos[:2])
    path = write_map()
    before = path.read_text(encoding="utf-8")
    with raises(ServoMapError, "shoulder", "200", "-483", "883", "0", "4095"):
        write_into_map(load_servo_map(path), "zero_tick", {"shoulder": 200}, path)
    assert path.read_text(encoding="utf-8") == before
