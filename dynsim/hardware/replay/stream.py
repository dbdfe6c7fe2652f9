"""Writing on threads of their own: a disk that is full or slow, a terminal that is held: neither touches the loop.

What is told is kept in memory by the loop, which waits for nobody; a thread takes it from there to a file or a display.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from dynsim.hardware.replay.rows import Layout, RowMemory
from dynsim.record.scene import Scene
from dynsim.system.files import lock

INTERVAL = 0.5
"""Between two writes of what has come since [s]: a process that is killed loses no more than this."""
PATIENCE = 5.0
"""Longest wait for a file or display that does not come back, after the run [s]."""
PART = "measured.part"
"""Name of the file that grows during a run; the measured record takes its place at the end."""
PART_FORMAT = 1


class GrowingFile:
    """A file that can be read while it grows; nobody else's, and held until it is closed.

    See :func:`dynsim.system.files.lock`.

    Attributes
    ----------
    path : Path

    Raises
    ------
    OSError
        It cannot be made, or is there already.
    """

    def __init__(self, path: Path) -> None:
        # Not buffered: what a buffer still holds would be tried again, and fail again, when it is closed.
        self.path = path
        self._stream = path.open("xb", buffering=0)
        try:
            lock(self._stream.fileno(), wait=False)
        except OSError:
            self.discard()
            raise

    def append(self, data: bytes) -> None:
        """Raises OSError."""
        left = memoryview(data)
        while left:
            left = left[self._stream.write(left) or 0 :]

    def sync(self) -> None:
        """Wait until the disk has it. Raises OSError."""
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Raises OSError."""
        self._stream.close()

    def discard(self) -> None:
        """Close and remove it: the run that it was made for does not begin."""
        with suppress(OSError):
            self._stream.close()
        with suppress(OSError):
            self.path.unlink()


class RowStream:
    """The rows of a replay on their way to ``measured.part``: one line of JSON, then rows as they lie in memory.

    Parameters
    ----------
    path : path
    rows : RowMemory
    layout : Layout
    scene : Scene or None
        Of the replayed record.

    Raises
    ------
    OSError
        The file cannot be made, or its first line not be written.
    """

    name = "streamed record"

    def __init__(self, path: Path, rows: RowMemory, layout: Layout, scene: Scene | None) -> None:
        self.failure: Exception | None = None
        self._rows = rows
        self._written = 0
        header = {
            "format": PART_FORMAT,
            "row": rows.type.descr,
            "layout": vars(layout),
            "scene": scene.to_json() if scene else "",
        }
        self._file = GrowingFile(path)
        try:
            self._file.append(json.dumps(header, default=str).encode("utf-8") + b"\n")
        except BaseException:
            self._file.discard()
            raise

    def discard(self) -> None:
        self._file.discard()

    def pump(self) -> None:
        rows = self._rows.since(self._written)
        if rows:
            self._written += len(rows) // self._rows.type.itemsize
            self._file.append(rows)
            self._file.sync()

    def close(self) -> None:
        self._file.close()


class Outlet(Protocol):
    """Something that takes what the loop has left in memory to where it can be seen."""

    name: str
    failure: Exception | None

    def pump(self) -> None:
        """Take what has come since the last call. May raise: then it is not called again."""
        ...

    def close(self) -> None:
        """After the last call of ``pump``, also after one that failed."""
        ...


class Background:
    """A thread that pumps outlets, at least every ``interval`` [s] and whenever it is woken.

    Raises
    ------
    RuntimeError
        The system gives no thread; the outlets are closed.
    """

    def __init__(self, outlets: Sequence[Outlet], interval: float) -> None:
        self._outlets = outlets
        self._interval = interval
        self._woken = threading.Event()
        self._ending = False
        self._at_work: Outlet | None = None
        # Not waited for when Python ends: a terminal may be held for ever.
        self._thread = threading.Thread(target=self._run, name="dynsim outlets", daemon=True)
        try:
            self._thread.start()
        except BaseException:
            self._close_outlets()
            raise

    def wake(self) -> None:
        self._woken.set()

    def close(self, patience: float = PATIENCE) -> dict[str, Exception]:
        """Pump once more and end; the first error of every outlet that failed, by name.

        Parameters
        ----------
        patience : longest wait [s]; an outlet that does not come back in this time has failed with a TimeoutError
        """
        self._ending = True
        self.wake()
        self._thread.join(patience)
        failures = {outlet.name: outlet.failure for outlet in self._outlets if outlet.failure is not None}
        stuck = self._at_work
        if self._thread.is_alive() and stuck is not None:
            failures.setdefault(stuck.name, TimeoutError(f"does not answer for {patience:g} s"))
        return failures

    def _run(self) -> None:
        while not self._ending:
            self._woken.wait(self._interval)
            self._woken.clear()
            self._each("pump")
        self._each("pump")
        self._close_outlets()

    def _each(self, method: str) -> None:
        for outlet in self._outlets:
            if outlet.failure is None:
                self._guard(outlet, method)
        self._at_work = None

    def _close_outlets(self) -> None:
        for outlet in self._outlets:
            self._guard(outlet, "close")
        self._at_work = None

    def _guard(self, outlet: Any, method: str) -> None:
        self._at_work = outlet
        try:
            getattr(outlet, method)()
        except Exception as error:
            outlet.failure = outlet.failure or error
