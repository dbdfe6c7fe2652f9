"""Time stepping: contacts that open, close, stick and slide within steps of one length, without locating anything.

Moreau's and Jean's θ method for the whole coupled system. From (q, v, i) over a step h, with geometry at the midpoint
q_m = q + h v / 2 and x_θ = x + θ (x' − x):

    M (v' − v) = h (τ_θ + Q − bias) + Jᵀ p,    L (i' − i) = h (u_θ − R i_θ − K_m v_θ),    q' = q + h v_θ

Drives are implicit, by their linear blocks: i' is eliminated, and what is left of voltage loops, back-EMF and damping
comes to the diagonal of M. The impulses p solve one contact problem (dynsim.kernels.constraint.cone) over all
candidates with gap(q_m) ≤ 0: J v' + e J v (of an approach) ≥ 0 ⟂ p_n ≥ 0, Coulomb's cone, and couplings both ways.
Its coefficient is that of the slip at the start of the step: the static one at rest, else that of the speed (first
order, where it depends on it).

θ = 1 damps and is of first order; θ = 1/2 is of second order where no contact changes, and keeps the energy of linear
systems, contacts aside, to rounding. A landing leaves a penetration of up to h times its speed, which stays until the
point leaves; it is reported and shrinks with the step.

The ledger holds what the scheme does: power at x_θ, friction −p_t·(u + u')/2, and of rows that hold p_n (u_n + u_n')/2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.kernels.arrays import (
    APPLIED,
    ARMATURE,
    BLOCK_SIZE,
    BODY_A,
    BODY_B,
    CIRCUIT,
    COUPLED,
    DAMPING,
    DIDT,
    DIRECTION,
    DRIVEN,
    FIRST_ROW,
    FIRST_TANGENT,
    FORCE,
    GAP,
    GEAR_DAMPING,
    LINK,
    MODE,
    MOST_ROWS,
    MU,
    NORMAL,
    OPEN,
    PARENT,
    POSITION,
    QDD,
    RATE_I,
    RATE_Q,
    RATE_V,
    RHS,
    ROW,
    ROWS,
    SECOND_TANGENT,
    STICKING,
    TARGET,
    TORQUE_I,
    TORQUE_Q,
    TORQUE_V,
    ContactArrays,
    ModelArrays,
    Q,
    R,
    S,
    Workspace,
    row_limit,
)
from dynsim.kernels.constraint.cone import BOTH_WAYS, CONE, CONE_ROOM, ONE_WAY, TANGENT, approach
from dynsim.kernels.constraint.rows import point_row, set_modes
from dynsim.kernels.constraint.shapes import shaped_rows
from dynsim.kernels.constraint.surface import contact_rows
from dynsim.kernels.constraint.unilateral import RESTITUTION as LAW_RESTITUTION
from dynsim.kernels.constraint.unilateral import (
    STATIC,
    STOP_CLOSED,
    UnilateralArrays,
    sliding_friction,
    stop_gap,
)
from dynsim.kernels.drive.law import drive_block
from dynsim.kernels.jit import integers, internal_kernel, reals
from dynsim.kernels.tree.joints import displace, normalise, read_positions
from dynsim.kernels.tree.sweep import forward_sweep

# A residual that is good enough, and one above which a solve counts as capped [m/s]; starts before it is.
GOOD, BAD = 1e-10, 1e-8
QUICK_ROUNDS, LAST_ROUNDS = 2, 12
# A gap that counts as closed: far above rounding [m].
MARGIN = 1e-10
# SteppingArrays.law
FRICTION_OF, RESTITUTION, GRIP, GRIP_AXIS = 0, 1, 2, 3
LAW_SIZE = 6
# SteppingArrays.found: largest residual [m/s], solves above BAD, largest penetration [m]; solves, and those that took
# more than the quick rounds; most of what steps have taken of the energy, or made (negative), at any time [J].
WORST, CAPPED, PENETRATION, SOLVES, LONG_SOLVES, TAKEN = 0, 1, 2, 3, 4, 5
FOUND_SIZE = 6
# SteppingArrays.before: rates at the start; rates of the velocity products; acceleration of the last step, and then of
# this one; what is applied at the start, without loads.
V_START, V_BIAS, ACCELERATION, APPLIED_THEN = 0, 1, 2, 3
# SteppingArrays.eliminated
FREE, PER, DIDT_THEN = 0, 1, 2
# SteppingArrays.energy
START, STOP = 0, 1
MECHANICAL, MAGNETIC = 0, 1


class SteppingArrays(NamedTuple):
    """What time stepping reads and writes beside ``Run``; p is the most rows that there can be."""

    theta: float
    law: np.ndarray  # (c, LAW_SIZE) friction, restitution, and friction along GRIP_AXIS per that across (1: isotropic)
    body: np.ndarray  # (n, BODY_SIZE) as that of the model, its ARMATURE with what is implicit
    linear: np.ndarray  # (na, BLOCK_SIZE)
    eliminated: np.ndarray  # (na, 3) i' − i at v' = v, what v' − v adds to it; di/dt at the start
    before: np.ndarray  # (4, n) see V_START and what follows it
    energy: np.ndarray  # (2, 2) at START and STOP of the step: MECHANICAL and MAGNETIC [J]
    rate: np.ndarray  # (2, p) row rates at the start and the end
    impulse: np.ndarray  # (p,) of the rows of candidate k at 3 k, then couplings: the next start
    f: np.ndarray  # (p,)
    b: np.ndarray  # (p,)
    mu: np.ndarray  # (p,)
    kind: np.ndarray  # (p,) int
    modes: np.ndarray  # (c,) int: OPEN, or STICKING for three rows
    motion: np.ndarray  # (c,) int: OPEN, SLIDING or STICKING at the end of the step
    told: np.ndarray  # (c,) int: that of the last accepted step; −1 before the first
    room: np.ndarray  # (CONE_ROOM, p, p)
    found: np.ndarray  # (FOUND_SIZE,)


def stepping_arrays(
    model: ModelArrays,
    contacts: ContactArrays,
    na: int,
    joint_rows: int,
    theta: float,
    unilateral: UnilateralArrays | None,
) -> SteppingArrays:
    """Allocate :class:`SteppingArrays`: friction of the contacts and the law's restitution; isotropic."""
    assert unilateral is not None, "time stepping is of the unilateral law"
    n, c = model.body.shape[0], contacts.link.shape[0]
    p = row_limit(c, joint_rows)
    law = np.zeros((c, LAW_SIZE))
    law[:, FRICTION_OF], law[:, GRIP], law[:, GRIP_AXIS] = contacts.point[:, MU], 1.0, 1.0
    law[:, RESTITUTION] = unilateral.law[:, LAW_RESTITUTION]
    return SteppingArrays(
        theta=float(theta),
        law=law,
        body=reals(model.body),
        linear=np.zeros((na, BLOCK_SIZE)),
        eliminated=np.zeros((na, 3)),
        before=np.zeros((4, n)),
        energy=np.full((2, 2), np.nan),
        rate=np.zeros((2, p)),
        impulse=np.zeros(p),
        f=np.zeros(p),
        b=np.zeros(p),
        mu=np.zeros(p),
        kind=integers(np.zeros(p)),
        modes=integers(np.full(c, -1)),
        motion=integers(np.full(c, OPEN)),
        told=integers(np.full(c, -1)),
        room=np.zeros((CONE_ROOM, p, p)),
        found=np.zeros(FOUND_SIZE),
    )


@internal_kernel
def moved(system, ws: Workspace, y, scale, out):
    """Positions of y moved by ``scale`` times the QDD column, into out; its other entries as in y."""
    layout = system.layout
    for j in range(y.shape[0]):
        out[j] = y[j]
    for i in range(ws.joints.shape[0]):
        ws.joints[i, QDD] *= scale
    if layout.extra == 0:
        for i in range(ws.joints.shape[0]):
            out[layout.q + i] += ws.joints[i, QDD]
    else:
        displace(system.model.compound, system.model, ws, out, layout.q)
        normalise(system.model.compound, system.model, out, layout.q)


@internal_kernel
def place_joints(system, ws: Workspace, y):
    """Positions of y into ``ws.joints``."""
    layout = system.layout
    if layout.extra > 0:
        read_positions(system.model.compound, system.model, y, layout.q, ws)
        return
    for i in range(ws.joints.shape[0]):
        ws.joints[i, Q] = y[layout.q + i]


@internal_kernel
def geometry(system, model: ModelArrays, s: SteppingArrays, ws: Workspace):
    """Poses, gaps and rows at the positions and rates in ``ws.joints``; tangents along and across the grip axis."""
    forward_sweep(model, ws, 1.0, 0.0, 1.0)
    contact_rows(model, system.contacts, system.unilateral, ws)
    shaped_rows(system.shapes, system.unilateral, model, system.contacts, ws)
    state = ws.contacts
    for k in range(state.shape[0]):
        i, nx, ny, nz = system.contacts.link[k, LINK], state[k, NORMAL], state[k, NORMAL + 1], state[k, NORMAL + 2]
        x, y, z = s.law[k, GRIP_AXIS], s.law[k, GRIP_AXIS + 1], s.law[k, GRIP_AXIS + 2]
        ax = ws.links[i, R] * x + ws.links[i, R + 1] * y + ws.links[i, R + 2] * z
        ay = ws.links[i, R + 3] * x + ws.links[i, R + 4] * y + ws.links[i, R + 5] * z
        az = ws.links[i, R + 6] * x + ws.links[i, R + 7] * y + ws.links[i, R + 8] * z
        across = ax * nx + ay * ny + az * nz
        ax, ay, az = ax - across * nx, ay - across * ny, az - across * nz
        length = math.sqrt(ax * ax + ay * ay + az * az)
        if not length > 1e-6:  # the axis is along the normal: any direction does
            ax, ay, az = (0.0, nz, -ny) if abs(nx) < 0.7 else (-nz, 0.0, nx)
            length = math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax / length, ay / length, az / length
        state[k, FIRST_TANGENT], state[k, FIRST_TANGENT + 1], state[k, FIRST_TANGENT + 2] = ax, ay, az
        state[k, SECOND_TANGENT] = ny * az - nz * ay
        state[k, SECOND_TANGENT + 1] = nz * ax - nx * az
        state[k, SECOND_TANGENT + 2] = nx * ay - ny * ax


@internal_kernel
def close_contacts(system, s: SteppingArrays, ws: Workspace):
    """Rows for the candidates whose gap is not open; the table of rows is rebuilt only when these change."""
    changed = close_stops(system.unilateral, ws)
    for k in range(ws.contacts.shape[0]):
        mode = STICKING if ws.contacts[k, GAP] <= MARGIN else OPEN
        if mode != s.modes[k]:
            changed = True
        s.modes[k] = mode
    if changed:
        set_modes(system.contacts, system.couplings, system.unilateral, ws, s.modes)
    return changed


@internal_kernel
def close_stops(unilateral: UnilateralArrays, ws: Workspace):
    """Close the joint stops whose gap is not open, open the others; True when one has changed."""
    table, changed = unilateral.stop_table, False
    for k in range(table.shape[0]):
        closed = 1 if stop_gap(unilateral, ws, k) <= MARGIN else 0
        changed = changed or closed != table[k, STOP_CLOSED]
        table[k, STOP_CLOSED] = closed
    return changed


@internal_kernel
def tangent_rows(system, s: SteppingArrays, ws: Workspace):
    """Rows of the closed candidates and the kinds of the contact problem; TARGET is the acceleration zero.

    The second tangent is scaled by GRIP, friction along the axis being that times friction across: the ellipse of
    admissible forces is a disc then, and slip opposes friction as the ellipse's normal does.
    """
    state, rows, active = ws.contacts, ws.rows, ws.active
    for r in range(ws.counts[COUPLED]):
        # Behind the couplings come joint stops.
        s.kind[r] = BOTH_WAYS if r < system.couplings.joint.shape[0] else ONE_WAY
        s.mu[r], rows[r, TARGET] = 0.0, 0.0
    for k in range(state.shape[0]):
        if active[k, MODE] != STICKING:
            continue
        first = active[k, FIRST_ROW]
        x, y, z = state[k, POSITION], state[k, POSITION + 1], state[k, POSITION + 2]
        for m in range(MOST_ROWS):
            r, d = first + m, NORMAL if m == 0 else FIRST_TANGENT if m == 1 else SECOND_TANGENT
            scale = s.law[k, GRIP] if m == 1 else 1.0
            dx, dy, dz = scale * state[k, d], scale * state[k, d + 1], scale * state[k, d + 2]
            point_row(rows, r, x, y, z, dx, dy, dz)
            rows[r, TARGET] = 0.0
            for j in range(6):
                rows[r, DIRECTION + j] = rows[r, ROW + j]
            s.kind[r] = CONE if m == 0 else TANGENT


@internal_kernel
def constraint_rates(model: ModelArrays, ws: Workspace, y, first, out):
    """J v of all rows, v from ``first`` on in y. A row's rate climbs from its link to the world."""
    rows, links, active = ws.rows, ws.links, ws.active
    for r in range(ws.counts[ROWS]):
        if r < ws.counts[COUPLED]:
            out[r] = rows[r, ROW] * y[first + active[r, BODY_A]] + rows[r, ROW + 1] * y[first + active[r, BODY_B]]
            continue
        a, b, c = rows[r, ROW], rows[r, ROW + 1], rows[r, ROW + 2]
        d, e, f = rows[r, ROW + 3], rows[r, ROW + 4], rows[r, ROW + 5]
        total, i = 0.0, active[r, BODY_A]
        while i >= 0:
            total += y[first + i] * (
                ((a * links[i, S] + b * links[i, S + 1]) + (c * links[i, S + 2] + d * links[i, S + 3]))
                + (e * links[i, S + 4] + f * links[i, S + 5])
            )
            i = model.tree[i, PARENT]
        out[r] = total


@internal_kernel
def implicit_drives(system, s: SteppingArrays, ws: Workspace, h):
    """Eliminate the currents: what is left of drives and damping to APPLIED and to the ARMATURE of ``s.body``.

    After ``drive`` at (q + h θ v, v, i, t + θ h). With Δ = v' − v: i' − i = a + c Δ, and the torque of x_θ is
    τ + ∂τ/∂i θ a + (∂τ/∂q h θ² + ∂τ/∂v θ + ∂τ/∂i θ c) Δ.
    """
    body, theta, joints, motors = system.model.body, s.theta, ws.joints, ws.motors
    for i in range(joints.shape[0]):
        s.body[i, ARMATURE] = body[i, ARMATURE] + h * theta * (body[i, DAMPING] + body[i, GEAR_DAMPING])
    for a in range(motors.shape[0]):
        j, linear = system.drives.table[a, DRIVEN], s.linear[a]
        drive_block(system.drives, ws, a, linear)
        free, per = 0.0, 0.0
        if system.drives.table[a, CIRCUIT] >= 0:
            scale = h / (1.0 - h * theta * linear[RATE_I])
            free = scale * motors[a, DIDT]
            per = scale * (linear[RATE_Q] * h * theta * theta + linear[RATE_V] * theta)
        s.eliminated[a, FREE], s.eliminated[a, PER], s.eliminated[a, DIDT_THEN] = free, per, motors[a, DIDT]
        joints[j, APPLIED] += linear[TORQUE_I] * theta * free
        slope = linear[TORQUE_Q] * h * theta * theta + linear[TORQUE_V] * theta + linear[TORQUE_I] * theta * per
        s.body[j, ARMATURE] -= h * slope


@internal_kernel
def friction_of(unilateral: UnilateralArrays, s: SteppingArrays, k, speed):
    """Coefficient of friction of candidate k in a step that begins at this speed of slip."""
    if speed <= BAD:
        return unilateral.law[k, STATIC]
    return sliding_friction(unilateral.law, k, s.law[k, FRICTION_OF], speed)


@internal_kernel
def slip_of_rates(s: SteppingArrays, k, x, y):
    """Slip of candidate k from the rates x, y of its tangents [m/s]."""
    x = x / s.law[k, GRIP] if s.law[k, GRIP] > 0.0 else 0.0
    return math.sqrt(x * x + y * y)


@internal_kernel
def solve_contacts(unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, h):
    """Impulses of all rows, by the last ones as a start; their mean forces into ``ws.rows``. Returns the residual."""
    p, coupled, rows = ws.counts[ROWS], ws.counts[COUPLED], ws.rows
    last = 3 * ws.contacts.shape[0]
    for r in range(p):
        # RHS = − J M⁻¹ (applied − bias), TARGET being zero.
        s.b[r] = s.rate[0, r] - h * rows[r, RHS]
        s.f[r] = s.impulse[last + r] if r < coupled else 0.0
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, MODE] == STICKING:
            r = ws.active[k, FIRST_ROW]
            s.b[r] += s.law[k, RESTITUTION] * min(s.rate[0, r], 0.0)
            s.mu[r] = friction_of(unilateral, s, k, slip_of_rates(s, k, s.rate[0, r + 1], s.rate[0, r + 2]))
            for m in range(MOST_ROWS):
                s.f[r + m] = s.impulse[3 * k + m]
    residual = approach(ws.small[0], s.b, s.kind, s.mu, p, s.f, s.room, GOOD, QUICK_ROUNDS)
    s.found[SOLVES] += 1.0
    if not residual <= BAD:
        s.found[LONG_SOLVES] += 1.0
        residual = approach(ws.small[0], s.b, s.kind, s.mu, p, s.f, s.room, GOOD, LAST_ROUNDS)
    if not residual <= BAD:
        s.found[CAPPED] += 1.0
    s.found[WORST] = max(s.found[WORST], residual)
    for r in range(p):
        rows[r, FORCE] = s.f[r] / h
        if r < coupled:
            s.impulse[last + r] = s.f[r]
    for k in range(ws.contacts.shape[0]):
        closed, r = ws.active[k, MODE] == STICKING, ws.active[k, FIRST_ROW]
        for m in range(MOST_ROWS):
            s.impulse[3 * k + m] = s.f[r + m] if closed else 0.0
    return residual
