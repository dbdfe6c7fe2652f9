"""The right-hand side on SIMD lanes: ``derivative`` of four states at four times, and its tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.simd import forms  # noqa: F401
from dynsim.dynamics.simd.tables import aligned, as_lanes, lane_workspace, tables_as_lanes
from dynsim.dynamics.tables import Workspace
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Parts of a system whose kernels have no forms for lanes.
_WITHOUT_FORMS = ("dense", "shapes")


def has_forms(system: System) -> bool:
    """True of points on quadrics, by the articulated solve: only their right-hand sides compile for lanes."""
    return all(getattr(system, name) is None for name in _WITHOUT_FORMS)


class StageLanes(NamedTuple):
    """Room for right-hand sides that are evaluated four at a time."""

    ws: Workspace
    t: np.ndarray  # (4,)
    y: np.ndarray  # (m, 4)
    f: np.ndarray  # (m, 4)
    delta: np.ndarray  # (4,)
    output: np.ndarray  # (columns.size, 4), see dynsim.dynamics.state.OutputLayout


def stage_lanes(ws: Workspace, m: int, columns: int) -> StageLanes:
    """Allocate :class:`StageLanes` beside a workspace, whose rows are taken whenever the Jacobian is made anew."""
    return StageLanes(lane_workspace(ws), aligned(4), aligned(m, 4), aligned(m, 4), aligned(4), aligned(columns, 4))


@noinline_kernel
def evaluate_four(lanes: StageLanes, system: System):
    """``derivative`` of all lanes, one program for all of its callers."""
    derivative(system, as_lanes(lanes.t)[()], as_lanes(lanes.y), tables_as_lanes(lanes.ws), as_lanes(lanes.f))


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
