"""A film of one or several robots side by side, with a clock and a plot with a cursor."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageColor, ImageDraw

from dynsim.draw.figures import style
from dynsim.draw.figures.style import GREY, PULLING, VARIANT_COLOURS
from dynsim.draw.figures.style import title as titled
from dynsim.draw.film.painter import FINER, FROM, PAPER, Camera, Painter, View, font, view_axes
from dynsim.draw.geometry.robot import Array, azimuth, bounds, robots
from dynsim.errors import RecordError
from dynsim.record import TIME, Record
from dynsim.system.files import replacing
from dynsim.system.terminal import plain

# The plot below the robots of a film: one signal over time, drawn once, with a moving cursor.


# Signals shown by default: the first of them that the record, or one of several records, has.
ONE = ("contact_normal_force", "wheel_load", "hand_error", "support_margin", "position_error", "power", "q", "phi")
SEVERAL = ("energy_electrical", "hand_error", "position_error", "tip_margin", "support_margin", "q", "phi")
DPI = 100
CURSOR = "#202428"
# Number of columns of a signal with lines of their own: the largest ones. A band shows the range of all columns.
NAMED = 4
# Least width of a plot with a legend beside it [pixel], and most letters of a name in it.
LEGEND_MIN, LETTERS = 400, 16
# Height of one name in the legend [pixel]; names that do not fit are left out.
LEGEND_ROW = 14


class Strip:
    """A plot of one signal of all records over time, of a size [pixel].

    Parameters
    ----------
    signal : name, None for the first of a list that is there

    Raises
    ------
    RecordError
        No record has the signal, or it is no quantity over the record's time.
    """

    def __init__(self, records: Mapping[str, Record], size: tuple[int, int], signal: str | None = None) -> None:
        self._size = size
        self.signal = chosen(records, signal)
        self._image: Image.Image | None = None
        self.legend: tuple[str, ...] = ()
        if self.signal is not None:
            with style.look():
                self._draw(records, self.signal)

    def frame(self, time: float) -> Image.Image | None:
        """The plot with its cursor at an instant [s]; None where there is nothing to plot."""
        if self._image is None:
            return None
        image = self._image.copy()
        box = self._axes.get_window_extent()
        x, _ = self._axes.transData.transform((time, 0.0))
        ImageDraw.Draw(image).line([x, self._size[1] - box.y1, x, self._size[1] - box.y0], fill=CURSOR, width=2)
        return image

    def _draw(self, records: Mapping[str, Record], name: str) -> None:
        figure = Figure(figsize=(self._size[0] / DPI, self._size[1] / DPI), dpi=DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        colours, several = style.variant_styles(list(records)), len(records) > 1
        having = {label: record for label, record in records.items() if name in record}
        for label, record in having.items():
            values = record[name].reshape(len(record), -1)
            called = {} if record.scene is None else record.scene.wheel_names
            names = [called.get(text, text) for text in record.labels[name] or (name,) * values.shape[1]]
            many = values.shape[1] > 1
            shown = largest(values, 1 if several else NAMED)
            if len(shown) < values.shape[1]:
                colour, opacity = (colours[label]["color"], 0.2) if several else ("#CFCFCF", 1.0)
                low, high = np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)
                text = None if several else f"all {values.shape[1]}"
                axes.fill_between(record.time, low, high, color=colour, alpha=opacity, linewidth=0, label=text)
            for rank, k in enumerate(shown):
                colour = style.VARIANT_COLOURS[rank] if many and not several else colours[label]["color"]
                text = _cut(plain(label), LETTERS) if several else _cut(plain(names[k]), LETTERS)
                text += f": {_cut(plain(names[k]), LETTERS)}" if several and many else ""
                style.line(axes, record.time, values[:, k], color=colour, label=text)
        unit = next(iter(having.values())).units[name]
        title = f"{name.replace('_', ' ')}{f' [{unit}]' if unit not in ('', '1') else ''}"
        if several and any(record[name][0].size > 1 for record in having.values() if len(record)):
            title += ": largest by rms, and range of all"
        axes.set_title(title, fontsize=7.5, loc="left", pad=3)
        axes.set_xlabel("time [s]", fontsize=7, labelpad=0)
        axes.tick_params(labelsize=7)
        start = min(float(record.time[0]) for record in records.values())
        end = max(float(record.time[-1]) for record in records.values())
        axes.set_xlim(start, end if end > start else start + 1.0)
        axes.set_ylim(*_limits([record[name] for record in having.values()]))
        if several or len(axes.lines) > 1:
            handles, labels = axes.get_legend_handles_labels()
            # The range of all first: it lies behind the others.
            most = max((self._size[1] - 20) // LEGEND_ROW, 1)
            self.legend = tuple(labels[:most])
            look: dict[str, Any] = {"bbox_to_anchor": (1.0, 1.0), "fontsize": 6.5, "borderaxespad": 0.2}
            axes.legend(handles[:most], labels[:most], loc="upper left", **look)
        canvas.draw()
        self._image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        self._axes = axes


def largest(values: style.Array, count: int) -> list[int]:
    """Columns with the largest root mean square over time, at most so many, in their order; (T, n)."""
    effort = np.nan_to_num(values.astype(float) ** 2).sum(axis=0)
    return sorted(np.argsort(-effort, kind="stable")[:count].tolist())


def _cut(name: str, letters: int) -> str:
    return name if len(name) <= letters else name[: letters - 1] + "…"


def chosen(records: Mapping[str, Record], signal: str | None) -> str | None:
    """The signal to plot, see :class:`Strip`."""

    def plotted(name: str) -> bool:
        return any(
            name in r and r.signals[name].axis == TIME and r[name].ndim < 3 and r[name].size for r in records.values()
        )

    if signal is None:
        return next((name for name in (SEVERAL if len(records) > 1 else ONE) if plotted(name)), None)
    if not plotted(signal):
        names = sorted({name for record in records.values() for name in record if plotted(name)})
        raise RecordError(f"no signal {signal!r} over the record's time to plot; there are {', '.join(names)}")
    return signal


def _limits(values: list[style.Array]) -> tuple[float, float]:
    """Range of the axis: a spike at the start does not squeeze the rest."""
    pooled = np.concatenate([array.ravel() for array in values])
    pooled = pooled[np.isfinite(pooled)]
    if not len(pooled):
        return -1.0, 1.0
    low, high = float(pooled.min()), float(pooled.max())
    a, b = np.percentile(pooled, (1.0, 99.0)).tolist()
    if b > a and high - low > 4.0 * (b - a):
        low, high = max(low, a - 0.6 * (b - a)), min(high, b + 0.6 * (b - a))
    room = 0.06 * (high - low) or max(0.05 * abs(high), 1e-9)
    return low - room, high + room


# Writing of frames to a film file: GIF by Pillow, MP4 by PyAV; limits on its length.


# Largest frame rate of a GIF [1/s]: times are multiples of 0.01 s, and players slow down frames of less than 0.02 s.
GIF_FPS_MAX = 50
# Most pixels of all frames of a GIF, a byte each in memory.
GIF_PIXELS_MAX = 1_000_000_000
# Most frames of a film: more would take hours to paint.
FRAMES_MAX = 100_000
# Number of frames from which the palette of a GIF is made.
SAMPLED = 6
# Colours of a palette that differ by no more than this (of 255) are merged.
NEARLY = 9
# Quality parameter of H.264: smaller is better and gives larger files; 18 is almost the original.
QUALITY = 20


def check_length(kind: str, count: int, size: tuple[int, int]) -> None:
    """Refuse more frames than a film may have.

    Raises
    ------
    RecordError
        There are more; of a GIF all stay in memory until the last one is there.
    """
    if count > FRAMES_MAX:
        raise RecordError(f"{count} frames are no film; take a higher --speed or a lower --fps")
    if kind == "gif" and count * size[0] * size[1] > GIF_PIXELS_MAX:
        raise RecordError(
            f"a GIF of {count} frames of {size[0]}x{size[1]} pixels takes too much memory; write an .mp4, or take a "
            "higher --speed, a lower --fps or a smaller --size"
        )


def check(kind: str, fps: int) -> None:
    """Refuse what cannot be written, before the first frame is painted.

    Raises
    ------
    RecordError
        Another kind of file than "gif" and "mp4", PyAV is not installed, or too many frames a second for a GIF.
    """
    if kind not in ("gif", "mp4"):
        raise RecordError(
            f"a film is a file.mp4 or a file.gif, not .{kind}" if kind else "a film is FILE.mp4 or FILE.gif"
        )
    if kind == "gif" and fps > GIF_FPS_MAX:
        raise RecordError(
            f"a GIF has at most {GIF_FPS_MAX} frames a second, not {fps}; write an .mp4, or take a lower --fps"
        )
    if kind == "mp4":
        _av()


def write_gif(
    stream: BinaryIO, frames: Iterable[Image.Image], sampled: Iterable[Image.Image], count: int, fps: int, last_s: float
) -> None:
    """One palette for all frames, from those ``sampled``, so that nothing flickers; the last frame is held [s]."""
    palette = _palette(list(sampled))
    # Hundredths of a second, rounded so that none is lost over the film.
    ends = np.rint(100.0 * np.arange(count + 1) / fps).astype(int)
    times = (10 * np.diff(ends)).tolist()
    times[-1] += round(1000 * last_s)
    indexed = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first = next(indexed)
    first.save(stream, "GIF", save_all=True, append_images=indexed, duration=times, loop=0, optimize=True, disposal=1)


def _palette(frames: list[Image.Image]) -> Image.Image:
    width, height = frames[0].size
    sheet = Image.new("RGB", (width, height * len(frames)))
    for k, frame in enumerate(frames):
        sheet.paste(frame, (0, k * height))
    # Small marks have few pixels, and their colours must be told apart all the same; what is nearly one of them is it.
    kept = np.array([ImageColor.getrgb(colour) for colour in (*VARIANT_COLOURS, PULLING, GREY, "#FFFFFF")])
    colours = sheet.quantize(120, method=Image.Quantize.MEDIANCUT).getpalette() or []
    others = np.array(colours, dtype=int).reshape(-1, 3)[:120]
    others = others[np.abs(others[:, None] - kept).max(axis=2).min(axis=1) > NEARLY]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([kept, others]).ravel().tolist())
    return palette


def write_mp4(stream: BinaryIO, frames: Iterable[Image.Image], fps: int, last_s: float) -> None:
    """H.264 as every browser and office program plays it; the last frame is repeated for ``hold`` [s].

    Raises
    ------
    RecordError
        PyAV is not installed.
    """
    av = _av()
    frames = iter(frames)
    first = last = next(frames)
    with av.open(stream, "w", format="mp4") as container:
        options = {"crf": str(QUALITY), "preset": "veryfast"}
        track = container.add_stream("libx264", rate=Fraction(fps), options=options)
        track.width, track.height = first.size
        track.pix_fmt = "yuv420p"

        def add(frame: Image.Image) -> None:
            container.mux(track.encode(av.VideoFrame.from_ndarray(np.asarray(frame), format="rgb24")))

        add(first)
        for frame in frames:
            add(frame)
            last = frame
        for _ in range(round(last_s * fps)):
            add(last)
        container.mux(track.encode())


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise RecordError(
            "an .mp4 needs PyAV: pip install 'dynsim[video]'; or write a .gif, which needs nothing more"
        ) from error
    return av


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
        check_length("", len(self.times), size)
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
    check(kind, fps)
    film = Film(records, view=view, size=size, speed=speed, fps=fps, plot=plot)
    total = len(film.times)
    check_length(kind, total, size)
    frames = film.frames(lambda done: progress(done, total))
    with replacing(path) as stream:
        if kind == "gif":
            some = np.unique(np.linspace(0, total - 1, SAMPLED).astype(int))
            write_gif(stream, frames, (film.frame(float(film.times[k])) for k in some), total, fps, hold)
        else:
            write_mp4(stream, frames, fps, hold)
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
    if not frames < FRAMES_MAX:  # before there is a table of them
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
