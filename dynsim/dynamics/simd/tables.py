"""Tables for SIMD: float tables whose last axis is the lanes, as tables of Lanes, and single lanes of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from dynsim.dynamics.tables import Workspace
from dynsim.jit.simd import INT32, Lanes, lanes_of
from dynsim.jit.struct_types import Tables, made, parts_of

# Number of lanes: four doubles are one register of AVX2.
WIDTH = 4
# Tables of a workspace that have lanes, as one more axis, the last; rows and modes are the same for all.
WITH_LANES = ("links", "joints", "trig", "motors", "contacts", "rows", "column", "small")


def aligned(*shape: int) -> np.ndarray:
    """Zeros of this shape that begin at a cache line, as whole vectors load fastest."""
    size = math.prod(shape)
    room = np.zeros(size + 8)
    start = (-room.__array_interface__["data"][0] % 64) // 8
    return room[start : start + size].reshape(shape)


def lane_workspace(ws: Workspace) -> Workspace:
    """A workspace whose lanes are all what ``ws`` is; ``trig`` unpadded, as sines are computed a lane at a time."""
    unpadded = ws._replace(trig=ws.trig[:, : len(ws.joints)])
    tables = {name: getattr(unpadded, name)[..., None] for name in WITH_LANES}
    lanes = {name: aligned(*table.shape[:-1], WIDTH) for name, table in tables.items()}
    for name, table in lanes.items():
        table[...] = tables[name]
    return ws._replace(active=ws.active.copy(), counts=ws.counts.copy(), **lanes)


@intrinsic
def lane_count(typingctx: Any, value: Any) -> Any:
    """How many lanes a value or table has."""
    count = lanes_of(value)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.get_constant(types.intp, count)

    return types.intp(value), codegen


@intrinsic
def lane(typingctx: Any, value: Any, k: Any) -> Any:
    """Lane k of a value; of tables a view; tuples part by part. What has no lanes is itself."""
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
        return made(context, builder, result, lanes)
    source, view = make_array(kind)(context, builder, value), make_array(result)(context, builder)
    start = builder.gep(builder.bitcast(source.data, view.data.type), [index])
    return _viewed(context, builder, view, start, source.shape, source.strides, 8)


@intrinsic
def with_lane(typingctx: Any, value: Any, k: Any, x: Any) -> Any:
    """The value with the number x as its lane k."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        index = builder.trunc(context.cast(builder, args[1], sig.args[1], types.intp), INT32)
        return builder.insert_element(args[0], context.cast(builder, args[2], sig.args[2], types.float64), index)

    return value(value, types.unliteral(k), types.unliteral(x)), codegen


@intrinsic
def as_lanes(typingctx: Any, array: Any) -> Any:
    """A C-contiguous array of doubles, its last axis the lanes, as an array of lanes."""
    result = _of_lanes(array)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _as_lanes(context, builder, args[0], array, result)

    return result(array), codegen


def _of_lanes(array: Any) -> Any:
    return types.Array(Lanes(WIDTH), array.ndim - 1, "C", aligned=False)


def _as_lanes(context: Any, builder: Any, value: Any, kind: Any, result: Any) -> Any:
    source, view = make_array(kind)(context, builder, value), make_array(result)(context, builder)
    shape = cgutils.unpack_tuple(builder, source.shape)[:-1]
    strides = cgutils.unpack_tuple(builder, source.strides)[:-1]
    start = builder.bitcast(source.data, view.data.type)
    return _viewed(context, builder, view, start, shape, strides, 8 * result.dtype.lanes)


def _viewed(context: Any, builder: Any, view: Any, data: Any, shape: Any, strides: Any, itemsize: int) -> Any:
    populate_array(
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
    """:func:`as_lanes` of all tables of a workspace that have lanes."""
    parts = [_of_lanes(part) if name in WITH_LANES else part for name, part in zip(ws.fields, ws, strict=True)]
    result = Tables(parts, ws.instance_class)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [
            value if seen == kind else _as_lanes(context, builder, value, kind, seen)
            for value, kind, seen in zip(parts_of(context, builder, ws, args[0]), ws, result, strict=True)
        ]
        return made(context, builder, result, values)

    return result(ws), codegen
