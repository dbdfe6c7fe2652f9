"""Drawing of figures and pages after runs, in this process or, for several runs, in one process per core."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynsim.cli.app import QuietOption, TrustOption
from dynsim.cli.tables import console, drawing, errors, film_progress, labelled, record_files, say, say_written
from dynsim.errors import RecordError
from dynsim.system import interruption
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.record import Record


@dataclass(frozen=True)
class Figures:
    """Figures of records, each alone or all in the same axes (``together``), as files of a kind in a folder."""

    records: dict[str, Record]
    folder: Path
    kind: str
    together: bool = False

    def draw(self) -> None:
        """See :func:`dynsim.draw.figures.draw`."""
        from dynsim.draw import figures

        if self.together:
            figures.draw_comparison(self.records, self.folder, self.kind)
        else:
            for record in self.records.values():
                figures.draw(record, self.folder, self.kind)


@dataclass(frozen=True)
class Page:
    """The page that shows records in 3D."""

    records: dict[str, Record]
    folder: Path

    def draw(self) -> Path | None:
        """Write it; None where the records have nothing to be seen."""
        from dynsim.draw.page import viewable, write
        from dynsim.engine.recording import VIEW

        shown = {name: record for name, record in self.records.items() if viewable(record)}
        return write(shown, self.folder / VIEW) if shown else None


@contextmanager
def saved_before(folder: Path) -> Iterator[None]:
    """Within, signals are handled again, and one is answered with where the results are."""
    interruption.heed()
    try:
        interruption.check()
        yield
    except KeyboardInterrupt:
        errors.print(f"interrupted; all results are in {escaped(folder)}, not all figures and pages")
        raise


def draw(figures: Figures, quiet: bool) -> None:
    """Draw here, and say so."""
    with drawing(figures.folder, quiet):
        figures.draw()


def draw_all(wanted: Sequence[Figures], page: Page, quiet: bool) -> Path | None:
    """Draw, and write a page, in several processes if there are several cores; returns the file of the page.

    Raises
    ------
    RecordError
        See :func:`dynsim.draw.figures.draw`; or a process was ended from outside.
    KeyboardInterrupt
        After Ctrl-C, which costs what was not drawn yet.
    """
    from dynsim.studies.processes import WorkerInterrupted, WorkerLost, cores, run_in_processes

    pages: list[Path | None] = []

    def take(task: Figures | Page, result: Callable[[], Path | None]) -> None:
        try:
            done = result()
        except WorkerInterrupted:
            return
        except WorkerLost as lost:
            raise RecordError(f"{task.folder}: could not be drawn: {lost}") from lost
        if isinstance(task, Page):
            pages.append(done)

    # The longest first, the shortest last.
    tasks: list[Figures | Page] = [*wanted, page]
    workers = min(cores(), len(tasks))
    with drawing(page.folder, quiet):
        if workers == 1:
            for figures in wanted:
                figures.draw()
            return page.draw()
        if run_in_processes(_draw, tasks, workers, take):
            raise KeyboardInterrupt
    return pages[0] if pages else None


def _draw(task: Figures | Page, _: Any) -> Path | None:
    """In a worker."""
    return task.draw()


# Command ``dynsim view``, and the pages that ``run`` and ``compare`` write.


def view(
    records: Annotated[
        list[Path], typer.Argument(metavar="RECORD", help="Records (HDF5), measured ones too, or folders of runs.")
    ],
    ghost: Annotated[
        bool, typer.Option("--ghost", help="Lay several over each other, the first one solid; default: side by side.")
    ] = False,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = True,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="For the page; default: view.html beside the record or in the folder, here for several.",
        ),
    ] = None,
    trust: TrustOption = False,
) -> None:
    """Write a page that shows records in 3D, with plots and forces over time, for any browser and without a network."""
    from dynsim.draw.page import write
    from dynsim.engine.recording import VIEW

    named = labelled(record_files(records), trust=trust)
    first = records[0] if records[0].is_dir() else records[0].parent
    page = out or (first if len(records) == 1 else Path()) / VIEW
    with console.status(f"writing {escaped(page)}"):
        write(named, page, ghost=ghost)
    say_written(page)
    if open_:
        open_page(page)


def write_view(records: Mapping[str, Record], folder: Path, quiet: bool) -> Path | None:
    """The page of records in a folder, and say where; None where they have nothing to be seen."""
    page = Page(dict(records), folder).draw()
    tell_of_view(page, quiet)
    return page


def tell_of_view(page: Path | None, quiet: bool) -> None:
    """Say where a page is that was written."""
    if page is not None and not quiet:
        say(f"To be seen in a browser: {escaped(page)}")


def open_page(page: Path) -> None:
    """Open a page in the user's browser, or say that there is no display to open one on."""
    open_address(page.absolute().as_uri(), escaped(page))


def open_address(address: str, name: str = "") -> None:
    """Open an address in the user's browser, or say that there is no display to open one on."""
    import webbrowser

    # Without a display some systems start a browser within the terminal.
    display = sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")))
    if not display or not webbrowser.open(address):
        say(f"No browser opened; open {name or address} in one")


# Command ``dynsim animate``: writes a film of one or several records.


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
    from dynsim.draw.film.film import check

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
