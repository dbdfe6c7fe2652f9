"""Conditions for motion: verification of the servos before torque on, and abort rules on the answers of each cycle.

Each abort rule has a bounded reaction time: the number of cycles from the first cycle whose answers show the fault to
the cycle that declares it. The bound is set in ``safety`` of the map; it is one cycle for an alert, and one round of
health reads of all servos for faults that only health reads can detect.

Verification compares the limits stored in a servo with the limits of the map, because the servo silently ignores goals
beyond its limits and switches its torque off at its own thresholds. A limit that contradicts the map prevents arming.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import (
    HARDWARE_ERRORS,
    HEALTH_BLOCK,
    MODEL_BY_NUMBER,
    RAD_S_PER_UNIT,
    RETURN_DELAY_SECONDS_PER_UNIT,
    STATE_BLOCK,
    VOLT_PER_UNIT,
    WATCHDOG_SECONDS_PER_UNIT,
    OperatingMode,
    describe_hardware_error,
)
from dynsim.hardware.bus.protocol import Bus, NoAnswer, RequestRefused, too_busy
from dynsim.hardware.errors import VerificationFailed
from dynsim.hardware.replay.trajectory import QUINTIC_PEAK, CyclePlan, Needs
from dynsim.hardware.servo_map import MappedServo, Safety, ServoMap, mark_turns, turns_verified


class Cause(StrEnum):
    """Cause of a fault that ends a replay."""

    INTERRUPTED = "interrupted"
    PORT = "port"
    VERIFICATION = "verification"
    ARMING = "arming"
    MISSED_STATUS = "missed status"
    ALERT = "hardware alert"
    TORQUE_LOST = "torque lost"
    WATCHDOG = "watchdog tripped"
    FOLLOWING_ERROR = "following error"
    PAIR = "pair difference"
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
    """Fault that was declared during a replay.

    Attributes
    ----------
    cause : Cause
    text : str
        Message for the log and the user.
    ids : tuple of int
        IDs of the faulty servos; empty if the fault is not specific to some servos.
    time : float
        Time at which the fault was declared, on the clock of the replay [s].
    """

    cause: Cause
    text: str
    ids: tuple[int, ...] = ()
    time: float = math.nan


@dataclass
class Cycle:
    """Commands and measurements in one cycle; arrays have shape (N,) and contain joint values in the order of the map.

    Attributes
    ----------
    time : float
        Start time of the cycle, on the clock of the replay [s].
    goal_position, goal_velocity : array
        Goals [rad], [rad/s].
    position, velocity, torque : array
        Measured values [rad], [rad/s], [N·m]; NaN if the status was missed.
    current, load, pwm : array
        Motor current [A], load as a fraction of the stall torque, and PWM as a fraction of the supply voltage, in the
        direction of the joint; NaN if the servo does not measure it or it was not read in this cycle.
    goal_register : array
        Last goal sent to each servo: ticks in position mode, units of the velocity register in velocity mode.
    read_time : array
        Times at which the statuses arrived, on the clock of the replay [s].
    alert : bool array
        Alert bits in the status packets.
    lateness : float
        Delay of the start of the cycle after its deadline [s].
    skipped : int
        Number of cycles skipped before this one.
    exchange : float
        Duration of the bus traffic, not including the health read [s].
    stray : int
        Number of received bytes that do not belong to answers.
    silence : float
        Longest time without a packet to the servos between the previous cycle and the end of this cycle [s].
    outdated : tuple of int
        IDs of servos that answered an earlier request instead of the request in this cycle.
    health : dict
        Registers of the servo whose health was read in this cycle, by ID; empty if no health was read.
    """

    time: float
    goal_position: NDArray[np.float64]
    goal_velocity: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    torque: NDArray[np.float64]
    current: NDArray[np.float64]
    load: NDArray[np.float64]
    pwm: NDArray[np.float64]
    goal_register: NDArray[np.float64]
    read_time: NDArray[np.float64]
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
    """Checker for the cycles of a replay, from arming until the fault policy has been applied.

    A fault is declared only once per servo. Faults that result from an earlier fault of a servo are not declared.
    """

    def __init__(self, servo_map: ServoMap, plan: CyclePlan) -> None:
        self._servos = servo_map.servos
        self._by_id = {servo.id: servo for servo in servo_map.servos}
        self._safety = servo_map.safety
        self._watchdog = watchdog_units(servo_map.safety) * WATCHDOG_SECONDS_PER_UNIT
        self._late_after = 1.0 / plan.rate
        self._in_position_mode = np.array([servo.in_position_mode for servo in self._servos])
        self._following_limit = np.array([servo.kind.following_error for servo in self._servos])
        self._torque_limit = np.array([servo.kind.limits.torque for servo in self._servos])
        self._missed, self._following, self._torque = np.zeros((3, len(self._servos)), dtype=int)
        # Indices of both servos of each pair, limit of the difference of their angles, and cycles beyond it.
        self._pairs = np.array(servo_map.pairs, dtype=int).reshape(-1, 2)
        self._max_difference = np.array([self._servos[second].max_difference for _, second in self._pairs])
        self._apart = np.zeros(len(self._pairs), dtype=int)
        self._late = 0
        self._declared: set[tuple[Cause, int | None]] = set()

    def following_error(self, cycle: Cycle) -> NDArray[np.float64]:
        """Return the commanded minus the measured values (N,): [rad] in position mode, [rad/s] in velocity mode.

        The two servos of a pair have one error, the larger one.
        """
        error = np.where(
            self._in_position_mode, cycle.goal_position - cycle.position, cycle.goal_velocity - cycle.velocity
        )
        first, second = error[self._pairs].T
        worst = np.where(np.isnan(first) | (np.abs(second) > np.abs(first)), second, first)
        error[self._pairs] = worst[:, None]
        return error

    def examine(self, cycle: Cycle) -> list[Fault]:
        """Return the faults that appear in this cycle for the first time, in order of decreasing severity."""
        missed = cycle.missed
        error = np.abs(self.following_error(cycle))
        self._missed = np.where(missed, self._missed + 1, 0)
        # If a status is missed, the error and the torque are unknown: their counters are neither increased nor reset.
        self._following = _count(self._following, error > self._following_limit, missed)
        self._torque = _count(self._torque, np.abs(cycle.torque) > self._torque_limit, missed)
        difference = np.abs(np.subtract(*cycle.position[self._pairs].T))
        self._apart = _count(self._apart, difference > self._max_difference, np.isnan(difference))
        self._late = self._late + 1 if cycle.lateness > self._late_after else 0
        return [*self._faults(cycle, error)]

    def _faults(self, cycle: Cycle, error: NDArray[np.float64]) -> Iterator[Fault]:
        """Declare the faults of a cycle; ``error`` has the magnitudes of the following errors."""
        safety = self._safety
        if stall := self.stall(cycle.silence):
            yield stall
        if hit := self._newly(Cause.ALERT, np.flatnonzero(cycle.alert)):
            text = f"hardware error reported by {', '.join(map(str, hit))}"
            yield Fault(Cause.ALERT, text, tuple(servo.id for servo in hit))
        for id_, registers in cycle.health.items():
            yield from self._health(self._by_id[id_], registers)
        yield from self._silent(np.flatnonzero(self._missed >= safety.missed_cycles), cycle)
        text = f"off its goal for {safety.following_cycles} cycles"
        yield from self._beyond(Cause.FOLLOWING_ERROR, self._following >= safety.following_cycles, error, text)
        for pair in self._pairs[self._apart >= safety.following_cycles]:
            servos = [self._servos[k] for k in pair]
            if self._new(Cause.PAIR, servos[1].id):
                at = ", ".join(f"{self._servos[k]} at {cycle.position[k]:.3f} rad" for k in pair)
                text = (
                    f"two servos on one axle differ by more than {servos[1].max_difference:.3f} rad for "
                    f"{safety.following_cycles} cycles: {at}"
                )
                yield Fault(Cause.PAIR, text, tuple(servo.id for servo in servos))
        text = f"too much torque for {safety.torque_cycles} cycles"
        yield from self._beyond(Cause.TORQUE, self._torque >= safety.torque_cycles, cycle.torque, text)
        if self._late >= safety.late_cycles and self._new(Cause.DEADLINE):
            yield Fault(
                Cause.DEADLINE,
                f"{self._late} cycles in a row started late, the last by {cycle.lateness * 1e3:.1f} ms: "
                "the computer is too slow or too busy; close other programs, or lower --rate",
            )

    def stall(self, silence: float) -> Fault | None:
        """Declare a stall if no packet was sent for ``silence`` [s], long enough for the watchdogs to trip."""
        if silence <= self._watchdog:
            return None
        self._new(Cause.STALL)
        text = (
            f"no packet was sent for {silence:.2f} s, so that the servos' watchdogs ({self._watchdog:.2f} s) tripped; "
            "close other programs, or lower --rate"
        )
        return Fault(Cause.STALL, text)

    def _new(self, cause: Cause, id_: int | None = None) -> bool:
        """Mark a fault as declared, and return True if it had not been declared before."""
        known = (cause, id_) in self._declared
        self._declared.add((cause, id_))
        return not known

    def _newly(self, cause: Cause, indices: Iterable[int]) -> list[MappedServo]:
        """Mark a fault of some servos as declared, and return the servos for which it had not been declared before."""
        return [self._servos[k] for k in indices if self._new(cause, self._servos[k].id)]

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
            # All servos have the same supply, so the fault has no IDs and all servos stop synchronously.
            yield Fault(Cause.VOLTAGE, f"{servo}: {volts:.1f} V, allowed {supply.lowest:g} to {supply.highest:g} V")

    def _silent(self, indices: NDArray[np.intp], cycle: Cycle) -> Iterator[Fault]:
        if hit := self._newly(Cause.MISSED_STATUS, indices):
            text = f"no status received for {self._safety.missed_cycles} cycles from {', '.join(map(str, hit))}"
            if outdated := [servo for servo in hit if servo.id in cycle.outdated]:
                text += f"; answers to earlier requests come from {', '.join(map(str, outdated))}"
            if len(indices) == len(self._servos) > 1:
                text += "; no servo answers: is the supply or the line lost?"
            yield Fault(Cause.MISSED_STATUS, text, tuple(servo.id for servo in hit))

    def _beyond(
        self, cause: Cause, over: NDArray[np.bool_], values: NDArray[np.float64], quantity: str
    ) -> Iterator[Fault]:
        # Ignore servos with an earlier fault: a servo without torque, or without an answer, is far from its goal, too.
        in_trouble = {id_ for _, id_ in self._declared}
        if hit := self._newly(
            cause, [k for k in map(int, np.flatnonzero(over)) if self._servos[k].id not in in_trouble]
        ):
            value = {servo.id: values[k] for k, servo in enumerate(self._servos)}
            names = ", ".join(f"{servo.joint} (ID {servo.id}, {value[servo.id]:.3f})" for servo in hit)
            yield Fault(cause, f"{quantity}: {names}", tuple(servo.id for servo in hit))


def _count(counters: NDArray[np.int64], hit: NDArray[np.bool_], unknown: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.where(unknown, counters, np.where(hit, counters + 1, 0))


# Verification before torque on: servos match the map, are configured and healthy, and are within their limits.


EEPROM_BLOCK = (0, 64)
TRIAL_READS = 10
TRIAL_MISSES = 2
"""Maximum number of TRIAL_READS that a servo may miss."""
NEEDED_SHUTDOWN = 0b0010_0100  # overheating, overload
STATUS_TO_ALL = 2
RESTORE_RAM = 0b10
"""Bit of the startup configuration (address 60): the servo restores saved RAM registers when it starts."""
NO_ANSWER_HINT = (
    "check power, cable, ID and baud rate (`dynsim hw scan`); a servo with Protocol 1 firmware does not answer"
)

QUANTITIES = ("position °", "velocity rad/s", "torque N m", "temperature °C", "supply V")
VOLTAGE_SHUTDOWN = 1 << next(bit for bit, name in HARDWARE_ERRORS.items() if name == "input voltage")
ATTEMPTS = 3
"""Number of reads after which a servo without answer counts as silent."""

Registers = dict[str, int]


def snapshot(bus: Bus, servo: MappedServo) -> Registers:
    """Read all registers of a servo; the keys are names of registers. Raises NoAnswer or RequestRefused."""
    eeprom = bus.read_block(servo.id, *EEPROM_BLOCK).data
    ram = bus.read_block(servo.id, *HEALTH_BLOCK).data
    return servo.model.registers_in(EEPROM_BLOCK[0], eeprom + ram)


def all_registers(bus: Bus, servo_map: ServoMap) -> dict[str, Registers | str]:
    """Read the registers of all servos, by joint; a servo without answer has an error text. Raises PortError."""
    contents: dict[str, Registers | str] = {}
    for servo in servo_map.servos:
        try:
            contents[servo.joint] = snapshot(bus, servo)
        except (NoAnswer, RequestRefused) as error:
            contents[servo.joint] = str(error)
    return contents


def configure(bus: Bus, servo_map: ServoMap, report: Callable[[str], None]) -> None:
    """Write operating mode, return delay and drive mode (EEPROM) if they differ from the values the replay needs.

    Raises
    ------
    NoAnswer, RequestRefused
        If a servo does not answer or refuses a write, for example because its torque is on, which locks the EEPROM.
    """
    wanted = {"return_delay": int(servo_map.bus.return_delay / RETURN_DELAY_SECONDS_PER_UNIT), "drive_mode": 0}
    for servo in servo_map.servos:
        now = snapshot(bus, servo)
        for name, value in {"operating_mode": int(servo.operating_mode), **wanted}.items():
            if now[name] != value:
                if name == "operating_mode":
                    mark_turns(bus, [servo], verified=False)  # the servo may lose its count of turns
                bus.write(servo.id, servo.model.fields[name], value)
                report(f"{servo}: {name} {now[name]} -> {value}")


def verify(
    bus: Bus, servo_map: ServoMap, demands: Iterable[Needs], *, poll: Callable[[], None]
) -> tuple[list[str], list[LimitRow]]:
    """Verify the servos on the bus before a motion.

    Parameters
    ----------
    bus : Bus
    servo_map : ServoMap
    demands : iterable of Needs
        Demands of the motion on the joints, in the order of the map.
    poll : callable
        Called between servos; may raise an exception to cancel.

    Returns
    -------
    problems : list of str
        One line per problem; empty if the robot may move.
    rows : list of LimitRow
        Limits stored in the servos next to the limits of the map.
    """
    problems: list[str] = []
    rows: list[LimitRow] = []
    silent = False
    angles: dict[str, float] = {}
    present = bus.ping_all()
    poll()
    for id_, (model, firmware) in present.items():
        if id_ not in servo_map.ids:
            name = MODEL_BY_NUMBER[model].name if model in MODEL_BY_NUMBER else f"model {model}"
            problems.append(f"ID {id_}: {name} (firmware {firmware}) is on the bus but not in the map")
    for servo, needs in zip(servo_map.servos, demands, strict=True):
        poll()
        try:
            registers = snapshot(bus, servo)
        except NoAnswer as missing:
            silent = True
            hint = "check for two servos with this ID" if missing.garbled or servo.id in present else NO_ANSWER_HINT
            problems.append(f"{servo.joint}: {missing}; {hint}")
            continue
        except RequestRefused as refused:
            problems.append(f"{servo.joint}: {refused}")
            continue
        unfit = [*_unfit(servo, registers, servo_map)]
        if registers["model_number"] == servo.model.number:
            rows.append(compare_limits(servo, registers, servo_map.safety, needs))
            angles[servo.joint] = servo.to_angle(registers["present_position"])
            turns = _turn_problem(bus, servo, registers)
            unfit += [*rows[-1].refused, *(turns or _position_problem(servo, registers))]
        problems += [f"{servo}: {text}" for text in unfit]
    problems += _pair_problems(servo_map, angles)
    missed = [] if problems else _trial_reads(bus, servo_map, poll)
    if (silent or missed) and (busy := too_busy(bus)):
        missed.append(busy)
    return problems + missed, rows


def _unfit(servo: MappedServo, registers: Registers, servo_map: ServoMap) -> Iterator[str]:
    if registers["model_number"] != servo.model.number:
        yield f"is model {registers['model_number']}, the map has {servo.model.name} ({servo.model.number})"
        return
    if registers["firmware"] < servo.kind.firmware_min:
        yield f"firmware {registers['firmware']} is older than firmware_min {servo.kind.firmware_min}"
    if (mode := registers["operating_mode"]) != servo.operating_mode:
        name = OperatingMode(mode).name.lower() if mode in list(OperatingMode) else str(mode)
        yield f"is in mode {name}, must be {servo.operating_mode.name.lower()} (--configure sets it)"
    if mode := registers["drive_mode"]:
        yield f"drive mode is {mode}, must be 0 (--configure sets it); use sign in the map instead"
    delay, longest = registers["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT, servo_map.bus.return_delay
    if delay > longest + 1e-9:
        yield f"return delay is {delay * 1e6:.0f} µs, the map has {longest * 1e6:.0f} µs (--configure sets it)"
    if registers["status_return_level"] != STATUS_TO_ALL:
        yield f"status return level is {registers['status_return_level']}, must be {STATUS_TO_ALL}"
    if registers["shutdown"] & NEEDED_SHUTDOWN != NEEDED_SHUTDOWN:
        yield f"shutdown is 0x{registers['shutdown']:02x}, must switch the torque off at overheating and overload"
    if error := registers["hardware_error"]:
        yield f"hardware error: {describe_hardware_error(error)}; restart the servo to clear it"
    volts, supply = registers["present_voltage"] * VOLT_PER_UNIT, servo_map.safety.supply
    if not supply.lowest <= volts <= supply.highest:
        yield f"supply is {volts:.1f} V, allowed {supply.lowest:g} to {supply.highest:g} V"
    if registers["present_temperature"] > servo_map.safety.temperature_max:
        yield f"{registers['present_temperature']} °C, limit {servo_map.safety.temperature_max:g} °C"


def _position_problem(servo: MappedServo, registers: Registers) -> list[str]:
    """Return a problem if the servo is outside its limits, from where the robot must not start."""
    tick = registers["present_position"]
    low, high = servo.tick_limits
    if not servo.in_position_mode or low <= tick <= high:
        return []
    return [
        f"is at {servo.to_angle(tick):.3f} rad (tick {tick}), outside its limits "
        f"{servo.position_limits[0]:.3f} to {servo.position_limits[1]:.3f} rad; move it by hand"
    ]


def _turn_problem(bus: Bus, servo: MappedServo, registers: Registers) -> list[str]:
    """Return a problem if the count of turns of a servo in extended position mode is not verified."""
    if not servo.counts_turns or registers["operating_mode"] != servo.operating_mode:
        return []
    if registers.get("startup_configuration", 0) & RESTORE_RAM:
        return ["restores its RAM when it starts, which hides a lost count of turns; clear bit 1 of address 60"]
    try:
        if turns_verified(bus, servo):
            return []
    except (NoAnswer, RequestRefused) as error:
        return [str(error)]
    return [
        "its count of turns is not verified since its last start; put the joint into its zero posture and run "
        f"`dynsim hw calibrate --joint {servo.axle}`"
    ]


def _pair_problems(servo_map: ServoMap, angles: dict[str, float]) -> Iterator[str]:
    """Yield a problem for each pair whose two servos measure different angles [rad] of their joint."""
    for first, second in servo_map.pairs:
        this, other = servo_map.servos[first], servo_map.servos[second]
        apart = abs(angles.get(this.joint, math.nan) - angles.get(other.joint, math.nan))
        if apart > other.max_difference:
            yield (
                f"{this}, {other}: their angles differ by {apart:.3f} rad (limit {other.max_difference:.3f} rad), "
                f"so they would work against each other; check their signs, and run `dynsim hw calibrate --joint "
                f"{other.axle}`"
            )


def _trial_reads(bus: Bus, servo_map: ServoMap, poll: Callable[[], None]) -> list[str]:
    """Detect two servos with the same ID: their answers to a ping may be equal, but their measured values differ."""
    missed = dict.fromkeys(servo_map.ids, 0)
    for _ in range(TRIAL_READS):
        poll()
        replies = bus.sync_read(servo_map.ids, *STATE_BLOCK).replies
        for id_ in servo_map.ids:
            missed[id_] += id_ not in replies
    if all(count == TRIAL_READS for count in missed.values()):
        return ["no servo answers a sync read; set the latency timer of the adapter to 1 ms"]
    return [
        f"{servo}: {missed[servo.id]} of {TRIAL_READS} answers were missing or garbled; "
        "check the cable, and for two servos with this ID"
        for servo in servo_map.servos
        if missed[servo.id] > TRIAL_MISSES
    ]


@dataclass(frozen=True)
class LimitRow:
    """Limits of one servo next to the limits of the map.

    Attributes
    ----------
    joint : str
    id : int
    cells : tuple of (str, str)
        Limit stored in the servo and limit of the map, for each of QUANTITIES.
    refused : tuple of str
        Differences that prevent arming.
    differs : tuple of str
        Other differences, shown as notes.
    """

    joint: str
    id: int
    cells: tuple[tuple[str, str], ...]
    refused: tuple[str, ...]
    differs: tuple[str, ...]


def needs_of_map(servo: MappedServo) -> Needs:
    """Return the full range that the map allows."""
    low, high = servo.position_limits
    return Needs(low, high, servo.kind.limits.velocity)


def compare_limits(servo: MappedServo, registers: Registers, safety: Safety, needs: Needs) -> LimitRow:
    """Compare the limits in the EEPROM of a servo with the limits of the map.

    A limit is refused if the servo would ignore goals of the motion or lag behind it. A threshold is refused if the
    servo would switch its torque off before the rule of the replay stops it, or later than its data sheet specifies.
    """
    compared = (
        _position(servo, registers, needs),
        _velocity(servo, registers, needs),
        _torque(servo, registers),
        _temperature(servo, registers, safety),
        _supply(registers, safety),
    )
    return LimitRow(
        servo.joint,
        servo.id,
        tuple((row.servo, row.map) for row in compared),
        tuple(row.refused for row in compared if row.refused),
        tuple(row.differs for row in compared if row.differs),
    )


class _Compared(NamedTuple):
    servo: str = "-"
    map: str = "-"
    refused: str = ""
    differs: str = ""


def _position(servo: MappedServo, registers: Registers, needs: Needs) -> _Compared:
    if not servo.in_position_mode:
        return _Compared()
    low, high = registers["min_position"], registers["max_position"]
    own = np.degrees(sorted((servo.to_angle(low), servo.to_angle(high))))
    bounds = np.degrees(servo.position_limits)
    if servo.counts_turns:  # in this mode the stored limits have no effect
        return _Compared(map=f"{bounds[0]:.0f} to {bounds[1]:.0f}")
    goals, allowed = sorted((servo.to_ticks(needs.low), servo.to_ticks(needs.high))), servo.tick_limits
    refused = differs = ""
    if goals[0] < low or goals[1] > high:
        refused = f"the motion needs ticks {goals[0]} to {goals[1]}, the servo allows {low} to {high}"
    elif allowed[0] < low or allowed[1] > high:
        differs = f"position limits of the servo are narrower than in the map: ticks {low} to {high}"
    return _Compared(f"{own[0]:.0f} to {own[1]:.0f}", f"{bounds[0]:.0f} to {bounds[1]:.0f}", refused, differs)


def _velocity(servo: MappedServo, registers: Registers, needs: Needs) -> _Compared:
    units, allowed = registers["velocity_limit"], servo.kind.limits.velocity
    own = units * RAD_S_PER_UNIT / servo.gear
    refused = differs = ""
    below = units < abs(servo.to_velocity_units(allowed))
    if below and not servo.in_position_mode:
        refused = f"velocity limit of the servo is {own:.2f} rad/s, below the map; it would ignore faster goals"
    elif units < abs(servo.to_velocity_units(needs.fastest)):
        refused = f"the motion needs {needs.fastest:.2f} rad/s, the servo allows {own:.2f} and would lag"
    elif below:
        differs = f"velocity limit of the servo is {own:.2f} rad/s, below the map"
    return _Compared(f"{own:.2f}", f"{allowed:.2f}", refused, differs)


def _torque(servo: MappedServo, registers: Registers) -> _Compared:
    allowed = servo.kind.limits.torque
    if "current_limit" not in registers:
        return _Compared(map=f"{allowed:.1f}")
    # The limit applies to modes that control current, which a map cannot select.
    own = servo.gear * servo.model.torque(registers["current_limit"])
    below = f"current limit of the servo corresponds to {own:.1f} N m, below the map" if own < allowed else ""
    return _Compared(f"{own:.1f}", f"{allowed:.1f}", differs=below)


def _temperature(servo: MappedServo, registers: Registers, safety: Safety) -> _Compared:
    own, allowed = registers["temperature_limit"], safety.temperature_max
    refused = ""
    if own <= allowed:
        refused = f"switches its torque off at {own} °C, before temperature_max ({allowed:g} °C) stops the robot"
    elif own > (highest := servo.model.fields["temperature_limit"].default):
        refused = f"temperature limit is {own} °C, a {servo.model.name} must shut down at {highest} °C"
    return _Compared(f"{own}", f"{allowed:g}", refused)


def _supply(registers: Registers, safety: Safety) -> _Compared:
    low, high = registers["min_voltage"] * VOLT_PER_UNIT, registers["max_voltage"] * VOLT_PER_UNIT
    allowed = safety.supply
    refused = differs = ""
    if not (low <= allowed.lowest and allowed.highest <= high):
        outside = f"outside {low:g} to {high:g} V, a narrower range than safety.supply"
        if registers["shutdown"] & VOLTAGE_SHUTDOWN:
            refused = f"switches its torque off {outside}"
        else:
            differs = f"raises an alert {outside}"
    return _Compared(f"{low:g} to {high:g}", f"{allowed.lowest:g} to {allowed.highest:g}", refused, differs)


def difference_lines(rows: Sequence[LimitRow]) -> list[str]:
    """Return the lines of a text table with cells "servo | map", followed by the differences."""
    table = [["joint", "ID", *QUANTITIES]]
    table += [[row.joint, str(row.id), *(" | ".join(cell) for cell in row.cells)] for row in rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in table]
    return ["limits (stored in the servo | in the map):", *lines, *differences(rows)]


def differences(rows: Sequence[LimitRow]) -> list[str]:
    """Return one line per difference, the refused limits first."""
    refused = [f"{row.joint} (ID {row.id}): {text}" for row in rows for text in row.refused]
    return refused + [f"note: {row.joint} (ID {row.id}): {text}" for row in rows for text in row.differs]


@dataclass(frozen=True)
class Distance:
    """Present angle of one joint, and its angle at the start of the motion [rad]."""

    joint: str
    now: float
    start: float

    @property
    def size(self) -> float:
        return abs(self.start - self.now)

    def __str__(self) -> str:
        return f"{self.joint} {self.size:.3f} rad (from {self.now:.3f} to {self.start:.3f})"


def way_to_start(bus: Bus, servo_map: ServoMap, start: NDArray[np.float64]) -> tuple[list[Distance], float]:
    """Read the present posture and plan the move to the start.

    Parameters
    ----------
    bus : Bus
    servo_map : ServoMap
    start : array, shape (N,)
        Posture at the start of the motion [rad].

    Returns
    -------
    distances : list of Distance
        Distances of the joints in position mode, the largest first.
    duration : float
        Duration of the move [s].

    Raises
    ------
    VerificationFailed
        If a servo does not answer.
    """
    ticks = read_ticks(bus, [servo for servo in servo_map.servos if servo.in_position_mode])
    distances = [
        Distance(servo.joint, servo.to_angle(ticks[servo.id]), float(target))
        for servo, target in zip(servo_map.servos, start, strict=True)
        if servo.in_position_mode
    ]
    distances.sort(key=lambda distance: -distance.size)
    farthest = max((distance.size for distance in distances), default=0.0)
    return distances, QUINTIC_PEAK * farthest / servo_map.safety.approach_velocity


def read_registers(bus: Bus, servos: Sequence[MappedServo], block: tuple[int, int]) -> dict[int, Registers]:
    """Read a block of registers of all servos that answer one of ATTEMPTS reads, by ID. Raises PortError."""
    registers: dict[int, Registers] = {}
    for _ in range(ATTEMPTS):
        missing = {servo.id: servo for servo in servos if servo.id not in registers}
        if not missing:
            break
        replies = bus.sync_read([*missing], *block).replies
        registers |= {id_: missing[id_].model.registers_in(block[0], reply.data) for id_, reply in replies.items()}
    return registers


def read_ticks(bus: Bus, servos: Sequence[MappedServo]) -> dict[int, int]:
    """Return the position of each servo [ticks], by ID. Raises VerificationFailed if a servo does not answer."""
    registers = read_registers(bus, servos, STATE_BLOCK)
    ticks = {id_: values["present_position"] for id_, values in registers.items()}
    silent = [str(servo) for servo in servos if servo.id not in ticks]
    if silent:
        busy = too_busy(bus)
        raise VerificationFailed(
            f"no answer from {', '.join(silent)}; check power, cable, ID and baud rate{busy and '; '}{busy}"
        )
    return ticks
