"""Named tuples passed by reference to compiled code keep their contents."""

from __future__ import annotations

import pickle
import subprocess
import sys
from typing import NamedTuple

import numba
import numpy as np
import pytest

from dynsim.dynamics.tables import Workspace, workspace
from dynsim.jit.compiler import Tables
from dynsim.jit.kernel import internal_kernel, kernel


class Inner(NamedTuple):
    table: np.ndarray
    flag: bool
    number: complex


class Outer(NamedTuple):
    count: int
    flag: bool
    inner: Inner
    nothing: Inner | None
    pair: tuple[float, int]
    matrix: np.ndarray


class Elsewhere(NamedTuple):
    first: float
    second: int


Inner.__module__ = Outer.__module__ = "dynsim.dynamics.example"


@internal_kernel
def look(outer, table):
    """Every field, of tuples within tuples too."""
    total = outer.count + 10.0 * outer.pair[1] + outer.pair[0] + (100.0 if outer.flag else 0.0)
    if outer.nothing is None:
        total += 1e3
    if outer.inner.flag:
        total += 1e4
    return total + outer.inner.table[1] + outer.inner.number.imag + outer.matrix[1, 0] + table[0]


@internal_kernel
def changed(outer, table):
    """A tuple that compiled code makes, and gives back."""
    inner = Inner(table, not outer.inner.flag, outer.inner.number * 2.0)
    return Outer(outer.count + 1, not outer.flag, inner, outer.nothing, outer.pair, outer.matrix)


def example() -> Outer:
    inner = Inner(np.array([0.5, 0.25]), True, 1.0 + 0.125j)
    return Outer(3, False, inner, None, (0.75, 2), np.array([[0.0, 0.0], [7e5, 0.0]]))


@kernel
def noted(outer, table):
    return look(outer, table)


@kernel
def made_and_told(outer, table):
    """Two that live at once, the second made of the first."""
    first = changed(outer, table)
    second = changed(first, outer.inner.table)
    return look(first, table), look(second, table), look(outer, table)


@kernel
def given_back(outer, table):
    return changed(outer, table)


@kernel
def of_elsewhere(two):
    return two.first * two.second


def test_fields() -> None:
    table = np.array([0.0625, 8.0])
    assert noted(example(), table) == look(example(), table) == 3 + 20 + 0.75 + 1e3 + 1e4 + 0.25 + 0.125 + 7e5 + 0.0625


def test_tuples_that_are_made() -> None:
    table = np.array([0.0625, 8.0])
    first = changed(example(), table)
    second = changed(first, example().inner.table)
    assert made_and_told(example(), table) == tuple(look(outer, table) for outer in (first, second, example()))


@kernel
def kept(outer, table):
    """One of the turns of a loop, and two that change places in each."""
    chosen, last, other = outer, outer, changed(outer, table)
    for k in range(5):
        counted = Outer(k, False, outer.inner, outer.nothing, outer.pair, outer.matrix)
        if k == 1:
            chosen = counted
        last, other = other, last
        if k == 3:
            last = counted
    return chosen.count, last.count, other.count


def test_what_is_kept_stays_what_it_was() -> None:
    table = np.zeros(2)
    python = getattr(kept, "py_func", kept)
    assert kept(example(), table) == python(example(), table)
    assert kept(example(), table)[0] == 1


@pytest.mark.parametrize("upper", [0.0, 5.0])
def test_in_functions_that_count_references(upper: float) -> None:
    """numba looks into what a variable held before, which at first is nothing."""

    @numba.njit
    def chosen(outer, upper):
        if outer.pair[0] > upper:
            returned = Outer(1, True, outer.inner, outer.nothing, outer.pair, outer.matrix)
        else:
            returned = Outer(2, True, outer.inner, outer.nothing, outer.pair, outer.matrix)
        return returned.count, returned[0], returned[-1][1, 0]

    assert chosen(example(), upper) == ((1, 1, 7e5) if upper == 0.0 else (2, 2, 7e5))


def test_back_to_python() -> None:
    table = np.array([0.0625, 8.0])
    returned, wanted = given_back(example(), table), changed(example(), table)
    # From the cache it is a copy of the class, because pytest's modules cannot be imported by name.
    assert (type(returned).__name__, type(returned.inner).__name__) == ("Outer", "Inner")
    assert returned.inner.table is table
    assert (returned.count, returned.flag, returned.nothing, returned.pair) == (
        wanted.count,
        wanted.flag,
        None,
        wanted.pair,
    )
    assert returned.inner[1:] == wanted.inner[1:]


def test_writing_through_a_tuple_is_seen() -> None:
    """The block is constant, the tables that it leads to are not."""
    outer = example()
    add_up(outer, 5)
    assert outer.inner.table[0] == 0.5 + 1 + 2 + 3 + 4


@kernel
def add_up(outer, count):
    for k in range(count):
        outer.inner.table[0] += k


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="types of the compiler")
def test_types() -> None:
    kind = numba.typeof(example())
    assert isinstance(kind, Tables)
    assert isinstance(kind.types[2], Tables)
    assert kind == numba.typeof(example())
    other = numba.typeof(example()._replace(matrix=np.zeros(2)))
    assert kind != other
    assert str(kind) != str(other)
    assert not isinstance(numba.typeof(Elsewhere(1.0, 2)), Tables)
    assert of_elsewhere(Elsewhere(1.5, 2)) == 3.0


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="types of the compiler")
def test_a_type_kept_on_disk_is_found_in_another_process() -> None:
    """Its hash is that of the other process, or kernels were read from the cache in every call."""
    code = """
import pickle, sys, numba
import dynsim.jit.kernel
from dynsim.dynamics.tables import workspace
sys.stdout.buffer.write(pickle.dumps(numba.typeof(workspace(3, 3, 2))))
"""
    here = numba.typeof(workspace(3, 3, 2))
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    loaded = pickle.loads(there)
    assert here.instance_class is Workspace
    assert hash(loaded) == hash(here)
    assert {here: 1}[loaded] == 1
