"""Figures of an arm over time: energy and work ([WM] Figs 7, 8), energy ledger, motors, hand path, tracking error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from dynsim.draw.figures import contacts, style
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.shapes import box_about
from dynsim.record import Record
from dynsim.record.measures import RESIDUAL_LIMIT, energy_turnover, hand_error, hand_target

# Terms of the ledger, in stacking order.
TERMS = {
    "heat_joule": ("Joule heat in the windings", "#E69F00"),
    "loss_gear": ("gear losses", "#56B4E9"),
    "loss_joint": ("joint losses", "#0072B2"),
    "heat_friction": ("contact friction", "#882255"),
    "loss_impact": ("impacts of contacts", "#8C6D31"),
    "loss_stop": ("impacts at joint stops", "#F0E442"),
    "loss_damper": ("dampers of contacts and ties", "#44AA99"),
    "energy_elastic": ("Δ elastic energy", "#AA4499"),
    "loss_scheme": ("loss of time stepping", "#999933"),
    "energy_kinetic": ("Δ kinetic energy", "#009E73"),
    "energy_potential": ("Δ potential energy", "#CC79A7"),
    "energy_magnetic": ("Δ magnetic energy", "#7F7F7F"),
}
# Largest ratio of final values for which a linear axis is used.
LOG_RATIO = 8.0
# Fraction of the energy turnover above which one term hides the others, which then get a separate panel.
DOMINANT = 0.8
# Terms below this fraction of the largest term are rounding errors.
NOTHING = 1e-9
# Net and drawn energy are shown as one curve if they differ by no more than this fraction of the maximum.
DIFFER = 0.01
# A residual below this fraction of its limit is only printed, not drawn.
SMALL_RESIDUAL = 0.1


def has_motors(record: Record) -> bool:
    """Return whether the record has electrical energy to draw."""
    return "energy_electrical" in record and "current" in record and record["current"].shape[1] > 0


def energy(record: Record) -> Figure | None:
    """Draw net electrical energy, drawn energy if it differs, and mechanical work; return None without motors."""
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
    contacts.mark_all([(top,), (bottom,)], record)
    for axes in (top, bottom):
        style.legend_above(axes, columns=2)
    return figure


def energy_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw the electrical energy of all variants over time and in total, and their mechanical work."""
    shown = {name: record for name, record in records.items() if has_motors(record)}
    if not shown:
        return None
    height = 5.0 + 2.0 * contacts.height_of_variants(shown)
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
        # Values in the first milliseconds would extend the axis by many almost empty decades.
        over_time.set_ylim(least, 1.6 * finals.max())
    over_time.set_ylabel("electrical energy [J]")
    over_time.tick_params(labelbottom=False)
    work.axhline(0.0, color=style.GREY, linewidth=0.6)
    work.set_ylabel("mechanical work [J]")
    work.set_xlabel("time [s]")
    contacts.mark_variants([(over_time,), (work,)], shown, styles)
    _totals(total, list(shown), finals, [str(styles[name]["color"]) for name in shown], logarithmic)
    style.legend_below(figure, [over_time], 5)
    return figure


def ledger(record: Record) -> Figure | None:
    """Draw the stacked terms of the energy ledger and its residual; return None without a ledger.

    If Joule heat would hide the other terms, the main panel omits it, and a small panel shows all terms.
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
    contacts.mark_all([(axes,) for axes in panels], record)
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
    """Stack positive terms upward and negative terms downward from zero; their sum is the supplied energy."""
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
            fontsize=style.letters(7.0),
        )
    axes.set_ylabel("unexplained\n[J]")


def _totals(axes: Axes, names: Sequence[str], values: Array, colours: Sequence[str], logarithmic: bool) -> None:
    """Draw totals as bars, or as dots on a logarithmic axis, on which bars would have no origin.

    Dots are labelled with their ratio to the largest total.
    """
    places, largest = np.arange(len(names)), float(values.max())
    if logarithmic:
        axes.scatter(places, values, s=60, c=colours, zorder=3)
        # Leave space for the numbers on a logarithmic axis.
        axes.set_ylim(0.6 * float(values.min()), 2.0 * largest)
        style.log_axis(axes)
        axes.margins(x=0.2)
    else:
        axes.bar(places, values, color=colours, width=0.7)
        axes.margins(x=0.05, y=0.08)
    for x, value in zip(places.tolist(), values.tolist(), strict=True):
        part = f"\n1/{style.number(largest / value, 3)}" if logarithmic and value < largest else ""
        look: dict[str, Any] = {
            "textcoords": "offset points",
            "ha": "center",
            "va": "bottom",
            "fontsize": style.letters(7.5),
        }
        text = f"{style.number(value)}{part}"
        axes.annotate(text, (x, max(value, 0.0)), xytext=(0, 6 if logarithmic else 2), **look)
    axes.set_xticks(places, names, rotation=30 if len(names) <= 4 else 60, ha="right")
    axes.grid(axis="x", visible=False)
    axes.set_title("electrical energy of the run, net [J]" + (",\nand relative to the largest" if logarithmic else ""))


def _joules(values: Array, largest: float = 0.0) -> str:
    """Format the last value in joules; as 0 if it is only a rounding error of the ledger's largest value."""
    last = float(values[-1])
    return f"{style.number(0.0 if abs(last) < NOTHING * largest else last)} J"


# Motor currents and voltages. Maximum number of motors with separate lines, selected by their currents; if there are
# more motors, the envelope of all motors is drawn too.
LARGEST = 6


def motors(record: Record) -> Figure | None:
    """Draw motor currents and terminal voltages; return None without motors."""
    if "current" not in record or record["current"].shape[1] == 0:
        return None
    signals = (("current", "current [A]"), ("voltage", "voltage [V]"))
    count = record["current"].shape[1]
    # Select the motors by their current after the start, when all are active; both panels show the same motors.
    settled = record.time >= record.settle_time
    late = settled if settled.any() else slice(None)
    effort = np.sqrt((record["current"][late] ** 2).mean(axis=0))
    shown = np.arange(count) if count <= LARGEST else np.sort(np.argsort(effort)[::-1][:LARGEST])
    figure = style.new_figure(4.4, style.title(record, "motor currents and voltages"))
    rows = style.time_rows(
        figure, [[(record.time, record[name])] for name, _ in signals], record.settle_time, compress=True
    )
    looks = style.variant_styles(shown.tolist())
    for (name, label), panels in zip(signals, rows, strict=True):
        for axes in panels:
            _draw(axes, record, name, shown, looks)
        panels[0].set_ylabel(label)
    contacts.mark_all(rows, record)
    named = f"{LARGEST} largest by\nrms current" if count > LARGEST else None
    figure.legend(
        *rows[0][-1].get_legend_handles_labels(),
        loc="outside right center",
        title=named,
        title_fontsize=style.letters(7.5),
    )
    return figure


def _draw(axes: Axes, record: Record, name: str, shown: np.ndarray, looks: Mapping[int, Mapping[str, Any]]) -> None:
    values, labels = record[name], record.labels[name]
    called = {} if record.scene is None else record.scene.wheel_names
    if len(shown) < values.shape[1]:
        low, high = values.min(axis=1), values.max(axis=1)
        axes.fill_between(record.time, low, high, color="#CFCFCF", linewidth=0, label=f"all {len(labels)} motors")
    for k in shown:
        style.line(axes, record.time, values[:, k], label=called.get(labels[k], labels[k]), **looks[k])
    axes.axhline(0.0, color=style.GREY, linewidth=0.6)


# Hand and target: paths in three planes, and tracking error over time ([WM] Figs 4–6).
PLANES = ((0, 1), (0, 2), (1, 2))
MILLI = 1e3
# A target that moves by less than this counts as fixed [m].
HELD = 1e-6
# Legend entries for targets that follow from a hand path, and from the goals of the joints.
TARGET, GOALS = "target", "goals"
# Marker for the start position of the hand, which is the same for all variants.
START: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markerfacecolor": "white",
    "markeredgecolor": style.BLACK,
    "markersize": 4,
    "zorder": 4,
}


def path(record: Record) -> Figure | None:
    """Draw the hand path and its target in xy, xz and yz at one scale; return None without a hand."""
    return _paths({"hand": record}, style.title(record, "hand path"))


def path_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw the hand paths of all variants in xy, xz and yz."""
    return _paths(records, style.comparison_title(list(records.values()), "hand paths"))


def _paths(records: Mapping[str, Record], title: str) -> Figure | None:
    shown = {name: record for name, record in records.items() if "hand_position" in record}
    if not shown:
        return None
    # The height fits three square panels and the legend, without extra space.
    figure = style.new_figure(2.62 + style.legend_row() * -(-(3 + len(shown)) // 4) / 72.0, title)
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
    """Draw the components and the norm of the tracking error over time; return None without a target."""
    target = hand_target(record)
    if target is None:
        return None
    deviation = MILLI * (record["hand_position"] - target)
    norm = np.linalg.norm(deviation, axis=1)
    figure = style.new_figure(4.1, style.title(record, "tracking error"))
    series = [[(record.time, deviation)], [(record.time, norm)]]
    rows = style.time_rows(figure, series, record.settle_time)
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
    contacts.mark_all(rows, record)
    style.legend_above(rows[0][-1], columns=4)
    style.legend_above(rows[1][-1])
    return figure


def error_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw the tracking errors of all variants: distance from the target (logarithmic) and vertical error."""
    shown = {name: record for name, record in records.items() if hand_target(record) is not None}
    if not shown:
        return None
    height = 4.4 + 2.0 * contacts.height_of_variants(shown)
    figure = style.new_figure(height, style.comparison_title(list(shown.values()), "tracking error"))
    deviations = {name: MILLI * (record["hand_position"] - hand_target(record)) for name, record in shown.items()}
    norms = {name: np.linalg.norm(deviation, axis=1) for name, deviation in deviations.items()}
    styles = style.variant_styles(list(records))
    settle = max(record.settle_time for record in shown.values())
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
    contacts.mark_variants(rows, shown, styles)
    style.legend_below(figure, rows[0][-1:], 2)
    return figure


def _log_rows(panels: Sequence[Axes], settled: Array) -> None:
    """Make the axes logarithmic; axes of the whole run show only the settled range if there is a transient panel."""
    for axes in panels:
        axes.autoscale(axis="y")
        style.log_axis(axes)
    if len(panels) > 1 and settled.size:
        panels[-1].set_ylim(float(settled.min()) / 1.3, 1.3 * float(settled.max()))
        style.log_axis(panels[-1])


def _planes(figure: Figure, records: list[Record]) -> list[Axes]:
    """Create three square panels with one scale that contain all hand paths and targets."""
    points = [record["hand_position"] for record in records]
    points += [target for record in records if (target := hand_target(record)) is not None]
    low, high = box_about(points)
    span = float((high - low).max())
    half = 0.56 * span if span > 0.0 else 0.05
    middle = 0.5 * (low + high)
    panels = list(figure.subplots(1, 3))
    for axes, (i, j) in zip(panels, PLANES, strict=True):
        axes.set_aspect("equal", anchor="N")  # put unused space above the legend
        axes.set_xlim(middle[i] - half, middle[i] + half)
        axes.set_ylim(middle[j] - half, middle[j] + half)
        axes.set_xlabel(f"{'xyz'[i]} [m]")
        axes.set_ylabel(f"{'xyz'[j]} [m]")
        # Use fewer ticks along x, because labels such as "−0.050" are wide.
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
        # This marker is larger than the one at the start of the hand, with which it may coincide.
        axes.plot(*target[0], "x", label=target_name(record), color=style.BLACK, markersize=8, zorder=3)
        return
    axes.plot(*edge_on(target).T, label=target_name(record), color=style.BLACK, linestyle=(0, (4, 2)), zorder=3, lw=0.9)
    axes.plot(*target[0], "x", color=style.BLACK, markersize=5, zorder=4)


def target_name(record: Record) -> str:
    """Return the legend entry for the target from :func:`dynsim.record.measures.hand_target`."""
    return TARGET if "target_position" in record else GOALS


def edge_on(points: Array) -> Array:
    """Return a plane curve, (T, 2), unchanged or, if it is straight, only its end points.

    A dashed line that is drawn back and forth would fill the gaps between its dashes.
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
        # A fixed target is itself drawn as a marker.
        if target in followed:
            axes.plot([], [], "x", color=style.BLACK, markersize=5, label=f"start of the {target}")
    style.legend_below(figure, [axes], 4)


def _error_label(name: str, record: Record) -> str:
    settle = record.settle_time
    rms = hand_error(record, settle)["hand_error_rms_m"]
    return name if rms is None or not np.isfinite(rms) else f"{name}: rms {MILLI * rms:.3g} mm from {settle:g} s on"


def _mark_settle(panels: Sequence[Axes], record: Record) -> None:
    """Draw a line at the settling time in every panel; only the first has a legend entry, away from the curves."""
    settle = record.settle_time
    if max(0.0, record.time[0]) < settle < min(float(record.time[-1]), panels[0].get_xlim()[1]):
        for axes in panels:
            label = f"settled from {settle:g} s on" if axes is panels[0] else None
            axes.axvline(settle, color=style.GREY, linestyle=":", linewidth=1.0, label=label)
