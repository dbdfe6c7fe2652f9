"""Dense output: the state anywhere within a step, and the samples of the record from it."""

from __future__ import annotations

from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import normalise
from dynsim.integrators import run as ki
from dynsim.integrators.output import write_output
from dynsim.integrators.project import settle
from dynsim.integrators.radau5 import tables as kn
from dynsim.integrators.radau5.tables import NODE_RADAU, NewtonArrays
from dynsim.integrators.run import Run
from dynsim.jit.kernel import inline_kernel, internal_kernel, kernel


@internal_kernel
def collocated(newton: NewtonArrays | None, j, whole):
    """Quadratic and cubic coefficient of entry j, of the cubic through y, the stages and y_new = y + ``whole``."""
    if newton is None:  # known to the compiler
        return 0.0, 0.0
    c0, c1 = NODE_RADAU[0], NODE_RADAU[1]
    first = (newton.z[0, j] / c0 - whole) / (1.0 - c0)
    bend = ((newton.z[1, j] / c1 - whole) / (1.0 - c1) - first) / (c1 - c0)
    return first - c0 * bend, bend


@internal_kernel
def fill_dense(run: Run):
    """Coefficients of the dense output over the step from y to y_new, see ``Run.dense``."""
    h, y, y_new, k, d = run.clock[ki.STEP], run.y, run.y_new, run.stage, run.dense
    for j in range(y.shape[0]):
        d[0, j] = y_new[j] - y[j]
        d[3, j] = 0.0
        if run.method == ki.TIME_STEPPING:
            d[1, j], d[2, j] = 0.0, 0.0
        elif run.method == ki.RADAU5:
            d[1, j], d[2, j] = collocated(run.newton, j, d[0, j])
        else:
            d[1, j] = h * k[0, j] - d[0, j]
            d[2, j] = d[0, j] - h * k[6, j] - d[1, j]
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
    d, x = run.dense, min((t - run.clock[ki.TIME]) / run.clock[ki.STEP], 1.0)
    z = 1.0 - x
    for j in range(out.shape[0]):
        out[j] = run.y[j] + x * (d[0, j] + z * (d[1, j] + x * (d[2, j] + z * d[3, j])))


@kernel
def state_within(run: Run, t, out):
    """State at a time within the step that is pending, by the dense output, into out: (m,)."""
    fill_dense(run)
    interpolate(run, t, out)


@inline_kernel
def sample_step(system: System, ws: Workspace, run: Run):
    """Record every sample time within the step from TIME to TIME + STEP, from the dense output.

    Samples are projected like steps are, so that recorded gaps hold the promised tolerance too.
    """
    t, h = run.clock[ki.TIME], run.clock[ki.STEP]
    first = run.count[ki.SAMPLE] + waiting_samples(run.newton)
    last = first
    # A sample at END must not be lost to the rounding of t + h.
    until = run.clock[ki.END] if t + h >= run.clock[ki.END] - 1e-12 * max(1.0, run.clock[ki.END]) else t + h
    if last >= run.sample_time.shape[0] or run.sample_time[last] > until:
        return
    fill_dense(run)
    while last < run.sample_time.shape[0] and run.sample_time[last] <= until:
        interpolate(run, run.sample_time[last], run.sample[last])
        if system.layout.extra > 0:
            normalise(system.model, run.sample[last], system.layout.q)
        last += 1
    write_samples(run.newton, system, ws, run, last - first)


@internal_kernel
def write_sample(system: System, ws: Workspace, run: Run):
    """Project the next sample and record it, whose state is there."""
    s = run.count[ki.SAMPLE]
    settle(system, run.sample_time[s], run.sample[s], ws, run.stage[7], run)
    write_output(system, ws, run, s)
    run.count[ki.SAMPLE] = s + 1


@internal_kernel
def sampled_now(run: Run):
    """True where the last sample that was recorded is at TIME, apart from rounding."""
    s, t = run.count[ki.SAMPLE] - 1, run.clock[ki.TIME]
    return s >= 0 and abs(run.sample_time[s] - t) <= 1e-12 * max(1.0, abs(t))


@internal_kernel
def rewrite_sample(system: System, ws: Workspace, run: Run):
    """Record a sample at TIME again, after commands, loads or modes have jumped: it has their values from now on.

    Right after a start: ``ws`` is of the present state, and remains so.
    """
    if not sampled_now(run):
        return
    run.count[ki.SAMPLE] -= 1
    row = run.sample[run.count[ki.SAMPLE]]
    for j in range(row.shape[0]):
        row[j] = run.y[j]
    write_sample(system, ws, run)


@internal_kernel
def write_samples(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run, more):
    """Record so many ``more`` samples, whose states are there; on lanes up to three of them wait for the next ones."""
    for _ in range(more):
        write_sample(system, ws, run)


@internal_kernel
def write_waiting(newton: NewtonArrays | None, system: System, ws: Workspace, run: Run):
    """Record the samples that wait for others: something else than a step comes next."""


@internal_kernel
def waiting_samples(newton: NewtonArrays | None):
    """Samples whose states are there and that are not recorded yet."""
    if newton is None:  # known to the compiler
        return 0
    return newton.count[kn.WAITING]
