"""Habits of numba that cost a third of the time it takes to make a kernel, mended: it looks the same things up again
and again. None of this changes what is compiled.

numba is pinned to one minor version, see pyproject.toml; a test compiles with and without this, to the same machine
code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from typing import Any

from numba.core import base, ir, ssa, transforms, types
from numba.core.base import BaseContext
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import TargetConfig
from numba.core.types.functions import BaseFunction
from numba.core.typing.npydecl import NumpyRulesArrayOperator


def mend(owner: Any, name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Put the decorated function in the place of ``owner.name``."""

    def put(function: Callable[..., Any]) -> Callable[..., Any]:
        setattr(owner, name, function)
        return function

    return put


_call_type = BaseFunction.get_call_type


@mend(BaseFunction, "get_call_type")
def _found_call_type(self: BaseFunction, context: Any, args: Any, kws: Any) -> Any:
    """The signature of an operator for types of arguments, remembered: numba tries some forty rules for each ``+``.

    Only what is found among numba's own signatures: what is compiled on demand (``max``) depends on the options of the
    function that it is called from.
    """
    if kws:
        return _call_type(self, context, args, kws)
    found = self.__dict__.setdefault("_found", {})
    key = context, *args
    if key not in found:
        signature = _call_type(self, context, args, kws)
        if self._impl_keys[signature.args] is not self.typing_key:
            return signature
        found[key] = signature
    return found[key]


@mend(ir.Inst, "_rec_list_vars")
def _variables(self: ir.Inst, value: Any) -> list[ir.Var]:
    """The variables in a value, in order; numba asks for those of a whole function some forty times."""
    if isinstance(value, ir.Var):
        return [value]
    if isinstance(value, ir.Inst):
        return value.list_vars()
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, (list, tuple)):
        return []
    found = []
    for one in value:
        kind = type(one)
        if kind is ir.Var:
            found.append(one)
        elif kind not in _PLAIN:
            found += _variables(self, one)
    return found


# What instructions hold besides variables.
_PLAIN = {str, int, float, type(None), ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg, type(ir.UNDEFINED), type(len)}


@mend(ssa, "_run_ssa_block_pass")
def _statements(states: dict[str, Any], block: ir.Block, handler: Any) -> Iterator[Any]:
    """What a handler makes of the statements of a block, without a line of a log for each."""
    for statement in block.body:
        treat = handler.on_assign if isinstance(statement, ir.Assign) else handler.on_other
        yield treat(states, statement)


@mend(TargetConfig, "values")
def _options(self: TargetConfig) -> dict[str, Any]:
    return _defaults(type(self)) | self._values


@cache
def _defaults(kind: type[TargetConfig]) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


@mend(TargetConfig, "__hash__")
def _hash_of_options(self: TargetConfig) -> int:
    return hash(type(self))


_array_rules = NumpyRulesArrayOperator.generic


@mend(NumpyRulesArrayOperator, "generic")
def _only_arrays(self: NumpyRulesArrayOperator, args: Any, kws: Any) -> Any:
    """The rules of array arithmetic are tried where there is an array."""
    if any(isinstance(argument, types.ArrayCompatible) for argument in args):
        return _array_rules(self, args, kws)
    return None


_post_process = PostProcessor.run


@mend(PostProcessor, "run")
def _only_what_is_read(self: PostProcessor, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """numba's, without the variables that live at the entry of each block: only generators are compiled from them."""
    code = self.func_ir
    if code.is_generator:
        _post_process(self, emit_dels, extend_lifetimes)
        return
    code.blocks = transforms.canonicalize_cfg(code.blocks)
    code.variable_lifetime = VariableLifetime(code.blocks)
    code.generator_info = None
    if emit_dels:
        self._insert_var_dels(extend_lifetimes=extend_lifetimes)


base._has_loc = lru_cache(maxsize=4096)(base._has_loc)
BaseContext.get_abi_sizeof = lru_cache(maxsize=4096)(BaseContext.get_abi_sizeof)
