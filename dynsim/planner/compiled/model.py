"""Cost of torques, and its Gauss–Newton model in the directions that stay on hand path and surfaces."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel
from dynsim.planner.compiled.linear import dot
from dynsim.planner.compiled.retract import constraint_rows, null_space
from dynsim.planner.compiled.tables import Arm, Course, Points, Work

# Fraction of the torque limits above which torques have an additional cost, and the factor of this cost relative to the
# heat.
NEAR_LIMIT, LIMIT_COST = 0.98, 100.0
# Exponent of the power mean that approximates the peak torque.
PEAK_POWER = 12


@internal_kernel
def costs(arm: Arm, course: Course, work: Work, Q, peak):
    """Compute cost and heat [W] of the torques in the workspace, and ``weight`` and ``pull`` of the quadratic model.

    Torques near their limits have an additional cost. ``peak`` is the cost of the maximum torque of revolute joints
    [W/(N m)], approximated by a power mean; forces of prismatic joints are excluded.
    """
    E, n = work.torque.shape
    heat, cost, largest, mean, revolute = 0.0, 0.0, 0.0, 0.0, 0
    for j in range(n):
        if not arm.prismatic[j]:
            revolute += 1
            for e in range(E):
                largest = max(largest, abs(work.torque[e, j]))
    for e in range(E):
        for j in range(n):
            torque, w, share = work.torque[e, j], arm.heat[j], course.share[e]
            heat += share * w * torque * torque
            work.weight[e, j], work.pull[e, j] = w, w * torque
            over = abs(torque) - NEAR_LIMIT * arm.greatest[j]
            if over > 0.0:
                cost += share * LIMIT_COST * w * over * over
                work.weight[e, j] += LIMIT_COST * w
                work.pull[e, j] += LIMIT_COST * w * math.copysign(over, torque)
            if peak > 0.0 and largest > 0.0 and not arm.prismatic[j]:
                mean += (abs(torque) / largest) ** PEAK_POWER / (E * revolute)
    if mean > 0.0:
        cost += peak * largest * mean ** (1.0 / PEAK_POWER)
        for e in range(E):
            for j in range(n):
                if arm.prismatic[j]:
                    continue
                torque = abs(work.torque[e, j])
                slope = (
                    peak * mean ** (1.0 / PEAK_POWER - 1.0) * (torque / largest) ** (PEAK_POWER - 1) / (E * revolute)
                )
                slope *= 0.5 / course.share[e]
                work.pull[e, j] += math.copysign(slope, work.torque[e, j])
                work.weight[e, j] += (PEAK_POWER - 1) * slope / max(torque, 1e-9)
    for k in range(Q.shape[0]):
        for l in range(Q.shape[0]):
            if course.smooth[k, l] != 0.0 or course.ripple[k, l] != 0.0:
                for j in range(n):
                    cost += course.smooth[k, l] * Q[k, j] * Q[l, j]
                    heat += course.ripple[k, l] * Q[k, j] * dot(work.jolt[j], Q[l])
    return cost + heat, heat


@internal_kernel
def prepare(arm: Arm, points: Points, course: Course, work: Work, Q, damping):
    """Compute matrix and gradient of the Gauss–Newton model in the null space of hand and braces, and in the forces.

    Returns the number of unknowns.
    """
    weight, pull = work.weight, work.pull
    n, c = arm.parent.shape[0], points.friction.shape[0]
    K, E = Q.shape[0], course.knot.shape[0]
    H, g, B, column, start, slope = work.H, work.g, work.B, work.column, work.start, work.slope
    # Number coupled unknowns close to each other, so that the matrix is banded.
    N, behind = 0, 0
    for k in range(K):
        work.free[k] = null_space(work, k, constraint_rows(course, work, k))
        start[k] = N
        N += work.free[k]
        while behind < E and course.knot[behind] == k:
            work.pressed[behind] = N
            N += c
            behind += 1
    g[:], H[:N, :N] = 0.0, 0.0
    for e in range(E):
        m = 0
        for k in range(K):
            if course.blend[e, k] == 0.0 and course.chord[e, k] == 0.0 and course.bend[e, k] == 0.0:
                continue
            for r in range(n):
                for j in range(n):
                    slope[r, j] = course.chord[e, k] * work.by_v[e, r, j] + course.blend[e, k] * work.by_q[e, r, j]
                    slope[r, j] += course.bend[e, k] * work.inertia[e, r, j]
            for d in range(n - work.free[k], n):
                column[m] = start[k] + d - (n - work.free[k])
                for r in range(n):
                    B[m, r] = dot(slope[r], work.basis[k, :, d])
                m += 1
        for i in range(c):
            column[m] = work.pressed[e] + i
            for r in range(n):
                B[m, r] = work.by_f[e, r, i]
            m += 1
        for a in range(m):
            g[column[a]] += course.share[e] * dot(pull[e], B[a])
            for r in range(n):
                work.rate[r] = course.share[e] * weight[e, r] * B[a, r]
            for b in range(a + 1):
                z, i, j = dot(work.rate, B[b]), column[a], column[b]
                if i >= j:
                    H[i, j] += z
                else:
                    H[j, i] += z
    for k in range(K):
        first = n - work.free[k]
        for l in range(K):
            smooth, ripple = course.smooth[k, l], course.ripple[k, l]
            if smooth == 0.0 and ripple == 0.0:
                continue
            other = n - work.free[l]
            for d in range(work.free[k]):
                # Row of the direction times the matrix that couples both knots.
                for j in range(n):
                    work.rate[j] = smooth * work.basis[k, j, first + d]
                    for i in range(n):
                        work.rate[j] += ripple * work.basis[k, i, first + d] * work.jolt[i, j]
                g[start[k] + d] += dot(work.rate, Q[l])
                if l <= k:
                    for b in range(work.free[l]):
                        if start[k] + d >= start[l] + b:
                            H[start[k] + d, start[l] + b] += dot(work.rate, work.basis[l, :, other + b])
    for k in range(K):
        for d in range(work.free[k]):
            H[start[k] + d, start[k] + d] += damping
    for e in range(E):
        for i in range(c):
            H[work.pressed[e] + i, work.pressed[e] + i] += 1e-9
    return N
