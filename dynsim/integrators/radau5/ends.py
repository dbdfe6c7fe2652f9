"""The end of a step: its derivative, whether it is on the constraints and forces are unique there.

RADAU5 evaluates it on lanes, together with samples of the steps before: four states take no longer than one alone.
"""

from __future__ import annotations

from typing import Any

from numba.core import types

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.uniqueness import clearly_unique
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.simd.system import FOUR
from dynsim.dynamics.simd.tables import lane, tables_as_lanes
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.dense import fill_lanes, load_samples, samples_on_lanes, take_samples
from dynsim.integrators.project import off_surface, settle
from dynsim.integrators.radau5.newton import NewtonArrays
from dynsim.integrators.radau5.stages import evaluate_four
from dynsim.integrators.run import Run
from dynsim.integrators.watch import forces_unique, watch
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import internal_kernel


@internal_kernel
def evaluate_end(newton: NewtonArrays, system: System, ws: Workspace, run: Run):
    """Derivative at y_new into stage[6]."""
    evaluate_end_alone(system, ws, run)


@internal_kernel
def evaluate_end_alone(system: System, ws: Workspace, run: Run):
    """The same without lanes."""
    derivative(system, run.clock[ki.TIME] + run.clock[ki.STEP], run.y_new, ws, run.stage[6])
    run.count[ki.EVALUATIONS] += 1


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
    """On the first lane; on the others samples that wait. Guards of events want the workspace of one state."""
    if run.event.shape[0] > 0:
        evaluate_end_alone(system, ws, run)
        return
    lanes = newton.lanes
    lanes.t[0] = run.clock[ki.TIME] + run.clock[ki.STEP]
    for j in range(run.y.shape[0]):
        lanes.y[j, 0] = run.y_new[j]
    count = load_samples(newton, run, 1)
    fill_lanes(lanes, run, 1 + count)
    dependent, contradictory = lanes.ws.counts[ka.DEPENDENT], lanes.ws.counts[ka.CONTRADICTORY]
    evaluate_four(lanes, system)
    ws.counts[ka.DEPENDENT] += lanes.ws.counts[ka.DEPENDENT] - dependent
    ws.counts[ka.CONTRADICTORY] += lanes.ws.counts[ka.CONTRADICTORY] - contradictory
    run.count[ki.EVALUATIONS] += 1
    for j in range(run.y.shape[0]):
        run.stage[6, j] = lanes.f[j, 0]
    take_samples(newton, system, ws, run, 1, count)


@form_of(end_accepted, _on_lanes)
def end_accepted_on_lanes(newton, system, ws, run):
    """By what the first lane has left, where the end was evaluated there, unless it must be projected."""
    end, on_lanes = lane(tables_as_lanes(newton.lanes.ws, FOUR), 0), run.event.shape[0] == 0
    if on_lanes and not off_surface(end):
        return end_watched(system, end, run)
    return end_settled(system, ws, run, on_lanes or off_surface(ws)) and end_watched(system, ws, run)
