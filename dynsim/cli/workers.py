"""Processes of a sweep begin to load while its arguments are read."""

from __future__ import annotations

from collections.abc import Sequence

from dynsim.studies.processes import begin_early, cores

# With these the command itself knows whether there are processes at all.
_DECIDED_LATER = ("--help", "--jobs", "--scheduler")


def begin_workers(arguments: Sequence[str]) -> None:
    """Begin for ``dynsim sweep`` with these arguments, unless they may ask for something else."""
    if cores() > 1 and not any(argument.startswith(_DECIDED_LATER) for argument in arguments):
        load_workers()


def load_workers() -> None:
    """Load what runs need in a process that workers will be copies of; nothing where that is done already."""
    begin_early("dynsim.studies.batch", "dynsim.studies.plan", "dynsim.engine.dynamics")
