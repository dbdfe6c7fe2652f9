"""Fixtures shared by all folders."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from dynsim.engine import simulate
from dynsim.record import Record
from dynsim.scenario import load_scenario


@cache
def _simulated(name: str, variant: str | None) -> Record:
    return simulate(load_scenario(name, variant))


@pytest.fixture(scope="session")
def simulated() -> Callable[[str, str | None], Record]:
    """Record of a shipped scenario and variant, simulated once per session."""
    return _simulated
