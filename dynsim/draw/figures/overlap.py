"""Curves that lie on each other in the final picture: the lower ones become wider, and notes name them."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from numpy.typing import NDArray

from dynsim.draw.figures.panels import named, row_of

Mask = NDArray[np.bool_]
PATHS, KINDS = "paths", ("coincide", "nearly coincide")
# Resolution of the pictures that are compared [1/inch]; curves coincide if they are closer than this [point], except in
# a part of the picture that is invisible.
DPI, CLOSE, INVISIBLE = 150.0, 1.25, 0.006
# Curves nearly coincide if they are apart in at most this part of the picture. Notes contain an interval of times that
# is not longer than this part of the axis.
APART, LONG = 0.2, 0.3
# A curve is wider by STEP for each curve that hides it, at most by STEPS times as much [point]. A curve that is wider
# by the factor WIDER anyway is visible on both sides of the other.
STEP, STEPS, WIDER = 0.5, 3, 2.5


def separate(figure: Figure) -> list[str]:
    """Widen curves that others hide, and return notes on the curves that a reader cannot distinguish.

    The figure has a layout.
    """
    lines = [line for axes in figure.axes for line in axes.get_lines()]
    known = {_look(line): _name(line) for line in reversed(lines) if _name(line)}
    names = {line: _name(line) or known.get(_look(line), "") for line in lines}
    panels: dict[tuple[str, int], list[tuple[Axes, dict[str, list[Line2D]]]]] = {}
    for panel, axes in [(panel, axes) for panel, group in named(figure).items() for axes in group]:
        if len(curves := _curves(axes, names)) > 1:
            # Paths coincide if they do so in all planes.
            key = (panel, row_of(axes)) if axes.get_aspect() == "auto" else (PATHS, 0)
            panels.setdefault(key, []).append((axes, curves))
    if not panels:
        return []
    dpi, widths, notes = figure.dpi, dict[str, float](), dict[str, list[str]]()
    figure.set_dpi(DPI)
    for (panel, _), group in panels.items():
        parts = [_apart(*shown) for shown in group]
        (axes, curves), apart = group[-1], parts[-1]
        worst = {pair: max(part[p][0] for part in parts for p in (pair, pair[::-1]) if p in part) for pair in apart}
        near = [pair for pair in apart if (worst[pair] if panel == PATHS else apart[pair][0]) <= APART]
        begun = {} if panel == PATHS else {pair: _until(axes, *apart[pair][1:]) for pair in apart.keys() - {*near}}
        early = {pair: until for pair, until in sorted(begun.items()) if until and not pair[1].startswith("target")}
        for name, (line, *_) in curves.items():
            wide = line.get_linewidth() + STEP * min(sum(lower == name for lower, _ in [*near, *early]), STEPS)
            widths[name] = max(wide, widths.get(name, 0.0))
        # Deviations from a target, which is a thin line above the curve, are visible.
        near = [(a, b) for a, b in near if not (worst[a, b] and b.startswith("target"))]
        for same in _joined(near):
            own = [pair for pair in near if pair[0] in same]
            nearly, off = any(worst[pair] for pair in own), np.any([apart[pair][1] for pair in own], axis=0)
            where = f" except {_times(axes, off)}" if nearly and panel != PATHS else ""
            notes.setdefault(f"{'nearly ' * nearly}coincide: {listed(same)}{where}", []).append(panel)
        for until in dict.fromkeys(early.values()):
            for same in _joined(pair for pair in early if early[pair] == until):
                notes.setdefault(f"coincide: {listed(same)} until {until}", []).append(panel)
    figure.set_dpi(dpi)
    for legend in [*figure.legends, *filter(None, (axes.get_legend() for axes in figure.axes))]:
        handles: Any = legend.legend_handles
        names |= {handle: _name(text) for handle, text in zip(handles, legend.get_texts(), strict=True)}
    for line, name in names.items():
        if name in widths and isinstance(line, Line2D):
            line.set_linewidth(widths[name])
    every = {panel for panel, _ in panels}
    texts = [text + f" ({', '.join(dict.fromkeys(own))})" * (every != {*own}) for text, own in notes.items()]
    kinds = {kind: [text.partition(": ")[2] for text in texts if text.startswith(kind)] for kind in KINDS}
    return [f"Curves that {kind}: {'; '.join(own)}." for kind, own in kinds.items() if own]


def _apart(axes: Axes, curves: Mapping[str, Sequence[Line2D]]) -> dict[tuple[str, str], tuple[float, Mask, Mask]]:
    """Return for each pair of a lower and an upper curve at which part and columns of the picture they are apart.

    The last columns are those in which the curves differ at all. Without a time axis, the part is that of the length
    of the curves.
    """
    thin, thick = ({k: _picture(axes, lines, w) for k, lines in curves.items()} for w in (72.0 / DPI, 2.0 * CLOSE))
    # Curves that cover more of the picture are below the others.
    order = sorted(curves, key=lambda k: (int(curves[k][0].get_zorder()), -round(math.log2(thin[k].sum() or 1.0))))
    for level, line in [(level, line) for level, k in enumerate(order) for line in curves[k]]:
        line.set_zorder(int(line.get_zorder()) + 1e-3 * level)
    in_order = {k for k, lines in curves.items() if all((np.diff(line.get_xdata()) >= 0.0).all() for line in lines)}
    apart: dict[tuple[str, str], tuple[float, Mask, Mask]] = {}
    for lower, upper in combinations([k for k in order if thin[k].any()], 2):
        if curves[lower][0].get_linewidth() < WIDER * curves[upper][0].get_linewidth():
            drawn, off = thin[lower] | thin[upper], thin[lower] & ~thick[upper] | thin[upper] & ~thick[lower]
            columns, over_time = np.any(off, axis=0), {lower, upper} <= in_order
            share = columns.sum() / drawn.any(axis=0).sum() if over_time else off.sum() / drawn.sum()
            differ = np.any(thin[lower] ^ thin[upper], axis=0)
            apart[lower, upper] = float(share) if share > INVISIBLE else 0.0, columns, differ
    return apart


def _times(axes: Axes, off: Mask) -> str:
    """Return the times at which curves are apart, in words, from the columns of the picture."""
    if not len(columns := np.flatnonzero(off)):
        return "at the start"
    (low, high), ends = axes.get_xlim(), np.array([columns[0], columns[-1] + 1]) / len(off)
    if np.ptp(ends) > LONG:
        return "for short times"
    digits = max(2 - math.ceil(math.log10(high - low)), 0)
    begin, end = (f"{low + share * (high - low):.{digits}f}" for share in ends)
    unit = next(iter(re.findall(r" \[\w+", _across(axes))), "").replace("[", "")
    return f"{begin}–{end}{unit}" if begin != end else f"near {end}{unit}"


def _across(axes: Axes) -> str:
    """Return the labels of the horizontal axes of a column of panels."""
    return "".join(other.get_xlabel() for other in axes.get_shared_x_axes().get_siblings(axes))


def _until(axes: Axes, off: Mask, differ: Mask) -> str:
    """Return the time until which curves over time coincide, in words; "" for a short time."""
    first = int(np.argmax(off))
    if first < LONG * len(off) or differ[:first].mean() > APART or "time" not in _across(axes):
        return ""
    return _times(axes, np.arange(len(off)) == first).removeprefix("near ").rpartition("–")[2]


def _joined(pairs: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Return the names of pairs in groups; pairs with a name in common belong to the same group."""
    groups: list[list[str]] = []
    for a, b in pairs:
        own = [group for group in groups if a in group or b in group]
        groups = [group for group in groups if group not in own] + [list(dict.fromkeys([*chain(*own), a, b]))]
    return groups


def listed(names: Sequence[str]) -> str:
    """Return names in words; at least three names with consecutive numbers are a range."""
    parts: list[list[str]] = []
    for name in names:
        if parts and re.sub(r"\d+(?=\D*$)", lambda match: str(int(match[0]) + 1), parts[-1][-1]) == name:
            parts[-1].append(name)
        else:
            parts.append([name])
    texts = [text for part in parts for text in ([f"{part[0]}–{part[-1]}"] if len(part) > 2 else part)]
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def _name(artist: Line2D | Text) -> str:
    """Return the label of a curve without its numbers, or "" for a curve without a label."""
    label = artist.get_text() if isinstance(artist, Text) else str(artist.get_label())
    return "" if label.startswith("_") else " ".join(re.split(": |, at most | rms ", label)[0].split())


def _look(line: Line2D) -> tuple[Any, ...]:
    return to_hex(line.get_color()), str(vars(line)["_unscaled_dash_pattern"])


def _curves(axes: Axes, names: Mapping[Line2D, str]) -> dict[str, list[Line2D]]:
    """Return the curves of axes by name, from the lowest to the uppermost; a curve may have several parts."""
    curves: dict[str, list[Line2D]] = {}
    if axes.get_aspect() != "auto" and (axes.patches or axes.collections):
        return {}  # a posture
    for line in sorted(axes.get_lines(), key=Line2D.get_zorder):
        drawn = line.get_visible() and line.get_linestyle() != "None" and line.get_transform() == axes.transData
        if drawn and names[line] and np.size(line.get_xdata()) > 1:
            curves.setdefault(names[line], []).append(line)
    return curves


def _picture(axes: Axes, lines: Sequence[Line2D], points: float) -> Mask:
    """Return the pixels of the axes that solid lines of a width [point] cover."""
    left, low, right, top = np.round(axes.get_window_extent().extents).astype(int)
    renderer = RendererAgg(right + 1, top + 1, DPI)
    for line in lines:
        drawn = copy.copy(line)
        drawn.set(linestyle="-", marker="", linewidth=points, alpha=None, antialiased=False)
        drawn.draw(renderer)
    return np.asarray(renderer.buffer_rgba())[1 : top - low + 1, left:, 3] > 0
