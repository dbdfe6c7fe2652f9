"""Consoles of the command line, messages, and progress bars."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from dynsim.system.terminal import Terminal, escaped, escaped_problem

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

    from dynsim.engine.compilation import Compilation
    from dynsim.scenario import Scenario
    from dynsim.studies.compare import VariantProgress

# Maximum width of the title of a progress bar [characters].
_TITLE_WIDTH = 22
# Maximum number of progress bars that a terminal keeps.
_KEPT = 6
# Expected compilation time of the kernels if they have never been compiled before [s].
_COMPILED_S = 90.0

# No emoji: rich would replace ":b:" in a path or key.
console = Terminal(emoji=False)
errors = Terminal(stderr=True, soft_wrap=True, highlight=False, emoji=False)


def print_error(text: object) -> None:
    """Print an error to standard error, as one line and its indented continuation; the text is escaped here."""
    errors.print(f"[red]error:[/] {escaped_problem(text)}")


def print_warning(text: object) -> None:
    """Print a warning to standard error as :func:`print_error` prints an error."""
    errors.print(f"[yellow]warning:[/] {escaped_problem(text)}")


def print_line(text: str) -> None:
    """Print text to standard output without wrapping; pass names in the text through :func:`escaped` first."""
    console.print(text, highlight=False, soft_wrap=True)


def print_written(path: Path) -> None:
    """Print where the files of a command are."""
    print_line(f"Written to {escaped(path)}")


@contextmanager
def drawing(folder: Path, quiet: bool) -> Iterator[None]:
    """Show a status line while figures are being drawn in the block."""
    with nullcontext() if quiet else console.status(f"drawing {escaped(folder)}"):
        yield


def _bars(*columns: str | ProgressColumn, quiet: bool, kept: bool = True) -> Progress:
    """Create progress bars with these columns and elapsed and remaining time; a terminal keeps them if ``kept``."""
    from rich import progress
    from rich.table import Column

    return progress.Progress(
        *columns,
        progress.TimeElapsedColumn(table_column=Column(no_wrap=True)),
        "to go",
        progress.TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=Console(quiet=True) if quiet else console,
        transient=not (kept and console.is_terminal),
        disable=quiet,
    )


@contextmanager
def status(task: str) -> Iterator[None]:
    """Show a status line for the block, and print the first compilation of kernels."""
    with console.status(task) as line:

        def compiling(now: Compilation | None) -> None:
            line.update(task if now is None else f"{task}: compiling, {now.elapsed:.0f} s")

        with _compilation_shown(False, compiling):
            yield


@contextmanager
def _compilation_shown(quiet: bool, show: Callable[[Compilation | None], None] = lambda now: None) -> Iterator[None]:
    """Print the first compilation of kernels in the block, and show its progress; suppress both if ``quiet``."""
    from dynsim.engine.compilation import shown_by_caller, watched

    shown: list[Compilation] = []

    def compiling(now: Compilation | None) -> None:
        if now is not None and not shown:
            shown.append(now)
            console.print(f"{escaped(now.text[0].upper() + now.text[1:])}.", highlight=False)
        show(now)

    if quiet:
        shown_by_caller()
        yield
        return
    with watched(compiling):
        yield


@contextmanager
def progress(scenarios: Sequence[Scenario], quiet: bool) -> Iterator[VariantProgress]:
    """Show a progress bar per scenario, and one more if its references take long; yield a progress callback."""
    from rich.progress import BarColumn

    from dynsim.engine import REFERENCES, SIMULATION

    # The text fits into 80 columns for times up to 9999 s: the bar shrinks, but the times do not.
    done = "{task.completed:.2f} / {task.total:g} s {task.fields[what]}"
    kernels: list[TaskID] = []

    def compiling(now: Compilation | None) -> None:
        if now is None:
            bars.update(kernels[0], visible=False)
            return
        if not kernels:
            kernels.append(bars.add_task("kernels", total=now.expected or _COMPILED_S, what="compiled"))
        bars.update(kernels[0], completed=now.elapsed, visible=True)

    # More bars would move the start of a table off the screen.
    kept = len(scenarios) <= _KEPT
    with (
        _bars("{task.description}", BarColumn(), done, quiet=quiet, kept=kept) as bars,
        _compilation_shown(quiet, compiling),
    ):

        def add(scenario: Scenario, kind: str, visible: bool) -> TaskID:
            title = scenario.variant or scenario.name
            title = title if len(title) <= _TITLE_WIDTH else title[: _TITLE_WIDTH - 1] + "…"
            return bars.add_task(escaped(title), total=scenario.duration_s, what=kind, visible=visible)

        preparing = {s.variant: add(s, "references", False) for s in scenarios}
        simulating = {s.variant: add(s, "simulated", True) for s in scenarios}

        def report(variant: str, time: float, stage: str = SIMULATION) -> None:
            bars.update(preparing[variant], completed=time, visible=stage == REFERENCES, refresh=stage == REFERENCES)
            if stage == SIMULATION:
                bars.update(simulating[variant], completed=time)

        yield report


@contextmanager
def sweep_progress(runs: int, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar for all runs of a sweep and the number of failed runs; yield a progress callback."""
    from rich.progress import BarColumn, MofNCompleteColumn

    bar = _bars("runs", BarColumn(), MofNCompleteColumn(), "{task.fields[failed]}", quiet=quiet)
    task = bar.add_task("", total=runs, failed="")

    def compiling(now: Compilation | None) -> None:
        if bar.live.is_started:
            bar.update(task, failed="" if now is None else f"compiling, {now.elapsed:.0f} s")

    def report(done: int, failed: int) -> None:
        # Start the bar here, so that an error before the first run is printed without a bar.
        bar.start()
        bar.update(task, completed=done, failed=f"{failed} failed" if failed else "")

    try:
        with _compilation_shown(quiet, compiling):
            yield report
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def plan_progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar for the stages of a plan; yield a callback for the stage and the fraction done."""
    from rich.progress import BarColumn

    with _bars("{task.description}", BarColumn(), quiet=quiet) as bar, _compilation_shown(quiet):
        task = bar.add_task("searching", total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


@contextmanager
def film_progress(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar for the frames of an animation; yield a progress callback."""
    from rich.progress import BarColumn, MofNCompleteColumn

    with _bars("frames", BarColumn(), MofNCompleteColumn(), quiet=quiet) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
