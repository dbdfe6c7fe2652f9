"""Meshes of robots from URDF files: found, thinned to what a page can carry, read once each."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.view.blocks import Blocks
from dynsim.view.mesh_files import Mesh, read_mesh

# Triangles of one mesh at most: seven links of a robot are then some 150 kB.
TRIANGLES = 5000
# Cells along the longest side of a mesh, the first that leaves few enough triangles.
CELLS = (2000, 400, 250, 160, 100, 64, 40, 24, 12)
_CODES = 65535.0


class Meshes:
    """Meshes, each once, with at most so many triangles; those of a record are looked for where its robot's file is."""

    def __init__(self, most: int = TRIANGLES) -> None:
        self.found: list[Mesh] = []
        self._most = most
        self._folders: tuple[Path, ...] = ()
        self._known: dict[Path, int | None] = {}
        self._missing: dict[str, None] = {}

    def of_robot(self, record: Record) -> None:
        """Look for what follows where the robot of this record came from."""
        scenario = record.provenance.get("scenario", {})
        files = _named(scenario.get("plant", {}) if isinstance(scenario, Mapping) else {}, "file")
        self._folders = tuple(Path(file).parent for file in files)

    def index(self, file: str) -> int | None:
        """Number of a mesh among those of the page; None where there is none, or it cannot be read."""
        for path in self._places(file):
            if path not in self._known:
                self._known[path] = self._read(path)
            if (found := self._known[path]) is not None:
                return found
        self._missing[file.rpartition("/")[2]] = None
        return None

    def notes(self) -> list[str]:
        """What could not be drawn."""
        names = list(self._missing)
        more = f" and {len(names) - 4} more" if len(names) > 4 else ""
        return [f"meshes not found, rods instead: {', '.join(names[:4])}{more}"] if names else []

    def _places(self, file: str) -> Iterator[Path]:
        """Where a mesh may lie: beside the robot's file, or in its package, found like ROS does or above that file."""
        if not file.startswith("package://"):
            for folder in self._folders:
                yield folder / file.removeprefix("file://")
            return
        package, _, rest = file.removeprefix("package://").partition("/")
        roots = [above for folder in self._folders for above in (folder, *folder.parents)]
        roots += [Path(one) for one in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if one]
        roots += [Path(one, "share") for one in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if one]
        for root in roots:
            yield root / package / rest
            if root.name == package:
                yield root / rest

    def _read(self, path: Path) -> int | None:
        try:
            if not path.is_file():
                return None
            self.found.append(thinned(read_mesh(path), self._most))
        except (RecordError, OSError, ValueError):
            return None
        return len(self.found) - 1


def packed(mesh: Mesh, blocks: Blocks) -> dict[str, Any]:
    """A mesh as the page reads it: corners in 16 bits within their box, triangles, and which colours they have."""
    corners, triangles, colours = mesh
    low, high = corners.min(axis=0), corners.max(axis=0)
    step = np.where(high > low, (high - low) / _CODES, 1.0)
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


def thinned(mesh: Mesh, most: int = TRIANGLES) -> Mesh:
    """The same surface with at most so many triangles: corners within one cell of a grid become one.

    Raises
    ------
    ValueError
        Nothing is left of it.
    """
    corners, triangles, colours = mesh
    low = corners[triangles].min(axis=(0, 1))
    size = float((corners[triangles].max(axis=(0, 1)) - low).max())
    if not size > 0.0:
        raise ValueError("a mesh without size")
    for cells in CELLS:
        cell = np.rint((corners - low) * (cells / size)).astype(np.int64)
        _, place, number = np.unique(cell, axis=0, return_index=True, return_inverse=True)
        faces = number.reshape(-1)[triangles]
        whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        faces = faces[whole]
        # The same three corners in the same sense, beginning with the least.
        first = faces.argmin(axis=1)[:, None]
        faces, kept = np.unique(
            np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1), axis=0, return_index=True
        )
        if len(faces) <= most:
            break
    if not len(faces):
        raise ValueError("a mesh without faces")
    used, faces = np.unique(faces, return_inverse=True)
    painted = None if colours is None else colours[whole][kept]
    return Mesh(corners[place[used]], faces.reshape(-1, 3), painted)


def _named(tree: Any, key: str) -> Iterator[str]:
    """Texts of a key, wherever it is."""
    if isinstance(tree, Mapping):
        for name, value in tree.items():
            if name == key and isinstance(value, str):
                yield value
            else:
                yield from _named(value, key)
