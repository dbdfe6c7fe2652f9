"""Compiler pipeline for kernels: numba's pipeline with changes that reduce compilation time; variants for SIMD lanes.

The changes avoid the following costs of numba's pipeline:

- It stores every callee twice, as a separate library and as a copy in its caller, see :class:`_OwnCallees`.
- It compiles a function again for each set of options of its callers, see :func:`register_part`.
- It unpacks named tuples at every call, see :class:`Tables`.
- It repeats the same look-ups, see :func:`_quick_look_ups`.

The changes are active in dynsim's compilations only; :data:`dynsim.jit.numba_version.REPLACED` lists the
parts of numba that they replace.
"""

from __future__ import annotations

import gc
import hashlib
import inspect
import os
from abc import ABC
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from typing import Any, TypeVar

from dynsim.jit.numba_version import check_sources

# isort: split
import numba
from llvmlite import ir as llvm
from llvmlite.binding import Linkage, parse_assembly
from numba import _dynfunc
from numba.core import cgutils, config, debuginfo, ir, typed_passes, types, untyped_passes
from numba.core.boxing import box_namedtuple
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.datamodel import models, registry
from numba.core.imputils import impl_ret_borrowed, lower_builtin, lower_getattr_generic
from numba.core.lowering import Lower
from numba.core.pythonapi import NativeValue, box, unbox
from numba.core.registry import cpu_target
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NativeLowering
from numba.core.types.functions import BaseFunction
from numba.core.typing.collections import NamedTupleClassAttribute
from numba.core.typing.templates import infer, infer_global, make_callable_template, make_overload_template
from numba.core.typing.typeof import typeof_impl

# Struct types: in compiled code, named tuples are memory blocks that are passed by address.


_BYTE, _WORD = llvm.IntType(8), llvm.IntType(64)
_ADDRESS = _BYTE.as_pointer()


class Tables(types.NamedTuple):  # type: ignore[misc]
    """Type of a named tuple that is passed by its address.

    Its name is short and does not list the fields. numba's type name of a ``Run`` has ten thousand letters and is part
    of the name of every function that has such a parameter.
    """

    def __init__(self, kinds: Iterable[Any], cls: type) -> None:
        self.types = tuple(kinds)
        self.count = len(self.types)
        self.fields = tuple(cls._fields)  # type: ignore[attr-defined]
        self.instance_class = cls
        digest = hashlib.sha256(repr([str(kind) for kind in self.types]).encode()).hexdigest()[:15]
        self._hash = int(digest, 16)  # the same in every process, because types are stored on disk with the kernels
        types.Type.__init__(self, f"{cls.__name__}.{digest}")

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Tables) and self.key == other.key)


class _OfDynsim(ABC):  # noqa: B024
    """Named-tuple classes defined in dynsim, for registration with ``typeof``; numba handles all other classes."""

    @classmethod
    def __subclasshook__(cls, kind: type) -> bool:
        return issubclass(kind, tuple) and hasattr(kind, "_asdict") and kind.__module__.startswith("dynsim.")


@typeof_impl.register(_OfDynsim)
def _typeof(value: Any, context: Any) -> Tables | None:
    kinds = [typeof_impl(part, context) for part in value]
    return None if None in kinds else Tables(kinds, type(value))


def constructors(function: Callable[..., Any], typing: Any) -> None:
    """Let kernels call the dynsim named-tuple classes that a function uses; other code uses numba's constructors."""
    for name in function.__code__.co_names:
        cls = function.__globals__.get(name)
        if isinstance(cls, type) and issubclass(cls, _OfDynsim):
            kind = types.NamedTupleClass(cls)
            if kind not in typing._attributes:
                typing.insert_attributes(type("Constructor", (_Constructor,), {"key": kind})(typing))


class _TablesClass(types.NamedTupleClass):  # type: ignore[misc]
    """Class whose instances are :class:`Tables`, for lowering."""

    def get_impl_key(self, sig: Any) -> Any:
        return _TablesClass


class _Constructor(NamedTupleClassAttribute):  # type: ignore[misc]
    def resolve___call__(self, kind: Any) -> Any:
        if ConfigStack().top().nrt:  # the caller is not a kernel, because kernels do not count references
            return super().resolve___call__(kind)
        cls = kind.instance_class

        def typer(*args: Any, **kws: Any) -> Tables:
            return Tables(map(types.unliteral, typer.pysig.bind(*args, **kws).args), cls)

        typer.pysig = inspect.signature(cls)  # type: ignore[attr-defined]
        return types.Function(make_callable_template(_TablesClass, typer))


@registry.register_default(Tables)
class _TablesModel(models.DataModel):  # type: ignore[misc]
    """Data model: a value is the address of the block; stored data is the block itself, in whole words."""

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
        """Return the parts whose references numba counts; an unassigned variable has the null address."""

        def getter(value: Any, k: int) -> Any:
            nothing = cgutils.alloca_once(builder, llvm.ArrayType(_BYTE, self.size), zfill=True)
            missing = cgutils.is_null(builder, value)
            return self.part(builder, builder.select(missing, builder.bitcast(nothing, _ADDRESS), value), k)

        return [(kind, partial(getter, k=k)) for k, kind in enumerate(self.fe_type)]

    def inner_models(self) -> list[Any]:
        return self.parts

    def room(self, builder: Any) -> Any:
        """Allocate a block in the stack frame of the function."""
        with debuginfo.suspend_emission(builder), builder.goto_entry_block():
            block = builder.alloca(llvm.ArrayType(_BYTE, self.size))
            block.align = self.alignment
            return builder.bitcast(block, _ADDRESS)

    def copied(self, builder: Any, value: Any) -> Any:
        """Return a copy of the block; the null address has no block and is returned unchanged."""
        block = self.room(builder)
        with builder.if_then(cgutils.is_not_null(builder, value)):
            cgutils.raw_memcpy(builder, block, value, _WORD(self.size), 1)
        return builder.select(cgutils.is_null(builder, value), value, block)

    def start(self, builder: Any, value: Any, k: int) -> Any:
        """Return the address of part k."""
        return builder.gep(value, [_WORD(self.starts[k])], inbounds=True) if self.starts[k] else value

    def part(self, builder: Any, value: Any, k: int) -> Any:
        """Return part k of the tuple, or its address if it is a nested tuple."""
        model, start = self.parts[k], self.start(builder, value, k)
        if isinstance(model, _TablesModel):
            return start
        kind = model.get_data_type()
        start = builder.bitcast(start, kind.as_pointer())
        if kind == model.get_value_type():
            return builder.load(start)  # a single load, which LLVM may split
        return model.load_from_data_pointer(builder, start)

    def put(self, builder: Any, block: Any, k: int, value: Any) -> None:
        """Set part k of a block that is being built."""
        model, start = self.parts[k], self.start(builder, block, k)
        if isinstance(model, _TablesModel):
            cgutils.raw_memcpy(builder, start, value, _WORD(model.size), 1)
        else:
            data = model.as_data(builder, value)
            builder.store(data, builder.bitcast(start, data.type.as_pointer()))


def parts_of(context: Any, builder: Any, kind: Any, value: Any) -> list[Any]:
    """Return the parts of a named tuple in compiled code."""
    model = context.data_model_manager[kind]
    return [model.part(builder, value, k) for k in range(len(kind))]


def build_tuple(context: Any, builder: Any, kind: Tables, values: Sequence[Any]) -> Any:
    """Build a named tuple from its parts in the stack frame of the function."""
    model = context.data_model_manager[kind]
    block = model.room(builder)
    for k, value in enumerate(values):
        model.put(builder, block, k, value)
    return block


@lower_builtin(_TablesClass, types.VarArg(types.Any))
def _constructed(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind = sig.return_type
    values = [context.cast(builder, *conversion) for conversion in zip(args, sig.args, kind, strict=True)]
    return impl_ret_borrowed(context, builder, kind, build_tuple(context, builder, kind, values))


class _Lower(Lower):  # type: ignore[misc]
    """numba's lowering with constructors of :class:`Tables`, and copies of tables that are assigned more than once."""

    def _lower_call_normal(self, fnty: Any, expr: Any, signature: Any) -> Any:
        if isinstance(fnty, types.NamedTupleClass) and isinstance(signature.return_type, Tables):
            fnty = _TablesClass(fnty.instance_class)
        return super()._lower_call_normal(fnty, expr, signature)

    @cached_property
    def _reassigned(self) -> set[str]:
        """Names of variables of type :class:`Tables` that are assigned more than once."""
        assigned = (store.target.name for block in self.blocks.values() for store in block.find_insts(ir.Assign))
        return {
            name for name, times in Counter(assigned).items() if times > 1 and isinstance(self.typeof(name), Tables)
        }

    def loadvar(self, name: str) -> Any:
        """Load a copy of the tuple, because its value must survive the next assignment."""
        return self._copied(super().loadvar(name), name)

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Store a copy of the tuple, because it must survive the next tuple built in the same block."""
        super().storevar(self._copied(value, name), name, argidx)

    def _copied(self, value: Any, name: str) -> Any:
        if name not in self._reassigned:
            return value
        return self.context.data_model_manager[self.typeof(name)].copied(self.builder, value)


@register_pass(mutates_CFG=True, analysis_only=False)
class Lowering(NativeLowering):  # type: ignore[misc]
    """Lowering pass that uses :class:`_Lower`."""

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
    """Return part k; numba counts its references if it counts any."""
    part = context.data_model_manager[kind].part(builder, value, k)
    return impl_ret_borrowed(context, builder, kind[k], part)


@unbox(Tables)
def _unboxed(typ: Any, obj: Any, c: Any) -> Any:
    """Unbox a tuple into a block part by part, like numba's ``unbox_tuple``; its class defines the number of parts."""
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


# isort: split


_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

F = TypeVar("F", bound=Callable[..., Any])


def packs_formulas() -> bool:
    """Return whether LLVM packs the scalar formulas of 3-vectors and wrenches into vector instructions.

    A right-hand side then takes 8 % less time. numba disables this by default; the environment variable
    NUMBA_SLP_VECTORIZE takes precedence.
    """
    return bool(config.SLP_VECTORIZE) or "NUMBA_SLP_VECTORIZE" not in os.environ


class _OwnCallees(JITCodeLibrary):
    """Machine code that calls only functions that it contains.

    numba links a copy of every callee into its caller, optimises it again there, and gives all copies the same name.
    The copy that runs, and thus the last bits of a result, would then depend on the code loaded earlier in the process.
    As internal functions, the copies are private to a library, in the compiling process and in all processes that load
    it.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        """Do nothing, because all functions are optimised at the end."""
        ll_module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        self._linking_libraries = _with_callees(self._linking_libraries)
        super().finalize()

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage == Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = Linkage.internal
        # numba first runs cheaper passes for reference counting, which kernels do not use.
        passes, builder = self._codegen._module_pass_manager(slp_vectorize=packs_formulas())
        passes.run(self._final_module, builder)

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        """Return machine code and its symbol names for the cache, without the code for inlining into other kernels.

        Parts serve that purpose, see :func:`as_part`. Reading this code back would take longer than a run of a few
        seconds.
        """
        self._ensure_finalized()
        module, inside = self._final_module, (Linkage.internal, Linkage.private)
        functions, variables = (
            [symbol.name for symbol in symbols if not symbol.is_declaration and symbol.linkage not in inside]
            for symbols in (module.functions, module.global_variables)
        )
        lines = [f'define void @"{name}"() {{ ret void }}' for name in functions]
        lines += [f'@"{name}" = common global i8 0' for name in variables]
        names = parse_assembly("\n".join(lines)).as_bitcode()
        return self.name, "object", (self._get_compiled_object(), names)


class _LeanCompiler(Compiler):
    """numba's compiler without the passes for features that kernels do not use.

    These features are closures, array expressions, ``with`` and loops over types.
    """

    def define_pipelines(self) -> list[PassManager]:
        passes = PassManager("kernel")
        for step in _PASSES:
            passes.add_pass(step, step.__name__)
        passes.finalize()
        return [passes]

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        constructors(func, self.state.typingctx)
        return super().compile_extra(func)


_PASSES = (
    untyped_passes.TranslateByteCode,
    untyped_passes.FixupArgs,
    untyped_passes.IRProcessing,
    untyped_passes.GenericRewrites,
    untyped_passes.InlineInlinables,
    untyped_passes.DeadBranchPrune,
    untyped_passes.ReconstructSSA,
    typed_passes.NopythonTypeInference,
    typed_passes.PreLowerStripPhis,
    typed_passes.IRLegalization,
    Lowering,
    typed_passes.NoPythonBackend,
)


class KernelCompiler(_LeanCompiler):
    """Compiler that compiles kernels into :class:`_OwnCallees`."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        check_sources()
        self.state.library = _OwnCallees(self.state.targetctx.codegen(), func.__qualname__)
        self.state.library.enable_object_caching()
        # All objects are still in use, so garbage collection would free nothing and take an eighth of the time.
        collecting = gc.isenabled()
        gc.disable()
        try:
            with _quick_look_ups():
                return super().compile_extra(func)
        finally:
            if collecting:
                gc.enable()


@contextmanager
def _quick_look_ups() -> Iterator[None]:
    """Speed up two of numba's look-ups, which take a quarter of the compilation time, while a kernel is compiled.

    The result is the same. Other threads compile before or after this, because numba holds its compiler lock meanwhile.
    """
    replaced = (BaseFunction, "get_call_type", _remembered()), (ir.Inst, "_rec_list_vars", _variables)
    originals = [getattr(owner, name) for owner, name, _ in replaced]
    try:
        for owner, name, function in replaced:
            setattr(owner, name, function)
        yield
    finally:
        for (owner, name, _), function in zip(replaced, originals, strict=True):
            setattr(owner, name, function)


def _remembered() -> Callable[..., Any]:
    """Return ``get_call_type`` with a cache of operator signatures: numba tries about forty rules for each ``+``.

    Only numba's own signatures are cached, because functions compiled on demand (such as ``max``) depend on the options
    of their caller.
    """
    look_up, signatures = BaseFunction.get_call_type, {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return look_up(self, context, args, kws)
        key = self, context, *args
        if key not in signatures:
            signature = look_up(self, context, args, kws)
            if self._impl_keys[signature.args] is not self.typing_key:
                return signature
            signatures[key] = signature
        return signatures[key]

    return get_call_type


def _variables(self: Any, value: Any) -> list[ir.Var]:
    """Return the variables in a value, in order; numba requests all variables of a function about forty times."""
    if isinstance(value, ir.Var):
        return [value]
    if isinstance(value, ir.Inst):
        return value.list_vars()
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, (list, tuple)):
        return []
    return [
        variable
        for part in value
        for variable in ((part,) if type(part) is ir.Var else () if type(part) in _PLAIN else _variables(self, part))
    ]


# Types that occur in instructions and are not variables.
_PLAIN = {str, int, float, type(None), ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg, type(ir.UNDEFINED), type(len)}


class _ToLink(JITCodeLibrary):
    """Code that is only linked into other libraries and optimised there; it never becomes machine code itself."""

    def finalize(self) -> None:
        """Link nothing, because the kernel links each part once."""
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        self._finalize_dynamic_globals()
        self._finalized = True


def _with_callees(libraries: Iterable[Any]) -> list[Any]:
    """Return the libraries, and those called by parts among them, each once and after all of its callers.

    LLVM drops a function if nothing linked before refers to it, and later calls of it would have no address.
    """
    seen, callees_first = set[Any](), list[Any]()

    def visit(library: Any) -> None:
        if library in seen:
            return
        seen.add(library)
        if isinstance(library, _ToLink):
            for callee in library._linking_libraries:
                visit(callee)
        callees_first.append(library)

    for library in libraries:
        visit(library)
    return callees_first[::-1]


class _ToCall(_ToLink):
    """Code as in :class:`_ToLink` that must not be inlined into its callers."""

    def add_llvm_module(self, ll_module: Any) -> None:
        for function in ll_module.functions:  # only this module's functions; callees are linked later, may be inlined
            if not function.is_declaration:
                function.add_function_attribute("noinline")
        super().add_llvm_module(ll_module)


class PartCompiler(_LeanCompiler):
    """Compiler that compiles parts into :class:`_ToLink`."""

    library = _ToLink

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        self.state.library = self.library(self.state.targetctx.codegen(), func.__qualname__)
        self.state.flags.no_compile = True
        result = super().compile_extra(func)
        # This entry is never called; numba only requires an object of this kind.
        entry = _dynfunc.make_function(
            result.fndesc.lookup_module(), func.__name__, "", 0, result.environment, (result.library,)
        )
        self.state.targetctx.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


class NoInlineCompiler(PartCompiler):
    """Compiler that compiles parts into :class:`_ToCall`."""

    library = _ToCall


def as_part(function: Callable[..., Any], options: Mapping[str, Any]) -> Any:
    """Return a numba dispatcher for a function that is linked into its callers; LLVM decides whether to inline it."""
    return numba.njit(pipeline_class=PartCompiler, **{"forceinline": False, **options, **_NO_ENTRY})(function)


def register_part(function: F, compiler: type[Compiler], options: Mapping[str, Any]) -> F:
    """Register a function as a part and return it; kernels that call it link it, compiled once per set of types.

    numba's ``register_jitable`` would compile the function again for each set of options of its callers, and the
    function would inherit options that are not set here (``forceinline``) from its callers.
    """

    def implementation(*kinds: Any, **__: Any) -> Any:
        form, when = _FORMS.get(function, (None, None))
        return form if when and when(*kinds) else function

    every = {"nopython": True, "pipeline_class": compiler, "forceinline": False, **options, **_NO_ENTRY}
    template = make_overload_template(function, implementation, every, strict=False, inline="never")
    template._get_impl = _implementation
    infer(template)
    infer_global(function, types.Function(template))
    return function


# Parts that have a variant, with the condition on the argument types under which the variant is used.
_FORMS: dict[Callable[..., Any], tuple[Callable[..., Any], Callable[..., bool]]] = {}


def form_of(function: Callable[..., Any], when: Callable[..., bool]) -> Callable[[F], F]:
    """Use the decorated function instead of a registered part if ``when(*argument types)`` is true."""

    def put(form: F) -> F:
        _FORMS[function] = form, when
        return form

    return put


def _implementation(template: Any, args: Any, kws: Any) -> Any:
    """Return ``_get_impl`` of a template, regardless of the options of the caller."""
    key = template.context, tuple(args), tuple(kws.items())
    if key not in template._impl_cache:
        template._build_impl(key, args, kws)
    return template._impl_cache[key]
