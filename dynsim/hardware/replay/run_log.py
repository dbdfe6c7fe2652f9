"""What a replay leaves behind: a log to read along (`tail -f`), and its cycles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dynsim.hardware.replay.rows import RowMemory
from dynsim.hardware.replay.rules import Cycle
from dynsim.hardware.replay.stream import GrowingFile
from dynsim.hardware.servo_map import ServoMap
from dynsim.system.terminal import plain


class RunLog:
    """Lines "time [s]  state  text". They reach the file by :meth:`pump`, which another thread calls.

    Parameters
    ----------
    path : path or None
        None: the lines are only in ``lines``.

    Attributes
    ----------
    lines : list of str
    failure : Exception or None
        Why the file ends before the run did.
    wake : callable
        Called after every line: the thread that pumps may be asleep.

    Raises
    ------
    OSError
        The file cannot be made.
    """

    name = "log"

    def __init__(self, path: Path | None) -> None:
        self.lines: list[str] = []
        self.failure: Exception | None = None
        self.wake: Callable[[], None] = lambda: None
        self._file = GrowingFile(path) if path else None
        self._written = 0

    def write(self, time: float, state: str, text: str) -> None:
        self.lines.append(plain(f"{time:10.4f}  {state:<13}  {text}"))
        self.wake()

    def pump(self) -> None:
        count = len(self.lines)
        if self._file and count > self._written:
            text = "\n".join([*self.lines[self._written : count], ""])
            self._written = count
            self._file.append(text.encode("utf-8", errors="backslashreplace"))

    def close(self) -> None:
        if self._file:
            self._file.close()

    def discard(self) -> None:
        if self._file:
            self._file.discard()


class Recorder:
    """Collects the timed cycles of a replay.

    Attributes
    ----------
    rows : RowMemory
    hottest : float
        Servo [°C], NaN before the first health read.
    """

    def __init__(self, servo_map: ServoMap) -> None:
        self._map = servo_map
        count = len(servo_map.servos)
        self.rows = RowMemory(count)
        self.hottest = float("nan")
        self._columns = {servo.id: column for column, servo in enumerate(servo_map.servos)}
        self._volts, self._celsius = np.full(count, np.nan), np.full(count, np.nan)

    def add(
        self,
        *,
        time: float,
        path_time: float,
        origin: float,
        state: int,
        exchange: float,
        stray: int,
        skipped: int,
        cycle: Cycle,
    ) -> None:
        """Keep one cycle; times in [s], ``exchange`` is the duration of its bus traffic."""
        if cycle.health:
            for id_, registers in cycle.health.items():
                self._volts[self._columns[id_]] = registers["present_voltage"] * 0.1
                self._celsius[self._columns[id_]] = registers["present_temperature"]
            self.hottest = float(np.nanmax(self._celsius))
        self.rows.add(
            (time, origin, path_time, cycle.lateness, exchange, state, stray, skipped),
            (
                cycle.goal_position,
                cycle.goal_velocity,
                cycle.position,
                cycle.velocity,
                cycle.torque,
                self._volts,
                self._celsius,
                cycle.alert,
            ),
        )
