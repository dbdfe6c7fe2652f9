"""Snapshot of all that a choice of contact modes writes, so that a choice can be tried and taken back."""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.rows import set_modes
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.integrators import run as ki
from dynsim.integrators.contacts.impacts import evaluate
from dynsim.integrators.run import Run
from dynsim.jit.kernel import internal_kernel, noinline_kernel


@noinline_kernel
def keep(unilateral: UnilateralArrays, ws: Workspace, run: Run):
    """Keep modes, their tables and the state, between two steps, when ``y_new`` is free."""
    kept, mode = unilateral.kept, unilateral.mode
    for k in range(mode.shape[0]):
        mode[k, ku.WANTED] = ws.active[k, ka.MODE]
    at = write(kept, 0, mode)
    at = write(kept, at, unilateral.dry_table)
    at = write(kept, at, unilateral.stop_table)
    at = write(kept, at, unilateral.slide)
    at = write(kept, at, unilateral.tally)
    at = write(kept, at, unilateral.dry)
    at = write(kept, at, unilateral.stop)
    at = write_numbers(kept, at, unilateral.number)
    write_numbers(kept, at, unilateral.shares)
    for i in range(run.y.shape[0]):
        run.y_new[i] = run.y[i]


@noinline_kernel
def take_back(system: System, ws: Workspace, run: Run):
    """Modes, their tables and the state as :func:`keep` has seen them, and the right-hand side there."""
    unilateral = system.unilateral
    kept, mode = unilateral.kept, unilateral.mode
    at = read(kept, 0, mode)
    at = read(kept, at, unilateral.dry_table)
    at = read(kept, at, unilateral.stop_table)
    at = read(kept, at, unilateral.slide)
    at = read(kept, at, unilateral.tally)
    at = read(kept, at, unilateral.dry)
    at = read(kept, at, unilateral.stop)
    at = read_numbers(kept, at, unilateral.number)
    read_numbers(kept, at, unilateral.shares)
    for i in range(run.y.shape[0]):
        run.y[i] = run.y_new[i]
    # First with the present rows, for the positions of points, which the earlier rows start from.
    evaluate(system, ws, run)
    set_modes(system.contacts, system.couplings, unilateral, ws, mode[:, ku.WANTED])
    evaluate(system, ws, run)
    run.count[ki.STATUS] = ki.RUNNING


@internal_kernel
def write(kept, at, table):
    """Write a table into ``kept`` from ``at`` on; returns where the next begins."""
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            kept[at] = table[i, j]
            at += 1
    return at


@internal_kernel
def read(kept, at, table):
    """Read a table, of numbers or of integers, from ``kept``; returns where the next begins."""
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            table[i, j] = kept[at]
            at += 1
    return at


@internal_kernel
def write_numbers(kept, at, numbers):
    """Write numbers into ``kept`` from ``at`` on; returns where the next begin."""
    for i in range(numbers.shape[0]):
        kept[at + i] = numbers[i]
    return at + numbers.shape[0]


@internal_kernel
def read_numbers(kept, at, numbers):
    """Read numbers from ``kept``; returns where the next begin."""
    for i in range(numbers.shape[0]):
        numbers[i] = kept[at + i]
    return at + numbers.shape[0]
