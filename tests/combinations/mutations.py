"""Mutation check of the harness: faults that dynsim once had are put back one by one, and the scenes must find each.

    PYTHONPATH=.:tests python -m combinations.mutations --count 12 --only jam

copies the package, restores the fault, compiles it, and runs scenes of the pair cover that have the levels concerned.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dynsim
from combinations.covering import pairs
from combinations.factors import SAMPLED, UNILATERAL

SEED = 1
PACKAGE = Path(dynsim.__file__).parent
TESTS = Path(__file__).parents[1]
RUBBING = ("bearing", "gear", "both")


@dataclass(frozen=True)
class Fault:
    """A fault that dynsim had.

    Attributes
    ----------
    name : in a word or two
    effect : of the fault, on runs
    texts : file below the package, present text, text with the fault
    levels : of the scenes that can have it, by factor
    """

    name: str
    effect: str
    texts: tuple[tuple[str, str, str], ...]
    levels: dict[str, tuple[str, ...]]


FAULTS = (
    Fault(
        "start",
        "sampled commands with dry joint friction start the arm at q = 0",
        (
            (
                "integrators/driver.py",
                "    if unilateral is not None and run.count[ki.MODES_DUE] > 0:\n        derivative(",
                "    if unilateral is not None and run.count[ki.MODES_DUE] < 0:\n        derivative(",
            ),
        ),
        {"controller": SAMPLED, "rubbing": RUBBING, "contact": UNILATERAL},
    ),
    Fault(
        "directions",
        "time stepping records contact forces along other tangents than those of the step",
        (("integrators/stepping/step.py", "        put_directions_back(s, ws)\n", ""),),
        {"contact": UNILATERAL[1:], "friction": ("coulomb", "static", "viscous", "stribeck", "high")},
    ),
    Fault(
        "jam",
        "friction holds a point that nothing presses",
        (
            (
                "integrators/contacts/events.py",
                "if mode == ka.STICKING and unilateral.number[ku.SPLIT] == 1.0 and normal_is_open",
                "if mode == ka.STICKING and unilateral.number[ku.SPLIT] == 2.0 and normal_is_open",
            ),
        ),
        {"surface": ("steep",), "friction": ("high", "static", "stribeck"), "contact": ("points",)},
    ),
    Fault(
        "immobile",
        "a contact point that no joint moves gets a constraint row",
        (
            ("scenario/build.py", "left_out=mark.left_out)", "left_out=False)"),
            (
                "integrators/contacts/impacts.py",
                "if near and not moves_along_normal(",
                "if False and not moves_along_normal(",
            ),
        ),
        {"points": ("unmoved",), "contact": ("points", "joints", "links", "glued")},
    ),
    Fault(
        "cone",
        "an equilibrium that needs friction starts on the edge of the friction cone",
        (("compile/equilibrium.py", "RESERVED = 0.9", "RESERVED = 1.0"),),
        {"start": ("equilibrium",), "contact": UNILATERAL[1:]},
    ),
    Fault(
        "stops",
        "time stepping leaves a joint beyond a stop that it has passed",
        (
            (
                "integrators/stepping/contacts.py",
                "    if loss > 0.0:\n        rate = return_rate(min(stop_gap",
                "    if loss < 0.0:\n        rate = return_rate(min(stop_gap",
            ),
        ),
        {"stops": ("reached",), "contact": UNILATERAL},
    ),
    Fault(
        "soft start",
        "the preliminary run of the snake sees objects and ties",
        (("engine/snake_start.py", "        alone = _alone(scenario)\n", "        alone = scenario\n"),),
        {"plant": ("snake",)},
    ),
    Fault(
        "signals",
        "the recorded voltage of a sampled loop is that held until the tick",
        (
            (
                "integrators/dense.py",
                "    if not sampled_now(run):\n        return\n",
                "    if run.count[ki.SAMPLE] >= 0:\n        return\n",
            ),
        ),
        {"controller": SAMPLED},
    ),
)


def restore(fault: Fault, folder: Path) -> None:
    """Copy the package into ``folder``, with a fault.

    Raises
    ------
    LookupError
        The text that the fault replaces is not there.
    """
    target = folder / PACKAGE.name
    shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))
    scenarios = PACKAGE.parent / "scenarios"
    if scenarios.exists():
        (folder / "scenarios").symlink_to(scenarios)
    for name, present, faulty in fault.texts:
        path = target / name
        text = path.read_text("utf-8")
        if text.count(present) != 1:
            raise LookupError(f"{fault.name}: {name} has {text.count(present)} times {present!r}")
        path.write_text(text.replace(present, faulty), "utf-8")


def concerned(fault: Fault, count: int) -> list[int]:
    """Numbers of the first scenes of the pair cover that have the fault's levels."""
    cover = pairs(SEED)
    fitting = [k for k, levels in enumerate(cover) if all(levels[f] in own for f, own in fault.levels.items())]
    return fitting[:count]


def look(folder: Path, numbers: list[int]) -> dict[int, list[tuple[str, str]]]:
    """Problems of scenes by number, found with the package in ``folder``, in a process of its own."""
    journal = folder / "journal.jsonl"
    # A seed keeps the order of sets, and with it that of what is drawn, the same in both runs.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(TESTS)])}
    command = [sys.executable, "-m", "combinations", "--cover", "pairs", "--seed", str(SEED), "--journal", str(journal)]
    command += ["--jobs", "1", "--numbers", *map(str, numbers)]
    subprocess.run(command, env=environment, cwd=folder, capture_output=True, check=False, timeout=3600)
    rows: list[dict[str, Any]] = [json.loads(line) for line in journal.read_text("utf-8").splitlines()]
    return {row["number"]: [(kind, text) for kind, text in row["problems"]] for row in rows}


def found(fault: Fault, count: int) -> dict[int, list[tuple[str, str]]]:
    """Problems of the scenes that a fault concerns, once it is back."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        restore(fault, folder)
        return look(folder, concerned(fault, count))


def main() -> int:
    """Print which scenes find each fault; 1 if one is not found."""
    parser = argparse.ArgumentParser(prog="python -m combinations.mutations", description=__doc__)
    parser.add_argument("--count", type=int, default=12, help="most scenes for each fault")
    parser.add_argument("--only", choices=[fault.name for fault in FAULTS], help="this fault alone")
    options = parser.parse_args()
    missed = 0
    for fault in FAULTS:
        if options.only not in (None, fault.name):
            continue
        seen = {number: texts for number, texts in found(fault, options.count).items() if texts}
        missed += not seen
        print(f"{fault.name} ({fault.effect}): {'found' if seen else 'NOT FOUND'} by scenes {sorted(seen)}", flush=True)
        for number, texts in seen.items():
            kind, text = texts[0]
            print(f"    {number}: {kind}: {text[:200]}", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
