"""End states of a replay: the reported state of the servos is the actual one."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, says

from dynsim.hardware.bus.packet import Instruction, Packet
from dynsim.hardware.errors import ReplayAborted
from dynsim.hardware.replay.output import LIMP, SILENT, ReplayState, ServoEnd, StopRequest, robot_state
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.session import run_replay
from dynsim.hardware.servo_map import load_servo_map

from .conftest import Rig, Run

pytestmark = pytest.mark.long

POLICIES = ["hold", "decelerate", "off"]
OFF = {"hold": "holding", "decelerate": "holding", "off": "off"}
HEARD = {"hold": "holding", "decelerate": "holding", "off": LIMP}


def doing(run: Run) -> dict[str, str]:
    return {servo.joint: servo.doing for servo in run.result.servos}


def check_against_the_servos(run: Run) -> None:
    """Torque, error and speed reported are those of the servos; a servo reported as silent cannot be reached."""
    servos = run.line.servos
    for end in run.result.servos:
        registers, index = servos.registers[end.id], servos.ids.index(end.id)
        if end.doing == SILENT:
            assert run.line.servos.unplugged or end.id in servos.dead
            continue
        assert end.torque == bool(registers["torque_enable"])
        assert end.error == registers["hardware_error"]
        assert end.torque == (not end.doing.startswith("limp"))
        if end.doing in ("holding", LIMP):
            assert registers["bus_watchdog"] == 0
        if end.doing == "holding":
            assert abs(servos.plant.velocity[index]) < 0.15


def at_cycle(run: Run, state: ReplayState, number: int, act: Callable[[], object]) -> None:
    """Do something while the ``number``-th request for states of a state is on the line."""
    seen = 0

    def listen(time: float, packet: Packet) -> None:
        nonlocal seen
        run.sent.append((time, packet))
        if (
            run.replay.journal.state == state
            and packet.instruction == Instruction.SYNC_READ
            and len(packet.parameters) > 5
        ):
            seen += 1
            if seen == number:
                act()

    run.line.listener = listen


def stall(run: Run, duration: float = 1.02) -> Callable[[], None]:
    """This program does not run for a while."""
    return lambda: run.clock.sleep_until(run.clock.now() + duration)


def finish(run: Run) -> Run:
    run.result = run.replay.run()
    return run


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize(
    "state", [ReplayState.MOVE_TO_START, ReplayState.SETTLE, ReplayState.REPLAY], ids=lambda state: state.name
)
def test_a_stall_is_seen_in_every_state_and_nobody_is_sent_on(rig, state: ReplayState, policy: str) -> None:
    run = rig.prepare(policy=policy)
    at_cycle(run, state, 8, stall(run))
    result = finish(run).result
    assert result.fault.cause == Cause.STALL
    assert result.fault_state == state
    check_message(result.fault.text, re.compile(r"\b1\.0\d* s"), "0.20 s")
    assert result.end_state == OFF[policy]
    check_against_the_servos(run)
    # Where they stopped by themselves they stay: no goal of the path reaches them any more.
    stopped = run.line.servos.plant.position.copy()
    run.line.advance(run.line.time + 1.0)
    assert policy == "off" or np.abs(run.line.servos.plant.position - stopped).max() < 0.01
    declared = [(id_, value) for _, id_, value in result.policy_goals]
    assert [(id_, value) for time, id_, value in run.goals() if time > result.fault_time] == declared


def test_a_pause_shorter_than_the_watchdogs_is_no_stall(rig) -> None:
    run = rig.prepare()
    at_cycle(run, ReplayState.REPLAY, 30, stall(run, 0.15))
    result = finish(run).result
    assert result.fault is None
    assert result.end_state == "off"


def largest_steps(run: Run) -> dict[int, int]:
    """The largest step from goal to goal of every servo in position mode, by ID [ticks]."""
    ids = [servo.id for servo in run.map.servos if servo.in_position_mode]
    return {id_: max(abs(np.diff([value for _, goal_id, value in run.goals() if goal_id == id_]))) for id_ in ids}


@pytest.mark.parametrize("pause", [0.05, 0.1, 0.17])
@pytest.mark.parametrize("state", [ReplayState.MOVE_TO_START, ReplayState.REPLAY], ids=lambda state: state.name)
def test_after_a_pause_the_path_waits_and_no_goal_is_far(rig, clean_run: Run, state: ReplayState, pause: float) -> None:
    run = rig.prepare()
    at_cycle(run, state, 30, stall(run, pause))
    result = finish(run).result
    assert result.fault is None
    # Rounding to ticks: one more than where no cycle was skipped.
    before = largest_steps(clean_run)
    assert all(step <= before[id_] + 1 for id_, step in largest_steps(run).items())
    skipped = result.timing["skipped_cycles"] * run.replay.loop.period
    assert skipped >= pause - 2 * run.replay.loop.period
    assert result.timing["path_late_s"] == pytest.approx(skipped if state == ReplayState.REPLAY else 0.0)
    # No place of the path is left out, and it takes so much longer.
    times, straight = result.record["record_time"], clean_run.result.record["record_time"]
    on_path, planned = np.isfinite(times), np.isfinite(straight)
    np.testing.assert_allclose(np.unique(times[on_path]), np.unique(straight[planned]))
    reached = [record.time[np.flatnonzero(t == np.nanmax(t))[0]] for record, t in
               ((result.record, times), (clean_run.result.record, straight))]  # fmt: skip
    assert reached[0] - reached[1] == pytest.approx(result.timing["path_late_s"], abs=1e-3)


@pytest.mark.parametrize("number", [1, 5])
def test_after_a_pause_while_it_slows_down_no_goal_is_far(rig, clean_run: Run, number: int) -> None:
    run = rig.prepare({"kind": "overload", "id": 1, "at": 1.7}, policy="decelerate")
    at_cycle(run, ReplayState.FAULT, number, stall(run, 0.15))
    assert finish(run).result.fault.cause == Cause.ALERT
    assert largest_steps(run)[2] <= largest_steps(clean_run)[2] + 1


@pytest.mark.parametrize(("armed", "found_holding"), [(0, True), (1, True), (2, True), (1, False), (2, False)])
def test_who_is_stopped_by_another_program_while_arming_is_released(rig, armed: int, found_holding: bool) -> None:
    """`hw stop` after the torque of so many servos was switched on: those that came later had not heard of it."""
    run = rig.prepare()
    if found_holding:
        for id_ in run.map.ids:
            run.line.servos.write(id_, 64, b"\1")
    seen = 0

    def listen(time: float, packet: Packet) -> None:
        nonlocal seen
        run.sent.append((time, packet))
        if run.replay.journal.state != ReplayState.ARM or packet.instruction != Instruction.WRITE:
            return
        address = int.from_bytes(packet.parameters[:2], "little")
        seen += address == 64
        if seen == armed and address == 98:  # the watchdog of the next one is cleared
            for id_ in run.map.ids:
                run.line.servos.write(id_, 64, b"\0")

    run.line.listener = listen
    result = finish(run).result
    assert result.fault.cause == Cause.TORQUE_LOST
    assert result.fault_state == ReplayState.ARM
    check_message(result.fault.text, re.compile(r"\(ID \d\)"))
    assert result.end_state == "off"
    check_against_the_servos(run)
    assert not [packet for _, packet in run.sent if packet.instruction == Instruction.SYNC_WRITE]


SECOND = {
    "drop_off": SILENT,
    "overload": "limp: overload",
    "overheat": "limp: overheating",
    "reboot": LIMP,
}


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("kind", SECOND)
@pytest.mark.parametrize("onset", [pytest.param(0.5, marks=pytest.mark.long), 1.7], ids=["MOVE_TO_START", "REPLAY"])
def test_a_second_fault_on_the_way_is_named_and_shows(rig, onset: float, kind: str, policy: str) -> None:
    """One servo overloads, and 80 ms later, while the others slow down, another one fails."""
    first = {"kind": "overload", "id": 1, "at": onset}
    run = rig.run(first, {"kind": kind, "id": 2, "at": onset + 0.08}, policy=policy)
    result = run.result
    assert result.fault.cause == Cause.ALERT
    assert doing(run)["shoulder"] == "limp: overload"
    assert doing(run)["wheel"] == HEARD[policy]
    check_against_the_servos(run)
    if policy == "off":
        return  # it was over before
    assert doing(run)["elbow"] == SECOND[kind]
    assert "elbow (ID 2)" in result.fault_text
    assert "shoulder (ID 1)" in result.fault_text
    assert {id_ for fault in result.faults for id_ in fault.ids} == {1, 2}
    if policy == "decelerate":
        # It was told to stop when it was found, once, and not to slow down with the others any more.
        named_at = (
            next(fault for fault in result.faults if 2 in fault.ids).time if kind == "drop_off" else result.fault_time
        )
        later = [time for time, id_, _ in result.policy_goals if id_ == 2 and time >= named_at]
        wheel = [time for time, id_, _ in result.policy_goals if id_ == 7]
        assert max(later) < max(wheel)


def test_faults_of_one_cycle_are_all_named(rig) -> None:
    faults = [{"kind": "overload", "id": 1, "at": 1.7}, {"kind": "overheat", "id": 2, "at": 1.7}]
    run = rig.run(*faults, {"kind": "drop_off", "id": 7, "at": 1.7})
    for name in ("shoulder (ID 1)", "elbow (ID 2)", "wheel (ID 7)"):
        assert name in run.result.fault_text
    assert run.result.end_state == f"mixed: shoulder limp: overload; elbow limp: overheating; wheel {SILENT}"
    summary = run.result.record.summary
    assert [fault["cause"] for fault in summary["faults"]] == [fault.cause for fault in run.result.faults]
    assert [event.name for event in run.result.record.events if event.kind == "fault"] == [
        fault.cause for fault in run.result.faults
    ]


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("onset", [0.5, 1.7, 2.5], ids=["MOVE_TO_START", "REPLAY", "end of REPLAY"])
def test_a_lost_supply_leaves_all_limp_and_is_noticed(rig, onset: float, policy: str) -> None:
    run = rig.run({"kind": "supply_loss", "at": onset}, policy=policy)
    result = run.result
    assert result.fault.cause == Cause.MISSED_STATUS
    assert says(result.fault.text, "all silent")
    assert result.end_state == "off"
    assert set(doing(run).values()) == {LIMP}
    check_against_the_servos(run)
    if policy != "off":
        assert Cause.TORQUE_LOST in [fault.cause for fault in result.faults]


def test_a_supply_lost_while_slowing_down_is_noticed(rig) -> None:
    run = rig.run({"kind": "drop_off", "id": 1, "at": 1.7}, {"kind": "supply_loss", "at": 1.85}, policy="decelerate")
    assert says(run.result.fault_text, "all silent")
    assert run.result.end_state == f"mixed: 2 {LIMP}; shoulder {SILENT}"
    check_against_the_servos(run)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_stop_by_another_program_is_named(rig, policy: str) -> None:
    run = rig.prepare(policy=policy)
    at_cycle(run, ReplayState.REPLAY, 40, lambda: [run.line.servos.write(id_, 64, b"\0") for id_ in run.map.ids])
    result = finish(run).result
    assert result.fault.cause == Cause.TORQUE_LOST
    check_message(result.fault.text, re.compile(r"\(ID \d\)"))
    assert result.end_state == "off"
    check_against_the_servos(run)
    assert not [time for time, _, value in run.writes_of(64) if value == 1 and time > result.fault_time]


@pytest.mark.parametrize("policy", ["hold", "decelerate"])
def test_a_port_that_dies_during_the_policy_is_named(rig, policy: str) -> None:
    run = rig.run({"kind": "drop_off", "id": 1, "at": 1.7}, {"kind": "unplug", "at": 1.8}, policy=policy)
    assert [fault.cause for fault in run.result.faults] == [Cause.MISSED_STATUS, Cause.PORT]
    assert run.result.end_state == "unreachable"
    assert set(doing(run).values()) == {SILENT}


@pytest.mark.parametrize("number", [2, 15, 40])
def test_a_stall_during_the_policy_is_named(rig, number: int) -> None:
    run = rig.prepare({"kind": "overload", "id": 1, "at": 1.7}, policy="decelerate")
    at_cycle(run, ReplayState.FAULT, number, stall(run))
    result = finish(run).result
    assert [fault.cause for fault in result.faults][:2] == [Cause.ALERT, Cause.STALL]
    assert result.end_state == "mixed: 2 holding; shoulder limp: overload"
    check_against_the_servos(run)


def test_an_error_within_the_policy_falls_back_to_holding(rig) -> None:
    run = rig.prepare({"kind": "overload", "id": 1, "at": 1.7}, policy="decelerate")

    def at(time: float) -> Any:
        raise ZeroDivisionError

    at_cycle(run, ReplayState.REPLAY, 10**9, lambda: None)
    after_fault = run.replay._ending.after_fault

    def broken(*arguments: Any, **options: Any) -> None:
        run.replay.loop.course.at = at
        after_fault(*arguments, **options)

    run.replay._ending.after_fault = broken
    result = finish(run).result
    assert [fault.cause for fault in result.faults] == [Cause.ALERT, Cause.PROGRAM]
    assert result.end_state == "mixed: 2 holding; shoulder limp: overload"
    run.line.advance(run.line.time + 1.0)
    assert np.abs(run.line.servos.plant.velocity).max() < 1e-2


def test_a_regular_end_that_did_not_come_about_is_a_fault(write_map) -> None:
    rig = Rig(load_servo_map(write_map(('at_end: "off"', 'at_end: "hold"'))))
    run = rig.prepare()
    at_cycle(run, ReplayState.DISARM, 1, lambda: run.line.servos.raise_error(1, 1 << 5))
    result = finish(run).result
    assert result.fault.cause == Cause.END_STATE
    assert result.end_state == "mixed: 2 holding; elbow limp: overload"
    assert not result.record.complete
    check_against_the_servos(run)


def test_a_second_ctrl_c_comes_too_late_for_nothing(rig) -> None:
    """While states are read back for the result, torque off is still what the user gets."""
    stop = StopRequest()
    run = rig.prepare({"kind": "overload", "id": 1, "at": 1.7}, stop=stop)
    read_back = run.replay._ending.read_back

    def reading(**options: Any) -> None:
        read_back(**options)
        if not stop.count:
            stop()
            stop()

    run.replay._ending.read_back = reading
    result = finish(run).result
    assert result.end_state == "off" or result.end_state == f"mixed: 2 {LIMP}; shoulder limp: overload"
    assert not any(servo["torque_enable"] for servo in run.line.servos.registers.values())


def test_log_error_and_summary_say_what_each_servo_does(rig, tmp_path) -> None:
    run = rig.prepare({"kind": "overload", "id": 2, "at": 1.7})
    connection = nullcontext((run.replay.bus, run.clock))
    with pytest.raises(ReplayAborted) as aborted:
        run_replay(rig.motion(), rig.map, connection, tmp_path, live=True)
    assert mentions(aborted.value, "mixed: 2 holding; elbow limp: overload")
    assert aborted.value.exit_code == 4
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["end_state"] == "mixed: 2 holding; elbow limp: overload"
    assert [(servo["joint"], servo["doing"]) for servo in summary["servos"]] == [
        ("shoulder", "holding"), ("elbow", "limp: overload"), ("wheel", "holding"),
    ]  # fmt: skip
    elbow = summary["servos"][1]
    assert (elbow["torque"], elbow["error"]) == (False, 32)
    assert isinstance(elbow["position_rad"], float)
    log = (tmp_path / "replay.log").read_text(encoding="utf-8")
    assert mentions(log, "mixed: 2 holding; elbow limp: overload")
    assert lines_with(log, "elbow (ID 2)", "limp: overload")


def test_what_the_whole_does() -> None:
    def whole(*doings: str) -> str:
        return robot_state([ServoEnd(f"j{k}", k, doing=doing) for k, doing in enumerate(doings)])

    assert whole("holding", "holding") == "holding"
    assert whole(LIMP, LIMP) == "off"
    assert whole(SILENT, SILENT) == "unreachable"
    assert whole("limp: input voltage", "limp: input voltage") == "limp: input voltage"
    assert whole("moving", "holding", "holding") == "mixed: 2 holding; j0 moving"
    assert whole("moving", "holding") == "mixed: j0 moving; j1 holding"
