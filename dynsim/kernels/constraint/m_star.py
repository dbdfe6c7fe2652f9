"""The paper's dense system M* x = b, x = (vdot, f_n, di/dt) ([WM] eqs 31–35): readable reference and test oracle."""

from __future__ import annotations

from dynsim.kernels.arrays import (
    APPLIED,
    ARMATURE,
    BIAS,
    BODY_A,
    BODY_B,
    DEPENDENT,
    DIDT,
    DIRECTION,
    FORCE,
    INDUCTANCE,
    JOINT_ROW,
    PARENT,
    QDD,
    RHS,
    ROW,
    ROW_KIND,
    ROWS,
    TARGET,
    DriveArrays,
    ModelArrays,
    S,
    Workspace,
)
from dynsim.kernels.constraint.delassus import solve_small
from dynsim.kernels.drive.law import emf_balance
from dynsim.kernels.jit import internal_kernel
from dynsim.kernels.tree.sweep import mass_matrix, newton_euler


@internal_kernel
def solve_m_star(K, model: ModelArrays, drives: DriveArrays, ws: Workspace):
    """Fill M* and b and solve for vdot, contact forces and di/dt.

    K : (n + p + na, n + p + na + 1) or more, room for M* with b as its last column.

    [M + J_m, −Fᵀ, 0; J, 0, 0; 0, 0, L] [vdot; f; di/dt] = [applied; target; u − R i − K_m v]. F (force directions)
    differs from J (rows) under friction: the paper's −J_tᵀ f_t with f_t = μ f_n has moved to the left side. Call after
    ``contact_rows``: the mass matrix overwrites velocities and wrenches of the sweep.
    """
    n, p, na = model.tree.shape[0], ws.counts[ROWS], drives.link.shape[0]
    size = n + p + na
    links, joints, state = ws.links, ws.joints, ws.rows
    for i in range(size):
        for j in range(size + 1):
            K[i, j] = 0.0
    newton_euler(model, ws, 1.0, 0.0, 1.0)
    for i in range(n):
        K[i, size] = joints[i, APPLIED] - joints[i, BIAS]
    mass_matrix(model, ws, K)
    for i in range(n):
        K[i, i] += model.body[i, ARMATURE]
    for k in range(p):
        K[n + k, size] = state[k, TARGET]
        for end in range(2):
            j, sign = (ws.active[k, BODY_A], 1.0) if end == 0 else (ws.active[k, BODY_B], -1.0)
            if ws.active[k, ROW_KIND] == JOINT_ROW:
                K[n + k, j] += state[k, ROW + end]
                K[j, n + k] -= state[k, DIRECTION + end]
                continue
            while j >= 0:
                for s in range(6):
                    K[n + k, j] += sign * links[j, S + s] * state[k, ROW + s]
                    K[j, n + k] -= sign * links[j, S + s] * state[k, DIRECTION + s]
                j = model.tree[j, PARENT]
    for a in range(na):
        K[n + p + a, size] = emf_balance(drives, ws, a)
        K[n + p + a, n + p + a] = drives.motor[a, INDUCTANCE]
    # Gaussian elimination. The positive definite mass block needs no pivoting; what it leaves of the constraint block
    # is J (M + J_m)⁻¹ F, not symmetric and perhaps of deficient rank.
    for k in range(n):
        inverse = 1.0 / K[k, k]
        for i in range(k + 1, n + p):
            factor = K[i, k] * inverse
            if factor != 0.0:
                for j in range(k + 1, n + p):
                    K[i, j] -= factor * K[k, j]
                K[i, size] -= factor * K[k, size]
    for k in range(p):
        state[k, RHS] = K[n + k, size]
        for m in range(p):
            ws.small[0, k, m] = K[n + k, n + m]
    ws.counts[DEPENDENT] += solve_small(ws.small, state, ws.active, p)
    for a in range(na):
        ws.motors[a, DIDT] = K[n + p + a, size] / K[n + p + a, n + p + a]
    for i in range(n - 1, -1, -1):
        total = K[i, size]
        for k in range(p):
            total -= K[i, n + k] * state[k, FORCE]
        for j in range(i + 1, n):
            total -= K[i, j] * joints[j, QDD]
        joints[i, QDD] = total / K[i, i]
