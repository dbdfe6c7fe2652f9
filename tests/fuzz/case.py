"""One case: the files of an input, the commands that read them, and what must not be lost."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

KINDS = ("scenario", "override", "servo_map", "urdf", "csv_path", "record")
SHIPPED = Path(__file__).resolve().parents[2] / "scenarios"


@dataclass
class Draft:
    """What the module of a kind draws.

    Attributes
    ----------
    what : str
        How the input was broken, for the report.
    files : dict[str, bytes]
        By name; written to an empty folder, in which the commands run.
    commands : list of list of str
        Arguments of ``dynsim``; each runs only when the one before went well.
    losses : callable, optional
        Called in that folder whatever the commands said: what dynsim took without a word although it does not say what
        the input says. It must let the errors through with which dynsim refuses the input.
    """

    what: str
    files: dict[str, bytes]
    commands: list[list[str]]
    losses: Callable[[], list[str]] | None = field(default=None)


def draw(kind: str, seed: int, index: int, records: Path) -> Draft:
    """The case of this number: the same ones for ever, in any order. ``records`` is the folder of sound records."""
    return importlib.import_module(f"fuzz.inputs.{kind}").draw(Random(f"{seed}/{kind}/{index}"), records)
