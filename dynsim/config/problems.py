"""Conversion of pydantic's validation errors to one-line messages with file, line, key, value and fix.

Scenarios and servo maps share this module, so their errors have the same form.
"""

from __future__ import annotations

import difflib
import itertools
import re
import types
import typing
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError

from dynsim.errors import ModelError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

# Limits for one message: number of unknown keys, number of other problems, length of a value or key [characters].
UNKNOWN_SHOWN = 20
OTHERS_SHOWN = 4
SHOWN_LIMIT = 80
# Keys whose value selects the configuration class for a mapping.
TAGS = ("type", "kind")
# Pattern for a list index in a dotted key.
INDEX = re.compile("[0-9]{1,9}")


@contextmanager
def errors_at(*keys: int | str) -> Iterator[None]:
    """Convert ModelErrors of the block to errors about a key of the scenario."""
    try:
        yield
    except ModelError as error:
        raise ModelError(f"{dotted(keys)}: {error}", keys=keys) from error


class OptionKey(str):
    """Dotted key that an option of a command overrides; errors refer to it with this option."""

    def __new__(cls, key: str, option: str = "--set") -> OptionKey:
        self = super().__new__(cls, key)
        self.option = option
        return self

    option: str


@dataclass(frozen=True)
class Origin:
    """Origin of the values of a scenario or servo map, from which messages determine the line of a key.

    Attributes
    ----------
    file : Path or str
        The file, or a name for another source.
    mappings : tuple
        Mappings that were read from the file and merged: first the changes of the variant, then the rest of the file.
    overrides : tuple of str
        Dotted keys that were overridden.
    """

    file: Path | str
    mappings: tuple[Any, ...] = ()
    overrides: tuple[str, ...] = ()

    def overriding(self, keys: Sequence[int | str]) -> str:
        """Return how the value at ``keys``, a value inside it, or a mapping that contains it was overridden, or "".

        How: the name of a command-line option, or "overrides".
        """
        own = ".".join(map(str, keys))
        matching = (k for k in self.overrides if own == k or own.startswith(k + ".") or k.startswith(own + "."))
        return next(map(overriding, matching), "")

    def line(self, keys: Sequence[int | str]) -> int:
        """Return the line of the deepest of the nested ``keys`` found in the file; 0 if not even the first is found."""
        # Use the mapping that matches the most keys; on a tie, the first one, because the variant overrides the rest.
        lines = [_line(mapping, keys) for mapping in self.mappings]
        return max(lines, key=lambda depth_and_line: depth_and_line[0], default=(0, 0))[1]

    def location(self, keys: Sequence[int | str]) -> str:
        """Return ``file:line`` of a key; if the key was overridden, return how, see :attr:`overriding`."""
        if how := self.overriding(keys):
            return how
        return f"{self.file}:{line}" if (line := self.line(keys)) else str(self.file)


def overriding(key: str) -> str:
    """Return how a key is overridden: the name of a command-line option, or "overrides"."""
    return key.option if isinstance(key, OptionKey) else "overrides"


def unknown_keys(
    error: ValidationError, data: Any, origin: Origin, schema: type[BaseModel], also: Sequence[str] = ()
) -> list[str]:
    """Return one message for each unknown key: location, key, and a similar known key.

    Parameters
    ----------
    error : ValidationError
        Validation error raised by pydantic.
    data : Any
        Data that were validated.
    origin : Origin
        Origin of the data.
    schema : type of BaseModel
        Schema that the data violate.
    also : sequence of str
        Further keys that are allowed at the top level.
    """
    texts: list[str] = []
    for problem in error.errors(include_url=False, include_input=False):
        if problem["type"] != "extra_forbidden" or len(texts) > UNKNOWN_SHOWN:
            continue
        keys, _, _ = _locate(data, problem["loc"])
        known = _fields(schema, problem["loc"][:-1]) + (list(also) if len(keys) == 1 else [])
        suggestion = suggest(str(keys[-1]), known)
        if not suggestion and known:
            suggestion = f"; known keys: {', '.join(known)}"
        texts.append(f"{origin.location(keys)}: {dotted(keys)}: unknown key{suggestion}")
    return texts


def explain(error: ValidationError, data: Any, origin: Origin, unknown: Sequence[str]) -> str:
    """Return one line that states the location, key, value and fix of each problem, starting with the unknown keys."""
    texts = list(dict.fromkeys(unknown))
    shown = texts[:UNKNOWN_SHOWN] + (["and more"] if len(texts) > UNKNOWN_SHOWN else [])
    problems = error.errors(include_url=False, include_input=False)
    others: dict[str, str] = {}
    # pydantic reports one problem for each missing entry of a list of fixed length.
    siblings = Counter((problem["type"], problem["loc"][:-1]) for problem in problems)
    for problem in problems:
        if problem["type"] == "extra_forbidden":
            continue
        keys, value, text = _problem(problem, data, siblings[problem["type"], problem["loc"][:-1]])
        key = dotted(keys)
        # A misspelt key causes a second problem, because the correct key is missing; do not report it.
        misspelt = problem["type"] == "missing" and any(f"did you mean {str(keys[-1])!r}?" in other for other in texts)
        if not misspelt:
            # pydantic reports one problem for each type in a union; show only the first.
            others.setdefault(key, f"{origin.location(keys)}: {key and f'{key}{value}: '}{text}")
    shown += itertools.islice(others.values(), OTHERS_SHOWN)
    if (more := len(others) - OTHERS_SHOWN) > 0:
        shown.append(f"and {more} more problem{'s' if more > 1 else ''}")
    return "; ".join(shown)


def _problem(problem: ErrorDetails, data: Any, siblings: int) -> tuple[list[int | str], str, str]:
    """Return the keys of an invalid value, the text " = value" (empty for a mapping or list), and the problem.

    ``siblings`` is the number of problems of the same type in the same list.
    """
    context, kind, message = problem.get("ctx", {}), problem["type"], problem["msg"].removeprefix("Value error, ")
    loc = (*problem["loc"], *context.get("key", "").split("."))
    keys, value, exists = _locate(data, tuple(part for part in loc if part != ""))
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return _wrong_tag(keys, value, context)
    if kind == "missing" and isinstance(problem["loc"][-1], int) and isinstance(value, list):
        text = f"has {len(value)} entries; it must have {len(value) + siblings}"
    elif kind == "missing":
        text = "is missing; add it"
    elif kind in ("model_type", "dict_type", "model_attributes_type"):
        text = "must be a mapping of keys to values"
    elif kind in ("too_short", "too_long"):
        most = "at least" if kind == "too_short" else "at most"
        needed = context["min_length" if kind == "too_short" else "max_length"]
        text = f"has {context['actual_length']} entries; it must have {most} {needed}"
    elif kind == "list_type":
        text = "must be a list, such as [a, b]"
    elif kind == "literal_error":
        choices = re.findall("'([^']*)'", context["expected"])
        text = f"must be {context['expected']}{suggest(value, choices) if isinstance(value, str) else ''}"
    elif message.startswith("Input should be "):
        text = "must be " + message.removeprefix("Input should be ")
    else:
        text = " ".join((message[0].lower() + message[1:]).splitlines())
    shown_value = f" = {value_text(value)}" if exists and not isinstance(value, (Mapping, list)) else ""
    return keys, shown_value, text


def _wrong_tag(keys: list[int | str], value: Any, context: Mapping[str, Any]) -> tuple[list[int | str], str, str]:
    """Return the keys, value and problem if the ``type`` (or ``kind``) of a mapping is unknown, misspelt or missing."""
    tag = context["discriminator"].strip("'")
    known = context.get("expected_tags", "").replace("'", "")
    entries = value if isinstance(value, Mapping) else {}
    if named := entries.get(tag):
        text = f"unknown {tag} {value_text(named)}{suggest(str(named), known.split(', '))}; choices: {known}"
        return [*keys, tag], "", text
    near = difflib.get_close_matches(tag, [key for key in entries if isinstance(key, str)], n=1)
    if near:
        return [*keys, near[0]], "", f"unknown key; did you mean {tag!r}?"
    return [*keys, tag], "", "is missing; add it" + (f" (choices: {known})" if known else "")


def key_text(key: object) -> str:
    """Return a key as text for a message: on one line and of limited length."""
    text = str(key)
    text = text if len(text) <= SHOWN_LIMIT else text[:SHOWN_LIMIT] + "…"
    return text if text.isprintable() else repr(text)[1:-1]


def dotted(keys: Sequence[int | str]) -> str:
    return ".".join(key_text(key) if key != "" else "''" for key in keys)


def value_text(value: object) -> str:
    """Return a value as text for a message: on one line and of limited length."""
    if isinstance(value, str):
        # Keep both ends of a long text: a path ends with the name of the file.
        half = SHOWN_LIMIT // 2
        return repr(value if len(value) <= SHOWN_LIMIT else f"{value[:half]}…{value[-half:]}")
    text = repr(value)
    return text if len(text) <= SHOWN_LIMIT else text[:SHOWN_LIMIT] + "…"


def suggest(word: str, known: Any) -> str:
    if len(word) > SHOWN_LIMIT:
        return ""  # the comparison time grows with the square of the length
    near = difflib.get_close_matches(word, [str(k) for k in itertools.islice(known, 1000)], n=1, cutoff=0.6)
    return f"; did you mean {near[0]!r}?" if near else ""


def _locate(data: Any, loc: tuple[int | str, ...]) -> tuple[list[int | str], Any, bool]:
    """Return the keys of a pydantic location without its union tags, the value at this location, and if it exists."""
    keys: list[int | str] = []
    node, exists = data, True
    for part in loc:
        if isinstance(node, list) and isinstance(part, str) and INDEX.fullmatch(part):
            part = int(part)  # a list index in a dotted key
        in_mapping = isinstance(node, Mapping) and part in node
        in_list = isinstance(node, list) and isinstance(part, int) and part < len(node)
        if exists and (in_mapping or in_list):
            node = node[part]
        elif part == "" or (isinstance(node, Mapping) and part in (node.get(tag) for tag in TAGS)):
            continue
        elif exists and isinstance(node, (int, float, str, list)):
            # Skip parts that name a branch of a union of plain types, such as "float" or "list[float]".
            continue
        else:
            exists = False
        keys.append(part)
    return keys, node, exists


def _line(mapping: Any, keys: Sequence[int | str]) -> tuple[int, int]:
    """Return how many of the nested ``keys`` a YAML mapping contains, and the line of the last one; (0, 0) if none."""
    depth = line = 0
    node = mapping
    for key in keys:
        lines = getattr(node, "lines", {})
        if key not in lines:
            break
        depth, line = depth + 1, lines[key]
        node = node[key]
    return depth, line


def _fields(schema: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that a schema allows at a pydantic location."""
    classes = [schema]
    for part in loc:
        fields = [c.model_fields[part] for c in classes if isinstance(part, str) and part in c.model_fields]
        if fields:
            classes = [c for field in fields for kind in (field.annotation, *field.metadata) for c in _models(kind)]
        else:
            tagged = [c for c in classes if part in _literals(c)]
            classes = tagged or classes
    return [name for c in classes for name in c.model_fields]


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return the configuration classes in an annotation; for ``families.MemberField``, ``models`` returns them."""
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return [annotation] if issubclass(annotation, BaseModel) else []
    if callable(choices := getattr(annotation, "models", None)):
        return list(choices())
    return [model for argument in typing.get_args(annotation) for model in _models(argument)]


def _literals(model: type[BaseModel]) -> tuple[Any, ...]:
    tags = [model.model_fields[tag].annotation for tag in TAGS if tag in model.model_fields]
    return tuple(itertools.chain.from_iterable(map(typing.get_args, tags)))


def listed(names: Sequence[str]) -> str:
    """Join up to four names with commas; for more names, return only the first, the last and their number."""
    return ", ".join(names) if len(names) <= 4 else f"{names[0]} … {names[-1]} ({len(names)})"
