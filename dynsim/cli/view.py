"""Command ``dynsim view``, and the pages that ``run`` and ``compare`` write."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynsim.cli.app import TrustOption
from dynsim.cli.display import console, labelled, record_files, say, say_written
from dynsim.cli.drawing import Page
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.record import Record


def view(
    records: Annotated[
        list[Path], typer.Argument(metavar="RECORD", help="Records (HDF5), measured ones too, or folders of runs.")
    ],
    ghost: Annotated[
        bool, typer.Option("--ghost", help="Lay several over each other, the first one solid; default: side by side.")
    ] = False,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = True,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="For the page; default: view.html beside the record or in the folder, here for several.",
        ),
    ] = None,
    trust: TrustOption = False,
) -> None:
    """Write a page that shows records in 3D, with plots and forces over time, for any browser and without a network."""
    from dynsim.draw.page import write
    from dynsim.engine.results import VIEW

    named = labelled(record_files(records), trust=trust)
    first = records[0] if records[0].is_dir() else records[0].parent
    page = out or (first if len(records) == 1 else Path()) / VIEW
    with console.status(f"writing {escaped(page)}"):
        write(named, page, ghost=ghost)
    say_written(page)
    if open_:
        open_page(page)


def write_view(records: Mapping[str, Record], folder: Path, quiet: bool) -> Path | None:
    """The page of records in a folder, and say where; None where they have nothing to be seen."""
    page = Page(dict(records), folder).draw()
    tell_of_view(page, quiet)
    return page


def tell_of_view(page: Path | None, quiet: bool) -> None:
    """Say where a page is that was written."""
    if page is not None and not quiet:
        say(f"To be seen in a browser: {escaped(page)}")


def open_page(page: Path) -> None:
    """Open a page in the user's browser, or say that there is no display to open one on."""
    open_address(page.absolute().as_uri(), escaped(page))


def open_address(address: str, name: str = "") -> None:
    """Open an address in the user's browser, or say that there is no display to open one on."""
    import webbrowser

    # Without a display some systems start a browser within the terminal.
    display = sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")))
    if not display or not webbrowser.open(address):
        say(f"No browser opened; open {name or address} in one")
