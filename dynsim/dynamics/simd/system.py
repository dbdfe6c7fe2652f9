"""The right-hand side on lanes: several states, times and sets of parameters at once, by the kernels of one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import config, types

from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.simd import forms  # noqa: F401
from dynsim.dynamics.simd.tables import as_lanes, lane, lane_count, lane_tables, spread_tables, tables_as_lanes
from dynsim.dynamics.tables import Workspace
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import internal_kernel, kernel

# Without the compiler there are no lanes: their kernels are for it alone.
COMPILED = not config.DISABLE_JIT
# What says how wide lanes are: a tuple of so many zeros.
FOUR, EIGHT = (0.0,) * 4, (0.0,) * 8


def lane_workspace(ws: Workspace, width: tuple) -> Workspace:
    """A workspace of lanes, all of which are what ``ws`` is; rows and modes are the same for all.

    Sines are computed a lane at a time, so ``trig`` needs no padding.
    """
    found: Workspace = spread_tables(ws._replace(trig=ws.trig[:, : len(ws.joints)]), len(width))
    return found._replace(active=ws.active.copy(), counts=ws.counts.copy())


@internal_kernel
def derivative_lanes(system: System, t, y, ws: Workspace, dy):
    """``derivative`` of all lanes, one by one; t one time or lanes. Systems that have a form for lanes take that."""
    for k in range(lane_count(y)):
        derivative(lane(system, k), lane(t, k), lane(y, k), lane(ws, k), lane(dy, k))


# Parts of a system whose kernels have no forms for lanes.
_WITHOUT_FORMS = ("dense", "shapes")


def has_forms(system: System) -> bool:
    """True of points on quadrics, by the articulated solve; other systems go lane by lane."""
    return all(getattr(system, name) is None for name in _WITHOUT_FORMS)


def _have_forms(system: Any, *_: Any) -> bool:
    """The same by types."""
    parts = dict(zip(System._fields, system, strict=True))
    return all(parts[name] == types.none for name in _WITHOUT_FORMS)


@form_of(derivative_lanes, _have_forms)
def derivative_at_once(system: System, t, y, ws: Workspace, dy):
    """``derivative`` itself, compiled for lanes."""
    derivative(system, t, y, ws, dy)


@kernel
def evaluate_lanes(width, system: System, t, y, ws: Workspace, dy):
    """:func:`derivative_lanes` of float tables whose last axis is the lanes; t a number."""
    derivative_lanes(
        tables_as_lanes(system, width),
        t,
        as_lanes(y, width),
        tables_as_lanes(ws, width),
        as_lanes(dy, width),
    )


@kernel
def evaluate_lanes_at(width, system: System, t, y, ws: Workspace, dy):
    """The same at times of their own, t (N,)."""
    derivative_lanes(
        tables_as_lanes(system, width),
        as_lanes(t, width)[()],
        as_lanes(y, width),
        tables_as_lanes(ws, width),
        as_lanes(dy, width),
    )


def derivatives(system: System, t: Any, y: np.ndarray, ws: Workspace, dy: np.ndarray) -> None:
    """dy/dt of N states at once, N = 4 or 8.

    Parameters
    ----------
    system : tables of :data:`~dynsim.dynamics.simd.tables.AXES` may have a last axis of N sets of parameters
    t : time, or (N,) times [s]
    y, dy : (layout.size, N)
    ws : of :func:`lane_workspace`
    """
    width = (0.0,) * y.shape[-1]
    if not COMPILED:
        for k in range(len(width)):
            at = t[k] if isinstance(t, np.ndarray) else t
            derivative(lane_tables(system, k), at, y[:, k], lane_tables(ws, k), dy[:, k])
    elif isinstance(t, np.ndarray):
        evaluate_lanes_at(width, system, t, y, ws, dy)
    else:
        evaluate_lanes(width, system, t, y, ws, dy)
