"""Figures of a brace plan: posture and forces along the path, heat by brace set, single braces, and robustness."""

from __future__ import annotations

import re
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
from dynsim.record.quantities import Quantity, rounded, summary_quantity

# Length of the arrow of the largest force, and of the number at its tail, relative to the length of the view.
ARROW, TAIL = 0.08, 0.07
# An arm that leaves its vertical plane by less than this fraction of its length is not drawn from above.
FLAT = 0.02
# Values whose ratio exceeds this are drawn on a logarithmic axis.
WIDE = 20.0
# Margin around the arm in a view [m].
MARGIN = 0.1
# Colours of surfaces, of a fixed or mobile base, and of every other row of a chart.
_SURFACE, _BASE, _BAND = "#D9D9D9", "#F2F2F2", "#F4F4F4"
# Markers of plans by number of braces; size of letters of small texts [point].
_MARKERS, _SMALL = "osD^vP*", 7.0
# Heights of a row of a chart, and of title, legend and axis [inch]; share of the width for labels of rows.
_ROW, _ROOM, _LABELS = 0.26, 1.2, 0.42
# Marks of brace sets.
_BEST, _REJECTED, _OTHER = "best of its size", "rejected", "other set"


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
        Mean heat and its limit, relative to the run without errors; the heat is NaN if the run ended early. NaN: no
        limit.
    error, error_limit : float
        Rms error of the hand and its limit [mm]; the error is NaN if the run ended early. NaN: no limit.
    reason : str
        Reason why the run rejects the plan, such as a limit; "" if it does not.
    """

    label: str
    heat: float
    heat_limit: float
    error: float
    error_limit: float
    reason: str = ""


@dataclass(frozen=True)
class VariedPlans:
    """Best plans for several values of a key.

    Attributes
    ----------
    key : str
        Column of the values.
    axis : Quantity
        Name and unit of the values.
    series : mapping of str to sequence
        Table rows of the plans by name of the curve; a row without a plan has no heat.
    limits : mapping of str to float
        Limits of required columns.
    """

    key: str
    axis: Quantity
    series: Mapping[str, Sequence[Mapping[str, Any]]]
    limits: Mapping[str, float]


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
        Labels and heat [W] of brace sets, by number of braces; the first set for each number is the best.
    survives : mapping of int to bool or None
        Whether each best set survives verification.
    singles : mapping of str to float
        Heat of single braces by candidate [W].
    corners : mapping of int to sequence of CornerRun
        Simulated runs of each best set, by number of braces; the first run is as planned.
    simulated : mapping of int to float
        Heat of the run as planned of each best set [W], by number of braces.
    varied : VariedPlans or None
        Plans for several values of a key; this plan is the best of them.
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
    simulated: Mapping[int, float]
    varied: VariedPlans | None = None


def posture(picture: PlanPicture) -> Figure | None:
    """Draw the best plan at several times with brace forces, and also from above if the arm leaves its plane."""
    if not picture.poses:
        return None
    up = picture.ground[1]
    last = picture.poses[-1]
    drawn = np.vstack([picture.path, *(line for pose in picture.poses for line in pose.lines), *picture.base])
    span, sizes = float(np.ptp(drawn[:, 0])), np.linalg.norm(last.forces, axis=1, keepdims=True)
    arrows = ARROW * span * last.forces / (sizes.max(initial=0.0) or 1.0)
    # The numbers at the tails of the arrows are within the view.
    tails = last.points - arrows - TAIL * span * last.forces / np.where(sizes > 0.0, sizes, 1.0)
    flat = np.ptp(drawn[:, 1]) < FLAT * span
    limits = np.vstack([drawn - MARGIN, drawn + MARGIN, tails])
    low, high = limits.min(axis=0), limits.max(axis=0)
    low[2], high[2] = max(low[2], up[0]), min(high[2], up[-1])
    shapes = (high - low)[[2] if flat else [2, 1]] / (high - low)[0]
    height = min((style.width() - 0.7) * float(shapes.sum()) + 0.35 * len(shapes), 8.0) + 0.6
    subject = "posture and forces of the best plan" if picture.braces else "posture of the best plan, without braces"
    figure = style.new_figure(height, f"{picture.title}: {subject}")
    views = figure.subplots(len(shapes), 1, squeeze=False, sharex=True, height_ratios=shapes)[:, 0]
    surfaces = (picture.ground, picture.tops)
    for axes, row, name, solid in zip(views, (2, 1), ("height [m]", "to the left [m]"), surfaces, strict=False):
        seen = [0, row]
        # A surface that is everywhere, such as a floor from above, is not drawn.
        if solid is not None and solid[2].min() < 0.0 < solid[2].max():
            axes.contourf(*solid, levels=[-1e9, 0.0], colors=[_SURFACE])
            axes.contour(*solid, levels=[0.0], colors=[GREY], linewidths=0.8)
        _draw_base(axes, picture, seen)
        _draw_poses(axes, picture, seen, arrows)
        axes.plot(*picture.path[:, seen].T, color=GREEN, linewidth=2.0, label="path of the hand")
        axes.set(ylabel=name, aspect="equal", xlim=(low[0], high[0]), ylim=(low[row], high[row]))
    views[-1].set_xlabel("distance along the heading [m]")
    style.legend_below(figure, [views[0]], 3)
    times = ", ".join(number(pose.time, 2) for pose in picture.poses)
    braced = " Arrows: normal forces on the arm in the dark posture. Black circles: braces." if picture.braces else ""
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


def _draw_poses(axes: Axes, picture: PlanPicture, seen: list[int], arrows: Array) -> None:
    """Draw links and braces, and the numbered forces of the last pose; the legend has their names and values."""
    for k, pose in enumerate(picture.poses):
        shade = 0.2 + 0.8 * ((k + 1) / len(picture.poses)) ** 2
        for line in pose.lines:
            axes.plot(*line[:, seen].T, color=BLUE, alpha=shade, marker="o", markersize=2.0, linewidth=1.2)
        for point, centre in zip(pose.points, pose.centres, strict=True):
            radius = float(np.linalg.norm(centre - point))
            axes.add_patch(Circle(centre[seen], radius, facecolor="none", edgecolor=BLACK, alpha=shade, linewidth=0.8))
    last = picture.poses[-1]
    size = style.letters(_SMALL)
    for k, (name, point, centre, arrow) in enumerate(
        zip(picture.braces, last.points[:, seen], last.centres[:, seen], arrows[:, seen], strict=True), start=1
    ):
        # The circle of a thin link would be too small to be seen.
        axes.plot(*centre, "o", markersize=4.0, markerfacecolor="white", markeredgecolor=BLACK, zorder=4)
        tail, length = point - arrow, float(np.linalg.norm(arrow))
        if length > 0.0:
            look: dict[str, Any] = {
                "arrowstyle": "-|>",
                "color": BLACK,
                "mutation_scale": 6.0,
                "shrinkA": 0,
                "shrinkB": 0,
            }
            axes.annotate("", xy=tuple(point), xytext=tuple(tail), arrowprops=look, zorder=5)
        # The number is at the tail of the arrow, or below the brace if the force points towards the reader.
        away = -arrow / length if length > 0.1 * float(np.linalg.norm(arrows[k - 1])) else np.array([0.0, -1.0])
        axes.annotate(
            f"{k}", tuple(tail), xytext=tuple(1.2 * size * away), textcoords="offset points", ha="center", va="center",
            fontsize=size, fontweight="bold", zorder=6, path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )  # fmt: skip
        force = rounded(float(np.linalg.norm(last.forces[k - 1])), 2, "#")
        look = {"color": BLACK, "marker": f"${k}$", "markeredgewidth": 0.2, "linestyle": "none"}
        axes.plot([], [], label=f"{name}: {force} N", **look)


def heat_by_set(picture: PlanPicture) -> Figure | None:
    """Draw the planned heat of the best brace sets of each size; return None for a single set, which has no rival.

    The best set of each size is filled, and has its simulated heat.
    """
    rows = [(count, label, heat, k) for count, sets in picture.sets.items() for k, (label, heat) in enumerate(sets)]
    if len(rows) < 2:
        return None
    marks, runs = [], []
    for count, _, _, k in rows:
        lost = k == 0 and picture.survives.get(count) is False
        marks.append(_OTHER if k else _REJECTED if lost else _BEST)
        runs.append(picture.simulated.get(count, np.nan) if k == 0 else np.nan)
    labels, surface = _without_surface([label if count else "no braces" for count, label, _, _ in rows])
    title = f"{picture.title}: heat of the motors by brace set{surface}"
    figure = _dots(title, labels, [heat for _, _, heat, _ in rows], marks, "mean heat, planned [W]", runs)
    for y in range(1, len(rows)):
        if rows[y][0] != rows[y - 1][0]:
            figure.axes[0].axhline(y - 0.5, color=GREY, linewidth=0.5)
    verified = any(survives is not None for survives in picture.survives.values())
    survive = " of the sets that survive simulated errors of friction and surfaces"
    best = f"least simulated heat{survive}" if verified else "least planned heat"
    rejected = (
        " Rejected: no set of this size survives; the least simulated heat is drawn." if _REJECTED in marks else ""
    )
    figure.note(f"Size: number of braces. Best: {best}.{rejected}")
    return figure


def single_braces(picture: PlanPicture) -> Figure | None:
    """Draw the minimum heat with one brace for each braced point, in the middle of the path and without slip."""
    if len(picture.singles) < 2:
        return None
    heats = list(picture.singles.values())
    marks = ["minimum" if heat == min(heats) else "other point" for heat in heats]
    labels, surface = _without_surface(list(picture.singles))
    title = f"{picture.title}: heat of the motors with one brace{surface}"
    return _dots(title, labels, heats, marks, "minimum heat at mid-path, no slip [W]")


def _without_surface(labels: Sequence[str]) -> tuple[list[str], str]:
    """Return labels without the name of the surface if it is the same for all braces, and a text with its name."""
    surfaces = {surface for label in labels for surface in re.findall(r" on (.+?)(?=, | → |$)", label)}
    if len(surfaces) != 1:
        return list(labels), ""
    ending = f" on {surfaces.pop()}"
    return [re.sub(rf"{re.escape(ending)}(?=, | → |$)", "", label) for label in labels], ending


def _row(labels: Sequence[str]) -> float:
    """Return the height of a row with labels of several lines [inch]."""
    return max(_ROW, 1.65 * style.letters(_SMALL) / 72.0 * max(label.count("\n") + 1 for label in labels))


def _dots(
    title: str,
    labels: Sequence[str],
    values: Sequence[float],
    marks: Sequence[str],
    axis: str,
    runs: Sequence[float] = (),
) -> style.Drawing:
    """Draw a row with a dot and its number for each value, and a line for each simulated value in ``runs``.

    Bars would have no natural origin on the logarithmic axis that a wide range requires.
    """
    size = style.letters(_SMALL)
    names = [style.broken(label, _LABELS * style.width(), size) for label in labels]
    figure = style.new_figure(_ROOM + _row(names) * len(values), title)
    axes = figure.subplots()
    for y, (value, mark) in enumerate(zip(values, marks, strict=True)):
        look: dict[str, Any] = {"marker": "X" if mark == _REJECTED else "o", "color": BLUE, "markersize": 6.0}
        face = "white" if mark.startswith("other") else BLUE
        axes.plot(value, y, linestyle="none", markerfacecolor=face, clip_on=False, zorder=3, label=mark, **look)
        text = f"{rounded(value, 3, '#')} W"
        axes.text(1.02, y, text, transform=axes.get_yaxis_transform(), va="center", fontsize=size)
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
    row = max(0.085 * len(shown) + 0.08, _row(names))
    figure = style.new_figure(
        _ROOM + row * len(names), f"{picture.title}: simulated runs with errors of friction and surfaces"
    )
    panels = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(names))
    quantities = (("heat", "heat / heat without errors"), ("error", "hand error, rms [mm]"))
    for axes, (key, name) in zip(panels, quantities, strict=True):
        values = {count: np.array([getattr(corner, key) for corner in corners]) for count, corners in shown.items()}
        limits = np.array([getattr(corner, f"{key}_limit") for corner in first])
        bounded = np.isfinite(limits)
        most = max(float(np.nanmax(array, initial=0.0)) for array in (limits[bounded], *values.values()))
        if most > WIDE * limits[bounded].max(initial=0.0) > 0.0:
            least = min(float(np.nanmin(array)) for array in (limits[bounded], *values.values()))
            axes.set_xlim(0.8 * max(least, 1e-3 * most), 1.5 * most)
            style.log_axis(axes, "x")
        else:
            # A heat is compared with the run without errors, an error with zero.
            least = min(1.0, *(float(np.nanmin(array)) for array in values.values())) if key == "heat" else 0.0
            axes.set_xlim(least - 0.06 * (most - least), most + 0.08 * (most - least))
            axes.xaxis.set_major_locator(MaxNLocator(4 if style.narrow() else 7, steps=(1, 2, 5, 10)))
        for y in rows[::2]:
            axes.axhspan(y - 0.5, y + 0.5, color=_BAND, linewidth=0, zorder=0)
        for k, (count, corners) in enumerate(shown.items()):
            at = rows + 0.8 * ((k + 0.5) / len(shown) - 0.5)
            lost = np.array([bool(corner.reason) for corner in corners])
            label = f"{_braces(count)}: {'survives' if picture.survives.get(count) else 'rejected'}"
            look = {"color": VARIANT_COLOURS[k % 7], "marker": _MARKERS[k % 7]}
            axes.plot(values[count], at, linestyle="none", markersize=4.0, label=label, **look)
            # Runs that ended early are at the edge.
            ends = np.where(np.isfinite(values[count]), values[count], axes.get_xlim()[1])
            axes.plot(ends[lost], at[lost], "x", color=BLACK, markersize=6.0, zorder=4)
        axes.vlines(
            limits[bounded],
            rows[bounded] - 0.5,
            rows[bounded] + 0.5,
            color=BLACK,
            linestyle=(0, (3, 2)),
            linewidth=1.0,
            label="limit",
        )
        if any(corner.reason for corners in shown.values() for corner in corners):
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
    for count, corners in picture.corners.items():
        if first_lost := next((corner for corner in corners if corner.reason), None):
            case = f"Rejected with {first_lost.label}" if count in shown else "Rejected as planned, and so not drawn"
            figure.note(f"{case} ({_braces(count)}): {first_lost.reason}.")
    return figure


def varied(picture: PlanPicture) -> Figure | None:
    """Draw heat and required quantities of the best plans against a varied key, with the limits of requirements."""
    if picture.varied is None:
        return None
    plans = picture.varied
    rows = [row for series in plans.series.values() for row in series]
    metrics = {key: summary_quantity(key) for key in ("heat_W", *plans.limits)}
    metrics = {key: drawn.fitted(row.get(key) for row in rows) for key, drawn in metrics.items()}
    figure = style.new_figure(1.7 * len(metrics) + 1.0, f"{picture.title}: plans for each {plans.axis.name}")
    panels = figure.subplots(len(metrics), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (key, drawn) in zip(panels, metrics.items(), strict=True):
        values = []
        for k, (label, series) in enumerate(plans.series.items()):
            at = np.array([plans.axis.scale * row[plans.key] for row in series])
            numbers = [row.get(key) for row in series]
            y = np.array([np.nan if value is None else drawn.scale * value for value in numbers])
            lost = np.array([row.get("survives") is False for row in series])
            look: dict[str, Any] = {"color": VARIANT_COLOURS[k % 7], "marker": _MARKERS[k % 7], "markersize": 4.5}
            axes.plot(at, y, label=label or None, linewidth=1.0, **look)
            if lost.any():
                axes.plot(at[lost], y[lost], linestyle="none", markerfacecolor="white", zorder=3, **look)
            values += y[np.isfinite(y)].tolist()
        if key in plans.limits:
            limit = drawn.scale * plans.limits[key]
            axes.axhline(limit, color=BLACK, linestyle=(0, (3, 2)), linewidth=1.0, label="limit")
            values.append(limit)
        if values and max(values) > WIDE * min(values) > 0.0:
            style.log_axis(axes)
        else:
            axes.set_ylim(bottom=0.0)
        axes.set_ylabel(style.broken(drawn.label, 1.6))
    panels[-1].set_xlabel(style.broken(plans.axis.label))
    figure.align_ylabels(panels)
    style.legend_below(figure, list(panels), 3)
    figure.note("Each point: the number of braces with the least heat. Hollow: rejected; gaps: no plan.")
    return figure


def _braces(count: int) -> str:
    return f"{count or 'no'} brace{'' if count == 1 else 's'}"


FIGURES = {
    "plan_posture": posture,
    "plan_heat": heat_by_set,
    "plan_single_braces": single_braces,
    "plan_robustness": robustness,
    "plan_vary": varied,
}


def draw_plan_figures(picture: PlanPicture, folder: Path, kind: str, look: Look | None = None) -> list[Path]:
    """Draw all figures of a plan to a folder; return the files."""
    with style.look(look):
        return style.save_all(FIGURES, picture, folder, kind)
