"""Fixed steps of N runs at once: RK4 on lanes, one time for all, parameters and states of each its own.

A lane gets what a run of its own gets, to rounding: where one has left its surfaces it alone is projected.
"""

from __future__ import annotations

import numpy as np

from dynsim.kernels.arrays import ROWS, Workspace
from dynsim.kernels.integrate.project import PROJECTION_LIMIT, off_surface, project
from dynsim.kernels.jit import internal_kernel, kernel
from dynsim.kernels.lanes.system import derivative_lanes
from dynsim.kernels.lanes.tables import aligned, as_lanes, lane, lane_count, tables_as_lanes
from dynsim.kernels.system import System

STAGES = 6  # rows of scratch of advance_rk4


def stages(m: int, count: int) -> np.ndarray:
    """Scratch of :func:`advance_rk4` for m entries of the state and so many lanes."""
    return aligned(STAGES, m, count)


@kernel
def advance_rk4(width, system: System, t, h, steps, y, ws: Workspace, stage):
    """So many steps of RK4 of length h [s] from time t; returns steps in which a lane was not met by its surfaces.

    Parameters
    ----------
    width : FOUR or EIGHT of dynsim.kernels.lanes.system
    system : tables may have lanes
    y : (layout.size, N) in and out
    ws : of ``lane_workspace``
    stage : (STAGES, layout.size, N) scratch; stage[0] is the derivative at y in the end
    """
    tables, room, states = tables_as_lanes(system, width), tables_as_lanes(ws, width), as_lanes(y, width)
    k = as_lanes(stage, width)
    unmet = 0 if settle_lanes(tables, t, states, room, k[0]) else 1
    for step in range(steps):
        at = t + step * h
        # In the order of dynsim.kernels.integrate.explicit, so that sums round alike.
        shift(states, 0.5 * h, k[0], k[4])
        derivative_lanes(tables, at + 0.5 * h, k[4], room, k[1])
        shift(states, 0.5 * h, k[1], k[4])
        derivative_lanes(tables, at + 0.5 * h, k[4], room, k[2])
        shift(states, h, k[2], k[4])
        derivative_lanes(tables, at + h, k[4], room, k[3])
        for j in range(states.shape[0]):
            states[j] = (
                states[j] + h * (1.0 / 6.0) * k[0, j] + h * (1.0 / 3.0) * k[1, j] + h * (1.0 / 3.0) * k[2, j]
            ) + h * (1.0 / 6.0) * k[3, j]
        if not settle_lanes(tables, at + h, states, room, k[0]):
            unmet += 1
    return unmet


@internal_kernel
def shift(y, h, k, out):
    """out = y + h k."""
    for j in range(y.shape[0]):
        out[j] = y[j] + h * k[j]


@internal_kernel
def settle_lanes(system: System, t, y, ws: Workspace, dy):
    """Derivative of all lanes, those projected first that have left their surfaces; False when one cannot be."""
    derivative_lanes(system, t, y, ws, dy)
    if ws.counts[ROWS] == 0:
        return True
    for _ in range(PROJECTION_LIMIT):
        moved = False
        for k in range(lane_count(y)):
            if off_surface(lane(ws, k)):
                project(lane(system, k), lane(ws, k), lane(y, k))
                moved = True
        if not moved:
            return True
        derivative_lanes(system, t, y, ws, dy)
    met = True
    for k in range(lane_count(y)):
        met = met and not off_surface(lane(ws, k))
    return met
