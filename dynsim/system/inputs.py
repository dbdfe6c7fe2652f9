"""Files that a user names: regular files of bounded size, as text or YAML. Reading them never blocks.

YAML is built from the parser's events: so every error is one of ours with its line, aliases cannot grow without bound,
and a file of some 100 000 numbers loads in a second (ruamel's compiled parser; its Python one takes ten times as long).
Plain values are those of YAML 1.2's core schema: null, booleans, integers, floats and text; a date is text.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from dynsim.errors import DynsimError

# Bounds on a YAML file: bytes, values after aliases are written out, mappings and lists within each other.
SIZE_LIMIT = 16_000_000
NODE_LIMIT = 1_000_000
DEPTH_LIMIT = 50
# Digits of an integer: more than a float can hold are no quantity.
DIGITS_LIMIT = 308

# Makes the error to raise of its message: a class of errors, or one with something filled in.
ErrorClass = Callable[[str], DynsimError]

_NULLS = frozenset(("", "~", "null", "Null", "NULL"))
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INTEGER = re.compile(r"[-+]?(?:0b[01]+|0o[0-7]+|0x[0-9a-fA-F]+|[0-9]+)")
_FLOAT = re.compile(
    r"[-+]?(?:(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.inf|\.Inf|\.INF)|\.nan|\.NaN|\.NAN"
)
# What YAML does not allow in a text, escaped or not: control characters (but tab and line ends) and half characters.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x80-\x84\x86-\x9f\ud800-\udfff\ufffe\uffff]")
_CORE = "tag:yaml.org,2002:"
_TEXT_TAGS = (None, "!", _CORE + "str")
_MERGE = object()


def is_file(path: str | os.PathLike[str], error: ErrorClass) -> bool:
    """True for a regular file, False when there is nothing of that name.

    Raises
    ------
    DynsimError
        Of the class ``error``: a folder, pipe, socket or device (they may block or never end), or a name that cannot
        be looked up.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    except ValueError as reason:
        raise error(f"{os.fspath(path)!r}: cannot be the name of a file ({reason})") from reason
    if stat.S_ISREG(mode):
        return True
    kind = "folder" if stat.S_ISDIR(mode) else "pipe" if stat.S_ISFIFO(mode) else "device or socket"
    raise error(f"{path}: is a {kind}; a regular file is needed")


def check_file(path: str | os.PathLike[str], error: ErrorClass) -> None:
    """As :func:`is_file`, and raise ``error`` when there is no such file."""
    if not is_file(path, error):
        raise error(f"{path}: no such file")


def read_bytes(path: Path, error: ErrorClass, limit: int = SIZE_LIMIT) -> bytes:
    """The content of a file of at most ``limit`` bytes.

    Raises
    ------
    DynsimError
        Of the class ``error``: no regular file, too large or not readable.
    """
    check_file(path, error)
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    if len(content) > limit:
        raise error(f"{path}: is larger than {limit / 1e6:g} MB, more than is read")
    return content


def read_text(path: Path, error: ErrorClass, limit: int = SIZE_LIMIT) -> str:
    """The text of a UTF-8 file of at most ``limit`` bytes, without a byte order mark.

    Raises
    ------
    DynsimError
        Of the class ``error``: no regular file, too large, not readable or not UTF-8.
    """
    content = read_bytes(path, error, limit)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        line = content[: reason.start].count(b"\n") + 1
        wrong = f"byte 0x{content[reason.start]:02x} is not UTF-8"
        raise error(f"{path}:{line}: {wrong}; save it as UTF-8") from reason


class YamlMapping(dict[str, Any]):
    """A mapping of a YAML text; ``lines`` has the line of every key."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: dict[Any, int] = {}


class YamlList(list[Any]):
    """A list of a YAML text; ``lines`` has the line of every entry."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: dict[Any, int] = {}


def parse_yaml(text: str, error: ErrorClass, source: str, *, line_numbers: bool = True) -> Any:
    """The one document of a YAML text as plain values in :class:`YamlMapping` and :class:`YamlList`; None without one.

    Keys are text as written: ``1`` and ``"1"`` are the same key. Aliases are copies, ``<<`` merges.

    Parameters
    ----------
    text, error : the text; the class of errors to raise
    source : what the text is, for messages
    line_numbers : whether messages give lines (not for a text of one line)

    Raises
    ------
    DynsimError
        Of the class ``error``, with source and line, whatever is wrong with the text.
    """
    builder = _Builder(error, source, line_numbers)
    if found := _FORBIDDEN.search(text):
        line = text.count("\n", 0, found.start()) + 1
        builder.fail(line, f"not YAML: character U+{ord(found[0]):04X} is not allowed")
    for event in _events(text, builder):
        builder.take(event)
    return builder.root


def _events(text: str, builder: _Builder) -> Iterator[Any]:
    from ruamel.yaml import YAML

    try:
        yield from YAML(typ="safe").parse(text)
    except (DynsimError, KeyboardInterrupt, GeneratorExit):
        raise
    except Exception as reason:
        # Any text may come: whatever the parser stumbles over, the text is at fault.
        mark = getattr(reason, "problem_mark", None) or getattr(reason, "context_mark", None)
        problem = getattr(reason, "problem", None) or getattr(reason, "context", None) or str(reason)
        builder.fail(mark.line + 1 if mark else None, f"not YAML: {' '.join(problem.split())}")


@dataclass
class _Open:
    """A mapping or list whose end has not come yet."""

    value: YamlMapping | YamlList
    line: int
    anchor: str | None
    nodes_before: int
    key: Any = None
    key_line: int = 0
    merged: list[YamlMapping] = field(default_factory=list)
    height: int = 1


class _Builder:
    """Puts the values of a document together from its events."""

    def __init__(self, error: ErrorClass, source: str, line_numbers: bool) -> None:
        self.root: Any = None
        self._error, self._source, self._line_numbers = error, source, line_numbers
        self._open: list[_Open] = []
        # Anchor → value, its number of nodes and of levels; None until it is complete.
        self._anchors: dict[str, tuple[Any, int, int] | None] = {}
        self._nodes = self._documents = 0

    def fail(self, line: int | None, problem: str) -> NoReturn:
        place = f"{self._source}:{line}" if line and self._line_numbers else self._source
        raise self._error(f"{place}: {problem}")

    def take(self, event: Any) -> None:
        kind = type(event).__name__
        if kind == "ScalarEvent":
            self._scalar(event)
        elif kind in ("MappingStartEvent", "SequenceStartEvent"):
            self._start(event, YamlMapping() if kind == "MappingStartEvent" else YamlList())
        elif kind in ("MappingEndEvent", "SequenceEndEvent"):
            self._end()
        elif kind == "AliasEvent":
            self._alias(event)
        elif kind == "DocumentStartEvent":
            self._documents += 1
            if self._documents > 1:
                self.fail(event.start_mark.line + 1, "a second document begins; there must be one")

    def _scalar(self, event: Any) -> None:
        line, text, tag = event.start_mark.line + 1, event.value, _tag(event)
        plain = event.implicit[0] and tag is None
        if found := _FORBIDDEN.search(text):
            self.fail(line, f"character U+{ord(found[0]):04X} is not allowed")
        top = self._open[-1] if self._open else None
        if isinstance(top, _Open) and isinstance(top.value, YamlMapping) and top.key is None:
            if tag not in _TEXT_TAGS:
                self._fail_tag(str(tag), line)
            if event.anchor is not None:
                self._anchors[event.anchor] = (text, 1, 0)
            top.key, top.key_line = (_MERGE if plain and text == "<<" else text), line
            if top.key in top.value:
                self.fail(line, f"duplicate key {text!r} (first in line {top.value.lines[text]})")
            return
        if plain:
            value = self._plain(text, line)
        elif tag in _TEXT_TAGS:
            value = text
        else:
            value = self._tagged(text, str(tag), line)
        self._count(1, line)
        if event.anchor is not None:
            self._anchors[event.anchor] = (value, 1, 0)
        self._add(value, line)

    def _plain(self, text: str, line: int) -> Any:
        if text in _NULLS:
            return None
        if text in _BOOLEANS:
            return _BOOLEANS[text]
        if _INTEGER.fullmatch(text):
            base = 0 if text.lstrip("+-")[:2] in ("0b", "0o", "0x") else 10
            if len(text) > DIGITS_LIMIT or abs(number := int(text, base)) >= 10**DIGITS_LIMIT:
                self.fail(line, f"a number of {len(text)} digits; no quantity has more than {DIGITS_LIMIT}")
            return number
        if _FLOAT.fullmatch(text):
            return float(text if text[-1] in "0123456789." else text.lower().replace(".", ""))
        return text

    def _tagged(self, text: str, tag: str, line: int) -> Any:
        """A scalar whose type the file gives (``!!float 1``)."""
        kinds: dict[str, Any] = {"null": type(None), "bool": bool, "int": int, "float": float}
        kind = kinds.get(tag.removeprefix(_CORE)) if tag.startswith(_CORE) else None
        if kind is None:
            self._fail_tag(tag, line)
        value = self._plain(text, line)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            self.fail(line, f"{text[:40]!r} is no !!{tag.removeprefix(_CORE)}")
        return value

    def _fail_tag(self, tag: str, line: int) -> NoReturn:
        shown = tag.replace(_CORE, "!!")[:60]
        self.fail(line, f"tag {shown!r} is not known; write plain mappings, lists, numbers and texts")

    def _start(self, event: Any, value: YamlMapping | YamlList) -> None:
        line, tag = event.start_mark.line + 1, _tag(event)
        if tag not in (None, "!", _CORE + ("map" if isinstance(value, YamlMapping) else "seq")):
            self._fail_tag(str(tag), line)
        self._check_no_key(line, "a mapping" if isinstance(value, YamlMapping) else "a list")
        if len(self._open) >= DEPTH_LIMIT:
            self._fail_depth(line)
        self._count(1, line)
        if event.anchor is not None:
            self._anchors[event.anchor] = None
        self._open.append(_Open(value, line, event.anchor, self._nodes - 1))

    def _end(self) -> None:
        ended = self._open.pop()
        value = ended.value
        if ended.merged and isinstance(value, YamlMapping):
            # Its own keys win, then those that were merged first.
            own = YamlMapping()
            own.update(value)
            own.lines = value.lines
            value.clear()
            value.lines = {}
            for mapping in (*reversed(ended.merged), own):
                value.update(mapping)
                value.lines.update(mapping.lines)
        if ended.anchor is not None:
            self._anchors[ended.anchor] = (value, self._nodes - ended.nodes_before, ended.height)
        if self._open:
            self._open[-1].height = max(self._open[-1].height, ended.height + 1)
        self._add(value, ended.line)

    def _alias(self, event: Any) -> None:
        line, name = event.start_mark.line + 1, event.anchor
        self._check_no_key(line, "an alias")
        if name not in self._anchors:
            self.fail(line, f"alias *{name}: there is no anchor &{name} before it")
        anchored = self._anchors[name]
        if anchored is None:
            self.fail(line, f"alias *{name} is within &{name} itself: it would never end")
        value, nodes, height = anchored
        if len(self._open) + height > DEPTH_LIMIT:
            self._fail_depth(line)
        self._count(nodes, line)
        if self._open:
            self._open[-1].height = max(self._open[-1].height, height + 1)
        self._add(_copy(value), line)

    def _check_no_key(self, line: int, what: str) -> None:
        top = self._open[-1] if self._open else None
        if top is not None and isinstance(top.value, YamlMapping) and top.key is None:
            self.fail(line, f"{what} is no key; keys are texts")

    def _fail_depth(self, line: int) -> NoReturn:
        self.fail(line, f"more than {DEPTH_LIMIT} mappings and lists within each other")

    def _count(self, nodes: int, line: int) -> None:
        self._nodes += nodes
        if self._nodes > NODE_LIMIT:
            self.fail(line, f"more than {NODE_LIMIT:,} values (aliases written out)".replace(",", " "))

    def _add(self, value: Any, line: int) -> None:
        if not self._open:
            self.root = value
            return
        top = self._open[-1]
        if isinstance(top.value, YamlList):
            top.value.lines[len(top.value)] = line
            top.value.append(value)
            return
        if top.key is _MERGE:
            mappings = value if isinstance(value, YamlList) else [value]
            if not all(isinstance(mapping, YamlMapping) for mapping in mappings):
                self.fail(line, "<< takes a mapping, or a list of mappings")
            top.merged.extend(mappings)
        else:
            top.value[top.key] = value
            top.value.lines[top.key] = top.key_line
        top.key = None


def _tag(event: Any) -> str | None:
    return None if event.tag is None else str(event.tag)


def _copy(value: Any) -> Any:
    """A copy of a value that shares no mapping or list with it; as deep as ``DEPTH_LIMIT`` allows."""
    if isinstance(value, YamlMapping):
        mapping = YamlMapping()
        mapping.update({key: _copy(item) for key, item in value.items()})
        mapping.lines = value.lines
        return mapping
    if isinstance(value, YamlList):
        entries = YamlList()
        entries.extend(_copy(item) for item in value)
        entries.lines = value.lines
        return entries
    return value
