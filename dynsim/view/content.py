"""What a page shows of records: bodies and where they were, paths, contacts, supports, motors, signals, events."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.errors import RecordError
from dynsim.measures import hand_target
from dynsim.record import TIME, Record, Signal
from dynsim.record.poses import ORIENTATION, POSITION, point_positions
from dynsim.record.scene import Scene
from dynsim.record.surface_points import normals
from dynsim.view.blocks import Blocks
from dynsim.view.meshes import Meshes
from dynsim.view.solids import body_shapes, drawn_shape, drawn_surface
from dynsim.view.wheels import cop_of, supports, wheel_groups

Array = NDArray[np.float64]
# Poses between the frames of the page are interpolated: to this [m].
POSE_ERROR = 4e-5
# Samples of a signal that plots get; longer ones keep the least and the largest of each bin.
PLOTTED = 8000
# Frames of a longer run are thinned though poses between them be off by more.
FRAMES = 20_000
# Signals that the scene itself shows.
_SHOWN = {POSITION, ORIENTATION, "posture"}


def packed(records: Mapping[str, Record], *, ghost: bool = False) -> str:
    """Head and blocks of a page, in base64; see :func:`dynsim.view.html.page`.

    Raises
    ------
    RecordError
        No record has samples and a scene with the poses of its bodies.
    """
    shown = {name: robot for name, record in records.items() if (robot := _robot(record)) is not None}
    if not shown:
        raise RecordError("nothing to view: a record needs samples, a scene, and the poses of its bodies")
    robots = list(shown.values())
    azimuth, (low, high) = _azimuth(robots), _bounds(robots)
    blocks = Blocks()
    meshes = Meshes(blocks)
    parts = [_record(name, robot, blocks, meshes, low, high) for name, robot in shown.items()]
    head = {
        "version": 1,
        "by": f"dynsim {__version__}",
        "ghost": ghost,
        "azimuth": azimuth,
        "box": [corner.tolist() for corner in _bounds(robots, azimuth)],
        "records": parts,
        "meshes": meshes.found,
        "notes": meshes.notes(),
    }
    return blocks.packed(head)


def viewable(record: Record) -> bool:
    """Whether a page has something to show of a record: samples, a scene, and the poses of its bodies."""
    return _robot(record) is not None


@dataclass(frozen=True)
class Robot:
    """A record whose bodies were placed, and the samples that become frames of the page."""

    record: Record
    scene: Scene
    rows: NDArray[np.intp]
    reach: float


def _robot(record: Record) -> Robot | None:
    scene = record.scene
    if scene is None or not scene.bodies or not {POSITION, ORIENTATION} <= set(record) or not len(record):
        return None
    if record[POSITION].shape != (len(record), len(scene.bodies), 3):
        return None
    position = record[POSITION][np.isfinite(record[POSITION]).all(axis=(1, 2))]
    if not len(position):
        return None
    ends = [position[0], *(point_positions(record, p, 0)[None] for p in scene.points)]
    known = np.concatenate(ends)
    reach = float(np.ptp(known[np.isfinite(known).all(axis=1)], axis=0).max(initial=0.0)) or 0.5
    return Robot(record, scene, _frames(record, reach), reach)


def _frames(record: Record, reach: float) -> NDArray[np.intp]:
    """Samples between which the poses of all others follow to ``POSE_ERROR``: each 2^n-th one, and the last."""
    count = len(record)
    position, turn = record[POSITION].reshape(count, -1), record[ORIENTATION].reshape(count, -1)
    stride, arm = 1, min(reach, 1.0)
    while 4 * stride < count:
        rows = _every(count, 2 * stride)
        # What is left out, and the ends of its interval.
        between = np.delete(np.arange(count), rows)
        left = np.searchsorted(rows, between) - 1
        a, b = rows[left], rows[left + 1]
        t = record.time
        share = ((t[between] - t[a]) / np.maximum(t[b] - t[a], 1e-12))[:, None].astype(np.float32)
        with np.errstate(all="ignore"):
            off = [
                np.abs(x[between] - (x[a] + share * (x[b] - x[a]))).max(initial=0.0) * weight
                for x, weight in ((position, 1.0), (turn, 2.0 * arm))
            ]
        if not max(off) <= POSE_ERROR and count // stride <= FRAMES:
            break
        stride *= 2
    return _every(count, stride)


def _every(count: int, stride: int) -> NDArray[np.intp]:
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


def _bounds(robots: Sequence[Robot], azimuth: float = 0.0) -> tuple[Array, Array]:
    """The box, turned about z by ``azimuth``, in which everything moves, with some room, (3,) and (3,) [m]."""
    points = []
    for robot in robots:
        record = robot.record
        found = [record[POSITION].reshape(-1, 3).astype(np.float64), *(one for _, one in _paths(record, robot.scene))]
        # The last samples of a run that diverged are far from everything else.
        points += found if record.complete else [_without_ends(one) for one in found]
        for shape in robot.scene.fixed:
            middle, half = np.array(shape.position), 0.5 * max(shape.size) if shape.kind != "mesh" else 0.0
            points += [np.stack([middle - half, middle + half])]
    pooled = np.concatenate(points)
    pooled = pooled[np.isfinite(pooled).all(axis=1)]
    c, s = math.cos(azimuth), math.sin(azimuth)
    pooled = pooled @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    low, high = pooled.min(axis=0), pooled.max(axis=0)
    # What hardly moves is not blown up to fill the window, and what is flat has some depth to stand in.
    span, reach = float((high - low).max()), max(robot.reach for robot in robots)
    least = max(0.24 * span, 0.6 * reach if span < 0.6 * reach else 0.0)
    room = np.maximum(0.5 * (least - (high - low)), 0.0) + 0.03 * least + max(map(_thickness, robots))
    return low - room, high + room


def _without_ends(points: Array) -> Array:
    """Points without the outermost hundredth at either end of each axis, (T, 3)."""
    points = points[np.isfinite(points).all(axis=1)]
    return np.clip(points, *np.percentile(points, (1.0, 99.0), axis=0)) if len(points) else points


def _thickness(robot: Robot) -> float:
    """How far shapes reach beside the lines between the bodies, more or less [m]."""
    shapes = [shape for body in robot.scene.bodies for shape in body.shapes]
    round_ = [shape.size[0] for shape in shapes if shape.kind in ("cylinder", "capsule", "sphere")]
    boxes = [0.5 * sorted(shape.size)[1] for shape in shapes if shape.kind == "box"]
    meshes = [0.08 * robot.reach for shape in shapes if shape.kind == "mesh"]
    return min(max([*round_, *boxes, *meshes], default=0.0), 0.5 * robot.reach)


def _azimuth(robots: Sequence[Robot]) -> float:
    """Direction in which robot and hand reach furthest, (−π/2, π/2] about z [rad]: the page looks across it."""
    clouds = [robot.record[POSITION][robot.rows][..., :2].reshape(-1, 2).astype(np.float64) for robot in robots]
    clouds += [path[robot.rows, :2] for robot in robots for _, path in _paths(robot.record, robot.scene)]
    points = np.concatenate(clouds)
    points = points[np.isfinite(points).all(axis=1)]
    spread = points - points.mean(axis=0)
    x, y = np.linalg.eigh(spread.T @ spread)[1][:, 1].tolist()
    return math.atan2(y, x) if x > 0.0 or (x == 0.0 and y > 0.0) else math.atan2(-y, -x)


def _paths(record: Record, scene: Scene) -> Iterator[tuple[str, Array]]:
    if scene.hand is not None:
        yield "hand", np.asarray(point_positions(record, scene.hand), dtype=np.float64)
    target = hand_target(record)
    if target is None and "hand_position_goal" in record:
        target = record["hand_position_goal"]
    if target is None and "w_target" in record:
        target = record["w_target"][:, :3]
    if target is not None:
        yield "target", np.asarray(target, dtype=np.float64)


def _record(name: str, robot: Robot, blocks: Blocks, meshes: Meshes, low: Array, high: Array) -> dict[str, Any]:
    record, scene, rows = robot.record, robot.scene, robot.rows
    meshes.of_robot(record)
    position, turn = record[POSITION][rows], record[ORIENTATION][rows]
    shapes = body_shapes(scene, robot.reach, meshes)
    groups = wheel_groups(record, scene)
    bodies: list[dict[str, Any]] = [
        {"name": body.name, "parent": body.parent, "joint": body.joint.name, "shapes": one}
        for body, one in zip(scene.bodies, shapes, strict=True)
    ]
    for group, places in enumerate(groups.places):
        for body, shape in places:
            bodies[body]["shapes"][shape]["wheel"] = group
    part: dict[str, Any] = {
        "name": name,
        "title": _title(record),
        "measured": "scenario" not in record.provenance or "q_goal" in record,
        "complete": bool(record.complete),
        "radius": min((s["size"][0] for one in shapes for s in one if s["kind"] in ("cylinder", "capsule")), default=0),
        "reach": robot.reach,
        "bodies": bodies,
        "fixed": [one for shape in scene.fixed if (one := drawn_shape(shape, meshes)) is not None],
        "surfaces": [drawn_surface(surface, low, high) for surface in scene.surfaces],
        "frames": blocks.add(record.time[rows], 1e-9),
        "position": blocks.add(position, 0.5 * POSE_ERROR),
        "orientation": blocks.add(turn, 1e-5),
        "paths": {key: blocks.add(path[rows], 1e-5) for key, path in _paths(record, scene)},
        "contacts": _contacts(robot, blocks),
        "wheels": None if groups.down is None else {"names": groups.names, "down": blocks.add(groups.down[rows])},
        "supports": supports(scene, groups),
        "motors": _motors(record, scene),
        "limit": voltage_limits(record),
        "events": [[event.time, event.kind, event.name, _finite(event.value)] for event in record.events],
    }
    if (pressure := cop_of(record)) is not None:
        part["pressure"] = {"name": pressure[0], "at": blocks.add(pressure[1][rows], 1e-4)}
    if "gripper" in record and scene.hand is not None:
        part["gripper"] = blocks.add(record["gripper"][rows])
    if scene.hand is not None:
        part["hand"] = {"body": scene.hand.body, "p": list(scene.hand.position), "name": scene.hand.name}
    part["signals"], part["axes"] = _signals(record, blocks)
    return part


def _title(record: Record) -> str:
    scenario = record.provenance.get("scenario")
    names = [scenario.get("name"), scenario.get("variant")] if isinstance(scenario, Mapping) else []
    text = " / ".join(str(one) for one in names if one)
    robot = record.provenance.get("robot")
    return text or (f"{robot}, measured" if robot else "record")


def _contacts(robot: Robot, blocks: Blocks) -> list[dict[str, Any]]:
    """Every contact point: on which body, its normal, normal force and friction over time, mode where there is one."""
    record, scene, rows = robot.record, robot.scene, robot.rows
    if "contact_normal_force" not in record:
        return []
    names = record.labels["contact_normal_force"]
    found = []
    for point in scene.contacts:
        surface = scene.surface(point.surface)
        if surface is None or point.name not in names:
            continue
        k = names.index(point.name)
        normal = normals(surface, np.asarray(point_positions(record, point, rows), dtype=np.float64))
        force = np.asarray(record["contact_normal_force"][rows, k], dtype=np.float64)
        mode = record["contact_mode"][rows, k] if "contact_mode" in record else None
        if mode is not None and not mode.any():
            continue
        one: dict[str, Any] = {
            "name": point.name,
            "surface": point.surface,
            "body": point.body,
            "p": list(point.position),
            "friction": _friction(record, point.name),
            "normal": blocks.add(normal),
            "force": blocks.add(force),
        }
        if "contact_force" in record:
            one["tangent"] = blocks.add(record["contact_force"][rows, k] - force[:, None] * normal)
        if mode is not None:
            one["mode"] = blocks.add(mode)
        found.append(one)
    return found


def _friction(record: Record, name: str) -> float:
    """The coefficient of the cone that the force of a contact cannot leave; 0 where it is not known."""
    contacts = record.provenance.get("scenario", {}).get("contacts", {})
    points = contacts.get("points") or {}
    point = points.get(name, {}) if isinstance(points, Mapping) else {}
    kinetic = [one.get("friction") for one in (point, contacts)]
    held = [one.get("static_friction") for one in (point, contacts)]
    known = [next((float(one) for one in both if one is not None), 0.0) for both in (kinetic, held)]
    return max(known)


def _motors(record: Record, scene: Scene) -> list[list[Any]]:
    """Name of each motor and the index of the body that it moves; of a wheel of a base, the wheel."""
    names = record.labels["current"] if "current" in record else record.labels.get("v", ())
    by_joint = {body.joint.name: k for k, body in enumerate(scene.bodies)}
    by_label = {
        label: k for k, body in enumerate(scene.bodies) if body.joint.kind != "planar" for label in body.joint.labels
    }
    places = [(name, by_label.get(name, by_joint.get(name))) for name in names]
    return [[name, body] for name, body in places if body is not None]


def voltage_limits(record: Record) -> float | None:
    """The voltage limit of the motors [V] where they share one; None where there is none, or several."""
    found = set(_named(record.provenance.get("scenario", {}).get("plant", {}), "voltage_limit_V"))
    return _finite(found.pop()) if len(found) == 1 else None


def _finite(value: float | None) -> float | None:
    """JSON has no infinity."""
    return value if value is not None and math.isfinite(value) else None


def _named(tree: Any, key: str) -> Iterator[float]:
    """Numbers of a key, wherever it is."""
    if isinstance(tree, Mapping):
        for name, value in tree.items():
            if name == key and isinstance(value, (int, float)):
                yield float(value)
            else:
                yield from _named(value, key)
    elif isinstance(tree, (list, tuple)):
        for value in tree:
            yield from _named(value, key)


def _signals(record: Record, blocks: Blocks) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Signals for the plots, and their time axes."""
    found, axes = [], {}
    for name, signal in (record.signals | _hand_error(record)).items():
        data = signal.data
        if name in _SHOWN or not data.size or data.ndim > 3:
            continue
        labels = list(signal.labels)
        if data.ndim == 3:
            parts = "xyz" if data.shape[2] == 3 else range(data.shape[2])
            labels = [f"{label} {part}" for label in labels for part in parts]
        every = record.time if signal.axis == TIME else record.axes[signal.axis]
        time, values = _thinned(every, data.reshape(len(data), -1))
        if signal.axis not in axes:
            axes[signal.axis] = blocks.add(time, 1e-9)
        found.append(
            {
                "name": name,
                "unit": signal.unit,
                "about": signal.description,
                "labels": labels,
                "axis": signal.axis,
                "data": blocks.add(values, _resolution(values)),
            }
        )
    if TIME not in axes:
        axes[TIME] = blocks.add(_thinned(record.time, record.time[:, None])[0], 1e-9)
    return found, axes


def _resolution(values: Array) -> float:
    """What is told apart where a plot shows most of the values: a spike at the start does not coarsen the rest."""
    known = values[np.isfinite(values)]
    if not len(known):
        return np.inf
    low, high = np.percentile(known, (5.0, 95.0))
    return 5e-4 * float(high - low) or np.inf


def _hand_error(record: Record) -> dict[str, Signal]:
    """How far the hand is from its target, where a record says both and not this."""
    target = hand_target(record)
    if target is None or "hand_position" not in record or "hand_error" in record:
        return {}
    distance = np.linalg.norm(record["hand_position"] - target, axis=1)
    return {"hand_error": Signal(distance, "m", description="distance of the hand from its target")}


def _thinned(time: Array, values: NDArray[Any]) -> tuple[Array, Array]:
    """At most ``PLOTTED`` instants; of a longer run two for each bin, its extremes in their order."""
    values = np.asarray(values, dtype=np.float64)
    if len(time) <= PLOTTED:
        return time, values
    size = -(-2 * len(time) // PLOTTED)
    whole = len(time) // size * size
    bins = values[:whole].reshape(-1, size, values.shape[1])
    bare = np.where(np.isfinite(bins), bins, 0.0)
    least, most = bare.argmin(axis=1), bare.argmax(axis=1)
    order = np.sort(np.stack([least, most], axis=1), axis=1)
    kept = np.take_along_axis(bins, order, axis=1).reshape(-1, values.shape[1])
    at = time[:whole].reshape(-1, size)[:, [0, size // 2]].ravel()
    return np.append(at, time[-1]), np.concatenate([kept, values[-1:]])
