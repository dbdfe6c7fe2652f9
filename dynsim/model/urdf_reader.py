"""Strict reading of URDF text: every element with its line, every number checked, nothing guessed or dropped.

What the URDF specification lets a file leave out has the specification's value (a link without ``<inertial>`` has no
mass, a joint without ``<axis>`` turns about x); what else is missing, misspelt, there twice or no number is refused.
Entities and DTDs are refused unread, and size, depth and number of elements are limited, so that reading always ends.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from dynsim.errors import ModelError
from dynsim.inputs import read_bytes
from dynsim.model.description import Array, Inertia

# The largest robots in use have some 100 links and 1 MB of text. Pinocchio walks the tree by recursion: some 5000 links
# in a chain overflow its stack.
BYTES_MAX, ELEMENTS_MAX, DEPTH_MAX, LINKS_MAX = 16_000_000, 100_000, 100, 2000
ATTRIBUTES_MAX, NAME_LENGTH_MAX, _NUMBER_LENGTH_MAX = 100, 200, 400
MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
# Numbers whose magnitude stands for "no limit" [rad, m, N m …]: URDF demands some number for most limits.
UNLIMITED = 1e9
# No robot has such numbers, and with larger ones products overflow.
_MAGNITUDE_MAX = 1e15

# Elements of physics, whose values are attributes.
_WITHOUT_TEXT = {"mass", "inertia", "origin", "axis", "limit", "dynamics", "mimic"}

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Child elements that physics depends on, by parent, and their attributes. Other elements and, on limits and losses,
# other attributes are extensions of single programs; they are ignored unless they look like one of these misspelt.
_CHILDREN = {
    "robot": ("link", "joint"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
}
_ATTRIBUTES = {
    "origin": ("xyz", "rpy"),
    "mass": ("value",),
    "inertia": _MOMENTS,
    "parent": ("link",),
    "child": ("link",),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
}
_EXTENDED = ("limit", "dynamics")


@dataclass(frozen=True)
class UrdfLink:
    """A link as the file has it; ``inertia`` is None without ``<inertial>``, ``shaped`` means visual or collision."""

    name: str
    line: int
    inertia: Inertia | None
    shaped: bool


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
    """Links and joints by name in the order of the file, the root link, and ``text``, the same as plain URDF."""

    path: Path
    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    root: str
    text: str

    def error(self, line: int, text: str) -> ModelError:
        """An error about a line of the file."""
        return ModelError(f"{self.path}:{line}: {text}")


@dataclass
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    children: list[_Element] = field(default_factory=list)


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
    """Reads one file; all errors name it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, line: int, text: str) -> ModelError:
        return ModelError(f"{self.path}:{line}: {text}")

    def tree(self) -> UrdfTree:
        root = self.parse(self.read())
        if root.tag != "robot":
            raise self.error(root.line, f"the outermost element is <{_cut(root.tag)}>, a URDF file has <robot>")
        self.check_children(root, "the robot")
        links: dict[str, UrdfLink] = {}
        joints: dict[str, UrdfJoint] = {}
        for element in root.children:
            if element.tag == "link":
                link = self.link(element, links)
                links[link.name] = link
                if len(links) > LINKS_MAX:
                    raise self.error(link.line, f"more than {LINKS_MAX} links; simplify the model")
        for element in root.children:
            if element.tag == "joint":
                joint = self.joint(element, joints, links)
                joints[joint.name] = joint
        top = self.root(links, joints)
        name = root.attributes.get("name", "") or self.path.stem
        return UrdfTree(self.path, name, links, joints, top, _plain_text(root, name))

    def read(self) -> bytes:
        data = read_bytes(self.path, ModelError, BYTES_MAX)
        if not data.strip():
            raise ModelError(f"{self.path}: is empty; a URDF file has <robot> with links and joints")
        return data

    def parse(self, data: bytes) -> _Element:
        """The elements of XML text in any encoding that expat knows; with their lines."""
        parser = expat.ParserCreate()
        open_elements: list[_Element] = []
        roots: list[_Element] = []
        count = 0

        def begin(tag: str, attributes: dict[str, str]) -> None:
            nonlocal count
            count += 1
            line = parser.CurrentLineNumber
            if tag.startswith("xacro:"):
                raise self.error(line, f"<{_cut(tag)}>: {self.expand}")
            if count > ELEMENTS_MAX:
                raise self.error(line, f"more than {ELEMENTS_MAX} elements; simplify the model")
            if len(open_elements) >= DEPTH_MAX:
                raise self.error(line, f"elements are nested more than {DEPTH_MAX} deep; URDF needs fewer than ten")
            if len(attributes) > ATTRIBUTES_MAX:
                raise self.error(line, f"<{_cut(tag)}> has more than {ATTRIBUTES_MAX} attributes; simplify the model")
            around = [element.tag for element in open_elements]
            place = {"link": ["robot"], "inertial": ["robot", "link"]}.get(tag, around)
            in_robot = around[:1] == ["robot"] and "gazebo" not in around
            if in_robot and around != place and not (tag == "inertial" and around[:2] == place):
                raise self.error(
                    line,
                    f"<{tag}> in <{_cut(around[-1])}> would be ignored; it belongs in <{place[-1]}>, move it there",
                )
            element = _Element(tag, attributes, line)
            (open_elements[-1].children if open_elements else roots).append(element)
            open_elements.append(element)

        def end(_: str) -> None:
            open_elements.pop()

        def text(content: str) -> None:
            element = open_elements[-1]
            # Without attributes it is refused for what it lacks.
            if content.strip() and element.tag in _WITHOUT_TEXT and element.attributes:
                tag = element.tag
                raise self.error(
                    parser.CurrentLineNumber,
                    f"<{tag}> holds the text {_shown(content.strip())}; URDF has values in attributes only",
                )

        def document_type(*_: object) -> None:
            raise self.error(
                parser.CurrentLineNumber, "has a DOCTYPE; entities and DTDs are not read: remove it, write them out"
            )

        parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, text
        parser.StartDoctypeDeclHandler = document_type
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise self.error(error.lineno, f"not XML: {expat.ErrorString(error.code)}") from None
        except (LookupError, ValueError) as error:
            raise ModelError(f"{self.path}: its encoding is not known ({error}); save it as UTF-8") from None
        return roots[0]

    @property
    def expand(self) -> str:
        return (
            f"this is a xacro file; run `xacro {self.path} > {self.path.name.split('.')[0]}_expanded.urdf` (of ROS) "
            "and give that file"
        )

    def link(self, element: _Element, others: dict[str, UrdfLink]) -> UrdfLink:
        name = self.name(element, others)
        who = f"link {_shown(name)}"
        self.check_children(element, who)
        for shape in element.children:
            for lost in shape.children if shape.tag not in ("inertial", "gazebo") else ():
                if lost.tag in ("inertial", "mass", "inertia"):
                    raise self.error(lost.line, f"{who}: <{lost.tag}> in <{_cut(shape.tag)}>; it belongs in <inertial>")
        shaped = any(child.tag in ("visual", "collision") for child in element.children)
        inertial = self.child(element, "inertial")
        return UrdfLink(name, element.line, None if inertial is None else self.inertia(inertial, who), shaped)

    def inertia(self, element: _Element, who: str) -> Inertia:
        self.check_children(element, who)
        mass_element = self.required(element, "mass", who, "give both, or remove <inertial> for a link without mass")
        tensor_element = self.required(
            element, "inertia", who, "give all six moments (zero for a point mass), or remove <inertial>"
        )
        R, com = self.origin(element, who)
        mass = self.number(mass_element, "value", who)
        if mass < 0.0:
            raise self.error(mass_element.line, f"{who}: mass {mass:g} kg is negative; a mass is zero or positive")
        xx, xy, xz, yy, yz, zz = (self.number(tensor_element, key, who) for key in _MOMENTS)
        tensor = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        return Inertia(mass, com, 0.5 * (tensor + tensor.T))

    def joint(self, element: _Element, others: dict[str, UrdfJoint], links: dict[str, UrdfLink]) -> UrdfJoint:
        name = self.name(element, others)
        who = f"joint {_shown(name)}"
        self.check_children(element, who)
        kind = element.attributes.get("type")
        known = (*MOVING, "fixed", "floating", "planar")
        if kind not in known:
            stated = "has no type" if kind is None else f"is {_shown(kind)}{suggestion(kind, known)}"
            raise self.error(element.line, f"{who} {stated}; known: {', '.join(MOVING)}, fixed")
        ends = []
        for tag in ("parent", "child"):
            end = self.required(element, tag, who, f'add it, like <{tag} link="arm"/>')
            link = self.text(end, "link", who)
            if link not in links:
                raise self.error(
                    end.line, f"{who}: its {tag} link {_shown(link)} is not in the file{suggestion(link, links)}"
                )
            ends.append(link)
        R, p = self.origin(element, who)
        lower, upper, velocity_limit, effort_limit = self.limits(element, kind, who)
        dynamics, mimic = self.child(element, "dynamics"), self.child(element, "mimic")
        damping, friction = (
            0.0 if dynamics is None else self.number(dynamics, key, who, 0.0) for key in ("damping", "friction")
        )
        if damping < 0.0 or friction < 0.0:
            line = element.line if dynamics is None else dynamics.line
            raise self.error(line, f"{who}: damping {damping:g} and friction {friction:g}; a loss is zero or positive")
        mimics, multiplier, offset = None, 1.0, 0.0
        if mimic is not None:
            mimics = self.text(mimic, "joint", who)
            multiplier, offset = self.number(mimic, "multiplier", who, 1.0), self.number(mimic, "offset", who, 0.0)
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

    def limits(self, element: _Element, kind: str, who: str) -> tuple[float, float, float, float]:
        """Lower and upper position, velocity and effort; zero of the latter stands in files whose author knew none."""
        limit = self.child(element, "limit")
        if limit is None:
            if kind in ("revolute", "prismatic"):
                raise self.error(
                    element.line, f"{who} is {kind} and has no <limit>; add it, or make the joint continuous"
                )
            return -math.inf, math.inf, math.inf, math.inf
        lower, upper = self.number(limit, "lower", who, 0.0), self.number(limit, "upper", who, 0.0)
        bounds = [self.number(limit, key, who, None if kind in MOVING else 0.0) for key in ("velocity", "effort")]
        velocity, effort = (size if 0.0 < size < UNLIMITED else math.inf for size in bounds)
        if min(bounds) < 0.0:
            raise self.error(limit.line, f"{who}: a velocity or effort limit is negative; 0 stands for none")
        if kind == "continuous":
            return -math.inf, math.inf, velocity, effort
        if lower > upper:
            raise self.error(limit.line, f"{who}: lower limit {lower:g} is above upper limit {upper:g}; swap them")
        return (
            -math.inf if lower <= -UNLIMITED else lower,
            math.inf if upper >= UNLIMITED else upper,
            velocity,
            effort,
        )

    def origin(self, element: _Element, who: str) -> tuple[Array, Array]:
        """Rotation and position that ``<origin>`` states; none is the identity."""
        origin = self.child(element, "origin")
        if origin is None:
            return np.eye(3), np.zeros(3)
        p, rpy = (self.numbers(origin, key, 3, who, (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
        return rotation(*rpy), p

    def axis(self, element: _Element, kind: str, who: str) -> Array:
        """Unit axis in the joint's frame; that of a joint without one is not looked at."""
        stated = self.child(element, "axis")
        default = (1.0, 0.0, 0.0)
        axis = np.array(default) if stated is None else self.numbers(stated, "xyz", 3, who)
        if kind not in MOVING:
            return np.array(default)
        length = float(np.linalg.norm(axis))
        if stated is not None and not 1e-12 < length < math.inf:
            raise self.error(stated.line, f"{who}: axis {_shown(stated.attributes['xyz'])} is no direction")
        # A unit axis stays as it is: dividing by 1 − 1e-16 would take it off the exact coordinate directions.
        return axis if abs(length - 1.0) < 1e-15 else axis / length

    def root(self, links: dict[str, UrdfLink], joints: dict[str, UrdfJoint]) -> str:
        """The one link that hangs on no joint; every other one must be reached from it."""
        above: dict[str, UrdfJoint] = {}
        for joint in joints.values():
            other = above.setdefault(joint.child, joint)
            if other is not joint:
                raise self.error(
                    joint.line,
                    f"joint {_shown(joint.name)}: its child {_shown(joint.child)} already hangs on joint "
                    f"{_shown(other.name)} (line {other.line}): a kinematic loop, which URDF cannot state; "
                    "remove one of the two",
                )
        roots = [name for name in links if name not in above]
        if not links:
            raise ModelError(f"{self.path}: has no <link>; a URDF file has links and joints")
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
            raise self.error(
                lost.line,
                f"joint {_shown(lost.name)} is part of a kinematic loop that no root link leads to; "
                "the joints of a URDF file form a tree",
            )
        if len(roots) != 1:
            names = ", ".join(_shown(name) for name in roots[:5]) + (", …" if len(roots) > 5 else "")
            line = links[roots[1]].line if roots else 1
            raise self.error(line, f"a tree has one root link; here: {names or 'none'}; connect them with joints")
        return roots[0]

    def name(self, element: _Element, others: dict[str, UrdfLink] | dict[str, UrdfJoint]) -> str:
        name = element.attributes.get("name", "")
        if not name:
            raise self.error(element.line, f"<{element.tag}> has no name; give it one")
        self.check_expanded(element, "name", f"<{element.tag}>")
        if not name.isprintable():
            raise self.error(
                element.line, f"{element.tag} {_shown(name)}: the name has control characters; remove them"
            )
        if len(name) > NAME_LENGTH_MAX:
            raise self.error(element.line, f"{element.tag} {_shown(name)}: a name has at most {NAME_LENGTH_MAX} signs")
        if name in others:
            raise self.error(
                element.line,
                f"{element.tag} {_shown(name)} is there twice (also in line {others[name].line}); rename one of them",
            )
        return name

    def check_children(self, element: _Element, who: str) -> None:
        """Refuse what is there twice, belongs elsewhere or looks misspelt: other readers pass over it in silence."""
        known, seen = _CHILDREN[element.tag], set()
        for child in element.children:
            if child.tag in known:
                if child.tag in seen and element.tag != "robot":
                    raise self.error(child.line, f"{who} has more than one <{child.tag}>; remove one")
                seen.add(child.tag)
                self.check_attributes(child, who)
                continue
            meant = _near(child.tag, known)
            if meant:
                raise self.error(child.line, f"{who}: unknown element <{_cut(child.tag)}>; did you mean <{meant}>?")
            if child.tag in ("link", "joint", "inertial", "mass", "inertia"):
                raise self.error(child.line, f"{who}: <{child.tag}> does not belong in <{element.tag}>")

    def check_attributes(self, element: _Element, who: str) -> None:
        known = _ATTRIBUTES.get(element.tag, ())
        for key in element.attributes if known else ():
            meant = _near(key, known)
            if key not in known and (meant or element.tag not in _EXTENDED):
                hint = f"did you mean {meant}?" if meant else f"known: {', '.join(known)}"
                raise self.error(element.line, f"{who}: unknown attribute {_cut(key)} of <{element.tag}>; {hint}")

    def child(self, element: _Element, tag: str) -> _Element | None:
        return next((child for child in element.children if child.tag == tag), None)

    def required(self, element: _Element, tag: str, who: str, fix: str) -> _Element:
        found = self.child(element, tag)
        if found is None:
            where = f"{who}: <{element.tag}>" if element.tag == "inertial" else who
            raise self.error(element.line, f"{where} has no <{tag}>; {fix}")
        return found

    def text(self, element: _Element, key: str, who: str) -> str:
        if not element.attributes.get(key):
            raise self.error(element.line, f"{who}: <{element.tag}> has no {key}; add it")
        self.check_expanded(element, key, who)
        return element.attributes[key]

    def number(self, element: _Element, key: str, who: str, default: float | None = None) -> float:
        return float(self.numbers(element, key, 1, who, None if default is None else (default,))[0])

    def numbers(
        self, element: _Element, key: str, count: int, who: str, default: tuple[float, ...] | None = None
    ) -> Array:
        """The numbers of an attribute: plain ASCII decimals, as many as there must be, finite."""
        text = element.attributes.get(key)
        if text is None:
            if default is not None:
                return np.array(default)
            raise self.error(element.line, f"{who}: <{element.tag}> has no {key}; add it, like {key}={_EXAMPLE[count]}")
        self.check_expanded(element, key, who)
        words = _words(text)
        stated = f"{who}: <{element.tag} {key}={_shown(text)}>"
        if len(words) != count:
            raise self.error(
                element.line, f"{stated} has {len(words)} entries, {count} are needed, like {_EXAMPLE[count]}"
            )
        values = []
        for word in words:
            if len(word) > _NUMBER_LENGTH_MAX or not _NUMBER.fullmatch(word):
                raise self.error(
                    element.line,
                    f"{stated} is not a finite number; write it in the digits 0–9 with a point, like {_EXAMPLE[count]}",
                )
            value = float(word)
            vanished = value == 0.0 and re.search("[1-9]", re.split("[eE]", word)[0])
            # Limits may be as large as numbers go: that stands for none.
            largest = math.inf if element.tag == "limit" else _MAGNITUDE_MAX
            if vanished or not math.isfinite(value) or abs(value) > largest:
                raise self.error(element.line, f"{stated} is out of the range of numbers; check its exponent")
            values.append(value)
        return np.array(values)

    def check_expanded(self, element: _Element, key: str, who: str) -> None:
        if "${" in element.attributes[key] or "$(" in element.attributes[key]:
            raise self.error(
                element.line, f"{who}: <{element.tag} {key}={_shown(element.attributes[key])}>: {self.expand}"
            )


_EXAMPLE = {1: '"0.25"', 3: '"0 0 0.25"'}


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


def suggestion(word: str, known: object) -> str:
    """``; did you mean 'x'?``, or nothing when no known word is near."""
    near = difflib.get_close_matches(word[:100], [str(k) for k in known], n=1, cutoff=0.6)  # type: ignore[attr-defined]
    return f"; did you mean {near[0]!r}?" if near else ""


def _near(word: str, known: tuple[str, ...]) -> str:
    """The known word that ``word`` looks like misspelt, empty if none. Programs have extensions of similar names."""
    if word in known:
        return ""
    near = difflib.get_close_matches(word[:40].casefold(), known, n=1, cutoff=0.8)
    return near[0] if near else ""


def _plain_text(root: _Element, name: str) -> str:
    """What physics depends on, with the numbers as the file has them, in UTF-8 without anything else.

    For Pinocchio, whose parser knows no other encoding and drops the whole inertia over a space beside a number.
    """

    def written(element: _Element, tags: tuple[str, ...]) -> str:
        attributes = ""
        for key, value in element.attributes.items():
            if key in ("name", "type", "link", "joint"):
                attributes += f" {key}={quoteattr(value)}"
            elif key in _ATTRIBUTES.get(element.tag, ()):
                attributes += f" {key}={quoteattr(' '.join(_words(value)))}"
        # Pinocchio refuses dynamics without a loss, which the specification allows.
        if element.tag == "dynamics" and not attributes:
            return ""
        inside = "".join(
            written(child, _CHILDREN.get(child.tag, ())) for child in element.children if child.tag in tags
        )
        return f"<{element.tag}{attributes}>{inside}</{element.tag}>"

    inside = "".join(written(child, _CHILDREN[child.tag]) for child in root.children if child.tag in ("link", "joint"))
    return f"<robot name={quoteattr(name)}>{inside}</robot>"


def _words(text: str) -> list[str]:
    """What stands between white space, of XML's kinds only."""
    return [word for word in re.split(r"[ \t\r\n]+", text) if word]


def _shown(text: str) -> str:
    """A text of the file, quoted and cut to what fits in a message."""
    return repr(_cut(text))


def _cut(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
