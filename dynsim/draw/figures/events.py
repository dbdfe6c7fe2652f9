"""Marks of events over time axes: landings, lift-offs, begin and end of slip, joint stops."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation

from dynsim.record import Record
from dynsim.record.content import Event

# Kind of event → mark of matplotlib, the same as a character, and words for it. Other kinds have figures of their own.
MARKS: dict[str, tuple[str, str, str]] = {
    "landing": ("v", "▼", "landing"),
    "lift_off": ("^", "▲", "lift-off"),
    "bounce": ("o", "●", "bounce"),
    "slip_start": (">", "▶", "slip starts"),
    "slip_stop": ("s", "■", "slip stops"),
    "stop_hit": ("P", "✚", "joint stop hit"),
    "stop_left": ("X", "✖", "joint stop left"),
    "chatter": ("*", "★", "chatter"),
}
COLOUR = "#555555"
# Most events that get vertical lines; more would hide the curves, and get marks only.
LINES = 40
# Distance of the marks from the upper edge, and between their rows [point].
BELOW, ROW = 4.0, 6.0
# Most characters in a line of the legend of marks, which fits under the narrowest panel.
WIDEST = 50


def marked(record: Record, names: Iterable[str] | None = None) -> list[Event]:
    """Events that are marked, of the contacts and joints named or of all."""
    chosen = None if names is None else set(names)
    return [event for event in record.events if event.kind in MARKS and (chosen is None or event.name in chosen)]


def mark(axes: Axes, events: Sequence[Event], colour: str = COLOUR, *, row: int = 0, lines: bool = True) -> None:
    """Draw events that lie within the axes: a faint line each and its mark, in a row from the upper edge down.

    Negative rows lie above the edge.
    """
    low, high = axes.get_xlim()
    inside = [event for event in events if low <= event.time <= high]
    down = ScaledTranslation(0.0, -(BELOW + ROW * row) / 72.0, axes.figure.dpi_scale_trans)
    transform = axes.get_xaxis_transform() + down
    look: dict[str, Any] = {"color": colour, "markersize": 3.2, "markeredgewidth": 0.0, "zorder": 6, "clip_on": False}
    for kind, (marker, _, _) in MARKS.items():
        times = [event.time for event in inside if event.kind == kind]
        if not times:
            continue
        axes.plot(times, [1.0] * len(times), marker, transform=transform, label="_event", **look)
        if lines and len(inside) <= LINES:
            for time in times:
                axes.axvline(time, color=colour, linewidth=0.5, alpha=0.35 if row >= 0 else 0.2, zorder=0.5)
    axes.set_xlim(low, high)


def mark_all(rows: Iterable[Sequence[Axes]], record: Record) -> None:
    """Mark all events of a run in every panel, and name the marks under the last one."""
    events = marked(record)
    if not events:
        return
    for panels in (rows := list(rows)):
        for axes in panels:
            mark(axes, events)
    explain(rows[-1][-1], events)


def height_of_variants(records: Mapping[str, Record]) -> float:
    """Room over a panel for the rows of :func:`mark_variants` [inch]."""
    return ROW * sum(bool(marked(record)) for record in records.values()) / 72.0


def mark_variants(
    rows: Iterable[Sequence[Axes]], records: Mapping[str, Record], colours: Mapping[str, str]
) -> list[Event]:
    """Mark the events of several runs over every panel, a row in its colour for each that has some; returns them.

    Inside they would lie on the curves of the other variants.
    """
    having = {name: events for name, record in records.items() if (events := marked(record))}
    everything = [event for events in having.values() for event in events]
    if not everything:
        return []
    for panels in rows:
        for axes in panels:
            for row, (name, events) in enumerate(having.items()):
                mark(axes, events, colours[name], row=-1 - row, lines=len(everything) <= LINES)
            # The empty title keeps the room.
            axes.set_title(" ", fontsize=1.0, y=1.0, pad=ROW * len(having))
    return everything


def explain(axes: Axes, events: Sequence[Event]) -> None:
    """Lines under the label of the time axis: each mark that is drawn, what it means, and how often."""
    count = Counter(event.kind for event in events)
    lines = [axes.get_xlabel()]
    for part in (f"{sign} {text} ({count[kind]})" for kind, (_, sign, text) in MARKS.items() if count[kind]):
        joined = f"{lines[-1]}   {part}"
        if len(lines) == 1 or len(joined) > WIDEST:
            lines.append(part)
        else:
            lines[-1] = joined
    if len(lines) > 1:
        axes.set_xlabel("\n".join(lines))
