"""Data types of a stepped simulation: states, contact forces, snapshots; default guards, and events of the kernels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.prepare import Prepared
from dynsim.errors import RecordError, brief
from dynsim.integrators import events
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as contact_events
from dynsim.record import Record
from dynsim.system.arguments import names_wrong_types

Array = NDArray[np.float64]

# Guards of events: their number in the kernels and the kind of object that they observe.
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


# Events of contacts, joint stops and joints with dry friction, by their numbers in the kernels.
CONTACT_EVENTS = {
    contact_events.LANDING: "landing",
    contact_events.LIFT_OFF: "lift_off",
    contact_events.SLIP_START: "slip_start",
    contact_events.SLIP_STOP: "slip_stop",
    contact_events.BOUNCE: "bounce",
    contact_events.CHATTERS: "chatter",
    contact_events.STOP_HIT: "stop_hit",
    contact_events.STOP_LEFT: "stop_left",
}


def take_log(run: ki.Run) -> list[tuple[float, int]]:
    """Empty the event log of the kernels and return times [s] and event numbers."""
    logged = int(run.count[ki.LOGGED])
    if logged == 0:
        return []
    run.count[ki.LOGGED] = 0
    return list(zip(run.log_time[:logged].tolist(), run.log_event[:logged].tolist(), strict=True))


def event_name(prepared: Prepared, number: int) -> tuple[str, str] | None:
    """Return kind and subject of a logged event of a contact, stop or joint with dry friction; None for a guard."""
    if number < ki.CONTACT_LOG:
        return None
    first = max(log for log in (ki.CONTACT_LOG, ki.STOP_LOG, ki.DRY_LOG) if log <= number)
    k, kind = divmod(number - first, contact_events.LOG_KINDS)
    if first == ki.CONTACT_LOG:
        return CONTACT_EVENTS[kind], prepared.contacts[k].name
    return CONTACT_EVENTS[kind], (prepared.stops if first == ki.STOP_LOG else prepared.dry)[k].joint


@names_wrong_types
@dataclass(frozen=True)
class State:
    """State of a simulation.

    Attributes
    ----------
    time : float
        Time [s].
    q : (nq,) ndarray
        Joint positions [rad or m]; quaternions [1].
    v : (n,) ndarray
        Joint rates [rad/s or m/s].
    current : (circuits,) ndarray
        Currents of the motors that have a circuit [A].
    tie_rest : (ties,) ndarray or None
        Rest values x_0 of the ties [m or rad], which change when ties slide beyond a bound; None: the values at the
        start of the scenario.

    Notes
    -----
    docs/terms.md explains the symbols.

    Examples
    --------
    Start a second simulation from the end of a record:

    >>> import dynsim
    >>> scenario = dynsim.load_scenario("single_pendulum", overrides={"duration_s": 1})
    >>> state = dynsim.State.of(dynsim.simulate(scenario))
    >>> state.time, state.q.shape, state.current.shape
    (1.0, (1,), (0,))
    >>> dynsim.Simulation(scenario, state=state, duration=2.0).advance(1.5).time
    1.5
    """

    time: float
    q: Array
    v: Array
    current: Array
    tie_rest: Array | None = None

    @classmethod
    def of(cls, record: Record, sample: int = -1) -> State:
        """Return the state at a sample of a record.

        Parameters
        ----------
        record : Record
            Record of a dynamics run.
        sample : int, optional
            Index of the sample; default: the last.

        Returns
        -------
        State
            State at the sample, without ``tie_rest``, which records do not contain.

        Raises
        ------
        MissingEntry
            If the record has no positions, rates or currents.
        RecordError
            If the record has no such sample.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.simulate(dynsim.load_scenario("single_pendulum", overrides={"duration_s": 1}))
        >>> dynsim.State.of(record, 0).time
        0.0
        """
        names = ("q", "v", "current")
        if not -len(record.time) <= sample < len(record.time):
            raise RecordError(f"sample = {brief(sample)}: the record has {len(record.time)} samples")
        return cls(float(record.time[sample]), *(np.array(record[name][sample], dtype=np.float64) for name in names))


@dataclass(frozen=True)
class Touch:
    """Force and mode of a contact point.

    Attributes
    ----------
    force : float
        Normal force [N]; negative: pulling.
    vector : (3,) ndarray
        Normal and friction force in the world frame [N].
    mode : int or None
        0 off its surface, 1 sliding, 2 sticking; None under the bilateral law.
    position, normal : (3,) ndarray
        Point at which the force acts [m], and normal of the surface there, in the world frame.
    """

    force: float
    vector: Array
    mode: int | None
    position: Array
    normal: Array


@dataclass(frozen=True)
class Snapshot:
    """Complete state of a simulation; created by :meth:`Simulation.snapshot`."""

    owner: object
    arrays: dict[str, NDArray[Any]]
    behind_brakes: Mapping[str, float]
    tick_handlers: list[dict[str, Any]]
    attributes: dict[str, Any]
