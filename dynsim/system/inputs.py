"""Functions that read files chosen by the user, as text or YAML, without blocking; only regular files of limited size.

YAML values are built from the events of the parser. Therefore every error is a dynsim error with a line number, the
expansion of aliases is limited, and a file of some 100 000 numbers loads in a second (with the compiled parser of
ruamel; its Python parser takes ten times as long). Plain values follow the core schema of YAML 1.2: null, booleans,
integers, floats and text; dates are read as text.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from dynsim.errors import DynsimError

# Limits for a YAML file: size [bytes], number of values with aliases expanded, depth of nested mappings and lists.
SIZE_LIMIT = 16_000_000
NODE_LIMIT = 1_000_000
DEPTH_LIMIT = 50
# Maximum number of digits of an integer; the largest float is about 1.8e308.
DIGITS_LIMIT = 308

# Callable that creates an error from its message: an exception class, or a functools.partial of one.
ErrorClass = Callable[[str], DynsimError]

_NULLS = frozenset(("", "~", "null", "Null", "NULL"))
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INTEGER = re.compile(r"[-+]?(?:0b[01]+|0o[0-7]+|0x[0-9a-fA-F]+|[0-9]+)")
_FLOAT = re.compile(
    r"[-+]?(?:(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.inf|\.Inf|\.INF)|\.nan|\.NaN|\.NAN"
)
# Characters that are not allowed in YAML, escaped or not: lone surrogates, and control characters except tab and line
# ends.
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x80-\x84\x86-\x9f\ud800-\udfff\ufffe\uffff]")
_CORE = "tag:yaml.org,2002:"
_TEXT_TAGS = (None, "!", _CORE + "str")
# Parser events that begin a value, and the method that reads it; events that cannot begin a key, with their names.
_VALUES = {"ScalarEvent": "_scalar", "MappingStartEvent": "_mapping", "SequenceStartEvent": "_list", "AliasEvent": ""}
_NO_KEYS = {"MappingStartEvent": "a mapping", "SequenceStartEvent": "a list", "AliasEvent": "an alias"}
# Placeholder for the value of an anchor while this value is still being read.
_INCOMPLETE = object()


def is_file(path: str | os.PathLike[str], error: ErrorClass) -> bool:
    """Return True if the path is a regular file, and False if nothing exists at the path.

    Raises
    ------
    DynsimError
        If the path is a folder, pipe, socket or device (reading one may block or never end) or cannot be looked up; the
        class of the error is ``error``.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    except ValueError as reason:
        raise error(f"{os.fspath(path)!r}: is not a valid file name ({reason})") from reason
    if stat.S_ISREG(mode):
        return True
    kind = "folder" if stat.S_ISDIR(mode) else "pipe" if stat.S_ISFIFO(mode) else "device or socket"
    raise error(f"{path}: is a {kind}; a regular file is needed")


def check_file(path: str | os.PathLike[str], error: ErrorClass) -> None:
    """Raise ``error`` if the file does not exist or is not a regular file, see :func:`is_file`."""
    if not is_file(path, error):
        raise error(f"{path}: no such file")


def read_bytes(path: Path, error: ErrorClass, limit: int = SIZE_LIMIT) -> bytes:
    """Return the content of a file of at most ``limit`` bytes.

    Raises
    ------
    DynsimError
        If the path is not a regular file, or the file is too large or cannot be read; the class of the error is
        ``error``.
    """
    check_file(path, error)
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror})") from reason
    if len(content) > limit:
        raise error(f"{path}: is larger than {limit / 1e6:g} MB, the size limit")
    return content


def read_text(path: Path, error: ErrorClass, limit: int = SIZE_LIMIT) -> str:
    """Return the text of a UTF-8 file of at most ``limit`` bytes, without a byte order mark.

    Raises
    ------
    DynsimError
        If the path is not a regular file, or the file is too large, cannot be read or is not UTF-8; the class of the
        error is ``error``.
    """
    content = read_bytes(path, error, limit)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        line = content[: reason.start].count(b"\n") + 1
        wrong = f"byte 0x{content[reason.start]:02x} is not UTF-8"
        raise error(f"{path}:{line}: {wrong}; save it as UTF-8") from reason


class _Located:
    """Mapping or list of a YAML text; ``lines`` has the line of every key or entry."""

    def __init__(self, lines: dict[Any, int] | None = None) -> None:
        super().__init__()
        self.lines: dict[Any, int] = {} if lines is None else lines


class YamlMapping(_Located, dict[str, Any]):
    """Mapping of a YAML text."""


class YamlList(_Located, list[Any]):
    """List of a YAML text."""


def parse_yaml(text: str, error: ErrorClass, source: str, *, line_numbers: bool = True) -> Any:
    """Parse a YAML text that contains one document; return a YamlMapping, a YamlList, a plain value, or None if empty.

    Keys are kept as they are written: ``1`` and ``"1"`` are the same key. An alias is replaced by a copy of its anchor,
    and ``<<`` merges mappings.

    Parameters
    ----------
    text : str
        Text to parse.
    error : ErrorClass
        Class of the errors to raise.
    source : str
        Origin of the text, to be shown in messages.
    line_numbers : bool, optional
        Whether messages include line numbers (not useful for a text of one line).

    Raises
    ------
    DynsimError
        If there is any error in the text; the class of the error is ``error``, and its message states source and line.
    """
    return _Reader(text, error, source, line_numbers).document()


class _Reader:
    """Reader that builds the values of a YAML document from the events of the parser."""

    def __init__(self, text: str, error: ErrorClass, source: str, line_numbers: bool) -> None:
        self._error, self._source, self._line_numbers = error, source, line_numbers
        self._text, self._events = text, self._parsed(text)
        self._anchors: dict[str, Any] = {}
        self._nodes = 0

    def document(self) -> Any:
        if character := _FORBIDDEN.search(self._text):
            line = self._text.count("\n", 0, character.start()) + 1
            self._fail(line, f"not YAML: character U+{ord(character[0]):04X} is not allowed")
        root, documents = None, 0
        for event in self._events:
            kind = type(event).__name__
            if kind in _VALUES:
                root = self._value(event, 0)
            documents += kind == "DocumentStartEvent"
            if documents > 1:
                self._fail(_line(event), "a second document begins; only one is allowed")
        return root

    def _parsed(self, text: str) -> Iterator[Any]:
        from ruamel.yaml import YAML

        try:
            yield from YAML(typ="safe").parse(text)
        except Exception as reason:
            # The parser may raise any exception on arbitrary text; the cause is always an error in the text.
            mark = getattr(reason, "problem_mark", None) or getattr(reason, "context_mark", None)
            problem = getattr(reason, "problem", None) or getattr(reason, "context", None) or str(reason)
            hint = " ".join(problem.split())
            lines = text.split("\n")
            if mark is not None and mark.line < len(lines) and lines[mark.line][mark.column :].startswith("\t"):
                hint = "tab character; indent with spaces"
            self._fail(mark.line + 1 if mark else None, f"not YAML: {hint}")

    def _fail(self, line: int | None, problem: str) -> NoReturn:
        location = f"{self._source}:{line}" if line and self._line_numbers else self._source
        raise self._error(f"{location}: {problem}")

    def _value(self, event: Any, depth: int) -> Any:
        """Return the value that begins with an event, inside ``depth`` nested mappings and lists."""
        kind, line, anchor = type(event).__name__, _line(event), event.anchor
        if kind == "AliasEvent":
            if anchor not in self._anchors:
                self._fail(line, f"alias *{anchor}: no anchor &{anchor} before it")
            if self._anchors[anchor] is _INCOMPLETE:
                self._fail(line, f"alias *{anchor} is inside &{anchor} itself, an endless recursion")
            return self._copy(self._anchors[anchor], line, depth)
        if kind != "ScalarEvent":
            self._check_depth(line, depth)
        self._count(line)
        if anchor is not None:
            self._anchors[anchor] = _INCOMPLETE
        value = getattr(self, _VALUES[kind])(event, line, depth)
        if anchor is not None:
            self._anchors[anchor] = value
        return value

    def _scalar(self, event: Any, line: int, depth: int) -> Any:
        text, tag = self._allowed(event), _tag(event)
        if event.implicit[0] and tag is None:
            return self._plain(text, line)
        return text if tag in _TEXT_TAGS else self._tagged(text, str(tag), line)

    def _allowed(self, event: Any) -> str:
        if character := _FORBIDDEN.search(event.value):
            self._fail(_line(event), f"character U+{ord(character[0]):04X} is not allowed")
        return str(event.value)

    def _plain(self, text: str, line: int) -> Any:
        if text in _NULLS:
            return None
        if text in _BOOLEANS:
            return _BOOLEANS[text]
        if _INTEGER.fullmatch(text):
            base = 0 if text.lstrip("+-")[:2] in ("0b", "0o", "0x") else 10
            if len(text) > DIGITS_LIMIT or abs(number := int(text, base)) >= 10**DIGITS_LIMIT:
                self._fail(line, f"a number with {len(text)} digits; the limit is {DIGITS_LIMIT}")
            return number
        if _FLOAT.fullmatch(text):
            return float(text if text[-1] in "0123456789." else text.lower().replace(".", ""))
        return text

    def _tagged(self, text: str, tag: str, line: int) -> Any:
        """Return a scalar whose type is set by a tag in the file, such as ``!!float 1``."""
        kinds: dict[str, Any] = {"null": type(None), "bool": bool, "int": int, "float": float}
        kind = kinds.get(tag.removeprefix(_CORE)) if tag.startswith(_CORE) else None
        if kind is None:
            self._fail_tag(tag, line)
        value = self._plain(text, line)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            self._fail(line, f"{text[:40]!r} is not a valid !!{tag.removeprefix(_CORE)}")
        return value

    def _fail_tag(self, tag: str, line: int) -> NoReturn:
        shown = tag.replace(_CORE, "!!")[:60]
        self._fail(line, f"unknown tag {shown!r}; use plain mappings, lists, numbers and text")

    def _list(self, event: Any, line: int, depth: int) -> YamlList:
        self._check_tag(event, "seq")
        entries = YamlList()
        while (entry := next(self._events)) and type(entry).__name__ in _VALUES:
            entries.lines[len(entries)] = _line(entry)
            entries.append(self._value(entry, depth + 1))
        return entries

    def _mapping(self, event: Any, line: int, depth: int) -> YamlMapping:
        self._check_tag(event, "map")
        own, merged = YamlMapping(), list[YamlMapping]()
        while (key := next(self._events)) and type(key).__name__ in _VALUES:
            name, start = self._key(key, own), next(self._events)
            value = self._value(start, depth + 1)
            if key.implicit[0] and _tag(key) is None and name == "<<":
                mappings = value if isinstance(value, YamlList) else [value]
                if not all(isinstance(mapping, YamlMapping) for mapping in mappings):
                    self._fail(_line(start), "<< requires a mapping, or a list of mappings")
                merged.extend(mappings)
            else:
                own[name], own.lines[name] = value, _line(key)
        # The mapping's own keys take precedence, then the keys that were merged first.
        whole = YamlMapping()
        for mapping in (*reversed(merged), own):
            whole.update(mapping)
            whole.lines.update(mapping.lines)
        return whole

    def _key(self, event: Any, mapping: YamlMapping) -> str:
        if kind := _NO_KEYS.get(type(event).__name__):
            self._fail(_line(event), f"{kind} cannot be a key; a key must be text")
        if (tag := _tag(event)) not in _TEXT_TAGS:
            self._fail_tag(str(tag), _line(event))
        name = self._allowed(event)
        if event.anchor is not None:
            self._anchors[event.anchor] = name
        if name in mapping:
            self._fail(_line(event), f"duplicate key {name!r} (already on line {mapping.lines[name]})")
        return name

    def _copy(self, value: Any, line: int, depth: int) -> Any:
        """Return a copy of an anchor's value for an alias; the copy shares no mapping or list with the original."""
        self._count(line)
        if isinstance(value, YamlMapping | YamlList):
            self._check_depth(line, depth)
        if isinstance(value, YamlMapping):
            mapping = YamlMapping(value.lines)
            mapping.update((key, self._copy(item, line, depth + 1)) for key, item in value.items())
            return mapping
        if isinstance(value, YamlList):
            entries = YamlList(value.lines)
            entries.extend(self._copy(item, line, depth + 1) for item in value)
            return entries
        return value

    def _check_tag(self, event: Any, kind: str) -> None:
        if (tag := _tag(event)) not in (None, "!", _CORE + kind):
            self._fail_tag(str(tag), _line(event))

    def _check_depth(self, line: int, depth: int) -> None:
        if depth >= DEPTH_LIMIT:
            self._fail(line, f"more than {DEPTH_LIMIT} levels of nested mappings and lists")

    def _count(self, line: int) -> None:
        self._nodes += 1
        if self._nodes > NODE_LIMIT:
            self._fail(line, f"more than {NODE_LIMIT:,} values (with aliases expanded)".replace(",", " "))


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


def _tag(event: Any) -> str | None:
    return None if event.tag is None else str(event.tag)
