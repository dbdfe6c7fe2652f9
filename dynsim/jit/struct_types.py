"""Struct types: named tuples in compiled code as memory blocks that are passed by address.

numba flattens tuples at every call: the tables of a model, a workspace and a run are some seven hundred numbers, and
more than half of the code of a kernel took tuples apart and put them together. Here a tuple is one block of memory,
with its inner tuples inside; a call passes its address, and reading a field by its name is one load.

Tuples are immutable, so their addresses are declared ``noalias``, and LLVM moves loads out of loops. A tuple made by
compiled code lives in the stack frame of the function that makes it, one per place in the source. Returned tuples, and
those in variables that are assigned in several places, are copied, so that a later iteration cannot overwrite them.
"""

from __future__ import annotations

import hashlib
import inspect
from abc import ABC
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from typing import Any

from dynsim.jit import numba_version  # noqa: F401

# isort: split
from llvmlite import ir as llvm
from numba.core import cgutils, debuginfo, ir, types
from numba.core.boxing import box_namedtuple
from numba.core.compiler_machinery import register_pass
from numba.core.datamodel import models, registry
from numba.core.imputils import impl_ret_borrowed, lower_builtin, lower_getattr_generic
from numba.core.lowering import Lower
from numba.core.pythonapi import NativeValue, box, unbox
from numba.core.registry import cpu_target
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NativeLowering
from numba.core.typing.collections import NamedTupleClassAttribute
from numba.core.typing.templates import make_callable_template
from numba.core.typing.typeof import typeof_impl

_BYTE, _WORD = llvm.IntType(8), llvm.IntType(64)
_ADDRESS = _BYTE.as_pointer()


class Tables(types.NamedTuple):  # type: ignore[misc]
    """Type of a named tuple that is passed by its address.

    Its name says which, not what is in it: numba's name of a run is ten thousand letters long, and part of the name of
    each function that is given one.
    """

    def __init__(self, kinds: Iterable[Any], cls: type) -> None:
        self.types = tuple(kinds)
        self.count = len(self.types)
        self.fields = tuple(cls._fields)  # type: ignore[attr-defined]
        self.instance_class = cls
        digest = hashlib.sha256(repr([str(kind) for kind in self.types]).encode()).hexdigest()[:15]
        self._hash = int(digest, 16)  # the same in every process: types are kept on disk with the kernels
        types.Type.__init__(self, f"{cls.__name__}.{digest}")

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Tables) and self.key == other.key)


class _OfDynsim(ABC):  # noqa: B024
    """The classes of named tuples in dynsim's own modules, for ``typeof``: all others are numba's."""

    @classmethod
    def __subclasshook__(cls, kind: type) -> bool:
        return issubclass(kind, tuple) and hasattr(kind, "_asdict") and kind.__module__.startswith("dynsim.")


@typeof_impl.register(_OfDynsim)
def _typeof(value: Any, context: Any) -> Tables | None:
    kinds = [typeof_impl(part, context) for part in value]
    return None if None in kinds else Tables(kinds, type(value))


def constructors(function: Callable[..., Any], typing: Any) -> None:
    """Let kernels call the classes of dynsim's named tuples that a function names; other compiled code sees numba's."""
    for name in function.__code__.co_names:
        cls = function.__globals__.get(name)
        if isinstance(cls, type) and issubclass(cls, _OfDynsim):
            kind = types.NamedTupleClass(cls)
            if kind not in typing._attributes:
                typing.insert_attributes(type("Constructor", (_Constructor,), {"key": kind})(typing))


class _TablesClass(types.NamedTupleClass):  # type: ignore[misc]
    """To lowering, a class whose instances are :class:`Tables`."""

    def get_impl_key(self, sig: Any) -> Any:
        return _TablesClass


class _Constructor(NamedTupleClassAttribute):  # type: ignore[misc]
    def resolve___call__(self, kind: Any) -> Any:
        if ConfigStack().top().nrt:  # not a kernel: they do not count references
            return super().resolve___call__(kind)
        cls = kind.instance_class

        def typer(*args: Any, **kws: Any) -> Tables:
            return Tables(map(types.unliteral, typer.pysig.bind(*args, **kws).args), cls)

        typer.pysig = inspect.signature(cls)  # type: ignore[attr-defined]
        return types.Function(make_callable_template(_TablesClass, typer))


@registry.register_default(Tables)
class _TablesModel(models.DataModel):  # type: ignore[misc]
    """The value is the address of the block; as data it is the block itself, in whole words."""

    def __init__(self, dmm: Any, fe_type: Tables) -> None:
        super().__init__(dmm, fe_type)
        self.parts = [dmm.lookup(kind) for kind in fe_type]
        target, end, self.starts, self.alignment = cpu_target.target_context.target_data, 0, [], 8
        for part in self.parts:
            kind = part.get_data_type()
            inner = isinstance(part, _TablesModel)
            alignment = part.alignment if inner else kind.get_abi_alignment(target)
            end = -(-end // alignment) * alignment
            self.starts.append(end)
            end += part.size if inner else kind.get_abi_size(target)
            self.alignment = max(self.alignment, alignment)
        self.size = -(-end // self.alignment) * self.alignment

    def get_value_type(self) -> Any:
        return _ADDRESS

    def get_data_type(self) -> Any:
        return llvm.ArrayType(_WORD, self.size // 8)

    def get_argument_type(self) -> Any:
        return _ADDRESS

    def get_return_type(self) -> Any:
        return self.get_data_type()

    def as_argument(self, builder: Any, value: Any) -> Any:
        return value

    def from_argument(self, builder: Any, value: Any) -> Any:
        if isinstance(value, llvm.Argument):
            for attribute in ("noalias", "captures(none)"):
                value.add_attribute(attribute)
        return value

    def as_data(self, builder: Any, value: Any) -> Any:
        return builder.load(builder.bitcast(value, self.get_data_type().as_pointer()))

    def from_data(self, builder: Any, value: Any) -> Any:
        block = self.room(builder)
        builder.store(value, builder.bitcast(block, value.type.as_pointer()))
        return block

    as_return, from_return = as_data, from_data

    def load_from_data_pointer(self, builder: Any, ptr: Any, align: int | None = None) -> Any:
        return builder.bitcast(ptr, _ADDRESS)

    def traverse(self, builder: Any) -> list[tuple[Any, Any]]:
        """What numba counts references to; the address of a variable that has not been assigned yet is null."""

        def getter(value: Any, k: int) -> Any:
            nothing = cgutils.alloca_once(builder, llvm.ArrayType(_BYTE, self.size), zfill=True)
            missing = cgutils.is_null(builder, value)
            return self.part(builder, builder.select(missing, builder.bitcast(nothing, _ADDRESS), value), k)

        return [(kind, partial(getter, k=k)) for k, kind in enumerate(self.fe_type)]

    def inner_models(self) -> list[Any]:
        return self.parts

    def room(self, builder: Any) -> Any:
        """A block in the frame of the function."""
        with debuginfo.suspend_emission(builder), builder.goto_entry_block():
            block = builder.alloca(llvm.ArrayType(_BYTE, self.size))
            block.align = self.alignment
            return builder.bitcast(block, _ADDRESS)

    def copied(self, builder: Any, value: Any) -> Any:
        """The block once more; nothing of nothing."""
        block = self.room(builder)
        with builder.if_then(cgutils.is_not_null(builder, value)):
            cgutils.raw_memcpy(builder, block, value, _WORD(self.size), 1)
        return builder.select(cgutils.is_null(builder, value), value, block)

    def start(self, builder: Any, value: Any, k: int) -> Any:
        """Address of part k."""
        return builder.gep(value, [_WORD(self.starts[k])], inbounds=True) if self.starts[k] else value

    def part(self, builder: Any, value: Any, k: int) -> Any:
        """Part k of the tuple: of a tuple in it the address."""
        model, start = self.parts[k], self.start(builder, value, k)
        if isinstance(model, _TablesModel):
            return start
        kind = model.get_data_type()
        start = builder.bitcast(start, kind.as_pointer())
        if kind == model.get_value_type():
            return builder.load(start)  # in one, and LLVM's to take apart
        return model.load_from_data_pointer(builder, start)

    def put(self, builder: Any, block: Any, k: int, value: Any) -> None:
        """Part k of a block that is being made."""
        model, start = self.parts[k], self.start(builder, block, k)
        if isinstance(model, _TablesModel):
            cgutils.raw_memcpy(builder, start, value, _WORD(model.size), 1)
        else:
            data = model.as_data(builder, value)
            builder.store(data, builder.bitcast(start, data.type.as_pointer()))


def parts_of(context: Any, builder: Any, kind: Any, value: Any) -> list[Any]:
    """The parts of a named tuple in compiled code."""
    model = context.data_model_manager[kind]
    return [model.part(builder, value, k) for k in range(len(kind))]


def made(context: Any, builder: Any, kind: Tables, values: Sequence[Any]) -> Any:
    """A named tuple of these parts, in the frame of the function."""
    model = context.data_model_manager[kind]
    block = model.room(builder)
    for k, value in enumerate(values):
        model.put(builder, block, k, value)
    return block


@lower_builtin(_TablesClass, types.VarArg(types.Any))
def _constructed(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind = sig.return_type
    values = [context.cast(builder, *conversion) for conversion in zip(args, sig.args, kind, strict=True)]
    return impl_ret_borrowed(context, builder, kind, made(context, builder, kind, values))


class _Lower(Lower):  # type: ignore[misc]
    """numba's, with constructors of :class:`Tables`, and copies of those that are assigned in several places."""

    def _lower_call_normal(self, fnty: Any, expr: Any, signature: Any) -> Any:
        if isinstance(fnty, types.NamedTupleClass) and isinstance(signature.return_type, Tables):
            fnty = _TablesClass(fnty.instance_class)
        return super()._lower_call_normal(fnty, expr, signature)

    @cached_property
    def _again(self) -> set[str]:
        """Names of those."""
        assigned = (store.target.name for block in self.blocks.values() for store in block.find_insts(ir.Assign))
        return {
            name for name, times in Counter(assigned).items() if times > 1 and isinstance(self.typeof(name), Tables)
        }

    def loadvar(self, name: str) -> Any:
        """The tuple outlives the next assignment."""
        return self._copied(super().loadvar(name), name)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """The variable outlives the next tuple that is made where this one was."""
        super().storevar(self._copied(value, name), name, argidx)

    def _copied(self, value: Any, name: str) -> Any:
        if name not in self._again:
            return value
        return self.context.data_model_manager[self.typeof(name)].copied(self.builder, value)


@register_pass(mutates_CFG=True, analysis_only=False)
class Lowering(NativeLowering):  # type: ignore[misc]
    """numba's, by :class:`_Lower`."""

    _name = "dynsim_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return _Lower


@lower_builtin("static_getitem", Tables, types.IntegerLiteral)
def _numbered(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, (value, number) = sig.args[0], args
    return _borrowed(context, builder, kind, value, number % len(kind))


@lower_getattr_generic(Tables)
def _field(context: Any, builder: Any, typ: Any, value: Any, attr: str) -> Any:
    return _borrowed(context, builder, typ, value, typ.fields.index(attr))


def _borrowed(context: Any, builder: Any, kind: Any, value: Any, k: int) -> Any:
    """Part k, whose references numba counts where it counts any."""
    part = context.data_model_manager[kind].part(builder, value, k)
    return impl_ret_borrowed(context, builder, kind[k], part)


@unbox(Tables)
def _unboxed(typ: Any, obj: Any, c: Any) -> Any:
    """numba's ``unbox_tuple``, part by part into a block. The number of parts is that of the class."""
    model, cleanups = c.context.data_model_manager[typ], []
    block, is_error = model.room(c.builder), cgutils.alloca_once_value(c.builder, cgutils.false_bit)
    for k, kind in enumerate(typ):
        native = c.unbox(kind, c.pyapi.tuple_getitem(obj, k))
        model.put(c.builder, block, k, native.value)
        with c.builder.if_then(native.is_error, likely=False):
            c.builder.store(cgutils.true_bit, is_error)
        if native.cleanup is not None:
            cleanups.append(native.cleanup)

    def cleanup() -> None:
        for clean in reversed(cleanups):
            clean()

    return NativeValue(block, cleanup=cleanup if cleanups else None, is_error=c.builder.load(is_error))


@box(Tables)
def _boxed(typ: Any, value: Any, c: Any) -> Any:
    return box_namedtuple(typ, cgutils.pack_struct(c.builder, parts_of(c.context, c.builder, typ, value)), c)
