"""Compiler pipeline of the kernels, numba's with changes that save compilation time; variants for SIMD lanes.

The changes avoid these costs of numba's pipeline:

- It keeps every callee twice, as a library of its own and as a copy in its caller, see :class:`_OwnCallees`.
- It compiles a function again for each set of options of its callers, see :func:`register_part`.
- It takes named tuples apart at every call, see dynsim.jit.struct_types.
- It repeats the same look-ups, see :func:`_quick_look_ups`.

The changes act in dynsim's own compilations only; the parts of numba that they replace are in dynsim.jit.numba_version.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from dynsim.jit.numba_version import check_sources

# isort: split
import numba
from llvmlite.binding import Linkage, parse_assembly
from numba import _dynfunc
from numba.core import config, ir, typed_passes, types, untyped_passes
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import PassManager
from numba.core.types.functions import BaseFunction
from numba.core.typing.templates import infer, infer_global, make_overload_template

from dynsim.jit.struct_types import Lowering, constructors

_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

F = TypeVar("F", bound=Callable[..., Any])


def packs_formulas() -> bool:
    """Whether LLVM packs the scalar formulas of 3-vectors and wrenches into vector instructions.

    A right-hand side takes 8 % less time then. numba leaves it off; who sets NUMBA_SLP_VECTORIZE has the last word.
    """
    return bool(config.SLP_VECTORIZE) or "NUMBA_SLP_VECTORIZE" not in os.environ


class _OwnCallees(JITCodeLibrary):
    """Machine code that calls only what it brings along.

    numba links a copy of every callee into its caller, optimised again there, and leaves all copies under one name:
    which of them runs is then a matter of what the process has loaded before, and so are the last bits of a result.
    Made internal, the copies of a library are its own, in the process that compiles and in all that load it.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        """Nothing yet: all of it is optimised in the end."""
        ll_module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        self._linking_libraries = list(_with_callees(self._linking_libraries))
        super().finalize()

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if function.linkage == Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = Linkage.internal
        # numba runs a cheaper set of passes before, for the sake of reference counting, which kernels do without.
        passes, builder = self._codegen._module_pass_manager(slp_vectorize=packs_formulas())
        passes.run(self._final_module, builder)

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        """For the cache: machine code, and the names by which it is found; not the code to merge into further kernels.

        Parts are for that, see :func:`as_part`; to read it back would take longer than a run of some seconds.
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
    """numba's compiler without the passes for what kernels do not have: closures, array expressions, ``with``, loops
    over types."""

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
    """numba's compiler, into :class:`_OwnCallees`."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        check_sources()
        self.state.library = _OwnCallees(self.state.targetctx.codegen(), func.__qualname__)
        self.state.library.enable_object_caching()
        # What is compiled is still in use: collecting garbage meanwhile finds none, and takes an eighth of the time.
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
    """Two look-ups of numba that take a quarter of the time, mended while a kernel is compiled.

    What is compiled is the same. Others compile before or after, as numba holds its lock of the compiler meanwhile.
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
    """``get_call_type`` that remembers the signatures of operators: numba tries some forty rules for each ``+``.

    Only those found among numba's own: what is compiled on demand (``max``) depends on the options of its caller.
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
    """The variables in a value, in order; numba asks for those of a whole function some forty times."""
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


# What instructions hold besides variables.
_PLAIN = {str, int, float, type(None), ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg, type(ir.UNDEFINED), type(len)}


class _ToLink(JITCodeLibrary):
    """Code that is only linked into other libraries and optimised there; it never becomes machine code of its own."""

    def finalize(self) -> None:
        """Nothing is linked in yet: the kernel links each part once."""
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        self._finalize_dynamic_globals()
        self._finalized = True


def _with_callees(libraries: Iterable[Any], seen: set[Any] | None = None) -> Iterator[Any]:
    """Libraries, and those that parts among them call, each once."""
    seen = set() if seen is None else seen
    for library in libraries:
        if library not in seen:
            seen.add(library)
            yield library
            if isinstance(library, _ToLink):
                yield from _with_callees(library._linking_libraries, seen)


class _ToCall(_ToLink):
    """The same for code that must not be merged into its callers."""

    def add_llvm_module(self, ll_module: Any) -> None:
        for function in ll_module.functions:  # its own; what it calls is linked in later, and may be merged into it
            if not function.is_declaration:
                function.add_function_attribute("noinline")
        super().add_llvm_module(ll_module)


class PartCompiler(_LeanCompiler):
    """numba's compiler, into :class:`_ToLink`."""

    library = _ToLink

    def compile_extra(self, func: Callable[..., Any]) -> Any:
        self.state.library = self.library(self.state.targetctx.codegen(), func.__qualname__)
        self.state.flags.no_compile = True
        result = super().compile_extra(func)
        # Nothing to call: numba only asks for an object of the kind.
        entry = _dynfunc.make_function(
            result.fndesc.lookup_module(), func.__name__, "", 0, result.environment, (result.library,)
        )
        self.state.targetctx.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


class NoInlineCompiler(PartCompiler):
    """numba's compiler, into :class:`_ToCall`."""

    library = _ToCall


def as_part(function: Callable[..., Any], options: Mapping[str, Any]) -> Any:
    """numba's dispatcher of what is linked into its callers; LLVM decides whether it is merged into them."""
    return numba.njit(pipeline_class=PartCompiler, **{"forceinline": False, **options, **_NO_ENTRY})(function)


def register_part(function: F, compiler: type[Compiler], options: Mapping[str, Any]) -> F:
    """The function itself; kernels that call it link it in, compiled once for the types of its arguments.

    numba's own ``register_jitable`` compiles it once more for each set of options of its callers, and takes from them
    what is not said here (``forceinline``).
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


# Parts with another form, and for which types of arguments it stands in.
_FORMS: dict[Callable[..., Any], tuple[Callable[..., Any], Callable[..., bool]]] = {}


def form_of(function: Callable[..., Any], when: Callable[..., bool]) -> Callable[[F], F]:
    """The decorated function stands in for a registered part where ``when(*types of its arguments)`` is true."""

    def put(form: F) -> F:
        _FORMS[function] = form, when
        return form

    return put


def _implementation(template: Any, args: Any, kws: Any) -> Any:
    """``_get_impl`` of a template, whatever the options of the caller."""
    key = template.context, tuple(args), tuple(kws.items())
    if key not in template._impl_cache:
        template._build_impl(key, args, kws)
    return template._impl_cache[key]
