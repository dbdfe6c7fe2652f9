"""Motors from data sheets, the table that they share with the servos, and maps drafted from scenarios."""

from __future__ import annotations

import math
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from support.messages import raises

from dynsim import cli, load_scenario, simulate
from dynsim.config.data_sheets import JOINT_SHEETS, SERVO_SHEETS
from dynsim.hardware.bus.control_table import MODELS
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.map_draft import draft_map
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.servo_map import load_servo_map
from dynsim.hardware.virtual.simulated_plant import MotorLaw, SimulatedArm
from dynsim.library import families
from dynsim.model.drives import Servo
from dynsim.record.joint_motion import export_record
from dynsim.scenario import build

from .conftest import Rig

ARM = """
duration_s: 1.0
plant:
  type: serial_arm
  link: {length_m: 0.15, mass_kg: 0.1, motor: {type: xm430_w350}}
  chain: [{axis: z, motor: {type: xl430_w250}}, {axis: y}, {axis: y}]
  initial_deg: [0, 20, 30]
controller:
  type: joint_pd
  joints: {joint_2: {times_s: [0, 1], angles_deg: [20, 35], ends: rest}}
"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.yaml"
    path.write_text(ARM, encoding="utf-8")
    return path


def motor(name: str) -> Servo:
    module = families.member("motor", name)

    class Context:
        joint = "j"

    servo: Servo = module.build(module.Config(type=name), Context())
    return servo


@pytest.mark.parametrize("name", SERVO_SHEETS)
def test_motor_and_servo_have_the_values_of_one_sheet(name: str) -> None:
    sheet, model, servo = SERVO_SHEETS[name], MODELS[name], motor(SERVO_SHEETS[name].motor_type)
    assert servo.sheet == name
    assert servo.stall_torque == pytest.approx(sheet.stall_torque) == model.stall_torque
    assert servo.voltage_limit / servo.torque_constant == pytest.approx(model.no_load_speed, abs=0.005)
    assert servo.nominal_torque == pytest.approx(0.2 * sheet.stall_torque, abs=1e-4)
    # A servo in position mode has the stiffness of the virtual servos.
    stiffness = servo.k_p * servo.torque_constant / servo.resistance
    if not servo.velocity_mode:
        assert stiffness == pytest.approx(MotorLaw([model]).stiffness[0], rel=2e-3)
    assert sheet.source.startswith("https://emanual.robotis.com/docs/en/dxl/")


@pytest.mark.parametrize("name", JOINT_SHEETS)
def test_a_joint_delivers_its_torque_up_to_its_speed(name: str) -> None:
    sheet, servo = JOINT_SHEETS[name], motor(name)
    assert servo.torque_limit == sheet.torque
    at_speed = servo.torque_constant * (servo.voltage_limit - servo.torque_constant * sheet.speed) / servo.resistance
    assert at_speed == pytest.approx(sheet.torque, rel=1e-4)
    assert servo.k_p * servo.torque_constant / servo.resistance == pytest.approx(sheet.stiffness, rel=1e-3)


def test_configurations_of_the_catalogue_can_be_pickled() -> None:
    config = families.member("motor", "panda_large").Config(type="panda_large")
    assert pickle.loads(pickle.dumps(config)) == config


def test_a_drafted_map_replays_its_scenario(arm: Path, tmp_path: Path) -> None:
    scenario = load_scenario(arm)
    (tmp_path / "map.yaml").write_text(draft_map(scenario), encoding="utf-8")
    servo_map = load_servo_map(tmp_path / "map.yaml")
    assert [servo.model.name for servo in servo_map.servos] == ["XL430-W250", "XM430-W350", "XM430-W350"]
    record = simulate(scenario)
    check_motion(record, servo_map)
    run = Rig(servo_map, record, dict(zip(servo_map.joints, record["q"][0].tolist(), strict=True))).run()
    assert run.result.fault is None
    assert np.nanmax(np.abs(run.result.record["q"][:, 1])) > math.radians(30)


def test_a_record_with_a_prismatic_joint_is_replayed(tmp_path: Path) -> None:
    """The unit of its positions is "rad or m"; the scene has the kinds of the joints."""
    record = simulate(load_scenario("sampled_arm", "servos", {"duration_s": 0.1, "metrics.settle_s": 0}))
    assert record.units["q"] == "rad or m"
    assert [record.unit_of("q", joint) for joint in record.labels["q"]] == ["m", *["rad"] * 4]
    header = export_record(record, tmp_path / "q.csv", "csv").read_text().partition("\n")[0]
    assert header.startswith("time [s],joint_1 [m],joint_2 [rad]")
    assert "joint_1 [m/s],joint_2 [rad/s]" in header
    (tmp_path / "map.yaml").write_text(draft_map(load_scenario("sampled_arm", "servos"), "MX-106"), encoding="utf-8")
    checked = check_motion(record, load_servo_map(tmp_path / "map.yaml"))
    assert "joint_1" in " ".join(checked.warnings)


def test_a_draft_names_motors_without_servo_model(arm: Path) -> None:
    scenario = load_scenario(arm, overrides={"plant.link.motor": {"type": "wang_minami"}})
    with raises(ServoMapError, "joint_2, joint_3", "xm430_w350", "--model"):
        draft_map(scenario)
    with raises(ServoMapError, "--model", "AX-12A", "XL430-W250"):
        draft_map(scenario, "AX-12A")
    assert draft_map(scenario, "XM540-W270").count("XM540-W270") == 1
    with raises(ServoMapError, "XL330-M288", "common supply voltage"):
        draft_map(scenario, "XL330-M288")
    with raises(ServoMapError, "plant.type: snake", "snake.yaml"):
        draft_map(load_scenario("snake_operator"))
    with raises(ServoMapError, "no revolute joint with a motor"):
        draft_map(load_scenario("free_flyer", overrides={"plant.motor": None, "plant.motors": {}}))


def test_the_command_writes_a_map_once(arm: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["dynsim", "hw", "map", str(arm)])
    codes = []
    for _ in range(2):
        with pytest.raises(SystemExit) as ended:
            cli.main()
        codes.append(ended.value.code or 0)
    assert codes == [0, 2]
    assert load_servo_map(tmp_path / "arm_map.yaml").joints == ("joint_1", "joint_2", "joint_3")


def test_a_draft_lists_joints_without_servo() -> None:
    text = draft_map(load_scenario("mobile_elbow_comparison"), "MX-106")
    assert "no servo here" in text
    assert "base.left, base.right" in text
    assert "base.left:" not in text
    # A joint that turns further than position mode allows.
    text = draft_map(load_scenario("six_axis_arm"), "XM430-W350")
    assert "mode: extended_position" in text
    assert text.count("mode: position") == 4


@pytest.mark.long
def test_a_pair_has_twice_the_torque_behind_a_plant(arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At rest the arm sags by gravity torque over stiffness: half as far with two servos on the axle."""
    monkeypatch.setattr("dynsim.hardware.virtual.simulated_plant.GEAR_FRICTION", 0.0)  # it would hold the arm
    scenario = load_scenario(arm)
    text = draft_map(scenario)
    sag = []
    for second in ("", ", pair: {id: 9}"):
        joint = "joint_2: {kind: kind_2, id: 2, sign: 1, zero_tick: 2048"
        assert joint in text
        (tmp_path / "map.yaml").write_text(text.replace(joint, joint + second), encoding="utf-8")
        servo_map = load_servo_map(tmp_path / "map.yaml")
        initial = build.robot(scenario).initial
        plant = SimulatedArm(scenario, servo_map, initial)
        run = Rig(servo_map, simulate(scenario), {}).prepare(plant=plant)
        for id_ in servo_map.ids:
            assert not run.line.servos.write(id_, 64, b"\1")
        run.line.advance(3.0)
        sag.append(plant.joint_positions[1] - initial[1])
        # Servos that face each other turn in opposite directions.
        assert abs(run.line.servos.plant.torque[1:3].sum()) < 1e-2 or not second
    assert sag[0] == pytest.approx(2.0 * sag[1], rel=0.1)
    assert abs(sag[1]) > 1e-3
