"""Every warning and every kind of stop of the engine has a check, or a reason why it cannot be checked."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import dynsim
from combinations.sentences import PARTS, UNVERIFIED
from combinations.verdicts import STOPS, VERIFIERS
from dynsim.engine.stopping import KINDS

PACKAGE = Path(dynsim.__file__).parent
# Modules that make sentences for the warnings of a dynamic run, and the function if it is only one.
SOURCES = {
    "engine/warnings.py": "",
    "engine/soundness.py": "",
    "engine/equilibrium.py": "",
    "engine/overlaps.py": "",
    "engine/target_distance.py": "off_target",
    "scenario/between.py": "idle_entries",
    "scenario/build.py": "left_out_warnings",
}
LEAST_WORDS = 5


def sentences(source: str, function: str = "") -> Iterator[str]:
    """Yield texts with placeholders of a module, or of one function of it, with a number for each placeholder."""
    tree: ast.AST = ast.parse(source)
    if function:
        own = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == function]
        tree = ast.Module(list(own), [])
    within = {id(inner) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr) and sum(id(node) == inner for inner in within) <= 1:
            yield "".join(
                part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else "1"
                for part in node.values
            )


@pytest.mark.parametrize("module", SOURCES)
def test_every_warning_has_a_check_or_a_reason(module: str) -> None:
    known = [*VERIFIERS, *UNVERIFIED, *PARTS]
    source = (PACKAGE / module).read_text("utf-8")
    lacking = [
        text
        for text in sentences(source, SOURCES[module])
        if len(re.findall(r"[a-z]{2,}", text)) >= LEAST_WORDS and not any(re.search(pattern, text) for pattern in known)
    ]
    assert lacking == []


def test_every_stop_has_a_check() -> None:
    assert set(KINDS.values()) == set(STOPS)


def test_a_warning_without_a_check_is_seen() -> None:
    source = 'f"{contact}: this is a new warning, with a number of {number} m"'
    (text,) = sentences(source)
    assert not any(re.search(pattern, text) for pattern in (*VERIFIERS, *UNVERIFIED, *PARTS))
