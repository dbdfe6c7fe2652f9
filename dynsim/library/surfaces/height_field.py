"""Height field z = h(x, y) from a file: a bicubic C² spline through heights on a grid."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import Positive, SurfaceConfig, Vector3, default, error_at
from dynsim.errors import DynsimError
from dynsim.model.surfaces import HeightField
from dynsim.record.csv_rows import SIZE_LIMIT, read_grid
from dynsim.system.inputs import read_bytes

# Minimum number of heights along x and along y for cubic splines.
LEAST = 4
# Maximum magnitude of a height [m].
LIMIT = 1e6


class Config(SurfaceConfig):
    """Heights [m] over a grid in the x–y plane, extrapolated linearly; the robot is above."""

    type: Literal["height_field"]
    file: str = Field(
        description="path of a CSV file without a header, or of a .npy file, relative to the scenario file: "
        "one row per y, one column per x"
    )
    spacing_m: Annotated[list[Positive], Field(min_length=2, max_length=2)] = Field(
        description="grid spacing along x and y"
    )
    origin_m: Vector3 = default(
        [0.0, 0.0, 0.0], "position of the first height of the first row; z is added to all heights"
    )
    # The file is read only once, so that later edits do not change a loaded scenario.
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
                "file",
                f"{self.file}: has {rows} rows of {columns} heights; a spline needs at least {LEAST} rows and columns",
            )
        wrong = np.argwhere(~(np.abs(self._heights) <= LIMIT))
        if len(wrong):
            row, column = wrong[0].tolist()
            raise error_at(
                "file",
                f"{self.file}: height {column + 1} of row {row + 1} is {self._heights[row][column]:g} m; "
                f"heights must be finite, with a magnitude of at most {LIMIT:g} m",
            )
        return self


def build(config: Config, context: BuildContext) -> HeightField:
    """Return the height field in world coordinates."""
    x, y, z = config.origin_m
    return HeightField(np.array([x, y]), np.array(config.spacing_m), np.array(config._heights) + z)


def _read_npy(file: str) -> list[list[float]]:
    """Read the rows of a .npy file; raise ValueError if it is not a two-dimensional array of numbers."""
    try:
        heights = np.load(io.BytesIO(read_bytes(Path(file), DynsimError, SIZE_LIMIT)), allow_pickle=False)
    except DynsimError as error:
        raise ValueError(str(error)) from error
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{file}: must be an array of numbers ({error})") from error
    if not isinstance(heights, np.ndarray) or heights.ndim != 2 or heights.dtype.kind not in "fiu":
        raise ValueError(
            f"{file}: must be a two-dimensional array of numbers, got shape {getattr(heights, 'shape', ())}"
        )
    rows: list[list[float]] = heights.astype(np.float64).tolist()
    return rows
