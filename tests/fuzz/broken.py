"""Deliberately broken loaders, one per kind of failure: each breaks reading a record in its own way."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def _load_with(before: Callable[[], Any]) -> None:
    """Records are loaded as ever, after ``before``."""
    from dynsim.record import Record

    sound = Record.load.__func__  # type: ignore[attr-defined]

    def load(cls: type[Record], path: Any) -> Record:
        before()
        return sound(cls, path)

    Record.load = classmethod(load)  # type: ignore[assignment,method-assign]


def raises() -> None:
    """A traceback."""
    _load_with(lambda: int("no number"))


def hangs() -> None:
    """A loop that heeds Ctrl-C."""
    _load_with(lambda: time.sleep(3600))


def hangs_deaf() -> None:
    """A loop in which no Ctrl-C helps, as in a compiled library."""

    def wait() -> None:
        while True:
            try:
                time.sleep(3600)
            except KeyboardInterrupt:
                continue

    _load_with(wait)


def aborts() -> None:
    """The interpreter ends by a signal."""
    _load_with(os.abort)


def exits() -> None:
    """The interpreter ends without a word."""
    _load_with(lambda: os._exit(0))


def eats_memory() -> None:
    """More memory than the machine has."""
    _load_with(lambda: bytearray(64 << 30))


def babbles() -> None:
    """Two errors, one of them with the terminal's control codes."""

    def say() -> None:
        from dynsim.errors import RecordError

        print("error: \x1b[31mone\nand more", file=sys.stderr)
        raise RecordError("two")

    _load_with(say)


def loses() -> None:
    """Masses of scenarios a hundredth too large."""
    from dynsim.plants import serial_arm

    sound = serial_arm.LinkConfig.inertia

    def inertia(self: Any) -> Any:
        body = sound(self)
        return type(body)(1.01 * body.mass, body.com, body.tensor)

    serial_arm.LinkConfig.inertia = inertia  # type: ignore[method-assign]


def overwrites() -> None:
    """A refused command has touched an older file."""
    from dynsim.errors import RecordError

    def touch() -> None:
        Path("out.txt").write_text("gone", encoding="utf-8")
        raise RecordError("refused, too late")

    _load_with(touch)


def litters() -> None:
    """A refused command leaves a temporary file."""
    from dynsim.errors import RecordError

    def touch() -> None:
        Path("out.txt.tmp").write_text("half", encoding="utf-8")
        raise RecordError("refused, with a rest")

    _load_with(touch)
