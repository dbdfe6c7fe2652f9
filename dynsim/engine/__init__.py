"""Functions that simulate or check a scenario with the engine for its plant; types for progress and the start."""

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
from dynsim.record.scene import Scene
from dynsim.scenario import Scenario, require_scenario
from dynsim.system import interruption
from dynsim.system.arguments import names_wrong_types
from dynsim.system.memo import remembering

# Nothing is logged unless the caller configures logging. This line is here and not in dynsim/__init__.py, because every
# module that logs imports this package.
logging.getLogger("dynsim").addHandler(logging.NullHandler())
log = logging.getLogger(__name__)

# Module that implements each engine.
ENGINES = {"dynamics": "dynsim.engine.simulation", "kinematic": "dynsim.engine.kinematic"}
REFERENCES, SIMULATION = "references", "simulation"


class Progress(Protocol):
    """Callback for progress, called about ten times a second with the time [s] that a stage has reached.

    The stage is ``REFERENCES`` while the controller prepares its references, if that takes long; then ``SIMULATION``.
    """

    def __call__(self, time: float, stage: str = SIMULATION) -> None: ...


@dataclass(frozen=True)
class Start:
    """Start of a scenario: positions in the world [m], gaps, tip margins and warnings.

    Attributes
    ----------
    hand : (3,) ndarray
        Position of the controlled point [m].
    contacts : dict of str to (3,) ndarray
        Position of each enabled contact point [m]; contacts of `contacts.between` are in ``pairs``.
    gaps : dict of str to float
        Distance of each of these points from its surface [m]; negative: below the surface.
    aloft : str
        Scenario line that would put all declared contact points onto their surfaces; empty if all of them touch.
    solved : dict of str to (float, float, str)
        Joints that ``initial`` moved: new position, previous position and unit [deg or m].
    nearest : dict of str to (float, str)
        Joints without a set position that start at the legal position nearest to zero: position and unit [deg or m].
    tip_margin : float or None
        Tip margin of a mobile base at rest under weight and loads; None for a fixed or floating base.
    tip_margin_braced : float or None
        Tip margin if the touching contacts support the arm with the forces that minimise motor heat; None if no contact
        touches, or if the contacts cannot hold the arm.
    warnings : sequence of str
        Warnings about keys without effect, bodies below surfaces, contact points that no joint moves along the normal,
        an unstable sampled control loop, and jumps at a start in equilibrium.
    off_path : float or None
        Distance of the hand from the start of its path [m]; None without a path.
    scene : Scene or None
        Bodies, surfaces and points for pictures; None if the plant cannot be drawn.
    pairs : dict of str to float
        Distance of each pair of bodies that can touch each other [m], in ascending order.
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
    scene: Scene | None = None
    pairs: Mapping[str, float] = field(default_factory=dict)
    nearest: Mapping[str, tuple[float, str]] = field(default_factory=dict)


@names_wrong_types
def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """Simulate a scenario and return its record.

    Parameters
    ----------
    scenario : Scenario
        Scenario to simulate, see :func:`dynsim.load_scenario`.
    progress : callable, optional
        Called about ten times a second with the time [s] and the stage, see :class:`Progress`.
    pictured : bool, optional
        If False, omit the scene, body poses and provenance, which only figures, viewers and files need.

    Returns
    -------
    Record
        Signals, units, events, summary and provenance.

    Raises
    ------
    SimulationStopped
        If the run diverges or has no solution; ``error.record`` contains the results up to the stop.
    SimulationInterrupted
        On Ctrl-C; ``error.record`` contains the results up to the interruption.
    ModelError
        If the scenario does not define a valid physical model.
    UnreachableReference
        If the hand cannot follow its path.
    ScenarioError
        If the record would exceed its size limit, or options conflict.

    Notes
    -----
    The equations of motion are [WM] eqs 42–44 and 54–55, extended by motors and contacts, see
    docs/theory/multibody.md. Runs within one ``dynsim.system.memo.remembering`` block, as in a sweep, share
    intermediate results.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("single_pendulum", overrides={"duration_s": 1})
    >>> record = dynsim.simulate(scenario)
    >>> record["q"].shape, record.units["q"], record.complete
    ((201, 1), 'rad', True)
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
    """Log the warnings in the summary of a record."""
    for warning in record.summary["warnings"] if record is not None else ():
        log.warning("%s: %s", scenario.title, warning)


@names_wrong_types
def check(scenario: Scenario, started: Callable[[Start], None] | None = None) -> Start:
    """Validate a scenario without integrating it, and return its start positions and contact gaps.

    The check builds the model, solves for the start posture and the contact forces, prepares the references, and checks
    the size of the record.

    Parameters
    ----------
    scenario : Scenario
        Scenario to check.
    started : callable, optional
        Called with the :class:`Start` before contacts and references are checked; its ``off_path`` is not yet set.

    Returns
    -------
    Start
        Positions of the hand and the contact points at t = 0 [m], gaps [m], tip margins and warnings.

    Raises
    ------
    ModelError
        If the scenario does not define a valid physical model.
    UnreachableReference
        If the hand cannot follow its path.
    ScenarioError
        If the record would exceed its size limit, or options conflict.
    SimulationStopped
        If no consistent contact forces exist at the start, or if they break down immediately (Painlevé's paradox).

    Notes
    -----
    Nothing is integrated. docs/theory/uniqueness.md states when contact forces exist.

    Examples
    --------
    >>> import dynsim
    >>> start = dynsim.check(dynsim.load_scenario("falling_arm"))
    >>> list(start.contacts), start.hand.shape
    (['joint_2', 'joint_3', 'joint_4', 'joint_5', 'hand'], (3,))
    """
    with named(scenario), remembering():
        start: Start = _module(scenario).check(scenario, started or (lambda start: None))
        return start


@contextmanager
def named(scenario: Scenario) -> Iterator[None]:
    """Prefix errors with the scenario and variant they concern."""
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
        raise ModelError(f"{name}: values differ too much in magnitude to compute a result ({error})") from error
    except MemoryError as error:
        reason = f"not enough memory ({error})" if str(error) else "not enough memory"
        raise ScenarioError(f"{name}: {reason}; use fewer joints, or lower record.rate_hz or duration_s") from error
    except KeyboardInterrupt:
        interruption.answered()
        raise SimulationInterrupted(f"{name}: interrupted before the first result; nothing was saved") from None


def _module(scenario: Scenario) -> ModuleType:
    if scenario.engine not in ENGINES:
        known = ", ".join(ENGINES)
        raise ModelError(
            f"plant {scenario.plant.type!r} requires the unknown engine {scenario.engine!r}; engines: {known}"
        )
    return importlib.import_module(ENGINES[scenario.engine])
