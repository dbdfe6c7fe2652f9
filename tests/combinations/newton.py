"""Newton's and Euler's laws on records: forces and accelerations, momentum, rates, circuits.

Integrals over samples use Simpson's rule. Their error is bounded by the difference from the trapezoidal rule and by
second differences of the rates nearby; for smooth motion this bound is far above the error.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from combinations.bodies import position_rates
from combinations.observed import OPEN, STICKING, Observed, balance, warned, whole_steps
from combinations.sentences import STEPS_MADE
from dynsim.model.drives import Motor

Array = NDArray[np.float64]
Finding = Iterator[str]

# Rates of closed rows that are not projected; larger rates are removed at once [m/s or rad/s].
PROJECTED = 1e-8


def equation(seen: Observed) -> Finding:
    """Check the equation of motion: weight, contacts, loads, drives, friction and stops cause the accelerations."""
    state = balance(seen)
    if not len(state.rows):
        return
    excess = state.excess
    if excess.max() > 1.0:
        row, j = np.unravel_index(excess.argmax(), excess.shape)
        names = seen.joints if not seen.robot.couplings else [f"direction {k}" for k in range(state.left.shape[1])]
        yield (
            f"{names[j]} at t = {seen.time[state.rows[row]]:.6g} s: {state.left[row, j]:.4g} of terms of "
            f"{state.scale[row].max():.4g} are left, in {(excess.max(axis=1) > 1.0).sum()} of {len(state.rows)} samples"
        )


def free_sets(seen: Observed) -> list[list[int]]:
    """Return the bodies of each floating tree; ties to other trees count as outside forces."""
    bodies, n = seen.bodies, seen.bodies.n
    root = [bodies.ancestors(i)[-1] for i in range(n)]
    floats = {
        r
        for r in set(root)
        if [link.kind for link in seen.robot.links[r : r + 6]] == ["prismatic"] * 3 + ["ball_x", "ball_y", "ball_z"]
    }
    sets = {r: [i for i in range(n) if root[i] == r] for r in floats}
    return [sets[r] for r in sorted(sets)]


def momentum(seen: Observed) -> Finding:
    """Check that momentum and angular momentum of every set of free bodies change by the impulses on it."""
    for chosen in free_sets(seen):
        angular, linear = seen.bodies.momentum(seen.motion, chosen)
        moment, force, size = _acting_on(seen, set(chosen))
        both, rate = np.hstack([angular, linear]), np.hstack([moment, force])
        name = seen.robot.links[chosen[-1]].name
        if warned(seen, STEPS_MADE):
            # Bodies turn too far in a step for an expansion about its midpoint; :func:`equation` checks the steps.
            continue
        if seen.stepped:
            rows = whole_steps(seen)
            # Means over the step, evaluated at its end: the error is of the order of the step.
            off = np.abs(both[rows] - both[rows - 1] - seen.step * rate[rows])
            reach = 1.0 + np.linalg.norm(seen.motion.origin[chosen[-1]][rows], axis=1)
            # Forces along axes of bodies act in the middle of the step, half a step's turn before its end.
            turn = 0.02 + 0.5 * seen.step * np.max([np.linalg.norm(spin[rows], axis=1) for spin in seen.motion.spin], 0)
            allowed = (seen.step * turn * size[rows] * reach + 1e-12)[:, None] + _products_jumped(seen, chosen, rows)
            # Their points move by v h/2 until then, and with them the arms of moments (9294).
            speeds = [seen.motion.velocity(i, seen.motion.origin[i])[rows] for i in range(len(seen.motion.origin))]
            fastest = np.max([np.linalg.norm(v, axis=1) for v in speeds], 0)
            allowed[:, :3] += (0.5 * seen.step**2 * fastest * size[rows])[:, None]
            # A step predicts the rates of its middle with the acceleration of the last one (8744, 9086).
            allowed += 0.5 * _products_jumped(seen, chosen, np.maximum(rows - 1, 0))
        elif seen.sample_time is not None:
            # Forces jump or bend at ticks, between samples; :func:`equation` checks the forces at the samples.
            continue
        else:
            off, allowed, rows = integral_error(seen, both, rate)
        if off.size and (off / allowed).max() > 1.0:
            k, c = np.unravel_index((off / allowed).argmax(), off.shape)
            kind = ("angular momentum", "momentum")[c // 3]
            yield (
                f"{name}: {kind} along {'xyz'[c % 3]} at t = {seen.time[rows[k]]:.6g} s is off the impulses by "
                f"{off[k, c]:.3g} (allowed {np.broadcast_to(allowed, off.shape)[k, c]:.3g})"
            )


def _products_jumped(seen: Observed, chosen: list[int], rows: NDArray[np.int64]) -> Array:
    """Return the uncertainty of the momentum of bodies from rates that jump within steps, (len(rows), 6).

    A step uses the velocity products c(v) of its start, but the bodies leave its midpoint with different rates. After
    an impact of joints, the rotation of the bodies is therefore late by the change of h c. For smooth motion this
    change is of second order.
    """
    q, end = seen.q_middle[rows], seen.v[rows]
    start = end - seen.step * seen.vdot[rows]

    def needed(v: Array) -> Array:
        wrenches = seen.bodies.wrenches(seen.bodies.motion(q, v, np.zeros_like(v)))
        return np.hstack([sum(wrenches[i][part] for i in chosen) for part in (0, 1)])

    return seen.step * np.abs(needed(end) - needed(start))


def _acting_on(
    seen: Observed, chosen: set[int], weight: bool = True, load_time: Array | None = None
) -> tuple[Array, Array, Array]:
    """Return outside moment (about the world's origin) and force on a set of bodies, and the sum of magnitudes.

    ``load_time`` : times of the loads, (T,) [s]; None for the times of the samples
    """
    moment, force, size = np.zeros((len(seen), 3)), np.zeros((len(seen), 3)), np.zeros(len(seen))

    def add(at: Array, push: Array, twist: Array | float = 0.0) -> None:
        nonlocal moment, force, size
        moment = moment + np.cross(at, push) + twist
        force = force + push
        size = size + np.linalg.norm(push, axis=1) + np.linalg.norm(np.broadcast_to(twist, push.shape), axis=1)

    for i in chosen if weight else ():
        body = seen.bodies.robot.links[i].inertia
        add(seen.motion.point(i, body.com), np.broadcast_to(body.mass * seen.bodies.gravity, (len(seen), 3)))
    for touch in seen.touches():
        first, *second = touch.body if isinstance(touch.body, tuple) else (touch.body,)
        if first in chosen:
            add(touch.position, touch.force)
        if not chosen.isdisjoint(second):
            add(touch.position, -touch.force)
    for load in seen.loads:
        body, point = seen.robot.attach(load.body, load.point)
        if body in chosen:
            pushing = load.components(seen.time if load_time is None else load_time)
            parts = [pushing[:, :3], pushing[:, 3:]]
            if load.in_body:
                parts = [np.einsum("tij,tj->ti", seen.motion.rotation[body], part) for part in parts]
            add(seen.motion.point(body, point), *parts)
    for a, b, at, push, twist in seen.tie_wrenches(seen.motion):
        for body, sign in ((a, 1.0), (b, -1.0)):
            if body in chosen:
                add(at, sign * push, sign * twist)
    return moment, force, size


def integral_error(seen: Observed, value: Array, rate: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return errors of the changes of values (T, k) against integrals of their rates, limits, and first samples.

    Each row belongs to a pair of equal intervals without events.
    """
    if len(seen) < 3:
        return np.zeros((0, value.shape[1])), np.ones((0, value.shape[1])), np.zeros(0, dtype=np.int64)
    interval = np.diff(seen.time)
    even = np.abs(interval[1:] - interval[:-1]) <= 1e-9 * interval[1:]
    rows = np.flatnonzero(even & seen.quiet(2))
    h = interval[rows][:, None]
    f0, f1, f2 = rate[rows], rate[rows + 1], rate[rows + 2]
    simpson, trapezoid = h / 3.0 * (f0 + 4.0 * f1 + f2), h / 2.0 * (f0 + 2.0 * f1 + f2)
    off = np.abs(value[rows + 2] - value[rows] - simpson)
    rounding = 1e-12 * np.abs(value).max(axis=0, initial=0.0) + 1e-13
    # Projection of samples and errors of steps move states within the tolerances of the integrator.
    config = seen.scenario.integrator
    drift = 100.0 * (config.absolute_tolerance + config.rtol * np.abs(value[rows]).max(initial=0.0))
    # At its limit of stability, 3.3, dopri5 does not damp deviations of stiff motion, such as slow slip, which are some
    # atol. They are 3.3/step times as large in the rates.
    if seen.record.summary["method"] == "dopri5":
        pace = 3.3 * float(seen.record.summary["steps"]) / max(float(seen.time[-1] - seen.time[0]), 1e-12)
        drift = drift + 10.0 * config.absolute_tolerance * pace * 2.0 * h
    # Oscillations and limits between samples show in the second differences of the rates nearby.
    bend = np.zeros_like(rate)
    bend[1:-1] = np.abs(rate[2:] - 2.0 * rate[1:-1] + rate[:-2])
    reach = (
        (5.0 if seen.settling > 0.0 else 2.0)
        * h
        * np.max([bend[np.clip(rows + k, 0, len(rate) - 1)] for k in range(-2, 5)], axis=0)
    )
    return off, 2.0 * np.abs(simpson - trapezoid) + reach + rounding + drift, rows


def motion(seen: Observed) -> Finding:
    """Check that accelerations integrate to rates, and rates to positions."""
    if seen.stepped:
        yield from _stepped_motion(seen)
        return
    between = seen.sample_time is not None and seen.sample_time < 0.99 * np.diff(seen.time).max(initial=0.0)
    # The effect of a command between two ticks is not visible in the samples.
    if jumps_at_ticks(seen) or between:
        return
    speeds = position_rates(seen.bodies, seen.q, seen.v)
    for label, value, rate in (("v", seen.v, seen.vdot), ("q", seen.q, speeds)):
        off, allowed, rows = integral_error(seen, value, rate)
        if label == "v" and any((touch.mode != OPEN).any() for touch in seen.touches()):
            allowed = allowed + _projected(seen, rows)
        if off.size and (off / allowed).max() > 1.0:
            k, j = np.unravel_index((off / allowed).argmax(), off.shape)
            yield (
                f"{label} of {seen.record.labels[label][j]} at t = {seen.time[rows[k]]:.6g} s is {off[k, j]:.3g} "
                f"off the "
                f"integral of its rate (allowed {allowed[k, j]:.3g})"
            )


def _projected(seen: Observed, samples: NDArray[np.int_]) -> Array:
    """Return changes of rates by projection, (samples, n): least-norm changes that remove PROJECTED from closed rows.

    If rows are nearly dependent, the changes are many times as large. Directions of joints count too, so that the
    result is at least PROJECTED.
    """
    touches = [touch for touch in seen.touches() if (touch.mode != OPEN).any()]
    jacobians = [seen.bodies.jacobian(seen.motion, touch.body, touch.position) for touch in touches]
    changes = np.full((len(samples), seen.v.shape[1]), PROJECTED)
    for change, i in zip(changes, samples, strict=True):
        rows = []
        for touch, J in zip(touches, jacobians, strict=True):
            if touch.mode[i] != OPEN:
                rows += [*J[i]] if touch.mode[i] == STICKING else [touch.normal[i] @ J[i]]
        if rows:
            change *= 1.0 + np.abs(np.linalg.pinv(np.array(rows), rcond=1e-9)).sum(axis=1)
    return changes


def _stepped_motion(seen: Observed) -> Finding:
    """Check that rates of samples one step apart change by one or two steps with the recorded accelerations."""
    h = seen.step
    # Steps end at ticks and at delayed commands, so that three may lie between samples.
    if seen.sample_time is not None:
        return
    beside = np.flatnonzero(np.abs(np.diff(seen.time) - h) < 1e-6 * h) + 1
    beside = beside[beside > 1]
    if not len(beside):
        return
    change, now, before = seen.v[beside] - seen.v[beside - 1], h * seen.vdot[beside], h * seen.vdot[beside - 1]
    bend = now - before
    share = ((change - before) * bend).sum(axis=1) / np.maximum((bend * bend).sum(axis=1), 1e-300)
    off = np.abs(change - before - np.clip(share, 0.0, 1.0)[:, None] * bend).max(axis=1)
    allowed = 1e-6 * (np.abs(now) + np.abs(before)).max(axis=1) + 1e-12
    # If a step was cut at the end of a load, three steps may lie between samples.
    wrong = (off > allowed) & seen.apart_from_events(2.0 * h)[beside]
    if wrong.any():
        k = int(np.where(wrong, off, 0.0).argmax())
        yield (
            f"rates at t = {seen.time[beside[k]]:.6g} s are {off[k]:.3g} off what the accelerations make of the "
            f"last ones"
        )


def jumps_at_ticks(seen: Observed) -> bool:
    """Whether accelerations jump at new commands, because a drive has no circuit or a fast circuit."""
    direct = any(not isinstance(motor, Motor) for motor in seen.robot.motors)
    return seen.sample_time is not None and (direct or seen.settling > 0.0)


def circuit(seen: Observed) -> Finding:
    """Check L di/dt = u − R i − K v for DC motors."""
    if seen.stepped or seen.sample_time is not None:
        return
    current, voltage = seen.record["current"], seen.record["voltage"]
    for a, motor in enumerate(seen.robot.motors):
        if not isinstance(motor, Motor) or seen.settling > 0.0:
            continue
        j = seen.joints.index(motor.joint)
        rate = (
            voltage[:, a] - motor.resistance * current[:, a] - motor.joint_constant * seen.v[:, j]
        ) / motor.inductance
        off, allowed, rows = integral_error(seen, current[:, a : a + 1], rate[:, None])
        if off.size and (off / allowed).max() > 1.0:
            k = int((off / allowed).argmax())
            yield f"current of {motor.joint} at t = {seen.time[rows[k]]:.6g} s is {off[k, 0]:.3g} A off its circuit"


def support(seen: Observed) -> Finding:
    """Check that wheels and caster of a mobile base carry the forces that its tree of bodies needs from the ground."""
    base = seen.robot.base
    if base is None:
        return
    bodies, motion = seen.bodies, seen.motion
    body = [link.name for link in seen.robot.links].index(base.body)
    root = bodies.ancestors(body)[-1]
    tree = {i for i in range(bodies.n) if bodies.ancestors(i)[-1] == root}
    needed = bodies.wrenches(motion)
    moment, force = (sum((needed[i][part] for i in tree), start=np.zeros((len(seen), 3))) for part in (0, 1))
    # The forces that the bodies need already include weight.
    acting_moment, acting_force, _ = _acting_on(seen, tree, weight=False)
    moment, force = moment - acting_moment, force - acting_force
    moment = moment + _wheel_spin(seen)
    at = motion.origin[body]
    own_moment = np.einsum("tji,tj->ti", motion.rotation[body], moment - np.cross(at, force))
    own_force = np.einsum("tji,tj->ti", motion.rotation[body], force)
    feet = np.array([[0.0, 0.5 * base.track], [0.0, -0.5 * base.track], base.caster[:2]])
    levers = np.stack([np.ones(3), feet[:, 1], -feet[:, 0]])
    loads = np.linalg.solve(levers, np.stack([own_force[:, 2], own_moment[:, 0], own_moment[:, 1]])).T
    off = np.abs(loads - seen.record["wheel_load"]).max(axis=1)
    # Forces of a step belong to its middle, and the accelerations of samples are means.
    size = np.abs(loads).max(axis=1) + np.linalg.norm(force, axis=1)
    allowed = (1e-2 if seen.stepped else 1e-6) * size + 1e-9
    if (off > allowed).any():
        i = int((off / allowed).argmax())
        yield (
            f"wheels and caster at t = {seen.time[i]:.6g} s carry {seen.record['wheel_load'][i].round(4)} N, "
            f"by the bodies {loads[i].round(4)} N"
        )


def _wheel_spin(seen: Observed) -> Array:
    """Return the moment for the spin of a mobile base's wheels, about an axle that turns with the base, (T, 3)."""
    base, motion = seen.robot.base, seen.motion
    assert base is not None
    body = [link.name for link in seen.robot.links].index(base.body)
    left, right = (seen.joints.index(joint) for joint in base.wheels)
    axle = motion.rotation[body][:, :, 1]
    spin = base.spin_inertia * (seen.v[:, left] + seen.v[:, right])[:, None]
    rate = base.spin_inertia * (seen.vdot[:, left] + seen.vdot[:, right])[:, None]
    return np.asarray(rate * axle + spin * np.cross(motion.spin[body], axle))


# Share of the magnitudes of all forces that a wrench may differ: turning axes of ties are differences of rotations.
SAME_WRENCH = 1e-6


def wrench(seen: Observed) -> Finding:
    """Check that sensors at joints show what the bodies beyond the joint need, minus the forces on them."""
    bodies, motion = seen.bodies, seen.motion
    needed = bodies.wrenches(motion)
    rows, load_time = np.arange(len(seen)), seen.time
    if seen.loads:
        start, end = seen.steps_around if seen.stepped else (seen.time, seen.time)
        load_time = start + seen.scenario.integrator.theta * (end - start)
        jumps = np.concatenate([load.knots for load in seen.loads])
        apart = np.abs(load_time[:, None] - jumps).min(axis=1) > 1e-9
        # Of samples within a step, and of steps that are cut, the sensor may show loads at another time of the step.
        whole = np.abs(seen.time - start - seen.step) < 1e-6 * seen.step if seen.stepped else apart
        rows = np.flatnonzero(apart & whole)
    for k, name in enumerate(seen.record.labels["wrench_force"] if "wrench_force" in seen.record and len(rows) else ()):
        config = seen.config["sensors"]["wrench"][name]
        body, point = seen.robot.attach(config["body"], np.array(config["point_m"]))
        beyond = {i for i in range(bodies.n) if body in bodies.ancestors(i)}
        moment, force, size = _acting_on(seen, beyond, weight=False, load_time=load_time)
        moment, force = (
            sum((needed[i][part] for i in beyond), start=-outside) for part, outside in ((0, moment), (1, force))
        )
        if seen.robot.base is not None and config["body"] == seen.robot.base.body:
            moment = moment + _wheel_spin(seen)
        at = motion.point(body, point)
        moment = moment - np.cross(at, force)
        size = size + sum(np.linalg.norm(needed[i][1], axis=1) for i in beyond)
        size = size * (1.0 + np.max([np.linalg.norm(origin - at, axis=1) for origin in motion.origin], axis=0))
        size = size + sum(np.linalg.norm(needed[i][0], axis=1) for i in beyond)
        for signal, expected in (("wrench_force", force), ("wrench_torque", moment)):
            shown = np.einsum("tij,tj->ti", motion.rotation[body], seen.record[signal][:, k])
            excess = (np.linalg.norm(shown - expected, axis=1) / (SAME_WRENCH * size + 1e-12))[rows]
            if excess.max() > 1.0:
                row = rows[excess.argmax()]
                yield (
                    f"{signal} of {config['body']} at t = {seen.time[row]:.6g} s is {shown[row]} in the world, "
                    f"but its bodies need {expected[row]}"
                )
