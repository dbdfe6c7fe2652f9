"""Consoles, messages about written files, progress bars, and the display of drawing and compilation."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from dynsim.errors import RecordError
from dynsim.system.terminal import Terminal, escaped

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID
    from rich.status import Status

    from dynsim.engine.compilation import Compilation
    from dynsim.record import Record
    from dynsim.scenario import Scenario
    from dynsim.studies.compare import VariantProgress

# emoji: rich would turn the ":b:" of a path or key into a picture.
console = Terminal(emoji=False)
errors = Terminal(stderr=True, soft_wrap=True, highlight=False, emoji=False)


def say(text: str) -> None:
    """A sentence on standard output, in as many lines as it has; names in it are :func:`escaped`."""
    console.print(text, highlight=False, soft_wrap=True)


def say_written(path: Path) -> None:
    """Print where the files of a command are."""
    say(f"Written to {escaped(path)}")


# Of a progress bar.
_TITLE_WIDTH = 22
# Of kernels, where none have been compiled yet [s].
_COMPILED_S = 90.0
# Of a run's folder, and of one of several.
RECORD, COMPARISON = "record.h5", "comparison.json"


def labelled(paths: Sequence[Path], *, trust: bool = False) -> dict[str, Record]:
    """Records, or those of folders, by names for them: their variants, numbered where another has the same.

    Raises
    ------
    RecordError
        See :meth:`dynsim.record.Record.load`.
    """
    from dynsim.record import Record
    from dynsim.system.files import file_name

    records: dict[str, Record] = {}
    for path in record_files(paths):
        record = Record.load(path, trust=trust)
        name = file_name(record.summary.get("variant") or path.parent.name or path.stem)
        label = next(label for k in itertools.count(1) if (label := name if k == 1 else f"{name}_{k}") not in records)
        records[label] = record
    return records


def record_files(paths: Sequence[Path]) -> list[Path]:
    """Records as they were named; of a folder its record, or those of the variants in it.

    Raises
    ------
    RecordError
        A folder has no records.
    """
    files = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        inside = [path / RECORD] if (path / RECORD).is_file() else _of_variants(path)
        if not inside:
            raise RecordError(
                f"{path}: no {RECORD} there, nor in a folder in it; name a record, or the folder of a run"
            )
        files += inside
    return files


def _of_variants(folder: Path) -> list[Path]:
    """Records of the folders in a folder: in the order of a comparison's variants, others after them."""
    files = sorted(folder.glob(f"*/{RECORD}"))
    try:
        order = list(json.loads((folder / COMPARISON).read_text(encoding="utf-8"))["variants"])
    except (OSError, ValueError, KeyError, TypeError):
        return files
    return sorted(files, key=lambda path: order.index(path.parent.name) if path.parent.name in order else len(order))


@contextmanager
def drawing(folder: Path, quiet: bool) -> Iterator[None]:
    """Says that figures are being drawn."""
    with nullcontext() if quiet else console.status(f"drawing {escaped(folder)}"):
        yield


def _bars(*columns: str | ProgressColumn) -> Progress:
    """Bars with these columns, time since their start and time to go; gone at their end where there is no terminal."""
    from rich import progress
    from rich.table import Column

    return progress.Progress(
        *columns,
        progress.TimeElapsedColumn(table_column=Column(no_wrap=True)),
        "to go",
        progress.TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=console,
        transient=not console.is_terminal,
    )


def told_in(status: Status, task: str, now: Compilation | None) -> None:
    """Say in a status what is compiled meanwhile."""
    status.update(task if now is None else f"{task}: {escaped(now.text)}, {now.elapsed:.0f} s")


def _silence() -> None:
    """Kernels are compiled without a word."""
    from dynsim.engine.compilation import shown_by_caller

    shown_by_caller()


@contextmanager
def _compilation_told(show: Callable[[Compilation | None], None] = lambda now: None) -> Iterator[None]:
    """Within, the first compilation of kernels is told, and shown while it lasts."""
    from dynsim.engine.compilation import watched

    shown: list[Compilation] = []

    def compiling(now: Compilation | None) -> None:
        if now is not None and not shown:
            shown.append(now)
            console.print(f"{escaped(now.text[0].upper() + now.text[1:])}.", highlight=False)
        show(now)

    with watched(compiling):
        yield


@contextmanager
def progress(scenarios: Sequence[Scenario], quiet: bool) -> Iterator[VariantProgress]:
    """A progress bar per scenario, with time and time to go, and one while references take long; yields its report."""
    if quiet:
        _silence()
        yield lambda variant, time, stage="": None
        return
    from rich.progress import BarColumn

    from dynsim.engine import REFERENCES, SIMULATION

    # In 80 columns all fits up to 9999 s: the bar gives way, the times do not.
    done = "{task.completed:.2f} / {task.total:g} s {task.fields[what]}"
    kernels: list[TaskID] = []

    def compiling(now: Compilation | None) -> None:
        if now is None:
            bars.update(kernels[0], visible=False)
            return
        if not kernels:
            kernels.append(bars.add_task("kernels", total=now.expected or _COMPILED_S, what="compiled"))
        bars.update(kernels[0], completed=now.elapsed, visible=True)

    with _bars("{task.description}", BarColumn(), done) as bars, _compilation_told(compiling):

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
    """A bar over all runs of a sweep, with time, time to go and how many failed; yields its report."""
    if quiet:
        _silence()
        yield lambda done, failed: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn

    bar = _bars("runs", BarColumn(), MofNCompleteColumn(), "{task.fields[failed]}")
    task = bar.add_task("", total=runs, failed="")

    def compiling(now: Compilation | None) -> None:
        if bar.live.is_started:
            bar.update(task, failed="" if now is None else f"compiling, {now.elapsed:.0f} s")

    def report(done: int, failed: int) -> None:
        # Not before: what refuses the sweep then stands alone.
        bar.start()
        bar.update(task, completed=done, failed=f"{failed} failed" if failed else "")

    try:
        with _compilation_told(compiling):
            yield report
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def plan_progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """A bar over the stages of a plan of braces; yields its report of a stage and the share that is done."""
    if quiet:
        _silence()
        yield lambda stage, share: None
        return
    from rich.progress import BarColumn

    with _bars("{task.description}", BarColumn()) as bar, _compilation_told():
        task = bar.add_task("searching", total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


@contextmanager
def film_progress(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar over the frames of a film, with time and time to go; yields its report."""
    if quiet:
        yield lambda done, total: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn

    with _bars("frames", BarColumn(), MofNCompleteColumn()) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
