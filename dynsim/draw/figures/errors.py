"""Figure of the errors between measured and simulated runs, for `dynsim hw compare`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from dynsim.draw.figures import style
from dynsim.draw.figures.style import Array

# Number of joints drawn in colour where none are named: those with the largest rms errors.
STRONG = 4
FAINT: dict[str, Any] = {"color": "#CFCFCF", "linewidth": 0.7}
# On top and dashed, so that both are visible where they agree.
SIMULATED: dict[str, Any] = {"color": style.BLACK, "linewidth": 0.9, "linestyle": (0, (4, 3))}


@dataclass(frozen=True)
class Followed:
    """One quantity of several joints, simulated and measured, and its errors.

    Attributes
    ----------
    kind : plural noun, such as "joints"
    quantity, error : labels of the axes, with units
    scale : of the error's unit to that of the values
    names : of the joints
    rms : of their errors
    texts : about their errors
    values : (2, T, N), simulated and measured
    """

    kind: str
    quantity: str
    error: str
    scale: float
    names: list[str]
    rms: list[float]
    texts: list[str]
    values: Array


def draw_errors(title: str, time: Array, quantities: Sequence[Followed], named: Sequence[str], path: Path) -> Path:
    """Two panels for each quantity: values of some joints, measured over simulated, and the errors of all.

    Parameters
    ----------
    named : joints in colour, of any quantity; the ``STRONG`` worst of one of which none is named
    """
    with style.look():
        rows = [style.LEGEND_ROW / 72.0 * (3 + min(len(quantity.names), STRONG)) / 2 for quantity in quantities]
        figure = style.new_figure(sum(4.2 + row for row in rows), title)
        panels = figure.subplots(2 * len(quantities), 1, sharex=True)
        for quantity, (values, errors) in zip(quantities, panels.reshape(-1, 2), strict=True):
            _draw(values, errors, time, quantity, named)
        panels[-1].set_xlabel("record time [s]")
        return style.save(figure, path)


def _draw(values: Axes, errors: Axes, time: Array, quantity: Followed, named: Sequence[str]) -> None:
    ranking = sorted(range(len(quantity.names)), key=lambda k: -quantity.rms[k])
    chosen = [quantity.names.index(name) for name in dict.fromkeys(named) if name in quantity.names] or ranking[:STRONG]
    looks = style.variant_styles([quantity.names[k] for k in chosen])
    simulated, measured = quantity.values
    coloured = {
        k: {key: looks[quantity.names[k]][key] for key in ("color", "linestyle")} | {"linewidth": 1.2} for k in chosen
    }
    for k in chosen:
        style.line(values, time, measured[:, k], **coloured[k])
        style.line(values, time, simulated[:, k], **SIMULATED)
    for k in [k for k in reversed(ranking) if k not in chosen] + chosen:
        look = coloured[k] | {"label": quantity.texts[k]} if k in chosen else FAINT
        style.line(errors, time, quantity.scale * (measured[:, k] - simulated[:, k]), **look)
    if others := len(quantity.names) - len(chosen):
        errors.plot([], [], label=f"the other {others} {quantity.kind}", **FAINT)
    values.plot([], [], label="simulated (measured in colour)", **SIMULATED)
    style.legend_above(values)
    style.legend_above(errors, columns=2)
    values.set_ylabel(quantity.quantity)
    errors.axhline(0.0, color=style.GREY, linewidth=0.6)
    errors.set_ylabel(quantity.error)
