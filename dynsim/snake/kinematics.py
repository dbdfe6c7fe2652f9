"""Kinematics and velocity constraints of an articulated mobile robot with a raised head ([T] section III.A).

Source [T]: M. Tanaka, K. Tadakuma, M. Nakajima, M. Fujita, "Task-Space Control of Articulated Mobile Robots With a
Soft Gripper for Operations", IEEE Transactions on Robotics 35(1), 2019.

The chain is traversed from the controlled point E to the tail: E, head point, theta_1, psi_1, ..., theta_(n_h/2),
psi_(n_h/2) (wheel pair 1), then theta, wheel pair 2, theta, wheel pair 3, ... to the tail axle. Neighbours are one
link length apart; E and the head point are ``point_offset`` apart. The body behind a joint is rotated by Rz(theta) or
Ry(psi) relative to the body in front of it, so psi > 0 raises the head. Pitch joints of the base part only lift wheels
([T] II.A) and are zero here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import internal_kernel, kernel


class SnakeModel(NamedTuple):
    """Parameters of a robot for the kernels: lengths [m], angles [rad], masses [kg].

    The robot has n_phi = head_joints + base_joints joints, base_joints + 1 wheel pairs and head_joints + 2 base_joints
    links.
    """

    head_joints: int  # n_h, even, because yaw and pitch joints alternate
    base_joints: int  # n_b, all of them yaw joints
    wheels: int  # n_w, active wheels of the base part
    link_length: float
    wheel_radius: float
    point_offset: float  # distance of the controlled point ahead of the head point: 0, or the length of the gripper
    pitch: np.ndarray  # (n_phi,) 1 for pitch joints
    lower: np.ndarray  # (n_phi,) joint limits
    upper: np.ndarray  # (n_phi,)
    half_track: np.ndarray  # (n_b + 1,)
    wheel: np.ndarray  # (n_b + 1,) index of the pair's active wheel, -1 for passive pairs
    side: np.ndarray  # (n_b + 1,) +1: active wheel on the left (along +Y of the pair), -1: on the right
    link_mass: np.ndarray  # (n_h + 2 n_b,)


class Chain(NamedTuple):
    """Frames of one posture in world coordinates, written by :func:`walk_chain`."""

    rate_axis: np.ndarray  # (3, 3) row k: angular velocity of the head per unit rate of alpha, beta, gamma
    joint_position: np.ndarray  # (n_phi, 3)
    joint_axis: np.ndarray  # (n_phi, 3)
    pair_position: np.ndarray  # (n_b + 1, 3) middle of the axle
    pair_x: np.ndarray  # (n_b + 1, 3) rolling direction
    pair_y: np.ndarray  # (n_b + 1, 3) axle direction, to the left
    pair_z: np.ndarray  # (n_b + 1, 3)
    link_centre: np.ndarray  # (n_h + 2 n_b, 3)


def zero_arrays(kind, sizes, **others):
    """Return a named tuple of zero arrays with these sizes by field; ``others`` are its other fields."""
    return kind(**{name: np.zeros(size) for name, size in sizes.items()}, **others)


def new_chain(model: SnakeModel) -> Chain:
    """Allocate the workspace of :func:`walk_chain`."""
    joints, pairs = model.head_joints + model.base_joints, model.base_joints + 1
    rows = {"rate_axis": 3, "link_centre": model.head_joints + 2 * model.base_joints}
    rows |= dict.fromkeys(("joint_position", "joint_axis"), joints)
    rows |= dict.fromkeys(("pair_position", "pair_x", "pair_y", "pair_z"), pairs)
    return zero_arrays(Chain, {name: (count, 3) for name, count in rows.items()})


@internal_kernel
def wrap_angle(angle):
    """Return the angle wrapped to [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@internal_kernel
def turn(axis_is_pitch, angle, R):
    """Compute R := R Ry(angle) or R Rz(angle) in place; the rows of R, (3, 3), are the frame axes in the world."""
    c, s = math.cos(angle), math.sin(angle)
    for i in range(3):
        x = R[0, i]
        if axis_is_pitch:
            z = R[2, i]
            R[0, i] = c * x - s * z
            R[2, i] = s * x + c * z
        else:
            y = R[1, i]
            R[0, i] = c * x + s * y
            R[1, i] = c * y - s * x


@internal_kernel
def head_frame(w, R):
    """Write the frame axes of Rz(gamma) Ry(beta) Rx(alpha) to the rows of R; w = (x, y, z, alpha, beta, gamma)."""
    ca, sa = math.cos(w[3]), math.sin(w[3])
    cb, sb = math.cos(w[4]), math.sin(w[4])
    cg, sg = math.cos(w[5]), math.sin(w[5])
    R[0, 0], R[0, 1], R[0, 2] = cg * cb, sg * cb, -sb
    R[1, 0], R[1, 1], R[1, 2] = cg * sb * sa - sg * ca, sg * sb * sa + cg * ca, cb * sa
    R[2, 0], R[2, 1], R[2, 2] = cg * sb * ca + sg * sa, sg * sb * ca - cg * sa, cb * ca


@kernel
def pose_of_point(model, base, phi, R, w):
    """Compute the pose w of the controlled point if the base part is level on its wheels.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    base : (3,) ndarray
        x, y [m] and yaw [rad] of wheel pair 1.
    phi : (n_phi,) ndarray
        Joint angles [rad].
    R : (3, 3) ndarray
        Workspace.
    w : (6,) ndarray
        Output: x, y, z [m], alpha, beta, gamma [rad] of R = Rz(gamma) Ry(beta) Rx(alpha).
    """
    R[0, 0], R[0, 1], R[0, 2] = math.cos(base[2]), math.sin(base[2]), 0.0
    R[1, 0], R[1, 1], R[1, 2] = -R[0, 1], R[0, 0], 0.0
    R[2, 0], R[2, 1], R[2, 2] = 0.0, 0.0, 1.0
    w[0], w[1], w[2] = base[0], base[1], model.wheel_radius
    for j in range(model.head_joints - 1, -1, -1):
        turn(model.pitch[j], -phi[j], R)
        for i in range(3):
            w[i] += model.link_length * R[0, i]
    for i in range(3):
        w[i] += model.point_offset * R[0, i]
    w[3] = math.atan2(R[1, 2], R[2, 2])
    w[4] = math.atan2(-R[0, 2], math.sqrt(R[0, 0] * R[0, 0] + R[0, 1] * R[0, 1]))
    w[5] = math.atan2(R[0, 1], R[0, 0])


@kernel
def walk_chain(model, w, phi, R, chain):
    """Compute positions and axes of joints, wheel pairs and links for any pose w and joint angles phi, level or not."""
    half = 0.5 * model.link_length
    head_frame(w, R)
    cb, sb = math.cos(w[4]), math.sin(w[4])
    cg, sg = math.cos(w[5]), math.sin(w[5])
    # omega = (Rz Ry e_x) alpha' + (Rz e_y) beta' + e_z gamma'
    axis = chain.rate_axis
    axis[0, 0], axis[0, 1], axis[0, 2] = cg * cb, sg * cb, -sb
    axis[1, 0], axis[1, 1], axis[1, 2] = -sg, cg, 0.0
    axis[2, 0], axis[2, 1], axis[2, 2] = 0.0, 0.0, 1.0

    x = w[0] - model.point_offset * R[0, 0]
    y = w[1] - model.point_offset * R[0, 1]
    z = w[2] - model.point_offset * R[0, 2]
    link = 0
    for j in range(model.head_joints + model.base_joints):
        in_base = j >= model.head_joints
        for part in range(2 if in_base else 1):
            centre = chain.link_centre[link]
            centre[0], centre[1], centre[2] = x - half * R[0, 0], y - half * R[0, 1], z - half * R[0, 2]
            x, y, z = x - 2 * half * R[0, 0], y - 2 * half * R[0, 1], z - 2 * half * R[0, 2]
            link += 1
            if part == 0:
                p, e, row = chain.joint_position[j], chain.joint_axis[j], 1 if model.pitch[j] else 2
                p[0], p[1], p[2] = x, y, z
                e[0], e[1], e[2] = R[row, 0], R[row, 1], R[row, 2]
                turn(model.pitch[j], phi[j], R)
        pair = j - model.head_joints + 1
        if pair >= 0:
            chain.pair_position[pair, 0] = x
            chain.pair_position[pair, 1] = y
            chain.pair_position[pair, 2] = z
            for i in range(3):
                chain.pair_x[pair, i] = R[0, i]
                chain.pair_y[pair, i] = R[1, i]
                chain.pair_z[pair, i] = R[2, i]


@internal_kernel
def velocity_row(model, chain, w, pair, a, A, B, row):
    """Write the row a . v_pair = A w' - B u for the velocity of an axle's midpoint along the direction a."""
    p = chain.pair_position[pair]
    ax, ay, az = a[0], a[1], a[2]
    dx, dy, dz = p[0] - w[0], p[1] - w[1], p[2] - w[2]
    A[row, 0], A[row, 1], A[row, 2] = ax, ay, az
    # a . (omega x d) = omega . (d x a)
    mx, my, mz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
    for k in range(3):
        e = chain.rate_axis[k]
        A[row, 3 + k] = e[0] * mx + e[1] * my + e[2] * mz
    for j in range(B.shape[1]):
        B[row, j] = 0.0
    for j in range(model.head_joints + pair):
        q, e = chain.joint_position[j], chain.joint_axis[j]
        dx, dy, dz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
        mx, my, mz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        B[row, j] = -(e[0] * mx + e[1] * my + e[2] * mz)


@internal_kernel
def add_rotation(model, chain, pair, factor, a, A, B, row):
    """Add factor times a . omega_pair = A w' - B u, with the angular velocity of a wheel pair's body, to a row."""
    ax, ay, az = factor * a[0], factor * a[1], factor * a[2]
    for k in range(3):
        e = chain.rate_axis[k]
        A[row, 3 + k] += ax * e[0] + ay * e[1] + az * e[2]
    for j in range(model.head_joints + pair):
        e = chain.joint_axis[j]
        B[row, j] -= ax * e[0] + ay * e[1] + az * e[2]


@kernel
def constraint_matrices(model, chain, w, A, B):
    """Compute A(q) and B(q) of A w' = B u with all wheels on the ground, u = (phi', rho') ([T] eqs 2-6).

    The rows are: n_b + 1 rows for no side slip, Y_i . v_i = 0; three rows for ground contact, e_z . v_1 = 0 and
    X_1 . omega_tail = Y_1 . omega_tail = 0; n_w rows for rolling active wheels,
    X_i . v_i - side_i b_i (Z_i . omega_i) = r rho_i'.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    chain : Chain
        Frames of the posture, from :func:`walk_chain`.
    w : (6,) ndarray
        Pose of the controlled point [m, rad].
    A : (n_b + 4 + n_w, 6) ndarray
        Output.
    B : (n_b + 4 + n_w, n_phi + n_w) ndarray
        Output.
    """
    pairs = model.base_joints + 1
    joints = model.head_joints + model.base_joints
    for i in range(pairs):
        velocity_row(model, chain, w, i, chain.pair_y[i], A, B, i)
    first = pairs - pairs  # use a variable instead of the literal 0, so that only one signature is compiled
    velocity_row(model, chain, w, first, chain.rate_axis[2], A, B, pairs)  # rate axis of gamma: e_z
    for row in range(pairs + 1, pairs + 3):
        a = chain.pair_x[0] if row == pairs + 1 else chain.pair_y[0]
        for k in range(6):
            A[row, k] = 0.0
        for j in range(B.shape[1]):
            B[row, j] = 0.0
        add_rotation(model, chain, pairs - 1, 1.0, a, A, B, row)
    for i in range(pairs):
        if model.wheel[i] >= 0:
            row = pairs + 3 + model.wheel[i]
            velocity_row(model, chain, w, i, chain.pair_x[i], A, B, row)
            add_rotation(model, chain, i, -model.side[i] * model.half_track[i], chain.pair_z[i], A, B, row)
            B[row, joints + model.wheel[i]] = model.wheel_radius


@kernel
def active_rows(model, grounded, rows):
    """Find the rows of A and B that are active in a mode ([T] eqs 7, 8); both rows of a lifted pair are removed.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    grounded : (n_b + 1,) ndarray
        1 for pairs on the ground.
    rows : (n_b + 4 + n_w,) ndarray
        Output: row indices; entries beyond the returned count are undefined.

    Returns
    -------
    int
        Number of active rows.
    """
    pairs = model.base_joints + 1
    count = 0
    for i in range(pairs):
        if grounded[i]:
            rows[count] = i
            count += 1
    for i in range(3):
        rows[count] = pairs + i
        count += 1
    for i in range(pairs):
        if grounded[i] and model.wheel[i] >= 0:
            rows[count] = pairs + 3 + model.wheel[i]
            count += 1
    return count


@kernel
def posture_points(model, bases, phis, R, chain, w, points):
    """Compute the polyline of the robot for many states: controlled point, head joints, base joints and axles.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    bases : (T, 3) ndarray
        x, y [m] and yaw [rad] of wheel pair 1.
    phis : (T, n_phi) ndarray
        Joint angles [rad].
    R, chain, w
        Workspaces.
    points : (T, 1 + n_h + 2 n_b, 3) ndarray
        Output [m]; entry n_h is wheel pair 1, every second entry after it is the next pair.
    """
    for t in range(bases.shape[0]):
        pose_of_point(model, bases[t], phis[t], R, w)
        walk_chain(model, w, phis[t], R, chain)
        for i in range(3):
            points[t, 0, i] = w[i]
            for j in range(model.head_joints):
                points[t, 1 + j, i] = chain.joint_position[j, i]
            for j in range(model.base_joints):
                k = 1 + model.head_joints + 2 * j
                points[t, k, i] = chain.joint_position[model.head_joints + j, i]
                points[t, k + 1, i] = chain.pair_position[j + 1, i]
