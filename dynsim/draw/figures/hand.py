"""Figures of the hand and its target: paths in three planes, and tracking error over time ([WM] Figs 4–6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynsim.draw.figures import events, style
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.surfaces import box_about
from dynsim.record import Record
from dynsim.record.measures import hand_error, hand_target

PLANES = ((0, 1), (0, 2), (1, 2))
MILLI = 1e3
# A target whose motion stays within this is fixed [m].
HELD = 1e-6
# Legends: position of the hand by its path, and by the goals of the joints.
TARGET, GOALS = "target", "goals"
# Mark of the start of a hand, the same for all variants.
START: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markerfacecolor": "white",
    "markeredgecolor": style.BLACK,
    "markersize": 4,
    "zorder": 4,
}


def path(record: Record) -> Figure | None:
    """Hand path and target in xy, xz and yz at one scale; None without a hand."""
    return _paths({"hand": record}, style.title(record, "hand path"))


def path_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Hand paths of all variants in xy, xz and yz."""
    return _paths(records, style.comparison_title(list(records.values()), "hand paths"))


def _paths(records: Mapping[str, Record], title: str) -> Figure | None:
    shown = {name: record for name, record in records.items() if "hand_position" in record}
    if not shown:
        return None
    # Three square panels and the legend, without room above and below.
    figure = style.new_figure(2.62 + style.LEGEND_ROW * -(-(3 + len(shown)) // 4) / 72.0, title)
    panels = _planes(figure, list(shown.values()))
    styles = style.variant_styles(list(records))
    for axes, plane in zip(panels, PLANES, strict=True):
        _draw_target(axes, next(iter(shown.values())), plane)
        for name, record in shown.items():
            position = style.sparse(record["hand_position"][:, plane])
            axes.plot(*position.T, label=name, **styles[name])
            axes.plot(*position[0], **START)
    _legend_below(figure, panels[0])
    return figure


def error(record: Record) -> Figure | None:
    """Tracking error over time, components and norm; None without a target."""
    target = hand_target(record)
    if target is None:
        return None
    deviation = MILLI * (record["hand_position"] - target)
    norm = np.linalg.norm(deviation, axis=1)
    figure = style.new_figure(4.1, style.title(record, "tracking error"))
    series = [[(record.time, deviation)], [(record.time, norm)]]
    rows = style.time_rows(figure, series, style.settle_time(record))
    looks = style.variant_styles("xyz")
    for axes in rows[0]:
        for k, name in enumerate("xyz"):
            style.line(axes, record.time, deviation[:, k], label=name, **looks[name])
    for axes in rows[1]:
        style.line(axes, record.time, norm, label=_error_label("|e|", record), color=style.BLACK)
        axes.set_ylim(bottom=0.0)
    rows[0][0].set_ylabel(f"hand − {target_name(record)} [mm]")
    rows[1][0].set_ylabel(f"distance from {target_name(record)} [mm]")
    for panels in zip(*rows, strict=True):
        _mark_settle(panels, record)
    events.mark_all(rows, record)
    style.legend_above(rows[0][-1], columns=4)
    style.legend_above(rows[1][-1])
    return figure


def error_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Tracking errors of all variants: distance from the target, logarithmic, and the vertical part."""
    shown = {name: record for name, record in records.items() if hand_target(record) is not None}
    if not shown:
        return None
    height = 4.4 + 2.0 * events.height_of_variants(shown)
    figure = style.new_figure(height, style.comparison_title(list(shown.values()), "tracking error"))
    deviations = {name: MILLI * (record["hand_position"] - hand_target(record)) for name, record in shown.items()}
    norms = {name: np.linalg.norm(deviation, axis=1) for name, deviation in deviations.items()}
    styles = style.variant_styles(list(records))
    settle = max(map(style.settle_time, shown.values()))
    series = [[(r.time, norms[name]) for name, r in shown.items()]]
    series += [[(r.time, deviations[name][:, 2]) for name, r in shown.items()]]
    rows = style.time_rows(figure, series, settle)
    for distance, vertical in zip(*rows, strict=True):
        for name, record in shown.items():
            style.line(distance, record.time, norms[name], label=_error_label(name, record), **styles[name])
            style.line(vertical, record.time, deviations[name][:, 2], **styles[name])
        _mark_settle((distance, vertical), next(iter(shown.values())))
    if any((norm > 0.0).any() for norm in norms.values()):
        late = np.concatenate([norms[name][record.time >= settle] for name, record in shown.items()])
        _log_rows(rows[0], late[late > 0.0])
    rows[0][0].set_ylabel("distance from target [mm]")
    rows[1][0].set_ylabel("vertical error [mm]")
    colours = {name: str(look["color"]) for name, look in styles.items()}
    events.explain(rows[1][-1], events.mark_variants(rows, shown, colours))
    style.legend_below(figure, rows[0][-1:], 2)
    return figure


def _log_rows(panels: Sequence[Axes], settled: Array) -> None:
    """Logarithmic axes; that of the whole run, where the beginning has a panel of its own, for what has settled."""
    for axes in panels:
        axes.autoscale(axis="y")
        style.log_axis(axes)
    if len(panels) > 1 and settled.size:
        panels[-1].set_ylim(float(settled.min()) / 1.3, 1.3 * float(settled.max()))
        style.log_axis(panels[-1])


def _planes(figure: Figure, records: list[Record]) -> list[Axes]:
    """Three square panels of one scale, large enough for hands and targets."""
    points = [record["hand_position"] for record in records]
    points += [target for record in records if (target := hand_target(record)) is not None]
    low, high = box_about(points)
    span = float((high - low).max())
    half = 0.56 * span if span > 0.0 else 0.05
    middle = 0.5 * (low + high)
    panels = list(figure.subplots(1, 3))
    for axes, (i, j) in zip(panels, PLANES, strict=True):
        axes.set_aspect("equal", anchor="N")  # room that is left is above the legend
        axes.set_xlim(middle[i] - half, middle[i] + half)
        axes.set_ylim(middle[j] - half, middle[j] + half)
        axes.set_xlabel(f"{'xyz'[i]} [m]")
        axes.set_ylabel(f"{'xyz'[j]} [m]")
        # Fewer beside each other, where "−0.050" is wide, than above each other.
        axes.locator_params(axis="x", nbins=4)
        axes.locator_params(axis="y", nbins=5)
    return panels


def _draw_target(axes: Axes, record: Record, plane: tuple[int, int]) -> None:
    wanted = hand_target(record)
    if wanted is None:
        return
    target = wanted[:, plane]
    known = wanted[np.isfinite(wanted).all(axis=1)]
    if len(known) and float(np.ptp(known, axis=0).max()) <= HELD:
        # Larger than the start of the hand, which may lie on it.
        axes.plot(*target[0], "x", label=target_name(record), color=style.BLACK, markersize=8, zorder=3)
        return
    axes.plot(*edge_on(target).T, label=target_name(record), color=style.BLACK, linestyle=(0, (4, 2)), zorder=3, lw=0.9)
    axes.plot(*target[0], "x", color=style.BLACK, markersize=5, zorder=4)


def target_name(record: Record) -> str:
    """What a legend calls :func:`dynsim.record.measures.hand_target`."""
    return TARGET if "target_position" in record else GOALS


def edge_on(points: Array) -> Array:
    """A curve in the plane of the drawing, (T, 2); one seen edge-on as the segment that it covers.

    Running to and fro over itself it would fill the gaps of its own dashes.
    """
    points = style.sparse(points)
    if len(points) < 3 or not np.isfinite(points).all():
        return points
    centred = points - points.mean(axis=0)
    sizes, directions = np.linalg.svd(centred, full_matrices=False)[1:]
    if sizes[-1] > 1e-6 * sizes[0]:
        return points
    along = centred @ directions[0]
    return points[[int(along.argmin()), int(along.argmax())]]


def _legend_below(figure: Figure, axes: Axes) -> None:
    followed = {line.get_label() for line in axes.get_lines() if line.get_linestyle() != "None"}
    axes.plot([], [], label="start of the hand", **START)
    for target in (TARGET, GOALS):
        # One that is held is a mark itself.
        if target in followed:
            axes.plot([], [], "x", color=style.BLACK, markersize=5, label=f"start of the {target}")
    style.legend_below(figure, [axes], 4)


def _error_label(name: str, record: Record) -> str:
    settle = style.settle_time(record)
    rms = hand_error(record, settle)["hand_error_rms_m"]
    return name if rms is None or not np.isfinite(rms) else f"{name}: rms {MILLI * rms:.3g} mm from {settle:g} s on"


def _mark_settle(panels: Sequence[Axes], record: Record) -> None:
    """A line in every panel; the legend of the first names it, as a label beside it would lie on the curves."""
    settle = style.settle_time(record)
    if max(0.0, record.time[0]) < settle < min(float(record.time[-1]), panels[0].get_xlim()[1]):
        for axes in panels:
            label = f"settled from {settle:g} s on" if axes is panels[0] else None
            axes.axvline(settle, color=style.GREY, linestyle=":", linewidth=1.0, label=label)
