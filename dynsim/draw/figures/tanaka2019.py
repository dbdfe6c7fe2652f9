"""Figures in the layout of [T], for comparison with the paper.

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019. Its curves are not reproduced; numbers that its text states are shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dynsim.draw.figures import style
from dynsim.draw.figures.snake_view import (
    COORDINATE_NAMES,
    COST,
    DEGREES,
    GROUND,
    HEAD,
    LIMIT,
    SYMBOLS,
    View,
    above_edge,
    greek,
    mode_chart,
    moving,
    overlay_margins,
    pair_loads,
    posture_grid,
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
)

STOPPED = "joint at its limit"
# Scenarios of Fig 13: without and with a pipe.
PICK_UPS = ("snake_operator", "snake_pick_up")

SIMULATED = {"kinematic": ""}
Maker = Callable[[Mapping[str, Record]], Figure]


def figures(scenario: str, records: Mapping[str, Record]) -> dict[str, Maker]:
    """Return the drawing functions of comparisons with [T] by file name, for the variants that were run."""
    makers: dict[str, Maker] = {}
    if scenario == "snake_positioning" and set(records) & set(TABLE_III):
        makers["table_iii"] = lambda r: _deviations(r, SIMULATED)
    if scenario == "snake_positioning_dynamic":
        moved = [name for name in TABLE_III if name in records]
        if moved:
            makers |= {"table_iii": lambda r: _deviations(r, SOURCES), "wheel_loads": wheel_loads}
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


# Names of the sources of a displacement, and their markers, by the keys of ``SOURCES``.
MARKS: dict[str, tuple[str, dict[str, Any]]] = {
    "kinematic": ("simulated, kinematic", {"marker": "s", "color": "black", "mfc": "none"}),
    "dynamic": ("simulated with forces, feedforward", {"marker": "D", "color": HEAD}),
    "measured": ("simulated with forces, head pose fed back", {"marker": "o", "color": GROUND}),
}


def _deviations(records: Mapping[str, Record], sources: Mapping[str, str]) -> Figure:
    """Draw Table III of [T]: deviations from six target displacements, measured in [T] and simulated here.

    ``sources`` contains the endings of the names of variants by the source of their displacement.
    """
    moved = [name for name in TABLE_III if name in records]
    places, published = np.arange(len(moved)), [TABLE_III[name] for name in moved]
    figure = style.new_figure(7.0, "displacement of the head minus its target, Table III of Tanaka et al. 2019")
    axes = figure.subplots(6, 1, sharex=True)
    for i, axis in enumerate(axes):
        off = [1e3 * (p.mean[i] - p.target[i]) for p in published]
        spread = [2e3 * p.deviation[i] for p in published]
        axis.bar(places, off, width=0.8, color=VARIANT_COLOURS[2], alpha=0.5, label="measured: mean")
        look: dict[str, Any] = {"ls": "", "color": VARIANT_COLOURS[5], "lw": 1.2, "capsize": 2.5}
        axis.errorbar(places - 0.28, off, yerr=spread, label="measured: ± 2 SD", **look)
        for shift, (source, ending) in zip((-0.08, 0.12, 0.3), sources.items(), strict=False):
            text, mark = MARKS[source]
            there = [k for k, name in enumerate(moved) if name + ending in records]
            ours = [1e3 * (displacement(records[moved[k] + ending])[i] - published[k].target[i]) for k in there]
            axis.plot(places[there] + shift, ours, ls="", ms=4, label=text, **mark)
        axis.axhline(0.0, color="black", lw=0.6)
        axis.margins(y=0.08)
        axis.set_ylabel(f"{_name(i)} [{'mm' if i < 3 else 'mrad'}]")
    axes[-1].set_xlim(-0.6, len(moved) - 0.4)
    axes[-1].set_xticks(places, [_name(COORDINATES.index(m)).split()[-1] for m in moved])
    axes[-1].set_xlabel("coordinate that was moved")
    figure.align_ylabels(axes)
    style.legend_below(figure, [axes[0]], 2)
    note = "Displacement: mean over the last second minus mean over the first second (Tanaka et al. 2019, V.A)"
    later = ", in which a head whose pose is fed back still rises from its sag." if len(sources) > 1 else "."
    figure.note(note + later)
    return figure


def _name(i: int) -> str:
    return COORDINATE_NAMES.get(COORDINATES[i], COORDINATES[i])


def sag_and_feedback(records: Mapping[str, Record]) -> Figure:
    """Draw Figs 7(a) and 7(b) of [T]: the head while β changes, with feedforward and with a measured head pose."""
    shown = {"beta": "(a) feedforward", "beta_measured": "(b) head pose fed back"}
    drawn, note = moving([records[name] for name in shown])
    figure = style.new_figure(
        1.2 * len(drawn) + 1.0, "head while its pitch β changes, as in Fig 7 of Tanaka et al. 2019"
    )
    axes = figure.subplots(len(drawn), 2, sharex=True, sharey="row", squeeze=False)
    for column, (name, title) in zip(axes.T, shown.items(), strict=True):
        record = records[name]
        for i, axis in zip(drawn, column, strict=True):
            scale = 1e3 if i < 3 else DEGREES
            axis.plot(record.time, scale * record["w"][:, i], color=GROUND, label="simulated")
            axis.plot(record.time, scale * record["w_target"][:, i], "--", color=HEAD, lw=1.0, label="target")
        column[0].set_title(title, fontsize=style.letters(8.0))
        column[-1].set_xlabel("time [s]")
    for i, axis in zip(drawn, axes[:, 0], strict=True):
        axis.set_ylabel(f"{_name(i)} [{'mm' if i < 3 else '°'}]")
    figure.align_ylabels(axes[:, 0])
    style.legend_below(figure, [axes[0, 0]], 2)
    figure.note(*filter(None, [note]))
    return figure


def wheel_loads(records: Mapping[str, Record]) -> Figure:
    """Draw the loads of the wheel pairs over time, for every manoeuvre with feedforward."""
    moved = [name for name in TABLE_III if name in records]
    columns = 2
    rows = -(-len(moved) // columns)
    loads = {name: pair_loads(records[name]) for name in moved}
    looks = style.variant_styles([pair for pair in loads[moved[0]] if any(load[pair].any() for load in loads.values())])
    figure = style.new_figure(1.3 * rows + 1.3, "loads of the wheel pairs by the coordinate that was moved")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axis, name in zip(axes.ravel(), moved, strict=False):
        record = records[name]
        for pair, look in looks.items():
            axis.plot(record.time, loads[name][pair], label=pair, **look)
        axis.set_title(f"moving {SYMBOLS.get(name, name)}", fontsize=style.letters(8.0))
    above_edge(axes[0, 0])
    for axis in axes.ravel()[len(moved) :]:
        axis.set_visible(False)
    for axis in axes[:, 0]:
        axis.set_ylabel("load [N]")
    for k in range(columns):
        axes[-1, k].set_xlabel("time [s]")
    style.legend_below(figure, [axes[0, 0]], 7)
    return figure


def motion(records: Mapping[str, Record]) -> Figure:
    """Draw Figs 8 and 16 of [T]: top views over time with the costs of eq 19 and eq 20."""
    shown = {"cyclic": "eq 19 (Fig 8)", "eq20": "eq 20 as printed (Fig 16)", "eq20_min": "eq 20, 1/min d (Fig 16)"}
    lines = {}
    for name, label in shown.items():
        record = records[name]
        views = [_view_at(record, t) for t in (0.0, 2.0, 7.0, 12.0, 17.0, np.inf)]
        area = record["support_area"]
        lines[label] = [(v, f"{v.time:.0f} s, mode {v.mode}, {area[v.row]:.3f} m²") for v in views]
    return posture_grid(
        "costs of eq 19 and eq 20, as in Figs 8 and 16 of Tanaka et al. 2019, with the area of support", lines
    )


def _view_at(record: Record, time: float) -> View:
    return View(record, min(int(np.searchsorted(record.time, time)), len(record) - 1))


def head_and_cost(record: Record) -> Figure:
    """Draw Fig 9 of [T]: head pose, mode and V over time, and the error stated in the text of [T]."""
    columns = 1 if style.narrow() else 2
    figure = style.new_figure(
        9.2 / columns + 2.4, style.title(record, "head, mode and cost, as in Fig 9 of Tanaka et al. 2019")
    )
    axes = figure.subplots(8 // columns, columns, sharex=True, squeeze=False)
    *poses, mode, cost = [*axes[:3].T.ravel(), *axes[3]] if columns == 2 else axes.ravel()
    time = record.time
    for i, axis in enumerate(poses):
        scale, error, unit = (1e3, HEAD_ERROR[0], "mm") if i < 3 else (1.0, HEAD_ERROR[1], "rad")
        target = scale * record["w_target"][:, i]
        axis.plot(time, scale * record["w"][:, i], color=GROUND, label="simulated")
        axis.plot(time, target, "--", color=HEAD, lw=1.0, label="target")
        low, high, label = (
            target - scale * error,
            target + scale * error,
            "errors in Tanaka et al. 2019: about 30 mm, 0.1 rad",
        )
        axis.fill_between(time, low, high, color=VARIANT_COLOURS[4], alpha=0.25, lw=0, label=label)
        style.at_least(axis, 4 * scale * error)
        axis.set_ylabel(f"{_name(i)} [{unit}]")
        off = scale * np.abs(record["w"][:, i] - record["w_target"][:, i]).max()
        least = 1e-3 * scale * error
        text = f"below {least:.2g}" if off < least else f"{off:.2g}"
        axis.set_title(f"largest error {text} {unit}", fontsize=style.letters(7.0))
    mode.step(time, record["mode"], where="post", color=GROUND)
    mode.set(ylabel="mode", ylim=(0.5, record["mode"].max() + 0.5))
    mode.set_yticks(np.unique(record["mode"]))
    cost.plot(time, record["cost"], color=GROUND)
    cost.set_ylabel(COST)
    cost.set_ylim(bottom=0.0)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.align_ylabels(axes)
    style.legend_below(figure, poses[:1], 3)
    return figure


def joint_angles(record: Record) -> Figure:
    """Draw Fig 10 of [T]: every joint angle over time with its limits."""
    geometry, phi = snake_geometry(record), record["phi"]
    names, count = record.labels["phi"], phi.shape[1]
    columns = 2 if style.narrow() else 3
    lines = -(-count // columns)
    figure = style.new_figure(
        1.4 * lines + 0.9, style.title(record, "joint angles, as in Fig 10 of Tanaka et al. 2019")
    )
    axes = figure.subplots(lines, columns, sharex=True)
    for axis in axes.ravel()[count:]:
        axis.set_visible(False)
    for j, axis in enumerate(axes.ravel()[:count]):
        axis.plot(record.time, phi[:, j], color=GROUND, label="simulated")
        for bound in (geometry.lower[j], geometry.upper[j]):
            axis.axhline(bound, label="joint limit", **LIMIT)
        out, label = record["at_limit"][:, j] > 0, "excluded from allocation at its limit"
        axis.plot(record.time[out], phi[out, j], ".", color=HEAD, ms=3, label=label)
        if "phi_command" in record:
            axis.plot(record.time, record["phi_command"][:, j], "--", color=HEAD, lw=1.0, label="commanded")
        reach = 1.15 * geometry.upper[j]
        axis.set(ylim=(-reach, reach), ylabel=f"{greek(names[j])} [rad]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    style.legend_below(figure, [axes[0, 0]], 4)
    return figure


def policies(records: Mapping[str, Record]) -> Figure:
    """Draw the modes of the three policies over time, with V, the largest yaw angle and the support margin."""
    figure = style.new_figure(9.3, style.comparison_title(list(records.values()), "mode switching policies"))
    axes = figure.subplots(6, 1, sharex=True, height_ratios=[1, 1, 1, 1.2, 1, 1])
    for axis, name in zip(axes, POLICIES, strict=False):
        mode_chart(axis, records[name], f"{name}: mode")
    shown = {f"{name}, cost at the end {records[name]['cost'][-1]:.2f}": records[name] for name in POLICIES}
    overlay_margins(axes[3:], shown, style.variant_styles(list(shown)))
    axes[5].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    style.legend_below(figure, [axes[3]], 3)
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
    title = style.title(record, "the door and its angle, as in Fig 14 of Tanaka et al. 2019")
    return posture_grid(title, {"": titled})


def picking_up(record: Record) -> Figure:
    """Draw Fig 13 of [T]: reaching, grasping and after picking up, with the object if the scenario has one."""
    closed = np.flatnonzero(record["gripper"])
    height = record["w"][closed, 2]
    lifted = closed[np.argmax(height > height.max() - 1e-4)]  # the first time; later ones differ only by rounding
    shown = ((closed[0] // 2, "1: reaching"), (closed[0], "2: grasping"), (lifted, "3: after picking up"))
    line = [(View(record, int(row)), f"{caption}, {record.time[row]:.1f} s") for row, caption in shown]
    return posture_grid(style.title(record, "picking up, as in Fig 13 of Tanaka et al. 2019"), {"": line}, side=True)
