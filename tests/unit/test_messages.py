"""Checks of messages by form and names: what they refuse, and that no phrase of the table has been reworded away."""

from __future__ import annotations

import ast
from importlib.resources import files
from pathlib import Path

import pytest
from support.messages import PHRASES, check_message, lines_with, mentions, raises

PACKAGE = Path(str(files("dynsim")))


def wordings() -> str:
    """Every string of the package's modules, and its pages: with the parts of f-strings between their values."""
    strings = [path.read_text(encoding="utf-8") for kind in ("*.js", "*.html") for path in PACKAGE.rglob(kind)]
    for path in PACKAGE.rglob("*.py"):
        constants = (node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.Constant))
        strings += [node.value for node in constants if isinstance(node.value, str)]
    return "\n".join(strings)


def test_every_phrase_is_of_a_message_of_the_package() -> None:
    """Otherwise a test that a message is absent would pass whatever is said."""
    text = wordings()
    # Built from two parts: by the page of a drive, and from a key of the summary.
    parts = {"hold stick": "a stick", "energy row": "electrical_energy_J"}
    assert [key for key, phrase in PHRASES.items() if parts.get(key, phrase) not in text] == []


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("error", []),  # no words
        ("the limit of joint_1 is wrong", ["joint_10"]),
        ("the limit of joint_10 is wrong", ["joint_1"]),
        ("a mass of 10 kg is wrong", ["0 kg"]),
        ("a mass of 1.5 kg is wrong", ["5 kg"]),
        ("two problems stand here\nin lines that are not indented", []),
        ("one problem stands here\n\n  with a blank line", []),
        ("Traceback (most recent call last)", []),
        ("an object at 0x7f12ab34cd90 is wrong", []),
    ],
)
def test_a_message_of_another_form_or_without_a_name_is_refused(text: str, names: list[str]) -> None:
    with pytest.raises(AssertionError):
        check_message(text, *names)


def test_names_are_words_of_their_own() -> None:
    assert mentions("case.yaml:2: plant.mass_kg = -1: too small", "case.yaml:2", "plant.mass_kg = -1", "-1")
    assert lines_with(["joint_1 never moves", "joint_2 moves"], "joint_1", phrase="never")
    assert not lines_with(["joint_1 moves", "joint_2 never moves"], "joint_1", phrase="never")


def test_the_type_of_the_error_counts() -> None:
    with pytest.raises(ValueError), raises(KeyError, "x"):  # noqa: PT011
        raise ValueError("x is wrong")
