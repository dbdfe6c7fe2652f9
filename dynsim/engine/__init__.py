"""Run a scenario: the plant's engine turns it into a record."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from dynsim.record import Record
from dynsim.scenario import Scenario

# Called now and then with the simulated time [s].
Progress = Callable[[float], None]


def simulate(scenario: Scenario, progress: Progress | None = None) -> Record:
    """Simulate a scenario.

    Parameters
    ----------
    scenario : Scenario
    progress : called with the simulated time [s] about ten times a second

    Returns
    -------
    Record
        Signals, units, summary and provenance.

    Raises
    ------
    SimulationStopped
        Divergence or no solution; ``error.record`` holds what was simulated until then.
    SimulationInterrupted
        Ctrl-C; ``error.record`` likewise.
    ModelError, UnreachableReference
        The scenario describes no physics, or a path that the hand cannot follow.
    """
    engine = importlib.import_module(f"dynsim.engine.{scenario.engine}")
    return engine.simulate(scenario, progress)
