"""Processes of a sweep begin to load while its arguments are read."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from dynsim.studies.processes import begin_early, cores

# With these there are none here.
_ELSEWHERE = ("--help", "--scheduler")


def begin_workers(arguments: Sequence[str]) -> None:
    """Begin for ``dynsim sweep`` with these arguments, unless they ask for no processes here."""
    words = " ".join(arguments).replace("--jobs=", "--jobs ").split()
    jobs = dict(pairwise(words)).get("--jobs", str(cores()))
    if jobs != "1" and not any(word.startswith(_ELSEWHERE) for word in words):
        load_workers()


def load_workers() -> None:
    """Load what runs need in a process that workers will be copies of; nothing where that is done already."""
    begin_early("dynsim.studies.batch", "dynsim.studies.plan", "dynsim.engine.dynamics")
