"""Viewer page: its data (body poses, paths, contacts, supports, motors, signals, events), HTML text and display."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim._version import __version__
from dynsim.draw.geometry.meshes import Mesh, Meshes, simplified
from dynsim.draw.geometry.projection import view_axes
from dynsim.draw.geometry.robot import (
    FRAMES,
    POSE_ERROR,
    DrawnRobot,
    Penetration,
    azimuth,
    bounds,
    contacts,
    gripping,
    knots,
    largest_force,
    moving,
    paths,
    penetrations,
    robot_of,
    robots,
)
from dynsim.draw.geometry.shapes import (
    body_shapes,
    cop_of,
    drawn_shapes,
    drawn_surface,
    gripper,
    supports,
    thinnest,
    wheel_groups,
)
from dynsim.errors import RecordError
from dynsim.record import TIME, Record, Signal
from dynsim.record.measures import GRIPPER_STATES, hand_target
from dynsim.record.poses import NORMAL, ORIENTATION, POSITION, TOUCHING, contact_positions, point_positions
from dynsim.record.scene import WORLD, Scene, SceneSurface
from dynsim.system.arguments import names_wrong_types
from dynsim.system.files import replacing

# Compression of time series, which are quantised, differenced, and split into byte planes.

# Largest code for a finite value, by number of bits; 32 bits are used if half a quantisation step with 16 bits exceeds
# the allowed error.
_CODES = {16: 2**16 - 2, 32: 2**32 - 2}
_TYPES: dict[int, np.dtype[Any]] = {16: np.dtype("<u2"), 32: np.dtype("<u4")}


class Blocks:
    """Collection of data blocks; the description of each block is stored in the head of the page."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._known: dict[bytes, int] = {}
        self._size = 0

    def add(self, columns: ArrayLike, error: float = np.inf, step: float = 0.0) -> dict[str, Any]:
        """Add columns, (T,) or (T, …), quantised to 16 bits of their range, or to 32 bits if ``error`` requires it.

        A quantisation step of ``step``, but at most 1/500 of the range, makes noise compressible.
        """
        data = np.asarray(columns, dtype=np.float64)
        data = data.reshape(len(data), -1) if len(data) else data.reshape(0, 1)
        known = np.isfinite(data)
        low = np.where(known, data, np.inf).min(axis=0, initial=np.inf)
        high = np.where(known, data, -np.inf).max(axis=0, initial=-np.inf)
        some = np.isfinite(low)
        low, span = np.where(some, low, 0.0), np.where(some, high - low, 0.0)
        bits = 16 if 0.5 * span.max(initial=0.0) / _CODES[16] <= error else 32
        scale = np.where(span > 0.0, np.maximum(span / _CODES[bits], np.minimum(span / 500.0, step)), 0.0)
        with np.errstate(all="ignore"):
            codes = np.rint((np.where(known, data, low) - low) / np.where(scale > 0.0, scale, 1.0))
        kind = _TYPES[bits]
        codes = np.where(known, codes, float(_CODES[bits] + 1)).astype(kind)
        steps = np.diff(codes.T, axis=1, prepend=np.zeros((codes.shape[1], 1), dtype=kind))
        planes = np.ascontiguousarray(steps).view(np.uint8).reshape(-1, bits // 8).T
        start = self._append(np.ascontiguousarray(planes).tobytes())
        header = {"at": start, "rows": len(data), "columns": int(codes.shape[1]), "bits": bits}
        # Twelve digits are more than the quantisation keeps.
        return header | {"offset": low.tolist(), "scale": [float(f"{x:.12g}") for x in scale]}

    def raw(self, data: NDArray[Any]) -> dict[str, Any]:
        """Add an array of integers ≥ 0 unchanged (for meshes), little-endian, in 16 bits, or in 32 if necessary."""
        bits = 16 if data.max(initial=0) < 2**16 else 32
        return {"at": self._append(data.astype(_TYPES[bits]).tobytes()), "count": int(data.size), "bits": bits}

    def _append(self, content: bytes) -> int:
        """Return the position of a block, and append it unless an equal block exists."""
        key = hashlib.sha256(content).digest()
        if key not in self._known:
            self._known[key] = self._size
            self._parts.append(content)
            self._size += len(content)
        return self._known[key]

    def packed(self, head: dict[str, Any]) -> str:
        """Return the length of the head in 4 bytes, the head as JSON, and the blocks; compressed and in base64."""
        text = json.dumps(head, allow_nan=False, separators=(",", ":"), ensure_ascii=True).encode("ascii")
        content = len(text).to_bytes(4, "little") + text + b"".join(self._parts)
        # Omit the time stamp, so that equal records give identical pages.
        return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")


def packed_mesh(mesh: Mesh, blocks: Blocks) -> dict[str, Any]:
    """Return a mesh in the data format of the page: corners in 16 bits within their box, triangles, and colours."""
    corners, triangles, colours = mesh
    low, high = corners.min(axis=0), corners.max(axis=0)
    step = np.where(high > low, (high - low) / 65535.0, 1.0)
    paint: dict[str, Any] = {}
    if colours is not None:
        # Use −1 for a missing colour, because NaN is not equal to itself.
        palette, number = np.unique(np.round(np.nan_to_num(colours, nan=-1.0), 3), axis=0, return_inverse=True)
        paint["palette"] = [None if row[0] < 0.0 else row.tolist() for row in palette]
        paint["paint"] = blocks.raw(number.reshape(-1))
    return paint | {
        "vertices": blocks.raw(np.rint((corners - low) / step)),
        "triangles": blocks.raw(triangles),
        "low": low.tolist(),
        "step": step.tolist(),
    }


Array = NDArray[np.float64]
# Maximum number of samples of a plotted signal; for longer signals the minimum and maximum of each bin are kept.
PLOTTED = 8000
# Number of plotted values of a page; with more, signals have fewer samples, but at least FEWEST.
VALUES, FEWEST = 3_000_000, 400
# Relative error of contact forces between the instants of a page, and error of centres of pressure [m].
FORCE_ERROR, CENTRE_ERROR = 5e-4, 5e-5
# Lengths of at most this size are plotted in millimetres [m].
SMALL = 0.1
# Maximum relative difference between the recorded heat and the heat by the trapezoidal rule; currents may jump between
# samples.
HEAT_ERROR = 0.05
# Signals that are shown in the 3D view but not in plots.
_SHOWN = {POSITION, ORIENTATION, TOUCHING, NORMAL, "posture"}
# Names of signals; the others are their keys in words.
_NAMES = {
    "q": "joint position",
    "v": "joint rate",
    "vdot": "joint acceleration",
    "phi": "joint angle",
    "phi_dot": "joint rate",
    "phi_command": "commanded joint angle",
    "phi_dot_command": "commanded joint rate",
    "rho": "wheel angle",
    "rho_dot": "wheel rate",
    "rho_dot_command": "commanded wheel rate",
    "w": "pose of the controlled point",
    "w_target": "target pose",
    "w_estimate": "estimated pose",
    "torque": "motor torque",
    "current": "motor current",
    "voltage": "motor voltage",
    "power": "electrical power",
    "contact_normal_force": "normal force of contacts",
    "contact_force": "force of contacts",
    "contact_gap": "gap of contacts",
    "contact_slip_velocity": "slip velocity of contacts",
    "contact_impulse": "impulse of contacts",
    "contact_mode": "mode of contacts",
    "contact_slip_distance": "slip distance of contacts",
    "hand_error": "distance of the hand from its target",
    "hand_turn_error": "angle of the hand from its target",
    "position_error": "distance of the head from its target",
    "attitude_error": "angle of the head from its target",
    "energy_electrical": "electrical energy, net",
    "energy_electrical_drawn": "electrical energy drawn",
    "energy_electrical_supply": "electrical energy, common supply",
    "energy_residual": "residual of the energy balance",
    "heat_joule": "heat of the windings",
    "heat_friction": "heat of friction",
    "loss_gear": "loss in gears",
    "loss_joint": "loss in joints",
    "loss_impact": "loss in impacts",
    "loss_stop": "loss at joint stops",
    "loss_damper": "loss in dampers",
    "loss_scheme": "loss of time stepping",
    "tip_margin": "margin against tipping",
}


def packed(records: Mapping[str, Record], *, ghost: bool = False, live: bool = False) -> str:
    """Return the head and the blocks of a page in base64, see :func:`dynsim.draw.page.content.page`.

    A ``live`` page also has the contacts that do not touch in the record.

    Raises
    ------
    RecordError
        If no record has samples and a scene with body poses.
    """
    shown = robots(records)
    every = list(shown.values())
    turn, points = azimuth(every), moving(every)
    low, high = bounds(every, points=points)
    blocks = Blocks()
    meshes = Meshes()
    layout = _Layout(records[name] for name in shown)
    parts = [_record(name, robot, blocks, meshes, low, high, live) for name, robot in shown.items()]
    for part, robot in zip(parts, every, strict=True):
        part["signals"], part["axes"] = _signals(robot.record, blocks, layout)
    head = {
        "version": 1,
        "by": f"dynsim {__version__}",
        "ghost": ghost,
        "azimuth": turn,
        "box": [corner.tolist() for corner in bounds(every, view_axes("top", turn), points)],
        "records": parts,
        "meshes": [packed_mesh(mesh, blocks) for mesh in simplified(meshes.unique)],
        "notes": meshes.notes(),
    }
    return blocks.packed(head)


def viewable(record: Record) -> bool:
    """Return whether a page can show a record.

    Parameters
    ----------
    record : Record
        Record to check.

    Returns
    -------
    bool
        True if the record has samples and a scene with body poses.

    Examples
    --------
    >>> import dynsim
    >>> dynsim.view.viewable(dynsim.Record([0.0, 1.0]))
    False
    """
    return robot_of(record) is not None


def _record(
    name: str, robot: DrawnRobot, blocks: Blocks, meshes: Meshes, low: Array, high: Array, live: bool
) -> dict[str, Any]:
    record, scene, rows = robot.record, robot.scene, robot.rows
    instants, touching = _contacts(robot, blocks, live)
    sunk = penetrations(record, scene, rows)
    meshes.of_robot(record.scene)
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
        "measured": record.measured,
        "complete": bool(record.complete),
        "radius": thinnest(shapes),
        "reach": robot.reach,
        "bodies": bodies,
        "fixed": drawn_shapes(scene.fixed, meshes),
        "stands": _stands(scene),
        "surfaces": [drawn_surface(surface, *_near(surface, robot, sunk, low, high)) for surface in scene.surfaces],
        "frames": blocks.add(record.time[rows], 1e-9),
        "position": blocks.add(position, 0.5 * POSE_ERROR),
        "orientation": blocks.add(turn, 2e-5),
        "paths": {key: blocks.add(path[rows], 1e-5) for key, path in paths(record, scene)},
        "instants": blocks.add(record.time[instants], 1e-9),
        "contacts": touching,
        "sunk": [
            {"name": point.name, "surface": point.surface, "body": point.body, "p": list(point.position)}
            | {"least": point.least, "depth": blocks.add(point.depth, 1e-5)}
            for point in sunk
        ],
        "wheels": None if groups.down is None else {"names": groups.names, "down": blocks.add(groups.down[instants])},
        "supports": supports(scene, groups),
        "motors": _motors(record, scene),
        "limits": _limits(record),
        "names": scene.wheel_names,
        "limit": scene.voltage_limit,
        "resistance": resistance(record),
        "events": [[event.time, event.kind, event.name, _finite(event.value)] for event in record.events],
    }
    if (pressure := cop_of(record)) is not None:
        part["pressure"] = {"name": pressure[0], "at": blocks.add(pressure[1][instants], 1e-4)}
    if (grip := gripping(record)) is not None and scene.hand is not None:
        part["gripper"] = blocks.add(grip[instants])
        part["fingers"] = gripper(shapes, scene, robot.reach)
        if "gripper_state" in record:
            part["states"] = list(GRIPPER_STATES)
    if scene.hand is not None:
        part["hand"] = {"body": scene.hand.body, "p": list(scene.hand.position), "name": scene.hand.name}
    return part


def _near(
    surface: SceneSurface, robot: DrawnRobot, sunk: Sequence[Penetration], low: Array, high: Array
) -> tuple[Array, Array]:
    """Return the box near which a surface is drawn: a plane through the robot is a plate at its contact points."""
    record, deep = robot.record, 0.05 * robot.reach
    touched = [contact_positions(record, point) for point in robot.scene.contacts if point.surface == surface.name]
    through = any(point.surface == surface.name and point.depth.max() > deep for point in sunk)
    if surface.kind != "plane" or not touched or not through:
        return low, high
    points = np.concatenate(touched)
    points = points[(np.abs(surface.gap(points)) < deep) & np.isfinite(points).all(axis=1)]
    return (points.min(axis=0) - 2.0 * deep, points.max(axis=0) + 2.0 * deep) if len(points) else (low, high)


def _stands(scene: Scene) -> list[list[float]]:
    """Return the joints that connect the robot to the world [m], if nothing is drawn below them."""
    bases = [(b, b.joint) for b in scene.bodies if b.parent == WORLD and b.name not in scene.objects]
    fixed = [joint for body, joint in bases if joint.kind == "revolute" and not joint.part_of]
    return [] if scene.fixed else [list(joint.position) for joint in fixed]


def _contacts(robot: DrawnRobot, blocks: Blocks, live: bool) -> tuple[NDArray[np.intp], list[dict[str, Any]]]:
    """Return samples whose interpolation shows contacts, wheels, gripper and centre of pressure, and the contacts.

    A contact has its body, normal, normal force and friction over time, and mode and position if known.
    """
    record, drawn = robot.record, contacts(robot, open_too=live)
    tolerance = {"normal": FORCE_ERROR, "at": POSE_ERROR, "mode": 0.25}
    tolerance["force"] = tolerance["tangent"] = FORCE_ERROR * largest_force(drawn)
    entries, data = [], [np.zeros((len(record), 1))]
    for contact in drawn:
        point, at = contact.point, contact.at
        entry: dict[str, Any] = {"name": point.name, "surface": point.surface, "body": point.body}
        entry |= {"p": list(point.position), "friction": point.friction, "radius": 0.0}
        if at is not None:
            # On a sphere the force acts one radius below the centre.
            arm = point_positions(record, point) - at
            radius = float(np.linalg.norm(arm[0]))
            if np.abs(arm - radius * contact.normal).max() < 0.5 * POSE_ERROR:
                entry["radius"], at = radius, None
        values = {"normal": contact.normal, "force": contact.force, "tangent": contact.tangent, "mode": contact.mode}
        entry |= {name: table for name, table in (values | {"at": at}).items() if table is not None}
        data += [entry[name].reshape(len(record), -1) / error for name, error in tolerance.items() if name in entry]
        entries.append(entry)
    for states in (wheel_groups(record, robot.scene).down, gripping(record)):
        data += [] if states is None else [4.0 * states.reshape(len(record), -1)]
    if (pressure := cop_of(record)) is not None:
        data.append(pressure[1] / CENTRE_ERROR)
    rows = knots(record.time, np.concatenate(data, axis=1), FRAMES)
    for entry in entries:
        entry |= {name: blocks.add(entry[name][rows]) for name in tolerance if name in entry}
    return rows, entries


def _motors(record: Record, scene: Scene) -> list[list[Any]]:
    """Return the name of each motor and the index of the body that it moves (a wheel for a motor of the base)."""
    names = record.labels["current"] if "current" in record else record.labels.get("v", ())
    by_joint = {body.joint.name: k for k, body in enumerate(scene.bodies)}
    by_label = {
        label: k for k, body in enumerate(scene.bodies) if body.joint.kind != "planar" for label in body.joint.labels
    }
    places = [(name, by_label.get(name, by_joint.get(name))) for name in names]
    return [[name, body] for name, body in places if body is not None]


def resistance(record: Record) -> float | None:
    """Return the resistance R that all motors share [Ω] if R ∫ Σ i² dt equals the recorded heat, or None."""
    R = None if record.scene is None else record.scene.resistance
    if R is None or not {"current", "heat_joule"} <= set(record) or len(record) < 2:
        return None
    heat = float(record["heat_joule"][-1] - record["heat_joule"][0])
    loss = R * float(np.trapezoid((record["current"] ** 2).sum(axis=1), record.time))
    return R if abs(loss - heat) <= HEAT_ERROR * abs(heat) else None


# Ratings of motors in the summary, by the name of their colouring.
_RATINGS = {
    "rating": ("nominal_torque_N_m", "nominal_force_N"),
    "stall": ("stall_torque_N_m",),
    "nominal_current": ("nominal_current_A",),
}


def _limits(record: Record) -> dict[str, dict[str, float]]:
    """Return the ratings of the motors for which they are known, by colouring and joint [N m, N or A]."""
    motors = record.summary.get("motors", ())
    return {
        name: {motor["joint"]: motor[key] for motor in motors for key in keys if motor.get(key)}
        for name, keys in _RATINGS.items()
    }


def _finite(value: float | None) -> float | None:
    """Return the value, or None if it is not finite, because JSON has no infinity."""
    return value if value is not None and math.isfinite(value) else None


def _plotted(record: Record) -> dict[str, Signal]:
    """Return the signals that can be plotted."""
    signals = record.signals | _hand_error(record)
    return {name: s for name, s in signals.items() if name not in _SHOWN and s.data.size and s.data.ndim <= 3}


class _Layout:
    """Number of samples of the plotted signals of a page, and signals that are plotted in millimetres."""

    def __init__(self, records: Iterable[Record]) -> None:
        self.small: dict[str, bool] = {}
        columns = 0
        for record in records:
            for name, signal in _plotted(record).items():
                columns += signal.data[0].size
                if signal.unit == "m" and "position" not in name.split("_")[1:]:
                    sizes = np.abs(signal.data[np.isfinite(signal.data)])
                    small = bool(np.percentile(sizes, 98.0) <= SMALL) if sizes.size else True
                    self.small[name] = self.small.get(name, True) and small
        self.samples = min(max(VALUES // max(columns, 1), FEWEST), PLOTTED)
        self.crowded = self.samples < 4 * FEWEST


def _signals(record: Record, blocks: Blocks, layout: _Layout) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the signals for the plots, and their time axes."""
    signals, axes = [], {}
    for name, signal in _plotted(record).items():
        data, unit = signal.data, signal.unit
        if layout.small.get(name) and unit == "m":
            data, unit = 1e3 * data, "mm"
        labels = list(signal.labels)
        if data.ndim == 3:
            parts = "xyz" if data.shape[2] == 3 else range(data.shape[2])
            labels = [f"{label} {part}" for label in labels for part in parts]
        every = record.time if signal.axis == TIME else record.axes[signal.axis]
        time, values = _thinned(every, data.reshape(len(data), -1), layout.samples)
        resolution = _resolution(values)
        if signal.axis not in axes:
            axes[signal.axis] = blocks.add(time, 1e-9)
        signals.append(
            {
                "name": name,
                "words": _NAMES.get(name) or name.replace("_", " "),
                "unit": unit,
                "about": signal.description,
                "labels": labels,
                "axis": signal.axis,
                "data": blocks.add(values, resolution, resolution if layout.crowded else 0.0),
            }
        )
    if TIME not in axes:
        axes[TIME] = blocks.add(_thinned(record.time, record.time[:, None], layout.samples)[0], 1e-9)
    return signals, axes


def _resolution(values: Array) -> float:
    """Return the resolution required to plot most of the values; a peak at the start does not make it coarser."""
    known = values[np.isfinite(values)]
    if not len(known):
        return np.inf
    low, high = np.percentile(known, (5.0, 95.0))
    return 5e-4 * float(high - low) or np.inf


def _hand_error(record: Record) -> dict[str, Signal]:
    """Return the distance of the hand from its target as a signal, if the record contains both but not this signal."""
    target = hand_target(record)
    if target is None or "hand_position" not in record or "hand_error" in record:
        return {}
    distance = np.linalg.norm(record["hand_position"] - target, axis=1)
    return {"hand_error": Signal(distance, "m", description="distance of the hand from its target")}


def _thinned(time: Array, values: NDArray[Any], most: int = PLOTTED) -> tuple[Array, Array]:
    """Return at most ``most`` samples; for a longer run, these are the two extremes of each bin, in their order."""
    values = np.asarray(values, dtype=np.float64)
    if len(time) <= most:
        return time, values
    size = -(-2 * len(time) // most)
    whole = len(time) // size * size
    bins = values[:whole].reshape(-1, size, values.shape[1])
    bare = np.where(np.isfinite(bins), bins, 0.0)
    least, most = bare.argmin(axis=1), bare.argmax(axis=1)
    order = np.sort(np.stack([least, most], axis=1), axis=1)
    kept = np.take_along_axis(bins, order, axis=1).reshape(-1, values.shape[1])
    at = time[:whole].reshape(-1, size)[:, [0, size // 2]].ravel()
    return np.append(at, time[-1]), np.concatenate([kept, values[-1:]])


# HTML text of a page, with scripts and styles, three.js from its package, and the data.
SCRIPTS = ("decode", "solids", "marks", "actor", "stage", "plots", "controls", "main")
"""Files of the page's program, in loading order."""
_THREE = ("jupyter_threejs_sage", "static/r130/three.min.js")


def page(records: Mapping[str, Record], *, ghost: bool = False, scripts: Sequence[str] = (), connect: str = "") -> str:
    """Return the HTML text of the page of one or several records.

    Parameters
    ----------
    records : mapping of str to Record
        Displayed names and records.
    ghost : bool, optional
        Overlay several records, the first one solid; default: side by side.
    scripts : sequence of str, optional
        Additional JavaScript programs. They run after the page's program, which they can access as ``dynsim``.
    connect : str, optional
        The only address to which the page may connect (for live driving); default: none.

    Returns
    -------
    str
        HTML text.

    Raises
    ------
    RecordError
        If no record has samples and a scene with body poses, or three.js is not installed.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows", overrides={"duration_s": 0.1})
    >>> text = dynsim.view.page({"two elbows": dynsim.simulate(scenario)})
    >>> text.startswith("<!DOCTYPE html>")
    True
    """
    data = packed(records, ghost=ghost, live=bool(connect))
    titles = (record.title.partition(" / ")[0] for record in records.values())
    title = next(filter(None, titles), "record")
    allowed = f"; connect-src {html.escape(connect)}" if connect else ""
    return _filled({"title": html.escape(title), "data": data, "connect": allowed}, scripts)


@names_wrong_types
def write(records: Mapping[str, Record], path: str | os.PathLike[str], *, ghost: bool = False) -> Path:
    """Write the page of one or several records to a file atomically.

    Parameters
    ----------
    records : mapping of str to Record
        Displayed names and records.
    path : str or path-like
        File to write.
    ghost : bool, optional
        Overlay several records, the first one solid; default: side by side.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    RecordError
        In the same cases as for :func:`page`, and if the file cannot be written.

    Examples
    --------
    >>> import dynsim, pathlib, tempfile
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows", overrides={"duration_s": 0.1})
    >>> record = dynsim.simulate(scenario)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = dynsim.view.write({"two elbows": record}, pathlib.Path(folder) / "view.html")
    >>> path.name
    'view.html'
    """
    return Inline(page(records, ghost=ghost)).save(path)


def _filled(values: Mapping[str, str], scripts: Sequence[str]) -> str:
    own = resources.files("dynsim.draw.page").joinpath("page")
    style = own.joinpath("style.css").read_text(encoding="utf-8")
    program = "\n".join(own.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    program = "\n".join([program, *scripts])
    parts = {"style": style, "three": _inline(three()), "program": _inline(program), **values}
    text = own.joinpath("page.html").read_text(encoding="utf-8")
    return re.sub(r"<!--\{(\w+)\}-->", lambda match: parts[match[1]], text)


def three() -> str:
    """Return the text of three.js, including its licence.

    Raises
    ------
    RecordError
        If the package is not installed.
    """
    package, file = _THREE
    try:
        return resources.files(package).joinpath(file).read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise RecordError("viewing records in 3D requires three.js: pip install jupyter-threejs-sage") from error


def _inline(program: str) -> str:
    """Escape a program for a script element."""
    return re.sub(r"</(script)", r"<\\/\1", program, flags=re.IGNORECASE).replace("<!--", r"<\!--")


@dataclass(frozen=True)
class Inline:
    """Page that a notebook displays in a frame.

    Parameters
    ----------
    page : str
        HTML text.
    height : int, optional
        Height of the frame [pixel].

    Examples
    --------
    >>> import dynsim
    >>> inline = dynsim.view.Inline("<p>text</p>", height=300)
    >>> '<iframe' in inline._repr_html_()
    True
    """

    page: str
    height: int = 640

    def _repr_html_(self) -> str:
        # Scripts may run, but without the permissions of the notebook.
        return (
            f'<iframe sandbox="allow-scripts allow-downloads" srcdoc="{html.escape(self.page)}" '
            f'style="width:100%;height:{int(self.height)}px;border:0" title="dynsim"></iframe>'
        )

    def __repr__(self) -> str:
        return f"<page of {len(self.page) / 1e6:.2f} MB; write it with save(FILE)>"

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file.

        Parameters
        ----------
        path : str or path-like
            File to write.

        Returns
        -------
        Path
            The written file.

        Raises
        ------
        RecordError
            If the file cannot be written.

        Examples
        --------
        >>> import dynsim, pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = dynsim.view.Inline("<p>text</p>").save(pathlib.Path(folder) / "view.html")
        >>> path.name
        'view.html'
        """
        with replacing(Path(path)) as stream:
            stream.write(self.page.encode("utf-8", errors="replace"))
        return Path(path)


@names_wrong_types
def show(*records: Record, ghost: bool = False, height: int = 640) -> Inline:
    """Show records in 3D, with plots over time; notebooks display the page inline.

    Parameters
    ----------
    *records : Record
        Records to show, side by side.
    ghost : bool, optional
        Overlay the records on the first one instead of showing them side by side.
    height : int, optional
        Height of the frame in a notebook [pixel].

    Returns
    -------
    Inline
        The page, as an object that notebooks display.

    Raises
    ------
    RecordError
        If a record cannot be shown, see :func:`page`.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", overrides={"duration_s": 0.1})
    >>> shown = dynsim.view.show(dynsim.simulate(scenario), height=400)
    """
    named: dict[str, Record] = {}
    for record in records:
        name = str(record.summary.get("variant") or "record")
        named[name if name not in named else f"{name} {len(named) + 1}"] = record
    return Inline(page(named, ghost=ghost), height)
