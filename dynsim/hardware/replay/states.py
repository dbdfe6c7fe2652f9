"""What a replay goes through and how it ends: its states, what it shows of itself, the user's stop, the result."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Literal

from dynsim.hardware.replay.rows import TimingStatistics
from dynsim.hardware.replay.rules import Cause, Fault
from dynsim.record import Record


class State(IntEnum):
    """Where the replay is; recorded cycle by cycle."""

    CONNECT = 0
    VERIFY = 1
    ARM = 2
    MOVE_TO_START = 3
    SETTLE = 4
    REPLAY = 5
    DISARM = 6
    FAULT = 7
    DRY_RUN = 8


UNARMED = (State.CONNECT, State.VERIFY, State.DRY_RUN)

EndState = Literal["not armed", "off", "holding", "unreachable"]
"""How the robot was left. "unreachable": the port died, the servos stop by their own watchdogs."""


class StopRequest:
    """Counts the user's Ctrl-C (or other signals): the first asks for a controlled stop, the second for torque off."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, *_: Any) -> None:
        self.count += 1

    @property
    def for_release(self) -> bool:
        """The user wants torque off, now."""
        return self.count >= 2

    def check(self) -> None:
        """Raises Stopped when the user has asked for a stop."""
        if self.count:
            raise Stopped(Fault(Cause.INTERRUPTED, "stopped by the user"))


@dataclass(frozen=True)
class Progress:
    """What a display may show after every cycle.

    Attributes
    ----------
    state : State
    fraction : float
        Of the current motion, 0 to 1.
    following_error : float
        Worst of all joints [rad].
    temperature : float
        Hottest servo [°C], NaN before it is known.
    """

    state: State
    fraction: float
    following_error: float
    temperature: float


@dataclass
class ReplayResult:
    """How a replay ended.

    Attributes
    ----------
    end_state : EndState
    fault : Fault | None
    fault_state : State | None
        Where the fault struck.
    fault_time : float
        On the replay's clock [s], NaN without one.
    policy_goals : list
        (clock time, ID, register value) of every goal sent after the fault.
    record : Record
    timing : TimingStatistics | None
    torque_still_on : tuple of int
        IDs that did not confirm torque off.
    """

    end_state: EndState = "not armed"
    fault: Fault | None = None
    fault_state: State | None = None
    fault_time: float = math.nan
    policy_goals: list[tuple[float, int, int]] = field(default_factory=list)
    record: Record = field(default_factory=lambda: Record([]))
    timing: TimingStatistics | None = None
    torque_still_on: tuple[int, ...] = ()


class Stopped(Exception):
    """The replay cannot go on: a rule, the user or a servo says so."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault.text)
        self.fault = fault
