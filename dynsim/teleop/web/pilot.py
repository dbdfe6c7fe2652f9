"""Messages from a pilot, which are short JSON texts, and their validation; the dead-man switch."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from dynsim.snake.description import FIXING, NO_REQUEST, SWITCHING
from dynsim.teleop.snake import Command, PilotAxis

MAX_BYTES = 4096
"""Maximum size of a message [bytes]; if a message is longer, the connection is closed."""
MAX_COUNT = 2**53
"""Largest integer that a browser represents exactly."""
STEPS = 100
"""Number of steps to which a speed is rounded, so that joystick noise does not add entries to the script."""
REQUESTS = {"switching": SWITCHING, "fixing": FIXING}
ACTIONS = ("take", "leave", "end")


class Refused(ValueError):
    """A client has sent an invalid message; the text states the reason."""


@dataclass(frozen=True)
class PilotCommand:
    """Command from the pilot.

    Attributes
    ----------
    count : int
        Number of the message, which increases from message to message.
    axes : tuple of float
        Velocities as fractions of full speed, from −1 to 1.
    held : bool
        True if the dead-man switch is held.
    request : int
        Requested mode; ``NO_REQUEST`` if no mode is requested.
    closed : bool
        True to close the gripper.
    """

    count: int
    axes: tuple[float, ...]
    held: bool
    request: int = NO_REQUEST
    closed: bool = False


def parse(text: str | bytes, axes: int, modes: tuple[int, ...]) -> PilotCommand | str:
    """Parse a message from a client; return a command, or one of the ``ACTIONS``.

    Parameters
    ----------
    text : str or bytes
        Message.
    axes : int
        Number of axes.
    modes : tuple of int
        Modes that may be requested.

    Raises
    ------
    Refused
        If the message is not valid.
    """
    message = parse_object(text)
    if set(message) == {"do"}:
        if message["do"] not in ACTIONS:
            raise Refused(f"do: must be one of {', '.join(ACTIONS)}")
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


def parse_object(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object with finite numbers; raise Refused if the message is not valid."""
    if not isinstance(text, str):
        raise Refused("binary message; send text")
    try:
        message = json.loads(text, parse_constant=_reject_constant)
    except Refused:
        raise
    except (ValueError, RecursionError):
        raise Refused("not valid JSON") from None
    if not isinstance(message, dict):
        raise Refused("not a JSON object")
    return message


def finite(value: Any) -> bool:
    """Return whether a value is a finite number; an integer may be too large for a float."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and (isinstance(value, int) or math.isfinite(value))


def _reject_constant(name: str) -> NoReturn:
    raise Refused(f"{name} is not a finite number")


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_COUNT:
        raise Refused("n: must be the number of the message")
    return value


def _axes(values: Any, count: int) -> tuple[float, ...]:
    """Return ``count`` values, limited to full speed and rounded to speed steps; raise Refused if any is invalid."""
    if not isinstance(values, list) or len(values) != count:
        raise Refused(f"axes: must be a list of {count} numbers")
    axes = []
    for value in values:
        # An integer may have thousands of digits, and a float may have overflowed to infinity.
        if not finite(value):
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
    known = ", ".join([*REQUESTS, *map(str, modes)]) if modes else "none"
    raise Refused(f"mode: unknown mode; modes: {known}")


# Dead-man switch: the thread of the server sets it, and the simulation reads it at each tick.


SILENCE = 0.25
"""Velocities become zero if no message from the pilot arrives for this time [s]."""

NO_PILOT, RELEASED, DRIVING, SILENT = "no pilot", "key released", "driving", "silent"


class Deadman:
    """Dead-man switch that stores the newest command from the pilot; thread-safe.

    Velocities are zero unless the switch is held and the last message is not older than ``SILENCE``. After a silence,
    and for a new pilot, the switch takes effect only after a message has reported that it is released.

    Parameters
    ----------
    axes : sequence of PilotAxis
        Velocities of the robot.
    clock : callable
        Monotonic clock [s].
    """

    def __init__(self, axes: Sequence[PilotAxis], clock: Callable[[], float]) -> None:
        self._limits = [axis.limit for axis in axes]
        self._clock, self._lock = clock, threading.Lock()
        self._newest: PilotCommand | None = None
        self._received_at, self._armed, self._request, self._closed = 0.0, False, NO_REQUEST, False
        self._silent = False

    def receive(self, command: PilotCommand) -> None:
        """Store a command from the pilot; ignore it if a newer command has already been received."""
        with self._lock:
            now = self._clock()
            if self._newest is not None and command.count <= self._newest.count:
                return
            self._check_silence(now)
            if not command.held:
                self._armed, self._silent = True, False
            if command.request != NO_REQUEST and command.held and self._armed:
                self._request = command.request
            self._newest, self._received_at, self._closed = command, now, command.closed

    def reset(self) -> None:
        """Discard the stored command, because the pilot has left."""
        with self._lock:
            self._newest, self._armed, self._request, self._silent = None, False, NO_REQUEST, False

    def disarm(self) -> None:
        """Require that the switch is released once before it takes effect."""
        with self._lock:
            self._armed, self._request = False, NO_REQUEST

    def command(self) -> tuple[Command, str, int]:
        """Return the command for the simulation, the state of the pilot, and the number of the pilot's last message."""
        with self._lock:
            newest, still = self._newest, Command((0.0,) * len(self._limits), closed=self._closed)
            if newest is None:
                return still, NO_PILOT, -1
            self._check_silence(self._clock())
            if self._silent or not (newest.held and self._armed):
                self._request = NO_REQUEST
                return still, SILENT if self._silent else RELEASED, newest.count
            velocity = tuple(part * limit for part, limit in zip(newest.axes, self._limits, strict=True))
            request, self._request = self._request, NO_REQUEST
            return Command(velocity, request, self._closed), DRIVING, newest.count

    def _check_silence(self, now: float) -> None:
        if self._newest is not None and now - self._received_at > SILENCE:
            self._silent, self._armed = True, False
