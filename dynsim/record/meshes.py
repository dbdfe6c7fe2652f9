"""Mesh files of robots: search for them, and read STL, OBJ and COLLADA."""

from __future__ import annotations

import codecs
import io
import itertools
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.system.inputs import read_bytes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
# Limits of one mesh file: its bytes, and the triangles, nested elements and nodes that it contains, copies of instances
# included.
BYTES_MAX, TRIANGLES_MAX, DEPTH_MAX, NODES_MAX = 100_000_000, 2_000_000, 100, 100_000
# Endings of mesh files, also of those that are named but not read.
_KINDS = (".stl", ".obj", ".dae", ".glb", ".gltf")
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
        kind = "glTF mesh (GLB)" if path.suffix.lower() in (".glb", ".gltf") else f"mesh format {path.suffix!r}"
        raise RecordError(f"{path}: {kind} is not supported; convert it to .stl, .obj or .dae")
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
    # Some programs write text after the triangles, or begin the header of a binary file with "solid".
    text = content[:5].lower() == b"solid" and b"facet" in content[:2000]
    if len(content) >= 84 + _RECORD.itemsize * count and not text:
        _check_count(count)
        corners = np.frombuffer(content, _RECORD, count, 84)["corners"].astype(np.float64)
    elif not text:
        present = max(len(content) - 84, 0) // _RECORD.itemsize
        raise ValueError(f"the file ends after {present} of {count} triangles; export it again")
    else:
        _check_count(content.count(b"vertex") // 3)
        numbers = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
        corners = np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def stl_bytes(mesh: Mesh) -> bytes:
    """Return a mesh as a binary STL file, without colours."""
    rows = np.zeros(len(mesh.triangles), _RECORD)
    rows["corners"] = mesh.corners[mesh.triangles]
    return bytes(80) + len(rows).to_bytes(4, "little") + rows.tobytes()


def _obj(content: bytes) -> Mesh:
    corners: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in content.decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            if len(words) < 4:  # without it, the indices of faces would refer to other corners
                raise ValueError(f"corner {len(corners) + 1} has fewer than three coordinates")
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


def mesh_path(file: str, folders: Iterable[Path]) -> Path | None:
    """Return the path of a mesh as named in a robot file, or None if it is not found.

    Packages are searched for as in ROS, in the folders above the robot file, and by the name in their ``package.xml``.
    Otherwise the only file in the robot's package whose path has the longest common end is used.

    Parameters
    ----------
    file : str
        Path, or URL that begins with ``package://``, ``model://`` or ``file://``.
    folders : iterable of Path
        Folder of the robot file; several for robots whose file was copied.
    """
    for path in _places(file, [folder.absolute() for folder in folders]):
        with suppress(OSError, ValueError):
            if path.is_file():
                return path
    return None


def _places(file: str, folders: list[Path]) -> Iterator[Path]:
    """Yield possible paths of a mesh, the best first."""
    scheme, _, inside = file.rpartition("://")
    if scheme not in ("package", "model"):
        yield from (up / inside for folder in folders for up in _upward(folder))
    else:
        package, _, inside = inside.partition("/")
        roots = [above for folder in folders for above in (folder, *folder.parents)]
        paths = {"ROS_PACKAGE_PATH": "", "AMENT_PREFIX_PATH": "share"}
        for variable, below in paths.items():
            roots += [Path(root, below) for root in os.environ.get(variable, "").split(os.pathsep) if root]
        for root in roots:
            yield root / package / inside
            if root.name == package or _package_name(root) == package:
                yield root / inside
    for folder in folders:
        # Of files with equal ends, the one nearest to the robot file; none if two are equally near.
        ends = {path: _equal_names(reversed(path.parts), reversed(Path(inside).parts)) for path in _mesh_files(folder)}
        ranked = [((end, _equal_names(path.parts, folder.parts)), path) for path, end in ends.items() if end]
        best = max((rank for rank, _ in ranked), default=None)
        nearest = [path for rank, path in ranked if rank == best]
        if len(nearest) == 1:
            yield nearest[0]


# Number of folders above a robot file that may be its package, and number of files that are looked at in a package.
_ABOVE, _FILES = 4, 50_000


def _upward(folder: Path) -> tuple[Path, ...]:
    return folder, *itertools.islice(folder.parents, _ABOVE)


@cache
def _mesh_files(folder: Path) -> list[Path]:
    """Return the meshes in the nearest folder above with ``package.xml`` or ``meshes``; without one, in the folder."""
    for up in _upward(folder):
        if (up / "package.xml").is_file() or (up / "meshes").is_dir():
            files = up.rglob("*")
            break
    else:
        files = folder.glob("*")
    return [path for path in itertools.islice(files, _FILES) if path.suffix.lower() in _KINDS]


def _equal_names(names: Iterable[str], others: Iterable[str]) -> int:
    """Return the number of equal names with which two sequences begin; upper and lower case are the same."""
    pairs = zip(names, others, strict=False)
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0].casefold() == pair[1].casefold(), pairs))


_NAME = re.compile(rb"<name>\s*([^<\s]+)\s*</name>")


@cache
def _package_name(folder: Path) -> str:
    """Return the name in the package.xml of a folder; "" without one."""
    with suppress(OSError):
        if name := _NAME.search((folder / "package.xml").read_bytes()[:100_000]):
            return name[1].decode("utf-8", errors="replace")
    return ""
