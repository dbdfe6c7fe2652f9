"""Film of one robot or several side by side, with a clock and a plot with a time cursor, encoded as GIF or MP4."""

from __future__ import annotations

import itertools
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
from dynsim.draw.film.painter import FINER, PAPER, Camera, Painter, font, largest
from dynsim.draw.geometry.projection import FROM, View, view_axes
from dynsim.draw.geometry.robot import Array, azimuth, bounds, framed, robots
from dynsim.errors import RecordError
from dynsim.record import TIME, Record
from dynsim.system import interruption
from dynsim.system.arguments import names_wrong_types
from dynsim.system.files import replacing
from dynsim.system.terminal import plain

# Signals plotted by default: the first of these that a record, or any of several records, contains.
SIGNALS_OF_ONE = (
    "contact_normal_force",
    "wheel_load",
    "hand_error",
    "support_margin",
    "position_error",
    "power",
    "q",
    "phi",
)
SIGNALS_OF_SEVERAL = ("energy_electrical", "hand_error", "position_error", "tip_margin", "support_margin", "q", "phi")
DPI = 100
CURSOR = "#202428"
# Number of columns of a signal that are drawn as lines (the largest by rms); a band shows the range of all columns.
NAMED = 4
# Maximum length of a name in the legend.
MAX_LETTERS = 16
# Height of a legend entry [pixel]; entries that do not fit are omitted.
LEGEND_ROW = 14
# Relative range of a signal below which it counts as constant.
CONSTANT = 1e-6


class Strip:
    """Plot of one signal of all records over time.

    Parameters
    ----------
    records : mapping of str to Record
        Names and records.
    size : tuple of int
        Width and height [pixel].
    signal : str, optional
        Name of the signal; default: the first default signal in the records.

    Raises
    ------
    RecordError
        If no record has the signal, or it cannot be plotted over the main time axis.
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
        """Return the plot with its cursor at a time [s], or None if no signal can be plotted."""
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
            has_columns = values.shape[1] > 1
            shown = largest(values, 1 if several else NAMED)
            if len(shown) < values.shape[1]:
                colour, opacity = (colours[label]["color"], 0.2) if several else ("#CFCFCF", 1.0)
                low, high = np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)
                text = None if several else f"all {values.shape[1]}"
                axes.fill_between(record.time, low, high, color=colour, alpha=opacity, linewidth=0, label=text)
            for rank, k in enumerate(shown):
                colour = style.VARIANT_COLOURS[rank] if has_columns and not several else colours[label]["color"]
                text = _cut(plain(label), MAX_LETTERS) if several else _cut(plain(names[k]), MAX_LETTERS)
                text += f": {_cut(plain(names[k]), MAX_LETTERS)}" if several and has_columns else ""
                style.line(axes, record.time, values[:, k], color=colour, label=text)
        unit = next(iter(having.values())).units[name]
        title = f"{name.replace('_', ' ')}{f' [{unit}]' if unit not in ('', '1') else ''}"
        if several and any(record[name][0].size > 1 for record in having.values() if len(record)):
            title += ": largest by rms, and range of all columns"
        axes.set_title(title, fontsize=7.5, loc="left", pad=3)
        axes.set_xlabel("time [s]", fontsize=7, labelpad=0)
        axes.tick_params(labelsize=7)
        axes.ticklabel_format(axis="y", useOffset=False)
        start = min(float(record.time[0]) for record in records.values())
        end = max(float(record.time[-1]) for record in records.values())
        axes.set_xlim(start, end if end > start else start + 1.0)
        axes.set_ylim(*_limits([record[name] for record in having.values()]))
        if several or len(axes.lines) > 1:
            entries = style.legend_entries([axes])
            # The range of all columns is the first entry, because it is drawn behind the lines.
            most = max((self._size[1] - 20) // LEGEND_ROW, 1)
            self.legend = tuple(entries)[:most]
            look: dict[str, Any] = {"bbox_to_anchor": (1.0, 1.0), "fontsize": 6.5, "borderaxespad": 0.2}
            axes.legend([*entries.values()][:most], map(style.visible, self.legend), loc="upper left", **look)
        style.literal(figure)
        canvas.draw()
        self._image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        self._axes = axes


def _cut(name: str, letters: int) -> str:
    return name if len(name) <= letters else name[: letters - 1] + "…"


def chosen(records: Mapping[str, Record], signal: str | None) -> str | None:
    """Return the signal to plot, see :class:`Strip`."""

    def plotted(name: str) -> bool:
        return any(
            name in r and r.signals[name].axis == TIME and r[name].ndim < 3 and r[name].size for r in records.values()
        )

    if signal is None:
        return next(
            (name for name in (SIGNALS_OF_SEVERAL if len(records) > 1 else SIGNALS_OF_ONE) if plotted(name)), None
        )
    if not plotted(signal):
        names = sorted({name for record in records.values() for name in record if plotted(name)})
        raise RecordError(f"no signal {signal!r} that can be plotted over time; choices: {', '.join(names)}")
    return signal


def _limits(values: list[style.Array]) -> tuple[float, float]:
    """Return the range of the axis; a spike that would compress the rest of the curve is cut off.

    A constant signal has a range around it that hides its rounding errors.
    """
    pooled = np.concatenate([array.ravel() for array in values])
    pooled = pooled[np.isfinite(pooled)]
    if not len(pooled):
        return -1.0, 1.0
    low, high = float(pooled.min()), float(pooled.max())
    a, b = np.percentile(pooled, (1.0, 99.0)).tolist()
    if b > a and high - low > 4.0 * (b - a):
        low, high = max(low, a - 0.6 * (b - a)), min(high, b + 0.6 * (b - a))
    constant = max(abs(low), abs(high))
    room = 0.06 * (high - low) if high - low > CONSTANT * constant else max(0.05 * constant, 1e-9)
    return low - room, high + room


# Encoding: GIF with Pillow, MP4 with PyAV.

# Maximum frame rate of a GIF [1/s]: times are multiples of 0.01 s, and players slow down frames shorter than 0.02 s.
GIF_FPS_MAX = 50
# Maximum number of pixels of all frames of a GIF; each takes one byte of memory.
GIF_PIXELS_MAX = 1_000_000_000
# Maximum number of frames in a film; more frames would take hours to render.
FRAMES_MAX = 100_000
# Number of frames from which the palette of a GIF is computed.
SAMPLED = 6
# Palette colours that differ by no more than this (of 255) are merged.
NEARLY = 9
# Quality parameter (CRF) of H.264; smaller values give better quality and larger files, and 18 is nearly lossless.
QUALITY = 20


def check(kind: str, fps: int) -> None:
    """Check the format and the frame rate before the first frame is rendered.

    Raises
    ------
    RecordError
        If the format is not "gif" or "mp4", PyAV is not installed, or the frame rate is too high for a GIF.
    """
    if kind not in ("gif", "mp4"):
        raise RecordError(
            f"unknown film format .{kind}; use .mp4 or .gif" if kind else "the film file must end in .mp4 or .gif"
        )
    if kind == "gif" and fps > GIF_FPS_MAX:
        raise RecordError(f"--fps {fps} is too high for a GIF (limit {GIF_FPS_MAX}); write an .mp4, or lower --fps")
    if kind == "mp4":
        _av()


def write_gif(
    stream: BinaryIO, frames: Iterable[Image.Image], sampled: Iterable[Image.Image], count: int, fps: int, last_s: float
) -> None:
    """Write a GIF with a single palette, computed from ``sampled`` frames, which avoids flicker.

    ``last_s`` is the extra duration of the last frame [s].
    """
    palette = _palette(list(sampled))
    # Times in hundredths of a second; rounding the end times avoids accumulating errors over the film.
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
    # Keep the colours of marks, which have few pixels; similar colours are merged with them.
    kept = np.array([ImageColor.getrgb(colour) for colour in (*VARIANT_COLOURS, PULLING, GREY, "#FFFFFF")])
    colours = sheet.quantize(120, method=Image.Quantize.MEDIANCUT).getpalette() or []
    others = np.array(colours, dtype=int).reshape(-1, 3)[:120]
    others = others[np.abs(others[:, None] - kept).max(axis=2).min(axis=1) > NEARLY]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([kept, others]).ravel().tolist())
    return palette


def write_mp4(stream: BinaryIO, frames: Iterable[Image.Image], fps: int, last_s: float) -> None:
    """Write an H.264 video that all browsers and office programs can play.

    ``last_s`` is the extra duration of the last frame [s].

    Raises
    ------
    RecordError
        If PyAV is not installed.
    """
    av = _av()
    frames = iter(frames)
    first = next(frames)
    with av.open(stream, "w", format="mp4") as container:
        options = {"crf": str(QUALITY), "preset": "veryfast"}
        track = container.add_stream("libx264", rate=Fraction(fps), options=options)
        track.width, track.height = first.size
        track.pix_fmt = "yuv420p"

        def add(frame: Image.Image) -> None:
            container.mux(track.encode(av.VideoFrame.from_ndarray(np.asarray(frame), format="rgb24")))

        for frame in itertools.chain([first], frames):
            add(frame)
        for _ in range(round(last_s * fps)):
            add(frame)
        container.mux(track.encode())


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise RecordError("an .mp4 requires PyAV: pip install 'dynsim[video]'; or write a .gif") from error
    return av


# Height of the title [pixel], and of the plot relative to the frame.
HEAD, PLOT = 26, 0.24
# Minimum height of the plot, and minimum size of a film with a plot [pixel].
PLOT_MIN, WITH_PLOT = 84, (240, 220)
# Margin around a robot: maximum [pixel], and margin relative to a small frame.
ROOM, ROOM_SHARE = 14, 0.05
# Minimum width and height of the cell of one robot [pixel].
CELL_MIN = 60
SIZE_MIN, SIZE_MAX = 160, 4096
FPS_MAX, SPEED_MAX = 120, 1000.0


class Film:
    """Frames of records at equal steps of their common time axis.

    Parameters
    ----------
    records : mapping of str to Record
        Names and records; several are shown side by side.
    view : {"iso", "side", "top"}, optional
        View direction.
    size : tuple of int, optional
        Width and height [pixel], even numbers from 160 to 4096.
    speed : float, optional
        Playback speed; 1 is real time.
    fps : int, optional
        Frame rate [1/s], 1 to 120.
    plot : str, optional
        Signal to plot below the robots; "" for no plot; default: a signal is chosen automatically if there is space.

    Attributes
    ----------
    times : (n,) ndarray
        Times of the frames [s].
    size : tuple of int
        Width and height [pixel].
    fps : int
        Frame rate [1/s].

    Raises
    ------
    RecordError
        If no record can be shown, the signal does not exist, or a number is out of range.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows", overrides={"duration_s": 0.1})
    >>> film = dynsim.film.Film({"two elbows": dynsim.simulate(scenario)}, size=(320, 240), fps=20)
    >>> film.frame(0.05).size, len(film.times)
    ((320, 240), 3)
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
            raise RecordError(f"unknown view {view!r}; choices: {', '.join(FROM)}")
        _check(size, speed, fps)
        self.size, self.fps = size, fps
        shown = robots(records)
        self.times = _times(records, speed, fps)
        self._speed = speed
        kept = {name: records[name] for name in shown}
        width, height = size
        strip = (width, max(round(PLOT * height), PLOT_MIN))
        has_room = width >= WITH_PLOT[0] and height >= WITH_PLOT[1]
        if plot and not has_room:
            raise RecordError(
                f"a film with a plot must be at least {WITH_PLOT[0]}x{WITH_PLOT[1]} pixels, got {width}x{height}"
            )
        self._strip = Strip(kept, strip, plot) if plot != "" and has_room else None
        has_plot = self._strip is not None and self._strip.signal is not None
        self._area = (0, HEAD, width, height - (strip[1] if has_plot else 0))
        some = list(shown.values())
        axes = view_axes(view, azimuth(some))
        low, high = framed(some, axes)
        self._places, cell = _layout(len(some), self._area, high - low)
        if min(cell) < CELL_MIN:
            raise RecordError(
                f"--size {width}x{height} is too small for {len(some)} robots; increase it, or use fewer records"
            )
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
        title = titled(first, "").replace(":  (", " (").rstrip(": ")
        self._title = plain(first.scenario_name if len(some) > 1 else title)

    def frame(self, time: float) -> Image.Image:
        """Return the frame at a time.

        Parameters
        ----------
        time : float
            Time of the records [s].

        Returns
        -------
        PIL.Image.Image
            The frame.

        Examples
        --------
        See :class:`Film`.
        """
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
                if y > self._area[1]:
                    draw.line([0, y, self.size[0], y], fill=GREY)
        if self._strip is not None and (strip := self._strip.frame(time)) is not None:
            image.paste(strip, (0, self._area[3]))
        interruption.check()  # a signal that arrived while the kernel that fills faces was loaded is postponed
        return image

    def frames(self, done: Callable[[int], None] = lambda count: None) -> Iterator[Image.Image]:
        """Yield all frames.

        Parameters
        ----------
        done : callable, optional
            Called after each frame with the number of frames so far.

        Yields
        ------
        PIL.Image.Image
            The next frame.

        Examples
        --------
        See :class:`Film`.
        """
        for k, time in enumerate(self.times.tolist(), start=1):
            yield self.frame(time)
            done(k)


@names_wrong_types
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
    """Write a film of records atomically, as ``.gif`` or ``.mp4``.

    Parameters
    ----------
    records : mapping of str to Record
        Names and records; several are shown side by side.
    path : str or path-like
        File to write; its suffix determines the format.
    view : {"iso", "side", "top"}, optional
        View direction.
    size : tuple of int, optional
        Width and height [pixel], even numbers from 160 to 4096.
    speed : float, optional
        Playback speed; 1 is real time.
    fps : int, optional
        Frame rate [1/s], 1 to 120.
    hold : float, optional
        Extra duration of the last frame [s], 0 to 60.
    plot : str, optional
        Signal to plot below the robots; "" for no plot; default: a signal is chosen automatically if there is space.
    progress : callable, optional
        Called after each frame with the number of frames so far and in total.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    RecordError
        In the same cases as for :class:`Film`, and if the format is unknown, PyAV is missing for an MP4, the film has
        too many frames, or the file cannot be written.

    Examples
    --------
    >>> import dynsim, pathlib, tempfile
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows", overrides={"duration_s": 0.1})
    >>> records = {"two elbows": dynsim.simulate(scenario)}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = dynsim.film.write(records, pathlib.Path(folder) / "arm.gif", size=(320, 240), fps=20)
    >>> path.name
    'arm.gif'
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if not (math.isfinite(hold) and 0.0 <= hold <= 60.0):
        raise RecordError(f"hold must be 0 to 60 s, got {hold:g}")
    check(kind, fps)
    film = Film(records, view=view, size=size, speed=speed, fps=fps, plot=plot)
    total = len(film.times)
    if kind == "gif" and total * size[0] * size[1] > GIF_PIXELS_MAX:
        raise RecordError(
            f"a GIF of {total} frames of {size[0]}x{size[1]} pixels needs too much memory; write an .mp4, "
            "raise --speed, or lower --fps or --size"
        )
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
        raise RecordError(
            f"width and height must be even numbers from {SIZE_MIN} to {SIZE_MAX}, got {size[0]}x{size[1]}"
        )
    if not (math.isfinite(speed) and 0.0 < speed <= SPEED_MAX):
        raise RecordError(f"speed must be greater than 0 and at most {SPEED_MAX:g}, got {speed:g}")
    if not 1 <= fps <= FPS_MAX:
        raise RecordError(f"fps must be 1 to {FPS_MAX}, got {fps}")


def _times(records: Mapping[str, Record], speed: float, fps: int) -> Array:
    """Return the times of the frames; the last one is the time of the last sample."""
    start = min((float(record.time[0]) for record in records.values() if len(record)), default=0.0)
    end = max((float(record.time[-1]) for record in records.values() if len(record)), default=0.0)
    frames = (end - start) * fps / speed
    if not frames < FRAMES_MAX:  # check before the array of times is created
        raise RecordError(f"too many frames ({frames:.3g}, limit {FRAMES_MAX}); raise --speed or lower --fps")
    steps = math.ceil(round(frames, 6))
    return np.minimum(start + np.arange(steps + 1) * (speed / fps), end)


def _layout(count: int, area: tuple[int, int, int, int], seen: Array) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return the positions and size of ``count`` cells in an area, arranged so that the robots appear largest.

    Parameters
    ----------
    seen : (3,) ndarray
        Size of the scene: right, up, towards the viewer [m].
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
