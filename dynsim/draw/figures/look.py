"""Look of figures as a user asks for it: size, font, style sheets, title and caption; matplotlib is not imported."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dynsim.errors import RecordError, brief

# Widths and heights of figures that can be drawn [inch], and sizes of letters [point].
LEAST, MOST = 1.0, 40.0
SMALLEST, LARGEST = 3.0, 40.0
INCHES = {"": 1.0, "in": 1.0, "mm": 1.0 / 25.4, "cm": 1.0 / 2.54}
_SIZE = re.compile(r"([0-9]*\.?[0-9]+)(?:[x×]([0-9]*\.?[0-9]+))?\s*(in|mm|cm)?")


@dataclass(frozen=True)
class Look:
    """Size, font and style of figures.

    Attributes
    ----------
    width, height : float or None
        Size [inch]; None: as wide as a page, and as high as the contents of each figure require.
    family : str or None
        Font family, such as "serif" or "Arial"; None: that of matplotlib's settings.
    points : float or None
        Size of the letters of labels [point]; None: 8.5, or that of matplotlib's settings.
    styles : tuple of str
        Names or files of matplotlib style sheets; later ones take precedence.
    title, caption : bool
        Whether the figure has a title above, and notes below the axes.
    panels : tuple of str
        Names of panels to draw, or parts of them; empty: all panels.
    film : bool
        Whether an animation is written next to the figures of a snake.
    """

    width: float | None = None
    height: float | None = None
    family: str | None = None
    points: float | None = None
    styles: tuple[str, ...] = ()
    title: bool = True
    caption: bool = True
    panels: tuple[str, ...] = ()
    film: bool = True

    @classmethod
    def of(
        cls,
        size: float | tuple[float, float] | str | None = None,
        font: float | str | None = None,
        style: str | Path | Sequence[str | Path] | None = None,
        *,
        title: bool = True,
        caption: bool = True,
        panels: str | Sequence[str] | None = None,
    ) -> Look:
        """Return the look that a user describes.

        Parameters
        ----------
        size : float, tuple of float or str, optional
            Width, or width and height [inch]; also text such as "3.4", "3.4x2.4" or "86mm".
        font : float or str, optional
            Size of the letters [point], a family, or both: 8, "serif", "serif 8".
        style : str, Path or sequence of them, optional
            Names or files of matplotlib style sheets; in a text, commas separate them.
        title, caption : bool, optional
            Whether the figure has a title above, and notes below the axes.
        panels : str or sequence of str, optional
            Names of panels to draw, or parts of them; in a text, commas separate them. Default: all panels.

        Raises
        ------
        RecordError
            If a value has another form, or the size is not between 1 and 40 inches or 3 and 40 points.
        """
        width, height = _size(size)
        family, points = _font(font)
        sheets = _list((str(style),) if isinstance(style, Path) else style)
        return cls(width, height, family, points, sheets, title, caption, _list(panels))


def _list(names: str | Sequence[str | Path] | None) -> tuple[str, ...]:
    if isinstance(names, str):
        names = [name.strip() for name in names.split(",")]
    return tuple(filter(None, map(str, names or ())))


def _size(size: float | tuple[float, float] | str | None) -> tuple[float | None, float | None]:
    if size is None:
        return None, None
    if isinstance(size, str):
        match = _SIZE.fullmatch(size.strip())
        if match is None:
            raise RecordError(f"size {brief(size)}: must be WIDTH or WIDTHxHEIGHT, such as 3.4, 3.4x2.4 or 86x60mm")
        values = [float(part) * INCHES[match[3] or ""] for part in match.groups()[:2] if part]
    else:
        parts = size if isinstance(size, Sequence) else (size,)
        if not 1 <= len(parts) <= 2 or any(isinstance(part, bool) for part in parts):
            raise RecordError(f"size {brief(size)}: must be a width, or a pair of width and height [inch]")
        values = [float(min(part, 2.0 * MOST)) for part in parts]
    for value in values:
        if not LEAST <= value <= MOST:
            raise RecordError(f"size {brief(size)}: each side must be between {LEAST:g} and {MOST:g} inches")
    return values[0], values[1] if len(values) == 2 else None


def _font(font: float | str | None) -> tuple[str | None, float | None]:
    if font is None:
        return None, None
    words = font.split() if isinstance(font, str) else [str(font)]
    points = None
    try:
        points = float(words[-1])
        words.pop()
    except (ValueError, IndexError):
        pass
    if points is not None and not (math.isfinite(points) and SMALLEST <= points <= LARGEST):
        raise RecordError(
            f"font {brief(font)}: the size of letters must be between {SMALLEST:g} and {LARGEST:g} points"
        )
    if points is None and not words:
        raise RecordError("font: must be a size in points, a family, or both, such as 8, serif, or serif 8")
    return " ".join(words) or None, points
