"""Errors of public functions that name the argument of a wrong type."""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from dynsim.errors import DynsimError, brief

Function = TypeVar("Function", bound=Callable[..., Any])


def names_wrong_types(function: Function) -> Function:
    """Decorate a function so that a wrong type of an argument raises a TypeError that names the argument.

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
    import numpy as np
    from pydantic import ConfigDict, TypeAdapter, ValidationError
    from pydantic.errors import PydanticSchemaGenerationError, PydanticUndefinedAnnotation

    if "Array" in str(annotation):
        try:
            return np.asarray(value, dtype=np.float64).dtype == np.float64 and value is not None
        except (TypeError, ValueError):
            return "None" in str(annotation) and value is None
    try:
        hint = eval(annotation, function.__globals__) if isinstance(annotation, str) else annotation
        adapter = TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
    except (NameError, TypeError, PydanticSchemaGenerationError, PydanticUndefinedAnnotation):
        return True
    try:
        adapter.validate_python(value, strict=True)
    except ValidationError:
        return False
    return True
