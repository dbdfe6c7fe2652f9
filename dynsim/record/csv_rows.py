"""CSV files: strict reading of numeric tables and grids (errors name file, line and reason), and writing of tables."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from dynsim.errors import DynsimError
from dynsim.system.inputs import read_text

# Maximum file size [bytes], enough for a few million rows.
SIZE_LIMIT = 100_000_000
# The pattern is needed because float() also accepts "1_0" and digits of other scripts, which other programs would not
# read as numbers.
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)


def read_rows(file: str, *headers: Sequence[str], kind: str) -> list[list[float]]:
    """Return the rows of :func:`read_table`; the number of columns shows which of the headers the file has."""
    return read_table(file, *headers, kind=kind)[1]


def read_table(file: str, *headers: Sequence[str], kind: str) -> tuple[tuple[str, ...], list[list[float]]]:
    """Read a header and at least two rows; the values in the first column must increase.

    Parameters
    ----------
    file : str
        Path of the file.
    *headers : sequence of str
        Accepted headers; the first line of the file must be one of them.
    kind : str
        Name of the object that the rows describe, for error messages.

    Returns
    -------
    columns : tuple of str
        Header of the file.
    rows : list of list of float
        Numbers of each row.

    Raises
    ------
    ValueError
        If the file is invalid; with file, line and reason, for validators of scenarios.
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
        raise ValueError(f"{file}: {len(rows)} rows below the header; {kind} requires two or more")
    return columns, rows


def read_grid(file: str) -> list[list[float]]:
    """Read the rows of a file of numbers without a header; all rows must have the same length.

    Raises
    ------
    ValueError
        If the file is invalid; with file, line and reason, for validators of scenarios.
    """
    rows: list[list[float]] = []
    columns: Sequence[str] = ()
    for number, content in _contents(_lines(file), 1):
        columns = columns or [str(k + 1) for k in range(content.count(",") + 1)]
        rows.append(_row(content, columns, f"{file}:{number}"))
    if not rows:
        raise ValueError(f"{file}: contains no rows of numbers")
    return rows


def _lines(file: str) -> list[str]:
    try:
        text = read_text(Path(file), DynsimError, SIZE_LIMIT)
    except DynsimError as error:
        raise ValueError(str(error)) from error
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _contents(lines: Iterable[str], first: int) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not empty and not only a comment, with their line numbers."""
    for number, line in enumerate(lines, first):
        if content := line.partition("#")[0].strip(" \t"):
            yield number, content


def _row(line: str, columns: Sequence[str], location: str) -> list[float]:
    cells = [cell.strip(" \t") for cell in line.split(",")]
    if len(cells) != len(columns):
        names = f": {','.join(columns)}" if columns[0] != "1" else ", as in the first row"
        raise ValueError(f"{location}: has {len(cells)} values; there must be {len(columns)}{names}")
    if not all(NUMBER.fullmatch(cell) and math.isfinite(float(cell)) for cell in cells):
        raise ValueError(f"{location}: {_shown(line)} must be {len(columns)} finite numbers, written in digits 0 to 9")
    return [float(cell) for cell in cells]


def _shown(line: str) -> str:
    """Quote a line of the file for a message, without control characters and shortened to 80 characters."""
    return repr(line if len(line) <= 80 else line[:79] + "…")


def csv_table(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as CSV text, with all digits and empty fields for missing values."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(csv_cell(name) for name in names)
    writer.writerows([csv_cell(row.get(name)) for name in names] for row in rows)
    return stream.getvalue()


def csv_cell(value: Any) -> Any:
    """Return a cell of a table: lists and mappings as JSON, formulas of spreadsheets with an apostrophe in front."""
    if isinstance(value, (list, tuple, dict)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) and not NUMBER.fullmatch(value):
        return f"'{value}"
    return value
