"""Test whether the contacts determine their forces: determinant and diagonal of J M⁻¹ F.

With friction the matrix is A(σ) = A0 − B diag(σ). A0 = J M⁻¹ Jᵀ, positive semidefinite, is the matrix without friction;
column m of B is the part of contact m's friction; σ_m is 1 for the signed law and the sign of f_m for the dissipative
one. The forces are unique for every right-hand side exactly when the determinants of all A(σ) have one sign, which is
that of A0; docs/physics.md derives it.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.delassus import RANK_TOLERANCE
from dynsim.dynamics.contact.quadrics import SIGNS_LIMIT
from dynsim.dynamics.tables import Workspace
from dynsim.jit.kernel import internal_kernel

UNIQUE, REVERSED, SEVERAL = 0, 1, 2

# Blocks of the scratch ``room``, (ROOM, p, p); of SIGNS and FORCES only the first row is used.
FRICTIONLESS, FRICTION, BASIS, MATRIX, PRODUCT, SIGNS, FORCES = 0, 1, 2, 3, 4, 5, 6
ROOM = 7
# A determinant above this fraction of the bound by its terms is clearly positive.
CLEAR = 1e-3
# A normal mobility below this fraction of that along the force is the square of rounding.
IMMOBILE = 1e-24
# Rounding: below these fractions a diagonal entry or a force has no sign, and two solutions are the same one.
DIAGONAL_TOLERANCE = 1e-12
FORCE_TOLERANCE = 1e-9


@internal_kernel
def clearly_unique(ws: Workspace):
    """True for no row, and for one or two without dissipative friction whose determinant is positive by far.

    Small, because it is merged into the step: passing the tables to the rest of the watch costs as much as a sweep.
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
    """True without friction, and when every A(σ) is strictly diagonally dominant, so that none of them is singular."""
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
    """The last link that row k touches."""
    return max(ws.active[k, ka.BODY_A], ws.active[k, ka.BODY_B])


@internal_kernel
def split_matrix(ws: Workspace, room):
    """A0 and B into ``room``, from the eliminated rows and the matrix that the derivative has left in ``ws``.

    A row's column is zero beyond its own links, and links come after their parents.
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
    """UNIQUE, or why the constraint forces at the state of ``ws`` are not determined, right after ``derivative``.

    REVERSED: the determinant of J M⁻¹ F with the present signs, per that without friction, is not positive, or every
    diagonal entry is negative. SEVERAL: other signs of dissipative contacts agree with their forces too.

    Parameters
    ----------
    room : (ROOM, p, p) scratch, or more
    since : (c,) first time at which the contact's diagonal entry was negative [s], written here; inf: never
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
            # Only a frictional row can have it: that of a sliding point.
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
    """Zero the rows of points that no joint moves along their normals: what is left there is rounding, of any sign."""
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
    """A0 = L Lᵀ by Cholesky with pivoting: L, (p, rank), into ``room[BASIS]``; returns the rank."""
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
    """Sign of the determinant of A(σ) for the signs in ``room``; the forces into ``room[FORCES, 0]`` at full rank.

    Dependent rows: of Lᵀ A(σ) L, the forces that supports of equal stiffness have, which lie in the range of A0.
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
    return eliminate(room, rank)


@internal_kernel
def eliminate(room, size):
    """Solve the leading ``size`` rows of ``room[MATRIX]`` x = ``room[FORCES, 0]``; returns the determinant's sign."""
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
    """True when the forces in ``room`` have the signs that they were solved for and differ from those of ``ws``."""
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
