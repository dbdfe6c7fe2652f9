"""Inverse kinematics along a path: joint positions that reach its targets with brace points on their surfaces."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import distance as kd
from dynsim.dynamics.contact.distance import ShapeArrays, distance
from dynsim.dynamics.contact.rows import quadric_gap
from dynsim.dynamics.linear import factor_symmetric, solve_symmetric
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.joints import point_jacobian, point_position, read_positions
from dynsim.dynamics.tree.sweep import kinematics
from dynsim.jit.kernel import internal_kernel, kernel

ITERATIONS = 200
STEP_MAX = 0.3  # maximum step per iteration [rad or m]; prevents jumps to another branch of solutions


class PathArrays(NamedTuple):
    """Point, joints and braces that follow a path, and scratch: r = 3 + number of braces, c moving joints, n joints."""

    link: int  # link that carries the point
    point: np.ndarray  # (3,) point in the frame of the link [m]
    braces: ContactArrays
    shapes: ShapeArrays | None  # shapes of the braces; None: all are points on quadrics
    column: np.ndarray  # (c,) int, rows of the joints
    place: np.ndarray  # (c,) int, coordinates of the joints
    lower: np.ndarray  # (c,) joint limits along the path [rad or m], infinite if there is no limit
    upper: np.ndarray  # (c,)
    jacobian: np.ndarray  # (3, n)
    rates: np.ndarray  # (r, c)
    system: np.ndarray  # (r, r)
    error: np.ndarray  # (r,)
    change: np.ndarray  # (c,)
    position: np.ndarray  # (3,)


@kernel
def follow_path(
    model: ModelArrays, ws: Workspace, path: PathArrays, targets, base, carried, begin, end, tolerance, q, result
):
    """Compute joint positions for the targets from ``begin`` up to ``end``, and write them to ``result``.

    Damped Gauss–Newton from the previous solution, dq = Jᵀ (J Jᵀ + λ 1)⁻¹ e, where λ falls with the error e. A joint at
    a limit that Jᵀ e would push beyond it is excluded from a step, and a step is clipped at the limits.

    Parameters
    ----------
    targets : (T, 3) ndarray
        Targets of the point [m].
    base, carried : (T, 4) ndarray, int
        Coordinates of a mobile base, and their first index in q; (T, 0) without a base.
    tolerance : float
        Distance from a target at which it counts as reached [m].
    q : (nq,) ndarray
        Previous solution; overwritten with the last one.
    result : (T, c) ndarray
        Joint positions [rad or m]; entries before ``begin`` must be filled already.

    Returns
    -------
    k : int
        Index of the first target that is not reached, or ``end``.
    best : float
        Remaining distance [m].
    """
    moving, rows = path.column.shape[0], path.error.shape[0]
    for k in range(begin, end):
        for e in range(base.shape[1]):
            q[carried + e] = base[k, e]
        if k >= 3 and moving <= rows:
            # Start from the parabola through the last three solutions, which leaves only one iteration. Do not do this
            # for redundant joints, because the motion that the hand does not determine would run away.
            for j in range(moving):
                q[path.place[j]] = 3.0 * result[k - 1, j] - 3.0 * result[k - 2, j] + result[k - 3, j]
        clip_to_limits(path, q)
        best = math.inf
        for _ in range(ITERATIONS):
            left = errors(model, ws, path, targets[k], q)
            best = min(best, left)
            # Iterate far below the tolerance, because the references must be smooth, not just close.
            if left < 1e-4 * tolerance:
                break
            exclude_limited(path, q)
            step(path, 1e-12 + 0.1 * left * left, q)
            clip_to_limits(path, q)
        if not best <= tolerance:
            return k, best
        for j in range(moving):
            result[k, j] = q[path.place[j]]
    return end, 0.0


@internal_kernel
def exclude_limited(path: PathArrays, q):
    """Zero the rates of joints at a limit that a descent step would move beyond it."""
    for j in range(path.column.shape[0]):
        pull = 0.0
        for e in range(path.error.shape[0]):
            pull += path.rates[e, j] * path.error[e]
        at = q[path.place[j]]
        if (at >= path.upper[j] and pull > 0.0) or (at <= path.lower[j] and pull < 0.0):
            for e in range(path.error.shape[0]):
                path.rates[e, j] = 0.0


@internal_kernel
def clip_to_limits(path: PathArrays, q):
    """Move joints that are beyond a limit back to it."""
    for j in range(path.column.shape[0]):
        q[path.place[j]] = max(min(q[path.place[j]], path.upper[j]), path.lower[j])


@internal_kernel
def errors(model: ModelArrays, ws: Workspace, path: PathArrays, target, q):
    """Compute the distances from the target and surfaces, with derivatives; return the norm of the distances [m]."""
    read_positions(model, q, 0, ws)
    for j in range(ws.joints.shape[0]):
        ws.joints[j, ka.QD] = 0.0
    kinematics(model, ws)
    position, jacobian, error = path.position, path.jacobian, path.error
    point_position(ws, path.link, path.point, position)
    point_jacobian(model, ws, path.link, position, jacobian)
    for e in range(3):
        error[e] = target[e] - position[e]
        for j in range(path.column.shape[0]):
            path.rates[e, j] = jacobian[e, path.column[j]]
    for b in range(path.braces.link.shape[0]):
        link = path.braces.link[b, ka.LINK]
        point_position(ws, link, path.braces.point[b, ka.POINT : ka.POINT + 3], position)
        gap, nx, ny, nz = gap_and_normal(path.shapes, path.braces, b, position[0], position[1], position[2])
        point_jacobian(model, ws, link, position, jacobian)
        error[3 + b] = -gap
        for j in range(path.column.shape[0]):
            i = path.column[j]
            path.rates[3 + b, j] = nx * jacobian[0, i] + ny * jacobian[1, i] + nz * jacobian[2, i]
    square = 0.0
    for e in range(error.shape[0]):
        square += error[e] * error[e]
    return math.sqrt(square)


@internal_kernel
def gap_and_normal(shapes: ShapeArrays | None, braces: ContactArrays, b, x, y, z):
    """Return the distance of brace b, at a point in W, from its surface [m], and the normal there (3 numbers)."""
    if shapes is not None:  # noqa: SIM102 (resolved at compile time)
        if shapes.kind[b, kd.SURFACE] != kd.AS_POINT:
            centre = distance(shapes, b, x, y, z)
            return centre[0] - shapes.data[b, kd.RADIUS], centre[1], centre[2], centre[3]
    gap, n, _ = quadric_gap(braces.point, b, braces.link[b, ka.CURVED] != 0, (x, y, z))
    return gap, n[0], n[1], n[2]


@internal_kernel
def step(path: PathArrays, damping, q):
    """Take the damped step: (J Jᵀ + λ 1) y = e, dq = Jᵀ y, each entry limited to ``STEP_MAX``."""
    rates, system, y, change = path.rates, path.system, path.error, path.change
    rows, moving = rates.shape
    for a in range(rows):
        for b in range(a + 1):
            total = damping if a == b else 0.0
            for j in range(moving):
                total += rates[a, j] * rates[b, j]
            system[a, b] = total
    factor_symmetric(system, rows, rows)
    solve_symmetric(system, y, rows)
    longest = 0.0
    for j in range(moving):
        change[j] = 0.0
        for a in range(rows):
            change[j] += rates[a, j] * y[a]
        longest = max(longest, abs(change[j]))
    scale = min(1.0, STEP_MAX / max(longest, 1e-300))
    for j in range(moving):
        q[path.place[j]] += scale * change[j]
