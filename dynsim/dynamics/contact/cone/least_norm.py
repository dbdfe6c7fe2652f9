"""Selection of indeterminate contact forces: towards least norm, as far as the friction cones allow.

The motion w = W f + b of a contact problem (dynsim.dynamics.contact.cone.problem) is unique, but its forces f are not
where rows depend on each other: four legs of a table, three elbows of a straight arm. On the faces of the cones that
contain f, f = S x; S has a column of length one for each direction in which a force may change:

    n, t1, t2 of a point that sticks (n alone without friction),   n + f_t/f_n of one that slides,   a one-way row

For a point that slides f_t/f_n is −μ w_t/|w_t|, as exactly as the problem is solved. Slip near STILL has another
direction by some percent, and a column along it would leave the difference behind where the rest of f is taken away:
friction without a normal force. Only where there is no force yet, the direction is that of the slip.

There G = Sᵀ W S is singular, and x plus any vector of its null space gives the same motion. The solution of least norm
is the projection of x on the range of G. Where that is outside a cone, f stops on the way to it at the first cone; and
where it would change the motion by more than STILL, before that: an eigenvalue λ that counts as zero may be none, and
forces along its eigenvector give other rows rates of the order of √λ.
"""

from __future__ import annotations

import math

from dynsim.dynamics.contact.cone import problem as kc
from dynsim.dynamics.contact.cone.steps import block_size
from dynsim.jit.kernel import internal_kernel

# Blocks of the scratch ``room``: G, its factor, columns S (coefficients on the rows of their block), then vectors.
MATRIX, FACTOR, COLUMNS, NOW, GOAL, RIGHT, PIVOT, ROW, SIZE = 0, 1, 2, 3, 4, 5, 6, 7, 8
# A row that separates faster than this has no force; slip slower than this has no direction, nor has a force that
# changes the rate of its own row by less [m/s].
STILL = 1e-9
# G is singular if a pivot is below SINGULAR times the mean of its diagonal. The projection adds SHIFT times that mean
# to the diagonal; each refinement multiplies the error by about SHIFT.
SINGULAR, SHIFT, REFINEMENTS = 1e-10, 1e-6, 4
# Bisections of the way to a cone; share of the largest force that may lie outside it.
HALVINGS, ROUNDING = 50, 1e-12


@internal_kernel
def select_least_norm(W, w, kind, mu, p, f, room):
    """Move the forces f, (p,), with the motion w = W f + b towards their least norm. Uses ``room``, (CONE_ROOM, p, p).

    Leaves f as it is where it is unique.
    """
    n = changeable(W, w, kind, mu, p, f, room)
    if n < 2:
        return
    G, L, S, row, size = room[MATRIX], room[FACTOR], room[COLUMNS], room[ROW, 0], room[SIZE, 0]
    now, goal, right = room[NOW, 0], room[GOAL, 0], room[RIGHT, 0]
    trace = 0.0
    for i in range(n):
        a, now[i] = int(row[i]), 0.0
        for k in range(int(size[i])):
            now[i] += S[i, k] * f[a + k]
        for j in range(i + 1):
            b, total = int(row[j]), 0.0
            for k in range(int(size[i])):
                for m in range(int(size[j])):
                    total += S[i, k] * W[a + k, b + m] * S[j, m]
            G[i, j], G[j, i] = total, total
        trace += G[i, i]
    if not trace > 0.0 or factored(G, L, room[PIVOT, 0], n, 0.0, SINGULAR * trace / n):
        return
    shift = SHIFT * trace / n
    factored(G, L, room[PIVOT, 0], n, shift, 0.0)
    # x = (G + ε)⁻¹ G x₀, refined: the error outside the range of G stays zero, that inside falls by ε each time.
    for i in range(n):
        goal[i] = 0.0
    for _ in range(1 + REFINEMENTS):
        for i in range(n):
            right[i] = 0.0
            for j in range(n):
                right[i] += G[i, j] * (now[j] - goal[j])
        substitute(L, room[PIVOT, 0], right, n)
        for i in range(n):
            goal[i] += right[i]
    strongest = 0.0
    for k in range(p):
        strongest = max(strongest, abs(f[k]))
    share = 1.0
    if not inside(mu, n, room, 1.0, ROUNDING * strongest):
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            if inside(mu, n, room, share, ROUNDING * strongest):
                low = share
            else:
                high = share
        share = low
    step = room[PIVOT, 0]
    for r in range(p):
        step[r] = 0.0
    for i in range(n):
        a = int(row[i])
        for k in range(int(size[i])):
            step[a + k] += share * (goal[i] - now[i]) * S[i, k]
    change = 0.0
    for r in range(p):
        total = 0.0
        for k in range(p):
            total += W[r, k] * step[k]
        change = max(change, abs(total))
    part = 1.0 if change <= STILL else STILL / change
    for r in range(p):
        f[r] += part * step[r]


@internal_kernel
def changeable(W, w, kind, mu, p, f, room):
    """The columns S of the rows whose forces may change: coefficients, first row and size; returns their number."""
    S, row, size = room[COLUMNS], room[ROW, 0], room[SIZE, 0]
    n, k = 0, 0
    while k < p:
        if kind[k] == kc.CONE and w[k] <= STILL:
            slip = math.sqrt(w[k + 1] * w[k + 1] + w[k + 2] * w[k + 2])
            if mu[k] > 0.0 and slip > STILL:
                x, y = sliding_share(W, w, mu, f, k, slip)
                scale = 1.0 / math.sqrt(1.0 + x * x + y * y)
                row[n], size[n], S[n, 0], S[n, 1], S[n, 2] = k, 3.0, scale, scale * x, scale * y
                n += 1
            else:
                for m in range(3 if mu[k] > 0.0 else 1):
                    row[n], size[n], S[n, 0] = k + m, 1.0, 1.0
                    n += 1
        elif kind[k] == kc.ONE_WAY and w[k] <= STILL:
            row[n], size[n], S[n, 0] = k, 1.0, 1.0
            n += 1
        k += block_size(kind, k)
    return n


@internal_kernel
def sliding_share(W, w, mu, f, k, slip):
    """Friction per normal force, (x, y), of the point with first row k that slides at ``slip``: within its cone."""
    if f[k] * W[k, k] <= STILL:
        return -mu[k] * w[k + 1] / slip, -mu[k] * w[k + 2] / slip
    x, y = f[k + 1] / f[k], f[k + 2] / f[k]
    size = math.sqrt(x * x + y * y)
    part = mu[k] / size if size > mu[k] else 1.0
    return part * x, part * y


@internal_kernel
def factored(G, L, pivot, n, shift, least):
    """G + ``shift`` = L D Lᵀ, (n, n), D into ``pivot``; False where a pivot is not above ``least``."""
    for j in range(n):
        d = G[j, j] + shift
        for k in range(j):
            d -= L[j, k] * L[j, k] * pivot[k]
        pivot[j] = d
        if not d > least:
            return False
        for i in range(j + 1, n):
            total = G[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k] * pivot[k]
            L[i, j] = total / d
    return True


@internal_kernel
def substitute(L, pivot, x, n):
    """x ← (L D Lᵀ)⁻¹ x."""
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
    for i in range(n - 1, -1, -1):
        x[i] /= pivot[i]
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]


@internal_kernel
def inside(mu, n, room, share, slack):
    """True when the forces ``share`` of the way from NOW to GOAL lie in their cones."""
    now, goal, row, size = room[NOW, 0], room[GOAL, 0], room[ROW, 0], room[SIZE, 0]
    i = 0
    while i < n:
        normal = now[i] + share * (goal[i] - now[i])
        if normal < -slack:
            return False
        # Three columns of one row each, in a row: a point that sticks.
        sticks = size[i] == 1.0 and i + 2 < n and row[i + 1] == row[i] + 1.0 and mu[int(row[i])] > 0.0
        if sticks:
            x = now[i + 1] + share * (goal[i + 1] - now[i + 1])
            y = now[i + 2] + share * (goal[i + 2] - now[i + 2])
            if math.sqrt(x * x + y * y) > mu[int(row[i])] * normal + slack:
                return False
            i += 2
        i += 1
    return True
