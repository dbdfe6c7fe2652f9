"""Study: duration of the very first run, which compiles the kernels, and of a later one.

``PYTHONPATH=tests python -m studies.start_up`` writes results/reference/start_up.json in two minutes, on an otherwise
idle machine, the machine of results/reference/bench.json.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from dynsim.system.files import write_json
from studies.bench.programs import SCENARIO
from studies.bench.run import machine, versions

FILE = Path("results/reference/start_up.json")
METHODS = ("radau5", "dopri5")


def measure(method: str) -> dict[str, dict[str, float]]:
    """Time a run with an empty kernel cache and the next one; also a comparison of all variants with figures and page.

    The first run creates matplotlib's list of fonts.
    """
    run = ["run", SCENARIO, "--no-figures", "--set", f"integrator.method={method}"]
    compare = ["compare", SCENARIO, "--set", f"integrator.method={method}"]
    with tempfile.TemporaryDirectory() as folder:
        return {
            kind: _timed(command, Path(folder))
            for kind, command in (("cold", run), ("warm", run), ("first_compare", compare), ("compare", compare))
        }


def _timed(arguments: list[str], folder: Path) -> dict[str, float]:
    """Return wall time and processor time of all processes [s]."""
    command = [sys.executable, "-m", "dynsim", *arguments, "--quiet", "--out", str(folder / arguments[0])]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(command, check=True, env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache")})
    wall, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"wall_s": wall, "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def start_up() -> dict[str, Any]:
    """Return the times by method, with machine and versions."""
    # The load before shows whether other programs affect the wall times.
    where = {"machine": machine() | {"load_before": os.getloadavg()[0]}, "versions": versions()}
    return where | {method: measure(method) for method in METHODS}


if __name__ == "__main__":
    write_json(FILE, start_up())
    print(f"written: {FILE}; into the pages: python .ci/pages.py")
