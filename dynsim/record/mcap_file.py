"""Export of a record to an MCAP file of ROS 2 messages for rosbag2, Foxglove, PlotJuggler and RViz, without ROS.

Topics: ``/joint_states``, ``/tf`` and ``/tf_static`` (each body, including a base, and each fixed frame relative to its
parent; the root is ``world``), ``/robot_description`` (see :mod:`dynsim.record.urdf_text`), and ``/contacts/NAME`` for
each contact point, with the force that the surface exerts on it. The frame ``contact_NAME`` of this force has the axes
of the world. Its origin is the point where the force acts (for a sphere or capsule the point of contact), so that the
torque is zero. If a body carries the surface, ``/contacts/NAME_on_BODY`` has the opposite force on this body.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.errors import RecordError
from dynsim.record.joint_motion import joint_motion
from dynsim.record.poses import contact_positions, relative_pose
from dynsim.record.quaternion import Array
from dynsim.record.record import Record
from dynsim.record.scene import WORLD
from dynsim.record.urdf_text import WORLD_LINK, fixed_frames, scene_urdf
from dynsim.system.files import replacing

# With this setting, late subscribers also receive the last message, as is usual in ROS 2 for descriptions and static
# frames.
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline: {sec: 2147483647, nsec: 4294967295}\n"
    "  lifespan: {sec: 2147483647, nsec: 4294967295}\n  liveliness: 1\n"
    "  liveliness_lease_duration: {sec: 2147483647, nsec: 4294967295}\n  avoid_ros_namespace_conventions: false\n"
)


def write_mcap(record: Record, path: Path) -> Path:
    """Write joint states, frames, contact forces and the robot description at all samples of a record.

    Time zero is the first sample. ``effort`` is the joint torque; it is NaN for joints without a motor, and empty if no
    joint has one.

    Parameters
    ----------
    record : Record
        Record with joint positions and rates.
    path : Path
        File to write.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    RecordError
        If the required packages are not installed, the record has no joint motion, or the file cannot be written.
    """
    # Optional packages, which take a second to import.
    try:
        writer_module = importlib.import_module("mcap.writer")
        typesys = importlib.import_module("rosbags.typesys")
    except ImportError as error:
        raise RecordError(f"MCAP files require mcap and rosbags: pip install 'dynsim[ros]' ({error})") from error
    with replacing(path) as stream:
        bag = _Bag(writer_module.Writer(stream), typesys.get_typestore(typesys.Stores.ROS2_JAZZY))
        bag.writer.start(profile="ros2", library=f"dynsim {__version__}")
        for time, topic, kind, message in sorted(_messages(record, bag), key=lambda entry: entry[0]):
            bag.write(time, topic, kind, message)
        bag.writer.finish()
    return path


class _Bag:
    """Writer that creates messages by type name and writes each to the channel of its topic."""

    def __init__(self, writer: Any, types: Any) -> None:
        self.writer, self._types = writer, types
        self._channels: dict[str, int] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        return self._types.types[kind](**fields)

    def header(self, nanoseconds: int, frame: str) -> Any:
        seconds, nanosec = divmod(nanoseconds, 1_000_000_000)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def write(self, time: int, topic: str, kind: str, message: Any) -> None:
        if topic not in self._channels:
            text, _ = self._types.generate_msgdef(kind, ros_version=2)
            schema = self.writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
            latched = {"offered_qos_profiles": _LATCHED} if topic in ("/robot_description", "/tf_static") else {}
            self._channels[topic] = self.writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=schema, metadata=latched
            )
        data = bytes(self._types.serialize_cdr(message, kind))
        self.writer.add_message(channel_id=self._channels[topic], log_time=time, publish_time=time, data=data)


def _messages(record: Record, bag: _Bag) -> list[tuple[int, str, str, Any]]:
    """Return all messages as tuples of time [ns], topic, type and content."""
    labels, time, position, velocity = joint_motion(record)
    stamps = np.rint(time * 1e9).astype(np.int64).tolist()
    # Joints have the names of the description; the pose of a joint with several rates, such as a base, is a transform.
    names = _joint_names(record, labels)
    columns, joints = [k for k, label in enumerate(labels) if label in names], list(names.values())
    position, velocity = position[:, columns], velocity[:, columns]
    effort = np.zeros((len(time), 0))
    if "torque" in record:
        torque = dict(zip(record.labels["torque"], record["torque"].T, strict=True))
        missing = np.full(len(time), np.nan)
        if torque.keys() & names.keys():
            effort = np.stack([torque.get(label, missing) for label in names], axis=1)
    kind = "sensor_msgs/msg/JointState"
    messages: list[tuple[int, str, str, Any]] = []
    for k, stamp in enumerate(stamps):
        state = bag.make(
            kind,
            header=bag.header(stamp, ""),
            name=joints,
            position=np.ascontiguousarray(position[k]),
            velocity=np.ascontiguousarray(velocity[k]),
            effort=np.ascontiguousarray(effort[k]),
        )
        messages.append((stamp, "/joint_states", kind, state))
    return messages + _frames(record, bag, stamps) + _forces(record, bag, stamps)


def _joint_names(record: Record, labels: list[str]) -> dict[str, str]:
    """Return the joint names of the robot description by label, for the joints with one position."""
    if record.scene is None or not record.scene.bodies:
        return {label: label for label in labels}
    joints = [record.scene.bodies[rows[0]].joint for rows in record.scene.rows.values() if len(rows) == 1]
    names = {joint.labels[0]: joint.name for joint in joints if len(joint.labels) == 1}
    return {label: names[label] for label in labels if label in names}


def _frames(record: Record, bag: _Bag, stamps: list[int]) -> list[tuple[int, str, str, Any]]:
    """Return the robot description and the frames of bodies and contact points; the list is empty without a scene."""
    scene = record.scene
    if scene is None or not scene.bodies:
        return []
    robot = str(record.provenance.get("scenario", {}).get("name", "robot"))
    text = "std_msgs/msg/String"
    first = stamps[0]
    messages = [(first, "/robot_description", text, bag.make(text, data=scene_urdf(scene, robot)))]
    kind = "tf2_msgs/msg/TFMessage"
    moving: list[tuple[str, str, Array, Array]] = []
    names = [body.name for body in scene.bodies] + [WORLD_LINK]  # WORLD is -1
    fixed = [
        _transform(bag, first, names[frame.body], frame.name, np.array(frame.position), np.array(frame.orientation))
        for frame in fixed_frames(scene)
    ]
    for last, rows in scene.rows.items():
        parent = names[scene.bodies[rows[0]].parent]
        p, q = relative_pose(record, [scene.bodies[k] for k in rows])
        if all(scene.bodies[k].joint.kind == "fixed" for k in rows):
            fixed.append(_transform(bag, first, parent, names[last], p[:, 0], q[:, 0]))
        else:
            moving.append((parent, names[last], p, q))
    unturned = np.array([1.0, 0.0, 0.0, 0.0])
    for point in scene.contacts if "body_position" in record else ():
        at = contact_positions(record, point).T
        turn = np.broadcast_to(unturned[:, None], (4, len(stamps)))
        moving.append((WORLD_LINK, f"contact_{point.name}", at, turn))
    if fixed:
        messages.append((first, "/tf_static", kind, bag.make(kind, transforms=fixed)))
    for k, stamp in enumerate(stamps):
        transforms = [_transform(bag, stamp, parent, child, p[:, k], q[:, k]) for parent, child, p, q in moving]
        messages.append((stamp, "/tf", kind, bag.make(kind, transforms=transforms)))
    return messages


def _transform(bag: _Bag, stamp: int, parent: str, child: str, p: Array, q: Array) -> Any:
    x, y, z = p.tolist()
    w, i, j, k = q.tolist()
    return bag.make(
        "geometry_msgs/msg/TransformStamped",
        header=bag.header(stamp, parent),
        child_frame_id=child,
        transform=bag.make(
            "geometry_msgs/msg/Transform",
            translation=bag.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=bag.make("geometry_msgs/msg/Quaternion", x=i, y=j, z=k, w=w),
        ),
    )


def _forces(record: Record, bag: _Bag, stamps: list[int]) -> list[tuple[int, str, str, Any]]:
    """Return the contact forces as wrenches."""
    if "contact_force" not in record:
        return []
    kind, vector = "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Vector3"
    nothing = bag.make(vector, x=0.0, y=0.0, z=0.0)
    messages = []
    scene = record.scene
    points = () if scene is None else scene.contacts
    carriers = {point.name: scene.bodies[point.carrier].name for point in points if scene and point.carrier != WORLD}
    for label, forces in zip(record.labels["contact_force"], record["contact_force"].swapaxes(0, 1), strict=True):
        wrenches = {label: forces}
        if label in carriers:
            wrenches[f"{label}_on_{carriers[label]}"] = -forces
        for name, values in wrenches.items():
            topic = f"/contacts/{re.sub(r'[^A-Za-z0-9_]', '_', name)}"
            for stamp, (x, y, z) in zip(stamps, values.tolist(), strict=True):
                wrench = bag.make("geometry_msgs/msg/Wrench", force=bag.make(vector, x=x, y=y, z=z), torque=nothing)
                message = bag.make(kind, header=bag.header(stamp, f"contact_{label}"), wrench=wrench)
                messages.append((stamp, topic, kind, message))
    return messages
