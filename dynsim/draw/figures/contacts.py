"""Figure of the normal contact forces over time, and marks of contact events on time axes.

Under the bilateral law, a force may have either sign; the region below zero is shaded. Under the unilateral law, bands
show the mode of each contact: open, sliding or sticking.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynsim.draw.figures import style
from dynsim.draw.figures.style import Array
from dynsim.record import Record
from dynsim.record.content import Event
from dynsim.record.measures import TIP_OVER, percent

# Kinds of events that are marked, as events of contacts and of joints. Other kinds have separate figures.
MARKS = {
    "landing": ("landing",),
    "lift_off": ("lift-off",),
    "bounce": ("bounce",),
    "slip_start": ("contact starts to slide", "joint starts to slide"),
    "slip_stop": ("contact starts to stick", "joint starts to stick"),
    "stop_hit": ("joint stop hit",),
    "stop_left": ("joint stop left",),
    "chatter": ("chatter",),
    TIP_OVER: ("tip margin falls below 0",),
}
_SHAPES = dict(zip((text for texts in MARKS.values() for text in texts), "v^o>Ds|PX*p", strict=True))
COLOUR = "#A6A6A6"
# Events that are closer than this fraction of the axis share a line or a mark; in a narrow figure, twice as much.
APART = 0.01
# Maximum number of lines in a panel; fraction of the axis that a line or band needs to be visible, and its group then.
LINES, VISIBLE, SEEN = 12, 8e-3, "seen"


def marked(record: Record, names: Iterable[str] | None = None) -> list[Event]:
    """Return the events to mark, for all contacts and joints or only for the named ones."""
    chosen = None if names is None else set(names)
    return [event for event in record.events if event.kind in MARKS and (chosen is None or event.name in chosen)]


def mark(axes: Axes, events: Sequence[Event]) -> None:
    """Draw a thin line behind the curves at the time of each event within the axes, unless there are many."""
    low, high = axes.get_xlim()
    times = _merged((event.time for event in events), (low, high))
    look: dict[str, Any] = {"colors": COLOUR, "linewidth": 0.6, "zorder": 0.5, "label": f"{style.UNLISTED}event"}
    if 0 < len(times) <= LINES:
        seen = SEEN if times[-1] > low + VISIBLE * (high - low) else None
        axes.vlines(times, 0.0, 1.0, transform=axes.get_xaxis_transform(), gid=seen, **look)
        axes.set_xlim(low, high)


def _merged(times: Iterable[float], limits: tuple[float, float]) -> list[float]:
    """Return the times within an axis, without those that cannot be distinguished from the one before."""
    (low, high), kept = limits, list[float]()
    for time in sorted(time for time in times if low <= time <= high):
        if not kept or time - kept[-1] >= APART * (1 + style.narrow()) * (high - low):
            kept.append(time)
    return kept


def mark_all(figure: style.Drawing, rows: Sequence[Sequence[Axes]], record: Record) -> None:
    """Mark the events of a run in every panel, and above the first one by kind, with a legend."""
    touching, kinds = set(contact_names([record])), dict[str, list[float]]()
    for event in marked(record):
        kinds.setdefault(MARKS[event.kind][0 if event.name in touching else -1], []).append(event.time)
    kinds = {text: kinds[text] for text in _SHAPES if text in kinds}
    for axes in (axes for panels in rows for axes in panels):
        mark(axes, marked(record))
    since = -np.inf
    for axes in rows[0]:
        # An event has a mark in one panel only: the panel of the transient, or else the panel of the whole run.
        shown = {text: [t for t in times if t > since] for text, times in kinds.items()}
        style.rug(axes, {_SHAPES[text]: _merged(times, axes.get_xlim()) for text, times in shown.items()})
        since = axes.get_xlim()[1]
    entries: dict[str, Any] = {}
    for (text, times), *marked_as in zip(kinds.items(), *map(style.rug_rows, rows[0]), strict=True):
        marks, drawn = marked_as[-1], sum(np.size(marks.get_xdata()) for marks in marked_as)
        fewer = f" in {drawn} mark{'s' * (drawn > 1)}" if drawn < len(times) else ""
        entries[f"{text} ({len(times)}{fewer})"] = marks
    figure.put_below({**entries, **_seen(rows)}, 4, last=True)


def _seen(rows: Sequence[Sequence[Axes]]) -> dict[str, Any]:
    """Return legend entries for the bands and lines that are visible."""
    parts = [part for panels in rows for axes in panels for part in axes.collections if part.get_gid() == SEEN]
    return {str(part.get_label()).removeprefix(style.UNLISTED): part for part in parts}


# Maximum number of rows on a page; height of a row, and of a figure [inch].
ROWS, ROW, PAGE = 4, 1.75, 7.8
# Maximum number of variants whose legend entries have numbers.
NUMBERED = 4
# Maximum number of samples that are drawn as dots.
DOTS = 150
# Share of the run below which a contact is closed only for an instant, and maximum number of such contacts in the note.
BRIEF, LISTED = 0.005, 5
# Colours of the bands for the modes, by number.
MODE = "contact_mode"
BANDS: dict[str, dict[str, Any]] = {
    "contact open": {"facecolor": "#F2F2F2"},
    "contact slides": {"facecolor": "#FDEBC8", "edgecolor": "#E8C98A", "hatch": "///"},
    "contact sticks": {"facecolor": "#A9DCCB"},
}


def forces(record: Record) -> Figure | None:
    """Draw the normal force of each contact; return None without contacts, or if no contact ever touched."""
    return _forces({"": record}, style.title(record, "normal contact forces"))


def forces_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw the normal force of each contact; variants that have the same contact are overlaid."""
    return _forces(records, style.comparison_title(list(records.values()), "normal contact forces"))


def _forces(records: Mapping[str, Record], title: str) -> Figure | None:
    """Draw rows of forces; for a single run (named ""), also contact modes, or the time during which surfaces pull."""
    runs, alone = list(records.values()), "" in records
    # Under the unilateral law most candidates never touch.
    touching = {(v, name): _touched(r, name) for v, r in records.items() for name in contact_names(runs)}
    # Contacts that are closed for an instant are in a note, unless all are.
    least = BRIEF if max(touching.values(), default=0.0) > BRIEF else 0.0
    names = [name for name in contact_names(runs) if any(touching[v, name] > least for v in records)]
    if not names:
        return None
    chosen = _most_interesting(names, runs)
    kind = "highest" if any(map(is_unilateral, runs)) else "lowest"
    note = "" if len(chosen) == len(names) else f", {len(chosen)} of {len(names)} contacts ({kind} forces)"
    having = {name: {v: r for v, r in records.items() if touching[v, name] > least} for name in chosen}
    labels = {
        (name, v): f"{v or name}: {_share(r, name)}{_modes(r, name) * alone}{_within(r, name)}"
        for name in chosen
        for v, r in having[name].items()
    }
    # Many variants share one legend below the panels; otherwise the legend of a row has its numbers, and the shading.
    many = max(map(len, having.values())) > NUMBERED
    texts = [[*(text for (own, _), text in labels.items() if own == name), "surface pulls"] for name in chosen]
    more = 0 if many else sum(style.fitted_legend(text, 2)[2] - 1 for text in texts)
    above = 1.0 + more * style.legend_row() / 72.0
    figure = style.new_figure(min(above + ROW * len(chosen), PAGE), title + note)
    series = [[values for r in having[name].values() for values in _series(r, name)] for name in chosen]
    styles, dashed = style.variant_styles(list(records)), False
    rows = style.time_rows(figure, series, max(run.settle_time for run in runs), zero=alone)
    for name, panels in zip(chosen, rows, strict=True):
        for axes in panels:
            for variant, record in having[name].items():
                force, colour = _force(record, name), str(styles[variant]["color"])
                label = variant if many else labels[name, variant]
                style.line(axes, record.time, force, label=label, **styles[variant])
                for value in _extremes(record, name) if alone else ():
                    low, high = (-np.inf, np.inf) if axes.get_autoscaley_on() else axes.get_ylim()
                    dashed = dashed or low < value < high
                    axes.axhline(value, color=colour, linestyle=(0, (5, 3)), linewidth=0.7)
                if alone:
                    mark(axes, marked(record, [name]))
                if alone and is_unilateral(record):
                    _draw_modes(axes, record, name)
                if alone and len(panels) > 1 and axes is panels[0]:
                    _draw_samples(axes, record, name, colour)
            if not all(map(is_unilateral, having[name].values())):
                style.shade_below_zero(axes, "surface pulls")
        style.label_row(panels, f"{name}\nnormal force [N]")
        if not many:
            style.legend_above(panels[-1], columns=2)
    _note_sampling(figure, rows, runs)
    brief = [_brief(records[v], name, v) for (v, name), share in touching.items() if 0.0 < share <= least]
    if brief:
        others = f" and {len(brief) - LISTED} more" * (len(brief) > LISTED)
        figure.note(f"Closed for an instant, not drawn: {'; '.join(brief[:LISTED])}{others}.")
    if not many:
        also = ", also as dashed lines" if dashed else ""
        figure.note(f"Legend: share of the run; range over all integration steps, with peaks between samples{also}.")
    if many:
        style.legend_below(figure, [panels[-1] for panels in rows], 5)
    seen = _seen(rows)
    figure.put_below({text: seen[text] for text in (*BANDS, "event") if text in seen}, 4)
    return figure


def contact_names(records: Sequence[Record]) -> list[str]:
    """Return the names of all contacts, in order of first occurrence."""
    names: dict[str, None] = {}
    for record in records:
        names.update(dict.fromkeys(record.labels.get("contact_normal_force", ())))
    return list(names)


def _touched(record: Record, name: str) -> float:
    """Return the share of the run during which a contact is closed, 1 under the bilateral law."""
    return float(_summary(record, name).get("closed_fraction", 1.0)) if name in contact_names([record]) else 0.0


def _brief(record: Record, name: str, variant: str) -> str:
    """Describe a contact that was closed for an instant."""
    lasts, of = 1e3 * _touched(record, name) * float(record.time[-1]), f" of {variant}" if variant else ""
    return f"{name}{of} ({style.number(lasts, 2)} ms, up to {style.number(float(_extremes(record, name).max()), 3)} N)"


def is_unilateral(record: Record) -> bool:
    """Return whether the contacts of a record follow the unilateral law."""
    return MODE in record


def _share(record: Record, name: str) -> str:
    state, key = ("closed", "closed_fraction") if is_unilateral(record) else ("pulling", "pulling_fraction")
    contact = _summary(record, name)
    return f"{state} {percent(contact[key])}" if contact else f"{state} for an unknown time"


def _modes(record: Record, name: str) -> str:
    contact = _summary(record, name)
    if not contact or not is_unilateral(record):
        return ""
    return f" (slides {percent(contact['sliding_fraction'])}, sticks {percent(contact['sticking_fraction'])})"


def _within(record: Record, name: str) -> str:
    extremes = _extremes(record, name)
    scale = float(np.abs(extremes).max(initial=0.0))
    low, high = (style.number(value, 3, scale) for value in extremes) if extremes.size else ("", "")
    return f", {low} … {high} N" if extremes.size else ""


def _extremes(record: Record, name: str) -> Array:
    """Return the minimum and maximum force over all integration steps [N], or an empty array if unknown.

    These values include peaks between samples.
    """
    contact = _summary(record, name)
    if not contact:
        return np.empty(0)
    values = np.array([contact["normal_force_min_N"], contact["normal_force_max_N"]], dtype=np.float64)
    return values if np.isfinite(values).all() else np.empty(0)


def _summary(record: Record, name: str) -> dict[str, Any]:
    """Return the summary of a contact, which covers all integration steps; empty if it is missing."""
    return next((contact for contact in record.summary.get("contacts", ()) if contact["name"] == name), {})


def _series(record: Record, name: str) -> list[style.Series]:
    """Return the series that determine the axis range: samples and extremes, which mostly occur at the start."""
    extremes = _extremes(record, name)
    return [(record.time, _force(record, name)), *([(record.time[[0, 0]], extremes)] if extremes.size else [])]


def _draw_samples(axes: Axes, record: Record, name: str, colour: str) -> None:
    """Draw a dot at each sample of the transient, if there are few enough samples to distinguish them."""
    inside = record.time <= axes.get_xlim()[1]
    if inside.sum() <= DOTS:
        axes.plot(record.time[inside], _force(record, name)[inside], ".", color=colour, markersize=2.5)


def _note_sampling(figure: style.Drawing, rows: Sequence[Sequence[Axes]], records: Sequence[Record]) -> None:
    """Add a note about the sampling interval."""
    steps = [float(np.median(np.diff(record.time))) for record in records if len(record) > 1]
    if steps:
        dots = any(line.get_marker() == "." for panels in rows for line in panels[0].get_lines())
        figure.note(f"Sampled every {style.number(1e3 * max(steps), 3)} ms{' (dots)' * dots}.")


def _force(record: Record, name: str) -> Array:
    column = record.labels["contact_normal_force"].index(name)
    return np.asarray(record["contact_normal_force"][:, column], dtype=np.float64)


def _most_interesting(names: list[str], records: Sequence[Record]) -> list[str]:
    """Return all contacts, or the ``ROWS`` contacts with the lowest forces (unilateral law: highest), in order."""
    if len(names) <= ROWS:
        return names
    unilateral = any(map(is_unilateral, records))

    def rank(name: str) -> float:
        values = [_force(r, name) for r in records if name in contact_names([r])]
        return (
            -max(float(force.max()) for force in values) if unilateral else min(float(force.min()) for force in values)
        )

    chosen = sorted(names, key=rank)[:ROWS]
    return [name for name in names if name in chosen]


def mode_bands(record: Record, name: str) -> list[tuple[float, float, int]]:
    """Return the begin, end [s] and mode of each interval in one mode, bounded by events of the contact, if any."""
    mode = np.rint(record[MODE][:, record.labels[MODE].index(name)]).astype(int)
    changes = [event.time for event in marked(record, [name])]
    time, bands, since = record.time, [], float(record.time[0])
    for k in np.flatnonzero(np.diff(mode)):
        between = [t for t in changes if time[k] < t <= time[k + 1]]
        at = between[-1] if between else float(time[k + 1])
        bands.append((since, at, int(mode[k])))
        since = at
    return [*bands, (since, float(time[-1]), int(mode[-1]))]


def _draw_modes(axes: Axes, record: Record, name: str) -> None:
    """Draw bands behind the curve for open, sliding and sticking."""
    bands, limits = mode_bands(record, name), axes.get_xlim()
    look: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "linewidth": 0, "zorder": 0.2}
    for mode, (text, shading) in enumerate(BANDS.items()):
        spans = [(begin, end - begin) for begin, end, which in bands if which == mode]
        widths = [min(begin + width, limits[1]) - begin for begin, width in spans]
        look["gid"] = SEEN if max(widths, default=0.0) > VISIBLE * (limits[1] - limits[0]) else None
        if spans:
            axes.broken_barh(spans, (0.0, 1.0), label=f"{style.UNLISTED}{text}", **shading, **look)
    axes.set_xlim(limits)
