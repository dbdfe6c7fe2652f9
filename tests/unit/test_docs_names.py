"""Names in developer pages and sources exist: files, their contents, dotted names, folders of the package."""

from __future__ import annotations

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest

import dynsim
from dynsim.engine.recording import VIEW
from dynsim.library.families import FAMILIES
from dynsim.record import FORMAT

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "dynsim"
PAGES = ("architecture.md", "extending.md")
# The error handler of codecs that dynsim.system.terminal registers under this name.
NO_MODULES = {"dynsim.plain"}
# Files that the reader of an example creates.
MADE = {"dynsim/library/surfaces/ellipsoid.py", "dynsim/model/joints/screw.py"}


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def prose(text: str) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def file_named(path: str) -> Path | None:
    """The file or folder of that name, from the root of the repository or in the package."""
    return next((base / path for base in (ROOT, PACKAGE) if (base / path).exists()), None)


def paths(text: str) -> set[str]:
    return set(re.findall(r"`((?:\w+/)*\w+\.py|(?:\w+/)+)`", prose(text))) - MADE


def claims(text: str) -> set[tuple[str, str]]:
    """(file, name) where a page says that a name is in a file: `a.py` (`f`), `a.py`, `f`, and `f`, `g` in `a.py`."""
    text, file = " ".join(prose(text).split()), r"`((?:\w+/)*\w+\.py)`"
    pairs = re.findall(rf"{file} \(([^()]*)\)", text) + re.findall(rf"{file}, (`\w+`)", text)
    backwards = re.findall(rf"((?:`\w+`(?:, | and )?)+) (?:in|of) {file}", text)
    pairs += [(path, names) for names, path in backwards]
    return {(path, name) for path, names in pairs for name in re.findall(r"`(\w+)`", names)}


@cache
def defined(path: Path) -> frozenset[str]:
    """Functions, classes, methods, and what modules and classes assign."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return frozenset(names)


def dotted(text: str) -> set[str]:
    """Dotted names that begin with dynsim, one of its modules or a name that it exports; no groups of entry points."""
    roots = {"dynsim", *dynsim.__all__, *(path.stem for path in PACKAGE.iterdir())}
    names = re.findall(r"`([A-Za-z_]\w*(?:\.\w+)+)(?:\([^`]*\))?`", prose(text))
    groups = {f"dynsim.{family}s" for family in FAMILIES}
    return {name for name in names if name.split(".")[0] in roots and not name.endswith(".py")} - groups


def resolves(name: str) -> bool:
    """Whether a dotted name, with or without ``dynsim.``, is a module or an attribute of one."""
    parts = name.removeprefix("dynsim.").split(".")
    thing, path = dynsim, "dynsim"
    for part in parts:
        path = f"{path}.{part}"
        if hasattr(thing, part):
            thing = getattr(thing, part)
            continue
        if part in getattr(thing, "__dataclass_fields__", ()):
            continue
        try:
            thing = importlib.import_module(path)
        except ImportError:
            return False
    return True


def missing(text: str) -> list[str]:
    """What a page names and there is not."""
    absent = [path for path in paths(text) if file_named(path) is None]
    for path, name in claims(text):
        file = file_named(path)
        if file is not None and name not in defined(file):
            absent.append(f"{path}: {name}")
    return sorted(absent + [name for name in dotted(text) if not resolves(name)])


@pytest.mark.parametrize("name", PAGES)
def test_what_a_page_names_exists(name: str) -> None:
    text = page(name)
    # The patterns find what they are for.
    assert len(paths(text)) > 15
    assert len(claims(text)) > 5
    assert missing(text) == []


def test_what_the_pages_for_developers_name_exists() -> None:
    pages = sorted((ROOT / "docs" / "dev").glob("*.md"))
    assert len(pages) == 7
    assert {path.name: wrong for path in pages if (wrong := missing(path.read_text(encoding="utf-8")))} == {}


DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.name)
def test_files_of_a_run_have_the_names_that_are_written(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert set(re.findall(r"`([\w.]+\.html)`", text)) <= {VIEW}
    assert set(re.findall(r"dynsim-record-\d", text)) <= {FORMAT}


@pytest.mark.parametrize(
    "wrong",
    [
        "`dynamics/nowhere.py`",
        "`nowhere/`",
        "`dynamics/derivative.py` (`derivative`, `nothing`)",
        "(`dynamics/derivative.py`, `nothing`)",
        "`derivative` and\n`nothing` in `dynamics/derivative.py`",
        "`engine.nothing`",
        "`dynsim.Simulation.nothing`",
        "`Simulation.nothing(0.1)`",
    ],
)
def test_a_name_that_is_not_there_is_found(wrong: str) -> None:
    assert len(missing(f"See {wrong}.")) == 1


def test_what_sources_name_exists() -> None:
    """Modules, functions and classes by their whole names, in docstrings, comments and texts."""
    groups = {f"dynsim.{family}s" for family in FAMILIES}
    named = {
        (name, path.relative_to(PACKAGE).as_posix())
        for path in PACKAGE.rglob("*.py")
        for name in re.findall(r"\bdynsim(?:\.[A-Za-z_]\w*)+", path.read_text(encoding="utf-8"))
        if name not in groups | NO_MODULES
    }
    assert len(named) > 1000
    assert [f"{path}: {name}" for name, path in sorted(named) if not resolves(name)] == []


def test_examples_make_what_is_not_there() -> None:
    assert all(f"`{path}`" in page("extending.md") + page("dev/core.md") for path in MADE)
    assert [path for path in MADE if file_named(path) is not None] == []


def test_every_file_of_the_package_has_a_docstring() -> None:
    assert [path for path in PACKAGE.rglob("*.py") if path.name != "_version.py" and not docstring(path)] == []


def docstring(path: Path) -> str:
    """Docstring of a file."""
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
