"""Time integration of the coupled system: start, steps of the chosen method, acceptance, events, ticks, samples.

All methods have dense output, so that sample times do not limit the steps:

- ``DOPRI5``: Dormand–Prince 5(4) for non-stiff systems, adaptive, with six evaluations per step and dense output of
  order 4 (Hairer, Nørsett, Wanner: Solving Ordinary Differential Equations I, II.5–II.6).
- ``RADAU5``: implicit and adaptive, of order 5 with three stages (stage order 3), an error estimate of order 3 and
  dense output of order 3. Its steps are limited by accuracy, not by the fast eigenvalues of motors (−450 ± 1900i 1/s in
  the published arm); see ``radau5``.
- ``TIME_STEPPING``: contacts open and close within fixed steps, see ``stepping``; samples are interpolated linearly.

After each accepted step of the adaptive methods, q and v are projected onto the active rows if they are off by more
than ``GAP_TOLERANCE`` or ``RATE_TOLERANCE``, see ``project_level``.

A sample at a tick contains the values that apply from the tick on: it is recorded at the end of the preceding step, and
again after the commands have been sampled.
"""

from __future__ import annotations

from collections.abc import Callable

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.drive.law import take_commands
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import normalise, read_positions
from dynsim.dynamics.tree.support import watch_support
from dynsim.integrators import run as ki
from dynsim.integrators.contacts.events import consistent, solve_modes, switch_contacts, take_directions, watch_modes
from dynsim.integrators.dopri5 import A_DOPRI5, ERROR_DOPRI5, NODE_DOPRI5, step_explicit
from dynsim.integrators.events import arm_events, cut_step, fire_events, take_ticks
from dynsim.integrators.methods import compiled
from dynsim.integrators.radau5.step import after_step, end_accepted, end_workspace, step_radau5
from dynsim.integrators.radau5.tables import discard_history
from dynsim.integrators.run import Run, forces_unique, rewrite_sample, sample_step, settle, watch, write_waiting
from dynsim.integrators.simd import radau5  # noqa: F401 (registers variants of kernels)
from dynsim.integrators.steps import choose_step, finished, finite, first_step, next_step, rejected, stalled
from dynsim.jit.kernel import FixedSignature, free_kernel, inline_kernel, internal_kernel, noinline_kernel


@internal_kernel
def start(system: System, ws: Workspace, run: Run):
    """Evaluate the first derivative with contacts, and set the first step size if it is unset; STATUS on failure."""
    if not start_contacts(system.unilateral, system, ws, run):
        run.count[ki.STATUS] = ki.NOT_PROJECTED if run.count[ki.STATUS] == ki.RUNNING else run.count[ki.STATUS]
    elif not finite(run.stage[0]):
        run.count[ki.STATUS] = ki.NO_FORCES if ws.counts[ka.CONTRADICTORY] > 0 else ki.NOT_FINITE
    elif forces_unique(system, ws, run, run.clock[ki.TIME]):
        watch(ws, run, 0.0)
        if run.clock[ki.STEP] <= 0.0:
            first_step(system, ws, run)
    discard_history(run.newton, run.count[ki.STEPS])
    run.count[ki.STARTED] = 1


@internal_kernel
def start_contacts(unilateral: UnilateralArrays | None, system: System, ws: Workspace, run: Run):
    """Evaluate the derivative at the start of a step, with satisfied constraints and consistent contact modes."""
    if unilateral is None:  # resolved at compile time, as below, unlike a test of system.unilateral
        return settle(system, run.clock[ki.TIME], run.y, ws, run.stage[0], run)
    due, first = run.count[ki.MODES_DUE] > 0, run.count[ki.MODES_DUE] == ki.AT_START
    if due:
        run.count[ki.MODES_DUE] = 0
        read_positions(system.model, run.y, system.layout.q, ws)
        hold_all_joints(unilateral, ws)
        solve_modes(system, ws, run, first)
    if run.count[ki.STATUS] != ki.RUNNING or not settle(system, run.clock[ki.TIME], run.y, ws, run.stage[0], run):
        return False
    if consistent(system, ws):
        return True
    solve_modes(system, ws, run, first)
    return run.count[ki.STATUS] == ki.RUNNING and settle(system, run.clock[ki.TIME], run.y, ws, run.stage[0], run)


@internal_kernel
def hold_all_joints(unilateral: UnilateralArrays, ws: Workspace):
    """Let dry friction hold all joints: the first impact comes before the modes that select the joints it holds."""
    for k in range(unilateral.dry_table.shape[0]):
        unilateral.dry[k, ku.DRY_AT] = ws.joints[unilateral.dry_table[k, ku.DRY_JOINT], ka.Q]


@inline_kernel
def accept(system: System, ws: Workspace, run: Run):
    """Project y_new, record it and make it y; set STATUS if contacts cannot be satisfied or forces are not unique."""
    t, h = run.clock[ki.TIME], run.clock[ki.STEP]
    if not end_accepted(run.newton, system, ws, run):
        return
    watch_modes(system.model, system.contacts, system.unilateral, ws, h, run.gaps)
    # The tipping event needs the ground reaction at the end of this step.
    if run.event.shape[0] > 0:
        watch_support(run.support)
    if system.layout.extra > 0:
        normalise(system.model, run.y_new, system.layout.q)
    sample_step(system, ws, run)
    take_directions(system.unilateral, ws, run)
    for j in range(run.y.shape[0]):
        run.y[j] = run.y_new[j]
        run.stage[0, j] = run.stage[6, j]
    run.clock[ki.TIME] = t + h
    run.count[ki.STEPS] += 1


@inline_kernel
def accepts_step(system: System, ws: Workspace, run: Run, error):
    """Return whether error control, events and HOLD accept the step just taken."""
    clock, count = run.clock, run.count
    if run.event.shape[0] > 0 and cut_step(system, end_workspace(run.newton, system, ws, run), run):
        return False
    clock[ki.ERROR] = error
    if clock[ki.TIME] + clock[ki.STEP] > clock[ki.HOLD]:
        count[ki.PENDING] = 1
        return False
    return True


@internal_kernel
def propose(run: Run):
    """Set the size of the next trial step, unless a search for a root sets it."""
    if run.count[ki.SEARCHING] == 0:
        run.clock[ki.PROPOSED] = run.clock[ki.STEP]
        choose_step(run)


@internal_kernel
def adapt_step_size(run: Run, order, beta):
    """Set the step size after an accepted step."""
    clock, count = run.clock, run.count
    if count[ki.FIRED] == 1:
        clock[ki.STEP] = clock[ki.PROPOSED]
    else:
        next_step(run, clock[ki.ERROR], order, beta)
        # A step that was cut short does not invalidate the step size that was proposed before.
        if count[ki.TRIMMED] == 1:
            clock[ki.STEP] = max(clock[ki.STEP], clock[ki.PROPOSED])


@internal_kernel
def evaluate_for_commands(unilateral: UnilateralArrays | None, system: System, ws: Workspace, run: Run):
    """Evaluate the state from which commands are computed into ``ws``, projected if the contact modes fit this state.

    At the start and after a jump of rates, the rows still belong to the earlier modes: held joints may not have a
    position yet, and projection onto these rows would move the robot.
    """
    if unilateral is not None and run.count[ki.MODES_DUE] > 0:
        derivative(system, run.clock[ki.TIME], run.y, ws, run.stage[0])
        run.count[ki.EVALUATIONS] += 1
        return
    settle(system, run.clock[ki.TIME], run.y, ws, run.stage[0], run)


@internal_kernel
def ready(system: System, ws: Workspace, run: Run):
    """Start or restart, and process ticks, if due; return False if control must return to the caller."""
    count = run.count
    due = take_ticks(run, system.drives.input)
    if due & ki.TAKE_COMMANDS:
        evaluate_for_commands(system.unilateral, system, ws, run)
        take_commands(system.drives, system.reference, run.clock[ki.TIME], ws)
        count[ki.STARTED] = 0
    if count[ki.STARTED] == 0:
        start(system, ws, run)
        arm_events(system, ws, run)
        if count[ki.STATUS] == ki.RUNNING:
            rewrite_sample(system, ws, run)
    count[ki.TICKED] = due & ~ki.TAKE_COMMANDS
    return count[ki.TICKED] == 0


@inline_kernel
def can_step(system: System, ws: Workspace, run: Run):
    """Return whether a step can be taken; if not, control must first return to the caller."""
    # Most runs have nothing to do between two steps.
    idle = run.count[ki.STARTED] == 1 and run.tick.shape[0] + run.breaks.shape[0] == 0
    return idle or ready(system, ws, run)


@inline_kernel
def conclude(system: System, ws: Workspace, run: Run, error, order):
    """Accept or reject the step just taken or pending; return whether control must return to the caller."""
    count = run.count
    if count[ki.PENDING] == 0:
        if rejected(ws, run, error, order):
            count[ki.SEARCHING] = 0
            return False
        if not accepts_step(system, ws, run, error):
            return count[ki.PENDING] == 1
    count[ki.PENDING] = 0
    accept(system, ws, run)
    adapt_step_size(run, order, 0.04)
    if count[ki.FIRED] == 1 and count[ki.STATUS] == ki.RUNNING:
        switch_contacts(system.unilateral, system, ws, run)
    return run.event.shape[0] > 0 and fire_events(run)


@inline_kernel
def advance_explicit(system: System, ws: Workspace, run: Run, limit, rows, nodes, errors, inner, order):
    """Run :func:`advance` with an explicit method, see :func:`dynsim.integrators.dopri5.step_explicit`."""
    taken, error = 0, 0.0
    while limit >= 0 and can_step(system, ws, run):
        if taken >= limit or finished(run) or stalled(run):
            return
        taken += 1
        if run.count[ki.PENDING] == 0:
            propose(run)
            error = step_explicit(system, ws, run, rows, nodes, errors, inner)
        if conclude(system, ws, run, error, order):
            return


@free_kernel
def advance_dopri5(system: System, ws: Workspace, run: Run, limit):
    """Run :func:`advance` with DOPRI5, whose inner stages are at 0.3 and 0.8 of the step."""
    advance_explicit(system, ws, run, limit, A_DOPRI5, NODE_DOPRI5, ERROR_DOPRI5, 2, 5.0)


@noinline_kernel
def conclude_separately(system: System, ws: Workspace, run: Run, error, order):
    """Call :func:`conclude`, compiled separately.

    The functions that a RADAU5 step calls compile slowly; with small functions such as this one, compilation takes less
    than half the time of one function that contains them all.
    """
    return conclude(system, ws, run, error, order)


@free_kernel
def advance_radau5(system: System, ws: Workspace, run: Run, limit):
    """Run :func:`advance` with RADAU5.

    If the call ends only because of ``limit``, up to four samples remain waiting, because the samples that are computed
    together must not depend on the speed of the computer.
    """
    taken, error = 0, 0.0
    if limit < 0:
        return
    while can_step(system, ws, run) and not finished(run):
        if taken >= limit:
            return
        if stalled(run):
            break
        taken += 1
        if run.count[ki.PENDING] == 0:
            propose(run)
            error = step_radau5(system, ws, run)
        steps, h = run.count[ki.STEPS], run.clock[ki.STEP]
        done = conclude_separately(system, ws, run, error, 4.0)
        if run.count[ki.STEPS] > steps:
            after_step(run, h)
        if done:
            break
    write_waiting(run.newton, system, ws, run)


def advance(system: System, ws: Workspace, run: Run, limit: int) -> None:
    """Take up to ``limit`` steps towards END and set run.count[STATUS]; a negative limit only loads the function.

    The call returns earlier if an event or a tick needs the caller (LOGGED, TICKED), if the next step would end beyond
    HOLD (the step is kept as PENDING and accepted by the next call unless the caller drops it), or if another thread
    has set ASKED.

    There is one compiled function per method, so that each is compiled only when it is used.
    """
    compiled(run.method)(system, ws, run, limit)


def direct(run: Run) -> Callable[[System, Workspace, Run, int], None]:
    """Return the compiled :func:`advance` for a run in many short pieces whose tables keep their types."""
    return FixedSignature(compiled(run.method))
