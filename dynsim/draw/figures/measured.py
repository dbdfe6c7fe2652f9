"""Figures of a measured run: joints and goals, servos, hand path, posture, and errors relative to a simulated run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynsim.draw.figures import energy, posture, style
from dynsim.draw.figures.style import Array
from dynsim.record import TIME, Record
from dynsim.record.measures import servo_limits

# Maximum number of joints on a page; the joints with the largest errors are drawn.
JOINTS = 24
# Maximum number of lines in a panel.
LINES = 12
MILLI = 1e3


def draw(record: Record, folder: Path, kind: str = "png") -> list[Path]:
    """Draw all figures, see :func:`dynsim.draw.figures.draw`."""
    return style.save_all(FIGURES, record, folder, kind)


def joints(record: Record) -> Figure | None:
    """Draw every joint with its goal over time; return None without recorded goals."""
    followed = _followed(record)
    if not followed:
        return None
    shown = _largest(followed, JOINTS)
    columns = 2 if len(shown) > (6 if style.narrow() else 3) else 1
    lines = -(-len(shown) // columns)
    note = "" if len(shown) == len(followed) else f"; {len(shown)} of {len(followed)} with the largest error"
    figure = style.new_figure(0.9 + 1.15 * lines, style.title(record, f"joints and their goals{note}"))
    grid = figure.subplots(lines, columns, sharex=True, squeeze=False)
    for axes, (label, unit, measured, goal) in zip(grid.T.ravel(), shown, strict=False):
        style.line(axes, record.time, measured, color=style.BLUE, label="measured")
        style.line(axes, record.time, goal, color=style.BLACK, linestyle=(0, (4, 2)), lw=0.9, label="goal")
        axes.set_ylabel(f"{label}\n[{unit}]")
        style.at_least(axes, 0.02)
        _mark_replay(axes, record)
    for axes in grid.T.ravel()[len(shown) :]:
        axes.set_axis_off()
    _label_time(grid)
    style.legend_below(figure, [grid[0, 0]], 2)
    return figure


def following_error(record: Record) -> Figure | None:
    """Draw the following error (measured minus goal) of every joint and its magnitude; return None without goals."""
    followed = _followed(record)
    if not followed:
        return None
    shown = _largest(followed, LINES)
    note = "" if len(shown) == len(followed) else f"; {len(shown)} of {len(followed)} with the largest error"
    figure = style.new_figure(2.9 + 0.17 * len(shown), style.title(record, f"following error{note}"))
    over_time, largest = figure.subplots(2, 1, height_ratios=[1.7, 0.4 + 0.17 * len(shown)])
    units = {unit for _, unit, _, _ in shown}
    one_unit = f" [m{units.pop()}]" if len(units) == 1 else ""
    looks = style.variant_styles([label for label, *_ in shown])
    for label, unit, measured, goal in shown:
        name = label if one_unit else f"{label} [m{unit}]"
        style.line(over_time, record.time, MILLI * (measured - goal), label=name, **looks[label])
    over_time.set_ylabel(f"measured − goal\n{one_unit.strip()}")
    over_time.set_xlabel("time [s]")
    _mark_replay(over_time, record, named=True)
    during = record.time >= 0.0 if (record.time >= 0.0).any() else slice(None)
    errors = [MILLI * np.abs(measured - goal)[during] for _, _, measured, goal in shown]
    most = [_finite(np.nanmax, error) for error in errors]
    rms = [_finite(lambda e: np.sqrt(np.nanmean(e**2)), error) for error in errors]
    energy.bars(largest, [label for label, *_ in shown], most, rms)
    limits = servo_limits(record, "following_error_rad")
    for k, (label, *_) in enumerate(shown):
        if (limit := limits.get(label)) is not None:
            energy.limit_mark(largest, k, MILLI * limit, "limit of the error")
    largest.set_xlabel(f"magnitude during the replay{one_unit}")
    largest.set_xlim(0.0, 1.05 * largest.get_xlim()[1])
    style.legend_below(figure, [over_time, largest], 4)
    return figure


def servos(record: Record) -> Figure | None:
    """Draw the measurements of the servos and the timing of the cycles; return None without measurements."""
    rows = [
        (name, label)
        for name, label in (
            ("torque_estimate", "estimated\ntorque [N m]"),
            ("current", "current\n[A]"),
            ("load", "load / stall\ntorque"),
            ("pwm", "PWM / supply\nvoltage"),
            ("supply_voltage", "supply\nvoltage [V]"),
            ("temperature", "temperature\n[°C]"),
        )
        if name in record and record[name].shape[1:] != (0,) and np.isfinite(record[name]).any()
    ]
    if not rows:
        return None
    # Every row shows the same joints, selected by the largest values in the first row.
    first, names = record[rows[0][0]], record.labels[rows[0][0]]
    size = [_finite(np.nanmax, np.abs(column)) for column in first.T]
    shown = [names[k] for k in np.sort(np.argsort(size)[::-1][:LINES])]
    timed = "lateness" in record
    note = "" if len(shown) == len(names) else f"; {len(shown)} of {len(names)} with the largest {rows[0][0]}"
    title = style.title(record, f"servos{note.replace('_', ' ')}")
    figure = style.new_figure(1.1 + 1.2 * (len(rows) + timed), title)
    grid = figure.subplots(len(rows) + timed, 1, sharex=True, squeeze=False)
    for (name, label), axes in zip(rows, grid[:, 0], strict=False):
        columns = dict(zip(record.labels[name], record[name].T, strict=True))
        for joint, look in style.variant_styles(shown).items():
            if joint in columns:
                style.line(axes, record.times(name), columns[joint], label=joint, **look)
        axes.set_ylabel(label)
        style.at_least(axes, 0.5)
        _mark_replay(axes, record, named=axes is grid[0, 0])
    if rows[0][0] == "torque_estimate":
        limits = servo_limits(record, "torque_N_m")
        motors = {look["color"]: {"limit": limits.get(joint)} for joint, look in style.variant_styles(shown).items()}
        energy.draw_limits(figure, grid[0, 0], motors, ("limit",), "torque [N m]")
    style.legend_below(figure, [grid[0, 0]], 4)
    if timed:
        _cycles(grid[-1, 0], record)
    _label_time(grid)
    return figure


def _cycles(axes: Axes, record: Record) -> None:
    """Draw the lateness of the cycles, and mark cycles in which a servo did not answer."""
    style.line(axes, record.time, MILLI * record["lateness"], color=style.BLUE, lw=0.9, label="cycle late by")
    if "exchange" in record:
        style.line(axes, record.time, MILLI * record["exchange"], color=style.SKY, lw=0.9, label="exchange on the bus")
    axes.set_ylabel("duration\n[ms]")
    if "missed" in record and (missed := record["missed"].any(axis=1)).any():
        text = f"{missed.sum()} cycles with a servo that did not answer"
        axes.plot(record.time[missed], np.zeros(missed.sum()), "x", color=style.PULLING, markersize=4, label=text)
    style.legend_above(axes)
    _mark_replay(axes, record)


Followed = tuple[str, str, Array, Array]


def _followed(record: Record) -> list[Followed]:
    """Return the label, unit, measurement and goal of all quantities with goals.

    These are positions, or rates if no position is recorded with a goal.
    """
    followed: dict[str, Followed] = {}
    own = [name for name, signal in record.signals.items() if signal.axis == TIME and signal.data.ndim == 2]
    names = [name for name in own if f"{name}_goal" in own and name != "hand_position"]
    for name in sorted(names, key=lambda name: record.units[name].endswith("/s")):
        goals = dict(zip(record.labels[f"{name}_goal"], record[f"{name}_goal"].T, strict=True))
        for label, measured in zip(record.labels[name], record[name].T, strict=True):
            if label in goals and np.isfinite(goals[label]).any():
                followed.setdefault(label, (label, record.units[name], measured, goals[label]))
    return list(followed.values())


def _largest(followed: Sequence[Followed], count: int) -> list[Followed]:
    """Return all entries, or the ``count`` entries with the largest errors, in the original order."""
    errors = [_finite(np.nanmax, np.abs(measured - goal)) for _, _, measured, goal in followed]
    kept = np.sort(np.argsort(errors)[::-1][:count])
    return [followed[k] for k in kept]


def _finite(measure: Callable[[Array], float], values: Array) -> float:
    """Apply a measure to values, or return 0 if no value is finite."""
    return float(measure(values)) if np.isfinite(values).any() else 0.0


def _mark_replay(axes: Axes, record: Record, *, named: bool = False) -> None:
    """Draw dotted lines at changes of the replay state; faults in red."""
    start, end = float(record.time[0]), float(record.time[-1])
    for event in record.events:
        if event.kind not in ("state", "fault") or not start < event.time <= end:
            continue
        colour = style.PULLING if event.kind == "fault" else style.GREY
        axes.axvline(event.time, color=colour, linestyle=":", linewidth=0.8, zorder=1)
        # Label only some changes, because the first states may follow each other within milliseconds.
        if named and (event.kind == "fault" or event.name == "REPLAY"):
            # The names are above the axes, and faults above the start of the replay, which may be near.
            look: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
            side = "right" if event.time > 0.7 * end + 0.3 * start else "left"
            level = 2.0 + (event.kind == "fault") * 9.0
            axes.annotate(
                f"fault: {event.name.lower()}" if event.kind == "fault" else event.name.lower(),
                (event.time, 1.0),
                xytext=(0.0, level),
                ha=side,
                color=colour,
                fontsize=style.letters(7.0),
                **look,
            )


def _label_time(grid: np.ndarray) -> None:
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")


def figures(record: Record) -> dict[str, Callable[[Record], Figure | None]]:
    """Return the drawing functions of one run by file name; they return None if the record has no data."""
    return FIGURES


# Drawing functions by file name; they return None if the record has no data.
FIGURES: dict[str, Callable[[Record], Figure | None]] = {
    "joints": joints,
    "following_error": following_error,
    "servos": servos,
    "hand_path": energy.path,
    "tracking_error": energy.error,
    "posture": posture.posture,
}


# Errors between measured and simulated runs, drawn for `dynsim hw compare`.

# Number of joints drawn in colour by default, selected by the largest rms errors.
HIGHLIGHTED = 4
FAINT: dict[str, Any] = {"color": "#CFCFCF", "linewidth": 0.7}
# Simulated values are drawn on top and dashed, so that both curves are visible if they agree.
SIMULATED: dict[str, Any] = {"color": style.BLACK, "linewidth": 0.9, "linestyle": (0, (4, 3))}


@dataclass(frozen=True)
class Compared:
    """One quantity of several joints, simulated and measured, with its errors.

    Attributes
    ----------
    kind : str
        Plural noun, such as "joints".
    quantity, error : str
        Axis labels, with units.
    scale : float
        Factor from the unit of the values to the unit of the error.
    names : list of str
        Names of the joints.
    rms : list of float
        Rms errors.
    texts : list of str
        Legend entries of the errors.
    values : (2, T, N) ndarray
        Simulated and measured values.
    """

    kind: str
    quantity: str
    error: str
    scale: float
    names: list[str]
    rms: list[float]
    texts: list[str]
    values: Array


def draw_errors(title: str, time: Array, quantities: Sequence[Compared], named: Sequence[str], path: Path) -> Path:
    """Draw two panels per quantity: measured over simulated values of some joints, and the errors of all joints.

    Parameters
    ----------
    title : str
        Title of the figure.
    time : (T,) ndarray
        Times [s].
    quantities : sequence of Compared
        Quantities to draw.
    named : sequence of str
        Joints to draw in colour; if a quantity has no named joint, the ``HIGHLIGHTED`` joints with the largest errors
        are drawn in colour.
    path : Path
        File to write.

    Returns
    -------
    Path
        The written file.
    """
    with style.look():
        rows = [style.legend_row() / 72.0 * (3 + min(len(quantity.names), HIGHLIGHTED)) / 2 for quantity in quantities]
        figure = style.new_figure(sum(4.2 + row for row in rows), title)
        panels = figure.subplots(2 * len(quantities), 1, sharex=True)
        # A joint has the same colour in all panels.
        chosen: dict[str, None] = {}
        for quantity in quantities:
            own = [name for name in (named or chosen) if name in quantity.names]
            order = sorted(range(len(quantity.names)), key=lambda k: -quantity.rms[k])
            chosen.update(dict.fromkeys(own or [quantity.names[k] for k in order[:HIGHLIGHTED]]))
        looks = {name: look | {"linewidth": 1.2} for name, look in style.variant_styles(list(chosen)).items()}
        for quantity, (values, errors) in zip(quantities, panels.reshape(-1, 2), strict=True):
            _draw(values, errors, time, quantity, looks)
        panels[-1].set_xlabel("record time [s]")
        return style.save(figure, path)


def _draw(values: Axes, errors: Axes, time: Array, quantity: Compared, looks: Mapping[str, dict[str, Any]]) -> None:
    ranking = sorted(range(len(quantity.names)), key=lambda k: quantity.rms[k])
    simulated, measured = quantity.values
    chosen = [k for k, name in enumerate(quantity.names) if name in looks]
    for k in chosen:
        style.line(values, time, measured[:, k], **looks[quantity.names[k]])
        style.line(values, time, simulated[:, k], **SIMULATED)
    for k in [k for k in ranking if k not in chosen] + chosen:
        look = looks[quantity.names[k]] | {"label": quantity.texts[k]} if k in chosen else FAINT
        style.line(errors, time, quantity.scale * (measured[:, k] - simulated[:, k]), **look)
    if others := len(quantity.names) - len(chosen):
        errors.plot([], [], label=f"the other {others} {quantity.kind}", **FAINT)
    values.plot([], [], label="simulated (measured in colour)", **SIMULATED)
    style.legend_above(values)
    style.legend_above(errors, columns=2)
    values.set_ylabel(quantity.quantity.replace(" [", "\n["))
    errors.axhline(0.0, color=style.GREY, linewidth=0.6)
    errors.set_ylabel(quantity.error.replace("− ", "−\n"))
