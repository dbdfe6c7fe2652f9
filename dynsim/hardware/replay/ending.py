"""End of a replay: stops the robot and leaves torque on, or switches torque off, then reads the state of the servos.

After a fault nothing is sent beyond what the fault policy needs. Nothing here writes to a log, a terminal or a file. A
step that fails does not prevent the next ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from dynsim.hardware.bus.control_table import HEALTH_BLOCK, describe_hardware_error
from dynsim.hardware.bus.protocol import Bus, NoAnswer, RequestRefused
from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.loop import FIELDS, Array, GoalRegisters, Loop, goal_registers
from dynsim.hardware.replay.output import Journal
from dynsim.hardware.replay.rules import Cause, Cycle, Fault, decode_health
from dynsim.hardware.replay.states import (
    HOLDING,
    LIMP,
    MOVING,
    NOT_ARMED,
    TRIPPED,
    UNARMED,
    ReplayResult,
    ReplayState,
    ServoEnd,
    of_the_whole,
)
from dynsim.hardware.safety import FaultPolicy
from dynsim.hardware.servo_map import MappedServo

REST_TIME = 1.0
"""Longest wait for the servos to stand still, and for silent ones to come back (a restart takes 0.3 s) [s]."""
REST_CYCLES = 10
AT_REST = 0.1
"""Joints and wheels slower than this are at rest [rad/s]; a few units of the velocity register."""
READS = 3
"""Reads after which a servo that has not answered counts as silent."""


class Ending:
    """Brings the robot to one of the end states.

    Parameters
    ----------
    loop : Loop
    journal : Journal
    result : ReplayResult
        Gets further faults, what every servo does in the end, and the IDs that did not confirm torque off.
    policy : "hold", "decelerate" or "off"
    """

    def __init__(self, loop: Loop, journal: Journal, result: ReplayResult, policy: FaultPolicy) -> None:
        self._loop = loop
        self._journal = journal
        self._result = result
        self._policy = policy
        self._servos = loop.map.servos
        self._troubled: set[int] = set()
        self._held = self._released = False
        self._at_rest = False

    def regular(self) -> None:
        """What the map says about the end of a motion. Raises PortError."""
        if self._loop.map.safety.at_end == "hold":
            self._leave_holding()
        else:
            self._release()

    def after_fault(self, struck: ReplayState, *, found_holding: bool) -> None:
        """Carry out the fault policy for the faults of the result; raises nothing.

        Parameters
        ----------
        struck : ReplayState
            In which the fault happened.
        found_holding : bool
            Torque was on before the robot was armed.
        """
        self._at_rest = struck == ReplayState.SETTLE
        interrupted = self._result.faults[0].cause == Cause.INTERRUPTED
        if self._loop.stop.for_release:
            self._try(self._release)
        elif struck in UNARMED:
            return
        elif struck == ReplayState.DISARM:
            self._try(self.regular)
        elif struck == ReplayState.ARM:
            # Nothing has moved yet: back to how the robot was found, unless somebody else took its torque meanwhile.
            taken = any(fault.cause == Cause.TORQUE_LOST for fault in self._result.faults)
            self._try(self._leave_holding if found_holding and not taken else self._release)
        elif self._policy == "off" and not interrupted:
            self._try(self._release)
        else:
            # A dead port needs no policy, but the attempt costs nothing and finds out whether it is really dead.
            if not self._try(self._hold if self._policy == "hold" and not interrupted else self._decelerate):
                self._try(self._hold)
            self._try(self._come_to_rest)
            self._try(self._release if self._policy == "off" else self._leave_holding)

    def release_at_last(self) -> bool:
        """Torque off if the user has asked for it since the policy was carried out; raises nothing."""
        if self._released or not self._loop.stop.for_release:
            return False
        self._try(self._release)
        self.read_back(armed=True)
        return True

    def read_back(self, *, armed: bool) -> None:
        """Ask every servo what it does, and derive from it what the robot does; raises nothing."""
        self._result.servos = tuple(ServoEnd(servo.joint, servo.id) for servo in self._servos)
        self._try(self._ask)
        self._result.end_state = of_the_whole(self._result.servos) if armed else NOT_ARMED

    def _ask(self) -> None:
        self._result.servos = read_back(self._loop.bus, self._servos)

    # -- what goes wrong on the way -----------------------------------------------------------------------------------

    def _try(self, step: Callable[[], None]) -> bool:
        """Whether a step went through; why not becomes a fault of the result."""
        try:
            step()
        except PortError as error:
            if all(fault.cause != Cause.PORT for fault in self._result.faults):
                self._declare(Fault(Cause.PORT, f"{error}; armed servos stop by their bus watchdog"))
        except Exception as error:
            self._declare(Fault(Cause.PROGRAM, repr(error)))
        except BaseException as error:
            # Somebody wants out, and gets out when the robot has been seen to.
            self._loop.stop()
            self._declare(Fault(Cause.PROGRAM, repr(error)))
        else:
            return True
        return False

    def _declare(self, fault: Fault) -> None:
        self._result.declare(replace(fault, time=self._loop.now()))
        self._journal.say(f"{fault.cause}: {fault.text}")

    def _watch(self, lateness: float, skipped: int) -> Cycle:
        """Read; the rules go on, and who gets into trouble stops where it is."""
        loop = self._loop
        cycle = loop.exchange(lateness, skipped, write=False)
        # The goals that follow do not depend on when they are sent.
        for fault in loop.rules.examine(cycle):
            if fault.cause != Cause.DEADLINE:
                self._declare(fault)
                self._stop_where_they_are(fault)
        return cycle

    def _stop_where_they_are(self, fault: Fault) -> None:
        if self._held:
            return
        if fault.cause == Cause.STALL:
            self._hold()
        else:
            self._hold_measured(self._known_as(fault.ids))

    def _known_as(self, ids: Collection[int]) -> list[int]:
        """Numbers of servos in the map, of which none was in trouble before."""
        indices = [index for index, servo in enumerate(self._servos) if servo.id in ids and index not in self._troubled]
        self._troubled.update(indices)
        return indices

    # -- ways of stopping ---------------------------------------------------------------------------------------------

    def _hold(self) -> None:
        """Goals of all servos := where they are."""
        self._held = True
        if any(fault.cause == Cause.STALL for fault in self._result.faults):
            # What was read last is from before.
            self._loop.exchange(0.0, 0, write=False)
        self._hold_measured(range(len(self._servos)))

    def _hold_measured(self, indices: Iterable[int]) -> None:
        """Goals of the given servos := where they are."""
        loop = self._loop
        goals: GoalRegisters = {"goal_position": {}, "goal_velocity": {}}
        for index in indices:
            servo = self._servos[index]
            loop.goal_rate[index] = 0.0
            if not servo.in_position_mode:
                goals["goal_velocity"][servo.id] = 0
                continue
            ticks = servo.to_ticks(float(loop.measured[index]))
            low, high = servo.tick_limits
            if low <= ticks <= high:
                goals["goal_position"][servo.id] = ticks
                loop.goal[index] = loop.measured[index]
            # A reading outside of the joint's limits is not to be trusted: that servo keeps its last goal.
        loop.write_goals(goals)

    def _decelerate(self) -> None:
        """Slow down along the path to rest, so that all joints keep step; servos in trouble stop where they are."""
        loop, faults = self._loop, self._result.faults
        if any(fault.cause == Cause.STALL for fault in faults):
            # They have stopped by themselves, and take no goals.
            return self._hold()
        self._hold_measured(self._known_as([id_ for fault in faults for id_ in fault.ids]))
        course = loop.course
        if course is None:
            return None
        start, end = course.time, course.end
        speed = 0.0 if self._at_rest else course.speed
        stop_time = course.braking_time(loop.map.safety.stop_time)
        elapsed, goals = 0.0, 0
        while elapsed < stop_time and not loop.stop.for_release and not self._held:
            lateness, skipped = loop.wait_for_deadline()
            stall = loop.stall()
            if stall:
                self._declare(stall)
                return self._hold()
            goals += 1
            elapsed = min(stop_time, goals * loop.period)
            course.time = min(end, start + speed * (elapsed - elapsed**2 / (2 * stop_time)))
            position, rate = course.at(course.time)
            velocity = rate * speed * (1 - elapsed / stop_time)
            self._send(position, velocity)
            self._watch(lateness, skipped)
        return None

    def _send(self, position: Array, velocity: Array) -> None:
        """Goals [rad], [rad/s] of the servos that are not in trouble."""
        loop = self._loop
        well = [index for index in range(len(self._servos)) if index not in self._troubled]
        loop.goal[well], loop.goal_rate[well] = position[well], velocity[well]
        loop.write_goals(goal_registers([self._servos[index] for index in well], position[well], velocity[well]))

    def _come_to_rest(self) -> None:
        """Wait until everybody answers and stands still, for REST_TIME at most."""
        quiet = 0
        for _ in range(math.ceil(REST_TIME / self._loop.period)):
            if self._loop.stop.for_release:
                return
            cycle = self._watch(*self._loop.wait_for_deadline())
            # A servo that is silent is not at rest: it may be restarting.
            quiet = quiet + 1 if np.all(np.abs(cycle.velocity) < AT_REST) else 0
            if quiet == REST_CYCLES:
                return

    def _leave_holding(self) -> None:
        """Watchdogs off, so that the robot keeps holding when this program has gone. Raises PortError."""
        loop = self._loop
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
                # It stopped by itself, and took no goal until now.
                loop.measured[index] = servo.to_angle(registers["present_position"])
                self._hold_measured([index])
        if unconfirmed:
            self._journal.say(
                f"watchdogs not confirmed to be off, they may stop these servos: {'; '.join(unconfirmed)}"
            )
        return self._journal.say("servos that are on stay ON; `dynsim hw stop` releases them")

    def _release(self) -> None:
        """Torque off by broadcast, until all confirm or REST_TIME is over; then watchdogs off. Raises PortError."""
        loop, until = self._loop, self._loop.now() + REST_TIME
        self._released = True
        while True:
            loop.bus.torque_off_all()
            health = read_health(loop.bus, self._servos)
            still_on = [id_ for id_ in loop.map.ids if id_ not in health or health[id_]["torque_enable"]]
            self._result.torque_still_on = tuple(still_on)
            if not still_on or loop.now() >= until:
                break
            loop.pause(REST_TIME / 10)
        # Of those that are off: a watchdog that trips later would leave goals read-only for whoever comes next.
        for id_ in loop.map.ids:
            if id_ not in still_on and health[id_]["bus_watchdog"]:
                with suppress(NoAnswer, RequestRefused):
                    loop.bus.write(id_, FIELDS["bus_watchdog"], 0)
        confirmed = f"; NOT confirmed by ID {', '.join(map(str, still_on))}" if still_on else ""
        self._journal.say(f"torque off{confirmed}")


def read_health(bus: Bus, servos: Sequence[MappedServo]) -> dict[int, dict[str, int]]:
    """Registers 64 to 146 of every servo that answers, by ID and name.

    Raises
    ------
    PortError
    """
    health: dict[int, dict[str, int]] = {}
    for _ in range(READS):
        silent = [servo for servo in servos if servo.id not in health]
        if not silent:
            break
        replies = bus.sync_read([servo.id for servo in silent], *HEALTH_BLOCK).replies
        health |= {servo.id: decode_health(servo, replies[servo.id].data) for servo in silent if servo.id in replies}
    return health


def read_back(bus: Bus, servos: Sequence[MappedServo]) -> tuple[ServoEnd, ...]:
    """What every servo is doing now. Raises PortError."""
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
