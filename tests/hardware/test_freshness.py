"""Late answers of servos: none is taken for the answer to a later request; length of requests after a missed answer."""

from __future__ import annotations

import random

import numpy as np
import pytest
from support.messages import check_message, says

from dynsim.hardware.bus.control_table import MX_106, RAD_PER_TICK, STATE_BLOCK
from dynsim.hardware.bus.dynamixel_bus import LATE_READS, DynamixelBus
from dynsim.hardware.bus.packet import Instruction
from dynsim.hardware.bus.protocol import NoAnswer, VirtualClock
from dynsim.hardware.replay.output import SILENT, ReplayState
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.line import VirtualPort, line_for_map

pytestmark = pytest.mark.long

F = MX_106.fields
PERIOD = 0.01
LENGTH = STATE_BLOCK[1]


@pytest.mark.parametrize("periods", [0.5, 1, 2, 3, 3.5, 4, 5, 8])
def test_a_late_servo_aborts_within_three_cycles(rig, periods: float) -> None:
    """Its answers come while those to later requests are awaited: whole periods late they look up to date."""
    run = rig.run({"kind": "late_status", "id": 2, "at": 1.7, "delay": periods * PERIOD})
    result = run.result
    assert result.fault.cause == Cause.MISSED_STATUS
    assert result.fault.ids == (2,)
    started = run.line.servos.torque_since + 1.7
    begun = run.replay.loop.path_started + result.record.time
    cycles = (begun >= started) & (result.record["state"] != ReplayState.FAULT)
    assert cycles.sum() <= run.map.safety.missed_cycles + 1
    missed = result.record["missed"][:, 1]
    assert missed[cycles][1:].all()
    # Not one of them counts later on, either, although they keep coming.
    assert missed[begun >= started + 3 * PERIOD].all()
    assert result.servos[1].doing == SILENT
    assert {servo.doing for servo in result.servos} == {"holding", SILENT}


def test_who_answers_too_late_is_told_from_who_does_not_answer(rig) -> None:
    late = rig.run({"kind": "late_status", "id": 2, "at": 1.7, "delay": PERIOD}).result.fault
    check_message(late.text, "elbow (ID 2)", phrase="late answers")
    silent = rig.run({"kind": "lost_status", "id": 2, "at": 1.7}).result.fault
    assert not says(silent.text, "late answers")


def test_what_is_measured_is_up_to_date_when_answers_are_late_now_and_then(rig, clean_run) -> None:
    """Every position read is where the servo was within the cycle, with one answer in twenty two periods late."""
    truth: list[tuple[float, float]] = []
    run = rig.prepare({"kind": "late_status", "id": 2, "probability": 0.05, "delay": 2 * PERIOD}, seed=3)
    run.line.listener = lambda time, _: truth.append((time, float(run.line.servos.plant.position[1])))
    result = run.replay.run()
    assert result.fault is None
    record, servo = result.record, run.map.servos[1]
    missed = record["missed"][:, 1]
    assert missed.sum() > 5
    times, angles = np.array(truth).T
    begun = run.replay.loop.path_started + record.time[~missed]
    measured = np.array([servo.to_ticks(angle) * RAD_PER_TICK for angle in record["q"][~missed, 1]])
    first, last = np.searchsorted(times, begun), np.searchsorted(times, begun + 0.7 * PERIOD)
    for angle, low, high in zip(measured, first, last, strict=True):
        within = angles[max(low - 1, 0) : high + 1]
        assert within.min() - 2 * RAD_PER_TICK <= angle <= within.max() + 2 * RAD_PER_TICK


def test_nothing_is_longer_on_the_wire_as_long_as_all_answer(clean_run) -> None:
    lengths = {
        int.from_bytes(packet.parameters[2:4], "little")
        for _, packet in clean_run.sent
        if packet.instruction == Instruction.SYNC_READ and packet.parameters[:2] == bytes([STATE_BLOCK[0], 0])
    }
    assert lengths == {LENGTH}


def test_requests_grow_after_a_miss_and_shrink_again(rig) -> None:
    clock, asked = VirtualClock(), []
    line = line_for_map(
        rig.map,
        script=FaultScript(),
        listener=lambda _, packet: asked.append(int.from_bytes(packet.parameters[2:4], "little")),
    )
    bus = DynamixelBus(VirtualPort(line, clock, baud=rig.map.bus.baud), latency=2e-3, return_delay=0.0)

    def read(times: int) -> list[int]:
        asked.clear()
        for _ in range(times):
            replies = bus.sync_read(rig.map.ids, *STATE_BLOCK).replies
            assert {len(reply.data) for reply in replies.values()} <= {LENGTH}
        return asked.copy()

    assert read(3) == [LENGTH] * 3
    line.servos.dead.add(2)
    assert read(LATE_READS + 1) == [LENGTH + k % LATE_READS for k in range(LATE_READS + 1)]
    line.servos.dead.clear()
    # The shortest that nobody owes an answer to.
    assert read(LATE_READS + 1) == [LENGTH + 1] * (LATE_READS - 1) + [LENGTH] * 2


@pytest.mark.parametrize("seed", range(20))
def test_a_late_answer_never_passes_for_that_to_another_single_read(rig, seed: int) -> None:
    """Items of one size, read one after the other from a servo whose answers come up to three time-outs late."""
    items = {"goal_velocity": 0, "profile_acceleration": 200, "profile_velocity": 300, "goal_position": 1900}
    line = line_for_map(rig.map)
    bus = DynamixelBus(VirtualPort(line, VirtualClock(), baud=rig.map.bus.baud), latency=2e-3, return_delay=0.0)
    for name, value in items.items():
        line.servos.write(2, F[name].address, F[name].encode(value))
    draw, transmit = random.Random(seed), line.transmit
    line.transmit = lambda *sent: [
        (arrival + (draw.uniform(0, 0.1) if draw.random() < 0.6 else 0.0), frame) for arrival, frame in transmit(*sent)
    ]
    heard = 0
    for _ in range(50):
        name = draw.choice(list(items))
        try:
            assert bus.read(2, F[name]) == items[name]
            heard += 1
        except NoAnswer:
            continue
    assert heard > 10
