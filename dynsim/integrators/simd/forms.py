"""The right-hand side on SIMD lanes: tables with lanes, variants of kernels, and ``derivative`` of four states at once.

A variant replaces its kernel only for arguments with lanes. Variants exist for kernels that branch on data; they use
selects or run lane by lane. All other kernels are compiled for lanes from their own source.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.delassus import check_forces, solve_dependent, solve_many, solve_small
from dynsim.dynamics.contact.rows import sign_changed, surface_distance
from dynsim.dynamics.contact.shares import solve_near_shares
from dynsim.dynamics.contact.unilateral import slide_direction, sliding_friction
from dynsim.dynamics.derivative import System, derivative
from dynsim.dynamics.drive.law import clipped, evaluate_reference, fed_forward, servo_circuit
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.loads import add_loads
from dynsim.jit.compiler import Tables, build_tuple, form_of, parts_of
from dynsim.jit.kernel import every, internal_kernel, noinline_kernel
from dynsim.jit.simd import INT32, Lanes, all_lanes, lanes_of, select

# Tables for SIMD: views of float tables, whose last axis is the lanes, as tables of Lanes, and access to single lanes.


# Number of lanes: an AVX2 register holds four doubles.
WIDTH = 4
# Workspace tables that have lanes as an additional last axis; rows and modes are the same for all lanes.
WITH_LANES = ("links", "joints", "trig", "motors", "contacts", "rows", "column", "small")


def aligned(*shape: int) -> np.ndarray:
    """Return an array of zeros that begins at a cache line, so that whole vectors load fastest."""
    size = math.prod(shape)
    room = np.zeros(size + 8)
    start = (-room.__array_interface__["data"][0] % 64) // 8
    return room[start : start + size].reshape(shape)


def lane_workspace(ws: Workspace) -> Workspace:
    """Return a workspace whose lanes all equal ``ws``; ``trig`` is unpadded, as sines are computed lane by lane."""
    unpadded = ws._replace(trig=ws.trig[:, : len(ws.joints)])
    tables = {name: getattr(unpadded, name)[..., None] for name in WITH_LANES}
    lanes = {name: aligned(*table.shape[:-1], WIDTH) for name, table in tables.items()}
    for name, table in lanes.items():
        table[...] = tables[name]
    return ws._replace(active=ws.active.copy(), counts=ws.counts.copy(), **lanes)


@intrinsic
def lane_count(typingctx: Any, value: Any) -> Any:
    """Return the number of lanes of a value or table."""
    count = lanes_of(value)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.get_constant(types.intp, count)

    return types.intp(value), codegen


@intrinsic
def lane(typingctx: Any, value: Any, k: Any) -> Any:
    """Return lane k of a value: a view of a table, or a tuple of lanes; a value without lanes is returned unchanged."""
    result = _lane_type(value)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        index = context.cast(builder, args[1], sig.args[1], types.intp)
        return _lane(context, builder, args[0], value, index)

    return result(value, types.unliteral(k)), codegen


def _lane_type(kind: Any) -> Any:
    if isinstance(kind, Lanes):
        return types.float64
    if isinstance(kind, types.Array) and isinstance(kind.dtype, Lanes):
        return types.Array(types.float64, kind.ndim, "A", aligned=False)
    if isinstance(kind, Tables):
        return Tables([_lane_type(part) for part in kind], kind.instance_class)
    return kind


def _lane(context: Any, builder: Any, value: Any, kind: Any, index: Any) -> Any:
    result = _lane_type(kind)
    if result == kind:
        return value
    if isinstance(kind, Lanes):
        return builder.extract_element(value, builder.trunc(index, INT32))
    if isinstance(kind, Tables):
        parts = parts_of(context, builder, kind, value)
        lanes = [_lane(context, builder, x, part, index) for x, part in zip(parts, kind, strict=True)]
        return build_tuple(context, builder, result, lanes)
    source, view = context.make_array(kind)(context, builder, value), context.make_array(result)(context, builder)
    start = builder.gep(builder.bitcast(source.data, view.data.type), [index])
    return _viewed(context, builder, view, start, source.shape, source.strides, 8)


@intrinsic
def with_lane(typingctx: Any, value: Any, k: Any, x: Any) -> Any:
    """Return the value with lane k replaced by the number x."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        index = builder.trunc(context.cast(builder, args[1], sig.args[1], types.intp), INT32)
        return builder.insert_element(args[0], context.cast(builder, args[2], sig.args[2], types.float64), index)

    return value(value, types.unliteral(k), types.unliteral(x)), codegen


@intrinsic
def as_lanes(typingctx: Any, array: Any) -> Any:
    """Return a C-contiguous array of doubles, whose last axis is the lanes, as an array of lanes."""
    result = _of_lanes(array)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _as_lanes(context, builder, args[0], array, result)

    return result(array), codegen


def _of_lanes(array: Any) -> Any:
    return types.Array(Lanes(WIDTH), array.ndim - 1, "C", aligned=False)


def _as_lanes(context: Any, builder: Any, value: Any, kind: Any, result: Any) -> Any:
    source, view = context.make_array(kind)(context, builder, value), context.make_array(result)(context, builder)
    shape = cgutils.unpack_tuple(builder, source.shape)[:-1]
    strides = cgutils.unpack_tuple(builder, source.strides)[:-1]
    start = builder.bitcast(source.data, view.data.type)
    return _viewed(context, builder, view, start, shape, strides, 8 * result.dtype.lanes)


def _viewed(context: Any, builder: Any, view: Any, data: Any, shape: Any, strides: Any, itemsize: int) -> Any:
    context.populate_array(
        view,
        data=data,
        shape=shape,
        strides=strides,
        itemsize=context.get_constant(types.intp, itemsize),
        meminfo=None,
    )
    return view._getvalue()


@intrinsic
def tables_as_lanes(typingctx: Any, ws: Any) -> Any:
    """Apply :func:`as_lanes` to all tables of a workspace that have lanes."""
    parts = [_of_lanes(part) if name in WITH_LANES else part for name, part in zip(ws.fields, ws, strict=True)]
    result = Tables(parts, ws.instance_class)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [
            value if seen == kind else _as_lanes(context, builder, value, kind, seen)
            for value, kind, seen in zip(parts_of(context, builder, ws, args[0]), ws, result, strict=True)
        ]
        return build_tuple(context, builder, result, values)

    return result(ws), codegen


def any_lanes(*kinds):
    """Return whether any argument has lanes."""
    return lanes_of(*kinds) > 0


def times(*kinds):
    """Return whether t, the third argument, has lanes."""
    return lanes_of(kinds[2]) > 0


@form_of(clipped, any_lanes)
def clipped_lanes(x, limit):
    """Clip each lane to ±limit; NaN is kept."""
    return select(x > limit, limit, select(x < -limit, -limit, x))


@form_of(servo_circuit, any_lanes)
def servo_circuit_lanes(motor, a, mode, command, v):
    """Return voltage and current; lanes at the current limit have a different voltage."""
    if mode == ka.OFF:
        return motor[a, ka.K_M] * v, 0.0 * v
    u = clipped(command, motor[a, ka.U_MAX])
    wanted = (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]
    i = clipped(wanted, motor[a, ka.I_MAX])
    return select(i != wanted, motor[a, ka.RESISTANCE] * i + motor[a, ka.K_M] * v, u), i


@form_of(surface_distance, any_lanes)
def surface_distance_lanes(value, slope, curvature):
    """Return the distance; lanes without a root along the normal get the first-order distance."""
    inner = 1.0 - 2.0 * curvature * value / (slope * slope)
    return select(inner <= 0.0, value / slope, 2.0 * value / (slope * (1.0 + math.sqrt(inner))))


@form_of(every, any_lanes)
def every_lane(mask):
    """Return whether the mask is true for all lanes."""
    return all_lanes(mask)


@form_of(solve_many, any_lanes)
def solve_many_lanes(small, state, p):
    """Solve lane by lane, in closed form where it holds for this lane alone; return the sum of results."""
    dependent = 0
    for k in range(lane_count(small)):
        dependent += solve_small(lane(small, k), lane(state, k), p)
    return dependent


@form_of(solve_dependent, any_lanes)
def solve_dependent_lanes(small, state, p):
    """Solve lane by lane."""
    dependent = 0
    for k in range(lane_count(small)):
        dependent += solve_dependent(lane(small, k), lane(state, k), p)
    return dependent


@form_of(solve_near_shares, any_lanes)
def solve_near_shares_lanes(unilateral, ws, p):
    """Solve lane by lane."""
    dependent = 0
    for k in range(lane_count(ws)):
        dependent += solve_near_shares(unilateral, lane(ws, k), p)
    return dependent


@form_of(slide_direction, any_lanes)
def slide_direction_lanes(unilateral, contacts, k, slip, n):
    """Return the direction of each lane; ``unilateral.slide`` keeps the speed of the last single-state evaluation."""
    slide, (x, y, z) = unilateral.slide, slip
    a, b, c = slide[k, ku.REFERENCE], slide[k, ku.REFERENCE + 1], slide[k, ku.REFERENCE + 2]
    along = x * a + y * b + z * c
    if slide[k, ku.FROZEN] == 1.0:
        slow, up = unilateral.number[ku.SLOW], a * n[0] + b * n[1] + c * n[2]
        more = select(along < slow, slow - along, 0.0)
        a, b, c = a - up * n[0], b - up * n[1], c - up * n[2]
        u, v, w = x + more * a, y + more * b, z + more * c
        size = math.sqrt(u * u + v * v + w * w)
        moves = size > 0.0
        a, b, c = select(moves, u / size, a), select(moves, v / size, b), select(moves, w / size, c)
        speed = x * a + y * b + z * c
    else:
        size = math.sqrt(x * x + y * y + z * z)
        moves, on = size > 0.0, along >= 0.0
        scale = select(on, 1.0 / size, -1.0 / size)
        a, b, c = select(moves, x * scale, a), select(moves, y * scale, b), select(moves, z * scale, c)
        speed = select(moves, select(on, size, -size), along)
    return a, b, c, sliding_friction(contacts.law, k, speed)


@form_of(check_forces, any_lanes)
def check_forces_lanes(model, contacts, unilateral, ws):
    """Check lane by lane."""
    for k in range(lane_count(ws)):
        check_forces(model, contacts, unilateral, lane(ws, k))


@form_of(sign_changed, any_lanes)
def sign_changed_lanes(ws, passes):
    """Return whether the signs of any lane have changed; lanes whose signs agree with their forces keep them."""
    one_way = False
    for k in range(ws.counts[ka.ROWS]):
        if ws.active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
            one_way = True
    changed = False
    if one_way:
        for k in range(lane_count(ws)):
            if sign_changed(lane(ws, k), passes):
                changed = True
    return changed


@form_of(evaluate_reference, times)
def evaluate_reference_lanes(drives, reference, t, ws):
    """Evaluate the references at several times, which may be in different segments."""
    for k in range(lane_count(t)):
        evaluate_reference(drives, reference, lane(t, k), lane(ws, k))


@form_of(fed_forward, times)
def fed_forward_lanes(voltage, grid, t, a, asked):
    """Add the planned voltages at several times, one per lane."""
    if voltage.shape[0] == 0:
        return asked
    for k in range(lane_count(t)):
        asked = with_lane(asked, k, fed_forward(voltage, grid, lane(t, k), a, lane(asked, k)))
    return asked


@form_of(add_loads, times)
def add_loads_lanes(model, loads, t, ws, power, start):
    """Add the external wrenches at several times, one per lane."""
    for k in range(lane_count(t)):
        add_loads(model, loads, lane(t, k), lane(ws, k), lane(power, k), start)


# Evaluation of ``derivative`` for four states at four times, and its tables.


# Parts of a system whose kernels do not have variants for lanes.
_WITHOUT_FORMS = ("dense", "shapes")


def has_forms(system: System) -> bool:
    """Return whether the right-hand side compiles for lanes: only points on quadrics, with the articulated solve."""
    return all(getattr(system, name) is None for name in _WITHOUT_FORMS)


class StageLanes(NamedTuple):
    """Arrays of right-hand sides that are evaluated four at a time."""

    ws: Workspace
    t: np.ndarray  # (4,)
    y: np.ndarray  # (m, 4)
    f: np.ndarray  # (m, 4)
    delta: np.ndarray  # (4,)
    output: np.ndarray  # (columns.size, 4), see dynsim.dynamics.state.OutputLayout


def stage_lanes(ws: Workspace, m: int, columns: int) -> StageLanes:
    """Allocate :class:`StageLanes` for a workspace, whose rows are copied whenever the Jacobian is recomputed."""
    return StageLanes(lane_workspace(ws), aligned(4), aligned(m, 4), aligned(m, 4), aligned(4), aligned(columns, 4))


@noinline_kernel
def evaluate_four(lanes: StageLanes, system: System):
    """Call ``derivative`` for all lanes; all callers share one compiled program."""
    derivative(system, as_lanes(lanes.t)[()], as_lanes(lanes.y), tables_as_lanes(lanes.ws), as_lanes(lanes.f))


@internal_kernel
def take_rows(ws: Workspace, lanes: Workspace):
    """Copy the rows, modes and anchors of a workspace to all lanes of another workspace."""
    for r in range(ws.active.shape[0]):
        for s in range(ws.active.shape[1]):
            lanes.active[r, s] = ws.active[r, s]
        for s in range(ws.rows.shape[1]):
            for k in range(4):
                lanes.rows[r, s, k] = ws.rows[r, s]
    for c in range(ws.contacts.shape[0]):
        for s in range(ws.contacts.shape[1]):
            for k in range(4):
                lanes.contacts[c, s, k] = ws.contacts[c, s]
    for s in range(ws.counts.shape[0]):
        lanes.counts[s] = ws.counts[s]
    # As after solves with other rows, entries of joints that no row involves must be zero.
    for i in range(ws.column.shape[0]):
        for s in range(ws.column.shape[1]):
            for k in range(4):
                lanes.column[i, s, k] = 0.0
