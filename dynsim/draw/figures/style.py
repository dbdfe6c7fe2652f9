"""Style shared by all figures: sizes, colours, titles, legends, time axes, number formats, saving."""

from __future__ import annotations

import logging
import math
import re
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.container import Container
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.textpath import text_to_path
from matplotlib.ticker import AutoLocator, FuncFormatter, LogFormatter, LogLocator, NullFormatter, NullLocator
from matplotlib.transforms import Bbox, ScaledTranslation, Transform, blended_transform_factory
from numpy.typing import NDArray

from dynsim.draw.figures.look import Look
from dynsim.draw.figures.overlap import separate
from dynsim.draw.figures.panels import chosen, explained, named, regrid
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.system.files import replacing
from dynsim.system.terminal import plain

T = TypeVar("T")
Array = NDArray[np.float64]
# A quantity over time: times, (T,), and values, (T,) or (T, k).
Series = tuple[Array, Array]

# Colours of Okabe and Ito, which colour-blind readers can distinguish; yellow is omitted, because it is too faint on
# white.
BLUE, ORANGE, GREEN, PURPLE, SKY, BLACK = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#000000"
# This colour is reserved for pulling contacts in every figure, so no variant uses it.
PULLING = "#D55E00"
GREY = "#7F7F7F"
# Colour of notes, which is dark enough for small letters.
NOTE = "#555555"
# Colour of parts of links that are below a surface because they have no contact point.
DEEP = "#882255"
# Black is reserved for targets and limits.
VARIANT_COLOURS = (BLUE, GREEN, ORANGE, PURPLE, SKY, "#8C6D31", "#9E9AC8", "#332288")
# Line styles of variants, in addition to colours, or of variants that share a colour.
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1, 1, 1)), (0, (1, 1)), (0, (8, 3)), (0, (3, 1, 1, 1, 1, 1)))
# Names of colours, line styles and markers in captions.
_COLOUR_NAMES = {
    BLUE: "blue", ORANGE: "orange", GREEN: "green", PURPLE: "pink", SKY: "light blue", BLACK: "black",
    "#8c6d31": "brown", "#9e9ac8": "lavender", "#332288": "indigo", GREY: "grey", PULLING: "red", DEEP: "dark red",
}  # fmt: skip
_DASH_NAMES = ("solid", "dashed", "dash-dotted", "dotted", "long dashes", "dash-dot-dotted")
_MARKER_NAMES = {"o": "circle", "s": "square", "D": "diamond", "^": "triangle", "v": "triangle down", "x": "cross"}
AXIS_COLOURS = {"x": BLUE, "y": GREEN, "z": ORANGE}

# Width of a figure on a page [inch]; in a figure below NARROW, which fits a column of a paper, panels are below each
# other.
WIDTH, NARROW = 7.2, 5.0
# Size of the letters of labels [point]; the other sizes are multiples.
POINTS = 8.5
# Sizes of other texts as multiples of the size of labels.
_SIZES = {
    "axes.titlesize": 1.0,
    "axes.labelsize": 1.0,
    "legend.fontsize": 0.88,
    "xtick.labelsize": 0.88,
    "ytick.labelsize": 0.88,
    "figure.titlesize": 1.18,
}
# Labels of coordinates, with an italic symbol.
_COORDINATE = re.compile(r"(height |roll |pitch |yaw )?\$(x|y|z|\\alpha|\\beta|\\gamma)\$( \[(m|mm|rad|mrad|°)\])?")
# Space between the edge of a figure, and its title and notes [inch].
EDGE = 0.07
# Spaces before units, before brackets, and in ranges, at which a line is not broken.
_UNIT = re.compile(
    r"(?<=\d) (?=(?:[mk]?[smgNWJAV]|mm|N m|kg|rad|Hz|°|%)(?!\w)|[…×])|(?<=[…×]) | (?=\[)|(?<=N) (?=m\b)|(?<=azimuth) "
)
_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ"}
# Labels of artists that are in no legend begin with this.
UNLISTED = "_unlisted "
# Also labels that matplotlib gives to artists without a label.
_UNLISTED = re.compile(rf"_(nolegend_|child\d+|container\d+)|{UNLISTED}.*")
# Mean width of a letter as a multiple of its size, for the breaking of long lines.
LETTER = 0.56
DPI = 170
# File with the captions of the figures in its folder.
CAPTIONS = "captions.txt"
_LOOK: Any = {
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.0,
    "hatch.linewidth": 0.5,
    "axes.prop_cycle": cycler(color=VARIANT_COLOURS),
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    # A line with a million points overflows Agg's cell block unless it is drawn in pieces.
    "agg.path.chunksize": 20_000,
}
# Curves in space with more points than this are thinned; a figure is about 1200 pixels wide.
LINE_POINTS = 4000
# A transient panel shows TRANSIENT_ROOM times the transient, unless this exceeds TRANSIENT_MAX_SHARE of the run.
TRANSIENT_ROOM, TRANSIENT_MAX_SHARE = 1.2, 0.8
# Peaks in less than this share of the samples of each series [%] are cut if the range with them is SPIKE times the
# range without them.
SHORT, SPIKE = 2.0, 5.0
# Space beyond the settled range of a row that is cut, as a fraction of the range.
HEADROOM = 0.3
# Curves whose range is below this fraction of their largest value are drawn with zero.
FLAT = 0.1
# Values below this fraction of the scale of a quantity are rounding errors.
NOTHING = 1e-9
# Minimum number of labelled ticks of an axis, and minimum share of its range between the first and the last.
LABELS, COVERED = 3, 0.6
# Steps between ticks, as multiples of a power of ten: those of matplotlib, and more if they have too few labels.
STEPS = ((1, 2, 2.5, 5, 10), (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10))
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# Group of the marks above axes, and the height of a row of them [point].
RUG, RUG_ROW = "rug", 5.5
# Number of additional layouts of axes with a fixed aspect.
ASPECTS = 3
# Height of a legend row as a multiple of the size of its letters.
LEGEND_ROW = 1.67


_drawn: ContextVar[Look | None] = ContextVar("look of the figures", default=None)
# ``matplotlib.rcParams`` belongs to the process, so only one thread at a time may change it.
_settings = RLock()


@contextmanager
def look(wanted: Look | None = None) -> Iterator[None]:
    """Apply a look in a ``with`` block; the look of an outer block takes precedence.

    Settings of matplotlib that a user changed, in ``rcParams`` or by a style sheet, remain; dynsim sets the others.
    LaTeX is not used, because names of variants and joints contain letters that are commands there. Other threads that
    use this function wait until the block ends.

    Raises
    ------
    RecordError
        If a style sheet cannot be read, or there is no font of the family.
    """
    if _drawn.get() is not None:
        yield
        return
    wanted = wanted or Look()
    with _settings, matplotlib.rc_context():
        matplotlib.rcParams["text.usetex"] = False
        _apply_styles(wanted.styles)
        changed = _changed((*_LOOK, *_SIZES, "font.size", "mathtext.fontset"))
        points = wanted.points or (matplotlib.rcParams["font.size"] if "font.size" in changed else POINTS)
        settings: Any = {**_LOOK, **{key: points * share for key, share in _SIZES.items()}}
        matplotlib.rcParams.update({key: value for key, value in settings.items() if key not in changed})
        matplotlib.rcParams["font.size"] = points
        if wanted.family is not None:
            _check_family(wanted.family)
            matplotlib.rcParams["font.family"] = [wanted.family]
        if "mathtext.fontset" not in changed:
            matplotlib.rcParams["mathtext.fontset"] = _math_font()
        token = _drawn.set(wanted)
        try:
            yield
        finally:
            _drawn.reset(token)


def _changed(keys: Iterable[str]) -> set[str]:
    """Return the settings of matplotlib that differ from its defaults."""
    now: Any = matplotlib.rcParams
    default: Any = matplotlib.rcParamsDefault
    return {key for key in keys if now[key] != default[key]}


def _math_font() -> Any:
    """Return matplotlib's font for symbols that is most like the font of the texts."""
    name = get_font(findfont(FontProperties())).family_name
    if name.startswith("DejaVu"):
        return "dejavuserif" if "Serif" in name else "dejavusans"
    if name.startswith(("CMU", "cmr", "Computer Modern", "Latin Modern", "LM")):
        return "cm"
    serif = name in matplotlib.rcParamsDefault["font.serif"] or re.search("STIXG|Times|Roman|Serif|Tinos", name)
    return "stix" if serif else "stixsans"


def _apply_styles(sheets: Sequence[str]) -> None:
    import matplotlib.style

    for sheet in sheets:
        try:
            # Matplotlib only logs unknown settings and invalid values.
            with _logged("matplotlib") as faults:
                matplotlib.style.use(sheet)
        except (OSError, ValueError) as error:
            text = " ".join(str(error).split())
            raise RecordError(
                f"style {sheet!r}: {text}; choices: a file, or {', '.join(matplotlib.style.available)}"
            ) from error
        if faults:
            raise RecordError(f"style {sheet!r}: {faults[0]}; correct or remove this setting")
        if matplotlib.rcParams["text.usetex"]:
            raise RecordError(
                f"style {sheet!r}: text.usetex: True is not supported, because names are drawn literally; remove it, "
                "and use font.family: serif with mathtext.fontset: cm for letters like those of LaTeX"
            )


@contextmanager
def _logged(name: str) -> Iterator[list[str]]:
    """Collect the first lines of the warnings that a library logs in the block, instead of printing them."""
    texts: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING:
            texts.append(record.getMessage().strip().partition("\n")[0])
        return False

    logger = logging.getLogger(name)
    logger.addFilter(keep)
    try:
        yield texts
    finally:
        logger.removeFilter(keep)


def _check_family(family: str) -> None:
    try:
        findfont(FontProperties(family=[family]), fallback_to_default=False)
    except ValueError as error:
        raise RecordError(
            f"font {family!r}: this machine has no such font; try serif, sans-serif, or its name"
        ) from error


def width() -> float:
    """Return the width of the figures [inch]: as wanted, as in ``rcParams``, or that of a page."""
    wanted = _drawn.get()
    if wanted is not None and wanted.width is not None:
        return wanted.width
    return float(matplotlib.rcParams["figure.figsize"][0]) if _has_own_size() else WIDTH


def _has_own_size() -> bool:
    return bool(matplotlib.rcParams["figure.figsize"] != matplotlib.rcParamsDefault["figure.figsize"])


def narrow() -> bool:
    """Return whether the figures fit a column of a paper, so that panels are below each other."""
    return width() < NARROW


def letters(points: float) -> float:
    """Return a font size [point] that is ``points`` if labels have their usual size, and in proportion otherwise."""
    return points / POINTS * float(matplotlib.rcParams["font.size"])


def _size(key: str) -> float:
    """Return a font size of ``rcParams`` [point]; sizes in words are those of dynsim."""
    settings: Any = matplotlib.rcParams
    size = settings[key]
    return float(size) if isinstance(size, int | float) else letters(_SIZES[key] * POINTS)


def broken(text: str, across: float | None = None, points: float | None = None, *, even: bool = False) -> str:
    """Break a text into lines that fit in ``across`` [inch] (default: the figure), with letters of a size [point].

    If ``even``, the lines are about equally long. A line may have a dozen letters in any case.
    """
    size = letters(POINTS) if points is None else points
    room = 72.0 * (width() if across is None else across)
    return "\n".join(_filled(part, room, size, even) for part in text.split("\n"))


def _filled(text: str, room: float, size: float, even: bool) -> str:
    count, text = max(int(room / (LETTER * size)), 12), _UNIT.sub("\u00a0", text)
    lines = textwrap.wrap(text, count)
    while count > 12 and any(text_width(line, size) > room for line in lines):
        count -= 1
        lines = textwrap.wrap(text, count)
    longest = max(map(len, text.split()), default=0)
    while even and count > max(12, longest) and len(shorter := textwrap.wrap(text, count - 1)) == len(lines):
        count, lines = count - 1, shorter
    return "\n".join(lines).replace("\u00a0", " ")


def text_width(text: str, size: float) -> float:
    """Return the width of a line of text [point], with letters of a size [point]."""
    return float(text_to_path.get_text_width_height_descent(plain(text), FontProperties(size=size), ismath=False)[0])


class Drawing(Figure):
    """Figure with one legend and notes below its axes, with space for both.

    Attributes
    ----------
    subject : str
        Title, even if it is not drawn.
    notes : str
        Notes, one per line: what dashes mean, what was cut off. They are drawn if the look has a caption.
    grows : bool
        Whether lines of title, legend and notes make the figure higher; False if the user set its height.
    needed : float
        Height that the contents require [inch].
    ticked : bool
        Whether the ticks of the next drawing have been chosen.
    """

    subject = notes = ""
    grows = True
    needed = 0.0
    ticked = False
    # During a layout, the space for the labels of axes on their four sides [pixel].
    _measured: dict[Axes, Array] | None = None
    _note: Text | None = None
    _below: Legend | None = None
    _rows = 1

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._entries: dict[str, Any] = {}
        self._automatic: set[AutoLocator] = set()

    @property
    def caption(self) -> str:
        """Caption for a paper, one sentence per line: subject and axes of the figure, its legend, then the notes."""
        scenario, colon, subject = self.subject.partition(": ")
        panels: dict[str, list[str]] = {}
        for axes in filter(Axes.get_visible, self.axes):
            sharing: Any = axes.get_shared_x_axes().get_siblings(axes)
            labels = (_words(other.get_xlabel()).partition(": ")[0] for other in [axes, *sharing])
            across = next(filter(None, labels), "")
            up = _words(axes.get_ylabel())
            if up and up not in panels.setdefault(across, []):
                panels[across].append(up)
            elif across:
                panels.setdefault(across, [])
        alone = panels.pop("", [])
        panels[""] = [up for up in alone if not any(up in others for others in panels.values())]
        parts = [" over ".join(filter(None, [", ".join(up), across])) for across, up in panels.items()]
        subject = f"{subject} ({scenario})" if colon else self.subject
        sentence = ": ".join(filter(None, [subject, "; ".join(filter(None, parts))]))
        entries = "; ".join(f"{_words(label)}{_described(handle)}" for label, handle in self.legend_entries())
        log = [up for axes in self.axes if axes.get_yscale() == "log" and (up := _quantity(axes.get_ylabel()))]
        log += [over for axes in self.axes if axes.get_xscale() == "log" and (over := _quantity(axes.get_xlabel()))]
        parts = [
            sentence and f"{sentence[0].upper()}{sentence[1:]}.",
            entries and f"Lines and marks: {entries}.",
            f"Logarithmic axes: {', '.join(dict.fromkeys(log))}." if log else "",
            self.notes,
        ]
        return "\n".join(filter(None, parts))

    def legend_entries(self) -> list[tuple[str, Any]]:
        """Return label and handle of the entries of the legends of the figure and its axes, each label once."""
        entries = dict(self._entries)
        for legend in filter(None, (axes.get_legend() for axes in self.axes)):
            texts = (" ".join(text.get_text().split()) for text in legend.get_texts())
            entries |= dict(zip(texts, legend.legend_handles, strict=True))
        return list(entries.items())

    def entitle(self, title: str) -> None:
        """Set the subject, and the title above the panels if the look has titles."""
        self.subject = title
        if (_drawn.get() or Look()).title and title:
            size, before = _size("figure.titlesize"), max(_lines(self.get_suptitle()), 1)
            text = broken(title, self.get_figwidth() - 2.0 * EDGE, size, even=True)
            self.suptitle(text, fontsize=size)
            self.grow(1.2 * size * (_lines(text) - before))

    def note(self, *notes: str) -> None:
        """Add notes to the caption."""
        self.notes = "\n".join([*filter(None, [self.notes]), *notes])
        wanted = _drawn.get()
        if not self.notes or (wanted is not None and not wanted.caption):
            return
        size, before = letters(7.0), ""
        if self._note is not None:
            before = self._note.get_text()
            self._note.remove()
        text = broken(self.notes, self.get_figwidth() - 2.0 * EDGE, size)
        look: Any = {"fontsize": size, "color": NOTE, "ha": "left", "va": "bottom", "in_layout": False}
        self._note = self.text(EDGE / self.get_figwidth(), 0.0, text, **look)
        self.grow(1.25 * size * (_lines(text) - _lines(before)))

    def put_below(self, entries: Mapping[str, Any], columns: int, *, last: bool = False) -> None:
        """Add entries (handles by label) to the legend below the axes, first or last, in at most so many columns."""
        if not entries:
            return
        if self._below is not None:
            self._below.remove()
        self._entries = {**self._entries, **entries} if last else {**entries, **self._entries}
        before = self._rows
        labels, columns, self._rows = fitted_legend(list(self._entries), columns)
        anchor: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 0.0), "borderaxespad": 0.0}
        self._below = self.legend(list(self._entries.values()), labels, ncols=columns, **anchor)
        self._below.set_in_layout(False)
        self.grow(legend_row() * (self._rows - before))

    def keep(self, kept: Sequence[Axes]) -> None:
        """Remove all axes but ``kept``, which keep their height, and legend entries that explain only the others."""
        own, grows, self.grows = self.get_figheight(), self.grows, True
        self.set_figheight(self.needed)
        self.draw_without_rendering()
        before = {axes: _room(axes) for axes in kept}
        entries = dict(self._entries)
        if not any(axes.get_legend() for axes in kept):
            entries = dict(self.legend_entries())
        if self._below is not None:
            self._below.remove()
        self.grow(legend_row() * (1 - self._rows))
        self._below, self._rows, self._entries = None, 1, {}
        self.put_below(explained(entries, kept), 5)
        regrid(self, kept)
        scenario, colon, subject = self.subject.partition(": ")
        early = subject.partition(" (incomplete")
        self.entitle(f"{scenario}{colon}{', '.join(named(self))}{early[1]}{early[2]}")
        # Panels keep their height; at a fixed scale they use the width of the panels that were beside them. Labels of
        # panels at a fixed scale need no space if there is more than enough, so the height is found by iteration.
        for _ in range(3):
            self.draw_without_rendering()
            rows = {}
            for axes, (wide, high) in before.items():
                width, height = _room(axes)
                scale = 1.0 if axes.get_aspect() == "auto" else min(width / wide, max(3.0 / high, 1.0))
                rows[round(axes.get_position(original=True).y1, 3)] = scale * high - height
            if abs(sum(rows.values())) < 0.05:
                break
            self.grow(72.0 * sum(rows.values()))
        self.grows = grows
        if not grows:
            self.set_figheight(own)

    def grow(self, points: float) -> None:
        """Make the figure higher [point], unless the user set its height."""
        self.needed += points / 72.0
        if self.grows:
            self.set_figheight(self.get_figheight() + points / 72.0)

    def savefig(self, fname: Any, **options: Any) -> None:
        """Write the figure; PDF and EPS files contain TrueType fonts, because journals reject fonts of type 3."""
        fonts: Any = {"pdf.fonttype": 42, "ps.fonttype": 42}
        with matplotlib.rc_context({key: fonts[key] for key in fonts.keys() - _changed(fonts)}):
            super().savefig(fname, **options)

    def add_subplot(self, *args: Any, **options: Any) -> Any:
        """Add axes, see :meth:`matplotlib.figure.Figure.add_subplot`."""
        axes: Any = super().add_subplot(*args, **options)
        axes.get_tightbbox = partial(self._box, axes, axes.get_tightbbox)
        return axes

    def _box(self, axes: Axes, measure: Callable[..., Bbox], *args: Any, **options: Any) -> Bbox:
        """Return the box of axes and their labels; during a layout, the labels are measured once.

        Constrained layout measures them again after it has moved the axes, which takes most of its time, although the
        ticks remain.
        """
        if self._measured is None or not axes.get_visible():
            return measure(*args, **options)
        if axes not in self._measured:
            box = measure(*args, **options)
            self._measured[axes] = np.subtract(box.extents, axes.bbox.extents)
        axes.apply_aspect()
        return Bbox(np.add(axes.bbox.extents, self._measured[axes]).reshape(2, 2))

    def lay_out(self, renderer: Any) -> None:
        """Determine the positions of the axes, and choose the ticks of the next drawing.

        With ticks that depend on the size of the axes, the layout may alternate between two sizes, and cut labels. So
        the ticks are chosen once, after a first layout; the layout of the drawing has space for their labels.

        Raises
        ------
        RecordError
            If the height that the user set leaves no space for the axes.
        """
        both = [axis for axes in self.axes[::-1] if axes.axison for axis in (axes.yaxis, axes.xaxis)]
        automatic = {ticks: axis for axis in both if isinstance(ticks := axis.get_major_locator(), AutoLocator)}
        # Others have a number of ticks that was set.
        self._automatic |= {ticks for ticks in automatic if vars(ticks)["_nbins"] == "auto"}
        with self._layout(renderer):
            if (engine := self.get_layout_engine()) is not None:
                engine.execute(self)
        for ticks in automatic.keys() & self._automatic:
            _choose_ticks(automatic[ticks], ticks)
        self.ticked = True

    def draw(self, renderer: Any) -> None:
        """Draw the figure, with notes at its lower edge, the legend above them, and the axes in the space above.

        Raises
        ------
        RecordError
            As for :meth:`lay_out`.
        """
        if not self.ticked:
            self.lay_out(renderer)
        self.ticked = False
        with self._layout(renderer):
            super().draw(renderer)

    @contextmanager
    def _layout(self, renderer: Any) -> Iterator[None]:
        """Place notes and legend for a layout of the axes in the block, in the space above.

        Axes with a fixed aspect get their first layouts here, because the space for their labels depends on their size.
        """
        engine: Any = self.get_layout_engine()
        gap, used = 4.0 * self.dpi / 72.0, 0.0
        for below in (self._note, self._below):
            if below is None:
                continue
            level = (used + 0.6 * gap) / self.bbox.height
            if isinstance(below, Text):
                below.set_y(level)
            else:
                below.set_bbox_to_anchor((0.5, level), transform=self.transFigure)
            used += below.get_window_extent(renderer).height + gap
        if isinstance(engine, ConstrainedLayoutEngine):
            share = min(used / self.bbox.height, 0.8)
            engine.set(rect=(0.0, share, 1.0, 1.0 - share))
        self._measured, fixed = {}, any(axes.get_aspect() != "auto" for axes in self.axes)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                for _ in range(ASPECTS if fixed and engine is not None else 0):
                    engine.execute(self)
                yield
            finally:
                self._measured = None
        for warning in caught:
            if "collapsed" in str(warning.message) and not self.grows:
                size = f"size {self.get_figwidth():.3g}x{self.get_figheight():.3g}"
                least = f"set the width only, a height of {self.needed:.2g} in, or fewer panels"
                raise RecordError(f"{size}: no space for the axes of this figure; {least}")
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def _room(axes: Axes) -> tuple[float, float]:
    """Return the width and height of the cell of axes [inch]; the height of one row if the cell has several."""
    cell, box, figure = axes.get_subplotspec(), axes.get_position(original=True), axes.get_figure(root=True)
    assert cell is not None
    assert figure is not None
    return box.width * figure.get_figwidth(), box.height * figure.get_figheight() / len(cell.rowspan)


def _choose_ticks(axis: Axis, locator: AutoLocator) -> None:
    """Set the number of ticks: at least ``LABELS`` if they fit, which span the share ``COVERED`` of the axis."""
    # The sizes in ``rcParams`` may have changed since the figure was made.
    axes: Any = axis.axes
    which, size = int(axis is axis.axes.yaxis), float(axis.get_major_ticks(1)[0].label1.get_fontsize())
    axes.apply_aspect()
    low, high = sorted(axis.get_view_interval())
    # Length of the axis [point].
    length = 72.0 * float(axes.bbox.size[which]) / axes.figure.dpi
    usual = int(np.clip(0.85 * axis.get_tick_space(), 1, 9))
    best: tuple[float, int, tuple[float, ...]] = (-1.0, 1, STEPS[0])
    for steps, count in product(STEPS, [*range(usual, 10), *range(usual - 1, 0, -1)]):
        locator.set_params(nbins=count, steps=steps)
        at = [float(tick) for tick in axis.get_majorticklocs() if low <= tick <= high]
        texts = axis.get_major_formatter().format_ticks(at)
        wide = 1.3 * size if which else max((text_width(text, size) for text in texts), default=0.0) + 0.5 * size
        if len(at) > 1 and length * (at[1] - at[0]) < wide * (high - low):
            continue
        covered = (at[-1] - at[0]) / (high - low) if at else 0.0
        if (score := min(len(at), LABELS) + min(covered, COVERED)) > best[0]:
            best = (score, count, steps)
        if score == LABELS + COVERED:
            return
    locator.set_params(nbins=best[1], steps=best[2])


def _words(label: str) -> str:
    """Return a label of an axis in one line, with symbols as letters."""
    if _COORDINATE.fullmatch(label):
        label = re.sub(r"\\(alpha|beta|gamma)", lambda match: _GREEK[match[1]], label.replace("$", ""))
    return " ".join(label.split())


def _quantity(label: str) -> str:
    """Return a label of an axis in one line, without its unit."""
    return _words(label).partition(" [")[0]


def _described(handle: Any) -> str:
    """Return colour and line style, or marker, of an entry of a legend, in brackets; "" if they have no names."""
    handle = next(iter(getattr(handle, "patches", ())), handle)
    if not isinstance(handle, Line2D | Patch):
        return ""
    colour = handle.get_color() if isinstance(handle, Line2D) else handle.get_facecolor()
    words = [next((name for code, name in _COLOUR_NAMES.items() if to_hex(colour) == code.lower()), "")]
    if isinstance(handle, Line2D) and handle.get_linestyle() == "None":
        words.append(_MARKER_NAMES.get(str(handle.get_marker()), ""))
    elif isinstance(handle, Line2D):
        pattern = vars(handle)["_unscaled_dash_pattern"]
        styles = {vars(Line2D([], [], linestyle=dash))["_unscaled_dash_pattern"]: k for k, dash in enumerate(DASHES)}
        words.append(_DASH_NAMES[styles[pattern]] if pattern in styles else "dashed")
    text = ", ".join(filter(None, words))
    return f" ({text})" if text else ""


def _lines(text: str) -> int:
    return text.count("\n") + 1 if text else 0


def new_figure(height: float, title: str, *, page: float = WIDTH) -> Drawing:
    """Create an empty figure, independent of pyplot and displays.

    Parameters
    ----------
    height : float
        Height [inch], unless the user wants another, with one line of title and of legend; further lines and notes are
        added to it. The height in ``rcParams`` is used if it is larger.
    title : str
        Title; a long one has several lines.
    page : float, optional
        Width [inch] if the user wants none.
    """
    wanted = _drawn.get() or Look()
    wide = width() if wanted.width is not None or _has_own_size() else page
    own = float(matplotlib.rcParams["figure.figsize"][1]) if _has_own_size() and wanted.width is None else 0.0
    dots: Any = matplotlib.rcParams["savefig.dpi"] if _changed(["savefig.dpi"]) else None
    figure = Drawing(figsize=(wide, wanted.height or max(own, height)), layout="constrained", dpi=dots)
    figure.grows = wanted.height is None
    figure.needed = height
    FigureCanvasAgg(figure)
    figure.entitle(title)
    return figure


def literal(figure: Figure) -> None:
    """Draw all texts literally: names from files may contain formulas, and control characters that have no glyphs.

    Only powers of ten, and the symbols of coordinates, are formulas.
    """
    powers = {label for axes in figure.axes for axis in (axes.xaxis, axes.yaxis) for label in _powers(axis)}
    for text in figure.findobj(Text):
        text.set_text(plain(text.get_text()))
        text.set_parse_math(text in powers or _COORDINATE.fullmatch(text.get_text()) is not None)


def _powers(axis: Axis) -> list[Text]:
    """Return the tick labels that matplotlib writes as powers of ten."""
    return axis.get_ticklabels(which="both") if isinstance(axis.get_major_formatter(), LogFormatter) else []


def _with_dots(figure: Figure) -> Figure:
    """Return the figure with the resolution of its file, at which the extents of texts are computed only once."""
    if not _changed(["savefig.dpi"]):
        figure.set_dpi(DPI)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, PDF or SVG, depending on the suffix; equal figures give equal bytes.

    Raises
    ------
    RecordError
        If the file cannot be written; an existing file is then unchanged.
    """
    literal(_with_dots(figure))
    kind = path.suffix.removeprefix(".")
    with _settings, replacing(path) as stream, matplotlib.rc_context({"svg.hashsalt": path.stem}):
        if kind == "png":
            # This draws once; ``savefig`` would draw twice, the first time for the layout.
            canvas: Any = figure.canvas
            canvas.print_png(stream)
        else:
            date = {"pdf": "CreationDate", "svg": "Date"}[kind]
            figure.savefig(stream, format=kind, dpi="figure", metadata={date: None})
    return path


def save_all(makers: Mapping[str, Callable[[T], Figure | None]], of: T, folder: Path, kind: str) -> list[Path]:
    """Draw and save every figure for which there are data, and write their captions; return the files of figures."""
    with look():
        made = ((name, make(of)) for name, make in makers.items())
        drawn = ((name, _with_dots(figure)) for name, figure in made if figure is not None)
        files, captions = [], []
        for name, figure in with_panels(drawn):
            files.append(save(figure, folder / f"{name}.{kind}"))
            captions.append(f"{name}\n{getattr(figure, 'caption', '')}\n")
        if captions:
            with replacing(folder / CAPTIONS) as stream:
                stream.write("\n".join(captions).encode())
        return files


def wanted_panels() -> tuple[str, ...]:
    """Return the names of the only panels to draw; empty for all panels."""
    return (_drawn.get() or Look()).panels


def wants_film() -> bool:
    """Return whether an animation is written next to the figures."""
    wanted = _drawn.get() or Look()
    return wanted.film and not wanted.panels


def with_panels(drawn: Iterable[tuple[str, Figure]]) -> Iterable[tuple[str, Figure]]:
    """Reduce figures to the panels of the look, if it names any; figures without such a panel are omitted.

    Notes on curves that coincide are added.
    """
    if wanted := wanted_panels():
        figures: dict[str, Any] = dict(drawn)
        for name, axes in (kept := chosen(figures, wanted)).items():
            figures[name].keep(axes)
        drawn = [(name, figures[name]) for name in kept]
    for name, figure in drawn:
        if isinstance(figure, Drawing):
            literal(figure)  # before its first layout
            canvas: Any = figure.canvas
            figure.lay_out(canvas.get_renderer())
            figure.note(*separate(figure))
        yield name, figure
        if isinstance(figure, Drawing):
            figure.ticked = False  # its owner may change it


def title(record: Record, subject: str) -> str:
    """Return a title with scenario and variant (or the measured robot), and the end time of an incomplete run."""
    note = "" if record.complete else f" (incomplete: ends at {record.time[-1]:.3g} s)"
    name = record.scenario_name
    return f"{record.title.replace(name, spaced(name), 1) or 'record'}: {subject}{note}"


def comparison_title(records: Sequence[Record], subject: str) -> str:
    """Return a title with the scenario of the variants."""
    return f"{spaced(records[0].scenario_name) or 'comparison'}: {subject}"


def spaced(name: str) -> str:
    """Return the name of a scenario for a title: a file name such as "wall_push" consists of words."""
    return name.replace("_", " ")


def variant_styles(names: Sequence[T]) -> dict[T, dict[str, Any]]:
    """Return the colour, width and line style of each variant, or of each curve of one run, by position.

    Line styles differ, so that curves can be distinguished in greyscale, and equal curves remain visible. Pairs of
    colour and line style repeat only after several turns of the colours.
    """
    colours = _colours()
    turn = math.lcm(len(colours), len(DASHES))
    return {
        name: {
            "color": colours[k % len(colours)],
            "linestyle": DASHES[(k + k // turn) % len(DASHES)],
            "linewidth": float(matplotlib.rcParams["lines.linewidth"]),
        }
        for k, name in enumerate(names)
    }


def _colours() -> Sequence[str]:
    """Return the colours of variants: those of the look, and dynsim's own outside of a look."""
    if _drawn.get() is None:
        return VARIANT_COLOURS
    cycle = matplotlib.rcParams["axes.prop_cycle"].by_key().get("color", VARIANT_COLOURS)
    return [to_hex(colour) for colour in cycle]


# Legend entry of variants without an ending.
ALONE = "without suffix"


def families(names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Split the names of variants at an underscore into a stem, which related variants share, and an ending.

    The stem is the shortest beginning that is the name of a variant: "x_slow" belongs to "x". If no name begins with
    the name of another variant, the ending is the last word: "ii_z" has the stem "ii".
    """
    stems = {}
    for name in names:
        words = name.split("_")
        beginnings = ["_".join(words[:k]) for k in range(1, len(words) + 1)]
        stems[name] = next(part for part in beginnings if part in names)
    if list(stems) == list(stems.values()):
        stems = {name: name.rpartition("_")[0] or name for name in names}
    return {name: (stem, name[len(stem) + 1 :]) for name, stem in stems.items()}


def number(value: float, digits: int = 4, scale: float = 0.0) -> str:
    """Format a number with a true minus sign and powers of ten; as 0 if it is a rounding error of the ``scale``."""
    text = with_powers(f"{0.0 if abs(value) < NOTHING * scale else value:.{digits}g}")
    return re.sub(r"^(−?)1 × ", r"\1", text)


def with_powers(text: str) -> str:
    """Return a formatted number with true minus signs and a power of ten instead of an exponent: 3.6 × 10⁻¹¹."""
    mantissa, exponent, power = text.partition("e")
    raised = f" × 10{str(int(power)).translate(SUPERSCRIPTS)}" if exponent else ""
    return f"{mantissa.replace('-', '−')}{raised}"


def log_axis(axes: Axes, which: str = "y") -> None:
    """Make an axis ("x" or "y") logarithmic with plain numbers, also for ranges of less than a decade."""
    axes.set(**{f"{which}scale": "log"})
    low, high = axes.get_ylim() if which == "y" else axes.get_xlim()
    near = high < 200.0 * low
    axis = axes.yaxis if which == "y" else axes.xaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if near else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 6)))
    axis.set_minor_formatter(NullFormatter())


def label_row(panels: Sequence[Axes], label: str) -> None:
    """Label the vertical axis of a row of panels; panels with another scale have a separate label."""
    for axes in panels:
        if axes is panels[0] or axes.get_ylim() != panels[0].get_ylim():
            axes.set_ylabel(label)


def at_least(axes: Axes, span: float) -> None:
    """Widen the vertical axis to at least ``span``, so that rounding or sensor resolution does not fill the axes."""
    low, high = axes.get_ylim()
    if high - low < span:
        middle = 0.5 * (low + high)
        axes.set_ylim(middle - 0.5 * span, middle + 0.5 * span)


def shade_below_zero(axes: Axes, label: str) -> None:
    """Draw the zero line, and shade the part of the axes below it, if any."""
    axes.axhline(0.0, color=PULLING, linewidth=0.8)
    low, high = axes.get_ylim()
    if low < 0.0:
        axes.axhspan(low, 0.0, color=PULLING, alpha=0.13, linewidth=0, label=label)
        axes.set_ylim(low, high)


def shade(axes: Axes, time: Array, where: NDArray[np.bool_], colour: str, label: str, **hatched: Any) -> None:
    """Shade the times at which ``where`` is True, each up to the next sample, with one legend entry."""
    if where.any():
        until = where | np.append(False, where[:-1])
        look: dict[str, Any] = {"facecolor": colour, "linewidth": 0, "zorder": 0.2, "label": label, **hatched}
        axes.fill_between(time, 0.0, 1.0, where=until, transform=axes.get_xaxis_transform(), **look)


def legend_row() -> float:
    """Return the height of a row of a legend [point]."""
    return LEGEND_ROW * _size("legend.fontsize")


def fitted_legend(labels: Sequence[str], columns: int) -> tuple[list[str], int, int]:
    """Return the labels, broken into lines, the number of columns that fit into the figure, and the rows of text."""
    size = _size("legend.fontsize")
    handle = (matplotlib.rcParams["legend.handlelength"] + 2.8) * size
    available = 72.0 * 0.97 * width()
    lines = [broken(visible(label), (available - handle) / 72.0, size) for label in labels]
    widths = [max(text_width(line, size) for line in label.split("\n")) + handle for label in lines]
    # A legend is filled column by column; each column is as wide as its widest label.
    for count in range(max(min(columns, len(lines)), 1), 0, -1):
        parts = [part for part in np.array_split(np.arange(len(lines)), count) if len(part)]
        wide = sum(max(widths[k] for k in part) for part in parts)
        # Fewer columns with as many rows are easier to read.
        if wide <= available and (count == 1 or -(-len(lines) // (count - 1)) > -(-len(lines) // count)):
            break
    return lines, count, max((sum(lines[k].count("\n") + 1 for k in part) for part in parts), default=0)


def legend_beside(axes: Axes, columns: int = 2) -> None:
    """Place a legend without repeated entries to the right of the axes, or above them in a narrow figure."""
    if narrow():
        legend_above(axes, columns)
        return
    unique = legend_entries([axes])
    axes.legend(unique.values(), map(visible, unique), loc="center left", bbox_to_anchor=(1.0, 0.5))


def legend_above(axes: Axes, columns: int = 3) -> None:
    """Place the legend above the axes, where it hides no curves, with space for all of its rows."""
    unique = legend_entries([axes])
    labels, columns, rows = fitted_legend(list(unique), columns)
    lift = rug_height(axes)
    look: dict[str, Any] = {"ncols": columns, "borderaxespad": 0.0, "bbox_transform": _raised(axes, lift)}
    legend = axes.legend(unique.values(), labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), **look)
    # The legend may extend over the panel to its left; a blank title reserves the space above.
    legend.set_in_layout(False)
    axes.set_title(" ", y=1.0, pad=6.0 + lift + legend_row() * max(rows - 1, 0))


def rug(axes: Axes, rows: Mapping[str, Sequence[float]]) -> None:
    """Draw marks above the axes at times on the horizontal axis, one row per shape."""
    for shape, times in rows.items():
        across = blended_transform_factory(axes.transData, _raised(axes, rug_height(axes) + 0.5 * RUG_ROW))
        look: dict[str, Any] = {"linestyle": "none", "color": "#333333", "markersize": 3.2, "markeredgewidth": 0.7}
        marks = Line2D(times, [1.0] * len(times), marker=shape, gid=RUG, clip_on=False, **look)
        marks.set_transform(across)
        marks.set_in_layout(bool(times))  # without data, its box would be at the corner of the figure
        axes.add_artist(marks)


def rug_height(axes: Axes) -> float:
    """Return the height of the marks above axes [point]."""
    return RUG_ROW * len(rug_rows(axes))


def rug_rows(axes: Axes) -> list[Line2D]:
    """Return the rows of marks above axes, from bottom to top."""
    return [part for part in axes.lines if part.get_gid() == RUG]


def _raised(axes: Axes, points: float) -> Transform:
    """Return the coordinates of axes, moved up [point]."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    return axes.transAxes + ScaledTranslation(0.0, points / 72.0, figure.dpi_scale_trans)


def legend_below(figure: Drawing, panels: Sequence[Axes], columns: int) -> None:
    """Place one legend for several panels below the figure."""
    figure.put_below(legend_entries(panels), columns)


def legend_entries(panels: Sequence[Axes]) -> dict[str, Any]:
    """Return the entries of the legends of panels by label, each once."""
    unique: dict[str, Any] = {}
    for axes in panels:
        for artist in [*axes.get_children(), *axes.containers]:
            label = artist.get_label() if isinstance(artist, (Line2D, Patch, Collection, Container)) else ""
            # A name may begin with an underscore, as the labels that matplotlib sets itself.
            if label and not _UNLISTED.fullmatch(str(label)):
                unique.setdefault(str(label), artist)
    return unique


def visible(label: str) -> str:
    """Return a label that legends of matplotlib before 3.10 do not omit."""
    return f" {label}" if label.startswith("_") else label


def sparse(points: Array) -> Array:
    """Thin a curve in space to at most about ``LINE_POINTS`` points."""
    kept = np.linspace(0, len(points) - 1, min(len(points), LINE_POINTS)).astype(int)
    return points[kept]


def line(axes: Axes, time: Array, values: Array, **options: Any) -> None:
    """Plot a quantity over time; a single sample is a dot."""
    axes.plot(time, values, marker="o" if len(time) == 1 else None, markersize=3, **options)


def time_rows(
    figure: Drawing, rows: Sequence[Sequence[Series]], settle: float, *, compress: bool = False, zero: bool = True
) -> list[tuple[Axes, ...]]:
    """Create axes for quantities over time, one row each, with a column for the initial transient if needed.

    If the transient would compress the settled range of a row to less than two thirds of the height, it gets an
    enlarged panel on the left, and the axes on the right are limited to the settled range. A transient that lasts for
    most of the run gets no panel, because the panel would repeat the run. Without a panel, as in narrow figures, axes
    are cut only if less than ``SHORT`` % of the samples exceed them.

    Parameters
    ----------
    figure : Drawing
        Figure to which the axes are added.
    rows : sequence of sequences of Series
        For each row, the series that will be drawn in it.
    settle : float
        Time from which on the values count as settled [s].
    compress : bool, optional
        Use a logarithmic scale beyond the settled range in the transient panel.
    zero : bool, optional
        Include zero in the settled range.

    Returns
    -------
    list of tuple of Axes
        For each row, the axes (transient, whole run) or (whole run,); draw all curves in all of them.
    """
    end = max(time[-1] for row in rows for time, _ in row)
    longest = TRANSIENT_MAX_SHARE * end / TRANSIENT_ROOM
    transients = [_cut(row, settle, zero, longest) for row in rows]
    window = max((transient.end for transient in transients if transient is not None), default=0.0)
    split = window > 0.0
    grid = figure.subplots(
        len(rows), 1 + split, sharex="col", squeeze=False, width_ratios=[1.0, 2.4] if split else [1.0]
    )
    for transient, axes in zip(transients, grid, strict=True):
        if end > 0.0:
            axes[-1].set_xlim(0.0, end)
        if split:
            axes[0].set_xlim(0.0, TRANSIENT_ROOM * window)
        if transient is not None:
            axes[-1].set_ylim(transient.low, transient.high)
        if transient is not None and split and compress:
            _compress(axes[0], transient)
        if transient is not None and not transient.end:
            # No curve is outside of the axes, on the right.
            text = f"range {' … '.join(number(peak, 3) for peak in transient.peaks)}"
            look: dict[str, Any] = {"rotation": 90, "va": "center", "color": NOTE, "fontsize": letters(6.5)}
            axes[-1].text(1.01, 0.5, text, transform=axes[-1].transAxes, **look)
    for axis in grid[-1]:
        axis.set_xlabel("time [s]")
    if split:
        grid[-1, 0].set_xlabel("time [s]: initial transient")
        grid[-1, 1].set_xlabel("time [s]: whole run, axes cut to the settled range")
    if any(transient is not None and not transient.end for transient in transients):
        figure.note("Short peaks exceed the axes (range: with them).")
    return [tuple(axes) for axes in grid]


@dataclass(frozen=True)
class Transient:
    """End of a row's transient [s], range of the row's axis afterwards, and extremes of the whole run."""

    end: float
    low: float
    high: float
    peaks: tuple[float, float]


def _cut(row: Sequence[Series], settle: float, zero: bool, longest: float) -> Transient | None:
    """Return the transient of a row if it gets a panel, or the range without peaks in a few samples, or None."""
    transient = _transient(row, settle, zero, longest)
    if transient is not None and not narrow():
        return transient
    for ranged in filter(None, (transient, _spike(row))):
        lasting = [out for time, out in _beyond(row, ranged.low, ranged.high) if time[-1] > time[0]]
        if 100.0 * max((float(out.mean()) for out in lasting), default=1.0) < SHORT:
            return replace(ranged, end=0.0)
    return None


def _transient(row: Sequence[Series], settle: float, zero: bool, longest: float) -> Transient | None:
    """Return the transient of a row, or None if it is too long or the axis of the row need not be limited."""
    settled = np.concatenate([values[time >= settle].ravel() for time, values in row])
    everything = np.concatenate([values.ravel() for _, values in row])
    settled, everything = settled[np.isfinite(settled)], everything[np.isfinite(everything)]
    if settled.size < 2:
        return None
    low, high = float(settled.min()), float(settled.max())
    if high - low < (FLAT if zero else 0.2 * FLAT) * max(-low, high) or zero:
        low, high = min(low, 0.0), max(high, 0.0)
    span = high - low
    if span <= 0.0 or np.ptp(np.append(everything, [low, high])) < 1.5 * span:
        return None
    # A part that is cut leaves space, so that the settled range is not at the edge.
    within = (float(everything.min()) - 0.05 * span, float(everything.max()) + 0.05 * span)
    low, high = min(low, max(low - HEADROOM * span, within[0])), max(high, min(high + HEADROOM * span, within[1]))
    end = max((float(time[out][-1]) for time, out in _beyond(row, low, high) if out.any()), default=0.0)
    # The panel also shows a little of the settled range.
    end, peaks = max(1.5 * end, 0.02 * settle), (float(everything.min()), float(everything.max()))
    return Transient(end, low, high, peaks) if end < longest else None


def _spike(row: Sequence[Series]) -> Transient | None:
    """Return the range of a row without peaks that last for an instant, if they would flatten the rest, or None."""
    values = np.concatenate([values.ravel() for _, values in row])
    values = np.append(values[np.isfinite(values)], 0.0)
    peaks, (low, high) = (float(values.min()), float(values.max())), np.percentile(values, [SHORT, 100.0 - SHORT])
    if not 0.0 < SPIKE * (high - low) < peaks[1] - peaks[0]:
        return None
    room = HEADROOM * (high - low)
    return Transient(0.0, max(peaks[0], low - room), min(peaks[1], high + room), peaks)


def _beyond(row: Sequence[Series], low: float, high: float) -> list[tuple[Array, Any]]:
    """Return the times of each series, and whether any of its values is outside of a range then."""
    return [(time, ((y < low) | (y > high)).reshape(len(time), -1).any(axis=1)) for time, y in row]


def _compress(axes: Axes, transient: Transient) -> None:
    """Make the axis linear within the settled range and logarithmic beyond it, so that a peak hides no details."""
    settled = max(abs(transient.low), abs(transient.high))
    largest = max(map(abs, transient.peaks))
    if largest > 3.0 * settled:
        axes.set_yscale("symlog", linthresh=settled)
        steps = [m * 10.0**k for k in range(-9, 10) for m in (1, 3)]
        ticks = [step for step in steps if 0.5 * settled <= step <= largest]
        axes.set_yticks([-tick for tick in ticks[::-1]] + [0.0, *ticks])
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
        axes.yaxis.set_minor_locator(NullLocator())
        # Curves have a kink at the point where the scale changes, so the figure states the scale.
        text = f"logarithmic beyond ±{number(settled, 2)}"
        axes.text(0.98, 0.03, text, transform=axes.transAxes, ha="right", color=GREY, fontsize=letters(6.5))
