"""Configuration of an operator: timed velocities of the hand and mobile base, tick rate, rate limits and braces."""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from dynsim.compile.references.teleop import BASE, HAND, VELOCITIES, VelocityScript
from dynsim.config.base import NonNegative, Pair, Positive, StrictConfig, Vector3, default


class Velocity(StrictConfig):
    """Velocity command of an operator; omitted velocities remain unchanged."""

    at_s: NonNegative = Field(description="time of the command")
    hand: Vector3 | None = default(
        None,
        "hand velocity x, y, z [m/s] in world axes, or on a mobile base in the axes of the base; default: unchanged",
    )
    base: Pair | None = default(
        None, "base velocity: forward [m/s] and turning to the left [rad/s]; default: unchanged"
    )


class OperatorConfig(StrictConfig):
    """References that follow velocity commands from a scenario or a live operator, and are updated at every tick."""

    rate_hz: Positive = default(100.0, "tick rate, at which the references are updated")
    joints: list[str] = default([], "joints that follow the hand velocity; the other joints hold")
    braces: list[str] = default([], "contact points that the joints keep on their surfaces")
    rate_limit_rad_s: Positive = default(
        2.0, "maximum joint rate (m/s at a prismatic joint); it slows the hand down if necessary"
    )
    acceleration_limit_rad_s2: Positive = default(
        10.0,
        "maximum joint acceleration (m/s² at a prismatic joint); limits how fast a joint stops at the "
        "edge of the workspace",
    )
    hand_acceleration_m_s2: Positive = default(0.5, "acceleration of the hand")
    base_acceleration_m_s2: Positive = default(0.5, "forward acceleration of the base; larger values may tip it")
    base_acceleration_rad_s2: Positive = default(2.0, "angular acceleration of the base")
    tolerance_m: Positive = default(1e-6, "maximum position error; the target waits if it would be exceeded")
    commands: list[Velocity] = default([], "velocity commands, each held until the next")

    @model_validator(mode="after")
    def _check(self) -> Self:
        times = [command.at_s for command in self.commands]
        if times != sorted(times):
            raise ValueError("commands must be sorted by at_s")
        if not self.joints and any(command.hand is not None for command in self.commands):
            raise ValueError("commands for the hand require joints; list the joints that follow")
        return self

    def script(self) -> VelocityScript:
        """Return the commands; each takes effect at the first tick at or after its time."""
        velocity, current = np.zeros((len(self.commands), VELOCITIES)), np.zeros(VELOCITIES)
        for row, command in zip(velocity, self.commands, strict=True):
            for part, values in ((HAND, command.hand), (BASE, command.base)):
                if values is not None:
                    current[part] = values
            row[:] = current
        ticks = [math.ceil(command.at_s * self.rate_hz - 1e-6) for command in self.commands]
        return VelocityScript(np.array(ticks, dtype=np.int64), velocity)
