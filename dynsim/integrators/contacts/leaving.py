"""Acceleration of a sticking point without its own force: whether anything presses it against its surface.

Where the rows of sticking points and held joints depend on each other, forces within all friction cones may hold a
point that nothing presses, like a wedge that was never driven in. Then the motion is not unique: in another solution
the point has no force and leaves. If the forces are unique, a point sticks exactly if it would approach its surface
without its force, since where that acceleration is zero, zero force is the solution.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import problem as kc
from dynsim.dynamics.contact.splits import find_splits, normal_is_open
from dynsim.dynamics.contact.unilateral import UnilateralArrays, rows_of_couplings
from dynsim.dynamics.tables import ContactArrays, Workspace
from dynsim.integrators.contacts.impacts import begin_problem, largest_right_side, solve_problem
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Starts of the contact problem of all others; a point for which none finds a solution counts as pressed.
STARTS = 8
# Fraction of the largest right-hand side below which an acceleration counts as zero.
NO_ACCELERATION = 1e-8


@noinline_kernel
def approach_without_force(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """Acceleration of sticking candidate k towards its surface without its own force, right after ``derivative``.

    The contact problem has all other forces: sticking points may slip in it, held joints move and stops open; sliding
    points keep their direction. Positive, by NO_ACCELERATION, if nothing moves the point, so that the guard of a point
    that leaves falls through zero [m/s²].
    """
    index, vector, active, W = unilateral.index, unilateral.vector, ws.active, ws.small[0]
    size = ws.counts[ka.COUPLED]
    begin_problem(unilateral, rows_of_couplings(unilateral, ws), size)
    for j in range(ws.contacts.shape[0]):
        mode, r = active[j, ka.MODE], active[j, ka.FIRST_ROW]
        if j == k or mode == ka.OPEN:
            continue
        vector[ku.CONE_FRICTION, size] = unilateral.number[ku.HOLDING] * contacts.law[j, ka.STATIC]
        for s in range(3 if mode == ka.STICKING else 1):
            index[ku.KINDS, size] = kc.ONE_WAY if mode == ka.SLIDING else kc.CONE if s == 0 else kc.TANGENT
            index[ku.TABLE_ROW, size] = r + s
            size += 1
    largest, first = largest_right_side(ws), active[k, ka.FIRST_ROW]
    for i in range(size):
        a = index[ku.TABLE_ROW, i]
        vector[ku.OFFSET, i], vector[ku.SOLUTION, i] = -ws.rows[a, ka.RHS], 0.0
        # Columns of sliding points have their friction in W already.
        for j in range(size):
            unilateral.room[ku.PROBLEM, i, j] = W[a, index[ku.TABLE_ROW, j]]
    if size > 0 and not solve_problem(unilateral, unilateral.room[ku.PROBLEM], size, largest, STARTS):
        return 1.0
    away = -ws.rows[first, ka.RHS]
    for i in range(size):
        away += W[first, index[ku.TABLE_ROW, i]] * vector[ku.SOLUTION, i]
    return NO_ACCELERATION * largest - away


@internal_kernel
def watch_unpressed(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, h):
    """Add an accepted step to the time of each point that sticks although nothing presses it.

    Only if the split of least norm lies in all cones: equally stiff supports have this split, and hold the point.
    Otherwise the guard of the normal force lets the point leave.
    """
    if unilateral.number[ku.REDUNDANT] == 1.0 and unilateral.number[ku.SPLIT] == 0.0 and ws.counts[ka.STUCK] > 0:
        add_unpressed(contacts, unilateral, ws, h)


@noinline_kernel
def add_unpressed(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, h):
    """:func:`watch_unpressed` where rows depend on each other."""
    find_splits(unilateral, ws)
    for k in range(ws.contacts.shape[0]):
        is_open = ws.active[k, ka.MODE] == ka.STICKING and normal_is_open(unilateral, ws, k)
        if is_open and approach_without_force(contacts, unilateral, ws, k) < 0.0:
            unilateral.tally[k, ku.UNPRESSED] += h
