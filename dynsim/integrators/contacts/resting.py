"""Joints at rest that dry friction holds by a constant force instead of a row, because other rows hold them too.

The equations of motion do not determine how such a joint and the other rows share the load. The choice of modes gives
one solution; the joint gets its force from the solution with the same motion and the best worst-case margin. If another
joint were at its bound, the next change of forces would end this load sharing, and modes would be chosen again
endlessly.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.cone.program import best_split, split_room_in
from dynsim.dynamics.contact.delassus import ONE_WAY, change_of_coupling, solve_small
from dynsim.dynamics.contact.shares import some_slide
from dynsim.dynamics.contact.unilateral import UnilateralArrays, dry_bound, dry_rests, dry_rows_held
from dynsim.dynamics.derivative import System
from dynsim.dynamics.linear import RANK_TOLERANCE, null_space
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.articulated import row_mobilities
from dynsim.integrators.contacts.impacts import FORCE_TOLERANCE, take_modes
from dynsim.integrators.run import Run, project_level
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Largest fraction of its friction bound that a joint at rest may carry: slightly below 1, to distinguish it from
# sliding.
NEARLY_ALL = 1.0 - 1e-15
# Fraction of a joint's mobility that other rows leave. Below NEARLY_DEPENDENT, no friction could hold the joint by a
# row; below ROUNDING, or below its rounding error, the row of the joint depends on the other rows.
NEARLY_DEPENDENT, ROUNDING = 1e-6, 1e-12
# Relative rounding error of mobilities, which are sums over joints.
ROUNDINGS = 1e-15
# Value of DRY_NEXT: the joint rests without a row from now on.
RELEASED = 2


@internal_kernel
def release_dependent_joints(system: System, ws: Workspace, size):
    """Hold joints at rest that sliding contacts or stops also hold by the force of the solution instead of a row.

    The row of such a joint depends on the normal rows, and the way they share a force changes the friction of sliding
    points, so that no split in the right-hand side would equal the solution. At rest, Coulomb's law admits any force
    within the bound. Rows that depend only on rows of sticking points and other joints remain, see
    :mod:`dynsim.dynamics.contact.delassus`. Rows that depend on them only nearly do not remain: holding such a joint
    would take unbounded forces, and the order of pivots would decide whether it is held.

    Parameters
    ----------
    size : int
        Size of the solved problem.

    Returns
    -------
    margin : float
        Worst margin of the chosen solution, as a fraction of its largest force; infinite if no joint was released.
    """
    unilateral, W = system.unilateral, ws.small[0]
    table, mode, bare, whole = unilateral.dry_table, unilateral.mode, 0, 0
    bare_factor, whole_factor = unilateral.room[ku.SPLIT_MATRIX], unilateral.room[ku.NULL_SPACE]
    bare_row, whole_row = unilateral.index[0], unilateral.index[1]
    blocked, released = some_slide(mode[:, ku.WANTED]), 0
    for k in range(unilateral.stop_table.shape[0]):
        blocked = blocked or unilateral.stop_table[k, ku.STOP_CLOSED] == 1
    if table.shape[0] == 0:
        return math.inf
    for r in range(system.couplings.joint.shape[0]):
        bare = extended(bare_factor, W, bare_row, bare, r)
    for k in range(mode.shape[0]):
        for s in range(3 if mode[k, ku.WANTED] == ka.STICKING else 0):
            bare = extended(bare_factor, W, bare_row, bare, ws.active[k, ka.FIRST_ROW] + s)
    for i in range(bare):
        whole = extended(whole_factor, W, whole_row, whole, bare_row[i])
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            whole = extended(whole_factor, W, whole_row, whole, unilateral.stop_table[k, ku.STOP_ROW])
    for k in range(mode.shape[0]):
        if mode[k, ku.WANTED] == ka.SLIDING:
            whole = extended(whole_factor, W, whole_row, whole, ws.active[k, ka.FIRST_ROW])
    for k in range(table.shape[0]):
        if table[k, ku.DRY_NEXT] == 0:
            continue
        r = table[k, ku.DRY_ROW]
        alone = mobility_left(bare_factor, W, bare_row, bare, r) / W[r, r]
        noise = rounding_left(bare_factor, W, bare_row, bare, r) / W[r, r]
        among_all = mobility_left(whole_factor, W, whole_row, whole, r) / W[r, r]
        blocks = blocked and alone > max(RANK_TOLERANCE, noise) and among_all <= NEARLY_DEPENDENT
        if blocks or max(ROUNDING, noise) < alone <= NEARLY_DEPENDENT:
            table[k, ku.DRY_NEXT], released = RELEASED, released + 1
        else:
            bare, whole = extended(bare_factor, W, bare_row, bare, r), extended(whole_factor, W, whole_row, whole, r)
    margin = take_widest_split(system, ws, size) if released > 0 else math.inf
    for k in range(table.shape[0]):
        if table[k, ku.DRY_NEXT] == RELEASED:
            rest_without_row(unilateral, k)
    return margin


@noinline_kernel
def take_widest_split(system: System, ws: Workspace, size):
    """Replace the solution by the solution with the same motion and the best worst-case margin.

    The problem has ``size`` rows. Forces that only act against each other may change: forces of joints at rest, closed
    stops and sticking points within their bounds, and forces of sliding points along their total force. Sliding
    friction keeps its ratio to the normal force, also if slip only begins. Returns the margin as a fraction of the
    largest force.
    """
    unilateral, table = system.unilateral, system.unilateral.dry_table
    vector, kinds, N = unilateral.vector, unilateral.index[ku.KINDS], unilateral.room[ku.NULL_SPACE]
    f, first, row = vector[ku.SOLUTION], unilateral.index[0], unilateral.index[1]
    mu, force, out = vector[0], vector[1], vector[2]
    couplings = system.couplings.joint.shape[0]
    after, count, p = couplings + dry_rows_held(unilateral), 0, 0
    for i in range(after, size):
        if kinds[i] == kc.CONE and f[i] > 0.0 and sticks(unilateral, ws, i):
            first[count], mu[count] = p, vector[ku.CONE_FRICTION, i]
            for s in range(3):
                row[p] = i + s
                p += 1
            count += 1
    points = count
    for k in range(table.shape[0]):
        if table[k, ku.DRY_HOLDS] == 1 and table[k, ku.DRY_NEXT] != 0:
            first[count], mu[count], row[p] = p, vector[ku.CONE_FRICTION, table[k, ku.DRY_ROW]], table[k, ku.DRY_ROW]
            p += 1
            count += 1
    bounded = p
    for i in range(after, size):
        slides = kinds[i] == kc.CONE and not sticks(unilateral, ws, i)
        if f[i] > 0.0 and (slides or kinds[i] == kc.ONE_WAY):
            if slides:
                vector[ku.FIRST_PART, i], vector[ku.SECOND_PART, i] = f[i + 1] / f[i], f[i + 2] / f[i]
            first[count], mu[count], row[p] = p, ONE_WAY, i
            p += 1
            count += 1
    for i in range(couplings):
        row[p + i] = i
    whole = p + couplings
    for i in range(whole):
        for j in range(whole):
            unilateral.room[ku.SPLIT_MATRIX, i, j] = mobility_along_forces(unilateral, ws, row[i], row[j])
    width = null_space(unilateral.room[ku.SPLIT_MATRIX], whole, N, p)
    largest = 0.0
    for i in range(p):
        force[i] = f[row[i]]
        largest = max(largest, abs(force[i]))
    programs = split_room_in(unilateral.split_room, unilateral.index[2], width, count)
    worst = best_split(force[:p], N, width, first, mu, points, count - points, out[:p], programs, False)
    for i in range(p, whole):
        f[row[i]] += change_of_coupling(N, width, i, force, out, p)
    for i in range(p):
        f[row[i]] = out[i]
        if i >= bounded and kinds[row[i]] == kc.CONE:
            f[row[i] + 1], f[row[i] + 2] = (
                vector[ku.FIRST_PART, row[i]] * out[i],
                vector[ku.SECOND_PART, row[i]] * out[i],
            )
    return worst / largest if largest > 0.0 else math.inf


@internal_kernel
def mobility_along_forces(unilateral: UnilateralArrays, ws: Workspace, i, j):
    """Return the mobility between rows i and j of the solved problem along total forces, including sliding friction."""
    vector, total = unilateral.vector, 0.0
    a, b = unilateral.index[ku.TABLE_ROW, i], unilateral.index[ku.TABLE_ROW, j]
    for s in range(3):
        x = 1.0 if s == 0 else vector[ku.FIRST_PART + s - 1, i]
        for t in range(3):
            y = 1.0 if t == 0 else vector[ku.FIRST_PART + t - 1, j]
            # Rows without tangential parts may be the last rows of the table.
            if x != 0.0 and y != 0.0:
                total += x * y * ws.small[0, a + s, b + t]
    return total


@internal_kernel
def sticks(unilateral: UnilateralArrays, ws: Workspace, i):
    """Return whether row i of the solved problem is the normal row of a candidate that sticks in the chosen modes."""
    for k in range(unilateral.mode.shape[0]):
        if unilateral.mode[k, ku.TOUCHING] == 1 and ws.active[k, ka.FIRST_ROW] == unilateral.index[ku.TABLE_ROW, i]:
            return unilateral.mode[k, ku.WANTED] == ka.STICKING
    return False


@internal_kernel
def rest_without_row(unilateral: UnilateralArrays, k):
    """Keep dry-friction joint k at rest by a constant force, taken from the solution."""
    # Rows of joints come first, so their numbers are the same in the reduced problem.
    share = -unilateral.vector[ku.SOLUTION, unilateral.dry_table[k, ku.DRY_ROW]] / dry_bound(unilateral, k)
    unilateral.dry_table[k, ku.DRY_NEXT] = 0
    unilateral.dry[k, ku.DRY_SIDE] = min(max(share, -NEARLY_ALL), NEARLY_ALL)


@noinline_kernel
def hold_free_joints(system: System, ws: Workspace, run: Run, begins):
    """Give rows to joints that rest by a constant force and that contacts and stops no longer hold.

    Call this function after single modes have changed, at the end of an accepted step. If slip ``begins`` somewhere, a
    joint at its friction bound moves with the contact or stop that held it; if it had a row, it would stick and break
    loose at once.
    """
    unilateral, y = system.unilateral, run.y
    table, dry = unilateral.dry_table, unilateral.dry
    W, factor, row = ws.small[0], unilateral.room[ku.SPLIT_MATRIX], unilateral.index[0]
    for k in range(table.shape[0]):
        rests = abs(ws.joints[table[k, ku.DRY_JOINT], ka.QD]) <= unilateral.number[ku.CREEP]
        moves = begins and abs(dry[k, ku.DRY_SIDE]) >= 1.0 - FORCE_TOLERANCE
        free = rests_without_row(unilateral, k) and rests and not moves
        table[k, ku.DRY_NEXT] = 1 if free else 0
        if free:
            table[k, ku.DRY_HOLDS], dry[k, ku.DRY_AT] = 1, ws.joints[table[k, ku.DRY_JOINT], ka.Q]
    take_modes(system, ws, run)
    p, count = ws.counts[ka.ROWS], 0
    row_mobilities(ws, W)
    # The rows of the joints to be tested come last.
    for r in range(p):
        index = -1
        for k in range(table.shape[0]):
            if table[k, ku.DRY_NEXT] == 1 and table[k, ku.DRY_ROW] == r:
                index = k
        if index < 0:
            count = extended(factor, W, row, count, r)
    for k in range(table.shape[0]):
        if table[k, ku.DRY_NEXT] == 1:
            r = table[k, ku.DRY_ROW]
            # This is the limit below which a row is released, see release_dependent_joints().
            free = mobility_left(factor, W, row, count, r) > NEARLY_DEPENDENT * W[r, r]
            table[k, ku.DRY_HOLDS] = 1 if free else 0
            count = extended(factor, W, row, count, r) if free else count
    take_modes(system, ws, run)
    y[system.layout.loss + kst.IMPACT_LOSS] += project_level(system, ws, y, 1)


@internal_kernel
def some_rest_without_row(unilateral: UnilateralArrays):
    """Return whether any joint rests by a constant force."""
    resting = 0
    for k in range(unilateral.dry_table.shape[0]):
        resting += 1 if rests_without_row(unilateral, k) else 0
    return resting > 0


@internal_kernel
def rests_without_row(unilateral: UnilateralArrays, k):
    """Return whether dry-friction joint k rests by a constant force and without a closed brake."""
    table = unilateral.dry_table
    return table[k, ku.DRY_HOLDS] == 0 and table[k, ku.DRY_BRAKE] != ku.CLOSED and dry_rests(unilateral, k)


@internal_kernel
def extended(factor, W, row, count, r):
    """Extend a Cholesky factor of rows ``row[:count]`` of W by row r, unless r depends on them; return the count."""
    square = mobility_left(factor, W, row, count, r)
    if not square > max(RANK_TOLERANCE * W[r, r], rounding_left(factor, W, row, count, r)):
        return count
    factor[count, count], row[count] = math.sqrt(square), r
    return count + 1


@internal_kernel
def mobility_left(factor, W, row, count, r):
    """Return the mobility along row r that the rows of a Cholesky factor leave; write row ``count`` of the factor."""
    square = W[r, r]
    for i in range(count):
        total = W[r, row[i]]
        for j in range(i):
            total -= factor[count, j] * factor[i, j]
        factor[count, i] = total / factor[i, i]
        square -= factor[count, i] * factor[count, i]
    return square


@internal_kernel
def rounding_left(factor, W, row, count, r):
    """Return the possible rounding error in the result of the preceding call of :func:`mobility_left`.

    That result is w·W w for the combination w = (−x, 1) of the rows and row r; forces x along the rows cancel the
    effect of a unit force along row r on them. An error δ √(W_ii W_jj) of each entry changes it by δ (Σ |w_i| √W_ii)²,
    which is large if the rows nearly depend on each other, because x is then large. The part of the factor above its
    diagonal is scratch.
    """
    size = math.sqrt(W[r, r])
    for i in range(count - 1, -1, -1):
        total = factor[count, i]
        for j in range(i + 1, count):
            total -= factor[j, i] * factor[j, count]
        factor[i, count] = total / factor[i, i]
        size += abs(factor[i, count]) * math.sqrt(W[row[i], row[i]])
    return ROUNDINGS * size * size


@internal_kernel
def projection_residual(ws: Workspace, small, column, errors):
    """Write the residual that projection leaves in a column of the rows (gaps or rates), right after ``derivative``.

    RHS and FORCE of the rows, and ``small``, are used as scratch.
    """
    rows, p = ws.rows, ws.counts[ka.ROWS]
    for r in range(p):
        rows[r, ka.RHS] = rows[r, column]
    row_mobilities(ws, small[0])
    solve_small(small, rows, p)
    for r in range(p):
        errors[r] = rows[r, column]
        for s in range(p):
            errors[r] -= small[0, r, s] * rows[s, ka.FORCE]
