"""Table of active constraint rows (couplings, dry friction, stops, contacts, ties), their forces and errors.

A row is one scalar constraint J vdot = target with one force. It has a kind, an owner (the candidate, coupling, stop,
joint or tie) and up to two bodies. The table is rebuilt only when a mode changes. Order: couplings, joints held by dry
friction, closed joint stops, closed candidates, ties; behind these active rows, one without force per open candidate.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.tables import ContactArrays, CouplingArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    ZERO_VECTOR,
    cross,
    dot_vector,
    point_acceleration,
    point_velocity,
    put_six,
    put_vector,
    six,
    times_number,
    vector,
    wrench_at,
)
from dynsim.jit.kernel import internal_kernel, noinline_kernel


@internal_kernel
def set_modes(
    contacts: ContactArrays, couplings: CouplingArrays, unilateral: UnilateralArrays | None, ws: Workspace, modes
):
    """Give every candidate its mode, (c,) of OPEN, SLIDING or STICKING, and rebuild the table of rows.

    Behind the couplings come the joints with dry friction, the joint stops that are closed, then the candidates, and
    ties between bodies.

    Call it right after ``derivative`` at the state where modes change, and ``derivative`` once more afterwards: a
    candidate that begins to stick is held where the last evaluation has seen it. Its slip should have come to rest:
    what is left of it the next projection takes away, unseen by the ledger.
    """
    active, rows = ws.active, ws.rows
    p, sticking = couplings.joint.shape[0], 0
    for k in range(p):
        new_row(ws, k, ka.JOINT_ROW, k, couplings.joint[k, ka.FOLLOWER])
        active[k, ka.BODY_B] = couplings.joint[k, ka.LEADER]
        rows[k, ka.ROW], rows[k, ka.ROW + 1] = 1.0, -couplings.law[k, ka.RATIO]
        rows[k, ka.DIRECTION], rows[k, ka.DIRECTION + 1] = rows[k, ka.ROW], rows[k, ka.ROW + 1]
        rows[k, ka.ROW_OFFSET] = couplings.law[k, ka.OFFSET]
    if unilateral is not None:
        p = dry_rows(unilateral, ws, p)
        p = stop_rows(unilateral, couplings.joint.shape[0], ws, p)
    joint_rows = p
    for k in range(contacts.link.shape[0]):
        i = contacts.link[k, ka.LINK]
        if modes[k] == ka.STICKING and active[k, ka.MODE] != ka.STICKING:
            drop_anchor(ws, k)
        active[k, ka.MODE], active[k, ka.FIRST_ROW] = modes[k], p
        if modes[k] == ka.SLIDING:
            new_row(ws, p, ka.SLIDING_ROW, k, i)
            active[p, ka.LAW] = contacts.link[k, ka.FRICTION_LAW]
            rows[p, ka.ROW_MU], rows[p, ka.ROW_FLOOR] = contacts.law[k, ka.MU], contacts.law[k, ka.FLOOR]
            p += 1
        elif modes[k] == ka.STICKING:
            sticking += 1
            for _ in range(ka.MOST_ROWS):
                new_row(ws, p, ka.STICKING_ROW, k, i)
                p += 1
    if unilateral is not None:
        p = tie_rows(unilateral, ws, p)
    ws.counts[ka.ROWS], ws.counts[ka.COUPLED], ws.counts[ka.STUCK] = p, joint_rows, sticking
    for k in range(contacts.link.shape[0]):
        if modes[k] == ka.OPEN:
            active[k, ka.FIRST_ROW] = p
            new_row(ws, p, ka.SLIDING_ROW, k, contacts.link[k, ka.LINK])
            p += 1
    # Solves write the joints that a row feels, and read all the others as zero.
    for i in range(ws.column.shape[0]):
        for s in range(ws.column.shape[1]):
            ws.column[i, s] = 0.0


@internal_kernel
def dry_rows(unilateral: UnilateralArrays, ws: Workspace, p):
    """A joint row, of one joint, for every joint that dry friction holds; returns the number of rows then."""
    table, owner = unilateral.dry_table, p + unilateral.stop_table.shape[0]
    for k in range(table.shape[0]):
        if table[k, ku.DRY_HOLDS] == 0:
            continue
        joint = table[k, ku.DRY_JOINT]
        new_row(ws, p, ka.JOINT_ROW, owner + k, joint)
        ws.active[p, ka.BODY_B] = joint
        ws.rows[p, ka.ROW], ws.rows[p, ka.DIRECTION], ws.rows[p, ka.ROW_OFFSET] = 1.0, 1.0, unilateral.dry[k, ku.DRY_AT]
        table[k, ku.DRY_ROW] = p
        p += 1
    return p


@internal_kernel
def tie_rows(unilateral: UnilateralArrays, ws: Workspace, p):
    """A row between two bodies for every tie that holds; returns the number of rows then."""
    table = unilateral.tie_table
    for k in range(table.shape[0]):
        if table[k, ku.TIE_HOLDS] == 1:
            new_row(ws, p, ka.BODY_ROW, k, table[k, ku.TIE_A])
            ws.active[p, ka.BODY_B], table[k, ku.TIE_ROW] = table[k, ku.TIE_B], p
            p += 1
    return p


@internal_kernel
def stop_rows(unilateral: UnilateralArrays, couplings, ws: Workspace, p):
    """A joint row, of one joint, for every stop that is closed; returns the number of rows then."""
    table, stop = unilateral.stop_table, unilateral.stop
    for k in range(table.shape[0]):
        stop[k, ku.STOP_FORCE] = 0.0
        if table[k, ku.STOP_CLOSED] == 1:
            joint = table[k, ku.STOP_JOINT]
            new_row(ws, p, ka.JOINT_ROW, couplings + k, joint)
            ws.active[p, ka.BODY_B] = joint
            ws.rows[p, ka.ROW], ws.rows[p, ka.DIRECTION], ws.rows[p, ka.ROW_OFFSET] = (
                stop[k, ku.SIDE],
                stop[k, ku.SIDE],
                stop[k, ku.LIMIT],
            )
            table[k, ku.STOP_ROW] = p
            p += 1
    return p


@internal_kernel
def new_row(ws: Workspace, r, kind, owner, link):
    """Row r of one body, without friction."""
    active = ws.active
    active[r, ka.ROW_KIND], active[r, ka.OWNER], active[r, ka.LAW] = kind, owner, ka.FRICTION_SIGNED
    active[r, ka.BODY_A], active[r, ka.BODY_B] = link, -1
    for s in range(ka.ROW_STATE_SIZE):
        ws.rows[r, s] = 0.0
    ws.rows[r, ka.SIGN] = 1.0


@internal_kernel
def drop_anchor(ws: Workspace, k):
    """Hold candidate k at the foot of its present position on the surface, along n and two tangents there."""
    state = ws.contacts
    for s in range(3):
        state[k, ka.ANCHOR + s] = state[k, ka.POSITION + s] - state[k, ka.GAP] * state[k, ka.NORMAL + s]
    tangents(ws, k)


@internal_kernel
def tangents(ws: Workspace, k):
    """Two directions along the surface at the present normal of candidate k, for the rows of a point that sticks."""
    state = ws.contacts
    n = vector(state, k, ka.NORMAL)
    # n × the axis that is furthest from n.
    ax, ay, az = abs(n[0]), abs(n[1]), abs(n[2])
    if ax <= ay and ax <= az:
        t = 0.0, n[2], -n[1]
    elif ay <= az:
        t = -n[2], 0.0, n[0]
    else:
        t = n[1], -n[0], 0.0
    t = times_number(t, 1.0 / math.sqrt(dot_vector(t, t)))
    put_vector(state, k, ka.FIRST_TANGENT, t)
    put_vector(state, k, ka.SECOND_TANGENT, cross(n, t))


@internal_kernel
def point_row(rows, r, at, d):
    """Motion of a body's point at ``at`` along d, as row r."""
    put_six(rows, r, ka.ROW, wrench_at(at, d, ZERO_VECTOR))


@noinline_kernel
def sticking_rows(model: ModelArrays, ws: Workspace, k, i):
    """Rows of candidate k, on link i, that sticks; the first one is there already.

    The first row is the surface's own, as if it slid, so that the gap stays that of the surface. The others are
    t · (r − anchor) = 0 with the tangents t of the anchor: constant, so that t · r̈ = 0 is exact on any surface,
    whatever is left of the velocity. At rest the three together are r̈ = 0.
    """
    state, rows, links, active = ws.contacts, ws.rows, ws.links, ws.active
    first = active[k, ka.FIRST_ROW]
    at = vector(state, k, ka.POSITION)
    # Velocity of the point, and its acceleration at vdot = 0 (A carries −g from its root).
    V = six(links, i, ka.V)
    v, a = point_velocity(V, at), point_acceleration(six(links, i, ka.A), V, at)
    a = a[0] + model.gravity[0], a[1] + model.gravity[1], a[2] + model.gravity[2]
    offset = at[0] - state[k, ka.ANCHOR], at[1] - state[k, ka.ANCHOR + 1], at[2] - state[k, ka.ANCHOR + 2]
    for m in range(ka.MOST_ROWS):
        r = first + m
        d = vector(state, k, ka.NORMAL if m == 0 else ka.FIRST_TANGENT if m == 1 else ka.SECOND_TANGENT)
        point_row(rows, r, at, d)
        for s in range(6):
            rows[r, ka.DIRECTION + s] = rows[r, ka.ROW + s]
        if m > 0:
            rows[r, ka.TARGET] = -dot_vector(d, a)
            rows[r, ka.ROW_RATE] = dot_vector(d, v)
            rows[r, ka.ROW_GAP] = dot_vector(d, offset)


@internal_kernel
def force_vectors(ws: Workspace):
    """Whole force of every candidate in W, friction included, into ``ws.contacts``, after ``derivative``."""
    state, rows, active = ws.contacts, ws.rows, ws.active
    for k in range(state.shape[0]):
        first = active[k, ka.FIRST_ROW]
        for s in range(3):
            state[k, ka.FORCE_VECTOR + s] = rows[first, ka.FORCE] * rows[first, ka.DIRECTION + 3 + s]
        if active[k, ka.MODE] == ka.STICKING:
            for r in range(first + 1, first + ka.MOST_ROWS):
                for s in range(3):
                    state[k, ka.FORCE_VECTOR + s] += rows[r, ka.FORCE] * rows[r, ka.DIRECTION + 3 + s]


@internal_kernel
def row_errors(ws: Workspace):
    """How far positions and rates are off each active row, into ROW_GAP and ROW_RATE, after ``derivative``.

    Of a coupling q_follower − ratio q_leader − offset; those of tangential rows of sticking points are there already.
    """
    rows, active, joints = ws.rows, ws.active, ws.joints
    for r in range(ws.counts[ka.ROWS]):
        if active[r, ka.ROW_KIND] == ka.JOINT_ROW:
            a, b = active[r, ka.BODY_A], active[r, ka.BODY_B]
            rows[r, ka.ROW_GAP] = (
                rows[r, ka.ROW] * joints[a, ka.Q] + rows[r, ka.ROW + 1] * joints[b, ka.Q] - rows[r, ka.ROW_OFFSET]
            )
            rows[r, ka.ROW_RATE] = joint_rate(ws, r)
    for k in range(ws.contacts.shape[0]):
        r = active[k, ka.FIRST_ROW]
        rows[r, ka.ROW_GAP], rows[r, ka.ROW_RATE] = ws.contacts[k, ka.GAP], ws.contacts[k, ka.GAP_RATE]


@internal_kernel
def joint_rate(ws: Workspace, r):
    """Rate of the joint row r."""
    rows, active, joints = ws.rows, ws.active, ws.joints
    return (
        rows[r, ka.ROW] * joints[active[r, ka.BODY_A], ka.QD]
        + rows[r, ka.ROW + 1] * joints[active[r, ka.BODY_B], ka.QD]
    )
