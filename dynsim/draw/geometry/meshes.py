"""Meshes of URDF robots: search for mesh files, read each once, and limit the number of triangles in a page or film."""

from __future__ import annotations

import codecs
import io
import itertools
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError, first_few
from dynsim.record.scene import Scene
from dynsim.system.inputs import read_bytes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
# Limits of one mesh file: its bytes, and the triangles, nested elements and nodes that it contains, copies of instances
# included.
BYTES_MAX, TRIANGLES_MAX, DEPTH_MAX, NODES_MAX = 100_000_000, 2_000_000, 100, 100_000
_UNKNOWN = np.full(3, np.nan)
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])


class Mesh(NamedTuple):
    """Triangle mesh.

    Attributes
    ----------
    corners : (n, 3) ndarray
        Positions [m].
    triangles : (m, 3) ndarray of int
        Indices of corners.
    colours : (m, 3) ndarray or None
        Red, green and blue from 0 to 1, NaN for triangles without a colour; None for a file without colours.
    """

    corners: Array
    triangles: Indices
    colours: Array | None = None


def read_mesh(path: Path) -> Mesh:
    """Read a mesh file (STL, OBJ or COLLADA) in the frame and units of URDF.

    The unit of a COLLADA file is applied; its up axis is ignored, as in other robot viewers.

    Raises
    ------
    RecordError
        If the file cannot be read, has another format, or is damaged.
    """
    reader = {".stl": _stl, ".obj": _obj, ".dae": _collada}.get(path.suffix.lower())
    if reader is None:
        raise RecordError(f"{path}: unsupported mesh format; use .stl, .obj or .dae")
    content = read_bytes(path, RecordError, BYTES_MAX)
    try:
        mesh = reader(content)
    # With damaged files pycollada raises exceptions of almost any type.
    except Exception as error:
        raise RecordError(f"{path}: cannot read mesh: {' '.join(str(error).split())[:200]}") from error
    corners, triangles, colours = mesh
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(corners):
        raise RecordError(f"{path}: the mesh has no triangles, or triangles with invalid corner indices")
    good = np.isfinite(corners[triangles]).all(axis=(1, 2))
    return Mesh(corners, triangles[good], None if colours is None else colours[good])


def _check_count(triangles: int) -> None:
    if triangles > TRIANGLES_MAX:
        raise ValueError(f"{triangles:.3g} triangles; at most {TRIANGLES_MAX:.3g} are read: simplify the mesh")


def _stl(content: bytes) -> Mesh:
    count = int.from_bytes(content[80:84], "little")
    if len(content) >= 84 and len(content) == 84 + _RECORD.itemsize * count:
        _check_count(count)
        corners = np.frombuffer(content, _RECORD, count, 84)["corners"].astype(np.float64)
    else:
        _check_count(content.count(b"vertex") // 3)
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
            _check_count(len(triangles))
    return Mesh(np.array(corners, dtype=np.float64).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3))


_COLOUR = re.compile(rb"<color\b[^>]*>([^<]*)</color>")
_DECLARATION = re.compile(r"\s*<\?xml\b[^>]*\?>")
_ENCODING = re.compile(rb"<\?xml\b[^>]*\bencoding\s*=\s*[\"']([\w.-]+)")


def _collada(content: bytes) -> Mesh:
    import collada

    if content.startswith(b"PK"):
        raise ValueError("a zip archive, not a COLLADA text; unpack it")
    content = _utf8(content)
    _ColladaBudget(content).check()
    # Remove invalid colours; otherwise the geometry that uses them would be lost.
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


def _utf8(content: bytes) -> bytes:
    """Return an XML text in UTF-8 without its declaration, so that all parsers read the same characters."""
    declared = _ENCODING.match(content)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif content.startswith(codecs.BOM_UTF8) or declared is None:
        encoding = "utf-8-sig"
    else:
        encoding = declared[1].decode("ascii")
    if codecs.lookup(encoding).name not in ("utf-8", "utf-8-sig", "utf-16", "ascii", "iso8859-1", "cp1252"):
        raise ValueError(f"encoding {encoding}; use UTF-8")
    return _DECLARATION.sub("", content.decode(encoding), 1).encode("utf-8")


class _ColladaBudget:
    """Sizes of a COLLADA file, counted while it is scanned; instances count as often as they are placed."""

    def __init__(self, content: bytes) -> None:
        # Of every node and geometry: triangles of its own, and the elements that it contains or instantiates.
        self._triangles: Counter[str] = Counter()
        self._parts: dict[str, list[str]] = {}
        self._open: list[tuple[str, str]] = []
        self._scenes: list[str] = []
        self._text: list[str] = []
        self._stride = 1
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartDoctypeDeclHandler = self._doctype
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        parser.CharacterDataHandler = self._characters
        parser.Parse(content, True)

    def check(self) -> None:
        """Raise ValueError if the scenes of the file place too much."""
        sizes: dict[str, tuple[int, int]] = {}

        def size(key: str, above: tuple[str, ...]) -> tuple[int, int]:
            """Return the number of nodes and triangles that an element places."""
            if key in above or len(above) > DEPTH_MAX:
                raise ValueError(f"node {key[1:]!r} contains itself, or instances are nested too deeply")
            if key not in sizes:
                parts = [size(part, (*above, key)) for part in self._parts.get(key, ())]
                sizes[key] = 1 + sum(part[0] for part in parts), self._triangles[key] + sum(part[1] for part in parts)
            return sizes[key]

        for scene in self._scenes:
            nodes, triangles = size(scene, ())
            _check_count(triangles)
            if nodes > NODES_MAX:
                raise ValueError(f"{nodes:.3g} nodes; at most {NODES_MAX:.3g} are read")

    def _doctype(self, *_: object) -> None:
        raise ValueError("XML entities and document types are not allowed")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        tag = name.rpartition(":")[2]
        if len(self._open) >= DEPTH_MAX:
            raise ValueError(f"elements are nested more than {DEPTH_MAX} deep")
        owner = self._open[-1][1] if self._open else ""
        key = owner
        if tag in ("node", "geometry", "visual_scene"):
            key = f"#{attributes.get('id', '')}" if attributes.get("id") else f" {len(self._parts)}"
            self._parts.setdefault(key, [])
            if tag == "node" and owner:
                self._parts[owner].append(key)
            elif tag == "visual_scene":
                self._scenes.append(key)
        elif tag in ("instance_node", "instance_geometry", "instance_controller") and owner:
            self._parts[owner].append(attributes.get("url", ""))
        elif tag == "input":
            offset = attributes.get("offset", "0")
            self._stride = max(self._stride, 1 + (int(offset) if offset.isascii() and offset.isdigit() else 0))
        elif tag in _PRIMITIVES:
            self._stride = 1
        self._text.clear()
        self._open.append((tag, key))

    def _end(self, _: str) -> None:
        tag, key = self._open.pop()
        if tag in ("p", "vcount") and self._open:
            count = sum(len(text.split()) for text in self._text)
            primitive = self._open[-1][0]
            if tag == "vcount":  # a polygon of n corners is n - 2 triangles
                self._triangles[key] -= 2 * count
            elif primitive == "triangles":
                self._triangles[key] += count // self._stride // 3
            else:
                self._triangles[key] += count // self._stride - (0 if primitive == "polylist" else 2)
        self._text.clear()

    def _characters(self, text: str) -> None:
        if self._open and self._open[-1][0] in ("p", "vcount"):
            self._text.append(text)


# Elements of a geometry with indices of corners.
_PRIMITIVES = ("triangles", "polylist", "polygons", "trifans", "tristrips", "lines", "linestrips")


def _diffuse(material: Any) -> Array:
    """Return the red, green and blue of a material from 0 to 1; NaN if it has a texture or no colour."""
    colour = getattr(material.effect, "diffuse", None)
    if isinstance(colour, tuple) and len(colour) > 2 and np.isfinite(colour[:3]).all():
        return np.clip(colour[:3], 0.0, 1.0)
    return _UNKNOWN


# Maximum number of triangles of all meshes of a page, about 1 MB.
TRIANGLES = 100_000
# Corners closer than this fraction of the mesh size are merged; STL files repeat corners for every triangle.
_WELD = 2.0**-20
# Fractions of the mesh size for merging corners before a mesh is simplified, because thin triangles, which are frequent
# in CAD meshes, hinder simplification. The next fraction is tried if more than _TOO_MANY times the allowed number of
# triangles remains.
_COARSE, _TOO_MANY = (1 / 500, 1 / 250, 1 / 120, 1 / 60, 1 / 30), 1.5
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
        exists = False
        for path in self._places(file):
            try:
                if not path.is_file():
                    continue
            except (OSError, ValueError):
                continue
            exists = True
            if path not in self._known:
                self._known[path] = self._read(path)
            if (index := self._known[path]) is not None:
                return index
        if not exists:
            self._missing[file.rpartition("/")[2]] = None
        return None

    def find(self, file: str) -> Path | None:
        """Return the absolute path of a mesh file, or None if it is not found."""
        for path in self._places(file):
            with suppress(OSError, ValueError):
                if path.is_file():
                    return path.absolute()
        return None

    def notes(self) -> list[str]:
        """Return notes about meshes that could not be drawn."""
        names = list(self._missing)
        missing = [f"meshes not found, rods instead: {first_few(names)}"] if names else []
        return missing + [f"{reason}; a rod instead" for reason in self._unreadable]

    def _places(self, file: str) -> Iterator[Path]:
        """Yield possible paths of a mesh: next to the robot file, or in its package.

        Packages are searched for as in ROS, and in the folders above the robot file.
        """
        if not file.startswith("package://"):
            for folder in self._folders:
                yield folder / file.removeprefix("file://")
            return
        package, _, inside = file.removeprefix("package://").partition("/")
        roots = [above for folder in self._folders for above in (folder, *folder.parents)]
        roots += [Path(root) for root in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if root]
        roots += [
            Path(folder, "share") for folder in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if folder
        ]
        for root in roots:
            yield root / package / inside
            if root.name == package:
                yield root / inside

    def _read(self, path: Path) -> int | None:
        try:
            self.unique.append(welded(read_mesh(path)))
        except (RecordError, OSError, ValueError) as error:
            self._unreadable[str(error)] = None
            return None
        return len(self.unique) - 1


def stl_bytes(mesh: Mesh) -> bytes:
    """Return a mesh as a binary STL file, without colours."""
    rows = np.zeros(len(mesh.triangles), _RECORD)
    rows["corners"] = mesh.corners[mesh.triangles]
    return bytes(80) + len(rows).to_bytes(4, "little") + rows.tobytes()


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
    1997). Parts with different colours are simplified separately, the largest first, and keep their borders, so that no
    gaps open between them.
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
    from fast_simplification import simplify

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
