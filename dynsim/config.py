"""Base of every part of a scenario: strict about keys, frozen after validation."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class StrictConfig(BaseModel):
    """A mapping of a scenario file; unknown keys are errors, numbers must be finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)


class BodyPoint(StrictConfig):
    """A point fixed on a body."""

    body: str = Field(description="name of the body, or of a frame fixed on one")
    point_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="in that body's or frame's axes, from its origin")


def error_at(key: str, message: str) -> PydanticCustomError:
    """An error for a validator of a whole mapping to raise about one dotted ``key`` within it."""
    return PydanticCustomError("value_error", "{message}", {"message": message, "key": key})


def unit_vector(values: list[float], name: str) -> NDArray[np.float64]:
    """``values`` scaled to length one; ValueError when it has none."""
    array = np.array(values, dtype=np.float64)
    length = float(np.linalg.norm(array))
    if length < 1e-12:
        raise ValueError(f"{name} has no direction (length zero)")
    return array / length
