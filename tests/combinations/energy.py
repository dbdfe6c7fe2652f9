"""Checks of energies on records: stored energies, the ledger as defined in docs/theory/energy.md, losses and heat."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from combinations.newton import integral_error, jumps_at_ticks
from combinations.observed import OPEN, STICKING, Observed, warned, whole_steps
from combinations.sentences import FRICTION_GIVES, LEDGER
from dynsim.model.drives import Motor, Servo, TorqueSource

Array = NDArray[np.float64]
Finding = Iterator[str]

# Share of the turnover above which a ledger must warn.
RESIDUAL = 1e-6
# Total error of ten landings, each located to 1e-13 m (docs/theory/energy.md) [m].
LANDINGS_M = 1e-12
# Rate of a joint at rest that time stepping leaves as rounding [rad/s or m/s].
RATE_ROUNDING = 1e-10


def ledger(seen: Observed) -> Finding:
    """Check that stored energies agree with the bodies, and that the ledger closes or a warning reports it."""
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
        # Samples coincide with the ends of steps only if the steps are whole.
        if off.max() > 1e-8 * scale + 1e-12:
            i = int(off.argmax())
            yield f"{name} at t = {seen.time[i]:.6g} s is {record[name][i]:.9g} J, of the bodies {values[i]:.9g} J"
    turnover, residual = turnover_and_residual(seen)
    floor = residual_floor(seen)
    relative = residual / max(turnover, floor) if max(turnover, floor) > 0.0 else 0.0
    reported = float(record.summary["energy_residual_relative"])
    if abs(relative - reported) > 0.01 * max(relative, reported) + 1e-12:
        yield f"the residual is {relative:.3e} of the turnover by the signals, {reported:.3e} in the summary"
    if relative > RESIDUAL and not warned(seen, LEDGER):
        yield f"the ledger does not close: {relative:.3e} of the turnover, without a warning"


def losses(seen: Observed) -> Finding:
    """Check that losses never decrease."""
    turnover, _ = turnover_and_residual(seen)
    names = ["heat_joule", "loss_joint", "loss_gear"]
    restitution = any(touch.contact.restitution > 0.0 for touch in seen.touches())
    signed = any(touch.contact.pulling_friction == "signed" for touch in seen.touches()) and not seen.real
    if not signed:
        names += ["heat_friction"]
    taken = {name: seen.record[name] for name in names}
    if not restitution and not signed:
        # If contacts and stops share an impact, only the sum of their parts must be a loss. The energy that moves a
        # point out of its surface again is subtracted from the impact losses.
        parts = [seen.record[name] for name in ("loss_impact", "loss_stop") if name in seen.record]
        taken |= {"loss_impact + loss_stop": sum(parts, np.zeros(len(seen)))} if not seen.stepped else {}
    for name, loss in taken.items():
        fall = -np.diff(loss)
        # Rates of sticking points are solved to 1e-8 m/s only; dense output within a step is as accurate as the step.
        allowed = (1e-7 if seen.stepped else seen.scenario.integrator.rtol) * turnover + 1e-12
        if fall.size and fall.max() > allowed and not warned(seen, FRICTION_GIVES):
            yield f"{name} falls by {fall.max():.3g} J at t = {seen.time[int(fall.argmax()) + 1]:.6g} s"


def powers(seen: Observed) -> Finding:
    """Check that heat and losses are the integrals of the powers at the samples."""
    record, current = seen.record, seen.record["current"]
    heat = np.zeros(len(seen))
    for a, motor in enumerate(seen.robot.motors):
        if not isinstance(motor, TorqueSource):
            heat = heat + motor.resistance * current[:, a] ** 2
    rubbed, rubbed_before = np.zeros(len(seen)), np.zeros(len(seen))
    for touch in seen.touches():
        rubs = touch.mode != STICKING
        if seen.stepped and touch.contact.stiffness == 0.0:
            # The energy that a step with a landing removes is impact loss.
            rubs[1:] &= touch.mode[:-1] != OPEN
        rubbed = rubbed - np.where(rubs, (touch.tangential * touch.slip).sum(axis=1), 0.0)
        earlier = np.concatenate([touch.slip[:1], touch.slip[:-1]])
        rubbed_before = rubbed_before - np.where(rubs, (touch.tangential * earlier).sum(axis=1), 0.0)
    lost = (seen.bodies.damping * seen.v**2).sum(axis=1) - (seen.joint_signal("joint_friction") * seen.v).sum(axis=1)
    for motor in seen.robot.motors:
        if isinstance(motor, Servo) and motor.coulomb_friction > 0.0 and seen.smoothed(motor):
            rate = seen.v[:, seen.joints.index(motor.joint)]
            lost = lost + motor.coulomb_friction * rate**2 / np.hypot(rate, motor.coulomb_speed or 1e-2)
    drawn = (current * record["voltage"]).sum(axis=1)
    work = {
        "heat_joule": (record["heat_joule"], heat),
        "losses of gears and joints": (record["loss_gear"] + record["loss_joint"], lost),
        "heat_friction": (record["heat_friction"], rubbed),
        "energy_electrical": (record["energy_electrical"], drawn),
    }
    # This includes the ticks of a task-space controller, whose period has a different key.
    if jumps_at_ticks(seen) or seen.at_ticks.any():
        del work["energy_electrical"]
        if jumps_at_ticks(seen):
            # If samples are further apart than ticks, power may oscillate in between, and all samples have one phase.
            del work["heat_joule"], work["losses of gears and joints"], work["heat_friction"]
    turnover, _ = turnover_and_residual(seen)
    unlike = _unlike_trapezia(seen) if seen.stepped else {}
    for name, (total, power) in work.items():
        # The work of a step's impulse uses the mean of the rates at its ends.
        before = rubbed_before if name == "heat_friction" else np.concatenate([power[:1], power[:-1]])
        yield from _integrated(seen, name, total, (before, power), turnover, unlike.get(name))


def _unlike_trapezia(seen: Observed) -> dict[str, Array]:
    """Return the possible difference of power at the mean state of a step and mean power at its ends, (T,) [W].

    For products x y the difference is Δx Δy/4. If friction reverses within the step, its mean power is unknown.
    """
    before = seen.v - seen.step * seen.vdot
    turns = seen.v * before < 0.0
    joints = np.where(turns, np.abs(seen.joint_signal("joint_friction")) * (np.abs(seen.v) + np.abs(before)), 0.0)
    joints += 0.25 * seen.bodies.damping * (seen.v - before) ** 2
    # The rate of a joint that rests in the middle of a step is known to rounding only.
    joints += np.abs(seen.joint_signal("joint_friction")) * RATE_ROUNDING
    contacts = np.zeros(len(seen))
    for touch in seen.touches():
        slip, earlier = touch.slip, touch.slip_before
        size = np.linalg.norm(touch.tangential, axis=1)
        both = np.linalg.norm(slip, axis=1) + np.linalg.norm(earlier, axis=1)
        contacts = contacts + np.where((slip * earlier).sum(axis=1) < 0.0, size * both, 0.0)
        # The normal force of the step acts along the normal at its middle.
        turned = np.linalg.norm(np.diff(touch.normal, axis=0, prepend=touch.normal[:1]), axis=1)
        contacts = contacts + turned * np.abs(touch.normal_force) * np.linalg.norm(slip, axis=1)
        # The heat of a step is computed from the slip in its law.
        contacts = contacts + size * touch.lag
    current, voltage = (
        np.diff(seen.record[name], axis=0, prepend=seen.record[name][:1]) for name in ("current", "voltage")
    )
    resistance = np.array([getattr(motor, "resistance", 0.0) for motor in seen.robot.motors])
    return {
        "losses of gears and joints": joints.sum(axis=1),
        "heat_friction": contacts,
        "heat_joule": 0.25 * current**2 @ resistance,
        "energy_electrical": 0.25 * np.abs(current * voltage).sum(axis=1),
    }


def _integrated(
    seen: Observed, name: str, total: Array, powers: tuple[Array, Array], turnover: float, unlike: Array | None
) -> Finding:
    """Compare energies with integrals; ``powers``: at start and end of the step that ends at a sample, (T,) [W]."""
    earlier, power = powers
    if not seen.stepped:
        off, allowed, rows = integral_error(seen, total[:, None], power[:, None])
        allowed = allowed + 1e-5 * turnover
        rows = rows + 2
    else:
        rows = whole_steps(seen)
        h, now, before = seen.step, power[rows], earlier[rows]
        # Power at the mean state of a step lies between the powers at its ends; their difference bounds the error.
        off = np.abs(total[rows] - total[rows - 1] - 0.5 * h * (now + before))[:, None]
        allowed = 1.1 * h * np.abs(now - before) + 0.02 * h * (np.abs(now) + np.abs(before))
        allowed = (allowed + 1e-6 * turnover + 1e-15)[:, None]
        if unlike is not None:
            allowed = allowed + h * unlike[rows][:, None]
        off = np.where(seen.apart_from_events(2.0 * h)[rows, None], off, 0.0)
    if off.size and (off / allowed).max() > 1.0:
        k = int((off / allowed).argmax())
        yield (
            f"{name} until t = {seen.time[rows[k]]:.6g} s is {off[k, 0]:.3g} J off the integral over the samples "
            f"(allowed {allowed[k, 0]:.3g} J)"
        )


def residual_floor(seen: Observed) -> float:
    """Return the floor of the denominator of the relative residual, as in docs/theory/energy.md [J]."""
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
    return max(floor, mass * g * LANDINGS_M / RESIDUAL) if seen.real else floor


def turnover_and_residual(seen: Observed) -> tuple[float, float]:
    """Return the turnover of energy, and the largest imbalance of the signals [J]."""
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
