"""Compliant rows in time stepping: springs and dampers of contacts, and ties between bodies.

A spring k and a damper c on a row whose motion is x, and whose rates are u at the start and u' at the end of a step:

    f = −k x_φ − c u_φ,    u_φ = u + φ (u' − u),    x_φ = x + φ h u_φ

With K = φ h k + c its impulse p = h f makes a row of the contact problem with compliance ε, bounded or one-sided:

    u' + a + ε p = 0,    ε = 1/(h φ K),    a = (k x + (1 − φ) K u)/(φ K)

φ is the θ of the step if the step resolves the spring, z = h² k w ≤ 1 with the mobility w of the row. For a stiffer
spring φ = ½ would give an oscillation with the factor −1 per step and throw landing bodies off. There 1 − φ falls with
1/z, and K gets an additional damping that grows to 2 h k; its work counts as discretisation energy. In the limit the
row is rigid, and half of its depth is removed in each step.

The energy stored in springs and the loss in dampers are integrated with the state. A tie yields at its bound: its rest
position moves, so that the spring force stays at the bound.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import problem as kc
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.spatial import (
    ZERO_VECTOR,
    compose,
    cross,
    dot_vector,
    first_axis,
    put_rotation,
    put_six,
    put_vector,
    rotate,
    rotate_back,
    rotation,
    second_axis,
    third_axis,
    times_number,
    transform,
    vector,
    wrench_at,
)
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import internal_kernel

# A force is at its bound when less than this share of it is missing.
AT_BOUND = 1e-12
# Time in which unresolved springs return to their rest, in steps.
RETURN_STEPS = 2.0
# ε of the tangents of a contact that gives way, in mobilities of theirs: a spring 1/(h² ε) that no step resolves, some
# 1e9 N/m where it holds a kilogram.
TANGENTIAL = 1e-4
# How often the first step of a run is solved again with tangential impulses of its own as those of the last step.
MOST_LOADED = 30


@internal_kernel
def give_way(k, c, w, x, u, h, theta):
    """φ, compliance ε and what is added to the end rate, a, of a row with mobility w that is at x with rate u."""
    resolved = 1.0 / max(1.0, h * h * k * w)
    phi = 1.0 - (1.0 - theta) * resolved
    K = phi * h * k + c + (1.0 - resolved) * RETURN_STEPS * h * k
    return phi, 1.0 / (h * phi * K), (k * x + (1.0 - phi) * K * u) / (phi * K)


@internal_kernel
def soften_contact(law, s: SteppingArrays, ws: Workspace, k, h):
    """Let the rows of candidate k, which is listed, give way, if they do; into W, ``s.b`` and ``s.turn``.

    Tangents against the impulses of the last step, ``s.f``: u' + a + ε (p − p_last) = 0 where it sticks. Rigid, nearly
    straight chains of wheels would wedge themselves in: lateral forces of hundreds of newtons from rates of 1e-8 m/s.
    """
    stiffness, damping = law[k, ka.CONTACT_STIFFNESS], law[k, ka.CONTACT_DAMPING]
    if stiffness == 0.0:
        return
    r, turn, W = ws.active[k, ka.FIRST_ROW], s.turn[k], ws.small[0]
    turn[kt.PRESSED_IN] = ws.contacts[k, ka.GAP] - 0.5 * h * s.rate[0, r]
    s.statistics[kt.STIFFEST] = max(s.statistics[kt.STIFFEST], stiffness * W[r, r])
    phi, more, added = give_way(stiffness, damping, W[r, r], turn[kt.PRESSED_IN], s.rate[0, r], h, s.theta)
    W[r, r] += more
    turn[kt.IMPLICIT], turn[kt.ADDED] = phi, added
    for i in range(r + 1, r + ka.MOST_ROWS):
        more = TANGENTIAL * W[i, i]
        W[i, i] += more
        s.b[i] -= more * s.f[i]


@internal_kernel
def load_tangents(law, s: SteppingArrays, ws: Workspace):
    """Take tangential impulses of compliant contacts as those of the last step; True if the law changes by that.

    A start has no last step. With p_last = 0 all of its static friction would first have to deflect the tangents, which
    lets a body that rests accelerate by ε p/h. What the tangents carry at a start they have carried before.
    """
    changes = False
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] != ka.STICKING or law[k, ka.CONTACT_STIFFNESS] == 0.0:
            continue
        for m in range(1, ka.MOST_ROWS):
            i = ws.active[k, ka.FIRST_ROW] + m
            # W has ε already.
            more = TANGENTIAL / (1.0 + TANGENTIAL) * ws.small[0, i, i] * (s.f[i] - s.impulse[3 * k + m])
            s.b[i] -= more
            s.impulse[3 * k + m] = s.f[i]
            changes = changes or abs(more) > kt.GOOD
    return changes


@internal_kernel
def spring_energy(stiffness, x):
    """½ k x² of what is pressed in by −x [J]."""
    return 0.5 * stiffness * min(x, 0.0) ** 2


@internal_kernel
def book_soft_contact(law, layout, s: SteppingArrays, ws: Workspace, k, work, y_new, h):
    """What the normal force of candidate k, whose work is ``work``, has stored and lost; the rest is the scheme's.

    Where there is no force the surface comes back by itself, and its damper takes all.
    """
    now, last, stiffness = s.memory[kt.NOW, k], s.memory[kt.LAST, k], law[k, ka.CONTACT_STIFFNESS]
    lost = last[kt.STORED]
    if now[kt.LISTED] == 1.0:
        r, turn = ws.active[k, ka.FIRST_ROW], s.turn[k]
        change = s.rate[1, r] - s.rate[0, r]
        now[kt.STORED] = spring_energy(stiffness, turn[kt.PRESSED_IN] + h * (s.rate[0, r] + s.theta * change))
        lost -= now[kt.STORED]
        if s.f[r] > 0.0:
            lost = h * law[k, ka.CONTACT_DAMPING] * (s.rate[0, r] + turn[kt.IMPLICIT] * change) ** 2
    book_spring(layout, now[kt.STORED] - last[kt.STORED], lost, work, y_new)


@internal_kernel
def book_spring(layout, stored, lost, work, y_new):
    """More energy in a spring, and what its damper takes, of the work −``work`` that both are given [J]."""
    y_new[layout.elastic + kst.STORED] += stored
    y_new[layout.elastic + kst.DAMPED] += lost
    y_new[layout.scheme] -= work + stored + lost
    y_new[layout.ledger + kst.CONSTRAINT] -= work


@internal_kernel
def list_ties(unilateral: UnilateralArrays, ws: Workspace):
    """Begin and end ties as their kinds say; True when one has changed. A rest that is NaN is where the bodies are."""
    table, tie, changed = unilateral.tie_table, unilateral.tie, False
    for k in range(table.shape[0]):
        holds = 1 if table[k, ku.TIE_KIND] >= 0 else 0
        if holds != table[k, ku.TIE_HOLDS]:
            table[k, ku.TIE_HOLDS], changed = holds, True
            if holds == 1:
                begin_tie(unilateral, ws, k)
                tie[k, ku.TIE_TURNED] = tie_deflection(unilateral, ws, k)
                x = tie[k, ku.TIE_TURNED] - tie[k, ku.TIE_REST]
                tie[k, ku.TIE_STORED], tie[k, ku.TIE_GIVEN] = 0.5 * tie[k, ku.TIE_STIFFNESS] * x * x, 0.0
                if table[k, ku.TIE_KIND] == kc.ONE_WAY:
                    tie[k, ku.TIE_STORED] = spring_energy(tie[k, ku.TIE_STIFFNESS], x)
    return changed


@internal_kernel
def begin_tie(unilateral: UnilateralArrays, ws: Workspace, k):
    """The rest of tie k where it is NaN: as its bodies are now."""
    table, tie = unilateral.tie_table, unilateral.tie
    if tie[k, ku.TIE_REST] == tie[k, ku.TIE_REST]:
        return
    if table[k, ku.TIE_TURNS] == 1:
        put_rotation(tie, k, ku.TIE_ATTITUDE, relative_attitude(ws, table[k, ku.TIE_A], table[k, ku.TIE_B]))
        tie[k, ku.TIE_REST] = 0.0
    else:
        tie[k, ku.TIE_REST] = tie_deflection(unilateral, ws, k)


@internal_kernel
def axes_of(ws: Workspace, b):
    """Rotation of body b, or of the world, −1."""
    if b < 0:
        return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    return rotation(ws.links, b, ka.R)


@internal_kernel
def origin_of(ws: Workspace, b):
    """Origin of body b, or of the world, −1."""
    if b < 0:
        return ZERO_VECTOR
    return vector(ws.links, b, ka.P)


@internal_kernel
def relative_attitude(ws: Workspace, a, b):
    """Rotation of body b in the axes of body a."""
    A, B = rotation(ws.links, a, ka.R), axes_of(ws, b)
    x, y, z = rotate_back(A, first_axis(B)), rotate_back(A, second_axis(B)), rotate_back(A, third_axis(B))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@internal_kernel
def tie_deflection(unilateral: UnilateralArrays, ws: Workspace, k):
    """How far A of tie k is before B along the axis, or turned about it, of the rotation vector [m or rad]."""
    table, tie = unilateral.tie_table, unilateral.tie
    a, b, axis = table[k, ku.TIE_A], table[k, ku.TIE_B], vector(tie, k, ku.TIE_AXIS)
    if table[k, ku.TIE_TURNS] == 1:
        return -dot_vector(axis, tie_turn(unilateral, ws, k))
    A = rotation(ws.links, a, ka.R)
    at = transform(vector(ws.links, a, ka.P), A, vector(tie, k, ku.TIE_POINT))
    other = transform(origin_of(ws, b), axes_of(ws, b), vector(tie, k, ku.TIE_OTHER_POINT))
    return dot_vector(rotate(A, axis), (at[0] - other[0], at[1] - other[1], at[2] - other[2]))


@internal_kernel
def tie_turn(unilateral: UnilateralArrays, ws: Workspace, k):
    """Rotation vector of B against A since tie k began, in the axes of A, at most half a turn long [rad]."""
    table, R = unilateral.tie_table, rotation(unilateral.tie, k, ku.TIE_ATTITUDE)
    E = compose(
        relative_attitude(ws, table[k, ku.TIE_A], table[k, ku.TIE_B]),
        (R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]),
    )
    twice = E[7] - E[5], E[2] - E[6], E[3] - E[1]
    sine = 0.5 * math.sqrt(dot_vector(twice, twice))
    angle = math.atan2(sine, 0.5 * (E[0] + E[4] + E[8] - 1.0))
    return times_number(twice, 0.5 * (angle / sine if sine > 1e-9 else 1.0))


@internal_kernel
def turning_axis(axis, turn):
    """Direction along which angular velocity changes the part along an axis of a rotation vector, which is ``turn``.

    With the rotation vector φ it is a + ½ φ × a + c φ × (φ × a), c = 1/φ² − (1 + cos φ)/(2 φ sin φ): the axis itself
    if the bodies turn about it alone. A torque along the axis would not be the gradient of ½ k x² otherwise, and turns
    to and fro would make energy.
    """
    square = dot_vector(turn, turn)
    size = math.sqrt(square)
    c = 1.0 / 12.0 + square / 720.0
    if size > 1e-2:
        half = 0.5 * size
        c = (1.0 - half * math.cos(half) / math.sin(half)) / square
    once = cross(turn, axis)
    again = cross(turn, once)
    return (
        axis[0] + 0.5 * once[0] + c * again[0],
        axis[1] + 0.5 * once[1] + c * again[1],
        axis[2] + 0.5 * once[2] + c * again[2],
    )


@internal_kernel
def place_ties(unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace):
    """Rows of the ties that hold, at the geometry of the sweep: the motion of A against B at the point of B."""
    table, tie, rows = unilateral.tie_table, unilateral.tie, ws.rows
    for k in range(table.shape[0]):
        if table[k, ku.TIE_HOLDS] == 0:
            continue
        r, b, axis = table[k, ku.TIE_ROW], table[k, ku.TIE_B], vector(tie, k, ku.TIE_AXIS)
        A = rotation(ws.links, table[k, ku.TIE_A], ka.R)
        if table[k, ku.TIE_TURNS] == 1:
            turn = tie_turn(unilateral, ws, k)
            put_vector(rows, r, ka.ROW, rotate(A, turning_axis(axis, turn)))
            put_vector(rows, r, ka.ROW + 3, ZERO_VECTOR)
            x = -dot_vector(axis, turn)
            # Rotation vectors are at most half a turn long and go on at the other side; the rest goes with them.
            if abs(x - tie[k, ku.TIE_TURNED]) > math.pi:
                tie[k, ku.TIE_REST] += math.copysign(2.0 * math.pi, x - tie[k, ku.TIE_TURNED])
            tie[k, ku.TIE_TURNED] = x
        else:
            at = transform(origin_of(ws, b), axes_of(ws, b), vector(tie, k, ku.TIE_OTHER_POINT))
            put_six(rows, r, ka.ROW, wrench_at(at, rotate(A, axis), ZERO_VECTOR))
            x = tie_deflection(unilateral, ws, k)
        for j in range(6):
            rows[r, ka.DIRECTION + j] = rows[r, ka.ROW + j]
        rows[r, ka.TARGET], s.kind[r] = 0.0, table[k, ku.TIE_KIND]
        tie[k, ku.TIE_AT] = x - tie[k, ku.TIE_REST]


@internal_kernel
def soften_ties(unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, h):
    """Let the rows of ties give way, within their bounds; starts from their last impulses."""
    table, tie, W = unilateral.tie_table, unilateral.tie, ws.small[0]
    for k in range(table.shape[0]):
        if table[k, ku.TIE_HOLDS] == 0:
            continue
        r = table[k, ku.TIE_ROW]
        s.mu[r], s.f[r] = h * tie[k, ku.TIE_BOUND], h * tie[k, ku.TIE_FORCE]
        tie[k, ku.TIE_AT] -= 0.5 * h * s.rate[0, r]
        s.statistics[kt.STIFFEST] = max(s.statistics[kt.STIFFEST], tie[k, ku.TIE_STIFFNESS] * W[r, r])
        tie[k, ku.TIE_IMPLICIT], more, added = give_way(
            tie[k, ku.TIE_STIFFNESS], tie[k, ku.TIE_DAMPING], W[r, r], tie[k, ku.TIE_AT], s.rate[0, r], h, s.theta
        )
        W[r, r] += more
        s.right[r] += added


@internal_kernel
def book_ties(unilateral: UnilateralArrays, layout, s: SteppingArrays, ws: Workspace, y_new, h):
    """What ties have stored and lost, and where their rests are, should the step be accepted."""
    table, tie = unilateral.tie_table, unilateral.tie
    for k in range(table.shape[0]):
        row, stored = tie[k], tie[k, ku.TIE_STORED]
        row[ku.TIE_FORCE], row[ku.TIE_REST_NOW], row[ku.TIE_STORED_NOW] = 0.0, row[ku.TIE_REST], 0.0
        if table[k, ku.TIE_HOLDS] == 0:
            book_spring(layout, -stored, stored, 0.0, y_new)
            continue
        r, one_sided = table[k, ku.TIE_ROW], table[k, ku.TIE_KIND] == kc.ONE_WAY
        force, change = ws.rows[r, ka.FORCE], s.rate[1, r] - s.rate[0, r]
        x = row[ku.TIE_AT] + h * (s.rate[0, r] + s.theta * change)
        at_bound = force == 0.0 if one_sided else abs(force) >= row[ku.TIE_BOUND] * (1.0 - AT_BOUND)
        if at_bound and not one_sided:
            most = row[ku.TIE_BOUND] / row[ku.TIE_STIFFNESS] if row[ku.TIE_STIFFNESS] > 0.0 else 0.0
            kept = min(max(x, -most), most)
            row[ku.TIE_REST_NOW] += x - kept
            x = kept
        if one_sided:
            x = min(x, 0.0)
        row[ku.TIE_FORCE], row[ku.TIE_STORED_NOW] = force, 0.5 * row[ku.TIE_STIFFNESS] * x * x
        work = 0.5 * h * force * (s.rate[0, r] + s.rate[1, r])
        lost = h * row[ku.TIE_DAMPING] * (s.rate[0, r] + row[ku.TIE_IMPLICIT] * change) ** 2
        if at_bound:
            lost = stored - row[ku.TIE_STORED_NOW] - work
        book_spring(layout, row[ku.TIE_STORED_NOW] - stored, lost, work, y_new)


@internal_kernel
def accept_ties(unilateral: UnilateralArrays):
    """The step has been accepted: rests and energies are those of its end."""
    for k in range(unilateral.tie.shape[0]):
        tie = unilateral.tie[k]
        tie[ku.TIE_GIVEN] += abs(tie[ku.TIE_REST_NOW] - tie[ku.TIE_REST])
        tie[ku.TIE_REST], tie[ku.TIE_STORED] = tie[ku.TIE_REST_NOW], tie[ku.TIE_STORED_NOW]
