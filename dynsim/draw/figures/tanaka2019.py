"""Figures and tables in the layout of [T], for comparison with the paper.

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019. Its curves are not reproduced; numbers that its text states are shown.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dynsim.draw.figures import style
from dynsim.draw.figures.snake_view import (
    GROUND,
    HEAD,
    SYMBOLS,
    View,
    greek,
    mode_chart,
    overlay_margins,
    posture_grid,
    posture_strip,
)
from dynsim.draw.figures.style import VARIANT_COLOURS
from dynsim.record import Record
from dynsim.snake.lifting import snake_geometry
from dynsim.snake.published import (
    COORDINATES,
    DOORS,
    HEAD_ERROR,
    POLICIES,
    SOURCES,
    TABLE_III,
    displacement,
    mode_sequence,
    opening,
    tables,
)
from dynsim.system.files import write_text

STOPPED = "joint at its limit"
# Scenarios of Fig 13: without and with a pipe.
PICK_UPS = ("snake_operator", "snake_pick_up")

Maker = Callable[[Mapping[str, Record]], Figure]


def figures(scenario: str, records: Mapping[str, Record]) -> dict[str, Maker]:
    """Return the drawing functions of comparisons with [T] by file name, for the variants that were run."""
    makers: dict[str, Maker] = {}
    if scenario == "snake_positioning" and set(records) & set(TABLE_III):
        makers["table_iii"] = positioning
    if scenario == "snake_positioning_dynamic":
        moved = [name for name in TABLE_III if name in records]
        if moved:
            makers |= {"table_iii": dynamic_positioning, "wheel_loads": wheel_loads}
        if {"beta", "beta_measured"} <= set(records):
            makers["fig_7"] = sag_and_feedback
    if scenario == "snake_joint_limits":
        if "cyclic" in records:
            makers |= {"fig_9": lambda r: head_and_cost(r["cyclic"]), "fig_10": lambda r: joint_angles(r["cyclic"])}
        if {"cyclic", "eq20", "eq20_min"} <= set(records):
            makers["fig_8_and_16"] = motion
        if set(POLICIES) <= set(records):
            makers["policies"] = policies
    if scenario in DOORS and "pull_switching" in records:
        makers["fig_14"] = lambda r: door(r["pull_switching"])
    return makers


def figures_of_run(record: Record) -> dict[str, Callable[[Record], Figure]]:
    """Return the drawing functions of comparisons with [T] that require only one run."""
    return {"fig_13": picking_up} if record.summary["scenario"] in PICK_UPS and record["gripper"].any() else {}


def write_tables(scenario: str, records: Mapping[str, Record], folder: Path) -> list[Path]:
    """Write the comparison tables with [T] as CSV; return the files."""
    written = []
    for name, rows in tables(scenario, records).items():
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows(rows)
        written.append(write_text(folder / f"{name}.csv", stream.getvalue()))
    return written


def _bars(
    axis: Axes, moved: Sequence[str], places: NDArray[Any], i: int, scale: float, deviations: float, **look: Any
) -> None:
    """Draw how far coordinate i was from its target in [T], ± a number of standard ``deviations``."""
    published = [TABLE_III[name] for name in moved]
    off = [scale * (p.mean[i] - p.target[i]) for p in published]
    axis.bar(places, off, yerr=[deviations * scale * p.deviation[i] for p in published], capsize=2, **look)


def positioning(records: Mapping[str, Record]) -> Figure:
    """Draw Table III of [T]: deviation from the target displacement, measured in [T] and simulated here."""
    moved = [name for name in TABLE_III if name in records]
    figure = style.new_figure(4.7, "displacements of the head and Table III of [T]")
    axes = figure.subplots(2, 1, sharex=True)
    width = 0.8 / 3
    for axis, part, unit in ((axes[0], range(3), "mm"), (axes[1], range(3, 6), "rad")):
        scale = 1e3 if unit == "mm" else 1.0
        for k, i in enumerate(part):
            positions = np.arange(len(moved)) + (k - 1) * width
            name = SYMBOLS.get(COORDINATES[i], COORDINATES[i])
            look = {"color": VARIANT_COLOURS[k], "alpha": 0.6, "label": f"Δ{name}, [T]"}
            _bars(axis, moved, positions, i, scale, 1.0, width=0.9 * width, **look)
            ours = [scale * (displacement(records[m])[i] - TABLE_III[m].target[i]) for m in moved]
            axis.plot(positions, ours, "D", color="black", ms=3, label="simulated, no slip" if k == 2 else None)
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_ylabel(f"off target [{unit}]")
        style.legend_beside(axis)
    axes[1].set_xticks(range(len(moved)), [f"moving {SYMBOLS.get(m, m)}" for m in moved])
    axes[1].set_xlim(-0.6, len(moved) - 0.4)
    return figure


def dynamic_positioning(records: Mapping[str, Record]) -> Figure:
    """Draw Table III of [T]: deviation from the target displacement, measured in [T] and simulated in three ways."""
    moved = [name for name in TABLE_III if name in records]
    figure = style.new_figure(6.6, "displacements of the head and Table III of [T]")
    axes = figure.subplots(6, 1, sharex=True)
    marks = {"kinematic": ("|", "black"), "dynamic": ("D", HEAD), "measured": ("o", GROUND)}
    for i, axis in enumerate(axes):
        positions, unit = np.arange(len(moved)), "mm" if i < 3 else "mrad"
        look = {"color": VARIANT_COLOURS[2], "alpha": 0.5, "label": "[T], ± 2 SD"}
        _bars(axis, moved, positions, i, 1e3, 2.0, width=0.6, **look)
        for source, (mark, colour) in marks.items():
            names = [m + SOURCES[source] for m in moved]
            there = [k for k, name in enumerate(names) if name in records]
            ours = [1e3 * (displacement(records[names[k]])[i] - TABLE_III[moved[k]].target[i]) for k in there]
            axis.plot(positions[there], ours, mark, color=colour, ms=5, label=source)
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_ylabel(f"Δ{SYMBOLS.get(COORDINATES[i], COORDINATES[i])} [{unit}]")
    axes[-1].set_xlim(-0.6, len(moved) - 0.4)
    style.legend_below(figure, [axes[0]], 4)
    axes[-1].set_xticks(range(len(moved)), [f"moving {SYMBOLS.get(m, m)}" for m in moved])
    return figure


def sag_and_feedback(records: Mapping[str, Record]) -> Figure:
    """Draw Figs 7(a) and 7(b) of [T]: the head while β changes, with feedforward and with a measured head pose."""
    figure = style.new_figure(7.2, "head while β changes, as in Fig 7 of [T]")
    axes = figure.subplots(6, 2, sharex=True, sharey="row")
    shown = {"beta": "(a) feedforward", "beta_measured": "(b) measured by motion capture"}
    for column, (name, title) in zip(axes.T, shown.items(), strict=True):
        record = records[name]
        for i, axis in enumerate(column):
            axis.plot(record.time, record["w"][:, i], color=GROUND, label="simulated")
            axis.plot(record.time, record["w_target"][:, i], ":", color="red", lw=1.4, label="target")
            style.at_least(axis, 0.02)
        column[0].set_title(title, fontsize=style.letters(8.0))
        column[-1].set_xlabel("t [s]")
    for i, axis in enumerate(axes[:, 0]):
        axis.set_ylabel(f"{SYMBOLS.get(COORDINATES[i], COORDINATES[i])}$_h$ [{'m' if i < 3 else 'rad'}]")
    style.legend_below(figure, [axes[0, 0]], 2)
    return figure


def wheel_loads(records: Mapping[str, Record]) -> Figure:
    """Draw the loads of the wheel pairs over time, for every manoeuvre with feedforward."""
    moved = [name for name in TABLE_III if name in records]
    figure = style.new_figure(1.25 * len(moved) + 1.2, "loads of the wheel pairs")
    axes = figure.subplots(len(moved), 1, sharex=True, squeeze=False)[:, 0]
    for axis, name in zip(axes, moved, strict=True):
        record = records[name]
        names = record.labels["contact_normal_force"]
        for pair in record.labels["grounded"]:
            sides = [k for k, wheel in enumerate(names) if wheel[:-1] == pair.replace("pair", "wheel")]
            load = record["contact_normal_force"][:, sides].sum(axis=1)
            axis.plot(record.time, load, lw=0.9, label=pair.replace("pair", "pair "))
        axis.set_ylabel(f"moving {SYMBOLS.get(name, name)} [N]")
        axis.set_ylim(bottom=0.0)
    axes[-1].set_xlabel("t [s]")
    style.legend_below(figure, [axes[0]], len(axes[0].lines))
    return figure


def motion(records: Mapping[str, Record]) -> Figure:
    """Draw Figs 8 and 16 of [T]: top views over time with the costs of eq 19 and eq 20."""
    shown = {"cyclic": "eq 19\n(Fig 8)", "eq20": "eq 20 printed\n(Fig 16)", "eq20_min": "eq 20, 1/min d\n(Fig 16)"}
    lines = {}
    for name, label in shown.items():
        record = records[name]
        views = [_view_at(record, t) for t in (0.0, 2.0, 7.0, 12.0, 17.0, np.inf)]
        area = record["support_area"]
        lines[label] = [(v, f"{v.time:.0f} s, mode {v.mode}, {area[v.row]:.3f} m²") for v in views]
    return posture_grid("eq 19 and eq 20, as in Figs 8 and 16 of [T], with the area of the support polygon", lines)


def _view_at(record: Record, time: float) -> View:
    return View(record, min(int(np.searchsorted(record.time, time)), len(record) - 1))


def head_and_cost(record: Record) -> Figure:
    """Draw Fig 9 of [T]: head pose, mode and V over time, and the error stated in the text of [T]."""
    figure = style.new_figure(6.9, style.title(record, "head, mode and cost, as in Fig 9 of [T]"))
    axes = figure.subplots(4, 2, sharex=True)
    time = record.time
    for i, axis in enumerate(axes[:3].T.ravel()):
        scale, error, unit = (1e3, HEAD_ERROR[0], "mm") if i < 3 else (1.0, HEAD_ERROR[1], "rad")
        target = scale * record["w_target"][:, i]
        axis.plot(time, scale * record["w"][:, i], color=GROUND, label="simulated")
        axis.plot(time, target, ":", color="red", lw=1.4, label="target")
        low, high, label = target - scale * error, target + scale * error, "[T]: errors of about 30 mm and 0.1 rad"
        axis.fill_between(time, low, high, color=VARIANT_COLOURS[4], alpha=0.25, lw=0, label=label)
        style.at_least(axis, 4 * scale * error)
        axis.set_ylabel(f"{SYMBOLS.get(COORDINATES[i], COORDINATES[i])}$_h$ [{unit}]")
        off = scale * np.abs(record["w"][:, i] - record["w_target"][:, i]).max()
        axis.set_title(f"largest error {off:.1e} {unit}", fontsize=style.letters(7.0))
    axes[3, 0].step(time, record["mode"], where="post", color=GROUND)
    axes[3, 0].set(ylabel="σ", ylim=(0.5, record["mode"].max() + 0.5), xlabel="t [s]")
    axes[3, 0].set_yticks(np.unique(record["mode"]))
    axes[3, 1].plot(time, record["cost"], color=GROUND)
    axes[3, 1].set(ylabel="V", xlabel="t [s]")
    axes[3, 1].set_ylim(bottom=0.0)
    style.legend_below(figure, [axes[0, 0]], 3)
    return figure


def joint_angles(record: Record) -> Figure:
    """Draw Fig 10 of [T]: every joint angle over time with its limits."""
    geometry, phi = snake_geometry(record), record["phi"]
    names, count = record.labels["phi"], phi.shape[1]
    lines = -(-count // 3)
    figure = style.new_figure(1.55 * lines + 0.7, style.title(record, "joint angles, as in Fig 10 of [T]"))
    axes = figure.subplots(lines, 3, sharex=True)
    for axis in axes.ravel()[count:]:
        axis.set_visible(False)
    for j, axis in enumerate(axes.ravel()[:count]):
        axis.plot(record.time, phi[:, j], color=GROUND, label="simulated")
        for bound in (geometry.lower[j], geometry.upper[j]):
            axis.axhline(bound, color="black", ls="-.", lw=0.8, label="joint limit")
        out, label = record["at_limit"][:, j] > 0, "excluded from allocation at its limit"
        axis.plot(record.time[out], phi[out, j], ".", color=HEAD, ms=3, label=label)
        if "phi_command" in record:
            axis.plot(record.time, record["phi_command"][:, j], ":", color="red", lw=1.2, label="commanded")
        reach = 1.15 * geometry.upper[j]
        axis.set(ylim=(-reach, reach), ylabel=f"{greek(names[j])} [rad]")
    for axis in axes[-1]:
        axis.set_xlabel("t [s]")
    style.legend_below(figure, [axes[0, 0]], 4)
    return figure


def policies(records: Mapping[str, Record]) -> Figure:
    """Draw the modes of the three policies over time, with V, the largest yaw angle and the support margin."""
    figure = style.new_figure(9.3, style.comparison_title(list(records.values()), "mode switching policies"))
    axes = figure.subplots(6, 1, sharex=True, height_ratios=[1, 1, 1, 1.2, 1, 1])
    for axis, name in zip(axes, POLICIES, strict=False):
        mode_chart(axis, records[name], f"{name}: mode")
    overlay_margins(
        axes[3:], {f"{name}, V at the end {records[name]['cost'][-1]:.2f}": records[name] for name in POLICIES}
    )
    axes[3].legend()
    axes[5].set_xlabel("t [s]      (margin below zero: the robot tips)")
    return figure


def door(record: Record) -> Figure:
    """Draw Fig 14 of [T], seen from above: pulling the door, stops at joint limits, and postures after mode changes."""
    fixing = record["mode"][0]
    changes = mode_sequence(record)
    # A stop ends with the first mode other than the fixing mode; a recovery ends with the return to the fixing mode.
    stops = [
        (t, STOPPED if mode != fixing else "after switching modes")
        for (_, before), (t, mode) in pairwise(changes)
        if (before == fixing) != (mode == fixing)
    ]
    closed = record.time[np.flatnonzero(record["gripper"])[0]]
    shown = [(0.0, "initial"), (closed, "knob grasped"), *stops, (record.time[-1], "end")]
    titled = []
    for k, (time, caption) in enumerate(shown):
        view = _view_at(record, time)
        if caption == STOPPED:
            view = View(record, max(view.row - 1, 0))  # the sample before the change that ends the stop
        opened = opening(record)[view.row]
        titled.append((view, f"({'abcdefghijklmnop'[k]}) {caption}\n{view.time:.1f} s, {opened:.1f}°"))
    lines = {" " * start: titled[start : start + 3] for start in range(0, len(titled), 3)}
    title = style.title(record, "the door and its angle, as in Fig 14 of [T]; green: arc of the knob")
    return posture_grid(title, lines)


def picking_up(record: Record) -> Figure:
    """Draw Fig 13 of [T]: reaching, grasping and after picking up, with the object if the scenario has one."""
    closed = np.flatnonzero(record["gripper"])
    height = record["w"][closed, 2]
    lifted = closed[np.argmax(height > height.max() - 1e-4)]  # the first time; later ones differ only by rounding
    shown = ((closed[0] // 2, "1: reaching"), (closed[0], "2: grasping"), (lifted, "3: after picking up"))
    line = [(View(record, int(row)), f"{caption}, t = {record.time[row]:.1f} s") for row, caption in shown]
    return posture_strip(style.title(record, "picking up, as in Fig 13 of [T]"), line)
