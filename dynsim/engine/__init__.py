"""Run a scenario: the plant's engine turns it into a record."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Protocol

from dynsim.record import Record
from dynsim.scenario import Scenario

REFERENCES, SIMULATION = "references", "simulation"


class Progress(Protocol):
    """Called about ten times a second with the time [s] that a stage has come to.

    The stage is ``REFERENCES`` while the controller prepares them, if that takes long; then ``SIMULATION``.
    """

    def __call__(self, time: float, stage: str = SIMULATION) -> None: ...


def simulate(scenario: Scenario, progress: Progress | None = None) -> Record:
    """Simulate a scenario.

    Parameters
    ----------
    scenario : Scenario
    progress : called as ``progress(time)`` and ``progress(time, stage)``, see :class:`Progress`

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
