"""Figures of one record and comparisons of several records, written to a folder or returned one at a time.

Matplotlib is loaded when the first figure is drawn.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from dynsim.draw.figures.look import Look
from dynsim.errors import DynsimError, RecordError, brief
from dynsim.record import Record
from dynsim.system.arguments import names_wrong_types

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED, SIMULATED = "dynsim.draw.figures.measured", "dynsim.draw.figures.arm"
# Modules that draw figures, with the sets of signals that they need. A module has ``draw`` and ``draw_comparison``, and
# ``figures`` and ``comparisons``, which return a mapping of drawing functions. A module can draw records that have all
# signals of one of its sets; the first module that matches is used.
MODULES: dict[str, tuple[set[str], ...]] = {
    "dynsim.draw.figures.snake": ({"posture"}, {"base_pose", "mode"}, {"w", "w_target"}),
    MEASURED: ({"q_goal"}, {"record_time"}, {"torque_estimate"}),
    SIMULATED: ({"hand_position"}, {"current"}, {"energy_residual"}),
}
# Legend entry of a record whose name is blank.
UNNAMED = "(no name)"


def draw(record: Record, folder: Path, kind: str = "png", look: Look | None = None) -> list[Path]:
    """Draw every figure for which the record has data.

    Parameters
    ----------
    record : Record
        Record to draw.
    folder : Path
        Output folder.
    kind : {"png", "pdf", "svg"}, optional
        File format.
    look : Look, optional
        Size, font and style; default: for a page.

    Returns
    -------
    list of Path
        The written files; empty for a record without samples.

    Raises
    ------
    RecordError
        If no module draws records with these signals, the record lacks data, or a file cannot be written.
    """
    if not len(record):
        return []
    style = importlib.import_module("dynsim.draw.figures.style")
    with _drawable(), style.look(look):
        return list(_module(record).draw(record, Path(folder), kind))


def draw_comparison(
    records: Mapping[str, Record], folder: Path, kind: str = "png", look: Look | None = None
) -> list[Path]:
    """Overlay variants in the order of ``records``; records without samples are skipped.

    Parameters
    ----------
    records : mapping of str to Record
        Names and records.
    folder : Path
        Output folder.
    kind : {"png", "pdf", "svg"}, optional
        File format.
    look : Look, optional
        Size, font and style; default: for a page.

    Returns
    -------
    list of Path
        The written files.

    Raises
    ------
    RecordError
        In the same cases as for :func:`draw`, and if the records are of different kinds.
    """
    drawn = {name: record for name, record in _with_names(records).items() if len(record)}
    # In a comparison, measured runs are drawn in the same way as simulated runs, which have the same signals.
    arm = importlib.import_module(SIMULATED)
    own = [_module(record, name) for name, record in drawn.items()]
    modules = {arm if module.__name__ == MEASURED else module for module in own}
    if not modules:
        return []
    if len(modules) > 1:
        raise RecordError("cannot overlay records of different kinds")
    style = importlib.import_module("dynsim.draw.figures.style")
    with _drawable(), style.look(look):
        return list(modules.pop().draw_comparison(drawn, Path(folder), kind))


@names_wrong_types
def figure(
    records: Record | Mapping[str, Record],
    name: str,
    *,
    title: bool = True,
    caption: bool = True,
    size: float | tuple[float, float] | str | None = None,
    font: float | str | None = None,
    style: str | Path | Sequence[str | Path] | None = None,
    panels: str | Sequence[str] | None = None,
) -> Figure:
    """Draw one figure of a record, or of several overlaid records, and return the matplotlib Figure.

    Parameters
    ----------
    records : Record or mapping of str to Record
        A record, or a mapping of names to records.
    name : str
        File name without suffix of a figure that ``dynsim plot`` writes: "energy", "compare_energy", …
    title : bool, optional
        Whether the figure has a title; use False for figures with a caption.
    caption : bool, optional
        Whether notes are drawn below the axes; the attribute ``caption`` of the figure describes the figure and
        has their text in any case.
    size : float, tuple of float or str, optional
        Width, or width and height [inch], such as 3.4, (3.4, 2.4) or "86mm". Default: 7.2 inches, and the height that
        the contents require. Figures below 5 inches have their panels below each other.
    font : float or str, optional
        Size of the letters [point], a font family, or both: 8, "serif", "serif 8". Default: 8.5 points.
    style : str, Path or sequence of them, optional
        Names or files of matplotlib style sheets.
    panels : str or sequence of str, optional
        Names of the panels to draw, or parts of them, such as "distance" or ["electrical energy", "work"]; the error
        for an unknown name lists the panels. The figure is lower without the others. Default: all panels.

    Returns
    -------
    matplotlib.figure.Figure
        The figure; its ``savefig`` writes a file.

    Raises
    ------
    RecordError
        If no figure has this name, the record has no data for it, it has no such panel, or size, font or style cannot
        be used.

    Notes
    -----
    Settings in ``matplotlib.rcParams`` that differ from matplotlib's defaults remain, such as ``font.family``, except
    ``text.usetex``: names are drawn literally, without LaTeX.

    Several threads may call this function; the calls are executed one after the other, because ``rcParams`` belong to
    the process. Meanwhile, no other thread may change ``rcParams`` or draw with matplotlib directly.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows", overrides={"duration_s": 0.1})
    >>> record = dynsim.simulate(scenario)
    >>> drawing = dynsim.figure(record, "contact_forces", title=False, size=3.4, font="serif 8")
    >>> drawing.savefig("forces.pdf")  # doctest: +SKIP
    """
    several = not isinstance(records, Record)
    if not several and not len(records):
        raise RecordError("the record has no samples")
    if several and not records:
        raise RecordError("no records to draw")
    if isinstance(records, Mapping):
        records = _with_names(records)
    module = _module(next(iter(records.values()))) if isinstance(records, Mapping) else _module(records)
    # Comparisons of measured runs use the figures of simulated runs.
    home = importlib.import_module(SIMULATED) if several and module.__name__ == MEASURED else module
    wanted = Look.of(size, font, style, title=title, caption=caption, panels=panels)
    shared = importlib.import_module("dynsim.draw.figures.style")
    with _drawable(), shared.look(wanted):
        makers = home.comparisons(records) if several else home.figures(records)
        if name not in makers:
            kind = "several records" if several else "such a record"
            raise RecordError(f"unknown figure {brief(name)} for {kind}; choices: {', '.join(makers)}")
        drawn: Figure | None = makers[name](records)
        if drawn is None:
            raise RecordError(f"the record has no data for the figure {name!r}")
        list(shared.with_panels([(name, drawn)]))
        shared.literal(drawn)
        if wanted.height is not None:
            drawn.draw_without_rendering()  # raises if the height leaves no space for the axes
    return drawn


def _with_names(records: Mapping[str, Record]) -> dict[str, Record]:
    """Return the records with a text for names that are empty or blank, which a legend would omit."""
    return {name if name.strip() else UNNAMED: record for name, record in records.items()}


@contextmanager
def _drawable() -> Iterator[None]:
    """Convert errors in the block to RecordError, because records may come from any source and may lack data."""
    try:
        yield
    except DynsimError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:
        text = " ".join(str(error).split())
        raise RecordError(f"the record cannot be drawn: {type(error).__name__}: {text}") from error


def _module(record: Record, name: str = "") -> ModuleType:
    for module, needed in MODULES.items():
        if any(signals <= set(record) for signals in needed):
            return importlib.import_module(module)
    which = f"{name}: " if name else ""
    raise RecordError(f"{which}no figures for a record with these signals: {', '.join(record) or 'none'}")
