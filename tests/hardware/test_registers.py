"""Limits stored in the servos, compared with those of the map."""

from __future__ import annotations

import math

import pytest
from support.messages import check_message, lines_with

from dynsim.hardware.replay.rules import Cause, compare_limits, difference_lines, needs_of_map, snapshot
from dynsim.hardware.servo_map import load_servo_map


@pytest.mark.parametrize(
    ("id_", "name", "value", "names"),
    [
        (
            1,
            "max_position",
            2300,
            ("shoulder (ID 1)", "1657", "2439", "0", "2300"),
        ),
        (
            2,
            "min_position",
            1600,
            ("elbow (ID 2)", "1509", "2291", "1600", "4095"),
        ),
        (1, "velocity_limit", 80, ("shoulder (ID 1)", "2.40 rad/s", "1.92")),
        (7, "velocity_limit", 200, ("wheel (ID 7)", "4.80 rad/s")),
        (1, "temperature_limit", 60, ("shoulder (ID 1)", "60 °C", "temperature_max", "65 °C")),
        (1, "temperature_limit", 65, ("shoulder (ID 1)", "65 °C", "temperature_max")),
        (7, "temperature_limit", 95, ("wheel (ID 7)", "95 °C", "MX-28", "80 °C")),
    ],
)
def test_a_servo_that_makes_the_map_untrue_is_not_armed(
    rig, id_: int, name: str, value: int, names: tuple[str, ...]
) -> None:
    run = rig.prepare()
    run.line.servos.registers[id_][name] = value
    result = run.replay.run()
    assert result.fault.cause == Cause.VERIFICATION
    check_message(result.fault.text, "1", *names)
    assert not run.goals()
    assert lines_with(run.replay.journal.log.lines, *names)


def test_a_supply_at_which_a_servo_goes_limp_is_refused_only_if_it_does(rig) -> None:
    """Bit 0 of the shutdown register says whether the voltage alert takes the torque."""
    for shutdown, refused in ((0x34, False), (0x35, True)):
        run = rig.prepare()
        run.line.servos.registers[1]["min_voltage"] = 110
        run.line.servos.registers[1]["shutdown"] = shutdown
        result = run.replay.run()
        assert (result.fault is not None) is refused
        (row,) = [row for row in result.limits if row.refused or row.differs]
        assert row.joint == "shoulder"
        assert row.cells[4] == ("11 to 16", "10.5 to 14")
        assert (bool(row.refused), bool(row.differs)) == (refused, not refused)
        assert lines_with(row.refused or row.differs, "11", "16 V")


@pytest.mark.parametrize(
    ("name", "value", "names"),
    [
        ("max_position", 2500, ("0", "2500")),
        ("velocity_limit", 110, ("2.64 rad/s",)),
        ("current_limit", 500, ("2.7 N m",)),
    ],
)
def test_a_difference_that_this_motion_does_not_meet_is_a_note(
    rig, name: str, value: int, names: tuple[str, ...]
) -> None:
    run = rig.prepare()
    run.line.servos.registers[1][name] = value
    result = run.replay.run()
    assert result.fault is None
    assert lines_with(run.replay.journal.log.lines, "shoulder (ID 1)", *names)


def test_servos_as_delivered_differ_in_nothing_and_are_shown(rig) -> None:
    run = rig.prepare()
    result = run.replay.run()
    assert [row.joint for row in result.limits] == ["shoulder", "elbow", "wheel"]
    assert not any(row.refused or row.differs for row in result.limits)
    lines = difference_lines(result.limits)
    assert len(lines) == 2 + 3
    # Ticks 0 and 4095 about the elbow's zero at 1900, whose sense is turned; 230 units of 0.229 rpm; 2047 of 3.36 mA.
    assert result.limits[1].cells[0] == ("-193 to 167", "-60 to 60")
    assert result.limits[2].cells[:3] == (("-", "-"), ("5.52", "5.00"), ("-", "1.8"))
    assert result.limits[0].cells[2:] == (("11.1", "6.0"), ("80", "65"), ("9.5 to 16", "10.5 to 14"))
    assert all(line in "\n".join(run.replay.journal.log.lines) for line in lines)


def test_needs_are_those_of_the_speed_and_of_the_extremes_between_samples(rig) -> None:
    shoulder, _, wheel = rig.motion(speed=0.5).needs()
    assert (shoulder.low, shoulder.high) == pytest.approx((-0.6, 0.6), abs=1e-6)
    assert shoulder.fastest == pytest.approx(1.2, abs=1e-3)
    assert wheel.fastest == pytest.approx(1.5, abs=1e-3)


def test_limits_scale_with_the_gear(write_map, rig) -> None:
    """Two turns of the servo to one of the joint: half the speed and angle, twice the torque."""
    servo_map = load_servo_map(
        write_map(("error: 0.2", "error: 0.2\n    gear: 1.5"), ("velocity: 3.0", "velocity: 2.5"))
    )
    run = rig.prepare()
    shoulder = servo_map.servos[0]
    row = compare_limits(shoulder, snapshot(run.replay.bus, shoulder), servo_map.safety, needs_of_map(shoulder))
    assert row.cells[0] == ("-120 to 120", "-60 to 60")
    own = run.line.servos.registers[1]["velocity_limit"] * 0.229 * 2 * math.pi / 60
    assert row.cells[1] == (f"{own / 1.5:.2f}", "2.50")
    assert row.cells[2] == ("16.7", "6.0")
