"""Compiler type of N doubles (SIMD) with its operations: one source of a kernel serves numbers and vectors.

Arithmetic, roots and ``min``/``max`` work lane by lane in vector instructions. A comparison gives a :class:`Mask`. It
has no truth value: a branch on it does not compile, because lanes could not take different branches. Kernels that
branch on data ask for ``every`` lane or have variants for lanes, made with :func:`select`, see
dynsim.integrators.simd.forms.

LLVM maps ``<N x double>`` to the registers of the processor: eight lanes are one register of AVX-512, two of AVX2 or
four of SSE2.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import PrimitiveModel
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, register_model

INT32 = ir.IntType(32)


class Lanes(types.Type):
    """Compiler type of N doubles, one per lane."""

    def __init__(self, count: int) -> None:
        self.lanes = count
        super().__init__(name=f"Lanes({count})")

    def unify(self, typingctx: Any, other: Any) -> Any:
        """Return the lanes type for a variable that is first assigned a number and later lanes."""
        return self if isinstance(other, (types.Float, types.Integer)) else None

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Allow the conversion of a number to lanes that all contain it."""
        return Conversion.unsafe if isinstance(other, (types.Float, types.Integer)) else None


class Mask(types.Type):
    """Compiler type of N booleans, one per lane."""

    def __init__(self, count: int) -> None:
        self.lanes = count
        super().__init__(name=f"Mask({count})")


@register_model(Lanes)
class _LanesModel(PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        super().__init__(manager, kind, _vector(kind.lanes))


@register_model(Mask)
class _MaskModel(PrimitiveModel):
    def __init__(self, manager: Any, kind: Mask) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.lanes))


def _vector(count: int) -> ir.VectorType:
    return ir.VectorType(ir.DoubleType(), count)


def spread(context: Any, builder: Any, value: Any, kind: Any, count: int) -> Any:
    """Return a value as lanes: the value itself, or lanes that all contain a number."""
    if isinstance(kind, Lanes):
        return value
    vector = _vector(count)
    none = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(none, context.cast(builder, value, kind, types.float64), ir.Constant(INT32, 0))
    return builder.shuffle_vector(first, none, ir.Constant(ir.VectorType(INT32, count), [0] * count))


@lower_cast(types.Float, Lanes)
@lower_cast(types.Integer, Lanes)
def _cast(context: Any, builder: Any, kind: Any, to: Lanes, value: Any) -> Any:
    return spread(context, builder, value, kind, to.lanes)


def lanes_of(*kinds: Any) -> int:
    """Return the lane count of the first type that has lanes; tuples and arrays have the lanes of their parts."""
    for kind in kinds:
        lanes = getattr(kind, "lanes", 0)
        if not lanes and isinstance(kind, types.Array):
            lanes = lanes_of(kind.dtype)
        elif not lanes and isinstance(kind, types.BaseTuple):
            lanes = lanes_of(*kind)
        if lanes:
            return int(lanes)
    return 0


def _operation(function: Any, result: Callable[[int], types.Type], emit: Callable[..., Any]) -> None:
    """Define ``function`` for lanes, and for lanes mixed with numbers, by ``emit(builder, count, *vectors)``."""

    class Template(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            plain = [types.unliteral(kind) for kind in args]
            if not any(isinstance(kind, Lanes) for kind in plain):
                return None
            if not all(isinstance(kind, (Lanes, types.Float, types.Integer)) for kind in plain):
                return None
            return signature(result(lanes_of(*plain)), *plain)

    infer_global(function)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        count = lanes_of(*sig.args)
        return emit(
            builder,
            count,
            *(spread(context, builder, x, kind, count) for x, kind in zip(args, sig.args, strict=True)),
        )

    numbers = (Lanes, types.Float, types.Integer)
    if emit.__code__.co_argcount == 3:
        lower_builtin(function, Lanes)(lower)
        return
    for first in numbers:
        for second in numbers:
            if first is Lanes or second is Lanes:
                lower_builtin(function, first, second)(lower)


def _arithmetic(name: str) -> Callable[..., Any]:
    return lambda builder, count, a, b: getattr(builder, name)(a, b)


def _comparison(symbol: str) -> Callable[..., Any]:
    kind = "fcmp_unordered" if symbol == "!=" else "fcmp_ordered"
    return lambda builder, count, a, b: getattr(builder, kind)(symbol, a, b)


def _llvm(name: str) -> Callable[..., Any]:
    return lambda builder, count, a: _call(builder, count, name, a)


def _call(builder: Any, count: int, name: str, *args: Any) -> Any:
    vector = _vector(count)
    kind = ir.FunctionType(vector, [vector] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{count}f64"), args)


for _function, _name in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.isub, "fsub"),
    (operator.mul, "fmul"),
    (operator.imul, "fmul"),
    (operator.truediv, "fdiv"),
    (operator.itruediv, "fdiv"),
):
    _operation(_function, Lanes, _arithmetic(_name))
for _function, _name in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _operation(_function, Mask, _comparison(_name))
for _function, _name in ((math.sqrt, "sqrt"), (np.rint, "rint"), (np.floor, "floor"), (abs, "fabs"), (math.exp, "exp")):
    _operation(_function, Lanes, _llvm(_name))
_operation(operator.neg, Lanes, lambda builder, count, a: builder.fsub(ir.Constant(_vector(count), [-0.0] * count), a))
_operation(operator.pow, Lanes, lambda builder, count, a, b: _call(builder, count, "pow", a, b))
# These definitions treat NaN as numba does for numbers.
_operation(min, Lanes, lambda builder, count, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))
_operation(max, Lanes, lambda builder, count, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Return, for each lane, a if the mask is true and b otherwise; a number counts as equal lanes."""
    result = Lanes(mask.lanes)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        mask, *values = args
        x, y = (
            spread(context, builder, value, kind, result.lanes)
            for value, kind in zip(values, sig.args[1:], strict=True)
        )
        return builder.select(mask, x, y)

    return signature(result, mask, a, b), codegen


@intrinsic
def all_lanes(typingctx: Any, mask: Any) -> Any:
    """Return whether the mask is true for all lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(mask.lanes))
        return builder.icmp_unsigned("==", bits, ir.Constant(ir.IntType(mask.lanes), 2**mask.lanes - 1))

    return types.boolean(mask), codegen


@intrinsic
def four(typingctx: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Return four numbers as lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = ir.Constant(_vector(4), ir.Undefined)
        for k, x in enumerate(args):
            number = context.cast(builder, x, sig.args[k], types.float64)
            value = builder.insert_element(value, number, ir.Constant(INT32, k))
        return value

    return signature(Lanes(4), *(types.unliteral(x) for x in (a, b, c, d))), codegen


@intrinsic
def swap_middle(typingctx: Any, value: Any) -> Any:
    """Return four lanes with the middle two exchanged."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        order = ir.Constant(ir.VectorType(INT32, 4), [0, 2, 1, 3])
        return builder.shuffle_vector(args[0], args[0], order)

    return value(value), codegen
