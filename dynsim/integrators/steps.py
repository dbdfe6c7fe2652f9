"""Error norm, first step and step-size control; checks for the end of a run and for lack of progress."""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import position_error
from dynsim.integrators import run as ki
from dynsim.integrators.events import next_tick
from dynsim.integrators.run import Run
from dynsim.jit.kernel import inline_kernel, internal_kernel, kernel


@internal_kernel
def error_norm(system: System, ws: Workspace, run: Run, error, slack):
    """Return the RMS of error / (atol + rtol |y|) over positions, rates and currents; quaternions count as angles.

    For rates and currents, atol is multiplied by ``slack``.
    """
    y, y_new, atol, rtol, layout = run.y, run.y_new, run.clock[ki.ATOL], run.clock[ki.RTOL], system.layout
    total, size = 0.0, layout.tracked
    beyond, loose = layout.q + ws.joints.shape[0] + layout.extra, slack * atol
    if layout.extra > 0:
        model = system.model
        total, size = position_error(model, y, y_new, error, layout.q, rtol, atol)
        size += layout.tracked - (beyond - layout.q)
    for j in range(layout.tracked):
        position = layout.q <= j < beyond
        if not (position and layout.extra > 0):
            x = error[j] / ((atol if position else loose) + rtol * max(abs(y[j]), abs(y_new[j])))
            total += x * x
    return math.sqrt(total / size)


@internal_kernel
def energy_norm(run: Run, j, error):
    """Return the error of ledger integral j in a step, relative to the tolerance for its value and its change.

    If motors push against a fixed obstacle, only their power changes, and the error of the state does not show that.
    """
    then, now = run.y[j], run.y_new[j]
    return abs(error) / (run.clock[ki.ATOL] + run.clock[ki.RTOL] * (abs(now) + abs(now - then)))


@kernel
def finite(values):
    """Return whether no element is NaN or infinite."""
    total = 0.0
    for j in range(values.shape[0]):
        total += values[j] * 0.0
    return total == 0.0


@inline_kernel
def finished(run: Run):
    """Return whether the run has ended for any reason or was asked to return; set STATUS at END."""
    end = run.clock[ki.END]
    if run.count[ki.STATUS] == ki.RUNNING and end - run.clock[ki.TIME] <= 1e-12 * max(1.0, end):
        run.count[ki.STATUS] = ki.FINISHED
    return run.count[ki.STATUS] != ki.RUNNING or run.count[ki.ASKED] != 0


@internal_kernel
def stalled(run: Run):
    """Count one more trial; if the last MOST_TRIALS trials made almost no progress, set STATUS and return True.

    This bounds every loop of steps, trials, events and restarts, whatever its cause.
    """
    clock, count = run.clock, run.count
    count[ki.TRIALS] += 1
    if count[ki.TRIALS] < ki.MOST_TRIALS:
        return False
    stands = clock[ki.TIME] - clock[ki.COUNTED_SINCE] <= clock[ki.LEAST_PROGRESS]
    if stands:
        count[ki.STATUS] = ki.NO_PROGRESS
    else:
        count[ki.TRIALS], clock[ki.COUNTED_SINCE] = 0, clock[ki.TIME]
    return stands


@internal_kernel
def first_step(system: System, ws: Workspace, run: Run):
    """Return Hairer's initial step size, with which the state changes by a hundredth of its scale."""
    clock, y, k = run.clock, run.y, run.stage
    size, slope = 0.0, 0.0
    if system.layout.extra > 0:
        # The guess must not depend on the attitude, so only the rotation of a quaternion counts.
        for j in range(y.shape[0]):
            run.y_new[j] = y[j]
        size, slope = error_norm(system, ws, run, y, 1.0) ** 2, error_norm(system, ws, run, k[0], 1.0) ** 2
    else:
        for j in range(system.layout.tracked):
            scale = clock[ki.ATOL] + clock[ki.RTOL] * abs(y[j])
            size += (y[j] / scale) ** 2
            slope += (k[0, j] / scale) ** 2
    guess = 0.01 * math.sqrt(size / slope) if size > 1e-10 and slope > 1e-10 else 1e-6
    clock[ki.STEP] = min(guess, clock[ki.STEP_MAX], clock[ki.END] - clock[ki.TIME])


@internal_kernel
def choose_step(run: Run):
    """Trim STEP so that a step ends exactly at END or a tick; halve the rest if a sliver would remain."""
    clock = run.clock
    until = next_tick(run, clock[ki.END])
    remaining = until - clock[ki.TIME]
    run.count[ki.TRIMMED] = 1 if until < clock[ki.END] and remaining < 2.0 * clock[ki.STEP] else 0
    if run.method == ki.TIME_STEPPING:
        # With a remainder of a millionth of a step, the velocity jump of an impact would become a huge acceleration.
        if remaining < clock[ki.STEP] * (1.0 + 1e-6):
            clock[ki.STEP] = remaining
    elif remaining <= clock[ki.STEP] * 1.0000001:
        clock[ki.STEP] = remaining
    elif remaining < 2.0 * clock[ki.STEP]:
        clock[ki.STEP] = 0.5 * remaining


@internal_kernel
def rejected(ws: Workspace, run: Run, error, order):
    """Return whether a step with this error norm must be repeated; shrink STEP, or set STATUS if it cannot shrink."""
    clock, count, h = run.clock, run.count, run.clock[ki.STEP]
    if count[ki.STATUS] != ki.RUNNING:
        return True
    broken = ki.NO_FORCES if ws.counts[ka.CONTRADICTORY] > 0 else ki.NOT_FINITE
    if not (finite(run.y_new) and finite(run.stage[6])) or error != error:
        error = 1e10
    if error <= 1.0:
        return False
    count[ki.REJECTED] += 1
    clock[ki.STEP] = h * max(0.1, 0.9 * error ** (-1.0 / order))
    if clock[ki.STEP] < 1e-13 * max(1.0, clock[ki.TIME]):
        count[ki.STATUS] = broken if error >= 1e10 else ki.STEP_TOO_SMALL
    return True


@internal_kernel
def next_step(run: Run, error, order, beta):
    """Set STEP by proportional–integral control (Hairer, Nørsett, Wanner II.4)."""
    clock = run.clock
    error = max(error, 1e-10)
    change = 0.9 * error ** (0.75 * beta - 1.0 / order) * clock[ki.LAST_ERROR] ** beta
    clock[ki.LAST_ERROR] = max(error, 1e-4)
    clock[ki.STEP] = min(clock[ki.STEP] * min(max(change, 0.2), 5.0), clock[ki.STEP_MAX])
