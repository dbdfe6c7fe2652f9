"""Steps of explicit Runge–Kutta methods; coefficients of DOPRI5, the method 5(4) of Dormand and Prince."""

from __future__ import annotations

import numpy as np

from dynsim.dynamics import state as kst
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.events import note_inside
from dynsim.integrators.run import Run
from dynsim.integrators.steps import energy_norm, error_norm
from dynsim.jit.kernel import inline_kernel, internal_kernel

# Stage rows a_ij; the last row is the solution, whose derivative is the first stage of the next step.
A_DOPRI5 = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
NODE_DOPRI5 = np.array([0.0, 0.2, 0.3, 0.8, 8 / 9, 1.0, 1.0])
ERROR_DOPRI5 = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])


@internal_kernel
def combine(y, h, row, stages, k, y_new):
    """Write y_new = y + h Σ row_s k_s over the first ``stages`` stages."""
    for j in range(y.shape[0]):
        y_new[j] = y[j]
    for s in range(stages):
        if row[s] != 0.0:
            w = h * row[s]
            for j in range(y.shape[0]):
                y_new[j] += w * k[s, j]


@inline_kernel
def explicit_error(system: System, ws: Workspace, run: Run, row):
    """Return the error norm of an explicit step with error coefficients ``row`` (7,); the estimate is in stage[7]."""
    h, y, k = run.clock[ki.STEP], run.y, run.stage
    for j in range(y.shape[0]):
        k[7, j] = 0.0
    combine(k[7], h, row, 7, k, k[7])
    error = error_norm(system, ws, run, k[7], 1.0)
    if system.layout.circuits < ws.motors.shape[0]:
        # The currents of circuits are states, so their errors also reveal errors of the power.
        for j in (system.layout.ledger + kst.ELECTRICAL, system.layout.ledger + kst.JOULE):
            error = max(error, energy_norm(run, j, k[7, j]))
    return error


@inline_kernel
def step_explicit(system: System, ws: Workspace, run: Run, rows, nodes, errors, inner):
    """Take one step of an explicit method and return the error norm.

    The last row of ``rows`` is the solution, whose derivative, the first stage of the next step, is left in stage[6];
    the error estimate is in stage[7]. Stages ``inner`` and ``inner + 1`` are inside the step.
    """
    t, h, y, y_new, k = run.clock[ki.TIME], run.clock[ki.STEP], run.y, run.y_new, run.stage
    last = rows.shape[0] - 1
    for s in range(1, last + 1):
        combine(y, h, rows[s], s, k, y_new)
        derivative(system, t + nodes[s] * h, y_new, ws, k[6 if s == last else s])
        if run.event.shape[0] > 0 and inner <= s <= inner + 1:
            note_inside(system, ws, run, s - inner, nodes[s])
    run.count[ki.EVALUATIONS] += last
    return explicit_error(system, ws, run, errors)
