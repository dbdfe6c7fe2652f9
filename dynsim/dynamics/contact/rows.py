"""Constraint rows (couplings, dry friction, stops, contacts, ties): table, forces, errors, and geometry of contacts.

A row is one scalar constraint J vdot = target with one force. It has a kind, an owner (a candidate, coupling, stop,
joint or tie) and up to two bodies. The table is rebuilt only when a mode changes. Its order is: couplings, joints held
by dry friction, closed joint stops, closed candidates, ties. These active rows are followed by one row without a force
for each open candidate.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import distance as kd
from dynsim.dynamics.contact import solids as ks
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.distance import ShapeArrays, distance, nearest
from dynsim.dynamics.contact.solids import find_pairs
from dynsim.dynamics.contact.unilateral import UnilateralArrays, slide_direction
from dynsim.dynamics.tables import ContactArrays, CouplingArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    ZERO_VECTOR,
    along,
    cross,
    dot_vector,
    minus_scaled,
    point_acceleration,
    point_velocity,
    put_six,
    put_vector,
    rotate,
    rotate_back,
    rotated_symmetric,
    rotation,
    six,
    times_inertia,
    times_number,
    transform,
    vector,
    wrench_at,
)
from dynsim.jit.kernel import exact_kernel, internal_kernel, noinline_kernel


@internal_kernel
def set_modes(
    contacts: ContactArrays, couplings: CouplingArrays, unilateral: UnilateralArrays | None, ws: Workspace, modes
):
    """Set the mode of every candidate, (c,) of OPEN, SLIDING or STICKING, and rebuild the table of rows.

    The couplings are followed by joints held by dry friction, closed joint stops, candidates, and ties between bodies.

    Call this function right after ``derivative`` at the state at which modes change, and call ``derivative`` again
    afterwards: a candidate that begins to stick is held at its position in the last evaluation. Its slip should be
    zero, because the next projection removes any remaining slip without an entry in the energy ledger.
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
            drop_anchor(contacts, ws, k)
        active[k, ka.MODE], active[k, ka.FIRST_ROW] = modes[k], p
        if modes[k] == ka.SLIDING:
            new_row(ws, p, ka.SLIDING_ROW, k, i)
            active[p, ka.BODY_B] = contacts.link[k, ka.CARRIER]
            active[p, ka.LAW] = contacts.link[k, ka.FRICTION_LAW]
            rows[p, ka.ROW_MU], rows[p, ka.ROW_FLOOR] = contacts.law[k, ka.MU], contacts.law[k, ka.FLOOR]
            p += 1
        elif modes[k] == ka.STICKING:
            sticking += 1
            for _ in range(ka.MOST_ROWS):
                new_row(ws, p, ka.STICKING_ROW, k, i)
                active[p, ka.BODY_B] = contacts.link[k, ka.CARRIER]
                p += 1
    if unilateral is not None:
        p = tie_rows(unilateral, ws, p)
    ws.counts[ka.ROWS], ws.counts[ka.COUPLED], ws.counts[ka.STUCK] = p, joint_rows, sticking
    for k in range(contacts.link.shape[0]):
        if modes[k] == ka.OPEN:
            active[k, ka.FIRST_ROW] = p
            new_row(ws, p, ka.SLIDING_ROW, k, contacts.link[k, ka.LINK])
            p += 1
    # The solves write only the entries of joints that a row involves, and rely on zeros in all other entries.
    ws.column[:] = 0.0


@internal_kernel
def dry_rows(unilateral: UnilateralArrays, ws: Workspace, p):
    """Write a joint row with one joint for every joint held by dry friction; return the new number of rows."""
    table, owner = unilateral.dry_table, p + unilateral.stop_table.shape[0]
    for k in range(table.shape[0]):
        if table[k, ku.DRY_HOLDS] == 0:
            continue
        row_of_joint(ws, p, owner + k, table[k, ku.DRY_JOINT], 1.0, unilateral.dry[k, ku.DRY_AT])
        table[k, ku.DRY_ROW] = p
        p += 1
    return p


@internal_kernel
def tie_rows(unilateral: UnilateralArrays, ws: Workspace, p):
    """Write a row between two bodies for every active tie; return the new number of rows."""
    table = unilateral.tie_table
    for k in range(table.shape[0]):
        if table[k, ku.TIE_HOLDS] == 1:
            new_row(ws, p, ka.BODY_ROW, k, table[k, ku.TIE_A])
            ws.active[p, ka.BODY_B], table[k, ku.TIE_ROW] = table[k, ku.TIE_B], p
            p += 1
    return p


@internal_kernel
def stop_rows(unilateral: UnilateralArrays, couplings, ws: Workspace, p):
    """Write a joint row with one joint for every closed stop; return the new number of rows."""
    table, stop = unilateral.stop_table, unilateral.stop
    for k in range(table.shape[0]):
        stop[k, ku.STOP_FORCE] = 0.0
        if table[k, ku.STOP_CLOSED] == 1:
            row_of_joint(ws, p, couplings + k, table[k, ku.STOP_JOINT], stop[k, ku.SIDE], stop[k, ku.LIMIT])
            table[k, ku.STOP_ROW] = p
            p += 1
    return p


@internal_kernel
def row_of_joint(ws: Workspace, r, owner, joint, side, offset):
    """Initialise row r of one joint, whose position times ``side`` is to be ``offset``."""
    new_row(ws, r, ka.JOINT_ROW, owner, joint)
    ws.active[r, ka.BODY_B] = joint
    ws.rows[r, ka.ROW], ws.rows[r, ka.DIRECTION], ws.rows[r, ka.ROW_OFFSET] = side, side, offset


@internal_kernel
def new_row(ws: Workspace, r, kind, owner, link):
    """Initialise row r, which belongs to one body and has no friction."""
    active = ws.active
    active[r, ka.ROW_KIND], active[r, ka.OWNER], active[r, ka.LAW] = kind, owner, ka.FRICTION_SIGNED
    active[r, ka.BODY_A], active[r, ka.BODY_B] = link, -1
    ws.rows[r] = 0.0
    ws.rows[r, ka.SIGN] = 1.0


@internal_kernel
def drop_anchor(contacts: ContactArrays, ws: Workspace, k):
    """Anchor candidate k at the projection of its present position onto the surface, and set two tangents there."""
    state, carrier = ws.contacts, contacts.link[k, ka.CARRIER]
    anchor = along(vector(state, k, ka.POSITION), vector(state, k, ka.NORMAL), -state[k, ka.GAP])
    if carrier >= 0:
        at = vector(ws.links, carrier, ka.P)
        anchor = rotate_back(rotation(ws.links, carrier, ka.R), along(anchor, at, -1.0))
    put_vector(state, k, ka.ANCHOR, anchor)
    tangents(ws, k)


@internal_kernel
def tangents(ws: Workspace, k):
    """Compute two tangents at the present normal of candidate k, for the rows of a sticking point."""
    state = ws.contacts
    n = vector(state, k, ka.NORMAL)
    # The first tangent is n × the coordinate axis furthest from n.
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
    """Write row r: the motion along d of the body point at ``at``."""
    put_six(rows, r, ka.ROW, wrench_at(at, d, ZERO_VECTOR))


@noinline_kernel
def sticking_rows(model: ModelArrays, contacts: ContactArrays, ws: Workspace, k, i):
    """Write the tangential rows of sticking candidate k on link i; the first row is already written.

    The first row is the row of the surface, as for a sliding point, so that the gap remains the distance from the
    surface. The other rows are t · (r − anchor) = 0 with the tangents t at the anchor. These are constant, so that
    t · r̈ = 0 is exact on any surface for any remaining velocity. At rest, the three rows together give r̈ = 0. On a
    surface that a body carries, all this is seen from the body.
    """
    state, rows, links, active = ws.contacts, ws.rows, ws.links, ws.active
    first = active[k, ka.FIRST_ROW]
    at = vector(state, k, ka.POSITION)
    # Velocity of the point, and its acceleration at vdot = 0 (A includes −g from the root).
    V = six(links, i, ka.V)
    v, a = point_velocity(V, at), point_acceleration(six(links, i, ka.A), V, at)
    a = a[0] + model.gravity[0], a[1] + model.gravity[1], a[2] + model.gravity[2]
    anchor, carrier = vector(state, k, ka.ANCHOR), contacts.link[k, ka.CARRIER]
    if carrier >= 0:
        # The same for the point of the carrier; ċ is the velocity of the body's own point.
        V = six(links, carrier, ka.V)
        b = point_acceleration(six(links, carrier, ka.A), V, at)
        v = along(v, point_velocity(V, at), -1.0)
        a = a[0] - b[0] - model.gravity[0], a[1] - b[1] - model.gravity[1], a[2] - b[2] - model.gravity[2]
        a = along(a, cross((V[0], V[1], V[2]), v), -1.0)
        anchor = transform(vector(links, carrier, ka.P), rotation(links, carrier, ka.R), anchor)
    offset = along(at, anchor, -1.0)
    for m in range(ka.MOST_ROWS):
        r = first + m
        d = vector(state, k, ka.NORMAL if m == 0 else ka.FIRST_TANGENT if m == 1 else ka.SECOND_TANGENT)
        point_row(rows, r, at, d)
        put_six(rows, r, ka.DIRECTION, six(rows, r, ka.ROW))
        if m > 0:
            rows[r, ka.TARGET] = -dot_vector(d, a)
            rows[r, ka.ROW_RATE] = dot_vector(d, v)
            rows[r, ka.ROW_GAP] = dot_vector(d, offset)


@internal_kernel
def force_vectors(ws: Workspace):
    """Write the force of every candidate, including friction, in W to ``ws.contacts``; call after ``derivative``."""
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
    """Write the position and rate errors of each active row to ROW_GAP and ROW_RATE; call after ``derivative``.

    The error of a coupling is q_follower − ratio q_leader − offset. Tangential rows of sticking points already have
    their errors.
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
def largest_of_rows(ws: Workspace, column):
    """Return the largest absolute value in this column of the active rows."""
    largest = 0.0
    for r in range(ws.counts[ka.ROWS]):
        largest = max(largest, abs(ws.rows[r, column]))
    return largest


@internal_kernel
def slip_speed(ws: Workspace, k):
    """Return |v_t| of candidate k [m/s]."""
    state = ws.contacts
    x, y, z = state[k, ka.SLIP_VELOCITY], state[k, ka.SLIP_VELOCITY + 1], state[k, ka.SLIP_VELOCITY + 2]
    return math.sqrt(x * x + y * y + z * z)


@internal_kernel
def joint_rate(ws: Workspace, r):
    """Return the rate of joint row r."""
    rows, active, joints = ws.rows, ws.active, ws.joints
    return (
        rows[r, ka.ROW] * joints[active[r, ka.BODY_A], ka.QD]
        + rows[r, ka.ROW + 1] * joints[active[r, ka.BODY_B], ka.QD]
    )


# Contact points on quadrics: geometry, slip direction, constraint rows, and the friction of the bilateral law.


# Maximum number of solves, in addition to two per contact, in the search for signs of dissipative contacts that agree
# with their forces.
SIGN_PASSES = 64
# If there are more contacts than this, not all choices of signs are tried.
SIGNS_LIMIT = 8
# A normal force below this fraction of the largest one is a rounding error.
NO_FORCE = 1e-12


@internal_kernel
def surface_distance(value, slope, curvature):
    """Return the signed distance along the normal from the level-set value.

    It is the root of C − |∇C| s + κ s²/2 with κ = nᵀQn: exact for the plane, the sphere and the cylinder.
    """
    inner = 1.0 - 2.0 * curvature * value / (slope * slope)
    if inner <= 0.0:
        return value / slope
    return 2.0 * value / (slope * (1.0 + math.sqrt(inner)))


@internal_kernel
def hessian_product(point, k, u):
    """Return u·Q u for the surface of contact k; ``point`` has shape (c, POINT_SIZE)."""
    return (
        u[0] * (point[k, ka.QUADRIC] * u[0] + 2.0 * (point[k, ka.QUADRIC + 1] * u[1] + point[k, ka.QUADRIC + 2] * u[2]))
        + u[1] * (point[k, ka.QUADRIC + 3] * u[1] + 2.0 * point[k, ka.QUADRIC + 4] * u[2])
        + u[2] * point[k, ka.QUADRIC + 5] * u[2]
    )


@internal_kernel
def quadric_gap(point, k, curved, at):
    """Return signed distance and normal of the quadric of candidate k at a point in W, and 1/|∇C|.

    ∇C of a plane, which is not ``curved``, is its unit normal: this saves every right-hand side two roots and three
    divisions.
    """
    n = vector(point, k, ka.QUADRIC + 6)
    gap, inverse = dot_vector(n, at) + point[k, ka.QUADRIC + 9], 1.0
    if curved:
        bent = times_inertia(six(point, k, ka.QUADRIC), at)
        n = n[0] + bent[0], n[1] + bent[1], n[2] + bent[2]
        slope = math.sqrt(dot_vector(n, n))
        inverse = 1.0 / slope
        n = times_number(n, inverse)
        gap = surface_distance(gap + 0.5 * dot_vector(bent, at), slope, hessian_product(point, k, n))
    return gap, n, inverse


@internal_kernel
def contact_rows(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Compute position, gap, slip, constraint row and force direction of every candidate, after ``forward_sweep``.

    A candidate off its surface also has a row, which comes after the active rows, so that this computation needs no
    branches.

    The surface is C(r) = r·Q r/2 + b·r + c with n = ∇C/|∇C| ([WM] eqs 3, 6, 8); a gap > 0 is off the surface. The row
    is n·r̈ = −ṙᵀ(∂²C/∂r²)ṙ / |∇C| ([WM] eqs 15, 30). The force per unit f_n is n − σ μ t with the smoothed slip
    direction t = v_t / √(|v_t|² + v_s²) ([WM] eqs 9, 14 and f_t = μ f_n). v_s is an assumption of dynsim, because the
    paper does not cover zero slip. σ is 1 in the paper's law; in the dissipative law it is the sign of f_n, kept
    between calls. Under the unilateral law, t and μ come from
    :func:`~dynsim.dynamics.contact.unilateral.slide_direction`.
    """
    links, point, gravity = ws.links, contacts.point, model.gravity
    for k in range(contacts.link.shape[0]):
        i, mu = contacts.link[k, ka.LINK], signed_friction(ws, ws.active[k, ka.FIRST_ROW])
        R = rotation(links, i, ka.R)
        at = transform(vector(links, i, ka.P), R, vector(point, k, ka.POINT))
        curved = contacts.link[k, ka.CURVED] != 0
        gap, n, inverse = quadric_gap(point, k, curved, at)
        # Velocity of the point, and its acceleration at vdot = 0 (A includes −g from the root).
        V = six(links, i, ka.V)
        v, a = point_velocity(V, at), point_acceleration(six(links, i, ka.A), V, at)
        a = a[0] + gravity[0], a[1] + gravity[1], a[2] + gravity[2]
        rate = dot_vector(n, v)
        slip = v[0] - rate * n[0], v[1] - rate * n[1], v[2] - rate * n[2]
        t, mu = slip_friction(unilateral, contacts, ws, k, slip, n, mu)
        target = -dot_vector(n, a)
        target = target - hessian_product(point, k, v) * inverse if curved else target
        # Only stores follow, because a store to one table makes the compiler reload values of the other.
        write_candidate(ws, k, at, gap, n, rate, slip, t, mu, target)
    if ws.counts[ka.STUCK] == 0:
        return
    for k in range(contacts.link.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING:
            sticking_rows(model, contacts, ws, k, contacts.link[k, ka.LINK])


@internal_kernel
def slip_friction(unilateral: UnilateralArrays | None, contacts: ContactArrays, ws: Workspace, k, slip, n, mu):
    """Return the direction of slip of candidate k and the friction against it; under the bilateral law this is mu."""
    if unilateral is None:  # resolved at compile time
        v_s = contacts.law[k, ka.V_S]
        return times_number(slip, 1.0 / math.sqrt(dot_vector(slip, slip) + v_s * v_s)), mu
    x, y, z, mu = slide_direction(unilateral, contacts, k, slip, n)
    ws.rows[ws.active[k, ka.FIRST_ROW], ka.ROW_MU] = mu
    return (x, y, z), mu


@internal_kernel
def write_candidate(ws: Workspace, k, at, gap, n, rate, slip, t, mu, target):
    """Write position, gap, slip, row and force direction of candidate k."""
    state, rows, m = ws.contacts, ws.rows, ws.active[k, ka.FIRST_ROW]
    state[k, ka.GAP], state[k, ka.GAP_RATE], rows[m, ka.TARGET] = gap, rate, target
    put_vector(state, k, ka.POSITION, at)
    put_vector(state, k, ka.NORMAL, n)
    put_vector(state, k, ka.SLIP_VELOCITY, slip)
    put_vector(state, k, ka.TANGENT, t)
    point_row(rows, m, at, n)
    unit_force(rows, m, mu, at, n, t)


@internal_kernel
def signed_friction(ws: Workspace, m):
    """Return σ μ of row m."""
    mu = ws.rows[m, ka.ROW_MU]
    return mu * ws.rows[m, ka.SIGN] if ws.active[m, ka.LAW] == ka.FRICTION_DISSIPATIVE else mu


@exact_kernel
def unit_force(rows, m, mu, at, n, t):
    """Write the wrench of a unit normal force with friction, n − σ μ t at the contact point, to DIRECTION of row m.

    The result is bit-identical whether it is computed for the first time or after a change of sign, so that a
    right-hand side does not depend on the signs of the preceding evaluation.
    """
    x, y, z = n[0] - mu * t[0], n[1] - mu * t[1], n[2] - mu * t[2]
    # The cross product is written out, because in a separate function the compiler would contract its products.
    wrench = at[1] * z - at[2] * y, at[2] * x - at[0] * z, at[0] * y - at[1] * x, x, y, z
    put_six(rows, m, ka.DIRECTION, wrench)


@internal_kernel
def turn_direction(ws: Workspace, m):
    """Recompute DIRECTION of row m for its present SIGN."""
    state, k = ws.contacts, ws.active[m, ka.OWNER]
    at, n, t = vector(state, k, ka.POSITION), vector(state, k, ka.NORMAL), vector(state, k, ka.TANGENT)
    unit_force(ws.rows, m, signed_friction(ws, m), at, n, t)


@internal_kernel
def sign_changed(ws: Workspace, passes):
    """Reverse directions of dissipative contacts whose forces contradict their assumed signs; return whether any did.

    The first passes reverse all of these directions. Later passes reverse only the first one (least-index pivoting,
    which cannot cycle while all choices have determinants of one sign), and finally every choice is tried in turn. If
    no choice is consistent (Painlevé), the forces become NaN, the count CONTRADICTORY increases and the search ends.
    Forces that vanish up to rounding have no sign and count as +. The result thus does not depend on the initial signs
    of the search, unless several choices are consistent (dynsim.dynamics.contact.delassus checks this).
    """
    rows, active, p = ws.rows, ws.active, ws.counts[ka.ROWS]
    limit = 2 * p + SIGN_PASSES
    changed, largest = False, largest_of_rows(ws, ka.FORCE)
    for k in range(p):
        if active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
            agreement = rows[k, ka.FORCE] * rows[k, ka.SIGN]
            if agreement < -NO_FORCE * largest or (agreement <= NO_FORCE * largest and rows[k, ka.SIGN] < 0.0):
                if passes < limit and not (changed and passes > p):
                    rows[k, ka.SIGN] = -rows[k, ka.SIGN]
                    turn_direction(ws, k)
                changed = True
    if changed and passes >= limit:
        choice, free = passes - limit, 0
        for k in range(p):
            if active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
                free += 1
        if free > SIGNS_LIMIT or choice >= 1 << free:
            ws.counts[ka.CONTRADICTORY] += 1
            for k in range(p):
                rows[k, ka.FORCE] = math.nan
            return False
        index = 0
        for k in range(p):
            if active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
                rows[k, ka.SIGN] = -1.0 if (choice >> index) & 1 == 1 else 1.0
                index += 1
                turn_direction(ws, k)
    return changed


# Contact geometry of spheres and capsules, and of surfaces given by a signed distance.


# sin² of the angle between an axis and a direction of constant distance. Below this value u̇ = 0, because the axis has
# no unique nearest point; for example, it is parallel to the axis of a cylinder.
ALONG = 1e-8


@internal_kernel
def shaped_rows(
    shapes, unilateral: UnilateralArrays | None, model: ModelArrays, contacts: ContactArrays, ws: Workspace
):
    """Overwrite the results of ``contact_rows`` for candidates that are not points on quadrics.

    The results are the position (the point of contact c), gap, slip, row, target and direction, and the rows of
    sticking candidates. If ``shapes`` is None, there are no such candidates.
    """
    if shapes is None:  # resolved at compile time; the default program then excludes shapes
        return
    find_pairs(shapes.pairs, ws)
    for k in range(contacts.link.shape[0]):
        if shapes.kind[k, kd.SURFACE] == kd.PAIR:
            pair_row(shapes.pairs, shapes, unilateral, model, contacts, ws, k)
        elif shapes.kind[k, kd.SURFACE] != kd.AS_POINT:
            shaped_row(shapes, unilateral, model, contacts, ws, k)


@internal_kernel
def pair_row(pairs, shapes: ShapeArrays, unilateral: UnilateralArrays | None, model: ModelArrays, contacts, ws, k):
    """Compute the rows of a contact of two solids, for time stepping: TARGET is without the turning of the normal."""
    if pairs is None:
        return
    slot, m = pairs.slots[shapes.kind[k, kd.FIELD], shapes.kind[k, kd.COUNT]], ws.active[k, ka.FIRST_ROW]
    i, carrier = contacts.link[k, ka.LINK], contacts.link[k, ka.CARRIER]
    at = slot[ks.PLACE], slot[ks.PLACE + 1], slot[ks.PLACE + 2]
    n = slot[ks.NORMAL], slot[ks.NORMAL + 1], slot[ks.NORMAL + 2]
    V, b = six(ws.links, i, ka.V), (-model.gravity[0], -model.gravity[1], -model.gravity[2])
    a = point_acceleration(six(ws.links, i, ka.A), V, at)
    if carrier >= 0:
        other = six(ws.links, carrier, ka.V)
        b = point_acceleration(six(ws.links, carrier, ka.A), other, at)
        V = minus_scaled(V, other, 1.0)
    v = point_velocity(V, at)
    rate = dot_vector(n, v)
    slip = along(v, n, -rate)
    t, mu = slip_friction(unilateral, contacts, ws, k, slip, n, signed_friction(ws, m))
    write_candidate(ws, k, at, slot[ks.GAP], n, rate, slip, t, mu, dot_vector(n, b) - dot_vector(n, a))
    if ws.active[k, ka.MODE] == ka.STICKING:
        tangents(ws, k)
        sticking_rows(model, contacts, ws, k, i)


@internal_kernel
def carrier_of(pairs, contacts: ContactArrays, k):
    """Return the link that carries the surface of candidate k; without pairs it is −1, known at compile time."""
    if pairs is None:
        return -1
    return contacts.link[k, ka.CARRIER]


@internal_kernel
def shaped_row(
    shapes: ShapeArrays,
    unilateral: UnilateralArrays | None,
    model: ModelArrays,
    contacts: ContactArrays,
    ws: Workspace,
    k,
):
    """Compute the geometry and the rows of one candidate.

    Friction acts at c, along the velocity of the body point at c. A sticking candidate rolls: its tangential rows are
    t · v_c = 0 for the body point that is at c now; as the body rolls, other points take its place. With
    v_c = v_O + ω × c

        t · (v̇_O + ω̇ × c + ω × ċ) = 0,   ċ = ṡ − ρ H ṡ,   ṡ = v + u̇ d,

    so that, compared with a held point, ω × v_c becomes ω × ċ. A rolling candidate has no anchor to which it must
    return.
    """
    links, rows, point, data = ws.links, ws.rows, contacts.point, shapes.data
    i, m, radius = contacts.link[k, ka.LINK], ws.active[k, ka.FIRST_ROW], shapes.data[k, kd.RADIUS]
    R = rotation(links, i, ka.R)
    s = transform(vector(links, i, ka.P), R, vector(point, k, ka.POINT))
    d = rotate(R, vector(data, k, kd.D))
    carrier = carrier_of(shapes.pairs, contacts, k)
    # Point and axis in the frame of the surface.
    x, e = s, d
    if carrier >= 0:
        turned = rotation(links, carrier, ka.R)
        x = rotate_back(turned, along(s, vector(links, carrier, ka.P), -1.0))
        e = rotate_back(turned, d)
    u = 0.0
    if shapes.kind[k, kd.MOVES] != 0:
        u = nearest(shapes, k, x[0], x[1], x[2], e[0], e[1], e[2])
        s, x = along(s, d, u), along(x, e, u)
    far, nx, ny, nz, hxx, hxy, hxz, hyy, hyz, hzz = distance(shapes, k, x[0], x[1], x[2])
    n, H = (nx, ny, nz), (hxx, hxy, hxz, hyy, hyz, hzz)
    # Velocity of the body's point at s, and its acceleration at vdot = 0 (A includes −g from the root).
    V = six(links, i, ka.V)
    a = point_acceleration(six(links, i, ka.A), V, s)
    a = a[0] + model.gravity[0], a[1] + model.gravity[1], a[2] + model.gravity[2]
    if carrier >= 0:
        # From here on, both are relative to the carrier and its point at s.
        turned, other = rotation(links, carrier, ka.R), six(links, carrier, ka.V)
        n, H = rotate(turned, n), rotated_symmetric(turned, H)
        b = point_acceleration(six(links, carrier, ka.A), other, s)
        V = minus_scaled(V, other, 1.0)
        coriolis = cross((other[0], other[1], other[2]), point_velocity(V, s))
        a = a[0] - b[0] - model.gravity[0], a[1] - b[1] - model.gravity[1], a[2] - b[2] - model.gravity[2]
        a = along(a, coriolis, -2.0)
    w, v = (V[0], V[1], V[2]), point_velocity(V, s)
    # H v, which becomes ṅ = H ṡ, and v, which becomes ṡ.
    n_rate, s_rate = times_inertia(H, v), v
    second = dot_vector(n, a) + dot_vector(v, n_rate)
    if 0.0 < u < 1.0:
        H_d = times_inertia(H, d)
        bent = dot_vector(d, H_d)
        if bent > ALONG * dot_vector(d, d) * (hxx + hyy + hzz):
            mixed = dot_vector(v, H_d) + dot_vector(n, cross(w, d))
            speed = -mixed / bent
            second += speed * mixed
            n_rate, s_rate = along(n_rate, H_d, speed), along(s_rate, d, speed)
    c = along(s, n, -radius)
    rate = dot_vector(n, v)
    v = along(v, cross(w, n), -radius)
    slip = along(v, n, -rate)
    t, mu = slip_friction(unilateral, contacts, ws, k, slip, n, signed_friction(ws, m))
    write_candidate(ws, k, c, far - radius, n, rate, slip, t, mu, -second)
    if ws.active[k, ka.MODE] != ka.STICKING:
        return
    rolls = radius > 0.0 or shapes.kind[k, kd.MOVES] != 0
    if rolls or carrier >= 0:
        # The candidate rolls away from its anchor, or its surface turns; any two tangents at its present point span the
        # same rows.
        tangents(ws, k)
    sticking_rows(model, contacts, ws, k, i)
    if rolls:
        # v_c − ċ, relative to the carrier
        left = along(along(v, s_rate, -1.0), n_rate, radius)
        own = six(links, i, ka.V)
        extra = cross((own[0], own[1], own[2]), left)
        if carrier >= 0:
            other = six(links, carrier, ka.V)
            extra = along(extra, cross((other[0], other[1], other[2]), along(left, v, -1.0)), -1.0)
        for r in range(m + 1, m + 3):
            rows[r, ka.TARGET] += dot_vector(vector(rows, r, ka.ROW + 3), extra)
            rows[r, ka.ROW_GAP] = 0.0
