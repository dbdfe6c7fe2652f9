"""Truth of the warnings and stops of a run, each verified by a separate computation.

A warning without an entry in :data:`VERIFIERS` is a finding, so that each new warning needs a check. Warnings that
only the engine can verify are in ``sentences.UNVERIFIED``, with the reason.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from combinations.accelerations import critical, exists, glued_forces, leaves, state_of
from combinations.observed import AT_STEP, OPEN, SLIDING, STICKING, Observed, Touch
from combinations.running import Run
from combinations.sampled_loop import loop_growth
from combinations.sentences import (
    AT_TIME,
    BY_AMOUNT,
    DUE_TO,
    FROM_THEN_ON,
    HOLDS_UP,
    INCOMPLETE,
    INSTEAD_OF,
    LAST_STEP,
    MOVED_BACK,
    OVERLOAD,
    SENTENCES,
    SHARE_OF_RUN,
    STEP_FELL,
    STILL_BEYOND,
    UNSTABLE,
    UNVERIFIED,
    WEDGE,
    WEDGED,
)
from combinations.surfaces import nearest
from dynsim.compile.clearance import POINTS
from dynsim.errors import SimulationStopped
from dynsim.model.drives import Motor, Servo

Array = NDArray[np.float64]
Match = re.Match[str]

# Numbers in sentences have three digits.
DIGITS = 0.006
# Fraction of the turnover above which steps must not create energy without a warning if contacts are compliant.
GAIN = 1e-3
# Slip and rates below this count as rest in the sentences of the engine [m/s, rad/s].
AT_REST = 1e-9
# Dependent rows have a singular value below this fraction of the largest.
DEPENDENT = 1e-6
# Fraction of a contact's force by which the engine may see it differently inside its cone, for lack of digits.
UNDECIDED = 1e-3
# The rounding of an angle above this is 1e-3 rad: it has no direction with the digits of a sentence [rad].
LOST = 1e13
# Number of samples in which a contact is checked for wedging, and number of directions of its cone.
LOOKED, ROUND = 41, 7201
# A loop is unstable if the logarithm of its states grows by more than GROWTH per second; it explains the end of a run
# if they have grown by e to the power GROWN.
GROWTH, GROWN = 1.0, 3.0


def untrue(scenario: Mapping[str, Any], run: Run, seen: Observed) -> Iterator[str]:
    """Yield a sentence for each wrong warning or stop, and for a warning that is missing."""
    lost = len(seen) > 0 and np.abs(seen.q).max() > LOST
    for warning in run.warnings:
        # The stop itself, in the words of its error.
        if warning.startswith(INCOMPLETE):
            if run.error is None or str(run.error) not in warning:
                yield f"{warning!r}, but it ended with {run.error!r}"
            continue
        answered = False
        for pattern, verifier in VERIFIERS.items():
            if (match := re.search(pattern, warning)) is not None:
                answered = True
                if lost:
                    break
                if reason := verifier(match, seen):
                    yield f"{warning[:160]!r}: {reason}"
                break
        if not answered and not any(re.search(pattern, warning) for pattern in UNVERIFIED):
            yield f"{warning[:160]!r}: no check knows this warning"
    rate = loop_growth(seen)
    if rate is not None and rate > 1.1 * GROWTH and not any(UNSTABLE in warning for warning in run.warnings):
        yield f"the sampled loop grows with {rate:.3g} 1/s, without a warning"
    if seen.real and not any(WEDGED in warning for warning in run.warnings):
        for touch in seen.touches():
            if _often_wedged(touch, seen):
                yield f"{touch.contact.name} can wedge itself against {touch.contact.surface_name}, without a warning"
    if isinstance(run.error, SimulationStopped):
        yield from _stop(run.error, seen)


def untrue_start(stop: SimulationStopped, seen: Observed) -> Iterator[str]:
    """Yield a sentence if a run that stopped before its first sample could have started."""
    if reason := _not_critical(stop, seen) and _has_forces(stop, seen):
        yield f"stops ({stop.kind}) before anything moves: {reason}; {str(stop)[:200]}"


def _stop(stop: SimulationStopped, seen: Observed) -> Iterator[str]:
    """Yield a sentence if a stop was not necessary."""
    text = f"stops ({stop.kind}) at t = {stop.time:.6g} s"
    if stop.kind not in STOPS:
        yield f"{text}: no check knows this kind of stop"
        return
    # An unstable loop with time to grow, in any posture, explains any kind of stop.
    for q in (None, *seen.q) if UNSTABLE in str(stop) else (None,):
        rate = loop_growth(seen, q)
        if rate is not None and rate > GROWTH and rate * stop.time > GROWN:
            return
    # There is no separate model of loops with encoders, so only their growth is checked.
    energy = seen.record["energy_kinetic"]
    grows = energy[-1] > 100.0 * energy[: max(1, len(seen) // 2)].max()
    if UNSTABLE in str(stop) and seen.reads_sensors and grows:
        return
    if reason := STOPS[stop.kind](stop, seen):
        yield f"{text}: {reason}; {str(stop)[:200]}"


def _not_overturned(stop: SimulationStopped, seen: Observed) -> str:
    margin = float(seen.record["tip_margin"][-1])
    return "" if margin < 0.05 else f"the tip margin is {margin:.3g}"


def _not_critical(stop: SimulationStopped, seen: Observed) -> str:
    return "" if critical(seen, stop.state) else "no combination of modes of the bodies is critical"


def _has_forces(stop: SimulationStopped, seen: Observed) -> str:
    return "there are contact forces" if exists(seen, stop.state, stop.time) else ""


def _unproved(stop: SimulationStopped, seen: Observed) -> str:
    return "nothing shows that it had to"


def _crawls(stop: SimulationStopped, seen: Observed) -> str:
    """Whether the rest would take more steps of the last length than were taken; otherwise it is only slow.

    Steps that are short for a true reason may be arbitrarily many.
    """
    if (match := re.search(HOLDS_UP, str(stop))) is not None:
        return _not_changing(match, stop, seen)
    step = re.search(LAST_STEP, str(stop))
    if step is None:
        return _unproved(stop, seen)
    taken, left = float(seen.record.summary["steps"]), float(seen.run.scenario["duration_s"]) - stop.time
    more = left / float(step[1])
    return "" if more <= taken else f"after {taken:.3g} steps, {more:.3g} more are left"


def _stands(stop: SimulationStopped, seen: Observed) -> str:
    """Whether friction that changes as fast as stated limits the steps; otherwise the stop is unproved."""
    match = re.search(HOLDS_UP, str(stop))
    return _unproved(stop, seen) if match is None else _not_changing(match, stop, seen)


# Explicit steps that stiff friction holds up, in its time constants: the limit of stability of DOPRI5 is 3.3,
# and steps go up to it, are rejected, and go up again.
HELD_UP = (1.0, 5.0)
# Slip below 1000 atol, or this [m/s], turns friction as fast as at this speed (docs/theory/unilateral.md).
SLOWEST = 1e-7
# Forces of real contacts come from the last sample, but the state from the stop: they may have changed by this factor.
SINCE = 1.3


def _not_changing(match: Match, stop: SimulationStopped, seen: Observed) -> str:
    """Return why friction changes more slowly with slip than stated, for an explicit method whose steps it limits.

    Friction damps slip: dv/dt = −A v, A_ij = W_ij D_j, with the mobility W of slip: the mobility of the bodies minus
    the part removed by the rows R of all closed contacts, whose forces have the directions F, with friction. Slip
    across the direction of a slipping real contact turns its friction μ f, with D = μ f / v. Friction of a glued
    contact is −μ f s / w, w² = |s|² + v_s², with D = μ f / w (1 − s sᵀ / w²).
    """
    if seen.record.summary["method"] != "dopri5":
        return "its method is not explicit"
    state, touch = state_of(seen, stop.state), _touch(seen, match[2])
    if touch is None or (seen.real and (match[2] not in state.names or touch.mode[-1] != SLIDING)):
        return f"{match[2]} does not slide"
    motion = seen.bodies.motion(state.q[None], state.v[None], np.zeros((1, len(state.v))))
    now = {other.contact.name: other for other in seen.touches(motion)}
    speed = float(np.linalg.norm(now[match[2]].slip[0]))
    if abs(speed - float(match[3])) > DIGITS * speed + AT_REST:
        return f"{match[2]} slips at {speed:.3g} m/s"
    identity, free = np.eye(len(state.v)), seen.bodies.free_directions()
    rows = [*np.linalg.svd(free)[0].T[free.shape[1] :]]
    for name in ("joint_friction", "stop_force") if seen.real else ():
        for k, joint in enumerate(seen.record.labels[name] if name in seen.record else ()):
            j = seen.joints.index(joint)
            if seen.record[name][-1, k] != 0.0 and abs(seen.v[-1, j]) < AT_REST:
                rows.append(identity[j])
    glued = {} if seen.real else _glued(stop, seen)
    forces: list[Array] = list(rows)
    slips: list[Array] = []
    damped: list[Array] = []
    blocks: dict[str, slice] = {}
    slow = max(1000.0 * seen.scenario.integrator.absolute_tolerance, SLOWEST)
    for other in seen.touches():
        if seen.real and other.mode[-1] == OPEN:
            continue
        J = seen.bodies.jacobian(seen.motion, other.body, other.position)[-1]
        n, friction, pressed = other.normal[-1], other.tangential[-1], float(other.normal_force[-1])
        if not seen.real:
            at = now[other.contact.name]
            J, n = seen.bodies.jacobian(motion, at.body, at.position)[0], at.normal[0]
            friction, pressed = glued[other.contact.name]
        if other.mode[-1] == STICKING and seen.real:
            rows += [*J]
            forces += [*J]
            continue
        rows.append(n @ J)
        forces.append((n + friction / (pressed or np.inf)) @ J)
        slip, contact = now[other.contact.name].slip[0], other.contact
        if seen.real:
            size = float(np.linalg.norm(friction))
            E = (np.cross(n, friction / (size or np.inf)) @ J)[None]
            D = np.array([[size / max(float(np.linalg.norm(slip)), slow)]])
        else:
            smooth = float(np.hypot(np.linalg.norm(slip), contact.slip_smoothing))
            size = contact.friction * (pressed if contact.pulling_friction == "signed" else abs(pressed))
            E = (np.eye(3) - np.outer(n, n)) @ J
            D = size / smooth * (np.eye(3) - np.outer(slip, slip) / smooth**2)
        blocks[contact.name] = slice(len(slips), len(slips) + len(E))
        slips += [*E]
        damped += [*(D @ E)]
    R, F, E, W = np.array(rows), np.array(forces), np.array(slips), np.linalg.inv(state.mass)
    A = E @ (W - W @ F.T @ np.linalg.pinv(R @ W @ F.T, rcond=1e-9) @ R @ W) @ np.array(damped).T
    fastest = float(np.abs(np.linalg.eigvals(A)).max())
    since = SINCE if seen.real else 1.0 + 2.0 * DIGITS
    if not 1.0 / since < fastest * float(match[4]) < since:
        return f"friction changes within {1.0 / max(fastest, 1e-300):.3g} s"
    own = float(A.diagonal()[blocks[match[2]]].sum())
    # The largest trace of the blocks is at least the mean of the eigenvalues.
    if own * len(blocks) * since < fastest:
        return f"that is not by {match[2]}, whose friction alone changes within {1.0 / max(own, 1e-300):.3g} s"
    low, high = HELD_UP
    if not low < float(match[1]) / float(match[4]) < high:
        return f"steps of {match[1]} s are not those that this holds up"
    return ""


def _glued(stop: SimulationStopped, seen: Observed) -> dict[str, tuple[Array, float]]:
    """Return the friction of each glued contact at a stop, (3,), and its normal force."""
    state, f = glued_forces(seen, stop.state, stop.time)
    motion = seen.bodies.motion(state.q[None], state.v[None], np.zeros((1, len(state.v))))
    forces = dict(zip(state.names, zip(f.tolist(), state.friction, strict=True), strict=True))
    result = {}
    for touch in seen.touches(motion):
        pressed, mu = forces[touch.contact.name]
        size = pressed if touch.contact.pulling_friction == "signed" else abs(pressed)
        slip = touch.slip[0]
        result[touch.contact.name] = (
            -mu * size * slip / np.hypot(np.linalg.norm(slip), touch.contact.slip_smoothing), pressed,
        )  # fmt: skip
    return result


def _does_not_run_away(stop: SimulationStopped, seen: Observed) -> str:
    """Return why steps need not be so short: nothing is critical, and friction does not cause infinite rates.

    Friction that reverses with a pulling glued contact may drive the motion. Fast motion has forces ∝ v², so that the
    power P ∝ v³ and dT/dt = P make the rates infinite after 2 T/P: no step can pass that time. With an error of at
    least third order in its share of that time, a rejected step takes at least rtol^(1/3) of it.
    """
    if not (reason := _not_critical(stop, seen)) or seen.real:
        return reason
    state = state_of(seen, stop.state)
    motion = seen.bodies.motion(state.q[None], state.v[None], np.zeros((1, len(state.v))))
    frictions, step = _glued(stop, seen), re.search(STEP_FELL, str(stop))
    power = sum(float(frictions[touch.contact.name][0] @ touch.slip[0]) for touch in seen.touches(motion))
    energy = 0.5 * float(state.v @ state.mass @ state.v)
    share = float(step[1]) * power / (2.0 * energy) if step is not None and energy > 0.0 else 0.0
    if share > seen.scenario.integrator.rtol ** (1.0 / 3.0):
        return ""
    return f"{reason}, and a step is {share:.2g} of the time in which friction could make the rates infinite"


STOPS: dict[str, Callable[[SimulationStopped, Observed], str]] = {
    "overturned": _not_overturned,
    "forces_reversed": _not_critical,
    "several_forces": _not_critical,
    "no_forces": _not_critical,
    "step_too_small": _does_not_run_away,
    "not_finite": _not_critical,
    "no_contact_forces": _has_forces,
    # The scene contains no reason for runs that do not end.
    "not_projected": _unproved,
    "chatter": _unproved,
    "no_progress": _stands,
    "out_of_time": _crawls,
    "stuck": _unproved,
}
"""Check of each kind of stop; returns the reason why the stop is wrong, or an empty string."""


def _joint(seen: Observed, name: str) -> int | None:
    return seen.joints.index(name) if name in seen.joints else None


def _near(value: float, said: str, digits: float = DIGITS) -> bool:
    return abs(value - float(said)) <= digits * max(abs(value), abs(float(said))) + 1e-12


def _touch(seen: Observed, name: str) -> Touch | None:
    return next((touch for touch in seen.touches() if touch.contact.name == name), None)


def _chatters(match: Match, seen: Observed) -> str:
    times = np.array([event.time for event in seen.record.events if event.name == match[1]])
    most = max((int(((times >= t) & (times <= t + float(match[3]))).sum()) for t in times), default=0)
    return "" if most >= 0.5 * float(match[2]) else f"{most} events of it within {match[3]} s"


def _pulls(match: Match, seen: Observed) -> str:
    touch = _touch(seen, match[1])
    if touch is None or seen.real:
        return "no such glued contact"
    least = -float(touch.normal_force.min(initial=0.0))
    # Steps between samples may have seen larger values.
    if least > float(match[4]) * (1.0 + DIGITS):
        return f"with {least:.4g} N in a sample"
    # Commands of an unstable loop alternate from tick to tick, and samples may show only every second one.
    if any(UNSTABLE in warning for warning in seen.run.warnings):
        return ""
    pulling = touch.normal_force < 0.0
    share = 100.0 * float(pulling.mean())
    # If consecutive samples have different signs, the time and number of sign changes between them are unknown.
    off = 100.0 * (3.0 + np.count_nonzero(pulling[1:] != pulling[:-1])) / len(seen) + 1.0
    return "" if abs(share - float(match[3])) <= off else f"in {share:.3g} % of the samples"


def _pulls_between(match: Match, seen: Observed) -> str:
    """Return a reason if a contact that leaves its surface does not pull; steps between samples may have seen more."""
    touch = _touch(seen, match[1])
    if touch is None or not seen.real:
        return "no such contact that leaves its surface"
    least = -float(touch.normal_force.min(initial=0.0))
    return f"with {least:.4g} N in a sample" if least > float(match[2]) * (1.0 + DIGITS) else ""


def _never_touches(match: Match, seen: Observed) -> str:
    touch = _touch(seen, match[1])
    if touch is None:
        return "no such contact"
    if np.abs(touch.normal_force).max(initial=0.0) > 0.0:
        return f"it carries {touch.normal_force.max():.4g} N"
    near = 1e3 * float(touch.gap.min())
    if abs(near - float(match[3])) > DIGITS * abs(near) + 1e-5:
        return f"it comes as near as {near:.4g} mm"
    return ""


def _never_pressed(match: Match, seen: Observed) -> str:
    touch = _touch(seen, match[1])
    if touch is None:
        return "no such contact"
    if np.abs(touch.normal_force).max(initial=0.0) > 0.0:
        return f"it carries {touch.normal_force.max():.4g} N"
    near = float(touch.gap.min())
    return "" if near <= 2e-6 else f"it comes as near as {near:.4g} m"


def _reversed(match: Match, seen: Observed) -> str:
    """Check W_nn − μ W_nt < 0 for the contact alone, at the sample after the stated time; without one, at the stop."""
    touch, since = _touch(seen, match[1]), _at_latest(match[2])
    if touch is None:
        return "no such contact"
    i, stop = int(np.searchsorted(seen.time, since)), seen.run.error
    if i == len(seen) and isinstance(stop, SimulationStopped):
        return _not_reversed_at(stop, match[1], seen, since)
    i = min(i, len(seen) - 1)
    J = seen.bodies.jacobian(seen.motion, touch.body, touch.position)[i]
    M = seen.bodies.mass_matrix(seen.q[i])
    own = touch.normal[i] @ J @ np.linalg.solve(M, J.T @ touch.force[i]) / (touch.normal_force[i] or 1.0)
    size = touch.normal[i] @ J @ np.linalg.solve(M, J.T @ touch.normal[i])
    if touch.mode[i] != SLIDING:
        # It slid between the samples: assume the worst direction.
        answer = np.linalg.solve(M, J.T @ touch.normal[i]) @ J.T
        own = min(own, size - touch.contact.friction_at_rest * float(np.linalg.norm(answer - size * touch.normal[i])))
    return "" if own < 0.05 * size else f"the diagonal entry is {own:.3g} of {size:.3g} at t = {seen.time[i]:.4g} s"


def _at_latest(said: str) -> float:
    """Return the largest time that is written like this with four digits."""
    value = float(said)
    return value + (0.5 * 10.0 ** (np.floor(np.log10(value)) - 3.0) if value > 0.0 else 0.0)


# A runaway (8584: 5e9 rad/s at its stop) had another posture at its warning, which no sample shows [rad or m].
ANOTHER_POSTURE = 0.1


def _not_reversed_at(stop: SimulationStopped, name: str, seen: Observed, since: float) -> str:
    state = state_of(seen, stop.state)
    if float(np.abs(stop.state["v"]).max()) * (stop.time - since) > ANOTHER_POSTURE:
        return ""
    if name not in state.names:
        return "it is open at the stop"
    k = state.names.index(name)
    rows, slip = state.rows[k], state.slip[k]
    answer = rows @ np.linalg.solve(state.mass, rows[0])
    speed = float(np.linalg.norm(slip))
    slides = speed > AT_REST and stop.time <= since
    along = float(answer[1:] @ slip) / speed if slides else float(np.linalg.norm(answer[1:]))
    own = float(answer[0]) - state.friction[k] * along
    return "" if own < 0.05 * answer[0] else f"the diagonal entry is {own:.3g} of {answer[0]:.3g} at the stop"


def _friction_gives(match: Match, seen: Observed) -> str:
    gained = -float(seen.record["heat_friction"][-1])
    if isinstance(seen.run.error, SimulationStopped) and float(match[1]) > gained:
        return ""  # the summary counts up to the stop, the signals up to the last sample
    return "" if _near(gained, match[1]) else f"by the signals {gained:.3g} J"


def _at_limit(match: Match, seen: Observed) -> str:
    motor = next((motor for motor in seen.robot.motors if motor.joint == match[1]), None)
    if motor is None:
        return "no such motor"
    a, limit = seen.robot.motors.index(motor), float(match[3])
    signal = seen.record["voltage" if match[2] == "voltage" else "current"][:, a]
    # Currents of circuits approach their limit without reaching it: the last thousandth counts.
    near = limit * (1.0 - (1e-3 if isinstance(motor, Motor) and match[2] == "current" else 1e-5))
    reached = np.abs(signal) >= near
    if isinstance(motor, Servo):
        reached &= seen.record["current"][:, a] != 0.0
    share = 100.0 * float(reached.mean())
    return "" if abs(share - float(match[4])) <= 0.15 + 100.0 / len(seen) else f"in {share:.3g} % of the samples"


def _passes_limit(match: Match, seen: Observed) -> str:
    i = _joint(seen, match[1])
    if i is None:
        return "no such joint"
    link, q, v = seen.robot.links[i], seen.q[:, seen.bodies.places[i]], seen.v[:, i]
    torque = np.zeros(len(seen))
    if match[1] in seen.record.labels["torque"]:
        torque = seen.record["torque"][:, seen.record.labels["torque"].index(match[1])]
    beyond = {
        "lower position": link.lower - q,
        "upper position": q - link.upper,
        "velocity": np.abs(v) - link.velocity_limit,
        "effort": np.abs(torque) - link.effort_limit,
    }[match[2]]
    over = np.flatnonzero(beyond > 1e-6)
    if not over.size:
        return "no sample is beyond it"
    still = float(beyond[-1]) > 1e-6
    if (still and MOVED_BACK in match.string) or (not still and STILL_BEYOND in match.string):
        return f"it is {beyond[-1]:.3g} beyond it at the end"
    first = float(seen.time[over[0]])
    return "" if _near(first, match[3]) or abs(first - float(match[3])) < 1e-3 else f"first at t = {first:.4g} s"


def _does_not_close(match: Match, seen: Observed) -> str:
    from combinations.energy import residual_floor, turnover_and_residual

    turnover, residual = turnover_and_residual(seen)
    relative = residual / max(turnover, residual_floor(seen), 1e-300)
    return "" if relative > 0.9e-6 else f"the residual is {relative:.2e} of the turnover"


def _drifted(match: Match, seen: Observed) -> str:
    worst = max(
        (float(np.abs(touch.gap[touch.mode != OPEN]).max(initial=0.0)) for touch in seen.touches()), default=0.0
    )
    # Samples are projected; the drift is measured at accepted steps.
    return "" if worst <= float(match[1]) * (1.0 + DIGITS) + 1e-9 else f"by {worst:.2g} m in a sample"


def _at_step_ends(seen: Observed) -> NDArray[np.bool_]:
    """Return samples at ends of steps: within a step states and energies are linear, with the rest in the scheme."""
    return np.abs(seen.steps_around[1] - seen.time) < AT_STEP * seen.step


def _scheme(match: Match, seen: Observed) -> str:
    most = float(np.abs(seen.record["loss_scheme"][_at_step_ends(seen)]).max(initial=0.0))
    return "" if most <= float(match[1]) * (1.0 + DIGITS) + 1e-12 else f"{most:.3g} J in a sample"


def _gains(match: Match, seen: Observed) -> str:
    """Check that something is compliant, and the number is a share of the turnover, at least a fall of the loss."""
    from combinations.energy import residual_floor, turnover_and_residual

    if not seen.robot.ties and all(touch.contact.stiffness == 0.0 for touch in seen.touches()):
        return "nothing gives way"
    stated = float(match[1]) * (1.0 + DIGITS)
    if stated < GAIN * max(turnover_and_residual(seen)[0], residual_floor(seen)):
        return f"{match[1]} J are less than {GAIN:g} of the turnover"
    loss = seen.record["loss_scheme"][_at_step_ends(seen)]
    made = float((np.maximum.accumulate(loss) - loss).max(initial=0.0))
    return "" if made <= stated + 1e-12 else f"{made:.3g} J between samples"


def _sinks(match: Match, seen: Observed) -> str:
    # A compliant surface deforms by f/k, whatever the steps.
    rigid = [touch for touch in seen.touches() if touch.contact.stiffness == 0.0]
    deepest = max((-1e3 * float(touch.gap.min(initial=0.0)) for touch in rigid), default=0.0)
    return "" if deepest <= float(match[1]) * (1.0 + DIGITS) + 1e-3 else f"{deepest:.3g} mm in a sample"


def _compressed(match: Match, seen: Observed) -> str:
    """Check that the contact or pair is compliant, and that no sample is deeper than stated."""
    own = [touch for touch in seen.touches() if touch.contact.name == match[1]]
    own += [t for t in seen.touches() if f"{t.contact.body}-{t.contact.surface.carrier}" == match[1]]
    if not any(touch.contact.stiffness > 0.0 for touch in own):
        return "no such compliant contact"
    deepest = 1e3 * max(-float(touch.gap.min()) for touch in own)
    return "" if deepest <= float(match[2]) * (1.0 + DIGITS) + 1e-3 else f"{deepest:.3g} mm in a sample"


def _passes_through(match: Match, seen: Observed) -> str:
    """Check that the pair exists and that its gap changes at that time."""
    own = [t for t in seen.touches() if f"{t.contact.body}-{t.contact.surface.carrier}" == match[1]]
    if not own:
        return "no such pair"
    around = np.abs(seen.time - float(match[2])) <= np.diff(seen.time).max()
    change = max(float(np.ptp(touch.gap[around])) for touch in own)
    return "" if change > 0.0 else "the gap does not change"


def _shared(match: Match, seen: Observed) -> str:
    """Check that rows of closed contacts and resting joints are dependent in some sample."""
    names = [name for name in re.split(r", | and ", match[1]) if name and not name.endswith(" more")]
    joints = [name for name in re.split(r", | and ", match[2] or "") if name and not name.endswith(" more")]
    known = {touch.contact.name for touch in seen.touches()}
    if not names:
        return "it names no contact"
    if any(name not in known for name in names) or any(name not in seen.joints for name in joints):
        return "it names unknown contacts or joints"
    for i in _samples_of_modes(seen):
        if _dependent(seen, i):
            return ""
    return "rows of closed contacts and resting joints are independent in all sets of modes"


def _shared_by_joints(match: Match, seen: Observed) -> str:
    """Check that rows of resting joints and of couplings are dependent in some sample."""
    joints = [name for name in re.split(r", | and ", match[1]) if name and not name.endswith(" more")]
    if any(name not in seen.joints for name in joints):
        return "it names unknown joints"
    if any(_dependent(seen, i) for i in _samples_of_modes(seen)):
        return ""
    return "rows of resting joints are independent in all sets of modes"


def _samples_of_modes(seen: Observed) -> list[int]:
    modes = np.stack([touch.mode for touch in seen.touches()], axis=1) if seen.touches() else np.zeros((len(seen), 0))
    resting = np.abs(seen.joint_signal("joint_friction")) > 0.0
    resting &= np.abs(seen.v) < AT_REST
    both = np.hstack([modes, resting])
    _, first = np.unique(both, axis=0, return_index=True)
    return [int(i) for i in first]


def _dependent(seen: Observed, i: int) -> bool:
    basis = seen.bodies.free_directions()
    parts = []
    for touch in seen.touches():
        if touch.mode[i] != OPEN:
            J = seen.bodies.jacobian(seen.motion, touch.body, touch.position)[i]
            rows = J if touch.mode[i] == STICKING else touch.normal[i][None] @ J
            parts.append(_row_space(rows @ basis))
    rubs = seen.record.labels["joint_friction"] if "joint_friction" in seen.record else ()
    for joint in rubs:
        j = seen.joints.index(joint)
        if abs(seen.v[i, j]) < AT_REST:
            parts.append(_row_space(np.eye(seen.bodies.n)[j][None] @ basis))
    rows = np.vstack(parts) if parts else np.zeros((0, basis.shape[1]))
    sizes = np.linalg.svd(rows, compute_uv=False) if len(rows) else np.zeros(0)
    return int((sizes > DEPENDENT).sum()) < len(rows)


def _row_space(rows: Array) -> Array:
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(basis[sizes > max(DEPENDENT * sizes.max(initial=0.0), 1e-9)])


def _below(match: Match, seen: Observed) -> str:
    """Check that the axis of the deepest body is below the surface by the stated depth, and by more than its radius."""
    surface = seen.shapes.get(match[1])
    link = next((k for k, link in enumerate(seen.robot.links) if link.name == match[2]), None)
    if surface is None or link is None:
        return "no such surface or body"
    own = seen.robot.links[link]
    ends = [own.tip] if own.tip is not None else [other.p_PJ for other in seen.robot.links if other.parent == own.name]
    if own.tip is None and seen.robot.hand[0] == own.name:
        ends.append(seen.robot.hand[1])
    start = seen.motion.point(link, np.zeros(3))
    deepest, spacing = -float(surface.distance(start).min()), 0.0
    for end in ends:
        tip = seen.motion.point(link, end)
        # The engine checks points of the axis: within half their spacing distances change by at most that much.
        spacing = max(spacing, float(np.linalg.norm(end)) / POINTS)
        for share in np.linspace(0.0, 1.0, 65):
            deepest = max(deepest, -float(surface.distance(start + share * (tip - start)).min()))
        # A tangent point of a small ball is between these points: use the least distance.
        deepest = max(deepest, -float(surface.distance(nearest(surface, start, tip)).min()))
    if abs(1e3 * deepest - float(match[3])) > 0.02 * abs(1e3 * deepest) + 0.02 + 0.5e3 * spacing:
        return f"it lies {1e3 * deepest:.4g} mm deep"
    # Between the points checked here it may be slightly deeper.
    return "" if deepest > own.radius - 2e-5 else f"that is within its radius of {own.radius:g} m"


def _reference_beyond(match: Match, seen: Observed) -> str:
    """Check that waypoints exceed the stop; splines between them may, so that only the joint is checked."""
    i = _joint(seen, match[1])
    if i is None:
        return "no such joint"
    link = seen.robot.links[i]
    return "" if np.isfinite(link.lower) or np.isfinite(link.upper) else "it has no stop"


def _overloaded(match: Match, seen: Observed) -> str:
    names = {motor.joint: a for a, motor in enumerate(seen.robot.motors)}
    quantity = {"current": "current", "torque": "torque", "force": "torque"}[match[2]]
    for joint, said in re.findall(OVERLOAD, match[1]):
        if joint not in names:
            return f"no motor {joint}"
        a = names[joint]
        squared = seen.record[quantity][:, a] ** 2
        rms = float(np.sqrt(np.trapezoid(squared, seen.time) / (seen.time[-1] - seen.time[0])))
        motor = seen.robot.motors[a]
        nominal = motor.nominal_torque if quantity == "torque" else getattr(motor, "nominal_current", np.inf)
        if not _near(rms, said):
            return f"the root mean square of {joint} is {rms:.4g}"
        if rms <= nominal:
            return f"the nominal value of {joint} is {nominal:g}"
    return ""


def _tips(match: Match, seen: Observed) -> str:
    margin = seen.record["tip_margin"]
    tipped = any(event.kind == "tip_over" for event in seen.record.events)
    return (
        ""
        if tipped and abs(float(match[1] or 0.0) - 100.0 * float((margin < 0.0).mean())) < 0.1
        else "by the signals it does not"
    )


def _lifted(match: Match, seen: Observed) -> str:
    share = 100.0 * float((seen.record["wheel_load"].sum(axis=1) <= 0.0).mean())
    return "" if abs(share - float(match[1])) < 0.1 else f"in {share:.3g} % of the samples"


def _would_slip(match: Match, seen: Observed) -> str:
    k = seen.record.labels["traction_demand"].index(match[1])
    first = min((event.time for event in seen.record.events if event.kind == "tip_over"), default=np.inf)
    most = float(np.nanmax(seen.record["traction_demand"][seen.time < first, k]))
    return "" if _near(most, match[2]) else f"it needs {most:.4g} times in the samples"


def _left_out(match: Match, seen: Observed) -> str:
    """Check that the joints give the point no velocity along the normal in any sample."""
    touch = _touch(seen, match[1])
    if touch is None:
        return "no such contact"
    J = seen.bodies.jacobian(seen.motion, touch.body, touch.position)
    along = np.abs(np.einsum("tk,tkn->tn", touch.normal, J)).max(initial=0.0)
    # Lever arms of metres, rounded.
    return "" if along <= 1e-9 * (1.0 + np.abs(J).max(initial=0.0)) else f"joints move it by {along:.3g} m/rad"


def _jumps(match: Match, seen: Observed) -> str:
    return "" if (seen.config.get("initial") or {}).get("equilibrium") else "no equilibrium was asked for"


def _unstable(match: Match, seen: Observed) -> str:
    if seen.reads_sensors:
        # There is no separate model of encoders with delay; with true positions it is the slower loop.
        return ""
    from_then_on = re.search(FROM_THEN_ON, match.string)
    q = None if from_then_on is None else seen.q[np.abs(seen.time - float(from_then_on[1])).argmin()]
    rate = loop_growth(seen, q, most=True)
    return "" if rate is not None and rate > 0.9 * GROWTH else f"it grows with {rate} 1/s"


def _unpressed(match: Match, seen: Observed) -> str:
    """Each contact sticks somewhere, and would leave there if it had no force."""
    for name, share in re.findall(SHARE_OF_RUN, match[1]):
        touch = _touch(seen, name)
        if touch is None:
            return f"no contact {name}"
        rows, samples = np.flatnonzero(touch.mode == STICKING), int(0.01 * float(share) * len(seen))
        # It may be between two samples.
        if samples > 0 and not any(leaves(seen, name, int(i)) for i in rows[:: max(min(len(rows) // 20, samples), 1)]):
            return f"{name} is pressed wherever it sticks"
    return ""


def _leaves_in_impact(match: Match, seen: Observed) -> str:
    """Each contact lifts off at the reported time."""
    for name, time in re.findall(AT_TIME, match[1]):
        lifts = [event.time for event in seen.record.events if event.kind == "lift_off" and event.name == name]
        if not any(abs(own - float(time)) <= 1e-5 * own for own in lifts):
            return f"{name} does not lift off at t = {time} s"
    return ""


def _wedged(match: Match, seen: Observed) -> str:
    """Each contact is closed at its time, can wedge itself from the coefficient on, and nothing else decides there."""
    entries = re.findall(WEDGE, match[1])
    for name, least, friction, time in entries:
        touch = _touch(seen, name)
        if touch is None or not seen.real:
            return f"no contact {name} that can open"
        if not _near(touch.contact.friction_at_rest, friction):
            return f"{name} has a coefficient of {touch.contact.friction_at_rest:g}"
        own, undecided = _wedges(touch, seen, int(np.abs(seen.time - float(time)).argmin()), -UNDECIDED)
        if not _near(own, least):
            return f"{name} can wedge itself from a coefficient of {own:.4g} on"
        if not undecided:
            return f"{name} sticks there by its load alone"
    return "" if entries else "it names no contact"


def _often_wedged(touch: Touch, seen: Observed) -> bool:
    """Whether a contact can wedge in a tenth of the samples in which it is closed, one after another."""
    mu, contact = touch.contact.friction_at_rest, touch.contact
    closed = np.flatnonzero(touch.mode != OPEN)
    if contact.stiffness > 0.0 or contact.grip_axis is not None or mu == 0.0 or not len(closed):
        return False
    looked = closed[np.linspace(0, len(closed) - 1, LOOKED).astype(int)].tolist()
    in_row = 0
    for i in looked:
        least, undecided = _wedges(touch, seen, i, UNDECIDED)
        in_row = in_row + 1 if undecided and least < mu * (1.0 - DIGITS) else 0
        if in_row > LOOKED // 10:
            return True
    return False


def _wedges(touch: Touch, seen: Observed, i: int, margin: float) -> tuple[float, bool]:
    """Return the least coefficient with which a contact wedges in a sample, and whether its load leaves that open.

    Forces that no joint feels are searched in all directions of the cone's axis and of a circle around it. The load
    decides if forces without them, along the normal and along possible slip, are in the cone, up to a ``margin``, a
    fraction of the force.
    """
    n, closed = touch.normal[i], touch.mode[i] != OPEN
    rows = seen.bodies.jacobian(seen.motion, touch.body, touch.position)[i] @ seen.bodies.free_directions()
    values, vectors = np.linalg.eigh(rows @ rows.T)
    null = vectors[:, values <= DEPENDENT**2 * values[-1]]
    if not closed or not null.shape[1] or np.linalg.norm(n @ rows) <= DEPENDENT * np.sqrt(values[-1]):
        return np.inf, False
    angles = np.linspace(0.0, 2.0 * np.pi, ROUND)
    across = np.array([np.cos(angles), np.sin(angles)])[: null.shape[1]]
    directions = null @ (across if null.shape[1] == 2 else np.array([[-1.0, 1.0]]))
    along = np.maximum(n @ directions, DEPENDENT)
    least = float((np.sqrt(np.maximum(1.0 - along**2, 0.0)) / along).min())
    # Slip keeps the point on its surface.
    still = null_space(np.array([n @ rows])) if rows.shape[1] > 1 else np.zeros((rows.shape[1], 0))
    u, sizes, _ = np.linalg.svd(rows @ still)
    slips = u[:, : int((sizes > DEPENDENT * np.sqrt(values[-1])).sum())]
    needed = np.linalg.lstsq(rows.T @ np.column_stack([n, slips]), rows.T @ touch.force[i], rcond=None)[0]
    edge = touch.contact.friction_at_rest * needed[0] - float(np.linalg.norm(needed[1:]))
    outside = min(needed[0], edge) < -margin * float(np.linalg.norm(touch.force[i])) - 1e-9 * np.sign(margin)
    return least, bool(touch.mode[i] == SLIDING or outside)


def _slips_at_once(match: Match, seen: Observed) -> str:
    moves = float(np.abs(seen.vdot[0]).max(initial=0.0)) > 1e-6
    early = any(event.kind == "slip_start" and event.time <= 2e-3 for event in seen.record.events)
    return "" if moves or early else "nothing slips or moves at the start"


def _moves_at_once(match: Match, seen: Observed) -> str:
    """Check that it has that acceleration, and a contact that would carry at rest does not."""
    j = seen.joints.index(match[1])
    if abs(seen.vdot[0, j] - float(match[2])) > DIGITS * abs(seen.vdot[0, j]):
        return f"{match[1]} starts with {seen.vdot[0, j]:.4g}"
    for name, now in re.findall(INSTEAD_OF, match[0]):
        touch = _touch(seen, name)
        if touch is None or abs(touch.normal_force[0] - float(now)) > DIGITS * abs(float(now)) + 1e-9:
            return f"{name} does not carry {now} N"
    return ""


def _moved_at_the_start(match: Match, seen: Observed) -> str:
    """The first sample differs from the scenario's posture by the reported amounts."""
    for name, angle in re.findall(BY_AMOUNT, match[1]):
        joint = _joint(seen, name)
        if joint is None:
            return f"no joint {name}"
        k = seen.bodies.places[joint]
        off = float(seen.q[0, k] - seen.robot.initial[k])
        own = np.degrees(off) if seen.robot.links[joint].units[0] == "rad" else off
        if not _near(own, angle):
            return f"{name} starts {own:.4g} from there"
    return ""


def _not_carried_out(match: Match, seen: Observed) -> str:
    """Check the script with only the limit on the hand's acceleration, and the final position of its target."""
    operator = (seen.config.get("controller") or {}).get("operator")
    if operator is None:
        return "there is no operator"
    rate, most = operator["rate_hz"], operator["hand_acceleration_m_s2"] / operator["rate_hz"]
    commands = [command for command in operator["commands"] if command["hand"] is not None]
    velocity, moved, path = np.zeros(3), np.zeros(3), 0.0
    for tick in range(int(seen.time[-1] * rate + 1e-6) + 1):
        begun = [command["hand"] for command in commands if command["at_s"] * rate <= tick + 1e-6]
        change = np.array(begun[-1] if begun else [0.0, 0.0, 0.0]) - velocity
        velocity = velocity + change * min(1.0, most / max(float(np.linalg.norm(change)), 1e-300))
        moved, path = moved + velocity / rate, path + float(np.linalg.norm(velocity)) / rate
    missed, asked = float(match[1]), float(match[2])
    # Three digits are printed, and a tick at the end may count.
    near = DIGITS * path + max(float(np.linalg.norm(command["hand"])) for command in commands) / rate
    if abs(asked - path) > near:
        return f"it was commanded to go {path:.3g} m"
    # By the triangle inequality the paths add up to at least the distance, and at most both paths together.
    least = 0.0
    if "target_position" in seen.record:
        target = seen.record["target_position"]
        least = float(np.linalg.norm(moved - (target[-1] - target[0])))
    return "" if least - near <= missed <= 2.0 * path + near else f"it ended {least:.3g} m from there"


def _off_path(match: Match, seen: Observed) -> str:
    off = 1e3 * float(np.linalg.norm(seen.record["hand_position"][0] - seen.record["target_position"][0]))
    return "" if _near(off, match[1]) else f"it starts {off:.3g} mm off"


def _off_target(match: Match, seen: Observed) -> str:
    """Check the distance, and the condition that each cause requires at the first joint that is named."""
    names = ("hand_position", "target_position") if match[1] == "hand" else ("w", "w_target")
    at, target = (seen.record[name][-1, :3] for name in names)
    off = 1e3 * float(np.linalg.norm(at - target))
    if not (_near(off, match[2]) and _near(float(seen.time[-1]), match[3])):
        return f"at the end it is {off:.3g} mm off"
    for text, holds in _CONDITIONS.items():
        for joint in re.findall(DUE_TO.format(text), match.string):
            if not holds(joint, seen):
                return f"that is not so of {joint}"
    return ""


def _saturated_at_end(joint: str, seen: Observed) -> bool:
    motor = next((motor for motor in seen.robot.motors if motor.joint == joint), None)
    if not isinstance(motor, Motor | Servo):
        return False
    a = seen.robot.motors.index(motor)
    volts, amperes = (abs(float(seen.record[name][-1, a])) for name in ("voltage", "current"))
    return (
        volts >= 0.999 * motor.voltage_limit
        or amperes >= 0.99 * motor.greatest_current
        or _holds_current(motor, seen, a)
    )


def _holds_current(motor: Motor | Servo, seen: Observed, a: int) -> bool:
    """Whether the driver lowers the voltage for its current limit: the current approaches it."""
    back = motor.joint_constant * float(seen.v[-1, seen.robot.joint_names.index(motor.joint)])
    drop = abs(float(seen.record["voltage"][-1, a]) - back)
    return drop >= 0.999 * motor.resistance * motor.greatest_current


def _at_stop(joint: str, seen: Observed) -> bool:
    labels = seen.record.labels["stop_force"] if "stop_force" in seen.record else ()
    return joint in labels and bool(seen.record["stop_force"][-1, labels.index(joint)] != 0.0)


def _position_controlled(joint: str, seen: Observed) -> bool:
    motor = next((motor for motor in seen.robot.motors if motor.joint == joint), None)
    return isinstance(motor, Motor) or (isinstance(motor, Servo) and not motor.velocity_mode)


_CONDITIONS: dict[str, Callable[[str, Observed], bool]] = {
    "sag of ": lambda joint, seen: bool(np.any(seen.robot.gravity)) and _position_controlled(joint, seen),
    "contact forces on ": lambda joint, seen: bool(seen.record["contact_force"][-1].any()),
    "loads and ties on ": lambda joint, seen: any(seen.config.get(key) for key in ("loads", "ties", "objects")),
    "motors of ": _saturated_at_end,
    "joint stops of ": _at_stop,
    "friction at rest of ": lambda joint, seen: (
        (seen.real and bool(seen.record["joint_friction"][-1].any()))
        or any(isinstance(motor, Servo) and motor.coulomb_friction > 0.0 for motor in seen.robot.motors)
    ),
    "motion of (?!.* without)": lambda joint, seen: bool(np.abs(seen.v[-1]).max() > 0.0),
}


VERIFIERS: dict[str, Callable[[Match, Observed], str]] = {
    SENTENCES["chatter of a contact"]: _chatters,
    SENTENCES["chatter of a stop"]: _chatters,
    SENTENCES["pulls"]: _pulls,
    SENTENCES["pulls between"]: _pulls_between,
    SENTENCES["never touches"]: _never_touches,
    SENTENCES["never pressed"]: _never_pressed,
    SENTENCES["reversed"]: _reversed,
    SENTENCES["friction gives"]: _friction_gives,
    SENTENCES["at limit"]: _at_limit,
    SENTENCES["passes limit"]: _passes_limit,
    SENTENCES["does not close"]: _does_not_close,
    SENTENCES["drifted"]: _drifted,
    SENTENCES["scheme"]: _scheme,
    SENTENCES["gains"]: _gains,
    SENTENCES["sinks"]: _sinks,
    SENTENCES["compressed"]: _compressed,
    SENTENCES["passes through"]: _passes_through,
    SENTENCES["shared with dry friction"]: _shared,
    SENTENCES["shared by joints"]: _shared_by_joints,
    SENTENCES["shared"]: _shared,
    SENTENCES["below"]: _below,
    SENTENCES["reference beyond"]: _reference_beyond,
    SENTENCES["overloaded"]: _overloaded,
    SENTENCES["tips at the start"]: _tips,
    SENTENCES["tips"]: _tips,
    SENTENCES["lifted"]: _lifted,
    SENTENCES["would slip"]: _would_slip,
    SENTENCES["left out"]: _left_out,
    SENTENCES["jumps"]: _jumps,
    SENTENCES["unstable"]: _unstable,
    SENTENCES["unpressed"]: _unpressed,
    SENTENCES["leaves in impact"]: _leaves_in_impact,
    SENTENCES["wedged"]: _wedged,
    SENTENCES["moved at the start"]: _moved_at_the_start,
    SENTENCES["moves at once"]: _moves_at_once,
    SENTENCES["slips at once"]: _slips_at_once,
    SENTENCES["off target"]: _off_target,
    SENTENCES["off path"]: _off_path,
    SENTENCES["not carried out"]: _not_carried_out,
}
"""Pattern of each warning and its check: the groups and what the run shows → why it is not so, empty if it is."""
