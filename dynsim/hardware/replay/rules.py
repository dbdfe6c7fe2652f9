"""Abort rules of a replay: conditions on the answers of a cycle that stop the motion.

Each rule has a bounded reaction time: the number of cycles from the first cycle whose answers show the fault to the
cycle that declares it. The bound is set in ``safety`` of the map; it is one cycle for an alert, and one round of health
reads of all servos for faults that only health reads can detect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import VOLT_PER_UNIT, WATCHDOG_SECONDS_PER_UNIT, describe_hardware_error
from dynsim.hardware.replay.trajectory import CyclePlan
from dynsim.hardware.servo_map import MappedServo, Safety, ServoMap


class Cause(StrEnum):
    """Cause of the end of a replay."""

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
    STALL = "stall"
    NOT_SETTLED = "not settled"
    GOAL_GUARD = "goal guard"
    END_STATE = "end state"
    LIMIT = "limit"
    SIMULATION = "simulation"
    PROGRAM = "program error"


@dataclass(frozen=True)
class Fault:
    """One declared fault.

    Attributes
    ----------
    cause : Cause
    text : str
        Message for the log and the user.
    ids : tuple of int
        IDs of the faulty servos; empty if the fault is not specific to some servos.
    time : float
        Time of the declaration, on the clock of the replay [s].
    """

    cause: Cause
    text: str
    ids: tuple[int, ...] = ()
    time: float = math.nan


@dataclass
class Cycle:
    """Commands and measurements of one cycle; arrays have shape (N,), in joint coordinates and the order of the map.

    Attributes
    ----------
    time : float
        Start of the cycle, on the clock of the replay [s].
    goal_position, goal_velocity : array
        Goals [rad], [rad/s].
    position, velocity, torque : array
        Measured values [rad], [rad/s], [N·m]; NaN if the status was missed.
    alert : bool array
        Alert bits of the statuses.
    lateness : float
        Delay of the start after the deadline [s].
    skipped : int
        Number of cycles skipped before this one.
    exchange : float
        Duration of the bus traffic without the health read [s].
    stray : int
        Number of bytes outside answers.
    silence : float
        Longest time without a packet to the servos, from the previous cycle to the end of this one [s].
    outdated : tuple of int
        IDs of servos that answered an earlier request instead of this one.
    health : dict
        Registers of the servo whose health was read, by ID; empty if none was read.
    """

    time: float
    goal_position: NDArray[np.float64]
    goal_velocity: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    torque: NDArray[np.float64]
    alert: NDArray[np.bool_]
    lateness: float
    skipped: int
    exchange: float
    stray: int
    silence: float = 0.0
    outdated: tuple[int, ...] = ()
    health: dict[int, dict[str, int]] = field(default_factory=dict)

    @property
    def missed(self) -> NDArray[np.bool_]:
        return np.isnan(self.position)


def watchdog_units(safety: Safety) -> int:
    """Return the watchdog time of the map in units of the servo register (20 ms), rounded up."""
    return math.ceil(safety.watchdog / WATCHDOG_SECONDS_PER_UNIT)


class AbortRules:
    """Check the cycles of a replay, from arming to the end of the fault policy.

    A fault is declared once per servo. Consequences of an earlier fault of a servo are not declared.
    """

    def __init__(self, servo_map: ServoMap, plan: CyclePlan) -> None:
        count = len(servo_map.servos)
        self._servos = servo_map.servos
        self._by_id = {servo.id: servo for servo in servo_map.servos}
        self._safety = servo_map.safety
        self._watchdog = watchdog_units(servo_map.safety) * WATCHDOG_SECONDS_PER_UNIT
        self._late_after = 1.0 / plan.rate
        self._in_position_mode = np.array([servo.in_position_mode for servo in self._servos])
        self._following_limit = np.array([servo.kind.following_error for servo in self._servos])
        self._torque_limit = np.array([servo.kind.limits.torque for servo in self._servos])
        self._missed = np.zeros(count, dtype=int)
        self._following = np.zeros(count, dtype=int)
        self._torque = np.zeros(count, dtype=int)
        self._late = 0
        self._declared: set[tuple[Cause, int | None]] = set()

    def following_error(self, cycle: Cycle) -> NDArray[np.float64]:
        """Return commanded minus measured, shape (N,): [rad] in position mode, [rad/s] in velocity mode."""
        return np.where(
            self._in_position_mode, cycle.goal_position - cycle.position, cycle.goal_velocity - cycle.velocity
        )

    def examine(self, cycle: Cycle) -> list[Fault]:
        """Return the faults that this cycle shows for the first time, the most severe first."""
        missed = cycle.missed
        error = np.abs(self.following_error(cycle))
        self._missed = np.where(missed, self._missed + 1, 0)
        # A missed status has no error and torque: their counters neither grow nor restart.
        self._following = _count(self._following, error > self._following_limit, missed)
        self._torque = _count(self._torque, np.abs(cycle.torque) > self._torque_limit, missed)
        self._late = self._late + 1 if cycle.lateness > self._late_after else 0
        safety = self._safety
        return [
            *filter(None, [self.stall(cycle.silence)]),
            *self._alert(cycle),
            *(fault for id_, registers in cycle.health.items() for fault in self._health(self._by_id[id_], registers)),
            *self._silent(np.flatnonzero(self._missed >= safety.missed_cycles), cycle),
            *self._beyond(
                Cause.FOLLOWING_ERROR, self._following >= safety.following_cycles, error,
                f"off its goal for {safety.following_cycles} cycles",
            ),
            *self._beyond(
                Cause.TORQUE, self._torque >= safety.torque_cycles, cycle.torque,
                f"too much torque for {safety.torque_cycles} cycles",
            ),
            *self._deadline(cycle),
        ]  # fmt: skip

    def stall(self, silence: float) -> Fault | None:
        """Declare a stall if no packet was sent for ``silence`` [s], long enough for the watchdogs to trip."""
        if silence <= self._watchdog:
            return None
        self._new(Cause.STALL)
        text = (
            f"stalled for {silence:.2f} s, so the bus watchdogs of the servos ({self._watchdog:.2f} s) have tripped; "
            "close other programs, or lower --rate"
        )
        return Fault(Cause.STALL, text)

    def _new(self, cause: Cause, id_: int | None = None) -> bool:
        """Mark a fault as declared and return True if it was not declared before."""
        known = (cause, id_) in self._declared
        self._declared.add((cause, id_))
        return not known

    def _newly(self, cause: Cause, indices: Iterable[int]) -> list[MappedServo]:
        """Mark a fault of some servos as declared and return the servos for which it was not declared before."""
        return [self._servos[k] for k in indices if self._new(cause, self._servos[k].id)]

    def _alert(self, cycle: Cycle) -> Iterator[Fault]:
        if hit := self._newly(Cause.ALERT, np.flatnonzero(cycle.alert)):
            text = f"hardware error reported by {', '.join(map(str, hit))}"
            yield Fault(Cause.ALERT, text, tuple(servo.id for servo in hit))

    def _health(self, servo: MappedServo, registers: dict[str, int]) -> Iterator[Fault]:
        celsius, volts = registers["present_temperature"], registers["present_voltage"] * VOLT_PER_UNIT
        texts: dict[Cause, str] = {}
        if registers["hardware_error"]:
            texts[Cause.ALERT] = describe_hardware_error(registers["hardware_error"])
        elif registers["bus_watchdog"] == -1 and (Cause.STALL, None) not in self._declared:
            texts[Cause.WATCHDOG] = "its bus watchdog has tripped, it ignores goals"
        elif not registers["torque_enable"]:
            texts[Cause.TORQUE_LOST] = "torque is off (restarted, or switched off by another program)"
        if celsius > self._safety.temperature_max:
            texts[Cause.TEMPERATURE] = f"{celsius} °C, limit {self._safety.temperature_max:g} °C"
        for cause, text in texts.items():
            if self._new(cause, servo.id):
                yield Fault(cause, f"{servo}: {text}", (servo.id,))
        supply = self._safety.supply
        if not supply.lowest <= volts <= supply.highest and self._new(Cause.VOLTAGE):
            # One supply feeds all servos, so the fault has no IDs and all servos stop synchronously.
            yield Fault(Cause.VOLTAGE, f"{servo}: {volts:.1f} V, allowed {supply.lowest:g} to {supply.highest:g} V")

    def _silent(self, indices: NDArray[np.intp], cycle: Cycle) -> Iterator[Fault]:
        if hit := self._newly(Cause.MISSED_STATUS, indices):
            text = f"no status for {self._safety.missed_cycles} cycles: {', '.join(map(str, hit))}"
            if outdated := [servo for servo in hit if servo.id in cycle.outdated]:
                text += f"; answers to earlier requests come from {', '.join(map(str, outdated))}"
            if len(indices) == len(self._servos) > 1:
                text += "; no servo answers: is the supply or the line lost?"
            yield Fault(Cause.MISSED_STATUS, text, tuple(servo.id for servo in hit))

    def _beyond(
        self, cause: Cause, over: NDArray[np.bool_], values: NDArray[np.float64], quantity: str
    ) -> Iterator[Fault]:
        # Ignore servos with an earlier fault: a servo without torque or answer is off its goal, too.
        in_trouble = {id_ for _, id_ in self._declared}
        if hit := self._newly(
            cause, [k for k in map(int, np.flatnonzero(over)) if self._servos[k].id not in in_trouble]
        ):
            value = {servo.id: values[k] for k, servo in enumerate(self._servos)}
            names = ", ".join(f"{servo.joint} (ID {servo.id}, {value[servo.id]:.3f})" for servo in hit)
            yield Fault(cause, f"{quantity}: {names}", tuple(servo.id for servo in hit))

    def _deadline(self, cycle: Cycle) -> Iterator[Fault]:
        if self._late >= self._safety.late_cycles and self._new(Cause.DEADLINE):
            yield Fault(
                Cause.DEADLINE,
                f"{self._late} cycles in a row started late, the last by {cycle.lateness * 1e3:.1f} ms: "
                "the computer is too slow or too busy; close other programs, or lower --rate",
            )


def _count(counters: NDArray[np.int64], hit: NDArray[np.bool_], unknown: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.where(unknown, counters, np.where(hit, counters + 1, 0))
