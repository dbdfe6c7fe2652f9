"""numba for other code in the process: unchanged by dynsim, which adapts it in its own compilations alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core import ir
from numba.core.types.functions import BaseFunction
from support.messages import check_message, raises

from dynsim.jit import kernel as jit
from dynsim.jit import numba_version

pytestmark = pytest.mark.skipif(numba.config.DISABLE_JIT, reason="what the compiler does")

PROGRAM = '''
import re, sys
from collections import namedtuple

if "imported" in sys.argv or "compiled" in sys.argv:
    import dynsim.jit.kernel as jit
    import dynsim.integrators.simd.forms

if "compiled" in sys.argv:
    from typing import NamedTuple
    import numpy as np

    class Pair(NamedTuple):
        table: np.ndarray
        number: float

    Pair.__module__ = "dynsim.example"

    @jit.kernel
    def total(pair):
        other = pair
        for k in range(3):
            other = Pair(other.table, other.number + pair.table[k] ** 2)
        return other.number

    assert total(Pair(np.arange(3.0), 1.0)) == 6.0

import numba
import numpy as np
from numba import njit, objmode, prange, vectorize
from numba.experimental import jitclass

Point = namedtuple("Point", "x y")


def generators():
    @njit
    def odd(n):
        for i in range(n):
            if i % 2:
                yield i * 1.5

    @njit
    def total(n):
        found = 0.0
        for x in odd(n):
            found += x
        return found

    return total(10)


def parallel():
    @njit(parallel=True)
    def total(a):
        s = 0.0
        for i in prange(a.shape[0]):
            s += a[i] ** 2
        return s + (a * 2 + 1).sum()

    return total(np.arange(10.0))


def object_mode():
    @njit
    def norm(x):
        with objmode(y="float64"):
            y = float(np.linalg.norm([x, x]))
        return y + 1

    return norm(3.0)


def lifted_loops():
    @numba.jit(forceobj=True, looplift=True)
    def total(a):
        found = {}
        s = 0
        for i in range(len(a)):
            s += a[i]
        found["x"] = s
        return found["x"]

    return total(np.arange(5)), len(total.overloads[total.signatures[0]].lifted)


def containers():
    @njit
    def count(n):
        pairs = [(i, i * 2.0) for i in range(n)]
        found = {}
        for a, b in pairs:
            found[a] = b
        return len(found), found[3]

    return count(6)


def named_tuples():
    @njit
    def turned(p):
        q = Point(p.y, p.x)
        for i in range(3):
            q = Point(q.x + i, q.y)
        return q

    mixed = Point(np.arange(2.0), 1)
    return turned(Point(1.0, 2.0)), str(numba.typeof(mixed)), str(numba.typeof(Point(1.0, 2.0)))


def vectorized():
    @vectorize(["float64(float64,float64)"])
    def f(a, b):
        return a * b + 1

    return f(np.arange(3.0), 2.0).tolist()


def classes():
    @jitclass([("v", numba.float64[:])])
    class A:
        def __init__(self, n):
            self.v = np.zeros(n)

        def add(self, k):
            self.v[:] += k
            return self.v.sum()

    return A(4).add(2.0)


def array_expressions():
    @njit
    def f(a, b):
        return (a + b * 2)[a > 1].mean(), np.dot(a, b)

    return f(np.arange(5.0), np.ones(5))


def strings():
    @njit
    def f(s):
        return s.upper() + str(len(s))

    return f("abc")


def machine_code():
    """Instructions of what LLVM packs into vectors, where it is told to."""

    @njit
    def cross(a, b, c):
        c[0] = a[0] * b[0] + 1.0
        c[1] = a[1] * b[1] + 1.0
        c[2] = a[2] * b[2] + 1.0
        c[3] = a[3] * b[3] + 1.0

    cross(np.ones(4), np.ones(4), np.ones(4))
    (code,) = cross.inspect_asm().values()
    return re.findall(r"^\\t([a-z]\\w*)", code, re.MULTILINE)


def options():
    return sorted((name, value) for name, value in vars(numba.config).items() if name.isupper() and value is not None)


for one in (generators, parallel, object_mode, lifted_loops, containers, named_tuples, vectorized, classes,
            array_expressions, strings, machine_code, options):
    print(one.__name__, repr(one()))
'''


@pytest.mark.long
def test_what_others_compile_does_not_depend_on_dynsim(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    alone, imported, compiled = (
        subprocess.run(
            [sys.executable, program, how],
            capture_output=True, text=True, check=True, timeout=300, env=environment,
        ).stdout.splitlines()
        for how in ("alone", "imported", "compiled")
    )  # fmt: skip
    assert len(alone) == 12
    assert imported == alone
    assert compiled == alone
    assert list(tmp_path.rglob("*.kernel"))


@jit.kernel
def _cannot_be_compiled(x):  # type: ignore[no-untyped-def]
    return x.nothing


def test_what_is_replaced_is_put_back_when_a_kernel_cannot_be_compiled() -> None:
    before = BaseFunction.get_call_type, ir.Inst._rec_list_vars
    with pytest.raises(numba.TypingError):
        _cannot_be_compiled(1.0)
    assert before == (BaseFunction.get_call_type, ir.Inst._rec_list_vars)
    assert all(function.__module__.startswith("numba.") for function in before)


NAME = "numba.core.codegen:CPUCodeLibrary.finalize"


@pytest.mark.parametrize("change", ["another source", "missing"])
def test_kernels_are_not_compiled_by_another_numba(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    name = NAME if change == "another source" else f"{NAME}_all"
    monkeypatch.setitem(numba_version.REPLACED, name, "0" * 32)
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)
    numba_version.check_sources.cache_clear()

    @jit.kernel
    def double(x):  # type: ignore[no-untyped-def]
        return 2 * x

    with raises(ImportError, f"numba {numba.__version__}", "0.68.1", name, 'pip install "numba==0.68.1"'):
        double(3)
    monkeypatch.undo()
    numba_version.check_sources()


def test_another_minor_version_of_numba_is_refused_before_its_internals_are_imported() -> None:
    code = """
import sys, numba
numba.__version__ = "0.69.0"
sys.modules["numba.core.types.functions"] = None  # gone
import dynsim.jit.kernel
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    check_message(done.stderr.splitlines()[-1], "ImportError", "0.69.0", "0.68.1", 'pip install "numba==0.68.1"')
