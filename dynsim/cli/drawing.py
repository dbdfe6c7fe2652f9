"""Drawing of figures and 3D pages after runs, in this process or in parallel, and the commands view and animate."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynsim.cli.app import QuietOption, RecordsArgument, TrustOption, option
from dynsim.cli.output import console, drawing, errors, film_progress, print_line, print_warning, print_written
from dynsim.cli.records import labelled, record_files
from dynsim.errors import RecordError
from dynsim.system import interruption
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.draw.figures.look import Look
    from dynsim.record import Record
    from dynsim.record.scene import Scene


@dataclass(frozen=True)
class Figures:
    """Task that draws figures of records: one set per record, or overlays of all records if ``together`` is True."""

    records: dict[str, Record]
    folder: Path
    kind: str
    look: Look | None = None
    together: bool = False

    def draw(self) -> None:
        """Draw the figures, see :func:`dynsim.draw.figures.draw`."""
        from dynsim.draw import figures

        if self.together:
            figures.draw_comparison(self.records, self.folder, self.kind, self.look)
        else:
            for record in self.records.values():
                figures.draw(record, self.folder, self.kind, self.look)


@dataclass(frozen=True)
class Page:
    """Task that writes the page that shows records in 3D."""

    records: dict[str, Record]
    folder: Path

    def draw(self) -> Path | None:
        """Write the page and return its path, or None if no record can be shown."""
        from dynsim.draw.page import viewable, write
        from dynsim.engine.recording import VIEW

        shown = {name: record for name, record in self.records.items() if viewable(record)}
        return write(shown, self.folder / VIEW) if shown else None


@contextmanager
def interruptible_drawing(folder: Path) -> Iterator[None]:
    """Handle signals again within the block; if one arrives, print where the results are."""
    interruption.heed()
    try:
        interruption.check()
        yield
    except KeyboardInterrupt:
        errors.print(f"interrupted; all results are in {escaped(folder)}, but some figures or pages are missing")
        raise


def draw(figures: Figures, quiet: bool) -> None:
    """Draw figures in this process, and show a status line meanwhile."""
    with drawing(figures.folder, quiet):
        figures.draw()


def draw_all(wanted: Sequence[Figures], page: Page, quiet: bool) -> Path | None:
    """Draw figures and write a page, using one process per core; return the path of the page, if any.

    Raises
    ------
    RecordError
        As for :func:`dynsim.draw.figures.draw`; also if a worker process was killed.
    KeyboardInterrupt
        After Ctrl-C; figures that were not finished are missing.
    """
    from dynsim.studies.processes import WorkerInterrupted, WorkerLost, cores, run_in_processes

    pages: list[Path | None] = []

    def take(task: Figures | Page, result: Callable[[], Path | None]) -> None:
        try:
            done = result()
        except WorkerInterrupted:
            return
        except WorkerLost as lost:
            raise RecordError(f"{task.folder}: drawing failed: {lost}") from lost
        if isinstance(task, Page):
            pages.append(done)

    # Start the longest tasks first.
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
    """Execute one drawing task in a worker process."""
    return task.draw()


# Command ``dynsim view``, and the pages written by ``run`` and ``compare``.


def view(
    records: RecordsArgument,
    ghost: Annotated[
        bool, typer.Option("--ghost", help="Overlay the records, with the first one solid; default: side by side.")
    ] = False,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = True,
    out: Annotated[
        Path | None,
        option("FILE", "Output file; default: view.html next to the record, or in the working directory for several."),
    ] = None,
    trust: TrustOption = False,
) -> None:
    """Write a self-contained 3D page of records, which any browser can open offline."""
    from dynsim.draw.page import write
    from dynsim.engine.recording import VIEW

    named = labelled(record_files(records), trust=trust)
    first = records[0] if records[0].is_dir() else records[0].parent
    page = out or (first if len(records) == 1 else Path()) / VIEW
    with console.status(f"writing {escaped(page)}"):
        write(named, page, ghost=ghost)
    warn_about_meshes(record.scene for record in named.values())
    print_written(page)
    if open_:
        open_page(page)


def warn_about_meshes(scenes: Iterable[Scene | None]) -> None:
    """Print a warning for each mesh of the scenes that cannot be drawn."""
    from dynsim.draw.geometry.meshes import mesh_notes

    for note in mesh_notes(scenes):
        print_warning(note)


def write_view(records: Mapping[str, Record], folder: Path, quiet: bool) -> Path | None:
    """Write the page of records to a folder and print its path; return None if no record can be shown."""
    page = Page(dict(records), folder).draw()
    print_page(page, quiet)
    return page


def print_page(page: Path | None, quiet: bool) -> None:
    """Print the path of a page, if there is one."""
    if page is not None and not quiet:
        print_line(f"3D page (open in a browser): {escaped(page)}")


def open_page(page: Path) -> None:
    """Open a page in the default browser, or print its path if no browser can be opened."""
    open_address(page.absolute().as_uri(), escaped(page))


def open_address(address: str, name: str = "") -> None:
    """Open an address in the default browser, or print it if no browser can be opened."""
    import webbrowser

    # Without a display some systems start a browser inside the terminal.
    display = sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")))
    if not display or not webbrowser.open(address):
        print_line(f"No browser was opened; open {name or address} in a browser")


# Command ``dynsim animate``.


class ViewName(StrEnum):
    iso = "iso"
    side = "side"
    top = "top"


def animate(
    records: RecordsArgument,
    out: Annotated[Path, option("FILE", "Output file, FILE.mp4 or FILE.gif.")],
    view: Annotated[ViewName, typer.Option(help="View direction.")] = ViewName.iso,
    speed: Annotated[float, option("X", "Playback speed; 1 is real time, 0.1 is ten times slower.")] = 1.0,
    size: Annotated[str, option("WxH", "Width and height [pixel].")] = "960x540",
    fps: Annotated[int, option("N", "Frame rate [1/s].")] = 25,
    hold: Annotated[float, option("S", "Duration of the last frame [s].")] = 1.0,
    plot: Annotated[
        str | None, option("SIGNAL", "Signal to plot below the scene, or none; default: chosen automatically.")
    ] = None,
    quiet: QuietOption = False,
    trust: TrustOption = False,
) -> None:
    """Write a GIF or MP4 film of records, side by side; needs no display."""
    from dynsim.draw.film import write
    from dynsim.draw.film.film import check

    wanted = _size(size)
    check(out.suffix.lower().removeprefix("."), fps)
    named = labelled(records, trust=trust)
    warn_about_meshes(record.scene for record in named.values())
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
        print_written(out)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", text)
    if match is None:
        raise RecordError(f"--size {text!r}: must be WIDTHxHEIGHT, such as 960x540")
    return int(match[1]), int(match[2])
