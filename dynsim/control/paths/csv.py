"""A hand path from a CSV file with the columns t_s, x_m, y_m, z_m."""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.interpolate import PchipInterpolator

from dynsim.config import StrictConfig
from dynsim.errors import ModelError
from dynsim.inputs import read_text

COLUMNS = ("t_s", "x_m", "y_m", "z_m")
# Of a file [bytes]: some million rows.
SIZE_LIMIT = 100_000_000


class Config(StrictConfig):
    """Shape-preserving cubic through the rows of ``file``, held beyond its ends."""

    type: Literal["csv"]
    file: str = Field(description="CSV file, relative to the scenario file, with a header t_s,x_m,y_m,z_m")

    @model_validator(mode="after")
    def _check(self) -> Self:
        _table(self.file)
        return self

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """The curve at times t [s], shape (T, 3) [m]."""
        table = _table(self.file)
        return PchipInterpolator(table[:, 0], table[:, 1:])(np.clip(t, table[0, 0], table[-1, 0]))


@lru_cache(maxsize=8)
def _table(file: str) -> NDArray[np.float64]:
    """Rows (t, x, y, z) of the file; ValueError names what is wrong with it."""
    path = Path(file)
    try:
        # Line ends of every system become "\n".
        stream = io.StringIO(read_text(path, ModelError, SIZE_LIMIT), newline=None)
    except ModelError as error:
        raise ValueError(str(error)) from error
    header = stream.readline().strip()
    if tuple(name.strip() for name in header.split(",")) != COLUMNS:
        raise ValueError(f"{path}:1: the first line is {header[:80]!r}; it must be {','.join(COLUMNS)!r}")
    lines = ((number, line.strip()) for number, line in enumerate(stream, 2))
    rows = [_row(line, f"{path}:{number}") for number, line in lines if line and not line.startswith("#")]
    table = np.array(rows)
    if len(table) < 2 or not np.isfinite(table).all() or np.any(np.diff(table[:, 0]) <= 0.0):
        raise ValueError(f"{path}: needs two rows or more, finite numbers and increasing t_s")
    return table


def _row(line: str, place: str) -> list[float]:
    cells = [cell.strip() for cell in line.partition("#")[0].split(",")]
    if len(cells) != len(COLUMNS):
        raise ValueError(f"{place}: {len(cells)} values; there must be {len(COLUMNS)}: {','.join(COLUMNS)}")
    try:
        # Python's own reading of numbers knows underscores and the digits of every script.
        if not line.isascii() or any("_" in cell for cell in cells):
            raise ValueError
        return [float(cell) for cell in cells]
    except ValueError:
        raise ValueError(f"{place}: {line[:80]!r} is not {len(COLUMNS)} numbers") from None
