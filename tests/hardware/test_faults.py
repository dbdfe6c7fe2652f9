"""Scripted faults end as docs/hardware/faults.md states, in time; only the policy's goals are sent afterwards."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from studies.fault_table import CASES, POLICIES, Case, broken_promises

from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.bus.packet import Instruction
from dynsim.hardware.replay.check import velocity_limit
from dynsim.hardware.replay.output import LIMP, NOT_ARMED, SILENT, TRIPPED, ReplayState
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.trajectory import CyclePlan
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.servos import PHYSICS_STEP

from .conftest import check_goals_within_limits

pytestmark = pytest.mark.long

SILENCING = ("lost_status", "late_status", "truncated_status", "bad_crc", "drop_off")
"""Faults after which the struck servo cannot report its state."""
DISABLING = ("reboot", "overload", "overheat", "temperature_ramp")
"""Faults that switch off the torque of the struck servo, at once or after some time."""


def reaction_bound(cause: Cause, servo_map: ServoMap, plan: CyclePlan) -> int:
    """Cycles within which a rule declares its fault, counted from the first cycle that shows it."""
    safety = servo_map.safety
    in_turn = len(servo_map.servos) * plan.health_every
    return {
        Cause.MISSED_STATUS: safety.missed_cycles,
        Cause.FOLLOWING_ERROR: safety.following_cycles,
        Cause.TORQUE: safety.torque_cycles,
        Cause.DEADLINE: safety.late_cycles,
        Cause.ALERT: 1,
        Cause.TORQUE_LOST: in_turn,
        Cause.WATCHDOG: in_turn,
        Cause.VOLTAGE: in_turn,
        Cause.TEMPERATURE: in_turn,
    }.get(cause, 1)


def check_case(rig, case: Case, seed: int) -> None:
    """Strike somebody at some time under some policy, all drawn from the seed, and judge the end."""
    draw = random.Random(f"{case.name}/{seed}")
    entry, onset, policy = dict(case.entry), draw.uniform(0.1, 1.3), draw.choice(POLICIES)
    if case.ids:
        entry["id"] = draw.choice(case.ids)
    if case.scripted_onset:
        entry["at"] = onset
    run = rig.run(entry, seed=seed, policy=policy)
    result = run.result
    description = f"{case.name}, seed {seed}, {policy}: {result.fault_text}, {result.end_state}"
    check_goals_within_limits(run)
    if not case.causes:
        assert result.fault is None, description
        assert result.end_state == "off"
        assert not any(servo["torque_enable"] for servo in run.line.servos.registers.values())
        return
    assert result.fault is not None, description
    assert result.fault.cause in case.causes, description
    check_nothing_but_the_policy_after(run)
    check_end_state(run, policy, entry, description)
    if case.scripted_onset:
        # A fault strikes at the first physics step after its onset.
        check_reaction(run, run.line.servos.torque_since + onset + PHYSICS_STEP, case, description)


def check_nothing_but_the_policy_after(run) -> None:
    result = run.result
    assert list(broken_promises(run)) == []
    on_the_wire = [id_ for time, id_, _ in run.goals() if time > result.fault_time]
    if run.replay.policy == "hold" and result.fault.cause != Cause.WATCHDOG:
        assert len(set(on_the_wire)) == len(on_the_wire), "hold speaks once to every servo"
    if run.replay.policy == "off":
        assert not on_the_wire
    everybody = set(result.fault.ids) == set(run.map.ids)  # nobody is left to slow down along the path
    if run.replay.policy == "decelerate" and result.end_state not in (NOT_ARMED, "unreachable") and not everybody:
        check_comes_to_rest(run)


def check_comes_to_rest(run) -> None:
    """Steps of the decelerating goals never grow beyond rounding, and the last one is zero or a tick."""
    troubled = {id_ for fault in run.result.faults for id_ in fault.ids}
    assert len(run.result.policy_goals) > len(run.map.servos)
    for servo in run.map.servos:
        values = [value for _, id_, value in run.result.policy_goals if id_ == servo.id]
        if servo.id in troubled or len(values) < 3:
            continue
        if servo.in_position_mode:
            allowed = velocity_limit(servo) / run.map.bus.rate / RAD_PER_TICK + 1
            assert np.abs(np.diff(values)).max() <= allowed
            assert abs(values[-1] - values[-2]) <= 1
        else:
            assert values[-1] == 0
    last = max(time for time, id_, _ in run.result.policy_goals if id_ not in troubled)
    assert last - run.result.fault_time <= run.map.safety.stop_time + 10 / run.map.bus.rate


def check_end_state(run, policy: str, entry: dict[str, Any], description: str) -> None:
    end, line = run.result.end_state, run.line
    if run.result.fault.cause == Cause.VERIFICATION:
        assert end == NOT_ARMED, description
        assert not any(servo["torque_enable"] for servo in line.servos.registers.values())
        assert not run.goals()
        return
    if run.result.fault.cause == Cause.PORT:
        assert end == "unreachable", description
        line.advance(line.time + 2.0)
        # Nobody can be told anything: the servos' own watchdogs stop them.
        assert all(servo["bus_watchdog"] == -1 for servo in line.servos.registers.values())
        assert np.abs(line.servos.plant.velocity).max() < 1e-3
        return
    silent = {entry["id"]} if entry["kind"] in SILENCING else set()
    asked = LIMP if policy == "off" or entry["kind"] == "supply_loss" else "holding"
    check_what_was_read(run, silent, description)
    for servo in run.result.servos:
        if servo.id != entry.get("id"):
            assert servo.doing == asked, description
        elif silent:
            assert servo.doing == SILENT, description
        elif entry["kind"] not in DISABLING:
            assert servo.doing == asked, description
    doings = {servo.doing for servo in run.result.servos}
    assert end == ({"holding": "holding", LIMP: "off"}[asked] if doings == {asked} else end), description
    assert end.startswith("mixed: 2 ") == (len(doings) > 1), description
    if asked == LIMP:
        alive = [id_ for id_ in line.servos.ids if line.servos.registers[id_]["torque_enable"]]
        # The torque was taken from those too who cannot say so.
        assert not alive, description
        assert set(run.result.torque_still_on) == silent, description
        return
    line.advance(line.time + 2.0)
    assert np.abs(line.servos.plant.velocity).max() < 1e-2, description
    for id_, servo in line.servos.registers.items():
        if id_ == entry.get("id") and entry["kind"] in (*DISABLING, "drop_off"):
            continue
        assert servo["torque_enable"], description
        assert servo["bus_watchdog"] == 0, description


def check_what_was_read(run, silent: set[int], description: str) -> None:
    """The servos reported are the servos there are; that they are as reported is one of the kept promises."""
    servos = run.line.servos
    for servo, end in zip(run.map.servos, run.result.servos, strict=True):
        assert (end.joint, end.id) == (servo.joint, servo.id)
        if servo.id in silent:
            assert (end.torque, end.error, end.position, end.doing) == (None, None, None, SILENT), description
            continue
        index = servos.ids.index(servo.id)
        assert end.torque == (end.doing in ("holding", "moving", TRIPPED)), description
        speed = servo.sign * servos.plant.velocity[index]
        # Who is limp coasts to a halt while it is asked.
        assert not end.torque or abs(end.velocity - speed) < 0.05, description
        if end.doing == "holding":
            assert abs(speed) < 0.15, description
        if end.error and not end.torque:
            names = {1: "input voltage", 4: "overheating", 32: "overload"}
            assert end.doing == f"limp: {names[end.error]}", description


def check_reaction(run, onset: float, case: Case, description: str) -> None:
    """Cycles from the first that can show the fault to the one that declared it."""
    if run.result.fault.cause == Cause.PORT:
        # The transaction in which the port dies declares it.
        assert run.result.fault_time - onset <= 1.5 / run.map.bus.rate, description
        return
    record, plan = run.result.record, run.replay.motion.plan
    bound = reaction_bound(run.result.fault.cause, run.map, plan)
    before = record["state"] != ReplayState.FAULT
    if run.result.fault.cause in (Cause.FOLLOWING_ERROR, Cause.TORQUE):
        over = over_the_threshold(run)[before]
        run_length = len(over) if over.all() else int(np.argmin(over[::-1]))
        assert run_length == bound, f"{description}: {run_length} cycles, bound {bound}"
        return
    starts = (record.time + run.replay.loop.path_started)[before] if run.replay.loop.path_started else None
    if starts is None:
        starts = (record.time + run.replay.loop.origin)[before]
    cycles = int((starts >= onset + case.visible_after).sum())
    assert cycles <= bound, f"{description}: {cycles} cycles, bound {bound}"
    # No cycle at all only where the fault struck within the one that declared it: the clock says so too.
    assert onset <= run.result.fault_time <= onset + case.visible_after + (bound + 1) / run.map.bus.rate, description


def over_the_threshold(run) -> np.ndarray:
    """Cycles in which the servo that was blamed was beyond the limit of the rule that blamed it."""
    record, fault = run.result.record, run.result.fault
    column = run.map.ids.index(fault.ids[0])
    servo = run.map.servos[column]
    if fault.cause == Cause.TORQUE:
        return np.abs(record["torque_estimate"][:, column]) > servo.kind.limits.torque
    name = servo.kind.follows.position if servo.in_position_mode else servo.kind.follows.velocity
    at = record.labels[name].index(servo.joint)
    return np.abs(record[name + "_goal"][:, at] - record[name][:, at]) > servo.kind.following_error


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_fault_ends_as_specified(rig, case: Case) -> None:
    for seed in range(1):
        check_case(rig, case, seed)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_fault_ends_as_specified_in_100_of_100_runs(rig, case: Case) -> None:
    for seed in range(100):
        check_case(rig, case, seed)


def test_without_faults_the_replay_ends_off_with_nothing_missed_or_skipped(clean_run) -> None:
    run = clean_run
    assert run.result.fault is None
    assert run.result.end_state == "off"
    assert run.result.timing["missed_statuses"] == 0
    assert run.result.timing["skipped_cycles"] == 0


def test_every_listed_fault_has_a_case() -> None:
    from typing import get_args

    from dynsim.hardware.virtual import faults as virtual_faults

    kinds = {
        kind
        for member in get_args(get_args(virtual_faults.Fault)[0])
        for kind in get_args(member.model_fields["kind"].annotation)
    }
    assert kinds == {case.entry["kind"] for case in CASES}


def test_torque_taken_away_by_another_program_is_noticed_in_turn(rig) -> None:
    run = rig.prepare(policy="decelerate")

    def take_away(progress) -> None:
        if (
            progress.state == ReplayState.REPLAY
            and run.line.servos.registers[2]["torque_enable"]
            and run.clock.now() > 1.9
        ):
            run.line.servos.write(2, 64, b"\0")

    run.replay.journal.observer = take_away
    result = run.replay.run()
    assert result.fault.cause in (Cause.TORQUE_LOST, Cause.FOLLOWING_ERROR)
    assert result.end_state == f"mixed: 2 holding; elbow {LIMP}"
    assert not run.line.servos.registers[2]["torque_enable"], "nobody may switch it on again"


def test_overload_integrator_shuts_a_jammed_joint_down() -> None:
    """A joint pressed against a stop overloads after OVERLOAD_TIME; only a reboot brings it back."""
    from dynsim.hardware.bus.control_table import MX_106
    from dynsim.hardware.bus.packet import StatusError
    from dynsim.hardware.virtual.faults import FaultScript
    from dynsim.hardware.virtual.line import VirtualLine
    from dynsim.hardware.virtual.servos import ServoRegisters

    script = FaultScript.model_validate({"faults": [{"kind": "stuck", "id": 1, "at": 0.0}]})
    line = VirtualLine({1: ServoRegisters(MX_106, 1, 3)}, positions=[np.pi], script=script)
    line.servos.write(1, 64, b"\1")
    line.servos.write(1, 116, (3000).to_bytes(4, "little"))
    line.advance(0.9)
    assert line.servos.registers[1]["torque_enable"] == 1
    line.advance(1.5)
    assert line.servos.registers[1]["torque_enable"] == 0
    assert line.servos.registers[1]["hardware_error"] == 1 << 5
    assert line.servos.write(1, 64, b"\1") == StatusError.RESULT_FAIL
    line.servos.reboot(1)
    line.advance(3.0)
    assert line.servos.registers[1]["hardware_error"] == 0
    assert line.servos.write(1, 64, b"\1") == StatusError.NONE


def test_noise_is_never_read_as_a_state(rig, clean_run) -> None:
    """With noise before every status, what was read is what an undisturbed run reads."""
    clean, noisy = clean_run, rig.run({"kind": "noise"}, seed=3)
    assert noisy.result.fault is None
    assert noisy.result.timing["stray_bytes"] > 0
    rows = min(len(clean.result.record), len(noisy.result.record))
    difference = noisy.result.record["q"][:rows] - clean.result.record["q"][:rows]
    assert np.nanmax(np.abs(difference)) < 0.02
    assert Instruction.SYNC_READ in {packet.instruction for _, packet in noisy.sent}
