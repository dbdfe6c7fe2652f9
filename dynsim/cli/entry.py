"""Entry point of the command line: prints errors and warnings as one line each and sets the exit code."""

from __future__ import annotations

import errno
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import typer

from dynsim.cli.commands import app
from dynsim.cli.output import print_error, print_warning
from dynsim.errors import DynsimError, SimulationInterrupted
from dynsim.system import interruption
from dynsim.system.terminal import lenient_streams


def main(received: Sequence[int]) -> None:
    """Run the command line and exit; print an error as one line, and set the exit code.

    ``received`` is the list of signals from :func:`dynsim.system.interruption.handled`, whose block encloses this call.
    If there are no results to save, Ctrl-C ends the program with exit code 130.
    """
    with lenient_streams() as output, _plain_warnings():
        code = _exit_code()
        if output is not None:
            output.flush()
            if code == 0 and output.failure is not None:
                code = _explain_lost_output(output.failure)
    code = interruption.exit_code(received) if code == SimulationInterrupted.exit_code else code
    if interruption.is_left():
        # A normal exit would free data that a thread in compiled code still uses.
        with suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _exit_code() -> int:
    """Run the command in the arguments, print its error, if any, and return the exit code."""
    try:
        _command()(prog_name="dynsim")
    except SystemExit as finished:
        return finished.code if isinstance(finished.code, int) else 0 if finished.code is None else 1
    except DynsimError as error:
        problem, code = str(error), error.exit_code
    except MemoryError as error:
        problem, code = f"not enough memory: {error}".removesuffix(": "), DynsimError.exit_code
    except OSError as error:
        # An error of the operating system that no caller has replaced by a better message.
        problem, code = _explain_system(error), DynsimError.exit_code
    except KeyboardInterrupt:
        return SimulationInterrupted.exit_code
    else:
        return 0
    print_error(problem)
    return code


def _command() -> Any:
    """Return the command line as one command; its help shows no metavar for flags, because they take no value."""
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
            return "the working directory no longer exists; change to another folder"
    return f"{error.filename}: {error.strerror}" if error.filename is not None else str(error.strerror or error)


def _explain_lost_output(failure: OSError) -> int:
    """Return the exit code after a failed write to stdout; a closed pipe (``| head``) is not reported as an error."""
    if failure.errno == errno.EPIPE:
        return interruption.exit_code([signal.SIGPIPE]) if hasattr(signal, "SIGPIPE") else 1
    print_error(f"cannot write to standard output ({failure.strerror})")
    return DynsimError.exit_code


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print warnings about input or files in the block as one line on stderr, without their location in the code."""
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *location: Any, **options: Any) -> None:
        if issubclass(category, UserWarning):
            print_warning(message)
        elif not issubclass(category, RuntimeWarning):  # of numpy; results that are not finite have errors of their own
            shown(message, category, *location, **options)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = shown
