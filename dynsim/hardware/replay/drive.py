"""Live drive of servos: check and follow the postures of a running simulation as they arrive.

The servos lag the simulation by at least half of ``safety.stop_time``, so that enough of the path ahead of the last
goal is known and checked for a stop along the path within that time. With b the length of known path ahead [s], T the
stop time and h the period, a cycle advances by s h along the path, where s is the largest speed with

    s² T/2 ≤ b − s h,     s ≤ 1,     s ≤ s_before + h/T

If the simulation is late, the robot slows down along its path and stops at the end of the path; it speeds up again at
the same rate. Lost time is not made up: the simulation waits for the servos (:meth:`Feed.report_time`).

If a snake robot lifts wheel pairs, postures are delayed until the joint angles of the lifting are known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from dynsim.errors import CheckRefused
from dynsim.hardware.replay.check import ROUNDING, CheckedMotion, MotionLimits, plan_cycle
from dynsim.hardware.replay.output import Stopped
from dynsim.hardware.replay.rules import Cause, Fault
from dynsim.hardware.replay.trajectory import GAP_FACTOR, SHAKING_WINDOW, Array, CyclePlan, GoalCourse, Needs, Path
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

# A path that grows knot by knot; each knot is checked against the motion limits before it is sent to the servos.


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
