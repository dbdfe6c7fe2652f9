"""Hand path from a CSV file with the columns t_s, x_m, y_m, z_m."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator
from scipy.interpolate import PchipInterpolator

from dynsim.compile.control import HandPath, HandPathConfig
from dynsim.compile.protocols import BuildContext
from dynsim.model.description import Array
from dynsim.record.csv_rows import read_rows

COLUMNS = ("t_s", "x_m", "y_m", "z_m")


class Config(HandPathConfig):
    """Shape-preserving cubic through the rows of `file`, constant before the first and after the last row."""

    type: Literal["csv"]
    file: str = Field(description="path of a CSV file, relative to the scenario file, with the header t_s,x_m,y_m,z_m")
    # The file is read only once, so that later edits do not change a loaded scenario.
    _rows: list[list[float]] = PrivateAttr()

    @model_validator(mode="after")
    def _read(self) -> Self:
        self._rows = read_rows(self.file, COLUMNS, kind="a path")
        _check_curve(self._rows, self.file)
        return self

    def position(self, t: Array) -> Array:
        """Return the positions at times t [s], shape (T, 3) [m]."""
        curve = _curve(self._rows)
        return curve(np.clip(t, curve.x[0], curve.x[-1]))


def build(config: Config, context: BuildContext) -> HandPath:
    """Return the configuration itself, which implements the `HandPath` interface."""
    return config


def _curve(rows: list[list[float]]) -> PchipInterpolator:
    table = np.array(rows)
    return PchipInterpolator(table[:, 0], table[:, 1:])


def _check_curve(rows: list[list[float]], file: str) -> None:
    """Raise ValueError if, because of rounding, the curve becomes infinite or misses its rows."""
    table = np.array(rows)
    try:
        with np.errstate(all="ignore"):
            curve = _curve(rows)
            met = np.allclose(curve(table[:, 0]), table[:, 1:], rtol=1e-9, atol=1e-12)
    except ValueError:  # raised if slopes overflow
        met = False
    if not (met and np.isfinite(curve.c).all()):
        raise ValueError(f"{file}: cannot be interpolated: numbers too large, or rows too close in time")
