"""Projection of positions and rates onto the constraints.

After each accepted step q and v are projected onto the closed contacts when they have left them by more than
``GAP_TOLERANCE`` or ``RATE_TOLERANCE``.
"""

from __future__ import annotations

import math

from dynsim.kernels.arrays import FORCE, GAP, GAP_RATE, INVERSE_D, QDD, RHS, SLIP_VELOCITY, Workspace
from dynsim.kernels.constraint.delassus import solve_small
from dynsim.kernels.integrate.run import EVALUATIONS, PROJECTIONS, Run
from dynsim.kernels.jit import internal_kernel, merged_kernel
from dynsim.kernels.system import System, derivative
from dynsim.kernels.tree.articulated import accelerate
from dynsim.kernels.tree.joints import displace

# Projection: a tenth of the drift that is promised (1e-9 m), and a rate that adds less than that in a step.
GAP_TOLERANCE = 1e-10
RATE_TOLERANCE = 1e-8
PROJECTION_LIMIT = 6


@internal_kernel
def off_surface(ws: Workspace):
    """True when a contact has left its surface by more than the projection tolerances."""
    state = ws.contacts
    for k in range(state.shape[0]):
        # Rounding limits the rate to a fraction of the speed.
        x, y, z = state[k, SLIP_VELOCITY], state[k, SLIP_VELOCITY + 1], state[k, SLIP_VELOCITY + 2]
        rate = RATE_TOLERANCE * (1.0 + math.sqrt(x * x + y * y + z * z))
        if abs(state[k, GAP]) > GAP_TOLERANCE or abs(state[k, GAP_RATE]) > rate:
            return True
    return False


@internal_kernel
def project(system: System, ws: Workspace, y):
    """One Newton step of q and v onto the contacts, weighted by the mass matrix, right after ``derivative`` at y.

    dq = −M⁻¹ Jᵀ λ with J M⁻¹ Jᵀ λ = gap, and the same for v with J v: the nearest point in the kinetic metric. The
    factors of M + J_m and the eliminated rows are those that the derivative has left in the workspace.
    """
    state, column, small = ws.contacts, ws.column, ws.small
    n, p = ws.joints.shape[0], state.shape[0]
    plain = system.layout.extra == 0
    for level in range(2):
        start = system.layout.q if level == 0 else system.layout.v
        for k in range(p):
            state[k, RHS] = state[k, GAP] if level == 0 else state[k, GAP_RATE]
            for m in range(p):
                small[0, k, m] = 0.0
                for i in range(n):
                    small[0, k, m] += column[i, 1 + 2 * k] * column[i, 1 + 2 * m] * ws.links[i, INVERSE_D]
        solve_small(small, state)
        for i in range(n):
            column[i, 0] = 0.0
            for k in range(p):
                column[i, 0] -= state[k, FORCE] * column[i, 1 + 2 * k]
        accelerate(system.model, ws)
        if level == 0 and not plain:
            displace(system.model, ws, y, start)
        else:
            for i in range(n):
                y[start + i] += ws.joints[i, QDD]


@merged_kernel
def settle(system: System, t, y, ws: Workspace, dy, run: Run):
    """Derivative at y, projecting y first where needed. Returns False when the contacts cannot be met."""
    derivative(system, t, y, ws, dy)
    run.count[EVALUATIONS] += 1
    for _ in range(PROJECTION_LIMIT):
        if not off_surface(ws):
            return True
        project(system, ws, y)
        derivative(system, t, y, ws, dy)
        run.count[EVALUATIONS] += 1
        run.count[PROJECTIONS] += 1
    return not off_surface(ws)
