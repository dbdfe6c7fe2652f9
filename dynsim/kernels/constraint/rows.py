"""The table of active rows: which candidates are held, and how; joints that follow others; the forces of candidates.

A row is one scalar constraint J vdot = target with one force. It has a kind, an owner (a candidate or a coupling) and
up to two bodies, and is rebuilt only when a mode changes: couplings first, then the candidates in their order; behind
the active rows, one of no force for each candidate that is off its surface.
"""

from __future__ import annotations

import math

from dynsim.kernels.arrays import (
    ANCHOR,
    BODY_A,
    BODY_B,
    COUPLED,
    DIRECTION,
    FIRST_ROW,
    FIRST_TANGENT,
    FOLLOWER,
    FORCE,
    FORCE_VECTOR,
    FRICTION_LAW,
    FRICTION_SIGNED,
    GAP,
    GAP_RATE,
    HELD,
    JOINT_ROW,
    LAW,
    LEADER,
    LINK,
    MODE,
    MOST_ROWS,
    MU,
    NORMAL,
    OFFSET,
    OPEN,
    OWNER,
    POSITION,
    QD,
    RATIO,
    ROW,
    ROW_GAP,
    ROW_KIND,
    ROW_MU,
    ROW_OFFSET,
    ROW_RATE,
    ROW_STATE_SIZE,
    ROWS,
    SECOND_TANGENT,
    SIGN,
    SLIDING,
    SLIDING_ROW,
    STICKING,
    STICKING_ROW,
    TARGET,
    A,
    ContactArrays,
    CouplingArrays,
    ModelArrays,
    Q,
    V,
    Workspace,
)
from dynsim.kernels.constraint.unilateral import (
    LIMIT,
    SIDE,
    STOP_CLOSED,
    STOP_FORCE,
    STOP_JOINT,
    STOP_ROW,
    UnilateralArrays,
)
from dynsim.kernels.jit import apart_kernel, internal_kernel


@internal_kernel
def set_modes(
    contacts: ContactArrays, couplings: CouplingArrays, unilateral: UnilateralArrays | None, ws: Workspace, modes
):
    """Give every candidate its mode, (c,) of OPEN, SLIDING or STICKING, and rebuild the table of rows.

    Behind the couplings come the joint stops that are closed, then the candidates.

    Call it right after ``derivative`` at the state where modes change, and ``derivative`` once more afterwards: a
    candidate that begins to stick is held where the last evaluation has seen it. Its slip should have come to rest:
    what is left of it the next projection takes away, unseen by the ledger.
    """
    active, rows = ws.active, ws.rows
    p, held = couplings.joint.shape[0], 0
    for k in range(p):
        new_row(ws, k, JOINT_ROW, k, couplings.joint[k, FOLLOWER])
        active[k, BODY_B] = couplings.joint[k, LEADER]
        rows[k, ROW], rows[k, ROW + 1] = 1.0, -couplings.law[k, RATIO]
        rows[k, DIRECTION], rows[k, DIRECTION + 1] = rows[k, ROW], rows[k, ROW + 1]
        rows[k, ROW_OFFSET] = couplings.law[k, OFFSET]
    if unilateral is not None:
        p = stop_rows(unilateral, ws, p)
    joint_rows = p
    for k in range(contacts.link.shape[0]):
        i = contacts.link[k, LINK]
        if modes[k] == STICKING and active[k, MODE] != STICKING:
            drop_anchor(ws, k)
        active[k, MODE], active[k, FIRST_ROW] = modes[k], p
        if modes[k] == SLIDING:
            new_row(ws, p, SLIDING_ROW, k, i)
            active[p, LAW] = contacts.link[k, FRICTION_LAW]
            rows[p, ROW_MU] = contacts.point[k, MU]
            p += 1
        elif modes[k] == STICKING:
            held += 1
            for _ in range(MOST_ROWS):
                new_row(ws, p, STICKING_ROW, k, i)
                p += 1
    ws.counts[ROWS], ws.counts[COUPLED], ws.counts[HELD] = p, joint_rows, held
    for k in range(contacts.link.shape[0]):
        if modes[k] == OPEN:
            active[k, FIRST_ROW] = p
            new_row(ws, p, SLIDING_ROW, k, contacts.link[k, LINK])
            p += 1
    # Solves write the joints that a row feels, and read all the others as zero.
    for i in range(ws.column.shape[0]):
        for s in range(ws.column.shape[1]):
            ws.column[i, s] = 0.0


@internal_kernel
def stop_rows(unilateral: UnilateralArrays, ws: Workspace, p):
    """A joint row, of one joint, for every stop that is closed; returns the number of rows then."""
    table, stop, couplings = unilateral.stop_table, unilateral.stop, p
    for k in range(table.shape[0]):
        stop[k, STOP_FORCE] = 0.0
        if table[k, STOP_CLOSED] == 1:
            joint = table[k, STOP_JOINT]
            new_row(ws, p, JOINT_ROW, couplings + k, joint)
            ws.active[p, BODY_B] = joint
            ws.rows[p, ROW], ws.rows[p, DIRECTION], ws.rows[p, ROW_OFFSET] = (
                stop[k, SIDE],
                stop[k, SIDE],
                stop[k, LIMIT],
            )
            table[k, STOP_ROW] = p
            p += 1
    return p


@internal_kernel
def new_row(ws: Workspace, r, kind, owner, link):
    """Row r of one body, without friction."""
    active = ws.active
    active[r, ROW_KIND], active[r, OWNER], active[r, LAW] = kind, owner, FRICTION_SIGNED
    active[r, BODY_A], active[r, BODY_B] = link, -1
    for s in range(ROW_STATE_SIZE):
        ws.rows[r, s] = 0.0
    ws.rows[r, SIGN] = 1.0


@internal_kernel
def drop_anchor(ws: Workspace, k):
    """Hold candidate k at the foot of its present position on the surface, along n and two tangents there."""
    state = ws.contacts
    for s in range(3):
        state[k, ANCHOR + s] = state[k, POSITION + s] - state[k, GAP] * state[k, NORMAL + s]
    tangents(ws, k)


@internal_kernel
def tangents(ws: Workspace, k):
    """Two directions along the surface at the present normal of candidate k, for the rows of a point that sticks."""
    state = ws.contacts
    x, y, z = state[k, NORMAL], state[k, NORMAL + 1], state[k, NORMAL + 2]
    # n × the axis that is furthest from n.
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax <= ay and ax <= az:
        tx, ty, tz = 0.0, z, -y
    elif ay <= az:
        tx, ty, tz = -z, 0.0, x
    else:
        tx, ty, tz = y, -x, 0.0
    scale = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = scale * tx, scale * ty, scale * tz
    state[k, FIRST_TANGENT], state[k, FIRST_TANGENT + 1], state[k, FIRST_TANGENT + 2] = tx, ty, tz
    state[k, SECOND_TANGENT] = y * tz - z * ty
    state[k, SECOND_TANGENT + 1] = z * tx - x * tz
    state[k, SECOND_TANGENT + 2] = x * ty - y * tx


@internal_kernel
def point_row(rows, r, x, y, z, dx, dy, dz):
    """Motion of a body's point at (x, y, z) along (dx, dy, dz), as row r."""
    rows[r, ROW], rows[r, ROW + 1], rows[r, ROW + 2] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    rows[r, ROW + 3], rows[r, ROW + 4], rows[r, ROW + 5] = dx, dy, dz


@apart_kernel
def sticking_rows(model: ModelArrays, ws: Workspace, k, i):
    """Rows of candidate k, on link i, that sticks; the first one is there already.

    The first row is the surface's own, as if it slid, so that the gap stays that of the surface. The others are
    t · (r − anchor) = 0 with the tangents t of the anchor: constant, so that t · r̈ = 0 is exact on any surface,
    whatever is left of the velocity. At rest the three together are r̈ = 0.
    """
    state, rows, links, active = ws.contacts, ws.rows, ws.links, ws.active
    first = active[k, FIRST_ROW]
    x, y, z = state[k, POSITION], state[k, POSITION + 1], state[k, POSITION + 2]
    # Velocity of the point, and its acceleration at vdot = 0 (A carries −g from its root).
    wx, wy, wz = links[i, V], links[i, V + 1], links[i, V + 2]
    vx, vy, vz = links[i, V + 3] + wy * z - wz * y, links[i, V + 4] + wz * x - wx * z, links[i, V + 5] + wx * y - wy * x
    ex, ey, ez = links[i, A], links[i, A + 1], links[i, A + 2]
    ax = links[i, A + 3] + model.gravity[0] + ey * z - ez * y + wy * vz - wz * vy
    ay = links[i, A + 4] + model.gravity[1] + ez * x - ex * z + wz * vx - wx * vz
    az = links[i, A + 5] + model.gravity[2] + ex * y - ey * x + wx * vy - wy * vx
    for m in range(MOST_ROWS):
        r = first + m
        d = NORMAL if m == 0 else FIRST_TANGENT if m == 1 else SECOND_TANGENT
        dx, dy, dz = state[k, d], state[k, d + 1], state[k, d + 2]
        point_row(rows, r, x, y, z, dx, dy, dz)
        for s in range(6):
            rows[r, DIRECTION + s] = rows[r, ROW + s]
        if m > 0:
            rows[r, TARGET] = -(dx * ax + dy * ay + dz * az)
            rows[r, ROW_RATE] = dx * vx + dy * vy + dz * vz
            rows[r, ROW_GAP] = (
                dx * (x - state[k, ANCHOR]) + dy * (y - state[k, ANCHOR + 1]) + dz * (z - state[k, ANCHOR + 2])
            )


@internal_kernel
def force_vectors(ws: Workspace):
    """Whole force of every candidate in W, friction included, into ``ws.contacts``, after ``derivative``."""
    state, rows, active = ws.contacts, ws.rows, ws.active
    for k in range(state.shape[0]):
        first = active[k, FIRST_ROW]
        for s in range(3):
            state[k, FORCE_VECTOR + s] = rows[first, FORCE] * rows[first, DIRECTION + 3 + s]
        if active[k, MODE] == STICKING:
            for r in range(first + 1, first + MOST_ROWS):
                for s in range(3):
                    state[k, FORCE_VECTOR + s] += rows[r, FORCE] * rows[r, DIRECTION + 3 + s]


@internal_kernel
def row_errors(ws: Workspace):
    """How far positions and rates are off each active row, into ROW_GAP and ROW_RATE, after ``derivative``.

    Of a coupling q_follower − ratio q_leader − offset; those of tangential rows of sticking points are there already.
    """
    rows, active, joints = ws.rows, ws.active, ws.joints
    for r in range(ws.counts[ROWS]):
        if active[r, ROW_KIND] == JOINT_ROW:
            a, b = active[r, BODY_A], active[r, BODY_B]
            rows[r, ROW_GAP] = rows[r, ROW] * joints[a, Q] + rows[r, ROW + 1] * joints[b, Q] - rows[r, ROW_OFFSET]
            rows[r, ROW_RATE] = joint_rate(ws, r)
    for k in range(ws.contacts.shape[0]):
        r = active[k, FIRST_ROW]
        rows[r, ROW_GAP], rows[r, ROW_RATE] = ws.contacts[k, GAP], ws.contacts[k, GAP_RATE]


@internal_kernel
def joint_rate(ws: Workspace, r):
    """Rate of the joint row r."""
    rows, active, joints = ws.rows, ws.active, ws.joints
    return rows[r, ROW] * joints[active[r, BODY_A], QD] + rows[r, ROW + 1] * joints[active[r, BODY_B], QD]
