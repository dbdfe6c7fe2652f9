"""Damaged folders of sweeps, which ``dynsim sweep --resume`` continues."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from random import Random
from typing import Any

from fuzz.case import Draft
from fuzz.mutations import mutate_bytes, mutate_text, mutate_tree

COMMAND = [
    "sweep", "single_pendulum", "--set", "duration_s=0.01", "--set", "metrics.settle_s=0",
    "--grid", "plant.chain.0.mass_kg=1,2,3,4", "--jobs", "1", "--no-figures", "--quiet", "--out", "out",
]  # fmt: skip
PLAN, JOURNAL = "sweep.json", "runs.jsonl"
# Columns of the table with text, which may consist of digits.
TEXTS = ("variant", "status", "reason", "warnings")


def make_sweep(folder: Path) -> None:
    """Make a valid sweep of four runs in ``folder``, without a commit, because an edited tree refuses to resume it."""
    from dynsim.scenario import read_scenario
    from dynsim.studies.sweep import run_sweep
    from dynsim.studies.sweep_plan import Axis, Plan

    forget_commit()
    overrides = {"duration_s": 0.01, "metrics.settle_s": 0}
    axes = (Axis.parse(COMMAND[COMMAND.index("--grid") + 1]),)
    run_sweep(Plan(read_scenario("single_pendulum"), (None,), overrides, axes), folder)


def forget_commit() -> None:
    """Make sweeps of this process store no commit."""
    from dynsim.studies import sweep

    sweep.commit = lambda: ""


def draw(rng: Random, records: Path) -> Draft:
    files: dict[str, bytes | str] = {
        f"out/{path.name}": path.read_bytes() for path in sorted((records / "sweep").iterdir()) if path.is_file()
    }
    name = f"out/{rng.choice((PLAN, JOURNAL, JOURNAL, JOURNAL))}"
    data = files[name]
    assert isinstance(data, bytes)
    choice = rng.random()
    if choice < 0.5:
        lines: list[Any] = [json.loads(line) for line in ([data] if name.endswith(PLAN) else data.splitlines())]
        row = rng.randrange(len(lines))
        mutation = mutate_tree(rng, lines[row])
        data = "".join(f"{json.dumps(line, default=str)}\n" for line in lines).encode("utf-8", "surrogatepass")
    elif choice < 0.75:
        data, mutation = mutate_text(rng, data.decode())
    else:
        data, mutation = mutate_bytes(rng, data)
    files[name] = data
    if rng.random() < 0.1:
        gone = rng.choice(sorted(files))
        del files[gone]
        mutation += f"; without {gone}"
    return Draft(f"{name}: {mutation}", files, [[*COMMAND, "--resume"]], losses)


def losses() -> list[str]:
    """Return runs that are missing in the table or have an invalid number."""
    from dynsim.errors import RecordError

    table = Path("out/sweep.csv")
    if not table.is_file():
        raise RecordError("refused")
    csv.field_size_limit(1 << 30)  # a key of the journal names a column, however long it is
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    lost = [] if len(rows) == 4 else [f"{len(rows)} runs of 4 are in the table"]
    for row in rows:
        for column, cell in row.items():
            if column in TEXTS:
                continue
            try:
                value = float(cell or "0")
            except (TypeError, ValueError):
                continue
            if not math.isfinite(value):
                lost.append(f"column {column} of a run is not finite")
    return lost
