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
and Engineering 92, 1991), started from the caller's last forces. Where it does not converge, it alternates with sweeps
of block Gauss–Seidel (each block solved exactly) and with scattered starts. The last resort is a homotopy from nearly
decoupled blocks to the problem. A proximal term keeps Newton's matrix regular when rows depend on each other; it does
not change the solution.
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

__all__ = ["BOTH_WAYS", "BOX", "CONE", "CONE_ROOM", "NO_SOLUTION", "ONE_WAY", "TANGENT", "approach", "solve_cones"]

# What ``solve_cones`` returns instead of a residual when it has proved that there is no solution.
NO_SOLUTION = -1.0

# Newton's steps from one start; of these the first go all the way, the others only as far as they come nearer.
NEWTON_STEPS, FULL_STEPS, HALVINGS = 20, 6, 8
# Starts in all, sweeps that come before a start times its number, and where that number starts anew.
ROUNDS, SWEEPS, SWEPT_ROUNDS = 200, 10, 40
# Of paths: how many, steps of one, starts at each.
PATHS, PATH_STEPS, PATH_ROUNDS = 40, 150, 8
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
    residual = approach(W, b, kind, mu, p, f, room, tolerance, PATH_ROUNDS)
    if residual <= tolerance:
        return residual
    if impossible(W, b, kind, mu, p, room):
        return NO_SOLUTION
    residual = approach(W, b, kind, mu, p, f, room, tolerance, ROUNDS)
    if residual <= tolerance:
        return residual
    for attempt in range(PATHS):
        residual = follow_path(W, b, kind, mu, p, f, room, tolerance, attempt)
        if residual <= tolerance:
            break
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
def follow_path(W, b, kind, mu, p, f, room, tolerance, attempt):
    """Follow the solution of (W + ε w) f + b − ε w a = 0, cones as before, from ε = 1 to none.

    At first blocks hardly feel each other. Each ``attempt`` has its own anchor a, and so another path; steps of ε grow
    while the solution can be followed and shrink where it cannot. Leaves f as it was when the end is no nearer.
    """
    shifted, right, mobility = room[SHIFTED], room[SHIFTED_RIGHT, 0], room[MOBILITY, 0]
    kept, last, anchor = room[KEPT, 0], room[LAST, 0], room[ANCHOR, 0]
    mobilities(W, kind, p, room)
    least, _ = measure(W, b, kind, mu, p, f, room)
    scale = 0.0
    for k in range(p):
        kept[k] = f[k]
        scale = max(scale, abs(b[k]))
    scatter(mobility, p, anchor, attempt * scale, attempt)
    for k in range(p):
        if kind[k] == CONE or kind[k] == ONE_WAY:
            anchor[k] = abs(anchor[k])
        f[k], last[k] = anchor[k], anchor[k]
    epsilon, factor = 1.0, 0.3
    for _ in range(PATH_STEPS):
        mobilities(W, kind, p, room)
        shift(W, b, p, room, epsilon)
        shifted_residual = approach(shifted, right, kind, mu, p, f, room, max(tolerance, 1e-9 * scale), PATH_ROUNDS)
        if shifted_residual <= 1e-6 * scale:
            for k in range(p):
                last[k] = f[k]
            if epsilon <= 1e-11:
                break
            factor = max(0.5 * factor, 0.01)
        else:
            for k in range(p):
                f[k] = last[k]
            epsilon /= factor
            factor = math.sqrt(factor)
            if factor > 0.98:
                break
        epsilon *= factor
    residual = approach(W, b, kind, mu, p, f, room, tolerance, ROUNDS)
    if not residual < least:
        residual = least
        for k in range(p):
            f[k] = kept[k]
    return residual


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
        approach(room[SHIFTED], right, kind, none, p, proof, room, 1e-9 * scale, PATH_ROUNDS)
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
