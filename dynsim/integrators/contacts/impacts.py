"""Impacts: touching contacts are projected onto their surfaces, and impulses stop or reverse their approach.

The law is Moreau's, with Newton's restitution and Coulomb's cone for impulses; it is solved for all touching contacts
and stops at once.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.cone.steps import FEW_PROXIMAL, approach, approach_or_proximal_point, solve_cones
from dynsim.dynamics.contact.delassus import find_splits, normal_is_open
from dynsim.dynamics.contact.mobility import moves_along_normal
from dynsim.dynamics.contact.rows import largest_of_rows, row_errors, set_modes, slip_speed
from dynsim.dynamics.contact.unilateral import (
    UnilateralArrays,
    dry_rows_held,
    holding_bound,
    rows_of_couplings,
    sliding_friction,
    stop_gap,
    stop_rate,
)
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.linear import affine_row
from dynsim.dynamics.tables import ContactArrays, Workspace
from dynsim.dynamics.tree.articulated import accelerate_by_impulses
from dynsim.integrators import run as ki
from dynsim.integrators import run as kp
from dynsim.integrators.run import Run, project_level
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# An approach is an impact if it is faster than this multiple of the projection tolerance for rates.
STRIKE = 3.0
# Number of successive impacts at one instant after which restitution is zero.
MOST_BOUNCES = 30.0
# Number of Newton starts for an impact problem with restitution; it has no solution if restitution contradicts
# friction.
BOUNCE_STARTS = 40
# Distance from its surface within which a point that begins to touch is brought [m].
FOOT_TOLERANCE = 1e-13
# A projection that leaves more than this fraction of a gap converges only linearly, because the point approaches a
# singular posture.
SLOWLY = 0.1
# Tolerances of the contact problem: residual relative to the largest entry, and fraction of the largest force that
# counts as zero.
CONE_TOLERANCE, FORCE_TOLERANCE = 1e-9, 1e-9
# If all rates or accelerations are smaller than this, the target of the residual is relative to this value instead
# [m/s, m/s²]: with closed brakes a point has motions of 1e-30, and no force gives a smaller residual than zero force.
IMMOBILE = 1e-3
# The search for another solution of an impact starts with forces that give this fraction of the largest rate.
OTHER_START = 1e-6


@internal_kernel
def evaluate(system: System, ws: Workspace, run: Run):
    """Evaluate the right-hand side and the row errors at the present state with the present modes."""
    derivative(system, run.clock[ki.TIME], run.y, ws, run.stage[0])
    run.count[ki.EVALUATIONS] += 1
    row_errors(ws)


@internal_kernel
def take_modes(system: System, ws: Workspace, run: Run):
    """Take the modes WANTED, and evaluate the right-hand side with them."""
    set_modes(system.contacts, system.couplings, system.unilateral, ws, system.unilateral.mode[:, ku.WANTED])
    evaluate(system, ws, run)


@internal_kernel
def strike_limit(ws: Workspace, k):
    """Return the rate along the normal below which candidate k does not strike [m/s]."""
    return STRIKE * kp.RATE_TOLERANCE * (1.0 + slip_speed(ws, k))


@internal_kernel
def find_touching(system: System, ws: Workspace, touch):
    """Mark candidates and stops that touch and do not leave; return whether any of them approaches.

    A point that no joint can move along its normal in this posture does not count as touching, because its force would
    be arbitrary. The same applies to a point that a projection could bring onto its surface only by changing the
    posture. If the posture changes, the point lands as soon as it is deeper than now.

    When a point leaves because nothing presses it, open points that rest at their surfaces stay open, and land if they
    move deeper. If they were closed, one of them could hold the others in place although nothing presses it either, and
    would leave at once.
    """
    unilateral = system.unilateral
    state, mode, table = ws.contacts, unilateral.mode, unilateral.stop_table
    strikes, leaves = False, False
    for k in range(mode.shape[0]):
        leaves = leaves or mode[k, ku.LEAVES] == 1
    for k in range(mode.shape[0]):
        limit = strike_limit(ws, k)
        closed = ws.active[k, ka.MODE] != ka.OPEN
        near = closed or (state[k, ka.GAP] <= touch and state[k, ka.GAP_RATE] <= limit)
        near = near and mode[k, ku.LEAVES] == 0
        if leaves and not closed and state[k, ka.GAP_RATE] >= -limit:
            near = near and state[k, ka.GAP] + unilateral.slide[k, ku.LANDS_AT] <= 0.0
        if near and not moves_along_normal(system.model, system.contacts, ws, k, state[k, ka.GAP]):
            near = closed = False
            unilateral.slide[k, ku.LANDS_AT] = ku.DEPTH + max(0.0, -state[k, ka.GAP])
        mode[k, ku.TOUCHING] = 1 if near else 0
        if near and state[k, ka.GAP_RATE] < -limit:
            mode[k, ku.STRUCK] = 1
        # A landing point is stopped even if it is slow, because nothing else would stop it if it stayed open.
        strikes = strikes or (near and state[k, ka.GAP_RATE] < (-limit if closed else 0.0))
    for k in range(table.shape[0]):
        rate = stop_rate(unilateral, ws, k)
        limit = STRIKE * kp.RATE_TOLERANCE
        near = table[k, ku.STOP_CLOSED] == 1 or (stop_gap(unilateral, ws, k) <= touch and rate <= limit)
        table[k, ku.STOP_CLOSED] = 1 if near else 0
        if near and rate < -limit:
            table[k, ku.STOP_STRUCK], strikes = 1, True
    return strikes


@internal_kernel
def keep_touching(unilateral: UnilateralArrays, ws: Workspace):
    """Release points and joints that leave faster than they settle, after an impact or when a brake has closed."""
    state, mode, table = ws.contacts, unilateral.mode, unilateral.stop_table
    for k in range(mode.shape[0]):
        if state[k, ka.GAP_RATE] > unilateral.tally[k, ku.SETTLE]:
            mode[k, ku.TOUCHING] = 0
    for k in range(table.shape[0]):
        if stop_rate(unilateral, ws, k) > unilateral.stop[k, ku.STOP_SETTLE]:
            table[k, ku.STOP_CLOSED] = 0


@internal_kernel
def close_touching(system: System, ws: Workspace, run: Run):
    """Bring touching points and joints onto their surfaces and stops, up to rounding, before they are held.

    A point lands slightly below its surface. If rows depend on each other, like the rows of a point on a body with one
    degree of freedom, there might be no state at which its normal row and the tangential rows of a contact point above
    the surface all vanish. A point that is about to bounce is not moved: if it were lifted at each bounce, it would
    bounce indefinitely.

    Joints that dry friction holds do not move, unless this contradicts a stop or point that comes down with them. In
    that case, friction lets them move, by at most the gaps to close, and holds them in their new positions.
    """
    unilateral = system.unilateral
    mode, table = unilateral.mode, unilateral.dry_table
    for k in range(mode.shape[0]):
        fast = mode[k, ku.STRUCK] == 1 and ws.contacts[k, ka.GAP_RATE] < -unilateral.tally[k, ku.SETTLE]
        bounces = fast and mode[k, ku.BEFORE] == ka.OPEN and system.contacts.law[k, ka.RESTITUTION] > 0.0
        stays = mode[k, ku.TOUCHING] == 1 and not bounces
        mode[k, ku.WANTED] = (
            ka.OPEN if not stays else ka.STICKING if ws.active[k, ka.MODE] == ka.STICKING else ka.SLIDING
        )
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.WANTED])
    if project_down(system, ws, run) or dry_rows_held(unilateral) == 0:
        return
    for k in range(table.shape[0]):
        table[k, ku.DRY_NEXT], table[k, ku.DRY_HOLDS] = table[k, ku.DRY_HOLDS], 0
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.WANTED])
    project_down(system, ws, run)
    for k in range(table.shape[0]):
        table[k, ku.DRY_HOLDS] = table[k, ku.DRY_NEXT]
        if table[k, ku.DRY_HOLDS] == 1:
            unilateral.dry[k, ku.DRY_AT] = ws.joints[table[k, ku.DRY_JOINT], ka.Q]


@internal_kernel
def project_down(system: System, ws: Workspace, run: Run):
    """Project positions onto the active rows, up to rounding if possible; return False if the rows cannot be met."""
    before = worst = math.inf
    for trial in range(1 + kp.PROJECTION_LIMIT):
        evaluate(system, ws, run)
        worst = largest_of_rows(ws, ka.ROW_GAP)
        # If a point is nearly immobile along its normal, each step only halves the distance to full immobility.
        if worst <= FOOT_TOLERANCE or SLOWLY * before < worst <= kp.GAP_TOLERANCE or trial == kp.PROJECTION_LIMIT:
            break
        before = worst
        project_level(system, ws, run.y, 0)
    return worst <= kp.GAP_TOLERANCE


@internal_kernel
def begin_problem(unilateral: UnilateralArrays, couplings, count):
    """Write ``count`` joint rows, of which the first ``couplings`` are couplings, as the first rows of the problem."""
    index, vector, bounded = unilateral.index, unilateral.vector, couplings + dry_rows_held(unilateral)
    for r in range(count):
        index[ku.KINDS, r] = kc.BOTH_WAYS if r < couplings else kc.BOX if r < bounded else kc.ONE_WAY
        index[ku.TABLE_ROW, r] = r
        vector[ku.CONE_FRICTION, r], vector[ku.FIRST_PART, r], vector[ku.SECOND_PART, r] = 0.0, 0.0, 0.0
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 1:
            vector[ku.CONE_FRICTION, unilateral.dry_table[k, ku.DRY_ROW]] = holding_bound(unilateral, k)


@internal_kernel
def add_candidate(unilateral: UnilateralArrays, ws: Workspace, size, k, slides, friction):
    """Add the rows of candidate k, without parts, to a contact problem of this size; return its new size."""
    index, vector = unilateral.index, unilateral.vector
    vector[ku.CONE_FRICTION, size] = friction
    for s in range(1 if slides else ka.MOST_ROWS):
        index[ku.KINDS, size] = kc.ONE_WAY if slides else kc.CONE if s == 0 else kc.TANGENT
        index[ku.TABLE_ROW, size] = ws.active[k, ka.FIRST_ROW] + s
        vector[ku.FIRST_PART, size], vector[ku.SECOND_PART, size] = 0.0, 0.0
        size += 1
    return size


@internal_kernel
def fill_problem(unilateral: UnilateralArrays, ws: Workspace, size):
    """Write the matrix and the accelerations without forces of a contact problem; the forces start at zero."""
    index, vector, W = unilateral.index, unilateral.vector, ws.small[0]
    for i in range(size):
        a = index[ku.TABLE_ROW, i]
        vector[ku.OFFSET, i], vector[ku.SOLUTION, i] = -ws.rows[a, ka.RHS], 0.0
        for j in range(size):
            b = index[ku.TABLE_ROW, j]
            value = W[a, b]
            if vector[ku.FIRST_PART, j] != 0.0 or vector[ku.SECOND_PART, j] != 0.0:
                value += vector[ku.FIRST_PART, j] * W[a, b + 1] + vector[ku.SECOND_PART, j] * W[a, b + 2]
            unilateral.room[ku.PROBLEM, i, j] = value


@internal_kernel
def gather(system: System, ws: Workspace, run: Run):
    """Write the normal and tangential rows of all touching contacts, stops and joints, and their system.

    The kinds and table rows of these rows are written to ``unilateral.index``. Returns the number of rows.
    """
    unilateral, mode = system.unilateral, system.unilateral.mode
    close_touching(system, ws, run)
    for k in range(mode.shape[0]):
        mode[k, ku.WANTED] = ka.STICKING if mode[k, ku.TOUCHING] == 1 else ka.OPEN
    take_modes(system, ws, run)
    size = ws.counts[ka.COUPLED]
    begin_problem(unilateral, system.couplings.joint.shape[0], size)
    for k in range(mode.shape[0]):
        if mode[k, ku.WANTED] == ka.STICKING:
            size = add_candidate(unilateral, ws, size, k, False, friction_at_rest(system, k))
    return size


@internal_kernel
def solve_problem(unilateral: UnilateralArrays, W, size, largest, starts):
    """Solve the contact problem of ``unilateral.vector`` and W, (size, size), into SOLUTION; return False on failure.

    Parameters
    ----------
    largest : float
        Largest of the rates or accelerations that the forces must bring to zero.
    starts : int
        Number of starts of Newton's method before a problem that may have no solution is abandoned; 0: unlimited.
    """
    vector, room, kind = unilateral.vector, unilateral.room[ku.SCRATCH :], unilateral.index[ku.KINDS]
    b, mu, f, good = vector[ku.OFFSET], vector[ku.CONE_FRICTION], vector[ku.SOLUTION], 1e-2 * CONE_TOLERANCE
    good *= max(largest, IMMOBILE)
    if starts > 0:
        residual = approach_or_proximal_point(W, b, kind, mu, size, f, room, good, starts)
    else:
        residual = solve_cones(W, b, kind, mu, size, f, room, good)
    return 0.0 <= residual <= CONE_TOLERANCE * (1.0 + largest)


@internal_kernel
def friction_at_rest(system: System, k):
    """Return the coefficient of the friction cone of candidate k, which is at rest along its surface."""
    if system.unilateral.mode[k, ku.KINETIC_ONLY] == 1:
        return system.contacts.law[k, ka.MU]
    return system.unilateral.number[ku.HOLDING] * system.contacts.law[k, ka.STATIC]


@internal_kernel
def friction_of_impact(system: System, ws: Workspace, k):
    """Return the friction coefficient of candidate k in an impact: at the slip before it, or static if at rest."""
    slip, before = slip_speed(ws, k), system.unilateral.mode[k, ku.BEFORE]
    if before == ka.STICKING or (before == ka.OPEN and slip <= system.unilateral.number[ku.SLOW]):
        return friction_at_rest(system, k)
    return sliding_friction(system.contacts.law, k, slip)


@internal_kernel
def impulses(system: System, ws: Workspace, p, largest, share):
    """Solve for the impulses of :func:`impact` with restitution times ``share``; write losses of rows to FORCE [J].

    Returns False if no solution exists, or if the solution would create energy.
    """
    unilateral, rows = system.unilateral, ws.rows
    vector, mode = unilateral.vector, unilateral.mode
    for r in range(p):
        vector[ku.OFFSET, r], vector[ku.SOLUTION, r] = rows[r, ka.ROW_RATE], 0.0
        # The dry friction of joints is bounded and therefore transmits no impulse.
        vector[ku.CONE_FRICTION, r] = 0.0
    for k in range(mode.shape[0]):
        if mode[k, ku.TOUCHING] == 1:
            r = ws.active[k, ka.FIRST_ROW]
            vector[ku.CONE_FRICTION, r] = friction_of_impact(system, ws, k)
            # A closed point has no approach speed to reverse; a brake or another impact has just caused its speed.
            falls = mode[k, ku.STRUCK] == 1 and mode[k, ku.BEFORE] == ka.OPEN
            if falls and -rows[r, ka.ROW_RATE] > unilateral.tally[k, ku.SETTLE]:
                vector[ku.OFFSET, r] *= 1.0 + share * system.contacts.law[k, ka.RESTITUTION]
    forget_rounding(system, ws)
    if not solve_problem(unilateral, ws.small[0], p, largest, BOUNCE_STARTS if share > 0.0 else 0):
        return False
    f, total, turnover = vector[ku.SOLUTION], 0.0, 0.0
    for r in range(p):
        after = affine_row(ws.small[0], f, rows[:, ka.ROW_RATE], p, r)
        # FORCE is unused until the next evaluation.
        rows[r, ka.FORCE] = -0.5 * f[r] * (rows[r, ka.ROW_RATE] + after)
        total += rows[r, ka.FORCE]
        turnover += abs(rows[r, ka.FORCE])
    return total >= -CONE_TOLERANCE * turnover or share == 0.0


@internal_kernel
def forget_rounding(system: System, ws: Workspace):
    """Zero rates in OFFSET that are within the tolerance, for rows that were closed before the impact.

    An impact may have several solutions, for instance if a wedged point may leave or stay. In a search from zero
    forces, the sign of such a rate would decide between them, but the sign is due to rounding.
    """
    unilateral, offset = system.unilateral, system.unilateral.vector[ku.OFFSET]
    mode, table = unilateral.mode, unilateral.stop_table
    for k in range(mode.shape[0]):
        if stays_or_leaves(unilateral, k):
            r, limit = ws.active[k, ka.FIRST_ROW], strike_limit(ws, k)
            for i in range(r, r + 3 if mode[k, ku.BEFORE] == ka.STICKING else r + 1):
                if abs(offset[i]) <= limit:
                    offset[i] = 0.0
    r = system.couplings.joint.shape[0] + dry_rows_held(unilateral)
    for k in range(table.shape[0]):
        if table[k, ku.STOP_CLOSED] == 1:
            if table[k, ku.STOP_BEFORE] == 1 and abs(offset[r]) <= STRIKE * kp.RATE_TOLERANCE:
                offset[r] = 0.0
            r += 1


@internal_kernel
def stays_or_leaves(unilateral: UnilateralArrays, k):
    """Return whether candidate k takes part in an impact and was closed before it."""
    return unilateral.mode[k, ku.TOUCHING] == 1 and unilateral.mode[k, ku.BEFORE] != ka.OPEN


@internal_kernel
def look_for_other(system: System, ws: Workspace, run: Run, p, largest):
    """Count closed points that leave in the impact although another solution keeps them; SOLUTION is unchanged.

    The search has one start, near the forces of the wedge, and finds most but not all of these solutions.
    """
    unilateral = system.unilateral
    tally, vector = unilateral.tally, unilateral.vector
    f, first, b, mu = vector[ku.SOLUTION], vector[ku.FIRST_PART], vector[ku.OFFSET], vector[ku.CONE_FRICTION]
    for r in range(p):
        first[r], f[r] = f[r], 0.0
    any_leaves = False
    for k in range(tally.shape[0]):
        if stays_or_leaves(unilateral, k):
            r = ws.active[k, ka.FIRST_ROW]
            if mu[r] > 0.0 and affine_row(ws.small[0], first, b, p, r) > tally[k, ku.SETTLE]:
                mobility = max(ws.small[0, r, r], ws.small[0, r + 1, r + 1], ws.small[0, r + 2, r + 2])
                f[r], any_leaves = OTHER_START * largest / max(mobility, 1e-300), True
    if any_leaves:
        good = CONE_TOLERANCE * (1.0 + largest)
        room, kind = unilateral.room[ku.SCRATCH :], unilateral.index[ku.KINDS]
        goal = 1e-2 * CONE_TOLERANCE * max(largest, IMMOBILE)
        if approach(ws.small[0], b, kind, mu, p, f, room, goal, 1, FEW_PROXIMAL) <= good:
            for k in range(tally.shape[0]):
                if stays_or_leaves(unilateral, k):
                    r = ws.active[k, ka.FIRST_ROW]
                    rate = affine_row(ws.small[0], first, b, p, r)
                    if mu[r] > 0.0 and rate > tally[k, ku.SETTLE] and affine_row(ws.small[0], f, b, p, r) < 0.5 * rate:
                        if tally[k, ku.OPEN_IMPACTS] == 0.0:
                            tally[k, ku.OPEN_SINCE] = run.clock[ki.TIME]
                        tally[k, ku.OPEN_IMPACTS] += 1.0
    for r in range(p):
        f[r] = first[r]


@internal_kernel
def impact(system: System, ws: Workspace, run: Run):
    """Apply impulses P that stop approaches: u = W P + b with b = J v, or (1 + e) n·v for normals that strike.

    Then v += M⁻¹ Jᵀ P, and the energy −½ P·(J v₋ + J v₊) is recorded as impact loss.
    """
    unilateral, y, layout = system.unilateral, run.y, system.layout
    vector, mode, rows = unilateral.vector, unilateral.mode, ws.rows
    p = gather(system, ws, run)
    largest = largest_of_rows(ws, ka.ROW_RATE)
    # Newton's restitution may contradict friction: a wedged point cannot leave, and some impacts would gain energy.
    # Such impacts are solved without restitution; this problem always has a solution, and it loses energy. The same
    # applies to points that throw each other back and forth at one instant: accumulating impacts end in contact.
    bouncing = unilateral.number[ku.CHANGES] <= MOST_BOUNCES and impulses(system, ws, p, largest, 1.0)
    if not bouncing and not impulses(system, ws, p, largest, 0.0):
        run.count[ki.STATUS], run.clock[ki.NOT_UNIQUE] = ki.NO_CONTACT_FORCES, run.clock[ki.TIME]
        return
    look_for_other(system, ws, run, p, largest)
    f = vector[ku.SOLUTION]
    accelerate_by_impulses(system.model, ws, f)
    for i in range(ws.joints.shape[0]):
        y[layout.v + i] += ws.joints[i, ka.QDD]
    for k in range(mode.shape[0]):
        if mode[k, ku.TOUCHING] == 1:
            r = ws.active[k, ka.FIRST_ROW]
            loss = rows[r, ka.FORCE] + rows[r + 1, ka.FORCE] + rows[r + 2, ka.FORCE]
            unilateral.tally[k, ku.LOSS] += loss
            y[layout.loss + kst.IMPACT_LOSS] += loss
            y[layout.contact + kst.CONTACT_SIZE * k + kst.IMPULSE] += f[r]
    r = system.couplings.joint.shape[0] + dry_rows_held(unilateral)
    for s in range(r):
        # Add the loss of a closing brake, which stops its joint as a coupling does.
        y[layout.loss + kst.IMPACT_LOSS] += rows[s, ka.FORCE]
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            unilateral.stop[k, ku.STOP_LOSS] += rows[r, ka.FORCE]
            y[layout.loss + kst.JOINT_STOP_LOSS] += rows[r, ka.FORCE]
            r += 1


# Snapshot of all data that a choice of contact modes writes, so that the choice can be tried and undone.


@noinline_kernel
def save_modes(unilateral: UnilateralArrays, ws: Workspace, run: Run):
    """Save the modes, their tables and the state between two steps, when ``y_new`` is unused."""
    for k in range(unilateral.mode.shape[0]):
        unilateral.mode[k, ku.WANTED] = ws.active[k, ka.MODE]
    transfer_tables(unilateral, True)
    for i in range(run.y.shape[0]):
        run.y_new[i] = run.y[i]


@noinline_kernel
def restore_modes(system: System, ws: Workspace, run: Run):
    """Restore the modes, tables and state saved by :func:`save_modes`, and evaluate the right-hand side there."""
    unilateral = system.unilateral
    transfer_tables(unilateral, False)
    for i in range(run.y.shape[0]):
        run.y[i] = run.y_new[i]
    # Evaluate with the present rows first: the earlier rows are built from the positions of the points.
    evaluate(system, ws, run)
    take_modes(system, ws, run)
    run.count[ki.STATUS] = ki.RUNNING


@internal_kernel
def transfer_tables(unilateral: UnilateralArrays, store):
    """Copy all tables that a choice of modes writes to ``kept``, or back."""
    kept, at, number, shares = unilateral.kept, 0, unilateral.number, unilateral.shares
    for table in (unilateral.mode, unilateral.dry_table, unilateral.stop_table):
        at = transfer(kept, at, table, store)
    for numbers in (unilateral.slide, unilateral.tally, unilateral.dry, unilateral.stop):
        at = transfer(kept, at, numbers, store)
    at = transfer(kept, at, number.reshape((1, number.shape[0])), store)
    transfer(kept, at, shares.reshape((1, shares.shape[0])), store)


@internal_kernel
def transfer(kept, at, table, store):
    """Copy a table of floats or integers to ``kept`` from index ``at`` on, or back; return the next index."""
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            if store:
                kept[at] = table[i, j]
            else:
                table[i, j] = kept[at]
            at += 1
    return at


# Acceleration of a sticking point without its own force, which shows whether anything presses it against its surface.


# Number of Newton starts for the contact problem of the other points; if all fail, the point counts as pressed.
STARTS = 8
# Fraction of the largest right-hand side below which an acceleration counts as zero.
NO_ACCELERATION = 1e-8


@noinline_kernel
def approach_without_force(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the acceleration of sticking candidate k towards its surface without its own force.

    Call this function right after ``derivative``. The contact problem contains all other forces: sticking points may
    slip, held joints may move and stops may open; sliding points keep their direction. If nothing moves the point, the
    result [m/s²] is slightly positive (NO_ACCELERATION), so that the guard of a point that leaves falls through zero.
    """
    index, vector, active, W = unilateral.index, unilateral.vector, ws.active, ws.small[0]
    size = ws.counts[ka.COUPLED]
    begin_problem(unilateral, rows_of_couplings(unilateral, ws), size)
    for j in range(ws.contacts.shape[0]):
        if j != k and active[j, ka.MODE] != ka.OPEN:
            # In W, the columns of sliding points already include their friction.
            friction = unilateral.number[ku.HOLDING] * contacts.law[j, ka.STATIC]
            size = add_candidate(unilateral, ws, size, j, active[j, ka.MODE] == ka.SLIDING, friction)
    largest, first = largest_of_rows(ws, ka.RHS), active[k, ka.FIRST_ROW]
    fill_problem(unilateral, ws, size)
    if size > 0 and not solve_problem(unilateral, unilateral.room[ku.PROBLEM], size, largest, STARTS):
        return 1.0
    away = -ws.rows[first, ka.RHS]
    for i in range(size):
        away += W[first, index[ku.TABLE_ROW, i]] * vector[ku.SOLUTION, i]
    return NO_ACCELERATION * largest - away


@noinline_kernel
def watch_unpressed(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, h):
    """Add an accepted step to the time of each point that sticks although nothing presses it.

    This applies only if the split of least norm is in all cones: this is the split among equally stiff supports, which
    hold the point. Otherwise the guard of the normal force lets the point leave.
    """
    if unilateral.number[ku.REDUNDANT] == 0.0 or unilateral.number[ku.SPLIT] == 1.0 or ws.counts[ka.STUCK] == 0:
        return
    find_splits(unilateral, ws)
    for k in range(ws.contacts.shape[0]):
        is_open = ws.active[k, ka.MODE] == ka.STICKING and normal_is_open(unilateral, ws, k)
        if is_open and approach_without_force(contacts, unilateral, ws, k) < 0.0:
            unilateral.tally[k, ku.UNPRESSED] += h
