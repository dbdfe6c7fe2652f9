"""Base classes of configurations in scenarios and servo maps; types and checks of numbers, vectors and waypoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import PydanticCustomError

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


def _forbid_conversion(schema: Any) -> None:
    """Make the numbers of a pydantic core schema take numbers only.

    Otherwise ``true`` would be read as 1 and the text "1_9.2" as 19.2. Keys are texts and are not changed.
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
    """A mapping of a file: unknown keys are errors, and numbers are neither texts nor true."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> Any:
        schema = handler(source)
        _forbid_conversion(schema)
        return schema


class StrictConfig(StrictModel):
    """A mapping of a scenario file: numbers must be finite too."""

    model_config = ConfigDict(allow_inf_nan=False, validate_default=True, defer_build=True)


class BodyPoint(StrictConfig):
    """A point fixed on a body."""

    body: str = Field(description="name of the body, or of a frame fixed on one")
    point_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="in that body's or frame's axes, from its origin")


def error_at(key: str, message: str) -> PydanticCustomError:
    """An error for a validator of a whole mapping to raise about one dotted ``key`` within it."""
    return PydanticCustomError("value_error", "{message}", {"message": message, "key": key})


def check_waypoints(times: Sequence[float], values: Sequence[Any], key: str) -> None:
    """ValueError unless the times of waypoints increase and there are as many as values, which ``key`` names."""
    if len(times) != len(values):
        raise ValueError(f"{len(times)} times_s and {len(values)} {key}: there must be as many")
    if np.any(np.diff(times) <= 0.0):
        raise ValueError("times_s must increase")


def unit_vector(values: list[float], name: str) -> NDArray[np.float64]:
    """``values`` scaled to length one; ValueError when it has none."""
    array = np.array(values, dtype=np.float64)
    length = float(np.linalg.norm(array))
    if length < 1e-12:
        raise ValueError(f"{name} has no direction (length zero)")
    return array / length
