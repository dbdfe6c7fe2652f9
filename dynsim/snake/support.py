"""Support polygon, static stability and cost functions of the redundancy resolution ([T] eqs 19 and 20).

All of them depend only on the joint angles and the grounded wheel pairs, not on the robot's pose on the plane.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.snake.kinematics import SnakeModel, zero_arrays

COST_ANGLES = 0  # eq 19
COST_SUPPORT_NORM = 1  # eq 20 as printed: 1 / norm of the distances to all sides
COST_SUPPORT_MIN = 2  # eq 20 with the smoothed distance to the nearest side


class Cost(NamedTuple):
    """Parameters of the cost V; ``kind`` is one of COST_*."""

    kind: int
    diagonal: np.ndarray  # (n_phi,) K_V
    angle_weight: float  # a_1
    support_weight: float  # a_2 [m]
    distance_floor: float  # [m] lower bound of the distances in V, so that V stays finite if the robot tips
    smoothing: float  # [m] sides whose distances differ by less than about this value are averaged as the nearest side


class Support(NamedTuple):
    """Workspace and result of :func:`support_polygon`."""

    contact: np.ndarray  # (2 (n_b + 1), 2) contact points of the wheels with the ground [m]
    owner: np.ndarray  # (2 (n_b + 1),) wheel pair of each contact
    order: np.ndarray  # (2 (n_b + 1),) sorting workspace
    hull: np.ndarray  # (2 (n_b + 1) + 1,) contacts on the hull, counter-clockwise
    distance: np.ndarray  # (2 (n_b + 1),) signed distance of the centre of mass from each side, inside > 0 [m]
    length: np.ndarray  # (2 (n_b + 1),) length of each side [m]
    centre: np.ndarray  # (3,) centre of mass [m]
    centre_slope: np.ndarray  # (n_phi, 2) derivative of the projected centre with wheel pair 1's body fixed [m/rad]
    slope: np.ndarray  # (n_phi,) derivative of one distance [m/rad]
    length_slope: np.ndarray  # (n_phi,) derivative of the length of that side [m/rad]


def new_support(model: SnakeModel) -> Support:
    """Allocate the workspace of :func:`support_polygon`, :func:`cost_value` and :func:`cost_gradient`."""
    contacts, joints = 2 * (model.base_joints + 1), model.head_joints + model.base_joints
    sizes = {"contact": (contacts, 2), "distance": contacts, "length": contacts, "centre": 3}
    sizes |= {"centre_slope": (joints, 2), "slope": joints, "length_slope": joints}
    owner, order, hull = (np.zeros(size, dtype=np.int64) for size in (contacts, contacts, contacts + 1))
    return zero_arrays(Support, sizes, owner=owner, order=order, hull=hull)


@internal_kernel
def cross(ox, oy, ax, ay, bx, by):
    """Return (a - o) x (b - o), which is positive if o, a, b turn left."""
    return (ax - ox) * (by - oy) - (ay - oy) * (bx - ox)


@internal_kernel
def convex_hull(points, count, order, hull):
    """Find the counter-clockwise hull of the first ``count`` points (monotone chain); return its number of corners."""
    for i in range(count):
        j = i
        while j > 0 and (
            points[order[j - 1], 0] > points[i, 0]
            or (points[order[j - 1], 0] == points[i, 0] and points[order[j - 1], 1] > points[i, 1])
        ):
            order[j] = order[j - 1]
            j -= 1
        order[j] = i
    size = 0
    for sweep in range(2):
        start = size
        for step in range(count):
            p = order[step] if sweep == 0 else order[count - 1 - step]
            while size >= start + 2:
                a, b = hull[size - 2], hull[size - 1]
                if cross(points[a, 0], points[a, 1], points[b, 0], points[b, 1], points[p, 0], points[p, 1]) > 0.0:
                    break
                size -= 1
            hull[size] = p
            size += 1
        size -= 1  # the last point of a sweep is the first point of the next sweep
    return size


@kernel
def support_polygon(model, chain, grounded, support):
    """Compute the support polygon of the grounded wheels and the signed distances d_i of the centre of mass.

    The robot is statically stable ([T] V.E) as long as all d_i > 0: the projected centre of mass is inside.

    Returns
    -------
    sides : int
        Number of sides; 0 if no polygon exists.
    margin : float
        Smallest d_i [m]; -inf for fewer than three corners.
    """
    mass = 0.0
    for i in range(3):
        support.centre[i] = 0.0
    for k in range(model.link_mass.shape[0]):
        mass += model.link_mass[k]
        for i in range(3):
            support.centre[i] += model.link_mass[k] * chain.link_centre[k, i]
    for i in range(3):
        support.centre[i] /= mass
    count = 0
    for i in range(model.base_joints + 1):
        if grounded[i]:
            for side in (-1.0, 1.0):
                for k in range(2):
                    support.contact[count, k] = (
                        chain.pair_position[i, k] + side * model.half_track[i] * chain.pair_y[i, k]
                    )
                support.owner[count] = i
                count += 1
    sides = convex_hull(support.contact, count, support.order, support.hull) if count >= 3 else 0
    if sides < 3:
        return 0, -math.inf
    margin = math.inf
    gx, gy = support.centre[0], support.centre[1]
    for s in range(sides):
        a = support.contact[support.hull[s]]
        b = support.contact[support.hull[(s + 1) % sides]]
        support.length[s] = math.hypot(b[0] - a[0], b[1] - a[1])
        d = cross(a[0], a[1], b[0], b[1], gx, gy) / support.length[s]
        support.distance[s] = d
        margin = min(margin, d)
    return sides, margin


@kernel
def polygon_area(support, sides):
    """Return the area of the support polygon [m^2]."""
    area = 0.0
    for s in range(sides):
        a, b = support.contact[support.hull[s]], support.contact[support.hull[(s + 1) % sides]]
        area += 0.5 * (a[0] * b[1] - a[1] * b[0])
    return area


@internal_kernel
def centre_slopes(model, chain, support):
    """Compute the derivatives of the projected centre of mass with respect to the joint angles, wheel pair 1 fixed."""
    total = 0.0
    for k in range(model.link_mass.shape[0]):
        total += model.link_mass[k]
    mass, mx, my, mz = 0.0, 0.0, 0.0, 0.0
    for j in range(model.head_joints):  # a head joint moves all links in front of it, in the negative direction
        m, c = model.link_mass[j], chain.link_centre[j]
        mass, mx, my, mz = mass + m, mx + m * c[0], my + m * c[1], mz + m * c[2]
        p, e = chain.joint_position[j], chain.joint_axis[j]
        rx, ry, rz = mx - mass * p[0], my - mass * p[1], mz - mass * p[2]
        support.centre_slope[j, 0] = -(e[1] * rz - e[2] * ry) / total
        support.centre_slope[j, 1] = -(e[2] * rx - e[0] * rz) / total
    mass, mx, my, mz = 0.0, 0.0, 0.0, 0.0
    link = model.link_mass.shape[0]
    for j in range(model.head_joints + model.base_joints - 1, model.head_joints - 1, -1):
        # a base joint moves all links behind it; the link in front of it is added afterwards
        for k in range(2):
            link -= 1
            if k == 1:
                p, e = chain.joint_position[j], chain.joint_axis[j]
                rx, ry, rz = mx - mass * p[0], my - mass * p[1], mz - mass * p[2]
                support.centre_slope[j, 0] = (e[1] * rz - e[2] * ry) / total
                support.centre_slope[j, 1] = (e[2] * rx - e[0] * rz) / total
            m, c = model.link_mass[link], chain.link_centre[link]
            mass, mx, my, mz = mass + m, mx + m * c[0], my + m * c[1], mz + m * c[2]


@internal_kernel
def distance_slope(model, chain, support, side, sides):
    """Compute the derivatives of a distance d_side and of the side's length with respect to joint angles [m/rad].

    The results are in ``support.slope`` and ``support.length_slope``.
    """
    ia, ib = support.hull[side], support.hull[(side + 1) % sides]
    a, b = support.contact[ia], support.contact[ib]
    ex, ey = b[0] - a[0], b[1] - a[1]
    gx, gy = support.centre[0] - a[0], support.centre[1] - a[1]
    length, d = support.length[side], support.distance[side]
    for j in range(model.head_joints + model.base_joints):
        dax, day, dbx, dby = 0.0, 0.0, 0.0, 0.0
        i = j - model.head_joints
        if i >= 0:
            p = chain.joint_position[j]
            if support.owner[ia] > i:
                dax, day = -(a[1] - p[1]), a[0] - p[0]
            if support.owner[ib] > i:
                dbx, dby = -(b[1] - p[1]), b[0] - p[0]
        dgx, dgy = support.centre_slope[j, 0] - dax, support.centre_slope[j, 1] - day
        dex, dey = dbx - dax, dby - day
        numerator = dex * gy + ex * dgy - dey * gx - ey * dgx
        support.length_slope[j] = (ex * dex + ey * dey) / length
        support.slope[j] = (numerator - d * support.length_slope[j]) / length


@internal_kernel
def nearness(support, side, smoothing, margin):
    """Return exp(-(d_side - margin) / s): 1 for the nearest side, near 0 for sides that are several s farther away."""
    return math.exp(-(support.distance[side] - margin) / smoothing)


@kernel
def smooth_margin(support, sides, smoothing, margin):
    """Smooth the smallest distance: margin - s ln sum_i (L_i / L) exp(-(d_i - margin) / s), L = sum of the lengths L_i.

    The gradient of the exact minimum jumps if two sides are equally near, and a robot that follows it would oscillate
    between them. As sides are weighted by their lengths, a side that a new corner of the hull splits has the same
    effect as before.

    Returns
    -------
    distance : float
        Smoothed distance, at least ``margin`` [m].
    total : float
        sum_i L_i exp(...) [m].
    perimeter : float
        L [m].
    """
    total, perimeter = 0.0, 0.0
    for s in range(sides):
        total += support.length[s] * nearness(support, s, smoothing, margin)
        perimeter += support.length[s]
    return margin - smoothing * math.log(total / perimeter), total, perimeter


@kernel
def cost_value(cost, phi, sides, support, margin):
    """Return V of eq 19 or eq 20, with ``sides``, ``support`` and ``margin`` from :func:`support_polygon`."""
    V = 0.0
    for j in range(phi.shape[0]):
        V += cost.diagonal[j] * phi[j] * phi[j]
    if cost.kind == COST_ANGLES:
        return V
    V *= cost.angle_weight
    if cost.kind == COST_SUPPORT_MIN:
        if sides > 0:
            margin = smooth_margin(support, sides, cost.smoothing, margin)[0]
        return V + cost.support_weight / max(margin, cost.distance_floor)
    total = 0.0
    for s in range(sides):
        total += support.distance[s] ** 2
    return V + cost.support_weight / max(math.sqrt(total), cost.distance_floor)


@kernel
def cost_gradient(model, cost, chain, phi, grounded, support, gradient):
    """Write eta = dV/d(phi, rho) ([T] eq 17), shape (n_phi + n_w,), to ``gradient``; the part for wheels is zero."""
    angle_weight = 1.0 if cost.kind == COST_ANGLES else cost.angle_weight
    for j in range(gradient.shape[0]):
        gradient[j] = 2.0 * angle_weight * cost.diagonal[j] * phi[j] if j < phi.shape[0] else 0.0
    if cost.kind == COST_ANGLES:
        return
    sides, margin = support_polygon(model, chain, grounded, support)
    if sides == 0:
        return
    centre_slopes(model, chain, support)
    if cost.kind == COST_SUPPORT_MIN:
        near, total, perimeter = smooth_margin(support, sides, cost.smoothing, margin)
        factor = -cost.support_weight / max(near, cost.distance_floor) ** 2
        for s in range(sides):
            distance_slope(model, chain, support, s, sides)
            share = nearness(support, s, cost.smoothing, margin) / total
            by_distance, by_length = share * support.length[s], cost.smoothing * (1.0 / perimeter - share)
            for j in range(phi.shape[0]):
                gradient[j] += factor * (by_distance * support.slope[j] + by_length * support.length_slope[j])
        return
    total = 0.0
    for s in range(sides):
        total += support.distance[s] ** 2
    norm = max(math.sqrt(total), cost.distance_floor)
    for s in range(sides):
        distance_slope(model, chain, support, s, sides)
        for j in range(phi.shape[0]):
            gradient[j] -= cost.support_weight * support.distance[s] / norm**3 * support.slope[j]
