"""Triangles from mesh files: STL (text and binary), OBJ and COLLADA, the subset that URDF robots use."""

from __future__ import annotations

import io
import itertools
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.system.inputs import read_bytes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
BYTES_MAX = 100_000_000
_UNKNOWN = np.full(3, np.nan)
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


def read_mesh(path: Path) -> Mesh:
    """The mesh of a file, in the frame and unit that a URDF file takes it in, a COLLADA file's with its colours.

    The unit of a COLLADA file is handled, its upward axis is not: so do the viewers that robots are made with.

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
    # Broken files make pycollada raise almost anything.
    except Exception as error:
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
            indices = [int(word.split("/")[0]) for word in words[1:]]
            face = [k - 1 if k > 0 else len(corners) + k for k in indices]
            triangles += [(face[0], b, c) for b, c in itertools.pairwise(face[1:])]
    return Mesh(np.array(corners, dtype=np.float64).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3))


_COLOUR = re.compile(rb"<color\b[^>]*>([^<]*)</color>")


def _collada(content: bytes) -> Mesh:
    import collada

    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise ValueError("entities are not read")
    # A mesh is worth more than its colours: broken ones would take what they are bound to with them.
    content = _COLOUR.sub(lambda match: match[0] if len(match[1].split()) > 2 else b"", content)
    for text in (content, re.sub(b"<bind_material>.*?</bind_material>", b"", content, flags=re.DOTALL)):
        document = collada.Collada(io.BytesIO(text), ignore=[collada.DaeError])
        placed = list((document.scene or document.scenes[0]).objects("geometry"))
        if placed:
            break
    colours = {material.id: _diffuse(material) for material in document.materials}
    corners, triangles, paint, count = [], [], [], 0
    for bound in placed:
        R, p = bound.matrix[:3, :3], bound.matrix[:3, 3]
        for part in bound.original.primitives:
            if isinstance(part, collada.polylist.Polylist):
                part = part.triangleset()
            if not isinstance(part, collada.triangleset.TriangleSet):
                continue
            node = bound.materialnodebysymbol.get(part.material)
            colour = colours.get(node.target.id if node else part.material, _UNKNOWN)
            corners.append(part.vertex @ R.T + p)
            triangles.append(part.vertex_index + count)
            paint.append(np.tile(colour, (len(part.vertex_index), 1)))
            count += len(part.vertex)
    unit = document.assetInfo.unitmeter or 1.0
    known = np.concatenate(paint)
    return Mesh(
        unit * np.concatenate(corners, dtype=np.float64),
        np.concatenate(triangles, dtype=np.int64),
        known if np.isfinite(known).any() else None,
    )


def _diffuse(material: Any) -> Array:
    """Red, green and blue of a material from 0 to 1; NaN where it has a texture or none of them."""
    colour = getattr(material.effect, "diffuse", None)
    if isinstance(colour, tuple) and len(colour) > 2 and np.isfinite(colour[:3]).all():
        return np.clip(colour[:3], 0.0, 1.0)
    return _UNKNOWN
