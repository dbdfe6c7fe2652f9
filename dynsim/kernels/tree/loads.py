"""External wrenches on points of bodies: constant, by splines over time, or rewritten between steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.kernels import arrays as ka
from dynsim.kernels.arrays import ModelArrays, Workspace
from dynsim.kernels.jit import apart_kernel, internal_kernel

# LoadArrays.table, int
LINK, IN_BODY, HOLDS, DATA, SEGMENTS = 0, 1, 2, 3, 4
TABLE_SIZE = 5
# Of LoadArrays.data, from table[l, DATA] on: point in the body's frame [m], wrench that is added to that of the
# segments: force [N] and moment [N m]. Then the segments: first time [s], then ascending powers of t − that time, four
# for each component of force and moment. At last the time at which the last segment ends.
POINT, WRENCH, FIRST_SEGMENT = 0, 3, 9
SEGMENT_SIZE = 25


class LoadArrays(NamedTuple):
    """External wrenches."""

    table: np.ndarray  # (l, TABLE_SIZE) int: link, axes of the wrench, held beyond its times, place in data, segments
    data: np.ndarray  # (…,) see POINT, WRENCH, FIRST_SEGMENT


@internal_kernel
def segment_start(loads: LoadArrays, k, t):
    """Place in ``loads.data`` of the segment of load k that t lies in, and the time to evaluate it at; −1 for none.

    Depends on time alone, so it is the same for all states that are evaluated together.
    """
    count = loads.table[k, SEGMENTS]
    first = loads.table[k, DATA] + FIRST_SEGMENT
    if count == 0:
        return -1, t
    end = loads.data[first + count * SEGMENT_SIZE]
    # From the right at both ends: the steps end there (Run.breaks).
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
    """Moment about the world origin and force of load k at time t in W [N m, N], after ``forward_sweep``."""
    links, table, data = ws.links, loads.table, loads.data
    i, place = table[k, LINK], table[k, DATA]
    fx, fy, fz = data[place + WRENCH], data[place + WRENCH + 1], data[place + WRENCH + 2]
    mx, my, mz = data[place + WRENCH + 3], data[place + WRENCH + 4], data[place + WRENCH + 5]
    segment, at = segment_start(loads, k, t)
    if segment >= 0:
        x = at - data[segment]
        c = segment + 1
        fx += data[c] + x * (data[c + 1] + x * (data[c + 2] + x * data[c + 3]))
        fy += data[c + 4] + x * (data[c + 5] + x * (data[c + 6] + x * data[c + 7]))
        fz += data[c + 8] + x * (data[c + 9] + x * (data[c + 10] + x * data[c + 11]))
        mx += data[c + 12] + x * (data[c + 13] + x * (data[c + 14] + x * data[c + 15]))
        my += data[c + 16] + x * (data[c + 17] + x * (data[c + 18] + x * data[c + 19]))
        mz += data[c + 20] + x * (data[c + 21] + x * (data[c + 22] + x * data[c + 23]))
    b0, b1, b2 = links[i, ka.R], links[i, ka.R + 1], links[i, ka.R + 2]
    b3, b4, b5 = links[i, ka.R + 3], links[i, ka.R + 4], links[i, ka.R + 5]
    b6, b7, b8 = links[i, ka.R + 6], links[i, ka.R + 7], links[i, ka.R + 8]
    if table[k, IN_BODY] != 0:
        fx, fy, fz = b0 * fx + b1 * fy + b2 * fz, b3 * fx + b4 * fy + b5 * fz, b6 * fx + b7 * fy + b8 * fz
        mx, my, mz = b0 * mx + b1 * my + b2 * mz, b3 * mx + b4 * my + b5 * mz, b6 * mx + b7 * my + b8 * mz
    x, y, z = data[place + POINT], data[place + POINT + 1], data[place + POINT + 2]
    rx = links[i, ka.P] + b0 * x + b1 * y + b2 * z
    ry = links[i, ka.P + 1] + b3 * x + b4 * y + b5 * z
    rz = links[i, ka.P + 2] + b6 * x + b7 * y + b8 * z
    mx, my, mz = mx + ry * fz - rz * fy, my + rz * fx - rx * fz, mz + rx * fy - ry * fx
    return mx, my, mz, fx, fy, fz


@apart_kernel
def add_loads(model: ModelArrays, loads: LoadArrays, t, ws: Workspace, power, start):
    """Add S·W of every external wrench W to the applied forces of the joints that carry it, after ``forward_sweep``.

    Its power W·V goes to power[start:] [W].
    """
    links, joints, table = ws.links, ws.joints, loads.table
    for k in range(table.shape[0]):
        i = table[k, LINK]
        mx, my, mz, fx, fy, fz = load_wrench(loads, k, t, ws)
        power[start + k] = (
            mx * links[i, ka.V] + my * links[i, ka.V + 1] + mz * links[i, ka.V + 2]
            + fx * links[i, ka.V + 3] + fy * links[i, ka.V + 4] + fz * links[i, ka.V + 5]
        )  # fmt: skip
        while i >= 0:
            joints[i, ka.APPLIED] += (
                mx * links[i, ka.S] + my * links[i, ka.S + 1] + mz * links[i, ka.S + 2]
                + fx * links[i, ka.S + 3] + fy * links[i, ka.S + 4] + fz * links[i, ka.S + 5]
            )  # fmt: skip
            i = model.tree[i, ka.PARENT]
