"""The control loop of a replay: at each deadline it writes goals, reads states, records and checks them.

Cycles start at absolute deadlines. A cycle that is more than a period late is skipped; the path waits meanwhile.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.bus.control_table import HEALTH_BLOCK, MX_106, RAD_PER_TICK, STATE_BLOCK
from dynsim.hardware.bus.protocol import Bus
from dynsim.hardware.replay.check import velocity_limit
from dynsim.hardware.replay.motion import GoalCourse, MotionTask
from dynsim.hardware.replay.output import Journal, Recorder
from dynsim.hardware.replay.rules import AbortRules, Cause, Cycle, Fault, decode_health
from dynsim.hardware.replay.states import ReplayState, Stopped, StopRequest
from dynsim.hardware.servo_map import MappedServo, ServoMap

Array = NDArray[np.float64]

FIELDS = MX_106.fields
"""Registers that all models share have the same address in all of them."""
STATE = struct.Struct("<hii")
"""Effort, velocity and position in a block of :data:`~dynsim.hardware.bus.control_table.STATE_BLOCK`."""


GoalRegisters = dict[str, dict[int, int]]
"""By the name of the register and the ID of the servo."""


def goal_registers(
    servos: Iterable[MappedServo], position: Iterable[float], velocity: Iterable[float]
) -> GoalRegisters:
    """Of servos in position mode the ticks of their angles [rad], of the others units of their rates [rad/s]."""
    goals: GoalRegisters = {"goal_position": {}, "goal_velocity": {}}
    for servo, angle, rate in zip(servos, position, velocity, strict=True):
        if servo.in_position_mode:
            goals["goal_position"][servo.id] = servo.to_ticks(float(angle))
        else:
            goals["goal_velocity"][servo.id] = servo.to_velocity_units(float(rate))
    return goals


class Loop:
    """Goals out, measurements in, cycle by cycle.

    Attributes
    ----------
    map : ServoMap
    bus : Bus
    stop : StopRequest
    rules : AbortRules
    period : float
        [s].
    goal, goal_rate : array, shape (N,)
        Commanded last [rad], [rad/s].
    measured : array, shape (N,)
        Where every joint was seen last [rad].
    origin, tick :
        Clock time [s] of the first deadline, and the number of the last one.
    course : GoalCourse or None
        What is followed, or was last.
    path_started : float or None
        Clock time [s] of path time 0, once the replay of the path began.
    policy_goals : list
        (clock time, ID, register value) of every goal sent after a fault.
    """

    def __init__(
        self,
        motion: MotionTask,
        servo_map: ServoMap,
        bus: Bus,
        clock: Clock,
        stop: StopRequest,
        recorder: Recorder,
        journal: Journal,
    ) -> None:
        self.map = servo_map
        self.bus = bus
        self.stop = stop
        self.rules = AbortRules(servo_map, motion.plan)
        self.period = 1.0 / motion.plan.rate
        count = len(servo_map.servos)
        self.goal, self.goal_rate = np.zeros(count), np.zeros(count)
        self.measured = np.zeros(count)
        self.origin = clock.now()
        self.tick = 0
        self.course: GoalCourse | None = None
        self.path_started: float | None = None
        self.policy_goals: list[tuple[float, int, int]] = []
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._in_position_mode = np.array([servo.in_position_mode for servo in servo_map.servos])
        # What may be sent: lowest and highest tick and the longest step from goal to goal, or the highest speed.
        self._tick_bounds = [
            (*servo.tick_limits, velocity_limit(servo) * servo.gear * 2 * self.period / RAD_PER_TICK + 2)
            for servo in servo_map.servos
        ]
        self._unit_bounds = [abs(servo.to_velocity_units(velocity_limit(servo))) for servo in servo_map.servos]
        self._health_every = motion.plan.health_every
        self._cycles = 0
        self._sent: dict[int, int] = {}
        self._heard_at = math.inf

    def take_over(self, index: int, register: int, angle: float) -> None:
        """A servo was armed where it is: at the goal ``register``, at a joint angle [rad]."""
        self._sent[self.map.servos[index].id] = register
        self.goal[index] = self.measured[index] = angle

    def all_taken_over(self) -> None:
        """All are armed; from now on silence makes their watchdogs trip."""
        self._heard_at = self._clock.now()

    def stall(self) -> Fault | None:
        """The fault of having been silent for longer than the servos' watchdogs allow, until now."""
        silence = self._clock.now() - self._heard_at
        return self.rules.stall(silence) if self.rules.stalled(silence) else None

    def now(self) -> float:
        """[s]."""
        return self._clock.now()

    def pause(self, duration: float) -> None:
        """Let a time pass [s]."""
        self._clock.sleep_until(self._clock.now() + duration)

    def begin(self) -> None:
        """Deadlines count from now."""
        self.origin, self.tick = self._clock.now(), 0

    def deadline_of(self, tick: int) -> float:
        return self.origin + tick * self.period

    def wait_for_deadline(self) -> tuple[float, int]:
        """Sleep until the next cycle is due; its lateness [s] and the number of cycles skipped."""
        self.tick += 1
        behind = math.floor((self._clock.now() - self.deadline_of(self.tick)) / self.period)
        skipped = max(0, behind)
        self.tick += skipped
        self._clock.sleep_until(self.deadline_of(self.tick))
        return self._clock.now() - self.deadline_of(self.tick) + skipped * self.period, skipped

    def follow(self, course: GoalCourse) -> None:
        """Go along a course to its end.

        From goal to goal one period of it passes, also where cycles in between were skipped: made up for at once they
        would be one great step.
        """
        self.course = course
        while not course.over:
            lateness, skipped = self.wait_for_deadline()
            self.stop.check()
            position, velocity = course.advance(self.period)
            self._cycle(position, velocity, lateness, skipped)

    def stay(self, position: Array) -> Cycle:
        """One cycle at rest."""
        lateness, skipped = self.wait_for_deadline()
        self.stop.check()
        return self._cycle(position, np.zeros_like(position), lateness, skipped)

    def look(self) -> None:
        """One cycle that only reads."""
        lateness, skipped = self.wait_for_deadline()
        self.stop.check()
        self.exchange(lateness, skipped, write=False)

    def _cycle(self, position: Array, velocity: Array, lateness: float, skipped: int) -> Cycle:
        stall = self.stall()
        if stall:
            # Servos that stopped by themselves must not be sent to where they would be by now.
            raise Stopped(stall)
        self.goal, self.goal_rate = position, velocity
        cycle = self.exchange(lateness, skipped, write=True)
        faults = self.rules.examine(cycle)
        if faults:
            raise Stopped(*faults)
        return cycle

    def exchange(self, lateness: float, skipped: int, *, write: bool) -> Cycle:
        """Write all goals, read all states (and one servo's health in turn), record."""
        began = self._clock.now()
        if write:
            self._send(self.goal, self.goal_rate)
        block = self.bus.sync_read(self.map.ids, *STATE_BLOCK)
        exchange = self._clock.now() - began
        servos = self.map.servos
        count = len(servos)
        position, velocity, torque = np.full((3, count), np.nan)
        alert = np.zeros(count, dtype=bool)
        for index, servo in enumerate(servos):
            reply = block.replies.get(servo.id)
            if reply is None:
                continue
            effort, units, ticks = STATE.unpack(reply.data)
            torque[index] = servo.to_torque(effort)
            velocity[index] = servo.to_velocity(units)
            position[index] = servo.to_angle(ticks)
            alert[index] = reply.alert
        cycle = Cycle(
            time=began,
            goal_position=self.goal.copy(),
            goal_velocity=self.goal_rate.copy(),
            position=position,
            velocity=velocity,
            torque=torque,
            alert=alert,
            lateness=lateness,
            skipped=skipped,
            exchange=exchange,
            stray=block.stray_bytes,
            outdated=tuple(block.outdated),
        )
        self.measured = np.where(cycle.missed, self.measured, cycle.position)
        self._cycles += 1
        if self._cycles % self._health_every == 0:
            servo = servos[self._cycles // self._health_every % count]
            # Like a sync read of one: a servo that is silent costs one time-out and no retry.
            answer = self.bus.sync_read((servo.id,), *HEALTH_BLOCK).replies.get(servo.id)
            if answer is not None:
                cycle.health[servo.id] = decode_health(servo, answer.data)
        now = self._clock.now()
        if self._heard_at < math.inf:
            cycle.silence, self._heard_at = max(began - self._heard_at, now - began), now
        origin = math.nan if self.path_started is None else self.path_started
        path_time = self.course.time if self.course and self.path_started is not None else math.nan
        self._journal.guard("record", self._recorder.add, cycle, self._journal.state, path_time, origin)
        self._report(cycle)
        return cycle

    def _report(self, cycle: Cycle) -> None:
        error = self.rules.following_error(cycle)[self._in_position_mode]
        worst = float(np.nanmax(np.abs(error))) if np.isfinite(error).any() else 0.0
        self._journal.report(worst, self.course.fraction if self.course else 0.0)

    def _send(self, position: Array, velocity: Array) -> None:
        """The only place goals of a motion leave through. Refuses what no checked motion can ask for."""
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
                raise Stopped(Fault(Cause.GOAL_GUARD, f"{servo.joint}: goal {goal} was not sent", (servo.id,)))
        self.write_goals(goals)

    def write_goals(self, goals: GoalRegisters) -> None:
        """Goal registers by name and ID, as they are."""
        for name, values in goals.items():
            if not values:
                continue
            self.bus.sync_write(FIELDS[name], values)
            self._sent.update(values)
            if self._journal.state == ReplayState.FAULT:
                now = self._clock.now()
                self.policy_goals += [(now, id_, value) for id_, value in values.items()]
