"""Figures of runs: here, or of several runs by as many processes as there are cores."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynsim.cli.display import drawing
from dynsim.errors import RecordError

if TYPE_CHECKING:
    from dynsim.record import Record

# New objects after which a command looks for garbage. What it imports stays: to look through it as often as Python does
# takes a tenth of a run.
GARBAGE = 200_000


@dataclass(frozen=True)
class Figures:
    """The figures of one record, or of several over each other, as files of a kind in a folder."""

    records: dict[str, Record]
    folder: Path
    kind: str
    together: bool = False

    def draw(self) -> None:
        """See :func:`dynsim.figures.draw`."""
        from dynsim import figures

        if self.together:
            figures.draw_comparison(self.records, self.folder, self.kind)
        else:
            for record in self.records.values():
                figures.draw(record, self.folder, self.kind)


def draw(figures: Figures, quiet: bool) -> None:
    """Draw here, and say so."""
    with drawing(figures.folder, quiet):
        figures.draw()


def draw_all(wanted: Sequence[Figures], folder: Path, quiet: bool) -> None:
    """Draw in several processes, if there are several cores; ``folder`` is what is said to be drawn.

    Raises
    ------
    RecordError
        See :func:`dynsim.figures.draw`; or a process was ended from outside.
    """
    from dynsim.studies.processes import WorkerLost, cores, run_in_processes

    def take(figures: Figures, result: Callable[[], None]) -> None:
        try:
            result()
        except WorkerLost as lost:
            raise RecordError(f"{figures.folder}: the process that drew there was ended from outside") from lost

    workers = min(cores(), len(wanted))
    with drawing(folder, quiet):
        if workers == 1:
            for figures in wanted:
                figures.draw()
        elif run_in_processes(_draw, wanted, workers, take):
            raise KeyboardInterrupt


def _draw(figures: Figures, _: Any) -> None:
    """In a worker."""
    gc.set_threshold(GARBAGE)
    figures.draw()
