"""Memoisation of results that runs of a sweep share, keyed by the bits of their inputs."""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar, cast

import numpy as np
from pydantic import BaseModel

T = TypeVar("T")

# Number of results of each kind that are kept: few, as successive runs of a sweep share most inputs.
KEPT = 4


class Memo:
    """Results of pure functions, each found by the inputs from which it was computed.

    Numbers, texts and arrays are the same where their bits are (−0.0 is not 0.0, 1 is not 1.0), and so are tuples,
    lists, dicts and configurations of such; anything else only where it is the same object, which must not be changed.
    Whoever takes a result must not change it either. A function that raises is called again next time.
    """

    def __init__(self) -> None:
        self._kept: dict[str, OrderedDict[Hashable, tuple[Any, Any]]] = {}

    def recall(self, kind: str, make: Callable[[], T], *inputs: Any) -> T:
        """See :func:`recall`."""
        kept, key = self._kept.setdefault(kind, OrderedDict()), _bits(inputs)
        if key in kept:
            kept.move_to_end(key)
            return cast(T, kept[key][1])
        result = make()
        # With the inputs, so that no other object gets the identity of one that is gone.
        kept[key] = inputs, result
        if len(kept) > KEPT:
            kept.popitem(last=False)
        return result


_current: ContextVar[Memo | None] = ContextVar("memo", default=None)


@contextmanager
def remembering(memo: Memo | None = None) -> Iterator[None]:
    """Within: :func:`recall` goes by this memo; by default by the one around, or a new one where there is none."""
    token = _current.set(memo or _current.get() or Memo())
    try:
        yield
    finally:
        _current.reset(token)


def recall(kind: str, make: Callable[[], T], *inputs: Any) -> T:
    """What ``make`` gives, or gave within the same :func:`remembering` for the same inputs.

    Parameters
    ----------
    kind : of the result; each keeps the last :data:`KEPT`
    inputs : all that the result depends on
    """
    memo = _current.get()
    return make() if memo is None else memo.recall(kind, make, *inputs)


def _bits(value: Any) -> Hashable:
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
        # Some say an error of what is set to its default, and none of what is left out.
        return kind, frozenset(value.model_fields_set), _bits(value.__dict__), _bits(value.__pydantic_private__)
    return kind, id(value)
