"""The plot below the robots of a film: one signal over time, drawn once, with a moving cursor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from dynsim.draw.figures import style
from dynsim.errors import RecordError
from dynsim.record import TIME, Record
from dynsim.system.terminal import plain

# Signals shown by default: the first of them that the record, or one of several records, has.
ONE = ("contact_normal_force", "wheel_load", "hand_error", "support_margin", "position_error", "power", "q", "phi")
SEVERAL = ("energy_electrical", "hand_error", "position_error", "tip_margin", "support_margin", "q", "phi")
DPI = 100
CURSOR = "#202428"
# Number of columns of a signal with lines of their own: the largest ones. A band shows the range of all columns.
NAMED = 4
# Least width of a plot with a legend beside it [pixel], and most letters of a name in it.
LEGEND_MIN, LETTERS = 400, 16
# Height of one name in the legend [pixel]; names that do not fit are left out.
LEGEND_ROW = 14


class Strip:
    """A plot of one signal of all records over time, of a size [pixel].

    Parameters
    ----------
    signal : name, None for the first of a list that is there

    Raises
    ------
    RecordError
        No record has the signal, or it is no quantity over the record's time.
    """

    def __init__(self, records: Mapping[str, Record], size: tuple[int, int], signal: str | None = None) -> None:
        self._size = size
        self.signal = chosen(records, signal)
        self._image: Image.Image | None = None
        self.legend: tuple[str, ...] = ()
        if self.signal is not None:
            with style.look():
                self._draw(records, self.signal)

    def frame(self, time: float) -> Image.Image | None:
        """The plot with its cursor at an instant [s]; None where there is nothing to plot."""
        if self._image is None:
            return None
        image = self._image.copy()
        box = self._axes.get_window_extent()
        x, _ = self._axes.transData.transform((time, 0.0))
        ImageDraw.Draw(image).line([x, self._size[1] - box.y1, x, self._size[1] - box.y0], fill=CURSOR, width=2)
        return image

    def _draw(self, records: Mapping[str, Record], name: str) -> None:
        figure = Figure(figsize=(self._size[0] / DPI, self._size[1] / DPI), dpi=DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        colours, several = style.variant_styles(list(records)), len(records) > 1
        having = {label: record for label, record in records.items() if name in record}
        for label, record in having.items():
            values = record[name].reshape(len(record), -1)
            called = {} if record.scene is None else record.scene.wheel_names
            names = [called.get(text, text) for text in record.labels[name] or (name,) * values.shape[1]]
            many = values.shape[1] > 1
            shown = largest(values, 1 if several else NAMED)
            if len(shown) < values.shape[1]:
                colour, opacity = (colours[label]["color"], 0.2) if several else ("#CFCFCF", 1.0)
                low, high = np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)
                text = None if several else f"all {values.shape[1]}"
                axes.fill_between(record.time, low, high, color=colour, alpha=opacity, linewidth=0, label=text)
            for rank, k in enumerate(shown):
                colour = style.VARIANT_COLOURS[rank] if many and not several else colours[label]["color"]
                text = _cut(plain(label), LETTERS) if several else _cut(plain(names[k]), LETTERS)
                text += f": {_cut(plain(names[k]), LETTERS)}" if several and many else ""
                style.line(axes, record.time, values[:, k], color=colour, label=text)
        unit = next(iter(having.values())).units[name]
        title = f"{name.replace('_', ' ')}{f' [{unit}]' if unit not in ('', '1') else ''}"
        if several and any(record[name][0].size > 1 for record in having.values() if len(record)):
            title += ": largest by rms, and range of all"
        axes.set_title(title, fontsize=7.5, loc="left", pad=3)
        axes.set_xlabel("time [s]", fontsize=7, labelpad=0)
        axes.tick_params(labelsize=7)
        start = min(float(record.time[0]) for record in records.values())
        end = max(float(record.time[-1]) for record in records.values())
        axes.set_xlim(start, end if end > start else start + 1.0)
        axes.set_ylim(*_limits([record[name] for record in having.values()]))
        if several or len(axes.lines) > 1:
            handles, labels = axes.get_legend_handles_labels()
            # The range of all first: it lies behind the others.
            most = max((self._size[1] - 20) // LEGEND_ROW, 1)
            self.legend = tuple(labels[:most])
            look: dict[str, Any] = {"bbox_to_anchor": (1.0, 1.0), "fontsize": 6.5, "borderaxespad": 0.2}
            axes.legend(handles[:most], labels[:most], loc="upper left", **look)
        canvas.draw()
        self._image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        self._axes = axes


def largest(values: style.Array, count: int) -> list[int]:
    """Columns with the largest root mean square over time, at most so many, in their order; (T, n)."""
    effort = np.nan_to_num(values.astype(float) ** 2).sum(axis=0)
    return sorted(np.argsort(-effort, kind="stable")[:count].tolist())


def _cut(name: str, letters: int) -> str:
    return name if len(name) <= letters else name[: letters - 1] + "…"


def chosen(records: Mapping[str, Record], signal: str | None) -> str | None:
    """The signal to plot, see :class:`Strip`."""

    def plotted(name: str) -> bool:
        return any(
            name in r and r.signals[name].axis == TIME and r[name].ndim < 3 and r[name].size for r in records.values()
        )

    if signal is None:
        return next((name for name in (SEVERAL if len(records) > 1 else ONE) if plotted(name)), None)
    if not plotted(signal):
        names = sorted({name for record in records.values() for name in record if plotted(name)})
        raise RecordError(f"no signal {signal!r} over the record's time to plot; there are {', '.join(names)}")
    return signal


def _limits(values: list[style.Array]) -> tuple[float, float]:
    """Range of the axis: a spike at the start does not squeeze the rest."""
    pooled = np.concatenate([array.ravel() for array in values])
    pooled = pooled[np.isfinite(pooled)]
    if not len(pooled):
        return -1.0, 1.0
    low, high = float(pooled.min()), float(pooled.max())
    a, b = np.percentile(pooled, (1.0, 99.0)).tolist()
    if b > a and high - low > 4.0 * (b - a):
        low, high = max(low, a - 0.6 * (b - a)), min(high, b + 0.6 * (b - a))
    room = 0.06 * (high - low) or max(0.05 * abs(high), 1e-9)
    return low - room, high + room
