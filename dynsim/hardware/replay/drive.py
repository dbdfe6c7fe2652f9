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
from typing import Protocol

import numpy as np

from dynsim.errors import CheckRefused
from dynsim.hardware.replay.check import ROUNDING, MotionLimits, plan_cycle
from dynsim.hardware.replay.incremental_path import IncrementalPath, Sample
from dynsim.hardware.replay.motion import Array, GoalCourse, MotionTask, Needs
from dynsim.hardware.replay.rules import Cause, Fault
from dynsim.hardware.replay.states import Stopped
from dynsim.hardware.replay.trajectory import HOLE, Path
from dynsim.hardware.replay.verify import needs_of_map
from dynsim.hardware.servo_map import ServoMap
from dynsim.record.scene import Scene

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

        By more where its postures are held back (:mod:`dynsim.hardware.replay.lift_lookahead`).
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
