"""Figures of a sweep: values over the grid, energy versus error, distributions and sensitivities.

The figures require only the table of the sweep.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dynsim.draw.figures import style
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.style import Array
from dynsim.record.sensitivity import LEVEL, sensitivities, spread

ENERGY = "electrical_energy_J"
# Label of each quantity, and factor to the unit in the label. The first error that the table contains is drawn.
ENERGIES = {ENERGY: ("electrical energy [J]", 1.0)}
ERRORS = {
    "hand_error_rms_m": ("hand error, rms [mm]", 1e3),
    "final_position_error_m": ("final position error [mm]", 1e3),
}
# Words in units at the end of summary keys.
UNITS = {"m", "s", "rad", "N", "A", "V", "W", "J", "kg", "per"}
# Maximum number of parameters in a tornado diagram, and of bars in a histogram.
_BARS, _BINS = 12, 40
# Values whose ratio exceeds this are drawn on a logarithmic axis or colour scale.
_WIDE = 8.0
# Height and width of a panel, and heights of a bar in a tornado diagram, of the margins, and of a colour bar [inch].
_PANEL, _ACROSS, _BAR, _ROOM = 2.1, 3.5, 0.22, 0.9
_COLOURS = 0.5
# Maximum length of an axis label, a panel title, and a part of the figure title [characters].
_LABEL, _HEAD, _PART = 34, 58, 70
# Maximum number of rows of distributions.
_ROWS = 6
# Markers of variants; maximum number of runs that are labelled with their number.
_MARKERS, _NUMBERED = "osD^vP*X", 12


@dataclass(frozen=True)
class Sweep:
    """Table of the runs of a sweep.

    Attributes
    ----------
    name : str
        Name of the scenario.
    rows : sequence of mapping
        Results and varied values by column; a failed run has only its varied values.
    grid, sampled : sequence of str
        Columns that were varied.
    known : sequence of str
        All variants of the scenario in their order, so that colours do not depend on which variants were run.
    plotted : sequence of str
        Columns to draw; default: energy and error.
    """

    name: str
    rows: Sequence[Mapping[str, Any]]
    grid: Sequence[str]
    sampled: Sequence[str]
    known: Sequence[str] = ()
    plotted: Sequence[str] = ()

    @property
    def variants(self) -> list[str]:
        """Variants in the order of the table; a single variant without a name if the table lists no variants."""
        return list(dict.fromkeys(str(row.get("variant", "")) for row in self.rows))

    @property
    def failed(self) -> str:
        """Text for titles with the number of failed runs; "" if no run failed."""
        bad = sum(all(row.get(key) is None for key in self.metrics) for row in self.rows)
        return f"; {bad} of {len(self.rows)} failed" if bad else ""

    @property
    def looks(self) -> dict[str, dict[str, Any]]:
        """Colour and width of every variant."""
        return style.variant_styles(list(dict.fromkeys([*self.known, *self.variants])))

    @property
    def metrics(self) -> dict[str, tuple[str, float]]:
        """Columns to draw that are in the table: the requested columns, or energy and error."""
        if self.plotted:
            return {key: ENERGIES.get(key) or ERRORS.get(key) or named(key) for key in self.plotted if self._has(key)}
        energies = {key: look for key, look in ENERGIES.items() if self._has(key)}
        errors = [key for key in ERRORS if self._has(key)][:1]
        return energies | {key: ERRORS[key] for key in errors}

    def _has(self, key: str) -> bool:
        return any(row.get(key) is not None for row in self.rows)

    def of(self, variant: str) -> list[Mapping[str, Any]]:
        """Return the rows of one variant."""
        return [row for row in self.rows if str(row.get("variant", "")) == variant]


def named(key: str) -> tuple[str, float]:
    """Return the label and scale of a result from its key and the unit in it; ``base.tip_margin_min`` has no unit.

    The part before the last dot is unchanged: ``elbow_c: normal force max [N]``.
    """
    name, _, number = key.rpartition(".")
    words = number.split("_")
    units: list[str] = []
    while len(words) > 1 and words[-1] in UNITS:
        units.insert(0, words.pop())
    per = units.index("per") if "per" in units else len(units)
    unit = " ".join(units[:per]) + ("/" + " ".join(units[per + 1 :]) if per < len(units) else "")
    return f"{name}{': ' if name else ''}{' '.join(words)}{f' [{unit}]' if unit else ''}", 1.0


def draw(sweep: Sweep, folder: Path, kind: str = "png", look: Look | None = None) -> list[Path]:
    """Draw every figure for which the table has data; return the files.

    Raises
    ------
    RecordError
        If a file cannot be written.
    """
    makers = {
        "sweep_lines": lines,
        "sweep_map": heat_map,
        "sweep_pareto": pareto,
        "sweep_samples": samples,
        "sweep_tornado": tornado,
    }
    with style.look(look):
        return style.save_all(makers, sweep, folder, kind) if sweep.rows and sweep.metrics else []


def lines(sweep: Sweep) -> Figure | None:
    """Draw energy and error over the grid if it has a single key; return None if it has no or several keys."""
    if len(sweep.grid) != 1:
        return None
    (key,) = sweep.grid
    styles, metrics = sweep.looks, sweep.metrics
    figure = style.new_figure(_PANEL * len(metrics) + _ROOM, f"{sweep.name}: over {key}{sweep.failed}")
    panels = figure.subplots(len(metrics), 1, sharex=True, squeeze=False)[:, 0]
    levels = _levels(sweep.rows, key)
    at = np.array(levels, dtype=float) if _numeric(levels) else np.arange(float(len(levels)))
    for axes, (metric, (label, scale)) in zip(panels, metrics.items(), strict=True):
        for variant in sweep.variants:
            look, name = styles[variant], variant or None
            groups = [_values(_at(sweep.of(variant), {key: level}), metric) * scale for level in levels]
            means = np.array([group.mean() if len(group) else np.nan for group in groups])
            axes.plot(at, means, marker="o", markersize=3, label=name, clip_on=False, **look)
            if any(len(group) > 1 for group in groups):
                limits = np.array(
                    [np.quantile(group, [0.025, 0.975]) if len(group) else (np.nan,) * 2 for group in groups]
                )
                axes.fill_between(at, *limits.T, color=look["color"], alpha=0.15, linewidth=0)
        axes.set_ylabel(label)
        _scale(axes, "y", scale * _values(sweep.rows, metric))
    panels[-1].set_xlabel(key)
    if not _numeric(levels):
        panels[-1].set_xticks(at, list(map(str, levels)))
    if len(sweep.variants) > 1:
        style.legend_above(panels[0], columns=4)
    return figure


def heat_map(sweep: Sweep) -> Figure | None:
    """Draw energy and error of each variant over the first two grid keys, averaged over all other keys."""
    if len(sweep.grid) < 2:
        return None
    x, y = sweep.grid[:2]
    metrics, variants = sweep.metrics, sweep.variants
    others = [*sweep.grid[2:], *sweep.sampled]
    note = f" (mean over {_short(', '.join(others), _PART)})" if others else ""
    title = f"{sweep.name}: over {x} and {y}{note}{sweep.failed}"
    figure = style.new_figure(_PANEL * len(variants) + _ROOM + _COLOURS, title)
    panels = figure.subplots(len(variants), len(metrics), squeeze=False, sharex=True, sharey=True)
    xs, ys = _levels(sweep.rows, x), _levels(sweep.rows, y)
    empty = False
    for column, (metric, (label, scale)) in zip(panels.T, metrics.items(), strict=True):
        tables = [np.full((len(ys), len(xs)), np.nan) for _ in variants]
        for table, variant in zip(tables, variants, strict=True):
            for j, b in enumerate(ys):
                for i, a in enumerate(xs):
                    values = _values(_at(sweep.of(variant), {x: a, y: b}), metric) * scale
                    table[j, i] = values.mean() if len(values) else np.nan
        low, high = np.nanmin(tables), np.nanmax(tables)
        empty = empty or bool(np.isnan(tables).any())
        norm = LogNorm(low, high) if _is_wide(low, high) else Normalize(low, high)
        for axes, table, variant in zip(column, tables, variants, strict=True):
            image = axes.imshow(table, origin="lower", aspect="auto", cmap="viridis", norm=norm)
            axes.grid(visible=False)
            axes.set_facecolor(style.GREY)
            axes.set_title(variant)
            _name_cells(axes, "y", y, ys)
            _name_cells(axes, "x", x, xs)
        # Place the colour bar below its column; next to it, the label would be at the next column.
        bar = figure.colorbar(image, ax=list(column), label=label, location="bottom", aspect=30, pad=0.02)
        if isinstance(norm, LogNorm):
            style.log_axis(bar.ax, "x")
    if empty:
        figure.legend(handles=[Patch(color=style.GREY, label="no run succeeded")], loc="outside lower right")
    for axes in panels[:, 1:].flat:
        axes.set_ylabel("")
    for axes in panels[:-1].flat:
        axes.set_xlabel("")
    return figure


def pareto(sweep: Sweep) -> Figure | None:
    """Draw energy versus error of all runs, and number the runs on the Pareto front; return None if one is missing."""
    if sweep.plotted or len(sweep.metrics) < 2:
        return None
    (energy, (energy_label, _)), (error, (error_label, scale)) = sweep.metrics.items()
    figure = style.new_figure(3.6, f"{sweep.name}: energy versus error, {len(sweep.rows)} runs{sweep.failed}")
    axes = figure.subplots()
    styles, last = sweep.looks, max(len(sweep.variants) - 1, 1)
    for k, variant in enumerate(sweep.variants):
        points = [
            (row[error], row[energy]) for row in sweep.of(variant) if None not in (row.get(error), row.get(energy))
        ]
        xs, ys = np.array(points, dtype=float).reshape(-1, 2).T
        # Earlier variants are larger, so that equal runs appear as concentric rings.
        larger = 1.0 + 1.8 * (len(sweep.variants) - 1 - k) / last
        size = (18 if len(sweep.rows) < 500 else 4) * larger**2
        mark = {"color": styles[variant]["color"], "marker": _MARKERS[k % len(_MARKERS)]}
        axes.scatter(scale * xs, ys, s=size, label=variant or None, linewidths=0, zorder=3, **mark)
    rows = [row for row in sweep.rows if None not in (row.get(error), row.get(energy))]
    front = best([(scale * row[error], row[energy]) for row in rows])
    numbered = len(front) <= _NUMBERED and all("run" in row for row in rows)
    for x, y in front if numbered else ():
        run = next(row["run"] for row in rows if (scale * row[error], row[energy]) == (x, y))
        axes.annotate(
            f"{run}", (x, y), xytext=(5.0, 4.0), textcoords="offset points", fontsize=style.letters(7.0), zorder=5
        )
    axes.plot(
        *front.T,
        color=style.BLACK,
        linewidth=0.7,
        # No run is both to the left of the steps and below them.
        drawstyle="steps-post",
        marker="o",
        markersize=5,
        markerfacecolor="none",
        label=f"no run is better in both{', numbered as in the table' if numbered else ''}",
        zorder=4,
    )
    axes.margins(0.05)
    axes.set(xlabel=error_label, ylabel=energy_label)
    _scale(axes, "x", np.array([scale * row[error] for row in rows]))
    _scale(axes, "y", np.array([row[energy] for row in rows]))
    style.legend_above(axes, columns=len(sweep.variants) + 1)
    return figure


def best(points: Sequence[tuple[float, float]]) -> Array:
    """Return the points that no other point dominates, sorted by the first coordinate, (k, 2)."""
    front: list[tuple[float, float]] = []
    for x, y in sorted(points):
        if not front or y < front[-1][1]:
            front.append((x, y))
    return np.array(front).reshape(-1, 2)


def samples(sweep: Sweep) -> Figure | None:
    """Draw the distribution of energy and error over the samples; return None without samples.

    The figure has one row per variant and grid point, because variation due to the grid is not part of the distribution
    and all grid points have the same draws. If there are many grid points, only some, evenly spaced, are shown.
    """
    if not sweep.sampled:
        return None
    metrics, variants = sweep.metrics, sweep.variants
    # Each combination of grid values once, in the order of the table.
    firsts = [sweep.rows[rows[0]] for rows in _grouped(sweep.rows, sweep.grid).values()]
    places = [{key: row[key] for key in sweep.grid} for row in firsts]
    room = max(_ROWS // len(variants), 1)
    shown = [places[k] for k in np.linspace(0, len(places) - 1, min(room, len(places))).round().astype(int)]
    note = f"; {len(shown)} of {len(places)} grid points, all in statistics.json" if len(shown) < len(places) else ""
    figure = style.new_figure(
        _PANEL * len(variants) * len(shown) + _ROOM,
        f"{sweep.name}: {len(sweep.rows)} runs with random parameters{sweep.failed}{note}",
        # A panel must be as wide as a title with two numbers and their intervals.
        page=max(style.WIDTH, _ACROSS * len(metrics)),
    )
    rows = [(variant, grid_place) for variant in variants for grid_place in shown]
    ends = [key.split(".")[-1] for key in sweep.grid]
    names = {key: end if ends.count(end) == 1 else key for key, end in zip(sweep.grid, ends, strict=True)}
    panels = figure.subplots(len(rows), len(metrics), squeeze=False)
    for row, (variant, grid_place) in zip(panels, rows, strict=True):
        here = list(_at(sweep.of(variant), grid_place))
        # If there is only one grid point, the title does not name it.
        values = {key: style.number(value) if _numeric([value]) else value for key, value in grid_place.items()}
        where = [f"{names[key]} = {value}" for key, value in values.items()] if len(places) > 1 else []
        texts = [variant] * bool(variant) + [_short(", ".join(where), _HEAD - len(variant))] * bool(where)
        head = f"{', '.join(texts)}\n" if texts else ""
        for axes, (metric, (label, scale)) in zip(row, metrics.items(), strict=True):
            _distribution(axes, _values(here, metric) * scale, head, sweep.looks[variant]["color"])
            axes.set_xlabel(label)
            axes.set_ylabel("runs")
    return figure


def _distribution(axes: Axes, values: Array, head: str, colour: str) -> None:
    """Draw the histogram of the draws at one grid point, with the mean, its interval, and the interval of the draws."""
    if len(values) < 2:
        axes.set_title(f"{head}too few runs with numbers: {len(values)}", fontsize=style.letters(7.5))
        return
    if np.ptp(values) == 0.0:
        axes.set_title(f"{head}{len(values)} runs, all {style.number(values[0])}", fontsize=style.letters(7.5))
        return
    # Bin width by the rule of Freedman and Diaconis, or of Sturges for few samples.
    bins = min(_BINS, len(np.histogram_bin_edges(values, "auto")) - 1)
    axes.hist(values, bins=bins, color=colour, alpha=0.7)
    statistics = spread(values)
    axes.axvline(statistics.mean, color=style.BLACK, linewidth=1.0)
    for limit in (statistics.low, statistics.high):
        axes.axvline(limit, color=style.BLACK, linewidth=0.8, linestyle=(0, (4, 2)))
    of_all = (
        f"{statistics.count} runs: mean {_with_interval(statistics.mean, statistics.mean_high - statistics.mean)}, "
        f"{100 * LEVEL:g} % in {style.number(statistics.low)} … {style.number(statistics.high)}"
    )
    axes.set_title(f"{head}{of_all}", fontsize=style.letters(7.5))
    axes.margins(x=0.03)


def tornado(sweep: Sweep) -> Figure | None:
    """Draw the effect of one standard deviation of each sampled key; return None if no linear model can be fitted."""
    effects = {
        (variant, metric): fit
        for variant in sweep.variants
        for metric in sweep.metrics
        if (fit := _fit(sweep, variant, metric)) is not None
    }
    if not effects:
        return None
    variants, metrics = sweep.variants, sweep.metrics
    bars = min(len(sweep.sampled), _BARS)
    title = f"{sweep.name}: effect of one standard deviation of each parameter{sweep.failed}"
    figure = style.new_figure((_BAR * bars + _ROOM) * len(variants) + 0.5, title)
    panels = figure.subplots(len(variants), len(metrics), squeeze=False)
    for row, variant in zip(panels, variants, strict=True):
        for axes, (metric, (label, scale)) in zip(row, metrics.items(), strict=True):
            axes.set_xlabel(f"change of {label}")
            fit = effects.get((variant, metric))
            if fit is None:
                axes.set_title(f"{variant}: no linear fit")
                continue
            order = np.argsort(-np.abs(fit.effect), kind="stable")[:bars][::-1]
            effect, half = scale * fit.effect[order], scale * fit.half_width[order]
            colours = [style.BLUE if value > 0.0 else style.ORANGE for value in effect]
            axes.barh(range(len(order)), effect, xerr=half, color=colours, height=0.7, error_kw={"elinewidth": 0.8})
            axes.set_yticks(range(len(order)), [_short(sweep.sampled[k]) for k in order])
            axes.axvline(0.0, color=style.BLACK, linewidth=0.6)
            axes.grid(visible=False, axis="y")
            axes.margins(x=0.05)
            explained = f"linear fit explains {100.0 * fit.explained:.3g} % of the variance"
            axes.set_title("\n".join([variant] * bool(variant) + [explained]), fontsize=style.letters(7.5))
    return figure


def _fit(sweep: Sweep, variant: str, metric: str) -> Any:
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


def _name_cells(axes: Axes, which: str, key: str, levels: Sequence[Any]) -> None:
    """Label the rows or columns of an image, at most about eight of them."""
    shown = range(0, len(levels), -(-len(levels) // 8))
    texts = [f"{levels[k]:.3g}" if _numeric(levels) else str(levels[k]) for k in shown]
    axes.set(**{f"{which}ticks": list(shown), f"{which}ticklabels": texts, f"{which}label": _short(key)})


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
    elif 0.0 <= low < 0.7 * high:
        axes.set(**{f"{which}lim": (0.0, 1.05 * high)})


def _with_interval(value: float, half: float) -> str:
    """Format a value and its half-width with two significant digits of the half-width."""
    places = max(1 - math.floor(math.log10(half)), 0) if half > 0.0 else 3
    return f"{value:.{places}f} ± {half:.{places}f}".replace("-", "−")


def _is_wide(low: float, high: float) -> bool:
    """Return whether values between these limits are positive and differ widely in magnitude."""
    return bool(low > 0.0 and high > _WIDE * low)


def _short(text: str, long: int = _LABEL) -> str:
    return text if len(text) <= long else f"…{text[1 - long :]}"
