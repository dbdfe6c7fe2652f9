"""Solver of the contact problem with bilateral and unilateral rows, Coulomb cones and dry friction without smoothing.

The first part of the file contains the steps (residual, Newton step, block Gauss–Seidel sweep) and the layout of the
scratch array ``room``; the second part contains the solver itself.
"""

from __future__ import annotations

import math

from dynsim.dynamics.linear import affine_row, eliminate
from dynsim.jit.kernel import internal_kernel, kernel

BOTH_WAYS, ONE_WAY, CONE, TANGENT, BOX = 0, 1, 2, 3, 4

# Blocks of the scratch array: two matrices, then vectors, each in the first row of its block.
MATRIX, SHIFTED = 0, 1
MOTION, MOBILITY, RIGHT, STATUS, FIRST, SECOND, BETA = 2, 3, 4, 5, 6, 7, 8
BEST, SWEPT, START, GOAL = 9, 10, 11, 12
SHIFTED_RIGHT, KEPT, LAST, ANCHOR, PROOF, NO_FRICTION, KNOWN = 13, 14, 15, 16, 17, 18, 19
CONE_ROOM = 20
# STATUS of a block, stored at its first row: no force; held with u = 0; sliding; at the bound FIRST.
OFF, HOLDS, SLIDES, CLAMPED = 0.0, 1.0, 2.0, 3.0
# The proximal term is PROXIMAL_FACTOR times the relative residual, at least LEAST_PROXIMAL, which is above rounding.
PROXIMAL_FACTOR, LEAST_PROXIMAL = 1e3, 1e-11
ROOT_STEPS = 60


@internal_kernel
def block_size(kind, k):
    """Return the number of rows of the block that begins at row k."""
    return 3 if kind[k] == CONE else 1


@internal_kernel
def copy(source, target, p):
    """Copy the first p numbers."""
    for k in range(p):
        target[k] = source[k]


@internal_kernel
def mobilities(W, kind, p, room):
    """Write the mobility of each block, the mean of its diagonal entries, to ``room[MOBILITY, 0]``."""
    mobility = room[MOBILITY, 0]
    largest = 0.0
    for k in range(p):
        largest = max(largest, abs(W[k, k]))
    k = 0
    while k < p:
        size = block_size(kind, k)
        total = 0.0
        for i in range(size):
            total += abs(W[k + i, k + i])
        # An immobile row gets a small mobility, so that quotients stay finite.
        total = max(total / size, 1e-14 * largest, 1e-300)
        for i in range(size):
            mobility[k + i] = total
        k += size


@internal_kernel
def motion(W, b, p, f, u):
    """Compute u = W f + b."""
    for k in range(p):
        u[k] = affine_row(W, f, b, p, k)


@internal_kernel
def measure(W, b, kind, mu, p, f, room):
    """Compute u = W f + b in ``room[MOTION, 0]``; return the residual and Σ error² / mobility."""
    u, mobility = room[MOTION, 0], room[MOBILITY, 0]
    motion(W, b, p, f, u)
    residual, merit, k = 0.0, 0.0, 0
    while k < p:
        w = mobility[k]
        error = abs(u[k]) if kind[k] == BOTH_WAYS else abs(min(w * f[k], u[k]))
        if kind[k] == BOX:
            error = abs(w * (f[k] - bounded(f[k] - u[k] / w, mu[k])))
        merit += error * error / w
        # Written so that NaN is kept.
        residual = residual if error <= residual else error
        if kind[k] == CONE:
            x, y, radius = w * f[k + 1] - u[k + 1], w * f[k + 2] - u[k + 2], mu[k] * w * max(f[k], 0.0)
            length = math.sqrt(x * x + y * y)
            scale = radius / length if length > radius else 1.0
            x, y = w * f[k + 1] - scale * x, w * f[k + 2] - scale * y
            error = math.sqrt(x * x + y * y)
            merit += error * error / w
            residual = residual if error <= residual else error
        k += block_size(kind, k)
    return residual, merit


@internal_kernel
def bounded(x, bound):
    """Return x clipped to ±bound."""
    return min(max(x, -bound), bound)


@internal_kernel
def newton_step(W, b, kind, mu, p, f, room, relative, most):
    """Take one Newton step of f, given its motion u in ``room[MOTION, 0]``.

    Blocks that are off (z_n = w f_n − u_n ≤ 0) get f = 0 and have no unknown. BOX rows with |z| ≥ w μ have no unknown
    either; their bound goes to the right-hand side of all rows. The other blocks have u_n' = 0, and u_t' = 0 if
    z_t = w f_t − u_t is inside the disc of radius μ z_n. Outside the disc, with d = z_t / |z_t| and e normal to it,

        d·f_t' = μ f_n',    (1 − β) w e·f_t' + β e·u_t' = 0,    β = μ z_n / |z_t|,

    so that such a block has the unknowns f_n and e·f_t. The matrix consists of the rows n and e of the motion and the
    columns n + μ d and e of the force. Each row gets a proximal term: w times a fraction, at most ``most``, that falls
    with the ``relative`` residual.
    """
    mobility, A, x = room[MOBILITY, 0], room[MATRIX], room[RIGHT, 0]
    status, first, second, beta = room[STATUS, 0], room[FIRST, 0], room[SECOND, 0], room[BETA, 0]
    near = min(max(PROXIMAL_FACTOR * most * relative, LEAST_PROXIMAL), most)
    find_statuses(kind, mu, p, f, room)
    known = room[KNOWN, 0]
    copy(b, known, p)
    m = 0
    while m < p:
        # STATUS is only written at the first row of a block; tangents have values left over from another problem.
        if status[m] == CLAMPED:
            for k in range(p):
                known[k] += W[k, m] * first[m]
        m += block_size(kind, m)
    r, k = 0, 0
    while k < p:
        more = near * mobility[k]
        if status[k] == HOLDS:
            for i in range(k, k + block_size(kind, k)):
                fill_row(W, kind, mu, p, i, i, 1.0, 0.0, room, r)
                A[r, r] += more
                x[r] = more * f[i] - known[i]
                r += 1
        elif status[k] == SLIDES:
            fill_row(W, kind, mu, p, k, k, 1.0, 0.0, room, r)
            A[r, r] += more
            x[r] = more * f[k] - known[k]
            r += 1
            if beta[k] > 0.0:
                ex, ey = -second[k], first[k]
                fill_row(W, kind, mu, p, k + 1, k + 2, ex, ey, room, r)
                A[r, r] += (1.0 - beta[k]) / beta[k] * mobility[k] + more
                x[r] = more * (ex * f[k + 1] + ey * f[k + 2]) - (ex * known[k + 1] + ey * known[k + 2])
                r += 1
        k += block_size(kind, k)
    eliminate(A, x, r, -1.0)
    r, k = 0, 0
    while k < p:
        if status[k] == SLIDES:
            normal, across = x[r], 0.0
            r += 1
            if beta[k] > 0.0:
                across = x[r]
                r += 1
            f[k] = normal
            f[k + 1] = mu[k] * normal * first[k] - across * second[k]
            f[k + 2] = mu[k] * normal * second[k] + across * first[k]
        else:
            for i in range(k, k + block_size(kind, k)):
                f[i] = 0.0
                if status[k] == HOLDS:
                    f[i] = x[r]
                    r += 1
                elif status[k] == CLAMPED:
                    f[i] = first[k]
        k += block_size(kind, k)


@internal_kernel
def find_statuses(kind, mu, p, f, room):
    """Set STATUS of each block, FIRST, SECOND = d and BETA of sliding blocks, and FIRST of blocks at a bound."""
    u, mobility = room[MOTION, 0], room[MOBILITY, 0]
    status, first, second, beta = room[STATUS, 0], room[FIRST, 0], room[SECOND, 0], room[BETA, 0]
    k = 0
    while k < p:
        w = mobility[k]
        normal = w * f[k] - u[k]
        status[k] = HOLDS if kind[k] == BOTH_WAYS or normal > 0.0 else OFF
        if kind[k] == BOX:
            status[k] = HOLDS
            if abs(normal) >= w * mu[k]:
                status[k], first[k] = CLAMPED, mu[k] if normal > 0.0 else -mu[k]
        if kind[k] == CONE and normal > 0.0:
            x, y = w * f[k + 1] - u[k + 1], w * f[k + 2] - u[k + 2]
            length = math.sqrt(x * x + y * y)
            if length > mu[k] * normal:
                status[k] = SLIDES
                first[k], second[k], beta[k] = x / length, y / length, mu[k] * normal / length
        k += block_size(kind, k)


@internal_kernel
def fill_row(W, kind, mu, p, i, j, alpha, gamma, room, r):
    """Write row r of Newton's matrix: the motion alpha u_i + gamma u_j in terms of the unknowns."""
    A, status, first, second, beta = room[MATRIX], room[STATUS, 0], room[FIRST, 0], room[SECOND, 0], room[BETA, 0]
    c, m = 0, 0
    while m < p:
        if status[m] == HOLDS:
            for s in range(m, m + block_size(kind, m)):
                A[r, c] = alpha * W[i, s] + gamma * W[j, s]
                c += 1
        elif status[m] == SLIDES:
            normal = alpha * W[i, m] + gamma * W[j, m]
            x = alpha * W[i, m + 1] + gamma * W[j, m + 1]
            y = alpha * W[i, m + 2] + gamma * W[j, m + 2]
            A[r, c] = normal + mu[m] * (first[m] * x + second[m] * y)
            c += 1
            if beta[m] > 0.0:
                A[r, c] = first[m] * y - second[m] * x
                c += 1
        m += block_size(kind, m)


@internal_kernel
def sweep(W, b, kind, mu, p, f, room):
    """Do one block Gauss–Seidel sweep: solve each block exactly with the other forces fixed."""
    mobility = room[MOBILITY, 0]
    k = 0
    while k < p:
        if kind[k] == CONE:
            n, x, y = affine_row(W, f, b, p, k), affine_row(W, f, b, p, k + 1), affine_row(W, f, b, p, k + 2)
            n -= W[k, k] * f[k] + W[k, k + 1] * f[k + 1] + W[k, k + 2] * f[k + 2]
            x -= W[k + 1, k] * f[k] + W[k + 1, k + 1] * f[k + 1] + W[k + 1, k + 2] * f[k + 2]
            y -= W[k + 2, k] * f[k] + W[k + 2, k + 1] * f[k + 1] + W[k + 2, k + 2] * f[k + 2]
            solve_block(W, k, n, x, y, mu[k], f, 1e-12 * mobility[k])
            k += 3
            continue
        total = affine_row(W, f, b, p, k)
        new = f[k] - total / max(W[k, k], 1e-12 * mobility[k]) if W[k, k] > 0.0 else 0.0
        f[k] = new if kind[k] == BOTH_WAYS else max(new, 0.0)
        if kind[k] == BOX:
            f[k] = bounded(new, mu[k])
        k += 1


@internal_kernel
def solve_block(W, k, n, x, y, mu, f, least):
    """Return the forces of the single block at row k; its motion without these forces is (n, x, y).

    The block is off if n ≥ 0. Otherwise u_n = 0 gives f_n = −(n + w·f_t) / W_nn, which leaves (S + α) f_t = g with the
    Schur complement S of W_nn and g = w n / W_nn − (x, y). The block sticks if the force for α = 0 is in the cone;
    otherwise α is the root of |f_t| − μ f_n, which is positive at α = 0 and negative for large α.
    """
    f[k], f[k + 1], f[k + 2] = 0.0, 0.0, 0.0
    normal = W[k, k]
    if n >= 0.0 or not normal > least:
        return
    if mu == 0.0:
        f[k] = -n / normal
        return
    wx, wy = W[k, k + 1] / normal, W[k, k + 2] / normal
    a = W[k + 1, k + 1] - wx * W[k + 1, k] + least
    c = W[k + 1, k + 2] - wx * W[k + 2, k]
    d = W[k + 2, k + 2] - wy * W[k + 2, k] + least
    gx, gy = wx * n - x, wy * n - y
    fn, fx, fy, excess = sliding_force(a, c, d, gx, gy, wx, wy, n / normal, mu, 0.0)
    if excess > 0.0:
        low, high, at_low = 0.0, a + d, excess
        at_high = at_low
        for _ in range(200):
            fn, fx, fy, at_high = sliding_force(a, c, d, gx, gy, wx, wy, n / normal, mu, high)
            if at_high <= 0.0:
                break
            low, at_low = high, at_high
            high *= 4.0
        side = 0
        for _ in range(ROOT_STEPS):
            if at_high == 0.0 or high - low <= 1e-15 * high:
                break
            middle = low + (high - low) * at_low / (at_low - at_high)
            if not (middle > low and middle < high):
                middle = 0.5 * (low + high)
            fn, fx, fy, excess = sliding_force(a, c, d, gx, gy, wx, wy, n / normal, mu, middle)
            if abs(excess) <= 1e-15 * mu * abs(fn):
                break
            if excess > 0.0:
                low, at_low = middle, excess
                at_high = 0.5 * at_high if side == 1 else at_high
                side = 1
            else:
                high, at_high = middle, excess
                at_low = 0.5 * at_low if side == -1 else at_low
                side = -1
    f[k], f[k + 1], f[k + 2] = fn, fx, fy


@internal_kernel
def sliding_force(a, c, d, gx, gy, wx, wy, n, mu, alpha):
    """Return f_n, f_t and |f_t| − μ f_n for the matrix ((a, c), (c, d)) + α."""
    determinant = (a + alpha) * (d + alpha) - c * c
    fx = ((d + alpha) * gx - c * gy) / determinant
    fy = ((a + alpha) * gy - c * gx) / determinant
    fn = -(n + wx * fx + wy * fy)
    return fn, fx, fy, math.sqrt(fx * fx + fy * fy) - mu * fn


# Solver of the contact problem.


# Return value of ``solve_cones`` instead of a residual if there is provably no solution.
NO_SOLUTION = -1.0

# Number of Newton steps from one start; the first FULL_STEPS are full steps, and later steps are halved up to HALVINGS
# times until they reduce the merit.
NEWTON_STEPS, FULL_STEPS, HALVINGS = 20, 6, 8
# Total number of starts; sweeps per start, multiplied by the number of the start; number of starts after which this
# multiplier begins again.
ROUNDS, SWEEPS, SWEPT_ROUNDS = 200, 10, 40
# Number of starts before a proof is tried, and for each problem in the proof.
FEW_ROUNDS = 8
# Largest proximal term of Newton steps from the first start, unless the caller chooses another.
FEW_PROXIMAL = 1e-6
# Proximal-point method: number of steps, first and smallest ε.
NEAR_STEPS, FIRST_EPSILON, LEAST_EPSILON = 60, 1e-3, 1e-9
# A proof covers all forces up to PROVED_FORCE times |b| / mobility; its problem is regularised by PROOF_SHIFT.
PROVED_FORCE, PROOF_SHIFT, PROOF_STEPS = 1e6, 1e-6, 4


@kernel
def solve_cones(W, b, kind, mu, p, f, room, tolerance):
    """Solve a contact problem for the forces f; return its residual, or NO_SOLUTION.

    The residual is the largest error of a block in the units of u, measured by the natural map with the block's own
    mobility w (the mean of its diagonal entries): |u| for BOTH_WAYS, |min(w f, u)| for ONE_WAY and normals, and
    |w f_t − P(w f_t − u_t)| for tangents, with the projection P onto the disc of radius μ w f_n. BOX rows have the same
    error as tangents, with the projection onto ±μ w. The residual is zero only at solutions, and no term in it is
    regularised. A residual above ``tolerance`` means that no better f was found.

    Parameters
    ----------
    W, b : (p or more, p or more) ndarray, (p or more,) ndarray
        Matrix and vector of the motion u = W f + b. W need not be symmetric in ONE_WAY columns, and may be
        rank-deficient.
    kind : (p,) ndarray of int
        BOTH_WAYS, ONE_WAY, CONE, TANGENT or BOX.
    mu : (p,) ndarray
        Friction coefficients at CONE rows, bounds of the forces at BOX rows, possibly infinite.
    f : (p,) ndarray
        Initial forces, overwritten with the solution or the best forces found.
    room : (CONE_ROOM, p or more, p or more) ndarray
        Scratch.
    tolerance : float
        Residual at which the search ends [units of u].
    """
    if p == 0:  # without possible contacts, no scratch is allocated either
        return 0.0
    residual = approach_or_proximal_point(W, b, kind, mu, p, f, room, tolerance, FEW_ROUNDS)
    if residual <= tolerance:
        return residual
    if impossible(W, b, kind, mu, p, room):
        return NO_SOLUTION
    return approach(W, b, kind, mu, p, f, room, tolerance, ROUNDS, FEW_PROXIMAL)


@internal_kernel
def approach_or_proximal_point(W, b, kind, mu, p, f, room, tolerance, rounds):
    """Solve as :func:`solve_cones` without a proof: one start, :func:`proximal_point`, then up to ``rounds`` starts."""
    residual = approach(W, b, kind, mu, p, f, room, tolerance, 1, FEW_PROXIMAL)
    if not residual <= tolerance:
        residual = proximal_point(W, b, kind, mu, p, f, room, tolerance)
    if not residual <= tolerance:
        residual = approach(W, b, kind, mu, p, f, room, tolerance, rounds, FEW_PROXIMAL)
    return residual


@internal_kernel
def approach(W, b, kind, mu, p, f, room, tolerance, rounds, share):
    """Solve as :func:`solve_cones` by Newton's method from up to ``rounds`` starts: f, then swept or random forces.

    ``share`` is the largest proximal term of the steps from f; it is relative to the mobilities.
    """
    best, swept, mobility = room[BEST, 0], room[SWEPT, 0], room[MOBILITY, 0]
    mobilities(W, kind, p, room)
    residual, merit = measure(W, b, kind, mu, p, f, room)
    least, scale = residual, 0.0
    for k in range(p):
        best[k], swept[k] = f[k], f[k]
        scale = max(scale, abs(b[k]))
    for attempt in range(rounds):
        scattered = attempt % 2 == 1 or attempt > SWEPT_ROUNDS
        if attempt > 0:
            if scattered:
                largest = 0.0
                for k in range(p):
                    largest = max(largest, abs(best[k]) * mobility[k])
                scatter(mobility, p, f, largest, attempt)
            else:
                copy(swept, f, p)
            for _ in range(SWEEPS * (attempt if attempt <= SWEPT_ROUNDS else attempt % SWEEPS)):
                sweep(W, b, kind, mu, p, f, room)
            if not scattered:
                copy(f, swept, p)
            residual, merit = measure(W, b, kind, mu, p, f, room)
        # Alternate between values: a value that is too small for some problems is too large for others.
        most = 1e-6 if attempt % 6 < 2 else 1e-3 if attempt % 6 < 4 else 1e-9
        most = share if attempt == 0 else most
        for step in range(NEWTON_STEPS + 1):
            # The comparison is written so that NaN is never the best residual.
            if residual < least:
                least = residual
                copy(f, best, p)
            if not residual > tolerance or step == NEWTON_STEPS:
                break
            relative = residual / scale if scale > 0.0 else 1.0
            residual, merit = damped_step(W, b, kind, mu, p, f, room, relative, most, merit, step >= FULL_STEPS)
        if least <= tolerance:
            break
    copy(best, f, p)
    return least


@internal_kernel
def damped_step(W, b, kind, mu, p, f, room, relative, most, before, damped):
    """Take one Newton step, halved until the merit falls if ``damped``; return the residual and merit after it."""
    start, goal = room[START, 0], room[GOAL, 0]
    copy(f, start, p)
    newton_step(W, b, kind, mu, p, f, room, relative, most)
    residual, merit = measure(W, b, kind, mu, p, f, room)
    if not damped or merit < before:
        return residual, merit
    copy(f, goal, p)
    t, at, least = 1.0, 1.0, merit
    for _ in range(HALVINGS):
        t *= 0.5
        for k in range(p):
            f[k] = start[k] + t * (goal[k] - start[k])
        residual, merit = measure(W, b, kind, mu, p, f, room)
        if merit < least:
            least, at = merit, t
        if merit < (1.0 - 0.5 * t) * before:
            break
    if at != t:
        for k in range(p):
            f[k] = start[k] + at * (goal[k] - start[k])
        residual, merit = measure(W, b, kind, mu, p, f, room)
    return residual, merit


@internal_kernel
def scatter(mobility, p, f, size, attempt):
    """Set initial forces of order ``size`` / mobility that are pseudo-random but the same in every run."""
    for k in range(p):
        f[k] = size / mobility[k] * math.sin(12.9898 * (k + 1) * attempt)


@internal_kernel
def shift(W, b, p, room, epsilon):
    """Write W + ε w to ``room[SHIFTED]`` and b − ε w a, with the anchor a, to ``room[SHIFTED_RIGHT, 0]``."""
    shifted, right, mobility, anchor = room[SHIFTED], room[SHIFTED_RIGHT, 0], room[MOBILITY, 0], room[ANCHOR, 0]
    for k in range(p):
        for m in range(p):
            shifted[k, m] = W[k, m]
        shifted[k, k] += epsilon * mobility[k]
        right[k] = b[k] - epsilon * mobility[k] * anchor[k]


@internal_kernel
def proximal_point(W, b, kind, mu, p, f, room, tolerance):
    """Solve (W + ε w) f' + b − ε w f = 0 repeatedly with the same cones (proximal-point method); return the residual.

    A fixed point solves the original problem for any ε. If the forces are not unique, they stay near the initial f. As
    W + ε w is regular, each of these problems takes few Newton steps. ε falls after a solved problem and grows after an
    unsolved one. The best forces found are left in f.
    """
    shifted, right = room[SHIFTED], room[SHIFTED_RIGHT, 0]
    kept, anchor = room[KEPT, 0], room[ANCHOR, 0]
    mobilities(W, kind, p, room)
    least, _ = measure(W, b, kind, mu, p, f, room)
    scale = 0.0
    for k in range(p):
        kept[k], anchor[k] = f[k], f[k]
        scale = max(scale, abs(b[k]))
    epsilon, inner = FIRST_EPSILON, max(0.1 * tolerance, 1e-14 * scale)
    for _ in range(NEAR_STEPS):
        shift(W, b, p, room, epsilon)
        left = approach(shifted, right, kind, mu, p, f, room, inner, 1, FEW_PROXIMAL)
        # Restore the mobilities, because ``approach`` has left those of the shifted problem.
        mobilities(W, kind, p, room)
        residual, _ = measure(W, b, kind, mu, p, f, room)
        if residual < least:
            least = residual
            copy(f, kept, p)
        if least <= tolerance:
            break
        solved = left <= 0.1 * residual + inner
        if solved:
            copy(f, anchor, p)
        else:
            copy(anchor, f, p)
        epsilon = max(0.3 * epsilon, LEAST_EPSILON) if solved else min(10.0 * epsilon, 1.0)
    copy(kept, f, p)
    return least


@internal_kernel
def impossible(W, b, kind, mu, p, room):
    """Return whether it is proved that no forces up to PROVED_FORCE |b| / w solve the problem.

    The proof is a combination d of motions, of any sign for BOTH_WAYS rows, non-negative for ONE_WAY rows and normals,
    and zero for tangents and BOX rows. A solution has d·u ≥ 0. But d·u = (Wᵀd)·f + d·b is negative if d·b is negative
    and no admissible force makes (Wᵀd)·f positive, for example if bodies close in on each other from all sides. Such a
    d is the remaining motion, −ε w f, of the frictionless problem that is solved with ε w added to W.
    """
    proof, none, scale = room[PROOF, 0], room[NO_FRICTION, 0], 0.0
    right, mobility = room[SHIFTED_RIGHT, 0], room[MOBILITY, 0]
    for k in range(p):
        proof[k], none[k], room[ANCHOR, 0, k], scale = 0.0, 0.0, 0.0, max(scale, abs(b[k]))
    mobilities(W, kind, p, room)
    shift(W, b, p, room, PROOF_SHIFT)
    # Repeat for the remaining motion. Each time, a millionth of the motion that forces can cause remains.
    for _ in range(PROOF_STEPS):
        approach(room[SHIFTED], right, kind, none, p, proof, room, 1e-9 * scale, FEW_ROUNDS, FEW_PROXIMAL)
        mobilities(W, kind, p, room)
        for k in range(p):
            free = kind[k] == TANGENT or kind[k] == BOX
            proof[k] = 0.0 if free else PROOF_SHIFT * mobility[k] * proof[k]
            if kind[k] != BOTH_WAYS:
                proof[k] = max(proof[k], 0.0)
            right[k] = -proof[k]
            room[LAST, 0, k] = proof[k]
            proof[k] /= PROOF_SHIFT * mobility[k]
    total = 0.0
    for k in range(p):
        proof[k] = room[LAST, 0, k]
        total += proof[k] * b[k]
    k = 0
    while k < p:
        power = 0.0
        for m in range(p):
            power += proof[m] * W[m, k]
        if kind[k] == BOTH_WAYS or kind[k] == BOX:
            power = abs(power)
        elif kind[k] == CONE:
            x, y = 0.0, 0.0
            for m in range(p):
                x += proof[m] * W[m, k + 1]
                y += proof[m] * W[m, k + 2]
            power += mu[k] * math.sqrt(x * x + y * y)
        most = PROVED_FORCE * scale / mobility[k]
        total += max(power, 0.0) * (min(most, mu[k]) if kind[k] == BOX else most)
        k += block_size(kind, k)
    return total < 0.0
