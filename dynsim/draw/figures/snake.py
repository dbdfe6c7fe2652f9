"""Figures and animation of a snake run, and comparisons of runs, from their records alone.

The figures show postures in top and side view with grounded and lifted wheels and the support polygon; the controlled
variables and their targets; joint angles and limits; and cost, smallest singular value, support margin and modes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dynsim.draw import film
from dynsim.draw.figures import snake_tasks, style, tanaka2019
from dynsim.draw.figures.snake_view import (
    BODY,
    GROUND,
    HEAD,
    MIN_HEIGHT,
    NUMBERED,
    SYMBOLS,
    TARGET,
    View,
    error_axis,
    greek,
    interval_starts,
    limits,
    mode_chart,
    mode_starts,
    mode_steps,
    moments,
    overlay_margins,
    posture_grid,
    posture_strip,
)
from dynsim.record import Record
from dynsim.snake.lifting import snake_geometry

# Number of postures in an animation, in a row, and overlaid in one picture.
FRAMES, IN_A_ROW, IN_A_PICTURE = 50, 6, 7
# A logarithmic axis cannot show an error of exactly zero.
TINY = 1e-16
# Shades of grey for postures over time, because the lines next to them are coloured.
SHADES = LinearSegmentedColormap.from_list("shades", ["#CFCFCF", "#000000"])


def draw(record: Record, folder: Path, kind: str = "png") -> list[Path]:
    """Draw all figures of one run and the animation; return the files."""
    return [*style.save_all(figures(record), record, folder, kind), animate(record, folder / "animation.gif")]


def draw_comparison(records: Mapping[str, Record], folder: Path, kind: str = "png") -> list[Path]:
    """Draw overlays of variants and, for experiments of [T], comparisons with the paper; return the files."""
    scenarios = {record.summary["scenario"] for record in records.values()}
    written = tanaka2019.write_tables(scenarios.pop(), records, folder) if len(scenarios) == 1 else []
    return written + style.save_all(comparisons(records), records, folder, kind)


def figures(record: Record) -> dict[str, Callable[[Record], Figure]]:
    """Return the drawing functions of one run by file name."""
    return {
        "postures": postures,
        "overview": overview,
        "tracking": tracking,
        "joints": joints,
        "redundancy": redundancy,
        **snake_tasks.makers(record),
        **tanaka2019.figures_of_run(record),
    }


def comparisons(records: Mapping[str, Record]) -> dict[str, Callable[[Mapping[str, Record]], Figure]]:
    """Return the drawing functions for several runs by file name.

    Comparisons with [T] are included only if all runs have the same scenario.
    """
    scenarios = {record.summary["scenario"] for record in records.values()}
    published = tanaka2019.figures(scenarios.pop(), records) if len(scenarios) == 1 else {}
    return {"comparison": comparison, "postures": strips, **published}


def comparison(records: Mapping[str, Record]) -> Figure:
    """Draw cost, largest yaw angle relative to its limit, support margin and head error of all variants."""
    title = style.comparison_title(list(records.values()), "cost, angles, margin and error")
    figure = style.new_figure(7.0, title)
    axes = figure.subplots(4, 1, sharex=True)
    overlay_margins(axes[:3], records)
    for record in records.values():
        axes[3].semilogy(record.time, np.maximum(record["position_error"], TINY))
    error_axis(axes[3], *(record["position_error"] for record in records.values()))
    axes[3].set_ylabel("position error [m]")
    style.legend_beside(axes[0])
    axes[-1].set_xlabel("t [s]")
    return figure


def strips(records: Mapping[str, Record]) -> Figure:
    """Draw the postures of every variant over time, one row per variant."""
    lines = {}
    for name, record in records.items():
        views = [View(record, row) for row in moments(record, IN_A_ROW)]
        waiting = record.summary["waiting_s"]
        label = name.replace("_", "\n") + (f"\n(waited {waiting:.0f} s)" if waiting >= 0.5 else "")
        lines[label] = [(view, f"{view.time:.1f} s, mode {view.mode}") for view in views]
    title = style.comparison_title(list(records.values()), "postures over time")
    return posture_grid(title, lines, one_scale=False)


def postures(record: Record) -> Figure:
    """Draw postures over time: top view above, side view along the heading of the base part below."""
    views = [View(record, row) for row in moments(record, IN_A_ROW)]
    texts = [f"{view.time:.1f} s, mode {view.mode}" for view in views]
    return posture_strip(style.title(record, "postures over time"), list(zip(views, texts, strict=True)))


def overview(record: Record) -> Figure:
    """Draw the whole run from above: postures over time, path of the controlled point and its target.

    A robot that stays in place and works with its head is only a thin strip, so a side view is added below.
    """
    views = [View(record, row) for row in moments(record, IN_A_PICTURE)]
    x0, x1, y0, y1 = limits([*(view.project(view.points, above=True) for view in views), record["w"][:, :2]], 0.06)
    flat = y1 - y0 < MIN_HEIGHT * (x1 - x0)
    width = 6.4 if flat else 5.0
    high = width * (y1 - y0) / (x1 - x0)
    side = limits([view.project(view.points, above=False) for view in views], 0.06) if flat else (0.0, 1.0, 0.0, 0.0)
    low = width * (side[3] - side[2]) / (side[1] - side[0])
    height = max(high + low, 1.0) + 1.2 + 0.5 * flat
    figure = style.new_figure(height, style.title(record, "the run from above"), page=width + 1.4)
    grid = figure.subplots(1 + flat, 1, squeeze=False, height_ratios=[high, low] if flat else None)
    axis = grid[0, 0]
    shades = ScalarMappable(Normalize(0.0, record.time[-1]), matplotlib.colormaps["viridis_r"] if flat else SHADES)
    body = {"lw": 1.6 if flat else 4.0, "solid_capstyle": "round"}
    for panel, above in zip(grid[:, 0], (True, False), strict=False):
        for view in views:
            points, shade = view.project(view.points, above), shades.to_rgba(record.time[view.row])
            panel.plot(*points.T, "-", color=shade, **body)
            panel.plot(*points[0], "o", color=shade, ms=4 if flat else 6)
        panel.set_aspect("equal", adjustable="box")
    axis.plot(*record["w"][:, :2].T, color=HEAD, lw=1.0, label="controlled point")
    axis.plot(*record["w_target"][:, :2].T, "--", color=TARGET, lw=1.0, label="target")
    axis.plot(*record["base_pose"][:, :2].T, color=GROUND, lw=0.8, label="wheel pair 1")
    axis.set(xlabel="x [m]", ylabel="y [m]", xlim=(x0, x1), ylim=(y0, y1))
    if flat:
        below = grid[1, 0]
        below.axhline(0.0, color="#BBBBBB", lw=0.8, zorder=0)
        below.set(xlabel="along the heading of the base part [m]", ylabel="height [m]")
        below.set(xlim=side[:2], ylim=(min(side[2], -0.02), side[3]))
    figure.colorbar(shades, ax=grid.ravel().tolist(), label="posture at t [s]")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def tracking(record: Record) -> Figure:
    """Draw the six coordinates of the controlled point with their targets, and the errors."""
    figure = style.new_figure(6.2, style.title(record, "controlled point and its target"))
    axes = figure.subplots(4, 2, sharex=True)
    labels = record.labels["w"]
    for i, (name, axis) in enumerate(zip(labels, axes[:3].T.ravel(), strict=True)):
        axis.plot(record.time, record["w"][:, i], color=GROUND, label="controlled point")
        axis.plot(record.time, record["w_target"][:, i], "--", color=HEAD, lw=0.9, label="target")
        style.at_least(axis, 2e-3)
        axis.set_ylabel(f"{SYMBOLS.get(name, name)} [{'m' if i < 3 else 'rad'}]")
        style.shade(axis, record.time, record["gripper"] > 0, "#EEEEEE", "gripper closed")
    # Use a white background, so that grey entries are visible on an entirely grey panel.
    axes[0, 0].legend(facecolor="white", edgecolor="none")
    for axis, part, unit in zip(axes[3], ("position", "attitude"), ("m", "rad"), strict=True):
        error = record[f"{part}_error"]
        axis.semilogy(record.time, np.maximum(error, TINY), color=BODY)
        axis.set_ylabel(f"{part} error [{unit}]")
        error_axis(axis, error)
        axis.set_xlabel("t [s]")
    return figure


def joints(record: Record) -> Figure:
    """Draw the joint angles of the head and base part with their limits; dots mark joints excluded from allocation."""
    geometry = snake_geometry(record)
    n_h, pitch, upper, lower = geometry.head_joints, geometry.pitch, geometry.upper, geometry.lower
    phi, labels = record["phi"], record.labels["phi"]
    parts = [
        ("head yaw", np.flatnonzero(~pitch[:n_h])),
        ("head pitch", np.flatnonzero(pitch[:n_h])),
        ("base yaw", np.arange(n_h, len(labels))),
    ]
    figure = style.new_figure(5.9, style.title(record, "joint angles and their limits"))
    axes = figure.subplots(3, 1, sharex=True)
    for axis, (title, group) in zip(axes, parts, strict=True):
        for j in group:
            (line,) = axis.plot(record.time, phi[:, j], label=greek(labels[j]))
            out = record["at_limit"][:, j] > 0
            axis.plot(record.time[out], phi[out, j], ".", color=line.get_color(), ms=3)
        for limit in {*upper[group], *lower[group]}:
            axis.axhline(limit, color="black", ls="-.", lw=0.8)
        axis.set_ylabel(f"{title} [rad]")
        style.legend_beside(axis)
    axes[-1].set_xlabel("t [s]      (dash-dotted: limits; dots: joint excluded from allocation at its limit)")
    return figure


def redundancy(record: Record) -> Figure:
    """Draw modes (grounded wheels), cost, smallest singular value and support margin over time."""
    many = len(mode_starts(record)) > NUMBERED  # the mode numbers then have a separate panel
    ratios = [1.3, *([0.8] if many else []), 1, 1, 1]
    figure = style.new_figure(6.7 + 1.1 * many, style.title(record, "modes and margins"))
    axes = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)
    cost, sigma, margin = axes[-3:, 0]
    mode_chart(axes[0, 0], record)
    if many:
        mode_steps(axes[1, 0], record)
    cost.plot(record.time, record["cost"], color=GROUND)
    cost.set_ylabel("cost V")
    cost.set_ylim(bottom=0)
    _over_time(sigma, record, record["sigma_min"], many)
    sigma.set_ylabel("σ_min of B̃")
    sigma.set_ylim(bottom=0)
    _over_time(margin, record, 1e3 * record["support_margin"], many)
    margin.axhline(0.0, color=HEAD, ls="-.", lw=0.8)
    margin.set_ylabel("support margin [mm]")
    margin.set_ylim(bottom=min(0.0, 1e3 * float(record["support_margin"].min())) - 4)
    margin.set_xlabel("t [s]      (margin below zero: the robot tips)")
    return figure


def _over_time(axis: Axes, record: Record, values: NDArray[np.float64], many: bool) -> None:
    """Draw a line or, if ``many`` mode changes would fill the panel, its range and minimum in each interval."""
    if not many:
        axis.plot(record.time, values, color=GROUND)
        return
    starts = interval_starts(len(values))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    time = np.append(record.time[starts], record.time[-1])
    axis.stairs(high, time, baseline=low, fill=True, color=GROUND, alpha=0.25, lw=0, label="range")
    axis.plot(record.time[starts], low, color=GROUND, lw=1.0, label="lowest")
    style.legend_beside(axis)


def animate(record: Record, path: Path) -> Path:
    """Write a short film of the run."""
    fps = 10
    speed = (record.time[-1] - record.time[0]) * fps / (FRAMES - 1)
    return film.write({"": record}, path, size=(480, 420), fps=fps, speed=float(speed) or 1.0, plot="")
