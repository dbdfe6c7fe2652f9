"""Statics of a braced arm at many instants with exact derivatives, and the steps of the local solver, compiled.

Of an arm whose joints each have one coordinate, on a base that stands, with braces c whose forces are

    F_c = f_c (n − μ v_t / √(|v_t|² + v_s²)),    τ = g(q) + (D + D_m) v − Σ_c J_cᵀ F_c

n: normal of the surface at the brace, v_t: velocity of the touching point along it. Postures q_k belong to knots;
instants e belong to a knot each and have velocities v_e = Σ_k chord_ek q_k, so that back and forth along one path are
two instants of one knot.

Everything is in one file: the cache of compiled code asks whether the file of a function has changed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics.contact.distance import ShapeArrays, distance
from dynsim.dynamics.tree.spatial import dot_vector
from dynsim.jit.kernel import internal_kernel, kernel

# Slip [m/s] over which friction grows to its value: steep enough to charge braces that creep, smooth enough for steps.
SLIP_SCALE = 2e-3
# What is lost of a row of constraints that others imply.
DEPENDENT = 1e-9
# Distance from hand path and surfaces that counts as none [m].
ON = 1e-9
# First damping of the steps beside the curvature of the heat, and its bounds, over the largest of that curvature.
DAMPING, DAMPING_MIN, DAMPING_MAX = 1e-3, 1e-7, 1e6
# Longest step of a coordinate in one turn [rad or m].
REACH = 0.6
# Torques beyond this part of their limits cost extra, so many times what they cost as heat.
NEAR_LIMIT, DEAR = 0.98, 100.0
# Exponent of the mean that stands for the peak of the torques.
PEAK_POWER = 12
# Of multipliers and forces, relative to their scale: nothing is gained by letting go of a bound.
NO_GAIN = 1e-11


class Arm(NamedTuple):
    """Joints of one coordinate and what they carry; n joints, parents before children."""

    parent: np.ndarray  # (n,) int, −1: the base that stands
    prismatic: np.ndarray  # (n,) int, 1 or 0
    rotation: np.ndarray  # (n, 3, 3) of the joint frame at q = 0 in the parent's, in W on the base
    place: np.ndarray  # (n, 3) its origin there [m]
    axis: np.ndarray  # (n, 3)
    mass: np.ndarray  # (n,) [kg]
    com: np.ndarray  # (n, 3) centre of mass in the body's frame [m]
    losses: np.ndarray  # (n,) D + D_m [N m s/rad]
    heat: np.ndarray  # (n,) R / K_m² [W/(N m)²]
    greatest: np.ndarray  # (n,) greatest torque at rest [N m], inf for none
    lower: np.ndarray  # (n,) limits of the joints
    upper: np.ndarray  # (n,)
    gravity: np.ndarray  # (3,)
    hand: np.ndarray  # (1,) int, its body
    hand_point: np.ndarray  # (3,) [m]
    shapes: ShapeArrays  # the surfaces


class Points(NamedTuple):
    """Braces first, c of them, then points that stay clear; P altogether."""

    body: np.ndarray  # (P,) int
    point: np.ndarray  # (P, 3) in its frame [m]
    radius: np.ndarray  # (P,) of a sphere about it [m]
    surface: np.ndarray  # (P,) int
    margin: np.ndarray  # (P,) least distance [m], of braces zero
    friction: np.ndarray  # (c,) μ


class Course(NamedTuple):
    """Knots k with targets of the hand and instants e."""

    target: np.ndarray  # (K, h) position of the hand [m], with the two directions' components if they are asked for
    knot: np.ndarray  # (E,) int
    chord: np.ndarray  # (E, K) [1/s]
    share: np.ndarray  # (E,) of the time; their sum is 1
    smooth: np.ndarray  # (K, K) SᵀS of the smoothness S q


class Work(NamedTuple):
    """Results and scratch."""

    torque: np.ndarray  # (E, n)
    by_q: np.ndarray  # (E, n, n) ∂τ/∂q at fixed v and f
    by_v: np.ndarray  # (E, n, n)
    by_f: np.ndarray  # (E, n, c)
    gap: np.ndarray  # (K, P) distance from the surface less radius
    gap_rate: np.ndarray  # (K, P, n)
    hand: np.ndarray  # (K, h)
    hand_rate: np.ndarray  # (K, h, n)
    R: np.ndarray  # (n, 3, 3)
    p: np.ndarray  # (n, 3)
    a: np.ndarray  # (n, 3) joint axes in W
    below: np.ndarray  # (n, 4) mass and first moment of what a joint carries
    touch: np.ndarray  # (c, n, 3) velocity of the touching point by each rate
    centre: np.ndarray  # (c, n, 3) the same of the centre of its sphere
    normal: np.ndarray  # (c, 3)
    bend: np.ndarray  # (c, 3, 3) curvature of the surface
    shift: np.ndarray  # (c, n, 3) what the touching point moves by on the body, by each coordinate
    slip: np.ndarray  # (c, 8) velocity along the surface over its size, that size, velocity of the touching point
    force: np.ndarray  # (c, 3)
    turn: np.ndarray  # (n, 3) ∂F/∂q of a brace
    drift: np.ndarray  # (n, 3) ∂F/∂v
    vector: np.ndarray  # (12, 3)
    basis: np.ndarray  # (K, n, n) columns that keep hand and braces come last
    free: np.ndarray  # (K,) int, how many of those
    rows: np.ndarray  # (R, n) constraints of one knot
    normal_matrix: np.ndarray  # (R, R)
    right: np.ndarray  # (R,)
    H: np.ndarray  # (N, N)
    g: np.ndarray  # (N,)
    x: np.ndarray  # (N,) L⁻¹ times the step without constraints
    step: np.ndarray  # (N,)
    B: np.ndarray  # (n, 2 n + c)
    column: np.ndarray  # (2 n + c,) int
    start: np.ndarray  # (K,) int, where the unknowns of each knot's posture begin; the forces of its instants follow
    pressed: np.ndarray  # (E,) int, where the forces of each instant begin
    skyline: np.ndarray  # (N,) int, first column of each row of H that is not zero
    working: np.ndarray  # (W, 3) int: constraints of the step that have been violated: kind, knot or instant, which
    bound: np.ndarray  # (W,)
    normals: np.ndarray  # (W, N) their rows, then L⁻¹ times them
    dual: np.ndarray  # (W, W)
    dual_right: np.ndarray  # (W,)
    multiplier: np.ndarray  # (W,)
    passive: np.ndarray  # (W,) int
    small: np.ndarray  # (W, W)
    small_right: np.ndarray  # (W,)
    index: np.ndarray  # (W,) int
    small_skyline: np.ndarray  # (W,) int
    rate: np.ndarray  # (E, n) velocities of the instants
    weight: np.ndarray  # (E, n) of the squares of torques in the model of the cost
    pull: np.ndarray  # (E, n) half the gradient of the cost by torques, over the share of time
    change: np.ndarray  # (K, n) of postures in a step
    trial: np.ndarray  # (K, n)
    trial_forces: np.ndarray  # (E, c)


@internal_kernel
def cross(u, v, out):
    """out = u × v."""
    out[0] = u[1] * v[2] - u[2] * v[1]
    out[1] = u[2] * v[0] - u[0] * v[2]
    out[2] = u[0] * v[1] - u[1] * v[0]


@internal_kernel
def poses(arm: Arm, work: Work, q):
    """Frames of all bodies, joint axes in W, and mass and first moment of what each joint carries."""
    n = arm.parent.shape[0]
    R, p, a = work.R, work.p, work.a
    for j in range(n):
        i = arm.parent[j]
        x, y, z = arm.axis[j, 0], arm.axis[j, 1], arm.axis[j, 2]
        angle = 0.0 if arm.prismatic[j] else q[j]
        s, c = math.sin(angle), math.cos(angle)
        v = 1.0 - c
        turn = (
            (c + x * x * v, x * y * v - z * s, x * z * v + y * s),
            (y * x * v + z * s, c + y * y * v, y * z * v - x * s),
            (z * x * v - y * s, z * y * v + x * s, c + z * z * v),
        )
        for r in range(3):
            if i < 0:
                p[j, r] = arm.place[j, r]
            else:
                p[j, r] = p[i, r] + R[i, r, 0] * arm.place[j, 0] + R[i, r, 1] * arm.place[j, 1]
                p[j, r] += R[i, r, 2] * arm.place[j, 2]
            if i < 0:
                f0, f1, f2 = arm.rotation[j, r, 0], arm.rotation[j, r, 1], arm.rotation[j, r, 2]
            else:
                f0 = R[i, r, 0] * arm.rotation[j, 0, 0] + R[i, r, 1] * arm.rotation[j, 1, 0]
                f0 += R[i, r, 2] * arm.rotation[j, 2, 0]
                f1 = R[i, r, 0] * arm.rotation[j, 0, 1] + R[i, r, 1] * arm.rotation[j, 1, 1]
                f1 += R[i, r, 2] * arm.rotation[j, 2, 1]
                f2 = R[i, r, 0] * arm.rotation[j, 0, 2] + R[i, r, 1] * arm.rotation[j, 1, 2]
                f2 += R[i, r, 2] * arm.rotation[j, 2, 2]
            a[j, r] = f0 * x + f1 * y + f2 * z
            for k in range(3):
                R[j, r, k] = f0 * turn[0][k] + f1 * turn[1][k] + f2 * turn[2][k]
            if arm.prismatic[j]:
                p[j, r] += a[j, r] * q[j]
    below = work.below
    for j in range(n):
        below[j, 0] = arm.mass[j]
        for r in range(3):
            middle = p[j, r] + R[j, r, 0] * arm.com[j, 0] + R[j, r, 1] * arm.com[j, 1] + R[j, r, 2] * arm.com[j, 2]
            below[j, 1 + r] = arm.mass[j] * middle
    for j in range(n - 1, -1, -1):
        i = arm.parent[j]
        if i >= 0:
            for r in range(4):
                below[i, r] += below[j, r]


@internal_kernel
def body_point(work: Work, body, point, out):
    """A point of a body in W [m]."""
    R, p = work.R, work.p
    for r in range(3):
        out[r] = p[body, r] + R[body, r, 0] * point[0] + R[body, r, 1] * point[1] + R[body, r, 2] * point[2]


@internal_kernel
def rates(arm: Arm, work: Work, body, at, out):
    """Velocity of the material point of a body at a place ``at``, for each unit of rate, (n, 3)."""
    lever = work.vector[11]
    for j in range(arm.parent.shape[0]):
        for r in range(3):
            out[j, r] = 0.0
    j = body
    while j >= 0:
        if arm.prismatic[j]:
            for r in range(3):
                out[j, r] = work.a[j, r]
        else:
            for r in range(3):
                lever[r] = at[r] - work.p[j, r]
            cross(work.a[j], lever, out[j])
        j = arm.parent[j]


@internal_kernel
def geometry(arm: Arm, points: Points, work: Work, q, k):
    """Of knot k: hand, gaps and their rates; of the braces also what their forces need."""
    n, c, P = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0]
    x, lever, jacobian = work.vector[0], work.vector[1], work.turn
    poses(arm, work, q)
    body_point(work, arm.hand[0], arm.hand_point, x)
    rates(arm, work, arm.hand[0], x, jacobian)
    for r in range(3):
        work.hand[k, r] = x[r]
        for j in range(n):
            work.hand_rate[k, r, j] = jacobian[j, r]
    # Components of the axes of the hand: x, y and z of its z axis, then of its x axis.
    for r in range(3, work.hand.shape[1]):
        axis, e = (2 if r < 6 else 0), r % 3
        for i in range(3):
            lever[i] = work.R[arm.hand[0], i, axis]
        work.hand[k, r] = lever[e]
        for j in range(n):
            work.hand_rate[k, r, j] = 0.0
        j = arm.hand[0]
        while j >= 0:
            if not arm.prismatic[j]:
                cross(work.a[j], lever, x)
                work.hand_rate[k, r, j] = x[e]
            j = arm.parent[j]
    for i in range(P):
        body, radius = points.body[i], points.radius[i]
        body_point(work, body, points.point[i], x)
        far, nx, ny, nz, xx, xy, xz, yy, yz, zz = distance(arm.shapes, points.surface[i], x[0], x[1], x[2])
        work.gap[k, i] = far - radius
        rates(arm, work, body, x, jacobian)
        for j in range(n):
            work.gap_rate[k, i, j] = nx * jacobian[j, 0] + ny * jacobian[j, 1] + nz * jacobian[j, 2]
        if i >= c:
            continue
        normal, bend = work.normal[i], work.bend[i]
        normal[0], normal[1], normal[2] = nx, ny, nz
        bend[0, 0], bend[0, 1], bend[0, 2], bend[1, 1], bend[1, 2], bend[2, 2] = xx, xy, xz, yy, yz, zz
        bend[1, 0], bend[2, 0], bend[2, 1] = xy, xz, yz
        for j in range(n):
            for r in range(3):
                work.centre[i, j, r] = jacobian[j, r]
        for r in range(3):
            x[r] -= radius * normal[r]
        rates(arm, work, body, x, work.touch[i])
        # The touching point moves by J_centre − ρ ∂n/∂q, the material there by J_touch.
        for j in range(n):
            for r in range(3):
                turned = dot_vector(bend[r], work.centre[i, j])
                work.shift[i, j, r] = work.centre[i, j, r] - radius * turned - work.touch[i, j, r]


@internal_kernel
def knot_of_first(course: Course, e):
    """Whether instant e is the first one of its knot in a row."""
    return e == 0 or course.knot[e] != course.knot[e - 1]


@internal_kernel
def statics(arm: Arm, points: Points, course: Course, work: Work, Q, V, F, derivatives):
    """Torques, and with ``derivatives`` those of them; geometry of all knots. Q: (K, n), V: (E, n), F: (E, c).

    ∂τ/∂q_r = H_jr − Σ_c J_cj · ∂F_c/∂q_r − Σ_c (a_j × s_cr) · F_c,
    H_ij = −a_i · M_j (joint i carries joint j, both directions alike), M_j = Σ_k J_kj × w_k over weights and forces;
    zero for a prismatic joint i. s_cr: what the touching point moves by on its body.
    """
    n, c = arm.parent.shape[0], points.friction.shape[0]
    vector = work.vector
    lever, moment, part, u = vector[2], vector[3], vector[4], vector[5]
    for e in range(course.knot.shape[0]):
        if knot_of_first(course, e):
            geometry(arm, points, work, Q[course.knot[e]], course.knot[e])
        v = V[e]
        for i in range(c):
            slip, normal = work.slip[i], work.normal[i]
            for r in range(3):
                rate = 0.0
                for j in range(n):
                    rate += work.touch[i, j, r] * v[j]
                slip[4 + r] = rate
            ahead = dot_vector(normal, slip[4:7])
            square = SLIP_SCALE * SLIP_SCALE
            for r in range(3):
                slip[r] = slip[4 + r] - ahead * normal[r]
                square += slip[r] * slip[r]
            slip[3] = math.sqrt(square)
            for r in range(3):
                slip[r] /= slip[3]
                u[r] = normal[r] - points.friction[i] * slip[r]
                work.force[i, r] = F[e, i] * u[r]
            for j in range(n):
                work.by_f[e, j, i] = -dot_vector(work.touch[i, j], u)
        for j in range(n):
            # Weight and forces on what the joint carries: M_j = Σ J × w.
            if arm.prismatic[j]:
                for r in range(3):
                    part[r] = work.a[j, r] * work.below[j, 0]
            else:
                for r in range(3):
                    lever[r] = work.below[j, 1 + r] - work.below[j, 0] * work.p[j, r]
                cross(work.a[j], lever, part)
            torque = arm.losses[j] * v[j] - dot_vector(arm.gravity, part)
            for i in range(c):
                torque += work.by_f[e, j, i] * F[e, i]
            work.torque[e, j] = torque
            if not derivatives:
                continue
            cross(part, arm.gravity, moment)
            for i in range(c):
                cross(work.touch[i, j], work.force[i], part)
                for r in range(3):
                    moment[r] += part[r]
            for i in range(n):
                work.by_v[e, i, j] = 0.0
                if i <= j:
                    work.by_q[e, i, j], work.by_q[e, j, i] = 0.0, 0.0
            work.by_v[e, j, j] = arm.losses[j]
            i = j
            while i >= 0:
                if not arm.prismatic[i]:
                    bent = -dot_vector(work.a[i], moment)
                    work.by_q[e, i, j], work.by_q[e, j, i] = bent, bent
                i = arm.parent[i]
        if derivatives:
            for i in range(c):
                force_derivatives(arm, points, work, v, F[e, i], i, e)


@kernel
def evaluate(arm: Arm, points: Points, course: Course, work: Work, Q, V, F, derivatives):
    """See :func:`statics`: what several kernels call is none of its own."""
    statics(arm, points, course, work, Q, V, F, derivatives)


@internal_kernel
def force_derivatives(arm: Arm, points: Points, work: Work, v, f, i, e):
    """What the direction of brace i's force, and the point that it acts at, add to the derivatives of instant e.

    ∂F = f (∂n − μ G ∂w), w = v_t, G = (1 − u uᵀ)/s, s = √(|w|² + v_s²), u = w/s.
    """
    mu, slip, normal, n = points.friction[i], work.slip[i], work.normal[i], arm.parent.shape[0]
    vector = work.vector
    carried, before, dw, dn, part, turned = vector[2], vector[3], vector[4], vector[5], vector[6], vector[7]
    body = points.body[i]
    whole = vector[8]
    for r in range(3):
        whole[r], carried[r] = 0.0, slip[4 + r]
    j = body
    while j >= 0:
        if not arm.prismatic[j]:
            for r in range(3):
                whole[r] += work.a[j, r] * v[j]
        j = arm.parent[j]
    for r in range(n):
        for t in range(3):
            work.turn[r, t], work.drift[r, t] = 0.0, 0.0
    # From the tip inwards: carried = Σ J_i v_i of joint j and those it carries, before = Σ a_i v_i of those before it.
    for t in range(3):
        before[t], carried[t] = whole[t], 0.0
    j = body
    while j >= 0:
        rate = work.touch[i, j]
        for t in range(3):
            carried[t] += rate[t] * v[j]
            if not arm.prismatic[j]:
                before[t] -= work.a[j, t] * v[j]
        cross(before, rate, dw)
        if not arm.prismatic[j]:
            cross(work.a[j], carried, part)
            for t in range(3):
                dw[t] += part[t]
        # The material at the touching point changes.
        cross(whole, work.shift[i, j], part)
        for t in range(3):
            dw[t] += part[t]
            dn[t] = dot_vector(work.bend[i, t], work.centre[i, j])
        ahead = dot_vector(normal, dw) + dot_vector(dn, slip[4:7])
        level = dot_vector(normal, slip[4:7])
        for t in range(3):
            dw[t] -= normal[t] * ahead + dn[t] * level
            turned[t] = rate[t] - normal[t] * dot_vector(normal, rate)
        along, other = dot_vector(slip[0:3], dw), dot_vector(slip[0:3], turned)
        for t in range(3):
            work.turn[j, t] = f * (dn[t] - mu * (dw[t] - slip[t] * along) / slip[3])
            work.drift[j, t] = -f * mu * (turned[t] - slip[t] * other) / slip[3]
        j = arm.parent[j]
    for t in range(3):
        part[t] = work.force[i, t]
    j = body
    while j >= 0:
        k = body
        while k >= 0:
            work.by_q[e, j, k] -= dot_vector(work.touch[i, j], work.turn[k])
            work.by_v[e, j, k] -= dot_vector(work.touch[i, j], work.drift[k])
            if not arm.prismatic[j]:
                cross(work.a[j], work.shift[i, k], turned)
                work.by_q[e, j, k] -= dot_vector(turned, part)
            k = arm.parent[k]
        j = arm.parent[j]


@internal_kernel
def factor(A, skyline, n):
    """Cholesky's L of the leading n × n part of A, in its lower half; pivots that are lost stop moving anything.

    skyline : (n,) int, out: first column of each row that is not zero; left of it L has zeros too
    """
    for i in range(n):
        first = 0
        while first < i and A[i, first] == 0.0:
            first += 1
        skyline[i] = first
        for j in range(first, i + 1):
            s = A[i, j]
            for k in range(max(first, skyline[j]), j):
                s -= A[i, k] * A[j, k]
            if i == j:
                A[i, i] = math.sqrt(s) if s > 1e-300 else 1e150
            else:
                A[i, j] = s / A[j, j]


@internal_kernel
def forward(L, skyline, b, n):
    """b ← L⁻¹ b."""
    for i in range(n):
        s = b[i]
        for k in range(skyline[i], i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@internal_kernel
def backward(L, skyline, b, n):
    """b ← L⁻ᵀ b."""
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(skyline[i], i):
            b[k] -= L[i, k] * b[i]


@internal_kernel
def nonnegative(work: Work, G, h, x, m):
    """x ≥ 0 that minimises ½ xᵀGx − hᵀx, by Lawson and Hanson's active sets, from the passive ones marked in ``work``.

    G: (m, m) positive semidefinite, with room for a little on its diagonal.
    """
    passive, small, right, index, skyline = work.passive, work.small, work.small_right, work.index, work.small_skyline
    scale = 1e-300
    for i in range(m):
        scale = max(scale, abs(h[i]))
        x[i], passive[i] = 0.0, 0
    for _ in range(3 * m + 10):
        best, most = -1, NO_GAIN * scale
        for i in range(m):
            if passive[i] == 0:
                gain = h[i]
                for k in range(m):
                    if passive[k]:
                        gain -= G[i, k] * x[k]
                if gain > most:
                    best, most = i, gain
        if best < 0:
            return
        passive[best] = 1
        for _inner in range(m + 1):
            count = 0
            for i in range(m):
                if passive[i]:
                    index[count] = i
                    count += 1
            if count == 0:
                break
            for a in range(count):
                right[a] = h[index[a]]
                for b in range(a + 1):
                    small[a, b] = G[index[a], index[b]]
                small[a, a] *= 1.0 + 1e-12
            factor(small, skyline, count)
            forward(small, skyline, right, count)
            backward(small, skyline, right, count)
            share = 1.0
            for a in range(count):
                i = index[a]
                if right[a] <= 0.0:
                    share = min(share, x[i] / (x[i] - right[a]) if x[i] > right[a] else 0.0)
            for a in range(count):
                i = index[a]
                x[i] += share * (right[a] - x[i])
                if share < 1.0 and right[a] <= 0.0 and x[i] <= 1e-13 * scale + 1e-300:
                    x[i], passive[i] = 0.0, 0
            if share == 1.0:
                break
            # What held the step leaves in any case.
            for a in range(count):
                i = index[a]
                if passive[i] and right[a] <= 0.0 and x[i] <= 0.0:
                    x[i], passive[i] = 0.0, 0


@internal_kernel
def least_heat(arm: Arm, work: Work, least, F):
    """Normal forces of least heat of each instant after :func:`statics` with forces of zero, at least ``least``."""
    n, c = work.by_f.shape[1], work.by_f.shape[2]
    G, h, x = work.dual, work.dual_right, work.multiplier
    for e in range(F.shape[0]):
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
                s -= G[i, k] * least
            h[i] = s
        nonnegative(work, G, h, x, c)
        for i in range(c):
            F[e, i] = least + x[i]


@internal_kernel
def equilibrium(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, forces):
    """Torques and derivatives of postures, with normal forces of least heat where ``forces`` asks for those, in F."""
    for e in range(F.shape[0]):
        for i in range(F.shape[1]):
            F[e, i] = 0.0 if forces else F[e, i]
        for j in range(Q.shape[1]):
            z = 0.0
            for k in range(Q.shape[0]):
                z += course.chord[e, k] * Q[k, j]
            work.rate[e, j] = z
    if forces and F.shape[1] > 0:
        statics(arm, points, course, work, Q, work.rate, F, False)
        least_heat(arm, work, least, F)
    statics(arm, points, course, work, Q, work.rate, F, True)


@kernel
def settle(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, forces):
    """See :func:`equilibrium`."""
    equilibrium(arm, points, course, work, Q, F, least, forces)


@internal_kernel
def costs(arm: Arm, course: Course, work: Work, Q, peak):
    """Cost and heat [W] of the torques in the workspace; weights and pull of the cost's quadratic model.

    Torques near their limits are dear; ``peak`` : cost of the greatest torque [W/(N m)], by a mean of high power.
    """
    E, n = work.torque.shape
    heat, cost, largest, mean = 0.0, 0.0, 0.0, 0.0
    for e in range(E):
        for j in range(n):
            largest = max(largest, abs(work.torque[e, j]))
    for e in range(E):
        for j in range(n):
            torque, w, share = work.torque[e, j], arm.heat[j], course.share[e]
            heat += share * w * torque * torque
            work.weight[e, j], work.pull[e, j] = w, w * torque
            over = abs(torque) - NEAR_LIMIT * arm.greatest[j]
            if over > 0.0:
                cost += share * DEAR * w * over * over
                work.weight[e, j] += DEAR * w
                work.pull[e, j] += DEAR * w * math.copysign(over, torque)
            if peak > 0.0 and largest > 0.0:
                mean += (abs(torque) / largest) ** PEAK_POWER / (E * n)
    if mean > 0.0:
        cost += peak * largest * mean ** (1.0 / PEAK_POWER)
        for e in range(E):
            for j in range(n):
                torque = abs(work.torque[e, j])
                slope = peak * mean ** (1.0 / PEAK_POWER - 1.0) * (torque / largest) ** (PEAK_POWER - 1) / (E * n)
                slope *= 0.5 / course.share[e]
                work.pull[e, j] += math.copysign(slope, work.torque[e, j])
                work.weight[e, j] += (PEAK_POWER - 1) * slope / max(torque, 1e-9)
    for k in range(Q.shape[0]):
        for l in range(Q.shape[0]):
            if course.smooth[k, l] != 0.0:
                cost += course.smooth[k, l] * dot(Q[k], Q[l])
    return cost + heat, heat


@internal_kernel
def copy(a, out):
    """Entries of a matrix to another one."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@internal_kernel
def dot(u, v):
    """u · v."""
    z = 0.0
    for i in range(u.shape[0]):
        z += u[i] * v[i]
    return z


@internal_kernel
def constraint_rows(course: Course, points: Points, work: Work, k):
    """Rates of hand and braces of knot k into ``work.rows``; how many."""
    c, n, h = points.friction.shape[0], work.rows.shape[1], work.hand.shape[1]
    for r in range(h):
        for j in range(n):
            work.rows[r, j] = work.hand_rate[k, r, j]
    for i in range(c):
        for j in range(n):
            work.rows[h + i, j] = work.gap_rate[k, i, j]
    return h + c


@internal_kernel
def put_back(arm: Arm, points: Points, course: Course, work: Work, Q, steps, tolerance, reach):
    """Put the postures of all knots onto hand and braces, clear of the rest and within limits: least change.

    Damped Gauss–Newton's steps on what is violated. Returns what is left at the worst knot [m].
    ``reach`` : greatest step of a coordinate
    """
    n, c, P, h = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0], work.hand.shape[1]
    rows, A, right = work.rows, work.normal_matrix, work.right
    worst = 0.0
    for k in range(Q.shape[0]):
        left = math.inf
        for turn in range(steps + 1):
            geometry(arm, points, work, Q[k], k)
            m = constraint_rows(course, points, work, k)
            left = 0.0
            for r in range(h):
                right[r] = course.target[k, r] - work.hand[k, r]
                left = max(left, abs(right[r]))
            for i in range(c):
                right[h + i] = -work.gap[k, i]
                left = max(left, abs(work.gap[k, i]))
            for i in range(c, P):
                short = points.margin[i] - work.gap[k, i]
                if short > 0.0 and m < rows.shape[0]:
                    for j in range(n):
                        rows[m, j] = work.gap_rate[k, i, j]
                    right[m] = short + 0.5 * tolerance
                    # Slack: what scrapes by a rounding is clear.
                    left = max(left, short - tolerance)
                    m += 1
            for j in range(n):
                over = arm.lower[j] - Q[k, j] if Q[k, j] < arm.lower[j] else arm.upper[j] - Q[k, j]
                if (Q[k, j] < arm.lower[j] or Q[k, j] > arm.upper[j]) and m < rows.shape[0]:
                    for i in range(n):
                        rows[m, i] = 1.0 if i == j else 0.0
                    right[m] = over
                    left = max(left, abs(over) - tolerance)
                    m += 1
            if left <= tolerance or turn == steps or not left < 1e6:
                break
            far = 0.0
            for r in range(m):
                far = max(far, abs(right[r]))
            damping = 1e-10 + 1e-2 * min(far, 1.0) ** 2
            for r in range(m):
                right[r] *= min(1.0, 0.25 / far)
                for s in range(r + 1):
                    z = 0.0
                    for j in range(n):
                        z += rows[r, j] * rows[s, j]
                    A[r, s] = z
                A[r, r] += damping
            factor(A, work.small_skyline, m)
            forward(A, work.small_skyline, right, m)
            backward(A, work.small_skyline, right, m)
            most = 1e-300
            for j in range(n):
                z = 0.0
                for r in range(m):
                    z += rows[r, j] * right[r]
                work.x[j] = z
                most = max(most, abs(z))
            for j in range(n):
                Q[k, j] += work.x[j] * min(1.0, reach / most)
        worst = max(worst, left)
    return worst


@kernel
def retract(arm: Arm, points: Points, course: Course, work: Work, Q, steps, tolerance, reach):
    """See :func:`put_back`."""
    return put_back(arm, points, course, work, Q, steps, tolerance, reach)


@internal_kernel
def split(work: Work, k, m):
    """Orthonormal columns of which the last keep the m rows of ``work.rows``, into ``work.basis``; how many last.

    Householder's reflections on the rows, those with the most left first; rows that others imply are left out.
    """
    rows, Z, u = work.rows, work.basis[k], work.g
    n = rows.shape[1]
    for i in range(n):
        for j in range(n):
            Z[i, j] = 1.0 if i == j else 0.0
    rank = 0
    for _ in range(m):
        if rank == n:
            break
        best, most = -1, DEPENDENT * DEPENDENT
        for r in range(rank, m):
            square = 0.0
            for j in range(rank, n):
                square += rows[r, j] * rows[r, j]
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
            s = 0.0
            for j in range(rank, n):
                s += rows[r, j] * u[j]
            s *= 2.0 / square
            for j in range(rank, n):
                rows[r, j] -= s * u[j]
        for i in range(n):
            s = 0.0
            for j in range(rank, n):
                s += Z[i, j] * u[j]
            s *= 2.0 / square
            for j in range(rank, n):
                Z[i, j] -= s * u[j]
        rank += 1
    return n - rank


# Kinds of constraints of a step.
CLEAR, LOWER, UPPER, FORCE = 0, 1, 2, 3


@internal_kernel
def unknowns(work: Work):
    """How many unknowns a step has."""
    last = work.start.shape[0] - 1
    N = work.start[last] + work.free[last]
    for e in range(work.pressed.shape[0]):
        N = max(N, work.pressed[e] + work.by_f.shape[2])
    return N


@internal_kernel
def add_row(arm: Arm, points: Points, work: Work, m, kind, at, which, bound):
    """Constraint m of the step: its row over the unknowns, and its bound."""
    n, N = arm.parent.shape[0], unknowns(work)
    row = work.normals[m]
    work.working[m, 0], work.working[m, 1], work.working[m, 2], work.bound[m] = kind, at, which, bound
    for i in range(N):
        row[i] = 0.0
    if kind == FORCE:
        row[work.pressed[at] + which] = 1.0
        return
    first = n - work.free[at]
    for d in range(work.free[at]):
        z = 0.0
        if kind == CLEAR:
            for j in range(n):
                z += work.gap_rate[at, which, j] * work.basis[at, j, first + d]
        else:
            z = work.basis[at, which, first + d] * (1.0 if kind == LOWER else -1.0)
        row[work.start[at] + d] = z


@internal_kernel
def known(work: Work, m, kind, at, which):
    """Whether a constraint is among the first m of the step."""
    for i in range(m):
        if work.working[i, 0] == kind and work.working[i, 1] == at and work.working[i, 2] == which:
            return True
    return False


@internal_kernel
def along(arm: Arm, work: Work, x, k, j):
    """Change of coordinate j of knot k by a step x of the unknowns."""
    first, z = arm.parent.shape[0] - work.free[k], 0.0
    for d in range(work.free[k]):
        z += work.basis[k, j, first + d] * x[work.start[k] + d]
    return z


@internal_kernel
def prepare(arm: Arm, points: Points, course: Course, work: Work, Q, damping):
    """Matrix and gradient of Gauss and Newton's model, over what hand and braces leave free of each knot, and forces.

    Returns the number of unknowns.
    """
    weight, pull = work.weight, work.pull
    n, c = arm.parent.shape[0], points.friction.shape[0]
    K, E = Q.shape[0], course.knot.shape[0]
    H, g, B, column, start = work.H, work.g, work.B, work.column, work.start
    # Unknowns that meet in the model are near each other, so that its matrix is a band.
    N, behind = 0, 0
    for k in range(K):
        work.free[k] = split(work, k, constraint_rows(course, points, work, k))
        start[k] = N
        N += work.free[k]
        while behind < E and course.knot[behind] == k:
            work.pressed[behind] = N
            N += c
            behind += 1
    for i in range(N):
        g[i] = 0.0
        for j in range(N):
            H[i, j] = 0.0
    for e in range(E):
        m = 0
        for k in range(K):
            here = course.knot[e] == k
            if not here and course.chord[e, k] == 0.0:
                continue
            first = n - work.free[k]
            for d in range(work.free[k]):
                column[m] = start[k] + d
                for r in range(n):
                    z = 0.0
                    for j in range(n):
                        slope = course.chord[e, k] * work.by_v[e, r, j]
                        if here:
                            slope += work.by_q[e, r, j]
                        z += slope * work.basis[k, j, first + d]
                    B[r, m] = z
                m += 1
        for i in range(c):
            column[m] = work.pressed[e] + i
            for r in range(n):
                B[r, m] = work.by_f[e, r, i]
            m += 1
        for a in range(m):
            for r in range(n):
                g[column[a]] += course.share[e] * pull[e, r] * B[r, a]
            for b in range(a + 1):
                z = 0.0
                for r in range(n):
                    z += weight[e, r] * B[r, a] * B[r, b]
                z *= course.share[e]
                i, j = column[a], column[b]
                if i >= j:
                    H[i, j] += z
                else:
                    H[j, i] += z
    for k in range(K):
        first = n - work.free[k]
        for l in range(K):
            if course.smooth[k, l] == 0.0:
                continue
            other = n - work.free[l]
            for d in range(work.free[k]):
                for j in range(n):
                    g[start[k] + d] += course.smooth[k, l] * work.basis[k, j, first + d] * Q[l, j]
                if l <= k:
                    for b in range(work.free[l]):
                        z = 0.0
                        for j in range(n):
                            z += work.basis[k, j, first + d] * work.basis[l, j, other + b]
                        if start[k] + d >= start[l] + b:
                            H[start[k] + d, start[l] + b] += course.smooth[k, l] * z
    for k in range(K):
        for d in range(work.free[k]):
            H[start[k] + d, start[k] + d] += damping
    for e in range(E):
        for i in range(c):
            H[work.pressed[e] + i, work.pressed[e] + i] += 1e-9
    return N


@internal_kernel
def step(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, N):
    """The step of least model value after :func:`prepare`, which keeps clearances, limits and least forces.

    The matrix is factored in place. Constraints are taken in when a step violates them: dual problems
    min ½ λᵀ A H⁻¹ Aᵀ λ − λ·(b − A x_0) of those so far. Returns twice the fall of the model, −g·x − λ·b; postures
    change by ``work.change``.
    """
    n, c, P = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0]
    K, E = Q.shape[0], course.knot.shape[0]
    H, g, x, skyline = work.H, work.g, work.x, work.skyline
    factor(H, skyline, N)
    # x_0 = −H⁻¹ g, kept as L⁻¹ of it.
    for i in range(N):
        x[i] = -g[i]
    forward(H, skyline, x, N)
    for a in range(work.multiplier.shape[0]):
        work.multiplier[a] = 0.0
    m, most = 0, work.bound.shape[0]
    full = work.step
    for _ in range(12):
        # The step L⁻ᵀ (x + Σ λ L⁻¹ a).
        for i in range(N):
            full[i] = x[i]
            for a in range(m):
                if work.multiplier[a] != 0.0:
                    full[i] += work.multiplier[a] * work.normals[a, i]
        backward(H, skyline, full, N)
        before = m
        for e in range(E):
            for i in range(c):
                slack = least - F[e, i]
                if full[work.pressed[e] + i] < slack - 1e-9 and m < most and not known(work, before, FORCE, e, i):
                    add_row(arm, points, work, m, FORCE, e, i, slack)
                    m += 1
        for k in range(K):
            for i in range(c, P):
                slack = min(points.margin[i] - work.gap[k, i], 0.0)
                if slack < -1.0:
                    continue
                z = 0.0
                for j in range(n):
                    z += work.gap_rate[k, i, j] * along(arm, work, full, k, j)
                if z < slack - 1e-9 and m < most and not known(work, before, CLEAR, k, i):
                    add_row(arm, points, work, m, CLEAR, k, i, slack)
                    m += 1
            for j in range(n):
                z = along(arm, work, full, k, j)
                low, high = min(arm.lower[j] - Q[k, j], 0.0), max(arm.upper[j] - Q[k, j], 0.0)
                if z < low - 1e-9 and m < most and not known(work, before, LOWER, k, j):
                    add_row(arm, points, work, m, LOWER, k, j, low)
                    m += 1
                if z > high + 1e-9 and m < most and not known(work, before, UPPER, k, j):
                    add_row(arm, points, work, m, UPPER, k, j, -high)
                    m += 1
        if m == before:
            break
        for a in range(before, m):
            forward(H, skyline, work.normals[a], N)
            z = 0.0
            for i in range(N):
                z += work.normals[a, i] * x[i]
            work.dual_right[a] = work.bound[a] - z
            for b in range(a + 1):
                z = 0.0
                for i in range(N):
                    z += work.normals[a, i] * work.normals[b, i]
                work.dual[a, b], work.dual[b, a] = z, z
            work.dual[a, a] += 1e-14
        nonnegative(work, work.dual, work.dual_right, work.multiplier, m)
    fall = 0.0
    for i in range(N):
        fall -= g[i] * full[i]
    for a in range(m):
        fall -= work.multiplier[a] * work.bound[a]
    for k in range(K):
        for j in range(n):
            work.change[k, j] = along(arm, work, full, k, j)
    return fall


@kernel
def solve(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, peak, turns, tolerance):
    """Postures Q, (K, n), and forces F, (E, c), of least cost, in place, from postures near by.

    Returns cost and heat [W] and steps taken; NaN where the start cannot be put onto path and surfaces.
    """
    if put_back(arm, points, course, work, Q, 60, ON, 2.0 * REACH / 3.0) > 2.0 * ON:
        return math.nan, math.nan, 0
    equilibrium(arm, points, course, work, Q, F, least, True)
    cost, heat = costs(arm, course, work, Q, peak)
    damping, quiet, taken, ratio = DAMPING, 0, 0, 0.0
    scale = max(cost, 0.1)
    trial, forces = work.trial, work.trial_forces
    while taken < turns:
        taken += 1
        before = cost
        while damping < DAMPING_MAX:
            N = prepare(arm, points, course, work, Q, damping * scale + 1e-6)
            fall = step(arm, points, course, work, Q, F, least, N)
            if not fall > 0.0 or fall < tolerance * 0.1 * max(cost, 1e-3):
                break
            longest = 1e-300
            for k in range(Q.shape[0]):
                for j in range(Q.shape[1]):
                    longest = max(longest, abs(work.change[k, j]))
            share = min(1.0, REACH / longest)
            for k in range(Q.shape[0]):
                for j in range(Q.shape[1]):
                    trial[k, j] = Q[k, j] + share * work.change[k, j]
            if put_back(arm, points, course, work, trial, 12, ON, 2.0 * REACH / 3.0) <= 2.0 * ON:
                equilibrium(arm, points, course, work, trial, forces, least, True)
                there, warmth = costs(arm, course, work, trial, peak)
                if there < cost:
                    ratio = (cost - there) / (fall * share * (2.0 - share))
                    cost, heat = there, warmth
                    copy(trial, Q)
                    copy(forces, F)
                    break
            damping *= 8.0
            equilibrium(arm, points, course, work, Q, F, least, False)
            costs(arm, course, work, Q, peak)
        if not cost < before:
            break
        if ratio > 0.7:
            damping = max(damping / 6.0, DAMPING_MIN)
        elif ratio < 0.25:
            damping *= 3.0
        quiet = quiet + 1 if before - cost < tolerance * max(cost, 1e-3) else 0
        if quiet >= 2:
            break
    equilibrium(arm, points, course, work, Q, F, least, False)
    return cost, heat, taken
