"""Articulated-body solver: O(n) elimination for accelerations and the matrix of constraint rows; M is never formed.

Eliminating the joints from the tips to the root factors M + J_m; D_i is the pivot of joint i. For a right-hand side b,
let column(b) be b after elimination; then a·(M + J_m)⁻¹ b = Σ_i column(a)_i column(b)_i / D_i. The p×p matrix of the
constraints thus needs only dot products of columns, and one forward sweep gives vdot.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    ZERO_INERTIA,
    ZERO_SIX,
    body_in_world,
    dot,
    dot_plus,
    inertia,
    minus_outer,
    minus_scaled,
    negative,
    plus,
    plus_inertia,
    plus_scaled,
    put_six,
    scaled,
    six,
    times,
)
from dynsim.dynamics.tree.sweep import body_inertia, forward_sweep, inertial_wrench
from dynsim.jit.kernel import inline_kernel, internal_kernel, kernel, noinline_kernel


@internal_kernel
def factor(model: ModelArrays, ws: Workspace):
    """Compute articulated inertias and eliminated applied forces, from the tips to the root, after ``forward_sweep``.

    I^A_i = I_i + Σ_children (I^A − U Uᵀ/D), U = I^A S, D = S·U + J_m (Featherstone; world frame with one origin).
    F^A_i = F_i + Σ_children (F^A + U w/D), with w = applied − S·F^A in ``ws.column[:, 0]``. The inertial wrenches F of
    the sweep include velocity products and weight, so the bias forces need no separate pass.
    """
    tree, body, links, joints, column = model.tree, model.body, ws.links, ws.joints, ws.column
    n = tree.shape[0]
    for i in range(n):
        if tree[i, ka.BRANCHES] != 0:
            for k in range(21):
                links[i, ka.IA + k] = 0.0
            for k in range(6):
                links[i, ka.F + k] = 0.0
    # I and F are the contribution of link i + 1, kept in registers while the chain is serial; contributions of other
    # children accumulate in memory.
    I, F = ZERO_INERTIA, ZERO_SIX
    for i in range(n - 1, -1, -1):
        m, c, I_c = body_inertia(model, ws, i)
        I = plus_inertia(I, body_in_world(m, c, I_c))
        F = plus(F, inertial_wrench(ws, i, m, c, I_c))
        if tree[i, ka.BRANCHES] != 0:
            I = plus_inertia(I, inertia(links, i, ka.IA))
            F = plus(F, six(links, i, ka.F))
        S = six(links, i, ka.S)
        U = times(I, S)
        d = 1.0 / dot_plus(S, U, body[i, ka.ARMATURE])
        w = joints[i, ka.APPLIED] - dot(S, F)
        U_over_D = scaled(U, d)
        put_six(links, i, ka.U_OVER_D, U_over_D)
        links[i, ka.INVERSE_D] = d
        column[i, 0] = w
        F = plus_scaled(F, U_over_D, w)
        I = minus_outer(I, U_over_D, U)
        j = tree[i, ka.PARENT]
        if j != i - 1 or j < 0:
            if j >= 0:
                for k in range(21):
                    links[j, ka.IA + k] += I[k]
                for k in range(6):
                    links[j, ka.F + k] += F[k]
            I, F = ZERO_INERTIA, ZERO_SIX


@internal_kernel
def row_system(model: ModelArrays, ws: Workspace):
    """Write the p×p system J M⁻¹ F f = target − J M⁻¹ applied to ``ws.small[0]`` and the RHS column, after `factor`.

    The eliminated row k and its force direction are left in the columns ``ws.column[:, 1 + 2 k]`` and
    ``ws.column[:, 2 + 2 k]``. A row involves only joints between its links and the world; the rest of a column is zero
    from the start. Entry (k, m) is Σ column_k column_m / D over the joints that both rows involve.
    """
    tree, links, small, state = model.tree, ws.links, ws.small, ws.rows
    for k in range(ws.counts[ka.ROWS]):
        if ws.active[k, ka.BODY_B] >= 0:
            if ws.active[k, ka.ROW_KIND] != ka.STICKING_ROW:
                two_ended_row(model, ws, k)
            elif k == ws.active[ws.active[k, ka.OWNER], ka.FIRST_ROW]:
                two_ended_columns(model, ws, k)
            continue
        if ws.active[k, ka.ROW_KIND] == ka.STICKING_ROW:
            if k == ws.active[ws.active[k, ka.OWNER], ka.FIRST_ROW]:
                sticking_columns(model, ws, k)
            continue
        # Current values of the row and its force direction during the elimination.
        row, direction = six(state, k, ka.ROW), six(state, k, ka.DIRECTION)
        for m in range(k):
            small[0, k, m] = 0.0
            small[0, m, k] = 0.0
        own, total = 0.0, state[k, ka.TARGET]
        i = ws.active[k, ka.BODY_A]
        while i >= 0:
            S, U_over_D = six(links, i, ka.S), six(links, i, ka.U_OVER_D)
            r, w = dot(S, row), dot(S, direction)
            own, total = enter_column(ws, i, k, r, w, own, total)
            row, direction = minus_scaled(row, U_over_D, r), minus_scaled(direction, U_over_D, w)
            i = tree[i, ka.PARENT]
        small[0, k, k] = own
        state[k, ka.RHS] = total


@internal_kernel
def enter_column(ws: Workspace, i, k, r, w, own, total):
    """Write row k and its direction at joint i to the columns and to the system.

    Returns the partial sums of the diagonal entry and of the right-hand side of the row.
    """
    column, small = ws.column, ws.small
    column[i, 1 + 2 * k] = r
    column[i, 2 + 2 * k] = w
    d = ws.links[i, ka.INVERSE_D]
    x = d * r
    for m in range(k):
        small[0, k, m] += x * column[i, 2 + 2 * m]
        small[0, m, k] += d * w * column[i, 1 + 2 * m]
    return own + x * w, total - x * column[i, 0]


@noinline_kernel
def sticking_columns(model: ModelArrays, ws: Workspace, k):
    """Compute :func:`row_system` for the three rows of a sticking point, k and the next two, in one pass.

    Each row is its own force direction. The products with earlier rows are symmetric about the diagonal unless the
    earlier row slides.
    """
    tree, links, column, small, state = model.tree, ws.links, ws.column, ws.small[0], ws.rows
    b, c = k + 1, k + 2
    row_a, row_b, row_c = six(state, k, ka.ROW), six(state, b, ka.ROW), six(state, c, ka.ROW)
    for r in range(3):
        for m in range(k):
            small[k + r, m] = 0.0
            small[m, k + r] = 0.0
    aa, ab, ac, bb, bc, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ta, tb, tc = state[k, ka.TARGET], state[b, ka.TARGET], state[c, ka.TARGET]
    i = ws.active[k, ka.BODY_A]
    while i >= 0:
        S, U_over_D = six(links, i, ka.S), six(links, i, ka.U_OVER_D)
        x, y, z = dot(S, row_a), dot(S, row_b), dot(S, row_c)
        column[i, 1 + 2 * k], column[i, 2 + 2 * k] = x, x
        column[i, 1 + 2 * b], column[i, 2 + 2 * b] = y, y
        column[i, 1 + 2 * c], column[i, 2 + 2 * c] = z, z
        d = links[i, ka.INVERSE_D]
        dx, dy, dz = d * x, d * y, d * z
        aa, ab, ac, bb, bc, cc = aa + dx * x, ab + dx * y, ac + dx * z, bb + dy * y, bc + dy * z, cc + dz * z
        applied = column[i, 0]
        ta, tb, tc = ta - dx * applied, tb - dy * applied, tc - dz * applied
        for m in range(k):
            w = column[i, 2 + 2 * m]
            small[k, m] += dx * w
            small[b, m] += dy * w
            small[c, m] += dz * w
            if ws.active[m, ka.ROW_KIND] == ka.SLIDING_ROW:
                r = column[i, 1 + 2 * m]
                small[m, k] += dx * r
                small[m, b] += dy * r
                small[m, c] += dz * r
        row_a, row_b = minus_scaled(row_a, U_over_D, x), minus_scaled(row_b, U_over_D, y)
        row_c = minus_scaled(row_c, U_over_D, z)
        i = tree[i, ka.PARENT]
    for m in range(k):
        if ws.active[m, ka.ROW_KIND] != ka.SLIDING_ROW:
            for r in range(3):
                small[m, k + r] = small[k + r, m]
    small[k, k], small[b, b], small[c, c] = aa, bb, cc
    small[k, b], small[b, k], small[k, c], small[c, k], small[b, c], small[c, b] = ab, ab, ac, ac, bc, bc
    state[k, ka.RHS], state[b, ka.RHS], state[c, ka.RHS] = ta, tb, tc


@noinline_kernel
def two_ended_columns(model: ModelArrays, ws: Workspace, k):
    """Compute :func:`sticking_columns` for a point that sticks to another body.

    The rows climb from both ends as in :func:`two_ended_row`.
    """
    tree, links, column, small, state = model.tree, ws.links, ws.column, ws.small[0], ws.rows
    b, c = k + 1, k + 2
    row_a, row_b, row_c = six(state, k, ka.ROW), six(state, b, ka.ROW), six(state, c, ka.ROW)
    other_a, other_b, other_c = negative(row_a), negative(row_b), negative(row_c)
    for r in range(3):
        for m in range(k + 3):
            small[k + r, m] = 0.0
    ta, tb, tc = state[k, ka.TARGET], state[b, ka.TARGET], state[c, ka.TARGET]
    i, j = ws.active[k, ka.BODY_A], ws.active[k, ka.BODY_B]
    while i >= 0 or j >= 0:
        if j > i:
            i, j = j, i
            row_a, row_b, row_c, other_a, other_b, other_c = other_a, other_b, other_c, row_a, row_b, row_c
        if i == j:
            row_a, row_b, row_c = plus(row_a, other_a), plus(row_b, other_b), plus(row_c, other_c)
            j = -1
        S, U_over_D = six(links, i, ka.S), six(links, i, ka.U_OVER_D)
        x, y, z = dot(S, row_a), dot(S, row_b), dot(S, row_c)
        column[i, 1 + 2 * k], column[i, 2 + 2 * k] = x, x
        column[i, 1 + 2 * b], column[i, 2 + 2 * b] = y, y
        column[i, 1 + 2 * c], column[i, 2 + 2 * c] = z, z
        d = links[i, ka.INVERSE_D]
        dx, dy, dz = d * x, d * y, d * z
        applied = column[i, 0]
        ta, tb, tc = ta - dx * applied, tb - dy * applied, tc - dz * applied
        for m in range(k + 3):
            w = column[i, 2 + 2 * m]
            small[k, m] += dx * w
            small[b, m] += dy * w
            small[c, m] += dz * w
        row_a, row_b = minus_scaled(row_a, U_over_D, x), minus_scaled(row_b, U_over_D, y)
        row_c = minus_scaled(row_c, U_over_D, z)
        i = tree[i, ka.PARENT]
    for r in range(k, k + 3):
        for m in range(r):
            small[m, r] = small[r, m]
            if ws.active[m, ka.ROW_KIND] == ka.SLIDING_ROW:
                small[m, r] = 0.0
                for i in range(tree.shape[0]):
                    small[m, r] += links[i, ka.INVERSE_D] * column[i, 1 + 2 * m] * column[i, 2 + 2 * r]
    state[k, ka.RHS], state[b, ka.RHS], state[c, ka.RHS] = ta, tb, tc


@noinline_kernel
def two_ended_row(model: ModelArrays, ws: Workspace, k):
    """Compute the column, diagonal entry and right-hand side of a row between two bodies, as :func:`row_system` does.

    Two accumulators climb from the two ends, the larger index first, so that both meet in the first common ancestor
    and continue as one. A joint row has no wrench: its coefficients enter at its two joints.
    """
    tree, links, small, state = model.tree, ws.links, ws.small, ws.rows
    first, last = ws.active[k, ka.BODY_A], ws.active[k, ka.BODY_B]
    jointed = ws.active[k, ka.ROW_KIND] == ka.JOINT_ROW
    # Current values of the row and its direction on sides A and B during the elimination.
    row_a, direction_a = ZERO_SIX, ZERO_SIX
    if not jointed:
        row_a, direction_a = six(state, k, ka.ROW), six(state, k, ka.DIRECTION)
    row_b, direction_b = negative(row_a), negative(direction_a)
    for m in range(k):
        small[0, k, m] = 0.0
        small[0, m, k] = 0.0
    own, total = 0.0, state[k, ka.TARGET]
    # i is the end that moves next, and j is the other end.
    i, j = first, last
    while i >= 0 or j >= 0:
        if j > i:
            i, j = j, i
            row_a, row_b, direction_a, direction_b = row_b, row_a, direction_b, direction_a
        if i == j:
            row_a, direction_a = plus(row_a, row_b), plus(direction_a, direction_b)
            j = -1
        S, U_over_D = six(links, i, ka.S), six(links, i, ka.U_OVER_D)
        r, w = dot(S, row_a), dot(S, direction_a)
        if jointed and i == first:
            r, w = r + state[k, ka.ROW], w + state[k, ka.DIRECTION]
        elif jointed and i == last:
            r, w = r + state[k, ka.ROW + 1], w + state[k, ka.DIRECTION + 1]
        own, total = enter_column(ws, i, k, r, w, own, total)
        row_a, direction_a = minus_scaled(row_a, U_over_D, r), minus_scaled(direction_a, U_over_D, w)
        i = tree[i, ka.PARENT]
    small[0, k, k] = own
    state[k, ka.RHS] = total


@internal_kernel
def add_row_forces(model: ModelArrays, ws: Workspace):
    """Add the solved forces of all rows to the eliminated applied forces in ``ws.column[:, 0]``."""
    tree, column, state = model.tree, ws.column, ws.rows
    for k in range(ws.counts[ka.ROWS]):
        f = state[k, ka.FORCE]
        i = ws.active[k, ka.BODY_A]
        j = ws.active[k, ka.BODY_B]
        if j >= 0:
            for m in range(max(i, j) + 1):
                column[m, 0] += f * column[m, 2 + 2 * k]
            continue
        while i >= 0:
            column[i, 0] += f * column[i, 2 + 2 * k]
            i = tree[i, ka.PARENT]


@internal_kernel
def row_mobilities(ws: Workspace, W):
    """Write the symmetric J M⁻¹ Jᵀ of the active rows to W, from their columns: the changes of rates by impulses."""
    column, p = ws.column, ws.counts[ka.ROWS]
    for r in range(p):
        for s in range(p):
            W[r, s] = 0.0
            for i in range(ws.joints.shape[0]):
                W[r, s] += column[i, 1 + 2 * r] * column[i, 1 + 2 * s] * ws.links[i, ka.INVERSE_D]


@inline_kernel
def sweep_accelerations(model: ModelArrays, ws: Workspace, onto):
    """Compute vdot = (M + J_m)⁻¹ b from the eliminated b in ``ws.column[:, 0]`` by a forward sweep. F is scratch.

    vdot_i = column_i / D − (U/D)·a_p, a_i = a_p + S vdot_i. If ``onto`` is True, the result is added to the present
    vdot.
    """
    tree, links, joints, column = model.tree, ws.links, ws.joints, ws.column
    # The acceleration of link i − 1 stays in registers; it is read back only where the tree branches.
    A = ZERO_SIX
    for i in range(tree.shape[0]):
        j = tree[i, ka.PARENT]
        if j != i - 1:
            A = six(links, j, ka.F) if j >= 0 else ZERO_SIX
        x = column[i, 0] * links[i, ka.INVERSE_D] - dot(six(links, i, ka.U_OVER_D), A)
        joints[i, ka.QDD] = joints[i, ka.QDD] + x if onto else x
        A = plus_scaled(A, six(links, i, ka.S), x)
        if tree[i, ka.BRANCHES] != 0:
            put_six(links, i, ka.F, A)


@internal_kernel
def accelerate(model: ModelArrays, ws: Workspace):
    """Set vdot = (M + J_m)⁻¹ b, see :func:`sweep_accelerations`."""
    sweep_accelerations(model, ws, False)


@noinline_kernel
def change_accelerations(model: ModelArrays, ws: Workspace):
    """Add (M + J_m)⁻¹ b to vdot, see :func:`sweep_accelerations`."""
    sweep_accelerations(model, ws, True)


@internal_kernel
def accelerate_by_impulses(model: ModelArrays, ws: Workspace, f):
    """Set vdot to the change of rates by impulses f along the active rows, M⁻¹ Jᵀ f."""
    for i in range(ws.joints.shape[0]):
        ws.column[i, 0] = 0.0
        for r in range(ws.counts[ka.ROWS]):
            ws.column[i, 0] += f[r] * ws.column[i, 1 + 2 * r]
    accelerate(model, ws)


@kernel
def forward_dynamics(model: ModelArrays, ws: Workspace):
    """Compute vdot = (M + J_m)⁻¹ (applied − h − g) in ``ws.joints``, without contacts, by sweep, factor, accelerate."""
    forward_sweep(model, ws, 1.0, 0.0, 1.0)
    factor(model, ws)
    accelerate(model, ws)
