"""Command ``dynsim sweep``: many runs of one scenario, with a table and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynsim.cli import screen
from dynsim.cli.app import (
    FigureFormat,
    FiguresOption,
    FontOption,
    FormatOption,
    NoCaptionOption,
    NoTitleOption,
    QuietOption,
    ScenarioArgument,
    SetOption,
    SizeOption,
    StyleOption,
    folder_option,
    option,
    parsed_overrides,
)
from dynsim.cli.comparison import grouped_warnings, limited_warnings
from dynsim.cli.output import console, drawing, errors, print_line, print_warning, sweep_progress
from dynsim.cli.tables import without_rounding
from dynsim.errors import ScenarioError, SimulationStopped
from dynsim.system.terminal import escaped, escaped_line

if TYPE_CHECKING:
    from dynsim.draw.figures.look import Look
    from dynsim.draw.figures.sweep import Sweep
    from dynsim.record.quantities import Quantity
    from dynsim.studies.sweep import SweepRow
    from dynsim.studies.sweep_plan import Plan

# Number of failed runs whose reasons are printed.
_SHOWN = 5
# Maximum number of lines of warnings on a screen.
_KINDS = 10


class KeepRecords(StrEnum):
    none = "none"
    failed = "failed"
    all = "all"


def sweep(
    scenario: ScenarioArgument,
    grid: Annotated[
        list[str] | None,
        option(
            "KEY=start:stop:count",
            "Values of one key: start:stop:count (ends included) or a,b,c; repeatable (all combinations).",
        ),
    ] = None,
    sample: Annotated[
        list[str] | None,
        option(
            "KEY=normal(m,s)",
            "Random values of one key: normal(mean,sd) or uniform(a,b); `*` matches every list entry; repeatable.",
        ),
    ] = None,
    count: Annotated[int, option("N", "Number of random draws.", min=1)] = 1,
    seed: Annotated[int, option("S", "Seed for the random draws.", min=0)] = 0,
    variants: Annotated[
        str | None, option("all|NAMES", "`all`, or comma-separated variant names; default: the first in the file.")
    ] = None,
    overrides: SetOption = None,
    jobs: Annotated[int | None, option("N", "Number of processes; default: one per core.", min=1)] = None,
    scheduler: Annotated[
        str | None, option("ADDRESS", "Run on the workers of this Dask scheduler (tcp://HOST:PORT).")
    ] = None,
    out: Annotated[Path | None, folder_option("results/SCENARIO/sweep")] = None,
    keep_records: Annotated[KeepRecords, typer.Option(help="Which runs keep their full record.")] = KeepRecords.none,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume the sweep in --out; completed runs are skipped.")
    ] = False,
    plot: Annotated[
        list[str] | None,
        option(
            "NUMBER",
            "Table column to plot instead of energy and error, e.g. base.tip_margin_min; repeatable. "
            "With --resume, redraws a finished sweep.",
        ),
    ] = None,
    no_figures: FiguresOption = False,
    format_: FormatOption = FigureFormat.png,
    size: SizeOption = None,
    font: FontOption = None,
    style: StyleOption = None,
    no_title: NoTitleOption = False,
    no_caption: NoCaptionOption = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate a scenario over a grid of values, random samples, or both; write a table of all runs and figures.

    The table has a row for each failed run, too, with the reason for the failure. Exit codes: 0 if at least one run
    succeeded, 2 if the input is invalid, 3 if no run succeeded, 130 after Ctrl-C.
    """
    from dynsim.draw.figures.look import Look
    from dynsim.studies.processes import cores

    if jobs is not None and scheduler is not None:
        raise ScenarioError(
            "--jobs (processes on this machine) and --scheduler (workers of a cluster) conflict; use one of them"
        )
    look = Look.of(size, font, style, title=not no_title, caption=not no_caption)
    if plot and no_figures:
        raise ScenarioError("--plot and --no-figures conflict; use one of them")
    from dynsim.scenario import read_scenario
    from dynsim.studies.sweep import OK, TABLES, has_parquet, run_sweep
    from dynsim.studies.sweep_plan import Axis, Law, Plan

    file = read_scenario(scenario)
    axes, laws = tuple(map(Axis.parse, grid or ())), tuple(map(Law.parse, sample or ()))
    plan = Plan(file, _variants(file.variants, variants), parsed_overrides(overrides), axes, laws, count, seed)
    # Invalid values are reported here, before processes and threads start.
    name = plan.first.name
    folder = out or Path("results", name, "sweep")
    unchecked = list(plot or ())

    def warn_once(row: SweepRow) -> None:
        if row.status == OK:
            _warn_about_unknown(row, unchecked)
            unchecked.clear()

    with sweep_progress(plan.runs, quiet) as report:
        rows = run_sweep(
            plan,
            folder,
            jobs=min(jobs or cores(), plan.runs),
            keep_records=keep_records.value,
            resume=resume,
            scheduler=scheduler,
            progress=report,
            ended=warn_once,
        )
    failed = [row for row in rows if row.status != OK]
    for row in failed[:_SHOWN]:
        errors.print(f"run {row.run} {row.status}: {escaped(row.reason)}")
    if len(failed) > _SHOWN:
        errors.print(f"… and {len(failed) - _SHOWN} more; the table lists all reasons")
    if not no_figures:
        _draw(name, rows, plan, folder, quiet, format_, look, plot or ())
    if not quiet:
        _print_table(name, rows, plan, plot or ())
        if not has_parquet():
            print_line(escaped("Parquet file skipped: it requires pyarrow (pip install 'dynsim[tables]')."))
        print_line(f"{len(rows) - len(failed)} of {len(rows)} runs succeeded. Written to {escaped(folder)}")
    if len(failed) == len(rows):
        raise SimulationStopped(f"none of the {len(rows)} runs succeeded; {folder / TABLES[0]} lists the reasons")


def _print_table(name: str, rows: Sequence[SweepRow], plan: Plan, plotted: Sequence[str]) -> None:
    """Print values and results of all runs, or of the first runs and the first keys that fit, and grouped warnings."""
    from dynsim.record.quantities import ENERGY, ERRORS, summary_quantity
    from dynsim.studies.sweep import TABLES

    varied = _varied(plan)
    numbers = {key for row in rows for key in row.numbers}
    errors = [key for key in ERRORS if key in numbers]
    results = {key: summary_quantity(key) for key in plotted or [ENERGY, *errors[:1]] if key in numbers}
    columns = [("run", [str(row.run) for row in rows])]
    if any(row.variant is not None for row in rows):
        columns.append(("variant", [escaped_line(row.variant) for row in rows]))
    columns += [_column(varied[axis.key], [row.values[axis.key] for row in rows]) for axis in plan.grid]
    columns += [_column(results[key], [row.numbers.get(key) for row in rows], unit=1.0) for key in results]
    columns += [_column(varied[key], [row.values[key] for row in rows]) for key in plan.sampled]
    width, height = screen.size(console)
    warnings = {f"run {row.run}": [*filter(None, row.warnings.split("\n"))] for row in rows}
    lines = grouped_warnings(warnings, runs="runs")
    if not screen.is_unbounded(console):
        lines = limited_warnings(grouped_warnings(warnings, width, runs="runs"), _KINDS)
    if lines:
        lines.append(f"whole warnings of each run: {TABLES[0]}")
    screen.show(console, [screen.listing(console, name, columns, height - _SHOWN - 1 - len(lines)), *lines])


def _varied(plan: Plan) -> dict[str, Quantity]:
    """Return name, symbol and unit of the varied keys of a sweep."""
    from dynsim.scenario.quantities import quantity

    return {key: quantity(key, plan.first) for key in plan.parameters}


def _column(described: Quantity, values: Sequence[Any], unit: float = 0.0) -> tuple[str, list[str]]:
    """Return heading and cells of a column, with 0 for rounding errors next to its values or ``unit``."""
    values = without_rounding(values, unit)
    described = described.fitted(values)
    from dynsim.record.quantities import rounded

    cells = [
        "–" if value is None
        else rounded(value * described.scale) if isinstance(value, (int, float)) and not isinstance(value, bool)
        else escaped_line(value)
        for value in values
    ]  # fmt: skip
    return escaped_line(described.label), cells


def _variants(known: Sequence[str], wanted: str | None) -> tuple[str | None, ...]:
    if not known:
        if wanted is not None:
            raise ScenarioError(f"--variants {wanted}: the scenario has no variants")
        return (None,)
    if wanted is None:
        return (known[0],)
    return tuple(known) if wanted == "all" else tuple(name.strip() for name in wanted.split(","))


def _warn_about_unknown(row: SweepRow, plotted: Sequence[str]) -> None:
    """Warn early if the first completed run lacks a number to be plotted; another variant may have it."""
    from dynsim.config.problems import suggest

    for number in plotted:
        if number not in row.numbers:
            named = f" ({row.variant})" if row.variant else ""
            print_warning(
                f"--plot {number}: run {row.run}{named} has no such number"
                f"{suggest(number, row.numbers)}; to change it, press Ctrl-C and use --resume with another --plot"
            )


def _draw(
    name: str,
    rows: Sequence[SweepRow],
    plan: Plan,
    folder: Path,
    quiet: bool,
    format_: str,
    look: Look,
    plotted: Sequence[str] = (),
) -> None:
    from dynsim.config.problems import suggest
    from dynsim.draw.figures.sweep import draw
    from dynsim.studies.sweep import TABLES

    known = dict.fromkeys(key for row in rows for key in row.numbers)
    unknown = [number for number in plotted if known and number not in known]
    if unknown:
        raise ScenarioError(
            f"--plot {', '.join(unknown)}: no run has {'that number' if len(unknown) == 1 else 'these numbers'}"
            f"{suggest(unknown[0], known) if len(unknown) == 1 else ''}; {folder / TABLES[0]} lists all; "
            "use --resume with another --plot to redraw without simulating"
        )
    with drawing(folder, quiet):
        draw(drawn_table(name, rows, plan, plotted), folder, format_, look)


def drawn_table(name: str, rows: Sequence[SweepRow], plan: Plan, plotted: Sequence[str] = ()) -> Sweep:
    """Return the table of a sweep for its figures; runs that stopped early have no numbers.

    Parameters
    ----------
    name : str
        Name of the scenario.
    rows : sequence of SweepRow
        Runs.
    plan : Plan
        Plan of the sweep.
    plotted : sequence of str, optional
        Columns to draw; default: energy and error.
    """
    from dynsim.draw.figures.sweep import Sweep
    from dynsim.studies.sweep import OK

    return Sweep(
        name,
        # A varied key, such as duration_s, may have the name of a result.
        [{**(row if row.status == OK else replace(row, numbers={})).cells(), **row.values} for row in rows],
        [axis.key for axis in plan.grid],
        plan.sampled,
        plan.file.variants,
        plotted,
        _varied(plan),
    )
