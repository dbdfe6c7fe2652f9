"""Data of a viewer page: body poses, paths, contacts, supports, motors, signals, events."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.draw.geometry.camera import view_axes
from dynsim.draw.geometry.meshes import Meshes, named, simplified
from dynsim.draw.geometry.robot import (
    POSE_ERROR,
    DrawnRobot,
    azimuth,
    bounds,
    contacts,
    gripping,
    paths,
    penetrations,
    robot_of,
    robots,
)
from dynsim.draw.geometry.shapes import body_shapes, drawn_shape, drawn_surface, gripper, thinnest
from dynsim.draw.geometry.wheels import cop_of, supports, wheel_groups
from dynsim.draw.page.blocks import Blocks, packed_mesh
from dynsim.record import TIME, Record, Signal
from dynsim.record.measures import GRIPPER_STATES, hand_target
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.scene import Scene

Array = NDArray[np.float64]
# Most samples of a signal in plots; of longer signals the least and the largest value of each bin are kept.
PLOTTED = 8000
# Largest relative error of the heat by the trapezoidal rule against that of the record: currents may jump between
# samples.
HEAT_ERROR = 0.05
# Signals that the 3D view shows, and plots do not.
_SHOWN = {POSITION, ORIENTATION, "posture"}


def packed(records: Mapping[str, Record], *, ghost: bool = False) -> str:
    """Head and blocks of a page, in base64; see :func:`dynsim.draw.page.html.page`.

    Raises
    ------
    RecordError
        No record has samples and a scene with the poses of its bodies.
    """
    shown = robots(records)
    every = list(shown.values())
    turn, (low, high) = azimuth(every), bounds(every)
    blocks = Blocks()
    meshes = Meshes()
    parts = [_record(name, robot, blocks, meshes, low, high) for name, robot in shown.items()]
    head = {
        "version": 1,
        "by": f"dynsim {__version__}",
        "ghost": ghost,
        "azimuth": turn,
        "box": [corner.tolist() for corner in bounds(every, view_axes("top", turn))],
        "records": parts,
        "meshes": [packed_mesh(mesh, blocks) for mesh in simplified(meshes.unique)],
        "notes": meshes.notes(),
    }
    return blocks.packed(head)


def viewable(record: Record) -> bool:
    """Whether a page has something to show of a record: samples, a scene, and the poses of its bodies."""
    return robot_of(record) is not None


def _record(name: str, robot: DrawnRobot, blocks: Blocks, meshes: Meshes, low: Array, high: Array) -> dict[str, Any]:
    record, scene, rows = robot.record, robot.scene, robot.rows
    meshes.of_robot(record)
    position, turn = record[POSITION][rows], record[ORIENTATION][rows]
    shapes = body_shapes(scene, robot.reach, meshes)
    groups = wheel_groups(record, scene)
    bodies: list[dict[str, Any]] = [
        {"name": body.name, "parent": body.parent, "joint": body.joint.name, "shapes": shapes_of_body}
        for body, shapes_of_body in zip(scene.bodies, shapes, strict=True)
    ]
    for group, places in enumerate(groups.places):
        for body, shape in places:
            bodies[body]["shapes"][shape]["wheel"] = group
    part: dict[str, Any] = {
        "name": name,
        "title": record.title or "record",
        "measured": "scenario" not in record.provenance or "q_goal" in record,
        "complete": bool(record.complete),
        "radius": thinnest(shapes),
        "reach": robot.reach,
        "bodies": bodies,
        "fixed": [shape_drawn for shape in scene.fixed if (shape_drawn := drawn_shape(shape, meshes)) is not None],
        "surfaces": [drawn_surface(surface, low, high) for surface in scene.surfaces],
        "frames": blocks.add(record.time[rows], 1e-9),
        "position": blocks.add(position, 0.5 * POSE_ERROR),
        "orientation": blocks.add(turn, 1e-5),
        "paths": {key: blocks.add(path[rows], 1e-5) for key, path in paths(record, scene)},
        "contacts": _contacts(robot, blocks),
        "sunk": [
            {"name": point.name, "surface": point.surface, "body": point.body, "p": list(point.position)}
            | {"least": point.least, "depth": blocks.add(point.depth, 1e-5)}
            for point in penetrations(record, scene, rows)
        ],
        "wheels": None if groups.down is None else {"names": groups.names, "down": blocks.add(groups.down[rows])},
        "supports": supports(scene, groups),
        "motors": _motors(record, scene),
        "names": scene.wheel_names,
        "limit": shared(record, "voltage_limit_V"),
        "resistance": resistance(record),
        "events": [[event.time, event.kind, event.name, _finite(event.value)] for event in record.events],
    }
    if (pressure := cop_of(record)) is not None:
        part["pressure"] = {"name": pressure[0], "at": blocks.add(pressure[1][rows], 1e-4)}
    if (grip := gripping(record)) is not None and scene.hand is not None:
        part["gripper"] = blocks.add(grip[rows])
        part["fingers"] = gripper(shapes, robot.reach)
        if "gripper_state" in record:
            part["states"] = list(GRIPPER_STATES)
    if scene.hand is not None:
        part["hand"] = {"body": scene.hand.body, "p": list(scene.hand.position), "name": scene.hand.name}
    part["signals"], part["axes"] = _signals(record, blocks)
    return part


def _contacts(robot: DrawnRobot, blocks: Blocks) -> list[dict[str, Any]]:
    """Every contact point: on which body, its normal, normal force and friction over time; mode and place if known."""
    entries = []
    for contact in contacts(robot, robot.rows):
        point = contact.point
        entry: dict[str, Any] = {
            "name": point.name,
            "surface": point.surface,
            "body": point.body,
            "p": list(point.position),
            "friction": contact.friction,
            "normal": blocks.add(contact.normal),
            "force": blocks.add(contact.force),
        }
        if contact.tangent is not None:
            entry["tangent"] = blocks.add(contact.tangent)
        if contact.mode is not None:
            entry["mode"] = blocks.add(contact.mode)
        if contact.at is not None:
            entry["at"] = blocks.add(contact.at)
        entries.append(entry)
    return entries


def _motors(record: Record, scene: Scene) -> list[list[Any]]:
    """Name of each motor and the index of the body that it moves; of a wheel of a base, the wheel."""
    names = record.labels["current"] if "current" in record else record.labels.get("v", ())
    by_joint = {body.joint.name: k for k, body in enumerate(scene.bodies)}
    by_label = {
        label: k for k, body in enumerate(scene.bodies) if body.joint.kind != "planar" for label in body.joint.labels
    }
    places = [(name, by_label.get(name, by_joint.get(name))) for name in names]
    return [[name, body] for name, body in places if body is not None]


def shared(record: Record, key: str) -> float | None:
    """A number of the motors by its key in the scenario; None where they have none, or several."""
    values = named(record.provenance.get("scenario", {}).get("plant", {}), key)
    numbers = {float(value) for value in values if isinstance(value, (int, float))}
    return _finite(numbers.pop()) if len(numbers) == 1 else None


def resistance(record: Record) -> float | None:
    """R of the motors [Ω] where they share one, and R ∫ Σ i² dt is the heat that was recorded."""
    R = shared(record, "resistance_ohm")
    if R is None or not {"current", "heat_joule"} <= set(record) or len(record) < 2:
        return None
    heat = float(record["heat_joule"][-1] - record["heat_joule"][0])
    loss = R * float(np.trapezoid((record["current"] ** 2).sum(axis=1), record.time))
    return R if abs(loss - heat) <= HEAT_ERROR * abs(heat) else None


def _finite(value: float | None) -> float | None:
    """JSON has no infinity."""
    return value if value is not None and math.isfinite(value) else None


def _signals(record: Record, blocks: Blocks) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Signals for the plots, and their time axes."""
    signals, axes = [], {}
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
        signals.append(
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
    return signals, axes


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
