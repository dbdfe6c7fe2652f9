"""Writing of records to HDF5 files, with a digest of all bytes at the end."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from collections.abc import Sequence
from typing import Any

from dynsim.errors import RecordError
from dynsim.record.content import FORMAT, TIME, Content, Event, Signal, check_name, check_time

EVENT_COLUMNS = {"time": float, "kind": str, "name": str, "value": float, "description": str}
"""Attributes of events; each is a data set of the group ``events``."""
_LABELS_IN_ATTRIBUTE = 1000
"""More labels than this become a data set: HDF5 attributes have at most 64 kB, which is 4090 labels."""


def encode(content: Content) -> memoryview:
    """The bytes of a file.

    Raises
    ------
    RecordError
        A time axis is invalid, or a text cannot be stored in HDF5.
    """
    import h5py

    check_time(content.time)
    for name, times in content.axes.items():
        check_name("time axis", name)
        check_time(times, f"time axis {name!r}")
    summary, provenance = json.dumps(content.summary), json.dumps(content.provenance, default=str)
    scene = "" if content.scene is None else content.scene.to_json()
    # Made in memory: HDF5 crashes the process when the disk is full while it closes a file.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["complete"] = content.complete
        # Long texts as data sets: HDF5 attributes end at 64 kB.
        file["summary"] = summary
        file["provenance"] = provenance
        if scene:
            file["scene"] = scene
        _write(file, "time", Signal(content.time, "s"))
        for name, times in content.axes.items():
            _write(file, f"axes/{name}", Signal(times, "s"))
        _write_events(file, content.events)
        for name, signal in content.signals.items():
            try:
                _write(file, f"signals/{name}", signal)
                if len(signal.labels) > _LABELS_IN_ATTRIBUTE:
                    file.create_dataset(f"labels/{name}", data=list(signal.labels), dtype=h5py.string_dtype())
            except ValueError as error:
                raise RecordError(f"signal {name!r} cannot be saved: {error}") from error
    image.seek(0, os.SEEK_END)
    image.write(b"\ndynsim-sha256:%s\n" % hashlib.sha256(image.getbuffer()).hexdigest().encode("ascii"))
    return image.getbuffer()


def _write(file: Any, name: str, signal: Signal) -> None:
    # gzip only where it pays: it costs time on every run, and short records are small anyway.
    options = {"compression": "gzip", "compression_opts": 1} if signal.data.nbytes > 1 << 22 else {}
    data = file.create_dataset(name, data=signal.data, **options)
    data.attrs["unit"] = signal.unit
    if len(signal.labels) <= _LABELS_IN_ATTRIBUTE:
        data.attrs["labels"] = list(signal.labels)
    data.attrs["description"] = signal.description
    if signal.axis != TIME:
        data.attrs["axis"] = signal.axis


def _write_events(file: Any, events: Sequence[Event]) -> None:
    """A column for each attribute; a file without events has no group of them."""
    import h5py

    if not events:
        return
    for name, kind in EVENT_COLUMNS.items():
        column = [getattr(event, name) for event in events]
        if kind is float:
            column = [math.nan if entry is None else entry for entry in column]
        file.create_dataset(f"events/{name}", data=column, dtype="f8" if kind is float else h5py.string_dtype())
