"""Arrays of one integration: state, recorded rows, clock, counters, events, ticks; its methods and statuses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import delassus as kq
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.delassus import force_verdict, solve_small
from dynsim.dynamics.contact.rows import force_vectors, row_errors
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.ledger import kinetic_energy, magnetic_energy, potential_energy
from dynsim.dynamics.simd.forms import stage_lanes
from dynsim.dynamics.state import OutputLayout, StateLayout, block
from dynsim.dynamics.tables import Workspace, row_limit, workspace
from dynsim.dynamics.tree import support as ks
from dynsim.dynamics.tree.articulated import accelerate
from dynsim.dynamics.tree.joints import displace, normalise, point_position
from dynsim.dynamics.tree.support import SupportArrays, ground_reaction, no_support
from dynsim.integrators import methods
from dynsim.integrators.radau5 import tables as kn
from dynsim.integrators.radau5.tables import NODE_RADAU, NewtonArrays, newton_arrays
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import inline_kernel, integers, internal_kernel, kernel, reals

# Run.method
DOPRI5, RADAU5, TIME_STEPPING = methods.DOPRI5.number, methods.RADAU5.number, methods.TIME_STEPPING.number
LINEAR, HERMITE = methods.LINEAR, methods.HERMITE

RUNNING, FINISHED, NOT_FINITE, STEP_TOO_SMALL, NOT_PROJECTED, NO_FORCES = 0, 1, 2, 3, 4, 5
FORCES_REVERSED, SEVERAL_FORCES, STOPPED = 6, 7, 8
# Under the unilateral law: no forces agree with Coulomb's law; modes change without end.
NO_CONTACT_FORCES, CHATTER = 9, 10
# MOST_TRIALS steps made hardly any progress. Set by the caller: the wall time limit is over; a step does not end.
NO_PROGRESS, OUT_OF_TIME, STUCK = 11, 12, 13

# Run.clock
TIME, STEP, LAST_ERROR, END, RTOL, ATOL, STEP_MAX = 0, 1, 2, 3, 4, 5, 6
NOT_UNIQUE = 7  # end of the step at which the contact forces were not unique, which was not accepted [s]
# A step that would end beyond HOLD is left pending, not accepted; the step size proposed before a cut; error norm of
# the step taken; the bracket of the root that is searched, from TIME on [s].
HOLD, PROPOSED, ERROR, LOW, HIGH = 8, 9, 10, 11, 12
# Time at which trials were last counted from zero, and the least that MOST_TRIALS of them have to come on by [s].
COUNTED_SINCE, LEAST_PROGRESS = 13, 14
INNER = 15  # 2: the parts of the step at which guards are noted within it
CLOCK_SIZE = 17
# Run.count, int
STEPS, REJECTED, EVALUATIONS, PROJECTIONS, SAMPLE, STATUS, STARTED = 0, 1, 2, 3, 4, 5, 6
# A step waits to be accepted; trials of a root; which end of the bracket moved last; the step ends at an event; it ends
# at a tick; events in the log; bits of the ticks that the caller is to look at.
PENDING, SEARCHING, TURNED_BACK, FIRED, TRIMMED, LOGGED, TICKED = 7, 8, 9, 10, 11, 12, 13
NEXT_BREAK = 14  # index of the first of Run.breaks that is not past
MODES_DUE = 15  # contact modes are to be chosen at the next start, which is that of the run, or follows a jump of rates
GRAZING = 16  # how often the step was shortened because it passed over something
TRIALS = 17  # steps tried, accepted or not, since COUNTED_SINCE
ASKED = 18  # written by another thread: the piece is to end at the next step
COUNT_SIZE = 19
# Steps that are looked at together, and the part of a run's duration that they have to come on by.
MOST_TRIALS, PROGRESS = 10_000, 1e-6
AT_START, AFTER_JUMP = 1, 2
# Run.event, and Run.event_table, int
EVENT_LEVEL, SIDE, START_VALUE, VALUE, AT_LOW, AT_HIGH = 0, 1, 2, 3, 4, 5
INNER_VALUE = 6  # 2: at INNER
EVENT_SIZE = 8
EVENT_KIND, EVENT_INDEX, DIRECTION, ON_EVENT = 0, 1, 2, 3
EVENT_TABLE_SIZE = 4
# What an event does besides being logged: nothing, the caller looks, the run ends.
LOG, RETURN, STOP = 0, 1, 2
# Run.tick, and Run.tick_table, int. Kinds are bits.
TICK_PERIOD, TICK_NEXT, TICK_PHASE = 0, 1, 2
TICK_SIZE = 3
TICK_KIND, TICK_COUNT = 0, 1
TICK_TABLE_SIZE = 2
TAKE_COMMANDS, CALLER = 1, 2
LOG_LENGTH = 1024
GAPS_SIZE = 10
# Entries of Run.log_event from these numbers on are of contacts, of joint stops, and of joints with dry friction, see
# contact_events.
CONTACT_LOG, STOP_LOG, DRY_LOG = 1 << 20, 1 << 40, 1 << 50
# Run.extremes, per contact
FORCE_MIN, FORCE_MAX, DRIFT_MAX = 0, 1, 2
PULLING, LAST_FORCE = 3, 4  # time with a negative normal force [s]; normal force at the last accepted step [N]
LOCAL_SINCE = 5  # first time at which the contact's entry on the diagonal of J M⁻¹ F was negative [s], else inf
EXTREMES_SIZE = 6


class Run(NamedTuple):
    """The moving part of one simulation; m is the length of the state."""

    method: int
    dense_kind: int  # see dynsim.integrators.methods
    layout: StateLayout
    y: np.ndarray  # (m,) state at TIME
    y_new: np.ndarray  # (m,)
    stage: np.ndarray  # (8, m) stage derivatives; stage[0] belongs to y
    dense: np.ndarray  # (4, m) y(θ) = y + θ (d0 + (1−θ)(d1 + θ (d2 + (1−θ) d3)))
    quartic: np.ndarray  # (7,) coefficients of d3 / h, by stage
    clock: np.ndarray  # (CLOCK_SIZE,)
    count: np.ndarray  # (COUNT_SIZE,) int
    extremes: np.ndarray  # (c, EXTREMES_SIZE)
    room: np.ndarray  # (ROOM, p, p) scratch for the most rows p, see dynsim.dynamics.contact.delassus
    hand_link: int
    hand_point: np.ndarray  # (3,) in the body's frame
    sample_time: np.ndarray  # (T,)
    sample: np.ndarray  # (T, m) states
    event: np.ndarray  # (e, EVENT_SIZE)
    event_table: np.ndarray  # (e, EVENT_TABLE_SIZE) int
    tick: np.ndarray  # (k, TICK_SIZE)
    tick_table: np.ndarray  # (k, TICK_TABLE_SIZE) int
    breaks: np.ndarray  # (b,) increasing times at which derivatives jump or bend: steps end there [s]
    log_time: np.ndarray  # (LOG_LENGTH,) of events [s]
    log_event: np.ndarray  # (LOG_LENGTH,) int: which
    hand: np.ndarray  # (3,) room
    gaps: np.ndarray  # (c, GAPS_SIZE) gaps, their rates, normals, positions and slip at the start of the step
    support: SupportArrays
    columns: OutputLayout
    output: np.ndarray  # (T, columns.size)
    stepping: SteppingArrays | None  # of time stepping alone
    newton: NewtonArrays | None  # of radau5 alone

    def states(self, name: str) -> np.ndarray:
        """A block of the sampled states by its name, see :func:`dynsim.dynamics.state.block`."""
        return self.sample[: self.count[SAMPLE], block(self.layout, name)]

    def outputs(self, name: str) -> np.ndarray:
        """Columns of the samples' outputs by their name; those of contacts are (T, c, OUTPUTS_PER_CONTACT)."""
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
    """Allocate a :class:`Run` from t = 0 at state y, (layout.size,).

    ``least_progress``: of MOST_TRIALS steps [s]; default: PROGRESS of the run until ``end``.
    ``lanes``: RADAU5 evaluates right-hand sides together, see dynsim.dynamics.simd.forms.has_forms.

    Raises
    ------
    ValueError
        For an unknown method, and for time stepping without the block ``scheme`` of the state.
    """
    m, p, table = len(y), row_limit(c, couplings), methods.by_number(method)
    if method == TIME_STEPPING and layout.size == layout.scheme:
        raise ValueError("the state has no room for the scheme's energy, see dynsim.dynamics.state")
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


# Statistics of accepted steps: extremes of contact forces and gaps, time of pulling; uniqueness of the forces.


@internal_kernel
def watch(ws: Workspace, run: Run, h):
    """Extremes of normal forces and gaps at accepted steps; time of pulling, the force linear within the last step."""
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
    """True when the contacts determine their forces at time t, right after ``derivative``; else sets STATUS."""
    verdict = force_verdict(ws, run.room, run.extremes[:, LOCAL_SINCE], t)
    if verdict == kq.UNIQUE:
        return True
    run.count[STATUS] = FORCES_REVERSED if verdict == kq.REVERSED else SEVERAL_FORCES
    run.clock[NOT_UNIQUE] = t
    return False


# Recorded outputs of a sample that are not states: accelerations, drives, hand, energies, contacts, support.


@internal_kernel
def write_output(system: System, ws: Workspace, run: Run, row):
    """All recorded outputs that are not states, after ``derivative``, into the columns of OutputLayout."""
    fill_output(system, ws, run, run.output[row])
    write_support(system, ws, run, row)


@internal_kernel
def fill_output(system: System, ws: Workspace, run: Run, out):
    """The same without the ground reactions of a mobile base, into out (columns.size,); also for lanes."""
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
        k += kst.OUTPUTS_PER_CONTACT
    row_forces(system.unilateral, out[columns.stop :], out[columns.dry :], out[columns.tie :])


@internal_kernel
def fill_energies(system: System, ws: Workspace, run: Run, out):
    """Kinetic, potential and magnetic energy of the last sweep and its currents."""
    energy = run.columns.energy
    out[energy] = kinetic_energy(system.model, ws)
    out[energy + 1] = potential_energy(system.model, ws)
    out[energy + 2] = magnetic_energy(system.drives, ws)


@internal_kernel
def fill_drives(system: System, ws: Workspace, run: Run, out):
    """Currents, voltages and shaft torques of the motors, at the accelerations that are in ``out``."""
    joints, motors, motor, columns = ws.joints, ws.motors, system.drives.motor, run.columns
    for a in range(motors.shape[0]):
        i = system.drives.table[a, ka.DRIVEN]
        out[columns.current + a] = motors[a, ka.CURRENT]
        out[columns.voltage + a] = motors[a, ka.VOLTAGE]
        steady = steady_torque(motor, motors, a, joints[i, ka.QD])
        out[columns.torque + a] = with_rotor(run.stepping, steady, motor[a, ka.J_M] * out[columns.vdot + i], a)


@internal_kernel
def steady_torque(motor, motors, a, v):
    """Shaft torque of motor a at a constant rate v [N m or N]."""
    return motor[a, ka.K_M] * motors[a, ka.CURRENT] - motor[a, ka.D_M] * v - motors[a, ka.DRAG] - motors[a, ka.DRY_DRAG]


@internal_kernel
def with_rotor(stepping: SteppingArrays | None, steady, inertial, a):
    """Shaft torque of motor a at a constant rate, ``steady``, less what its rotor takes, ``inertial``.

    Recorded torques are without impulses. In the steps of an impact, whose accelerations have one in them, the torque
    stays as it was in the last step without; at the start of a run it is ``steady``.
    """
    if stepping is None:  # known to the compiler
        return steady - inertial
    if stepping.grid[kt.HELD_STEPS] == 0.0:
        return steady - inertial
    return stepping.torque[a] if stepping.torque[a] == stepping.torque[a] else steady


@internal_kernel
def row_forces(unilateral: UnilateralArrays | None, stop, dry, tie):
    """Forces of joint stops, (s,), of dry frictions, (d,), and of ties, (e,), or more."""
    if unilateral is None:  # known to the compiler
        return
    for k in range(unilateral.stop.shape[0]):
        stop[k] = unilateral.stop[k, ku.STOP_FORCE]
    for k in range(unilateral.dry.shape[0]):
        dry[k] = unilateral.dry[k, ku.DRY_FORCE]
    for k in range(unilateral.tie.shape[0]):
        tie[k] = unilateral.tie[k, ku.TIE_FORCE]


@internal_kernel
def write_support(system: System, ws: Workspace, run: Run, row):
    """What the ground carries of a mobile base, into the columns ``support``."""
    if run.support.index.shape[0] == 0:
        return
    ground_reaction(system.model, system.loads, run.sample_time[row], ws, run.support)
    for s in range(ks.OUTPUTS):
        run.output[row, run.columns.support + s] = run.support.state[s]


# Projection of positions and rates onto the active constraint rows.


# A tenth of the specified drift (1e-9 m), and a rate that adds less than that in a step [m, m/s; rad, rad/s].
GAP_TOLERANCE = 1e-10
RATE_TOLERANCE = 1e-8
PROJECTION_LIMIT = 6


@internal_kernel
def off_surface(ws: Workspace):
    """True when the state has left an active row by more than the projection tolerances."""
    state, rows, active = ws.contacts, ws.rows, ws.active
    row_errors(ws)
    for r in range(ws.counts[ka.ROWS]):
        # Rounding limits the rate to a fraction of the speed.
        if active[r, ka.ROW_KIND] == ka.JOINT_ROW:
            speed = abs(rows[r, ka.ROW + 1] * ws.joints[active[r, ka.BODY_B], ka.QD])
        else:
            k = active[r, ka.OWNER]
            x, y, z = state[k, ka.SLIP_VELOCITY], state[k, ka.SLIP_VELOCITY + 1], state[k, ka.SLIP_VELOCITY + 2]
            speed = math.sqrt(x * x + y * y + z * z)
        if abs(rows[r, ka.ROW_GAP]) > GAP_TOLERANCE or abs(rows[r, ka.ROW_RATE]) > RATE_TOLERANCE * (1.0 + speed):
            return True
    return False


@internal_kernel
def project(system: System, ws: Workspace, y):
    """One Newton step of q and v onto the active rows, weighted by the mass matrix, right after :func:`off_surface`.

    dq = −M⁻¹ Jᵀ λ with J M⁻¹ Jᵀ λ = gap, and the same for v with J v: the nearest point in the kinetic metric. The
    factors of M + J_m and the eliminated rows are those that the derivative has left in the workspace.
    """
    project_level(system, ws, y, 0)
    project_level(system, ws, y, 1)


@internal_kernel
def project_level(system: System, ws: Workspace, y, level):
    """Positions (level 0) or rates (1) of :func:`project`; returns ½ λᵀ J v, the kinetic energy that rates lose [J]."""
    state, active, column, small = ws.rows, ws.active, ws.column, ws.small
    n, p = ws.joints.shape[0], ws.counts[ka.ROWS]
    start = system.layout.q if level == 0 else system.layout.v
    for k in range(p):
        state[k, ka.RHS] = state[k, ka.ROW_GAP] if level == 0 else state[k, ka.ROW_RATE]
        for m in range(p):
            small[0, k, m] = 0.0
            for i in range(n):
                small[0, k, m] += column[i, 1 + 2 * k] * column[i, 1 + 2 * m] * ws.links[i, ka.INVERSE_D]
    solve_small(small, state, active, p)
    energy = 0.0
    for k in range(p):
        energy += 0.5 * state[k, ka.FORCE] * state[k, ka.RHS]
    for i in range(n):
        column[i, 0] = 0.0
        for k in range(p):
            column[i, 0] -= state[k, ka.FORCE] * column[i, 1 + 2 * k]
    accelerate(system.model, ws)
    if level == 0 and system.layout.extra > 0:
        displace(system.model, ws, y, start)
    else:
        for i in range(n):
            y[start + i] += ws.joints[i, ka.QDD]
    return energy


@internal_kernel
def settle(system: System, t, y, ws: Workspace, dy, run: Run):
    """Derivative at y, projecting y first where needed. Returns False when the rows cannot be met."""
    derivative(system, t, y, ws, dy)
    run.count[EVALUATIONS] += 1
    for _ in range(PROJECTION_LIMIT):
        if not off_surface(ws):
            return True
        project(system, ws, y)
        derivative(system, t, y, ws, dy)
        run.count[EVALUATIONS] += 1
        run.count[PROJECTIONS] += 1
    return not off_surface(ws)


# Dense output: the state anywhere within a step, and the samples of the record from it.


@internal_kernel
def collocated(newton: NewtonArrays | None, j, whole):
    """Quadratic and cubic coefficient of entry j, of the cubic through y, the stages and y_new = y + ``whole``."""
    if newton is None:  # known to the compiler
        return 0.0, 0.0
    c0, c1 = NODE_RADAU[0], NODE_RADAU[1]
    first = (newton.z[0, j] / c0 - whole) / (1.0 - c0)
    bend = ((newton.z[1, j] / c1 - whole) / (1.0 - c1) - first) / (c1 - c0)
    return first - c0 * bend, bend


@internal_kernel
def fill_dense(run: Run):
    """Coefficients of the dense output over the step from y to y_new, see ``Run.dense``."""
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
    """State at time t by ``Run.dense`` into out: (m,); of the rounding beyond the step's end nothing is made."""
    d, x = run.dense, min((t - run.clock[TIME]) / run.clock[STEP], 1.0)
    z = 1.0 - x
    for j in range(out.shape[0]):
        out[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))


@kernel
def state_within(run: Run, t, out):
    """State at a time within the step that is pending, by the dense output, into out: (m,)."""
    fill_dense(run)
    interpolate(run, t, out)


@inline_kernel
def sample_step(system: System, ws: Workspace, run: Run):
    """Record every sample time within the step from TIME to TIME + STEP, from the dense output.

    Samples are projected like steps are, so that recorded gaps hold the promised tolerance too.
    """
    t, h = run.clock[TIME], run.clock[STEP]
    first = run.count[SAMPLE] + waiting_samples(run.newton)
    last = first
    # A sample at END must not be lost to the rounding of t + h.
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
    """Project the next sample and record it, whose state is there."""
    s = run.count[SAMPLE]
    settle(system, run.sample_time[s], run.sample[s], ws, run.stage[7], run)
    write_output(system, ws, run, s)
    run.count[SAMPLE] = s + 1


@internal_kernel
def sampled_now(run: Run):
    """True where the last sample that was recorded is at TIME, apart from rounding."""
    s, t = run.count[SAMPLE] - 1, run.clock[TIME]
    return s >= 0 and abs(run.sample_time[s] - t) <= 1e-12 * max(1.0, abs(t))


@internal_kernel
def rewrite_sample(system: System, ws: Workspace, run: Run):
    """Record a sample at TIME again, after commands, loads or modes have jumped: it has their values from now on.

    Right after a start: ``ws`` is of the present state, and remains so.
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
    """Record so many ``more`` samples, whose states are there; on lanes up to three of them wait for the next ones."""
    for _ in range(more):
        write_sample(system, ws, run)


@internal_kernel
def write_waiting(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """Record the samples that wait for others: something else than a step comes next."""


@internal_kernel
def waiting_samples(newton: NewtonArrays | None):
    """Samples whose states are there and that are not recorded yet."""
    if newton is None:  # known to the compiler
        return 0
    return newton.count[kn.WAITING]
