"""Between the server, which hears the pilot, and the simulation, which asks at every tick: the dead-man's key."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from dynsim.teleop.driven import NO_REQUEST, Axis, Order
from dynsim.teleop.web.wishes import Wish

SILENCE = 0.25
"""After so long without a word from the pilot velocities are zero [s]."""

NOBODY, RELEASED, DRIVING, SILENT = "nobody drives", "key released", "driving", "silent"


class Helm:
    """The newest wish; safe to use from two threads.

    Velocities are zero unless the dead-man's key is held and the last word is not older than ``SILENCE``. After
    silence, and for a new pilot, the key counts only once it was heard released: nothing goes on by itself.

    Parameters
    ----------
    axes : velocities of the robot; clock : seconds that only rise
    """

    def __init__(self, axes: Sequence[Axis], clock: Callable[[], float]) -> None:
        self._limits = [axis.limit for axis in axes]
        self._clock, self._lock = clock, threading.Lock()
        self._wish: Wish | None = None
        self._heard, self._armed, self._request, self._closed = 0.0, False, NO_REQUEST, False
        self._silent = False

    def hear(self, wish: Wish) -> None:
        """A word of the pilot; one that was overtaken by a later one is dropped."""
        with self._lock:
            now = self._clock()
            if self._wish is not None and wish.count <= self._wish.count:
                return
            self._note_silence(now)
            if not wish.held:
                self._armed, self._silent = True, False
            if wish.request != NO_REQUEST and wish.held and self._armed:
                self._request = wish.request
            self._wish, self._heard, self._closed = wish, now, wish.closed

    def forget(self) -> None:
        """The pilot has left."""
        with self._lock:
            self._wish, self._armed, self._request, self._silent = None, False, NO_REQUEST, False

    def disarm(self) -> None:
        """The key must be let go once before it counts."""
        with self._lock:
            self._armed, self._request = False, NO_REQUEST

    def order(self) -> tuple[Order, str, int]:
        """What holds from now on, why, and the count of the wish that it comes from."""
        with self._lock:
            still = (0.0,) * len(self._limits)
            wish = self._wish
            if wish is None:
                return Order(still, closed=self._closed), NOBODY, -1
            self._note_silence(self._clock())
            if self._silent or not (wish.held and self._armed):
                self._request = NO_REQUEST
                return Order(still, closed=self._closed), SILENT if self._silent else RELEASED, wish.count
            velocity = tuple(part * limit for part, limit in zip(wish.axes, self._limits, strict=True))
            request, self._request = self._request, NO_REQUEST
            return Order(velocity, request, self._closed), DRIVING, wish.count

    def _note_silence(self, now: float) -> None:
        if self._wish is not None and now - self._heard > SILENCE:
            self._silent, self._armed = True, False
