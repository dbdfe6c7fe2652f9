"""Replays and drives by command on virtual servos in virtual time: faults, exceptions in the code, and a verdict."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import CodeType, FrameType, SimpleNamespace
from typing import Any

import pytest
from studies.fault_table import CASES, MAP, POLICIES, TORQUE_ADDRESS, goals_in, swing

import dynsim
from dynsim import cli
from dynsim.cli import hardware
from dynsim.errors import DynsimError
from dynsim.hardware import ports
from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.bus.packet import Instruction, Packet
from dynsim.hardware.bus.protocol import VirtualClock
from dynsim.hardware.replay import machine
from dynsim.hardware.replay.check import Sample, lead, velocity_limit
from dynsim.hardware.replay.measured import recover
from dynsim.hardware.replay.output import NOT_ARMED, UNARMED, ReplayState
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import ServoMap, load_servo_map
from dynsim.hardware.virtual.line import VirtualLine
from dynsim.record import Record
from dynsim.system.files import json_text
from dynsim.teleop.web import follower

from .test_drive import Simulated

PACKAGE = Path(dynsim.__file__).parent
LOOP = (
    PACKAGE / "hardware" / "replay",
    PACKAGE / "hardware" / "bus",
    Path(sys.modules[Simulated.__module__].__file__ or ""),
)
"""Code whose functions are the stages of a loop; a feed of postures is a stage, too."""
SERVOS = PACKAGE / "hardware" / "virtual"
IN_SERVOS = "virtual servos"
ACCELERATION = 40.0
"""Limit of all joints [rad/s²]; the swing needs 10, a run-up 20, a stop from the highest speed 17."""
RIG = (
    MAP.replace("rate: 100", "rate: 50")
    .replace("run_up: 20", "run_up: 20, approach_velocity: 1.0")
    .replace("torque:", f"acceleration: {ACCELERATION:g}, torque:")
)
DURATION = 0.3
"""Duration of a replay or drive [s]."""
OUTSIDE = "OUTSIDE"
"""Before the state machine exists, and after it has ended."""


# -- exceptions in the code -------------------------------------------------------------------------------------------


@dataclass(frozen=True, order=True)
class Stage:
    """A function of the loop, the state in which it is called, and whether the exception comes at its start or end."""

    function: str
    state: str
    event: str

    def __str__(self) -> str:
        return f"{self.event} of {self.function} in {self.state}"


@dataclass
class Stages:
    """All stages that a run passes; at the ``turn``-th pass of ``failing`` the function raises ``error``."""

    failing: Stage | None = None
    turn: int = 1
    error: BaseException = field(default_factory=lambda: ZeroDivisionError("out of the blue " * 20))
    state: Callable[[], str] = lambda: OUTSIDE
    passed: Counter[Stage] = field(default_factory=Counter)
    raised: bool = False
    _names: dict[CodeType, str | None] = field(default_factory=dict)
    _in_servos: int = 0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Watch this thread within the block."""
        before = sys.getprofile()
        sys.setprofile(self._profile)
        try:
            yield
        finally:
            sys.setprofile(before)

    def _profile(self, frame: FrameType, event: str, value: Any) -> None:
        if event not in ("call", "return"):
            return
        code = frame.f_code
        if code not in self._names:
            path = Path(code.co_filename)
            if SERVOS in path.parents:
                self._names[code] = IN_SERVOS
            elif any(path == folder or folder in path.parents for folder in LOOP) and "<" not in code.co_name:
                self._names[code] = f"{path.name}:{code.co_qualname}"
            else:
                # Comprehensions, and code that runs when a module is loaded, belong to their callers.
                self._names[code] = None
        name = self._names[code]
        if name == IN_SERVOS:
            # Code that virtual servos share with the loop is not a stage of the loop while they run it.
            self._in_servos += 1 if event == "call" else -1
        if name is None or self._in_servos:
            return
        stage = Stage(name, self.state(), event)
        self.passed[stage] += 1
        if stage == self.failing and self.passed[stage] == self.turn:
            self.raised = True
            raise self.error


# -- a run ------------------------------------------------------------------------------------------------------------


@dataclass
class Schedule:
    """What happens in a run.

    Attributes
    ----------
    driven : a drive; otherwise a replay
    faults : entries of a fault script
    presses : clock times of Ctrl-C [s]
    late : (clock time, duration) of pauses of the program [s]
    limp_at_first : False if the robot is holding when the run begins
    """

    driven: bool = False
    policy: str = "decelerate"
    faults: tuple[dict[str, Any], ...] = ()
    seed: int = 0
    presses: tuple[float, ...] = ()
    late: tuple[tuple[float, float], ...] = ()
    at_end: str = "off"
    speed: float = 1.0
    limp_at_first: bool = True


def drawn(number: int) -> Schedule:
    """Return a random schedule: up to three faults of servos or line, Ctrl-C, and pauses of the program."""
    draw = Random(f"schedule {number}")
    span = 1.6 if (driven := number % 2 == 1) else 2.2
    faults = []
    for case in draw.sample(CASES, draw.choice((0, 1, 1, 2, 3))):
        entry = dict(case.entry)
        if case.scripted_onset or draw.random() < 0.5:
            entry["at"] = round(draw.uniform(0.0, span), 4)
        if case.ids:
            entry["id"] = draw.choice(case.ids)
        if draw.random() < 0.4 and entry["kind"] not in ("duplicate_id", "wrong_model", "wrong_firmware", "wrong_mode"):
            entry["duration"] = round(10 ** draw.uniform(-2.5, 0.0), 4)
        for name in ("probability", "delay", "angle", "drop", "heating_rate"):
            if name in entry and draw.random() < 0.5:
                entry[name] = round(entry[name] * draw.uniform(0.1, 1.0), 5)
        faults.append(entry)
    return Schedule(
        driven=driven,
        policy=draw.choice(POLICIES),
        faults=tuple(faults),
        seed=number,
        presses=tuple(sorted(draw.uniform(0.0, span + 0.6) for _ in range(draw.choice((0, 0, 0, 1, 2))))),
        late=tuple(
            (draw.uniform(0.0, span), 10 ** draw.uniform(-2.5, 0.0)) for _ in range(draw.choice((0, 0, 0, 1, 3)))
        ),
        at_end=draw.choice(("off", "hold")),
        speed=1.0 if driven else draw.choice((1.0, 0.7)),
        limp_at_first=draw.random() < 0.8,
    )


class LateClock(VirtualClock):
    """Virtual time in which the program pauses, and Ctrl-C."""

    def __init__(self, schedule: Schedule) -> None:
        super().__init__()
        self._presses, self._late = list(schedule.presses), list(schedule.late)

    def sleep_until(self, deadline: float) -> None:
        if self._late and self.now() >= self._late[0][0]:
            deadline += self._late.pop(0)[1]
        super().sleep_until(deadline)
        if self._presses and self.now() >= self._presses[0]:
            del self._presses[0]
            os.kill(os.getpid(), signal.SIGINT)


@dataclass
class Goal:
    """A goal on the wire, and the position that its servo then reports, both in register units."""

    time: float
    id: int
    value: int
    present: int


@dataclass
class Ended:
    """A run that has ended."""

    schedule: Schedule
    folder: Path
    map: ServoMap
    code: int | None = None
    error: BaseException | None = None
    stderr: str = ""
    replay: machine.Replay | None = None
    line: VirtualLine | None = None
    clock: LateClock | None = None
    goals: list[Goal] = field(default_factory=list)
    sent: list[tuple[float, Packet]] = field(default_factory=list)

    def state(self) -> str:
        """State of the machine."""
        return OUTSIDE if self.replay is None else self.replay.journal.state.name

    def listen(self, time: float, packet: Packet) -> None:
        """Note a packet."""
        self.sent.append((time, packet))
        if self.line is not None:
            for _, id_, value in goals_in(time, packet):
                present = self.line.servos.registers[id_]["present_position"]
                self.goals.append(Goal(time, id_, value, present))


def files(folder: Path) -> None:
    """Write the maps and the record of all runs."""
    swing(DURATION).save(folder / "rig.h5")
    for at_end in ("off", "hold"):
        (folder / f"{at_end}.yaml").write_text(RIG.replace('at_end: "off"', f'at_end: "{at_end}"'), encoding="utf-8")


def run(schedule: Schedule, source: Path, folder: Path, stages: Stages | None = None) -> Ended:
    """Run the command of a schedule in this process, with the files in ``source``."""
    script, map_file = folder / "faults.yaml", source / f"{schedule.at_end}.yaml"
    script.write_text(json_text({"seed": schedule.seed, "faults": list(schedule.faults)}), encoding="utf-8")
    ended = Ended(schedule, folder, load_servo_map(map_file), clock=LateClock(schedule))
    stages = stages or Stages()
    stages.state = ended.state
    common = ("--map", map_file, "--port", "virtual", "--faults", script, "--policy", schedule.policy)
    arguments = ("replay", source / "rig.h5", *common, "--quiet", "--speed", schedule.speed, "--out", folder / "out")
    if schedule.driven:
        arguments = ("drive", "single_pendulum", *common, "--no-open", "--quiet", "--out", folder / "out")
    streams = io.StringIO(), io.StringIO()
    with _staged(ended, stages), redirect_stdout(streams[0]), redirect_stderr(streams[1]):
        sys.argv = ["dynsim", "hw", *map(str, arguments)]
        try:
            cli.main()
        except SystemExit as leaving:
            ended.code = int(leaving.code or 0)
        except BaseException as error:
            ended.error = error
    ended.stderr = streams[1].getvalue()
    return ended


@contextmanager
def _staged(ended: Ended, stages: Stages) -> Iterator[None]:
    """Replace the clock and the process of the simulation, and note the machine and the line."""
    replayed = hardware.replayed
    begin, line_for_map, make_port = machine.Replay.__post_init__, ports.line_for_map, ports.VirtualPort

    def begun(self: machine.Replay) -> None:
        begin(self)
        ended.replay = self

    def line(servo_map: ServoMap, **options: Any) -> VirtualLine:
        ended.line = line_for_map(servo_map, listener=ended.listen, **options)
        if not ended.schedule.limp_at_first:
            for id_ in servo_map.ids:
                ended.line.servos.write(id_, TORQUE_ADDRESS, b"\1")
        return ended.line

    def watched(*arguments: Any, **options: Any) -> Any:
        with stages.watched():
            return replayed(*arguments, **options)

    class Simulation:
        """In place of the process of the simulation, without a browser."""

        def __init__(self, request: Any) -> None:
            clock: Any = ended.clock
            self.feed = Simulated(clock, lead(request.servo_map), until=DURATION)

        def __enter__(self) -> Simulation:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def ready(self) -> Any:
            still = SimpleNamespace(scene=None, provenance={})
            return follower.Ready("http://127.0.0.1", still, Sample(0.0, *self.feed.posture(0.0)), self.feed.step)  # type: ignore[arg-type]

        def wait_for_pilot(self) -> None:
            pass

        def finish(self, why: str) -> Any:
            return follower.Done(SimpleNamespace(ended=why), 0.0, saved=False, failure=None)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", sys.argv)
        patch.setattr(hardware, "replayed", watched)
        patch.setattr(machine.Replay, "__post_init__", begun)
        patch.setattr(ports, "line_for_map", line)
        patch.setattr(ports, "VirtualPort", lambda line, clock, baud: make_port(line, ended.clock, baud=baud))
        patch.setattr(ports, "VirtualClock", lambda: ended.clock)
        patch.setattr(ports, "PacedClock", lambda: ended.clock)
        patch.setattr(follower, "SimulationProcess", Simulation)
        yield


# -- the verdict ------------------------------------------------------------------------------------------------------


def broken_promises(ended: Ended) -> Iterator[str]:
    """Yield what a run must not do, however it was disturbed."""
    yield from _goals_beyond_limits(ended)
    yield from _report(ended)
    yield from _files(ended)


def _goals_beyond_limits(ended: Ended) -> Iterator[str]:
    replay = ended.replay
    fault_time = float("inf") if replay is None or replay.result.fault is None else replay.result.fault_time
    started = float("inf")
    if replay is not None and replay.loop.path_started is not None:
        started = replay.loop.path_started - replay.loop.period
    for servo in ended.map.servos:
        goals = [goal for goal in ended.goals if goal.id == servo.id]
        if not servo.in_position_mode:
            fastest = abs(servo.to_velocity_units(velocity_limit(servo)))
            yield from (f"{servo.joint}: velocity {goal.value}" for goal in goals if abs(goal.value) > fastest)
            continue
        low, high = servo.tick_limits
        period = 1.0 / ended.map.bus.rate
        most = 2 * velocity_limit(servo) * period / RAD_PER_TICK + 2
        # Two roundings to ticks in each of two steps.
        bend = ACCELERATION * period**2 / RAD_PER_TICK + 2
        before: list[int] = []
        for number, goal in enumerate(goals):
            # The first goal is the present position, which may be anywhere.
            if number and not low <= goal.value <= high:
                yield f"{servo.joint}: position {goal.value} at {goal.time:.3f} s"
            step = goal.value - before[-1] if before else 0
            # A servo that stops at its present position measures it up to some cycles before.
            if abs(step) > most and not (goal.time >= fault_time and abs(goal.value - goal.present) <= 3 * most):
                yield f"{servo.joint}: step of {step} ticks at {goal.time:.3f} s"
            if len(before) > 1 and started < goal.time < fault_time and before[-2:] != [goal.value] * 2:
                change = step - (before[-1] - before[-2])
                if goals[number - 2].time > started and abs(change) > bend:
                    yield f"{servo.joint}: change of step by {change} ticks at {goal.time:.3f} s"
            before.append(goal.value)


def _report(ended: Ended) -> Iterator[str]:
    """Torque of all servos, exit code and message."""
    replay, line, schedule = ended.replay, ended.line, ended.schedule
    if ended.error is not None:
        yield f"traceback: {ended.error!r}"
        return
    lines = [text for text in ended.stderr.splitlines() if not text.startswith((" ", "warning:"))]
    if ended.code and not (len(lines) == 1 and lines[0].startswith("error:")) and not (ended.code == 130 and not lines):
        yield f"exit code {ended.code} with {ended.stderr!r}"
    moved = any(
        packet.instruction == Instruction.WRITE and _address(packet) == TORQUE_ADDRESS for _, packet in ended.sent
    )
    if replay is None or (replay.result.end_state == NOT_ARMED and replay.result.fault is None):
        if moved or ended.goals:
            yield "motion without a result"
        if not ended.code:
            yield "exit code 0 without a result"
        return
    result = replay.result
    if result.fault is not None and not ended.code:
        yield "exit code 0 after a fault"
    log = (ended.folder / "out" / ("servos" if schedule.driven else "") / "replay.log").read_text(encoding="utf-8")
    message = log if "unexpected error" in ended.stderr or not ended.stderr else ended.stderr
    if result.fault_state is not None and result.fault_state not in UNARMED and result.end_state not in message:
        yield f"end state {result.end_state!r} not in the message"
    if not result.servos and moved:
        yield "torque not read"
    changing = any(fault["kind"] in CHANGING for fault in schedule.faults)
    silenced = {fault.get("id") for fault in schedule.faults if fault["kind"] in SILENCERS}
    for end in result.servos:
        registers = line.servos.registers[end.id] if line is not None else {}
        if end.torque is None:
            if end.id not in silenced and None not in silenced:
                yield f"torque of {end.joint} not read"
        elif not changing and (end.torque, end.error) != (
            bool(registers["torque_enable"]),
            registers["hardware_error"],
        ):
            yield f"{end.joint} is not as reported ({end.doing})"
    after = [
        (time, packet) for time, packet in ended.sent if time > result.fault_time and not replay.loop.stop.for_release
    ]
    if any(
        _address(packet) == TORQUE_ADDRESS and packet.parameters[2:3] != b"\0"
        for _, packet in after
        if packet.instruction == Instruction.WRITE
    ):
        yield "torque was switched on after the fault"
    declared = iter([(id_, value) for _, id_, value in result.policy_goals])
    # A goal may be declared and then lost, for example because the port died.
    if not all((goal.id, goal.value) in declared for goal in ended.goals if goal.time > result.fault_time):
        yield "a goal after the fault that was not the policy's"
    if schedule.policy == "off" and result.fault_state in MOVING and result.faults[0].cause != Cause.INTERRUPTED:
        on = [id_ for id_, servo in line.servos.registers.items() if servo["torque_enable"]] if line else []
        if None not in silenced and not set(on) <= silenced:
            yield "torque on under the policy off"


SILENCERS = (
    "lost_status",
    "late_status",
    "truncated_status",
    "bad_crc",
    "noise",
    "drop_off",
    "unplug",
    "reboot",
    "supply_loss",
    "duplicate_id",
)
"""Faults after which a servo may not be able to report its torque."""


CHANGING = ("overload", "overheat", "temperature_ramp", "stuck", "watchdog_trip", *SILENCERS)
"""Faults after which a servo may lose its torque at any time, also after it was read."""
MOVING = (ReplayState.MOVE_TO_START, ReplayState.SETTLE, ReplayState.REPLAY)


def _address(packet: Packet) -> int:
    return int.from_bytes(packet.parameters[:2], "little")


def _files(ended: Ended) -> Iterator[str]:
    """The measured record can be read, and the summary agrees with the result."""
    folder = ended.folder / "out" / ("servos" if ended.schedule.driven else "")
    if ended.replay is None or not any(packet.instruction == Instruction.SYNC_READ for _, packet in ended.sent):
        return
    try:
        if (folder / "measured.h5").exists():
            record = Record.load(folder / "measured.h5")
        elif "hw recover" in ended.stderr or ended.code == 130:
            record = recover(folder)
        else:
            yield f"no record: {ended.stderr!r}"
            return
    except DynsimError as error:
        yield f"record: {error}"
        return
    result = ended.replay.result
    if record.complete != (result.fault is None) and "measured record failed" not in ended.stderr:
        yield f"the record is marked {'complete' if record.complete else 'incomplete'}"
    if "unexpected error" in ended.stderr or not ended.stderr:
        return
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    if summary.get("end_state") != result.end_state or len(summary["servos"]) != len(result.servos):
        yield "the summary differs from the result"
