"""Engine of the multibody plants: integrate the coupled system and collect its record."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dynsim import interruption, metrics
from dynsim.engine import REFERENCES, SIMULATION, Progress, Start
from dynsim.engine.outcome import check_size, kernels_logged, raise_stopped
from dynsim.engine.provenance import provenance
from dynsim.engine.uniqueness import motion_spread, paradox
from dynsim.errors import ModelError, ScenarioError, SimulationInterrupted, SimulationStopped
from dynsim.kernels import arrays as ka
from dynsim.kernels.integrate import driver
from dynsim.kernels.integrate import run as ki
from dynsim.kernels.state import (
    CONTACT_SIZE,
    IMPULSE,
    OUT_FORCE,
    OUT_GAP,
    OUT_SLIP,
    OUT_VECTOR,
    SLIP,
    block,
    output_layout,
    state_layout,
)
from dynsim.kernels.system import System, new_workspace
from dynsim.model.arrays import compile_contacts, compile_couplings, compile_drives
from dynsim.model.clearance import poses
from dynsim.model.control import JointControl
from dynsim.model.description import Array, Contact, Link, Robot
from dynsim.model.model import Model
from dynsim.record import Record
from dynsim.scenario import Scenario, build_model

log = logging.getLogger(__name__)

# Wall time between two looks at progress and Ctrl-C [s].
_CHUNK_S = 0.1
# Steps that an explicit method may be held to by the electrical poles alone: a quarter of an hour for ten joints.
STEPS_LIMIT = 2e8


@dataclass(frozen=True)
class Prepared:
    """A scenario compiled to kernel arrays, at its initial state."""

    model: Model
    contacts: list[Contact]
    control: JointControl
    system: System
    run: ki.Run
    workspace: ka.Workspace


def prepare(scenario: Scenario, progress: Progress | None = None) -> Prepared:
    """Compile a scenario; references that take long report to ``progress``.

    Raises
    ------
    ModelError, UnreachableReference
        See :func:`dynsim.engine.simulate`.
    ScenarioError
        The record would be larger than ``record.size_limit_GB``, or the explicit method would need too many steps.
    """
    model = build_model(scenario)
    robot, contacts = model.robot, scenario.contacts()
    scenario.check_start(model)
    n, na, c, couplings = model.n, len(robot.motors), len(contacts), len(robot.couplings)
    layout, columns = state_layout(n, n, na, c), output_layout(n, na, c)
    times = _sample_times(scenario, columns=layout.size + columns.size)
    _check_stiffness(scenario, robot)
    _check_work(scenario, n, c + couplings)
    control = _control(scenario, model, progress)
    _check_references(scenario, robot, contacts, control)
    options = scenario.integrator
    method = ki.METHODS[options.method]
    step = options.step_s or (1e-3 if method == ki.RK4 else 0.0)
    size = n + ka.row_limit(c, couplings) + na
    system = System(
        layout=layout,
        model=model.arrays,
        drives=compile_drives(robot, k_p=list(control.k_p), k_d=list(control.k_d)),
        reference=control.reference,
        contacts=compile_contacts(robot, contacts),
        dense=np.zeros((size, size + 1)) if options.solver == "m_star" else None,
        couplings=compile_couplings(robot),
    )
    y = np.zeros(layout.size)
    y[block(layout, "q")] = robot.initial
    run = ki.new_run(
        method,
        y,
        layout,
        columns,
        n=n,
        na=na,
        c=c,
        couplings=couplings,
        sample_time=times,
        hand=(model.body_index(robot.hand[0]), robot.hand[1]),
        end=scenario.duration_s,
        step=step,
        step_max=options.step_max_s or np.inf,
        rtol=options.rtol,
        atol=options.atol,
    )
    return Prepared(model, contacts, control, system, run, new_workspace(system))


def start(prepared: Prepared) -> Start:
    """Positions of the hand and of the contact points at t = 0."""
    model, q = prepared.model, prepared.model.robot.initial
    contacts = {contact.name: model.point_position(contact.body, contact.point, q) for contact in prepared.contacts}
    return Start(model.point_position(*model.robot.hand, q), contacts)


def simulate(scenario: Scenario, progress: Progress | None = None) -> Record:
    """See :func:`dynsim.engine.simulate`."""
    prepared = prepare(scenario, progress)
    run = prepared.run
    # Loading or compiling the kernels is no integration time.
    with kernels_logged(log):
        driver.advance(prepared.system, prepared.workspace, run, 0)
    if progress is not None:
        progress(0.0, SIMULATION)
    started, limit, interrupted = clock.perf_counter(), 1, False
    try:
        log.info("%s: integrating %g s by %s", scenario.title, scenario.duration_s, scenario.integrator.method)
        while run.count[ki.STATUS] == ki.RUNNING:
            before = clock.perf_counter()
            driver.advance(prepared.system, prepared.workspace, run, limit)
            taken = clock.perf_counter() - before
            limit = int(min(max(limit * min(_CHUNK_S / max(taken, 1e-9), 10.0), 1), 1_000_000))
            if progress is not None:
                progress(float(run.clock[ki.TIME]), SIMULATION)
            interruption.check()
        interruption.keep()
    except KeyboardInterrupt:
        interruption.keep()
        interruption.answered()
        interrupted = True
    wall = clock.perf_counter() - started
    log.info("%s: integrated %g s in %d steps, %.3f s", scenario.title, run.clock[ki.TIME], run.count[ki.STEPS], wall)
    record = _record(scenario, prepared, wall)
    status, reached = int(run.count[ki.STATUS]), float(run.clock[ki.TIME])
    if interrupted or status != ki.FINISHED:
        if interrupted:
            stop: SimulationStopped = SimulationInterrupted(
                f"interrupted at t = {reached:.3f} s of {scenario.duration_s:g} s",
                time=reached,
                state=_last_state(prepared, run.y),
            )
        elif found := paradox(prepared.system, prepared.workspace, run, prepared.contacts):
            reached, y, words = found
            if scenario.integrator.method == "rk4":
                words += "; a shorter integrator.step_s or an adaptive method (rk43) tells whether the step is to blame"
            stop = SimulationStopped(
                f"stopped at t = {reached:.6g} s: {words}", time=reached, state=_last_state(prepared, y)
            )
        else:
            stop = SimulationStopped(
                _reason(status, scenario, prepared), time=reached, state=_last_state(prepared, run.y)
            )
        raise_stopped(stop, record)
    return record


def _sample_times(scenario: Scenario, columns: int) -> np.ndarray:
    rate = scenario.record.rate_hz
    count = int(np.floor(scenario.duration_s * rate * (1.0 + 1e-12))) + 1
    check_size(scenario, count, columns)
    times = np.arange(count) / rate
    if scenario.duration_s - times[-1] > 1e-9 * scenario.duration_s:
        times = np.append(times, scenario.duration_s)
    return times


def _check_stiffness(scenario: Scenario, robot: Robot) -> None:
    """Refuse an explicit method where the circuits' own poles R/L already ask for too many steps."""
    method, duration = scenario.integrator.method, scenario.duration_s
    if method not in ("rk43", "dopri5") or not robot.motors:
        return
    motor = max(robot.motors, key=lambda motor: motor.resistance / motor.inductance)
    pole = motor.resistance / motor.inductance
    # Explicit methods of these orders are stable up to |h pole| of about 3.
    steps = duration * pole / 3.0
    if steps > STEPS_LIMIT:
        raise ScenarioError(
            f"{motor.joint}: R/L = {pole:.2g} 1/s holds integrator.method {method} to about {steps:.1g} steps for "
            f"{duration:g} s; take integrator.method: rodas4, or a larger inductance than {motor.inductance:g} H"
        )


def _check_work(scenario: Scenario, n: int, p: int) -> None:
    """Refuse what would integrate for longer than ``integrator.time_limit_h``, by an estimate from its size."""
    options = scenario.integrator
    # Measured from 10 to 1000 links with up to 250 contacts, right to a factor of two: the sweeps, the p × p system of
    # chains as long as n, its elimination, and the decomposition that dependent rows need (p > n always are).
    seconds = 1e-7 * n + 4e-10 * n * p**2 + (8e-8 if p > n else 2e-10) * p**3
    if options.solver == "m_star":
        seconds += 3e-10 * (n + p) ** 3
    # A Jacobian by differences, and its factors.
    per_step = (2 * n + 6) * seconds + 3e-10 * n**3 if options.method == "rodas4" else 4.0 * seconds
    # Motors and friction hold the step at about a millisecond.
    steps = scenario.duration_s / (options.step_s if options.step_s and options.method == "rk4" else 1e-3)
    hours = steps * per_step / 3600.0
    if hours > options.time_limit_h:
        raise ScenarioError(
            f"{n} joints with {p} contacts: a right-hand side takes about {seconds:.1g} s, so "
            f"{scenario.duration_s:g} s would integrate for about {hours:.2g} hours, the limit "
            f"(integrator.time_limit_h) is {options.time_limit_h:g}; "
            "take fewer contacts or links, a shorter duration_s, or a higher limit"
        )


def _control(scenario: Scenario, model: Model, progress: Progress | None) -> JointControl:
    if scenario.controller is None:
        return JointControl.short_circuit(len(model.robot.motors))
    log.info("%s: planning references over %g s", scenario.title, scenario.duration_s)
    started = clock.perf_counter()
    control = scenario.build_controller(model, None if progress is None else partial(progress, stage=REFERENCES))
    log.info("%s: planned references in %.3f s", scenario.title, clock.perf_counter() - started)
    if not isinstance(control, JointControl):
        raise ModelError(f"controller {scenario.controller.type!r} cannot drive a {scenario.plant.type!r}")
    return control


def _check_references(scenario: Scenario, robot: Robot, contacts: Sequence[Contact], control: JointControl) -> None:
    """Refuse references that, followed exactly, would take a contact point off the surface that holds it."""
    links = {link.name: link for link in robot.links}
    motor_of = {motor.joint: a for a, motor in enumerate(robot.motors)}
    held: dict[str, list[tuple[Contact, Array]]] = {}
    for contact in contacts:
        index, point = robot.attach(contact.body, contact.point)
        carrier = body = robot.links[index].name
        chain = []
        while True:
            chain.append(motor_of.get(links[body].joint, -1))
            parent = links[body].parent
            if parent is None:
                break
            body = parent
        # A joint that follows nothing gives way, so the references do not say where the point is. Where no reference
        # moves, the point stays where it starts, which has its own check.
        follows = all(a >= 0 and control.k_p[a] > 0.0 for a in chain)
        if follows and any(control.reference.spline[a] >= 0 for a in chain):
            held.setdefault(carrier, []).append((contact, point))
    if not held:
        return
    tolerance = scenario.config.contacts.reference_tolerance_m
    joints = {link.joint: i for i, link in enumerate(robot.links)}
    driven = np.array([joints[motor.joint] for motor in robot.motors])
    worst: dict[str, tuple[float, float, np.ndarray]] = {}
    first: dict[str, float] = {}
    for times, q in control.positions(robot.initial, driven):
        for link, R, p in poses(robot, q, held):
            for contact, point in held.get(link.name, ()):
                position = (p + point @ R).T
                gap = contact.surface.gaps(position)
                k = int(np.abs(gap).argmax())
                if abs(gap[k]) > tolerance:
                    first.setdefault(contact.name, float(times[np.abs(gap) > tolerance][0]))
                    if abs(gap[k]) > abs(worst.get(contact.name, (0.0,))[0]):
                        worst[contact.name] = float(gap[k]), float(times[k]), position[k]
    if not worst:
        return
    name, (gap_max, time, place) = max(worst.items(), key=lambda item: abs(item[1][0]))
    surface = next(contact.surface_name for contact in contacts if contact.name == name)
    others = ", ".join(other for other in worst if other != name)
    raise ModelError(
        f"contact {name}: the references of the joints take its point {gap_max:+.4g} m off surface {surface!r} at "
        f"t = {time:.3f} s, at ({place[0]:.4g}, {place[1]:.4g}, {place[2]:.4g}) m, and beyond "
        f"contacts.reference_tolerance_m = {tolerance:g} m from t = {first[name]:.3f} s on"
        f"{f' (also {others})' if others else ''}; "
        "let the joints before the contact hold, change their path, or disable the contact"
    )


def _record(scenario: Scenario, prepared: Prepared, wall: float) -> Record:
    """Name the columns that the kernels have written."""
    model, run, contacts = prepared.model, prepared.run, prepared.contacts
    robot = model.robot
    rows = int(run.count[ki.SAMPLE])
    joints, driven = robot.joint_names, tuple(motor.joint for motor in robot.motors)
    names = tuple(contact.name for contact in contacts)
    record = Record(run.sample_time[:rows], provenance=provenance(scenario))
    angle, rate, acceleration, _ = _joint_units(robot.links)
    with_motor = set(driven)
    *_, force = _joint_units([link for link in robot.links if link.joint in with_motor] or robot.links)
    record.add("q", run.states("q"), angle, labels=joints, description="joint positions")
    record.add("v", run.states("v"), rate, labels=joints, description="joint rates")
    record.add("vdot", run.outputs("vdot"), acceleration, labels=joints, description="joint accelerations")
    current, voltage = run.outputs("current"), run.outputs("voltage")
    record.add("current", current, "A", labels=driven, description="motor currents")
    record.add("voltage", voltage, "V", labels=driven, description="motor terminal voltages")
    record.add("torque", run.outputs("torque"), force, labels=driven, description="shaft torques, [WM] eq 25")
    record.add("power", current * voltage, "W", labels=driven, description="electrical power u i")
    record.add("hand_position", run.outputs("hand"), "m", labels=("x", "y", "z"))
    target = prepared.control.target(record.time)
    if target is not None:
        record.add("target_position", target, "m", labels=("x", "y", "z"))
    for integral, (name, text) in zip(run.states("ledger").T, metrics.INTEGRALS.items(), strict=True):
        record.add(name, integral, "J", description=text)
    for store, name in zip(run.outputs("energy").T, metrics.STORES, strict=True):
        record.add(name, store, "J", description=f"{name.removeprefix('energy_')} energy")
    record.add("energy_residual", metrics.energy_residual(record), "J", description="what the ledger does not explain")
    touch = run.outputs("contact")
    vector, slip = slice(OUT_VECTOR, OUT_VECTOR + 3), slice(OUT_SLIP, OUT_SLIP + 3)
    record.add("contact_normal_force", touch[:, :, OUT_FORCE], "N", labels=names, description="f_n; negative: pulling")
    record.add("contact_force", touch[:, :, vector], "N", labels=names, description="normal and friction force, W")
    record.add("contact_gap", touch[:, :, OUT_GAP], "m", labels=names, description="distance from the surface")
    record.add("contact_slip_velocity", touch[:, :, slip], "m/s", labels=names)
    integrals = run.states("contact").reshape(rows, len(contacts), CONTACT_SIZE)
    record.add("contact_impulse", integrals[:, :, IMPULSE], "N s", labels=names, description="∫ f_n dt")
    record.add("contact_slip_distance", integrals[:, :, SLIP], "m", labels=names, description="∫ |v_t| dt")
    deficient, spread = int(prepared.workspace.counts[ka.DEPENDENT]), None
    if deficient and rows and any(contact.friction > 0.0 for contact in contacts):
        joint_units = [(link.joint, link.units[2]) for link in robot.links]
        spread = motion_spread(prepared.system, run.sample_time[:rows], run.sample[:rows], joint_units)
    counts = metrics.Counts(
        wall=wall,
        steps=int(run.count[ki.STEPS]),
        rejected=int(run.count[ki.REJECTED]),
        evaluations=int(run.count[ki.EVALUATIONS]),
        projections=int(run.count[ki.PROJECTIONS]),
        deficient=deficient,
        extremes=run.extremes,
        spread=spread,
    )
    record.summary = metrics.summarise(record, scenario, contacts, robot, counts)
    return record


def _joint_units(links: Iterable[Link]) -> Sequence[str]:
    """Units of position, velocity, acceleration and force of joints; "rad or m" when there are both kinds."""
    units = sorted({link.units for link in links}, reverse=True)
    return [" or ".join(kinds) for kinds in zip(*units, strict=True)]


def _last_state(prepared: Prepared, y: np.ndarray) -> dict[str, Sequence[float]]:
    return {name: y[block(prepared.system.layout, name)].tolist() for name in ("q", "v", "current")}


def _reason(status: int, scenario: Scenario, prepared: Prepared) -> str:
    run = prepared.run
    t, method = float(run.clock[ki.TIME]), scenario.integrator.method
    where = f"stopped at t = {t:.6g} s"
    if status == ki.NOT_FINITE:
        advice = (
            f"take a smaller integrator.step_s than {run.clock[ki.STEP]:g}, or an adaptive method (rk43, rodas4)"
            if method == "rk4"
            else "look at the last state for a joint that runs away"
        )
        return f"{where}: the state is no longer finite (divergence); {advice}"
    if status == ki.NO_FORCES:
        names = ", ".join(contact.name for contact in prepared.contacts)
        return (
            f"{where}: no signs of the normal forces at {names} agree with dissipative friction (Painlevé's paradox); "
            "lower contacts.friction, or take contacts.pulling_friction: signed"
        )
    if status == ki.STEP_TOO_SMALL:
        return (
            f"{where}: the step size fell to {run.clock[ki.STEP]:.1e} s; try integrator.method rodas4 or a larger rtol"
        )
    ws = prepared.workspace
    gaps = ws.rows[: ws.counts[ka.ROWS], ka.ROW_GAP]
    worst = int(np.argmax(np.abs(gaps)))
    owner = int(ws.active[worst, ka.OWNER])
    if ws.active[worst, ka.ROW_KIND] == ka.JOINT_ROW:
        coupling = prepared.model.robot.couplings[owner]
        what = f"joint {coupling.joint} cannot be kept where {coupling.leader} leads it (off by {gaps[worst]:+.2e})"
    else:
        what = f"contact {prepared.contacts[owner].name} cannot be kept on its surface (gap {gaps[worst]:+.2e} m)"
    return f"{where}: {what}; the contacts contradict each other or the arm is singular here" + (
        ", or integrator.step_s is too long (try integrator.method: rk43)" if method == "rk4" else ""
    )
