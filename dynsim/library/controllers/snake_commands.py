"""Target motion of the snake: an operator's velocity commands and generated paths ([T] IV.C).

A script is a :class:`dynsim.snake.description.CommandSource` with all commands known in advance, unlike a joystick.
The script of a live operator is replayed tick by tick, as recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from dynsim.config.base import NonNegative, Positive, StrictConfig, default
from dynsim.config.problems import suggest
from dynsim.model.description import Array
from dynsim.snake.description import FIXING, SWITCHING, CommandBlock, Feedback

Coordinates = tuple[float, float, float, float, float, float]
Profile = Literal["linear", "smooth"]

STATES = {"switching": SWITCHING, "fixing": FIXING}


class SnakeCommand(StrictConfig):
    """Command of an operator; omitted values remain unchanged."""

    at_s: NonNegative = Field(description="time of the command")
    velocity: Coordinates | None = default(
        None, "rates of x, y, z [m/s] and alpha, beta, gamma [rad/s], held until the next command; default: unchanged"
    )
    mode: int | Literal["switching", "fixing"] | None = default(
        None, "number of a mode to fix, or `switching` or `fixing` to enter that state; default: unchanged"
    )
    gripper: Literal["open", "closed"] | None = default(None, "gripper command; default: unchanged")

    @field_validator("mode", mode="before")
    @classmethod
    def _state_or_number(cls, value: Any) -> Any:
        """Accept a state or an integer; the controller checks that its mode table contains the number."""
        text = value if isinstance(value, str) else ""
        if value is None or text in STATES or (isinstance(value, int) and not isinstance(value, bool)):
            return value
        raise ValueError(f"unknown mode{suggest(text, STATES)} (choices: {', '.join(STATES)}, or the number of a mode)")


class TargetMotion(StrictConfig):
    """Motion of the target with a start, a duration and a profile in time."""

    start_s: NonNegative = default(0.0, "start time of the motion")
    duration_s: Positive = Field(description="duration of the motion")
    profile: Profile = default("smooth", "progress in time: `linear`, or `smooth` (minimum jerk, from rest to rest)")


class Ramp(TargetMotion):
    """Displacement of the target along a straight line in its six coordinates."""

    type: Literal["ramp"]
    displacement: Coordinates = Field(description="displacement in x, y, z [m] and alpha, beta, gamma [rad]")
    profile: Profile = default("linear", "progress in time: `linear`, or `smooth` (minimum jerk, from rest to rest)")

    def offset(self, s: Array) -> Array:
        """Return the displacement at progress s in [0, 1], shape (T, 6)."""
        return s[:, None] * np.array(self.displacement)


class Circle(TargetMotion):
    """Circular motion of the target in the horizontal xy plane, starting along +x, or in the vertical yz plane."""

    type: Literal["circle"]
    radius_m: Positive = Field(description="radius")
    turns: float = default(
        1.0, "number of turns; plane xy: positive to the left; plane yz: starts at the top, positive first to the left"
    )
    plane: Literal["xy", "yz"] = default("xy", "plane of the circle")
    backward: bool = default(False, "plane xy: move backward from the start point")
    turn_head: bool = default(True, "plane xy: the yaw angle follows the tangent")

    def offset(self, s: Array) -> Array:
        """Return the displacement at progress s in [0, 1], shape (T, 6)."""
        angle = 2.0 * np.pi * self.turns * s
        out = np.zeros((len(s), 6))
        if self.plane == "yz":
            out[:, 1] = self.radius_m * np.sin(angle)
            out[:, 2] = self.radius_m * (np.cos(angle) - 1.0)
            return out
        sense = -1.0 if self.backward else 1.0
        out[:, 0] = sense * self.radius_m * np.sin(np.abs(angle))
        out[:, 1] = self.radius_m * np.sign(self.turns) * (1.0 - np.cos(angle))
        if self.turn_head:
            out[:, 5] = sense * angle
        return out


class DoorArc(TargetMotion):
    """Arc of a door knob about the hinge; the yaw stays perpendicular to the door ([T] V.D.3).

    The robot faces the door along +x; the hinge is `radius_m` to the left or right of the target's start.
    """

    type: Literal["door_arc"]
    radius_m: Positive = Field(description="distance from hinge to knob")
    angle_deg: Annotated[float, Field(gt=0, le=180)] = default(60.0, "opening angle of the door")
    hinge: Literal["left", "right"] = default("left", "side of the hinge")
    opening: Literal["pull", "push"] = default("pull", "direction in which the door opens")

    def offset(self, s: Array) -> Array:
        """Return the displacement at progress s in [0, 1], shape (T, 6)."""
        angle = np.deg2rad(self.angle_deg) * s
        left = 1.0 if self.hinge == "left" else -1.0
        away = 1.0 if self.opening == "push" else -1.0
        out = np.zeros((len(s), 6))
        out[:, 0] = away * self.radius_m * np.sin(angle)
        out[:, 1] = left * self.radius_m * (1.0 - np.cos(angle))
        out[:, 5] = left * away * angle
        return out


Path = Annotated[Ramp | Circle | DoorArc, Field(discriminator="type")]


class Script(StrictConfig):
    """Operator commands and target paths of a scenario; their velocities are added."""

    commands: list[SnakeCommand] = Field(default_factory=list, description="operator commands, sorted by time")
    paths: list[Path] = Field(default_factory=list, description="target paths, added to the commands")

    @model_validator(mode="after")
    def _in_order(self) -> Script:
        times = [command.at_s for command in self.commands]
        if times != sorted(times):
            raise ValueError("commands must be sorted by at_s")
        return self


@dataclass(frozen=True)
class ScriptedSource:
    """Command source with all commands known in advance."""

    commands: Sequence[SnakeCommand]
    paths: Sequence[Ramp | Circle | DoorArc]

    def read(self, first: int, count: int, period: float, feedback: Feedback | None = None) -> CommandBlock:
        """Return the commands of periods ``first`` to ``first + count - 1``; ``feedback`` is ignored.

        A command takes effect at the first period that begins at or after its time.
        """
        ticks = first + np.arange(count + 1)
        block = CommandBlock(np.zeros((count, 6)), np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64))
        for path in self.paths:
            s = np.clip((ticks * period - path.start_s) / path.duration_s, 0.0, 1.0)
            if path.profile == "smooth":
                s = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
            # With the mean rate of each period, the integrated target is exact at every tick.
            block.velocity[...] += np.diff(path.offset(s), axis=0) / period
        lasting, gripper = np.zeros(6), 0
        pieces = []
        for command in self.commands:
            tick = int(np.ceil(command.at_s / period - 1e-9))
            lasting = lasting if command.velocity is None else np.array(command.velocity)
            gripper = gripper if command.gripper is None else int(command.gripper == "closed")
            pieces.append((tick, lasting, gripper))
            if command.mode is not None and 0 <= tick - first < count:
                block.request[tick - first] = STATES[command.mode] if isinstance(command.mode, str) else command.mode
        for i, (tick, velocity, closed) in enumerate(pieces):
            end = pieces[i + 1][0] if i + 1 < len(pieces) else first + count
            part = slice(max(tick - first, 0), max(end - first, 0))
            block.velocity[part] += velocity
            block.gripper[part] = closed
        return block


@dataclass
class TimedScript:
    """Script that is read one period at a time, as from a live operator, so that its commands keep their times."""

    script: ScriptedSource
    _all: CommandBlock | None = None

    def read(self, first: int, count: int, period: float, feedback: Feedback | None = None) -> CommandBlock:
        """Return the commands of period ``first``."""
        if self._all is None:
            self._all = self.script.read(0, first + count, period)
        here = slice(first, first + 1)
        return CommandBlock(self._all.velocity[here], self._all.request[here], self._all.gripper[here])
