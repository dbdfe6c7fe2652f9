"""Which candidates are open, slide or stick: impacts, and the complementarity problem of the accelerations.

At a start, a landing and the end of slip, forces may jump and all that touches is looked at anew. First what
approaches is stopped by impulses (Moreau's law with Newton's restitution and Coulomb's cone on impulses); then

    0 ≤ f_n ⟂ n·r̈ ≥ 0,   |f_t| ≤ μ_s f_n, and f_t = −μ_s f_n a_t/|a_t| where a_t ≠ 0

is solved for what is at rest along its surface, with one unknown, f_n (n − μ t), for each point that slides already.
The solution says which points leave, which stick, and where slip begins, in which direction.
"""

from __future__ import annotations

import math

from dynsim.kernels.arrays import (
    DEPENDENT,
    FIRST_ROW,
    FIRST_TANGENT,
    FORCE,
    GAP,
    GAP_RATE,
    MODE,
    MU,
    OPEN,
    QD,
    QDD,
    RHS,
    ROW_GAP,
    ROW_RATE,
    ROWS,
    SECOND_TANGENT,
    SLIDING,
    SLIP_VELOCITY,
    STICKING,
    Q,
    Workspace,
)
from dynsim.kernels.constraint.cone import BOTH_WAYS, CONE, ONE_WAY, TANGENT, solve_cones
from dynsim.kernels.constraint.rows import row_errors, set_modes
from dynsim.kernels.constraint.unilateral import (
    BEFORE,
    CONE_FRICTION,
    FIRST_PART,
    FROZEN,
    HEADWAY,
    KINDS,
    LIMIT,
    LOSS,
    NEXT,
    NEXT_SPEED,
    OFFSET,
    PROBLEM,
    REDUNDANT,
    REFERENCE,
    RESTITUTION,
    SCRATCH,
    SECOND_PART,
    SETTLE,
    SIDE,
    SLOW,
    SOLUTION,
    SPEED,
    SPLIT,
    STATIC,
    STOP_BEFORE,
    STOP_CLOSED,
    STOP_JOINT,
    STOP_LOSS,
    STRIBECK,
    STRUCK,
    TABLE_ROW,
    TOUCHING,
    WANTED,
    UnilateralArrays,
    slide_direction,
)
from dynsim.kernels.integrate.project import PROJECTION_LIMIT, RATE_TOLERANCE, project_level
from dynsim.kernels.integrate.run import (
    EVALUATIONS,
    FORCES_REVERSED,
    NO_CONTACT_FORCES,
    NOT_UNIQUE,
    STATUS,
    TIME,
    Run,
)
from dynsim.kernels.jit import internal_kernel
from dynsim.kernels.state import CONTACT_SIZE, IMPACT_LOSS, IMPULSE, JOINT_STOP_LOSS
from dynsim.kernels.system import System, derivative
from dynsim.kernels.tree.articulated import accelerate

# A point that approaches faster than this many tolerances of projected rates strikes.
STRIKE = 3.0
# What begins to touch is brought this close to its surface [m].
FOOT_TOLERANCE = 1e-13
# Of a solution of the cones: residual by the largest entry, and what of the largest force is none.
CONE_TOLERANCE, FORCE_TOLERANCE = 1e-9, 1e-9
# Where nothing is faster, or accelerated by more, residuals are not compared with it: behind closed brakes a point has
# motions of 1e-30, and no force upon it is better than none [m/s, m/s²].
IMMOBILE = 1e-3
# An acceleration along the surface below this fraction of the largest right-hand side is none.
SLIP_TOLERANCE = 1e-8
# A friction force this close to the cone, as a fraction, is on it.
ON_CONE = 1e-7


@internal_kernel
def slip_speed(ws: Workspace, k):
    """|v_t| of candidate k [m/s]."""
    state = ws.contacts
    x, y, z = state[k, SLIP_VELOCITY], state[k, SLIP_VELOCITY + 1], state[k, SLIP_VELOCITY + 2]
    return math.sqrt(x * x + y * y + z * z)


@internal_kernel
def evaluate(system: System, ws: Workspace, run: Run):
    """The right-hand side at the present state, with the present modes, and how its rows are off."""
    derivative(system, run.clock[TIME], run.y, ws, run.stage[0])
    run.count[EVALUATIONS] += 1
    row_errors(ws)


@internal_kernel
def resolve(system: System, ws: Workspace, run: Run, touch):
    """Stop what strikes, and choose the modes of everything that touches: closed, or no further than ``touch`` [m] off.

    ``unilateral.mode`` has the modes BEFORE, and what was STRUCK. Sets STATUS where there is no solution.
    """
    unilateral = system.unilateral
    mode, table = unilateral.mode, unilateral.stop_table
    evaluate(system, ws, run)
    for k in range(mode.shape[0]):
        mode[k, BEFORE], mode[k, STRUCK] = ws.active[k, MODE], 0
    for k in range(table.shape[0]):
        table[k, STOP_BEFORE] = table[k, STOP_CLOSED]
    if find_touching(unilateral, ws, touch):
        impact(system, ws, run)
        if run.count[STATUS] == NO_CONTACT_FORCES:
            return
        evaluate(system, ws, run)
        keep_touching(unilateral, ws)
    choose(system, ws, run)


@internal_kernel
def find_touching(unilateral: UnilateralArrays, ws: Workspace, touch):
    """Note what touches and does not leave; True when some of it approaches."""
    state, mode, table, stop = ws.contacts, unilateral.mode, unilateral.stop_table, unilateral.stop
    strikes = False
    for k in range(mode.shape[0]):
        limit = STRIKE * RATE_TOLERANCE * (1.0 + slip_speed(ws, k))
        closed = ws.active[k, MODE] != OPEN
        near = closed or (state[k, GAP] <= touch and state[k, GAP_RATE] <= limit)
        mode[k, TOUCHING] = 1 if near else 0
        if near and state[k, GAP_RATE] < -limit:
            mode[k, STRUCK] = 1
        # What lands ever so slowly is stopped too: nothing else would, should it stay open.
        strikes = strikes or (near and state[k, GAP_RATE] < (-limit if closed else 0.0))
    for k in range(table.shape[0]):
        j = table[k, STOP_JOINT]
        gap, rate = stop[k, SIDE] * ws.joints[j, Q] - stop[k, LIMIT], stop[k, SIDE] * ws.joints[j, QD]
        limit = STRIKE * RATE_TOLERANCE
        near = table[k, STOP_CLOSED] == 1 or (gap <= touch and rate <= limit)
        table[k, STOP_CLOSED] = 1 if near else 0
        strikes = strikes or (near and rate < -limit)
    return strikes


@internal_kernel
def keep_touching(unilateral: UnilateralArrays, ws: Workspace):
    """After an impact: what leaves faster than SETTLE touches no more."""
    state, mode, table, stop = ws.contacts, unilateral.mode, unilateral.stop_table, unilateral.stop
    for k in range(mode.shape[0]):
        if state[k, GAP_RATE] > unilateral.tally[k, SETTLE]:
            mode[k, TOUCHING] = 0
    for k in range(table.shape[0]):
        if stop[k, SIDE] * ws.joints[table[k, STOP_JOINT], QD] > STRIKE * RATE_TOLERANCE:
            table[k, STOP_CLOSED] = 0


@internal_kernel
def come_down(system: System, ws: Workspace, run: Run):
    """Bring what touches onto its surface, to rounding, before it is held where it is.

    A point lands a little below its surface. Where rows depend on each other, as those of a point on a body with one
    degree of freedom, there might be no state at which its normal row and the tangential ones of a foot found above it
    all vanish. What is about to bounce is not held: lifted at each bounce, it would go on for ever.
    """
    unilateral = system.unilateral
    mode = unilateral.mode
    for k in range(mode.shape[0]):
        fast = mode[k, STRUCK] == 1 and ws.contacts[k, GAP_RATE] < -unilateral.tally[k, SETTLE]
        bounces = fast and mode[k, BEFORE] == OPEN and unilateral.law[k, RESTITUTION] > 0.0
        held = mode[k, TOUCHING] == 1 and not bounces
        mode[k, WANTED] = OPEN if not held else STICKING if ws.active[k, MODE] == STICKING else SLIDING
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, WANTED])
    for _ in range(PROJECTION_LIMIT):
        evaluate(system, ws, run)
        worst = 0.0
        for r in range(ws.counts[ROWS]):
            worst = max(worst, abs(ws.rows[r, ROW_GAP]))
        if worst <= FOOT_TOLERANCE:
            return
        project_level(system, ws, run.y, 0)


@internal_kernel
def gather(system: System, ws: Workspace, run: Run):
    """Rows along normal and tangents of everything that touches, and their system, into the workspace.

    Kinds and table rows of the rows into ``unilateral.place``; returns how many there are.
    """
    unilateral = system.unilateral
    mode, place = unilateral.mode, unilateral.place
    come_down(system, ws, run)
    for k in range(mode.shape[0]):
        mode[k, WANTED] = STICKING if mode[k, TOUCHING] == 1 else OPEN
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, WANTED])
    evaluate(system, ws, run)
    couplings, p = system.couplings.joint.shape[0], ws.counts[ROWS]
    for r in range(p):
        place[KINDS, r] = BOTH_WAYS if r < couplings else ONE_WAY
    for k in range(mode.shape[0]):
        if mode[k, WANTED] == STICKING:
            r = ws.active[k, FIRST_ROW]
            place[KINDS, r], place[KINDS, r + 1], place[KINDS, r + 2] = CONE, TANGENT, TANGENT
    return p


@internal_kernel
def impulses(system: System, ws: Workspace, p, largest, share):
    """Solve for the impulses of :func:`impact` with so much of the restitutions; the loss of each row into FORCE [J].

    False when there is no solution, or one that would create energy.
    """
    unilateral, rows = system.unilateral, ws.rows
    vector, mode = unilateral.vector, unilateral.mode
    for r in range(p):
        vector[OFFSET, r], vector[SOLUTION, r] = rows[r, ROW_RATE], 0.0
    for k in range(mode.shape[0]):
        if mode[k, TOUCHING] == 1:
            r = ws.active[k, FIRST_ROW]
            vector[CONE_FRICTION, r] = system.contacts.point[k, MU]
            # What was closed had no speed to turn round: a brake or another impact has just given it this one.
            falls = mode[k, STRUCK] == 1 and mode[k, BEFORE] == OPEN
            if falls and -rows[r, ROW_RATE] > unilateral.tally[k, SETTLE]:
                vector[OFFSET, r] *= 1.0 + share * unilateral.law[k, RESTITUTION]
    residual = solve_cones(
        ws.small[0],
        vector[OFFSET],
        unilateral.place[KINDS],
        vector[CONE_FRICTION],
        p,
        vector[SOLUTION],
        unilateral.room[SCRATCH:],
        1e-2 * CONE_TOLERANCE * max(largest, IMMOBILE),
    )
    if not 0.0 <= residual <= CONE_TOLERANCE * (1.0 + largest):
        return False
    f, total, turnover = vector[SOLUTION], 0.0, 0.0
    for r in range(p):
        after = rows[r, ROW_RATE]
        for s in range(p):
            after += ws.small[0, r, s] * f[s]
        # FORCE is free until the next evaluation.
        rows[r, FORCE] = -0.5 * f[r] * (rows[r, ROW_RATE] + after)
        total += rows[r, FORCE]
        turnover += abs(rows[r, FORCE])
    return total >= -CONE_TOLERANCE * turnover or share == 0.0


@internal_kernel
def impact(system: System, ws: Workspace, run: Run):
    """Impulses that stop what approaches: u = W P + b with b = J v and, of normals that strike, (1 + e) n·v.

    Then v += M⁻¹ Jᵀ P, and the energy −½ P·(J v₋ + J v₊) is booked as impact loss.
    """
    unilateral, y, layout = system.unilateral, run.y, system.layout
    vector, mode, rows, column = unilateral.vector, unilateral.mode, ws.rows, ws.column
    p = gather(system, ws, run)
    largest = 0.0
    for r in range(p):
        largest = max(largest, abs(rows[r, ROW_RATE]))
    # Newton's restitution may contradict friction: a point that is wedged cannot leave, and some would gain energy.
    # Those impacts are without restitution, which always has a solution, and a loss.
    if not impulses(system, ws, p, largest, 1.0) and not impulses(system, ws, p, largest, 0.0):
        run.count[STATUS], run.clock[NOT_UNIQUE] = NO_CONTACT_FORCES, run.clock[TIME]
        return
    f = vector[SOLUTION]
    for i in range(ws.joints.shape[0]):
        column[i, 0] = 0.0
        for r in range(p):
            column[i, 0] += f[r] * column[i, 1 + 2 * r]
    accelerate(system.model, ws)
    for i in range(ws.joints.shape[0]):
        y[layout.v + i] += ws.joints[i, QDD]
    for k in range(mode.shape[0]):
        if mode[k, TOUCHING] == 1:
            r = ws.active[k, FIRST_ROW]
            loss = rows[r, FORCE] + rows[r + 1, FORCE] + rows[r + 2, FORCE]
            unilateral.tally[k, LOSS] += loss
            y[layout.loss + IMPACT_LOSS] += loss
            y[layout.contact + CONTACT_SIZE * k + IMPULSE] += f[r]
    r = system.couplings.joint.shape[0]
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, STOP_CLOSED] == 1:
            unilateral.stop[k, STOP_LOSS] += rows[r, FORCE]
            y[layout.loss + JOINT_STOP_LOSS] += rows[r, FORCE]
            r += 1


@internal_kernel
def choose(system: System, ws: Workspace, run: Run):
    """Modes by the accelerations of all that touches; the rates of what is closed are brought to zero."""
    unilateral = system.unilateral
    mode, vector = unilateral.mode, unilateral.vector
    p = gather(system, ws, run)
    largest = 0.0
    for r in range(p):
        largest = max(largest, abs(ws.rows[r, RHS]))
    for k in range(mode.shape[0]):
        if mode[k, TOUCHING] == 1:
            mode[k, WANTED] = SLIDING if begins_sliding(system, ws, k) else STICKING
    solved = False
    # Where static friction gives way to a smaller kinetic one, the others' forces change.
    for _ in range(1 + mode.shape[0]):
        size = reduce_rows(system, ws, run, p)
        if run.count[STATUS] == FORCES_REVERSED:
            return
        residual = solve_cones(
            unilateral.room[PROBLEM],
            vector[OFFSET],
            unilateral.place[KINDS],
            vector[CONE_FRICTION],
            size,
            vector[SOLUTION],
            unilateral.room[SCRATCH:],
            1e-2 * CONE_TOLERANCE * max(largest, IMMOBILE),
        )
        if not 0.0 <= residual <= CONE_TOLERANCE * (1.0 + largest):
            run.count[STATUS], run.clock[NOT_UNIQUE] = NO_CONTACT_FORCES, run.clock[TIME]
            return
        if not give_way(system, ws, size, largest):
            solved = True
            break
    if not solved:
        run.count[STATUS], run.clock[NOT_UNIQUE] = NO_CONTACT_FORCES, run.clock[TIME]
        return
    take_solution(system, ws, size, largest)
    # What is left of rates after an impact that was let settle, and of points that were solved for as if at rest: those
    # that begin to slip would else go against the direction that they are given, and stop, and begin again.
    for k in range(mode.shape[0]):
        starts = mode[k, WANTED] == SLIDING and unilateral.slide[k, FROZEN] == 1.0
        rests = starts and slip_speed(ws, k) <= 2.0 * unilateral.number[SLOW]
        mode[k, TOUCHING] = STICKING if rests else mode[k, WANTED]
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, TOUCHING])
    # What was split before says nothing of these modes.
    unilateral.number[REDUNDANT], unilateral.number[SPLIT] = 0.0, 0.0
    evaluate(system, ws, run)
    loss = project_level(system, ws, run.y, 1)
    run.y[system.layout.loss + IMPACT_LOSS] += loss
    evaluate(system, ws, run)
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, WANTED])
    before = ws.counts[DEPENDENT]
    evaluate(system, ws, run)
    unilateral.number[REDUNDANT] = 1.0 if ws.counts[DEPENDENT] > before else 0.0
    for k in range(mode.shape[0]):
        starts = mode[k, WANTED] == SLIDING and mode[k, TOUCHING] == STICKING
        unilateral.slide[k, HEADWAY] = max(0.0, -unilateral.slide[k, SPEED]) if starts else 0.0


@internal_kernel
def begins_sliding(system: System, ws: Workspace, k):
    """True for a candidate that slides already, or has no friction to stick with; sets its direction."""
    unilateral = system.unilateral
    slide, state = unilateral.slide, ws.contacts
    speed = slip_speed(ws, k)
    if speed > 2.0 * unilateral.number[SLOW]:
        # An impact may have turned it.
        slide[k, FROZEN] = 0.0
        for s in range(3):
            slide[k, REFERENCE + s] = state[k, SLIP_VELOCITY + s] / speed
        return True
    if unilateral.law[k, STATIC] == 0.0:
        slide[k, FROZEN] = 0.0
        return True
    return False


@internal_kernel
def reduce_rows(system: System, ws: Workspace, run: Run, p):
    """The problem of accelerations in ``unilateral``: a point that slides keeps its normal row alone; returns its size.

    Column of such a row: W (n − μ t). One whose own force would accelerate it against itself sets STATUS (Painlevé).
    """
    unilateral, W = system.unilateral, ws.small[0]
    place, vector, mode, state = unilateral.place, unilateral.vector, unilateral.mode, ws.contacts
    size, first = 0, p
    for k in range(mode.shape[0] - 1, -1, -1):
        if mode[k, TOUCHING] == 1:
            first = ws.active[k, FIRST_ROW]
    for r in range(first):
        place[KINDS, r] = BOTH_WAYS if r < system.couplings.joint.shape[0] else ONE_WAY
        place[TABLE_ROW, r], vector[FIRST_PART, r], vector[SECOND_PART, r] = r, 0.0, 0.0
    size = first
    for k in range(mode.shape[0]):
        if mode[k, TOUCHING] == 0:
            continue
        r = ws.active[k, FIRST_ROW]
        place[TABLE_ROW, size], vector[FIRST_PART, size], vector[SECOND_PART, size] = r, 0.0, 0.0
        if mode[k, WANTED] == SLIDING:
            x, y, z = state[k, SLIP_VELOCITY], state[k, SLIP_VELOCITY + 1], state[k, SLIP_VELOCITY + 2]
            tx, ty, tz, mu = slide_direction(unilateral, system.contacts, k, x, y, z)
            a, b = FIRST_TANGENT, SECOND_TANGENT
            vector[FIRST_PART, size] = -mu * (tx * state[k, a] + ty * state[k, a + 1] + tz * state[k, a + 2])
            vector[SECOND_PART, size] = -mu * (tx * state[k, b] + ty * state[k, b + 1] + tz * state[k, b + 2])
            place[KINDS, size] = ONE_WAY
            size += 1
        else:
            vector[CONE_FRICTION, size] = unilateral.law[k, STATIC]
            for s in range(3):
                place[KINDS, size] = CONE if s == 0 else TANGENT
                place[TABLE_ROW, size], vector[FIRST_PART, size], vector[SECOND_PART, size] = r + s, 0.0, 0.0
                size += 1
    for i in range(size):
        a = place[TABLE_ROW, i]
        vector[OFFSET, i], vector[SOLUTION, i] = -ws.rows[a, RHS], 0.0
        for j in range(size):
            b = place[TABLE_ROW, j]
            value = W[a, b]
            if vector[FIRST_PART, j] != 0.0 or vector[SECOND_PART, j] != 0.0:
                value += vector[FIRST_PART, j] * W[a, b + 1] + vector[SECOND_PART, j] * W[a, b + 2]
            unilateral.room[PROBLEM, i, j] = value
        if place[KINDS, i] == ONE_WAY and W[a, a] > 0.0 and unilateral.room[PROBLEM, i, i] <= 1e-12 * W[a, a]:
            run.count[STATUS], run.clock[NOT_UNIQUE] = FORCES_REVERSED, run.clock[TIME]
    return size


@internal_kernel
def acceleration(unilateral: UnilateralArrays, i, size):
    """Acceleration along row i of the reduced problem."""
    total = unilateral.vector[OFFSET, i]
    for j in range(size):
        total += unilateral.room[PROBLEM, i, j] * unilateral.vector[SOLUTION, j]
    return total


@internal_kernel
def slips(system: System, i, size, largest, mu):
    """True when the contact at row i of the reduced problem, on its cone, is accelerated along its surface."""
    unilateral = system.unilateral
    f = unilateral.vector[SOLUTION]
    friction = math.sqrt(f[i + 1] * f[i + 1] + f[i + 2] * f[i + 2])
    if friction < mu * f[i] * (1.0 - ON_CONE):
        return False
    a, b = acceleration(unilateral, i + 1, size), acceleration(unilateral, i + 2, size)
    return math.sqrt(a * a + b * b) > SLIP_TOLERANCE * largest


@internal_kernel
def begin_slip(system: System, ws: Workspace, k, fx, fy):
    """Candidate k begins to slip against its friction force (fx, fy) along its two tangents."""
    slide, state = system.unilateral.slide, ws.contacts
    size = math.sqrt(fx * fx + fy * fy)
    slide[k, FROZEN] = 1.0
    for s in range(3):
        slide[k, REFERENCE + s] = -(fx * state[k, FIRST_TANGENT + s] + fy * state[k, SECOND_TANGENT + s]) / size
        slide[k, NEXT + s] = slide[k, REFERENCE + s]
    slide[k, NEXT_SPEED] = 0.0


@internal_kernel
def give_way(system: System, ws: Workspace, size, largest):
    """Let what slips over a static coefficient that is larger than the kinetic one slide; True if something does."""
    unilateral = system.unilateral
    place, mode, law, f = unilateral.place, unilateral.mode, unilateral.law, unilateral.vector[SOLUTION]
    changed, i = False, 0
    for k in range(mode.shape[0]):
        if mode[k, TOUCHING] == 0:
            continue
        while place[TABLE_ROW, i] != ws.active[k, FIRST_ROW]:
            i += 1
        drops = law[k, STRIBECK] == 0.0 and law[k, STATIC] > system.contacts.point[k, MU] and f[i] > 0.0
        if mode[k, WANTED] == STICKING and drops and slips(system, i, size, largest, law[k, STATIC]):
            begin_slip(system, ws, k, f[i + 1], f[i + 2])
            mode[k, WANTED] = SLIDING
            changed = True
    return changed


@internal_kernel
def take_solution(system: System, ws: Workspace, size, largest):
    """Modes from the forces of the reduced problem, into WANTED; stops that carry nothing open."""
    unilateral = system.unilateral
    place, mode, f = unilateral.place, unilateral.mode, unilateral.vector[SOLUTION]
    strongest = 0.0
    for i in range(size):
        strongest = max(strongest, abs(f[i]))
    i = system.couplings.joint.shape[0]
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, STOP_CLOSED] == 1:
            unilateral.stop_table[k, STOP_CLOSED] = 1 if f[i] > FORCE_TOLERANCE * strongest else 0
            i += 1
    for k in range(mode.shape[0]):
        if mode[k, TOUCHING] == 0:
            mode[k, WANTED] = OPEN
            continue
        while place[TABLE_ROW, i] != ws.active[k, FIRST_ROW]:
            i += 1
        if not f[i] > FORCE_TOLERANCE * strongest:
            mode[k, WANTED] = OPEN
        elif mode[k, WANTED] == STICKING and slips(system, i, size, largest, unilateral.law[k, STATIC]):
            begin_slip(system, ws, k, f[i + 1], f[i + 2])
            mode[k, WANTED] = SLIDING
