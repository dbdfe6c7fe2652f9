"""Replacement of the kernels' reals by N lanes, in plain Python, to find state-dependent branches (for test_lanes).

``Lanes`` are N doubles, one for each of N states; N is 4 in the compiled kernels. A comparison gives N booleans. An
``if`` on such a comparison is recorded with its line, since SIMD code has no such branch; lanes that disagree raise
``Divergent``. Constants of the model become ``Constant``, which records where a real is taken for an integer; integers
stay integers.
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
    """A line of the kernels by its text."""

    file: str
    function: str
    text: str


class Line(NamedTuple):
    """A line of the kernels by its number."""

    path: str
    function: str
    number: int

    def location(self) -> Place:
        """Its text, which stays when lines before it come and go."""
        text = linecache.getline(self.path, self.number).strip()
        return Place(Path(self.path).relative_to(KERNELS).as_posix(), self.function, text)


class Divergent(Exception):
    """Lanes took different branches."""

    def __init__(self, location: Place) -> None:
        super().__init__(str(location))
        self.place = location


class Notes:
    """What runs have noted: places that asked lanes, and that took a constant real for an integer; lines that ran."""

    def __init__(self) -> None:
        self.asked: set[Place] = set()
        self.kinds: set[Place] = set()
        self.lines: set[Line] = set()


_notes = Notes()


@contextmanager
def noted() -> Iterator[Notes]:
    """Notes of what runs inside."""
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
    """The value of all lanes, for a place that can do with one only."""
    location = _place()
    _notes.asked.add(location)
    if any(value != values[0] for value in values):
        raise Divergent(location)
    return values[0]


class Mask:
    """One truth for each lane."""

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
    """N doubles. No index, no dictionary key, no float: those would need one number."""

    __array_ufunc__ = None  # numpy's numbers leave operators to this class
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
    """Lanes of a where the mask is true, of b elsewhere."""
    if not isinstance(mask, Mask):
        return a if mask else b
    count = len(mask.values)
    return Lanes(x if m else y for m, x, y in zip(mask.values, _values(a, count), _values(b, count), strict=True))


class Constant(np.float64):
    """A real of the model; compared with an integer, or made one, it is taken for what it is not."""

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
    """The function for lanes and for numbers."""

    def apply(*arguments: Any) -> Any:
        if any(isinstance(x, Lanes) for x in arguments):
            return Lanes(_lane_by_lane(function, *arguments))
        return function(*arguments)

    return apply


# All that the right-hand side may take from its libraries. Roots of numbers are numpy's: NaN, not an error.
MATH = SimpleNamespace(sqrt=_spread(np.sqrt), nan=np.nan, inf=np.inf, pi=np.pi)
NUMPY = SimpleNamespace(rint=_spread(np.rint), floor=_spread(np.floor))


def plain(function: Any) -> FunctionType:
    """The source of a kernel, compiled or not."""
    return getattr(function, "py_func", function)


def reached(root: Any, without: Sequence[Any] = ()) -> list[FunctionType]:
    """The function and all kernels that it calls, directly or not, and not through one of ``without`` alone."""
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
    """Lines that can run, without the head of the function."""
    code = function.__code__
    numbers = {number for _, _, number in code.co_lines() if number is not None}
    source = linecache.getlines(code.co_filename)
    body = next(k for k in range(code.co_firstlineno, len(source)) if source[k - 1].startswith("def "))
    return {Line(code.co_filename, code.co_name, number) for number in numbers if number > body}


def patch(monkeypatch: pytest.MonkeyPatch, root: Any, **replaced: Callable[..., Any]) -> None:
    """Let the modules of all that ``root`` reaches run as Python, with lanes; ``replaced``: kernels by name."""
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
    """The tables of a named tuple, however nested, by their kind."""
    if isinstance(value, tuple):
        return type(value)(*(mapped(part, real, integer) for part in value))
    if isinstance(value, np.ndarray):
        return real(value) if value.dtype == np.float64 else integer(value)
    return value


def objects(table: np.ndarray, make: Callable[[Any], Any]) -> np.ndarray:
    """A table of objects, made of each number."""
    result = np.empty(table.shape, dtype=object)
    for index in np.ndindex(table.shape):
        result[index] = make(table[index])
    return result


def constants(tables: Any) -> Any:
    """A named tuple of the model, for runs with lanes."""
    return mapped(tables, lambda table: objects(table, Constant), lambda table: objects(table, int))


def copies(tables: Any) -> Any:
    """A named tuple of tables of its own."""
    return mapped(tables, np.copy, np.copy)


def in_lanes(tables: Any, count: int) -> Any:
    """A named tuple of what is written, all reals with so many equal lanes."""
    return mapped(
        tables, lambda table: objects(table, lambda x: Lanes((x,) * count)), lambda table: objects(table, int)
    )


def stacked(states: list[np.ndarray]) -> np.ndarray:
    """Vectors as one vector of lanes."""
    result = np.empty(states[0].shape, dtype=object)
    for k in range(len(result)):
        result[k] = Lanes(state[k] for state in states)
    return result


def lane(table: np.ndarray, k: int) -> np.ndarray:
    """Lane k of a table."""
    return np.array([x.values[k] if isinstance(x, Lanes) else x for x in table.flat], dtype=float).reshape(table.shape)
