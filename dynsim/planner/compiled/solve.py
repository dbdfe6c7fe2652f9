"""Local solver: steps that minimise the model of the cost within clearances, joint limits and minimum forces."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.planner.compiled.geometry import NEARBY
from dynsim.planner.compiled.linear import backward, copy, dot, factor, forward, nonnegative
from dynsim.planner.compiled.model import costs, prepare
from dynsim.planner.compiled.retract import ON, REACH, margin, project
from dynsim.planner.compiled.statics import statics
from dynsim.planner.compiled.tables import Arm, Course, Points, Work

# Initial damping of the steps and its bounds, relative to the cost.
DAMPING, DAMPING_MIN, DAMPING_MAX = 1e-3, 1e-7, 1e6
# Number of further decreases of the cost, each like the last one, that may still bring it below its limit.
HOPE = 10
# Kinds of step constraints.
CLEAR, LOWER, UPPER, FORCE = 0, 1, 2, 3


@internal_kernel
def add_violated(arm: Arm, work: Work, m, before, kind, at, which, value, bound):
    """Add a violated constraint of the step as column m of ``work.normals``; return the new number of constraints."""
    if value >= bound - 1e-9 or m == work.bound.shape[0]:
        return m
    for i in range(before):
        if work.working[i, 0] == kind and work.working[i, 1] == at and work.working[i, 2] == which:
            return m
    n, normals = arm.parent.shape[0], work.normals
    work.working[m, 0], work.working[m, 1], work.working[m, 2], work.bound[m] = kind, at, which, bound
    normals[:, m] = 0.0
    if kind == FORCE:
        normals[work.pressed[at] + which, m] = 1.0
        return m + 1
    first = n - work.free[at]
    for d in range(work.free[at]):
        if kind == CLEAR:
            z = dot(work.gap_rate[at, which], work.basis[at, :, first + d])
        else:
            z = work.basis[at, which, first + d] * (1.0 if kind == LOWER else -1.0)
        normals[work.start[at] + d, m] = z
    return m + 1


@internal_kernel
def add_dual_rows(work: Work, N, before, m):
    """Add rows ``before`` to m − 1 of the dual problem and multiply the normals of these constraints by L⁻¹.

    The loop runs over rows of the matrix of normals, which the compiler can vectorise; most leading entries are zero.
    """
    L, normals, dual, right = work.H, work.normals, work.dual, work.dual_right
    for a in range(before, m):
        right[a] = work.bound[a]
        for b in range(a + 1):
            dual[a, b] = 1e-14 if a == b else 0.0
    for i in range(N):
        for k in range(work.skyline[i], i):
            for a in range(before, m):
                normals[i, a] -= L[i, k] * normals[k, a]
        for a in range(before, m):
            normals[i, a] /= L[i, i]
            z = normals[i, a]
            if z != 0.0:
                right[a] -= z * work.x[i]
                for b in range(a + 1):
                    dual[a, b] += z * normals[i, b]
    for a in range(before, m):
        for b in range(a):
            dual[b, a] = dual[a, b]


@internal_kernel
def step(arm: Arm, points: Points, course: Course, work: Work, Q, F, min_force, N):
    """Compute the step that minimises the model of :func:`prepare` within clearances, limits and minimum forces.

    The matrix is factorised in place. Violated constraints are added one after the other, and the dual problem
    min ½ λᵀ A H⁻¹ Aᵀ λ − λ·(b − A x_0) of the constraints added so far is solved. The change of the postures is written
    to ``work.change``. Returns twice the decrease of the model, −g·x − λ·b.
    """
    n, c, P = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0]
    K, E = Q.shape[0], course.knot.shape[0]
    H, g, x, skyline = work.H, work.g, work.x, work.skyline
    factor(H, skyline, 0, N)
    # x holds −L⁻¹ g; the unconstrained step is x_0 = −H⁻¹ g = L⁻ᵀ x.
    for i in range(N):
        x[i] = -g[i]
    forward(H, skyline, x, N)
    work.multiplier[:] = 0.0
    m = 0
    full = work.step
    for _ in range(12):
        # The step is L⁻ᵀ (x + Σ λ L⁻¹ a).
        for i in range(N):
            full[i] = x[i]
            for a in range(m):
                if work.multiplier[a] != 0.0:
                    full[i] += work.multiplier[a] * work.normals[i, a]
        backward(H, skyline, full, N)
        for k in range(K):
            for j in range(n):
                work.change[k, j] = dot(work.basis[k, j, n - work.free[k] :], full[work.start[k] :])
        before = m
        for e in range(E):
            for i in range(c):
                if course.acting[e, i] == 0:
                    continue
                value, slack = full[work.pressed[e] + i], min_force - F[e, i]
                m = add_violated(arm, work, m, before, FORCE, e, i, value, slack)
        for k in range(K):
            for i in range(P):
                slack = min(margin(course, points, k, i) - work.gap[k, i], 0.0)
                if slack < -NEARBY:
                    continue
                z = dot(work.gap_rate[k, i], work.change[k])
                m = add_violated(arm, work, m, before, CLEAR, k, i, z, slack)
            for j in range(n):
                z, low, high = work.change[k, j], arm.lower[j] - Q[k, j], arm.upper[j] - Q[k, j]
                m = add_violated(arm, work, m, before, LOWER, k, j, z, min(low, 0.0))
                m = add_violated(arm, work, m, before, UPPER, k, j, -z, -max(high, 0.0))
        if m == before:
            break
        add_dual_rows(work, N, before, m)
        nonnegative(work, work.dual, work.dual_right, work.multiplier, before, m)
    fall = 0.0
    for i in range(N):
        fall -= g[i] * full[i]
    for a in range(m):
        fall -= work.multiplier[a] * work.bound[a]
    return fall


@kernel
def solve(arm: Arm, points: Points, course: Course, work: Work, Q, F, min_force, peak, turns, tolerance, most):
    """Minimise the cost over postures Q, shape (K, n), and forces F, shape (E, c), in place, from a nearby start.

    The iteration ends early if the cost is unlikely to fall below ``most`` [W]. Returns cost [W], heat [W] and number
    of steps; NaN if the start cannot be projected onto path and surfaces.
    """
    if project(arm, points, course, work, Q, 60, ON) > 2.0 * ON:
        return math.nan, math.nan, 0
    statics(arm, points, course, work, Q, F, min_force, True)
    cost, heat = costs(arm, course, work, Q, peak)
    damping, quiet, taken, ratio = DAMPING, 0, 0, 0.0
    scale = max(cost, 0.1)
    trial, forces = work.trial, work.trial_forces
    while taken < turns:
        taken += 1
        before = cost
        while damping < DAMPING_MAX:
            N = prepare(arm, points, course, work, Q, damping * scale + 1e-6)
            fall = step(arm, points, course, work, Q, F, min_force, N)
            if not fall > 0.0 or fall < tolerance * 0.1 * max(cost, 1e-3):
                break
            longest = 1e-300
            for change in work.change.flat:
                longest = max(longest, abs(change))
            share = min(1.0, REACH / longest)
            for k in range(Q.shape[0]):
                for j in range(Q.shape[1]):
                    trial[k, j] = Q[k, j] + share * work.change[k, j]
            if project(arm, points, course, work, trial, 12, ON) <= 2.0 * ON:
                statics(arm, points, course, work, trial, forces, min_force, True)
                there, warmth = costs(arm, course, work, trial, peak)
                if there < cost:
                    ratio = (cost - there) / (fall * share * (2.0 - share))
                    cost, heat = there, warmth
                    copy(trial, Q)
                    copy(forces, F)
                    break
            damping *= 8.0
            statics(arm, points, course, work, Q, F, min_force, False)
            costs(arm, course, work, Q, peak)
        if not cost < before:
            break
        if ratio > 0.7:
            damping = max(damping / 6.0, DAMPING_MIN)
        elif ratio < 0.25:
            damping *= 3.0
        quiet = quiet + 1 if before - cost < tolerance * max(cost, 1e-3) else 0
        if quiet >= 2 or cost - HOPE * (before - cost) > most:
            break
    statics(arm, points, course, work, Q, F, min_force, False)
    return cost, heat, taken
