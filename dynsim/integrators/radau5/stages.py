"""Right-hand sides that RADAU5 needs together, on lanes if it has any: three stages, and columns of the Jacobian.

Four lanes do for both: a second width would be a second program to compile.
"""

from __future__ import annotations

from typing import Any

from numba.core import types

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.simd.system import FOUR, derivative_lanes
from dynsim.dynamics.simd.tables import as_lanes, tables_as_lanes
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import displace
from dynsim.integrators.radau5 import newton as kn
from dynsim.integrators.radau5.newton import NewtonArrays, StageLanes
from dynsim.integrators.tableaux import NODE_RADAU
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import apart_kernel, internal_kernel


@internal_kernel
def displaced(system: System, ws: Workspace, y, s, x):
    """x = y but for number s of the rates' displacements, the rates and the currents; returns by how much."""
    n, layout = ws.joints.shape[0], system.layout
    for j in range(y.shape[0]):
        x[j] = y[j]
    if s < n and layout.extra > 0:
        for i in range(n):
            ws.joints[i, ka.QDD] = 1e-7 if i == s else 0.0
        displace(system.model.compound, system.model, ws, x, layout.q)
        return 1e-7
    j = layout.q + s if s < n else layout.v + s - n if s < 2 * n else layout.current + s - 2 * n
    delta = 1e-3 if s >= 2 * n else 1e-8 * max(abs(y[j]), 0.1) if s >= n else 1e-7 * max(abs(y[j]), 1.0)
    x[j] = y[j] + delta
    return x[j] - y[j]


@internal_kernel
def columns(lanes: StageLanes | None, system: System, ws: Workspace, t, y, x, base, r: NewtonArrays):
    """Finite differences of v̇ into ``r.along``, right after ``derivative`` at y, which is ``base``; x (m,) is room."""
    v = system.layout.v
    for s in range(r.along.shape[0]):
        delta = displaced(system, ws, y, s, x)
        derivative(system, t, x, ws, r.f[0])
        r.count[kn.COLUMNS] += 1
        for i in range(r.along.shape[1]):
            r.along[s, i] = (r.f[0, v + i] - base[v + i]) / delta


@internal_kernel
def evaluate_stages(lanes: StageLanes | None, system: System, ws: Workspace, t, h, y, x, r: NewtonArrays):
    """Derivatives at the stages, into ``r.f``; x (m,) is room."""
    for s in range(3):
        for j in range(r.kept.shape[1]):
            x[j] = y[j] + r.z[s, j]
        derivative(system, t + NODE_RADAU[s] * h, x, ws, r.f[s])


def _given(lanes: Any, *_: Any) -> bool:
    return bool(lanes != types.none)


@apart_kernel
def evaluate_four(lanes: StageLanes, system: System):
    """The derivative of all lanes, one program for both of its callers."""
    derivative_lanes(
        system,
        as_lanes(lanes.t, FOUR)[()],
        as_lanes(lanes.y, FOUR),
        tables_as_lanes(lanes.ws, FOUR),
        as_lanes(lanes.f, FOUR),
    )


@form_of(columns, _given)
def columns_on_lanes(lanes, system, ws, t, y, x, base, r):
    """Four columns at a time; the last ones once more where their number is no multiple."""
    v, last = system.layout.v, r.along.shape[0] - 1
    take_rows(ws, lanes.ws)
    for first in range(0, last + 1, 4):
        for k in range(4):
            lanes.t[k] = t
            lanes.delta[k] = displaced(system, ws, y, min(first + k, last), lanes.y[:, k])
        evaluate_four(lanes, system)
        r.count[kn.COLUMNS] += 4
        for k in range(4):
            s = min(first + k, last)
            for i in range(r.along.shape[1]):
                r.along[s, i] = (lanes.f[v + i, k] - base[v + i]) / lanes.delta[k]


@form_of(evaluate_stages, _given)
def stages_on_lanes(lanes, system, ws, t, h, y, x, r):
    """Three lanes, and the last of them again."""
    for j in range(r.kept.shape[1]):
        z0, z1, z2 = y[j] + r.z[0, j], y[j] + r.z[1, j], y[j] + r.z[2, j]
        lanes.y[j, 0], lanes.y[j, 1], lanes.y[j, 2], lanes.y[j, 3] = z0, z1, z2, z2
    for k in range(4):
        lanes.t[k] = t + NODE_RADAU[min(k, 2)] * h
    evaluate_four(lanes, system)
    for j in range(y.shape[0]):
        r.f[0, j], r.f[1, j], r.f[2, j] = lanes.f[j, 0], lanes.f[j, 1], lanes.f[j, 2]


@internal_kernel
def take_rows(ws: Workspace, lanes: Workspace):
    """Rows, modes and anchors of a workspace for all lanes of another one."""
    for r in range(ws.active.shape[0]):
        for s in range(ws.active.shape[1]):
            lanes.active[r, s] = ws.active[r, s]
        for s in range(ws.rows.shape[1]):
            for k in range(4):
                lanes.rows[r, s, k] = ws.rows[r, s]
    for c in range(ws.contacts.shape[0]):
        for s in range(ws.contacts.shape[1]):
            for k in range(4):
                lanes.contacts[c, s, k] = ws.contacts[c, s]
    for s in range(ws.counts.shape[0]):
        lanes.counts[s] = ws.counts[s]
    # As solves leave it that have other rows: joints that none of them feels are zero.
    for i in range(ws.column.shape[0]):
        for s in range(ws.column.shape[1]):
            for k in range(4):
                lanes.column[i, s, k] = 0.0
