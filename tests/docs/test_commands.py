"""Commands in the pages exist, with their options, on scenarios that exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer
from latex2mathml import converter

from docs import test_pages_run
from dynsim.cli.commands import app
from dynsim.system.shipped import shipped_scenarios

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "results" / "README.md"]
FENCE = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```$", flags=re.MULTILINE | re.DOTALL)
LANGUAGES = {"bash", "sh", "python", "yaml", "text", "toml", "math"}
APP = typer.main.get_command(app)


def commands(text: str) -> list[str]:
    """Lines of blocks and code within sentences that call dynsim with something."""
    blocks = [text for kind, text in FENCE.findall(text) if kind in ("bash", "sh")]
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    lines += [line.strip() for line in text.splitlines() if line.startswith("    dynsim ")]
    lines += re.findall(r"`(dynsim [^`]+)`", " ".join(text.split()))
    return [line for line in lines if line.startswith("dynsim ") and "…" not in line]


def parsed(line: str) -> tuple[str, dict[str, Any]]:
    """Name of a command and what it is given; raises what Typer says of a line that it would refuse."""
    words, command, name = shlex.split(line, comments=True)[1:], APP, "dynsim"
    while True:
        context = command.context_class(command, info_name=name)
        options, words, _ = command.make_parser(context).parse_args(list(words))
        if not hasattr(command, "resolve_command") or not words:
            return name, options
        name, command, words = command.resolve_command(context, words)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_commands_are_those_of_dynsim(path: Path) -> None:
    wrong = []
    for line in commands(path.read_text(encoding="utf-8")):
        try:
            parsed(line)
        except Exception as error:  # of the click within Typer
            wrong.append(f"{line}: {error}")
    assert wrong == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_block_says_what_it_is(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert {
        kind for kind, _ in FENCE.findall(re.sub(r"<!-- table:.*?<!-- end -->", "", text, flags=re.DOTALL))
    } <= LANGUAGES


def test_equations_keep_their_rows_and_cells_on_the_site() -> None:
    equations = [
        text for path in PAGES for kind, text in FENCE.findall(path.read_text(encoding="utf-8")) if kind == "math"
    ]
    assert len(equations) > 25
    for text in equations:
        converted = converter.convert(text)
        assert "\\" not in converted, text
        if r"\begin{array}" in text:
            rows = text.count(r"\\") + 1
            assert (converted.count("<mtr>"), converted.count("<mtd")) == (rows, rows + text.count("&")), text


def test_what_is_bash_is_run() -> None:
    shown = set()
    for path in PAGES:
        if any(kind == "bash" for kind, _ in FENCE.findall(path.read_text(encoding="utf-8"))):
            shown.add(path.relative_to(ROOT).as_posix())
    assert shown <= set(test_pages_run.PAGES)


def test_a_command_that_is_not_there_is_found() -> None:
    for line in ("dynsim rum elbow_comparison", "dynsim run elbow_comparison --varient x", "dynsim hw chek x"):
        with pytest.raises(Exception, match="No such"):
            parsed(line)
    assert parsed("dynsim run elbow_comparison --set a=1  # so")[1]["scenario"] == "elbow_comparison"


def test_scenarios_that_are_named_exist() -> None:
    names = {path.stem for path in shipped_scenarios()}
    named = set()
    for path in PAGES:
        for line in commands(path.read_text(encoding="utf-8")):
            scenario = parsed(line)[1].get("scenario") or ""
            if re.fullmatch("[a-z_]+", scenario):
                named.add(scenario)
    assert len(named) > 8
    assert named <= names
