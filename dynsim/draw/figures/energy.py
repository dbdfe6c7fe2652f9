"""Figures of electrical energy and work over time ([WM] Figs 7, 8), and of the energy ledger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from dynsim.draw.figures import events, style
from dynsim.draw.figures.style import Array
from dynsim.record import Record
from dynsim.record.measures import RESIDUAL_LIMIT, energy_turnover

# Terms of the ledger in the order in which they are stacked.
TERMS = {
    "heat_joule": ("Joule heat in the windings", "#E69F00"),
    "loss_gear": ("gear losses", "#56B4E9"),
    "loss_joint": ("joint losses", "#0072B2"),
    "heat_friction": ("contact friction", "#882255"),
    "loss_impact": ("impacts of contacts", "#8C6D31"),
    "loss_stop": ("impacts at joint stops", "#F0E442"),
    "loss_damper": ("dampers of contacts and ties", "#44AA99"),
    "energy_elastic": ("Δ elastic energy", "#AA4499"),
    "loss_scheme": ("taken by time steps", "#999933"),
    "energy_kinetic": ("Δ kinetic energy", "#009E73"),
    "energy_potential": ("Δ potential energy", "#CC79A7"),
    "energy_magnetic": ("Δ magnetic energy", "#7F7F7F"),
}
# Largest ratio of final values that is drawn on a linear axis.
LOG_RATIO = 8.0
# Share of the turnover above which one term hides the others, which then get a panel of their own.
DOMINANT = 0.8
# Less than this share of the largest term is rounding.
NOTHING = 1e-9
# Net and drawn energy that are nowhere further apart than this share of the largest are one curve.
DIFFER = 0.01
# A residual below this share of its limit is a number, not a picture.
SMALL_RESIDUAL = 0.1


def has_motors(record: Record) -> bool:
    """Whether the record has electrical energy to draw."""
    return "energy_electrical" in record and "current" in record and record["current"].shape[1] > 0


def energy(record: Record) -> Figure | None:
    """Electrical energy, net and, where it differs, drawn; mechanical work. None without motors."""
    if not has_motors(record):
        return None
    figure = style.new_figure(4.2, style.title(record, "electrical energy and mechanical work"))
    top, bottom = figure.subplots(2, 1, sharex=True)
    net, drawn = record["energy_electrical"], record["energy_electrical_drawn"]
    apart = bool(np.abs(drawn - net).max() > DIFFER * np.abs(drawn).max())
    label = f"net ∫ Σ u·i dt: {_joules(net)}" + ("" if apart else f" (drawn ∫ Σ max(u·i, 0) dt: {_joules(drawn)})")
    style.line(top, record.time, net, label=label, color=style.BLUE, lw=1.8)
    if apart:
        label = f"drawn ∫ Σ max(u·i, 0) dt: {_joules(drawn)}"
        style.line(top, record.time, drawn, label=label, color=style.ORANGE, linestyle=(0, (4, 3)))
    top.set_ylabel("electrical energy [J]")
    work = record["work_mechanical"]
    style.line(bottom, record.time, work, label=f"∫ Σ τ·q̇ dt: {_joules(work)}", color=style.GREEN)
    bottom.axhline(0.0, color=style.GREY, linewidth=0.6)
    bottom.set_ylabel("mechanical work [J]")
    bottom.set_xlabel("time [s]")
    events.mark_all([(top,), (bottom,)], record)
    for axes in (top, bottom):
        style.legend_above(axes, columns=2)
    return figure


def energy_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Electrical energy over time and in total, and mechanical work, of all variants."""
    shown = {name: record for name, record in records.items() if has_motors(record)}
    if not shown:
        return None
    height = 5.0 + 2.0 * events.height_of_variants(shown)
    figure = style.new_figure(
        height, style.comparison_title(list(shown.values()), "electrical energy and mechanical work")
    )
    grid = figure.add_gridspec(2, 2, width_ratios=[1.6, 1.0])
    over_time, total = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[:, 1])
    work = figure.add_subplot(grid[1, 0], sharex=over_time)
    finals = np.array([record["energy_electrical"][-1] for record in shown.values()])
    logarithmic = bool(finals.min() > 0.0 and finals.max() > LOG_RATIO * finals.min())
    least = 0.02 * float(finals.min())
    styles = style.variant_styles(list(records))
    for name, record in shown.items():
        style.line(over_time, record.time, record["energy_electrical"], label=name, **styles[name])
        style.line(work, record.time, record["work_mechanical"], **styles[name])
    if logarithmic:
        style.log_axis(over_time)
        # The first milliseconds would spread the axis over many decades in which nothing is to be seen.
        over_time.set_ylim(least, 1.6 * finals.max())
    over_time.set_ylabel("electrical energy [J]")
    over_time.tick_params(labelbottom=False)
    work.axhline(0.0, color=style.GREY, linewidth=0.6)
    work.set_ylabel("mechanical work [J]")
    work.set_xlabel("time [s]")
    colours = {name: str(look["color"]) for name, look in styles.items()}
    events.explain(work, events.mark_variants([(over_time,), (work,)], shown, colours))
    _totals(total, list(shown), finals, [str(styles[name]["color"]) for name in shown], logarithmic)
    style.legend_below(figure, [over_time], 5)
    return figure


def ledger(record: Record) -> Figure | None:
    """Where the energy went, stacked, and what the ledger does not explain; None without a ledger.

    Where Joule heat would hide the rest, the rest has the panel, and a small one aside has all of it.
    """
    if "energy_residual" not in record:
        return None
    terms = {name: record[name] - record[name][:1] for name in TERMS if name in record}
    supplied = record["energy_electrical"] + record["work_constraint"]
    source = "electrical energy"
    if "work_loads" in record:
        supplied, source = supplied + record["work_loads"].sum(axis=1), "electrical energy and work of loads"
    turnover = energy_turnover(record)
    dominant = bool(np.abs(terms["heat_joule"]).max() > DOMINANT * turnover > 0.0)
    near = bool(np.abs(record["energy_residual"]).max() > SMALL_RESIDUAL * RESIDUAL_LIMIT * turnover > 0.0)
    figure = style.new_figure(3.9 + 1.3 * near, style.title(record, "energy ledger"))
    grid = figure.add_gridspec(1 + near, 1 + dominant, width_ratios=[3.2, 1.0][: 1 + dominant])
    if near:
        grid.set_height_ratios([2.4, 1.0])
    whole = figure.add_subplot(grid[0, -1])
    _stack(whole, record.time, terms, supplied, source)
    main = whole
    if dominant:
        whole.set_title("with Joule heat", loc="left")
        whole.set_xlabel("time [s]")
        main = figure.add_subplot(grid[0, 0], sharex=whole)
        others = {name: values for name, values in terms.items() if name != "heat_joule"}
        _stack(main, record.time, others, supplied - terms["heat_joule"], source)
        main.set_title("without Joule heat", loc="left")
    main.set_ylabel("energy since start [J]")
    panels = [main, figure.add_subplot(grid[1, 0], sharex=main)] if near else [main]
    if near:
        _residual(panels[1], record, turnover)
        main.tick_params(labelbottom=False)
    panels[-1].set_xlabel("time [s]")
    events.mark_all([(axes,) for axes in panels], record)
    if not near:
        panels[-1].set_xlabel(f"{panels[-1].get_xlabel()}\n{_residual_note(record, turnover)}")
    style.legend_below(figure, [whole], 3)
    return figure


def _residual_note(record: Record, turnover: float) -> str:
    largest = float(np.abs(record["energy_residual"]).max())
    if not turnover > 0.0:
        return f"unexplained: at most {style.number(largest, 2)} J"
    share = style.number(largest / turnover, 2)
    return f"unexplained: at most {style.number(largest, 2)} J, {share} of the turnover (limit {RESIDUAL_LIMIT:g})"


def _stack(axes: Axes, time: Array, terms: Mapping[str, Array], supplied: Array, source: str) -> None:
    """Positive terms upward and negative ones downward from zero: both together make up what was supplied."""
    kept = np.unique(np.linspace(0, len(time) - 1, min(len(time), style.LINE_POINTS // 4)).astype(int))
    largest = max(float(np.abs(values[-1])) for values in (*terms.values(), supplied))
    for clip in (np.maximum, np.minimum):
        base = np.zeros(len(kept))
        for name, values in terms.items():
            part = clip(values[kept], 0.0)
            if not np.any(part):
                continue
            text, colour = TERMS[name]
            known = axes.get_legend_handles_labels()[1]
            label = f"{text}: {_joules(values, largest)}"
            axes.fill_between(
                time[kept], base, base + part, color=colour, linewidth=0.3, label=None if label in known else label
            )
            base = base + part
    label = f"sum = {source}: {_joules(supplied, largest)}" if np.any(supplied) else f"{source}: none"
    axes.plot(time[kept], supplied[kept], color=style.BLACK, linewidth=1.1, label=label)


def _residual(axes: Axes, record: Record, turnover: float) -> None:
    size = np.abs(record["energy_residual"])
    if np.any(size > 0.0):
        axes.set_yscale("log", nonpositive="mask")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    shown = np.where(size > 0.0, size, np.nan)
    if np.isfinite(shown).any():
        style.line(axes, record.time, np.where(np.isnan(shown), np.nanmin(shown), shown), color=style.BLACK, lw=0.9)
    if turnover > 0.0:
        limit = RESIDUAL_LIMIT * turnover
        axes.axhline(limit, color=style.PULLING, linestyle="--", linewidth=0.9)
        axes.annotate(
            f"limit: {RESIDUAL_LIMIT:g} of the turnover",
            (0.99, limit),
            xycoords=("axes fraction", "data"),
            xytext=(0, -9),
            textcoords="offset points",
            ha="right",
            color=style.PULLING,
            fontsize=7,
        )
    axes.set_ylabel("unexplained\n[J]")


def _totals(axes: Axes, names: Sequence[str], values: Array, colours: Sequence[str], logarithmic: bool) -> None:
    """Totals as bars; on the logarithmic axis of the curves, where these would have no foot, as dots.

    Those have what they are as parts of the largest beside them.
    """
    places, largest = np.arange(len(names)), float(values.max())
    if logarithmic:
        axes.scatter(places, values, s=60, c=colours, zorder=3)
        # Room for the numbers, on an axis of decades.
        axes.set_ylim(0.6 * float(values.min()), 2.0 * largest)
        style.log_axis(axes)
        axes.margins(x=0.2)
    else:
        axes.bar(places, values, color=colours, width=0.7)
        axes.margins(x=0.05, y=0.08)
    for x, value in zip(places.tolist(), values.tolist(), strict=True):
        part = f"\n1/{style.number(largest / value, 3)}" if logarithmic and value < largest else ""
        look: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom", "fontsize": 7.5}
        text = f"{style.number(value)}{part}"
        axes.annotate(text, (x, max(value, 0.0)), xytext=(0, 6 if logarithmic else 2), **look)
    axes.set_xticks(places, names, rotation=30 if len(names) <= 4 else 60, ha="right")
    axes.grid(axis="x", visible=False)
    axes.set_title("electrical energy of the run, net [J]" + (",\nand as a part of the largest" if logarithmic else ""))


def _joules(values: Array, largest: float = 0.0) -> str:
    """The last value; 0 if it is rounding beside the largest of its ledger."""
    last = float(values[-1])
    return f"{style.number(0.0 if abs(last) < NOTHING * largest else last)} J"
