"""Errors of public functions that name the argument of a wrong type."""

from __future__ import annotations

import functools
import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, TypeVar

from dynsim.errors import DynsimError, brief

Function = TypeVar("Function", bound=Callable[..., Any])


def names_wrong_types(function: Function) -> Function:
    """Decorate a function so that a wrong type of an argument raises a TypeError that names the argument.

    Of a class, all public methods and the constructor are decorated.

    The types are compared with the annotations only after the function has failed with an error that is not a
    :class:`DynsimError`, so that calls without errors cost nothing.

    Examples
    --------
    >>> @names_wrong_types
    ... def double(number: float) -> float:
    ...     return 2.0 * number
    >>> double("3")
    Traceback (most recent call last):
    TypeError: double: number = '3': must be float
    """
    if inspect.isclass(function):
        for name, method in list(vars(function).items()):
            if name == "__init__" or not name.startswith("_"):
                if inspect.isfunction(method):
                    setattr(function, name, names_wrong_types(method))
                elif isinstance(method, classmethod):
                    setattr(function, name, classmethod(names_wrong_types(method.__func__)))
        return function

    @functools.wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except DynsimError:
            raise
        except Exception as error:
            if wrong := _wrong_argument(function, arguments, named):
                raise TypeError(wrong) from error
            raise

    return typing.cast(Function, checked)


def _wrong_argument(function: Callable[..., Any], arguments: tuple[Any, ...], named: Mapping[str, Any]) -> str:
    """Return the message about the first argument whose type does not match its annotation, or ""."""
    try:
        bound = inspect.signature(function).bind(*arguments, **named)
    except TypeError:
        return ""
    for name, value in bound.arguments.items():
        annotation = function.__annotations__.get(name)
        if annotation is not None and not _matches(value, annotation, function):
            return f"{function.__qualname__.removesuffix('.__init__')}: {name} = {brief(value)}: must be {annotation}"
    return ""


def _matches(value: Any, annotation: Any, function: Callable[..., Any]) -> bool:
    """Return False if a value certainly does not match an annotation, which may be a text."""
    if "Array" in str(annotation):
        import numpy as np

        try:
            np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            return False
        return value is not None
    try:
        hint = eval(annotation, function.__globals__) if isinstance(annotation, str) else annotation
    except (NameError, TypeError):  # a name that is imported for type checks only
        return True
    return _fits(value, hint)


def _fits(value: Any, hint: Any) -> bool:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is typing.Literal:
        return isinstance(value, str | int) and value in parts
    if hint is float:
        return isinstance(value, Real) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, Integral) and not isinstance(value, bool)
    if hint is None:
        return value is None
    if getattr(hint, "_is_protocol", False) or (origin or hint) is Callable:
        return callable(value)
    if not inspect.isclass(origin or hint):
        return True
    if not isinstance(value, origin or hint) or (isinstance(value, str) and hint is not str):
        return False
    elements = parts[:1] if isinstance(value, Sequence) and not isinstance(value, str) else ()
    return all(_fits(item, part) for part in elements for item in value)
