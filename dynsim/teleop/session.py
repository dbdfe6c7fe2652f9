"""Interface and data types of a teleoperated simulation, tick by tick, with a script of commands that reproduces it.

A session results in a scenario: the one that it was made of, with the pilot's commands as a script, and the duration of
the session. The form of the script depends on the plant: :mod:`dynsim.teleop.snake`, :mod:`dynsim.teleop.arm`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.stepped import Touch
from dynsim.record import Record
from dynsim.scenario import Scenario, scenario_from_resolved
from dynsim.snake.description import NO_REQUEST

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PilotAxis:
    """One component of the velocities that a pilot commands.

    Attributes
    ----------
    name : ``x``, ``yaw``; group : what moves, ``hand``, ``head``, ``gripper`` or ``base``
    limit : fastest rate, in ``unit``
    """

    name: str
    group: str
    unit: str
    limit: float


@dataclass(frozen=True)
class Command:
    """Command of a pilot for one tick of the simulation.

    Attributes
    ----------
    velocity : of each axis [m/s, rad/s]
    request : a mode to go to: its number, or one of :mod:`dynsim.snake.description`; ``NO_REQUEST``: none
    closed : the gripper
    """

    velocity: tuple[float, ...]
    request: int = NO_REQUEST
    closed: bool = False


@dataclass(frozen=True)
class LiveFrame:
    """What a pilot sees after a tick.

    Attributes
    ----------
    time : [s]; poses : (bodies, 7) position [m], quaternion w, x, y, z; hand : (3,) [m]
    hindrance : why not all of what was commanded is done; empty where it is
    extra : by the names of a frame of the page: wheels, gripper; ``mode`` of a snake
    touching : what contact points do, by their names
    """

    time: float
    poses: Array
    hand: Array
    hindrance: str
    extra: dict[str, Any]
    touching: Mapping[str, Touch]


@dataclass(frozen=True)
class SpeedLimits:
    """Fastest rates that a pilot can command.

    Attributes
    ----------
    hand : of a hand or head [m/s]; turn : of a head or base [rad/s]; base : of a mobile base [m/s]
    """

    hand: float = 0.1
    turn: float = 0.5
    base: float = 0.3


class Session(Protocol):
    """A simulation that a pilot commands.

    Attributes
    ----------
    axes : velocities of a command; modes : numbers that it may request; has_gripper : it may close
    period : of a tick [s]
    still : a moment of the same robot at its start, for a page to be made of
    """

    axes: tuple[PilotAxis, ...]
    modes: tuple[int, ...]
    has_gripper: bool
    period: float
    still: Record

    @property
    def ticks(self) -> int:
        """Periods so far."""

    @property
    def time(self) -> float:
        """Of the simulation [s]: with its ticks, or half a tick behind them."""

    @property
    def finished(self) -> bool:
        """The longest time is over, or the run has ended by itself."""

    def tick(self, command: Command) -> None:
        """Advance by one period; SimulationStopped where there is no going on."""

    def frame(self) -> LiveFrame:
        """What there is to see now."""

    def joints(self) -> Mapping[str, Array]:
        """Angles of joints [rad], rates [rad/s] unless they are held from tick to tick, and which wheels are grounded
        (since the tick before).

        By the names of the record's signals, in the order of their labels.
        """

    def record(self) -> Record:
        """The record of all ticks so far, with a scenario that makes it again."""


def with_controller(scenario: Scenario, duration: float, controller: dict[str, Any]) -> Scenario:
    """The scenario with another duration [s] and controller."""
    return scenario_from_resolved({**scenario.resolved, "duration_s": duration, "controller": controller})
