"""Solver of the contact problem: bilateral and unilateral rows, Coulomb cones and dry joint friction, unsmoothed.

Find f with u = W f + b (forces and accelerations, or impulses and velocities) such that every row or block of rows has

    BOTH_WAYS    u = 0
    ONE_WAY      0 ≤ f ⟂ u ≥ 0
    CONE         0 ≤ f_n ⟂ u_n ≥ 0,  |f_t| ≤ μ f_n,  u_t = −λ f_t with λ ≥ 0, and λ = 0 inside the cone
    BOX          |f| ≤ μ,  u = −λ f with λ ≥ 0, and λ = 0 within the bounds: dry friction of a joint

A CONE row is followed by its two TANGENT rows. Friction is not associated: u_n has no term μ |u_t|. A compliant row,
u = W f + b + ε f, has ε added to its diagonal entry of W. Bounds other than ±μ are shifted by their mean f_m: the
unknown is f − f_m, and W f_m is added to b.

The method is a semismooth Newton method on the natural map of Alart and Curnier (Computer Methods in Applied Mechanics
and Engineering 92, 1991), started from the caller's last forces. A proximal term keeps Newton's matrix regular when
rows depend on each other; it does not change the solution. With W of deficient rank Newton's method may cycle among
active sets. Then the proximal-point method (Rockafellar, SIAM Journal on Control and Optimization 14, 1976) solves a
sequence of regular problems instead. The last resort is sweeps of block Gauss–Seidel (each block solved exactly) and
scattered starts: with strong friction the map is not monotone, and the sequence may end elsewhere.
"""

from __future__ import annotations

import math

from dynsim.dynamics.contact.cone.steps import (
    ANCHOR,
    BEST,
    BOTH_WAYS,
    BOX,
    CONE,
    CONE_ROOM,
    GOAL,
    KEPT,
    LAST,
    MOBILITY,
    NO_FRICTION,
    ONE_WAY,
    PROOF,
    SHIFTED,
    SHIFTED_RIGHT,
    START,
    SWEPT,
    TANGENT,
    block_size,
    measure,
    mobilities,
    newton_step,
    sweep,
)
from dynsim.jit.kernel import internal_kernel, kernel

__all__ = [
    "BOTH_WAYS",
    "BOX",
    "CONE",
    "CONE_ROOM",
    "NO_SOLUTION",
    "ONE_WAY",
    "TANGENT",
    "approach",
    "approach_or_draw_near",
    "draw_near",
    "solve_cones",
]

# What ``solve_cones`` returns instead of a residual when it has proved that there is no solution.
NO_SOLUTION = -1.0

# Newton's steps from one start; of these the first go all the way, the others only as far as they come nearer.
NEWTON_STEPS, FULL_STEPS, HALVINGS = 20, 6, 8
# Starts in all, sweeps that come before a start times its number, and where that number starts anew.
ROUNDS, SWEEPS, SWEPT_ROUNDS = 200, 10, 40
# Starts before a proof is tried, and of each problem of the proof.
FEW_ROUNDS = 8
# Proximal-point method: number of steps, first and least ε.
NEAR_STEPS, FIRST_EPSILON, LEAST_EPSILON = 60, 1e-3, 1e-9
# A proof holds for all forces up to this times |b| / mobility; its problem is regularised by the second number.
PROVED_FORCE, PROOF_SHIFT, PROOF_STEPS = 1e6, 1e-6, 4


@kernel
def solve_cones(W, b, kind, mu, p, f, room, tolerance):
    """Forces f of a contact problem, from f as a start; returns its residual, or NO_SOLUTION.

    The residual is the largest error of a block in the units of u, by the natural map with the block's own mobility w
    (the mean of its diagonal entries): |u| of BOTH_WAYS, |min(w f, u)| of ONE_WAY and of normals, and
    |w f_t − P(w f_t − u_t)| of tangents, P the projection on the disc of radius μ w f_n; the same of BOX rows, with
    that on ±μ w. It is zero exactly at solutions, and nothing in it is regularised. One above ``tolerance`` means that
    no better f was found.

    Parameters
    ----------
    W, b : (p, p), (p,) or more; need not be symmetric in ONE_WAY columns, and may be of deficient rank
    kind : (p,) int, BOTH_WAYS, ONE_WAY, CONE, TANGENT or BOX
    mu : (p,) friction coefficients at the CONE rows, bounds of the forces at BOX rows, which may be infinite
    f : (p,) start, overwritten by the solution or the best that was found
    room : (CONE_ROOM, p, p) or more, scratch
    tolerance : residual that is good enough [units of u]
    """
    if p == 0:  # of a system that nothing can touch, there is no room either
        return 0.0
    residual = approach_or_draw_near(W, b, kind, mu, p, f, room, tolerance, FEW_ROUNDS)
    if residual <= tolerance:
        return residual
    if impossible(W, b, kind, mu, p, room):
        return NO_SOLUTION
    return approach(W, b, kind, mu, p, f, room, tolerance, ROUNDS)


@internal_kernel
def approach_or_draw_near(W, b, kind, mu, p, f, room, tolerance, rounds):
    """:func:`solve_cones` without a proof: one start, then :func:`draw_near`, then up to ``rounds`` starts."""
    residual = approach(W, b, kind, mu, p, f, room, tolerance, 1)
    if not residual <= tolerance:
        residual = draw_near(W, b, kind, mu, p, f, room, tolerance)
    if not residual <= tolerance:
        residual = approach(W, b, kind, mu, p, f, room, tolerance, rounds)
    return residual


@internal_kernel
def approach(W, b, kind, mu, p, f, room, tolerance, rounds):
    """:func:`solve_cones` by Newton's method from so many starts: the first is f, then swept and scattered ones."""
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
                for k in range(p):
                    f[k] = swept[k]
            for _ in range(SWEEPS * (attempt if attempt <= SWEPT_ROUNDS else attempt % SWEEPS)):
                sweep(W, b, kind, mu, p, f, room)
            if not scattered:
                for k in range(p):
                    swept[k] = f[k]
            residual, merit = measure(W, b, kind, mu, p, f, room)
        # What is too weak for some problems is too strong for others.
        most = 1e-6 if attempt % 6 < 2 else 1e-3 if attempt % 6 < 4 else 1e-9
        for step in range(NEWTON_STEPS + 1):
            # Written so that NaN is never the best.
            if residual < least:
                least = residual
                for k in range(p):
                    best[k] = f[k]
            if not residual > tolerance or step == NEWTON_STEPS:
                break
            relative = residual / scale if scale > 0.0 else 1.0
            residual, merit = damped_step(W, b, kind, mu, p, f, room, relative, most, merit, step >= FULL_STEPS)
        if least <= tolerance:
            break
    for k in range(p):
        f[k] = best[k]
    return least


@internal_kernel
def damped_step(W, b, kind, mu, p, f, room, relative, most, before, damped):
    """One Newton step, which if ``damped`` is halved until the merit falls; returns residual and merit there."""
    start, goal = room[START, 0], room[GOAL, 0]
    for k in range(p):
        start[k] = f[k]
    newton_step(W, b, kind, mu, p, f, room, relative, most)
    residual, merit = measure(W, b, kind, mu, p, f, room)
    if not damped or merit < before:
        return residual, merit
    for k in range(p):
        goal[k] = f[k]
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
    """A start of so large forces times mobility, without pattern, and the same in every run."""
    for k in range(p):
        f[k] = size / mobility[k] * math.sin(12.9898 * (k + 1) * attempt)


@internal_kernel
def shift(W, b, p, room, epsilon):
    """W + ε w and b − ε w a of the anchor a into ``room[SHIFTED]``, ``room[SHIFTED_RIGHT, 0]``."""
    shifted, right, mobility, anchor = room[SHIFTED], room[SHIFTED_RIGHT, 0], room[MOBILITY, 0], room[ANCHOR, 0]
    for k in range(p):
        for m in range(p):
            shifted[k, m] = W[k, m]
        shifted[k, k] += epsilon * mobility[k]
        right[k] = b[k] - epsilon * mobility[k] * anchor[k]


@internal_kernel
def draw_near(W, b, kind, mu, p, f, room, tolerance):
    """Solve (W + ε w) f' + b − ε w f = 0, cones as before, again and again (proximal point); returns the residual.

    A fixed point solves the problem itself, whatever ε is; if forces are not unique, they stay near the start f. As
    W + ε w is regular, each of these problems takes few Newton steps. ε falls after a solved
    problem and grows after an unsolved one. Leaves the best f.
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
        left = approach(shifted, right, kind, mu, p, f, room, inner, 1)
        # ``approach`` has left those of the shifted problem.
        mobilities(W, kind, p, room)
        residual, _ = measure(W, b, kind, mu, p, f, room)
        if residual < least:
            least = residual
            for k in range(p):
                kept[k] = f[k]
        if least <= tolerance:
            break
        solved = left <= 0.1 * residual + inner
        for k in range(p):
            if solved:
                anchor[k] = f[k]
            else:
                f[k] = anchor[k]
        epsilon = max(0.3 * epsilon, LEAST_EPSILON) if solved else min(10.0 * epsilon, 1.0)
    for k in range(p):
        f[k] = kept[k]
    return least


@internal_kernel
def impossible(W, b, kind, mu, p, room):
    """True when it is proved that no forces up to PROVED_FORCE |b| / w solve the problem.

    The proof is a combination d of motions, of any sign for BOTH_WAYS rows, not negative for ONE_WAY rows and normals,
    zero for tangents and BOX rows. A solution has d·u ≥ 0; but d·u = (Wᵀd)·f + d·b, which is negative when d·b is, and
    no force that is allowed makes (Wᵀd)·f positive: bodies that close in on each other from all sides. Such a d is what
    is left of motion, −ε w f, when the problem without friction is solved with ε w added to W.
    """
    proof, none, scale = room[PROOF, 0], room[NO_FRICTION, 0], 0.0
    right, mobility = room[SHIFTED_RIGHT, 0], room[MOBILITY, 0]
    for k in range(p):
        proof[k], none[k], room[ANCHOR, 0, k], scale = 0.0, 0.0, 0.0, max(scale, abs(b[k]))
    mobilities(W, kind, p, room)
    shift(W, b, p, room, PROOF_SHIFT)
    # What is left of what is left: each time a millionth of what forces can move.
    for _ in range(PROOF_STEPS):
        approach(room[SHIFTED], right, kind, none, p, proof, room, 1e-9 * scale, FEW_ROUNDS)
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
