"""Rests of ties of a run that goes on from a state: measured where its scenario starts, not where the state is.

A run from its own start leaves this to its first step, ``begin_tie`` in
:mod:`dynsim.integrators.stepping.compliance`, whose formulas these are.
"""

from __future__ import annotations

import numpy as np

from dynsim.compile.model import Model
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.model.description import Array, Tie


def set_rests(model: Model, unilateral: UnilateralArrays, at_start: Array, rests: Array | None) -> None:
    """Write x_0 of the ties that hold from the start on into their table.

    Parameters
    ----------
    at_start : (nq,) coordinates at which the scenario starts
    rests : (e,) x_0 in the state [m or rad]; NaN, or None: as at the scenario's start
    """
    for k, (tie, ints, row) in enumerate(zip(model.robot.ties, unilateral.tie_table, unilateral.tie, strict=True)):
        if not tie.holds:
            continue
        (A, at), (B, other) = (model.body_pose(int(ints[end]), at_start) for end in (ku.TIE_A, ku.TIE_B))
        if np.isnan(tie.rest) and tie.turns:
            row[ku.TIE_ATTITUDE : ku.TIE_ATTITUDE + 9] = (A.T @ B).ravel()
            row[ku.TIE_REST] = 0.0
        elif np.isnan(tie.rest):
            axis, point, other_point = (row[c : c + 3] for c in (ku.TIE_AXIS, ku.TIE_POINT, ku.TIE_OTHER_POINT))
            row[ku.TIE_REST] = (A @ axis) @ (at + A @ point - other - B @ other_point)
        if rests is not None and not np.isnan(rests[k]):
            row[ku.TIE_REST] = rests[k]


def may_have_slid(tie: Tie) -> bool:
    """Whether x_0 of a tie may have moved since its run began."""
    return tie.holds and not tie.pushes and tie.stiffness > 0.0 and bool(np.isfinite(tie.bound))
