"""The navigation has its six sections and every page, and pages begin with their purpose and, for tasks, a command."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if path.parent.name != "paper"]
TASKS = ("how-to/", "hardware/", "scenarios/", "planner.", "sweeps.", "viewer.", "films.", "teleop.", "snake.")
COMMAND = re.compile(r"^```(?:bash|sh|python)$|`dynsim [a-z]", flags=re.MULTILINE)


def navigation() -> list[Any]:
    """Return ``nav`` of the site, which follows keys with tags that only MkDocs reads."""
    text = (DOCS / "site" / "mkdocs.yml").read_text(encoding="utf-8")
    entries: list[Any] = yaml.safe_load(text.split("\nnav:\n")[1])
    return entries


def leaves(entry: Any) -> Iterator[str]:
    """Yield the pages of an entry of the navigation."""
    if isinstance(entry, str):
        yield entry
    else:
        for part in entry if isinstance(entry, list) else entry.values():
            yield from leaves(part)


def opening(page: str) -> str:
    """Return the text between the title of a page and its first section."""
    return page.partition("\n")[2].split("\n## ")[0].strip()


def test_navigation_has_its_sections_and_every_page() -> None:
    sections = [next(iter(entry)) for entry in navigation() if isinstance(entry, dict)]
    assert sections == ["Start", "How-to", "Reference", "Theory", "Validation", "Developers"]
    listed = list(leaves(navigation()))
    assert len(listed) == len(set(listed))
    assert {path.relative_to(DOCS).as_posix() for path in PAGES} <= set(listed)


def test_pages_begin_with_a_sentence() -> None:
    assert len(PAGES) > 60
    begun = re.compile(r"(?!```)[A-Za-z`]")
    assert [path.name for path in PAGES if not begun.match(opening(path.read_text(encoding="utf-8")))] == []


def test_pages_of_tasks_begin_with_a_command() -> None:
    tasks = [path for path in PAGES if path.relative_to(DOCS).as_posix().startswith(TASKS)]
    assert len(tasks) > 30
    assert [path.name for path in tasks if not COMMAND.search(opening(path.read_text(encoding="utf-8")))] == []
