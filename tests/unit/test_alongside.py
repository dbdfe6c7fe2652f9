"""Kernels that are called by address: compiled by another process or here, found again by the next process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

MODULE = """
import numpy as np
from dynsim.jit.kernel import internal_kernel, kernel, separate_kernel

@separate_kernel
def add_to(x, y):
    for k in range(y.shape[0]):
        y[k] += 3.0 * x[k]

@internal_kernel
def add_twice(x, y):
    add_to(x, y)
    add_to(x, y)

@kernel
def once(x, y):
    add_to(x, y)

@kernel
def thrice(x, y):
    add_twice(x, y)
    add_to(x, y)

if __name__ == "__main__":
    import pair

    x, y = np.arange(4.0), np.ones(4)
    pair.thrice(x, y)
    pair.once(x, y)
    assert np.array_equal(y, 1.0 + 12.0 * x), y
    print(sum(pair.add_to.dispatcher.stats.cache_hits.values()))
"""


def run(folder: Path, executable: str, cores: str) -> bool:
    """The module as a program; ``executable`` is what it starts alongside, on so many cores.

    True when it has found what it calls by address in the cache.
    """
    program = (
        "import os, runpy, sys\n"
        f"sys.executable = {executable!r}\n"
        f"os.sched_getaffinity = lambda _: {cores}\n"
        f"sys.path.insert(0, {str(folder)!r})\n"
        "runpy.run_module('pair', run_name='__main__')\n"
    )
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", program], env=environment, check=True, stdout=subprocess.PIPE)
    return int(done.stdout) > 0


@pytest.mark.parametrize(
    ("executable", "cores"),
    [(sys.executable, "{0, 1}"), (sys.executable, "{0}"), ("/bin/false", "{0, 1}"), ("/nowhere", "{0, 1}")],
    ids=["alongside", "one core", "the process fails", "no process"],
)
def test_what_is_called_by_address_is_compiled_once_and_found_again(
    tmp_path: Path, executable: str, cores: str
) -> None:
    (tmp_path / "pair.py").write_text(MODULE)
    alongside = executable == sys.executable and cores == "{0, 1}"
    assert run(tmp_path, executable, cores) == alongside
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.kernel")}
    assert sorted(path.name.split("-")[0] for path in files) == ["pair.add_to", "pair.once", "pair.thrice"]
    assert run(tmp_path, executable, cores)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.kernel")} == files
    # Callers that are there, and what they call is not: it is compiled again.
    next(path for path in files if path.name.startswith("pair.add_to")).unlink()
    assert not run(tmp_path, executable, cores)
