"""RODAS4, a linearly implicit method: one step, with the circuits and positions eliminated from its linear systems."""

from __future__ import annotations

from dynsim.kernels.arrays import CIRCUIT, DRIVEN, RATE_I, RATE_Q, RATE_V, Workspace
from dynsim.kernels.drive.law import drive_block
from dynsim.kernels.integrate.run import EVALUATIONS, STEP, TIME, Run
from dynsim.kernels.integrate.steps import error_norm
from dynsim.kernels.integrate.tableaux import A_RODAS, C_RODAS, GAMMA, GAMMA_RODAS, NODE_RODAS
from dynsim.kernels.jit import merged_kernel
from dynsim.kernels.system import System, derivative


@merged_kernel
def differentiate(system: System, ws: Workspace, run: Run):
    """Finite differences of the right-hand side along q, v, i and t at (TIME, y), into ``run.jacobian``.

    Currents enter linearly, so their differences are exact; the stiff electrical rows are not taken from here but
    are the drives' own, in ``run.linear``. What drives without a circuit do is part of the differences along q and v.
    """
    t, y, y_new, k = run.clock[TIME], run.y, run.y_new, run.stage
    m, states = y.shape[0], system.layout.tracked
    for j in range(m):
        y_new[j] = y[j]
    # The workspace may still hold a sample or a rejected step.
    derivative(system, t, y, ws, k[7])
    for a in range(ws.motors.shape[0]):
        drive_block(system.drives, ws, a, run.linear[a])
    for s in range(states):
        delta = 1e-7 * max(abs(y[s]), 1.0)
        y_new[s] = y[s] + delta
        delta = y_new[s] - y[s]
        derivative(system, t, y_new, ws, run.jacobian[s])
        for j in range(m):
            run.jacobian[s, j] = (run.jacobian[s, j] - k[0, j]) / delta
        y_new[s] = y[s]
    delta = 1e-6
    derivative(system, t + delta, y_new, ws, run.jacobian[states])
    for j in range(m):
        run.jacobian[states, j] = (run.jacobian[states, j] - k[0, j]) / delta
    run.count[EVALUATIONS] += states + 2


@merged_kernel
def factor_stage_matrix(system: System, ws: Workspace, run: Run, h):
    """Reduced stage matrix of RODAS4 in the rates alone, LU-factored with partial pivoting, into ``run.matrix``.

    With g = 1/(γ h), and a, b, c for ∂(di/dt)/∂(q, v, i): u_q = (r_q + u_v)/g and u_i = (r_i + a u_q + b u_v)/(g − c)
    are exact, which leaves (g − ∂v̇/∂v − ∂v̇/∂q/g − ∂v̇/∂i (a/g + b)/(g − c)) u_v = r.
    """
    W, jacobian, block, table = run.matrix, run.jacobian, run.linear, system.drives.table
    n, na = ws.joints.shape[0], ws.motors.shape[0]
    q, v, current = system.layout.q, system.layout.v, system.layout.current
    g = 1.0 / (GAMMA * h)
    for i in range(n):
        for j in range(n):
            W[i, j] = -jacobian[v + j, v + i] - jacobian[q + j, v + i] / g
        W[i, i] += g
    for a in range(na):
        j, row = table[a, DRIVEN], current + table[a, CIRCUIT]
        if row >= current:
            slope = (block[a, RATE_Q] / g + block[a, RATE_V]) / (g - block[a, RATE_I])
            for i in range(n):
                W[i, j] -= jacobian[row, v + i] * slope
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(W[i, k]) > abs(W[best, k]):
                best = i
        run.pivot[k] = best
        if best != k:
            for j in range(n):
                W[k, j], W[best, j] = W[best, j], W[k, j]
        for i in range(k + 1, n):
            W[i, k] /= W[k, k]
            for j in range(k + 1, n):
                W[i, j] -= W[i, k] * W[k, j]


@merged_kernel
def step_rodas4(system: System, ws: Workspace, run: Run):
    """One RODAS4 step; returns the error norm. stage[1…5] are stage vectors, stage[6] the derivative at y_new.

    (1/(γh) − J) u_i = f(t + α_i h, y + Σ a_ij u_j) + Σ c_ij u_j / h + γ_i h ∂f/∂t; y_new = y + Σ a_6j u_j + u_6, and
    u_6 is the error estimate.
    """
    t, h, y, y_new, k = run.clock[TIME], run.clock[STEP], run.y, run.y_new, run.stage
    n, na, m = ws.joints.shape[0], ws.motors.shape[0], run.y.shape[0]
    q, v, current, states = system.layout.q, system.layout.v, system.layout.current, system.layout.tracked
    differentiate(system, ws, run)
    factor_stage_matrix(system, ws, run, h)
    g = 1.0 / (GAMMA * h)
    block, table, jacobian, W, r = run.linear, system.drives.table, run.jacobian, run.matrix, k[7]
    for s in range(6):
        u = k[1 + s]
        for j in range(m):
            y_new[j] = y[j]
            for p in range(s):
                y_new[j] += A_RODAS[s, p] * k[1 + p, j]
        derivative(system, t + NODE_RODAS[s] * h, y_new, ws, r)
        for j in range(m):
            r[j] += GAMMA_RODAS[s] * h * jacobian[states, j]
            for p in range(s):
                r[j] += C_RODAS[s, p] / h * k[1 + p, j]
        for i in range(n):
            u[v + i] = r[v + i]
            for j in range(n):
                u[v + i] += jacobian[q + j, v + i] * r[q + j] / g
        for a in range(na):
            j, row = table[a, DRIVEN], current + table[a, CIRCUIT]
            if row >= current:
                free = (r[row] + block[a, RATE_Q] * r[q + j] / g) / (g - block[a, RATE_I])
                for i in range(n):
                    u[v + i] += jacobian[row, v + i] * free
        for i in range(n):
            p = run.pivot[i]
            u[v + i], u[v + p] = u[v + p], u[v + i]
        for i in range(n):
            for j in range(i):
                u[v + i] -= W[i, j] * u[v + j]
        for i in range(n - 1, -1, -1):
            for j in range(i + 1, n):
                u[v + i] -= W[i, j] * u[v + j]
            u[v + i] /= W[i, i]
        for i in range(n):
            u[q + i] = (r[q + i] + u[v + i]) / g
        for a in range(na):
            j, row = table[a, DRIVEN], current + table[a, CIRCUIT]
            if row >= current:
                pull = block[a, RATE_Q] * u[q + j] + block[a, RATE_V] * u[v + j]
                u[row] = (r[row] + pull) / (g - block[a, RATE_I])
        for j in range(states, m):
            total = r[j]
            for p in range(states):
                total += jacobian[p, j] * u[p]
            u[j] = total / g
    for j in range(m):
        y_new[j] += k[6, j]
        k[7, j] = k[6, j]
    error = error_norm(system, ws, run, k[7])
    derivative(system, t + h, y_new, ws, k[6])
    run.count[EVALUATIONS] += 7
    return error
