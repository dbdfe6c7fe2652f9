"""One step of time stepping, its ledger, its samples, and the driver; the method is that of ``time_stepping``."""

from __future__ import annotations

from dynsim.kernels.arrays import (
    APPLIED,
    CIRCUIT,
    DAMPING,
    DRIVEN,
    FIRST_ROW,
    FORCE,
    GAP,
    GEAR_DAMPING,
    MODE,
    NORMAL_FORCE,
    OPEN,
    QD,
    QDD,
    ROWS,
    SLIDING,
    STICKING,
    ModelArrays,
    Q,
    Workspace,
)
from dynsim.kernels.constraint.unilateral import (
    CLOSED_TIME,
    DEEPEST,
    HITS,
    LANDINGS,
    LIFT_OFFS,
    LOSS,
    SLIP_STARTS,
    STOP_BEFORE,
    STOP_CLOSED,
    STOP_LOSS,
    STOP_ROW,
    UnilateralArrays,
    note_stop_forces,
)
from dynsim.kernels.drive.law import drive, take_commands
from dynsim.kernels.integrate.balance import begin_energy, drive_work, midpoint_work, stored_energy
from dynsim.kernels.integrate.contact_events import (
    LANDING,
    LIFT_OFF,
    LOG_KINDS,
    SLIP_START,
    SLIP_STOP,
    STOP_HIT,
    STOP_LEFT,
    log,
)
from dynsim.kernels.integrate.events import take_ticks
from dynsim.kernels.integrate.output import write_output
from dynsim.kernels.integrate.run import (
    CONTACT_LOG,
    END,
    EVALUATIONS,
    HOLD,
    LOGGED,
    NOT_FINITE,
    PENDING,
    PROPOSED,
    SAMPLE,
    STARTED,
    STATUS,
    STEP,
    STEPS,
    STOP_LOG,
    TAKE_COMMANDS,
    TICKED,
    TIME,
    Run,
)
from dynsim.kernels.integrate.steps import choose_step, finished, finite, stalled
from dynsim.kernels.integrate.time_stepping import (
    ACCELERATION,
    APPLIED_THEN,
    BAD,
    FREE,
    MAGNETIC,
    PENETRATION,
    PER,
    START,
    STOP,
    TAKEN,
    V_BIAS,
    V_START,
    SteppingArrays,
    close_contacts,
    constraint_rates,
    geometry,
    implicit_drives,
    moved,
    place_joints,
    slip_of_rates,
    solve_contacts,
    tangent_rows,
)
from dynsim.kernels.integrate.time_stepping import MECHANICAL as ENERGY
from dynsim.kernels.integrate.watch import watch
from dynsim.kernels.jit import free_kernel, internal_kernel
from dynsim.kernels.ledger import drive_powers
from dynsim.kernels.state import (
    CONSTRAINT,
    CONTACT_SIZE,
    DRAWN,
    ELECTRICAL,
    ENERGIES,
    FRICTION,
    GEAR,
    IMPACT_LOSS,
    IMPULSE,
    JOINT,
    JOINT_STOP_LOSS,
    JOULE,
    MECHANICAL,
    OUT_MODE,
    OUTPUTS_PER_CONTACT,
    SLIP,
    SUPPLY,
)
from dynsim.kernels.system import System
from dynsim.kernels.tree.angles import sine_cosine
from dynsim.kernels.tree.articulated import accelerate, add_row_forces, factor, row_system
from dynsim.kernels.tree.joints import normalise
from dynsim.kernels.tree.loads import add_loads


@internal_kernel
def step_moreau(system: System, ws: Workspace, run: Run):
    """One step from y to y_new; mean accelerations and forces stay in the workspace."""
    s, t, h, y, y_new, layout = run.stepping, run.clock[TIME], run.clock[STEP], run.y, run.y_new, system.layout
    joints, theta, n = ws.joints, s.theta, ws.joints.shape[0]
    model = ModelArrays(system.model.tree, s.body, system.model.gravity, system.model.compound)
    v0, v_bias, last, applied = s.before[V_START], s.before[V_BIAS], s.before[ACCELERATION], s.before[APPLIED_THEN]
    begin_energy(system, ws, run)
    place_joints(system, ws, y)
    if layout.extra > 0:  # rolling bases move along their heading, whatever was swept last
        sine_cosine(joints, ws.trig)
    for i in range(n):
        v0[i] = y[layout.v + i]
        v_bias[i] = v0[i] + theta * h * last[i]
        joints[i, Q] += h * theta * v0[i]
        joints[i, QD], joints[i, QDD] = v0[i], v0[i]
        joints[i, APPLIED] = -(model.body[i, DAMPING] + model.body[i, GEAR_DAMPING]) * v0[i]
    drive(system.drives, system.reference, t + theta * h, y, layout, ws)
    implicit_drives(system, s, ws, h)
    for i in range(n):
        applied[i] = joints[i, APPLIED]

    moved(system, ws, y, 0.5 * h, y_new)
    place_joints(system, ws, y_new)
    for i in range(n):
        joints[i, QD], joints[i, QDD] = v_bias[i], 0.0
    geometry(system, model, s, ws)
    if close_contacts(system, s, ws):
        # The last acceleration tells nothing of the next one.
        for i in range(n):
            joints[i, QD], last[i] = v0[i], 0.0
        geometry(system, model, s, ws)
    if system.loads.table.shape[0] > 0:
        add_loads(model, system.loads, t + theta * h, ws, run.stage[1], layout.load)
    tangent_rows(system, s, ws)
    factor(model, ws)
    constraint_rates(model, ws, y, layout.v, s.rate[0])
    if ws.counts[ROWS] > 0:
        row_system(model, ws)
        solve_contacts(system.unilateral, s, ws, h)
        note_stop_forces(system.unilateral, ws)
        add_row_forces(model, ws)
    accelerate(model, ws)
    run.count[EVALUATIONS] += 1

    for i in range(n):
        last[i] = joints[i, QDD]
        joints[i, QDD] = v0[i] + theta * h * last[i]
    moved(system, ws, y, h, y_new)
    for i in range(n):
        y_new[layout.v + i] = v0[i] + h * last[i]
        joints[i, QDD] = last[i]
    constraint_rates(model, ws, y_new, layout.v, s.rate[1])
    for a in range(ws.motors.shape[0]):
        k, j = system.drives.table[a, CIRCUIT], system.drives.table[a, DRIVEN]
        if k >= 0:
            y_new[layout.current + k] = (
                y[layout.current + k] + s.eliminated[a, FREE] + s.eliminated[a, PER] * h * last[j]
            )
    book(system, ws, run)


@internal_kernel
def book(system: System, ws: Workspace, run: Run):
    """The ledger of the step into y_new: power at x_θ, and what contacts and couplings have done."""
    s, t, h, y, y_new, layout = run.stepping, run.clock[TIME], run.clock[STEP], run.y, run.y_new, system.layout
    joints, theta, n = ws.joints, s.theta, ws.joints.shape[0]
    between, body = run.stage[2], system.model.body
    # Of the sweep at the midpoint, before others overwrite it.
    stored = -midpoint_work(system.model, ws, s.before[V_START], s.before[ACCELERATION], h)
    if system.loads.table.shape[0] > 0:
        # Once more, for their powers at the mean velocities that are in the links now.
        add_loads(system.model, system.loads, t + theta * h, ws, run.stage[1], layout.load)
    for j in range(y.shape[0]):
        between[j] = y[j] + theta * (y_new[j] - y[j])
    gear, joint = 0.0, 0.0
    place_joints(system, ws, y)
    for i in range(n):
        v = between[layout.v + i]
        joints[i, Q] += h * theta * v
        joints[i, QD], joints[i, APPLIED] = v, 0.0
        gear += body[i, GEAR_DAMPING] * v * v
        joint += body[i, DAMPING] * v * v
    drive(system.drives, system.reference, t + theta * h, between, layout, ws)
    electrical, drawn, joule, mechanical, drag = drive_powers(system.drives, ws)
    stored += drive_work(system, ws, run)
    held, friction, first = 0.0, 0.0, layout.contact
    for r in range(ws.counts[ROWS]):
        held += 0.5 * ws.rows[r, FORCE] * (s.rate[0, r] + s.rate[1, r])
    for k in range(ws.contacts.shape[0]):
        ws.contacts[k, NORMAL_FORCE], motion = 0.0, OPEN
        if ws.active[k, MODE] == STICKING:
            r = ws.active[k, FIRST_ROW]
            x, z = 0.5 * (s.rate[0, r + 1] + s.rate[1, r + 1]), 0.5 * (s.rate[0, r + 2] + s.rate[1, r + 2])
            power = ws.rows[r + 1, FORCE] * x + ws.rows[r + 2, FORCE] * z
            friction -= power
            held -= power
            ws.contacts[k, NORMAL_FORCE] = ws.rows[r, FORCE]
            s.found[PENETRATION] = max(s.found[PENETRATION], -ws.contacts[k, GAP])
            y_new[first + SLIP] += h * slip_of_rates(s, k, x, z)
            y_new[first + IMPULSE] += h * ws.rows[r, FORCE]
            motion = SLIDING if slip_of_rates(s, k, s.rate[1, r + 1], s.rate[1, r + 2]) > BAD else STICKING
        s.motion[k] = motion
        first += CONTACT_SIZE
    start = layout.ledger
    y_new[start + ELECTRICAL] += h * electrical
    y_new[start + DRAWN] += h * drawn
    y_new[start + JOULE] += h * joule
    y_new[start + GEAR] += h * (gear + drag)
    y_new[start + JOINT] += h * joint
    y_new[start + FRICTION] += h * friction
    y_new[start + CONSTRAINT] += h * held
    book_losses(system.unilateral, system, s, ws, y_new, h)
    y_new[start + MECHANICAL] += h * mechanical
    y_new[start + SUPPLY] += h * max(electrical, 0.0)
    for k in range(system.loads.table.shape[0]):
        y_new[layout.load + k] += h * run.stage[1, layout.load + k]
    stored_energy(system, ws, y_new, s.energy[STOP])
    y_new[layout.scheme] -= stored + (s.energy[STOP, ENERGY] - s.energy[START, ENERGY])
    if abs(y_new[layout.scheme]) > abs(s.found[TAKEN]):
        s.found[TAKEN] = y_new[layout.scheme]


@internal_kernel
def tell_changes(unilateral: UnilateralArrays, s: SteppingArrays, run: Run):
    """Log and count what the accepted step has changed, at its end; True when the caller is to empty the log.

    What a contact begins with is no event.
    """
    tally, table, stop = unilateral.tally, unilateral.stop_table, unilateral.stop
    for k in range(s.told.shape[0]):
        before, now = s.told[k], s.motion[k]
        s.told[k] = now
        if before < 0 or before == now:
            continue
        if now == OPEN:
            kind = LIFT_OFF
            tally[k, LIFT_OFFS] += 1.0
        elif before == OPEN:
            kind = LANDING
            tally[k, LANDINGS] += 1.0
        elif now == SLIDING:
            kind = SLIP_START
            tally[k, SLIP_STARTS] += 1.0
        else:
            kind = SLIP_STOP
        log(run, CONTACT_LOG + LOG_KINDS * k + kind)
    for k in range(table.shape[0]):
        closed = table[k, STOP_CLOSED] == 1
        if run.count[STEPS] > 1 and table[k, STOP_CLOSED] != table[k, STOP_BEFORE]:
            stop[k, HITS] += 1.0 if closed else 0.0
            log(run, STOP_LOG + LOG_KINDS * k + (STOP_HIT if closed else STOP_LEFT))
        table[k, STOP_BEFORE] = table[k, STOP_CLOSED]
    return run.count[LOGGED] + s.told.shape[0] + table.shape[0] > run.log_time.shape[0]


@internal_kernel
def book_losses(unilateral: UnilateralArrays, system: System, s, ws: Workspace, y_new, h):
    """What normals and joint stops take is a loss, not an error of the constraints."""
    layout, tally = system.layout, unilateral.tally
    for k in range(unilateral.stop.shape[0]):
        if unilateral.stop_table[k, STOP_CLOSED] == 0:
            continue
        r = unilateral.stop_table[k, STOP_ROW]
        work = 0.5 * h * ws.rows[r, FORCE] * (s.rate[0, r] + s.rate[1, r])
        unilateral.stop[k, CLOSED_TIME] += h
        unilateral.stop[k, STOP_LOSS] -= work
        y_new[layout.loss + JOINT_STOP_LOSS] -= work
        y_new[layout.ledger + CONSTRAINT] -= work
    for k in range(ws.contacts.shape[0]):
        if ws.active[k, MODE] == STICKING:
            r = ws.active[k, FIRST_ROW]
            work = 0.5 * h * ws.rows[r, FORCE] * (s.rate[0, r] + s.rate[1, r])
            y_new[layout.loss + IMPACT_LOSS] -= work
            y_new[layout.ledger + CONSTRAINT] -= work
            tally[k, LOSS] -= work
            tally[k, DEEPEST] = max(tally[k, DEEPEST], -ws.contacts[k, GAP])
        tally[k, s.motion[k]] += h  # the times in the order of the modes


@internal_kernel
def sample_moreau(system: System, ws: Workspace, run: Run):
    """Record every sample time within the step, the state linear in between; forces are the means of the step."""
    t, h, last, clock = run.clock[TIME], run.clock[STEP], run.count[SAMPLE], run.clock
    s = run.stepping
    until = t + h + 1e-12 * max(1.0, clock[END])
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        x = min(max((run.sample_time[last] - t) / h, 0.0), 1.0)
        row = run.sample[last]
        for j in range(row.shape[0]):
            row[j] = run.y[j] + x * (run.y_new[j] - run.y[j])
        if system.layout.extra > 0:
            normalise(system.model.compound, system.model, row, system.layout.q)
        place_joints(system, ws, row)
        for i in range(ws.joints.shape[0]):
            ws.joints[i, QD], ws.joints[i, APPLIED] = row[system.layout.v + i], 0.0
        drive(system.drives, system.reference, run.sample_time[last], row, system.layout, ws)
        geometry(system, system.model, s, ws)
        write_output(system, ws, run, last)
        # What lies between the ends of a step is linear, energy is not.
        between = -(1.0 - x) * (s.energy[START, ENERGY] + s.energy[START, MAGNETIC])
        between -= x * (s.energy[STOP, ENERGY] + s.energy[STOP, MAGNETIC])
        for k in range(ENERGIES):
            between += run.output[last, run.columns.energy + k]
        row[system.layout.scheme] -= between
        for k in range(ws.contacts.shape[0]):
            # The rows are those of sticking even where it slides.
            run.output[last, run.columns.contact + k * OUTPUTS_PER_CONTACT + OUT_MODE] = s.motion[k]
        last += 1
    run.count[SAMPLE] = last


@internal_kernel
def commands_due(system: System, ws: Workspace, run: Run):
    """Take sampled commands where they are due; True when the caller is to look."""
    due = take_ticks(run)
    if due & TAKE_COMMANDS:
        place_joints(system, ws, run.y)
        for i in range(ws.joints.shape[0]):
            ws.joints[i, QD] = run.y[system.layout.v + i]
        take_commands(system.drives, system.reference, run.clock[TIME], ws)
    run.count[TICKED] = due & ~TAKE_COMMANDS
    if run.count[STARTED] == 0:
        run.count[STARTED] = 1
        for i in range(ws.joints.shape[0]):
            run.stepping.before[ACCELERATION, i] = 0.0
    return run.count[TICKED] != 0


@free_kernel
def advance_moreau(system: System, ws: Workspace, run: Run, limit):
    """``advance`` of time stepping."""
    clock, count, taken = run.clock, run.count, 0
    if limit < 0:
        return
    while not commands_due(system, ws, run):
        if finished(run) or taken >= limit or stalled(run):
            return
        taken += 1
        if count[PENDING] == 0:
            clock[PROPOSED] = clock[STEP]
            choose_step(run)
            step_moreau(system, ws, run)
            if not finite(run.y_new):
                count[STATUS] = NOT_FINITE
                return
            if clock[TIME] + clock[STEP] > clock[HOLD]:
                count[PENDING] = 1
                return
        count[PENDING] = 0
        watch(ws, run, clock[STEP])
        sample_moreau(system, ws, run)
        for j in range(run.y.shape[0]):
            run.y[j] = run.y_new[j]
        clock[TIME] += clock[STEP]
        clock[STEP] = clock[PROPOSED]
        count[STEPS] += 1
        if tell_changes(system.unilateral, run.stepping, run):
            return
