"""A smooth curve through points on the ground at given times."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import BPoly

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.plane_curve import AlongCurve, PlaneCurve, seen_from_start
from dynsim.config.base import NonNegative, StrictConfig, check_waypoints

Point = Annotated[list[float], Field(min_length=2, max_length=2)]


class Config(StrictConfig):
    """From rest to rest through ``points_m`` at ``times_s``, the heading along the curve; held beyond them."""

    type: Literal["waypoints"]
    times_s: list[NonNegative] = Field(min_length=2)
    points_m: list[Point] = Field(min_length=2, description="x and y; the first is where the base starts")
    frame: Literal["world", "start"] = Field(
        default="world", description="of the points; start: that of the base at its start, x ahead"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_waypoints(self.times_s, self.points_m, "points_m")
        if not np.hypot(*np.diff(self.points_m, axis=0).T).min() > 0.0:
            raise ValueError("two neighbouring points_m are the same; a base that waits takes csv with V_m_s")
        return self


def build(config: Config, context: BuildContext) -> BasePath:
    """Cubic spline r(u) over the chords, from the heading at the start on, and u(t) quintic between two points.

    At the points u has no acceleration, and the harmonic mean of the mean speeds before and after; so it never goes
    back, and between two points alone it is minimum jerk.

    Raises
    ------
    ModelError
        The path starts elsewhere or sideways, or has a corner: with the point.
    """
    points = seen_from_start(context.model.robot, config.points_m, config.frame)
    entries = enumerate(zip(config.points_m, config.times_s, strict=True))
    names = [f"point {k} ({x:g}, {y:g}) m, t = {t:g} s" for k, ((x, y), t) in entries]
    curve = PlaneCurve(points, names, start_limit=0.5 * np.pi, turn_limit=np.pi, samples=128)
    speeds = np.diff(curve.nodes) / np.diff(config.times_s)
    middle = 2.0 / (1.0 / speeds[:-1] + 1.0 / speeds[1:])
    rates = np.concatenate([[0.0], middle, [0.0]])
    distance = BPoly.from_derivatives(config.times_s, np.stack([curve.nodes, rates, np.zeros_like(rates)], axis=1))
    return AlongCurve(curve, distance)
