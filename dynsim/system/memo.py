"""Memoisation of results that are shared by the runs of a sweep; inputs are compared bit by bit."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

T = TypeVar("T")

# Number of results kept for each kind; a few suffice, because successive runs of a sweep share most inputs.
KEPT = 4


class Memo:
    """Cache for results of pure functions, indexed by the inputs from which they were computed.

    Numbers, strings and arrays are equal if their bits are equal (−0.0 is not 0.0, 1 is not 1.0), and so are tuples,
    lists, dicts and configurations that contain them; any other object equals only itself and must not be changed.
    Callers must not change a result either. If a function raises an exception, it is called again the next time.
    """

    def __init__(self) -> None:
        # Bits of the inputs, inputs and result of each call, the last one first.
        self._kept: dict[str, list[tuple[Any, Any, Any]]] = {}

    def recall(self, kind: str, make: Callable[[], T], *inputs: Any) -> T:
        """Return the result for the given inputs, as described for the function :func:`recall`."""
        kept, bits = self._kept.setdefault(kind, []), _bits(inputs)
        # A few comparisons take less time than hashes, which Python computes again at each access.
        k = next((k for k, entry in enumerate(kept) if entry[0] == bits), None)
        # Keep the inputs too, so that no other object can reuse the identity of a deleted one.
        entry = (bits, inputs, make()) if k is None else kept.pop(k)
        kept.insert(0, entry)
        del kept[KEPT:]
        result: T = entry[2]
        return result


_current: ContextVar[Memo | None] = ContextVar("memo", default=None)


@contextmanager
def remembering(memo: Memo | None = None) -> Iterator[None]:
    """Use a memo for calls of :func:`recall` within the block; default: the memo of the outer block, or a new one."""
    token = _current.set(memo or _current.get() or Memo())
    try:
        yield
    finally:
        _current.reset(token)


def recall(kind: str, make: Callable[[], T], *inputs: Any) -> T:
    """Return the result of ``make``, or the stored result if it was called before with equal inputs.

    Results are stored only within a :func:`remembering` block.

    Parameters
    ----------
    kind : str
        Kind of result; the last :data:`KEPT` results of each kind are kept.
    make : callable
        Function that computes the result.
    inputs : Any
        Everything that the result depends on.
    """
    memo = _current.get()
    return make() if memo is None else memo.recall(kind, make, *inputs)


def _bits(value: Any) -> Any:
    kind = type(value)
    if kind is np.ndarray:
        if value.dtype == object:
            return kind, id(value)
        return value.shape, value.dtype.str, value.tobytes()
    if kind is float:
        return kind, struct.pack("d", value)
    if kind is list or isinstance(value, tuple):
        return kind, tuple(map(_bits, value))
    if kind is dict:
        return kind, tuple((name, _bits(entry)) for name, entry in value.items())
    if value is None or kind in (int, bool, str, bytes):
        return kind, value
    if isinstance(value, BaseModel):
        # Some configurations reject a key that is set to its default value but accept it if it is omitted.
        return kind, frozenset(value.model_fields_set), _bits(value.__dict__), _bits(value.__pydantic_private__)
    return kind, id(value)
