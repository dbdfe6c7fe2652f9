"""The replay: a checked motion on a bus of servos.

CONNECT → VERIFY → ARM → MOVE_TO_START → SETTLE → REPLAY → SETTLE → DISARM, and from everywhere → FAULT. The offline
check (:mod:`dynsim.hardware.check`) has been passed before. Cycles start at absolute deadlines; one that is more than
a period late is skipped, never made up for. After a fault nothing is sent but what the fault policy says.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path as FilePath
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.hardware.bus import Bus, NoAnswer, RequestRefused
from dynsim.hardware.check import CheckedMotion, velocity_limit
from dynsim.hardware.clock import Clock
from dynsim.hardware.control_table import (
    HEALTH_BLOCK,
    MX_106,
    RAD_PER_TICK,
    RAD_S2_PER_UNIT,
    RAD_S_PER_UNIT,
    STATE_BLOCK,
    WATCHDOG_SECONDS_PER_UNIT,
)
from dynsim.hardware.errors import PortError
from dynsim.hardware.measured import describe
from dynsim.hardware.rules import AbortRules, Cause, Cycle, Fault, decode_health
from dynsim.hardware.run_log import Recorder, RunLog, TimingStatistics
from dynsim.hardware.servo_map import FaultPolicy, Servo, ServoMap
from dynsim.hardware.trajectory import Path, quintic
from dynsim.hardware.verify import configure, dump_registers, verify
from dynsim.record import Record

Array = NDArray[np.float64]

FIELDS = MX_106.fields
"""Items the two models share have the same address in both."""
APPROACH_ACCELERATION = 10.0
"""Profile acceleration the firmware is given for the move to the start [rad/s²]."""
SETTLE_CYCLES = 10
SETTLE_TIME = 3.0
"""Longest wait for the servos to come to rest [s]."""
SETTLE_VELOCITY = 0.1
"""[rad/s], a few units of the velocity register."""
DRY_RUN_TIME = 1.0
"""Reading without moving, to time the bus [s]."""
LOG_INTERVAL = 1.0


class State(IntEnum):
    """Where the replay is; recorded cycle by cycle."""

    CONNECT = 0
    VERIFY = 1
    ARM = 2
    MOVE_TO_START = 3
    SETTLE = 4
    REPLAY = 5
    DISARM = 6
    FAULT = 7
    DRY_RUN = 8


UNARMED = (State.CONNECT, State.VERIFY, State.DRY_RUN)

EndState = Literal["not armed", "off", "holding", "unreachable"]
"""How the robot was left. "unreachable": the port died, the servos stop by their own watchdogs."""


class StopRequest:
    """Counts the user's Ctrl-C (or other signals): the first asks for a controlled stop, the second for torque off."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, *_: Any) -> None:
        self.count += 1


class Motion(Protocol):
    """Something to follow, over its own time."""

    def at(self, time: float) -> tuple[Array, Array]:
        """Joint angles [rad] and their derivatives with respect to ``time``, shape (N,)."""
        ...


@dataclass(frozen=True)
class Approach:
    """Rest-to-rest move between two postures on a quintic, all joints in step.

    Attributes
    ----------
    start, goal : array, shape (N,)
        [rad].
    duration : float
        [s].
    """

    start: Array
    goal: Array
    duration: float

    def at(self, time: float) -> tuple[Array, Array]:
        fraction, rate = quintic(self.duration, time)
        return self.start + fraction * (self.goal - self.start), rate * (self.goal - self.start)


@dataclass(frozen=True)
class Progress:
    """What a display may show after every cycle.

    Attributes
    ----------
    state : State
    fraction : float
        Of the current motion, 0 to 1.
    following_error : float
        Worst of all joints [rad].
    temperature : float
        Hottest servo [°C], NaN before it is known.
    """

    state: State
    fraction: float
    following_error: float
    temperature: float


@dataclass
class ReplayResult:
    """How a replay ended.

    Attributes
    ----------
    end_state : EndState
    fault : Fault | None
    fault_state : State | None
        Where the fault struck.
    fault_time : float
        On the replay's clock [s], NaN without one.
    policy_goals : list
        (clock time, ID, register value) of every goal sent after the fault.
    record : Record
    timing : TimingStatistics | None
    torque_still_on : tuple of int
        IDs that did not confirm torque off.
    """

    end_state: EndState = "not armed"
    fault: Fault | None = None
    fault_state: State | None = None
    fault_time: float = math.nan
    policy_goals: list[tuple[float, int, int]] = field(default_factory=list)
    record: Record = field(default_factory=lambda: Record([]))
    timing: TimingStatistics | None = None
    torque_still_on: tuple[int, ...] = ()


class _Stopped(Exception):
    def __init__(self, fault: Fault) -> None:
        super().__init__(fault.text)
        self.fault = fault


class Replay:
    """One run of one motion.

    Parameters
    ----------
    motion : CheckedMotion
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
    """

    def __init__(
        self,
        motion: CheckedMotion,
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
        observer: Callable[[Progress], None] | None = None,
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
        self.log = log or RunLog(None)
        self.state = State.CONNECT
        self.result = ReplayResult()
        self._dump_folder = dump_folder
        self._observer = observer
        self._provenance = {"robot": servo_map.robot, "speed": motion.speed, "rate_Hz": motion.plan.rate}
        self._provenance |= provenance or {}
        self._servos = servo_map.servos
        self._in_position_mode = np.array([servo.in_position_mode for servo in self._servos])
        self._period = 1.0 / motion.plan.rate
        self._rules = AbortRules(servo_map, motion.plan)
        self._recorder = Recorder(servo_map)
        count = len(self._servos)
        self._goal, self._goal_rate = np.zeros(count), np.zeros(count)
        self._measured = np.zeros(count)
        self._sent: dict[int, int] = {}
        self._sent_at = math.nan
        self._log_origin = self._origin = clock.now()
        self._tick = 0
        self._cycles = 0
        self._found_holding = False
        self._replay_started: float | None = None
        self._following: Motion | None = None
        self._following_time = self._following_end = self._following_speed = 0.0
        self._last_logged = -math.inf

    def run(self) -> ReplayResult:
        """Carry the replay through, to its end or to a fault; never raises for trouble on the bus.

        An exception of another kind (of the observer, a KeyboardInterrupt without :class:`StopRequest`) is raised again
        after the fault policy was carried out.
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
        except _Stopped as stopped:
            self._fault(stopped.fault)
        except PortError as error:
            self._fault(Fault(Cause.PORT, str(error)))
        except (NoAnswer, RequestRefused) as error:
            self._fault(Fault(Cause.ARMING if self.state == State.ARM else Cause.VERIFICATION, str(error), (error.id,)))
        except BaseException as error:
            # A robot with its torque on must not be left to itself, whatever went wrong.
            self._fault(Fault(Cause.PROGRAM, repr(error)))
            raise
        self._finish()
        return self.result

    # -- states -------------------------------------------------------------------------------------------------------

    def _verify(self) -> None:
        self._enter(State.CONNECT)
        self._check_stop()
        self._enter(State.VERIFY)
        if self.write_eeprom:
            configure(self.bus, self.map, self._say)
        problems = verify(self.bus, self.map, self.motion, poll=self._check_stop)
        if self._dump_folder:
            dump_registers(self.bus, self.map, self._dump_folder / "registers.json")
        if problems:
            raise _Stopped(Fault(Cause.VERIFICATION, "\n  ".join([f"{len(problems)} problem(s):", *problems])))
        self._say(f"{len(self._servos)} servos as the map says")

    def _dry_run(self) -> None:
        self._enter(State.DRY_RUN)
        self._goal = self._goal_rate = np.full(len(self._servos), np.nan)
        self._start_cycles()
        for _ in range(math.ceil(DRY_RUN_TIME / self._period)):
            lateness, skipped = self._wait_for_deadline()
            self._check_stop()
            self._exchange(lateness, skipped, path_time=0.0, write=False)
        self._say("dry run: nothing was moved (--live moves)")

    def _arm(self) -> None:
        self._enter(State.ARM)
        self._found_holding = any(self.bus.read(servo.id, FIELDS["torque_enable"]) for servo in self._servos)
        for index, servo in enumerate(self._servos):
            self._check_stop()
            # A watchdog that tripped in an earlier run keeps goals read-only until it is cleared.
            self.bus.write(servo.id, FIELDS["bus_watchdog"], 0)
            present = self.bus.read(servo.id, FIELDS["present_position"])
            goal_field, goal = self._goal_item(servo, present, 0)
            for name, value in self._profile(servo, approaching=True).items():
                self.bus.write(servo.id, FIELDS[name], value)
            self.bus.write(servo.id, goal_field, goal)
            if self.bus.read(servo.id, goal_field) != goal:
                raise _Stopped(Fault(Cause.ARMING, f"{servo.joint} (ID {servo.id}) did not take its goal", (servo.id,)))
            self.bus.write(servo.id, FIELDS["torque_enable"], 1)
            if not self.bus.read(servo.id, FIELDS["torque_enable"]):
                raise _Stopped(Fault(Cause.ARMING, f"{servo.joint} (ID {servo.id}): torque stays off", (servo.id,)))
            self._sent[servo.id] = goal
            self._goal[index] = self._measured[index] = servo.to_angle(present)
        units = math.ceil(self.map.safety.watchdog / WATCHDOG_SECONDS_PER_UNIT)
        for servo in self._servos:
            self.bus.write(servo.id, FIELDS["bus_watchdog"], units)
        self._sent_at = self.clock.now()
        self._say(f"torque on, bus watchdogs at {units * WATCHDOG_SECONDS_PER_UNIT * 1e3:.0f} ms")

    def _move_to_start(self) -> None:
        goal = np.where(self._in_position_mode, self.motion.path.position[0], self._goal)
        distance = float(np.abs(goal - self._goal).max())
        duration = max(1.875 * distance / self.map.safety.approach_velocity, self._period)
        self._enter(State.MOVE_TO_START)
        self._say(f"{distance:.3f} rad in {duration:.1f} s")
        self._start_cycles()
        self._follow(Approach(self._goal.copy(), goal, duration), 0.0, duration, speed=1.0)
        self._settle()

    def _settle(self) -> None:
        self._enter(State.SETTLE)
        quiet, cycles = 0, 0
        goal, rest = self._goal.copy(), np.zeros_like(self._goal)
        while quiet < SETTLE_CYCLES:
            cycle = self._cycle(goal, rest, path_time=self._following_time)
            error = np.abs(self._rules.following_error(cycle))
            limit = np.array([servo.kind.following_error for servo in self._servos])
            still = (error < limit) & (np.abs(cycle.velocity) < SETTLE_VELOCITY)
            quiet = quiet + 1 if np.all(still | cycle.missed) else 0
            cycles += 1
            if cycles * self._period > SETTLE_TIME:
                moving = [servo for servo, at_rest in zip(self._servos, still, strict=True) if not at_rest]
                names = ", ".join(servo.joint for servo in moving)
                text = f"not at rest {SETTLE_TIME:g} s after the motion: {names}"
                raise _Stopped(Fault(Cause.NOT_SETTLED, text, tuple(servo.id for servo in moving)))

    def _replay_path(self) -> None:
        path: Path = self.motion.path
        for name in ("profile_velocity", "profile_acceleration"):
            values = {servo.id: self._profile(servo, approaching=False)[name] for servo in self._servos}
            self.bus.sync_write(FIELDS[name], values)
        self._enter(State.REPLAY)
        self._replay_started = self._deadline_of(self._tick + 1) - path.start / self.motion.speed
        self._follow(path, path.start, path.end, speed=self.motion.speed)
        self._settle()

    def _disarm(self) -> None:
        self._enter(State.DISARM)
        if self.map.safety.at_end == "hold":
            self._leave_holding()
        else:
            self._release()

    # -- cycles -------------------------------------------------------------------------------------------------------

    def _start_cycles(self) -> None:
        self._origin, self._tick = self.clock.now(), 0

    def _deadline_of(self, tick: int) -> float:
        return self._origin + tick * self._period

    def _wait_for_deadline(self) -> tuple[float, int]:
        """Sleep until the next cycle is due; its lateness [s] and the number of cycles skipped."""
        self._tick += 1
        behind = math.floor((self.clock.now() - self._deadline_of(self._tick)) / self._period)
        skipped = max(0, behind)
        self._tick += skipped
        self.clock.sleep_until(self._deadline_of(self._tick))
        return self.clock.now() - self._deadline_of(self._tick) + skipped * self._period, skipped

    def _follow(self, motion: Motion, start: float, end: float, *, speed: float) -> None:
        """Run along a motion from its time ``start`` to ``end`` [s], ``speed`` of it per second."""
        first = self._tick + 1
        self._following, self._following_end, self._following_speed = motion, end, speed
        self._following_time = start
        while self._following_time < end:
            lateness, skipped = self._wait_for_deadline()
            # Scheduled, not actual time: jitter of the loop must not enter the goals.
            self._following_time = min(end, start + speed * self._period * (self._tick - first + 1))
            position, rate = motion.at(self._following_time)
            self._check_stop()
            self._cycle_now(position, speed * rate, lateness, skipped)

    def _cycle(self, position: Array, velocity: Array, *, path_time: float) -> Cycle:
        lateness, skipped = self._wait_for_deadline()
        self._check_stop()
        self._following_time = path_time
        return self._cycle_now(position, velocity, lateness, skipped)

    def _cycle_now(self, position: Array, velocity: Array, lateness: float, skipped: int) -> Cycle:
        self._goal, self._goal_rate = position, velocity
        cycle = self._exchange(lateness, skipped, path_time=self._following_time, write=True)
        fault = self._rules.examine(cycle)
        if fault:
            raise _Stopped(fault)
        return cycle

    def _exchange(self, lateness: float, skipped: int, *, path_time: float, write: bool) -> Cycle:
        """Write all goals, read all states (and one servo's health in turn), record."""
        began = self.clock.now()
        if write:
            self._send(self._goal, self._goal_rate)
        block = self.bus.sync_read(self.map.ids, *STATE_BLOCK)
        exchange = self.clock.now() - began
        count = len(self._servos)
        cycle = Cycle(
            self._goal.copy(),
            self._goal_rate.copy(),
            np.full(count, np.nan),
            np.full(count, np.nan),
            np.full(count, np.nan),
            np.zeros(count, dtype=bool),
            lateness,
        )
        for index, servo in enumerate(self._servos):
            reply = block.replies.get(servo.id)
            if reply is None:
                continue
            data = reply.data
            cycle.torque[index] = servo.to_torque(int.from_bytes(data[0:2], "little", signed=True))
            cycle.velocity[index] = servo.to_velocity(int.from_bytes(data[2:6], "little", signed=True))
            cycle.position[index] = servo.to_angle(int.from_bytes(data[6:10], "little", signed=True))
            cycle.alert[index] = reply.alert
        self._measured = np.where(cycle.missed, self._measured, cycle.position)
        self._cycles += 1
        if self._cycles % self.motion.plan.health_every == 0:
            servo = self._servos[self._cycles // self.motion.plan.health_every % count]
            # Like a sync read of one: a servo that is silent costs one time-out and no retry.
            answer = self.bus.sync_read((servo.id,), *HEALTH_BLOCK).replies.get(servo.id)
            if answer is not None:
                cycle.health[servo.id] = decode_health(servo, answer.data)
        state = int(self.state)
        self._recorder.add(
            time=began,
            path_time=path_time if self._replay_started is not None else math.nan,
            state=state,
            exchange=exchange,
            stray=block.stray_bytes,
            skipped=skipped,
            cycle=cycle,
        )
        self._report(cycle)
        return cycle

    def _send(self, position: Array, velocity: Array) -> None:
        """The only place goals of a motion leave through. Refuses what no checked motion can ask for."""
        now = self.clock.now()
        elapsed = max(now - self._sent_at, 0.0) + self._period
        goals: dict[str, dict[int, int]] = {"goal_position": {}, "goal_velocity": {}}
        for index, servo in enumerate(self._servos):
            ticks, units = servo.to_ticks(float(position[index])), servo.to_velocity_units(float(velocity[index]))
            if servo.in_position_mode:
                low, high = servo.tick_limits
                step = velocity_limit(servo) * servo.gear * elapsed / RAD_PER_TICK + 2
                if not low <= ticks <= high or abs(ticks - self._sent[servo.id]) > step:
                    raise _Stopped(Fault(Cause.GOAL_GUARD, f"{servo.joint}: goal {ticks} was not sent", (servo.id,)))
                goals["goal_position"][servo.id] = ticks
            else:
                if abs(units) > abs(servo.to_velocity_units(velocity_limit(servo))):
                    raise _Stopped(Fault(Cause.GOAL_GUARD, f"{servo.joint}: goal {units} was not sent", (servo.id,)))
                goals["goal_velocity"][servo.id] = units
        self._write_goals(goals)

    def _write_goals(self, goals: dict[str, dict[int, int]]) -> None:
        for name, values in goals.items():
            if not values:
                continue
            self.bus.sync_write(FIELDS[name], values)
            self._sent.update(values)
            if self.state == State.FAULT:
                now = self.clock.now()
                self.result.policy_goals += [(now, id_, value) for id_, value in values.items()]
        self._sent_at = self.clock.now()

    def _goal_item(self, servo: Servo, ticks: int, units: int) -> tuple[Any, int]:
        return (FIELDS["goal_position"], ticks) if servo.in_position_mode else (FIELDS["goal_velocity"], units)

    def _profile(self, servo: Servo, *, approaching: bool) -> dict[str, int]:
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

    # -- fault --------------------------------------------------------------------------------------------------------

    def _fault(self, fault: Fault) -> None:
        struck = self.state
        self.result.fault, self.result.fault_state, self.result.fault_time = fault, struck, self.clock.now()
        self._enter(State.FAULT)
        self._say(f"in {struck.name}: {fault.cause}: {fault.text}")
        try:
            self.result.end_state = self._carry_out_policy(fault, struck)
        except PortError as error:
            self.result.end_state = "not armed" if struck in UNARMED else "unreachable"
            self._say(f"{error}; armed servos stop by their bus watchdog")
        self._say(f"end state: {self.result.end_state}")
        self._dump_after_fault()

    def _carry_out_policy(self, fault: Fault, struck: State) -> EndState:
        if self._released_by_user():
            return self._release()
        if struck in UNARMED:
            return "not armed"
        if struck == State.DISARM:
            return self._leave_holding() if self.map.safety.at_end == "hold" else self._release()
        if struck == State.ARM:
            # Nothing has moved yet: back to how the robot was found.
            return self._leave_holding() if self._found_holding else self._release()
        # A dead port needs no policy, but the attempt costs nothing and finds out whether it is really dead.
        if self.policy == "off" and fault.cause != Cause.INTERRUPTED:
            return self._release()
        if self.policy == "hold" and fault.cause != Cause.INTERRUPTED:
            self._hold_measured(range(len(self._servos)))
        else:
            self._decelerate(fault)
        if self._released_by_user() or self.policy == "off":
            return self._release()
        return self._leave_holding()

    def _hold_measured(self, indices: Iterable[int]) -> None:
        """Goals of the given servos := where they are."""
        goals: dict[str, dict[int, int]] = {"goal_position": {}, "goal_velocity": {}}
        for index in indices:
            servo = self._servos[index]
            if not servo.in_position_mode:
                goals["goal_velocity"][servo.id] = 0
                continue
            ticks = servo.to_ticks(float(self._measured[index]))
            low, high = servo.tick_limits
            if low <= ticks <= high:
                goals["goal_position"][servo.id] = ticks
            # A reading outside of the joint's limits is not to be trusted: that servo keeps its last goal.
        self._write_goals(goals)

    def _decelerate(self, fault: Fault) -> None:
        """Slow down along the path to rest, so that all joints keep step; servos in trouble stop where they are."""
        troubled = [index for index, servo in enumerate(self._servos) if servo.id in fault.ids]
        self._hold_measured(troubled)
        if self._following is None:
            return
        start, end, speed = self._following_time, self._following_end, self._following_speed
        if self.result.fault_state == State.SETTLE:
            speed = 0.0
        stop_time = self.map.safety.stop_time
        healthy = [index for index in range(len(self._servos)) if index not in troubled]
        first = self._tick
        while (elapsed := (self._tick - first) * self._period) < stop_time and not self._released_by_user():
            self._wait_for_deadline()
            elapsed = min(stop_time, (self._tick - first) * self._period)
            self._following_time = min(end, start + speed * (elapsed - elapsed**2 / (2 * stop_time)))
            position, rate = self._following.at(self._following_time)
            velocity = rate * speed * (1 - elapsed / stop_time)
            goals: dict[str, dict[int, int]] = {"goal_position": {}, "goal_velocity": {}}
            for index in healthy:
                servo = self._servos[index]
                name = "goal_position" if servo.in_position_mode else "goal_velocity"
                units = servo.to_velocity_units(float(velocity[index]))
                goals[name][servo.id] = servo.to_ticks(float(position[index])) if servo.in_position_mode else units
                self._goal[index], self._goal_rate[index] = position[index], velocity[index]
            self._write_goals(goals)
            self._exchange(0.0, 0, path_time=self._following_time, write=False)

    def _leave_holding(self) -> EndState:
        """Watchdogs off, so that the robot keeps holding when this program has gone."""
        silent = []
        for servo in self._servos:
            if self._released_by_user():
                return self._release()
            try:
                self.bus.write(servo.id, FIELDS["bus_watchdog"], 0)
            except (NoAnswer, RequestRefused):
                silent.append(servo.joint)
        if silent:
            self._say(f"no answer from {', '.join(silent)}: whether they hold is not known")
        self._say("torque stays ON, the robot holds; `dynsim hw stop` releases it")
        return "holding"

    def _release(self) -> EndState:
        """Torque off by broadcast, then ask every servo."""
        self.bus.torque_off_all()
        still_on = []
        for servo in self._servos:
            try:
                if self.bus.read(servo.id, FIELDS["torque_enable"]):
                    still_on.append(servo.id)
            except (NoAnswer, RequestRefused):
                still_on.append(servo.id)
        self.result.torque_still_on = tuple(still_on)
        self._say("torque off" + (f"; NOT confirmed by ID {', '.join(map(str, still_on))}" if still_on else ""))
        return "off"

    def _dump_after_fault(self) -> None:
        if not self._dump_folder or self.result.end_state in ("not armed", "unreachable"):
            return
        try:
            dump_registers(self.bus, self.map, self._dump_folder / "registers_after_fault.json")
        except (PortError, RecordError) as error:
            self._say(f"no register dump: {error}")

    def _released_by_user(self) -> bool:
        return self.stop.count >= 2

    def _check_stop(self) -> None:
        if self.stop.count:
            raise _Stopped(Fault(Cause.INTERRUPTED, "stopped by the user"))

    # -- reports ------------------------------------------------------------------------------------------------------

    def _enter(self, state: State) -> None:
        self.state = state
        self._say("enter")
        if self._observer:
            self._observer(Progress(state, 0.0, 0.0, self._recorder.hottest))

    def _say(self, text: str) -> None:
        self.log.write(self.clock.now() - self._log_origin, self.state.name, text)

    def _report(self, cycle: Cycle) -> None:
        error = self._rules.following_error(cycle)[self._in_position_mode]
        worst = float(np.nanmax(np.abs(error))) if np.isfinite(error).any() else 0.0
        now = self.clock.now()
        if now - self._last_logged >= LOG_INTERVAL:
            self._last_logged = now
            hottest = self._recorder.hottest
            self._say(
                f"following error {worst:.4f} rad" + (f", hottest {hottest:.0f} °C" if hottest == hottest else "")
            )
        if self._observer:
            span = self._following_end or 1.0
            self._observer(
                Progress(self.state, min(1.0, max(0.0, self._following_time / span)), worst, self._recorder.hottest)
            )

    def _finish(self) -> None:
        result = self.result
        if result.fault is None:
            held = self.map.safety.at_end == "hold"
            result.end_state = "not armed" if not self.live else "holding" if held else "off"
        started = self._replay_started if self._replay_started is not None else self._origin
        result.record = describe(self._recorder.record(started, self._provenance), self.motion.scene, State)
        result.record.complete = result.fault is None
        result.timing = self._recorder.timing()
        summary: dict[str, Any] = {"end_state": result.end_state}
        if result.fault is not None:
            fault = result.fault
            result.record.add_event(result.fault_time - started, "fault", fault.cause.value, description=fault.text)
            summary |= {"fault": result.fault.cause.value, "fault_text": result.fault.text}
        result.record.summary |= summary
        if result.timing:
            self._say("timing: " + ", ".join(f"{name} {value:.6g}" for name, value in result.timing.as_dict().items()))
