"""Projection of positions and rates onto the active constraint rows.

After each accepted step of the adaptive methods q and v are projected onto the active rows if they are off
them by more than ``GAP_TOLERANCE`` or ``RATE_TOLERANCE``.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.delassus import solve_small
from dynsim.dynamics.contact.rows import row_errors
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.articulated import accelerate
from dynsim.dynamics.tree.joints import displace
from dynsim.integrators import run as ki
from dynsim.integrators.run import Run
from dynsim.jit.kernel import internal_kernel

# A tenth of the specified drift (1e-9 m), and a rate that adds less than that in a step [m, m/s; rad, rad/s].
GAP_TOLERANCE = 1e-10
RATE_TOLERANCE = 1e-8
PROJECTION_LIMIT = 6


@internal_kernel
def off_surface(ws: Workspace):
    """True when the state has left an active row by more than the projection tolerances."""
    state, rows, active = ws.contacts, ws.rows, ws.active
    row_errors(ws)
    for r in range(ws.counts[ka.ROWS]):
        # Rounding limits the rate to a fraction of the speed.
        if active[r, ka.ROW_KIND] == ka.JOINT_ROW:
            speed = abs(rows[r, ka.ROW + 1] * ws.joints[active[r, ka.BODY_B], ka.QD])
        else:
            k = active[r, ka.OWNER]
            x, y, z = state[k, ka.SLIP_VELOCITY], state[k, ka.SLIP_VELOCITY + 1], state[k, ka.SLIP_VELOCITY + 2]
            speed = math.sqrt(x * x + y * y + z * z)
        if abs(rows[r, ka.ROW_GAP]) > GAP_TOLERANCE or abs(rows[r, ka.ROW_RATE]) > RATE_TOLERANCE * (1.0 + speed):
            return True
    return False


@internal_kernel
def project(system: System, ws: Workspace, y):
    """One Newton step of q and v onto the active rows, weighted by the mass matrix, right after :func:`off_surface`.

    dq = −M⁻¹ Jᵀ λ with J M⁻¹ Jᵀ λ = gap, and the same for v with J v: the nearest point in the kinetic metric. The
    factors of M + J_m and the eliminated rows are those that the derivative has left in the workspace.
    """
    project_level(system, ws, y, 0)
    project_level(system, ws, y, 1)


@internal_kernel
def project_level(system: System, ws: Workspace, y, level):
    """Positions (level 0) or rates (1) of :func:`project`; returns ½ λᵀ J v, the kinetic energy that rates lose [J]."""
    state, active, column, small = ws.rows, ws.active, ws.column, ws.small
    n, p = ws.joints.shape[0], ws.counts[ka.ROWS]
    start = system.layout.q if level == 0 else system.layout.v
    for k in range(p):
        state[k, ka.RHS] = state[k, ka.ROW_GAP] if level == 0 else state[k, ka.ROW_RATE]
        for m in range(p):
            small[0, k, m] = 0.0
            for i in range(n):
                small[0, k, m] += column[i, 1 + 2 * k] * column[i, 1 + 2 * m] * ws.links[i, ka.INVERSE_D]
    solve_small(small, state, active, p)
    energy = 0.0
    for k in range(p):
        energy += 0.5 * state[k, ka.FORCE] * state[k, ka.RHS]
    for i in range(n):
        column[i, 0] = 0.0
        for k in range(p):
            column[i, 0] -= state[k, ka.FORCE] * column[i, 1 + 2 * k]
    accelerate(system.model, ws)
    if level == 0 and system.layout.extra > 0:
        displace(system.model, ws, y, start)
    else:
        for i in range(n):
            y[start + i] += ws.joints[i, ka.QDD]
    return energy


@internal_kernel
def settle(system: System, t, y, ws: Workspace, dy, run: Run):
    """Derivative at y, projecting y first where needed. Returns False when the rows cannot be met."""
    derivative(system, t, y, ws, dy)
    run.count[ki.EVALUATIONS] += 1
    for _ in range(PROJECTION_LIMIT):
        if not off_surface(ws):
            return True
        project(system, ws, y)
        derivative(system, t, y, ws, dy)
        run.count[ki.EVALUATIONS] += 1
        run.count[ki.PROJECTIONS] += 1
    return not off_surface(ws)
