"""The paper's dense system M* x = b, x = (vdot, f_n, di/dt) ([WM] eqs 31–35), a readable reference for tests."""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.shares import solve_rows
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.drive.law import dc_balance
from dynsim.dynamics.tables import DriveArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.sweep import mass_matrix, newton_euler
from dynsim.jit.kernel import internal_kernel


@internal_kernel
def solve_m_star(K, model: ModelArrays, drives: DriveArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Fill M* and b and solve for vdot, contact forces and di/dt.

    [M + J_m, −Fᵀ, 0; J, 0, 0; 0, 0, L] [vdot; f; di/dt] = [applied; target; u − R i − K_m v]. With friction, F (force
    directions) differs from J (rows), because the paper's term −J_tᵀ f_t with f_t = μ f_n is on the left side here.
    Call this function after ``contact_rows``, because the mass matrix overwrites the velocities and wrenches of the
    sweep.

    Parameters
    ----------
    K : (n + p + k or more, n + p + k + 1 or more) ndarray
        Scratch for M* with b as its last column; k motors have a circuit.
    """
    n, p, na = model.tree.shape[0], ws.counts[ka.ROWS], drives.table.shape[0]
    size = K.shape[0]
    links, joints, motors, state = ws.links, ws.joints, ws.motors, ws.rows
    K[:, : size + 1] = 0.0
    newton_euler(model, ws, 1.0, 0.0, 1.0)
    for i in range(n):
        K[i, size] = joints[i, ka.APPLIED] - joints[i, ka.BIAS]
    mass_matrix(model, ws, K)
    for i in range(n):
        K[i, i] += model.body[i, ka.ARMATURE]
    for k in range(p):
        K[n + k, size] = state[k, ka.TARGET]
        for end in range(2):
            j, sign = (ws.active[k, ka.BODY_A], 1.0) if end == 0 else (ws.active[k, ka.BODY_B], -1.0)
            if ws.active[k, ka.ROW_KIND] == ka.JOINT_ROW:
                K[n + k, j] += state[k, ka.ROW + end]
                K[j, n + k] -= state[k, ka.DIRECTION + end]
                continue
            while j >= 0:
                for s in range(6):
                    K[n + k, j] += sign * links[j, ka.S + s] * state[k, ka.ROW + s]
                    K[j, n + k] -= sign * links[j, ka.S + s] * state[k, ka.DIRECTION + s]
                j = model.tree[j, ka.PARENT]
    for a in range(na):
        row = n + p + drives.table[a, ka.CIRCUIT]
        if row >= n + p:
            v = joints[drives.table[a, ka.DRIVEN], ka.QD]
            K[row, size] = dc_balance(drives.motor, a, motors[a, ka.VOLTAGE], v, motors[a, ka.CURRENT])
            K[row, row] = drives.motor[a, ka.INDUCTANCE]
    # Gaussian elimination. The positive definite mass block needs no pivoting; eliminating it leaves J (M + J_m)⁻¹ F in
    # the constraint block, which is not symmetric and may be rank-deficient.
    for k in range(n):
        inverse = 1.0 / K[k, k]
        for i in range(k + 1, n + p):
            factor = K[i, k] * inverse
            if factor != 0.0:
                for j in range(k + 1, n + p):
                    K[i, j] -= factor * K[k, j]
                K[i, size] -= factor * K[k, size]
    for k in range(p):
        state[k, ka.RHS] = K[n + k, size]
        for m in range(p):
            ws.small[0, k, m] = K[n + k, n + m]
    ws.counts[ka.DEPENDENT] += solve_rows(unilateral, ws, p)
    for a in range(na):
        row = n + p + drives.table[a, ka.CIRCUIT]
        if row >= n + p:
            motors[a, ka.DIDT] = K[row, size] / K[row, row]
    for i in range(n - 1, -1, -1):
        total = K[i, size]
        for k in range(p):
            total -= K[i, n + k] * state[k, ka.FORCE]
        for j in range(i + 1, n):
            total -= K[i, j] * joints[j, ka.QDD]
        joints[i, ka.QDD] = total / K[i, i]
