"""The progress bar of a replay, drawn in its own thread so that a blocked terminal cannot delay the motion."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from dynsim.hardware.replay.output import Background
from dynsim.hardware.replay.states import ReplayProgress

DRAWING_INTERVAL = 0.1
"""Between two drawings [s]."""
PATIENCE = 1.0
"""Longest wait for a terminal that accepts no output, after the run [s]."""


class Display:
    """A bar with state, following error and temperature; called with a Progress, it shows the last one.

    Attributes
    ----------
    failure : Exception or None
        Why nothing is drawn any more.
    """

    name = "progress bar"

    def __init__(self, console: Console) -> None:
        self.failure: Exception | None = None
        self._latest: ReplayProgress | None = None
        self._bar = Bar(
            TextColumn("{task.description:<13}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("following error {task.fields[error]:6.4f} rad"),
            TextColumn("hottest {task.fields[temperature]}"),
            console=console,
            transient=True,
            auto_refresh=False,
            # What other threads print must not wait for this one.
            redirect_stdout=False,
            redirect_stderr=False,
        )
        self._task = self._bar.add_task("", total=1.0, error=0.0, temperature="-")

    def __call__(self, progress: ReplayProgress) -> None:
        self._latest = progress

    def pump(self) -> None:
        latest, self._latest = self._latest, None
        if latest is None:
            return
        known = latest.temperature == latest.temperature
        self._bar.start()
        self._bar.update(
            self._task,
            description=latest.state.name,
            completed=latest.fraction,
            error=latest.following_error,
            temperature=f"{latest.temperature:.0f} °C" if known else "-",
            refresh=True,
        )

    def close(self) -> None:
        self._bar.stop()


@contextmanager
def displayed(console: Console, failures: dict[str, BaseException]) -> Iterator[Display | None]:
    """A display that draws itself within the block; None where the system gives no thread for it.

    Why it did not, or did so no more, joins ``failures`` at the end of the block.
    """
    display = Display(console)
    try:
        background = Background([display], DRAWING_INTERVAL)
    except RuntimeError as error:
        failures[display.name] = error
        yield None
        return
    try:
        yield display
    finally:
        failures |= background.close(PATIENCE)
