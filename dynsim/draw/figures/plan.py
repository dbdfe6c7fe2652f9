"""Figures of a plan of braces: posture with forces along the path, heat by set, map of single braces, robustness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from dynsim.draw.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PULLING,
    Array,
    legend_above,
    log_axis,
    new_figure,
    number,
    save_all,
)

# Largest length of the arrow of the greatest force, in parts of the height of the view.
ARROW = 0.35
# An arm that leaves its plane by less than this part of its length is not drawn from above.
FLAT = 0.02
# Values whose ratio is larger are drawn on a logarithmic axis.
WIDE = 20.0
# Margin to either side of an arm in the view from above [m].
MARGIN = 0.1


@dataclass(frozen=True)
class Pose:
    """The arm at one instant: along its heading, to the left of it, and up [m].

    Attributes
    ----------
    time : [s]
    lines : of each link both ends, (2, 3)
    points, forces : of the braces, (c, 3) [m] and [N]
    """

    time: float
    lines: Sequence[Array]
    points: Array
    forces: Array


@dataclass(frozen=True)
class PlanPicture:
    """What the figures of a plan show.

    Attributes
    ----------
    title : of the scenario
    poses : of the best plan; path: of the hand, (T, 3) [m], as those of the poses
    braces : names of the best plan's, in the order of their points
    ground : distance from the nearest surface on a grid: along, up, and (up, along) [m]
    sets : label and heat [W] by number of braces; the first of each is the answer
    survives : of the answers
    singles : heat of single braces by candidate [W]
    corners : of the answers, by number of braces: labels, heat [W] and hand's error [mm]; planned heat
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
    """The best plan at some instants with the forces of its braces, from above too where it leaves its plane."""
    if not picture.poses:
        return None
    along, up, gap = picture.ground
    aside = np.concatenate([picture.path[:, 1], *(line[:, 1] for pose in picture.poses for line in pose.lines)])
    width = float(np.ptp(aside)) + 2.0 * MARGIN
    flat = np.ptp(aside) < FLAT * np.ptp(along)
    shapes = [float(np.ptp(up) / np.ptp(along)), *([] if flat else [width / float(np.ptp(along))])]
    height = min(1.2 + 6.6 * sum(shapes), 9.0)
    figure = new_figure(height, f"{picture.title}: posture and forces of the best plan")
    views = figure.subplots(len(shapes), 1, squeeze=False, sharex=True, height_ratios=shapes)[:, 0]
    side = views[0]
    side.contourf(along, up, gap, levels=[-1e9, 0.0], colors=["#D9D9D9"])
    side.contour(along, up, gap, levels=[0.0], colors=[GREY], linewidths=0.8)
    # Arrows come from below most braces, and stay within.
    lowest = min(pose.points[:, 2].min(initial=up[-1]) for pose in picture.poses)
    length = min(ARROW * float(np.ptp(up)), float(lowest - up[0]))
    largest = max(float(np.linalg.norm(pose.forces, axis=1).max(initial=0.0)) for pose in picture.poses)
    for axes, row, name in zip(views, (2, 1), ("up [m]", "left [m]"), strict=False):
        seen = [0, row]
        _draw_poses(axes, picture, seen, largest, length)
        axes.plot(*picture.path[:, seen].T, color=GREEN, linewidth=2.0, label="path of the hand")
        axes.set(ylabel=name, aspect="equal")
    if largest > 0.0:
        side.plot([], [], color=PULLING, label=f"forces on braces, at most {number(largest, 3)} N")
    if not flat:
        views[1].set_ylim(aside.min() - MARGIN, aside.max() + MARGIN)
    views[-1].set_xlabel("along the heading [m]")
    legend_above(side, columns=2)
    return figure


def _draw_poses(axes: Axes, picture: PlanPicture, seen: list[int], largest: float, length: float) -> None:
    """Links, forces, and numbers of braces beside their points in the last pose: the legend has their names."""
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
            fontsize=7.5,
            color=PULLING,
            fontweight="bold",
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )
        axes.plot([], [], color=PULLING, marker=f"${k}$", linestyle="none", label=name)


def heat_by_set(picture: PlanPicture) -> Figure | None:
    """Planned heat of the best sets of each size, and the simulated one of the answers, which are filled."""
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
    title = f"{picture.title}: heat of the motors by set of braces, the answers filled"
    return _dots(title, labels, [heat for _, _, heat, _ in rows], texts, marks, "mean heat, planned [W]")


def single_braces(picture: PlanPicture) -> Figure | None:
    """Least heat of an arm with one brace, by the point that is braced, in the middle of the path without slip."""
    if not picture.singles:
        return None
    heats = list(picture.singles.values())
    best = min(heats)
    texts = [f"{number(heat, 3)} W{', least' if heat == best else ''}" for heat in heats]
    marks = [{"marker": "o", "markerfacecolor": BLUE if heat == best else "white"} for heat in heats]
    title = f"{picture.title}: one brace, by where it is"
    return _dots(title, list(picture.singles), heats, texts, marks, "least heat at one posture, no slip [W]")


def _dots(
    title: str,
    labels: Sequence[str],
    values: Sequence[float],
    texts: Sequence[str],
    marks: Sequence[Mapping[str, Any]],
    axis: str,
) -> Figure:
    """A row with a dot and its text for each value: on a logarithmic axis, which values of many sizes need, bars would
    begin anywhere."""
    figure = new_figure(1.1 + 0.26 * len(values), title)
    axes = figure.subplots()
    low, high = min(values), max(values)
    wide = high > WIDE * low > 0.0
    middle = np.sqrt(low * high) if wide else 0.5 * high
    for y, (value, text, mark) in enumerate(zip(values, texts, marks, strict=True)):
        axes.plot(value, y, color=BLUE, markersize=6.0, linestyle="none", clip_on=False, zorder=3, **mark)
        # Towards the middle, where there is room.
        offset, side = (7.0, "left") if value <= middle else (-7.0, "right")
        axes.annotate(
            text, (value, y), xytext=(offset, 0.0), textcoords="offset points", ha=side, va="center", fontsize=7.0
        )
    axes.set_yticks(range(len(labels)), labels, fontsize=7.0)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel(axis)
    if wide:
        axes.set_xlim(low / (high / low) ** 0.05, high * (high / low) ** 0.05)
        log_axis(axes, "x")
    else:
        axes.set_xlim(0.0, 1.1 * high or 1.0)
    return figure


def robustness(picture: PlanPicture) -> Figure | None:
    """Heat, over the planned one, and the hand's error of the answers where the scene is not as planned."""
    shown = {count: corners for count, corners in picture.corners.items() if len(corners[1]) > 1}
    if not shown:
        return None
    figure = new_figure(4.2, f"{picture.title}: the plans where the scene is not as planned")
    upper, lower = figure.subplots(2, 1, sharex=True)
    labels = [label for label, _, _ in next(iter(shown.values()))[1]]
    width = 0.8 / len(shown)
    for k, (count, (planned, corners)) in enumerate(shown.items()):
        at = np.arange(len(corners)) + (k - 0.5 * (len(shown) - 1)) * width
        colour = (BLUE, GREEN, ORANGE, GREY, PULLING)[k % 5]
        upper.bar(at, [heat / planned for _, heat, _ in corners], width, color=colour, label=_number_of_braces(count))
        lower.bar(at, [error for _, _, error in corners], width, color=colour)
    upper.axhline(1.0, color="black", linewidth=0.6)
    upper.set_ylabel("heat over planned")
    lower.set_ylabel("hand's error, rms [mm]")
    lower.set_xticks(range(len(labels)), labels, rotation=25.0, ha="right", fontsize=6.5)
    legend_above(upper, columns=len(shown))
    return figure


def _number_of_braces(count: int) -> str:
    return f"{count} brace{'' if count == 1 else 's'}"


FIGURES = {
    "plan_posture": posture,
    "plan_heat": heat_by_set,
    "plan_single_braces": single_braces,
    "plan_robustness": robustness,
}


def draw_plan_figures(picture: PlanPicture, folder: Path, kind: str) -> list[Path]:
    """All figures of a plan to a folder; returns the files."""
    return save_all(FIGURES, picture, folder, kind)
