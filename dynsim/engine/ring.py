"""Events that count, and the statistics of a run that keeps only its last samples, in a ring buffer.

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
from dynsim.record import Event, Record

_COUNTS = {
    "lift_off": ku.LIFT_OFFS,
    "landing": ku.LANDINGS,
    "slip_start": ku.SLIP_STARTS,
    "bounce": ku.BOUNCES,
    "chatter": ku.CHATTERED,
}
# Motion below which slip and openings are not counted [m or rad]: the distance up to which a contact counts as closed
# at the start. At the limit of friction, rounding lets points start to slip at 1e-11 m/s and stop at the next tick.
NEGLIGIBLE = 1e-6
# Samples within an opening or a slip of a joint from which its extent is known; a parabola through three samples is at
# most a third higher than the largest of them.
_INSIDE = 3
# Duration up to which the joint positions before and after a slip show its extent [s].
_SHORT = 0.02
_PAIRS = {("slip_start", "slip_stop"): ku.SLIP_STARTS, ("lift_off", "landing"): ku.LIFT_OFFS}
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


def without_negligible(record: Record, prepared: Prepared, happened: Sequence[Event]) -> tuple[list[Event], Prepared]:
    """Return the events that count, and the run with as many events in its tally.

    A slip is omitted with its end, and a lift-off with the landing that follows it. The samples around and within the
    pair must show that the slip, or the gap, is below :data:`NEGLIGIBLE`; otherwise the pair is kept.

    Parameters
    ----------
    record : Record
        Record with positions, gaps and slip distances.
    prepared : Prepared
        Prepared run under the unilateral law.
    happened : sequence of Event
        Events of the run in chronological order.
    """
    unilateral = prepared.system.unilateral
    if unilateral is None or not len(record):
        return list(happened), prepared
    contacts = {contact.name: k for k, contact in enumerate(prepared.contacts)}
    joints = {dry.joint: record.labels["q"].index(dry.joint) for dry in prepared.dry}
    times = np.array([event.time for event in happened])
    before, after = np.searchsorted(record.time, times, "left") - 1, np.searchsorted(record.time, times, "left")
    open_at = prepared.run.outputs("contact")[:, :, kst.OUT_MODE] == ka.OPEN
    tally, omitted, last = unilateral.tally.copy(), set[int](), dict[str, int]()
    for end, event in enumerate(happened):
        begin = last.get(event.name)
        last[event.name] = end
        column = None if begin is None else _PAIRS.get((happened[begin].kind, event.kind))
        if begin is None or column is None or after[end] >= len(record):
            continue
        span = slice(max(int(before[begin]), 0), int(after[end]) + 1)
        contact, joint = contacts.get(event.name), joints.get(event.name)
        # A contact and a joint may have the same name; the contact is then known to be open.
        if contact is not None and joint is not None:
            if not open_at[span, contact].all():
                continue
            contact = None
        inside = span.stop - span.start - 2 >= _INSIDE
        if contact is None:
            extent = np.ptp(record["q"][span, joint]) if inside or event.time - happened[begin].time <= _SHORT else 1.0
        elif column == ku.SLIP_STARTS:
            extent = np.ptp(record["contact_slip_distance"][span, contact])
        else:
            extent = record["contact_gap"][span, contact].max() if inside else 1.0
        if extent < NEGLIGIBLE:
            omitted |= {begin, end}
            if contact is not None:
                tally[contact, [column, *([ku.LANDINGS] if column == ku.LIFT_OFFS else [])]] -= 1.0
    kept = [event for k, event in enumerate(happened) if k not in omitted]
    return kept, replace(prepared, system=prepared.system._replace(unilateral=unilateral._replace(tally=tally)))
