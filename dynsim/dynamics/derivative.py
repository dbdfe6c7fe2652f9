"""Right-hand side dy/dt of the coupled system of bodies, motors and contacts ([WM] eqs 28–35).

The layout of y (positions, rates, currents, integrals) is in dynsim.dynamics.state.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.delassus import admissible_forces
from dynsim.dynamics.contact.distance import ShapeArrays
from dynsim.dynamics.contact.m_star import solve_m_star
from dynsim.dynamics.contact.rows import contact_rows, set_modes, shaped_rows, sign_changed
from dynsim.dynamics.contact.shares import solve_rows
from dynsim.dynamics.contact.unilateral import UnilateralArrays, apply_dry_friction
from dynsim.dynamics.drive.law import drive
from dynsim.dynamics.ledger import dry_losses, ledger_rates
from dynsim.dynamics.state import StateLayout
from dynsim.dynamics.tables import (
    ContactArrays,
    CouplingArrays,
    DriveArrays,
    ModelArrays,
    ReferenceArrays,
    Workspace,
    workspace,
)
from dynsim.dynamics.tree.articulated import accelerate, add_row_forces, factor, row_system
from dynsim.dynamics.tree.joints import positions_along, read_positions
from dynsim.dynamics.tree.loads import LoadArrays, add_loads
from dynsim.dynamics.tree.sweep import forward_sweep
from dynsim.jit.kernel import integers, internal_kernel, kernel, reals


class System(NamedTuple):
    """Constant data of a simulation."""

    layout: StateLayout
    model: ModelArrays
    drives: DriveArrays
    reference: ReferenceArrays
    contacts: ContactArrays
    loads: LoadArrays
    dense: np.ndarray | None  # scratch for M* and b, see dynsim.dynamics.contact.m_star; None: only articulated solve
    couplings: CouplingArrays = CouplingArrays(
        integers(np.zeros((0, ka.COUPLING_JOINT_SIZE))), reals(np.zeros((0, ka.COUPLING_SIZE)))
    )
    unilateral: UnilateralArrays | None = None  # None: candidates stick to their surfaces, and joints have no stops
    shapes: ShapeArrays | None = None  # candidates other than points on quadrics; None: no such candidates


def new_workspace(system: System) -> Workspace:
    """Allocate the workspace of a system, with all couplings closed.

    Candidates slide at first under the bilateral law and are open under the unilateral law. Candidates marked LEFT_OUT
    are open under both laws.
    """
    contacts, couplings, unilateral = system.contacts, system.couplings, system.unilateral
    c, joint_rows = contacts.link.shape[0], couplings.joint.shape[0]
    if unilateral is not None:
        joint_rows += unilateral.stop.shape[0] + unilateral.dry.shape[0] + unilateral.tie.shape[0]
    ws = workspace(system.model.tree.shape[0], system.drives.table.shape[0], c, joint_rows)
    modes = np.full(c, ka.SLIDING if unilateral is None else ka.OPEN)
    modes[contacts.link[:, ka.LEFT_OUT] == 1] = ka.OPEN
    set_modes(contacts, couplings, unilateral, ws, integers(modes))
    return ws


@internal_kernel
def constrained_acceleration(model: ModelArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Compute vdot in ``ws.joints`` and the forces in ``ws.rows`` from the applied forces by the articulated solve."""
    factor(model, ws)
    p, passes = ws.counts[ka.ROWS], 0
    while p > 0:
        passes += 1
        row_system(model, ws)
        ws.counts[ka.DEPENDENT] += solve_rows(unilateral, ws, p)
        if not sign_changed(ws, passes):
            break
    add_row_forces(model, ws)
    accelerate(model, ws)


@internal_kernel
def m_star_acceleration(
    dense,
    model: ModelArrays,
    drives: DriveArrays,
    unilateral: UnilateralArrays | None,
    ws: Workspace,
    dependent,
):
    """Compute the same unknowns from the dense M*, if ``dense`` is allocated.

    The articulated solve runs first, because projection uses its factors. ``dependent`` is the count of dependent rows
    before that solve, so that they are not counted twice.
    """
    if dense is None:  # resolved at compile time; the default program then excludes M*
        return
    ws.counts[ka.DEPENDENT] = dependent
    passes = 0
    while passes == 0 or sign_changed(ws, passes):
        passes += 1
        solve_m_star(dense, model, drives, unilateral, ws)


@kernel
def derivative(system: System, t, y, ws: Workspace, dy):
    """Compute dy/dt of the whole coupled system at time t; for y and dy see dynsim.dynamics.state."""
    model, drives, contacts, layout = system.model, system.drives, system.contacts, system.layout
    joints, motors = ws.joints, ws.motors
    n, na = joints.shape[0], motors.shape[0]
    # Most robots have one position per rate; for the other robots, reading and writing depends on the kind of joint.
    plain = layout.extra == 0
    if not plain:
        read_positions(model, y, layout.q, ws)
    for i in range(n):
        if plain:
            joints[i, ka.Q] = y[layout.q + i]
        joints[i, ka.QD] = y[layout.v + i]
        # The sweep multiplies vdot by zero; a NaN from a state without a solution would therefore persist indefinitely.
        joints[i, ka.QDD] = 0.0
        joints[i, ka.APPLIED] = -(model.body[i, ka.DAMPING] + model.body[i, ka.GEAR_DAMPING]) * joints[i, ka.QD]
    drive(drives, system.reference, t, y, layout, ws)
    apply_dry_friction(system.unilateral, ws)

    forward_sweep(model, ws, 1.0, 0.0, 1.0)
    if system.loads.table.shape[0] > 0:
        add_loads(model, system.loads, t, ws, dy, layout.load)
    contact_rows(model, contacts, system.unilateral, ws)
    shaped_rows(system.shapes, system.unilateral, model, contacts, ws)
    dependent = ws.counts[ka.DEPENDENT]
    constrained_acceleration(model, system.unilateral, ws)
    m_star_acceleration(system.dense, model, drives, system.unilateral, ws, dependent)
    admissible_forces(model, contacts, system.unilateral, ws)

    if not plain:
        for k in range(layout.q, layout.v):
            dy[k] = 0.0
        positions_along(model, y, layout.q, joints[:, ka.QD], dy)
    for i in range(n):
        if plain:
            dy[layout.q + i] = joints[i, ka.QD]
        dy[layout.v + i] = joints[i, ka.QDD]
    for a in range(na):
        if drives.table[a, ka.CIRCUIT] >= 0:
            dy[layout.current + drives.table[a, ka.CIRCUIT]] = motors[a, ka.DIDT]
    ledger_rates(model, drives, ws, dy, layout)
    dry_losses(system.unilateral, ws, dy, layout.ledger)
