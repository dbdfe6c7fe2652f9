"""What figures are drawn on: the same pixels as matplotlib's own, also after its fonts have changed."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from dynsim.figures import style
from dynsim.figures.canvas import Canvas


def picture() -> Figure:
    """Texts, a formula and lines."""
    figure = style.new_figure(2.0, "some text")
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 2e-7], label="$e_x$ of a line")
    axes.legend()
    return figure


def test_the_file_holds_the_pixels_that_matplotlib_draws(tmp_path: Path) -> None:
    for family in ("DejaVu Sans", "DejaVu Serif", "DejaVu Sans"):
        with matplotlib.rc_context({"font.sans-serif": [family]}), style.look():
            path = style.save(picture(), tmp_path / "figure.png")
            expected = picture()
            expected.set_dpi(style.DPI)
            canvas = FigureCanvasAgg(expected)
            canvas.draw()
        with Image.open(path) as image:
            assert np.allclose(image.info["dpi"], style.DPI, atol=0.02)  # files have whole dots per metre
            assert np.array_equal(np.asarray(image), np.asarray(canvas.buffer_rgba()))


def test_a_figure_of_another_size_gets_a_renderer_of_its_own() -> None:
    figure = style.new_figure(2.0, "size")
    canvas = Canvas(figure)
    first = canvas.get_renderer()
    assert canvas.get_renderer() is first
    figure.set_size_inches(3.0, 4.0)
    assert (canvas.get_renderer().width, canvas.get_renderer().height) == canvas.get_width_height(physical=True)
    assert canvas.get_renderer() is not first
