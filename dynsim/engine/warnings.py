"""Warnings of a dynamics run, each a sentence with location, number and fix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.clearance import Sinking, by_surface
from dynsim.compile.control import JointControl
from dynsim.compile.tables import START_TOLERANCE, JointStop, format_quantity
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.engine.force_indeterminacy import motion_spread, sharing, wedges
from dynsim.engine.overlaps import one_digit, passed_through, squeezed
from dynsim.engine.prepare import Prepared
from dynsim.engine.soundness import unstable_later, unstable_loop
from dynsim.engine.target_distance import off_target
from dynsim.errors import first_few
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.integrators.run import RATE_TOLERANCE
from dynsim.integrators.stepping import tables as kt
from dynsim.model.description import Contact, Robot
from dynsim.model.drives import Drive, Motor, Servo, TorqueSource
from dynsim.record import Record
from dynsim.record.measures import RESIDUAL_LIMIT, SHORT, TIP_OVER, least_loads, overturns_settled, percent
from dynsim.scenario import Scenario, build
from dynsim.scenario.between import idle_entries
from dynsim.scenario.effect import without_effect

DRIFT_LIMIT_M = 1e-9
# A joint acceleration above this at an equilibrium start is motion, not a rounding error [rad/s² or m/s²].
STARTS_MOVING = 1e-6
# Postures that differ by less than this are equal up to rounding errors [rad or m].
SAME_POSTURE = 1e-12
# If an equilibrium does not use the full friction, accelerations below this fraction of gravity are rounding errors of
# stiff contacts.
OF_WEIGHT = 1e-4
# Contact forces at the start count as different from the forces at rest if they differ by more than this, relative or
# in N.
DIFFERS = 1e-3
# Slip that starts before this time counts as slip at the start [s].
START_SLIP_TIME = 1e-3
# A joint with dry friction that is slower than this is at rest [rad/s or m/s].
AT_REST = 1e-9
# Negative friction heat below this fraction of the energy turnover, or this energy [J], is a rounding error.
FRICTION_ROUNDING, FRICTION_ROUNDING_J = 1e-12, 1e-10
# Limits in files are rounded: a joint that starts at 1.5707963 = 90° does not exceed it.
LIMIT_SLACK = 1e-6
# Relative distance from a current limit within which it counts as reached.
NEAR_LIMIT = 1e-3
NOT_ENFORCED = "this limit is not enforced"
# Limits above which time stepping causes a warning: energy that the steps remove or add, and energy change if
# everything happened half a step later, both as fractions of the energy turnover; depth of points below surfaces [m].
SCHEME_LIMIT = 1e-2
# Limit of the energy that steps add at compliant contacts. A spring that is first touched within a step stores more
# energy than it has absorbed.
GAIN_LIMIT = 1e-3
HALF_STEP_LIMIT = 2e-2
PENETRATION_LIMIT_M = 1e-3
MODEL_IT = "lower contacts.friction, or model the {} (contacts.stiffness_N_per_m with integrator.method: time_stepping)"


def warnings_of(
    record: Record,
    scenario: Scenario,
    prepared: Prepared,
    summary: dict[str, Any],
    scale: float,
    sunk: Sequence[Sinking],
    motors: Sequence[dict[str, Any]],
    begun: float = 0.0,
) -> list[str]:
    """Return all warnings of a run, each as one sentence.

    Parameters
    ----------
    record : Record
        Record of the run.
    scenario : Scenario
        Scenario of the run.
    prepared : Prepared
        Prepared run after its last step.
    summary : dict
        Entries of the summary so far.
    scale : float
        Energy turnover, but at least the resolution of the ledger [J].
    sunk : sequence of Sinking
        Bodies below surfaces.
    motors : sequence of dict
        Loads of the motors.
    begun : float, optional
        Start time of the run [s]; the samples of a ring buffer may start later.
    """
    robot = prepared.model.robot
    unstable = unstable_loop(scenario, prepared)
    growing = unstable_later(scenario, prepared, record) if unstable is None else unstable[0]
    warnings = [
        *([growing] if growing else []),
        *_contact_warnings(record, scenario, prepared, summary, begun),
        *_saturated(record, robot),
        *_passed_limits(record, robot, prepared.system.unilateral is not None),
        *_base_warnings(record, scenario, prepared, begun),
    ]
    if summary["energy_residual_relative"] > RESIDUAL_LIMIT:
        warnings.append(
            f"the energy ledger does not close: residual {summary['energy_residual_relative']:.1e} of the turnover; "
            "tighten integrator.rtol or the step"
        )
    compressed = squeezed(record, prepared)
    warnings += [*compressed, *passed_through(record, prepared)]
    if (stepping := summary.get("time_stepping")) is not None:
        warnings += [*capped(stepping), *coarse(stepping, scale, summary["contacts"], bool(compressed))]
    elif summary["constraint_drift_max_m"] > DRIFT_LIMIT_M:
        warnings.append(f"contacts drifted by {summary['constraint_drift_max_m']:.1e} m")
    warnings += _undetermined(record, prepared, stepping is not None)
    warnings += _not_unique(record, prepared, begun)
    warnings += _slipping_start(record, prepared) or _moving_start(record, prepared)
    warnings += _sunk(record, sunk)
    warnings += _beyond_stops(robot, prepared.stops, prepared.control)
    warnings += [*robot.notes, *without_effect(scenario, bool(robot.motors)), *idle_entries(scenario, robot)]
    warnings += _overloaded(motors)
    hand = getattr(scenario.config.controller, "hand", None)
    from_start = getattr(hand, "from_start", False)
    warnings += off_target(summary, float(record.time[-1]) if len(record) else 0.0, begun, from_start)
    return warnings if prepared.balance is None else [*warnings, *prepared.balance.warnings]


def _contact_warnings(
    record: Record, scenario: Scenario, prepared: Prepared, summary: dict[str, Any], begun: float
) -> list[str]:
    """Warn of chatter, contacts that pull, carry no load or oppose their force, and of friction that adds energy."""
    contacts, unilateral, warnings = prepared.contacts, prepared.system.unilateral, list[str]()
    units = {link.joint: link.units for link in prepared.model.robot.links}
    if unilateral is not None:
        for contact, tally in zip(contacts, unilateral.tally, strict=True):
            if tally[ku.CHATTERED]:
                warnings.append(
                    f"{contact.name}: chatter, more than {ke.MOST_EVENTS} contact events within {ke.WINDOW:g} s; "
                    f"lift-offs slower than {tally[ku.SETTLE]:.0e} m/s were suppressed"
                )
        warnings += [
            f"{stop.joint}: chatter, more than {ke.MOST_EVENTS} events of its stop within {ke.WINDOW:g} s; "
            f"rebounds slower than {row[ku.STOP_SETTLE]:.0e} {units[stop.joint][1]} were suppressed"
            for stop, row in zip(prepared.stops, unilateral.stop, strict=True)
            if row[ku.STOP_CHATTERED]
        ]
    for contact in summary["contacts"]:
        if contact["normal_force_min_N"] < 0.0 and unilateral is not None:
            warnings.append(
                f"{contact['name']}: pulls with up to {-contact['normal_force_min_N']:.3g} N within a step, in which "
                "a real contact would lift off and land again; reduce integrator.step_max_s"
            )
        elif contact["normal_force_min_N"] < 0.0:
            warnings.append(
                f"{contact['name']}: the {contact['surface']} pulls on this brace for "
                f"{percent(contact['pulling_fraction'])} of the run, with up to "
                f"{-contact['normal_force_min_N']:.3g} N; a real arm would lift off"
            )
    left_out = {contact.name for contact in contacts if contact.left_out} | prepared.behind_brakes.keys()
    warnings += build.left_out_warnings(scenario, contacts, prepared.behind_brakes)
    initial, columns = scenario.config.initial, record.labels["contact_gap"]
    placed = () if initial is None else initial.on_surface
    # A ring buffer does not contain the earlier samples.
    within = f" from t = {record.time[0]:.4g} s on" if len(record) and record.time[0] > begun else ""
    for contact in summary["contacts"]:
        name = contact["name"]
        # A contact that only bounces never counts as closed, and neither does a contact in a run that ends in its first
        # step.
        pressed = contact["closed_fraction"] > 0.0 or contact.get("bounces") or contact["normal_force_max_N"] > 0.0
        never = "gap_min_m" in contact and not pressed
        if never and name not in left_out:
            nearest = int(record["contact_gap"][:, columns.index(name)].argmin())
            time, surface = f"t = {record.time[nearest]:.4g} s", contact["surface"]
            if contact["gap_min_m"] <= build.START_TOLERANCE:
                warnings.append(
                    f"{name}: is on the {surface} at {time}, but is never pressed{within} and carries no load"
                )
                continue
            warnings.append(
                f"{name}: never touches the {surface}{within} and carries no load; smallest gap "
                f"{1e3 * contact['gap_min_m']:.3g} mm at {time}"
                f"{'' if name in placed else ' (use initial.on_surface to start on the surface)'}"
            )
    for k, (brace, since) in enumerate(zip(contacts, prepared.run.extremes[:, ki.LOCAL_SINCE], strict=True)):
        # The end of a rejected step explains a stop and is not part of the run. Without another brace the run stops.
        if since <= prepared.run.clock[ki.TIME] and _others_closed(record, k, since):
            warnings.append(
                f"{brace.name}: from t = {since:.4g} s on, its friction reverses the effect of its normal force "
                "(negative diagonal of J M⁻¹F, Painlevé's paradox at one contact); only the other braces hold it, and "
                "whether real braces do depends on their stiffness; lower contacts.friction or change the posture"
            )
    gained = -summary["friction_heat_J"]
    if gained > max(FRICTION_ROUNDING * summary["energy_turnover_J"], FRICTION_ROUNDING_J):
        text = f"friction has added {gained:.3g} J to the arm: "
        if unilateral is None:
            text += "f_t = μ f_n reverses when the normal force pulls "
            text += "(contacts.pulling_friction: dissipative uses μ |f_n|)"
        else:
            text += "an integration error; reduce integrator.step_s or tighten integrator.rtol"
        warnings.append(text)
    return warnings


def _saturated(record: Record, robot: Robot) -> list[str]:
    """Warn of motors at their limits of voltage, current or torque."""
    warnings = []
    units = {link.joint: link.units[3] for link in robot.links}
    limited = [
        (a, motor, limits) for a, motor in enumerate(robot.motors) for limits in _limits_of(motor, units[motor.joint])
    ]
    # Computing the maximum along contiguous samples takes a third of the time.
    peaks = {
        name: np.abs(record[name].T.copy()).max(axis=1, initial=0.0) for name in {limit[1] for *_, limit in limited}
    }
    for a, motor, (quantity, signal, limit, unit) in limited:
        # The current of a DC motor approaches its driver limit but does not reach it.
        reached = limit * (1.0 - NEAR_LIMIT) if isinstance(motor, Motor) and quantity == "current" else limit
        # A diverged run may contain NaN, which hides a peak.
        if not peaks[signal][a] < reached:
            saturated = np.abs(record[signal][:, a]) >= reached
            if isinstance(motor, Servo):
                # Without current, its voltage equals the back-EMF.
                saturated &= record["current"][:, a] != 0.0
            if saturated.mean() >= SHORT:
                warnings.append(
                    f"{motor.joint}: {quantity} at its limit of {limit:g} {unit} for "
                    f"{100 * saturated.mean():.1f} % of the run"
                )
    return warnings


def _limits_of(motor: Drive, unit: str) -> list[tuple[str, str, float, str]]:
    """Return the limits of a motor: the limited quantity, its signal, the limit and its unit.

    ``unit`` is the unit of the joint's torque or force.
    """
    if isinstance(motor, TorqueSource):
        return [("torque" if unit == "N m" else "force", "current", motor.torque_limit, unit)]
    limits = [("voltage", "voltage", motor.voltage_limit, "V")]
    if isinstance(motor, Servo) or np.isfinite(motor.current_limit):
        limits.append(("current", "current", motor.greatest_current, "A"))
    return limits


def _named(contacts: Sequence[Contact], chosen: NDArray[np.bool_], names: Sequence[str]) -> list[str]:
    """Return those of the names whose contacts are chosen, in the order of the contacts; ``chosen`` has shape (c,)."""
    return [contact.name for contact, own in zip(contacts, chosen, strict=True) if own and contact.name in names]


def _undetermined(record: Record, prepared: Prepared, stepped: bool) -> list[str]:
    """Warn of dependent contact rows: the forces, and with friction also the motion, are not unique."""
    run, system, contacts = prepared.run, prepared.system, prepared.contacts
    evaluations = int(prepared.workspace.counts[ka.DEPENDENT])
    if system.unilateral is not None:
        return _shared_forces(record, prepared, evaluations > 0, stepped)
    if not evaluations:
        return []
    warnings = [f"contact rows were linearly dependent in {evaluations} evaluations; the forces are a least-norm split"]
    spread = None
    if len(record) and any(contact.friction > 0.0 for contact in contacts):
        rows, units = len(record), [(link.joint, link.units[2]) for link in prepared.model.robot.links]
        spread = motion_spread(system, record.time, run.sample[:rows], units)
    if spread is not None:
        warnings.append(
            f"with friction, dependent contact rows also leave the motion undetermined: at t = {spread.time:.4g} s the "
            f"acceleration of {spread.joint} can be anywhere from {spread.low:.4g} to {spread.high:.4g} {spread.unit} "
            "for splits of the normal forces that keep their signs "
            f"(this run: {spread.taken:.4g}); remove braces until the remaining ones are independent"
        )
    return warnings


def _shared_forces(record: Record, prepared: Prepared, dependent: bool, stepped: bool) -> list[str]:
    """Warn of unilateral forces that the motion does not determine; if all points stick, the motion is unique.

    ``dependent`` is True if rows have depended on each other; ``stepped`` is True for time stepping, which does not
    detect dependent rows.
    """
    contacts, rests = prepared.contacts, _joints_at_rest(record, prepared)
    if not len(record) or not (dependent or stepped or rests.any()):
        return []
    touching, joints = sharing(prepared.model, contacts, record["q"], record["contact_mode"], rests)
    if joints and not touching:
        return [
            f"{first_few(joints)}: shared dry friction forces keep these coupled joints at rest; the motion does not "
            "determine these forces, and the recorded forces are only one solution"
        ]
    if not touching:
        return []
    modes, friction = record["contact_mode"], np.array([contact.friction > 0.0 for contact in contacts], dtype=bool)
    slides = (modes[rests.any(axis=1) if joints else slice(None)] == ka.SLIDING).any(axis=0) & friction
    sliding = _named(contacts, slides, touching)
    verb = "slides" if len(sliding) == 1 else "slide"
    motion = f"; while {first_few(sliding)} {verb}, other solutions may move differently" if sliding else ""
    if joints:
        # From sticking to open while dry friction keeps joints at rest.
        leaves = (modes[:-1] == ka.STICKING) & (modes[1:] == ka.OPEN) & rests[:-1].any(axis=1, keepdims=True)
        if not sliding and (leaving := _named(contacts, leaves.any(axis=0), touching)):
            leave = "leaves its surface" if len(leaving) == 1 else "leave their surfaces"
            motion = f"; when {first_few(leaving)} {leave}, other solutions may move differently"
        return [
            f"{first_few(touching)}: forces shared with the dry friction of {first_few(joints)}, which keeps these "
            "joints at rest; the motion does not determine them, and the recorded forces are only one solution"
            f"{motion}"
        ]
    if sliding:
        choice = "have the least norm" if stepped else "differ least from the forces at the last mode change"
        return [
            f"{', '.join(touching)}: the motion does not determine how load is shared{motion}; the recorded forces "
            f"{choice}"
        ]
    return [
        f"{', '.join(touching)}: the motion does not determine how load is shared, because the points stick; "
        "the recorded forces are the least-norm split within all friction cones"
    ]


def _others_closed(record: Record, k: int, since: float) -> bool:
    """Return whether a contact other than the k-th is closed at a sample from a time on, or at the last sample."""
    if "contact_mode" not in record:
        return len(record.labels["contact_gap"]) > 1
    first = min(int(np.searchsorted(record.time, since)), len(record) - 1)
    others = np.delete(record["contact_mode"][first:], k, axis=1)
    return bool((others != ka.OPEN).any())


def _not_unique(record: Record, prepared: Prepared, begun: float) -> list[str]:
    """Warn of contacts that the law lets stick, leave or wedge although it has another solution too."""
    # The fraction refers to the whole run, even with a ring buffer, because samples do not show the pressing forces.
    law, time, warnings = prepared.system.unilateral, float(prepared.run.clock[ki.TIME]) - begun, list[str]()
    if law is None:
        return warnings
    tallies = list(zip((contact.name for contact in prepared.contacts), law.tally, strict=True))
    shares = {name: min(tally[ku.UNPRESSED] / time, 1.0) for name, tally in tallies if time > 0.0}
    if stuck := [f"{name} ({percent(share)} of the run)" for name, share in shares.items() if share >= SHORT]:
        warnings.append(
            f"the motion is not unique: no load presses {first_few(stuck)}, held by forces within the friction cones; "
            "without these forces it would lift off, which also satisfies the contact law. This run keeps it closed, "
            f"as equally stiff supports would; {MODEL_IT.format('supports')}"
        )
    if left := [f"{name} ({tally[ku.OPEN_SINCE]:.6g} s)" for name, tally in tallies if tally[ku.OPEN_IMPACTS]]:
        warnings.append(
            "the motion is not unique: impacts of other points or joint stops, the first at the time in brackets, lift "
            f"{first_few(left)} off, although impulses within the friction cones could keep the contact closed "
            f"(wedged), which also satisfies the contact law; {MODEL_IT.format('supports')}"
        )
    wedged = [
        f"{wedge.contact.name} against {wedge.contact.surface_name} for coefficients of {wedge.least:.4g} or more "
        f"(here {wedge.friction:.4g}, t = {wedge.time:.6g} s)"
        for wedge in wedges(prepared.model, prepared.contacts, record)
    ]
    if wedged:
        warnings.append(
            f"the motion is not unique: friction alone can wedge {first_few(wedged)} without a load: no joint moves "
            "the point along some direction inside its friction cone, so a force of any size along it, or none, "
            f"satisfies the contact law; {MODEL_IT.format('surface')}"
        )
    return warnings


def _slipping_start(record: Record, prepared: Prepared) -> list[str]:
    """Warn of an equilibrium on the edge of the friction cones that slips at the start."""
    if prepared.balance is None or not prepared.balance.on_edge or not len(record) or record.time[0] != 0.0:
        return []
    if np.abs(record["vdot"][0]).max(initial=0.0) > STARTS_MOVING:
        slips = 0.0
    else:
        slips = min((event.time for event in record.events if event.kind == "slip_start"), default=np.inf)
    if slips > START_SLIP_TIME:
        return []
    return [
        f"initial.equilibrium: the start slips at t = {slips:.3g} s because this posture requires the full static "
        "friction; raise contacts.friction or change the posture"
    ]


def _moving_start(record: Record, prepared: Prepared) -> list[str]:
    """Warn if the run leaves the equilibrium immediately: for wedged points the contact law allows rest and motion."""
    balance, robot = prepared.balance, prepared.model.robot
    if balance is None or balance.warnings or not len(record) or record.time[0] != 0.0:
        return []
    # The run may have started from a different state. Quaternions have been normalised.
    there = np.allclose(record["q"][0], robot.initial, rtol=0.0, atol=SAME_POSTURE)
    # After a projection, rates are of the size of rounding errors.
    if not there or np.abs(record["v"][0]).max(initial=0.0) > RATE_TOLERANCE:
        return []
    size = np.abs(record["vdot"][0])
    if size.max(initial=0.0) <= OF_WEIGHT * (1.0 + float(np.linalg.norm(robot.gravity))):
        return []
    link, acceleration = robot.links[int(size.argmax())], float(record["vdot"][0][size.argmax()])
    names, touch = record.labels["contact_normal_force"], record["contact_normal_force"][0]
    other = [
        f"{name} {touch[names.index(name)]:.4g} N instead of {force:.4g} N"
        for name, force in balance.normal_forces.items()
        if abs(touch[names.index(name)] - force) > DIFFERS * (1.0 + abs(force))
    ]
    text = f"initial.equilibrium: {link.joint} nevertheless starts with {acceleration:.4g} {link.units[2]}"
    if other:
        text += (
            f", and contact forces differ from rest: {first_few(other)}; the contact law allows both, and the "
            "run follows the motion; remove one of these contacts, lower its friction, or change the posture"
        )
    return [text]


def _joints_at_rest(record: Record, prepared: Prepared) -> NDArray[np.bool_]:
    """Return whether dry friction keeps each joint at rest, (T, n)."""
    rests = np.zeros((len(record), prepared.model.n), dtype=bool)
    law = prepared.system.unilateral
    if law is not None and "joint_friction" in record:
        columns = [prepared.model.joint_names.index(joint) for joint in record.signals["joint_friction"].labels]
        rests[:, columns] = np.abs(record["v"][:, columns]) < AT_REST
        # If a brake holds a joint, its dry friction is zero.
        braked = law.dry_table[:, ku.DRY_BRAKE] != ku.NEVER_CLOSED
        rests[:, columns] &= ~braked | (record["joint_friction"] != 0.0)
    return rests


def _sunk(record: Record, sunk: Sequence[Sinking]) -> list[str]:
    """Warn once for each surface of the bodies below it in the samples, with the depth of the deepest body."""
    warnings = []
    for surface, below in by_surface(sunk).items():
        deepest = max(below, key=lambda s: s.depth)
        names = ", ".join(s.body for s in below)
        verb = "passes" if len(below) == 1 else "pass"
        # Bodies from URDF do not have a radius.
        thick = any(s.radius > 0.0 for s in below)
        beyond = " by more than the link's radius" if thick else ""
        radius = f" (radius {1e3 * deepest.radius:g} mm)" if thick else ""
        warnings.append(
            f"{names} {verb} below {surface}{beyond}: {deepest.body}{radius} by up to {1e3 * deepest.depth:.3g} mm in "
            f"the samples, first at t = {record.time[min(s.sample for s in below)]:.4g} s; "
            "only contact points interact with surfaces"
        )
    return warnings


def _passed_limits(record: Record, robot: Robot, real: bool) -> list[str]:
    """Warn of joint limits that samples of the record exceed.

    Only stops are enforced, and only under the unilateral law (``real``). Under this law only time stepping lets joints
    pass their stops, by up to one step of motion at a hit, and then moves them back.
    """
    torque = dict(zip(record.labels["torque"], record["torque"].T, strict=True))
    warnings = []
    for link, k, v in zip(robot.links, robot.position_index, record["v"].T, strict=True):
        if all(abs(bound) == np.inf for bound in (link.lower, link.upper, link.velocity_limit, link.effort_limit)):
            continue
        q = record["q"][:, k]
        position, velocity, _, force = link.units
        if not len(q):
            continue
        below, above, effort = link.lower - q, q - link.upper, np.abs(torque.get(link.joint, np.zeros_like(q)))
        for quantity, limit, unit, beyond, note in (
            ("lower position", link.lower, position, below, _after_passing(below[-1], position, real)),
            ("upper position", link.upper, position, above, _after_passing(above[-1], position, real)),
            ("velocity", link.velocity_limit, velocity, np.abs(v) - link.velocity_limit, NOT_ENFORCED),
            ("effort", link.effort_limit, force, effort - link.effort_limit, NOT_ENFORCED),
        ):
            over = np.flatnonzero(beyond > LIMIT_SLACK)
            if over.size:
                amount, first = beyond[over].max(), record.time[over[0]]
                warnings.append(
                    f"{link.joint}: exceeds its {quantity} limit of {format_quantity(limit, unit, 4)} by up to "
                    f"{format_quantity(amount, unit, 3)}, first at t = {first:.4g} s; {note}"
                )
    return warnings


def _after_passing(left: float, unit: str, real: bool) -> str:
    """Return consequence and fix for a joint that passed its stop and is ``left`` beyond it at the end [rad or m]."""
    if not real:
        return "joint stops require contacts.law: unilateral"
    if left > LIMIT_SLACK:
        end = f"it is still {format_quantity(left, unit, 3)} beyond its stop at the end"
    else:
        end = "time stepping has moved it back to its stop"
    return f"{end}; reduce integrator.step_s to reduce the overshoot"


def _beyond_stops(robot: Robot, stops: Sequence[JointStop], control: JointControl) -> list[str]:
    """Warn of references beyond a joint stop: the controller pushes against the stop and cannot reach the reference."""
    follows = {motor.joint: bool(k_p > 0.0) for motor, k_p in zip(robot.motors, control.k_p, strict=True)}
    places = dict(zip(robot.joint_names, robot.position_index, strict=True))
    units = {link.joint: link.units[0] for link in robot.links}
    watched = [stop for stop in stops if follows.get(stop.joint, False)]
    if not watched or not np.isfinite(control.end):
        return []
    worst: dict[JointStop, tuple[float, float]] = {}
    first: dict[JointStop, float] = {}
    for times, q in control.positions(robot):
        for stop in watched:
            beyond = stop.side * (stop.position - q[:, places[stop.joint]])
            k = int(beyond.argmax())
            if beyond[k] > START_TOLERANCE:
                first.setdefault(stop, float(times[beyond > START_TOLERANCE][0]))
                worst[stop] = max(worst.get(stop, (0.0, 0.0)), (float(beyond[k]), float(times[k])))
    return [
        f"{stop.joint}: its reference exceeds its stop at {format_quantity(stop.position, units[stop.joint])} by "
        f"up to {format_quantity(most, units[stop.joint])}, first at t = {first[stop]:.4g} s, most at t = {time:.4g} "
        "s; the motor pushes against the stop and cannot follow its path; change the path or the limit"
        for stop, (most, time) in worst.items()
    ]


def coarse(
    stepping: dict[str, Any], scale: float, contacts: Sequence[dict[str, Any]] = (), squeezed: bool = False
) -> list[str]:
    """Warn of steps that are too long, and suggest a shorter step.

    Such steps remove or add too much energy, leave the energy uncertain, or let points sink in too far. ``scale`` is
    the energy turnover [J], but at least the resolution of the ledger; it is zero before the first motion. ``contacts``
    are the contacts of the summary; the deepest one is named. If edges are ``squeezed`` beyond their rounding, shorter
    steps do not improve the energy.
    """
    step, worst, deepest = stepping["step_s"], stepping["scheme_loss_worst_J"], stepping["penetration_max_m"]
    # This value is missing for a ring buffer.
    blurred = stepping.get("half_step_energy_J", 0.0)
    # This value exists only with compliant contacts or ties.
    made = stepping.get("scheme_gain_J", 0.0)
    warnings: list[str] = []

    def warn(text: str, shorter: float, helps: bool = not squeezed) -> None:
        fix = f"integrator.step_s is {step:g}: use {one_digit(shorter):g}"
        if not helps:
            fix = "smaller steps do not help; increase the stiffness of the compressed edges"
        warnings.append(f"time stepping: {text}; {fix}")

    def part(energy: float, limit: float) -> str:
        return f"{energy:.3g} J{{}}, {100 * energy / scale:.2g} % of the turnover (limit {100 * limit:g} %)"

    if scale > 0.0 and made > GAIN_LIMIT * scale:
        text = part(made, GAIN_LIMIT).format(" to compliant contacts or ties")
        warn(f"the steps themselves add {text}", _resolving(stepping, made / scale))
    # Energy added by the steps is reported only once.
    another = worst > 0.0 or made <= GAIN_LIMIT * scale
    if scale > 0.0 and another and abs(worst) > SCHEME_LIMIT * scale:
        text = f"{'removed' if worst > 0.0 else 'added'} up to {part(abs(worst), SCHEME_LIMIT).format('')}"
        warn(f"the steps themselves {text}", step * SCHEME_LIMIT * scale / abs(worst))
    if scale > 0.0 and blurred > HALF_STEP_LIMIT * scale:
        text = f"the energy is known only to {part(blurred, HALF_STEP_LIMIT).format('')}"
        text += ", the change if everything happened half a step later"
        warn(f"the power changes so fast that {text}", step * HALF_STEP_LIMIT * scale / blurred)
    if deepest > PENETRATION_LIMIT_M:
        text = f"points sink up to {1e3 * deepest:.3g} mm into their surfaces as they land"
        name = max(contacts, key=lambda contact: contact["penetration_max_m"])["name"] if contacts else ""
        limit = f"{name and f'{name}; '}limit {1e3 * PENETRATION_LIMIT_M:g} mm"
        warn(f"{text} ({limit})", step * PENETRATION_LIMIT_M / deepest, helps=True)
    return warnings


def _resolving(stepping: dict[str, Any], share: float) -> float:
    """Return a step with which landings on springs add less than GAIN_LIMIT of the energy; so far they add ``share``.

    A step applies the full spring force if its midpoint is in contact, and no force otherwise. This adds up to z/4, and
    on average z/12, of the kinetic energy of a landing, depending on the position within the step, z = (ω h)². With z =
    GAIN_LIMIT, four landings at worst, and twelve on average, stay within the limit. The share of a single run is not a
    reliable measure, because it depends on these positions and follows no power of z for z > 1.
    """
    step, pulsation = float(stepping["step_s"]), stepping["spring_rate_rad_per_s"]
    # The share includes energy added by other effects, which are of the method's order or of first order.
    if pulsation == 0.0:  # ties with dampers only
        return step * GAIN_LIMIT / share
    return float(min(GAIN_LIMIT**0.5 / pulsation, step * (GAIN_LIMIT / share) ** 0.5))


def capped(stepping: dict[str, Any]) -> list[str]:
    """Warn of unsolved contact problems; penetration is not counted as drift, because it shrinks with the step."""
    if not stepping["capped_solves"]:
        return []
    return [
        f"time stepping: {stepping['capped_solves']} of {stepping['contact_solves']} contact problems were abandoned "
        f"with a residual above {kt.BAD:g} m/s (maximum {stepping['residual_max_m_s']:.1e} m/s); their forces violate "
        "Coulomb's law slightly; reduce integrator.step_s"
    ]


def _base_warnings(record: Record, scenario: Scenario, prepared: Prepared, begun: float) -> list[str]:
    """Warn of behaviour that is impossible for a real mobile base."""
    base, run, settle = prepared.model.robot.base, prepared.run, scenario.metrics.settle_s
    if base is None:
        return []
    warnings = []
    load, traction = record["wheel_load"], record["traction_demand"]
    lowest = least_loads(record, run.support.least)
    late = record["tip_margin"][record.time >= settle]
    first = min((event.time for event in record.events if event.kind == TIP_OVER), default=np.inf)
    # The samples of a ring buffer may start after the base has tipped.
    tipped = len(record) > 0 and record.time[0] > begun and record["tip_margin"][0] < 0.0
    if tipped:
        first = float(record.time[0])
    tips = "is tipped over" if tipped else "tips over"
    if np.isfinite(first) and not base.stop_on_overturn:
        pulled = ", ".join(
            f"{name} {low:.3g}" for name, low in zip(record.labels["wheel_load"], lowest, strict=True) if low < 0.0
        )
        least = f" (least loads [N]: {pulled})" if pulled else ""
        share = float((record["tip_margin"] < 0.0).mean())
        beyond = f"in {percent(share)} of the samples" if share > 0.0 else "between two samples"
        if late.size and overturns_settled(record, settle) is None:
            warnings.append(
                f"a jolt at the start drives the tip margin below zero at t = {first:.4f} s, {beyond}, but none "
                f"from {settle:g} s on (margin at least {late.min():.3g}){least}; use initial.equilibrium, or start "
                "the motion at rest"
            )
        else:
            warnings.append(
                f"the base {tips} at t = {first:.4f} s, with a tip margin below zero {beyond}; the run continues "
                f"as if the base were held down{least}; use plant.base.on_overturn: stop to end it there"
            )
    lifted = load.sum(axis=1) <= 0.0
    if lifted.any():
        warnings.append(
            f"the base is lifted: its wheels and caster carry no load in {percent(lifted.mean())} of the samples, "
            f"first at t = {record.time[lifted.argmax()]:.4g} s (counts as a tip margin of -1)"
        )
    # After the base has tipped, the loads are meaningless.
    standing = record.time < first
    for name, demand in zip(record.labels["traction_demand"], traction[standing].T, strict=True):
        slips = demand > 1.0
        if slips.any():
            warnings.append(
                f"the {name} wheel would slip: it requires up to {np.nanmax(demand):.3g} times the traction that "
                f"plant.base.wheel_friction = {base.wheel_friction:g} provides, first at "
                f"t = {record.time[standing][slips.argmax()]:.4g} s; the simulation enforces rolling anyway"
            )
    return warnings


def _overloaded(loads: Sequence[dict[str, Any]]) -> list[str]:
    """Warn of motors whose root mean square load exceeds the nominal value, the most loaded motor first."""
    warnings = []
    for label, quantity, unit in (("current", "current", "A"), ("torque", "torque", "N_m"), ("force", "force", "N")):
        over = []
        for load in loads:
            rms, nominal = load.get(f"{quantity}_rms_{unit}"), load.get(f"nominal_{quantity}_{unit}")
            if rms is not None and nominal is not None and rms > nominal:
                over.append((rms / nominal, f"{load['joint']} {rms:.3g} of {nominal:g} {unit.replace('_', ' ')}"))
        if over:
            texts = [text for _, text in sorted(over, key=lambda entry: -entry[0])]
            warnings.append(
                f"{', '.join(texts)}: the rms {label} of the run exceeds the nominal {label}; a real motor would "
                "overheat: brace the arm, slow down, or use a larger motor"
            )
    return warnings
