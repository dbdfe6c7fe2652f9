"""URDF in and out: the tree of bodies, their joints, limits and viscous losses.

Reading goes through Pinocchio, which merges everything behind fixed joints into the moving body that carries it.
Motors, gears, contacts and gravity are not part of a URDF file; they belong to the scenario.
"""

from __future__ import annotations

import math
import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import WORLD, Array, Inertia, Link, Robot

_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
# URDF demands numbers for the limits of position, effort and velocity: this one stands for "no limit" (rad, m, N m …).
_UNLIMITED = 1e9
_NUMERIC = frozenset(
    {"xyz", "rpy", "value", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "lower", "upper"}
    | {"effort", "velocity", "damping", "friction"}
)
HAND = "hand"


def read_urdf(path: Path) -> Robot:
    """Read the bodies and joints of a URDF file.

    Joints keep their names and the order of the file (a parent still comes first); each body is named after the link
    at its moving joint. The hand is the link named ``hand``, else the tip of the chain with the most moving joints: the
    last frame fixed to its last body, or that body's origin when nothing is fixed to it. The root link is the world.

    Raises
    ------
    ModelError
        No such file, not URDF, or a joint that is mimic, floating or planar: the message names file and joint.

    Warns
    -----
    UserWarning
        The file states Coulomb friction of joints, which is not simulated.
    """
    root = _parse(path)
    joints = root.findall("joint")
    for joint in joints:
        _check_joint(path, joint)
    moving = [joint for joint in joints if joint.get("type") in _KINDS]
    if not moving:
        raise ModelError(f"{path}: no moving joint")
    # Imported here: Pinocchio takes a second to load, and only URDF files need it.
    import pinocchio

    try:
        model = pinocchio.buildModelFromUrdf(str(path))
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"{path}: not a valid URDF model: {' '.join(str(error).split())}") from error

    child_of = {joint: _link_name(joint, "child") for joint in joints}
    body_of = {0: None} | {model.getJointId(joint.get("name")): child_of[joint] for joint in moving}
    links: list[Link] = []
    while moving:
        for joint in moving:
            j = model.getJointId(joint.get("name"))
            parent = body_of[model.parents[j]]
            if parent is None or any(link.name == parent for link in links):
                break
        moving.remove(joint)
        lower, upper = _position_limits(joint)
        inertia, placement = model.inertias[j], model.jointPlacements[j]
        tensor = np.array(inertia.inertia)
        links.append(
            Link(
                name=child_of[joint],
                joint=str(joint.get("name")),
                parent=parent,
                kind=_KINDS[joint.get("type", "")],
                axis=_axis(path, joint),
                inertia=Inertia(float(inertia.mass), np.array(inertia.lever), 0.5 * (tensor + tensor.T)),
                R_PJ=np.array(placement.rotation),
                p_PJ=np.array(placement.translation),
                damping=_number(joint, "dynamics", "damping"),
                lower=lower,
                upper=upper,
                velocity_limit=_size_limit(joint, "velocity"),
                effort_limit=_size_limit(joint, "effort"),
            )
        )
    rubbing = [str(joint.get("name")) for joint in joints if _number(joint, "dynamics", "friction") != 0.0]
    if rubbing:
        warnings.warn(f"{path}: Coulomb friction of joints is not simulated ({', '.join(rubbing)})", stacklevel=2)
    return Robot(
        name=root.get("name", path.stem), links=tuple(links), motors=(), hand=_hand(root, model, body_of, child_of)
    )


def write_urdf(robot: Robot) -> str:
    """The bodies and joints of a robot as URDF text, with the hand as a frame of its own.

    Numbers are written in full, so that reading the text back gives the same dynamics to rounding.
    """
    root = ElementTree.Element("robot", name=robot.name)
    taken = {link.name for link in robot.links}
    base = next(name for name in (WORLD, "base_link", "root_link") if name not in taken)
    ElementTree.SubElement(root, "link", name=base)
    for link in robot.links:
        inertial = ElementTree.SubElement(ElementTree.SubElement(root, "link", name=link.name), "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=_text(link.inertia.com), rpy="0 0 0")
        ElementTree.SubElement(inertial, "mass", value=_text(link.inertia.mass))
        moments = {f"i{'xyz'[i]}{'xyz'[j]}": _text(link.inertia.tensor[i, j]) for i in range(3) for j in range(i, 3)}
        ElementTree.SubElement(inertial, "inertia", moments)
    for link in robot.links:
        limits = (link.lower, link.upper, link.effort_limit, link.velocity_limit)
        endless = link.kind == "revolute" and math.isinf(link.lower) and math.isinf(link.upper)
        joint = ElementTree.SubElement(root, "joint", name=link.joint, type="continuous" if endless else link.kind)
        _connect(joint, link.parent or base, link.name, link.p_PJ, link.R_PJ)
        ElementTree.SubElement(joint, "axis", xyz=_text(link.axis))
        if not (endless and all(map(math.isinf, limits))):
            # A continuous joint has no lower and upper.
            texts = [_text(min(max(limit, -_UNLIMITED), _UNLIMITED)) for limit in limits]
            given = dict(zip(("lower", "upper", "effort", "velocity"), texts, strict=True))
            ElementTree.SubElement(joint, "limit", dict(list(given.items())[2:]) if endless else given)
        if link.damping:
            ElementTree.SubElement(joint, "dynamics", damping=_text(link.damping), friction="0.0")
    if HAND not in taken:
        body, point = robot.hand
        ElementTree.SubElement(root, "link", name=HAND)
        joint = ElementTree.SubElement(root, "joint", name=f"{HAND}_frame", type="fixed")
        _connect(joint, body, HAND, point, np.eye(3))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _parse(path: Path) -> ElementTree.Element:
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ElementTree.ParseError as error:
        raise ModelError(f"{path}: not XML: {error}") from error
    if root.tag != "robot":
        raise ModelError(f"{path}: the outermost element is <{root.tag}>, a URDF file has <robot>")
    _check_tree(path, root)
    for owner in (*root.findall("link"), *root.findall("joint")):
        _check_numbers(path, owner)
    return root


def _check_tree(path: Path, root: ElementTree.Element) -> None:
    roots = [link.get("name") for link in root.findall("link")]
    links = set(roots)
    for joint in root.findall("joint"):
        for end in ("parent", "child"):
            if _link_name(joint, end) not in links:
                raise ModelError(
                    f"{path}: joint {joint.get('name')!r}: its {end} link {_link_name(joint, end)!r} is not in the file"
                )
        child = _link_name(joint, "child")
        if child not in roots:
            raise ModelError(f"{path}: joint {joint.get('name')!r}: its child {child!r} already hangs on another joint")
        roots.remove(child)
    if len(roots) != 1:
        raise ModelError(f"{path}: a tree has one root link; here: {', '.join(map(str, roots)) or 'none'}")
    reached, pending = set(roots), root.findall("joint")
    while True:
        grown = [joint for joint in pending if _link_name(joint, "parent") in reached]
        if not grown:
            break
        reached |= {_link_name(joint, "child") for joint in grown}
        pending = [joint for joint in pending if joint not in grown]
    if pending:
        raise ModelError(f"{path}: joint {pending[0].get('name')!r} is part of a loop that the root does not reach")


def _check_numbers(path: Path, owner: ElementTree.Element) -> None:
    """Pinocchio's parser takes a mass it cannot read for zero; so look at every number that physics depends on."""
    elements = list(owner) if owner.tag == "joint" else owner.findall("inertial/*")
    for element in elements:
        for key, text in element.items():
            if key not in _NUMERIC:
                continue
            try:
                fine = all(math.isfinite(float(word)) for word in text.split())
            except ValueError:
                fine = False
            if not fine:
                raise ModelError(
                    f"{path}: {owner.tag} {owner.get('name')!r}: <{element.tag} {key}={text!r}> is not a finite number"
                )
        if element.tag == "mass" and float(element.get("value", "0")) < 0.0:
            raise ModelError(f"{path}: link {owner.get('name')!r}: mass {element.get('value')} kg is negative")


def _check_joint(path: Path, joint: ElementTree.Element) -> None:
    name, kind = joint.get("name"), joint.get("type")
    if joint.find("mimic") is not None:
        raise ModelError(f"{path}: joint {name!r} mimics another joint; coupled joints are not simulated")
    if kind not in {*_KINDS, "fixed"}:
        raise ModelError(f"{path}: joint {name!r} is {kind}; known: {', '.join(_KINDS)}, fixed")
    if kind in ("revolute", "prismatic") and joint.find("limit") is None:
        raise ModelError(f"{path}: joint {name!r} is {kind} and has no <limit>")


def _link_name(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _number(joint: ElementTree.Element, tag: str, attribute: str) -> float:
    element = joint.find(tag)
    return 0.0 if element is None else float(element.get(attribute, "0"))


def _position_limits(joint: ElementTree.Element) -> tuple[float, float]:
    if joint.get("type") == "continuous":
        return -math.inf, math.inf
    lower, upper = _number(joint, "limit", "lower"), _number(joint, "limit", "upper")
    return (-math.inf if lower <= -_UNLIMITED else lower), (math.inf if upper >= _UNLIMITED else upper)


def _size_limit(joint: ElementTree.Element, attribute: str) -> float:
    """Limit of velocity or effort. Zero stands in files whose author knew none: a joint so limited could not move."""
    limit = _number(joint, "limit", attribute)
    return limit if 0.0 < limit < _UNLIMITED else math.inf


def _axis(path: Path, joint: ElementTree.Element) -> Array:
    """Unit joint axis in the joint frame; URDF's default is x."""
    element = joint.find("axis")
    axis = np.array([float(x) for x in (element.get("xyz", "1 0 0") if element is not None else "1 0 0").split()])
    length = float(np.linalg.norm(axis))
    if axis.shape != (3,) or not length > 0.0:
        raise ModelError(f"{path}: joint {joint.get('name')!r}: axis {axis} is no direction")
    # A unit axis stays as it is: dividing by 1 − 1e-16 would take it off the exact coordinate directions.
    return axis if abs(length - 1.0) < 1e-15 else axis / length


def _hand(
    root: ElementTree.Element, model: Any, body_of: dict[int, Any], child_of: dict[Any, str]
) -> tuple[str, Array]:
    """The controlled point: the frame ``hand``, else the tip of the deepest chain."""
    joint_to = {child: joint for joint, child in child_of.items()}

    def depth(name: str) -> tuple[int, int]:
        """Number of moving joints and of all joints between the root and a link."""
        moving = total = 0
        while name in joint_to:
            joint = joint_to[name]
            moving, total = moving + (joint.get("type") in _KINDS), total + 1
            name = _link_name(joint, "parent")
        return moving, total

    names = [str(link.get("name")) for link in root.findall("link")]
    tip = max(names, key=depth)
    if HAND in names and depth(HAND)[0] > 0:
        tip = HAND
    frame = model.frames[model.getBodyId(tip)]
    return str(body_of[frame.parentJoint]), np.array(frame.placement.translation)


def _connect(joint: ElementTree.Element, parent: str, child: str, position: Array, rotation: Array) -> None:
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_text(position), rpy=_text(_roll_pitch_yaw(rotation)))


def _roll_pitch_yaw(R: Array) -> Array:
    """Angles of R = Rz(yaw) Ry(pitch) Rx(roll) [rad], accurate at pitch = ±90° too.

    There roll and yaw are not unique: whatever yaw rounding gives, roll is taken from what is left after undoing it.
    """
    yaw = math.atan2(R[1, 0], R[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def _text(values: Any) -> str:
    """Numbers in their shortest form that reads back to the same double."""
    return " ".join(repr(float(x)) for x in np.atleast_1d(values))
