"""Banned names: no variable, argument or function has one, in package, tests and scripts."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import dynsim

PACKAGE = Path(dynsim.__file__).parent
REPOSITORY = Path(__file__).parents[2]
BANNED = {"found", "given", "held", "hold", "one", "place", "rest", "told", "way", "what"}
# In tests of brakes, which hold a joint, and of references, which hold a value.
ALLOWED_IN_TESTS = {"held"}
# Participles, which do not name an action or a result of a function.
PARTICIPLES = {"folded", "shown", "sunk"}
# Of the public interface: how long the last frame of a film stays.
PUBLIC = {("cli/drawing.py", "hold"), ("draw/film/film.py", "hold")}


def bad_names(source: str) -> Iterator[tuple[str, int]]:
    """Banned names of variables, arguments and functions with their lines; attributes are not looked at."""
    tree = ast.parse(source)
    fields = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            plain = (statement for statement in node.body if not isinstance(statement, ast.FunctionDef))
            fields |= {id(inner) for statement in plain for inner in ast.walk(statement)}
    for node in ast.walk(tree):
        name, banned = "", BANNED
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and id(node) not in fields:
            name = node.id
        elif isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.FunctionDef) and "property" not in map(ast.unparse, node.decorator_list):
            name, banned = node.name, BANNED | PARTICIPLES
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs):
            name = node.name or ""
        if name in banned:
            yield name, getattr(node, "lineno", 0)


def test_names_say_what_they_are() -> None:
    wrong = [
        f"{module}:{line}: {name}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for name, line in bad_names(path.read_text(encoding="utf-8"))
        if ((module := path.relative_to(PACKAGE).as_posix()), name) not in PUBLIC
    ]
    assert wrong == []


@pytest.mark.parametrize("folder", ["tests", ".ci", "docs"])
def test_names_of_tests_and_scripts_do_too(folder: str) -> None:
    paths = sorted((REPOSITORY / folder).rglob("*.py"))
    wrong = [
        f"{path.relative_to(REPOSITORY)}:{line}: {name}"
        for path in paths
        for name, line in bad_names(path.read_text(encoding="utf-8"))
        if name in BANNED - ALLOWED_IN_TESTS
    ]
    assert paths
    assert wrong == []


def test_what_is_looked_at() -> None:
    source = (
        "class A:\n  one: int\n  def held(self, way): ...\nfor place in (): told = 1\ndef shown(): ...\nrest(what)\n"
    )
    assert sorted(bad_names(source)) == [("held", 3), ("place", 4), ("shown", 5), ("told", 4), ("way", 3)]


def test_a_class_name_means_one_thing() -> None:
    """``Config`` is what every member of a family has; private classes are their module's own."""
    homes: dict[str, list[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and node.name != "Config" and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(path.relative_to(PACKAGE).as_posix())
    assert {name: modules for name, modules in homes.items() if len(modules) > 1} == {}
