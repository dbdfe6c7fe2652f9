"""Lines, dashes, arrows, rings and labels drawn on an image, in pixels; the font of films."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw, ImageFont

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """The font that matplotlib brings, so that films look the same everywhere."""
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), size)


def line(draw: ImageDraw.ImageDraw, points: Array, colour: tuple[int, ...], width: int) -> None:
    """A path through points, (n, 2) [pixel]."""
    if len(points) > 1:
        draw.line(points.ravel().tolist(), fill=colour, width=width, joint="curve")


def dashes(draw: ImageDraw.ImageDraw, points: Array, length: float, colour: str, width: int) -> None:
    """A path as dashes that are as long as their gaps [pixel]."""
    if len(points) < 2:
        return
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    for start in np.arange(0.0, distance[-1], 2.0 * length):
        ends = np.linspace(start, min(start + length, distance[-1]), 5)
        dash = np.stack([np.interp(ends, distance, points[:, k]) for k in (0, 1)], axis=1)
        draw.line(dash.ravel().tolist(), fill=colour, width=width)


def arrow(draw: ImageDraw.ImageDraw, tail: Array, head: Array, colour: str, width: int) -> None:
    """From tail to head [pixel], its head filled."""
    along = head - tail
    size = float(np.linalg.norm(along))
    if size < 1e-6:
        return
    along = along / size
    across = np.array([-along[1], along[0]])
    long = min(3.4 * width, size)
    neck = head - long * along
    draw.line([*tail.tolist(), *neck.tolist()], fill=colour, width=width)
    corners: Sequence[Array] = (head, neck + 0.45 * long * across, neck - 0.45 * long * across)
    draw.polygon([tuple(corner.tolist()) for corner in corners], fill=colour)


def ring(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: str, width: int) -> None:
    """A circle about a dot [pixel]."""
    draw.circle((x, y), radius, outline=colour, width=width)
    draw.circle((x, y), 2, fill=colour)


def labels(
    draw: ImageDraw.ImageDraw,
    texts: Sequence[tuple[str, Array, str]],
    face: ImageFont.FreeTypeFont,
    size: tuple[int, int],
    paper: str,
) -> list[Box]:
    """Texts above their places, on paper of their own: over what is there, within the picture, beside each other.

    Parameters
    ----------
    texts : text, middle of its lower edge (2,), colour
    size : of the picture

    Returns
    -------
    list
        Where they are: left, top, right, bottom.
    """
    edge = 0.2 * face.size
    boxes: list[Box] = []
    for text, anchor, colour in texts:
        width, height = draw.textlength(text, font=face) + 2.0 * edge, 1.1 * face.size
        x = min(max(float(anchor[0]) - 0.5 * width, 0.0), size[0] - width)
        y = min(max(float(anchor[1]) - height, 0.0), size[1] - height)
        for _ in texts:
            # Above what it would hide.
            hidden = [box for box in boxes if x < box[2] and box[0] < x + width and y < box[3] and box[1] < y + height]
            if not hidden:
                break
            y = min(box[1] for box in hidden) - height
        boxes.append((x, y, x + width, y + height))
        draw.rounded_rectangle(boxes[-1], radius=edge, fill=paper)
        draw.text((x + 0.5 * width, y + 0.5 * height), text, fill=colour, font=face, anchor="mm")
    return boxes
