"""External wrenches on points of bodies: constant, by splines over time, or rewritten between steps."""

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
# LoadArrays.data, from table[l, DATA] on: point in the body's frame [m], wrench that is added to the segments' wrench:
# force [N] and moment [N m]. Then the segments: first time [s], then ascending powers of t − that time, four for each
# component of force and moment. Finally the end time of the last segment.
POINT, WRENCH, FIRST_SEGMENT = 0, 3, 9
SEGMENT_SIZE = 25


class LoadArrays(NamedTuple):
    """External wrenches."""

    table: np.ndarray  # (l, TABLE_SIZE) int: link, axes of the wrench, held beyond its times, start in data, segments
    data: np.ndarray  # (…,) see POINT, WRENCH, FIRST_SEGMENT


@internal_kernel
def segment_start(loads: LoadArrays, k, t):
    """Return the start in ``loads.data`` of the segment of load k at t, and the time of evaluation; −1 for none.

    Depends on time only, so it is the same for all states that are evaluated together.
    """
    count = loads.table[k, SEGMENTS]
    first = loads.table[k, DATA] + FIRST_SEGMENT
    if count == 0:
        return -1, t
    end = loads.data[first + count * SEGMENT_SIZE]
    # Both ends belong to the right: the steps end there (Run.breaks).
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
    """Return moment about the world origin and force of load k at time t in W [N m, N], after ``forward_sweep``."""
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
    """Return three numbers of the data from index c on."""
    return data[c], data[c + 1], data[c + 2]


@internal_kernel
def cubics(data, c, x):
    """Evaluate three cubic polynomials in x with coefficients from index c on."""
    return cubic(data, c, x), cubic(data, c + 4, x), cubic(data, c + 8, x)


@internal_kernel
def cubic(data, c, x):
    """Evaluate the cubic polynomial in x with ascending coefficients from index c on."""
    return data[c] + x * (data[c + 1] + x * (data[c + 2] + x * data[c + 3]))


@noinline_kernel
def add_loads(model: ModelArrays, loads: LoadArrays, t, ws: Workspace, power, start):
    """Add S·W of every external wrench W to the applied forces of the joints that carry it, after ``forward_sweep``.

    Its power W·V goes to power[start:] [W].
    """
    links, joints, table = ws.links, ws.joints, loads.table
    for k in range(table.shape[0]):
        i = table[k, LINK]
        W = load_wrench(loads, k, t, ws)
        power[start + k] = dot(W, six(links, i, ka.V))
        while i >= 0:
            joints[i, ka.APPLIED] += dot(W, six(links, i, ka.S))
            i = model.tree[i, ka.PARENT]
