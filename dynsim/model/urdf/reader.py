"""URDF import: strict reading of links and joints, lenient reading of visual shapes, and conversion to a robot.

All numbers are checked, and errors name element and line. Elements that the URDF specification makes optional get its
defaults (a link without ``<inertial>`` has no mass, a joint without ``<axis>`` turns about x). Other elements that are
missing, misspelt, repeated or not numeric are refused.
"""

from __future__ import annotations

import difflib
import heapq
import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol
from xml.parsers import expat

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import Array, Coupling, Frame, Inertia, Link, Robot
from dynsim.model.joints.ball import floating
from dynsim.model.joints.planar import planar
from dynsim.record.quaternion import of_turn, product
from dynsim.record.scene import Shape, ShapeKind, quaternion
from dynsim.system.inputs import read_bytes

# XML of a URDF file: elements with line numbers, and attributes as numbers; unknown attributes are reported.


# The largest robots in use have some 100 links and 1 MB of text.
BYTES_MAX, ELEMENTS_MAX, DEPTH_MAX = 16_000_000, 100_000, 100
ATTRIBUTES_MAX, NAME_LENGTH_MAX, _NUMBER_LENGTH_MAX = 100, 200, 400
# Largest magnitude of a number: no robot needs larger ones, and their products could overflow.
_MAGNITUDE_MAX = 1e15

# Elements of physics; their values are attributes, so text in them is an error.
_WITHOUT_TEXT = {"mass", "inertia", "origin", "axis", "limit", "dynamics", "mimic"}

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Child elements that physics depends on, by parent, and their attributes. Other elements, and other attributes of
# limits and losses, are extensions of some programs; they are ignored unless they look like a misspelling of these.
_CHILDREN = {
    "robot": ("link", "joint"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
}
_ATTRIBUTES = {
    "origin": ("xyz", "rpy"),
    "mass": ("value",),
    "inertia": MOMENTS,
    "parent": ("link",),
    "child": ("link",),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
}
_EXTENDED = ("limit", "dynamics")
_EXAMPLE = {1: '"0.25"', 3: '"0 0 0.25"'}


@dataclass
class Element:
    """XML tag with its attributes, start line and children."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)

    def child(self, tag: str) -> Element | None:
        """Return the first child with this tag, or None."""
        return next((child for child in self.children if child.tag == tag), None)


class Placed(Protocol):
    """Part of the file with a line number."""

    @property
    def line(self) -> int: ...


class UrdfFile:
    """One URDF file, read by elements; all errors name it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, line: int, text: str) -> ModelError:
        """Return an error about a line of the file."""
        return ModelError(f"{self.path}:{line}: {text}")

    def root(self) -> Element:
        """Return the root element with all of its content.

        Raises
        ------
        ModelError
            If the file cannot be read, is not XML, or exceeds a limit.
        """
        return self._parse(self._read())

    def _read(self) -> bytes:
        data = read_bytes(self.path, ModelError, BYTES_MAX)
        if not data.strip():
            raise ModelError(f"{self.path}: is empty; a URDF file has <robot> with links and joints")
        return data

    def _parse(self, data: bytes) -> Element:
        """Parse XML text in any encoding that expat knows into elements with line numbers."""
        parser = expat.ParserCreate()
        open_elements: list[Element] = []
        roots: list[Element] = []
        count = 0

        def begin(tag: str, attributes: dict[str, str]) -> None:
            nonlocal count
            count += 1
            line = parser.CurrentLineNumber
            if tag.startswith("xacro:"):
                raise self.error(line, f"<{cut(tag)}>: {self._expand}")
            if count > ELEMENTS_MAX:
                raise self.error(line, f"more than {ELEMENTS_MAX} elements; simplify the model")
            if len(open_elements) >= DEPTH_MAX:
                raise self.error(line, f"elements are nested more than {DEPTH_MAX} deep; URDF needs fewer than ten")
            if len(attributes) > ATTRIBUTES_MAX:
                raise self.error(line, f"<{cut(tag)}> has more than {ATTRIBUTES_MAX} attributes; simplify the model")
            around = [element.tag for element in open_elements]
            parents = {"link": ["robot"], "inertial": ["robot", "link"]}.get(tag, around)
            in_robot = around[:1] == ["robot"] and "gazebo" not in around
            if in_robot and around != parents and not (tag == "inertial" and around[:2] == parents):
                raise self.error(
                    line,
                    f"<{tag}> in <{cut(around[-1])}> would be ignored; it belongs in <{parents[-1]}>, move it there",
                )
            element = Element(tag, attributes, line)
            (open_elements[-1].children if open_elements else roots).append(element)
            open_elements.append(element)

        def end(_: str) -> None:
            open_elements.pop()

        def text(content: str) -> None:
            element = open_elements[-1]
            # An element without attributes is refused for missing attributes.
            if content.strip() and element.tag in _WITHOUT_TEXT and element.attributes:
                tag = element.tag
                raise self.error(
                    parser.CurrentLineNumber,
                    f"<{tag}> contains the text {quoted(content.strip())}; URDF has values in attributes only",
                )

        def document_type(*_: object) -> None:
            raise self.error(
                parser.CurrentLineNumber, "has a DOCTYPE; entities and DTDs are not supported: expand and remove them"
            )

        parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, text
        parser.StartDoctypeDeclHandler = document_type
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise self.error(error.lineno, f"not XML: {expat.ErrorString(error.code)}") from None
        except (LookupError, ValueError) as error:
            raise ModelError(f"{self.path}: unknown encoding ({error}); save it as UTF-8") from None
        return roots[0]

    @property
    def _expand(self) -> str:
        return (
            f"this is a xacro file; run `xacro {self.path} > {self.path.name.split('.')[0]}_expanded.urdf` (of ROS) "
            "and use that file"
        )

    def name(self, element: Element, others: Mapping[str, Placed]) -> str:
        """Return the name of a link or joint, checked to be printable and unique."""
        name = element.attributes.get("name", "")
        if not name:
            raise self.error(element.line, f"<{element.tag}> has no name; add the attribute name")
        self._check_expanded(element, "name", f"<{element.tag}>")
        if not name.isprintable():
            raise self.error(
                element.line, f"{element.tag} {quoted(name)}: the name has control characters; remove them"
            )
        if len(name) > NAME_LENGTH_MAX:
            raise self.error(
                element.line, f"{element.tag} {quoted(name)}: a name has at most {NAME_LENGTH_MAX} characters"
            )
        if name in others:
            raise self.error(
                element.line,
                f"{element.tag} {quoted(name)} is defined twice (also in line {others[name].line}); rename one of them",
            )
        return name

    def check_children(self, element: Element, who: str) -> None:
        """Refuse repeated, misplaced or misspelt elements, which other readers ignore silently."""
        known, seen = _CHILDREN[element.tag], set()
        for child in element.children:
            if child.tag in known:
                if child.tag in seen and element.tag != "robot":
                    raise self.error(child.line, f"{who} has more than one <{child.tag}>; remove one")
                seen.add(child.tag)
                self._check_attributes(child, who)
                continue
            meant = _near(child.tag, known)
            if meant:
                raise self.error(child.line, f"{who}: unknown element <{cut(child.tag)}>; did you mean <{meant}>?")
            if child.tag in ("link", "joint", "inertial", "mass", "inertia"):
                raise self.error(child.line, f"{who}: <{child.tag}> does not belong in <{element.tag}>")

    def _check_attributes(self, element: Element, who: str) -> None:
        known = _ATTRIBUTES.get(element.tag, ())
        for key in element.attributes if known else ():
            meant = _near(key, known)
            if key not in known and (meant or element.tag not in _EXTENDED):
                hint = f"did you mean {meant}?" if meant else f"known: {', '.join(known)}"
                raise self.error(element.line, f"{who}: unknown attribute {cut(key)} of <{element.tag}>; {hint}")

    def required(self, element: Element, tag: str, who: str, fix: str) -> Element:
        """Return the child with this tag; without it, raise an error with the advice ``fix``."""
        child = element.child(tag)
        if child is None:
            where = f"{who}: <{element.tag}>" if element.tag == "inertial" else who
            raise self.error(element.line, f"{where} has no <{tag}>; {fix}")
        return child

    def text(self, element: Element, key: str, who: str) -> str:
        """Return a required, non-empty attribute."""
        if not element.attributes.get(key):
            raise self.error(element.line, f"{who}: <{element.tag}> has no {key}; add it")
        self._check_expanded(element, key, who)
        return element.attributes[key]

    def number(self, element: Element, key: str, who: str, default: float | None = None) -> float:
        """Return the single number of an attribute."""
        return float(self.numbers(element, key, 1, who, None if default is None else (default,))[0])

    def numbers(
        self, element: Element, key: str, count: int, who: str, default: tuple[float, ...] | None = None
    ) -> Array:
        """Return the ``count`` numbers of an attribute: plain ASCII decimals, finite."""
        text = element.attributes.get(key)
        if text is None:
            if default is not None:
                return np.array(default)
            raise self.error(element.line, f"{who}: <{element.tag}> has no {key}; add it, e.g. {key}={_EXAMPLE[count]}")
        self._check_expanded(element, key, who)
        words = _words(text)
        stated = f"{who}: <{element.tag} {key}={quoted(text)}>"
        if len(words) != count:
            raise self.error(
                element.line, f"{stated} has {len(words)} entries, {count} are needed, e.g. {_EXAMPLE[count]}"
            )
        values = []
        for word in words:
            if len(word) > _NUMBER_LENGTH_MAX or not _NUMBER.fullmatch(word):
                raise self.error(
                    element.line,
                    f"{stated} is not a finite number; write decimal digits 0–9 with a point, e.g. {_EXAMPLE[count]}",
                )
            value = float(word)
            vanished = value == 0.0 and re.search("[1-9]", re.split("[eE]", word)[0])
            # Limits may be as large as numbers go, meaning no limit.
            largest = math.inf if element.tag == "limit" else _MAGNITUDE_MAX
            if vanished or not math.isfinite(value) or abs(value) > largest:
                raise self.error(element.line, f"{stated} is out of the range of numbers; check its exponent")
            values.append(value)
        return np.array(values)

    def _check_expanded(self, element: Element, key: str, who: str) -> None:
        if "${" in element.attributes[key] or "$(" in element.attributes[key]:
            raise self.error(
                element.line, f"{who}: <{element.tag} {key}={quoted(element.attributes[key])}>: {self._expand}"
            )


def suggestion(word: str, known: object) -> str:
    """Return ``; did you mean 'x'?``, or an empty text if no known word is similar."""
    near = difflib.get_close_matches(word[:100], [str(k) for k in known], n=1, cutoff=0.6)  # type: ignore[attr-defined]
    return f"; did you mean {near[0]!r}?" if near else ""


def _near(word: str, known: tuple[str, ...]) -> str:
    """Return the known word of which ``word`` looks like a misspelling, or "". Programs have similar extensions."""
    if word in known:
        return ""
    near = difflib.get_close_matches(word[:40].casefold(), known, n=1, cutoff=0.8)
    return near[0] if near else ""


def _words(text: str) -> list[str]:
    """Return the words between XML white space."""
    return [word for word in re.split(r"[ \t\r\n]+", text) if word]


def quoted(text: str) -> str:
    """Return a text of the file, quoted and shortened for a message."""
    return repr(cut(text))


def cut(text: str) -> str:
    """Return a text of the file, shortened for a message."""
    return text if len(text) <= 60 else text[:57] + "..."


# Visual shapes and named colours of URDF links (``<visual>``), read leniently.


Colour = tuple[float, float, float, float]
# No length, scale or angle is larger.
_LARGEST = 1e15


def materials(robot: Element) -> dict[str, Colour]:
    """Return the named colours that the file defines outside of its links."""
    colours = {
        child.attributes.get("name", ""): _colour(child, {}) for child in robot.children if child.tag == "material"
    }
    return {name: colour for name, colour in colours.items() if colour is not None}


def visual_shapes(link: Element, named_colours: Mapping[str, Colour]) -> tuple[Shape, ...]:
    """Return the shapes of a link in its frame; ``named_colours`` maps names to colours."""
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
    """Return ``count`` numbers of an attribute; empty if they are not valid."""
    try:
        numbers = tuple(map(float, element.attributes.get(key, default).split()))
    except ValueError:
        return ()
    return numbers if len(numbers) == count and all(abs(number) < _LARGEST for number in numbers) else ()


# The largest robots in use have some 100 links.
LINKS_MAX = 2000
MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
# Joints with several rates.
SEVERAL = ("floating", "planar")
# A limit of at least this magnitude means "no limit" [rad, m, N m …]: URDF requires a number for most limits.
UNLIMITED = 1e9


@dataclass(frozen=True)
class UrdfLink:
    """Link as stated in the file; ``inertia`` is None without ``<inertial>``; ``shaped``: has visual or collision.

    ``shapes`` are the visuals that can be drawn.
    """

    name: str
    line: int
    inertia: Inertia | None
    shaped: bool
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class UrdfJoint:
    """Joint as stated in the file: placement of the child in the parent's frame, unit axis in the child's frame.

    ``kind`` is URDF's type, ``mimics`` the name of the joint that leads this one, at ``multiplier`` times its position
    and ``offset`` [rad or m]. Limits [rad or m, rad/s or m/s, N m or N] are infinite if the file has none; ``damping``
    and ``friction`` are then zero.
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
    """Links and joints by their names, in the order of the file, and the root link."""

    path: Path
    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    root: str

    def error(self, line: int, text: str) -> ModelError:
        """Return an error about a line of the file."""
        return ModelError(f"{self.path}:{line}: {text}")


def read_tree(path: Path) -> UrdfTree:
    """Read the links and joints of a URDF file.

    Raises
    ------
    ModelError
        If the file cannot be read, is not URDF, or is ambiguous; the message contains file, line, link or joint,
        attribute, value and a fix.
    """
    return _Reader(path).tree()


class _Reader:
    """Reader of the links and joints of one file."""

    def __init__(self, path: Path) -> None:
        self.file = UrdfFile(path)

    def tree(self) -> UrdfTree:
        root = self.file.root()
        if root.tag != "robot":
            raise self.file.error(root.line, f"the root element is <{cut(root.tag)}>, must be <robot>")
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
                        lost.line,
                        f"{who}: <{lost.tag}> is inside <{cut(shape.tag)}>; move it "
                        f"{'directly below <link>' if lost.tag == 'inertial' else 'into <inertial>'}",
                    )
        shaped = any(child.tag in ("visual", "collision") for child in element.children)
        inertial = element.child("inertial")
        return UrdfLink(name, element.line, None if inertial is None else self.inertia(inertial, who), shaped)

    def inertia(self, element: Element, who: str) -> Inertia:
        self.file.check_children(element, who)
        mass_element = self.file.required(
            element, "mass", who, "add both, or remove <inertial> for a link without mass"
        )
        tensor_element = self.file.required(
            element, "inertia", who, "add all six moments (zero for a point mass), or remove <inertial>"
        )
        R, com = self.origin(element, who)
        mass = self.file.number(mass_element, "value", who)
        if mass < 0.0:
            raise self.file.error(mass_element.line, f"{who}: mass {mass:g} kg must not be negative")
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
            end = self.file.required(element, tag, who, f'add it, e.g. <{tag} link="arm"/>')
            link = self.file.text(end, "link", who)
            if link not in links:
                raise self.file.error(
                    end.line, f"{who}: its {tag} link {quoted(link)} is not in the file{suggestion(link, links)}"
                )
            ends.append(link)
        for tag in ("limit", "dynamics") if kind in SEVERAL else ():
            if (single := element.child(tag)) is not None:
                raise self.file.error(
                    single.line, f"{who} is {kind}: <{tag}> has one number but the joint several rates; remove <{tag}>"
                )
        R, p = self.origin(element, who)
        lower, upper, velocity_limit, effort_limit = self.limits(element, kind, who)
        dynamics, mimic = element.child("dynamics"), element.child("mimic")
        damping, friction = (
            0.0 if dynamics is None else self.file.number(dynamics, key, who, 0.0) for key in ("damping", "friction")
        )
        if damping < 0.0 or friction < 0.0:
            line = element.line if dynamics is None else dynamics.line
            raise self.file.error(line, f"{who}: damping {damping:g} and friction {friction:g} must not be negative")
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
        """Return limits of position (lower, upper), velocity and effort; zero velocity or effort means unknown."""
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
            raise self.file.error(limit.line, f"{who}: velocity and effort limits must not be negative; 0: unlimited")
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
        """Return rotation and position of ``<origin>``; identity without it."""
        origin = element.child("origin")
        if origin is None:
            return np.eye(3), np.zeros(3)
        p, rpy = (self.file.numbers(origin, key, 3, who, (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
        return rotation(*rpy), p

    def axis(self, element: Element, kind: str, who: str) -> Array:
        """Return the unit axis in the joint's frame; the axis of a joint that does not use it is not checked."""
        stated = element.child("axis")
        default = (1.0, 0.0, 0.0)
        axis = np.array(default) if stated is None else self.file.numbers(stated, "xyz", 3, who)
        if kind == "planar" and stated is None:
            raise self.file.error(
                element.line,
                f"{who} is planar and has no <axis>, the normal of its plane: URDF then means x, but many programs z; "
                'add it, e.g. <axis xyz="0 0 1"/>',
            )
        if kind not in (*MOVING, "planar"):
            return np.array(default)
        length = float(np.linalg.norm(axis))
        if stated is not None and not 1e-12 < length < math.inf:
            raise self.file.error(stated.line, f"{who}: axis {quoted(stated.attributes['xyz'])} has no direction")
        # A unit axis stays as it is: dividing by 1 − 1e-16 would take it off the exact coordinate directions.
        return axis if abs(length - 1.0) < 1e-15 else axis / length

    def root(self, links: dict[str, UrdfLink], joints: dict[str, UrdfJoint]) -> str:
        """Return the only link that is not a child; all others must be reached from it."""
        above: dict[str, UrdfJoint] = {}
        for joint in joints.values():
            other = above.setdefault(joint.child, joint)
            if other is not joint:
                raise self.file.error(
                    joint.line,
                    f"joint {quoted(joint.name)}: its child {quoted(joint.child)} is already the child of joint "
                    f"{quoted(other.name)} (line {other.line}): a kinematic loop, which URDF does not support; "
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
                f"joint {quoted(lost.name)} is part of a kinematic loop without a root link; "
                "the joints of a URDF file must form a tree",
            )
        if len(roots) != 1:
            names = ", ".join(quoted(name) for name in roots[:5]) + (", …" if len(roots) > 5 else "")
            line = links[roots[1]].line if roots else 1
            raise self.file.error(line, f"a tree has one root link; found: {names or 'none'}; connect them with joints")
        return roots[0]


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3); angles [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


# Conversion to a robot: bodies, joints, limits, viscous losses, couplings, frames and shapes.


HAND = "hand"
# Functions that make the rows of joints with several rows.
ROWS = {"floating": floating, "planar": planar}


@dataclass(frozen=True)
class _Place:
    """Moving body that carries a link (None: the world), the link's frame there, and its distance from the root."""

    body: str | None
    R: Array
    p: Array
    moving: int
    joints: int


def read_urdf(path: Path, lock: Mapping[str, float] | None = None) -> Robot:
    """Read the bodies and joints of a URDF file.

    Joints keep their names and the order of the file (but a parent always comes first); each body is named after the
    link at its moving joint, and every other link is a frame of the body that carries it. Floating and planar joints
    become their rows (:mod:`dynsim.model.joints`). The hand is the link named ``hand``, otherwise the tip of the chain
    with the most moving joints: the last link fixed to its last body, or that body's origin if nothing is fixed to it.
    The root link is the world. A mimic joint is a coupling to its leader; a locked leader locks it too.

    Parameters
    ----------
    path : Path
        URDF file.
    lock : mapping, optional
        Positions [rad or m] of joints to fix, with the joint names as keys.

    Raises
    ------
    ModelError
        If the file does not exist or is not URDF, a number or an inertia is invalid, the leader of a mimic joint does
        not exist, or ``lock`` names an unknown joint or one without a single position. The message contains file, line,
        link or joint, value and a fix.

    Warns
    -----
    UserWarning
        If a link with a shape has no mass, the moments of inertia of a link are impossible for a body, or a joint is
        locked beyond its limits.
    """
    tree = read_tree(path)
    locked = _locked(tree, {**_locked_followers(tree, lock or {}), **(lock or {})})
    places = _places(locked)
    links = _links(locked, places)
    if not links:
        raise ModelError(f"{path}: no moving joint")
    _warn(locked, places, links)
    frames = [Frame(name, pose.body, pose.R, pose.p) for name, pose in places.items() if pose.body != name]
    rows = tuple(row for link in links for row in (ROWS[link.kind](link) if link.kind in ROWS else (link,)))
    for joint in locked.joints.values():
        for name in (joint.name, joint.mimics or joint.name):
            if joint.mimics is not None and locked.joints[name].kind in SEVERAL:
                raise tree.error(
                    joint.line, f"joint {joint.name!r} mimics {joint.mimics!r}, but {name!r} has several positions"
                )
    couplings = tuple(
        Coupling(joint.name, joint.mimics, joint.multiplier, joint.offset)
        for joint in locked.joints.values()
        if joint.mimics is not None and joint.kind in MOVING
    )
    hand = _hand(tree, places)
    return Robot(
        name=tree.name,
        links=rows,
        motors=(),
        hand=(str(hand.body), hand.p),
        hand_frame=hand.R,
        frames=tuple(frames),
        couplings=couplings,
        fixed_shapes=_shapes(locked, places).get(None, ()),
        fixed_inertia=_fixed(locked, places),
    )


def _fixed(tree: UrdfTree, places: Mapping[str, _Place]) -> Inertia:
    """Return the mass properties of all links fixed to the root, in its frame."""
    parts = [
        inertia.placed(pose.R, pose.p)
        for name, pose in places.items()
        if pose.body is None and (inertia := tree.links[name].inertia) is not None
    ]
    return Inertia.merged(parts) if parts else Inertia(0.0)


def _locked_followers(tree: UrdfTree, lock: Mapping[str, float]) -> dict[str, float]:
    """Return positions of mimic joints whose leader is locked or fixed, directly or through others [rad or m]."""
    positions: dict[str, float] = {}
    for follower in tree.joints.values():
        chain, joint = [], follower
        while joint.mimics is not None and joint.name not in lock and joint.kind != "fixed":
            if joint.mimics not in tree.joints:
                raise tree.error(
                    joint.line,
                    f"joint {joint.name!r} mimics joint {joint.mimics!r}, which is not in the file"
                    f"{suggestion(joint.mimics, tree.joints)}",
                )
            if joint in chain:
                raise tree.error(joint.line, f"joint {joint.name!r} mimics itself through {joint.mimics!r}")
            chain.append(joint)
            joint = tree.joints[joint.mimics]
        if chain and (joint.name in lock or joint.kind == "fixed"):
            q = lock.get(joint.name, 0.0)
            for link in reversed(chain):
                q = link.multiplier * q + link.offset
            positions[follower.name] = q
    return positions


def _locked(tree: UrdfTree, lock: Mapping[str, float]) -> UrdfTree:
    """Return the tree with joints fixed at positions: T_PC = T_PJ · Rot(a, q), or T_PJ · Trans(a q) if prismatic."""
    joints = dict(tree.joints)
    for name, value in lock.items():
        if name not in joints:
            raise ModelError(
                f"{tree.path}: lock: no joint {name!r}{suggestion(name, joints)}; joints: {', '.join(joints)}"
            )
        joint = joints[name]
        if joint.kind not in MOVING:
            fix = "; make it fixed in the file" if joint.kind in SEVERAL else ""
            raise tree.error(
                joint.line, f"lock: joint {name!r} is {joint.kind} and has no single position to lock{fix}"
            )
        if not math.isfinite(value):
            raise ModelError(f"{tree.path}: lock: {name} = {value} is not a finite number")
        if not joint.lower - 1e-9 <= value <= joint.upper + 1e-9:
            warnings.warn(
                f"{tree.path}: joint {name!r} is locked at {value:g}, outside its limits "
                f"[{joint.lower:g}, {joint.upper:g}]",
                stacklevel=3,
            )
        if joint.kind == "prismatic":
            joints[name] = replace(joint, kind="fixed", p=joint.p + joint.R @ joint.axis * value)
        else:
            joints[name] = replace(joint, kind="fixed", R=joint.R @ _turn(joint.axis, value))
    return replace(tree, joints=joints)


def _turn(axis: Array, angle: float) -> Array:
    """Return the rotation about a unit axis, R = 1 + sin q [a]× + (1 − cos q) [a]×² (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _places(tree: UrdfTree) -> dict[str, _Place]:
    """Return the place of every link; parents first, otherwise in the order of the file."""
    below: dict[str, list[tuple[int, UrdfJoint]]] = {name: [] for name in tree.links}
    for order, joint in enumerate(tree.joints.values()):
        below[joint.parent].append((order, joint))
    places = {tree.root: _Place(None, np.eye(3), np.zeros(3), 0, 0)}
    # Fixed joints first: links behind them belong to an existing body and may carry joints early in the file.
    pending: list[tuple[bool, int, str]] = []
    joints = tree.joints

    def open_up(link: str) -> None:
        for order, joint in below[link]:
            heapq.heappush(pending, (joint.kind != "fixed", order, joint.name))

    open_up(tree.root)
    while pending:
        moves, _, name = heapq.heappop(pending)
        joint, parent = joints[name], places[joints[name].parent]
        if moves:
            places[joint.child] = _Place(joint.child, np.eye(3), np.zeros(3), parent.moving + 1, parent.joints + 1)
        else:
            R, p = parent.R @ joint.R, parent.p + parent.R @ joint.p
            places[joint.child] = _Place(parent.body, R, p, parent.moving, parent.joints + 1)
        open_up(joint.child)
    return places


def _links(tree: UrdfTree, places: Mapping[str, _Place]) -> tuple[Link, ...]:
    """Return the moving bodies with everything fixed to them; a floating or planar joint is still a single link."""
    parts: dict[str | None, list[Inertia]] = {}
    for name, pose in places.items():
        inertia = tree.links[name].inertia
        if inertia is not None and pose.body is not None:
            own = name == pose.body
            parts.setdefault(pose.body, []).append(inertia if own else inertia.placed(pose.R, pose.p))
    joint_to = {joint.child: joint for joint in tree.joints.values()}
    shapes = _shapes(tree, places)
    links = []
    for name, pose in places.items():
        if pose.body != name:
            continue
        joint = joint_to[name]
        parent = places[joint.parent]
        links.append(
            Link(
                name=name,
                joint=joint.name,
                parent=parent.body,
                kind=MOVING.get(joint.kind, joint.kind),
                axis=joint.axis,
                inertia=Inertia.merged(parts.get(name, [Inertia(0.0)])),
                R_PJ=parent.R @ joint.R,
                p_PJ=parent.p + parent.R @ joint.p,
                damping=joint.damping,
                friction=joint.friction,
                lower=joint.lower,
                upper=joint.upper,
                velocity_limit=joint.velocity_limit,
                effort_limit=joint.effort_limit,
                shapes=shapes.get(name, ()),
            )
        )
    return tuple(links)


def _shapes(tree: UrdfTree, places: Mapping[str, _Place]) -> dict[str | None, tuple[Shape, ...]]:
    """Return the shapes of each moving body and of the world (None), with everything fixed to it."""
    drawn: dict[str | None, tuple[Shape, ...]] = {}
    for name, pose in places.items():
        turn = quaternion(pose.R)
        shapes = tuple(shape.placed(pose.p, turn) for shape in tree.links[name].shapes)
        drawn[pose.body] = (*drawn.get(pose.body, ()), *shapes)
    return drawn


def _hand(tree: UrdfTree, places: Mapping[str, _Place]) -> _Place:
    """Return the controlled point: the link ``hand`` if it moves, otherwise the tip of the first deepest chain."""
    tip = max(tree.links, key=lambda name: (places[name].moving, places[name].joints))
    if HAND in places and places[HAND].moving > 0:
        tip = HAND
    return places[tip]


def _warn(tree: UrdfTree, places: Mapping[str, _Place], links: tuple[Link, ...]) -> None:
    """Refuse impossible bodies; warn about missing masses."""
    for link in links:
        link.inertia.check(f"{tree.path}:{tree.links[link.name].line}: link {link.name!r}, with everything fixed to it")
    loaded: set[str | None] = set()
    for link in reversed(links):
        if link.name in loaded or link.inertia.mass > 0.0 or link.inertia.tensor.any():
            loaded |= {link.name, link.parent}
    empty = [link.joint for link in links if link.name not in loaded and (link.parent in loaded or not link.parent)]
    if empty:
        warnings.warn(f"{tree.path}: nothing beyond these joints has a mass ({', '.join(empty)})", stacklevel=3)
    moving = [tree.links[name] for name, pose in places.items() if pose.body is not None]
    bare = [link.name for link in moving if link.inertia is None and link.shaped]
    if bare:
        warnings.warn(
            f"{tree.path}: links with a shape but without <inertial> have no mass ({', '.join(bare)})", stacklevel=3
        )
    odd = []
    for part in moving:
        try:
            (part.inertia or Inertia(0.0)).check(part.name)
        except ModelError:
            odd.append(part.name)
    if odd:
        warnings.warn(
            f"{tree.path}: impossible moments of inertia, accepted because the sum with the links fixed to them is "
            f"possible ({', '.join(odd)})",
            stacklevel=3,
        )
