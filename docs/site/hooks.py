"""MkDocs hooks: generated pages, files from outside of docs/ and links to them, equations as MathML, redirects."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from posixpath import dirname, relpath
from typing import Any

import yaml
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

SITE = Path(__file__).parent
ROOT = SITE.parents[1]
sys.path[:0] = [str(ROOT), str(SITE)]

import figures  # noqa: E402
import gallery  # noqa: E402
import reference  # noqa: E402

# Pages in the root of the repository, and their places on the site.
OUTSIDE = {
    "CHANGELOG.md": "dev/changelog.md",
    "CONTRIBUTING.md": "dev/contributing.md",
    "results/README.md": "dev/results.md",
}
WORKER = "iframe-worker.js"
_EQUATION = re.compile(r"^```math\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
# A symbol of one letter with an index. The first alternatives match text that must not change: code, headings, link
# targets, HTML tags.
_INDEX = re.compile(
    r"(?P<kept>^```.*?^```$|^ {4}.*?$|^#.*?$|`[^`]*`|\]\([^)]*\)|<[a-z!/][^>]*>)"
    r"|(?<![\w-])(?P<letter>[^\W\d_][\u0300-\u036f]*)_(?P<index>[^\W_]{1,8})(?![\w*_])",
    flags=re.MULTILINE | re.DOTALL,
)
_OUTSIDE = re.compile(rf"\]\((?:\.\./)+({'|'.join(map(re.escape, OUTSIDE))})(?=[)#])")
# A page at an old address: with JavaScript it leads to the heading, without to the page.
_MOVED = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Moved</title>
<script>
const moved = {moved}, anchor = decodeURIComponent(location.hash.slice(1));
location.replace(moved[anchor] ?? moved[""] + location.hash);
</script>
<noscript><meta http-equiv="refresh" content="0; url={url}"></noscript>
<p>This page moved to <a href="{url}">{url}</a>.</p></html>
"""
_PICTURE = re.compile(r"\]\((?:\.\./)*(results/[\w/.-]+\.(?:png|gif))\)")


def on_files(files: Files, config: Any) -> Files:
    """Add generated files, and files of the repository that pages show."""
    files.append(File.generated(config, "reference/servo-map-keys.md", content=reference.servo_map_page()))
    files.append(File.generated(config, "reference/commands.md", content=reference.cli_page()))
    files.append(File.generated(config, WORKER, abs_src_path=str(SITE / WORKER)))
    files.append(File.generated(config, "gallery.md", content=gallery.page()))
    files.append(File.generated(config, "reference/figures.md", content=figures.page()))
    for built in sorted([*gallery.BUILT.glob("*/*.*"), *figures.BUILT.glob("*.png")]):
        name = built.relative_to(ROOT / "build").as_posix()
        files.append(File.generated(config, name, abs_src_path=str(built)))
    for source, target in OUTSIDE.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_text(encoding="utf-8")))
    pages = [file for file in files if file.src_uri.endswith(".md")]
    shown = {name for page in pages for name in _PICTURE.findall(page.content_string)}
    for name in sorted(shown):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Convert equations to MathML, which browsers typeset, and links to repository files to links of the site."""
    markdown = _EQUATION.sub(_typeset, markdown)
    markdown = _INDEX.sub(lambda match: match["kept"] or f"{match['letter']}<sub>{match['index']}</sub>", markdown)
    up = "../" * page.file.src_uri.count("/")
    markdown = _PICTURE.sub(lambda match: f"]({up}{match[1]})", markdown)
    markdown = _OUTSIDE.sub(lambda match: f"]({up}{OUTSIDE[match[1]]}", markdown)
    if page.file.src_uri in OUTSIDE.values():
        markdown = re.sub(r"\]\((?:\.\./)?docs/", f"]({up}", markdown)
        for source, target in OUTSIDE.items():
            markdown = markdown.replace(f"]({source})", f"]({up}{target})")
    return markdown


def _typeset(equation: re.Match[str]) -> str:
    return f'<div class="equation">{convert(equation[1], display="block")}</div>'


def on_post_build(config: Any) -> None:
    """Write pages that redirect from the old addresses of redirects.yml to the new ones."""
    pages: dict[str, dict[str, str]] = {}
    for old, new in yaml.safe_load((SITE / "redirects.yml").read_text(encoding="utf-8")).items():
        page, _, anchor = old.partition("#")
        address = relpath(new, dirname(page) or ".").replace(".md", ".html")
        pages.setdefault(page, {})[anchor] = address
    for page, moved in pages.items():
        target = Path(config["site_dir"], page).with_suffix(".html")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(_MOVED.format(moved=json.dumps(moved), url=moved[""]), encoding="utf-8")
