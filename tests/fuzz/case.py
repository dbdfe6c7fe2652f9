"""One fuzz case: input files, the commands that read them, and the files that must survive."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

KINDS = ("scenario", "override", "servo_map", "urdf", "csv_path", "record", "terrain", "sweep", "faults")
# The file that is damaged, by kind.
MAIN = {
    "scenario": "scenario.yaml", "override": "scenario.yaml", "servo_map": "map.yaml", "urdf": "robot.urdf",
    "csv_path": "path.csv", "record": "record.h5", "terrain": "heights.csv", "sweep": "out/runs.jsonl",
    "faults": "faults.yaml",
}  # fmt: skip
# Substitutes for that file, and the share of cases with one: no input may block or never end.
NO_FILES = ("pipe", "folder", "nothing", "link to /dev/zero", "link to /dev/null", "link to itself", "unreadable")
NO_FILE_SHARE = 0.02
SHIPPED = Path(__file__).resolve().parents[2] / "scenarios"


@dataclass
class Draft:
    """What the module of a kind draws.

    Attributes
    ----------
    what : str
        How the input was broken, for the report.
    files : dict[str, bytes or str]
        By name; written to an empty folder, in which the commands run. A text is one of ``NO_FILES``.
    commands : list of list of str
        Arguments of ``dynsim``; each runs only when the one before went well.
    losses : callable, optional
        Called in that folder whatever the commands said: what dynsim took without a word although it does not say what
        the input says. It must let the errors through with which dynsim refuses the input.
    """

    what: str
    files: dict[str, bytes | str]
    commands: list[list[str]]
    losses: Callable[[], list[str]] | None = field(default=None)


def draw(kind: str, seed: int, index: int, records: Path) -> Draft:
    """The case of this number: the same ones for ever, in any order. ``records`` is the folder of sound records."""
    rng = Random(f"{seed}/{kind}/{index}")
    case: Draft = importlib.import_module(f"fuzz.inputs.{kind}").draw(rng, records)
    if rng.random() < NO_FILE_SHARE:
        case.files[MAIN[kind]] = mutation = rng.choice(NO_FILES)
        case.what = f"{mutation} as {MAIN[kind]}"
    return case


def put(path: Path, content: bytes | str) -> None:
    """Write a file of a case, or what stands in its place."""
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
