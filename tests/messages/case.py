"""Inputs as data: a case is one input, and a table makes cases from short rows."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

# Old text in a row of `Edits` whose new text is the whole file.
ALL = ""
# A key of a YAML text or of a mapping in Python.
KEY = re.compile(r"([A-Za-z_][\w.]*)['\"]?\s*:(?!//)")

Content = str | bytes
# Content by file name; a function makes a file that takes work, such as a record.
Files = Mapping[str, Content | Callable[[], bytes]]


@dataclass(frozen=True)
class Case:
    """An input.

    Attributes
    ----------
    name : str
        Plain words; unique in its area.
    shown : tuple of str
        The input, as the golden file shows it.
    files : Files
        Written to the working folder beforehand.
    action : str
        Python, or a command line that begins with ``dynsim``.
    sources, keys : tuple of str
        A message must contain one of the sources, and one of the keys; empty if it needs none.
    measured : bool
        Its decimal numbers come from a simulation, and are shown without their digits, which depend on the machine.
    """

    name: str
    shown: tuple[str, ...]
    files: Files
    action: str
    sources: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    measured: bool = False


@dataclass(frozen=True)
class Edits:
    """Files with a change: rows of (name, old, new, old, new, …), or (name, text to append to the first file).

    If old is ``ALL``, new replaces the whole first file. The message must name the changed file, and a key if the file
    is YAML, unless ``keyed`` is false.
    """

    action: str
    files: Files
    rows: Sequence[tuple[Content, ...]]
    keyed: bool = True
    measured: bool = False

    @property
    def heading(self) -> str:
        return f"{', '.join(self.files)}: {self.action}"

    def cases(self) -> Iterator[Case]:
        for name, *change in self.rows:
            changed = dict(self.files)
            first = next(iter(changed))
            if len(change) == 1:
                pairs = [("", f"{changed[first]}{change[0]!s}", f"+ {shown(change[0])}")]
            else:
                olds, news = change[::2], change[1::2]
                pairs = [
                    (old, new, f"{shown(old)} → {shown(new)}" if old != ALL else f"= {shown(new)}")
                    for old, new in zip(olds, news, strict=True)
                ]
            edited = [_edit(changed, str(old), new) for old, new, _ in pairs]
            parts = [part for part in change if isinstance(part, str)]
            yaml = self.keyed and all(file.endswith(".yaml") for file in edited)
            keys = {key.rpartition(".")[2] for part in parts for key in KEY.findall(part)} if yaml else ()
            texts = tuple(text for *_, text in pairs)
            sources = tuple(dict.fromkeys(edited))
            yield Case(str(name), texts, changed, self.action, sources, tuple(keys), self.measured)


def _edit(files: dict[str, Any], old: str, new: Content) -> str:
    """Replace a text in the first file that has it, or the whole first file; return the file's name."""
    if old == ALL:
        name = next(iter(files))
        files[name] = new
        return name
    for name, text in files.items():
        if isinstance(text, str) and old in text:
            files[name] = text.replace(old, str(new), 1)
            return name
    raise ValueError(f"no file has the text {old!r}")


@dataclass(frozen=True)
class Overrides:
    """Overrides of a shipped scenario: rows of (name, values by key) or (name, values by key, variant).

    The scenario is checked, or simulated if ``run`` is true. The error of a check must name a key, and the file or the
    overrides.
    """

    scenario: str
    rows: Sequence[tuple[Any, ...]]
    run: bool = False
    always: Mapping[str, Any] = field(default_factory=dict)

    @property
    def heading(self) -> str:
        always = f" with {dict(self.always)}" if self.always else ""
        return f"{self.scenario}{always}: {'dynsim.simulate' if self.run else 'dynsim.check'}"

    def cases(self) -> Iterator[Case]:
        for name, values, *variant in self.rows:
            both = {**self.always, **values}
            arguments = [repr(self.scenario), *map(repr, variant)]
            loading = f"dynsim.load_scenario({', '.join(arguments)}, overrides={both!r})"
            text = f"{values}" + (f", variant {variant[0]}" if variant else "")
            keys = {key for key in re.split(r"[.\s{}\[\]'\",:=]+", str(values)) if re.fullmatch(r"[A-Za-z_]\w+", key)}
            yield Case(
                name,
                (text,),
                {},
                f"dynsim.{'simulate' if self.run else 'check'}({loading})",
                () if self.run else ("overrides", f"{self.scenario}.yaml"),
                () if self.run else tuple(keys),
                measured=self.run,
            )


@dataclass(frozen=True)
class Settings:
    """Settings with ``--set`` of a shipped scenario: rows of (name, setting)."""

    scenario: str
    rows: Sequence[tuple[str, str]]

    @property
    def heading(self) -> str:
        return f"{self.scenario}: dynsim.load_scenario, with --set of the command line"

    def cases(self) -> Iterator[Case]:
        for name, setting in self.rows:
            loading = f"dynsim.load_scenario({self.scenario!r}, overrides=set_options({setting!r}))"
            yield Case(name, (f"--set {shown(setting)}",), {}, loading, ("--set",))


@dataclass(frozen=True)
class Calls:
    """Python: rows of (name, statements), which may use the names of :mod:`messages.objects`."""

    rows: Sequence[tuple[str, str]]
    files: Files = field(default_factory=dict)
    heading: str = "Python"
    measured: bool = False

    def cases(self) -> Iterator[Case]:
        for name, action in self.rows:
            yield Case(name, (shown(action),), self.files, action, measured=self.measured)


@dataclass(frozen=True)
class Commands:
    """Command lines: rows of (name, arguments of ``dynsim``).

    If arguments are files of the table, the message must name one of them, unless ``named`` is false.
    """

    rows: Sequence[tuple[str, str]]
    files: Files = field(default_factory=dict)
    named: bool = True

    @property
    def heading(self) -> str:
        return "command lines" + (f" with {', '.join(self.files)}" if self.files else "")

    def cases(self) -> Iterator[Case]:
        for name, arguments in self.rows:
            words = re.split(r"[\s/=]", arguments)
            used = tuple(dict.fromkeys(top for file in self.files if (top := file.partition("/")[0]) in words))
            yield Case(
                name, (f"dynsim {shown(arguments)}",), self.files, f"dynsim {arguments}", used if self.named else ()
            )


Table = Edits | Overrides | Settings | Calls | Commands


def shown(content: Content, most: int = 240) -> str:
    """Return a text on one line: shortened, with marks for line ends and unprintable characters."""
    text = content if isinstance(content, str) else repr(content)
    text = text if len(text) <= most else f"{text[:most]}… ({len(text)} characters)"
    text = text.strip("\n").replace("\n", " ⏎ ") if text.strip() else repr(text)
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)
