"""The explicit Runge–Kutta method: one step of DOPRI5."""

from __future__ import annotations

from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.run import Run
from dynsim.integrators.steps import error_norm
from dynsim.integrators.tableaux import A_DOPRI5, ERROR_DOPRI5, NODE_DOPRI5
from dynsim.jit.kernel import internal_kernel, merged_kernel


@internal_kernel
def combine(y, h, row, stages, k, y_new):
    """y_new = y + h Σ row_s k_s over the first ``stages`` stages."""
    for j in range(y.shape[0]):
        y_new[j] = y[j]
    for s in range(stages):
        if row[s] != 0.0:
            w = h * row[s]
            for j in range(y.shape[0]):
                y_new[j] += w * k[s, j]


@merged_kernel
def step_dopri5(system: System, ws: Workspace, run: Run):
    """One step of Dormand and Prince's method; returns the error norm.

    The last stage is the derivative at y_new; it is left in stage[6], the error estimate in stage[7].
    """
    t, h, y, y_new, k = run.clock[ki.TIME], run.clock[ki.STEP], run.y, run.y_new, run.stage
    for s in range(1, 7):
        combine(y, h, A_DOPRI5[s], s, k, y_new)
        derivative(system, t + NODE_DOPRI5[s] * h, y_new, ws, k[s])
    run.count[ki.EVALUATIONS] += 6
    for j in range(y.shape[0]):
        k[7, j] = 0.0
    combine(k[7], h, ERROR_DOPRI5, 7, k, k[7])
    return error_norm(system, ws, run, k[7], 1.0)
