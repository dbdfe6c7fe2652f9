"""Writing of frames to a film file: GIF by Pillow, MP4 by PyAV; limits on its length."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from typing import Any, BinaryIO

import numpy as np
from PIL import Image, ImageColor

from dynsim.draw.figures.style import GREY, PULLING, VARIANT_COLOURS
from dynsim.errors import RecordError

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
