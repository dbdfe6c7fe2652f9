"""Column names of kernel tables are unique across tables."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

import dynsim

FOLDER = Path(dynsim.__file__).parent
FILES = (
    "dynamics/tables.py",
    "dynamics/state.py",
    "integrators/run.py",
    "integrators/events.py",
    "dynamics/tree/loads.py",
)


def given_twice(source: str) -> set[str]:
    """Names that are assigned more than once at the top of a module."""
    names: Counter[str] = Counter()
    for node in ast.parse(source).body:
        for target in node.targets if isinstance(node, ast.Assign) else ():
            names.update(part.id for part in ast.walk(target) if isinstance(part, ast.Name))
    return {name for name, count in names.items() if count > 1}


@pytest.mark.parametrize("file", FILES)
def test_no_column_is_named_twice(file: str) -> None:
    assert given_twice((FOLDER / file).read_text(encoding="utf-8")) == set()


def test_a_name_that_is_given_twice_is_seen() -> None:
    assert given_twice("A, B = 0, 1\nC = 2\nB = 3\n") == {"B"}
