"""Drawing of figures and pages after runs, in this process or, for several runs, in one process per core."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynsim.cli.display import drawing, errors
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
        from dynsim.engine.results import VIEW

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
