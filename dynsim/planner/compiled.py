"""Statics of a braced arm at many instants with exact derivatives, and the steps of the local solver, compiled.

For an arm whose joints each have one coordinate, on a fixed base, with braces c whose forces are

    F_c = f_c (n − μ v_t / √(|v_t|² + v_s²)),    τ = g(q) + (D + D_m) v − Σ_c J_cᵀ F_c

n: normal of the surface at the brace, v_t: velocity of the touching point along the surface. Postures q_k belong to
knots; instants e lie between knots, at q_e = Σ_k blend_ek q_k with velocities v_e = Σ_k chord_ek q_k. So one posture
has two instants on a path that goes back and forth.

All is in one file, because for this package the cache of compiled code checks the function's own file only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics.contact.distance import ShapeArrays, distance
from dynsim.dynamics.tree.spatial import (
    ZERO_VECTOR,
    along,
    compose,
    cross,
    dot_vector,
    first_axis,
    put_rotation,
    put_vector,
    rotate,
    rotation,
    third_axis,
    times_inertia,
    times_number,
    transform,
    turn,
    vector,
)
from dynsim.jit.kernel import internal_kernel, kernel

# A constraint row of which less than this share is independent of the others is dependent.
DEPENDENT = 1e-9
# Distance from hand path and surfaces that counts as none [m].
ON = 1e-9
# First damping of the steps beside the curvature of the heat, and its bounds, over the largest of that curvature.
DAMPING, DAMPING_MIN, DAMPING_MAX = 1e-3, 1e-7, 1e6
# Longest step of a coordinate in one iteration [rad or m].
REACH = 0.6
# Points that are so much further from a surface than they must be are left out of a step [m].
NEARBY = 0.5
# Steps back onto the manifold within which what is left must be halved, or the search for it ends.
PATIENCE = 12
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
    rotation: np.ndarray  # (n, 9) of the joint frame at q = 0 in the parent's, in W on the base
    origin: np.ndarray  # (n, 3) of that frame there [m]
    axis: np.ndarray  # (n, 3)
    mass: np.ndarray  # (n,) [kg]
    com: np.ndarray  # (n, 3) centre of mass in the body's frame [m]
    # Of a prismatic joint forces stand for torques, and metres for radians.
    losses: np.ndarray  # (n,) D + D_m [N m s/rad]
    heat: np.ndarray  # (n,) R / K_m² [W/(N m)²]
    greatest: np.ndarray  # (n,) greatest torque at rest [N m], inf for none
    lower: np.ndarray  # (n,) limits of the joints
    upper: np.ndarray  # (n,)
    gravity: np.ndarray  # (1, 3)
    hand: np.ndarray  # (1,) int, its body
    hand_point: np.ndarray  # (1, 3) [m]
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
    """Knots k with targets of the hand and instants e; instants of one posture follow each other."""

    target: np.ndarray  # (K, h) position of the hand [m], with the two directions' components if they are asked for
    knot: np.ndarray  # (E,) int, the last one before the instant
    blend: np.ndarray  # (E, K)
    chord: np.ndarray  # (E, K) [1/s]
    share: np.ndarray  # (E,) of the time; their sum is 1
    smooth: np.ndarray  # (K, K) SᵀS of the smoothness S q
    slip_scale: np.ndarray  # (1,) slip over which friction grows to its value [m/s]


class Work(NamedTuple):
    """Results and scratch."""

    torque: np.ndarray  # (E, n)
    by_q: np.ndarray  # (E, n, n) ∂τ/∂q at fixed v and f
    by_v: np.ndarray  # (E, n, n)
    by_f: np.ndarray  # (E, n, c)
    gap: np.ndarray  # (K + 1, P) distance from the surface less radius; the last row is of an instant
    gap_rate: np.ndarray  # (K + 1, P, n), of those that are near by
    hand: np.ndarray  # (K + 1, h)
    hand_rate: np.ndarray  # (K + 1, h, n)
    R: np.ndarray  # (n, 9)
    p: np.ndarray  # (n, 3)
    a: np.ndarray  # (n, 3) joint axes in W
    below: np.ndarray  # (n, 4) mass and first moment of what a joint carries
    moment: np.ndarray  # (n, 3) of the weight that a joint carries, about it, turned by each
    touch: np.ndarray  # (c, n, 3) velocity of the touching point by each rate
    turned: np.ndarray  # (c, n, 3) ∂n/∂q: what the normal at the brace turns by
    normal: np.ndarray  # (c, 3)
    shift: np.ndarray  # (c, n, 3) what the touching point moves by on the body, by each coordinate
    slip: np.ndarray  # (c, 7) velocity along the surface over its size, that of the touching point, that size
    force: np.ndarray  # (c, 3)
    turn: np.ndarray  # (n, 3) ∂F/∂q of a brace
    drift: np.ndarray  # (n, 3) ∂F/∂v
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
    normals: np.ndarray  # (N, W) their normals as columns, then L⁻¹ times them
    dual: np.ndarray  # (W, W)
    dual_right: np.ndarray  # (W,)
    multiplier: np.ndarray  # (W,)
    passive: np.ndarray  # (W,) int
    small: np.ndarray  # (W, W)
    small_right: np.ndarray  # (W,)
    index: np.ndarray  # (W,) int
    small_skyline: np.ndarray  # (W,) int
    between: np.ndarray  # (n,) posture of an instant
    rate: np.ndarray  # (n,) velocity of an instant
    weight: np.ndarray  # (E, n) of the squares of torques in the model of the cost
    pull: np.ndarray  # (E, n) half the gradient of the cost by torques, over the share of time
    change: np.ndarray  # (K, n) of postures in a step
    trial: np.ndarray  # (K, n)
    trial_forces: np.ndarray  # (E, c)


@internal_kernel
def poses(arm: Arm, work: Work, q):
    """Frames of all bodies, joint axes in W, and mass and first moment of what each joint carries."""
    n, below = arm.parent.shape[0], work.below
    for j in range(n):
        i, u = arm.parent[j], vector(arm.axis, j, 0)
        R, p = rotation(arm.rotation, j, 0), vector(arm.origin, j, 0)
        if i >= 0:
            before = rotation(work.R, i, 0)
            R, p = compose(before, R), transform(vector(work.p, i, 0), before, p)
        a = rotate(R, u)
        if arm.prismatic[j]:
            p = along(p, a, q[j])
        else:
            R = turn(R, u, a, math.sin(q[j]), math.cos(q[j]))
        put_rotation(work.R, j, 0, R)
        put_vector(work.p, j, 0, p)
        put_vector(work.a, j, 0, a)
        below[j, 0] = arm.mass[j]
        put_vector(below, j, 1, times_number(transform(p, R, vector(arm.com, j, 0)), arm.mass[j]))
    for j in range(n - 1, -1, -1):
        if arm.parent[j] >= 0:
            for r in range(4):
                below[arm.parent[j], r] += below[j, r]


@internal_kernel
def body_point(work: Work, body, point, i):
    """Place of point i of a table, on a body, in W [m]."""
    return transform(vector(work.p, body, 0), rotation(work.R, body, 0), vector(point, i, 0))


@internal_kernel
def rates(arm: Arm, work: Work, body, at, out):
    """Velocity of the material point of a body at a place ``at``, for each unit of rate, (n, 3)."""
    for j in range(arm.parent.shape[0]):
        put_vector(out, j, 0, ZERO_VECTOR)
    j = body
    while j >= 0:
        a = vector(work.a, j, 0)
        if not arm.prismatic[j]:
            a = cross(a, along(at, vector(work.p, j, 0), -1.0))
        put_vector(out, j, 0, a)
        j = arm.parent[j]


@internal_kernel
def put_rows(table, out, row):
    """A table (n, 3) as three rows of another one, from ``row`` on."""
    for j in range(table.shape[0]):
        for r in range(3):
            out[row + r, j] = table[j, r]


@internal_kernel
def geometry(arm: Arm, points: Points, work: Work, q, k, count):
    """Into row k: hand, gaps and rates of the first ``count`` points; of the braces what their forces need too."""
    n, c, hand, jacobian = arm.parent.shape[0], points.friction.shape[0], arm.hand[0], work.turn
    poses(arm, work, q)
    x = body_point(work, hand, arm.hand_point, 0)
    rates(arm, work, hand, x, jacobian)
    put_vector(work.hand, k, 0, x)
    put_rows(jacobian, work.hand_rate[k], 0)
    # Where an orientation is asked for: the z axis of the hand's body, then its x axis.
    for row in range(3, work.hand.shape[1], 3):
        R = rotation(work.R, hand, 0)
        axis = third_axis(R) if row == 3 else first_axis(R)
        for j in range(n):
            put_vector(jacobian, j, 0, ZERO_VECTOR)
        j = hand
        while j >= 0:
            if not arm.prismatic[j]:
                put_vector(jacobian, j, 0, cross(vector(work.a, j, 0), axis))
            j = arm.parent[j]
        put_vector(work.hand, k, row, axis)
        put_rows(jacobian, work.hand_rate[k], row)
    for i in range(count):
        body, radius = points.body[i], points.radius[i]
        x = body_point(work, body, points.point, i)
        far, nx, ny, nz, xx, xy, xz, yy, yz, zz = distance(arm.shapes, points.surface[i], x[0], x[1], x[2])
        normal = (nx, ny, nz)
        work.gap[k, i] = far - radius
        if i >= c and far - radius > points.margin[i] + NEARBY:
            continue
        rates(arm, work, body, x, jacobian)
        for j in range(n):
            work.gap_rate[k, i, j] = dot_vector(normal, vector(jacobian, j, 0))
        if i >= c:
            continue
        put_vector(work.normal, i, 0, normal)
        touch, shift, turned = work.touch[i], work.shift[i], work.turned[i]
        rates(arm, work, body, along(x, normal, -radius), touch)
        # The touching point moves by J_centre − ρ ∂n/∂q, the material there by J_touch.
        for j in range(n):
            centre = vector(jacobian, j, 0)
            dn = times_inertia((xx, xy, xz, yy, yz, zz), centre)
            put_vector(turned, j, 0, dn)
            put_vector(shift, j, 0, along(along(centre, dn, -radius), vector(touch, j, 0), -1.0))


@internal_kernel
def statics(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, forces):
    """Torques of the instants with their derivatives, and geometry of all knots. Q: (K, n), F: (E, c).

    ∂τ/∂q_r = H_jr − Σ_c J_cj · ∂F_c/∂q_r − Σ_c (a_j × s_cr) · F_c,
    H_ij = −a_i · M_j (joint i carries joint j, both directions alike), M_j = Σ_k J_kj × w_k over weights and forces;
    zero for a prismatic joint i. s_cr: what the touching point moves by on its body.

    forces : whether those of least heat, at least ``least`` [N], are put into F first
    """
    n, c, weight = arm.parent.shape[0], points.friction.shape[0], vector(arm.gravity, 0, 0)
    K, v = Q.shape[0], work.rate
    for k in range(K):
        geometry(arm, points, work, Q[k], k, points.body.shape[0])
    for e in range(course.knot.shape[0]):
        for j in range(n):
            v[j], work.between[j] = 0.0, 0.0
            for k in range(K):
                v[j] += course.chord[e, k] * Q[k, j]
                work.between[j] += course.blend[e, k] * Q[k, j]
        if e == 0 or course.knot[e] != course.knot[e - 1]:
            geometry(arm, points, work, work.between, K, c)
        for j in range(n):
            a, mass = vector(work.a, j, 0), work.below[j, 0]
            if arm.prismatic[j]:
                lever = times_number(a, mass)
            else:
                lever = cross(a, along(vector(work.below, j, 1), vector(work.p, j, 0), -mass))
            work.torque[e, j] = arm.losses[j] * v[j] - dot_vector(weight, lever)
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
            pull = along(normal, u, -points.friction[i])
            put_vector(work.force, i, 0, pull)
            for j in range(n):
                work.by_f[e, j, i] = -dot_vector(vector(work.touch[i], j, 0), pull)
        if forces:
            least_heat(arm, work, least, F[e], e)
        for i in range(c):
            put_vector(work.force, i, 0, times_number(vector(work.force, i, 0), F[e, i]))
        for j in range(n):
            moment = vector(work.moment, j, 0)
            for i in range(c):
                work.torque[e, j] += work.by_f[e, j, i] * F[e, i]
                moment = along(moment, cross(vector(work.touch[i], j, 0), vector(work.force, i, 0)), 1.0)
            for i in range(n):
                work.by_v[e, i, j] = 0.0
                if i <= j:
                    work.by_q[e, i, j], work.by_q[e, j, i] = 0.0, 0.0
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
    """What the direction of brace i's force, and the point that it acts at, add to the derivatives of instant e.

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
    # From the tip inwards: carried = Σ J_i v_i of joint j and those it carries, before = Σ a_i v_i of those before it.
    before, carried = whole, ZERO_VECTOR
    j = body
    while j >= 0:
        rate, a, dn = vector(touch, j, 0), vector(work.a, j, 0), vector(turned, j, 0)
        carried = along(carried, rate, v[j])
        # The material at the touching point changes.
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
def factor(A, skyline, done, n):
    """Cholesky's L of the leading n × n part of A, in its lower half; pivots that are lost stop moving anything.

    skyline : (n,) int, out: first column of each row that is not zero; left of it L has zeros too
    done : so many rows are those of L already
    """
    for i in range(done, n):
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
def nonnegative(work: Work, G, h, x, known, m):
    """x ≥ 0 that minimises ½ xᵀGx − hᵀx, by Lawson and Hanson's active sets.

    G: (m, m) positive semidefinite, with room for a little on its diagonal.
    known : the first so many are the solution without the others, and those above zero are marked in ``work.passive``
    """
    passive, small, right, index, skyline = work.passive, work.small, work.small_right, work.index, work.small_skyline
    scale, count, done = 1e-300, 0, 0
    for i in range(m):
        scale = max(scale, abs(h[i]))
        if i >= known:
            x[i], passive[i] = 0.0, 0
        elif passive[i]:
            index[count] = i
            count += 1
    for _ in range(3 * m + 10):
        best, most = -1, NO_GAIN * scale
        for i in range(m):
            if passive[i] == 0:
                gain = h[i]
                for a in range(count):
                    gain -= G[i, index[a]] * x[index[a]]
                if gain > most:
                    best, most = i, gain
        if best < 0:
            return
        passive[best], index[count] = 1, best
        count += 1
        while count > 0:
            for a in range(done, count):
                for b in range(a + 1):
                    small[a, b] = G[index[a], index[b]]
                small[a, a] *= 1.0 + 1e-12
            factor(small, skyline, done, count)
            done = count
            for a in range(count):
                right[a] = h[index[a]]
            forward(small, skyline, right, count)
            backward(small, skyline, right, count)
            share, first = 1.0, -1
            for a in range(count):
                i = index[a]
                if right[a] <= 0.0:
                    reached = x[i] / (x[i] - right[a]) if x[i] > right[a] else 0.0
                    if reached < share:
                        share, first = reached, a
            left = 0
            for a in range(count):
                i = index[a]
                x[i] += share * (right[a] - x[i])
                if a == first or (first >= 0 and right[a] <= 0.0 and x[i] <= 1e-13 * scale):
                    x[i], passive[i], done = 0.0, 0, min(done, a)
                else:
                    index[left] = i
                    left += 1
            count = left
            if first < 0:
                break


@internal_kernel
def least_heat(arm: Arm, work: Work, least, f, e):
    """Normal forces of least heat of instant e, (c,), at least ``least``; its torques are those without forces."""
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
            s -= G[i, k] * least
        h[i] = s
    nonnegative(work, G, h, x, 0, c)
    for i in range(c):
        f[i] = least + x[i]


@kernel
def settle(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, forces):
    """See :func:`statics`."""
    statics(arm, points, course, work, Q, F, least, forces)


@internal_kernel
def costs(arm: Arm, course: Course, work: Work, Q, peak):
    """Cost and heat [W] of the torques in the workspace; weights and pull of the cost's quadratic model.

    Torques near their limits are dear; ``peak`` : cost of the greatest torque of revolute joints [W/(N m)], by a mean
    of high power. Forces of prismatic joints are no torques.
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
                cost += share * DEAR * w * over * over
                work.weight[e, j] += DEAR * w
                work.pull[e, j] += DEAR * w * math.copysign(over, torque)
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
            if course.smooth[k, l] != 0.0:
                for j in range(n):
                    cost += course.smooth[k, l] * Q[k, j] * Q[l, j]
    return cost + heat, heat


@internal_kernel
def copy(a, out):
    """Entries of a matrix to another one."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


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

    Damped Gauss–Newton's steps on what is violated. Returns what is left at the worst knot [m], up to the first
    that fails.
    ``reach`` : greatest step of a coordinate
    """
    n, c, P, h = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0], work.hand.shape[1]
    rows, A, right = work.rows, work.normal_matrix, work.right
    worst = 0.0
    for k in range(Q.shape[0]):
        left, halved = math.inf, math.inf
        for attempt in range(steps + 1):
            geometry(arm, points, work, Q[k], k, P)
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
                    z = 0.0
                    for j in range(n):
                        z += rows[r, j] * rows[s, j]
                    A[r, s] = z
                A[r, r] += damping
            factor(A, work.small_skyline, 0, m)
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
        if worst > 2.0 * tolerance:
            break
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
def taken_in(arm: Arm, points: Points, work: Work, m, before, kind, at, which, value, bound):
    """How many constraints the step has with one that it violates: as column m its normal over the unknowns."""
    if value >= bound - 1e-9 or m == work.bound.shape[0]:
        return m
    for i in range(before):
        if work.working[i, 0] == kind and work.working[i, 1] == at and work.working[i, 2] == which:
            return m
    n, N = arm.parent.shape[0], unknowns(work)
    normals = work.normals
    work.working[m, 0], work.working[m, 1], work.working[m, 2], work.bound[m] = kind, at, which, bound
    for i in range(N):
        normals[i, m] = 0.0
    if kind == FORCE:
        normals[work.pressed[at] + which, m] = 1.0
        return m + 1
    first = n - work.free[at]
    for d in range(work.free[at]):
        z = 0.0
        if kind == CLEAR:
            for j in range(n):
                z += work.gap_rate[at, which, j] * work.basis[at, j, first + d]
        else:
            z = work.basis[at, which, first + d] * (1.0 if kind == LOWER else -1.0)
        normals[work.start[at] + d, m] = z
    return m + 1


@internal_kernel
def moved(arm: Arm, work: Work, x, k, j):
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
            if course.blend[e, k] == 0.0 and course.chord[e, k] == 0.0:
                continue
            first = n - work.free[k]
            for d in range(work.free[k]):
                column[m] = start[k] + d
                for r in range(n):
                    z = 0.0
                    for j in range(n):
                        slope = course.chord[e, k] * work.by_v[e, r, j] + course.blend[e, k] * work.by_q[e, r, j]
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
def taken_along(work: Work, N, before, m):
    """The dual problem's rows of constraints from ``before`` on, of m, whose normals become L⁻¹ times them.

    By rows of the normals, whose ends the compiler takes several at once of; most of their beginnings are zero.
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
def step(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, N):
    """The step of least model value after :func:`prepare`, which keeps clearances, limits and least forces.

    The matrix is factored in place. Constraints are taken in when a step violates them: dual problems
    min ½ λᵀ A H⁻¹ Aᵀ λ − λ·(b − A x_0) of those so far. Returns twice the fall of the model, −g·x − λ·b; postures
    change by ``work.change``.
    """
    n, c, P = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0]
    K, E = Q.shape[0], course.knot.shape[0]
    H, g, x, skyline = work.H, work.g, work.x, work.skyline
    factor(H, skyline, 0, N)
    # x_0 = −H⁻¹ g, kept as L⁻¹ of it.
    for i in range(N):
        x[i] = -g[i]
    forward(H, skyline, x, N)
    for a in range(work.multiplier.shape[0]):
        work.multiplier[a] = 0.0
    m = 0
    full = work.step
    for _ in range(12):
        # The step L⁻ᵀ (x + Σ λ L⁻¹ a).
        for i in range(N):
            full[i] = x[i]
            for a in range(m):
                if work.multiplier[a] != 0.0:
                    full[i] += work.multiplier[a] * work.normals[i, a]
        backward(H, skyline, full, N)
        for k in range(K):
            for j in range(n):
                work.change[k, j] = moved(arm, work, full, k, j)
        before = m
        for e in range(E):
            for i in range(c):
                value, slack = full[work.pressed[e] + i], least - F[e, i]
                m = taken_in(arm, points, work, m, before, FORCE, e, i, value, slack)
        for k in range(K):
            for i in range(c, P):
                slack = min(points.margin[i] - work.gap[k, i], 0.0)
                if slack < -NEARBY:
                    continue
                z = 0.0
                for j in range(n):
                    z += work.gap_rate[k, i, j] * work.change[k, j]
                m = taken_in(arm, points, work, m, before, CLEAR, k, i, z, slack)
            for j in range(n):
                z, low, high = work.change[k, j], arm.lower[j] - Q[k, j], arm.upper[j] - Q[k, j]
                m = taken_in(arm, points, work, m, before, LOWER, k, j, z, min(low, 0.0))
                m = taken_in(arm, points, work, m, before, UPPER, k, j, -z, -max(high, 0.0))
        if m == before:
            break
        taken_along(work, N, before, m)
        nonnegative(work, work.dual, work.dual_right, work.multiplier, before, m)
    fall = 0.0
    for i in range(N):
        fall -= g[i] * full[i]
    for a in range(m):
        fall -= work.multiplier[a] * work.bound[a]
    return fall


@kernel
def solve(arm: Arm, points: Points, course: Course, work: Work, Q, F, least, peak, turns, tolerance):
    """Postures Q, (K, n), and forces F, (E, c), of least cost, in place, from postures near by.

    Returns cost and heat [W] and steps taken; NaN where the start cannot be put onto path and surfaces.
    """
    if put_back(arm, points, course, work, Q, 60, ON, 2.0 * REACH / 3.0) > 2.0 * ON:
        return math.nan, math.nan, 0
    statics(arm, points, course, work, Q, F, least, True)
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
                statics(arm, points, course, work, trial, forces, least, True)
                there, warmth = costs(arm, course, work, trial, peak)
                if there < cost:
                    ratio = (cost - there) / (fall * share * (2.0 - share))
                    cost, heat = there, warmth
                    copy(trial, Q)
                    copy(forces, F)
                    break
            damping *= 8.0
            statics(arm, points, course, work, Q, F, least, False)
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
    statics(arm, points, course, work, Q, F, least, False)
    return cost, heat, taken
