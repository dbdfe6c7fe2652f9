"""Time axes with an inset: the whole run on one scale, its initial transient enlarged where no curve is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dynsim.draw.figures import style
from dynsim.draw.figures.style import TRANSIENT_ROOM, Series, Transient, transient_of

# Place of an inset in parts of its panel: left edge, width, height; the room that its labels take below and above.
LEFT, WIDE, HIGH = 0.47, 0.51, 0.50
UNDER, OVER = 0.16, 0.04
MARK = "#DDE6EE"
# What happens within this share of the run is not seen on its scale.
NARROW = 0.1


def inset_rows(figure: Figure, rows: Sequence[Sequence[Series]], settle: float) -> list[tuple[Axes, ...]]:
    """Axes for quantities over time, one row each, of one scale of time.

    A row whose transient would squeeze the settled rest (:func:`dynsim.draw.figures.style.transient_of`) is cut to the
    settled range; an inset shows the transient, and where it is taken from is shaded.

    Returns
    -------
    list of tuples of Axes
        For each row (inset, whole run) or (whole run,); draw everything in all of them.
    """
    end = max(float(time[-1]) for row in rows for time, _ in row)
    grid = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    if end > 0.0:
        grid[0].set_xlim(0.0, end)
    grid[-1].set_xlabel("time [s]")
    found: list[tuple[Axes, ...]] = []
    for row, axes in zip(rows, grid, strict=True):
        transient = transient_of(row, settle, end) or _first_only(row, settle, end)
        if transient is None:
            found.append((axes,))
            continue
        window = TRANSIENT_ROOM * transient.end
        low, high, bottom = _room(row, (transient.low, transient.high), end)
        axes.set_ylim(low, high)
        inset = axes.inset_axes((LEFT, bottom, WIDE, HIGH))
        inset.set_xlim(0.0, window)
        # It lies within the panel: the layout need not measure it.
        inset.set_in_layout(False)
        inset.tick_params(labelsize=6.5, pad=1.5)
        inset.spines[["top", "right"]].set_visible(True)
        for spine in inset.spines.values():
            spine.set_color(style.GREY)
        share = window / end
        axes.axvspan(0.0, window, color=MARK, linewidth=0, zorder=0.1)
        corners = [[(share, edge), (LEFT, bottom + edge * HIGH)] for edge in (0.0, 1.0)]
        axes.add_collection(
            LineCollection(corners, colors=style.GREY, linewidths=0.6, transform=axes.transAxes, zorder=4.9),
            autolim=False,
        )
        found.append((inset, axes))
    return found


def _first_only(row: Sequence[Series], settle: float, end: float) -> Transient | None:
    """Of what is zero once it has settled, the short time in which it is not, if that is too narrow to be seen."""
    last = largest = smallest = 0.0
    for time, values in row:
        some = np.isfinite(values) & (values != 0.0)
        if (some & (time >= settle)).any():
            return None
        if some.any():
            last = max(last, float(time[some][-1]))
            smallest, largest = min(smallest, float(values[some].min())), max(largest, float(values[some].max()))
    if not 0.0 < last < NARROW * end:
        return None
    room = 0.08 * (largest - smallest)
    return Transient(1.5 * last, smallest - room, largest + room, max(largest, -smallest))


def _room(row: Sequence[Series], limits: tuple[float, float], end: float) -> tuple[float, float, float]:
    """Limits of a panel, wider where no curve leaves room for an inset, and where the inset begins in parts of it."""
    low, high = limits
    needed = UNDER + HIGH + OVER
    bands = []
    for time, values in row:
        there = values[time >= (LEFT - 0.03) * end]
        there = there[np.isfinite(there)]
        if len(there):
            bands.append((float(there.min()), float(there.max())))
    gaps = _gaps(sorted(bands), low, high)
    widest = max(gaps, key=lambda gap: gap[1] - gap[0])
    if widest[1] - widest[0] >= needed * (high - low):
        middle = 0.5 * (widest[0] + widest[1] - (OVER - UNDER) * (high - low))
        return low, high, (middle - low) / (high - low) - 0.5 * HIGH
    first, last = min(bands)[0], max(one[1] for one in bands)
    if high - last >= first - low:
        high = max(high, low + (last - low) / (1.0 - needed))
        return low, high, 1.0 - OVER - HIGH
    low = min(low, high - (high - first) / (1.0 - needed))
    return low, high, UNDER


def _gaps(bands: Sequence[tuple[float, float]], low: float, high: float) -> list[tuple[float, float]]:
    """What the bands, in order, leave free between the limits."""
    found, reached = [], low
    for first, last in bands:
        found.append((reached, max(first, reached)))
        reached = max(reached, last)
    return [*found, (reached, max(high, reached))]
