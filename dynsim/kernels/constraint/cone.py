"""Contact problems: forces on one side, Coulomb cones, rows that hold both ways, all at once and without smoothing.

Find f with u = W f + b (forces and accelerations, or impulses and velocities) such that every row or block of rows has

    BOTH_WAYS    u = 0
    ONE_WAY      0 ≤ f ⟂ u ≥ 0
    CONE         0 ≤ f_n ⟂ u_n ≥ 0,  |f_t| ≤ μ f_n,  u_t = −λ f_t with λ ≥ 0, and λ = 0 inside the cone

A CONE row is followed by its two TANGENT rows. Friction is not associated: u_n does not depend on μ |u_t|.

The method is a semismooth Newton method on the natural map of Alart and Curnier (Computer Methods in Applied Mechanics
and Engineering 92, 1991), from the caller's last forces; where that does not come closer, sweeps of block Gauss–Seidel
with the exact solution of each block choose a new start. A proximal term keeps it regular when rows depend on each
other; it vanishes at the solution.
"""

from __future__ import annotations

import math

from dynsim.kernels.jit import internal_kernel, kernel

BOTH_WAYS, ONE_WAY, CONE, TANGENT = 0, 1, 2, 3
# What ``solve_cones`` returns instead of a residual when it has proved that there is no solution.
NO_SOLUTION = -1.0

# Blocks of the scratch: the Newton matrix, then vectors in first rows.
MATRIX, MOTION, MOBILITY, STEP, BEST, RIGHT, ROWS_OF, FIRST, SECOND = 0, 1, 2, 3, 4, 5, 6, 7, 8
CONE_ROOM = 9
# Newton steps before sweeps take over, sweeps before Newton steps, and how often.
NEWTON_STEPS, SWEEPS, ROUNDS = 12, 12, 40
# Proximal term as a fraction of a row's own mobility: from a fraction of the relative residual down to what keeps
# elimination far from rounding.
LEAST_PROXIMAL, MOST_PROXIMAL = 1e-11, 1e-6
ROOT_STEPS = 60


@kernel
def solve_cones(W, b, kind, mu, p, f, room, tolerance):
    """Forces f of a contact problem, from f as a start; returns its residual, or NO_SOLUTION.

    The residual is the largest error of a block in the units of u, by the natural map with the block's own mobility w
    (the mean of its diagonal entries): |u| of BOTH_WAYS, |min(w f, u)| of ONE_WAY and of normals, and
    |w f_t − P(w f_t − u_t)| of tangents, P the projection on the disc of radius μ w f_n. It is zero exactly at
    solutions, and nothing in it is regularised. One above ``tolerance`` means that no better f was found.

    Parameters
    ----------
    W, b : (p, p), (p,) or more; need not be symmetric in ONE_WAY columns, and may be of deficient rank
    kind : (p,) int, BOTH_WAYS, ONE_WAY, CONE or TANGENT
    mu : (p,) friction coefficients at the CONE rows
    f : (p,) start, overwritten by the solution or the best that was found
    room : (CONE_ROOM, p, p) or more, scratch
    tolerance : residual that is good enough [units of u]
    """
    best = room[BEST, 0]
    mobilities(W, kind, p, room)
    residual = measure(W, b, kind, mu, p, f, room)
    least = residual
    for k in range(p):
        best[k] = f[k]
    for attempt in range(ROUNDS):
        for _ in range(NEWTON_STEPS):
            # Written so that NaN ends the Newton steps.
            if not residual > tolerance:
                break
            newton_step(W, kind, mu, p, f, residual, b, room)
            residual = measure(W, b, kind, mu, p, f, room)
            if residual < least:
                least = residual
                for k in range(p):
                    best[k] = f[k]
        for k in range(p):
            f[k] = best[k]
        if least <= tolerance:
            return least
        for _ in range(SWEEPS * (1 + attempt)):
            sweep(W, b, kind, mu, p, f, room)
        residual = measure(W, b, kind, mu, p, f, room)
        # A new start even where it is not nearer: Newton steps from the old one have been tried.
        if residual < least or attempt > 0:
            least = residual
            for k in range(p):
                best[k] = f[k]
    return least


@internal_kernel
def mobilities(W, kind, p, room):
    """Own mobility of each block into ``room[MOBILITY, 0]``: the mean of its diagonal entries."""
    mobility = room[MOBILITY, 0]
    largest = 0.0
    for k in range(p):
        largest = max(largest, abs(W[k, k]))
    k = 0
    while k < p:
        size = 3 if kind[k] == CONE else 1
        total = 0.0
        for i in range(size):
            total += abs(W[k + i, k + i])
        # An immobile row has some mobility, so that what is divided by it stays finite.
        total = max(total / size, 1e-14 * largest, 1e-300)
        for i in range(size):
            mobility[k + i] = total
        k += size


@internal_kernel
def measure(W, b, kind, mu, p, f, room):
    """u = W f + b into ``room[MOTION, 0]``; returns the residual."""
    u, mobility = room[MOTION, 0], room[MOBILITY, 0]
    for k in range(p):
        total = b[k]
        for m in range(p):
            total += W[k, m] * f[m]
        u[k] = total
    residual, k = 0.0, 0
    while k < p:
        w = mobility[k]
        if kind[k] == BOTH_WAYS:
            error = abs(u[k])
        else:
            error = abs(min(w * f[k], u[k]))
        # Written so that NaN stays.
        residual = residual if error <= residual else error
        if kind[k] == CONE:
            x, y, radius = w * f[k + 1] - u[k + 1], w * f[k + 2] - u[k + 2], mu[k] * w * max(f[k], 0.0)
            length = math.sqrt(x * x + y * y)
            scale = radius / length if length > radius else 1.0
            x, y = w * f[k + 1] - scale * x, w * f[k + 2] - scale * y
            error = math.sqrt(x * x + y * y)
            residual = residual if error <= residual else error
            k += 3
        else:
            k += 1
    return residual


@internal_kernel
def newton_step(W, kind, mu, p, f, residual, b, room):
    """One step of f by Newton's method, u of f in ``room[MOTION, 0]``.

    Blocks that are off (z_n = w f_n − u_n ≤ 0) get f = 0 and have no unknown. The others have u_n' = 0, and with
    z_t = w f_t − u_t inside the disc of radius μ z_n u_t' = 0. Outside, along d = z_t / |z_t| and e across it,

        d·f_t' = μ f_n',    (1 − β) w e·f_t' + β e·u_t' = 0,    β = μ z_n / |z_t|,

    so that such a block has the unknowns f_n and e·f_t. The rows n, e of the motion and the columns n + μ d, e of the
    force make the matrix. To rows of u' = 0 a proximal term is added.
    """
    u, mobility, A, x = room[MOTION, 0], room[MOBILITY, 0], room[MATRIX], room[RIGHT, 0]
    place, first, second = room[ROWS_OF, 0], room[FIRST, 0], room[SECOND, 0]
    size = 0
    scale = 0.0
    for k in range(p):
        scale = max(scale, abs(b[k]))
    proximal = min(max(1e-3 * residual / scale, LEAST_PROXIMAL), MOST_PROXIMAL) if scale > 0.0 else MOST_PROXIMAL
    # place: 0 off, 1 u' = 0, 2 slides (at its normal row); first, second: direction of sliding; second of e: 1 − β.
    k = 0
    while k < p:
        w = mobility[k]
        if kind[k] == BOTH_WAYS or w * f[k] - u[k] > 0.0:
            place[k] = 1.0
            size += 1
            if kind[k] == CONE:
                normal = w * f[k] - u[k]
                dx, dy = w * f[k + 1] - u[k + 1], w * f[k + 2] - u[k + 2]
                length = math.sqrt(dx * dx + dy * dy)
                if length <= mu[k] * normal:
                    place[k + 1], place[k + 2] = 1.0, 1.0
                    size += 2
                else:
                    place[k] = 2.0
                    first[k], second[k] = dx / length, dy / length
                    first[k + 1] = mu[k] * normal / length
                    if first[k + 1] > 0.0:
                        size += 1
        else:
            place[k] = 0.0
            if kind[k] == CONE:
                place[k + 1], place[k + 2] = 0.0, 0.0
        k += 3 if kind[k] == CONE else 1
    # Rows.
    r, k = 0, 0
    while k < p:
        if place[k] == 0.0:
            k += 3 if kind[k] == CONE else 1
            continue
        if place[k] == 1.0:
            for i in range(3 if kind[k] == CONE else 1):
                # u' = 0: W (f' − ...) in absolute forces: W f' = −b, the proximal term about f.
                fill_row(W, kind, mu, p, k + i, k + i, 1.0, 0.0, place, first, second, A, r)
                A[r, r] += proximal * mobility[k]
                x[r] = -b[k + i] + proximal * mobility[k] * f[k + i]
                r += 1
        else:
            fill_row(W, kind, mu, p, k, k, 1.0, 0.0, place, first, second, A, r)
            A[r, r] += proximal * mobility[k]
            x[r] = -b[k] + proximal * mobility[k] * f[k]
            r += 1
            beta = first[k + 1]
            if beta > 0.0:
                ex, ey = -second[k], first[k]
                fill_row(W, kind, mu, p, k + 1, k + 2, ex, ey, place, first, second, A, r)
                A[r, r] += (1.0 - beta) / beta * mobility[k] + proximal * mobility[k]
                x[r] = -(ex * b[k + 1] + ey * b[k + 2]) + proximal * mobility[k] * (ex * f[k + 1] + ey * f[k + 2])
                r += 1
        k += 3 if kind[k] == CONE else 1
    eliminate(A, x, size)
    r, k = 0, 0
    while k < p:
        if place[k] == 0.0:
            for i in range(3 if kind[k] == CONE else 1):
                f[k + i] = 0.0
        elif place[k] == 1.0:
            for i in range(3 if kind[k] == CONE else 1):
                f[k + i] = x[r]
                r += 1
        else:
            f[k] = x[r]
            across = 0.0
            r += 1
            if first[k + 1] > 0.0:
                across = x[r]
                r += 1
            f[k + 1] = mu[k] * f[k] * first[k] - across * second[k]
            f[k + 2] = mu[k] * f[k] * second[k] + across * first[k]
        k += 3 if kind[k] == CONE else 1


@internal_kernel
def fill_row(W, kind, mu, p, i, j, alpha, beta, place, first, second, A, r):
    """Row r of the Newton matrix: that of the motion alpha u_i + beta u_j, over the unknowns."""
    c, m = 0, 0
    while m < p:
        if place[m] == 1.0:
            for s in range(3 if kind[m] == CONE else 1):
                A[r, c] = alpha * W[i, m + s] + beta * W[j, m + s]
                c += 1
        elif place[m] == 2.0:
            wn = alpha * W[i, m] + beta * W[j, m]
            wx = alpha * W[i, m + 1] + beta * W[j, m + 1]
            wy = alpha * W[i, m + 2] + beta * W[j, m + 2]
            A[r, c] = wn + mu[m] * (first[m] * wx + second[m] * wy)
            c += 1
            if first[m + 1] > 0.0:
                A[r, c] = first[m] * wy - second[m] * wx
                c += 1
        m += 3 if kind[m] == CONE else 1


@internal_kernel
def eliminate(A, x, size):
    """Solve the leading ``size`` rows of A y = x in place, with partial pivoting."""
    for k in range(size):
        best = k
        for i in range(k + 1, size):
            if abs(A[i, k]) > abs(A[best, k]):
                best = i
        if best != k:
            x[k], x[best] = x[best], x[k]
            for j in range(k, size):
                A[k, j], A[best, j] = A[best, j], A[k, j]
        if A[k, k] == 0.0:
            A[k, k] = 1.0
            x[k] = 0.0
            for i in range(k + 1, size):
                A[i, k] = 0.0
            continue
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, size):
            factor = A[i, k] * inverse
            if factor != 0.0:
                for j in range(k + 1, size):
                    A[i, j] -= factor * A[k, j]
                x[i] -= factor * x[k]
    for i in range(size - 1, -1, -1):
        total = x[i]
        for j in range(i + 1, size):
            total -= A[i, j] * x[j]
        x[i] = total / A[i, i]


@internal_kernel
def sweep(W, b, kind, mu, p, f, room):
    """One sweep of block Gauss–Seidel: each block solved exactly with the others' forces as they are."""
    mobility = room[MOBILITY, 0]
    k = 0
    while k < p:
        if kind[k] == CONE:
            n, x, y = b[k], b[k + 1], b[k + 2]
            for m in range(p):
                n += W[k, m] * f[m]
                x += W[k + 1, m] * f[m]
                y += W[k + 2, m] * f[m]
            n -= W[k, k] * f[k] + W[k, k + 1] * f[k + 1] + W[k, k + 2] * f[k + 2]
            x -= W[k + 1, k] * f[k] + W[k + 1, k + 1] * f[k + 1] + W[k + 1, k + 2] * f[k + 2]
            y -= W[k + 2, k] * f[k] + W[k + 2, k + 1] * f[k + 1] + W[k + 2, k + 2] * f[k + 2]
            solve_block(W, k, n, x, y, mu[k], f, 1e-12 * mobility[k])
            k += 3
            continue
        total = b[k]
        for m in range(p):
            total += W[k, m] * f[m]
        new = f[k] - total / max(W[k, k], 1e-12 * mobility[k]) if W[k, k] > 0.0 else 0.0
        f[k] = new if kind[k] == BOTH_WAYS else max(new, 0.0)
        k += 1


@internal_kernel
def solve_block(W, k, n, x, y, mu, f, least):
    """Forces of the block at row k alone, whose motion without them is (n, x, y).

    Off when n ≥ 0. Else u_n = 0 makes f_n = −(n + w·f_t) / W_nn, and what is left is (S + α) f_t = g with the Schur
    complement S of W_nn, g = w n / W_nn − (x, y). It sticks when α = 0 lies in the cone; else α is the root of
    |f_t| − μ f_n, which is positive at 0 and negative far out.
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
    fn, fx, fy, excess = slid(a, c, d, gx, gy, wx, wy, n / normal, mu, 0.0)
    if excess > 0.0:
        low, high, at_low = 0.0, a + d, excess
        at_high = at_low
        for _ in range(200):
            fn, fx, fy, at_high = slid(a, c, d, gx, gy, wx, wy, n / normal, mu, high)
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
            fn, fx, fy, excess = slid(a, c, d, gx, gy, wx, wy, n / normal, mu, middle)
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
def slid(a, c, d, gx, gy, wx, wy, n, mu, alpha):
    """(f_n, f_t, |f_t| − μ f_n) of ((a, c), (c, d)) + α."""
    determinant = (a + alpha) * (d + alpha) - c * c
    fx = ((d + alpha) * gx - c * gy) / determinant
    fy = ((a + alpha) * gy - c * gx) / determinant
    fn = -(n + wx * fx + wy * fy)
    return fn, fx, fy, math.sqrt(fx * fx + fy * fy) - mu * fn
