"""Event counts and statistics of a run that keeps only its last samples, in a ring buffer.

The kernels count from the beginning of the run. Within the ring, events are counted; times, fractions and extremes are
computed from the samples. Three numbers are unknown: the losses of single contacts, the losses of single stops, and the
energy change if everything happened half a step later. They are NaN here and are omitted from summaries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.engine.prepare import Prepared
from dynsim.integrators import run as ki
from dynsim.integrators.stepping import tables as kt
from dynsim.model.description import Array
from dynsim.record import Event

_COUNTS = {
    "lift_off": ku.LIFT_OFFS,
    "landing": ku.LANDINGS,
    "slip_start": ku.SLIP_STARTS,
    "bounce": ku.BOUNCES,
    "chatter": ku.CHATTERED,
}
_MODES = {ka.OPEN: ku.TIME_OPEN, ka.SLIDING: ku.TIME_SLIDING, ka.STICKING: ku.TIME_STICKING}


def counted_within(prepared: Prepared, happened: Sequence[Event]) -> Prepared:
    """Return the run with statistics and extremes of the kept samples and of the events from the first sample on.

    Parameters
    ----------
    prepared : Prepared
        Prepared run with at least one sample in the ring; its energies count from the first sample.
    happened : sequence of Event
        Events within the ring.
    """
    run, unilateral = prepared.run, prepared.system.unilateral
    touch = run.outputs("contact")
    on = (touch[:, :, kst.OUT_MODE] != ka.OPEN) | (unilateral is None)
    gaps = np.where(on, touch[:, :, kst.OUT_GAP], 0.0)
    depths = np.maximum(-gaps, 0.0).max(axis=0)
    extremes, weights = _extremes(run, touch[:, :, kst.OUT_FORCE], gaps), time_shares(run.sample_time)
    system = prepared.system
    if unilateral is not None:
        tally, stop = unilateral.tally.copy(), unilateral.stop.copy()
        for mode, column in _MODES.items():
            tally[:, column] = weights @ (touch[:, :, kst.OUT_MODE] == mode)
        tally[:, list(_COUNTS.values())], tally[:, ku.LOSS] = 0.0, np.nan
        tally[:, ku.DEEPEST] = depths
        contacts = {contact.name: k for k, contact in enumerate(prepared.contacts)}
        for event in happened:
            if event.kind in _COUNTS and event.name in contacts:
                tally[contacts[event.name], _COUNTS[event.kind]] += 1.0
        count = len(prepared.stops)
        stop[:, [ku.HITS, ku.STOP_CHATTERED]], stop[:, ku.STOP_LOSS] = 0.0, np.nan
        stop[:count, ku.CLOSED_TIME] = weights @ (run.outputs("stop")[:, :count] > 0.0)
        for event in happened:
            if event.kind == "stop_hit":
                stop[_struck(prepared, event), ku.HITS] += 1.0
            elif event.kind == "chatter" and event.name not in contacts:
                stop[_struck(prepared, event), ku.STOP_CHATTERED] += 1.0
        system = system._replace(unilateral=unilateral._replace(tally=tally, stop=stop))
    stepping = run.stepping
    if stepping is not None:
        statistics, scheme = stepping.statistics.copy(), run.states("scheme")[:, 0]
        statistics[kt.TAKEN] = scheme[np.abs(scheme).argmax()]
        statistics[kt.MADE] = (np.maximum.accumulate(scheme) - scheme).max()
        statistics[kt.HALF_STEP] = np.nan
        rigid = np.array([contact.stiffness == 0.0 for contact in prepared.contacts], dtype=bool)
        statistics[kt.PENETRATION] = depths[rigid].max(initial=0.0)
        stepping = stepping._replace(statistics=statistics)
    # An empty array means that the minimum loads of a mobile base between the samples are unknown.
    support = run.support._replace(least=np.zeros(0))
    run = run._replace(extremes=extremes, stepping=stepping, support=support)
    return replace(prepared, run=run, system=system)


def _extremes(run: ki.Run, force: Array, gaps: Array) -> Array:
    """Return the extremes of the samples, (c, EXTREMES_SIZE).

    Arguments are the normal forces [N] and the gaps of closed contacts [m], both (T, c).
    """
    extremes = run.extremes.copy()
    extremes[:, ki.FORCE_MIN], extremes[:, ki.FORCE_MAX] = force.min(axis=0), force.max(axis=0)
    extremes[:, ki.DRIFT_MAX] = np.abs(gaps).max(axis=0)
    # As in dynsim.integrators.run, forces are linear between two samples.
    low, high = np.minimum(force[1:], force[:-1]), np.maximum(force[1:], force[:-1])
    part = np.where(high <= 0.0, 1.0, low / np.where(low < high, low - high, -1.0))
    extremes[:, ki.PULLING] = np.diff(run.sample_time) @ np.where(low < 0.0, part, 0.0)
    # Times before the first sample are unknown.
    since = extremes[:, ki.LOCAL_SINCE]
    since[since < run.sample_time[0]] = np.inf
    return extremes


def time_shares(times: Array) -> NDArray[np.float64]:
    """Return the time that each sample represents [s]: half of each adjacent interval."""
    halves = 0.5 * np.diff(times)
    return np.append(halves, 0.0) + np.append(0.0, halves)


def _struck(prepared: Prepared, event: Event) -> int:
    """Return the index of the stop that a joint hit: events name the joint, and its nearest stop was hit."""
    run, robot = prepared.run, prepared.model.robot
    row = min(int(np.searchsorted(run.sample_time, event.time)), len(run.sample_time) - 1)
    q = run.states("q")[row, robot.position_index[robot.joint_names.index(event.name)]]
    own = [k for k, stop in enumerate(prepared.stops) if stop.joint == event.name]
    return min(own, key=lambda k: abs(q - prepared.stops[k].position))
