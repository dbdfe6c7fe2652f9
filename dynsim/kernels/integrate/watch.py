"""What is watched at accepted steps: extremes of the contact forces, and whether these are unique."""

from __future__ import annotations

from dynsim.kernels.arrays import GAP, MODE, NORMAL_FORCE, OPEN, Workspace
from dynsim.kernels.constraint.uniqueness import REVERSED, UNIQUE, force_verdict
from dynsim.kernels.integrate.run import (
    DRIFT_MAX,
    FORCE_MAX,
    FORCE_MIN,
    FORCES_REVERSED,
    LAST_FORCE,
    LOCAL_SINCE,
    NOT_UNIQUE,
    PULLING,
    SEVERAL_FORCES,
    STATUS,
    Run,
)
from dynsim.kernels.jit import internal_kernel
from dynsim.kernels.system import System


@internal_kernel
def watch(ws: Workspace, run: Run, h):
    """Extremes of normal forces and gaps at accepted steps; time of pulling, the force linear within the last step."""
    state, extremes = ws.contacts, run.extremes
    for k in range(state.shape[0]):
        low = min(extremes[k, LAST_FORCE], state[k, NORMAL_FORCE])
        high = max(extremes[k, LAST_FORCE], state[k, NORMAL_FORCE])
        if low < 0.0 and h > 0.0:
            extremes[k, PULLING] += h if high <= 0.0 else h * low / (low - high)
        extremes[k, LAST_FORCE] = state[k, NORMAL_FORCE]
        extremes[k, FORCE_MIN] = min(extremes[k, FORCE_MIN], state[k, NORMAL_FORCE])
        extremes[k, FORCE_MAX] = max(extremes[k, FORCE_MAX], state[k, NORMAL_FORCE])
        if ws.active[k, MODE] != OPEN:
            extremes[k, DRIFT_MAX] = max(extremes[k, DRIFT_MAX], abs(state[k, GAP]))


@internal_kernel
def forces_unique(system: System, ws: Workspace, run: Run, t):
    """True when the contacts determine their forces at time t, right after ``derivative``; else sets STATUS."""
    verdict = force_verdict(ws, run.room, run.extremes[:, LOCAL_SINCE], t)
    if verdict == UNIQUE:
        return True
    run.count[STATUS] = FORCES_REVERSED if verdict == REVERSED else SEVERAL_FORCES
    run.clock[NOT_UNIQUE] = t
    return False
