"""The Typer application and the options that several commands share."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from dynsim._version import __version__
from dynsim.cli.output import console
from dynsim.config import completion

app = typer.Typer(
    name="dynsim",
    help="Dynamic simulator of braced hyper-redundant manipulators: energy, tracking, contact and motors.",
    epilog="Example: dynsim run single_pendulum",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


def option(metavar: str, description: str, **settings: Any) -> Any:
    """Return an option with a value, named ``metavar`` in the help; ``settings``: limits or completion of the value."""
    return typer.Option(metavar=metavar, help=description, **settings)


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="Path of a scenario file, or the name of a shipped scenario (see `dynsim list`).",
        autocompletion=completion.scenarios,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="a.b.c=VALUE", help="Override one scenario key, e.g. `integrator.rtol=1e-8`; repeatable."
    ),
]
VariantOption = Annotated[
    str | None, option("VARIANT", "Variant to use; default: the first in the file.", autocompletion=completion.variants)
]
RecordsArgument = Annotated[
    list[Path], typer.Argument(metavar="RECORD", help="Records (HDF5), simulated or measured, or folders of runs.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
TrustOption = Annotated[
    bool,
    typer.Option(
        "--trust", help="Accept records whose digest is missing or wrong (written or changed by another program)."
    ),
]


class Rows(StrEnum):
    screen = "screen"
    all = "all"


RowsOption = Annotated[
    Rows, typer.Option("--rows", help="Rows and warnings to print: as many as fit on a screen, or all.")
]
FiguresOption = Annotated[bool, typer.Option("--no-figures", help="Skip the figures and view.html.")]


def parsed_overrides(texts: list[str] | None, name: str = "--set", inside: str = "") -> dict[str, Any]:
    """Return the values passed with an option, by key; keys are inside a section."""
    from dynsim.scenario import parse_override

    return dict(parse_override(text, name, inside) for text in texts or ())


def folder_option(default: str) -> Any:
    """Return the option ``--out`` of a command that writes several files."""
    return option("FOLDER", f"Output folder; default: {default}.")


class FigureFormat(StrEnum):
    png = "png"
    pdf = "pdf"
    svg = "svg"


SizeOption = Annotated[
    str | None, option("WxH", "Width, or width and height, of the figures: 3.4, 3.4x2.4 [inch] or 86mm.")
]
FontOption = Annotated[
    str | None, option("FONT", "Size of the labels [point], a font family, or both, e.g. 8 or 'serif 8'.")
]
StyleOption = Annotated[
    str | None, option("SHEETS", "Matplotlib style sheets of the figures: files or names, comma-separated.")
]
PanelsOption = Annotated[
    str | None,
    option(
        "NAMES",
        "Draw only the figures with these panels, and only the panels: names or parts of names, comma-separated, such "
        "as distance,work; an unknown name lists all. Several records: only their overlay.",
    ),
]
NoTitleOption = Annotated[bool, typer.Option("--no-title", help="Omit the titles of the figures.")]
NoCaptionOption = Annotated[
    bool, typer.Option("--no-caption", help="Omit the notes below the axes; captions.txt has them.")
]
FormatOption = Annotated[FigureFormat, typer.Option("--format", help="File format of the figures.")]


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
        bool, typer.Option("--verbose", "-v", help="Log slow steps and run warnings to stderr.")
    ] = False,
) -> None:
    if verbose:
        _log_to_stderr()


def _log_to_stderr() -> None:
    # Imported here so that --help and --version start faster.
    import logging

    class OnStderr(logging.StreamHandler[TextIO]):
        """Handler that writes to the current stderr, because a progress bar replaces stderr to print above itself."""

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
