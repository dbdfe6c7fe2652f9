"""Mutation check of the harness: faults that dynsim once had are restored one by one, and the scenes must detect each.

    PYTHONPATH=.:tests python -m combinations.mutations --only jam

copies the package, restores the fault, compiles it, and runs the scenes of :mod:`combinations.known` that once failed.
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
from combinations import study
from combinations.known import KNOWN, KNOWN_SEED

PACKAGE = Path(dynsim.__file__).parent
TESTS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Fault:
    """A fault that dynsim had.

    Attributes
    ----------
    name : str
        Key of the scenes in :data:`combinations.known.KNOWN`.
    texts : tuple
        File below the package, present text, text with the fault.
    """

    name: str
    texts: tuple[tuple[str, str, str], ...]


FAULTS = (
    Fault(
        "sampled_start",
        (
            (
                "integrators/driver.py",
                "    if unilateral is not None and run.count[ki.MODES_DUE] > 0:\n        derivative(",
                "    if unilateral is not None and run.count[ki.MODES_DUE] < 0:\n        derivative(",
            ),
        ),
    ),
    Fault(
        "force_of_spheres",
        (("integrators/stepping/step.py", "        restore_directions(s, ws)\n", ""),),
    ),
    Fault(
        "jam",
        (
            (
                "integrators/contacts/events.py",
                "if mode == ka.STICKING and unilateral.number[ku.SPLIT] == 1.0 and normal_is_open",
                "if mode == ka.STICKING and unilateral.number[ku.SPLIT] == 2.0 and normal_is_open",
            ),
        ),
    ),
    Fault(
        "unmoved",
        (
            ("scenario/build.py", "left_out=left_out)", "left_out=False)"),
            (
                "integrators/contacts/impacts.py",
                "if near and not moves_along_normal(",
                "if False and not moves_along_normal(",
            ),
        ),
    ),
    Fault(
        "equilibrium",
        (("compile/posture.py", "RESERVED = 0.9", "RESERVED = 1.0"),),
    ),
    Fault(
        "passed_stop",
        (
            (
                "integrators/stepping/contacts.py",
                "    if loss > 0.0:\n        rate = return_rate(min(stop_gap",
                "    if loss < 0.0:\n        rate = return_rate(min(stop_gap",
            ),
        ),
    ),
    Fault(
        "snake_start",
        (("engine/snake_control.py", "        alone = _alone(scenario)\n", "        alone = scenario\n"),),
    ),
    Fault(
        "voltage",
        (
            (
                "integrators/run.py",
                "    if not sampled_now(run):\n        return\n",
                "    if run.count[ki.SAMPLE] >= 0:\n        return\n",
            ),
        ),
    ),
)


def restore(fault: Fault, folder: Path) -> None:
    """Copy the package into ``folder``, with a fault.

    Raises
    ------
    LookupError
        If the text that the fault replaces is missing.
    """
    target = folder / PACKAGE.name
    shutil.copytree(PACKAGE, target, ignore=shutil.ignore_patterns("__pycache__"))
    if (scenarios := PACKAGE.parent / "scenarios").exists():
        (folder / "scenarios").symlink_to(scenarios)
    for name, present, faulty in fault.texts:
        path = target / name
        text = path.read_text("utf-8")
        if text.count(present) != 1:
            raise LookupError(f"{fault.name}: {name} has {text.count(present)} times {present!r}")
        path.write_text(text.replace(present, faulty), "utf-8")


def problems(name: str) -> list[str]:
    """Return the problems of the scenes of a known fault, with the package of this process."""
    listed = []
    for number in KNOWN[name].numbers:
        with tempfile.TemporaryDirectory() as temporary:
            outcome = study.look_at(KNOWN[name].assignment, KNOWN_SEED, number, Path(temporary), thorough=False)
        listed += [f"scene {number}: {kind}: {text}" for kind, text in outcome.problems]
    return listed


def problems_with(fault: Fault) -> list[str]:
    """Return :func:`problems` from a separate process whose package has the fault."""
    with tempfile.TemporaryDirectory() as temporary:
        restore(fault, Path(temporary))
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([temporary, str(TESTS)])}
        command = [sys.executable, "-m", "combinations.mutations", "--inspect", fault.name]
        done = subprocess.run(command, env=environment, cwd=temporary, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{fault.name}: {done.stderr[-2000:]}")
        report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        if Path(report["package"]).parent != Path(temporary).resolve():
            raise RuntimeError(f"{fault.name}: the process used {report['package']}, not the package with the fault")
        return list(report["problems"])


def main() -> int:
    """Print the problems that the scenes report for each fault; return 1 if a fault is not detected."""
    parser = argparse.ArgumentParser(prog="python -m combinations.mutations", description=__doc__)
    names = [fault.name for fault in FAULTS]
    parser.add_argument("--only", choices=names, help="this fault alone")
    parser.add_argument("--inspect", choices=names, help="print the problems of its scenes, with the present package")
    options = parser.parse_args()
    if options.inspect is not None:
        print(json.dumps({"package": str(PACKAGE.resolve()), "problems": problems(options.inspect)}))
        return 0
    missed = 0
    for fault in FAULTS:
        if options.only in (None, fault.name):
            reports = problems_with(fault)
            missed += not reports
            print(f"{fault.name} ({KNOWN[fault.name].fault}): {'found' if reports else 'NOT FOUND'}", flush=True)
            print("".join(f"    {text[:200]}\n" for text in reports[:4]), end="", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
