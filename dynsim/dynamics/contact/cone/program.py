"""Small dense second-order cone programs: interior-point solver, and selection of indeterminate contact forces.

    minimise ½ xᵀ H x + gᵀ x   subject to   A x = b,   s = G x + h ∈ K

K is a product of cones {(s_0, s_1): |s_1| ≤ s_0} of any sizes; a cone of size 1 is s_0 ≥ 0. The solver is a primal–dual
interior-point method with Nesterov–Todd scaling and Mehrotra's corrector (as in coneqp of CVXOPT), for about a dozen
unknowns. H must be positive semidefinite; A may have dependent rows. x is optimal if there are multipliers y and
z ∈ K with

    H x + g + Aᵀ y − Gᵀ z = 0,   A x = b,   G x + h = s,   s · z = 0
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.cone.steps import block_size
from dynsim.dynamics.linear import affine_row, factor_symmetric, solve_symmetric
from dynsim.jit.kernel import integers, internal_kernel, kernel, reals

ITERATIONS = 60
# Tolerance of the optimality conditions for a program scaled to numbers near 1; a few dozen operations round this much.
TOLERANCE = 1e-13
# Complementarity gap at which the iteration ends, because double precision cannot resolve smaller gaps.
GAP_MIN = 1e-16
# Below CLOSE, the iteration ends after PATIENCE steps that do not halve the residual.
CLOSE, PATIENCE = 1e-9, 2
# Regularisation of the Newton system along undetermined directions; the optimum is unchanged.
REGULAR = 1e-13
# Fraction of the distance to the boundary of the cones that remains after a step. With a hundredth of this value, steps
# end away from the central path, at the edge of a cone, and the next steps creep along that edge.
ASIDE = 2e-2


class ConeProgram(NamedTuple):
    """Data, solution and scratch arrays of a program. S is the sum of the cone sizes.

    Smaller programs use the leading parts of the arrays.
    """

    H: np.ndarray  # (n, n)
    g: np.ndarray  # (n,)
    A: np.ndarray  # (m, n)
    b: np.ndarray  # (m,)
    G: np.ndarray  # (S, n)
    h: np.ndarray  # (S,)
    first: np.ndarray  # (cones + 1,) int: start of each cone in s, and end of the last cone
    x: np.ndarray  # (n,) initial point, then solution
    y: np.ndarray  # (m,)
    s: np.ndarray  # (S,)
    z: np.ndarray  # (S,)
    kkt: np.ndarray  # (n + m, n + m) scratch, like all arrays below
    step: np.ndarray  # (n + m,)
    scaled: np.ndarray  # (S, n)
    scaling: np.ndarray  # (S,) w of each cone, with unit hyperbolic norm
    size: np.ndarray  # (cones,) factor of the scaling
    work: np.ndarray  # (7, S)
    kept: np.ndarray  # (n + m + 2 S,) the best x, y, s and z so far


LAMBDA, RESIDUAL, TARGET, DS, DZ, SCALED_DS, SCALED_DZ = 0, 1, 2, 3, 4, 5, 6


def cone_program(n: int, m: int, cones: int, rows: int) -> ConeProgram:
    """Allocate a :class:`ConeProgram` for n unknowns, m equations and ``cones`` cones with ``rows`` rows in total."""
    flat, first = reals(np.zeros(program_size(n, m, cones, rows))), integers(np.zeros(cones + 1))
    return program_in(flat, first, n, m, cones, rows)


def program_size(n: int, m: int, cones: int, rows: int) -> int:
    """Return the number of floats that :func:`program_in` needs for a program."""
    return n * n + n + m * n + m + 3 * rows + n + m + (n + m) ** 2 + n + m + 2 * rows * n + 10 * rows + cones + n + m


@internal_kernel
def program_in(flat, first, n, m, cones, rows):
    """Return a :class:`ConeProgram` whose arrays are views of one array.

    Many separate arrays would have to be passed through every function.

    Parameters
    ----------
    flat : (program_size(...),) ndarray
        Storage of all arrays.
    first : (cones + 1,) ndarray of int
        Starts of the cones.
    """
    H, at = piece(flat, 0, n, n)
    A, at = piece(flat, at, m, n)
    G, at = piece(flat, at, rows, n)
    kkt, at = piece(flat, at, n + m, n + m)
    scaled, at = piece(flat, at, rows, n)
    work, at = piece(flat, at, 7, rows)
    vectors, _ = piece(flat, at, 1, flat.shape[0] - at)
    line, b = vectors[0], n
    h = b + m
    x = h + rows
    y = x + n
    s = y + m
    z = s + rows
    step = z + rows
    scaling = step + n + m
    size = scaling + rows
    kept = size + cones
    return ConeProgram(
        H, line[:b], A, line[b:h], G, line[h:x], first, line[x:y], line[y:s], line[s:z], line[z:step], kkt,
        line[step:scaling], scaled, line[scaling:size], line[size:kept], work, line[kept : kept + n + m + 2 * rows],
    )  # fmt: skip


@internal_kernel
def piece(flat, start, rows, columns):
    """Return the matrix of this size in ``flat`` from ``start`` on, and the index behind it."""
    end = start + rows * columns
    return flat[start:end].reshape((rows, columns)), end


@kernel
def solve_cone_program(program: ConeProgram, n, m, cones):
    """Solve the program of the leading n unknowns, m equations and ``cones`` cones, starting from ``program.x``.

    All s must be inside their cones at the start. The solution and the multipliers are left in x, y, s and z. Returns
    the largest residual of the optimality conditions, including s · z; for numbers near 1, it is the relative error of
    the optimum.
    """
    x, y, s, z, first = program.x, program.y, program.s, program.z, program.first
    work, step = program.work, program.step
    rows = first[cones]
    start(program, n, m, cones)
    least, since = math.inf, 0
    for _ in range(ITERATIONS):
        error = conditions(program, n, m, cones)
        gap = 0.0
        for i in range(rows):
            gap += s[i] * z[i]
        gap = gap / cones if cones > 0 else 1.0
        # Close to the boundary of the cones, rounding (or NaN) prevents further progress.
        since += 1
        if error < least:
            if error < 0.5 * least:
                since = 0
            least = error
            keep(program, n, m, cones, True)
        if not least > TOLERANCE or not error < math.inf or gap <= GAP_MIN or (least < CLOSE and since >= PATIENCE):
            break
        scale_cones(program, cones)
        factor_kkt(program, n, m, rows, cones)

        # The predictor is a full step towards complementarity.
        for c in range(cones):
            jordan(work, LAMBDA, LAMBDA, TARGET, first[c], first[c + 1], -1.0, 0.0)
        newton_step(program, n, m, cones)
        reach = longest_step(program, cones)
        centring = (1.0 - reach) ** 3
        for c in range(cones):
            jordan(work, LAMBDA, LAMBDA, TARGET, first[c], first[c + 1], -1.0, 0.0)
            jordan(work, SCALED_DS, SCALED_DZ, TARGET, first[c], first[c + 1], -1.0, 1.0)
            work[TARGET, first[c]] += centring * gap
        newton_step(program, n, m, cones)
        reach = min(1.0, (1.0 - ASIDE) * longest_step(program, cones))
        if not reach > 1e-9:
            break
        for k in range(n):
            x[k] += reach * step[k]
        for e in range(m):
            y[e] += reach * step[n + e]
        for i in range(rows):
            s[i] += reach * work[DS, i]
            z[i] += reach * work[DZ, i]
    keep(program, n, m, cones, False)
    return least


@internal_kernel
def keep(program: ConeProgram, n, m, cones, store):
    """Store the current unknowns, or restore the stored values."""
    kept, rows = program.kept, program.first[cones]
    position = 0
    for table, size in ((program.x, n), (program.y, m), (program.s, rows), (program.z, rows)):
        for i in range(size):
            if store:
                kept[position] = table[i]
            else:
                table[i] = kept[position]
            position += 1


@internal_kernel
def start(program: ConeProgram, n, m, cones):
    """Set s to the slacks of x, y to zero, and z so that s and z are on the central path."""
    s, z, first = program.s, program.z, program.first
    program.y[:m] = 0.0
    for c in range(cones):
        square = 0.0
        for i in range(first[c], first[c + 1]):
            s[i] = affine_row(program.G, program.x, program.h, n, i)
            square += s[i] * s[i] * (1.0 if i == first[c] else -1.0)
        for i in range(first[c], first[c + 1]):
            z[i] = s[i] / square * (1.0 if i == first[c] else -1.0)


@internal_kernel
def slope(program: ConeProgram, n, m, k):
    """Return (H x + g + Aᵀ y)_k."""
    total = program.g[k]
    for j in range(n):
        total += program.H[k, j] * program.x[j]
    for e in range(m):
        total += program.A[e, k] * program.y[e]
    return total


@internal_kernel
def equation(program: ConeProgram, n, e):
    """Return (A x − b)_e."""
    total = -program.b[e]
    for k in range(n):
        total += program.A[e, k] * program.x[k]
    return total


@internal_kernel
def conditions(program: ConeProgram, n, m, cones):
    """Return the largest residual of the optimality conditions, including s · z; residuals of slacks go to ``work``."""
    x, s, z, rows = program.x, program.s, program.z, program.first[cones]
    worst, gap = 0.0, 0.0
    for k in range(n):
        left = slope(program, n, m, k)
        for i in range(rows):
            left -= program.G[i, k] * z[i]
        worst = max(worst, abs(left))
    for e in range(m):
        left = equation(program, n, e)
        worst = max(worst, abs(left))
    for i in range(rows):
        left = program.h[i] - s[i]
        for k in range(n):
            left += program.G[i, k] * x[k]
        program.work[RESIDUAL, i] = left
        worst = max(worst, abs(left))
        gap += s[i] * z[i]
    return worst if gap <= worst else gap  # NaN is kept


@internal_kernel
def scale_cones(program: ConeProgram, cones):
    """Compute the Nesterov–Todd scaling W of every cone, W z = W⁻¹ s = λ: its vector w, its factor, and λ."""
    s, z, first, w, work = program.s, program.z, program.first, program.scaling, program.work
    for c in range(cones):
        a, end = first[c], first[c + 1]
        norm_s, norm_z = hyperbolic(s, a, end), hyperbolic(z, a, end)
        product = 0.0
        for i in range(a, end):
            product += s[i] * z[i]
        half = 0.5 / math.sqrt(0.5 * (1.0 + product / (norm_s * norm_z)))
        for i in range(a, end):
            w[i] = half * (s[i] / norm_s + (z[i] if i == a else -z[i]) / norm_z)
        program.size[c] = math.sqrt(norm_s / norm_z)
        for i in range(a, end):
            work[LAMBDA, i] = s[i]
        unscale(program, c, work[LAMBDA])


@internal_kernel
def hyperbolic(u, a, end):
    """Return √(u_0² − |u_1|²) for the part of u in the cone from a to end."""
    square = 0.0
    for i in range(a + 1, end):
        square += u[i] * u[i]
    length = math.sqrt(square)
    return math.sqrt((u[a] - length) * (u[a] + length))


@internal_kernel
def unscale(program: ConeProgram, c, u):
    """Apply W⁻¹ of cone c to u in place."""
    w, a, end = program.scaling, program.first[c], program.first[c + 1]
    factor, along, head = 1.0 / program.size[c], 0.0, u[a]
    for i in range(a + 1, end):
        along += w[i] * u[i]
    u[a] = factor * (w[a] * head - along)
    pull = along / (1.0 + w[a]) - head
    for i in range(a + 1, end):
        u[i] = factor * (u[i] + pull * w[i])


@internal_kernel
def factor_kkt(program: ConeProgram, n, m, rows, cones):
    """Factor the regularised matrix [H + Gᵀ W⁻² G + Aᵀ A, Aᵀ; A, 0] = L D Lᵀ; D is on the diagonal, L below it.

    The term Aᵀ A, which the right-hand side compensates, provides pivots for unknowns that only the equations
    determine. An equation that depends on the preceding ones gets a pivot that suppresses its multiplier.
    """
    kkt, scaled = program.kkt, program.scaled
    column = program.work[TARGET]
    for k in range(n):
        for i in range(rows):
            column[i] = program.G[i, k]
        for c in range(cones):
            unscale(program, c, column)
        for i in range(rows):
            scaled[i, k] = column[i]
    for k in range(n):
        for j in range(k + 1):
            kkt[k, j] = program.H[k, j] + (REGULAR if j == k else 0.0)
    for i in range(rows):
        for k in range(n):
            for j in range(k + 1):
                kkt[k, j] += scaled[i, k] * scaled[i, j]
    for e in range(m):
        for k in range(n):
            kkt[n + e, k] = program.A[e, k]
            for j in range(k + 1):
                kkt[k, j] += program.A[e, k] * program.A[e, j]
        for j in range(e + 1):
            kkt[n + e, n + j] = 0.0
    factor_symmetric(kkt, n + m, n)


@internal_kernel
def newton_step(program: ConeProgram, n, m, cones):
    """Compute the Newton step of all unknowns for λ ∘ (W dz + W⁻¹ ds) = TARGET; TARGET is overwritten."""
    work, step, first = program.work, program.step, program.first
    z, rows = program.z, first[cones]
    target, ds, dz = work[TARGET], work[DS], work[DZ]
    scaled_ds, scaled_dz = work[SCALED_DS], work[SCALED_DZ]
    for i in range(rows):
        scaled_ds[i] = work[RESIDUAL, i]
    for c in range(cones):
        divide(work, LAMBDA, TARGET, first[c], first[c + 1])
        unscale(program, c, scaled_ds)
    for k in range(n):
        left = slope(program, n, m, k)
        for i in range(rows):
            left -= program.G[i, k] * z[i] + program.scaled[i, k] * (target[i] - scaled_ds[i])
        step[k] = -left
    for e in range(m):
        left = equation(program, n, e)
        step[n + e] = -left
        for k in range(n):
            step[k] -= program.A[e, k] * left
    solve_symmetric(program.kkt, step, n + m)
    for i in range(rows):
        ds[i] = affine_row(program.G, step, work[RESIDUAL], n, i)
        scaled_ds[i] = ds[i]
    for c in range(cones):
        unscale(program, c, scaled_ds)
    for i in range(rows):
        scaled_dz[i] = target[i] - scaled_ds[i]
        dz[i] = scaled_dz[i]
    for c in range(cones):
        unscale(program, c, dz)


@internal_kernel
def jordan(work, u, v, out, a, end, factor, keep):
    """Set row ``out`` to ``keep`` times itself plus ``factor`` (u · v, u_0 v_1 + v_0 u_1), in the cone a to end."""
    product = 0.0
    for i in range(a, end):
        product += work[u, i] * work[v, i]
    for i in range(a + 1, end):
        mixed = work[u, a] * work[v, i] + work[v, a] * work[u, i]
        work[out, i] = keep * work[out, i] + factor * mixed
    work[out, a] = keep * work[out, a] + factor * product


@internal_kernel
def divide(work, u, out, a, end):
    """Replace row ``out`` by the vector r with u ∘ r = out, in the cone from a to end."""
    along = 0.0
    for i in range(a + 1, end):
        along += work[u, i] * work[out, i]
    norm = hyperbolic(work[u], a, end)
    head = (work[u, a] * work[out, a] - along) / (norm * norm)
    for i in range(a + 1, end):
        work[out, i] = (work[out, i] - head * work[u, i]) / work[u, a]
    work[out, a] = head


@internal_kernel
def clear_objective(program: ConeProgram, unknowns, weight):
    """Reset the objective to a small weight on the unknowns."""
    for k in range(unknowns):
        program.g[k] = 0.0
        for m in range(unknowns):
            program.H[k, m] = weight if m == k else 0.0


@internal_kernel
def worst_margin(program: ConeProgram, unknowns, cones):
    """Return the smallest distance of x to the boundary of a cone; negative outside."""
    worst = math.inf
    for c in range(cones):
        head, square = 0.0, 0.0
        for i in range(program.first[c], program.first[c + 1]):
            slack = affine_row(program.G, program.x, program.h, unknowns, i)
            if i == program.first[c]:
                head = slack
            else:
                square += slack * slack
        worst = min(worst, head - math.sqrt(square))
    return worst


@internal_kernel
def maximise_margin(program: ConeProgram, unknowns, equations, cones, most, weight):
    """Find the point x with the largest margin to all cones, at most ``most``, from the present x; return this margin.

    The margin is one more unknown, with its column of G; ``weight`` is the weight of the others in the objective.
    """
    rows, x = program.first[cones], program.x
    clear_objective(program, unknowns + 1, weight)
    program.g[unknowns], program.H[unknowns, unknowns] = -1.0, 0.0
    program.G[rows, unknowns], program.h[rows], program.first[cones + 1] = -1.0, most, rows + 1
    for k in range(unknowns):
        program.G[rows, k] = 0.0
    x[unknowns] = min(worst_margin(program, unknowns, cones), most) - 1.0
    solve_cone_program(program, unknowns + 1, equations, cones + 1)
    return x[unknowns]


@internal_kernel
def longest_step(program: ConeProgram, cones):
    """Return the longest step, at most 1, that keeps s and z in their cones."""
    first, reach = program.first, 1.0
    for c in range(cones):
        reach = min(reach, exit_distance(program.s, program.work[DS], first[c], first[c + 1]))
        reach = min(reach, exit_distance(program.z, program.work[DZ], first[c], first[c + 1]))
    return reach


@internal_kernel
def exit_distance(u, du, a, end):
    """Return the smallest α > 0 at which u + α du leaves the cone; infinite if it never does."""
    # Go no further than the height of the apex: on a line through the apex, rounding hides the double root found below.
    apex = -u[a] / du[a] if du[a] < 0.0 else math.inf
    if end == a + 1:
        return apex
    square, product, norm = du[a] * du[a], u[a] * du[a], hyperbolic(u, a, end)
    for i in range(a + 1, end):
        square -= du[i] * du[i]
        product -= u[i] * du[i]
    constant = norm * norm
    inner = product * product - square * constant
    if inner < 0.0:
        return apex
    below = math.sqrt(inner) - product
    return min(constant / below, apex) if below > 0.0 else apex


# Split of forces among redundant sticking contacts by cone programs: least norm within the cones, or largest margin.


# Weight of |z|² in the objective of the margin; it makes the best split unique if the margin alone does not.
LEAST_WEIGHT = 1e-13
# Bound on the margin, in units of the largest given force; for a body wedged between two walls the margin is unbounded.
MARGIN_MAX = 10.0
# Tolerance, in units of the largest force, for tangential forces without friction and for cones that meet in a point.
FORCE_TOLERANCE = 1e-9


def split_size(r: int, count: int) -> int:
    """Return the number of floats in the scratch of :func:`best_split`, see :func:`split_room_in`."""
    return program_size(*split_sizes(r, count))


def split_sizes(r: int, count: int) -> tuple[int, int, int, int]:
    """Return unknowns, equations, cones and rows for null spaces of up to r columns and ``count`` contacts."""
    return r + 1, 2 * count, count + 1, ka.MOST_ROWS * count + 1


@internal_kernel
def split_room_in(flat, first, r, count):
    """Return the scratch of :func:`best_split` in given arrays, (split_size(r, count),) and (count + 2,) int."""
    return program_in(flat, first, r + 1, 2 * count, count + 1, ka.MOST_ROWS * count + 1)


@kernel
def best_split(f0, N, r, contact_first, mu, contacts, joints, out, room: ConeProgram, least):
    """Find the split f = f0 + N z of redundant sticking contacts: inside all cones if possible, then with least norm.

    The best margin is max_z min_j (μ_j f_n,j − |f_t,j|). If it is negative, no split holds all contacts. A contact
    without friction cannot carry a tangential force: this force is set to zero if possible, and the margin is f_n,j.

    Parameters
    ----------
    f0 : (p or more,) ndarray
        Forces of all rows [N].
    N : (p or more, r or more) ndarray
        Directions in which they can be split differently; r columns are used.
    contact_first : (contacts + joints or more,) ndarray of int
        Normal row of each sticking contact, which is followed by its tangential rows; then, for the ``joints``, the row
        of each joint held by dry friction and of each closed joint stop.
    mu : (contacts + joints or more,) ndarray
        Static friction of a contact. For a joint held by dry friction: the bound of its force, with the margin
        μ_j − |f_j|. For a stop: a negative number, with the margin f_j.
    out : (p or more,) ndarray
        Force of least norm in all cones; if no force is in all cones, the force with the best margin.
    room : ConeProgram
        Scratch of :func:`split_sizes`.
    least : bool
        If False, always return the split with the best margin.

    Returns
    -------
    float
        Best margin [N], at most ten times the largest force in f0.
    """
    p, count = f0.shape[0], contacts + joints
    scale = 0.0
    for i in range(p):
        out[i] = f0[i]
        scale = max(scale, abs(f0[i]))
    if scale == 0.0 or count == 0:
        return 0.0
    x, equations = room.x, 0
    for j in range(contacts):
        if mu[j] > 0.0:
            continue
        for e in range(1, ka.MOST_ROWS):
            i = contact_first[j] + e
            for k in range(r):
                room.A[equations, k] = N[i, k]
            room.A[equations, r] = 0.0
            room.b[equations] = -f0[i] / scale
            equations += 1
    cone_rows(f0, N, r, contact_first, mu, contacts, joints, scale, room)
    for k in range(r):
        x[k] = 0.0
    if r == 0:
        worst = worst_margin(room, r, count)
        for e in range(equations):
            if abs(room.b[e]) > FORCE_TOLERANCE:
                worst = min(worst, -abs(room.b[e]))
        return worst * scale
    margin = maximise_margin(room, r, equations, count, MARGIN_MAX, LEAST_WEIGHT)
    error = 0.0
    for e in range(equations):
        off = -room.b[e]
        for k in range(r):
            off += room.A[e, k] * x[k]
        error = max(error, abs(off))
    if error > FORCE_TOLERANCE:
        margin = min(margin, -error)

    if least and margin > FORCE_TOLERANCE:
        # The cones have an interior: find the force of least norm, starting from the point found.
        for k in range(r):
            room.g[k] = 0.0
            for i in range(p):
                room.g[k] += N[i, k] * f0[i] / scale
            for m in range(r):
                room.H[k, m] = 0.0
                for i in range(p):
                    room.H[k, m] += N[i, k] * N[i, m]
        solve_cone_program(room, r, equations, count)
    for i in range(p):
        for k in range(r):
            out[i] += scale * N[i, k] * x[k]
    return margin * scale


@internal_kernel
def cone_rows(f0, N, r, contact_first, mu, contacts, joints, scale, room: ConeProgram):
    """Write the cones in z and the margin t: (μ f_n − t, f_t) for contacts, (μ − t, f) for joints, f − t for stops."""
    row = 0
    for j in range(contacts + joints):
        i, room.first[j], slope = contact_first[j], row, mu[j] if mu[j] > 0.0 else 1.0
        if j >= contacts and mu[j] >= 0.0:
            force_row(f0, N, r, i, 0.0, scale, room, row, -1.0)
            room.h[row] = mu[j] / scale
            force_row(f0, N, r, i, 1.0, scale, room, row + 1, 0.0)
            row += 2
            continue
        force_row(f0, N, r, i, slope if j < contacts else 1.0, scale, room, row, -1.0)
        row += 1
        for e in range(1, ka.MOST_ROWS if j < contacts and mu[j] > 0.0 else 1):
            force_row(f0, N, r, i + e, 1.0, scale, room, row, 0.0)
            row += 1
    room.first[contacts + joints] = row


@internal_kernel
def force_row(f0, N, r, i, factor, scale, room: ConeProgram, row, by_margin):
    """Write row ``row`` of the cones: ``factor`` times force i, and ``by_margin`` times the margin."""
    for k in range(r):
        room.G[row, k] = factor * N[i, k]
    room.G[row, r], room.h[row] = by_margin, factor * f0[i] / scale


# Selection of indeterminate contact forces: as close to least norm as the friction cones allow.


# Blocks of the scratch ``room``: G, its factor, columns S (coefficients on the rows of their block), then vectors.
MATRIX, FACTOR, COLUMNS, NOW, GOAL, RIGHT, PIVOT, ROW, SIZE = 0, 1, 2, 3, 4, 5, 6, 7, 8
# Speed [m/s]: a row that separates faster has no force, slower slip has no direction, and a force that changes the rate
# of its row by less has no direction either.
STILL = 1e-9
# G is singular if a pivot is below SINGULAR times the mean of its diagonal. The projection adds SHIFT times that mean
# to the diagonal; each refinement multiplies the error by about SHIFT.
SINGULAR, SHIFT, REFINEMENTS = 1e-10, 1e-6, 4
# Number of bisections of the step to a cone; fraction of the largest force by which a force may be outside its cone.
HALVINGS, ROUNDING = 50, 1e-12


@internal_kernel
def select_least_norm(W, w, kind, mu, p, f, room):
    """Move the forces f, (p,), towards their least norm without changing the motion w = W f + b.

    f remains unchanged if it is unique. ``room`` is scratch, (CONE_ROOM, p, p).
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
            if size[i] == 1.0 and size[j] == 1.0:  # then S is one
                G[i, j], G[j, i] = W[a, b], W[a, b]
                continue
            for k in range(int(size[i])):
                for m in range(int(size[j])):
                    total += S[i, k] * W[a + k, b + m] * S[j, m]
            G[i, j], G[j, i] = total, total
        trace += G[i, i]
    if not trace > 0.0 or factor_shifted(G, L, n, 0.0) > SINGULAR * trace / n:
        return
    factor_shifted(G, L, n, SHIFT * trace / n)
    # x = (G + ε)⁻¹ G x₀, refined iteratively: the error outside the range of G stays zero; the error within it falls by
    # a factor of about ε each time.
    for i in range(n):
        goal[i] = 0.0
    for _ in range(1 + REFINEMENTS):
        for i in range(n):
            right[i] = 0.0
        for j in range(n):
            far = now[j] - goal[j]
            for i in range(n):  # G is symmetric; along a row, the loop is vectorised
                right[i] += G[j, i] * far
        solve_symmetric(L, right, n)
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
    """Write the columns S for rows whose forces may change, with their first rows and sizes; return their number."""
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
    """Return the friction per normal force, (x, y), of the point with first row k that slides at ``slip``."""
    if f[k] * W[k, k] <= STILL:
        return -mu[k] * w[k + 1] / slip, -mu[k] * w[k + 2] / slip
    x, y = f[k + 1] / f[k], f[k + 2] / f[k]
    size = math.sqrt(x * x + y * y)
    part = mu[k] / size if size > mu[k] else 1.0
    return part * x, part * y


@internal_kernel
def factor_shifted(G, L, n, shift):
    """Factor G + ``shift``, (n, n), into L, see :func:`factor_symmetric`; return the smallest pivot."""
    least = math.inf
    for i in range(n):
        for j in range(i + 1):
            L[i, j] = G[i, j]
        L[i, i] += shift
    factor_symmetric(L, n, n)
    for i in range(n):
        least = min(least, L[i, i])
    return least


@internal_kernel
def inside(mu, n, room, share, slack):
    """Return whether the forces at the fraction ``share`` of the way from NOW to GOAL are in their cones."""
    now, goal, row, size = room[NOW, 0], room[GOAL, 0], room[ROW, 0], room[SIZE, 0]
    i = 0
    while i < n:
        normal = now[i] + share * (goal[i] - now[i])
        if normal < -slack:
            return False
        # Three consecutive columns with one row each belong to a sticking point.
        sticks = size[i] == 1.0 and i + 2 < n and row[i + 1] == row[i] + 1.0 and mu[int(row[i])] > 0.0
        if sticks:
            x = now[i + 1] + share * (goal[i + 1] - now[i + 1])
            y = now[i + 2] + share * (goal[i + 2] - now[i + 2])
            if math.sqrt(x * x + y * y) > mu[int(row[i])] * normal + slack:
                return False
            i += 2
        i += 1
    return True
