"""Figures of one record, or comparisons of several, written to a folder; single figures by name.

Matplotlib is loaded on the first drawing.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from dynsim.errors import DynsimError, RecordError, brief
from dynsim.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED, SIMULATED = "dynsim.draw.figures.measured", "dynsim.draw.figures.arm"
# Module with ``draw`` and ``draw_comparison``, and with ``figures`` and ``comparisons``, the makers by name → sets of
# signals. A module draws the records that have one of its sets; the first module that matches is used.
MODULES: dict[str, tuple[set[str], ...]] = {
    "dynsim.draw.figures.snake": ({"posture"}, {"base_pose", "mode"}, {"w", "w_target"}),
    MEASURED: ({"q_goal"}, {"record_time"}, {"torque_estimate"}),
    SIMULATED: ({"hand_position"}, {"current"}, {"energy_residual"}),
}


def draw(record: Record, folder: Path, kind: str = "png") -> list[Path]:
    """Draw every figure that the record has data for, as files of a kind: "png", "pdf" or "svg".

    Returns
    -------
    list of Path
        The files written; empty for a record without samples.

    Raises
    ------
    RecordError
        Nobody draws records of such signals, the record lacks what the figures need, or a file cannot be written.
    """
    if not len(record):
        return []
    with _drawable():
        return list(_module(record).draw(record, Path(folder), kind))


def draw_comparison(records: Mapping[str, Record], folder: Path, kind: str = "png") -> list[Path]:
    """Draw variants over each other, in the order of ``records``; those without samples are left out.

    Raises
    ------
    RecordError
        See :func:`draw`; or the records are of different kinds.
    """
    drawn = {name: record for name, record in records.items() if len(record)}
    # Measured runs too are drawn as simulated ones: what both have.
    arm = importlib.import_module(SIMULATED)
    modules = {arm if module.__name__ == MEASURED else module for module in map(_module, drawn.values())}
    if not modules:
        return []
    if len(modules) > 1:
        raise RecordError("records of different kinds cannot be drawn over each other")
    with _drawable():
        return list(modules.pop().draw_comparison(drawn, Path(folder), kind))


def figure(records: Record | Mapping[str, Record], name: str, *, title: bool = True) -> Figure:
    """Draw one figure of a record, or of variants over each other, as a matplotlib figure in dynsim's look.

    >>> dynsim.figure(record, "contact_forces", title=False).savefig("forces.pdf")

    Parameters
    ----------
    records : a record, or several by name
    name : of the file that ``dynsim plot`` writes, without its ending: "energy", "compare_energy", …
    title : with the heading above all panels; papers have a caption instead

    Raises
    ------
    RecordError
        No such figure, or the record has no data for it.
    """
    several = not isinstance(records, Record)
    if not several and not len(records):
        raise RecordError("the record has no samples")
    if several and not records:
        raise RecordError("no records to draw")
    module = _module(next(iter(records.values()))) if isinstance(records, Mapping) else _module(records)
    # Measured runs are compared by the figures of simulated ones.
    home = importlib.import_module(SIMULATED) if several and module.__name__ == MEASURED else module
    style = importlib.import_module("dynsim.draw.figures.style")
    with _drawable(), style.look():
        makers = home.comparisons(records) if several else home.figures(records)
        if name not in makers:
            kind = "several records" if several else "such a record"
            raise RecordError(f"no figure {brief(name)} of {kind}; figures: {', '.join(makers)}")
        drawn: Figure | None = makers[name](records)
    if drawn is None:
        raise RecordError(f"the record has no data for the figure {name!r}")
    if not title:
        drawn.suptitle("")
    return drawn


@contextmanager
def _drawable() -> Iterator[None]:
    """A record may come from anywhere: what it lacks is its fault, and said in a line."""
    try:
        yield
    except DynsimError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        text = " ".join(str(error).split())
        raise RecordError(f"the record cannot be drawn: {type(error).__name__}: {text}") from error


def _module(record: Record) -> ModuleType:
    for name, needed in MODULES.items():
        if any(signals <= set(record) for signals in needed):
            return importlib.import_module(name)
    raise RecordError(f"no figures for a record of these signals: {', '.join(record) or 'none'}")
