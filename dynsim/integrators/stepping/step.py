"""Time stepping: one step, its ledger, samples and driver; the equations are in dynsim.integrators.stepping.tables."""

from __future__ import annotations

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.solids import remember_pairs
from dynsim.dynamics.contact.unilateral import UnilateralArrays, note_stop_forces
from dynsim.dynamics.derivative import System
from dynsim.dynamics.drive.law import drive, drive_on_segments, segment_of, take_commands
from dynsim.dynamics.ledger import damping_powers, drive_powers, kinetic_energy, potential_energy
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.articulated import accelerate, add_row_forces, factor, row_system
from dynsim.dynamics.tree.joints import normalise, sine_cosine
from dynsim.dynamics.tree.loads import add_loads
from dynsim.dynamics.tree.spatial import dot, point_velocity, put_six, six, times_inertia
from dynsim.dynamics.tree.sweep import body_inertia, forward_sweep, inertial_wrench
from dynsim.integrators import run as ki
from dynsim.integrators.contacts import events as ke
from dynsim.integrators.events import take_ticks
from dynsim.integrators.run import Run, fill_drives, fill_energies, sampled_now, steady_torque, watch, write_output
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.articulated_contacts import end_rates
from dynsim.integrators.stepping.contacts import (
    book_soft_contact,
    book_ties,
    list_contacts,
    note_contacts,
    rates_jumped,
    remember,
    restart_memory,
    slip_of_rates,
    solve_compliant,
    solve_contacts,
    strikes,
    tangent_rows,
)
from dynsim.integrators.stepping.free_bodies import balance_momentum
from dynsim.integrators.stepping.tables import (
    SteppingArrays,
    constraint_rates,
    geometry,
    moved,
    place_joints,
    place_state,
)
from dynsim.integrators.steps import choose_step, finished, finite, stalled
from dynsim.jit.kernel import free_kernel, internal_kernel

# Drives within a time-stepping step: implicit linear blocks, whose active limits are determined at x_θ.


# Maximum number of repetitions of a step to find the active limits of its drives; after ALL_AT_ONCE repetitions, only
# one drive changes at a time, because simultaneous changes may undo each other.
MOST_TRIES, ALL_AT_ONCE = 16, 4


@internal_kernel
def eliminate_currents(system: System, ws: Workspace, run: Run):
    """Write torques of drives and damping to APPLIED, and their implicit part to the ARMATURE of ``s.body``.

    The joints must be at (q + h θ v, v), and APPLIED must contain all other torques. With Δ = v' − v, i' − i is
    a + c Δ, and the torque at x_θ is τ + ∂τ/∂i θ a + (∂τ/∂q h θ² + ∂τ/∂v θ + ∂τ/∂i θ c) Δ.
    """
    s, h, body, joints, motors = run.stepping, run.clock[ki.STEP], system.model.body, ws.joints, ws.motors
    theta, drives = s.theta, system.drives
    drive_on_segments(
        drives, system.reference, run.clock[ki.TIME] + theta * h, run.y, system.layout, s.segment, ws, s.linear
    )
    for i in range(joints.shape[0]):
        damping = body[i, ka.DAMPING] + body[i, ka.GEAR_DAMPING]
        s.body[i, ka.ARMATURE] = body[i, ka.ARMATURE] + h * theta * damping
    for a in range(motors.shape[0]):
        j, linear, free, per = drives.table[a, ka.DRIVEN], s.linear[a], 0.0, 0.0
        if drives.table[a, ka.CIRCUIT] >= 0:
            scale = h / (1.0 - h * theta * linear[ka.RATE_I])
            free = scale * motors[a, ka.DIDT]
            per = scale * (linear[ka.RATE_Q] * h * theta * theta + linear[ka.RATE_V] * theta)
        s.eliminated[a, kt.FREE], s.eliminated[a, kt.PER], s.eliminated[a, kt.DIDT_THEN] = free, per, motors[a, ka.DIDT]
        joints[j, ka.APPLIED] += linear[ka.TORQUE_I] * theta * free
        slope = (
            linear[ka.TORQUE_Q] * h * theta * theta + linear[ka.TORQUE_V] * theta + linear[ka.TORQUE_I] * theta * per
        )
        s.body[j, ka.ARMATURE] -= h * slope


@internal_kernel
def drive_at_theta(system: System, ws: Workspace, run: Run):
    """Evaluate the drive laws at x_θ of the step to y_new; APPLIED then contains only the torques of the drives."""
    s, h, y, y_new, layout = run.stepping, run.clock[ki.STEP], run.y, run.y_new, system.layout
    between, theta = run.stage[2], s.theta
    for j in range(y.shape[0]):
        between[j] = y[j] + theta * (y_new[j] - y[j])
    place_joints(system, ws, y)
    for i in range(ws.joints.shape[0]):
        v = between[layout.v + i]
        ws.joints[i, ka.Q] += h * theta * v
        ws.joints[i, ka.QD], ws.joints[i, ka.APPLIED] = v, 0.0
    drive(system.drives, system.reference, run.clock[ki.TIME] + theta * h, between, layout, ws)


@internal_kernel
def limits_agree(system: System, ws: Workspace, run: Run, tries):
    """Return whether the active limits of the drives agree with their state at x_θ; if not, change the limits.

    Call this function after :func:`drive_at_theta`. On the way from one limit to the opposite limit, a drive passes
    through the unlimited segment between them. A light wheel would cross this segment within a step under either limit,
    so that each limit would lead to the other. For a motor with inductance, the voltage limits are between its current
    limits instead.
    """
    s, agree = run.stepping, True
    t = run.clock[ki.TIME] + s.theta * run.clock[ki.STEP]
    for a in range(ws.motors.shape[0]):
        segment = segment_of(system.drives, system.reference, t, ws, a)
        direct = system.drives.table[a, ka.DRIVE_KIND] == ka.DC_MOTOR and abs(segment) == 2
        if segment == -s.segment[a] and not direct:
            segment = 0
        if segment != s.segment[a] and (agree or tries < ALL_AT_ONCE):
            s.segment[a], agree = segment, False
    return agree


# Energy error of the time-stepping discretisation, which is the ledger term ``loss_scheme``.


@internal_kernel
def stored_energy(system: System, ws: Workspace, y, out):
    """Write the energies of bodies with rotors, and of coils, at y [J] to out, (2,), after a sweep at y."""
    layout, motor = system.layout, system.drives.motor
    place_state(system, ws, y)
    forward_sweep(system.model, ws, 1.0, 0.0, 1.0)
    out[kt.MECHANICAL] = kinetic_energy(system.model, ws) + potential_energy(system.model, ws)
    out[kt.MAGNETIC] = 0.0
    for a in range(ws.motors.shape[0]):
        k = system.drives.table[a, ka.CIRCUIT]
        if k >= 0:
            out[kt.MAGNETIC] += 0.5 * motor[a, ka.INDUCTANCE] * y[layout.current + k] * y[layout.current + k]


@internal_kernel
def begin_energy(system: System, ws: Workspace, run: Run):
    """Set the energy at the start of a step: the energy at the end of the last step, unless the state has changed."""
    energy, same = run.stepping.energy, True
    for j in range(system.layout.tracked):
        same = same and run.y[j] == run.y_new[j]
    # The energy is NaN before the first step.
    if same and energy[kt.STOP, kt.MECHANICAL] == energy[kt.STOP, kt.MECHANICAL]:
        for m in range(energy.shape[1]):
            energy[kt.START, m] = energy[kt.STOP, m]
    else:
        stored_energy(system, ws, run.y, energy[kt.START])


@internal_kernel
def midpoint_work(model: ModelArrays, ws: Workspace, v, vdot, h):
    """Return v̄·M Δ + h v̄·(c + g) at the midpoint [J], whose sweep is still in ``ws``.

    The link velocities for v̄ are left in V.

    Parameters
    ----------
    v, vdot : (n,) ndarray
        Rates at the start and mean acceleration; v̄ = v + h vdot / 2, Δ = h vdot.
    """
    tree, body, links = model.tree, model.body, ws.links
    inertia, bias = 0.0, 0.0
    for i in range(tree.shape[0]):
        m, c, I = body_inertia(model, ws, i)
        wrench = inertial_wrench(ws, i, m, c, I)
        j, rate, change = tree[i, ka.PARENT], v[i] + 0.5 * h * vdot[i], h * vdot[i]
        for s in range(6):
            links[i, ka.V + s] = links[i, ka.S + s] * rate + (links[j, ka.V + s] if j >= 0 else 0.0)
            links[i, ka.A + s] = links[i, ka.S + s] * change + (links[j, ka.A + s] if j >= 0 else 0.0)
        V, A = six(links, i, ka.V), six(links, i, ka.A)
        bias += dot(wrench, V)
        at_c, change_at_c, L = point_velocity(V, c), point_velocity(A, c), times_inertia(I, A)
        inertia += (
            V[0] * L[0]
            + V[1] * L[1]
            + V[2] * L[2]
            + m * (at_c[0] * change_at_c[0] + at_c[1] * change_at_c[1] + at_c[2] * change_at_c[2])
            + body[i, ka.ARMATURE] * rate * change
        )
    return inertia + h * bias


@internal_kernel
def drive_work(system: System, ws: Workspace, run: Run):
    """Return the energy created by linearising the drives and by evaluating their power at x_θ [J].

    APPLIED must contain the torques of the drives at x_θ.
    """
    s, h, y, y_new, layout = run.stepping, run.clock[ki.STEP], run.y, run.y_new, system.layout
    joints, motors, motor, body, theta = ws.joints, ws.motors, system.drives.motor, system.model.body, s.theta
    v, vdot, applied = s.before[kt.V_START], s.before[kt.ACCELERATION], s.before[kt.APPLIED_THEN]
    total = 0.0
    for i in range(joints.shape[0]):
        change = h * vdot[i]
        used = h * applied[i] - (s.body[i, ka.ARMATURE] - body[i, ka.ARMATURE]) * change
        law = joints[i, ka.APPLIED] - (body[i, ka.DAMPING] + body[i, ka.GEAR_DAMPING]) * joints[i, ka.QD]
        total += (v[i] + 0.5 * change) * used - h * joints[i, ka.QD] * law
    for a in range(motors.shape[0]):
        k, j = system.drives.table[a, ka.CIRCUIT], system.drives.table[a, ka.DRIVEN]
        if k >= 0:
            start, linear = y[layout.current + k], s.linear[a]
            more = y_new[layout.current + k] - start
            by_v = (linear[ka.RATE_Q] * h * theta + linear[ka.RATE_V]) * theta
            rate = s.eliminated[a, kt.DIDT_THEN] + by_v * h * vdot[j] + linear[ka.RATE_I] * theta * more
            total += (
                h * motor[a, ka.INDUCTANCE] * ((start + 0.5 * more) * rate - motors[a, ka.CURRENT] * motors[a, ka.DIDT])
            )
    return total


@internal_kernel
def step_moreau(system: System, ws: Workspace, run: Run):
    """Take one step from y to y_new; mean accelerations and forces are left in the workspace."""
    s, y, layout = run.stepping, run.y, system.layout
    v0, v_bias, last = s.before[kt.V_START], s.before[kt.V_BIAS], s.before[kt.ACCELERATION]
    model = ModelArrays(system.model.tree, s.body, system.model.gravity)
    begin_energy(system, ws, run)
    restart_memory(system, s, ws, y)
    # The mean acceleration of an impact does not predict the next step; the last step without an impact does.
    known = s.before[kt.SMOOTH] if s.grid[kt.IMPACT_LAST] == 1.0 else last
    for i in range(ws.joints.shape[0]):
        v0[i] = y[layout.v + i]
        v_bias[i] = v0[i] + s.theta * run.clock[ki.STEP] * known[i]
    for tries in range(1, MOST_TRIES + 1):
        take_drives(system, ws, run)
        place_midpoint(system, model, ws, run)
        if tries == 1 and list_contacts(system, s, ws, run.clock[ki.STEP]):
            # The last acceleration does not predict the acceleration of this step.
            for i in range(ws.joints.shape[0]):
                v_bias[i], ws.joints[i, ka.QD] = v0[i], v0[i]
            geometry(system, model, ws)
        solve_step(system, model, ws, run)
        drive_at_theta(system, ws, run)
        if limits_agree(system, ws, run, tries):
            break
        if tries == MOST_TRIES:
            s.statistics[kt.UNSETTLED] += 1.0
    note_contacts(system, s, ws)
    book(system, ws, run)


@internal_kernel
def take_drives(system: System, ws: Workspace, run: Run):
    """Evaluate the drives at (q + h θ v, v) for the step; the torques without loads are left in ``s.before``."""
    s, y, layout, joints, body = run.stepping, run.y, system.layout, ws.joints, system.model.body
    place_joints(system, ws, y)
    if layout.extra > 0:  # rolling bases move along their heading; the last sweep may have been at another state
        sine_cosine(joints, ws.trig)
    for i in range(joints.shape[0]):
        v = s.before[kt.V_START, i]
        joints[i, ka.Q] += run.clock[ki.STEP] * s.theta * v
        joints[i, ka.QD], joints[i, ka.QDD] = v, v
        joints[i, ka.APPLIED] = -(body[i, ka.DAMPING] + body[i, ka.GEAR_DAMPING]) * v
    eliminate_currents(system, ws, run)
    for i in range(joints.shape[0]):
        s.before[kt.APPLIED_THEN, i] = joints[i, ka.APPLIED]


@internal_kernel
def place_midpoint(system: System, model: ModelArrays, ws: Workspace, run: Run):
    """Compute the geometry at q + h v/2, and the velocity products for rates predicted from the last acceleration."""
    moved(system, ws, run.y, 0.5 * run.clock[ki.STEP], run.y_new)
    place_joints(system, ws, run.y_new)
    for i in range(ws.joints.shape[0]):
        ws.joints[i, ka.QD], ws.joints[i, ka.QDD] = run.stepping.before[kt.V_BIAS, i], 0.0
    geometry(system, model, ws)


@internal_kernel
def solve_step(system: System, model: ModelArrays, ws: Workspace, run: Run):
    """Solve for the impulses and accelerations at the midpoint, and write the resulting state to y_new."""
    s, t, h, y, y_new, layout = run.stepping, run.clock[ki.TIME], run.clock[ki.STEP], run.y, run.y_new, system.layout
    joints, v0, last = ws.joints, s.before[kt.V_START], s.before[kt.ACCELERATION]
    if system.loads.table.shape[0] > 0:
        add_loads(model, system.loads, t + s.theta * h, ws, run.stage[1], layout.load)
    tangent_rows(system, s, ws)
    factor(model, ws)
    solved = False
    if ws.counts[ka.ROWS] > 0:
        solved = solve_compliant(s.articulated, model, system, s, ws, h)
        if not solved:
            constraint_rates(model, ws, y, layout.v, s.rate[0])
            row_system(model, ws)
            solve_contacts(None, model, system, s, ws, h)
            add_row_forces(model, ws)
        note_stop_forces(system.unilateral, ws)
    if not solved:
        accelerate(model, ws)
    balance_momentum(model, s, ws, h)
    run.count[ki.EVALUATIONS] += 1
    for i in range(joints.shape[0]):
        last[i] = joints[i, ka.QDD]
        joints[i, ka.QDD] = v0[i] + s.theta * h * last[i]
    moved(system, ws, y, h, y_new)
    for i in range(joints.shape[0]):
        y_new[layout.v + i] = v0[i] + h * last[i]
        joints[i, ka.QDD] = last[i]
    if solved:
        end_rates(s.articulated, s, ws, h)
    else:
        constraint_rates(model, ws, y_new, layout.v, s.rate[1])
    for a in range(ws.motors.shape[0]):
        k, j = system.drives.table[a, ka.CIRCUIT], system.drives.table[a, ka.DRIVEN]
        if k >= 0:
            y_new[layout.current + k] = (
                y[layout.current + k] + s.eliminated[a, kt.FREE] + s.eliminated[a, kt.PER] * h * last[j]
            )


@internal_kernel
def book(system: System, ws: Workspace, run: Run):
    """Add the step's ledger to y_new, after :func:`drive_at_theta`: the power at x_θ, and the work of contacts."""
    s, t, h, y_new, layout = run.stepping, run.clock[ki.TIME], run.clock[ki.STEP], run.y_new, system.layout
    start = system.layout.ledger
    # Use the sweep at the midpoint before it is overwritten.
    stored = -midpoint_work(system.model, ws, s.before[kt.V_START], s.before[kt.ACCELERATION], h)
    stored += drive_work(system, ws, run)
    stored += s.statistics[kt.BALANCED]
    if system.loads.table.shape[0] > 0:
        # Add the loads again to get their powers at the mean velocities that the links have now.
        add_loads(system.model, system.loads, t + s.theta * h, ws, run.stage[1], layout.load)
    gear, joint = damping_powers(system.model, ws)
    electrical, drawn, joule, mechanical, drag = drive_powers(system.drives, ws)
    for r in range(ws.counts[ka.ROWS]):
        y_new[start + kst.CONSTRAINT] += work_of_row(s, ws, r, h)
    y_new[start + kst.ELECTRICAL] += h * electrical
    y_new[start + kst.DRAWN] += h * drawn
    y_new[start + kst.JOULE] += h * joule
    y_new[start + kst.GEAR] += h * (gear + drag)
    y_new[start + kst.JOINT] += h * joint
    y_new[start + kst.MECHANICAL] += h * mechanical
    y_new[start + kst.SUPPLY] += h * max(electrical, 0.0)
    s.grid[kt.POWER_NOW] = electrical
    for k in range(system.loads.table.shape[0]):
        y_new[layout.load + k] += h * run.stage[1, layout.load + k]
        s.grid[kt.POWER_NOW] += run.stage[1, layout.load + k]
    book_stops(system.unilateral, system, s, ws, y_new, h)
    book_dry(system.unilateral, system, s, ws, y_new, h)
    book_ties(system.unilateral, layout, s, ws, y_new, h)
    book_contacts(system, s, ws, y_new, h)
    stored_energy(system, ws, y_new, s.energy[kt.STOP])
    y_new[layout.scheme] -= stored + (s.energy[kt.STOP, kt.MECHANICAL] - s.energy[kt.START, kt.MECHANICAL])
    if abs(y_new[layout.scheme]) > abs(s.statistics[kt.TAKEN]):
        s.statistics[kt.TAKEN] = y_new[layout.scheme]
    s.statistics[kt.MOST_TAKEN] = max(s.statistics[kt.MOST_TAKEN], y_new[layout.scheme])
    s.statistics[kt.MADE] = max(s.statistics[kt.MADE], s.statistics[kt.MOST_TAKEN] - y_new[layout.scheme])


@internal_kernel
def work_of_row(s: SteppingArrays, ws: Workspace, r, h):
    """Return the work of the force of row r on its motion, p (u + u')/2 [J]."""
    return 0.5 * h * ws.rows[r, ka.FORCE] * (s.rate[0, r] + s.rate[1, r])


@internal_kernel
def book_stops(unilateral: UnilateralArrays, system: System, s: SteppingArrays, ws: Workspace, y_new, h):
    """Record the work of joint stops as a loss, not as a constraint error."""
    for k in range(unilateral.stop.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 0:
            continue
        work = work_of_row(s, ws, unilateral.stop_table[k, ku.STOP_ROW], h)
        y_new[system.layout.loss + kst.JOINT_STOP_LOSS] -= work
        y_new[system.layout.ledger + kst.CONSTRAINT] -= work


@internal_kernel
def book_dry(unilateral: UnilateralArrays, system: System, s: SteppingArrays, ws: Workspace, y_new, h):
    """Record dry friction as losses of gear and joint in the ratio of their bounds; write its forces to the tables."""
    ledger = system.layout.ledger
    for k in range(unilateral.dry.shape[0]):
        dry, r, a = unilateral.dry[k], unilateral.dry_table[k, ku.DRY_ROW], unilateral.dry_table[k, ku.DRY_DRIVE]
        dry[ku.DRY_FORCE], work = ws.rows[r, ka.FORCE], work_of_row(s, ws, r, h)
        share = dry[ku.OF_GEAR] / (dry[ku.OF_GEAR] + dry[ku.OF_JOINT])
        # If the motion reverses within a step, the friction force may be along the mean motion. This is an error of the
        # step, as for contacts.
        lost = min(work, 0.0)
        y_new[system.layout.scheme] -= work - lost
        y_new[ledger + kst.GEAR] -= share * lost
        y_new[ledger + kst.JOINT] -= (1.0 - share) * lost
        y_new[ledger + kst.MECHANICAL] += share * lost
        y_new[ledger + kst.CONSTRAINT] -= work
        if a >= 0:
            ws.motors[a, ka.DRY_DRAG] = -share * dry[ku.DRY_FORCE]


@internal_kernel
def book_contacts(system: System, s: SteppingArrays, ws: Workspace, y_new, h):
    """Record the work of contacts: landings as impact loss, tangents that slide or begin to stick as friction.

    In a landing, friction may return energy that the normal impulse takes, so only their sum is a loss. The remaining
    work of closed rows is counted as scheme energy. The energy for pushing a point out of its surface is deducted from
    the impact losses.
    """
    layout, first = system.layout, system.layout.contact
    for k in range(ws.contacts.shape[0]):
        now, last = s.memory[kt.NOW, k], s.memory[kt.LAST, k]
        ws.contacts[k, ka.NORMAL_FORCE], s.turn[k, kt.STRUCK] = 0.0, 0.0
        soft, normal = system.contacts.law[k, ka.CONTACT_STIFFNESS] > 0.0, 0.0
        if now[kt.LISTED] == 1.0:
            r = ws.active[k, ka.FIRST_ROW]
            force = ws.rows[r, ka.FORCE]
            ws.contacts[k, ka.NORMAL_FORCE] = force
            normal = work_of_row(s, ws, r, h)
            tangential = work_of_row(s, ws, r + 1, h) + work_of_row(s, ws, r + 2, h)
            struck, friction = normal, tangential
            if last[kt.CLOSED] == 1.0:
                struck = min(h * force * max(s.turn[k, kt.PUSH], 0.0), max(last[kt.BUDGET], 0.0))
                if now[kt.SLID] == 0.0 and last[kt.SLID] == 0.0:
                    friction = 0.0
            slips = friction != 0.0 or now[kt.SLID] == 1.0
            # If slip ends or reverses within a step, the mean force may be along the mean motion. Since friction cannot
            # return energy, this is an error of the step.
            friction = min(friction, 0.0)
            if last[kt.CLOSED] == 0.0 and not soft:
                struck, friction = normal + tangential, 0.0
            if slips:
                x, z = 0.5 * (s.rate[0, r + 1] + s.rate[1, r + 1]), 0.5 * (s.rate[0, r + 2] + s.rate[1, r + 2])
                y_new[first + kst.SLIP] += h * slip_of_rates(system.contacts.law, k, x, z)
            y_new[first + kst.IMPULSE] += h * force
            y_new[layout.ledger + kst.FRICTION] -= friction
            if soft:
                y_new[layout.scheme] -= tangential - friction
                y_new[layout.ledger + kst.CONSTRAINT] -= tangential
            else:
                y_new[layout.loss + kst.IMPACT_LOSS] -= struck
                s.turn[k, kt.STRUCK] = -struck
                y_new[layout.scheme] -= normal + tangential - struck - friction
                y_new[layout.ledger + kst.CONSTRAINT] -= normal + tangential
        if soft:
            book_soft_contact(system.contacts.law, layout, s, ws, k, normal, y_new, h)
        first += kst.CONTACT_SIZE


@internal_kernel
def count_step(unilateral: UnilateralArrays, law, s: SteppingArrays, ws: Workspace, h):
    """Update times, depths and losses of candidates and joint stops for the accepted step."""
    for k in range(unilateral.stop.shape[0]):
        if unilateral.stop_table[k, ku.STOP_CLOSED] == 1:
            unilateral.stop[k, ku.CLOSED_TIME] += h
            unilateral.stop[k, ku.STOP_LOSS] -= work_of_row(s, ws, unilateral.stop_table[k, ku.STOP_ROW], h)
    for k in range(ws.contacts.shape[0]):
        tally = unilateral.tally[k]
        tally[s.motion[k]] += h  # the times are in the order of the modes
        if s.memory[kt.NOW, k, kt.LISTED] == 1.0:
            tally[ku.LOSS] += s.turn[k, kt.STRUCK]
            tally[ku.DEEPEST] = max(tally[ku.DEEPEST], -ws.contacts[k, ka.GAP])
            if law[k, ka.CONTACT_STIFFNESS] == 0.0:
                s.statistics[kt.PENETRATION] = max(s.statistics[kt.PENETRATION], -ws.contacts[k, ka.GAP])


@internal_kernel
def keep_torques(system: System, ws: Workspace, run: Run):
    """Record the shaft torques of the accepted step, at x_θ, unless it has an impact.

    Call this function before the samples of the step and before ``remember``. The mean acceleration of an impact is
    Δv/h, which diverges as steps become shorter. The same applies to the next step, which corrects for rows that turned
    within the step of the landing.
    """
    s, motor, y, y_new, layout = run.stepping, system.drives.motor, run.y, run.y_new, system.layout
    impact = strikes(system.contacts.law, system.unilateral, s, ws, False)
    s.grid[kt.IMPACT_LAST] = 1.0 if impact else 0.0
    if not impact:
        for i in range(ws.joints.shape[0]):
            s.before[kt.SMOOTH, i] = s.before[kt.ACCELERATION, i]
    if impact or strikes(system.contacts.law, system.unilateral, s, ws, True):
        s.grid[kt.HELD_STEPS] = 2.0
    else:
        s.grid[kt.HELD_STEPS] = max(s.grid[kt.HELD_STEPS] - 1.0, 0.0)
    if s.grid[kt.HELD_STEPS] > 0.0:
        return
    for a in range(ws.motors.shape[0]):
        i = system.drives.table[a, ka.DRIVEN]
        v = y[layout.v + i] + s.theta * (y_new[layout.v + i] - y[layout.v + i])
        inertial = motor[a, ka.J_M] * s.before[kt.ACCELERATION, i]
        s.torque[a] = steady_torque(motor, ws.motors, a, v) - inertial


@internal_kernel
def log_step_changes(unilateral: UnilateralArrays, s: SteppingArrays, run: Run):
    """Log and count the changes of the accepted step at its end; return whether the caller must empty the log.

    The initial state of a contact is not an event.
    """
    table, stop = unilateral.stop_table, unilateral.stop
    for k in range(s.logged_motion.shape[0]):
        before, now = s.logged_motion[k], s.motion[k]
        s.logged_motion[k] = now
        if before >= 0 and before != now:
            ke.log_and_count(unilateral, run, k, ke.kind_of_change(before, now))
    for k in range(table.shape[0]):
        closed = table[k, ku.STOP_CLOSED] == 1
        if run.count[ki.STEPS] > 1 and table[k, ku.STOP_CLOSED] != table[k, ku.STOP_BEFORE]:
            stop[k, ku.HITS] += 1.0 if closed else 0.0
            ke.log(run, ki.STOP_LOG + ke.LOG_KINDS * k + (ke.STOP_HIT if closed else ke.STOP_LEFT))
        table[k, ku.STOP_BEFORE] = table[k, ku.STOP_CLOSED]
    rubbing = unilateral.dry_table
    for k in range(rubbing.shape[0]):
        ke.log_joint(unilateral, run, k, 0 if abs(s.w[rubbing[k, ku.DRY_ROW]]) > kt.BAD else 1)
    most = s.logged_motion.shape[0] + table.shape[0] + rubbing.shape[0]
    return run.count[ki.LOGGED] + most > run.log_time.shape[0]


@internal_kernel
def save_directions(s: SteppingArrays, ws: Workspace):
    """Save the wrenches of unit forces of all active rows, with which the step was solved."""
    for r in range(ws.counts[ka.ROWS]):
        put_six(s.direction, r, 0, six(ws.rows, r, ka.DIRECTION))


@internal_kernel
def restore_directions(s: SteppingArrays, ws: Workspace):
    """Undo the changes of the directions by ``geometry``, because the forces of the step belong to its own rows.

    ``geometry`` gives the rows of sticking contacts different tangents, without the grip factor.
    """
    for r in range(ws.counts[ka.ROWS]):
        put_six(ws.rows, r, ka.DIRECTION, six(s.direction, r, 0))


@internal_kernel
def sample_moreau(system: System, ws: Workspace, run: Run):
    """Record all samples within the step, with a state that is linear in time.

    Forces are means over the step. As vectors, they are along the normal and the tangents at the midpoint, so that the
    sum of all forces is the change of momentum.
    """
    t, h, last = run.clock[ki.TIME], run.clock[ki.STEP], run.count[ki.SAMPLE]
    s = run.stepping
    until = t + h + 1e-12 * max(1.0, t + h)
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        x = min(max((run.sample_time[last] - t) / h, 0.0), 1.0)
        row = run.sample[last]
        for j in range(row.shape[0]):
            row[j] = run.y[j] + x * (run.y_new[j] - run.y[j])
        if system.layout.extra > 0:
            normalise(system.model, row, system.layout.q)
        place_state(system, ws, row)
        drive(system.drives, system.reference, run.sample_time[last], row, system.layout, ws)
        save_directions(s, ws)
        geometry(system, system.model, ws)
        restore_directions(s, ws)
        write_output(system, ws, run, last)
        # Within a step the state is linear in time, but the energy is not.
        between = -(1.0 - x) * (s.energy[kt.START, kt.MECHANICAL] + s.energy[kt.START, kt.MAGNETIC])
        between -= x * (s.energy[kt.STOP, kt.MECHANICAL] + s.energy[kt.STOP, kt.MAGNETIC])
        for k in range(kst.ENERGIES):
            between += run.output[last, run.columns.energy + k]
        row[system.layout.scheme] -= between
        for k in range(ws.contacts.shape[0]):
            # The contact has sticking rows even if it slides, so its mode must be written separately.
            run.output[last, run.columns.contact + k * kst.OUTPUTS_PER_CONTACT + kst.OUT_MODE] = s.motion[k]
        last += 1
    run.count[ki.SAMPLE] = last


@internal_kernel
def commands_due(system: System, ws: Workspace, run: Run):
    """Sample commands if they are due; return whether control must return to the caller."""
    due = take_ticks(run, system.drives.input)
    if due & ki.TAKE_COMMANDS:
        place_state(system, ws, run.y)
        take_commands(system.drives, system.reference, run.clock[ki.TIME], ws)
    run.count[ki.TICKED] = due & ~ki.TAKE_COMMANDS
    if due & ki.TAKE_COMMANDS or run.count[ki.STARTED] == 0:
        rewrite_sample(system, ws, run)
    if run.count[ki.STARTED] == 0:
        run.count[ki.STARTED] = 1
        run.stepping.before[kt.ACCELERATION] = 0.0
        run.stepping.before[kt.SMOOTH] = 0.0
    return run.count[ki.TICKED] != 0


@internal_kernel
def rewrite_sample(system: System, ws: Workspace, run: Run):
    """Update the drives in a sample at TIME, which was recorded at the end of the last step, to the new commands.

    If a brake has closed since then, the state of the sample is updated too. Accelerations and forces remain the means
    of the last step.
    """
    if not sampled_now(run):
        return
    last, columns = run.count[ki.SAMPLE] - 1, run.columns
    row, out = run.sample[last], run.output[last]
    place_state(system, ws, run.y)
    drive(system.drives, system.reference, run.clock[ki.TIME], run.y, system.layout, ws)
    fill_drives(system, ws, run, out)
    if not rates_jumped(run.stepping, run.y, system.layout.v):
        return
    for j in range(row.shape[0]):
        row[j] = run.y[j]
    # The next step begins with a separate sweep.
    geometry(system, system.model, ws)
    fill_energies(system, ws, run, out)
    for k in range(ws.contacts.shape[0]):
        for m in range(3):
            at = columns.contact + k * kst.OUTPUTS_PER_CONTACT + kst.OUT_SLIP + m
            out[at] = ws.contacts[k, ka.SLIP_VELOCITY + m]


@internal_kernel
def advance_time(s: SteppingArrays, clock):
    """Set TIME to the end of the accepted step: the start of the equal steps plus their number times the step size.

    This avoids accumulating rounding errors. The count restarts after a trimmed step and at a tick.
    """
    grid, whole = s.grid, clock[ki.PROPOSED]
    if grid[kt.GRID_START] + grid[kt.GRID_STEPS] * whole != clock[ki.TIME]:
        grid[kt.GRID_START], grid[kt.GRID_STEPS] = clock[ki.TIME], 0.0
    if clock[ki.STEP] == whole:
        grid[kt.GRID_STEPS] += 1.0
        clock[ki.TIME] = grid[kt.GRID_START] + grid[kt.GRID_STEPS] * whole
    else:
        clock[ki.TIME] += clock[ki.STEP]
    clock[ki.STEP] = whole


@free_kernel
def advance_moreau(system: System, ws: Workspace, run: Run, limit):
    """Run ``advance`` with time stepping."""
    clock, count, taken = run.clock, run.count, 0
    if limit < 0:
        return
    while not commands_due(system, ws, run):
        if finished(run) or taken >= limit or stalled(run):
            return
        taken += 1
        if count[ki.PENDING] == 0:
            clock[ki.PROPOSED] = clock[ki.STEP]
            choose_step(run)
            step_moreau(system, ws, run)
            if not finite(run.y_new):
                count[ki.STATUS] = ki.NOT_FINITE
                return
            if clock[ki.TIME] + clock[ki.STEP] > clock[ki.HOLD]:
                count[ki.PENDING] = 1
                return
        count[ki.PENDING] = 0
        watch(ws, run, clock[ki.STEP])
        keep_torques(system, ws, run)
        count_step(system.unilateral, system.contacts.law, run.stepping, ws, clock[ki.STEP])
        remember_pairs(system.shapes.pairs)  # of the midpoint, before a sample finds others
        sample_moreau(system, ws, run)
        for j in range(run.y.shape[0]):
            run.y[j] = run.y_new[j]
        remember(system.unilateral, run.stepping, run.y, system.layout.v, clock[ki.STEP])
        advance_time(run.stepping, clock)
        count[ki.STEPS] += 1
        if log_step_changes(system.unilateral, run.stepping, run):
            return
