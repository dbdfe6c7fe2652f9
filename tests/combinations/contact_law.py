"""The laws of contacts, joint stops and dry friction on records."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from combinations.observed import OPEN, SLIDING, STICKING, Observed, Touch, warned
from combinations.sentences import DRIFTED, IMMOBILE
from dynsim.model.surfaces import HeightField

Array = NDArray[np.float64]
Finding = Iterator[str]

# docs/theory/contact.md: gaps after the projection of a step [m]; and gap at which a point counts as landed.
DRIFT = 1e-9
# Slack for joint stops, because limits in files are rounded [rad or m].
STOP_SLACK = 1e-6
# Fraction of the force that a frozen slip direction and the tolerance of an event leave.
CONE = 1e-5
# Largest speed of a sticking point: limit of the velocity projection [m/s]; steps solve contact problems to 1e-8.
CREEP = 1e-6
# Beyond this distance the nearest point of a height field is not searched everywhere [m].
FAR = 0.5
# Direction of slower slip is noise: 1000 times the default atol [m/s].
SLOW = 1e-4
# The kernels' bound for such slip, in units of atol.
OF_ATOL = 1000.0


def touching(seen: Observed) -> Finding:
    """Check that gaps, slip and normals agree with the posture, open contacts have no force, and no contact pulls."""
    for k, touch in enumerate(seen.touches()):
        name = touch.contact.name
        off = np.abs(touch.gap - seen.record["contact_gap"][:, k])
        # The foot of the perpendicular to waves far below is not unique.
        if isinstance(touch.contact.surface, HeightField):
            off[touch.gap > FAR] = 0.0
        if touch.contact.solid is not None:  # slots that are not in use
            off[touch.mode == OPEN] = 0.0
        # Errors of two searches for a nearest point.
        if off.max() > 1e-8 + 1e-6 * np.abs(touch.gap[off.argmax()]):
            i = int(off.argmax())
            yield (
                f"{name} at t = {seen.time[i]:.6g} s: gap {seen.record['contact_gap'][i, k]:.6g}, own "
                f"{touch.gap[i]:.6g} m"
            )
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
        pulls = touch.normal_force + 1e-9 + CONE * size.max()
        if seen.stepped:
            pulls = pulls + _unsolved(seen, float(seen.record.summary["time_stepping"]["residual_max_m_s"]))
        if (pulls < 0.0).any():
            i = int(pulls.argmin())
            yield f"{name} at t = {seen.time[i]:.6g} s pulls with {-touch.normal_force[i]:.4g} N"
        unheld = (touch.mode == OPEN) & (size > 1e-9)
        if unheld.any():
            yield (
                f"{name} at t = {seen.time[unheld.argmax()]:.6g} s is open and has a force of "
                f"{size[unheld].max():.4g} N"
            )
        if touch.contact.stiffness == 0.0:
            far = (touch.normal_force > 1e-9) & (np.minimum(touch.gap, touch.gap_before) > _reach(seen, touch))
            if far.any():
                i = int(np.where(far, touch.gap, 0.0).argmax())
                yield (
                    f"{name} at t = {seen.time[i]:.6g} s: {touch.normal_force[i]:.4g} N at a gap of {touch.gap[i]:.3g} "
                    f"m"
                )


def _unsolved(seen: Observed, rate: float) -> Array:
    """Return the force that gives all links together this rate [m/s] within the step of each sample, (T,) [N].

    Contact problems of time stepping are solved to some rate: mobility times a force outside its cone is at most this.
    """
    start, end = seen.steps_around
    return np.asarray(rate * sum(link.inertia.mass for link in seen.robot.links) / np.maximum(end - start, 1e-12))


def _reach(seen: Observed, touch: Touch) -> Array:
    """Return the largest gap of a contact with a force, (T,) [m]; in time stepping plus the normal motion of a step.

    A point that starts within a micrometre of its surface counts as closed. While it is closed, its rate along the
    normal is zero at the end of each step, so that it leaves the surface by half the change of that rate in a step.
    """
    if not seen.stepped:
        return np.full(len(seen), 10.0 * DRIFT)
    closed = touch.mode != OPEN
    left = np.cumsum(np.where(closed, np.abs(_turned_rows(seen, touch)[0]), 0.0))
    left = left - np.maximum.accumulate(np.where(closed, 0.0, left))
    return np.asarray(1e-6 + left + seen.step * (_fastest_approach(touch) + np.linalg.norm(touch.slip, axis=1)))


def _fastest_approach(touch: Touch) -> Array:
    """Return the largest speed along the normal until each sample, (T,) [m/s]."""
    return np.asarray(np.maximum.accumulate(np.maximum(np.abs(touch.approach), np.abs(touch.approach_before))))


def coefficient(touch: Touch, speed: Array) -> Array:
    """Return μ at slip speeds, (T,)."""
    contact = touch.contact
    at_rest = contact.friction_at_rest
    mu = contact.friction + contact.viscous_friction * speed
    if contact.stribeck > 0.0:
        mu = mu + (at_rest - contact.friction) * np.exp(-((speed / contact.stribeck) ** 2))
    return np.asarray(mu)


def friction(seen: Observed) -> Finding:
    """Check that friction is in its cone, on its edge against slip, and that there is no other slip."""
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
    # Steps use μ at their start, the direction of their mean, and rates before an impact.
    before = touch.slip_before
    speed = np.maximum(speed, np.linalg.norm(before, axis=1))
    if seen.stepped:
        # A sample within a step has the force of the step, but rates between those at its ends.
        speed = np.maximum(speed, np.maximum(np.append(speed[1:], 0.0), np.append(0.0, speed[:-1])))
    most = np.maximum(contact.friction_at_rest, coefficient(touch, speed))
    if contact.grip_axis is None:
        over = size - most * f_n
        allowed = _share(seen, touch) * np.linalg.norm(touch.force, axis=1) + 1e-9 * (1.0 + np.abs(f_n).max())
        if seen.stepped:
            # Rates are solved to 1e-8 m/s.
            allowed = allowed + _unsolved(seen, 1e-8)
        if (closed & (over > allowed)).any():
            i = int(np.where(closed, over - allowed, -np.inf).argmax())
            yield (
                f"{contact.name} at t = {seen.time[i]:.6g} s: friction of {size[i]:.6g} N is outside the cone of "
                f"{most[i]:.4g} × {f_n[i]:.6g} N"
            )
    # In time stepping the law applies at the ends of steps; a sample may be within a step.
    power = (tangential * touch.slip_after).sum(axis=1)
    # A slightly wrong normal has a tangential share of the normal force, possibly all of the tangential force.
    noise = _share(seen, touch) * np.linalg.norm(touch.force, axis=1) * speed
    # Friction against w gives f·u up to |f| |u − w| to slip u.
    # Slip that begins against its direction by less than the accuracy of integration, a few times atol, continues.
    unknown = SLOW + touch.lag if seen.stepped else max(1e-7, 10.0 * seen.scenario.integrator.absolute_tolerance)
    gained = slips & (power > noise + size * unknown + 1e-12)
    if seen.stepped:
        # A step in which slip ends may end with part of it reversed.
        gained &= (tangential * before).sum(axis=1) > 0.0
    if gained.any():
        i = int(np.where(gained, power, 0.0).argmax())
        yield f"{contact.name} at t = {seen.time[i]:.6g} s: friction drives the slip with {power[i]:.4g} W"
    if contact.grip_axis is None:
        yield from _against_slip(seen, touch, slips, before)
    # Only the velocity of the touching point counts: other points of a rolling sphere move.
    sticks = closed & (touch.mode == STICKING)
    if seen.stepped:
        # A step at whose end slip is over contained some slip.
        sticks &= np.concatenate([[False], sticks[:-1]])
    moving = sticks & (np.linalg.norm(touch.slip, axis=1) > _creep(seen, touch))
    if moving.any():
        own = np.linalg.norm(touch.slip, axis=1)
        i = int(np.where(moving, own, 0.0).argmax())
        yield f"{contact.name} at t = {seen.time[i]:.6g} s sticks and slips with {own[i]:.3g} m/s"


def _share(seen: Observed, touch: Touch) -> Array:
    """Return the fraction of a force by which its parts may be wrong, (T,): in steps the normal is half a step old."""
    return CONE + touch.turned if seen.stepped else np.full(len(seen), CONE)


def _slow_slip(seen: Observed) -> float:
    """Return the slip up to which its initial direction is kept, 1000 atol [m/s]; in steps twice that speed."""
    return max(2.0 * OF_ATOL * seen.scenario.integrator.absolute_tolerance, SLOW)


def _creep(seen: Observed, touch: Touch) -> Array:
    """Return the largest slip of a sticking contact, (T,) [m/s]: time stepping adds the rotation of the surface."""
    if not seen.stepped:
        return np.full(len(seen), CREEP)
    moved = np.linalg.norm(np.diff(touch.position, axis=0, prepend=touch.position[:1]), axis=1)
    speed = np.abs(touch.approach) + np.linalg.norm(touch.slip, axis=1)
    soft = 1e-3 if touch.contact.stiffness > 0.0 else 0.0
    ends = touch.body if isinstance(touch.body, tuple) else (touch.body,)
    spin = np.sum([np.linalg.norm(seen.motion.spin[end], axis=1) for end in ends], axis=0)
    return np.asarray(SLOW + soft + 2.0 * (spin * moved + touch.turned * speed) + _turned_rows(seen, touch)[1])


def _against_slip(seen: Observed, touch: Touch, slips: NDArray[np.bool_], before: Array) -> Finding:
    """Check that sliding friction is μ f_n against the slip."""
    speed, f_n = np.linalg.norm(touch.slip_after, axis=1), touch.normal_force
    if seen.stepped:
        # If slip begins, ends or turns within a step, its friction is a mean: only steady slip is compared.
        earlier = np.linalg.norm(before, axis=1)
        both = np.maximum(speed, earlier)
        turned = np.linalg.norm(touch.slip_after - before, axis=1)
        steady = slips & (np.minimum(speed, earlier) > SLOW) & (turned < 0.2 * both)
        middle = 0.5 * (touch.slip_after + before)
        low, high = coefficient(touch, np.minimum(speed, earlier)), coefficient(touch, both)
        # The contact moves on the body within a step, and the tangent plane turns.
        # Directions of u and w are up to 2 |u − w|/|u| apart.
        share = (
            (turned + 2.0 * touch.lag) / np.maximum(both, 1e-300) + np.abs(high - low) / np.maximum(high, 1e-300) + 1e-3
        )
    else:
        steady, middle = slips & (speed > _slow_slip(seen)), touch.slip
        share = np.full(len(seen), 1e-3)
    pace = np.maximum(np.linalg.norm(middle, axis=1), 1e-300)
    mu = coefficient(touch, np.linalg.norm(before, axis=1) if seen.stepped else speed)
    expected = -(mu * f_n / pace)[:, None] * middle
    off = np.linalg.norm(touch.tangential - expected, axis=1)
    allowed = share * np.linalg.norm(touch.force, axis=1) + 1e-9
    wrong = steady & (off > allowed)
    if wrong.any():
        i = int(np.where(wrong, off / allowed, 0.0).argmax())
        yield (
            f"{touch.contact.name} at t = {seen.time[i]:.6g} s: friction {touch.tangential[i].round(5)} N, "
            f"{expected[i].round(5)} N against the slip {middle[i].round(6)} m/s, in {wrong.sum()} samples"
        )


def _at_an_end(seen: Observed, touch: Touch, i: int) -> bool:
    """Whether a link is nearest to the surface at an end of its axis that has a separate contact."""
    return any(
        other.contact.tip is None
        and np.linalg.norm(other.position[i] - touch.position[i])
        < 1e-4 + abs(other.contact.radius - touch.contact.radius)
        and other.gap[i] < touch.gap[i] + 1e-5
        for other in seen.touches()
    )


def _turned_rows(seen: Observed, touch: Touch) -> tuple[Array, Array]:
    """Return the changes in a step at the sample's rates: gap beyond its rate [m], and slip [m/s], (T,)."""
    then = next(other for other in seen.touches_before if other.contact.name == touch.contact.name)
    gap = touch.gap - then.gap - seen.step * touch.approach
    return np.asarray(gap), np.linalg.norm(touch.slip - then.slip, axis=1)


def gaps(seen: Observed) -> Finding:
    """Check that nothing is below its surface: by events within the residual of projection, by steps within a step."""
    for touch in seen.touches():
        name, contact = touch.contact.name, touch.contact
        if not seen.real:
            worst = int(np.abs(touch.gap).argmax())
            if abs(touch.gap[worst]) > DRIFT and not warned(seen, DRIFTED):
                yield (
                    f"{name} at t = {seen.time[worst]:.6g} s is {touch.gap[worst]:+.3g} m off the surface that it is "
                    f"glued to"
                )
            continue
        # A point that no joint moves along the normal is left out of the contacts, with a warning.
        if f"{name}{IMMOBILE}" in " ".join(seen.run.warnings):
            continue
        deepest = int(touch.gap.argmin())
        sag = 2.0 * np.abs(touch.normal_force).max() / contact.stiffness if contact.stiffness > 0.0 else 0.0
        begun = max(-float(touch.gap[0]), 0.0)
        allowed = DRIFT
        if seen.stepped:
            # The gap at the middle of a step decides: until its end a point moves and falls freely.
            fall = 0.5 * seen.step**2 * float(np.linalg.norm(seen.bodies.gravity))
            allowed = 1e-7 + sag + 1.5 * seen.step * float(_fastest_approach(touch)[deepest]) + fall
            # Rates are along the surface at the end of a step, so on a curve the point leaves it by half their change.
            allowed += float(np.abs(_turned_rows(seen, touch)[0])[touch.mode != OPEN].sum())
            if contact.tip is not None and _at_an_end(seen, touch, deepest):
                continue
        if -touch.gap[deepest] > allowed + begun:
            yield (
                f"{name} at t = {seen.time[deepest]:.6g} s is {-touch.gap[deepest]:.3g} m below its surface "
                f"(allowed {allowed:.3g})"
            )


def _spent(seen: Observed, joint: str, limit: float, beyond: float) -> bool:
    """Whether the energy lost in hits is too small to push the joint back against its largest force."""
    for stop in seen.record.summary["joint_stops"]:
        if stop["joint"] == joint and stop["limit"] == limit:
            return bool(stop.get("impact_loss_J", np.inf) < stop["force_max"] * beyond)
    return False


def stops(seen: Observed) -> Finding:
    """Check that joints stay within their stops, steps move them back, and a stop pushes only at its end."""
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
                yield (
                    f"{link.joint} at t = {seen.time[deepest]:.6g} s is {beyond[deepest]:.3g} beyond its stop (allowed "
                    f"{allowed:.3g})"
                )
            # 20 ms to return, at most at 0.02 per second, and as long again for the remaining energy.
            late = seen.time >= seen.time[deepest] + 0.2 + 2.0 * max(float(beyond[deepest]), 0.0) / 0.02
            if beyond[deepest] > 10.0 * STOP_SLACK and late.any():
                still = float(beyond[late].min())
                if still > 0.5 * beyond[deepest] and not _spent(seen, link.joint, limit, still):
                    since = seen.time[-1] - seen.time[deepest]
                    yield f"{link.joint} is {still:.3g} beyond its stop for {since:.3g} s and does not come back"
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
    """Check that dry friction of joints is within its bound, and on it, against the motion, if there is motion."""
    if "joint_friction" not in seen.record:
        return
    gears = {motor.joint: getattr(motor, "dry_friction", 0.0) for motor in seen.robot.motors}
    for k, joint in enumerate(seen.record.labels["joint_friction"]):
        i = seen.joints.index(joint)
        bound = seen.robot.links[i].friction + gears.get(joint, 0.0)
        torque, rate = seen.record["joint_friction"][:, k], seen.v[:, i]
        # Events are checked at the ends of steps: samples within them, and torques of joints at rest, have errors.
        off = 1e-6 if seen.stepped else max(1e-6, seen.scenario.integrator.rtol)
        if (np.abs(torque) > bound * (1.0 + off) + 1e-12).any():
            t = int(np.abs(torque).argmax())
            yield (
                f"{joint} at t = {seen.time[t]:.6g} s: dry friction of {torque[t]:.6g} is beyond its bound {bound:.6g}"
            )
        moves = np.abs(rate) > 10.0 * CREEP
        if not seen.stepped:
            moves &= ~_rests_with_constant_torque(seen, torque, rate)
        if seen.stepped:
            # Only steady motion: in a step in which it stops or begins, any force within the bound is valid.
            gain = seen.step * seen.vdot[:, i]
            moves &= np.minimum((rate - gain) * rate, (rate + gain) * rate) > 0.01 * rate**2
        beside = np.where(moves, np.abs(torque + bound * np.sign(rate)), 0.0)
        if (beside > 1e-6 * bound + 1e-9).any():
            t = int(beside.argmax())
            yield (
                f"{joint} at t = {seen.time[t]:.6g} s moves with {rate[t]:.3g} and its dry friction is "
                f"{torque[t]:.6g} of {bound:.6g}"
            )


def _rests_with_constant_torque(seen: Observed, torque: Array, rate: Array) -> Array:
    """Return samples at which a joint without a separate row may be nearly at rest because contacts hold it.

    Its torque is constant from one choice of modes to the next. The contacts may turn it at rates so low that slip has
    no defined direction, before the modes are chosen again: 1000 times atol.
    """
    same = np.abs(np.diff(torque)) <= 1e-12 * np.abs(torque[1:])
    constant = np.append(same, False) | np.insert(same, 0, False)
    slow = OF_ATOL * seen.scenario.integrator.absolute_tolerance
    return np.asarray(constant & (np.abs(rate) <= slow))
