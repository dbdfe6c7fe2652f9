"""Visual shapes and named colours of URDF links (``<visual>``), read leniently.

Shapes have no part in the mechanics, and URDF files often contain broken ones, or formats of other programs: a shape
that cannot be parsed is left out without an error. A mesh keeps its file name; the file is not opened here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dynsim.model.urdf.xml import Element
from dynsim.record.quaternion import of_turn, product
from dynsim.record.scene import Shape, ShapeKind

Colour = tuple[float, float, float, float]
# As in dynsim.model.urdf.xml: no length, scale or angle is larger.
_LARGEST = 1e15


def materials(robot: Element) -> dict[str, Colour]:
    """Colours that the file defines by name, outside of its links."""
    colours = {
        child.attributes.get("name", ""): _colour(child, {}) for child in robot.children if child.tag == "material"
    }
    return {name: colour for name, colour in colours.items() if colour is not None}


def visual_shapes(link: Element, named_colours: Mapping[str, Colour]) -> tuple[Shape, ...]:
    """Shapes of a link in its frame; ``named_colours`` are colours by name."""
    shapes = [_shape(child, named_colours) for child in link.children if child.tag == "visual"]
    return tuple(shape for shape in shapes if shape is not None)


def _shape(visual: Element, named_colours: Mapping[str, Colour]) -> Shape | None:
    geometry = visual.child("geometry")
    if geometry is None or len(geometry.children) != 1:
        return None
    solid = geometry.children[0]
    material = visual.child("material")
    colour = None if material is None else _colour(material, named_colours)
    origin = visual.child("origin")
    xyz = (0.0, 0.0, 0.0) if origin is None else _numbers(origin, "xyz", 3, "0 0 0")
    rpy = (0.0, 0.0, 0.0) if origin is None else _numbers(origin, "rpy", 3, "0 0 0")
    kind: ShapeKind
    file = ""
    match solid.tag:
        case "box":
            kind, size = "box", _numbers(solid, "size", 3)
        case "sphere":
            kind, size = "sphere", _numbers(solid, "radius", 1)
        case "cylinder" | "capsule":
            kind = "cylinder" if solid.tag == "cylinder" else "capsule"
            size = _numbers(solid, "radius", 1) + _numbers(solid, "length", 1)
            size = size if len(size) == 2 else ()
        case "mesh":
            kind, size, file = "mesh", _numbers(solid, "scale", 3, "1 1 1"), solid.attributes.get("filename", "")
            size = size if file else ()
        case _:
            return None
    if not (size and xyz and rpy) or (kind != "mesh" and min(size) <= 0.0):
        return None
    roll, pitch, yaw = rpy
    turn = product(of_turn((0, 0, 1), yaw), product(of_turn((0, 1, 0), pitch), of_turn((1, 0, 0), roll)))
    return Shape(kind, size, file=file, colour=colour).placed(np.array(xyz), turn)


def _colour(material: Element, named_colours: Mapping[str, Colour]) -> Colour | None:
    stated = material.child("color")
    numbers = () if stated is None else _numbers(stated, "rgba", 4)
    if not numbers or not all(0.0 <= number <= 1.0 for number in numbers):
        return named_colours.get(material.attributes.get("name", ""))
    red, green, blue, opacity = numbers
    return red, green, blue, opacity


def _numbers(element: Element, key: str, count: int, default: str = "") -> tuple[float, ...]:
    """So many numbers of an attribute; empty where there are others."""
    try:
        numbers = tuple(map(float, element.attributes.get(key, default).split()))
    except ValueError:
        return ()
    return numbers if len(numbers) == count and all(abs(number) < _LARGEST for number in numbers) else ()
