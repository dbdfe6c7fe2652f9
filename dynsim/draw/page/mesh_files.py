"""Triangles from mesh files: STL (both forms), OBJ and COLLADA, as far as robots of URDF files use them."""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.system.inputs import read_bytes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
BYTES_MAX = 100_000_000
# Nodes within nodes of a COLLADA scene.
_DEPTH_MAX = 50
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])


class Mesh(NamedTuple):
    """A surface of triangles.

    Attributes
    ----------
    corners : (n, 3) [m]
    triangles : (m, 3) indices of corners
    colours : (m, 3) red, green and blue from 0 to 1, NaN where the file has none; None: it has none at all
    """

    corners: Array
    triangles: Indices
    colours: Array | None = None


class _Geometry(NamedTuple):
    """A mesh of a COLLADA file, with the symbol of its material for each triangle."""

    corners: Array
    triangles: Indices
    symbols: NDArray[np.str_]


def read_mesh(path: Path) -> Mesh:
    """The mesh of a file, in the frame and unit that a URDF file takes it in, a COLLADA file's with its colours.

    The unit of a COLLADA file is heeded, its upward axis is not: so do the viewers that robots are made with.

    Raises
    ------
    RecordError
        The file cannot be read, is of another format, or broken.
    """
    reader = {".stl": _stl, ".obj": _obj, ".dae": _collada}.get(path.suffix.lower())
    if reader is None:
        raise RecordError(f"{path}: not a mesh that can be read (.stl, .obj, .dae)")
    content = read_bytes(path, RecordError, BYTES_MAX)
    try:
        mesh = reader(content)
    except (ValueError, KeyError, IndexError, ET.ParseError, AttributeError, TypeError) as error:
        raise RecordError(f"{path}: not a mesh that can be read: {error}") from error
    corners, triangles, colours = mesh
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(corners):
        raise RecordError(f"{path}: no triangles, or some of corners that it does not have")
    good = np.isfinite(corners[triangles]).all(axis=(1, 2))
    return Mesh(corners, triangles[good], None if colours is None else colours[good])


def _stl(content: bytes) -> Mesh:
    count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + _RECORD.itemsize * count:
        corners = np.frombuffer(content, _RECORD, count, 84)["corners"].astype(np.float64)
    else:
        numbers = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
        corners = np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _obj(content: bytes) -> Mesh:
    corners: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in content.decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if len(words) >= 4 and words[0] == "v":
            corners.append([float(word) for word in words[1:4]])
        elif len(words) >= 4 and words[0] == "f":
            found = [int(word.split("/")[0]) for word in words[1:]]
            face = [k - 1 if k > 0 else len(corners) + k for k in found]
            triangles += [(face[0], b, c) for b, c in itertools.pairwise(face[1:])]
    return Mesh(np.array(corners, dtype=np.float64).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3))


def _collada(content: bytes) -> Mesh:
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise ValueError("entities are not read")
    root = ET.fromstring(content)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    unit = root.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", "1"))
    geometries = {one.get("id", ""): _geometry(one) for one in root.iter("geometry")}
    known = _colours(root)
    parts: list[Mesh] = []
    for scene in root.iter("visual_scene"):
        for node in scene.findall("node"):
            _place(node, np.diag([scale, scale, scale, 1.0]), geometries, known, parts, 0)
    if not parts:
        parts = [Mesh(scale * one.corners, one.triangles, _painted(one, known)) for one in geometries.values()]
    starts = np.cumsum([0, *(len(part.corners) for part in parts)])
    faces = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    unknown = [np.full((len(part.triangles), 3), np.nan) if part.colours is None else part.colours for part in parts]
    colours = np.concatenate(unknown)
    return Mesh(
        np.concatenate([part.corners for part in parts]),
        np.concatenate(faces),
        colours if np.isfinite(colours).any() else None,
    )


def _colours(root: ET.Element) -> dict[str, Array]:
    """Diffuse colours of materials by their ids; textures have none."""
    effects = {}
    for effect in root.iter("effect"):
        try:
            numbers = _numbers(effect.find(".//diffuse/color"))
        except ValueError:  # a mesh is worth more than its colours
            continue
        if len(numbers) >= 3 and np.isfinite(numbers).all():
            effects[f"#{effect.get('id')}"] = np.clip(numbers[:3], 0.0, 1.0)
    materials = {}
    for material in root.iter("material"):
        instance = material.find("instance_effect")
        if instance is not None and (url := instance.get("url", "")) in effects:
            materials[material.get("id", "")] = effects[url]
    return materials


def _painted(geometry: _Geometry, known: Mapping[str, Array]) -> Array:
    """Colours of triangles, (m, 3), by the symbols of their materials."""
    colours = np.full((len(geometry.triangles), 3), np.nan)
    for symbol in set(geometry.symbols.tolist()) & set(known):
        colours[geometry.symbols == symbol] = known[symbol]
    return colours


def _place(
    node: ET.Element,
    T: Array,
    geometries: Mapping[str, _Geometry],
    known: Mapping[str, Array],
    parts: list[Mesh],
    depth: int,
) -> None:
    """Add the geometries of a node and of those within it, placed by its transforms."""
    if depth > _DEPTH_MAX:
        raise ValueError("nodes within nodes without end")
    for step in node:
        T = T @ _transform(step)
    for instance in node.findall("instance_geometry"):
        geometry = geometries[instance.get("url", "").removeprefix("#")]
        bound = {
            one.get("symbol", ""): known[target]
            for one in instance.iter("instance_material")
            if (target := one.get("target", "").removeprefix("#")) in known
        }
        corners = geometry.corners @ T[:3, :3].T + T[:3, 3]
        parts.append(Mesh(corners, geometry.triangles, _painted(geometry, {**known, **bound})))
    for child in node.findall("node"):
        _place(child, T, geometries, known, parts, depth + 1)


def _transform(step: ET.Element) -> Array:
    T = np.eye(4)
    if step.tag not in ("matrix", "translate", "rotate", "scale"):
        return T
    numbers = _numbers(step)
    if step.tag == "matrix":
        return numbers.reshape(4, 4)
    if step.tag == "translate":
        T[:3, 3] = numbers
    elif step.tag == "scale":
        T[:3, :3] = np.diag(numbers)
    else:
        axis, angle = numbers[:3] / max(float(np.linalg.norm(numbers[:3])), 1e-12), np.radians(numbers[3])
        K = np.cross(np.eye(3), -axis)
        T[:3, :3] = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    return T


def _geometry(geometry: ET.Element) -> _Geometry:
    sources = {f"#{one.get('id')}": one for one in geometry.iter("source")}
    for vertices in geometry.iter("vertices"):
        place = next(one for one in vertices.findall("input") if one.get("semantic") == "POSITION")
        sources[f"#{vertices.get('id')}"] = sources[str(place.get("source"))]
    corners, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    symbols: list[str] = []
    for kind in ("triangles", "polylist", "polygons"):
        for part in geometry.iter(kind):
            inputs = part.findall("input")
            stride = 1 + max(int(one.get("offset", "0")) for one in inputs)
            place = next(one for one in inputs if one.get("semantic") == "VERTEX")
            points = _numbers(sources[str(place.get("source"))].find("float_array")).reshape(-1, 3)
            index = [_numbers(p).astype(np.int64).reshape(-1, stride) for p in part.findall("p")]
            sizes = part.find("vcount")
            if kind == "polygons":
                lengths = np.array([len(one) for one in index])
            else:
                total = sum(map(len, index))
                lengths = _numbers(sizes).astype(np.int64) if sizes is not None else np.full(total // 3, 3)
            if not index:
                continue
            corners.append(points)
            faces.append(_fans(np.concatenate(index)[:, int(place.get("offset", "0"))], lengths) + count)
            symbols += len(faces[-1]) * [part.get("material", "")]
            count += len(points)
    return _Geometry(np.concatenate(corners), np.concatenate(faces), np.array(symbols, dtype=np.str_))


def _fans(index: NDArray[np.int64], lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of polygons of so many corners each."""
    starts = np.cumsum(lengths) - lengths
    found = []
    for size in np.unique(lengths[lengths >= 3]).tolist():
        first = starts[lengths == size]
        found += [np.stack([index[first], index[first + k], index[first + k + 1]], axis=1) for k in range(1, size - 1)]
    return np.concatenate(found) if found else np.zeros((0, 3), dtype=np.int64)


def _numbers(element: ET.Element | None) -> Array:
    text = "" if element is None or element.text is None else element.text
    return np.array(text.split(), dtype=np.float64)
