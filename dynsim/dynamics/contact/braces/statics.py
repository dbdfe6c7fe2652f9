"""Brace forces that minimise motor heat for a given motion, their ranges, and certificates of infeasibility.

    tau = M vdot + h + g + J_m vdot + (D + D_m) v − Bᵀ f,    minimise Σ w_j tau_j²,  w = R / K_m²

subject to lower ≤ tau ≤ upper (both zero for a joint without a motor), |f_t| ≤ μ f_n and f_n ≥ min_N: a second-order
cone program. Each brace has f = (f_n, f_1, f_2) along its normal n and two tangents; the rows of B map rates to the
velocities of its point along them. A sliding brace has f_t = −μ f_n d with the direction of slip d; a commanded f_n is
known. The unknowns of a brace are thus f if it is held, and f_n if it slides or has no friction; f_n is not an unknown
if it is commanded. If braces have a target force, the program minimises the deviation from it instead of the heat; see
``NEAR``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone.program import (
    ConeProgram,
    clear_objective,
    cone_program,
    maximise_margin,
    solve_cone_program,
)
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.joints import point_jacobian, point_position, read_positions
from dynsim.dynamics.tree.spatial import point_velocity, put_vector, six
from dynsim.dynamics.tree.sweep import kinematics, newton_euler
from dynsim.jit.kernel import integers, internal_kernel, kernel, reals

# Tables of the program: braces and motors (input), forces (output) and workspace.


# BraceArrays.table
POINT = 0  # 3: in the body's frame [m]
AXES = 3  # 9: unit normal and two tangents in W, one after the other
SLIP = 12  # 2: unit direction of sliding along the tangents, zero for a brace that is held
FRICTION = 14
LEAST = 15  # min_N
COMMANDED = 16  # commanded normal force [N], NaN if none
# Target of the normal force of a brace [N], and its weight (compliance) [m/N]; zero for braces without a target.
# If any brace has a target, forces minimise Σ compliance (f_n − near)² instead of the heat.
NEAR, COMPLIANCE = 17, 18
BRACE_SIZE = 19
# BraceArrays.motors: a torque source has K_m = 1 and no resistance; a joint without a motor has K_m = 1 and no current
HEAT = 0  # w = R / K_m² [W/(N m)²]
LOWER = 1  # torque limits at the present joint rate [N m], infinite for none; both zero without a motor
UPPER = 2
CONSTANT, RESISTANCE, VOLTAGE_LIMIT, CURRENT_LIMIT = 3, 4, 5, 6  # K_m [N m/A], R [Ω], U [V], I [A]
MOTOR_SIZE = 7
# BraceArrays.results: normal and tangential forces, then the ends of the interval of the normal force
FORCES, LOW, HIGH = 0, 3, 4
RESULT_SIZE = 5


class BraceArrays(NamedTuple):
    """Braces, motors, results and workspace."""

    link: np.ndarray  # (c,) int
    carrier: np.ndarray  # (c,) int: link that carries the surface, or -1 for the world
    table: np.ndarray  # (c, BRACE_SIZE) braces
    motors: np.ndarray  # (n, MOTOR_SIZE)
    first: np.ndarray  # (c + 1,) int: first unknown of each brace, and number of unknowns
    free: np.ndarray  # (n,) torques without the unknown forces [N m]
    torques: np.ndarray  # (n,) [N m]
    results: np.ndarray  # (c, RESULT_SIZE) [N]
    forces: np.ndarray  # (c, 3) on the arm in W [N]
    certificate: np.ndarray  # (n,) see brace_statics
    B: np.ndarray  # (3 c, n) one row for each unknown
    inside: np.ndarray  # (3 c,) scratch
    position: np.ndarray  # (3,) scratch
    jacobian: np.ndarray  # (3, n) scratch
    other: np.ndarray  # (3, n) scratch
    program: ConeProgram


def brace_arrays(link: np.ndarray, carrier: np.ndarray, motors: np.ndarray) -> BraceArrays:
    """Allocate :class:`BraceArrays` for braces of links on carriers, (c,) each, and for the motors, (n, MOTOR_SIZE)."""
    c, n = len(link), len(motors)
    forces = ka.MOST_ROWS * c
    return BraceArrays(
        link=link,
        carrier=carrier,
        table=reals(np.zeros((c, BRACE_SIZE))),
        motors=motors,
        first=integers(np.zeros(c + 1)),
        free=reals(np.zeros(n)),
        torques=reals(np.zeros(n)),
        results=reals(np.zeros((c, RESULT_SIZE))),
        forces=reals(np.zeros((c, 3))),
        certificate=reals(np.zeros(n)),
        B=reals(np.zeros((forces, n))),
        inside=reals(np.zeros(forces)),
        position=reals(np.zeros(3)),
        jacobian=reals(np.zeros((3, n))),
        other=reals(np.zeros((3, n))),
        program=cone_program(forces + 1, n, 2 * c + 2 * n + 1, 4 * c + 2 * n + 1),
    )


# Tolerance of the largest margin to the constraints, as a fraction of the force scale [1]. Below −SLACK, no solution
# exists; within ±SLACK, the set of solutions has no interior.
SLACK = 1e-9
# If all torques are at least this far from their limits, as a fraction of the force scale, the margin is not maximised.
AMPLE = 1e-6
# An interval counts as unbounded if forces of this multiple of the force scale are still possible.
FAR = 1e4
# Weight of the forces in the objective, in addition to the heat; it keeps forces that do not load any motor finite.
LEAST_WEIGHT = 1e-14


@kernel
def brace_motion(model: ModelArrays, ws: Workspace, braces: BraceArrays, q, v, positions, velocities):
    """Compute positions and velocities of the points of braces along a motion.

    Parameters
    ----------
    q, v : (T, nq) ndarray, (T, n) ndarray
        Coordinates and rates.
    positions, velocities : (T, c, 3) ndarray
        Results [m, m/s], overwritten; the points are in ``braces.table``.
    """
    for t in range(q.shape[0]):
        set_motion(model, ws, q[t], v[t], v[t])
        kinematics(model, ws)
        for k in range(braces.link.shape[0]):
            link, at = braces.link[k], positions[t, k]
            point_position(ws, link, braces.table[k], at)
            put_vector(velocities[t], k, 0, point_velocity(six(ws.links, link, ka.V), at))


@kernel
def brace_statics(
    model: ModelArrays, ws: Workspace, braces: BraceArrays, q, v, vdot, tables, torques, normal, intervals
):
    """Compute the forces of least heat along a motion; write the last forces and the requested intervals to ``braces``.

    Returns the number of instants with a solution: the computation stops at the first instant at which no forces
    satisfy all constraints. Then ``certificate`` is a vector ω (n,) of joint rates that proves it: for all torques
    within their limits and all admissible brace forces, ω·(tau + Bᵀ f) < ω·free, although a solution requires equality.

    Parameters
    ----------
    q, v, vdot : (T, nq) ndarray, (T, n) ndarray, (T, n) ndarray
        Coordinates, rates and accelerations.
    tables : (T, c, BRACE_SIZE) ndarray
        Braces at each instant.
    torques, normal : (T, n) ndarray, (T, c) ndarray
        Motor torques [N m] and normal forces [N], overwritten.
    """
    for t in range(q.shape[0]):
        for k in range(braces.link.shape[0]):
            for e in range(BRACE_SIZE):
                braces.table[k, e] = tables[t, k, e]
        set_motion(model, ws, q[t], v[t], vdot[t])
        torque_limits(braces, ws)
        if not least_heat_forces(model, ws, braces, intervals):
            return t
        for j in range(torques.shape[1]):
            torques[t, j] = braces.torques[j]
        for k in range(normal.shape[1]):
            normal[t, k] = braces.results[k, FORCES]
    return q.shape[0]


@internal_kernel
def set_motion(model: ModelArrays, ws: Workspace, q, v, vdot):
    """Write coordinates, rates and accelerations to the workspace."""
    read_positions(model, q, 0, ws)
    for j in range(v.shape[0]):
        ws.joints[j, ka.QD], ws.joints[j, ka.QDD] = v[j], vdot[j]


@internal_kernel
def torque_limits(braces: BraceArrays, ws: Workspace):
    """Compute the torque limits of each motor at a steady current: |R i + K_m v| ≤ U, |i| ≤ I.

    A motor that is driven faster than its voltage allows brakes with its maximum torque.
    """
    motors = braces.motors
    for j in range(motors.shape[0]):
        constant, resistance, current = motors[j, CONSTANT], motors[j, RESISTANCE], motors[j, CURRENT_LIMIT]
        low, high = -current, current
        if resistance > 0.0:
            induced = constant * ws.joints[j, ka.QD]
            low = min(max(low, (-motors[j, VOLTAGE_LIMIT] - induced) / resistance), current)
            high = max(min(high, (motors[j, VOLTAGE_LIMIT] - induced) / resistance), -current)
        motors[j, LOWER], motors[j, UPPER] = constant * low, constant * high


@internal_kernel
def least_heat_forces(model: ModelArrays, ws: Workspace, braces: BraceArrays, intervals):
    """Write the torques, forces and intervals of one instant to ``braces``; return whether a solution exists.

    Without a solution, a certificate is written instead.
    """
    results, table, motors = braces.results, braces.table, braces.motors
    c, n, first, x = braces.link.shape[0], braces.free.shape[0], braces.first, braces.program.x
    scale = brace_rows(model, ws, braces)
    unknowns = first[c]
    passive, limited = 0, False
    for j in range(n):
        passive += motors[j, LOWER] == motors[j, UPPER]
        limited |= not (math.isinf(motors[j, LOWER]) and math.isinf(motors[j, UPPER]))
    best = False
    if passive == 0:
        # An optimum without limits that satisfies the limits is also the optimum with limits, as in most cases.
        equations, cones = constraints(braces, scale, False, False)
        middle_forces(braces, scale)
        least_heat(braces, unknowns, equations, cones, scale)
        keep(braces, scale)
        best = not limited or ample(braces, scale)
    if limited and (intervals or not best):
        # Contradictory equations have no margin. First relax them: allow nonzero torques at passive joints.
        if passive > 0:
            equations, cones = constraints(braces, scale, True, True)
            if largest_margin(braces, equations, cones, scale) < -SLACK:
                contradiction(braces, equations, cones, True)
                return False
        equations, cones = constraints(braces, scale, True, False)
        inside = largest_margin(braces, equations, cones, scale)
        if inside < -SLACK:
            contradiction(braces, equations, cones, False)
            return False
        for k in range(unknowns):
            braces.inside[k] = x[k]
        if not best:
            if inside > SLACK:
                least_heat(braces, unknowns, equations, cones, scale)
            keep(braces, scale)
        for k in range(c):
            for end in range(2):
                if table[k, COMMANDED] == table[k, COMMANDED]:
                    results[k, LOW + end] = table[k, COMMANDED]
                elif inside <= SLACK:
                    results[k, LOW + end] = results[k, FORCES]
                elif intervals:
                    results[k, LOW + end] = extreme_force(braces, unknowns, equations, cones, k, end, scale)
        return True
    for k in range(c):
        commanded = table[k, COMMANDED] == table[k, COMMANDED]
        results[k, LOW] = table[k, COMMANDED] if commanded else table[k, LEAST]
        results[k, HIGH] = table[k, COMMANDED] if commanded else math.inf
    return True


@internal_kernel
def keep(braces: BraceArrays, scale):
    """Write the torques and forces that result from the unknowns x to ``braces``."""
    for j in range(braces.free.shape[0]):
        torque = braces.free[j]
        for k in range(braces.first[braces.link.shape[0]]):
            torque -= braces.B[k, j] * scale * braces.program.x[k]
        braces.torques[j] = torque
    for k in range(braces.link.shape[0]):
        brace_forces(braces, k, scale)


@internal_kernel
def brace_forces(braces: BraceArrays, k, scale):
    """Compute the force of brace k from the unknowns, along its axes and in the world."""
    table, results, x, at = braces.table, braces.results, braces.program.x, braces.first[k]
    normal = table[k, COMMANDED]
    if normal != normal:
        normal, at = scale * x[at], at + 1
    results[k, FORCES] = normal
    for e in range(2):
        directed = at == braces.first[k + 1]
        results[k, FORCES + 1 + e] = (
            -table[k, FRICTION] * normal * table[k, SLIP + e] if directed else scale * x[at + e]
        )
    for i in range(3):
        braces.forces[k, i] = 0.0
        for e in range(ka.MOST_ROWS):
            braces.forces[k, i] += results[k, FORCES + e] * table[k, AXES + 3 * e + i]


@internal_kernel
def ample(braces: BraceArrays, scale):
    """Return whether all torques are at an ample distance from their limits."""
    for j in range(braces.free.shape[0]):
        torque, room = braces.torques[j], AMPLE * scale
        if torque - braces.motors[j, LOWER] < room or braces.motors[j, UPPER] - torque < room:
            return False
    return True


@internal_kernel
def middle_forces(braces: BraceArrays, scale):
    """Set the initial forces, along the normals, inside the cones of all braces."""
    table, x, first = braces.table, braces.program.x, braces.first
    for k in range(braces.link.shape[0]):
        for i in range(first[k], first[k + 1]):
            x[i] = 0.0
        if table[k, COMMANDED] != table[k, COMMANDED]:
            x[first[k]] = 1.0 + 2.0 * table[k, LEAST] / scale


@internal_kernel
def largest_margin(braces: BraceArrays, equations, cones, scale):
    """Find the point x inside the constraints with the best worst-case margin; return this margin, at most 1."""
    middle_forces(braces, scale)
    unknowns = braces.first[braces.link.shape[0]]
    return maximise_margin(braces.program, unknowns, equations, cones, 1.0, LEAST_WEIGHT)


@internal_kernel
def brace_rows(model: ModelArrays, ws: Workspace, braces: BraceArrays):
    """Compute the torques without the unknown forces, and the rows B for these forces; return a force scale [N]."""
    newton_euler(model, ws, 1.0, 1.0, 1.0)
    table, B, jacobian, first, n = braces.table, braces.B, braces.jacobian, braces.first, braces.free.shape[0]
    torque, lever, scale = 0.0, 0.0, 1e-3
    for j in range(n):
        losses = model.body[j, ka.DAMPING] + model.body[j, ka.GEAR_DAMPING]
        braces.free[j] = (
            ws.joints[j, ka.BIAS] + model.body[j, ka.ARMATURE] * ws.joints[j, ka.QDD] + losses * ws.joints[j, ka.QD]
        )
        torque = max(torque, abs(braces.free[j]))
    first[0] = 0
    for k in range(braces.link.shape[0]):
        point_position(ws, braces.link[k], table[k], braces.position)
        point_jacobian(model, ws, braces.link[k], braces.position, jacobian)
        if braces.carrier[k] >= 0:
            point_jacobian(model, ws, braces.carrier[k], braces.position, braces.other)
            for i in range(3):
                for j in range(n):
                    jacobian[i, j] -= braces.other[i, j]
        scale = max(scale, table[k, LEAST])
        commanded, mu, at = table[k, COMMANDED] == table[k, COMMANDED], table[k, FRICTION], first[k]
        directed = mu == 0.0 or table[k, SLIP] != 0.0 or table[k, SLIP + 1] != 0.0
        tangents = at + (0 if commanded else 1)
        first[k + 1] = tangents + (0 if directed else 2)
        for j in range(n):
            rate = along(table, jacobian, k, j, 0)
            first_tangent, second_tangent = along(table, jacobian, k, j, 1), along(table, jacobian, k, j, 2)
            lever = max(lever, abs(rate), abs(first_tangent), abs(second_tangent))
            if directed:
                rate -= mu * (table[k, SLIP] * first_tangent + table[k, SLIP + 1] * second_tangent)
            else:
                B[tangents, j], B[tangents + 1, j] = first_tangent, second_tangent
            if commanded:
                braces.free[j] -= table[k, COMMANDED] * rate
            else:
                B[at, j] = rate
    return max(scale, torque / lever) if lever > 0.0 else scale


@internal_kernel
def along(table, jacobian, k, j, e):
    """Return the velocity of brace k's point along axis e of the brace per unit rate j."""
    at = AXES + 3 * e
    return table[k, at] * jacobian[0, j] + table[k, at + 1] * jacobian[1, j] + table[k, at + 2] * jacobian[2, j]


@internal_kernel
def constraints(braces: BraceArrays, scale, limits, relaxed):
    """Set up the equations and cones for the forces divided by ``scale``; return their numbers.

    With ``limits``, the torque limits are included. With ``relaxed``, passive joints have cones instead of equations.
    """
    program, table, B, motors = braces.program, braces.table, braces.B, braces.motors
    A, b, G, h, first = program.A, program.b, program.G, program.h, program.first
    c, n = braces.link.shape[0], braces.free.shape[0]
    unknowns, equations, cones, rows = braces.first[c], 0, 0, 0
    A[:, unknowns] = 0.0
    G[: 4 * c, : unknowns + 1] = 0.0
    h[: 4 * c] = 0.0
    for j in range(c):
        k, mu, commanded = braces.first[j], table[j, FRICTION], table[j, COMMANDED] == table[j, COMMANDED]
        tangents = k + (0 if commanded else 1)
        if not commanded:
            G[rows, k], h[rows], first[cones] = 1.0, -table[j, LEAST] / scale, rows
            G[rows, unknowns] = -1.0
            rows, cones = rows + 1, cones + 1
        if tangents < braces.first[j + 1]:
            first[cones] = rows
            if commanded:
                h[rows] = mu * table[j, COMMANDED] / scale
            else:
                G[rows, k] = mu
            G[rows + 1, tangents], G[rows + 2, tangents + 1], G[rows, unknowns] = 1.0, 1.0, -1.0
            rows, cones = rows + 3, cones + 1
    # The torques are in units of the force scale.
    for j in range(n if limits else 0):
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
def contradiction(braces: BraceArrays, equations, cones, relaxed):
    """Write the certificate of a negative best margin: the torque multipliers, which are joint rates."""
    program, motors = braces.program, braces.motors
    # The torques are the last equations and the last cones, so loop backwards.
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
def extreme_force(braces: BraceArrays, unknowns, equations, cones, j, end, scale):
    """Return the smallest (end 0) or largest (end 1) possible normal force of brace j [N]; x must start inside."""
    program, k, x = braces.program, braces.first[j], braces.program.x
    if end == 0 and equations == 0 and possible_with_least(braces, j):
        return braces.table[j, LEAST]
    rows, first = program.first[cones], program.first
    clear_objective(program, unknowns, LEAST_WEIGHT)
    sign = 1.0 if end == 0 else -1.0
    program.g[k] = sign
    for m in range(unknowns):
        program.G[rows, m] = 0.0
        x[m] = braces.inside[m]
    program.G[rows, k], program.h[rows], first[cones + 1] = sign, FAR, rows + 1
    solve_cone_program(program, unknowns, equations, cones + 1)
    return math.inf if end == 1 and x[k] > 0.999 * FAR else scale * x[k]


@internal_kernel
def possible_with_least(braces: BraceArrays, j):
    """Return whether the forces remain possible when the force of brace j is reduced to its minimum."""
    results, k, least = braces.results, braces.first[j], braces.table[j, LEAST]
    shorter = results[j, FORCES] - least
    share = shorter / results[j, FORCES] if shorter > 0.0 else 0.0
    for i in range(braces.free.shape[0]):
        torque = braces.torques[i] + shorter * braces.B[k, i]
        for e in range(k + 1, braces.first[j + 1]):
            torque += share * results[j, FORCES + e - k] * braces.B[e, i]
        if not braces.motors[i, LOWER] <= torque <= braces.motors[i, UPPER]:
            return False
    return True


@internal_kernel
def least_heat(braces: BraceArrays, unknowns, equations, cones, scale):
    """Find the forces of least heat, or nearest to targets, in units of ``scale`` (H = B w Bᵀ, g = −B w free)."""
    program, B, motors, n = braces.program, braces.B, braces.motors, braces.free.shape[0]
    clear_objective(program, unknowns, LEAST_WEIGHT)
    largest = 0.0
    for j in range(braces.link.shape[0]):
        compliance, k = braces.table[j, COMPLIANCE], braces.first[j]
        if compliance > 0.0:
            program.H[k, k], program.g[k] = compliance, -compliance * braces.table[j, NEAR] / scale
            largest = max(largest, compliance)
    near = largest > 0.0
    for k in range(0 if near else unknowns):
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
