"""What figures are drawn on: the pixels of matplotlib, texts at whole ones, also after its fonts have changed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from PIL import Image

from dynsim.draw.figures import style
from dynsim.draw.figures.canvas import Canvas


def picture() -> Figure:
    """Texts, a formula and lines."""
    figure = style.new_figure(2.0, "some text")
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 2e-7], label="$e_x$ of a line")
    axes.legend()
    axes.set(xlabel="across", ylabel="upwards, $x^2$")
    axes.text(0.3, 1e-7, "aslant and faint", rotation=30.0, color="red", alpha=0.4)
    return figure


def test_the_file_holds_the_pixels_that_matplotlib_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # matplotlib 3.11 draws texts at fractions of pixels, before it rounded as here.
    draw_text = RendererAgg.draw_text

    def rounding(self: RendererAgg, gc: Any, x: float, y: float, *rest: Any, **options: Any) -> None:
        draw_text(self, gc, round(x), round(y), *rest, **options)

    monkeypatch.setattr(RendererAgg, "draw_text", rounding)
    for family in ("DejaVu Sans", "DejaVu Serif", "DejaVu Sans"):
        with matplotlib.rc_context({"font.sans-serif": [family]}), style.look():
            path = style.save(picture(), tmp_path / "figure.png")
            expected = picture()
            expected.set_dpi(style.DPI)
            canvas = FigureCanvasAgg(expected)
            canvas.draw()
        with Image.open(path) as image:
            assert np.allclose(image.info["dpi"], style.DPI, atol=0.02)  # files have whole dots per metre
            drawn, wanted = np.asarray(image).astype(int), np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
            # Letters are blended with each other before the sheet, each time to a whole number.
            assert np.abs(drawn - wanted).max() <= 3
            assert np.ptp(wanted) == 255


def test_a_figure_of_another_size_gets_a_renderer_of_its_own() -> None:
    figure = style.new_figure(2.0, "size")
    canvas = Canvas(figure)
    first = canvas.get_renderer()
    assert canvas.get_renderer() is first
    figure.set_size_inches(3.0, 4.0)
    assert (canvas.get_renderer().width, canvas.get_renderer().height) == canvas.get_width_height(physical=True)
    assert canvas.get_renderer() is not first
