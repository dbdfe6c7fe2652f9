"""A height field z = h(x, y) from a file: a bicubic C² spline through heights on a grid."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, StrictConfig, Vector3, error_at
from dynsim.errors import DynsimError
from dynsim.model.surfaces import HeightField
from dynsim.record.csv_rows import SIZE_LIMIT, read_grid
from dynsim.system.inputs import read_bytes

# Least number of heights along x and along y, for cubics.
LEAST = 4
# Largest magnitude of a height [m].
LIMIT = 1e6


class Config(StrictConfig):
    """Heights [m] over a grid of the x–y plane, beyond which they go on straight; the free side is above."""

    type: Literal["height_field"]
    file: str = Field(
        description="CSV without a header or .npy, relative to the scenario file: a row for each y, a column for each x"
    )
    spacing_m: Annotated[list[Positive], Field(min_length=2, max_length=2)] = Field(description="along x and y")
    origin_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="of the first height of the first row")
    # Read once: an edit of the file does not change a scenario that is already loaded, only the next one.
    _heights: list[list[float]] = PrivateAttr()

    @model_validator(mode="after")
    def _read(self) -> Self:
        try:
            self._heights = _read_npy(self.file) if self.file.endswith(".npy") else read_grid(self.file)
        except ValueError as error:
            raise error_at("file", str(error)) from error
        rows, columns = len(self._heights), len(self._heights[0]) if self._heights else 0
        if min(rows, columns) < LEAST:
            raise error_at(
                "file", f"{self.file}: {rows} rows of {columns} heights; a spline needs {LEAST} or more each way"
            )
        wrong = np.argwhere(~(np.abs(self._heights) <= LIMIT))
        if len(wrong):
            row, column = wrong[0].tolist()
            raise error_at(
                "file",
                f"{self.file}: height {column + 1} of row {row + 1} is {self._heights[row][column]:g} m; "
                f"heights must be numbers of at most {LIMIT:g} m",
            )
        return self


def build(config: Config, context: BuildContext) -> HeightField:
    """The field, with its heights in the world."""
    x, y, z = config.origin_m
    return HeightField(np.array([x, y]), np.array(config.spacing_m), np.array(config._heights) + z)


def _read_npy(file: str) -> list[list[float]]:
    """The rows of a .npy file; ValueError, with the reason, unless it has rows of finite numbers."""
    try:
        heights = np.load(io.BytesIO(read_bytes(Path(file), DynsimError, SIZE_LIMIT)), allow_pickle=False)
    except DynsimError as error:
        raise ValueError(str(error)) from error
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{file}: is no array of numbers ({error})") from error
    if not isinstance(heights, np.ndarray) or heights.ndim != 2 or heights.dtype.kind not in "fiu":
        raise ValueError(
            f"{file}: its array is of shape {getattr(heights, 'shape', ())}; it must have a row for each y"
        )
    rows: list[list[float]] = heights.astype(np.float64).tolist()
    return rows
