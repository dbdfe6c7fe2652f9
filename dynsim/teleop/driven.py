"""A scenario in the hands of a pilot: tick by tick, with a script of what was asked that gives the same run again.

A script is part of a scenario, so a drive leaves a scenario: that of which it was made, with its commands and as long
as it took. What the commands are is the plant's: :mod:`dynsim.teleop.snake`, :mod:`dynsim.teleop.arm`.
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

Array = NDArray[np.float64]
NO_REQUEST = 0


@dataclass(frozen=True)
class Axis:
    """One velocity that a pilot gives.

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
class Order:
    """What a pilot asks for in one tick.

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
class Shown:
    """What a pilot sees after a tick.

    Attributes
    ----------
    time : [s]; poses : (bodies, 7) position [m], quaternion w, x, y, z; hand : (3,) [m]
    hindrance : why not all of what was asked for is done; empty where it is
    extra : by the names of a frame of the page: wheels, gripper; ``mode`` of a snake
    touching : what contact points do, by their names
    """

    time: float
    poses: Array
    hand: Array
    hindrance: str
    extra: dict[str, Any]
    touching: Mapping[str, Touch]


class Driven(Protocol):
    """A simulation that is driven."""

    axes: tuple[Axis, ...]
    modes: tuple[int, ...]
    has_gripper: bool
    period: float

    @property
    def ticks(self) -> int:
        """Periods so far."""

    @property
    def time(self) -> float:
        """Of the simulation [s]: with its ticks, or half a tick behind them."""

    @property
    def finished(self) -> bool:
        """The longest drive is over, or the run has ended by itself."""

    def tick(self, order: Order) -> None:
        """Advance by one period; SimulationStopped where there is no going on."""

    def shown(self) -> Shown:
        """What there is to see now."""

    def joints(self) -> Mapping[str, Array]:
        """Angles of joints [rad], rates [rad/s] unless they are held from tick to tick, and which wheels are grounded
        (since the tick before).

        By the names of the record's signals, in the order of their labels.
        """

    def still(self) -> Record:
        """A moment of the same robot at its start, for a page to be made of."""

    def record(self) -> Record:
        """What was driven so far, with a scenario that drives it again."""


@dataclass(frozen=True)
class Pace:
    """Fastest rates that a pilot can ask for.

    Attributes
    ----------
    speed : of a hand or head [m/s]; turn : of a head or base [rad/s]; base : of a mobile base [m/s]
    """

    speed: float = 0.1
    turn: float = 0.5
    base: float = 0.3


def changed(scenario: Scenario, duration: float, controller: dict[str, Any]) -> Scenario:
    """The scenario with another duration [s] and controller."""
    resolved = scenario.resolved
    return scenario_from_resolved({**resolved, "duration_s": duration, "controller": controller})
