"""Powers of the energy ledger, whose integrals are states; kinetic, potential and magnetic energy."""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.rows import joint_rate
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.tables import DriveArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import point_velocity, six, vector
from dynsim.dynamics.tree.sweep import body_inertia
from dynsim.jit.kernel import internal_kernel, kernel


@internal_kernel
def drive_powers(drives: DriveArrays, ws: Workspace):
    """Return the total electrical, drawn, Joule, mechanical and drag powers of all drives [W]; see `ledger_rates`."""
    joints, motors, motor = ws.joints, ws.motors, drives.motor
    electrical, drawn, joule, mechanical, drag = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(motors.shape[0]):
        i = drives.table[a, ka.DRIVEN]
        current, v = motors[a, ka.CURRENT], joints[i, ka.QD]
        power = motors[a, ka.VOLTAGE] * current
        electrical += power
        drawn += max(power, 0.0)
        joule += motor[a, ka.RESISTANCE] * current * current
        shaft = (
            motor[a, ka.K_M] * current
            - motor[a, ka.J_M] * joints[i, ka.QDD]
            - motor[a, ka.D_M] * v
            - motors[a, ka.DRAG]
        )
        mechanical += shaft * v
        drag += motors[a, ka.DRAG] * v
    return electrical, drawn, joule, mechanical, drag


@internal_kernel
def damping_powers(model: ModelArrays, ws: Workspace):
    """Return the viscous losses of all gears and of all joints [W]."""
    gear, joint = 0.0, 0.0
    for i in range(ws.joints.shape[0]):
        square = ws.joints[i, ka.QD] * ws.joints[i, ka.QD]
        gear += model.body[i, ka.GEAR_DAMPING] * square
        joint += model.body[i, ka.DAMPING] * square
    return gear, joint


@internal_kernel
def ledger_rates(model: ModelArrays, drives: DriveArrays, ws: Workspace, out, layout):
    """Write the rates of all integrals to the blocks ledger and contact of ``out`` [W; N, m/s], and the normal forces.

    The powers are: electrical, Σ u i; drawn, Σ max(u i, 0), with one supply per motor; supply, max(Σ u i, 0), with one
    supply for all motors; Joule, Σ R i²; gear, Σ D_m v² and the drag of servos; joint, Σ D v²; friction,
    −Σ f_n (d − n)·v of sliding contacts, with the force direction d; constraint, Σ f J v of all rows (zero if the
    constraints are satisfied); mechanical, Σ tau v with tau = K_m i − J_m vdot − D_m v − drag ([WM] eq 25).
    """
    state = ws.contacts
    electrical, drawn, joule, mechanical, drag = drive_powers(drives, ws)
    gear, joint = damping_powers(model, ws)
    friction, constraint = 0.0, 0.0
    start, first = layout.ledger, layout.contact
    rows = ws.rows
    for k in range(state.shape[0]):
        m, mode, slip = ws.active[k, ka.FIRST_ROW], ws.active[k, ka.MODE], 0.0
        # The force of a candidate off its surface is zero, because no solve writes to its row.
        f, rate = rows[m, ka.FORCE], state[k, ka.GAP_RATE]
        state[k, ka.NORMAL_FORCE] = f
        if mode == ka.SLIDING:
            x, y, z = state[k, ka.SLIP_VELOCITY], state[k, ka.SLIP_VELOCITY + 1], state[k, ka.SLIP_VELOCITY + 2]
            # The slip velocity has no component along n, so d·v_t contains only friction.
            friction -= f * (
                rows[m, ka.DIRECTION + 3] * x + rows[m, ka.DIRECTION + 4] * y + rows[m, ka.DIRECTION + 5] * z
            )
            slip = math.sqrt(x * x + y * y + z * z)
        elif mode == ka.STICKING:
            constraint += (
                rows[m + 1, ka.FORCE] * rows[m + 1, ka.ROW_RATE] + rows[m + 2, ka.FORCE] * rows[m + 2, ka.ROW_RATE]
            )
        constraint += f * rate
        out[first + kst.IMPULSE] = f
        out[first + kst.SLIP] = slip
        first += kst.CONTACT_SIZE
    for k in range(ws.counts[ka.COUPLED]):
        constraint += rows[k, ka.FORCE] * joint_rate(ws, k)
    out[start + kst.ELECTRICAL] = electrical
    out[start + kst.DRAWN] = drawn
    out[start + kst.JOULE] = joule
    out[start + kst.GEAR] = gear + drag
    out[start + kst.JOINT] = joint
    out[start + kst.FRICTION] = friction
    out[start + kst.CONSTRAINT] = constraint
    out[start + kst.MECHANICAL] = mechanical
    out[start + kst.SUPPLY] = max(electrical, 0.0)


@internal_kernel
def dry_losses(unilateral: UnilateralArrays | None, ws: Workspace, out, start):
    """Add the dissipation by dry friction of sliding joints to the losses of gears and joints in the ledger [W]."""
    if unilateral is None:  # resolved at compile time
        return
    for k in range(unilateral.dry.shape[0]):
        if unilateral.dry_table[k, ku.DRY_HOLDS] == 0:
            speed = unilateral.dry[k, ku.DRY_SIDE] * ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.QD]
            out[start + kst.GEAR] += unilateral.dry[k, ku.OF_GEAR] * speed
            out[start + kst.JOINT] += unilateral.dry[k, ku.OF_JOINT] * speed
            out[start + kst.MECHANICAL] -= unilateral.dry[k, ku.OF_GEAR] * speed


@kernel
def kinetic_energy(model: ModelArrays, ws: Workspace):
    """Return the kinetic energy ½ Σ V·I V + ½ Σ J_m v² [J] from the poses and axes of the last sweep; overwrites V."""
    tree, links, joints = model.tree, ws.links, ws.joints
    total = 0.0
    for i in range(tree.shape[0]):
        j = tree[i, ka.PARENT]
        for s in range(6):
            links[i, ka.V + s] = links[i, ka.S + s] * joints[i, ka.QD] + (links[j, ka.V + s] if j >= 0 else 0.0)
        m, c, I = body_inertia(model, ws, i)
        w, v = vector(links, i, ka.V), point_velocity(six(links, i, ka.V), c)
        total += 0.5 * (
            w[0] * (I[0] * w[0] + 2.0 * (I[1] * w[1] + I[2] * w[2]))
            + w[1] * (I[3] * w[1] + 2.0 * I[4] * w[2])
            + I[5] * w[2] * w[2]
            + m * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        )
        total += 0.5 * model.body[i, ka.ARMATURE] * joints[i, ka.QD] * joints[i, ka.QD]
    return total


@kernel
def potential_energy(model: ModelArrays, ws: Workspace):
    """Return the potential energy −Σ m g·c [J], relative to the world origin; call after ``forward_sweep``."""
    total = 0.0
    for i in range(ws.links.shape[0]):
        m, c, _ = body_inertia(model, ws, i)
        total -= m * (c[0] * model.gravity[0] + c[1] * model.gravity[1] + c[2] * model.gravity[2])
    return total


@internal_kernel
def magnetic_energy(drives: DriveArrays, ws: Workspace):
    """Return the magnetic energy ½ Σ L i² [J]."""
    total = 0.0
    for a in range(ws.motors.shape[0]):
        total += 0.5 * drives.motor[a, ka.INDUCTANCE] * ws.motors[a, ka.CURRENT] * ws.motors[a, ka.CURRENT]
    return total
