"""Meshes of robots for pages and films: read each once, and limit the number of triangles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError, first_few
from dynsim.record.meshes import Mesh, mesh_path, read_mesh
from dynsim.record.scene import Scene

# Maximum number of triangles of all meshes of a page, about 1 MB.
TRIANGLES = 100_000
# Corners closer than this fraction of the mesh size are merged; STL files repeat corners for every triangle.
_WELD = 2.0**-20
# Fractions of the mesh size for merging corners before a mesh is simplified, because thin triangles, which are frequent
# in CAD meshes, hinder simplification. The next fraction is tried if more than _TOO_MANY times the allowed number of
# triangles remains.
_COARSE, _TOO_MANY = (1 / 500, 1 / 250, 1 / 120, 1 / 60, 1 / 30, 1 / 20, 1 / 15), 1.5
# Aggressiveness parameter of fast_simplification; edges are collapsed up to an error of 1 % of the mesh size.
_AGGRESSIVENESS = 2.5
# Minimum number of triangles of a solid (a tetrahedron).
_MIN_TRIANGLES = 4


class Meshes:
    """Set of distinct meshes; mesh files are searched for in the folder of a record's robot file."""

    def __init__(self) -> None:
        self.unique: list[Mesh] = []
        self._folders: tuple[Path, ...] = ()
        self._known: dict[Path, int | None] = {}
        self._missing: dict[str, None] = {}
        self._unreadable: dict[str, None] = {}

    def of_robot(self, scene: Scene | None) -> None:
        """Search for further meshes in the folders of the robot of this scene."""
        self._folders = () if scene is None else tuple(map(Path, scene.mesh_folders))

    def index(self, file: str) -> int | None:
        """Return the index of a mesh on the page, or None if it is not found or cannot be read."""
        path = mesh_path(file, self._folders)
        if path is None:
            self._missing[file.rpartition("/")[2]] = None
            return None
        if path not in self._known:
            self._known[path] = self._read(path)
        return self._known[path]

    def find(self, file: str) -> Path | None:
        """Return the absolute path of a mesh file, or None if it is not found."""
        path = mesh_path(file, self._folders)
        return None if path is None else path.absolute()

    def notes(self) -> list[str]:
        """Return notes about meshes that could not be drawn."""
        names = list(self._missing)
        missing = [f"meshes not found, rods instead: {first_few(names)}"] if names else []
        return missing + [f"{reason}; a rod instead" for reason in self._unreadable]

    def _read(self, path: Path) -> int | None:
        try:
            self.unique.append(_welded(path, path.stat().st_mtime_ns))
        except (RecordError, OSError, ValueError) as error:
            self._unreadable[str(error)] = None
            return None
        return len(self.unique) - 1


@lru_cache(maxsize=64)
def _welded(path: Path, changed: int) -> Mesh:
    """Return a mesh file with merged corners; a file that changed since it was read is read again."""
    return welded(read_mesh(path))


def mesh_paths(scene: Scene, files: Iterable[str]) -> dict[str, Path]:
    """Return the paths of the mesh files that are found in the folders of a scene, by their name in the robot file."""
    meshes = Meshes()
    meshes.of_robot(scene)
    return {file: path for file in files if (path := meshes.find(file)) is not None}


def mesh_notes(scenes: Iterable[Scene | None]) -> list[str]:
    """Return notes about the meshes of scenes that cannot be drawn, as on their page; each file is read once."""
    meshes = Meshes()
    for scene in filter(None, scenes):
        meshes.of_robot(scene)
        for shape in (*scene.fixed, *(shape for body in scene.bodies for shape in body.shapes)):
            if shape.kind == "mesh":
                meshes.index(shape.file)
    return meshes.notes()


def welded(mesh: Mesh, near: float = _WELD) -> Mesh:
    """Merge corners closer than ``near`` times the mesh size, and remove triangles that become lines.

    Raises
    ------
    ValueError
        If no triangles remain.
    """
    corners, triangles, colours = mesh
    low, size = _box(corners[triangles])
    if not size > 0.0:
        raise ValueError("the mesh has zero size")
    _, first, number = np.unique(
        np.rint((corners - low) / (near * size)), axis=0, return_index=True, return_inverse=True
    )
    faces = number.reshape(-1)[triangles]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    if not whole.any():
        raise ValueError("the mesh has no faces")
    used, faces = np.unique(faces[whole], return_inverse=True)
    return Mesh(corners[first[used]], faces.reshape(-1, 3), None if colours is None else colours[whole])


def _box(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the lowest corner of the bounding box of some points, and its longest edge [m]."""
    pooled = corners.reshape(-1, 3)
    low = pooled.min(axis=0)
    return low, float((pooled.max(axis=0) - low).max())


def simplified(meshes: Sequence[Mesh], most: int = TRIANGLES) -> list[Mesh]:
    """Simplify meshes to about ``most`` triangles in total; smaller meshes are unchanged.

    Edges are collapsed in the places where this changes the surface least (quadric error metrics, Garland and Heckbert
    1997). Without the extra ``meshes``, corners are merged on a grid instead. Parts with different colours are
    simplified separately, the largest first, and keep their borders, so that no gaps open between them.
    """
    limit = _limit([len(rows) for mesh in meshes for rows in _by_colour(mesh)], most)
    return [_simplified(mesh, limit) for mesh in meshes]


def _simplified(mesh: Mesh, most: int) -> Mesh:
    """Simplify a mesh to at most about ``most`` triangles of each colour."""
    sizes = [len(rows) for rows in _by_colour(mesh)]
    wanted = sum(min(size, most) for size in sizes)
    if wanted == sum(sizes):
        return mesh
    for near in _COARSE:
        coarse = welded(mesh, near)
        coarser = welded(_joined([_decimated(coarse, rows, most) for rows in _by_colour(coarse)]))
        if len(coarser.triangles) <= _TOO_MANY * wanted:
            break
    return coarser


def _by_colour(mesh: Mesh) -> list[NDArray[np.intp]]:
    """Return the rows of the triangles of each colour."""
    if mesh.colours is None:
        return [np.arange(len(mesh.triangles))]
    _, number = np.unique(np.nan_to_num(mesh.colours, nan=-1.0), axis=0, return_inverse=True)
    number = number.reshape(-1)
    return [np.flatnonzero(number == k) for k in range(int(number.max()) + 1)]


def _limit(counts: Sequence[int], most: int) -> int:
    """Return the size to which larger parts must be reduced so that all parts together have ``most`` triangles."""
    left = most
    for k, count in enumerate(sorted(counts)):
        share = left // (len(counts) - k)
        if count > share:
            return max(share, _MIN_TRIANGLES)
        left -= count
    return most


def _decimated(mesh: Mesh, rows: NDArray[np.intp], most: int) -> Mesh:
    """Return some triangles of a mesh as a mesh with at most about ``most`` triangles."""
    used, faces = np.unique(mesh.triangles[rows], return_inverse=True)
    corners, faces = mesh.corners[used], faces.reshape(-1, 3)
    paint = None if mesh.colours is None else mesh.colours[rows]
    if len(faces) <= most:
        return Mesh(corners, faces, paint)
    try:
        from fast_simplification import simplify
    except ImportError:  # an extra; merging of corners alone is coarser
        return Mesh(corners, faces, paint)
    # Scale to unit size, because the thresholds are lengths and a mesh may be in millimetres.
    low, size = _box(corners)
    unit = (corners - low) / size
    fewer, faces = simplify(unit, faces.astype(np.int32), target_count=most, agg=_AGGRESSIVENESS, preserve_border=True)
    return Mesh(low + size * fewer, faces.astype(np.int64), None if paint is None else paint[: len(faces)])


def _joined(parts: Sequence[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(part.corners) for part in parts)])
    colours = [part.colours for part in parts if part.colours is not None]
    return Mesh(
        np.concatenate([part.corners for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate(colours) if colours else None,
    )
