"""What figures are drawn on: matplotlib's Agg, which measures each text once for all figures, and writes PNG faster."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.font_manager import FontProperties, fontManager, get_font
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
# Width, height and descent [pixel] of texts, by resolution, text, font and whether it is a formula.
_sizes: dict[tuple[float, str, FontProperties, bool], tuple[float, float, float]] = {}
# Ascent, descent and gap of lines [pixel], by resolution, size and font.
_heights: dict[tuple[float, float, int], tuple[float, float, float]] = {}
# How much of each pixel texts cover, 0 to 255, and where the picture lies from their origin [pixel]; by angle too.
_pictures: dict[tuple[float, str, FontProperties, Any, float], tuple[Pixels, int, int]] = {}
# What they were measured with.
_settings: dict[str, Any] = {}
# Texts that are remembered; those of a folder of figures are some hundreds.
MOST = 4000
# Around the box of a text [pixel].
ROOM = 4


def heed_fonts() -> None:
    """For whoever changes matplotlib's settings: texts that were measured with other fonts are measured again."""
    parameters: Any = matplotlib.rcParams
    now = {key: value for key, value in parameters.items() if key.startswith(("font.", "text.", "mathtext."))}
    if now != _settings:
        _sizes.clear()
        _heights.clear()
        _pictures.clear()
        _settings.clear()
        _settings.update(now)


class _Renderer(RendererAgg):
    """matplotlib's remembers the size of a text for one figure; most texts of a folder of figures are in many."""

    def get_text_width_height_descent(self, s: str, prop: FontProperties, ismath: Any) -> tuple[float, float, float]:
        key = self.dpi, s, prop.copy(), ismath
        if key not in _sizes:
            _make_room(_sizes)
            _sizes[key] = super().get_text_width_height_descent(s, prop, ismath)
        return _sizes[key]

    def draw_text(
        self,
        gc: Any,
        x: float,
        y: float,
        s: str,
        prop: FontProperties,
        angle: float,
        ismath: Any = False,
        mtext: Any = None,
    ) -> None:
        """A text that begins at a whole pixel: then its picture is the same in all figures, and drawn once for all."""
        key = self.dpi, s, prop.copy(), ismath, angle
        if key not in _pictures:
            _make_room(_pictures)
            _pictures[key] = self._picture(s, prop, angle, ismath)
        covered, left, bottom = _pictures[key]
        image = np.empty((*covered.shape, 4), np.uint8)
        colour = gc.get_rgb()
        image[..., :3] = np.round(255.0 * np.array(colour[:3]))
        opaque = gc.get_alpha() if len(colour) == 3 or gc.get_forced_alpha() else colour[3]
        image[..., 3] = covered if opaque == 1.0 else np.round(opaque * covered)
        self.draw_image(gc, round(x) + left, int(self.height) - round(y) + bottom, image)

    def _picture(self, text: str, prop: FontProperties, angle: float, ismath: Any) -> tuple[Pixels, int, int]:
        """What a text covers, rows from the bottom; its lower left corner from the text's origin, upwards."""
        width, height, descent = self.get_text_width_height_descent(text, prop, ismath)
        turned = np.exp(1j * np.radians(angle))
        # Strokes may reach a little beyond the box.
        corners = turned * np.array(
            [x + 1j * y for x in (-ROOM, width + ROOM) for y in (-ROOM - descent, height + ROOM)]
        )
        left, bottom = int(np.floor(corners.real.min())), int(np.floor(corners.imag.min()))
        right, top = int(np.ceil(corners.real.max())), int(np.ceil(corners.imag.max()))
        sheet = RendererAgg(right - left, top - bottom, self.dpi)
        RendererAgg.draw_text(sheet, sheet.new_gc(), -left, top, text, prop, angle, ismath)
        covered = np.asarray(sheet.buffer_rgba())[::-1, :, 3]
        return np.ascontiguousarray(covered), left, bottom

    def _get_font_height_metrics(self, prop: FontProperties) -> tuple[float, float, float]:
        """Ascent, descent and gap of lines [pixel], which matplotlib 3.11 asks for at each layout of a text.

        It would read them from the font each time. The computation is its own; earlier versions never ask.
        """
        key = self.dpi, prop.get_size_in_points(), hash(prop)
        if key not in _heights:
            font: Any = get_font(fontManager.findfont(prop))
            table, names = font.get_sfnt_table("OS/2"), ("sTypoAscender", "sTypoDescender", "sTypoLineGap")
            if table is None:
                table, names = font.get_sfnt_table("hhea"), ("ascent", "descent", "lineGap")
            scale = prop.get_size_in_points() * self.dpi / (72.0 * font.get_sfnt_table("head")["unitsPerEm"])
            ascent, descent, gap = (table[name] * scale for name in names)
            _heights[key] = ascent, -descent, gap
        return _heights[key]


def _make_room(texts: dict[Any, Any]) -> None:
    if len(texts) >= MOST:
        texts.clear()


class Canvas(FigureCanvasAgg):
    """A canvas that belongs to no window."""

    def get_renderer(self) -> RendererAgg:
        width, height = self.get_width_height(physical=True)
        now = getattr(self, "renderer", None)
        if now is None or (now.width, now.height, now.dpi) != (width, height, self.figure.dpi):
            self.renderer = _Renderer(width, height, self.figure.dpi)
        return self.renderer

    def png(self) -> bytes:
        """Draw the figure at its own resolution, once; ``savefig`` draws twice, the first time for the layout."""
        self.draw()
        return png(np.asarray(self.buffer_rgba()), self.figure.dpi)


def png(pixels: NDArray[np.uint8], dpi: float) -> bytes:
    """A PNG of opaque pixels, (height, width, 4), with their number per inch.

    Rows are not filtered: figures are flat areas, which shrink as well without, and to try all filters on each row, as
    Pillow does, takes twice as long as all the rest.
    """
    height, width, _ = pixels.shape
    rows = np.zeros((height, 1 + 3 * width), np.uint8)  # the first byte says: no filter
    for k in range(3):  # three copies take a third of the time of one that has the colours innermost
        rows[:, 1 + k :: 3] = pixels[..., k]
    per_metre = round(dpi / 0.0254)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1)),
        (b"IDAT", zlib.compress(rows.data, 3)),
        (b"IEND", b""),
    )
    framed = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)
