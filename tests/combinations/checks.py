"""Checks of a scene's runs that share no code with the kernels: what must hold of every record, and between methods.

Each check is a function of what a record shows (:class:`combinations.observed.Observed`) and yields a sentence with
the worst sample. Tolerances say where they come from. An integral over samples is taken by Simpson's rule, and may
be off by as much as it and the trapezoidal rule differ, and as rates reach around: far more than its error is where
motion is smooth, and enough where it is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from combinations.agreement import disagreements
from combinations.bodies import position_rates
from combinations.observed import OPEN, SLIDING, STICKING, Observed, Touch, balance, whole_steps
from combinations.running import Run
from combinations.verdicts import untrue
from dynsim.errors import SimulationStopped
from dynsim.model.drives import Motor, Servo, TorqueSource
from dynsim.scenario import build

Array = NDArray[np.float64]

# Terms of the equation of motion cancel to this part of their size: by events the record's accelerations and forces
# solve one linear system, whose condition costs up to six of sixteen digits.
BALANCE = 1e-8
# Forces of a step, and where it puts contacts, from differences of samples: h Δv̇ of rounded rates.
STEPPED_BALANCE = 1e-7
# Promise of docs/physics.md: gaps after a step's projection [m]; and where a point counts as landed.
DRIFT = 1e-9
# Of joint stops: limits in files are rounded [rad or m].
STOP_SLACK = 1e-6
# Share of the force that a frozen direction of slip and the tolerance of an event leave.
CONE = 1e-5
# What sticks moves no faster: limit of the projection of velocities [m/s]; steps solve contact problems to 1e-8.
CREEP = 1e-6
# Slip below this has no direction of its own: 1000 atol of the default [m/s].
SLOW = 1e-4
# The first sample of what starts on a surface is projected onto it, from up to a micrometre.
START = 1e-5
# Share of the turnover above which the ledger must warn.
RESIDUAL = 1e-6
# A force beyond this many times what weight, loads and motors can do at a lever of 5 cm is none of this world.
ABSURD, LEVER_M = 1e6, 0.05
# A held command is that of the tick before: at a tick the record shows the voltage that was held until then (True), or
# the one that is held from then on (False).
SHOWS_HELD_UNTIL_TICK = True
# Signals that may be NaN, where there is no load to divide by.
MAY_BE_NAN = ("center_of_pressure", "traction_demand")


@dataclass(frozen=True)
class Problem:
    """What is wrong with a run.

    ``kind`` : the check, in a word; ``detail`` : a sentence with name, time and numbers
    """

    kind: str
    detail: str


Finding = Iterator[str]


def problems(scenario: Mapping[str, Any], run: Run) -> list[Problem]:
    """Everything that is wrong with a run, each check once with its worst sample."""
    listed = [Problem("check", text) for text in started_as_checked(run)]
    if run.record is None or run.resolved is None:
        return listed
    listed += [Problem("finite", text) for text in finite(run)]
    if listed or not len(run.record) or "vdot" not in run.record:
        return listed
    seen = Observed(run)
    for name, check in CHECKS.items():
        listed += [Problem(name, text) for text in check(seen)]
    listed += [Problem("verdict", text) for text in untrue(scenario, run, seen)]
    return listed


def compare(scenario: Mapping[str, Any], runs: Mapping[str, Run]) -> list[Problem]:
    """Where the runs of one scene by several methods, solvers and ways differ more than they may."""
    return [Problem(kind, text) for kind, text in disagreements(scenario, runs)]


def started_as_checked(run: Run) -> Finding:
    """``check`` refuses a scene if and only if it does not start."""
    started = run.record is not None or isinstance(run.error, SimulationStopped)
    if started and run.checked is not None:
        yield f"check refuses what runs: {run.checked[:200]}"
    if not started and run.checked is None:
        yield f"check passes what does not start: {str(run.error)[:200]}"


def finite(run: Run) -> Finding:
    """All signals are numbers, and the run covers its time unless it stopped."""
    assert run.record is not None
    for name in run.record:
        data = np.asarray(run.record[name], dtype=np.float64)
        if name not in MAY_BE_NAN and not np.isfinite(data).all():
            rows = np.argwhere(~np.isfinite(data.reshape(len(data), -1)))
            yield f"{name} is not finite, first in sample {rows[0, 0]}"


def start(seen: Observed) -> Finding:
    """The first sample is the posture that the scenario asks for, at rest."""
    # A soft start settles into a posture of its own.
    if seen.time[0] != 0.0 or seen.config["plant"].get("start") == "soft":
        return
    asked = build.unposed(seen.scenario).initial
    initial = seen.config.get("initial") or {}
    free = np.zeros(len(asked), dtype=bool)
    places = dict(zip(seen.joints, seen.bodies.places, strict=True))
    if initial.get("on_references"):
        for joint, path in ((seen.config.get("controller") or {}).get("joints") or {}).items():
            key = next((key for key in path if key.startswith(("angles_", "positions_"))), None)
            if key is not None and joint in places:
                first = float(path[key][0])
                asked[places[joint]] = np.radians(first) if key.endswith("deg") else first
            elif joint in places:
                free[places[joint]] = True
    if initial.get("on_surface"):
        kept = [places[joint] for joint in initial.get("keep", []) if joint in places]
        free[:] = True
        free[kept] = False
        for touch in seen.touches():
            if touch.contact.name in initial["on_surface"] and abs(touch.gap[0]) > START:
                yield f"{touch.contact.name} starts {touch.gap[0]:+.3g} m from its surface, not on it"
    off = np.where(free, 0.0, np.abs(seen.q[0] - asked))
    if off.max(initial=0.0) > START:
        k = int(off.argmax())
        name = seen.record.labels["q"][k]
        yield f"{name} starts at {seen.q[0, k]:.6g}, asked for {asked[k]:.6g}"
    # Against the posture that the resolved scenario has, where points were to be put on surfaces.
    off = np.abs(seen.q[0] - seen.robot.initial)
    if off.max(initial=0.0) > START:
        k = int(off.argmax())
        yield f"{seen.record.labels['q'][k]} starts at {seen.q[0, k]:.6g}, the scenario has {seen.robot.initial[k]:.6g}"
    fastest = float(np.abs(seen.v[0]).max(initial=0.0))
    # What starts on its surfaces is at rest; an impact at the start could only take velocities away.
    if fastest > CREEP:
        yield f"{seen.joints[int(np.abs(seen.v[0]).argmax())]} starts with a rate of {fastest:.3g}, not at rest"


def equilibrium(seen: Observed) -> Finding:
    """What starts in equilibrium does not accelerate."""
    initial, controller = seen.config.get("initial") or {}, seen.config.get("controller") or {}
    if not initial.get("equilibrium") or seen.time[0] != 0.0:
        return
    if any(not isinstance(motor, Motor) for motor in seen.robot.motors) and (
        controller.get("joints") or controller.get("hand")
    ):
        return
    size = np.abs(seen.vdot[0])
    # A millionth of what the weight does to a joint that is let go.
    if size.max(initial=0.0) > 1e-4 * (1.0 + np.linalg.norm(seen.bodies.gravity)):
        yield f"{seen.joints[int(size.argmax())]} starts with an acceleration of {size.max():.3g}, from equilibrium"


def equation(seen: Observed) -> Finding:
    """Forces of the record move the bodies as the record says: weight, contacts, loads, drives, friction, stops."""
    state = balance(seen)
    if not len(state.rows):
        return
    share = STEPPED_BALANCE if seen.stepped else BALANCE
    allowed = share * state.scale.max(axis=1, keepdims=True) + 2.0 * state.slack + 1e-10
    excess = np.abs(state.left) / allowed
    if excess.max() > 1.0:
        row, j = np.unravel_index(excess.argmax(), excess.shape)
        names = seen.joints if not seen.robot.couplings else [f"direction {k}" for k in range(state.left.shape[1])]
        yield (
            f"{names[j]} at t = {seen.time[state.rows[row]]:.6g} s: {state.left[row, j]:.4g} of terms of "
            f"{state.scale[row].max():.4g} are left, in {(excess.max(axis=1) > 1.0).sum()} of {len(state.rows)} samples"
        )


def free_sets(seen: Observed) -> list[list[int]]:
    """Bodies of each tree that floats; trees tied to each other move as one."""
    bodies, n = seen.bodies, seen.bodies.n
    root = [bodies.ancestors(i)[-1] for i in range(n)]
    floats = {
        r
        for r in set(root)
        if [link.kind for link in seen.robot.links[r : r + 6]]
        == ["prismatic"] * 3 + ["ball_x", "ball_y", "ball_z"]
    }
    sets = {r: [i for i in range(n) if root[i] == r] for r in floats}
    return [sets[r] for r in sorted(sets)]


def momentum(seen: Observed) -> Finding:
    """Momentum and angular momentum of every set of free bodies change by the impulses of what acts on it."""
    for chosen in free_sets(seen):
        angular, linear = seen.bodies.momentum(seen.motion, chosen)
        moment, force, size = _acting_on(seen, set(chosen))
        both, rate = np.hstack([angular, linear]), np.hstack([moment, force])
        name = seen.robot.links[chosen[-1]].name
        if seen.stepped:
            rows = whole_steps(seen)
            # Means over the step, taken where it ends: as much off as the step is long beside the motion.
            off = np.abs(both[rows] - both[rows - 1] - seen.step * rate[rows])
            reach = 1.0 + np.linalg.norm(seen.motion.origin[chosen[-1]][rows], axis=1)
            allowed = (seen.step * 0.02 * size[rows] * reach + 1e-12)[:, None]
        else:
            off, allowed, rows = _integral_error(seen, both, rate)
        if off.size and (off / allowed).max() > 1.0:
            k, c = np.unravel_index((off / allowed).argmax(), off.shape)
            kind = ("angular momentum", "momentum")[c // 3]
            yield (
                f"{name}: {kind} along {'xyz'[c % 3]} at t = {seen.time[rows[k]]:.6g} s is off the impulses by "
                f"{off[k, c]:.3g} (allowed {np.broadcast_to(allowed, off.shape)[k, c]:.3g})"
            )


def _acting_on(seen: Observed, chosen: set[int]) -> tuple[Array, Array, Array]:
    """Moment about the world's origin and force from outside on a set of bodies, and the sum of their sizes."""
    moment, force, size = np.zeros((len(seen), 3)), np.zeros((len(seen), 3)), np.zeros(len(seen))

    def add(at: Array, push: Array, twist: Array | float = 0.0) -> None:
        nonlocal moment, force, size
        moment = moment + np.cross(at, push) + twist
        force = force + push
        size = size + np.linalg.norm(push, axis=1) + np.linalg.norm(np.broadcast_to(twist, push.shape), axis=1)

    for i in chosen:
        body = seen.robot.links[i].inertia
        add(seen.motion.point(i, body.com), np.broadcast_to(body.mass * seen.bodies.gravity, (len(seen), 3)))
    for touch in seen.touches():
        if touch.body in chosen:
            add(touch.position, touch.force)
    for load in seen.loads:
        body, point = seen.robot.attach(load.body, load.point)
        if body in chosen:
            wrench = load.components(seen.time)
            parts = [wrench[:, :3], wrench[:, 3:]]
            if load.in_body:
                parts = [np.einsum("tij,tj->ti", seen.motion.rotation[body], part) for part in parts]
            add(seen.motion.point(body, point), *parts)
    for a, b, at, push, twist in seen.tie_wrenches(seen.motion):
        for body, sign in ((a, 1.0), (b, -1.0)):
            if body in chosen:
                add(at, sign * push, sign * twist)
    return moment, force, size


def _integral_error(seen: Observed, value: Array, rate: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """By how much values (T, k) change otherwise than the integral of their rates, over pairs of equal intervals in
    which nothing happens; what is allowed; and the first sample of each pair."""
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
    # Projection of samples and steps' errors move states within tolerances of the integrator.
    config = seen.scenario.integrator
    drift = 100.0 * (config.atol + config.rtol * np.abs(value[rows]).max(initial=0.0))
    # What rings or is cut by a limit between samples shows in how far rates reach around them.
    around = np.stack([rate[np.clip(rows + k, 0, len(rate) - 1)] for k in range(-2, 5)])
    reach = h * (around.max(axis=0) - around.min(axis=0))
    return off, 2.0 * np.abs(simpson - trapezoid) + reach + rounding + drift, rows


def motion(seen: Observed) -> Finding:
    """Accelerations add up to rates, and rates to positions."""
    if seen.stepped:
        yield from _stepped_motion(seen)
        return
    if _jumps_at_ticks(seen):
        return
    speeds = position_rates(seen.bodies, seen.q, seen.v)
    for label, value, rate in (("v", seen.v, seen.vdot), ("q", seen.q, speeds)):
        off, allowed, rows = _integral_error(seen, value, rate)
        if off.size and (off / allowed).max() > 1.0:
            k, j = np.unravel_index((off / allowed).argmax(), off.shape)
            yield (
                f"{label} of {seen.record.labels[label][j]} at t = {seen.time[rows[k]]:.6g} s is {off[k, j]:.3g} off the "
                f"integral of its rate (allowed {allowed[k, j]:.3g})"
            )


def _stepped_motion(seen: Observed) -> Finding:
    """Between samples that lie a step apart rates change by that of one step or of two, whose accelerations are known."""
    h = seen.step
    beside = np.flatnonzero(np.abs(np.diff(seen.time) - h) < 1e-6 * h) + 1
    beside = beside[beside > 1]
    if not len(beside):
        return
    change, now, before = seen.v[beside] - seen.v[beside - 1], h * seen.vdot[beside], h * seen.vdot[beside - 1]
    bend = now - before
    share = ((change - before) * bend).sum(axis=1) / np.maximum((bend * bend).sum(axis=1), 1e-300)
    off = np.abs(change - before - np.clip(share, 0.0, 1.0)[:, None] * bend).max(axis=1)
    allowed = 1e-6 * (np.abs(now) + np.abs(before)).max(axis=1) + 1e-12
    # Where a step was cut at the end of a load, three steps may lie between samples.
    wrong = (off > allowed) & np.array([(np.abs(seen.event_times - t) > 2.0 * h).all() for t in seen.time[beside]])
    if wrong.any():
        k = int(np.where(wrong, off, 0.0).argmax())
        yield f"rates at t = {seen.time[beside[k]]:.6g} s are {off[k]:.3g} off what the accelerations make of the last ones"


def _jumps_at_ticks(seen: Observed) -> bool:
    """Whether accelerations jump where commands are taken: those of drives without a circuit, or with a fast one."""
    direct = any(not isinstance(motor, Motor) for motor in seen.robot.motors)
    return seen.sample_time is not None and (direct or seen.settling > 0.0)


def circuit(seen: Observed) -> Finding:
    """L di/dt = u − R i − K v of DC motors."""
    if seen.stepped or seen.sample_time is not None:
        return
    current, voltage = seen.record["current"], seen.record["voltage"]
    for a, motor in enumerate(seen.robot.motors):
        if not isinstance(motor, Motor) or seen.settling > 0.0:
            continue
        j = seen.joints.index(motor.joint)
        rate = (voltage[:, a] - motor.resistance * current[:, a] - motor.joint_constant * seen.v[:, j]) / motor.inductance
        off, allowed, rows = _integral_error(seen, current[:, a : a + 1], rate[:, None])
        if off.size and (off / allowed).max() > 1.0:
            k = int((off / allowed).argmax())
            yield f"current of {motor.joint} at t = {seen.time[rows[k]]:.6g} s is {off[k, 0]:.3g} A off its circuit"


def touching(seen: Observed) -> Finding:
    """Gaps, slip and normals of the record are those of the posture; what is open has no force, none pulls."""
    for k, touch in enumerate(seen.touches()):
        name = touch.contact.name
        off = np.abs(touch.gap - seen.record["contact_gap"][:, k])
        # Two searches for a nearest point.
        if off.max() > 1e-8 + 1e-6 * np.abs(touch.gap[off.argmax()]):
            i = int(off.argmax())
            yield f"{name} at t = {seen.time[i]:.6g} s: gap {seen.record['contact_gap'][i, k]:.6g}, own {touch.gap[i]:.6g} m"
        slip = seen.record["contact_slip_velocity"][:, k]
        off = np.where(touch.mode != OPEN, np.abs(slip - touch.slip).max(axis=1), 0.0)
        if off.max() > 1e-7 + 1e-6 * np.abs(slip).max():
            i = int(off.argmax())
            yield f"{name} at t = {seen.time[i]:.6g} s: slip {slip[i]} m/s, own {touch.slip[i]}"
        along = (touch.force * touch.normal).sum(axis=1)
        size = np.linalg.norm(touch.force, axis=1)
        off = np.abs(along - touch.normal_force) - _share(seen, touch) * size
        if (off > 1e-9).any():
            i = int(off.argmax())
            yield (
                f"{name} at t = {seen.time[i]:.6g} s: its force has {along[i]:.6g} N along the normal, "
                f"f_n is {touch.normal_force[i]:.6g} N"
            )
        if not seen.real:
            continue
        if (touch.normal_force < -1e-9 - CONE * size.max()).any():
            i = int(touch.normal_force.argmin())
            yield f"{name} at t = {seen.time[i]:.6g} s pulls with {-touch.normal_force[i]:.4g} N"
        unheld = (touch.mode == OPEN) & (size > 1e-9)
        if unheld.any():
            yield f"{name} at t = {seen.time[unheld.argmax()]:.6g} s is open and has a force of {size[unheld].max():.4g} N"
        if touch.contact.stiffness == 0.0:
            far = (touch.normal_force > 1e-9) & (touch.gap > _reach(seen, touch))
            if far.any():
                i = int(np.where(far, touch.gap, 0.0).argmax())
                yield f"{name} at t = {seen.time[i]:.6g} s: {touch.normal_force[i]:.4g} N at a gap of {touch.gap[i]:.3g} m"


def _reach(seen: Observed, touch: Touch) -> Array:
    """How far from its surface what touches may be, (T,) [m]: of steps what they go along the normal, and sag."""
    if not seen.stepped:
        return np.full(len(seen), 10.0 * DRIFT)
    return 1e-7 + seen.step * (_fastest_approach(touch) + np.linalg.norm(touch.slip, axis=1))


def _fastest_approach(touch: Touch) -> Array:
    """Largest speed along the normal until each sample, (T,) [m/s]."""
    return np.asarray(np.maximum.accumulate(np.abs(touch.approach)))


def coefficient(touch: Touch, speed: Array) -> Array:
    """μ at speeds of slip, (T,)."""
    contact = touch.contact
    at_rest = contact.friction_at_rest
    mu = contact.friction + contact.viscous_friction * speed
    if contact.stribeck > 0.0:
        mu = mu + (at_rest - contact.friction) * np.exp(-((speed / contact.stribeck) ** 2))
    return np.asarray(mu)


def friction(seen: Observed) -> Finding:
    """Friction stays in its cone, is on its edge against the slip where there is some, and slips nowhere else."""
    for touch in seen.touches():
        yield from _glued_friction(seen, touch) if not seen.real else _real_friction(seen, touch)


def _glued_friction(seen: Observed, touch: Touch) -> Finding:
    contact = touch.contact
    speed = np.linalg.norm(touch.slip, axis=1)
    smooth = np.hypot(speed, contact.slip_smoothing)
    size = touch.normal_force if contact.pulling_friction == "signed" else np.abs(touch.normal_force)
    expected = -contact.friction * (size / smooth)[:, None] * touch.slip
    off = np.abs(touch.tangential - expected).max(axis=1)
    allowed = 1e-6 * np.abs(touch.normal_force) + 1e-9
    if (off > allowed).any():
        i = int((off / allowed).argmax())
        yield (
            f"{contact.name} at t = {seen.time[i]:.6g} s: friction {touch.tangential[i]} N, "
            f"{expected[i]} by the slip {touch.slip[i]} m/s"
        )


def _real_friction(seen: Observed, touch: Touch) -> Finding:
    contact, f_n = touch.contact, touch.normal_force
    tangential = touch.tangential
    speed, size = np.linalg.norm(touch.slip, axis=1), np.linalg.norm(tangential, axis=1)
    closed = touch.mode != OPEN
    slips = closed & (touch.mode == SLIDING) & (f_n > 0.0)
    # Steps take μ of their start, the direction of their mean, and rates of before an impact.
    before = touch.slip_before
    speed = np.maximum(speed, np.linalg.norm(before, axis=1))
    most = np.maximum(contact.friction_at_rest, coefficient(touch, speed))
    if contact.grip_axis is None:
        over = size - most * f_n
        allowed = _share(seen, touch) * np.linalg.norm(touch.force, axis=1) + 1e-9 * (1.0 + np.abs(f_n).max())
        if (closed & (over > allowed)).any():
            i = int(np.where(closed, over - allowed, -np.inf).argmax())
            yield (
                f"{contact.name} at t = {seen.time[i]:.6g} s: friction of {size[i]:.6g} N is outside the cone of "
                f"{most[i]:.4g} × {f_n[i]:.6g} N"
            )
    power = (tangential * touch.slip).sum(axis=1)
    # A step in which slip ends may end with some of it turned round.
    gained = slips & (power > size * (_share(seen, touch) * speed + (SLOW if seen.stepped else 1e-7)) + 1e-12)
    if seen.stepped:
        gained &= (tangential * before).sum(axis=1) > 0.0
    if gained.any():
        i = int(np.where(gained, power, 0.0).argmax())
        yield f"{contact.name} at t = {seen.time[i]:.6g} s: friction drives the slip with {power[i]:.4g} W"
    if contact.grip_axis is None:
        yield from _against_slip(seen, touch, slips, before)
    # What sticks does not move. Steps end with what they have solved the problem to.
    # A sphere that rolls has velocities of its own at other places: only the place that touches counts.
    sticks = closed & (touch.mode == STICKING)
    if seen.stepped:
        # A step at whose end slip is over had some of it.
        sticks &= np.concatenate([[False], sticks[:-1]])
    moving = sticks & (np.linalg.norm(touch.slip, axis=1) > _creep(seen, touch))
    if moving.any():
        own = np.linalg.norm(touch.slip, axis=1)
        i = int(np.where(moving, own, 0.0).argmax())
        yield f"{contact.name} at t = {seen.time[i]:.6g} s sticks and slips with {own[i]:.3g} m/s"


def _share(seen: Observed, touch: Touch) -> Array:
    """Part of a force by which its parts may be off, (T,): by steps it belongs to the normal of half a step before."""
    return CONE + (touch.turned if seen.stepped else np.zeros(len(seen)))


def _creep(seen: Observed, touch: Touch) -> Array:
    """Slip of what sticks, (T,) [m/s]: nothing; of steps what the turn of the surface adds, and of soft contacts sag."""
    if not seen.stepped:
        return np.full(len(seen), CREEP)
    moved = np.linalg.norm(np.diff(touch.position, axis=0, prepend=touch.position[:1]), axis=1)
    speed = np.abs(touch.approach) + np.linalg.norm(touch.slip, axis=1)
    soft = 1e-3 if touch.contact.stiffness > 0.0 else 0.0
    spin = np.linalg.norm(seen.motion.spin[touch.body], axis=1)
    return np.asarray(SLOW + soft + 2.0 * (spin * moved + touch.turned * speed))


def _against_slip(seen: Observed, touch: Touch, slips: NDArray[np.bool_], before: Array) -> Finding:
    """Sliding friction is μ f_n against the slip."""
    speed, f_n = np.linalg.norm(touch.slip, axis=1), touch.normal_force
    if seen.stepped:
        # A step in which slip begins, ends or turns has friction of its own mean: only steady ones tell.
        earlier = np.linalg.norm(before, axis=1)
        both = np.maximum(speed, earlier)
        turned = np.linalg.norm(touch.slip - before, axis=1)
        told = slips & (np.minimum(speed, earlier) > SLOW) & (turned < 0.2 * both)
        middle = 0.5 * (touch.slip + before)
        low, high = coefficient(touch, np.minimum(speed, earlier)), coefficient(touch, both)
        # The contact's place moves on the body within a step, and the tangent plane turns.
        share = turned / np.maximum(both, 1e-300) + np.abs(high - low) / np.maximum(high, 1e-300) + 1e-3
    else:
        told, middle = slips & (speed > SLOW), touch.slip
        share = np.full(len(seen), 1e-3)
    pace = np.maximum(np.linalg.norm(middle, axis=1), 1e-300)
    mu = coefficient(touch, np.linalg.norm(before, axis=1) if seen.stepped else speed)
    expected = -(mu * f_n / pace)[:, None] * middle
    off = np.linalg.norm(touch.tangential - expected, axis=1)
    allowed = share * np.linalg.norm(touch.force, axis=1) + 1e-9
    wrong = told & (off > allowed)
    # From rest the static coefficient holds until the first step of slip is over.
    if wrong.any():
        i = int(np.where(wrong, off / allowed, 0.0).argmax())
        yield (
            f"{touch.contact.name} at t = {seen.time[i]:.6g} s: friction {touch.tangential[i].round(5)} N, "
            f"{expected[i].round(5)} N against the slip {middle[i].round(6)} m/s, in {wrong.sum()} samples"
        )


def gaps(seen: Observed) -> Finding:
    """Nothing lies below its surface: by events within what projection leaves, by steps within what one goes too far."""
    for touch in seen.touches():
        name, contact = touch.contact.name, touch.contact
        if not seen.real:
            worst = int(np.abs(touch.gap).argmax())
            if abs(touch.gap[worst]) > DRIFT and not _warned(seen, "contacts drifted"):
                yield f"{name} at t = {seen.time[worst]:.6g} s is {touch.gap[worst]:+.3g} m off the surface that it is glued to"
            continue
        deepest = int(touch.gap.argmin())
        sag = 2.0 * np.abs(touch.normal_force).max() / contact.stiffness if contact.stiffness > 0.0 else 0.0
        begun = max(-float(touch.gap[0]), 0.0)
        allowed = DRIFT if not seen.stepped else 1e-7 + sag + 1.5 * seen.step * float(_fastest_approach(touch)[deepest])
        if -touch.gap[deepest] > allowed + begun:
            yield (
                f"{name} at t = {seen.time[deepest]:.6g} s is {-touch.gap[deepest]:.3g} m below its surface "
                f"(allowed {allowed:.3g})"
            )


def stops(seen: Observed) -> Finding:
    """Joints stay within their stops, and steps take back what one let pass; a stop pushes only at its end."""
    if not seen.real:
        return
    for i, (link, k) in enumerate(zip(seen.robot.links, seen.bodies.places, strict=True)):
        for side, limit in ((1.0, link.lower), (-1.0, link.upper)):
            if not np.isfinite(limit):
                continue
            beyond, rate = side * (limit - seen.q[:, k]), np.abs(seen.v[:, i])
            deepest = int(beyond.argmax())
            fastest = float(rate[: deepest + 1].max(initial=0.0))
            allowed = STOP_SLACK + (1.5 * seen.step * fastest if seen.stepped else 0.0)
            if beyond[deepest] > allowed:
                yield f"{link.joint} at t = {seen.time[deepest]:.6g} s is {beyond[deepest]:.3g} beyond its stop (allowed {allowed:.3g})"
            # 20 ms to come back, at 0.02 a second at the most, and as long again for what energy is left to do it.
            late = seen.time >= seen.time[deepest] + 0.2 + 2.0 * max(float(beyond[deepest]), 0.0) / 0.02
            if beyond[deepest] > 10.0 * STOP_SLACK and late.any():
                still = float(beyond[late].min())
                if still > 0.5 * beyond[deepest]:
                    yield f"{link.joint} is {still:.3g} beyond its stop for {seen.time[-1] - seen.time[deepest]:.3g} s and does not come back"
    if "stop_force" in seen.record:
        yield from _stop_forces(seen)


def _stop_forces(seen: Observed) -> Finding:
    for k, joint in enumerate(seen.record.labels["stop_force"]):
        i = seen.joints.index(joint)
        link, q = seen.robot.links[i], seen.q[:, seen.bodies.places[i]]
        force = seen.record["stop_force"][:, k]
        near = STOP_SLACK + (2.0 * seen.step * np.abs(seen.v[:, i]).max() if seen.stepped else 0.0)
        pushes = ((force > 1e-9) & (q - link.lower > near)) | ((force < -1e-9) & (link.upper - q > near))
        if pushes.any():
            i = int(np.where(pushes, np.abs(force), 0.0).argmax())
            yield f"{joint} at t = {seen.time[i]:.6g} s: its stop pushes with {force[i]:.4g} and is not reached"


def dry(seen: Observed) -> Finding:
    """Dry friction of joints stays within its bound, and is on it, against the motion, where there is some."""
    if "joint_friction" not in seen.record:
        return
    gears = {motor.joint: getattr(motor, "dry_friction", 0.0) for motor in seen.robot.motors}
    for k, joint in enumerate(seen.record.labels["joint_friction"]):
        i = seen.joints.index(joint)
        bound = seen.robot.links[i].friction + gears.get(joint, 0.0)
        torque, rate = seen.record["joint_friction"][:, k], seen.v[:, i]
        if (np.abs(torque) > bound * (1.0 + 1e-6) + 1e-12).any():
            t = int(np.abs(torque).argmax())
            yield f"{joint} at t = {seen.time[t]:.6g} s: dry friction of {torque[t]:.6g} is beyond its bound {bound:.6g}"
        moves = np.abs(rate) > 10.0 * CREEP
        if seen.stepped:
            # Steady motion only: a step in which it stops or begins has any force within the bound.
            gain = seen.step * seen.vdot[:, i]
            moves &= np.minimum((rate - gain) * rate, (rate + gain) * rate) > 0.01 * rate**2
        off = np.where(moves, np.abs(torque + bound * np.sign(rate)), 0.0)
        if (off > 1e-6 * bound + 1e-9).any():
            t = int(off.argmax())
            yield f"{joint} at t = {seen.time[t]:.6g} s moves with {rate[t]:.3g} and its dry friction is {torque[t]:.6g} of {bound:.6g}"


def ledger(seen: Observed) -> Finding:
    """Energies are those of the bodies, the ledger closes or a warning says so, and losses only grow."""
    record = seen.record
    kinetic, potential = seen.bodies.energies(seen.motion, seen.v)
    own = {"energy_kinetic": kinetic, "energy_potential": potential - potential[0] + record["energy_potential"][0]}
    current = record["current"]
    magnetic = np.zeros(len(seen))
    for a, motor in enumerate(seen.robot.motors):
        if isinstance(motor, Motor):
            magnetic = magnetic + 0.5 * motor.inductance * current[:, a] ** 2
    own["energy_magnetic"] = magnetic
    for name, values in own.items():
        off = np.abs(record[name] - values)
        scale = np.abs(values).max(initial=0.0) + np.abs(kinetic).max(initial=0.0)
        # Samples of steps lie on their ends only where these are whole ones.
        if off.max() > 1e-8 * scale + 1e-12:
            i = int(off.argmax())
            yield f"{name} at t = {seen.time[i]:.6g} s is {record[name][i]:.9g} J, of the bodies {values[i]:.9g} J"
    turnover, residual = turnover_and_residual(seen)
    floor = residual_floor(seen)
    relative = residual / max(turnover, floor) if max(turnover, floor) > 0.0 else 0.0
    told = float(record.summary["energy_residual_relative"])
    if abs(relative - told) > 0.01 * max(relative, told) + 1e-12:
        yield f"the residual is {relative:.3e} of the turnover by the signals, {told:.3e} in the summary"
    if relative > RESIDUAL and not _warned(seen, "the energy ledger does not close"):
        yield f"the ledger does not close: {relative:.3e} of the turnover, and no warning says so"


def residual_floor(seen: Observed) -> float:
    """Least energy to which a residual is compared, as docs/physics.md has it [J]."""
    reach, lever, mass = {}, 0.0, 0.0
    for link in seen.bodies.robot.links:
        reach[link.name] = 0.0 if link.parent is None else reach[link.parent] + float(np.linalg.norm(link.p_PJ))
        lever += link.inertia.mass * (reach[link.name] + float(np.linalg.norm(link.inertia.com)))
        mass += link.inertia.mass
    g, record = float(np.linalg.norm(seen.bodies.gravity)), seen.record
    stores = (
        np.abs(record["energy_kinetic"]),
        np.abs(record["energy_potential"] - record["energy_potential"][0]),
        np.abs(record["energy_magnetic"]),
    )
    floor = seen.scenario.integrator.rtol * max(lever * g, *(float(store.max(initial=0.0)) for store in stores))
    # Landings are located to some 1e-10 m (docs/physics.md); ten of them.
    return max(floor, mass * g * 1e-3 * RESIDUAL) if seen.real and floor == 0.0 else floor


def turnover_and_residual(seen: Observed) -> tuple[float, float]:
    """Energy that changed hands, and the largest imbalance of the signals [J]."""
    record = seen.record
    sources = record["energy_electrical"] + record["work_constraint"]
    size = np.abs(record["energy_electrical"]) + np.abs(record["work_constraint"])
    if "work_loads" in record:
        sources = sources + record["work_loads"].sum(axis=1)
        size = size + np.abs(record["work_loads"]).sum(axis=1)
    sinks = ("heat_joule", "loss_gear", "loss_joint", "heat_friction", "loss_impact", "loss_stop", "loss_damper")
    for name in (*sinks, "energy_elastic", "loss_scheme"):
        if name in record:
            sources, size = sources - record[name], size + np.abs(record[name])
    for name in ("energy_kinetic", "energy_potential", "energy_magnetic"):
        change = record[name] - record[name][0]
        sources, size = sources - change, size + np.abs(change)
    return float(0.5 * size.max(initial=0.0)), float(np.abs(sources).max(initial=0.0))


def losses(seen: Observed) -> Finding:
    """Losses never fall."""
    turnover, _ = turnover_and_residual(seen)
    names = ["heat_joule", "loss_joint", "loss_gear"]
    restitution = any(touch.contact.restitution > 0.0 for touch in seen.touches())
    signed = any(touch.contact.pulling_friction == "signed" for touch in seen.touches()) and not seen.real
    if not restitution and not signed:
        names += ["heat_friction"]
        # What takes a point out of the surface again comes from what steps have taken there.
        names += [name for name in ("loss_impact", "loss_stop") if name in seen.record and not seen.stepped]
    for name in names:
        fall = -np.diff(seen.record[name])
        # Steps take friction of what sticks for none; what is left of rates is solved to 1e-8 m/s.
        allowed = (1e-7 if seen.stepped else 1e-9) * turnover + 1e-12
        if fall.size and fall.max() > allowed and not _warned(seen, "friction has put"):
            yield f"{name} falls by {fall.max():.3g} J at t = {seen.time[int(fall.argmax()) + 1]:.6g} s"


def powers(seen: Observed) -> Finding:
    """Heat and losses are the integrals of what the samples show of them."""
    record, current = seen.record, seen.record["current"]
    heat = np.zeros(len(seen))
    for a, motor in enumerate(seen.robot.motors):
        if not isinstance(motor, TorqueSource):
            heat = heat + motor.resistance * current[:, a] ** 2
    rubbed = np.zeros(len(seen))
    for touch in seen.touches():
        rubbed = rubbed - np.where(touch.mode == STICKING, 0.0, (touch.tangential * touch.slip).sum(axis=1))
    lost = (seen.bodies.damping * seen.v**2).sum(axis=1) - (seen.joint_signal("joint_friction") * seen.v).sum(axis=1)
    for motor in seen.robot.motors:
        if isinstance(motor, Servo) and motor.coulomb_friction > 0.0 and not seen.real:
            rate = seen.v[:, seen.joints.index(motor.joint)]
            lost = lost + motor.coulomb_friction * rate**2 / np.hypot(rate, motor.coulomb_speed or 1e-2)
    drawn = (current * record["voltage"]).sum(axis=1)
    work = {
        "heat_joule": (record["heat_joule"], heat),
        "losses of gears and joints": (record["loss_gear"] + record["loss_joint"], lost),
        "heat_friction": (record["heat_friction"], rubbed),
        "energy_electrical": (record["energy_electrical"], drawn),
    }
    if _jumps_at_ticks(seen) or seen.sample_time is not None:
        del work["energy_electrical"]
        if _jumps_at_ticks(seen):
            del work["heat_joule"]
    turnover, _ = turnover_and_residual(seen)
    for name, (total, power) in work.items():
        yield from _integrated(seen, name, total, power, turnover)


def _integrated(seen: Observed, name: str, total: Array, power: Array, turnover: float) -> Finding:
    if not seen.stepped:
        off, allowed, rows = _integral_error(seen, total[:, None], power[:, None])
        allowed = allowed + 1e-5 * turnover
        rows = rows + 2
    else:
        rows = whole_steps(seen)
        h, now, before = seen.step, power[rows], power[rows - 1]
        # Power at the mean state of a step: between those of its ends, and as much off as these differ.
        off = np.abs(total[rows] - total[rows - 1] - 0.5 * h * (now + before))[:, None]
        allowed = (h * np.abs(now - before) + 0.02 * h * (np.abs(now) + np.abs(before)) + 1e-6 * turnover)[:, None]
        quiet = np.array([(np.abs(seen.event_times - t) > 2.0 * h).all() for t in seen.time[rows]], dtype=bool)
        off = np.where(quiet[:, None], off, 0.0) if len(rows) else off
    if off.size and (off / allowed).max() > 1.0:
        k = int((off / allowed).argmax())
        yield (
            f"{name} until t = {seen.time[rows[k]]:.6g} s is {off[k, 0]:.3g} J off the integral of what the samples show "
            f"(allowed {allowed[k, 0]:.3g} J)"
        )


def commands(seen: Observed) -> Finding:
    """Voltages are what the controller asks for: now, or at the last tick, for joints whose reference stands still."""
    controller = seen.config.get("controller") or {}
    if controller.get("type") != "joint_pd" or any(
        controller.get(key) for key in ("hand", "operator", "brace", "gravity", "torques", "feedforward")
    ):
        return
    if seen.config.get("sensors"):
        return
    moved = set(controller.get("joints") or {})
    period = seen.sample_time
    for a, motor in enumerate(seen.robot.motors):
        if not isinstance(motor, Motor) or motor.joint in moved:
            continue
        i = seen.joints.index(motor.joint)
        k_p, k_d = (_gain(controller, key, motor.joint) for key in ("k_p_V_per_rad", "k_d_V_s_per_rad"))
        if k_p is None or k_d is None:
            continue
        q, v = seen.q[:, seen.bodies.places[i]], seen.v[:, i]
        command = np.clip(k_p * (seen.robot.initial[seen.bodies.places[i]] - q) - k_d * v, -motor.voltage_limit, motor.voltage_limit)
        shown = seen.record["voltage"][:, a]
        if np.isfinite(motor.current_limit):
            continue
        if period is None:
            off = np.abs(shown - command)
        else:
            off = _held_command_errors(seen, command, shown, period)
        allowed = 1e-6 * (np.abs(command).max() + abs(k_p) + abs(k_d) * (1.0 + np.abs(v).max())) + 1e-9
        if off.max(initial=0.0) > allowed:
            t = int(off.argmax())
            yield f"{motor.joint} at t = {seen.time[t]:.6g} s: {shown[t]:.6g} V, {off[t]:.3g} V off the command of the state"


def _gain(controller: Mapping[str, Any], key: str, joint: str) -> float | None:
    value = controller.get(key)
    if isinstance(value, Mapping):
        value = value.get(joint)
    return None if value is None or isinstance(value, Sequence) else float(value)


def _held_command_errors(seen: Observed, command: Array, shown: Array, period: float) -> Array:
    """By how much voltages differ from the command at their tick, where that is a sample, (T,) [V]."""
    count = seen.time / period
    at_tick = np.abs(count - np.round(count)) < 1e-6
    tick = np.where(at_tick, np.round(count), np.floor(count)).astype(int)
    if SHOWS_HELD_UNTIL_TICK:
        tick = np.where(at_tick & (tick > 0), tick - 1, tick)
    sample_of_tick = {int(tick_): i for i, tick_ in enumerate(np.round(count).astype(int)) if at_tick[i]}
    off = np.zeros(len(seen))
    for i, number in enumerate(tick):
        if int(number) in sample_of_tick:
            off[i] = abs(shown[i] - command[sample_of_tick[int(number)]])
    return off


def absurd(seen: Observed) -> Finding:
    """No force is beyond what weight, loads, motors and the motion could do."""
    weight = sum(link.inertia.mass for link in seen.bodies.robot.links)
    size = weight * (np.linalg.norm(seen.bodies.gravity) + 1.0)
    size += sum(float(np.linalg.norm(load.components(seen.time)[:, :3], axis=1).max(initial=0.0)) for load in seen.loads)
    size += float(np.abs(seen.driven_torques(seen.record["current"], seen.v)).sum(axis=1).max(initial=0.0)) / LEVER_M
    for name in ("contact_normal_force", "stop_force", "joint_friction", "tie_force"):
        if name not in seen.record or not seen.record[name].size:
            continue
        most = float(np.abs(seen.record[name]).max())
        if most > ABSURD * size:
            yield f"{name} comes to {most:.3g}, where weight, loads and motors make {size:.3g}"
    # An impact of what moves takes at most all its energy; a scene of some kilograms knows no speeds like these.
    if np.abs(seen.v).max(initial=0.0) > 1e5 or np.abs(seen.q).max(initial=0.0) > 1e6:
        yield f"rates come to {np.abs(seen.v).max():.3g}, positions to {np.abs(seen.q).max():.3g}"


def _warned(seen: Observed, text: str) -> bool:
    return any(text in warning for warning in seen.run.warnings)


CHECKS: dict[str, Callable[[Observed], Finding]] = {
    "start": start,
    "equilibrium": equilibrium,
    "equation": equation,
    "momentum": momentum,
    "motion": motion,
    "circuit": circuit,
    "touching": touching,
    "friction": friction,
    "gaps": gaps,
    "stops": stops,
    "dry": dry,
    "ledger": ledger,
    "losses": losses,
    "powers": powers,
    "commands": commands,
    "absurd": absurd,
}
