"""Benchmark of sweeps of the published arm: wall time by numbers of runs and processes."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from dynsim.scenario import read_scenario
from dynsim.studies.processes import cores
from dynsim.studies.sweep import run_sweep
from dynsim.studies.sweep_plan import Law, Plan
from studies.bench.programs import SCENARIO

RUNS = (250, 500, 1000)


def measure(quick: bool) -> list[dict[str, Any]]:
    """Return the wall seconds of sweeps of 10 s runs over friction, with one process and with one per core."""
    file = read_scenario(SCENARIO)
    law = Law.parse("contacts.friction=normal(0.1,0.005)")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for runs in (count // 10 if quick else count for count in RUNS):
            for jobs in dict.fromkeys((1, cores())):
                plan = Plan(file, (file.variants[0],), laws=(law,), count=runs)
                started = time.perf_counter()
                rows_of = run_sweep(plan, Path(folder, f"{runs}-{jobs}"), jobs=jobs)
                wall = time.perf_counter() - started
                failed = sum(row.status != "ok" for row in rows_of)
                rows.append({"runs": runs, "jobs": jobs, "wall_s": wall, "failed": failed})
    return rows
