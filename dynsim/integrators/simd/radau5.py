"""RADAU5 on SIMD lanes: linear systems of Newton's method, stages, Jacobian columns, step ends and samples.

Each function is a variant of the scalar kernel named in its decorator. The compiler uses it if ``newton.lanes`` is set,
which depends only on the system; see :func:`dynsim.integrators.simd.forms.has_forms`.
"""

from __future__ import annotations

from typing import Any

from numba.core import types

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.unilateral import UnilateralArrays
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import positions_along, rates_across
from dynsim.integrators import run as ki
from dynsim.integrators.events import note_inside
from dynsim.integrators.radau5 import tables as kn
from dynsim.integrators.radau5.step import (
    columns,
    displaced,
    end_accepted,
    end_settled,
    end_watched,
    end_workspace,
    evaluate_end,
    evaluate_stages,
    factor_both,
    solve_both,
)
from dynsim.integrators.radau5.tables import ALPHA_RADAU, BETA_RADAU, GAMMA_RADAU, NODE_RADAU, NewtonArrays
from dynsim.integrators.run import Run, fill_output, off_surface, write_sample, write_samples, write_waiting
from dynsim.integrators.simd.forms import StageLanes, as_lanes, evaluate_four, lane, tables_as_lanes, take_rows
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import internal_kernel
from dynsim.jit.simd import four, swap_middle


def has_lanes(*kinds: Any) -> bool:
    """True if right-hand sides are evaluated on lanes, from the types of arguments with the tables of RADAU5."""
    tables = (kind for kind in kinds if "lanes" in getattr(kind, "fields", ()))
    return any(kind[kind.fields.index("lanes")] != types.none for kind in tables)


def _on_lanes(*kinds: Any) -> bool:
    """Return whether samples use lanes and the law is bilateral, so that only samples need the forces at the end."""
    _, system, *_ = kinds
    return has_lanes(*kinds) and bool(system[system.fields.index("unilateral")] == types.none)


@internal_kernel
def pair(real, z):
    """Return factors with which x ∘ (p, m) is a multiplication by a real and a complex number at once."""
    return four(real, z.real, z.real, real), four(0.0, -z.imag, z.imag, 0.0)


@form_of(factor_both, has_lanes)
def invert_on_lanes(system, r, h):
    """Invert both reduced matrices by Gauss–Jordan elimination, with pivots that are large in both."""
    along, block, table = r.along, r.linear, system.drives.table
    p, m = as_lanes(r.direct), as_lanes(r.crossed)
    over, circuit = as_lanes(r.over), as_lanes(r.circuit)
    n, real, z = p.shape[0], GAMMA_RADAU / h, complex(ALPHA_RADAU / h, BETA_RADAU / h)
    first = 2 * n
    gp, gm = pair(real, z)
    op, om = pair(1.0 / real, 1.0 / z)
    over[0], over[1] = op, om
    for i in range(n):
        for j in range(n):
            p[i, j] = -along[j, i] * op - along[n + j, i]
            m[i, j] = -along[j, i] * om
        p[i, i] += gp
        m[i, i] += gm
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            rate = block[a, ka.RATE_I]
            cp, cm = pair(1.0 / (real - rate), 1.0 / (z - rate))
            circuit[a, 0], circuit[a, 1] = cp, cm
            sp, sm = block[a, ka.RATE_Q] * op + block[a, ka.RATE_V], block[a, ka.RATE_Q] * om
            sp, sm = sp * cp - sm * cm, sp * cm + sm * cp
            for i in range(n):
                p[i, j] -= along[first + k, i] * sp
                m[i, j] -= along[first + k, i] * sm
    for k in range(n):
        best, largest = k, 0.0
        for i in range(k, n):
            size = (r.direct[i, k, 1] ** 2 + r.crossed[i, k, 2] ** 2) * r.direct[i, k, 0] ** 2
            if size > largest:
                best, largest = i, size
        r.pivot[k] = best
        if best != k:
            for j in range(n):
                p[k, j], p[best, j] = p[best, j], p[k, j]
                m[k, j], m[best, j] = m[best, j], m[k, j]
        dp, dm = pair(1.0 / r.direct[k, k, 0], 1.0 / complex(r.direct[k, k, 1], r.crossed[k, k, 2]))
        p[k, k], m[k, k] = 1.0, 0.0
        for j in range(n):
            c, d = p[k, j], m[k, j]
            p[k, j], m[k, j] = c * dp - d * dm, c * dm + d * dp
        for i in range(n):
            if i != k:
                e, f = p[i, k], m[i, k]
                p[i, k], m[i, k] = 0.0, 0.0
                for j in range(n):
                    c, d = p[k, j], m[k, j]
                    p[i, j], m[i, j] = p[i, j] - (e * c - f * d), m[i, j] - (e * d + f * c)
    for k in range(n - 1, -1, -1):
        best = r.pivot[k]
        if best != k:
            for i in range(n):
                p[i, k], p[i, best] = p[i, best], p[i, k]
                m[i, k], m[i, best] = m[i, best], m[i, k]


@form_of(solve_both, has_lanes)
def multiply_on_lanes(system, ws, y, r, h):
    """Multiply by the inverses of :func:`invert_on_lanes`."""
    along, block, table, layout = r.along, r.linear, system.drives.table, system.layout
    n, q, v, current = along.shape[1], layout.q, layout.v, layout.current
    p, m, x, room = as_lanes(r.direct), as_lanes(r.crossed), as_lanes(r.x), as_lanes(r.room)
    over, circuit = as_lanes(r.over), as_lanes(r.circuit)
    op, om = over[0], over[1]
    u, angle, across, first = room[0], room[1], room[2], 2 * n
    for j in range(x.shape[0]):
        x[j] = four(r.one[j], r.two[j].real, r.two[j].imag, 0.0)
    if layout.extra > 0:
        rates_across(system.model, y, q, x, angle)
    for i in range(n):
        e = angle[i] if layout.extra > 0 else x[q + i]
        angle[i] = e * op + swap_middle(e) * om
        u[i] = x[v + i]
    for j in range(n):
        e = angle[j]
        for i in range(n):
            u[i] += along[j, i] * e
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            free = x[current + k] + block[a, ka.RATE_Q] * angle[j]
            free = free * circuit[a, 0] + swap_middle(free) * circuit[a, 1]
            for i in range(n):
                u[i] += along[first + k, i] * free
    for i in range(n):
        across[i] = swap_middle(u[i])
    for i in range(n):
        total, other = x[v + i] * 0.0, x[v + i] * 0.0
        for j in range(n):
            total += p[i, j] * u[j]
            other += m[i, j] * across[j]
        x[v + i] = total + other
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            rate = x[v + j]
            moved = angle[j] + rate * op + swap_middle(rate) * om
            free = x[current + k] + block[a, ka.RATE_Q] * moved + block[a, ka.RATE_V] * rate
            x[current + k] = free * circuit[a, 0] + swap_middle(free) * circuit[a, 1]
    if layout.extra == 0:
        for i in range(n):
            rate = x[v + i]
            x[q + i] = angle[i] + rate * op + swap_middle(rate) * om
    else:
        for i in range(n):
            u[i] = x[v + i]
        positions_along(system.model, y, q, u, x)
        for j in range(q, q + n + layout.extra):
            e = x[j]
            x[j] = e * op + swap_middle(e) * om
    for j in range(x.shape[0]):
        e = x[j]
        r.one[j], r.two[j] = lane(e, 0), complex(lane(e, 1), lane(e, 2))


@internal_kernel
def may_wait(unilateral: UnilateralArrays | None, run: Run):
    """Return whether only steps occur between two samples, so that modes, commands and loads do not change."""
    if unilateral is None:  # resolved at compile time
        return run.event.shape[0] + run.tick.shape[0] + run.breaks.shape[0] == 0
    return False


@internal_kernel
def has_stops(unilateral: UnilateralArrays | None):
    """Return whether joints have stops or dry friction, whose forces are stored for a single state only."""
    if unilateral is None:  # resolved at compile time
        return False
    return unilateral.stop.shape[0] + unilateral.dry.shape[0] > 0


@form_of(write_samples, has_lanes)
def write_samples_on_lanes(newton, system, ws, run, more):
    """Record four samples at a time, or fewer if they cannot wait; a single sample is cheaper without lanes."""
    newton.count[kn.WAITING] += more
    wait = may_wait(system.unilateral, run)
    # The ground reaction, too, is only computed for a single state.
    alone = has_stops(system.unilateral) or run.support.index.shape[0] > 0
    while newton.count[kn.WAITING] >= 4 or (newton.count[kn.WAITING] > 0 and not wait):
        if alone or newton.count[kn.WAITING] == 1:
            newton.count[kn.WAITING] -= 1
            write_sample(system, ws, run)
        else:
            write_together(newton, system, ws, run, 0)


@form_of(write_waiting, has_lanes)
def write_waiting_on_lanes(newton, system, ws, run):
    """Write waiting samples from lanes, even a single one, so that values do not depend on when calls return.

    The first lane still contains the end of a pending step.
    """
    if newton.count[kn.WAITING] > 0:
        write_together(newton, system, ws, run, 1)


@internal_kernel
def write_together(newton: NewtonArrays, system: System, ws: Workspace, run: Run, begin):
    """Record the waiting samples, up to four, starting at lane ``begin``."""
    count = load_samples(newton, run, begin)
    fill_lanes(newton.lanes, run, begin + count)
    evaluate_four(newton.lanes, system)
    take_samples(newton, system, ws, run, begin, count)


@internal_kernel
def load_samples(newton: NewtonArrays, run: Run, begin):
    """Load waiting samples into the lanes, starting at ``begin``; return their number."""
    lanes, first, count = newton.lanes, run.count[ki.SAMPLE], min(newton.count[kn.WAITING], 4 - begin)
    for k in range(count):
        lanes.t[begin + k] = run.sample_time[first + k]
        for j in range(run.y.shape[0]):
            lanes.y[j, begin + k] = run.sample[first + k, j]
    return count


@internal_kernel
def fill_lanes(lanes: StageLanes, run: Run, begin):
    """Copy the first lane into the unused lanes, starting at ``begin``."""
    for k in range(begin, 4):
        lanes.t[k] = lanes.t[0]
        for j in range(run.y.shape[0]):
            lanes.y[j, k] = lanes.y[j, 0]


@internal_kernel
def take_samples(newton: NewtonArrays, system: System, ws: Workspace, run: Run, begin, count):
    """Record ``count`` samples from the lanes, starting at ``begin``; project samples off their surfaces separately."""
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


@form_of(evaluate_end, _on_lanes)
def evaluate_end_on_lanes(newton, system, ws, run):
    """Evaluate y_new on the first lane, the two inner stages on the next two, and a waiting sample on the last."""
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
    """Check the end of the step in the first lane, unless it must be projected."""
    end = lane(tables_as_lanes(newton.lanes.ws), 0)
    if not off_surface(end):
        return end_watched(system, end, run)
    return end_settled(system, ws, run, True) and end_watched(system, ws, run)


@form_of(end_workspace, _on_lanes)
def end_workspace_on_lanes(newton, system, ws, run):
    """Return the first lane, which contains the end of the step."""
    return lane(tables_as_lanes(newton.lanes.ws), 0)


@form_of(columns, has_lanes)
def columns_on_lanes(lanes, system, ws, t, y, x, base, r):
    """Compute four columns at a time; if their number is not a multiple of four, the last one is repeated."""
    v, last = system.layout.v, r.along.shape[0] - 1
    take_rows(ws, lanes.ws)
    for first in range(0, last + 1, 4):
        for k in range(4):
            lanes.t[k] = t
            lanes.delta[k] = displaced(system, ws, y, min(first + k, last), lanes.y[:, k], r.clock[kn.CHANGE])
        evaluate_four(lanes, system)
        r.count[kn.COLUMNS] += 4
        for k in range(4):
            s = min(first + k, last)
            for i in range(r.along.shape[1]):
                r.along[s, i] = (lanes.f[v + i, k] - base[v + i]) / lanes.delta[k]


@form_of(evaluate_stages, has_lanes)
def stages_on_lanes(lanes, system, ws, t, h, y, x, r):
    """Evaluate the three stages on three lanes, and the last stage again on the fourth lane."""
    for j in range(r.kept.shape[1]):
        z0, z1, z2 = y[j] + r.z[0, j], y[j] + r.z[1, j], y[j] + r.z[2, j]
        lanes.y[j, 0], lanes.y[j, 1], lanes.y[j, 2], lanes.y[j, 3] = z0, z1, z2, z2
    for k in range(4):
        lanes.t[k] = t + NODE_RADAU[min(k, 2)] * h
    evaluate_four(lanes, system)
    for j in range(y.shape[0]):
        r.f[0, j], r.f[1, j], r.f[2, j] = lanes.f[j, 0], lanes.f[j, 1], lanes.f[j, 2]
