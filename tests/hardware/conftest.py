"""A small rig for the hardware tests: two MX-106 joints and one MX-28 wheel on a virtual line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynsim.hardware.bus.clock import VirtualClock
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus
from dynsim.hardware.bus.packet import Instruction, Packet
from dynsim.hardware.replay.check import CheckedMotion, check_motion, velocity_limit
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.states import ReplayResult, StopRequest
from dynsim.hardware.servo_map import ServoMap, load_servo_map
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.line import VirtualLine, line_for_map
from dynsim.hardware.virtual.port import VirtualPort
from dynsim.record import Record

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
GOAL_ADDRESSES = (104, 116)
TORQUE_ADDRESS = 64


def swing(duration: float = 1.2, rate: float = 200.0, amplitude: float = 0.6) -> Record:
    """A swing that never stands still for long: angle 0.6 sin 4t, wheel at up to 3 rad/s."""
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
    """One replay on the rig, with all that was sent."""

    replay: Replay
    result: ReplayResult
    line: VirtualLine
    clock: VirtualClock
    sent: list[tuple[float, Packet]]

    @property
    def map(self) -> ServoMap:
        return self.replay.map

    def goals(self) -> list[tuple[float, int, int]]:
        """(time, ID, value) of every goal on the wire."""
        return [entry for time, packet in self.sent for entry in goals_in(time, packet)]

    def writes_of(self, address: int) -> list[tuple[float, int, int]]:
        return [
            (time, packet.id, packet.parameters[2])
            for time, packet in self.sent
            if packet.instruction == Instruction.WRITE and int.from_bytes(packet.parameters[:2], "little") == address
        ]


def goals_in(time: float, packet: Packet) -> list[tuple[float, int, int]]:
    p = packet.parameters
    if packet.instruction == Instruction.SYNC_WRITE and int.from_bytes(p[:2], "little") in GOAL_ADDRESSES:
        return [(time, p[k], int.from_bytes(p[k + 1 : k + 5], "little", signed=True)) for k in range(4, len(p), 5)]
    if packet.instruction == Instruction.WRITE and int.from_bytes(p[:2], "little") in GOAL_ADDRESSES:
        return [(time, packet.id, int.from_bytes(p[2:6], "little", signed=True))]
    return []


def check_goals_within_limits(run: Run) -> None:
    limits = {servo.id: servo.tick_limits for servo in run.map.servos if servo.in_position_mode}
    fastest = {
        servo.id: abs(servo.to_velocity_units(velocity_limit(servo)))
        for servo in run.map.servos
        if not servo.in_position_mode
    }
    for _, id_, value in run.goals():
        if id_ in limits:
            assert limits[id_][0] <= value <= limits[id_][1]
        else:
            assert abs(value) <= fastest[id_]


@dataclass
class Rig:
    """Runs replays on virtual servos."""

    map: ServoMap
    record: Record = field(default_factory=swing)

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
        sent: list[tuple[float, Packet]] = []
        clock = VirtualClock()
        line = line_for_map(
            self.map,
            script=FaultScript.model_validate({"seed": seed, "faults": list(faults)}),
            listener=lambda time, packet: sent.append((time, packet)),
            posture={"shoulder": 0.1, "elbow": 0.2},
            plant=plant,
        )
        port = VirtualPort(line, clock, baud=self.map.bus.baud)
        bus = DynamixelBus(port, latency=self.map.bus.latency, return_delay=self.map.bus.return_delay)
        replay = Replay(motion or self.motion(), self.map, bus, clock, stop=stop, **options)
        return Run(replay, replay.result, line, clock, sent)

    def run(self, *faults: dict[str, Any], **options: Any) -> Run:
        run = self.prepare(*faults, **options)
        run.result = run.replay.run()
        return run


@pytest.fixture(scope="session")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    path.write_text(MAP, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def rig(map_file: Path) -> Rig:
    return Rig(load_servo_map(map_file))


@pytest.fixture(scope="session")
def clean_run(rig: Rig) -> Run:
    """A replay without faults, for those who only look at it."""
    return rig.run()


@pytest.fixture
def write_map(tmp_path: Path) -> Callable[..., Path]:
    """Write the rig's map with replacements: write_map(("a", "b"), …)."""

    def write(*replacements: tuple[str, str]) -> Path:
        text = MAP
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "map.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write
