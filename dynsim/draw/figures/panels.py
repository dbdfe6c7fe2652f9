"""Panels of a figure: their names, and a grid of only some of them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.lines import Line2D

from dynsim.errors import RecordError, brief


def named(figure: Figure) -> dict[str, list[Axes]]:
    """Return the axes of each panel by name; axes without a name belong to the panel on their left.

    The name is the label of the axes, or the first words of their title, or the vertical quantity without its unit.
    """
    panels: dict[str, list[Axes]] = {}
    row: dict[int, str] = {}
    for axes in filter(Axes.get_subplotspec, figure.axes):  # without colour bars
        first = row_of(axes)
        if name := _name(axes) or (row.get(first, "") if axes.axison else ""):
            panels.setdefault(name, []).append(axes)
            row[first] = name
    return panels


def _name(axes: Axes) -> str:
    title = f"{axes.get_title()}{axes.get_title('left')}".strip()
    x, y = (_words(axis.get_label_text()) for axis in (axes.xaxis, axes.yaxis))
    over = f"{y} over {x}" if y and x and not x.startswith("time") else y
    alone = "" if _cell(axes).colspan.start else x
    return str(axes.get_label()) or re.split("[,;:]", title)[0] or over or alone


def _words(label: str) -> str:
    """Return a label in one line, without its unit; of a symbol that has a name, only the name remains."""
    text = re.sub(r"\[.*?\]", "", label)
    return " ".join((re.sub(r"\$.*?\$", "", text).strip() or text.replace("$", "")).split())


def chosen(figures: Mapping[str, Figure], wanted: Sequence[str]) -> dict[str, list[Axes]]:
    """Return the wanted panels of each figure that has any of them; parts of names suffice if they are not names.

    Raises
    ------
    RecordError
        If no figure has a panel of a wanted name.
    """
    panels = {name: named(figure) for name, figure in figures.items()}
    every = {panel for names in panels.values() for panel in names}
    selected: set[str] = set()
    for part in wanted:
        equal = {panel for panel in every if panel.casefold() == part.casefold()}
        matching = equal or {panel for panel in every if part.casefold() in panel.casefold()}
        if not matching:
            lists = "; ".join(f"{name}: {', '.join(names)}" for name, names in panels.items())
            raise RecordError(f"panel {brief(part)}: not found; panels by figure: {lists}")
        selected |= matching
    kept = {
        name: [axes for panel, group in names.items() if panel in selected for axes in group]
        for name, names in panels.items()
    }
    return {name: axes for name, axes in kept.items() if axes}


def regrid(figure: Figure, kept: Sequence[Axes]) -> None:
    """Remove all axes but ``kept`` and close the gaps; axes that are now at an edge get the labels of their column."""
    cells = [_cell(axes) for axes in kept]
    old = cells[0].get_gridspec()
    rows, columns = _used([cell.rowspan for cell in cells]), _used([cell.colspan for cell in cells])
    heights: Any = old.get_height_ratios()
    widths: Any = old.get_width_ratios()
    ratios: Any = {"height_ratios": [heights[k] for k in rows], "width_ratios": [widths[k] for k in columns]}
    grid = GridSpec(len(rows), len(columns), figure, **ratios)
    for axes, cell in zip(kept, cells, strict=True):
        down, across = _within(rows, cell.rowspan), _within(columns, cell.colspan)
        if down.stop == len(rows):
            _show_label(axes, "x", "labelbottom")
        if across.start == 0:
            _show_label(axes, "y", "labelleft")
        axes.set_subplotspec(grid[down, across])
    aligned: Any = figure
    for axes in [axes for axes in figure.axes if axes not in kept]:
        for group in aligned._align_label_groups.values():
            group.remove(axes)  # matplotlib would use the removed axes when it aligns labels
        axes.remove()


def row_of(axes: Axes) -> int:
    """Return the first row of axes in the grid of its figure."""
    return _cell(axes).rowspan.start


def _cell(axes: Axes) -> SubplotSpec:
    cell = axes.get_subplotspec()
    assert cell is not None
    return cell


def _used(spans: Sequence[range]) -> list[int]:
    """Return the rows, or columns, that separate the spans; each of the others has no span that these lack."""
    users = {k: {i for i, span in enumerate(spans) if k in span} for span in spans for k in span}
    used: list[int] = []
    for k in sorted(users, key=lambda k: (-len(users[k]), k)):
        if not any(users[k] <= users[other] for other in used):
            used.append(k)
    return sorted(used)


def _within(lines: Sequence[int], span: range) -> slice:
    inside = [k for k, line in enumerate(lines) if line in span]
    return slice(inside[0], inside[-1] + 1)


def _show_label(axes: Axes, which: Literal["x", "y"], numbers: str) -> None:
    """Label an axis that so far shared the label and numbers of another panel."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = [label for other in siblings if (label := getattr(other, f"get_{which}label")())]
    if len(siblings) > 1:
        axes.tick_params(axis=which, **{numbers: True})
        axes.set(**{f"{which}label": getattr(axes, f"get_{which}label")() or next(iter(labels), "")})


def explained(entries: Mapping[str, Any], kept: Iterable[Axes]) -> dict[str, Any]:
    """Return the entries of a legend (handles by label) that look like an artist of the ``kept`` axes."""
    looks = {_look(artist) for axes in kept for artist in (*axes.lines, *axes.patches, *axes.collections)}
    return {label: handle for label, handle in entries.items() if _look(handle) in looks}


def _look(artist: Any) -> tuple[Any, ...]:
    artist = next(iter(getattr(artist, "patches", ())), artist)
    if isinstance(artist, Line2D) and artist.get_linestyle() == "None":
        return (artist.get_marker(),)
    if isinstance(artist, Line2D):
        return to_hex(artist.get_color()), artist.get_linestyle(), artist.get_marker()
    for colours in (artist.get_facecolor(), artist.get_edgecolor()):
        if len(rows := to_rgba_array(colours)):
            return (to_hex(rows[0]),)
    return ()
