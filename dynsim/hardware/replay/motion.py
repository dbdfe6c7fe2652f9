"""Motions for servos: postures as functions of time, advance of the loop along them, and demands on the servos."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dynsim.record import Record
    from dynsim.record.scene import Scene

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

        May raise :class:`~dynsim.hardware.replay.states.Stopped`.
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
