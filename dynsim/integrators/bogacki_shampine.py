"""BOGACKI_SHAMPINE, the explicit Runge–Kutta method 3(2) of Bogacki and Shampine (1989): coefficients and loop.

A step takes three evaluations; at loose tolerances, a run takes fewer evaluations than with DOPRI5. The dense output is
the cubic Hermite polynomial.
"""

from __future__ import annotations

import numpy as np

from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.integrators.driver import advance_explicit
from dynsim.integrators.run import Run
from dynsim.jit.kernel import free_kernel

# Stage rows a_ij, with the solution as the last row, whose derivative is the next step's first stage.
A = np.array([[0.0, 0.0, 0.0], [1 / 2, 0.0, 0.0], [0.0, 3 / 4, 0.0], [2 / 9, 1 / 3, 4 / 9]])
NODE = np.array([0.0, 1 / 2, 3 / 4, 1.0])
ERROR = np.array([-5 / 72, 1 / 12, 1 / 9, 0.0, 0.0, 0.0, -1 / 8])


@free_kernel
def advance_bogacki_shampine(system: System, ws: Workspace, run: Run, limit):
    """Take up to ``limit`` steps, see :func:`dynsim.integrators.driver.advance`."""
    advance_explicit(system, ws, run, limit, A, NODE, ERROR, 1, 3.0)
