"""Arrays of one integration: state, recorded rows, clock, counters, events, ticks; its methods and statuses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import delassus as kq
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.delassus import force_verdict, solve_small
from dynsim.dynamics.contact.rows import force_vectors, row_errors, slip_speed
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.ledger import kinetic_energy, magnetic_energy, potential_energy
from dynsim.dynamics.state import OutputLayout, StateLayout, block
from dynsim.dynamics.tables import Workspace, row_limit, workspace
from dynsim.dynamics.tree import support as ks
from dynsim.dynamics.tree.articulated import accelerate_by_impulses, row_mobilities
from dynsim.dynamics.tree.joints import displace, normalise, point_position
from dynsim.dynamics.tree.support import SupportArrays, ground_reaction, no_support
from dynsim.integrators import methods
from dynsim.integrators.radau5 import tables as kn
from dynsim.integrators.radau5.tables import NODE_RADAU, NewtonArrays, newton_arrays
from dynsim.integrators.simd.forms import stage_lanes
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import inline_kernel, integers, internal_kernel, kernel, reals

# Run.method
DOPRI5, RADAU5, TIME_STEPPING = methods.DOPRI5.number, methods.RADAU5.number, methods.TIME_STEPPING.number
LINEAR, HERMITE = methods.LINEAR, methods.HERMITE

RUNNING, FINISHED, NOT_FINITE, STEP_TOO_SMALL, NOT_PROJECTED, NO_FORCES = 0, 1, 2, 3, 4, 5
FORCES_REVERSED, SEVERAL_FORCES, STOPPED = 6, 7, 8
# Statuses under the unilateral law: no forces agree with Coulomb's law; modes change endlessly.
NO_CONTACT_FORCES, CHATTER = 9, 10
# Statuses: MOST_TRIALS steps made almost no progress; set by the caller: wall-clock limit reached; a step does not end.
NO_PROGRESS, OUT_OF_TIME, STUCK = 11, 12, 13

# Run.clock
TIME, STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX = 0, 1, 2, 3, 4, 5, 6
NOT_UNIQUE = 7  # end of the rejected step at which the contact forces were not unique [s]
# HOLD: a step that would end beyond this time is left pending instead of being accepted; step size proposed before a
# cut; error norm of the step taken; bracket of the root being searched, measured from TIME [s].
HOLD, PROPOSED, ERROR, LOW, HIGH = 8, 9, 10, 11, 12
# Time at which the count of trials last restarted, and required progress of MOST_TRIALS trials [s].
COUNTED_SINCE, LEAST_PROGRESS = 13, 14
INNER = 15  # 2: fractions of the step at which guards are recorded
CLOCK_SIZE = 17
# Run.count, int
STEPS, REJECTED, EVALUATIONS, PROJECTIONS, SAMPLE, STATUS, STARTED = 0, 1, 2, 3, 4, 5, 6
# Flag that a step is pending; number of trials for a root; end of the bracket that moved last; flags that the step ends
# at an event or at a tick; number of events in the log; bits of the ticks that need the caller.
PENDING, SEARCHING, TURNED_BACK, FIRED, TRIMMED, LOGGED, TICKED = 7, 8, 9, 10, 11, 12, 13
NEXT_BREAK = 14  # index of the first break in Run.breaks that has not been passed
MODES_DUE = 15  # contact modes must be chosen at the next start: start of the run, or after a jump of rates
GRAZING = 16  # number of times the step was shortened because it passed over an event
TRIALS = 17  # number of steps tried since COUNTED_SINCE, accepted or not
ASKED = 18  # written by another thread to request a return at the next step
COUNT_SIZE = 19
# Number of trials in a progress check, and required progress as a fraction of the duration of the run.
MOST_TRIALS, PROGRESS = 10_000, 1e-6
AT_START, AFTER_JUMP = 1, 2
# Columns of Run.event, and of Run.event_table, int
EVENT_LEVEL, SIDE, START_VALUE, VALUE, AT_LOW, AT_HIGH = 0, 1, 2, 3, 4, 5
INNER_VALUE = 6  # 2: values at the fractions INNER of the step
EVENT_SIZE = 8
EVENT_KIND, EVENT_INDEX, DIRECTION, ON_EVENT = 0, 1, 2, 3
EVENT_TABLE_SIZE = 4
# Action of an event in addition to its log entry: none, return to the caller, end the run.
LOG, RETURN, STOP = 0, 1, 2
# Columns of Run.tick, and of Run.tick_table, int. The kinds of ticks are bits.
TICK_PERIOD, TICK_NEXT, TICK_PHASE = 0, 1, 2
TICK_SIZE = 3
TICK_KIND, TICK_COUNT = 0, 1
TICK_QUEUED = 2  # number of rows at the end of Run.queue that the next ticks use instead of returning to the caller
TICK_TABLE_SIZE = 3
TAKE_COMMANDS, CALLER = 1, 2
LOG_LENGTH = 1024
# Rows of Run.queue.
QUEUE_LENGTH = 8
GAPS_SIZE = 10
# Codes in Run.log_event from these numbers on belong to contacts, joint stops, and joints with dry friction; see
# dynsim.integrators.contacts.events.
CONTACT_LOG, STOP_LOG, DRY_LOG = 1 << 20, 1 << 40, 1 << 50
# Run.extremes, per contact
FORCE_MIN, FORCE_MAX, DRIFT_MAX = 0, 1, 2
PULLING, LAST_FORCE = 3, 4  # time with a negative normal force [s]; normal force at the last accepted step [N]
LOCAL_SINCE = 5  # first time at which the contact's diagonal entry of J M⁻¹ F was negative [s]; inf if never
EXTREMES_SIZE = 6


class Run(NamedTuple):
    """State and working arrays of one integration; m is the length of the state."""

    method: int
    dense_kind: int  # see dynsim.integrators.methods
    layout: StateLayout
    y: np.ndarray  # (m,) state at TIME
    y_new: np.ndarray  # (m,)
    stage: np.ndarray  # (8, m) stage derivatives; stage[0] is the derivative at y
    dense: np.ndarray  # (4, m) y(θ) = y + θ (d0 + (1−θ)(d1 + θ (d2 + (1−θ) d3)))
    quartic: np.ndarray  # (7,) coefficients of d3 / h, by stage
    clock: np.ndarray  # (CLOCK_SIZE,)
    count: np.ndarray  # (COUNT_SIZE,) int
    extremes: np.ndarray  # (c, EXTREMES_SIZE)
    room: np.ndarray  # (ROOM, p, p) scratch; p is the largest number of rows, see dynsim.dynamics.contact.delassus
    hand_link: int
    hand_point: np.ndarray  # (3,) in the body's frame
    sample_time: np.ndarray  # (T,)
    sample: np.ndarray  # (T, m) states
    event: np.ndarray  # (e, EVENT_SIZE)
    event_table: np.ndarray  # (e, EVENT_TABLE_SIZE) int
    tick: np.ndarray  # (k, TICK_SIZE)
    tick_table: np.ndarray  # (k, TICK_TABLE_SIZE) int
    queue: np.ndarray  # (QUEUE_LENGTH, na, 2) positions and rates of the references from a tick on
    breaks: np.ndarray  # (b,) increasing times at which derivatives jump or bend and steps must end [s]
    log_time: np.ndarray  # (LOG_LENGTH,) event times [s]
    log_event: np.ndarray  # (LOG_LENGTH,) int: event codes
    hand: np.ndarray  # (3,) scratch
    gaps: np.ndarray  # (c, GAPS_SIZE) gaps, their rates, normals, positions and slip at the start of the step
    support: SupportArrays
    columns: OutputLayout
    output: np.ndarray  # (T, columns.size)
    stepping: SteppingArrays | None  # time stepping only
    newton: NewtonArrays | None  # RADAU5 only

    def states(self, name: str) -> np.ndarray:
        """Return the block ``name`` of the sampled states, see :func:`dynsim.dynamics.state.block`."""
        return self.sample[: self.count[SAMPLE], block(self.layout, name)]

    def outputs(self, name: str) -> np.ndarray:
        """Return the output columns ``name`` of the samples; for contacts (T, c, OUTPUTS_PER_CONTACT)."""
        columns = self.output[: self.count[SAMPLE], block(self.columns, name)]
        if name == "contact":
            return columns.reshape(len(columns), columns.shape[1] // kst.OUTPUTS_PER_CONTACT, kst.OUTPUTS_PER_CONTACT)
        return columns


def new_run(
    method: int,
    y: np.ndarray,
    layout: StateLayout,
    columns: OutputLayout,
    *,
    n: int,
    na: int,
    c: int,
    couplings: int = 0,
    sample_time: np.ndarray,
    hand: tuple[int, np.ndarray],
    end: float,
    step: float,
    step_max: float,
    rtol: float,
    atol: float,
    events: tuple[np.ndarray, np.ndarray] | None = None,
    ticks: tuple[np.ndarray, np.ndarray] | None = None,
    breaks: np.ndarray | None = None,
    least_progress: float | None = None,
    support: SupportArrays | None = None,
    stepping: SteppingArrays | None = None,
    lanes: bool = False,
) -> Run:
    """Allocate a :class:`Run` that starts at t = 0.

    Parameters
    ----------
    method : int
        DOPRI5, RADAU5 or TIME_STEPPING.
    y : (layout.size,) ndarray
        Initial state.
    layout, columns : StateLayout, OutputLayout
        Layouts of the state and of the outputs of a sample.
    n, na, c, couplings : int
        Numbers of joints, motors, contact candidates and couplings.
    sample_time : (T,) ndarray
        Sample times [s].
    hand : tuple
        Body of the hand and its point in the body's frame (3,) [m].
    end, step, step_max : float
        End time, first step and largest step [s].
    rtol, atol : float
        Tolerances of the error control.
    events, ticks : tuple of ndarray, optional
        Tables of floats and of integers, see ``Run.event`` and ``Run.tick``.
    breaks : (b,) ndarray, optional
        Times at which derivatives jump or bend [s].
    least_progress : float, optional
        Required progress of MOST_TRIALS steps [s]; default: PROGRESS times the time until ``end``.
    support : SupportArrays, optional
        Ground support of a mobile base.
    stepping : SteppingArrays, optional
        Arrays of time stepping.
    lanes : bool, optional
        If True, RADAU5 evaluates several right-hand sides at once, see dynsim.integrators.simd.forms.has_forms.

    Raises
    ------
    ValueError
        If the method is unknown, or the state lacks the block ``scheme`` that time stepping requires.
    """
    m, p, table = len(y), row_limit(c, couplings), methods.by_number(method)
    if method == TIME_STEPPING and layout.size == layout.scheme:
        raise ValueError("time stepping requires a state with the block 'scheme', see dynsim.dynamics.state")
    clock = np.zeros(CLOCK_SIZE)
    clock[[STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX]] = step, 1e-4, end, rtol, atol, step_max
    clock[HOLD] = np.inf
    clock[LEAST_PROGRESS] = PROGRESS * end if least_progress is None else least_progress
    event, event_table = events or (np.zeros((0, EVENT_SIZE)), np.zeros((0, EVENT_TABLE_SIZE)))
    tick, tick_table = ticks or (np.zeros((0, TICK_SIZE)), np.zeros((0, TICK_TABLE_SIZE)))
    extremes = np.zeros((c, EXTREMES_SIZE))
    extremes[:, FORCE_MIN], extremes[:, FORCE_MAX], extremes[:, LOCAL_SINCE] = np.inf, -np.inf, np.inf
    count = np.zeros(COUNT_SIZE, dtype=np.int64)
    count[MODES_DUE] = AT_START
    newton = newton_arrays(n, na, layout.circuits, layout.tracked, m) if method == RADAU5 else None
    if newton is not None and lanes:
        newton = newton._replace(lanes=stage_lanes(workspace(n, na, c, couplings), m, columns.size))
    return Run(
        method=method,
        dense_kind=table.dense,
        layout=layout,
        y=reals(y),
        y_new=np.zeros(m),
        stage=np.zeros((8, m)),
        dense=np.zeros((4, m)),
        quartic=reals(table.quartic),
        clock=clock,
        count=count,
        extremes=extremes,
        room=np.zeros((kq.ROOM, p, p)),
        hand_link=hand[0],
        hand_point=reals(hand[1]),
        sample_time=reals(sample_time),
        sample=np.zeros((len(sample_time), m)),
        event=reals(event),
        event_table=integers(event_table),
        tick=reals(tick),
        tick_table=integers(tick_table),
        queue=np.zeros((QUEUE_LENGTH, na, 2)),
        breaks=reals(np.zeros(0) if breaks is None else breaks),
        log_time=np.zeros(LOG_LENGTH),
        log_event=np.zeros(LOG_LENGTH, dtype=np.int64),
        hand=np.zeros(3),
        gaps=np.zeros((c, GAPS_SIZE)),
        support=no_support() if support is None else support,
        columns=columns,
        output=np.zeros((len(sample_time), columns.size)),
        stepping=stepping,
        newton=newton,
    )


# Statistics of accepted steps: extremes of contact forces and gaps, pulling times, and uniqueness of the forces.


@internal_kernel
def watch(ws: Workspace, run: Run, h):
    """Update extremes of normal forces and gaps, and pulling times, after an accepted step.

    Pulling times are computed as if the force were linear within the step.
    """
    state, extremes = ws.contacts, run.extremes
    for k in range(state.shape[0]):
        low = min(extremes[k, LAST_FORCE], state[k, ka.NORMAL_FORCE])
        high = max(extremes[k, LAST_FORCE], state[k, ka.NORMAL_FORCE])
        if low < 0.0 and h > 0.0:
            extremes[k, PULLING] += h if high <= 0.0 else h * low / (low - high)
        extremes[k, LAST_FORCE] = state[k, ka.NORMAL_FORCE]
        extremes[k, FORCE_MIN] = min(extremes[k, FORCE_MIN], state[k, ka.NORMAL_FORCE])
        extremes[k, FORCE_MAX] = max(extremes[k, FORCE_MAX], state[k, ka.NORMAL_FORCE])
        if ws.active[k, ka.MODE] != ka.OPEN:
            extremes[k, DRIFT_MAX] = max(extremes[k, DRIFT_MAX], abs(state[k, ka.GAP]))


@internal_kernel
def forces_unique(system: System, ws: Workspace, run: Run, t):
    """Return whether contact forces are uniquely determined at time t, after ``derivative``; if not, set STATUS."""
    verdict = force_verdict(ws, run.room, run.extremes[:, LOCAL_SINCE], t)
    if verdict == kq.UNIQUE:
        return True
    run.count[STATUS] = FORCES_REVERSED if verdict == kq.REVERSED else SEVERAL_FORCES
    run.clock[NOT_UNIQUE] = t
    return False


# Recorded outputs of a sample other than states: accelerations, drives, hand, energies, contacts, support.


@internal_kernel
def write_output(system: System, ws: Workspace, run: Run, row):
    """Write all recorded outputs other than states to the columns of OutputLayout, after ``derivative``."""
    fill_output(system, ws, run, run.output[row])
    write_support(system, ws, run, row)


@internal_kernel
def fill_output(system: System, ws: Workspace, run: Run, out):
    """Write the outputs other than states and ground reactions to ``out``, (columns.size,); also for SIMD lanes."""
    joints, state, columns = ws.joints, ws.contacts, run.columns
    force_vectors(ws)
    for i in range(joints.shape[0]):
        out[columns.vdot + i] = joints[i, ka.QDD]
    fill_drives(system, ws, run, out)
    point_position(ws, run.hand_link, run.hand_point, out[columns.hand : columns.hand + 3])
    fill_energies(system, ws, run, out)
    k = columns.contact
    for c in range(state.shape[0]):
        out[k + kst.OUT_FORCE] = state[c, ka.NORMAL_FORCE]
        out[k + kst.OUT_GAP] = state[c, ka.GAP]
        out[k + kst.OUT_MODE] = ws.active[c, ka.MODE]
        for s in range(3):
            out[k + kst.OUT_VECTOR + s] = state[c, ka.FORCE_VECTOR + s]
            out[k + kst.OUT_SLIP + s] = state[c, ka.SLIP_VELOCITY + s]
            out[k + kst.OUT_POSITION + s] = state[c, ka.POSITION + s]
            out[k + kst.OUT_NORMAL + s] = state[c, ka.NORMAL + s]
        k += kst.OUTPUTS_PER_CONTACT
    row_forces(system.unilateral, out[columns.stop :], out[columns.dry :], out[columns.tie :])


@internal_kernel
def fill_energies(system: System, ws: Workspace, run: Run, out):
    """Write the kinetic, potential and magnetic energy at the state of the last sweep."""
    energy = run.columns.energy
    out[energy] = kinetic_energy(system.model, ws)
    out[energy + 1] = potential_energy(system.model, ws)
    out[energy + 2] = magnetic_energy(system.drives, ws)


@internal_kernel
def fill_drives(system: System, ws: Workspace, run: Run, out):
    """Write the currents, voltages and shaft torques of the motors for the accelerations in ``out``."""
    joints, motors, motor, columns = ws.joints, ws.motors, system.drives.motor, run.columns
    for a in range(motors.shape[0]):
        i = system.drives.table[a, ka.DRIVEN]
        out[columns.current + a] = motors[a, ka.CURRENT]
        out[columns.voltage + a] = motors[a, ka.VOLTAGE]
        steady = steady_torque(motor, motors, a, joints[i, ka.QD])
        out[columns.torque + a] = with_rotor(run.stepping, steady, motor[a, ka.J_M] * out[columns.vdot + i], a)


@internal_kernel
def steady_torque(motor, motors, a, v):
    """Return the shaft torque of motor a at a constant rate v [N m or N]."""
    return motor[a, ka.K_M] * motors[a, ka.CURRENT] - motor[a, ka.D_M] * v - motors[a, ka.DRAG] - motors[a, ka.DRY_DRAG]


@internal_kernel
def with_rotor(stepping: SteppingArrays | None, steady, inertial, a):
    """Return the shaft torque of motor a: ``steady``, at a constant rate, minus ``inertial``, which turns its rotor.

    Recorded torques exclude impulses. In the steps of an impact, whose accelerations contain an impulse, the torque of
    the last step without an impact is kept; at the start of a run it is ``steady``.
    """
    if stepping is None:  # resolved at compile time
        return steady - inertial
    if stepping.grid[kt.HELD_STEPS] == 0.0:
        return steady - inertial
    return stepping.torque[a] if stepping.torque[a] == stepping.torque[a] else steady


@internal_kernel
def row_forces(unilateral: UnilateralArrays | None, stop, dry, tie):
    """Write the forces of joint stops, (s,), dry friction, (d,), and ties, (e,); the arrays may be longer."""
    if unilateral is None:  # resolved at compile time
        return
    for k in range(unilateral.stop.shape[0]):
        stop[k] = unilateral.stop[k, ku.STOP_FORCE]
    for k in range(unilateral.dry.shape[0]):
        dry[k] = unilateral.dry[k, ku.DRY_FORCE]
    for k in range(unilateral.tie.shape[0]):
        tie[k] = unilateral.tie[k, ku.TIE_FORCE]


@internal_kernel
def write_support(system: System, ws: Workspace, run: Run, row):
    """Write the ground reaction of a mobile base to the columns ``support``."""
    if run.support.index.shape[0] == 0:
        return
    ground_reaction(system.model, system.loads, run.sample_time[row], ws, run.support)
    for s in range(ks.OUTPUTS):
        run.output[row, run.columns.support + s] = run.support.state[s]


# Projection of positions and rates onto the active constraint rows.


# Tolerances of projection [m, m/s; rad, rad/s]: a tenth of the specified drift (1e-9 m), and a rate that adds less than
# this in one step.
GAP_TOLERANCE = 1e-10
RATE_TOLERANCE = 1e-8
PROJECTION_LIMIT = 6


@internal_kernel
def off_surface(ws: Workspace):
    """Return whether the state violates an active row by more than the projection tolerances."""
    rows, active = ws.rows, ws.active
    row_errors(ws)
    for r in range(ws.counts[ka.ROWS]):
        # Rounding limits the accuracy of the rate to a fraction of the speed.
        if active[r, ka.ROW_KIND] == ka.JOINT_ROW:
            speed = abs(rows[r, ka.ROW + 1] * ws.joints[active[r, ka.BODY_B], ka.QD])
        else:
            speed = slip_speed(ws, active[r, ka.OWNER])
        if abs(rows[r, ka.ROW_GAP]) > GAP_TOLERANCE or abs(rows[r, ka.ROW_RATE]) > RATE_TOLERANCE * (1.0 + speed):
            return True
    return False


@internal_kernel
def project_level(system: System, ws: Workspace, y, level):
    """Take one Newton step of q (level 0) or v (1) onto the active rows; return ½ λᵀ J v, the energy that v loses [J].

    Call after :func:`off_surface`. dq = −M⁻¹ Jᵀ λ with J M⁻¹ Jᵀ λ = gap, and the same for v with J v: the nearest point
    in the kinetic metric. Factors of M + J_m and eliminated rows are still in the workspace from the derivative.
    """
    state, n, p = ws.rows, ws.joints.shape[0], ws.counts[ka.ROWS]
    start = system.layout.q if level == 0 else system.layout.v
    energy = 0.0
    for k in range(p):
        state[k, ka.RHS] = -state[k, ka.ROW_GAP] if level == 0 else -state[k, ka.ROW_RATE]
    row_mobilities(ws, ws.small[0])
    solve_small(ws.small, state, p)
    for k in range(p):
        energy += 0.5 * state[k, ka.FORCE] * state[k, ka.RHS]
    accelerate_by_impulses(system.model, ws, state[:, ka.FORCE])
    if level == 0 and system.layout.extra > 0:
        displace(system.model, ws, y, start)
    else:
        for i in range(n):
            y[start + i] += ws.joints[i, ka.QDD]
    return energy


@internal_kernel
def settle(system: System, t, y, ws: Workspace, dy, run: Run):
    """Evaluate the derivative at y, projecting y first if needed; return False if the rows cannot be satisfied."""
    derivative(system, t, y, ws, dy)
    run.count[EVALUATIONS] += 1
    for _ in range(PROJECTION_LIMIT):
        if not off_surface(ws):
            return True
        project_level(system, ws, y, 0)
        project_level(system, ws, y, 1)
        derivative(system, t, y, ws, dy)
        run.count[EVALUATIONS] += 1
        run.count[PROJECTIONS] += 1
    return not off_surface(ws)


# Dense output: the state at any time within a step, from which the samples of the record are computed.


@internal_kernel
def collocated(newton: NewtonArrays | None, j, whole):
    """Return the quadratic and cubic coefficients for entry j of the cubic through y, the stages and y + ``whole``."""
    if newton is None:  # resolved at compile time
        return 0.0, 0.0
    c0, c1 = NODE_RADAU[0], NODE_RADAU[1]
    first = (newton.z[0, j] / c0 - whole) / (1.0 - c0)
    bend = ((newton.z[1, j] / c1 - whole) / (1.0 - c1) - first) / (c1 - c0)
    return first - c0 * bend, bend


@internal_kernel
def fill_dense(run: Run):
    """Compute the coefficients of the dense output over the step from y to y_new, see ``Run.dense``."""
    h, y, y_new, k, d, b = run.clock[STEP], run.y, run.y_new, run.stage, run.dense, run.quartic
    for j in range(y.shape[0]):
        d[0, j] = y_new[j] - y[j]
        d[3, j] = 0.0
        if run.dense_kind == LINEAR:
            d[1, j], d[2, j] = 0.0, 0.0
        elif run.dense_kind == HERMITE:
            d[1, j] = h * k[0, j] - d[0, j]
            d[2, j] = d[0, j] - h * k[6, j] - d[1, j]
            bend = b[0] * k[0, j]
            for s in range(1, 7):
                bend += b[s] * k[s, j]
            d[3, j] = h * bend
        else:
            d[1, j], d[2, j] = collocated(run.newton, j, d[0, j])


@internal_kernel
def interpolate(run: Run, t, out):
    """Write the state at time t from ``Run.dense`` to out, (m,); clamp times that are beyond the end by rounding."""
    d, x = run.dense, min((t - run.clock[TIME]) / run.clock[STEP], 1.0)
    z = 1.0 - x
    for j in range(out.shape[0]):
        out[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))


@kernel
def state_within(run: Run, t, out):
    """Write the state at a time within the pending step, from the dense output, to out, (m,)."""
    fill_dense(run)
    interpolate(run, t, out)


@inline_kernel
def sample_step(system: System, ws: Workspace, run: Run):
    """Record every sample time within the step from TIME to TIME + STEP, from the dense output.

    Samples are projected in the same way as steps, so that recorded gaps satisfy the same tolerance.
    """
    t, h = run.clock[TIME], run.clock[STEP]
    first = run.count[SAMPLE] + waiting_samples(run.newton)
    last = first
    # Rounding of t + h must not lose a sample at END.
    until = run.clock[END] if t + h >= run.clock[END] - 1e-12 * max(1.0, run.clock[END]) else t + h
    if last >= run.sample_time.shape[0] or run.sample_time[last] > until:
        return
    fill_dense(run)
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        interpolate(run, run.sample_time[last], run.sample[last])
        if system.layout.extra > 0:
            normalise(system.model, run.sample[last], system.layout.q)
        last += 1
    write_samples(run.newton, system, ws, run, last - first)


@internal_kernel
def write_sample(system: System, ws: Workspace, run: Run):
    """Project and record the next sample, whose state has already been computed."""
    s = run.count[SAMPLE]
    settle(system, run.sample_time[s], run.sample[s], ws, run.stage[7], run)
    write_output(system, ws, run, s)
    run.count[SAMPLE] = s + 1


@internal_kernel
def sampled_now(run: Run):
    """Return whether the last recorded sample is at TIME, up to rounding."""
    s, t = run.count[SAMPLE] - 1, run.clock[TIME]
    return s >= 0 and abs(run.sample_time[s] - t) <= 1e-12 * max(1.0, abs(t))


@internal_kernel
def rewrite_sample(system: System, ws: Workspace, run: Run):
    """Record the sample at TIME again after commands, loads or modes have jumped, with the values from now on.

    Call this function right after a start: ``ws`` must belong to the present state, and still does afterwards.
    """
    if not sampled_now(run):
        return
    run.count[SAMPLE] -= 1
    row = run.sample[run.count[SAMPLE]]
    for j in range(row.shape[0]):
        row[j] = run.y[j]
    write_sample(system, ws, run)


@internal_kernel
def write_samples(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run, more):
    """Record ``more`` samples whose states are known; with SIMD lanes, up to three of them wait for later samples."""
    for _ in range(more):
        write_sample(system, ws, run)


@internal_kernel
def write_waiting(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """Record the samples that wait for later samples, because something other than a step comes next."""


@internal_kernel
def waiting_samples(newton: NewtonArrays | None):
    """Return the number of samples whose states are known but not yet recorded."""
    if newton is None:  # resolved at compile time
        return 0
    return newton.count[kn.WAITING]
