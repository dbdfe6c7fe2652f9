"""Explicit Runge–Kutta methods: one step of RK43, DOPRI5 or RK4."""

from __future__ import annotations

from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.run import Run
from dynsim.integrators.steps import error_norm, finite
from dynsim.integrators.tableaux import (
    A_DOPRI5,
    A_RK4,
    ERROR_DOPRI5,
    NODE_DOPRI5,
    NODE_RK4,
    WEIGHT_ACCURACY,
    WEIGHT_STABILITY,
)
from dynsim.integrators.watch import forces_unique
from dynsim.jit.kernel import internal_kernel, merged_kernel


@internal_kernel
def weight_rk43(system: System, ws: Workspace, run: Run):
    """Weight of the error estimate of RK43, by what sets the step: accuracy or stability.

    z = |h (f(y_new) − k_4)| / |y_new − Y_4|, Y_4 the state of the fourth stage at the same time, is |h λ| of the modes
    that the two differ in (Hairer, Wanner: Solving Ordinary Differential Equations II, IV.2, eq 2.25): the method is
    stable up to z of 2.8, and smooth motions have small ones. The weight falls from 1/6 at z = 0 to 0.03
    from z = √½ on, a quarter of that.
    """
    h, y, y_new, k, atol, rtol = run.clock[ki.STEP], run.y, run.y_new, run.stage, run.clock[ki.ATOL], run.clock[ki.RTOL]
    slope, change = 0.0, 0.0
    if system.layout.extra > 0:
        for j in range(system.layout.tracked):
            k[7, j] = h * (k[6, j] - k[3, j])
        slope = error_norm(system, ws, run, k[7], 1.0) ** 2
        for j in range(system.layout.tracked):
            k[7, j] = y_new[j] - y[j] - h * k[2, j]
        change = error_norm(system, ws, run, k[7], 1.0) ** 2
    else:
        for j in range(system.layout.tracked):
            scale = 1.0 / (atol + rtol * max(abs(y[j]), abs(y_new[j])))
            df, dy = h * (k[6, j] - k[3, j]) * scale, (y_new[j] - y[j] - h * k[2, j]) * scale
            slope += df * df
            change += dy * dy
    remote = max(1.0 - 2.0 * slope / change, 0.0) if change > 0.0 else 1.0
    return WEIGHT_STABILITY + (WEIGHT_ACCURACY - WEIGHT_STABILITY) * remote * remote


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
def step_explicit(system: System, ws: Workspace, run: Run):
    """One step of an explicit Runge–Kutta method; returns the error norm, 0 for the fixed-step method.

    The last stage is the derivative at y_new; it is left in stage[6], the error estimate in stage[7].
    """
    t, h, y, y_new, k = run.clock[ki.TIME], run.clock[ki.STEP], run.y, run.y_new, run.stage
    A = A_DOPRI5 if run.method == ki.DOPRI5 else A_RK4
    node = NODE_DOPRI5 if run.method == ki.DOPRI5 else NODE_RK4
    last = A.shape[0] - 1
    for s in range(1, last + 1):
        combine(y, h, A[s], s, k, y_new)
        derivative(system, t + node[s] * h, y_new, ws, k[s if s < last else 6])
        # A fixed step may jump over what an error estimate would not let pass, so its stages are watched too.
        stage = k[s if s < last else 6]
        if run.method == ki.RK4 and finite(stage) and not forces_unique(system, ws, run, t + node[s] * h):
            return 0.0
    run.count[ki.EVALUATIONS] += last
    if run.method == ki.RK4:
        return 0.0
    if run.method == ki.RK43:
        weight = weight_rk43(system, ws, run)
        for j in range(y.shape[0]):
            k[7, j] = weight * h * (k[6, j] - k[3, j])
    else:
        for j in range(y.shape[0]):
            k[7, j] = 0.0
        combine(k[7], h, ERROR_DOPRI5, 7, k, k[7])
    return error_norm(system, ws, run, k[7], 1.0)
