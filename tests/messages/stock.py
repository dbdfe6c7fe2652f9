"""Records that several inputs use, and their files, each of which is made once."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from studies.fault_table import swing

import dynsim


def saved(record: dynsim.Record) -> bytes:
    """Return the content of the file of a record."""
    with tempfile.TemporaryDirectory(prefix="messages-") as folder:
        return record.save(Path(folder, "record.h5")).read_bytes()


def two_joints() -> dynsim.Record:
    """Return a record of two joints, with a summary and events."""
    made = dynsim.Record(np.linspace(0.0, 1.0, 5), provenance={"engine": "dynamics"})
    made.add("q", np.arange(10.0).reshape(5, 2), "rad", labels=("a", "b"))
    made.add("v", np.zeros((5, 2)), "rad/s", labels=("a", "b"))
    made.add_event(0.2, "contact closes", "elbow")
    made.add_event(0.7, "contact opens", "elbow")
    made.summary = {"steps": 3}
    return made


def pressure() -> dynsim.Record:
    """Return a record of a signal that no figure shows."""
    made = dynsim.Record(np.linspace(0.0, 1.0, 5))
    made.add("pressure", np.arange(5.0), "Pa")
    return made


def pendulum() -> dynsim.Record:
    """Return the record of a short simulation."""
    short = {"duration_s": 0.05, "metrics.settle_s": 0.0}
    return dynsim.simulate(dynsim.load_scenario("single_pendulum", overrides=short))


def file_of(make: Callable[[], dynsim.Record]) -> Callable[[], bytes]:
    """Return a function that returns the file of a record, which it makes once."""
    return cache(lambda: saved(make()))


TWO_JOINTS, PRESSURE, PENDULUM, SWING = map(file_of, (two_joints, pressure, pendulum, swing))
