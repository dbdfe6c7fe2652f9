"""Run a scenario: the plant's engine turns it into a record."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Protocol

import numpy as np

from dynsim.errors import ModelError, ScenarioError, SimulationInterrupted, UnreachableReference
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
    progress : called with time [s] and stage, see :class:`Progress`

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
    with _named(scenario):
        return _module(scenario).simulate(scenario, progress)


def check(scenario: Scenario) -> None:
    """Do everything that comes before the first step: model, contacts at the start, references, size of the record.

    Raises
    ------
    ModelError, UnreachableReference, ScenarioError
    """
    with _named(scenario):
        _module(scenario).prepare(scenario)


@contextmanager
def _named(scenario: Scenario) -> Iterator[None]:
    """Say in errors which scenario and variant they are about; those of reading it name file and line themselves."""
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"needs a Scenario, not {scenario!r}; load_scenario(name or file) gives one")
    variant = f" ({scenario.variant})" if scenario.variant else ""
    name = scenario.place(variant=variant)
    try:
        yield
    except ModelError as error:
        raise ModelError(f"{scenario.place(error.keys, variant)}: {error}") from error
    except (ScenarioError, UnreachableReference) as error:
        raise type(error)(f"{name}: {error}") from error
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise ModelError(f"{name}: numbers of very different size, no result can be computed ({error})") from error
    except MemoryError as error:
        reason = f"not enough memory ({error})" if str(error) else "not enough memory"
        raise ScenarioError(f"{name}: {reason}; a lower record.rate_hz or duration_s needs less") from error
    except KeyboardInterrupt:
        raise SimulationInterrupted(f"{name}: interrupted before there was anything to save") from None


def _module(scenario: Scenario) -> ModuleType:
    return importlib.import_module(f"dynsim.engine.{scenario.engine}")
