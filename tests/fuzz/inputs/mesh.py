"""Meshes of a URDF robot in OBJ, STL and COLLADA: random ones, whose triangles are known, and damaged ones."""

from __future__ import annotations

import itertools
import math
import re
import struct
import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzz.case import Draft
from fuzz.mutations import mutate_blocks, mutate_bytes, mutate_text
from fuzz.readings import DECIMAL, Unreadable

SCENARIO = b"duration_s: 0.01\nplant: {type: urdf_arm, file: robot.urdf}\n"
ROBOT = (
    '<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="0.5"/><origin xyz="0 0 0.1"/>'
    '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial><visual><geometry>'
    '<mesh filename="{file}"/></geometry></visual></link><joint name="j" type="continuous"><parent link="base"/>'
    '<child link="arm"/><axis xyz="0 1 0"/></joint></robot>'
)
# Numbers of a mesh file are often of single precision.
PRECISION = 1e-6


def draw(rng: Random, records: Path, kind: str) -> Draft:
    count, sound = rng.choice((3, 4, 8, 40)), rng.random() < 0.5
    corners = [[float(f"{rng.uniform(-1, 1):.6g}") for _ in range(3)] for _ in range(count)]
    faces = [
        rng.sample(range(count), rng.choice((3, 3, 4, 5)) if count > 4 else 3) for _ in range(rng.choice((1, 2, 6, 50)))
    ]
    data = {"obj": _obj, "stl": _stl, "dae": _dae}[kind](rng, corners, faces)
    mutation = f"{len(faces)} faces"
    if not sound:
        binary = b"\x00" in data
        choice = rng.random()
        if choice < 0.4 and not binary:
            data, mutation = mutate_text(rng, data.decode())
        elif choice < 0.85:
            data, mutation = mutate_bytes(rng, data)
        else:
            data, mutation = mutate_blocks(rng, data)
    name = f"mesh.{kind}"
    files: dict[str, bytes | str] = {
        "scenario.yaml": SCENARIO, "robot.urdf": ROBOT.format(file=name).encode(), name: data,
    }  # fmt: skip
    commands = [["check", "scenario.yaml"]]
    if rng.random() < 0.1:
        commands = [["run", "scenario.yaml", "--quiet", "--no-figures", "--out", "out"],
                    ["view", "out/record.h5", "--no-open", "--out", "page.html"]]  # fmt: skip
    return Draft(mutation, files, commands, partial(losses, kind, sound))


def _obj(rng: Random, corners: list[list[float]], faces: list[list[int]]) -> bytes:
    """Return an OBJ file with comments, texture and normal indices, and indices from either end."""
    suffix = rng.choice(("", "/1", "/1/1", "//1"))
    lines = ["# mesh", "o part", *(f"v {x} {y} {z}" + rng.choice(("", " 1.0")) for x, y, z in corners), "vn 0 0 1"]
    for face in faces:
        relative = rng.random() < 0.3
        lines.append("f " + " ".join(f"{k - len(corners) if relative else k + 1}{suffix}" for k in face))
        lines += rng.choice(([], [], ["s off"], ["usemtl x"], [""]))
    return (rng.choice(("\n", "\r\n")).join(lines) + "\n").encode()


def _stl(rng: Random, corners: list[list[float]], faces: list[list[int]]) -> bytes:
    triangles = [[corners[k] for k in triangle] for face in faces for triangle in _fan(face)]
    if rng.random() < 0.5:
        records = (
            struct.pack("<12fH", 0, 0, 1, *(x for corner in triangle for x in corner), 0) for triangle in triangles
        )
        return (
            rng.choice((b"\0", b" ", b"solid ")).ljust(80, b" ") + struct.pack("<I", len(triangles)) + b"".join(records)
        )
    loops = (
        "facet normal 0 0 1\n outer loop\n" + "".join(f"  vertex {x} {y} {z}\n" for x, y, z in triangle)
        + " endloop\nendfacet\n" for triangle in triangles
    )  # fmt: skip
    return ("solid x\n" + "".join(loops) + "endsolid x\n").encode()


def _dae(rng: Random, corners: list[list[float]], faces: list[list[int]]) -> bytes:
    """Return a COLLADA file with a unit, nodes in nodes, copies of nodes, and normals between the indices."""

    def moves() -> str:
        return "".join(
            rng.choice((
                f"<translate>{rng.uniform(-1, 1):.4g} 0 2</translate>",
                f"<rotate>{rng.choice(('1 0 0', '0 1 0', '0.6 0 0.8'))} {rng.uniform(-180, 180):.4g}</rotate>",
                "<scale>2 1 0.5</scale>",
                "<matrix>0 -1 0 0.5 1 0 0 0 0 0 1 -0.25 0 0 0 1</matrix>",
            )) for _ in range(rng.choice((0, 1, 2)))
        )  # fmt: skip

    normals = rng.random() < 0.5
    kind = rng.choice(("triangles", "polylist"))
    shown = [list(triangle) for face in faces for triangle in _fan(face)] if kind == "triangles" else faces
    index = " ".join(f"{k} 0" if normals else f"{k}" for face in shown for k in face)
    counts = f"<vcount>{' '.join(str(len(face)) for face in shown)}</vcount>" if kind == "polylist" else ""
    parts = "".join(f'<param name="{name}" type="float"/>' for name in "XYZ")

    def source(name: str, numbers: str, count: int) -> str:
        return (
            f'<source id="{name}"><float_array id="{name}a" count="{3 * count}">{numbers}</float_array>'
            f'<technique_common><accessor source="#{name}a" count="{count}" stride="3">{parts}</accessor>'
            "</technique_common></source>"
        )

    numbers = " ".join(f"{x}" for corner in corners for x in corner)
    inputs = '<input semantic="VERTEX" source="#v" offset="0"/>'
    inputs += '<input semantic="NORMAL" source="#n" offset="1"/>' if normals else ""
    shape = f'{moves()}<instance_geometry url="#g"/>'
    copied = rng.random() < 0.4
    library = f'<library_nodes><node id="c">{shape}</node></library_nodes>' if copied else ""
    shape = "".join(f'<node>{moves()}<instance_node url="#c"/></node>' for _ in range(2)) if copied else shape
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{rng.choice(("1", "0.01", "0.0254"))}"/><up_axis>{rng.choice(("Y_UP", "Z_UP"))}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
{source("p", numbers, len(corners))}{source("n", "0 0 1", 1)}
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<{kind} count="{len(shown)}">{inputs}{counts}<p>{index}</p></{kind}>
</mesh></geometry></library_geometries>
{library}<library_visual_scenes><visual_scene id="s">
<node>{moves()}<node>{shape}</node></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
""".encode()


def _fan(face: list[int]) -> list[tuple[int, int, int]]:
    return [(face[0], face[k], face[k + 1]) for k in range(1, len(face) - 1)]


def losses(kind: str, sound: bool) -> list[str]:
    """Return triangles in which the mesh differs from a second reading; refuse a sound mesh as a loss."""
    from dynsim.errors import RecordError
    from dynsim.record.meshes import read_mesh

    path = Path(f"mesh.{kind}")
    try:
        mesh = read_mesh(path)
    except RecordError as error:
        if sound and path.is_file() and not path.is_symlink() and path.stat().st_size:
            return [f"a valid mesh is refused: {error}"]
        raise
    taken = mesh.corners[mesh.triangles]
    try:
        said = {"obj": _read_obj, "stl": _read_stl, "dae": _read_dae}[kind](path.read_bytes())
    except Unreadable:
        raise
    except (ValueError, LookupError, AttributeError, ElementTree.ParseError, OverflowError) as error:
        raise Unreadable(str(error)) from error
    said = said[np.isfinite(said).all(axis=(1, 2))]
    if said.shape != taken.shape:
        return [f"{len(said)} triangles became {len(taken)}"]
    scale = max(1.0, float(np.abs(said).max(initial=0.0)))
    return [] if np.allclose(said, taken, rtol=PRECISION, atol=PRECISION * scale) else ["triangles moved"]


def _number(text: str) -> float:
    if not DECIMAL.fullmatch(text):
        raise Unreadable(text)
    return float(text)


def _read_obj(data: bytes) -> np.ndarray:
    corners, triangles = [], []
    for line in re.split("\r\n?|\n", data.decode("ascii")):
        words = line.split()
        if words[:1] == ["v"]:
            corners.append([_number(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            numbers = [int(word.partition("/")[0]) for word in words[1:]]
            triangles += _fan([k - 1 if k > 0 else len(corners) + k for k in numbers])
    if any(k < 0 for triangle in triangles for k in triangle):
        raise Unreadable("index")
    return np.array([[corners[k] for k in triangle] for triangle in triangles], float).reshape(-1, 3, 3)


def _read_stl(data: bytes) -> np.ndarray:
    if len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        return np.array([row[3:12] for row in struct.iter_unpack("<12fH", data[84:])], float).reshape(-1, 3, 3)
    words = data.decode("ascii").split()
    starts = [k for k, word in enumerate(words) if word == "vertex"]
    if data.count(b"vertex") != len(starts) or 3 * words.count("facet") != len(starts):
        raise Unreadable("an incomplete facet")
    return np.array([[_number(word) for word in words[k + 1 : k + 4]] for k in starts], float).reshape(-1, 3, 3)


def _read_dae(data: bytes) -> np.ndarray:
    """Return the triangles of a COLLADA file as the generator of this module writes it."""
    root = ElementTree.fromstring(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    by_id: dict[str, Any] = {str(element.get("id")): element for element in root.iter() if element.get("id")}
    shapes = {f"#{geometry.get('id')}": _shape(geometry, by_id) for geometry in root.iter("geometry")}

    def placed(node: ElementTree.Element, T: np.ndarray, depth: int) -> list[np.ndarray]:
        if depth > 20:
            raise Unreadable("nested too deeply")
        parts = []
        for child in node:
            numbers = [_number(word) for word in (child.text or "").split()]
            if child.tag in ("translate", "rotate", "scale", "matrix"):
                T = T @ _transform(child.tag, numbers)
        for child in node:
            if child.tag == "node":
                parts += placed(child, T, depth + 1)
            elif child.tag == "instance_node":
                parts += placed(by_id[str(child.get("url"))[1:]], T, depth + 1)
            elif child.tag == "instance_geometry":
                parts.append(shapes[str(child.get("url"))] @ T[:3, :3].T + T[:3, 3])
        return parts

    unit = root.find("asset/unit")
    meter = _number(unit.get("meter", "1")) if unit is not None else 1.0
    scenes = root.findall("library_visual_scenes/visual_scene")
    if len(scenes) != 1 or not meter:
        raise Unreadable("several scenes")
    parts = [part for node in scenes[0] for part in placed(node, np.eye(4), 0)]
    return meter * np.concatenate(parts)


def _shape(geometry: ElementTree.Element, by_id: dict[str, Any]) -> np.ndarray:
    triangles = []
    for primitive in (*geometry.iter("triangles"), *geometry.iter("polylist")):
        inputs = {str(item.get("semantic")): item for item in primitive.findall("input")}
        stride = 1 + max(int(item.get("offset", "0")) for item in inputs.values())
        vertices = by_id[str(inputs["VERTEX"].get("source"))[1:]]
        source = by_id[str(vertices.find("input").get("source"))[1:]]
        numbers = [_number(word) for word in source.find("float_array").text.split()]
        corners = [numbers[k : k + 3] for k in range(0, len(numbers), 3)]
        index = [int(word) for word in primitive.find("p").text.split()][
            int(inputs["VERTEX"].get("offset", "0")) :: stride
        ]
        if primitive.tag == "polylist":
            sizes = [int(word) for word in primitive.find("vcount").text.split()]
        else:
            sizes = [3] * (len(index) // 3)
        if sum(sizes) != len(index) or min(index) < 0:
            raise Unreadable("a face is incomplete")
        ends = np.cumsum([0, *sizes])
        faces = [index[a:b] for a, b in itertools.pairwise(ends)]
        triangles += [[corners[k] for k in triangle] for face in faces for triangle in _fan(face)]
    return np.array(triangles, float).reshape(-1, 3, 3)


def _transform(kind: str, numbers: list[float]) -> np.ndarray:
    T = np.eye(4)
    if kind == "translate":
        T[:3, 3] = numbers
    elif kind == "scale":
        T[:3, :3] = np.diag(numbers)
    elif kind == "matrix":
        T = np.array(numbers).reshape(4, 4)
    else:
        axis, angle = np.array(numbers[:3]) / np.linalg.norm(numbers[:3]), math.radians(numbers[3])
        K = np.cross(np.eye(3), axis)
        T[:3, :3] = np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K
    return T
