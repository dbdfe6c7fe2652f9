"""A hand path from a CSV file with the columns t_s, x_m, y_m, z_m."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator
from scipy.interpolate import PchipInterpolator

from dynsim.config import StrictConfig
from dynsim.errors import ModelError
from dynsim.inputs import read_text
from dynsim.model.control import HandPath
from dynsim.model.protocols import BuildContext

COLUMNS = ("t_s", "x_m", "y_m", "z_m")
# Of a file [bytes]: some million rows.
SIZE_LIMIT = 100_000_000
# float() takes more: "1_0", digits of other scripts. No other program would read the file so.
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)


class Config(StrictConfig):
    """Shape-preserving cubic through the rows of ``file``, held beyond its ends."""

    type: Literal["csv"]
    file: str = Field(description="CSV file, relative to the scenario file, with a header t_s,x_m,y_m,z_m")
    # Read once: an edit of the file does not change a scenario that is already loaded, only the next one.
    _rows: list[list[float]] = PrivateAttr()

    @model_validator(mode="after")
    def _read(self) -> Self:
        self._rows = _rows(self.file)
        _check_curve(self._rows, self.file)
        return self

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """The curve at times t [s], shape (T, 3) [m]."""
        curve = _curve(self._rows)
        return curve(np.clip(t, curve.x[0], curve.x[-1]))


def build(config: Config, context: BuildContext) -> HandPath:
    """The path, which its configuration is."""
    return config


def _rows(file: str) -> list[list[float]]:
    """Rows t, x, y, z of the file; ValueError names what is wrong with it."""
    try:
        text = read_text(Path(file), ModelError, SIZE_LIMIT)
    except ModelError as error:
        raise ValueError(str(error)) from error
    header, *lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if tuple(name.strip() for name in header.split(",")) != COLUMNS:
        raise ValueError(f"{file}:1: the first line is {_shown(header)}; it must be {','.join(COLUMNS)!r}")
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 2):
        content = line.partition("#")[0].strip(" \t")
        if not content:
            continue
        rows.append(_row(content, f"{file}:{number}"))
        if len(rows) > 1 and not rows[-1][0] > rows[-2][0]:
            raise ValueError(
                f"{file}:{number}: t_s = {rows[-1][0]:g} after {rows[-2][0]:g}; it must increase from row to row"
            )
    if len(rows) < 2:
        raise ValueError(f"{file}: {len(rows)} rows below the header; a path needs two or more")
    return rows


def _row(line: str, place: str) -> list[float]:
    cells = [cell.strip(" \t") for cell in line.split(",")]
    if len(cells) != len(COLUMNS):
        raise ValueError(f"{place}: {len(cells)} values; there must be {len(COLUMNS)}: {','.join(COLUMNS)}")
    if not all(_NUMBER.fullmatch(cell) and math.isfinite(float(cell)) for cell in cells):
        raise ValueError(f"{place}: {_shown(line)} is not {len(COLUMNS)} numbers, finite and in digits 0 to 9")
    return [float(cell) for cell in cells]


def _curve(rows: list[list[float]]) -> PchipInterpolator:
    table = np.array(rows)
    return PchipInterpolator(table[:, 0], table[:, 1:])


def _check_curve(rows: list[list[float]], file: str) -> None:
    """ValueError unless rounding leaves the curve finite and on its rows."""
    table = np.array(rows)
    try:
        with np.errstate(all="ignore"):
            curve = _curve(rows)
            met = np.allclose(curve(table[:, 0]), table[:, 1:], rtol=1e-9, atol=1e-12)
    except ValueError:  # slopes that overflow
        met = False
    if not (met and np.isfinite(curve.c).all()):
        raise ValueError(f"{file}: numbers too large, or rows too close in time, for a curve through them")


def _shown(line: str) -> str:
    """A line of the file for a message: one line, no control characters, not a page long."""
    return repr(line if len(line) <= 80 else line[:79] + "…")
