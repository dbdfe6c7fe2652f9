"""Kernels that others call by address: compiled on their own, by a process alongside the one that compiles the caller.

A compiled function carries the code of all it calls, and so is compiled on one core. A part that is worth a process of
its own is a kernel of its own instead: its caller knows only a symbol, which gets an address when the caller is loaded.
Both are in the cache, the caller with what it needs.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba.core import cgutils, serialize, types
from numba.extending import intrinsic


class Need(NamedTuple):
    """A kernel that is called by address, and the types of its arguments."""

    module: str
    name: str
    kinds: tuple[Any, ...]

    @property
    def symbol(self) -> str:
        """By which its callers know it."""
        return f"dynsim.{self.name}.{hashlib.sha256(repr(self).encode()).hexdigest()[:16]}"

    def compile(self) -> Any:
        """numba's result, from the cache if it is there."""
        dispatcher = getattr(importlib.import_module(self.module), self.name).dispatcher
        dispatcher.compile(self.kinds)
        return dispatcher.overloads[self.kinds]


# By symbol: what has been asked for, what is being compiled alongside, and what has an address in this process.
_asked: dict[str, Need] = {}
_working: dict[str, subprocess.Popen[bytes]] = {}
_provided: dict[str, Any] = {}


def by_address(function: Callable[..., Any], dispatcher: Any) -> Any:
    """What kernels call for a kernel that returns nothing and is compiled on its own."""

    def call(typing: Any, *kinds: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            need = Need(function.__module__, function.__qualname__, tuple(signature.args))
            _ask(need)
            convention = context.call_conv
            kind = convention.get_function_type(types.none, signature.args)
            callee = cgutils.get_or_insert_function(builder.module, kind, need.symbol)
            status, _ = convention.call_function(builder, callee, types.none, signature.args, values)
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return context.get_dummy_value()

        return types.none(*kinds), generate

    # numba wants to see the arguments.
    first = inspect.Parameter("typing", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    call.__signature__ = inspect.Signature([first, *inspect.signature(function).parameters.values()])  # type: ignore[attr-defined]
    found = intrinsic(call)
    found.dispatcher = dispatcher
    return found


def needed_by(module: Any) -> list[Need]:
    """What an LLVM module calls by address."""
    return [_asked[one.name] for one in module.functions if one.is_declaration and one.name in _asked]


def provide(need: Need) -> None:
    """Give the symbol its address in this process; waits for the process that compiles the kernel, if there is one."""
    if need.symbol in _provided:
        return
    process = _working.pop(need.symbol, None)
    if process is not None:
        process.wait()
    _asked[need.symbol] = need
    result = _provided[need.symbol] = need.compile()
    llvm.add_symbol(need.symbol, result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def _ask(need: Need) -> None:
    """Have the kernel compiled alongside, where there is a core for it; else :func:`provide` will do it here."""
    if need.symbol in _asked:
        return
    _asked[need.symbol] = need
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores < 2 or not sys.executable:
        return
    with suppress(OSError):  # no process to be had: as with one core
        process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import _work; _work()"],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _working[need.symbol] = process
        assert process.stdin is not None
        with process.stdin as stdin:
            stdin.write(serialize.dumps(need))


def _work() -> None:
    """In the process alongside: compile into the cache."""
    pickle.load(sys.stdin.buffer).compile()
