"""Parts that all snake figures share: colours, top and side views of one posture, and mode charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from dynsim.draw.figures import style
from dynsim.draw.figures.posture import add_outlines
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.projection import ABOVE, UP, Projection
from dynsim.draw.geometry.shapes import corners_of, wheel_groups
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.record.poses import POSITION
from dynsim.snake.lifting import snake_geometry
from dynsim.snake.published import used_limit

BODY, HEAD, GROUND, LIFT, TARGET, SUPPORT = "#444444", style.PULLING, style.BLUE, "#FFFFFF", style.GREEN, style.SKY
OBJECT = "#E9CFA6"
SYMBOLS = {"alpha": "α", "beta": "β", "gamma": "γ"}
# Maximum number of modes whose numbers fit above the bars of a chart.
NUMBERED = 30
# Number of intervals into which a run is divided. If it has more modes than this, fractions and ranges for each
# interval are drawn instead of each mode.
INTERVALS = 160
# Colours of fractions of time from 0 to 1.
SHARES = LinearSegmentedColormap.from_list("shares", [LIFT, GROUND])
# Minimum height of a top view relative to its width, because a straight robot appears as a thin line.
MIN_HEIGHT = 0.3
# Font size of tick labels at the vertical axes of postures [point].
SMALL = 6.5


def object_bodies(record: Record) -> dict[str, int]:
    """Return the names and body indices of the objects whose poses are in the record."""
    if record.scene is None or POSITION not in record:
        return {}
    return {body.name: k for k, body in enumerate(record.scene.bodies) if body.name in record.scene.objects}


class View:
    """One posture, drawn from above or from the side along the heading of the base part."""

    def __init__(self, record: Record, row: int) -> None:
        scene = record.scene
        if scene is None:
            raise RecordError("cannot draw the record of a snake without a scene that contains its wheels and links")
        self.row, self.time, self.mode = row, float(record.time[row]), int(record["mode"][row])
        self.points: Array = record["posture"][row]
        self.path: Array = record["w"][:, :2]
        self.centre: Array = record["centre_of_mass"][row]
        self.grounded = record["grounded"][row].astype(bool)
        self.radius = snake_geometry(record).wheel_radius
        # Corners of the wheels of each pair.
        pairs = wheel_groups(record, scene).places
        self.wheels = [[corners_of(record, scene, body, row)[shape][0] for body, shape in pair] for pair in pairs]
        solids = [corners_of(record, scene, body, row) for body in object_bodies(record).values()]
        self.objects = [corners for shapes in solids for corners, _ in shapes]
        x, y, yaw = record["base_pose"][row]
        self.beside = Projection(np.array([x, y, 0.0]), np.array([[np.cos(yaw), np.sin(yaw), 0.0], UP]))

    def project(self, points: Array, above: bool) -> Array:
        """Project points to the plane of the drawing, (n, 3) → (n, 2) [m]."""
        return (ABOVE if above else self.beside).project(points)

    def extent(self, above: bool) -> Array:
        """Return all points that a view must show, (k, 2)."""
        wheels = [corners for pair in self.wheels for corners in pair]
        return self.project(np.concatenate([self.points, *wheels, *self.objects]), above)

    def draw(self, axes: Axes, above: bool) -> None:
        """Draw objects, body, controlled point and wheels and, from above, the support polygon and centre of mass."""
        objects = (self.project(corners, above) for corners in self.objects)
        add_outlines(axes, objects, fc=OBJECT, ec=BODY, lw=0.5, zorder=1.5)
        if above:
            stands = [corners.mean(axis=0)[:2] for k in np.flatnonzero(self.grounded) for corners in self.wheels[k]]
            add_outlines(axes, [np.array(stands)], color=SUPPORT, alpha=0.25, lw=0, zorder=1)
            axes.plot(*self.centre[:2], "x", color="black", ms=4, mew=1.0, zorder=6)
        else:
            axes.axhline(0.0, color="#BBBBBB", lw=0.8, zorder=0)
        flat = self.project(self.points, above)
        axes.plot(*flat.T, "-", color=BODY, lw=1.8, zorder=3, solid_capstyle="round")
        axes.plot(*flat[0], "o", color=HEAD, ms=4, zorder=5)
        for down, pair in zip(self.grounded, self.wheels, strict=True):
            # In side view, a lifted pair is drawn slightly above the ground; the model has no height for it ([T] II.A).
            raised = np.array([0.0, 0.0 if above or down else 0.35 * self.radius])
            look: dict[str, Any] = {"facecolor": GROUND if down else LIFT, "edgecolor": GROUND, "lw": 0.7}
            wheels = (self.project(corners, above) + raised for corners in pair)
            add_outlines(axes, wheels, zorder=4 if above else 2, **look)


def posture_grid(title: str, lines: Mapping[str, Sequence[tuple[View, str]]], one_scale: bool = True) -> Figure:
    """Draw labelled rows of top views with their titles, and the path of the controlled point in green.

    With ``one_scale``, the areas of all rows have the same size; otherwise each row shows the area that it needs.
    """
    columns = max(map(len, lines.values()))
    clouds = [[view.extent(above=True) for view, _ in line] for line in lines.values()]
    pooled = [cloud for line in clouds for cloud in line]
    boxes = [_not_flat(limits(pooled if one_scale else line, 0.06)) for line in clouds]
    size = 8.6 / columns
    heights = [size * (y1 - y0) / (x1 - x0) for x0, x1, y0, y1 in boxes]
    titles = 1 + max(text.count("\n") for line in lines.values() for _, text in line)
    height = sum(heights) + len(lines) * (0.3 + 0.14 * titles) + 0.8
    figure = style.new_figure(height, title, page=9.0)
    axes = figure.subplots(
        len(lines),
        columns,
        squeeze=False,
        sharex="all" if one_scale else "row",
        sharey="row",
        height_ratios=heights,
    )
    for k, ((label, line), (x0, x1, y0, y1)) in enumerate(zip(lines.items(), boxes, strict=True)):
        row = axes[k]
        row[0].set_ylabel(label, rotation=0, ha="right", va="center")
        row[0].tick_params(axis="y", labelsize=SMALL)
        for column in range(len(line), columns):
            row[column].set_visible(False)
            if k > 0:
                axes[k - 1, column].tick_params(labelbottom=True)  # the lowest panel in this column
        for axis, (view, text) in zip(row, line, strict=False):
            axis.plot(*view.path.T, color=TARGET, lw=1.0, zorder=2)
            view.draw(axis, above=True)
            axis.set(xlim=(x0, x1), ylim=(y0, y1))
            axis.set_title(text, fontsize=style.letters(7.0))
            axis.set_aspect("equal", adjustable="box")
    for axis in axes[-1]:
        axis.set_xlabel("x [m]")
    figure.supylabel("y [m]", fontsize=style.letters(8.0))
    _explain(figure, [view for line in lines.values() for view, _ in line])
    return figure


def posture_strip(title: str, line: Sequence[tuple[View, str]]) -> Figure:
    """Draw postures with their titles: the top view above, and the side view along the heading of the base below."""
    views = [view for view, _ in line]
    top = _not_flat(limits([view.extent(above=True) for view in views], 0.08))
    side = limits([view.extent(above=False) for view in views], 0.08)
    tall, low = top[3] - top[2], side[3] - side[2]
    column = 9.0 / len(views)
    height = column * (tall / (top[1] - top[0]) + low / (side[1] - side[0])) + 2.1
    figure = style.new_figure(max(height, 2.9), title, page=9.0)
    axes = figure.subplots(2, len(views), squeeze=False, height_ratios=[tall, max(low, 0.35 * tall)])
    for (view, text), above, below in zip(line, *axes, strict=True):
        view.draw(above, above=True)
        view.draw(below, above=False)
        above.set(xlim=top[:2], ylim=top[2:], title=text)
        below.set(xlim=side[:2], ylim=(min(side[2], -0.02), side[3]))
        for axis in (above, below):
            axis.set_aspect("equal", adjustable="box")
            if axis is not axes[0, 0] and axis is not axes[1, 0]:
                axis.tick_params(labelleft=False)
            axis.tick_params(axis="x", labelrotation=45)
    for axis, name in ((axes[0, 0], "y [m]"), (axes[1, 0], "height [m]")):
        axis.set_ylabel(name)
        axis.tick_params(axis="y", labelsize=SMALL)
    for above, below in axes.T:
        above.set_xlabel("x [m]")
        below.set_xlabel("along heading [m]")
    _explain(figure, views)
    return figure


def overlay_margins(axes: Sequence[Axes], records: Mapping[str, Record]) -> None:
    """Overlay cost, largest yaw angle relative to its limit, and support margin of labelled runs in three panels."""
    for label, record in records.items():
        axes[0].plot(record.time, record["cost"], label=label)
        axes[1].plot(record.time, used_limit(record))
        axes[2].plot(record.time, 1e3 * record["support_margin"])
    for axis, limit, text in zip(axes[1:], (1.0, 0.0), ("largest |θ| / limit", "support margin [mm]"), strict=True):
        axis.axhline(limit, color="black", ls="-.", lw=0.8)
        axis.set_ylabel(text)
    axes[0].set_ylabel("cost V")
    axes[0].set_ylim(bottom=0)


def mode_starts(record: Record) -> NDArray[np.int64]:
    """Return the rows at which a mode begins, including the first row."""
    mode = record["mode"]
    return np.flatnonzero(np.diff(mode, prepend=mode[0] - 1))


def mode_chart(axis: Axes, record: Record, title: str = "mode") -> None:
    """Draw grounded (filled) and lifted (white) wheel pairs over time, with mode numbers if they fit."""
    grounded, time, mode = record["grounded"], record.time, record["mode"]
    starts, last, pairs = mode_starts(record), len(time) - 1, grounded.shape[1]
    numbered, dense = len(starts) <= NUMBERED, len(starts) > INTERVALS
    if dense:
        _shares(axis, record, grounded, np.arange(1.0, pairs + 1.0))
    for i in range(0 if dense else pairs):
        # A bar ends where the pair is lifted, and at every mode change if these can be distinguished.
        begins = starts if numbered else np.flatnonzero(np.diff(grounded[:, i], prepend=grounded[0, i] - 1))
        ends = np.append(begins[1:], last)
        bars = [(time[a], time[b] - time[a]) for a, b in zip(begins, ends, strict=True) if grounded[a, i]]
        edge = {"edgecolors": "white", "linewidth": 0.4} if numbered else {"linewidth": 0.0}
        axis.broken_barh(bars, (i + 0.6, 0.8), facecolors=GROUND, **edge)
    if numbered:
        for start, end in zip(starts, np.append(starts[1:], last), strict=True):
            axis.text(
                (time[start] + time[end]) / 2,
                0.2,
                str(mode[start]),
                ha="center",
                va="center",
                fontsize=style.letters(7.0),
            )
    axis.set_xlim(time[0], time[-1])
    axis.set_ylim(pairs + 0.6, -0.2 if numbered else 0.4)
    axis.set_yticks(range(1, pairs + 1))
    axis.set_ylabel("wheel pair")
    # The title mentions mode numbers only if they are drawn.
    title = f"{title}, and the " if numbered else title.removesuffix("mode")
    length = (time[-1] - time[0]) / INTERVALS
    lifted = f"share of each {length:.2g} s, white: lifted" if dense else "blue) or lifted (white"
    axis.set_title(f"{title}wheel pairs on the ground ({lifted})", loc="left")


def mode_steps(axis: Axes, record: Record) -> None:
    """Draw mode numbers over time as steps, or as fractions of time if steps would fill the panel."""
    shown = np.unique(record["mode"])
    if len(mode_starts(record)) > INTERVALS:
        _shares(axis, record, record["mode"][:, None] == shown, shown.astype(float))
    else:
        axis.step(record.time, record["mode"], where="post", color=GROUND, lw=0.7)
    axis.set(ylabel="mode", ylim=(shown[0] - 0.5, shown[-1] + 0.5))
    if len(shown) <= 12:
        axis.set_yticks(shown)


def interval_starts(samples: int) -> NDArray[np.int64]:
    """Return the rows at which the intervals of a run begin, see ``INTERVALS``."""
    return np.unique(np.linspace(0, samples, INTERVALS + 1).astype(np.int64))[:-1]


def _shares(axis: Axes, record: Record, holds: NDArray[Any], places: NDArray[np.float64]) -> None:
    """Draw the fraction of each interval for which conditions, (T, k), hold as shaded bars at ``places``, (k,)."""
    starts = interval_starts(len(record.time))
    counts = np.diff(starts, append=len(record.time))[:, None]
    shares = np.add.reduceat(holds.astype(float), starts, axis=0) / counts
    edges = np.append(record.time[starts], record.time[-1])
    for position, share in zip(places, shares.T, strict=True):
        bar = [position - 0.4, position + 0.4]
        axis.pcolormesh(edges, bar, share[None], cmap=SHARES, vmin=0.0, vmax=1.0)


def error_axis(axis: Axes, *errors: NDArray[np.float64]) -> None:
    """Set the limits of a logarithmic error axis so that rounding errors (an exact first sample) do not extend it."""
    values = np.concatenate(errors)
    values = values[values > 1e-15]
    if len(values):
        axis.set_ylim(10.0 ** np.floor(np.log10(np.percentile(values, 2))), 3.0 * values.max())
    else:
        axis.set_ylim(1e-16, 1e-14)


def moments(record: Record, count: int) -> NDArray[np.int64]:
    """Return the rows of ``count`` evenly spaced samples, including the first and the last."""
    return np.unique(np.linspace(0, len(record.time) - 1, min(count, len(record.time))).round().astype(np.int64))


def limits(clouds: list[NDArray[np.float64]], margin: float) -> tuple[float, float, float, float]:
    """Return x and y limits that contain all points and a margin."""
    points = np.vstack(clouds)
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    return float(x0), float(x1), float(y0), float(y1)


def _not_flat(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Increase the height of limits if they form a strip that is too thin for ticks."""
    x0, x1, y0, y1 = box
    more = max(0.0, MIN_HEIGHT * (x1 - x0) - (y1 - y0)) / 2
    return x0, x1, y0 - more, y1 + more


def greek(name: str) -> str:
    """Return a joint name with its Greek letter."""
    return name.replace("theta", "θ").replace("psi", "ψ")


def _explain(figure: Figure, views: Sequence[View]) -> None:
    """Add a legend of the views below a figure."""
    handles: list[Any] = [
        Line2D([], [], color=HEAD, marker="o", ls="", ms=4, label="controlled point"),
        Line2D([], [], color=BODY, lw=1.8, label="body"),
        Patch(facecolor=GROUND, edgecolor=GROUND, label="wheel on the ground"),
        Patch(facecolor=LIFT, edgecolor=GROUND, label="wheel lifted"),
        Patch(facecolor=SUPPORT, alpha=0.25, label="support polygon"),
        Line2D([], [], color="black", marker="x", ls="", ms=4, label="centre of mass"),
    ]
    if any(view.objects for view in views):
        handles.append(Patch(facecolor=OBJECT, edgecolor=BODY, lw=0.5, label="object"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
