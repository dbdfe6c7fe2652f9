"""State machine of a replay: a checked motion carried out by the servos of a bus.

CONNECT → VERIFY → ARM → MOVE_TO_START → SETTLE → REPLAY → SETTLE → DISARM, and from each state → FAULT. A motion must
have passed the offline check (:mod:`dynsim.hardware.replay.check`). After a fault only the commands of the fault policy
are sent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from dynsim.errors import SimulationStopped
from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.bus.control_table import RAD_S2_PER_UNIT, RAD_S_PER_UNIT, WATCHDOG_SECONDS_PER_UNIT
from dynsim.hardware.bus.protocol import Bus, NoAnswer, RequestRefused, too_busy
from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.check import velocity_limit
from dynsim.hardware.replay.ending import AT_REST, Ending, read_health
from dynsim.hardware.replay.loop import FIELDS, Loop
from dynsim.hardware.replay.measured import describe, measured_record, timing_of
from dynsim.hardware.replay.motion import QUINTIC_PEAK, Approach, MotionTask, PlannedCourse
from dynsim.hardware.replay.output import REGISTERS, REGISTERS_AFTER_FAULT, Journal, Layout, Recorder, RunLog
from dynsim.hardware.replay.rules import Cause, Fault, watchdog_units
from dynsim.hardware.replay.states import UNARMED, ReplayProgress, ReplayResult, ReplayState, Stopped, StopRequest
from dynsim.hardware.replay.verify import Registers, all_registers, configure, difference_lines, verify
from dynsim.hardware.safety import FaultPolicy
from dynsim.hardware.servo_map import MappedServo, ServoMap
from dynsim.system.files import write_json

APPROACH_ACCELERATION = 10.0
"""Profile acceleration written to the servos for the move to the start [rad/s²]."""
SETTLE_CYCLES = 10
SETTLE_TIME = 3.0
"""Longest wait for the servos to come to rest [s]."""
RECORD = "measured record"
"""Name of the measured record in the list of outputs that failed."""
DRY_RUN_TIME = 1.0
"""Duration of a dry run, which reads without moving, to measure the timing of the bus [s]."""


class Replay:
    """One run of one motion.

    Parameters
    ----------
    motion : MotionTask
    servo_map : ServoMap
    bus : Bus
    clock : Clock
    policy : "hold", "decelerate" or "off"
        Instead of the map's.
    live : bool
        False: verify and time the bus, move nothing.
    write_eeprom : bool
        Configure servos that are set up differently.
    stop : StopRequest
    log : RunLog
    dump_folder : path, optional
        Where register dumps go.
    observer : callable, optional
        Called with a Progress after every cycle and on every change of state.
    provenance : dict
        Kept in the measured record.

    Attributes
    ----------
    recorder : Recorder
    layout : Layout
        Of the record made of its rows.
    """

    def __init__(
        self,
        motion: MotionTask,
        servo_map: ServoMap,
        bus: Bus,
        clock: Clock,
        *,
        policy: FaultPolicy | None = None,
        live: bool = True,
        write_eeprom: bool = False,
        stop: StopRequest | None = None,
        log: RunLog | None = None,
        dump_folder: FilePath | None = None,
        observer: Callable[[ReplayProgress], None] | None = None,
        provenance: dict[str, Any] | None = None,
    ) -> None:
        self.motion = motion
        self.map = servo_map
        self.bus = bus
        self.clock = clock
        self.policy: FaultPolicy = policy or servo_map.safety.policy
        self.live = live
        self.write_eeprom = write_eeprom
        self.stop = stop or StopRequest()
        self._dump_folder = dump_folder
        self._provenance = {"robot": servo_map.robot, "speed": motion.speed, "rate_Hz": motion.plan.rate}
        self._provenance |= servo_map.lifting | (provenance or {})
        self._servos = servo_map.servos
        self._found_holding = False
        self.recorder = Recorder(servo_map)
        self.layout = Layout.of(servo_map, self._provenance)
        self.journal = Journal(clock, self.recorder, log or RunLog(None), observer, self.stop)
        self.loop = Loop(motion, servo_map, bus, clock, self.stop, self.recorder, self.journal)
        self.result = ReplayResult(policy_goals=self.loop.policy_goals)
        self._ending = Ending(self.loop, self.journal, self.result, self.policy)

    def run(self) -> ReplayResult:
        """Carry the replay through, to its end or to a fault; never raises for trouble on the bus or with outputs.

        An exception of another kind (a KeyboardInterrupt without :class:`StopRequest`) is raised again after the fault
        policy was carried out.
        """
        try:
            self._verify()
            if self.live:
                self._arm()
                self._move_to_start()
                self._replay_path()
                self._disarm()
            else:
                self._dry_run()
        except Stopped as stopped:
            self._fault(*stopped.faults)
        except PortError as error:
            self._fault(Fault(Cause.PORT, str(error)))
        except (NoAnswer, RequestRefused) as error:
            cause = Cause.ARMING if self.journal.state == ReplayState.ARM else Cause.VERIFICATION
            busy = too_busy(self.bus) if isinstance(error, NoAnswer) else ""
            self._fault(Fault(cause, f"{error}{busy and '; '}{busy}", (error.id,)))
        except SimulationStopped as error:
            self._fault(Fault(Cause.SIMULATION, f"the robot behind the virtual servos (--plant) {error}"))
        except BaseException as error:
            # A robot with its torque on must not be left to itself, whatever went wrong.
            self._fault(Fault(Cause.PROGRAM, repr(error)))
            self._finish()
            raise
        self._finish()
        return self.result

    def _verify(self) -> None:
        self.journal.enter(ReplayState.CONNECT)
        self.stop.check()
        self.journal.enter(ReplayState.VERIFY)
        if self.write_eeprom:
            configure(self.bus, self.map, self.journal.say)
        problems, limits = verify(self.bus, self.map, self.motion, poll=self.stop.check)
        self.result.limits = tuple(limits)
        for line in difference_lines(limits):
            self.journal.say(line)
        self._dump(self._read_registers(), REGISTERS)
        if problems:
            raise Stopped(Fault(Cause.VERIFICATION, "\n  ".join([f"{len(problems)} problem(s):", *problems])))
        self.journal.say(f"{len(self._servos)} servos as the map says")

    def _dry_run(self) -> None:
        self.journal.enter(ReplayState.DRY_RUN)
        self.loop.goal = self.loop.goal_rate = np.full(len(self._servos), np.nan)
        self.loop.begin()
        for _ in range(math.ceil(DRY_RUN_TIME / self.loop.period)):
            self.loop.look()
        self.journal.say("dry run: nothing was moved (--live moves)")

    def _arm(self) -> None:
        self.journal.enter(ReplayState.ARM)
        on = {servo.id for servo in self._servos if self.bus.read(servo.id, FIELDS["torque_enable"])}
        self._found_holding = bool(on)
        for index, servo in enumerate(self._servos):
            self.stop.check()
            # A watchdog that tripped in an earlier run keeps goals read-only until it is cleared.
            self.bus.write(servo.id, FIELDS["bus_watchdog"], 0)
            present = self.bus.read(servo.id, FIELDS["present_position"])
            name, goal = ("goal_position", present) if servo.in_position_mode else ("goal_velocity", 0)
            for item, value in self._profile(servo, approaching=True).items():
                self.bus.write(servo.id, FIELDS[item], value)
            self.bus.write(servo.id, FIELDS[name], goal)
            if self.bus.read(servo.id, FIELDS[name]) != goal:
                raise Stopped(Fault(Cause.ARMING, f"{servo} did not take its goal", (servo.id,)))
            if servo.id in on:
                self._check_still_on([servo])
            self.bus.write(servo.id, FIELDS["torque_enable"], 1)
            if not self.bus.read(servo.id, FIELDS["torque_enable"]):
                raise Stopped(Fault(Cause.ARMING, f"{servo}: torque stays off", (servo.id,)))
            self.loop.take_over(index, goal, servo.to_angle(present))
        # Who stopped the robot meanwhile has not reached the servos that were armed after that.
        self._check_still_on(self._servos)
        units = watchdog_units(self.map.safety)
        self.loop.all_taken_over()
        for servo in self._servos:
            self.bus.write(servo.id, FIELDS["bus_watchdog"], units)
        self.journal.say(f"torque on, bus watchdogs at {units * WATCHDOG_SECONDS_PER_UNIT * 1e3:.0f} ms")

    def _check_still_on(self, servos: Sequence[MappedServo]) -> None:
        """Raises Stopped where one has lost its torque, NoAnswer where one is silent."""
        health = read_health(self.bus, servos)
        for servo in servos:
            if servo.id not in health:
                raise NoAnswer(servo.id, garbled=False)
        lost = [servo for servo in servos if not health[servo.id]["torque_enable"]]
        if lost:
            names = ", ".join(map(str, lost))
            text = f"{names}: torque is off again (switched off by another program, or restarted)"
            raise Stopped(Fault(Cause.TORQUE_LOST, text, tuple(servo.id for servo in lost)))

    def _move_to_start(self) -> None:
        here = self.loop.goal.copy()
        in_position_mode = np.array([servo.in_position_mode for servo in self._servos])
        goal = np.where(in_position_mode, self.motion.start, here)
        distance = float(np.abs(goal - here).max())
        duration = max(QUINTIC_PEAK * distance / self.map.safety.approach_velocity, self.loop.period)
        self.journal.enter(ReplayState.MOVE_TO_START)
        self.journal.say(f"{distance:.3f} rad in {duration:.1f} s")
        self.loop.begin()
        self.loop.follow(PlannedCourse(Approach(here, goal, duration), 0.0, duration, speed=1.0))
        self._settle()

    def _settle(self) -> None:
        self.journal.enter(ReplayState.SETTLE)
        loop, quiet, cycles = self.loop, 0, 0
        goal = loop.goal.copy()
        while quiet < SETTLE_CYCLES:
            cycle = loop.stay(goal)
            error = np.abs(loop.rules.following_error(cycle))
            limit = np.array([servo.kind.following_error for servo in self._servos])
            still = (error < limit) & (np.abs(cycle.velocity) < AT_REST)
            quiet = quiet + 1 if np.all(still | cycle.missed) else 0
            cycles += 1
            if cycles * loop.period > SETTLE_TIME:
                moving = [servo for servo, at_rest in zip(self._servos, still, strict=True) if not at_rest]
                names = ", ".join(servo.joint for servo in moving)
                text = f"not at rest {SETTLE_TIME:g} s after the motion: {names}"
                raise Stopped(Fault(Cause.NOT_SETTLED, text, tuple(servo.id for servo in moving)))

    def _replay_path(self) -> None:
        for name in ("profile_velocity", "profile_acceleration"):
            values = {servo.id: self._profile(servo, approaching=False)[name] for servo in self._servos}
            self.bus.sync_write(FIELDS[name], values)
        self.journal.enter(ReplayState.REPLAY)
        course = self.motion.course()
        self.loop.path_started = self.loop.deadline_of(self.loop.tick + 1) - course.time / self.motion.speed
        self.loop.follow(course)
        self._settle()

    def _disarm(self) -> None:
        self.journal.enter(ReplayState.DISARM)
        self._ending.regular()
        self._ending.read_back(armed=True)
        asked = "holding" if self.map.safety.at_end == "hold" else "off"
        if self.result.end_state != asked:
            cause = Cause.INTERRUPTED if self.stop.for_release else Cause.END_STATE
            raise Stopped(Fault(cause, f"should be {asked}, but is {self.result.end_state}"))
        self._tell_end()

    def _profile(self, servo: MappedServo, *, approaching: bool) -> dict[str, int]:
        """The firmware's own limits: slow towards the start, the joint's speed limit during the replay.

        0 would mean "no limit" and is never written as a velocity; as an acceleration it leaves shaping to the path.
        """
        velocity = (
            min(2 * self.map.safety.approach_velocity, velocity_limit(servo)) if approaching else velocity_limit(servo)
        )
        acceleration = APPROACH_ACCELERATION if approaching else 0.0
        return {
            "profile_velocity": max(1, math.ceil(velocity * servo.gear / RAD_S_PER_UNIT)),
            "profile_acceleration": math.ceil(acceleration * servo.gear / RAD_S2_PER_UNIT),
        }

    def _fault(self, *faults: Fault) -> None:
        struck, result = self.journal.state, self.result
        # The robot first: whatever writes, is told afterwards.
        with self.journal.held_back():
            result.fault_state, result.fault_time = struck, self.clock.now()
            self.journal.enter(ReplayState.FAULT)
            for fault in faults:
                result.declare(replace(fault, time=result.fault_time))
                self.journal.say(f"in {struck.name}: {fault.cause}: {fault.text}")
            self._ending.after_fault(struck, found_holding=self._found_holding)
            armed = struck not in UNARMED or self.stop.for_release
            if armed or faults[0].cause != Cause.PORT:
                self._ending.read_back(armed=armed)
        self._tell_end()
        if armed and result.end_state != "unreachable":
            registers = self._read_registers()
            if self._ending.release_at_last():
                self._tell_end()
            self._dump(registers, REGISTERS_AFTER_FAULT)

    def _tell_end(self) -> None:
        self.journal.say(f"end state: {self.result.end_state}")
        for servo in self.result.servos:
            self.journal.say(str(servo))

    def _read_registers(self) -> dict[str, Registers | str] | None:
        """Of all servos, for a dump; None where the port died after a fault."""
        try:
            return all_registers(self.bus, self.map)
        except PortError as error:
            if self.result.fault is None:
                raise
            self.journal.say(f"no register dump: {error}")
            return None

    def _dump(self, registers: dict[str, Registers | str] | None, name: str) -> None:
        if self._dump_folder and registers is not None:
            self.journal.guard(name, write_json, self._dump_folder / name, registers)

    def _finish(self) -> None:
        self.journal.guard(RECORD, self._sum_up)
        timing = self.result.timing
        if timing:
            self.journal.say(f"timing: {', '.join(f'{name} {value:.6g}' for name, value in timing.as_dict().items())}")

    def _sum_up(self) -> None:
        """Record and timing of the run."""
        result, rows = self.result, self.recorder.all()
        result.timing = timing_of(rows, self.layout)
        started = self.loop.path_started if self.loop.path_started is not None else self.loop.origin
        record = describe(measured_record(rows, self.layout, started), self.motion.scene, self.motion.unmeasured)
        record.complete = result.fault is None
        for fault in result.faults:
            record.add_event(fault.time - started, "fault", fault.cause.value, description=fault.text)
        record.summary |= result.summary()
        result.record = record
