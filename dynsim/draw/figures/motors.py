"""Figures of motor currents and voltages over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynsim.draw.figures import events, style
from dynsim.record import Record

# Most motors with lines of their own: those with the largest currents; of more motors the envelope is drawn too.
LARGEST = 6


def motors(record: Record) -> Figure | None:
    """Motor currents and terminal voltages; None without motors."""
    if "current" not in record or record["current"].shape[1] == 0:
        return None
    signals = (("current", "current [A]"), ("voltage", "voltage [V]"))
    count = record["current"].shape[1]
    # By the current after the start, where all motors are busy; the same motors in both panels.
    settled = record.time >= style.settle_time(record)
    late = settled if settled.any() else slice(None)
    effort = np.sqrt((record["current"][late] ** 2).mean(axis=0))
    shown = np.arange(count) if count <= LARGEST else np.sort(np.argsort(effort)[::-1][:LARGEST])
    figure = style.new_figure(4.4, style.title(record, "motor currents and voltages"))
    rows = style.time_rows(
        figure, [[(record.time, record[name])] for name, _ in signals], style.settle_time(record), compress=True
    )
    looks = style.variant_styles(shown.tolist())
    for (name, label), panels in zip(signals, rows, strict=True):
        for axes in panels:
            _draw(axes, record, name, shown, looks)
        panels[0].set_ylabel(label)
    events.mark_all(rows, record)
    named = f"{LARGEST} largest by\nrms current" if count > LARGEST else None
    figure.legend(*rows[0][-1].get_legend_handles_labels(), loc="outside right center", title=named, title_fontsize=7.5)
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
