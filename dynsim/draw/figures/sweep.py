"""Figures of a sweep: values over the grid, energy versus error, distributions and sensitivities.

The figures require only the table of the sweep.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import LogLocator, MaxNLocator

from dynsim.draw.figures import style
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.style import Array
from dynsim.record.quantities import ENERGY, ERRORS, Quantity, rounded, summary_quantity
from dynsim.record.sensitivity import LEVEL, Sensitivities, sensitivities, spread

# Maximum number of parameters in a tornado diagram with one or two variants, and with more; of bars in a histogram.
_PARAMETERS, _FEW, _BINS = 12, 8, 40
# Values whose ratio exceeds this are drawn on a logarithmic axis or colour scale; values of a grid need a larger ratio.
_WIDE, _WIDE_GRID = 8.0, 20.0
# Height of a panel; heights of a bar in a tornado diagram, of the margins, and of a colour bar [inch].
_PANEL, _BAR, _ROOM, _COLOURS = 2.1, 0.1, 0.9, 0.6
# Minimum width of panels that are side by side; many panels may be narrower in a narrow figure [inch].
_ACROSS, _ACROSS_MANY = 2.3, 1.6
# Maximum number of panels of a narrow figure that are below each other; more panels than _MANY are always narrower.
_STACKED, _MANY = 4, 8
# Maximum number of variants whose maps are drawn.
_MAPS = 6
# Maximum number of distributions below each other, and the height of one [inch].
_ROWS, _LOW = 5, 1.6
# Markers of variants; maximum number of runs that are labelled with their number, and size of these numbers [point].
_MARKERS, _NUMBERED, _DIGITS = "osD^vP*X", 12, 7.0
# Steps between ticks, as multiples of a power of ten.
_STEPS = (1, 2, 2.5, 5, 10)
# Marks in the cells of a map that have no colour.
_MISSING = {"x": "no run succeeded", "_": "number does not exist"}
# Values farther beyond the middle 80 % than this multiple of their range are beyond the axis.
_FAR = 30.0
# Height of a row of words [inch]; part of the axis below which intervals and bars are too short to be seen.
_WORDS, _SHORT = 0.4, 0.02
# Maximum number of rows of a map whose cells contain numbers, and minimum size of these numbers [point].
_CELLS, _LEAST = 12, 5.0


@dataclass(frozen=True)
class Sweep:
    """Table of the runs of a sweep.

    Attributes
    ----------
    name : str
        Name of the scenario.
    rows : sequence of mapping
        Results and varied values by column; a failed run has its varied values and a ``status`` other than "ok".
    grid, sampled : sequence of str
        Columns that were varied.
    known : sequence of str
        All variants of the scenario in their order, so that colours do not depend on which variants were run.
    plotted : sequence of str
        Columns to draw; default: energy and error.
    keys : mapping of str to Quantity
        Name, symbol and unit of the varied columns; default: the columns themselves.
    """

    name: str
    rows: Sequence[Mapping[str, Any]]
    grid: Sequence[str]
    sampled: Sequence[str]
    known: Sequence[str] = ()
    plotted: Sequence[str] = ()
    keys: Mapping[str, Quantity] = field(default_factory=dict)

    @property
    def variants(self) -> list[str]:
        """Variants in the order of the table; a single variant without a name if the table lists no variants."""
        return list(dict.fromkeys(str(row.get("variant", "")) for row in self.rows))

    def figure(self, height: float, subject: str) -> style.Drawing:
        """Create a figure; its title has the scenario and a single variant, and a note the number of failed runs."""
        variant = f" / {self.variants[0]}" if len(self.variants) == 1 and self.variants[0] else ""
        figure = style.new_figure(height, f"{style.spaced(self.name)}{variant}: {subject}")
        if bad := sum(map(_failed, self.rows)):
            figure.note(f"{bad} of {len(self.rows)} runs failed.")
        return figure

    @property
    def looks(self) -> dict[str, dict[str, Any]]:
        """Colour and width of every variant."""
        return style.variant_styles(list(dict.fromkeys([*self.known, *self.variants])))

    @property
    def metrics(self) -> dict[str, Quantity]:
        """Columns to draw that are in the table: the requested columns, or energy and error."""
        wanted = self.plotted or [ENERGY, *filter(self._has, ERRORS)][:2]
        return {key: summary_quantity(key).fitted(_values(self.rows, key).tolist()) for key in wanted if self._has(key)}

    def varied(self, key: str) -> Quantity:
        """Return the quantity of a varied column; lengths are in millimetres if all are small."""
        return self.keys.get(key, Quantity(key)).fitted(row[key] for row in self.rows)

    def value(self, key: str, value: Any) -> str:
        """Return a text with a value of a varied column, e.g. "μ = 0.1"."""
        varied = self.varied(key)
        text = style.number(varied.scale * value) if _numeric([value]) else value
        return f"{varied.symbol or varied.name} = {text}{f' {varied.unit}' if varied.unit else ''}"

    def deviation(self, key: str) -> str:
        """Return the name of a sampled column with its standard deviation, e.g. "mass of link 2 ± 0.005 kg"."""
        varied = self.varied(key)
        size = f"{varied.scale * float(np.std(_values(self.rows, key), ddof=1)):#.2g}".rstrip(".")
        return f"{varied.name} ± {size}{f' {varied.unit}' if varied.unit else ''}"

    def _has(self, key: str) -> bool:
        return any(row.get(key) is not None for row in self.rows)

    def of(self, variant: str) -> list[Mapping[str, Any]]:
        """Return the rows of one variant."""
        return [row for row in self.rows if str(row.get("variant", "")) == variant]


def draw(sweep: Sweep, folder: Path, kind: str = "png", look: Look | None = None) -> list[Path]:
    """Draw every figure for which the table has data; return the files.

    Raises
    ------
    RecordError
        If a file cannot be written.
    """
    with style.look(look):
        return style.save_all(FIGURES, sweep, folder, kind) if sweep.rows and sweep.metrics else []


def lines(sweep: Sweep) -> Figure | None:
    """Draw energy and error over the grid if it has a single key; return None if it has no or several keys.

    Values that are words are rows. Crosses on the axis mark values at which a variant has no successful run.
    """
    if len(sweep.grid) != 1:
        return None
    (key,) = sweep.grid
    levels = _levels(sweep.rows, key)
    if not _numeric(levels):
        return _words(sweep, key, levels)
    styles, metrics, varied = sweep.looks, sweep.metrics, sweep.varied(key)
    figure = sweep.figure(_PANEL * len(metrics) + _ROOM, f"effect of the {varied.name}")
    panels = figure.subplots(len(metrics), 1, sharex=True, squeeze=False)[:, 0]
    at = varied.scale * np.array(levels, dtype=float)
    shaded, good = False, _succeeded(sweep, key, levels)
    inside = at[np.any(list(good.values()), axis=0)]
    if not len(inside):
        return None
    for axes, (metric, drawn) in zip(panels, metrics.items(), strict=True):
        for k, variant in enumerate(sweep.variants):
            # Hollow markers of decreasing size show curves that coincide.
            look: dict[str, Any] = {
                "color": styles[variant]["color"], "linewidth": 1.0, "marker": _MARKERS[k % len(_MARKERS)],
                "markersize": 3.5 + 2.5 * 0.5**k, "markerfacecolor": "none", "clip_on": False,
            }  # fmt: skip
            groups = [_values(_at(sweep.of(variant), {key: level}), metric) * drawn.scale for level in levels]
            means = np.array([group.mean() if len(group) else np.nan for group in groups])
            if np.isfinite(means).any():
                axes.plot(at, means, label=variant or None, **look)
            if any(len(group) > 1 for group in groups):
                limits = np.array(
                    [np.quantile(group, [0.025, 0.975]) if len(group) else (np.nan,) * 2 for group in groups]
                )
                axes.fill_between(at, *limits.T, color=look["color"], alpha=0.15, linewidth=0)
                shaded = True
        axes.set_ylabel(style.broken(drawn.label, _PANEL))
        axes.margins(x=0.02)
        _scale(axes, "y", drawn.scale * _values(sweep.rows, metric))
        _clip(figure, axes, drawn, drawn.scale * _values(sweep.rows, metric))
    figure.align_ylabels(panels)
    bad = [value for value, *fine in zip(at, *good.values(), strict=True) if not all(fine) and value in inside]
    for axes in panels if bad else ():
        look = {"transform": axes.get_xaxis_transform(), "color": style.BLACK, "clip_on": False, "zorder": 5}
        axes.plot(bad, np.zeros(len(bad)), "x", markersize=5.0, label="variants without a successful run", **look)
    panels[-1].set_xlabel(style.broken(_label(varied)))
    if _is_geometric(at):
        style.log_axis(panels[-1], "x")
    elif style.narrow():
        panels[-1].xaxis.set_major_locator(MaxNLocator(5, steps=_STEPS))
    if len(sweep.variants) > 1 or bad:
        style.legend_below(figure, list(panels), 4)
    if shaded:
        figure.note(f"Lines: means over {_listed(sweep, sweep.sampled)}; shaded: 95 % of the runs.")
    _note_failures(figure, sweep, key, good)
    return figure


def _words(sweep: Sweep, key: str, levels: Sequence[Any]) -> Figure:
    """Draw energy and error at values that are words or truth values, which are the rows of the panels."""
    metrics, name = sweep.metrics, sweep.varied(key).name
    grid = _Grid([1] * len(metrics), _ACROSS)
    height = (_WORDS * len(levels) + _ROOM) * grid.rows
    figure = sweep.figure(height, f"effect of the {name}")
    panels = [row[0] for row in grid.subplots(figure)]
    for m, (axes, (metric, drawn)) in enumerate(zip(panels, metrics.items(), strict=True)):
        for k, variant in enumerate(sweep.variants):
            groups = [_values(_at(sweep.of(variant), {key: level}), metric) * drawn.scale for level in levels]
            means = [group.mean() if len(group) else np.nan for group in groups]
            look = {"color": sweep.looks[variant]["color"], "markersize": 3.5 + 2.5 * 0.5**k}
            if np.isfinite(means).any():
                axes.plot(
                    means, range(len(levels)), _MARKERS[k % len(_MARKERS)],
                    markerfacecolor="none", label=variant or None, **look,
                )  # fmt: skip
        axes.set(ylim=(len(levels) - 0.5, -0.5), xlabel=style.broken(drawn.label, 0.8 * grid.width))
        axes.set_yticks(range(len(levels)), [f"{name.split()[-1]} {level}" for level in levels])
        axes.tick_params(labelleft=m % grid.beside == 0)
        axes.margins(x=0.05)
        _scale(axes, "x", drawn.scale * _values(sweep.rows, metric))
    if len(sweep.variants) > 1:
        style.legend_below(figure, panels, 4)
    _note_failures(figure, sweep, key, _succeeded(sweep, key, levels))
    return figure


def _succeeded(sweep: Sweep, key: str, levels: Sequence[Any]) -> dict[str, list[bool]]:
    """Return for each variant at which values of a key not all runs failed."""
    return {v: [not all(map(_failed, _at(sweep.of(v), {key: level}))) for level in levels] for v in sweep.variants}


def _note_failures(figure: style.Drawing, sweep: Sweep, key: str, good: Mapping[str, Sequence[bool]]) -> None:
    """Note at which values of a key no run of a variant succeeded; variants with equal values share a sentence."""
    groups: dict[str, list[str]] = {}
    levels = _levels(sweep.rows, key)
    for variant, fine in good.items():
        bad = [level for level, well in zip(levels, fine, strict=True) if not well]
        values = ", ".join(sweep.value(key, level).partition(" = ")[2] for level in bad)
        if bad:
            groups.setdefault(values if len(bad) <= _FEW else f"{len(bad)} of {len(levels)} values", []).append(variant)
    parts = [f"{', '.join(filter(None, variants))} at {values}".strip() for values, variants in groups.items()]
    if parts:
        figure.note(f"No run succeeded: {'; '.join(parts)}.")


def heat_map(sweep: Sweep) -> Figure | None:
    """Draw energy and error of each variant over the first two grid keys, averaged over all other keys."""
    if len(sweep.grid) < 2:
        return None
    x, y = sweep.grid[:2]
    metrics, able = sweep.metrics, [v for v in sweep.variants if not all(map(_failed, sweep.of(v)))]
    # A variant without a contact, for example, lacks the force of this contact.
    variants = {
        metric: [v for v in sweep.variants if any(row.get(metric) is not None for row in sweep.of(v))][:_MAPS]
        for metric in metrics
    }
    xs, ys = _levels(sweep.rows, x), _levels(sweep.rows, y)
    grid = _Grid([len(drawn) for drawn in variants.values()], _ACROSS)
    panel = (0.6 if grid.rows > 4 else 0.75 if grid.rows > 3 or style.narrow() else 1.0) * _PANEL
    height = panel * grid.rows + _ROOM + _COLOURS * len(grid.bands)
    figure = sweep.figure(height, f"effect of the {sweep.varied(x).name} and the {sweep.varied(y).name}")
    panels = grid.subplots(figure)
    for m, (row, (metric, drawn)) in enumerate(zip(panels, metrics.items(), strict=True)):
        tables = np.full((len(variants[metric]), len(ys), len(xs)), np.nan)
        failed = np.zeros(tables.shape, dtype=bool)
        for k, variant in enumerate(variants[metric]):
            for j, b in enumerate(ys):
                for i, a in enumerate(xs):
                    runs = list(_at(sweep.of(variant), {x: a, y: b}))
                    values = _values(runs, metric) * drawn.scale
                    tables[k, j, i] = values.mean() if len(values) else np.nan
                    failed[k, j, i] = not len(values) and all(map(_failed, runs))
        low, high = np.nanmin(tables), np.nanmax(tables)
        norm = LogNorm(low, high) if _is_wide(low, high) else Normalize(low, high)
        texts = np.vectorize(_rounded, otypes=[object])(tables)
        written = _fit_cells(texts, grid.width)
        for k, (axes, table, bad, variant) in enumerate(zip(row, tables, failed, variants[metric], strict=False)):
            if len(sweep.variants) > 1:
                axes.set_title(variant)
            image = axes.imshow(table, origin="lower", aspect="auto", cmap="viridis", norm=norm)
            axes.grid(visible=False)
            axes.autoscale(enable=False)
            for marker, mask in (("x", bad), ("_", np.isnan(table) & ~bad)):
                if mask.any():
                    row_index, column = np.nonzero(mask)
                    axes.plot(column, row_index, marker, color=style.GREY, markersize=4.0, label=_MISSING[marker])
            if written:
                _write_cells(axes, image, table, texts[k], written)
            _name_cells(axes, "y", sweep.varied(y), ys, 8, 0.55 * panel)
            _name_cells(axes, "x", sweep.varied(x), xs, 8 if grid.width > _ACROSS else 5, 0.8 * grid.width)
            if k % grid.columns or (m % grid.beside and k < len(variants[next(iter(metrics))])):
                axes.tick_params(labelleft=False)
                axes.set_ylabel("")
            if k + grid.columns < len(tables):
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
        # Place the colour bar below its panels; next to them, the label would be at the next column.
        name = style.broken(drawn.label, 0.85 * grid.width * grid.columns)
        bar = figure.colorbar(image, ax=row, label=name, location="bottom", aspect=30 * grid.columns, pad=0.02)
        ticks = max(int(1.8 * grid.width * grid.columns), 2)
        if not isinstance(norm, LogNorm):
            bar.locator = MaxNLocator(min(ticks, 8), steps=_STEPS)
        else:
            style.log_axis(bar.ax, "x")
            if high > 200.0 * low or ticks < 4:
                subs = (1.0,) if high > 200.0 * low else (1.0, 3.0)
                bar.ax.xaxis.set_major_locator(LogLocator(subs=subs, numticks=max(ticks, 3)))
        if lacking := [v for v in able if all(row.get(metric) is None for row in sweep.of(v))]:
            figure.note(f"{drawn.name}: does not exist for {', '.join(lacking)}.")
    if failing := [v for v in sweep.variants if v not in able]:
        figure.note(f"{', '.join(failing)}: no run succeeded.")
    if len(able) > _MAPS:
        figure.note(f"Maps of the first {_MAPS} of {len(able)} variants.")
    style.legend_below(figure, [axes for row in panels for axes in row], 2)
    if others := [*sweep.grid[2:], *sweep.sampled]:
        figure.note(f"Mean over {_listed(sweep, others)}.")
    return figure


@dataclass(frozen=True)
class _Grid:
    """Arrangement of the panels of several metrics: metrics side by side, or below each other in a narrow figure.

    Attributes
    ----------
    members : sequence of int
        Number of panels of each metric.
    across : float
        Minimum width of a panel [inch].
    """

    members: Sequence[int]
    across: float

    @property
    def fit(self) -> int:
        """Number of panels that fit side by side."""
        few = style.narrow() and sum(self.members) <= _STACKED
        across = _ACROSS_MANY if style.narrow() or sum(self.members) > _MANY else self.across
        return 1 if few else max(1, int(style.width() / across))

    @property
    def beside(self) -> int:
        """Number of metrics that are side by side, without gaps, so that the figure has few rows."""
        equal = len(set(self.members)) == 1
        counts = [k for k in range(self.fit, 0, -1) if k == 1 or (equal and len(self.members) % k == 0)]
        return min(counts, key=lambda k: -(-max(self.members) // (self.fit // k)) * (len(self.members) // k))

    @property
    def columns(self) -> int:
        """Number of columns of the panels of a metric, so that its rows are equally long."""
        most = max(self.members)
        return -(-most // -(-most // min(most, self.fit // self.beside)))

    @property
    def bands(self) -> list[int]:
        """Number of rows of each group of metrics that are side by side."""
        groups = range(0, len(self.members), self.beside)
        return [-(-max(self.members[k : k + self.beside]) // self.columns) for k in groups]

    @property
    def rows(self) -> int:
        """Number of rows of the figure."""
        return sum(self.bands)

    @property
    def width(self) -> float:
        """Width of a panel [inch]."""
        return style.width() / (self.beside * self.columns)

    def subplots(self, figure: Figure) -> list[list[Axes]]:
        """Create the axes and return those of each metric; those beyond its members are at the end and empty.

        A single panel has the width of its row.
        """
        axes = figure.subplots(self.rows, self.beside * self.columns, squeeze=False)
        panels = []
        for m, count in enumerate(self.members):
            band, left = m // self.beside, m % self.beside * self.columns
            first = sum(self.bands[:band])
            block = axes[first : first + self.bands[band], left : left + self.columns].ravel()
            for empty in block[count:]:
                empty.set_axis_off()
            if count == 1:
                spec = block[0].get_subplotspec().get_gridspec()
                block[0].set_subplotspec(spec[first, left : left + self.columns])
            panels.append(list(block))
        return panels


def _fit_cells(texts: Any, across: float) -> float:
    """Return the size of letters with which texts fit into the cells of maps ``across`` wide [inch]; 0 if too small."""
    # Labels of ticks and axes are 0.45 in wide; digits are wider than the mean letter.
    space = 72.0 * (across - 0.45) / texts.shape[2] - 3.0
    size = min(style.letters(_DIGITS), space / (1.15 * style.LETTER * max(map(len, texts.flat))))
    return size if size >= _LEAST and texts.shape[1] <= _CELLS else 0.0


def _write_cells(axes: Axes, image: AxesImage, table: Array, texts: Any, size: float) -> None:
    """Write the values of a map into its cells, in black or white depending on the colour."""
    for (row, column), text in np.ndenumerate(texts):
        shade = image.cmap(image.norm(table[row, column]))[:3]
        colour = "black" if np.dot(shade, (0.3, 0.6, 0.1)) > 0.5 else "white"
        axes.text(column, row, text, ha="center", va="center", fontsize=size, color=colour)


def pareto(sweep: Sweep) -> Figure | None:
    """Draw energy versus error of all runs, and number the runs on the Pareto front; return None if one is missing."""
    if sweep.plotted or len(sweep.metrics) < 2:
        return None
    (energy, up), (error, right) = sweep.metrics.items()
    rows = [row for row in sweep.rows if None not in (row.get(error), row.get(energy))]
    figure = sweep.figure(3.6, "energy versus error")
    axes = figure.subplots()
    styles = sweep.looks
    points = np.array([(right.scale * row[error], up.scale * row[energy]) for row in rows], dtype=float).reshape(-1, 2)
    front = best(list(map(tuple, points)))
    on_front = (points[:, None] == front).all(axis=2).any(axis=1)
    for k, variant in enumerate(sweep.variants):
        mine = np.array([str(row.get("variant", "")) == variant for row in rows], dtype=bool)
        look: dict[str, Any] = {
            "marker": _MARKERS[k % len(_MARKERS)],
            "s": 24 if len(rows) < 500 else 6,
            "linewidths": 0.9,
        }
        colour = styles[variant]["color"]
        # Empty markers of equal runs remain visible.
        axes.scatter(*points[mine].T, facecolors="none", edgecolors=colour, label=variant or None, zorder=3, **look)
        axes.scatter(*points[mine & on_front].T, color=colour, zorder=4, **look)
    # No run is both to the left of the steps and below them.
    steps: dict[str, Any] = {"color": style.GREY, "linewidth": 0.8, "drawstyle": "steps-post", "zorder": 2}
    axes.plot(*front.T, **steps)
    alone = len(front) == 1
    filled: dict[str, Any] = {"marker": "o", "markersize": 5, "color": style.GREY, "linewidth": 0.0 if alone else 0.8}
    axes.plot([], [], label="best run" if alone else "Pareto front", **filled)
    axes.margins(0.1)
    axes.set(xlabel=right.label, ylabel=up.label)
    _scale(axes, "x", points[:, 0])
    _scale(axes, "y", points[:, 1])
    style.legend_below(figure, [axes], 5)
    firsts = [(points == at).all(axis=1).argmax() for at in front]
    few = len(rows) < len(sweep.rows) - sum(map(_failed, sweep.rows))
    text = f"{len(rows)} runs{' have both numbers' if few else ''}."
    about = [_described(sweep, rows[k]) for k in firsts]
    if alone:
        text += f" Best run{f' ({about[0]})' if about[0] else ''}: least energy and least error."
    else:
        text += " Pareto front: no run is better in both."
        if len(front) <= _NUMBERED and all("run" in row for row in rows):
            numbers = [str(rows[k]["run"]) for k in firsts]
            _number_runs(figure, axes, front, numbers)
            text += " Numbers: runs as in the table, the first of equal runs"
            named = [f"{number}: {run}" for number, run in zip(numbers, about, strict=True) if run]
            text += f" ({'; '.join(named)})." if named else "."
    figure.note(text)
    return figure


def _described(sweep: Sweep, run: Mapping[str, Any]) -> str:
    """Return the variant of a run and its values of the grid."""
    values = [sweep.value(key, run[key]).replace(" = ", "\u00a0=\u00a0") for key in sweep.grid]
    return ", ".join(filter(None, [str(run.get("variant", "")), *values]))


def _number_runs(figure: Figure, axes: Axes, front: Array, texts: Sequence[str]) -> None:
    """Write the numbers of runs below the front, where no other runs are; runs close to each other share a text."""
    figure.draw_without_rendering()
    size, gap = style.letters(_DIGITS), 4.0
    at = axes.transData.transform(front) * 72.0 / figure.dpi
    box = axes.get_window_extent()
    left, bottom = box.x0 * 72.0 / figure.dpi, box.y0 * 72.0 / figure.dpi
    groups: list[list[int]] = []
    for k, point in enumerate(at):
        if groups and (np.abs(point - at[groups[-1][-1]]) < (4.0 * size, 1.5 * size)).all():
            groups[-1].append(k)
        else:
            groups.append([k])
    for group in groups:
        k, align, text = group[0], "right", ", ".join(texts[i] for i in group)
        if at[k, 0] - style.LETTER * size * len(text) - gap < left:
            # The lower right is empty as well, up to the next run on the front.
            k, align = group[-1], "left"
            if k + 1 < len(at):
                count = max(int((at[k + 1, 0] - at[k, 0] - 3.0 * gap) / (style.LETTER * size)), 2)
                text = textwrap.fill(text, count, break_long_words=False)
        below = at[k, 1] - 1.2 * size * (text.count("\n") + 1) - gap > bottom
        axes.annotate(
            text, front[k], xytext=(gap if align == "left" else -gap, -gap if below else gap),
            textcoords="offset points", fontsize=size, ha=align, va="top" if below else "bottom", zorder=5,
        )  # fmt: skip


def best(points: Sequence[tuple[float, float]]) -> Array:
    """Return the points that no other point dominates, sorted by the first coordinate, (k, 2)."""
    front: list[tuple[float, float]] = []
    for x, y in sorted(points):
        if not front or y < front[-1][1]:
            front.append((x, y))
    return np.array(front).reshape(-1, 2)


def samples(sweep: Sweep) -> Figure | None:
    """Draw the distribution of energy and error over the samples; return None without samples.

    The figure has one panel per variant and grid point, because variation due to the grid is not part of the
    distribution and all grid points have the same draws. If there are many grid points, only some, evenly spaced, are
    shown.
    """
    if not sweep.sampled:
        return None
    metrics, variants = sweep.metrics, sweep.variants
    # Each combination of grid values once, in the order of the table.
    firsts = [sweep.rows[rows[0]] for rows in _grouped(sweep.rows, sweep.grid).values()]
    points = [{key: row[key] for key in sweep.grid} for row in firsts]
    room = max(_ROWS // len(variants), 1)
    shown = [points[k] for k in np.linspace(0, len(points) - 1, min(room, len(points))).round().astype(int)]
    members = [(variant, point) for variant in variants for point in shown]
    grid = _Grid([len(members)] * len(metrics), _ACROSS)
    figure = sweep.figure(
        (_LOW if grid.rows > 1 else _PANEL) * grid.rows + _ROOM,
        "distribution of random runs",
    )
    for m, (row, (metric, drawn)) in enumerate(zip(grid.subplots(figure), metrics.items(), strict=True)):
        for k, (axes, (variant, point)) in enumerate(zip(row, members, strict=False)):
            values = _values(_at(sweep.of(variant), point), metric) * drawn.scale
            heads = [variant] * (len(variants) > 1) + [sweep.value(key, at) for key, at in point.items()]
            head = ", ".join(heads) if len(members) > 1 else ""
            texts = _distribution(axes, values, drawn.unit, sweep.looks[variant]["color"], grid.width)
            title = "\n".join(filter(None, [head, texts]))
            axes.set_title(style.broken(title, 0.85 * grid.width, style.letters(7.5)), fontsize=style.letters(7.5))
            if k >= len(members) - grid.columns:
                axes.set_xlabel(style.broken(drawn.label, 0.8 * grid.width))
            if k % grid.columns == 0 and m % grid.beside == 0:
                axes.set_ylabel("runs")
    each = f", {len(sweep.rows) // (len(variants) * len(points))} in each panel" if len(members) > 1 else ""
    figure.note(
        f"{len(sweep.rows)} runs{each}. Random: {_listed(sweep, sweep.sampled)}. Line and first number: mean; after "
        f"±: its {100 * LEVEL:g} % interval; dashed: limits of {100 * LEVEL:g} % of the runs."
    )
    if len(shown) < len(points):
        figure.note(f"{len(shown)} of {len(points)} grid points; statistics.json contains all.")
    return figure


def _distribution(axes: Axes, values: Array, unit: str, colour: str, across: float) -> str:
    """Draw the draws at one grid point as a histogram ``across`` wide [inch]; return mean and interval as text."""
    if len(values) < 2 or np.ptp(values) == 0.0:
        axes.set_axis_off()
        few = f"too few runs with numbers: {len(values)}"
        return few if len(values) < 2 else f"{len(values)} runs, all {style.number(values[0])} {unit}".rstrip()
    # Bin width by the rule of Freedman and Diaconis, or of Sturges for few samples.
    bins = min(_BINS, len(np.histogram_bin_edges(values, "auto")) - 1)
    axes.hist(values, bins=bins, color=colour, alpha=0.7)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.xaxis.set_major_locator(MaxNLocator(4 if style.narrow() else 7, steps=_STEPS))
    statistics = spread(values)
    axes.axvline(statistics.mean, color=style.BLACK, linewidth=1.0)
    for limit in (statistics.low, statistics.high):
        axes.axvline(limit, color=style.BLACK, linewidth=0.8, linestyle=(0, (4, 2)))
    axes.margins(x=0.03)
    interval = _with_interval(statistics.mean, statistics.mean_high - statistics.mean)
    mean = f"{interval}{f' {unit}' if unit else ''},"
    limits = f"{100 * LEVEL:g} % in {_rounded(statistics.low)} … {_rounded(statistics.high)}"
    return f"{mean}{' ' if across > _ACROSS + 0.5 else chr(10)}{limits}"


def tornado(sweep: Sweep) -> Figure | None:
    """Draw the effect of one standard deviation of each sampled key; return None if no linear model can be fitted."""
    metrics = sweep.metrics
    effects = {metric: {v: fit for v in sweep.variants if (fit := _fit(sweep, v, metric))} for metric in metrics}
    effects = {metric: fits for metric, fits in effects.items() if fits}
    if not effects:
        return None
    variants = [v for v in sweep.variants if any(v in fits for fits in effects.values())]
    bars = min(len(sweep.sampled), _PARAMETERS if len(variants) < 3 else _FEW)
    grid = _Grid([1] * len(effects), 0.4 * style.WIDTH)
    small = style.letters(7.0)
    labels = [style.broken(sweep.deviation(key), 0.48 * grid.width, small) for key in sweep.sampled]
    lines = max(label.count("\n") + 1 for label in labels)
    figure = sweep.figure(
        (max(_BAR * (len(variants) + 1), 1.3 / 72.0 * small * lines) * bars + _ROOM) * grid.rows + 0.5,
        "effect of one standard deviation of each parameter",
    )
    panels = [row[0] for row in grid.subplots(figure)]
    explained: list[str] = []
    visible = False
    for axes, (metric, fits) in zip(panels, effects.items(), strict=True):
        drawn = metrics[metric]
        largest = np.max([np.abs(fit.effect) for fit in fits.values()], axis=0)
        order = np.argsort(-largest, kind="stable")[:bars][::-1]
        thick, least = 0.8 / len(variants), _SHORT * drawn.scale * largest.max()
        places = max(1 - math.floor(math.log10(least)), 0) if least > 0.0 else 0
        for k, variant in enumerate(variants):
            if variant not in fits:
                continue
            effect, half = (drawn.scale * values[order] for values in (fits[variant].effect, fits[variant].half_width))
            at = np.arange(len(order)) + (0.5 * (len(variants) - 1) - k) * thick
            look = {"color": sweep.looks[variant]["color"], "error_kw": {"elinewidth": 0.8}}
            seen = np.where(half > least, half, 0.0)
            visible |= bool(seen.any())
            axes.barh(at, effect, xerr=seen if seen.any() else None, height=thick, label=variant or None, **look)
            for height, value in zip(at, effect, strict=True):
                if abs(value) < 2.0 * least:
                    text = f"{round(value, places) + 0.0:.{places}f}".replace("-", "−")
                    look = {"xytext": (3.0, 0.0), "textcoords": "offset points", "va": "center"}
                    axes.annotate(text, (max(value, 0.0), height), fontsize=style.letters(6.0), **look)
        axes.set_yticks(range(len(order)), [labels[k] for k in order], fontsize=small)
        axes.axvline(0.0, color=style.BLACK, linewidth=0.6)
        axes.grid(visible=False, axis="y")
        axes.margins(x=0.05)
        axes.set_title(style.broken(drawn.name, 0.6 * grid.width))
        axes.set_xlabel(f"change{f' [{drawn.unit}]' if drawn.unit else ''}")
        shares = sorted({f"{100.0 * fit.explained:.4g}" for fit in fits.values()}, key=float)
        explained.append(f"{' … '.join(dict.fromkeys([shares[0], shares[-1]]))} % ({drawn.name})")
    if len(variants) > 1:
        style.legend_below(figure, panels, 4)
    size = f"shorter than {100 * _SHORT:g} % of the largest change"
    drawn_as = f"error bars, unless {size}" if visible else size
    figure.note(f"{100 * LEVEL:g} % intervals: {drawn_as}. After ±: one standard deviation.")
    figure.note(f"Variance that linear fits explain: {', '.join(explained)}.")
    if bars < len(sweep.sampled):
        figure.note(f"The {bars} largest of {len(sweep.sampled)} effects; statistics.json contains all.")
    return figure


def _fit(sweep: Sweep, variant: str, metric: str) -> Sensitivities | None:
    rows = [row for row in sweep.of(variant) if row.get(metric) is not None]
    if not rows or not sweep.sampled:
        return None
    values = np.array([row[metric] for row in rows], dtype=float)
    # Remove the effect of the grid, so that only the effect of the samples remains.
    for here in _grouped(rows, sweep.grid).values():
        values[here] -= values[here].mean()
    # All grid points have the same draws. Count each draw once, otherwise the intervals would be too narrow.
    draws = list(_grouped(rows, sweep.sampled).values())
    parameters = np.array([[rows[draw[0]][key] for key in sweep.sampled] for draw in draws], dtype=float)
    return sensitivities(parameters, np.array([values[draw].mean() for draw in draws]))


FIGURES = {
    "sweep_lines": lines,
    "sweep_map": heat_map,
    "sweep_pareto": pareto,
    "sweep_samples": samples,
    "sweep_tornado": tornado,
}


def _failed(row: Mapping[str, Any]) -> bool:
    return bool(row.get("status", "ok") != "ok")


def _rounded(value: float) -> str:
    return style.with_powers(rounded(value, zeros="#")) if np.isfinite(value) else ""


def _label(quantity: Quantity) -> str:
    """Return the label of an axis, with the symbol of the quantity if it is a letter."""
    symbol = f" {quantity.symbol}" if len(quantity.symbol) == 1 else ""
    return f"{quantity.name}{symbol}{f' [{quantity.unit}]' if quantity.unit else ''}"


def _listed(sweep: Sweep, keys: Sequence[str]) -> str:
    """Return the names of varied columns, or their number if there are many."""
    names = [sweep.varied(key).name for key in keys]
    return " and ".join(names) if len(names) < 3 else f"{names[0]}, … ({len(names)} parameters)"


def _grouped(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> dict[tuple[str, ...], list[int]]:
    """Group the indices of rows by their values of some keys."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for k, row in enumerate(rows):
        groups.setdefault(tuple(str(row[key]) for key in keys), []).append(k)
    return groups


def _levels(rows: Sequence[Mapping[str, Any]], key: str) -> list[Any]:
    """Return the values of a grid key: numbers in ascending order, others in the order of the table."""
    levels = list({str(row[key]): row[key] for row in rows}.values())
    return sorted(levels) if _numeric(levels) else levels


def _numeric(levels: Sequence[Any]) -> bool:
    return all(isinstance(level, (int, float)) and not isinstance(level, bool) for level in levels)


def _is_geometric(levels: Array) -> bool:
    """Return whether ascending levels are positive, differ widely and are not evenly spaced."""
    if len(levels) < 3 or levels[0] <= 0.0 or levels[-1] < _WIDE_GRID * levels[0]:
        return False
    return bool(np.ptp(np.diff(levels)) > 1e-6 * levels[-1])


def _name_cells(axes: Axes, which: str, varied: Quantity, levels: Sequence[Any], count: int, room: float) -> None:
    """Label the rows or columns of an image, at most about ``count`` of them; the axis is ``room`` long [inch]."""
    at, texts = np.arange(len(levels)), list(map(str, levels))
    if _numeric(levels):
        values = varied.scale * np.array(levels, dtype=float)
        if len(levels) > count and np.ptp(np.diff(values)) < 1e-6 * np.ptp(values):
            # Many evenly spaced levels have ticks at round numbers.
            ticks = MaxNLocator(count, steps=_STEPS).tick_values(values[0], values[-1])
            values = ticks[(ticks > values[0] - 1e-9) & (ticks < values[-1] + 1e-9)]
            at = np.interp(values, varied.scale * np.array(levels, dtype=float), at)
        texts = [style.number(value, 3) for value in values]
    places = max(len(text.partition(".")[2]) for text in texts)
    if _numeric(levels) and not any("e" in text for text in texts):
        texts = [f"{value:.{places}f}".replace("-", "−") for value in values]
    digits = style.LETTER * style.letters(7.5) * (max(map(len, texts)) + 1.5)
    fit = max(int(72.0 * room / digits), 1) if which == "x" else len(texts)
    every = -(-len(texts) // min(count + 1, fit))
    label = style.broken(_label(varied), room)
    axes.set(**{f"{which}ticks": at[::every], f"{which}ticklabels": texts[::every], f"{which}label": label})


def _at(rows: Sequence[Mapping[str, Any]], values: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    return (row for row in rows if all(row[key] == value for key, value in values.items()))


def _values(rows: Sequence[Mapping[str, Any]] | Iterator[Mapping[str, Any]], metric: str) -> Array:
    return np.array([row[metric] for row in rows if row.get(metric) is not None], dtype=float)


def _scale(axes: Axes, which: str, values: Array) -> None:
    """Use a logarithmic axis for positive values of very different magnitude; otherwise start at zero if possible."""
    values = values[np.isfinite(values)]
    low, high = values.min(initial=np.inf), values.max(initial=-np.inf)
    if _is_wide(low, high):
        style.log_axis(axes, which)
    elif 0.0 <= low < 0.5 * high:
        axes.set(**{f"{which}lim": (0.0, 1.05 * high)})


def _clip(figure: style.Drawing, axes: Axes, drawn: Quantity, values: Array) -> None:
    """Limit a linear axis to most of its values if a few are far beyond, with a note."""
    low, high = np.quantile(values, [0.1, 0.9])
    span = high - low
    far = (values > high + _FAR * span) | (values < low - _FAR * span)
    if far.any() and span > 0.0 and axes.get_yscale() == "linear":
        least, most = min(values[~far].min(), low), max(values[~far].max(), high)
        axes.set_ylim(least - 0.1 * span, most + 0.1 * span)
        for line in axes.lines:
            at = np.asarray(line.get_ydata(), dtype=float)
            line.set_ydata(np.where((at < least) | (at > most), np.nan, at))
        extreme = style.number(values[far][np.abs(values[far]).argmax()], 3)
        figure.note(f"{drawn.name}: {far.sum()} of {len(values)} values, up to {extreme}, are beyond the axis.")


def _with_interval(value: float, half: float) -> str:
    """Format a value and its half-width with two significant digits of the half-width."""
    places = max(1 - math.floor(math.log10(half)), 0) if half > 0.0 else 3
    return f"{value:.{places}f} ± {half:.{places}f}".replace("-", "−")


def _is_wide(low: float, high: float) -> bool:
    """Return whether values between these limits are positive and differ widely in magnitude."""
    return bool(low > 0.0 and high > _WIDE * low)
