"""Joints with several rates (ball, rolling base, wheeled base), sines and cosines, and positions of body-fixed points.

Every joint is a sequence of rows with one velocity each. A row is a link of the tree with a motion axis S; all rows of
a joint but the last are massless. The axes of a joint with several rows are fixed in the body that it carries. With
V_J = Σ S_k v_k and the velocity V of that body, d/dt(S_k) = V × S_k, and the bias of the joint is V × V_J = V_P × V_J.
Each row thus has the bias V_P × S_k v_k, where V_P is the velocity of the body on which the *joint* is mounted
(``BASE``), not the velocity of the preceding row. The sweeps need nothing else.

Positions are not integrals of these velocities: q̇ = N(q) v, and a joint may have more positions than velocities. The
first row computes its pose from the coordinates of the whole joint; the other rows copy it.

=====================  ===============================  ==================================================
joint                  coordinates                      rows
=====================  ===============================  ==================================================
ball                   quaternion w, x, y, z            angular velocity about the body's x, y, z
rolling base           x, y, heading in the ground      unit speed along the heading; unit rate of turning
wheeled base           angles of its left and right     rates of the wheels: each moves the centre of the axle by r/2
                       wheel; x, y in the ground        forwards and turns it by r/T, the left wheel to the right
=====================  ===============================  ==================================================

The heading of a wheeled base is (r/T)(right − left): r/T is the parameter of its first row, r/2 of its second.

A free body has three prismatic rows and a ball joint; a planar joint has two prismatic rows and a revolute one.
"""

from __future__ import annotations

import math

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    ZERO_SIX,
    ZERO_VECTOR,
    compose,
    cross_motion,
    first_axis,
    point_velocity,
    put_rotation,
    put_six,
    put_vector,
    rotation,
    second_axis,
    six,
    third_axis,
    times_number,
    transform,
    turn_z,
    vector,
    wrench_at,
)
from dynsim.jit.kernel import internal_kernel, kernel, noinline_kernel

# Sines and cosines of joint angles by range reduction and polynomials, without calls or branches.


TWO_OVER_PI = 2.0 / math.pi
HALF_PI_HIGH, HALF_PI_MIDDLE = 1.57079632673412561417, 6.07710050630396597660e-11
HALF_PI_LOW = 2.02226624879595063154e-21
SIN3, SIN5, SIN7 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
SIN9, SIN11, SIN13 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
COS4, COS6, COS8 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
COS10, COS12, COS14 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@internal_kernel
def sine_cosine_of(q):
    """Return the sine and cosine of one q, within one unit in the last place of libm's results.

    The function contains no calls, which would push all values of a sweep out of their registers, and no branches:
    r = q − k π/2 with π/2 in three parts, then the polynomials of FreeBSD's msun (k_sin.c, k_cos.c) on |r| ≤ π/4.
    Infinite q gives NaN.
    """
    k = np.rint(q * TWO_OVER_PI)
    r = ((q - k * HALF_PI_HIGH) - k * HALF_PI_MIDDLE) - k * HALF_PI_LOW
    z = r * r
    s = r + r * z * (SIN3 + z * (SIN5 + z * (SIN7 + z * (SIN9 + z * (SIN11 + z * SIN13)))))
    c = 1.0 - 0.5 * z + z * z * (COS4 + z * (COS6 + z * (COS8 + z * (COS10 + z * (COS12 + z * COS14)))))
    # k = 4 turns + 2 half + odd; sin and cos of r + k π/2 without a branch.
    odd = k - 2.0 * np.floor(0.5 * k)
    half = 0.5 * (k - odd)
    sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))
    return sign * (s + odd * (c - s)), sign * (c - odd * (c + s))


@internal_kernel
def sine_cosine(joints, trig):
    """Write the sine and cosine of every q to ``trig``, (3, ≥ n), several joints at a time by SIMD."""
    for i in range(joints.shape[0]):
        trig[2, i] = joints[i, ka.Q]
    for i in range(trig.shape[1]):
        trig[0, i], trig[1, i] = sine_cosine_of(trig[2, i])


@internal_kernel
def row_motion(model: ModelArrays, ws: Workspace, i, B, p):
    """Return the pose and motion axis of row i of a joint with several rows.

    Parameters
    ----------
    model : ModelArrays
        Placements, axes and parameters of the joints.
    B, p : tuple
        Rotation and origin of the joint frame at q = 0 in the world; for later rows, the pose of the preceding row.

    Returns
    -------
    tuple
        Rotation and origin of the body, axis as a motion at the world origin.
    """
    kind, joints, trig = model.tree[i, ka.KIND], ws.joints, ws.trig
    # At unit rate: angular velocity s, and velocity l of the body's origin.
    s, l = ZERO_VECTOR, ZERO_VECTOR
    if kind == ka.BALL_X:
        B = compose(B, turned(joints[i, ka.Q], joints[i, ka.EXTRA], joints[i + 1, ka.Q], joints[i + 2, ka.Q]))
        s = first_axis(B)
    elif kind == ka.BALL_Y:
        s = second_axis(B)
    elif kind == ka.BALL_Z or kind == ka.TURN:
        s = third_axis(B)
    elif kind == ka.ROLL:
        p = transform(p, B, (joints[i, ka.Q], joints[i, ka.EXTRA], 0.0))
        B = turn_z(B, trig[0, i + 1], trig[1, i + 1])
        l = first_axis(B)
    elif kind == ka.LEFT_WHEEL:
        rate, ahead = model.body[i, ka.PARAMETER], model.body[i + 1, ka.PARAMETER]
        sine, cosine = sine_cosine_of(rate * (joints[i + 1, ka.Q] - joints[i, ka.Q]))
        p = transform(p, B, (joints[i, ka.EXTRA], joints[i + 1, ka.EXTRA], 0.0))
        B = turn_z(B, sine, cosine)
        s, l = times_number(third_axis(B), -rate), times_number(first_axis(B), ahead)
    elif kind == ka.RIGHT_WHEEL:
        rate, ahead = model.body[i - 1, ka.PARAMETER], model.body[i, ka.PARAMETER]
        s, l = times_number(third_axis(B), rate), times_number(first_axis(B), ahead)
    # As a motion at the world origin: its linear part is l + p × s, as the moment of a wrench.
    moment = wrench_at(p, s, l)
    return B, p, (s[0], s[1], s[2], moment[0], moment[1], moment[2])


@internal_kernel
def turned(w, x, y, z):
    """Return the rotation of a quaternion, which need not have unit length: it drifts between normalisations."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


@internal_kernel
def row_rates(model: ModelArrays, ws: Workspace, i, v, vdot, gx, gy, gz):
    """Return V and A of link i from its axis S, for every kind of joint: V = V_p + S v, A = A_p + V_b × S v + S vdot.

    p is the parent, and b is the body on which the joint is mounted. ``forward_sweep`` inlines this computation for
    joints with one row.
    """
    links, j, m = ws.links, model.tree[i, ka.PARENT], model.tree[i, ka.BASE]
    bias = cross_motion(six(links, m, ka.V), six(links, i, ka.S)) if m >= 0 else ZERO_SIX
    # The acceleration of the world is −g.
    root = (0.0, 0.0, 0.0, -gx, -gy, -gz)
    for s in range(6):
        links[i, ka.V + s] = links[i, ka.S + s] * v + (links[j, ka.V + s] if j >= 0 else 0.0)
        links[i, ka.A + s] = links[i, ka.S + s] * vdot + bias[s] * v + (links[j, ka.A + s] if j >= 0 else root[s])


@noinline_kernel
def sweep_row(model: ModelArrays, ws: Workspace, i, v, vdot, gx, gy, gz):
    """Write R, p, S, V and A of row i to ``ws.links``, as ``forward_sweep`` does for a link.

    ``v``, ``vdot`` and the gravity components already include the factors of the sweep.
    """
    body, links, j = model.body, ws.links, model.tree[i, ka.PARENT]
    B, p = rotation(body, i, ka.R_PJ), vector(body, i, ka.P_PJ)
    if j >= 0:
        A = rotation(links, j, ka.R)
        B, p = compose(A, B), transform(vector(links, j, ka.P), A, p)
    B, p, S = row_motion(model, ws, i, B, p)
    put_rotation(links, i, ka.R, B)
    put_vector(links, i, ka.P, p)
    put_six(links, i, ka.S, S)
    row_rates(model, ws, i, v, vdot, gx, gy, gz)


@kernel
def read_positions(model: ModelArrays, y, start, ws: Workspace):
    """Copy the coordinates of all joints from y[start:] to the workspace."""
    tree, joints = model.tree, ws.joints
    for i in range(tree.shape[0]):
        k = start + tree[i, ka.POSITION_INDEX]
        joints[i, ka.Q] = y[k]
        if tree[i, ka.KIND] == ka.BALL_X or tree[i, ka.KIND] == ka.ROLL:
            joints[i, ka.EXTRA] = y[k + 1]
        elif tree[i, ka.KIND] == ka.LEFT_WHEEL or tree[i, ka.KIND] == ka.RIGHT_WHEEL:
            joints[i, ka.EXTRA] = y[k + 2]


@internal_kernel
def quaternion_rate(w, x, y, z, a, b, c):
    """Return q̇ = ½ q ∘ (0, ω) of q = (w, x, y, z), from the angular velocity ω = (a, b, c) in the body."""
    a, b, c = 0.5 * a, 0.5 * b, 0.5 * c
    return -(x * a + y * b + z * c), w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a


@internal_kernel
def quaternion_turn(w, x, y, z, dw, dx, dy, dz):
    """Return vec(q̄ ∘ δq) of q = (w, x, y, z): half the body rotation that changes the unit quaternion q by δq."""
    return w * dx - x * dw - y * dz + z * dy, w * dy - y * dw - z * dx + x * dz, w * dz - z * dw - x * dy + y * dx


@internal_kernel
def displace(model: ModelArrays, ws: Workspace, y, start):
    """Move the positions y[start:] by the small displacement in the QDD column: velocities that act for a unit time."""
    tree, joints = model.tree, ws.joints
    for i in range(tree.shape[0]):
        k, kind = start + tree[i, ka.POSITION_INDEX], tree[i, ka.KIND]
        if kind == ka.BALL_X:
            w, x, y0, z = y[k], y[k + 1], y[k + 2], y[k + 3]
            change = quaternion_rate(w, x, y0, z, joints[i, ka.QDD], joints[i + 1, ka.QDD], joints[i + 2, ka.QDD])
            for s in range(4):
                y[k + s] += change[s]
        elif kind == ka.ROLL:
            y[k] += joints[i, ka.QDD] * ws.trig[1, i + 1]
            y[k + 1] += joints[i, ka.QDD] * ws.trig[0, i + 1]
        elif kind == ka.LEFT_WHEEL:
            left, right = joints[i, ka.QDD], joints[i + 1, ka.QDD]
            # Use the heading at half the displacement, so that the error is of third order instead of second.
            heading = model.body[i, ka.PARAMETER] * (y[k + 1] - y[k] + 0.5 * (right - left))
            shift = model.body[i + 1, ka.PARAMETER] * (left + right)
            y[k] += left
            y[k + 1] += right
            s, c = sine_cosine_of(heading)
            y[k + 2] += shift * c
            y[k + 3] += shift * s
        elif kind != ka.BALL_Y and kind != ka.BALL_Z and kind != ka.RIGHT_WHEEL:
            y[k] += joints[i, ka.QDD]


@internal_kernel
def normalise(model: ModelArrays, y, start):
    """Scale every quaternion in y[start:] to unit length."""
    tree = model.tree
    for i in range(tree.shape[0]):
        if tree[i, ka.KIND] == ka.BALL_X:
            k = start + tree[i, ka.POSITION_INDEX]
            scale = 1.0 / math.sqrt(y[k] * y[k] + y[k + 1] * y[k + 1] + y[k + 2] * y[k + 2] + y[k + 3] * y[k + 3])
            for s in range(4):
                y[k + s] *= scale


@internal_kernel
def position_error(model: ModelArrays, y, y_new, error, start, rtol, atol):
    """Return the sum of squares of the position errors relative to their tolerances, and the number of errors.

    The error of a quaternion counts as the three angles 2 vec(q̄ ∘ δq) of the rotation that corrects it. Their
    tolerance is atol + rtol [rad], as for a revolute joint one radian from zero.
    """
    tree, total, count = model.tree, 0.0, 0
    for i in range(tree.shape[0]):
        k, kind = start + tree[i, ka.POSITION_INDEX], tree[i, ka.KIND]
        if kind == ka.BALL_X:
            w, x, y0, z = y_new[k], y_new[k + 1], y_new[k + 2], y_new[k + 3]
            dw, dx, dy, dz = error[k], error[k + 1], error[k + 2], error[k + 3]
            scale = 2.0 / ((w * w + x * x + y0 * y0 + z * z) * (atol + rtol))
            ex, ey, ez = quaternion_turn(w, x, y0, z, dw, dx, dy, dz)
            ex, ey, ez = scale * ex, scale * ey, scale * ez
            total += ex * ex + ey * ey + ez * ez
            count += 3
        elif kind != ka.BALL_Y and kind != ka.BALL_Z and kind != ka.RIGHT_WHEEL:
            for s in range(2 if kind == ka.ROLL else 4 if kind == ka.LEFT_WHEEL else 1):
                e = error[k + s] / (atol + rtol * max(abs(y[k + s]), abs(y_new[k + s])))
                total += e * e
                count += 1
    return total, count


@noinline_kernel
def positions_along(model: ModelArrays, y, start, u, out):
    """Add q̇ = N(q) u to out[start:], with positions y[start:] and rates u (n,); both may be complex.

    Ball: ½ q ∘ (0, ω) with ω in the body; rolling: V (cos ψ, sin ψ), ω. Wheels: their own rates, and
    V = (r/2)(left + right) along the heading as for a rolling base.
    """
    tree = model.tree
    for i in range(tree.shape[0]):
        k, kind = start + tree[i, ka.POSITION_INDEX], tree[i, ka.KIND]
        if kind == ka.BALL_X:
            change = quaternion_rate(y[k], y[k + 1], y[k + 2], y[k + 3], u[i], u[i + 1], u[i + 2])
            for s in range(4):
                out[k + s] += change[s]
        elif kind == ka.ROLL:
            s, c = sine_cosine_of(y[start + tree[i + 1, ka.POSITION_INDEX]])
            out[k] += c * u[i]
            out[k + 1] += s * u[i]
        elif kind == ka.LEFT_WHEEL:
            s, c = sine_cosine_of(model.body[i, ka.PARAMETER] * (y[k + 1] - y[k]))
            shift = model.body[i + 1, ka.PARAMETER] * (u[i] + u[i + 1])
            out[k] += u[i]
            out[k + 1] += u[i + 1]
            out[k + 2] += shift * c
            out[k + 3] += shift * s
        elif kind != ka.BALL_Y and kind != ka.BALL_Z and kind != ka.RIGHT_WHEEL:
            out[k] += u[i]


@internal_kernel
def rates_across(model: ModelArrays, y, start, d, out):
    """Write N⁺ d to out, (n,): the rates that change positions by d[start:] as closely as possible; may be complex."""
    tree = model.tree
    for i in range(tree.shape[0]):
        k, kind = start + tree[i, ka.POSITION_INDEX], tree[i, ka.KIND]
        if kind == ka.BALL_X:
            turn = quaternion_turn(y[k], y[k + 1], y[k + 2], y[k + 3], d[k], d[k + 1], d[k + 2], d[k + 3])
            for s in range(3):
                out[i + s] = 2.0 * turn[s]
        elif kind == ka.ROLL:
            s, c = sine_cosine_of(y[start + tree[i + 1, ka.POSITION_INDEX]])
            out[i] = c * d[k] + s * d[k + 1]
        elif kind != ka.BALL_Y and kind != ka.BALL_Z:
            out[i] = d[k]


# Positions and Jacobians of body-fixed points, from the poses left by a forward sweep.


@kernel
def point_position(ws: Workspace, link, point, out):
    """Write the world position p_WB + R_WB point of a body-fixed point to out, (3,) [m], after ``forward_sweep``."""
    if link < 0:
        out[0], out[1], out[2] = point[0], point[1], point[2]
        return
    out[0], out[1], out[2] = transform(vector(ws.links, link, ka.P), rotation(ws.links, link, ka.R), point)


@kernel
def point_jacobian(model: ModelArrays, ws: Workspace, link, position, out):
    """Write the Jacobian of the world velocity of the point at ``position`` on ``link`` to out, (3, n) [m/rad or 1].

    Column j is S_lin + S_ang × position for every joint j between the world and the link, zero elsewhere.
    """
    out[:] = 0.0
    j = link
    while j >= 0:
        out[0, j], out[1, j], out[2, j] = point_velocity(six(ws.links, j, ka.S), position)
        j = model.tree[j, ka.PARENT]
