"""`python -m dynsim.hardware`: the hardware commands alone."""

from __future__ import annotations

import sys

import typer

from dynsim.errors import DynsimError
from dynsim.hardware.cli import export, hw

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
app.add_typer(hw, name="hw")
app.command()(export)


def main() -> None:
    try:
        app()
    except DynsimError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
