"""What a replay goes through and how it ends: its states, what it shows of itself, the user's stop, the result."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

from dynsim.hardware.replay.end_state import ServoEnd
from dynsim.hardware.replay.registers import LimitRow
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

NOT_ARMED = "not armed"


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
    end_state : str
        What the robot was read to do at the end: "holding", "off", "mixed: ..." (who does what), "unreachable" (nobody
        answers; armed servos stop by their own watchdogs), or "not armed" where nothing was switched on.
    servos : tuple of ServoEnd
        What every servo was read to do.
    faults : list of Fault
        All that were declared, one of each cause; the first one stopped the motion.
    fault_state : State | None
        Where the first one struck.
    fault_time : float
        Of the first one, on the replay's clock [s], NaN without one.
    policy_goals : list
        (clock time, ID, register value) of every goal sent after the fault.
    record : Record
    timing : TimingStatistics | None
    torque_still_on : tuple of int
        IDs that did not confirm torque off.
    limits : tuple of LimitRow
        Limits that the servos have stored, beside the map's.
    """

    end_state: str = NOT_ARMED
    servos: tuple[ServoEnd, ...] = ()
    faults: list[Fault] = field(default_factory=list)
    fault_state: State | None = None
    fault_time: float = math.nan
    policy_goals: list[tuple[float, int, int]] = field(default_factory=list)
    record: Record = field(default_factory=lambda: Record([]))
    timing: TimingStatistics | None = None
    torque_still_on: tuple[int, ...] = ()
    limits: tuple[LimitRow, ...] = ()

    @property
    def fault(self) -> Fault | None:
        """The one that stopped the motion, the gravest of its cycle."""
        return self.faults[0] if self.faults else None

    @property
    def fault_text(self) -> str:
        """All faults in words, the first one with the state it struck in; empty without one."""
        first = f" in {self.fault_state.name}" if self.fault_state is not None else ""
        texts = [f"{fault.cause}{'' if number else first}: {fault.text}" for number, fault in enumerate(self.faults)]
        return "; ".join(texts)

    def summary(self) -> dict[str, Any]:
        """How it ended, for ``summary.json``."""
        summary: dict[str, Any] = {
            "end_state": self.end_state,
            "servos": [servo.as_dict() for servo in self.servos],
        }
        if self.fault is not None:
            summary |= {"fault": self.fault.cause.value, "fault_text": self.fault.text}
            summary["faults"] = [
                {"cause": fault.cause.value, "text": fault.text, "ids": fault.ids} for fault in self.faults
            ]
        return summary

    def declare(self, fault: Fault) -> None:
        """Add a fault; what has the cause of an earlier one joins it."""
        for number, known in enumerate(self.faults):
            if known.cause == fault.cause:
                ids = known.ids + tuple(id_ for id_ in fault.ids if id_ not in known.ids)
                self.faults[number] = replace(known, text=_joined(known.text, fault.text), ids=ids)
                return
        self.faults.append(fault)


def _joined(first: str, second: str) -> str:
    """Texts "who: what" of one cause; what befell several is said once."""
    who, _, what = first.partition(": ")
    other, _, the_same = second.partition(": ")
    return f"{who}, {other}: {what}" if what and what == the_same else f"{first}; {second}"


class Stopped(Exception):
    """The replay cannot go on: rules, the user or a servo say so."""

    def __init__(self, *faults: Fault) -> None:
        super().__init__("; ".join(fault.text for fault in faults))
        self.faults = faults
