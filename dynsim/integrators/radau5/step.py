"""One step of RADAU5 (Radau IIA, order 5, three stages) by simplified Newton with eliminated circuits and positions.

The stages are Z_i = h Σ a_ij f(t + c_j h, y + Z_j), and y_new = y + Z_3 (Hairer, Wanner: Solving Ordinary Differential
Equations II, IV.8). With W = T⁻¹ Z, the linear systems of Newton's method decouple into a real and a complex system of
the size of the state, g I − J with g = γ/h or (α + iβ)/h, and each of these reduces to a system of the size of the
rates. In

    q̇ = N v,    v̇ = f(q, v, i),    di/dt = a q + b v + c i + …

the first and the last rows are eliminated, u_q = (r_q + N u_v)/g and u_i = (r_i + a u_q + b u_v)/(g − c), which gives

    (g − ∂f/∂v − ∂f/∂θ/g − ∂f/∂i (a/g + b)/(g − c)) u_v = r_v + ∂f/∂θ N⁺ r_q/g + ∂f/∂i (r_i + a r_q/g)/(g − c),

where θ are displacements along the rates. The Jacobian neglects the change of N with q: if bodies rotate in space,
Newton's method converges more slowly, but to the same solution. The Jacobian and the factors are kept as long as
Newton's method converges.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.delassus import clearly_unique
from dynsim.dynamics.contact.rows import slip_speed
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.drive.law import drive_block, segment_of
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import displace, positions_along, rates_across
from dynsim.integrators import run as ki
from dynsim.integrators.events import note_inside
from dynsim.integrators.radau5 import tables as kn
from dynsim.integrators.radau5.tables import (
    A_RADAU,
    ALPHA_RADAU,
    BETA_RADAU,
    ERROR_RADAU,
    GAMMA_RADAU,
    NODE_RADAU,
    T_INVERSE_RADAU,
    T_RADAU,
    NewtonArrays,
)
from dynsim.integrators.run import Run, forces_unique, off_surface, settle, watch
from dynsim.integrators.simd.forms import StageLanes
from dynsim.integrators.steps import energy_norm, error_norm
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Linear systems of RADAU5's Newton method, reduced to the rates: a real and a complex system, solved together.


@internal_kernel
def factor_both(system: System, r: NewtonArrays, h):
    """Invert both reduced matrices, from ``r.along`` and ``r.linear``, for steps of length h."""
    reduced_inverse(system, r, GAMMA_RADAU / h, r.real_inverse)
    reduced_inverse(system, r, complex(ALPHA_RADAU / h, BETA_RADAU / h), r.complex_inverse)


@internal_kernel
def solve_both(system: System, ws: Workspace, y, r: NewtonArrays, h):
    """Replace the right-hand sides ``r.one`` (real) and ``r.two`` (complex), (s,), by solutions, see `factor_both`."""
    solve_newton(system, y, r, GAMMA_RADAU / h, r.real_inverse, r.one, r.real_room)
    solve_newton(system, y, r, complex(ALPHA_RADAU / h, BETA_RADAU / h), r.complex_inverse, r.two, r.complex_room)


@internal_kernel
def reduced_inverse(system: System, r: NewtonArrays, g, A):
    """Write the inverse of the reduced matrix for g, real or complex, to A (n, n), by Gauss–Jordan elimination."""
    along, block, table, pivot = r.along, r.linear, system.drives.table, r.pivot
    n = A.shape[0]
    first = 2 * n  # first row of the circuits
    for i in range(n):
        for j in range(n):
            A[i, j] = -along[j, i] / g - along[n + j, i]
        A[i, i] += g
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            gain = (block[a, ka.RATE_Q] / g + block[a, ka.RATE_V]) / (g - block[a, ka.RATE_I])
            for i in range(n):
                A[i, j] -= along[first + k, i] * gain
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[best, k]):
                best = i
        pivot[k] = best
        for j in range(n):
            A[k, j], A[best, j] = A[best, j], A[k, j]
        scale = 1.0 / A[k, k]
        A[k, k] = 1.0
        for j in range(n):
            A[k, j] *= scale
        for i in range(n):
            if i != k:
                factor = A[i, k]
                A[i, k] = 0.0
                for j in range(n):
                    A[i, j] -= factor * A[k, j]
    for k in range(n - 1, -1, -1):
        best = pivot[k]
        for i in range(n):
            A[i, k], A[i, best] = A[i, best], A[i, k]


@internal_kernel
def solve_newton(system: System, y, r: NewtonArrays, g, A, x, room):
    """Replace x (s,) by (g I − J)⁻¹ x, using the inverse A of the reduced matrix; ``room`` (2, s) is scratch."""
    along, block, table, layout = r.along, r.linear, system.drives.table, system.layout
    n, q, v, current, angle, u = A.shape[0], layout.q, layout.v, layout.current, room[0], room[1]
    first = 2 * n  # first row of the circuits
    if layout.extra > 0:
        rates_across(system.model, y, q, x, angle)
    for i in range(n):
        angle[i] = (angle[i] if layout.extra > 0 else x[q + i]) / g
        u[i] = x[v + i]
    for j in range(n):
        for i in range(n):
            u[i] += along[j, i] * angle[j]
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            free = (x[current + k] + block[a, ka.RATE_Q] * angle[j]) / (g - block[a, ka.RATE_I])
            for i in range(n):
                u[i] += along[first + k, i] * free
    for i in range(n):
        total = 0.0 * u[i]
        for j in range(n):
            total += A[i, j] * u[j]
        x[v + i] = total
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            rate = x[v + j]
            pull = block[a, ka.RATE_Q] * (angle[j] + rate / g) + block[a, ka.RATE_V] * rate
            x[current + k] = (x[current + k] + pull) / (g - block[a, ka.RATE_I])
    if layout.extra == 0:
        for i in range(n):
            x[q + i] = angle[i] + x[v + i] / g
    else:
        for i in range(n):
            u[i] = x[v + i]
        positions_along(system.model, y, q, u, x)
        for j in range(q, q + n + layout.extra):
            x[j] = x[j] / g


# End of a RADAU5 step: derivative, constraint and uniqueness checks, and samples on SIMD lanes.


@internal_kernel
def evaluate_end(newton: NewtonArrays, system: System, ws: Workspace, run: Run):
    """Evaluate the derivatives at the three stages into ``f``, and copy the last one, at y_new, into stage[6].

    The order matters: entries that no derivative writes are zero in ``f`` but scratch in stage[6].
    """
    for s in range(2):
        for j in range(newton.kept.shape[1]):
            run.stage[7, j] = run.y[j] + newton.z[s, j]
        derivative(system, run.clock[ki.TIME] + kn.NODE_RADAU[s] * run.clock[ki.STEP], run.stage[7], ws, newton.f[s])
        if run.event.shape[0] > 0:
            note_inside(system, ws, run, s, kn.NODE_RADAU[s])
    derivative(system, run.clock[ki.TIME] + run.clock[ki.STEP], run.y_new, ws, newton.f[2])
    for j in range(run.y.shape[0]):
        run.stage[6, j] = newton.f[2, j]
    run.count[ki.EVALUATIONS] += 3


@internal_kernel
def end_workspace(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """Return the workspace of the end of the step just taken."""
    return ws


@internal_kernel
def end_accepted(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """Project y_new if it is off the constraints, and check the forces; on failure, set STATUS and return False."""
    return end_settled(system, ws, run, off_surface(ws)) and end_watched(system, ws, run)


@internal_kernel
def end_settled(system: System, ws: Workspace, run: Run, off):
    """Return whether y_new is on the constraints; if it was ``off``, first project it and evaluate ``ws`` there."""
    if not off or settle(system, run.clock[ki.TIME] + run.clock[ki.STEP], run.y_new, ws, run.stage[6], run):
        return True
    run.count[ki.STATUS] = ki.NOT_PROJECTED
    return False


@internal_kernel
def end_watched(system: System, ws: Workspace, run: Run):
    """Return whether the forces at y_new are unique; ``ws`` must be the result of ``derivative`` at y_new."""
    h = run.clock[ki.STEP]
    if not (clearly_unique(ws) or forces_unique(system, ws, run, run.clock[ki.TIME] + h)):
        return False
    watch(ws, run, h)
    return True


# Newton's method: maximum number of iterations, and contraction below which the Jacobian is kept.
MOST_ITERATIONS, GOOD_CONTRACTION = 8, 0.05
# In steps shorter than SHORT [s], errors of rates and currents near zero are weighted by their effect until the end of
# the step. This slack is smaller if rtol is below SLACK_RTOL, because then all steps are short.
SHORT, SLACK_RTOL = 0.005, 1e-6
# Change of rates for finite differences, as a fraction of the slowest slip; its square is the rounding error of slip at
# 1e-7 m/s.
SMALL = 1e-4
# Error norm assigned to a step whose Newton iteration diverges; half of the step is then tried next.
NO_STAGES = 10.5


@noinline_kernel
def differentiate(system: System, ws: Workspace, run: Run):
    """Compute finite differences of v̇ with respect to displacements along the rates, rates and currents, at (TIME, y).

    The stiff electrical rows are computed from the drives instead; v̇ is linear in the currents.
    """
    t, y, x, base, r = run.clock[ki.TIME], run.y, run.stage[6], run.stage[7], run.newton
    # The workspace may still contain a sample or a rejected step.
    derivative(system, t, y, ws, base)
    for a in range(ws.motors.shape[0]):
        drive_block(system.drives, ws, a, segment_of(system.drives, system.reference, t, ws, a), r.linear[a])
    r.clock[kn.CHANGE] = largest_change(system.unilateral, ws)
    columns(r.lanes, system, ws, t, y, x, base, r)
    run.count[ki.EVALUATIONS] += r.along.shape[0] + 1
    r.count[kn.JACOBIANS] += 1
    r.count[kn.STALE], r.count[kn.MADE_AT], r.clock[kn.FACTORED] = 0, run.count[ki.STEPS], 0.0
    # The contraction of Newton's method with the new Jacobian is not known yet.
    r.clock[kn.CONTRACTION] = 0.0


@internal_kernel
def largest_change(unilateral: UnilateralArrays | None, ws: Workspace):
    """Return the largest change of rates for finite differences [rad/s or m/s]; call right after ``derivative``.

    A change δ along and across a slip v turns its friction, and the differences have a relative error of δ/2v in
    directions in which friction does not change. If friction turns within a time τ, with the rate 1/τ, Newton's method
    then diverges for steps longer than about 2v/δ τ. For a point that slides slowly, the change is SMALL times its
    slip, which is far above rounding.
    """
    change = math.inf
    if unilateral is None:  # resolved at compile time
        return change
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, ka.MODE] == ka.SLIDING:
            change = min(change, SMALL * max(slip_speed(ws, k), unilateral.number[ku.SLOW]))
    return change


@internal_kernel
def displaced(system: System, ws: Workspace, y, s, x, change):
    """Write x = y with entry s changed; s counts the displacements along the rates, then the rates, then the currents.

    ``change`` limits changes of rates. Returns the change of the entry.
    """
    n, layout = ws.joints.shape[0], system.layout
    for j in range(y.shape[0]):
        x[j] = y[j]
    if s < n and layout.extra > 0:
        for i in range(n):
            ws.joints[i, ka.QDD] = 1e-7 if i == s else 0.0
        displace(system.model, ws, x, layout.q)
        return 1e-7
    j = layout.q + s if s < n else layout.v + s - n if s < 2 * n else layout.current + s - 2 * n
    rate = min(1e-8 * max(abs(y[j]), 0.1), change)
    delta = 1e-3 if s >= 2 * n else rate if s >= n else 1e-7 * max(abs(y[j]), 1.0)
    x[j] = y[j] + delta
    return x[j] - y[j]


@internal_kernel
def columns(lanes: StageLanes | None, system: System, ws: Workspace, t, y, x, base, r: NewtonArrays):
    """Write finite differences of v̇ into ``r.along``; ``base`` is the derivative at y, x (m,) is scratch."""
    v = system.layout.v
    for s in range(r.along.shape[0]):
        delta = displaced(system, ws, y, s, x, r.clock[kn.CHANGE])
        derivative(system, t, x, ws, r.f[0])
        r.count[kn.COLUMNS] += 1
        for i in range(r.along.shape[1]):
            r.along[s, i] = (r.f[0, v + i] - base[v + i]) / delta


@internal_kernel
def evaluate_stages(lanes: StageLanes | None, system: System, ws: Workspace, t, h, y, x, r: NewtonArrays):
    """Evaluate the derivatives at the stages into ``r.f``; x (m,) is scratch."""
    for s in range(3):
        for j in range(r.kept.shape[1]):
            x[j] = y[j] + r.z[s, j]
        derivative(system, t + NODE_RADAU[s] * h, x, ws, r.f[s])


@internal_kernel
def keep_stages(run: Run):
    """Save the stages of the last accepted step, as a polynomial for the next initial guess, and their error."""
    r, c0, c1 = run.newton, NODE_RADAU[0], NODE_RADAU[1]
    if r.count[kn.SEEN] == run.count[ki.STEPS]:
        return
    r.count[kn.SEEN], r.count[kn.EXTRAPOLATES], r.clock[kn.KEPT] = run.count[ki.STEPS], 1, r.clock[kn.TRIED]
    for j in range(r.kept.shape[1]):
        z0, z1, z2 = r.z[0, j], r.z[1, j], r.z[2, j]
        slope, middle = (z1 - z2) / (c1 - 1.0), (z0 - z1) / (c0 - c1)
        bend = (middle - slope) / (c0 - 1.0)
        r.kept[0, j], r.kept[1, j], r.kept[2, j] = slope, bend, bend - (middle - z0 / c0) / c1
        r.kept[3, j] = r.error[j]


@internal_kernel
def collocation_error(x):
    """Return P(x) = ∫ Π (s − c_i) ds from 0 to x; c_3 = 1 is a double root."""
    return x * (x - 1.0) * (x - 1.0) * (0.25 * x - 0.1)


@internal_kernel
def guess_stages(run: Run, h):
    """Guess the stages by extrapolating those of the last step, corrected for the errors of both steps.

    The stages are of order 3. With P(x) = ∫ Π (s − c_i) ds from 0 to x and D = h⁴ y⁗/6, the collocation polynomial of
    the last step is y − D P(x), with x = 1 + c ρ in the next step, which is ρ times as long and has the stages
    y − ρ⁴ D P(c). The error estimate of the last step was −D/(10 γ), so its stages give the next stages up to h⁵.
    """
    r, c0, c1 = run.newton, NODE_RADAU[0], NODE_RADAU[1]
    ahead = h / r.clock[kn.KEPT] if r.count[kn.EXTRAPOLATES] == 1 else 0.0
    for s in range(3):
        x = NODE_RADAU[s] * ahead
        more = -10.0 * GAMMA_RADAU * (collocation_error(1.0 + x) - ahead**4 * collocation_error(NODE_RADAU[s]))
        for j in range(r.kept.shape[1]):
            r.z[s, j] = x * (r.kept[0, j] + (x - (c1 - 1.0)) * (r.kept[1, j] + (x - (c0 - 1.0)) * r.kept[2, j]))
            r.z[s, j] += more * r.kept[3, j]
    for j in range(r.kept.shape[1]):
        for s in range(3):
            r.w[s, j] = (
                T_INVERSE_RADAU[s, 0] * r.z[0, j]
                + T_INVERSE_RADAU[s, 1] * r.z[1, j]
                + T_INVERSE_RADAU[s, 2] * r.z[2, j]
            )


@noinline_kernel
def solve_stages(system: System, ws: Workspace, run: Run, h):
    """Solve for the stages of a step of length h by Newton's method; return whether it has converged."""
    t, y, x, r = run.clock[ki.TIME], run.y, run.y_new, run.newton
    tracked, before, contraction = r.kept.shape[1], 0.0, 0.0
    g, c = GAMMA_RADAU / h, complex(ALPHA_RADAU / h, BETA_RADAU / h)
    guess_stages(run, h)
    lever, least = max(r.clock[kn.LEVER], 1e-16) ** 0.8, 1 - r.count[kn.EXTRAPOLATES]
    for k in range(MOST_ITERATIONS):
        evaluate_stages(r.lanes, system, ws, t, h, y, x, r)
        run.count[ki.EVALUATIONS] += 3
        r.count[kn.ITERATIONS] += 1
        for j in range(tracked):
            f0, f1, f2 = r.f[0, j], r.f[1, j], r.f[2, j]
            r.one[j] = T_INVERSE_RADAU[0, 0] * f0 + T_INVERSE_RADAU[0, 1] * f1 + T_INVERSE_RADAU[0, 2] * f2
            r.one[j] -= g * r.w[0, j]
            r.two[j] = complex(
                T_INVERSE_RADAU[1, 0] * f0 + T_INVERSE_RADAU[1, 1] * f1 + T_INVERSE_RADAU[1, 2] * f2,
                T_INVERSE_RADAU[2, 0] * f0 + T_INVERSE_RADAU[2, 1] * f1 + T_INVERSE_RADAU[2, 2] * f2,
            ) - c * complex(r.w[1, j], r.w[2, j])
        solve_both(system, ws, y, r, h)
        total = 0.0
        for j in range(tracked):
            d0, d1, d2 = r.one[j], r.two[j].real, r.two[j].imag
            total += (d0 * d0 + d1 * d1 + d2 * d2) * r.weight[j] * r.weight[j]
        change = math.sqrt(total / (3 * tracked))
        if not change < 1e30:
            return False
        if k > 0:
            ratio = change / before
            contraction = ratio if k == 1 else math.sqrt(ratio * contraction)
            if contraction >= 0.99:
                return False
            lever = contraction / (1.0 - contraction)
            if lever * change * contraction ** (MOST_ITERATIONS - 2 - k) >= r.clock[kn.CLOSE]:
                return False
            r.clock[kn.CONTRACTION] = contraction
        before = max(change, 1e-16)
        for j in range(tracked):
            r.w[0, j] += r.one[j]
            r.w[1, j] += r.two[j].real
            r.w[2, j] += r.two[j].imag
            for s in range(3):
                r.z[s, j] = T_RADAU[s, 0] * r.w[0, j] + T_RADAU[s, 1] * r.w[1, j] + T_RADAU[s, 2] * r.w[2, j]
        # The ledger sums the derivatives of the last iterate but one, so steps without a guess do one more iteration.
        if lever * change <= r.clock[kn.CLOSE] and k >= least:
            r.clock[kn.LEVER] = lever
            return True
    return False


@internal_kernel
def slack(system: System, h, rtol):
    """Return the factor by which atol is multiplied for rates and currents in a step of length h.

    An error e of a rate moves a joint by h e within the step. Circuits that ring after a start do so for milliseconds,
    in steps of 0.1 ms. There, an error of 50 atol in a rate moves its joint no further than an error of atol in a step
    of 5 ms, and motors damp this error. Without motors the error would persist. Its effect on impacts would also
    persist for a while, and steps after impacts are even shorter. For an rtol below 1e-6, the slack is therefore
    smaller, and at 1e-8 almost no slack remains.
    """
    if system.layout.circuits == 0:
        return 1.0
    return max(1.0, SHORT / h * min(rtol / SLACK_RTOL, 1.0) ** 2)


@internal_kernel
def estimate(system: System, ws: Workspace, run: Run, h, slope):
    """Write the error (γ/h − J)⁻¹ (f + Σ e_s Z_s / h), of order 3, to stage[7]; f is ``slope``. Returns its norm."""
    r, error = run.newton, run.stage[7]
    for j in range(r.one.shape[0]):
        r.one[j] = slope[j] + (ERROR_RADAU[0] * r.z[0, j] + ERROR_RADAU[1] * r.z[1, j] + ERROR_RADAU[2] * r.z[2, j]) / h
        r.two[j] = 0.0
    solve_both(system, ws, run.y, r, h)
    for j in range(error.shape[0]):
        error[j] = r.one[j] if j < r.one.shape[0] else 0.0
    for j in range(r.one.shape[0]):
        r.error[j] = r.one[j]
    return error_norm(system, ws, run, error, slack(system, h, run.clock[ki.RTOL]))


@internal_kernel
def energy_error(system: System, run: Run, h):
    """Return the error norm of the electrical energy and Joule heat by the formula of `estimate` without a Jacobian."""
    r, largest = run.newton, 0.0
    for j in (system.layout.ledger + kst.ELECTRICAL, system.layout.ledger + kst.JOULE):
        error = h * run.stage[0, j]
        for s in range(3):
            error += ERROR_RADAU[s] * r.z[s, j]
        largest = max(largest, energy_norm(run, j, error / GAMMA_RADAU))
    return largest


@noinline_kernel
def step_radau5(system: System, ws: Workspace, run: Run):
    """Take one RADAU5 step and return the error norm. stage[6] is the derivative at y_new."""
    t, h, y, y_new, r = run.clock[ki.TIME], run.clock[ki.STEP], run.y, run.y_new, run.newton
    tracked = r.kept.shape[1]
    keep_stages(run)
    for j in range(tracked):
        r.weight[j] = 1.0 / (run.clock[ki.ATOL] + run.clock[ki.RTOL] * abs(y[j]))
    solved = False
    while not solved:
        if r.count[kn.STALE] == 1:
            differentiate(system, ws, run)
        if r.clock[kn.FACTORED] != h:
            factor_both(system, r, h)
            r.clock[kn.FACTORED] = h
            r.count[kn.FACTORS] += 1
        if solve_stages(system, ws, run, h):
            solved = True
        elif r.count[kn.MADE_AT] == run.count[ki.STEPS]:
            r.count[kn.DIVERGED] += 1
            r.clock[kn.LEVER] = 1.0
            for j in range(y.shape[0]):
                y_new[j], run.stage[6, j] = y[j], run.stage[0, j]
            return NO_STAGES
        else:
            r.count[kn.STALE] = 1
    r.clock[kn.TRIED] = h
    for j in range(tracked):
        y_new[j] = y[j] + r.z[2, j]
    error = estimate(system, ws, run, h, run.stage[0])
    if error >= 1.0:
        for j in range(y.shape[0]):
            run.stage[6, j] = y[j] + run.stage[7, j]
        derivative(system, t, run.stage[6], ws, r.f[0])
        run.count[ki.EVALUATIONS] += 1
        error = estimate(system, ws, run, h, r.f[0])
    evaluate_end(r, system, ws, run)
    add_up(run, h)
    return max(error, energy_error(system, run, h))


@internal_kernel
def add_up(run: Run, h):
    """Compute the integrals of the ledger from derivatives at the converged stages.

    The derivatives that Newton's method evaluated belong to the iterate before its last correction. If a stiff motor
    holds a joint, that correction changes the power with the same sign in every step, and the ledger would not close.
    """
    r = run.newton
    for j in range(r.kept.shape[1], run.y.shape[0]):
        for s in range(3):
            r.z[s, j] = h * (A_RADAU[s, 0] * r.f[0, j] + A_RADAU[s, 1] * r.f[1, j] + A_RADAU[s, 2] * r.f[2, j])
        run.y_new[j] = run.y[j] + r.z[2, j]


@internal_kernel
def after_step(run: Run, h):
    """Decide whether to keep the Jacobian and the factors after an accepted step of length h."""
    r, clock = run.newton, run.clock
    if r.clock[kn.CONTRACTION] > GOOD_CONTRACTION:
        r.count[kn.STALE] = 1
    elif h <= clock[ki.STEP] <= 1.2 * h:
        clock[ki.STEP] = h
