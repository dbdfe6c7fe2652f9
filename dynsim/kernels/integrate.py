"""Time integration of the coupled system: one step per call of a method, error control, projection, sampling.

Methods, all with dense output (so that records do not force steps):

- ``RK43``: the classical method of order 4 with an embedded order 3, adaptive, four evaluations a step; cubic Hermite
  dense output. The first choice: the motors of an arm hold the step at the stability limit (rates of −450 ± 1900i 1/s
  in the published one), whatever the tolerance, and there the fewest evaluations per second win;
- ``DOPRI5``: Dormand–Prince 5(4), adaptive, six evaluations a step; dense output of order 4 (Hairer, Nørsett, Wanner:
  Solving Ordinary Differential Equations I, II.5–II.6). Better where accuracy sets the step;
- ``RK4``: the classical method at a fixed step; cubic Hermite dense output;
- ``RODAS4``: a linearly implicit (Rosenbrock) method of order 4(3), stiffly accurate, which keeps its order when the
  inductance goes to zero (Hairer, Wanner: Solving Ordinary Differential Equations II, IV.7 and VI.4); adaptive.

After each accepted step q and v are projected onto the closed contacts when they have left them by more than
``GAP_TOLERANCE`` or ``RATE_TOLERANCE``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.kernels.arrays import (
    CURRENT,
    D_M,
    DIRECTION,
    FORCE,
    GAP,
    GAP_RATE,
    INDUCTANCE,
    INVERSE_D,
    J_M,
    K_D,
    K_M,
    K_P,
    QD,
    QDD,
    RESISTANCE,
    RHS,
    SLIP_VELOCITY,
    U_MAX,
    VOLTAGE,
    Workspace,
)
from dynsim.kernels.articulated import accelerate
from dynsim.kernels.coupled import System, derivative
from dynsim.kernels.energy import CONTACT_SIZE, LEDGER_SIZE, kinetic_energy, magnetic_energy, potential_energy
from dynsim.kernels.jit import internal_kernel, kernel, merged_kernel, reals
from dynsim.kernels.kinematics import point_position
from dynsim.kernels.rows import solve_small
from dynsim.kernels.uniqueness import REVERSED, ROOM, UNIQUE, clearly_unique, force_verdict

DOPRI5, RK4, RODAS4, RK43 = 0, 1, 2, 3
METHODS = {"rk43": RK43, "dopri5": DOPRI5, "rk4": RK4, "rodas4": RODAS4}

# Projection: a tenth of the drift that is promised (1e-9 m), and a rate that adds less than that in a step.
GAP_TOLERANCE = 1e-10
RATE_TOLERANCE = 1e-8
PROJECTION_LIMIT = 6

RUNNING, FINISHED, NOT_FINITE, STEP_TOO_SMALL, NOT_PROJECTED, NO_FORCES = 0, 1, 2, 3, 4, 5
FORCES_REVERSED, SEVERAL_FORCES = 6, 7

# Run.clock
TIME, STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX = 0, 1, 2, 3, 4, 5, 6
NOT_UNIQUE = 7  # end of the step at which the contact forces were not unique, which was not accepted [s]
CLOCK_SIZE = 8
# Run.count, int
STEPS, REJECTED, EVALUATIONS, PROJECTIONS, SAMPLE, STATUS, STARTED = 0, 1, 2, 3, 4, 5, 6
COUNT_SIZE = 7
# Run.extremes, per contact
FORCE_MIN, FORCE_MAX, DRIFT_MAX = 0, 1, 2
PULLING, LAST_FORCE = 3, 4  # time with a negative normal force [s]; normal force at the last accepted step [N]
LOCAL_SINCE = 5  # first time at which the contact's entry on the diagonal of J M⁻¹ F was negative [s], else inf
EXTREMES_SIZE = 6


class Run(NamedTuple):
    """The moving part of one simulation; m is the length of the state."""

    method: int
    y: np.ndarray  # (m,) state at TIME
    y_new: np.ndarray  # (m,)
    stage: np.ndarray  # (8, m) stage derivatives; stage[0] belongs to y
    dense: np.ndarray  # (4, m) y(θ) = y + θ (d0 + (1−θ)(d1 + θ (d2 + (1−θ) d3)))
    jacobian: np.ndarray  # (2 n + na + 1, m) finite differences along q, v, i, t (rodas4)
    matrix: np.ndarray  # (n, n) factored stage matrix (rodas4)
    pivot: np.ndarray  # (n,) int (rodas4)
    gain: np.ndarray  # (na, 2) k_p and k_d where the voltage is not at its limit, else 0 (rodas4)
    clock: np.ndarray  # (CLOCK_SIZE,)
    count: np.ndarray  # (COUNT_SIZE,) int
    extremes: np.ndarray  # (c, EXTREMES_SIZE)
    room: np.ndarray  # (ROOM, c, c) scratch, see dynsim.kernels.uniqueness
    hand_link: int
    hand_point: np.ndarray  # (3,) in the body's frame
    sample_time: np.ndarray  # (T,)
    sample: np.ndarray  # (T, m) states
    output: np.ndarray  # (T, output_size) see write_output


def new_run(
    method: int,
    y: np.ndarray,
    *,
    n: int,
    na: int,
    c: int,
    sample_time: np.ndarray,
    hand: tuple[int, np.ndarray],
    end: float,
    step: float,
    step_max: float,
    rtol: float,
    atol: float,
) -> Run:
    """Allocate a :class:`Run` from t = 0 at state y, (2 n + na + LEDGER_SIZE + CONTACT_SIZE c,)."""
    m, rodas = len(y), method == RODAS4
    clock = np.zeros(CLOCK_SIZE)
    clock[[STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX]] = step, 1e-4, end, rtol, atol, step_max
    extremes = np.zeros((c, EXTREMES_SIZE))
    extremes[:, FORCE_MIN], extremes[:, FORCE_MAX], extremes[:, LOCAL_SINCE] = np.inf, -np.inf, np.inf
    return Run(
        method=method,
        y=reals(y),
        y_new=np.zeros(m),
        stage=np.zeros((8, m)),
        dense=np.zeros((4, m)),
        jacobian=np.zeros((2 * n + na + 1, m) if rodas else (0, 0)),
        matrix=np.zeros((n, n) if rodas else (0, 0)),
        pivot=np.zeros(n if rodas else 0, dtype=np.int64),
        gain=np.zeros((na, 2)),
        clock=clock,
        count=np.zeros(COUNT_SIZE, dtype=np.int64),
        extremes=extremes,
        room=np.zeros((ROOM, c, c)),
        hand_link=hand[0],
        hand_point=reals(hand[1]),
        sample_time=reals(sample_time),
        sample=np.zeros((len(sample_time), m)),
        output=np.zeros((len(sample_time), output_size(n, na, c))),
    )


def output_size(n: int, na: int, c: int) -> int:
    """Columns of ``Run.output``: vdot n, voltage na, torque na, hand 3, energies 3, then per contact 8."""
    return n + 2 * na + 6 + 8 * c


@internal_kernel
def write_output(system: System, ws: Workspace, run: Run, row):
    """Everything worth recording that is not a state, after ``derivative``: see :func:`output_size`.

    Energies are kinetic, potential, magnetic. Per contact: f_n, the force vector (3), gap, slip velocity (3).
    """
    out, joints, motors, motor, state = run.output, ws.joints, ws.motors, system.drives.motor, ws.contacts
    k = 0
    for i in range(joints.shape[0]):
        out[row, k] = joints[i, QDD]
        k += 1
    for a in range(motors.shape[0]):
        i = system.drives.link[a]
        out[row, k] = motors[a, VOLTAGE]
        out[row, k + motors.shape[0]] = (
            motor[a, K_M] * motors[a, CURRENT] - motor[a, J_M] * joints[i, QDD] - motor[a, D_M] * joints[i, QD]
        )
        k += 1
    k += motors.shape[0]
    point_position(ws, run.hand_link, run.hand_point, out[row, k : k + 3])
    out[row, k + 3] = kinetic_energy(system.model, ws)
    out[row, k + 4] = potential_energy(system.model, ws)
    out[row, k + 5] = magnetic_energy(system.drives, ws)
    k += 6
    for c in range(state.shape[0]):
        out[row, k] = state[c, FORCE]
        out[row, k + 4] = state[c, GAP]
        for s in range(3):
            out[row, k + 1 + s] = state[c, FORCE] * state[c, DIRECTION + 3 + s]
            out[row, k + 5 + s] = state[c, SLIP_VELOCITY + s]
        k += 8


@internal_kernel
def off_surface(ws: Workspace):
    """True when a contact has left its surface by more than the projection tolerances."""
    state = ws.contacts
    for k in range(state.shape[0]):
        # Rounding limits the rate to a fraction of the speed.
        x, y, z = state[k, SLIP_VELOCITY], state[k, SLIP_VELOCITY + 1], state[k, SLIP_VELOCITY + 2]
        rate = RATE_TOLERANCE * (1.0 + math.sqrt(x * x + y * y + z * z))
        if abs(state[k, GAP]) > GAP_TOLERANCE or abs(state[k, GAP_RATE]) > rate:
            return True
    return False


@internal_kernel
def project(system: System, ws: Workspace, y):
    """One Newton step of q and v onto the contacts, weighted by the mass matrix, right after ``derivative`` at y.

    dq = −M⁻¹ Jᵀ λ with J M⁻¹ Jᵀ λ = gap, and the same for v with J v: the nearest point in the kinetic metric. The
    factors of M + J_m and the eliminated rows are those that the derivative has left in the workspace.
    """
    state, column, small = ws.contacts, ws.column, ws.small
    n, p = ws.joints.shape[0], state.shape[0]
    for level in range(2):
        for k in range(p):
            state[k, RHS] = state[k, GAP] if level == 0 else state[k, GAP_RATE]
            for m in range(p):
                small[0, k, m] = 0.0
                for i in range(n):
                    small[0, k, m] += column[i, 1 + 2 * k] * column[i, 1 + 2 * m] * ws.links[i, INVERSE_D]
        solve_small(small, state)
        for i in range(n):
            column[i, 0] = 0.0
            for k in range(p):
                column[i, 0] -= state[k, FORCE] * column[i, 1 + 2 * k]
        accelerate(system.model, ws)
        for i in range(n):
            y[level * n + i] += ws.joints[i, QDD]


@merged_kernel
def settle(system: System, t, y, ws: Workspace, dy, run: Run):
    """Derivative at y, projecting y first where needed. Returns False when the contacts cannot be met."""
    derivative(system, t, y, ws, dy)
    run.count[EVALUATIONS] += 1
    for _ in range(PROJECTION_LIMIT):
        if not off_surface(ws):
            return True
        project(system, ws, y)
        derivative(system, t, y, ws, dy)
        run.count[EVALUATIONS] += 1
        run.count[PROJECTIONS] += 1
    return not off_surface(ws)


@internal_kernel
def error_norm(run: Run, size, error):
    """Root mean square of error / (atol + rtol |y|) over positions, rates and currents, the first ``size`` states."""
    y, y_new, atol, rtol = run.y, run.y_new, run.clock[ATOL], run.clock[RTOL]
    total = 0.0
    for j in range(size):
        x = error[j] / (atol + rtol * max(abs(y[j]), abs(y_new[j])))
        total += x * x
    return math.sqrt(total / size)


@merged_kernel
def ledger_length(ws: Workspace):
    """Number of integrals at the end of the state."""
    return LEDGER_SIZE + CONTACT_SIZE * ws.contacts.shape[0]


# Explicit methods: stage rows a_ij, with the solution as the last row, whose derivative is the next step's first stage.
A_DOPRI5 = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
NODE_DOPRI5 = np.array([0.0, 0.2, 0.3, 0.8, 8 / 9, 1.0, 1.0])
ERROR_DOPRI5 = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
A_RK4 = np.array(
    [[0.0] * 4, [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6]]
)
NODE_RK4 = np.array([0.0, 0.5, 0.5, 1.0, 1.0])
# Weights of h (f(y_new) − k_4), the error estimate of RK43. The fourth stage and the derivative at y_new meet the same
# third-order conditions, so moving any weight between them gives an embedded solution of order 3. All the weight that
# the fourth stage has (1/6) makes the error of undamped motions about rtol. Where stability sets the step, the estimate
# is the transient of modes that die out within some steps; a small weight keeps it from shortening steps for nothing.
WEIGHT_ACCURACY = 1 / 6
WEIGHT_STABILITY = 0.03


@internal_kernel
def weight_rk43(run: Run, size):
    """Weight of the error estimate of RK43, by what sets the step: accuracy or stability.

    z = |h (f(y_new) − k_4)| / |y_new − Y_4|, Y_4 the state of the fourth stage at the same time, is |h λ| of the modes
    that the two differ in (Hairer, Wanner: Solving Ordinary Differential Equations II, IV.2, eq 2.25): the method is
    stable up to z of 2.8, and smooth motions have small ones. The weight falls from 1/6 at z = 0 to 0.03
    from z = √½ on, a quarter of that.
    """
    h, y, y_new, k, atol, rtol = run.clock[STEP], run.y, run.y_new, run.stage, run.clock[ATOL], run.clock[RTOL]
    slope, change = 0.0, 0.0
    for j in range(size):
        scale = 1.0 / (atol + rtol * max(abs(y[j]), abs(y_new[j])))
        df, dy = h * (k[6, j] - k[3, j]) * scale, (y_new[j] - y[j] - h * k[2, j]) * scale
        slope += df * df
        change += dy * dy
    remote = max(1.0 - 2.0 * slope / change, 0.0) if change > 0.0 else 1.0
    return WEIGHT_STABILITY + (WEIGHT_ACCURACY - WEIGHT_STABILITY) * remote * remote


@internal_kernel
def combine(y, h, row, stages, k, y_new):
    """y_new = y + h Σ row_s k_s over the first ``stages`` stages."""
    for j in range(y.shape[0]):
        y_new[j] = y[j]
    for s in range(stages):
        if row[s] != 0.0:
            w = h * row[s]
            for j in range(y.shape[0]):
                y_new[j] += w * k[s, j]


@merged_kernel
def step_explicit(system: System, ws: Workspace, run: Run):
    """One step of an explicit Runge–Kutta method; returns the error norm, 0 for the fixed-step method.

    The last stage is the derivative at y_new; it is left in stage[6], the error estimate in stage[7].
    """
    t, h, y, y_new, k = run.clock[TIME], run.clock[STEP], run.y, run.y_new, run.stage
    A = A_DOPRI5 if run.method == DOPRI5 else A_RK4
    node = NODE_DOPRI5 if run.method == DOPRI5 else NODE_RK4
    last = A.shape[0] - 1
    for s in range(1, last + 1):
        combine(y, h, A[s], s, k, y_new)
        derivative(system, t + node[s] * h, y_new, ws, k[s if s < last else 6])
        # A fixed step may jump over what an error estimate would not let pass, so its stages are watched too.
        stage = k[s if s < last else 6]
        if run.method == RK4 and finite(stage) and not forces_unique(system, ws, run, t + node[s] * h):
            return 0.0
    run.count[EVALUATIONS] += last
    if run.method == RK4:
        return 0.0
    if run.method == RK43:
        weight = weight_rk43(run, y.shape[0] - ledger_length(ws))
        for j in range(y.shape[0]):
            k[7, j] = weight * h * (k[6, j] - k[3, j])
    else:
        for j in range(y.shape[0]):
            k[7, j] = 0.0
        combine(k[7], h, ERROR_DOPRI5, 7, k, k[7])
    return error_norm(run, y.shape[0] - ledger_length(ws), k[7])


# RODAS4(3), coefficients of Hairer and Wanner: a_ij and c_ij by stage, nodes, γ_i, dense output.
GAMMA = 0.25
A_RODAS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [1.544000000000000, 0.0, 0.0, 0.0, 0.0],
        [0.9466785280815826, 0.2557011698983284, 0.0, 0.0, 0.0],
        [3.314825187068521, 2.896124015972201, 0.9986419139977817, 0.0, 0.0],
        [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 0.0],
        [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0],
    ]
)
C_RODAS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [-5.668800000000000, 0.0, 0.0, 0.0, 0.0],
        [-2.430093356833875, -0.2063599157091915, 0.0, 0.0, 0.0],
        [-0.1073529058151375, -9.594562251023355, -20.47028614809616, 0.0, 0.0],
        [7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160, 0.0],
        [8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054],
    ]
)
NODE_RODAS = np.array([0.0, 0.386, 0.21, 0.63, 1.0, 1.0])
GAMMA_RODAS = np.array([0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0])
D_RODAS = np.array(
    [
        [10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662],
        [-0.6762803392806898, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872],
    ]
)


@merged_kernel
def differentiate(system: System, ws: Workspace, run: Run):
    """Finite differences of the right-hand side along q, v, i and t at (TIME, y), into ``run.jacobian``.

    Currents enter linearly, so their differences are exact; the stiff electrical rows are not taken from here but
    written out in :func:`step_rodas4`.
    """
    t, y, y_new, k = run.clock[TIME], run.y, run.y_new, run.stage
    m, states = y.shape[0], y.shape[0] - ledger_length(ws)
    for j in range(m):
        y_new[j] = y[j]
    # The workspace may still hold a sample or a rejected step.
    derivative(system, t, y, ws, k[7])
    for a in range(ws.motors.shape[0]):
        follows = 1.0 if abs(ws.motors[a, VOLTAGE]) < system.drives.motor[a, U_MAX] else 0.0
        run.gain[a, 0] = follows * system.drives.motor[a, K_P]
        run.gain[a, 1] = follows * system.drives.motor[a, K_D]
    for s in range(states):
        delta = 1e-7 * max(abs(y[s]), 1.0)
        y_new[s] = y[s] + delta
        delta = y_new[s] - y[s]
        derivative(system, t, y_new, ws, run.jacobian[s])
        for j in range(m):
            run.jacobian[s, j] = (run.jacobian[s, j] - k[0, j]) / delta
        y_new[s] = y[s]
    delta = 1e-6
    derivative(system, t + delta, y_new, ws, run.jacobian[states])
    for j in range(m):
        run.jacobian[states, j] = (run.jacobian[states, j] - k[0, j]) / delta
    run.count[EVALUATIONS] += states + 2


@merged_kernel
def factor_stage_matrix(system: System, ws: Workspace, run: Run, h):
    """Reduced stage matrix of RODAS4 in the rates alone, LU-factored with partial pivoting, into ``run.matrix``.

    With g = 1/(γ h): u_q = (r_q + u_v)/g and u_i = (r_i − (k_p u_q + (k_d + K_m) u_v)/L) / (g + R/L) are exact, which
    leaves (g − ∂v̇/∂v − ∂v̇/∂q/g + ∂v̇/∂i (k_p/g + k_d + K_m)/L/(g + R/L)) u_v = r. A saturated motor has k_p = k_d = 0.
    """
    W, jacobian, motor = run.matrix, run.jacobian, system.drives.motor
    n, na = ws.joints.shape[0], ws.motors.shape[0]
    g = 1.0 / (GAMMA * h)
    for i in range(n):
        for j in range(n):
            W[i, j] = -jacobian[n + j, n + i] - jacobian[j, n + i] / g
        W[i, i] += g
    for a in range(na):
        j = system.drives.link[a]
        slope = (run.gain[a, 0] / g + run.gain[a, 1] + motor[a, K_M]) / (
            motor[a, INDUCTANCE] * g + motor[a, RESISTANCE]
        )
        for i in range(n):
            W[i, j] += jacobian[2 * n + a, n + i] * slope
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(W[i, k]) > abs(W[best, k]):
                best = i
        run.pivot[k] = best
        if best != k:
            for j in range(n):
                W[k, j], W[best, j] = W[best, j], W[k, j]
        for i in range(k + 1, n):
            W[i, k] /= W[k, k]
            for j in range(k + 1, n):
                W[i, j] -= W[i, k] * W[k, j]


@merged_kernel
def step_rodas4(system: System, ws: Workspace, run: Run):
    """One RODAS4 step; returns the error norm. stage[1…5] are stage vectors, stage[6] the derivative at y_new.

    (1/(γh) − J) u_i = f(t + α_i h, y + Σ a_ij u_j) + Σ c_ij u_j / h + γ_i h ∂f/∂t; y_new = y + Σ a_6j u_j + u_6, and
    u_6 is the error estimate.
    """
    t, h, y, y_new, k = run.clock[TIME], run.clock[STEP], run.y, run.y_new, run.stage
    n, na, m = ws.joints.shape[0], ws.motors.shape[0], run.y.shape[0]
    states = 2 * n + na
    differentiate(system, ws, run)
    factor_stage_matrix(system, ws, run, h)
    g = 1.0 / (GAMMA * h)
    motor, jacobian, W, r = system.drives.motor, run.jacobian, run.matrix, k[7]
    for s in range(6):
        u = k[1 + s]
        for j in range(m):
            y_new[j] = y[j]
            for q in range(s):
                y_new[j] += A_RODAS[s, q] * k[1 + q, j]
        derivative(system, t + NODE_RODAS[s] * h, y_new, ws, r)
        for j in range(m):
            r[j] += GAMMA_RODAS[s] * h * jacobian[states, j]
            for q in range(s):
                r[j] += C_RODAS[s, q] / h * k[1 + q, j]
        for i in range(n):
            u[n + i] = r[n + i]
            for j in range(n):
                u[n + i] += jacobian[j, n + i] * r[j] / g
        for a in range(na):
            j = system.drives.link[a]
            free = r[2 * n + a] - run.gain[a, 0] / motor[a, INDUCTANCE] * r[j] / g
            free /= g + motor[a, RESISTANCE] / motor[a, INDUCTANCE]
            for i in range(n):
                u[n + i] += jacobian[2 * n + a, n + i] * free
        for i in range(n):
            p = run.pivot[i]
            u[n + i], u[n + p] = u[n + p], u[n + i]
        for i in range(n):
            for j in range(i):
                u[n + i] -= W[i, j] * u[n + j]
        for i in range(n - 1, -1, -1):
            for j in range(i + 1, n):
                u[n + i] -= W[i, j] * u[n + j]
            u[n + i] /= W[i, i]
        for i in range(n):
            u[i] = (r[i] + u[n + i]) / g
        for a in range(na):
            j = system.drives.link[a]
            pull = run.gain[a, 0] * u[j] + (run.gain[a, 1] + motor[a, K_M]) * u[n + j]
            u[2 * n + a] = (r[2 * n + a] - pull / motor[a, INDUCTANCE]) / (
                g + motor[a, RESISTANCE] / motor[a, INDUCTANCE]
            )
        for j in range(states, m):
            total = r[j]
            for q in range(states):
                total += jacobian[q, j] * u[q]
            u[j] = total / g
    for j in range(m):
        y_new[j] += k[6, j]
        k[7, j] = k[6, j]
    error = error_norm(run, states, k[7])
    derivative(system, t + h, y_new, ws, k[6])
    run.count[EVALUATIONS] += 7
    return error


@internal_kernel
def fill_dense(run: Run):
    """Coefficients of the dense output over the step from y to y_new, see ``Run.dense``."""
    h, y, y_new, k, d = run.clock[STEP], run.y, run.y_new, run.stage, run.dense
    for j in range(y.shape[0]):
        d[0, j] = y_new[j] - y[j]
        d[3, j] = 0.0
        if run.method == RODAS4:
            d[1, j], d[2, j] = 0.0, 0.0
            for s in range(5):
                d[1, j] += D_RODAS[0, s] * k[1 + s, j]
                d[2, j] += D_RODAS[1, s] * k[1 + s, j]
        else:
            d[1, j] = h * k[0, j] - d[0, j]
            d[2, j] = d[0, j] - h * k[6, j] - d[1, j]
            if run.method == DOPRI5:
                d[3, j] = h * (
                    -12715105075.0 / 11282082432.0 * k[0, j]
                    + 87487479700.0 / 32700410799.0 * k[2, j]
                    - 10690763975.0 / 1880347072.0 * k[3, j]
                    + 701980252875.0 / 199316789632.0 * k[4, j]
                    - 1453857185.0 / 822651844.0 * k[5, j]
                    + 69997945.0 / 29380423.0 * k[6, j]
                )


@merged_kernel
def sample_step(system: System, ws: Workspace, run: Run):
    """Record every sample time within the step from TIME to TIME + STEP, from the dense output.

    Samples are projected like steps are, so that recorded gaps hold the promised tolerance too.
    """
    t, h = run.clock[TIME], run.clock[STEP]
    last = run.count[SAMPLE]
    # A sample at END must not be lost to the rounding of t + h.
    until = run.clock[END] if t + h >= run.clock[END] - 1e-12 * max(1.0, run.clock[END]) else t + h
    if last >= run.sample_time.shape[0] or run.sample_time[last] > until:
        return
    fill_dense(run)
    d = run.dense
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        x = min((run.sample_time[last] - t) / h, 1.0)
        z = 1.0 - x
        row = run.sample[last]
        for j in range(row.shape[0]):
            row[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))
        settle(system, run.sample_time[last], row, ws, run.stage[7], run)
        write_output(system, ws, run, last)
        last += 1
    run.count[SAMPLE] = last


@internal_kernel
def watch(ws: Workspace, run: Run, h):
    """Extremes of normal forces and gaps at accepted steps; time of pulling, the force linear within the last step."""
    state, extremes = ws.contacts, run.extremes
    for k in range(state.shape[0]):
        low = min(extremes[k, LAST_FORCE], state[k, FORCE])
        high = max(extremes[k, LAST_FORCE], state[k, FORCE])
        if low < 0.0 and h > 0.0:
            extremes[k, PULLING] += h if high <= 0.0 else h * low / (low - high)
        extremes[k, LAST_FORCE] = state[k, FORCE]
        extremes[k, FORCE_MIN] = min(extremes[k, FORCE_MIN], state[k, FORCE])
        extremes[k, FORCE_MAX] = max(extremes[k, FORCE_MAX], state[k, FORCE])
        extremes[k, DRIFT_MAX] = max(extremes[k, DRIFT_MAX], abs(state[k, GAP]))


@internal_kernel
def forces_unique(system: System, ws: Workspace, run: Run, t):
    """True when the contacts determine their forces at time t, right after ``derivative``; else sets STATUS."""
    verdict = force_verdict(system.contacts, ws, run.room, run.extremes[:, LOCAL_SINCE], t)
    if verdict == UNIQUE:
        return True
    run.count[STATUS] = FORCES_REVERSED if verdict == REVERSED else SEVERAL_FORCES
    run.clock[NOT_UNIQUE] = t
    return False


@kernel
def finite(values):
    """True when no element is NaN or infinite."""
    total = 0.0
    for j in range(values.shape[0]):
        total += values[j] * 0.0
    return total == 0.0


@internal_kernel
def first_step(run: Run, states):
    """Hairer's first guess of the step size: one that changes the state by a hundredth of its scale."""
    clock, y, k = run.clock, run.y, run.stage
    size, slope = 0.0, 0.0
    for j in range(states):
        scale = clock[ATOL] + clock[RTOL] * abs(y[j])
        size += (y[j] / scale) ** 2
        slope += (k[0, j] / scale) ** 2
    guess = 0.01 * math.sqrt(size / slope) if size > 1e-10 and slope > 1e-10 else 1e-6
    clock[STEP] = min(guess, clock[STEP_MAX], clock[END] - clock[TIME])


@merged_kernel
def start(system: System, ws: Workspace, run: Run):
    """First derivative, on the contacts, and a first step size where none is given. Sets STATUS when there is none."""
    if not settle(system, run.clock[TIME], run.y, ws, run.stage[0], run):
        run.count[STATUS] = NOT_PROJECTED
    elif not finite(run.stage[0]):
        run.count[STATUS] = NO_FORCES if ws.deficient[1] > 0 else NOT_FINITE
    elif forces_unique(system, ws, run, run.clock[TIME]):
        watch(ws, run, 0.0)
        if run.clock[STEP] <= 0.0:
            first_step(run, run.y.shape[0] - ledger_length(ws))
    run.count[STARTED] = 1


@internal_kernel
def choose_step(run: Run):
    """Trim STEP so that END is met exactly: halve the way there rather than leave a sliver for the last step."""
    clock = run.clock
    remaining = clock[END] - clock[TIME]
    if run.method == RK4:
        if remaining < clock[STEP] * (1.0 + 1e-9):
            clock[STEP] = remaining
    elif remaining <= clock[STEP] * 1.0000001:
        clock[STEP] = remaining
    elif remaining < 2.0 * clock[STEP]:
        clock[STEP] = 0.5 * remaining


@internal_kernel
def rejected(ws: Workspace, run: Run, error, order):
    """True when a step of this error norm must be repeated: shrinks STEP, or sets STATUS when that is hopeless."""
    clock, count, h = run.clock, run.count, run.clock[STEP]
    if count[STATUS] != RUNNING:
        return True
    broken = NO_FORCES if ws.deficient[1] > 0 else NOT_FINITE
    if not (finite(run.y_new) and finite(run.stage[6])) or error != error:
        if run.method == RK4:
            count[STATUS] = broken
            return True
        error = 1e10
    if error <= 1.0:
        return False
    count[REJECTED] += 1
    clock[STEP] = h * max(0.1, 0.9 * error ** (-1.0 / order))
    if clock[STEP] < 1e-13 * max(1.0, clock[TIME]):
        count[STATUS] = broken if error >= 1e10 else STEP_TOO_SMALL
    return True


@merged_kernel
def accept(system: System, ws: Workspace, run: Run):
    """Project y_new, record, and make it the new y. Sets STATUS when contacts cannot be met or forces not be known."""
    t, h = run.clock[TIME], run.clock[STEP]
    if off_surface(ws) and not settle(system, t + h, run.y_new, ws, run.stage[6], run):
        run.count[STATUS] = NOT_PROJECTED
        return
    if not (clearly_unique(system.contacts, ws) or forces_unique(system, ws, run, t + h)):
        return
    watch(ws, run, h)
    sample_step(system, ws, run)
    for j in range(run.y.shape[0]):
        run.y[j] = run.y_new[j]
        run.stage[0, j] = run.stage[6, j]
    run.clock[TIME] = t + h
    run.count[STEPS] += 1


@internal_kernel
def next_step(run: Run, error, order, beta):
    """Proportional–integral step control (Hairer, Nørsett, Wanner II.4)."""
    clock = run.clock
    error = max(error, 1e-10)
    change = 0.9 * error ** (0.75 * beta - 1.0 / order) * clock[LAST_ERROR] ** beta
    clock[LAST_ERROR] = max(error, 1e-4)
    clock[STEP] = min(clock[STEP] * min(max(change, 0.2), 5.0), clock[STEP_MAX])


@merged_kernel
def finished(run: Run):
    """True when the run has ended, for whatever reason; sets STATUS at END."""
    end = run.clock[END]
    if run.count[STATUS] == RUNNING and end - run.clock[TIME] <= 1e-12 * max(1.0, end):
        run.count[STATUS] = FINISHED
    return run.count[STATUS] != RUNNING


@kernel
def advance_explicit(system: System, ws: Workspace, run: Run, limit):
    """:func:`advance` of the explicit methods."""
    order = 5.0 if run.method == DOPRI5 else 4.0
    if run.count[STARTED] == 0:
        start(system, ws, run)
    for _ in range(limit):
        if finished(run):
            return
        proposed = run.clock[STEP]
        choose_step(run)
        error = step_explicit(system, ws, run)
        if rejected(ws, run, error, order):
            continue
        accept(system, ws, run)
        if run.method == RK4:
            run.clock[STEP] = proposed
        else:
            next_step(run, error, order, 0.04)


@kernel
def advance_rodas4(system: System, ws: Workspace, run: Run, limit):
    """:func:`advance` of RODAS4."""
    if run.count[STARTED] == 0:
        start(system, ws, run)
    for _ in range(limit):
        if finished(run):
            return
        choose_step(run)
        error = step_rodas4(system, ws, run)
        if rejected(ws, run, error, 4.0):
            continue
        accept(system, ws, run)
        next_step(run, error, 4.0, 0.04)


def advance(system: System, ws: Workspace, run: Run, limit: int) -> None:
    """Take up to ``limit`` steps towards END; run.count[STATUS] says how it ended.

    Two compiled functions behind one name, so that the linearly implicit method is only compiled when it is used.
    """
    (advance_rodas4 if run.method == RODAS4 else advance_explicit)(system, ws, run, limit)
