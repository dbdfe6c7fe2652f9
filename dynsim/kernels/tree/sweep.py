"""Recursive Newton–Euler: kinematics, inverse dynamics, bias forces, and the mass matrix by unit accelerations."""

from __future__ import annotations

from dynsim.kernels.arrays import (
    AXIS,
    BIAS,
    COM,
    INERTIA,
    KIND,
    MASS,
    P_PJ,
    PARENT,
    PRISMATIC,
    QD,
    QDD,
    R_PJ,
    REVOLUTE,
    REVOLUTE_X,
    REVOLUTE_Y,
    TURNED,
    A,
    F,
    ModelArrays,
    P,
    Q,
    R,
    S,
    V,
    Workspace,
)
from dynsim.kernels.jit import internal_kernel, kernel
from dynsim.kernels.tree.angles import sine_cosine
from dynsim.kernels.tree.joints import sweep_row


@internal_kernel
def forward_sweep(model: ModelArrays, ws: Workspace, velocity, acceleration, gravity):
    """Root to tips: pose, axis, velocity and acceleration of every link ([WM] eqs 36–41).

    X_WB = X_WP X_PJ X_J(q). A revolute axis a through p is S = (a, p × a), a prismatic one S = (0, a).
    V = V_p + S v and A = A_p + V_p × S v + S vdot with A_world = −gravity, so that every inertial wrench holds the
    weight.

    Parameters
    ----------
    velocity, acceleration, gravity : float
        Factors on v, vdot (both from ``ws.joints``) and gravity: (1, 0, 1) gives the bias forces ([WM] eq 54),
        (0, 1, 0) the product M vdot ([WM] eq 55), (1, 1, 1) the inverse dynamics.
    """
    tree, body, links, joints, trig = model.tree, model.body, ws.links, ws.joints, ws.trig
    sine_cosine(joints, trig)
    gx, gy, gz = gravity * model.gravity[0], gravity * model.gravity[1], gravity * model.gravity[2]
    for i in range(tree.shape[0]):
        j = tree[i, PARENT]
        qi, vi, ai = joints[i, Q], velocity * joints[i, QD], acceleration * joints[i, QDD]
        # Joint frame at q = 0: B = R_WP R_PJ, origin p.
        b0, b1, b2 = body[i, R_PJ], body[i, R_PJ + 1], body[i, R_PJ + 2]
        b3, b4, b5 = body[i, R_PJ + 3], body[i, R_PJ + 4], body[i, R_PJ + 5]
        b6, b7, b8 = body[i, R_PJ + 6], body[i, R_PJ + 7], body[i, R_PJ + 8]
        px, py, pz = body[i, P_PJ], body[i, P_PJ + 1], body[i, P_PJ + 2]
        if j >= 0:
            a0, a1, a2 = links[j, R], links[j, R + 1], links[j, R + 2]
            a3, a4, a5 = links[j, R + 3], links[j, R + 4], links[j, R + 5]
            a6, a7, a8 = links[j, R + 6], links[j, R + 7], links[j, R + 8]
            px, py, pz = (
                links[j, P] + a0 * px + a1 * py + a2 * pz,
                links[j, P + 1] + a3 * px + a4 * py + a5 * pz,
                links[j, P + 2] + a6 * px + a7 * py + a8 * pz,
            )
            if tree[i, TURNED] == 0:
                b0, b1, b2, b3, b4, b5, b6, b7, b8 = a0, a1, a2, a3, a4, a5, a6, a7, a8
            else:
                b0, b1, b2, b3, b4, b5, b6, b7, b8 = (
                    a0 * b0 + a1 * b3 + a2 * b6,
                    a0 * b1 + a1 * b4 + a2 * b7,
                    a0 * b2 + a1 * b5 + a2 * b8,
                    a3 * b0 + a4 * b3 + a5 * b6,
                    a3 * b1 + a4 * b4 + a5 * b7,
                    a3 * b2 + a4 * b5 + a5 * b8,
                    a6 * b0 + a7 * b3 + a8 * b6,
                    a6 * b1 + a7 * b4 + a8 * b7,
                    a6 * b2 + a7 * b5 + a8 * b8,
                )
        # Joint motion.
        k = tree[i, KIND]
        if k == PRISMATIC:
            ux, uy, uz = body[i, AXIS], body[i, AXIS + 1], body[i, AXIS + 2]
            zx = b0 * ux + b1 * uy + b2 * uz
            zy = b3 * ux + b4 * uy + b5 * uz
            zz = b6 * ux + b7 * uy + b8 * uz
            px += zx * qi
            py += zy * qi
            pz += zz * qi
            sx, sy, sz, lx, ly, lz = 0.0, 0.0, 0.0, zx, zy, zz
        else:
            s, c = trig[0, i], trig[1, i]
            if k == REVOLUTE:
                # Rodrigues: B R(u, q) = c B + s B [u]x + (1 - c) (B u) uᵀ
                ux, uy, uz = body[i, AXIS], body[i, AXIS + 1], body[i, AXIS + 2]
                zx = b0 * ux + b1 * uy + b2 * uz
                zy = b3 * ux + b4 * uy + b5 * uz
                zz = b6 * ux + b7 * uy + b8 * uz
                d = 1.0 - c
                b0, b1, b2 = (
                    c * b0 + s * (b1 * uz - b2 * uy) + d * zx * ux,
                    c * b1 + s * (b2 * ux - b0 * uz) + d * zx * uy,
                    c * b2 + s * (b0 * uy - b1 * ux) + d * zx * uz,
                )
                b3, b4, b5 = (
                    c * b3 + s * (b4 * uz - b5 * uy) + d * zy * ux,
                    c * b4 + s * (b5 * ux - b3 * uz) + d * zy * uy,
                    c * b5 + s * (b3 * uy - b4 * ux) + d * zy * uz,
                )
                b6, b7, b8 = (
                    c * b6 + s * (b7 * uz - b8 * uy) + d * zz * ux,
                    c * b7 + s * (b8 * ux - b6 * uz) + d * zz * uy,
                    c * b8 + s * (b6 * uy - b7 * ux) + d * zz * uz,
                )
            elif k == REVOLUTE_X:
                zx, zy, zz = b0, b3, b6
                b1, b2 = c * b1 + s * b2, c * b2 - s * b1
                b4, b5 = c * b4 + s * b5, c * b5 - s * b4
                b7, b8 = c * b7 + s * b8, c * b8 - s * b7
            elif k == REVOLUTE_Y:
                zx, zy, zz = b1, b4, b7
                b0, b2 = c * b0 - s * b2, c * b2 + s * b0
                b3, b5 = c * b3 - s * b5, c * b5 + s * b3
                b6, b8 = c * b6 - s * b8, c * b8 + s * b6
            else:
                zx, zy, zz = b2, b5, b8
                b0, b1 = c * b0 + s * b1, c * b1 - s * b0
                b3, b4 = c * b3 + s * b4, c * b4 - s * b3
                b6, b7 = c * b6 + s * b7, c * b7 - s * b6
            sx, sy, sz = zx, zy, zz
            lx, ly, lz = py * zz - pz * zy, pz * zx - px * zz, px * zy - py * zx
        links[i, R], links[i, R + 1], links[i, R + 2] = b0, b1, b2
        links[i, R + 3], links[i, R + 4], links[i, R + 5] = b3, b4, b5
        links[i, R + 6], links[i, R + 7], links[i, R + 8] = b6, b7, b8
        links[i, P], links[i, P + 1], links[i, P + 2] = px, py, pz
        # Velocity and acceleration; V × S v = V_p × S v, because S × S = 0.
        links[i, S], links[i, S + 1], links[i, S + 2] = sx, sy, sz
        links[i, S + 3], links[i, S + 4], links[i, S + 5] = lx, ly, lz
        jwx, jwy, jwz, jvx, jvy, jvz = sx * vi, sy * vi, sz * vi, lx * vi, ly * vi, lz * vi
        if j >= 0:
            wx, wy, wz, ox, oy, oz = (
                links[j, V],
                links[j, V + 1],
                links[j, V + 2],
                links[j, V + 3],
                links[j, V + 4],
                links[j, V + 5],
            )
            ex = links[j, A] + wy * jwz - wz * jwy + sx * ai
            ey = links[j, A + 1] + wz * jwx - wx * jwz + sy * ai
            ez = links[j, A + 2] + wx * jwy - wy * jwx + sz * ai
            fx = links[j, A + 3] + wy * jvz - wz * jvy + oy * jwz - oz * jwy + lx * ai
            fy = links[j, A + 4] + wz * jvx - wx * jvz + oz * jwx - ox * jwz + ly * ai
            fz = links[j, A + 5] + wx * jvy - wy * jvx + ox * jwy - oy * jwx + lz * ai
            wx, wy, wz, ox, oy, oz = wx + jwx, wy + jwy, wz + jwz, ox + jvx, oy + jvy, oz + jvz
        else:
            wx, wy, wz, ox, oy, oz = jwx, jwy, jwz, jvx, jvy, jvz
            ex, ey, ez = sx * ai, sy * ai, sz * ai
            fx, fy, fz = lx * ai - gx, ly * ai - gy, lz * ai - gz
        links[i, V], links[i, V + 1], links[i, V + 2], links[i, V + 3], links[i, V + 4], links[i, V + 5] = (
            wx,
            wy,
            wz,
            ox,
            oy,
            oz,
        )
        links[i, A], links[i, A + 1], links[i, A + 2], links[i, A + 3], links[i, A + 4], links[i, A + 5] = (
            ex,
            ey,
            ez,
            fx,
            fy,
            fz,
        )
        if k > PRISMATIC:
            # Apart from the rest, which keeps its values in registers.
            sweep_row(model.compound, model, ws, i, vi, ai, gx, gy, gz)


@internal_kernel
def body_inertia(model: ModelArrays, ws: Workspace, i):
    """Mass, centre of mass c in W, and inertia I_c about it in the axes of W (xx xy xz yy yz zz), after a sweep."""
    body, links = model.body, ws.links
    b0, b1, b2 = links[i, R], links[i, R + 1], links[i, R + 2]
    b3, b4, b5 = links[i, R + 3], links[i, R + 4], links[i, R + 5]
    b6, b7, b8 = links[i, R + 6], links[i, R + 7], links[i, R + 8]
    ixx, ixy, ixz = body[i, INERTIA], body[i, INERTIA + 1], body[i, INERTIA + 2]
    iyy, iyz, izz = body[i, INERTIA + 3], body[i, INERTIA + 4], body[i, INERTIA + 5]
    t0, t1, t2 = b0 * ixx + b1 * ixy + b2 * ixz, b0 * ixy + b1 * iyy + b2 * iyz, b0 * ixz + b1 * iyz + b2 * izz
    t3, t4, t5 = b3 * ixx + b4 * ixy + b5 * ixz, b3 * ixy + b4 * iyy + b5 * iyz, b3 * ixz + b4 * iyz + b5 * izz
    t6, t7, t8 = b6 * ixx + b7 * ixy + b8 * ixz, b6 * ixy + b7 * iyy + b8 * iyz, b6 * ixz + b7 * iyz + b8 * izz
    ixx, ixy, ixz = t0 * b0 + t1 * b1 + t2 * b2, t0 * b3 + t1 * b4 + t2 * b5, t0 * b6 + t1 * b7 + t2 * b8
    iyy, iyz, izz = t3 * b3 + t4 * b4 + t5 * b5, t3 * b6 + t4 * b7 + t5 * b8, t6 * b6 + t7 * b7 + t8 * b8
    ux, uy, uz = body[i, COM], body[i, COM + 1], body[i, COM + 2]
    cx = links[i, P] + b0 * ux + b1 * uy + b2 * uz
    cy = links[i, P + 1] + b3 * ux + b4 * uy + b5 * uz
    cz = links[i, P + 2] + b6 * ux + b7 * uy + b8 * uz
    return body[i, MASS], cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz


@internal_kernel
def inertial_wrench(ws: Workspace, i, m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz):
    """Wrench about the world origin that moves body i as the sweep says: (I_c α + ω × I_c ω + c × m a_c, m a_c)."""
    links = ws.links
    wx, wy, wz, ox, oy, oz = (
        links[i, V], links[i, V + 1], links[i, V + 2], links[i, V + 3], links[i, V + 4], links[i, V + 5]
    )  # fmt: skip
    ex, ey, ez = links[i, A], links[i, A + 1], links[i, A + 2]
    vx, vy, vz = ox + wy * cz - wz * cy, oy + wz * cx - wx * cz, oz + wx * cy - wy * cx
    fx = m * (links[i, A + 3] + ey * cz - ez * cy + wy * vz - wz * vy)
    fy = m * (links[i, A + 4] + ez * cx - ex * cz + wz * vx - wx * vz)
    fz = m * (links[i, A + 5] + ex * cy - ey * cx + wx * vy - wy * vx)
    kx, ky, kz = ixx * wx + ixy * wy + ixz * wz, ixy * wx + iyy * wy + iyz * wz, ixz * wx + iyz * wy + izz * wz
    nx = ixx * ex + ixy * ey + ixz * ez + wy * kz - wz * ky + cy * fz - cz * fy
    ny = ixy * ex + iyy * ey + iyz * ez + wz * kx - wx * kz + cz * fx - cx * fz
    nz = ixz * ex + iyz * ey + izz * ez + wx * ky - wy * kx + cx * fy - cy * fx
    return nx, ny, nz, fx, fy, fz


@kernel
def kinematics(model: ModelArrays, ws: Workspace):
    """Poses, axes and velocities of all links from q and v in ``ws.joints``: :func:`forward_sweep` at vdot = 0."""
    forward_sweep(model, ws, 1.0, 0.0, 1.0)


@kernel
def newton_euler(model: ModelArrays, ws: Workspace, velocity, acceleration, gravity):
    """Generalised forces tau = M vdot + h + g, into the BIAS column of ``ws.joints`` [N m or N] ([WM] eqs 42–44, 52).

    Forward sweep, then tips to root: F_i += Σ_children F, tau_i = S·F_i. The factors are those of
    :func:`forward_sweep`. Reflected motor inertia and joint losses are not in tau.
    """
    forward_sweep(model, ws, velocity, acceleration, gravity)
    tree, links, joints = model.tree, ws.links, ws.joints
    for i in range(tree.shape[0]):
        m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz = body_inertia(model, ws, i)
        links[i, F], links[i, F + 1], links[i, F + 2], links[i, F + 3], links[i, F + 4], links[i, F + 5] = (
            inertial_wrench(ws, i, m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz)
        )
    for i in range(tree.shape[0] - 1, -1, -1):
        tau = 0.0
        j = tree[i, PARENT]
        for s in range(6):
            tau += links[i, S + s] * links[i, F + s]
            if j >= 0:
                links[j, F + s] += links[i, F + s]
        joints[i, BIAS] = tau


@kernel
def mass_matrix(model: ModelArrays, ws: Workspace, M):
    """M(q), column by column as p(q, 0, e_i, 0) ([WM] eq 55). M: (n, n) output.

    Overwrites V, A, F, vdot and bias of the workspace. M may have more rows and columns than n.
    Reflected motor inertia is not added.
    """
    n, joints = model.tree.shape[0], ws.joints
    for i in range(n):
        joints[i, QDD] = 0.0
    for i in range(n):
        joints[i, QDD] = 1.0
        newton_euler(model, ws, 0.0, 1.0, 0.0)
        joints[i, QDD] = 0.0
        for j in range(n):
            M[j, i] = joints[j, BIAS]
