"""Base of every part of a scenario: strict about keys, frozen after validation."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class StrictConfig(BaseModel):
    """A mapping of a scenario file; unknown keys are errors, numbers must be finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)


def unit_vector(values: list[float], name: str) -> NDArray[np.float64]:
    """``values`` scaled to length one; ValueError when it has none."""
    array = np.array(values, dtype=np.float64)
    length = float(np.linalg.norm(array))
    if length < 1e-12:
        raise ValueError(f"{name} has no direction (length zero)")
    return array / length
