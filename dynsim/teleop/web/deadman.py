"""The dead-man's key: set by the server's thread, read by the simulation at every tick."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from dynsim.snake.description import NO_REQUEST
from dynsim.teleop.session import Command, PilotAxis
from dynsim.teleop.web.pilot import PilotCommand

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
