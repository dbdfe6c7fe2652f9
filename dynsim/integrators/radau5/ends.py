"""End of a RADAU5 step: derivative, constraint and uniqueness checks, and samples on lanes.

On SIMD lanes the end is evaluated with waiting samples of earlier steps: four states cost about as much as one.
"""

from __future__ import annotations

from typing import Any

from numba.core import types

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.contact.uniqueness import clearly_unique
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.simd.system import StageLanes, evaluate_four
from dynsim.dynamics.simd.tables import as_lanes, lane, tables_as_lanes
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.dense import write_sample, write_samples, write_waiting
from dynsim.integrators.events import note_inside
from dynsim.integrators.output import fill_output
from dynsim.integrators.project import off_surface, settle
from dynsim.integrators.radau5 import tables as kn
from dynsim.integrators.radau5.tables import NewtonArrays
from dynsim.integrators.run import Run
from dynsim.integrators.watch import forces_unique, watch
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import internal_kernel


def samples_on_lanes(newton: Any, system: Any, ws: Any, run: Any, *_: Any) -> bool:
    """Where there are lanes, by types."""
    return bool(newton != types.none and newton[newton.fields.index("lanes")] != types.none)


@internal_kernel
def may_wait(unilateral: UnilateralArrays | None, run: Run):
    """True where nothing but steps happens between two samples: modes, commands and loads go on as they are."""
    if unilateral is None:  # known to the compiler
        return run.event.shape[0] + run.tick.shape[0] + run.breaks.shape[0] == 0
    return False


@internal_kernel
def has_stops(unilateral: UnilateralArrays | None):
    """True where joints have stops or dry friction, whose forces are kept for one state alone."""
    if unilateral is None:  # known to the compiler
        return False
    return unilateral.stop.shape[0] + unilateral.dry.shape[0] > 0


@form_of(write_samples, samples_on_lanes)
def write_samples_on_lanes(newton, system, ws, run, more):
    """Four at a time; those that cannot wait by fewer, and one is done sooner alone."""
    newton.count[kn.WAITING] += more
    wait = may_wait(system.unilateral, run)
    # What the ground carries is computed for one state alone too.
    alone = has_stops(system.unilateral) or run.support.index.shape[0] > 0
    while newton.count[kn.WAITING] >= 4 or (newton.count[kn.WAITING] > 0 and not wait):
        if alone or newton.count[kn.WAITING] == 1:
            newton.count[kn.WAITING] -= 1
            write_sample(system, ws, run)
        else:
            write_together(newton, system, ws, run, 0)


@form_of(write_waiting, samples_on_lanes)
def write_waiting_on_lanes(newton, system, ws, run):
    """Write even a single sample from lanes: its value must not depend on when a caller looks.

    The first lane keeps the end of a step that is pending.
    """
    if newton.count[kn.WAITING] > 0:
        write_together(newton, system, ws, run, 1)


@internal_kernel
def write_together(newton: NewtonArrays, system: System, ws: Workspace, run: Run, begin):
    """Record the waiting samples, up to four, from lane ``begin`` on."""
    count = load_samples(newton, run, begin)
    fill_lanes(newton.lanes, run, begin + count)
    evaluate_four(newton.lanes, system)
    take_samples(newton, system, ws, run, begin, count)


@internal_kernel
def load_samples(newton: NewtonArrays, run: Run, begin):
    """Samples that wait into the lanes from ``begin`` on; returns how many."""
    lanes, first, count = newton.lanes, run.count[ki.SAMPLE], min(newton.count[kn.WAITING], 4 - begin)
    for k in range(count):
        lanes.t[begin + k] = run.sample_time[first + k]
        for j in range(run.y.shape[0]):
            lanes.y[j, begin + k] = run.sample[first + k, j]
    return count


@internal_kernel
def fill_lanes(lanes: StageLanes, run: Run, begin):
    """The first lane into those from ``begin`` on, for which there is nothing else."""
    for k in range(begin, 4):
        lanes.t[k] = lanes.t[0]
        for j in range(run.y.shape[0]):
            lanes.y[j, k] = lanes.y[j, 0]


@internal_kernel
def take_samples(newton: NewtonArrays, system: System, ws: Workspace, run: Run, begin, count):
    """Record so many samples from the lanes, from ``begin`` on; what has left its surfaces is projected, alone."""
    if count == 0:
        return
    lanes = newton.lanes
    tables = tables_as_lanes(lanes.ws)
    fill_output(system, tables, run, as_lanes(lanes.output))
    run.count[ki.EVALUATIONS] += count
    newton.count[kn.WAITING] -= count
    for k in range(begin, begin + count):
        if off_surface(lane(tables, k)):
            write_sample(system, ws, run)
        else:
            row = run.output[run.count[ki.SAMPLE]]
            for j in range(lanes.output.shape[0]):
                row[j] = lanes.output[j, k]
            run.count[ki.SAMPLE] += 1


@internal_kernel
def evaluate_end(newton: NewtonArrays, system: System, ws: Workspace, run: Run):
    """Derivatives at the three stages into ``f``, and the last one, which is at y_new, into stage[6] too."""
    evaluate_two(newton, system, ws, run)
    evaluate_end_alone(newton, system, ws, run)


@internal_kernel
def evaluate_two(newton: NewtonArrays, system: System, ws: Workspace, run: Run):
    """Derivatives at the first two stages, into ``f``."""
    for s in range(2):
        for j in range(newton.kept.shape[1]):
            run.stage[7, j] = run.y[j] + newton.z[s, j]
        derivative(system, run.clock[ki.TIME] + kn.NODE_RADAU[s] * run.clock[ki.STEP], run.stage[7], ws, newton.f[s])
        if run.event.shape[0] > 0:
            note_inside(system, ws, run, s, kn.NODE_RADAU[s])
    run.count[ki.EVALUATIONS] += 2


@internal_kernel
def evaluate_end_alone(newton: NewtonArrays, system: System, ws: Workspace, run: Run):
    """Derivative at y_new into the third row of ``f``, then into stage[6].

    Not the other way round: entries that no derivative writes are zero in ``f``, and scratch in stage[6].
    """
    derivative(system, run.clock[ki.TIME] + run.clock[ki.STEP], run.y_new, ws, newton.f[2])
    for j in range(run.y.shape[0]):
        run.stage[6, j] = newton.f[2, j]
    run.count[ki.EVALUATIONS] += 1


@internal_kernel
def end_workspace(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """The workspace of the end of the step just taken."""
    return ws


@internal_kernel
def end_accepted(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """Project y_new where it is off the constraints, and watch the forces; False, and STATUS, when that cannot be."""
    return end_settled(system, ws, run, off_surface(ws)) and end_watched(system, ws, run)


@internal_kernel
def end_settled(system: System, ws: Workspace, run: Run, off):
    """True when y_new is on the constraints; where it was ``off`` them ``ws`` is of what it has become."""
    if not off or settle(system, run.clock[ki.TIME] + run.clock[ki.STEP], run.y_new, ws, run.stage[6], run):
        return True
    run.count[ki.STATUS] = ki.NOT_PROJECTED
    return False


@internal_kernel
def end_watched(system: System, ws: Workspace, run: Run):
    """True when forces at y_new are unique; ``ws`` right after ``derivative`` there."""
    h = run.clock[ki.STEP]
    if not (clearly_unique(ws) or forces_unique(system, ws, run, run.clock[ki.TIME] + h)):
        return False
    watch(ws, run, h)
    return True


def _on_lanes(newton: Any, system: Any, ws: Any, run: Any, *_: Any) -> bool:
    """Where samples are taken on lanes and nothing else asks what the forces at the end are."""
    return samples_on_lanes(newton, system, ws, run) and bool(system[system.fields.index("unilateral")] == types.none)


@form_of(evaluate_end, _on_lanes)
def evaluate_end_on_lanes(newton, system, ws, run):
    """Evaluate y_new on the first lane, the two inner stages on the next, and a waiting sample on the last."""
    lanes, t, h = newton.lanes, run.clock[ki.TIME], run.clock[ki.STEP]
    lanes.t[0], lanes.t[1], lanes.t[2] = t + h, t + kn.NODE_RADAU[0] * h, t + kn.NODE_RADAU[1] * h
    for j in range(run.y.shape[0]):
        lanes.y[j, 0] = run.y_new[j]
        lanes.y[j, 1], lanes.y[j, 2] = run.y[j] + newton.z[0, j], run.y[j] + newton.z[1, j]
    count = load_samples(newton, run, 3)
    fill_lanes(lanes, run, 3 + count)
    dependent, contradictory = lanes.ws.counts[ka.DEPENDENT], lanes.ws.counts[ka.CONTRADICTORY]
    evaluate_four(lanes, system)
    ws.counts[ka.DEPENDENT] += lanes.ws.counts[ka.DEPENDENT] - dependent
    ws.counts[ka.CONTRADICTORY] += lanes.ws.counts[ka.CONTRADICTORY] - contradictory
    run.count[ki.EVALUATIONS] += 3
    for j in range(run.y.shape[0]):
        newton.f[0, j], newton.f[1, j], newton.f[2, j] = lanes.f[j, 1], lanes.f[j, 2], lanes.f[j, 0]
        run.stage[6, j] = newton.f[2, j]
    take_samples(newton, system, ws, run, 3, count)
    if run.event.shape[0] > 0:
        for s in range(2):
            note_inside(system, lane(tables_as_lanes(lanes.ws), 1 + s), run, s, kn.NODE_RADAU[s])


@form_of(end_accepted, _on_lanes)
def end_accepted_on_lanes(newton, system, ws, run):
    """By what the first lane has left, unless the end must be projected."""
    end = lane(tables_as_lanes(newton.lanes.ws), 0)
    if not off_surface(end):
        return end_watched(system, end, run)
    return end_settled(system, ws, run, True) and end_watched(system, ws, run)


@form_of(end_workspace, _on_lanes)
def end_workspace_on_lanes(newton, system, ws, run):
    """The first lane."""
    return lane(tables_as_lanes(newton.lanes.ws), 0)
