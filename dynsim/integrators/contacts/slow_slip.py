"""How long steps of RK4 may be where something slips slowly.

Friction turns a slip of speed v at the rate μ f_n/(m v). In steps that are too long for it what should come to rest
goes from side to side and never does, and RK4 has no error estimate that says so.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.tables import Workspace
from dynsim.jit.kernel import internal_kernel

# Of a step: h μ f_n/(m v). RK4 is stable up to 2.8.
MOST_TURN = 2.0


@internal_kernel
def note_turning(unilateral: UnilateralArrays, ws: Workspace, k, speed):
    """At the end of an accepted step: the longest one that follows candidate k, which slips with ``speed`` [m/s]."""
    slide = unilateral.slide
    turn = unilateral.law[k, ku.STATIC] * abs(ws.rows[ws.active[k, ka.FIRST_ROW], ka.FORCE]) * slide[k, ku.MOBILITY]
    slide[k, ku.LONGEST] = MOST_TURN * max(speed, unilateral.number[ku.SLOW]) / turn if turn > 0.0 else math.inf


@internal_kernel
def longest_step(unilateral: UnilateralArrays | None, ws: Workspace):
    """The longest step of RK4 that follows all that slips [s]."""
    longest = math.inf
    if unilateral is None:  # known to the compiler
        return longest
    for k in range(ws.active.shape[0]):
        if ws.active[k, ka.MODE] == ka.SLIDING and unilateral.slide[k, ku.FROZEN] == 0.0:
            longest = min(longest, unilateral.slide[k, ku.LONGEST])
    return longest
