"""Energies and the integrals of the ledger, which are states of the integrator."""

from __future__ import annotations

import math

from dynsim.kernels.arrays import (
    ARMATURE,
    COUPLED,
    CURRENT,
    D_M,
    DAMPING,
    DIRECTION,
    DRAG,
    DRIVEN,
    FIRST_ROW,
    FORCE,
    GAP_RATE,
    GEAR_DAMPING,
    INDUCTANCE,
    J_M,
    K_M,
    MODE,
    NORMAL_FORCE,
    PARENT,
    QD,
    QDD,
    RESISTANCE,
    ROW_RATE,
    SLIDING,
    SLIP_VELOCITY,
    STICKING,
    VOLTAGE,
    DriveArrays,
    ModelArrays,
    S,
    V,
    Workspace,
)
from dynsim.kernels.constraint.rows import joint_rate
from dynsim.kernels.jit import internal_kernel, kernel
from dynsim.kernels.state import (
    CONSTRAINT,
    CONTACT_SIZE,
    DRAWN,
    ELECTRICAL,
    FRICTION,
    GEAR,
    IMPULSE,
    JOINT,
    JOULE,
    MECHANICAL,
    SLIP,
    SUPPLY,
)
from dynsim.kernels.tree.sweep import body_inertia


@internal_kernel
def drive_powers(drives: DriveArrays, ws: Workspace):
    """Electrical, drawn, Joule and mechanical power of all drives, and that of their drag [W]; see `ledger_rates`."""
    joints, motors, motor = ws.joints, ws.motors, drives.motor
    electrical, drawn, joule, mechanical, drag = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(motors.shape[0]):
        i = drives.table[a, DRIVEN]
        current, v = motors[a, CURRENT], joints[i, QD]
        power = motors[a, VOLTAGE] * current
        electrical += power
        drawn += max(power, 0.0)
        joule += motor[a, RESISTANCE] * current * current
        shaft = motor[a, K_M] * current - motor[a, J_M] * joints[i, QDD] - motor[a, D_M] * v - motors[a, DRAG]
        mechanical += shaft * v
        drag += motors[a, DRAG] * v
    return electrical, drawn, joule, mechanical, drag


@internal_kernel
def ledger_rates(model: ModelArrays, drives: DriveArrays, ws: Workspace, out, layout):
    """Rates of all integrals, into the blocks ledger and contact of ``out`` [W; N, m/s], and the normal forces.

    Electrical Σ u i; drawn Σ max(u i, 0), a supply for each motor; supply max(Σ u i, 0), one for all; Joule Σ R i²;
    gear Σ D_m v² and the drag of servos; joint Σ D v²; friction −Σ f_n (d − n)·v of what slides, d the force direction;
    constraint Σ f J v of all rows (zero on the constraint); mechanical Σ tau v with tau = K_m i − J_m vdot − D_m v −
    drag ([WM] eq 25).
    """
    joints, state = ws.joints, ws.contacts
    electrical, drawn, joule, mechanical, drag = drive_powers(drives, ws)
    gear, joint = 0.0, 0.0
    for i in range(joints.shape[0]):
        square = joints[i, QD] * joints[i, QD]
        gear += model.body[i, GEAR_DAMPING] * square
        joint += model.body[i, DAMPING] * square
    friction, constraint = 0.0, 0.0
    start, first = layout.ledger, layout.contact
    rows = ws.rows
    for k in range(state.shape[0]):
        m, mode, slip = ws.active[k, FIRST_ROW], ws.active[k, MODE], 0.0
        # Zero of a candidate that is off its surface: no solve writes to its row.
        f, rate = rows[m, FORCE], state[k, GAP_RATE]
        state[k, NORMAL_FORCE] = f
        if mode == SLIDING:
            x, y, z = state[k, SLIP_VELOCITY], state[k, SLIP_VELOCITY + 1], state[k, SLIP_VELOCITY + 2]
            # The slip velocity has no part along n, so d·v_t is the friction alone.
            friction -= f * (rows[m, DIRECTION + 3] * x + rows[m, DIRECTION + 4] * y + rows[m, DIRECTION + 5] * z)
            slip = math.sqrt(x * x + y * y + z * z)
        elif mode == STICKING:
            constraint += rows[m + 1, FORCE] * rows[m + 1, ROW_RATE] + rows[m + 2, FORCE] * rows[m + 2, ROW_RATE]
        constraint += f * rate
        out[first + IMPULSE] = f
        out[first + SLIP] = slip
        first += CONTACT_SIZE
    for k in range(ws.counts[COUPLED]):
        constraint += rows[k, FORCE] * joint_rate(ws, k)
    out[start + ELECTRICAL] = electrical
    out[start + DRAWN] = drawn
    out[start + JOULE] = joule
    out[start + GEAR] = gear + drag
    out[start + JOINT] = joint
    out[start + FRICTION] = friction
    out[start + CONSTRAINT] = constraint
    out[start + MECHANICAL] = mechanical
    out[start + SUPPLY] = max(electrical, 0.0)


@kernel
def kinetic_energy(model: ModelArrays, ws: Workspace):
    """½ Σ V·I V + ½ Σ J_m v² [J], from the poses and axes of the last sweep; overwrites V."""
    tree, links, joints = model.tree, ws.links, ws.joints
    total = 0.0
    for i in range(tree.shape[0]):
        j = tree[i, PARENT]
        for s in range(6):
            links[i, V + s] = links[i, S + s] * joints[i, QD] + (links[j, V + s] if j >= 0 else 0.0)
        wx, wy, wz, ox, oy, oz = (
            links[i, V],
            links[i, V + 1],
            links[i, V + 2],
            links[i, V + 3],
            links[i, V + 4],
            links[i, V + 5],
        )
        m, cx, cy, cz, ixx, ixy, ixz, iyy, iyz, izz = body_inertia(model, ws, i)
        vx, vy, vz = ox + wy * cz - wz * cy, oy + wz * cx - wx * cz, oz + wx * cy - wy * cx
        total += 0.5 * (
            wx * (ixx * wx + 2.0 * (ixy * wy + ixz * wz))
            + wy * (iyy * wy + 2.0 * iyz * wz)
            + izz * wz * wz
            + m * (vx * vx + vy * vy + vz * vz)
        )
        total += 0.5 * model.body[i, ARMATURE] * joints[i, QD] * joints[i, QD]
    return total


@kernel
def potential_energy(model: ModelArrays, ws: Workspace):
    """−Σ m g·c [J], zero at the world origin, after ``forward_sweep``."""
    total = 0.0
    for i in range(ws.links.shape[0]):
        m, cx, cy, cz, _, _, _, _, _, _ = body_inertia(model, ws, i)
        total -= m * (cx * model.gravity[0] + cy * model.gravity[1] + cz * model.gravity[2])
    return total


@internal_kernel
def magnetic_energy(drives: DriveArrays, ws: Workspace):
    """½ Σ L i² [J]."""
    total = 0.0
    for a in range(ws.motors.shape[0]):
        total += 0.5 * drives.motor[a, INDUCTANCE] * ws.motors[a, CURRENT] * ws.motors[a, CURRENT]
    return total
