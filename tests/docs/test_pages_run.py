"""Code blocks of README, the first pages and how-to pages run, page by page, in an empty folder.

A block of ``yaml`` with a title is a file; each line of ``bash`` is a command of dynsim, which must succeed, or end
with the code of its comment ``# exit code N``; lines of a ``text`` block after it must be in what it printed; blocks
of ``python`` share their names. ``sh`` is not run; test_commands.py looks at what it says.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import dynsim

ROOT = Path(__file__).parents[2]
HOW_TO = sorted(f"docs/how-to/{page.name}" for page in (ROOT / "docs" / "how-to").glob("*.md"))
PAGES = [
    "README.md", "docs/getting-started.md", "docs/python.md", "docs/scenarios/files.md", "docs/scenarios/signals.md",
    *HOW_TO, "docs/hardware/replay.md",
]  # fmt: skip
BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
PACKAGE = str(Path(dynsim.__file__).parents[1])

pytestmark = pytest.mark.long


def run(line: str, folder: Path) -> str:
    """Output of a command of dynsim, which must have its exit code. .ci/run runs the two commands of the README."""
    if line.startswith("python3 -m venv"):
        return ""
    program, *arguments = shlex.split(line, comments=True)
    stated = re.search(r"# exit code (\d+)$", line)
    assert program == "dynsim", f"{line}: only dynsim is run; other commands are sh"
    paths = [PACKAGE, *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [sys.executable, "-m", "dynsim", *arguments],
        cwd=folder, capture_output=True, text=True, timeout=900, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == int(stated[1] if stated else 0), f"{line}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def words(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    printed = ""
    blocks = BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))
    assert any(kind in ("bash", "python") for kind, _, _ in blocks)
    for kind, title, text in blocks:
        match kind:
            case "yaml":
                assert title, f"{page}: a block of yaml needs a title, the file that it is"
                (tmp_path / title).write_text(text, encoding="utf-8")
            case "bash":
                printed = "\n".join(run(line, tmp_path) for line in text.strip().splitlines())
            case "text":
                for line in text.strip().splitlines():
                    assert words(line) in words(printed), f"{page}: {line!r} is not in\n{printed}"
            case "python":
                with contextlib.redirect_stdout(io.StringIO()) as output:
                    exec(compile(text, page, "exec"), names)
                printed = output.getvalue()
