"""Export of the joint positions and rates of a record: CSV, ROS joint trajectory, or log for URDF joints."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, TextIO

import numpy as np

from dynsim.errors import RecordError
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
_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def export_record(record: Record, path: Path, format_: Format, *, rate: float | None = None) -> Path:
    """Write the joint positions and rates of a record.

    ``csv``: one row per sample, columns "time [s]", "<joint> [rad]", "<joint> [rad/s]", with the units of the record
    ("rad or m" if it has both kinds of joints). ``joint-trajectory``: the fields of a ROS
    trajectory_msgs/JointTrajectory as YAML, for a joint trajectory controller. ``urdf-log``: one JSON object per line,
    {"time", "position": {joint: rad or m}, "velocity": {joint: rad/s or m/s}}, with the joint names of the URDF.

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

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    RecordError
        If the record has no joint angles or only one sample, or if the file cannot be written.
    """
    joints, time, position, velocity = joint_motion(record)
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


def joint_motion(record: Record) -> tuple[list[str], Array, Array, Array]:
    """Return joint names, times starting at 0 [s], positions and rates [rad, rad/s; m, m/s] of a record.

    Raises
    ------
    RecordError
        If the record has no joint motion, no samples, or a value that is not finite.
    """
    joints: list[str] = []
    angles, rates = [], []
    for name, rate in RATES.items():
        if name in record and rate in record:
            shared = _in_both(record, name, rate)
            joints += shared
            angles.append(record[name][:, [record.labels[name].index(joint) for joint in shared]])
            rates.append(record[rate][:, [record.labels[rate].index(joint) for joint in shared]])
    if not joints:
        pairs = ", ".join(f"{name} with {rate}" for name, rate in RATES.items())
        raise RecordError(f"the record has no joint motion ({pairs}); it has {', '.join(record)}")
    if not len(record):
        raise RecordError("the record has no samples")
    position, velocity = np.hstack(angles), np.hstack(rates)
    for quantity, values in (("position", position), ("rate", velocity)):
        for sample, joint in np.argwhere(~np.isfinite(values))[:1]:
            raise RecordError(
                f"the {quantity} of {joints[joint]} is {values[sample, joint]} at sample {sample} "
                f"(t = {record.time[sample]:.6g} s): the record is damaged"
            )
    return joints, record.time - record.time[0], position, velocity


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
    pairs = [(name, rate) for name, rate in RATES.items() if name in record and rate in record]
    units = [[record.units[pair[k]] for pair in pairs for _ in _in_both(record, *pair)] for k in (0, 1)]
    headings = [f"{joint} [{unit}]" for column in units for joint, unit in zip(joints, column, strict=True)]
    rows = csv.writer(file)
    rows.writerow(["time [s]", *map(csv_cell, headings)])
    rows.writerows([f"{value:.9g}" for value in (t, *qs, *vs)] for t, qs, vs in zip(time, q, v, strict=True))


def _write_joint_trajectory(file: TextIO, joints: list[str], time: Array, q: Array, v: Array) -> None:
    file.write(f"joint_names: [{', '.join(map(_yaml_text, joints))}]\npoints:\n")
    for t, qs, vs in zip(time, q, v, strict=True):
        seconds, nanoseconds = divmod(round(t * 1e9), 1_000_000_000)
        file.write(f"- positions: {_flow(qs)}\n  velocities: {_flow(vs)}\n")
        file.write(f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}\n")


def _yaml_text(joint: str) -> str:
    """Return a name unchanged if YAML reads it as text, otherwise as a quoted JSON string, which YAML can read."""
    return joint if re.fullmatch(r"[A-Za-z_][\w.-]*", joint) and joint.lower() not in _YAML_WORDS else json.dumps(joint)


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
