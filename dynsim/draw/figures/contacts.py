"""Figure of the normal contact forces over time, with pulling forces or contact modes marked.

Under the bilateral law a force may have either sign; the region below zero is shaded. Under the unilateral law bands
show the mode of each contact: open, sliding or sticking.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynsim.draw.figures import events, style
from dynsim.draw.figures.style import Array
from dynsim.record import Record
from dynsim.record.measures import percent

# Most rows on a page; height of a row [inch].
ROWS, ROW = 8, 1.75
# Most samples that are drawn as dots.
DOTS = 150
# Modes by their number: name, colour of the bands, and key of the summary with the share of time.
MODE = "contact_mode"
MODES = (
    ("open", "#EFEFEF", "closed_fraction"),
    ("slides", "#FCE3B0", "sliding_fraction"),
    ("sticks", "#BFE6D8", "sticking_fraction"),
)


def forces(record: Record) -> Figure | None:
    """Normal force of each contact; None without contacts, or if none ever touched."""
    return _forces({"": record}, style.title(record, "normal contact forces"))


def forces_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Normal force of each contact, all variants that have it over each other."""
    return _forces(records, style.comparison_title(list(records.values()), "normal contact forces"))


def _forces(records: Mapping[str, Record], title: str) -> Figure | None:
    """Rows of forces; of one run, which has no name, with the modes of its contacts or the time in which they pull."""
    runs, alone = list(records.values()), "" in records
    names = touching_names(runs)
    if not names:
        return None
    chosen = _most_interesting(names, runs)
    kind = "highest" if any(map(is_real, runs)) else "lowest"
    note = "" if len(chosen) == len(names) else f", {len(chosen)} of {len(names)} contacts ({kind} forces)"
    having = {name: {v: r for v, r in records.items() if _touched(r, name)} for name in chosen}
    # A legend has an entry for each variant and one for the shading.
    more = sum(-(-(len(having[name]) + 1) // 2) - 1 for name in chosen) * style.LEGEND_ROW / 72.0
    figure = style.new_figure(1.0 + ROW * len(chosen) + more, title + note)
    series = [[values for r in having[name].values() for values in _series(r, name)] for name in chosen]
    styles = style.variant_styles(list(records))
    rows = style.time_rows(figure, series, max(map(style.settle_time, runs)))
    for name, panels in zip(chosen, rows, strict=True):
        # What the panel of the beginning shows would be a heap of marks in the other one.
        begun = panels[0].get_xlim()[1] if len(panels) > 1 else -np.inf
        for axes in panels:
            for row, (variant, record) in enumerate(having[name].items()):
                force, colour = _force(record, name), str(styles[variant]["color"])
                label = f"{variant or name}: {_share(record, name)}{_within(record, name)}"
                style.line(axes, record.time, force, label=label, **styles[variant])
                for value in _extremes(record, name):
                    axes.axhline(value, color=colour, linestyle=(0, (5, 3)), linewidth=0.7)
                changes = events.marked(record, [name])
                events.mark(axes, [e for e in changes if axes is panels[0] or e.time > begun], colour, row=row)
                if alone and is_real(record):
                    _draw_modes(axes, record, name)
                elif alone:
                    fill: dict[str, Any] = {"color": style.PULLING, "alpha": 0.3, "linewidth": 0, "interpolate": True}
                    axes.fill_between(record.time, force, 0.0, where=force < 0.0, label="_pulling", **fill)
                if len(panels) > 1 and axes is panels[0]:
                    _draw_samples(axes, record, name, colour)
            if not all(map(is_real, having[name].values())):
                style.shade_below_zero(axes, "surface pulls")
        panels[0].set_ylabel(f"{name}\nfₙ [N]")
        style.legend_above(panels[-1], columns=4 if alone else 2)
    _note_sampling(rows, runs)
    events.explain(rows[-1][-1], [event for record in runs for event in events.marked(record, chosen)])
    return figure


def contact_names(records: Sequence[Record]) -> list[str]:
    """Names of all contacts, in the order in which they first appear."""
    names: dict[str, None] = {}
    for record in records:
        names.update(dict.fromkeys(record.labels.get("contact_normal_force", ())))
    return list(names)


def touching_names(records: Sequence[Record]) -> list[str]:
    """Those that touched: under the unilateral law many may, and most never do."""
    return [name for name in contact_names(records) if any(_touched(record, name) for record in records)]


def _touched(record: Record, name: str) -> bool:
    return name in contact_names([record]) and _summary(record, name).get("closed_fraction", 1.0) > 0.0


def is_real(record: Record) -> bool:
    """Whether its contacts follow the unilateral law."""
    return MODE in record


def _share(record: Record, name: str) -> str:
    state, key = ("closed", "closed_fraction") if is_real(record) else ("pulling", "pulling_fraction")
    contact = _summary(record, name)
    return f"{state} {percent(contact[key])} of the run" if contact else f"{state} unknown part"


def _within(record: Record, name: str) -> str:
    extremes = _extremes(record, name)
    return f"; all steps {style.number(extremes[0], 3)} … {style.number(extremes[1], 3)} N" if extremes.size else ""


def _extremes(record: Record, name: str) -> Array:
    """Lowest and highest force of all integration steps [N], which see peaks between the samples; empty if unknown."""
    contact = _summary(record, name)
    if not contact:
        return np.empty(0)
    values = np.array([contact["normal_force_min_N"], contact["normal_force_max_N"]], dtype=np.float64)
    return values if np.isfinite(values).all() else np.empty(0)


def _summary(record: Record, name: str) -> dict[str, Any]:
    """The contact's part of the summary: over all integration steps, not over the samples. Empty if there is none."""
    return next((contact for contact in record.summary.get("contacts", ()) if contact["name"] == name), {})


def _series(record: Record, name: str) -> list[style.Series]:
    """What must find room: the samples, and the extremes, which most often fall into the first milliseconds."""
    extremes = _extremes(record, name)
    return [(record.time, _force(record, name)), *([(record.time[[0, 0]], extremes)] if extremes.size else [])]


def _draw_samples(axes: Axes, record: Record, name: str, colour: str) -> None:
    """A dot at each sample of the transient, while they are few enough to be told apart."""
    inside = record.time <= axes.get_xlim()[1]
    if inside.sum() <= DOTS:
        axes.plot(record.time[inside], _force(record, name)[inside], ".", color=colour, markersize=2.5)


def _note_sampling(rows: Sequence[Sequence[Axes]], records: Sequence[Record]) -> None:
    """Under the last panel: how often the curves are sampled, and what the dashed lines are."""
    steps = [float(np.median(np.diff(record.time))) for record in records if len(record) > 1]
    if not steps:
        return
    note = f"sampled every {style.number(1e3 * max(steps), 3)} ms"
    if any(line.get_marker() == "." for panels in rows for line in panels[0].get_lines()):
        note += " (dots)"
    note += "; dashed: extremes of all steps"
    last = rows[-1][-1]
    last.set_xlabel(f"{last.get_xlabel()}\n{note}")


def _force(record: Record, name: str) -> Array:
    column = record.labels["contact_normal_force"].index(name)
    return np.asarray(record["contact_normal_force"][:, column], dtype=np.float64)


def _most_interesting(names: list[str], records: Sequence[Record]) -> list[str]:
    """All contacts, or ``ROWS`` of them, in their order: those that pull hardest, or if real press hardest."""
    if len(names) <= ROWS:
        return names
    real = any(map(is_real, records))

    def rank(name: str) -> float:
        values = [_force(r, name) for r in records if name in contact_names([r])]
        return -max(float(force.max()) for force in values) if real else min(float(force.min()) for force in values)

    chosen = sorted(names, key=rank)[:ROWS]
    return [name for name in names if name in chosen]


def mode_bands(record: Record, name: str) -> list[tuple[float, float, int]]:
    """Begin, end [s] and mode of each stretch of samples in one mode, cut at the contact's events if there are some."""
    mode = np.rint(record[MODE][:, record.labels[MODE].index(name)]).astype(int)
    changes = [event.time for event in events.marked(record, [name])]
    time, bands, since = record.time, [], float(record.time[0])
    for k in np.flatnonzero(np.diff(mode)):
        between = [t for t in changes if time[k] < t <= time[k + 1]]
        at = between[-1] if between else float(time[k + 1])
        bands.append((since, at, int(mode[k])))
        since = at
    return [*bands, (since, float(time[-1]), int(mode[-1]))]


def _draw_modes(axes: Axes, record: Record, name: str) -> None:
    """Bands behind the curve: when the contact is open, slides and sticks, with the share of the run in the legend."""
    bands, contact = mode_bands(record, name), _summary(record, name)
    limits = axes.get_xlim()
    for mode, (text, colour, key) in enumerate(MODES):
        spans = [(begin, end - begin) for begin, end, which in bands if which == mode]
        share = None if not contact else contact[key] if mode else 1.0 - contact[key]
        if not spans and not share:
            continue
        label = text if share is None else f"{text} {percent(share)}"
        axes.broken_barh(
            spans, (0.0, 1.0), transform=axes.get_xaxis_transform(), color=colour, linewidth=0, zorder=0.2, label=label
        )
    axes.set_xlim(limits)
