"""BOGACKI_SHAMPINE, the explicit Runge–Kutta method 3(2) of Bogacki and Shampine (1989): coefficients, step and loop.

Three evaluations a step; at loose tolerances fewer than DOPRI5 needs. Dense output is the cubic Hermite polynomial.
"""

from __future__ import annotations

import numpy as np

from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.dopri5 import combine, explicit_error
from dynsim.integrators.driver import can_step, conclude, propose
from dynsim.integrators.events import note_inside
from dynsim.integrators.run import Run
from dynsim.integrators.steps import finished, stalled
from dynsim.jit.kernel import free_kernel, inline_kernel

# Stage rows a_ij, with the solution as the last row, whose derivative is the next step's first stage.
A = np.array([[0.0, 0.0, 0.0], [1 / 2, 0.0, 0.0], [0.0, 3 / 4, 0.0], [2 / 9, 1 / 3, 4 / 9]])
NODE = np.array([0.0, 1 / 2, 3 / 4, 1.0])
ERROR = np.array([-5 / 72, 1 / 12, 1 / 9, 0.0, 0.0, 0.0, -1 / 8])


@inline_kernel
def step_bogacki_shampine(system: System, ws: Workspace, run: Run):
    """Take one step and return its error norm.

    The last stage is the derivative at y_new; it is left in stage[6], the error estimate in stage[7].
    """
    t, h, y, y_new, k = run.clock[ki.TIME], run.clock[ki.STEP], run.y, run.y_new, run.stage
    for s in range(1, 4):
        combine(y, h, A[s], s, k, y_new)
        derivative(system, t + NODE[s] * h, y_new, ws, k[6 if s == 3 else s])
        if run.event.shape[0] > 0 and s < 3:
            note_inside(system, ws, run, s - 1, NODE[s])
    run.count[ki.EVALUATIONS] += 3
    for s in range(3, 6):
        for j in range(y.shape[0]):
            k[s, j] = 0.0
    return explicit_error(system, ws, run, ERROR)


@free_kernel
def advance_bogacki_shampine(system: System, ws: Workspace, run: Run, limit):
    """Take up to ``limit`` steps, see :func:`dynsim.integrators.driver.advance`."""
    taken, error = 0, 0.0
    if limit < 0:
        return
    while can_step(system, ws, run):
        if taken >= limit or finished(run) or stalled(run):
            return
        taken += 1
        if run.count[ki.PENDING] == 0:
            propose(run)
            error = step_bogacki_shampine(system, ws, run)
        if conclude(system, ws, run, error, 3.0):
            return
