"""Faults in the layout of a figure that a reader sees at once: texts that leave the canvas or overlap other texts."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import Bbox

import dynsim
from dynsim.errors import SimulationStopped
from dynsim.record import Record
from dynsim.scenario import load_scenario

# Widths of a page and of a column [inch].
SIZES = (7.2, 3.4)
# Texts may touch by this much [point]: the box of a text is larger than its ink.
SLACK = 1.2
# Minimum distance of a text from the edge of the canvas [point].
EDGE = 1.0


def simulated(name: str, variant: str | None, changes: Mapping[str, Any]) -> Record | None:
    """Return the record of a run, which ends early if the run stops; None if the run stops at the start."""
    try:
        return dynsim.simulate(load_scenario(name, variant, changes))
    except SimulationStopped as stop:
        return stop.record


def faults(name: str, label: str, records: Record | Mapping[str, Record], size: float) -> list[str]:
    """Return the faults of a figure of a width [inch], with a label of its records."""
    figure = dynsim.figure(records, name, size=size)
    return [f"{name} of {label} at {size} in: {fault}" for fault in layout_faults(figure) + tick_faults(figure)]


def layout_faults(figure: Figure) -> list[str]:
    """Return texts at the edge of the canvas or beyond, pairs of texts that overlap, and the lack of a caption.

    Only texts that are really drawn count; invisible ticks and texts outside a clip path do not.
    """
    slack = SLACK * figure.dpi / 72.0
    canvas = figure.bbox.padded(-EDGE * figure.dpi / 72.0)
    faults = [] if getattr(figure, "caption", "") else ["the figure has no caption"]
    boxes = [(text, text.get_window_extent()) for text in _drawn_texts(figure)]
    faults = [
        f"{_name(text)} is at the edge of the canvas or beyond" for text, box in boxes if not _inside(box, canvas)
    ]
    for (first, a), (second, b) in itertools.combinations(boxes, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        along = min(a.y1, b.y1) - max(a.y0, b.y0)
        if across > slack and along > slack and not _apart(first, second, slack):
            faults.append(f"{_name(first)} overlaps {_name(second)}")
    return faults


def _drawn_texts(figure: Figure) -> list[Text]:
    """Draw the figure and return its texts in the order in which they were drawn."""
    seen: dict[int, Text] = {}
    original = Text.draw

    def draw(self: Text, renderer: object, *args: object, **options: object) -> None:
        if self.get_visible() and self.get_text().strip() and self.get_alpha() != 0.0:
            seen[id(self)] = self
        original(self, renderer, *args, **options)

    Text.draw = draw
    try:
        FigureCanvasAgg(figure).draw()
    finally:
        Text.draw = original
    return [text for text in seen.values() if _is_shown(text)]


def _is_shown(text: Text) -> bool:
    box = text.get_window_extent()
    if text.get_clip_on() and text.clipbox is not None:
        return bool(box.overlaps(text.clipbox))
    return box.width > 0.0


def _inside(box: Bbox, canvas: Bbox) -> bool:
    return bool(box.x0 >= canvas.x0 and box.x1 <= canvas.x1 and box.y0 >= canvas.y0 and box.y1 <= canvas.y1)


def _apart(first: Text, second: Text, slack: float) -> bool:
    """Return whether slanted texts are apart although their upright boxes overlap (separating axes)."""
    if not (first.get_rotation() % 90.0 or second.get_rotation() % 90.0):
        return False
    corners = [_corners(text) for text in (first, second)]
    for shape in corners:
        for k in range(2):
            edge = shape[k + 1] - shape[k]
            normal = np.array([-edge[1], edge[0]]) / (np.hypot(*edge) or 1.0)
            a, b = (points @ normal for points in corners)
            if min(a.max(), b.max()) - max(a.min(), b.min()) <= slack:
                return True
    return False


def _corners(text: Text):
    """Corners of a text's slanted box [pixel], (4, 2)."""
    angle = text.get_rotation()
    text.set_rotation(0.0)
    flat = text.get_window_extent()
    text.set_rotation(angle)
    upright = text.get_window_extent()
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    half = 0.5 * np.array(
        [[-flat.width, -flat.height], [flat.width, -flat.height], [flat.width, flat.height], [-flat.width, flat.height]]
    )
    middle = np.array([0.5 * (upright.x0 + upright.x1), 0.5 * (upright.y0 + upright.y1)])
    return middle + half @ np.array([[c, s], [-s, c]])


def _name(text: Text) -> str:
    return repr(" ".join(text.get_text().split())[:60])


# Minimum number of labelled ticks of an axis, and of an x or y axis shorter than LOW [inch]; minimum share of the axis
# between the first and the last label.
LABELS, FEW, LOW, COVERED = 3, 2, (1.1, 0.5), 0.55


def tick_faults(figure: Figure) -> list[str]:
    """Return linear axes of a drawn figure with few labels, or with labels that cover a small part of the axis."""
    faults = []
    for axes in (axes for axes in figure.axes if axes.axison and axes.get_visible() and axes.name == "rectilinear"):
        for which, axis in enumerate((axes.xaxis, axes.yaxis)):
            low, high = sorted(axis.get_view_interval())
            texts = [text for text in axis.get_majorticklabels() if text.get_text()]
            labelled = texts and axis.get_tick_params()[f"label{('bottom', 'left')[which]}"]
            at = [float(tick) for tick in axis.get_majorticklocs() if low <= tick <= high]
            if axis.get_scale() != "linear" or not labelled or isinstance(axis.get_major_locator(), FixedLocator):
                continue
            length = axes.bbox.size[which] / figure.dpi
            name = f"{axis.get_label_text() or which!r} of {_name(axes.yaxis.label)}"
            long = length >= LOW[which]
            if len(at) < (LABELS if long else FEW) or (long and at[-1] - at[0] < COVERED * (high - low)):
                faults.append(f"{name} ({length:.2f} in): labels {at} in {low:.4g} … {high:.4g}")
    return faults
