"""Figures of a brace plan: posture and forces along the path, heat by brace set, single braces, and robustness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from dynsim.draw.figures import style
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.style import BLACK, BLUE, GREEN, GREY, VARIANT_COLOURS, Array, number
from dynsim.draw.geometry.shapes import outline

# Maximum length of the arrow of the largest force, relative to the height of the view.
ARROW = 0.35
# An arm that leaves its vertical plane by less than this fraction of its length is not drawn from above.
FLAT = 0.02
# Values whose ratio exceeds this are drawn on a logarithmic axis.
WIDE = 20.0
# Margin on each side of the arm in the view from above [m].
MARGIN = 0.1
# Colours of surfaces, of a fixed or mobile base, and of every other row of a chart.
_SURFACE, _BASE, _BAND = "#D9D9D9", "#F2F2F2", "#F4F4F4"
# Markers of plans by number of braces; size of letters of small texts [point].
_MARKERS, _SMALL = "osD^vP*", 7.0
# Heights of a row of a chart, and of title, legend and axis [inch]; share of the width for labels of rows.
_ROW, _ROOM, _LABELS = 0.26, 1.2, 0.42


@dataclass(frozen=True)
class Pose:
    """Posture of the arm at one time; coordinates are along its heading, to its left, and up [m].

    Attributes
    ----------
    time : float
        Time [s].
    lines : sequence of (2, 3) ndarray
        Both ends of each link.
    points, forces : (c, 3) ndarray
        Points [m] and forces [N] of the braces.
    centres : (c, 3) ndarray
        Centres of the braces, which are spheres about points of the arm [m].
    """

    time: float
    lines: Sequence[Array]
    points: Array
    forces: Array
    centres: Array


@dataclass(frozen=True)
class CornerRun:
    """Simulated run of a plan with errors of friction and surfaces.

    Attributes
    ----------
    label : str
        Errors.
    heat, heat_limit : float
        Mean heat and its limit, relative to the planned heat; the heat is NaN if the run ended early.
    error, error_limit : float
        Rms error of the hand and its limit [mm]; the error is NaN if the run ended early.
    rejected : bool
        Whether the run rejects the plan, by these limits or for another reason.
    """

    label: str
    heat: float
    heat_limit: float
    error: float
    error_limit: float
    rejected: bool


@dataclass(frozen=True)
class PlanPicture:
    """Content of the figures of a plan.

    Attributes
    ----------
    title : str
        Title of the scenario.
    poses : sequence of Pose
        Poses of the best plan.
    path : (T, 3) ndarray
        Hand path [m], in the coordinates of the poses.
    braces : sequence of str
        Names of the braces of the best plan, in the order of their points.
    ground : tuple of ndarray
        Distance from the nearest surface on a vertical grid: along, up, and (up, along) [m].
    tops : tuple of ndarray or None
        The same on a horizontal grid at the height of the braces: along, left, and (left, along); None without braces.
    base : sequence of (n, 3) ndarray
        Corners of the solids of a fixed or mobile base [m].
    sets : mapping of int to sequence
        Labels and heat [W] of brace sets, by number of braces; the first set for each number is the planner's answer.
    survives : mapping of int to bool or None
        Whether each answer survives verification.
    singles : mapping of str to float
        Heat of single braces by candidate [W].
    corners : mapping of int to sequence of CornerRun
        Simulated runs of each answer, by number of braces; the first run is as planned.
    """

    title: str
    poses: Sequence[Pose]
    path: Array
    braces: Sequence[str]
    ground: tuple[Array, Array, Array]
    tops: tuple[Array, Array, Array] | None
    base: Sequence[Array]
    sets: Mapping[int, Sequence[tuple[str, float]]]
    survives: Mapping[int, bool | None]
    singles: Mapping[str, float]
    corners: Mapping[int, Sequence[CornerRun]]


def posture(picture: PlanPicture) -> Figure | None:
    """Draw the best plan at several times with brace forces, and also from above if the arm leaves its plane."""
    if not picture.poses:
        return None
    along, up, _ = picture.ground
    drawn = np.vstack([picture.path, *(line for pose in picture.poses for line in pose.lines), *picture.base])
    flat = np.ptp(drawn[:, 1]) < FLAT * np.ptp(along)
    shapes = [float(np.ptp(up) / np.ptp(along))]
    if not flat:
        shapes.append(float((np.ptp(drawn[:, 1]) + 2.0 * MARGIN) / np.ptp(along)))
    height = min((style.width() - 0.7) * sum(shapes) + 0.35 * len(shapes), 8.0) + 0.6
    figure = style.new_figure(height, f"{picture.title}: posture and forces of the best plan")
    views = figure.subplots(len(shapes), 1, squeeze=False, sharex=True, height_ratios=shapes)[:, 0]
    # Most arrows start below the braces and must stay within the view.
    lowest = min(pose.points[:, 2].min(initial=up[-1]) for pose in picture.poses)
    length = min(ARROW * float(np.ptp(up)), float(lowest - up[0]))
    largest = max(float(np.linalg.norm(pose.forces, axis=1).max(initial=0.0)) for pose in picture.poses)
    surfaces = (picture.ground, picture.tops)
    for axes, row, name, solid in zip(views, (2, 1), ("height [m]", "left [m]"), surfaces, strict=False):
        seen = [0, row]
        # A surface that is everywhere, such as a floor from above, is not drawn.
        if solid is not None and solid[2].min() < 0.0 < solid[2].max():
            axes.contourf(*solid, levels=[-1e9, 0.0], colors=[_SURFACE])
            axes.contour(*solid, levels=[0.0], colors=[GREY], linewidths=0.8)
        _draw_base(axes, picture, seen)
        _draw_poses(axes, picture, seen, largest, length)
        axes.plot(*picture.path[:, seen].T, color=GREEN, linewidth=2.0, label="path of the hand")
        axes.set(ylabel=name, aspect="equal")
    views[0].set(xlim=(along[0], along[-1]), ylim=(up[0], up[-1]))
    if largest > 0.0:
        _draw_scale(views[0], picture, largest, length)
    if not flat:
        views[1].set_ylim(drawn[:, 1].min() - MARGIN, drawn[:, 1].max() + MARGIN)
    views[-1].set_xlabel("distance along the heading [m]")
    style.legend_below(figure, [views[0]], 3)
    times = ", ".join(number(pose.time, 2) for pose in picture.poses)
    braced = " Arrows: normal forces on the arm. Circles: braces." if largest > 0.0 else ""
    base = "" if picture.base else " Square: base."
    figure.note(f"Postures at t = {times} s, from faint to dark.{braced}{base}")
    return figure


def _draw_base(axes: Axes, picture: PlanPicture, seen: list[int]) -> None:
    """Draw the outlines of the base and a column up to the first joint; a base without solids is a mark."""
    joint = picture.poses[0].lines[0][0]
    look: dict[str, Any] = {"facecolor": _BASE, "edgecolor": GREY, "linewidth": 0.8, "zorder": 1.5}
    if picture.base:
        for corners in picture.base:
            axes.add_patch(Polygon(outline(corners[:, seen]), **look))
        solids = np.vstack(picture.base)
        nearest = np.clip(joint, solids.min(axis=0), solids.max(axis=0))
        axes.plot(*np.array([nearest, joint])[:, seen].T, color=GREY, linewidth=4.0, solid_capstyle="butt", zorder=1.6)
    else:
        axes.plot(*joint[seen], color=GREY, marker="s", markersize=8.0, zorder=1.5)


def _draw_poses(axes: Axes, picture: PlanPicture, seen: list[int], largest: float, length: float) -> None:
    """Draw links, braces and forces, and number the braces in the last pose; the legend contains their names."""
    for k, pose in enumerate(picture.poses):
        shade = 0.25 + 0.75 * (k + 1) / len(picture.poses)
        for line in pose.lines:
            axes.plot(*line[:, seen].T, color=BLUE, alpha=shade, marker="o", markersize=2.5, linewidth=1.6)
        for point, centre in zip(pose.points, pose.centres, strict=True):
            radius = float(np.linalg.norm(centre - point))
            axes.add_patch(Circle(centre[seen], radius, facecolor="none", edgecolor=BLACK, alpha=shade, linewidth=0.8))
        for point, force in zip(pose.points[:, seen], pose.forces[:, seen] / (largest or 1.0) * length, strict=True):
            if np.linalg.norm(force) > 0.02 * length:
                _arrow(axes, point - force, point, alpha=shade)
    for k, (name, point) in enumerate(zip(picture.braces, picture.poses[-1].points[:, seen], strict=True), start=1):
        axes.annotate(
            f"{k}",
            point,
            xytext=(7.0, -8.0),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=style.letters(7.5),
            fontweight="bold",
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )
        axes.plot([], [], color=BLACK, marker=f"${k}$", markeredgewidth=0.2, linestyle="none", label=name)


def _arrow(axes: Axes, start: Array, end: Array, **look: Any) -> None:
    arrow = {"arrowstyle": "-|>", "color": BLACK, "shrinkA": 0.0, "shrinkB": 0.0, **look}
    axes.annotate("", xy=(end[0], end[1]), xytext=(start[0], start[1]), arrowprops=arrow)


def _draw_scale(axes: Axes, picture: PlanPicture, largest: float, length: float) -> None:
    """Draw an arrow for a round force in the upper corner that is farther from the arm."""
    power = 10.0 ** np.floor(np.log10(largest))
    force = next(step * power for step in (5.0, 2.0, 1.0) if step * power <= largest)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    tip = high - 0.05 * (high - low)
    corners = [np.array([left + share * (right - left), tip]) for share in (0.03, 0.9)]
    drawn = np.vstack([*(line for pose in picture.poses for line in pose.lines), picture.path])[:, [0, 2]]
    corner = max(corners, key=lambda point: np.linalg.norm(drawn - point, axis=1).min())
    _arrow(axes, corner - [0.0, length * force / largest], corner)
    axes.annotate(
        f"{force:g} N",
        (corner[0], corner[1]),
        xytext=(5.0, -1.0),
        textcoords="offset points",
        va="top",
        fontsize=style.letters(7.5),
    )


def heat_by_set(picture: PlanPicture) -> Figure | None:
    """Draw the planned heat of the best brace sets of each size; answers are filled and show their simulated heat."""
    rows = [(count, label, heat, k) for count, sets in picture.sets.items() for k, (label, heat) in enumerate(sets)]
    if not rows:
        return None
    marks, runs = [], []
    for count, _, heat, k in rows:
        corners = picture.corners.get(count, ())
        lost = k == 0 and picture.survives.get(count) is False
        marks.append("rejected answer" if lost else "answer" if k == 0 else "other set")
        runs.append(corners[0].heat * heat if k == 0 and corners else np.nan)
    labels, surface = _without_surface([label for _, label, _, _ in rows])
    title = f"{picture.title}: heat of the motors by brace set{surface}"
    figure = _dots(title, labels, [heat for _, _, heat, _ in rows], marks, "mean heat, planned [W]", runs)
    for y in range(1, len(rows)):
        if rows[y][0] != rows[y - 1][0]:
            figure.axes[0].axhline(y - 0.5, color=GREY, linewidth=0.5)
    return figure


def single_braces(picture: PlanPicture) -> Figure | None:
    """Draw the minimum heat with one brace for each braced point, in the middle of the path and without slip."""
    if len(picture.singles) < 2:
        return None
    heats = list(picture.singles.values())
    marks = ["minimum" if heat == min(heats) else "other point" for heat in heats]
    labels, surface = _without_surface(list(picture.singles))
    title = f"{picture.title}: one brace{surface}, by braced point"
    return _dots(title, labels, heats, marks, "minimum heat at one posture, no slip [W]")


def _without_surface(labels: Sequence[str]) -> tuple[list[str], str]:
    """Return labels without the name of the surface if it is the same for all braces, and a text with its name."""
    parts = [[brace.rpartition(" on ") for brace in label.split(", ")] for label in labels]
    surfaces = {surface for braces in parts for point, _, surface in braces if point}
    if len(surfaces) != 1:
        return list(labels), ""
    return [", ".join(point or name for point, _, name in braces) for braces in parts], f" on {surfaces.pop()}"


def _row(labels: Sequence[str]) -> float:
    """Return the height of a row with labels of several lines [inch]."""
    return max(_ROW, 1.35 * style.letters(_SMALL) / 72.0 * max(label.count("\n") + 1 for label in labels))


def _dots(
    title: str,
    labels: Sequence[str],
    values: Sequence[float],
    marks: Sequence[str],
    axis: str,
    runs: Sequence[float] = (),
) -> Figure:
    """Draw a row with a dot and its number for each value, and a line for each simulated value in ``runs``.

    Bars would have no natural origin on the logarithmic axis that a wide range requires.
    """
    size = style.letters(_SMALL)
    names = [style.broken(label, _LABELS * style.width(), size) for label in labels]
    figure = style.new_figure(_ROOM + _row(names) * len(values), title)
    axes = figure.subplots()
    for y, (value, mark) in enumerate(zip(values, marks, strict=True)):
        look: dict[str, Any] = {"marker": "X" if mark.startswith("rejected") else "o", "color": BLUE, "markersize": 6.0}
        face = "white" if mark.startswith("other") else BLUE
        axes.plot(value, y, linestyle="none", markerfacecolor=face, clip_on=False, zorder=3, label=mark, **look)
        axes.text(
            1.02, y, f"{float(f'{value:.3g}'):g} W", transform=axes.get_yaxis_transform(), va="center", fontsize=size
        )
    for y, run in enumerate(runs):
        if np.isfinite(run):
            axes.plot(run, y, "|", color=BLACK, markersize=11.0, clip_on=False, zorder=4, label="simulated run")
    everything = [*values, *(run for run in runs if np.isfinite(run))]
    low, high = min(everything), max(everything)
    axes.set_yticks(range(len(names)), names, fontsize=size)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel(style.broken(axis, 0.5 * style.width()))
    if high > WIDE * low > 0.0:
        axes.set_xlim(low / (high / low) ** 0.05, high * (high / low) ** 0.05)
        style.log_axis(axes, "x")
    else:
        axes.set_xlim(0.0, 1.1 * high or 1.0)
    style.legend_above(axes, columns=4)
    return figure


def robustness(picture: PlanPicture) -> Figure | None:
    """Draw heat and hand error of the answers in scenes with errors, with the limits that a plan must meet."""
    shown = {count: corners for count, corners in picture.corners.items() if len(corners) > 1}
    if not shown:
        return None
    first = next(iter(shown.values()))
    size = style.letters(_SMALL)
    names = [style.broken(corner.label, 0.3 * style.width(), size) for corner in first]
    row = max(0.07 * len(shown) + 0.08, _row(names))
    figure = style.new_figure(
        _ROOM + row * len(names), f"{picture.title}: simulated runs with errors of friction and surfaces"
    )
    panels = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(names))
    quantities = (("heat", "heat / planned heat"), ("error", "hand error, rms [mm]"))
    for axes, (key, name) in zip(panels, quantities, strict=True):
        values = {count: np.array([getattr(corner, key) for corner in corners]) for count, corners in shown.items()}
        limits = np.array([getattr(corner, f"{key}_limit") for corner in first])
        most = max(float(np.nanmax(array, initial=0.0)) for array in (limits, *values.values()))
        if most > WIDE * limits.max():
            least = min(float(np.nanmin(array)) for array in (limits, *values.values()))
            axes.set_xlim(0.8 * max(least, 1e-3 * most), 1.5 * most)
            style.log_axis(axes, "x")
        else:
            axes.set_xlim(-0.03 * most, 1.08 * most)
            axes.xaxis.set_major_locator(MaxNLocator(4 if style.narrow() else 7, steps=(1, 2, 5, 10)))
        for y in rows[::2]:
            axes.axhspan(y - 0.5, y + 0.5, color=_BAND, linewidth=0, zorder=0)
        for k, (count, corners) in enumerate(shown.items()):
            at = rows + 0.8 * ((k + 0.5) / len(shown) - 0.5)
            lost = np.array([corner.rejected for corner in corners])
            verdict = "survives" if picture.survives.get(count) else "rejected"
            label = f"{count} brace{'' if count == 1 else 's'}: {verdict}"
            look = {"color": VARIANT_COLOURS[k % 7], "marker": _MARKERS[k % 7]}
            axes.plot(values[count], at, linestyle="none", markersize=4.0, label=label, **look)
            # Runs that ended early are at the edge.
            ends = np.where(np.isfinite(values[count]), values[count], axes.get_xlim()[1])
            axes.plot(ends[lost], at[lost], "x", color=BLACK, markersize=6.0, zorder=4)
        axes.vlines(limits, rows - 0.5, rows + 0.5, color=BLACK, linestyle=(0, (3, 2)), linewidth=1.0, label="limit")
        if any(corner.rejected for corners in shown.values() for corner in corners):
            axes.plot([], [], "x", color=BLACK, markersize=6.0, label="rejects the plan")
        axes.grid(visible=False, axis="y")
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_yticks(rows, names, fontsize=size)
        axes.set_xlabel(style.broken(name, 0.3 * style.width()))
    style.legend_below(figure, [panels[0]], 4)
    figure.note(
        "A plan survives if, in every run, heat and error are within the limits, only the braces touch, and no motor, "
        "joint or base reaches a limit."
    )
    if any(not np.isfinite(corner.heat) for corners in shown.values() for corner in corners):
        figure.note("Crosses at the right edge: runs that ended early.")
    if lacking := [str(count) for count in picture.corners if count not in shown]:
        figure.note(f"Number of braces {', '.join(lacking)}: rejected as planned; errors were not simulated.")
    return figure


FIGURES = {
    "plan_posture": posture,
    "plan_heat": heat_by_set,
    "plan_single_braces": single_braces,
    "plan_robustness": robustness,
}


def draw_plan_figures(picture: PlanPicture, folder: Path, kind: str, look: Look | None = None) -> list[Path]:
    """Draw all figures of a plan to a folder; return the files."""
    with style.look(look):
        return style.save_all(FIGURES, picture, folder, kind)
