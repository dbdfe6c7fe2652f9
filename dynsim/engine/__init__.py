"""Run a scenario: the plant's engine turns it into a record."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import ModuleType

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
    return _module(scenario).simulate(scenario, progress)


def check(scenario: Scenario) -> None:
    """Do everything that comes before the first step: model, contacts at the start, references, size of the record.

    Raises
    ------
    ModelError, UnreachableReference, ScenarioError
    """
    _module(scenario).prepare(scenario)


def _module(scenario: Scenario) -> ModuleType:
    return importlib.import_module(f"dynsim.engine.{scenario.engine}")
