"""Files of the package stay short enough to be read in one go; one that is longer says why at its top."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import dynsim

PACKAGE = Path(dynsim.__file__).parent
LINES_MAX = 450
MARK = "Long because: "
# Not split yet. A file that is short, or says why it is not, must leave this list.
NOT_SPLIT_YET = {"figures/posture.py", "record_file.py"}


def too_long(source: str) -> bool:
    """More than LINES_MAX lines, and no line of the module's docstring that gives the reason."""
    if len(source.splitlines()) <= LINES_MAX:
        return False
    lines = (ast.get_docstring(ast.parse(source)) or "").splitlines()
    return not any(line.startswith(MARK) and line.removeprefix(MARK).strip() for line in lines)


def test_no_file_is_long_without_a_reason() -> None:
    files = {str(file.relative_to(PACKAGE)): file.read_text(encoding="utf-8") for file in PACKAGE.rglob("*.py")}
    assert len(files) > 100, "these are not the files of the package"
    assert {name for name, source in files.items() if too_long(source)} == NOT_SPLIT_YET


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("x = 1\n" * LINES_MAX, False),
        ("x = 1\n" * (LINES_MAX + 1), True),
        ('"""A table.\n\nLong because: one row per register.\n"""\n' + "x = 1\n" * LINES_MAX, False),
        ('"""A table.\n\nLong because: \n"""\n' + "x = 1\n" * LINES_MAX, True),
        ('"""A table."""\n\nx = "Long because: of this"\n' + "x = 1\n" * LINES_MAX, True),
    ],
    ids=["short", "long", "with a reason", "with an empty reason", "with the words elsewhere"],
)
def test_only_a_reason_at_the_top_excuses_a_long_file(source: str, expected: bool) -> None:
    assert too_long(source) is expected
