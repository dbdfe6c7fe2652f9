"""RADAU5, Radau IIA of order 5 with three stages: one step by simplified Newton, circuits and positions eliminated.

Stages Z_i = h Σ a_ij f(t + c_j h, y + Z_j), and y_new = y + Z_3 (Hairer, Wanner: Solving Ordinary Differential
Equations II, IV.8). With W = T⁻¹ Z the linear systems of Newton's method fall apart into a real one and a complex one
of the size of the state, g I − J with g = γ/h or (α + iβ)/h, and these into ones of the size of the rates. Of

    q̇ = N v,    v̇ = f(q, v, i),    di/dt = a q + b v + c i + …

the first and the last rows are solved by hand, u_q = (r_q + N u_v)/g and u_i = (r_i + a u_q + b u_v)/(g − c), so

    (g − ∂f/∂v − ∂f/∂θ/g − ∂f/∂i (a/g + b)/(g − c)) u_v = r_v + ∂f/∂θ N⁺ r_q/g + ∂f/∂i (r_i + a r_q/g)/(g − c),

θ being displacements along the rates. The change of N along q is left out of the Jacobian, which costs Newton's method
some contraction where a body tumbles, not accuracy. Jacobian and factors are kept for as long as it contracts.
"""

from __future__ import annotations

import math

from dynsim.kernels.arrays import CIRCUIT, DRIVEN, QDD, RATE_I, RATE_Q, RATE_V, Workspace
from dynsim.kernels.drive.law import drive_block
from dynsim.kernels.integrate.newton import (
    CLOSE,
    CONTRACTION,
    DIVERGED,
    EXTRAPOLATES,
    FACTORED,
    FACTORS,
    ITERATIONS,
    JACOBIANS,
    KEPT,
    LEVER,
    MADE_AT,
    SEEN,
    STALE,
    TRIED,
    NewtonArrays,
)
from dynsim.kernels.integrate.run import ATOL, EVALUATIONS, RTOL, STEP, STEPS, TIME, Run
from dynsim.kernels.integrate.steps import error_norm
from dynsim.kernels.integrate.tableaux import (
    A_RADAU,
    ALPHA_RADAU,
    BETA_RADAU,
    ERROR_RADAU,
    GAMMA_RADAU,
    NODE_RADAU,
    T_INVERSE_RADAU,
    T_RADAU,
)
from dynsim.kernels.jit import internal_kernel, merged_kernel
from dynsim.kernels.system import System, derivative
from dynsim.kernels.tree.joints import displace, positions_along, rates_across

# Newton's method: most iterations, and the contraction below which the Jacobian stays.
MOST_ITERATIONS, GOOD_CONTRACTION = 8, 0.05
# What a step whose Newton's method diverges is said to be in error by: half of it is tried next.
NO_STAGES = 10.5


@merged_kernel
def differentiate(system: System, ws: Workspace, run: Run):
    """Finite differences of v̇ along the rates' displacements, the rates and the currents, at (TIME, y).

    The stiff electrical rows are not taken from here but are the drives' own; v̇ is linear in the currents.
    """
    t, y, x, base, r = run.clock[TIME], run.y, run.stage[6], run.stage[7], run.newton
    n, v, joints = ws.joints.shape[0], system.layout.v, ws.joints
    # The workspace may still hold a sample or a rejected step.
    derivative(system, t, y, ws, base)
    for a in range(ws.motors.shape[0]):
        drive_block(system.drives, ws, a, r.linear[a])
    for s in range(r.along.shape[0]):
        for j in range(y.shape[0]):
            x[j] = y[j]
        if s < n and system.layout.extra > 0:
            delta = 1e-7
            for i in range(n):
                joints[i, QDD] = delta if i == s else 0.0
            displace(system.model.compound, system.model, ws, x, system.layout.q)
        else:
            j = system.layout.q + s if s < n else v + s - n if s < 2 * n else system.layout.current + s - 2 * n
            delta = 1e-3 if s >= 2 * n else 1e-8 * max(abs(y[j]), 0.1) if s >= n else 1e-7 * max(abs(y[j]), 1.0)
            x[j] = y[j] + delta
            delta = x[j] - y[j]
        derivative(system, t, x, ws, r.f[0])
        for i in range(n):
            r.along[s, i] = (r.f[0, v + i] - base[v + i]) / delta
    run.count[EVALUATIONS] += r.along.shape[0] + 1
    r.count[JACOBIANS] += 1
    r.count[STALE], r.count[MADE_AT], r.clock[FACTORED] = 0, run.count[STEPS], 0.0


@internal_kernel
def factor_newton(system: System, r: NewtonArrays, g, matrix, pivot):
    """The reduced matrix for g, real or complex, LU-factored with partial pivoting."""
    along, block, table = r.along, r.linear, system.drives.table
    n = matrix.shape[0]
    first = 2 * n  # of the rows of circuits
    for i in range(n):
        for j in range(n):
            matrix[i, j] = -along[n + j, i] - along[j, i] / g
        matrix[i, i] += g
    for a in range(table.shape[0]):
        j, k = table[a, DRIVEN], table[a, CIRCUIT]
        if k >= 0:
            slope = (block[a, RATE_Q] / g + block[a, RATE_V]) / (g - block[a, RATE_I])
            for i in range(n):
                matrix[i, j] -= along[first + k, i] * slope
    for k in range(n):
        best, largest = k, 0.0
        for i in range(k, n):
            x = matrix[i, k]
            size = x.real * x.real + x.imag * x.imag
            if size > largest:
                best, largest = i, size
        pivot[k] = best
        if best != k:
            for j in range(n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        for i in range(k + 1, n):
            matrix[i, k] /= matrix[k, k]
            for j in range(k + 1, n):
                matrix[i, j] -= matrix[i, k] * matrix[k, j]


@internal_kernel
def solve_newton(system: System, ws: Workspace, y, r: NewtonArrays, g, matrix, pivot, x, room):
    """x ← (g I − J)⁻¹ x by the factors of :func:`factor_newton`, x (s,) and room (2, s) real or complex."""
    along, block, table, layout = r.along, r.linear, system.drives.table, system.layout
    n, q, v, current = matrix.shape[0], system.layout.q, system.layout.v, system.layout.current
    u, angle, first = room[0], room[1], 2 * n
    if layout.extra > 0:
        rates_across(system.model.compound, system.model, y, q, x, angle)
    for i in range(n):
        angle[i] = (angle[i] if layout.extra > 0 else x[q + i]) / g
        u[i] = x[v + i]
    for j in range(n):
        for i in range(n):
            u[i] += along[j, i] * angle[j]
    for a in range(table.shape[0]):
        j, k = table[a, DRIVEN], table[a, CIRCUIT]
        if k >= 0:
            free = (x[current + k] + block[a, RATE_Q] * angle[j]) / (g - block[a, RATE_I])
            for i in range(n):
                u[i] += along[first + k, i] * free
    for i in range(n):
        p = pivot[i]
        u[i], u[p] = u[p], u[i]
    for i in range(n):
        for j in range(i):
            u[i] -= matrix[i, j] * u[j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            u[i] -= matrix[i, j] * u[j]
        u[i] /= matrix[i, i]
    for a in range(table.shape[0]):
        j, k = table[a, DRIVEN], table[a, CIRCUIT]
        if k >= 0:
            pull = block[a, RATE_Q] * (angle[j] + u[j] / g) + block[a, RATE_V] * u[j]
            x[current + k] = (x[current + k] + pull) / (g - block[a, RATE_I])
    for i in range(n):
        x[v + i] = u[i]
        if layout.extra == 0:
            x[q + i] = angle[i] + u[i] / g
    if layout.extra > 0:
        positions_along(system.model.compound, system.model, y, q, u, x)
        for j in range(q, q + n + layout.extra):
            x[j] /= g


@internal_kernel
def keep_stages(run: Run):
    """The stages of the step accepted last, as a polynomial for the first guess of the next ones."""
    r, c0, c1 = run.newton, NODE_RADAU[0], NODE_RADAU[1]
    if r.count[SEEN] == run.count[STEPS]:
        return
    r.count[SEEN], r.count[EXTRAPOLATES], r.clock[KEPT] = run.count[STEPS], 1, r.clock[TRIED]
    for j in range(r.kept.shape[1]):
        z0, z1, z2 = r.z[0, j], r.z[1, j], r.z[2, j]
        slope, middle = (z1 - z2) / (c1 - 1.0), (z0 - z1) / (c0 - c1)
        bend = (middle - slope) / (c0 - 1.0)
        r.kept[0, j], r.kept[1, j], r.kept[2, j] = slope, bend, bend - (middle - z0 / c0) / c1


@internal_kernel
def guess_stages(run: Run, h):
    """First guess of the stages, where the last ones lead to."""
    r, c0, c1 = run.newton, NODE_RADAU[0], NODE_RADAU[1]
    ahead = h / r.clock[KEPT] if r.count[EXTRAPOLATES] == 1 else 0.0
    for j in range(r.kept.shape[1]):
        for s in range(3):
            x = NODE_RADAU[s] * ahead
            r.z[s, j] = x * (r.kept[0, j] + (x - (c1 - 1.0)) * (r.kept[1, j] + (x - (c0 - 1.0)) * r.kept[2, j]))
    for j in range(r.kept.shape[1]):
        for s in range(3):
            r.w[s, j] = (
                T_INVERSE_RADAU[s, 0] * r.z[0, j]
                + T_INVERSE_RADAU[s, 1] * r.z[1, j]
                + T_INVERSE_RADAU[s, 2] * r.z[2, j]
            )


@merged_kernel
def solve_stages(system: System, ws: Workspace, run: Run, h):
    """Newton's method for the stages of a step of length h; True when it has converged."""
    t, y, x, r = run.clock[TIME], run.y, run.y_new, run.newton
    tracked, before, contraction = r.kept.shape[1], 0.0, 0.0
    g, c = GAMMA_RADAU / h, complex(ALPHA_RADAU / h, BETA_RADAU / h)
    guess_stages(run, h)
    lever, least = max(r.clock[LEVER], 1e-16) ** 0.8, 1 - r.count[EXTRAPOLATES]
    for k in range(MOST_ITERATIONS):
        for s in range(3):
            for j in range(tracked):
                x[j] = y[j] + r.z[s, j]
            derivative(system, t + NODE_RADAU[s] * h, x, ws, r.f[s])
        run.count[EVALUATIONS] += 3
        r.count[ITERATIONS] += 1
        for j in range(tracked):
            f0, f1, f2 = r.f[0, j], r.f[1, j], r.f[2, j]
            r.one[j] = T_INVERSE_RADAU[0, 0] * f0 + T_INVERSE_RADAU[0, 1] * f1 + T_INVERSE_RADAU[0, 2] * f2
            r.one[j] -= g * r.w[0, j]
            r.two[j] = complex(
                T_INVERSE_RADAU[1, 0] * f0 + T_INVERSE_RADAU[1, 1] * f1 + T_INVERSE_RADAU[1, 2] * f2,
                T_INVERSE_RADAU[2, 0] * f0 + T_INVERSE_RADAU[2, 1] * f1 + T_INVERSE_RADAU[2, 2] * f2,
            ) - c * complex(r.w[1, j], r.w[2, j])
        solve_newton(system, ws, y, r, g, r.real, r.pivot[0], r.one, r.room_one)
        solve_newton(system, ws, y, r, c, r.complex, r.pivot[1], r.two, r.room_two)
        total = 0.0
        for j in range(tracked):
            d0, d1, d2 = r.one[j], r.two[j].real, r.two[j].imag
            total += (d0 * d0 + d1 * d1 + d2 * d2) * r.weight[j] * r.weight[j]
        change = math.sqrt(total / (3 * tracked))
        if not change < 1e30:
            return False
        if k > 0:
            ratio = change / before
            contraction = ratio if k == 1 else math.sqrt(ratio * contraction)
            if contraction >= 0.99:
                return False
            lever = contraction / (1.0 - contraction)
            if lever * change * contraction ** (MOST_ITERATIONS - 2 - k) >= r.clock[CLOSE]:
                return False
            r.clock[CONTRACTION] = contraction
        before = max(change, 1e-16)
        for j in range(tracked):
            r.w[0, j] += r.one[j]
            r.w[1, j] += r.two[j].real
            r.w[2, j] += r.two[j].imag
            for s in range(3):
                r.z[s, j] = T_RADAU[s, 0] * r.w[0, j] + T_RADAU[s, 1] * r.w[1, j] + T_RADAU[s, 2] * r.w[2, j]
        # The ledger adds up the derivatives of the last iterate but one: where nothing was known before, one more.
        if lever * change <= r.clock[CLOSE] and k >= least:
            r.clock[LEVER] = lever
            return True
    return False


@internal_kernel
def estimate(system: System, ws: Workspace, run: Run, h, slope):
    """Norm of the error (γ/h − J)⁻¹ (f + Σ e_s Z_s / h), of order 3, into stage[7]; f is ``slope``."""
    r, error = run.newton, run.stage[7]
    for j in range(r.one.shape[0]):
        r.one[j] = slope[j] + (ERROR_RADAU[0] * r.z[0, j] + ERROR_RADAU[1] * r.z[1, j] + ERROR_RADAU[2] * r.z[2, j]) / h
    solve_newton(system, ws, run.y, r, GAMMA_RADAU / h, r.real, r.pivot[0], r.one, r.room_one)
    for j in range(error.shape[0]):
        error[j] = r.one[j] if j < r.one.shape[0] else 0.0
    return error_norm(system, ws, run, error)


@merged_kernel
def step_radau5(system: System, ws: Workspace, run: Run):
    """One RADAU5 step; returns the error norm. stage[6] is the derivative at y_new."""
    t, h, y, y_new, r = run.clock[TIME], run.clock[STEP], run.y, run.y_new, run.newton
    tracked = r.kept.shape[1]
    keep_stages(run)
    for j in range(tracked):
        r.weight[j] = 1.0 / (run.clock[ATOL] + run.clock[RTOL] * abs(y[j]))
    solved = False
    while not solved:
        if r.count[STALE] == 1:
            differentiate(system, ws, run)
        if r.clock[FACTORED] != h:
            factor_newton(system, r, GAMMA_RADAU / h, r.real, r.pivot[0])
            factor_newton(system, r, complex(ALPHA_RADAU / h, BETA_RADAU / h), r.complex, r.pivot[1])
            r.clock[FACTORED] = h
            r.count[FACTORS] += 1
        if solve_stages(system, ws, run, h):
            solved = True
        elif r.count[MADE_AT] == run.count[STEPS]:
            r.count[DIVERGED] += 1
            r.clock[LEVER] = 1.0
            for j in range(y.shape[0]):
                y_new[j], run.stage[6, j] = y[j], run.stage[0, j]
            return NO_STAGES
        else:
            r.count[STALE] = 1
    r.clock[TRIED] = h
    for j in range(y.shape[0]):
        if j >= tracked:
            for s in range(3):
                r.z[s, j] = h * (A_RADAU[s, 0] * r.f[0, j] + A_RADAU[s, 1] * r.f[1, j] + A_RADAU[s, 2] * r.f[2, j])
        y_new[j] = y[j] + r.z[2, j]
    error = estimate(system, ws, run, h, run.stage[0])
    if error >= 1.0:
        for j in range(y.shape[0]):
            run.stage[6, j] = y[j] + run.stage[7, j]
        derivative(system, t, run.stage[6], ws, r.f[0])
        run.count[EVALUATIONS] += 1
        error = estimate(system, ws, run, h, r.f[0])
    derivative(system, t + h, y_new, ws, run.stage[6])
    run.count[EVALUATIONS] += 1
    return error


@internal_kernel
def after_step(run: Run, h):
    """Whether the Jacobian stays, and the factors, after a step of length h was accepted."""
    r, clock = run.newton, run.clock
    if r.clock[CONTRACTION] > GOOD_CONTRACTION:
        r.count[STALE] = 1
    elif h <= clock[STEP] <= 1.2 * h:
        clock[STEP] = h
