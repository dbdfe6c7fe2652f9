"""URDF export: bodies and joints of a robot as a file that gives the same dynamics when it is read."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import WORLD, Frame, Link, Robot
from dynsim.model.urdf.reader import HAND, MOVING, ROWS, UNLIMITED
from dynsim.record.urdf_text import add_shapes, connect, numbers, xml_text


def write_urdf(robot: Robot) -> str:
    """Write the bodies, joints and shapes of a robot as URDF text.

    Frames, including the hand's frame, become links without mass. Joint losses contain only bearing losses, not motor
    losses. A capsule becomes the cylinder about it, which :func:`dynsim.compile.solids.solids_of` reads as the capsule.

    Numbers are written with all digits, so that reading the text gives the same dynamics up to rounding errors.

    Raises
    ------
    ModelError
        If URDF has no such kind of joint, or cannot represent the losses of a joint.
    """
    links = _whole_joints(robot)
    root = ElementTree.Element("robot", name=robot.name)
    frames = [frame for frame in robot.frames if frame.name != HAND]
    taken = {link.name for link in robot.links} | {frame.name for frame in frames}
    base = robot.root or next(name for name in (WORLD, "base_link", "root_link") if name not in taken)
    stand = ElementTree.SubElement(root, "link", name=base)
    add_shapes(stand, robot.fixed_shapes)
    add_shapes(stand, robot.fixed_solids, "collision")
    for link in links:
        body = ElementTree.SubElement(root, "link", name=link.name)
        inertial = ElementTree.SubElement(body, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=numbers(link.inertia.com), rpy="0 0 0")
        ElementTree.SubElement(inertial, "mass", value=numbers(link.inertia.mass))
        moments = {f"i{'xyz'[i]}{'xyz'[j]}": numbers(link.inertia.tensor[i, j]) for i in range(3) for j in range(i, 3)}
        ElementTree.SubElement(inertial, "inertia", moments)
        add_shapes(body, link.shapes)
        add_shapes(body, link.solids, "collision")
    leads = {coupling.joint: coupling for coupling in robot.couplings}
    for link in links:
        limits = (link.lower, link.upper, link.effort_limit, link.velocity_limit)
        endless = link.kind == "revolute" and math.isinf(link.lower) and math.isinf(link.upper)
        joint = ElementTree.SubElement(root, "joint", name=link.joint, type="continuous" if endless else link.kind)
        connect(joint, link.parent or base, link.name, link.p_PJ, link.R_PJ)
        if link.kind != "floating":
            ElementTree.SubElement(joint, "axis", xyz=numbers(link.axis))
        if link.kind in MOVING.values() and not (endless and all(map(math.isinf, limits))):
            # A continuous joint has no lower and upper limits.
            texts = [numbers(min(max(limit, -UNLIMITED), UNLIMITED)) for limit in limits]
            attributes = dict(zip(("lower", "upper", "effort", "velocity"), texts, strict=True))
            ElementTree.SubElement(joint, "limit", dict(list(attributes.items())[2:]) if endless else attributes)
        if link.damping or link.friction:
            ElementTree.SubElement(joint, "dynamics", damping=numbers(link.damping), friction=numbers(link.friction))
        if coupling := leads.get(link.joint):
            law = {"multiplier": numbers(coupling.ratio), "offset": numbers(coupling.offset)}
            ElementTree.SubElement(joint, "mimic", {"joint": coupling.leader, **law})
    if HAND not in taken:
        carrier, point = robot.hand
        frames.append(Frame(HAND, carrier, robot.hand_axes, point))
    joints = {link.joint for link in links}
    for frame in frames:
        if frame.name == base:
            continue
        name = f"{frame.name}_frame"
        while name in joints:
            name += "_"
        ElementTree.SubElement(root, "link", name=frame.name)
        joint = ElementTree.SubElement(root, "joint", name=name, type="fixed")
        connect(joint, frame.body or base, frame.name, frame.p, frame.R)
    return xml_text(root)


def _whole_joints(robot: Robot) -> list[Link]:
    """Return the links of the file; rows that form a floating or planar joint become one link of that kind."""
    rows: dict[str, list[Link]] = {}
    for link in robot.links:
        rows.setdefault(link.joint_of_rows or link.joint, []).append(link)
    return [_whole_joint(name, group) for name, group in rows.items()]


def _whole_joint(name: str, rows: list[Link]) -> Link:
    first, last = rows[0], rows[-1]
    if first.joint_of_rows is None and first.kind in MOVING.values():
        return first
    whole = replace(last, joint=name, parent=first.parent, R_PJ=first.R_PJ, p_PJ=first.p_PJ, joint_of_rows=None)
    for kind, make in ROWS.items():
        made = make(whole)
        same = [(row.joint, row.kind) for row in made] == [(row.joint, row.kind) for row in rows]
        if same and all(np.allclose(a.axis, b.axis, rtol=0.0, atol=1e-15) for a, b in zip(made, rows, strict=True)):
            if any(row.damping or row.friction for row in rows):
                raise ModelError(f"{name}: has losses; URDF has no units for losses of a {kind} joint")
            return replace(whole, kind=kind)
    raise ModelError(f"{name}: is made of {', '.join(row.kind for row in rows)}; URDF has no such joint")
