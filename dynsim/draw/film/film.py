"""A film of one or several robots side by side, with a clock and a plot with a cursor."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from dynsim.draw.figures.style import GREY, VARIANT_COLOURS
from dynsim.draw.figures.style import title as titled
from dynsim.draw.film import encode
from dynsim.draw.film.painter import FINER, PAPER, Painter
from dynsim.draw.film.strip import Strip
from dynsim.draw.film.strokes import font
from dynsim.draw.geometry.camera import FROM, Camera, View, view_axes
from dynsim.draw.geometry.robot import Array, azimuth, bounds, robots
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.system.files import replacing
from dynsim.system.terminal import plain

# Heights of the title, and of the plot as a part of the picture.
HEAD, PLOT = 26, 0.24
# Least height of the plot, and least size of a film that has one [pixel].
PLOT_MIN, WITH_PLOT = 84, (240, 220)
# Margin around a robot: at most [pixel], and as a part of a small picture.
ROOM, ROOM_SHARE = 14, 0.05
# Least width and height of the picture of one robot [pixel].
CELL_MIN = 60
SIZE_MIN, SIZE_MAX = 160, 4096
FPS_MAX, SPEED_MAX = 120, 1000.0


class Film:
    """Frames of records at equal steps of their common time.

    Parameters
    ----------
    records : one, or several that are shown beside each other
    view : "side", "top" or "iso"
    size : width and height [pixel], even numbers
    speed : of the film, 1: as fast as the motion was
    fps : frames a second
    plot : signal below the robots, None: one that suits them where there is room, "": none

    Raises
    ------
    RecordError
        A record has nothing to be seen, the signal is not there, or a number is beyond bounds.
    """

    def __init__(
        self,
        records: Mapping[str, Record],
        *,
        view: View = "iso",
        size: tuple[int, int] = (960, 540),
        speed: float = 1.0,
        fps: int = 25,
        plot: str | None = None,
    ) -> None:
        if view not in FROM:
            raise RecordError(f"a film is seen from {', '.join(FROM)}, not {view!r}")
        _check(size, speed, fps)
        self.size, self.fps = size, fps
        shown = robots(records)
        self.times = _times(records, speed, fps)
        encode.check_length("", len(self.times), size)
        self._speed = speed
        kept = {name: records[name] for name in shown}
        width, height = size
        strip = (width, max(round(PLOT * height), PLOT_MIN))
        has_room = width >= WITH_PLOT[0] and height >= WITH_PLOT[1]
        if plot and not has_room:
            raise RecordError(f"a film with a plot is at least {WITH_PLOT[0]}x{WITH_PLOT[1]}, not {width}x{height}")
        self._strip = Strip(kept, strip, plot) if plot != "" and has_room else None
        has_plot = self._strip is not None and self._strip.signal is not None
        self._area = (0, HEAD, width, height - (strip[1] if has_plot else 0))
        some = list(shown.values())
        axes = view_axes(view, azimuth(some))
        low, high = bounds(some, axes)
        self._places, cell = _layout(len(some), self._area, high - low)
        if min(cell) < CELL_MIN:
            raise RecordError(f"{len(some)} robots need a larger --size than {width}x{height}, or fewer records")
        room = min(ROOM, round(ROOM_SHARE * min(cell)))
        area = [room * FINER, room * FINER, (cell[0] - room) * FINER, (cell[1] - room) * FINER]
        if len(some) > 1:
            area[1] += 14 * FINER
        camera = Camera.fitted(axes, low, high, (area[0], area[1], area[2], area[3]))
        self.painters = {
            name: Painter(
                robot,
                camera,
                cell,
                bounds(some),
                tint=VARIANT_COLOURS[k % len(VARIANT_COLOURS)],
                title=plain(name) if len(some) > 1 else "",
            )
            for k, (name, robot) in enumerate(shown.items())
        }
        first = next(iter(kept.values()))
        name = first.provenance.get("scenario", {}).get("name", "")
        title = titled(first, "").replace(":  (", " (").rstrip(": ")
        self._title = plain(str(name) if len(some) > 1 else title)

    def frame(self, time: float) -> Image.Image:
        """The picture at an instant of the records [s]."""
        image = Image.new("RGB", self.size, PAPER)
        for corner, painter in zip(self._places, self.painters.values(), strict=True):
            image.paste(painter.frame(time), corner)
        draw = ImageDraw.Draw(image)
        draw.text((10, 5), self._title, fill="#202428", font=font(13))
        clock = f"{time:.2f} s" + (f"  ({self._speed:.3g}×)" if self._speed != 1.0 else "")
        draw.text((self.size[0] - 10, 5), clock, fill="#202428", font=font(13), anchor="ra")
        if len(self._places) > 1:
            for x, y in self._places:
                if x > 0:
                    draw.line([x, y, x, self._area[3]], fill=GREY)
        if self._strip is not None and (strip := self._strip.frame(time)) is not None:
            image.paste(strip, (0, self._area[3]))
        return image

    def frames(self, done: Callable[[int], None] = lambda count: None) -> Iterator[Image.Image]:
        """All pictures; ``done`` is told how many there were."""
        for k, time in enumerate(self.times.tolist(), start=1):
            yield self.frame(time)
            done(k)


def write(
    records: Mapping[str, Record],
    path: str | os.PathLike[str],
    *,
    view: View = "iso",
    size: tuple[int, int] = (960, 540),
    speed: float = 1.0,
    fps: int = 25,
    hold: float = 1.0,
    plot: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write a film of records, ``.gif`` or ``.mp4``: complete or not at all.

    Parameters
    ----------
    records, view, size, speed, fps, plot : see :class:`Film`
    hold : how long the last frame stays [s]
    progress : is told after each frame how many of how many there are

    Raises
    ------
    RecordError
        As :class:`Film`; another kind of file; PyAV is not installed, which an MP4 needs; the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if not (math.isfinite(hold) and 0.0 <= hold <= 60.0):
        raise RecordError(f"the last frame can be held for 0 to 60 s, not {hold:g}")
    encode.check(kind, fps)
    film = Film(records, view=view, size=size, speed=speed, fps=fps, plot=plot)
    total = len(film.times)
    encode.check_length(kind, total, size)
    frames = film.frames(lambda done: progress(done, total))
    with replacing(path) as stream:
        if kind == "gif":
            some = np.unique(np.linspace(0, total - 1, encode.SAMPLED).astype(int))
            encode.write_gif(stream, frames, (film.frame(float(film.times[k])) for k in some), total, fps, hold)
        else:
            encode.write_mp4(stream, frames, fps, hold)
    return path


def _check(size: tuple[int, int], speed: float, fps: int) -> None:
    if any(side % 2 or not SIZE_MIN <= side <= SIZE_MAX for side in size):
        raise RecordError(f"width and height are even numbers from {SIZE_MIN} to {SIZE_MAX}, not {size[0]}x{size[1]}")
    if not (math.isfinite(speed) and 0.0 < speed <= SPEED_MAX):
        raise RecordError(f"the speed of a film is more than 0 and at most {SPEED_MAX:g}, not {speed:g}")
    if not 1 <= fps <= FPS_MAX:
        raise RecordError(f"a film has 1 to {FPS_MAX} frames a second, not {fps}")


def _times(records: Mapping[str, Record], speed: float, fps: int) -> Array:
    """Instants of the frames, the last one that of the last sample."""
    start = min((float(record.time[0]) for record in records.values() if len(record)), default=0.0)
    end = max((float(record.time[-1]) for record in records.values() if len(record)), default=0.0)
    frames = (end - start) * fps / speed
    if not frames < encode.FRAMES_MAX:  # before there is a table of them
        raise RecordError(f"{frames:.3g} frames are no film; take a higher --speed or a lower --fps")
    steps = math.ceil(round(frames, 6))
    return np.minimum(start + np.arange(steps + 1) * (speed / fps), end)


def _layout(count: int, area: tuple[int, int, int, int], seen: Array) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Places and size of so many pictures in an area, in the rows and columns that show robots largest.

    Parameters
    ----------
    seen : (3,) size of what is shown: right, up, near [m]
    """
    left, top, right, bottom = area
    wide, high = np.maximum(seen[:2], 1e-9)
    best, shape = -1.0, (1, count)
    for columns in range(1, count + 1):
        rows = -(-count // columns)
        scale = min((right - left) / columns / wide, (bottom - top) / rows / high)
        if scale > best:
            best, shape = scale, (rows, columns)
    rows, columns = shape
    cell = (right - left) // columns, (bottom - top) // rows
    places = [(left + k % columns * cell[0], top + k // columns * cell[1]) for k in range(count)]
    return places, cell
