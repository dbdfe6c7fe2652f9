"""Reading and writing of records as HDF5 files.

A file is HDF5 data followed by one line with the SHA-256 of all bytes before it, which HDF5 ignores. The digest reveals
damage. A file without that line, or with another digest, is read only with ``trust=True`` (``--trust``). Sizes are
checked before data are decompressed. A file that this process did not write is read in a child process with limits of
time and memory (:mod:`dynsim.record.isolated`), because the HDF5 library may crash or loop endlessly on a damaged file.
A file is rejected if it may belong to another run than the files next to it.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError, brief
from dynsim.record import isolated
from dynsim.record.content import FORMAT, TIME, Content, Event, Signal, check_name, check_signal, check_time, is_numeric
from dynsim.record.quaternion import Array
from dynsim.record.scene import Scene
from dynsim.system.files import check_complete
from dynsim.system.inputs import is_file

EVENT_COLUMNS = {"time": float, "kind": str, "name": str, "value": float, "description": str}
"""Attributes of events; each attribute is a data set in the group ``events``."""
_written: set[str] = set()
"""Digests of the files that this process wrote."""
_LABELS_IN_ATTRIBUTE = 1000
"""Above this number, labels are stored as a data set, because an HDF5 attribute holds at most 64 kB, or 4090 labels."""


def encode(content: Content) -> memoryview:
    """Return the bytes of a record file.

    Raises
    ------
    RecordError
        If a time axis is invalid, or a text cannot be stored in HDF5.
    """
    import h5py

    check_time(content.time)
    for name, times in content.axes.items():
        check_name("time axis", name)
        check_time(times, f"time axis {name!r}")
    summary, provenance = json.dumps(content.summary), json.dumps(content.provenance, default=str)
    scene = "" if content.scene is None else content.scene.to_json()
    # The file is written in memory, because HDF5 crashes the process if the disk is full when it closes a file.
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["complete"] = content.complete
        # Long texts are stored as data sets, because an HDF5 attribute holds at most 64 kB.
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
    digest = hashlib.sha256(image.getbuffer()).hexdigest()
    _written.add(digest)
    image.write(b"\ndynsim-sha256:%s\n" % digest.encode("ascii"))
    return image.getbuffer()


def _write(file: Any, name: str, signal: Signal) -> None:
    # Use gzip only for large signals, because it takes time in every run and short records are small anyway.
    options = {"compression": "gzip", "compression_opts": 1} if signal.data.nbytes > 1 << 22 else {}
    data = file.create_dataset(name, data=signal.data, **options)
    data.attrs["unit"] = signal.unit
    if len(signal.labels) <= _LABELS_IN_ATTRIBUTE:
        data.attrs["labels"] = list(signal.labels)
    data.attrs["description"] = signal.description
    if signal.axis != TIME:
        data.attrs["axis"] = signal.axis


def _write_events(file: Any, events: Sequence[Event]) -> None:
    """Write one column per attribute; without events, the group is not created."""
    import h5py

    if not events:
        return
    for name, kind in EVENT_COLUMNS.items():
        column = [getattr(event, name) for event in events]
        if kind is float:
            column = [math.nan if entry is None else entry for entry in column]
        file.create_dataset(f"events/{name}", data=column, dtype="f8" if kind is float else h5py.string_dtype())


_FORMATS = "dynsim-record-"
_LAST_LINE = re.compile(rb"\ndynsim-sha256:([0-9a-f]{64})\n")
_LAST_LINE_SIZE = 80


def read(path: Path, *, trust: bool = False) -> Content:
    """Read a record file.

    Parameters
    ----------
    path : Path
        File to read.
    trust : bool, optional
        Accept a file whose digest is missing or wrong (written or changed by another program).

    Raises
    ------
    RecordError
        If the file does not exist, is damaged or is not a record; if its digest is missing or wrong and ``trust`` is
        False; or if it may belong to a different run than the files next to it.
    """
    try:
        if not is_file(path, RecordError):
            part = path.with_suffix(".part")
            hint = f"; the replay crashed and left {part}: dynsim hw recover {path.parent}" if part.is_file() else ""
            raise RecordError(f"{path}: no such record{hint}")
        check_complete(path)
        with path.open("rb") as stream:
            digest, doubt = _digest(path, stream)
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if doubt and not trust:
        raise RecordError(f"{path}: {doubt}; {_TRUST}")
    return decode(path) if digest in _written else isolated.read(path)


_TRUST = "if you trust its source, read it with --trust (in Python: Record.load(path, trust=True))"


def _digest(path: Path, stream: BinaryIO) -> tuple[str, str]:
    """Return the digest of the data, and why the file may not be as dynsim wrote it, or "" if it is.

    Raises
    ------
    RecordError
        If the file is not an HDF5 file.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(size - _LAST_LINE_SIZE, 0))
    match = _LAST_LINE.fullmatch(stream.read())
    stream.seek(0)
    if not stream.read(8).startswith(b"\x89HDF\r\n\x1a\n"):
        raise RecordError(f"{path}: not a readable HDF5 file (wrong signature)")
    if match is None:
        return "", "no digest (SHA-256) at the end: it was truncated, or written by another program"
    stream.seek(0)
    actual, left = hashlib.sha256(), size - _LAST_LINE_SIZE
    while left and (block := stream.read(min(left, 1 << 20))):
        actual.update(block)
        left -= len(block)
    if actual.hexdigest().encode("ascii") != match[1]:
        return "", "its content does not match its digest (SHA-256): it was damaged, or changed after dynsim wrote it"
    return actual.hexdigest(), ""


def decode(path: Path) -> Content:
    """Read and check the content of an HDF5 file.

    Parameters
    ----------
    path : Path
        HDF5 file.

    Raises
    ------
    RecordError
        If the content is invalid; the message contains file and reason.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return _Reader(file, path.stat().st_size).content()
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from error
    except MemoryError as error:
        raise RecordError(f"{path}: not enough memory to read it") from error
    # For damaged files, h5py raises exceptions of almost any type.
    except Exception as error:
        text = str(error).strip("'\"").splitlines() or [type(error).__name__]
        raise RecordError(f"{path}: not a readable HDF5 file ({text[0]})") from error


# Groups of data sets, and the names of their data sets in messages.
_GROUPS = {"signals": "signal {!r}", "axes": "time axis {!r}", "events": "{} of the events", "labels": "labels of {!r}"}


def _describe(path: str) -> str:
    group, _, name = path.rpartition("/")
    return _GROUPS[group].format(name) if group else name


class _Reader:
    """Reader of an open file; its error messages do not contain the name of the file."""

    def __init__(self, file: Any, size: int) -> None:
        self._file = file
        self._size = size
        self._left = isolated.data_limit(size)

    def content(self) -> Content:
        version, complete = (self._file.attrs.get(name) for name in ("format", "complete"))
        if not isinstance(version, str) or not version.startswith(_FORMATS):
            raise RecordError(f"an HDF5 file, but not a dynsim record ({FORMAT})")
        if version != FORMAT:
            raise RecordError(f"unsupported record format {brief(version)}; this version of dynsim reads {FORMAT}")
        if complete is None:
            raise RecordError("incomplete dynsim record: the attribute complete is missing")
        if not isinstance(complete, (bool, np.bool_)):
            raise RecordError("the attribute complete must be true or false")
        axes = {TIME: self._times(TIME)}
        for name in self._names("axes"):
            if name == TIME:
                raise RecordError(f"the name {TIME} is reserved for the default time axis")
            axes[name] = self._times(f"axes/{name}")
        samples = {name: len(times) for name, times in axes.items()}
        scene = self._text("scene") if "scene" in self._file else ""
        signals = {name: self._signal(name, samples) for name in self._names("signals")}
        return Content(
            time=axes.pop(TIME),
            signals=signals,
            summary=_mapping("summary", self._text("summary")),
            provenance=_mapping("provenance", self._text("provenance")),
            complete=bool(complete),
            axes=axes,
            events=self._events(),
            scene=Scene.from_json(scene) if scene else None,
        )

    def _times(self, path: str) -> Array:
        times = self._numbers(path)
        check_time(times, _describe(path))
        return times.astype(np.float64, copy=False)

    def _signal(self, name: str, samples: Mapping[str, int]) -> Signal:
        path = f"signals/{name}"
        data, attributes = self._numbers(path), self._file[path].attrs
        kept = "labels" in attributes or "labels" not in self._file
        labels = attributes.get("labels") if kept else self._column(f"labels/{name}")
        if labels is None:
            raise RecordError(f"incomplete dynsim record: {_describe(path)} has no labels")
        texts = {key: attributes.get(key) for key in ("unit", "description")} | {"axis": attributes.get("axis", TIME)}
        for key, text in texts.items():
            if not isinstance(text, str):
                raise RecordError(f"{key} of {_describe(path)} is not a text")
        signal = Signal(data, labels=_texts(labels, f"labels of {_describe(path)}"), **texts)
        check_signal(name, signal, samples)
        return signal

    def _events(self) -> list[Event]:
        if not self._names("events"):
            return []
        columns: dict[str, Sequence[Any]] = {}
        for name, kind in EVENT_COLUMNS.items():
            path = f"events/{name}"
            texts = kind is str
            columns[name] = _texts(self._column(path), _describe(path)) if texts else self._numbers(path).tolist()
            if len(columns[name]) != len(columns["time"]):
                counts = len(columns[name]), len(columns["time"])
                raise RecordError(f"{_describe(path)} has {counts[0]} entries, but there are {counts[1]} times")
        if not all(map(math.isfinite, columns["time"])):
            raise RecordError("events: the time of an event is not finite")
        columns["value"] = [None if math.isnan(value) else value for value in columns["value"]]
        return [Event(*entries) for entries in zip(*(columns[name] for name in EVENT_COLUMNS), strict=True)]

    def _names(self, group: str) -> list[str]:
        return list(self._child(group, group=True)) if group in self._file else []

    def _child(self, path: str, *, group: bool = False) -> Any:
        """Return a data set or group that is stored in the file itself."""
        import h5py

        name = f"group {path}" if group else _describe(path)
        link = self._file.get(path, getlink=True)
        if link is None:
            raise RecordError(f"incomplete dynsim record: {name} is missing")
        if not isinstance(link, h5py.HardLink):
            raise RecordError(f"{name} is a link; links are not followed")
        item = self._file[path]
        if not isinstance(item, h5py.Group if group else h5py.Dataset):
            raise RecordError(f"{name} is not a {'group' if group else 'data set'}")
        return item

    def _numbers(self, path: str) -> NDArray[Any]:
        """Return an array of real numbers."""
        data = self._child(path)
        if not is_numeric(data.dtype):
            raise RecordError(f"{_describe(path)} contains {data.dtype}, not real numbers")
        return np.asarray(self._values(data, path))

    def _column(self, path: str) -> NDArray[Any]:
        """Return texts that are stored as a data set."""
        return np.asarray(self._values(self._child(path), path))

    def _text(self, name: str) -> str:
        """Return a long text that is stored as a data set."""
        text = self._values(self._child(name), name)
        if not isinstance(text, bytes):
            raise RecordError(f"{name} is not text")
        return text.decode("utf-8")

    def _values(self, data: Any, path: str) -> Any:
        """Return the content of a data set; reject data that are external or too large."""
        name = _describe(path)
        if data.external or data.is_virtual:
            raise RecordError(f"{name} is stored in other files, which are not opened")
        size = math.prod(data.shape or ()) * data.dtype.itemsize
        self._left -= size
        if self._left < 0:
            raise RecordError(
                f"{name} would expand to {size} bytes; the limit for a file of {self._size} bytes is "
                f"{isolated.data_limit(self._size)} in total"
            )
        return data[()]


def _mapping(name: str, text: str) -> dict[str, Any]:
    try:
        mapping = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordError(f"{name} is not JSON ({error})") from error
    if not isinstance(mapping, dict):
        raise RecordError(f"{name} is {type(mapping).__name__}, not a mapping")
    return mapping


def _texts(values: Any, name: str) -> tuple[str, ...]:
    """Return the texts of an attribute or a data set, which h5py reads as str or bytes."""
    if np.ndim(values) != 1:
        raise RecordError(f"{name} must be a list")
    texts = tuple(text.decode("utf-8") if isinstance(text, bytes) else text for text in np.asarray(values).tolist())
    if not all(isinstance(text, str) for text in texts):
        raise RecordError(f"{name} must be texts")
    return texts
