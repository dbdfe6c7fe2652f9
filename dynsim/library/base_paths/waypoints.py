"""Smooth curve of a mobile base through points on the ground at specified times."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import BPoly

from dynsim.compile.control import BasePath
from dynsim.compile.protocols import BuildContext
from dynsim.compile.references.plane_curve import AlongCurve, PlaneCurve, seen_from_start
from dynsim.config.base import NonNegative, Pair, StrictConfig, check_waypoints, default


class Config(StrictConfig):
    """Motion from rest to rest through `points_m` at `times_s`, with the heading along the curve."""

    type: Literal["waypoints"]
    times_s: list[NonNegative] = Field(min_length=2, description="times of the points, increasing")
    points_m: list[Pair] = Field(min_length=2, description="x and y of the points; the base starts at the first")
    frame: Literal["world", "start"] = default(
        "world", "frame of the points: `world`, or `start` (the base at its start, x ahead)"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_waypoints(self.times_s, self.points_m, "points_m")
        if not np.hypot(*np.diff(self.points_m, axis=0).T).min() > 0.0:
            raise ValueError("points_m has two equal consecutive points; to make the base wait, use csv with V_m_s")
        return self


def build(config: Config, context: BuildContext) -> BasePath:
    """Build the curve: a cubic spline r(u) in the chord length u that starts along the heading, and quintics u(t).

    At the points, u(t) has zero acceleration, and its rate is the harmonic mean of the mean speeds before and after
    the point. The base therefore never reverses, and with only two points the motion has minimum jerk.

    Raises
    ------
    ModelError
        If the path does not start at the base and along its heading, or has a corner; the message names the point.
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
