"""Relative links and pictures of Markdown pages lead to files and headings of a checkout, without building the site."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "results/README.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
FENCE = re.compile(r"^ *```.*?^ *```$", flags=re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(<?([^)\s>]+)")


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as code hosts and the site build them."""
    names: set[str] = set()
    for heading in re.findall(r"^#+ +(.*?)\s*$", FENCE.sub("", text), flags=re.MULTILINE):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)|<!--.*?-->", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
        repeats = (f"{name}-{k}" for k in range(1, len(names) + 1))
        names.add(name if name not in names else next(repeat for repeat in repeats if repeat not in names))
    return names


def dead_links(page: Path, text: str | None = None) -> list[str]:
    """Return the relative links of a page, or of a text in its place, whose file or anchor is missing."""
    dead = []
    text = FENCE.sub("", page.read_text(encoding="utf-8") if text is None else text)
    for link in LINK.findall(re.sub(r"`[^`\n]*`", "", text)):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists():
            dead.append(f"{link}: no such file")
        elif anchor and anchor not in anchors(target.read_text(encoding="utf-8")):
            dead.append(f"{link}: no such heading")
    return dead


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(page: Path) -> None:
    assert dead_links(page) == []


def test_redirects_lead_from_removed_pages_to_files_and_headings() -> None:
    moved = yaml.safe_load((ROOT / "docs" / "site" / "redirects.yml").read_text(encoding="utf-8"))
    for old, new in moved.items():
        name = old.partition("#")[0]
        assert name in moved, f"{old}: its page has no line"
        assert not (ROOT / "docs" / name).exists(), f"{name} still exists"
        assert new.partition("#")[0] not in moved, f"{new} has moved too"
    # The site writes this page from CONTRIBUTING.md.
    links = "".join(f"[a]({new})" for new in moved.values() if new != "dev/contributing.md")
    assert dead_links(ROOT / "docs" / "index.md", links) == []


def test_dead_links_are_reported(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    (tmp_path / "other.md").write_text("# Other page\n\n## Keys of `x`: a, b\n\n## Keys\n\n## Keys\n", encoding="utf-8")
    alive = "[a](other.md) [b](other.md#keys-of-x-a-b) [c](other.md#keys-1) [d](https://x.org/y) [e](#top) `[f](g.md)`"
    page.write_text(f"# Top\n\n{alive}\n\n```text\n# No heading\n[g](h.md)\n```\n", encoding="utf-8")
    assert dead_links(page) == []
    dead = "[a](gone.md) ![b](gone.png) [c](other.md#gone) [d](#no-heading) [e](other.md#keys-2)"
    page.write_text(f"# Top\n\n{dead}\n\n```text\n# No heading\n```\n", encoding="utf-8")
    assert len(dead_links(page)) == 5
