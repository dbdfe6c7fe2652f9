"""Kinematics of the arm: positions of hand and braces, and distances of points and solids, with their rates."""

from __future__ import annotations

import math

from dynsim.dynamics.contact import solids as ks
from dynsim.dynamics.contact.distance import distance
from dynsim.dynamics.contact.solids import find_contacts, rotation_of
from dynsim.dynamics.tree.spatial import (
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
from dynsim.jit.kernel import internal_kernel
from dynsim.planner.compiled.linear import copy
from dynsim.planner.compiled.tables import Arm, Points, Work

# In a step, points are ignored if their distance from a surface exceeds their margin by more than this [m].
NEARBY = 0.5
# Solids are examined if the spheres about them are closer than their margin plus this [m].
SOLIDS_NEARBY = 0.1


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
