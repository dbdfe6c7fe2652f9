"""Kinematic plant of the snake and the compiled tick loop: plant, controller, mode switching, recording.

The state of the plant is the pose of the base part, the joint angles and the wheel angles. The pose of the controlled
point follows from them and is never integrated: its error is the real one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.kernels.jit import internal_kernel, kernel
from dynsim.kernels.snake import SnakeModel, constraint_matrices, pose_of_point, walk_chain, wrap_angle
from dynsim.kernels.snake_control import (
    LIMITS_ALLOCATE,
    LIMITS_NONE,
    Work,
    control_input,
    estimate_from_joints,
    new_work,
    sigma_min,
)
from dynsim.kernels.snake_support import cost_value, polygon_area, support_polygon

# With gain K, damping that withholds this much of a command leaves a head error of WITHHELD / K [m/s, rad/s].
WITHHELD = 1e-5
MEASURED, ESTIMATED, FEEDFORWARD = 0, 1, 2
# Why a command cannot be carried out.
NO_OBSTACLE, JOINT_LIMIT, RATE_LIMIT, SINGULAR, ATTITUDE = 0, 1, 2, 3, 4
# State.counts
MODE = 0  # row of the mode in Law.grounded
TICKS = 1  # run
CLAMPED = 2  # joint-ticks clamped at a limit
PLACE = 3  # commands carried out of the present block
WAITED = 4  # ticks in which the command could not be carried out and the target waited
SLOWED = 5  # ticks slowed down
NULL_REDUCED = 6  # ticks with less null-space motion
WAITED_FOR = 6  # + JOINT_LIMIT … ATTITUDE: ticks that waited for it
COUNTS_SIZE = WAITED_FOR + ATTITUDE + 1
# A target is not turned further than this towards beta = +-90 deg [rad].
BETA_LIMIT = 0.5 * math.pi - 0.02
# Steps in which a null-space motion that is too fast is reduced, the last of them to nothing.
NULL_REDUCTIONS = 4


class Schedule(NamedTuple):
    """Sampling of the controller."""

    period: float  # control period [s]
    midpoint: int  # 1: the held rates are those of the predicted middle of the period; 0: those of its beginning
    substeps: int  # integration steps of the plant in one control period
    state_source: int  # MEASURED, ESTIMATED or FEEDFORWARD
    null_start_tick: int


class State(NamedTuple):
    """Everything that changes from tick to tick."""

    base: np.ndarray  # (3,) x, y, yaw at wheel pair 1
    phi: np.ndarray  # (n_phi,)
    rho: np.ndarray  # (n_w,)
    w_target: np.ndarray  # (6,) w_d, integrated from the commanded velocity
    w_hat: np.ndarray  # (6,) what the controller believes of w
    phi_hat: np.ndarray  # (n_phi,) what the controller believes of phi
    counts: np.ndarray  # (COUNTS_SIZE,) int


class Rig(NamedTuple):
    """Workspace of the tick loop."""

    work: Work
    base_rate: np.ndarray  # (3,)
    base_sum: np.ndarray  # (3,)
    base_stage: np.ndarray  # (3,)
    phi_stage: np.ndarray  # (n_phi,)
    normal: np.ndarray  # (3, 4)
    px: np.ndarray  # (n_b,) base joint positions relative to pair 1
    py: np.ndarray
    pose: np.ndarray  # (6,)
    target: np.ndarray  # (6,)
    rate: np.ndarray  # (6,) rate of the target that is carried out
    origin: np.ndarray  # (3,)
    command: np.ndarray  # (6,) rate of the target that is asked for


class Trace(NamedTuple):
    """Recorded rows; row r belongs to tick r * stride."""

    base: np.ndarray  # (R, 3)
    phi: np.ndarray  # (R, n_phi)
    rho: np.ndarray  # (R, n_w)
    u: np.ndarray  # (R, n_phi + n_w)
    w: np.ndarray  # (R, 6)
    w_target: np.ndarray  # (R, 6)
    w_hat: np.ndarray  # (R, 6)
    mode: np.ndarray  # (R,) row of Law.grounded
    cost: np.ndarray  # (R,)
    sigma: np.ndarray  # (R,)
    margin: np.ndarray  # (R,)
    area: np.ndarray  # (R,) of the support polygon
    slip: np.ndarray  # (R,)
    at_limit: np.ndarray  # (R, n_phi)
    centre: np.ndarray  # (R, 3)


def new_state(model: SnakeModel) -> State:
    """Zero state."""
    joints = model.head_joints + model.base_joints
    return State(
        base=np.zeros(3),
        phi=np.zeros(joints),
        rho=np.zeros(model.wheels),
        w_target=np.zeros(6),
        w_hat=np.zeros(6),
        phi_hat=np.zeros(joints),
        counts=np.zeros(COUNTS_SIZE, dtype=np.int64),
    )


def new_rig(model: SnakeModel) -> Rig:
    """Empty workspace of :func:`run_ticks`."""
    joints = model.head_joints + model.base_joints
    return Rig(
        work=new_work(model),
        base_rate=np.zeros(3),
        base_sum=np.zeros(3),
        base_stage=np.zeros(3),
        phi_stage=np.zeros(joints),
        normal=np.zeros((3, 4)),
        px=np.zeros(model.base_joints),
        py=np.zeros(model.base_joints),
        pose=np.zeros(6),
        target=np.zeros(6),
        rate=np.zeros(6),
        origin=np.zeros(3),
        command=np.zeros(6),
    )


def new_trace(model: SnakeModel, rows: int) -> Trace:
    """Empty recording of ``rows`` samples."""
    joints = model.head_joints + model.base_joints
    return Trace(
        base=np.zeros((rows, 3)),
        phi=np.zeros((rows, joints)),
        rho=np.zeros((rows, model.wheels)),
        u=np.zeros((rows, joints + model.wheels)),
        w=np.zeros((rows, 6)),
        w_target=np.zeros((rows, 6)),
        w_hat=np.zeros((rows, 6)),
        mode=np.zeros(rows, dtype=np.int64),
        cost=np.zeros(rows),
        sigma=np.zeros(rows),
        margin=np.zeros(rows),
        area=np.zeros(rows),
        slip=np.zeros(rows),
        at_limit=np.zeros((rows, joints), dtype=np.int64),
        centre=np.zeros((rows, 3)),
    )


@internal_kernel
def copy(source, target):
    """target[:] = source; numba's slice assignment would compile its whole error formatting."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@internal_kernel
def base_velocity(model, grounded, yaw, phi, u, rig):
    """Velocity of the base part that the grounded wheels allow, into ``rig.base_rate``.

    Joint and wheel rates are given, so the rows (no side slip of every grounded pair, rolling of every grounded active
    wheel) are more than the three unknowns. Their least-squares solution is the motion of least dissipation when all
    wheels slip against equal viscous friction; between control ticks, when held rates fit the rows only to first order,
    it shares the misfit evenly. A consistent u gives the exact motion.

    Returns
    -------
    slip : float
        Largest residual of a row [m/s].
    """
    normal, out, joints = rig.normal, rig.base_rate, model.head_joints + model.base_joints
    slip = 0.0
    for sweep in range(2):  # 0: sum the normal equations, 1: residuals of the solution
        if sweep == 0:
            for i in range(3):
                for j in range(4):
                    normal[i, j] = 0.0
        x, y, heading, spin = 0.0, 0.0, yaw, 0.0
        for pair in range(model.base_joints + 1):
            if pair > 0:
                c, s = math.cos(heading), math.sin(heading)
                x, y = x - model.link_length * c, y - model.link_length * s
                rig.px[pair - 1], rig.py[pair - 1] = x, y
                heading += phi[model.head_joints + pair - 1]
                spin += u[model.head_joints + pair - 1]
                x -= model.link_length * math.cos(heading)
                y -= model.link_length * math.sin(heading)
            if not grounded[pair]:
                continue
            vx, vy = 0.0, 0.0  # from the joint rates, pair 1 held
            for j in range(pair):
                rate = u[model.head_joints + j]
                vx -= rate * (y - rig.py[j])
                vy += rate * (x - rig.px[j])
            c, s = math.cos(heading), math.sin(heading)
            for kind in range(2):
                if kind == 0:  # -s vx + c vy = 0
                    ax, ay, turn, known = -s, c, 0.0, 0.0
                elif model.wheel[pair] >= 0:  # c vx + s vy - side b omega = r rho'
                    ax, ay, turn = c, s, -model.side[pair] * model.half_track[pair]
                    known = model.wheel_radius * u[joints + model.wheel[pair]]
                else:
                    continue
                aw = -ax * y + ay * x + turn
                rhs = known - ax * vx - ay * vy - turn * spin
                if sweep == 0:
                    row = (ax, ay, aw, rhs)
                    for i in range(3):
                        for j in range(4):
                            normal[i, j] += row[i] * row[j]
                else:
                    slip = max(slip, abs(ax * out[0] + ay * out[1] + aw * out[2] - rhs))
        if sweep == 0:
            for i in range(3):
                for k in range(i + 1, 3):
                    factor = normal[k, i] / normal[i, i]
                    for j in range(i, 4):
                        normal[k, j] -= factor * normal[i, j]
            for i in range(2, -1, -1):
                value = normal[i, 3]
                for j in range(i + 1, 3):
                    value -= normal[i, j] * out[j]
                out[i] = value / normal[i, i]
    return slip


@internal_kernel
def advance_plant(model, grounded, period, substeps, state, u, rig):
    """Hold u for one control period: joints and wheels exactly, base pose by classical Runge-Kutta 4.

    Returns the largest slip met [m/s].
    """
    h, slip = period / substeps, 0.0
    for _ in range(substeps):
        for i in range(3):
            rig.base_sum[i] = 0.0
        for stage in range(4):
            fraction = (0.0, 0.5, 0.5, 1.0)[stage]
            for j in range(state.phi.shape[0]):
                rig.phi_stage[j] = state.phi[j] + fraction * h * u[j]
            for i in range(3):
                rig.base_stage[i] = state.base[i] + (fraction * h * rig.base_rate[i] if stage > 0 else 0.0)
            now = base_velocity(model, grounded, rig.base_stage[2], rig.phi_stage, u, rig)
            slip = max(slip, now)
            weight = (1.0, 2.0, 2.0, 1.0)[stage]
            for i in range(3):
                rig.base_sum[i] += weight * rig.base_rate[i]
        for i in range(3):
            state.base[i] += h / 6.0 * rig.base_sum[i]
        for j in range(state.phi.shape[0]):
            state.phi[j] += h * u[j]
        for j in range(state.rho.shape[0]):
            state.rho[j] += h * u[state.phi.shape[0] + j]
    return slip


@internal_kernel
def believe(model, schedule, state, rig):
    """What the controller takes for w and phi ([T] IV.C.1 and IV.C.2), into ``state.w_hat`` and ``state.phi_hat``."""
    if schedule.state_source != FEEDFORWARD:
        for j in range(state.phi.shape[0]):
            state.phi_hat[j] = state.phi[j]
    if schedule.state_source == MEASURED:
        pose_of_point(model, state.base, state.phi, rig.work.frame, state.w_hat)
    else:
        estimate_from_joints(model, state.phi_hat, rig.work.frame, rig.origin, state.w_hat, rig.pose)


@internal_kernel
def obstacle(law, work, joints):
    """Why ``work.u`` cannot be carried out: SINGULAR, JOINT_LIMIT, RATE_LIMIT or NO_OBSTACLE."""
    if work.withheld[0] > WITHHELD:
        return SINGULAR
    found = NO_OBSTACLE
    for j in range(joints):
        if work.at_limit[j] == 2:
            return JOINT_LIMIT
        if abs(work.u[j]) > law.rate_limit:
            found = RATE_LIMIT
    return found


@internal_kernel
def slow_down(model, law, u, phi):
    """Scale all rates alike such that no joint passes its rate or comes too fast to its limit.

    The constraints are homogeneous in the rates, so the wheels still roll without slip. Returns True when it had to.
    """
    factor = 1.0
    for j in range(phi.shape[0]):
        room = law.limit_rate * max(model.upper[j] - phi[j] if u[j] > 0.0 else phi[j] - model.lower[j], 0.0)
        # what allocation has put on its bound is there to rounding
        allowed = min(law.rate_limit, room + 1e-9)
        if abs(u[j]) > allowed:
            factor = min(factor, allowed / abs(u[j]))
    for j in range(u.shape[0]):
        u[j] *= factor
    return factor < 1.0


@internal_kernel
def tick(model, law, schedule, state, velocity, rig):
    """One control period: evaluate the controller, hold its rates, move the plant and the controller's beliefs.

    Rates of the beginning of the period, held, miss the constraints by O(period) at its end and leave a head error of
    that order. Those of its predicted middle (``schedule.midpoint``) make it O(period^2). The prediction is the closed
    loop itself, w~' = w~_d' - K (w~ - w~_d) ([T] eq 15).

    With the allocating limit policy a command is carried out only as a whole, every joint within its limits and rate;
    a null-space motion that is too fast is reduced. Otherwise the target waits where it is, and what is left to do
    (errors, shape points) is slowed down until it fits. A target that would turn over beta = +-90 deg, where the rates
    of alpha and gamma have no bound, waits too.

    Returns
    -------
    slip : float
        Of the plant [m/s]; the applied rates are in ``rig.work.u``.
    blocked : bool
        The command was not carried out.
    """
    work, period, mode = rig.work, schedule.period, state.counts[MODE]
    phi, phi_hat, w_hat, w_target = state.phi, state.phi_hat, state.w_hat, state.w_target
    pose, target, joints_ahead, u, error, rate = rig.pose, rig.target, rig.phi_stage, work.u, work.error, rig.rate
    joints = phi.shape[0]
    full_gain = law.null_gain if state.counts[TICKS] >= schedule.null_start_tick else 0.0
    null_gain = full_gain
    allocate = law.limit_policy == LIMITS_ALLOCATE
    believe(model, schedule, state, rig)
    copy(velocity, rate)
    reason, waits, reductions, slowed = NO_OBSTACLE, False, 0, False
    beta = wrap_angle(w_target[4])
    if allocate and abs(beta) > BETA_LIMIT and beta * velocity[4] > 0.0:
        reason, waits = ATTITUDE, True
        for i in range(6):
            rate[i] = 0.0
    while True:
        copy(w_hat, pose)
        copy(w_target, target)
        copy(phi_hat, joints_ahead)
        for evaluation in range(1 + schedule.midpoint):
            if evaluation == 1:
                for i in range(6):  # error is the commanded w'
                    pose[i] += 0.5 * period * error[i]
                    target[i] += 0.5 * period * rate[i]
                for j in range(joints):
                    joints_ahead[j] += 0.5 * period * u[j]
            control_input(model, law, work, pose, joints_ahead, target, rate, mode, null_gain)
        if not allocate:
            break
        found = obstacle(law, work, joints)
        if found == NO_OBSTACLE:
            break
        if found == RATE_LIMIT and reductions < NULL_REDUCTIONS and null_gain != 0.0:
            fastest = 0.0
            for j in range(joints):
                fastest = max(fastest, abs(u[j]))
            reductions += 1
            null_gain *= 0.0 if reductions == NULL_REDUCTIONS else 0.9 * law.rate_limit / fastest
        elif not waits:
            reason, waits, null_gain, reductions = found, True, full_gain, 0
            for i in range(6):
                rate[i] = 0.0
        elif null_gain != 0.0:
            null_gain, reductions = 0.0, NULL_REDUCTIONS
        else:
            slowed = slow_down(model, law, u, phi)
            break
    state.counts[SLOWED] += int(slowed)
    state.counts[NULL_REDUCED] += int(reductions > 0)
    if law.limit_policy != LIMITS_NONE:  # the mechanical stop, and what is left when no allocation helps
        for j in range(joints):
            up = max(model.upper[j] - phi[j], 0.0) / period
            down = min(model.lower[j] - phi[j], 0.0) / period
            if u[j] > up or u[j] < down:
                # rounding of an allocated bound is no event
                if u[j] > up + 1e-9 or u[j] < down - 1e-9:
                    state.counts[CLAMPED] += 1
                u[j] = up if u[j] > up else down
    slip = advance_plant(model, law.grounded[mode], period, schedule.substeps, state, u, rig)
    for j in range(joints):
        phi_hat[j] += period * u[j]  # feedforward; overwritten when the joints are read
    for i in range(6):
        w_target[i] += period * rate[i]
        w_hat[i] += period * rate[i]  # x, y, gamma of the estimated state; the rest is overwritten
    state.counts[TICKS] += 1
    commanded = False
    for i in range(6):
        commanded = commanded or velocity[i] != 0.0
    if waits and commanded:
        state.counts[WAITED_FOR + reason] += 1
    return slip, waits and commanded


@kernel
def record_row(model, law, state, rig, r, trace):
    """Write the state, and what follows from it, to row r of the trace."""
    work, chain, support, pose, mode = rig.work, rig.work.chain, rig.work.support, rig.pose, state.counts[MODE]
    phi, rho, grounded = state.phi, state.rho, law.grounded[mode]
    pose_of_point(model, state.base, phi, work.frame, pose)
    walk_chain(model, pose, phi, work.frame, chain)
    sides, margin = support_polygon(model, chain, grounded, support)
    constraint_matrices(model, chain, pose, work.A, work.B)
    trace.mode[r] = mode
    trace.cost[r] = cost_value(law.cost, phi, sides, support, margin)
    trace.margin[r] = margin
    trace.area[r] = polygon_area(support, sides)
    trace.sigma[r] = sigma_min(model, law, work, grounded)
    copy(state.base, trace.base[r])
    copy(support.centre, trace.centre[r])
    copy(pose, trace.w[r])
    copy(state.w_target, trace.w_target[r])
    copy(phi, trace.phi[r])
    copy(rho, trace.rho[r])


@kernel
def run_ticks(model, law, schedule, state, velocity, count, moving, stop, stride, rig, trace):
    """Run control periods in the present mode.

    Parameters
    ----------
    velocity : (T, 6) commanded rates of the target, a block of one row per period; zero after its end. The next row is
        taken only when the last one was carried out (``state.counts[PLACE]`` is the place).
    count : int, control periods to run.
    moving : int, 1: follow the script; 0: the target waits.
    stop : int, 1: return after a period that was blocked.
    stride : int, ticks 0, stride, 2 stride, ... of the run are recorded.

    Returns
    -------
    done : int
        Periods simulated; -1 when the state is no longer finite.
    blocked : bool
        The last period was blocked.
    """
    base, phi, counts, at_limit = state.base, state.phi, state.counts, rig.work.at_limit
    command, blocked = rig.command, False
    for k in range(count):
        now, place = counts[TICKS], counts[PLACE]
        r = now // stride if now % stride == 0 else -1
        if r >= 0:
            record_row(model, law, state, rig, r, trace)
        for i in range(6):
            command[i] = velocity[place, i] if moving and place < velocity.shape[0] else 0.0
        slip, blocked = tick(model, law, schedule, state, command, rig)
        counts[PLACE if moving and not blocked else WAITED] += 1
        if r >= 0:
            trace.slip[r] = slip
            copy(rig.work.u, trace.u[r])
            copy(state.w_hat, trace.w_hat[r])
            for j in range(phi.shape[0]):
                trace.at_limit[r, j] = at_limit[j]
            # beliefs at the beginning of the period: take back the step that the tick has added
            for i in range(6):
                trace.w_hat[r, i] -= schedule.period * rig.rate[i]
        finite = 0.0
        for i in range(3):
            finite += base[i]
        for j in range(phi.shape[0]):
            finite += phi[j]
        if not math.isfinite(finite):
            return -1, blocked
        if stop and moving and blocked:
            return k + 1, blocked
    return count, blocked
