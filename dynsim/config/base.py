"""Base classes for configurations in scenarios and servo maps; types and checks for numbers, vectors and waypoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    SerializerFunctionWrapHandler,
    model_serializer,
)
from pydantic_core import PydanticCustomError

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Lengths = Annotated[list[Positive], Field(min_length=3, max_length=3)]


def default(value: Any, description: str, **limits: Any) -> Any:
    """Return the field of a key that may be omitted: its default value, description and limits."""
    return Field(value, description=description, **limits)


def _nonzero(vector: list[float]) -> list[float]:
    if np.linalg.norm(vector) < 1e-12:
        raise ValueError("must not be the zero vector")
    return vector


def _ordered(limits: list[float]) -> list[float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"the lower limit {limits[0]:g} must be below the upper limit {limits[1]:g}")
    return limits


Direction = Annotated[Vector3, AfterValidator(_nonzero)]
Limits = Annotated[Pair, AfterValidator(_ordered)]


def _forbid_conversion(schema: Any) -> None:
    """Make all numbers of a pydantic core schema strict.

    Otherwise ``true`` would be read as 1 and the string "1_9.2" as 19.2. Keys are strings and are not changed.
    """
    if isinstance(schema, dict):
        if schema.get("type") in ("float", "int"):
            schema["strict"] = True
        for name, part in schema.items():
            if name not in ("keys_schema", "metadata", "default"):
                _forbid_conversion(part)
    elif isinstance(schema, (list, tuple)):
        for part in schema:
            _forbid_conversion(part)


class StrictModel(BaseModel):
    """Base class for mappings in files: unknown keys are errors; strings and Booleans are not accepted as numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> Any:
        schema = handler(source)
        _forbid_conversion(schema)
        return schema


class StrictConfig(StrictModel):
    """Base class for mappings in scenario files: as :class:`StrictModel`, but numbers must also be finite."""

    model_config = ConfigDict(allow_inf_nan=False, validate_default=True, defer_build=True)

    @model_serializer(mode="wrap")
    def _with_nulls(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Keep None with ``exclude_none`` too if it is not the default."""
        written: dict[str, Any] = dump(self)
        for key, member in type(self).model_fields.items():
            if member.default is not None and getattr(self, key) is None and not member.exclude:
                written[key] = None
        return written


class BodyPoint(StrictConfig):
    """Point fixed to a body."""

    body: str = Field(description="name of the body, or of a frame fixed to a body")
    point_m: Vector3 = default([0.0, 0.0, 0.0], "coordinates in the axes of the body or frame")


class SurfaceConfig(StrictConfig):
    """Surface that contact points can touch."""

    on: str | None = default(
        None, "body that carries the surface, which is then described in the axes of this body; default: the world"
    )


def error_at(key: str, message: str) -> PydanticCustomError:
    """Return an error about one dotted ``key``, to be raised by a validator that checks a whole mapping."""
    return PydanticCustomError("value_error", "{message}", {"message": message, "key": key})


def check_waypoints(times: Sequence[float], values: Sequence[Any], key: str) -> None:
    """Check that waypoints have one value per time, and that their times increase.

    Parameters
    ----------
    times : sequence of float
        Times of the waypoints [s].
    values : sequence
        Values of the waypoints.
    key : str
        Key of the values in the file, for the error message.

    Raises
    ------
    ValueError
        If there are more times than values or vice versa, or the times do not increase.
    """
    if len(times) != len(values):
        raise ValueError(f"{len(times)} times_s and {len(values)} {key}: both lists must have the same length")
    if np.any(np.diff(times) <= 0.0):
        raise ValueError("times_s must increase")


def unit_vector(values: list[float], name: str) -> NDArray[np.float64]:
    """Return the vector ``values`` scaled to length one; raise ValueError if it is the zero vector."""
    array = np.array(values, dtype=np.float64)
    length = float(np.linalg.norm(array))
    if length < 1e-12:
        raise ValueError(f"{name} must not be the zero vector")
    return array / length
