"""Strict reading of tables and grids of numbers from CSV files; errors name file, line and reason."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from dynsim.errors import DynsimError
from dynsim.system.inputs import read_text

# Largest size of a file [bytes]: some million rows.
SIZE_LIMIT = 100_000_000
# float() also accepts "1_0" and digits of other scripts, which other programs would not read as numbers.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)


def read_rows(file: str, *headers: Sequence[str], kind: str) -> list[list[float]]:
    """The rows of :func:`read_table`, for headers of different numbers of columns."""
    return read_table(file, *headers, kind=kind)[1]


def read_table(file: str, *headers: Sequence[str], kind: str) -> tuple[tuple[str, ...], list[list[float]]]:
    """Two or more rows of a file whose first line is one of ``headers``, which comes first; first column increasing.

    Parameters
    ----------
    kind : name of the object that the rows describe, for the message

    Raises
    ------
    ValueError
        With file, line and reason: for validators of a scenario.
    """
    first, *lines = _lines(file)
    columns = tuple(name.strip() for name in first.split(","))
    if columns not in [tuple(header) for header in headers]:
        wanted = " or ".join(repr(",".join(header)) for header in headers)
        raise ValueError(f"{file}:1: the first line is {_shown(first)}; it must be {wanted}")
    rows: list[list[float]] = []
    for number, content in _contents(lines, 2):
        rows.append(_row(content, columns, f"{file}:{number}"))
        if len(rows) > 1 and not rows[-1][0] > rows[-2][0]:
            raise ValueError(
                f"{file}:{number}: {columns[0]} = {rows[-1][0]:g} after {rows[-2][0]:g}; "
                "it must increase from row to row"
            )
    if len(rows) < 2:
        raise ValueError(f"{file}: {len(rows)} rows below the header; {kind} needs two or more")
    return columns, rows


def read_grid(file: str) -> list[list[float]]:
    """The rows of a file of numbers without a header, all of one length.

    Raises
    ------
    ValueError
        With file, line and reason: for validators of a scenario.
    """
    rows: list[list[float]] = []
    columns: Sequence[str] = ()
    for number, content in _contents(_lines(file), 1):
        columns = columns or [str(k + 1) for k in range(content.count(",") + 1)]
        rows.append(_row(content, columns, f"{file}:{number}"))
    if not rows:
        raise ValueError(f"{file}: no rows of numbers")
    return rows


def _lines(file: str) -> list[str]:
    try:
        text = read_text(Path(file), DynsimError, SIZE_LIMIT)
    except DynsimError as error:
        raise ValueError(str(error)) from error
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _contents(lines: Iterable[str], first: int) -> Iterator[tuple[int, str]]:
    """Lines that hold more than a comment, with their numbers."""
    for number, line in enumerate(lines, first):
        if content := line.partition("#")[0].strip(" \t"):
            yield number, content


def _row(line: str, columns: Sequence[str], location: str) -> list[float]:
    cells = [cell.strip(" \t") for cell in line.split(",")]
    if len(cells) != len(columns):
        names = f": {','.join(columns)}" if columns[0] != "1" else ", as in the first row"
        raise ValueError(f"{location}: {len(cells)} values; there must be {len(columns)}{names}")
    if not all(_NUMBER.fullmatch(cell) and math.isfinite(float(cell)) for cell in cells):
        raise ValueError(f"{location}: {_shown(line)} is not {len(columns)} numbers, finite and in digits 0 to 9")
    return [float(cell) for cell in cells]


def _shown(line: str) -> str:
    """A line of the file for a message: one line, no control characters, not a page long."""
    return repr(line if len(line) <= 80 else line[:79] + "…")
