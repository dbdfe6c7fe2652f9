"""Provenance of a record: scenario, engine, versions of dynsim, libraries and Python, commit, and date."""

from __future__ import annotations

import platform
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from dynsim._version import __version__
from dynsim.library import families
from dynsim.scenario import Scenario

LIBRARIES = ("numpy", "scipy", "numba", "h5py")
# File of a built package that names the commit from which it was built.
BUILT_FROM = "commit.txt"


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Everything needed to make the record again."""
    return {
        "scenario": scenario.resolved,
        "engine": scenario.engine,
        "dynsim_version": __version__,
        "commit": commit(),
        "libraries": {name: _version(name) for name in LIBRARIES} | families.libraries(),
        "python": platform.python_version(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


@lru_cache
def _version(library: str) -> str:
    # Reading the metadata of all of them takes 6 ms, as long as a short run of a sweep.
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "unknown"


@lru_cache
def commit() -> str:
    """Commit of the checkout that runs, or that an installed package was built from; "" where neither is known.

    Read from .git, once: starting git would cost more. A package has it from ``.ci/build_hook.py``.
    """
    built = Path(__file__).resolve().parents[1] / BUILT_FROM
    if built.is_file():
        return built.read_text(encoding="ascii").strip()
    git = Path(__file__).resolve().parents[2] / ".git"
    try:
        if git.is_file():  # a linked work tree
            # Of a submodule the path is relative to this file.
            git = git.parent / git.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
        head = (git / "HEAD").read_text(encoding="utf-8").strip()
        if not head.startswith("ref:"):
            return head
        name = head.removeprefix("ref:").strip()
        common = git / "commondir"
        root = (git / common.read_text(encoding="utf-8").strip()) if common.is_file() else git
        if (root / name).is_file():
            return (root / name).read_text(encoding="utf-8").strip()
        packed = (root / "packed-refs").read_text(encoding="utf-8").splitlines()
        return next((line.split()[0] for line in packed if line.endswith(" " + name)), "")
    except (OSError, UnicodeDecodeError):
        return ""
