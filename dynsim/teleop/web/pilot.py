"""Parsing of a pilot's messages: small JSON texts with known keys; others are refused with a reason."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from dynsim.snake.description import FIXING, NO_REQUEST, SWITCHING
from dynsim.teleop.snake import Command, PilotAxis

MOST_BYTES = 4096
"""Largest size of a message [bytes]; a longer one closes the connection."""
MOST_COUNT = 2**53
"""Largest integer that a browser represents exactly."""
STEPS = 100
"""Steps of the speeds up to full speed, so that noise of a joystick does not add entries to the script."""
REQUESTS = {"switching": SWITCHING, "fixing": FIXING}
ACTIONS = ("take", "leave", "end")


class Refused(ValueError):
    """A message that is not valid; the text gives the reason."""


@dataclass(frozen=True)
class PilotCommand:
    """The present command of the pilot.

    Attributes
    ----------
    count : of the browser's messages, rising; axes : in parts of full speed, −1 to 1
    held : the dead-man's key is held
    request : a mode to go to, ``NO_REQUEST`` for none; closed : the gripper
    """

    count: int
    axes: tuple[float, ...]
    held: bool
    request: int = NO_REQUEST
    closed: bool = False


def parse(text: str | bytes, axes: int, modes: tuple[int, ...]) -> PilotCommand | str:
    """A command, or one of ``ACTIONS``.

    Raises
    ------
    Refused
        With what is wrong.
    """
    if not isinstance(text, str):
        raise Refused("a binary message; texts are understood")
    try:
        message = json.loads(text, parse_constant=_no_number)
    except Refused:
        raise
    except (ValueError, RecursionError):
        raise Refused("no JSON") from None
    if not isinstance(message, dict):
        raise Refused("no JSON object")
    if set(message) == {"do"}:
        if message["do"] not in ACTIONS:
            raise Refused(f"do: one of {', '.join(ACTIONS)}")
        return str(message["do"])
    if unknown := set(message) - {"n", "axes", "held", "mode", "closed"}:
        raise Refused(f"unknown key {sorted(unknown)[0][:40]!r}")
    return PilotCommand(
        count=_count(message.get("n")),
        axes=_axes(message.get("axes"), axes),
        held=_flag(message, "held"),
        request=_request(message.get("mode"), modes),
        closed=_flag(message, "closed"),
    )


def _no_number(name: str) -> NoReturn:
    raise Refused(f"{name} is no number")


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MOST_COUNT:
        raise Refused("n: must count the messages")
    return value


def _axes(values: Any, count: int) -> tuple[float, ...]:
    """As many as there are, finite; what is beyond full speed is full speed."""
    if not isinstance(values, list) or len(values) != count:
        raise Refused(f"axes: must be a list of {count} numbers")
    axes = []
    for value in values:
        # Whole numbers may have thousands of digits, and decimals overflow to infinity.
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not (isinstance(value, int) or math.isfinite(value))
        ):
            raise Refused("axes: must be finite numbers")
        axes.append(round(STEPS * max(-1.0, min(1.0, value))) / STEPS)
    return tuple(axes)


def _flag(message: dict[str, Any], key: str) -> bool:
    value = message.get(key, False)
    if not isinstance(value, bool):
        raise Refused(f"{key}: must be true or false")
    return value


def _request(value: Any, modes: tuple[int, ...]) -> int:
    if value is None:
        return NO_REQUEST
    if isinstance(value, str) and value in REQUESTS and modes:
        return REQUESTS[value]
    if isinstance(value, int) and not isinstance(value, bool) and value in modes:
        return value
    known = ", ".join([*REQUESTS, *map(str, modes)]) if modes else "none here"
    raise Refused(f"mode: no such mode; known: {known}")


# The dead-man's key: set by the server's thread, read by the simulation at every tick.


SILENCE = 0.25
"""Time without a message from the pilot after which velocities are zero [s]."""

NOBODY, RELEASED, DRIVING, SILENT = "nobody drives", "key released", "driving", "silent"


class Deadman:
    """The newest command of the pilot; safe to use from two threads.

    Velocities are zero unless the dead-man's key is held and the last message is not older than ``SILENCE``. After
    silence, and for a new pilot, the key has an effect only after a message that it is released.

    Parameters
    ----------
    axes : velocities of the robot; clock : seconds that only rise
    """

    def __init__(self, axes: Sequence[PilotAxis], clock: Callable[[], float]) -> None:
        self._limits = [axis.limit for axis in axes]
        self._clock, self._lock = clock, threading.Lock()
        self._newest: PilotCommand | None = None
        self._heard, self._armed, self._request, self._closed = 0.0, False, NO_REQUEST, False
        self._silent = False

    def hear(self, command: PilotCommand) -> None:
        """Take a message of the pilot; it is dropped if a later one was received before."""
        with self._lock:
            now = self._clock()
            if self._newest is not None and command.count <= self._newest.count:
                return
            self._note_silence(now)
            if not command.held:
                self._armed, self._silent = True, False
            if command.request != NO_REQUEST and command.held and self._armed:
                self._request = command.request
            self._newest, self._heard, self._closed = command, now, command.closed

    def forget(self) -> None:
        """The pilot has left."""
        with self._lock:
            self._newest, self._armed, self._request, self._silent = None, False, NO_REQUEST, False

    def disarm(self) -> None:
        """The key must be let go once before it counts."""
        with self._lock:
            self._armed, self._request = False, NO_REQUEST

    def command(self) -> tuple[Command, str, int]:
        """What the simulation is to do from now on, why, and the count of the pilot's command that it comes from."""
        with self._lock:
            newest, still = self._newest, Command((0.0,) * len(self._limits), closed=self._closed)
            if newest is None:
                return still, NOBODY, -1
            self._note_silence(self._clock())
            if self._silent or not (newest.held and self._armed):
                self._request = NO_REQUEST
                return still, SILENT if self._silent else RELEASED, newest.count
            velocity = tuple(part * limit for part, limit in zip(newest.axes, self._limits, strict=True))
            request, self._request = self._request, NO_REQUEST
            return Command(velocity, request, self._closed), DRIVING, newest.count

    def _note_silence(self, now: float) -> None:
        if self._newest is not None and now - self._heard > SILENCE:
            self._silent, self._armed = True, False
