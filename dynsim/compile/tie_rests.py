"""Rest values of ties in a run that starts from a given state; they are measured at the start of the scenario.

In a run that begins at the scenario's start, the first step sets them: ``begin_tie`` in
:mod:`dynsim.integrators.stepping.contacts` uses the same formulas.
"""

from __future__ import annotations

import numpy as np

from dynsim.compile.hand_posture import turn_error
from dynsim.compile.model import Model
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.model.description import Array, Tie


def set_rests(model: Model, unilateral: UnilateralArrays, at_start: Array, rests: Array | None) -> None:
    """Write x_0 of the ties that hold from the start into their table.

    Parameters
    ----------
    model : Model
        Model of the robot.
    unilateral : UnilateralArrays
        Tables of the unilateral law.
    at_start : (nq,) ndarray
        Coordinates at the start of the scenario.
    rests : (e,) ndarray or None
        x_0 in the state [m or rad]; NaN or None: as at the start of the scenario.
    """
    for k, (tie, row) in enumerate(zip(model.robot.ties, unilateral.tie, strict=True)):
        if not tie.holds:
            continue
        if np.isnan(tie.rest):
            rest_here(model, unilateral, k, at_start)
        if rests is not None and not np.isnan(rests[k]):
            row[ku.TIE_REST] = rests[k]


def rest_here(model: Model, unilateral: UnilateralArrays, k: int, q: Array) -> None:
    """Write the rest value of tie k into its table, so that it has no deflection at coordinates (nq,)."""
    row = unilateral.tie[k]
    row[ku.TIE_REST] = 0.0
    if unilateral.tie_table[k, ku.TIE_TURNS] == 1:
        (A, _), (B, _) = _ends(model, unilateral, k, q)
        row[ku.TIE_ATTITUDE : ku.TIE_ATTITUDE + 9] = (A.T @ B).ravel()
    else:
        row[ku.TIE_REST] = deflection(model, unilateral, k, q)


def may_have_slid(tie: Tie) -> bool:
    """Return whether x_0 of a tie may have moved since its run started."""
    return tie.holds and not tie.pushes and tie.stiffness > 0.0 and bool(np.isfinite(tie.bound))


def deflection(model: Model, unilateral: UnilateralArrays, k: int, q: Array) -> float:
    """Return x − x_0 of tie k at coordinates (nq,) [m or rad]; a torsion is within half a turn."""
    row = unilateral.tie[k]
    (A, at), (B, other) = _ends(model, unilateral, k, q)
    axis = row[ku.TIE_AXIS : ku.TIE_AXIS + 3]
    if unilateral.tie_table[k, ku.TIE_TURNS] == 1:
        x = -axis @ turn_error(row[ku.TIE_ATTITUDE : ku.TIE_ATTITUDE + 9].reshape(3, 3), A.T @ B)
    else:
        point, other_point = row[ku.TIE_POINT : ku.TIE_POINT + 3], row[ku.TIE_OTHER_POINT : ku.TIE_OTHER_POINT + 3]
        x = (A @ axis) @ (at + A @ point - other - B @ other_point)
    return float(x - row[ku.TIE_REST])


def _ends(model: Model, unilateral: UnilateralArrays, k: int, q: Array) -> tuple[tuple[Array, Array], ...]:
    """Return the rotation and origin of both bodies of tie k; the second body may be the world."""
    a, b = unilateral.tie_table[k, [ku.TIE_A, ku.TIE_B]].tolist()
    return model.body_pose(a, q), (np.eye(3), np.zeros(3)) if b < 0 else model.body_pose(b, q)
