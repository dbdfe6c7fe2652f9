"""Compiled task-space control law of the snake: weighted redundancy resolution ([T] eqs 9-17).

The commanded motion determines B~ u, where u are the joint and wheel rates with weights W. With M = B~ W^(-1/2) and its
factorisation M = L Q^T (Householder reflections of the rows, one row at a time), the weighted pseudo-inverse is
B~^(W+) v = W^(-1/2) Q L^-1 v, and I - Q Q^T projects onto the null space. A row can be appended at any time; such a row
excludes a joint from the allocation while it is at its limit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.snake.kinematics import (
    Chain,
    SnakeModel,
    active_rows,
    constraint_matrices,
    new_chain,
    pose_of_point,
    walk_chain,
    wrap_angle,
    zero_arrays,
)
from dynsim.snake.support import Cost, Support, cost_gradient, new_support

# Treatment of joint limits: ignored; clamped in the tick loop; clamped, and joints at a limit excluded from allocation.
LIMITS_NONE, LIMITS_SATURATE, LIMITS_ALLOCATE = 0, 1, 2
# Null-space term: as printed in [T] eq 14, or in a form that never increases the cost; see control_input.
NULL_PAPER, NULL_SAFE = 0, 1


class ControlLaw(NamedTuple):
    """Constants of the controller; SI units, rates [1/s]."""

    gain: np.ndarray  # (6 + m,) diagonal of K
    null_gain: float  # k_eta
    null_form: int
    root_weight_inverse: np.ndarray  # (n_phi + n_w,) diagonal of W^(-1/2)
    shape_joints: np.ndarray  # (m,) joints of the shape controllable points, rows of S
    shape_target: np.ndarray  # (m,) [rad]
    grounded: np.ndarray  # (modes, n_b + 1) 1 for pairs on the ground
    limit_policy: int
    rate_limit: float  # maximum joint rate [rad/s]; a command that requires a higher rate is not executed
    limit_rate: float  # maximum rate towards a joint limit, per remaining angle [1/s]
    damping_sigma: float  # smallest singular value of M below which the solution is damped
    damping_factor: float  # damping at sigma = 0, in the same unit as sigma
    cost: Cost


class ControlWork(NamedTuple):
    """Workspace and results of one controller evaluation."""

    frame: np.ndarray  # (3, 3)
    chain: Chain
    support: Support
    A: np.ndarray  # (n_b + 4 + n_w, 6)
    B: np.ndarray  # (n_b + 4 + n_w, n_u)
    rows: np.ndarray  # (n_b + 4 + n_w,)
    row: np.ndarray  # (n_u,)
    ones: np.ndarray  # (n_u,)
    lower: np.ndarray  # (n_u, n_u) L
    reflector: np.ndarray  # (n_u, n_u)
    beta: np.ndarray  # (n_u,)
    rhs: np.ndarray  # (n_u,)
    solution: np.ndarray  # (n_u,)
    singular: np.ndarray  # (n_u,) left singular vector of the smallest singular value
    error: np.ndarray  # (6,)
    gradient: np.ndarray  # (n_u,) eta
    null_part: np.ndarray  # (n_u,) Q^T times the scaled gradient
    u: np.ndarray  # (n_u,) result: joint rates, wheel rates [rad/s]
    withheld: np.ndarray  # (1,) part of the command that damping removes [m/s, rad/s]
    at_limit: np.ndarray  # (n_phi,) 1: joint excluded from the allocation, 2: joint that could not be excluded


def new_work(model: SnakeModel) -> ControlWork:
    """Allocate the workspace of :func:`control_input`."""
    joints = model.head_joints + model.base_joints
    rows, inputs = model.base_joints + 4 + model.wheels, joints + model.wheels
    sizes = {"frame": (3, 3), "A": (rows, 6), "B": (rows, inputs), "error": 6, "withheld": 1}
    sizes |= dict.fromkeys(("lower", "reflector"), (inputs, inputs))
    sizes |= dict.fromkeys(("row", "beta", "rhs", "solution", "singular", "gradient", "null_part", "u"), inputs)
    return zero_arrays(
        ControlWork,
        sizes,
        chain=new_chain(model),
        support=new_support(model),
        rows=np.zeros(rows, dtype=np.int64),
        ones=np.ones(inputs),
        at_limit=np.zeros(joints, dtype=np.int64),
    )


@internal_kernel
def reflect(j, reflector, beta, vector):
    """Apply reflection j to a vector, in place."""
    s = 0.0
    for i in range(j, vector.shape[0]):
        s += reflector[j, i] * vector[i]
    s *= beta[j]
    for i in range(j, vector.shape[0]):
        vector[i] -= s * reflector[j, i]


@internal_kernel
def add_row(k, row, tolerance, lower, reflector, beta):
    """Extend M = L Q^T by ``row`` after all earlier reflections; write row k of L and reflector k.

    Returns False and keeps k rows if the part of ``row`` that is independent of the earlier rows is shorter than
    ``tolerance``. With tolerance 0 even a dependent row is accepted; its pivot is tiny, and damping must handle it.
    """
    n = row.shape[0]
    norm = 0.0
    for i in range(k, n):
        norm += row[i] * row[i]
    norm = math.sqrt(norm)
    if k >= n or norm < tolerance:
        return False
    pivot = -math.copysign(max(norm, 1e-14), row[k])
    for j in range(k):
        lower[k, j] = row[j]
        reflector[k, j] = 0.0
    lower[k, k] = pivot
    for i in range(k, n):
        reflector[k, i] = row[i]
    reflector[k, k] -= pivot
    square = 0.0
    for i in range(k, n):
        square += reflector[k, i] * reflector[k, i]
    beta[k] = 2.0 / square
    return True


@internal_kernel
def smallest_singular_value(count, tolerance, lower, u, y):
    """Compute the smallest singular value of L (count x count, lower triangular) by inverse iteration.

    The left singular vector is written to ``u``, ``y`` is workspace, and ``tolerance`` is the relative change that ends
    the iteration. The entries of the first vector have equal magnitude; their signs are chosen one by one to make y
    large (Cline, Moler, Stewart, Wilkinson 1979). A fixed first vector would be orthogonal to the singular vector in
    some postures, and the iteration would then end at the second smallest value. The convergence factor is the square
    of the ratio of the two smallest singular values: near a singularity, where the value and vector matter, two or
    three steps are sufficient; if the two values are close, any combination of their vectors is adequate.
    """
    sigma = math.inf
    for iteration in range(60):
        norm = 0.0
        for i in range(count):
            s = 0.0
            for j in range(i):
                s += lower[i, j] * y[j]
            if iteration == 0:
                u[i] = -math.copysign(1.0 / math.sqrt(count), s)
            y[i] = (u[i] - s) / lower[i, i]
            norm += y[i] * y[i]
        previous, sigma = sigma, 1.0 / math.sqrt(norm)
        norm = 0.0
        for i in range(count - 1, -1, -1):
            s = y[i]
            for j in range(i + 1, count):
                s -= lower[j, i] * u[j]
            u[i] = s / lower[i, i]
            norm += u[i] * u[i]
        norm = math.sqrt(norm)
        for i in range(count):
            u[i] /= norm
        if abs(previous - sigma) <= tolerance * sigma:
            break
    return sigma


@internal_kernel
def factor_rows(B, rows, count, shape_joints, scale, lower, reflector, beta):
    """Factorise B~ diag(scale) = L Q^T for a mode; B~ is ``rows[:count]`` of B, then S. Return the number of rows.

    Each reflection is applied to all later rows at once, because the processor overlaps their independent sums.
    """
    total = count + shape_joints.shape[0]
    for k in range(total):
        for i in range(scale.shape[0]):
            reflector[k, i] = B[rows[k], i] * scale[i] if k < count else 0.0
        if k >= count:
            reflector[k, shape_joints[k - count]] = scale[shape_joints[k - count]]
    for j in range(total):
        add_row(j, reflector[j], 0.0, lower, reflector, beta)
        for k in range(j + 1, total):
            reflect(j, reflector, beta, reflector[k])
    return total


@kernel
def sigma_min(model, law, work, grounded):
    """Return the smallest singular value of the unweighted B~ of a mode; ``work.B`` must be up to date."""
    lower = work.lower
    count = active_rows(model, grounded, work.rows)
    k = factor_rows(work.B, work.rows, count, law.shape_joints, work.ones, lower, work.reflector, work.beta)
    return smallest_singular_value(k, 1e-6, lower, work.singular, work.solution)


@internal_kernel
def solve_input(law, work, rows, null_gain):
    """Solve u = W^(-1/2) (Q L^-1 rhs - k_eta (I - Q Q^T) W^(1/2) n), n = eta (eq 14) or W^-1 eta (safe form)."""
    y, u, g, rhs = work.solution, work.u, work.null_part, work.rhs
    lower, reflector, beta, root = work.lower, work.reflector, work.beta, law.root_weight_inverse
    n = u.shape[0]
    for i in range(rows):
        s = rhs[i]
        for j in range(i):
            s -= lower[i, j] * y[j]
        y[i] = s / lower[i, i]
    for i in range(rows, n):
        y[i] = 0.0
    if null_gain != 0.0:
        gradient, safe = work.gradient, law.null_form == NULL_SAFE
        for i in range(n):
            g[i] = gradient[i] * (root[i] if safe else 1.0 / root[i])
        for j in range(rows):
            reflect(j, reflector, beta, g)
        for i in range(rows, n):
            y[i] = -null_gain * g[i]
    for j in range(rows - 1, -1, -1):
        reflect(j, reflector, beta, y)
    for i in range(n):
        u[i] = root[i] * y[i]


@internal_kernel
def worst_limit_violation(model, law, work, phi):
    """Return the joint whose rate exceeds its bound the most, and this bound; (-1, 0) if no rate exceeds its bound."""
    u, at_limit, upper, lower, rate = work.u, work.at_limit, model.upper, model.lower, law.limit_rate
    worst, joint, bound = 1e-12, -1, 0.0
    for j in range(phi.shape[0]):
        up = rate * (upper[j] - phi[j])
        down = rate * (lower[j] - phi[j])
        excess = max(u[j] - up, down - u[j])
        if at_limit[j] == 0 and excess > worst:
            worst, joint, bound = excess, j, up if u[j] > up else down
    return joint, bound


@kernel
def control_input(model, law, work, w, phi, w_target, velocity, mode, null_gain):
    """Evaluate the control law once, and write the joint and wheel rates u of [T] eqs 12-14 to ``work.u``.

    u = B~^(W+) A~ (w~_d' - K (w~ - w~_d)) - k_eta (I - B~^(W+) B~) n, with n = eta (the paper's eq 14) or W^-1 eta
    (safe: eta . u_ker <= 0 for every W). Near a singular B~ only the part of the command along the weakest direction is
    scaled, by sigma^2 / (sigma^2 + lambda^2) with lambda^2 = (1 - (sigma/damping_sigma)^2) damping_factor^2; the
    null-space part remains an exact projection.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    law : ControlLaw
        Constants of the controller.
    work : ControlWork
        Workspace and results.
    w : (6,) ndarray
        Estimated pose of the controlled point [m, rad].
    phi : (n_phi,) ndarray
        Estimated joint angles [rad].
    w_target, velocity : (6,) ndarray
        Target pose [m, rad] and its rate [m/s, rad/s].
    mode : int
        Row of ``law.grounded``.
    null_gain : float
        k_eta, or 0 to disable the null-space term.

    Returns
    -------
    sigma : float
        Smallest singular value of B~ W^(-1/2).
    """
    chain, A, B, kept, row, rhs = work.chain, work.A, work.B, work.rows, work.row, work.rhs
    lower, reflector, beta, error, singular = work.lower, work.reflector, work.beta, work.error, work.singular
    at_limit, grounded = work.at_limit, law.grounded[mode]
    gain, root, shape_joints, shape_target = law.gain, law.root_weight_inverse, law.shape_joints, law.shape_target

    walk_chain(model, w, phi, work.frame, chain)
    constraint_matrices(model, chain, w, A, B)
    count = active_rows(model, grounded, kept)
    rows = factor_rows(B, kept, count, shape_joints, root, lower, reflector, beta)

    for i in range(6):
        deviation = w[i] - w_target[i]
        error[i] = velocity[i] - gain[i] * (deviation if i < 3 else wrap_angle(deviation))
    for r in range(count):
        s = 0.0
        for i in range(6):
            s += A[kept[r], i] * error[i]
        rhs[r] = s
    for s in range(shape_joints.shape[0]):
        rhs[count + s] = -gain[6 + s] * (phi[shape_joints[s]] - shape_target[s])

    sigma = smallest_singular_value(rows, 1e-3, lower, singular, work.solution)
    work.withheld[0] = 0.0
    if sigma < law.damping_sigma:
        ratio = sigma / law.damping_sigma
        damping = (1.0 - ratio * ratio) * law.damping_factor**2
        along = 0.0
        for i in range(rows):
            along += singular[i] * rhs[i]
        along *= damping / (sigma * sigma + damping)
        for i in range(rows):
            rhs[i] -= along * singular[i]
        work.withheld[0] = abs(along)

    if null_gain != 0.0:
        cost_gradient(model, law.cost, chain, phi, grounded, work.support, work.gradient)
    for j in range(phi.shape[0]):
        at_limit[j] = 0
    joint = 0
    while joint >= 0:
        solve_input(law, work, rows, null_gain)
        if law.limit_policy != LIMITS_ALLOCATE:
            break
        joint, bound = worst_limit_violation(model, law, work, phi)
        while joint >= 0:
            for i in range(row.shape[0]):
                row[i] = 0.0
            row[joint] = root[joint]
            for j in range(rows):
                reflect(j, reflector, beta, row)
            # If almost only this joint can perform the task, the other joints would need 1/tolerance times its rate.
            if add_row(rows, row, 1e-3 * root[joint], lower, reflector, beta):
                rhs[rows] = bound
                rows += 1
                at_limit[joint] = 1
                break
            at_limit[joint] = 2
            joint, bound = worst_limit_violation(model, law, work, phi)
    return sigma


@internal_kernel
def estimate_from_joints(model, phi, frame, base, w_hat, w):
    """Estimate z, alpha, beta from the head joints for a level base ([T] IV.C.1); x, y, gamma keep integrated values.

    ``w_hat``, shape (6,), keeps its x, y, gamma; ``base`` and ``w`` are workspace.
    """
    base[0], base[1], base[2] = 0.0, 0.0, 0.0
    pose_of_point(model, base, phi, frame, w)
    for i in range(2, 5):
        w_hat[i] = w[i]
