"""URDF import: strict reading of links and joints, lenient reading of shapes, and conversion to a robot.

All numbers are checked, and one error lists all problems with element and line. Elements that are optional in the URDF
specification get its defaults (a link without ``<inertial>`` has no mass, a joint without ``<axis>`` turns about x).
Other elements that are missing, misspelt, repeated or not numeric are errors.
"""

from __future__ import annotations

import difflib
import heapq
import math
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, Literal
from xml.parsers import expat

import numpy as np

from dynsim.config.problems import suggest
from dynsim.errors import ModelError, RecordError, first_few
from dynsim.model.description import WORLD, Array, Coupling, Frame, Inertia, Link, Robot
from dynsim.model.joints.ball import floating
from dynsim.model.joints.planar import planar
from dynsim.record.meshes import mesh_path, read_mesh
from dynsim.record.quaternion import of_turn, product
from dynsim.record.scene import Shape, ShapeKind, quaternion
from dynsim.record.urdf_text import rotation as rotation_of
from dynsim.system.inputs import read_bytes

# XML of a URDF file: elements with line numbers, and attributes as numbers; unknown attributes are reported.


# Limits on a file; the largest robots in use have some 100 links and 1 MB of text.
BYTES_MAX, ELEMENTS_MAX, DEPTH_MAX = 16_000_000, 100_000, 100
ATTRIBUTES_MAX, NAME_LENGTH_MAX, _NUMBER_LENGTH_MAX = 100, 200, 400
# Maximum magnitude of a number: no robot needs larger numbers, and their products could overflow.
_MAGNITUDE_MAX = 1e15

# An XML declaration after white space or comments, and its encoding.
_LATE_DECLARATION = re.compile(
    rb"""\A(?:\xef\xbb\xbf)?(?:\s|<!--(?:(?!-->).)*-->)+(<\?xml\s(?:[^>]*\sencoding\s*=\s*["']([\w.-]+))?[^>]*\?>)""",
    re.DOTALL,
)
# Elements that define physics. Their values are attributes, so text inside them is an error.
_WITHOUT_TEXT = {"mass", "inertia", "origin", "axis", "limit", "dynamics", "mimic"}

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Child elements that affect the physics, by parent, and their attributes. Other elements, and other attributes of
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
_EXAMPLE = {1: '"0.25"', 3: '"0 0 0.25"', 4: '"0 0 1 1"'}
_ZERO: tuple[float, ...] = (0.0, 0.0, 0.0)


# Maximum number of problems in one message.
_PROBLEMS_MAX = 100


class _Reported(ModelError):
    """Consequence of a problem that is already in the list."""


class _Unexpanded(ModelError):
    """Expression of xacro, which alone is reported: the other problems may vanish with it."""


@dataclass
class Findings:
    """Problems of a file, each with its line, harmless extras, which are ignored, and repairs."""

    problems: list[ModelError] = field(default_factory=list)
    extras: list[str] = field(default_factory=list)
    repairs: list[str] = field(default_factory=list)  # moments of inertia that were replaced
    unread: set[str] = field(default_factory=set)  # links with an invalid name

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Add an error of the block to the problems."""
        try:
            yield
        except _Reported:
            pass
        except ModelError as error:
            self.problems.append(error)

    def check(self) -> None:
        """Raise the only problem, or one error with all problems, one per line."""
        for problem in self.problems:
            if isinstance(problem, _Unexpanded):
                raise ModelError(str(problem))
        if len(self.problems) == 1:
            raise self.problems[0]
        texts = list(dict.fromkeys(map(str, self.problems)))
        if len(texts) > _PROBLEMS_MAX:
            texts[_PROBLEMS_MAX:] = [f"and {len(texts) - _PROBLEMS_MAX} more problems"]
        if texts:
            raise ModelError("\n  ".join(texts))


@dataclass(frozen=True)
class Corrections:
    """Values that replace numbers of a file.

    Attributes
    ----------
    links : mapping
        By link: mass [kg], com (3,) [m], tensor (3, 3) about it [kg m²], or density of its shapes [kg/m³].
    joints : mapping
        By joint: attributes of :class:`Link`, such as lower, upper, damping and friction.
    nearest : bool
        Replace impossible moments of inertia by the nearest possible ones.
    floating : bool
        Let the root link float on a joint named ``root``; otherwise it is the world.
    """

    links: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    joints: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    nearest: bool = False
    floating: bool = False


@dataclass
class Element:
    """XML tag with its attributes, start line and children; ``owner`` names its link or joint in errors."""

    path: Path
    line: int
    tag: str
    attributes: dict[str, str]
    owner: str
    findings: Findings
    children: list[Element] = field(default_factory=list)
    faulty: set[str] = field(default_factory=set)  # tags of children that are reported

    def child(self, tag: str) -> Element | None:
        """Return the first child with this tag, or None."""
        if tag in self.faulty:
            raise _Reported("")
        return next((child for child in self.children if child.tag == tag), None)

    def equals(self, other: Element) -> bool:
        """Return True if both elements have the same tag, attributes and children."""
        same = (self.tag, self.attributes, len(self.children)) == (other.tag, other.attributes, len(other.children))
        return same and all(a.equals(b) for a, b in zip(self.children, other.children, strict=True))

    def ignore(self, text: str) -> None:
        """Add a harmless extra to the findings."""
        self.findings.extras.append(f"{text} (line {self.line})")

    def error(self, text: str) -> ModelError:
        """Return an error about the element."""
        return _error(self.path, self.line, text)

    def fault(self, text: str) -> ModelError:
        """Return an error about the element that names its link or joint."""
        return self.error(f"{self.owner}: {text}")

    def name(self, others: Mapping[str, UrdfLink | UrdfJoint]) -> str:
        """Return the name of a link or joint, after checking that it is printable and unique."""
        name = self.attributes.get("name", "")
        if not name:
            raise self.error(f"<{self.tag}> has no name; add the attribute name")
        self._check_expanded("name")
        if not name.isprintable():
            raise self.fault("the name has control characters; remove them")
        if len(name) > NAME_LENGTH_MAX:
            raise self.fault(f"a name has at most {NAME_LENGTH_MAX} characters")
        if name in others:
            raise self.error(
                f"{self.owner} is defined twice (also in line {others[name].line}); rename one of them",
            )
        return name

    def check_children(self, replaced: Collection[str] = ()) -> None:
        """Report repeated, misplaced or misspelt elements, which other readers silently ignore.

        Elements whose tag is in ``replaced`` are not read.
        """
        known, seen = _CHILDREN[self.tag], dict[str, Element]()
        for child in self.children:
            meant = _near(child.tag, known)
            if meant in replaced:
                continue
            reported = len(self.findings.problems)
            with self.findings.collecting():
                if child.tag in known:
                    first = seen.setdefault(child.tag, child)
                    if first is not child and self.tag != "robot":
                        if not child.equals(first):
                            raise child.error(f"{self.owner} has more than one <{child.tag}>; remove one")
                        child.ignore(f"second <{child.tag}> of {self.owner}")
                    child._check_attributes()
                elif meant:
                    raise child.error(f"{self.owner}: unknown element <{cut(child.tag)}>; did you mean <{meant}>?")
                elif child.tag in ("link", "joint", "inertial", "mass", "inertia"):
                    raise child.error(f"{self.owner}: <{child.tag}> does not belong in <{self.tag}>")
            if meant and len(self.findings.problems) > reported:
                self.faulty.add(meant)

    def _check_attributes(self) -> None:
        known = _ATTRIBUTES.get(self.tag, ())
        for key in self.attributes if known else ():
            if key in known:
                continue
            twin = f"i{key[2:]}{key[1:2]}"
            if (self.tag, key) == ("axis", "rpy") or (self.tag == "inertia" and twin in known):
                if twin in self.attributes and self.number(twin) != self.number(key):
                    raise self.fault(f"{key} and {twin} of <inertia> differ; remove {key}")
                self.ignore(f"{key} of <{self.tag}> of {self.owner}")
                continue
            meant = _near(key, known)
            if meant or self.tag not in _EXTENDED:
                hint = f"did you mean {meant}?" if meant else f"known: {', '.join(known)}"
                raise self.fault(f"unknown attribute {cut(key)} of <{self.tag}>; {hint}")

    def required(self, tag: str, fix: str) -> Element:
        """Return the child with this tag, or raise an error with the advice ``fix`` if it is missing."""
        child = self.child(tag)
        if child is None:
            inside = ": <inertial>" if self.tag == "inertial" else ""
            raise self.error(f"{self.owner}{inside} has no <{tag}>; {fix}")
        return child

    def text(self, key: str) -> str:
        """Return a required, non-empty attribute."""
        if not self.attributes.get(key):
            raise self.fault(f"<{self.tag}> has no {key}; add it")
        self._check_expanded(key)
        return self.attributes[key]

    def number(self, key: str, default: float | None = None) -> float:
        """Return the single number of an attribute."""
        return self.numbers(key, 1, None if default is None else (default,))[0]

    def numbers(self, key: str, count: int, default: tuple[float, ...] | None = None) -> tuple[float, ...]:
        """Return the ``count`` numbers of an attribute, which must be finite plain ASCII decimals."""
        text, example = self.attributes.get(key), _EXAMPLE[count]
        if text is None:
            if default is not None:
                return default
            raise self.fault(f"<{self.tag}> has no {key}; add it, e.g. {key}={example}")
        self._check_expanded(key)
        words = _words(text)
        stated = f"<{self.tag} {key}={quoted(text)}>"
        if len(words) != count:
            raise self.fault(f"{stated} has {len(words)} entries, {count} are needed, e.g. {example}")
        for word in words:
            if len(word) > _NUMBER_LENGTH_MAX or not _NUMBER.fullmatch(word):
                spaced = " ".join(text.replace(",", " ").split())
                fix = "write decimal digits 0–9 with a point"
                if "," in text and len(spaced.split()) == count:
                    fix, example = "separate numbers by spaces only", f'"{cut(spaced)}"'
                raise self.fault(f"{stated} is not a finite number; {fix}, e.g. {example}")
            value = float(word)
            vanished = value == 0.0 and re.search("[1-9]", re.split("[eE]", word)[0])
            # Limits may be arbitrarily large, which means that there is no limit.
            largest = math.inf if self.tag == "limit" else _MAGNITUDE_MAX
            if vanished or not math.isfinite(value) or abs(value) > largest:
                raise self.fault(f"{stated} is out of the range of numbers; check its exponent")
        return tuple(map(float, words))

    def origin(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return position [m] and angles roll, pitch, yaw [rad] of ``<origin>``; zeros without it."""
        origin = self.child("origin")
        return (_ZERO, _ZERO) if origin is None else (origin.numbers("xyz", 3, _ZERO), origin.numbers("rpy", 3, _ZERO))

    def _check_expanded(self, key: str) -> None:
        value = self.attributes[key]
        if "${" in value or "$(" in value:
            raise _Unexpanded(str(self.fault(f"<{self.tag} {key}={quoted(value)}>: {_expand(self.path)}")))


def _error(path: Path, line: int, text: str) -> ModelError:
    return ModelError(f"{path}:{line}: {text}")


def read_xml(path: Path) -> Element:
    """Return the root element of a file, in any encoding that expat knows, with all of its content.

    Raises
    ------
    ModelError
        If the file cannot be read, is not XML, or exceeds a limit.
    """
    data = read_bytes(path, ModelError, BYTES_MAX)
    if not data.strip():
        raise ModelError(f"{path}: is empty; a URDF file has <robot> with links and joints")
    findings, declared = Findings(), _LATE_DECLARATION.search(data)
    if declared is not None:
        # Blank the declaration, so that line numbers remain.
        data = data[: declared.start(1)] + b" " * len(declared[1]) + data[declared.end(1) :]
        findings.extras.append("an XML declaration after the first character of the file")
    encoding = declared[2] if declared is not None else None
    parser = expat.ParserCreate(None if encoding is None else encoding.decode("ascii"))
    open_elements: list[Element] = []
    roots: list[Element] = []
    count, lost = 0, None  # an element that does not belong where it is

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count, lost
        count += 1
        around = [element.tag for element in open_elements]
        own = f"{tag} {quoted(attributes.get('name', ''))}" if around else "the robot"
        owner = open_elements[-1].owner if len(around) > 1 else own
        element = Element(path, parser.CurrentLineNumber, tag, attributes, owner, findings)
        if tag.startswith("xacro:"):
            raise element.error(f"<{cut(tag)}>: {_expand(path)}")
        if count > ELEMENTS_MAX:
            raise element.error(f"more than {ELEMENTS_MAX} elements; simplify the model")
        if len(around) >= DEPTH_MAX:
            raise element.error(f"elements are nested more than {DEPTH_MAX} deep; URDF needs fewer than ten")
        if len(attributes) > ATTRIBUTES_MAX:
            raise element.error(f"<{cut(tag)}> has more than {ATTRIBUTES_MAX} attributes; simplify the model")
        parents = {"link": ["robot"], "inertial": ["robot", "link"]}.get(tag, around)
        in_robot = around[:1] == ["robot"] and "gazebo" not in around
        if lost is not None:
            pass
        elif in_robot and around != parents and not (tag == "inertial" and around[:2] == parents):
            lost = element
            text = f"<{tag}> in <{cut(around[-1])}> would be ignored; it belongs in <{parents[-1]}>, move it there"
            findings.problems.append(element.error(text))
        else:
            (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        nonlocal lost
        if open_elements.pop() is lost:
            lost = None

    def text(content: str) -> None:
        tag, content = open_elements[-1].tag, content.strip()
        # An element without attributes is refused for missing attributes.
        if content and tag in _WITHOUT_TEXT and open_elements[-1].attributes:
            stated = f"<{tag}> contains the text {quoted(content)}"
            fix = "URDF has values in attributes only"
            findings.problems.append(_error(path, parser.CurrentLineNumber, f"{stated}; {fix}"))

    def document_type(*_: object) -> None:
        problem = "has a DOCTYPE; entities and DTDs are not supported: expand and remove them"
        raise _error(path, parser.CurrentLineNumber, problem)

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, text
    parser.StartDoctypeDeclHandler = document_type
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        problem = f"invalid XML: {expat.ErrorString(error.code)}"
        if not roots or open_elements:
            raise _error(path, error.lineno, problem) from None
        findings.problems.append(_error(path, error.lineno, f"{problem}; remove the text after </robot>"))
    except (LookupError, ValueError) as error:
        raise ModelError(f"{path}: unknown encoding ({error}); save it as UTF-8") from None
    return roots[0]


def _expand(path: Path) -> str:
    return (
        f"this is a xacro file; run `xacro {path} > {path.name.split('.')[0]}_expanded.urdf` (of ROS) and use that file"
    )


def _near(word: str, known: tuple[str, ...]) -> str:
    """Return ``word`` if it is known, otherwise the known word that it seems to misspell, or "".

    Words that are merely similar may be extensions of other programs.
    """
    if word in known:
        return word
    near = difflib.get_close_matches(word[:40].casefold(), known, n=1, cutoff=0.8)
    return near[0] if near else ""


def _words(text: str) -> list[str]:
    """Return the words between XML white space."""
    return re.findall(r"[^ \t\r\n]+", text)


def quoted(text: str) -> str:
    """Return a text from the file, quoted and shortened for a message."""
    return repr(cut(text))


def cut(text: str) -> str:
    """Return a text from the file, shortened for a message."""
    return text if len(text) <= 60 else text[:57] + "..."


# Visual shapes and named colours of URDF links (``<visual>``), read leniently.


Colour = tuple[float, float, float, float]


def _shapes_of(link: Element, named_colours: Mapping[str, Colour | None], tag: str = "visual") -> tuple[Shape, ...]:
    """Return the shapes of a link in its frame that can be drawn; ``named_colours`` maps names to colours."""
    shapes = []
    for visual in link.children:
        if visual.tag == tag:
            with suppress(ModelError, ValueError):
                shapes.append(_shape(visual, named_colours))
    return tuple(shapes)


def _collisions_of(link: Element) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    """Return the collision shapes of a link that can be solids, and texts about the others."""
    solids, omitted = list[Shape](), list[str]()
    for collision in link.children:
        if collision.tag == "collision":
            text = f"{link.path.name}:{collision.line}: <collision> of {link.owner}"
            try:
                shape = _shape(collision, {})
            except (ModelError, ValueError):
                omitted.append(f"{text} has no valid geometry")
            else:
                if shape.kind == "mesh":
                    omitted.append(f"{text} is the mesh {shape.file}")
                else:
                    solids.append(shape)
    return tuple(solids), tuple(omitted)


def _shape(visual: Element, named_colours: Mapping[str, Colour | None]) -> Shape:
    """Return a shape; raise ModelError or ValueError if it cannot be drawn."""
    (solid,) = visual.required("geometry", "add it").children
    xyz, (roll, pitch, yaw) = visual.origin()
    kind: ShapeKind
    file = ""
    match solid.tag:
        case "box":
            kind, size = "box", solid.numbers("size", 3)
        case "sphere":
            kind, size = "sphere", solid.numbers("radius", 1)
        case "cylinder" | "capsule":
            kind = "cylinder" if solid.tag == "cylinder" else "capsule"
            size = solid.numbers("radius", 1) + solid.numbers("length", 1)
        case "mesh":
            kind, size, file = "mesh", solid.numbers("scale", 3, (1.0, 1.0, 1.0)), solid.text("filename")
        case _:
            raise ValueError(solid.tag)
    if kind != "mesh" and min(size) <= 0.0:
        raise ValueError(size)
    turn = product(of_turn((0, 0, 1), yaw), product(of_turn((0, 1, 0), pitch), of_turn((1, 0, 0), roll)))
    material = visual.child("material")
    colour = None if material is None else _colour(material, named_colours)
    return Shape(kind, size, file=file, colour=colour).placed(np.array(xyz), turn)


def _colour(material: Element, named_colours: Mapping[str, Colour | None]) -> Colour | None:
    with suppress(ModelError):
        red, green, blue, opacity = material.required("color", "add it").numbers("rgba", 4)
        if all(0.0 <= number <= 1.0 for number in (red, green, blue, opacity)):
            return red, green, blue, opacity
    return named_colours.get(material.attributes.get("name", ""))


def solid_inertia(shapes: Sequence[Shape], density: float, folder: Path, key: str) -> Inertia:
    """Return the mass properties of solid shapes with a density [kg/m³]; overlaps count twice.

    Raises
    ------
    ModelError
        If there are no shapes, or a mesh is not found, cannot be read, or is not closed.
    """
    if not shapes:
        raise ModelError(f"{key}.density_kg_m3: the link has no shapes; set mass_kg, com_m and inertia_kg_m2")
    parts = []
    for shape in shapes:
        try:
            solid = _solid(shape, density, folder)
        except (RecordError, ValueError) as error:
            raise ModelError(f"{key}.density_kg_m3: {error}; set mass_kg, com_m and inertia_kg_m2 instead") from error
        parts.append(solid.placed(rotation_of(shape.orientation), np.array(shape.position)))
    return Inertia.merged(parts)


def _solid(shape: Shape, density: float, folder: Path) -> Inertia:
    """Return the mass properties of a shape in its own frame."""
    match shape.kind:
        case "box":
            return Inertia.solid_box(density * math.prod(shape.size), shape.size)
        case "sphere":
            return Inertia.solid_capsule(density, shape.size[0], 0.0)
        case "capsule":
            return Inertia.solid_capsule(density, *shape.size)
        case "cylinder":
            radius, length = shape.size
            upright = Inertia.solid_cylinder(density * math.pi * radius**2 * length, radius, length)
            return upright.placed(np.eye(3), np.array([0.0, 0.0, -0.5 * length]))
    path = mesh_path(shape.file, [folder])
    if path is None:
        raise ValueError(f"mesh {shape.file} not found")
    mesh = read_mesh(path)
    try:
        return Inertia.solid_mesh(density, (np.array(shape.size) * mesh.corners)[mesh.triangles])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


# Maximum number of links; the largest robots in use have some 100 links.
LINKS_MAX = 2000
MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
# Joints with several rates.
SEVERAL = ("floating", "planar")
# A limit of at least this magnitude means "no limit" [rad, m, N m …]: URDF requires a number for most limits.
UNLIMITED = 1e9


@dataclass(frozen=True)
class UrdfLink:
    """Link as stated in the file.

    ``inertia`` is None if the link has no ``<inertial>``; ``shaped`` is True if it has a visual or collision element;
    ``shapes`` are the visual elements that can be drawn; ``solids`` and ``omitted`` as in :class:`Link`.
    """

    name: str
    line: int
    inertia: Inertia | None
    shaped: bool
    shapes: tuple[Shape, ...] = ()
    solids: tuple[Shape, ...] = ()
    omitted: tuple[str, ...] = ()


@dataclass(frozen=True)
class UrdfJoint:
    """Joint as stated in the file, with the link that it carries; ``coupling``: the joint that leads it, if any.

    ``link`` has the names of the links and URDF's type of joint; mass and shapes are those of the tree's link.
    """

    link: Link
    line: int
    coupling: Coupling | None

    @property
    def name(self) -> str:
        """Name of the joint."""
        return self.link.joint

    @property
    def kind(self) -> str:
        """Type of the joint in URDF."""
        return self.link.kind

    @property
    def child(self) -> str:
        """Name of the link that the joint carries."""
        return self.link.name

    @property
    def parent(self) -> str:
        """Name of the link on which the joint is."""
        return str(self.link.parent)


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints by their names, in the order of the file, and the root links: one in a file without problems."""

    path: Path
    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    roots: tuple[str, ...]
    findings: Findings

    def error(self, line: int, text: str) -> ModelError:
        """Return an error about a line of the file."""
        return _error(self.path, line, text)


def read_tree(path: Path, corrections: Corrections | None = None) -> UrdfTree:
    """Read the links and joints of a URDF file.

    Raises
    ------
    ModelError
        If the file cannot be read, is not URDF, or is ambiguous; the message lists all problems with file, line, link
        or joint, attribute, value and a fix.
    """
    tree = _parse(path, corrections or Corrections())
    tree.findings.check()
    return tree


def _parse(path: Path, corrections: Corrections) -> UrdfTree:
    """Read a file as far as possible, and collect its problems."""
    root = read_xml(path)
    findings = root.findings
    if root.tag != "robot":
        raise root.error(f"the root element is <{cut(root.tag)}>, must be <robot>")
    root.check_children()
    links: dict[str, UrdfLink] = {}
    joints: dict[str, UrdfJoint] = {}
    materials = [child for child in root.children if child.tag == "material"]
    colours = {material.attributes.get("name", ""): _colour(material, {}) for material in materials}
    named: dict[tuple[str, str], Element] = {}
    elements = [element for element in root.children if element.tag in ("link", "joint")]
    if sum(element.tag == "link" for element in elements) > LINKS_MAX:
        raise root.error(f"more than {LINKS_MAX} links; simplify the model")
    # Joints name links that may follow them in the file.
    for element in sorted(elements, key=lambda element: element.tag, reverse=True):
        name = element.attributes.get("name", "")
        twin = named.setdefault((element.tag, name), element)
        if twin is not element and element.equals(twin):
            element.ignore(f"second definition of {element.owner}")
            continue
        with findings.collecting():
            if element.tag == "link":
                links[name] = _link(element, links, colours, corrections.links.get(name, {}))
            else:
                joints[name] = _joint(element, joints, links, corrections.joints.get(name, {}))
        if element.tag == "link" and name not in links:
            findings.unread.add(name)
    if not links:
        findings.problems.append(ModelError(f"{path}: has no <link>; a URDF file has links and joints"))
    floats = corrections.floating
    if (
        links
        and not floats
        and all(joint.attributes.get("type") == "fixed" for joint in elements if joint.tag == "joint")
    ):
        floats = True  # so that the mass properties are checked too
        findings.problems.append(_immobile(path))
    roots: tuple[str, ...] = ()
    with findings.collecting():
        roots = _roots(path, links, joints)
        if len(roots) > 1 and len(joints) == sum(tag == "joint" for tag, _ in named):
            names, line = first_few([quoted(name) for name in roots]), links[roots[1]].line
            findings.problems.append(
                _error(path, line, f"a tree has one root link; found: {names}; connect them with joints")
            )
    tree = UrdfTree(path, root.attributes.get("name", "") or path.stem, links, joints, roots, findings)
    return _floating(tree) if floats and len(roots) == 1 else tree


def _immobile(path: Path) -> ModelError:
    return ModelError(f"{path}: has no moving joints; set plant.base: floating to let the root link move")


def _floating(tree: UrdfTree) -> UrdfTree:
    """Return the tree with a floating joint between the world and its root link."""
    (root,) = tree.roots
    if ROOT in tree.joints or any(joint.kind == "floating" for joint in tree.joints.values() if joint.parent == root):
        text = (
            f"plant.base: floating adds a joint {ROOT!r}, but the file has a floating or equally named joint; remove it"
        )
        tree.findings.problems.append(ModelError(f"{tree.path}: {text}"))
        return tree
    world = WORLD
    while world in tree.links:
        world += "_"
    line = tree.links[root].line
    joint = UrdfJoint(Link(root, ROOT, world, "floating", np.array([1.0, 0.0, 0.0]), Inertia(0.0)), line, None)
    links = {world: UrdfLink(world, line, None, shaped=False), **tree.links}
    return replace(tree, links=links, joints={ROOT: joint, **tree.joints}, roots=(world,))


def _link(
    element: Element,
    others: Mapping[str, UrdfLink],
    named_colours: Mapping[str, Colour | None],
    correction: Mapping[str, Any],
) -> UrdfLink:
    name, findings = element.name(others), element.findings
    whole = correction.keys() >= {"mass", "com", "tensor"} or "density" in correction
    element.check_children(("inertial",) if whole else ())
    for shape in element.children:
        for lost in shape.children if shape.tag != "gazebo" and not _near(shape.tag, ("inertial",)) else ():
            if lost.tag in ("inertial", "mass", "inertia"):
                target = "directly below <link>" if lost.tag == "inertial" else "into <inertial>"
                text = f"<{lost.tag}> is inside <{cut(shape.tag)}>; move it {target}"
                findings.problems.append(lost.fault(text))
    shaped = any(child.tag in ("visual", "collision") for child in element.children)
    shapes, inertia = _shapes_of(element, named_colours), None
    with findings.collecting():
        if "density" in correction:
            solids = shapes or _shapes_of(element, {}, "collision")
            inertia = solid_inertia(solids, correction["density"], element.path.parent, f"plant.links.{name}")
            inertia = replace(inertia, com=correction.get("com", inertia.com))
        elif whole:
            inertia = Inertia(**correction)
        elif (inertial := element.child("inertial")) is not None:
            inertia = _inertia(inertial, correction)
        elif correction:
            inertia = Inertia(**{"mass": 0.0, **correction})
    return UrdfLink(name, element.line, inertia, shaped, shapes, *_collisions_of(element))


def _inertia(element: Element, correction: Mapping[str, Any]) -> Inertia | None:
    """Return the mass properties of a link; None if a number is missing or invalid."""
    findings, corrected = element.findings, {"mass": "mass", "tensor": "inertia", "com": "origin"}
    reported = len(findings.problems)
    # The angles of <origin> turn the axes of <inertia>.
    unread = [corrected[key] for key in correction if key != "com" or "tensor" in correction]
    element.check_children(unread)
    values: dict[str, Any] = {}
    name = element.owner.removeprefix("link ").strip("'")
    with findings.collecting():
        if "mass" not in correction:
            mass = element.required("mass", f"add it, or set plant.links.{name}.mass_kg")
            values["mass"] = mass.number("value")
            if values["mass"] < 0.0:
                raise mass.fault(f"mass {values['mass']:g} kg must not be negative")
    with findings.collecting():
        com, rpy = element.origin() if "origin" not in unread else (_ZERO, _ZERO)
        values["com"], R = np.array(com), rotation(*rpy)
    with findings.collecting():
        if "tensor" not in correction:
            moments = element.required(
                "inertia", f"add all six moments, set plant.links.{name}.inertia_kg_m2 or density_kg_m3"
            )
            xx, xy, xz, yy, yz, zz = map(moments.number, MOMENTS)
            if "com" in values:
                tensor = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
                values["tensor"] = 0.5 * (tensor + tensor.T)
    return Inertia(**{**values, **correction}) if len(findings.problems) == reported else None


def _joint(
    element: Element,
    others: Mapping[str, UrdfJoint],
    links: Mapping[str, UrdfLink],
    correction: Mapping[str, float],
) -> UrdfJoint:
    name, findings = element.name(others), element.findings
    limited, lossy = "lower" in correction, correction.keys() >= {"damping", "friction"}
    element.check_children([tag for tag, known in (("limit", limited), ("dynamics", lossy)) if known])
    kind, known = element.attributes.get("type"), (*MOVING, "fixed", *SEVERAL)
    if kind not in known:
        stated = "has no type" if kind is None else f"is {quoted(kind)}{suggest(kind, known)}"
        several = "; three revolute joints about one point are a ball joint" if kind in ("spherical", "ball") else ""
        findings.problems.append(element.error(f"{element.owner} {stated}; known: {', '.join(known)}{several}"))
        kind = "continuous"  # to find further problems
    ends: dict[str, str] = {}
    for tag in ("parent", "child"):
        with findings.collecting():
            end = element.required(tag, f'add it, e.g. <{tag} link="arm"/>')
            ends[tag] = end.text("link")
            if ends[tag] in findings.unread:
                ends.pop(tag)
            elif ends[tag] not in links:
                stated = f"its {tag} link {quoted(ends[tag])} is not in the file"
                raise end.fault(f"{stated}; add it or remove the joint{suggest(ends.pop(tag), links)}")
    for tag in ("limit", "dynamics") if kind in SEVERAL else ():
        with findings.collecting():
            if (single := element.child(tag)) is not None:
                raise single.error(
                    f"{element.owner} is {kind}: <{tag}> has one number but the joint several rates; remove <{tag}>"
                )
    p, rpy, axis, coupling = _ZERO, _ZERO, np.array([1.0, 0.0, 0.0]), None
    values: dict[str, Any] = {}
    with findings.collecting():
        p, rpy = element.origin()
    with findings.collecting():
        if not limited:
            values |= _limits(element, kind)
        elif (limit := element.child("limit")) is not None:
            values |= _bounds(limit, kind)
    with findings.collecting():
        if not lossy and (dynamics := element.child("dynamics")) is not None:
            losses = {key: dynamics.number(key, 0.0) for key in ("damping", "friction") if key not in correction}
            if min(losses.values()) < 0.0:
                stated = " and ".join(f"{key} {loss:g}" for key, loss in losses.items())
                raise dynamics.fault(f"{stated} must not be negative")
            values |= losses
    with findings.collecting():
        if (mimic := element.child("mimic")) is not None:
            coupling = Coupling(name, mimic.text("joint"), mimic.number("multiplier", 1.0), mimic.number("offset", 0.0))
    with findings.collecting():
        axis = _axis(element, kind)
    if len(ends) < 2:
        raise _Reported("")
    link = Link(
        name=ends["child"],
        joint=name,
        parent=ends["parent"],
        kind=kind,
        axis=axis,
        inertia=Inertia(0.0),
        R_PJ=rotation(*rpy),
        p_PJ=np.array(p),
        **{**values, **correction},
    )
    return UrdfJoint(link, element.line, coupling)


def _limits(element: Element, kind: str) -> dict[str, Any]:
    """Return the limits of a joint by their names in `Link`; zero velocity or effort means unknown."""
    limit = element.child("limit")
    key = f"plant.joints.{element.attributes['name']}.limit_{'m' if kind == 'prismatic' else 'deg'}"
    if limit is None:
        if kind in ("revolute", "prismatic"):
            raise element.error(f"{element.owner} is {kind} and has no <limit>; add it or set {key}")
        return {}
    try:
        lower, upper = limit.number("lower", 0.0), limit.number("upper", 0.0)
        if kind == "continuous":
            lower, upper = -math.inf, math.inf
        if lower > upper:
            raise limit.fault(f"lower limit {lower:g} is above upper limit {upper:g}; swap them")
    except ModelError as error:
        raise ModelError(f"{error}; or set {key}") from None
    bounds = _bounds(limit, kind)
    return {
        "lower": -math.inf if lower <= -UNLIMITED else lower,
        "upper": math.inf if upper >= UNLIMITED else upper,
        **bounds,
    }


def _bounds(limit: Element, kind: str) -> dict[str, float]:
    """Return the limits of velocity and effort; zero means unknown."""
    bounds = {f"{key}_limit": limit.number(key, None if kind in MOVING else 0.0) for key in ("velocity", "effort")}
    if min(bounds.values()) < 0.0:
        raise limit.fault("velocity and effort limits must not be negative; 0: unlimited")
    return {key: size if 0.0 < size < UNLIMITED else math.inf for key, size in bounds.items()}


def _axis(element: Element, kind: str) -> Array:
    """Return the unit axis in the joint's frame; the axis of a joint that does not use it is not checked."""
    stated, default = element.child("axis"), np.array([1.0, 0.0, 0.0])
    if stated is None:
        if kind == "planar":
            raise element.error(
                f"{element.owner} is planar and has no <axis>, the normal of its plane: URDF then means x, but many "
                'programs z; add it, e.g. <axis xyz="0 0 1"/>'
            )
        return default
    axis = np.array(stated.numbers("xyz", 3))
    if kind not in (*MOVING, "planar"):
        return default
    length = float(np.linalg.norm(axis))
    if not 1e-12 < length < math.inf:
        raise stated.fault(f"axis {quoted(stated.attributes['xyz'])} has no direction")
    # A unit axis stays as it is: dividing by 1 − 1e-16 would take it off the exact coordinate directions.
    return axis if abs(length - 1.0) < 1e-15 else axis / length


def _roots(path: Path, links: Iterable[str], joints: Mapping[str, UrdfJoint]) -> tuple[str, ...]:
    """Return the links that are not a child; all others must be reached from them."""
    above: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        other = above.setdefault(joint.child, joint)
        if other is not joint:
            raise _error(
                path,
                joint.line,
                f"joint {quoted(joint.name)}: its child {quoted(joint.child)} is already the child of joint "
                f"{quoted(other.name)} (line {other.line}): a kinematic loop, which URDF does not support; "
                "remove one of the two",
            )
    try:
        TopologicalSorter({child: [joint.parent] for child, joint in above.items()}).prepare()
    except CycleError as error:
        lost = next(joint for child, joint in above.items() if child in error.args[1])
        raise _error(
            path,
            lost.line,
            f"joint {quoted(lost.name)} is part of a kinematic loop without a root link; "
            "the joints of a URDF file must form a tree",
        ) from None
    return tuple(name for name in links if name not in above)


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


HAND, ROOT = "hand", "root"
# Functions that make the rows of joints with several rows.
ROWS = {"floating": floating, "planar": planar}


@dataclass(frozen=True)
class _Place:
    """Moving body that carries a link (None: the world), the link's frame on it, and its distance from the root."""

    body: str | None
    R: Array
    p: Array
    moving: int
    joints: int


def read_urdf(path: Path, lock: Mapping[str, float] | None = None, corrections: Corrections | None = None) -> Robot:
    """Read the bodies and joints of a URDF file.

    Joints keep their names and their order in the file (except that a parent always comes first); each body is named
    after the link at its moving joint, and every other link is a frame of the body that carries it. Floating and planar
    joints become their rows (:mod:`dynsim.model.joints`). The hand is the link named ``hand``, otherwise the tip of the
    chain with the most moving joints: the last link fixed to its last body, or that body's origin if nothing is fixed
    to it. The root link is the world. A mimic joint is a coupling to its leader; a locked leader locks it too.

    Parameters
    ----------
    path : Path
        URDF file.
    lock : mapping, optional
        Positions [rad or m] of joints to fix, with the joint names as keys.
    corrections : Corrections, optional
        Values that replace numbers of the file.

    Raises
    ------
    ModelError
        If the file does not exist or is not URDF, a number or an inertia is invalid, the leader of a mimic joint does
        not exist, or ``lock`` names an unknown joint or one without a single position. The message lists all problems,
        each with file, line, link or joint, value and a fix.

    Warns
    -----
    UserWarning
        If a link with a shape has no mass, the moments of inertia of a link are impossible for a body, a joint is
        locked beyond its limits, or the file has harmless extras.
    """
    corrections = corrections or Corrections()
    locked = tree = _parse(path, corrections)
    for key, corrected, known in (
        ("links", corrections.links, tree.links),
        ("joints", corrections.joints, tree.joints),
    ):
        for name in corrected.keys() - known.keys():
            tree.findings.problems.append(
                ModelError(f"{path}: plant.{key}: no {key[:-1]} {name!r}{suggest(name, known)}")
            )
    with tree.findings.collecting():
        locked = _locked(tree, {**_locked_followers(tree, lock or {}), **(lock or {})})
    places = _places(locked)
    stated = _links(locked, places)
    links = _possible(locked, places, stated, corrections.nearest)
    if not links and not tree.findings.problems:
        raise _immobile(path)
    frames = [Frame(name, pose.body, pose.R, pose.p) for name, pose in places.items() if pose.body != name]
    rows = tuple(row for link in links for row in (ROWS[link.kind](link) if link.kind in ROWS else (link,)))
    followers = [(joint, coupling) for joint in locked.joints.values() if (coupling := joint.coupling) is not None]
    for joint, coupling in followers:
        for name in (joint.name, coupling.leader):
            if name in locked.joints and locked.joints[name].kind in SEVERAL:
                text = f"joint {joint.name!r} mimics {coupling.leader!r}, but {name!r} has several positions"
                tree.findings.problems.append(tree.error(joint.line, text))
    tree.findings.check()
    _warn(locked, places, links, {link.name for link, old in zip(links, stated, strict=True) if link is not old})
    hand = _hand(tree, places)
    return Robot(
        name=tree.name,
        links=rows,
        motors=(),
        hand=(str(hand.body), hand.p),
        hand_frame=hand.R,
        frames=tuple(frames),
        couplings=tuple(coupling for joint, coupling in followers if joint.kind in MOVING),
        fixed_shapes=_shapes(locked, places).get(None, ()),
        fixed_solids=_shapes(locked, places, "solids").get(None, ()),
        fixed_inertia=_inertias(locked, places).get(None, Inertia(0.0)),
        notes=tuple(tree.findings.repairs),
    )


def _locked_followers(tree: UrdfTree, lock: Mapping[str, float]) -> dict[str, float]:
    """Return positions of mimic joints whose leader is locked or fixed, directly or through others [rad or m]."""
    positions: dict[str, float] = {}
    for follower in tree.joints.values():
        chain, joint = [], follower
        while (coupling := joint.coupling) is not None and joint.name not in lock and joint.kind != "fixed":
            leader = coupling.leader
            if leader not in tree.joints:
                raise tree.error(
                    joint.line,
                    f"joint {joint.name!r} mimics joint {leader!r}, which is not in the file"
                    f"{suggest(leader, tree.joints)}",
                )
            if coupling in chain:
                raise tree.error(joint.line, f"joint {joint.name!r} mimics itself through {leader!r}")
            chain.append(coupling)
            joint = tree.joints[leader]
        if chain and (joint.name in lock or joint.kind == "fixed"):
            q = lock.get(joint.name, 0.0)
            for coupling in reversed(chain):
                q = coupling.ratio * q + coupling.offset
            positions[follower.name] = q
    return positions


def _locked(tree: UrdfTree, lock: Mapping[str, float]) -> UrdfTree:
    """Return the tree with joints fixed at positions: T_PC = T_PJ · Rot(a, q), or T_PJ · Trans(a q) if prismatic."""
    joints = dict(tree.joints)
    for name, value in lock.items():
        if name not in joints:
            raise ModelError(
                f"{tree.path}: lock: no joint {name!r}{suggest(name, joints)}; joints: {', '.join(joints)}"
            )
        joint, link = joints[name], joints[name].link
        if joint.kind not in MOVING:
            fix = "; make it fixed in the file" if joint.kind in SEVERAL else ""
            raise tree.error(
                joint.line, f"lock: joint {name!r} is {joint.kind} and has no single position to lock{fix}"
            )
        if not math.isfinite(value):
            raise ModelError(f"{tree.path}: lock: {name} = {value} is not a finite number")
        if not link.lower - 1e-9 <= value <= link.upper + 1e-9:
            warnings.warn(
                f"{tree.path}: joint {name!r} is locked at {value:g}, outside its limits "
                f"[{link.lower:g}, {link.upper:g}]",
                stacklevel=3,
            )
        if joint.kind == "prismatic":
            fixed = replace(link, kind="fixed", p_PJ=link.p_PJ + link.R_PJ @ link.axis * value)
        else:
            fixed = replace(link, kind="fixed", R_PJ=link.R_PJ @ _turn(link.axis, value))
        joints[name] = replace(joint, link=fixed)
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
    places = {root: _Place(None, np.eye(3), np.zeros(3), 0, 0) for root in tree.roots}
    # Follow fixed joints first, because links behind them belong to an existing body and may carry joints early in the
    # file.
    pending: list[tuple[bool, int, str]] = []
    joints = tree.joints

    def open_up(link: str) -> None:
        for order, joint in below[link]:
            heapq.heappush(pending, (joint.kind != "fixed", order, joint.name))

    for root in tree.roots:
        open_up(root)
    while pending:
        moves, _, name = heapq.heappop(pending)
        joint, parent = joints[name], places[joints[name].parent]
        if moves:
            places[joint.child] = _Place(joint.child, np.eye(3), np.zeros(3), parent.moving + 1, parent.joints + 1)
        else:
            R, p = parent.R @ joint.link.R_PJ, parent.p + parent.R @ joint.link.p_PJ
            places[joint.child] = _Place(parent.body, R, p, parent.moving, parent.joints + 1)
        open_up(joint.child)
    return places


def _links(tree: UrdfTree, places: Mapping[str, _Place]) -> tuple[Link, ...]:
    """Return the moving bodies with everything fixed to them; a floating or planar joint is a single link here."""
    joint_to = {joint.child: joint for joint in tree.joints.values()}
    inertias, shapes, solids = _inertias(tree, places), _shapes(tree, places), _shapes(tree, places, "solids")
    links = []
    for name, pose in places.items():
        if pose.body != name:
            continue
        joint = joint_to[name]
        parent, link = places[joint.parent], joint.link
        links.append(
            replace(
                link,
                parent=parent.body,
                kind=MOVING.get(link.kind, link.kind),
                inertia=inertias.get(name, Inertia(0.0)),
                R_PJ=parent.R @ link.R_PJ,
                p_PJ=parent.p + parent.R @ link.p_PJ,
                shapes=shapes.get(name, ()),
                solids=solids.get(name, ()),
                omitted=tuple(
                    text for part, at in places.items() if at.body == name for text in tree.links[part].omitted
                ),
            )
        )
    return tuple(links)


def _inertias(tree: UrdfTree, places: Mapping[str, _Place]) -> dict[str | None, Inertia]:
    """Return the mass properties of each moving body and of the world (None), with everything fixed to it."""
    parts: dict[str | None, list[Inertia]] = {}
    for name, pose in places.items():
        if (inertia := tree.links[name].inertia) is not None:
            own = name == pose.body
            parts.setdefault(pose.body, []).append(inertia if own else inertia.placed(pose.R, pose.p))
    return {body: Inertia.merged(fixed) for body, fixed in parts.items()}


def _shapes(
    tree: UrdfTree, places: Mapping[str, _Place], kind: Literal["shapes", "solids"] = "shapes"
) -> dict[str | None, tuple[Shape, ...]]:
    """Return the shapes of each moving body and of the world (None), with everything fixed to it."""
    drawn: dict[str | None, tuple[Shape, ...]] = {}
    for name, pose in places.items():
        turn = quaternion(pose.R)
        shapes = tuple(shape.placed(pose.p, turn) for shape in getattr(tree.links[name], kind))
        drawn[pose.body] = (*drawn.get(pose.body, ()), *shapes)
    return drawn


def _hand(tree: UrdfTree, places: Mapping[str, _Place]) -> _Place:
    """Return the controlled point: the link ``hand`` if it moves, otherwise the tip of the first longest chain."""
    tip = max(tree.links, key=lambda name: (places[name].moving, places[name].joints))
    if HAND in places and places[HAND].moving > 0:
        tip = HAND
    return places[tip]


def _possible(tree: UrdfTree, places: Mapping[str, _Place], links: Iterable[Link], nearest: bool) -> tuple[Link, ...]:
    """Return bodies whose moments of inertia are possible: report the others, or replace them by the nearest ones."""
    possible = []
    for link in links:
        line = tree.links[link.name].line
        try:
            link.inertia.check(f"{tree.path}:{line}: link {link.name!r}, with everything fixed to it")
        except ModelError as error:
            if nearest:
                made = link.inertia.nearest()
                change = float(np.linalg.norm(made.tensor - link.inertia.tensor) / np.linalg.norm(link.inertia.tensor))
                before, after = (np.linalg.eigvalsh(inertia.tensor) for inertia in (link.inertia, made))
                tree.findings.repairs.append(
                    f"{tree.path.name}:{line}: link {link.name!r}: principal moments {before} kg m² are impossible; "
                    f"{after} are used instead (a change of {100.0 * change:.3g} % of the norm)"
                )
                link = replace(link, inertia=made)
            else:
                odd = [part for part in _odd(tree, places) if places[part].body == link.name] or [link.name]
                fix = f"set plant.links.{odd[0]}.inertia_kg_m2, or plant.inertia: nearest for the smallest change"
                tree.findings.problems.append(ModelError(f"{error}; {fix}"))
        possible.append(link)
    return tuple(possible)


def _odd(tree: UrdfTree, places: Mapping[str, _Place]) -> list[str]:
    """Return the moving links whose own moments of inertia are impossible."""
    odd = []
    for name, pose in places.items():
        if pose.body is not None:
            try:
                (tree.links[name].inertia or Inertia(0.0)).check(name)
            except ModelError:
                odd.append(name)
    return odd


def _warn(tree: UrdfTree, places: Mapping[str, _Place], links: tuple[Link, ...], repaired: Collection[str]) -> None:
    """Warn about harmless extras, missing masses, and impossible moments of parts of bodies that are not repaired."""
    if tree.findings.extras:
        warnings.warn(f"{tree.path}: harmless extras are ignored: {first_few(tree.findings.extras)}", stacklevel=3)
    loaded: set[str | None] = set()
    for link in reversed(links):
        if link.name in loaded or link.inertia.mass > 0.0 or link.inertia.tensor.any():
            loaded |= {link.name, link.parent}
    empty = [link.joint for link in links if link.name not in loaded and (link.parent in loaded or not link.parent)]
    if empty:
        warnings.warn(f"{tree.path}: no link beyond these joints has a mass ({', '.join(empty)})", stacklevel=3)
    moving = [tree.links[name] for name, pose in places.items() if pose.body is not None]
    bare = [link.name for link in moving if link.inertia is None and link.shaped]
    if bare:
        warnings.warn(
            f"{tree.path}: links with a shape but without <inertial> have no mass ({', '.join(bare)})", stacklevel=3
        )
    if odd := [name for name in _odd(tree, places) if places[name].body not in repaired]:
        warnings.warn(
            f"{tree.path}: impossible moments of inertia were accepted, because the sums with the links fixed to these "
            f"links are possible ({', '.join(odd)})",
            stacklevel=3,
        )
