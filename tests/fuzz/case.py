"""One fuzz case: input files, the commands that read them, and the files that must survive."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import NamedTuple


class Kind(NamedTuple):
    """Kind of input: its module in ``inputs``, the damaged file if any, and its weight in a campaign.

    The function ``draw`` of a module with several kinds has the kind as third parameter.
    """

    module: str
    file: str = ""
    weight: int = 1


KINDS = {
    # Damaged files.
    "scenario": Kind("scenario", "scenario.yaml", 3),
    "override": Kind("override", "scenario.yaml", 4),
    "servo_map": Kind("servo_map", "map.yaml", 2),
    "urdf": Kind("urdf", "robot.urdf", 5),
    "csv_path": Kind("csv_path", "path.csv", 3),
    "record": Kind("record", "record.h5"),
    "hdf5": Kind("record", "record.h5"),
    "terrain": Kind("terrain", "heights.csv", 3),
    "tables": Kind("tables", "table.csv", 3),
    "sweep": Kind("sweep", "out/runs.jsonl", 2),
    "faults": Kind("faults", "faults.yaml"),
    "measured": Kind("servos", "measured.h5"),
    "recovery": Kind("servos", "out/measured.part"),
    "obj": Kind("mesh", "mesh.obj", 4),
    "stl": Kind("mesh", "mesh.stl", 4),
    "dae": Kind("mesh", "mesh.dae", 4),
    "recording": Kind("recording", "recording.csv", 2),
    # Inputs near valid ones, most of which run.
    "arm": Kind("simulation", weight=3),
    "braced_arm": Kind("simulation", weight=4),
    "mobile_arm": Kind("simulation", weight=2),
    "urdf_arm": Kind("simulation", weight=2),
    "loads": Kind("simulation", weight=3),
    "sensors": Kind("simulation", weight=2),
    "snake": Kind("simulation", weight=4),
    "dynamic_snake": Kind("simulation"),
    "gripper": Kind("simulation"),
    "set_value": Kind("simulation", weight=4),
    "compare": Kind("options"),
    "sweep_plan": Kind("options", weight=2),
    "plan": Kind("options"),
    "view": Kind("options"),
    "plot": Kind("options"),
    "animate": Kind("options"),
    "export": Kind("options", weight=2),
    "robot_export": Kind("options"),
    "servo_options": Kind("servos"),
    "names": Kind("names"),
    # Messages, requests and calls.
    "message": Kind("remote", weight=6),
    "request": Kind("remote", weight=4),
    "call": Kind("calls", weight=7),
    "steps": Kind("calls", weight=3),
}
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
    simulates : bool
        Whether ``losses`` itself runs a simulation.
    """

    what: str
    files: dict[str, bytes | str]
    commands: list[list[str]]
    losses: Callable[[], list[str]] | None = None
    simulates: bool = False


def draw(kind: str, seed: int, index: int, records: Path) -> Draft:
    """Return the case with this number: always the same, in any order. ``records`` is the folder of valid records."""
    rng = Random(f"{seed}/{kind}/{index}")
    module, file, _ = KINDS[kind]
    make = importlib.import_module(f"fuzz.inputs.{module}").draw
    several = sum(other.module == module for other in KINDS.values()) > 1
    case: Draft = make(rng, records, kind) if several else make(rng, records)
    if file and rng.random() < NO_FILE_SHARE:
        case.files[file] = mutation = rng.choice(NO_FILES)
        case.what = f"{mutation} as {file}"
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
