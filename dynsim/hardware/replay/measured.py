"""What makes a measured record one that describes itself: the scene of the record that was followed, poses, events."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.replay.trajectory import wheel_offsets
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import TIME, Record
from dynsim.record.poses import ORIENTATION, POSITION, add_body_poses, point_positions
from dynsim.record.scene import Scene

Array = NDArray[np.float64]
GROUNDED = "grounded"
LIFTING = "lifting"
FOLLOWED = "of the record that was followed, at record_time: no servo measures it"


def unmeasured(record: Record, servo_map: ServoMap) -> Record | None:
    """What a record says of the robot's place and no servo of a map will: the base of a snake, wheels of a mobile base.

    Columns of the joints of its scene that the map does not have, over the time of the motion; ``grounded``; and as
    ``lifting`` what the map adds to joints of the scene to lift wheels, of which the scene knows nothing. None for a
    record without scene, or one that does not have those columns either.
    """
    if record.scene is None:
        return None
    found = Record(record.time - record.time[0])
    servos = {(servo.kind.follows.position, servo.label) for servo in servo_map.servos}
    for name in dict.fromkeys(body.joint.signal for body in record.scene.bodies):
        wanted = [one for body in record.scene.bodies if body.joint.signal == name for one in body.joint.labels]
        missing = tuple(dict.fromkeys(label for label in wanted if (name, label) not in servos))
        if not missing:
            continue
        if name not in record or record.signals[name].axis != TIME or not set(missing) <= set(record.labels[name]):
            return None
        columns = [record.labels[name].index(label) for label in missing]
        found.add(name, record[name][:, columns], record.units[name], labels=missing, description=FOLLOWED)
    if GROUNDED in record:
        found.add(GROUNDED, record[GROUNDED], "1", labels=record.labels[GROUNDED], description=FOLLOWED)
    if servo_map.lifts is not None:
        added = wheel_offsets(record, servo_map)
        label = dict(zip(servo_map.joints, (servo.label for servo in servo_map.servos), strict=True))
        if added:
            data = np.column_stack(list(added.values()))
            found.add(LIFTING, data, "rad", labels=tuple(label[joint] for joint in added), description=FOLLOWED)
    return found


def describe(record: Record, scene: Scene | None, states: type[IntEnum], followed: Record | None = None) -> Record:
    """Add to a measured run what it is drawn from; the record itself is changed and given back.

    Every change of the signal ``state`` becomes an event. With a scene (that of the record that was followed) the poses
    of its bodies follow from the measured positions of its joints, and so does ``hand_position``;
    ``hand_position_goal`` is where the goals have the hand. What no servo measures is taken from the record that was
    ``followed``, see :func:`unmeasured`, and so says its description; a joint that is in neither leaves all poses out.
    """
    if len(record):
        for row in np.flatnonzero(np.diff(record["state"], prepend=-1)):
            record.add_event(record.time[row], "state", states(int(record["state"][row])).name)
    record.scene = scene
    if scene is None or not len(record):
        return record
    at, followed = _path_time(record), Record([0.0]) if followed is None else followed
    actual = _placed(record, scene, followed, at, "")
    if actual is None:
        return record
    on = " on the base of the record that was followed" if followed.signals else ""
    for name in (POSITION, ORIENTATION):
        pose = actual.signals[name]
        record.add(name, pose.data, pose.unit, labels=pose.labels, description=f"from measured joints{on}")
    for name in followed.signals:
        # Columns beside measured ones stay out: the record says of them only that they were measured.
        if name != LIFTING and name not in record:
            data = _at(followed, name, at)
            # A wheel is up or down.
            data = np.rint(data) if name == GROUNDED else data
            record.add(name, data, followed.units[name], labels=followed.labels[name], description=FOLLOWED)
    if scene.hand is None:
        return record
    axes = ("x", "y", "z")
    place = point_positions(actual, scene.hand)
    record.add("hand_position", place, "m", labels=axes, description=f"from joints{on}")
    if (goals := _placed(record, scene, followed, at, "_goal")) is not None:
        where = point_positions(goals, scene.hand)
        record.add("hand_position_goal", where, "m", labels=axes, description=f"from the goals of the joints{on}")
    return record


def _path_time(record: Record) -> Array:
    """Time in the record that was followed: its first instant before the motion began, the last one since it ended."""
    time = np.asarray(record["record_time"], dtype=np.float64) if "record_time" in record else record.time
    known = np.flatnonzero(np.isfinite(time))
    return np.interp(record.time, record.time[known], time[known]) if len(known) else np.zeros(len(record))


def _at(followed: Record, name: str, at: Array) -> Array:
    data = np.asarray(followed[name], dtype=np.float64)
    return np.column_stack([np.interp(at, followed.time, column) for column in data.T])


def _placed(record: Record, scene: Scene, followed: Record, at: Array, suffix: str) -> Record | None:
    """A record of the poses of all bodies, by measured joints or their goals (``suffix``); None where some lack."""
    found = Record(record.time)
    found.scene = scene
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
        found.add(name, np.column_stack(list(columns.values())), "rad", labels=tuple(columns))
    return found if add_body_poses(found) else None
