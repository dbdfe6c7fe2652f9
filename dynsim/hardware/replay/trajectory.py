"""Trajectory of servo goals from a record: continuous in time, at rest at both ends.

Between the samples of a record joint angles are the cubic Hermite interpolant of (q, v), or linear where the record's
rates are held from sample to sample (a sampled controller). Where the record begins or ends in motion, an interval of
constant acceleration is added (a parabola, which the same interpolant represents exactly), so that the robot starts and
ends at rest without a jump in velocity.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.config.problems import suggest
from dynsim.errors import CheckRefused
from dynsim.hardware.servo_map import MappedServo, ServoMap
from dynsim.record import TIME, Record
from dynsim.snake.lifting import grounded_pairs, lifted

if TYPE_CHECKING:
    from dynsim.record.scene import Scene

# Motions for servos: postures as functions of time, advance of the loop along them, and demands on the servos.


Array = NDArray[np.float64]

QUINTIC_PEAK = 1.875
"""Largest rate of :func:`quintic`, times its duration."""


class Motion(Protocol):
    """A posture as a function of the motion's own time."""

    def at(self, time: float) -> tuple[Array, Array]:
        """Joint angles [rad] and their derivatives with respect to ``time``, shape (N,)."""
        ...


class GoalCourse(Motion, Protocol):
    """Advance of the loop along a motion: one period from goal to goal, whatever the clock reads.

    Attributes
    ----------
    time : float
        Of the motion, reached [s].
    """

    time: float

    @property
    def speed(self) -> float:
        """How much of the motion passes per second."""

    @property
    def end(self) -> float:
        """How far the motion is known [s]."""

    @property
    def over(self) -> bool:
        """There are no more goals."""

    @property
    def fraction(self) -> float:
        """How much of it is done, 0 to 1."""

    def advance(self, period: float) -> tuple[Array, Array]:
        """The goal after a period [s]: joint angles [rad] and their rates [rad/s], shape (N,).

        May raise :class:`~dynsim.hardware.replay.output.Stopped`.
        """
        ...

    def braking_time(self, stop_time: float) -> float:
        """Of a stop along the motion at constant deceleration that should take ``stop_time`` [s]."""
        ...


class PlannedCourse:
    """A motion that is known from its time ``start`` to ``end`` [s], ``speed`` of it per second."""

    def __init__(self, motion: Motion, start: float, end: float, *, speed: float) -> None:
        self.motion, self.start, self.end, self.speed = motion, start, end, speed
        self.time = start
        self._goals = 0

    @property
    def over(self) -> bool:
        return self.time >= self.end

    @property
    def fraction(self) -> float:
        return min(1.0, max(0.0, self.time / (self.end or 1.0)))

    def at(self, time: float) -> tuple[Array, Array]:
        return self.motion.at(time)

    def advance(self, period: float) -> tuple[Array, Array]:
        self._goals += 1
        # Scheduled, not actual time: jitter of the loop must not enter the goals.
        self.time = min(self.end, self.start + self.speed * period * self._goals)
        position, rate = self.motion.at(self.time)
        return position, self.speed * rate

    def braking_time(self, stop_time: float) -> float:
        # Where the motion ends before, it ends at rest.
        return stop_time


@dataclass(frozen=True)
class Needs:
    """What a motion asks of one joint: lowest and highest angle [rad], highest speed [rad/s]."""

    low: float
    high: float
    fastest: float


@dataclass(frozen=True)
class CyclePlan:
    """How the bus's time is spent.

    Attributes
    ----------
    rate : float
        Cycles per second [Hz].
    cycle_time : float
        Planned duration of writing all goals and reading all states [s].
    health_time : float
        Planned duration of one health read [s].
    health_every : int
        One servo's health is read every so many cycles.
    """

    rate: float
    cycle_time: float
    health_time: float
    health_every: int


@dataclass(frozen=True, kw_only=True)
class MotionTask(ABC):
    """What a replay is to do: a checked record, or what a pilot will ask for.

    Attributes
    ----------
    plan : CyclePlan
    speed : float
        Seconds of the motion per second.
    scene : Scene or None
        What is known of the robot's looks; the measured record takes it over.
    unmeasured : Record or None
        What is known of its place that no servo says; the measured record takes that over too.
    """

    plan: CyclePlan
    speed: float = 1.0
    scene: Scene | None = None
    unmeasured: Record | None = None

    @property
    @abstractmethod
    def start(self) -> Array:
        """Posture in which the motion begins [rad], shape (N,)."""

    @property
    @abstractmethod
    def duration(self) -> float:
        """Longest time that it takes [s]."""

    @abstractmethod
    def needs(self) -> list[Needs]:
        """What it may ask of every joint, in the order of the map."""

    @abstractmethod
    def course(self) -> GoalCourse:
        """How to go along it, from its beginning."""


@dataclass(frozen=True)
class Approach:
    """Rest-to-rest move between two postures on a quintic, all joints in step.

    Attributes
    ----------
    start, goal : array, shape (N,)
        [rad].
    duration : float
        [s].
    """

    start: Array
    goal: Array
    duration: float

    def at(self, time: float) -> tuple[Array, Array]:
        fraction, rate = quintic(self.duration, time)
        return self.start + fraction * (self.goal - self.start), rate * (self.goal - self.start)


def quintic(duration: float, time: float) -> tuple[float, float]:
    """Fraction of a rest-to-rest move and its rate [1/s] at ``time`` [s]: s = 10u³ − 15u⁴ + 6u⁵, u = time/duration."""
    if duration <= 0:
        return 1.0, 0.0
    u = min(max(time / duration, 0.0), 1.0)
    return u**3 * (10 + u * (-15 + 6 * u)), 30 * u * u * (1 - u) ** 2 / duration


REST = 1e-6
"""Joint speed [rad/s] below which a record counts as at rest."""
HOLE, LONG = 2.5, 1.5
"""A step of more than HOLE times the median step is a gap in which the motion is not known. A step of more than LONG
times the 10 % quantile of all steps lacks samples; the median may itself be such a step."""
COMMON = 0.1
JERK_WINDOW = 0.1
"""Time over which the change of acceleration is averaged [s]: twice the lag of these servos (43.5 ms). A single jump in
the velocity of a record is bounded by the limit on acceleration; repeated jumps wear the gears."""
GROUNDED = "grounded"
"""Signal of dynsim's records with the wheel pairs on the ground; read where the map has no ``lifts``."""
SHAKING_WINDOW = 0.3
"""In which velocity that is gained and lost again counts as shaking [s]."""


@dataclass(frozen=True)
class Path:
    """Joint angles over path time.

    Attributes
    ----------
    time : array, shape (T,)
        Knots [s]; 0 is the first sample of the record, negative knots are the run-up.
    position : array, shape (T, N)
        At the knots [rad], in the order of the servo map.
    rate_after, rate_before : array, shape (T-1, N)
        Joint rates at the beginning and the end of every interval [rad/s].
    """

    time: Array
    position: Array
    rate_after: Array
    rate_before: Array

    @property
    def start(self) -> float:
        return float(self.time[0])

    @property
    def end(self) -> float:
        return float(self.time[-1])

    def at(self, time: float) -> tuple[Array, Array]:
        """Position [rad] and velocity [rad/s], shape (N,), at a path time [s]; at rest outside of the path."""
        if time <= self.time[0]:
            return self.position[0].copy(), np.zeros(self.position.shape[1])
        if time >= self.time[-1]:
            return self.position[-1].copy(), np.zeros(self.position.shape[1])
        left = int(np.searchsorted(self.time, time, side="right")) - 1
        h, q0, m0, b, a = self._cubics(left)
        s = (time - self.time[left]) / h
        return q0 + s * (m0 + s * (b + s * a)), (m0 + s * (2 * b + 3 * s * a)) / h

    def since(self, time: float, more: int) -> Path:
        """From the knot at or before a time on [s], and ``more`` knots before that."""
        first = max(0, int(np.searchsorted(self.time, time, side="right")) - 1 - more)
        return Path(self.time[first:], self.position[first:], self.rate_after[first:], self.rate_before[first:])

    def longer(self, time: float, position: Array, rate_after: Array, rate_before: Array) -> Path:
        """The same with one more knot, and rates at the beginning and the end of the interval before it."""
        return Path(
            np.append(self.time, time),
            np.concatenate([self.position, position[None]]),
            np.concatenate([self.rate_after, rate_after[None]]),
            np.concatenate([self.rate_before, rate_before[None]]),
        )

    def _cubics(self, k: int | slice) -> tuple[Array, ...]:
        """Of intervals: h [s], q0, m0, b, a, so that q = q0 + m0 s + b s² + a s³ with s from 0 to 1."""
        h = (self.time[1:][k] - self.time[:-1][k])[..., None]
        q0, q1 = self.position[:-1][k], self.position[1:][k]
        m0, m1 = h * self.rate_after[k], h * self.rate_before[k]
        return h, q0, m0, -3 * q0 + 3 * q1 - 2 * m0 - m1, 2 * q0 - 2 * q1 + m0 + m1

    def extremes(self, since: float = -math.inf) -> Extremes:
        """Every interval's extreme positions, velocities and accelerations, between the knots too.

        Acceleration q'' = (2b + 6a s)/h² is straight within an interval of length h, s = (t − t_k)/h: its extremes are
        the two ends. Where the rate itself steps, the step over the time it stands for is the third candidate. Only
        intervals that end after ``since`` [s] count.
        """
        late = slice(max(0, int(np.searchsorted(self.time, since, side="right")) - 1), None)
        h, q0, m0, b, a = self._cubics(late)
        # Position is extreme where 3a s² + 2b s + m0 = 0, velocity where 6a s + 2b = 0. The root is taken in the form
        # that does not cancel; where an interval has none, its ends stand in.
        with np.errstate(divide="ignore", invalid="ignore"):
            root = b + np.where(b < 0, -1.0, 1.0) * np.sqrt(b * b - 3 * a * m0)
            at_position = np.stack([np.zeros_like(a), np.ones_like(a), -root / (3 * a), -m0 / root])  # (4, T-1, N)
            at_velocity = np.stack([np.zeros_like(a), np.ones_like(a), -b / (3 * a)])
        at_position = np.where((at_position >= 0) & (at_position <= 1), at_position, 0.0)
        at_velocity = np.where((at_velocity >= 0) & (at_velocity <= 1), at_velocity, 0.0)
        position = q0 + at_position * (m0 + at_position * (b + at_position * a))
        velocity = (m0 + at_velocity * (2 * b + 3 * at_velocity * a)) / h
        left = self.time[:-1][late, None]
        ends = np.stack([left, left + h, left]) + np.zeros_like(a)
        with np.errstate(over="ignore"):  # an infinite one is beyond any limit
            acceleration = np.stack([*(table[late] for table in self._accelerations), self._steps[late]])
        return Extremes(left + h * at_position, position, left + h * at_velocity, velocity, ends, acceleration)

    @cached_property
    def _steps(self) -> Array:
        """Acceleration for the step in rate at the beginning of every interval [rad/s²], shape (T-1, N).

        A rate that is held from sample to sample stands for the middle of its interval, so that the step between two
        of them takes half the one interval and half the other. There is none before the first interval.
        """
        h = np.diff(self.time)[:, None]
        steps = np.zeros_like(self.rate_after)
        steps[1:] = (self.rate_after[1:] - self.rate_before[:-1]) / (0.5 * (h[1:] + h[:-1]))
        return steps

    def jerk(self, window: float, since: float = -math.inf) -> tuple[Array, Array]:
        """Change of acceleration per time, averaged in magnitude over ``window`` [s] of path time.

        j(t) = (1/window) Σ |a_{k+1} − a_k| over the knots between t − window and t, in which a_k is the mean of what
        the interpolant has on both sides of knot k, plus the step in rate there. It is the mean of |d³q/dt³| for a
        smooth path, 4 |a| f for one that is thrown to and fro f times a second, whatever the window, and Δa/window for
        a single jump. Between knots a is taken as straight. Only windows that end after ``since`` [s] count.

        Returns
        -------
        jerk : array, shape (N,)
            Largest of each joint [rad/s³].
        time : array, shape (N,)
            Where the window of that value ends [s].
        """
        variation = np.zeros_like(self.position)
        self._changes.cumsum(axis=0, out=variation[1:])
        ends, within = self._within(variation, window, since)
        jerk, where = self._worst(ends, within)
        return jerk / window, where

    def shaking(self, window: float, since: float = -math.inf) -> tuple[Array, Array]:
        """Velocity that is gained and lost again, or lost and gained again, within ``window`` [s] of path time.

        min(P, N), in which P = ∫ max(q'', 0) dt and N = ∫ max(−q'', 0) dt over the window, steps in rate included. It
        does not depend on a velocity the joint has besides. A zigzag of d every h has d · window/h² where the window
        holds many teeth, a spike of d within 2h (out in h, back in h) 2d/h with held rates; a move that goes one way
        gains and loses its top speed once, which counts where it takes no longer than the window. Only windows that end
        after ``since`` [s] count.

        Returns
        -------
        shaking : array, shape (N,)
            Largest of each joint [rad/s].
        time : array, shape (N,)
            Where the window of that value ends [s].
        """
        h, count = np.diff(self.time)[:, None], self.position.shape[1]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            first, last = self._accelerations
            # q'' is straight in an interval: where it changes sign the rate turns on the way.
            turning = self.rate_after + 0.5 * h * first * (first / (first - last))
            turning = np.where(first * last < 0, turning, self.rate_before)
            # Until the rate turns and from there on, and the step at the end of the interval.
            gained = np.maximum(turning - self.rate_after, 0.0) + np.maximum(self.rate_before - turning, 0.0)
            change, step = self.rate_before - self.rate_after, self.rate_after[1:] - self.rate_before[:-1]
            gained[:-1] += np.maximum(step, 0.0)
            change[:-1] += step
            total = np.zeros((len(self.time), 2 * count))
            np.concatenate([gained, np.maximum(gained - change, 0.0)], axis=1).cumsum(axis=0, out=total[1:])
        ends, within = self._within(total, window, since)
        return self._worst(ends, np.minimum(within[:, :count], within[:, count:]))

    @cached_property
    def _accelerations(self) -> tuple[Array, Array]:
        """Acceleration of the interpolant at the beginning and the end of every interval [rad/s²], shape (T-1, N)."""
        h, _, _, b, a = self._cubics(slice(None))
        return 2 * b / h / h, (2 * b + 6 * a) / h / h

    @cached_property
    def _changes(self) -> Array:
        """Change of acceleration from knot to knot in magnitude [rad/s²], shape (T-1, N)."""
        first, last = self._accelerations
        with np.errstate(over="ignore", invalid="ignore"):
            at_knots = np.concatenate([first[:1], 0.5 * (last[:-1] + first[1:]) + self._steps[1:], last[-1:]])
            return np.abs(at_knots[1:] - at_knots[:-1])

    def bounds_of_last(self, jerk_window: float, shaking_window: float) -> tuple[Array, Array, Array, Array, Array]:
        """What does not fall short of the extremes of the last interval, at a third of their cost.

        A cubic is between its control points, and so is its rate; of its windows all intervals count that they touch.
        What is gained and lost again in one is half of all that the rate changes by, or less.

        Returns
        -------
        position : array, shape (3, N)
            Control points [rad], but for the first.
        velocity, acceleration, jerk, shaking : array, shape (N,)
            In magnitude; times a window that of its jerk [rad/s²].
        """
        h, q0, q1 = float(self.time[-1] - self.time[-2]), self.position[-2], self.position[-1]
        v0, v1 = self.rate_after[-1], self.rate_before[-1]
        velocity = np.abs([v0, 3.0 * (q1 - q0) / h - v0 - v1, v1]).max(axis=0)
        first, last = self._accelerations
        acceleration = np.abs([first[-1], last[-1], self._steps[-1]]).max(axis=0)
        jerk_from, shaking_from = np.maximum(
            np.searchsorted(self.time, self.time[-2] - np.array([jerk_window, shaking_window]), side="right") - 1, 0
        )
        since = slice(shaking_from, None)
        within = 0.5 * np.diff(self.time)[since, None] * (np.abs(first[since]) + np.abs(last[since]))
        steps = np.abs(self.rate_after[1:] - self.rate_before[:-1])[since]
        return (
            np.array([q0 + h / 3.0 * v0, q1 - h / 3.0 * v1, q1]),
            velocity,
            acceleration,
            self._changes[jerk_from:].sum(axis=0),
            0.5 * (within.sum(axis=0) + steps.sum(axis=0)),
        )

    def _within(self, total: Array, window: float, since: float) -> tuple[Array, Array]:
        """What ``total``, a running sum at the knots, grows by within windows: their ends (M,) [s], growth (M, N).

        The growth is straight between windows that begin or end at a knot, and no larger in one that reaches beyond the
        path.
        """
        ends = np.concatenate([self.time, self.time + window])
        ends = ends[(ends > since) & (ends <= self.end)]
        with np.errstate(over="ignore", invalid="ignore"):
            return ends, self._interpolated(total, ends) - self._interpolated(total, ends - window)

    def _interpolated(self, values: Array, times: Array) -> Array:
        """Values at the knots (T, N), straight between them and the first one before, at other times: (M, N)."""
        left = np.maximum(np.searchsorted(self.time[:-1], times, side="right") - 1, 0)
        fraction = np.maximum((times - self.time[left]) / (self.time[left + 1] - self.time[left]), 0.0)[:, None]
        return values[left] + fraction * (values[left + 1] - values[left])

    def _worst(self, ends: Array, values: Array) -> tuple[Array, Array]:
        """Of each joint the largest value, and the end of its window."""
        worst = values.argmax(axis=0)
        return values[worst, np.arange(values.shape[1])], ends[worst]


class Extremes(NamedTuple):
    """Candidates for extreme values, each with its path time; all of shape (candidates, T-1, N)."""

    position_time: Array
    position: Array
    velocity_time: Array
    velocity: Array
    acceleration_time: Array
    acceleration: Array


def path_of_record(record: Record, servo_map: ServoMap) -> Path:
    """Collect the columns the servos follow and bring both ends to rest.

    Raises
    ------
    CheckRefused
        A signal or column is missing, time does not increase or has holes, a value is not finite, or the record is too
        short.
    """
    _check_time(record)
    time = record.time - record.time[0]
    position = np.empty((len(record), len(servo_map.servos)))
    rate_after, rate_before = np.empty_like(position[1:]), np.empty_like(position[1:])
    for column, servo in enumerate(servo_map.servos):
        if servo.hold_at is not None:
            position[:, column], rate_after[:, column], rate_before[:, column] = servo.hold_at, 0.0, 0.0
            continue
        follows = servo.kind.follows
        position[:, column] = column_of(record, follows.position, servo, "rad")
        velocity = column_of(record, follows.velocity, servo, "rad/s")
        if follows.rates == "held":
            rate_after[:, column] = rate_before[:, column] = np.diff(position[:, column]) / np.diff(time)
        else:
            rate_after[:, column], rate_before[:, column] = velocity[:-1], velocity[1:]
    for joint, offset in wheel_offsets(record, servo_map).items():
        column, rate = servo_map.joints.index(joint), np.gradient(offset, time)
        position[:, column] += offset
        rate_after[:, column] += rate[:-1]
        rate_before[:, column] += rate[1:]
    return _at_rest_at_both_ends(Path(time, position, rate_after, rate_before), servo_map.safety.run_up)


def _check_time(record: Record) -> None:
    if len(record) < 2:
        raise CheckRefused(f"the record has {len(record)} samples; a motion needs two")
    known = np.isfinite(record.time)
    if not known.all():
        bad = int(np.flatnonzero(~known)[0])
        raise CheckRefused(f"the record's time is {record.time[bad]} at sample {bad}, of {len(record)} samples")
    with np.errstate(over="ignore"):
        steps = np.diff(record.time)
    later = np.isfinite(steps) & (steps > 0)
    if not later.all():
        bad = int(np.flatnonzero(~later)[0]) + 1
        raise CheckRefused(f"the record's time does not increase at sample {bad} (t = {record.time[bad]:g} s)")
    if holes := long_steps(record, HOLE, 0.5):
        raise CheckRefused(
            f"the record has {len(holes)} hole(s): {holes[0]}; what the robot did there is not known. "
            "Simulate with an even step, or cut the record"
        )


def long_steps(record: Record, factor: float, share: float) -> list[str]:
    """Steps of the record's time longer than ``factor`` times the usual one, each in words.

    The usual step is the one that ``share`` of all steps do not exceed: 0.5 for their median.
    """
    steps = np.diff(record.time)
    usual = float(np.quantile(steps, share, method="lower"))
    return [
        f"no sample between t = {record.time[k]:g} and {record.time[k + 1]:g} s, {steps[k] / usual:.3g} of the usual "
        f"steps of {usual * 1e3:g} ms"
        for k in np.flatnonzero(steps > factor * usual)
    ]


def column_of(record: Record, signal: str, servo: MappedServo, unit: str) -> Array:
    """The column of ``signal`` that ``servo`` follows, shape (T,).

    Raises
    ------
    CheckRefused
        No such signal or column, another unit, or a value that is not finite.
    """
    if signal not in record:
        raise CheckRefused(
            f"{servo.entry}: follows the signal {signal!r}; the record has {', '.join(record)}{suggest(signal, record)}"
        )
    labels = record.labels[signal]
    if servo.label not in labels:
        raise CheckRefused(
            f"{servo.entry}: follows column {servo.label!r} of {signal!r}; "
            f"its columns are {', '.join(labels)}{suggest(servo.label, labels)}"
        )
    if record.units[signal] != unit:
        raise CheckRefused(f"signal {signal!r} is in {record.units[signal]!r}; {servo.joint} needs {unit!r}")
    if record[signal].ndim != 2:
        raise CheckRefused(
            f"signal {signal!r} must have one column for each joint, not the shape {record[signal].shape}"
        )
    if record.signals[signal].axis != TIME:
        raise CheckRefused(
            f"signal {signal!r} is on time axis {record.signals[signal].axis!r}, not on the record's own"
        )
    data = np.asarray(record[signal][:, labels.index(servo.label)], dtype=np.float64)
    if not np.all(np.isfinite(data)):
        bad = int(np.flatnonzero(~np.isfinite(data))[0])
        raise CheckRefused(f"{servo.joint}: {signal!r} is {data[bad]} at t = {record.time[bad]:g} s")
    return data


def wheel_offsets(record: Record, servo_map: ServoMap) -> dict[str, Array]:
    """What lifting adds to the joints that the map names for it, shape (T,) each [rad]; none where nothing is lifted.

    Raises
    ------
    CheckRefused
        The record lifts wheels and the map does not say how, or it lifts what cannot be lifted.
    """
    lifts = servo_map.lifts
    if lifts is None:
        _refuse_lifted_wheels(record)
        return {}
    return dict(zip(lifts.joints, lifted(record, lifts).hinge.T, strict=True))


def _refuse_lifted_wheels(record: Record) -> None:
    if GROUNDED not in record:
        return
    up = np.flatnonzero((grounded_pairs(record, GROUNDED) == 0).any(axis=0))
    if len(up):
        names = ", ".join(record.labels[GROUNDED][k] for k in up)
        raise CheckRefused(
            f"the record lifts wheel pairs ({names}) and the servo map does not say how: without it they would drag "
            "over the floor. Add to the map, for example:\n"
            "  lifts: {joints: [psi3, psi4, psi5, psi6, psi7, psi8], clearance_mm: 5, blend_s: 0.3}"
        )


def _at_rest_at_both_ends(path: Path, acceleration: float) -> Path:
    first, last = path.rate_after[0], path.rate_before[-1]
    still = np.zeros_like(first)
    if (fastest := np.abs(last).max()) > REST:
        duration = fastest / acceleration
        path = path.longer(path.end + duration, path.position[-1] + 0.5 * duration * last, last, still)
    if (fastest := np.abs(first).max()) > REST:
        duration = fastest / acceleration
        path = Path(
            np.concatenate([[-duration], path.time]),
            np.concatenate([path.position[:1] - 0.5 * duration * first, path.position]),
            np.concatenate([still[None], path.rate_after]),
            np.concatenate([first[None], path.rate_before]),
        )
    return path
