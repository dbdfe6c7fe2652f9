"""Dense output: the state anywhere within a step, and the samples of the record from it."""

from __future__ import annotations

from dynsim.kernels.arrays import Workspace
from dynsim.kernels.integrate.newton import NewtonArrays
from dynsim.kernels.integrate.output import write_output
from dynsim.kernels.integrate.project import settle
from dynsim.kernels.integrate.run import DOPRI5, END, RADAU5, SAMPLE, STEP, TIME, TIME_STEPPING, Run
from dynsim.kernels.integrate.tableaux import NODE_RADAU
from dynsim.kernels.jit import internal_kernel, kernel, merged_kernel
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


@kernel
def state_within(run: Run, t, out):
    """State at a time within the step that is pending, by the dense output, into out: (m,)."""
    fill_dense(run)
    d, x = run.dense, (t - run.clock[TIME]) / run.clock[STEP]
    z = 1.0 - x
    for j in range(out.shape[0]):
        out[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))


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
    d = run.dense
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        x = min((run.sample_time[last] - t) / h, 1.0)
        z = 1.0 - x
        row = run.sample[last]
        for j in range(row.shape[0]):
            row[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))
        if system.layout.extra > 0:
            normalise(system.model.compound, system.model, row, system.layout.q)
        settle(system, run.sample_time[last], row, ws, run.stage[7], run)
        write_output(system, ws, run, last)
        last += 1
    run.count[SAMPLE] = last
