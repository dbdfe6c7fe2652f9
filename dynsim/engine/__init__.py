"""Simulation and check of a scenario by the engine of its plant; types of progress and of a checked start."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import ModelError, ScenarioError, SimulationInterrupted, SimulationStopped, UnreachableReference
from dynsim.record import Record
from dynsim.scenario import Scenario, require_scenario
from dynsim.system import interruption
from dynsim.system.memo import remembering

# No log output unless the caller configures it. Here, not in dynsim/__init__.py: every module that logs imports this.
logging.getLogger("dynsim").addHandler(logging.NullHandler())
log = logging.getLogger(__name__)

# Modules of the engines, by name.
ENGINES = {"dynamics": "dynsim.engine.simulation", "kinematic": "dynsim.engine.kinematic"}
REFERENCES, SIMULATION = "references", "simulation"


class Progress(Protocol):
    """Called about ten times a second with the time [s] that a stage has come to.

    The stage is ``REFERENCES`` while the controller prepares them, if that takes long; then ``SIMULATION``.
    """

    def __call__(self, time: float, stage: str = SIMULATION) -> None: ...


@dataclass(frozen=True)
class Start:
    """Where a scenario starts, in the world [m].

    Attributes
    ----------
    hand : (3,) the controlled point
    contacts : (3,) of each enabled contact point, by its name
    gaps : of the same from their surfaces [m]; negative: below
    aloft : line of a scenario that would put the declared points which do not touch on their surfaces; empty: all do
    solved : joints that ``initial.on_surface`` has moved: where to and from where [° or m], and the unit
    tip_margin : of a mobile base at rest under weight and loads alone; None: it stands fixed or floats
    tip_margin_braced : the same with the contacts that touch, whose forces cost the motors least heat; None: there are
        none, or they do not hold the arm
    warnings : keys of the scenario that change nothing, bodies that begin below surfaces, contact points that no joint
        moves along the normal, an unstable sampled loop, and what jumps or moves at a start in equilibrium
    off_path : how far the hand is from where its path begins [m]; None: it has none
    """

    hand: NDArray[np.float64]
    contacts: Mapping[str, NDArray[np.float64]]
    gaps: Mapping[str, float] = field(default_factory=dict)
    aloft: str = ""
    solved: Mapping[str, tuple[float, float, str]] = field(default_factory=dict)
    tip_margin: float | None = None
    tip_margin_braced: float | None = None
    warnings: Sequence[str] = ()
    off_path: float | None = None


def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """Simulate a scenario; within :func:`dynsim.system.memo.remembering` it takes over what others have computed.

    Parameters
    ----------
    scenario : Scenario
    progress : called with time [s] and stage, see :class:`Progress`
    pictured : with scene, poses of bodies and provenance, which only figures, viewers and files need

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
    with named(scenario), remembering():
        interruption.heed()
        interruption.check()
        try:
            record: Record = _module(scenario).simulate(scenario, progress, pictured=pictured)
        except SimulationStopped as stop:
            note_warnings(scenario, stop.record)
            raise
        note_warnings(scenario, record)
        return record


def note_warnings(scenario: Scenario, record: Record | None) -> None:
    for warning in record.summary["warnings"] if record is not None else ():
        log.warning("%s: %s", scenario.title, warning)


def check(scenario: Scenario, started: Callable[[Start], None] | None = None) -> Start:
    """Do all that comes before the first step: model, contacts and their forces, references, size of the record.

    ``started`` : called with what is returned, but for ``off_path``, before contacts and references are looked at

    Returns
    -------
    Start
        Positions of the hand and of the contact points at t = 0, and what else a start has.

    Raises
    ------
    ModelError, UnreachableReference, ScenarioError
    SimulationStopped
        If contact forces at the start do not exist or cannot last (Painlevé's paradox).
    """
    with named(scenario), remembering():
        start: Start = _module(scenario).check(scenario, started or (lambda start: None))
        return start


@contextmanager
def named(scenario: Scenario) -> Iterator[None]:
    """Say in errors which scenario and variant they are about; those of reading it name file and line themselves."""
    require_scenario(scenario)
    variant = f" ({scenario.variant})" if scenario.variant else ""
    name = scenario.location(variant=variant)
    try:
        yield
    except (ModelError, UnreachableReference) as error:
        raise type(error)(f"{scenario.location(error.keys, variant)}: {error}") from error
    except ScenarioError as error:
        raise type(error)(f"{name}: {error}") from error
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise ModelError(f"{name}: numbers of very different size, no result can be computed ({error})") from error
    except MemoryError as error:
        reason = f"not enough memory ({error})" if str(error) else "not enough memory"
        raise ScenarioError(
            f"{name}: {reason}; fewer joints, a lower record.rate_hz or duration_s need less"
        ) from error
    except KeyboardInterrupt:
        interruption.answered()
        raise SimulationInterrupted(f"{name}: interrupted before there was anything to save") from None


def _module(scenario: Scenario) -> ModuleType:
    if scenario.engine not in ENGINES:
        known = ", ".join(ENGINES)
        raise ModelError(f"plant {scenario.plant.type!r} wants the engine {scenario.engine!r}; there are: {known}")
    return importlib.import_module(ENGINES[scenario.engine])
