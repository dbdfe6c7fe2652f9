"""Motions of servos as functions of time, and the trajectory of servo goals that is built from a record.

The trajectory is continuous in time, and starts and ends at rest. Between the samples of a record, joint angles are the
cubic Hermite interpolant of (q, v), or linear functions if the record holds its rates from sample to sample (a sampled
controller). If the record starts or ends in motion, an interval of constant acceleration is added (a parabola, which
the interpolant represents exactly), so that the robot starts and ends at rest without a jump in velocity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.config.problems import suggest
from dynsim.errors import CheckRefused
from dynsim.hardware.bus.control_table import STATE_BLOCK
from dynsim.hardware.servo_map import MappedServo, ServoMap
from dynsim.record import TIME, Record
from dynsim.record.joint_motion import ramp
from dynsim.snake.lifting import grounded_pairs, lifted

# Motions of servos: postures as functions of time, how the loop advances along them, and their demands on the servos.


Array = NDArray[np.float64]

QUINTIC_PEAK = 1.875
"""Maximum rate of :func:`quintic`, multiplied by the duration of the move."""


class Motion(Protocol):
    """Posture as a function of motion time."""

    def at(self, time: float) -> tuple[Array, Array]:
        """Return joint angles [rad] and their derivatives with respect to ``time``, shape (N,)."""


class GoalCourse:
    """Progress of the control loop along a motion: one period from goal to goal, independent of the clock.

    Parameters
    ----------
    motion : Motion
    start : float
        Motion time of the first goal [s].
    end : float
        Motion time up to which the motion is known [s].
    speed : float
        Motion time per second.

    Attributes
    ----------
    time : float
        Motion time of the last goal [s].
    """

    def __init__(self, motion: Motion, start: float, end: float, *, speed: float) -> None:
        self.end, self.speed = end, speed
        self.time = self._start = start
        self._motion = motion
        self._goals = 0

    @property
    def over(self) -> bool:
        """True if there are no more goals."""
        return self.time >= self.end

    @property
    def fraction(self) -> float:
        """Completed fraction of the motion, from 0 to 1."""
        return min(1.0, max(0.0, self.time / (self.end or 1.0)))

    def at(self, time: float) -> tuple[Array, Array]:
        """Return joint angles [rad] and their derivatives with respect to ``time``, shape (N,)."""
        return self._motion.at(time)

    def advance(self, period: float) -> tuple[Array, Array]:
        """Return the goal after one more period [s]: joint angles [rad] and their rates [rad/s], shape (N,).

        May raise :class:`~dynsim.hardware.replay.output.Stopped`.
        """
        self._goals += 1
        # Use the scheduled time, because jitter of the loop must not affect the goals.
        self.time = min(self.end, self._start + self.speed * period * self._goals)
        position, rate = self.at(self.time)
        return position, self.speed * rate

    def braking_time(self, stop_time: float) -> float:
        """Return how long a stop along the motion at constant deceleration takes [s]; ``stop_time`` is desired [s]."""
        # If the motion ends before the stop does, it ends at rest anyway.
        return stop_time


@dataclass(frozen=True)
class Needs:
    """Demands of a motion on one joint: its lowest angle, highest angle [rad] and maximum speed [rad/s]."""

    low: float
    high: float
    fastest: float


@dataclass(frozen=True)
class CyclePlan:
    """Time budget of the bus in each cycle.

    Attributes
    ----------
    rate : float
        Cycles per second [Hz].
    cycle_time : float
        Planned duration of writing all goals and reading all states [s].
    health_every : int
        Number of cycles from one health read to the next; each reads the health of one servo.
    state_block : tuple of int
        Address and length of the block that is read from all servos.
    """

    rate: float
    cycle_time: float
    health_every: int
    state_block: tuple[int, int] = STATE_BLOCK


@dataclass(frozen=True)
class Approach:
    """Synchronous rest-to-rest move of all joints between two postures; the joint angles follow a quintic polynomial.

    Attributes
    ----------
    start, goal : array, shape (N,)
        Joint angles [rad].
    duration : float
        Duration [s].
    """

    start: Array
    goal: Array
    duration: float

    def at(self, time: float) -> tuple[Array, Array]:
        fraction, rate = quintic(self.duration, time)
        return self.start + fraction * (self.goal - self.start), rate * (self.goal - self.start)


def quintic(duration: float, time: float) -> tuple[float, float]:
    """Return the completed fraction s of a rest-to-rest move, and its rate [1/s].

    s = 10u³ − 15u⁴ + 6u⁵ with u = time/duration.
    """
    if duration <= 0:
        return 1.0, 0.0
    u = min(max(time / duration, 0.0), 1.0)
    return u**3 * (10 + u * (-15 + 6 * u)), 30 * u * u * (1 - u) ** 2 / duration


GAP_FACTOR, LONG_FACTOR = 2.5, 1.5
"""A time step longer than GAP_FACTOR times the median is a gap, in which the motion is unknown. In a step longer than
LONG_FACTOR times the quantile LONG_QUANTILE, samples are probably missing (even the median step may lack samples)."""
LONG_QUANTILE = 0.1
JERK_WINDOW = 0.1
"""Time over which the jerk is averaged [s]: about twice the lag of these servos (43.5 ms). The acceleration limit
bounds a single jump in velocity; the jerk limit bounds repeated jumps, which wear the gears."""
GROUNDED = "grounded"
"""Signal in dynsim records that states which wheel pairs are on the ground; it is used if the map has no ``lifts``."""
SHAKING_WINDOW = 0.3
"""A change of velocity counts as shaking if it is reversed within this time [s]."""


@dataclass(frozen=True)
class Path:
    """Joint angles as functions of the path time.

    Attributes
    ----------
    time : array, shape (T,)
        Times of the knots [s]; 0 is the time of the first sample of the record, and negative times are in the run-up.
    position : array, shape (T, N)
        Joint angles at the knots [rad], in the order of the servo map.
    rate_after, rate_before : array, shape (T-1, N)
        Joint rates at the start and the end of each interval [rad/s].
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
        """Return the position [rad] and velocity [rad/s] at a path time [s], shape (N,); at rest outside the path."""
        if time <= self.time[0]:
            return self.position[0].copy(), np.zeros(self.position.shape[1])
        if time >= self.time[-1]:
            return self.position[-1].copy(), np.zeros(self.position.shape[1])
        left = int(np.searchsorted(self.time, time, side="right")) - 1
        h, q0, m0, b, a = self._cubics(left)
        s = (time - self.time[left]) / h
        return q0 + s * (m0 + s * (b + s * a)), (m0 + s * (2 * b + 3 * s * a)) / h

    def since(self, time: float, more: int) -> Path:
        """Return the end of the path; it starts ``more`` knots before the last knot that is not after ``time`` [s]."""
        first = max(0, int(np.searchsorted(self.time, time, side="right")) - 1 - more)
        return Path(self.time[first:], self.position[first:], self.rate_after[first:], self.rate_before[first:])

    def longer(self, time: float, position: Array, rate_after: Array, rate_before: Array) -> Path:
        """Return the path with one more knot; the two rates apply at the start and the end of the new interval."""
        return Path(
            np.append(self.time, time),
            np.vstack([self.position, position]),
            np.vstack([self.rate_after, rate_after]),
            np.vstack([self.rate_before, rate_before]),
        )

    def _cubics(self, k: int | slice) -> tuple[Array, ...]:
        """Return h [s], q0, m0, b and a for some intervals, where q = q0 + m0 s + b s² + a s³ with s from 0 to 1."""
        h = (self.time[1:][k] - self.time[:-1][k])[..., None]
        q0, q1 = self.position[:-1][k], self.position[1:][k]
        m0, m1 = h * self.rate_after[k], h * self.rate_before[k]
        return h, q0, m0, -3 * q0 + 3 * q1 - 2 * m0 - m1, 2 * q0 - 2 * q1 + m0 + m1

    def extremes(self, since: float = -math.inf) -> Extremes:
        """Return candidates for the extreme positions, velocities and accelerations of each interval.

        In an interval of length h, with s = (t − t_k)/h, the acceleration q'' = (2b + 6a s)/h² is linear, so its
        extremes are at the two ends. If there is a step in the rate, the step divided by its time is the third
        candidate. Only intervals that end after ``since`` [s] are included.
        """
        late = slice(max(0, int(np.searchsorted(self.time, since, side="right")) - 1), None)
        h, q0, m0, b, a = self._cubics(late)
        # The position is extreme where 3a s² + 2b s + m0 = 0, the velocity where 6a s + 2b = 0. The root is computed in
        # a form without cancellation; if an interval has no root, its start is used instead.
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
        with np.errstate(over="ignore"):  # an infinite value exceeds any limit
            acceleration = np.stack([*(table[late] for table in self._accelerations), self._steps[late]])
        return Extremes(left + h * at_position, position, left + h * at_velocity, velocity, ends, acceleration)

    @cached_property
    def _steps(self) -> Array:
        """Acceleration for the step in the rate at the start of each interval [rad/s²], shape (T-1, N).

        A rate that is held from sample to sample is assigned to the middle of its interval. Therefore the step between
        two rates lasts for half of each of the two intervals. The first interval has no step.
        """
        h = np.diff(self.time)[:, None]
        steps = np.zeros_like(self.rate_after)
        steps[1:] = (self.rate_after[1:] - self.rate_before[:-1]) / (0.5 * (h[1:] + h[:-1]))
        return steps

    def jerk(self, window: float, since: float = -math.inf) -> tuple[Array, Array]:
        """Return the largest mean magnitude of the jerk in a window that is ``window`` [s] of path time long.

        j(t) = (1/window) Σ |a_{k+1} − a_k|, where the sum is over the knots between t − window and t. a_k is the mean
        of the accelerations of the interpolant on both sides of knot k, plus the acceleration for the step in the rate
        at this knot; between knots, a is linear. j is the mean of |d³q/dt³| for a smooth path, 4 |a| f for an
        oscillation at f [Hz], whatever the window, and Δa/window for a single jump. Only windows that end after
        ``since`` [s] are included.

        Returns
        -------
        jerk : array, shape (N,)
            Maximum for each joint [rad/s³].
        time : array, shape (N,)
            End of the window with this value [s].
        """
        variation = np.zeros_like(self.position)
        first, last = self._accelerations
        with np.errstate(over="ignore", invalid="ignore"):
            at_knots = np.concatenate([first[:1], 0.5 * (last[:-1] + first[1:]) + self._steps[1:], last[-1:]])
            np.abs(at_knots[1:] - at_knots[:-1]).cumsum(axis=0, out=variation[1:])
        ends, within = self._within(variation, window, since)
        jerk, where = self._worst(ends, within)
        return jerk / window, where

    def shaking(self, window: float, since: float = -math.inf) -> tuple[Array, Array]:
        """Return the maximum change of velocity that is reversed within ``window`` [s] of path time.

        It is min(P, N) with P = ∫ max(q'', 0) dt and N = ∫ max(−q'', 0) dt over the window, including steps in the
        rate. It does not depend on a constant velocity of the joint. For a zigzag of d every h, it is d · window/h² if
        the window contains many teeth; for a spike of d within 2h (out in h, back in h) with held rates, it is 2d/h. A
        single move gains and loses its maximum speed once, which counts if the move is not longer than the window. Only
        windows that end after ``since`` [s] are included.

        Returns
        -------
        shaking : array, shape (N,)
            Maximum for each joint [rad/s].
        time : array, shape (N,)
            End of the window with this value [s].
        """
        h, count = np.diff(self.time)[:, None], self.position.shape[1]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            first, last = self._accelerations
            # q'' is linear in an interval; if it changes sign, the rate has an extreme inside the interval.
            turning = self.rate_after + 0.5 * h * first * (first / (first - last))
            turning = np.where(first * last < 0, turning, self.rate_before)
            # Sum of the gains before and after the extreme of the rate, and in the step at the end of the interval.
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
        """Acceleration of the interpolant at the start and the end of each interval [rad/s²], shape (T-1, N)."""
        h, _, _, b, a = self._cubics(slice(None))
        return 2 * b / h / h, (2 * b + 6 * a) / h / h

    def _within(self, total: Array, window: float, since: float) -> tuple[Array, Array]:
        """Return the end times of windows (M,) [s], and by how much ``total`` grows in each window (M, N).

        ``total`` is a running sum at the knots. Only windows that start or end at a knot are needed: in between, the
        growth is linear. A window that extends beyond the path does not have a larger growth.
        """
        ends = np.concatenate([self.time, self.time + window])
        ends = ends[(ends > since) & (ends <= self.end)]
        with np.errstate(over="ignore", invalid="ignore"):
            return ends, self._interpolated(total, ends) - self._interpolated(total, ends - window)

    def _interpolated(self, values: Array, times: Array) -> Array:
        """Interpolate values at the knots (T, N) linearly to other times (M, N); before the path, use the first."""
        left = np.maximum(np.searchsorted(self.time[:-1], times, side="right") - 1, 0)
        fraction = np.maximum((times - self.time[left]) / (self.time[left + 1] - self.time[left]), 0.0)[:, None]
        return values[left] + fraction * (values[left + 1] - values[left])

    def _worst(self, ends: Array, values: Array) -> tuple[Array, Array]:
        """Return the largest value for each joint, and the end time of the window in which it occurs."""
        worst = values.argmax(axis=0)
        return values[worst, np.arange(values.shape[1])], ends[worst]


class Extremes(NamedTuple):
    """Candidates for extreme values, and their path times; all arrays have the shape (candidates, T-1, N)."""

    position_time: Array
    position: Array
    velocity_time: Array
    velocity: Array
    acceleration_time: Array
    acceleration: Array


def path_of_record(record: Record, servo_map: ServoMap) -> Path:
    """Build the path from the record columns that the servos follow; it starts and ends at rest.

    Raises
    ------
    CheckRefused
        If a signal or column is missing, if the time does not increase or has gaps, if a value is not finite, or if the
        record is too short.
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
        raise CheckRefused(f"the record has {len(record)} samples; a motion needs at least two")
    known = np.isfinite(record.time)
    if not known.all():
        bad = int(np.flatnonzero(~known)[0])
        raise CheckRefused(f"the time of the record is {record.time[bad]} at sample {bad} of {len(record)}")
    with np.errstate(over="ignore"):
        steps = np.diff(record.time)
    later = np.isfinite(steps) & (steps > 0)
    if not later.all():
        bad = int(np.flatnonzero(~later)[0]) + 1
        raise CheckRefused(f"the time of the record does not increase at sample {bad} (t = {record.time[bad]:g} s)")
    if gaps := long_steps(record, GAP_FACTOR, 0.5):
        raise CheckRefused(
            f"the record has {len(gaps)} gap(s) in which the motion is unknown: {gaps[0]}; "
            "simulate with a uniform time step, or cut the record"
        )


def long_steps(record: Record, factor: float, share: float) -> list[str]:
    """Return a description of each time step that is longer than ``factor`` times the usual step.

    The usual step is the quantile ``share`` of all steps; a ``share`` of 0.5 is the median.
    """
    steps = np.diff(record.time)
    usual = float(np.quantile(steps, share, method="lower"))
    return [
        f"no sample between t = {record.time[k]:g} and {record.time[k + 1]:g} s, {steps[k] / usual:.3g} times the "
        f"usual step of {usual * 1e3:g} ms"
        for k in np.flatnonzero(steps > factor * usual)
    ]


def column_of(record: Record, signal: str, servo: MappedServo, unit: str) -> Array:
    """Return the column of ``signal`` that ``servo`` follows, shape (T,).

    Raises
    ------
    CheckRefused
        If the signal or column does not exist, has another unit, or contains a value that is not finite.
    """
    if signal not in record:
        follows = servo.kind.follows
        if signal == follows.velocity and follows.position in record:
            raise CheckRefused(
                f"{servo.entry}: the record has no velocities {signal!r}, only {', '.join(record)}; add velocities to "
                "positions with `dynsim import RECORD --map MAP --out FILE`"
            )
        raise CheckRefused(
            f"{servo.entry}: unknown signal {signal!r}; the record has {', '.join(record)}{suggest(signal, record)}"
        )
    labels = record.labels[signal]
    if servo.label not in labels:
        raise CheckRefused(
            f"{servo.entry}: unknown column {servo.label!r} of {signal!r}; "
            f"columns: {', '.join(labels)}{suggest(servo.label, labels)}"
        )
    if (own := record.unit_of(signal, servo.label)) != unit:
        raise CheckRefused(f"signal {signal!r} of {servo.label} has unit {own!r}; {servo.joint} requires {unit!r}")
    if record[signal].ndim != 2:
        raise CheckRefused(f"signal {signal!r} must have one column per joint, got shape {record[signal].shape}")
    if record.signals[signal].axis != TIME:
        raise CheckRefused(
            f"signal {signal!r} must use the time axis of the record, got {record.signals[signal].axis!r}"
        )
    data = np.asarray(record[signal][:, labels.index(servo.label)], dtype=np.float64)
    if not np.all(np.isfinite(data)):
        bad = int(np.flatnonzero(~np.isfinite(data))[0])
        raise CheckRefused(f"{servo.joint}: {signal!r} is {data[bad]} at t = {record.time[bad]:g} s")
    return data


def wheel_offsets(record: Record, servo_map: ServoMap) -> dict[str, Array]:
    """Return the angles [rad] that are added to joints to lift wheels, by joint name, each of shape (T,).

    The result is empty if the map has no ``lifts``.

    Raises
    ------
    CheckRefused
        If the record lifts wheels but the map has no ``lifts``, or if it lifts wheels that cannot be lifted.
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
            f"the record lifts wheel pairs ({names}) but the servo map has no 'lifts', so they would drag on the "
            "floor; add this entry to the map, for example:\n"
            "  lifts: {joints: [psi3, psi4, psi5, psi6, psi7, psi8], clearance_mm: 5, blend_s: 0.3}"
        )


def _at_rest_at_both_ends(path: Path, acceleration: float) -> Path:
    first, last = path.rate_after[0], path.rate_before[-1]
    still = np.zeros_like(first)
    duration, distance = ramp(last, acceleration)
    if duration > 0.0:
        path = path.longer(path.end + duration, path.position[-1] + distance, last, still)
    duration, distance = ramp(first, acceleration)
    if duration > 0.0:
        path = Path(
            np.append(-duration, path.time),
            np.vstack([path.position[0] - distance, path.position]),
            np.vstack([still, path.rate_after]),
            np.vstack([first, path.rate_before]),
        )
    return path
