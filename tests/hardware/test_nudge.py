"""A nudge moves one joint a little and back, alone, and reports its direction."""

from __future__ import annotations

import io
import math
import re
import sys
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, raises

from dynsim import cli
from dynsim.cli import hardware
from dynsim.hardware import ports
from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.errors import ReplayAborted, ReplayInterrupted, ServoMapError, VerificationFailed
from dynsim.hardware.nudge import ANGLE, PAUSE, SPEED, nudge
from dynsim.hardware.replay.output import StopRequest
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import load_servo_map, write_into_map

from .conftest import Run


def nudged(run: Run, joint: str, **options):
    servo = next(servo for servo in run.map.servos if servo.joint == joint)
    return nudge(run.map, servo, run.replay.bus, run.clock, **{"live": True, **options})


@pytest.mark.parametrize(("joint", "sense"), [("shoulder", 1), ("elbow", -1), ("wheel", 1)])
def test_a_joint_goes_out_and_back_and_nobody_else_gets_torque(rig, joint: str, sense: int) -> None:
    run = rig.prepare()
    servos = run.line.servos
    before = servos.plant.position.copy()
    servo = next(servo for servo in run.map.servos if servo.joint == joint)
    result = nudged(run, joint)
    assert result.asked == pytest.approx(math.radians(3))
    assert result.moved == pytest.approx(result.asked, abs=0.01)
    assert result.ticks * sense > 0
    assert result.ticks * RAD_PER_TICK * sense == pytest.approx(result.moved, abs=RAD_PER_TICK)
    assert result.followed
    assert {id_ for _, id_, value in run.writes_of(64) if value and id_ != 254} == {servo.id}
    assert all(id_ == servo.id for _, id_, _ in run.goals())
    assert [servos.registers[id_]["torque_enable"] for id_ in run.map.ids] == [0, 0, 0]
    # Back within the lag of the wheel, which counts no angle; a position servo within the friction of its gear.
    assert servos.plant.position == pytest.approx(before, abs=0.01 if joint == "wheel" else 4 * RAD_PER_TICK)


def test_goals_of_a_nudge_are_slow(rig) -> None:
    run = rig.prepare()
    nudged(run, "elbow")
    times, ticks = np.array([(time, value) for time, _, value in run.goals()]).T
    slope = np.abs(ticks[20:] - ticks[:-20]) * RAD_PER_TICK / (times[20:] - times[:-20])
    assert 0.8 * SPEED < slope.max() <= SPEED + RAD_PER_TICK / 0.19
    # 1.875 times as long as at the top speed, twice, and the pause.
    assert np.ptp(times[ticks != ticks[0]]) == pytest.approx(2 * 1.875 * ANGLE / SPEED + PAUSE, abs=0.4)


def test_at_its_upper_limit_a_joint_goes_the_other_way(rig) -> None:
    run = rig.prepare()
    run.line.servos.plant.position[0] += math.radians(59) - 0.1
    result = nudged(run, "shoulder")
    assert result.asked == pytest.approx(-math.radians(3))
    assert result.followed
    assert result.ticks < 0


def test_without_live_nothing_moves(rig) -> None:
    run = rig.prepare()
    assert nudged(run, "shoulder", live=False) is None
    assert not run.goals()
    assert not [value for _, _, value in run.writes_of(64) if value]


def test_a_robot_that_is_held_is_not_nudged(rig) -> None:
    """The nudge ends with a broadcast torque off: what another run left holding would fall."""
    run = rig.prepare()
    run.line.servos.write(2, 64, b"\1")
    with raises(VerificationFailed, "elbow (ID 2)", "dynsim hw stop"):
        nudged(run, "shoulder")
    assert run.line.servos.registers[2]["torque_enable"] == 1
    run.line.servos.dead.add(7)
    run.line.servos.write(2, 64, b"\0")
    with raises(VerificationFailed, "wheel", "ID 7"):
        nudged(run, "shoulder")


def test_a_joint_held_fast_is_let_go_before_the_nudge_is_at_its_end(rig) -> None:
    """The map's own bound of 0.2 rad would never be reached."""
    run = rig.prepare({"kind": "stuck", "id": 1})
    with raises(ReplayAborted, "shoulder", Cause.FOLLOWING_ERROR, "REPLAY"):
        nudged(run, "shoulder")
    furthest = max(abs(run.map.servos[0].to_angle(value) - 0.1) for _, _, value in run.goals())
    assert furthest < 0.9 * ANGLE
    assert run.line.servos.registers[1]["torque_enable"] == 0


def test_a_wheel_held_fast_did_not_follow(rig) -> None:
    run = rig.prepare({"kind": "stuck", "id": 7})
    assert not nudged(run, "wheel").followed


def test_ctrl_c_leaves_the_joint_limp(rig) -> None:
    class Late(StopRequest):
        def check(self) -> None:
            if run.goals() and run.clock.now() - run.goals()[0][0] > 0.6:
                self.count = 1
            super().check()

    run = rig.prepare()
    with raises(ReplayInterrupted, "shoulder", "interrupted", "REPLAY"):
        nudged(run, "shoulder", stop=Late())
    assert run.line.servos.registers[1]["torque_enable"] == 0


def test_signs_of_swapped_joints_are_written_and_limits_that_turn_with_them_are_looked_at(write_map) -> None:
    path = write_map(("id: 7}", "id: 7}  # left"))
    servo_map = load_servo_map(path)
    write_into_map(servo_map, "sign", {"elbow": 1, "wheel": -1}, path)
    again = load_servo_map(path)
    assert [servo.sign for servo in again.servos] == [1, 1, -1]
    assert [servo.zero_tick for servo in again.servos] == [2048, 1900, 2048]
    assert "# left" in path.read_text(encoding="utf-8")
    lopsided = write_map(("zero_tick: 1900", "zero_tick: 3900"), ("[-60, 60]", "[-10, 160]"))
    with raises(ServoMapError, "elbow", "1", "3900", "3786", "5720", "0", "4095"):
        write_into_map(load_servo_map(lopsided), "sign", {"elbow": 1}, lopsided)


@pytest.fixture
def answering(monkeypatch, capsys):
    """Run a command line with these answers on its standard input; (exit code, stdout, stderr)."""

    def run(answers: str, *arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["dynsim", *map(str, arguments)])
        monkeypatch.setattr(sys, "stdin", io.StringIO(answers))
        with pytest.raises(SystemExit) as leaving:
            cli.main()
        output = capsys.readouterr()
        return int(leaving.value.code or 0), output.out, output.err

    return run


@pytest.mark.long
def test_the_command_asks_about_each_joint_and_writes_on_request(answering, write_map) -> None:
    path = write_map()
    command = ("hw", "calibrate", "--map", path, "--port", "virtual", "--nudge")
    code, out, _ = answering("", *command, "--yes")
    assert code == 0
    moved = re.findall(r"^(\w+) \(ID \d\): ([+-]\d\.\d)", out, re.MULTILINE)
    assert [joint for joint, _ in moved] == ["shoulder", "elbow", "wheel"]
    # The friction of the gear costs up to 0.24°.
    assert all(2.7 <= float(angle) <= 3.1 for _, angle in moved)
    code, out, _ = answering("y\nagain\nperhaps\nn\ny\nn\n", *command)
    assert code == 0
    assert len(re.findall(r"elbow \(ID 2\): \+[23]", out)) == 2
    assert lines_with(out, "elbow", re.compile(r"\b1$"))
    assert load_servo_map(path).servos[1].sign == -1, "not without a yes"
    code, out, _ = answering("n\n", *command, "--joint", "elbow", "--write")
    assert code == 0
    assert "shoulder" not in out
    assert [servo.sign for servo in load_servo_map(path).servos] == [1, 1, 1]
    code, _, error = answering("", *command)
    assert code == 130
    assert mentions(error, "shoulder")


def test_options_of_the_nudge_are_nothing_for_zero_ticks(answering, write_map) -> None:
    code, _, error = answering("", "hw", "calibrate", "--map", write_map(), "--port", "virtual", "--live")
    assert code == 2
    assert mentions(error, "--live", "--nudge")
    code, _, error = answering("", "hw", "calibrate", "--map", "arm", "--port", "virtual", "--nudge", "--write")
    assert code == 2
    assert mentions(error, "--out")


@pytest.fixture
def on_the_rig(rig, monkeypatch) -> Run:
    """A port that is real to the commands, with the rig's servos behind it."""
    run = rig.prepare()

    @contextmanager
    def bus_on(port, servo_map):
        yield run.replay.bus, run.clock

    monkeypatch.setattr(ports, "bus_on", bus_on)
    return run


def test_on_a_real_port_nothing_is_nudged_without_live_or_without_a_yes(on_the_rig, answering, write_map) -> None:
    run = on_the_rig
    command = ("hw", "calibrate", "--map", write_map(), "--port", "/dev/ttyRobot", "--nudge")
    code, out, _ = answering("", *command)
    assert code == 0
    assert mentions(out, "--live")
    assert len(lines_with(out, re.compile(r"\(ID \d\): "))) == 3
    code, out, error = answering("n\n", *command, "--live")
    assert code == 130
    check_message(error, re.compile("^error: "))
    assert not run.goals()
    code, out, _ = answering("y\ny\n", *command, "--live", "--joint", "elbow")
    assert code == 0
    assert mentions(out, "y/N")
    assert {id_ for _, id_, _ in run.goals()} == {2}


@pytest.mark.parametrize(
    ("far", "asked", "answers", "agreed"),
    [
        (False, True, "y\n", True),
        (False, True, "n\n", False),
        (False, False, "", True),
        (True, True, "y\ny\n", True),
        (True, True, "y\nn\n", False),
        (True, False, "y\n", True),
        (True, False, "", False),  # nobody is there to look whether the way is free
    ],
)
def test_a_replay_asks_with_the_way_to_its_start_and_again_where_it_is_far(
    on_the_rig, rig, monkeypatch, capsys, far: bool, asked: bool, answers: str, agreed: bool
) -> None:
    run = on_the_rig
    if far:
        run.line.servos.plant.position[0] += 0.8
    monkeypatch.setattr(sys, "stdin", io.StringIO(answers))
    motion = rig.motion()
    with nullcontext() if agreed else raises(ReplayInterrupted):
        hardware.confirm_replay(rig.map, motion, "/dev/ttyRobot", asked=asked)
    out = capsys.readouterr().out
    now, start = (0.9 if far else 0.1), motion.path.position[0][0]
    assert lines_with(out, "shoulder", f"{abs(now - start):.3f} rad")
    assert mentions(out, f"{1.875 * abs(now - start) / 0.3:.1f} s")
    assert mentions(out, "safety.start_distance = 0.5 rad") is (far and (not asked or answers[0] == "y"))
    assert ("--yes" in out) is (far and not asked)


def test_who_does_not_answer_is_named_before_anything_is_asked(on_the_rig, rig) -> None:
    on_the_rig.line.servos.dead.add(2)
    with raises(VerificationFailed, "elbow (ID 2)"):
        hardware.confirm_replay(rig.map, rig.motion(), "/dev/ttyRobot", asked=True)
