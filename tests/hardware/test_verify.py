"""Verification before torque on: each condition that must refuse it."""

from __future__ import annotations

import json
import os
import select
import time

import pytest
from support.messages import check_message, mentions, says

from dynsim.hardware.bus.control_table import OperatingMode
from dynsim.hardware.bus.dynamixel_bus import READ_WAIT, SerialPort
from dynsim.hardware.replay.output import ReplayState
from dynsim.hardware.replay.rules import Cause


@pytest.mark.parametrize(
    ("name", "value", "names"),
    [
        ("return_delay", 250, ("500 µs", "0 µs", "--configure")),
        ("drive_mode", 1, ("1", "0", "--configure")),
        ("status_return_level", 1, ("1", "2")),
        ("shutdown", 0, ("0x00",)),
        ("hardware_error", 4, ("overheating",)),
        ("operating_mode", OperatingMode.EXTENDED_POSITION, ("extended_position", "position")),
        ("max_position", 2300, ("0", "2300")),
        ("firmware", 38, ("38", "41")),
    ],
)
def test_an_unfit_servo_is_not_armed(rig, name: str, value: int, names: tuple[str, ...]) -> None:
    run = rig.prepare()
    run.line.servos.registers[1][name] = value
    result = run.replay.run()
    assert result.fault.cause == Cause.VERIFICATION
    check_message(result.fault.text, "shoulder (ID 1)", *names)
    assert result.end_state == "not armed"
    assert not run.goals()


def test_a_robot_outside_of_its_limits_is_not_armed(rig) -> None:
    run = rig.prepare()
    run.line.servos.plant.position[0] += 2.0
    result = run.replay.run()
    check_message(result.fault.text, "shoulder (ID 1)", "2.100 rad", "-1.047", "1.047 rad")


def test_an_unknown_servo_on_the_bus_is_reported(rig) -> None:
    run = rig.prepare()
    field = run.map.servos[0].model.fields["id"]
    run.line.servos.write(1, field.address, field.encode(9))
    result = run.replay.run()
    check_message(result.fault.text, "ID 9", "MX-106", "45")


def test_a_silent_servo_comes_with_a_hint_at_protocol_1(rig) -> None:
    run = rig.prepare()
    run.line.servos.dead.add(2)
    result = run.replay.run()
    check_message(result.fault.text, "elbow", "ID 2", "dynsim hw scan", "Protocol 1")


@pytest.mark.parametrize("pause", [0.0, 0.08])
@pytest.mark.parametrize(
    ("fault", "state", "names"),
    [
        ({"kind": "drop_off", "id": 2}, ReplayState.VERIFY, ("elbow", "ID 2")),
        ({"kind": "lost_status", "id": 2, "probability": 0.9}, ReplayState.VERIFY, ("2",)),
        ({"kind": "drop_off", "id": 2, "at": 0.0}, ReplayState.ARM, ("ID 2",)),
    ],
)
def test_an_answer_that_is_missing_on_a_busy_computer_says_so(rig, fault, state, names, pause: float) -> None:
    run = rig.prepare(fault)
    run.replay.bus.port.longest_pause = pause
    result = run.replay.run()
    assert result.fault_state == state
    check_message(result.fault.text, *names)
    assert mentions(result.fault.text, "80 ms") == says(result.fault.text, "busy") == bool(pause)


def test_other_troubles_do_not_blame_the_computer(rig) -> None:
    run = rig.prepare({"kind": "wrong_model", "id": 1, "value": 12})
    run.replay.bus.port.longest_pause = 0.08
    assert not says(run.replay.run().fault.text, "busy")


def test_a_port_knows_how_late_it_was_run(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = os.openpty()
    port = SerialPort(os.ttyname(slave))
    port.setBaudRate(1_000_000)
    wait = select.select
    monkeypatch.setattr(select, "select", lambda *asked: (time.sleep(0.03), wait(*asked))[1])
    assert port.readPort(1) == b""
    assert port.longest_pause >= 0.03 - READ_WAIT
    port.closePort()
    os.close(master)
    os.close(slave)


def test_too_low_a_supply_is_reported(rig) -> None:
    run = rig.prepare()
    run.line.servos.supply = 10.0
    check_message(run.replay.run().fault.text, "10.0 V", "10.5", "14 V")


def test_configure_writes_what_differs_and_nothing_else(rig) -> None:
    run = rig.prepare(write_eeprom=True)
    run.line.servos.registers[1]["return_delay"] = 250
    run.line.servos.registers[7]["operating_mode"] = OperatingMode.POSITION
    result = run.replay.run()
    assert result.fault is None
    assert run.line.servos.registers[1]["return_delay"] == 0
    assert run.line.servos.registers[7]["operating_mode"] == OperatingMode.VELOCITY
    written = [packet for _, packet in run.sent if packet.instruction == 3 and packet.parameters[0] < 64]
    assert len(written) == 2
    assert any("return_delay 250 -> 0" in line for line in run.replay.journal.log.lines)


def test_configure_is_refused_while_torque_is_on(rig) -> None:
    run = rig.prepare(write_eeprom=True)
    run.line.servos.registers[1]["return_delay"] = 250
    run.line.servos.write(1, 64, b"\1")
    result = run.replay.run()
    assert result.fault.cause == Cause.VERIFICATION
    assert "not available" in result.fault.text
    assert result.end_state == "not armed"


def test_registers_are_dumped_before_and_after_a_fault(rig, tmp_path) -> None:
    run = rig.prepare({"kind": "overload", "id": 2, "at": 0.5}, dump_folder=tmp_path)
    run.replay.run()
    before = json.loads((tmp_path / "registers.json").read_text(encoding="utf-8"))
    after = json.loads((tmp_path / "registers_after_fault.json").read_text(encoding="utf-8"))
    assert before["elbow"]["hardware_error"] == 0
    assert after["elbow"]["hardware_error"] == 1 << 5
    assert before["wheel"]["model_number"] == 30


def test_arming_sends_the_robot_nowhere(clean_run) -> None:
    """Every goal written before torque on is where the servo stands."""
    run = clean_run
    for id_, position in ((1, 0.1), (2, 0.2)):
        servo = run.map.servos[run.map.ids.index(id_)]
        torque_on = next(time for time, who, value in run.writes_of(64) if who == id_ and value == 1)
        first = [value for time, who, value in run.goals() if who == id_ and time <= torque_on]
        assert first == [servo.to_ticks(position)]
