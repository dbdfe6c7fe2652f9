"""The rows that a replay leaves, one for every cycle: as they lie in memory and files, and the record made of them."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record

Rows = NDArray[np.void]


def row_type(servos: int) -> np.dtype[np.void]:
    """One cycle of so many servos, as it lies in memory: without gaps, in the byte order of the machine.

    ``time``, ``origin`` (the clock when the path began, NaN before), ``path_time``, ``lateness`` and ``exchange`` in
    [s]; positions [rad], velocities [rad/s] and torques [N·m] of joints, NaN where a status was missed; supply [V],
    temperature [°C].
    """
    seconds = ["time", "origin", "path_time", "lateness", "exchange"]
    numbers = ["state", "stray", "skipped"]
    joints = ["goal_position", "goal_velocity", "position", "velocity", "torque", "volts", "celsius"]
    return np.dtype(
        [(name, "f8") for name in seconds]
        + [(name, "i4") for name in numbers]
        + [(name, "f8", (servos,)) for name in joints]
        + [("alert", "?", (servos,))]
    )


_SCALARS = struct.Struct("=5d3i")


class RowMemory:
    """Rows that are added one by one and never change: another thread may take them meanwhile."""

    def __init__(self, servos: int) -> None:
        self.type = row_type(servos)
        self._rows: list[bytes] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, scalars: Sequence[float], arrays: Sequence[Any]) -> None:
        """Keep one row: the fields of :func:`row_type` in their order, arrays of exactly that type."""
        # Some microseconds faster than to assign them field by field, and this is done in every cycle.
        self._rows.append(b"".join((_SCALARS.pack(*scalars), *arrays)))

    def since(self, first: int) -> bytes:
        """Rows from number ``first`` on."""
        return b"".join(self._rows[first:])

    def all(self) -> Rows:
        return np.frombuffer(self.since(0), dtype=self.type)


@dataclass(frozen=True)
class TimingStatistics:
    """How well the loop kept its deadlines.

    Attributes
    ----------
    cycles, skipped_cycles, missed_statuses, stray_bytes : int
    period_mean, period_max, lateness_p50, lateness_p99, lateness_max, exchange_mean, exchange_max : float
        Time between cycle starts, start after the deadline, writing all goals and reading all states [s].
    path_late : float
        By how much the path ended later than planned, for the cycles that were skipped on it [s].
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
    path_late: float
    exchange_mean: float
    exchange_max: float

    def as_dict(self) -> dict[str, float | int]:
        """With the unit in the name, for summaries."""
        seconds = {f"{name}_s": value for name, value in vars(self).items() if isinstance(value, float)}
        return {name: value for name, value in vars(self).items() if isinstance(value, int)} | seconds


def timing_of(rows: Rows, layout: Layout) -> TimingStatistics | None:
    """None before the second cycle."""
    if len(rows) < 2:
        return None
    path_time = rows["path_time"]
    # Cycles in which the path went on; of the first there is no time before.
    followed = np.isfinite(path_time) & (np.diff(path_time, prepend=np.nan) != 0)
    periods, lateness, exchange = np.diff(rows["time"]), rows["lateness"], rows["exchange"]
    return TimingStatistics(
        cycles=len(rows),
        skipped_cycles=int(rows["skipped"].sum()),
        missed_statuses=int(np.isnan(rows["position"]).sum()),
        stray_bytes=int(rows["stray"].sum()),
        period_mean=float(periods.mean()),
        period_max=float(periods.max()),
        lateness_p50=float(np.percentile(lateness, 50)),
        lateness_p99=float(np.percentile(lateness, 99)),
        lateness_max=float(lateness.max()),
        path_late=float(rows["skipped"][followed].sum() / layout.provenance["rate_Hz"]),
        exchange_mean=float(exchange.mean()),
        exchange_max=float(exchange.max()),
    )


@dataclass(frozen=True)
class Layout:
    """What the columns of rows are called in a record.

    Signals measured carry the names and labels of the signals followed; ``<name>_goal`` is what was commanded.

    Attributes
    ----------
    joints : list of str
    labels : list of str
        Of the columns of the signals that the joints follow.
    positions, velocities : list of str
        The signal that each joint follows; held joints are among those of their kind.
    provenance : dict
    """

    joints: list[str]
    labels: list[str]
    positions: list[str]
    velocities: list[str]
    provenance: dict[str, Any]

    @classmethod
    def of(cls, servo_map: ServoMap, provenance: dict[str, Any]) -> Layout:
        servos = servo_map.servos
        return cls(
            list(servo_map.joints),
            [servo.label for servo in servos],
            [servo.kind.follows.position for servo in servos],
            [servo.kind.follows.velocity for servo in servos],
            provenance,
        )

    def groups(self) -> Iterator[tuple[str, str, list[int]]]:
        """(signal, "position" or "velocity", columns)."""
        for source, names in (("position", self.positions), ("velocity", self.velocities)):
            for name in dict.fromkeys(names):
                yield name, source, [column for column, one in enumerate(names) if one == name]


def measured_record(rows: Rows, layout: Layout, origin: float) -> Record:
    """The measured run; time 0 is ``origin`` on the clock of the rows [s], the start of the replayed motion."""
    record = Record(rows["time"] - origin, provenance=layout.provenance)
    joints = tuple(layout.joints)
    record.add("record_time", rows["path_time"], "s", description="time in the replayed record")
    record.add("state", rows["state"].astype(np.int64), "1", description="see replay.State")
    units = {"position": "rad", "velocity": "rad/s"}
    for (name, source, columns), suffix in itertools.product(layout.groups(), ("", "_goal")):
        labels = tuple(layout.labels[column] for column in columns)
        field = f"goal_{source}" if suffix else source
        record.add(name + suffix, rows[field][:, columns], units[source], labels=labels)
    record.add("torque_estimate", rows["torque"], "N m", labels=joints, description="from motor current or load")
    record.add("supply_voltage", rows["volts"], "V", labels=joints)
    record.add("temperature", rows["celsius"], "degC", labels=joints)
    missed = np.isnan(rows["position"])
    record.add("missed", missed, "1", labels=joints, description="no valid status in this cycle")
    record.add("alert", rows["alert"], "1", labels=joints, description="alert bit of the status")
    record.add("lateness", rows["lateness"], "s", description="cycle start after its deadline")
    record.add("exchange", rows["exchange"], "s", description="duration of the cycle's bus traffic")
    timing = timing_of(rows, layout)
    record.summary["timing"] = timing.as_dict() if timing else {}
    return record
