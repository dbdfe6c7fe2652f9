"""Figures and animation of a snake run, and comparisons of runs, from their records alone.

The figures show postures in top and side view with grounded and lifted wheels and the support polygon; the controlled
variables and their targets; joint angles and limits; and cost, smallest singular value, support margin and modes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dynsim.draw import film
from dynsim.draw.figures import snake_tasks, style, tanaka2019
from dynsim.draw.figures.overlap import listed
from dynsim.draw.figures.snake_view import (
    BODY,
    COORDINATE_NAMES,
    COST,
    DEGREES,
    GROUND,
    HEAD,
    NUMBERED,
    STILL,
    View,
    above_edge,
    error_axis,
    greek,
    interval_starts,
    is_numbered,
    limit_line,
    margin_axes,
    mode_chart,
    mode_starts,
    mode_steps,
    moments,
    most_columns,
    moving,
    overlaid,
    overlay_margins,
    posture_grid,
    rounding,
)
from dynsim.record import Record
from dynsim.snake.lifting import snake_geometry
from dynsim.snake.published import used_limit, write_tables

# Number of postures in an animation, in a row, and overlaid in one picture.
FRAMES, IN_A_ROW, IN_A_PICTURE = 50, 6, 7
# Maximum number of rows of variants on a page.
PAGE_ROWS = 4


def draw(record: Record, folder: Path, kind: str = "png") -> list[Path]:
    """Draw all figures of one run and, unless the look excludes it, the animation; return the files."""
    written = style.save_all(figures(record), record, folder, kind)
    return [*written, animate(record, folder / "animation.gif")] if style.wants_film() else written


def draw_comparison(records: Mapping[str, Record], folder: Path, kind: str = "png") -> list[Path]:
    """Draw overlays of variants and, for experiments of [T], comparisons with the paper; return the files."""
    tables = [] if style.wanted_panels() else write_tables(records, folder)
    return tables + style.save_all(comparisons(records), records, folder, kind)


def figures(record: Record) -> dict[str, Callable[[Record], Figure]]:
    """Return the drawing functions of one run by file name."""
    return {
        "postures": postures,
        "overview": overview,
        "tracking": tracking,
        "joints": joints,
        "redundancy": redundancy,
        **snake_tasks.makers(record),
        **tanaka2019.figures_of_run(record),
    }


def comparisons(records: Mapping[str, Record]) -> dict[str, Callable[[Mapping[str, Record]], Figure]]:
    """Return the drawing functions for several runs by file name.

    Comparisons with [T] are included only if all runs have the same scenario.
    """
    scenarios = {record.summary["scenario"] for record in records.values()}
    published = tanaka2019.figures(scenarios.pop(), records) if len(scenarios) == 1 else {}
    return {"comparison": comparison, "postures": strips, **published}


def comparison(records: Mapping[str, Record]) -> Figure:
    """Draw cost, largest yaw angle relative to its limit, support margin and head error of all variants.

    Up to six variants have curves over time. More variants have one bar each, from the smallest to the largest value.
    """
    title = style.comparison_title(list(records.values()), "cost, angles, margin and error")
    errors = {name: 1e3 * record["position_error"] for name, record in records.items()}
    exact = rounding("position error", "mm", *errors.values())
    count = 4 - bool(exact)
    figure = style.new_figure(0.6 + 1.5 * count, title)
    axes = figure.subplots(count, 1, sharex=True)
    if len(records) <= len(style.DASHES):
        looks = style.variant_styles(list(records))
        overlay_margins(axes[:3], records, looks)
        for name, record in records.items():
            for axis in axes[3:]:
                axis.plot(record.time, errors[name], **looks[name])
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(0.0, max(record.time[-1] for record in records.values()) or None)
        style.legend_below(figure, axes[:1], 6)
    else:
        _bars(figure, axes, records)
        margin_axes(axes[:3])
    for axis in axes[3:]:
        error_axis(axis, "position error", "mm", *errors.values())
        for mark in axis.lines if len(records) > len(style.DASHES) else ():
            # Marks on the lower edge would be cut.
            mark.set_visible(float(mark.get_ydata()[0]) > 1.1 * axis.get_ylim()[0])
    figure.note(*filter(None, [exact]))
    figure.align_ylabels(axes)
    return figure


def _bars(figure: style.Drawing, axes: Sequence[Axes], records: Mapping[str, Record]) -> None:
    """Draw the range of each quantity of each variant; variants with the same stem are next to each other."""
    parts = style.families(list(records))
    stems, endings = (list(dict.fromkeys(part)) for part in zip(*parts.values(), strict=True))
    looks, entries = style.variant_styles(endings), {}
    for name, (stem, ending) in parts.items():
        k, colour = endings.index(ending), looks[ending]["color"]
        x = stems.index(stem) + 0.8 * ((k + 0.5) / len(endings) - 0.5)
        run = records[name]
        quantities = run["cost"], used_limit(run), 1e3 * run["support_margin"], 1e3 * run["position_error"]
        for axis, values in zip(axes, quantities, strict=False):
            axis.vlines(x, values.min(), values.max(), color=colour, lw=1.5)
            (mark,) = axis.plot(x, values[-1], "osD^v<>"[k % 7], color=colour, ms=3.5, mec="white", mew=0.3)
        entries[f"…_{ending}" if ending else style.ALONE] = mark
    if len(endings) > 1:
        figure.put_below(entries, 6)
    axes[-1].set_xticks(range(len(stems)), stems, rotation=90 * (sum(map(len, stems)) > 10.0 * style.width()))
    axes[-1].set_xlim(-0.6, len(stems) - 0.4)
    axes[-1].set_xlabel("variant")
    for axis in axes:
        axis.grid(axis="x", visible=False)
    figure.note("Bars: range over the run; marks: value at its end.")


def strips(records: Mapping[str, Record]) -> Figure:
    """Draw the postures of the variants over time, overlaid; only the first variants if a page has no more space."""
    runs, some = {}, list(records.items())[: PAGE_ROWS * most_columns()]
    part = f", {len(some)} of {len(records)} variants" * (len(some) < len(records))
    for name, record in some:
        waiting = record.summary["waiting_s"]
        label = f"{name}, {record.time[-1]:.3g} s" + (f", {waiting:.0f} s of it waiting" if waiting >= 0.5 else "")
        runs[label] = (record, [View(record, row) for row in moments(record, IN_A_PICTURE)])
    return overlaid(style.comparison_title(list(records.values()), f"postures over time{part}"), runs)


def postures(record: Record) -> Figure:
    """Draw postures over time: top view, and side view along the heading of the base part below."""
    views = [View(record, row) for row in moments(record, IN_A_ROW)]
    line = [(view, f"{view.time:.1f} s, mode {view.mode}") for view in views]
    return posture_grid(style.title(record, "postures over time"), {"": line}, side=True)


def overview(record: Record) -> Figure:
    """Draw the whole run in one picture: postures over time, path of the controlled point and its target."""
    rows = moments(record, IN_A_PICTURE)
    views = [View(record, row) for row in rows]
    every = f", one\u00a0every\u00a0{record.time[rows[1]] - record.time[rows[0]]:.2g}\u00a0s" if len(rows) > 1 else ""
    return overlaid(style.title(record, f"postures{every}"), {"": (record, views)})


def tracking(record: Record) -> Figure:
    """Draw the coordinates of the controlled point that vary, with their targets, and the errors."""
    shown, note = moving([record])
    parts = (
        ("position error", "mm", 1e3 * record["position_error"]),
        ("attitude error", "°", DEGREES * record["attitude_error"]),
    )
    exact = [rounding(*part) if shown else "" for part in parts]
    drawn = [part for part, text in zip(parts, exact, strict=True) if not text]
    count = len(shown) + len(drawn)
    columns = 1 if style.narrow() or count % 2 else 2
    rows = count // columns
    figure = style.new_figure(min(1.5 * rows + 0.8, 7.9), style.title(record, "tracking of the target"))
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    panels, time = list(axes.T.ravel()), record.time
    for i, axis in zip(shown, panels, strict=False):
        values, target = record["w"][:, i], record["w_target"][:, i]
        scale, unit = (1.0, "m") if i < 3 else (DEGREES, "°")
        if i < 3 and np.ptp([values.min(), values.max(), *target]) < 0.2:
            scale, unit = 1e3, "mm"
        axis.plot(time, scale * values, color=GROUND, label="controlled point")
        axis.plot(time, scale * target, "--", color=HEAD, lw=0.9, label="target")
        axis.set_ylabel(f"{COORDINATE_NAMES.get(record.labels['w'][i], record.labels['w'][i])} [{unit}]")
    for axis, (part, unit, error) in zip(panels[len(shown) :], drawn, strict=True):
        axis.plot(time, error, color=BODY, label="error")
        error_axis(axis, part, unit, error)
    for axis in panels:
        style.shade(axis, time, record["gripper"] > 0, "#EEEEEE", "gripper closed")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.align_ylabels(axes)
    style.legend_below(figure, panels, 4)
    figure.note(*filter(None, [note, *exact]))
    return figure


def joints(record: Record) -> Figure:
    """Draw the joint angles of the head and base part with their limits; dots mark joints excluded from allocation.

    Constant angles are in a note.
    """
    geometry = snake_geometry(record)
    n_h, pitch, upper, lower = geometry.head_joints, geometry.pitch, geometry.upper, geometry.lower
    phi, labels = DEGREES * record["phi"], record.labels["phi"]
    parts = [
        ("yaw of the head", np.flatnonzero(~pitch[:n_h])),
        ("pitch of the head", np.flatnonzero(pitch[:n_h])),
        ("yaw of the base", np.arange(n_h, len(labels))),
    ]
    # Limits are in the panels, so smaller motions are flat lines there.
    least = max(STILL[1], 0.01 * DEGREES * float((upper - lower).min()))
    moves = (np.ptp(phi, axis=0) > least) | record["at_limit"].any(axis=0)
    parts = [(title, shown) for title, group in parts if len(shown := group[moves[group] | ~moves.any()])]
    figure = style.new_figure(2.0 * len(parts) + 0.4, style.title(record, "joint angles and limits"))
    axes = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (title, group) in zip(axes, parts, strict=True):
        looks = style.variant_styles(group.tolist())
        for j in group.tolist():
            axis.plot(record.time, phi[:, j], label=greek(labels[j]), **looks[j])
            out = record["at_limit"][:, j] > 0
            axis.plot(record.time[out], phi[out, j], ".", color=looks[j]["color"], ms=3)
        for limit in sorted({*upper[group], *lower[group]}):
            limit_line(axis, DEGREES * limit, "limits" if limit == max(upper[group]) else "")
        axis.set_ylabel(f"{title} [°]")
        style.legend_beside(axis, 3)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(record.time[0], record.time[-1] or None)
    if moves.any() and not moves.all():
        still: dict[str, list[str]] = {}
        for k in np.flatnonzero(~moves):
            still.setdefault(style.number(round(phi[0, k], 1) + 0.0, 3), []).append(greek(labels[k]))
        texts = [f"{listed(names)} at {angle}°" for angle, names in still.items()]
        figure.note(f"Constant within {style.number(least, 2)}° and not drawn: {'; '.join(texts)}.")
    if record["at_limit"].any():
        figure.note("Dots: the joint is excluded from allocation because it is at its limit.")
    return figure


def redundancy(record: Record) -> Figure:
    """Draw modes (grounded wheels), cost, smallest singular value and support margin over time."""
    many = not is_numbered(record)  # the mode numbers then have a separate panel
    ratios = [1.3, *([0.8] if many else []), 1, 1, 1]
    figure = style.new_figure(6.7 + 1.1 * many, style.title(record, "modes and margins"))
    axes = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)
    cost, sigma, margin = axes[-3:, 0]
    mode_chart(axes[0, 0], record)
    if many:
        mode_steps(axes[1, 0], record)
    cost.plot(record.time, record["cost"], color=GROUND)
    cost.set_ylabel(COST)
    above_edge(cost)
    dense = len(mode_starts(record)) > NUMBERED
    _over_time(sigma, record, record["sigma_min"], dense)
    sigma.set_ylabel("smallest singular\nvalue of B̃")
    sigma.set_ylim(bottom=0)
    _over_time(margin, record, 1e3 * record["support_margin"], dense)
    low, high = 1e3 * record["support_margin"].min(), 1e3 * record["support_margin"].max()
    margin.set_ylim(min(0.0, low) - 4.0, high + 0.1 * (high - min(0.0, low)) + 1.0)
    limit_line(margin, 0.0, "tips below zero")
    margin.set_ylabel("support margin\n[mm]")
    margin.set_xlabel("time [s]")
    if dense:
        style.legend_below(figure, [margin], 2)
    figure.align_ylabels(axes[:, 0])
    return figure


def _over_time(axis: Axes, record: Record, values: NDArray[np.float64], many: bool) -> None:
    """Draw a line or, if ``many`` mode changes would fill the panel, its range and minimum in each interval."""
    if not many:
        axis.plot(record.time, values, color=GROUND)
        return
    starts = interval_starts(len(values))
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    time = np.append(record.time[starts], record.time[-1])
    label = f"range in {(time[-1] - time[0]) / len(starts):.2g} s"
    axis.stairs(high, time, baseline=low, fill=True, color=GROUND, alpha=0.25, lw=0, label=label)
    axis.plot(record.time[starts], low, color=GROUND, lw=1.0, label="smallest value")


def animate(record: Record, path: Path) -> Path:
    """Write a short film of the run."""
    fps = 10
    speed = (record.time[-1] - record.time[0]) * fps / (FRAMES - 1)
    return film.write({"": record}, path, size=(480, 420), fps=fps, speed=float(speed) or 1.0, plot="")
