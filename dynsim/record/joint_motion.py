"""Export of the joint positions and rates of a record: CSV, ROS joint trajectory, or log for URDF joints."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, TextIO

import numpy as np

from dynsim.errors import RecordError, brief
from dynsim.record.csv_rows import csv_cell
from dynsim.record.quaternion import Array
from dynsim.record.record import Record
from dynsim.system.files import replacing

Format = Literal["csv", "joint-trajectory", "urdf-log"]
SUFFIX: dict[str, str] = {"csv": ".csv", "joint-trajectory": ".trajectory.yaml", "urdf-log": ".jsonl"}
RATES = {"q": "v", "phi": "phi_dot", "rho": "rho_dot"}
"""Position signals of records, each with the signal of its rates."""
ROWS_MAX = 1e7
"""Maximum number of rows of a resampled motion."""
REST = 1e-6
"""A motion counts as at rest if its joint speeds are below this value [rad/s or m/s]."""
RUN_UP = 2.0
"""Default acceleration of the run-up and run-out of a motion that starts or ends in motion [rad/s² or m/s²]."""
_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def export_record(
    record: Record, path: Path, format_: Format, *, rate: float | None = None, joints: Sequence[str] | None = None
) -> Path:
    """Write the joint positions and rates of a record.

    ``csv``: one row per sample, columns "time [s]", "<joint> [rad]", "<joint> [rad/s]", with the units of each
    joint. ``joint-trajectory``: the fields of a ROS
    trajectory_msgs/JointTrajectory as YAML, for a joint trajectory controller; it starts and ends at rest, if necessary
    after a run-up and with a run-out of constant acceleration. ``urdf-log``: one JSON object per line, {"time",
    "position": {joint: rad or m}, "velocity": {joint: rad/s or m/s}}, with the joint names of the URDF.

    Parameters
    ----------
    record : Record
        Record with joint positions and rates.
    path : Path
        File to write.
    format_ : {"csv", "joint-trajectory", "urdf-log"}
        File format.
    rate : float, optional
        Rate to which the record is resampled [Hz] (cubic Hermite), with a last row at the end of the record; default:
        the samples of the record.
    joints : sequence of str, optional
        Joints to write; default: all joints, or, for a joint trajectory, the joints with a motor.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    RecordError
        If the record has no joint angles or only one sample, if a joint is unknown or would exceed its limit in the
        run-up or run-out, or if the file cannot be written.
    """
    commanded = format_ == "joint-trajectory"
    joints, time, position, velocity = joint_motion(
        record, driven_joints(record) if commanded and not joints else joints
    )
    if len(time) < 2:
        raise RecordError("the record has only one sample; a motion requires two")
    if rate is not None:
        if not 0 < rate < np.inf:
            raise RecordError(f"--rate must be positive, not {rate}")
        # Imported here because it is slow to import.
        from scipy.interpolate import CubicHermiteSpline

        between = CubicHermiteSpline(time, position, velocity)
        end = float(time[-1])
        if end * rate > ROWS_MAX:
            raise RecordError(f"--rate {rate:g}: {end:g} s would be {end * rate:.3g} rows; the limit is {ROWS_MAX:g}")
        # The last row is at the end of the record, even if that is not a multiple of the period.
        time = np.arange(np.ceil(end * rate * (1.0 - 1e-9))) / rate
        time = np.append(time, end)
        position, velocity = between(time), between(time, 1)
    if commanded:
        time, position, velocity = _at_rest_at_both_ends(record, joints, time, position, velocity)
    writers: dict[str, Callable[..., None]] = {
        "csv": partial(_write_csv, record),
        "joint-trajectory": _write_joint_trajectory,
        "urdf-log": _write_urdf_log,
    }
    with replacing(path) as stream:
        text = io.TextIOWrapper(stream, encoding="utf-8", newline="")
        writers[format_](text, joints, time, position, velocity)
        text.flush()
        text.detach()  # otherwise the wrapper closes the stream before `replacing` publishes it
    return path


def joint_motion(record: Record, wanted: Sequence[str] | None = None) -> tuple[list[str], Array, Array, Array]:
    """Return joint names, times starting at 0 [s], positions and rates [rad, rad/s; m, m/s] of a record.

    Parameters
    ----------
    record : Record
        Record with joint positions and rates.
    wanted : sequence of str, optional
        Joints to return, in this order; default: all.

    Raises
    ------
    RecordError
        If the record has no joint motion, no samples, a value that is not finite, or no joint with a wanted name.
    """
    joints: list[str] = []
    angles, rates = [], []
    for name, rate in RATES.items():
        if name in record and rate in record:
            # Records of dynamic snakes contain the joints of ``q`` again in ``phi``, in the order of the controller.
            shared = [joint for joint in _in_both(record, name, rate) if joint not in joints]
            joints += shared
            angles.append(record[name][:, [record.labels[name].index(joint) for joint in shared]])
            rates.append(record[rate][:, [record.labels[rate].index(joint) for joint in shared]])
    if not joints:
        pairs = ", ".join(f"{name} with {rate}" for name, rate in RATES.items())
        raise RecordError(f"the record has no joint motion ({pairs}); it has {', '.join(record)}")
    if not len(record):
        raise RecordError("the record has no samples")
    position, velocity = np.hstack(angles), np.hstack(rates)
    if wanted is not None:
        if unknown := [name for name in wanted if name not in joints]:
            raise RecordError(f"unknown joint {brief(unknown[0])}; joints of the record: {', '.join(joints)}")
        if len({*wanted}) < len(wanted):
            raise RecordError(f"each joint may be listed only once, got {', '.join(wanted)}")
        columns = [joints.index(name) for name in wanted]
        joints, position, velocity = list(wanted), position[:, columns], velocity[:, columns]
    for quantity, values in (("position", position), ("rate", velocity)):
        for sample, joint in np.argwhere(~np.isfinite(values))[:1]:
            raise RecordError(
                f"the {quantity} of {joints[joint]} is {values[sample, joint]} at sample {sample} "
                f"(t = {record.time[sample]:.6g} s): the record is damaged"
            )
    return joints, record.time - record.time[0], position, velocity


def driven_joints(record: Record) -> list[str] | None:
    """Return the joints that have a motor, or None if the record contains no torques.

    Raises
    ------
    RecordError
        If the record contains torques, but no joint has a motor.
    """
    if "torque" not in record:
        return None
    if not (driven := [name for name in joint_motion(record)[0] if name in record.labels["torque"]]):
        raise RecordError("no joint of the record has a motor; list the joints of the trajectory with --joints")
    return driven


def ramp(rate: Array, acceleration: float) -> tuple[float, Array]:
    """Return duration [s] and distances, (N,), of a ramp of constant acceleration between rest and joint rates, (N,).

    The joint with the largest rate has the given acceleration; for rates that count as rest, the duration is 0.
    """
    fastest = float(np.abs(rate).max(initial=0.0))
    duration = fastest / acceleration if fastest > REST else 0.0
    return duration, 0.5 * duration * rate


def _at_rest_at_both_ends(
    record: Record, joints: list[str], time: Array, q: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return times starting at 0 [s], positions and rates of a motion with a run-up and a run-out if it needs them."""
    bodies = () if record.scene is None else record.scene.bodies
    ranges = {body.joint.labels[0]: body.joint for body in bodies if len(body.joint.labels) == 1}
    for end, k in (("start", 0), ("end", -1)):
        duration, distance = ramp(v[k], RUN_UP)
        if duration > 0.0:
            at_rest = q[k] - distance if k == 0 else q[k] + distance
            for joint, moving, still in zip(joints, q[k], at_rest, strict=True):
                limits = (ranges[joint].lower, ranges[joint].upper) if joint in ranges else (None, None)
                for limit, side in zip(limits, (1.0, -1.0), strict=True):
                    if limit is not None and side * still < side * limit <= side * moving:
                        raise RecordError(
                            f"{joint} is in motion at the {end}, and a ramp of {RUN_UP:g} rad/s² to rest would exceed "
                            f"its limit {limit:.4g} (reaching {still:.4g}); let the motion {end} at rest"
                        )
            time = np.append(0.0, time + duration) if k == 0 else np.append(time, time[-1] + duration)
            row = 0 if k == 0 else len(q)
            q, v = np.insert(q, row, at_rest, axis=0), np.insert(v, row, 0.0, axis=0)
        # Controllers reject any velocity at the end, even a negligible one.
        v[k] = 0.0
    return time, q, v


def _in_both(record: Record, name: str, rate: str) -> list[str]:
    """Return the joints that have a column in both signals.

    The coordinates of a planar mobile base or of a ball joint have no rate column with the same name.
    """
    for signal in (name, rate):
        if record[signal].ndim != 2 or len(record[signal]) != len(record):
            raise RecordError(
                f"signals {name!r} {record[name].shape} and {rate!r} {record[rate].shape} of the record must both "
                "have a row per sample and a column per joint"
            )
    return [label for label in record.labels[name] if label in record.labels[rate]]


def _write_csv(record: Record, file: TextIO, joints: list[str], time: Array, q: Array, v: Array) -> None:
    units = {
        joint: (record.unit_of(name, joint), record.unit_of(rate, joint))
        for name, rate in reversed(RATES.items())
        if name in record and rate in record
        for joint in _in_both(record, name, rate)
    }
    headings = [f"{joint} [{units[joint][k]}]" for k in (0, 1) for joint in joints]
    rows = csv.writer(file)
    rows.writerow(["time [s]", *map(csv_cell, headings)])
    rows.writerows([f"{value:.9g}" for value in (t, *qs, *vs)] for t, qs, vs in zip(time, q, v, strict=True))


def _write_joint_trajectory(file: TextIO, joints: list[str], time: Array, q: Array, v: Array) -> None:
    stamps = np.rint(time * 1e9).astype(np.int64)
    if not (np.diff(stamps) > 0).all():
        raise RecordError("the times of a joint trajectory must increase by at least 1 ns per point; reduce --rate")
    file.write(f"joint_names: [{', '.join(map(yaml_name, joints))}]\npoints:\n")
    for stamp, qs, vs in zip(stamps.tolist(), q, v, strict=True):
        seconds, nanoseconds = divmod(stamp, 1_000_000_000)
        file.write(f"- positions: {_flow(qs)}\n  velocities: {_flow(vs)}\n")
        file.write(f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}\n")


def yaml_name(name: str) -> str:
    """Return a name unchanged if YAML reads it as text, otherwise as a quoted JSON string, which YAML can read."""
    plain = re.fullmatch(r"[A-Za-z_][\w.-]*", name) and name.lower() not in _YAML_WORDS
    return name if plain else json.dumps(name, ensure_ascii=False)


def _flow(values: Array) -> str:
    # Use fixed notation, because YAML 1.1 reads "1e-05" as text: a float needs a decimal point.
    return f"[{', '.join(f'{value:.9f}' for value in values)}]"


def _write_urdf_log(file: TextIO, joints: list[str], time: Array, q: Array, v: Array) -> None:
    for t, qs, vs in zip(time, q, v, strict=True):
        line = {
            "time": round(float(t), 9),
            "position": dict(zip(joints, (round(float(x), 9) for x in qs), strict=True)),
            "velocity": dict(zip(joints, (round(float(x), 9) for x in vs), strict=True)),
        }
        file.write(json.dumps(line) + "\n")
