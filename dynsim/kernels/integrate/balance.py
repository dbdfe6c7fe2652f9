"""What the discretisation of time stepping does to the energy: a term of its ledger, ``loss_scheme``.

A step solves, with the inertia M, the velocity products c and the weight g of its midpoint q_m, and Δ = v' − v,

    M(q_m) Δ = h (τ̂ + Q − c(q_m, v_b) − g(q_m)) + Jᵀ p,        L (i' − i) = h û

where τ̂ and û are torques and circuit voltages as its linear blocks have them at x_θ. Dotted with the means v̄ and ī of
both ends, this is a balance of powers. That of the laws at x_θ, which the ledger has, differs from it, and so does the
change of the energy that bodies and coils really have, E(q', v') − E(q, v). What these differences add up to is the
energy that the steps make of nothing:

    E' − E − v̄·M Δ − h v̄·(c + g)          the inertia is that of one posture within a step, velocities are those of one
    + h (v̄·τ̂ − v_θ·τ(x_θ))                drives are linear within a step, and their power is that of x_θ
    + h L (ī·û − i_θ·û(x_θ))               likewise

Each term is computed from what went into the step, none from the ledger: an error of the solution, or a power that is
booked wrongly, stays in the residual. The sum is of first order in h where velocities jump, else of the method's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynsim.kernels.arrays import (
    APPLIED,
    ARMATURE,
    CIRCUIT,
    CURRENT,
    DAMPING,
    DIDT,
    DRIVEN,
    GEAR_DAMPING,
    INDUCTANCE,
    PARENT,
    QD,
    RATE_I,
    RATE_Q,
    RATE_V,
    A,
    ModelArrays,
    S,
    V,
    Workspace,
)
from dynsim.kernels.integrate.run import STEP, Run
from dynsim.kernels.integrate.time_stepping import (
    ACCELERATION,
    APPLIED_THEN,
    DIDT_THEN,
    MAGNETIC,
    MECHANICAL,
    START,
    STOP,
    V_START,
    place_joints,
)
from dynsim.kernels.jit import internal_kernel
from dynsim.kernels.ledger import kinetic_energy, potential_energy
from dynsim.kernels.tree.sweep import body_inertia, forward_sweep, inertial_wrench

if TYPE_CHECKING:
    from dynsim.kernels.system import System


@internal_kernel
def stored_energy(system: System, ws: Workspace, y, out):
    """Energy of bodies and rotors, and of coils, at y [J], into out, (2,). Sweeps there."""
    layout, motor = system.layout, system.drives.motor
    place_joints(system, ws, y)
    for i in range(ws.joints.shape[0]):
        ws.joints[i, QD] = y[layout.v + i]
    forward_sweep(system.model, ws, 1.0, 0.0, 1.0)
    out[MECHANICAL] = kinetic_energy(system.model, ws) + potential_energy(system.model, ws)
    out[MAGNETIC] = 0.0
    for a in range(ws.motors.shape[0]):
        k = system.drives.table[a, CIRCUIT]
        if k >= 0:
            out[MAGNETIC] += 0.5 * motor[a, INDUCTANCE] * y[layout.current + k] * y[layout.current + k]


@internal_kernel
def begin_energy(system: System, ws: Workspace, run: Run):
    """Energy at the start of a step: that at the end of the last one, unless the state is another one by now."""
    energy, same = run.stepping.energy, True
    for j in range(system.layout.tracked):
        same = same and run.y[j] == run.y_new[j]
    # NaN before the first step.
    if same and energy[STOP, MECHANICAL] == energy[STOP, MECHANICAL]:
        energy[START, MECHANICAL], energy[START, MAGNETIC] = energy[STOP, MECHANICAL], energy[STOP, MAGNETIC]
    else:
        stored_energy(system, ws, run.y, energy[START])


@internal_kernel
def midpoint_work(model: ModelArrays, ws: Workspace, v, vdot, h):
    """v̄·M Δ + h v̄·(c + g) at the midpoint, whose sweep is still there [J]; leaves the links' velocities of v̄ in V.

    v, vdot : (n,) rates at the start, mean acceleration; v̄ = v + h vdot / 2, Δ = h vdot
    """
    tree, body, links = model.tree, model.body, ws.links
    inertia, bias = 0.0, 0.0
    for i in range(tree.shape[0]):
        m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz = body_inertia(model, ws, i)
        n0, n1, n2, n3, n4, n5 = inertial_wrench(ws, i, m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz)
        j, rate, change = tree[i, PARENT], v[i] + 0.5 * h * vdot[i], h * vdot[i]
        for s in range(6):
            links[i, V + s] = links[i, S + s] * rate + (links[j, V + s] if j >= 0 else 0.0)
            links[i, A + s] = links[i, S + s] * change + (links[j, A + s] if j >= 0 else 0.0)
        wx, wy, wz, ox, oy, oz = (
            links[i, V], links[i, V + 1], links[i, V + 2], links[i, V + 3], links[i, V + 4], links[i, V + 5]
        )  # fmt: skip
        ex, ey, ez = links[i, A], links[i, A + 1], links[i, A + 2]
        bias += (n0 * wx + n1 * wy) + (n2 * wz + n3 * ox) + (n4 * oy + n5 * oz)
        vx, vy, vz = ox + wy * cz - wz * cy, oy + wz * cx - wx * cz, oz + wx * cy - wy * cx
        ax, ay, az = (
            links[i, A + 3] + ey * cz - ez * cy,
            links[i, A + 4] + ez * cx - ex * cz,
            links[i, A + 5] + ex * cy - ey * cx,
        )
        inertia += (
            wx * (ixx * ex + ixy * ey + ixz * ez)
            + wy * (ixy * ex + iyy * ey + iyz * ez)
            + wz * (ixz * ex + iyz * ey + izz * ez)
            + m * (vx * ax + vy * ay + vz * az)
            + body[i, ARMATURE] * rate * change
        )
    return inertia + h * bias


@internal_kernel
def drive_work(system: System, ws: Workspace, run: Run):
    """What linear drives and the place of their power make [J], after ``drive`` at x_θ: its torques are in APPLIED."""
    s, h, y, y_new, layout = run.stepping, run.clock[STEP], run.y, run.y_new, system.layout
    joints, motors, motor, body, theta = ws.joints, ws.motors, system.drives.motor, system.model.body, s.theta
    v, vdot, applied = s.before[V_START], s.before[ACCELERATION], s.before[APPLIED_THEN]
    total = 0.0
    for i in range(joints.shape[0]):
        change = h * vdot[i]
        used = h * applied[i] - (s.body[i, ARMATURE] - body[i, ARMATURE]) * change
        law = joints[i, APPLIED] - (body[i, DAMPING] + body[i, GEAR_DAMPING]) * joints[i, QD]
        total += (v[i] + 0.5 * change) * used - h * joints[i, QD] * law
    for a in range(motors.shape[0]):
        k, j = system.drives.table[a, CIRCUIT], system.drives.table[a, DRIVEN]
        if k >= 0:
            start, linear = y[layout.current + k], s.linear[a]
            more = y_new[layout.current + k] - start
            by_v = (linear[RATE_Q] * h * theta + linear[RATE_V]) * theta
            rate = s.eliminated[a, DIDT_THEN] + by_v * h * vdot[j] + linear[RATE_I] * theta * more
            total += h * motor[a, INDUCTANCE] * ((start + 0.5 * more) * rate - motors[a, CURRENT] * motors[a, DIDT])
    return total
