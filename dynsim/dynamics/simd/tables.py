"""Tables of lanes: float tables whose last axis is the lanes, seen by the compiler as tables of Lanes, and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from dynsim.dynamics.tables import ContactArrays, DriveArrays, ModelArrays, ReferenceArrays, Workspace
from dynsim.jit.simd import INT32, Lanes, lanes_of
from dynsim.jit.struct_types import Tables, made, parts_of

# Axes of the float tables that may have lanes: one more, and the last one is the lanes. The others are shared by all.
AXES: dict[type, dict[str, int]] = {
    ModelArrays: {"body": 2, "gravity": 1},
    DriveArrays: {"motor": 2, "input": 2},
    ReferenceArrays: {"held": 1, "coefficients": 3, "voltage": 3},
    ContactArrays: {"point": 2},
    Workspace: {
        "links": 2,
        "joints": 2,
        "trig": 2,
        "motors": 2,
        "contacts": 2,
        "rows": 2,
        "column": 2,
        "small": 3,
    },
}


def aligned(*shape: int) -> np.ndarray:
    """Zeros of this shape that begin at a cache line, as whole vectors load fastest."""
    size = math.prod(shape)
    room = np.zeros(size + 8)
    start = (-room.__array_interface__["data"][0] % 64) // 8
    return room[start : start + size].reshape(shape)


def spread_tables(tables: Any, count: int) -> Any:
    """A named tuple whose tables of :data:`AXES` have so many equal lanes; the others are the same objects."""
    return _mapped(tables, lambda table: _spread_table(table, count))


def _spread_table(table: np.ndarray, count: int) -> np.ndarray:
    result = aligned(*table.shape, count)
    result[...] = table[..., None]
    return result


def stack_tables(tables: Sequence[Any]) -> Any:
    """Named tuples of one kind as one, whose tables of :data:`AXES` have them as lanes; the others are the first's."""
    first, parts = tables[0], {}
    axes = AXES.get(type(first), {})
    for name, part in first._asdict().items():
        if hasattr(part, "_asdict"):
            parts[name] = stack_tables([getattr(one, name) for one in tables])
        elif part is not None and name in axes:
            parts[name] = aligned(*part.shape, len(tables))
            for k, one in enumerate(tables):
                parts[name][..., k] = getattr(one, name)
    return first._replace(**parts)


def lane_tables(tables: Any, k: int) -> Any:
    """Lane k of a named tuple of tables, views: what :func:`lane` is to the compiler."""
    return _mapped(tables, lambda table: table[..., k], 1)


def _mapped(value: Any, change: Any, more: int = 0) -> Any:
    """The tuple with its tables changed that have ``more`` axes than AXES says; those in it likewise."""
    axes = AXES.get(type(value), {})
    parts = {}
    for name, part in value._asdict().items():
        if hasattr(part, "_asdict"):
            parts[name] = _mapped(part, change, more)
        elif part is not None and name in axes and part.ndim == axes[name] + more:
            parts[name] = change(part)
    return value._replace(**parts)


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
def as_lanes(typingctx: Any, array: Any, width: Any) -> Any:
    """A C-contiguous array of doubles, its last axis the lanes, as an array of lanes; width: a tuple of N anything."""
    result = types.Array(Lanes(len(width)), array.ndim - 1, "C", aligned=False)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _as_lanes(context, builder, args[0], array, result)

    return result(array, width), codegen


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
def tables_as_lanes(typingctx: Any, tables: Any, width: Any) -> Any:
    """:func:`as_lanes` of all tables in a named tuple, and in those in it, that have an axis more than AXES says."""
    result = _tables_type(tables, len(width))

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _tables(context, builder, args[0], tables, result)

    return result(tables, width), codegen


def _tables_type(kind: Any, count: int) -> Any:
    axes, parts = AXES.get(kind.instance_class, {}), []
    for name, part in zip(kind.fields, kind, strict=True):
        if isinstance(part, Tables):
            parts.append(_tables_type(part, count))
        elif isinstance(part, types.Array) and part.ndim == axes.get(name, part.ndim) + 1:
            parts.append(types.Array(Lanes(count), part.ndim - 1, "C", aligned=False))
        else:
            parts.append(part)
    return Tables(parts, kind.instance_class)


def _tables(context: Any, builder: Any, value: Any, kind: Any, result: Any) -> Any:
    if result == kind:
        return value
    if isinstance(kind, types.Array):
        return _as_lanes(context, builder, value, kind, result)
    parts = parts_of(context, builder, kind, value)
    return made(
        context,
        builder,
        result,
        [_tables(context, builder, x, a, b) for x, a, b in zip(parts, kind, result, strict=True)],
    )
