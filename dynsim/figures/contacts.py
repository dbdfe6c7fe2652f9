"""Normal forces of the contacts, with the region in which the surface would have to pull."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynsim import metrics
from dynsim.figures import style
from dynsim.figures.style import Array
from dynsim.record import Record

# More rows than this do not fit a page.
ROWS = 8


def forces(record: Record) -> Figure | None:
    """Normal force of each contact; None without contacts."""
    names = contact_names([record])
    if not names:
        return None
    chosen = _most_interesting(names, [record])
    note = "" if len(chosen) == len(names) else f", {len(chosen)} of {len(names)} contacts (lowest forces)"
    figure = style.new_figure(1.0 + 1.5 * len(chosen), style.title(record, f"normal contact forces{note}"))
    rows = style.time_rows(
        figure, [[(record.time, _force(record, name))] for name in chosen], style.settle_time(record)
    )
    for name, panels in zip(chosen, rows, strict=True):
        force = _force(record, name)
        for axes in panels:
            style.line(axes, record.time, force, color=style.BLUE, label=pulling_label(record, name))
            axes.fill_between(
                *_thin_negative(record.time, force), 0.0, color=style.PULLING, alpha=0.3, linewidth=0, label="_pulling"
            )
            _mark_pulling(axes)
        panels[0].set_ylabel(f"{name}\n$f_n$ [N]")
        style.legend_above(panels[-1])
    return figure


def forces_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Normal force of each contact, all variants that have it over each other."""
    names = contact_names(list(records.values()))
    if not names:
        return None
    chosen = _most_interesting(names, list(records.values()))
    having = {name: {v: r for v, r in records.items() if name in contact_names([r])} for name in chosen}
    title = style.comparison_title(list(records.values()), "normal contact forces")
    figure = style.new_figure(1.1 + 1.7 * len(chosen), title)
    series = [[(r.time, _force(r, name)) for r in having[name].values()] for name in chosen]
    settle = max(style.settle_time(record) for record in records.values())
    styles = style.variant_styles(list(records))
    for name, panels in zip(chosen, style.time_rows(figure, series, settle), strict=True):
        for axes in panels:
            for variant, record in having[name].items():
                label = f"{variant}: pulling {_percent(record, name)}"
                style.line(axes, record.time, _force(record, name), label=label, **styles[variant])
            _mark_pulling(axes)
        panels[0].set_ylabel(f"{name}\n$f_n$ [N]")
        style.legend_above(panels[-1], columns=2 if len(having[name]) > 2 else 3)
    return figure


def contact_names(records: Sequence[Record]) -> list[str]:
    """Names of all contacts, in the order in which they first appear."""
    found: dict[str, None] = {}
    for record in records:
        found.update(dict.fromkeys(record.labels.get("contact_normal_force", ())))
    return list(found)


def pulling_label(record: Record, name: str) -> str:
    """Share of the run in which the contact pulls, and the extremes of its force."""
    label = f"{name}: pulling {_percent(record, name)}"
    for contact in record.summary.get("contacts", ()):
        if contact["name"] == name:
            # Of all integration steps, which see peaks between the samples.
            low, high = contact["normal_force_min_N"], contact["normal_force_max_N"]
            label += f"; all steps within {style.number(low, 3)} … {style.number(high, 3)} N"
    return label


def _percent(record: Record, name: str) -> str:
    share = metrics.negative_fraction(_force(record, name), record.time)
    return f"{100.0 * share:.1f} % of the run"


def _force(record: Record, name: str) -> Array:
    column = record.labels["contact_normal_force"].index(name)
    return np.asarray(record["contact_normal_force"][:, column], dtype=np.float64)


def _most_interesting(names: list[str], records: Sequence[Record]) -> list[str]:
    """All contacts, or the ``ROWS`` with the lowest forces, in the order of ``names``."""
    if len(names) <= ROWS:
        return names
    lowest = {n: min(float(_force(r, n).min()) for r in records if n in contact_names([r])) for n in names}
    chosen = sorted(names, key=lowest.__getitem__)[:ROWS]
    return [name for name in names if name in chosen]


def _thin_negative(time: Array, force: Array) -> tuple[Array, Array]:
    """The line cut off at zero, with its zero crossings, so that the filled area ends where the line does."""
    time, force = style.thin(time, force)
    a, b = force[:-1], force[1:]
    crossing = np.flatnonzero(a * b < 0.0)
    at = time[crossing] + (time[crossing + 1] - time[crossing]) * a[crossing] / (a[crossing] - b[crossing])
    time, force = np.insert(time, crossing + 1, at), np.insert(force, crossing + 1, 0.0)
    return time, np.minimum(force, 0.0)


def _mark_pulling(axes: Axes) -> None:
    """Shade what lies below zero, if any of the axis does."""
    axes.axhline(0.0, color=style.PULLING, linewidth=0.8)
    low, high = axes.get_ylim()
    if low >= 0.0:
        return
    axes.axhspan(low, 0.0, color=style.PULLING, alpha=0.13, linewidth=0, label="surface pulls")
    axes.set_ylim(low, high)
