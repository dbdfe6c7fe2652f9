"""Pairs of contact events between which a point or joint moves less than a micrometre or microradian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.engine.prepare import Prepared
from dynsim.record import Event, Record

# Motion below which slip and openings are not counted [m or rad]: the distance up to which a contact counts as closed
# at the start. At the limit of friction, rounding lets points start to slip at 1e-11 m/s and stop at the next tick.
LEAST = 1e-6
# Samples within an opening or a slip of a joint from which its extent is known; a parabola through three samples is at
# most a third higher than the largest of them.
INSIDE = 3
# Duration up to which the joint positions before and after a slip show its extent [s].
SHORT = 0.02
PAIRS = {("slip_start", "slip_stop"): ku.SLIP_STARTS, ("lift_off", "landing"): ku.LIFT_OFFS}


def without_negligible(record: Record, prepared: Prepared, happened: Sequence[Event]) -> tuple[list[Event], Prepared]:
    """Return the events that count, and the run with as many events in its tally.

    A slip is omitted with its end, and a lift-off with the landing that follows it. The samples around and within the
    pair must show that the slip, or the gap, is below :data:`LEAST`; otherwise the pair is kept.

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
        column = None if begin is None else PAIRS.get((happened[begin].kind, event.kind))
        if begin is None or column is None or after[end] >= len(record):
            continue
        span = slice(max(int(before[begin]), 0), int(after[end]) + 1)
        contact, joint = contacts.get(event.name), joints.get(event.name)
        # A contact and a joint may have the same name; the contact is then known to be open.
        if contact is not None and joint is not None:
            if not open_at[span, contact].all():
                continue
            contact = None
        inside = span.stop - span.start - 2 >= INSIDE
        if contact is None:
            extent = np.ptp(record["q"][span, joint]) if inside or event.time - happened[begin].time <= SHORT else 1.0
        elif column == ku.SLIP_STARTS:
            extent = np.ptp(record["contact_slip_distance"][span, contact])
        else:
            extent = record["contact_gap"][span, contact].max() if inside else 1.0
        if extent < LEAST:
            omitted |= {begin, end}
            if contact is not None:
                tally[contact, [column, *([ku.LANDINGS] if column == ku.LIFT_OFFS else [])]] -= 1.0
    kept = [event for k, event in enumerate(happened) if k not in omitted]
    return kept, replace(prepared, system=prepared.system._replace(unilateral=unilateral._replace(tally=tally)))
