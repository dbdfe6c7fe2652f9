"""Joint torques of a braced arm with their derivatives, and brace forces of least heat."""

from __future__ import annotations

import math

from dynsim.dynamics.tree.spatial import (
    ZERO_VECTOR,
    along,
    cross,
    dot_vector,
    put_vector,
    times_number,
    vector,
)
from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.planner.compiled.geometry import geometry
from dynsim.planner.compiled.linear import dot, nonnegative
from dynsim.planner.compiled.tables import Arm, Course, Points, Work


@kernel
def statics(arm: Arm, points: Points, course: Course, work: Work, Q, F, min_force, forces):
    """Compute torques and their derivatives at the given instants, and the geometry at all knots.

    ∂τ/∂q_r = H_jr − Σ_c J_cj · ∂F_c/∂q_r − Σ_c (a_j × s_cr) · F_c with the symmetric matrix H_ij = −a_i · M_j for
    joints i that carry joint j, and zero for a prismatic joint i; M_j = Σ_k J_kj × w_k over weights and forces. s_cr is
    the displacement of the contact point on its body.

    Parameters
    ----------
    arm, points, course, work
        Tables and workspace.
    Q : (K, n) ndarray
        Postures at the knots [rad or m].
    F : (E, c) ndarray
        Normal forces [N].
    min_force : float
        Minimum normal force [N].
    forces : bool
        Whether to compute the forces of least heat first and write them to ``F``.
    """
    n, c, weight = arm.parent.shape[0], points.friction.shape[0], vector(arm.gravity, 0, 0)
    K, v, a = Q.shape[0], work.rate, work.acceleration
    for k in range(K):
        geometry(arm, points, work, Q[k], k, points.body.shape[0])
    for e in range(course.knot.shape[0]):
        for j in range(n):
            v[j], a[j], work.between[j] = 0.0, 0.0, 0.0
            for k in range(K):
                v[j] += course.chord[e, k] * Q[k, j]
                a[j] += course.bend[e, k] * Q[k, j]
                work.between[j] += course.blend[e, k] * Q[k, j]
        if e == 0 or course.knot[e] != course.knot[e - 1]:
            geometry(arm, points, work, work.between, K, c)
        for j in range(n):
            axis, mass = vector(work.a, j, 0), work.below[j, 0]
            if arm.prismatic[j]:
                lever = times_number(axis, mass)
            else:
                lever = cross(axis, along(vector(work.below, j, 1), vector(work.p, j, 0), -mass))
            work.torque[e, j] = arm.losses[j] * v[j] - dot_vector(weight, lever) + dot(work.inertia[e, j], a)
            put_vector(work.moment, j, 0, cross(lever, weight))
        for i in range(c):
            normal, w = vector(work.normal, i, 0), ZERO_VECTOR
            for j in range(n):
                w = along(w, vector(work.touch[i], j, 0), v[j])
            slip = along(w, normal, -dot_vector(normal, w))
            size = math.sqrt(dot_vector(slip, slip) + course.slip_scale[0] ** 2)
            u = times_number(slip, 1.0 / size)
            put_vector(work.slip, i, 0, u)
            put_vector(work.slip, i, 3, w)
            work.slip[i, 6] = size
            pull = along(normal, u, -points.friction[i]) if course.acting[e, i] else ZERO_VECTOR
            put_vector(work.force, i, 0, pull)
            for j in range(n):
                work.by_f[e, j, i] = -dot_vector(vector(work.touch[i], j, 0), pull)
        if forces:
            least_heat(arm, work, min_force, F[e], e)
            for i in range(c):
                F[e, i] *= course.acting[e, i]
        for i in range(c):
            put_vector(work.force, i, 0, times_number(vector(work.force, i, 0), F[e, i]))
        work.by_q[e], work.by_v[e] = 0.0, 0.0
        for j in range(n):
            moment = vector(work.moment, j, 0)
            for i in range(c):
                work.torque[e, j] += work.by_f[e, j, i] * F[e, i]
                moment = along(moment, cross(vector(work.touch[i], j, 0), vector(work.force, i, 0)), 1.0)
            work.by_v[e, j, j] = arm.losses[j]
            i = j
            while i >= 0:
                if not arm.prismatic[i]:
                    bent = -dot_vector(vector(work.a, i, 0), moment)
                    work.by_q[e, i, j], work.by_q[e, j, i] = bent, bent
                i = arm.parent[i]
        for i in range(c):
            force_derivatives(arm, points, work, v, F[e, i], i, e)


@internal_kernel
def force_derivatives(arm: Arm, points: Points, work: Work, v, f, i, e):
    """Add the derivatives due to the direction and the point of application of brace i's force at instant e.

    ∂F = f (∂n − μ G ∂w), w = v_t, G = (1 − u uᵀ)/s, s = √(|w|² + v_s²), u = w/s.
    """
    touch, shift, turned, body = work.touch[i], work.shift[i], work.turned[i], points.body[i]
    normal, u, w = vector(work.normal, i, 0), vector(work.slip, i, 0), vector(work.slip, i, 3)
    blunt, level = points.friction[i] / work.slip[i, 6], dot_vector(normal, w)
    whole = ZERO_VECTOR
    j = body
    while j >= 0:
        if not arm.prismatic[j]:
            whole = along(whole, vector(work.a, j, 0), v[j])
        j = arm.parent[j]
    # Go from tip to base, with carried = Σ J_i v_i over joint j and the joints it carries, and before = Σ a_i v_i over
    # its parents.
    before, carried = whole, ZERO_VECTOR
    j = body
    while j >= 0:
        rate, a, dn = vector(touch, j, 0), vector(work.a, j, 0), vector(turned, j, 0)
        carried = along(carried, rate, v[j])
        # As the joint moves, another material point becomes the contact point.
        dw = cross(whole, vector(shift, j, 0))
        if not arm.prismatic[j]:
            before = along(before, a, -v[j])
            dw = along(dw, cross(a, carried), 1.0)
        dw = along(dw, cross(before, rate), 1.0)
        dw = along(along(dw, normal, -dot_vector(normal, dw) - dot_vector(dn, w)), dn, -level)
        across = along(rate, normal, -dot_vector(normal, rate))
        put_vector(work.turn, j, 0, times_number(along(dn, along(dw, u, -dot_vector(u, dw)), -blunt), f))
        put_vector(work.drift, j, 0, times_number(along(across, u, -dot_vector(u, across)), -f * blunt))
        j = arm.parent[j]
    force = vector(work.force, i, 0)
    j = body
    while j >= 0:
        rate, a, k = vector(touch, j, 0), vector(work.a, j, 0), body
        while k >= 0:
            work.by_q[e, j, k] -= dot_vector(rate, vector(work.turn, k, 0))
            work.by_v[e, j, k] -= dot_vector(rate, vector(work.drift, k, 0))
            if not arm.prismatic[j]:
                work.by_q[e, j, k] -= dot_vector(cross(a, vector(shift, k, 0)), force)
            k = arm.parent[k]
        j = arm.parent[j]


@internal_kernel
def least_heat(arm: Arm, work: Work, min_force, f, e):
    """Compute the normal forces of least heat at instant e, shape (c,), from the torques without brace forces.

    The forces are at least ``min_force`` [N].
    """
    n, c = work.by_f.shape[1], work.by_f.shape[2]
    G, h, x = work.dual, work.dual_right, work.multiplier
    for i in range(c):
        for k in range(c):
            s = 0.0
            for j in range(n):
                s += arm.heat[j] * work.by_f[e, j, i] * work.by_f[e, j, k]
            G[i, k] = s
        G[i, i] += 1e-12
    for i in range(c):
        s = 0.0
        for j in range(n):
            s -= arm.heat[j] * work.by_f[e, j, i] * work.torque[e, j]
        for k in range(c):
            s -= G[i, k] * min_force
        h[i] = s
    nonnegative(work, G, h, x, 0, c)
    for i in range(c):
        f[i] = min_force + x[i]
