"""Contents of a record: signals on time axes, events, scene; and the checks for invalid values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.record.scene import Scene

FORMAT = "dynsim-record-2"
"""The only format of files that is written and read."""
TIME = "time"
"""Name of the time axis of signals that name no other."""


@dataclass(frozen=True)
class Signal:
    """One quantity over time.

    Attributes
    ----------
    data : array, shape (T,) or (T, k) or (T, k, m)
    unit : str
        SI unit as text, "1" for pure numbers.
    labels : tuple of str
        Names of the k columns, empty for a scalar signal.
    description : str
    axis : str
        Name of its time axis, which has T instants.
    """

    data: NDArray[Any]
    unit: str
    labels: tuple[str, ...] = ()
    description: str = ""
    axis: str = TIME


@dataclass(frozen=True)
class Event:
    """Something that happened at an instant.

    Attributes
    ----------
    time : float
        [s]
    kind : str
        What kind of thing, such as "contact opens"; the same word for all of its kind.
    name : str
        What it happened to: a contact, a joint, …; empty for the whole run.
    value : float or None
        A number that belongs to it, in SI units.
    description : str
    """

    time: float
    kind: str
    name: str = ""
    value: float | None = None
    description: str = ""


@dataclass(frozen=True)
class Content:
    """All that a file holds."""

    time: NDArray[np.float64]
    signals: Mapping[str, Signal] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    complete: bool = True
    axes: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    events: Sequence[Event] = ()
    scene: Scene | None = None


def check_name(kind: str, name: str) -> None:
    """Refuse a name that HDF5 would take for something else.

    Raises
    ------
    RecordError
    """
    if name in ("", ".") or "/" in name or "\0" in name:
        raise RecordError(f"{kind} {name!r}: a name must not be empty, a dot, or hold a slash")


def check_time(time: NDArray[Any], axis: str = TIME) -> None:
    """Refuse a time axis that is none.

    Raises
    ------
    RecordError
        Not one-dimensional, not finite, or running backwards.
    """
    if time.ndim != 1:
        raise RecordError(f"{axis} has the shape {time.shape}; it must have one axis")
    if not np.isfinite(time).all():
        raise RecordError(f"{axis} is not finite at sample {int(np.flatnonzero(~np.isfinite(time))[0])}")
    if (backwards := np.flatnonzero(np.diff(time) < 0.0)).size:
        raise RecordError(f"{axis} runs backwards after sample {int(backwards[0])}")


def check_signal(name: str, signal: Signal, samples: Mapping[str, int]) -> None:
    """Refuse a signal that no record can hold.

    Parameters
    ----------
    samples : number of instants of every time axis

    Raises
    ------
    RecordError
        Its name, type, shape, labels or axis.
    """
    data = signal.data
    check_name("signal", name)
    if not is_numeric(data.dtype):
        raise RecordError(f"signal {name!r} holds {data.dtype}, not real numbers")
    if not 1 <= data.ndim <= 3:
        raise RecordError(f"signal {name!r} has {data.ndim} axes; one to three can be kept")
    if signal.axis not in samples:
        raise RecordError(f"signal {name!r} is on time axis {signal.axis!r}; this record has: {', '.join(samples)}")
    if data.shape[0] != samples[signal.axis]:
        where = "the record" if signal.axis == TIME else f"its time axis {signal.axis!r}"
        raise RecordError(f"signal {name!r} has {data.shape[0]} samples, {where} has {samples[signal.axis]}")
    if data.ndim > 1 and len(signal.labels) != data.shape[1]:
        raise RecordError(f"signal {name!r} has {data.shape[1]} columns and {len(signal.labels)} labels")
    if data.ndim == 1 and signal.labels:
        raise RecordError(f"signal {name!r} has no columns and {len(signal.labels)} labels")


def is_numeric(dtype: Any) -> bool:
    """Whether arrays of this type hold real numbers that a record can keep."""
    return bool(dtype.kind in "biuf" and dtype.itemsize <= 8)
