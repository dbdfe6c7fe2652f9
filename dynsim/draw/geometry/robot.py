"""Moving robot in a record, for pages and films: bodies, wheels, surfaces, poses, paths, contacts, penetrations."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.draw.geometry.meshes import Meshes
from dynsim.draw.geometry.shapes import body_shapes, drawn_shapes, floor_level, gripper, solid, surface_solid
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.record.measures import hand_target
from dynsim.record.poses import NORMAL, ORIENTATION, POSITION, TOUCHING, contact_positions, point_positions
from dynsim.record.quaternion import rotated
from dynsim.record.scene import HERE, NOT_BELOW, WORLD, Point, Scene, Vector3

Array = NDArray[np.float64]
# Maximum error of poses interpolated between the frames of a page [m].
POSE_ERROR = 4e-5
# Maximum number of frames in a page; longer runs have fewer frames than POSE_ERROR requires.
FRAMES = 20_000
# Longest interval between frames, in samples; it limits the time for choosing them.
LONGEST = 256
WORLD_AXES = np.eye(3)
HERE_POINT: Vector3 = (0.0, 0.0, 0.0)
# The extent of a solid is measured along these directions, at no more than so many samples.
DIRECTIONS = np.array([step for step in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(step)])
SAMPLES = 200
# Margin around the robot in which surfaces extend the view, relative to the longest edge of the box of the robot.
SURROUNDINGS = 0.25


def robots(records: Mapping[str, Record]) -> dict[str, DrawnRobot]:
    """Return the robots of all records that can be shown, with the names of the records.

    Raises
    ------
    RecordError
        If no record has samples and a scene with body poses.
    """
    drawn = {name: robot for name, record in records.items() if (robot := robot_of(record)) is not None}
    if not drawn:
        raise RecordError("no record can be viewed: a record needs samples, a scene, and the poses of its bodies")
    return drawn


@dataclass(frozen=True)
class DrawnRobot:
    """Record with body poses, and the samples that become frames of the page."""

    record: Record
    scene: Scene
    rows: NDArray[np.intp]
    reach: float

    @cached_property
    def extremes(self) -> list[Array]:
        """Outermost corners of the solids of each body in its frame, and of all fixed solids, (n, 3) [m] each."""
        meshes = Meshes()
        meshes.of_robot(self.scene)
        shapes = body_shapes(self.scene, self.reach, meshes)
        hand = self.scene.hand
        if hand is not None and hand.body != WORLD and gripping(self.record) is not None:
            both = gripper(shapes, self.scene, self.reach)
            length, width, height = both["size"]
            position = (np.array(hand.position) + np.array([both["ahead"], 0.0, 0.0])).tolist()
            size = [length, width + 2.0 * both["aside"][0], height]
            shapes[hand.body].append({"kind": "box", "size": size, "p": position, "q": list(HERE)})
        shapes.append(drawn_shapes(self.scene.fixed, meshes))
        clouds = [np.concatenate([np.zeros((0, 3)), *(solid(s, meshes.unique)[0] for s in own)]) for own in shapes]
        return [cloud[np.unique((cloud @ DIRECTIONS.T).argmax(axis=0))] if len(cloud) else cloud for cloud in clouds]


def gripping(record: Record) -> Array | None:
    """Return the state of the gripper, (T,): the number of the state, or 1 if closed; None without a gripper."""
    if record.scene is None or record.scene.grip is None:
        return None
    return next((record[name] for name in ("gripper_state", "gripper") if name in record), None)


def placed(record: Record) -> tuple[Scene | None, str]:
    """Return the scene of a record with body poses, or None and the reason why it cannot be used."""
    scene = record.scene
    if scene is None or not scene.bodies:
        return None, "the record has no scene"
    if POSITION not in record or ORIENTATION not in record:
        return None, "some joints were not recorded"
    if record[POSITION].shape != (len(record), len(scene.bodies), 3):
        return None, "the bodies of scene and record differ"
    return scene, ""


def robot_of(record: Record) -> DrawnRobot | None:
    """Return the robot of a record, or None without samples, scene or body poses."""
    scene, _ = placed(record)
    if scene is None or not len(record):
        return None
    position = record[POSITION][np.isfinite(record[POSITION]).all(axis=(1, 2))]
    if not len(position):
        return None
    ends = [position[0], *(point_positions(record, p, 0)[None] for p in scene.points)]
    known = np.concatenate(ends)
    reach = float(np.ptp(known[np.isfinite(known).all(axis=1)], axis=0).max(initial=0.0)) or 0.5
    return DrawnRobot(record, scene, _frames(record, scene), reach)


def _frames(record: Record, scene: Scene) -> NDArray[np.intp]:
    """Return the samples whose interpolation shows all bodies to ``POSE_ERROR``, and their rotation to 0.1 mrad."""
    arms = np.array([_arm(scene, k) for k in range(len(scene.bodies))], dtype=np.float32)
    turns = 2.0 * arms[:, None] * record[ORIENTATION]
    data = np.concatenate([record[POSITION], turns], axis=2).reshape(len(record), -1) / np.float32(POSE_ERROR)
    return knots(record.time, data, FRAMES)


def _arm(scene: Scene, k: int) -> float:
    """Return the distance from the origin of a body to its drawn parts [m], from 0.2 to 1 m."""
    ends = [point.position for point in scene.points if point.body == k]
    ends += [load.position for load in scene.payloads if load.body == k]
    ends += [body.joint.position for body in scene.bodies if body.parent == k]
    far = [math.hypot(*end) for end in ends]
    for shape in scene.bodies[k].shapes:
        far.append(math.hypot(*shape.position) + max(shape.size) if shape.kind != "mesh" else 1.0)
    return min(max(0.2, *far, 0.0), 1.0)


def knots(time: Array, data: NDArray[Any], most: int | None = None) -> NDArray[np.intp]:
    """Return rows from which linear interpolation reproduces all rows to within 1 (Ramer, Douglas and Peucker).

    Parameters
    ----------
    time : (T,) ndarray
        Times of the rows [s].
    data : (T, n) ndarray
        Values relative to their tolerances.
    most : int, optional
        Maximum number of rows, beyond which the tolerance is doubled.
    """
    count, data = len(time), np.nan_to_num(data, nan=1e6, posinf=1e6, neginf=-1e6)
    error = 1.0
    while True:
        rows = np.unique([*range(0, count, max(LONGEST, 4 * count // (most or count))), count - 1])
        kept, spans = set(rows.tolist()), list(zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True))
        while spans and (most is None or len(kept) <= most):
            a, b = spans.pop()
            if b - a < 2:
                continue
            share = ((time[a + 1 : b] - time[a]) / (time[b] - time[a]))[:, None].astype(data.dtype)
            off = np.abs(data[a + 1 : b] - (data[a] + share * (data[b] - data[a]))).max(axis=1, initial=0.0)
            k = int(off.argmax())
            if off[k] > error:
                kept.add(middle := a + 1 + k)
                spans += [(a, middle), (middle, b)]
        if not spans:
            return np.array(sorted(kept))
        error *= 2.0


def bounds(robots: Sequence[DrawnRobot], axes: Array = WORLD_AXES, points: Array | None = None) -> tuple[Array, Array]:
    """Return the corners, (3,) and (3,) [m], of the box along ``axes``, (3, 3), in which everything moves.

    ``points`` is the result of :func:`moving`, if it is known.
    """
    pooled = (moving(robots) if points is None else points) @ axes.T
    low, high = pooled.min(axis=0), pooled.max(axis=0)
    # A robot that hardly moves must not fill the window, and a flat scene needs some depth.
    span, reach = float((high - low).max()), max(robot.reach for robot in robots)
    smallest = max(0.24 * span, 0.6 * reach if span < 0.6 * reach else 0.0)
    room = np.maximum(0.5 * (smallest - (high - low)), 0.0) + 0.03 * smallest
    return low - room, high + room


def framed(robots: Sequence[DrawnRobot], axes: Array) -> tuple[Array, Array]:
    """Return the box along ``axes`` of everything that moves and of the surfaces next to it, as for :func:`bounds`."""
    points = moving(robots)
    low, high = bounds(robots, points=points)
    room = SURROUNDINGS * float((high - low).max())
    corners = [np.stack(bounds(robots, axes, points))]
    for surface in {surface for robot in robots for surface in robot.scene.surfaces}:
        if abs(surface.radius or 0.0) > 4.0 * room:
            continue  # only a part of it is drawn, behind the robot
        if (level := floor_level(surface)) is None:
            shown = np.clip(surface_solid(surface, low, high)[0], low - room, high + room)
            corners.append(shown[np.isfinite(shown).all(axis=1)] @ axes.T)
        elif low[2] - room <= level <= high[2]:
            corners.append(np.array([[*(0.5 * (low + high))[:2], level]]) @ axes.T)
    pooled = np.concatenate(corners)
    return pooled.min(axis=0), pooled.max(axis=0)


def moving(robots: Sequence[DrawnRobot]) -> Array:
    """Return positions of the solids of all bodies, of the hand and its target, and of fixed solids, (n, 3) [m]."""
    points = []
    for robot in robots:
        record = robot.record
        clouds = [
            record[POSITION].reshape(-1, 3).astype(np.float64),
            *(path for _, path in paths(record, robot.scene)),
        ]
        rows = robot.rows[:: -(-len(robot.rows) // SAMPLES)]
        origins, turns = (np.moveaxis(record[name][rows].astype(np.float64), -1, 0) for name in (POSITION, ORIENTATION))
        *bodies, fixed = robot.extremes
        for k, corners in enumerate(bodies):
            turned = rotated(turns[:, :, k, None], np.broadcast_to(corners.T[:, None], (3, len(rows), len(corners))))
            clouds.append(np.reshape(origins[:, :, k, None] + turned, (3, -1)).T)
        # The last samples of a diverging run are far away from all other samples.
        points += clouds if record.complete else [_without_ends(cloud) for cloud in clouds]
        points.append(fixed)
    pooled = np.concatenate(points)
    return np.asarray(pooled[np.isfinite(pooled).all(axis=1)])


def _without_ends(points: Array) -> Array:
    """Clip points, (T, 3), to the 1st and 99th percentile along each axis."""
    points = points[np.isfinite(points).all(axis=1)]
    return np.clip(points, *np.percentile(points, (1.0, 99.0), axis=0)) if len(points) else points


def azimuth(robots: Sequence[DrawnRobot]) -> float:
    """Return the horizontal direction of the largest extent of robot and hand path, (−π/2, π/2] about z [rad].

    The viewing direction of the page is perpendicular to this direction.
    """
    clouds = []
    for robot in robots:
        some = slice(None, None, max(1, len(robot.record) // 2000))
        clouds.append(robot.record[POSITION][some, :, :2].reshape(-1, 2).astype(np.float64))
        clouds += [path[some, :2] for _, path in paths(robot.record, robot.scene)]
    points = np.concatenate(clouds)
    points = points[np.isfinite(points).all(axis=1)]
    spread = points - points.mean(axis=0)
    x, y = np.linalg.eigh(spread.T @ spread)[1][:, 1].tolist()
    return math.atan2(y, x) if x > 0.0 or (x == 0.0 and y > 0.0) else math.atan2(-y, -x)


def paths(record: Record, scene: Scene) -> Iterator[tuple[str, Array]]:
    """Yield the paths of the hand and of its target, if known, (T, 3) [m] each."""
    if scene.hand is not None:
        yield "hand", np.asarray(point_positions(record, scene.hand), dtype=np.float64)
    target = hand_target(record)
    if target is None and "w_target" in record:
        target = record["w_target"][:, :3]
    if target is not None:
        yield "target", np.asarray(target, dtype=np.float64)


@dataclass(frozen=True)
class DrawnContact:
    """Contact point over time.

    Attributes
    ----------
    point : Point
        Point of the scene.
    normal : (T, 3) ndarray
        Unit vectors into the free side.
    force : (T,) ndarray
        Normal force [N], positive if the surface pushes.
    tangent : (T, 3) ndarray or None
        Tangential force [N], if recorded.
    mode : (T,) ndarray or None
        Mode under the unilateral law: 0 open, 1 sliding, 2 sticking.
    at : (T, 3) ndarray or None
        Position at which the force acts on a sphere or capsule [m]; None: the force acts at the point itself.
    """

    point: Point
    normal: Array
    force: Array
    tangent: Array | None
    mode: Array | None
    at: Array | None


def contacts(
    robot: DrawnRobot, rows: NDArray[np.intp] | slice = slice(None), open_too: bool = False
) -> list[DrawnContact]:
    """Return the contact points at samples of the record; without ``open_too`` only points that ever touched."""
    record, scene = robot.record, robot.scene
    if "contact_normal_force" not in record:
        return []
    names = record.labels["contact_normal_force"]
    result = []
    for point in scene.contacts:
        surface, normals = scene.surface(point.surface), record.labels.get(NORMAL, ())
        carried = point.name in normals
        if (surface is None and not carried) or point.name not in names:
            continue
        k = names.index(point.name)
        mode = record["contact_mode"][rows, k] if "contact_mode" in record else None
        if mode is not None and not mode.any() and not open_too:
            continue
        at = np.asarray(contact_positions(record, point, rows), dtype=np.float64)
        if carried:
            normal = np.asarray(record[NORMAL][rows, normals.index(point.name)], dtype=np.float64)
        else:
            assert surface is not None
            normal = surface.normal(at)
        force = np.asarray(record["contact_normal_force"][rows, k], dtype=np.float64)
        tangent = None
        if "contact_force" in record:
            tangent = record["contact_force"][rows, k] - force[:, None] * normal
        shaped = carried or (TOUCHING in record and point.name in record.labels[TOUCHING])
        result.append(DrawnContact(point, normal, force, tangent, mode, at if shaped else None))
        if point.carrier != WORLD:  # the reaction on the other body
            other = replace(point, name=reaction_name(scene, point), body=point.carrier)
            result.append(DrawnContact(other, -normal, force, None if tangent is None else -tangent, mode, at))
    return result


def reaction_name(scene: Scene, point: Point) -> str:
    """Return the name of the opposite force of a contact, on the body that carries the surface."""
    return f"{point.name} on {scene.bodies[point.carrier].name}"


@dataclass(frozen=True)
class Penetration:
    """Joint or hand that was below a surface by more than the radius of its link.

    Attributes
    ----------
    name, surface : str
        Names of the point and of the surface.
    body, position : int, tuple of float
        Index of the body, and point in its frame [m].
    least : float
        Smallest depth that counts as a penetration [m]: the radius plus the resolution of the poses.
    depth : (T,) ndarray
        Depth below the surface [m], negative above it.
    """

    name: str
    surface: str
    body: int
    position: Vector3
    least: float
    depth: Array


def penetrations(record: Record, scene: Scene, rows: NDArray[np.intp] | slice = slice(None)) -> list[Penetration]:
    """Return the joints, and the hand, that are below surfaces at samples of the record.

    This can happen because surfaces support only declared contact points. Bodies of a mobile base and wheels are
    excluded.
    """
    wheels = {k for k, body in enumerate(scene.bodies) if body.joint.signal == "rho"} | set(scene.base)
    points = [(scene.bodies[k].joint.name, k, HERE_POINT) for k in scene.rows if k not in wheels]
    if scene.hand is not None and scene.hand.body != WORLD:
        points.append((scene.hand.name, scene.hand.body, scene.hand.position))
    below = []
    for name, k, position in points:
        positions = np.asarray(point_positions(record, Point(name, "hand", k, position), rows), dtype=np.float64)
        allowed = scene.bodies[k].radius + NOT_BELOW
        for surface in scene.surfaces:
            with np.errstate(all="ignore"):
                depth = -surface.gap(positions)
            if (depth > allowed).any():
                below.append(Penetration(name, surface.name, k, position, allowed, depth))
    return below


def largest_force(contacts: Sequence[DrawnContact]) -> float:
    """Return the force whose arrow has full length [N]: the 98th percentile, so that peaks do not shrink the others."""
    sizes = np.abs(np.concatenate([contact.force for contact in contacts])) if contacts else np.zeros(0)
    sizes = sizes[np.isfinite(sizes)]
    return max(float(np.percentile(sizes, 98.0)) if len(sizes) else 1.0, 1e-6)
