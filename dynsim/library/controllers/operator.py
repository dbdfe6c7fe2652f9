"""Configuration of an operator: timed velocities of the hand and of the mobile base, ticks, rate limits, braces."""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.references.teleop import BASE, HAND, VELOCITIES, VelocityScript
from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3

BaseVelocity = Annotated[list[float], Field(min_length=2, max_length=2)]


class Velocity(StrictConfig):
    """One entry of the operator's list; what it does not name stays as it was."""

    at_s: NonNegative
    hand: Vector3 | None = Field(
        default=None, description="x, y, z [m/s], in axes of the world; on a mobile base in those of the base"
    )
    base: BaseVelocity | None = Field(default=None, description="ahead [m/s], to the left [rad/s]")


class OperatorConfig(StrictConfig):
    """References that follow velocities, rewritten at every tick; the commands may come from a live operator."""

    rate_hz: Positive = Field(default=100.0, description="ticks, at which references are rewritten")
    joints: list[str] = Field(default=[], description="joints that follow the hand's velocity; the others hold")
    braces: list[str] = Field(default=[], description="contact points that the joints keep on their surfaces meanwhile")
    rate_limit_rad_s: Positive = Field(
        default=2.0, description="fastest joint rate, m/s of a prismatic joint: a hand that needs more is slower"
    )
    acceleration_limit_rad_s2: Positive = Field(
        default=10.0, description="in which joint rates change, m/s² of a prismatic joint: it ends a way to the edge"
    )
    hand_acceleration_m_s2: Positive = Field(default=0.5, description="in which velocities of the hand change")
    base_acceleration_m_s2: Positive = Field(default=0.5, description="of the base ahead; more may tip it")
    base_acceleration_rad_s2: Positive = Field(default=2.0, description="of its turns")
    tolerance_m: Positive = Field(default=1e-6, description="a target further off than this is unreachable: it waits")
    commands: list[Velocity] = Field(default=[], description="held until the next one")

    @model_validator(mode="after")
    def _check(self) -> Self:
        times = [command.at_s for command in self.commands]
        if times != sorted(times):
            raise ValueError("commands must be in the order of their at_s")
        if not self.joints and any(command.hand is not None for command in self.commands):
            raise ValueError("commands of the hand need joints that follow them")
        return self

    def script(self) -> VelocityScript:
        """The commands; each takes effect at the first tick at or after its time."""
        velocity, current = np.zeros((len(self.commands), VELOCITIES)), np.zeros(VELOCITIES)
        for row, command in zip(velocity, self.commands, strict=True):
            for part, values in ((HAND, command.hand), (BASE, command.base)):
                if values is not None:
                    current[part] = values
            row[:] = current
        ticks = [math.ceil(command.at_s * self.rate_hz - 1e-6) for command in self.commands]
        return VelocityScript(np.array(ticks, dtype=np.int64), velocity)
