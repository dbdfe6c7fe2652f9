"""The compiled tick loop: state estimate, limits on the target's speed, control, plant and recording."""

from __future__ import annotations

import math

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.snake import controller
from dynsim.snake import state as ss
from dynsim.snake.controller import control_input, estimate_from_joints, sigma_min
from dynsim.snake.kinematics import constraint_matrices, pose_of_point, walk_chain, wrap_angle
from dynsim.snake.plant import advance_plant
from dynsim.snake.support import cost_value, polygon_area, support_polygon

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
    if schedule.state_source == ss.GIVEN:
        return
    if schedule.state_source != ss.FEEDFORWARD:
        for j in range(state.phi.shape[0]):
            state.phi_hat[j] = state.phi[j]
    if schedule.state_source == ss.MEASURED:
        pose_of_point(model, state.base, state.phi, ws.work.frame, state.w_hat)
    else:
        estimate_from_joints(model, state.phi_hat, ws.work.frame, ws.origin, state.w_hat, ws.pose)


@internal_kernel
def obstacle(law, work, joints):
    """Why ``work.u`` cannot be carried out: SINGULAR, JOINT_LIMIT, RATE_LIMIT or NO_OBSTACLE."""
    if work.withheld[0] > WITHHELD:
        return ss.SINGULAR
    reason = ss.NO_OBSTACLE
    for j in range(joints):
        if work.at_limit[j] == 2:
            return ss.JOINT_LIMIT
        if abs(work.u[j]) > law.rate_limit:
            reason = ss.RATE_LIMIT
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
    return reason in (ss.RATE_LIMIT, ss.JOINT_LIMIT)


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
        Why the target waits, see :mod:`dynsim.snake.state`; NO_OBSTACLE where it does not.
    commanded : bool
        There was something to carry out.
    speed : float
        Rows of the commands that are carried out, 0 to 1.
    """
    work, period, mode = ws.work, schedule.period, state.counts[ss.MODE]
    phi, phi_hat, w_hat, w_target = state.phi, state.phi_hat, state.w_hat, state.w_target
    pose, target, joints_ahead, u, error, rate = ws.pose, ws.target, ws.phi_stage, work.u, work.error, ws.rate
    joints = phi.shape[0]
    full_gain = law.null_gain if state.counts[ss.TICKS] >= schedule.null_start_tick else 0.0
    null_gain = full_gain
    allocate = law.limit_policy == controller.LIMITS_ALLOCATE
    believe(model, schedule, state, ws)
    reason, waits, reductions, slowed = ss.NO_OBSTACLE, False, 0, False
    row, done, speed, tries = state.counts[ss.CARRIED_OUT], state.progress[ss.DONE], 1.0, 0
    commanded = False
    for i in range(6):
        rate[i] = 0.0
    if moving:
        commanded_rate(velocity, row, done, speed, rate)
    for i in range(6):
        commanded = commanded or rate[i] != 0.0
    beta = wrap_angle(w_target[4])
    if allocate and abs(beta) > BETA_LIMIT and beta * rate[4] > 0.0:
        reason, waits = ss.ATTITUDE, True
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
        if hindrance == ss.NO_OBSTACLE:
            break
        fastest = 0.0
        for j in range(joints):
            fastest = max(fastest, abs(u[j]))
        if hindrance == ss.RATE_LIMIT and reductions < NULL_REDUCTIONS and null_gain != 0.0:
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
    state.counts[ss.SLOWED] += int(slowed)
    state.counts[ss.NULL_REDUCED] += int(reductions > 0)
    if law.limit_policy != controller.LIMITS_NONE:  # the mechanical stop, and what is left when no allocation helps
        for j in range(joints):
            up = max(model.upper[j] - phi[j], 0.0) / period
            down = min(model.lower[j] - phi[j], 0.0) / period
            if u[j] > up or u[j] < down:
                # rounding of an allocated bound is no event
                if u[j] > up + 1e-9 or u[j] < down - 1e-9:
                    state.counts[ss.CLAMPED] += 1
                u[j] = up if u[j] > up else down
    return reason if waits else ss.NO_OBSTACLE, commanded, speed


@internal_kernel
def settle(schedule, state, moving, reason, commanded, speed, ws):
    """End a control period: beliefs, target, and the place in the commands, after :func:`command` and the plant.

    Returns True when the command was not carried out.
    """
    period, u, rate, done = schedule.period, ws.work.u, ws.rate, state.progress[ss.DONE]
    for j in range(state.phi.shape[0]):
        state.phi_hat[j] += period * u[j]  # feedforward; overwritten when the joints are read
    for i in range(6):
        state.w_target[i] += period * rate[i]
        state.w_hat[i] += period * rate[i]  # x, y, gamma of the estimated state; the rest is overwritten
    state.counts[ss.TICKS] += 1
    blocked = reason != ss.NO_OBSTACLE and commanded
    if blocked:
        state.counts[ss.WAITED_FOR + reason] += 1
        state.counts[ss.STILL] += 1
        state.counts[ss.STILL_FOR] = reason
    elif moving:
        state.counts[ss.STILL] = 0
        state.counts[ss.PATH_SLOWED] += int(speed < 1.0)
        state.progress[ss.LATE] += 1.0 - speed
        done += speed
        if done >= 1.0 - 1e-12:
            state.counts[ss.CARRIED_OUT] += 1
            done = max(done - 1.0, 0.0)
        state.progress[ss.DONE] = done
    if blocked or not moving:
        state.counts[ss.WAITED] += 1
    return blocked


@internal_kernel
def tick(model, law, schedule, state, velocity, moving, slows, ws):
    """One control period of the kinematic robot: evaluate the controller, hold its rates, move the plant.

    Parameters as of :func:`command`. Returns the slip of the plant [m/s], and whether the command was not carried out.
    """
    mode = state.counts[ss.MODE]
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
        trace.mode[r] = state.counts[ss.MODE]
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
    work, chain, support, pose, mode = ws.work, ws.work.chain, ws.work.support, ws.pose, state.counts[ss.MODE]
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
        now = counts[ss.TICKS]
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
