"""The command line: ``dynsim run``, ``compare``, ``check``, ``list``, ``plot``, ``bench``, ``schema``, ``hw`` …"""

from __future__ import annotations

import errno
import itertools
import json
import os
import signal
import sys
import warnings
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import typer

from dynsim import completion, interruption
from dynsim._version import __version__
from dynsim.errors import DynsimError, RecordError, SimulationInterrupted, SimulationStopped
from dynsim.hardware.cli import export, hw
from dynsim.standard_streams import lenient_streams
from dynsim.terminal import Terminal
from dynsim.terminal import escaped as _escape

if TYPE_CHECKING:
    from rich.progress import TaskID

    from dynsim.record import Record
    from dynsim.scenario import Scenario
    from dynsim.studies.compare import VariantProgress

app = typer.Typer(
    name="dynsim",
    help="Dynamic simulator of braced hyper-redundant manipulators: energy, tracking, contact and motors.",
    epilog="Example: dynsim run single_pendulum",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
# emoji: rich would turn the ":b:" of a path or key into a picture.
console = Terminal(emoji=False)
errors = Terminal(stderr=True, soft_wrap=True, highlight=False, emoji=False)

# Of a progress bar.
_TITLE_WIDTH = 22
# Of a process that a signal ended: this and the number of the signal.
_SIGNAL_EXIT = 128

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="Scenario file, or the name of a shipped one.",
        autocompletion=completion.scenarios,
    ),
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="a.b.c=VALUE", help="Override a value; may be repeated.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
FiguresOption = Annotated[bool, typer.Option("--no-figures", help="Do not draw figures.")]


class FigureFormat(StrEnum):
    png = "png"
    pdf = "pdf"
    svg = "svg"


FormatOption = Annotated[FigureFormat, typer.Option("--format", help="Files that figures are drawn to.")]


def main() -> None:
    """Entry point: errors become one line and an exit code. Ctrl-C where nothing can be saved is typer's: 130."""
    with interruption.heeded() as received, lenient_streams() as output, _plain_warnings():
        code = _exit_code()
        if output is not None:
            output.flush()
            if code == 0 and output.failure is not None:
                code = _explain_lost_output(output.failure)
    sys.exit(_SIGNAL_EXIT + received[0] if received and code == SimulationInterrupted.exit_code else code)


def _exit_code() -> int:
    """Run the command that the arguments name; print its error, if any."""
    try:
        _command()(prog_name="dynsim")
    except SystemExit as finished:
        return finished.code if isinstance(finished.code, int) else 0 if finished.code is None else 1
    except DynsimError as error:
        problem, code = str(error), error.exit_code
    except MemoryError as error:
        problem, code = f"not enough memory: {error}".removesuffix(": "), DynsimError.exit_code
    except OSError as error:
        # What nobody could name better: of the system, not of dynsim.
        problem, code = _explain_system(error), DynsimError.exit_code
    except KeyboardInterrupt:
        return SimulationInterrupted.exit_code
    else:
        return 0
    errors.print(f"[red]error:[/] {_escape(problem)}")
    return code


def _command() -> Any:
    """The command of ``app``; its flags do not show a type, which they do not take."""
    command = typer.main.get_command(app)
    waiting = [command]
    while waiting:
        group = waiting.pop()
        waiting += getattr(group, "commands", {}).values()
        for parameter in (*group.params, group.get_help_option(typer.Context(group))):
            if parameter is not None and getattr(parameter, "is_flag", False):
                parameter.metavar = ""
    return command


def _explain_system(error: OSError) -> str:
    if error.errno == errno.ENOENT and error.filename is None:
        try:
            os.getcwd()
        except OSError:
            return "the working directory is no longer there; change to another folder"
    return f"{error.filename}: {error.strerror}" if error.filename is not None else str(error.strerror or error)


def _explain_lost_output(failure: OSError) -> int:
    """Exit code when not all could be printed; a reader that wants no more (``| head``) is no error to speak of."""
    if failure.errno == errno.EPIPE:
        return _SIGNAL_EXIT + signal.SIGPIPE if hasattr(signal, "SIGPIPE") else 1
    errors.print(f"[red]error:[/] standard output cannot be written ({failure.strerror})")
    return DynsimError.exit_code


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings about what the user gave, or keeps on disk, are a line on stderr without the place in dynsim's code."""
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
        if issubclass(category, UserWarning):
            errors.print(f"[yellow]warning:[/] {_escape(str(message))}")
        else:
            shown(message, category, *place, **options)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = shown


def _print_version(wanted: bool) -> None:
    if wanted:
        console.print(__version__, highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Say on stderr what takes long, and the warnings of runs.")
    ] = False,
) -> None:
    if verbose:
        _log_to_stderr()


def _log_to_stderr() -> None:
    # Imported here: --help and --version need not wait for it.
    import logging

    class OnStderr(logging.StreamHandler[TextIO]):
        """Stderr; on a terminal the one of the moment: a progress bar puts what is written there above itself."""

        def __init__(self) -> None:
            super().__init__(sys.stderr)
            self.on_terminal = sys.stderr.isatty()

        def emit(self, record: logging.LogRecord) -> None:
            if self.on_terminal:
                self.setStream(sys.stderr)
            super().emit(record)

    handler = OnStderr()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    library = logging.getLogger("dynsim")
    library.addHandler(handler)
    library.setLevel(logging.INFO)


@app.command(epilog="Example: dynsim run elbow_comparison --variant two_elbows --set integrator.rtol=1e-8")
def run(
    scenario: ScenarioArgument,
    variant: Annotated[
        str | None,
        typer.Option(metavar="VARIANT", help="Variant to run; default: the first.", autocompletion=completion.variants),
    ] = None,
    overrides: SetOption = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="For the files; default: results/SCENARIO/VARIANT.")
    ] = None,
    no_figures: FiguresOption = False,
    format_: FormatOption = FigureFormat.png,
    quiet: QuietOption = False,
) -> None:
    """Simulate one scenario and write its record, summary and figures."""
    from dynsim.engine import simulate
    from dynsim.files import check_writable
    from dynsim.results import RUN_FILES, save_run
    from dynsim.scenario import load_scenario

    loaded = load_scenario(scenario, variant, _overrides(overrides))
    folder = out or Path("results", loaded.name, loaded.variant)
    check_writable(folder, RUN_FILES)
    try:
        with _progress([loaded], quiet) as report:
            record = simulate(loaded, partial(report, loaded.variant))
    except SimulationStopped as stop:
        if stop.record is not None:
            save_run(stop.record, folder)
            errors.print(f"what was simulated until then is in {_escape(folder)}, marked incomplete")
        raise
    save_run(record, folder)
    interruption.heed()
    interruption.check()
    if not no_figures:
        _draw(record, folder / "figures", quiet, format_)
    if not quiet:
        from dynsim.tables import print_summary

        print_summary(console, record.summary)
        console.print(f"Written to {_escape(folder)}", highlight=False, soft_wrap=True)


@app.command(epilog="Example: dynsim compare scenarios/elbow_comparison.yaml --jobs 2")
def compare(
    scenario: ScenarioArgument,
    overrides: SetOption = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="For the files; default: results/SCENARIO.")
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="Processes that simulate variants.")] = 1,
    no_figures: FiguresOption = False,
    format_: FormatOption = FigureFormat.png,
    quiet: QuietOption = False,
) -> None:
    """Simulate all variants of a scenario and compare them in a table and in figures."""
    from dynsim.files import check_writable, discard
    from dynsim.results import COMPARISON_FILES, RUN_FILES, save_run
    from dynsim.scenario import load_scenario, variant_names
    from dynsim.studies.compare import compare as compare_variants
    from dynsim.studies.compare import save_comparison

    given = _overrides(overrides)
    loaded = [load_scenario(scenario, name, given) for name in variant_names(scenario)]
    folder = out or Path("results", loaded[0].name if loaded else "")
    check_writable(folder, COMPARISON_FILES[:2])
    for one in loaded:
        check_writable(folder / one.variant, RUN_FILES)
    records: dict[str, Record] = {}

    def finished(name: str, record: Record) -> None:
        # What described the old records goes before the first of them does.
        discard(folder, COMPARISON_FILES)
        save_run(record, folder / name)
        records[name] = record

    def stopped(name: str, stop: SimulationStopped) -> None:
        if stop.record is not None:
            discard(folder, COMPARISON_FILES)
            save_run(stop.record, folder / name)
            where = _escape(folder / name)
            errors.print(f"what was simulated of {_escape(name)} until then is in {where}, marked incomplete")

    failure: SimulationStopped | None = None
    try:
        with _progress(loaded, quiet) as report:
            compare_variants(scenario, overrides=given, jobs=jobs, progress=report, finished=finished, stopped=stopped)
    except SimulationInterrupted:
        raise
    except SimulationStopped as stop:
        failure = stop
    # In the order of the file, whichever was ready first.
    records = {s.variant: records[s.variant] for s in loaded if s.variant in records}
    if records:
        save_comparison(records, folder)
        interruption.heed()
        interruption.check()
        if not no_figures:
            for name, record in records.items():
                _draw(record, folder / name / "figures", quiet, format_)
            _draw_comparison(records, folder, quiet, format_)
        if not quiet:
            from dynsim.tables import print_comparison

            print_comparison(console, {name: record.summary for name, record in records.items()})
            console.print(f"Written to {_escape(folder)}", highlight=False, soft_wrap=True)
    if failure is not None:
        raise failure


@app.command(epilog="Example: dynsim check elbow_comparison six_axis_arm")
def check(
    scenarios: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENARIO",
            help="Scenario files, or names of shipped ones.",
            autocompletion=completion.scenarios,
        ),
    ],
    overrides: SetOption = None,
) -> None:
    """Validate scenarios without running them: schema, model, contacts at the start, reachable references.

    Prints where hand and contact points start, in full digits, to be copied into a surface or a path.
    """
    from dynsim.engine import check as check_scenario
    from dynsim.scenario import load_scenario, variant_names
    from dynsim.tables import print_starts

    failed = False
    for name in scenarios:
        try:
            variants: Sequence[str | None] = variant_names(name) or [None]
            starts = {}
            for variant in variants:
                with console.status(f"checking {_escape(name)} {_escape(variant or '')}"):
                    starts[variant or ""] = check_scenario(load_scenario(name, variant, _overrides(overrides)))
        except SimulationInterrupted:
            raise
        except DynsimError as error:
            failed = True
            errors.print(f"[red]error:[/] {_escape(str(error))}")
        else:
            count = f"{len(variants)} variants" if len(variants) > 1 else "1 variant"
            console.print(f"{_escape(name)}: ok ({count})", highlight=False, soft_wrap=True)
            print_starts(console, starts)
    if failed:
        raise typer.Exit(2)


@app.command("list", epilog="Example: dynsim list")
def list_() -> None:
    """Show shipped scenarios, plants, surfaces, controllers, paths and motors."""
    from dynsim.tables import print_choices

    print_choices(console)


@app.command(epilog="Example: dynsim plot results/elbow_comparison/two_elbows/record.h5")
def plot(
    records: Annotated[list[Path], typer.Argument(metavar="RECORD", help="Records (HDF5).")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="For the figures; default: figures/ beside each record."),
    ] = None,
    format_: FormatOption = FigureFormat.png,
) -> None:
    """Draw the figures of records; two or more are also laid over each other."""
    from dynsim.record import Record

    labelled: dict[str, Record] = {}
    for path in records:
        record = Record.load(path)
        label = _label(path, record, labelled)
        labelled[label] = record
        folder = path.parent / "figures" if out is None else out if len(records) == 1 else out / label
        try:
            _draw(record, folder, quiet=False, format_=format_)
        except RecordError as error:
            raise RecordError(f"{path}: {error}") from error
    if len(labelled) > 1:
        _draw_comparison(labelled, out or Path("figures"), quiet=False, format_=format_)


@app.command(epilog="Example: dynsim bench --quick --json bench.json")
def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer sizes and repetitions.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures as JSON.")] = None,
) -> None:
    """Time right-hand sides and the whole job beside Pinocchio and MuJoCo (where installed)."""
    from dynsim.files import write_json
    from dynsim.studies.bench import format_table, run_bench

    with console.status("measuring"):
        result = run_bench(quick)
    for table in format_table(result):
        console.print(table)
    if json_file is not None:
        write_json(json_file, result)


@app.command(epilog="Example: dynsim schema > scenario.schema.json")
def schema() -> None:
    """Print the JSON schema of scenario files, for editors."""
    from dynsim.scenario import json_schema

    print(json.dumps(json_schema(), indent=2))


# These load serial ports and servos only when called.
app.add_typer(hw, name="hw")
app.command(
    epilog="Example: dynsim export results/elbow_comparison/two_elbows/record.h5 --format joint-trajectory --rate 100"
)(export)


def _overrides(given: list[str] | None) -> dict[str, Any]:
    from dynsim.scenario import SetOptions, parse_override

    return SetOptions(parse_override(text) for text in given or ())


def _label(path: Path, record: Record, taken: Container[str]) -> str:
    """A name for a record and its folder among others: its variant, numbered where another has the same."""
    from dynsim.files import file_name

    name = file_name(record.summary.get("variant") or path.parent.name or path.stem)
    return next(label for k in itertools.count(1) if (label := name if k == 1 else f"{name}_{k}") not in taken)


def _draw(record: Record, folder: Path, quiet: bool, format_: FigureFormat) -> None:
    from dynsim.figures import draw

    _drawing(lambda: draw(record, folder, format_.value), folder, quiet)


def _draw_comparison(records: dict[str, Record], folder: Path, quiet: bool, format_: FigureFormat) -> None:
    from dynsim.figures import draw_comparison

    _drawing(lambda: draw_comparison(records, folder, format_.value), folder, quiet)


def _drawing(draw: Any, folder: Path, quiet: bool) -> None:
    if quiet:
        draw()
    else:
        with console.status(f"drawing {_escape(folder)}"):
            draw()


@contextmanager
def _progress(scenarios: Sequence[Scenario], quiet: bool) -> Iterator[VariantProgress]:
    """A progress bar per scenario, with time and time to go, and one while references take long; yields its report."""
    if quiet:
        yield lambda variant, time, stage="": None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.table import Column

    from dynsim.engine import REFERENCES, SIMULATION
    from dynsim.kernels.jit import is_cached

    if not is_cached():
        console.print("Compiling the kernels: once after an installation or an edit, about half a minute.")
    # In 80 columns all fits up to 9999 s: the bar gives way, the times do not.
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.2f} / {task.total:g} s {task.fields[what]}"),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TextColumn("to go"),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
    )
    with Progress(*columns, console=console, transient=not console.is_terminal) as bars:

        def add(scenario: Scenario, what: str, visible: bool) -> TaskID:
            title = scenario.variant or scenario.name
            title = title if len(title) <= _TITLE_WIDTH else title[: _TITLE_WIDTH - 1] + "…"
            return bars.add_task(_escape(title), total=scenario.duration_s, what=what, visible=visible)

        preparing = {s.variant: add(s, "references", False) for s in scenarios}
        simulating = {s.variant: add(s, "simulated", True) for s in scenarios}

        def report(variant: str, time: float, stage: str = SIMULATION) -> None:
            bars.update(preparing[variant], completed=time, visible=stage == REFERENCES, refresh=stage == REFERENCES)
            if stage == SIMULATION:
                bars.update(simulating[variant], completed=time)

        yield report


if __name__ == "__main__":
    main()
