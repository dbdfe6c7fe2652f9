"""Release of joints that dry friction holds although other rows have begun to turn them.

The row of a joint may depend on other rows in one posture only, such as that of a point at the crest of a surface. As
the point rolls off it the rows contradict each other, at first by so little that neither the rank of their system nor
their accelerations show it. Projection cannot remove this contradiction from gaps and rates, where it grows as the
point rolls on. Held by friction of finite strength, the joint follows the other rows instead.
"""

from __future__ import annotations

import math

from dynsim.dynamics import state as kst
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.rows import row_errors, set_modes
from dynsim.dynamics.contact.unilateral import UnilateralArrays, dry_bound
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.integrators.contacts.impacts import evaluate
from dynsim.integrators.contacts.modes import LEAST_SHARE
from dynsim.integrators.contacts.resting import leave_least
from dynsim.integrators.project import GAP_TOLERANCE, RATE_TOLERANCE, project_level
from dynsim.integrators.run import Run
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Share of the tolerances of projection that errors which it cannot remove may reach, and the share below which a sum of
# errors need not be looked at.
MOST_LEFT, LITTLE_LEFT = 0.5, 0.25


@internal_kernel
def note_left(unilateral: UnilateralArrays, ws: Workspace):
    """Note the error that projection leaves right after a choice of modes; it does not grow if nothing moves."""
    left = 0.0
    if unilateral.number[ku.REDUNDANT] == 1.0:
        left, _ = contradiction(unilateral, ws)
    unilateral.number[ku.LEFT] = left


@internal_kernel
def most_left(unilateral: UnilateralArrays):
    """Share of the tolerances at which a joint is released: growing errors may use half of the remaining tolerance."""
    return unilateral.number[ku.LEFT] + MOST_LEFT * (1.0 - unilateral.number[ku.LEFT])


@internal_kernel
def left_margin(unilateral: UnilateralArrays, ws: Workspace, k):
    """1 where rows agree; below 0 if a joint is to be let go. The guard of the first held joint looks for all."""
    for j in range(k):
        if unilateral.dry_table[j, ku.DRY_HOLDS] == 1:
            return 1.0
    left, _ = contradiction(unilateral, ws)
    return 1.0 - left / most_left(unilateral)


@noinline_kernel
def contradiction(unilateral: UnilateralArrays, ws: Workspace):
    """What projection leaves of gaps and rates along rows of which held joints are a part, right after ``derivative``.

    Nothing else in the workspace changes.

    Returns
    -------
    left, joint : its norm as a share of the tolerance, the larger of both levels; the joint to release, or −1
    """
    rows, p, off, most, gives = ws.rows, ws.counts[ka.ROWS], 0.0, 0.0, -1
    row_errors(ws)
    for r in range(p):
        off += (rows[r, ka.ROW_GAP] / GAP_TOLERANCE) ** 2 + (rows[r, ka.ROW_RATE] / RATE_TOLERANCE) ** 2
    # The remainder of least squares is no larger than the errors themselves.
    if off <= LITTLE_LEFT * LITTLE_LEFT:
        return most, gives
    force, right, errors = unilateral.vector[0], unilateral.vector[1], unilateral.vector[2]
    small = unilateral.room[ku.PROBLEM :]
    for r in range(p):
        force[r], right[r] = rows[r, ka.FORCE], rows[r, ka.RHS]
    for level in range(2):
        leave_least(ws, small, ka.ROW_GAP if level == 0 else ka.ROW_RATE, errors)
        norm = 0.0
        for r in range(p):
            norm += errors[r] * errors[r]
        norm = math.sqrt(norm)
        left, joint = norm / (GAP_TOLERANCE if level == 0 else RATE_TOLERANCE), first_to_yield(unilateral, errors, norm)
        if left > most and joint >= 0:
            most, gives = left, joint
    for r in range(p):
        rows[r, ka.FORCE], rows[r, ka.RHS] = force[r], right[r]
    return most, gives


@internal_kernel
def first_to_yield(unilateral: UnilateralArrays, errors, norm):
    """Return the held joint that slips first as forces against these errors grow; −1 if none has a part in them.

    The errors are along the one combination w of rows with wᵀ J = 0, so that their forces may change along w without
    another motion. Forces against the errors grow until one of them is at the bound that opposes its error.
    """
    table, least, joint, forces = unilateral.dry_table, math.inf, -1, unilateral.vector[0]
    for k in range(table.shape[0]):
        r = table[k, ku.DRY_ROW]
        if table[k, ku.DRY_HOLDS] == 1 and abs(errors[r]) > LEAST_SHARE * norm:
            room = dry_bound(unilateral, k) + (forces[r] if errors[r] > 0.0 else -forces[r])
            if room / abs(errors[r]) < least:
                least, joint = room / abs(errors[r]), k
    return joint


@noinline_kernel
def let_joint_go(system: System, ws: Workspace, run: Run):
    """Let a held joint that contradicts other rows move as these rows turn it; True if there was one.

    Right after :func:`evaluate`; all modes are to be chosen then. If the rate of the joint is only rounding it will be
    held again, where it is then.
    """
    unilateral, mode, y, layout = system.unilateral, system.unilateral.mode, run.y, system.layout
    if unilateral.number[ku.REDUNDANT] == 0.0:
        return False
    left, k = contradiction(unilateral, ws)
    # Half of the growth is enough: rounding changes the value by which an event has been located.
    if k < 0 or left < 0.5 * (unilateral.number[ku.LEFT] + most_left(unilateral)):
        return False
    unilateral.dry_table[k, ku.DRY_HOLDS] = 0
    for j in range(mode.shape[0]):
        mode[j, ku.WANTED] = ws.active[j, ka.MODE]
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.WANTED])
    evaluate(system, ws, run)
    project_level(system, ws, y, 0)
    y[layout.loss + kst.IMPACT_LOSS] += project_level(system, ws, y, 1)
    unilateral.dry[k, ku.DRY_SIDE] = 1.0 if y[layout.v + unilateral.dry_table[k, ku.DRY_JOINT]] > 0.0 else -1.0
    return True
