"""Records as HDF5 files, the reading half.

A file is HDF5 and, after its end, one line with the SHA-256 of all bytes before it. HDF5 ignores the line; with it,
damage is found before the HDF5 library, which may crash or never return on a damaged file, has seen it. A file without
that line, or with another digest, is read only where the caller trusts it. The attribute ``sha256`` is a checksum of
the content: of times, signals and texts, however they are stored. Sizes are limited in both cases, before anything is
unpacked.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import RecordError, shown
from dynsim.record.content import (
    FORMAT,
    TIME,
    Content,
    Event,
    Signal,
    check_signal,
    check_time,
    checksum,
    is_numeric,
)
from dynsim.record.scene import Scene
from dynsim.record.writer import CHECKSUM, EVENT_COLUMNS
from dynsim.system.files import check_complete
from dynsim.system.inputs import is_file

_FORMATS = "dynsim-record-"
SIZE_LIMIT = 2 << 30
"""A file may unpack to this many bytes, or to ``RATIO_LIMIT`` times its own size if that is more."""
RATIO_LIMIT = 100
_LAST_LINE = re.compile(rb"\ndynsim-sha256:([0-9a-f]{64})\n")
_LAST_LINE_SIZE = 80


def read(path: Path, *, trust: bool = False) -> Content:
    """Read a file.

    Parameters
    ----------
    trust : also read a file whose digest is missing or wrong: one that another program has written or changed

    Raises
    ------
    RecordError
        No such file; damaged, or no record; its digest is missing or wrong and it is not trusted; or it may be of
        another run than the files beside it.
    """
    try:
        if not is_file(path, RecordError):
            part = path.with_suffix(".part")
            hint = f"; the replay that made {part} died: dynsim hw recover {path.parent}" if part.is_file() else ""
            raise RecordError(f"{path}: no such record{hint}")
        check_complete(path)
        with path.open("rb") as stream:
            doubt = _doubt(path, stream)
    except (OSError, ValueError) as error:
        raise RecordError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if doubt and not trust:
        raise RecordError(f"{path}: {doubt}; {_TRUST}")
    return decode(path, path, trust=trust)


_TRUST = "if you know where it comes from, --trust reads it (in Python: Record.load(path, trust=True))"


def _doubt(path: Path, stream: BinaryIO) -> str:
    """Why the bytes may not be those that dynsim wrote, "" when they are.

    Raises
    ------
    RecordError
        It is no HDF5 file.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(size - _LAST_LINE_SIZE, 0))
    found = _LAST_LINE.fullmatch(stream.read())
    stream.seek(0)
    if not stream.read(8).startswith(b"\x89HDF\r\n\x1a\n"):
        raise RecordError(f"{path}: not a readable HDF5 file (it does not begin like one)")
    if found is None:
        return "it has no digest (SHA-256) at its end: it was cut short, or written by another program"
    stream.seek(0)
    actual, left = hashlib.sha256(), size - _LAST_LINE_SIZE
    while left and (block := stream.read(min(left, 1 << 20))):
        actual.update(block)
        left -= len(block)
    if actual.hexdigest().encode("ascii") != found[1]:
        return "damaged, or changed since dynsim wrote it: its bytes do not agree with its digest (SHA-256)"
    return ""


def decode(path: Path, source: Path | BinaryIO, *, trust: bool = False) -> Content:
    """What an HDF5 file holds, checked part by part.

    Parameters
    ----------
    path : its name, for messages
    source : the file, or its bytes
    trust : whether the content may differ from its checksum

    Raises
    ------
    RecordError
        With file and reason.
    """
    import h5py

    try:
        size = source.stat().st_size if isinstance(source, Path) else source.seek(0, os.SEEK_END)
        with h5py.File(source, "r") as file:
            return _Reader(file, size).content(trust)
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from error
    except MemoryError as error:
        raise RecordError(f"{path}: too large for the memory") from error
    # Damaged files make h5py raise almost anything.
    except Exception as error:
        text = str(error).strip("'\"").splitlines() or [type(error).__name__]
        raise RecordError(f"{path}: not a readable HDF5 file ({text[0]})") from error


def _allowed(size: int) -> int:
    """How many bytes a file of this size may unpack to."""
    return max(SIZE_LIMIT, RATIO_LIMIT * size)


class _Reader:
    """Reads an open file; its errors do not name it."""

    def __init__(self, file: Any, size: int) -> None:
        self._file = file
        self._size = size
        self._left = _allowed(size)

    def content(self, trust: bool) -> Content:
        import h5py

        file = self._file
        found = self._attribute(file, "format")
        if not isinstance(found, str) or not found.startswith(_FORMATS):
            raise RecordError(f"an HDF5 file, but not a dynsim record ({FORMAT})")
        if found != FORMAT:
            raise RecordError(f"a record of another format, {shown(found)}; this version of dynsim reads {FORMAT}")
        complete = self._attribute(file, "complete")
        if complete is None:
            raise RecordError("a dynsim record that lacks parts: no attribute complete")
        if not isinstance(complete, (bool, np.bool_)):
            raise RecordError("attribute complete is neither true nor false")
        time = self._numbers(self._child(file, "time", "time", h5py.Dataset), "time")
        check_time(time)
        axes = self._axes()
        samples = {TIME: len(time), **{name: len(times) for name, times in axes.items()}}
        texts = [self._text(name) for name in ("summary", "provenance")]
        summary, provenance = self._mapping("summary", texts[0]), self._mapping("provenance", texts[1])
        drawn = self._text("scene") if "scene" in file else ""
        scene = Scene.from_json(drawn) if drawn else None
        signals = {}
        if "signals" in file:
            group = self._child(file, "signals", "group signals", h5py.Group)
            for name in group:
                what = f"signal {name!r}"
                data = self._child(group, name, what, h5py.Dataset)
                one = Signal(
                    self._numbers(data, what),
                    self._string(data, "unit", what),
                    self._labels(data, name, what),
                    self._string(data, "description", what),
                    self._string(data, "axis", what) if "axis" in data.attrs else TIME,
                )
                check_signal(name, one, samples)
                signals[name] = one
        content = Content(time, signals, summary, provenance, bool(complete), axes, self._events(), scene)
        wanted = self._attribute(file, CHECKSUM)
        if not trust and not (isinstance(wanted, str) and wanted == checksum(content, texts[0], texts[1], drawn)):
            raise RecordError(f"damaged, or changed since: its content does not agree with its checksum; {_TRUST}")
        return replace(
            content,
            time=_native(time).astype(np.float64, copy=False),
            signals={name: replace(one, data=_native(one.data)) for name, one in signals.items()},
            axes={name: _native(times).astype(np.float64, copy=False) for name, times in axes.items()},
        )

    def _axes(self) -> dict[str, NDArray[Any]]:
        """Further time axes."""
        import h5py

        if "axes" not in self._file:
            return {}
        found = {}
        group = self._child(self._file, "axes", "group axes", h5py.Group)
        for name in group:
            what = f"time axis {name!r}"
            found[name] = self._numbers(self._child(group, name, what, h5py.Dataset), what)
            check_time(found[name], what)
        if TIME in found:
            raise RecordError(f"{TIME} is the name of the record's own axis")
        return found

    def _events(self) -> list[Event]:
        import h5py

        if "events" not in self._file:
            return []
        group = self._child(self._file, "events", "group events", h5py.Group)
        columns: dict[str, list[Any]] = {}
        for name, kind in EVENT_COLUMNS.items():
            what = f"{name} of the events"
            data = self._child(group, name, what, h5py.Dataset)
            texts = kind is str
            columns[name] = list(self._column(data, "events", name) if texts else self._numbers(data, what).ravel())
            if len(columns[name]) != len(columns["time"]):
                raise RecordError(f"{what} has {len(columns[name])} entries, their times {len(columns['time'])}")
        columns["value"] = [None if np.isnan(value) else float(value) for value in columns["value"]]
        columns["time"] = [float(time) for time in columns["time"]]
        if not all(map(math.isfinite, columns["time"])):
            raise RecordError("time of the events is not finite")
        return [Event(*entries) for entries in zip(*(columns[name] for name in EVENT_COLUMNS), strict=True)]

    def _child(self, parent: Any, name: str, what: str, kind: type) -> Any:
        """A group or data set that lies in the file itself."""
        import h5py

        link = parent.get(name, getlink=True)
        if link is None:
            raise RecordError(f"a dynsim record that lacks parts: no {what}")
        if not isinstance(link, h5py.HardLink):
            raise RecordError(f"{what} is a link to somewhere else; links are not followed")
        found = parent[name]
        if not isinstance(found, kind):
            raise RecordError(f"{what} is no {'group' if kind is h5py.Group else 'data set'}")
        return found

    def _numbers(self, data: Any, what: str) -> NDArray[Any]:
        """An array of real numbers."""
        dtype = data.dtype
        if not is_numeric(dtype):
            raise RecordError(f"{what} holds {dtype}, not real numbers")
        self._check_storage(data, what)
        return np.asarray(data[()])

    def _check_storage(self, data: Any, what: str) -> None:
        """Refuse what lies outside of the file, and sizes that are not there or beyond the limit."""
        import h5py

        properties = data.id.get_create_plist()
        if properties.get_external_count() or data.is_virtual:
            raise RecordError(f"{what} lies in other files, which are not opened")
        if data.shape is None:
            raise RecordError(f"{what} is empty")
        filters = [properties.get_filter(k)[0] for k in range(properties.get_nfilters())]
        if filters not in ([], [h5py.h5z.FILTER_DEFLATE]):
            raise RecordError(
                f"{what} is packed in a way (HDF5 filters {filters}) that dynsim does not read; gzip it does"
            )
        size, stored = math.prod(data.shape) * data.dtype.itemsize, data.id.get_storage_size()
        if stored > self._size or (size > stored and not filters):
            raise RecordError(f"{what} claims {size} bytes, but the file ({self._size} bytes) holds {stored} of them")
        self._left -= size
        if self._left < 0:
            raise RecordError(
                f"{what} would unpack to {size} bytes; a file of {self._size} bytes may unpack to "
                f"{_allowed(self._size)} in all"
            )

    def _text(self, name: str) -> str:
        """A long text, kept as a data set."""
        import h5py

        data = self._child(self._file, name, name, h5py.Dataset)
        if h5py.check_string_dtype(data.dtype) is None or data.shape != ():
            raise RecordError(f"{name} is not a text")
        self._check_storage(data, name)
        return str(data.asstr()[()])

    def _mapping(self, name: str, text: str) -> dict[str, Any]:
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise RecordError(f"{name} is not JSON ({error})") from error
        if not isinstance(found, dict):
            raise RecordError(f"{name} is {type(found).__name__}, not a mapping")
        return found

    def _attribute(self, owner: Any, name: str) -> Any:
        """An attribute of a size that fits the file, None if there is none."""
        if name not in owner.attrs:
            return None
        identifier = owner.attrs.get_id(name)
        if math.prod(identifier.shape or ()) * identifier.dtype.itemsize > self._size:
            raise RecordError(f"attribute {name} claims more bytes than the file has")
        return owner.attrs[name]

    def _string(self, owner: Any, name: str, what: str) -> str:
        value = self._attribute(owner, name)
        if isinstance(value, bytes):
            value = value.decode("utf-8")
        if not isinstance(value, str):
            raise RecordError(f"{what} has no text as {name}")
        return value

    def _labels(self, data: Any, name: str, what: str) -> tuple[str, ...]:
        import h5py

        if "labels" in data.attrs:
            return _texts(np.asarray(self._attribute(data, "labels")), f"{what} has labels")
        if "labels" not in self._file:
            raise RecordError(f"a dynsim record that lacks parts: no labels of {what}")
        kept = self._child(self._file, "labels", "group labels", h5py.Group)
        return self._column(self._child(kept, name, f"labels of {what}", h5py.Dataset), what, "labels")

    def _column(self, data: Any, what: str, name: str) -> tuple[str, ...]:
        """Texts, kept as a data set."""
        import h5py

        if h5py.check_string_dtype(data.dtype) is None:
            raise RecordError(f"{what} has {name} that are no texts")
        self._check_storage(data, f"{name} of {what}")
        return _texts(np.asarray(data[()]), f"{what} has {name}")


def _texts(found: NDArray[Any], what: str) -> tuple[str, ...]:
    if found.ndim != 1:
        raise RecordError(f"{what} that are no list")
    texts = tuple(text.decode("utf-8") if isinstance(text, bytes) else text for text in found.tolist())
    if not all(isinstance(text, str) for text in texts):
        raise RecordError(f"{what} that are no texts")
    return texts


def _native(array: NDArray[Any]) -> NDArray[Any]:
    """In the byte order of this machine."""
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
