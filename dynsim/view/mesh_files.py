"""Triangles from mesh files: STL (both forms), OBJ and COLLADA, as far as robots of URDF files use them."""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.inputs import read_bytes

Array = NDArray[np.float64]
# Corners, (n, 3) [m], and triangles as their indices, (m, 3).
Triangles = tuple[Array, NDArray[np.int64]]
BYTES_MAX = 100_000_000
# Nodes within nodes of a COLLADA scene.
_DEPTH_MAX = 50
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])


def read_mesh(path: Path) -> Triangles:
    """Corners and triangles of a file, in the frame and unit that a URDF file takes them in.

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
        corners, triangles = reader(content)
    except (ValueError, KeyError, IndexError, ET.ParseError, AttributeError, TypeError) as error:
        raise RecordError(f"{path}: not a mesh that can be read: {error}") from error
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(corners):
        raise RecordError(f"{path}: no triangles, or some of corners that it does not have")
    good = np.isfinite(corners[triangles]).all(axis=(1, 2))
    return corners, triangles[good]


def _stl(content: bytes) -> Triangles:
    count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + _RECORD.itemsize * count:
        corners = np.frombuffer(content, _RECORD, count, 84)["corners"].astype(np.float64)
    else:
        numbers = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
        corners = np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def _obj(content: bytes) -> Triangles:
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
    return np.array(corners, dtype=np.float64).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _collada(content: bytes) -> Triangles:
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise ValueError("entities are not read")
    root = ET.fromstring(content)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    unit = root.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", "1"))
    geometries = {one.get("id", ""): _geometry(one) for one in root.iter("geometry")}
    parts: list[Triangles] = []
    for scene in root.iter("visual_scene"):
        for node in scene.findall("node"):
            _place(node, np.diag([scale, scale, scale, 1.0]), geometries, parts, 0)
    if not parts:
        parts = [(scale * corners, triangles) for corners, triangles in geometries.values()]
    starts = np.cumsum([0, *(len(corners) for corners, _ in parts)])
    faces = [triangles + start for (_, triangles), start in zip(parts, starts, strict=False)]
    return np.concatenate([corners for corners, _ in parts]), np.concatenate(faces)


def _place(node: ET.Element, T: Array, geometries: dict[str, Triangles], parts: list[Triangles], depth: int) -> None:
    """Add the geometries of a node and of those within it, placed by its transforms."""
    if depth > _DEPTH_MAX:
        raise ValueError("nodes within nodes without end")
    for step in node:
        T = T @ _transform(step)
    for instance in node.findall("instance_geometry"):
        corners, triangles = geometries[instance.get("url", "").removeprefix("#")]
        parts.append((corners @ T[:3, :3].T + T[:3, 3], triangles))
    for child in node.findall("node"):
        _place(child, T, geometries, parts, depth + 1)


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


def _geometry(geometry: ET.Element) -> Triangles:
    sources = {f"#{one.get('id')}": one for one in geometry.iter("source")}
    for vertices in geometry.iter("vertices"):
        place = next(one for one in vertices.findall("input") if one.get("semantic") == "POSITION")
        sources[f"#{vertices.get('id')}"] = sources[str(place.get("source"))]
    corners, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
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
            count += len(points)
    return np.concatenate(corners), np.concatenate(faces)


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
