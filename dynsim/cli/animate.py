"""Command ``dynsim animate``: writes a film of one or several records."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from dynsim.cli.app import QuietOption, TrustOption
from dynsim.cli.display import film_progress, labelled, say_written
from dynsim.errors import RecordError


class ViewName(StrEnum):
    iso = "iso"
    side = "side"
    top = "top"


def animate(
    records: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORD", help="Records (HDF5) or folders of runs; several are shown beside each other."
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The film: FILE.mp4 or FILE.gif.")],
    view: Annotated[ViewName, typer.Option(help="From where it is seen.")] = ViewName.iso,
    speed: Annotated[
        float, typer.Option(metavar="X", help="1: as fast as the motion was; 0.1: ten times slower.")
    ] = 1.0,
    size: Annotated[str, typer.Option(metavar="WxH", help="Width and height [pixel].")] = "960x540",
    fps: Annotated[int, typer.Option(metavar="N", help="Frames a second.")] = 25,
    hold: Annotated[float, typer.Option(metavar="S", help="How long the last frame stays [s].")] = 1.0,
    plot: Annotated[
        str | None,
        typer.Option(metavar="SIGNAL", help="Signal to plot below; default: one that suits, none: no plot."),
    ] = None,
    quiet: QuietOption = False,
    trust: TrustOption = False,
) -> None:
    """Write a film of records, without display or browser: bodies, forces, time, and a plot with a cursor."""
    from dynsim.draw.film import write
    from dynsim.draw.film.encode import check

    wanted = _size(size)
    check(out.suffix.lower().removeprefix("."), fps)
    named = labelled(records, trust=trust)
    with film_progress(quiet) as report:
        write(
            named,
            out,
            view=view.value,
            size=wanted,
            speed=speed,
            fps=fps,
            hold=hold,
            plot="" if plot == "none" else plot,
            progress=report,
        )
    if not quiet:
        say_written(out)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", text)
    if match is None:
        raise RecordError(f"--size is WIDTHxHEIGHT, such as 960x540, not {text!r}")
    return int(match[1]), int(match[2])
