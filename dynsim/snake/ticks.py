"""The compiled tick loop: state estimate, limits on the target's speed, control, plant and recording."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.snake import controller
from dynsim.snake.controller import ControlWork, control_input, estimate_from_joints, new_work, sigma_min
from dynsim.snake.kinematics import SnakeModel, constraint_matrices, pose_of_point, walk_chain, wrap_angle
from dynsim.snake.support import cost_value, polygon_area, support_polygon

# Data of the tick loop: schedule, state of plant and controller, workspace, recorded rows.


# Source of the state that the controller believes; GIVEN: the caller that moves the robot writes it.
MEASURED, ESTIMATED, FEEDFORWARD, GIVEN = 0, 1, 2, 3
# Why a command cannot be carried out.
NO_OBSTACLE, JOINT_LIMIT, RATE_LIMIT, SINGULAR, ATTITUDE = 0, 1, 2, 3, 4
# State.counts
MODE = 0  # row of the mode in ControlLaw.grounded
TICKS = 1  # run
CLAMPED = 2  # joint-ticks clamped at a limit
CARRIED_OUT = 3  # commands carried out of the present block
WAITED = 4  # ticks in which the command could not be carried out and the target waited
SLOWED = 5  # ticks slowed down
NULL_REDUCED = 6  # ticks with less null-space motion
WAITED_FOR = 6  # + JOINT_LIMIT … ATTITUDE: ticks that waited for it
PATH_SLOWED = WAITED_FOR + ATTITUDE + 1  # ticks in which the target moved slower than commanded
STILL = PATH_SLOWED + 1  # ticks for which the target has now waited without a break
STILL_FOR = STILL + 1  # what it waited for last
COUNTS_SIZE = STILL_FOR + 1
# State.progress
DONE = 0  # part of the present row of commands that is carried out, 0 to 1
LATE = 1  # control periods that a slower target has lost


class Schedule(NamedTuple):
    """Sampling of the controller."""

    period: float  # control period [s]
    midpoint: int  # 1: the held rates are those of the predicted middle of the period; 0: those of its beginning
    substeps: int  # integration steps of the plant in one control period
    state_source: int  # MEASURED, ESTIMATED, FEEDFORWARD or GIVEN
    null_start_tick: int


class SnakeState(NamedTuple):
    """Everything that changes from tick to tick."""

    base: np.ndarray  # (3,) x, y, yaw at wheel pair 1
    phi: np.ndarray  # (n_phi,)
    rho: np.ndarray  # (n_w,)
    w_target: np.ndarray  # (6,) w_d, integrated from the commanded velocity
    w_hat: np.ndarray  # (6,) what the controller believes of w
    phi_hat: np.ndarray  # (n_phi,) what the controller believes of phi
    counts: np.ndarray  # (COUNTS_SIZE,) int
    progress: np.ndarray  # (2,)


class TickWorkspace(NamedTuple):
    """Workspace of the tick loop."""

    work: ControlWork
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


class SnakeTrace(NamedTuple):
    """Recorded rows; row r belongs to tick r * stride."""

    base: np.ndarray  # (R, 3)
    phi: np.ndarray  # (R, n_phi)
    rho: np.ndarray  # (R, n_w)
    u: np.ndarray  # (R, n_phi + n_w)
    w: np.ndarray  # (R, 6)
    w_target: np.ndarray  # (R, 6)
    w_hat: np.ndarray  # (R, 6)
    mode: np.ndarray  # (R,) row of ControlLaw.grounded
    cost: np.ndarray  # (R,)
    sigma: np.ndarray  # (R,)
    margin: np.ndarray  # (R,)
    area: np.ndarray  # (R,) of the support polygon
    slip: np.ndarray  # (R,)
    at_limit: np.ndarray  # (R, n_phi)
    centre: np.ndarray  # (R, 3)


def new_state(model: SnakeModel) -> SnakeState:
    """Zero state."""
    joints = model.head_joints + model.base_joints
    return SnakeState(
        base=np.zeros(3),
        phi=np.zeros(joints),
        rho=np.zeros(model.wheels),
        w_target=np.zeros(6),
        w_hat=np.zeros(6),
        phi_hat=np.zeros(joints),
        counts=np.zeros(COUNTS_SIZE, dtype=np.int64),
        progress=np.zeros(2),
    )


def new_tick_workspace(model: SnakeModel) -> TickWorkspace:
    """Empty workspace of :func:`run_ticks`."""
    joints = model.head_joints + model.base_joints
    return TickWorkspace(
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
    )


def new_trace(model: SnakeModel, rows: int) -> SnakeTrace:
    """Empty recording of ``rows`` samples."""
    joints = model.head_joints + model.base_joints
    return SnakeTrace(
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


# Kinematic plant of the snake: grounded wheels move the base; joints and wheels follow their commands.


@internal_kernel
def base_velocity(model, grounded, yaw, phi, u, ws):
    """Velocity of the base part that the grounded wheels allow, into ``ws.base_rate``.

    Joint and wheel rates are given, so the rows (no side slip of every grounded pair, rolling of every grounded active
    wheel) are more than the three unknowns. Their least-squares solution is the motion of least dissipation when all
    wheels slip against equal viscous friction; between control ticks, when held rates fit the rows only to first order,
    it shares the misfit evenly. A consistent u gives the exact motion.

    Returns
    -------
    slip : float
        Largest residual of a row [m/s].
    """
    normal, out, joints = ws.normal, ws.base_rate, model.head_joints + model.base_joints
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
                ws.px[pair - 1], ws.py[pair - 1] = x, y
                heading += phi[model.head_joints + pair - 1]
                spin += u[model.head_joints + pair - 1]
                x -= model.link_length * math.cos(heading)
                y -= model.link_length * math.sin(heading)
            if not grounded[pair]:
                continue
            vx, vy = 0.0, 0.0  # from the joint rates, pair 1 held
            for j in range(pair):
                rate = u[model.head_joints + j]
                vx -= rate * (y - ws.py[j])
                vy += rate * (x - ws.px[j])
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
def advance_plant(model, grounded, period, substeps, state, u, ws):
    """Hold u for one control period: joints and wheels exactly, base pose by classical Runge-Kutta 4.

    Returns the largest slip met [m/s].
    """
    h, slip = period / substeps, 0.0
    for _ in range(substeps):
        for i in range(3):
            ws.base_sum[i] = 0.0
        for stage in range(4):
            fraction = (0.0, 0.5, 0.5, 1.0)[stage]
            for j in range(state.phi.shape[0]):
                ws.phi_stage[j] = state.phi[j] + fraction * h * u[j]
            for i in range(3):
                ws.base_stage[i] = state.base[i] + (fraction * h * ws.base_rate[i] if stage > 0 else 0.0)
            now = base_velocity(model, grounded, ws.base_stage[2], ws.phi_stage, u, ws)
            slip = max(slip, now)
            weight = (1.0, 2.0, 2.0, 1.0)[stage]
            for i in range(3):
                ws.base_sum[i] += weight * ws.base_rate[i]
        for i in range(3):
            state.base[i] += h / 6.0 * ws.base_sum[i]
        for j in range(state.phi.shape[0]):
            state.phi[j] += h * u[j]
        for j in range(state.rho.shape[0]):
            state.rho[j] += h * u[state.phi.shape[0] + j]
    return slip


# Part of a command that damping may withhold [m/s, rad/s]; with gain K the head error is WITHHELD / K.
WITHHELD = 1e-5
# A target is not turned further than this towards beta = +-90 deg [rad].
BETA_LIMIT = 0.5 * math.pi - 0.02
# Steps in which a null-space motion that is too fast is reduced, the last of them to nothing.
NULL_REDUCTIONS = 4
# Most trials for a target speed that keeps the limits. Each takes the share ROOM of the speed that the last one allows,
# but at least LEAST_PART of the last speed, as the prediction at a speed far too high is inaccurate.
SLOW_DOWNS = 8
ROOM = 0.98
LEAST_PART = 0.25
# The target waits if it would have to be slower than this share of its commanded speed.
LEAST_SPEED = 0.01
# A joint nearer to its limit than this [rad] is at it; a joint further off that blocks a command was too fast.
AT_LIMIT = 0.05


@internal_kernel
def copy(source, target):
    """target[:] = source; numba's slice assignment would compile its whole error formatting."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@internal_kernel
def believe(model, schedule, state, ws):
    """What the controller takes for w and phi ([T] IV.C.1 and IV.C.2), into ``state.w_hat`` and ``state.phi_hat``."""
    if schedule.state_source == GIVEN:
        return
    if schedule.state_source != FEEDFORWARD:
        for j in range(state.phi.shape[0]):
            state.phi_hat[j] = state.phi[j]
    if schedule.state_source == MEASURED:
        pose_of_point(model, state.base, state.phi, ws.work.frame, state.w_hat)
    else:
        estimate_from_joints(model, state.phi_hat, ws.work.frame, ws.origin, state.w_hat, ws.pose)


@internal_kernel
def obstacle(law, work, joints):
    """Why ``work.u`` cannot be carried out: SINGULAR, JOINT_LIMIT, RATE_LIMIT or NO_OBSTACLE."""
    if work.withheld[0] > WITHHELD:
        return SINGULAR
    reason = NO_OBSTACLE
    for j in range(joints):
        if work.at_limit[j] == 2:
            return JOINT_LIMIT
        if abs(work.u[j]) > law.rate_limit:
            reason = RATE_LIMIT
    return reason


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
def is_too_fast(model, law, work, reason, phi):
    """A slower target would pass: joints are too fast, and what comes too fast to a limit is not at it yet."""
    for j in range(phi.shape[0]):
        if work.at_limit[j] == 2:
            left = model.upper[j] - phi[j] if work.u[j] > 0.0 else phi[j] - model.lower[j]
            if left < AT_LIMIT and abs(work.u[j]) <= law.rate_limit:
                return False
    return reason in (RATE_LIMIT, JOINT_LIMIT)


@internal_kernel
def fitting_part(model, law, work, phi):
    """Part of the rates ``work.u`` that keeps the rate limit and comes to no limit too fast, by a step at a time."""
    part = 1.0
    for j in range(phi.shape[0]):
        allowed, rate = law.rate_limit, abs(work.u[j])
        if work.at_limit[j] == 2:
            left = model.upper[j] - phi[j] if work.u[j] > 0.0 else phi[j] - model.lower[j]
            allowed = min(allowed, law.limit_rate * max(left, 0.0))
        if rate > allowed:
            part = min(part, allowed / rate)
    return max(ROOM * part, LEAST_PART)


@internal_kernel
def commanded_rate(velocity, row, done, speed, rate):
    """Mean rate of the target in a period in which ``speed`` rows of the commands are carried out, 0 to 1.

    The first ``done`` of row ``place`` is carried out already; after the last row the rate is zero. The path is that of
    the rows, whatever the speeds: every row is carried out as a whole, in one period or in several.
    """
    rows = velocity.shape[0]
    first = min(speed, 1.0 - done)
    second = speed - first
    for i in range(6):
        rate[i] = first * velocity[row, i] if row < rows else 0.0
        if second > 0.0 and row + 1 < rows:
            rate[i] += second * velocity[row + 1, i]


@internal_kernel
def command(model, law, schedule, state, velocity, moving, slows, ws):
    """What the controller asks for in one control period: rates of joints and wheels, into ``ws.work.u``.

    Rates of the beginning of the period, held, miss the constraints by O(period) at its end and leave a head error of
    that order. Those of its predicted middle (``schedule.midpoint``) make it O(period^2). The prediction is the closed
    loop itself, w~' = w~_d' - K (w~ - w~_d) ([T] eq 15).

    With the allocating limit policy a command is carried out with all six coordinates in step, every joint within its
    limits and rate. When a joint would be too fast, first the null-space motion is reduced, then (``slows``) the target
    goes along its path with less speed. Otherwise the target waits where it is, and what is left to do (errors, shape
    points) is slowed down until it fits. A target that would turn over beta = +-90 deg, where the rates of alpha and
    gamma have no bound, waits too.

    Parameters
    ----------
    velocity : (T, 6) see :func:`run_ticks`.
    moving : int, 0: the target waits, whatever the commands.
    slows : int, 1: the target may be slower than commanded.

    Returns
    -------
    reason : int
        Why the target waits, see :mod:`dynsim.snake.ticks`; NO_OBSTACLE where it does not.
    commanded : bool
        There was something to carry out.
    speed : float
        Rows of the commands that are carried out, 0 to 1.
    """
    work, period, mode = ws.work, schedule.period, state.counts[MODE]
    phi, phi_hat, w_hat, w_target = state.phi, state.phi_hat, state.w_hat, state.w_target
    pose, target, joints_ahead, u, error, rate = ws.pose, ws.target, ws.phi_stage, work.u, work.error, ws.rate
    joints = phi.shape[0]
    full_gain = law.null_gain if state.counts[TICKS] >= schedule.null_start_tick else 0.0
    null_gain = full_gain
    allocate = law.limit_policy == controller.LIMITS_ALLOCATE
    believe(model, schedule, state, ws)
    reason, waits, reductions, slowed = NO_OBSTACLE, False, 0, False
    row, done, speed, tries = state.counts[CARRIED_OUT], state.progress[DONE], 1.0, 0
    commanded = False
    for i in range(6):
        rate[i] = 0.0
    if moving:
        commanded_rate(velocity, row, done, speed, rate)
    for i in range(6):
        commanded = commanded or rate[i] != 0.0
    beta = wrap_angle(w_target[4])
    if allocate and abs(beta) > BETA_LIMIT and beta * rate[4] > 0.0:
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
        hindrance = obstacle(law, work, joints)
        if hindrance == NO_OBSTACLE:
            break
        fastest = 0.0
        for j in range(joints):
            fastest = max(fastest, abs(u[j]))
        if hindrance == RATE_LIMIT and reductions < NULL_REDUCTIONS and null_gain != 0.0:
            reductions += 1
            null_gain *= 0.0 if reductions == NULL_REDUCTIONS else 0.9 * law.rate_limit / fastest
        elif slows and commanded and tries < SLOW_DOWNS and not waits and is_too_fast(model, law, work, hindrance, phi):
            tries += 1
            speed *= fitting_part(model, law, work, phi)
            if speed < LEAST_SPEED:
                tries = SLOW_DOWNS
            else:
                commanded_rate(velocity, row, done, speed, rate)
        elif not waits:
            reason, waits, null_gain, reductions = hindrance, True, full_gain, 0
            for i in range(6):
                rate[i] = 0.0
        elif null_gain != 0.0:
            null_gain, reductions = 0.0, NULL_REDUCTIONS
        else:
            slowed = slow_down(model, law, u, phi)
            break
    state.counts[SLOWED] += int(slowed)
    state.counts[NULL_REDUCED] += int(reductions > 0)
    if law.limit_policy != controller.LIMITS_NONE:  # the mechanical stop, and what is left when no allocation helps
        for j in range(joints):
            up = max(model.upper[j] - phi[j], 0.0) / period
            down = min(model.lower[j] - phi[j], 0.0) / period
            if u[j] > up or u[j] < down:
                # rounding of an allocated bound is no event
                if u[j] > up + 1e-9 or u[j] < down - 1e-9:
                    state.counts[CLAMPED] += 1
                u[j] = up if u[j] > up else down
    return reason if waits else NO_OBSTACLE, commanded, speed


@internal_kernel
def settle(schedule, state, moving, reason, commanded, speed, ws):
    """End a control period: beliefs, target, and the place in the commands, after :func:`command` and the plant.

    Returns True when the command was not carried out.
    """
    period, u, rate, done = schedule.period, ws.work.u, ws.rate, state.progress[DONE]
    for j in range(state.phi.shape[0]):
        state.phi_hat[j] += period * u[j]  # feedforward; overwritten when the joints are read
    for i in range(6):
        state.w_target[i] += period * rate[i]
        state.w_hat[i] += period * rate[i]  # x, y, gamma of the estimated state; the rest is overwritten
    state.counts[TICKS] += 1
    blocked = reason != NO_OBSTACLE and commanded
    if blocked:
        state.counts[WAITED_FOR + reason] += 1
        state.counts[STILL] += 1
        state.counts[STILL_FOR] = reason
    elif moving:
        state.counts[STILL] = 0
        state.counts[PATH_SLOWED] += int(speed < 1.0)
        state.progress[LATE] += 1.0 - speed
        done += speed
        if done >= 1.0 - 1e-12:
            state.counts[CARRIED_OUT] += 1
            done = max(done - 1.0, 0.0)
        state.progress[DONE] = done
    if blocked or not moving:
        state.counts[WAITED] += 1
    return blocked


@internal_kernel
def tick(model, law, schedule, state, velocity, moving, slows, ws):
    """One control period of the kinematic robot: evaluate the controller, hold its rates, move the plant.

    Parameters as of :func:`command`. Returns the slip of the plant [m/s], and whether the command was not carried out.
    """
    mode = state.counts[MODE]
    reason, commanded, speed = command(model, law, schedule, state, velocity, moving, slows, ws)
    slip = advance_plant(model, law.grounded[mode], schedule.period, schedule.substeps, state, ws.work.u, ws)
    return slip, settle(schedule, state, moving, reason, commanded, speed, ws)


@internal_kernel
def record_command(schedule, state, ws, r, trace):
    """Write to row r of the trace what the controller has asked for in the period that has just ended."""
    copy(ws.work.u, trace.u[r])
    copy(state.w_hat, trace.w_hat[r])
    for j in range(state.phi.shape[0]):
        trace.at_limit[r, j] = ws.work.at_limit[j]
    # beliefs at the beginning of the period: take back the step that it has added
    for i in range(6):
        trace.w_hat[r, i] -= schedule.period * ws.rate[i]


@kernel
def command_tick(model, law, schedule, state, velocity, moving, slows, ws, r, trace):
    """One control period of a robot that something else moves: joints and wheels of ``state`` are what they are told.

    Parameters as of :func:`command`. What was told and believed at its beginning goes to row r of the trace, if it is
    not -1.
    Returns True when the command was not carried out.
    """
    if r >= 0:
        trace.mode[r] = state.counts[MODE]
        copy(state.w_target, trace.w_target[r])
        copy(state.phi, trace.phi[r])
    reason, commanded, speed = command(model, law, schedule, state, velocity, moving, slows, ws)
    blocked = settle(schedule, state, moving, reason, commanded, speed, ws)
    if r >= 0:
        record_command(schedule, state, ws, r, trace)
    joints = state.phi.shape[0]
    for j in range(joints):
        state.phi[j] += schedule.period * ws.work.u[j]
    for j in range(state.rho.shape[0]):
        state.rho[j] += schedule.period * ws.work.u[joints + j]
    return blocked


@kernel
def record_row(model, law, state, ws, r, trace):
    """Write the state, and what follows from it, to row r of the trace."""
    work, chain, support, pose, mode = ws.work, ws.work.chain, ws.work.support, ws.pose, state.counts[MODE]
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
def run_ticks(model, law, schedule, state, velocity, count, moving, stop, stride, ws, trace):
    """Run control periods in the present mode.

    Parameters
    ----------
    velocity : (T, 6) commanded rates of the target, a block of one row per period; zero after its end. The next row is
        taken only when the last one was carried out (``state.counts[CARRIED_OUT]`` is its row, ``state.progress[DONE]``
        the part of that row that is carried out already).
    count : int, control periods to run.
    moving : int, 1: follow the script; 0: the target waits.
    stop : int, 1: return after a period that was blocked; 0: a target that is too fast is slowed down instead.
    stride : int, ticks 0, stride, 2 stride, ... of the run are recorded.

    Returns
    -------
    done : int
        Periods simulated; -1 when the state is no longer finite.
    blocked : bool
        The last period was blocked.
    """
    base, phi, counts = state.base, state.phi, state.counts
    blocked, slows = False, 0 if stop else 1
    for k in range(count):
        now = counts[TICKS]
        r = now // stride if now % stride == 0 else -1
        if r >= 0:
            record_row(model, law, state, ws, r, trace)
        slip, blocked = tick(model, law, schedule, state, velocity, moving, slows, ws)
        if r >= 0:
            trace.slip[r] = slip
            record_command(schedule, state, ws, r, trace)
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
