"""External wrenches on points of bodies: constant, given by splines over time, or rewritten between steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import along, dot, rotate, rotation, six, transform, vector, wrench_at
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# LoadArrays.table, int
LINK, IN_BODY, HOLDS, DATA, SEGMENTS = 0, 1, 2, 3, 4
TABLE_SIZE = 5
# LoadArrays.data, from index table[l, DATA] on: point in the body's frame [m]; constant wrench (force [N] and moment
# [N m]) that is added to the wrench of the segments; then the segments. Each segment has its start time [s] and
# ascending powers of the time since then, four for each component of force and moment. The end time of the last segment
# follows.
POINT, WRENCH, FIRST_SEGMENT = 0, 3, 9
SEGMENT_SIZE = 25


class LoadArrays(NamedTuple):
    """Tables of external wrenches."""

    table: np.ndarray  # (l, TABLE_SIZE) int, see LINK and the following constants
    data: np.ndarray  # (…,) see POINT, WRENCH, FIRST_SEGMENT


@internal_kernel
def segment_start(loads: LoadArrays, k, t):
    """Return the index in ``loads.data`` of the segment of load k at time t (−1 if none), and the evaluation time.

    The result depends only on time, so it is the same for all states that are evaluated together.
    """
    count = loads.table[k, SEGMENTS]
    first = loads.table[k, DATA] + FIRST_SEGMENT
    if count == 0:
        return -1, t
    end = loads.data[first + count * SEGMENT_SIZE]
    # At both end times, use the value that applies just after them, because integration steps end there (Run.breaks).
    if t < loads.data[first] or t >= end:
        if loads.table[k, HOLDS] == 0:
            return -1, t
        t = min(max(t, loads.data[first]), end)
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) // 2
        if loads.data[first + middle * SEGMENT_SIZE] <= t:
            low = middle
        else:
            high = middle
    return first + low * SEGMENT_SIZE, t


@internal_kernel
def load_wrench(loads: LoadArrays, k, t, ws: Workspace):
    """Return the moment about the world origin and the force of load k at t in W [N m, N], after ``forward_sweep``."""
    links, table, data = ws.links, loads.table, loads.data
    i, start = table[k, LINK], table[k, DATA]
    force, moment = segment_vector(data, start + WRENCH), segment_vector(data, start + WRENCH + 3)
    segment, at = segment_start(loads, k, t)
    if segment >= 0:
        x, c = at - data[segment], segment + 1
        force, moment = along(force, cubics(data, c, x), 1.0), along(moment, cubics(data, c + 12, x), 1.0)
    R = rotation(links, i, ka.R)
    if table[k, IN_BODY] != 0:
        force, moment = rotate(R, force), rotate(R, moment)
    return wrench_at(transform(vector(links, i, ka.P), R, segment_vector(data, start + POINT)), force, moment)


@internal_kernel
def segment_vector(data, c):
    """Return three consecutive numbers of the data, starting at index c."""
    return data[c], data[c + 1], data[c + 2]


@internal_kernel
def cubics(data, c, x):
    """Evaluate three cubic polynomials in x with coefficients from index c on."""
    return cubic(data, c, x), cubic(data, c + 4, x), cubic(data, c + 8, x)


@internal_kernel
def cubic(data, c, x):
    """Evaluate the cubic polynomial in x with ascending coefficients that start at index c."""
    return data[c] + x * (data[c + 1] + x * (data[c + 2] + x * data[c + 3]))


@noinline_kernel
def add_loads(model: ModelArrays, loads: LoadArrays, t, ws: Workspace, power, start):
    """Add S·W of every external wrench W to the applied forces of the joints that carry it, after ``forward_sweep``.

    The power W·V of each wrench is written to power[start:] [W].
    """
    links, joints, table = ws.links, ws.joints, loads.table
    for k in range(table.shape[0]):
        i = table[k, LINK]
        W = load_wrench(loads, k, t, ws)
        power[start + k] = dot(W, six(links, i, ka.V))
        while i >= 0:
            joints[i, ka.APPLIED] += dot(W, six(links, i, ka.S))
            i = model.tree[i, ka.PARENT]
