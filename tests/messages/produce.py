"""Run a case in this process, in an empty folder, and return the messages that a user reads."""

from __future__ import annotations

import ast
import io
import re
import shlex
import sys
import tempfile
import warnings
from collections.abc import Mapping
from contextlib import ExitStack, chdir, redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer

from dynsim.cli import main
from dynsim.errors import DynsimError
from dynsim.scenario import SHIPPED
from messages.case import Case
from messages.objects import Objects

# Building the command takes ten times as long as most commands, so it is done once.
_get_command = cache(typer.main.get_command)
NOTHING = "(no message)"
# Kind of an exception that is not dynsim's own.
FOREIGN = "not dynsim's:"
# Addresses of objects differ between runs, and the last digits of numbers between machines.
_ADDRESS = re.compile(r"0x[0-9a-f]{6,}")
_DECIMAL = re.compile(r"\d+\.\d+(?:e[-+]\d+)?")
_ALL_DIGITS = re.compile(r"-?\d+\.\d{9,}(?:e[-+]?\d+)?|-?\d\.\d+e-1[3-9]")


def produce(case: Case) -> list[str]:
    """Return the messages of a case, each with its kind first: the class of an error, "warning", "exit 2", …"""
    with tempfile.TemporaryDirectory(prefix="messages-") as folder, chdir(folder):
        for name, content in case.files.items():
            path = Path(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            content = content() if callable(content) else content
            path.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
        run = _command if case.action.startswith("dynsim ") else _python
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            messages = run(case.action)
        said = [f"warning: {entry.message}" for entry in caught if issubclass(entry.category, UserWarning)]
        places = {str(Path(folder).resolve()): "FOLDER", folder: "FOLDER", str(SHIPPED): "SHIPPED"}
    texts = [_portable(message, places) for message in said + messages] or [NOTHING]
    return [_DECIMAL.sub(_without_digits, text) for text in texts] if case.measured else texts


def _portable(message: str, places: Mapping[str, str]) -> str:
    for path, name in places.items():
        message = message.replace(path, name)
    return _ALL_DIGITS.sub(_rounded, _ADDRESS.sub("0x…", message.strip()))


def _rounded(number: re.Match[str]) -> str:
    """Round a number to six digits, and a rounding error to zero."""
    value = float(number[0])
    return f"{value:.6g}…" if abs(value) > 1e-12 else "0…"


def _without_digits(number: re.Match[str]) -> str:
    return re.sub(r"\d", "#", number[0])


def _python(text: str) -> list[str]:
    """Return the error of Python statements, or the warnings and texts of the value of the last one."""
    *body, last = ast.parse(text).body
    names = Objects()
    try:
        exec(compile(ast.Module(body, []), "<input>", "exec"), names)
        if isinstance(last, ast.Expr):
            return _texts(eval(compile(ast.Expression(last.value), "<input>", "eval"), names))
        exec(compile(ast.Module([last], []), "<input>", "exec"), names)
    except DynsimError as error:
        return [f"{type(error).__name__}: {error}"]
    except Exception as error:
        return [f"{FOREIGN} {type(error).__name__}: {error}"]
    return []


def _texts(value: Any) -> list[str]:
    """Return the warnings of a start or a record; texts unchanged."""
    if isinstance(value, str):
        return [f"text: {value}"]
    if isinstance(value, (list, tuple)):
        return [text for entry in value for text in _texts(entry)]
    said = getattr(value, "warnings", None)
    said = value.summary.get("warnings", ()) if said is None and hasattr(value, "summary") else said
    return [f"warning: {text}" for text in said or ()]


def _command(line: str) -> list[str]:
    """Return the lines of a command on standard error, or else on standard output, each with its exit code."""
    output, errors, code = io.StringIO(), io.StringIO(), 0
    with ExitStack() as inside, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", shlex.split(line))
        patch.setattr(typer.main, "get_command", _get_command)
        inside.enter_context(redirect_stdout(output))
        inside.enter_context(redirect_stderr(errors))
        # The command line prints warnings itself.
        inside.enter_context(warnings.catch_warnings())
        warnings.simplefilter("default")
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
        except Exception as error:
            return [f"{FOREIGN} {type(error).__name__}: {error}"]
    printed = errors.getvalue() if errors.getvalue().strip() else output.getvalue()
    lines = [text.rstrip() for text in printed.splitlines() if text.strip()]
    # Continuation lines begin with a blank.
    messages: list[str] = []
    for text in lines:
        if text.startswith(" ") and messages:
            messages[-1] += f"\n{text}"
        else:
            messages.append(f"exit {code}: {text}")
    return messages
