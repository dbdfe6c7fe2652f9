"""Live drive of servos: postures of a running simulation are checked and followed as they arrive.

The servos stay behind the simulation by at least half of ``safety.stop_time``. So enough of the path ahead of the last
goal is known and checked that the servos can stop along it within that time. With b the length of known path ahead [s],
T the stop time and h the period, a cycle advances by s h along the path, where s is the largest speed with

    s² T/2 ≤ b − s h,     s ≤ 1,     s ≤ s_before + h/T

So a simulation that is late slows the robot down along its path, to rest where the path ends; the robot speeds up again
at the same rate. Lost time is not made up for: the simulation waits for the servos (:meth:`Feed.tell`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from dynsim.errors import CheckRefused
from dynsim.hardware.replay.check import ROUNDING, MotionLimits, plan_cycle
from dynsim.hardware.replay.output import Stopped
from dynsim.hardware.replay.rules import Cause, Fault
from dynsim.hardware.replay.trajectory import HOLE, SHAKING_WINDOW, Array, GoalCourse, MotionTask, Needs, Path
from dynsim.hardware.replay.verify import needs_of_map
from dynsim.hardware.servo_map import ServoMap
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

# A servo path that grows knot by knot; each knot must keep the motion limits before it is sent to servos.


class Sample(NamedTuple):
    """One sample of the motion: time [s], joint angles [rad] and rates [rad/s], (N,), in the order of the servo map.

    ``lift`` and ``lift_rate`` are added to them where a snake lifts wheel pairs, as in
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


class IncrementalPath:
    """Knots of a path as they come, as far back as goals and limits need them.

    Parameters
    ----------
    first : Sample
        Where it rests.
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
        """Joint angles [rad] and rates [rad/s] at a time [s]."""
        return self._path.at(time)

    def append(self, sample: Sample, *, keep: float) -> list[str]:
        """One more knot, unless it breaks limits; which ones, in words. Of jerk and shaking as if the path ended there.

        What is before ``keep`` [s], and before the windows of the limits, is dropped.
        """
        path, last = self._path, self._last
        with np.errstate(all="ignore"):  # what is no number holds no bound
            h = sample.time - last.time
            held_rate = (sample.position - last.position) / h
            # Before the first posture nothing is known: there the rate of the lift is that of the first interval.
            lift_rate = (sample.lift - last.lift) / h if len(path.time) == 1 else last.lift_rate
            after = np.where(self._held, held_rate, last.velocity) + lift_rate
            before = np.where(self._held, held_rate, sample.velocity) + sample.lift_rate
            longer = path.since(min(keep, path.end - SHAKING_WINDOW), 2).longer(
                sample.time, sample.posture, after, before
            )
            # Windows are looked at that end after the last knot. Knots before these have a part in their acceleration.
            windows = longer.since(path.end - SHAKING_WINDOW, 2)
            # A pilot's robot is well within its limits most of the time, and a cycle is short.
            sure = self._limits.surely_hold(windows)
            margins = [] if sure else self._limits.margins(windows, since=path.end, broken=True)
            broken = [str(margin) for margin in margins]
        if not broken:
            self._path, self._last = longer, sample
        return broken


SLACK = 0.1
"""Largest lead of the simulation over the servos, beyond the path that a stop takes [s]."""
SILENCE = 5.0
"""Time without a posture after which the drive ends [s]; the robot is at rest for most of it."""
MOST_BROKEN = 4
"""Largest number of violations that a fault names."""
REST = 1e-9
"""A path whose end is closer than this [s] is finished."""


class Feed(Protocol):
    """Source of the postures. Its methods do not wait, write files, or raise.

    Attributes
    ----------
    over : bool
        The drive has ended as it should, and all its samples have been taken.
    fault : str
        Why no more postures will come although the drive has not ended; empty without a fault.
    """

    @property
    def over(self) -> bool: ...

    @property
    def fault(self) -> str: ...

    def take(self, most: int) -> Sequence[Sample]:
        """Samples that have come since, the oldest first."""
        ...

    def tell(self, time: float) -> None:
        """The servos are at this time of the simulation [s]; it may go on to :func:`lead` beyond.

        By more where its postures are held back (:mod:`dynsim.hardware.replay.drive`).
        """
        ...


def lead(servo_map: ServoMap) -> float:
    """By how much the simulation may be ahead of the servos [s]."""
    return 0.5 * servo_map.safety.stop_time + SLACK


@dataclass(frozen=True, kw_only=True)
class DrivenMotion(MotionTask):
    """What a pilot will ask for. Of the simulation that it follows nothing is known yet but its beginning.

    Attributes
    ----------
    servo_map : ServoMap
    feed : Feed
    first : Sample
        Where it begins.
    step : float
        Between two samples [s].
    longest : float
        Drive [s].
    """

    servo_map: ServoMap
    feed: Feed
    first: Sample
    step: float
    longest: float

    @property
    def start(self) -> Array:
        """Posture in which it begins [rad], shape (N,)."""
        return self.first.posture

    @property
    def duration(self) -> float:
        """Longest drive [s]."""
        return self.longest

    def needs(self) -> list[Needs]:
        """Where it will go is not known: all that the map allows."""
        return [needs_of_map(servo) for servo in self.servo_map.servos]

    def course(self) -> GoalCourse:
        """Along what comes."""
        return DrivenCourse(self)


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
    """What can be known before a drive: its start is within the limits and at rest, and the bus carries the rate.

    Raises
    ------
    CheckRefused
    """
    plan = plan_cycle(servo_map, rate if rate is not None else servo_map.bus.rate)
    still = np.zeros((1, len(first.position)))
    start = Path(np.array([0.0, step]), np.stack([first.posture, first.posture]), still, still)
    broken = list(MotionLimits(servo_map).margins(start, broken=True))
    if broken:
        lines = "\n".join(f"  {margin}" for margin in broken)
        raise CheckRefused(f"the drive would begin beyond {len(broken)} limit(s), nothing was sent:\n{lines}")
    moving = np.flatnonzero(~(np.abs(first.velocity) <= ROUNDING))
    if len(moving):
        names = ", ".join(servo_map.joints[k] for k in moving)
        raise CheckRefused(
            f"the simulation begins in motion ({names}); servos begin at rest: let its rates begin at zero"
        )
    return DrivenMotion(servo_map=servo_map, feed=feed, first=first, step=step, longest=longest, plan=plan, scene=scene)


class DrivenCourse:
    """Along the samples of a feed, each checked when it comes, which is before any goal of its stretch is sent.

    The limits are those of the offline check. A sample beyond one is never followed, nor brought back to the limit:
    :class:`Stopped` ends the drive, and the fault policy has the way to a stop that has been checked.
    """

    def __init__(self, motion: DrivenMotion) -> None:
        self.time, self.speed = 0.0, 0.0
        self._motion, self._feed = motion, motion.feed
        self._stop_time = motion.servo_map.safety.stop_time
        self._path = IncrementalPath(motion.first, motion.servo_map)
        self._silent = 0.0

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self._path.end

    @property
    def over(self) -> bool:
        return self._feed.over and self.end - self.time < REST

    @property
    def fraction(self) -> float:
        return min(1.0, self.time / self._motion.duration)

    def at(self, time: float) -> tuple[Array, Array]:
        return self._path.at(time)

    def braking_time(self, stop_time: float) -> float:
        # At less than full speed a stop in this time may be longer than what is known of the path.
        ahead = self.end - self.time
        return stop_time if 0.5 * self.speed * stop_time <= ahead else 2.0 * ahead / self.speed

    def advance(self, period: float) -> tuple[Array, Array]:
        self._take(period)
        stop_time, ahead = self._stop_time, self.end - self.time
        most = (math.sqrt(period * period + 2.0 * stop_time * ahead) - period) / stop_time
        self.speed = min(1.0, most, self.speed + period / stop_time)
        self.time = min(self.end, self.time + self.speed * period)
        self._feed.tell(self.time)
        position, rate = self._path.at(self.time)
        return position, self.speed * rate

    def _take(self, period: float) -> None:
        """Samples that have come; never so many at once that the cycle would be late for it."""
        samples = self._feed.take(math.ceil(period / self._motion.step) + 1)
        self._silent = 0.0 if samples else self._silent + period
        for sample in samples:
            step = sample.time - self._path.end
            if not 0.0 < step <= HOLE * self._motion.step:
                text = f"its time goes from {self._path.end:g} to {sample.time:g} s in steps of {self._motion.step:g} s"
                raise Stopped(Fault(Cause.SIMULATION, text))
            if broken := self._path.append(sample, keep=self.time):
                text = "; ".join(broken[:MOST_BROKEN])
                more = f"; and {len(broken) - MOST_BROKEN} more" if len(broken) > MOST_BROKEN else ""
                raise Stopped(Fault(Cause.LIMIT, f"the pilot's robot goes beyond what the map allows: {text}{more}"))
        if self._feed.fault:
            raise Stopped(Fault(Cause.SIMULATION, self._feed.fault))
        if self._silent > SILENCE and not self._feed.over:
            raise Stopped(Fault(Cause.SIMULATION, f"no posture came for {SILENCE:g} s"))


# Lifted wheel pairs in a live drive: postures are held back until the joint angles that lifting adds are known.


@dataclass
class _Held:
    """A posture without the angles that lifting adds, kept until these are known.

    Attributes
    ----------
    sample : Sample
    yaw : shape (pairs - 1,) [rad]
    up, down : when each pair is lifted and put down [s], shape (pairs,): infinite where it always was, or is for all
        that is known; ``up`` is NaN for a pair on the ground
    """

    sample: Sample
    yaw: Array
    up: Array
    down: Array


class LiftLookahead:
    """Postures of a simulation from its start on, and as :class:`Sample` with what lifting adds.

    Parameters
    ----------
    still : Record
        Of the robot at its start, with its scene.
    servo_map : ServoMap
        With an entry ``lifts``.
    step : float
        Between two postures [s].

    Raises
    ------
    CheckRefused
        The map's entry does not fit the robot.
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
        self._held: list[_Held] = []
        # The last two that were folded: the rate of the last one is not known yet.
        self._folded: list[Sample] = []
        self._changed = -np.inf

    @property
    def yaw(self) -> tuple[str, list[int]]:
        """Signal with the yaw angles of the base part, and their columns."""
        return self._part.signal, self._columns

    def steady(self, time: float) -> bool:
        """Pairs may be lifted and put down at a time [s]: what was lifted last has had the time for both."""
        blend = self._lifts.blend_s
        return time >= blend - TIME_ROUNDING and time - self._changed >= 2.0 * blend - TIME_ROUNDING

    def begin(self, sample: Sample, yaw: Array, grounded: Array) -> Sample:
        """The posture in which the simulation rests, with what lifting adds.

        Parameters
        ----------
        yaw : (pairs - 1,) [rad]
        grounded : (pairs,) 1 where a pair is on the ground

        Raises
        ------
        CheckRefused
            A pair is lifted that cannot be.
        """
        refuse_what_cannot_stand(grounded[None], self._pairs, np.array([sample.time]))
        self._grounded = grounded.copy()
        self._up, self._down = np.where(grounded == 0, -np.inf, np.nan), np.full(len(grounded), np.inf)
        self._hold(sample, yaw)
        first = self._fold(self._held[0])
        self._folded = [first]
        return first

    def add(self, sample: Sample, yaw: Array, grounded: Array) -> list[Sample]:
        """One more posture; those that are whole now, the oldest first, without the one of :meth:`begin`.

        Parameters
        ----------
        grounded : (pairs,) 1 where a pair was on the ground since the posture before

        Raises
        ------
        CheckRefused
            A pair is lifted that cannot be, or not for so short a time.
        """
        since = self._held[-1]
        time = since.sample.time
        if (grounded != self._grounded).any():
            self._change(since, grounded)
        self._hold(sample, yaw)
        return self._whole(time - self._lifts.blend_s + TIME_ROUNDING)

    def remaining(self) -> list[Sample]:
        """All that are still held back: there are no more. What is lifted stays so."""
        return [*self._whole(np.inf), *self._last()]

    def _hold(self, sample: Sample, yaw: Array) -> None:
        copy = Sample(sample.time, sample.position.copy(), sample.velocity.copy())
        self._held.append(_Held(copy, yaw.copy(), self._up.copy(), self._down.copy()))

    def _change(self, since: _Held, grounded: Array) -> None:
        """Other pairs are on the ground since a posture."""
        time = since.sample.time
        refuse_what_cannot_stand(grounded[None], self._pairs, np.array([time]))
        for pair in np.flatnonzero((grounded == 1) & (self._grounded == 0)):
            up = float(self._up[pair])
            always = not np.isfinite(up)
            refuse_short_lift(self._lifts, self._pairs[pair], max(up, 0.0), time, 1 if always else 2)
            for entry in self._held:
                if entry.up[pair] == up:
                    entry.down[pair] = time
        self._up = np.where(grounded == 1, np.nan, np.where(self._grounded == 1, time, self._up))
        self._grounded, self._changed = grounded.copy(), time
        since.up = self._up.copy()

    def _whole(self, until: float) -> list[Sample]:
        """What is known up to a time [s], folded; each leaves when the one after it is."""
        samples: list[Sample] = []
        # The first of those held is the last one folded.
        while len(self._held) > 1 and self._held[1].sample.time <= until:
            del self._held[0]
            self._folded.append(self._fold(self._held[0]))
            if len(self._folded) == 3:
                samples.append(self._with_rate(1))
                del self._folded[0]
        return samples

    def _last(self) -> list[Sample]:
        if len(self._folded) < 2:
            return []
        return [self._with_rate(len(self._folded) - 1)]

    def _fold(self, entry: _Held) -> Sample:
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
