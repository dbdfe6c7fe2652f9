"""Figures of a brace plan: posture and forces along the path, heat by brace set, single braces, and robustness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from dynsim.draw.figures import style
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.style import BLUE, GREEN, GREY, ORANGE, PULLING, Array, number

# Maximum length of the arrow of the largest force, relative to the height of the view.
ARROW = 0.35
# An arm that leaves its vertical plane by less than this fraction of its length is not drawn from above.
FLAT = 0.02
# Values whose ratio exceeds this are drawn on a logarithmic axis.
WIDE = 20.0
# Margin on each side of the arm in the view from above [m].
MARGIN = 0.1


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
    """

    time: float
    lines: Sequence[Array]
    points: Array
    forces: Array


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
        Distance from the nearest surface on a grid: along, up, and (up, along) [m].
    sets : mapping of int to sequence
        Labels and heat [W] of brace sets, by number of braces; the first set for each number is the planner's answer.
    survives : mapping of int to bool or None
        Whether each answer survives verification.
    singles : mapping of str to float
        Heat of single braces by candidate [W].
    corners : mapping of int to tuple
        For each answer, by number of braces: planned heat [W]; labels, heat [W] and hand error [mm] for each corner
        case.
    """

    title: str
    poses: Sequence[Pose]
    path: Array
    braces: Sequence[str]
    ground: tuple[Array, Array, Array]
    sets: Mapping[int, Sequence[tuple[str, float]]]
    survives: Mapping[int, bool | None]
    singles: Mapping[str, float]
    corners: Mapping[int, tuple[float, Sequence[tuple[str, float, float]]]]


def posture(picture: PlanPicture) -> Figure | None:
    """Draw the best plan at several times with brace forces, and also from above if the arm leaves its plane."""
    if not picture.poses:
        return None
    along, up, gap = picture.ground
    aside = np.concatenate([picture.path[:, 1], *(line[:, 1] for pose in picture.poses for line in pose.lines)])
    width = float(np.ptp(aside)) + 2.0 * MARGIN
    flat = np.ptp(aside) < FLAT * np.ptp(along)
    shapes = [float(np.ptp(up) / np.ptp(along)), *([] if flat else [width / float(np.ptp(along))])]
    height = min(1.2 + 6.6 * sum(shapes), 9.0)
    figure = style.new_figure(height, f"{picture.title}: posture and forces of the best plan")
    views = figure.subplots(len(shapes), 1, squeeze=False, sharex=True, height_ratios=shapes)[:, 0]
    side = views[0]
    side.contourf(along, up, gap, levels=[-1e9, 0.0], colors=["#D9D9D9"])
    side.contour(along, up, gap, levels=[0.0], colors=[GREY], linewidths=0.8)
    # Most arrows start below the braces and must stay within the view.
    lowest = min(pose.points[:, 2].min(initial=up[-1]) for pose in picture.poses)
    length = min(ARROW * float(np.ptp(up)), float(lowest - up[0]))
    largest = max(float(np.linalg.norm(pose.forces, axis=1).max(initial=0.0)) for pose in picture.poses)
    for axes, row, name in zip(views, (2, 1), ("up [m]", "left [m]"), strict=False):
        seen = [0, row]
        _draw_poses(axes, picture, seen, largest, length)
        axes.plot(*picture.path[:, seen].T, color=GREEN, linewidth=2.0, label="path of the hand")
        axes.set(ylabel=name, aspect="equal")
    if largest > 0.0:
        side.plot([], [], color=PULLING, label=f"forces on braces, max {number(largest, 3)} N")
    if not flat:
        views[1].set_ylim(aside.min() - MARGIN, aside.max() + MARGIN)
    views[-1].set_xlabel("along the heading [m]")
    style.legend_above(side, columns=2)
    return figure


def _draw_poses(axes: Axes, picture: PlanPicture, seen: list[int], largest: float, length: float) -> None:
    """Draw links and forces, and number the braces in the last pose; the legend contains their names."""
    for k, pose in enumerate(picture.poses):
        shade = 0.25 + 0.75 * (k + 1) / len(picture.poses)
        for line in pose.lines:
            axes.plot(*line[:, seen].T, color=BLUE, alpha=shade, marker="o", markersize=2.5, linewidth=1.6)
        if largest == 0.0:
            continue
        for point, force in zip(pose.points[:, seen], pose.forces[:, seen] / largest * length, strict=True):
            arrow = {"arrowstyle": "-|>", "color": PULLING, "alpha": shade, "shrinkA": 0.0, "shrinkB": 0.0}
            if np.linalg.norm(force) > 0.02 * length:
                axes.annotate("", xy=point, xytext=point - force, arrowprops=arrow)
            else:
                axes.plot(*point, color=PULLING, alpha=shade, marker="o", markersize=4.0)
    for k, (name, point) in enumerate(zip(picture.braces, picture.poses[-1].points[:, seen], strict=True), start=1):
        axes.annotate(
            f"{k}",
            point,
            xytext=(6.0, -8.0),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=style.letters(7.5),
            color=PULLING,
            fontweight="bold",
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )
        axes.plot([], [], color=PULLING, marker=f"${k}$", linestyle="none", label=name)


def heat_by_set(picture: PlanPicture) -> Figure | None:
    """Draw the planned heat of the best brace sets of each size; answers are filled and show their simulated heat."""
    rows = [(count, label, heat, k) for count, sets in picture.sets.items() for k, (label, heat) in enumerate(sets)]
    if not rows:
        return None
    texts, marks = [], []
    for count, _, heat, k in rows:
        corners = picture.corners.get(count, (heat, ()))[1]
        lost = k == 0 and picture.survives.get(count) is False
        run = f", simulated {number(corners[0][1], 3)} W" if k == 0 and corners and np.isfinite(corners[0][1]) else ""
        texts.append(f"{number(heat, 3)} W{run}{', does not survive' if lost else ''}")
        marks.append({"marker": "X" if lost else "o", "markerfacecolor": BLUE if k == 0 else "white"})
    labels = [f"{count}: {label}" for count, label, _, _ in rows]
    title = f"{picture.title}: motor heat by brace set, answers filled"
    return _dots(title, labels, [heat for _, _, heat, _ in rows], texts, marks, "mean heat, planned [W]")


def single_braces(picture: PlanPicture) -> Figure | None:
    """Draw the minimum heat with one brace for each braced point, in the middle of the path and without slip."""
    if not picture.singles:
        return None
    heats = list(picture.singles.values())
    best = min(heats)
    texts = [f"{number(heat, 3)} W{', minimum' if heat == best else ''}" for heat in heats]
    marks = [{"marker": "o", "markerfacecolor": BLUE if heat == best else "white"} for heat in heats]
    title = f"{picture.title}: one brace, by braced point"
    return _dots(title, list(picture.singles), heats, texts, marks, "minimum heat at one posture, no slip [W]")


def _dots(
    title: str,
    labels: Sequence[str],
    values: Sequence[float],
    texts: Sequence[str],
    marks: Sequence[Mapping[str, Any]],
    axis: str,
) -> Figure:
    """Draw a row with a dot and its text for each value.

    Bars would have no natural origin on the logarithmic axis that a wide range requires.
    """
    figure = style.new_figure(1.1 + 0.26 * len(values), title)
    axes = figure.subplots()
    low, high = min(values), max(values)
    wide = high > WIDE * low > 0.0
    middle = np.sqrt(low * high) if wide else 0.5 * high
    for y, (value, text, mark) in enumerate(zip(values, texts, marks, strict=True)):
        axes.plot(value, y, color=BLUE, markersize=6.0, linestyle="none", clip_on=False, zorder=3, **mark)
        # Place the text towards the middle, where there is space.
        offset, side = (7.0, "left") if value <= middle else (-7.0, "right")
        axes.annotate(
            text,
            (value, y),
            xytext=(offset, 0.0),
            textcoords="offset points",
            ha=side,
            va="center",
            fontsize=style.letters(7.0),
        )
    axes.set_yticks(range(len(labels)), labels, fontsize=style.letters(7.0))
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel(axis)
    if wide:
        axes.set_xlim(low / (high / low) ** 0.05, high * (high / low) ** 0.05)
        style.log_axis(axes, "x")
    else:
        axes.set_xlim(0.0, 1.1 * high or 1.0)
    return figure


def robustness(picture: PlanPicture) -> Figure | None:
    """Draw the heat (relative to the plan) and hand error of the answers in scenes that differ from the plan."""
    shown = {count: corners for count, corners in picture.corners.items() if len(corners[1]) > 1}
    if not shown:
        return None
    figure = style.new_figure(4.2, f"{picture.title}: plans in scenes with errors")
    upper, lower = figure.subplots(2, 1, sharex=True)
    labels = [label for label, _, _ in next(iter(shown.values()))[1]]
    width = 0.8 / len(shown)
    for k, (count, (planned, corners)) in enumerate(shown.items()):
        at = np.arange(len(corners)) + (k - 0.5 * (len(shown) - 1)) * width
        colour = (BLUE, GREEN, ORANGE, GREY, PULLING)[k % 5]
        label = f"{count} brace{'' if count == 1 else 's'}"
        upper.bar(at, [heat / planned for _, heat, _ in corners], width, color=colour, label=label)
        lower.bar(at, [error for _, _, error in corners], width, color=colour)
    upper.axhline(1.0, color="black", linewidth=0.6)
    upper.set_ylabel("heat / planned heat")
    lower.set_ylabel("hand error, rms [mm]")
    lower.set_xticks(range(len(labels)), labels, rotation=25.0, ha="right", fontsize=style.letters(6.5))
    style.legend_above(upper, columns=len(shown))
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
