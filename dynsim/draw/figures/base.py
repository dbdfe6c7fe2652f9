"""Figures of a mobile base over time: wheel and caster loads, tip margin, traction, reference and motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dynsim.draw.figures import events, style
from dynsim.draw.figures.style import Array
from dynsim.record import Record
from dynsim.record.measures import TIP_OVER, overturns_settled, percent

LOADS, MARGIN, TRACTION = "wheel_load", "tip_margin", "traction_demand"
# Ends of the axes: the traction demand is unbounded without load, the tip margin where the ground carries almost none.
TRACTION_TOP, MARGIN_LOW = 2.5, -2.0
# Colours and widths of left wheel, right wheel and caster; the left is wider, so that it is visible at equal loads.
LOOKS = ((style.BLUE, 2.0), (style.GREEN, 1.0), (style.ORANGE, 1.2))
# Tracking: least range of the axes of positions and headings [m, °], so that rounding at rest is not enlarged.
LEAST_POSITION, LEAST_HEADING = 1e-3, 0.1
MILLI = 1e3


def overturning(record: Record) -> Figure | None:
    """Loads of wheels and caster, tip margin and traction demand over time; None without a mobile base."""
    if not {LOADS, MARGIN, TRACTION} <= set(record):
        return None
    figure = style.new_figure(6.2, style.title(record, "what the base stands on"))
    loads, margin = record[LOADS], record[MARGIN]
    # Nothing is demanded of a wheel that carries nothing, and of one that carries next to nothing no number.
    traction = np.where(np.isfinite(record[TRACTION]), record[TRACTION], np.nan)
    bare = np.asarray(np.isnan(traction).any(axis=1))
    demanded = np.minimum(traction, TRACTION_TOP)
    series = [loads, np.maximum(margin, MARGIN_LOW), demanded]
    rows = style.time_rows(figure, [[(record.time, values)] for values in series], style.settle_time(record))
    for axes in rows[0]:
        _lines(axes, record, LOADS, "least {} N", np.nanmin)
        style.shade_below_zero(axes, "pulls: held down")
        _mark_tipping(axes, [record], [style.PULLING])
    for axes in rows[1]:
        style.line(axes, record.time, margin, color=style.BLACK, label=_margin_label("margin", record))
        _frame_margin(axes)
        _mark_tipping(axes, [record], [style.PULLING])
    for axes in rows[2]:
        _lines(axes, record, TRACTION, "at most {}", np.nanmax)
        _shade(axes, record.time, bare, "a wheel carries nothing")
        axes.axhline(1.0, color=style.PULLING, linewidth=0.8, label="slips above 1")
        axes.set_ylim(0.0, min(max(axes.get_ylim()[1], 1.15), TRACTION_TOP))
        _mark_tipping(axes, [record], [style.PULLING])
    for panels, label in zip(rows, ("load [N]", "tip margin", "traction demand\n|F| / (μ N)"), strict=True):
        panels[0].set_ylabel(label)
        style.legend_above(panels[-1], columns=4)
    note = []
    if np.nanmax(traction, initial=0.0) > TRACTION_TOP:
        note.append(f"traction demand cut off at {TRACTION_TOP:g}: hardly any load")
    if bare.any():
        note.append(f"none without load on a wheel: {percent(float(bare.mean()))} of the samples")
    last = rows[2][-1]
    last.set_xlabel("\n".join([last.get_xlabel(), *note]))
    events.mark_all(rows, record)
    return figure


def margin_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Tip margins of all variants over each other; None without mobile bases."""
    shown = {name: record for name, record in records.items() if MARGIN in record}
    if not shown:
        return None
    some = list(shown.values())
    figure = style.new_figure(
        3.4 + len(shown) * style.LEGEND_ROW / 72.0 + events.height_of_variants(shown),
        style.comparison_title(some, "tip margin (1: safest place, 0: tips over)"),
    )
    series = [(record.time, np.maximum(record[MARGIN], MARGIN_LOW)) for record in some]
    (panels,) = style.time_rows(figure, [series], max(map(style.settle_time, some)))
    styles = style.variant_styles(list(records))
    colours = {name: str(look["color"]) for name, look in styles.items()}
    for axes in panels:
        for name, record in shown.items():
            style.line(axes, record.time, record[MARGIN], label=_margin_label(name, record), **styles[name])
        _frame_margin(axes)
        _mark_tipping(axes, some, [colours[name] for name in shown])
    panels[0].set_ylabel("tip margin")
    events.explain(panels[-1], events.mark_variants([panels], shown, colours))
    style.legend_below(figure, panels[-1:], 1)
    return figure


def tracking(record: Record) -> Figure | None:
    """Reference and place of a mobile base over time, and what lies between; None without a reference.

    Of a base that is to stand, and does, only what lies between is drawn.
    """
    if not {"base_pose", "base_target"} <= set(record):
        return None
    pose, target = record["base_pose"], record["base_target"]
    error = base_error(record)
    heading = np.degrees(np.stack([target[:, 2], pose[:, 2]], axis=1))
    stands = _spread(np.hstack([target[:, :2], pose[:, :2]])) < LEAST_POSITION and _spread(heading) < LEAST_HEADING
    # To a nanometre: beyond it a base that stands shows its rounding.
    away, turned = np.round(MILLI * error[:, :2], 6), np.round(180.0 / np.pi * error[:, 2:], 6)
    parts = {"error [mm]": away, "heading error [°]": turned}
    if not stands:
        parts = {"position [m]": np.hstack([target[:, :2], pose[:, :2]]), "heading [°]": heading, **parts}
    subject = "base, which stands: actual − reference" if stands else "base, reference and actual"
    figure = style.new_figure(0.6 + 1.5 * len(parts), style.title(record, subject))
    grid = style.time_rows(figure, [[(record.time, values)] for values in parts.values()], style.settle_time(record))
    rows = dict(zip(parts, grid, strict=True))
    for name, panels in rows.items():
        for axes in panels:
            values = parts[name]
            least = {"position [m]": LEAST_POSITION, "heading [°]": LEAST_HEADING}.get(name, 0.0)
            if _spread(values) < least:
                middle = float(np.nanmean(values))
                axes.set_ylim(middle - least, middle + least)
            axes.ticklabel_format(axis="y", useOffset=False)
    # Dashes: x and y may be the same.
    for k, (name, dashes) in enumerate((("x", "-"), ("y", (0, (5, 4))))):
        for axes in rows.get("position [m]", ()):
            _pair(axes, record.time, target[:, k], pose[:, k], name, style.AXIS_COLOURS[name], dashes)
    for axes in rows.get("heading [°]", ()):
        _pair(axes, record.time, heading[:, 0], heading[:, 1], "heading", style.BLACK, "-")
    for k, (name, colour) in enumerate((("ahead", style.BLUE), ("to the left", style.GREEN))):
        label = f"{name}: rms {style.number(_rms(away[:, k]), 3)} mm"
        for axes in rows["error [mm]"]:
            style.line(axes, record.time, away[:, k], color=colour, label=label)
    for axes in rows["heading error [°]"]:
        label = f"rms {style.number(_rms(turned), 3)}°"
        style.line(axes, record.time, turned[:, 0], color=style.BLACK, label=label)
    for name in ("error [mm]", "heading error [°]"):
        for axes in rows[name]:
            axes.axhline(0.0, color=style.GREY, linewidth=0.6)
    for name, panels in rows.items():
        panels[0].set_ylabel(name)
        style.legend_above(panels[-1], columns=4)
    events.mark_all(grid, record)
    figure.align_ylabels([panels[0] for panels in grid])
    return figure


def _spread(values: Array) -> float:
    """How far the values of any column spread."""
    known = values[np.isfinite(values).all(axis=1)]
    return float(np.ptp(known, axis=0).max()) if len(known) else 0.0


def base_error(record: Record) -> Array:
    """Actual minus reference of a mobile base: ahead and to the left of the reference [m], heading [rad], (T, 3)."""
    target = record["base_target"]
    error = record["base_pose"] - target
    c, s = np.cos(target[:, 2]), np.sin(target[:, 2])
    return np.stack([c * error[:, 0] + s * error[:, 1], c * error[:, 1] - s * error[:, 0], error[:, 2]], axis=1)


def tipping_times(record: Record) -> list[float]:
    """When the base tips over [s], in the order of time."""
    return [event.time for event in record.events if event.kind == TIP_OVER]


def _verdict(record: Record) -> str:
    times = tipping_times(record)
    if not times:
        return "it never tips over"
    more = f"{len(times)} times, first " if len(times) > 1 else ""
    settle = style.settle_time(record)
    if record.time[-1] > settle and overturns_settled(record, settle) is None:
        return f"a jolt of the start takes it below zero {more}at {style.number(times[0], 3)} s"
    return f"tips over {more}at {style.number(times[0], 3)} s"


def _margin_label(name: str, record: Record) -> str:
    """With the least margin after the start, and whether it tips."""
    settle = style.settle_time(record)
    late = record[MARGIN][record.time >= settle]
    least = f" least {style.number(float(np.nanmin(late)), 3)} from {settle:g} s on;" if np.isfinite(late).any() else ""
    return f"{name}:{least} {_verdict(record)}"


def _lines(axes: Axes, record: Record, signal: str, note: str, extreme: Callable[[Array], Any]) -> None:
    """A line for each column, its extreme in the legend."""
    for values, name, (colour, width) in zip(record[signal].T, record.labels[signal], LOOKS, strict=False):
        known = np.isfinite(values).any()
        values = np.where(np.isfinite(values), values, np.nan)
        label = f"{name}: {note.format(style.number(float(extreme(values)), 3))}" if known else f"{name}: none"
        style.line(axes, record.time, values, color=colour, linewidth=width, label=label)


def _shade(axes: Axes, time: Array, where: NDArray[np.bool_], label: str) -> None:
    """Bands over the samples at which something is so, named once; each as wide as to the samples beside it."""
    edges = np.flatnonzero(np.diff(where, prepend=False, append=False)).reshape(-1, 2)
    limits = axes.get_xlim()
    for k, (first, end) in enumerate(edges.tolist()):
        span = time[first], time[min(end, len(time) - 1)]
        axes.axvspan(*span, color="#EFEFEF", linewidth=0, zorder=0.2, label=label if k == 0 else None)
    axes.set_xlim(limits)


def _pair(axes: Axes, time: Array, target: Array, actual: Array, name: str, colour: str, dashes: Any) -> None:
    """Actual over its reference, which is wide and pale so that both are seen where they agree."""
    style.line(axes, time, target, color=colour, linewidth=4.0, alpha=0.3, label=f"{name}, reference")
    style.line(axes, time, actual, color=colour, linestyle=dashes, label=f"{name}, actual")


def _frame_margin(axes: Axes) -> None:
    low, high = axes.get_ylim()
    axes.set_ylim(max(min(low, -0.05), MARGIN_LOW), max(high, 0.1))
    style.shade_below_zero(axes, "beyond the triangle")


def _mark_tipping(axes: Axes, records: Sequence[Record], colours: Sequence[str]) -> None:
    """Lines and triangles at the times that the axes show; others would stand, and take room, beside the axes."""
    low, high = axes.get_xlim()
    for record, colour in zip(records, colours, strict=True):
        for time in tipping_times(record):
            if not low <= time <= high:
                continue
            axes.axvline(time, color=colour, linestyle=(0, (4, 2)), linewidth=0.9)
            # Above the axes, where a line at their edge is seen too.
            top = axes.get_xaxis_transform()
            axes.plot(time, 1.0, "v", color=colour, markersize=4, transform=top, clip_on=False, zorder=5)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
