"""Study: final state after every fault under every policy in every state of a replay, on virtual servos.

    PYTHONPATH=tests python -m studies.fault_table --runs 100 --out results/reference/bridge_faults.json

prints the table of docs/hardware/faults.md. A cell is a fault, the state of the replay in which it strikes, and a
policy; its runs differ in their seed: servo, time, and random parts of the fault. Each run is checked against the bytes
on the line and the registers: after the fault only the policy sends goals, no torque is switched on, and the servos are
in the reported state.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import numpy as np

from dynsim._version import __version__
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus
from dynsim.hardware.bus.packet import Instruction, Packet
from dynsim.hardware.bus.protocol import VirtualClock
from dynsim.hardware.replay.check import CheckedMotion, check_motion
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.output import SILENT, ReplayProgress, ReplayResult, ReplayState, StopRequest
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.trajectory import path_of_record
from dynsim.hardware.servo_map import FaultPolicy, ServoMap, load_servo_map
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.line import VirtualLine, VirtualPort, line_for_map
from dynsim.record import Record
from dynsim.system.files import write_json

MAP = """\
robot: rig
bus: {baud: 1000000, rate: 100}
safety: {policy: decelerate, at_end: "off", run_up: 20, supply: {lowest: 10.5, highest: 14.0}}
kinds:
  joint:
    model: MX-106
    mode: position
    follows: {position: q, velocity: v}
    limits: {position_deg: [-60, 60], velocity: 3.0, torque: 6.0}
    following_error: 0.2
  wheel:
    model: MX-28
    mode: velocity
    follows: {position: rho, velocity: rho_dot}
    limits: {velocity: 5.0, torque: 1.8}
    following_error: 1.0
servos:
  shoulder: {kind: joint, id: 1}
  elbow: {kind: joint, id: 2, sign: -1, zero_tick: 1900}
  wheel: {kind: wheel, id: 7}
"""
"""A small robot: two joints and a wheel."""
JOINTS, ANY = (1, 2), (1, 2, 7)
GOAL_ADDRESSES = (104, 116)
TORQUE_ADDRESS = 64
STOPPING = "stopping"
"""While the robot slows down after a Ctrl-C."""
STATES = (ReplayState.MOVE_TO_START.name, ReplayState.REPLAY.name, STOPPING)
POLICIES: tuple[FaultPolicy, ...] = get_args(FaultPolicy)


@dataclass(frozen=True)
class Case:
    """One fault: its script entry, the servos that it may strike, and the rules that detect it (none: no effect).

    Attributes
    ----------
    visible_after : float
        Time from its onset until a rule can detect it [s].
    """

    name: str
    entry: dict[str, Any]
    ids: tuple[int, ...] = ()
    causes: tuple[Cause, ...] = ()
    visible_after: float = 0.0

    @property
    def scripted_onset(self) -> bool:
        """False for a fault that exists from the start and is detected before anything moves."""
        return self.causes != (Cause.VERIFICATION,)


CASES = (
    Case("lost_status, now and then", {"kind": "lost_status", "probability": 0.01}, ANY),
    Case("lost_status, for good", {"kind": "lost_status"}, ANY, (Cause.MISSED_STATUS,)),
    Case("late_status", {"kind": "late_status", "delay": 0.005}, ANY, (Cause.MISSED_STATUS,)),
    Case("late_status, by whole periods", {"kind": "late_status", "delay": 0.04}, ANY, (Cause.MISSED_STATUS,)),
    Case("truncated_status", {"kind": "truncated_status"}, ANY, (Cause.MISSED_STATUS,)),
    Case("bad_crc", {"kind": "bad_crc"}, ANY, (Cause.MISSED_STATUS,)),
    Case("noise", {"kind": "noise"}),
    Case("echo", {"kind": "echo"}),
    Case("duplicate_id", {"kind": "duplicate_id"}, ANY, (Cause.VERIFICATION,)),
    Case("unplug", {"kind": "unplug"}, (), (Cause.PORT,)),
    Case("drop_off", {"kind": "drop_off"}, ANY, (Cause.MISSED_STATUS,)),
    Case("reboot", {"kind": "reboot"}, ANY, (Cause.MISSED_STATUS,)),
    Case("wrong_model", {"kind": "wrong_model", "value": 12}, ANY, (Cause.VERIFICATION,)),
    Case("wrong_firmware", {"kind": "wrong_firmware", "value": 38}, ANY, (Cause.VERIFICATION,)),
    Case("wrong_mode", {"kind": "wrong_mode", "value": 16}, ANY, (Cause.VERIFICATION,)),
    Case("overload", {"kind": "overload"}, ANY, (Cause.ALERT,)),
    Case("overheat", {"kind": "overheat"}, ANY, (Cause.ALERT,)),
    Case("watchdog_trip", {"kind": "watchdog_trip"}, ANY, (Cause.WATCHDOG, Cause.FOLLOWING_ERROR)),
    # A joint that sticks with a small error pushes until its torque rule fires instead.
    Case("stuck", {"kind": "stuck"}, ANY, (Cause.FOLLOWING_ERROR, Cause.TORQUE)),
    Case("backlash", {"kind": "backlash", "angle": 0.02}, JOINTS),
    Case("offset_jump", {"kind": "offset_jump", "angle": 0.5}, JOINTS, (Cause.FOLLOWING_ERROR,)),
    Case("voltage_sag", {"kind": "voltage_sag", "drop": 2.0}, (), (Cause.VOLTAGE,)),
    Case("supply_loss", {"kind": "supply_loss"}, (), (Cause.MISSED_STATUS,)),
    Case("temperature_ramp", {"kind": "temperature_ramp", "heating_rate": 200.0}, ANY, (Cause.TEMPERATURE,), 0.1825),
)


def swing(duration: float = 1.2, rate: float = 200.0, amplitude: float = 0.6) -> Record:
    """Return a swing that is never stationary for long: angle 0.6 sin 4t, wheel at up to 3 rad/s."""
    time = np.arange(0.0, duration, 1 / rate)
    record = Record(time)
    angles = amplitude * np.stack([np.sin(4 * time), np.sin(4 * time + 0.5)], axis=1)
    rates = 4 * amplitude * np.stack([np.cos(4 * time), np.cos(4 * time + 0.5)], axis=1)
    record.add("q", angles, "rad", labels=("shoulder", "elbow"))
    record.add("v", rates, "rad/s", labels=("shoulder", "elbow"))
    record.add("rho", (3 / 4 * (1 - np.cos(4 * time)))[:, None], "rad", labels=("wheel",))
    record.add("rho_dot", (3 * np.sin(4 * time))[:, None], "rad/s", labels=("wheel",))
    return record


@dataclass
class Run:
    """One replay on the rig, with all packets sent."""

    replay: Replay
    result: ReplayResult
    line: VirtualLine
    clock: VirtualClock
    sent: list[tuple[float, Packet]]

    @property
    def map(self) -> ServoMap:
        return self.replay.map

    def goals(self) -> list[tuple[float, int, int]]:
        """Return (time, ID, value) of every goal on the wire."""
        return [entry for time, packet in self.sent for entry in goals_in(time, packet)]

    def writes_of(self, address: int) -> list[tuple[float, int, int]]:
        """Return (time, ID, value) of every byte written at ``address`` to one servo."""
        return [
            (time, packet.id, packet.parameters[2])
            for time, packet in self.sent
            if packet.instruction == Instruction.WRITE and int.from_bytes(packet.parameters[:2], "little") == address
        ]

    def started(self) -> float:
        """Clock time of the record's time 0 [s]."""
        loop = self.replay.loop
        return loop.origin if loop.path_started is None else loop.path_started


def goals_in(time: float, packet: Packet) -> list[tuple[float, int, int]]:
    """Return (time, ID, value) of the goals in a packet."""
    p = packet.parameters
    if packet.instruction == Instruction.SYNC_WRITE and int.from_bytes(p[:2], "little") in GOAL_ADDRESSES:
        return [(time, p[k], int.from_bytes(p[k + 1 : k + 5], "little", signed=True)) for k in range(4, len(p), 5)]
    if packet.instruction == Instruction.WRITE and int.from_bytes(p[:2], "little") in GOAL_ADDRESSES:
        return [(time, packet.id, int.from_bytes(p[2:6], "little", signed=True))]
    return []


@dataclass
class Rig:
    """Runner of replays on virtual servos."""

    map: ServoMap
    record: Record = field(default_factory=swing)
    posture: dict[str, float] = field(default_factory=lambda: {"shoulder": 0.1, "elbow": 0.2})

    def motion(self, **options: Any) -> CheckedMotion:
        return check_motion(self.record, self.map, **options)

    def prepare(
        self,
        *faults: dict[str, Any],
        seed: int = 0,
        motion: CheckedMotion | None = None,
        stop: StopRequest | None = None,
        plant: Any = None,
        **options: Any,
    ) -> Run:
        """Return a replay that has not begun, on separate servos."""
        sent: list[tuple[float, Packet]] = []
        clock = VirtualClock()
        line = line_for_map(
            self.map,
            script=FaultScript.model_validate({"seed": seed, "faults": list(faults)}),
            listener=lambda time, packet: sent.append((time, packet)),
            posture=self.posture,
            plant=plant,
        )
        port = VirtualPort(line, clock, baud=self.map.bus.baud)
        bus = DynamixelBus(port, latency=self.map.bus.latency, return_delay=self.map.bus.return_delay)
        replay = Replay(motion or self.motion(), self.map, bus, clock, stop=stop or StopRequest(), **options)
        return Run(replay, replay.result, line, clock, sent)

    def run(self, *faults: dict[str, Any], **options: Any) -> Run:
        """Run a complete replay."""
        run = self.prepare(*faults, **options)
        run.result = run.replay.run()
        return run


@lru_cache(maxsize=1)
def rig() -> Rig:
    """Return the rig with the small robot, on a short path and at half rate, because there are thousands of runs."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rig.yaml")
        path.write_text(MAP.replace("rate: 100", "rate: 50"), encoding="utf-8")
        servo_map, record = load_servo_map(path), swing(0.3)
    start = path_of_record(record, servo_map).position[0]
    return Rig(servo_map, record, {"shoulder": float(start[0]) + 0.04, "elbow": float(start[1]) - 0.03})


@dataclass(frozen=True)
class Outcome:
    """Ending of one run.

    Attributes
    ----------
    end : str
        Final behaviour read from the servos: first the struck ones, then the others.
    cycles : int or None
        Cycles from the onset of the fault to the rule that declared it; None if no rule did.
    goals, packets : int
        Packets with goals, and all others, sent after it was declared.
    text : str
        Message to the user.
    broken : tuple of str
        Violated requirements.
    """

    end: str
    cycles: int | None
    goals: int
    packets: int
    text: str
    broken: tuple[str, ...]


@lru_cache(maxsize=1)
def spans() -> dict[str, tuple[float, float]]:
    """Return begin and end of each state without a fault [s after the first torque enable]."""
    run = rig().run()
    since = run.result.record.time + run.started() - run.line.servos.torque_since
    states = run.result.record["state"]
    ranges = {}
    for name in (ReplayState.MOVE_TO_START.name, ReplayState.REPLAY.name):
        times = since[states == ReplayState[name]]
        ranges[name] = float(times[0]), float(times[-1])
    return ranges


def strike(case: Case, state: str, policy: FaultPolicy, seed: int) -> Outcome:
    """Run once: a fault strikes some servos at some time within a state, all drawn from the seed."""
    draw = random.Random(f"{case.name}/{state}/{policy}/{seed}")
    entry, stop = dict(case.entry), StopRequest()
    if case.ids:
        entry["id"] = draw.choice(case.ids)
    asked = math.inf
    if case.scripted_onset:
        begin, end = spans()[ReplayState.REPLAY.name if state == STOPPING else state]
        entry["at"] = draw.uniform(begin, end)
        if state == STOPPING:
            asked = entry["at"] - draw.uniform(0.0, 0.8 * rig().map.safety.stop_time)
    run = rig().prepare(entry, seed=seed, policy=policy, stop=stop)

    def ask(_: ReplayProgress) -> None:
        if run.clock.now() - run.line.servos.torque_since >= asked and not stop.count:
            stop()

    run.replay.journal.observer = ask
    run.result = run.replay.run()
    return judge(run, case, entry)


def judge(run: Run, case: Case, entry: dict[str, Any]) -> Outcome:
    """Evaluate a run from its result, the wire and the servos."""
    result = run.result
    fault = next((fault for fault in result.faults if fault.cause in case.causes), None)
    cycles = None
    if fault is not None and case.scripted_onset:
        onset = run.line.servos.torque_since + entry["at"] + case.visible_after
        cycles = max(0, math.ceil((fault.time - onset) * run.map.bus.rate))
    after = [packet for time, packet in run.sent if time > result.fault_time]
    goals = sum(bool(goals_in(0.0, packet)) for packet in after)
    return Outcome(
        end=end_of(result, entry),
        cycles=cycles,
        goals=goals,
        packets=len(after) - goals,
        text=result.fault_text or "replayed",
        broken=tuple(broken_promises(run)),
    )


def end_of(result: ReplayResult, entry: dict[str, Any]) -> str:
    """Return the final behaviour without names: "struck: limp: overload, others: holding", or one for all."""
    if len({servo.doing for servo in result.servos}) <= 1 or "id" not in entry:
        return result.end_state
    struck = {servo.doing for servo in result.servos if servo.id == entry["id"]}
    others = {servo.doing for servo in result.servos if servo.id != entry["id"]}
    return f"{', '.join(sorted(struck))}; others {', '.join(sorted(others))}"


def broken_promises(run: Run) -> Iterator[str]:
    """Yield packets and reports that should not have been sent."""
    result, servos = run.result, run.line.servos
    on_the_wire = [(id_, value) for time, id_, value in run.goals() if time > result.fault_time]
    declared = [(id_, value) for _, id_, value in result.policy_goals]
    # The last declarations may not have reached the wire if the port failed meanwhile.
    if on_the_wire != declared[: len(on_the_wire)]:
        yield "a goal after the fault that was not the policy's"
    if [value for time, _, value in run.writes_of(TORQUE_ADDRESS) if time > result.fault_time and value]:
        yield "torque was switched on after the fault"
    for end in result.servos:
        registers = servos.registers[end.id]
        if end.doing == SILENT:
            continue
        if (end.torque, end.error) != (bool(registers["torque_enable"]), registers["hardware_error"]):
            yield f"{end.joint} is not as reported ({end.doing})"


@dataclass
class Cell:
    """Runs of one fault in one state under one policy."""

    case: str
    state: str
    policy: str
    outcomes: list[Outcome] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers for the reference; the text is from the first run."""
        seen = [outcome.cycles for outcome in self.outcomes if outcome.cycles is not None]
        return {
            "fault": self.case,
            "state": self.state,
            "policy": self.policy,
            "runs": len(self.outcomes),
            "ends": dict(Counter(outcome.end for outcome in self.outcomes).most_common()),
            "cycles_max": max(seen, default=None),
            "goal_packets_max": max(outcome.goals for outcome in self.outcomes),
            "other_packets_max": max(outcome.packets for outcome in self.outcomes),
            "text": self.outcomes[0].text,
            "broken": sorted({text for outcome in self.outcomes for text in outcome.broken}),
        }


def cells(runs: int, cases: Iterable[Case] = CASES, first: int = 0) -> Iterator[Cell]:
    """Yield all cells of these faults, with ``runs`` runs each, for the seeds from ``first`` on."""
    for case in cases:
        for state in STATES if case.scripted_onset else (ReplayState.VERIFY.name,):
            for policy in POLICIES:
                outcomes = [strike(case, state, policy, seed) for seed in range(first, first + runs)]
                yield Cell(case.name, state, policy, outcomes)


def _cells_of(job: tuple[Case, int]) -> list[dict[str, Any]]:
    case, runs = job
    return [cell.as_dict() for cell in cells(runs, [case])]


def markdown(table: list[dict[str, Any]]) -> str:
    """Return the table for the docs, with states of equal endings in one row."""
    lines = ["| fault | state | end: hold | end: decelerate | end: off | cycles | goals after it | the user reads |"]
    lines.append("|" + "---|" * 8)
    for case in dict.fromkeys(cell["fault"] for cell in table):
        groups: dict[tuple[str, ...], list[list[dict[str, Any]]]] = {}
        for state in dict.fromkeys(cell["state"] for cell in table if cell["fault"] == case):
            row = [cell for cell in table if (cell["fault"], cell["state"]) == (case, state)]
            groups.setdefault(tuple(_ends(cell) for cell in row), []).append(row)
        for ends, rows in groups.items():
            every = [cell for row in rows for cell in row]
            cycles = [cell["cycles_max"] for cell in every if cell["cycles_max"] is not None]
            states = ", ".join(row[0]["state"] for row in rows)
            text = next(
                (cell["text"] for cell in every if f"in {ReplayState.REPLAY.name}" in cell["text"]), every[0]["text"]
            )
            goals = "/".join(str(max(row[k]["goal_packets_max"] for row in rows)) for k in range(len(POLICIES)))
            lines.append(
                f"| `{case}` | {states} | {' | '.join(ends)} | {max(cycles) if cycles else '–'} | {goals} | "
                f"{text.splitlines()[0]} |"
            )
    return "\n".join(lines)


def _ends(cell: dict[str, Any]) -> str:
    ends = cell["ends"]
    if len(ends) == 1:
        return next(iter(ends))
    return "; ".join(f"{end} ({count} of {cell['runs']})" for end, count in ends.items())


def main() -> None:
    """Run the table, print it, and save it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="number of runs for each cell [100]")
    parser.add_argument("--out", type=Path, help="keep the numbers there (JSON)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes [all processors]")
    arguments = parser.parse_args()
    table = []
    with ProcessPoolExecutor(arguments.jobs) as pool:
        jobs = [(case, arguments.runs) for case in CASES]
        for done, row in enumerate(pool.map(_cells_of, jobs), start=1):
            table += row
            print(f"{done} of {len(CASES)} faults: {CASES[done - 1].name}", file=sys.stderr, flush=True)
            for cell in row:
                for text in cell["broken"]:
                    print(f"BROKEN: {cell['fault']} in {cell['state']}, {cell['policy']}: {text}")
    if arguments.out:
        write_json(arguments.out, {"version": __version__, "runs": arguments.runs, "cells": table})
    print(markdown(table))
    total = sum(cell["runs"] for cell in table)
    print(f"\n{total} runs, {sum(bool(cell['broken']) for cell in table)} cells with a broken promise")
    if any(cell["broken"] for cell in table):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
