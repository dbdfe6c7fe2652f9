"""What makes a measured record one that describes itself: the scene of the record that was followed, poses, events."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from dynsim.record import Record
from dynsim.record.poses import add_body_poses, point_positions
from dynsim.record.scene import Scene


def describe(record: Record, scene: Scene | None, states: type[IntEnum]) -> Record:
    """Add to a measured run what it is drawn from; the record itself is changed and given back.

    Every change of the signal ``state`` becomes an event. With a scene (that of the record that was followed), and
    where all its joints were measured, the poses of its bodies follow from the measured positions, and so does
    ``hand_position``; ``hand_position_goal`` is where the goals have the hand.
    """
    if len(record):
        for row in np.flatnonzero(np.diff(record["state"], prepend=-1)):
            record.add_event(record.time[row], "state", states(int(record["state"][row])).name)
    record.scene = scene
    if scene is None or not add_body_poses(record) or scene.hand is None:
        return record
    axes = ("x", "y", "z")
    record.add("hand_position", point_positions(record, scene.hand), "m", labels=axes, description="from joints")
    goals = Record(record.time)
    goals.scene = scene
    for name in dict.fromkeys(body.joint.signal for body in scene.bodies):
        if f"{name}_goal" in record:
            goals.add(name, record[f"{name}_goal"], record.units[name], labels=record.labels[f"{name}_goal"])
    if add_body_poses(goals):
        where = point_positions(goals, scene.hand)
        record.add("hand_position_goal", where, "m", labels=axes, description="from the goals of the joints")
    return record
