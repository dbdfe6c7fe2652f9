"""Error norm and step size."""

from __future__ import annotations

import math

from dynsim.kernels.arrays import CONTRADICTORY, Workspace
from dynsim.kernels.integrate.events import next_tick
from dynsim.kernels.integrate.run import (
    ASKED,
    ATOL,
    COUNTED_SINCE,
    END,
    FINISHED,
    FIXED_STEP,
    LAST_ERROR,
    LEAST_PROGRESS,
    MOST_TRIALS,
    NO_FORCES,
    NO_PROGRESS,
    NOT_FINITE,
    REJECTED,
    RK4,
    RTOL,
    RUNNING,
    STATUS,
    STEP,
    STEP_MAX,
    STEP_TOO_SMALL,
    TIME,
    TRIALS,
    TRIMMED,
    Run,
)
from dynsim.kernels.jit import internal_kernel, kernel, merged_kernel
from dynsim.kernels.system import System
from dynsim.kernels.tree.joints import position_error


@internal_kernel
def error_norm(system: System, ws: Workspace, run: Run, error, slack):
    """Root mean square of error / (atol + rtol |y|) over positions, rates and currents; quaternions count as angles.

    The atol of rates and currents is ``slack`` times that of positions.
    """
    y, y_new, atol, rtol, layout = run.y, run.y_new, run.clock[ATOL], run.clock[RTOL], system.layout
    total, size = 0.0, layout.tracked
    beyond, loose = layout.q + ws.joints.shape[0] + layout.extra, slack * atol
    if layout.extra > 0:
        model = system.model
        total, size = position_error(model.compound, model, y, y_new, error, layout.q, rtol, atol)
        size += layout.tracked - (beyond - layout.q)
    for j in range(layout.tracked):
        position = layout.q <= j < beyond
        if not (position and layout.extra > 0):
            x = error[j] / ((atol if position else loose) + rtol * max(abs(y[j]), abs(y_new[j])))
            total += x * x
    return math.sqrt(total / size)


@kernel
def finite(values):
    """True when no element is NaN or infinite."""
    total = 0.0
    for j in range(values.shape[0]):
        total += values[j] * 0.0
    return total == 0.0


@merged_kernel
def finished(run: Run):
    """True when the run has ended, for whatever reason, or is asked to; sets STATUS at END."""
    end = run.clock[END]
    if run.count[STATUS] == RUNNING and end - run.clock[TIME] <= 1e-12 * max(1.0, end):
        run.count[STATUS] = FINISHED
    return run.count[STATUS] != RUNNING or run.count[ASKED] != 0


@internal_kernel
def stalled(run: Run):
    """Count one more trial; True, and STATUS, when the last MOST_TRIALS of them have come next to nowhere.

    The bound of every loop of steps, trials, events and restarts, whatever keeps it going.
    """
    clock, count = run.clock, run.count
    count[TRIALS] += 1
    if count[TRIALS] < MOST_TRIALS:
        return False
    stands = clock[TIME] - clock[COUNTED_SINCE] <= clock[LEAST_PROGRESS]
    if stands:
        count[STATUS] = NO_PROGRESS
    else:
        count[TRIALS], clock[COUNTED_SINCE] = 0, clock[TIME]
    return stands


@internal_kernel
def first_step(system: System, ws: Workspace, run: Run):
    """Hairer's first guess of the step size: one that changes the state by a hundredth of its scale."""
    clock, y, k = run.clock, run.y, run.stage
    size, slope = 0.0, 0.0
    if system.layout.extra > 0:
        # A guess that is the same for every attitude: of a quaternion only its rotation counts.
        for j in range(y.shape[0]):
            run.y_new[j] = y[j]
        size, slope = error_norm(system, ws, run, y, 1.0) ** 2, error_norm(system, ws, run, k[0], 1.0) ** 2
    else:
        for j in range(system.layout.tracked):
            scale = clock[ATOL] + clock[RTOL] * abs(y[j])
            size += (y[j] / scale) ** 2
            slope += (k[0, j] / scale) ** 2
    guess = 0.01 * math.sqrt(size / slope) if size > 1e-10 and slope > 1e-10 else 1e-6
    clock[STEP] = min(guess, clock[STEP_MAX], clock[END] - clock[TIME])


@internal_kernel
def choose_step(run: Run):
    """Trim STEP so that END, or a tick, is met exactly: halve the way rather than leave a sliver for the last step."""
    clock = run.clock
    until = next_tick(run, clock[END])
    remaining = until - clock[TIME]
    run.count[TRIMMED] = 1 if until < clock[END] and remaining < 2.0 * clock[STEP] else 0
    if run.method in FIXED_STEP:
        if remaining < clock[STEP] * (1.0 + 1e-9):
            clock[STEP] = remaining
    elif remaining <= clock[STEP] * 1.0000001:
        clock[STEP] = remaining
    elif remaining < 2.0 * clock[STEP]:
        clock[STEP] = 0.5 * remaining


@internal_kernel
def rejected(ws: Workspace, run: Run, error, order):
    """True when a step of this error norm must be repeated: shrinks STEP, or sets STATUS when that is hopeless."""
    clock, count, h = run.clock, run.count, run.clock[STEP]
    if count[STATUS] != RUNNING:
        return True
    broken = NO_FORCES if ws.counts[CONTRADICTORY] > 0 else NOT_FINITE
    if not (finite(run.y_new) and finite(run.stage[6])) or error != error:
        if run.method == RK4:
            count[STATUS] = broken
            return True
        error = 1e10
    if error <= 1.0:
        return False
    count[REJECTED] += 1
    clock[STEP] = h * max(0.1, 0.9 * error ** (-1.0 / order))
    if clock[STEP] < 1e-13 * max(1.0, clock[TIME]):
        count[STATUS] = broken if error >= 1e10 else STEP_TOO_SMALL
    return True


@internal_kernel
def next_step(run: Run, error, order, beta):
    """Proportional–integral step control (Hairer, Nørsett, Wanner II.4)."""
    clock = run.clock
    error = max(error, 1e-10)
    change = 0.9 * error ** (0.75 * beta - 1.0 / order) * clock[LAST_ERROR] ** beta
    clock[LAST_ERROR] = max(error, 1e-4)
    clock[STEP] = min(clock[STEP] * min(max(change, 0.2), 5.0), clock[STEP_MAX])
