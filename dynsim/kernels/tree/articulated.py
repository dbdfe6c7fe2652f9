"""The O(n) solve: articulated-body elimination with several right-hand sides (M is never formed).

Eliminating the joints from the tips to the root factors M + J_m. For a right-hand side b let column(b) be what is left
at each joint after the elimination; then a·(M + J_m)⁻¹ b = Σ_i column(a)_i column(b)_i / D_i. So the p×p matrix of the
constraints needs only dot products of columns, and one forward sweep gives vdot.
"""

from __future__ import annotations

from dynsim.kernels.arrays import (
    APPLIED,
    ARMATURE,
    BODY_A,
    BODY_B,
    BRANCHES,
    DIRECTION,
    FIRST_ROW,
    FORCE,
    IA,
    INVERSE_D,
    JOINT_ROW,
    OWNER,
    PARENT,
    QDD,
    RHS,
    ROW,
    ROW_KIND,
    ROWS,
    SLIDING_ROW,
    STICKING_ROW,
    TARGET,
    U_OVER_D,
    F,
    ModelArrays,
    S,
    Workspace,
)
from dynsim.kernels.jit import apart_kernel, internal_kernel, kernel
from dynsim.kernels.tree.sweep import body_inertia, forward_sweep, inertial_wrench


@internal_kernel
def factor(model: ModelArrays, ws: Workspace):
    """Tips to root, after ``forward_sweep``: articulated inertias, and what the applied forces leave at each joint.

    I^A_i = I_i + Σ_children (I^A − U Uᵀ/D), U = I^A S, D = S·U + J_m (Featherstone, world frame, one origin).
    F^A_i = F_i + Σ_children (F^A + U w/D), w = applied − S·F^A, into ``ws.column[:, 0]``. The inertial wrenches F are
    those of the sweep: velocity products and weight come in here, so the bias forces need no pass of their own.
    """
    tree, body, links, joints, column = model.tree, model.body, ws.links, ws.joints, ws.column
    n = tree.shape[0]
    for i in range(n):
        if tree[i, BRANCHES] != 0:
            for k in range(21):
                links[i, IA + k] = 0.0
            for k in range(6):
                links[i, F + k] = 0.0
    # What link i + 1 hands down, kept in registers while the chain is serial; only links with further children
    # collect in memory.
    a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    h0, h1, h2, h3, h4, h5, h6, h7, h8 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    m0, m1, m2, m3, m4, m5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    f0, f1, f2, f3, f4, f5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n - 1, -1, -1):
        m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz = body_inertia(model, ws, i)
        n0, n1, n2, n3, n4, n5 = inertial_wrench(ws, i, m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz)
        # Inertia about the world origin: I_c + m (c² 1 − c cᵀ), with the coupling block [h]× of h = m c.
        hx, hy, hz = m * cx, m * cy, m * cz
        a0, a1, a2 = a0 + (ixx + hy * cy + hz * cz), a1 + (ixy - hx * cy), a2 + (ixz - hx * cz)
        a3, a4, a5 = a3 + (iyy + hx * cx + hz * cz), a4 + (iyz - hy * cz), a5 + (izz + hx * cx + hy * cy)
        h1, h2, h3, h5, h6, h7 = h1 - hz, h2 + hy, h3 + hz, h5 - hx, h6 - hy, h7 + hx
        m0, m3, m5 = m0 + m, m3 + m, m5 + m
        f0, f1, f2, f3, f4, f5 = f0 + n0, f1 + n1, f2 + n2, f3 + n3, f4 + n4, f5 + n5
        if tree[i, BRANCHES] != 0:
            a0, a1, a2 = a0 + links[i, IA], a1 + links[i, IA + 1], a2 + links[i, IA + 2]
            a3, a4, a5 = a3 + links[i, IA + 3], a4 + links[i, IA + 4], a5 + links[i, IA + 5]
            h0, h1, h2 = h0 + links[i, IA + 6], h1 + links[i, IA + 7], h2 + links[i, IA + 8]
            h3, h4, h5 = h3 + links[i, IA + 9], h4 + links[i, IA + 10], h5 + links[i, IA + 11]
            h6, h7, h8 = h6 + links[i, IA + 12], h7 + links[i, IA + 13], h8 + links[i, IA + 14]
            m0, m1, m2 = m0 + links[i, IA + 15], m1 + links[i, IA + 16], m2 + links[i, IA + 17]
            m3, m4, m5 = m3 + links[i, IA + 18], m4 + links[i, IA + 19], m5 + links[i, IA + 20]
            f0, f1, f2 = f0 + links[i, F], f1 + links[i, F + 1], f2 + links[i, F + 2]
            f3, f4, f5 = f3 + links[i, F + 3], f4 + links[i, F + 4], f5 + links[i, F + 5]
        sx, sy, sz = links[i, S], links[i, S + 1], links[i, S + 2]
        lx, ly, lz = links[i, S + 3], links[i, S + 4], links[i, S + 5]
        # Sums in pairs: the chain of dependent additions is what this loop waits for.
        u0 = ((a0 * sx + a1 * sy) + (a2 * sz + h0 * lx)) + (h1 * ly + h2 * lz)
        u1 = ((a1 * sx + a3 * sy) + (a4 * sz + h3 * lx)) + (h4 * ly + h5 * lz)
        u2 = ((a2 * sx + a4 * sy) + (a5 * sz + h6 * lx)) + (h7 * ly + h8 * lz)
        u3 = ((h0 * sx + h3 * sy) + (h6 * sz + m0 * lx)) + (m1 * ly + m2 * lz)
        u4 = ((h1 * sx + h4 * sy) + (h7 * sz + m1 * lx)) + (m3 * ly + m4 * lz)
        u5 = ((h2 * sx + h5 * sy) + (h8 * sz + m2 * lx)) + (m4 * ly + m5 * lz)
        d = 1.0 / (((sx * u0 + sy * u1) + (sz * u2 + lx * u3)) + ((ly * u4 + lz * u5) + body[i, ARMATURE]))
        w = joints[i, APPLIED] - (((sx * f0 + sy * f1) + (sz * f2 + lx * f3)) + (ly * f4 + lz * f5))
        d0, d1, d2, d3, d4, d5 = d * u0, d * u1, d * u2, d * u3, d * u4, d * u5
        links[i, U_OVER_D], links[i, U_OVER_D + 1], links[i, U_OVER_D + 2] = d0, d1, d2
        links[i, U_OVER_D + 3], links[i, U_OVER_D + 4], links[i, U_OVER_D + 5] = d3, d4, d5
        links[i, INVERSE_D] = d
        column[i, 0] = w
        f0, f1, f2, f3, f4, f5 = f0 + d0 * w, f1 + d1 * w, f2 + d2 * w, f3 + d3 * w, f4 + d4 * w, f5 + d5 * w
        a0, a1, a2, a3, a4, a5 = a0 - d0 * u0, a1 - d0 * u1, a2 - d0 * u2, a3 - d1 * u1, a4 - d1 * u2, a5 - d2 * u2
        h0, h1, h2 = h0 - d0 * u3, h1 - d0 * u4, h2 - d0 * u5
        h3, h4, h5 = h3 - d1 * u3, h4 - d1 * u4, h5 - d1 * u5
        h6, h7, h8 = h6 - d2 * u3, h7 - d2 * u4, h8 - d2 * u5
        m0, m1, m2, m3, m4, m5 = m0 - d3 * u3, m1 - d3 * u4, m2 - d3 * u5, m3 - d4 * u4, m4 - d4 * u5, m5 - d5 * u5
        j = tree[i, PARENT]
        if j != i - 1 or j < 0:
            if j >= 0:
                handed = (
                    a0, a1, a2, a3, a4, a5, h0, h1, h2, h3, h4, h5, h6, h7, h8, m0, m1, m2, m3, m4, m5
                )  # fmt: skip
                for k in range(21):
                    links[j, IA + k] += handed[k]
                links[j, F] += f0
                links[j, F + 1] += f1
                links[j, F + 2] += f2
                links[j, F + 3] += f3
                links[j, F + 4] += f4
                links[j, F + 5] += f5
            a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            h0, h1, h2, h3, h4, h5, h6, h7, h8 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            m0, m1, m2, m3, m4, m5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            f0, f1, f2, f3, f4, f5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@internal_kernel
def row_system(model: ModelArrays, ws: Workspace):
    """The p×p system J M⁻¹ F f = target − J M⁻¹ applied, into ``ws.small[0]`` and the RHS column, after :func:`factor`.

    Row k and its force direction leave the columns ``ws.column[:, 1 + 2 k]`` and ``ws.column[:, 2 + 2 k]``. Only joints
    between its links and the world feel a row; the rest of a column is zero from the start. Entry (k, m) is
    Σ column_k column_m / D over the joints that both rows feel.
    """
    tree, links, column, small, state = model.tree, ws.links, ws.column, ws.small, ws.rows
    for k in range(ws.counts[ROWS]):
        if ws.active[k, ROW_KIND] != SLIDING_ROW:
            if ws.active[k, BODY_B] >= 0:
                two_ended_row(model, ws, k)
                continue
            if ws.active[k, ROW_KIND] == STICKING_ROW:
                if k == ws.active[ws.active[k, OWNER], FIRST_ROW]:
                    sticking_columns(model, ws, k)
                continue
        r0, r1, r2 = state[k, ROW], state[k, ROW + 1], state[k, ROW + 2]
        r3, r4, r5 = state[k, ROW + 3], state[k, ROW + 4], state[k, ROW + 5]
        w0, w1, w2 = state[k, DIRECTION], state[k, DIRECTION + 1], state[k, DIRECTION + 2]
        w3, w4, w5 = state[k, DIRECTION + 3], state[k, DIRECTION + 4], state[k, DIRECTION + 5]
        for m in range(k):
            small[0, k, m] = 0.0
            small[0, m, k] = 0.0
        own, total = 0.0, state[k, TARGET]
        i = ws.active[k, BODY_A]
        while i >= 0:
            s0, s1, s2 = links[i, S], links[i, S + 1], links[i, S + 2]
            s3, s4, s5 = links[i, S + 3], links[i, S + 4], links[i, S + 5]
            r = ((s0 * r0 + s1 * r1) + (s2 * r2 + s3 * r3)) + (s4 * r4 + s5 * r5)
            w = ((s0 * w0 + s1 * w1) + (s2 * w2 + s3 * w3)) + (s4 * w4 + s5 * w5)
            column[i, 1 + 2 * k] = r
            column[i, 2 + 2 * k] = w
            d = links[i, INVERSE_D]
            scaled = d * r
            own += scaled * w
            total -= scaled * column[i, 0]
            for m in range(k):
                small[0, k, m] += scaled * column[i, 2 + 2 * m]
                small[0, m, k] += d * w * column[i, 1 + 2 * m]
            s0, s1, s2 = links[i, U_OVER_D], links[i, U_OVER_D + 1], links[i, U_OVER_D + 2]
            s3, s4, s5 = links[i, U_OVER_D + 3], links[i, U_OVER_D + 4], links[i, U_OVER_D + 5]
            r0, r1, r2, r3, r4, r5 = r0 - s0 * r, r1 - s1 * r, r2 - s2 * r, r3 - s3 * r, r4 - s4 * r, r5 - s5 * r
            w0, w1, w2, w3, w4, w5 = w0 - s0 * w, w1 - s1 * w, w2 - s2 * w, w3 - s3 * w, w4 - s4 * w, w5 - s5 * w
            i = tree[i, PARENT]
        small[0, k, k] = own
        state[k, RHS] = total


@apart_kernel
def sticking_columns(model: ModelArrays, ws: Workspace, k):
    """:func:`row_system` for the three rows of a point that sticks, k and the next two: their own directions.

    One walk for all of them. What they have in common with the rows before is the same on both sides of the diagonal
    unless the other one slides.
    """
    tree, links, column, small, state = model.tree, ws.links, ws.column, ws.small[0], ws.rows
    a0, a1, a2, a3, a4, a5 = (
        state[k, ROW], state[k, ROW + 1], state[k, ROW + 2], state[k, ROW + 3], state[k, ROW + 4], state[k, ROW + 5]
    )  # fmt: skip
    b, c = k + 1, k + 2
    b0, b1, b2, b3, b4, b5 = (
        state[b, ROW], state[b, ROW + 1], state[b, ROW + 2], state[b, ROW + 3], state[b, ROW + 4], state[b, ROW + 5]
    )  # fmt: skip
    c0, c1, c2, c3, c4, c5 = (
        state[c, ROW], state[c, ROW + 1], state[c, ROW + 2], state[c, ROW + 3], state[c, ROW + 4], state[c, ROW + 5]
    )  # fmt: skip
    for r in range(3):
        for m in range(k):
            small[k + r, m] = 0.0
            small[m, k + r] = 0.0
    aa, ab, ac, bb, bc, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ta, tb, tc = state[k, TARGET], state[b, TARGET], state[c, TARGET]
    i = ws.active[k, BODY_A]
    while i >= 0:
        s0, s1, s2 = links[i, S], links[i, S + 1], links[i, S + 2]
        s3, s4, s5 = links[i, S + 3], links[i, S + 4], links[i, S + 5]
        x = ((s0 * a0 + s1 * a1) + (s2 * a2 + s3 * a3)) + (s4 * a4 + s5 * a5)
        y = ((s0 * b0 + s1 * b1) + (s2 * b2 + s3 * b3)) + (s4 * b4 + s5 * b5)
        z = ((s0 * c0 + s1 * c1) + (s2 * c2 + s3 * c3)) + (s4 * c4 + s5 * c5)
        column[i, 1 + 2 * k], column[i, 2 + 2 * k] = x, x
        column[i, 1 + 2 * b], column[i, 2 + 2 * b] = y, y
        column[i, 1 + 2 * c], column[i, 2 + 2 * c] = z, z
        d = links[i, INVERSE_D]
        dx, dy, dz = d * x, d * y, d * z
        aa, ab, ac, bb, bc, cc = aa + dx * x, ab + dx * y, ac + dx * z, bb + dy * y, bc + dy * z, cc + dz * z
        applied = column[i, 0]
        ta, tb, tc = ta - dx * applied, tb - dy * applied, tc - dz * applied
        for m in range(k):
            w = column[i, 2 + 2 * m]
            small[k, m] += dx * w
            small[b, m] += dy * w
            small[c, m] += dz * w
            if ws.active[m, ROW_KIND] == SLIDING_ROW:
                r = column[i, 1 + 2 * m]
                small[m, k] += dx * r
                small[m, b] += dy * r
                small[m, c] += dz * r
        s0, s1, s2 = links[i, U_OVER_D], links[i, U_OVER_D + 1], links[i, U_OVER_D + 2]
        s3, s4, s5 = links[i, U_OVER_D + 3], links[i, U_OVER_D + 4], links[i, U_OVER_D + 5]
        a0, a1, a2, a3, a4, a5 = a0 - s0 * x, a1 - s1 * x, a2 - s2 * x, a3 - s3 * x, a4 - s4 * x, a5 - s5 * x
        b0, b1, b2, b3, b4, b5 = b0 - s0 * y, b1 - s1 * y, b2 - s2 * y, b3 - s3 * y, b4 - s4 * y, b5 - s5 * y
        c0, c1, c2, c3, c4, c5 = c0 - s0 * z, c1 - s1 * z, c2 - s2 * z, c3 - s3 * z, c4 - s4 * z, c5 - s5 * z
        i = tree[i, PARENT]
    for m in range(k):
        if ws.active[m, ROW_KIND] != SLIDING_ROW:
            for r in range(3):
                small[m, k + r] = small[k + r, m]
    small[k, k], small[b, b], small[c, c] = aa, bb, cc
    small[k, b], small[b, k], small[k, c], small[c, k], small[b, c], small[c, b] = ab, ab, ac, ac, bc, bc
    state[k, RHS], state[b, RHS], state[c, RHS] = ta, tb, tc


@apart_kernel
def two_ended_row(model: ModelArrays, ws: Workspace, k):
    """Column, own entry and right-hand side of a row with two ends, as :func:`row_system` does them for one end.

    Two accumulators climb from the two ends, the one with the larger index first, so that both meet in the first common
    ancestor and go on as one. A joint row has no wrench: its coefficients enter at its two joints.
    """
    tree, links, column, small, state = model.tree, ws.links, ws.column, ws.small, ws.rows
    first, last = ws.active[k, BODY_A], ws.active[k, BODY_B]
    jointed = ws.active[k, ROW_KIND] == JOINT_ROW
    # Of the sides A and B: what elimination has left of row and direction, six numbers each.
    ra0, ra1, ra2, ra3, ra4, ra5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    wa0, wa1, wa2, wa3, wa4, wa5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if not jointed:
        ra0, ra1, ra2 = state[k, ROW], state[k, ROW + 1], state[k, ROW + 2]
        ra3, ra4, ra5 = state[k, ROW + 3], state[k, ROW + 4], state[k, ROW + 5]
        wa0, wa1, wa2 = state[k, DIRECTION], state[k, DIRECTION + 1], state[k, DIRECTION + 2]
        wa3, wa4, wa5 = state[k, DIRECTION + 3], state[k, DIRECTION + 4], state[k, DIRECTION + 5]
    rb0, rb1, rb2, rb3, rb4, rb5 = -ra0, -ra1, -ra2, -ra3, -ra4, -ra5
    wb0, wb1, wb2, wb3, wb4, wb5 = -wa0, -wa1, -wa2, -wa3, -wa4, -wa5
    for m in range(k):
        small[0, k, m] = 0.0
        small[0, m, k] = 0.0
    own, total = 0.0, state[k, TARGET]
    # i is the end that moves next, j the other one.
    i, j = first, last
    while i >= 0 or j >= 0:
        if j > i:
            i, j = j, i
            ra0, ra1, ra2, ra3, ra4, ra5, rb0, rb1, rb2, rb3, rb4, rb5 = (
                rb0, rb1, rb2, rb3, rb4, rb5, ra0, ra1, ra2, ra3, ra4, ra5
            )  # fmt: skip
            wa0, wa1, wa2, wa3, wa4, wa5, wb0, wb1, wb2, wb3, wb4, wb5 = (
                wb0, wb1, wb2, wb3, wb4, wb5, wa0, wa1, wa2, wa3, wa4, wa5
            )  # fmt: skip
        if i == j:
            ra0, ra1, ra2, ra3, ra4, ra5 = ra0 + rb0, ra1 + rb1, ra2 + rb2, ra3 + rb3, ra4 + rb4, ra5 + rb5
            wa0, wa1, wa2, wa3, wa4, wa5 = wa0 + wb0, wa1 + wb1, wa2 + wb2, wa3 + wb3, wa4 + wb4, wa5 + wb5
            j = -1
        s0, s1, s2 = links[i, S], links[i, S + 1], links[i, S + 2]
        s3, s4, s5 = links[i, S + 3], links[i, S + 4], links[i, S + 5]
        r = ((s0 * ra0 + s1 * ra1) + (s2 * ra2 + s3 * ra3)) + (s4 * ra4 + s5 * ra5)
        w = ((s0 * wa0 + s1 * wa1) + (s2 * wa2 + s3 * wa3)) + (s4 * wa4 + s5 * wa5)
        if jointed and i == first:
            r, w = r + state[k, ROW], w + state[k, DIRECTION]
        elif jointed and i == last:
            r, w = r + state[k, ROW + 1], w + state[k, DIRECTION + 1]
        column[i, 1 + 2 * k] = r
        column[i, 2 + 2 * k] = w
        d = links[i, INVERSE_D]
        scaled = d * r
        own += scaled * w
        total -= scaled * column[i, 0]
        for m in range(k):
            small[0, k, m] += scaled * column[i, 2 + 2 * m]
            small[0, m, k] += d * w * column[i, 1 + 2 * m]
        s0, s1, s2 = links[i, U_OVER_D], links[i, U_OVER_D + 1], links[i, U_OVER_D + 2]
        s3, s4, s5 = links[i, U_OVER_D + 3], links[i, U_OVER_D + 4], links[i, U_OVER_D + 5]
        ra0, ra1, ra2 = ra0 - s0 * r, ra1 - s1 * r, ra2 - s2 * r
        ra3, ra4, ra5 = ra3 - s3 * r, ra4 - s4 * r, ra5 - s5 * r
        wa0, wa1, wa2 = wa0 - s0 * w, wa1 - s1 * w, wa2 - s2 * w
        wa3, wa4, wa5 = wa3 - s3 * w, wa4 - s4 * w, wa5 - s5 * w
        i = tree[i, PARENT]
    small[0, k, k] = own
    state[k, RHS] = total


@internal_kernel
def add_row_forces(model: ModelArrays, ws: Workspace):
    """Add the solved forces of all rows to the eliminated applied forces in ``ws.column[:, 0]``."""
    tree, column, state = model.tree, ws.column, ws.rows
    for k in range(ws.counts[ROWS]):
        f = state[k, FORCE]
        i = ws.active[k, BODY_A]
        j = ws.active[k, BODY_B]
        if j >= 0:
            for m in range(max(i, j) + 1):
                column[m, 0] += f * column[m, 2 + 2 * k]
            continue
        while i >= 0:
            column[i, 0] += f * column[i, 2 + 2 * k]
            i = tree[i, PARENT]


@internal_kernel
def accelerate(model: ModelArrays, ws: Workspace):
    """Forward sweep: vdot = (M + J_m)⁻¹ b from the eliminated b in ``ws.column[:, 0]``. Uses F as scratch.

    vdot_i = column_i / D − (U/D)·a_p, a_i = a_p + S vdot_i.
    """
    tree, links, joints, column = model.tree, ws.links, ws.joints, ws.column
    # The acceleration of link i − 1 stays in registers; it is read back only where the tree branches.
    a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(tree.shape[0]):
        j = tree[i, PARENT]
        if j != i - 1:
            if j >= 0:
                a0, a1, a2 = links[j, F], links[j, F + 1], links[j, F + 2]
                a3, a4, a5 = links[j, F + 3], links[j, F + 4], links[j, F + 5]
            else:
                a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u0, u1, u2 = links[i, U_OVER_D], links[i, U_OVER_D + 1], links[i, U_OVER_D + 2]
        u3, u4, u5 = links[i, U_OVER_D + 3], links[i, U_OVER_D + 4], links[i, U_OVER_D + 5]
        x = column[i, 0] * links[i, INVERSE_D] - (((u0 * a0 + u1 * a1) + (u2 * a2 + u3 * a3)) + (u4 * a4 + u5 * a5))
        joints[i, QDD] = x
        a0, a1, a2 = a0 + links[i, S] * x, a1 + links[i, S + 1] * x, a2 + links[i, S + 2] * x
        a3, a4, a5 = a3 + links[i, S + 3] * x, a4 + links[i, S + 4] * x, a5 + links[i, S + 5] * x
        if tree[i, BRANCHES] != 0:
            links[i, F], links[i, F + 1], links[i, F + 2] = a0, a1, a2
            links[i, F + 3], links[i, F + 4], links[i, F + 5] = a3, a4, a5


@kernel
def forward_dynamics(model: ModelArrays, ws: Workspace):
    """vdot = (M + J_m)⁻¹ (applied − h − g) without contacts: sweep, factor, accelerate. In and out: ``ws.joints``."""
    forward_sweep(model, ws, 1.0, 0.0, 1.0)
    factor(model, ws)
    accelerate(model, ws)
