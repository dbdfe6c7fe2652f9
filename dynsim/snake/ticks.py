"""Compiled tick loop of the kinematic snake: state estimate, target speed limits, control, plant and recording."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import internal_kernel, kernel
from dynsim.snake import controller
from dynsim.snake.controller import ControlWork, control_input, estimate_from_joints, new_work, sigma_min
from dynsim.snake.fold import OUT_OF_REACH, add_lift, lift_rates
from dynsim.snake.kinematics import (
    SnakeModel,
    constraint_matrices,
    pose_of_point,
    walk_chain,
    wrap_angle,
    zero_arrays,
)
from dynsim.snake.support import cost_value, polygon_area, support_polygon

# Data of the tick loop: schedule, state of plant and controller, workspace, recorded rows.

# Source of the controller's state estimate; GIVEN: the caller, which moves the robot, writes the estimate.
MEASURED, ESTIMATED, FEEDFORWARD, GIVEN = 0, 1, 2, 3
# Reasons why a command cannot be executed.
NO_OBSTACLE, JOINT_LIMIT, RATE_LIMIT, SINGULAR, ATTITUDE = 0, 1, 2, 3, 4
# Indices of SnakeState.counts
MODE = 0  # row of the mode in ControlLaw.grounded
TICKS = 1  # number of simulated ticks
CLAMPED = 2  # number of clamped joint rates, counted for each joint and tick
CARRIED_OUT = 3  # number of executed commands of the current block
WAITED = 4  # ticks in which the command could not be executed and the target waited
SLOWED = 5  # ticks in which the rates were scaled down
NULL_REDUCED = 6  # ticks in which the null-space motion was reduced
WAITED_FOR = 6  # + JOINT_LIMIT … ATTITUDE: ticks in which the target waited for this reason
PATH_SLOWED = WAITED_FOR + ATTITUDE + 1  # ticks in which the target moved slower than commanded
STILL = PATH_SLOWED + 1  # ticks since the target started to wait
STILL_FOR = STILL + 1  # reason for the last wait
COUNTS_SIZE = STILL_FOR + 1
# Result of a control period whose commanded positions are no longer finite, see also OUT_OF_REACH.
NOT_FINITE = -2
# Indices of SnakeState.progress
DONE = 0  # executed part of the current row of commands, 0 to 1
LATE = 1  # delay of a slowed target [control periods]


class Schedule(NamedTuple):
    """Sampling of the controller."""

    period: float  # control period [s]
    midpoint: int  # 1: rates are computed for the predicted middle of the period; 0: for the beginning
    substeps: int  # integration steps of the plant per control period
    state_source: int  # MEASURED, ESTIMATED, FEEDFORWARD or GIVEN
    null_start_tick: int


class SnakeState(NamedTuple):
    """State of plant and controller."""

    base: np.ndarray  # (3,) x, y, yaw at wheel pair 1
    phi: np.ndarray  # (n_phi,)
    rho: np.ndarray  # (n_w,)
    w_target: np.ndarray  # (6,) w_d, integrated from the commanded velocity
    w_hat: np.ndarray  # (6,) estimate of w
    phi_hat: np.ndarray  # (n_phi,) estimate of phi
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
    rate: np.ndarray  # (6,) executed rate of the target
    origin: np.ndarray  # (3,)


class SnakeTrace(NamedTuple):
    """Recorded rows; row r is tick r * stride."""

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
    area: np.ndarray  # (R,) area of the support polygon
    slip: np.ndarray  # (R,)
    at_limit: np.ndarray  # (R, n_phi)
    centre: np.ndarray  # (R, 3)


def new_state(model: SnakeModel) -> SnakeState:
    """Return a zero state."""
    joints = model.head_joints + model.base_joints
    sizes = {"base": 3, "phi": joints, "rho": model.wheels, "w_target": 6, "w_hat": 6, "phi_hat": joints, "progress": 2}
    return zero_arrays(SnakeState, sizes, counts=np.zeros(COUNTS_SIZE, dtype=np.int64))


def new_tick_workspace(model: SnakeModel) -> TickWorkspace:
    """Allocate the workspace of :func:`run_ticks`."""
    sizes = {"phi_stage": model.head_joints + model.base_joints, "normal": (3, 4)}
    sizes |= dict.fromkeys(("px", "py"), model.base_joints)
    sizes |= dict.fromkeys(("base_rate", "base_sum", "base_stage", "origin"), 3)
    sizes |= dict.fromkeys(("pose", "target", "rate"), 6)
    return zero_arrays(TickWorkspace, sizes, work=new_work(model))


def new_trace(model: SnakeModel, rows: int) -> SnakeTrace:
    """Allocate a recording of ``rows`` samples."""
    joints, wheels = model.head_joints + model.base_joints, model.wheels
    widths = {"base": 3, "phi": joints, "rho": wheels, "u": joints + wheels, "centre": 3}
    widths |= dict.fromkeys(("w", "w_target", "w_hat"), 6)
    sizes = {name: (rows, width) for name, width in widths.items()}
    sizes |= dict.fromkeys(("cost", "sigma", "margin", "area", "slip"), rows)
    mode, at_limit = np.zeros(rows, dtype=np.int64), np.zeros((rows, joints), dtype=np.int64)
    return zero_arrays(SnakeTrace, sizes, mode=mode, at_limit=at_limit)


# Kinematic plant of the snake: grounded wheels move the base; joints and wheels follow their commands.


@internal_kernel
def base_velocity(model, grounded, yaw, phi, u, ws):
    """Compute the velocity of the base part from the grounded wheels, and write it to ``ws.base_rate``.

    Joint and wheel rates are known, so the rows (no side slip of grounded pairs, rolling of grounded active wheels)
    overdetermine the three unknowns. The least-squares solution is the motion with the least dissipation if all wheels
    slip with equal viscous friction. Between control ticks the held rates satisfy the rows only to first order, and the
    solution distributes the residual evenly. A consistent u gives the exact motion.

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
            vx, vy = 0.0, 0.0  # due to the joint rates, with pair 1 held
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
    """Hold u for one control period; joints and wheels move exactly, the base by the classical Runge-Kutta method.

    Returns the largest slip [m/s].
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


# Maximum part of a command that damping may remove [m/s, rad/s]; with gain K the head error is WITHHELD / K.
WITHHELD = 1e-5
# Limit of |beta| [rad]; a target is not rotated closer to +-90 deg than this.
BETA_LIMIT = 0.5 * math.pi - 0.02
# Number of steps in which a null-space motion that is too fast is reduced; the last step removes it completely.
NULL_REDUCTIONS = 4
# Maximum number of trials for a target speed within the limits. Each trial uses the fraction ROOM of the speed that the
# last trial allows, but at least LEAST_PART of the last speed, because the prediction is inaccurate far above the
# limits.
SLOW_DOWNS = 8
ROOM = 0.98
LEAST_PART = 0.25
# Minimum target speed as a fraction of the commanded speed; if the target would be slower, it waits.
LEAST_SPEED = 0.01
# Distance to a joint limit below which the joint counts as at the limit [rad]; a joint that is farther away but blocks
# a command was too fast.
AT_LIMIT = 0.05


@internal_kernel
def copy(source, target):
    """Copy source to target, because numba's slice assignment would also compile the formatting of errors."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@internal_kernel
def update_estimate(model, schedule, state, ws):
    """Update the controller's estimates of w and phi, ``state.w_hat`` and ``state.phi_hat`` ([T] IV.C.1, IV.C.2)."""
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
    """Return the reason why ``work.u`` cannot be executed: SINGULAR, JOINT_LIMIT, RATE_LIMIT, or NO_OBSTACLE."""
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
    """Scale all rates by one factor so that no joint exceeds its rate limit or approaches its limit too fast.

    The constraints are homogeneous in the rates, so the wheels still roll without slip. Returns True if the factor is
    less than 1.
    """
    factor = 1.0
    for j in range(phi.shape[0]):
        room = law.limit_rate * max(model.upper[j] - phi[j] if u[j] > 0.0 else phi[j] - model.lower[j], 0.0)
        # Allocation puts rates on their bounds only up to rounding.
        allowed = min(law.rate_limit, room + 1e-9)
        if abs(u[j]) > allowed:
            factor = min(factor, allowed / abs(u[j]))
    for j in range(u.shape[0]):
        u[j] *= factor
    return factor < 1.0


@internal_kernel
def is_too_fast(model, law, work, reason, phi):
    """Return whether a slower target would help: joints are too fast, and no blocking joint is already at its limit."""
    for j in range(phi.shape[0]):
        if work.at_limit[j] == 2:
            left = model.upper[j] - phi[j] if work.u[j] > 0.0 else phi[j] - model.lower[j]
            if left < AT_LIMIT and abs(work.u[j]) <= law.rate_limit:
                return False
    return reason in (RATE_LIMIT, JOINT_LIMIT)


@internal_kernel
def fitting_part(model, law, work, phi):
    """Return the factor for the target speed in the next trial, computed from the rate limits and the joint limits."""
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
    """Compute the mean rate of the target in a period that executes ``speed`` rows of the commands, 0 to 1.

    The fraction ``done`` of row ``row`` is already executed; after the last row, the rate is zero. The path does not
    depend on the speed: every row is executed completely, in one period or several.
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
    """Compute the joint and wheel rates of one control period, and write them to ``ws.work.u``.

    If rates are computed for the beginning of the period and held, they violate the constraints by O(period) at the
    end, and the head error is of the same order. Rates for the predicted middle (``schedule.midpoint``) reduce it to
    O(period^2). The
    prediction uses the closed loop, w~' = w~_d' - K (w~ - w~_d) ([T] eq 15).

    With the limit policy "allocate", all six coordinates of a command are executed together, with every joint within
    its limits. If a joint would be too fast, the null-space motion is reduced first; then, if ``slows``, the
    target moves along its path at a lower speed. Otherwise the target waits, and the remaining motion (errors, shape
    points) is slowed down until it is within the limits. A target that would pass beta = +-90 deg, where the rates of
    alpha and gamma are unbounded, also waits.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    law : ControlLaw
        Constants of the controller.
    schedule : Schedule
        Sampling of the controller.
    state : SnakeState
        State of plant and controller.
    velocity : (T, 6) ndarray
        Commanded rates, see :func:`run_ticks`.
    moving : int
        0: the target waits and the commands are ignored.
    slows : int
        1: the target may be slower than commanded.
    ws : TickWorkspace
        Workspace.

    Returns
    -------
    reason : int
        Reason why the target waits, see :mod:`dynsim.snake.ticks`; NO_OBSTACLE if it does not wait.
    commanded : bool
        Whether the command was not zero.
    speed : float
        Number of executed command rows, 0 to 1.
    """
    work, period, mode = ws.work, schedule.period, state.counts[MODE]
    phi, phi_hat, w_hat, w_target = state.phi, state.phi_hat, state.w_hat, state.w_target
    pose, target, joints_ahead, u, error, rate = ws.pose, ws.target, ws.phi_stage, work.u, work.error, ws.rate
    joints = phi.shape[0]
    full_gain = law.null_gain if state.counts[TICKS] >= schedule.null_start_tick else 0.0
    null_gain = full_gain
    allocate = law.limit_policy == controller.LIMITS_ALLOCATE
    update_estimate(model, schedule, state, ws)
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
    if law.limit_policy != controller.LIMITS_NONE:  # clamp at mechanical stops, and rates that allocation left too high
        for j in range(joints):
            up = max(model.upper[j] - phi[j], 0.0) / period
            down = min(model.lower[j] - phi[j], 0.0) / period
            if u[j] > up or u[j] < down:
                # Do not count rates that exceed an allocated bound only by rounding.
                if u[j] > up + 1e-9 or u[j] < down - 1e-9:
                    state.counts[CLAMPED] += 1
                u[j] = up if u[j] > up else down
    return reason if waits else NO_OBSTACLE, commanded, speed


@internal_kernel
def settle(schedule, state, moving, reason, commanded, speed, ws):
    """End a control period after :func:`command` and the plant: update estimates, target and command position.

    Returns True if the command was not executed.
    """
    period, u, rate, done = schedule.period, ws.work.u, ws.rate, state.progress[DONE]
    for j in range(state.phi.shape[0]):
        state.phi_hat[j] += period * u[j]  # feedforward; overwritten if the joints are measured
    for i in range(6):
        state.w_target[i] += period * rate[i]
        state.w_hat[i] += period * rate[i]  # x, y, gamma of the estimate; the other coordinates are overwritten
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
    """Run one control period of the kinematic robot: evaluate the controller, hold its rates, move the plant.

    For the parameters, see :func:`command`. Returns the slip of the plant [m/s], and whether the command was not
    executed.
    """
    mode = state.counts[MODE]
    reason, commanded, speed = command(model, law, schedule, state, velocity, moving, slows, ws)
    slip = advance_plant(model, law.grounded[mode], schedule.period, schedule.substeps, state, ws.work.u, ws)
    return slip, settle(schedule, state, moving, reason, commanded, speed, ws)


@internal_kernel
def record_command(schedule, state, ws, r, trace):
    """Write the commands of the period that has just ended to row r of the trace."""
    copy(ws.work.u, trace.u[r])
    copy(state.w_hat, trace.w_hat[r])
    for j in range(state.phi.shape[0]):
        trace.at_limit[r, j] = ws.work.at_limit[j]
    # For the estimate at the beginning of the period, subtract the step added by settle.
    for i in range(6):
        trace.w_hat[r, i] -= schedule.period * ws.rate[i]


@internal_kernel
def command_tick(model, law, schedule, state, velocity, moving, slows, ws, r, trace, lines):
    """Run one control period of a robot that is simulated elsewhere, and write the references of joints and wheels.

    Commands and estimates at the beginning of the period are written to row r of the trace unless r is -1. Returns
    whether the command was executed, and whether the commanded positions are finite.
    """
    phi, rho, u, period = state.phi, state.rho, ws.work.u, schedule.period
    joints, first, total = phi.shape[0], lines.shape[0] - rho.shape[0], 0.0
    if r >= 0:
        trace.mode[r] = state.counts[MODE]
        copy(state.w_target, trace.w_target[r])
        copy(phi, trace.phi[r])
    reason, commanded, speed = command(model, law, schedule, state, velocity, moving, slows, ws)
    blocked = settle(schedule, state, moving, reason, commanded, speed, ws)
    if r >= 0:
        record_command(schedule, state, ws, r, trace)
    for j in range(joints):
        lines[j, 0], lines[j, 1] = phi[j], u[j]
        phi[j] += period * u[j]
        total += phi[j]
    for j in range(rho.shape[0]):
        lines[first + j, 0], lines[first + j, 1] = 0.0, u[joints + j]
        rho[j] += period * u[joints + j]
    return blocked, math.isfinite(total)


@kernel
def command_ticks(
    model, law, schedule, state, velocity, moving, slows, ws, stride, trace,
    lifting, up, down, added, added_rate, update, count, lines,
):  # fmt: skip
    """Run control periods of a robot that is simulated elsewhere, in the current mode.

    Joints and wheels of ``state`` are commanded positions. The function returns after a period whose command was not
    executed.

    Parameters
    ----------
    model, law, schedule, state, velocity, moving, slows, ws
        See :func:`command`.
    stride, trace
        See :func:`run_ticks`.
    lifting : LiftTables
        Lifting of the wheel pairs.
    up, down : (pairs,) ndarray
        Times between which the pairs are lifted [s].
    added, added_rate : (pairs - 1,) ndarray
        Angles that lifting adds to the pitch joints on the axles [rad], and their rates [rad/s].
    update : int
        Tick at which these rates are updated.
    count : int
        Number of control periods.
    lines : (count, motors, 2) ndarray
        Output: positions and rates of the references of joints, pitch joints that only lift, and wheels.

    Returns
    -------
    done : int
        Number of completed periods.
    blocked : bool
        Whether the last command was not executed.
    update : int
        Tick of the next update; OUT_OF_REACH if no pitch angles can lift the pairs, NOT_FINITE if the commanded
        positions are no longer finite.
    """
    joints, head, period = state.phi.shape[0], model.head_joints, schedule.period
    done, blocked = 0, False
    while done < count and not blocked:
        now, line = state.counts[TICKS], lines[done]
        r = now // stride if now % stride == 0 else -1
        blocked, finite = command_tick(model, law, schedule, state, velocity, moving, slows, ws, r, trace, line)
        if not finite:
            return done, blocked, NOT_FINITE
        if now >= update:
            yaw, rate = state.phi[head:], ws.work.u[head:joints]
            ticks = lift_rates(lifting, up, down, now * period, period, yaw, rate, added, added_rate)
            if ticks == OUT_OF_REACH:
                return done, blocked, OUT_OF_REACH
            update = now + ticks
        for k in range(added.shape[0]):
            row = joints + k - 1 if k > 0 else head - 1  # the joint on the axle of pair 1 carries the head
            if k > 0:
                line[row, 0], line[row, 1] = 0.0, 0.0
            add_lift(line[row], added, added_rate, period, k)
        done += 1
    return done, blocked, update


@kernel
def record_row(model, law, state, ws, r, trace):
    """Write the state and derived quantities to row r of the trace."""
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
def record_rows(model, law, state, ws, trace):
    """Complete the rows of a trace that have base, joints, wheels, target and mode; ``state`` is workspace."""
    for r in range(trace.mode.shape[0]):
        copy(trace.base[r], state.base)
        copy(trace.phi[r], state.phi)
        copy(trace.rho[r], state.rho)
        copy(trace.w_target[r], state.w_target)
        state.counts[MODE] = trace.mode[r]
        record_row(model, law, state, ws, r, trace)


@kernel
def run_ticks(model, law, schedule, state, velocity, count, moving, stop, stride, ws, trace):
    """Run control periods in the current mode.

    Parameters
    ----------
    model : SnakeModel
        Parameters of the robot.
    law : ControlLaw
        Constants of the controller.
    schedule : Schedule
        Sampling of the controller.
    state : SnakeState
        State of plant and controller.
    velocity : (T, 6) ndarray
        Commanded rates of the target [m/s, rad/s], one row per period; zero after the end. A row is executed completely
        before the next row starts: ``state.counts[CARRIED_OUT]`` is the current row, and ``state.progress[DONE]`` is
        its executed fraction.
    count : int
        Number of control periods.
    moving : int
        1: follow the commands; 0: the target waits.
    stop : int
        1: return after a blocked period; 0: slow down a target that is too fast.
    stride : int
        Interval between recorded ticks; the first recorded tick of the run is 0.
    ws : TickWorkspace
        Workspace.
    trace : SnakeTrace
        Recorded rows.

    Returns
    -------
    done : int
        Number of simulated periods; -1 if the state is no longer finite.
    blocked : bool
        Whether the last period was blocked.
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
