"""One fuzz case: input files, the commands that read them, and the files that must survive."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

KINDS = ("scenario", "override", "servo_map", "urdf", "csv_path", "record", "terrain", "sweep", "faults", "recording")
# The damaged file, by kind.
MAIN = {
    "scenario": "scenario.yaml", "override": "scenario.yaml", "servo_map": "map.yaml", "urdf": "robot.urdf",
    "csv_path": "path.csv", "record": "record.h5", "terrain": "heights.csv", "sweep": "out/runs.jsonl",
    "faults": "faults.yaml", "recording": "recording.csv",
}  # fmt: skip
# Substitutes for that file, and the fraction of cases with one: no input may block or never end.
NO_FILES = ("pipe", "folder", "nothing", "link to /dev/zero", "link to /dev/null", "link to itself", "unreadable")
NO_FILE_SHARE = 0.02
SHIPPED = Path(__file__).resolve().parents[2] / "scenarios"


@dataclass
class Draft:
    """Case drawn by the module of a kind.

    Attributes
    ----------
    what : str
        Description of the damage, for the report.
    files : dict[str, bytes or str]
        Content by file name; written to an empty folder, in which the commands run. A text is one of ``NO_FILES``.
    commands : list of list of str
        Arguments of ``dynsim``; each runs only if the preceding one succeeded.
    losses : callable, optional
        Called in that folder whatever the commands printed: returns values of the input that dynsim silently changed.
        Errors with which dynsim refuses the input must pass through.
    """

    what: str
    files: dict[str, bytes | str]
    commands: list[list[str]]
    losses: Callable[[], list[str]] | None = field(default=None)


def draw(kind: str, seed: int, index: int, records: Path) -> Draft:
    """Return the case with this number: always the same, in any order. ``records`` is the folder of valid records."""
    rng = Random(f"{seed}/{kind}/{index}")
    case: Draft = importlib.import_module(f"fuzz.inputs.{kind}").draw(rng, records)
    if rng.random() < NO_FILE_SHARE:
        case.files[MAIN[kind]] = mutation = rng.choice(NO_FILES)
        case.what = f"{mutation} as {MAIN[kind]}"
    return case


def put(path: Path, content: bytes | str) -> None:
    """Write a file of a case, or its substitute."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "pipe":
        os.mkfifo(path)
    elif content == "folder":
        path.mkdir()
    elif content.startswith("link to "):
        path.symlink_to(path.name if content.endswith("itself") else content.removeprefix("link to "))
    elif content == "unreadable":
        path.touch(mode=0)
