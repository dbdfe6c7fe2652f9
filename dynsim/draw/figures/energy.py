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
    "heat_joule": ("Joule heat", "#E69F00"),
    "loss_gear": ("gear losses", "#56B4E9"),
    "loss_joint": ("joint losses", "#0072B2"),
    "heat_friction": ("contact friction", "#882255"),
    "loss_impact": ("contact impacts", "#8C6D31"),
    "loss_stop": ("joint-stop impacts", "#F0E442"),
    "loss_damper": ("dampers", "#44AA99"),
    "energy_elastic": ("Δ elastic energy", "#AA4499"),
    "loss_scheme": ("numerical error of the time steps", "#999933"),
    "energy_kinetic": ("Δ kinetic energy", "#009E73"),
    "energy_potential": ("Δ potential energy", "#CC79A7"),
    "energy_magnetic": ("Δ magnetic energy", "#7F7F7F"),
}
# Largest ratios of the variants' final energies, and of their distances from the target, for which an axis is linear.
LOG_ENERGY, LOG_DISTANCE = 20.0, 8.0
# Fraction of the energy turnover above which one term hides the others, which then get a separate panel.
DOMINANT = 0.8
# Net energy and energy from the supply are one curve if they differ by no more than this fraction of the maximum.
DIFFER = 0.01
# A residual below this fraction of its limit is only printed, not drawn.
SMALL_RESIDUAL = 0.1
AT_END = "Energies in the legend: at the end of the run."


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
    label = f"net: {_joules(net)}" + ("" if apart else f"; taken from the supply: {_joules(drawn)}")
    style.line(top, record.time, net, label=label, color=style.BLUE, lw=1.8)
    if apart:
        label = f"taken from the supply, without recovery: {_joules(drawn)}"
        style.line(top, record.time, drawn, label=label, color=style.ORANGE, linestyle=(0, (4, 3)))
    if net.min() >= 0.0:
        top.set_ylim(bottom=0.0)
    top.set_ylabel("electrical\nenergy [J]")
    work = record["work_mechanical"]
    style.line(bottom, record.time, work, label=f"of the motors on the joints: {_joules(work)}", color=style.GREEN)
    bottom.axhline(0.0, color=style.GREY, linewidth=0.6)
    bottom.set_ylabel("mechanical\nwork [J]")
    bottom.set_xlabel("time [s]")
    contacts.mark_all(figure, [(top,), (bottom,)], record)
    for axes in (top, bottom):
        style.legend_above(axes, columns=2)
    figure.note(AT_END)
    return figure


def energy_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw the electrical energy of all variants over time and in total, and their mechanical work."""
    shown = {name: record for name, record in records.items() if has_motors(record)}
    if not shown:
        return None
    title = style.comparison_title(list(shown.values()), "electrical energy and mechanical work")
    below = 0.8 + 0.2 * len(shown)
    figure = style.new_figure(4.6 + below * style.narrow(), title)
    # In a narrow figure, the totals are below the curves.
    if style.narrow():
        grid = figure.add_gridspec(3, 1, height_ratios=[2.0, 2.0, below])
        cells = grid[0], grid[2], grid[1]
    else:
        grid = figure.add_gridspec(2, 2, width_ratios=[1.6, 1.0])
        cells = grid[0, 0], grid[:, 1], grid[1, 0]
    over_time, total = (figure.add_subplot(cell) for cell in cells[:2])
    work = figure.add_subplot(cells[2], sharex=over_time)
    finals = np.array([record["energy_electrical"][-1] for record in shown.values()])
    logarithmic = bool(finals.min() > 0.0 and finals.max() > LOG_ENERGY * finals.min())
    least = 0.02 * float(finals.min())
    styles = style.variant_styles(list(records))
    for name, record in shown.items():
        style.line(over_time, record.time, record["energy_electrical"], label=name, **styles[name])
        style.line(work, record.time, record["work_mechanical"], **styles[name])
    if logarithmic:
        style.log_axis(over_time)
        # Values in the first milliseconds would extend the axis by many almost empty decades.
        over_time.set_ylim(least, 1.6 * finals.max())
    elif min(float(record["energy_electrical"].min()) for record in shown.values()) >= 0.0:
        over_time.set_ylim(bottom=0.0)
    over_time.set_ylabel("electrical\nenergy [J]")
    over_time.tick_params(labelbottom=False)
    work.axhline(0.0, color=style.GREY, linewidth=0.6)
    work.set_ylabel("mechanical\nwork [J]")
    work.set_xlabel("time [s]")
    _totals(total, list(shown), finals, [str(styles[name]["color"]) for name in shown], logarithmic)
    style.legend_below(figure, [over_time], 5)
    if logarithmic:
        figure.note("Fractions: relative to the largest energy.")
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
    below = dominant and style.narrow()
    figure = style.new_figure(3.5 + 1.3 * near + 1.7 * below, style.title(record, "energy ledger"))
    # The panel with all terms is to the right of the main panel or, in a narrow figure, below it.
    rows, columns = 1 + near + below, 1 + (dominant and not below)
    widths, heights = [3.2, 1.0][:columns], [2.4, *[1.6] * below, *[1.0] * near]
    grid = figure.add_gridspec(rows, columns, width_ratios=widths, height_ratios=heights)
    whole = figure.add_subplot(grid[1 if below else 0, -1])
    largest = max(float(np.abs(values[-1])) for values in (*terms.values(), supplied))
    _stack(whole, record.time, terms, largest)
    _draw_supplied(whole, record.time, supplied, source, largest)
    whole.set_ylabel("energy since start [J]")
    main = whole
    if dominant:
        whole.set_title("with Joule heat", loc="left")
        whole.set_xlabel("time [s]" if not below else "")
        main = figure.add_subplot(grid[0, 0], sharex=whole)
        others = {name: values for name, values in terms.items() if name != "heat_joule"}
        _stack(main, record.time, others, largest)
        less = supplied - terms["heat_joule"]
        _draw_supplied(main, record.time, less, f"{source} − Joule heat", largest, linestyle=style.DASHES[1])
        main.set_ylabel("energy since start [J]")
    panels = [main, figure.add_subplot(grid[-1, 0], sharex=main)] if near else [main]
    if near:
        _residual(panels[1], record, turnover)
    if near or below:
        main.tick_params(labelbottom=False)
    if below:
        whole.tick_params(labelbottom=not near)
    (panels[-1] if near or not below else whole).set_xlabel("time [s]")
    contacts.mark_all(figure, [(axes,) for axes in panels], record)
    if dominant:
        main.set_title("without Joule heat", loc="left", pad=6.0 + style.rug_height(main))
    figure.note(AT_END)
    if not near:
        figure.note(_residual_note(record, turnover))
    style.legend_below(figure, [whole, main], 3)
    return figure


def _residual_note(record: Record, turnover: float) -> str:
    largest = float(np.abs(record["energy_residual"]).max())
    if not turnover > 0.0:
        return f"Unexplained energy: at most {style.number(largest, 2)} J."
    share = style.number(largest / turnover, 2)
    limit = style.number(RESIDUAL_LIMIT)
    return f"Unexplained energy: at most {style.number(largest, 2)} J, {share} of the turnover (limit {limit})."


def _stack(axes: Axes, time: Array, terms: Mapping[str, Array], largest: float) -> None:
    """Stack positive terms upward and negative terms downward from zero; their sum is the supplied energy."""
    kept = np.unique(np.linspace(0, len(time) - 1, min(len(time), style.LINE_POINTS // 4)).astype(int))
    for clip in (np.maximum, np.minimum):
        base = np.zeros(len(kept))
        for name, values in terms.items():
            part = clip(values[kept], 0.0)
            if not np.abs(part).max(initial=0.0) > style.NOTHING * largest:
                continue
            text, colour = TERMS[name]
            known = axes.get_legend_handles_labels()[1]
            label = f"{text}: {_joules(values, largest)}"
            axes.fill_between(
                time[kept], base, base + part, color=colour, linewidth=0.3, label=None if label in known else label
            )
            base = base + part


def _draw_supplied(axes: Axes, time: Array, supplied: Array, source: str, largest: float, **look: Any) -> None:
    label = f"{source}: {_joules(supplied, largest)}" if np.any(supplied) else f"{source}: none"
    axes.plot(*style.sparse(np.stack([time, supplied], axis=1)).T, color=style.BLACK, lw=1.1, label=label, **look)


def _residual(axes: Axes, record: Record, turnover: float) -> None:
    size = np.abs(record["energy_residual"])
    if np.any(size > 0.0):
        axes.set_yscale("log", nonpositive="mask")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: style.number(value)))
    shown = np.where(size > 0.0, size, np.nan)
    if np.isfinite(shown).any():
        style.line(axes, record.time, np.where(np.isnan(shown), np.nanmin(shown), shown), color=style.BLACK, lw=0.9)
    if turnover > 0.0:
        limit = RESIDUAL_LIMIT * turnover
        axes.axhline(limit, color=style.PULLING, linestyle="--", linewidth=0.9)
        axes.annotate(
            f"limit: {style.number(RESIDUAL_LIMIT)} of the turnover",
            (0.99, limit),
            xycoords=("axes fraction", "data"),
            xytext=(0, -9),
            textcoords="offset points",
            ha="right",
            color=style.PULLING,
            fontsize=style.letters(7.0),
        )
        # The first steps would extend the axis by many empty decades.
        axes.set_ylim(bottom=max(axes.get_ylim()[0], 1e-3 * limit))
    axes.set_ylabel("unexplained\nenergy [J]")


def _totals(axes: Axes, names: Sequence[str], values: Array, colours: Sequence[str], logarithmic: bool) -> None:
    """Draw totals as bars, or as dots on a logarithmic axis, on which bars would have no origin.

    Dots are labelled with their ratio to the largest total.
    """
    level, largest = np.arange(len(names)), float(values.max())
    if logarithmic:
        axes.scatter(values, level, s=40, c=colours, zorder=3)
        # Leave space for the numbers to the right of the dots.
        axes.set_xlim(0.6 * float(values.min()), largest * (largest / float(values.min())) ** 0.6)
        style.log_axis(axes, "x")
    else:
        axes.barh(level, values, color=colours, height=0.7)
        axes.set_xlim(min(0.0, 1.1 * float(values.min())), 1.3 * max(largest, 0.0) or 1.0)
    for k, value in enumerate(values.tolist()):
        part = f" (1/{style.number(largest / value, 3)})" if logarithmic and value < largest else ""
        look: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": style.letters(7.5)}
        axes.annotate(f"{style.number(value)}{part}", (max(value, 0.0), k), xytext=(6 if logarithmic else 3, 0), **look)
    axes.set_yticks(level, [style.broken(name, 0.9) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("net energy at the end [J]")
    axes.set_label("total energy")


def _joules(values: Array, largest: float = 0.0) -> str:
    """Format the last value in joules."""
    return f"{style.number(float(values[-1]), scale=largest)} J"


# Motors. Maximum number with separate lines; if there are more, the envelope of all motors is drawn too.
LARGEST = 6
# Name, unit, and keys of limit and rating in the summary of loads of motors, by the unit in the keys.
TORQUES = {
    "N_m": ("torque", "N m", "stall_torque_N_m", "nominal_torque_N_m"),
    "N": ("force", "N", "stall_force_N", "nominal_force_N"),
}
# A limit above this multiple of the largest value is in the notes, because its line would compress the curves.
FAR = 3.0
LIMIT: dict[str, Any] = {"linestyle": "--", "linewidth": 0.9, "color": style.PULLING}
RATING: dict[str, Any] = {"linestyle": (0, (1, 1.5)), "linewidth": 1.3, "color": style.BLACK}


def motors(record: Record) -> Figure | None:
    """Draw torques, currents and voltages of the motors, with limits and ratings; return None without currents."""
    if "current" not in record or record["current"].shape[1] == 0:
        return None
    loads = {motor["joint"]: motor for motor in _loads(record)}
    volts = None if record.scene is None else record.scene.voltage_limit
    joints = record.labels["current"]
    slides = [k for k, joint in enumerate(joints) if f"{TORQUES['N'][0]}_rms_N" in loads.get(joint, {})]
    every = range(len(joints))
    motors = {"N_m": [k for k in every if k not in slides], "N": slides}
    # Signal, label, motors, limits by joint, and their keys.
    signals: list[tuple[str, str, Sequence[int], Mapping[str, Any], Sequence[str]]] = [
        *(("torque", f"{name} [{unit}]", motors[key], loads, keys) for key, (name, unit, *keys) in TORQUES.items()),
        ("current", "current [A]", every, loads, ("peak_current_A", "nominal_current_A")),
        ("voltage", "voltage [V]", every, {name: {"limit": volts} for name in joints}, ("limit",)),
    ]
    signals = [signal for signal in signals if signal[0] in record and len(signal[2])]
    values = [record[name][:, [record.labels[name].index(joints[k]) for k in own]] for name, _, own, *_ in signals]
    shown = _most_loaded(record, [(signal[2], part) for signal, part in zip(signals, values, strict=True)])
    title = style.title(record, "torques, currents and voltages of the motors")
    figure = style.new_figure(1.2 + min(1.55 * len(signals), 5.0), title)
    looks = style.variant_styles(list(shown))
    rows = style.time_rows(figure, [[(record.time, part)] for part in values], record.settle_time, compress=True)
    for (_, label, own, entries, keys), part, panels in zip(signals, values, rows, strict=True):
        for axes in panels:
            _draw(axes, record, part, own, shown)
        limits = {looks[k]["color"]: entries.get(joints[k], {}) for k in shown if k in own}
        draw_limits(figure, panels[-1], limits, keys, label)
        style.label_row(panels, label.replace(" [", "\n["))
    style.legend_below(figure, [panels[-1] for panels in rows], 4)
    contacts.mark_all(figure, rows, record)
    if len(shown) < record["current"].shape[1]:
        figure.note(f"Lines: {len(shown)} motors, those with the largest values and rms currents after the start.")
    return figure


def torques(record: Record) -> Figure | None:
    """Draw the load of each motor next to its limit and rating as bars; return None without loads in the summary."""
    loads = {
        unit: [motor for motor in _loads(record) if f"{name}_rms_{unit}" in motor]
        for unit, (name, *_) in TORQUES.items()
    }
    loads = {unit: motors for unit, motors in loads.items() if motors}
    if not loads:
        return None
    limits = {key for unit, motors in loads.items() for motor in motors for key in TORQUES[unit][2:] if key in motor}
    kinds = [kind for k, kind in ((2, "limit"), (3, "rating")) if limits & {names[k] for names in TORQUES.values()}]
    subject = " and ".join(["load of each motor" + ", with" * bool(kinds), *kinds]).replace("with and", "with")
    heights = [0.7 + 0.17 * len(motors) for motors in loads.values()]
    figure = style.new_figure(0.7 + sum(heights), style.title(record, subject))
    panels = figure.subplots(len(loads), 1, height_ratios=heights, squeeze=False)[:, 0]
    called = _names(record)
    for (unit, motors), axes in zip(loads.items(), panels, strict=True):
        name, symbol, *keys = TORQUES[unit]
        most, rms = ([motor[f"{name}_{kind}_{unit}"] for motor in motors] for kind in ("max", "rms"))
        bars(axes, [called.get(motor["joint"], motor["joint"]) for motor in motors], most, rms)
        for key, text, look in zip(keys, ("limit (stall)", "rating (for the rms)"), (LIMIT, RATING), strict=True):
            known = [(motor[key], k) for k, motor in enumerate(motors) if key in motor]
            for value, k in known:
                limit_mark(axes, k, value, text, **look)
        axes.set_xlabel(f"{name} [{symbol}]")
        axes.set_xlim(0.0, 1.05 * axes.get_xlim()[1])
        # The numbers of short bars cannot be read from the axis; a column next to the axes never hides a limit.
        look = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": style.letters(7.0)}
        axes.text(1.02, 1.0, f"max, rms [{symbol}]", **{**look, "transform": axes.transAxes, "va": "bottom"})
        for k, pair in enumerate(zip(most, rms, strict=True)):
            axes.text(1.02, k, ", ".join(style.number(value, 2) for value in pair), **look)
    style.legend_below(figure, list(panels), 4)
    if not limits:
        figure.note("The scenario has neither torque limits nor torque ratings of motors.")
    return figure


def _loads(record: Record) -> list[dict[str, Any]]:
    """Return the loads of the motors; the rating of a torque also follows from that of the current."""
    return [
        motor | {key.replace("continuous", "nominal"): motor[key] for key in motor if key.startswith("continuous")}
        for motor in record.summary.get("motors", ())
    ]


def bars(axes: Axes, names: Sequence[str], largest: Sequence[float], rms: Sequence[float]) -> None:
    """Draw a row for each name, from top to bottom, with a bar of the largest value and a thinner one of the rms."""
    level = np.arange(len(names))
    axes.barh(level, largest, color="#CFCFCF", height=0.7, label="maximum")
    axes.barh(level, rms, color=style.BLUE, height=0.4, label="rms")
    axes.set_yticks(level, names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)


def limit_mark(axes: Axes, level: int, value: float, label: str, **look: Any) -> None:
    """Draw a limit across a horizontal bar."""
    axes.plot([value, value], [level - 0.45, level + 0.45], label=label, **(look or LIMIT))


def _most_loaded(record: Record, signals: Sequence[tuple[Sequence[int], Array]]) -> list[int]:
    """Return the positions of ``LARGEST`` motors in order: with the largest values, (T, k), of motors, and currents.

    Values are those after the start; of the currents the rms counts.
    """
    # Select the motors after the start, when all are active.
    settled = record.time >= record.settle_time
    rows = settled if settled.any() else slice(None)
    effort = np.sqrt((record["current"][rows] ** 2).mean(axis=0))
    peaks = [own[int(np.nan_to_num(np.abs(values[rows])).max(axis=0).argmax())] for own, values in signals]
    return sorted(list(dict.fromkeys([*peaks, *np.argsort(-effort, kind="stable").tolist()]))[:LARGEST])


def _names(record: Record) -> Mapping[str, str]:
    """Return the names of wheels by joint."""
    return {} if record.scene is None else record.scene.wheel_names


def _draw(axes: Axes, record: Record, values: Array, own: Sequence[int], shown: Sequence[int]) -> None:
    """Draw a signal of the ``own`` motors: the ``shown`` ones as lines, the envelope of all if there are more."""
    called, looks = _names(record), style.variant_styles(list(shown))
    if not set(own) <= set(shown):
        label = f"all {record['current'].shape[1]} motors"
        axes.fill_between(
            record.time, values.min(axis=1), values.max(axis=1), color="#CFCFCF", linewidth=0, label=label
        )
    for column, k in zip(values.T, own, strict=True):
        if k in shown:
            joint = record.labels["current"][k]
            style.line(axes, record.time, column, label=called.get(joint, joint), **looks[k])
    axes.axhline(0.0, color=style.GREY, linewidth=0.6)


def draw_limits(
    figure: style.Drawing,
    axes: Axes,
    motors: Mapping[str, Mapping[str, Any]],
    keys: Sequence[str],
    label: str,
) -> None:
    """Draw limits and ratings of motors if their lines are near the curves; otherwise add a note.

    Parameters
    ----------
    motors : mapping
        For the colour of each motor, its limits by key. Limits that differ have the colours of their motors.
    keys : sequence of str
        Keys of limit and rating.
    label : str
        Quantity and unit, such as "torque [N m]".
    """
    quantity, _, unit = label.rstrip("]").partition(" [")
    for key, text, look in zip(keys, ("limit", "rating"), (LIMIT, RATING), strict=False):
        known = {colour: float(motor[key]) for colour, motor in motors.items() if motor.get(key) is not None}
        alike = len(set(known.values())) == 1
        for colour, value in list(known.items())[: 1 if alike else None]:
            low, high = axes.get_ylim()
            name = f"{text} of the {quantity}: {style.number(value)} {unit}"
            if value > FAR * max(-low, high):
                if alike:
                    figure.note(f"Beyond the axes: {name}.")
                continue
            if not alike:
                name = f"{text} of the {quantity}, in the colour of its motor"
            sides = [side for side in (-value, value) if FAR * max(side * low, side * high) > value * value]
            for side in sides:
                own = {**look, "color": look["color"] if alike else colour}
                axes.axhline(side, label=name if side is sides[-1] else None, **own)
            axes.set_ylim(min(low, 1.08 * min(sides)), max(high, 1.08 * max(sides)))


# Hand and target: paths in three planes, and tracking error over time ([WM] Figs 4–6).
PLANES = ((0, 1), (0, 2), (1, 2))
# A path whose extent along an axis is below this fraction of the largest extent, about the width of a line, is drawn in
# the other plane only; if the ratio is above UNEQUAL, the axes of a plane have different scales.
EDGE_ON, UNEQUAL = 0.0125, 8.0
MILLI = 1e3
SIDES = np.array([-1.0, 1.0])
# A target that moves by less than this counts as fixed [m].
HELD = 1e-6
# Maximum number of legend entries in the free corner of a narrow figure.
CORNER = 7
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
    low, high = _box(list(shown.values()))
    planes, note = _planes(low, high)
    wide, alone = not style.narrow(), len(planes) == 1
    corner = len(planes) == 3 and not wide
    height = 3.6 if corner else 2.5 if wide else 1.1 + 2.0 * len(planes)
    if alone:
        across, up = (high - low)[list(planes[0])]
        height = 1.0 + float(np.clip((style.width() - 0.9) * up / max(across, style.NOTHING), 1.6, 3.0))
    figure = style.new_figure(height, title)
    if corner:
        # As in a technical drawing: xz is below xy, and yz beside it.
        grid = figure.add_gridspec(2, 2)
        panels = [figure.add_subplot(grid[cell]) for cell in ((0, 0), (1, 0), (1, 1))]
    else:
        panels = list(figure.subplots(*((1, len(planes)) if wide else (len(planes), 1)), squeeze=False).ravel())
    note += _frame(panels, planes, low, high)
    if corner:
        panels[0].set_anchor("S")
    styles = style.variant_styles(list(records))
    for axes, plane in zip(panels, planes, strict=True):
        _draw_target(axes, next(iter(shown.values())), plane)
        for name, record in shown.items():
            position = style.sparse(record["hand_position"][:, plane])
            axes.plot(*position.T, label=name, **styles[name])
            axes.plot(*position[0], **START)
    _add_starts(panels[0])
    entries = style.legend_entries(panels[:1])
    if corner and len(entries) <= CORNER:
        free = figure.add_subplot(grid[0, 1])
        free.set_axis_off()
        labels = [style.broken(style.visible(label), 1.1) for label in entries]
        free.legend(entries.values(), labels, loc="center")
    else:
        style.legend_below(figure, panels[:1], 4)
    if note:
        figure.note(note.strip())
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
            style.line(axes, record.time, deviation[:, k], label=f"${name}$", **looks[name])
    for axes in rows[1]:
        style.line(axes, record.time, norm, label=_error_label("distance", record), color=style.PURPLE)
        axes.set_ylim(bottom=0.0)
    style.label_row(rows[0], f"hand − {target_name(record)}\n[mm]")
    style.label_row(rows[1], f"distance from\n{target_name(record)} [mm]")
    _mark_settle(figure, rows, [record])
    contacts.mark_all(figure, rows, record)
    style.legend_above(rows[0][-1], columns=4)
    style.legend_above(rows[1][-1])
    return figure


def error_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw the tracking errors of all variants: distance from the target and vertical error.

    The axis of the distance is logarithmic if the settled distances differ by more than ``LOG_DISTANCE``.
    """
    shown = {name: record for name, record in records.items() if hand_target(record) is not None}
    if not shown:
        return None
    figure = style.new_figure(4.4, style.comparison_title(list(shown.values()), "tracking error"))
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
    _mark_settle(figure, rows, list(shown.values()))
    _scale_distances(figure, rows[0], [norms[name][record.time >= settle] for name, record in shown.items()])
    style.label_row(rows[0], "distance from\ntarget [mm]")
    style.label_row(rows[1], "vertical\nerror [mm]")
    style.legend_below(figure, [rows[0][-1], rows[1][-1]], 5)
    return figure


def _scale_distances(figure: style.Drawing, panels: Sequence[Axes], settled: Sequence[Array]) -> None:
    """Set the axes of distances, (n,) [mm] per variant, so that the settled ones of all variants can be read."""
    typical = [float(np.median(values)) for values in settled if values.size]
    if not typical or not 0.0 < LOG_DISTANCE * min(typical) < max(typical):
        for axes in panels:
            axes.set_ylim(bottom=0.0)
        return
    low = min(float(np.percentile(values, 2.0)) for values in settled if values.size) / 1.3
    # Distances near zero would extend the axis by many empty decades.
    low = max(low, 1e-4 * max(typical))
    figure.note(f"Distance: logarithmic, not drawn below {style.number(low, 2)} mm.")
    for axes in panels:
        axes.autoscale(axis="y")
        for text in [*axes.texts]:
            text.remove()  # the maximum is no longer cut
        axes.set_ylim(low, axes.get_ylim()[1])
        style.log_axis(axes)
    if len(panels) > 1:
        panels[-1].set_ylim(top=1.3 * max(float(values.max()) for values in settled if values.size))
        style.log_axis(panels[-1])


def _box(records: list[Record]) -> tuple[Array, Array]:
    """Return the corners of the box with all hand paths and targets [m]."""
    points = [record["hand_position"] for record in records]
    points += [target for record in records if (target := hand_target(record)) is not None]
    return box_about(points)


def _planes(low: Array, high: Array) -> tuple[Sequence[tuple[int, int]], str]:
    """Return the planes in which a path is not edge-on, and a note on the coordinate that is omitted."""
    size = high - low
    flat = [k for k in range(3) if size[k] < EDGE_ON * size.max()]
    if len(flat) != 1:
        return PLANES, ""
    (k,) = flat
    constant = f"{style.number(0.5 * (low[k] + high[k]), 3, scale=1.0)} m"
    within = f", within {style.number(0.5 * MILLI * size[k], 2)} mm" if size[k] > HELD else ""
    return [plane for plane in PLANES if k not in plane], f"Coordinate {'xyz'[k]}: {constant}{within}."


def _frame(panels: Sequence[Axes], planes: Sequence[tuple[int, int]], low: Array, high: Array) -> str:
    """Set limits of panels, with equal scale if the extents are comparable; label their axes; return a note."""
    size, apart = high - low, []
    margin = 0.06 * float(size.max()) or 0.05
    for axes, plane in zip(panels, planes, strict=True):
        across, up = size[list(plane)].tolist()
        half = 0.5 * np.array([across, up]) + margin
        if UNEQUAL * min(across, up) < size.max():
            half = 0.56 * np.array([across or margin, up or margin])
            apart.append(" and ".join("xyz"[k] for k in plane))
        else:
            axes.set_aspect("equal", anchor="N")  # put unused space above the legend
            half = half if len(planes) == 1 else np.full(2, 0.5 * float(size.max()) + margin)
        middle = 0.5 * (low + high)[list(plane)]
        axes.set(xlim=middle[0] + SIDES * half[0], ylim=middle[1] + SIDES * half[1])
        axes.set(**{f"{name}label": f"${'xyz'[k]}$ [m]" for name, k in zip("xy", plane, strict=True)})
        axes.tick_params(labelsize=style.letters(6.5 if style.narrow() else 7.5))
    return f" Axes have different scales: {', '.join(apart)}." if apart else ""


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


def _add_starts(axes: Axes) -> None:
    """Add legend entries for the markers at the starts of hand and target."""
    followed = {line.get_label() for line in axes.get_lines() if line.get_linestyle() != "None"}
    axes.plot([], [], label="start of the hand", **START)
    for target in (TARGET, GOALS):
        # A fixed target is itself drawn as a marker.
        if target in followed:
            axes.plot([], [], "x", color=style.BLACK, markersize=5, label=f"start of the {target}")


def _error_label(name: str, record: Record) -> str:
    rms = hand_error(record, record.settle_time)["hand_error_rms_m"]
    return name if rms is None or not np.isfinite(rms) else f"{name}: {style.number(MILLI * rms, 3, scale=1.0)} mm"


def _mark_settle(figure: style.Drawing, rows: Sequence[Sequence[Axes]], records: Sequence[Record]) -> None:
    """Draw a line at the settling time, from which the rms values in the legend count, or note the time."""
    settle, end = max(run.settle_time for run in records), max(float(run.time[-1]) for run in records)
    text = f"rms distance from {settle:g} s on" if settle > 0.0 else "rms distance of the whole run"
    shown = False
    for axes in (axes for panels in rows for axes in panels):
        if max(0.0, records[0].time[0]) < settle < min(end, axes.get_xlim()[1]):
            label = f"numbers: {text}" if axes is rows[-1][-1] else None
            axes.axvline(settle, color=style.GREY, linestyle=":", linewidth=1.0, label=label)
            shown |= label is not None
    if not shown:
        figure.note(f"Numbers in the legend: {text}.")
