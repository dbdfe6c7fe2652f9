"""XML of a URDF file: elements with line numbers, and attributes read as numbers; unknown ones are reported.

Entities and DTDs are refused unread, and size, depth and number of elements are limited, so that reading always ends.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol
from xml.parsers import expat

import numpy as np

from dynsim.errors import ModelError
from dynsim.model.description import Array
from dynsim.system.inputs import read_bytes

# The largest robots in use have some 100 links and 1 MB of text.
BYTES_MAX, ELEMENTS_MAX, DEPTH_MAX = 16_000_000, 100_000, 100
ATTRIBUTES_MAX, NAME_LENGTH_MAX, _NUMBER_LENGTH_MAX = 100, 200, 400
# Largest magnitude of a number: no robot needs larger ones, and their products could overflow.
_MAGNITUDE_MAX = 1e15

# Elements of physics; their values are attributes, so text in them is an error.
_WITHOUT_TEXT = {"mass", "inertia", "origin", "axis", "limit", "dynamics", "mimic"}

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
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
    """A tag with its attributes, the line it begins in, and what it holds."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)

    def child(self, tag: str) -> Element | None:
        """The first child of that kind."""
        return next((child for child in self.children if child.tag == tag), None)


class Placed(Protocol):
    """Something of the file with a line."""

    @property
    def line(self) -> int: ...


class UrdfFile:
    """One file, read by elements; all errors name it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def error(self, line: int, text: str) -> ModelError:
        """An error about a line of the file."""
        return ModelError(f"{self.path}:{line}: {text}")

    def root(self) -> Element:
        """The outermost element, with all that it holds.

        Raises
        ------
        ModelError
            The file cannot be read, is no XML, or passes a limit.
        """
        return self._parse(self._read())

    def _read(self) -> bytes:
        data = read_bytes(self.path, ModelError, BYTES_MAX)
        if not data.strip():
            raise ModelError(f"{self.path}: is empty; a URDF file has <robot> with links and joints")
        return data

    def _parse(self, data: bytes) -> Element:
        """The elements of XML text in any encoding that expat knows; with their lines."""
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
            # Without attributes it is refused for what it lacks.
            if content.strip() and element.tag in _WITHOUT_TEXT and element.attributes:
                tag = element.tag
                raise self.error(
                    parser.CurrentLineNumber,
                    f"<{tag}> holds the text {quoted(content.strip())}; URDF has values in attributes only",
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
    def _expand(self) -> str:
        return (
            f"this is a xacro file; run `xacro {self.path} > {self.path.name.split('.')[0]}_expanded.urdf` (of ROS) "
            "and give that file"
        )

    def name(self, element: Element, others: Mapping[str, Placed]) -> str:
        """The name of a link or joint: there, printable, and the only one of its kind."""
        name = element.attributes.get("name", "")
        if not name:
            raise self.error(element.line, f"<{element.tag}> has no name; give it one")
        self._check_expanded(element, "name", f"<{element.tag}>")
        if not name.isprintable():
            raise self.error(
                element.line, f"{element.tag} {quoted(name)}: the name has control characters; remove them"
            )
        if len(name) > NAME_LENGTH_MAX:
            raise self.error(element.line, f"{element.tag} {quoted(name)}: a name has at most {NAME_LENGTH_MAX} signs")
        if name in others:
            raise self.error(
                element.line,
                f"{element.tag} {quoted(name)} is there twice (also in line {others[name].line}); rename one of them",
            )
        return name

    def check_children(self, element: Element, who: str) -> None:
        """Refuse what is there twice, belongs elsewhere or looks misspelt: other readers pass over it in silence."""
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
        """The child of that kind; without it ``fix`` says what to do."""
        child = element.child(tag)
        if child is None:
            where = f"{who}: <{element.tag}>" if element.tag == "inertial" else who
            raise self.error(element.line, f"{where} has no <{tag}>; {fix}")
        return child

    def text(self, element: Element, key: str, who: str) -> str:
        """An attribute that must be there and not empty."""
        if not element.attributes.get(key):
            raise self.error(element.line, f"{who}: <{element.tag}> has no {key}; add it")
        self._check_expanded(element, key, who)
        return element.attributes[key]

    def number(self, element: Element, key: str, who: str, default: float | None = None) -> float:
        """The one number of an attribute."""
        return float(self.numbers(element, key, 1, who, None if default is None else (default,))[0])

    def numbers(
        self, element: Element, key: str, count: int, who: str, default: tuple[float, ...] | None = None
    ) -> Array:
        """The numbers of an attribute: plain ASCII decimals, as many as there must be, finite."""
        text = element.attributes.get(key)
        if text is None:
            if default is not None:
                return np.array(default)
            raise self.error(element.line, f"{who}: <{element.tag}> has no {key}; add it, like {key}={_EXAMPLE[count]}")
        self._check_expanded(element, key, who)
        words = _words(text)
        stated = f"{who}: <{element.tag} {key}={quoted(text)}>"
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

    def _check_expanded(self, element: Element, key: str, who: str) -> None:
        if "${" in element.attributes[key] or "$(" in element.attributes[key]:
            raise self.error(
                element.line, f"{who}: <{element.tag} {key}={quoted(element.attributes[key])}>: {self._expand}"
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


def _words(text: str) -> list[str]:
    """What stands between white space, of XML's kinds only."""
    return [word for word in re.split(r"[ \t\r\n]+", text) if word]


def quoted(text: str) -> str:
    """A text of the file, quoted and cut to what fits in a message."""
    return repr(cut(text))


def cut(text: str) -> str:
    """A text of the file, no longer than fits in a message."""
    return text if len(text) <= 60 else text[:57] + "..."
