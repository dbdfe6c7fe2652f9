"""Contact problem of a time step by articulated inertias, in O(n) for each step of Newton's method.

With a given status, the impulse of a compliant contact is p = −C (u' + a), like the impulse of a damper, so that Jᵀ C J
belongs to the articulated inertia of its link. C has the following nonzero parts:

    sticks:  C_ii = 1/ε_i
    slides:  C_nn = 1/ε_n,  C_tn = μ q/ε_n,  C_tt = κ e eᵀ

A joint that its dry friction locks passes the inertia of its link on as a whole, and a sliding joint has the bound of
its friction as torque. A step of Newton's method, which :mod:`dynsim.dynamics.contact.cone.steps` takes by eliminating
a dense matrix, is then one elimination of the tree and one forward sweep. Statuses follow from the resulting motion.

The law of a sliding contact is |p_t| = μ p_n and u'_t + a_t + ε p_t = −λ p_t. Its derivative is −C for the direction
d = p_t/|p_t|, e normal to it, κ = 1/(e·ε e + λ) and q = d − κ (e·ε d) e.
"""

from __future__ import annotations

import math

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import body_in_world, dot, dot_plus, minus_scaled, plus_scaled, put_six, scaled, six
from dynsim.dynamics.tree.sweep import body_inertia, inertial_wrench
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import ArticulatedArrays, SteppingArrays
from dynsim.jit.kernel import internal_kernel

# ArticulatedArrays.link: 6×6 matrices are row-major.
BODY, BODY_F = 0, 36  # 36 and 6: inertia and inertial wrench of the body
I, F = 42, 78  # 36 and 6: articulated inertia and wrench; mobility of the link before the first step
PASSED, PASSED_F = 84, 120  # 36 and 6: inertia and wrench that the joint passes to the parent
COLUMN, LINE = 126, 132  # 6 each: I S and Iᵀ S
LEFT = 138  # applied force of the joint minus S·F
INVERSE = 139  # 1 / (S·I S + J_m)
CHANGED = 140  # 1: the elimination must be repeated
LOCK, BOUND = 141, 142  # 1: dry friction locks the joint; otherwise the impulse of its friction
MOTION = 143  # 6: velocity of the link at the start, then its acceleration relative to the sweep
LINK_SIZE = 152
# ArticulatedArrays.contact
STATUS = 0  # kc.OFF, kc.HOLDS or kc.SLIDES
EPSILON, MOBILITY = 1, 4  # 3 each: compliance and mobility of the rows
MEAN = 7  # mean mobility including ε
NORMAL, TANGENT = 8, 11  # 3 each: nonzero entries of C, (nn, xn, yn) and (xx, xy, yy)
CONTACT_SIZE = 14

# Contacts whose ε is a smaller fraction of the mobility stay dense, because p = −u'/ε would amplify rounding of u'.
MOST_STIFF = 1e5
# Tangents whose mobility is a smaller fraction of the largest mobility of the contact are immobile up to rounding.
LEAST_MOBILITY = 1e-8
# Number of Newton steps; after ALL_AT_ONCE steps, only one status changes at a time, because simultaneous changes may
# undo each other.
NEWTON_STEPS, ALL_AT_ONCE = 60, 8
# Dry friction is at its bound if its impulse differs from the bound by less than this fraction.
AT_BOUND = 1e-12
# At the start of a search, a contact slides if its friction is below its bound by less than this fraction.
AT_CONE = 1e-9


def articulated_arrays(system: System) -> ArticulatedArrays | None:
    """Allocate :class:`ArticulatedArrays`; None if bodies touch each other.

    They are empty if the dense solver must solve all steps: rigid contacts are not dampers, and couplings and contacts
    on moving links join two branches of the tree.
    """
    law, link = system.contacts.law, system.contacts.link
    if system.shapes is not None and system.shapes.pairs is not None:
        return None
    compliant = len(law) > 0 and (law[:, ka.CONTACT_STIFFNESS] > 0.0).all() and (link[:, ka.CARRIER] < 0).all()
    c = len(law) if compliant and not len(system.couplings.joint) else 0
    return ArticulatedArrays(np.zeros((len(system.model.body) + 1, LINK_SIZE)), np.zeros((c, CONTACT_SIZE)))


@internal_kernel
def begin_articulated(model: ModelArrays, table, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace):
    """Compute bodies, mobilities and rates at the start of the step, after ``factor``.

    The diagonal blocks of W are written to ``ws.small[0]``, and zero to RHS, because the elimination contains the
    motion without impulses. Returns whether all rows are mobile compliant contacts or dry friction.
    """
    if art.contact.shape[0] == 0:
        return False
    write_bodies(model, art, ws)
    propagate_mobilities(model, art, s, ws)
    for r in range(ws.counts[ka.ROWS]):
        ws.rows[r, ka.RHS] = 0.0
        s.rate[0, r] = row_motion(art, s.before[kt.V_START], ws, r)
    rows = table.shape[0]
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING and contact_mobility(art, ws, k):
            rows += ka.MOST_ROWS
    return rows == ws.counts[ka.ROWS]


@internal_kernel
def write_bodies(model: ModelArrays, art: ArticulatedArrays, ws: Workspace):
    """Write inertias and inertial wrenches of all bodies."""
    for i in range(ws.joints.shape[0]):
        a = art.link[i]
        m, c, I_c = body_inertia(model, ws, i)
        b = body_in_world(m, c, I_c)
        # The coupling block, row-major in b, is the upper right block of the matrix.
        for j in range(3):
            for k in range(3):
                a[BODY + 6 * j + 3 + k] = b[6 + 3 * j + k]
                a[BODY + 6 * (3 + k) + j] = b[6 + 3 * j + k]
        a[0], a[1], a[2], a[6], a[7], a[8], a[12], a[13], a[14] = b[0], b[1], b[2], b[1], b[3], b[4], b[2], b[4], b[5]
        a[21], a[22], a[23], a[27], a[28], a[29] = b[15], b[16], b[17], b[16], b[18], b[19]
        a[33], a[34], a[35] = b[17], b[19], b[20]
        put_six(art.link, i, BODY_F, inertial_wrench(ws, i, m, c, I_c))


@internal_kernel
def propagate_mobilities(model: ModelArrays, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace):
    """Write mobility and initial velocity of each link, from the root to the tips.

    The mobility is the acceleration of the link by a wrench on itself, Φ_i = X Φ_p Xᵀ + S Sᵀ/D with X = 1 − S (U/D)ᵀ.
    """
    for i in range(ws.joints.shape[0]):
        a, p = art.link[i], model.tree[i, ka.PARENT]
        move_link(art, ws, i, p, s.before[kt.V_START, i])
        S, U_over_D, b = six(ws.links, i, ka.S), six(ws.links, i, ka.U_OVER_D), art.link[p]
        y = times_matrix(art, p, U_over_D)
        y = minus_scaled(y, S, 0.5 * dot_plus(y, U_over_D, ws.links[i, ka.INVERSE_D]))
        for j in range(6):
            for k in range(6):
                a[I + 6 * j + k] = b[I + 6 * j + k] - S[j] * y[k] - y[j] * S[k]


@internal_kernel
def contact_mobility(art: ArticulatedArrays, ws: Workspace, k):
    """Write the diagonal block of W of listed candidate k; return whether all of its rows are mobile."""
    r, W, c = ws.active[k, ka.FIRST_ROW], ws.small[0], art.contact[k]
    for m in range(ka.MOST_ROWS):
        y = times_matrix(art, ws.active[r, ka.BODY_A], six(ws.rows, r + m, ka.ROW))
        for j in range(ka.MOST_ROWS):
            W[r + j, r + m] = dot(six(ws.rows, r + j, ka.ROW), y)
        c[MOBILITY + m] = W[r + m, r + m]
    least = min(c[MOBILITY], c[MOBILITY + 1], c[MOBILITY + 2])
    return least > LEAST_MOBILITY * max(c[MOBILITY], c[MOBILITY + 1], c[MOBILITY + 2])


@internal_kernel
def times_matrix(art: ArticulatedArrays, i, x):
    """Return I x for the matrix I of link i."""
    return (
        dot(six(art.link, i, I), x), dot(six(art.link, i, I + 6), x), dot(six(art.link, i, I + 12), x),
        dot(six(art.link, i, I + 18), x), dot(six(art.link, i, I + 24), x), dot(six(art.link, i, I + 30), x),
    )  # fmt: skip


@internal_kernel
def move_link(art: ArticulatedArrays, ws: Workspace, i, p, x):
    """Set the motion of link i to the motion of its parent p plus S x."""
    put_six(art.link, i, MOTION, plus_scaled(six(art.link, p, MOTION), six(ws.links, i, ka.S), x))


@internal_kernel
def row_motion(art: ArticulatedArrays, x, ws: Workspace, r):
    """Return the motion of row r by the motions of the links, or by the motions x of joints for rows of joints."""
    i = ws.active[r, ka.BODY_A]
    return x[i] if r < ws.counts[ka.COUPLED] else dot(six(ws.rows, r, ka.ROW), six(art.link, i, MOTION))


@internal_kernel
def end_rates(art, s: SteppingArrays, ws: Workspace, h):
    """Write the rates of all rows at the end of the step to ``s.rate``, after :func:`solve_articulated`."""
    if art is None:  # resolved at compile time
        return
    for r in range(ws.counts[ka.ROWS]):
        s.rate[1, r] = s.rate[0, r] + h * row_motion(art, s.before[kt.ACCELERATION], ws, r)


@internal_kernel
def solve_articulated(model: ModelArrays, table, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace, h):
    """Solve for ``s.f``, ``s.w`` and the accelerations; return the residual [m/s], or inf if the search fails.

    ``s.right`` is u + a, without the acceleration by applied forces. The search starts with the present statuses. The
    forces of the last linear problem are returned, so that the equations of motion hold to rounding.
    """
    s.statistics[kt.SOLVES] += 1.0
    art.link[:, CHANGED] = 1.0
    for step in range(NEWTON_STEPS):
        linear_motion(model, art, s, ws, h)
        alone = step >= ALL_AT_ONCE
        changed = joint_statuses(model, table, art, s, ws, h, alone)
        residual = contact_statuses(art, s, ws, h, alone, changed)
        if not changed and residual <= kt.GOOD:
            return residual
    s.statistics[kt.CYCLED] += 1.0
    return math.inf


@internal_kernel
def begin_search(table, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace):
    """Set statuses from the impulses ``s.f`` and the rates ``s.rate``; return whether no contact is too stiff."""
    resolved = True
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] != ka.STICKING:
            continue
        c, r = art.contact[k], ws.active[k, ka.FIRST_ROW]
        for m in range(ka.MOST_ROWS):
            # ``turn_rows`` has added ε to W.
            c[EPSILON + m] = ws.small[0, r + m, r + m] - c[MOBILITY + m]
            resolved = resolved and c[EPSILON + m] * MOST_STIFF >= c[MOBILITY + m]
        c[MEAN] = (ws.small[0, r, r] + ws.small[0, r + 1, r + 1] + ws.small[0, r + 2, r + 2]) / 3.0
        x, y, share = s.f[r + 1], s.f[r + 2], c[MEAN]
        length = math.sqrt(x * x + y * y)
        if length > 0.0 and length >= s.mu[r] * s.f[r] * (1.0 - AT_CONE):
            v, w = s.rate[0, r + 1] + s.turn[k, kt.ADDED + 1], s.rate[0, r + 2] + s.turn[k, kt.ADDED + 2]
            share += math.sqrt(v * v + w * w) / length
        normal = c[MEAN] * s.f[r] if s.memory[kt.LAST, k, kt.LISTED] == 1.0 else 1.0
        set_status(c, s.mu[r], normal, share * x, share * y)
    for k in range(table.shape[0]):
        r, a = table[k, ku.DRY_ROW], art.link[table[k, ku.DRY_JOINT]]
        clamped = abs(s.f[r]) >= s.mu[r] * (1.0 - AT_BOUND)
        a[LOCK] = 0.0 if clamped else 1.0
        a[BOUND] = math.copysign(s.mu[r], s.f[r]) if clamped else 0.0
    return resolved


@internal_kernel
def add_contact(art: ArticulatedArrays, s: SteppingArrays, ws: Workspace, k, h):
    """Add the damper of listed candidate k to the inertia and the wrench of its link, if the link has changed."""
    c, r = art.contact[k], ws.active[k, ka.FIRST_ROW]
    a, N = art.link[ws.active[r, ka.BODY_A]], six(ws.rows, r, ka.ROW)
    if a[CHANGED] == 0.0:
        return
    X, Y = six(ws.rows, r + 1, ka.ROW), six(ws.rows, r + 2, ka.ROW)
    U = plus_scaled(plus_scaled(scaled(N, c[NORMAL]), X, c[NORMAL + 1]), Y, c[NORMAL + 2])
    V = plus_scaled(scaled(X, c[TANGENT]), Y, c[TANGENT + 1])
    W = plus_scaled(scaled(X, c[TANGENT + 1]), Y, c[TANGENT + 2])
    for j in range(6):
        a[F + j] += (s.right[r] * U[j] + s.right[r + 1] * V[j] + s.right[r + 2] * W[j]) / h
        for m in range(6):
            a[I + 6 * j + m] += U[j] * N[m] + V[j] * X[m] + W[j] * Y[m]


@internal_kernel
def linear_motion(model: ModelArrays, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace, h):
    """Compute the accelerations for the present statuses.

    Only links whose contacts or joints have changed since the last call, and their ancestors, are eliminated again.
    """
    n, link, tree = ws.joints.shape[0], art.link, model.tree
    for i in range(n - 1, -1, -1):
        a, p = link[i], tree[i, ka.PARENT]
        if a[CHANGED] == 1.0:
            link[p, CHANGED] = 1.0
            for j in range(42):
                a[I + j] = a[BODY + j]
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING:
            add_contact(art, s, ws, k, h)
    for i in range(n - 1, -1, -1):
        a, p = link[i], tree[i, ka.PARENT]
        if a[CHANGED] == 1.0:
            eliminate_link(model, art, s, ws, i, h)
            a[CHANGED] = 0.0
        if p >= 0 and link[p, CHANGED] == 1.0:
            for j in range(42):
                link[p, I + j] += a[PASSED + j]
    for i in range(n):
        a, p = link[i], tree[i, ka.PARENT]
        x = a[INVERSE] * (a[LEFT] - dot(six(link, i, LINE), six(link, p, MOTION)))
        if a[LOCK] == 1.0:
            x = -s.before[kt.V_START, i] / h
        ws.joints[i, ka.QDD] = x
        move_link(art, ws, i, p, x)


@internal_kernel
def eliminate_link(model: ModelArrays, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace, i, h):
    """Eliminate joint i: compute the inertia and the wrench that it passes on.

    A locked joint has the acceleration −v/h, which stops it.
    """
    a, S = art.link[i], six(ws.links, i, ka.S)
    left, pivot = ws.joints[i, ka.APPLIED] + a[BOUND] / h, model.body[i, ka.ARMATURE]
    for j in range(6):
        column, line = 0.0, 0.0
        for k in range(6):
            column += a[I + 6 * j + k] * S[k]
            line += a[I + 6 * k + j] * S[k]
        a[COLUMN + j], a[LINE + j] = column, line
        pivot += S[j] * column
        left -= S[j] * a[F + j]
    a[LEFT] = left
    inverse, x = 1.0 / pivot, left / pivot
    if a[LOCK] == 1.0:
        inverse, x = 0.0, -s.before[kt.V_START, i] / h
    a[INVERSE] = inverse
    for j in range(6):
        share = inverse * a[COLUMN + j]
        for k in range(6):
            a[PASSED + 6 * j + k] = a[I + 6 * j + k] - share * a[LINE + k]
        a[PASSED_F + j] = a[F + j] + a[COLUMN + j] * x


@internal_kernel
def joint_statuses(model: ModelArrays, table, art: ArticulatedArrays, s: SteppingArrays, ws: Workspace, h, alone):
    """Write impulses and rates of dry friction, and update its statuses; return whether any has changed.

    With ``alone``, only the first status that must change does so.
    """
    changed = False
    for k in range(table.shape[0]):
        r, i = table[k, ku.DRY_ROW], table[k, ku.DRY_JOINT]
        a, x, bound = art.link[i], ws.joints[i, ka.QDD], s.mu[r]
        if a[LOCK] == 1.0:
            force = model.body[i, ka.ARMATURE] * x - a[LEFT] + dot(six(art.link, i, LINE), six(art.link, i, MOTION))
            s.f[r], s.w[r] = h * force, 0.0
            if abs(s.f[r]) > bound * (1.0 + AT_BOUND) and not (alone and changed):
                a[LOCK], a[BOUND], a[CHANGED], changed = 0.0, math.copysign(bound, s.f[r]), 1.0, True
        else:
            s.f[r], s.w[r] = a[BOUND], s.before[kt.V_START, i] + h * x
            if math.copysign(s.w[r], s.w[r] * a[BOUND]) > kt.GOOD and not (alone and changed):
                a[LOCK], a[BOUND], a[CHANGED], changed = 1.0, 0.0, 1.0, True
    return changed


@internal_kernel
def contact_statuses(art: ArticulatedArrays, s: SteppingArrays, ws: Workspace, h, alone, changed):
    """Write impulses and rates w of contacts, and update their statuses.

    The natural map z = m p − w with the mean mobility m of the contact determines statuses and residual, as in
    :mod:`dynsim.dynamics.contact.cone.steps`: with λ = m (|z_t|/(μ z_n) − 1), a solution has z = (m + λ) p.

    Returns
    -------
    residual : float
        Largest error of the contact law of a contact, |m p − P(z)| with the projection P onto the cone [m/s].
    """
    residual = 0.0
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] != ka.STICKING:
            continue
        c, r = art.contact[k], ws.active[k, ka.FIRST_ROW]
        before, mu = c[STATUS], s.mu[r]
        A = six(art.link, ws.active[r, ka.BODY_A], MOTION)
        u = s.right[r] + h * dot(six(ws.rows, r, ka.ROW), A)
        v = s.right[r + 1] + h * dot(six(ws.rows, r + 1, ka.ROW), A)
        w = s.right[r + 2] + h * dot(six(ws.rows, r + 2, ka.ROW), A)
        normal = -c[NORMAL] * u
        x = -(c[NORMAL + 1] * u + c[TANGENT] * v + c[TANGENT + 1] * w)
        y = -(c[NORMAL + 2] * u + c[TANGENT + 1] * v + c[TANGENT + 2] * w)
        u, v, w = u + c[EPSILON] * normal, v + c[EPSILON + 1] * x, w + c[EPSILON + 2] * y
        s.f[r], s.f[r + 1], s.f[r + 2], s.w[r], s.w[r + 1], s.w[r + 2] = normal, x, y, u, v, w
        m = c[MEAN]
        z, x, y = m * normal - u, m * x - v, m * y - w
        most, length = mu * max(z, 0.0), math.sqrt(x * x + y * y)
        share = most / length if length > most else 1.0
        x_off, y_off = m * s.f[r + 1] - share * x, m * s.f[r + 2] - share * y
        error = abs(min(m * normal, u)) + math.sqrt(x_off * x_off + y_off * y_off)
        residual = residual if error <= residual else error  # NaN is kept
        status = status_of(mu, z, x, y)
        if status != before:
            if alone and changed:
                continue
            changed = True
        set_status(c, mu, z, x, y)
        if status == kc.SLIDES or status != before:
            art.link[ws.active[r, ka.BODY_A], CHANGED] = 1.0
    return residual


@internal_kernel
def status_of(mu, z, x, y):
    """Return the status of a contact from its natural map (z, x, y)."""
    if not z > 0.0:
        return kc.OFF
    return kc.SLIDES if math.sqrt(x * x + y * y) > mu * z else kc.HOLDS


@internal_kernel
def set_status(c, mu, z, x, y):
    """Set status and C of a contact from its natural map (z, x, y); λ = m (|(x, y)|/(μ z) − 1) while it slides."""
    c[STATUS] = status_of(mu, z, x, y)
    c[NORMAL:] = 0.0
    if c[STATUS] == kc.OFF:
        return
    c[NORMAL] = 1.0 / c[EPSILON]
    if c[STATUS] == kc.HOLDS:
        c[TANGENT], c[TANGENT + 2] = 1.0 / c[EPSILON + 1], 1.0 / c[EPSILON + 2]
        return
    length, most = math.sqrt(x * x + y * y), mu * z
    x, y = x / length, y / length
    across = y * y * c[EPSILON + 1] + x * x * c[EPSILON + 2]
    kappa = most / ((across - c[MEAN]) * most + c[MEAN] * length)
    part = kappa * x * y * (c[EPSILON + 2] - c[EPSILON + 1])
    c[NORMAL + 1], c[NORMAL + 2] = mu * c[NORMAL] * (x + part * y), mu * c[NORMAL] * (y - part * x)
    c[TANGENT], c[TANGENT + 1], c[TANGENT + 2] = kappa * y * y, -kappa * x * y, kappa * x * x
