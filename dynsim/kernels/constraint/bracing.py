"""Forces of braces that realise a motion with the least heat in the motors: a cone program in the forces.

    tau = M vdot + h + g + J_m vdot + (D + D_m) v − Bᵀ f,    minimise Σ w_j tau_j²,  w = R / K_m²

with f = (f_n, f_1, f_2) of each brace and the rows of B the velocities of its point along n and two tangents;
subject to lower ≤ tau ≤ upper (zero where there is no motor), |f_t| ≤ μ f_n and f_n ≥ min_N. A brace that slides has
f_t = −μ f_n d instead, one whose normal force is commanded has f_n = that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.kernels.arrays import ARMATURE, BIAS, DAMPING, GEAR_DAMPING, MOST_ROWS, QD, QDD, ModelArrays, Workspace
from dynsim.kernels.constraint.cone_program import ConeProgram, cone_program, solve_cone_program
from dynsim.kernels.jit import internal_kernel, kernel, reals
from dynsim.kernels.tree.points import point_jacobian, point_position
from dynsim.kernels.tree.sweep import newton_euler

# BraceArrays.table
POINT = 0  # 3: in the body's frame [m]
AXES = 3  # 9: unit normal and two tangents in W, one after the other
SLIP = 12  # 2: unit direction of sliding along the tangents, zero for a brace that is held
FRICTION = 14
LEAST = 15  # min_N
COMMANDED = 16  # [N], NaN for none
BRACE_SIZE = 17
# BraceArrays.motors
HEAT = 0  # w = R / K_m² [W/(N m)²]
LOWER = 1  # torque limits [N m], infinite for none; both zero without a motor
UPPER = 2
MOTOR_LIMITS = 3
# BraceArrays.found: normal and tangential forces, then the ends of the interval of the normal force
FORCES, LOW, HIGH = 0, 3, 4
FOUND_SIZE = 5

# How far forces violate the constraints, and how far apart the ends of an interval may be [1]: beyond it there is no
# solution, and below it nothing but one.
SLACK = 1e-9
# Intervals are open where forces this many times their scale are still possible.
FAR = 1e4
# Weight of the forces beside the heat: keeps those finite that no motor feels.
LEAST_WEIGHT = 1e-14


class BraceArrays(NamedTuple):
    """Braces, motors, what is found, and the room for it."""

    link: np.ndarray  # (c,) int
    table: np.ndarray  # (c, BRACE_SIZE)
    motors: np.ndarray  # (n, MOTOR_LIMITS)
    free: np.ndarray  # (n,) torques without braces [N m]
    torques: np.ndarray  # (n,) [N m]
    found: np.ndarray  # (c, FOUND_SIZE) [N]
    certificate: np.ndarray  # (n,) see brace_statics
    B: np.ndarray  # (3 c, n)
    start: np.ndarray  # (3 c,) scratch
    position: np.ndarray  # (3,) scratch
    jacobian: np.ndarray  # (3, n) scratch
    program: ConeProgram


def brace_arrays(link: np.ndarray, table: np.ndarray, motors: np.ndarray) -> BraceArrays:
    """Allocate a :class:`BraceArrays` for these braces and motors."""
    c, n = len(link), len(motors)
    forces, cones, limits = MOST_ROWS * c, 2 * c + 2 * n + 1, 2 * n
    return BraceArrays(
        link=link,
        table=table,
        motors=motors,
        free=reals(np.zeros(n)),
        torques=reals(np.zeros(n)),
        found=reals(np.zeros((c, FOUND_SIZE))),
        certificate=reals(np.zeros(n)),
        B=reals(np.zeros((forces, n))),
        start=reals(np.zeros(forces)),
        position=reals(np.zeros(3)),
        jacobian=reals(np.zeros((3, n))),
        program=cone_program(forces + 1, n + forces, cones, 4 * c + limits + 1),
    )


@kernel
def brace_statics(model: ModelArrays, ws: Workspace, braces: BraceArrays):
    """Least-heat forces at the q, v and vdot in ``ws.joints``; torques and forces into ``braces``.

    Returns 1.0, or 0.0 where nothing fulfils all constraints. Then ``certificate`` is a vector ω (n,) of joint rates
    that shows it: for all torques within their limits and all forces of the braces, ω·(tau + Bᵀ f) < ω·free, which
    would have to be equal.
    """
    program, found, table, n = braces.program, braces.found, braces.table, braces.free.shape[0]
    c = braces.link.shape[0]
    scale, unknowns, x = brace_rows(model, ws, braces), MOST_ROWS * c, program.x
    passive, limited = 0, False
    for j in range(n):
        passive += braces.motors[j, LOWER] == braces.motors[j, UPPER]
        limited |= not (math.isinf(braces.motors[j, LOWER]) and math.isinf(braces.motors[j, UPPER]))
    # Equations that contradict each other have no margin: first with torques of passive joints that may be off.
    if passive > 0:
        equations, cones = constraints(braces, scale, True)
        if largest_margin(braces, equations, cones, scale) < -SLACK:
            contradiction(braces, equations, cones, True)
            return 0.0
    equations, cones = constraints(braces, scale, False)
    inside = 1.0
    if limited:
        inside = largest_margin(braces, equations, cones, scale)
        if inside < -SLACK:
            contradiction(braces, equations, cones, False)
            return 0.0
    else:
        middle_forces(braces, scale)
    for j in range(c):
        found[j, LOW], found[j, HIGH] = table[j, LEAST], math.inf
        if table[j, COMMANDED] == table[j, COMMANDED]:
            found[j, LOW], found[j, HIGH] = table[j, COMMANDED], table[j, COMMANDED]
        elif limited:
            for end in range(2):
                found[j, LOW + end] = extreme_force(braces, unknowns, equations, cones, inside, j, end, scale)
    if inside > SLACK:
        least_heat(braces, unknowns, equations, cones, scale)
    for j in range(n):
        braces.torques[j] = braces.free[j]
        for k in range(unknowns):
            braces.torques[j] -= braces.B[k, j] * scale * x[k]
    for j in range(c):
        for e in range(MOST_ROWS):
            found[j, FORCES + e] = scale * x[MOST_ROWS * j + e]
    return 1.0


@internal_kernel
def middle_forces(braces: BraceArrays, scale):
    """Forces to start from, along the normals: inside the cones of all braces."""
    table, x = braces.table, braces.program.x
    for j in range(braces.link.shape[0]):
        commanded = table[j, COMMANDED]
        x[MOST_ROWS * j] = (1.0 + 2.0 * table[j, LEAST] / scale) if math.isnan(commanded) else commanded / scale
        x[MOST_ROWS * j + 1], x[MOST_ROWS * j + 2] = 0.0, 0.0


@internal_kernel
def largest_margin(braces: BraceArrays, equations, cones, scale):
    """A point x inside all constraints; returns the worst margin there, the largest possible, at most 1."""
    program, unknowns = braces.program, MOST_ROWS * braces.link.shape[0]
    x, rows = program.x, program.first[cones]
    clear_objective(program, unknowns + 1)
    program.g[unknowns], program.H[unknowns, unknowns] = -1.0, 0.0
    program.G[rows, unknowns], program.h[rows], program.first[cones + 1] = -1.0, 1.0, rows + 1
    for k in range(unknowns):
        program.G[rows, k] = 0.0
    middle_forces(braces, scale)
    x[unknowns] = worst_margin(program, unknowns, cones) - 1.0
    solve_cone_program(program, unknowns + 1, equations, cones + 1)
    return x[unknowns]


@internal_kernel
def brace_rows(model: ModelArrays, ws: Workspace, braces: BraceArrays):
    """Torques without braces, and B; returns a scale of the forces [N]."""
    newton_euler(model, ws, 1.0, 1.0, 1.0)
    table, B, jacobian, n = braces.table, braces.B, braces.jacobian, braces.free.shape[0]
    torque, lever, scale = 0.0, 0.0, 1e-3
    for j in range(n):
        losses = model.body[j, DAMPING] + model.body[j, GEAR_DAMPING]
        braces.free[j] = ws.joints[j, BIAS] + model.body[j, ARMATURE] * ws.joints[j, QDD] + losses * ws.joints[j, QD]
        torque = max(torque, abs(braces.free[j]))
    for k in range(braces.link.shape[0]):
        point_position(ws, braces.link[k], table[k], braces.position)
        point_jacobian(model, ws, braces.link[k], braces.position, jacobian)
        scale = max(scale, table[k, LEAST])
        for e in range(MOST_ROWS):
            x, y, z = table[k, AXES + 3 * e], table[k, AXES + 3 * e + 1], table[k, AXES + 3 * e + 2]
            for j in range(n):
                rate = x * jacobian[0, j] + y * jacobian[1, j] + z * jacobian[2, j]
                B[MOST_ROWS * k + e, j] = rate
                lever = max(lever, abs(rate))
    return max(scale, torque / lever) if lever > 0.0 else scale


@internal_kernel
def constraints(braces: BraceArrays, scale, relaxed):
    """Equations and cones in the forces over ``scale``; their numbers. ``relaxed``: passive joints are in cones."""
    program, table, B, motors = braces.program, braces.table, braces.B, braces.motors
    A, b, G, h, first = program.A, program.b, program.G, program.h, program.first
    c, n = braces.link.shape[0], braces.free.shape[0]
    unknowns, equations, cones, rows = MOST_ROWS * c, 0, 0, 0
    for e in range(A.shape[0]):
        for k in range(unknowns + 1):
            A[e, k] = 0.0
    for i in range(G.shape[0]):
        for k in range(unknowns):
            G[i, k] = 0.0
        h[i] = 0.0
    for j in range(c):
        k, mu = MOST_ROWS * j, table[j, FRICTION]
        if table[j, COMMANDED] == table[j, COMMANDED]:
            A[equations, k], b[equations] = 1.0, table[j, COMMANDED] / scale
            equations += 1
        else:
            G[rows, k], h[rows], first[cones] = 1.0, -table[j, LEAST] / scale, rows
            G[rows, unknowns] = -1.0
            rows, cones = rows + 1, cones + 1
        if mu == 0.0 or table[j, SLIP] != 0.0 or table[j, SLIP + 1] != 0.0:
            for e in range(2):
                A[equations, k + 1 + e], A[equations, k], b[equations] = 1.0, mu * table[j, SLIP + e], 0.0
                equations += 1
        else:
            first[cones] = rows
            G[rows, k], G[rows + 1, k + 1], G[rows + 2, k + 2] = mu, 1.0, 1.0
            G[rows, unknowns], G[rows + 1, unknowns], G[rows + 2, unknowns] = -1.0, 0.0, 0.0
            rows, cones = rows + 3, cones + 1
    # Torques in units of the force scale.
    for j in range(n):
        low, high = motors[j, LOWER], motors[j, UPPER]
        if low == high and not relaxed:
            for k in range(unknowns):
                A[equations, k] = B[k, j]
            b[equations] = (braces.free[j] - low) / scale
            equations += 1
            continue
        for side in range(2):
            if not math.isinf(high if side == 0 else low):
                first[cones] = rows
                sign = 1.0 if side == 0 else -1.0
                for k in range(unknowns):
                    G[rows, k] = sign * B[k, j]
                h[rows] = ((high - braces.free[j]) if side == 0 else (braces.free[j] - low)) / scale
                G[rows, unknowns] = -1.0
                rows, cones = rows + 1, cones + 1
    first[cones] = rows
    return equations, cones


@internal_kernel
def clear_objective(program: ConeProgram, unknowns):
    """Nothing to minimise but, with little weight, the unknowns."""
    for k in range(unknowns):
        program.g[k] = 0.0
        for m in range(unknowns):
            program.H[k, m] = LEAST_WEIGHT if m == k else 0.0


@internal_kernel
def worst_margin(program: ConeProgram, unknowns, cones):
    """Least distance of x to the boundary of a cone, negative outside."""
    worst = math.inf
    for c in range(cones):
        head, square = 0.0, 0.0
        for i in range(program.first[c], program.first[c + 1]):
            slack = program.h[i]
            for k in range(unknowns):
                slack += program.G[i, k] * program.x[k]
            if i == program.first[c]:
                head = slack
            else:
                square += slack * slack
        worst = min(worst, head - math.sqrt(square))
    return min(worst, 1.0)


@internal_kernel
def contradiction(braces: BraceArrays, equations, cones, relaxed):
    """The multipliers of torques as joint rates, from those of the margin that is negative at best."""
    program, motors = braces.program, braces.motors
    # Torques are the last of the equations and of the cones: backwards.
    e, i = equations - 1, program.first[cones] - 1
    for j in range(braces.free.shape[0] - 1, -1, -1):
        low, high = motors[j, LOWER], motors[j, UPPER]
        braces.certificate[j] = 0.0
        if low == high and not relaxed:
            braces.certificate[j] = -program.y[e]
            e -= 1
            continue
        if not math.isinf(low):
            braces.certificate[j] -= program.z[i]
            i -= 1
        if not math.isinf(high):
            braces.certificate[j] += program.z[i]
            i -= 1


@internal_kernel
def extreme_force(braces: BraceArrays, unknowns, equations, cones, inside, j, end, scale):
    """The least (end 0) or largest (end 1) normal force of brace j within all constraints [N], from the point x."""
    program, k = braces.program, MOST_ROWS * j
    x = program.x
    if inside <= SLACK:
        return scale * x[k]
    rows, first = program.first[cones], program.first
    clear_objective(program, unknowns)
    sign = 1.0 if end == 0 else -1.0
    program.g[k] = sign
    for m in range(unknowns):
        program.G[rows, m] = 0.0
        braces.start[m] = x[m]
    program.G[rows, k], program.h[rows], first[cones + 1] = sign, FAR, rows + 1
    solve_cone_program(program, unknowns, equations, cones + 1)
    force = x[k]
    for m in range(unknowns):
        x[m] = braces.start[m]
    return math.inf if end == 1 and force > 0.999 * FAR else scale * force


@internal_kernel
def least_heat(braces: BraceArrays, unknowns, equations, cones, scale):
    """The forces of least heat, in units of it: H = B w Bᵀ, g = −B w free."""
    program, B, motors, n = braces.program, braces.B, braces.motors, braces.free.shape[0]
    clear_objective(program, unknowns)
    largest = 0.0
    for k in range(unknowns):
        for m in range(k + 1):
            total = 0.0
            for j in range(n):
                total += B[k, j] * motors[j, HEAT] * B[m, j]
            program.H[k, m], program.H[m, k] = total, total
            largest = max(largest, abs(total))
        for j in range(n):
            program.g[k] -= B[k, j] * motors[j, HEAT] * braces.free[j] / scale
    unit = 1.0 / largest if largest > 0.0 else 1.0
    for k in range(unknowns):
        for m in range(unknowns):
            program.H[k, m] *= unit
        program.H[k, k] += LEAST_WEIGHT
        program.g[k] *= unit
    solve_cone_program(program, unknowns, equations, cones)
