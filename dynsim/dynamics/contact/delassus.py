"""Small dense (Delassus) systems of constraint forces: solver for dependent rows, split of the load, uniqueness test.

One row format serves every constraint: up to two links, ROW (the constrained motion is ROW · V), TARGET (the required
J vdot) and DIRECTION (the wrench of a unit force). Under sliding friction row and direction differ, so the p×p matrix
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
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.articulated import change_accelerations
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# A pivot below this fraction of the largest entry counts as a dependent row: far above rounding (1e-16 times a few
# dozen operations), far below the pivots of independent elbows (> 1e-6).
RANK_TOLERANCE = 1e-10


@internal_kernel
def solve_small(small, state, active, p):
    """Solve the leading p×p of ``small[0]`` f = RHS for the constraint forces f, into the FORCE column of ``state``.

    Gaussian elimination with partial pivoting. If a pivot vanishes, :func:`least_norm` solves the system again and
    gives the split of least norm among dependent rows. Returns 1 in that case, otherwise 0.

    Parameters
    ----------
    small : (4, p or more, p or more) ndarray
        Matrix, not symmetric under friction, and scratch.
    state : (p or more, ROW_STATE_SIZE) ndarray
        Table of rows.
    active : (p or more, ACTIVE_SIZE) ndarray of int
        Table of active rows.
    """
    if p == 1 and abs(small[0, 0, 0]) > state[0, ka.ROW_FLOOR]:
        state[0, ka.FORCE] = state[0, ka.RHS] / small[0, 0, 0]
        return 0
    if p == 1 and abs(small[0, 0, 0]) <= state[0, ka.ROW_FLOOR]:
        state[0, ka.FORCE] = 0.0
        return 0
    if p == 2:
        a, b, c, d = small[0, 0, 0], small[0, 0, 1], small[0, 1, 0], small[0, 1, 1]
        determinant = a * d - b * c
        # Well conditioned: Cramer's rule is as accurate as elimination.
        floors = state[0, ka.ROW_FLOOR] * state[1, ka.ROW_FLOOR]
        if abs(determinant) > 1e-3 * (abs(a * d) + abs(b * c)) + floors:
            x, y = state[0, ka.RHS] / determinant, state[1, ka.RHS] / determinant
            state[0, ka.FORCE], state[1, ka.FORCE] = d * x - b * y, a * y - c * x
            return 0
    return eliminate(small, state, active, p)


@noinline_kernel
def eliminate(small, state, active, p):
    """Do the work of :func:`solve_small` for any number of rows, without closed forms."""
    largest = largest_entry(small, state, p)
    for i in range(p):
        state[i, ka.FORCE] = state[i, ka.RHS]
        for j in range(p):
            small[1, i, j] = small[0, i, j]
    for k in range(p):
        best = k
        for i in range(k + 1, p):
            if abs(small[1, i, k]) > abs(small[1, best, k]):
                best = i
        # Written so that NaN falls through to plain elimination, where the integrator detects it.
        if abs(small[1, best, k]) <= RANK_TOLERANCE * largest:
            return least_norm(small, state, active, p, largest)
        if best != k:
            for j in range(p):
                small[1, k, j], small[1, best, j] = small[1, best, j], small[1, k, j]
            state[k, ka.FORCE], state[best, ka.FORCE] = state[best, ka.FORCE], state[k, ka.FORCE]
        inverse = 1.0 / small[1, k, k]
        for i in range(k + 1, p):
            factor = small[1, i, k] * inverse
            small[1, i, k] = factor
            for j in range(k + 1, p):
                small[1, i, j] -= factor * small[1, k, j]
            state[i, ka.FORCE] -= factor * state[k, ka.FORCE]
    for i in range(p - 1, -1, -1):
        total = state[i, ka.FORCE]
        for j in range(i + 1, p):
            total -= small[1, i, j] * state[j, ka.FORCE]
        state[i, ka.FORCE] = total / small[1, i, i]
    return 0


@noinline_kernel
def solve_dependent(small, state, active, p):
    """Solve as :func:`solve_small` for rows that are known to depend on each other.

    Pivots of columns in their order may not show it: the last pivot is the inverse of an entry of the inverse, large
    for a row with almost no part in the dependence. Forces would be as large as rounding allows.
    """
    return least_norm(small, state, active, p, largest_entry(small, state, p))


@internal_kernel
def largest_entry(small, state, p):
    """Return the size to which pivots are compared."""
    largest = 0.0
    for i in range(p):
        # A row without mobility is dependent even if no other row has a larger mobility.
        largest = max(largest, state[i, ka.ROW_FLOOR] / RANK_TOLERANCE)
        for j in range(p):
            largest = max(largest, abs(small[0, i, j]))
    return largest


@internal_kernel
def least_norm(small, state, active, p, largest):
    """Find the least-squares solution of least norm; return 1 if rows depend on each other, otherwise 0.

    Elimination with rook pivoting (the largest entry of its row and of its column) leaves P A Q = [L1; L2] [U1, U2] of
    rank r. With W = L2 L1⁻¹ and Z = U1⁻¹ U2, whose entries such pivots keep small, unlike the pivots of
    :func:`eliminate`,

        [L1; L2]⁺ b = L1⁻¹ (b1 + N(Wᵀ) (b2 − W b1)),    [U1, U2]⁺ c = (x1, Zᵀ x1),  x1 = s − N(Z) Zᵀ s,  s = U1⁻¹ c

    with N(X) = X (1 + Xᵀ X)⁻¹, and x = Q [U1, U2]⁺ [L1; L2]⁺ P b. Elimination turns b into L1⁻¹ b1 and b2 − W b1.
    """
    matrix, wide, part = small[1], small[2], small[3, p - 1]
    for i in range(p):
        state[i, ka.FORCE] = state[i, ka.RHS]
        for j in range(p):
            matrix[i, j] = small[0, i, j]
    r = eliminate_to_rank(small, state, active, p, largest)
    d = p - r
    # Wᵀ = L1⁻ᵀ L2ᵀ, (r, d).
    for k in range(r - 1, -1, -1):
        for a in range(d):
            wide[k, a] = matrix[r + a, k]
        for i in range(k + 1, r):
            factor = matrix[i, k]
            for a in range(d):
                wide[k, a] -= factor * wide[i, a]
    apply_normal(small, state, p, r)
    for k in range(r):
        for j in range(k):
            part[k] -= matrix[k, j] * part[j]
        state[k, ka.FORCE] += part[k]
    # s and Z, (r, d), together.
    for k in range(r - 1, -1, -1):
        inverse = 1.0 / matrix[k, k]
        total = state[k, ka.FORCE]
        for a in range(d):
            wide[k, a] = matrix[k, r + a]
        for j in range(k + 1, r):
            factor = matrix[k, j]
            total -= factor * state[j, ka.FORCE]
            for a in range(d):
                wide[k, a] -= factor * wide[j, a]
        state[k, ka.FORCE] = total * inverse
        for a in range(d):
            wide[k, a] *= inverse
    multiply_transposed(wide, state, r, d)
    apply_normal(small, state, p, r)
    for k in range(r):
        state[k, ka.FORCE] -= part[k]
    multiply_transposed(wide, state, r, d)
    # Restore the order of the rows.
    for k in range(p):
        part[k] = state[k, ka.FORCE]
    for k in range(p):
        state[active[k, ka.ORDER], ka.FORCE] = part[k]
    return 1 if d > 0 else 0


@internal_kernel
def eliminate_to_rank(small, state, active, p, largest):
    """Return the rank of ``small[1]`` by elimination; multipliers stay below the diagonal.

    ``largest`` is the size of the largest entry of ``small[0]``, see :func:`largest_entry`.

    A column without a pivot goes to the end and is finished: elimination would not add larger terms to it.
    """
    matrix = small[1]
    for i in range(p):
        active[i, ka.ORDER] = i
    k, last = 0, p
    while k < last:
        column, row = k, largest_in_column(matrix, k, k, p)
        if abs(matrix[row, column]) <= RANK_TOLERANCE * largest:
            last -= 1
            while last > k and abs(matrix[largest_in_column(matrix, last, k, p), last]) <= RANK_TOLERANCE * largest:
                last -= 1
            swap_columns(matrix, active, p, k, last)
            continue
        for _ in range(p):
            other = column
            for j in range(k, last):
                if abs(matrix[row, j]) > abs(matrix[row, other]):
                    other = j
            if other == column:
                break
            column = other
            other = largest_in_column(matrix, column, k, p)
            if other == row:
                break
            row = other
        swap_columns(matrix, active, p, k, column)
        if row != k:
            for j in range(p):
                matrix[k, j], matrix[row, j] = matrix[row, j], matrix[k, j]
            state[k, ka.FORCE], state[row, ka.FORCE] = state[row, ka.FORCE], state[k, ka.FORCE]
        inverse = 1.0 / matrix[k, k]
        for i in range(k + 1, p):
            factor = matrix[i, k] * inverse
            matrix[i, k] = factor
            for j in range(k + 1, last):
                matrix[i, j] -= factor * matrix[k, j]
            state[i, ka.FORCE] -= factor * state[k, ka.FORCE]
        k += 1
    return k


@internal_kernel
def largest_in_column(matrix, column, start, p):
    """Return the row of the largest entry of a column from row ``start`` on."""
    best = start
    for i in range(start + 1, p):
        if abs(matrix[i, column]) > abs(matrix[best, column]):
            best = i
    return best


@internal_kernel
def swap_columns(matrix, active, p, j, k):
    """Exchange two columns and their entries in ORDER."""
    if j != k:
        for i in range(p):
            matrix[i, j], matrix[i, k] = matrix[i, k], matrix[i, j]
        active[j, ka.ORDER], active[k, ka.ORDER] = active[k, ka.ORDER], active[j, ka.ORDER]


@internal_kernel
def multiply_transposed(wide, state, r, d):
    """Write wideᵀ x of the first r forces x to the d forces after them; wide: (r, d)."""
    for a in range(d):
        state[r + a, ka.FORCE] = 0.0
    for k in range(r):
        x = state[k, ka.FORCE]
        for a in range(d):
            state[r + a, ka.FORCE] += wide[k, a] * x


@internal_kernel
def apply_normal(small, state, p, r):
    """Compute X (1 + Xᵀ X)⁻¹ t = (1 + X Xᵀ)⁻¹ X t by the smaller system.

    X is ``small[2]``, (r, p − r), t is FORCE from r on. The result, (r,), goes to the last row of ``small[3]``; the
    last row of ``small[2]``, free of X, is scratch.
    """
    X, gram, x, t, d = small[2], small[3], small[3, p - 1], small[2, p - 1], p - r
    if d == 1:  # for example two braces that stick on a planar arm
        total = 1.0
        for k in range(r):
            total += X[k, 0] * X[k, 0]
        factor = state[r, ka.FORCE] / total
        for k in range(r):
            x[k] = factor * X[k, 0]
        return
    for a in range(d):
        t[a] = state[r + a, ka.FORCE]
    if d <= r:
        for a in range(d):
            for b in range(a, d):
                gram[a, b] = 1.0 if a == b else 0.0
        for k in range(r):
            for a in range(d):
                factor = X[k, a]
                for b in range(a, d):
                    gram[a, b] += factor * X[k, b]
        solve_definite(gram, t, d)
    for k in range(r):
        x[k] = 0.0
        for a in range(d):
            x[k] += X[k, a] * t[a]
    if d > r:
        for a in range(r):
            for b in range(a, r):
                total = 1.0 if a == b else 0.0
                for c in range(d):
                    total += X[a, c] * X[b, c]
                gram[a, b] = total
        solve_definite(gram, x, r)


@internal_kernel
def solve_definite(gram, x, size):
    """Solve gram y = x in place by Cholesky, Rᵀ R of the upper triangle; outer products let loops run along rows."""
    for a in range(size):
        inverse = 1.0 / math.sqrt(gram[a, a])
        for b in range(a, size):
            gram[a, b] *= inverse
        for c in range(a + 1, size):
            factor = gram[a, c]
            for b in range(c, size):
                gram[c, b] -= factor * gram[a, b]
    for a in range(size):
        x[a] /= gram[a, a]
        for b in range(a + 1, size):
            x[b] -= gram[a, b] * x[a]
    for a in range(size - 1, -1, -1):
        for b in range(a + 1, size):
            x[a] -= gram[a, b] * x[b]
        x[a] /= gram[a, a]


# Split of forces among dependent rows of sticking points, held joints and stops, within their bounds if possible.


# A unit split direction whose component along a normal row is smaller does not change that normal force.
NORMAL_PART = 1e-6
# A direction with a smaller square in the leading rows changes other rows only: couplings behind closed brakes.
NO_LEADING = 1e-20
# Value in place of a bound, for stops, which push one way.
ONE_WAY = -1.0


@internal_kernel
def margin(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """Return μ_s f_n − |f_t| of sticking candidate k [N]."""
    r, rows = ws.active[k, ka.FIRST_ROW], ws.rows
    a, b = rows[r + 1, ka.FORCE], rows[r + 2, ka.FORCE]
    return unilateral.number[ku.HOLDING] * contacts.law[k, ka.STATIC] * rows[r, ka.FORCE] - math.sqrt(a * a + b * b)


@internal_kernel
def dry_margin(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the margin of dry friction that holds a joint: its bound minus its force [N m or N]."""
    return holding_bound(unilateral, k) - abs(ws.rows[unilateral.dry_table[k, ku.DRY_ROW], ka.FORCE])


@internal_kernel
def admissible_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Replace forces of dependent sticking rows that exceed their bounds, and record forces of joints.

    The forces change in the null space of the rows: accelerations change only if rows are not fully dependent.
    """
    if unilateral is None:  # resolved at compile time
        return
    # Small, because it is inlined into the right-hand side.
    if unilateral.number[ku.REDUNDANT] == 1.0 or unilateral.stop.shape[0] + unilateral.dry.shape[0] > 0:
        check_forces(model, contacts, unilateral, ws)


@noinline_kernel
def check_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """Do the work of :func:`admissible_forces` if there are dependent rows, stops or dry friction."""
    unilateral.number[ku.SPLIT] = 0.0
    if unilateral.number[ku.REDUNDANT] == 1.0 and beyond_bounds(contacts, unilateral, ws):
        split_forces(model, contacts, unilateral, ws)
    note_stop_forces(unilateral, ws)
    note_dry_forces(unilateral, ws)


@internal_kernel
def beyond_bounds(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """True if a sticking point or held joint needs more force than its friction allows, or a closed stop pulls."""
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING and margin(contacts, unilateral, ws, k) < 0.0:
            return True
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 1 and dry_margin(unilateral, ws, k) < 0.0:
            return True
    for k in range(unilateral.stop_table.shape[0]):
        closed, r = unilateral.stop_table[k, ku.STOP_CLOSED] == 1, unilateral.stop_table[k, ku.STOP_ROW]
        if closed and ws.rows[r, ka.FORCE] < 0.0:
            return True
    return False


@noinline_kernel
def split_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """Compute the best split of all sticking forces, in FORCE of the rows; its worst margin goes to BEST_MARGIN.

    Pivots of J M⁻¹ Jᵀ are squares: rows that count as dependent at a pivot of 1e-10 may differ by 1e-5, and then a
    change of split changes accelerations by this fraction. They are updated to agree with the forces.
    """
    room, index, mu, rows = unilateral.room, unilateral.index, unilateral.vector[0], ws.rows
    first, row = index[0], index[1]
    points, count, p, ties = find_splits(unilateral, ws)
    for j in range(points):
        mu[j] = unilateral.number[ku.HOLDING] * contacts.law[ws.active[row[first[j]], ka.OWNER], ka.STATIC]
    j = points
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 1:
            mu[j] = holding_bound(unilateral, k)
            j += 1
    for _ in range(count - j):
        mu[j] = ONE_WAY
        j += 1
    force, out = unilateral.vector[1], unilateral.vector[2]
    for i in range(p):
        force[i] = rows[row[i], ka.FORCE]
    width = int(unilateral.number[ku.WIDTH])
    unilateral.number[ku.SPLIT] = 1.0
    programs = split_room_in(unilateral.split_room, index[3], width, count)
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
    """Write the directions in which sticking forces may change to NULL_SPACE, right after ``derivative``.

    index[0] is the first row of each sticking point, then of each held joint, then of each closed stop; index[1] has
    the rows in the table, followed by the coupling rows: their forces change with the others, without bounds.

    Returns
    -------
    points : int
        Number of sticking points.
    count : int
        Number of sticking points, held joints and closed stops.
    p : int
        Number of their rows.
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
    for k in range(unilateral.dry_table.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 1:
            first[count], row[p] = p, unilateral.dry_table[k, ku.DRY_ROW]
            p += 1
            count += 1
    for k in range(unilateral.stop_table.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            first[count], row[p] = p, unilateral.stop_table[k, ku.STOP_ROW]
            p += 1
            count += 1
    ties = rows_of_couplings(unilateral, ws)
    for r in range(ties):
        row[p + r] = r
    size = p + ties
    for i in range(size):
        for j in range(size):
            room[ku.SPLIT_MATRIX, i, j] = ws.small[0, row[i], row[j]]
    unilateral.number[ku.WIDTH] = null_space(room[ku.SPLIT_MATRIX], size, room[ku.NULL_SPACE], unilateral.index[2], p)
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
    """True if the last splits leave the normal force of sticking candidate k undetermined."""
    return row_shares(unilateral, first_split_row(ws, k))


@internal_kernel
def point_shares(unilateral: UnilateralArrays, ws: Workspace, k):
    """True if the last splits leave a force of sticking candidate k undetermined."""
    row = first_split_row(ws, k)
    return row_shares(unilateral, row) or row_shares(unilateral, row + 1) or row_shares(unilateral, row + 2)


@internal_kernel
def joint_shares(unilateral: UnilateralArrays, ws: Workspace, k):
    """True if the last splits leave the dry friction that holds joint k undetermined."""
    row = ka.MOST_ROWS * ws.counts[ka.STUCK]
    for j in range(k):
        row += unilateral.dry_table[j, ku.DRY_HOLDS]
    return row_shares(unilateral, row)


@internal_kernel
def row_shares(unilateral: UnilateralArrays, row):
    """True if the last splits leave the force of one of their rows undetermined."""
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


@internal_kernel
def null_space(W, p, N, order, leading):
    """Write a basis of the null space of W, (p, p), symmetric and positive semidefinite, to N, (p, width).

    It is orthonormal in its ``leading`` rows.

    Cholesky with pivoting, Π W Πᵀ = [L1; L2] [L1; L2]ᵀ; the columns (−L1⁻ᵀ L2ᵀ; 1), orthonormalised. W is overwritten.

    Returns
    -------
    width : int
        p minus the rank, minus the directions that change nothing in the leading rows.
    """
    largest, rank = 0.0, 0
    for i in range(p):
        order[i] = i
        largest = max(largest, W[i, i])
    while rank < p:
        best = rank
        for i in range(rank + 1, p):
            if W[order[i], order[i]] > W[order[best], order[best]]:
                best = i
        if not W[order[best], order[best]] > RANK_TOLERANCE * largest:
            break
        order[rank], order[best] = order[best], order[rank]
        a = order[rank]
        pivot = math.sqrt(W[a, a])
        W[a, a] = pivot
        for i in range(rank + 1, p):
            W[order[i], a] /= pivot
        for i in range(rank + 1, p):
            for j in range(rank + 1, p):
                W[order[i], order[j]] -= W[order[i], a] * W[order[j], a]
        rank += 1
    width = 0
    for free in order[rank:p]:
        for i in range(p):
            N[i, width] = 0.0
        N[free, width] = 1.0
        for k in range(rank - 1, -1, -1):
            total = -W[free, order[k]]
            for i in range(k + 1, rank):
                total -= W[order[i], order[k]] * N[order[i], width]
            N[order[k], width] = total / W[order[k], order[k]]
        # Orthogonalising twice is enough (Kahan, Parlett).
        for _ in range(2):
            for b in range(width):
                part = 0.0
                for i in range(leading):
                    part += N[i, b] * N[i, width]
                for i in range(p):
                    N[i, width] -= part * N[i, b]
        size = 0.0
        for i in range(leading):
            size += N[i, width] * N[i, width]
        if size > NO_LEADING:
            for i in range(p):
                N[i, width] /= math.sqrt(size)
            width += 1
    return width


# Test whether the contacts determine their forces: determinant and diagonal of J M⁻¹ F.


UNIQUE, REVERSED, SEVERAL = 0, 1, 2

# Blocks of the scratch ``room``, (ROOM, p, p); of SIGNS and FORCES only the first row is used.
FRICTIONLESS, FRICTION, BASIS, MATRIX, PRODUCT, SIGNS, FORCES = 0, 1, 2, 3, 4, 5, 6
ROOM = 7
# A determinant above this fraction of the bound from its terms is clearly positive.
CLEAR = 1e-3
# A normal mobility below this fraction of the mobility along the force is the square of rounding.
IMMOBILE = 1e-24
# Rounding: below these fractions a diagonal entry or a force has no sign, and two solutions are equal.
DIAGONAL_TOLERANCE = 1e-12
FORCE_TOLERANCE = 1e-9


@internal_kernel
def clearly_unique(ws: Workspace):
    """True without rows, or for one or two rows without dissipative friction whose determinant is clearly positive.

    Small, because it is inlined into the step: passing the tables to the full check costs as much as a sweep.
    """
    small, p = ws.small, ws.counts[ka.ROWS]
    if p == 0 or p > 2:
        return p == 0
    for k in range(p):
        if ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE or not small[0, k, k] > 0.0:
            return False
    if p == 1:
        return True
    straight, crossed = small[0, 0, 0] * small[0, 1, 1], small[0, 0, 1] * small[0, 1, 0]
    return straight - crossed > CLEAR * (straight + abs(crossed))


@internal_kernel
def dominant(ws: Workspace, room):
    """True without friction, or if every A(σ) is strictly diagonally dominant, so that none is singular."""
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
def last_link(ws: Workspace, k):
    """Return the last link that row k involves."""
    return max(ws.active[k, ka.BODY_A], ws.active[k, ka.BODY_B])


@internal_kernel
def split_matrix(ws: Workspace, room):
    """Write A0 and B to ``room``, from the eliminated rows and the matrix that the derivative left in ``ws``.

    The column of a row is zero beyond its own links, and links come after their parents.
    """
    active, column, links, state = ws.active, ws.column, ws.links, ws.rows
    p = ws.counts[ka.ROWS]
    for k in range(p):
        for m in range(k + 1):
            total = 0.0
            for i in range(min(last_link(ws, k), last_link(ws, m)) + 1):
                total += column[i, 1 + 2 * k] * column[i, 1 + 2 * m] * links[i, ka.INVERSE_D]
            room[FRICTIONLESS, k, m] = total
            room[FRICTIONLESS, m, k] = total
    for k in range(p):
        for m in range(p):
            sign = state[m, ka.SIGN] if active[m, ka.LAW] == ka.FRICTION_DISSIPATIVE else 1.0
            room[FRICTION, k, m] = sign * (room[FRICTIONLESS, k, m] - ws.small[0, k, m])


@internal_kernel
def force_verdict(ws: Workspace, room, since, t):
    """Return UNIQUE, or why the constraint forces at the state of ``ws`` are not unique, right after ``derivative``.

    REVERSED: the determinant of J M⁻¹ F with the present signs, relative to the frictionless one, is not positive, or
    every diagonal entry is negative. SEVERAL: other signs of dissipative contacts also agree with their forces.

    Parameters
    ----------
    room : (ROOM or more, p or more, p or more) ndarray
        Scratch.
    since : (c,) ndarray
        First time at which the contact's diagonal entry was negative [s], updated here; inf: never.
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
    """Zero the rows of points that no joint moves along their normals: their entries are rounding, of any sign."""
    p = ws.counts[ka.ROWS]
    for k in range(p):
        along = 0.0
        for i in range(last_link(ws, k) + 1):
            along += ws.column[i, 2 + 2 * k] * ws.column[i, 2 + 2 * k] * ws.links[i, ka.INVERSE_D]
        if room[FRICTIONLESS, k, k] <= max(IMMOBILE * along, ws.rows[k, ka.ROW_FLOOR]):
            for m in range(p):
                room[FRICTIONLESS, k, m], room[FRICTIONLESS, m, k], room[FRICTION, k, m] = 0.0, 0.0, 0.0


@internal_kernel
def frictionless_basis(room, p):
    """Factor A0 = L Lᵀ by Cholesky with pivoting; L, (p, rank), goes to ``room[BASIS]``; return the rank."""
    largest = 0.0
    for k in range(p):
        room[FORCES, 0, k] = room[FRICTIONLESS, k, k]
        largest = max(largest, room[FRICTIONLESS, k, k])
    for rank in range(p):
        best = 0
        for k in range(1, p):
            if room[FORCES, 0, k] > room[FORCES, 0, best]:
                best = k
        if room[FORCES, 0, best] <= RANK_TOLERANCE * largest:
            return rank
        inverse = 1.0 / math.sqrt(room[FORCES, 0, best])
        for k in range(p):
            total = room[FRICTIONLESS, k, best]
            for s in range(rank):
                total -= room[BASIS, k, s] * room[BASIS, best, s]
            room[BASIS, k, rank] = total * inverse
        for k in range(p):
            room[FORCES, 0, k] -= room[BASIS, k, rank] * room[BASIS, k, rank]
    return p


@internal_kernel
def solve_choice(ws: Workspace, room, rank):
    """Return the sign of the determinant of A(σ) for the signs in ``room``; forces go to ``room[FORCES, 0]``.

    For dependent rows, Lᵀ A(σ) L is used: supports of equal stiffness have these forces, in the range of A0.
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
                        total += room[BASIS, k, r] * room[PRODUCT, k, m] * room[BASIS, m, s]
                room[MATRIX, r, s] = total
    return eliminate_square(room, rank)


@internal_kernel
def eliminate_square(room, size):
    """Solve the leading ``size`` rows of ``room[MATRIX]`` x = ``room[FORCES, 0]``; return the determinant's sign."""
    matrix, x, sign = room[MATRIX], room[FORCES, 0], 1.0
    for k in range(size):
        best = k
        for i in range(k + 1, size):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        pivot = matrix[best, k]
        if not abs(pivot) > 0.0:
            return 0.0
        if best != k:
            sign = -sign
            x[k], x[best] = x[best], x[k]
            for j in range(k, size):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        sign = sign if pivot > 0.0 else -sign
        for i in range(k + 1, size):
            factor = matrix[i, k] / pivot
            for j in range(k + 1, size):
                matrix[i, j] -= factor * matrix[k, j]
            x[i] -= factor * x[k]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            x[i] -= matrix[i, j] * x[j]
        x[i] /= matrix[i, i]
    return sign


@internal_kernel
def another_solution(ws: Workspace, room):
    """True if the forces in ``room`` have the signs that they were solved for and differ from the forces of ``ws``."""
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
