"""Two servos on one axle, joints with more than one turn, servos with Protocol 1, and bounds with their origin."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.messages import raises

from dynsim import cli
from dynsim.errors import CheckRefused
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.imported import import_motion
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.replay.output import ReplayState
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import load_servo_map, mark_turns, read_zero_ticks, write_into_map
from dynsim.record import Record

from .conftest import Rig, check_goals_within_limits

MAP = """
robot: dual
bus: {baud: 1000000, rate: 50, latency: 0.002, return_delay: 0}
safety: {policy: hold, at_end: hold, watchdog: 0.5, supply: {lowest: 10.5, highest: 13.0}}
kinds:
  j:
    model: XM430-W350
    mode: position
    follows: {position: q, velocity: v}
    limits: {position_deg: [-100, 100], velocity: 4.0, torque: 1.2}
    following_error: 0.3
servos:
  pan: {kind: j, id: 1, sign: 1, zero_tick: 2048, pair: {id: 2, sign: -1, zero_tick: 2100}}
"""
TURNS = MAP.replace("mode: position", "mode: extended_position").replace("[-100, 100]", "[-30, 730]")
TURNS = TURNS[: TURNS.index(", pair")] + "}\n"


@pytest.fixture
def robot(tmp_path: Path) -> Callable[..., Rig]:
    """Return a rig for a map; its record turns the joint to an angle and back."""

    def build(text: str, angle: float = 0.8) -> Rig:
        path = tmp_path / "map.yaml"
        path.write_text(text, encoding="utf-8")
        time = np.arange(0.0, 4.0 + 1e-9, 0.02)
        record = Record(time)
        record.add("q", (angle * np.sin(np.pi * time / 4) ** 2)[:, None], "rad", labels=("pan",))
        record.add("v", (angle * np.pi / 4 * np.sin(np.pi * time / 2))[:, None], "rad/s", labels=("pan",))
        return Rig(load_servo_map(path), record, {"pan": 0.0})

    return build


def test_a_pair_moves_in_step(robot: Callable[..., Rig]) -> None:
    rig = robot(MAP)
    run = rig.run()
    assert run.result.fault is None
    assert run.result.end_state == "holding"
    check_goals_within_limits(run)
    goals: dict[int, list[int]] = {1: [], 2: []}
    for _, id_, value in run.goals():
        goals[id_].append(value)
    angles = [rig.map.servos[index].to_angle(max(goals[id_], key=abs)) for index, id_ in ((0, 1), (1, 2))]
    assert np.ptp(goals[1]) == np.ptp(goals[2]) == round(0.8 / (2 * np.pi / 4096))
    assert min(goals[2]) == 2100 - np.ptp(goals[2]), "the second servo turns the other way"
    assert len(angles) == 2
    record = run.result.record
    assert record.labels["q"] == ("pan",), "one column for the joint"
    assert record.labels["torque_estimate"] == ("pan", "pan.pair")
    assert record["q"].max() == pytest.approx(0.8, abs=0.01)


def test_a_recording_has_one_column_for_a_pair(robot: Callable[..., Rig], tmp_path: Path) -> None:
    rig = robot(MAP)
    ticks = [f"{time:.3f},{2048 + 500 * np.sin(np.pi * time / 4) ** 2:.0f}" for time in np.arange(0.0, 4.0, 0.02)]
    (tmp_path / "ticks.csv").write_text("\n".join(["time [s],pan [tick]", *ticks]) + "\n", encoding="utf-8")
    record, *_ = import_motion(tmp_path / "ticks.csv", rig.map)
    assert record.labels["q"] == ("pan",)
    assert record["q"].max() == pytest.approx(500 * 2 * np.pi / 4096, abs=2e-3)


def test_the_torque_limit_holds_for_each_servo_of_a_pair(robot: Callable[..., Rig]) -> None:
    rig = robot(MAP.replace("velocity: v}", "velocity: v, torque: torque}"))
    rig.record.add("torque", np.full((len(rig.record), 1), 2.0), "N m", labels=("pan",))
    (margin,) = [margin for margin in check_motion(rig.record, rig.map).margins if margin.quantity == "torque"]
    assert margin.value == pytest.approx(1.0)


@pytest.mark.parametrize("id_", [1, 2])
def test_servos_of_a_pair_that_differ_abort(robot: Callable[..., Rig], id_: int) -> None:
    run = robot(MAP).run({"kind": "offset_jump", "id": id_, "at": 2.5, "angle": 0.1})
    assert run.result.fault is not None
    assert run.result.fault.cause == Cause.PAIR
    assert run.result.fault.ids == (1, 2)
    assert run.result.fault_state == ReplayState.REPLAY
    assert run.result.end_state == "holding"
    # The rule counts cycles like the rule for the following error.
    onset = run.line.servos.torque_since + 2.5
    assert run.result.fault.time - onset <= (run.map.safety.following_cycles + 1) / run.map.bus.rate


def test_a_faulty_servo_stops_both_servos_of_its_pair(robot: Callable[..., Rig]) -> None:
    run = robot(MAP).run({"kind": "overload", "id": 2, "at": 2.5}, policy="decelerate")
    assert run.result.fault is not None
    assert run.result.fault.cause == Cause.ALERT
    after = [(id_, value) for _, id_, value in run.result.policy_goals if id_ == 1]
    assert len(set(after)) == 1, "the first servo stays where the second has stopped"


def test_a_pair_with_a_wrong_zero_is_refused(robot: Callable[..., Rig]) -> None:
    rig = robot(MAP)
    run = rig.prepare()
    run.line.servos.plant.position[1] += 0.2  # the horn sits elsewhere
    result = run.replay.run()
    assert result.fault is not None
    assert result.fault.cause == Cause.VERIFICATION
    assert all(word in result.fault.text for word in ("pan (ID 1), pan.pair (ID 2)", "differ by", "hw calibrate"))
    assert result.end_state == "not armed"


def test_zeros_of_a_pair_are_written_to_their_own_entries(robot: Callable[..., Rig], tmp_path: Path) -> None:
    rig = robot(MAP)
    run = rig.prepare()
    run.line.servos.plant.position[:] += np.array([0.05, 0.1])
    ticks = read_zero_ticks(run.replay.bus, rig.map.servos)
    write_into_map(rig.map, "zero_tick", ticks, tmp_path / "new.yaml")
    first, second = load_servo_map(tmp_path / "new.yaml").servos
    assert (first.zero_tick, second.zero_tick) == (2048 + 33, 2100 + 65)


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("pair: {id: 2", "pair: {id: 1", ["servos.pan.pair.id = 1", "also the ID of pan"]),
        ("zero_tick: 2100", "zero_tick: 9000", ["servos.pan.pair.zero_tick = 9000", "calibrate"]),
        ("zero_tick: 2100}}", "zero_tick: 2100, max_difference_deg: 90}}", ["max_difference_deg", "0.1 to 30"]),
        ("model: XM430-W350", "model: AX-12A", ["kinds.j.model", "Protocol 1", "Protocol 2.0"]),
        ("[-100, 100]", "[-300, 300]", ["limits.position_deg", "mode: extended_position"]),
    ],
)
def test_maps_with_mistakes_name_the_fix(robot: Callable[..., Rig], old: str, new: str, names: list[str]) -> None:
    assert old in MAP
    with raises(ServoMapError, *names):
        robot(MAP.replace(old, new))


def test_two_entries_for_one_column_hint_at_a_pair(robot: Callable[..., Rig]) -> None:
    with raises(ServoMapError, "servos.shadow.label", "servos.pan.pair: {id: 2}"):
        robot(MAP[: MAP.index(", pair")] + "}\n  shadow: {kind: j, id: 2, label: pan}\n")


# -- more than one turn ------------------------------------------------------------------------------------------------


def test_two_turns_are_replayed(robot: Callable[..., Rig]) -> None:
    run = robot(TURNS.replace("velocity: 4.0", "velocity: 4.8"), 6.0).run()
    assert run.result.fault is None
    check_goals_within_limits(run)
    assert max(value for _, _, value in run.goals()) == 2048 + round(6.0 / (2 * np.pi / 4096)) > 4095
    assert run.result.record["q"].max() == pytest.approx(6.0, abs=0.01)


@pytest.mark.parametrize("lost", ["restart", "another mode"])
def test_a_lost_count_of_turns_prevents_motion_until_calibration(robot: Callable[..., Rig], lost: str) -> None:
    rig = robot(TURNS, 1.0)
    run = rig.prepare(write_eeprom=True)
    servos, bus = run.line.servos, run.replay.bus
    if lost == "restart":
        servos.reboot(1)
        run.clock.sleep_until(1.0)
    else:
        servos.registers[1]["operating_mode"] = 3  # --configure changes it, and the servo may lose its turns
    result = run.replay.run()
    assert result.fault is not None
    assert result.fault.cause == Cause.VERIFICATION
    assert all(word in result.fault.text for word in ("turns", "zero posture", "hw calibrate --joint pan"))
    assert result.end_state == "not armed"
    # Calibration in the zero posture verifies the turn.
    mark_turns(bus, rig.map.servos)
    again = Rig(rig.map, rig.record, {"pan": 0.0}).prepare()
    assert again.replay.run().fault is None


def test_a_servo_that_restores_its_memory_is_refused(robot: Callable[..., Rig]) -> None:
    run = robot(TURNS, 1.0).prepare()
    run.line.servos.registers[1]["startup_configuration"] = 2
    fault = run.replay.run().fault
    assert fault is not None
    assert "address 60" in fault.text


# -- bounds -----------------------------------------------------------------------------------------------------------


def test_a_bound_names_tick_zero_and_line(robot: Callable[..., Rig]) -> None:
    text = MAP[: MAP.index(", pair")].replace("zero_tick: 2048", "zero_tick: 200") + "}\n"
    rig = robot(text, -0.5)
    with raises(CheckRefused, "tick 0, zero_tick 200", "end of the turn", "map.yaml:13: servos.pan"):
        check_motion(rig.record, rig.map)
    motion = check_motion(robot(text, 0.5).record, rig.map)
    assert any("tick 0, zero_tick 200" in warning for warning in motion.warnings)
    source = motion.margins[0].source
    assert source.startswith("tick 0, zero_tick 200, end of the turn in position mode, ")


@pytest.mark.parametrize(("joint", "code"), [("pan", 0), ("x", 2)])
def test_calibrate_accepts_names_of_joints(
    robot: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, joint: str, code: int
) -> None:
    robot(TURNS, 1.0)
    words = ["dynsim", "hw", "calibrate", "--map", str(tmp_path / "map.yaml"), "--port", "virtual", "--joint", joint]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert (ended.value.code or 0) == code


def test_a_jump_in_a_recorded_motion_is_refused(robot: Callable[..., Rig]) -> None:
    """A trajectory whose second point comes 10 ms after the first, half a radian away."""
    rig = robot(MAP)
    record = Record([0.0, 0.01, 1.0, 2.0])
    record.add("q", np.array([[-0.5], [0.0], [0.2], [0.2]]), "rad", labels=("pan",))
    record.add("v", np.zeros((4, 1)), "rad/s", labels=("pan",))
    with raises(CheckRefused, "pan: velocity", "75.0000 rad/s", "nothing was sent"):
        check_motion(record, rig.map)
