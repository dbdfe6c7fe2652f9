"""Dense output: the state anywhere within a step, and the samples of the record from it."""

from __future__ import annotations

from typing import Any

from numba.core import types

from dynsim.kernels.arrays import Workspace
from dynsim.kernels.compiler import form_of
from dynsim.kernels.constraint.unilateral import UnilateralArrays
from dynsim.kernels.integrate.newton import NewtonArrays
from dynsim.kernels.integrate.output import fill_output, write_output
from dynsim.kernels.integrate.project import off_surface, settle
from dynsim.kernels.integrate.run import DOPRI5, END, EVALUATIONS, RADAU5, SAMPLE, STEP, TIME, TIME_STEPPING, Run
from dynsim.kernels.integrate.stages import evaluate_four
from dynsim.kernels.integrate.tableaux import NODE_RADAU
from dynsim.kernels.jit import internal_kernel, kernel, merged_kernel
from dynsim.kernels.lanes.system import FOUR
from dynsim.kernels.lanes.tables import as_lanes, lane, tables_as_lanes
from dynsim.kernels.system import System
from dynsim.kernels.tree.joints import normalise


@internal_kernel
def collocated(newton: NewtonArrays | None, j, whole):
    """The two bends of entry j, of the cubic through y, the stages and y_new = y + ``whole``."""
    if newton is None:  # known to the compiler
        return 0.0, 0.0
    c0, c1 = NODE_RADAU[0], NODE_RADAU[1]
    first = (newton.z[0, j] / c0 - whole) / (1.0 - c0)
    bend = ((newton.z[1, j] / c1 - whole) / (1.0 - c1) - first) / (c1 - c0)
    return first - c0 * bend, bend


@internal_kernel
def fill_dense(run: Run):
    """Coefficients of the dense output over the step from y to y_new, see ``Run.dense``."""
    h, y, y_new, k, d = run.clock[STEP], run.y, run.y_new, run.stage, run.dense
    for j in range(y.shape[0]):
        d[0, j] = y_new[j] - y[j]
        d[3, j] = 0.0
        if run.method == TIME_STEPPING:
            d[1, j], d[2, j] = 0.0, 0.0
        elif run.method == RADAU5:
            d[1, j], d[2, j] = collocated(run.newton, j, d[0, j])
        else:
            d[1, j] = h * k[0, j] - d[0, j]
            d[2, j] = d[0, j] - h * k[6, j] - d[1, j]
            if run.method == DOPRI5:
                d[3, j] = h * (
                    -12715105075.0 / 11282082432.0 * k[0, j]
                    + 87487479700.0 / 32700410799.0 * k[2, j]
                    - 10690763975.0 / 1880347072.0 * k[3, j]
                    + 701980252875.0 / 199316789632.0 * k[4, j]
                    - 1453857185.0 / 822651844.0 * k[5, j]
                    + 69997945.0 / 29380423.0 * k[6, j]
                )


@internal_kernel
def interpolate(run: Run, t, out):
    """State at time t by ``Run.dense`` into out: (m,); of the rounding beyond the step's end nothing is made."""
    d, x = run.dense, min((t - run.clock[TIME]) / run.clock[STEP], 1.0)
    z = 1.0 - x
    for j in range(out.shape[0]):
        out[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))


@kernel
def state_within(run: Run, t, out):
    """State at a time within the step that is pending, by the dense output, into out: (m,)."""
    fill_dense(run)
    interpolate(run, t, out)


@merged_kernel
def sample_step(system: System, ws: Workspace, run: Run):
    """Record every sample time within the step from TIME to TIME + STEP, from the dense output.

    Samples are projected like steps are, so that recorded gaps hold the promised tolerance too.
    """
    t, h = run.clock[TIME], run.clock[STEP]
    last = run.count[SAMPLE]
    # A sample at END must not be lost to the rounding of t + h.
    until = run.clock[END] if t + h >= run.clock[END] - 1e-12 * max(1.0, run.clock[END]) else t + h
    if last >= run.sample_time.shape[0] or run.sample_time[last] > until:
        return
    fill_dense(run)
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        taken = sample_together(run.newton, system, ws, run, last, until)
        if taken == 0:
            taken = sample_alone(system, ws, run, last)
        last += taken
    run.count[SAMPLE] = last


@internal_kernel
def sample_alone(system: System, ws: Workspace, run: Run, s):
    """Record sample number s; returns 1, how many that is."""
    between(system, run, s)
    settle(system, run.sample_time[s], run.sample[s], ws, run.stage[7], run)
    write_output(system, ws, run, s)
    return 1


@internal_kernel
def between(system: System, run: Run, s):
    """The state of sample number s, not projected."""
    interpolate(run, run.sample_time[s], run.sample[s])
    if system.layout.extra > 0:
        normalise(system.model.compound, system.model, run.sample[s], system.layout.q)


@internal_kernel
def sample_together(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run, first, until):
    """Record several samples from number ``first`` on, none beyond ``until`` [s]; returns how many, 0 without lanes."""
    return 0


def _together(newton: Any, system: Any, ws: Any, run: Any, *_: Any) -> bool:
    """Where there are lanes; what the ground carries is computed one by one."""
    lanes = newton != types.none and newton[newton.fields.index("lanes")] != types.none
    return bool(lanes and run[run.fields.index("support")] == types.none)


@internal_kernel
def has_stops(unilateral: UnilateralArrays | None):
    """True where joints have stops, whose forces are kept for one state alone."""
    if unilateral is None:  # known to the compiler
        return False
    return unilateral.stop.shape[0] > 0


@form_of(sample_together, _together)
def sample_on_lanes(newton, system, ws, run, first, until):
    """Up to four; one is done sooner alone, and so is what has left its surfaces."""
    lanes, times, count = newton.lanes, run.sample_time, 0
    while count < 4 and first + count < times.shape[0] and times[first + count] <= until:
        count += 1
    if count == 1 or has_stops(system.unilateral):
        return 0
    for k in range(4):
        s = first + min(k, count - 1)
        if k < count:
            between(system, run, s)
        lanes.t[k] = times[s]
        for j in range(run.y.shape[0]):
            lanes.y[j, k] = run.sample[s, j]
    evaluate_four(lanes, system)
    run.count[EVALUATIONS] += count
    tables = tables_as_lanes(lanes.ws, FOUR)
    fill_output(system, tables, run, as_lanes(lanes.output, FOUR))
    for k in range(count):
        if off_surface(lane(tables, k)):
            sample_alone(system, ws, run, first + k)
        else:
            for j in range(lanes.output.shape[0]):
                run.output[first + k, j] = lanes.output[j, k]
    return count
