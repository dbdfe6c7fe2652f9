"""Commands run, compare, check, list, plot and schema; large imports are deferred until a command is called."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynsim.cli.app import (
    FigureFormat,
    FiguresOption,
    FontOption,
    FormatOption,
    NoCaptionOption,
    NoTitleOption,
    PanelsOption,
    QuietOption,
    RecordsArgument,
    Rows,
    RowsOption,
    ScenarioArgument,
    SetOption,
    SizeOption,
    StyleOption,
    TrustOption,
    VariantOption,
    app,
    folder_option,
    option,
    parsed_overrides,
)
from dynsim.cli.comparison import print_comparison, print_summary
from dynsim.cli.drawing import (
    Figures,
    Page,
    animate,
    draw,
    draw_all,
    interruptible_drawing,
    open_page,
    print_page,
    view,
    warn_about_meshes,
)
from dynsim.cli.export import export
from dynsim.cli.hardware import EXAMPLE, IMPORT_EXAMPLE, hw, hw_drive, import_recording
from dynsim.cli.output import (
    console,
    errors,
    print_error,
    print_line,
    print_warning,
    print_written,
    progress,
    status,
)
from dynsim.cli.plan import EXAMPLE as PLAN_EXAMPLE
from dynsim.cli.plan import plan
from dynsim.cli.pose import EXAMPLE as POSE_EXAMPLE
from dynsim.cli.pose import pose, view_starts
from dynsim.cli.records import labelled, record_files
from dynsim.cli.sweep import sweep
from dynsim.cli.tables import print_choices, print_starts
from dynsim.cli.teleop import teleop
from dynsim.config import completion
from dynsim.errors import DynsimError, RecordError, SimulationInterrupted, SimulationStopped
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.engine import Start
    from dynsim.record import Record
    from dynsim.scenario import Scenario

# Maximum number of variants whose figures `compare` draws unless an option requests them.
FEW = 4


@app.command(epilog="Example: dynsim run elbow_comparison --variant two_elbows --set integrator.rtol=1e-8")
def run(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    out: Annotated[Path | None, folder_option("results/SCENARIO/VARIANT")] = None,
    no_figures: FiguresOption = False,
    format_: FormatOption = FigureFormat.png,
    view: Annotated[bool, typer.Option("--view", help="Open the 3D page in a browser when the run is done.")] = False,
    rows: RowsOption = Rows.screen,
    quiet: QuietOption = False,
) -> None:
    """Simulate one scenario; write its record, summary, figures and a 3D page.

    The integration method is chosen automatically (`integrator.method: auto`); the summary reports the method and why
    it was chosen. Exit codes: 0 if the run was completed, 2 if the input is invalid, 3 if the run stopped early
    (results up to then are saved).
    """
    from dynsim.engine.recording import RUN_FILES, save_run
    from dynsim.scenario import load_scenario
    from dynsim.system.files import check_writable

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    folder = out or Path("results", loaded.name, loaded.variant)
    check_writable(folder, RUN_FILES)
    from dynsim.engine import simulate

    try:
        with progress([loaded], quiet) as report:
            record = simulate(loaded, partial(report, loaded.variant))
    except SimulationStopped as stop:
        if stop.record is not None:
            save_run(stop.record, folder)
            errors.print(f"results up to the stop are in {escaped(folder)} and are marked incomplete")
        raise
    save_run(record, folder)
    warn_about_meshes([record.scene])
    shown = Page({loaded.variant or loaded.name: record}, folder)
    page = None
    with interruptible_drawing(folder):
        if not no_figures:
            draw(Figures({loaded.variant: record}, folder / "figures", format_), quiet)
        if view or not no_figures:
            page = shown.draw()
    if not quiet:
        print_summary(console, record.summary, rows is Rows.all)
        print_written(folder)
    print_page(page, quiet)
    if view and page is not None:
        open_page(page)


@app.command(epilog="Example: dynsim compare snake_positioning --jobs 2 --variant-figures")
def compare(
    scenario: ScenarioArgument,
    overrides: SetOption = None,
    out: Annotated[Path | None, folder_option("results/SCENARIO")] = None,
    jobs: Annotated[int, option("N", "Number of processes.", min=1)] = 1,
    no_figures: FiguresOption = False,
    variant_figures: Annotated[
        bool | None,
        typer.Option(
            "--variant-figures/--no-variant-figures",
            help=f"Draw also the figures of each variant, without animations; default: with at most {FEW} variants. "
            "`dynsim plot` draws them later.",
            show_default=False,
        ),
    ] = None,
    format_: FormatOption = FigureFormat.png,
    size: SizeOption = None,
    font: FontOption = None,
    style: StyleOption = None,
    panels: PanelsOption = None,
    no_title: NoTitleOption = False,
    no_caption: NoCaptionOption = False,
    rows: RowsOption = Rows.screen,
    quiet: QuietOption = False,
) -> None:
    """Simulate all variants of a scenario and compare them in a table and figures."""
    from dynsim.draw.figures.look import Look
    from dynsim.engine.recording import COMPARISON_FILES, RUN_FILES, save_run
    from dynsim.scenario import load_scenario, variant_names
    from dynsim.system.files import check_writable, discard

    look = Look.of(size, font, style, title=not no_title, caption=not no_caption, panels=panels)
    values = parsed_overrides(overrides)
    loaded = [load_scenario(scenario, name, values) for name in variant_names(scenario)]
    folder = out or Path("results", loaded[0].name if loaded else "")
    check_writable(folder, COMPARISON_FILES[:2])
    for variant in loaded:
        check_writable(folder / variant.variant, RUN_FILES)
    from dynsim.studies.compare import compare as compare_variants
    from dynsim.studies.compare import save_comparison

    results: dict[str, Record | SimulationStopped] = {}

    def finished(name: str, record: Record) -> None:
        # Delete the old comparison before the first of its records is replaced.
        discard(folder, COMPARISON_FILES)
        save_run(record, folder / name)
        results[name] = record

    def stopped(name: str, stop: SimulationStopped) -> None:
        results[name] = stop
        discard(folder, COMPARISON_FILES)
        if stop.record is not None:
            save_run(stop.record, folder / name)
            where = escaped(folder / name)
            errors.print(f"results of {escaped(name)} up to the stop are in {where} and are marked incomplete")

    failure: SimulationStopped | None = None
    try:
        with progress(loaded, quiet) as report:
            compare_variants(scenario, overrides=values, jobs=jobs, progress=report, finished=finished, stopped=stopped)
    except SimulationInterrupted:
        raise
    except SimulationStopped as stop:
        failure = stop
    # Sort the results in the order of the variants in the file, not in the order in which they were completed.
    results = {scenario.variant: results[scenario.variant] for scenario in loaded if scenario.variant in results}
    save_comparison(results, folder)
    records = {name: result for name, result in results.items() if not isinstance(result, SimulationStopped)}
    if records:
        warn_about_meshes(record.scene for record in records.values())
        with interruptible_drawing(folder):
            if not no_figures:
                if variant_figures is None:
                    variant_figures = len(loaded) <= FEW
                wanted = [
                    Figures({name: record}, folder / name / "figures", format_, replace(look, film=False))
                    for name, record in records.items()
                    if variant_figures and not look.panels
                ]
                together = Figures(records, folder, format_, look, together=True)
                page = draw_all([together, *wanted], Page(records, folder), quiet)
        if not quiet:
            summaries = {name: record.summary for name, record in records.items()}
            print_comparison(console, summaries, rows is Rows.all, [name for name in results if name not in records])
            print_written(folder)
        if not no_figures:
            print_page(page, quiet)
    if failure is not None:
        raise failure


@app.command(epilog="Example: dynsim check elbow_comparison six_axis_arm")
def check(
    scenarios: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENARIO",
            help="Paths of scenario files, or names of shipped scenarios.",
            autocompletion=completion.scenarios,
        ),
    ],
    overrides: SetOption = None,
    view: Annotated[
        bool,
        typer.Option(
            "--view", help="Open a 3D page of the start postures; it is written to results/SCENARIO/start.html."
        ),
    ] = False,
) -> None:
    """Validate scenarios without simulating them: keys, model, contacts at the start, reachable references.

    For each variant, the command prints the start position of the hand and of each contact point (in full precision,
    ready to be copied into a path or surface), the gap at each contact and of the nearest pairs of bodies, the joints
    that `initial` moved, the joints that start at a limit because no position is set, and the tip margin of a mobile
    base at rest. `dynsim pose` changes a start posture.
    """
    from dynsim.engine import check as check_scenario
    from dynsim.scenario import load_scenario, variant_names

    failed = False
    for name in scenarios:
        starts: dict[str, Start] = {}
        loadable: list[Scenario] = []
        try:
            variants: Sequence[str | None] = variant_names(name) or [None]
            for variant in variants:
                task = f"checking {escaped(name)} {escaped(variant or '')}"
                with status(task):
                    loaded = load_scenario(name, variant, parsed_overrides(overrides))
                    loadable.append(loaded)
                    # Stored early, so that the start is printed even if a later check fails.
                    starts[variant or ""] = check_scenario(loaded, partial(starts.__setitem__, variant or ""))
        except SimulationInterrupted:
            raise
        except DynsimError as error:
            failed = True
            # Print the start positions, because they help the user to find the error.
            print_starts(console, starts)
            print_error(error)
        else:
            count = f"{len(variants)} variants" if len(variants) > 1 else "1 variant"
            print_line(f"{escaped(name)}: ok ({count})")
            print_starts(console, starts)
            warn_about_meshes(start.scene for start in starts.values())
        if view and loadable:
            view_starts(loadable)
    _warn_about_plugins()
    if failed:
        raise typer.Exit(2)


@app.command("list", epilog="Example: dynsim list")
def list_() -> None:
    """List shipped scenarios, plants, surfaces, controllers, paths and motors."""
    print_choices(console)
    _warn_about_plugins()


@app.command(epilog="Example: dynsim plot results/elbow_comparison/two_elbows/record.h5")
def plot(
    records: RecordsArgument,
    out: Annotated[Path | None, option("FOLDER", "Output folder; default: figures/ next to each record.")] = None,
    format_: FormatOption = FigureFormat.png,
    size: SizeOption = None,
    font: FontOption = None,
    style: StyleOption = None,
    panels: PanelsOption = None,
    no_title: NoTitleOption = False,
    no_caption: NoCaptionOption = False,
    trust: TrustOption = False,
) -> None:
    """Draw the figures of one record, or of several records and their overlay."""
    from dynsim.draw.figures.look import Look

    look = Look.of(size, font, style, title=not no_title, caption=not no_caption, panels=panels)
    files = record_files(records)
    named = labelled(files, trust=trust)
    if len(named) > 1:  # before the single figures, because it rejects records that do not fit together
        draw(Figures(named, out or Path("figures"), format_, look, together=True), quiet=False)
        if look.panels:
            return
    for path, (label, record) in zip(files, named.items(), strict=True):
        folder = path.parent / "figures" if out is None else out if len(files) == 1 else out / label
        try:
            draw(Figures({label: record}, folder, format_, look), quiet=False)
        except RecordError as error:
            raise RecordError(f"{path}: {error}") from error


app.command(epilog=PLAN_EXAMPLE)(plan)
app.command(epilog=POSE_EXAMPLE)(pose)
app.command(epilog="Example: dynsim teleop snake_operator --speed 0.2")(teleop)
app.command(epilog="Example: dynsim view results/elbow_comparison/*/record.h5 --ghost")(view)
app.command(epilog="Example: dynsim animate results/elbow_comparison/two_elbows --out film.gif --view side")(animate)


@app.command(epilog="Example: dynsim schema > scenario.schema.json")
def schema() -> None:
    """Print the JSON schema of scenario files for your editor."""
    from dynsim.scenario import json_schema

    print(json.dumps(json_schema(), indent=2))
    _warn_about_plugins()


app.command(epilog="Example: dynsim sweep elbow_comparison --variants all --grid contacts.friction=0:1:5")(sweep)
# The commands `hw …` load modules for serial ports and servos only when they run.
app.command("import", epilog=IMPORT_EXAMPLE)(import_recording)
hw.command("drive", epilog=EXAMPLE)(hw_drive)
app.add_typer(hw, name="hw")
app.command(
    epilog="Example: dynsim export results/elbow_comparison/two_elbows/record.h5 --format joint-trajectory --rate 100"
)(export)


def _warn_about_plugins() -> None:
    """Print a warning for each plug-in that cannot be loaded; a run warns only about plug-ins that it needs."""
    from dynsim.library.families import faults

    for fault in faults():
        print_warning(fault)
