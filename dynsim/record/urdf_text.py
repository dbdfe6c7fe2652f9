"""URDF text of a scene (links, joints, shapes), and XML helpers shared by all URDF writers."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from dynsim.record.quaternion import Array, rotated
from dynsim.record.scene import FixedFrame, Scene, Shape

Element = ElementTree.Element
WORLD_LINK = "world"
# Values written for a joint without limits, because URDF requires numbers [rad or m, N m or N, rad/s or m/s].
_UNLIMITED = 1e9


def scene_urdf(scene: Scene, name: str) -> str:
    """Return the URDF text of the bodies of a scene: joints, limits and shapes, without masses.

    Links are named after the bodies and fixed frames; the root is ``world``. Ball joints and joints with several rates
    become floating joints, whose bodies viewers position by their frames. ROS viewers display this text
    (``robot_description``). To include masses, use ``dynsim export SCENARIO --format urdf``.
    """
    root = Element("robot", name=name)
    names = [body.name for body in scene.bodies] + [WORLD_LINK]  # WORLD is -1
    add_shapes(ElementTree.SubElement(root, "link", name=WORLD_LINK), scene.fixed)
    for last in scene.rows:
        add_shapes(ElementTree.SubElement(root, "link", name=names[last]), scene.bodies[last].shapes)
    for last, rows in scene.rows.items():
        first = scene.bodies[rows[0]]
        joint = first.joint
        limited = joint.lower is not None and joint.upper is not None
        kind: str = "floating" if joint.kind == "ball" or len(rows) > 1 else joint.kind
        if kind == "revolute" and not limited:
            kind = "continuous"
        own = joint.part_of if len(rows) > 1 else joint.name
        element = ElementTree.SubElement(root, "joint", name=own, type=kind)
        connect(element, names[first.parent], names[last], joint.position, rotation(joint.orientation))
        if kind in ("revolute", "continuous", "prismatic", "planar"):
            ElementTree.SubElement(element, "axis", xyz=numbers(joint.axis))
        if kind in ("revolute", "prismatic"):
            lower, upper = (joint.lower, joint.upper) if limited else (-_UNLIMITED, _UNLIMITED)
            far = numbers(_UNLIMITED)
            ElementTree.SubElement(
                element, "limit", lower=numbers(lower), upper=numbers(upper), effort=far, velocity=far
            )
    for frame in fixed_frames(scene):
        ElementTree.SubElement(root, "link", name=frame.name)
        element = ElementTree.SubElement(root, "joint", name=f"{frame.name}_frame", type="fixed")
        connect(element, names[frame.body], frame.name, frame.position, rotation(frame.orientation))
    return xml_text(root)


def fixed_frames(scene: Scene) -> list[FixedFrame]:
    """Return the fixed frames of a scene, without a frame that has the name of the world or of a body."""
    taken = {WORLD_LINK, *(body.name for body in scene.bodies)}
    return [frame for frame in scene.frames if frame.name not in taken]


def add_shapes(link: Element, shapes: Sequence[Shape], tag: Literal["visual", "collision"] = "visual") -> None:
    """Add the elements of shapes to a link; a visual capsule becomes a cylinder and two spheres, a colliding one the
    cylinder about it."""
    for shape in _simple(shapes) if tag == "visual" else shapes:
        visual = ElementTree.SubElement(link, tag)
        R = rotation(shape.orientation)
        ElementTree.SubElement(visual, "origin", xyz=numbers(shape.position), rpy=numbers(roll_pitch_yaw(R)))
        geometry = ElementTree.SubElement(visual, "geometry")
        match shape.kind:
            case "box":
                ElementTree.SubElement(geometry, "box", size=numbers(shape.size))
            case "sphere":
                ElementTree.SubElement(geometry, "sphere", radius=numbers(shape.size[0]))
            case "cylinder" | "capsule":
                radius, length = shape.size
                length += 2.0 * radius if shape.kind == "capsule" else 0.0
                ElementTree.SubElement(geometry, "cylinder", radius=numbers(radius), length=numbers(length))
            case "mesh":
                ElementTree.SubElement(geometry, "mesh", filename=shape.file, scale=numbers(shape.size))
        if shape.colour is not None and tag == "visual":
            material = ElementTree.SubElement(visual, "material", name=f"rgba {numbers(shape.colour)}")
            ElementTree.SubElement(material, "color", rgba=numbers(shape.colour))


def _simple(shapes: Sequence[Shape]) -> list[Shape]:
    """Return the shapes with each capsule split into a cylinder and two spheres."""
    simple: list[Shape] = []
    for shape in shapes:
        if shape.kind != "capsule":
            simple.append(shape)
            continue
        radius, length = shape.size
        ends = [
            Shape("sphere", (radius,), (0.0, 0.0, end), colour=shape.colour).placed(shape.position, shape.orientation)
            for end in (-0.5 * length, 0.5 * length)
        ]
        simple += [Shape("cylinder", shape.size, shape.position, shape.orientation, colour=shape.colour), *ends]
    return simple


def connect(joint: Element, parent: str, child: str, position: Any, rotation: Array) -> None:
    """Add the elements parent, child and origin to a joint."""
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=numbers(position), rpy=numbers(roll_pitch_yaw(rotation)))


def rotation(orientation: Any) -> Array:
    """Return the rotation matrix of a unit quaternion, (3, 3)."""
    return rotated(np.array(orientation, dtype=np.float64), np.eye(3))


def roll_pitch_yaw(R: Array) -> Array:
    """Return the angles of R = Rz(yaw) Ry(pitch) Rx(roll) [rad]; they are also accurate at pitch = ±90°.

    At pitch = ±90° roll and yaw are not unique: yaw is determined by rounding, and roll is computed from Rz(yaw)ᵀ R.
    """
    yaw = math.atan2(R[1, 0], R[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def numbers(values: Any) -> str:
    """Format numbers in the shortest form that gives the same double when it is read."""
    return " ".join(repr(float(x)) for x in np.atleast_1d(values))


def xml_text(root: Element) -> str:
    """Return the indented XML document of an element."""
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
