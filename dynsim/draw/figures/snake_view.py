"""What all snake figures share: colours, one posture in top and side view, the chart of modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.ticker import Locator
from numpy.typing import NDArray

from dynsim.draw.geometry.shapes import outline
from dynsim.record import Record
from dynsim.snake.geometry import snake_geometry

# Okabe and Ito's palette: distinct for colour-blind readers.
BODY, HEAD, GROUND, LIFT, TARGET, SUPPORT = "#444444", "#D55E00", "#0072B2", "#FFFFFF", "#009E73", "#56B4E9"
CYCLE = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999"]
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": plt.cycler(color=CYCLE),
    "lines.linewidth": 1.1,
    "axes.xmargin": 0.0,
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}
SYMBOLS = {"alpha": "α", "beta": "β", "gamma": "γ"}


# Beyond this many modes their numbers do not fit above the bars of a chart.
NUMBERED = 30
# Parts of a run, of which shares and ranges are drawn where lines and bars would fill the panel: more modes than that.
TURNS = 160
# From never to always.
SHARES = LinearSegmentedColormap.from_list("shares", [LIFT, GROUND])
# A top view is at least this high, in parts of its width: a straight robot is a thin line.
LEAST_HEIGHT = 0.3


class SparseTicks(Locator):
    """Multiples of 1, 2 or 5 times a power of ten, as many as have room for their labels on a vertical axis."""

    LABEL, APART = 6.5, 8.5  # height of a label, distance of two ticks [points]

    def __init__(self, axes: Axes) -> None:
        self.axes = axes

    def __call__(self) -> Any:
        return self.tick_values(*sorted(self.axes.get_ylim()))

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Ticks between the two values, on axes of the present height."""
        points = 72.0 * self.axes.bbox.height / self.axes.figure.dpi
        least = self.APART * (vmax - vmin) / max(points, 1.0)
        power = 10.0 ** np.floor(np.log10(least))
        step = next(m * power for m in (1, 2, 5, 10) if m * power >= least * (1 - 1e-9))
        return step * np.arange(np.ceil(vmin / step - 1e-9), np.floor(vmax / step + 1e-9) + 1)


class View:
    """One posture, ready to be drawn."""

    def __init__(self, record: Record, row: int) -> None:
        geometry = snake_geometry(record)
        self.row, self.time, self.mode = row, float(record.time[row]), int(record["mode"][row])
        self.points: NDArray[np.float64] = record["posture"][row]
        self.path: NDArray[np.float64] = record["w"][:, :2]
        self.centre = record["centre_of_mass"][row]
        self.grounded = record["grounded"][row].astype(bool)
        self.radius = geometry.wheel_radius
        n_h = geometry.head_joints
        self.axles = self.points[n_h::2]
        x, y, yaw = record["base_pose"][row]
        headings = yaw + np.concatenate([[0.0], np.cumsum(record["phi"][row, n_h:])])
        self.along = np.stack([np.cos(headings), np.sin(headings)], axis=1)
        self.across = np.stack([-np.sin(headings), np.cos(headings)], axis=1) * geometry.half_track[:, None]
        # Side view: along the heading of the base part, from wheel pair 1.
        forward = np.array([np.cos(yaw), np.sin(yaw)])
        self.side = np.stack([(self.points[:, :2] - [x, y]) @ forward, self.points[:, 2]], axis=1)

    def outline(self) -> NDArray[np.float64]:
        """Everything that a top view must show, (k, 2)."""
        wheels = [self.axles[:, :2] + s * self.across + f * self.radius * self.along for s in (-1, 1) for f in (-1, 1)]
        return np.vstack([self.points[:, :2], *wheels])

    def support(self) -> NDArray[np.float64]:
        """Corners of the support polygon, (k, 2)."""
        down = self.grounded
        return outline(np.vstack([self.axles[down, :2] + s * self.across[down] for s in (-1, 1)]))

    def draw_top(self, axis: Axes) -> list[Artist]:
        drawn: list[Artist] = [
            axis.add_patch(Polygon(self.support(), color=SUPPORT, alpha=0.25, lw=0, zorder=1)),
            *axis.plot(*self.points[:, :2].T, "-", color=BODY, lw=1.8, zorder=3, solid_capstyle="round"),
            *axis.plot(*self.points[0, :2], "o", color=HEAD, ms=4, zorder=5),
            *axis.plot(*self.centre[:2], "x", color="black", ms=4, mew=1.0, zorder=6),
        ]
        for down in (True, False):
            corners = []
            for i in np.flatnonzero(self.grounded == down):
                length = self.radius * self.along[i]
                width = 0.24 * self.radius * self.across[i] / np.linalg.norm(self.across[i])
                for s in (-1, 1):
                    middle = self.axles[i, :2] + s * self.across[i]
                    corners.append([middle + f * length + g * width for f, g in ((1, 1), (1, -1), (-1, -1), (-1, 1))])
            face = GROUND if down else LIFT
            wheels = PolyCollection(corners, facecolors=face, edgecolors=GROUND, linewidths=0.7, zorder=4)
            drawn.append(axis.add_collection(wheels, autolim=False))
        return drawn

    def draw_side(self, axis: Axes) -> list[Artist]:
        drawn: list[Artist] = [
            axis.axhline(0.0, color="#BBBBBB", lw=0.8, zorder=0),
            *axis.plot(*self.side.T, "-", color=BODY, lw=1.8, zorder=3, solid_capstyle="round"),
            *axis.plot(*self.side[0], "o", color=HEAD, ms=4, zorder=5),
        ]
        n_h = len(self.points) - 2 * len(self.axles) + 1
        for down in (True, False):
            # A lifted pair is drawn a little above the ground: the model has no height for it ([T] II.A).
            raised = 0.0 if down else 0.35 * self.radius
            wheels = [
                Circle((self.side[n_h + 2 * i, 0], self.side[n_h + 2 * i, 1] + raised), self.radius)
                for i in np.flatnonzero(self.grounded == down)
            ]
            face = GROUND if down else LIFT
            collection = PatchCollection(wheels, facecolors=face, edgecolors=GROUND, linewidths=0.7, zorder=2)
            drawn.append(axis.add_collection(collection, autolim=False))
        return drawn


def posture_grid(lines: Mapping[str, Sequence[tuple[View, str]]], note: str = "", one_scale: bool = True) -> Figure:
    """Top views, each with its title, and the path of the point in green; every line of the grid has a label.

    ``one_scale``: all lines show the same area, else each the one it needs.
    """
    columns = max(map(len, lines.values()))
    clouds = [[view.outline() for view, _ in line] for line in lines.values()]
    pooled = [cloud for line in clouds for cloud in line]
    boxes = [_not_flat(limits(pooled if one_scale else line, 0.06)) for line in clouds]
    size = 8.6 / columns
    heights = [size * (y1 - y0) / (x1 - x0) for x0, x1, y0, y1 in boxes]
    titles = 1 + max(title.count("\n") for line in lines.values() for _, title in line)
    figure, axes = plt.subplots(
        len(lines),
        columns,
        figsize=(9.0, sum(heights) + len(lines) * (0.3 + 0.14 * titles) + 0.5),
        squeeze=False,
        sharex="all" if one_scale else "row",
        sharey="row",
        height_ratios=heights,
    )
    for place, ((label, line), (x0, x1, y0, y1)) in enumerate(zip(lines.items(), boxes, strict=True)):
        row = axes[place]
        row[0].set_ylabel(label, rotation=0, ha="right", va="center")
        _sparse_ticks(row[0])
        for column in range(len(line), columns):
            row[column].set_visible(False)
            if place > 0:
                axes[place - 1, column].tick_params(labelbottom=True)  # the lowest one there
        for axis, (view, title) in zip(row, line, strict=False):
            axis.plot(*view.path.T, color=TARGET, lw=1.0, zorder=2)
            view.draw_top(axis)
            axis.set(xlim=(x0, x1), ylim=(y0, y1))
            axis.set_title(title, fontsize=7)
            axis.set_aspect("equal", adjustable="box")
    figure.supxlabel("x [m]" + note, fontsize=8)
    figure.supylabel("y [m]", fontsize=8)
    figure.legend(handles=legend(), loc="outside upper center", ncols=6, frameon=False)
    return figure


def posture_strip(line: Sequence[tuple[View, str]]) -> Figure:
    """Postures with their titles: top view above, side view along the base's heading below."""
    views = [view for view, _ in line]
    top = _not_flat(limits([view.outline() for view in views], 0.08))
    side = limits([np.vstack([view.side, view.side * [1, 0]]) for view in views], 0.08)
    tall, low = top[3] - top[2], side[3] - side[2]
    width = 9.0
    column = width / len(views)
    height = column * (tall / (top[1] - top[0]) + low / (side[1] - side[0])) + 1.1
    figure, axes = plt.subplots(
        2, len(views), figsize=(width, max(height, 2.6)), squeeze=False, height_ratios=[tall, max(low, 0.35 * tall)]
    )
    for (view, title), above, below in zip(line, *axes, strict=True):
        view.draw_top(above)
        view.draw_side(below)
        above.set(xlim=top[:2], ylim=top[2:], title=title)
        below.set(xlim=side[:2], ylim=(min(side[2], -0.02), side[3]))
        for axis in (above, below):
            axis.set_aspect("equal", adjustable="box")
            if axis is not axes[0, 0] and axis is not axes[1, 0]:
                axis.tick_params(labelleft=False)
            axis.tick_params(axis="x", labelrotation=45)
    for axis, name in ((axes[0, 0], "y [m]"), (axes[1, 0], "height [m]")):
        axis.set_ylabel(name)
        _sparse_ticks(axis)
    figure.supxlabel("above: x [m]; below: along the heading of the base part [m]", fontsize=8)
    figure.legend(handles=legend(), loc="outside upper center", ncols=6, frameon=False)
    return figure


def mode_starts(record: Record) -> NDArray[np.int64]:
    """Rows at which a mode begins, the first one among them."""
    mode = record["mode"]
    return np.flatnonzero(np.diff(mode, prepend=mode[0] - 1))


def mode_chart(axis: Axes, record: Record, title: str = "mode") -> None:
    """Grounded (filled) and lifted (white) wheel pairs over time, with the mode numbers where these have room."""
    grounded, time, mode = record["grounded"], record.time, record["mode"]
    starts, last, pairs = mode_starts(record), len(time) - 1, grounded.shape[1]
    numbered, dense = len(starts) <= NUMBERED, len(starts) > TURNS
    if dense:
        _shares(axis, record, grounded, np.arange(1.0, pairs + 1.0))
    for i in range(0 if dense else pairs):
        # A bar ends where the pair is lifted, and at every change of mode while these can be told apart.
        begins = starts if numbered else np.flatnonzero(np.diff(grounded[:, i], prepend=grounded[0, i] - 1))
        ends = np.append(begins[1:], last)
        bars = [(time[a], time[b] - time[a]) for a, b in zip(begins, ends, strict=True) if grounded[a, i]]
        edge = {"edgecolors": "white", "linewidth": 0.4} if numbered else {"linewidth": 0.0}
        axis.broken_barh(bars, (i + 0.6, 0.8), facecolors=GROUND, **edge)
    if numbered:
        for start, end in zip(starts, np.append(starts[1:], last), strict=True):
            axis.text((time[start] + time[end]) / 2, 0.2, str(mode[start]), ha="center", va="center", fontsize=7)
    axis.set_xlim(time[0], time[-1])
    axis.set_ylim(pairs + 0.6, -0.2 if numbered else 0.4)
    axis.set_yticks(range(1, pairs + 1))
    axis.set_ylabel("wheel pair")
    # without numbers above the bars the title does not promise them
    title = f"{title}, and the " if numbered else title.removesuffix("mode")
    length = (time[-1] - time[0]) / TURNS
    lifted = f"share of each {length:.2g} s, white: lifted" if dense else "blue) or lifted (white"
    axis.set_title(f"{title}wheel pairs on the ground ({lifted})", loc="left")


def mode_steps(axis: Axes, record: Record) -> None:
    """Mode numbers over time as steps, or as shares of time where these would fill the panel."""
    shown = np.unique(record["mode"])
    if len(mode_starts(record)) > TURNS:
        _shares(axis, record, record["mode"][:, None] == shown, shown.astype(float))
    else:
        axis.step(record.time, record["mode"], where="post", color=GROUND, lw=0.7)
    axis.set(ylabel="mode", ylim=(shown[0] - 0.5, shown[-1] + 0.5))
    if len(shown) <= 12:
        axis.set_yticks(shown)


def turns(samples: int) -> NDArray[np.int64]:
    """Rows at which parts of a run begin, see ``TURNS``."""
    return np.unique(np.linspace(0, samples, TURNS + 1).astype(np.int64))[:-1]


def _shares(axis: Axes, record: Record, holds: NDArray[Any], places: NDArray[np.float64]) -> None:
    """The part of each turn for which something holds, (T, k), as bars of such shades at (k,) places."""
    starts = turns(len(record.time))
    many = np.diff(starts, append=len(record.time))[:, None]
    shares = np.add.reduceat(holds.astype(float), starts, axis=0) / many
    edges = np.append(record.time[starts], record.time[-1])
    for place, share in zip(places, shares.T, strict=True):
        bar = [place - 0.4, place + 0.4]
        axis.pcolormesh(edges, bar, share[None], cmap=SHARES, vmin=0.0, vmax=1.0)


def error_axis(axis: Axes, *errors: NDArray[np.float64]) -> None:
    """Lower limit of a logarithmic axis: what is rounding (a first sample that is exact) does not stretch it."""
    values = np.concatenate(errors)
    values = values[values > 1e-15]
    if len(values):
        axis.set_ylim(10.0 ** np.floor(np.log10(np.percentile(values, 2))), 3.0 * values.max())
    else:
        axis.set_ylim(1e-16, 1e-14)


def moments(record: Record, count: int) -> NDArray[np.int64]:
    """Rows of ``count`` evenly spread samples, first and last among them."""
    return np.unique(np.linspace(0, len(record.time) - 1, min(count, len(record.time))).round().astype(np.int64))


def limits(clouds: list[NDArray[np.float64]], margin: float) -> tuple[float, float, float, float]:
    """x and y limits that hold all points, with a margin."""
    points = np.vstack(clouds)
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    return float(x0), float(x1), float(y0), float(y1)


def _not_flat(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """The same limits, higher where they would be a strip too thin for its ticks."""
    x0, x1, y0, y1 = box
    more = max(0.0, LEAST_HEIGHT * (x1 - x0) - (y1 - y0)) / 2
    return x0, x1, y0 - more, y1 + more


def _sparse_ticks(axis: Axes) -> None:
    axis.yaxis.set_major_locator(SparseTicks(axis))
    axis.tick_params(axis="y", labelsize=SparseTicks.LABEL)


def relax(axis: Axes, least: float) -> None:
    """Do not blow a constant up to rounding noise."""
    low, high = axis.get_ylim()
    if high - low < 2 * least:
        middle = (low + high) / 2
        axis.set_ylim(middle - least, middle + least)


def greek(name: str) -> str:
    """Joint name with its Greek letter."""
    return name.replace("theta", "θ").replace("psi", "ψ")


def legend() -> list[Any]:
    """Handles for what a view shows."""
    return [
        Line2D([], [], color=HEAD, marker="o", ls="", ms=4, label="controlled point"),
        Line2D([], [], color=BODY, lw=1.8, label="body"),
        Patch(facecolor=GROUND, edgecolor=GROUND, label="wheel on the ground"),
        Patch(facecolor=LIFT, edgecolor=GROUND, label="wheel lifted"),
        Patch(facecolor=SUPPORT, alpha=0.25, label="support polygon"),
        Line2D([], [], color="black", marker="x", ls="", ms=4, label="centre of mass"),
    ]
