"""Replacement of the kernels' reals by N lanes, in plain Python, to find state-dependent branches (for test_lanes).

``Lanes`` are N doubles, one for each of N states; N is 4 in the compiled kernels. A comparison gives N booleans. An
``if`` on such a comparison is recorded with its line, since SIMD code has no such branch; lanes that disagree raise
``Divergent``. Constants of the model become ``Constant``, which records uses of a real as an integer; integers remain
integers.
"""

from __future__ import annotations

import builtins
import importlib
import linecache
import operator
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from inspect import isfunction
from pathlib import Path
from types import CodeType, FrameType, FunctionType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import dynsim.dynamics

KERNELS = str(Path(dynsim.dynamics.__file__).parent)


class Place(NamedTuple):
    """Line of the kernels, identified by its text."""

    file: str
    function: str
    text: str


class Line(NamedTuple):
    """Line of the kernels, identified by its number."""

    path: str
    function: str
    number: int

    def location(self) -> Place:
        """Text of the line, which is unchanged when preceding lines are added or removed."""
        text = linecache.getline(self.path, self.number).strip()
        return Place(Path(self.path).relative_to(KERNELS).as_posix(), self.function, text)


class Divergent(Exception):
    """Raised if lanes take different branches."""

    def __init__(self, location: Place) -> None:
        super().__init__(str(location))
        self.place = location


class Notes:
    """Notes of runs: places that branch on lanes, or use a constant real as an integer, and executed lines."""

    def __init__(self) -> None:
        self.asked: set[Place] = set()
        self.kinds: set[Place] = set()
        self.lines: set[Line] = set()


_notes = Notes()


@contextmanager
def noted() -> Iterator[Notes]:
    """Yield the notes of runs inside the block."""
    global _notes
    before, tracer = _notes, sys.gettrace()
    _notes = notes = Notes()

    def line(frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            notes.lines.add(_line(frame))
        return line

    def call(frame: FrameType, event: str, _: Any) -> Any:
        return line if frame.f_code.co_filename.startswith(KERNELS) else None

    sys.settrace(call)
    try:
        yield notes
    finally:
        sys.settrace(tracer)
        _notes = before


def _place() -> Place:
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and not frame.f_code.co_filename.startswith(KERNELS):
        frame = frame.f_back
    assert frame is not None, "lanes were asked outside the kernels"
    return _line(frame).location()


def _line(frame: FrameType) -> Line:
    return Line(frame.f_code.co_filename, frame.f_code.co_name, frame.f_lineno)


def _agreed(values: tuple) -> Any:
    """Return the common value of all lanes, for a place that can use only one."""
    location = _place()
    _notes.asked.add(location)
    if any(value != values[0] for value in values):
        raise Divergent(location)
    return values[0]


class Mask:
    """One boolean for each lane."""

    def __init__(self, values: tuple) -> None:
        self.values = values

    def __bool__(self) -> bool:
        return bool(_agreed(self.values))


def _values(x: Any, count: int) -> tuple:
    return x.values if isinstance(x, Lanes) else (x,) * count


def _lane_by_lane(function: Callable[..., Any], *arguments: Any) -> tuple:
    count = next(len(x.values) for x in arguments if isinstance(x, Lanes))
    return tuple(map(function, *(_values(x, count) for x in arguments)))


def _operator(function: Callable[..., Any], result: type, turned: bool = False) -> Callable[[Any, Any], Any]:
    def apply(self: Lanes, other: Any) -> Any:
        a, b = (other, self) if turned else (self, other)
        return result(_lane_by_lane(function, a, b))

    return apply


class Lanes:
    """N doubles; not an index, a dictionary key or a float, because these would need one number."""

    __array_ufunc__ = None  # numpy's scalars leave operators to this class
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, values: Any) -> None:
        self.values = tuple(np.float64(value) for value in values)

    def __neg__(self) -> Lanes:
        return Lanes(_lane_by_lane(operator.neg, self))

    def __abs__(self) -> Lanes:
        return Lanes(_lane_by_lane(operator.abs, self))

    def __bool__(self) -> bool:
        return bool(_agreed(tuple(value != 0.0 for value in self.values)))

    def __int__(self) -> int:
        return _agreed(tuple(int(value) for value in self.values))

    @property
    def real(self) -> Lanes:
        return self


for _name in ("add", "sub", "mul", "truediv", "pow"):
    setattr(Lanes, f"__{_name}__", _operator(getattr(operator, _name), Lanes))
    setattr(Lanes, f"__r{_name}__", _operator(getattr(operator, _name), Lanes, turned=True))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Lanes, f"__{_name}__", _operator(getattr(operator, _name), Mask))


def select(mask: Any, a: Any, b: Any) -> Any:
    """Return lanes of a where the mask is true, of b elsewhere."""
    if not isinstance(mask, Mask):
        return a if mask else b
    count = len(mask.values)
    return Lanes(x if m else y for m, x, y in zip(mask.values, _values(a, count), _values(b, count), strict=True))


class Constant(np.float64):
    """Real of the model; a comparison with an integer, or a conversion to one, is recorded as misuse."""

    __hash__ = np.float64.__hash__

    def __eq__(self, other: object) -> Any:
        self._taken(type(other) is int)
        return np.float64.__eq__(self, other)

    def __ne__(self, other: object) -> Any:
        self._taken(type(other) is int)
        return np.float64.__ne__(self, other)

    def __int__(self) -> int:
        self._taken(True)
        return np.float64.__int__(self)

    @staticmethod
    def _taken(for_an_integer: bool) -> None:
        if for_an_integer:
            _notes.kinds.add(_place())


def _spread(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function for lanes and for numbers."""

    def apply(*arguments: Any) -> Any:
        if any(isinstance(x, Lanes) for x in arguments):
            return Lanes(_lane_by_lane(function, *arguments))
        return function(*arguments)

    return apply


# All library functions that the right-hand side may use. Roots of numbers are numpy's: NaN, not an error.
MATH = SimpleNamespace(sqrt=_spread(np.sqrt), nan=np.nan, inf=np.inf, pi=np.pi)
NUMPY = SimpleNamespace(rint=_spread(np.rint), floor=_spread(np.floor))


def plain(function: Any) -> FunctionType:
    """Return the source of a kernel, compiled or not."""
    return getattr(function, "py_func", function)


def reached(root: Any, without: Sequence[Any] = ()) -> list[FunctionType]:
    """Return the function and all kernels that it calls, directly or not, other than only through ``without``."""
    left_out = {plain(function).__code__ for function in without}
    functions: dict[CodeType, FunctionType] = {}
    waiting = [plain(root)]
    while waiting:
        function = waiting.pop()
        if function.__code__ in functions or function.__code__ in left_out:
            continue
        functions[function.__code__] = function
        for name in function.__code__.co_names:
            called = plain(function.__globals__.get(name))
            if isfunction(called) and called.__code__.co_filename.startswith(KERNELS):
                waiting.append(called)
    return list(functions.values())


def lines(function: FunctionType) -> set[Line]:
    """Return the lines that can run, without the head of the function."""
    code = function.__code__
    numbers = {number for _, _, number in code.co_lines() if number is not None}
    source = linecache.getlines(code.co_filename)
    body = next(k for k in range(code.co_firstlineno, len(source)) if source[k - 1].startswith("def "))
    return {Line(code.co_filename, code.co_name, number) for number in numbers if number > body}


def patch(monkeypatch: pytest.MonkeyPatch, root: Any, **replaced: Callable[..., Any]) -> None:
    """Let the modules of all functions that ``root`` reaches run as Python with lanes; ``replaced``: kernels."""
    for name in sorted({function.__module__ for function in reached(root)}):
        module = importlib.import_module(name)
        for key, value in list(vars(module).items()):
            if hasattr(value, "py_func"):
                monkeypatch.setattr(module, key, value.py_func)
            if key in replaced:
                monkeypatch.setattr(module, key, replaced[key])
        for key, value in {"math": MATH, "np": NUMPY}.items():
            if key in vars(module):
                monkeypatch.setattr(module, key, value)
        for key in ("min", "max"):
            monkeypatch.setattr(module, key, _spread(getattr(builtins, key)), raising=False)


def mapped(value: Any, real: Callable[[np.ndarray], Any], integer: Callable[[np.ndarray], Any]) -> Any:
    """Convert the tables of a named tuple, however nested, by their kind."""
    if isinstance(value, tuple):
        return type(value)(*(mapped(part, real, integer) for part in value))
    if isinstance(value, np.ndarray):
        return real(value) if value.dtype == np.float64 else integer(value)
    return value


def objects(table: np.ndarray, make: Callable[[Any], Any]) -> np.ndarray:
    """Return a table of objects, one made from each number."""
    result = np.empty(table.shape, dtype=object)
    for index in np.ndindex(table.shape):
        result[index] = make(table[index])
    return result


def constants(tables: Any) -> Any:
    """Convert a named tuple of the model for runs with lanes."""
    return mapped(tables, lambda table: objects(table, Constant), lambda table: objects(table, int))


def copies(tables: Any) -> Any:
    """Return a named tuple with copies of its tables."""
    return mapped(tables, np.copy, np.copy)


def in_lanes(tables: Any, count: int) -> Any:
    """Convert a named tuple of written tables: all reals become ``count`` equal lanes."""
    return mapped(
        tables, lambda table: objects(table, lambda x: Lanes((x,) * count)), lambda table: objects(table, int)
    )


def stacked(states: list[np.ndarray]) -> np.ndarray:
    """Return vectors as one vector of lanes."""
    result = np.empty(states[0].shape, dtype=object)
    for k in range(len(result)):
        result[k] = Lanes(state[k] for state in states)
    return result


def lane(table: np.ndarray, k: int) -> np.ndarray:
    """Return lane k of a table."""
    return np.array([x.values[k] if isinstance(x, Lanes) else x for x in table.flat], dtype=float).reshape(table.shape)
