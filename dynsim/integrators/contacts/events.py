"""Events of the unilateral law (contacts, joint stops, dry friction): guards, mode changes and log.

Each candidate has two guards; each stop and each joint with dry friction has one. The first guard of a candidate is its
gap if it is open, or its normal force if it is closed. The second guard is the margin μ_s f_n − |f_t| if it sticks, or
its speed along the slip direction at the start of the step if it slides. Guards of joints are analogous. An event
occurs when a guard falls through zero.

Forces are continuous at lift-off and at the start of slip, where the complementarity problem is degenerate; the mode of
the single candidate is therefore set directly. If the result is inconsistent, and after all other events, all modes are
solved for again. They are also solved for when the best split of dependent rows reaches its limit, because several
points and joints then start to slip at once and forces jump.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.delassus import (
    dry_margin,
    joint_shares,
    margin,
    normal_is_open,
    point_shares,
    stops_that_share,
)
from dynsim.dynamics.contact.rows import largest_of_rows, row_errors, set_modes, slip_speed
from dynsim.dynamics.contact.shares import keep_shares
from dynsim.dynamics.contact.unilateral import (
    UnilateralArrays,
    dry_bound,
    dry_rests,
    dry_rows_held,
    stop_gap,
    stop_rate,
)
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import dot_vector, plus_scaled, point_acceleration, put_vector, six, vector
from dynsim.integrators import run as ki
from dynsim.integrators.contacts.impacts import (
    IMMOBILE,
    approach_without_force,
    evaluate,
    restore_modes,
    save_modes,
    take_modes,
    watch_unpressed,
)
from dynsim.integrators.contacts.modes import (
    BACKWARD,
    LEAST_SHARE,
    SLIP_TOLERANCE,
    SPLIT_SLACK,
    acceleration_left,
    aim,
    begin_slip,
    force_slack,
    friction_drops,
    note_headway,
    resolve,
    slip_on,
)
from dynsim.integrators.contacts.resting import hold_free_joints, projection_residual, some_rest_without_row
from dynsim.integrators.run import GAP_TOLERANCE, RATE_TOLERANCE, Run, project_level
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Functions that release joints held by dry friction when other rows begin to turn them.


# Maximum of the errors that projection cannot remove, as a fraction of the projection tolerances, and fraction below
# which the sum of the errors is not examined.
MOST_LEFT, LITTLE_LEFT = 0.5, 0.25


@internal_kernel
def record_residual(unilateral: UnilateralArrays, ws: Workspace):
    """Record the error that remains after projection, right after a choice of modes; at rest it does not grow."""
    left = 0.0
    if unilateral.number[ku.REDUNDANT] == 1.0:
        left, _ = contradiction(unilateral, ws)
    unilateral.number[ku.LEFT] = left


@internal_kernel
def release_limit(unilateral: UnilateralArrays):
    """Return the fraction of the tolerances at which a joint is released: half of the remaining tolerance."""
    return unilateral.number[ku.LEFT] + MOST_LEFT * (1.0 - unilateral.number[ku.LEFT])


@internal_kernel
def agreement_margin(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return 1 if the rows agree, or a value below 0 if a joint must be released.

    The guard of the first held joint checks all held joints.
    """
    for j in range(k):
        if unilateral.dry_table[j, ku.DRY_HOLDS] == 1:
            return 1.0
    left, _ = contradiction(unilateral, ws)
    return 1.0 - left / release_limit(unilateral)


@noinline_kernel
def contradiction(unilateral: UnilateralArrays, ws: Workspace):
    """Compute the residual of projection along rows that involve held joints, right after ``derivative``.

    No other data in the workspace change.

    Returns
    -------
    left : float
        Norm of the residual as a fraction of the tolerance: the larger value of gaps and rates.
    joint : int
        Joint to release, or −1 if none.
    """
    rows, p, off, most, gives = ws.rows, ws.counts[ka.ROWS], 0.0, 0.0, -1
    row_errors(ws)
    for r in range(p):
        off += (rows[r, ka.ROW_GAP] / GAP_TOLERANCE) ** 2 + (rows[r, ka.ROW_RATE] / RATE_TOLERANCE) ** 2
    # The least-squares residual is at most as large as the errors themselves.
    if off <= LITTLE_LEFT * LITTLE_LEFT:
        return most, gives
    force, right, errors = unilateral.vector[0], unilateral.vector[1], unilateral.vector[2]
    small = unilateral.room[ku.PROBLEM :]
    for r in range(p):
        force[r], right[r] = rows[r, ka.FORCE], rows[r, ka.RHS]
    for level in range(2):
        projection_residual(ws, small, ka.ROW_GAP if level == 0 else ka.ROW_RATE, errors)
        norm = 0.0
        for r in range(p):
            norm += errors[r] * errors[r]
        norm = math.sqrt(norm)
        left, joint = norm / (GAP_TOLERANCE if level == 0 else RATE_TOLERANCE), first_to_slip(unilateral, errors, norm)
        if left > most and joint >= 0:
            most, gives = left, joint
    for r in range(p):
        rows[r, ka.FORCE], rows[r, ka.RHS] = force[r], right[r]
    return most, gives


@internal_kernel
def first_to_slip(unilateral: UnilateralArrays, errors, norm):
    """Return the held joint that slips first as the forces that oppose these errors grow; −1 if none is involved.

    The errors are along the only combination w of rows with wᵀ J = 0, so forces can change along w without changing the
    motion. The forces grow against the errors until one of them reaches the bound that opposes its error.
    """
    table, least, joint, forces = unilateral.dry_table, math.inf, -1, unilateral.vector[0]
    for k in range(table.shape[0]):
        r = table[k, ku.DRY_ROW]
        if table[k, ku.DRY_HOLDS] == 1 and abs(errors[r]) > LEAST_SHARE * norm:
            room = dry_bound(unilateral, k) + (forces[r] if errors[r] > 0.0 else -forces[r])
            if room / abs(errors[r]) < least:
                least, joint = room / abs(errors[r]), k
    return joint


@noinline_kernel
def release_joint(system: System, ws: Workspace, run: Run):
    """Release a held joint that contradicts other rows, so that these rows can turn it; return whether one was found.

    Call this function right after :func:`evaluate`, and then choose all modes. If the rate of the joint is only a
    rounding error, the joint is held again in its new position.
    """
    unilateral, mode, y, layout = system.unilateral, system.unilateral.mode, run.y, system.layout
    if unilateral.number[ku.REDUNDANT] == 0.0:
        return False
    left, k = contradiction(unilateral, ws)
    # Half of the growth is sufficient, because rounding changes the value at which the event was located.
    if k < 0 or left < 0.5 * (unilateral.number[ku.LEFT] + release_limit(unilateral)):
        return False
    unilateral.dry_table[k, ku.DRY_HOLDS] = 0
    for j in range(mode.shape[0]):
        mode[j, ku.WANTED] = ws.active[j, ka.MODE]
    take_modes(system, ws, run)
    project_level(system, ws, y, 0)
    y[layout.loss + kst.IMPACT_LOSS] += project_level(system, ws, y, 1)
    unilateral.dry[k, ku.DRY_SIDE] = 1.0 if y[layout.v + unilateral.dry_table[k, ku.DRY_JOINT]] > 0.0 else -1.0
    return True


# Kinds of guards; numbers continue the list in dynsim.integrators.events.
NORMAL_GUARD, SLIP_GUARD, STOP_GUARD, DRY_GUARD = 10, 11, 12, 13
# Log entries of a candidate, of a stop, and (slip only) of a joint with dry friction.
LANDING, LIFT_OFF, SLIP_START, SLIP_STOP, BOUNCE, CHATTERS, STOP_HIT, STOP_LEFT = 0, 1, 2, 3, 4, 5, 6, 7
LOG_KINDS = 8
# Columns of the tally that count landings, lift-offs, starts of slip and bounces.
COUNTERS = (ku.LANDINGS, ku.LIFT_OFFS, ku.SLIP_STARTS, -1, ku.BOUNCES)

# Run.gaps: gap, gap rate, normal and position of a candidate at the start of the step, slip along REFERENCE, and the
# rate of this slip.
GAP_THEN, RATE_THEN, NORMAL_THEN, POSITION_THEN, SLIP_THEN, SLIP_RATE_THEN = 0, 1, 2, 5, 8, 9

# A candidate that starts or comes to rest at most this far from its surface touches it [m].
TOUCH = 1e-9
# More than MOST_EVENTS events of one candidate or stop within WINDOW [s] count as chatter; the speed below which
# impacts settle is then raised tenfold, up to MOST_SETTLE [m/s or rad/s].
WINDOW, MOST_EVENTS, MOST_SETTLE = 1.0, 200, 1e-2
# If more changes than this occur at one instant (of length INSTANT [s]), or one candidate or stop chatters more often
# than this, the run ends.
MOST_CHANGES, MOST_CHATTER = 60, 100
INSTANT = 1e-11
# A frozen slip direction is updated when friction has turned away from it by more than the angle with this tangent.
TURNED = 0.5
# At the limit of the best split, sticking is still a solution. For the choice of modes, friction at rest is therefore
# reduced by FIRST_REDUCTION, and by ten times as much in each further trial up to MOST_REDUCTION, until the chosen
# modes agree with their forces. These values are far above rounding and the tolerances of the choice, and far below the
# uncertainty of friction coefficients.
FIRST_REDUCTION, MOST_REDUCTION = 1e-5, 2e-3
# Fraction of the largest force below which the normal force of a sticking point at its limit counts as zero.
NO_FORCE = 1e-8


@internal_kernel
def contact_guard(contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace, kind, k):
    """Return the value of a guard of the unilateral law, right after ``derivative``."""
    if unilateral is None:  # resolved at compile time
        return 1.0
    if kind == STOP_GUARD:
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            return best_margin_or(unilateral, unilateral.stop[k, ku.STOP_FORCE])
        return stop_gap(unilateral, ws, k) + unilateral.stop[k, ku.HIT_AT]
    if kind == DRY_GUARD:
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 0:
            rate = ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QD]
            if dry_rests(unilateral, k):
                return unilateral.number[ku.CREEP] - abs(rate)
            return unilateral.dry[k, ku.DRY_SIDE] * rate + unilateral.dry[k, ku.DRY_HEADWAY] + BACKWARD
        force_margin = best_margin_or(unilateral, dry_margin(unilateral, ws, k))
        return min(force_margin, dry_bound(unilateral, k) * rest_margin(unilateral, ws, k))
    mode = ws.active[k, ka.MODE]
    if kind == NORMAL_GUARD:
        if mode == ka.STICKING and unilateral.number[ku.SPLIT] == 1.0 and normal_is_open(unilateral, ws, k):
            # The minimum possible normal force reaches zero without crossing it.
            return approach_without_force(contacts, unilateral, ws, k)
        return (
            ws.contacts[k, ka.GAP] + unilateral.slide[k, ku.LANDS_AT]
            if mode == ka.OPEN
            else ws.contacts[k, ka.NORMAL_FORCE]
        )
    if mode == ka.SLIDING and contacts.law[k, ka.STATIC] > 0.0:
        return unilateral.slide[k, ku.SPEED] + unilateral.slide[k, ku.HEADWAY] + BACKWARD
    if mode == ka.STICKING:
        # If the split of least norm of dependent rows is outside the cones, the forces are the smallest ones inside.
        # They lie on a cone and do not show the remaining margin. If no split is inside all cones, the best one shows
        # which contacts are at their limit.
        return best_margin_or(unilateral, margin(contacts, unilateral, ws, k))
    return 1.0


@internal_kernel
def rest_margin(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return 1 if held dry-friction joint k does not accelerate, or a value below 0 if its row can no longer hold it.

    Rows may depend on each other in a single posture, such as the rows of a joint and of a point at the crest of a
    surface. Near this posture they contradict each other, at first by less than the rank of their system reveals, and
    the least-squares solution leaves accelerations along them. The joint slides when modes are chosen again. The joint
    counts as accelerating above the limit of that choice or, if the choice held it anyway, above twice the acceleration
    that remained then. Below this limit, rates and gaps along the rows reveal the contradiction in time.
    """
    if unilateral.number[ku.REDUNDANT] == 0.0:
        return 1.0
    limit = max(SLIP_TOLERANCE * max(largest_of_rows(ws, ka.RHS), IMMOBILE), 2.0 * unilateral.dry[k, ku.DRY_LEFT])
    return min(1.0 - acceleration_left(unilateral, ws, k) / limit, agreement_margin(unilateral, ws, k))


@internal_kernel
def best_margin_or(unilateral: UnilateralArrays, own):
    """Return the margin of the best split of dependent rows, or a row's ``own`` margin without such a split."""
    best = unilateral.number[ku.BEST_MARGIN]
    return best if unilateral.number[ku.SPLIT] == 1.0 and best > 0.0 else own


@internal_kernel
def held_joint_accelerates(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether the event of held dry-friction joint k is an acceleration and not a force at its bound."""
    force_margin = best_margin_or(unilateral, dry_margin(unilateral, ws, k))
    return dry_bound(unilateral, k) * rest_margin(unilateral, ws, k) < force_margin


@internal_kernel
def too_long(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace, h, gaps):
    """Return the fraction of the step that should be taken instead if it has passed over an event, or 1.

    An open candidate may dip below its surface, or a joint may move beyond its open stop, and be outside again at the
    end of the step. The minimum of the cubic through the gaps and gap rates at both ends reveals this; ``gaps``,
    (c, GAPS_SIZE), contains the values at the start. In the same way, the slip of a point or the rate of a joint with
    dry friction may have reversed twice. A candidate may have passed through a body: it is then on the other side and
    has moved at least by the sum of both gaps. A point with a frozen slip direction may have become fast across this
    direction, so that friction should act along its actual slip.
    """
    fraction = 1.0
    if unilateral is None:  # resolved at compile time
        return fraction
    dry = unilateral.dry
    for k in range(dry.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 0 and not dry_rests(unilateral, k):
            joint, side = unilateral.dry_table[k, ku.DRY_JOINT], dry[k, ku.DRY_SIDE]
            then, now = h * side * dry[k, ku.DRY_ACCELERATION_THEN], h * side * ws.joints[joint, ka.QDD]
            before, after = side * dry[k, ku.DRY_RATE_THEN], side * ws.joints[joint, ka.QD]
            # A joint slower than CREEP hardly moves, and searching for its reversals would make some contacts chatter.
            slack = dry[k, ku.DRY_HEADWAY] + unilateral.number[ku.CREEP]
            fraction = min(fraction, dip(before, then, after, now, slack))
    for k in range(gaps.shape[0]):
        slow = unilateral.number[ku.SLOW]
        if (
            ws.active[k, ka.MODE] == ka.SLIDING
            and unilateral.slide[k, ku.FROZEN] == 1.0
            and contacts.law[k, ka.STATIC] > 0.0
        ):
            speed = slip_speed(ws, k)
            if speed > 2.0 * slow and unilateral.slide[k, ku.SPEED] < slow:
                fraction = min(fraction, max(1.5 * slow / speed, 0.01))
        if slips_along(contacts, ws, k):
            then, now = h * gaps[k, SLIP_RATE_THEN], h * slip_rate(model, contacts, unilateral, ws, k)
            # Slower slip hardly has a direction, and searching for its reversals would make some contacts chatter.
            slack = unilateral.slide[k, ku.HEADWAY] + slow
            fraction = min(fraction, dip(gaps[k, SLIP_THEN], then, unilateral.slide[k, ku.SPEED], now, slack))
        if passes_through(ws, gaps, k):
            fraction = min(fraction, 0.5)
        if ws.active[k, ka.MODE] == ka.OPEN:
            then, now = h * gaps[k, RATE_THEN], h * ws.contacts[k, ka.GAP_RATE]
            fraction = min(fraction, dip(gaps[k, GAP_THEN], then, ws.contacts[k, ka.GAP], now, ku.DEPTH))
    stop = unilateral.stop
    for k in range(stop.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 0:
            then, now = h * stop[k, ku.STOP_RATE_THEN], h * stop_rate(unilateral, ws, k)
            deepest = stop[k, ku.HIT_AT]
            fraction = min(fraction, dip(stop[k, ku.STOP_GAP_THEN], then, stop_gap(unilateral, ws, k), now, deepest))
    return fraction


@internal_kernel
def slips_along(contacts: ContactArrays, ws: Workspace, k):
    """Return whether candidate k slides with friction, whose direction depends on the sign of slip along REFERENCE."""
    return ws.active[k, ka.MODE] == ka.SLIDING and contacts.law[k, ka.STATIC] > 0.0


@internal_kernel
def slip_rate(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the acceleration along REFERENCE of the body point where candidate k touches [m/s²].

    It is relative to the point of the carrier of the surface.
    """
    a, carrier = acceleration_at(model, ws, contacts.link[k, ka.LINK], k), contacts.link[k, ka.CARRIER]
    if carrier >= 0:
        b = acceleration_at(model, ws, carrier, k)
        a = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return dot_vector(a, vector(unilateral.slide, k, ku.REFERENCE))


@internal_kernel
def acceleration_at(model: ModelArrays, ws: Workspace, i, k):
    """Return the acceleration of the point of link i that is where candidate k touches [m/s²]."""
    # A is the acceleration at vdot = 0 and includes −g from the root.
    V, A, j = six(ws.links, i, ka.V), six(ws.links, i, ka.A), i
    while j >= 0:
        A = plus_scaled(A, six(ws.links, j, ka.S), ws.joints[j, ka.QDD])
        j = model.tree[j, ka.PARENT]
    a = point_acceleration(A, V, vector(ws.contacts, k, ka.POSITION))
    return a[0] + model.gravity[0], a[1] + model.gravity[1], a[2] + model.gravity[2]


@internal_kernel
def dip(g0, d0, g1, d1, depth):
    """Return the fraction of a step at which the cubic through gaps g with changes d per step is below −depth, or 1.

    The fraction is the position of the cubic's minimum.
    """
    if d0 >= 0.0 or d1 <= 0.0:
        return 1.0
    # Hermite: g0 + d0 x + a x² + b x³.
    a, b = 3.0 * (g1 - g0) - 2.0 * d0 - d1, 2.0 * (g0 - g1) + d0 + d1
    x = lowest(d0, a, b)
    return x if x < 1.0 and g0 + x * (d0 + x * (a + x * b)) < -depth else 1.0


@internal_kernel
def lowest(d0, a, b):
    """Return the position between 0 and 1 at which d0 x + a x² + b x³ has a minimum, or 1 without a minimum."""
    root, x = a * a - 3.0 * b * d0, 1.0
    if root > 0.0:
        # This form of the root avoids cancellation.
        if d0 < 0.0 and a + math.sqrt(root) != 0.0:
            x = -d0 / (a + math.sqrt(root))
        elif d0 >= 0.0 and a < 0.0 and b > 0.0:
            x = (math.sqrt(root) - a) / (3.0 * b)
    return x if 0.0 < x < 1.0 else 1.0


@internal_kernel
def passes_through(ws: Workspace, gaps, k):
    """Return whether open candidate k may have passed through a body within the step.

    A distance changes by at most the length of the point's path, so the path must be at least as long as both gaps
    together; a path that bends by half a turn is π/2 times as long as its chord.
    """
    state = ws.contacts[k]
    g0, g1 = gaps[k, GAP_THEN], state[ka.GAP]
    if ws.active[k, ka.MODE] != ka.OPEN or g0 <= 0.0 or g1 <= 0.0:
        return False
    turned, square = 0.0, 0.0
    for s in range(3):
        turned += gaps[k, NORMAL_THEN + s] * state[ka.NORMAL + s]
        moved = state[ka.POSITION + s] - gaps[k, POSITION_THEN + s]
        square += moved * moved
    return turned < 0.0 and 2.5 * square >= (g0 + g1) * (g0 + g1)


@internal_kernel
def note_gaps(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace, gaps):
    """Record gaps, slip, joint rates, normals and positions at the start of a step; :func:`too_long` needs them."""
    if unilateral is None:  # resolved at compile time
        return
    for k in range(unilateral.dry.shape[0]):
        joint = unilateral.dry_table[k, ku.DRY_JOINT]
        unilateral.dry[k, ku.DRY_RATE_THEN] = ws.joints[joint, ka.QD]
        unilateral.dry[k, ku.DRY_ACCELERATION_THEN] = ws.joints[joint, ka.QDD]
    for k in range(unilateral.stop.shape[0]):
        unilateral.stop[k, ku.STOP_GAP_THEN] = stop_gap(unilateral, ws, k)
        unilateral.stop[k, ku.STOP_RATE_THEN] = stop_rate(unilateral, ws, k)
    for k in range(gaps.shape[0]):
        gaps[k, GAP_THEN], gaps[k, RATE_THEN] = ws.contacts[k, ka.GAP], ws.contacts[k, ka.GAP_RATE]
        put_vector(gaps, k, NORMAL_THEN, vector(ws.contacts, k, ka.NORMAL))
        put_vector(gaps, k, POSITION_THEN, vector(ws.contacts, k, ka.POSITION))
        if slips_along(contacts, ws, k):
            gaps[k, SLIP_THEN] = unilateral.slide[k, ku.SPEED]
            gaps[k, SLIP_RATE_THEN] = slip_rate(model, contacts, unilateral, ws, k)


@internal_kernel
def watch_modes(
    model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace, h, gaps
):
    """Update times per mode, depths, gaps and slip directions at the end of an accepted step, before its samples."""
    if unilateral is None:
        return
    watch_unpressed(contacts, unilateral, ws, h)
    note_gaps(model, contacts, unilateral, ws, gaps)
    state, tally, slide = ws.contacts, unilateral.tally, unilateral.slide
    for k in range(state.shape[0]):
        tally[k, ku.TIME_OPEN + ws.active[k, ka.MODE]] += h
        tally[k, ku.DEEPEST] = max(tally[k, ku.DEEPEST], -state[k, ka.GAP])
        if ws.active[k, ka.MODE] != ka.OPEN:
            slide[k, ku.LANDS_AT] = ku.DEPTH
        elif state[k, ka.GAP] > ku.DEPTH:
            slide[k, ku.LANDS_AT] = ku.AT_ROOT
        speed = slip_speed(ws, k)
        slide[k, ku.NEXT_SPEED] = speed
        for s in range(3):
            slide[k, ku.NEXT + s] = (
                state[k, ka.SLIP_VELOCITY + s] / speed if speed > 0.0 else slide[k, ku.REFERENCE + s]
            )
    for k in range(unilateral.stop.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            unilateral.stop[k, ku.CLOSED_TIME] += h
        if unilateral.stop[k, ku.HIT_AT] > ku.DEPTH and stop_gap(unilateral, ws, k) > -ku.DEPTH:
            unilateral.stop[k, ku.HIT_AT] = ku.DEPTH


@internal_kernel
def take_directions(unilateral: UnilateralArrays | None, ws: Workspace, run: Run):
    """Freeze slip directions of points that have become slow, and release them if fast again; call after sampling.

    Friction does not jump, because a direction is frozen along the slip and released when it is again along the slip.
    """
    if unilateral is None:
        return
    slide, slow = unilateral.slide, unilateral.number[ku.SLOW]
    for k in range(slide.shape[0]):
        if ws.active[k, ka.MODE] != ka.SLIDING:
            continue
        frozen, speed = slide[k, ku.FROZEN] == 1.0, slide[k, ku.NEXT_SPEED]
        along = speed * dot_vector(slide[k, ku.REFERENCE :], slide[k, ku.NEXT :]) if frozen else speed
        fast = along >= slow
        if fast or not frozen:
            put_vector(slide, k, ku.REFERENCE, vector(slide, k, ku.NEXT))
        elif speed * speed > along * along + (TURNED * slow) ** 2:
            # Start from the direction of friction, see slide_direction. Slip across it relaxes, so the method restarts.
            for s in range(3):
                slide[k, ku.REFERENCE + s] = (slow - along) * slide[k, ku.REFERENCE + s] + speed * slide[k, ku.NEXT + s]
            run.count[ki.STARTED] = 0
        slide[k, ku.FROZEN] = 0.0 if fast else 1.0
        if not fast:
            stay_tangential(slide, ws, k)


@internal_kernel
def stay_tangential(slide, ws: Workspace, k):
    """Keep a frozen direction tangential to the surface, whose normal turns as the point moves.

    A point without friction may never have slipped; its direction is then zero, or a rounding error along the normal,
    which is removed.
    """
    state, size, along = ws.contacts, 0.0, 0.0
    for s in range(3):
        along += slide[k, ku.REFERENCE + s] * state[k, ka.NORMAL + s]
    for s in range(3):
        slide[k, ku.REFERENCE + s] -= along * state[k, ka.NORMAL + s]
        size += slide[k, ku.REFERENCE + s] ** 2
    # A point without friction may not have a direction yet.
    if size > 0.0:
        for s in range(3):
            slide[k, ku.REFERENCE + s] /= math.sqrt(size)


@internal_kernel
def at_limit(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether candidate k, whose slip guard has fallen through zero, begins to slip or leaves.

    The guards of dependent rows fall through zero together, with the best worst-case margin. Candidates with a larger
    margin continue to stick.
    """
    if unilateral.number[ku.SPLIT] == 0.0:
        return True
    return margin(contacts, unilateral, ws, k) <= unilateral.number[ku.BEST_MARGIN] + split_slack(ws)


@internal_kernel
def split_slack(ws: Workspace):
    """Return the difference below which margins of a split count as equal [N or N m]."""
    return SPLIT_SLACK * (1.0 + largest_of_rows(ws, ka.FORCE))


@internal_kernel
def consistent(system: System, ws: Workspace):
    """Return whether all forces agree with their modes; call right after ``derivative``."""
    unilateral, table = system.unilateral, system.unilateral.stop_table
    slack = force_slack(ws)
    for k in range(table.shape[0]):
        if table[k, ku.STOP_CLOSED] == 1 and unilateral.stop[k, ku.STOP_FORCE] < -slack:
            return False
    for k in range(unilateral.dry_table.shape[0]):
        holds = unilateral.dry_table[k, ku.DRY_HOLDS] == 1
        if holds and contact_guard(system.contacts, unilateral, ws, DRY_GUARD, k) < -slack:
            return False
    for k in range(ws.contacts.shape[0]):
        mode = ws.active[k, ka.MODE]
        if mode != ka.OPEN and ws.contacts[k, ka.NORMAL_FORCE] < -slack:
            return False
        if mode == ka.STICKING and contact_guard(system.contacts, unilateral, ws, SLIP_GUARD, k) < -slack:
            return False
    return True


@noinline_kernel
def solve_modes(system: System, ws: Workspace, run: Run, first):
    """Choose all modes again and log the changes; if ``first``, nothing is logged."""
    before = ws.counts[ka.DEPENDENT]
    resolve(system, ws, run, TOUCH)
    record_residual(system.unilateral, ws)
    # Do not count dependent rows of modes that were only tried.
    ws.counts[ka.DEPENDENT] = before
    if not first:
        log_changes(system, ws, run)
    log_joints(system.unilateral, run)
    rearm(run)
    count_changes(system, run)


@internal_kernel
def split_ends(system: System, ws: Workspace, run: Run):
    """Return whether the best split among several points and joints that stick together has reached its limit.

    At this limit, several of them start to slip at once and their forces jump, so the mode of a single point or joint
    must not be changed alone. A single sticking point that shares its force with no joint or stop starts to slip alone,
    in the direction of its friction.
    """
    unilateral, strongest = system.unilateral, 0.0
    if unilateral.number[ku.SPLIT] == 0.0:
        return False
    stops = stops_that_share(unilateral)
    if ws.counts[ka.STUCK] + dry_rows_held(unilateral) + stops < 2:
        return False
    for k in range(ws.contacts.shape[0]):
        strongest = max(strongest, ws.contacts[k, ka.NORMAL_FORCE])
    for e in range(run.event.shape[0]):
        kind, k = run.event_table[e, ki.EVENT_KIND], run.event_table[e, ki.EVENT_INDEX]
        if kind < NORMAL_GUARD or run.event[e, ki.VALUE] > 0.0:
            continue
        # A joint that shares its force with no other row begins to slip alone, even if other rows share their forces.
        if kind == DRY_GUARD and unilateral.dry_table[k, ku.DRY_HOLDS] == 1 and joint_shares(unilateral, ws, k):
            return True
        if kind == STOP_GUARD and unilateral.stop_table[k, ku.STOP_CLOSED] == 1 and stops > 0:
            return True
        # A point at the apex of its cone leaves. If friction drops when the point slips, modes are chosen at full
        # friction.
        if kind == SLIP_GUARD and ws.active[k, ka.MODE] == ka.STICKING and not friction_drops(system, k):
            pressed = ws.rows[ws.active[k, ka.FIRST_ROW], ka.FORCE] > NO_FORCE * strongest
            if pressed and point_shares(unilateral, ws, k) and at_limit(system.contacts, unilateral, ws, k):
                return True
    return False


@noinline_kernel
def solve_reduced(system: System, ws: Workspace, run: Run):
    """Choose all modes with slightly reduced friction at rest and log the changes.

    Returns False and restores everything if no choice agrees with its forces.
    """
    number, clock = system.unilateral.number, run.clock
    before, not_unique, reduction = ws.counts[ka.DEPENDENT], clock[ki.NOT_UNIQUE], FIRST_REDUCTION
    save_modes(system.unilateral, ws, run)
    agrees = False
    while not agrees and reduction <= MOST_REDUCTION:
        number[ku.HOLDING] = 1.0 - reduction
        resolve(system, ws, run, TOUCH)
        # Check at the reduced friction: at full friction, modes in which too many contacts stick would also agree.
        agrees = run.count[ki.STATUS] == ki.RUNNING and consistent(system, ws)
        if not agrees:
            restore_modes(system, ws, run)
        reduction *= 10.0
    number[ku.HOLDING], ws.counts[ka.DEPENDENT] = 1.0, before
    if agrees:
        record_residual(system.unilateral, ws)
        log_changes(system, ws, run)
        log_joints(system.unilateral, run)
        rearm(run)
        count_changes(system, run)
    else:
        clock[ki.NOT_UNIQUE] = not_unique
    return agrees


@internal_kernel
def rearm(run: Run):
    """Mark all guards of the unilateral law as being on their positive side."""
    for e in range(run.event.shape[0]):
        if run.event_table[e, ki.EVENT_KIND] >= NORMAL_GUARD:
            run.event[e, ki.SIDE], run.event[e, ki.VALUE] = 1.0, 1.0


@internal_kernel
def count_changes(system: System, run: Run):
    """End the run if its modes keep changing at the same instant."""
    number = system.unilateral.number
    number[ku.CHANGES] = number[ku.CHANGES] + 1.0 if run.clock[ki.TIME] - number[ku.LAST_CHANGE] <= INSTANT else 1.0
    number[ku.LAST_CHANGE] = run.clock[ki.TIME]
    if number[ku.CHANGES] > MOST_CHANGES:
        run.count[ki.STATUS] = ki.CHATTER


@internal_kernel
def log(run: Run, code):
    """Write an event to the log; if the log is full, the entry is lost but the run continues."""
    count = run.count
    if count[ki.LOGGED] < run.log_time.shape[0]:
        run.log_time[count[ki.LOGGED]], run.log_event[count[ki.LOGGED]] = run.clock[ki.TIME], code
        count[ki.LOGGED] += 1


@internal_kernel
def log_contact(system: System, run: Run, k, kind):
    """Log and count an event of candidate k, and check for chatter."""
    log_and_count(system.unilateral, run, k, kind)
    watch_chatter(run, system.unilateral.tally, k, ku.SETTLE, ki.CONTACT_LOG)


@internal_kernel
def log_and_count(unilateral: UnilateralArrays, run: Run, k, kind):
    """Log and count an event of candidate k."""
    log(run, ki.CONTACT_LOG + LOG_KINDS * k + kind)
    if kind != SLIP_STOP:
        unilateral.tally[k, COUNTERS[kind]] += 1.0


@internal_kernel
def kind_of_change(before, now):
    """Return the kind of event that changes one mode of a candidate to another."""
    if before == ka.OPEN:
        return LANDING
    if now == ka.OPEN:
        return LIFT_OFF
    return SLIP_START if now == ka.SLIDING else SLIP_STOP


@internal_kernel
def log_stop(system: System, run: Run, k, kind):
    """Log that a joint hits or leaves stop k, count hits, and check for chatter."""
    stop = system.unilateral.stop
    log(run, ki.STOP_LOG + LOG_KINDS * k + kind)
    if kind == STOP_HIT:
        stop[k, ku.HITS] += 1.0
    watch_chatter(run, stop, k, ku.STOP_SETTLE, ki.STOP_LOG)


@internal_kernel
def watch_chatter(run: Run, table, k, settle, first):
    """Count an event of row k, with SETTLE in column ``settle``; in case of chatter, raise the settling speed.

    Log codes begin at ``first``.
    """
    start, count, chattered = settle + 1, settle + 2, settle + 3
    if run.clock[ki.TIME] - table[k, start] > WINDOW:
        table[k, start], table[k, count] = run.clock[ki.TIME], 0.0
    table[k, count] += 1.0
    if table[k, count] <= MOST_EVENTS:
        return
    if table[k, chattered] == 0.0:
        log(run, first + LOG_KINDS * k + CHATTERS)
    table[k, chattered] += 1.0
    table[k, settle] = min(10.0 * table[k, settle], MOST_SETTLE)
    table[k, start], table[k, count] = run.clock[ki.TIME], 0.0
    if table[k, chattered] > MOST_CHATTER:
        run.count[ki.STATUS] = ki.CHATTER


@internal_kernel
def log_changes(system: System, ws: Workspace, run: Run):
    """Log the changes made by a choice of modes."""
    unilateral, table = system.unilateral, system.unilateral.stop_table
    for k in range(ws.contacts.shape[0]):
        before, now = unilateral.mode[k, ku.BEFORE], ws.active[k, ka.MODE]
        if before != now:
            log_contact(system, run, k, kind_of_change(before, now))
        elif now == ka.OPEN and unilateral.mode[k, ku.STRUCK] == 1:
            # It leaves from where it landed, below its surface: it must not land there again at once.
            unilateral.slide[k, ku.LANDS_AT] = ku.AT_ROOT + max(0.0, -ws.contacts[k, ka.GAP])
            log_contact(system, run, k, BOUNCE)
    for k in range(table.shape[0]):
        before, closed = table[k, ku.STOP_BEFORE] == 1, table[k, ku.STOP_CLOSED] == 1
        # A joint may be driven away from its stop at the same instant at which it hits the stop.
        struck = table[k, ku.STOP_STRUCK] == 1
        if not before and (closed or struck):
            log_stop(system, run, k, STOP_HIT)
        if not closed and (before or struck):
            log_stop(system, run, k, STOP_LEFT)


@internal_kernel
def log_joints(unilateral: UnilateralArrays, run: Run):
    """Log joints that dry friction has begun or ceased to hold since the state stored in DRY_TOLD."""
    for k in range(unilateral.dry_table.shape[0]):
        log_joint(unilateral, run, k, 1 if dry_rests(unilateral, k) else 0)


@internal_kernel
def log_joint(unilateral: UnilateralArrays, run: Run, k, holds):
    """Log if dry-friction joint k begins or stops slipping; its state at the start is not an event."""
    before = unilateral.dry_table[k, ku.DRY_TOLD]
    unilateral.dry_table[k, ku.DRY_TOLD] = holds
    if before >= 0 and before != holds:
        log(run, ki.DRY_LOG + LOG_KINDS * k + (SLIP_STOP if holds == 1 else SLIP_START))


@internal_kernel
def break_loose(unilateral: UnilateralArrays, ws: Workspace, k):
    """Let joint k, which dry friction no longer holds, slide; return False if its slip has ended."""
    table, split = unilateral.dry_table, unilateral.number[ku.SPLIT] == 1.0
    if table[k, ku.DRY_HOLDS] == 0:
        return False
    force = ws.rows[table[k, ku.DRY_ROW], ka.FORCE]
    if not split or dry_margin(unilateral, ws, k) <= unilateral.number[ku.BEST_MARGIN] + split_slack(ws):
        table[k, ku.DRY_HOLDS], unilateral.dry[k, ku.DRY_SIDE] = 0, -1.0 if force > 0.0 else 1.0
        note_headway(unilateral, ws, k)
    return True


@noinline_kernel
def switch_contacts(unilateral: UnilateralArrays | None, system: System, ws: Workspace, run: Run):
    """Change the modes at contact events that end the accepted step; the method restarts at the next step."""
    if unilateral is None:
        return
    mode, table = unilateral.mode, unilateral.stop_table
    happened, directly, leaves, begins = 0, True, False, False
    for e in range(run.event.shape[0]):
        if run.event_table[e, ki.EVENT_KIND] >= NORMAL_GUARD and run.event[e, ki.VALUE] <= 0.0:
            happened += 1
    if happened == 0:
        return
    # Samples may have left another state in the workspace.
    evaluate(system, ws, run)
    if release_joint(system, ws, run):
        solve_modes(system, ws, run, False)
        run.count[ki.STARTED] = 0
        return
    if split_ends(system, ws, run) and solve_reduced(system, ws, run):
        run.count[ki.STARTED] = 0
        return
    strongest, split = 0.0, unilateral.number[ku.SPLIT] == 1.0
    for k in range(mode.shape[0]):
        mode[k, ku.WANTED] = ws.active[k, ka.MODE]
        strongest = max(strongest, ws.contacts[k, ka.NORMAL_FORCE])
    for e in range(run.event.shape[0]):
        kind, k = run.event_table[e, ki.EVENT_KIND], run.event_table[e, ki.EVENT_INDEX]
        if kind < NORMAL_GUARD or run.event[e, ki.VALUE] > 0.0:
            continue
        if kind == STOP_GUARD:
            if table[k, ku.STOP_CLOSED] == 1:
                if split and unilateral.stop[k, ku.STOP_FORCE] > unilateral.number[ku.BEST_MARGIN] + split_slack(ws):
                    continue
                table[k, ku.STOP_CLOSED] = 0
                log_stop(system, run, k, STOP_LEFT)
            else:
                directly = False
        elif kind == DRY_GUARD:
            before = unilateral.dry_table[k, ku.DRY_HOLDS]
            if before == 1 and held_joint_accelerates(unilateral, ws, k):
                directly = False
                continue
            directly = break_loose(unilateral, ws, k) and directly
            begins = begins or unilateral.dry_table[k, ku.DRY_HOLDS] < before
        elif ws.active[k, ka.MODE] == ka.OPEN:
            directly = False
        elif kind == NORMAL_GUARD and mode[k, ku.WANTED] == ka.STICKING and unilateral.number[ku.SPLIT] == 1.0:
            # Other points may start to slip when this one leaves.
            mode[k, ku.LEAVES], directly, leaves = 1, False, True
        elif kind == NORMAL_GUARD:
            mode[k, ku.WANTED] = ka.OPEN
            log_contact(system, run, k, LIFT_OFF)
        elif mode[k, ku.WANTED] == ka.STICKING:
            if mode[k, ku.LEAVES] == 1 or not at_limit(system.contacts, unilateral, ws, k):
                continue
            r = ws.active[k, ka.FIRST_ROW]
            if ws.rows[r, ka.FORCE] <= NO_FORCE * strongest:
                # At the apex of its cone, the point leaves, because no direction exists in which it could slip.
                mode[k, ku.WANTED] = ka.OPEN
                log_contact(system, run, k, LIFT_OFF)
                continue
            if friction_drops(system, k):
                # The forces jump, and so does the slip direction.
                mode[k, ku.KINETIC_ONLY], directly = 1, False
                continue
            begin_slip(system, ws, k, ws.rows[r + 1, ka.FORCE], ws.rows[r + 2, ka.FORCE])
            aim(unilateral, ws, k)
            mode[k, ku.WANTED], begins = ka.SLIDING, True
            log_contact(system, run, k, SLIP_START)
        elif mode[k, ku.WANTED] == ka.SLIDING:
            # If the slip has only turned, it continues; otherwise all modes must be chosen.
            directly = slip_on(unilateral, ws, k, 10.0 * unilateral.number[ku.SLOW]) and directly
    if directly:
        keep_shares(unilateral, ws, mode[:, ku.WANTED])
        set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.WANTED])
        if some_rest_without_row(unilateral):
            hold_free_joints(system, ws, run, begins)
        log_joints(unilateral, run)
        rearm(run)
        count_changes(system, run)
    # When a point leaves, points that start to slip hardly accelerate yet; at full friction they would seem to rest.
    elif not leaves or not solve_reduced(system, ws, run):
        solve_modes(system, ws, run, False)
    run.count[ki.STARTED] = 0
