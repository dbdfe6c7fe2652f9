"""Preparation of a dynamics run: choice of the integration method, kernel arrays, and checks before the first step."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dynsim.compile.clearance import gaps
from dynsim.compile.control import JointControl
from dynsim.compile.mobility import check_inertia, mobility_floors
from dynsim.compile.model import Model
from dynsim.compile.posture import gaps_and_rates
from dynsim.compile.shapes import compile_shapes
from dynsim.compile.tables import (
    DryFriction,
    JointStop,
    compile_contacts,
    compile_couplings,
    compile_drives,
    compile_loads,
    compile_support,
    compile_unilateral,
    dry_frictions,
    joint_stops,
    with_shapes,
)
from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.derivative import System, new_workspace
from dynsim.dynamics.drive.law import dc_block, servo_block
from dynsim.dynamics.state import OutputLayout, StateLayout, block, output_layout, state_layout
from dynsim.dynamics.tree import support as ks
from dynsim.engine import REFERENCES, Progress
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.equilibrium import Balance, balanced, pressed, shifted
from dynsim.engine.outcome import check_size
from dynsim.engine.trace import even_times
from dynsim.errors import ModelError, ScenarioError, SimulationStopped
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.integrators.events import TIP_MARGIN
from dynsim.integrators.methods import METHODS, by_number
from dynsim.integrators.run import RATE_TOLERANCE
from dynsim.integrators.simd.forms import has_forms
from dynsim.integrators.stepping.articulated_contacts import articulated_arrays
from dynsim.integrators.stepping.free_bodies import free_bodies
from dynsim.integrators.stepping.tables import stepping_arrays
from dynsim.model.description import Array, Contact, Load, Robot
from dynsim.model.drives import Drive, Motor
from dynsim.record.poses import pose_columns
from dynsim.scenario import Scenario, build
from dynsim.scenario.combinations import check_robot
from dynsim.scenario.schema import Integrator
from dynsim.system.memo import Memo, recall, remembering

if TYPE_CHECKING:
    from dynsim.engine.snake_control import Phase

# Choice of the integration method (``method: auto``) from the fastest rate of the system at the start.


AUTO = "auto"
PACE = 0.02
"""Step size that is assumed to be small enough for accurate arm motion [s]."""
TOUCHING = 1e-6
"""A contact with a gap below this [m] is closed at the start."""
SMALL = 36
"""Number of joints up to which the Jacobians of RADAU5 take less than half of the time of its steps."""
UNDAMPED, UNDAMPED_RTOL, LEAST_RTOL = (0.03, 0.1), 3e-9, 1e-12
"""Step tolerance if nothing damps integration errors: UNDAMPED_RTOL, limited to the fractions UNDAMPED of rtol.

The fraction is not applied if the tolerance would be below LEAST_RTOL.
"""

DENSE = 300
"""Matrix size up to which all eigenvalues are computed; for larger matrices, only the largest one is computed."""


class Choice(NamedTuple):
    """An integration method and the reason for its choice."""

    method: str
    reason: str
    sharper: float = 1.0
    """Step tolerances as a fraction of the scenario tolerances."""


def choose(
    options: Integrator, model: Model, contacts: Sequence[Contact], control: JointControl, drives: ka.DriveArrays
) -> Choice:
    """Return the method in ``integrator.method``, or for ``auto`` a method that suits the system."""
    if options.method != AUTO:
        return Choice(options.method, "set in the scenario")
    pace = min(PACE, control.sample_time or PACE, options.step_max_s or PACE)
    rate = fastest_rate(model, contacts, drives)
    reason = f"fastest rate {rate:.3g} 1/s, steps of {1e3 * pace:.3g} ms"
    if rate * pace > implicit_threshold(model.n):
        return Choice("radau5", f"{reason}: an implicit method is not limited by this rate")
    if rate == 0.0:
        sharper = min(max(UNDAMPED_RTOL / options.rtol, UNDAMPED[0]), UNDAMPED[1])
        sharper = sharper if options.rtol * sharper >= LEAST_RTOL else 1.0
        reason = f"no drive or loss damps errors: tolerances multiplied by {sharper:.2g} conserve the energy"
        if model.n <= SMALL and any(contact.friction_at_rest > 0.0 for contact in contacts):
            return Choice("radau5", f"{reason}; the implicit method resolves friction at slow slip", sharper)
        return Choice("dopri5", reason, sharper)
    return Choice("dopri5", f"{reason}: an explicit method can use such steps")


def implicit_threshold(n: int) -> float:
    """Return h |λ| above which a RADAU5 step costs less than the DOPRI5 steps that it replaces.

    DOPRI5 evaluates six right-hand sides per interval of 3.3/|λ|. RADAU5 evaluates about twenty per step and, at every
    eleventh step, also a Jacobian of 2 n columns and factors of n × n matrices: n³ multiplications take as long as 100
    n right-hand sides of a link.
    """
    return (20.0 + (2.0 * n + 0.03 * n**2) / 11.0) * 3.3 / 6.0


def drive_slopes(model: Model, drives: ka.DriveArrays) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return the derivatives of joint torques τ, and of current rates di/dt, by q, v and i, at rest.

    They include drives and joint damping. Shapes: torques (n, n), (n, n) and (n, circuits); current rates (circuits,
    n), (circuits, n) and (circuits, circuits). Held commands do not depend on the state.
    """
    n, circuits = model.n, int(model.robot.circuits)
    torque_q, torque_v, torque_i = np.zeros((n, n)), -np.diag(model.damping), np.zeros((n, circuits))
    rate_q, rate_v, rate_i = np.zeros((circuits, n)), np.zeros((circuits, n)), np.zeros((circuits, circuits))
    for a in range(len(drives.table)):
        kind, j, sampled = drives.table[a, ka.DRIVE_KIND], drives.table[a, ka.DRIVEN], drives.table[a, ka.SAMPLED] != 0
        if kind == ka.DC_MOTOR:
            e, block = drives.table[a, ka.CIRCUIT], dc_block(drives.motor, a, 0.0 if sampled else 1.0)
            torque_q[j, j], torque_v[j, j], torque_i[j, e] = block[0], torque_v[j, j] + block[1], block[2]
            rate_q[e, j], rate_v[e, j], rate_i[e, e] = block[3:]
        elif kind == ka.POSITION_SERVO:
            by_q, by_v = servo_block(drives.motor, a, drives.table[a, ka.SERVO_MODE], sampled, 0.0, 0.0)
            torque_q[j, j], torque_v[j, j] = by_q, torque_v[j, j] + by_v
    return torque_q, torque_v, torque_i, rate_q, rate_v, rate_i


def fastest_rate(model: Model, contacts: Sequence[Contact], drives: ka.DriveArrays) -> float:
    """Return the largest |λ| of drives and losses at the start, at rest [1/s]."""
    n, q = model.n, model.robot.initial
    torque_q, torque_v, torque_i, rate_q, rate_v, rate_i = drive_slopes(model, drives)
    if not (torque_q.any() or torque_v.any() or torque_i.any()):
        return 0.0
    mobility = np.linalg.inv(model.mass_matrix(q) + np.diag(model.armature))
    rows = _held(model, contacts, q)
    if len(rows):
        through = mobility @ rows.T
        mobility = mobility - through @ np.linalg.pinv(rows @ through) @ through.T
    still = np.zeros((n, len(rate_i)))
    return _spectral_radius(
        np.block(
            [
                [np.zeros((n, n)), np.eye(n), still],
                [mobility @ torque_q, mobility @ torque_v, mobility @ torque_i],
                [rate_q, rate_v, rate_i],
            ]
        )
    )


def _spectral_radius(A: Array) -> float:
    if len(A) <= DENSE:
        return float(np.abs(np.linalg.eigvals(A)).max())
    from scipy.sparse.linalg import eigs  # imported here because short chains do not need it

    start = np.random.default_rng(0).normal(size=len(A))
    return float(np.abs(eigs(A, k=1, v0=start, tol=1e-2, return_eigenvectors=False)[0]))


def _held(model: Model, contacts: Sequence[Contact], q: Array) -> Array:
    """Return the rows of constraints active at the start, (p, n): normals of touching contacts, and couplings."""
    gaps, rates = gaps_and_rates(model, contacts, q)
    return np.vstack([rates[np.abs(gaps) < TOUCHING], model.coupling_rows])


log = logging.getLogger(__name__)

# A run is refused if its estimated time exceeds the wall-clock limit by this factor, because estimates for small
# systems are too long by up to this factor.
WORK_MARGIN = 10.0
# Maximum number of explicit steps that the electrical poles may require: a quarter of an hour for ten joints.
STEPS_LIMIT = 2e8
# A run, unless it is short, makes no progress if its last MOST_TRIALS steps together advanced by no more than this time
# [s]. Its events are then closer together than the steps of any stiff robot.
STALLED_S = 1e-5
# Slip slower than this [m/s] has no defined direction, however tight the tolerances are. The rate at which friction
# turns the slip direction is inversely proportional to the slip speed and limits the steps. In ten milliseconds, such
# slip moves a point by a nanometre.
SLOWEST = 1e-7
# Maximum number of steps, more than any run needs.
EVERY_STEP = 1 << 62


@dataclass(frozen=True)
class Prepared:
    """A scenario compiled to kernel arrays, at its initial state."""

    model: Model
    contacts: list[Contact]
    control: JointControl
    system: System
    run: ki.Run
    workspace: ka.Workspace
    loads: list[Load]
    stops: list[JointStop]
    choice: Choice
    balance: Balance | None = None
    dry: Sequence[DryFriction] = ()
    # Contacts on their surfaces that are left out because of brakes: name and start time [s].
    behind_brakes: Mapping[str, float] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """Text that describes the system for which the kernels are compiled."""
        system, stepped = self.system, self.run.method == ki.TIME_STEPPING
        parts = [self.choice.method]
        if self.contacts or self.stops:
            parts.append("bilateral contacts" if system.unilateral is None else "unilateral contacts")
        extras = {
            "spheres, boxes or height fields": system.shapes is not None and not stepped,
            "the dense system": system.dense is not None,
        }
        return f"arms by {', '.join([*parts, *(name for name, there in extras.items() if there)])}"


def prepare(
    scenario: Scenario,
    progress: Progress | None = None,
    *,
    pushable: bool = False,
    times: np.ndarray | None = None,
    end: float | None = None,
    motors: Sequence[Drive] | None = None,
    starts: bool = True,
) -> Prepared:
    """Compile a scenario to kernel arrays; call ``progress`` while references are prepared, if that takes long.

    A caller that changes tables of a run must prepare it within a separate memo.

    Parameters
    ----------
    scenario : Scenario
        Scenario with a dynamics plant.
    progress : Progress, optional
        Progress callback.
    pushable : bool, optional
        If True, add an external wrench on every body, initially zero, after the loads of the scenario.
    times : (T,) ndarray, optional
        Sample times [s]; default: the sample times of the whole record.
    end : float, optional
        End of the run [s]; default: ``duration_s`` of the scenario.
    motors : sequence of Drive, optional
        Motors to use instead of the motors of the plant.
    starts : bool, optional
        False for a run that starts from a state: the caller checks its posture instead of the scenario's initial
        posture.

    Raises
    ------
    ModelError, UnreachableReference
        See :func:`dynsim.engine.simulate`.
    ScenarioError
        If the record would be larger than ``record.size_limit_GB``, or the explicit method would need too many steps.
    """
    described, contacts, piloted = at_start(scenario)
    if motors is not None:
        described = replace(described, motors=tuple(motors))
    model = recall("model", lambda: Model(described), described)
    robot, places = model.robot, [contact.geometry for contact in contacts]
    law = scenario.config.contacts.law
    if starts:
        recall("start", lambda: build.check_start(scenario, model, contacts), model, law, places)
        recall("inertia", lambda: check_inertia(model), model)
    loads = build.loads(scenario, robot)
    if pushable:
        # Wrenches that only the caller sets.
        nothing = np.zeros((0, 6, 4))
        pushes = [Load(body, body, np.zeros(3), False, np.zeros(1), nothing, False) for body in robot.bodies]
        loads = [*loads, *pushes]
    n, na, c = model.n, len(robot.motors), len(contacts)
    real = scenario.config.contacts.law == "unilateral"
    stops = joint_stops(robot)  # also checks the start, under both laws
    if not real:
        stops = []
    stepped = scenario.integrator.method == "time_stepping"
    dry = dry_frictions(robot) if real else []
    watched = real and bool(contacts or stops or dry)
    check_robot(scenario.config, robot)
    build.sensor_mounts(scenario, robot)  # raises an error for a sensor on an unknown link
    gives = bool(robot.ties) or any(contact.stiffness > 0.0 for contact in contacts)
    sizes = kst.LOSSES if real else 0, 1 if stepped else 0, kst.ELASTIC_SIZE if gives else 0
    layout = state_layout(model.nq, n, robot.circuits, c, len(loads), *sizes)
    columns = output_layout(n, na, c, ks.OUTPUTS if robot.base else 0, len(stops), len(dry), len(robot.ties))
    if times is None:
        times = sample_times(scenario, layout, columns, n)
    joint_rows = len(robot.couplings) + len(stops) + len(dry) + len(robot.ties)
    _check_work(scenario, n, c + joint_rows, scenario.integrator.method)
    control = piloted or _control(scenario, model, contacts, progress)
    if piloted is None:
        _check_sensors(scenario, control)
    if not real:
        _check_references(scenario, model, contacts, control)
    options, size = scenario.integrator, n + ka.row_limit(c, joint_rows) + robot.circuits
    sampled = control.sample_time is not None
    drives = compile_drives(robot, k_p=list(control.k_p), k_d=list(control.k_d), sampled=sampled, dry=real)
    choice = recall(
        "choice", lambda: choose(options, model, contacts, control, drives), options, model, control, places, *drives
    )
    _check_work(scenario, n, c + joint_rows, choice.method)
    _check_stiffness(choice.method, scenario.duration_s, robot)
    method = METHODS[choice.method].number
    step = options.step_s or (1e-3 if method == ki.TIME_STEPPING else 0.0)
    balance, initial = None, scenario.config.initial
    if initial is not None and initial.equilibrium:
        with kernels_logged(log, "the start at rest", loads=False):
            still, requested = build.loads(scenario, robot), robot.initial
            model = pressed(model, contacts, still, control, real)
            balance = balanced(model, contacts, still, control, real, requested)
            robot = model.robot
    if real:
        _check_scratch(c, ka.row_limit(c, joint_rows), kc.CONE_ROOM if method == ki.TIME_STEPPING else ku.ROOM)
    floors = None if real else recall("floors", lambda: mobility_floors(model, contacts), model, places)
    system = System(
        layout=layout,
        model=model.arrays,
        drives=drives,
        reference=control.reference if balance is None else shifted(control.reference, balance.shift),
        contacts=compile_contacts(robot, contacts, floors),
        loads=compile_loads(robot, loads),
        dense=np.zeros((size, size + 1)) if options.solver == "m_star" else None,
        couplings=compile_couplings(robot),
        shapes=compile_shapes(robot, contacts),
        unilateral=compile_unilateral(
            robot,
            contacts,
            stops,
            slow_slip(options.absolute_tolerance),
            creep(options.absolute_tolerance),
            dry,
            method == ki.TIME_STEPPING,
        )
        if real
        else None,
    )
    stepping = None
    if method == ki.TIME_STEPPING and system.unilateral is not None:
        system = with_shapes(system)
        free = free_bodies(model.arrays) if system.shapes and system.shapes.pairs is not None else None
        articulated = articulated_arrays(system)
        stepping = stepping_arrays(model.arrays, system.contacts, na, joint_rows, options.theta, free, articulated)
    y = np.zeros(layout.size)
    y[block(layout, "q")] = robot.initial
    if balance is not None:
        circuit = drives.table[:, ka.CIRCUIT]
        y[layout.current + circuit[circuit >= 0]] = balance.current[circuit >= 0]
    run = ki.new_run(
        method,
        y,
        layout,
        columns,
        n=n,
        na=na,
        c=c,
        couplings=joint_rows,
        sample_time=times,
        hand=(model.body_index(robot.hand[0]), robot.hand[1]),
        end=scenario.duration_s if end is None else end,
        step=step,
        step_max=min(options.step_max_s or np.inf, _longest_step(method, watched=watched)),
        rtol=options.rtol * choice.sharper,
        atol=options.absolute_tolerance * choice.sharper,
        ticks=_ticks(control),
        breaks=_breaks(loads, control, method, options),
        # Callers that step a run may leave its end open.
        least_progress=_least_progress(min(scenario.duration_s, end or np.inf)),
        events=guards(robot, contacts if real else (), stops, dry),
        support=compile_support(robot),
        stepping=stepping,
        lanes=has_forms(system),
    )
    return Prepared(model, contacts, control, system, run, new_workspace(system), loads, stops, choice, balance, dry)


def _check_scratch(c: int, rows: int, tables: int) -> None:
    """Raise ModelError if the scratch of the contact problem of c candidates cannot be allocated; it is not touched."""
    try:
        np.empty((tables, rows, rows))
    except MemoryError:
        raise ModelError(
            f"{c} contact candidates need {8e-9 * tables * rows**2:.3g} GB of address space, more than this computer "
            "allocates; use fewer pairs in contacts.between, fewer contacts.candidates, or fewer links",
            keys=("contacts",),
        ) from None


def at_start(scenario: Scenario) -> tuple[Robot, list[Contact], JointControl | None]:
    """Return the robot in its start posture, its contacts, and the control of a snake (None for other robots)."""
    described, contacts = build.robot_and_contacts(scenario)
    if type(described) is not Robot:
        # Import the modules of the snake only for a snake.
        from dynsim.compile.snake_tree import SnakeTree
        from dynsim.engine.snake_control import snake_start

        if isinstance(described, SnakeTree):
            robot, control = snake_start(scenario, described, follow_lines)
            return robot, contacts, control
    return described, contacts, None


def _check_sensors(scenario: Scenario, control: JointControl) -> None:
    """Raise an error for sensors that the controller of an arm does not read."""
    sensors = scenario.config.sensors
    if sensors is None:
        return
    if sensors.motion_capture is not None:
        raise ModelError(
            "sensors.motion_capture is for the snake's controller; remove it (arms use sensors.encoders)",
            keys=("sensors", "motion_capture"),
        )
    if sensors.encoders is None or control.sample_time is not None:
        return
    why = "this controller is continuous; set controller.sample_time_s or remove the encoders"
    raise ModelError(
        "sensors.encoders requires a sampled controller: "
        + ("this scenario has no controller; remove it" if scenario.controller is None else why),
        keys=("sensors", "encoders"),
    )


def follow_lines(scenario: Scenario, q: Array, phases: Sequence[Phase]) -> Array:
    """Return the coordinates (nq,) that a robot reaches from rest at q when servos follow linear references.

    ``phases`` is described at :data:`dynsim.engine.snake_control.Phase`.

    Raises
    ------
    SimulationStopped
        If the motion diverges.
    """
    # Use a separate memo, because the tables written to below must not be shared with other runs.
    with remembering(Memo()):
        prepared = prepare(scenario, times=np.full(1, np.inf), end=phases[-1][0])
    run, system, since = prepared.run, prepared.system, 0.0
    run.y[block(run.layout, "q")] = q
    motors = {motor.joint: a for a, motor in enumerate(prepared.model.robot.motors)}
    for end, lines in phases:
        rows = [motors[joint] for joint in lines]
        system.reference.spline[rows] = ka.REWRITTEN
        system.drives.input[rows, ka.LINE_START], system.drives.input[rows, ka.LINE_RATE] = np.array(
            [*lines.values()]
        ).T
        system.drives.input[rows, ka.LINE_SINCE], since = since, end
        run.clock[ki.END] = end
        run.count[[ki.STATUS, ki.STARTED]] = ki.RUNNING, 0
        while run.count[ki.STATUS] == ki.RUNNING:
            driver.advance(system, prepared.workspace, run, EVERY_STEP)
            run.count[ki.LOGGED] = 0
        if run.count[ki.STATUS] != ki.FINISHED:
            raise SimulationStopped(
                "the robot does not settle before the run starts (it diverges); check the gains and the initial posture"
            )
    return run.y[block(run.layout, "q")].copy()


def _ticks(control: JointControl) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the ticks at which commands are updated, for a sampled controller."""
    if control.sample_time is None:
        return None
    tick = np.zeros((1, ki.TICK_SIZE))
    tick[0, ki.TICK_PERIOD] = control.sample_time
    return tick, np.array([[ki.TAKE_COMMANDS, 0, 0]])


def guards(
    robot: Robot, contacts: Sequence[Contact], stops: Sequence[JointStop], dry: Sequence[DryFriction] = ()
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the events that a run watches for by default, and their actions: base first, then unilateral contacts.

    A mobile base triggers an event when its tip margin falls below zero. For contacts, stops and dry friction see
    dynsim.integrators.contacts.events.
    """
    rows = []
    if robot.base is not None:
        rows.append((TIP_MARGIN, 0, -1, ki.STOP if robot.base.stop_on_overturn else ki.LOG))
    for k, contact in enumerate(contacts):
        if not contact.left_out:
            rows += [(ke.NORMAL_GUARD, k, -1, ki.LOG), (ke.SLIP_GUARD, k, -1, ki.LOG)]
    rows += [(ke.STOP_GUARD, k, -1, ki.LOG) for k in range(len(stops))]
    rows += [(ke.DRY_GUARD, k, -1, ki.LOG) for k in range(len(dry))]
    if not rows:
        return None
    event = np.zeros((len(rows), ki.EVENT_SIZE))
    # Every value counts as positive before the run: an event that starts beyond zero occurs immediately.
    event[:, ki.SIDE] = 1.0
    return event, np.array(rows)


def slow_slip(atol: float) -> float:
    """Return the slip speed below which the slip direction is integration noise [m/s].

    Below this speed, friction changes the slip direction only as fast as at this speed.
    """
    return max(1000.0 * atol, SLOWEST)


def creep(atol: float) -> float:
    """Return the rate below which a joint with dry friction may be at rest [rad/s or m/s].

    If contacts block a joint that has no constraint row, only its rate shows that it moves. Until the rate exceeds this
    limit, its friction keeps the constant value from rest instead of the full friction. The energy error is
    proportional to the limit: relative to the turnover, it is two to three times the limit when a turning surface
    starts to move the joint. With a limit of 100 atol, which equals rtol by default, the error is a few rtol. The lower
    bound is the rate that projections leave in active rows.
    """
    return max(100.0 * atol, RATE_TOLERANCE)


def _least_progress(duration: float) -> float:
    """Return the time by which MOST_TRIALS steps together must advance [s]."""
    least = ki.PROGRESS * duration
    return max(least, min(10.0 * least, STALLED_S))


def _longest_step(method: int, *, watched: bool) -> float:
    """Return the longest step [s]; limited for implicit methods if contacts, stops or dry friction are watched.

    While everything is at rest, nothing limits the steps, and a force could fall below zero and rise again within a
    step. The knots of references have the same spacing as this limit. An implicit method stops where references bend,
    but a force may pass its bound between two such points, which changes the motion.
    """
    table = by_number(method)
    return PACE if table.explicit or (watched and table.adaptive) else np.inf


def _breaks(loads: Sequence[Load], control: JointControl, method: int, options: Integrator) -> np.ndarray:
    """Return the times at which loads jump or change slope [s]: a step across them could miss a short push completely.

    For an implicit method, include the times at which references bend, because its steps are longer than the spacing of
    their knots.
    """
    times = []
    for load in loads:
        varies = len(load.coefficients) > 1 or load.coefficients[:, :, 1:].any()
        if len(load.coefficients) and (varies or not load.hold):
            times.append(load.knots)
    if by_number(method).adaptive and not by_number(method).explicit:
        tolerances = options.rtol, options.absolute_tolerance
        times.append(recall("bends", lambda: control.bends(*tolerances), control, *tolerances))
    return np.unique(np.concatenate(times)) if times else np.zeros(0)


def sample_times(scenario: Scenario, layout: StateLayout, columns: OutputLayout, links: int) -> np.ndarray:
    """Return the sample times of the whole record, (T,) [s]; raise ScenarioError if it would be too large."""
    rate = scenario.record.rate_hz
    count = int(np.floor(scenario.duration_s * rate * (1.0 + 1e-12))) + 1
    check_size(scenario, count, layout.size + columns.size + pose_columns(links))
    return even_times(0.0, scenario.duration_s, rate)


def _check_stiffness(method: str, duration: float, robot: Robot) -> None:
    """Raise an error for an explicit method if the poles R/L of the circuits require too many steps."""
    circuits = [motor for motor in robot.motors if isinstance(motor, Motor)]
    if not METHODS[method].explicit or not circuits:
        return
    motor = max(circuits, key=lambda motor: motor.resistance / motor.inductance)
    pole = motor.resistance / motor.inductance
    steps = duration * pole / METHODS[method].stability
    if steps > STEPS_LIMIT:
        raise ScenarioError(
            f"{motor.joint}: R/L = {pole:.2g} 1/s requires about {steps:.1g} steps of integrator.method {method} for "
            f"{duration:g} s; use integrator.method: auto or radau5, or an inductance above {motor.inductance:g} H"
        )


def right_hand_side(n: int, p: int, *, dense: bool) -> float:
    """Estimate the time of one evaluation of the right-hand side for n joints and p constraint rows [s].

    The estimate is based on measurements from 10 to 1000 links with up to 250 contacts and is accurate to a factor of
    two. Its terms are the sweeps over the links, the assembly of the p × p system for chains of n links, and its
    elimination, which takes twice as long for dependent rows (rows are dependent if p > n).
    """
    seconds = 1e-7 * n + 4e-10 * n * p**2 + (4e-10 if p > n else 2e-10) * p**3
    return seconds + (3e-10 * (n + p) ** 3 if dense else 0.0)


def _check_work(scenario: Scenario, n: int, p: int, method: str) -> None:
    """Raise an error if the estimated time of the integration clearly exceeds ``integrator.wall_limit_s``.

    The estimate uses the system size. Before the method is chosen (``auto``), it assumes the faster method.
    """
    options = scenario.integrator
    if options.wall_limit_s is None:
        return
    seconds = right_hand_side(n, p, dense=options.solver == "m_star")
    # Motors and friction limit the steps of explicit methods to about a millisecond. An implicit method takes steps of
    # some hundredths of a second, with three iterations, and occasionally a finite-difference Jacobian and its
    # factorization.
    step = options.step_s if options.step_s and method == "time_stepping" else 1e-3
    explicit, implicit = 4.0 * seconds / step, ((2 * n + 14) * seconds + 3e-9 * n**3) / 1e-2
    if method == AUTO:
        rate = min(explicit, implicit)
    else:
        rate = explicit if METHODS[method].explicit or not METHODS[method].adaptive else implicit
    wall = scenario.duration_s * rate
    if wall > WORK_MARGIN * options.wall_limit_s:
        raise ScenarioError(
            f"{n} joints with {p} contacts: a right-hand side takes about {seconds:.1g} s, so "
            f"{scenario.duration_s:g} s would take about {wall:.2g} s to integrate, but the limit "
            f"(integrator.wall_limit_s) is {options.wall_limit_s:g} s; "
            "use fewer contacts or links, reduce duration_s, or raise the limit"
        )


def _control(scenario: Scenario, model: Model, contacts: Sequence[Contact], progress: Progress | None) -> JointControl:
    if scenario.controller is None:
        return JointControl.absent(model.robot)
    log.info("%s: planning references over %g s", scenario.title, scenario.duration_s)
    started = clock.perf_counter()
    with kernels_logged(log, "references", loads=False):
        control = build.controller(
            scenario, model, None if progress is None else partial(progress, stage=REFERENCES), contacts
        )
    log.info("%s: planned references in %.3f s", scenario.title, clock.perf_counter() - started)
    if not isinstance(control, JointControl):
        raise ModelError(f"controller {scenario.controller.type!r} cannot drive a {scenario.plant.type!r}")
    return control


def _check_references(scenario: Scenario, model: Model, contacts: Sequence[Contact], control: JointControl) -> None:
    """Raise an error if references, when followed exactly, would pull a contact point off its surface."""
    robot, tolerance = model.robot, scenario.config.contacts.reference_tolerance_m
    places = [contact.geometry for contact in contacts]

    driven = [motor.joint for motor in robot.motors]
    names = [(link.name, link.joint, link.parent) for link in robot.links]
    bits = model.geometry, robot.initial, names, robot.frames, driven, control.reference, control.k_p, robot.base
    recall("held places", lambda: _check_held(model, contacts, control, tolerance), *bits, places, tolerance)


def _check_held(model: Model, contacts: Sequence[Contact], control: JointControl, tolerance: float) -> None:
    """Check references against bilateral contacts, see :func:`_check_references`."""
    robot = model.robot
    links = {link.name: link for link in robot.links}
    motor_of = {motor.joint: a for a, motor in enumerate(robot.motors)}
    followed: dict[str, list[tuple[Contact, Array]]] = {}
    for contact in contacts:
        index, point = robot.attach(contact.body, contact.point)
        chain = []
        for end in (robot.links[index].name, contact.surface.carrier):
            body = end
            while body is not None:
                chain.append(motor_of.get(links[body].joint, -1))
                body = links[body].parent
        # A joint that does not follow a reference yields, so references do not determine the position of the point. If
        # no reference moves, the point stays at its initial position, which is checked separately.
        follows = all(a >= 0 and control.k_p[a] > 0.0 for a in chain)
        if follows and any(control.reference.spline[a] >= 0 for a in chain):
            followed.setdefault(robot.links[index].name, []).append((contact, point))
    if not followed:
        return
    worst: dict[str, tuple[float, float, np.ndarray]] = {}
    first: dict[str, float] = {}
    points = {body: [(contact.surface, point) for contact, point in pairs] for body, pairs in followed.items()}
    for times, q in control.positions(robot):
        for link, distances in gaps(robot, q, points):
            for (contact, _), distance in zip(followed[link.name], distances, strict=True):
                gap = distance - contact.radius
                k = int(np.abs(gap).argmax())
                if abs(gap[k]) > tolerance:
                    first.setdefault(contact.name, float(times[np.abs(gap) > tolerance][0]))
                    if abs(gap[k]) > abs(worst.get(contact.name, (0.0,))[0]):
                        worst[contact.name] = float(gap[k]), float(times[k]), q[k].copy()
    if not worst:
        return
    name, (gap_max, time, there) = max(worst.items(), key=lambda item: abs(item[1][0]))
    contact = next(contact for contact in contacts if contact.name == name)
    x, y, z = model.point_position(contact.body, contact.point, there)
    others = ", ".join(other for other in worst if other != name)
    raise ModelError(
        f"contact {name}: the joint references move its point {gap_max:+.4g} m off surface "
        f"{contact.surface_name!r} at t = {time:.3f} s, at ({x:.4g}, {y:.4g}, {z:.4g}) m; "
        f"contacts.reference_tolerance_m = {tolerance:g} m is exceeded from t = {first[name]:.3f} s on"
        f"{f' (also {others})' if others else ''}; "
        "keep the joints before the contact fixed, change their path, or disable the contact"
    )
