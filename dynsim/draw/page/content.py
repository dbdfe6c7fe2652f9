"""Data of a viewer page: body poses, paths, contacts, supports, motors, signals, events."""

from __future__ import annotations

import base64
import gzip
import html
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim._version import __version__
from dynsim.draw.film.painter import view_axes
from dynsim.draw.geometry.meshes import Mesh, Meshes, simplified
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
from dynsim.draw.geometry.shapes import (
    body_shapes,
    cop_of,
    drawn_shape,
    drawn_surface,
    gripper,
    supports,
    thinnest,
    wheel_groups,
)
from dynsim.errors import RecordError
from dynsim.record import TIME, Record, Signal
from dynsim.record.measures import GRIPPER_STATES, hand_target
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.scene import Scene
from dynsim.system.files import replacing

# Compression of time series for pages: quantised, differenced, and split into byte planes.


# Largest code of a finite value by number of bits; 32 bits are used where half a step of 16 exceeds the allowed error.
_CODES = {16: 2**16 - 2, 32: 2**32 - 2}
_TYPES: dict[int, np.dtype[Any]] = {16: np.dtype("<u2"), 32: np.dtype("<u4")}


class Blocks:
    """Collects blocks; the description of a block goes into the head of the page."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, columns: ArrayLike, error: float = np.inf) -> dict[str, Any]:
        """Add columns, (T,) or (T, …), each to half a step of its range in 16 bits, or 32 where ``error`` is less."""
        data = np.asarray(columns, dtype=np.float64)
        data = data.reshape(len(data), -1) if len(data) else data.reshape(0, 1)
        known = np.isfinite(data)
        low = np.where(known, data, np.inf).min(axis=0, initial=np.inf)
        high = np.where(known, data, -np.inf).max(axis=0, initial=-np.inf)
        some = np.isfinite(low)
        low, span = np.where(some, low, 0.0), np.where(some, high - low, 0.0)
        bits = 16 if 0.5 * span.max(initial=0.0) / _CODES[16] <= error else 32
        scale = span / _CODES[bits]
        with np.errstate(all="ignore"):
            codes = np.rint((np.where(known, data, low) - low) / np.where(scale > 0.0, scale, 1.0))
        kind = _TYPES[bits]
        codes = np.where(known, codes, float(_CODES[bits] + 1)).astype(kind)
        steps = np.diff(codes.T, axis=1, prepend=np.zeros((codes.shape[1], 1), dtype=kind))
        planes = np.ascontiguousarray(steps).view(np.uint8).reshape(-1, bits // 8).T
        content = np.ascontiguousarray(planes).tobytes()
        self._parts.append(content)
        start, self._size = self._size, self._size + len(content)
        header = {"at": start, "rows": len(data), "columns": int(codes.shape[1]), "bits": bits}
        return header | {"offset": low.tolist(), "scale": scale.tolist()}

    def raw(self, data: NDArray[Any]) -> dict[str, Any]:
        """Add an array of whole numbers ≥ 0 as it is (a mesh), little endian: in 16 bits, or 32 if one needs them."""
        bits = 16 if data.max(initial=0) < 2**16 else 32
        content = data.astype(_TYPES[bits]).tobytes()
        self._parts.append(content)
        start, self._size = self._size, self._size + len(content)
        return {"at": start, "count": int(data.size), "bits": bits}

    def packed(self, head: dict[str, Any]) -> str:
        """Head and blocks: the length of the head in 4 bytes, its JSON, the blocks; compressed, in base64."""
        text = json.dumps(head, allow_nan=False, separators=(",", ":"), ensure_ascii=True).encode("ascii")
        content = len(text).to_bytes(4, "little") + text + b"".join(self._parts)
        # No time in it: the same record gives the same page.
        return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode("ascii")


def packed_mesh(mesh: Mesh, blocks: Blocks) -> dict[str, Any]:
    """A mesh as the page reads it: corners in 16 bits within their box, triangles, and the colours of these."""
    corners, triangles, colours = mesh
    low, high = corners.min(axis=0), corners.max(axis=0)
    step = np.where(high > low, (high - low) / 65535.0, 1.0)
    paint: dict[str, Any] = {}
    if colours is not None:
        # −1 for none: numbers that are none are equal to nothing.
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
# Most samples of a signal in plots; of longer signals the least and the largest value of each bin are kept.
PLOTTED = 8000
# Largest relative error of the heat by the trapezoidal rule against that of the record: currents may jump between
# samples.
HEAT_ERROR = 0.05
# Signals that the 3D view shows, and plots do not.
_SHOWN = {POSITION, ORIENTATION, "posture"}


def packed(records: Mapping[str, Record], *, ghost: bool = False) -> str:
    """Head and blocks of a page, in base64; see :func:`dynsim.draw.page.content.page`.

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
        "measured": record.measured,
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
        "limit": scene.voltage_limit,
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


def resistance(record: Record) -> float | None:
    """R of the motors [Ω] where they share one, and R ∫ Σ i² dt is the heat that was recorded."""
    R = None if record.scene is None else record.scene.resistance
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


# The HTML text of a viewer page: its scripts and styles, three.js from its package, and the data; writing of pages.


SCRIPTS = ("decode", "solids", "marks", "actor", "stage", "plots", "controls", "main")
"""Files of the page's program, in the order in which they are loaded."""
_THREE = ("jupyter_threejs_sage", "static/r130/three.min.js")


def page(records: Mapping[str, Record], *, ghost: bool = False, scripts: Sequence[str] = (), connect: str = "") -> str:
    """The page of one record, or of several beside each other.

    Parameters
    ----------
    records : by the names that the page shows
    ghost : several are laid over each other, the first one solid
    scripts : texts of further programs, which run after the page's own and find it as ``dynsim``
    connect : the one address that a page of a live drive may connect to; a page of records has none

    Raises
    ------
    RecordError
        There is nothing to be seen: no record with samples and a scene; or three.js is not installed.
    """
    data = packed(records, ghost=ghost)
    titles = (record.title.partition(" / ")[0] for record in records.values())
    title = next(filter(None, titles), "record")
    allowed = f"; connect-src {html.escape(connect)}" if connect else ""
    return _filled({"title": html.escape(title), "data": data, "connect": allowed}, scripts)


def write(records: Mapping[str, Record], path: str | os.PathLike[str], *, ghost: bool = False) -> Path:
    """Write the page of :func:`page` to a file: complete or not at all.

    Raises
    ------
    RecordError
        As :func:`page`, or the file cannot be written.
    """
    content = page(records, ghost=ghost).encode("utf-8", errors="replace")
    with replacing(Path(path)) as stream:
        stream.write(content)
    return Path(path)


def _filled(values: Mapping[str, str], scripts: Sequence[str]) -> str:
    own = resources.files("dynsim.draw.page").joinpath("page")
    style = own.joinpath("style.css").read_text(encoding="utf-8")
    program = "\n".join(own.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS)
    program = "\n".join([program, *scripts])
    parts = {"style": style, "three": _inline(three()), "program": _inline(program), **values}
    text = own.joinpath("page.html").read_text(encoding="utf-8")
    return re.sub(r"<!--\{(\w+)\}-->", lambda match: parts[match[1]], text)


def three() -> str:
    """The text of three.js, with its licence in its first lines.

    Raises
    ------
    RecordError
        The package is not installed.
    """
    package, file = _THREE
    try:
        return resources.files(package).joinpath(file).read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise RecordError("to view records in 3D: pip install jupyter-threejs-sage") from error


def _inline(program: str) -> str:
    """As it may stand within a script element."""
    return re.sub(r"</(script)", r"<\\/\1", program, flags=re.IGNORECASE).replace("<!--", r"<\!--")


# A viewer page shown inside a notebook.


@dataclass(frozen=True)
class Inline:
    """A page that a notebook shows in a frame of its own, ``height`` pixels high; :meth:`save` writes it to a file."""

    page: str
    height: int = 640

    def _repr_html_(self) -> str:
        # Scripts run, but not with the rights of the notebook.
        return (
            f'<iframe sandbox="allow-scripts allow-downloads" srcdoc="{html.escape(self.page)}" '
            f'style="width:100%;height:{int(self.height)}px;border:0" title="dynsim"></iframe>'
        )

    def __repr__(self) -> str:
        return f"<page of {len(self.page) / 1e6:.2f} MB; save(FILE) writes it>"

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file.

        Raises
        ------
        RecordError
            The file cannot be written.
        """
        with replacing(Path(path)) as stream:
            stream.write(self.page.encode("utf-8", errors="replace"))
        return Path(path)


def show(*records: Record, ghost: bool = False, height: int = 640) -> Inline:
    """Show records in 3D, with plots over time; notebooks display the page inline.

    Parameters
    ----------
    *records : Record
        Records to show, side by side.
    ghost : bool, optional
        Overlay the records after the first one on it instead.
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
