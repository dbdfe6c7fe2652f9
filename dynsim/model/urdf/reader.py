"""Strict reading of URDF text to links and joints: all numbers are checked, errors name element and line.

Elements that the URDF specification makes optional have its defaults (a link without ``<inertial>`` has no mass, a
joint without ``<axis>`` turns about x). Others that are missing, misspelt, repeated or not numbers are refused. Visuals
are read leniently (:mod:`dynsim.model.urdf.visual`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import Array, Inertia
from dynsim.model.urdf.visual import materials, visual_shapes
from dynsim.model.urdf.xml import MOMENTS, Element, UrdfFile, cut, quoted, suggestion
from dynsim.record.scene import Shape

# The largest robots in use have some 100 links.
LINKS_MAX = 2000
MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
# Joints with several rates.
SEVERAL = ("floating", "planar")
# A limit of at least this magnitude means "no limit" [rad, m, N m …]: URDF demands some number for most limits.
UNLIMITED = 1e9


@dataclass(frozen=True)
class UrdfLink:
    """A link as the file has it; ``inertia`` is None without ``<inertial>``, ``shaped`` means visual or collision.

    ``shapes`` are its visuals, as far as they can be drawn.
    """

    name: str
    line: int
    inertia: Inertia | None
    shaped: bool
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class UrdfJoint:
    """A joint as the file states it: placement of the child in the parent's frame, unit axis in the child's frame.

    ``kind`` is URDF's type, ``mimics`` the name of the joint that leads this one, at ``multiplier`` times its position
    and ``offset`` [rad or m]. Limits [rad or m, rad/s or m/s, N m
    or N] are infinite where the file has none, ``damping`` and ``friction`` zero.
    """

    name: str
    line: int
    kind: str
    parent: str
    child: str
    R: Array
    p: Array
    axis: Array
    lower: float
    upper: float
    velocity_limit: float
    effort_limit: float
    damping: float
    friction: float
    mimics: str | None
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints by name in the order of the file, and the root link."""

    path: Path
    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    root: str

    def error(self, line: int, text: str) -> ModelError:
        """An error about a line of the file."""
        return ModelError(f"{self.path}:{line}: {text}")


def read_tree(path: Path) -> UrdfTree:
    """Read the links and joints of a URDF file.

    Raises
    ------
    ModelError
        The file cannot be read, is not URDF, or states something that is not clear: the message names file, line, link
        or joint, attribute, value and what to do.
    """
    return _Reader(path).tree()


class _Reader:
    """Reads the links and joints of one file."""

    def __init__(self, path: Path) -> None:
        self.file = UrdfFile(path)

    def tree(self) -> UrdfTree:
        root = self.file.root()
        if root.tag != "robot":
            raise self.file.error(root.line, f"the outermost element is <{cut(root.tag)}>, a URDF file has <robot>")
        self.file.check_children(root, "the robot")
        links: dict[str, UrdfLink] = {}
        joints: dict[str, UrdfJoint] = {}
        colours = materials(root)
        for element in root.children:
            if element.tag == "link":
                link = replace(self.link(element, links), shapes=visual_shapes(element, colours))
                links[link.name] = link
                if len(links) > LINKS_MAX:
                    raise self.file.error(link.line, f"more than {LINKS_MAX} links; simplify the model")
        for element in root.children:
            if element.tag == "joint":
                joint = self.joint(element, joints, links)
                joints[joint.name] = joint
        top = self.root(links, joints)
        name = root.attributes.get("name", "") or self.file.path.stem
        return UrdfTree(self.file.path, name, links, joints, top)

    def link(self, element: Element, others: dict[str, UrdfLink]) -> UrdfLink:
        name = self.file.name(element, others)
        who = f"link {quoted(name)}"
        self.file.check_children(element, who)
        for shape in element.children:
            for lost in shape.children if shape.tag not in ("inertial", "gazebo") else ():
                if lost.tag in ("inertial", "mass", "inertia"):
                    raise self.file.error(
                        lost.line, f"{who}: <{lost.tag}> in <{cut(shape.tag)}>; it belongs in <inertial>"
                    )
        shaped = any(child.tag in ("visual", "collision") for child in element.children)
        inertial = element.child("inertial")
        return UrdfLink(name, element.line, None if inertial is None else self.inertia(inertial, who), shaped)

    def inertia(self, element: Element, who: str) -> Inertia:
        self.file.check_children(element, who)
        mass_element = self.file.required(
            element, "mass", who, "give both, or remove <inertial> for a link without mass"
        )
        tensor_element = self.file.required(
            element, "inertia", who, "give all six moments (zero for a point mass), or remove <inertial>"
        )
        R, com = self.origin(element, who)
        mass = self.file.number(mass_element, "value", who)
        if mass < 0.0:
            raise self.file.error(mass_element.line, f"{who}: mass {mass:g} kg is negative; a mass is zero or positive")
        xx, xy, xz, yy, yz, zz = (self.file.number(tensor_element, key, who) for key in MOMENTS)
        tensor = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        return Inertia(mass, com, 0.5 * (tensor + tensor.T))

    def joint(self, element: Element, others: dict[str, UrdfJoint], links: dict[str, UrdfLink]) -> UrdfJoint:
        name = self.file.name(element, others)
        who = f"joint {quoted(name)}"
        self.file.check_children(element, who)
        kind = element.attributes.get("type")
        known = (*MOVING, "fixed", *SEVERAL)
        if kind not in known:
            stated = "has no type" if kind is None else f"is {quoted(kind)}{suggestion(kind, known)}"
            raise self.file.error(element.line, f"{who} {stated}; known: {', '.join(known)}")
        ends = []
        for tag in ("parent", "child"):
            end = self.file.required(element, tag, who, f'add it, like <{tag} link="arm"/>')
            link = self.file.text(end, "link", who)
            if link not in links:
                raise self.file.error(
                    end.line, f"{who}: its {tag} link {quoted(link)} is not in the file{suggestion(link, links)}"
                )
            ends.append(link)
        for tag in ("limit", "dynamics") if kind in SEVERAL else ():
            if (single := element.child(tag)) is not None:
                raise self.file.error(
                    single.line, f"{who} is {kind}: <{tag}> has one number for several rates; remove <{tag}>"
                )
        R, p = self.origin(element, who)
        lower, upper, velocity_limit, effort_limit = self.limits(element, kind, who)
        dynamics, mimic = element.child("dynamics"), element.child("mimic")
        damping, friction = (
            0.0 if dynamics is None else self.file.number(dynamics, key, who, 0.0) for key in ("damping", "friction")
        )
        if damping < 0.0 or friction < 0.0:
            line = element.line if dynamics is None else dynamics.line
            raise self.file.error(
                line, f"{who}: damping {damping:g} and friction {friction:g}; a loss is zero or positive"
            )
        mimics, multiplier, offset = None, 1.0, 0.0
        if mimic is not None:
            mimics = self.file.text(mimic, "joint", who)
            multiplier = self.file.number(mimic, "multiplier", who, 1.0)
            offset = self.file.number(mimic, "offset", who, 0.0)
        return UrdfJoint(
            name=name,
            line=element.line,
            kind=kind,
            parent=ends[0],
            child=ends[1],
            R=R,
            p=p,
            axis=self.axis(element, kind, who),
            lower=lower,
            upper=upper,
            velocity_limit=velocity_limit,
            effort_limit=effort_limit,
            damping=damping,
            friction=friction,
            mimics=mimics,
            multiplier=multiplier,
            offset=offset,
        )

    def limits(self, element: Element, kind: str, who: str) -> tuple[float, float, float, float]:
        """Lower and upper position, velocity and effort; zero of the latter stands in files whose author knew none."""
        limit = element.child("limit")
        if limit is None:
            if kind in ("revolute", "prismatic"):
                raise self.file.error(
                    element.line, f"{who} is {kind} and has no <limit>; add it, or make the joint continuous"
                )
            return -math.inf, math.inf, math.inf, math.inf
        lower, upper = self.file.number(limit, "lower", who, 0.0), self.file.number(limit, "upper", who, 0.0)
        bounds = [self.file.number(limit, key, who, None if kind in MOVING else 0.0) for key in ("velocity", "effort")]
        velocity, effort = (size if 0.0 < size < UNLIMITED else math.inf for size in bounds)
        if min(bounds) < 0.0:
            raise self.file.error(limit.line, f"{who}: a velocity or effort limit is negative; 0 stands for none")
        if kind == "continuous":
            return -math.inf, math.inf, velocity, effort
        if lower > upper:
            raise self.file.error(limit.line, f"{who}: lower limit {lower:g} is above upper limit {upper:g}; swap them")
        return (
            -math.inf if lower <= -UNLIMITED else lower,
            math.inf if upper >= UNLIMITED else upper,
            velocity,
            effort,
        )

    def origin(self, element: Element, who: str) -> tuple[Array, Array]:
        """Rotation and position that ``<origin>`` states; none is the identity."""
        origin = element.child("origin")
        if origin is None:
            return np.eye(3), np.zeros(3)
        p, rpy = (self.file.numbers(origin, key, 3, who, (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
        return rotation(*rpy), p

    def axis(self, element: Element, kind: str, who: str) -> Array:
        """Unit axis in the joint's frame; that of a joint without one is not looked at."""
        stated = element.child("axis")
        default = (1.0, 0.0, 0.0)
        axis = np.array(default) if stated is None else self.file.numbers(stated, "xyz", 3, who)
        if kind == "planar" and stated is None:
            raise self.file.error(
                element.line,
                f"{who} is planar and has no <axis>, the normal of its plane: URDF then means x, and many programs z; "
                'add it, like <axis xyz="0 0 1"/>',
            )
        if kind not in (*MOVING, "planar"):
            return np.array(default)
        length = float(np.linalg.norm(axis))
        if stated is not None and not 1e-12 < length < math.inf:
            raise self.file.error(stated.line, f"{who}: axis {quoted(stated.attributes['xyz'])} is no direction")
        # A unit axis stays as it is: dividing by 1 − 1e-16 would take it off the exact coordinate directions.
        return axis if abs(length - 1.0) < 1e-15 else axis / length

    def root(self, links: dict[str, UrdfLink], joints: dict[str, UrdfJoint]) -> str:
        """The one link that hangs on no joint; every other one must be reached from it."""
        above: dict[str, UrdfJoint] = {}
        for joint in joints.values():
            other = above.setdefault(joint.child, joint)
            if other is not joint:
                raise self.file.error(
                    joint.line,
                    f"joint {quoted(joint.name)}: its child {quoted(joint.child)} already hangs on joint "
                    f"{quoted(other.name)} (line {other.line}): a kinematic loop, which URDF cannot state; "
                    "remove one of the two",
                )
        roots = [name for name in links if name not in above]
        if not links:
            raise ModelError(f"{self.file.path}: has no <link>; a URDF file has links and joints")
        reached = set(roots)
        below: dict[str, list[UrdfJoint]] = {name: [] for name in links}
        for joint in joints.values():
            below[joint.parent].append(joint)
        pending = list(roots)
        while pending:
            for joint in below[pending.pop()]:
                reached.add(joint.child)
                pending.append(joint.child)
        lost = next((joint for joint in joints.values() if joint.child not in reached), None)
        if lost is not None:
            raise self.file.error(
                lost.line,
                f"joint {quoted(lost.name)} is part of a kinematic loop that no root link leads to; "
                "the joints of a URDF file form a tree",
            )
        if len(roots) != 1:
            names = ", ".join(quoted(name) for name in roots[:5]) + (", …" if len(roots) > 5 else "")
            line = links[roots[1]].line if roots else 1
            raise self.file.error(line, f"a tree has one root link; here: {names or 'none'}; connect them with joints")
        return roots[0]


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3); angles [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
