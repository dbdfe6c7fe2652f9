"""Content of a record (signals on time axes, events, scene) and checks that reject invalid values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError
from dynsim.record.quaternion import Array
from dynsim.record.scene import Scene

FORMAT = "dynsim-record-2"
"""The only file format that dynsim writes and reads."""
TIME = "time"
"""Name of the default time axis of signals."""


@dataclass(frozen=True)
class Signal:
    """One quantity over time.

    Attributes
    ----------
    data : ndarray, shape (T,), (T, k) or (T, k, m)
        Samples.
    unit : str
        SI unit as text; "1" for dimensionless numbers.
    labels : tuple of str
        Names of the k columns; empty for a scalar signal.
    description : str
        Short description.
    axis : str
        Name of the signal's time axis, which has T times.
    """

    data: NDArray[Any]
    unit: str
    labels: tuple[str, ...] = ()
    description: str = ""
    axis: str = TIME


@dataclass(frozen=True)
class Event:
    """Event at one time of a run.

    Attributes
    ----------
    time : float
        Time [s].
    kind : str
        Kind of the event, such as "contact opens"; all events of a kind share this text.
    name : str
        Name of the contact, joint or other part that the event concerns; empty if it concerns the whole run.
    value : float or None
        Associated number in SI units.
    description : str
        Short description.
    """

    time: float
    kind: str
    name: str = ""
    value: float | None = None
    description: str = ""


@dataclass(eq=False)
class Content:
    """Complete content of a record file."""

    time: Array
    signals: Mapping[str, Signal] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    complete: bool = True
    axes: Mapping[str, Array] = field(default_factory=dict)
    events: Sequence[Event] = ()
    scene: Scene | None = None


def check_name(kind: str, name: str) -> None:
    """Raise if a name cannot be used in HDF5.

    Raises
    ------
    RecordError
        If ``name`` is empty or a dot, or contains a slash or a null character.
    """
    if name in ("", ".") or "/" in name or "\0" in name:
        raise RecordError(f"{kind} {name!r}: a name must not be empty, be a dot, or contain a slash")


def check_time(time: NDArray[Any], axis: str = TIME) -> None:
    """Raise if a time axis is invalid.

    Raises
    ------
    RecordError
        If ``time`` is not one-dimensional, not finite, or runs backwards.
    """
    if time.ndim != 1:
        raise RecordError(f"{axis} must be one-dimensional, but has shape {time.shape}")
    if not np.isfinite(time).all():
        raise RecordError(f"{axis} is not finite at sample {int(np.flatnonzero(~np.isfinite(time))[0])}")
    if (backwards := np.flatnonzero(np.diff(time) < 0.0)).size:
        raise RecordError(f"{axis} runs backwards after sample {int(backwards[0])}")


def check_signal(name: str, signal: Signal, samples: Mapping[str, int]) -> None:
    """Raise if a signal is invalid.

    Parameters
    ----------
    name : str
        Name of the signal.
    signal : Signal
        Signal to check.
    samples : mapping of str to int
        Number of times on each time axis.

    Raises
    ------
    RecordError
        If its name, type, shape, labels or axis is invalid.
    """
    data = signal.data
    check_name("signal", name)
    if not is_numeric(data.dtype):
        raise RecordError(f"signal {name!r} contains {data.dtype}, not real numbers")
    if not 1 <= data.ndim <= 3:
        raise RecordError(f"signal {name!r} has {data.ndim} dimensions; it must have 1 to 3")
    if signal.axis not in samples:
        raise RecordError(f"signal {name!r}: unknown time axis {signal.axis!r}; this record has: {', '.join(samples)}")
    if data.shape[0] != samples[signal.axis]:
        where = "the record" if signal.axis == TIME else f"its time axis {signal.axis!r}"
        raise RecordError(f"signal {name!r} has {data.shape[0]} samples, {where} has {samples[signal.axis]}")
    if data.ndim > 1 and len(signal.labels) != data.shape[1]:
        raise RecordError(f"signal {name!r} has {data.shape[1]} columns but {len(signal.labels)} labels")
    if data.ndim == 1 and signal.labels:
        raise RecordError(f"signal {name!r} has no columns but {len(signal.labels)} labels")


def is_numeric(dtype: Any) -> bool:
    """Return whether a record can store arrays of this type, which must be real numbers of at most 8 bytes."""
    return bool(dtype.kind in "biuf" and dtype.itemsize <= 8)
