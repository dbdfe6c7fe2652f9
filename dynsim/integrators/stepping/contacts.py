"""Contact law of time stepping: Coulomb's law for the rates at the end of a step, with the rows at the end.

The rows J of a step belong to its midpoint. On a surface of curvature κ, the law J(q_m) v' = 0 would remove the energy
½ m (h κ v²)² in each step from a body that only follows the surface. The rows at the end are therefore extrapolated,
without another sweep. With the same rates v, the rows of this step give r = J_k v, and the rows of the last step give
s = J_{k−1} v, so that J(q') v' = J_k v' + c h/(h + h_last) up to O(h²), with c = r − s. The law is applied to

    w = J_k v' + a,    a = c h/(h + h_last),    0 ≤ p_n ⟂ w_n ≥ 0,  |p_t| ≤ μ p_n,  w_t = −λ p_t

W = J M⁻¹ Jᵀ remains symmetric, and each step solves one contact problem. For a contact that slides and cannot stop
within the step, friction is along the mean slip: w_t = u_t + u_t'. A contact that lands has no earlier rows: a = 0, or
a = e u_n by Newton's restitution, unless restitution and friction together would create energy. The penetration is
removed slowly, and only to the extent that the energy lost in the landing allows; a joint that has passed its stop is
moved back in the same way.

A law for mean rates, J (v + v') = 0, would be simpler, but it multiplies disturbances by −1, so that rates alternate
undamped.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import distance as kd
from dynsim.dynamics.contact import solids as ks
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.cone.steps import motion
from dynsim.dynamics.contact.mobility import moves_along_normal
from dynsim.dynamics.contact.rows import point_row, set_modes
from dynsim.dynamics.contact.solids import remember_pairs
from dynsim.dynamics.contact.unilateral import UnilateralArrays, dry_bound, sliding_friction, stop_gap
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    ZERO_VECTOR,
    compose,
    cross,
    dot_vector,
    first_axis,
    minus_scaled,
    point_velocity,
    put_rotation,
    put_six,
    put_vector,
    rotate,
    rotate_back,
    rotation,
    second_axis,
    six,
    third_axis,
    times_number,
    transform,
    vector,
    wrench_at,
)
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.articulated_contacts import begin_articulated, begin_search, solve_articulated
from dynsim.integrators.stepping.islands import find_islands, solve_problem
from dynsim.integrators.stepping.tables import SteppingArrays, geometry, place_state
from dynsim.jit.kernel import internal_kernel

# Compliant rows of time stepping: springs and dampers of contacts, and ties between bodies.


# A force counts as at its bound if it differs from the bound by less than this fraction.
AT_BOUND = 1e-12
# Number of steps in which springs that the step size does not resolve return to rest.
COMPLIANT_RETURN_STEPS = 2.0
# ε of the tangents of a compliant contact, as a multiple of their mobility. It corresponds to a spring 1/(h² ε) that no
# step resolves, of about 1e9 N/m if it holds one kilogram.
TANGENTIAL = 1e-4
# Maximum number of times that the first step of a run is solved again with its tangential impulses as the impulses of
# the last step.
MOST_LOADED = 30


@internal_kernel
def compliant_row(k, c, w, x, u, h, theta):
    """Return φ, the compliance ε, and the addition a to the end rate for a row with mobility w at x with rate u."""
    resolved = 1.0 / max(1.0, h * h * k * w)
    phi = 1.0 - (1.0 - theta) * resolved
    K = phi * h * k + c + (1.0 - resolved) * COMPLIANT_RETURN_STEPS * h * k
    return phi, 1.0 / (h * phi * K), (k * x + (1.0 - phi) * K * u) / (phi * K)


@internal_kernel
def soften_contact(law, s: SteppingArrays, ws: Workspace, k, h):
    """Add the compliance of listed candidate k, if it has any, to its rows in W, ``s.b`` and ``s.turn``.

    The tangents are relative to the impulses of the last step, ``s.f``: u' + a + ε (p − p_last) = 0 if the contact
    sticks. If the tangents were rigid, nearly straight chains of wheels would jam, with lateral forces of hundreds of
    newtons from rates of 1e-8 m/s.
    """
    stiffness, damping = law[k, ka.CONTACT_STIFFNESS], law[k, ka.CONTACT_DAMPING]
    if stiffness == 0.0:
        return
    r, turn, W = ws.active[k, ka.FIRST_ROW], s.turn[k], ws.small[0]
    turn[kt.PRESSED_IN] = ws.contacts[k, ka.GAP] - 0.5 * h * s.rate[0, r]
    s.statistics[kt.STIFFEST] = max(s.statistics[kt.STIFFEST], stiffness * W[r, r])
    phi, more, added = compliant_row(stiffness, damping, W[r, r], turn[kt.PRESSED_IN], s.rate[0, r], h, s.theta)
    W[r, r] += more
    turn[kt.IMPLICIT], turn[kt.ADDED] = phi, added
    for i in range(r + 1, r + ka.MOST_ROWS):
        more = TANGENTIAL * W[i, i]
        W[i, i] += more
        s.b[i] -= more * s.f[i]


@internal_kernel
def load_tangents(law, s: SteppingArrays, ws: Workspace):
    """Use the tangential impulses of compliant contacts as those of the last step; return whether this changes the law.

    At a start, no last step exists. With p_last = 0, all static friction would first have to deflect the tangents, so
    that a body at rest would accelerate by ε p/h. The loads of the tangents at a start are therefore assumed to have
    acted before.
    """
    changes = False
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] != ka.STICKING or law[k, ka.CONTACT_STIFFNESS] == 0.0:
            continue
        for m in range(1, ka.MOST_ROWS):
            i = ws.active[k, ka.FIRST_ROW] + m
            # W already includes ε.
            more = TANGENTIAL / (1.0 + TANGENTIAL) * ws.small[0, i, i] * (s.f[i] - s.impulse[3 * k + m])
            s.b[i] -= more
            s.impulse[3 * k + m] = s.f[i]
            changes = changes or abs(more) > kt.GOOD
    return changes


@internal_kernel
def spring_energy(stiffness, x):
    """Return the energy ½ k x² of a one-sided spring that is compressed by −x [J]."""
    return 0.5 * stiffness * min(x, 0.0) ** 2


@internal_kernel
def book_soft_contact(law, layout, s: SteppingArrays, ws: Workspace, k, work, y_new, h):
    """Record the energy stored and lost by the normal force of candidate k, whose work is ``work``.

    The remainder is counted as scheme energy. Without a force, the surface recovers by itself, and its damper absorbs
    all of its energy.
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
    """Record the energy ``stored`` in a spring and ``lost`` in its damper, which together receive −``work`` [J]."""
    y_new[layout.elastic + kst.STORED] += stored
    y_new[layout.elastic + kst.DAMPED] += lost
    y_new[layout.scheme] -= work + stored + lost
    y_new[layout.ledger + kst.CONSTRAINT] -= work


@internal_kernel
def list_ties(unilateral: UnilateralArrays, ws: Workspace):
    """Start and end ties according to their kinds; return whether any has changed.

    A rest value of NaN is set to the present pose.
    """
    table, tie, changed = unilateral.tie_table, unilateral.tie, False
    for k in range(table.shape[0]):
        holds = 1 if table[k, ku.TIE_KIND] >= 0 else 0
        if holds != table[k, ku.TIE_HOLDS]:
            table[k, ku.TIE_HOLDS], changed = holds, True
            if holds == 1:
                begin_tie(unilateral, ws, k)
                tie[k, ku.TIE_TURNED] = tie_deflection(unilateral, ws, k)
                x = tie[k, ku.TIE_TURNED] - tie[k, ku.TIE_REST]
                x = min(x, 0.0) if table[k, ku.TIE_KIND] == kc.ONE_WAY else x
                tie[k, ku.TIE_STORED], tie[k, ku.TIE_GIVEN] = 0.5 * tie[k, ku.TIE_STIFFNESS] * x * x, 0.0
    return changed


@internal_kernel
def begin_tie(unilateral: UnilateralArrays, ws: Workspace, k):
    """Set the rest value of tie k, if it is NaN, to the present pose of its bodies."""
    table, tie = unilateral.tie_table, unilateral.tie
    if tie[k, ku.TIE_REST] == tie[k, ku.TIE_REST]:
        return
    if table[k, ku.TIE_TURNS] == 1:
        put_rotation(tie, k, ku.TIE_ATTITUDE, relative_attitude(ws, table[k, ku.TIE_A], table[k, ku.TIE_B]))
        tie[k, ku.TIE_REST] = 0.0
    else:
        tie[k, ku.TIE_REST] = tie_deflection(unilateral, ws, k)


@internal_kernel
def pose_of(ws: Workspace, b):
    """Return origin and rotation of body b, or of the world, −1."""
    if b < 0:
        return ZERO_VECTOR, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return vector(ws.links, b, ka.P), rotation(ws.links, b, ka.R)


@internal_kernel
def relative_attitude(ws: Workspace, a, b):
    """Return the rotation of body b in the axes of body a."""
    A, (_, B) = rotation(ws.links, a, ka.R), pose_of(ws, b)
    x, y, z = rotate_back(A, first_axis(B)), rotate_back(A, second_axis(B)), rotate_back(A, third_axis(B))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@internal_kernel
def tie_deflection(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the deflection of tie k: displacement of A from B along the axis, or rotation about it [m or rad]."""
    table, tie = unilateral.tie_table, unilateral.tie
    a, b, axis = table[k, ku.TIE_A], table[k, ku.TIE_B], vector(tie, k, ku.TIE_AXIS)
    if table[k, ku.TIE_TURNS] == 1:
        return -dot_vector(axis, tie_turn(unilateral, ws, k))
    A = rotation(ws.links, a, ka.R)
    at = transform(vector(ws.links, a, ka.P), A, vector(tie, k, ku.TIE_POINT))
    origin, axes = pose_of(ws, b)
    other = transform(origin, axes, vector(tie, k, ku.TIE_OTHER_POINT))
    return dot_vector(rotate(A, axis), (at[0] - other[0], at[1] - other[1], at[2] - other[2]))


@internal_kernel
def tie_turn(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the rotation vector of B relative to A since tie k began, in the axes of A, at most half a turn [rad]."""
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
    """Return the direction along which angular velocity changes the ``axis`` component of rotation vector ``turn``.

    With the rotation vector φ and the axis a, the direction is a + ½ φ × a + c φ × (φ × a) with
    c = 1/φ² − (1 + cos φ)/(2 φ sin φ), which is the axis itself if the bodies only turn about it. Otherwise, a torque
    along the axis would not be the gradient of ½ k x², and turning back and forth would create energy.
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
    """Write the rows of active ties at the poses of the sweep: the motion of A relative to B at the point of B."""
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
            # Rotation vectors are at most half a turn long and then jump to the opposite side; so must the rest angle.
            if abs(x - tie[k, ku.TIE_TURNED]) > math.pi:
                tie[k, ku.TIE_REST] += math.copysign(2.0 * math.pi, x - tie[k, ku.TIE_TURNED])
            tie[k, ku.TIE_TURNED] = x
        else:
            origin, axes = pose_of(ws, b)
            at = transform(origin, axes, vector(tie, k, ku.TIE_OTHER_POINT))
            put_six(rows, r, ka.ROW, wrench_at(at, rotate(A, axis), ZERO_VECTOR))
            x = tie_deflection(unilateral, ws, k)
        put_six(rows, r, ka.DIRECTION, six(rows, r, ka.ROW))
        rows[r, ka.TARGET], s.kind[r] = 0.0, table[k, ku.TIE_KIND]
        tie[k, ku.TIE_AT] = x - tie[k, ku.TIE_REST]


@internal_kernel
def damping_of_tie(unilateral: UnilateralArrays, k):
    """Return the damping of tie k in this step: none if the tie only pushes and is open at the start of the step."""
    is_open = unilateral.tie_table[k, ku.TIE_KIND] == kc.ONE_WAY and unilateral.tie[k, ku.TIE_AT] > 0.0
    return 0.0 if is_open else unilateral.tie[k, ku.TIE_DAMPING]


@internal_kernel
def soften_ties(unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, h):
    """Add the compliance of ties to their rows, set their bounds, and start from their last impulses."""
    table, tie, W = unilateral.tie_table, unilateral.tie, ws.small[0]
    for k in range(table.shape[0]):
        if table[k, ku.TIE_HOLDS] == 0:
            continue
        r = table[k, ku.TIE_ROW]
        s.mu[r], s.f[r] = h * tie[k, ku.TIE_BOUND], h * tie[k, ku.TIE_FORCE]
        tie[k, ku.TIE_AT] -= 0.5 * h * s.rate[0, r]
        s.statistics[kt.STIFFEST] = max(s.statistics[kt.STIFFEST], tie[k, ku.TIE_STIFFNESS] * W[r, r])
        stiffness, damping = tie[k, ku.TIE_STIFFNESS], damping_of_tie(unilateral, k)
        tie[k, ku.TIE_IMPLICIT], more, added = compliant_row(
            stiffness, damping, W[r, r], tie[k, ku.TIE_AT], s.rate[0, r], h, s.theta
        )
        W[r, r] += more
        s.right[r] += added


@internal_kernel
def book_ties(unilateral: UnilateralArrays, layout, s: SteppingArrays, ws: Workspace, y_new, h):
    """Record the energy stored and lost by ties, and compute their rest values in case the step is accepted."""
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
        lost = h * damping_of_tie(unilateral, k) * (s.rate[0, r] + row[ku.TIE_IMPLICIT] * change) ** 2
        if at_bound:
            lost = stored - row[ku.TIE_STORED_NOW] - work
        book_spring(layout, row[ku.TIE_STORED_NOW] - stored, lost, work, y_new)


@internal_kernel
def accept_ties(unilateral: UnilateralArrays):
    """Accept the rest values and energies of ties at the end of the step."""
    for k in range(unilateral.tie.shape[0]):
        tie = unilateral.tie[k]
        tie[ku.TIE_GIVEN] += abs(tie[ku.TIE_REST_NOW] - tie[ku.TIE_REST])
        tie[ku.TIE_REST], tie[ku.TIE_STORED] = tie[ku.TIE_REST_NOW], tie[ku.TIE_STORED_NOW]


# Fraction of the energy transmitted by the rows of a step below which a gain is due to rounding; a restitution of 1 has
# no gain.
NO_GAIN = 1e-6
# cos of the largest angle by which a row may turn in a step; if it turns more, the contact has reached a kink, an edge
# or another point.
SAME_ROW = 0.95
# A contact point that has moved by more than the first value times the path of the body is a different point. If it has
# moved by less than the second value [m], which the body may have covered while reversing, it is the same point.
SAME_PLACE, SHORT_WAY = 4.0, 1e-4
# Distance from the end of an axis, as a fraction of its length, up to which a point counts as the end.
AT_END = 1e-9
# Gap up to which a point counts as touching when a run begins or its rates have jumped [m].
TOUCHES = 1e-9
# Gaps are closed, and penetrations removed, within RETURN_TIME [s] but at least RETURN_STEPS steps, and no faster than
# RETURN_SPEED [m/s]. With shorter times, contacts would bounce.
RETURN_TIME, RETURN_STEPS, RETURN_SPEED = 0.02, 10.0, 0.02
# Limit of each impulse times its mobility, as a multiple of the largest rate, if the impulses do not solve the problem.
MOST_UNSOLVED = 1e3
# Gaps of up to this multiple of h |a_n| are due to oscillations of the scheme and count as zero, because feedback on
# them would add energy.
SWAY = 2.0


@internal_kernel
def restart_memory(system, s: SteppingArrays, ws: Workspace, y):
    """Restart with the contacts that touch at y if the rates of y are not the rates at the end of the last step.

    The rows of these contacts at y, half a step before the midpoint, replace the rows of the last step; the change of
    turning rows then counts with the factor h/(h + 0). The function performs a sweep.
    """
    layout = system.layout
    if s.grid[kt.LENGTH_LAST] > 0.0 and not rates_jumped(s, y, layout.v):
        return
    s.grid[kt.LENGTH_LAST], s.grid[kt.HELD_STEPS], s.grid[kt.IMPACT_LAST] = 0.0, 0.0, 0.0
    place_state(system, ws, y)
    for i in range(s.before.shape[1]):
        ws.joints[i, ka.QDD] = 0.0
    for a in range(s.torque.shape[0]):
        s.torque[a] = math.nan
    geometry(system, system.model, ws)
    remember_pairs(system.shapes.pairs)
    for k in range(ws.contacts.shape[0]):
        last, state = s.memory[kt.LAST, k], ws.contacts[k]
        last[:] = 0.0
        if state[ka.GAP] > TOUCHES:
            continue
        note_place(system, state, k, last)
        last[kt.STORED] = spring_energy(system.contacts.law[k, ka.CONTACT_STIFFNESS], state[ka.GAP])
        at = vector(ws.contacts, k, ka.POSITION)
        v = point_velocity(relative_velocity(system, ws, k), at)
        for m in range(3):
            d = ka.NORMAL if m == 0 else ka.FIRST_TANGENT if m == 1 else ka.SECOND_TANGENT
            last[kt.END_RATE + m] = dot_vector(v, vector(ws.contacts, k, d))
        last[kt.END_RATE + 1] *= system.contacts.law[k, ka.GRIP]
        if last[kt.END_RATE] >= -kt.BAD:
            slip = slip_of_rates(system.contacts.law, k, last[kt.END_RATE + 1], last[kt.END_RATE + 2])
            last[kt.LISTED], last[kt.CLOSED], last[kt.SLID] = 1.0, 1.0, 1.0 if slip > kt.BAD else 0.0


@internal_kernel
def relative_velocity(system, ws: Workspace, k):
    """Return the spatial velocity of the body of candidate k relative to the carrier of its surface."""
    V, carrier = six(ws.links, system.contacts.link[k, ka.LINK], ka.V), system.contacts.link[k, ka.CARRIER]
    return minus_scaled(V, six(ws.links, carrier, ka.V), 1.0) if carrier >= 0 else V


@internal_kernel
def rates_jumped(s: SteppingArrays, y, first):
    """Return whether the rates in y, from index ``first`` on, differ from those at the end of the last step."""
    jumped = False
    for i in range(s.before.shape[1]):
        jumped = jumped or s.before[kt.V_LAST, i] != y[first + i]
    return jumped


@internal_kernel
def note_place(system, state, k, note):
    """Record the directions and location of candidate k, so that the next step can recognise its rows."""
    for m in range(3):
        note[kt.NORMAL_THEN + m], note[kt.TANGENT_THEN + m] = state[ka.NORMAL + m], state[ka.FIRST_TANGENT + m]
    note[kt.CENTRE], note[kt.CENTRE + 1], note[kt.CENTRE + 2] = centre(system.shapes, state, k)


@internal_kernel
def remember(unilateral: UnilateralArrays, s: SteppingArrays, y, first, h):
    """Save the data of the accepted step, whose end rates are the rates of y."""
    accept_ties(unilateral)
    for i in range(s.before.shape[1]):
        s.before[kt.V_LAST, i] = y[first + i]
    for k in range(s.memory.shape[1]):
        for m in range(kt.MEMORY_SIZE):
            s.memory[kt.LAST, k, m] = s.memory[kt.NOW, k, m]
    if s.grid[kt.LENGTH_LAST] > 0.0:
        s.statistics[kt.HALF_STEP] += 0.5 * h * abs(s.grid[kt.POWER_NOW] - s.grid[kt.POWER_LAST])
    s.grid[kt.LENGTH_LAST], s.grid[kt.POWER_LAST] = h, s.grid[kt.POWER_NOW]


@internal_kernel
def list_contacts(system, s: SteppingArrays, ws: Workspace, h):
    """Mark the candidates that touch; if they change, rebuild the table of rows and return True.

    A closed contact stays listed while its contact point remains the same, because the midpoint of a step over a convex
    surface is above the surface.
    """
    stops, ties = close_stops(system.model, system.unilateral, ws), list_ties(system.unilateral, ws)
    changed = stops or ties
    for k in range(ws.contacts.shape[0]):
        last = s.memory[kt.LAST, k]
        known = last[kt.LISTED] == 1.0 and is_same_contact(system, last, ws, k, h)
        s.turn[k, kt.KNOWN] = 1.0 if known else 0.0
        listed = ws.contacts[k, ka.GAP] <= kt.MARGIN or (known and last[kt.CLOSED] == 1.0)
        listed = listed and not at_axis_end(system, ws, k)
        # The depth does not matter, because it is removed slowly.
        listed = listed and moves_along_normal(system.model, system.contacts, ws, k, 0.0)
        mode = ka.STICKING if listed else ka.OPEN
        changed = changed or mode != s.modes[k]
        s.modes[k] = mode
    if changed:
        set_modes(system.contacts, system.couplings, system.unilateral, ws, s.modes)
        find_islands(system.model, system.shapes.pairs, s, ws)
    return changed


@internal_kernel
def at_axis_end(system, ws: Workspace, k):
    """Return whether candidate k, the nearest point of an axis, is at an end, which has a separate candidate.

    The radius of candidate k is smaller, but points penetrate by more than this difference within a step, so that both
    candidates would carry load.
    """
    shapes = system.shapes
    if shapes is None:  # resolved at compile time
        return False
    if shapes.kind[k, kd.MOVES] == 0:
        return False
    i = system.contacts.link[k, ka.LINK]
    R = rotation(ws.links, i, ka.R)
    start = transform(vector(ws.links, i, ka.P), R, vector(system.contacts.point, k, ka.POINT))
    axis, at = rotate(R, vector(shapes.data, k, kd.D)), centre(shapes, ws.contacts[k], k)
    along, square = 0.0, dot_vector(axis, axis)
    for m in range(3):
        along += (at[m] - start[m]) * axis[m]
    return min(along, square - along) <= AT_END * square


@internal_kernel
def is_same_contact(system, last, ws: Workspace, k, h):
    """Return whether candidate k has turned its normal little and moved its contact point about as far as its body."""
    state, turned = ws.contacts[k], 0.0
    for m in range(3):
        turned += state[ka.NORMAL + m] * last[kt.NORMAL_THEN + m]
    if turned <= SAME_ROW:
        return False
    shapes = system.shapes
    if shapes is None:  # resolved at compile time
        return True
    if shapes.kind[k, kd.SURFACE] == kd.PAIR:
        return is_same_slot(shapes.pairs, shapes.kind[k, kd.FIELD], shapes.kind[k, kd.COUNT])
    if shapes.kind[k, kd.MOVES] == 0:
        return True
    # Its contact point may have jumped, e.g. from one end of a capsule to the other.
    at = centre(shapes, state, k)
    square = (at[0] - last[kt.CENTRE]) ** 2 + (at[1] - last[kt.CENTRE + 1]) ** 2 + (at[2] - last[kt.CENTRE + 2]) ** 2
    v = point_velocity(six(ws.links, system.contacts.link[k, ka.LINK], ka.V), at)
    fastest, carrier = dot_vector(v, v), system.contacts.link[k, ka.CARRIER]
    if carrier >= 0:
        v = point_velocity(six(ws.links, carrier, ka.V), at)
        fastest = max(fastest, dot_vector(v, v))
    return math.sqrt(square) <= SAME_PLACE * h * math.sqrt(fastest) + SHORT_WAY


@internal_kernel
def is_same_slot(pairs, m, j):
    """Return whether slot j of pair m contains the feature that it contained after the last step."""
    if pairs is None:
        return True
    return pairs.slots[m, j, ks.FEATURE] >= 0.0 and pairs.slots[m, j, ks.FEATURE] == pairs.known[m, j]


@internal_kernel
def centre(shapes, state, k):
    """Return the centre of the sphere with which candidate k touches [m]."""
    radius = 0.0
    if shapes is not None:
        radius = shapes.data[k, kd.RADIUS]
    return (
        state[ka.POSITION] + radius * state[ka.NORMAL],
        state[ka.POSITION + 1] + radius * state[ka.NORMAL + 1],
        state[ka.POSITION + 2] + radius * state[ka.NORMAL + 2],
    )


@internal_kernel
def close_stops(model: ModelArrays, unilateral: UnilateralArrays, ws: Workspace):
    """Close joint stops whose gap is not positive, and open the other stops; return whether any has changed.

    A closed brake carries the entire load of its joint, so that the stop carries no load.
    """
    table, changed = unilateral.stop_table, False
    for k in range(table.shape[0]):
        braked = model.body[table[k, ku.STOP_JOINT], ka.ARMATURE] >= ka.BRAKED
        closed = 1 if stop_gap(unilateral, ws, k) <= kt.MARGIN and not braked else 0
        changed = changed or closed != table[k, ku.STOP_CLOSED]
        table[k, ku.STOP_CLOSED] = closed
    return changed


@internal_kernel
def tangent_rows(system, s: SteppingArrays, ws: Workspace):
    """Write rows of the listed candidates and kinds of the contact problem; TARGET is the acceleration zero.

    The second tangent is scaled by GRIP, the ratio of friction along the axis to friction across: the ellipse of
    admissible forces becomes a disc, and slip opposes friction as the normal of the ellipse does.
    """
    state, rows, active = ws.contacts, ws.rows, ws.active
    for r in range(ws.counts[ka.COUPLED]):
        # Couplings are followed by joints with dry friction, then by joint stops.
        s.kind[r] = kc.BOTH_WAYS if r < system.couplings.joint.shape[0] else kc.ONE_WAY
        s.mu[r], rows[r, ka.TARGET] = 0.0, 0.0
    for k in range(system.unilateral.dry.shape[0]):
        s.kind[system.unilateral.dry_table[k, ku.DRY_ROW]] = kc.BOX
    place_ties(system.unilateral, s, ws)
    for k in range(state.shape[0]):
        if active[k, ka.MODE] != ka.STICKING:
            continue
        first = active[k, ka.FIRST_ROW]
        at = vector(state, k, ka.POSITION)
        for m in range(ka.MOST_ROWS):
            r, d = first + m, ka.NORMAL if m == 0 else ka.FIRST_TANGENT if m == 1 else ka.SECOND_TANGENT
            scale = system.contacts.law[k, ka.GRIP] if m == 1 else 1.0
            point_row(rows, r, at, times_number(vector(state, k, d), scale))
            rows[r, ka.TARGET] = 0.0
            put_six(rows, r, ka.DIRECTION, six(rows, r, ka.ROW))
            s.kind[r] = kc.CONE if m == 0 else kc.TANGENT


@internal_kernel
def slip_of_rates(law, k, x, y):
    """Return the slip speed of candidate k from the rates x, y along its tangents [m/s]."""
    x = x / law[k, ka.GRIP] if law[k, ka.GRIP] > 0.0 else 0.0
    return math.sqrt(x * x + y * y)


@internal_kernel
def friction_of(law, s: SteppingArrays, k, r):
    """Return the friction coefficient of candidate k, with first row r, at the slip at the start of the step.

    The coefficient depends on whether the point has slid, because a sticking point also has tangential rates if its
    rows turn.
    """
    last, speed = s.memory[kt.LAST, k], slip_of_rates(law, k, s.rate[0, r + 1], s.rate[0, r + 2])
    if speed <= kt.BAD or (last[kt.CLOSED] == 1.0 and last[kt.SLID] == 0.0):
        return law[k, ka.STATIC]
    return sliding_friction(law, k, speed)


@internal_kernel
def turn_rows(law, s: SteppingArrays, ws: Workspace, k, h, slack):
    """Write the law's additions to the end rates of listed candidate k to ``s.turn``; its friction is in ``s.mu``."""
    turn, last, state, r = s.turn[k], s.memory[kt.LAST, k], ws.contacts[k], ws.active[k, ka.FIRST_ROW]
    share = h / (h + s.grid[kt.LENGTH_LAST]) if turn[kt.KNOWN] == 1.0 else 0.0
    along = 0.0
    for m in range(3):
        turn[kt.TURNED + m] = share * (s.rate[0, r + m] - last[kt.END_RATE + m])
        along += state[ka.FIRST_TANGENT + m] * last[kt.TANGENT_THEN + m]
    if along < SAME_ROW:
        turn[kt.TURNED + 1], turn[kt.TURNED + 2] = 0.0, 0.0
    for m in range(3):
        turn[kt.ADDED + m] = turn[kt.TURNED + m]
    turn[kt.PUSH], turn[kt.MEAN] = 0.0, 0.0
    soft = law[k, ka.CONTACT_STIFFNESS] > 0.0
    soften_contact(law, s, ws, k, h)
    if last[kt.CLOSED] == 0.0:
        if not soft and s.rate[0, r] < 0.0 and law[k, ka.RESTITUTION] > 0.0:
            turn[kt.ADDED] = law[k, ka.RESTITUTION] * s.rate[0, r]
        return
    if not soft:
        turn[kt.PUSH] = return_rate(state[ka.GAP], turn[kt.TURNED], last[kt.BUDGET], h, slack)
        turn[kt.ADDED] -= turn[kt.PUSH]
    if last[kt.SLID] == 1.0:
        slip = math.sqrt(s.rate[0, r + 1] ** 2 + s.rate[0, r + 2] ** 2)
        # At a start, no impulse is known.
        impulse = s.mu[r] * last[kt.NORMAL_IMPULSE]
        if impulse > 0.0:
            impulse *= h / s.grid[kt.LENGTH_LAST]
        if slip > impulse * largest_mobility(ws.small[0], r):
            turn[kt.MEAN] = 1.0
            turn[kt.ADDED + 1], turn[kt.ADDED + 2] = s.rate[0, r + 1], s.rate[0, r + 2]


@internal_kernel
def return_rate(gap, turned, budget, h, slack):
    """Return the rate at which a closed contact is moved back to its surface [m/s]; positive out of the surface.

    Parameters
    ----------
    gap : float
        Gap at the midpoint [m].
    turned : float
        Part of the contact's normal rate that is due to turning rows [m/s].
    budget : float
        Energy that the motion back may use [J].
    slack : float
        Distance from the surface that is left as it is [m].
    """
    gap -= 0.25 * h * turned
    off = max(0.0, abs(gap) - slack - SWAY * h * abs(turned))
    rate = min(off / max(RETURN_TIME, RETURN_STEPS * h), RETURN_SPEED)
    if gap > 0.0:
        return -rate
    return rate if budget > 0.0 else 0.0


@internal_kernel
def stop_return(unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, k, h):
    """Return the rate at which closed joint stop k moves its joint back [rad/s or m/s].

    The rate is limited by the energy lost when the joint hit the stop. The impulse of the last step, ``s.f`` of the
    stop's row, shows how much energy this rate requires.
    """
    loss, rate, row = unilateral.stop[k, ku.STOP_LOSS], 0.0, unilateral.stop_table[k, ku.STOP_ROW]
    if loss > 0.0:
        rate = return_rate(min(stop_gap(unilateral, ws, k), 0.0), 0.0, loss, h, 0.0)
        impulse = s.f[row]
        if rate * impulse > loss:
            rate = loss / impulse
    return rate


@internal_kernel
def largest_mobility(W, r):
    """Return the larger eigenvalue of the block of W for the two tangents that follow row r."""
    a, b, c = W[r + 1, r + 1], W[r + 1, r + 2], W[r + 2, r + 2]
    return 0.5 * (a + c) + math.sqrt(0.25 * (a - c) ** 2 + b * b)


@internal_kernel
def solve_contacts(art, model: ModelArrays, system, s: SteppingArrays, ws: Workspace, h):
    """Solve for the impulses of all rows, starting from the last ones, and write their mean forces to ``ws.rows``.

    ``art`` is None for the dense solver, otherwise its :class:`ArticulatedArrays`, and then the function returns
    whether it has found a solution.

    The function also updates ``s.impulse``. If a contact that was expected to continue sliding stops or reverses, the
    law for the end of the step is applied to it after all, at most once per contact. A problem without a solution is
    solved again without the additions of the law to the rates, and an impact that would create energy is solved again
    without restitution, at most once each.
    """
    p, coupled, rows = ws.counts[ka.ROWS], ws.counts[ka.COUPLED], ws.rows
    law, unilateral, pairs = system.contacts.law, system.unilateral, system.shapes.pairs
    start = 3 * ws.contacts.shape[0]
    scale_impulses(s, h)
    for r in range(p):
        # RHS = − J M⁻¹ (applied − bias), because TARGET is zero.
        s.b[r] = s.rate[0, r] - h * rows[r, ka.RHS]
        s.right[r] = s.b[r]
        s.f[r] = s.impulse[start + r] if r < coupled else 0.0
    for k in range(unilateral.dry.shape[0]):
        # A closed brake carries the entire load of its joint.
        bound = 0.0 if unilateral.dry_table[k, ku.DRY_BRAKE] == ku.CLOSED else dry_bound(unilateral, k)
        s.mu[unilateral.dry_table[k, ku.DRY_ROW]] = h * bound
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            s.right[unilateral.stop_table[k, ku.STOP_ROW]] -= stop_return(unilateral, s, ws, k, h)
    soften_ties(unilateral, s, ws, h)
    rigid, elastic = False, False
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING:
            rigid = rigid or law[k, ka.CONTACT_STIFFNESS] == 0.0
            r = ws.active[k, ka.FIRST_ROW]
            s.mu[r] = friction_of(law, s, k, r)
            for m in range(ka.MOST_ROWS):
                s.f[r + m] = s.impulse[3 * k + m]
            turn_rows(law, s, ws, k, h, 0.0 if pairs is None else kt.MARGIN)
            elastic = elastic or bounces(law, s, ws, k)
    if art is not None:  # noqa: SIM102 (resolved at compile time)
        if not begin_search(unilateral.dry_table, art, s, ws):
            return False
    loads = MOST_LOADED if s.grid[kt.LENGTH_LAST] == 0.0 else 0
    for _ in range(3 + ws.contacts.shape[0] + loads):
        for k in range(ws.contacts.shape[0]):
            if ws.active[k, ka.MODE] == ka.STICKING:
                for m in range(ka.MOST_ROWS):
                    r = ws.active[k, ka.FIRST_ROW] + m
                    s.right[r] = s.b[r] + s.turn[k, kt.ADDED + m]
        if art is None:  # resolved at compile time
            residual = solve_problem(s, ws.small[0], p, rigid, pairs)
            if not residual <= kt.BAD and drop_turns(law, unilateral, s, ws, p):
                continue
            s.statistics[kt.WORST] = max(s.statistics[kt.WORST], residual)
            if not residual <= kt.BAD:
                s.statistics[kt.CAPPED] += 1.0
                limit_energy(s, ws.small[0], p)
            if elastic and drop_gains(law, unilateral, pairs, s, ws, p):
                elastic = pairs is not None  # other islands may gain energy, too
                continue
        else:
            residual = solve_articulated(model, unilateral.dry_table, art, s, ws, h)
            if not residual <= kt.GOOD:
                return False
            s.statistics[kt.WORST] = max(s.statistics[kt.WORST], residual)
        if slip_ends(s, ws):
            continue
        if loads == 0 or not residual <= kt.BAD or not load_tangents(law, s, ws):
            break
        loads -= 1
    for r in range(p):
        rows[r, ka.FORCE] = s.f[r] / h
        if r < coupled:
            s.impulse[start + r] = s.f[r]
    for k in range(ws.contacts.shape[0]):
        listed, r = ws.active[k, ka.MODE] == ka.STICKING, ws.active[k, ka.FIRST_ROW]
        for m in range(ka.MOST_ROWS):
            s.impulse[3 * k + m] = s.f[r + m] if listed else 0.0
    return True


@internal_kernel
def solve_compliant(art, model: ModelArrays, system, s: SteppingArrays, ws: Workspace, h):
    """Solve for impulses and accelerations by articulated inertias; return False if the dense solver must do it."""
    if art is None:  # resolved at compile time
        return False
    table = system.unilateral.dry_table
    return begin_articulated(model, table, art, s, ws) and solve_contacts(art, model, system, s, ws, h)


@internal_kernel
def scale_impulses(s: SteppingArrays, h):
    """Scale the impulses of the last step so that they belong to the same forces in a step of length h."""
    before = s.grid[kt.IMPULSE_STEP]
    if before > 0.0 and before != h:
        for j in range(s.impulse.shape[0]):
            s.impulse[j] *= h / before
    s.grid[kt.IMPULSE_STEP] = h


@internal_kernel
def drop_turns(law, unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, p):
    """Zero the law's additions to the rates of rigid contacts and stops, and all impulses; return whether any changed.

    If W is rank-deficient, the additions need not be a possible motion of the system, and then the problem may have no
    solution. The rates without impulses are a possible motion, so a solution exists for these rates alone. Compliant
    contacts keep their springs.
    """
    dropped = False
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            r = unilateral.stop_table[k, ku.STOP_ROW]
            dropped = dropped or s.right[r] != s.b[r]
            s.right[r] = s.b[r]
    for k in range(ws.contacts.shape[0]):
        turn = s.turn[k]
        if ws.active[k, ka.MODE] == ka.STICKING and law[k, ka.CONTACT_STIFFNESS] == 0.0:
            for m in range(ka.MOST_ROWS):
                dropped = dropped or turn[kt.ADDED + m] != 0.0
                turn[kt.ADDED + m], turn[kt.TURNED + m] = 0.0, 0.0
            turn[kt.PUSH], turn[kt.MEAN] = 0.0, 0.0
    if dropped:
        s.statistics[kt.DROPPED] += 1.0
        # Do not start from the last impulses, because they may be huge.
        for r in range(p):
            s.f[r] = 0.0
    return dropped


@internal_kernel
def bounces(law, s: SteppingArrays, ws: Workspace, k):
    """Return whether candidate k lands and the law adds its restitution to the normal rate."""
    lands = ws.active[k, ka.MODE] == ka.STICKING and s.memory[kt.LAST, k, kt.CLOSED] == 0.0
    rigid = law[k, ka.CONTACT_STIFFNESS] == 0.0
    return lands and rigid and law[k, ka.RESTITUTION] > 0.0 and s.rate[0, ws.active[k, ka.FIRST_ROW]] < 0.0


@internal_kernel
def drop_gains(law, unilateral: UnilateralArrays, pairs, s: SteppingArrays, ws: Workspace, p):
    """Remove restitution from landings that would create energy; return whether any was removed.

    If bodies touch each other, each island is considered for itself: bodies elsewhere do not change a rebound.
    """
    if pairs is None:  # resolved at compile time
        gains = gains_energy(law, unilateral, s, ws, -1)
        if gains:
            drop_restitution(law, s, ws, -1)
        return gains
    dropped = False
    for first in range(p):
        if s.group[kt.ISLAND, first] == first and gains_energy(law, unilateral, s, ws, first):
            dropped = drop_restitution(law, s, ws, first) or dropped
    return dropped


@internal_kernel
def is_elsewhere(s: SteppingArrays, r, island):
    """Return whether row r belongs to another island than the one with this first row; −1 is the whole system."""
    return island >= 0 and s.group[kt.ISLAND, r] != island


@internal_kernel
def gains_energy(law, unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, island):
    """Return whether contacts and stops of an island together would add energy, p·(u + u')/2 > 0.

    u' excludes the additions for extrapolated rows and for returns to the surface; for closed rows it is the law rate
    w. ``island`` is the first row of the island, or −1 for the whole system.
    """
    gain, passed = 0.0, 0.0
    for k in range(unilateral.stop_table.shape[0]):
        r = unilateral.stop_table[k, ku.STOP_ROW]
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1 and not is_elsewhere(s, r, island):
            gain += 0.5 * s.f[r] * (s.rate[0, r] + s.w[r])
            passed += 0.5 * abs(s.f[r]) * (abs(s.rate[0, r]) + abs(s.w[r]))
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] != ka.STICKING or law[k, ka.CONTACT_STIFFNESS] > 0.0:
            continue
        if is_elsewhere(s, ws.active[k, ka.FIRST_ROW], island):
            continue
        for m in range(3):
            r = ws.active[k, ka.FIRST_ROW] + m
            after = s.w[r]
            if (m == 0 and bounces(law, s, ws, k)) or (s.turn[k, kt.MEAN] == 1.0 and m > 0):
                after -= s.turn[k, kt.ADDED + m]
            gain += 0.5 * s.f[r] * (s.rate[0, r] + after)
            passed += 0.5 * abs(s.f[r]) * (abs(s.rate[0, r]) + abs(after))
    return gain > NO_GAIN * passed


@internal_kernel
def drop_restitution(law, s: SteppingArrays, ws: Workspace, island):
    """Remove restitution from the landings of an island, as event-driven methods do if it contradicts friction.

    Returns whether any landing had it.
    """
    dropped = False
    for k in range(ws.contacts.shape[0]):
        if bounces(law, s, ws, k) and not is_elsewhere(s, ws.active[k, ka.FIRST_ROW], island):
            dropped = dropped or s.turn[k, kt.ADDED] != s.turn[k, kt.TURNED]
            s.turn[k, kt.ADDED] = s.turn[k, kt.TURNED]
    return dropped


@internal_kernel
def limit_energy(s: SteppingArrays, W, p):
    """Scale impulses that do not solve their problem by the factor in [0, 1] that minimises ½ fᵀ W f + f·b.

    This expression is the energy that the impulses add. A scaled f remains in its cones and removes energy for any f.
    """
    linear, square, strongest, fastest = 0.0, 0.0, 0.0, 0.0
    for k in range(p):
        linear += s.f[k] * s.right[k]
        square += s.f[k] * (s.w[k] - s.right[k])
        strongest, fastest = max(strongest, abs(W[k, k] * s.f[k])), max(fastest, abs(s.right[k]))
    part = min(max(-linear / square, 0.0), 1.0) if square > 0.0 else 0.0
    if part * strongest > MOST_UNSOLVED * fastest:
        part = MOST_UNSOLVED * fastest / strongest
    for k in range(p):
        s.f[k] *= part
    motion(W, s.right, p, s.f, s.w)


@internal_kernel
def slip_ends(s: SteppingArrays, ws: Workspace):
    """Apply the law for the end of the step to contacts that did not continue sliding as expected.

    Returns whether any such contact exists.
    """
    ends = False
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] != ka.STICKING or s.turn[k, kt.MEAN] == 0.0:
            continue
        r, on = ws.active[k, ka.FIRST_ROW], 0.0
        for m in range(1, 3):
            on += (s.w[r + m] - s.turn[k, kt.ADDED + m]) * s.rate[0, r + m]
        if on <= 0.0:
            s.turn[k, kt.MEAN], ends = 0.0, True
            for m in range(1, 3):
                s.turn[k, kt.ADDED + m] = s.turn[k, kt.TURNED + m]
    return ends


@internal_kernel
def strikes(law, unilateral: UnilateralArrays, s: SteppingArrays, ws: Workspace, elsewhere):
    """Return whether a rigid contact or a joint stop has been struck in this step.

    With ``elsewhere``, closed contacts whose contact point has jumped to another part of the body also count.
    """
    for k in range(unilateral.stop_table.shape[0]):
        closes = unilateral.stop_table[k, ku.STOP_CLOSED] > unilateral.stop_table[k, ku.STOP_BEFORE]
        if closes and is_stopped(s, unilateral.stop_table[k, ku.STOP_ROW]):
            return True
    for k in range(ws.contacts.shape[0]):
        begins = s.memory[kt.LAST, k, kt.CLOSED] == 0.0 or (elsewhere and s.turn[k, kt.KNOWN] == 0.0)
        rigid = s.memory[kt.NOW, k, kt.LISTED] == 1.0 and law[k, ka.CONTACT_STIFFNESS] == 0.0
        if begins and rigid and is_stopped(s, ws.active[k, ka.FIRST_ROW]):
            return True
    return False


@internal_kernel
def is_stopped(s: SteppingArrays, r):
    """Return whether row r approached at the start of the step and its force has stopped or reversed this approach."""
    return s.rate[0, r] < -kt.BAD and s.f[r] > 0.0


@internal_kernel
def note_contacts(system, s: SteppingArrays, ws: Workspace):
    """Write the state of each candidate after the step to ``s.memory`` and ``s.motion``; end rates are in ``s.rate``.

    A contact that presses or does not leave counts as closed, because a force that merely becomes zero is not an event.
    """
    for k in range(ws.contacts.shape[0]):
        now, last, state = s.memory[kt.NOW, k], s.memory[kt.LAST, k], ws.contacts[k]
        now[:] = 0.0
        s.motion[k] = ka.OPEN
        if ws.active[k, ka.MODE] != ka.STICKING:
            continue
        r = ws.active[k, ka.FIRST_ROW]
        now[kt.LISTED], now[kt.NORMAL_IMPULSE] = 1.0, s.f[r]
        note_place(system, state, k, now)
        for m in range(3):
            now[kt.END_RATE + m] = s.rate[1, r + m]
        if s.f[r] > 0.0 or s.w[r] <= kt.BAD:
            now[kt.CLOSED] = 1.0
            now[kt.SLID] = 1.0 if slip_of_rates(system.contacts.law, k, s.w[r + 1], s.w[r + 2]) > kt.BAD else 0.0
            s.motion[k] = ka.SLIDING if now[kt.SLID] == 1.0 else ka.STICKING
            now[kt.BUDGET] = last[kt.BUDGET] - s.f[r] * max(s.turn[k, kt.PUSH], 0.0)
            if last[kt.CLOSED] == 0.0:
                now[kt.BUDGET] -= 0.5 * s.f[r] * (s.rate[0, r] + s.rate[1, r])
