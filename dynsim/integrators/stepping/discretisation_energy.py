"""Energy error of time-stepping discretisation, a term of the ledger: ``loss_scheme``.

A step solves, with the inertia M, the velocity products c and the weight g of its midpoint q_m, and Δ = v' − v,

    M(q_m) Δ = h (τ̂ + Q − c(q_m, v_b) − g(q_m)) + Jᵀ p,        L (i' − i) = h û

where τ̂ and û are torques and circuit voltages as its linear blocks have them at x_θ. Dotted with the means v̄ and ī of
both ends, this is a balance of powers. The powers of the ledger, of the laws at x_θ, differ from these, and so does the
change of the energy of bodies and coils, E(q', v') − E(q, v). The sum of the differences is the energy that the
discretisation adds; it enters ``loss_scheme`` with a minus sign:

    E' − E − v̄·M Δ − h v̄·(c + g)          inertia and velocity products are those of one posture within a step
    + h (v̄·τ̂ − v_θ·τ(x_θ))                drives are linear within a step, and their power is that at x_θ
    + h L (ī·û − i_θ·û(x_θ))               likewise

Each term is computed from the inputs of the step, none from the ledger: an error of the solution, or a wrong power in
the ledger, stays in the residual. The sum is of first order in h where velocities jump, else of the method's order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynsim.dynamics import tables as ka
from dynsim.dynamics.ledger import kinetic_energy, potential_energy
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import dot, point_velocity, six, times_inertia
from dynsim.dynamics.tree.sweep import body_inertia, forward_sweep, inertial_wrench
from dynsim.integrators import run as ki
from dynsim.integrators.run import Run
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import place_joints
from dynsim.jit.kernel import internal_kernel

if TYPE_CHECKING:
    from dynsim.dynamics.derivative import System


@internal_kernel
def stored_energy(system: System, ws: Workspace, y, out):
    """Energy of bodies and rotors, and of coils, at y [J], into out, (2,). Sweeps there."""
    layout, motor = system.layout, system.drives.motor
    place_joints(system, ws, y)
    for i in range(ws.joints.shape[0]):
        ws.joints[i, ka.QD] = y[layout.v + i]
    forward_sweep(system.model, ws, 1.0, 0.0, 1.0)
    out[kt.MECHANICAL] = kinetic_energy(system.model, ws) + potential_energy(system.model, ws)
    out[kt.MAGNETIC] = 0.0
    for a in range(ws.motors.shape[0]):
        k = system.drives.table[a, ka.CIRCUIT]
        if k >= 0:
            out[kt.MAGNETIC] += 0.5 * motor[a, ka.INDUCTANCE] * y[layout.current + k] * y[layout.current + k]


@internal_kernel
def begin_energy(system: System, ws: Workspace, run: Run):
    """Energy at the start of a step: that at the end of the last one, unless the state is another one by now."""
    energy, same = run.stepping.energy, True
    for j in range(system.layout.tracked):
        same = same and run.y[j] == run.y_new[j]
    # NaN before the first step.
    if same and energy[kt.STOP, kt.MECHANICAL] == energy[kt.STOP, kt.MECHANICAL]:
        energy[kt.START, kt.MECHANICAL], energy[kt.START, kt.MAGNETIC] = (
            energy[kt.STOP, kt.MECHANICAL],
            energy[kt.STOP, kt.MAGNETIC],
        )
    else:
        stored_energy(system, ws, run.y, energy[kt.START])


@internal_kernel
def midpoint_work(model: ModelArrays, ws: Workspace, v, vdot, h):
    """v̄·M Δ + h v̄·(c + g) at the midpoint, whose sweep is still there [J]; leaves the links' velocities of v̄ in V.

    v, vdot : (n,) rates at the start, mean acceleration; v̄ = v + h vdot / 2, Δ = h vdot
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
    """What linear drives and the place of their power make [J], after ``drive`` at x_θ: its torques are in APPLIED."""
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
