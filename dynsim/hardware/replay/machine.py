"""State machine of a replay, in which servos execute a checked motion; its control loop, and the commands at its end.

The states are CONNECT → VERIFY → ARM → MOVE_TO_START → SETTLE → REPLAY → SETTLE → DISARM; each state may change to
FAULT. A motion must have passed the offline check (:mod:`dynsim.hardware.replay.check`). After a fault, only the
commands of the fault policy are sent.
"""

from __future__ import annotations

import math
import struct
import traceback
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import SimulationStopped, brief
from dynsim.hardware.bus.control_table import (
    HEALTH_BLOCK,
    MX_106,
    RAD_PER_TICK,
    RAD_S2_PER_UNIT,
    RAD_S_PER_UNIT,
    RAW_BLOCK,
    WATCHDOG_SECONDS_PER_UNIT,
    describe_hardware_error,
)
from dynsim.hardware.bus.protocol import Bus, Clock, NoAnswer, RequestRefused, too_busy
from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.check import MotionTask, velocity_limit
from dynsim.hardware.replay.measured import describe, measured_record
from dynsim.hardware.replay.output import (
    HOLDING,
    LIMP,
    MOVING,
    NOT_ARMED,
    REGISTERS,
    REGISTERS_AFTER_FAULT,
    TRIPPED,
    UNARMED,
    Journal,
    Layout,
    Recorder,
    ReplayProgress,
    ReplayResult,
    ReplayState,
    RunLog,
    ServoEnd,
    Stopped,
    StopRequest,
    robot_state,
)
from dynsim.hardware.replay.rules import (
    AbortRules,
    Cause,
    Cycle,
    Fault,
    Registers,
    all_registers,
    configure,
    difference_lines,
    read_registers,
    verify,
    watchdog_units,
)
from dynsim.hardware.replay.trajectory import QUINTIC_PEAK, Approach, CyclePlan, GoalCourse
from dynsim.hardware.servo_map import FaultPolicy, MappedServo, ServoMap
from dynsim.system.files import write_json

# Control loop of a replay: at each deadline, it writes goals, reads states, and records and checks them.


Array = NDArray[np.float64]

FIELDS = MX_106.fields
"""Control table of one model; registers that all models have in common have the same address in all models."""
PWM = struct.Struct("<h")
STATE = struct.Struct("<hii")
"""Layout of effort, velocity and position in a :data:`~dynsim.hardware.bus.control_table.STATE_BLOCK`, which is also
the end of a :data:`~dynsim.hardware.bus.control_table.RAW_BLOCK`."""


GoalRegisters = dict[str, dict[int, int]]
"""Values of the goal registers, by name of the register and by servo ID."""


def goal_registers(
    servos: Iterable[MappedServo], position: Iterable[float], velocity: Iterable[float]
) -> GoalRegisters:
    """Return ticks for joint angles [rad] in position mode, and register units for rates [rad/s] in velocity mode."""
    goals: GoalRegisters = {"goal_position": {}, "goal_velocity": {}}
    for servo, angle, rate in zip(servos, position, velocity, strict=True):
        if servo.in_position_mode:
            goals["goal_position"][servo.id] = servo.to_ticks(float(angle))
        else:
            goals["goal_velocity"][servo.id] = servo.to_velocity_units(float(rate))
    return goals


@dataclass(eq=False)
class Loop:
    """Control loop that writes goals and reads measurements in each cycle.

    Attributes
    ----------
    plan : CyclePlan
    map : ServoMap
    bus : Bus
    clock : Clock
    stop : StopRequest
    recorder : Recorder
    journal : Journal
    rules : AbortRules
    period : float
        Cycle time [s].
    goal, goal_rate : array, shape (N,)
        Last commanded angles [rad] and rates [rad/s].
    measured : array, shape (N,)
        Last measured joint angles [rad].
    origin : float
        Clock time of deadline 0 [s].
    tick : int
        Number of the last deadline.
    course : GoalCourse or None
        Current or last course.
    in_position_mode : bool array, shape (N,)
    path_started : float or None
        Clock time of path time 0 [s]; None before the replay of the path starts.
    policy_goals : list
        (clock time, ID, register value) of each goal that was sent after a fault.
    """

    plan: CyclePlan
    map: ServoMap
    bus: Bus
    clock: Clock
    stop: StopRequest
    recorder: Recorder
    journal: Journal
    course: GoalCourse | None = None
    path_started: float | None = None
    policy_goals: list[tuple[float, int, int]] = field(default_factory=list)
    _cycles: int = 0
    _last_contact: float = math.inf

    def __post_init__(self) -> None:
        servos = self.map.servos
        self.rules = AbortRules(self.map, self.plan)
        self.period = 1.0 / self.plan.rate
        self.goal, self.goal_rate, self.measured = np.zeros((3, len(servos)))
        self.begin()
        self.in_position_mode = np.array([servo.in_position_mode for servo in servos])
        # Limits for goals: in position mode, the lowest and highest tick and the maximum step from goal to goal; in
        # velocity mode, the maximum speed.
        self._tick_bounds = [
            (*servo.tick_limits, velocity_limit(servo) * servo.gear * 2 * self.period / RAD_PER_TICK + 2)
            for servo in servos
        ]
        self._unit_bounds = [abs(servo.to_velocity_units(velocity_limit(servo))) for servo in servos]
        self._sent: dict[int, int] = {}

    def servo_armed(self, index: int, register: int, angle: float) -> None:
        """Set the goal and measurement of a servo that was armed with the goal ``register`` at a joint angle [rad]."""
        self._sent[self.map.servos[index].id] = register
        self.goal[index] = self.measured[index] = angle

    def all_armed(self) -> None:
        """Start to measure the time without packets, because the watchdogs are active from now on."""
        self._last_contact = self.clock.now()

    def stall(self) -> Fault | None:
        """Return a fault if no packet has been sent for longer than the watchdog time of the servos, otherwise None."""
        return self.rules.stall(self.clock.now() - self._last_contact)

    def begin(self) -> None:
        """Start counting deadlines from now."""
        self.origin, self.tick = self.clock.now(), 0

    def deadline_of(self, tick: int) -> float:
        return self.origin + tick * self.period

    def next_cycle(self) -> tuple[float, int]:
        """Wait for the next deadline, see :meth:`wait_for_deadline`; raise Stopped if the user has requested a stop."""
        lateness, skipped = self.wait_for_deadline()
        self.stop.check()
        return lateness, skipped

    def wait_for_deadline(self) -> tuple[float, int]:
        """Wait until the next cycle is due; return its lateness [s] and the number of skipped cycles."""
        self.tick += 1
        behind = math.floor((self.clock.now() - self.deadline_of(self.tick)) / self.period)
        skipped = max(0, behind)
        self.tick += skipped
        self.clock.sleep_until(self.deadline_of(self.tick))
        return self.clock.now() - self.deadline_of(self.tick) + skipped * self.period, skipped

    def follow(self, course: GoalCourse) -> None:
        """Follow a course to its end.

        The course advances by one period per goal even if cycles were skipped, because making up for all skipped cycles
        at once would require a large step.
        """
        self.course = course
        while not course.over:
            due = self.next_cycle()
            self._cycle(*course.advance(self.period), *due)

    def stay(self, position: Array) -> Cycle:
        """Execute one cycle in which the robot stays at a position."""
        return self._cycle(position, np.zeros_like(position), *self.next_cycle())

    def _cycle(self, position: Array, velocity: Array, lateness: float, skipped: int) -> Cycle:
        if stall := self.stall():
            # Servos that have been stopped by their watchdogs must not jump to the current goal.
            raise Stopped(stall)
        self.goal, self.goal_rate = position, velocity
        cycle = self.exchange(lateness, skipped, write=True)
        if faults := self.rules.examine(cycle):
            raise Stopped(*faults)
        return cycle

    def exchange(self, lateness: float, skipped: int, *, write: bool) -> Cycle:
        """Write all goals, read all states, sometimes also read the health of one servo, and record all of them."""
        began = self.clock.now()
        if write:
            self._send(self.goal, self.goal_rate)
        block = self.bus.sync_read(self.map.ids, *self.plan.state_block)
        ended = self.clock.now()
        exchange = ended - began
        servos = self.map.servos
        count = len(servos)
        position, velocity, torque, current, load, pwm, read_time = np.full((7, count), np.nan)
        alert = np.zeros(count, dtype=bool)
        for index, servo in enumerate(servos):
            if reply := block.replies.get(servo.id):
                effort, units, ticks = STATE.unpack(reply.data[-STATE.size :])
                read_time[index] = ended - reply.age
                sensor, unit = (current, servo.model.ampere_per_unit) if servo.model.measures_current else (load, 1e-3)
                sensor[index] = servo.sign * effort * unit
                if len(reply.data) == RAW_BLOCK[1]:
                    pwm[index] = servo.to_pwm(PWM.unpack_from(reply.data)[0])
                torque[index], velocity[index] = servo.to_torque(effort), servo.to_velocity(units)
                position[index], alert[index] = servo.to_angle(ticks), reply.alert
        cycle = Cycle(
            time=began,
            goal_position=self.goal.copy(),
            goal_velocity=self.goal_rate.copy(),
            position=position,
            velocity=velocity,
            torque=torque,
            current=current,
            load=load,
            pwm=pwm,
            goal_register=np.array([self._sent.get(servo.id, np.nan) for servo in servos]),
            read_time=read_time,
            alert=alert,
            lateness=lateness,
            skipped=skipped,
            exchange=exchange,
            stray=block.stray_bytes,
            outdated=tuple(block.outdated),
        )
        self.measured = np.where(cycle.missed, self.measured, cycle.position)
        self._cycles += 1
        if self._cycles % self.plan.health_every == 0:
            servo = servos[self._cycles // self.plan.health_every % count]
            # Use a sync read for this servo: if it is silent, this costs one time-out, but no retries.
            answer = self.bus.sync_read((servo.id,), *HEALTH_BLOCK).replies.get(servo.id)
            if answer is not None:
                registers = cycle.health[servo.id] = servo.model.registers_in(HEALTH_BLOCK[0], answer.data)
                if self.plan.state_block != RAW_BLOCK:
                    pwm[servos.index(servo)] = servo.to_pwm(registers["present_pwm"])
        now = self.clock.now()
        if self._last_contact < math.inf:
            cycle.silence, self._last_contact = max(began - self._last_contact, now - began), now
        origin = math.nan if self.path_started is None else self.path_started
        path_time = self.course.time if self.course and self.path_started is not None else math.nan
        self.journal.guard("record", self.recorder.add, cycle, self.journal.state, path_time, origin)
        error = self.rules.following_error(cycle)[self.in_position_mode]
        worst = float(np.nanmax(np.abs(error))) if np.isfinite(error).any() else 0.0
        self.journal.report(worst, self.course.fraction if self.course else 0.0)
        return cycle

    def _send(self, position: Array, velocity: Array) -> None:
        """Send the goals of a motion; raise Stopped if a checked motion cannot contain such a goal."""
        servos = self.map.servos
        goals = goal_registers(servos, position, velocity)
        for servo, (low, high, step), fastest in zip(servos, self._tick_bounds, self._unit_bounds, strict=True):
            if servo.in_position_mode:
                goal = goals["goal_position"][servo.id]
                allowed = low <= goal <= high and abs(goal - self._sent[servo.id]) <= step
            else:
                goal = goals["goal_velocity"][servo.id]
                allowed = abs(goal) <= fastest
            if not allowed:
                raise Stopped(Fault(Cause.GOAL_GUARD, f"{servo.joint}: unsafe goal {goal} was not sent", (servo.id,)))
        self.write_goals(goals)

    def write_goals(self, goals: GoalRegisters) -> None:
        """Write goal registers without checking the goals."""
        for name, values in goals.items():
            if not values:
                continue
            if self.journal.state == ReplayState.FAULT:
                now = self.clock.now()
                self.policy_goals += [(now, id_, value) for id_, value in values.items()]
            self._sent.update(values)
            self.bus.sync_write(FIELDS[name], values)


# End of a replay: stop the robot, leave the torque on or switch it off, and read the states of the servos.


REST_TIME = 1.0
"""Maximum time to wait until the servos are at rest and silent servos answer again [s]; a restart takes 0.3 s."""
REST_CYCLES = 10
AT_REST = 0.1
"""Speed below which a joint or wheel counts as at rest [rad/s]: a few units of the velocity register."""


@dataclass(eq=False)
class Ending:
    """Procedures that bring the robot to one of the end states.

    Parameters
    ----------
    loop : Loop
    result : ReplayResult
        Result to which further faults, the end state of each servo, and the IDs of servos that did not confirm torque
        off are added.
    policy : "hold", "decelerate" or "off"
    """

    loop: Loop
    result: ReplayResult
    policy: FaultPolicy
    _faulty: set[int] = field(default_factory=set)
    _frozen: bool = False
    _released: bool = False
    _at_rest: bool = False

    @property
    def _servos(self) -> tuple[MappedServo, ...]:
        return self.loop.map.servos

    def regular(self) -> None:
        """End a successful motion as ``safety.at_end`` in the map specifies. Raises PortError."""
        if self.loop.map.safety.at_end == "hold":
            self._leave_holding()
        else:
            self._release()

    def after_fault(self, struck: ReplayState, *, found_holding: bool) -> None:
        """Apply the fault policy to the faults in the result. After an error in this function, it may be called again.

        Parameters
        ----------
        struck : ReplayState
            State in which the fault occurred.
        found_holding : bool
            True if torque was on before the robot was armed.
        """
        self._at_rest = self._at_rest or struck == ReplayState.SETTLE
        interrupted = self.result.faults[0].cause == Cause.INTERRUPTED
        if self.loop.stop.for_release:
            self._insist(self._release)
        elif struck in UNARMED:
            return
        elif struck == ReplayState.DISARM:
            self._insist(self.regular)
        elif struck == ReplayState.ARM:
            # Nothing has moved yet: restore the initial torque state, unless another program has since switched it off.
            taken = any(fault.cause == Cause.TORQUE_LOST for fault in self.result.faults)
            self._insist(self._leave_holding if found_holding and not taken else self._release)
        elif self.policy == "off" and not interrupted:
            self._insist(self._release)
        else:
            # If the port is dead, this has no effect, but the attempt shows whether the port is really dead.
            if not self._try(self._freeze if self.policy == "hold" and not interrupted else self._decelerate):
                self._insist(self._freeze)
            self._try(self._come_to_rest)
            self._insist(self._release if self.policy == "off" else self._leave_holding)

    def release_at_last(self) -> bool:
        """Switch the torque off if the user has requested it since the policy was applied."""
        if self._released or not self.loop.stop.for_release:
            return False
        self._try(self._release)
        self.read_back(armed=True)
        return True

    def read_back(self, *, armed: bool) -> None:
        """Read the state of all servos and derive the end state of the robot."""
        servos = tuple(ServoEnd(servo.joint, servo.id) for servo in self._servos)
        try:
            servos = read_back(self.loop.bus, self._servos)
        except PortError as error:
            self._port_died(error)
        self.result.servos, self.result.end_state = servos, robot_state(servos) if armed else NOT_ARMED

    # -- faults during the policy -------------------------------------------------------------------------------------

    def _try(self, step: Callable[[], None]) -> bool:
        """Execute a step and return True if it succeeded; if it failed, add the error to the result as a fault."""
        try:
            step()
        except PortError as error:
            self._port_died(error)
        except Exception as error:
            self._declare(Fault(Cause.PROGRAM, brief(error)))
        except BaseException as error:
            # This is a request to exit, which is delayed until the robot has been stopped.
            self.loop.stop()
            self._declare(Fault(Cause.PROGRAM, brief(error)))
        else:
            return True
        return False

    def _insist(self, step: Callable[[], None]) -> None:
        """Execute a step, and once more if it failed."""
        _ = self._try(step) or self._try(step)

    def _port_died(self, error: PortError) -> None:
        if all(fault.cause != Cause.PORT for fault in self.result.faults):
            self._declare(Fault(Cause.PORT, f"{error}; the bus watchdogs stop armed servos"))

    def _declare(self, fault: Fault) -> None:
        self.result.declare(replace(fault, time=self.loop.clock.now()))
        self.loop.journal.add_line(f"{fault.cause}: {fault.text}")

    def _watch(self, lateness: float, skipped: int) -> Cycle:
        """Read all states and apply the abort rules; a servo with a new fault stops at its present position."""
        loop = self.loop
        cycle = loop.exchange(lateness, skipped, write=False)
        # Ignore late cycles, because the remaining goals do not depend on the time at which they are sent.
        for fault in loop.rules.examine(cycle):
            if fault.cause != Cause.DEADLINE:
                self._declare(fault)
                self._stop_faulty(fault)
        return cycle

    def _stop_faulty(self, fault: Fault) -> None:
        if self._frozen:
            return
        if fault.cause == Cause.STALL:
            self._freeze()
        else:
            self._hold_measured(self._newly_faulty(fault.ids))

    def _newly_faulty(self, ids: Collection[int]) -> list[int]:
        """Mark servos as faulty; return the indices in the map of the servos that were not marked before.

        If a servo of a pair is faulty, both servos stop.
        """
        axles = {servo.axle for servo in self._servos if servo.id in ids}
        ids = {servo.id for servo in self._servos if servo.axle in axles}
        indices = [index for index, servo in enumerate(self._servos) if servo.id in ids and index not in self._faulty]
        self._faulty.update(indices)
        return indices

    # -- ways of stopping ---------------------------------------------------------------------------------------------

    def _freeze(self) -> None:
        """Set the goals of all servos to their present positions."""
        self._frozen = True
        if any(fault.cause == Cause.STALL for fault in self.result.faults):
            # The last measurement was taken before the stall, so measure again.
            self.loop.exchange(0.0, 0, write=False)
        self._hold_measured(range(len(self._servos)))

    def _hold_measured(self, indices: Iterable[int]) -> None:
        """Set the goals of some servos to their measured positions."""
        loop = self.loop
        reliable = []
        for index in indices:
            servo = self._servos[index]
            loop.goal_rate[index] = 0.0
            low, high = servo.tick_limits
            if servo.in_position_mode and not low <= servo.to_ticks(float(loop.measured[index])) <= high:
                # A measurement outside the limits of the joint is unreliable, so the servo keeps its last goal.
                continue
            reliable.append(index)
            if servo.in_position_mode:
                loop.goal[index] = loop.measured[index]
        self._write(reliable)

    def _decelerate(self) -> None:
        """Slow all joints down to rest synchronously along the path; stop faulty servos at their present positions."""
        loop, faults = self.loop, self.result.faults
        if any(fault.cause == Cause.STALL for fault in faults):
            # The watchdogs have stopped the servos, so that these do not accept goals.
            return self._freeze()
        self._hold_measured(self._newly_faulty([id_ for fault in faults for id_ in fault.ids]))
        course = loop.course
        if course is None:
            return None
        start, end = course.time, course.end
        speed, self._at_rest = 0.0 if self._at_rest else course.speed, True
        stop_time = course.braking_time(loop.map.safety.stop_time)
        elapsed, goals = 0.0, 0
        while elapsed < stop_time and not loop.stop.for_release and not self._frozen:
            lateness, skipped = loop.wait_for_deadline()
            if stall := loop.stall():
                self._declare(stall)
                return self._freeze()
            goals += 1
            elapsed = min(stop_time, goals * loop.period)
            course.time = min(end, start + speed * (elapsed - elapsed**2 / (2 * stop_time)))
            position, rate = course.at(course.time)
            velocity = rate * speed * (1 - elapsed / stop_time)
            self._send(position, velocity)
            self._watch(lateness, skipped)
        return None

    def _send(self, position: Array, velocity: Array) -> None:
        """Send goals [rad], [rad/s] to all servos that have no fault."""
        loop = self.loop
        sound = [index for index in range(len(self._servos)) if index not in self._faulty]
        loop.goal[sound], loop.goal_rate[sound] = position[sound], velocity[sound]
        self._write(sound)

    def _write(self, indices: list[int]) -> None:
        """Write the current goals of some servos."""
        loop, servos = self.loop, [self._servos[index] for index in indices]
        loop.write_goals(goal_registers(servos, loop.goal[indices], loop.goal_rate[indices]))

    def _come_to_rest(self) -> None:
        """Wait until all servos answer and are at rest, but no longer than REST_TIME."""
        quiet = 0
        for _ in range(math.ceil(REST_TIME / self.loop.period)):
            if self.loop.stop.for_release:
                return
            cycle = self._watch(*self.loop.wait_for_deadline())
            # A silent servo does not count as at rest, because it may be restarting.
            quiet = quiet + 1 if np.all(np.abs(cycle.velocity) < AT_REST) else 0
            if quiet == REST_CYCLES:
                return

    def _leave_holding(self) -> None:
        """Switch the watchdogs off, so that the robot keeps its posture after this program ends. Raises PortError."""
        loop = self.loop
        health = read_health(loop.bus, self._servos)
        unconfirmed = []
        for index, servo in enumerate(self._servos):
            if loop.stop.for_release:
                return self._release()
            try:
                loop.bus.write(servo.id, FIELDS["bus_watchdog"], 0)
            except (NoAnswer, RequestRefused) as error:
                unconfirmed.append(f"{servo.joint}: {error}")
            registers = health.get(servo.id)
            if registers and registers["bus_watchdog"] == -1:
                # The watchdog has stopped this servo, so that it did not accept any goal until now.
                loop.measured[index] = servo.to_angle(registers["present_position"])
                self._hold_measured([index])
        if unconfirmed:
            self.loop.journal.add_line(
                f"these servos did not confirm that their watchdogs are off and may stop: {'; '.join(unconfirmed)}"
            )
        return self.loop.journal.add_line("servos with torque on stay ON; switch them off with `dynsim hw stop`")

    def _release(self) -> None:
        """Broadcast "torque off" until all servos confirm it or REST_TIME has passed; then switch the watchdogs off.

        Raises PortError.
        """
        loop, until = self.loop, self.loop.clock.now() + REST_TIME
        self._released = True
        while True:
            loop.bus.torque_off_all()
            health = read_health(loop.bus, self._servos)
            still_on = [id_ for id_ in loop.map.ids if id_ not in health or health[id_]["torque_enable"]]
            self.result.torque_still_on = tuple(still_on)
            if not still_on or loop.clock.now() >= until:
                break
            loop.clock.sleep_until(loop.clock.now() + REST_TIME / 10)
        # Also switch the watchdogs off, because a watchdog that trips later makes goals read-only for the next program.
        for id_ in loop.map.ids:
            if id_ not in still_on and health[id_]["bus_watchdog"]:
                with suppress(NoAnswer, RequestRefused):
                    loop.bus.write(id_, FIELDS["bus_watchdog"], 0)
        confirmed = f"; NOT confirmed by ID {', '.join(map(str, still_on))}" if still_on else ""
        self.loop.journal.add_line(f"torque off{confirmed}")


def read_health(bus: Bus, servos: Sequence[MappedServo]) -> dict[int, Registers]:
    """Read the registers at addresses 64 to 146 of all servos that answer, by ID and name. Raises PortError."""
    return read_registers(bus, servos, HEALTH_BLOCK)


def read_back(bus: Bus, servos: Sequence[MappedServo]) -> tuple[ServoEnd, ...]:
    """Read the present state of all servos. Raises PortError."""
    health = read_health(bus, servos)
    return tuple(
        _end(servo, health[servo.id]) if servo.id in health else ServoEnd(servo.joint, servo.id) for servo in servos
    )


def _end(servo: MappedServo, registers: dict[str, int]) -> ServoEnd:
    torque, error = bool(registers["torque_enable"]), registers["hardware_error"]
    position, velocity = servo.to_angle(registers["present_position"]), servo.to_velocity(registers["present_velocity"])
    if not torque:
        doing = f"limp: {describe_hardware_error(error)}" if error else LIMP
    elif registers["bus_watchdog"] == -1:
        doing = TRIPPED
    else:
        doing = HOLDING if abs(velocity) < AT_REST else MOVING
    return ServoEnd(servo.joint, servo.id, torque, error, position, velocity, doing)


APPROACH_ACCELERATION = 10.0
"""Profile acceleration of the servos during the move to the start [rad/s²]."""
SETTLE_CYCLES = 10
SETTLE_TIME = 3.0
"""Maximum time to wait for the servos to come to rest [s]."""
RECORD = "measured record"
"""Name of the measured record in the list of outputs that failed."""
ATTEMPTS = 3
"""Maximum number of attempts to apply the fault policy if errors of this program interrupt it."""
DRY_RUN_TIME = 1.0
"""Duration of a dry run, which measures the timing of the bus without moving the robot [s]."""


@dataclass(eq=False)
class Replay:
    """One replay of a motion on servos.

    Parameters
    ----------
    motion : MotionTask
    map : ServoMap
    bus : Bus
    clock : Clock
    policy : "hold", "decelerate" or "off", optional
        Fault policy; default: the policy in the map.
    live : bool
        If False, verify the servos and measure the timing of the bus without moving the robot.
    write_eeprom : bool
        If True, correct EEPROM settings that differ from the map.
    stop : StopRequest, optional
    dump_folder : path, optional
        Folder for register dumps.
    observer : callable, optional
        Function that is called with a ReplayProgress after each cycle and at each change of state.
    provenance : dict, optional
        Entries to be added to the provenance of the measured record.

    Attributes
    ----------
    recorder : Recorder
    layout : Layout
        Layout of the measured record.
    """

    motion: MotionTask
    map: ServoMap
    bus: Bus
    clock: Clock
    _: KW_ONLY
    policy: FaultPolicy | None = None
    live: bool = True
    write_eeprom: bool = False
    stop: StopRequest = field(default_factory=StopRequest)
    dump_folder: FilePath | None = None
    observer: Callable[[ReplayProgress], None] | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        motion, servo_map = self.motion, self.map
        labels = {servo.joint: servo.label for servo in servo_map.servos if servo.label != servo.joint}
        provenance: dict[str, Any] = {"robot": servo_map.robot, "speed": motion.speed, "rate_Hz": motion.plan.rate}
        provenance["limits"] = {
            servo.joint: {"torque_N_m": servo.kind.limits.torque, "following_error_rad": servo.kind.following_error}
            for servo in servo_map.servos
        }
        self._servos = servo_map.servos
        self._found_holding = False
        self.recorder = Recorder(servo_map)
        provenance |= {"labels": labels} if labels else {}
        self.layout = Layout.of(servo_map, provenance | servo_map.lifting | self.provenance)
        self.journal = Journal(self.clock, self.recorder, RunLog(), self.observer, self.stop)
        self.loop = Loop(motion.plan, servo_map, self.bus, self.clock, self.stop, self.recorder, self.journal)
        self.result = ReplayResult(policy_goals=self.loop.policy_goals)
        self._ending = Ending(self.loop, self.result, self.policy or servo_map.safety.policy)

    def run(self) -> ReplayResult:
        """Execute the replay to its end or to a fault; all errors are part of the result.

        A request to exit (for example a KeyboardInterrupt without :class:`StopRequest`) is raised again after the fault
        policy was applied and the result is complete.
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
        except BaseException as error:
            # Always apply the fault policy before leaving a robot whose torque is on, also after errors while doing so.
            struck, errors = self.journal.state, [error]
            while len(errors) <= ATTEMPTS:
                try:
                    self._react(struck, errors)
                    break
                except BaseException as another:
                    errors.append(another)
            self._report(struck, errors)
            if not isinstance(error, Exception):
                self._finish()
                raise
        self._finish()
        return self.result

    def _verify(self) -> None:
        self.journal.enter(ReplayState.CONNECT)
        self.stop.check()
        self.journal.enter(ReplayState.VERIFY)
        if self.write_eeprom:
            configure(self.bus, self.map, self.journal.add_line)
        problems, limits = verify(self.bus, self.map, self.motion.needs(), poll=self.stop.check)
        self.result.limits = tuple(limits)
        for line in difference_lines(limits):
            self.journal.add_line(line)
        self._dump(self._read_registers(), REGISTERS)
        if problems:
            raise Stopped(Fault(Cause.VERIFICATION, "\n  ".join([f"{len(problems)} problem(s):", *problems])))
        self.journal.add_line(f"{len(self._servos)} servos match the map")

    def _dry_run(self) -> None:
        self.journal.enter(ReplayState.DRY_RUN)
        self.loop.goal = self.loop.goal_rate = np.full(len(self._servos), np.nan)
        self.loop.begin()
        for _ in range(math.ceil(DRY_RUN_TIME / self.loop.period)):
            self.loop.exchange(*self.loop.next_cycle(), write=False)
        self.journal.add_line("dry run: nothing was moved; use --live to move the robot")

    def _arm(self) -> None:
        self.journal.enter(ReplayState.ARM)
        self.result.end_state = "unreachable"  # until the servos are read at the end
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
                raise Stopped(Fault(Cause.ARMING, f"{servo} did not accept its goal", (servo.id,)))
            if servo.id in on:
                self._check_still_on([servo])
            self.bus.write(servo.id, FIELDS["torque_enable"], 1)
            if not self.bus.read(servo.id, FIELDS["torque_enable"]):
                raise Stopped(Fault(Cause.ARMING, f"{servo}: the torque stays off", (servo.id,)))
            self.loop.servo_armed(index, goal, servo.to_angle(present))
        # Another program may have switched torque off in the meantime; only servos that were armed later are still on.
        self._check_still_on(self._servos)
        units = watchdog_units(self.map.safety)
        self.loop.all_armed()
        for servo in self._servos:
            self.bus.write(servo.id, FIELDS["bus_watchdog"], units)
        self.journal.add_line(f"torque on, bus watchdogs set to {units * WATCHDOG_SECONDS_PER_UNIT * 1e3:.0f} ms")

    def _check_still_on(self, servos: Sequence[MappedServo]) -> None:
        """Raise Stopped if a servo has lost its torque, and NoAnswer if a servo does not answer."""
        health = read_health(self.bus, servos)
        for servo in servos:
            if servo.id not in health:
                raise NoAnswer(servo.id, garbled=False)
        lost = [servo for servo in servos if not health[servo.id]["torque_enable"]]
        if lost:
            names = ", ".join(map(str, lost))
            text = f"{names}: torque is off again (another program switched it off, or the servo restarted)"
            raise Stopped(Fault(Cause.TORQUE_LOST, text, tuple(servo.id for servo in lost)))

    def _move_to_start(self) -> None:
        here = self.loop.goal.copy()
        goal = np.where(self.loop.in_position_mode, self.motion.start, here)
        distance = float(np.abs(goal - here).max())
        duration = max(QUINTIC_PEAK * distance / self.map.safety.approach_velocity, self.loop.period)
        self.journal.enter(ReplayState.MOVE_TO_START)
        self.journal.add_line(f"move by up to {distance:.3f} rad in {duration:.1f} s")
        self.loop.begin()
        self.loop.follow(GoalCourse(Approach(here, goal, duration), 0.0, duration, speed=1.0))
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
            raise Stopped(Fault(cause, f"the robot should be {asked}, but is {self.result.end_state}"))
        self._log_end()

    def _profile(self, servo: MappedServo, *, approaching: bool) -> dict[str, int]:
        """Return the limits for the firmware's motion profile: slow on the approach, at the joint limit in the replay.

        A value of 0 means "no limit". It is never used for the velocity; for the acceleration, it is used in the
        replay, so that the path determines the motion.
        """
        velocity = (
            min(2 * self.map.safety.approach_velocity, velocity_limit(servo)) if approaching else velocity_limit(servo)
        )
        acceleration = APPROACH_ACCELERATION if approaching else 0.0
        return {
            "profile_velocity": max(1, math.ceil(velocity * servo.gear / RAD_S_PER_UNIT)),
            "profile_acceleration": math.ceil(acceleration * servo.gear / RAD_S2_PER_UNIT),
        }

    def _faults_of(self, error: BaseException) -> tuple[Fault, ...]:
        """Return the faults that correspond to an error of the motion."""
        match error:
            case Stopped():
                return error.faults
            case PortError():
                return (Fault(Cause.PORT, str(error)),)
            case NoAnswer() | RequestRefused():
                cause = Cause.ARMING if self.result.fault_state == ReplayState.ARM else Cause.VERIFICATION
                busy = too_busy(self.bus) if isinstance(error, NoAnswer) else ""
                return (Fault(cause, f"{error}{busy and '; '}{busy}", (error.id,)),)
            case SimulationStopped():
                return (Fault(Cause.SIMULATION, f"the simulated robot of the virtual servos (--plant) {error}"),)
        return (Fault(Cause.PROGRAM, brief(error)),)

    def _react(self, struck: ReplayState, errors: Sequence[BaseException]) -> None:
        """Declare the faults of all errors since the motion, apply the fault policy, and read the state of the servos.

        This function is called again after an error in it.
        """
        result = self.result
        result.fault_state = struck
        if math.isnan(result.fault_time):
            result.fault_time = self.clock.now()
        # Stop the robot first, and write the log afterwards.
        with self.journal.buffered():
            self.journal.enter(ReplayState.FAULT)
            for fault in (fault for error in errors for fault in self._faults_of(error)):
                result.declare(replace(fault, time=result.fault_time))
                self.journal.add_line(f"in {struck.name}: {fault.cause}: {fault.text}")
            self._ending.after_fault(struck, found_holding=self._found_holding)
            armed = struck not in UNARMED or self.stop.for_release
            if armed or result.faults[0].cause != Cause.PORT:
                self._ending.read_back(armed=armed)

    def _report(self, struck: ReplayState, errors: Sequence[BaseException]) -> None:
        """Write the state of the servos after a fault, and tracebacks of program errors, to the log."""
        self._log_end()
        if (struck not in UNARMED or self.stop.for_release) and self.result.end_state != "unreachable":
            registers = self._read_registers()
            if self._ending.release_at_last():
                self._log_end()
            self._dump(registers, REGISTERS_AFTER_FAULT)
        for error in errors:
            if self._faults_of(error)[0].cause == Cause.PROGRAM:
                for line in traceback.format_exception(error):
                    self.journal.add_line(line.rstrip())

    def _log_end(self) -> None:
        self.journal.add_line(f"end state: {self.result.end_state}")
        for servo in self.result.servos:
            self.journal.add_line(str(servo))

    def _read_registers(self) -> dict[str, Registers | str] | None:
        """Read the registers of all servos for a register dump; return None if the port fails after a fault."""
        try:
            return all_registers(self.bus, self.map)
        except PortError as error:
            if self.result.fault is None:
                raise
            self.journal.add_line(f"no register dump was written: {error}")
            return None

    def _dump(self, registers: dict[str, Registers | str] | None, name: str) -> None:
        if self.dump_folder and registers is not None:
            self.journal.guard(name, write_json, self.dump_folder / name, registers)

    def _finish(self) -> None:
        self.journal.guard(RECORD, self._sum_up)
        if self.result.timing:
            timing = ", ".join(f"{name} {value:.6g}" for name, value in self.result.timing.items())
            self.journal.add_line(f"timing: {timing}")

    def _sum_up(self) -> None:
        """Build the measured record and the timing statistics of the run."""
        result, rows = self.result, self.recorder.all()
        started = self.loop.path_started if self.loop.path_started is not None else self.loop.origin
        record = measured_record(rows, self.layout, started)
        result.timing = record.summary["timing"]
        describe(record, self.motion.scene, self.motion.unmeasured)
        record.complete = result.fault is None
        for fault in result.faults:
            record.add_event(fault.time - started, "fault", fault.cause.value, description=fault.text)
        record.summary |= result.summary()
        result.record = record
