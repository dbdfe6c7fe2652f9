"""Fixed steps of N runs at once: RK4 on lanes, one time for all, parameters and states of each its own.

A lane gets what a run of its own gets, to rounding: where one has left its surfaces it alone is projected. One that
cannot go on is marked and left to itself; whoever wants to know why runs it alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import uniqueness as kq
from dynsim.dynamics.contact.uniqueness import clearly_unique, force_verdict
from dynsim.dynamics.derivative import System
from dynsim.dynamics.simd.system import derivative_lanes
from dynsim.dynamics.simd.tables import AXES, lane, lane_count, stack_tables, tables_as_lanes
from dynsim.dynamics.state import OutputLayout
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import normalise
from dynsim.integrators import project as kp
from dynsim.integrators import run as ki
from dynsim.integrators.dense import fill_dense, interpolate
from dynsim.integrators.output import fill_output
from dynsim.integrators.project import off_surface, project
from dynsim.integrators.run import Run
from dynsim.integrators.steps import finished, finite
from dynsim.integrators.watch import watch
from dynsim.jit.kernel import internal_kernel, kernel


class LaneRuns(NamedTuple):
    """N runs side by side; what is called as in :class:`~dynsim.integrators.run.Run` is that, with lanes."""

    method: int
    columns: OutputLayout
    newton: None
    hand_link: int
    hand_point: np.ndarray  # (3, N)
    y: np.ndarray  # (m, N)
    y_new: np.ndarray  # (m, N)
    stage: np.ndarray  # (8, m, N)
    dense: np.ndarray  # (4, m, N)
    extremes: np.ndarray  # (c, EXTREMES_SIZE, N)
    sample: np.ndarray  # (T, m, N)
    output: np.ndarray  # (T, columns.size, N)
    sample_time: np.ndarray  # (T,)
    room: np.ndarray  # (ROOM, p, p)
    clock: np.ndarray  # (CLOCK_SIZE,) one time and step for all
    count: np.ndarray  # (COUNT_SIZE,) int
    projections: np.ndarray  # (N,) int
    settled: np.ndarray  # (N,) int: how often a lane was off its surfaces after a step
    failed: np.ndarray  # (N,) int: 1 when it cannot go on


AXES[LaneRuns] = {
    "hand_point": 1,
    "y": 1,
    "y_new": 1,
    "stage": 2,
    "dense": 2,
    "extremes": 2,
    "sample": 2,
    "output": 2,
}


def lane_runs(runs: Sequence[Run]) -> LaneRuns:
    """Runs of RK4 that have not begun, with one clock, layout and sample times for all, as lanes."""
    count = len(runs)
    own = {name: np.zeros(count, dtype=np.int64) for name in ("projections", "settled", "failed")}
    shared = [name for name in LaneRuns._fields if name not in own]
    found: LaneRuns = stack_tables([LaneRuns(**{name: getattr(run, name) for name in shared}, **own) for run in runs])
    return found._replace(clock=found.clock.copy(), count=found.count.copy(), room=found.room.copy())


@kernel
def advance_lanes(width, system: System, ws: Workspace, runs: LaneRuns, limit):
    """Take up to ``limit`` steps towards END; STATUS says when they are there, or all lanes have failed.

    Parameters
    ----------
    width : FOUR or EIGHT of dynsim.dynamics.simd.system
    system : tables may have lanes
    ws : of ``lane_workspace``, or stacked
    """
    tables, room, lanes = tables_as_lanes(system, width), tables_as_lanes(ws, width), tables_as_lanes(runs, width)
    clock, count = runs.clock, runs.count
    if count[ki.STARTED] == 0:
        count[ki.STARTED] = 1
        derivative_lanes(tables, clock[ki.TIME], lanes.y, room, lanes.stage[0])
        settle_lanes(tables, clock[ki.TIME], lanes.y, room, lanes.stage[0], lanes)
        see(room, lanes, lanes.stage[0], clock[ki.TIME])
        watch_lanes(room, lanes, 0.0)
    for _ in range(limit):
        if finished(runs):
            return
        proposed = clock[ki.STEP]
        # As dynsim.integrators.steps.choose_step does it.
        if clock[ki.END] - clock[ki.TIME] < proposed * (1.0 + 1e-9):
            clock[ki.STEP] = clock[ki.END] - clock[ki.TIME]
        step_rk4(tables, room, lanes)
        accept_lanes(tables, room, lanes)
        clock[ki.STEP] = proposed


@internal_kernel
def step_rk4(system: System, ws: Workspace, runs: LaneRuns):
    """y_new, and the derivative there in stage[6]; sums in the order of dynsim.integrators.explicit."""
    t, h, y, y_new, k = runs.clock[ki.TIME], runs.clock[ki.STEP], runs.y, runs.y_new, runs.stage
    shift(y, 0.5 * h, k[0], y_new)
    derivative_lanes(system, t + 0.5 * h, y_new, ws, k[1])
    see(ws, runs, k[1], t + 0.5 * h)
    shift(y, 0.5 * h, k[1], y_new)
    derivative_lanes(system, t + 0.5 * h, y_new, ws, k[2])
    see(ws, runs, k[2], t + 0.5 * h)
    shift(y, h, k[2], y_new)
    derivative_lanes(system, t + h, y_new, ws, k[3])
    see(ws, runs, k[3], t + h)
    for j in range(y.shape[0]):
        y_new[j] = (y[j] + h * (1.0 / 6.0) * k[0, j] + h * (1.0 / 3.0) * k[1, j] + h * (1.0 / 3.0) * k[2, j]) + h * (
            1.0 / 6.0
        ) * k[3, j]
    derivative_lanes(system, t + h, y_new, ws, k[6])


@internal_kernel
def shift(y, h, k, out):
    """out = y + h k."""
    for j in range(y.shape[0]):
        out[j] = y[j] + h * k[j]


@internal_kernel
def accept_lanes(system: System, ws: Workspace, runs: LaneRuns):
    """Project y_new, record, and make it the new y."""
    clock, count, y, y_new, k = runs.clock, runs.count, runs.y, runs.y_new, runs.stage
    t = clock[ki.TIME] + clock[ki.STEP]
    nothing = 0.0 * y_new[0]
    for j in range(y.shape[0]):
        nothing += y_new[j] * 0.0 + k[6, j] * 0.0
    left = 0
    for n in range(lane_count(y)):
        if lane(nothing, n) != 0.0:  # NaN
            runs.failed[n] = 1
        left += 1 - runs.failed[n]
    if left == 0:
        count[ki.STATUS] = ki.NOT_FINITE
        return
    settle_lanes(system, t, y_new, ws, k[6], runs)
    see(ws, runs, k[6], t)
    watch_lanes(ws, runs, clock[ki.STEP])
    normalise_lanes(system, y_new)
    sample_lanes(system, ws, runs)
    for j in range(y.shape[0]):
        y[j] = y_new[j]
        k[0, j] = k[6, j]
    clock[ki.TIME] = t
    count[ki.STEPS] += 1


@internal_kernel
def settle_lanes(system: System, t, y, ws: Workspace, dy, runs: LaneRuns):
    """Project those lanes that have left their surfaces, after the derivative at y; that is made anew for all."""
    if ws.counts[ka.ROWS] == 0:
        return
    for attempt in range(kp.PROJECTION_LIMIT):
        moved = False
        for k in range(lane_count(y)):
            if runs.failed[k] == 0 and off_surface(lane(ws, k)):
                project(lane(system, k), lane(ws, k), lane(y, k))
                runs.projections[k] += 1
                runs.settled[k] += 1 if attempt == 0 else 0
                moved = True
        if not moved:
            return
        derivative_lanes(system, t, y, ws, dy)
    for k in range(lane_count(y)):
        if off_surface(lane(ws, k)):
            runs.failed[k] = 1


@internal_kernel
def see(ws: Workspace, runs: LaneRuns, dy, t):
    """Lanes whose contacts do not determine their forces fail."""
    if clearly_unique(ws):
        return
    for k in range(lane_count(dy)):
        since = lane(runs, k).extremes[:, ki.LOCAL_SINCE]
        if runs.failed[k] == 0 and finite(lane(dy, k)) and force_verdict(lane(ws, k), runs.room, since, t) != kq.UNIQUE:
            runs.failed[k] = 1


@internal_kernel
def watch_lanes(ws: Workspace, runs: LaneRuns, h):
    """:func:`~dynsim.integrators.watch.watch` of each."""
    if ws.contacts.shape[0] > 0:
        for k in range(lane_count(ws)):
            watch(lane(ws, k), lane(runs, k), h)


@internal_kernel
def normalise_lanes(system: System, y):
    """Unit quaternions."""
    if system.layout.extra > 0:
        for k in range(lane_count(y)):
            normalise(system.model.compound, lane(system.model, k), lane(y, k), system.layout.q)


@internal_kernel
def sample_lanes(system: System, ws: Workspace, runs: LaneRuns):
    """As dynsim.integrators.dense.sample_step."""
    t, h, end = runs.clock[ki.TIME], runs.clock[ki.STEP], runs.clock[ki.END]
    until = end if t + h >= end - 1e-12 * max(1.0, end) else t + h
    last = runs.count[ki.SAMPLE]
    if last >= runs.sample_time.shape[0] or runs.sample_time[last] > until:
        return
    fill_dense(runs)
    while last < runs.sample_time.shape[0] and runs.sample_time[last] <= until:
        y = runs.sample[last]
        interpolate(runs, runs.sample_time[last], y)
        normalise_lanes(system, y)
        derivative_lanes(system, runs.sample_time[last], y, ws, runs.stage[7])
        settle_lanes(system, runs.sample_time[last], y, ws, runs.stage[7], runs)
        fill_output(system, ws, runs, runs.output[last])
        last += 1
    runs.count[ki.SAMPLE] = last
