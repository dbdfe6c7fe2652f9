"""Split of forces among redundant sticking contacts by cone programs: least norm in the cones, or largest margin."""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone.program import ConeProgram, cone_program, laid_out, program_size, solve_cone_program
from dynsim.jit.kernel import internal_kernel, kernel

# Weight of |z|² in the objective with the margin: makes the best split unique where the margin alone does not.
LEAST_WEIGHT = 1e-13
# Bound on the margin, in units of the largest given force: pressing two walls apart has no largest margin.
MARGIN_MAX = 10.0
# Tolerance in units of the largest force: for tangential forces without friction, and for cones that meet in a point.
FORCE_TOLERANCE = 1e-9


def split_room(r: int, count: int) -> ConeProgram:
    """The room of :func:`best_split` for null spaces of up to r columns and ``count`` contacts."""
    return cone_program(*split_sizes(r, count))


def split_size(r: int, count: int) -> int:
    """Numbers in that room, see :func:`split_room_in`."""
    return program_size(*split_sizes(r, count))


def split_sizes(r: int, count: int) -> tuple[int, int, int, int]:
    """Unknowns, equations, cones and rows of the larger of its programs."""
    return r + 1, 2 * count, count + 1, ka.MOST_ROWS * count + 1


@internal_kernel
def split_room_in(flat, first, r, count):
    """:func:`split_room` in given arrays, (split_size(r, count),) and (count + 2,) int."""
    return laid_out(flat, first, r + 1, 2 * count, count + 1, ka.MOST_ROWS * count + 1)


@kernel
def best_split(f0, N, r, contact_first, mu, contacts, joints, out, room: ConeProgram, least):
    """Forces f = f0 + N z of redundant sticking contacts: in all cones if any split is, and then the least, if wanted.

    The best margin is max_z min_j (μ_j f_n,j − |f_t,j|). Is it negative, no split holds all contacts. A contact without
    friction can hold no tangential force: where its own can vanish it is kept at zero, and its margin is f_n,j.

    Parameters
    ----------
    f0 : (p or more,) forces of all rows [N]
    N : (p or more, r or more) directions in which they can be split otherwise; r of them
    contact_first : (contacts + joints or more,) int, normal row of each sticking contact, whose tangential rows follow,
        then the ``joints``: the row of each joint that dry friction holds, and of each closed joint stop
    mu : (contacts + joints or more,) static friction; of joints the bound of their force, whose margin is μ_j − |f_j|;
        negative for a stop, whose margin is its force f_j
    out : (p or more,) the force of least norm in all cones; if no force is in all cones, the force of the best margin
    room : see :func:`split_room`
    least : False: the split of the best margin in any case

    Returns
    -------
    float
        The best margin [N], at most ten times the largest force in f0.
    """
    p, count = f0.shape[0], contacts + joints
    scale = 0.0
    for i in range(p):
        out[i] = f0[i]
        scale = max(scale, abs(f0[i]))
    if scale == 0.0 or count == 0:
        return 0.0
    x, equations = room.x, 0
    worst = math.inf
    for j in range(count):
        i = contact_first[j]
        if j >= contacts:
            worst = min(worst, (mu[j] - abs(f0[i]) if mu[j] >= 0.0 else f0[i]) / scale)
            continue
        if mu[j] > 0.0:
            worst = min(worst, (mu[j] * f0[i] - math.hypot(f0[i + 1], f0[i + 2])) / scale)
            continue
        worst = min(worst, f0[i] / scale)
        for e in range(1, ka.MOST_ROWS):
            for k in range(r):
                room.A[equations, k] = N[i + e, k]
            room.A[equations, r] = 0.0
            room.b[equations] = -f0[i + e] / scale
            equations += 1
    if r == 0:
        for e in range(equations):
            if abs(room.b[e]) > FORCE_TOLERANCE:
                worst = min(worst, -abs(room.b[e]))
        return worst * scale

    # The margin t is the last unknown.
    rows = cone_rows(f0, N, r, contact_first, mu, contacts, joints, scale, room)
    for k in range(r + 1):
        for m in range(r + 1):
            room.H[k, m] = 0.0
        room.H[k, k] = LEAST_WEIGHT
        room.g[k], x[k] = 0.0, 0.0
    room.H[r, r], room.g[r] = 0.0, -1.0
    x[r] = min(worst, 0.0) - 1.0
    room.first[count + 1] = rows + 1
    for k in range(r):
        room.G[rows, k] = 0.0
    room.G[rows, r], room.h[rows] = -1.0, MARGIN_MAX
    solve_cone_program(room, r + 1, equations, count + 1)
    margin = x[r]
    error = 0.0
    for e in range(equations):
        off = -room.b[e]
        for k in range(r):
            off += room.A[e, k] * x[k]
        error = max(error, abs(off))
    if error > FORCE_TOLERANCE:
        margin = min(margin, -error)

    if least and margin > FORCE_TOLERANCE:
        # There is room inside the cones: the least force, from the point found.
        for k in range(r):
            room.g[k] = 0.0
            for i in range(p):
                room.g[k] += N[i, k] * f0[i] / scale
            for m in range(r):
                room.H[k, m] = 0.0
                for i in range(p):
                    room.H[k, m] += N[i, k] * N[i, m]
        solve_cone_program(room, r, equations, count)
    for i in range(p):
        for k in range(r):
            out[i] += scale * N[i, k] * x[k]
    return margin * scale


@internal_kernel
def cone_rows(f0, N, r, contact_first, mu, contacts, joints, scale, room: ConeProgram):
    """The cones in z and the margin t; returns how many rows.

    (μ f_n − t, f_t) of contacts, (μ − t, f) of joints, f − t of stops.
    """
    row = 0
    for j in range(contacts):
        i, room.first[j] = contact_first[j], row
        slope = mu[j] if mu[j] > 0.0 else 1.0
        for k in range(r):
            room.G[row, k] = slope * N[i, k]
        room.G[row, r], room.h[row] = -1.0, slope * f0[i] / scale
        row += 1
        if mu[j] > 0.0:
            for e in range(1, ka.MOST_ROWS):
                for k in range(r):
                    room.G[row, k] = N[i + e, k]
                room.G[row, r], room.h[row] = 0.0, f0[i + e] / scale
                row += 1
    for j in range(contacts, contacts + joints):
        i, room.first[j] = contact_first[j], row
        if mu[j] < 0.0:
            for k in range(r):
                room.G[row, k] = N[i, k]
            room.G[row, r], room.h[row] = -1.0, f0[i] / scale
            row += 1
            continue
        for k in range(r):
            room.G[row, k], room.G[row + 1, k] = 0.0, N[i, k]
        room.G[row, r], room.h[row] = -1.0, mu[j] / scale
        room.G[row + 1, r], room.h[row + 1] = 0.0, f0[i] / scale
        row += 2
    room.first[contacts + joints] = row
    return row
