"""Checks of messages by their form and by the names in them: a test does not depend on how a message is worded."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

Name = str | re.Pattern[str]

# The only wordings that tests know: where several messages with the same names are possible, these tell which one it
# is. A reworded message changes one line here.
PHRASES = {
    # Warnings and errors.
    "all silent": "is the supply or the line lost?",
    "busy": "the operating system delayed this program",
    "incomplete": "incomplete",
    "interrupted": "interrupted at t",
    "late answers": "earlier requests",
    "no browser": "No browser",
    "no forces": "the motion needs forces",
    "no plan": "no plan: ",
    "no posture": "could be projected onto the hand path",
    "output failed": " failed: ",
    "pulls": "pulls on this brace",
    "reference": "its reference",
    "saved part": "up to the stop",
    "sent": "was sent",
    "sweep table": "lists the reasons",
    "takes": "seconds to two minutes",
    "unconfirmed": "NOT confirmed",
    "simulation gone": "the process of the simulation has ended",
    # Ends and states of a drive.
    "by pilot": "ended by the pilot",
    "hold stick": "a stick",
    "last browser": "the last browser was closed",
    "pilot silent": "the pilot is silent",
    "release key": "release the key, then hold it again",
    # Warnings of a run.
    "base lifted": "the base is lifted",
    "behind brakes": "only braked joints move this point",
    "friction gains": "friction has added",
    "held down": "held down",
    "immobile": "no joint moves this point",
    "jolt": "a jolt at the start",
    "ledger": "the energy ledger does not close",
    "least norm": "least-norm split",
    "motion open": "leave the motion undetermined",
    "moves otherwise": "other solutions may move differently",
    "never": "never",
    "not unique": "the motion is not unique",
    "pulls in a step": "would lift off and land again",
    "shared": "the motion does not determine",
    "sinks": "only contact points interact with surfaces",
    "start jumps": "still jumps at the start",
    "steps gain": "the steps themselves add",
    "stuck": "does not end",
    "tips over": "tips over",
    # Warnings of drives and of snakes.
    "diverges": "its prediction diverges",
    "out of reach": "out of reach",
    "overload": "of the run exceeds the nominal",
    "slowed down": "slowed down",
    "target waited": "the target waited for",
    "too fast": "too fast for the joints",
    "unstable": "sampled loop is unstable",
    "would stop": "would stop there",
    # Rows of tables.
    "energy row": "electrical energy [J]",
    "impact row": "impact loss",
    "ledger row": "ledger residual",
    # Legends and titles of figures.
    "gear friction": "friction",
    "impacts": "impacts",
    "no poses": "some joints were not recorded",
    "no scene": "has no scene",
    "other bodies": "the bodies of scene and record differ",
    "outside": "outside the triangle",
    "pulling": "surface pulls",
    "slides": "slides",
    # Signs of a page.
    "at voltage limit": "voltage limit",
    "sunk sign": "joint or hand below a surface",
    "wheel sign": "wheel on the ground",
}


def mentions(text: object, *names: Name) -> bool:
    """Whether a text has every name (file, key, joint, value, number) as a whole word, or matches its pattern."""
    return not _missing(str(text), names)


def says(text: object, phrase: str) -> bool:
    """Whether a text is the message that a key of ``PHRASES`` stands for."""
    return PHRASES[phrase] in str(text)


def lines_with(text: str | Iterable[str], *names: Name, phrase: str = "") -> list[str]:
    """Lines of a text, or of several warnings, that have every name and the phrase."""
    rows = text.splitlines() if isinstance(text, str) else text
    return [row for row in rows if mentions(row, *names) and (not phrase or says(row, phrase))]


def check_message(text: object, *names: Name, phrase: str = "") -> None:
    """Assert that a message has words, further problems in indented lines, no traceback, every name, and the phrase."""
    __tracebackhide__ = True
    message = str(text).rstrip()
    assert len(re.findall(r"[^\W\d_]{2,}", message)) > 1, f"no words: {message!r}"
    assert not re.search(r"\n(?!  )|\n\s*(\n|$)", message), f"further lines are not indented, or blank: {message!r}"
    assert not re.search(r"Traceback|\bat 0x[0-9a-f]{6}", message), message
    assert not _missing(message, names), f"without {_missing(message, names)}: {message!r}"
    assert not phrase or says(message, phrase), f"is not {phrase!r}: {message!r}"


@contextmanager
def raises(
    error: type[BaseException] | tuple[type[BaseException], ...], *names: Name, phrase: str = ""
) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """``pytest.raises``, and :func:`check_message` of the message."""
    import pytest  # the processes of the fuzz campaign need the phrases alone

    with pytest.raises(error) as caught:
        yield caught
    check_message(caught.value, *names, phrase=phrase)


@contextmanager
def warns(category: type[Warning], *names: Name, phrase: str = "") -> Iterator[pytest.WarningsRecorder]:
    """``pytest.warns``, with a warning that has every name and the phrase."""
    import pytest

    with pytest.warns(category) as caught:
        yield caught
    rows = [str(warning.message) for warning in caught]
    assert lines_with(rows, *names, phrase=phrase), rows


def _missing(text: str, names: Iterable[Name]) -> list[str]:
    return [
        str(name)
        for name in names
        if not (re.search(_whole(name), text) if isinstance(name, str) else name.search(text))
    ]


def _whole(name: str) -> str:
    """The pattern of a name that is not a part of a longer one, and of a number that is not a part of another."""
    before, after = r"(?<!\w)" if re.match(r"\w", name) else "", r"(?!\w)" if re.search(r"\w$", name) else ""
    if name[:1].isdigit():
        before += r"(?<!\d\.)"
    if name[-1:].isdigit():
        after += r"(?!\.\d)"
    return before + re.escape(name) + after
