"""Offline check of a motion against the limits of joints, servos and bus, at the requested speed and rate.

The check evaluates the extremes of the interpolant in every interval between samples. Nothing is clamped: a motion that
exceeds a limit is rejected as a whole, before a port is opened. This module also plans the cycle of the bus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dynsim.errors import CheckRefused
from dynsim.hardware.bus.control_table import HEALTH_BLOCK, STATE_BLOCK, TICKS_PER_TURN
from dynsim.hardware.replay.measured import unmeasured
from dynsim.hardware.replay.trajectory import (
    JERK_WINDOW,
    LONG_FACTOR,
    LONG_QUANTILE,
    SHAKING_WINDOW,
    Array,
    CyclePlan,
    GoalCourse,
    Needs,
    Path,
    column_of,
    long_steps,
    path_of_record,
)
from dynsim.hardware.servo_map import MappedServo, ServoMap
from dynsim.record import Record
from dynsim.record.scene import Scene

BITS_PER_BYTE = 10
TURNAROUND = 50e-6
"""Planned time per status in addition to its bytes and return delay [s] (unverified; from servos and adapter)."""
USB_TRANSACTION = 1e-3
"""Planned wait for an answer through a USB adapter with a latency timer of 1 ms [s]."""
WATCHDOG_CYCLES = 3
"""Minimum time of the servo watchdogs, in cycles."""
BUS_SHARE = 0.97
"""Maximum fraction of the period in which the bus may be busy."""

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
"""Exponent n: at path speed s the quantity is proportional to s^n or decreases faster (the time windows of jerk and
shaking cover less of a slower path)."""

SLOWEST, FASTEST = 0.01, 10.0
"""Range of speeds of the path, in path seconds per second."""
LONGEST = 24 * 3600.0
"""Maximum duration of a motion [s]; a longer duration is rejected as a mistake."""
STILL = 1e-6
"""A joint of a record that turns less than this [rad] counts as stationary."""
ROUNDING = 1e-9
"""Tolerance for rounding errors of a joint that rests at its limit; a tick is 1.5e-3 rad."""


@dataclass(frozen=True)
class Margin:
    """Smallest margin of one joint to one limit.

    Attributes
    ----------
    joint : str
    quantity : "position", "velocity", "acceleration", "jerk", "shaking" or "torque"
    value, limit, margin : float
        Values in SI units; a negative margin is a violation.
    time : float
        Time of the value [s of record time].
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
        # False for NaN, the result of an overflow.
        return self.margin >= -ROUNDING

    def __str__(self) -> str:
        unit = self.unit
        return (
            f"{self.joint}: {self.quantity} {self.value:.4f} {unit} at t = {self.time:.3f} s, "
            f"limit {self.limit:.4f} {unit}, margin {self.margin:+.4f} {unit}"
        )


@dataclass(frozen=True, kw_only=True)
class CheckedMotion:
    """Motion that passed the offline check; input of the replay.

    Attributes
    ----------
    plan : CyclePlan
    path : Path
    speed : float
        Motion time per second.
    scene : Scene or None
        Scene of the robot, which is copied into the measured record.
    unmeasured : Record or None
        Signals that the servos do not measure, such as the pose of the base; also copied into the measured record.
    margins : tuple of Margin
        Smallest margin for each joint and limit.
    warnings : tuple of str
    """

    plan: CyclePlan
    path: Path
    speed: float = 1.0
    scene: Scene | None = None
    unmeasured: Record | None = None
    margins: tuple[Margin, ...] = ()
    warnings: tuple[str, ...] = ()

    def tightest(self, servo_map: ServoMap) -> tuple[Margin, float] | None:
        """Return the smallest relative margin and its value; position margins are relative to half of the range."""
        ranges = {servo.joint: servo.position_limits[1] - servo.position_limits[0] for servo in servo_map.servos}

        def part(margin: Margin) -> float:
            whole = 0.5 * ranges[margin.joint] if margin.quantity == "position" else abs(margin.limit)
            return margin.margin / whole

        tightest = min(self.margins, key=part, default=None)
        return None if tightest is None else (tightest, part(tightest))

    @property
    def start(self) -> Array:
        """Posture at the start [rad], shape (N,)."""
        return self.path.position[0]

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return (self.path.end - self.path.start) / self.speed

    def needs(self) -> list[Needs]:
        """Return the demands on all joints, in the order of the map."""
        extremes = self.path.extremes()
        low, high = extremes.position.min(axis=(0, 1)), extremes.position.max(axis=(0, 1))
        fastest = self.speed * np.abs(extremes.velocity).max(axis=(0, 1))
        return [Needs(float(a), float(b), float(v)) for a, b, v in zip(low, high, fastest, strict=True)]

    def course(self) -> GoalCourse:
        """Return the course along the path, from its start."""
        return GoalCourse(self.path, self.path.start, self.path.end, speed=self.speed)


def check_motion(
    record: Record, servo_map: ServoMap, *, rate: float | None = None, speed: float = 1.0
) -> CheckedMotion:
    """Check a whole record against the limits of the map, the data sheets of the servos, and the bus.

    Parameters
    ----------
    record : Record
    servo_map : ServoMap
    rate : float, optional
        Command rate [Hz]; default: the rate in the map.
    speed : float
        Playback speed; 1 is real time, 0.5 is half speed.

    Raises
    ------
    CheckRefused
        If a limit is violated; the message lists all violations with joint, value, time and margin.
    """
    if not SLOWEST <= speed <= FASTEST:
        raise CheckRefused(f"--speed must be from {SLOWEST:g} to {FASTEST:g}, got {speed:g}")
    plan = plan_cycle(servo_map, rate if rate is not None else servo_map.bus.rate)
    _check_duration(record, speed)
    path = path_of_record(record, servo_map)
    margins = [*MotionLimits(servo_map).margins(path, speed), *_torque_margins(record, servo_map)]
    violations = [margin for margin in margins if not margin.holds]
    if violations:
        lines = [f"{len(violations)} limit(s) violated; nothing was sent:", *(f"  {entry}" for entry in violations)]
        if all(entry.quantity in SLOWED for entry in violations):
            slower = speed * min(
                (entry.limit / abs(entry.value)) ** (1 / SLOWED[entry.quantity]) for entry in violations
            )
            if slower >= SLOWEST:
                lines.append(f"  --speed {math.floor(100 * slower) / 100:g} would pass")
        raise CheckRefused("\n".join(lines))
    warnings = [] if record.complete else ["the record is marked incomplete: it ends before its scenario"]
    if limp := uncovered_joints(record, servo_map):
        warnings.append(f"joints of the record without a servo, limp on the robot: {'; '.join(limp)}")
    if missing := long_steps(record, LONG_FACTOR, LONG_QUANTILE):
        warnings.append(
            f"{len(missing)} of {len(record) - 1} time steps are long, samples may be missing: {missing[0]}"
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


def uncovered_joints(record: Record, servo_map: ServoMap) -> list[str]:
    """Return the joints of the record that no servo of the map follows, each with its range of motion.

    Only columns with both position and rate count as joints, so the pose of a mobile base in the plane is ignored.
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
    # Times that are not finite are rejected later, with the number of the sample.
    if LONGEST < duration < math.inf:
        raise CheckRefused(
            f"the motion would take {duration:.3g} s at --speed {speed:g} (limit {LONGEST / 3600:g} h); "
            "check that the time of the record is in seconds, cut the record, or increase --speed"
        )


def plan_cycle(servo_map: ServoMap, rate: float) -> CyclePlan:
    """Plan the time budget of one cycle at a command rate [Hz].

    Raises
    ------
    CheckRefused
        If the rate is too high for the bus or too low for the watchdogs.
    """
    if not (math.isfinite(rate) and rate > 0):
        raise CheckRefused(f"--rate must be positive, got {rate}")
    if rate * servo_map.safety.watchdog < WATCHDOG_CYCLES:
        raise CheckRefused(
            f"--rate {rate:g} is too low: safety.watchdog = {servo_map.safety.watchdog:g} s would trip within "
            f"{WATCHDOG_CYCLES} cycles; use {math.ceil(WATCHDOG_CYCLES / servo_map.safety.watchdog)} or more"
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
            f"{count} servos at {servo_map.bus.baud / 1e6:g} Mbit/s need {cycle_time * 1e3:.2f} ms per cycle, but "
            f"{rate:g} Hz leaves {1e3 / rate:.2f} ms; use --rate {highest} or less, or a higher baud rate"
        )
    return CyclePlan(rate, cycle_time, health_time, max(1, math.ceil(health_time / available)))


class MotionLimits:
    """Motion limits of the joints of a map, checked for whole paths or single intervals."""

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
        """Yield the smallest margin of each joint to each motion limit.

        Parameters
        ----------
        path : Path
        speed : float
            Playback speed.
        since : float
            Only intervals and windows that end after this path time [s] are checked.
        broken : bool
            If True, yield only violated limits.
        """
        extremes = path.extremes(since)
        # The windows are in robot time: `speed` seconds of the path pass in one second.
        jerk, jerk_time = path.jerk(JERK_WINDOW * speed, since)
        shaking, shaking_time = path.shaking(SHAKING_WINDOW * speed, since)
        with np.errstate(over="ignore"):
            values: dict[Quantity, tuple[Array, Array]] = {
                "velocity": (speed * extremes.velocity, extremes.velocity_time),
                "acceleration": (speed * (speed * extremes.acceleration), extremes.acceleration_time),
                "jerk": (speed * (speed * (speed * jerk)), jerk_time),
                "shaking": (speed * shaking, shaking_time),
            }
        columns = [self._tightest_position(extremes.position, extremes.position_time)]
        for quantity, (value, time) in values.items():
            limit = self._highest[quantity]
            worst, when = _extreme(np.abs, value, time)
            columns.append((worst, limit, limit - np.abs(worst), when))
        table = np.array(columns).transpose(2, 0, 1)  # (N, quantities, 4)
        wanted = ~(table[..., 2] >= -ROUNDING) if broken else np.ones(table.shape[:2], dtype=bool)
        wanted[:, 0] &= self._in_position_mode
        quantities: list[Quantity] = ["position", *values]
        for joint, quantity in np.argwhere(wanted):
            yield Margin(self._servos[joint].joint, quantities[quantity], *table[joint, quantity].tolist())

    def _tightest_position(self, position: Array, time: Array) -> tuple[Array, Array, Array, Array]:
        lowest, lowest_time = _extreme(np.negative, position, time)
        highest, highest_time = _extreme(np.positive, position, time)
        below = lowest - self._low < self._high - highest
        return (
            np.where(below, lowest, highest),
            np.where(below, self._low, self._high),
            np.where(below, lowest - self._low, self._high - highest),
            np.where(below, lowest_time, highest_time),
        )


def _extreme(key: Callable[[Array], Array], values: Array, times: Array) -> tuple[Array, Array]:
    """Return the value of each joint with the largest ``key``, and the time of that value; shape (N,)."""
    values, times = (part.reshape(-1, values.shape[-1]) for part in (values, times))
    largest = key(values).argmax(axis=0), np.arange(values.shape[1])
    return values[largest], times[largest]


def position_bounds(servo: MappedServo) -> tuple[float, float]:
    """Return the position limits of the map, restricted to the single turn of position mode [rad]."""
    turn = sorted((servo.to_angle(0), servo.to_angle(TICKS_PER_TURN - 1)))
    return max(servo.position_limits[0], turn[0]), min(servo.position_limits[1], turn[1])


def velocity_limit(servo: MappedServo) -> float:
    """Return the joint speed limit [rad/s]: the lower of the limit in the map and the no-load speed of the model."""
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
