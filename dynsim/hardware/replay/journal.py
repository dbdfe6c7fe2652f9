"""The only way out of a replay: what it tells the log, a display and files, none of which may stop or delay it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.replay.run_log import Recorder, RunLog
from dynsim.hardware.replay.states import Progress, State, StopRequest

LOG_INTERVAL = 1.0
"""Between two lines about the following error [s]."""

P = ParamSpec("P")
T = TypeVar("T")


class Journal:
    """Keeps the state of a replay, and tells of it. Nothing here raises.

    Attributes
    ----------
    state : State
    log : RunLog
    observer : callable, optional
        Called with a Progress after every cycle and on every change of state.
    failures : dict
        The first error of every output that failed, by its name; that output is off since.
    """

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        log: RunLog,
        observer: Callable[[Progress], None] | None,
        stop: StopRequest,
    ) -> None:
        self.state = State.CONNECT
        self.observer = observer
        self.log = log
        self.failures: dict[str, BaseException] = {}
        self._clock = clock
        self._recorder = recorder
        self._stop = stop
        self._origin = clock.now()
        self._last_logged = -math.inf
        self._kept: list[tuple[float, str, str]] | None = None

    def guard(self, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        """Run an output; None when it fails, and from then on without trying.

        Parameters
        ----------
        what : str
            Its name: what :attr:`failures` lists, and what is switched off by an error.
        call : callable
            A KeyboardInterrupt or SystemExit out of it becomes a request to stop: nothing may leave a moving robot.
        """
        if what in self.failures:
            return None
        try:
            return call(*args, **kwargs)
        except Exception as error:
            self.failures[what] = error
        except BaseException as error:
            self.failures[what] = error
            self._stop()
        if what != "log":
            self.say(f"{what} failed and is off from here: {self.failures[what]!r}")
        return None

    def enter(self, state: State) -> None:
        self.state = state
        self.say("enter")
        self._observe(0.0, 0.0)

    def say(self, text: str) -> None:
        line = (self._clock.now() - self._origin, self.state.name, text)
        if self._kept is None:
            self._write(*line)
        else:
            self._kept.append(line)

    def report(self, following_error: float, fraction: float) -> None:
        """After a cycle: the worst following error [rad], and how much of the motion is done."""
        if self._kept is not None:
            return
        now = self._clock.now()
        if now - self._last_logged >= LOG_INTERVAL:
            self._last_logged = now
            hottest = self._recorder.hottest
            self.say(
                f"following error {following_error:.4f} rad"
                + (f", hottest {hottest:.0f} °C" if hottest == hottest else "")
            )
        self._observe(fraction, following_error)

    @contextmanager
    def held_back(self) -> Iterator[None]:
        """Within, nothing leaves: what is said is written afterwards, and the observer hears of nothing.

        A disk or a terminal that blocks cannot delay what happens to the robot meanwhile.
        """
        self._kept = []
        try:
            yield
        finally:
            kept, self._kept = self._kept, None
            for line in kept:
                self._write(*line)

    def _write(self, time: float, state: str, text: str) -> None:
        self.guard("log", self.log.write, time, state, text)
        if self.log.failure is not None:
            self.failures.setdefault("log", self.log.failure)

    def _observe(self, fraction: float, following_error: float) -> None:
        if self.observer and self._kept is None:
            progress = Progress(self.state, fraction, following_error, self._recorder.hottest)
            self.guard("progress", self.observer, progress)
