"""How a replay leaves the robot: at rest and holding, or without torque; after a fault nothing else is sent."""

from __future__ import annotations

from collections.abc import Iterable

from dynsim.hardware.bus.protocol import NoAnswer, RequestRefused
from dynsim.hardware.replay.journal import Journal
from dynsim.hardware.replay.loop import FIELDS, Loop
from dynsim.hardware.replay.rules import Cause, Fault
from dynsim.hardware.replay.states import UNARMED, EndState, ReplayResult, State
from dynsim.hardware.servo_map import FaultPolicy


class Ending:
    """Brings the robot to one of the end states.

    Parameters
    ----------
    loop : Loop
    journal : Journal
    result : ReplayResult
        Gets the IDs that did not confirm torque off.
    policy : "hold", "decelerate" or "off"
    """

    def __init__(self, loop: Loop, journal: Journal, result: ReplayResult, policy: FaultPolicy) -> None:
        self._loop = loop
        self._journal = journal
        self._result = result
        self._policy = policy
        self._servos = loop.map.servos

    def regular(self) -> EndState:
        """What the map says about the end of a motion."""
        return self.leave_holding() if self._loop.map.safety.at_end == "hold" else self.release()

    def after_fault(self, fault: Fault, struck: State, *, found_holding: bool) -> EndState:
        """Carry out the fault policy.

        Parameters
        ----------
        struck : State
            In which the fault happened.
        found_holding : bool
            Torque was on before the robot was armed.
        """
        stop = self._loop.stop
        if stop.for_release:
            return self.release()
        if struck in UNARMED:
            return "not armed"
        if struck == State.DISARM:
            return self.regular()
        if struck == State.ARM:
            # Nothing has moved yet: back to how the robot was found.
            return self.leave_holding() if found_holding else self.release()
        # A dead port needs no policy, but the attempt costs nothing and finds out whether it is really dead.
        if self._policy == "off" and fault.cause != Cause.INTERRUPTED:
            return self.release()
        if self._policy == "hold" and fault.cause != Cause.INTERRUPTED:
            self._hold_measured(range(len(self._servos)))
        else:
            self._decelerate(fault, struck)
        if stop.for_release or self._policy == "off":
            return self.release()
        return self.leave_holding()

    def _hold_measured(self, indices: Iterable[int]) -> None:
        """Goals of the given servos := where they are."""
        goals: dict[str, dict[int, int]] = {"goal_position": {}, "goal_velocity": {}}
        for index in indices:
            servo = self._servos[index]
            if not servo.in_position_mode:
                goals["goal_velocity"][servo.id] = 0
                continue
            ticks = servo.to_ticks(float(self._loop.measured[index]))
            low, high = servo.tick_limits
            if low <= ticks <= high:
                goals["goal_position"][servo.id] = ticks
            # A reading outside of the joint's limits is not to be trusted: that servo keeps its last goal.
        self._loop.write_goals(goals)

    def _decelerate(self, fault: Fault, struck: State) -> None:
        """Slow down along the path to rest, so that all joints keep step; servos in trouble stop where they are."""
        loop = self._loop
        troubled = [index for index, servo in enumerate(self._servos) if servo.id in fault.ids]
        self._hold_measured(troubled)
        if loop.following is None:
            return
        start, end, speed = loop.following_time, loop.following_end, loop.following_speed
        if struck == State.SETTLE:
            speed = 0.0
        stop_time = loop.map.safety.stop_time
        healthy = [index for index in range(len(self._servos)) if index not in troubled]
        first = loop.tick
        while (elapsed := (loop.tick - first) * loop.period) < stop_time and not loop.stop.for_release:
            loop.wait_for_deadline()
            elapsed = min(stop_time, (loop.tick - first) * loop.period)
            loop.following_time = min(end, start + speed * (elapsed - elapsed**2 / (2 * stop_time)))
            position, rate = loop.following.at(loop.following_time)
            velocity = rate * speed * (1 - elapsed / stop_time)
            goals: dict[str, dict[int, int]] = {"goal_position": {}, "goal_velocity": {}}
            for index in healthy:
                servo = self._servos[index]
                name = "goal_position" if servo.in_position_mode else "goal_velocity"
                units = servo.to_velocity_units(float(velocity[index]))
                goals[name][servo.id] = servo.to_ticks(float(position[index])) if servo.in_position_mode else units
                loop.goal[index], loop.goal_rate[index] = position[index], velocity[index]
            loop.write_goals(goals)
            loop.exchange(0.0, 0, write=False)

    def leave_holding(self) -> EndState:
        """Watchdogs off, so that the robot keeps holding when this program has gone."""
        silent = []
        for servo in self._servos:
            if self._loop.stop.for_release:
                return self.release()
            try:
                self._loop.bus.write(servo.id, FIELDS["bus_watchdog"], 0)
            except (NoAnswer, RequestRefused):
                silent.append(servo.joint)
        if silent:
            self._journal.say(f"no answer from {', '.join(silent)}: whether they hold is not known")
        self._journal.say("torque stays ON, the robot holds; `dynsim hw stop` releases it")
        return "holding"

    def release(self) -> EndState:
        """Torque off by broadcast, then ask every servo."""
        self._loop.bus.torque_off_all()
        still_on = []
        for servo in self._servos:
            try:
                if self._loop.bus.read(servo.id, FIELDS["torque_enable"]):
                    still_on.append(servo.id)
            except (NoAnswer, RequestRefused):
                still_on.append(servo.id)
        self._result.torque_still_on = tuple(still_on)
        confirmed = f"; NOT confirmed by ID {', '.join(map(str, still_on))}" if still_on else ""
        self._journal.say(f"torque off{confirmed}")
        return "off"
