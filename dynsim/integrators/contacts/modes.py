"""Contact modes (open, sliding, sticking) from impacts and the complementarity problem of accelerations.

Forces may jump at the start, at a landing and at the end of slip, so the modes of all touching contacts and stops are
then chosen again. First, impulses stop approaching points and joints (:mod:`dynsim.integrators.contacts.impacts`); then

    0 ≤ f_n ⟂ n·r̈ ≥ 0,   |f_t| ≤ μ_s f_n, and f_t = −μ_s f_n a_t/|a_t| if a_t ≠ 0

is solved for the points at rest along their surfaces; points that slide already have the force f_n (n − μ t) with the
single unknown f_n. The solution shows which points lift off, which stick, and which begin to slip in which direction.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.delassus import dry_margin, find_splits, margin, point_shares
from dynsim.dynamics.contact.rows import largest_of_rows, set_modes, slip_speed
from dynsim.dynamics.contact.shares import even_out, share_slot, some_slide, write_shares
from dynsim.dynamics.contact.unilateral import (
    UnilateralArrays,
    dry_bound,
    dry_rests,
    dry_rows_held,
    holding_bound,
    slide_direction,
    stop_gap,
    stop_rate,
)
from dynsim.dynamics.derivative import System
from dynsim.dynamics.linear import affine_row
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.spatial import vector
from dynsim.integrators import run as ki
from dynsim.integrators.contacts.impacts import (
    FORCE_TOLERANCE,
    STRIKE,
    add_candidate,
    begin_problem,
    evaluate,
    fill_problem,
    find_touching,
    friction_at_rest,
    gather,
    impact,
    keep_touching,
    solve_problem,
    strike_limit,
    take_modes,
)
from dynsim.integrators.contacts.resting import projection_residual, release_dependent_joints
from dynsim.integrators.run import RATE_TOLERANCE, Run, project_level
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# An acceleration along the surface below this fraction of the largest right-hand side counts as zero.
SLIP_TOLERANCE = 1e-8
# Forces that contradict their modes by less than this, absolute [N] and relative to the largest force, are due to
# rounding.
FORCE_SLACK = 1e-9
# A point or joint that slips against its direction more slowly than this [m/s or rad/s] has not stopped yet; one that
# slips along its direction faster than this continues. If slip begins with almost no acceleration, its speed is only
# rounding.
BACKWARD = 2e-11
# A joint with a smaller share than this in the accelerations that contradictory rows leave is not involved.
LEAST_SHARE = 1e-3
# If slip is slower than this, or than twice SLOW [m/s], and no forces agree with it, the slip is stopped as by
# unbounded friction; at 1e-5 m/s this is an impact of 5e-11 J per kilogram. Otherwise, a point that lands within a step
# of coming to rest would end the run.
NEARLY_AT_REST = 1e-5
# Accuracy of the program that finds the best split, as a fraction of its largest force. Margins that differ by less are
# equal, and forces with no larger margin are at a corner of the admissible forces.
SPLIT_SLACK = 1e-7
# A friction force counts as on its cone if it is within this fraction of it.
ON_CONE = 1e-7
# Number of bisections of the interval of a slip direction, sufficient to reach rounding.
MOST_HALVINGS = 60
# Rules for the joints with dry friction that a choice of modes holds: all slow joints; all slow joints unless their
# rates contradict other closed rows; only joints at rest.
HOLD_SLOW, HOLD_COMPATIBLE, HOLD_RESTING = 0, 1, 2
# Holding heavy joints may change the rates of light joints by a multiple of the rate that the heavy joints lose. If
# joints geared to the held joints lose more than this multiple, the held joints were not at rest.
MOST_CHANGE = 100.0


@internal_kernel
def resolve(system: System, ws: Workspace, run: Run, touch):
    """Stop striking points and joints, and choose modes for all that are closed or within ``touch`` [m] of contact.

    ``unilateral.mode`` records the modes BEFORE, and the candidates that STRUCK. STATUS is set if no solution exists.
    """
    unilateral = system.unilateral
    mode, table = unilateral.mode, unilateral.stop_table
    evaluate(system, ws, run)
    for k in range(mode.shape[0]):
        mode[k, ku.BEFORE], mode[k, ku.STRUCK] = ws.active[k, ka.MODE], 0
    for k in range(table.shape[0]):
        table[k, ku.STOP_BEFORE], table[k, ku.STOP_STRUCK] = table[k, ku.STOP_CLOSED], 0
    note_forces(system, ws)
    if find_touching(system, ws, touch):
        impact(system, ws, run)
        if run.count[ki.STATUS] == ki.NO_CONTACT_FORCES:
            return
        evaluate(system, ws, run)
    keep_touching(unilateral, ws)
    choose(system, ws, run)


@internal_kernel
def choose(system: System, ws: Workspace, run: Run):
    """Choose modes from the accelerations of all touching points and joints; bring the rates of closed rows to zero."""
    mode, stops, dry = system.unilateral.mode, system.unilateral.stop_table, system.unilateral.dry_table
    for k in range(mode.shape[0]):
        mode[k, ku.TOUCHED] = mode[k, ku.TOUCHING]
        mode[k, ku.OVERLOADED] = 0
    for k in range(stops.shape[0]):
        stops[k, ku.STOP_TOUCHED] = stops[k, ku.STOP_CLOSED]
    for k in range(dry.shape[0]):
        dry[k, ku.DRY_OVERLOADED] = 0
    choose_joints(system, ws, run)
    # Settling after an impact may reverse light joints; their friction then opposes the new direction.
    if run.count[ki.STATUS] == ki.RUNNING and some_reversed(system, ws):
        restore_touching(system.unilateral)
        choose_joints(system, ws, run)
    # Each pass finds at least one more overloaded point or joint, so the loop ends.
    while run.count[ki.STATUS] == ki.RUNNING and note_overloaded(system, ws):
        restore_touching(system.unilateral)
        choose_joints(system, ws, run)
    for k in range(mode.shape[0]):
        mode[k, ku.KINETIC_ONLY], mode[k, ku.LEAVES] = 0, 0


@internal_kernel
def note_overloaded(system: System, ws: Workspace):
    """Mark points and joints that the chosen modes hold with more force than their friction; return whether any is new.

    If other rows leave a point or joint little mobility, or if it moves a heavy body, it hardly accelerates when its
    friction is exceeded, by less than the solution can show (see ``slips``). Its force, however, shows that it slips.
    If it were held, it would break loose and be held again endlessly.
    """
    unilateral, more = system.unilateral, False
    mode, dry, number = unilateral.mode, unilateral.dry_table, unilateral.number
    if number[ku.SPLIT] == 1.0 and number[ku.BEST_MARGIN] > 0.0:
        return False
    if number[ku.REDUNDANT] == 1.0:
        find_splits(unilateral, ws)
    slack = force_slack(ws)
    for k in range(mode.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING and mode[k, ku.OVERLOADED] == 0:
            left = margin(system.contacts, unilateral, ws, k)
            # A point that has exceeded static friction is held by kinetic friction; shared forces may be split
            # differently.
            alone = number[ku.REDUNDANT] == 0.0 or not point_shares(unilateral, ws, k)
            if mode[k, ku.KINETIC_ONLY] == 1 and alone:
                law = system.contacts.law
                left += (law[k, ka.MU] - number[ku.HOLDING] * law[k, ka.STATIC]) * ws.contacts[k, ka.NORMAL_FORCE]
            if left < -slack:
                mode[k, ku.OVERLOADED], more = 1, True
    for k in range(dry.shape[0]):
        holds = dry[k, ku.DRY_HOLDS] == 1 and dry[k, ku.DRY_OVERLOADED] == 0
        if holds and dry_margin(unilateral, ws, k) < -slack:
            dry[k, ku.DRY_OVERLOADED], more = 1, True
    return more


@internal_kernel
def force_slack(ws: Workspace):
    """Return the magnitude below which forces that contradict their modes are rounding errors [N or N m]."""
    strongest = 0.0
    for k in range(ws.contacts.shape[0]):
        strongest = max(strongest, abs(ws.contacts[k, ka.NORMAL_FORCE]))
    return FORCE_SLACK * (1.0 + strongest)


@internal_kernel
def some_reversed(system: System, ws: Workspace):
    """Return whether a joint or point slides noticeably against the direction for which its friction was chosen."""
    unilateral, turned = system.unilateral, False
    slow = 2.0 * unilateral.number[ku.SLOW]
    for k in range(unilateral.dry_table.shape[0]):
        side = 0.0 if dry_rests(unilateral, k) else unilateral.dry[k, ku.DRY_SIDE]
        rate = ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QD]
        turned = turned or side * rate < -2.0 * unilateral.number[ku.CREEP]
    for k in range(unilateral.mode.shape[0]):
        slides = ws.active[k, ka.MODE] == ka.SLIDING and system.contacts.law[k, ka.STATIC] > 0.0
        turned = turned or (slides and unilateral.slide[k, ku.SPEED] < -slow)
    return turned


@noinline_kernel
def choose_joints(system: System, ws: Workspace, run: Run):
    """Choose modes; if no forces agree with them, choose again without the points and stops that leave.

    An impact may leave rates that are too slow to count as leaving. By convention, not by the contact law, these rates
    are taken to be zero. If this problem has no solution, these points and stops have no force.
    """
    not_unique = run.clock[ki.NOT_UNIQUE]
    choose_rule(system, ws, run)
    if run.count[ki.STATUS] != ki.RUNNING and release_leaving(system, ws):
        run.count[ki.STATUS], run.clock[ki.NOT_UNIQUE] = ki.RUNNING, not_unique
        restore_touching(system.unilateral)
        choose_rule(system, ws, run)


@internal_kernel
def release_leaving(system: System, ws: Workspace):
    """Release points and stops that leave faster than rounding but slower than impacts settle.

    Returns whether any were released.
    """
    unilateral, any_leaves = system.unilateral, False
    mode, table = unilateral.mode, unilateral.stop_table
    for k in range(mode.shape[0]):
        if mode[k, ku.TOUCHED] == 1 and ws.contacts[k, ka.GAP_RATE] > strike_limit(ws, k):
            mode[k, ku.TOUCHED], any_leaves = 0, True
    for k in range(table.shape[0]):
        if table[k, ku.STOP_TOUCHED] == 1 and stop_rate(unilateral, ws, k) > STRIKE * RATE_TOLERANCE:
            table[k, ku.STOP_TOUCHED], any_leaves = 0, True
    return any_leaves


@internal_kernel
def choose_rule(system: System, ws: Workspace, run: Run):
    """Call :func:`choose_modes` with each rule for holding joints by dry friction until one is not rejected."""
    if search_modes(system, ws, run, HOLD_COMPATIBLE):
        return
    # A joint that a contact or stop moves, however slowly, is not at rest.
    restore_touching(system.unilateral)
    search_modes(system, ws, run, HOLD_RESTING)
    if run.count[ki.STATUS] != ki.RUNNING:
        run.count[ki.STATUS] = ki.RUNNING
        restore_touching(system.unilateral)
        search_modes(system, ws, run, HOLD_SLOW)


@internal_kernel
def search_modes(system: System, ws: Workspace, run: Run, rule):
    """Call :func:`choose_modes` from zero forces or, if that would end in a corner, near the forces before the event.

    If joints at rest share forces with sliding points, the solutions form a polygon or polyhedron, and each solution
    has a different motion. Newton's method ends in a corner of it: a joint is at its bound and a point is on its cone,
    but neither moves. The next change of forces would end this state, and modes would be chosen again endlessly. The
    forces before the event are in this set or next to it, and solutions near them continue the previous motion.
    """
    number, search, chosen, not_unique = system.unilateral.number, ku.FROM_ZERO, False, run.clock[ki.NOT_UNIQUE]
    while search <= ku.LAST:
        number[ku.SEARCH], number[ku.CORNER] = search, 0.0
        chosen = choose_modes(system, ws, run, rule)
        if number[ku.CORNER] == 0.0 and (search != ku.NEAR or run.count[ki.STATUS] == ki.RUNNING):
            break
        run.count[ki.STATUS], run.clock[ki.NOT_UNIQUE] = ki.RUNNING, not_unique
        restore_touching(system.unilateral)
        search += 1.0
    return chosen


@noinline_kernel
def note_forces(system: System, ws: Workspace):
    """Record the present contact, stop and friction forces in ``shares``; call right after :func:`evaluate`.

    A choice of modes may start near these forces, and then overwrites them.
    """
    unilateral, rows, state = system.unilateral, ws.rows, ws.contacts
    shares, first = unilateral.shares, system.couplings.joint.shape[0] + unilateral.stop_table.shape[0]
    shares[:] = 0.0
    write_shares(unilateral, ws)
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 0:
            shares[first + k] = -unilateral.dry[k, ku.DRY_SIDE] * dry_bound(unilateral, k)
    for k in range(state.shape[0]):
        if ws.active[k, ka.MODE] == ka.SLIDING:
            r = ws.active[k, ka.FIRST_ROW]
            x, y = sliding_parts(system, ws, k)
            slot = share_slot(unilateral, ws, r)
            shares[slot + 1], shares[slot + 2] = x * rows[r, ka.FORCE], y * rows[r, ka.FORCE]


@internal_kernel
def sliding_parts(system: System, ws: Workspace, k):
    """Return the friction along both tangents of sliding candidate k per unit of its normal force."""
    state = ws.contacts
    slip, n = vector(state, k, ka.SLIP_VELOCITY), vector(state, k, ka.NORMAL)
    tx, ty, tz, mu = slide_direction(system.unilateral, system.contacts, k, slip, n)
    a, b = ka.FIRST_TANGENT, ka.SECOND_TANGENT
    return (
        -mu * (tx * state[k, a] + ty * state[k, a + 1] + tz * state[k, a + 2]),
        -mu * (tx * state[k, b] + ty * state[k, b + 1] + tz * state[k, b + 2]),
    )


@internal_kernel
def restore_touching(unilateral: UnilateralArrays):
    """Restore the marks of candidates and stops that touched before a rejected choice."""
    mode, stops = unilateral.mode, unilateral.stop_table
    for k in range(mode.shape[0]):
        mode[k, ku.TOUCHING] = mode[k, ku.TOUCHED]
    for k in range(stops.shape[0]):
        stops[k, ku.STOP_CLOSED] = stops[k, ku.STOP_TOUCHED]


@noinline_kernel
def choose_modes(system: System, ws: Workspace, run: Run, rule):
    """Choose modes with one rule for holding joints by dry friction; return False if the rule is rejected.

    The rates are then unchanged. HOLD_COMPATIBLE is rejected if the slow rates of the held joints contradict other
    closed rows, or could only be zero if other joints stopped as well.
    """
    unilateral = system.unilateral
    mode = unilateral.mode
    unilateral.number[ku.SHARED] = 0.0
    hold_slow_joints(unilateral, ws, rule)
    if rule == HOLD_RESTING:
        release_moving_joints(unilateral, ws)
    gather(system, ws, run)
    largest = largest_of_rows(ws, ka.RHS)
    least = 2.0 * unilateral.number[ku.SLOW]
    solved, size = solve_accelerations(system, ws, run, largest, least, True)
    if not solved:
        least, run.count[ki.STATUS] = max(least, NEARLY_AT_REST), ki.RUNNING
        solved, size = solve_accelerations(system, ws, run, largest, least, False)
    if not solved:
        if run.count[ki.STATUS] != ki.FORCES_REVERSED:
            run.count[ki.STATUS] = ki.NO_CONTACT_FORCES
        run.clock[ki.NOT_UNIQUE] = run.clock[ki.TIME]
        # Leave the rows that contradict the law in the workspace, for diagnosis.
        take_modes(system, ws, run)
        return True
    take_solution(system, ws, size, largest)
    margin = release_dependent_joints(system, ws, size)
    if unilateral.number[ku.SEARCH] != ku.LAST and margin <= SPLIT_SLACK:
        unilateral.number[ku.CORNER] = 1.0
        return False
    for i in range(size):
        slot = share_slot(unilateral, ws, unilateral.index[ku.TABLE_ROW, i])
        unilateral.shares[slot] = unilateral.vector[ku.SOLUTION, i]
    # Remove residual rates after an impact that was allowed to settle, and of points that were solved as if at rest;
    # otherwise a point that begins to slip could move against its direction, stop, and begin again. A point that moves
    # along its direction keeps its rate; otherwise it would never start to move if events of other points were
    # frequent.
    for k in range(mode.shape[0]):
        starts = mode[k, ku.WANTED] == ka.SLIDING and unilateral.slide[k, ku.FROZEN] == 1.0
        rests = starts and slip_speed(ws, k) <= least and slip_along(unilateral, ws, k) <= -RATE_TOLERANCE
        mode[k, ku.TOUCHING] = ka.STICKING if rests else mode[k, ku.WANTED]
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.TOUCHING])
    # Earlier splits do not apply to these modes.
    unilateral.number[ku.REDUNDANT], unilateral.number[ku.SPLIT] = 0.0, 0.0
    evaluate(system, ws, run)
    if rule == HOLD_COMPATIBLE and holds_moving_joint(unilateral, ws) and rates_contradict(unilateral, ws):
        return False
    loss = project_level(system, ws, run.y, 1)
    if rule == HOLD_COMPATIBLE and stops_others(unilateral, ws):
        for i in range(ws.joints.shape[0]):
            run.y[system.layout.v + i] -= ws.joints[i, ka.QDD]
        evaluate(system, ws, run)
        return False
    run.y[system.layout.loss + kst.IMPACT_LOSS] += loss
    evaluate(system, ws, run)
    for k in range(mode.shape[0]):
        rubs = mode[k, ku.WANTED] == ka.SLIDING and system.contacts.law[k, ka.STATIC] > 0.0
        if rubs and unilateral.slide[k, ku.FROZEN] == 0.0 and slip_speed(ws, k) < unilateral.number[ku.SLOW]:
            # Rows of other contacts have stopped this point too; its friction keeps its direction.
            unilateral.slide[k, ku.FROZEN], mode[k, ku.BEGINS] = 1.0, 1
        if mode[k, ku.WANTED] == ka.SLIDING and mode[k, ku.BEGINS] == 1:
            aim(unilateral, ws, k)
    for k in range(unilateral.dry_table.shape[0]):
        unilateral.dry_table[k, ku.DRY_HOLDS] = unilateral.dry_table[k, ku.DRY_NEXT]
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.WANTED])
    before = ws.counts[ka.DEPENDENT]
    evaluate(system, ws, run)
    redundant = ws.counts[ka.DEPENDENT] > before
    if not redundant:
        find_splits(unilateral, ws)
        redundant = unilateral.number[ku.WIDTH] > 0.0
    unilateral.number[ku.REDUNDANT] = 1.0 if redundant else 0.0
    if redundant:
        if some_slide(mode[:, ku.WANTED]):
            even_out(unilateral, ws)
            unilateral.number[ku.SHARED] = 1.0
        evaluate(system, ws, run)
    for k in range(unilateral.dry_table.shape[0]):
        note_headway(unilateral, ws, k)
        holds = redundant and unilateral.dry_table[k, ku.DRY_HOLDS] == 1
        unilateral.dry[k, ku.DRY_LEFT] = acceleration_left(unilateral, ws, k) if holds else 0.0
    for k in range(unilateral.stop_table.shape[0]):
        # A joint that leaves from slightly beyond its stop has not hit it again.
        unilateral.stop[k, ku.HIT_AT] = ku.DEPTH + max(0.0, -stop_gap(unilateral, ws, k))
    for k in range(mode.shape[0]):
        if mode[k, ku.WANTED] == ka.OPEN:
            # A point that leaves may move below its surface as other points come down; this is not a new landing.
            deepest = ku.AT_ROOT + max(0.0, -ws.contacts[k, ka.GAP])
            unilateral.slide[k, ku.LANDS_AT] = max(unilateral.slide[k, ku.LANDS_AT], deepest)
        starts = mode[k, ku.WANTED] == ka.SLIDING and unilateral.slide[k, ku.FROZEN] == 1.0
        unilateral.slide[k, ku.HEADWAY] = max(0.0, -unilateral.slide[k, ku.SPEED]) if starts else 0.0
    return True


@noinline_kernel
def solve_accelerations(system: System, ws: Workspace, run: Run, largest, least, slides_on):
    """Solve for forces that agree with the law; a point that slips more slowly than ``least`` [m/s] is at rest.

    With ``slides_on``, a point that already slides is not treated as at rest, see :func:`keeps_sliding`.

    Returns
    -------
    solved : bool
        Whether such forces exist.
    size : int
        Size of the problem.
    """
    unilateral, mode, size = system.unilateral, system.unilateral.mode, 0
    for k in range(mode.shape[0]):
        if mode[k, ku.TOUCHING] == 1:
            slides = (slides_on and keeps_sliding(unilateral, ws, k)) or begins_sliding(system, ws, k, least)
            mode[k, ku.WANTED] = ka.SLIDING if slides else ka.STICKING
            mode[k, ku.KINETIC_ONLY] = 1 if mode[k, ku.KINETIC_ONLY] == 1 and friction_drops(system, k) else 0
    # When static friction drops to a smaller kinetic value, the forces of the other contacts change.
    for _ in range(1 + mode.shape[0]):
        size = reduce_rows(system, ws, run)
        if run.count[ki.STATUS] == ki.FORCES_REVERSED:
            return False, size
        if not solve_problem(unilateral, unilateral.room[ku.PROBLEM], size, largest, 0):
            return False, size
        if not give_way(system, ws, size, largest):
            return True, size
    return False, size


@internal_kernel
def joint_rests(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether dry-friction joint k is at rest within the accuracy of projected rates."""
    return abs(ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QD]) <= RATE_TOLERANCE


@internal_kernel
def holds_moving_joint(unilateral: UnilateralArrays, ws: Workspace):
    """Return whether dry friction holds a joint that still moves."""
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 1 and not joint_rests(unilateral, ws, k):
            return True
    return False


@internal_kernel
def release_moving_joints(unilateral: UnilateralArrays, ws: Workspace):
    """Let joints that are not quite at rest slide."""
    for k in range(unilateral.dry_table.shape[0]):
        if not joint_rests(unilateral, ws, k):
            unilateral.dry_table[k, ku.DRY_HOLDS] = 0


@noinline_kernel
def rates_contradict(unilateral: UnilateralArrays, ws: Workspace):
    """Return whether no change of joint rates brings all active row rates to zero; call after :func:`evaluate`."""
    left = unilateral.vector[2]
    projection_residual(ws, ws.small, ka.ROW_RATE, left)
    for r in range(ws.counts[ka.ROWS]):
        fast = 0.0 if ws.active[r, ka.ROW_KIND] == ka.JOINT_ROW else slip_speed(ws, ws.active[r, ka.OWNER])
        if abs(left[r]) > RATE_TOLERANCE * (1.0 + fast):
            return True
    return False


@internal_kernel
def stops_others(unilateral: UnilateralArrays, ws: Workspace):
    """Return whether holding slow joints changes rates by far more than their own; call after `project_level`."""
    slowly, change = 0.0, 0.0
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 1:
            slowly = max(slowly, abs(ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QD]))
    for i in range(ws.joints.shape[0]):
        change = max(change, abs(ws.joints[i, ka.QDD]))
    return slowly > RATE_TOLERANCE and change > MOST_CHANGE * slowly


@internal_kernel
def hold_slow_joints(unilateral: UnilateralArrays, ws: Workspace, rule):
    """Hold joints that do not move in position by dry friction; the other joints keep sliding in their directions.

    A joint that slides in its direction, however slowly, keeps its rate, as a point does, because nothing strikes it
    and other joints would have to stop with it.

    A joint with a closed brake rests without friction, because the brake carries all of its load. A friction row would
    reach its bound and break loose although the joint does not move.
    """
    table, dry = unilateral.dry_table, unilateral.dry
    for k in range(table.shape[0]):
        rate, braked = ws.joints[table[k, ku.DRY_JOINT], ka.QD], table[k, ku.DRY_BRAKE] == ku.CLOSED
        goes = not dry_rests(unilateral, k) and dry[k, ku.DRY_SIDE] * rate > BACKWARD and rule != HOLD_SLOW
        slow = abs(rate) <= 2.0 * unilateral.number[ku.CREEP]
        table[k, ku.DRY_HOLDS] = 1 if slow and not braked and not goes else 0
        dry[k, ku.DRY_SIDE], dry[k, ku.DRY_AT] = 1.0 if rate > 0.0 else -1.0, ws.joints[table[k, ku.DRY_JOINT], ka.Q]
        if braked:
            dry[k, ku.DRY_SIDE] = 0.0


@internal_kernel
def note_headway(unilateral: UnilateralArrays, ws: Workspace, k):
    """Record the speed against DRY_SIDE with which dry-friction joint k begins to slide."""
    rate = ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QD]
    unilateral.dry[k, ku.DRY_HEADWAY] = max(0.0, -unilateral.dry[k, ku.DRY_SIDE] * rate)


@internal_kernel
def acceleration_left(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the acceleration of held dry-friction joint k if its row alone were released, after :func:`evaluate`.

    If rows J v̇ = b contradict each other along one combination w with wᵀ J = 0, least squares leaves the accelerations
    r = w (w·b) / |w|². The joint has only a share of them, which may be small if a point has most of it. If the joint
    slides, as in a choice of modes, all other rows are satisfied, and the joint takes all of it:
    w·b / w_k = |r|² / r_k.
    """
    rows, p, squares, largest = ws.rows, ws.counts[ka.ROWS], 0.0, 0.0
    for r in range(p):
        left = rows[r, ka.RHS]
        for s in range(p):
            left -= ws.small[0, r, s] * rows[s, ka.FORCE]
        squares += left * left
        largest = max(largest, abs(left))
    share = abs(ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QDD])
    return squares / share if share > LEAST_SHARE * largest else share


@internal_kernel
def let_joints_slide(system: System, size, largest):
    """Write joints that dry friction still holds to DRY_NEXT, and the directions of the other joints to DRY_SIDE."""
    unilateral, i = system.unilateral, system.couplings.joint.shape[0]
    table, f = unilateral.dry_table, unilateral.vector[ku.SOLUTION]
    for k in range(table.shape[0]):
        table[k, ku.DRY_NEXT] = table[k, ku.DRY_HOLDS]
        if table[k, ku.DRY_HOLDS] == 1:
            moves = abs(acceleration(unilateral, i, size)) > SLIP_TOLERANCE * largest
            moves = moves or table[k, ku.DRY_OVERLOADED] == 1
            if moves and abs(f[i]) >= holding_bound(unilateral, k) * (1.0 - ON_CONE):
                table[k, ku.DRY_NEXT], unilateral.dry[k, ku.DRY_SIDE] = 0, -1.0 if f[i] > 0.0 else 1.0
            i += 1


@internal_kernel
def slip_along(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the slip of candidate k along its given direction [m/s]."""
    along = 0.0
    for s in range(3):
        along += unilateral.slide[k, ku.REFERENCE + s] * ws.contacts[k, ka.SLIP_VELOCITY + s]
    return along


@internal_kernel
def keeps_sliding(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether candidate k slides in its direction, however slowly, with the friction of the right-hand side.

    Such a candidate keeps its slip and thus its friction. If it were treated as at rest, its friction could change, and
    the forces of the right-hand side would differ from the forces of the choice.
    """
    if unilateral.mode[k, ku.BEFORE] != ka.SLIDING:
        return False
    if unilateral.slide[k, ku.FROZEN] == 0.0:
        return slip_on(unilateral, ws, k, unilateral.number[ku.SLOW])
    return slip_along(unilateral, ws, k) > RATE_TOLERANCE


@internal_kernel
def begins_sliding(system: System, ws: Workspace, k, least):
    """Set the direction of candidate k if it slides faster than ``least`` [m/s] or without friction; return whether."""
    unilateral = system.unilateral
    # The slip may have been turned by an impact.
    if slip_on(unilateral, ws, k, least):
        return True
    if system.contacts.law[k, ka.STATIC] == 0.0:
        unilateral.slide[k, ku.FROZEN] = 0.0
        return True
    return False


@internal_kernel
def slip_on(unilateral: UnilateralArrays, ws: Workspace, k, least):
    """Let candidate k slide along v_t/|v_t| if its slip exceeds ``least`` [m/s]; return whether it does."""
    slide, speed = unilateral.slide, slip_speed(ws, k)
    if speed > least:
        slide[k, ku.FROZEN] = 0.0
        for s in range(3):
            slide[k, ku.REFERENCE + s] = ws.contacts[k, ka.SLIP_VELOCITY + s] / speed
    return speed > least


@internal_kernel
def reduce_rows(system: System, ws: Workspace, run: Run):
    """Write the acceleration problem to ``unilateral``, with only the normal rows of sliding points; return its size.

    The column of such a row is W (n − μ t). STATUS is set if the force of a row would accelerate the row against this
    force (Painlevé).
    """
    unilateral, W = system.unilateral, ws.small[0]
    index, vector, mode = unilateral.index, unilateral.vector, unilateral.mode
    size = ws.counts[ka.COUPLED]
    begin_problem(unilateral, system.couplings.joint.shape[0], size)
    for k in range(mode.shape[0]):
        if mode[k, ku.TOUCHING] == 0:
            continue
        slides, row = mode[k, ku.WANTED] == ka.SLIDING, size
        size = add_candidate(unilateral, ws, size, k, slides, friction_at_rest(system, k))
        if slides:
            vector[ku.FIRST_PART, row], vector[ku.SECOND_PART, row] = sliding_parts(system, ws, k)
    fill_problem(unilateral, ws, size)
    for i in range(size):
        a = index[ku.TABLE_ROW, i]
        if unilateral.number[ku.SEARCH] == ku.NEAR:
            vector[ku.SOLUTION, i] = unilateral.shares[share_slot(unilateral, ws, a)]
        if index[ku.KINDS, i] == kc.ONE_WAY and W[a, a] > 0.0 and unilateral.room[ku.PROBLEM, i, i] <= 1e-12 * W[a, a]:
            run.count[ki.STATUS] = ki.FORCES_REVERSED
    return size


@internal_kernel
def acceleration(unilateral: UnilateralArrays, i, size):
    """Return the acceleration along row i of the reduced problem."""
    vector = unilateral.vector
    return affine_row(unilateral.room[ku.PROBLEM], vector[ku.SOLUTION], vector[ku.OFFSET], size, i)


@internal_kernel
def slips(system: System, k, i, size, largest):
    """Return whether candidate k, row i of the reduced problem, is on its cone and accelerates along its surface."""
    unilateral = system.unilateral
    f = unilateral.vector[ku.SOLUTION]
    friction = math.sqrt(f[i + 1] * f[i + 1] + f[i + 2] * f[i + 2])
    if friction < friction_at_rest(system, k) * f[i] * (1.0 - ON_CONE):
        return False
    if unilateral.mode[k, ku.OVERLOADED] == 1:
        return True
    a, b = acceleration(unilateral, i + 1, size), acceleration(unilateral, i + 2, size)
    return math.sqrt(a * a + b * b) > SLIP_TOLERANCE * largest


@internal_kernel
def begin_slip(system: System, ws: Workspace, k, fx, fy):
    """Start slip of candidate k against (fx, fy) on its two tangents: its friction force or negative acceleration."""
    slide, state = system.unilateral.slide, ws.contacts
    size = math.sqrt(fx * fx + fy * fy)
    slide[k, ku.FROZEN] = 1.0
    for s in range(3):
        slide[k, ku.REFERENCE + s] = (
            -(fx * state[k, ka.FIRST_TANGENT + s] + fy * state[k, ka.SECOND_TANGENT + s]) / size
        )
        slide[k, ku.NEXT + s] = slide[k, ku.REFERENCE + s]
    slide[k, ku.NEXT_SPEED] = 0.0


@internal_kernel
def aim(unilateral: UnilateralArrays, ws: Workspace, k):
    """Change REFERENCE of candidate k so that friction at its slip v is along d, the previous value of REFERENCE.

    A point that was solved as if at rest begins to slip along d, but may still have some slip across d, which turns its
    friction (see ``slide_direction``). This friction would differ from the choice, and a joint that it drives the other
    way would stop at once and begin again, endlessly. With v = a d + b and b normal to d, the reference is
    r = (u d − b)/√(u² + b²), and v + (s − v·r) r, with s = SLOW, is along d if (a + u) u = s √(u² + b²).
    """
    slide, state = unilateral.slide, ws.contacts
    along, across, slow = slip_along(unilateral, ws, k), 0.0, unilateral.number[ku.SLOW]
    for s in range(3):
        across += (state[k, ka.SLIP_VELOCITY + s] - along * slide[k, ku.REFERENCE + s]) ** 2
    if across == 0.0:
        return
    # (a + u) u / √(u² + b²) grows with u, from zero at the first of these to s or more at the second.
    low, high = max(0.0, -along), slow + abs(along) + math.sqrt(across)
    for _ in range(MOST_HALVINGS):
        middle = 0.5 * (low + high)
        if (along + middle) * middle < slow * math.sqrt(middle * middle + across):
            low = middle
        else:
            high = middle
    size = math.sqrt(high * high + across)
    for s in range(3):
        off = state[k, ka.SLIP_VELOCITY + s] - along * slide[k, ku.REFERENCE + s]
        slide[k, ku.REFERENCE + s] = (high * slide[k, ku.REFERENCE + s] - off) / size


@internal_kernel
def friction_drops(system: System, k):
    """Return whether the friction of candidate k drops to a smaller kinetic coefficient when it slips."""
    law = system.contacts.law
    return law[k, ka.STRIBECK] == 0.0 and law[k, ka.STATIC] > law[k, ka.MU]


@internal_kernel
def give_way(system: System, ws: Workspace, size, largest):
    """Give points that exceed static friction and slip the smaller kinetic coefficient; return whether any did.

    The constraint remains a cone: the point need not begin to slip in the direction of the larger force, unless its
    mobility is the same in all directions.
    """
    unilateral = system.unilateral
    index, mode, f = unilateral.index, unilateral.mode, unilateral.vector[ku.SOLUTION]
    changed, i = False, 0
    for k in range(mode.shape[0]):
        if mode[k, ku.TOUCHING] == 0:
            continue
        while index[ku.TABLE_ROW, i] != ws.active[k, ka.FIRST_ROW]:
            i += 1
        holds = mode[k, ku.WANTED] == ka.STICKING and mode[k, ku.KINETIC_ONLY] == 0 and f[i] > 0.0
        if holds and friction_drops(system, k) and slips(system, k, i, size, largest):
            mode[k, ku.KINETIC_ONLY] = 1
            changed = True
    return changed


@internal_kernel
def take_solution(system: System, ws: Workspace, size, largest):
    """Write the modes that follow from the forces of the reduced problem to WANTED; open stops that carry no force."""
    unilateral = system.unilateral
    index, mode, f = unilateral.index, unilateral.mode, unilateral.vector[ku.SOLUTION]
    strongest = 0.0
    for i in range(size):
        strongest = max(strongest, abs(f[i]))
    let_joints_slide(system, size, largest)
    i = system.couplings.joint.shape[0] + dry_rows_held(unilateral)
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            unilateral.stop_table[k, ku.STOP_CLOSED] = 1 if f[i] > FORCE_TOLERANCE * strongest else 0
            i += 1
    for k in range(mode.shape[0]):
        mode[k, ku.BEGINS] = 0
        if mode[k, ku.TOUCHING] == 0:
            mode[k, ku.WANTED] = ka.OPEN
            continue
        while index[ku.TABLE_ROW, i] != ws.active[k, ka.FIRST_ROW]:
            i += 1
        if not f[i] > FORCE_TOLERANCE * strongest:
            # The point touches without force, possibly slightly below its surface; it lands only if it moves deeper.
            mode[k, ku.WANTED], unilateral.slide[k, ku.LANDS_AT] = ka.OPEN, ku.DEPTH
        elif mode[k, ku.WANTED] == ka.STICKING and slips(system, k, i, size, largest):
            fx, fy = f[i + 1], f[i + 2]
            if fx == 0.0 and fy == 0.0:
                # Kinetic friction is zero, so nothing holds the point once static friction is exceeded.
                fx, fy = -acceleration(unilateral, i + 1, size), -acceleration(unilateral, i + 2, size)
            begin_slip(system, ws, k, fx, fy)
            mode[k, ku.WANTED], mode[k, ku.BEGINS] = ka.SLIDING, 1
