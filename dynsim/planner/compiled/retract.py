"""Projection of postures onto hand path and surfaces, and the directions that stay on them."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.planner.compiled.geometry import geometry
from dynsim.planner.compiled.linear import backward, copy, dot, factor, forward
from dynsim.planner.compiled.tables import Arm, Course, Points, Work

# A constraint row counts as dependent if the part of it that is independent of the other rows is below this fraction.
DEPENDENT = 1e-9
# Tolerance of the distances from the hand path and the surfaces [m].
ON = 1e-9
# Maximum step of a coordinate in one iteration [rad or m].
REACH = 0.6
# Maximum step of a coordinate in one iteration of a projection [rad or m].
PROJECTION_REACH = 2.0 * REACH / 3.0
# The projection fails if the residual does not halve within this number of steps.
PATIENCE = 12


@internal_kernel
def constraint_rows(course: Course, work: Work, k):
    """Write the constraint rows of hand and guided braces at knot k to ``work.rows``; return their number."""
    m, n = work.hand.shape[1], work.rows.shape[1]
    copy(work.hand_rate[k], work.rows)
    for i in range(course.guided.shape[1]):
        if course.guided[k, i]:
            for j in range(n):
                work.rows[m, j] = work.gap_rate[k, i, j]
            m += 1
    return m


@internal_kernel
def margin(course: Course, points: Points, k, i):
    """Return the minimum distance of a point or pair at knot k [m]; minus infinity for a guided brace."""
    if i >= course.guided.shape[1]:
        return points.margin[i]
    return -math.inf if course.guided[k, i] else course.apart[k, i]


@kernel
def project(arm: Arm, points: Points, course: Course, work: Work, Q, steps, tolerance):
    """Project the postures of all knots onto hand path and braces, clear of surfaces and within joint limits.

    Damped Gauss–Newton steps on the violated constraints keep the change small. Returns the largest residual of a knot
    [m], considering the knots up to the first that fails.

    Parameters
    ----------
    arm, points, course, work
        Tables and workspace.
    Q : (K, n) ndarray
        Postures at the knots [rad or m]; changed in place.
    steps : int
        Maximum number of steps per knot.
    tolerance : float
        Tolerance of the residual [m].
    """
    n, P, h = arm.parent.shape[0], points.body.shape[0], work.hand.shape[1]
    rows, A, right = work.rows, work.normal_matrix, work.right
    worst = 0.0
    for k in range(Q.shape[0]):
        left, halved = math.inf, math.inf
        for attempt in range(steps + 1):
            geometry(arm, points, work, Q[k], k, P)
            m = constraint_rows(course, work, k)
            left = 0.0
            for r in range(h):
                right[r] = course.target[k, r] - work.hand[k, r]
                left = max(left, abs(right[r]))
            on = h
            for i in range(P):
                short = margin(course, points, k, i) - work.gap[k, i]
                if short == -math.inf and i < course.guided.shape[1]:
                    right[on] = course.apart[k, i] - work.gap[k, i]
                    left = max(left, abs(right[on]))
                    on += 1
                if short > 0.0 and m < rows.shape[0]:
                    for j in range(n):
                        rows[m, j] = work.gap_rate[k, i, j]
                    right[m] = short + 0.5 * tolerance
                    # A point that is too close only because of rounding counts as clear.
                    left = max(left, short - tolerance)
                    m += 1
            for j in range(n):
                over = arm.lower[j] - Q[k, j] if Q[k, j] < arm.lower[j] else arm.upper[j] - Q[k, j]
                if (Q[k, j] < arm.lower[j] or Q[k, j] > arm.upper[j]) and m < rows.shape[0]:
                    rows[m] = 0.0
                    rows[m, j] = 1.0
                    right[m] = over
                    left = max(left, abs(over) - tolerance)
                    m += 1
            if left <= tolerance or attempt == steps or not left < 1e6:
                break
            if attempt % PATIENCE == PATIENCE - 1:
                if left > 0.5 * halved:
                    break
                halved = left
            far = 0.0
            for r in range(m):
                far = max(far, abs(right[r]))
            damping = 1e-10 + 1e-2 * min(far, 1.0) ** 2
            for r in range(m):
                right[r] *= min(1.0, 0.25 / far)
                for s in range(r + 1):
                    A[r, s] = dot(rows[r], rows[s])
                A[r, r] += damping
            factor(A, work.small_skyline, 0, m)
            forward(A, work.small_skyline, right, m)
            backward(A, work.small_skyline, right, m)
            most = 1e-300
            for j in range(n):
                work.x[j] = dot(rows[:m, j], right)
                most = max(most, abs(work.x[j]))
            for j in range(n):
                Q[k, j] += work.x[j] * min(1.0, PROJECTION_REACH / most)
        worst = max(worst, left)
        if worst > 2.0 * tolerance:
            break
    return worst


@internal_kernel
def null_space(work: Work, k, m):
    """Write an orthonormal basis to ``work.basis`` whose last columns span the null space of m rows of ``work.rows``.

    The basis is computed by Householder reflections with row pivoting; dependent rows are skipped. Returns the number
    of null-space columns.
    """
    rows, Z, u = work.rows, work.basis[k], work.g
    n = rows.shape[1]
    Z[:] = 0.0
    for i in range(n):
        Z[i, i] = 1.0
    rank = 0
    for _ in range(m):
        if rank == n:
            break
        best, most = -1, DEPENDENT * DEPENDENT
        for r in range(rank, m):
            square = dot(rows[r, rank:], rows[r, rank:])
            if square > most:
                best, most = r, square
        if best < 0:
            break
        for j in range(n):
            rows[rank, j], rows[best, j] = rows[best, j], rows[rank, j]
        size = math.sqrt(most)
        head = rows[rank, rank]
        sign = 1.0 if head >= 0.0 else -1.0
        square = 0.0
        for j in range(rank, n):
            u[j] = rows[rank, j] + (sign * size if j == rank else 0.0)
            square += u[j] * u[j]
        for r in range(rank, m):
            s = 2.0 / square * dot(rows[r, rank:], u[rank:])
            for j in range(rank, n):
                rows[r, j] -= s * u[j]
        for i in range(n):
            s = 2.0 / square * dot(Z[i, rank:], u[rank:])
            for j in range(rank, n):
                Z[i, j] -= s * u[j]
        rank += 1
    return n - rank
