"""Mode table and mode switching of a scenario ([T] Table II, IV.C.5)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StrictInt

from dynsim.config.base import Positive, StrictConfig
from dynsim.snake.description import Policy

# [T] Table II: mode number -> lifted wheel pairs of the base part (pair 1 at its head).
TABLE_II: dict[int, list[int]] = {1: [3, 6], 2: [6, 7], 3: [5, 6], 4: [4, 5], 5: [3, 4], 6: [2, 3]}


class Switching(StrictConfig):
    """Switching state ([T] IV.C.5); it is entered by a command ``mode: switching``."""

    policy: Policy = Field("cyclic", description="fixed: never switch; cyclic: [T]'s order; predictive: lowest cost")
    order: list[StrictInt] = Field(
        [2, 3, 4, 5, 6], min_length=1, description="mode numbers, also the predictive candidates"
    )
    period_s: Positive = Field(1.0, description="Delta T [s]")
    least_margin_m: float = Field(0.0, description="a mode whose support margin is not above it counts as tipping")
    when_blocked: bool = Field(
        False,
        description="enter the switching state by itself when a command cannot be carried out, the target waiting",
    )
    release_fraction: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.6, description="when_blocked: go on when every base joint is within this part of its limit (assumed)"
    )
    prediction_step_s: Positive = Field(0.02, description="step of the predicted period (assumed)")
