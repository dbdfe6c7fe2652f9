"""Small dense (Delassus) systems for constraint forces: solver for dependent rows, load sharing, uniqueness test.

All constraints share one row format: up to two links, ROW (the constrained motion is ROW · V), TARGET (the required
J vdot) and DIRECTION (the wrench of a unit force). With sliding friction, row and direction differ, so the p×p matrix
is not symmetric.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone.program import best_split, split_room_in
from dynsim.dynamics.contact.rows import SIGNS_LIMIT
from dynsim.dynamics.contact.unilateral import (
    UnilateralArrays,
    holding_bound,
    note_dry_forces,
    note_stop_forces,
    rows_of_couplings,
)
from dynsim.dynamics.linear import RANK_TOLERANCE, eliminate, least_norm, null_space, orthonormalise
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.articulated import change_accelerations, row_mobilities
from dynsim.jit.kernel import every, internal_kernel, noinline_kernel


@internal_kernel
def solve_small(small, state, p):
    """Solve the leading p×p of ``small[0]`` f = RHS for the constraint forces f, into the FORCE column of ``state``.

    Gaussian elimination with partial pivoting. If a pivot vanishes, :func:`solve_dependent` solves the system again
    and gives the split of least norm among dependent rows. Returns 1 in that case, otherwise 0.

    Parameters
    ----------
    small : (4, p or more, p or more) ndarray
        Matrix, not symmetric under friction, and scratch.
    state : (p or more, ROW_STATE_SIZE) ndarray
        Table of rows.
    """
    if p == 1 and every(abs(small[0, 0, 0]) > state[0, ka.ROW_FLOOR]):
        state[0, ka.FORCE] = state[0, ka.RHS] / small[0, 0, 0]
        return 0
    if p == 1 and every(abs(small[0, 0, 0]) <= state[0, ka.ROW_FLOOR]):
        state[0, ka.FORCE] = 0.0
        return 0
    if p == 2:
        a, b, c, d = small[0, 0, 0], small[0, 0, 1], small[0, 1, 0], small[0, 1, 1]
        determinant = a * d - b * c
        # For a well-conditioned matrix, Cramer's rule is as accurate as elimination.
        floors = state[0, ka.ROW_FLOOR] * state[1, ka.ROW_FLOOR]
        if every(abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)) + floors):
            x, y = state[0, ka.RHS] / determinant, state[1, ka.RHS] / determinant
            state[0, ka.FORCE], state[1, ka.FORCE] = d * x - b * y, a * y - c * x
            return 0
    return solve_many(small, state, p)


@noinline_kernel
def solve_many(small, state, p):
    """Solve as :func:`solve_small` for any number of rows, without closed-form solutions."""
    force = state[:, ka.FORCE]
    for i in range(p):
        force[i] = state[i, ka.RHS]
        for j in range(p):
            small[1, i, j] = small[0, i, j]
    if eliminate(small[1], force, p, dependent_pivot(small, state, p)) != 0.0:
        return 0
    return solve_dependent(small, state, p)


@noinline_kernel
def solve_dependent(small, state, p):
    """Solve as :func:`solve_small` for rows that are known to depend on each other.

    Pivots in the order of the columns may not reveal the dependence: the last pivot is the reciprocal of an entry of
    the inverse matrix and is large for a row that hardly takes part in the dependence. The forces would then be as
    large as rounding allows.
    """
    rank = least_norm(small, state[:, ka.RHS], state[:, ka.FORCE], p, dependent_pivot(small, state, p))
    return 1 if rank < p else 0


@internal_kernel
def dependent_pivot(small, state, p):
    """Return the size of a pivot, or of the rest of a row, that counts as zero."""
    largest, floor = 0.0, 0.0
    for i in range(p):
        # A row without mobility is dependent even if no other row has a larger mobility.
        floor = max(floor, state[i, ka.ROW_FLOOR])
        for j in range(p):
            largest = max(largest, abs(small[0, i, j]))
    return max(RANK_TOLERANCE * largest, floor)


# Split of forces among dependent rows of sticking points, held joints and stops, within their bounds if possible.


# A unit split direction whose component along a normal row is smaller than this does not change that normal force.
NORMAL_PART = 1e-6
# Value used instead of a bound for stops, which push in one direction only.
ONE_WAY = -1.0


@internal_kernel
def margin(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """Return μ_s f_n − |f_t| of sticking candidate k [N]."""
    r, rows = ws.active[k, ka.FIRST_ROW], ws.rows
    a, b = rows[r + 1, ka.FORCE], rows[r + 2, ka.FORCE]
    return unilateral.number[ku.HOLDING] * contacts.law[k, ka.STATIC] * rows[r, ka.FORCE] - math.sqrt(a * a + b * b)


@internal_kernel
def dry_margin(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the margin of the dry friction that holds a joint: its bound minus its magnitude [N m or N]."""
    return holding_bound(unilateral, k) - abs(ws.rows[unilateral.dry_table[k, ku.DRY_ROW], ka.FORCE])


@internal_kernel
def admissible_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Replace forces of dependent sticking rows that exceed their bounds, and record forces of joints.

    The forces change within the null space of the rows, so accelerations change only if rows are not fully dependent.
    """
    if unilateral is None:  # resolved at compile time
        return
    # This function is kept small, because it is inlined into the right-hand side.
    if unilateral.number[ku.REDUNDANT] == 1.0 or unilateral.stop.shape[0] + unilateral.dry.shape[0] > 0:
        check_forces(model, contacts, unilateral, ws)


@noinline_kernel
def check_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """Implement :func:`admissible_forces` for systems with dependent rows, stops or dry friction."""
    unilateral.number[ku.SPLIT] = 0.0
    if unilateral.number[ku.REDUNDANT] == 1.0 and beyond_bounds(contacts, unilateral, ws):
        split_forces(model, contacts, unilateral, ws)
    note_stop_forces(unilateral, ws)
    note_dry_forces(unilateral, ws)


@internal_kernel
def beyond_bounds(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """Return whether a sticking point or held joint needs more force than friction allows, or a closed stop pulls."""
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING and margin(contacts, unilateral, ws, k) < 0.0:
            return True
    for r in range(rows_of_couplings(unilateral, ws), ws.counts[ka.COUPLED]):
        bound, force = bound_of_row(unilateral, ws, r), ws.rows[r, ka.FORCE]
        if (force if bound == ONE_WAY else bound - abs(force)) < 0.0:
            return True
    return False


@internal_kernel
def bound_of_row(unilateral: UnilateralArrays, ws: Workspace, r):
    """Return the dry friction that may hold the joint of row r, or ONE_WAY if it is a closed stop."""
    k = ws.active[r, ka.OWNER] - rows_of_couplings(unilateral, ws) - unilateral.stop_table.shape[0]
    return holding_bound(unilateral, k) if k >= 0 else ONE_WAY


@noinline_kernel
def split_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """Write the best split of all sticking forces to FORCE of the rows, and its worst margin to BEST_MARGIN.

    The pivots of J M⁻¹ Jᵀ are squares: rows that count as dependent at a pivot of 1e-10 may differ by 1e-5, and then a
    change of the split changes accelerations by this fraction. The accelerations are updated to agree with the forces.
    """
    room, index, mu, rows = unilateral.room, unilateral.index, unilateral.vector[0], ws.rows
    first, row = index[0], index[1]
    points, count, p, ties = find_splits(unilateral, ws)
    for j in range(points):
        mu[j] = unilateral.number[ku.HOLDING] * contacts.law[ws.active[row[first[j]], ka.OWNER], ka.STATIC]
    for j in range(points, count):
        mu[j] = bound_of_row(unilateral, ws, row[first[j]])
    force, out = unilateral.vector[1], unilateral.vector[2]
    for i in range(p):
        force[i] = rows[row[i], ka.FORCE]
    width = int(unilateral.number[ku.WIDTH])
    unilateral.number[ku.SPLIT] = 1.0
    programs = split_room_in(unilateral.split_room, index[2], width, count)
    worst = best_split(
        force[:p], room[ku.NULL_SPACE], width, first, mu, points, count - points, out[:p], programs, True
    )
    unilateral.number[ku.BEST_MARGIN] = worst
    column = ws.column
    for m in range(column.shape[0]):
        column[m, 0] = 0.0
    for i in range(p + ties):
        change = out[i] - force[i] if i < p else change_of_coupling(room[ku.NULL_SPACE], width, i, force, out, p)
        rows[row[i], ka.FORCE] = out[i] if i < p else rows[row[i], ka.FORCE] + change
        for m in range(column.shape[0]):
            column[m, 0] += change * column[m, 2 + 2 * row[i]]
    change_accelerations(model, ws)


@internal_kernel
def change_of_coupling(N, width, i, force, out, p):
    """Return the change of coupling force i when forces of the leading p rows change from ``force`` to ``out``."""
    total = 0.0
    for c in range(width):
        part = 0.0
        for j in range(p):
            part += N[j, c] * (out[j] - force[j])
        total += N[i, c] * part
    return total


@internal_kernel
def find_splits(unilateral: UnilateralArrays, ws: Workspace):
    """Write the directions in which sticking forces may change to NULL_SPACE; call right after ``derivative``.

    index[0] contains the first row of each sticking point, then of each held joint, then of each closed stop. index[1]
    contains the table rows of these rows, followed by the coupling rows, whose forces change with the other forces but
    have no bounds.

    Returns
    -------
    points : int
        Number of sticking points.
    count : int
        Number of sticking points, held joints and closed stops.
    p : int
        Number of the rows of these points, joints and stops.
    ties : int
        Number of coupling rows.
    """
    room, first, row = unilateral.room, unilateral.index[0], unilateral.index[1]
    count, p = 0, 0
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING:
            first[count] = p
            for s in range(3):
                row[p] = ws.active[k, ka.FIRST_ROW] + s
                p += 1
            count += 1
    points = count
    ties = rows_of_couplings(unilateral, ws)
    for r in range(ties, ws.counts[ka.COUPLED]):
        first[count], row[p] = p, r
        p += 1
        count += 1
    for r in range(ties):
        row[p + r] = r
    size = p + ties
    for i in range(size):
        for j in range(size):
            room[ku.SPLIT_MATRIX, i, j] = ws.small[0, row[i], row[j]]
    unilateral.number[ku.WIDTH] = null_space(room[ku.SPLIT_MATRIX], size, room[ku.NULL_SPACE], p)
    unilateral.number[ku.SPLIT_ROWS] = p
    return points, count, p, ties


@internal_kernel
def first_split_row(ws: Workspace, k):
    """Return the first row of sticking candidate k in the last splits."""
    row = 0
    for j in range(k):
        row += ka.MOST_ROWS if ws.active[j, ka.MODE] == ka.STICKING else 0
    return row


@internal_kernel
def normal_is_open(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether the last splits leave the normal force of sticking candidate k undetermined."""
    return row_shares(unilateral, first_split_row(ws, k))


@internal_kernel
def point_shares(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether the last splits leave a force of sticking candidate k undetermined."""
    row = first_split_row(ws, k)
    return row_shares(unilateral, row) or row_shares(unilateral, row + 1) or row_shares(unilateral, row + 2)


@internal_kernel
def joint_shares(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return whether the last splits leave the dry friction that holds joint k undetermined."""
    row = ka.MOST_ROWS * ws.counts[ka.STUCK]
    for j in range(k):
        row += unilateral.dry_table[j, ku.DRY_HOLDS]
    return row_shares(unilateral, row)


@internal_kernel
def row_shares(unilateral: UnilateralArrays, row):
    """Return whether the last splits leave the force in a given row undetermined."""
    largest = 0.0
    for c in range(int(unilateral.number[ku.WIDTH])):
        largest = max(largest, abs(unilateral.room[ku.NULL_SPACE, row, c]))
    return largest > NORMAL_PART


@internal_kernel
def stops_that_share(unilateral: UnilateralArrays):
    """Return the number of closed stops whose forces the last splits leave undetermined."""
    sharing, closed = 0, 0
    for k in range(unilateral.stop_table.shape[0]):
        closed += unilateral.stop_table[k, ku.STOP_CLOSED]
    size = int(unilateral.number[ku.SPLIT_ROWS])
    for i in range(size - closed, size):
        sharing += 1 if row_shares(unilateral, i) else 0
    return sharing


# Test whether the contact forces are uniquely determined, from the determinant and the diagonal of J M⁻¹ F.


UNIQUE, REVERSED, SEVERAL = 0, 1, 2

# Blocks of the scratch array ``room``, (ROOM, p, p); only the first row of SIGNS and FORCES is used.
FRICTIONLESS, FRICTION, BASIS, MATRIX, PRODUCT, SIGNS, FORCES = 0, 1, 2, 3, 4, 5, 6
ROOM = 7
# A determinant above this fraction of the sum of the magnitudes of its terms is clearly positive.
CLEAR = 1e-3
# A normal mobility below this fraction of the mobility along the force is the square of a rounding error.
IMMOBILE = 1e-24
# Rounding tolerances: below these fractions, a diagonal entry or a force has no sign, and two solutions count as equal.
DIAGONAL_TOLERANCE = 1e-12
FORCE_TOLERANCE = 1e-9


@internal_kernel
def clearly_unique(ws: Workspace):
    """Return whether at most two rows, without dissipative friction, have a clearly positive determinant.

    Without rows, the result is True. This function is small, because it is inlined into the step: passing the tables to
    the full check costs as much as a sweep.
    """
    small, p = ws.small, ws.counts[ka.ROWS]
    if p == 0 or p > 2:
        return p == 0
    for k in range(p):
        if ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE or not every(small[0, k, k] > 0.0):
            return False
    if p == 1:
        return True
    straight, crossed = small[0, 0, 0] * small[0, 1, 1], small[0, 0, 1] * small[0, 1, 0]
    return every(straight - crossed > CLEAR * (straight + abs(crossed)))


@internal_kernel
def dominant(ws: Workspace, room):
    """Return whether contacts are frictionless or every A(σ) is strictly diagonally dominant, hence not singular."""
    small, p = ws.small, ws.counts[ka.ROWS]
    frictional = False
    for k in range(p):
        frictional = frictional or ws.rows[k, ka.ROW_MU] > 0.0
    if not frictional:
        return True
    for k in range(p):
        if not small[0, k, k] > 0.0:
            return False
    split_matrix(ws, room)
    for k in range(p):
        others = 0.0
        for m in range(p):
            others += abs(room[FRICTION, k, m])
            if m != k:
                others += abs(room[FRICTIONLESS, k, m])
        if not room[FRICTIONLESS, k, k] > others:
            return False
    return True


@internal_kernel
def split_matrix(ws: Workspace, room):
    """Write A0 and B to ``room``, from the eliminated rows and the matrix that the derivative left in ``ws``."""
    p = ws.counts[ka.ROWS]
    row_mobilities(ws, room[FRICTIONLESS])
    for k in range(p):
        for m in range(p):
            sign = ws.rows[m, ka.SIGN] if ws.active[m, ka.LAW] == ka.FRICTION_DISSIPATIVE else 1.0
            room[FRICTION, k, m] = sign * (room[FRICTIONLESS, k, m] - ws.small[0, k, m])


@internal_kernel
def force_verdict(ws: Workspace, room, since, t):
    """Return UNIQUE, or the reason why the constraint forces are not unique; call right after ``derivative``.

    REVERSED: the determinant of J M⁻¹ F with the present signs, relative to the frictionless determinant, is not
    positive, or every diagonal entry is negative. SEVERAL: other signs of dissipative contacts also agree with their
    forces.

    Parameters
    ----------
    room : (ROOM or more, p or more, p or more) ndarray
        Scratch.
    since : (c,) ndarray
        First time at which the contact's diagonal entry was negative [s], or inf if it never was; updated here.
    """
    if dominant(ws, room):
        return UNIQUE
    split_matrix(ws, room)
    drop_immobile(ws, room)
    p = ws.counts[ka.ROWS]
    rank = frictionless_basis(room, p)
    negative, free = 0, 0
    for k in range(p):
        own = room[FRICTIONLESS, k, k]
        if own > 0.0 and ws.small[0, k, k] < -DIAGONAL_TOLERANCE * own:
            negative += 1
            # Only the frictional row of a sliding point can have a negative entry.
            owner = ws.active[k, ka.OWNER]
            since[owner] = min(since[owner], t)
        if ws.rows[k, ka.ROW_MU] > 0.0 and ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
            free += 1
    reverse, doubtful, several = negative == p, negative == p, False
    for choice in range(1 << free if free <= SIGNS_LIMIT else free + 1):
        index = 0
        for k in range(p):
            sign = 1.0
            if ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
                sign = ws.rows[k, ka.SIGN]
                if ws.rows[k, ka.ROW_MU] > 0.0:
                    turned = (choice >> index) & 1 == 1 if free <= SIGNS_LIMIT else choice == index + 1
                    sign = -sign if turned else sign
                    index += 1
            room[SIGNS, 0, k] = sign
        determinant = solve_choice(ws, room, rank)
        if determinant <= 0.0:
            doubtful = True
            reverse = reverse or choice == 0
        if choice > 0 and determinant != 0.0 and rank == p and another_solution(ws, room):
            several = True
    if doubtful and several:
        return SEVERAL
    return REVERSED if reverse else UNIQUE


@internal_kernel
def drop_immobile(ws: Workspace, room):
    """Zero the rows of points that no joint moves along their normals; the entries are rounding errors of any sign."""
    p = ws.counts[ka.ROWS]
    for k in range(p):
        along = 0.0
        for i in range(ws.column.shape[0]):
            along += ws.column[i, 2 + 2 * k] * ws.column[i, 2 + 2 * k] * ws.links[i, ka.INVERSE_D]
        if room[FRICTIONLESS, k, k] <= max(IMMOBILE * along, ws.rows[k, ka.ROW_FLOOR]):
            for m in range(p):
                room[FRICTIONLESS, k, m], room[FRICTIONLESS, m, k], room[FRICTION, k, m] = 0.0, 0.0, 0.0


@internal_kernel
def frictionless_basis(room, p):
    """Write an orthonormal basis of the range of A0, (rank, p), to ``room[BASIS]``; return the rank."""
    largest = 0.0
    for k in range(p):
        largest = max(largest, room[FRICTIONLESS, k, k])
        for m in range(p):
            room[BASIS, k, m] = room[FRICTIONLESS, k, m]
    return orthonormalise(room[BASIS], p, p, RANK_TOLERANCE * largest)


@internal_kernel
def solve_choice(ws: Workspace, room, rank):
    """Return the sign of the determinant of A(σ) for the signs in ``room``; forces go to ``room[FORCES, 0]``.

    For dependent rows, Q A(σ) Qᵀ is used, with the basis Q of the range of A0: supports of equal stiffness have these
    forces.
    """
    p = ws.counts[ka.ROWS]
    target = MATRIX if rank == p else PRODUCT
    for k in range(p):
        room[FORCES, 0, k] = ws.rows[k, ka.RHS]
        for m in range(p):
            room[target, k, m] = room[FRICTIONLESS, k, m] - room[FRICTION, k, m] * room[SIGNS, 0, m]
    if rank < p:
        for r in range(rank):
            for s in range(rank):
                total = 0.0
                for k in range(p):
                    for m in range(p):
                        total += room[BASIS, r, k] * room[PRODUCT, k, m] * room[BASIS, s, m]
                room[MATRIX, r, s] = total
    return eliminate(room[MATRIX], room[FORCES, 0], rank, 0.0)


@internal_kernel
def another_solution(ws: Workspace, room):
    """Return whether the forces in ``room`` have the signs assumed for them and differ from the forces in ``ws``."""
    largest, difference, p = 0.0, 0.0, ws.counts[ka.ROWS]
    for k in range(p):
        force = room[FORCES, 0, k]
        largest = max(largest, abs(force), abs(ws.rows[k, ka.FORCE]))
        difference = max(difference, abs(force - ws.rows[k, ka.FORCE]))
    if not difference > FORCE_TOLERANCE * largest:
        return False
    for k in range(p):
        free = ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE
        if free and room[FORCES, 0, k] * room[SIGNS, 0, k] < -FORCE_TOLERANCE * largest:
            return False
    return True
