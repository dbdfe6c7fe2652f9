"""Where bodies and points were: from the scene of a record and the positions of its joints."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.record.content import TIME
from dynsim.record.quaternion import Array, continuous, of_turn, product, rotated
from dynsim.record.record import Record
from dynsim.record.scene import HERE, WORLD, Body, Joint, Point, Scene

POSITION, ORIENTATION = "body_position", "body_orientation"


def add_body_poses(record: Record) -> bool:
    """Add the poses of all bodies of the scene over time as signals; False where a joint was not recorded.

    ``body_position`` (T, bodies, 3) [m], ``body_orientation`` (T, bodies, 4): quaternions w, x, y, z whose signs do not
    jump. In single precision, which is a tenth of a micrometre at a metre: they are to be drawn, and follow from the
    scene and the joints' positions to the last digit.
    """
    scene = record.scene
    if scene is None or not scene.bodies or not all(_recorded(record, body.joint) for body in scene.bodies):
        return False
    columns = {body.joint.signal: _columns(record, body.joint.signal) for body in scene.bodies}
    names = tuple(body.name for body in scene.bodies)
    position = np.empty((len(names), 3, len(record)), dtype=np.float32)
    orientation = np.empty((len(names), 4, len(record)), dtype=np.float32)
    # Those of bodies that carry others yet to come.
    known: dict[int, tuple[Array, Array]] = {}
    left = np.bincount([body.parent for body in scene.bodies if body.parent != WORLD], minlength=len(names))
    # The last samples of a run that diverged may be beyond all bounds.
    with np.errstate(over="ignore", invalid="ignore"):
        for k, body in enumerate(scene.bodies):
            p, q = _pose(body, len(record), columns[body.joint.signal], known.get(body.parent))
            if body.parent != WORLD:
                left[body.parent] -= 1
                if not left[body.parent]:
                    del known[body.parent]
            if left[k]:
                known[k] = p, q
            position[k], orientation[k] = p, continuous(q)
    data = np.ascontiguousarray(position.transpose(2, 0, 1)), np.ascontiguousarray(orientation.transpose(2, 0, 1))
    record.add(POSITION, data[0], "m", labels=names, description="origins of the bodies' frames")
    record.add(ORIENTATION, data[1], "1", labels=names, description="quaternions w, x, y, z of the bodies' frames")
    return True


def poses_at(scene: Scene, positions: Mapping[str, Mapping[str, float]]) -> Array:
    """Poses of all bodies at one instant, (bodies, 7) [m, 1]: position, quaternion w, x, y, z.

    For live views: in plain numbers, because arrays of one sample would take twenty times as long. ``positions`` are
    those of the joints [rad or m], by signal and label.
    """
    found: list[tuple[float, ...]] = []
    for body in scene.bodies:
        joint = body.joint
        x, y, z, *turn = (0.0, 0.0, 0.0, *HERE) if body.parent == WORLD else found[body.parent]
        moved = [positions[joint.signal][label] for label in joint.labels]
        x, y, z = _beside((x, y, z), turn, joint.position)
        if joint.orientation != HERE:
            turn = _turned(turn, joint.orientation)
        if joint.kind == "ball":
            size = math.hypot(*moved)
            turn = _turned(turn, [value / size for value in moved])
        elif joint.kind == "prismatic":
            x, y, z = _beside((x, y, z), turn, [moved[0] * a for a in joint.axis])
        elif joint.kind == "planar":
            x, y, z = _beside((x, y, z), turn, (moved[0], moved[1], 0.0))
            turn = _turned(turn, (math.cos(0.5 * moved[2]), 0.0, 0.0, math.sin(0.5 * moved[2])))
        elif joint.kind != "fixed":
            s = math.sin(0.5 * moved[0])
            turn = _turned(turn, (math.cos(0.5 * moved[0]), *(s * a for a in joint.axis)))
        found.append((x, y, z, *turn))
    return np.array(found)


def _turned(a: Sequence[float], b: Sequence[float]) -> list[float]:
    """The turn b, then the turn a; see :func:`dynsim.record.quaternion.product`."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def _beside(place: Sequence[float], turn: Sequence[float], vector: Sequence[float]) -> tuple[float, float, float]:
    """A place and a vector in axes that are turned; see :func:`dynsim.record.quaternion.rotated`."""
    (w, i, j, k), (x, y, z) = turn, vector
    a, b, c = 2.0 * (j * z - k * y), 2.0 * (k * x - i * z), 2.0 * (i * y - j * x)
    return (
        place[0] + x + w * a + j * c - k * b,
        place[1] + y + w * b + k * a - i * c,
        place[2] + z + w * c + i * b - j * a,
    )


def pose_columns(bodies: int) -> int:
    """How many columns of 8 bytes the poses of so many bodies take: seven numbers of 4 bytes each."""
    return -(-7 * bodies // 2)


def point_positions(record: Record, point: Point, rows: slice | int | NDArray[np.intp] = slice(None)) -> Array:
    """World positions of a point on a body at samples of a record with body poses, (…, 3) [m].

    Raises
    ------
    MissingEntry
        The record has no body poses.
    """
    where = np.array(point.position)
    origin, turn = record[POSITION][rows], record[ORIENTATION][rows]
    if point.body == WORLD:
        return np.broadcast_to(where, (*origin.shape[:-2], 3))
    q = turn[..., point.body, :].astype(np.float64)
    return np.asarray(origin[..., point.body, :] + np.moveaxis(rotated(np.moveaxis(q, -1, 0), where), 0, -1))


def _recorded(record: Record, joint: Joint) -> bool:
    signal = record.signals.get(joint.signal)
    return signal is not None and signal.axis == TIME and set(joint.labels) <= set(signal.labels)


def _columns(record: Record, name: str) -> dict[str, Array]:
    return dict(zip(record.labels[name], record[name].T, strict=True))


def _pose(body: Body, count: int, columns: dict[str, Array], parent: tuple[Array, Array] | None) -> tuple[Array, Array]:
    """Position, (3, T), and orientation, (4, T), of a body at T = ``count`` samples from those of its parent."""
    joint = body.joint
    moved = [columns[label] for label in joint.labels]
    here = np.zeros((4, count))
    here[0] = 1.0
    p, q = (np.zeros((3, count)), here) if parent is None else parent
    p = p + rotated(q, np.array(joint.position))
    if joint.orientation != HERE:
        q = product(q, np.array(joint.orientation))
    if joint.kind == "fixed":
        return p, q
    if joint.kind == "ball":
        turn = np.stack(moved)
        return p, product(q, turn / np.sqrt((turn * turn).sum(axis=0)))
    if joint.kind == "prismatic":
        return p + rotated(q, np.multiply.outer(np.array(joint.axis), moved[0])), q
    if joint.kind == "planar":
        p = p + rotated(q, np.stack([moved[0], moved[1], np.zeros_like(moved[0])]))
        return p, product(q, of_turn((0.0, 0.0, 1.0), moved[2]))
    return p, product(q, of_turn(joint.axis, moved[0]))
