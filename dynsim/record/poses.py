"""Poses of bodies and points over time, computed from the scene and the joint positions of a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.record.content import TIME
from dynsim.record.quaternion import Array, continuous, of_turn, product, rotated
from dynsim.record.record import Record
from dynsim.record.scene import HERE, WORLD, Body, Joint, Point, Scene

POSITION, ORIENTATION, TOUCHING, NORMAL = "body_position", "body_orientation", "contact_position", "contact_normal"


def add_body_poses(record: Record) -> bool:
    """Add the poses of all bodies over time as signals; return False if the positions of a joint were not recorded.

    The signals are ``body_position`` (T, bodies, 3) [m] and ``body_orientation`` (T, bodies, 4), quaternions w, x, y, z
    without sign jumps. Both are in single precision (0.1 µm at 1 m), which is enough for drawing. They can be computed
    in double precision from the scene and the joint positions.
    """
    scene = record.scene
    if scene is None or not scene.bodies or not all(_recorded(record, body.joint) for body in scene.bodies):
        return False
    columns = {body.joint.signal: _columns(record, body.joint.signal) for body in scene.bodies}
    names = tuple(body.name for body in scene.bodies)
    position = np.empty((len(names), 3, len(record)), dtype=np.float32)
    orientation = np.empty((len(names), 4, len(record)), dtype=np.float32)
    # Poses of bodies whose children are still to be computed.
    known: dict[int, tuple[Array, Array]] = {}
    last_child = {body.parent: k for k, body in enumerate(scene.bodies)}
    # The last samples of a diverging run may overflow.
    with np.errstate(over="ignore", invalid="ignore"):
        for k, body in enumerate(scene.bodies):
            moved = np.array([columns[body.joint.signal][label] for label in body.joint.labels])
            p, q = _pose(body, moved, known.get(body.parent), (len(record),))
            if last_child[body.parent] == k:
                known.pop(body.parent, None)
            if k in last_child:
                known[k] = p, q
            position[k], orientation[k] = p, continuous(q)
    data = np.ascontiguousarray(position.transpose(2, 0, 1)), np.ascontiguousarray(orientation.transpose(2, 0, 1))
    record.add(POSITION, data[0], "m", labels=names, description="origins of the bodies' frames")
    record.add(ORIENTATION, data[1], "1", labels=names, description="quaternions w, x, y, z of the bodies' frames")
    return True


def poses_at(scene: Scene, positions: Mapping[str, Mapping[str, float]]) -> Array:
    """Return the poses of all bodies at one time, (bodies, 7) [m, 1]: position, quaternion w, x, y, z.

    Parameters
    ----------
    scene : Scene
        Scene with the bodies.
    positions : mapping
        Joint positions [rad or m] by signal and label.
    """
    poses: list[tuple[Array, Array]] = []
    for body in scene.bodies:
        moved = np.array([positions[body.joint.signal][label] for label in body.joint.labels])
        poses.append(_pose(body, moved, None if body.parent == WORLD else poses[body.parent], ()))
    return np.array([np.concatenate(pose) for pose in poses])


def relative_pose(record: Record, chain: Sequence[Body]) -> tuple[Array, Array]:
    """Return the pose of the last body of a chain relative to the parent of the first: (3, T) [m], and (4, T).

    Raises
    ------
    MissingEntry
        If the record does not contain the positions of a body's joint.
    """
    pose: tuple[Array, Array] | None = None
    for body in chain:
        columns = _columns(record, body.joint.signal) if body.joint.labels else {}
        pose = _pose(body, np.array([columns[label] for label in body.joint.labels]), pose, (len(record),))
    assert pose is not None
    return pose


def pose_columns(bodies: int) -> int:
    """Return the number of 8-byte columns that the poses of ``bodies`` bodies need (seven 4-byte numbers each)."""
    return -(-7 * bodies // 2)


def point_positions(record: Record, point: Point, rows: slice | int | NDArray[np.intp] = slice(None)) -> Array:
    """Return the world positions of a point on a body, (…, 3) [m].

    Parameters
    ----------
    record : Record
        Record with body poses.
    point : Point
        Point in the scene of the record.
    rows : slice, int or ndarray of int, optional
        Samples; default: all.

    Raises
    ------
    MissingEntry
        If the record has no body poses.
    """
    where = np.array(point.position)
    origin, turn = record[POSITION][rows], record[ORIENTATION][rows]
    if point.body == WORLD:
        return np.broadcast_to(where, (*origin.shape[:-2], 3))
    q = turn[..., point.body, :].astype(np.float64)
    return np.asarray(origin[..., point.body, :] + np.moveaxis(rotated(np.moveaxis(q, -1, 0), where), 0, -1))


def contact_positions(record: Record, point: Point, rows: slice | int | NDArray[np.intp] = slice(None)) -> Array:
    """Return the positions at which the contact force acts on a contact point, (…, 3) [m].

    For a sphere or capsule, this is the point that is nearest to the surface. Records of older versions contain only
    the centre of a sphere and one end of a capsule.

    Raises
    ------
    MissingEntry
        If the record has no body poses.
    """
    if TOUCHING in record and point.name in record.labels[TOUCHING]:
        return np.asarray(record[TOUCHING][rows, record.labels[TOUCHING].index(point.name)], dtype=np.float64)
    return point_positions(record, point, rows)


def _recorded(record: Record, joint: Joint) -> bool:
    signal = record.signals.get(joint.signal)
    return signal is not None and signal.axis == TIME and set(joint.labels) <= set(signal.labels)


def _columns(record: Record, name: str) -> dict[str, Array]:
    return dict(zip(record.labels[name], record[name].T, strict=True))


def _pose(body: Body, moved: Array, parent: tuple[Array, Array] | None, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return position, (3, …), and orientation, (4, …), of a body from the pose of its parent.

    Parameters
    ----------
    moved : (k, …) ndarray
        Positions of the body's joint [rad or m].
    shape : tuple of int
        Shape of the time dimension: () for one time, (T,) for all samples.
    """
    joint = body.joint
    p, q = parent or (np.zeros((3, *shape)), np.array([np.ones(shape), *np.zeros((3, *shape))]))
    p = p + rotated(q, np.array(joint.position))
    if joint.orientation != HERE:
        q = product(q, np.array(joint.orientation))
    if joint.kind == "ball":
        q = product(q, moved / np.sqrt((moved * moved).sum(axis=0)))
    elif joint.kind == "prismatic":
        p = p + rotated(q, np.multiply.outer(np.array(joint.axis), moved[0]))
    elif joint.kind == "planar":
        p = p + rotated(q, np.array([moved[0], moved[1], np.zeros(shape)]))
        q = product(q, of_turn((0.0, 0.0, 1.0), moved[2]))
    elif joint.kind == "revolute":
        q = product(q, of_turn(joint.axis, moved[0]))
    return p, q
