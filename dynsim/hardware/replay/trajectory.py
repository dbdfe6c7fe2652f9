"""A record as a path for the servos: continuous in time, with rest at both ends.

Between the samples of a record joint angles are the cubic Hermite interpolant of (q, v), or straight where the record's
rates are held from sample to sample (a sampled controller). Where the record begins or ends in motion, a stretch of
constant acceleration is added (a parabola, which the same interpolant represents exactly), so that the robot starts and
ends at rest without a jump in velocity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.errors import CheckRefused
from dynsim.hardware.replay.lifting import wheel_offsets
from dynsim.hardware.servo_map import Servo, ServoMap
from dynsim.record import TIME, Record

REST = 1e-6
"""Joint speed [rad/s] below which a record counts as at rest."""


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
    record_end : float
        Time of the last sample of the record [s], counted from its first.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    rate_after: NDArray[np.float64]
    rate_before: NDArray[np.float64]
    record_end: float

    @property
    def start(self) -> float:
        return float(self.time[0])

    @property
    def end(self) -> float:
        return float(self.time[-1])

    def at(self, time: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position [rad] and velocity [rad/s], shape (N,), at a path time [s]; at rest outside of the path."""
        if time <= self.time[0]:
            return self.position[0].copy(), np.zeros(self.position.shape[1])
        if time >= self.time[-1]:
            return self.position[-1].copy(), np.zeros(self.position.shape[1])
        left = int(np.searchsorted(self.time, time, side="right")) - 1
        h = self.time[left + 1] - self.time[left]
        s = (time - self.time[left]) / h
        q0, q1 = self.position[left], self.position[left + 1]
        m0, m1 = h * self.rate_after[left], h * self.rate_before[left]
        a, b = 2 * q0 - 2 * q1 + m0 + m1, -3 * q0 + 3 * q1 - 2 * m0 - m1
        return q0 + s * (m0 + s * (b + s * a)), (m0 + s * (2 * b + 3 * s * a)) / h

    def extremes(self) -> Extremes:
        """Every interval's extreme positions and velocities, between the knots too."""
        h = np.diff(self.time)[:, None]
        q0, q1 = self.position[:-1], self.position[1:]
        m0, m1 = h * self.rate_after, h * self.rate_before
        a, b = 2 * q0 - 2 * q1 + m0 + m1, -3 * q0 + 3 * q1 - 2 * m0 - m1  # (T-1, N)
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
        left = self.time[:-1, None]
        return Extremes(left + h * at_position, position, left + h * at_velocity, velocity)


@dataclass(frozen=True)
class Extremes:
    """Candidates for extreme values, each with its path time; all of shape (candidates, T-1, N)."""

    position_time: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity_time: NDArray[np.float64]
    velocity: NDArray[np.float64]


def path_of_record(record: Record, servo_map: ServoMap) -> Path:
    """Collect the columns the servos follow and bring both ends to rest.

    Raises
    ------
    CheckRefused
        A signal or column is missing, time does not increase, a value is not finite, or the record is too short.
    """
    if len(record) < 2:
        raise CheckRefused(f"the record has {len(record)} samples; a motion needs two")
    with np.errstate(invalid="ignore"):
        steps = np.diff(record.time)
    later = np.isfinite(steps) & (steps > 0)
    if not later.all():
        bad = int(np.flatnonzero(~later)[0]) + 1
        raise CheckRefused(f"the record's time does not increase at sample {bad} (t = {record.time[bad]:g} s)")
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
    return _at_rest_at_both_ends(
        Path(time, position, rate_after, rate_before, float(time[-1])), servo_map.safety.run_up
    )


def column_of(record: Record, signal: str, servo: Servo, unit: str) -> NDArray[np.float64]:
    """The column of ``signal`` that ``servo`` follows, shape (T,).

    Raises
    ------
    CheckRefused
        No such signal or column, another unit, or a value that is not finite.
    """
    if signal not in record:
        raise CheckRefused(f"{servo.joint} follows the signal {signal!r}; the record has {', '.join(record)}")
    labels = record.labels[signal]
    if servo.label not in labels:
        raise CheckRefused(f"{servo.joint} follows column {servo.label!r} of {signal!r}; it has {', '.join(labels)}")
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


def _at_rest_at_both_ends(path: Path, acceleration: float) -> Path:
    time, position, rate_after, rate_before = path.time, path.position, path.rate_after, path.rate_before
    first, last = rate_after[:1], rate_before[-1:]
    rest = np.zeros_like(first)
    if (fastest := np.abs(first).max()) > REST:
        duration = fastest / acceleration
        time = np.concatenate([[-duration], time])
        position = np.concatenate([position[:1] - 0.5 * duration * first, position])
        rate_after, rate_before = np.concatenate([rest, rate_after]), np.concatenate([first, rate_before])
    if (fastest := np.abs(last).max()) > REST:
        duration = fastest / acceleration
        time = np.concatenate([time, [path.record_end + duration]])
        position = np.concatenate([position, position[-1:] + 0.5 * duration * last])
        rate_after, rate_before = np.concatenate([rate_after, last]), np.concatenate([rate_before, rest])
    return Path(time, position, rate_after, rate_before, path.record_end)
