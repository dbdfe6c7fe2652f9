"""Forces of dependent rows while contacts slide: the least change from the forces at the last change of modes.

If rows depend on each other, the equations of motion determine only some sums of their forces. If no contact slides,
every split of these sums gives the same motion. The friction of a sliding contact, however, is proportional to its
normal force, so that each split gives a different motion. The choice of modes has found forces s that agree with
Coulomb's law, and the right-hand side continues from them:

    f = s + Δ,   W Δ = b − W s, Δ of least norm.

Forces are thus continuous when modes change. The split of least norm itself could pull at a contact that slides in the
chosen modes.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.delassus import find_splits, solve_dependent, solve_small
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.tables import Workspace
from dynsim.jit.kernel import internal_kernel, noinline_kernel


@internal_kernel
def solve_rows(unilateral: UnilateralArrays | None, ws: Workspace, p):
    """Solve for the forces of the p active rows; return whether the rows are dependent, as :func:`solve_small` does."""
    if unilateral is None:  # resolved at compile time
        return solve_small(ws.small, ws.rows, p)
    if unilateral.number[ku.SHARED] == 1.0:
        return solve_near_shares(unilateral, ws, p)
    if unilateral.number[ku.REDUNDANT] == 1.0:
        return solve_dependent(ws.small, ws.rows, p)
    return solve_small(ws.small, ws.rows, p)


@noinline_kernel
def solve_near_shares(unilateral: UnilateralArrays, ws: Workspace, p):
    """Solve for the forces nearest to the shares; the right-hand side is unchanged."""
    rows, W, share, right = ws.rows, ws.small[0], unilateral.vector[0], unilateral.vector[1]
    for r in range(p):
        slot = share_slot(unilateral, ws, r)
        share[r], right[r] = unilateral.shares[slot] if slot >= 0 else 0.0, rows[r, ka.RHS]
    for r in range(p):
        for s in range(p):
            rows[r, ka.RHS] -= W[r, s] * share[s]
    dependent = solve_dependent(ws.small, rows, p)
    for r in range(p):
        rows[r, ka.FORCE] += share[r]
        rows[r, ka.RHS] = right[r]
    return dependent


@internal_kernel
def share_slot(unilateral: UnilateralArrays, ws: Workspace, r):
    """Return the index of row r in ``shares``: couplings, stops, joints with dry friction, candidates; −1 for ties."""
    kind, k = ws.active[r, ka.ROW_KIND], ws.active[r, ka.OWNER]
    if kind == ka.JOINT_ROW:
        return k
    if kind == ka.BODY_ROW:
        return -1
    behind = ka.MOST_ROWS * (ws.contacts.shape[0] - k)
    return unilateral.shares.shape[0] - behind + r - ws.active[k, ka.FIRST_ROW]


@internal_kernel
def keep_shares(unilateral: UnilateralArrays, ws: Workspace, modes):
    """Save the present forces as shares; call right before ``set_modes`` with ``modes``, (c,).

    Independent rows stay independent when some of them are removed.
    """
    if unilateral.number[ku.REDUNDANT] == 0.0:
        return
    write_shares(unilateral, ws)
    unilateral.number[ku.SHARED] = 1.0 if some_slide(modes) else 0.0


@internal_kernel
def write_shares(unilateral: UnilateralArrays, ws: Workspace):
    """Write the present forces of the rows to ``shares``."""
    for r in range(ws.counts[ka.ROWS]):
        slot = share_slot(unilateral, ws, r)
        if slot >= 0:
            unilateral.shares[slot] = ws.rows[r, ka.FORCE]


@internal_kernel
def some_slide(modes):
    """Return whether any candidate slides."""
    sliding = 0
    for k in range(modes.shape[0]):
        sliding += 1 if modes[k] == ka.SLIDING else 0
    return sliding > 0


@noinline_kernel
def even_out(unilateral: UnilateralArrays, ws: Workspace):
    """Remove the part of the shares of sticking points that does not affect the motion; call after ``derivative``.

    The split among the sticking points thus remains the split of least norm, even if other points slide.
    """
    shares, N, row = unilateral.shares, unilateral.room[ku.NULL_SPACE], unilateral.index[1]
    _, count, p, ties = find_splits(unilateral, ws)
    if count == 0:
        return
    for c in range(int(unilateral.number[ku.WIDTH])):
        part = 0.0
        for j in range(p):
            part += N[j, c] * shares[share_slot(unilateral, ws, row[j])]
        for j in range(p + ties):
            shares[share_slot(unilateral, ws, row[j])] -= N[j, c] * part
