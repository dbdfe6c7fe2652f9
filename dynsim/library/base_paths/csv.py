"""Motion of a mobile base from a CSV file with columns t_s, x_m, y_m, or rates t_s, V_m_s, omega_rad_s."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator
from scipy.interpolate import PchipInterpolator

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.plane_curve import AlongCurve, PlaneCurve, seen_from_start
from dynsim.config.base import StrictConfig, default, error_at
from dynsim.errors import ModelError
from dynsim.model.description import Array
from dynsim.record.csv_rows import read_table

PLACES = ("t_s", "x_m", "y_m")
RATES = ("t_s", "V_m_s", "omega_rad_s")
# Rows closer than this [m] to the previous point of the curve affect the speed along the curve, but not its shape.
SPACING = 1e-3
# Maximum turn between rows of a smooth path [rad]; larger turns count as corners.
TURN_LIMIT = np.deg2rad(15.0)


class Config(StrictConfig):
    """Motion through the positions, or at the rates, in `file`; at rest before the first and after the last row."""

    type: Literal["csv"]
    file: str = Field(
        description="path of a CSV file, relative to the scenario file, with the header t_s,x_m,y_m or "
        "t_s,V_m_s,omega_rad_s"
    )
    frame: Literal["world", "start"] | None = default(
        None, "frame of x_m and y_m: `world`, or `start` (the base at its start, x ahead); default: world"
    )
    # The file is read only once, so that later edits do not change a loaded scenario.
    _rows: Array = PrivateAttr()
    _are_rates: bool = PrivateAttr()

    @model_validator(mode="after")
    def _read(self) -> Self:
        columns, rows = read_table(self.file, PLACES, RATES, kind="a path")
        self._rows, self._are_rates = np.array(rows), columns == RATES
        if self._rows[0, 0] < 0.0:
            raise ValueError(f"{self.file}: begins at {self._rows[0, 0]:g} s; times must not be negative")
        if not np.abs(self._rows).max() < 1e9 or np.diff(self._rows[:, 0]).min() < 1e-9:
            raise ValueError(f"{self.file}: cannot be interpolated: numbers too large, or rows too close in time")
        if self._are_rates and self.frame is not None:
            raise error_at("frame", "has no effect on a file with rates; remove it")
        return self


@dataclass(frozen=True)
class Rates:
    """Motion with rates V and ω that are shape-preserving cubic functions of time."""

    rates: PchipInterpolator

    def motion(self, t: Array) -> Array:
        """Return distance [m] and turn [rad], the integrals of V and ω, at times t [s], shape (T, 2)."""
        return np.asarray(self.rates.antiderivative()(np.clip(t, *self.rates.x[[0, -1]])))


def build(config: Config, context: BuildContext) -> BasePath:
    """Build the motion from the rows of the file.

    Raises
    ------
    ModelError
        If the path does not start at the base and along its heading, or has a corner; the message names the row.
    """
    times, rows = config._rows[:, 0], config._rows[:, 1:]
    if config._are_rates:
        return Rates(PchipInterpolator(times, rows))
    points = seen_from_start(context.model.robot, rows, config.frame or "world")
    kept, distance = _along(points)
    if len(kept) < 2:
        raise ModelError(
            f"{config.file}: all rows are within {SPACING:g} m of the first; use type: hold for a stationary base"
        )
    names = [f"row {k + 1} ({rows[k, 0]:g}, {rows[k, 1]:g}) m, t = {times[k]:g} s" for k in kept]
    try:
        curve = PlaneCurve(points[kept], names, start_limit=TURN_LIMIT, turn_limit=TURN_LIMIT, samples=8)
    except ModelError as error:
        raise ModelError(f"{config.file}: {error}") from error
    return AlongCurve(curve, PchipInterpolator(times, distance))


def _along(points: Array) -> tuple[list[int], Array]:
    """Return the rows that define the curve, and the non-decreasing cumulative chord length at every row [m]."""
    kept = [0]
    begin, *others = points.tolist()
    for k, point in enumerate(others, 1):
        if math.dist(begin, point) >= SPACING:
            begin = point
            kept.append(k)
    # The curve ends at the last row, even if that row is close.
    kept[1:] = [*kept[1:-1], len(points) - 1] if len(kept) > 1 else []
    chords = np.append(np.hypot(*np.diff(points[kept], axis=0).T), 0.0)
    last = np.searchsorted(kept, np.arange(len(points)), side="right") - 1
    beyond = np.minimum(np.hypot(*(points - points[kept][last]).T), chords[last])
    return kept, np.maximum.accumulate(np.cumsum(chords)[last] - chords[last] + beyond)
