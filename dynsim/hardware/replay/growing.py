"""A path that comes knot by knot, each held against the limits of its joints before anything goes there.

The limits are those of the offline check, and so is the function,
:func:`~dynsim.hardware.replay.check.motion_margins`. It takes a tenth of a cycle and more, so it is asked only where
simple bounds do not say that all is well: the control points of a cubic for angle and rate, and for what windows gather
the sums over all intervals that they touch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.hardware.replay.check import ROUNDING, motion_margins, position_bounds, velocity_limit
from dynsim.hardware.replay.motion import Array
from dynsim.hardware.replay.trajectory import JERK_WINDOW, SHAKING_WINDOW, Path
from dynsim.hardware.servo_map import ServoMap

KNOTS = 1024


class Sample(NamedTuple):
    """One posture: time [s], joint angles [rad] and rates [rad/s], shape (N,), in the order of the map.

    ``lift`` and ``lift_rate`` are what lifting wheel pairs adds to them, as in
    :func:`~dynsim.hardware.replay.trajectory.path_of_record`.
    """

    time: float
    position: Array
    velocity: Array
    lift: Array | float = 0.0
    lift_rate: Array | float = 0.0

    @property
    def posture(self) -> Array:
        """Where the joints are to be [rad], shape (N,)."""
        return self.position + self.lift


class Interval(NamedTuple):
    """Between two knots.

    Attributes
    ----------
    length : [s]
    after, before : rates at its beginning and its end [rad/s]
    first, last : accelerations there [rad/s²]
    step : acceleration for the step in rate at its beginning [rad/s²]
    knot : acceleration that the check of jerk sees at its beginning [rad/s²]
    """

    length: float
    after: Array
    before: Array
    first: Array
    last: Array
    step: Array
    knot: Array


class GrowingPath:
    """Knots of a path as they come, as far back as goals and limits need them.

    Parameters
    ----------
    first : Sample
        Where it rests.
    servo_map : ServoMap
    """

    def __init__(self, first: Sample, servo_map: ServoMap) -> None:
        servos, count = servo_map.servos, len(first.position)
        self._map = servo_map
        self._held = np.array([servo.kind.follows.rates == "held" for servo in servos])
        self._time, self._position = np.zeros(KNOTS), np.zeros((KNOTS, count))
        # Of the interval that ends at a knot.
        self._after, self._before = np.zeros((KNOTS, count)), np.zeros((KNOTS, count))
        self._time[0], self._position[0], self._count = first.time, first.posture, 1
        # Of acceleration, of velocity that is gained and that is lost, summed up to every knot.
        self._varied, self._gained, self._lost = (np.zeros((KNOTS, count)) for _ in range(3))
        self._last = first
        self._interval_before: Interval | None = None
        limits = [servo.kind.limits for servo in servos]
        bounds = np.array([position_bounds(s) if s.in_position_mode else s.position_limits for s in servos])
        self._low, self._high = bounds[:, 0] - ROUNDING, bounds[:, 1] + ROUNDING
        self._velocity = np.array([velocity_limit(servo) for servo in servos]) + ROUNDING
        self._acceleration = np.array([one.acceleration for one in limits]) + ROUNDING
        self._jerk = np.array([one.jerk for one in limits]) + ROUNDING
        self._shaking = np.array([one.shaking for one in limits]) + ROUNDING

    @property
    def end(self) -> float:
        """Time of the last knot [s]."""
        return float(self._time[self._count - 1])

    def at(self, time: float) -> tuple[Array, Array]:
        """Joint angles [rad] and rates [rad/s] at a time [s]."""
        return self._since(time, 1).at(time)

    def append(self, sample: Sample, *, keep: float) -> list[str]:
        """One more knot, unless it breaks limits; which ones, in words.

        What is before ``keep`` [s], and before the windows of the limits, may be dropped.
        """
        if self._count == len(self._time):
            self._make_room(min(keep, self.end - SHAKING_WINDOW))
        k = self._count
        self._time[k], self._position[k] = sample.time, sample.posture
        with np.errstate(all="ignore"):  # what is no number holds no bound
            interval = self._interval(sample)
            self._after[k], self._before[k] = interval.after, interval.before
            surely = self._add_up(interval)
        self._count += 1
        if not surely and (broken := self._broken()):
            self._count -= 1
            return broken
        self._interval_before, self._last = interval, sample
        return []

    def _interval(self, sample: Sample) -> Interval:
        """That ends at the sample."""
        k, held, last_one, before = self._count, self._held, self._last, self._interval_before
        h = sample.time - last_one.time
        straight, held_rate = (self._position[k] - self._position[k - 1]) / h, (sample.position - last_one.position) / h
        # Before the first posture nothing is known: there the rate of the lift is that of the first interval.
        lift_rate = (sample.lift - last_one.lift) / h if before is None else last_one.lift_rate
        left = np.where(held, held_rate, last_one.velocity) + lift_rate
        right = np.where(held, held_rate, sample.velocity) + sample.lift_rate
        first, last = (6.0 * straight - 4.0 * left - 2.0 * right) / h, (-6.0 * straight + 2.0 * left + 4.0 * right) / h
        if before is None:
            return Interval(h, left, right, first, last, np.zeros_like(first), first)
        step = (left - before.before) / (0.5 * (h + before.length))
        return Interval(h, left, right, first, last, step, 0.5 * (before.last + first) + step)

    def _add_up(self, interval: Interval) -> bool:
        """Running sums at the new knot; whether it is sure by them that no limit is broken."""
        k, before = self._count, self._interval_before
        h, left, right, first, last, step, knot = interval
        # Of jerk: final up to the knot before, as the next interval has its part in that of this one.
        change = 0.0 if before is None else np.abs(knot - before.knot)
        self._varied[k - 1] = self._varied[max(0, k - 2)] + change
        jump = 0.0 if before is None else left - before.before
        for sums, sign in ((self._gained, 1.0), (self._lost, -1.0)):
            within = np.maximum(sign * first, 0.0) + np.maximum(sign * last, 0.0)
            sums[k] = sums[k - 1] + np.maximum(sign * jump, 0.0) + 0.5 * h * within
        position, position_before = self._position[k], self._position[k - 1]
        out, back = position_before + h / 3.0 * left, position - h / 3.0 * right
        low, high = np.minimum(np.minimum(out, back), position), np.maximum(np.maximum(out, back), position)
        fastest = np.maximum(np.abs(left), np.abs(right))
        fastest = np.maximum(fastest, np.abs(3.0 * (position - position_before) / h - left - right))
        hardest = np.maximum(np.maximum(np.abs(first), np.abs(last)), np.abs(step))
        ends = self._time[k - 1]
        jerk_from, shaking_from = self._knot_before(ends - JERK_WINDOW), self._knot_before(ends - SHAKING_WINDOW)
        varied = self._varied[k - 1] + np.abs(last - knot) - self._varied[jerk_from]
        shaken = np.minimum(self._gained[k] - self._gained[shaking_from], self._lost[k] - self._lost[shaking_from])
        return bool(
            np.all(
                (low >= self._low)
                & (high <= self._high)
                & (fastest <= self._velocity)
                & (hardest <= self._acceleration)
                & (varied <= self._jerk * JERK_WINDOW)
                & (shaken <= self._shaking)
            )
        )

    def _knot_before(self, time: float) -> int:
        return max(0, int(np.searchsorted(self._time[: self._count], time, side="right")) - 1)

    def _broken(self) -> list[str]:
        """Limits that the last interval breaks, in words; jerk and shaking as if the path ended with it."""
        # Windows that this piece of the path would cut short end before ``since``.
        windows, since = self._since(self.end - SHAKING_WINDOW, 2), float(self._time[self._count - 2])
        return [str(one) for one in motion_margins(windows, self._map, 1.0, since) if not one.holds]

    def _since(self, time: float, more: int) -> Path:
        """From the knot at or before a time on [s], and ``more`` before that."""
        return self._path(max(0, self._knot_before(time) - more))

    def _path(self, first: int) -> Path:
        knots, intervals = slice(first, self._count), slice(first + 1, self._count)
        return Path(self._time[knots], self._position[knots], self._after[intervals], self._before[intervals], self.end)

    def _make_room(self, oldest: float) -> None:
        """Drop knots from before a time [s], but for some; where that gives no room, take more."""
        arrays = self._arrays()
        first = max(0, int(np.searchsorted(self._time, oldest)) - 4)
        size = len(self._time) if 2 * first > len(self._time) else 2 * len(self._time)
        fresh = [np.zeros((size, *array.shape[1:])) for array in arrays]
        self._count -= first
        for new, old in zip(fresh, arrays, strict=True):
            new[: self._count] = old[first:]
        self._time, self._position, self._after, self._before, self._varied, self._gained, self._lost = fresh

    def _arrays(self) -> tuple[Array, ...]:
        return self._time, self._position, self._after, self._before, self._varied, self._gained, self._lost
