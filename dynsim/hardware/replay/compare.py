"""Comparison of a measured run with the simulated run: delay, errors with and without delay, gate and figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.optimize import minimize_scalar

from dynsim.config.base import Positive, StrictConfig
from dynsim.errors import RecordError, brief
from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.errors import ComparisonGateFailed
from dynsim.hardware.replay.output import ReplayState
from dynsim.hardware.servo_map import read_yaml
from dynsim.record import Record
from dynsim.snake.lifting import Lifts, lifted

Array = NDArray[np.float64]
MAX_DELAY = 0.5
"""Maximum delay that is searched for [s]."""
MOVING = 3 * RAD_PER_TICK
"""Minimum motion of a joint from which its delay is estimated [rad]: three steps of the servo encoder."""
WHEEL_ANGLE, WHEEL_RATE = "rho", "rho_dot"
"""Signals of wheels. A wheel can turn without limit, so its rate and the angle turned since the start are compared."""

EFFORTS = (("torque", "torque_estimate", "N m"), ("current", "current", "A"))
"""Name of each effort in a simulated record and in a measured record, and its unit."""


class Gate(StrictConfig):
    """Error bounds for a comparison.

    Attributes
    ----------
    rms_rad, max_rad : float or None
        Error of the worst joint, including the delay [rad].
    rms_delay_removed_rad : float or None
        Rms error of the worst joint with the common delay removed [rad].
    delay_s : float or None
        Common delay [s].
    wheel_rate_rms_rad_s, wheel_angle_max_rad : float or None
        Error in the rate [rad/s] and in the angle turned since the start [rad] of the worst wheel; if one of these
        bounds is set, a comparison without wheels fails.
    """

    rms_rad: Positive | None = None
    max_rad: Positive | None = None
    rms_delay_removed_rad: Positive | None = None
    delay_s: Positive | None = None
    wheel_rate_rms_rad_s: Positive | None = None
    wheel_angle_max_rad: Positive | None = None


@dataclass(frozen=True)
class JointError:
    """Error of one joint: measured minus simulated angle.

    Attributes
    ----------
    joint : str
    rms, max : float
        Rms and maximum error [rad].
    time_of_max : float
        Time of ``max`` [s of record time].
    rms_delay_removed : float
        Rms error with the common delay removed [rad]; equal to ``rms`` if there is no common delay.
    delay : float
        Delay of this joint [s]; NaN if no delay explains the error.
    """

    joint: str
    rms: float
    max: float
    time_of_max: float
    rms_delay_removed: float
    delay: float


@dataclass(frozen=True)
class WheelError:
    """Error of one wheel: measured minus simulated motion.

    Attributes
    ----------
    wheel : str
    rate_rms, rate_max : float
        Rms and maximum error in the rate [rad/s].
    time_of_max : float
        Time of ``rate_max`` [s of record time].
    turned : float
        Angle turned in the simulation between the first and the last compared sample [rad].
    angle_max, angle_end : float
        Error in the angle turned since the start: maximum magnitude, and signed error at the end [rad].
    """

    wheel: str
    rate_rms: float
    rate_max: float
    time_of_max: float
    turned: float
    angle_max: float
    angle_end: float


@dataclass(frozen=True)
class EffortError:
    """Error of the torque or current of one joint: measured minus simulated, with the common delay removed.

    Attributes
    ----------
    joint, quantity, unit : str
        Name of the joint; "torque" in "N m" or "current" in "A", which is the unit of the following values.
    simulated_rms, measured_rms : float
        Rms values.
    rms, max : float
        Rms and maximum error.
    time_of_max : float
        Time of ``max`` [s of record time].
    """

    joint: str
    quantity: str
    unit: str
    simulated_rms: float
    measured_rms: float
    rms: float
    max: float
    time_of_max: float


@dataclass(frozen=True)
class Comparison:
    """Comparison of simulated and measured angles at the times of the measured run.

    Attributes
    ----------
    delay : float
        Common delay of all joints in the measured run [s]; NaN if no delay explains half of the mean square error.
    joints : tuple of JointError
    wheels : tuple of WheelError
        Empty if the records have no wheels in common.
    efforts : tuple of EffortError
        Torques and currents that both records contain.
    time : array, shape (T,)
        Record time [s].
    simulated, measured : array, shape (T, N)
        Joint angles [rad].
    wheel_rates : array, shape (2, T, number of wheels)
        Simulated and measured wheel rates [rad/s].
    effort_values : array, shape (2, T, number of efforts)
        Simulated and measured efforts.
    """

    delay: float
    joints: tuple[JointError, ...]
    wheels: tuple[WheelError, ...]
    efforts: tuple[EffortError, ...]
    time: Array
    simulated: Array
    measured: Array
    wheel_rates: Array
    effort_values: Array

    @property
    def worst(self) -> JointError:
        """Joint with the largest rms error."""
        return max(self.joints, key=lambda joint: joint.rms)

    @property
    def delay_text(self) -> str:
        """Text that states the common delay."""
        return "no common delay" if np.isnan(self.delay) else f"common delay {self.delay * 1e3:.1f} ms"

    def summary(self) -> dict[str, Any]:
        """Return the results as a dictionary for JSON, with units in the keys."""
        values = ("simulated_rms", "measured_rms", "rms", "max")
        joint_units = {"rms": "rad", "max": "rad", "rms_delay_removed": "rad", "delay": "s"}
        wheel_units = {
            "rate_rms": "rad_s", "rate_max": "rad_s", "turned": "rad", "angle_max": "rad", "angle_end": "rad"
        }  # fmt: skip
        return {
            "delay_s": _number(self.delay),
            "rms_rad": self.worst.rms,
            "max_rad": max(joint.max for joint in self.joints),
            "rms_delay_removed_rad": max(joint.rms_delay_removed for joint in self.joints),
            "worst_joint": self.worst.joint,
            "wheel_rate_rms_rad_s": max((wheel.rate_rms for wheel in self.wheels), default=None),
            "wheel_angle_max_rad": max((wheel.angle_max for wheel in self.wheels), default=None),
            "joints": {joint.joint: _with_units(joint, joint_units) for joint in self.joints},
            "wheels": {wheel.wheel: _with_units(wheel, wheel_units) for wheel in self.wheels},
            **{
                f"{quantity}s": {
                    effort.joint: _with_units(effort, dict.fromkeys(values, unit.replace(" ", "_")))
                    for effort in self.efforts
                    if effort.quantity == quantity
                }
                for quantity, _, unit in EFFORTS
            },
        }


def _number(value: float) -> float | None:
    return None if np.isnan(value) else value


def _with_units(error: JointError | WheelError | EffortError, units: dict[str, str]) -> dict[str, float | None]:
    return {f"{name}_{unit}": _number(getattr(error, name)) for name, unit in units.items()}


def compare_records(simulated: Record, measured: Record) -> Comparison:
    """Compare all joint angles that two records have in common.

    Joints that lift wheels are compared with the angles that the lifted wheel pairs in the simulated record require.
    For wheels, the rates and the angles turned since the start of the motion are compared.

    Parameters
    ----------
    simulated : Record
        Simulated run.
    measured : Record
        Measured run, whose signal ``record_time`` aligns it with the simulation. It may also be any other record.

    Raises
    ------
    RecordError
        If there are no common angles, if there are no samples of the replayed motion, or if the measured run is not the
        result of a replay.
    CheckRefused
        If the measured run lifted wheels but the lifting cannot be computed for the simulated record.
    """
    if "record_time" in simulated and "record_time" not in measured:
        raise RecordError("the first record was measured on servos, the second was simulated; exchange them")
    for name in ("state", "record_time"):
        if name in measured and measured[name].shape != measured.time.shape:
            raise RecordError(
                f"signal {name!r} of the measured run must have one column, got shape {measured[name].shape}"
            )
    speed = measured.provenance.get("speed", 1.0)
    if not isinstance(speed, (int, float)) or not 0.0 < speed < np.inf:
        raise RecordError(f"speed in the provenance of the measured run must be positive, got {brief(speed)}")
    rows = measured["state"] == ReplayState.REPLAY if "state" in measured else np.ones(len(measured), dtype=bool)
    time = measured["record_time"] if "record_time" in measured else measured.time  # noqa: SIM401
    rows &= np.isfinite(time) & (time >= 0) & (time <= simulated.time[-1] - simulated.time[0])
    if rows.sum() < 2:
        raise RecordError("the measured record does not contain the replayed motion; use a completed replay")
    pairs = _common_angles(simulated, measured)
    if not pairs:
        raise RecordError("the records have no joint angles in common (signals in rad with equal name and labels)")
    labels = tuple(label for label, _, _ in pairs)
    actual = np.column_stack([data[rows] for _, _, data in pairs])
    reference = np.column_stack([data for _, data, _ in pairs])
    own_time, time = simulated.time - simulated.time[0], time[rows]

    def at(times: Array) -> Array:
        return np.column_stack([np.interp(times, own_time, column) for column in reference.T])

    moving = np.ptp(reference, axis=0) > MOVING
    common = _delay(at, time, actual, moving)
    delay = 0.0 if np.isnan(common) else common
    joints = []
    for column, label in enumerate(labels):
        error = actual[:, column] - at(time)[:, column]
        shifted = actual[:, column] - at(time - delay)[:, column]
        only = np.zeros_like(moving)
        only[column] = moving[column]
        largest, time_of_max = _largest(error, time)
        joints.append(
            JointError(
                joint=label,
                rms=_rms(error),
                max=largest,
                time_of_max=time_of_max,
                rms_delay_removed=_rms(shifted),
                delay=_delay(at, time, actual, only) / speed,
            )
        )
    wheels, rates = _wheel_errors(simulated, measured, rows, time, speed)
    efforts, effort_values = _effort_errors(simulated, measured, rows, time, delay)
    return Comparison(common / speed, tuple(joints), wheels, efforts, time, at(time), actual, rates, effort_values)


def _rms(error: Array) -> float:
    """Return the rms value of an error; samples without an answer are NaN and are ignored."""
    return float(np.sqrt(np.nanmean(error**2)))


def _largest(error: Array, time: Array) -> tuple[float, float]:
    """Return the magnitude and time of the largest error; samples without an answer are NaN and are ignored."""
    worst = int(np.nanargmax(np.abs(error)))
    return float(abs(error[worst])), float(time[worst])


def _wheel_errors(
    simulated: Record, measured: Record, rows: NDArray[np.bool_], time: Array, speed: float
) -> tuple[tuple[WheelError, ...], Array]:
    """Return the errors of the wheels, and the wheel rates as in :class:`Comparison`."""
    angles = {label: (ours, theirs) for label, ours, theirs in _columns(simulated, measured, WHEEL_ANGLE)}
    own_time = simulated.time - simulated.time[0]
    errors, rates = [], np.zeros((2, len(time), 0))
    for label, ours, theirs in _columns(simulated, measured, WHEEL_RATE):
        if label not in angles:
            continue
        pair = np.stack([speed * np.interp(time, own_time, ours), theirs[rows]])
        rates = np.concatenate([rates, pair[:, :, None]], axis=2)
        rate = pair[1] - pair[0]
        asked = np.interp(time, own_time, angles[label][0])
        turned = angles[label][1][rows]
        seen = np.flatnonzero(np.isfinite(turned))  # samples for which the servo answered
        angle = (turned - turned[seen[0]]) - (asked - asked[seen[0]])
        rate_max, time_of_max = _largest(rate, time)
        errors.append(
            WheelError(
                wheel=label,
                rate_rms=_rms(rate),
                rate_max=rate_max,
                time_of_max=time_of_max,
                turned=float(asked[seen[-1]] - asked[seen[0]]),
                angle_max=float(np.nanmax(np.abs(angle))),
                angle_end=float(angle[seen[-1]]),
            )
        )
    return tuple(errors), rates


def _effort_errors(
    simulated: Record, measured: Record, rows: NDArray[np.bool_], time: Array, delay: float
) -> tuple[tuple[EffortError, ...], Array]:
    """Return the errors of torques and currents, and their values as in :class:`Comparison`."""
    labels = measured.provenance.get("labels", {})
    if not isinstance(labels, dict):
        raise RecordError(f"invalid labels in the provenance of the measured run: {brief(labels)}")
    own_time = simulated.time - simulated.time[0]
    errors, values = [], [np.zeros((2, len(time), 0))]
    for quantity, sensor, unit in EFFORTS:
        name = sensor if sensor in measured else quantity
        if any(n not in record or record[n].ndim != 2 for n, record in ((quantity, simulated), (name, measured))):
            continue
        acting: dict[str, Array] = {}
        for column, joint in enumerate(measured.labels[name]):
            data, label = np.asarray(measured[name][rows, column], dtype=np.float64), labels.get(joint, joint)
            if label in simulated.labels[quantity] and np.isfinite(data).any():
                acting[label] = acting.get(label, 0.0) + data  # both servos of a pair act on one joint
        for label, data in acting.items():
            ours = simulated[quantity][:, simulated.labels[quantity].index(label)]
            pair = np.stack([np.interp(time - delay, own_time, ours), data])
            largest, when = _largest(pair[1] - pair[0], time)
            sizes = (_rms(pair[0]), _rms(pair[1]), _rms(pair[1] - pair[0]))
            errors.append(EffortError(label, quantity, unit, *sizes, largest, when))
            values.append(pair[:, :, None])
    return tuple(errors), np.concatenate(values, axis=2)


def _columns(simulated: Record, measured: Record, name: str) -> list[tuple[str, Array, Array]]:
    """Return the label, simulated column and measured column for each column of a signal that is in both records."""
    if name not in simulated or name not in measured or simulated[name].ndim != 2 or measured[name].ndim != 2:
        return []
    ours, theirs = simulated.labels[name], measured.labels[name]
    columns = []
    for label in (label for label in ours if label in theirs):
        data = np.asarray(measured[name][:, theirs.index(label)], dtype=np.float64)
        if np.isfinite(data).any():
            columns.append((label, np.asarray(simulated[name][:, ours.index(label)], dtype=np.float64), data))
    return columns


def _common_angles(simulated: Record, measured: Record) -> list[tuple[str, Array, Array]]:
    """Return all angles, except wheel angles, that both records have in common.

    The reference for a joint that lifts wheels is the lifting angle, added to the angle in the record if there is one.
    """
    offsets = _lifting(simulated, measured)
    pairs = []
    for name, signal in simulated.signals.items():
        if "rad" not in signal.unit.split(" or ") or name not in measured or name == WHEEL_ANGLE:
            continue
        shared = [entry for entry in _columns(simulated, measured, name) if simulated.unit_of(name, entry[0]) == "rad"]
        pairs += [(label, ours + offsets.pop(label, 0.0), theirs) for label, ours, theirs in shared]
        for label in [label for label in offsets if label in measured.labels[name]]:
            data = np.asarray(measured[name][:, measured.labels[name].index(label)], dtype=np.float64)
            if np.isfinite(data).any():
                pairs.append((label, offsets.pop(label), data))
    return pairs


def _lifting(simulated: Record, measured: Record) -> dict[str, Array]:
    """Return the angles [rad] that the servo map of the measured run added to lift wheels, by column label."""
    entry = measured.provenance.get("lifts")
    if entry is None:
        return {}
    try:
        lifts = Lifts.model_validate(entry)
    except ValidationError:
        raise RecordError(f"invalid lifts in the provenance of the measured run: {brief(entry)}") from None
    return dict(zip(lifts.joints, lifted(simulated, lifts).hinge.T, strict=True))


def _delay(at: Any, time: Array, actual: Array, columns: NDArray[np.bool_]) -> float:
    """Return the time shift [s of record time] with which the simulated angles fit the measured angles best.

    Return NaN if no shift in the range explains half of the mean square error, because then sag or backlash, not delay,
    causes the error.
    """
    if not columns.any():
        return float("nan")

    def misfit(delay: float) -> float:
        error = (actual - at(time - delay))[:, columns]
        # Remove the mean: a joint that sags under its load has a constant error, which a delay does not explain.
        return float(np.nanmean((error - np.nanmean(error, axis=0)) ** 2))

    grid = np.linspace(-0.1, MAX_DELAY, 61)
    nearest = int(np.argmin([misfit(delay) for delay in grid]))
    if nearest in (0, len(grid) - 1):
        return float("nan")
    best, step = grid[nearest], grid[1] - grid[0]
    optimum = minimize_scalar(misfit, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-5})
    return float(optimum.x) if optimum.fun <= 0.5 * misfit(0.0) else float("nan")


def load_gate(path: str | Path) -> Gate:
    """Read a gate file.

    Raises
    ------
    ServoMapError
        If the file is missing, is not YAML or has an invalid entry; the message states the file and the line.
    """
    return read_yaml(Path(path), Gate)


def check_gate(comparison: Comparison, gate: Gate) -> None:
    """Check a comparison against the bounds of a gate.

    Raises
    ------
    ComparisonGateFailed
        If a bound is exceeded; the message lists all bounds that are exceeded.
    """
    summary = comparison.summary()
    bounds = {name: bound for name, bound in gate.model_dump().items() if bound is not None}
    if summary["delay_s"] is None:
        # If there is no common delay, only the other bounds apply.
        bounds.pop("delay_s", None)
    exceeded = [f"{name}: no wheels to compare" for name in bounds if summary[name] is None]
    exceeded += [
        f"{name} {summary[name]:.4g} > {bound:.4g}"
        for name, bound in bounds.items()
        if summary[name] is not None and summary[name] > bound
    ]
    if exceeded:
        raise ComparisonGateFailed(f"gate failed (worst joint {comparison.worst.joint}): {', '.join(exceeded)}")


def draw_comparison(comparison: Comparison, path: Path, joints: Sequence[str] = ()) -> Path:
    """Draw measured and simulated angles of some joints, and the errors of all joints; the same for wheels and efforts.

    Parameters
    ----------
    comparison : Comparison
    path : Path
        Output file.
    joints : sequence of str
        Joints and wheels to draw in colour; default: the joint and the wheel with the largest errors.

    Raises
    ------
    RecordError
        If a joint was not compared, or the file cannot be written.
    """
    from dynsim.draw.figures.measured import Compared as Followed
    from dynsim.draw.figures.measured import draw_errors

    names = [joint.joint for joint in comparison.joints]
    wheels = [wheel.wheel for wheel in comparison.wheels]
    for name in joints:
        if name not in names + wheels:
            raise RecordError(f"unknown joint {brief(name)}; compared joints: {', '.join(names + wheels)}")
    texts = [
        f"{joint.joint}: rms {1e3 * joint.rms:.3g} mrad, max. {1e3 * joint.max:.3g}" for joint in comparison.joints
    ]
    rms, both = [joint.rms for joint in comparison.joints], np.stack([comparison.simulated, comparison.measured])
    quantities = [
        Followed("joints", "joint angle [rad]", "measured − simulated [mrad]", 1e3, names, rms, texts, both),
    ]
    if wheels:
        texts = [
            f"{wheel.wheel}: rms {wheel.rate_rms:.3g} rad/s, max. angle error {wheel.angle_max:.3g} rad"
            for wheel in comparison.wheels
        ]
        rms, both = [wheel.rate_rms for wheel in comparison.wheels], comparison.wheel_rates
        quantities.append(
            Followed("wheels", "wheel rate [rad/s]", "measured − sim. [rad/s]", 1.0, wheels, rms, texts, both)
        )
    for quantity, _, unit in EFFORTS:
        columns = [k for k, effort in enumerate(comparison.efforts) if effort.quantity == quantity]
        chosen = [comparison.efforts[k] for k in columns]
        if chosen:
            texts = [f"{error.joint}: rms {error.rms:.3g} {unit}, max. {error.max:.3g}" for error in chosen]
            both = comparison.effort_values[:, :, columns]
            rms, joint_names = [error.rms for error in chosen], [error.joint for error in chosen]
            label = f"{quantity} [{unit}]"
            quantities.append(
                Followed(f"{quantity}s", label, f"measured − sim. [{unit}]", 1.0, joint_names, rms, texts, both)
            )
    title = (
        f"measured and simulated joints: {comparison.delay_text}, worst {comparison.worst.joint} "
        f"with rms {1e3 * comparison.worst.rms:.3g} mrad"
    )
    return draw_errors(title, comparison.time, quantities, joints, path)
