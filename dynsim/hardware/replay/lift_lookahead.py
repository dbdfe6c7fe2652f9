"""Lifted wheel pairs in a live drive: postures are held back until the joint angles that lifting adds are known.

A lifted pair comes down over the time ``lifts.blend_s`` (:mod:`dynsim.snake.lifting`), so its height at t depends on
when it is put down only if that is before t + blend_s. The posture of t is complete once it is known which pairs are on
the ground until then. The rates of these angles are central differences, so they need the angles of the next posture
too. The results equal those of a replay of the finished record, which uses the same functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynsim.hardware.replay.incremental_path import Sample
from dynsim.hardware.replay.motion import Array
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record
from dynsim.snake.base_part import base_part
from dynsim.snake.lifting import (
    TIME_ROUNDING,
    fold_to_heights,
    height_of,
    refuse_long_steps,
    refuse_other_joints,
    refuse_short_lift,
    refuse_what_cannot_stand,
)


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
