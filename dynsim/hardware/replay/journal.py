"""Where a replay is, told to the log and to a display."""

from __future__ import annotations

import math
from collections.abc import Callable

from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.replay.run_log import Recorder, RunLog
from dynsim.hardware.replay.states import Progress, State

LOG_INTERVAL = 1.0
"""Between two lines about the following error [s]."""


class Journal:
    """Keeps the state of a replay, and tells of it.

    Attributes
    ----------
    state : State
    log : RunLog
    observer : callable, optional
        Called with a Progress after every cycle and on every change of state.
    """

    def __init__(
        self, clock: Clock, recorder: Recorder, log: RunLog, observer: Callable[[Progress], None] | None
    ) -> None:
        self.state = State.CONNECT
        self.observer = observer
        self._clock = clock
        self._recorder = recorder
        self.log = log
        self._origin = clock.now()
        self._last_logged = -math.inf

    def enter(self, state: State) -> None:
        self.state = state
        self.say("enter")
        if self.observer:
            self.observer(Progress(state, 0.0, 0.0, self._recorder.hottest))

    def say(self, text: str) -> None:
        self.log.write(self._clock.now() - self._origin, self.state.name, text)

    def report(self, following_error: float, fraction: float) -> None:
        """After a cycle: the worst following error [rad], and how much of the motion is done."""
        now = self._clock.now()
        if now - self._last_logged >= LOG_INTERVAL:
            self._last_logged = now
            hottest = self._recorder.hottest
            self.say(
                f"following error {following_error:.4f} rad"
                + (f", hottest {hottest:.0f} °C" if hottest == hottest else "")
            )
        if self.observer:
            self.observer(Progress(self.state, fraction, following_error, self._recorder.hottest))
