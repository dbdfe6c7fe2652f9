"""The abort rules: from what one cycle brought in, whether the replay may go on.

Every rule has a bound on its reaction, in cycles from the first cycle in which the trouble can be seen on the wire to
the cycle in which the fault is declared; :func:`reaction_bound` gives it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import HEALTH_BLOCK, VOLT_PER_UNIT, describe_hardware_error
from dynsim.hardware.replay.check import CyclePlan
from dynsim.hardware.servo_map import Servo, ServoMap


class Cause(StrEnum):
    """Why a replay stopped."""

    INTERRUPTED = "interrupted"
    PORT = "port"
    VERIFICATION = "verification"
    ARMING = "arming"
    MISSED_STATUS = "missed status"
    ALERT = "hardware alert"
    TORQUE_LOST = "torque lost"
    WATCHDOG = "watchdog tripped"
    FOLLOWING_ERROR = "following error"
    TORQUE = "torque"
    VOLTAGE = "voltage"
    TEMPERATURE = "temperature"
    DEADLINE = "deadline"
    NOT_SETTLED = "not settled"
    GOAL_GUARD = "goal guard"
    PROGRAM = "program error"


@dataclass(frozen=True)
class Fault:
    """One declared fault.

    Attributes
    ----------
    cause : Cause
    text : str
        For the log and the user.
    ids : tuple of int
        Servos that are in trouble; empty when none is singled out.
    """

    cause: Cause
    text: str
    ids: tuple[int, ...] = ()


@dataclass
class Cycle:
    """What one cycle commanded and measured; arrays of shape (N,) in the order of the map, joint coordinates.

    Attributes
    ----------
    goal_position, goal_velocity : array
        [rad], [rad/s].
    position, velocity, torque : array
        Measured; NaN where the status was missed. [rad], [rad/s], [N·m].
    alert : bool array
    lateness : float
        Start after the deadline [s].
    health : dict
        Registers of the servo whose health was read, by ID; empty when none was.
    """

    goal_position: NDArray[np.float64]
    goal_velocity: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    torque: NDArray[np.float64]
    alert: NDArray[np.bool_]
    lateness: float
    health: dict[int, dict[str, int]] = field(default_factory=dict)

    @property
    def missed(self) -> NDArray[np.bool_]:
        return np.isnan(self.position)


def reaction_bound(cause: Cause, servo_map: ServoMap, plan: CyclePlan) -> int:
    """Cycles within which a rule declares its fault, counted from the first cycle that shows it."""
    safety = servo_map.safety
    in_turn = len(servo_map.servos) * plan.health_every
    return {
        Cause.MISSED_STATUS: safety.missed_cycles,
        Cause.FOLLOWING_ERROR: safety.following_cycles,
        Cause.TORQUE: safety.torque_cycles,
        Cause.DEADLINE: safety.late_cycles,
        Cause.ALERT: 1,
        Cause.TORQUE_LOST: in_turn,
        Cause.WATCHDOG: in_turn,
        Cause.VOLTAGE: in_turn,
        Cause.TEMPERATURE: in_turn,
    }.get(cause, 1)


class AbortRules:
    """Watches a replay cycle by cycle."""

    def __init__(self, servo_map: ServoMap, plan: CyclePlan) -> None:
        count = len(servo_map.servos)
        self._servos = servo_map.servos
        self._safety = servo_map.safety
        self._late_after = 1.0 / plan.rate
        self._in_position_mode = np.array([servo.in_position_mode for servo in self._servos])
        self._following_limit = np.array([servo.kind.following_error for servo in self._servos])
        self._torque_limit = np.array([servo.kind.limits.torque for servo in self._servos])
        self._missed = np.zeros(count, dtype=int)
        self._following = np.zeros(count, dtype=int)
        self._torque = np.zeros(count, dtype=int)
        self._late = 0

    def following_error(self, cycle: Cycle) -> NDArray[np.float64]:
        """Commanded minus measured, shape (N,): [rad] in position mode, [rad/s] in velocity mode."""
        return np.where(
            self._in_position_mode, cycle.goal_position - cycle.position, cycle.goal_velocity - cycle.velocity
        )

    def examine(self, cycle: Cycle) -> Fault | None:
        """The gravest fault this cycle shows, or None."""
        missed = cycle.missed
        error = np.abs(self.following_error(cycle))
        self._missed = np.where(missed, self._missed + 1, 0)
        # A missed status says nothing about error and torque: their counters neither grow nor start anew.
        self._following = _count(self._following, error > self._following_limit, missed)
        self._torque = _count(self._torque, np.abs(cycle.torque) > self._torque_limit, missed)
        self._late = self._late + 1 if cycle.lateness > self._late_after else 0
        return (
            self._alert(cycle)
            or self._health(cycle)
            or self._repeated(Cause.MISSED_STATUS, self._missed, self._safety.missed_cycles, "no status")
            or self._repeated(
                Cause.FOLLOWING_ERROR, self._following, self._safety.following_cycles, "off its goal", error
            )
            or self._repeated(Cause.TORQUE, self._torque, self._safety.torque_cycles, "too much torque", cycle.torque)
            or self._deadline(cycle)
        )

    def _alert(self, cycle: Cycle) -> Fault | None:
        hit = [servo for servo, alert in zip(self._servos, cycle.alert, strict=True) if alert]
        if not hit:
            return None
        names = ", ".join(f"{servo.joint} (ID {servo.id})" for servo in hit)
        return Fault(Cause.ALERT, f"hardware alert of {names}", tuple(servo.id for servo in hit))

    def _health(self, cycle: Cycle) -> Fault | None:
        for id_, registers in cycle.health.items():
            servo = next(servo for servo in self._servos if servo.id == id_)
            fault = self._unfit(servo, registers)
            if fault:
                return fault
        return None

    def _unfit(self, servo: Servo, registers: dict[str, int]) -> Fault | None:
        who, ids = f"{servo.joint} (ID {servo.id})", (servo.id,)
        volts = registers["present_voltage"] * VOLT_PER_UNIT
        celsius = registers["present_temperature"]
        supply = self._safety.supply
        if registers["hardware_error"]:
            return Fault(Cause.ALERT, f"{who}: {describe_hardware_error(registers['hardware_error'])}", ids)
        if registers["bus_watchdog"] == -1:
            return Fault(Cause.WATCHDOG, f"{who}: its bus watchdog has tripped, it ignores goals", ids)
        if not registers["torque_enable"]:
            return Fault(Cause.TORQUE_LOST, f"{who}: torque is off (restarted?)", ids)
        if celsius > self._safety.temperature_max:
            return Fault(Cause.TEMPERATURE, f"{who}: {celsius} °C, limit {self._safety.temperature_max:g} °C", ids)
        if not supply.lowest <= volts <= supply.highest:
            return Fault(Cause.VOLTAGE, f"{who}: {volts:.1f} V, allowed {supply.lowest:g} to {supply.highest:g} V", ids)
        return None

    def _repeated(
        self,
        cause: Cause,
        counters: NDArray[np.int64],
        allowed: int,
        what: str,
        values: NDArray[np.float64] | None = None,
    ) -> Fault | None:
        hit = np.flatnonzero(counters >= allowed)
        if not hit.size:
            return None
        names = ", ".join(
            f"{self._servos[k].joint} (ID {self._servos[k].id}{'' if values is None else f', {values[k]:.3f}'})"
            for k in hit
        )
        return Fault(cause, f"{what} for {allowed} cycles: {names}", tuple(self._servos[k].id for k in hit))

    def _deadline(self, cycle: Cycle) -> Fault | None:
        if self._late < self._safety.late_cycles:
            return None
        return Fault(
            Cause.DEADLINE, f"{self._late} cycles in a row started late, the last by {cycle.lateness * 1e3:.1f} ms"
        )


def _count(counters: NDArray[np.int64], hit: NDArray[np.bool_], unknown: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.where(unknown, counters, np.where(hit, counters + 1, 0))


def decode_health(servo: Servo, data: bytes) -> dict[str, int]:
    """Registers in a health block, by name."""
    start, length = HEALTH_BLOCK
    return {
        name: item.decode(data[item.address - start : item.address - start + item.size])
        for name, item in servo.model.fields.items()
        if start <= item.address and item.address + item.size <= start + length
    }
