"""The golden file ``messages.txt``, and the form that every message must have."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from messages import inputs
from messages.case import Case, Table
from messages.produce import FOREIGN, NOTHING, produce

FILE = Path(__file__).with_name("messages.txt")
DEPARTURES = Path(__file__).with_name("departures.txt")
COMMAND = "PYTHONPATH=.:tests python -m messages"
# Longest problem [words].
WORDS = 60
# Traces of a traceback, or of an object without a text.
RAW = re.compile(r'Traceback|File "|<[\w.]+ object at|<function|<class ')
# A key of a file with the key that it is in.
DOTTED = re.compile(r"(?<![\w/.])[a-z][a-z_]*\.[A-Za-z_][\w.]*")
HEAD = f"""\
# Messages of dynsim, written by `{COMMAND}`. Each block is a name, an input, and its messages.
# FOLDER is the working folder, SHIPPED the folder of the shipped scenarios; # is a digit that depends on the machine.
"""
MARK = "=" * 100


@cache
def areas() -> Mapping[str, tuple[Table, ...]]:
    """Return the tables of inputs by area, in the order of the golden file."""
    names = sorted(module.name for module in pkgutil.iter_modules(inputs.__path__))
    modules = [importlib.import_module(f"messages.inputs.{name}") for name in names]
    return {module.AREA: tuple(module.TABLES) for module in sorted(modules, key=lambda module: module.ORDER)}


def cases(area: str) -> list[Case]:
    """Return the cases of an area."""
    return [case for table in areas()[area] for case in table.cases()]


@cache
def messages(area: str) -> tuple[tuple[Case, tuple[str, ...]], ...]:
    """Return every case of an area with its messages."""
    return tuple((case, tuple(produce(case))) for case in cases(area))


def section(area: str) -> str:
    """Return the part of the golden file for an area, with the messages of now."""
    produced = {case.name: said for case, said in messages(area)}
    lines = [MARK, area, MARK, ""]
    for table in areas()[area]:
        lines += [f"[{table.heading}]", ""]
        for case in table.cases():
            said = [line for message in produced[case.name] for line in message.splitlines()]
            lines += [case.name, *(f"    {text}" for text in (*case.shown, *said)), ""]
    return "\n".join(lines)


def recorded() -> dict[str, str]:
    """Return the parts of the golden file by area."""
    if not FILE.exists():
        return {}
    parts = re.split(rf"^{MARK}\n(.*)\n{MARK}\n", FILE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return {
        area: f"{MARK}\n{area}\n{MARK}\n{content.removesuffix(chr(10))}"
        for area, content in zip(parts[::2], parts[1::2], strict=True)
    }


def difference(area: str) -> str:
    """Return the unified diff from the golden file to the messages of now; empty if they agree."""
    before, now = recorded().get(area, ""), section(area)
    lines = difflib.unified_diff(before.splitlines(), now.splitlines(), FILE.name, "produced now", lineterm="", n=4)
    return "\n".join(lines)


def write() -> None:
    """Write the golden file with the messages of now."""
    text = HEAD + "\n" + "\n".join(map(section, areas())) + "\n"
    FILE.write_text(text, encoding="utf-8")


def departures(area: str) -> Iterator[str]:
    """Yield the faults in the form of an area's messages, each with the name of its case."""
    for case, said in messages(area):
        for fault in dict.fromkeys(fault for message in said for fault in faults(message)):
            yield f"{area}: {case.name}: {fault}"
        text = " ".join(message for message in said if not message.startswith("warning: "))
        # A warning belongs to a run, which is named where it is printed.
        if not text:
            continue
        if case.sources and not any(source in text for source in case.sources):
            yield f"{area}: {case.name}: does not name {' or '.join(case.sources)}"
        if case.keys and not _names_key(text, case):
            yield f"{area}: {case.name}: does not name a key of the input"


def _names_key(text: str, case: Case) -> bool:
    """Return whether a text has a key of the input, or any dotted key such as ``contacts.friction``."""
    for source in case.sources:
        text = text.replace(source, "")
    return bool(DOTTED.search(text)) or any(re.search(rf"(?<!\w){re.escape(key)}(?!\w)", text) for key in case.keys)


def faults(message: str) -> Iterator[str]:
    """Yield the faults in the form of a message."""
    _, _, text = message.partition(": ")
    if message == NOTHING or not text.strip():
        yield "no message"
    if message.startswith(FOREIGN):
        yield "an exception that is not dynsim's"
    if RAW.search(message):
        yield "a traceback or an object without a text"
    # A list of problems has an indented line for each.
    if any(not line.startswith("  ") for line in text.splitlines()[1:]):
        yield "several lines"
    for line in text.splitlines():
        if (count := len(line.split())) > WORDS:
            yield f"{count // 10 * 10} words or more"
    if not all(character.isprintable() for character in message.replace("\n", "")):
        yield "characters that cannot be printed"


def allowed() -> list[str]:
    """Return the known departures."""
    lines = DEPARTURES.read_text(encoding="utf-8").splitlines() if DEPARTURES.exists() else []
    return [line for line in lines if line and not line.startswith("#")]


def drop_mended() -> list[str]:
    """Remove departures that have disappeared from the list, and return them."""
    now = {fault for area in areas() for fault in departures(area)}
    mended = [line for line in allowed() if line not in now]
    lines = DEPARTURES.read_text(encoding="utf-8").splitlines()
    DEPARTURES.write_text("".join(f"{line}\n" for line in lines if line not in mended), encoding="utf-8")
    return mended
