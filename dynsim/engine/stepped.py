"""What goes in and out of a stepped simulation: states, events, snapshots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.trace import Rows
from dynsim.kernels.integrate import events
from dynsim.kernels.integrate import run as ki
from dynsim.record import Event, Record

Array = NDArray[np.float64]

# Guards of events by name: number in the kernels, and what they are about.
GUARDS = {
    "joint_position": (events.JOINT_POSITION, "joint"),
    "joint_rate": (events.JOINT_RATE, "joint"),
    "motor_current": (events.MOTOR_CURRENT, "motor"),
    "motor_voltage": (events.MOTOR_VOLTAGE, "motor"),
    "contact_force": (events.CONTACT_FORCE, "contact"),
    "contact_gap": (events.CONTACT_GAP, "contact"),
    "hand_position": (events.HAND_X, "axis"),
    "tip_margin": (events.TIP_MARGIN, "base"),
}


def take_log(run: ki.Run) -> list[tuple[float, int]]:
    """Empty the log of the kernels: times [s] and indices of what has happened."""
    logged = int(run.count[ki.LOGGED])
    run.count[ki.LOGGED] = 0
    return list(zip(run.log_time[:logged].tolist(), run.log_event[:logged].tolist(), strict=True))


@dataclass(frozen=True)
class State:
    """The state of a simulation.

    Attributes
    ----------
    time : [s]
    q : (nq,) positions [rad or m]; v : (n,) rates; current : of the motors that have a circuit [A]
    """

    time: float
    q: Array
    v: Array
    current: Array

    @classmethod
    def of(cls, record: Record, sample: int = -1) -> State:
        """The state at a sample of a record, by default the last.

        Raises
        ------
        MissingEntry
            The record has no positions, rates or currents.
        """
        names = ("q", "v", "current")
        return cls(float(record.time[sample]), *(np.array(record[name][sample], dtype=np.float64) for name in names))


@dataclass(frozen=True)
class Snapshot:
    """Everything that the future of a simulation depends on; made by :meth:`Simulation.snapshot`."""

    owner: object
    arrays: dict[str, NDArray[Any]]
    time: float
    trace: tuple[tuple[Rows, ...], int]
    happened: tuple[Event, ...]
    frozen: bool
