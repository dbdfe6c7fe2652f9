"""Statistics of accepted steps: extremes of contact forces and gaps, time of pulling; uniqueness of the forces."""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import uniqueness as kq
from dynsim.dynamics.contact.uniqueness import force_verdict
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.run import Run
from dynsim.jit.kernel import internal_kernel


@internal_kernel
def watch(ws: Workspace, run: Run, h):
    """Extremes of normal forces and gaps at accepted steps; time of pulling, the force linear within the last step."""
    state, extremes = ws.contacts, run.extremes
    for k in range(state.shape[0]):
        low = min(extremes[k, ki.LAST_FORCE], state[k, ka.NORMAL_FORCE])
        high = max(extremes[k, ki.LAST_FORCE], state[k, ka.NORMAL_FORCE])
        if low < 0.0 and h > 0.0:
            extremes[k, ki.PULLING] += h if high <= 0.0 else h * low / (low - high)
        extremes[k, ki.LAST_FORCE] = state[k, ka.NORMAL_FORCE]
        extremes[k, ki.FORCE_MIN] = min(extremes[k, ki.FORCE_MIN], state[k, ka.NORMAL_FORCE])
        extremes[k, ki.FORCE_MAX] = max(extremes[k, ki.FORCE_MAX], state[k, ka.NORMAL_FORCE])
        if ws.active[k, ka.MODE] != ka.OPEN:
            extremes[k, ki.DRIFT_MAX] = max(extremes[k, ki.DRIFT_MAX], abs(state[k, ka.GAP]))


@internal_kernel
def forces_unique(system: System, ws: Workspace, run: Run, t):
    """True when the contacts determine their forces at time t, right after ``derivative``; else sets STATUS."""
    verdict = force_verdict(ws, run.room, run.extremes[:, ki.LOCAL_SINCE], t)
    if verdict == kq.UNIQUE:
        return True
    run.count[ki.STATUS] = ki.FORCES_REVERSED if verdict == kq.REVERSED else ki.SEVERAL_FORCES
    run.clock[ki.NOT_UNIQUE] = t
    return False
