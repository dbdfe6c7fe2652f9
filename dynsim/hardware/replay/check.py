"""Check of motions against the limits of joints, servos and bus: whole records, and postures of a live drive.

The check evaluates the extremes of the interpolant in every interval between samples. Nothing is clamped: a record that
exceeds a limit is rejected as a whole, before a port is opened. This module also plans the cycle of the bus.

In a live drive the servos lag the simulation by at least half of ``safety.stop_time``, so that enough of the path ahead
of the last goal is known and checked for a stop along the path within that time. With b the length of known path ahead
[s], T the stop time and h the period, a cycle advances by s h along the path, where s is the largest speed with

    s² T/2 ≤ b − s h,     s ≤ 1,     s ≤ s_before + h/T

If the simulation is late, the robot slows down along its path and stops at the end of the path; it speeds up again at
the same rate. Lost time is not made up: the simulation waits for the servos (:meth:`Feed.report_time`).

If a snake robot lifts wheel pairs, postures are delayed until the joint angles of the lifting are known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from dynsim.errors import CheckRefused
from dynsim.hardware.bus.control_table import HEALTH_BLOCK, RAD_PER_TICK, RAW_BLOCK, STATE_BLOCK
from dynsim.hardware.replay.measured import unmeasured
from dynsim.hardware.replay.output import Stopped
from dynsim.hardware.replay.rules import Cause, Fault, needs_of_map
from dynsim.hardware.replay.trajectory import (
    GAP_FACTOR,
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
from dynsim.snake.lifting import (
    TIME_ROUNDING,
    base_part,
    fold_to_heights,
    height_of,
    refuse_long_steps,
    refuse_other_joints,
    refuse_short_lift,
    refuse_what_cannot_stand,
)

BITS_PER_BYTE = 10
TURNAROUND = 50e-6
"""Planned time per status packet that servos and adapter add to its bytes and the return delay [s] (unverified)."""
USB_TRANSACTION = 1e-3
"""Planned delay of an answer in a USB adapter with a latency timer of 1 ms [s]."""
WATCHDOG_CYCLES = 3
"""Minimum time-out of the servo watchdogs [cycles]."""
BUS_SHARE = 0.97
"""Maximum fraction of the period for which the bus may be busy."""

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
"""Exponent n of each quantity: at path speed s, the quantity is proportional to s^n, or it decreases even faster if the
path is slowed down (the time windows for jerk and shaking contain a shorter part of a slower path)."""

SLOWEST, FASTEST = 0.01, 10.0
"""Range of path speeds, in seconds of the path per second."""
LONGEST = 24 * 3600.0
"""Maximum duration of a motion [s]; a longer duration is rejected as a mistake."""
STILL = 1e-6
"""A joint that turns by less than this angle [rad] in a record counts as stationary."""
ROUNDING = 1e-9
"""Tolerance for the rounding errors of a joint that rests at its limit; for comparison, a tick is 1.5e-3 rad."""


@dataclass(frozen=True)
class Margin:
    """Smallest margin between a quantity of one joint and its limit.

    Attributes
    ----------
    joint : str
    quantity : "position", "velocity", "acceleration", "jerk", "shaking" or "torque"
    value, limit, margin : float
        Value, limit and margin in SI units; a negative margin means that the limit is violated.
    time : float
        Time at which the value occurs [s of record time].
    source : str
        For a position: servo position at the limit, zero, and entry in the servo map.
    """

    joint: str
    quantity: Quantity
    value: float
    limit: float
    margin: float
    time: float
    source: str = ""

    @property
    def unit(self) -> str:
        return UNITS[self.quantity]

    @property
    def holds(self) -> bool:
        # This is False for NaN, which results from an overflow.
        return self.margin >= -ROUNDING

    def __str__(self) -> str:
        unit = self.unit
        return (
            f"{self.joint}: {self.quantity} {self.value:.4f} {unit} at t = {self.time:.3f} s, "
            f"limit {self.limit:.4f} {unit}{self.source and f' ({self.source})'}, margin {self.margin:+.4f} {unit}"
        )


@dataclass(frozen=True, kw_only=True)
class CheckedMotion:
    """Motion that has passed the offline check and can be replayed.

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
        """Return the margin that is smallest relative to its limit (or half the position range), and the ratio."""
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
    """Check a whole record against the limits in the map, the data sheets of the servos, and the bus.

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
        If a limit is violated; the message lists the joint, value, time and margin of each violation.
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
                lines.append(f"  with --speed {math.floor(100 * slower) / 100:g}, the check would pass")
        raise CheckRefused("\n".join(lines))
    warnings = [] if record.complete else ["the record is marked incomplete: it ends before its scenario does"]
    if limp := uncovered_joints(record, servo_map):
        warnings.append(f"joints in the record that have no servo and are limp on the robot: {'; '.join(limp)}")
    warnings += [
        f"{servo.joint}: its operating mode ends within limits.position_deg ({servo.bound_text(bound)}); "
        "turn the horn, or use mode: extended_position"
        for servo in servo_map.servos
        if servo.in_position_mode
        for bound, limit in zip(position_bounds(servo), servo.position_limits, strict=True)
        if abs(bound - limit) > 1.5 * RAD_PER_TICK / servo.gear
    ]
    if missing := long_steps(record, LONG_FACTOR, LONG_QUANTILE):
        warnings.append(
            f"{len(missing)} of {len(record) - 1} time steps are too long, samples may be missing: {missing[0]}"
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
    """Return the joints in the record that no servo in the map follows, each with its range of motion.

    Only columns for which the record contains both position and rate count as joints. Therefore the planar pose of a
    mobile base is ignored.
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
    # Times that are not finite are rejected later, with a message that states the sample.
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
            f"--rate {rate:g} is too low: with safety.watchdog = {servo_map.safety.watchdog:g} s, "
            "the watchdogs would trip within "
            f"{WATCHDOG_CYCLES} cycles; use {math.ceil(WATCHDOG_CYCLES / servo_map.safety.watchdog)} or more"
        )
    count = len(servo_map.servos)
    groups = [sum(servo.in_position_mode is mode for servo in servo_map.servos) for mode in (True, False)]
    written = sum(14 + 5 * members for members in groups if members)
    byte_time = BITS_PER_BYTE / servo_map.bus.baud
    per_status = servo_map.bus.return_delay + TURNAROUND
    health_time = (14 + 11 + HEALTH_BLOCK[1]) * byte_time + per_status + USB_TRANSACTION

    def cycle(block: tuple[int, int]) -> tuple[float, float]:
        """Return the duration of a cycle that reads ``block``, and the time that is left for a health read [s]."""
        read = 14 + count + count * (11 + block[1])
        duration = (written + read) * byte_time + count * per_status + USB_TRANSACTION
        return duration, BUS_SHARE / rate - duration

    cycle_time, available = cycle(STATE_BLOCK)
    if available <= 0:
        highest = math.floor(BUS_SHARE / (cycle_time + 0.1 * health_time))
        raise CheckRefused(
            f"{count} servos at {servo_map.bus.baud / 1e6:g} Mbit/s need {cycle_time * 1e3:.2f} ms per cycle, but "
            f"{rate:g} Hz leaves {1e3 / rate:.2f} ms; use --rate {highest} or less, or a higher baud rate"
        )
    health_every = max(1, math.ceil(health_time / available))
    # Also read the PWM, unless this delays the health reads, on which abort rules depend.
    raw_time, left = cycle(RAW_BLOCK)
    if left > 0 and max(1, math.ceil(health_time / left)) == health_every:
        return CyclePlan(rate, raw_time, health_every, RAW_BLOCK)
    return CyclePlan(rate, cycle_time, health_every)


class MotionLimits:
    """Motion limits of the joints in a map, against which whole paths or single intervals are checked."""

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
        """Yield the smallest margin between each joint and each of its motion limits.

        Parameters
        ----------
        path : Path
        speed : float
            Playback speed.
        since : float
            Check only intervals and windows that end after this path time [s].
        broken : bool
            If True, yield only violated limits.
        """
        extremes = path.extremes(since)
        # The windows are specified in robot time, in which `speed` seconds of the path pass in one second.
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
        # The two servos of a pair differ only in the ticks of their positions.
        wanted[:, 1:] &= np.array([servo.joint == servo.axle for servo in self._servos])[:, None]
        quantities: list[Quantity] = ["position", *values]
        for joint, quantity in np.argwhere(wanted):
            servo, (worst, bound, margin, when) = self._servos[joint], table[joint, quantity].tolist()
            source = servo.bound_text(bound) if quantity == 0 else ""
            yield Margin(servo.joint, quantities[quantity], worst, bound, margin, when, source)

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
    """Return the value with the largest ``key`` for each joint, and the time of this value; shape (N,)."""
    values, times = (part.reshape(-1, values.shape[-1]) for part in (values, times))
    largest = key(values).argmax(axis=0), np.arange(values.shape[1])
    return values[largest], times[largest]


def position_bounds(servo: MappedServo) -> tuple[float, float]:
    """Return the position limits in the map [rad], restricted to the ticks that the operating mode allows."""
    turn = sorted(map(servo.to_angle, servo.turn))
    return max(servo.position_limits[0], turn[0]), min(servo.position_limits[1], turn[1])


def velocity_limit(servo: MappedServo) -> float:
    """Return the joint speed limit [rad/s]: the lower of the limit in the map and the no-load speed of the model."""
    return min(servo.kind.limits.velocity, servo.model.no_load_speed / servo.gear)


def _torque_margins(record: Record, servo_map: ServoMap) -> Iterator[Margin]:
    for servo in servo_map.servos:
        signal = servo.kind.follows.torque
        if signal is None or servo.hold_at is not None or servo.joint != servo.axle:
            continue
        # The limit holds for each servo of a pair.
        count = sum(other.axle == servo.axle for other in servo_map.servos)
        torque = column_of(record, signal, servo, "N m") / count
        highest = int(np.abs(torque).argmax())
        value, limit = float(torque[highest]), servo.kind.limits.torque
        time = float(record.time[highest] - record.time[0])
        yield Margin(servo.joint, "torque", value, limit, limit - abs(value), time)


# Live drive: a path that grows knot by knot; each knot is checked before it is sent to the servos.


class Sample(NamedTuple):
    """One sample of the motion, in the order of the servo map.

    Attributes
    ----------
    time : float
        Simulation time [s].
    position, velocity : array, shape (N,)
        Joint angles [rad] and rates [rad/s].
    lift, lift_rate : array, shape (N,), or float
        Angles [rad] and rates [rad/s] that are added to lift the wheel pairs of a snake robot.
    """

    time: float
    position: Array
    velocity: Array
    lift: Array | float = 0.0
    lift_rate: Array | float = 0.0

    @property
    def posture(self) -> Array:
        """Commanded joint angles including the lifting [rad], shape (N,)."""
        return self.position + self.lift


class IncrementalPath:
    """Path that grows at its end and drops the knots that goals and limits no longer need.

    Parameters
    ----------
    first : Sample
        Start of the path, at rest.
    servo_map : ServoMap
    """

    def __init__(self, first: Sample, servo_map: ServoMap) -> None:
        self._limits = MotionLimits(servo_map)
        self._held = np.array([servo.kind.follows.rates == "held" for servo in servo_map.servos])
        rates = np.zeros((0, len(first.position)))
        self._path = Path(np.array([first.time]), first.posture[None], rates, rates)
        self._last = first

    @property
    def end(self) -> float:
        """Time of the last knot [s]."""
        return self._path.end

    def at(self, time: float) -> tuple[Array, Array]:
        """Return joint angles [rad] and rates [rad/s] at a time [s]."""
        return self._path.at(time)

    def append(self, sample: Sample, *, keep: float) -> list[str]:
        """Add a knot if it does not break a limit, and return the texts of the broken limits.

        Jerk and shaking are evaluated as if the path ended at this knot. Knots before ``keep`` [s] and before the
        windows of the limits are dropped.
        """
        path, last = self._path, self._last
        with np.errstate(all="ignore"):  # NaN fails every bound
            h = sample.time - last.time
            held_rate = (sample.position - last.position) / h
            # At the first posture the rate of the lift is the rate in the first interval.
            lift_rate = (sample.lift - last.lift) / h if len(path.time) == 1 else last.lift_rate
            after = np.where(self._held, held_rate, last.velocity) + lift_rate
            before = np.where(self._held, held_rate, sample.velocity) + sample.lift_rate
            longer = path.since(min(keep, path.end - SHAKING_WINDOW), 2).longer(
                sample.time, sample.posture, after, before
            )
            # Check the windows that end after the last knot; their accelerations also depend on two earlier knots.
            windows = longer.since(path.end - SHAKING_WINDOW, 2)
            broken = [str(margin) for margin in self._limits.margins(windows, since=path.end, broken=True)]
        if not broken:
            self._path, self._last = longer, sample
        return broken


SLACK = 0.1
"""Lead of the simulation over the servos in addition to the path needed for a stop [s]."""
SILENCE = 5.0
"""Time without a posture after which the drive ends [s]; the robot is at rest for most of this time."""
MAX_VIOLATIONS = 4
"""Maximum number of violations listed in the message of a fault."""
REST = 1e-9
"""Remaining path time below which the path is finished [s]."""


class Feed(Protocol):
    """Interface of a source of postures. Its methods do not wait, write files or raise.

    Attributes
    ----------
    over : bool
        True if the drive ended normally and all samples were taken.
    fault : str
        Reason why no more postures will arrive although the drive has not ended; empty without a fault.
    """

    @property
    def over(self) -> bool: ...

    @property
    def fault(self) -> str: ...

    def take(self, most: int) -> Sequence[Sample]:
        """Return at most ``most`` samples that arrived since the last call, the oldest first."""

    def report_time(self, time: float) -> None:
        """Report the simulation time that the servos have reached [s].

        The simulation may advance to :func:`lead` beyond this time, and further by the delay of :class:`LiftLookahead`.
        """


def lead(servo_map: ServoMap) -> float:
    """Return the time by which the simulation may be ahead of the servos [s]."""
    return 0.5 * servo_map.safety.stop_time + SLACK


@dataclass(frozen=True, kw_only=True)
class DrivenMotion:
    """Motion commanded live by a pilot; only its start is known in advance.

    Attributes
    ----------
    plan : CyclePlan
    servo_map : ServoMap
    feed : Feed
    first : Sample
        Start of the motion.
    step : float
        Time between two samples [s].
    duration : float
        Maximum duration of the drive [s].
    scene : Scene or None
        Scene of the robot, which is copied into the measured record.
    speed : float
        Motion time per second.
    """

    plan: CyclePlan
    servo_map: ServoMap
    feed: Feed
    first: Sample
    step: float
    duration: float
    scene: Scene | None
    speed: ClassVar[float] = 1.0
    unmeasured: ClassVar[None] = None

    @property
    def start(self) -> Array:
        """Posture at the start [rad], shape (N,)."""
        return self.first.posture

    def needs(self) -> list[Needs]:
        """Return the full range allowed by the map, because the motion is not known."""
        return [needs_of_map(servo) for servo in self.servo_map.servos]

    def course(self) -> GoalCourse:
        """Return the course along the samples of the feed."""
        return DrivenCourse(self)


MotionTask = CheckedMotion | DrivenMotion
"""Motion that a replay executes: a checked record, or the commands of a pilot."""


def check_drive(
    first: Sample,
    servo_map: ServoMap,
    feed: Feed,
    *,
    step: float,
    longest: float,
    rate: float | None = None,
    scene: Scene | None = None,
) -> DrivenMotion:
    """Check a drive before its start: the first posture is within the limits and at rest, and the bus allows the rate.

    Parameters
    ----------
    first : Sample
        Start of the motion.
    servo_map : ServoMap
    feed : Feed
        Source of the samples.
    step : float
        Time between two samples [s].
    longest : float
        Maximum duration of the drive [s].
    rate : float, optional
        Command rate [Hz]; default: the rate in the map.
    scene : Scene, optional
        Scene for the measured record.

    Raises
    ------
    CheckRefused
        If a limit is violated, the simulation starts in motion, or the bus does not allow the rate.
    """
    plan = plan_cycle(servo_map, rate if rate is not None else servo_map.bus.rate)
    still = np.zeros((1, len(first.position)))
    start = Path(np.array([0.0, step]), np.stack([first.posture, first.posture]), still, still)
    broken = list(MotionLimits(servo_map).margins(start, broken=True))
    if broken:
        lines = "\n".join(f"  {margin}" for margin in broken)
        raise CheckRefused(f"the drive would start beyond {len(broken)} limit(s); nothing was sent:\n{lines}")
    moving = np.flatnonzero(~(np.abs(first.velocity) <= ROUNDING))
    if len(moving):
        names = ", ".join(servo_map.joints[k] for k in moving)
        raise CheckRefused(
            f"the simulation starts in motion ({names}), but servos start at rest; use zero initial rates"
        )
    return DrivenMotion(
        plan=plan, servo_map=servo_map, feed=feed, first=first, step=step, duration=longest, scene=scene
    )


class DrivenCourse(GoalCourse):
    """Course along the samples of a feed; each sample is checked before any goal of its interval is sent.

    The limits are the same as in the offline check. A sample that exceeds a limit is neither followed nor clamped:
    :class:`Stopped` ends the drive, and the fault policy stops along the path that has been checked.
    """

    def __init__(self, motion: DrivenMotion) -> None:
        self._path = IncrementalPath(motion.first, motion.servo_map)
        super().__init__(self._path, 0.0, self._path.end, speed=0.0)
        self._step, self._duration, self._feed = motion.step, motion.duration, motion.feed
        self._stop_time = motion.servo_map.safety.stop_time
        self._silent = 0.0

    @property
    def over(self) -> bool:
        return self._feed.over and self.end - self.time < REST

    @property
    def fraction(self) -> float:
        return min(1.0, self.time / self._duration)

    def braking_time(self, stop_time: float) -> float:
        # At reduced speed a stop in this time may need more path than is known.
        ahead = self.end - self.time
        return stop_time if 0.5 * self.speed * stop_time <= ahead else 2.0 * ahead / self.speed

    def advance(self, period: float) -> tuple[Array, Array]:
        self._take(period)
        stop_time, ahead = self._stop_time, self.end - self.time
        most = (math.sqrt(period * period + 2.0 * stop_time * ahead) - period) / stop_time
        self.speed = min(1.0, most, self.speed + period / stop_time)
        self.time = min(self.end, self.time + self.speed * period)
        self._feed.report_time(self.time)
        position, rate = self.at(self.time)
        return position, self.speed * rate

    def _take(self, period: float) -> None:
        """Append the samples that have arrived, limited in number so that the cycle is not late."""
        samples = self._feed.take(math.ceil(period / self._step) + 1)
        self._silent = 0.0 if samples else self._silent + period
        for sample in samples:
            if not 0.0 < sample.time - self.end <= GAP_FACTOR * self._step:
                text = f"time jumps from {self.end:g} to {sample.time:g} s (step {self._step:g} s)"
                raise Stopped(Fault(Cause.SIMULATION, text))
            if broken := self._path.append(sample, keep=self.time):
                text = "; ".join(broken[:MAX_VIOLATIONS])
                more = f"; and {len(broken) - MAX_VIOLATIONS} more" if len(broken) > MAX_VIOLATIONS else ""
                raise Stopped(Fault(Cause.LIMIT, f"the driven motion exceeds limits of the servo map: {text}{more}"))
            self.end = sample.time
        if self._feed.fault:
            raise Stopped(Fault(Cause.SIMULATION, self._feed.fault))
        if self._silent > SILENCE and not self._feed.over:
            raise Stopped(Fault(Cause.SIMULATION, f"no posture received for {SILENCE:g} s"))


# Lifted wheel pairs in a live drive: delay postures until the joint angles of the lifting are known.


@dataclass
class _PendingPosture:
    """Posture whose lifting angles are not known yet.

    Attributes
    ----------
    sample : Sample
        Sample without the lifting.
    yaw : array, shape (pairs - 1,)
        Yaw angles of the base part [rad].
    up, down : array, shape (pairs,)
        Times at which each pair is lifted and put down [s]. ``up`` is -inf for a pair that is lifted from the start and
        NaN for a pair on the ground; ``down`` is inf if the time is not known yet.
    """

    sample: Sample
    yaw: Array
    up: Array
    down: Array


class LiftLookahead:
    """Add the angles of lifted wheel pairs to the postures of a simulation, with a delay.

    Parameters
    ----------
    still : Record
        Record of the robot at its start, with its scene.
    servo_map : ServoMap
        Map with an entry ``lifts``.
    step : float
        Time between two postures [s].

    Attributes
    ----------
    delay : float
        Delay of the samples [s].

    Raises
    ------
    CheckRefused
        If ``lifts`` does not match the robot.
    """

    def __init__(self, still: Record, servo_map: ServoMap, step: float) -> None:
        lifts = servo_map.lifts
        assert lifts is not None
        pairs = still.labels[lifts.signal]
        refuse_other_joints(lifts, pairs)
        refuse_long_steps(lifts, step)
        self._lifts, self._pairs = lifts, pairs
        self._part = base_part(still, pairs)
        self._columns = [still.labels[self._part.signal].index(name) for name in self._part.yaw]
        self._joints = [servo_map.joints.index(joint) for joint in lifts.joints]
        self.delay = lifts.blend_s + 2.0 * step
        self._pending: list[_PendingPosture] = []
        # The last folded postures; the rate of the newest is not known yet.
        self._folded: list[Sample] = []
        self._changed = -np.inf

    @property
    def yaw(self) -> tuple[str, list[int]]:
        """Signal with the yaw angles of the base part, and their columns."""
        return self._part.signal, self._columns

    def steady(self, time: float) -> bool:
        """Return True if pairs may be lifted or put down at a time [s]: the last change has been completed."""
        blend = self._lifts.blend_s
        return time >= blend - TIME_ROUNDING and time - self._changed >= 2.0 * blend - TIME_ROUNDING

    def begin(self, sample: Sample, yaw: Array, grounded: Array) -> Sample:
        """Return the initial posture, at rest, with its lifting angles.

        Parameters
        ----------
        sample : Sample
            Posture without lifting angles.
        yaw : array, shape (pairs - 1,)
            Yaw angles of the base part [rad].
        grounded : array, shape (pairs,)
            1 for a pair on the ground, 0 for a lifted pair.

        Raises
        ------
        CheckRefused
            If a lifted pair cannot be lifted.
        """
        refuse_what_cannot_stand(grounded[None], self._pairs, np.array([sample.time]))
        self._grounded = grounded.copy()
        self._up, self._down = np.where(grounded == 0, -np.inf, np.nan), np.full(len(grounded), np.inf)
        self._enqueue(sample, yaw)
        first = self._fold(self._pending[0])
        self._folded = [first]
        return first

    def add(self, sample: Sample, yaw: Array, grounded: Array) -> list[Sample]:
        """Add a posture and return the completed samples, the oldest first, without the sample of :meth:`begin`.

        Parameters
        ----------
        sample : Sample
            Posture without lifting angles.
        yaw : array, shape (pairs - 1,)
            Yaw angles of the base part [rad].
        grounded : array, shape (pairs,)
            1 for a pair on the ground since the previous posture, 0 for a lifted pair.

        Raises
        ------
        CheckRefused
            If a lifted pair cannot be lifted, or not for so short a time.
        """
        since = self._pending[-1]
        time = since.sample.time
        if (grounded != self._grounded).any():
            self._change(since, grounded)
        self._enqueue(sample, yaw)
        return self._completed(time - self._lifts.blend_s + TIME_ROUNDING)

    def remaining(self) -> list[Sample]:
        """Return all pending samples after the last posture; lifted pairs stay lifted."""
        completed = self._completed(np.inf)
        return completed if len(self._folded) < 2 else [*completed, self._with_rate(len(self._folded) - 1)]

    def _enqueue(self, sample: Sample, yaw: Array) -> None:
        copy = Sample(sample.time, sample.position.copy(), sample.velocity.copy())
        self._pending.append(_PendingPosture(copy, yaw.copy(), self._up.copy(), self._down.copy()))

    def _change(self, since: _PendingPosture, grounded: Array) -> None:
        """Record that the set of grounded pairs has changed at a posture."""
        time = since.sample.time
        refuse_what_cannot_stand(grounded[None], self._pairs, np.array([time]))
        for pair in np.flatnonzero((grounded == 1) & (self._grounded == 0)):
            up = float(self._up[pair])
            always = not np.isfinite(up)
            refuse_short_lift(self._lifts, self._pairs[pair], max(up, 0.0), time, 1 if always else 2)
            for entry in self._pending:
                if entry.up[pair] == up:
                    entry.down[pair] = time
        self._up = np.where(grounded == 1, np.nan, np.where(self._grounded == 1, time, self._up))
        self._grounded, self._changed = grounded.copy(), time
        since.up = self._up.copy()

    def _completed(self, until: float) -> list[Sample]:
        """Fold the postures up to a time [s] and return the samples whose successor is folded too."""
        samples: list[Sample] = []
        # The first pending posture is the last that was folded.
        while len(self._pending) > 1 and self._pending[1].sample.time <= until:
            del self._pending[0]
            self._folded.append(self._fold(self._pending[0]))
            if len(self._folded) == 3:
                samples.append(self._with_rate(1))
                del self._folded[0]
        return samples

    def _fold(self, entry: _PendingPosture) -> Sample:
        sample = entry.sample
        time = np.array([sample.time])
        height = np.where(np.isnan(entry.up), 0.0, height_of(time, entry.up, entry.down, self._lifts))[None]
        fold = fold_to_heights(self._part, entry.yaw[None], height, self._lifts, time)
        lift = np.zeros(len(sample.position))
        lift[self._joints] = fold.hinge[0]
        return sample._replace(lift=lift)

    def _with_rate(self, index: int) -> Sample:
        lifts = np.array([entry.lift for entry in self._folded])
        rates = np.gradient(lifts, np.array([entry.time for entry in self._folded]), axis=0)
        return self._folded[index]._replace(lift_rate=rates[index])
