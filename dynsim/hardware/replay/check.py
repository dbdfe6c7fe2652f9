"""The offline check of a motion before it is sent: limits of joints and servos at the given speed and rate.

Every interval between samples is examined for the extremes of its interpolant. Nothing is clamped: a motion beyond a
limit is refused as a whole, before a port is opened. Also here: the plan of a cycle of the bus.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import CheckRefused
from dynsim.hardware.bus.control_table import HEALTH_BLOCK, STATE_BLOCK, TICKS_PER_TURN
from dynsim.hardware.replay.measured import unmeasured
from dynsim.hardware.replay.trajectory import (
    COMMON,
    JERK_WINDOW,
    LONG,
    SHAKING_WINDOW,
    Array,
    CyclePlan,
    GoalCourse,
    MotionTask,
    Needs,
    Path,
    PlannedCourse,
    column_of,
    long_steps,
    path_of_record,
)
from dynsim.hardware.servo_map import MappedServo, ServoMap
from dynsim.record import Record

BITS_PER_BYTE = 10
TURNAROUND = 50e-6
"""Planned time per status beyond its bytes and return delay [s] (unverified; servos and adapter both contribute)."""
USB_TRANSACTION = 1e-3
"""Planned cost of waiting for an answer through a USB adapter with its latency timer at 1 ms [s]."""
WATCHDOG_CYCLES = 3
"""Least time of the servos' watchdogs, in cycles."""
BUS_SHARE = 0.97
"""Largest part of the period in which the bus may be busy."""

Quantity = Literal["position", "velocity", "acceleration", "jerk", "shaking", "torque"]
UNITS: dict[Quantity, str] = {
    "position": "rad",
    "velocity": "rad/s",
    "acceleration": "rad/s²",
    "jerk": "rad/s³",
    "shaking": "rad/s",
    "torque": "N m",
}
SLOWED: dict[Quantity, int] = {"velocity": 1, "acceleration": 2, "jerk": 2, "shaking": 1}
"""Exponent n: at the speed s of the path the quantity is proportional to s^n, or decreases faster (jerk and shaking,
whose time window covers less of a slower path)."""

SLOWEST, FASTEST = 0.01, 10.0
"""Range of speeds of the path, in path seconds per second."""
LONGEST = 24 * 3600.0
"""Longest motion [s]; longer times are refused as a mistake."""
STILL = 1e-6
"""A joint of a record that turns less than this [rad] counts as unmoved."""
ROUNDING = 1e-9
"""A joint of a record that rests at its very limit may be off by rounding of this size; a tick is 1.5e-3 rad."""


@dataclass(frozen=True)
class Margin:
    """The tightest place of one joint against one limit.

    Attributes
    ----------
    quantity : "position", "velocity", "acceleration", "jerk", "shaking" or "torque"
    value, limit, margin : float
        SI; a negative margin is a violation.
    time : float
        Where [s of record time].
    """

    joint: str
    quantity: Quantity
    value: float
    limit: float
    margin: float
    time: float

    @property
    def unit(self) -> str:
        return UNITS[self.quantity]

    @property
    def holds(self) -> bool:
        # What overflows to no number at all is no motion either.
        return self.margin >= -ROUNDING

    def __str__(self) -> str:
        unit = self.unit
        return (
            f"{self.joint}: {self.quantity} {self.value:.4f} {unit} at t = {self.time:.3f} s, "
            f"limit {self.limit:.4f} {unit}, margin {self.margin:+.4f} {unit}"
        )


@dataclass(frozen=True, kw_only=True)
class CheckedMotion(MotionTask):
    """A motion that passed: what the replay runs on.

    Attributes
    ----------
    path : Path
    margins : tuple of Margin
        Tightest place per joint and limit.
    warnings : tuple of str
    """

    path: Path
    margins: tuple[Margin, ...] = ()
    warnings: tuple[str, ...] = ()

    def tightest(self, servo_map: ServoMap) -> tuple[Margin, float] | None:
        """The margin that is the least part of its limit, of a position the half of its range, and that part."""
        ranges = {servo.joint: servo.position_limits[1] - servo.position_limits[0] for servo in servo_map.servos}
        parts = [
            (
                margin.margin / (0.5 * ranges[margin.joint] if margin.quantity == "position" else abs(margin.limit)),
                margin,
            )
            for margin in self.margins
        ]
        part, margin = min(parts, key=lambda entry: entry[0], default=(math.inf, None))
        return None if margin is None else (margin, part)

    @property
    def start(self) -> Array:
        """Posture in which it begins [rad], shape (N,)."""
        return self.path.position[0]

    @property
    def duration(self) -> float:
        """[s]."""
        return (self.path.end - self.path.start) / self.speed

    def needs(self) -> list[Needs]:
        """What it asks of every joint, in the order of the map."""
        extremes = self.path.extremes()
        low, high = extremes.position.min(axis=(0, 1)), extremes.position.max(axis=(0, 1))
        fastest = self.speed * np.abs(extremes.velocity).max(axis=(0, 1))
        return [Needs(float(a), float(b), float(v)) for a, b, v in zip(low, high, fastest, strict=True)]

    def course(self) -> GoalCourse:
        """How to go along the path, from its beginning."""
        return PlannedCourse(self.path, self.path.start, self.path.end, speed=self.speed)


def check_motion(
    record: Record, servo_map: ServoMap, *, rate: float | None = None, speed: float = 1.0
) -> CheckedMotion:
    """Examine a whole record against the limits of the map, the servos' data sheets and the bus.

    Parameters
    ----------
    record : Record
    servo_map : ServoMap
    rate : float, optional
        Goal rate [Hz]; the map's if not given.
    speed : float
        1 replays in the record's own time, 0.5 takes twice as long.

    Raises
    ------
    CheckRefused
        With every violated limit: joint, value, time and margin.
    """
    if not SLOWEST <= speed <= FASTEST:
        raise CheckRefused(f"--speed must be from {SLOWEST:g} to {FASTEST:g}, not {speed:g}")
    plan = plan_cycle(servo_map, rate if rate is not None else servo_map.bus.rate)
    _check_duration(record, speed)
    path = path_of_record(record, servo_map)
    margins = [*MotionLimits(servo_map).margins(path, speed), *_torque_margins(record, servo_map)]
    violations = [margin for margin in margins if not margin.holds]
    if violations:
        lines = [f"{len(violations)} limit(s) violated, nothing was sent:", *(f"  {entry}" for entry in violations)]
        if all(entry.quantity in SLOWED for entry in violations):
            slower = speed * min(
                (entry.limit / abs(entry.value)) ** (1 / SLOWED[entry.quantity]) for entry in violations
            )
            if slower >= SLOWEST:
                lines.append(f"  --speed {math.floor(100 * slower) / 100:g} would pass")
        raise CheckRefused("\n".join(lines))
    warnings = [] if record.complete else ["the record is marked incomplete: it ends before its scenario does"]
    if limp := without_servo(record, servo_map):
        warnings.append(f"joints of the record without a servo, limp on the robot: {'; '.join(limp)}")
    if missing := long_steps(record, LONG, COMMON):
        warnings.append(
            f"{len(missing)} of {len(record) - 1} steps are long, samples of the record may be missing: {missing[0]}"
        )
    return CheckedMotion(
        path=path,
        speed=speed,
        plan=plan,
        margins=tuple(margins),
        warnings=tuple(warnings),
        scene=record.scene,
        unmeasured=unmeasured(record, servo_map),
    )


def without_servo(record: Record, servo_map: ServoMap) -> list[str]:
    """Joints in the signals that the servos follow that are no servo's, each with how far it moves.

    They have a column of positions and one of rates: the place of a mobile base in the plane is no joint.
    """
    follows = dict.fromkeys((servo.kind.follows.position, servo.kind.follows.velocity) for servo in servo_map.servos)
    served = {(servo.kind.follows.position, servo.label) for servo in servo_map.servos}
    texts = []
    for position, velocity in follows:
        rates = record.labels.get(velocity, ()) if velocity in record else ()
        for column, label in enumerate(record.labels[position] if position in record else ()):
            if (position, label) in served or label not in rates:
                continue
            turned = float(np.ptp(record[position][:, column]))
            texts.append(
                f"{label} ({f'moves by {math.degrees(turned):.1f} deg' if turned > STILL else 'does not move'})"
            )
    return texts


def _check_duration(record: Record, speed: float) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        duration = np.ptp(record.time) / speed if len(record) else 0.0
    # Times that are no number at all are refused by their sample.
    if LONGEST < duration < math.inf:
        raise CheckRefused(
            f"the motion would take {duration:.3g} s at --speed {speed:g}, more than {LONGEST / 3600:g} h. "
            "Is the record's time in seconds? Cut the record, or replay it faster"
        )


def plan_cycle(servo_map: ServoMap, rate: float) -> CyclePlan:
    """Time budget of one cycle.

    Raises
    ------
    CheckRefused
        The bus cannot carry that rate.
    """
    if not (math.isfinite(rate) and rate > 0):
        raise CheckRefused(f"--rate must be positive, not {rate}")
    if rate * servo_map.safety.watchdog < WATCHDOG_CYCLES:
        raise CheckRefused(
            f"at {rate:g} Hz the servos' watchdogs of {servo_map.safety.watchdog:g} s would trip within "
            f"{WATCHDOG_CYCLES} cycles. Use --rate {math.ceil(WATCHDOG_CYCLES / servo_map.safety.watchdog)} or more"
        )
    count = len(servo_map.servos)
    groups = [sum(servo.in_position_mode is mode for servo in servo_map.servos) for mode in (True, False)]
    written = sum(14 + 5 * members for members in groups if members)
    read = 14 + count + count * (11 + STATE_BLOCK[1])
    byte_time = BITS_PER_BYTE / servo_map.bus.baud
    per_status = servo_map.bus.return_delay + TURNAROUND
    cycle_time = (written + read) * byte_time + count * per_status + USB_TRANSACTION
    health_time = (14 + 11 + HEALTH_BLOCK[1]) * byte_time + per_status + USB_TRANSACTION
    available = BUS_SHARE / rate - cycle_time
    if available <= 0:
        highest = math.floor(BUS_SHARE / (cycle_time + 0.1 * health_time))
        raise CheckRefused(
            f"{count} servos at {servo_map.bus.baud / 1e6:g} Mbit/s need {cycle_time * 1e3:.2f} ms a cycle; "
            f"{rate:g} Hz leaves {1e3 / rate:.2f} ms. Use --rate {highest} or less, or a higher baud rate"
        )
    return CyclePlan(rate, cycle_time, health_time, max(1, math.ceil(health_time / available)))


class MotionLimits:
    """Limits of the joints of a map for the paths that they may go along, of whole records and of single intervals."""

    def __init__(self, servo_map: ServoMap) -> None:
        self._servos = servo_map.servos
        self._in_position_mode = np.array([servo.in_position_mode for servo in self._servos])
        self._low, self._high = np.array([position_bounds(servo) for servo in self._servos]).T
        limits = [servo.kind.limits for servo in self._servos]
        self._highest: dict[Quantity, Array] = {
            "velocity": np.array([velocity_limit(servo) for servo in self._servos]),
            "acceleration": np.array([limit.acceleration for limit in limits]),
            "jerk": np.array([limit.jerk for limit in limits]),
            "shaking": np.array([limit.shaking for limit in limits]),
        }

    def margins(
        self, path: Path, speed: float = 1.0, since: float = -math.inf, *, broken: bool = False
    ) -> Iterator[Margin]:
        """The tightest place of every joint against each limit of its motion, in intervals and windows that end after
        ``since`` [s]; only those where a limit is ``broken``.
        """
        extremes = path.extremes(since)
        # The windows are of the robot's time, of which `speed` seconds of the path pass in a second.
        jerk, jerk_time = path.jerk(JERK_WINDOW * speed, since)
        shaking, shaking_time = path.shaking(SHAKING_WINDOW * speed, since)
        with np.errstate(over="ignore"):
            values: dict[Quantity, tuple[Array, Array]] = {
                "velocity": (speed * extremes.velocity, extremes.velocity_time),
                "acceleration": (speed * (speed * extremes.acceleration), extremes.acceleration_time),
                "jerk": (speed * (speed * (speed * jerk)), jerk_time),
                "shaking": (speed * shaking, shaking_time),
            }
        position, at = (part.reshape(-1, len(self._servos)) for part in (extremes.position, extremes.position_time))
        places = [self._tightest_position(position, at)]
        for quantity, (value, time) in values.items():
            limit = self._highest[quantity]
            worst, when = _of_each(value, time, np.abs(value.reshape(-1, len(limit))).argmax(axis=0))
            places.append((worst, limit, limit - np.abs(worst), when))
        table = np.array(places).transpose(2, 0, 1)  # (N, quantities, 4)
        wanted = ~(table[..., 2] >= -ROUNDING) if broken else np.ones(table.shape[:2], dtype=bool)
        wanted[:, 0] &= self._in_position_mode
        quantities: list[Quantity] = ["position", *values]
        for joint, quantity in np.argwhere(wanted):
            yield Margin(self._servos[joint].joint, quantities[quantity], *table[joint, quantity].tolist())

    def surely_hold(self, path: Path) -> bool:
        """Whether simple bounds say that the last interval, and the windows that end in it, break no limit."""
        position, velocity, acceleration, jerk, shaking = path.bounds_of_last(JERK_WINDOW, SHAKING_WINDOW)
        highest = self._highest
        return bool(
            np.all((position >= self._low) & (position <= self._high))
            and np.all(velocity <= highest["velocity"])
            and np.all(acceleration <= highest["acceleration"])
            and np.all(jerk <= JERK_WINDOW * highest["jerk"])
            and np.all(shaking <= highest["shaking"])
        )

    def _tightest_position(self, position: Array, time: Array) -> tuple[Array, Array, Array, Array]:
        lowest, lowest_time = _of_each(position, time, position.argmin(axis=0))
        highest, highest_time = _of_each(position, time, position.argmax(axis=0))
        below = lowest - self._low < self._high - highest
        return (
            np.where(below, lowest, highest),
            np.where(below, self._low, self._high),
            np.where(below, lowest - self._low, self._high - highest),
            np.where(below, lowest_time, highest_time),
        )


def _of_each(values: Array, times: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
    """Of each joint the value in one of the rows, and its time; shape (N,)."""
    columns = np.arange(len(rows))
    return values.reshape(-1, len(rows))[rows, columns], times.reshape(-1, len(rows))[rows, columns]


def position_bounds(servo: MappedServo) -> tuple[float, float]:
    """Limits of the map, narrowed to the single turn position mode knows [rad]."""
    turn = sorted((servo.to_angle(0), servo.to_angle(TICKS_PER_TURN - 1)))
    return max(servo.position_limits[0], turn[0]), min(servo.position_limits[1], turn[1])


def velocity_limit(servo: MappedServo) -> float:
    """Joint speed limit [rad/s]: the map's, or the model's no-load speed where that is lower."""
    return min(servo.kind.limits.velocity, servo.model.no_load_speed / servo.gear)


def _torque_margins(record: Record, servo_map: ServoMap) -> Iterator[Margin]:
    for servo in servo_map.servos:
        signal = servo.kind.follows.torque
        if signal is None or servo.hold_at is not None:
            continue
        torque = column_of(record, signal, servo, "N m")
        highest = int(np.abs(torque).argmax())
        value, limit = float(torque[highest]), servo.kind.limits.torque
        time = float(record.time[highest] - record.time[0])
        yield Margin(servo.joint, "torque", value, limit, limit - abs(value), time)
