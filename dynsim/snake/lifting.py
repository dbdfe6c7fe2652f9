"""Lifted wheel pairs of a record as angles of the pitch joints on their axles.

The record has each pair on the ground or off it, 1 or 0; a lift takes time. The height of a pair follows

    eta(t) = clearance s((t - t_up)/blend) s((t_down - t)/blend),   s(u) = 10 u^3 - 15 u^4 + 6 u^5

from the first sample t_up at which it is lifted; it is zero again at t_down, the first at which it is grounded. So a
pair is in the air only while the record has it off the ground. Pitch angles are computed from the heights and the yaw
angles of every sample (:mod:`dynsim.snake.base_part`), before anything moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dynsim.config.base import Positive, StrictConfig
from dynsim.errors import CheckRefused
from dynsim.record import TIME, Record
from dynsim.snake.base_part import BasePart, Fold, base_part

Array = NDArray[np.float64]
SAMPLES_PER_BLEND = 20
"""Fewer of them, and the path between two samples is no longer at the heights of the samples."""
TIME_ROUNDING = 1e-9
"""By so much less a time may be than it must [s]."""


class Lifts(StrictConfig):
    """How wheel pairs that the record lifts are lifted.

    Every pair but the last has a pitch joint on its axle. Lifting is added to what these do otherwise; the first, on
    the axle that carries the head, follows the record and keeps the head where it is.
    """

    signal: str = Field(
        "grounded", description="of the record, with 1 where a wheel pair is on the ground, 0 where it is lifted"
    )
    joints: tuple[str, ...] = Field(min_length=1, description="pitch joints on the axles of the first, second, … pair")
    clearance_mm: Positive = Field(5.0, description="height of the lower wheel of a lifted pair above the floor")
    blend_s: Positive = Field(0.3, description="time to lift a pair, and to put it down, in record time")
    tilt_mm: Positive = Field(
        2.5, description="a record is refused where one wheel of a grounded pair would be higher: a bent base twists"
    )


def lifted(record: Record, lifts: Lifts) -> Fold:
    """How the base part of a record is folded at every sample.

    Raises
    ------
    CheckRefused
        No such signal, or it lifts pairs that cannot be lifted, or not for so short a time; with pair and time.
    """
    grounded = grounded_pairs(record, lifts.signal)
    pairs = record.labels[lifts.signal]
    refuse_other_joints(lifts, pairs)
    time = record.time - record.time[0]
    refuse_what_cannot_stand(grounded, pairs, time)
    height = np.column_stack(
        [_height(column, time, lifts, name) for column, name in zip(grounded.T, pairs, strict=True)]
    )
    if not height.any():
        return Fold(np.zeros_like(height[:, 1:]), height, np.zeros_like(height))
    refuse_long_steps(lifts, float(np.diff(time).max()))
    part = base_part(record, pairs)
    return fold_to_heights(part, part.yaw_angles(record), height, lifts, time)


def fold_to_heights(part: BasePart, yaw: Array, height: Array, lifts: Lifts, time: Array) -> Fold:
    """The base part with its pairs at heights above the floor.

    Parameters
    ----------
    yaw : (T, pairs - 1) [rad]
    height : (T, pairs) [m]
    time : (T,) [s], for what is refused

    Raises
    ------
    CheckRefused
        No pitch angles do that, or a pair would stand on one wheel; with pair and time.
    """
    try:
        fold = part.fold(yaw, height)
    except ArithmeticError as lost:
        row, pair = lost.args
        raise CheckRefused(
            f"no pitch angle brings {part.pairs[pair]} to {1e3 * height[row, pair]:g} mm above the floor at "
            f"t = {time[row]:.3f} s"
        ) from None
    _refuse_twist(np.where(height == 0.0, fold.tilt, 0.0), lifts, part.pairs, time)
    return fold


def refuse_other_joints(lifts: Lifts, pairs: tuple[str, ...]) -> None:
    """CheckRefused unless every pair but the last has its pitch joint."""
    if len(lifts.joints) != len(pairs) - 1:
        raise CheckRefused(
            f"lifts.joints names {len(lifts.joints)} pitch joints; the record has {len(pairs)} wheel pairs, with one "
            "on the axle of each but the last"
        )


def refuse_long_steps(lifts: Lifts, step: float) -> None:
    """CheckRefused where samples are too far apart [s] for the path between them."""
    if step * SAMPLES_PER_BLEND > lifts.blend_s:
        raise CheckRefused(
            f"wheels are lifted in blend_s = {lifts.blend_s:g} s, and the record has a sample every {step:g} s: record "
            f"at {SAMPLES_PER_BLEND / lifts.blend_s:.0f} Hz or more, or lift them slower"
        )


def grounded_pairs(record: Record, name: str) -> Array:
    """1 where a pair is on the ground, shape (T, pairs)."""
    if name not in record:
        raise CheckRefused(f"lifts.signal: the record has no {name!r}; it has {', '.join(record)}")
    data = np.asarray(record[name])
    if data.ndim != 2 or record.signals[name].axis != TIME or not np.isin(data, (0, 1)).all():
        raise CheckRefused(f"signal {name!r} must be 0 or 1 for each wheel pair, at the times of the record")
    return data.astype(np.float64)


def refuse_what_cannot_stand(grounded: Array, pairs: tuple[str, ...], time: Array) -> None:
    """CheckRefused where pair 1 is lifted, or all others are; ``grounded`` has the shape (T, pairs)."""
    if not (grounded[:, 0] == 1).all():
        row = int(np.argmin(grounded[:, 0]))
        raise CheckRefused(
            f"{pairs[0]} is lifted at t = {time[row]:.3f} s: it carries the raised head, which would move with it"
        )
    standing = grounded.sum(axis=1)
    if standing.min() < 2:
        row = int(np.argmin(standing))
        raise CheckRefused(f"only {pairs[0]} is on the ground at t = {time[row]:.3f} s: the robot does not stand on it")


def _height(grounded: Array, time: Array, lifts: Lifts, name: str) -> Array:
    """Height of one pair over time, shape (T,) [m]."""
    height = np.zeros_like(time)
    edges = np.flatnonzero(np.diff(grounded, prepend=1.0, append=1.0))
    for first, end in edges.reshape(-1, 2):
        up, down = time[first], time[min(end, len(time) - 1)]
        # What is lifted from the beginning is lifted in the start posture, what is at the end stays so.
        blends = int(first > 0) + int(end < len(time))
        refuse_short_lift(lifts, name, up, down, blends)
        height[first:end] = height_of(
            time[first:end], up if first > 0 else -np.inf, down if end < len(time) else np.inf, lifts
        )
    return height


def refuse_short_lift(lifts: Lifts, name: str, up: float, down: float, blends: int) -> None:
    """CheckRefused where a pair is not lifted for as long as so many blends take; times in [s]."""
    if down - up < blends * lifts.blend_s - TIME_ROUNDING:
        raise CheckRefused(
            f"{name} is lifted for {down - up:.3f} s only, from t = {up:.3f} s on; up and down take "
            f"{blends * lifts.blend_s:g} s (lifts.blend_s)"
        )


def height_of(time: Array, up: Array | float, down: Array | float, lifts: Lifts) -> Array:
    """Height [m] at a time of what is lifted from ``up`` to ``down`` [s]; infinite ones are for ever."""
    since, until = (time - up) / lifts.blend_s, (down - time) / lifts.blend_s
    return 1e-3 * lifts.clearance_mm * _smooth(since) * _smooth(until)


def _smooth(u: Array) -> Array:
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 + u * (-15.0 + 6.0 * u))


def _refuse_twist(tilt: Array, lifts: Lifts, pairs: tuple[str, ...], time: Array) -> None:
    """A grounded pair whose other wheel is high in the air does not roll as the record's kinematics has it."""
    row, pair = np.unravel_index(int(tilt.argmax()), tilt.shape)
    if tilt[row, pair] > 1e-3 * lifts.tilt_mm:
        raise CheckRefused(
            f"{pairs[pair]} would stand on one wheel at t = {time[row]:.3f} s, the other "
            f"{1e3 * tilt[row, pair]:.1f} mm above the floor (lifts.tilt_mm: {lifts.tilt_mm:g}): the axles before it "
            "do not meet in one point, so that one between them cannot be lifted without a twist. Less clearance, or a "
            "base that is bent less"
        )
