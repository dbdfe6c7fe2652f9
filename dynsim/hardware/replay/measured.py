"""Measured record of a replay, even of a replay whose process died.

The scene is copied from the replayed record; the poses of the bodies are computed from the measured joint angles.
"""

from __future__ import annotations

import itertools
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.hardware.replay.output import (
    MEASURED,
    PART,
    PART_FORMAT,
    SUMMARY,
    Layout,
    ReplayState,
    Rows,
    Timing,
    is_locked,
    row_type,
)
from dynsim.hardware.replay.trajectory import GROUNDED, wheel_offsets
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import TIME, Record
from dynsim.record.poses import ORIENTATION, POSITION, add_body_poses, point_positions
from dynsim.record.scene import Scene
from dynsim.system.files import json_text, replace_together

Array = NDArray[np.float64]
LIFTING = "lifting"
RAW = (
    ("current", "A", "motor current, in the direction of the joint"),
    ("load", "1", "load of servos without a current sensor, as a fraction of the stall torque"),
    ("pwm", "1", "motor voltage as a fraction of the supply voltage, in the direction of the joint"),
    ("goal_register", "1", "last goal sent: ticks of 2π/4096 rad, or units of 0.229 rpm for a wheel"),
)
"""Names, units and descriptions of the signals with raw data of the servos."""
FOLLOWED = "copied from the replayed record at record_time; not measured by a servo"
END_STATE = "unknown: the program died"


def timing_of(rows: Rows, layout: Layout) -> Timing:
    """Return timing statistics of the recorded cycles; empty before the second cycle."""
    if len(rows) < 2:
        return {}
    path_time = rows["path_time"]
    # Select the cycles in which the path advanced; for the first cycle, there is no earlier time to compare with.
    followed = np.isfinite(path_time) & (np.diff(path_time, prepend=np.nan) != 0)
    periods, lateness, exchange = np.diff(rows["time"]), rows["lateness"], rows["exchange"]
    return {
        "cycles": len(rows),
        "skipped_cycles": int(rows["skipped"].sum()),
        "missed_statuses": int(np.isnan(rows["position"]).sum()),
        "stray_bytes": int(rows["stray"].sum()),
        "period_mean_s": float(periods.mean()),
        "period_max_s": float(periods.max()),
        "lateness_p50_s": float(np.percentile(lateness, 50)),
        "lateness_p99_s": float(np.percentile(lateness, 99)),
        "lateness_max_s": float(lateness.max()),
        "path_late_s": float(rows["skipped"][followed].sum() / layout.provenance["rate_Hz"]),
        "exchange_mean_s": float(exchange.mean()),
        "exchange_max_s": float(exchange.max()),
    }


def measured_record(rows: Rows, layout: Layout, origin: float) -> Record:
    """Build the record of the measured run.

    Parameters
    ----------
    rows : Rows
        Rows with the data of the cycles.
    layout : Layout
        Joints and signals in the rows.
    origin : float
        Start of the replayed motion on the clock of the rows [s]; it becomes time 0 of the record.
    """
    record = Record(rows["time"] - origin, provenance=layout.provenance)
    joints = tuple(layout.joints)
    record.add("record_time", rows["path_time"], "s", description="time in the replayed record")
    record.add("state", rows["state"].astype(np.int64), "1", description="state of the replay, a number of ReplayState")
    units = {"position": "rad", "velocity": "rad/s"}
    for (name, source, columns), suffix in itertools.product(layout.groups(), ("", "_goal")):
        labels = tuple(layout.labels[column] for column in columns)
        field = f"goal_{source}" if suffix else source
        record.add(name + suffix, rows[field][:, columns], units[source], labels=labels)
    record.add("torque_estimate", rows["torque"], "N m", labels=joints, description="from motor current or load")
    for name, unit, text in RAW:
        if np.isfinite(rows[name]).any():
            record.add(name, rows[name], unit, labels=joints, description=text)
    text = "time at which the status of each servo arrived"
    record.add("read_time", rows["read_time"] - origin, "s", labels=joints, description=text)
    record.add("supply_voltage", rows["volts"], "V", labels=joints)
    record.add("temperature", rows["celsius"], "degC", labels=joints)
    missed = np.isnan(rows["position"])
    record.add("missed", missed, "1", labels=joints, description="no valid status in this cycle")
    record.add("alert", rows["alert"], "1", labels=joints, description="alert bit of the status")
    record.add("lateness", rows["lateness"], "s", description="delay of the cycle start after its deadline")
    record.add("exchange", rows["exchange"], "s", description="duration of the bus traffic of the cycle")
    record.summary["timing"] = timing_of(rows, layout)
    return record


def unmeasured(record: Record, servo_map: ServoMap) -> Record | None:
    """Return the signals that determine the pose of the robot but are not measured, such as the base of a snake robot.

    The result contains, as functions of time, the columns of those joints in the scene that have no servo (for example
    the wheels of a mobile base), the signal ``grounded``, and, as ``lifting``, the angles that the map adds to joints
    to lift wheels, which are not part of the scene. It is None if the record has no scene or lacks one of the columns.
    """
    if record.scene is None:
        return None
    followed = Record(record.time - record.time[0])
    servos = {(servo.kind.follows.position, servo.label) for servo in servo_map.servos}
    for name in dict.fromkeys(body.joint.signal for body in record.scene.bodies):
        wanted = [label for body in record.scene.bodies if body.joint.signal == name for label in body.joint.labels]
        missing = tuple(dict.fromkeys(label for label in wanted if (name, label) not in servos))
        if not missing:
            continue
        if name not in record or record.signals[name].axis != TIME or not set(missing) <= set(record.labels[name]):
            return None
        columns = [record.labels[name].index(label) for label in missing]
        followed.add(name, record[name][:, columns], record.units[name], labels=missing, description=FOLLOWED)
    if GROUNDED in record:
        followed.add(GROUNDED, record[GROUNDED], "1", labels=record.labels[GROUNDED], description=FOLLOWED)
    if servo_map.lifts is not None:
        added = wheel_offsets(record, servo_map)
        label = dict(zip(servo_map.joints, (servo.label for servo in servo_map.servos), strict=True))
        if added:
            data = np.column_stack(list(added.values()))
            followed.add(LIFTING, data, "rad", labels=tuple(label[joint] for joint in added), description=FOLLOWED)
    return followed


def describe(record: Record, scene: Scene | None, followed: Record | None = None) -> Record:
    """Add events, body poses and hand positions to a measured record, so that it can be drawn.

    The record is changed in place and returned. Each change of the signal ``state`` becomes an event. Poses and
    ``hand_position`` are computed from the measured joint positions, ``hand_position_goal`` from the goals.

    Parameters
    ----------
    record : Record
        Measured record.
    scene : Scene or None
        Scene of the replayed record; if it is None, only events are added.
    followed : Record, optional
        Signals of the replayed record that no servo measures (see :func:`unmeasured`). If a joint is in neither record,
        all poses are omitted.
    """
    if len(record):
        for row in np.flatnonzero(np.diff(record["state"], prepend=-1)):
            record.add_event(record.time[row], "state", ReplayState(int(record["state"][row])).name)
    record.scene = scene
    if scene is None or not len(record):
        return record
    at, followed = _path_time(record), Record([0.0]) if followed is None else followed
    actual = _with_poses(record, scene, followed, at, "")
    if actual is None:
        return record
    on = " on the base of the replayed record" if followed.signals else ""
    for name in (POSITION, ORIENTATION):
        pose = actual.signals[name]
        record.add(name, pose.data, pose.unit, labels=pose.labels, description=f"from measured joints{on}")
    for name in followed.signals:
        # Skip signals with measured columns, because their description would not apply to the copied columns.
        if name != LIFTING and name not in record:
            data = _at(followed, name, at)
            # A wheel pair is either lifted or on the ground.
            data = np.rint(data) if name == GROUNDED else data
            record.add(name, data, followed.units[name], labels=followed.labels[name], description=FOLLOWED)
    if scene.hand is None:
        return record
    axes = ("x", "y", "z")
    position = point_positions(actual, scene.hand)
    record.add("hand_position", position, "m", labels=axes, description=f"from measured joints{on}")
    if (goals := _with_poses(record, scene, followed, at, "_goal")) is not None:
        where = point_positions(goals, scene.hand)
        record.add("hand_position_goal", where, "m", labels=axes, description=f"from joint goals{on}")
    return record


def _path_time(record: Record) -> Array:
    """Return the time in the replayed record, which is constant before the start and after the end of the motion."""
    time = np.asarray(record["record_time"], dtype=np.float64) if "record_time" in record else record.time
    known = np.flatnonzero(np.isfinite(time))
    return np.interp(record.time, record.time[known], time[known]) if len(known) else np.zeros(len(record))


def _at(followed: Record, name: str, at: Array) -> Array:
    data = np.asarray(followed[name], dtype=np.float64)
    return np.column_stack([np.interp(at, followed.time, column) for column in data.T])


def _with_poses(record: Record, scene: Scene, followed: Record, at: Array, suffix: str) -> Record | None:
    """Return a record with the poses of all bodies; None if a joint angle is missing.

    The poses are computed from the measured joint angles, or from the goals if ``suffix`` is "_goal".
    """
    poses = Record(record.time)
    poses.scene = scene
    added: dict[str, Array] = {}
    if LIFTING in followed:
        added = dict(zip(followed.labels[LIFTING], _at(followed, LIFTING, at).T, strict=True))
    for name in dict.fromkeys(body.joint.signal for body in scene.bodies):
        columns: dict[str, Array] = {}
        if name in followed:
            columns |= dict(zip(followed.labels[name], _at(followed, name, at).T, strict=True))
        if f"{name}{suffix}" in record:
            data = np.asarray(record[f"{name}{suffix}"], dtype=np.float64)
            own = dict(zip(record.labels[f"{name}{suffix}"], data.T, strict=True))
            columns |= {label: column - added.get(label, 0.0) for label, column in own.items()}
        if not columns:
            return None
        poses.add(name, np.column_stack(list(columns.values())), "rad", labels=tuple(columns))
    return poses if add_body_poses(poses) else None


def recover(folder: Path, out: Path | None = None) -> Record:
    """Build ``measured.h5`` and ``summary.json`` from ``measured.part`` after a replay died, and remove this file.

    The record is marked incomplete. If a summary exists, it belongs to the same replay, which ended but could not write
    its record; the end state in this summary is kept. If a complete ``measured.h5`` exists, it also belongs to the same
    replay, because the files of earlier replays are moved away before a replay starts; this file is kept, too.

    Parameters
    ----------
    folder : Path
        Folder of the replay.
    out : Path, optional
        Folder for the record and the summary, which must not contain such files yet. In this case ``folder`` is not
        changed and may be read-only.

    Raises
    ------
    RecordError
        If there is neither a partial nor a complete record, if the partial record is empty or cannot be read, if its
        replay is still running, if the record cannot be written, or if ``out`` already contains a record.
    """
    part = folder / PART
    try:
        if part.is_file() and is_locked(part):
            raise RecordError(f"{part}: the replay is still running; wait until it has ended")
        record = whole = _load_if_valid(folder / MEASURED)
        if not part.is_file() and not (whole and whole.complete):
            raise RecordError(f"{folder}: nothing to recover (no {PART})")
        if record is None:
            record = _read(part)
            record.summary |= {"end_state": END_STATE} | _summary(folder / SUMMARY) | {"recovered": True}
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            if there := [name for name in (MEASURED, SUMMARY, PART) if (out / name).exists()]:
                raise RecordError(f"{out}: already contains {', '.join(there)}; choose another --out")
            write_measured(record, record.summary, out)
            return record
        if whole is None:
            write_measured(record, record.summary, folder)
        part.unlink(missing_ok=True)
    except OSError as error:
        raise RecordError(f"{part}: cannot be recovered ({error.strerror})") from error
    return record


def write_measured(record: Record, summary: dict[str, Any], folder: Path) -> None:
    """Write the record and the summary; if one of them cannot be written, write neither."""
    contents: dict[str, bytes | memoryview] = {MEASURED: record.to_hdf5(), SUMMARY: json_text(summary).encode("utf-8")}
    replace_together(folder, contents)


def _load_if_valid(measured: Path) -> Record | None:
    """Return the record at a path, or None if it does not exist or is damaged."""
    with suppress(RecordError):
        return Record.load(measured)
    return None


def _summary(path: Path) -> dict[str, Any]:
    """Return the summary of a replay that ended; empty if the file does not exist or is damaged."""
    with suppress(FileNotFoundError, ValueError):
        summary = json.loads(path.read_bytes())
        return summary if isinstance(summary, dict) else {}
    return {}


def _read(part: Path) -> Record:
    content = part.read_bytes()
    if not content:
        raise RecordError(f"{part}: is empty, because the replay died before its first cycle; remove it")
    line, _, data = content.partition(b"\n")
    try:
        header: dict[str, Any] = json.loads(line)
        layout = Layout(**header["layout"])
        kind = row_type(len(layout.joints))
        if header["format"] != PART_FORMAT or header["row"] != json.loads(json.dumps(kind.descr)):
            raise ValueError("it was written by another version of dynsim")
        scene = Scene.from_json(header["scene"]) if header["scene"] else None
    except (ValueError, TypeError, KeyError) as error:
        raise RecordError(f"{part}: is not a partial record of a replay ({error})") from error
    # The last row may be cut off.
    rows = _valid_rows(np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], dtype=kind))
    origins = rows["origin"][np.isfinite(rows["origin"])]
    origin = origins[0] if len(origins) else rows["time"][0] if len(rows) else 0.0
    record = describe(measured_record(rows, layout, float(origin)), scene)
    record.complete = False
    return record


def _valid_rows(rows: Rows) -> Rows:
    """Return the rows before the first whose time does not increase or whose state is unknown.

    A power failure may leave zeros at the end.
    """
    forward = np.diff(rows["time"], prepend=-np.inf) > 0
    broken = np.flatnonzero(~(forward & np.isfinite(rows["time"]) & np.isin(rows["state"], [*ReplayState])))
    return rows[: broken[0]] if len(broken) else rows
