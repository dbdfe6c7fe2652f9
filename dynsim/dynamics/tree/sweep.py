"""Recursive Newton–Euler sweeps: kinematics, inverse dynamics, bias forces, and the mass matrix."""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.joints import sine_cosine, sweep_row
from dynsim.dynamics.tree.spatial import (
    compose,
    cross,
    first_axis,
    plus,
    point_acceleration,
    put_rotation,
    put_six,
    put_vector,
    rotate,
    rotation,
    scaled,
    second_axis,
    six,
    third_axis,
    times_inertia,
    transform,
    turn,
    turn_x,
    turn_y,
    turn_z,
    vector,
)
from dynsim.jit.kernel import internal_kernel, kernel


@internal_kernel
def forward_sweep(model: ModelArrays, ws: Workspace, velocity, acceleration, gravity):
    """Compute the pose, axis, velocity and acceleration of every link, from root to tips ([WM] eqs 36–41).

    X_WB = X_WP X_PJ X_J(q). A revolute axis a through p has S = (a, p × a), and a prismatic axis a has S = (0, a).
    V = V_p + S v and A = A_p + V_p × S v + S vdot with A_world = −gravity, so that every inertial wrench includes the
    weight.

    Parameters
    ----------
    velocity, acceleration, gravity : float
        Factors of v, vdot (both from ``ws.joints``) and gravity: (1, 0, 1) gives the bias forces ([WM] eq 54),
        (0, 1, 0) the product M vdot ([WM] eq 55), (1, 1, 1) the inverse dynamics.
    """
    tree, body, links, joints, trig = model.tree, model.body, ws.links, ws.joints, ws.trig
    sine_cosine(joints, trig)
    gx, gy, gz = gravity * model.gravity[0], gravity * model.gravity[1], gravity * model.gravity[2]
    for i in range(tree.shape[0]):
        j = tree[i, ka.PARENT]
        qi, vi, ai = joints[i, ka.Q], velocity * joints[i, ka.QD], acceleration * joints[i, ka.QDD]
        # The joint frame at q = 0 has the rotation B = R_WP R_PJ and the origin p.
        B, p = rotation(body, i, ka.R_PJ), vector(body, i, ka.P_PJ)
        if j >= 0:
            A = rotation(links, j, ka.R)
            p = transform(vector(links, j, ka.P), A, p)
            B = A if tree[i, ka.TURNED] == 0 else compose(A, B)
        # Joint motion.
        k = tree[i, ka.KIND]
        if k == ka.PRISMATIC:
            z = rotate(B, vector(body, i, ka.AXIS))
            p = p[0] + z[0] * qi, p[1] + z[1] * qi, p[2] + z[2] * qi
            S = 0.0, 0.0, 0.0, z[0], z[1], z[2]
        else:
            s, c = trig[0, i], trig[1, i]
            if k == ka.REVOLUTE:
                u = vector(body, i, ka.AXIS)
                z = rotate(B, u)
                B = turn(B, u, z, s, c)
            elif k == ka.REVOLUTE_X:
                z = first_axis(B)
                B = turn_x(B, s, c)
            elif k == ka.REVOLUTE_Y:
                z = second_axis(B)
                B = turn_y(B, s, c)
            else:
                z = third_axis(B)
                B = turn_z(B, s, c)
            m = cross(p, z)
            S = z[0], z[1], z[2], m[0], m[1], m[2]
        put_rotation(links, i, ka.R, B)
        put_vector(links, i, ka.P, p)
        put_six(links, i, ka.S, S)
        # Velocity and acceleration; V × S v = V_p × S v, because S × S = 0.
        J = scaled(S, vi)
        if j >= 0:
            V, A_p = six(links, j, ka.V), six(links, j, ka.A)
            put_six(links, i, ka.A, (
                A_p[0] + V[1] * J[2] - V[2] * J[1] + S[0] * ai,
                A_p[1] + V[2] * J[0] - V[0] * J[2] + S[1] * ai,
                A_p[2] + V[0] * J[1] - V[1] * J[0] + S[2] * ai,
                A_p[3] + V[1] * J[5] - V[2] * J[4] + V[4] * J[2] - V[5] * J[1] + S[3] * ai,
                A_p[4] + V[2] * J[3] - V[0] * J[5] + V[5] * J[0] - V[3] * J[2] + S[4] * ai,
                A_p[5] + V[0] * J[4] - V[1] * J[3] + V[3] * J[1] - V[4] * J[0] + S[5] * ai,
            ))  # fmt: skip
            put_six(links, i, ka.V, plus(V, J))
        else:
            put_six(links, i, ka.V, J)
            put_six(links, i, ka.A, (S[0] * ai, S[1] * ai, S[2] * ai, S[3] * ai - gx, S[4] * ai - gy, S[5] * ai - gz))
        if k > ka.PRISMATIC:
            # This is a separate function, so that the other values stay in registers.
            sweep_row(model, ws, i, vi, ai, gx, gy, gz)


@internal_kernel
def body_inertia(model: ModelArrays, ws: Workspace, i):
    """Return mass, centre of mass c in W, and inertia I_c about it in W axes (xx xy xz yy yz zz), after a sweep."""
    body, R = model.body, rotation(ws.links, i, ka.R)
    I_b = six(body, i, ka.INERTIA)
    t0, t1, t2 = times_inertia(I_b, (R[0], R[1], R[2]))
    t3, t4, t5 = times_inertia(I_b, (R[3], R[4], R[5]))
    t6, t7, t8 = times_inertia(I_b, (R[6], R[7], R[8]))
    inertia = (
        t0 * R[0] + t1 * R[1] + t2 * R[2],
        t0 * R[3] + t1 * R[4] + t2 * R[5],
        t0 * R[6] + t1 * R[7] + t2 * R[8],
        t3 * R[3] + t4 * R[4] + t5 * R[5],
        t3 * R[6] + t4 * R[7] + t5 * R[8],
        t6 * R[6] + t7 * R[7] + t8 * R[8],
    )
    return body[i, ka.MASS], transform(vector(ws.links, i, ka.P), R, vector(body, i, ka.COM)), inertia


@internal_kernel
def inertial_wrench(ws: Workspace, i, m, c, I):
    """Return the inertial wrench of body i about the world origin: (I_c α + ω × I_c ω + c × m a_c, m a_c)."""
    w, A = vector(ws.links, i, ka.V), six(ws.links, i, ka.A)
    a = point_acceleration(A, six(ws.links, i, ka.V), c)
    fx, fy, fz = m * a[0], m * a[1], m * a[2]
    L = times_inertia(I, w)
    return (
        I[0] * A[0] + I[1] * A[1] + I[2] * A[2] + w[1] * L[2] - w[2] * L[1] + c[1] * fz - c[2] * fy,
        I[1] * A[0] + I[3] * A[1] + I[4] * A[2] + w[2] * L[0] - w[0] * L[2] + c[2] * fx - c[0] * fz,
        I[2] * A[0] + I[4] * A[1] + I[5] * A[2] + w[0] * L[1] - w[1] * L[0] + c[0] * fy - c[1] * fx,
        fx,
        fy,
        fz,
    )


@kernel
def kinematics(model: ModelArrays, ws: Workspace):
    """Compute poses, axes and velocities of all links from q and v in ``ws.joints``, with vdot = 0."""
    forward_sweep(model, ws, 1.0, 0.0, 1.0)


@kernel
def newton_euler(model: ModelArrays, ws: Workspace, velocity, acceleration, gravity):
    """Write tau = M vdot + h + g to the BIAS column of ``ws.joints`` [N m or N] ([WM] eqs 42–44, 52).

    After a forward sweep, a sweep from the tips to the root computes F_i += Σ_children F and tau_i = S·F_i. For the
    factors, see :func:`forward_sweep`. Reflected motor inertia and joint losses are not in tau.
    """
    forward_sweep(model, ws, velocity, acceleration, gravity)
    tree, links, joints = model.tree, ws.links, ws.joints
    for i in range(tree.shape[0]):
        m, c, I = body_inertia(model, ws, i)
        put_six(links, i, ka.F, inertial_wrench(ws, i, m, c, I))
    for i in range(tree.shape[0] - 1, -1, -1):
        tau = 0.0
        j = tree[i, ka.PARENT]
        for s in range(6):
            tau += links[i, ka.S + s] * links[i, ka.F + s]
            if j >= 0:
                links[j, ka.F + s] += links[i, ka.F + s]
        joints[i, ka.BIAS] = tau


@kernel
def mass_matrix(model: ModelArrays, ws: Workspace, M):
    """Write M(q) to M, (n or more, n or more), column by column as p(q, 0, e_i, 0) ([WM] eq 55).

    Overwrites V, A, F, vdot and bias of the workspace. Reflected motor inertia is not added.
    """
    n, joints = model.tree.shape[0], ws.joints
    for i in range(n):
        joints[i, ka.QDD] = 0.0
    for i in range(n):
        joints[i, ka.QDD] = 1.0
        newton_euler(model, ws, 0.0, 1.0, 0.0)
        joints[i, ka.QDD] = 0.0
        for j in range(n):
            M[j, i] = joints[j, ka.BIAS]
