"""Deliberately broken loaders, one per kind of failure: the fuzzer must detect each of them.

Before a record is loaded, the entry of :data:`WAYS` with the number of the case is called. Every link of a serial arm
has 1 % more mass.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any


def install() -> None:
    """Break the loaders of this process."""
    from dynsim.library.plants.serial_arm import LinkConfig
    from dynsim.record import Record

    sound_load, sound_inertia = Record.load.__func__, LinkConfig.inertia  # type: ignore[attr-defined]

    def load(cls: type[Record], path: Any, *, trust: bool = False) -> Record:
        # A case runs in a folder with its name and number.
        number = Path.cwd().name.rpartition("-")[2]
        if not number.isdecimal():
            return sound_load(cls, path, trust=trust)
        list(WAYS.values())[int(number) % len(WAYS)]()
        return sound_load(cls, path, trust=trust)

    def inertia(self: Any) -> Any:
        body = sound_inertia(self)
        return type(body)(1.01 * body.mass, body.com, body.tensor)

    sys.modules["__main__"].RESIDENT = 600.0  # type: ignore[attr-defined]
    Record.load = classmethod(load)  # type: ignore[assignment,method-assign]
    LinkConfig.inertia = inertia  # type: ignore[method-assign]


def _hang_deaf() -> None:
    while True:
        try:
            time.sleep(3600)
        except KeyboardInterrupt:
            continue


def _babble() -> None:
    print("error: \x1b[31mone\nand more", file=sys.stderr)
    _refuse()


def _overwrite(name: str) -> None:
    Path(name).write_text("gone", encoding="utf-8")
    _refuse()


def _refuse() -> None:
    from dynsim.errors import RecordError

    raise RecordError("refused")


WAYS = {
    "raises": lambda: int("no number"),
    "hangs": lambda: time.sleep(3600),
    "takes all memory": lambda: bytearray(64 << 30),
    "takes 0.6 GB": lambda: len(b"x" * 600_000_000) and _refuse(),
    "babbles": _babble,
    "overwrites": lambda: _overwrite("map.yaml"),
    "litters": lambda: _overwrite("map.yaml.tmp"),
    "hangs deaf": _hang_deaf,
    "aborts": os.abort,
    "exits": lambda: os._exit(0),
    "refuses": _refuse,
}
