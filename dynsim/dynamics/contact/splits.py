"""Split of forces among dependent rows of sticking points, held joints and stops, within their bounds if possible.

Two sticking braces of a planar arm have dependent lateral rows, points along one body dependent radial rows: only the
sum of their forces is in the equations of motion. Such a set sticks as long as some split lies in all cones
|f_t| ≤ μ_s f_n. If the split of least norm is outside them, the split of least norm inside them replaces it; if no
split is inside, the split with the largest worst margin does.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone.socp import best_split, split_room_in
from dynsim.dynamics.contact.delassus import RANK_TOLERANCE
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

# A unit direction of splits whose part along a normal row is smaller leaves that normal force as it is.
NORMAL_PART = 1e-6
# A direction with a smaller square in the leading rows has its other parts alone: of couplings behind closed brakes.
NO_LEADING = 1e-20
# Instead of a bound: of stops, which push one way.
ONE_WAY = -1.0


@internal_kernel
def margin(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace, k):
    """μ_s f_n − |f_t| of candidate k, which sticks [N]."""
    r, rows = ws.active[k, ka.FIRST_ROW], ws.rows
    a, b = rows[r + 1, ka.FORCE], rows[r + 2, ka.FORCE]
    return unilateral.number[ku.HOLDING] * contacts.law[k, ka.STATIC] * rows[r, ka.FORCE] - math.sqrt(a * a + b * b)


@internal_kernel
def dry_margin(unilateral: UnilateralArrays, ws: Workspace, k):
    """Margin of dry friction that holds a joint: its bound minus its force [N m or N]."""
    return holding_bound(unilateral, k) - abs(ws.rows[unilateral.dry_table[k, ku.DRY_ROW], ka.FORCE])


@internal_kernel
def admissible_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Replace the forces of dependent rows that stick where they are beyond their bounds; note those of joints.

    The forces change in the null space of the rows: accelerations only change as far as rows are not quite dependent.
    """
    if unilateral is None:  # known to the compiler
        return
    # Small, because it is merged into the right-hand side.
    if unilateral.number[ku.REDUNDANT] == 1.0 or unilateral.stop.shape[0] + unilateral.dry.shape[0] > 0:
        look_at_forces(model, contacts, unilateral, ws)


@noinline_kernel
def look_at_forces(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """:func:`admissible_forces` where there are dependent rows, stops or dry friction."""
    unilateral.number[ku.SPLIT] = 0.0
    if unilateral.number[ku.REDUNDANT] == 1.0 and beyond_bounds(contacts, unilateral, ws):
        split_forces(model, contacts, unilateral, ws)
    note_stop_forces(unilateral, ws)
    note_dry_forces(unilateral, ws)


@internal_kernel
def beyond_bounds(contacts: ContactArrays, unilateral: UnilateralArrays, ws: Workspace):
    """True if a sticking point or a held joint has more force than its friction can have, or a closed stop pulls."""
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
    """The best split of the forces of all that sticks, into FORCE of its rows; its worst margin into BEST_MARGIN.

    Pivots of J M⁻¹ Jᵀ are squares: rows that count as dependent at a pivot of 1e-10 may differ by 1e-5, and a change of
    split by as much of the forces. Accelerations take this change, so that they agree with the forces.
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
    """Change of the force of row i, a coupling, when forces of the leading p rows change from ``force`` to ``out``."""
    total = 0.0
    for c in range(width):
        part = 0.0
        for j in range(p):
            part += N[j, c] * (out[j] - force[j])
        total += N[i, c] * part
    return total


@internal_kernel
def find_splits(unilateral: UnilateralArrays, ws: Workspace):
    """Directions in which the forces of all that sticks may change, into NULL_SPACE, right after ``derivative``.

    index[0] is the first row of each sticking point, then of each held joint, then of each closed stop, and index[1]
    the rows in the table, with those of couplings behind them: their forces change with the others, within no bound.

    Returns
    -------
    points, count, p, ties : sticking points; points, held joints and stops; their rows; rows of couplings
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
    """First row of candidate k, which sticks, in the splits found last."""
    row = 0
    for j in range(k):
        row += ka.MOST_ROWS if ws.active[j, ka.MODE] == ka.STICKING else 0
    return row


@internal_kernel
def normal_is_open(unilateral: UnilateralArrays, ws: Workspace, k):
    """True if the splits found last leave the normal force of candidate k, which sticks, undetermined."""
    return row_shares(unilateral, first_split_row(ws, k))


@internal_kernel
def point_shares(unilateral: UnilateralArrays, ws: Workspace, k):
    """True if the splits found last leave a force of candidate k, which sticks, undetermined."""
    row = first_split_row(ws, k)
    return row_shares(unilateral, row) or row_shares(unilateral, row + 1) or row_shares(unilateral, row + 2)


@internal_kernel
def joint_shares(unilateral: UnilateralArrays, ws: Workspace, k):
    """True if the splits found last leave the dry friction that holds joint k undetermined."""
    row = ka.MOST_ROWS * ws.counts[ka.STUCK]
    for j in range(k):
        row += unilateral.dry_table[j, ku.DRY_HOLDS]
    return row_shares(unilateral, row)


@internal_kernel
def row_shares(unilateral: UnilateralArrays, row):
    """True if the splits found last leave the force of one of their rows undetermined."""
    largest = 0.0
    for c in range(int(unilateral.number[ku.WIDTH])):
        largest = max(largest, abs(unilateral.room[ku.NULL_SPACE, row, c]))
    return largest > NORMAL_PART


@internal_kernel
def stops_that_share(unilateral: UnilateralArrays):
    """Number of closed stops whose forces the splits found last leave undetermined."""
    sharing, closed = 0, 0
    for k in range(unilateral.stop_table.shape[0]):
        closed += unilateral.stop_table[k, ku.STOP_CLOSED]
    size = int(unilateral.number[ku.SPLIT_ROWS])
    for i in range(size - closed, size):
        sharing += 1 if row_shares(unilateral, i) else 0
    return sharing


@internal_kernel
def null_space(W, p, N, order, leading):
    """Basis of the null space of W, (p, p), symmetric and positive semidefinite, into N, (p, width).

    It is orthonormal in its ``leading`` rows.

    Cholesky with pivoting, Π W Πᵀ = [L1; L2] [L1; L2]ᵀ; the columns (−L1⁻ᵀ L2ᵀ; 1), orthonormalised. W is overwritten.

    Returns
    -------
    width : p minus the rank, less what changes nothing in the leading rows
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
        # Twice is enough (Kahan, Parlett).
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
