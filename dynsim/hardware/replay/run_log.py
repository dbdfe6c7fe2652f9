"""What a replay leaves behind: a log to read along (`tail -f`), and the measured run as a record."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from dynsim.hardware.replay.rules import Cycle
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record
from dynsim.terminal import plain


class RunLog:
    """Lines "time [s]  state  text", each on disk as soon as it is written.

    A disk that fails does not keep a robot from being stopped: from then on the lines are only in ``lines``.

    Attributes
    ----------
    lines : list of str
    failure : OSError or None
        Why the file ends before the run did.
    """

    def __init__(self, path: Path | None) -> None:
        # Written in place: it is there to be followed.
        self._file: TextIO | None = (
            path.open("w", encoding="utf-8", errors="backslashreplace", buffering=1) if path else None
        )
        self.lines: list[str] = []
        self.failure: OSError | None = None

    def write(self, time: float, state: str, text: str) -> None:
        line = plain(f"{time:10.4f}  {state:<13}  {text}")
        self.lines.append(line)
        if self._file:
            try:
                self._file.write(line + "\n")
            except OSError as error:
                self.failure = error
                self.close()
                self.lines.append(f"the log could not be written on: {error.strerror}")

    def close(self) -> None:
        if self._file:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class TimingStatistics:
    """How well the loop kept its deadlines.

    Attributes
    ----------
    cycles, skipped_cycles, missed_statuses, stray_bytes : int
    period_mean, period_max, lateness_p50, lateness_p99, lateness_max, exchange_mean, exchange_max : float
        Time between cycle starts, start after the deadline, writing all goals and reading all states [s].
    """

    cycles: int
    skipped_cycles: int
    missed_statuses: int
    stray_bytes: int
    period_mean: float
    period_max: float
    lateness_p50: float
    lateness_p99: float
    lateness_max: float
    exchange_mean: float
    exchange_max: float

    def as_dict(self) -> dict[str, float | int]:
        """With the unit in the name, for summaries."""
        seconds = {f"{name}_s": value for name, value in vars(self).items() if isinstance(value, float)}
        return {name: value for name, value in vars(self).items() if isinstance(value, int)} | seconds


@dataclass(frozen=True)
class _Row:
    time: float
    path_time: float
    state: int
    exchange: float
    stray: int
    skipped: int
    cycle: Cycle
    volts: np.ndarray[Any, Any]
    celsius: np.ndarray[Any, Any]


class Recorder:
    """Collects the timed cycles of a replay.

    Signals measured carry the names and labels of the signals followed; ``<name>_goal`` is what was commanded.
    """

    def __init__(self, servo_map: ServoMap) -> None:
        self._map = servo_map
        self._rows: list[_Row] = []
        count = len(servo_map.servos)
        self._volts, self._celsius = np.full(count, np.nan), np.full(count, np.nan)

    def add(
        self, *, time: float, path_time: float, state: int, exchange: float, stray: int, skipped: int, cycle: Cycle
    ) -> None:
        """Keep one cycle; ``time`` and ``path_time`` in [s], ``exchange`` the duration of its bus traffic [s]."""
        for index, servo in enumerate(self._map.servos):
            if servo.id in cycle.health:
                self._volts[index] = cycle.health[servo.id]["present_voltage"] * 0.1
                self._celsius[index] = cycle.health[servo.id]["present_temperature"]
        self._rows.append(
            _Row(time, path_time, state, exchange, stray, skipped, cycle, self._volts.copy(), self._celsius.copy())
        )

    @property
    def cycles(self) -> int:
        return len(self._rows)

    @property
    def hottest(self) -> float:
        """[°C], NaN before the first health read."""
        return float(np.nanmax(self._celsius)) if np.isfinite(self._celsius).any() else float("nan")

    def timing(self) -> TimingStatistics | None:
        """None before the second cycle."""
        if len(self._rows) < 2:
            return None
        times = np.array([row.time for row in self._rows])
        lateness = np.array([row.cycle.lateness for row in self._rows])
        exchange = np.array([row.exchange for row in self._rows])
        periods = np.diff(times)
        return TimingStatistics(
            cycles=len(self._rows),
            skipped_cycles=sum(row.skipped for row in self._rows),
            missed_statuses=int(sum(row.cycle.missed.sum() for row in self._rows)),
            stray_bytes=sum(row.stray for row in self._rows),
            period_mean=float(periods.mean()),
            period_max=float(periods.max()),
            lateness_p50=float(np.percentile(lateness, 50)),
            lateness_p99=float(np.percentile(lateness, 99)),
            lateness_max=float(lateness.max()),
            exchange_mean=float(exchange.mean()),
            exchange_max=float(exchange.max()),
        )

    def record(self, origin: float, provenance: dict[str, Any]) -> Record:
        """The measured run; time 0 is ``origin`` [s], the start of the replayed motion."""
        rows = self._rows
        record = Record([row.time - origin for row in rows], provenance=provenance)
        joints, servos = self._map.joints, self._map.servos
        record.add("record_time", [row.path_time for row in rows], "s", description="time in the replayed record")
        record.add("state", np.array([row.state for row in rows], dtype=np.int64), "1", description="see replay.State")
        for name, unit, columns in self._groups():
            labels = tuple(servos[k].label for k in columns)
            source = "velocity" if unit == "rad/s" else "position"
            for suffix, attribute in (("", source), ("_goal", f"goal_{source}")):
                data = np.array([getattr(row.cycle, attribute)[columns] for row in rows]).reshape(
                    len(rows), len(columns)
                )
                record.add(name + suffix, data, unit, labels=labels)
        shape = (len(rows), len(servos))
        torque = np.array([row.cycle.torque for row in rows]).reshape(shape)
        record.add("torque_estimate", torque, "N m", labels=joints, description="from motor current or load")
        record.add("supply_voltage", np.array([row.volts for row in rows]).reshape(shape), "V", labels=joints)
        record.add("temperature", np.array([row.celsius for row in rows]).reshape(shape), "degC", labels=joints)
        missed = np.array([row.cycle.missed for row in rows], dtype=bool).reshape(shape)
        alert = np.array([row.cycle.alert for row in rows], dtype=bool).reshape(shape)
        record.add("missed", missed, "1", labels=joints, description="no valid status in this cycle")
        record.add("alert", alert, "1", labels=joints, description="alert bit of the status")
        record.add("lateness", [row.cycle.lateness for row in rows], "s", description="cycle start after its deadline")
        record.add("exchange", [row.exchange for row in rows], "s", description="duration of the cycle's bus traffic")
        timing = self.timing()
        record.summary["timing"] = timing.as_dict() if timing else {}
        return record

    def _groups(self) -> list[tuple[str, str, list[int]]]:
        """(signal, unit, servo indices), held joints under the signals of their kind."""
        groups: dict[tuple[str, str], list[int]] = {}
        for index, servo in enumerate(self._map.servos):
            groups.setdefault((servo.kind.follows.position, "rad"), []).append(index)
            groups.setdefault((servo.kind.follows.velocity, "rad/s"), []).append(index)
        return [(name, unit, columns) for (name, unit), columns in groups.items()]
