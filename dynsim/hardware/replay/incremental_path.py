"""A servo path that grows knot by knot; each knot must keep the motion limits before it is sent to servos.

Limits and their function (``MotionLimits.margins``) are those of the offline check of a record. There every interval is
checked; here only the newest one, and the time windows of jerk and shaking that end after the knot before it. The check
is skipped where simple bounds show that no limit is exceeded. Old knots are dropped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.hardware.replay.check import MotionLimits
from dynsim.hardware.replay.motion import Array
from dynsim.hardware.replay.trajectory import SHAKING_WINDOW, Path
from dynsim.hardware.servo_map import ServoMap


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
