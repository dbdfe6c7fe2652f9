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
from dynsim.draw.figures.posture import add_outlines, draw_cuts
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.projection import ABOVE, UP, Projection
from dynsim.draw.geometry.shapes import corners_of, wheel_groups
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.record.poses import POSITION
from dynsim.snake.lifting import snake_geometry
from dynsim.snake.published import used_limit

BODY, HEAD, GROUND, LIFT, TARGET, SUPPORT = "#444444", style.PULLING, style.BLUE, "#FFFFFF", style.GREEN, style.SKY
OBJECT, EDGE = "#E9CFA6", "#00283F"
# Edge of objects; thin objects consist of little else.
RIM = "#A8793A"
SYMBOLS = {"alpha": "α", "beta": "β", "gamma": "γ"}
COORDINATE_NAMES = {
    "x": "$x$",
    "y": "$y$",
    "z": "height $z$",
    "alpha": r"roll $\alpha$",
    "beta": r"pitch $\beta$",
    "gamma": r"yaw $\gamma$",
}
COST = "cost of\nredundancy"
# Maximum number of modes whose numbers fit above the bars of a chart.
NUMBERED = 30
# Number of intervals into which a run is divided. If it has more modes than this, fractions and ranges for each
# interval are drawn instead of each mode.
INTERVALS = 160
# Looks of limits (dotted) and of stall torques and bounds (long dashes); no curve is thin and black.
LIMIT: dict[str, Any] = {"color": style.BLACK, "ls": (0, (1, 2)), "lw": 0.8}
BOUND: dict[str, Any] = {"color": style.BLACK, "ls": (0, (8, 4)), "lw": 0.6}
# Coordinates of the controlled point that vary by less than this have no panel [mm, °].
STILL = (2.0, 0.2)
DEGREES = 180.0 / np.pi
# Colours of fractions of time from 0 to 1.
SHARES = LinearSegmentedColormap.from_list("shares", [LIFT, GROUND])
# Minimum height of a top view relative to its width, because a straight robot appears as a thin line.
MIN_HEIGHT = 0.3
# Font size of tick labels of postures [point]; least width of their panels, greatest and smallest height [inch].
SMALL, CELL, TALLEST, LOWEST = 6.5, 1.6, 4.6, 0.35
# Seen from above, the path of a point is drawn and explained if its extent is greater than this [m].
LONG = 0.05
# Height of a page that a figure fills before its legend has more than one row [inch].
PAGE = 8.2
# If a point of the body rises or sinks by more than this, there is a side view [m].
RISES = 0.01
# Errors below this are rounding errors [mm or °]; ratio of errors above which their axis is logarithmic.
ROUNDING, SPREAD = 1e-3, 30.0


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
        self.surfaces = scene.surfaces
        self.path: Array = record["w"][: row + 1, :2]
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
        """Draw body, controlled point, wheels and objects, surfaces within the limits of the axes, and support polygon.

        The support polygon and the centre of mass are drawn only from above.
        """
        objects = (self.project(corners, above) for corners in self.objects)
        add_outlines(axes, objects, fc=OBJECT, ec=RIM, lw=0.8, zorder=1.5)
        if above:
            stands = [corners.mean(axis=0)[:2] for k in np.flatnonzero(self.grounded) for corners in self.wheels[k]]
            add_outlines(axes, [np.array(stands)], color=SUPPORT, alpha=0.25, lw=0, zorder=1)
            axes.plot(*self.centre[:2], "x", color="black", ms=4, mew=1.0, zorder=6)
        # Seen from above, surfaces are cut at the height of the controlled point.
        plane = Projection(np.array([0.0, 0.0, self.points[0, 2]]), ABOVE.axes) if above else self.beside
        # The model has no size of a plate, so the body may be inside of its plane.
        draw_cuts(axes, plane, self.surfaces, np.concatenate([self.points, *(c for pair in self.wheels for c in pair)]))
        self.draw_body(axes, above, BODY, HEAD)
        for down, pair in zip(self.grounded, self.wheels, strict=True):
            # In side view, a lifted pair is drawn slightly above the ground; the model has no height for it ([T] II.A).
            raised = np.array([0.0, 0.0 if above or down else 0.35 * self.radius])
            look: dict[str, Any] = {"facecolor": GROUND if down else LIFT, "edgecolor": EDGE, "lw": 0.6}
            wheels = (self.project(corners, above) + raised for corners in pair)
            add_outlines(axes, wheels, zorder=4 if above else 2, **look)

    def draw_body(self, axes: Axes, above: bool, colour: Any, head: Any) -> None:
        """Draw the body and the controlled point."""
        flat = self.project(self.points, above)
        axes.plot(*flat.T, "-", color=colour, lw=1.8, zorder=3, solid_capstyle="round")
        axes.plot(*flat[0], "o", color=head, ms=2.8, zorder=5)


Box = tuple[float, float, float, float]


def _top_box(clouds: list[Array]) -> Box:
    """Return limits around points; a strip that is too thin for ticks becomes higher."""
    x0, x1, y0, y1 = limits(clouds, 0.06)
    more = max(0.0, MIN_HEIGHT * (x1 - x0) - (y1 - y0)) / 2
    return x0, x1, y0 - more, y1 + more


def _side_box(clouds: list[Array]) -> Box:
    x0, x1, low, high = limits(clouds, 0.06)
    return x0, x1, min(low, -0.02), high


def _columns(count: int) -> int:
    """Return how many of ``count`` panels are next to each other, so that rows are equally long."""
    return -(-count // -(-count // most_columns()))


def most_columns() -> int:
    """Return how many panels have space next to each other."""
    return max(int(style.width() / CELL), 1)


def _grid(
    title: str, rows: Sequence[Sequence[Box]], columns: int, lines: int, *, labelled: bool = False
) -> tuple[style.Drawing, NDArray[Any]]:
    """Create axes in rows of ``columns`` cells; a cell has one panel per box, below each other, at one scale.

    Parameters
    ----------
    title : str
        Title of the figure.
    rows : sequence of sequences of Box
        Limits of the panels of the cells in each row.
    columns : int
        Number of cells in a row.
    lines : int
        Number of lines of the titles of cells.
    labelled : bool, optional
        Whether every cell has tick labels on its left, and not only the first one of a row.
    """
    # A single cell is not so wide that it would be higher than TALLEST.
    left = 0.7 + labelled * (columns - 1) * style.letters(24.0) / 72.0
    cell = min(
        (style.width() - left) / columns, *(TALLEST * (b[1] - b[0]) / (b[3] - b[2]) for row in rows for b in row)
    )
    heights = [max(cell * (box[3] - box[2]) / (box[1] - box[0]), LOWEST) for row in rows for box in row]
    ticks = len(heights) if len(heights) > len(rows) else 1
    texts = ticks * style.letters(18.0 if ticks == 1 else 27.0) + len(rows) * style.letters(6.0 + 10.0 * lines)
    height = sum(heights) + texts / 72.0 + 0.8
    # Panels of a figure that would be higher than a page are a little smaller.
    figure = style.new_figure(max(min(height, PAGE), 0.85 * height), title)
    axes = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights)
    for panel in axes.ravel():
        panel.set_aspect("equal", adjustable="box")
        panel.tick_params(labelsize=style.letters(SMALL))
    return figure, axes.reshape(len(rows), -1, columns)


def _frame(axes: NDArray[Any], boxes: Sequence[Box], used: int, column: int, last: bool) -> list[Axes]:
    """Set the limits and labels of one cell of a row, hide the cells after the last one; return its panels."""
    panels = list(axes[:, column])
    names = (("$x$ [m]", "$y$ [m]"), ("along heading [m]", "height [m]"))
    for panel, (x0, x1, y0, y1), (across, up) in zip(panels, boxes, names, strict=False):
        panel.set(xlim=(x0, x1), ylim=(y0, y1))
        panel.tick_params(labelleft=column == 0, labelbottom=last or len(panels) > 1)
        panel.set_xlabel(across if last or len(panels) > 1 else "", fontsize=style.letters(7.5))
        panel.set_ylabel(up if column == 0 else "", fontsize=style.letters(7.5))
    for empty in axes[:, used:].ravel() if column == used - 1 else ():
        empty.set_visible(False)
    return panels


def posture_grid(
    title: str, lines: Mapping[str, Sequence[tuple[View, str]]], *, side: bool = False, one_scale: bool = True
) -> Figure:
    """Draw labelled lines of postures with their titles, and the path of the controlled point.

    Parameters
    ----------
    title : str
        Title of the figure.
    lines : mapping of str to sequence of (View, str)
        Views and their titles by the label of the line; a long line is continued in further rows of panels.
    side : bool, optional
        Whether the side view along the heading of the base is drawn below the top view.
    one_scale : bool, optional
        Whether the areas of all lines have the same limits; otherwise each line shows the area that it needs.
    """
    views = {label: [view for view, _ in line] for label, line in lines.items()}
    pooled = [view for line in views.values() for view in line]
    boxes = {
        label: [maker([view.extent(above) for view in (pooled if one_scale else line)]) for maker, above in sides]
        for label, line in views.items()
        for sides in [((_top_box, True), (_side_box, False))[: 1 + side]]
    }
    columns = min(_columns(len(line)) for line in lines.values())
    if (columns, max(map(len, lines.values()))) == (2, 3):
        columns = 1  # two columns would leave a cell empty
    rows = [(label, line[k : k + columns]) for label, line in lines.items() for k in range(0, len(line), columns)]
    cell = (style.width() - 0.7) / columns
    size = style.letters(7.0)
    texts = {id(view): style.broken(text, cell, size) for line in lines.values() for view, text in line}
    named = [label for label in lines if label.strip()]
    most = max(text.count("\n") for text in texts.values()) + 1 + bool(named)
    figure, axes = _grid(title, [boxes[label] for label, _ in rows], columns, most)
    for k, ((label, line), row) in enumerate(zip(rows, axes, strict=True)):
        below = len(rows[k + 1][1]) if k + 1 < len(rows) else 0
        for column, (view, _) in enumerate(line):
            panels = _frame(row, boxes[label], len(line), column, last=column >= below)
            panels[0].plot(*view.path.T, color=HEAD, lw=1.0, zorder=2)
            for panel, above in zip(panels, (True, False), strict=False):
                view.draw(panel, above=above)
            first = column == 0 and label.strip() and view is lines[label][0][0]
            panels[0].set_title((f"{label}\n" if first else "") + texts[id(view)], fontsize=size)
    paths = [view.path for view in pooled]
    _explain(figure, pooled, {"path of the point": Line2D([], [], color=HEAD, lw=1.0)} if _seen(paths) else {})
    return figure


def overlaid(title: str, runs: Mapping[str, tuple[Record, Sequence[View]]]) -> Figure:
    """Draw one cell for each run: postures and objects over time, earlier ones lighter, and paths on the ground.

    Cells have one scale. If a point of the body rises or sinks by more than ``RISES``, or the robot is straight, a side
    view along the last heading of the base is added below.
    """
    views = [view for _, line in runs.values() for view in line]
    for _, line in runs.values():
        for view in line:
            view.beside = line[-1].beside
    high = [np.stack([view.points[:, 2] for view in line]) for _, line in runs.values()]
    side = max(float(np.ptp(heights, axis=0).max()) for heights in high) > RISES
    tops, sides = [], []
    for record, line in runs.values():
        tops.append(limits([*(view.extent(above=True) for view in line), record["w"][:, :2]], 0.06))
        sides.append(_side_box([view.extent(above=False) for view in line]))
    x0, x1, y0, y1 = np.array(tops).T
    side = side or bool(np.max(y1 - y0) < MIN_HEIGHT * np.max(x1 - x0))
    half = 0.5 * np.array([np.max(x1 - x0), max(np.max(y1 - y0), MIN_HEIGHT * np.max(x1 - x0))])
    low, top = np.min(np.array(sides)[:, [0, 2]], axis=0), np.max(np.array(sides)[:, [1, 3]], axis=0)
    profile = (float(low[0]), float(top[0]), float(low[1]), float(top[1]))
    columns = _columns(len(runs))
    size = style.letters(7.0)
    labels = [style.broken(label, (style.width() - 0.7) / columns, size) if label else "" for label in runs]
    cells = []
    for box in tops:
        x, y = 0.5 * (box[0] + box[1]), 0.5 * (box[2] + box[3])
        cells.append([(x - half[0], x + half[0], y - half[1], y + half[1]), profile][: 1 + side])
    starts = range(0, len(runs), columns)
    lines = max(label.count("\n") + bool(label) for label in labels)
    uneven = [cells[k][0][2:] != cells[k - k % columns][0][2:] for k in range(len(cells))]
    figure, axes = _grid(title, [cells[start] for start in starts], columns, lines, labelled=any(uneven))
    for k, ((record, line), label) in enumerate(zip(runs.values(), labels, strict=True)):
        row, column = divmod(k, columns)
        used = min(columns, len(runs) - row * columns)
        panels = _frame(axes[row], cells[k], used, column, last=k + columns >= len(runs))
        for panel, above in zip(panels, (True, False), strict=False):
            for shade, view in zip(np.linspace(0.82, 0.4, len(line) - 1), line, strict=False):
                view.draw_body(panel, above, str(shade), str(shade))
                outlines = (view.project(corners, above) for corners in view.objects)
                add_outlines(panel, outlines, fc="none", ec=str(shade), lw=0.5, zorder=1.4)
            line[-1].draw(panel, above=above)
        if uneven[k]:
            panels[0].tick_params(labelleft=True)
        if _seen([record["w"][:, :2]]):
            panels[0].plot(*record["w"][:, :2].T, color=HEAD, lw=1.0, zorder=5.5)
            panels[0].plot(*record["w_target"][:, :2].T, "--", color=TARGET, lw=1.0, zorder=5.6)
        panels[0].set_title(label, fontsize=size)
    more: dict[str, Any] = {"earlier posture": Line2D([], [], color="0.65", lw=1.8)}
    if _seen([record["w"][:, :2] for record, _ in runs.values()]):
        more["path of the point"] = Line2D([], [], color=HEAD, lw=1.0)
        more["target of the point"] = Line2D([], [], color=TARGET, ls="--", lw=1.0)
    _explain(figure, views, more)
    return figure


def _seen(paths: Sequence[Array]) -> bool:
    """Return whether the longest path is longer than the mark of the controlled point."""
    return max(float(np.ptp(path, axis=0).max()) for path in paths) > LONG


def overlay_margins(
    axes: Sequence[Axes], records: Mapping[str, Record], looks: Mapping[str, Mapping[str, Any]]
) -> None:
    """Overlay cost, largest yaw angle relative to its limit, and support margin of labelled runs in three panels."""
    for label, record in records.items():
        axes[0].plot(record.time, record["cost"], label=label, **looks[label])
        axes[1].plot(record.time, used_limit(record), **looks[label])
        axes[2].plot(record.time, 1e3 * record["support_margin"], **looks[label])
    margin_axes(axes)


def margin_axes(axes: Sequence[Axes]) -> None:
    """Label panels of cost, yaw angle and support margin, and draw their limits."""
    texts = ("largest yaw angle\n/ its limit", "support margin\n[mm]")
    for axis, limit, name, text in zip(axes[1:], (1.0, 0.0), ("limit", "tips below zero"), texts, strict=True):
        limit_line(axis, limit, name)
        axis.set_ylabel(text)
    axes[0].set_ylabel(COST)
    above_edge(axes[0])


def limit_line(axis: Axes, value: float, text: str = "") -> None:
    """Draw a limit as a dotted line, with its name, if any, above the right end."""
    axis.axhline(value, **LIMIT)
    if not text:
        return
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, value), max(high, value + 0.14 * (max(high, value) - min(low, value))))
    axis.annotate(
        text,
        (1.0, value),
        xycoords=("axes fraction", "data"),
        xytext=(-2, 1.5),
        textcoords="offset points",
        ha="right",
        fontsize=style.letters(7.0),
    )


def pair_wheels(record: Record) -> dict[str, list[int]]:
    """Return the columns of the contact signals that belong to each wheel pair; keys: "pair 1", …."""
    names = record.labels["contact_normal_force"]
    return {
        pair.replace("pair", "pair "): [k for k, n in enumerate(names) if n[:-1] == pair.replace("pair", "wheel")]
        for pair in record.labels["grounded"]
    }


def pair_loads(record: Record) -> dict[str, Array]:
    """Return the load of each wheel pair [N], (T,); keys: "pair 1", …."""
    forces = record["contact_normal_force"]
    return {pair: forces[:, columns].sum(axis=1) for pair, columns in pair_wheels(record).items()}


def mode_starts(record: Record) -> NDArray[np.int64]:
    """Return the rows at which a mode begins, including the first row."""
    mode = record["mode"]
    return np.flatnonzero(np.diff(mode, prepend=mode[0] - 1))


def mode_chart(axis: Axes, record: Record, title: str = "mode") -> None:
    """Draw grounded (filled) and lifted (white) wheel pairs over time, with mode numbers if they fit."""
    grounded, time, mode = record["grounded"], record.time, record["mode"]
    starts, last, pairs = mode_starts(record), len(time) - 1, grounded.shape[1]
    middles = 0.5 * (time[starts] + time[np.append(starts[1:], last)])
    numbered, dense = is_numbered(record), len(starts) > INTERVALS
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
        for start, middle in zip(starts, middles, strict=True):
            axis.text(middle, 0.2, str(mode[start]), ha="center", va="center", fontsize=style.letters(7.0))
    axis.set_xlim(time[0], time[-1])
    axis.set_ylim(pairs + 0.6, -0.2 if numbered else 0.4)
    axis.set_yticks(range(1, pairs + 1))
    if numbered:
        axis.set_yticks([0.2, *range(1, pairs + 1)], ["mode", *map(str, range(1, pairs + 1))])
    axis.set_ylabel("wheel pair")
    # The title mentions mode numbers only if they are drawn.
    title = f"{title}, and the " if numbered else title.removesuffix("mode")
    length = (time[-1] - time[0]) / INTERVALS
    lifted = f"share of each {length:.2g} s, white: lifted" if dense else "blue) or lifted (white"
    text = style.broken(f"{title}wheel pairs on the ground ({lifted})", style.width() - 0.6)
    axis.set_title(text, loc="left")


def is_numbered(record: Record) -> bool:
    """Return whether the numbers of the modes fit above a chart of the modes."""
    starts = record.time[mode_starts(record)]
    middles = 0.5 * (starts + np.append(starts[1:], record.time[-1]))
    length = (record.time[-1] - record.time[0]) or 1.0
    apart = np.diff(middles).min(initial=length) / length * 72.0 * (style.width() - 0.8)
    return len(starts) <= NUMBERED and bool(apart > style.letters(7.0))


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


def rounding(name: str, unit: str, *errors: NDArray[np.float64]) -> str:
    """Return a note on errors [mm or °] that are rounding errors and need no panel, or ""."""
    text = f"{name.capitalize()}: below {ROUNDING:g} {unit}, not drawn.".replace(" °", "°")
    return text if all(error.max(initial=0.0) <= ROUNDING for error in errors) else ""


def error_axis(axis: Axes, name: str, unit: str, *errors: NDArray[np.float64]) -> None:
    """Label and limit an axis of errors [mm or °], logarithmic if the errors differ by more than ``SPREAD``.

    Rounding errors, and a peak or an exact sample at the start, do not extend the axis; a note names its lower end.
    """
    axis.set_ylabel(f"{name}\n[{unit}]")
    values = np.concatenate(errors)
    high = max(float(values.max(initial=0.0)), ROUNDING)
    seen = values[values > ROUNDING]
    low = float(np.percentile(seen, 2)) if len(seen) else high
    if high < SPREAD * low:
        axis.set_ylim(0.0, 1.1 * high)
        return
    axis.set_ylim(0.7 * low, 1.5 * high)
    style.log_axis(axis)
    locator: Any = axis.yaxis.get_major_locator()
    locator.set_params(numticks=6)  # otherwise low panels have labels at two decades only
    figure: Any = axis.figure
    if any((error[1:] < 0.7 * low).any() for error in errors):
        hidden = sum(bool((error < 0.7 * low).all()) for error in errors)
        runs = f" ({hidden} of {len(errors)} variants)" if hidden else ""
        end = f"{style.number(0.7 * low, 2)} {unit}".replace(" °", "°")
        figure.note(f"{name.capitalize()}s below {end} are not shown{runs}.")


def above_edge(axis: Axes) -> None:
    """Start the axis of a positive quantity slightly below zero, so that its frame does not cover curves at zero."""
    axis.set_ylim(bottom=-0.03 * axis.get_ylim()[1])


def moving(records: Sequence[Record]) -> tuple[list[int], str]:
    """Return the coordinates of the controlled point that vary in any run, and a note on the others."""
    shown, still = [], []
    for i, name in enumerate(records[0].labels["w"]):
        scale, unit = (1e3, " mm") if i < 3 else (DEGREES, "°")
        both = [scale * record[signal][:, i] for record in records for signal in ("w", "w_target")]
        if max(np.ptp(values) for values in both) > STILL[i // 3]:
            shown.append(i)
            continue
        off = max(np.abs(w - target).max() for w, target in zip(both[::2], both[1::2], strict=True))
        still.append(f"{SYMBOLS.get(name, name)} ({style.number(round(off, 2), 2)}{unit})")
    note = f"Constant and not drawn, with the largest distance from the target: {', '.join(still)}."
    return shown, note if still else ""


def moments(record: Record, count: int) -> NDArray[np.int64]:
    """Return the rows of ``count`` evenly spaced samples, including the first and the last."""
    return np.unique(np.linspace(0, len(record.time) - 1, min(count, len(record.time))).round().astype(np.int64))


def limits(clouds: list[NDArray[np.float64]], margin: float) -> tuple[float, float, float, float]:
    """Return x and y limits that contain all points and a margin."""
    points = np.vstack(clouds)
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    return float(x0), float(x1), float(y0), float(y1)


def greek(name: str) -> str:
    """Return a joint name with its Greek letter."""
    return name.replace("theta", "θ").replace("psi", "ψ")


def _explain(figure: style.Drawing, views: Sequence[View], more: Mapping[str, Any]) -> None:
    """Add a legend of the views below a figure."""
    entries: dict[str, Any] = {
        "body": Line2D([], [], color=BODY, lw=1.8),
        "wheel on ground": Patch(facecolor=GROUND, edgecolor=EDGE),
        "wheel lifted": Patch(facecolor=LIFT, edgecolor=EDGE),
        "support polygon": Patch(facecolor=SUPPORT, alpha=0.25),
        "centre of mass": Line2D([], [], color="black", marker="x", ls="", ms=4),
        "controlled point": Line2D([], [], color=HEAD, marker="o", ls="", ms=2.8),
        **more,
    }
    if any(len(view.surfaces) > 1 for view in views):
        entries["surface"] = Patch(facecolor="#ECECEC", edgecolor=style.GREY, lw=0.8)
    if any(view.objects for view in views):
        entries["object"] = Patch(facecolor=OBJECT, edgecolor=RIM, lw=0.8)
    figure.put_below(entries, 5)
