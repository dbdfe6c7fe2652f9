"""Compiled statics of a braced arm at many instants with exact derivatives, and the steps of the local solver.

The arm has a fixed base and joints with one coordinate each. Brace forces and joint torques are

    F_c = f_c (n − μ v_t / √(|v_t|² + v_s²)),    τ = g(q) + (D + D_m) v − Σ_c J_cᵀ F_c

for braces c with the surface normal n at the brace and the velocity v_t of the contact point along the surface.
Each knot k has a posture q_k. Instants e are between knots, with postures q_e = Σ_k blend_ek q_k and velocities
v_e = Σ_k chord_ek q_k. On a path that goes back and forth, there are two instants for each posture.

All functions are in one file, because in this package the cache of compiled code checks only the file that contains a
function.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from dynsim.dynamics.contact import solids as ks
from dynsim.dynamics.contact.distance import ShapeArrays, distance
from dynsim.dynamics.contact.solids import PairArrays, find_contacts, rotation_of
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

# A constraint row counts as dependent if the part of it that is independent of the other rows is below this fraction.
DEPENDENT = 1e-9
# Tolerance of the distances from the hand path and the surfaces [m].
ON = 1e-9
# Initial damping of the steps and its bounds, relative to the cost.
DAMPING, DAMPING_MIN, DAMPING_MAX = 1e-3, 1e-7, 1e6
# Maximum step of a coordinate in one iteration [rad or m].
REACH = 0.6
# Maximum step of a coordinate in one iteration of a projection [rad or m].
PROJECTION_REACH = 2.0 * REACH / 3.0
# In a step, points are ignored if their distance from a surface exceeds their margin by more than this [m].
NEARBY = 0.5
# Solids are examined if the spheres about them are closer than their margin plus this [m].
SOLIDS_NEARBY = 0.1
# The projection fails if the residual does not halve within this number of steps.
PATIENCE = 12
# Fraction of the torque limits above which torques have an additional cost, and the factor of this cost relative to the
# heat.
NEAR_LIMIT, LIMIT_COST = 0.98, 100.0
# Exponent of the power mean that approximates the peak torque.
PEAK_POWER = 12
# Threshold, relative to the scale of multipliers and forces, below which it is not worthwhile to release a bound.
NO_GAIN = 1e-11


class Arm(NamedTuple):
    """Joints with one coordinate each and the bodies they carry; n joints, parents before children."""

    parent: np.ndarray  # (n,) int, index of the parent joint; −1: the fixed base
    prismatic: np.ndarray  # (n,) int, 1 or 0
    rotation: np.ndarray  # (n, 9) joint frame at q = 0 in the parent's frame, or in W on the base
    origin: np.ndarray  # (n, 3) origin of that frame [m]
    axis: np.ndarray  # (n, 3)
    mass: np.ndarray  # (n,) [kg]
    com: np.ndarray  # (n, 3) centre of mass in the body's frame [m]
    # For prismatic joints, read forces instead of torques, and metres instead of radians.
    losses: np.ndarray  # (n,) D + D_m [N m s/rad]
    heat: np.ndarray  # (n,) R / K_m² [W/(N m)²]
    greatest: np.ndarray  # (n,) maximum torque at rest [N m]; inf: no limit
    lower: np.ndarray  # (n,) joint limits
    upper: np.ndarray  # (n,)
    gravity: np.ndarray  # (1, 3)
    hand: np.ndarray  # (1,) int, body of the hand
    hand_point: np.ndarray  # (1, 3) [m]
    shapes: ShapeArrays  # the surfaces
    pairs: PairArrays | None = None  # solids that must stay clear of each other, on bodies or (−1) fixed in W


class Points(NamedTuple):
    """Contact points of c braces, followed by points and pairs of solids that must stay clear; P in total."""

    body: np.ndarray  # (P,) int
    point: np.ndarray  # (P, 3) in the body's frame [m]
    radius: np.ndarray  # (P,) radius of a sphere around the point [m]
    surface: np.ndarray  # (P,) int; −1 − m: pair m of solids
    margin: np.ndarray  # (P,) minimum distance [m]; zero for braces
    friction: np.ndarray  # (c,) μ


class Course(NamedTuple):
    """Knots k with targets of the hand, and instants e; the instants of one posture are consecutive."""

    target: np.ndarray  # (K, h) position of the hand [m]; with an orientation, also two of its axes
    knot: np.ndarray  # (E,) int, last knot before the instant
    blend: np.ndarray  # (E, K)
    chord: np.ndarray  # (E, K) [1/s]
    share: np.ndarray  # (E,) fraction of the time; the sum is 1
    smooth: np.ndarray  # (K, K) SᵀS, where S q measures the smoothness of q
    slip_scale: np.ndarray  # (1,) v_s: slip at which friction approaches its full value [m/s]


class Work(NamedTuple):
    """Results and workspace; :func:`dynsim.planner.arm.workspace` reads shapes and types from the annotations."""

    torque: Annotated[np.ndarray, "E n"]
    by_q: Annotated[np.ndarray, "E n n"]  # ∂τ/∂q at fixed v and f
    by_v: Annotated[np.ndarray, "E n n"]
    by_f: Annotated[np.ndarray, "E n c"]
    gap: Annotated[np.ndarray, "K+1 P"]  # distance from the surface minus radius; the last row is for an instant
    gap_rate: Annotated[np.ndarray, "K+1 P n"]  # of nearby points only
    hand: Annotated[np.ndarray, "K+1 h"]
    hand_rate: Annotated[np.ndarray, "K+1 h n"]
    R: Annotated[np.ndarray, "n 9"]
    p: Annotated[np.ndarray, "n 3"]
    a: Annotated[np.ndarray, "n 3"]  # joint axes in W
    below: Annotated[np.ndarray, "n 4"]  # mass and first moment of the bodies that a joint carries
    moment: Annotated[np.ndarray, "n 3"]  # lever × weight of the bodies that a joint carries
    touch: Annotated[np.ndarray, "c n 3"]  # velocity of the contact point per unit rate
    turned: Annotated[np.ndarray, "c n 3"]  # ∂n/∂q of the normal at the brace
    normal: Annotated[np.ndarray, "c 3"]
    shift: Annotated[np.ndarray, "c n 3"]  # displacement of the contact point on the body per coordinate
    slip: Annotated[np.ndarray, "c 7"]  # u = v_t / √(|v_t|² + v_s²), velocity of the contact point, that square root
    force: Annotated[np.ndarray, "c 3"]
    turn: Annotated[np.ndarray, "n 3"]  # ∂F/∂q of a brace
    drift: Annotated[np.ndarray, "n 3"]  # ∂F/∂v
    basis: Annotated[np.ndarray, "K n n"]  # orthonormal basis; the last columns span the null space of hand and braces
    free: Annotated[np.ndarray, "K", int]  # number of these columns
    rows: Annotated[np.ndarray, "R n"]  # constraints of one knot
    normal_matrix: Annotated[np.ndarray, "R R"]
    right: Annotated[np.ndarray, "R"]
    H: Annotated[np.ndarray, "N N"]
    g: Annotated[np.ndarray, "N"]
    x: Annotated[np.ndarray, "max(N,n)"]  # L⁻¹ times the step without constraints
    step: Annotated[np.ndarray, "N"]
    B: Annotated[np.ndarray, "n Kn+c"]
    column: Annotated[np.ndarray, "Kn+c", int]
    start: Annotated[np.ndarray, "K", int]  # first unknown of each knot's posture; the forces of its instants follow
    pressed: Annotated[np.ndarray, "E", int]  # first force of each instant
    skyline: Annotated[np.ndarray, "N", int]  # first nonzero column of each row of H
    working: Annotated[np.ndarray, "W 3", int]  # violated constraints of the step: kind, knot or instant, index
    bound: Annotated[np.ndarray, "W"]
    normals: Annotated[np.ndarray, "N W"]  # normals of these constraints as columns, later multiplied by L⁻¹
    dual: Annotated[np.ndarray, "W W"]
    dual_right: Annotated[np.ndarray, "W"]
    multiplier: Annotated[np.ndarray, "W"]
    passive: Annotated[np.ndarray, "W", int]
    small: Annotated[np.ndarray, "W W"]
    small_right: Annotated[np.ndarray, "W"]
    index: Annotated[np.ndarray, "W", int]
    small_skyline: Annotated[np.ndarray, "max(W,R)", int]
    between: Annotated[np.ndarray, "n"]  # posture of an instant
    rate: Annotated[np.ndarray, "n"]  # velocity of an instant
    weight: Annotated[np.ndarray, "E n"]  # weights of the squared torques in the model of the cost
    pull: Annotated[np.ndarray, "E n"]  # half the gradient of the cost by the torques, divided by the fraction of time
    change: Annotated[np.ndarray, "K n"]  # change of the postures in a step
    trial: Annotated[np.ndarray, "K n"]
    trial_forces: Annotated[np.ndarray, "E c"]


@internal_kernel
def poses(arm: Arm, work: Work, q):
    """Compute the frames of all bodies, the joint axes in W, and the mass and first moment that each joint carries."""
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
    """Return the position in W of the point in row i of a table, fixed to a body [m]."""
    return transform(vector(work.p, body, 0), rotation(work.R, body, 0), vector(point, i, 0))


@internal_kernel
def rates(arm: Arm, work: Work, body, at, out):
    """Compute the velocity of a body's material point at position ``at`` per unit joint rate, shape (n, 3)."""
    out[:] = 0.0
    j = body
    while j >= 0:
        a = vector(work.a, j, 0)
        if not arm.prismatic[j]:
            a = cross(a, along(at, vector(work.p, j, 0), -1.0))
        put_vector(out, j, 0, a)
        j = arm.parent[j]


@internal_kernel
def copy(source, target):
    """Copy the entries of a matrix to another matrix."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@internal_kernel
def dot(a, b):
    """Return the scalar product of two vectors."""
    s = 0.0
    for i in range(a.shape[0]):
        s += a[i] * b[i]
    return s


@internal_kernel
def geometry(arm: Arm, points: Points, work: Work, q, k, count):
    """Compute row k of hand and gaps with their rates, for the first ``count`` points.

    For braces, the geometry of the forces is also computed.
    """
    n, c, hand, jacobian = arm.parent.shape[0], points.friction.shape[0], arm.hand[0], work.turn
    poses(arm, work, q)
    x = body_point(work, hand, arm.hand_point, 0)
    rates(arm, work, hand, x, jacobian)
    put_vector(work.hand, k, 0, x)
    copy(jacobian.T, work.hand_rate[k, :3])
    # With an orientation, write the z axis of the hand's body, then its x axis.
    for row in range(3, work.hand.shape[1], 3):
        R = rotation(work.R, hand, 0)
        axis = third_axis(R) if row == 3 else first_axis(R)
        jacobian[:] = 0.0
        j = hand
        while j >= 0:
            if not arm.prismatic[j]:
                put_vector(jacobian, j, 0, cross(vector(work.a, j, 0), axis))
            j = arm.parent[j]
        put_vector(work.hand, k, row, axis)
        copy(jacobian.T, work.hand_rate[k, row : row + 3])
    for i in range(count):
        if points.surface[i] < 0:
            pair_geometry(arm.pairs, arm, points, work, k, i)
            continue
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
        # The contact point moves by J_centre − ρ ∂n/∂q, whereas the material point there moves by J_touch.
        for j in range(n):
            centre = vector(jacobian, j, 0)
            dn = times_inertia((xx, xy, xz, yy, yz, zz), centre)
            put_vector(turned, j, 0, dn)
            put_vector(shift, j, 0, along(along(centre, dn, -radius), vector(touch, j, 0), -1.0))


@internal_kernel
def pair_geometry(pairs, arm: Arm, points: Points, work: Work, k, i):
    """Compute the distance of a pair of solids in row k with its rates; without pairs (None) nothing is compiled.

    If the spheres about the solids are far apart, the distance is infinite, so that the pair is ignored.
    """
    if pairs is None:
        return
    m = -1 - points.surface[i]
    index, solid, poses = pairs.index[m], pairs.solid[m], pairs.poses
    for side in range(2):
        R, p = rotation_of(solid[side]), vector(solid, side, ks.POSE + 9)
        if index[side] >= 0:
            body = rotation(work.R, index[side], 0)
            R, p = compose(body, R), transform(vector(work.p, index[side], 0), body, p)
        put_rotation(poses, side, 0, R)
        put_vector(poses, side, 9, p)
    apart = along(vector(poses, 0, 9), vector(poses, 1, 9), -1.0)
    far = math.sqrt(dot_vector(apart, apart)) - solid[0, ks.BOUND] - solid[1, ks.BOUND]
    if far > points.margin[i] + SOLIDS_NEARBY:
        work.gap[k, i] = math.inf
        return
    core, other, slots = solid[0, ks.CORE : ks.BOUND], solid[1, ks.CORE : ks.BOUND], pairs.slots[m]
    find_contacts(poses[0], core, poses[1], other, pairs.known[m], slots, pairs.places, pairs.chosen)
    best = 0
    for j in range(ks.SLOTS):
        if slots[j, ks.GAP] < slots[best, ks.GAP]:
            best = j
    normal, x = vector(slots, best, ks.NORMAL), vector(slots, best, ks.PLACE)
    work.gap[k, i], work.gap_rate[k, i] = slots[best, ks.GAP], 0.0
    for side in range(2):
        if index[side] >= 0:
            rates(arm, work, index[side], x, work.turn)
            for j in range(arm.parent.shape[0]):
                rate = dot_vector(normal, vector(work.turn, j, 0))
                work.gap_rate[k, i, j] += rate if side == 0 else -rate


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
            least_heat(arm, work, min_force, F[e], e)
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
def factor(A, skyline, done, n):
    """Factorise the leading n × n part of A = L Lᵀ (Cholesky) in its lower half; vanishing pivots become very large.

    Parameters
    ----------
    A : ndarray
        Symmetric matrix; its lower half is overwritten by L.
    skyline : (n,) ndarray of int
        Output: first nonzero column of each row of A; L is also zero to the left of it.
    done : int
        Number of leading rows that already contain L.
    n : int
        Size of the leading part.
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
    """Compute b ← L⁻¹ b."""
    for i in range(n):
        s = b[i]
        for k in range(skyline[i], i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@internal_kernel
def backward(L, skyline, b, n):
    """Compute b ← L⁻ᵀ b."""
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(skyline[i], i):
            b[k] -= L[i, k] * b[i]


@internal_kernel
def nonnegative(work: Work, G, h, x, known, m):
    """Minimise ½ xᵀGx − hᵀx over x ≥ 0 with the active-set method of Lawson and Hanson.

    Parameters
    ----------
    work : Work
        Workspace.
    G : (m, m) ndarray
        Positive semidefinite matrix with a small positive diagonal.
    h, x : (m,) ndarray
        Linear term, and the solution.
    known : int
        Number of leading entries of x that already solve the problem without the remaining entries; ``work.passive``
        marks the positive ones.
    m : int
        Number of unknowns.
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
            if course.smooth[k, l] != 0.0:
                for j in range(n):
                    cost += course.smooth[k, l] * Q[k, j] * Q[l, j]
    return cost + heat, heat


@internal_kernel
def constraint_rows(points: Points, work: Work, k):
    """Write the constraint rows of hand and braces at knot k to ``work.rows``; return their number."""
    c, h = points.friction.shape[0], work.hand.shape[1]
    copy(work.hand_rate[k], work.rows)
    copy(work.gap_rate[k, :c], work.rows[h:])
    return h + c


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
    n, c, P, h = arm.parent.shape[0], points.friction.shape[0], points.body.shape[0], work.hand.shape[1]
    rows, A, right = work.rows, work.normal_matrix, work.right
    worst = 0.0
    for k in range(Q.shape[0]):
        left, halved = math.inf, math.inf
        for attempt in range(steps + 1):
            geometry(arm, points, work, Q[k], k, P)
            m = constraint_rows(points, work, k)
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
def prepare(arm: Arm, points: Points, course: Course, work: Work, Q, damping):
    """Compute matrix and gradient of the Gauss–Newton model in the null space of hand and braces, and in the forces.

    Returns the number of unknowns.
    """
    weight, pull = work.weight, work.pull
    n, c = arm.parent.shape[0], points.friction.shape[0]
    K, E = Q.shape[0], course.knot.shape[0]
    H, g, B, column, start = work.H, work.g, work.B, work.column, work.start
    # Number coupled unknowns close to each other, so that the matrix is banded.
    N, behind = 0, 0
    for k in range(K):
        work.free[k] = null_space(work, k, constraint_rows(points, work, k))
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
                        if start[k] + d >= start[l] + b:
                            z = dot(work.basis[k, :, first + d], work.basis[l, :, other + b])
                            H[start[k] + d, start[l] + b] += course.smooth[k, l] * z
    for k in range(K):
        for d in range(work.free[k]):
            H[start[k] + d, start[k] + d] += damping
    for e in range(E):
        for i in range(c):
            H[work.pressed[e] + i, work.pressed[e] + i] += 1e-9
    return N


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
                value, slack = full[work.pressed[e] + i], min_force - F[e, i]
                m = add_violated(arm, work, m, before, FORCE, e, i, value, slack)
        for k in range(K):
            for i in range(c, P):
                slack = min(points.margin[i] - work.gap[k, i], 0.0)
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
def solve(arm: Arm, points: Points, course: Course, work: Work, Q, F, min_force, peak, turns, tolerance):
    """Minimise the cost over postures Q, shape (K, n), and forces F, shape (E, c), in place, from a nearby start.

    Returns cost [W], heat [W] and number of steps; NaN if the start cannot be projected onto path and surfaces.
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
        if quiet >= 2:
            break
    statics(arm, points, course, work, Q, F, min_force, False)
    return cost, heat, taken
