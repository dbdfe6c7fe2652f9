"""The record: signals over time with units, events, scene, summary and provenance; loaded from and saved as HDF5.

A record does not depend on the engine that made it: simulated and measured runs have the same form.
"""

from __future__ import annotations

import bisect
import difflib
import html
import importlib
import math
import os
from collections.abc import Iterable, Iterator, KeysView, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.errors import MissingEntry, RecordError, brief
from dynsim.record import export, reader
from dynsim.record.content import TIME, Content, Event, Signal, check_name, check_signal, check_time
from dynsim.record.scene import Scene
from dynsim.system.files import replacing

if TYPE_CHECKING:
    import pandas
    import xarray

# HTML tables by which notebooks display objects.


def table(title: str, rows: Iterable[tuple[object, ...]], more: str = "") -> str:
    """HTML of a table with its title; the first cell of a row names it. ``more`` follows as it is."""
    lines = "".join(
        f'<tr><th style="text-align:left">{html.escape(str(first))}</th>'
        + "".join(f'<td style="text-align:left">{html.escape(str(cell))}</td>' for cell in cells)
        + "</tr>"
        for first, *cells in rows
    )
    return f"<div><b>{html.escape(title)}</b><table>{lines}</table>{more}</div>"


# Number of signals that the repr names.
_SHOWN = 6


class Entries(dict[str, Any]):
    """A mapping whose error for a missing entry names it and those that it has."""

    def __init__(self, kind: str, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self._what = kind

    def __missing__(self, key: object) -> Any:
        raise MissingEntry(f"no {self._what} {brief(key)}; this record has: {', '.join(self) or 'none'}")


class Record:
    """Signals of one run, what happened in it, and what it looked like.

    ``record["q"]`` is the array, ``record.units["q"]`` its unit, ``record.labels["q"]`` its column names,
    ``record.times("q")`` its instants: those of ``time``, or of one of the further time axes ``axes``. ``events`` are
    in the order of their times; ``scene`` (None: not known) is what figures and viewers draw.

    ``summary`` holds the numbers of ``summary.json``; ``provenance`` says what made the record (resolved scenario,
    version, commit, libraries). ``complete`` is False when the run was interrupted or stopped.
    """

    def __init__(self, time: ArrayLike, *, provenance: Mapping[str, Any] | None = None) -> None:
        self.time: NDArray[np.float64] = np.asarray(time, dtype=np.float64)
        self.signals: dict[str, Signal] = {}
        self.summary = {}
        self.provenance = provenance or {}
        self.complete = True
        self.axes: dict[str, NDArray[np.float64]] = {}
        self.events: list[Event] = []
        self.scene: Scene | None = None

    def add(
        self,
        name: str,
        data: ArrayLike,
        unit: str,
        *,
        labels: tuple[str, ...] = (),
        description: str = "",
        axis: str = TIME,
    ) -> None:
        """Add a signal; its first axis is time, its second (if any) is named by ``labels``.

        ``axis`` is the name of its time axis: that of the record, or one that :meth:`add_axis` has added.

        Raises
        ------
        RecordError
            No real numbers, no such time axis, another number of samples than that has, or of labels than columns.
        """
        if name in self.axes:
            raise RecordError(f"signal {name!r}: a time axis has that name")
        signal = Signal(np.asarray(data), unit, tuple(labels), description, axis)
        samples = {TIME: len(self.time), **{axis: len(times) for axis, times in self.axes.items()}}
        check_signal(name, signal, samples)
        self.signals[name] = signal

    def add_axis(self, name: str, times: ArrayLike) -> None:
        """Add a further time axis [s], for signals that have instants of their own.

        Raises
        ------
        RecordError
            The name is taken, or the times are not finite or run backwards.
        """
        check_name("time axis", name)
        if name == TIME or name in self.axes or name in self.signals:
            raise RecordError(f"the name {name!r} is taken by another time axis or by a signal")
        axis = np.asarray(times, dtype=np.float64)
        check_time(axis, f"time axis {name!r}")
        self.axes[name] = axis

    def times(self, name: str) -> NDArray[np.float64]:
        """Instants of a signal's samples, (T,) [s].

        Raises
        ------
        MissingEntry
            No such signal.
        """
        axis = self._signal(name).axis
        return self.time if axis == TIME else self.axes[axis]

    def add_event(
        self, time: float, kind: str, name: str = "", *, value: float | None = None, description: str = ""
    ) -> None:
        """Add what happened at an instant [s], see :class:`Event`; events stay in the order of their times.

        Raises
        ------
        RecordError
            The time is not finite.
        """
        if not math.isfinite(time):
            raise RecordError(f"event {kind!r} at {time} s: the time must be finite")
        number = None if value is None or math.isnan(value) else float(value)
        event = Event(float(time), kind, name, number, description)
        bisect.insort(self.events, event, key=lambda entry: entry.time)

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._signal(name).data

    def _signal(self, name: str) -> Signal:
        if not isinstance(name, str) or name not in self.signals:
            near = difflib.get_close_matches(str(name), self.signals, 1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise MissingEntry(f"no signal {brief(name)}{hint}; this record has: {', '.join(self.signals) or 'none'}")
        return self.signals[name]

    def __repr__(self) -> str:
        title = self.title
        span = f", {self.time[0]:g} to {self.time[-1]:g} s" if len(self) else ""
        first = ", ".join(list(self.signals)[:_SHOWN]) + (", …" if len(self.signals) > _SHOWN else "")
        parts = [f"{len(self)} samples{span}", f"{len(self.signals)} signals{f' ({first})' if first else ''}"]
        parts += [f"{len(self.events)} event{'s' if len(self.events) > 1 else ''}"] if self.events else []
        parts += [] if self.complete else ["incomplete"]
        return f"<Record {f'{title}: ' if title else ''}{', '.join(parts)}>"

    def _repr_html_(self) -> str:
        rows = [
            (name, "×".join(map(str, signal.data.shape)), signal.unit, signal.description)
            for name, signal in self.signals.items()
        ]
        hint = "" if self.scene is None else "<p><code>record.view()</code> shows it in 3D.</p>"
        return table(repr(self)[1:-1], rows, hint)

    def view(self, *others: Record, ghost: bool = False, height: int = 640) -> Any:
        """A page that shows the run in 3D, with plots over time; notebooks show it inline.

        Parameters
        ----------
        others : records that are shown beside this one, or laid over it
        ghost : others are laid over this one
        height : of the frame in a notebook [pixel]

        Raises
        ------
        RecordError
            See :func:`dynsim.view.page`.
        """
        # By name: pictures know records, not the other way round.
        page = importlib.import_module("dynsim.draw.page")
        named: dict[str, Record] = {}
        for record in (self, *others):
            name = str(record.summary.get("variant") or "record")
            named[name if name not in named else f"{name} {len(named) + 1}"] = record
        return page.Inline(page.page(named, ghost=ghost), height)

    def keys(self) -> KeysView[str]:
        """Names of the signals."""
        return self.signals.keys()

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def __iter__(self) -> Iterator[str]:
        return iter(self.signals)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def title(self) -> str:
        """Scenario and variant, or the robot of a measured run; "" where neither is known."""
        scenario, robot = self.provenance.get("scenario"), self.provenance.get("robot")
        names = [scenario.get("name"), scenario.get("variant")] if isinstance(scenario, Mapping) else []
        return " / ".join(str(name) for name in names if name) or (f"{robot}, measured" if robot else "")

    @property
    def units(self) -> dict[str, str]:
        """Unit of every signal."""
        return Entries("signal", {name: signal.unit for name, signal in self.signals.items()})

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Column names of every signal."""
        return Entries("signal", {name: signal.labels for name, signal in self.signals.items()})

    @property
    def summary(self) -> dict[str, Any]:
        """The numbers of ``summary.json``."""
        return self._summary

    @summary.setter
    def summary(self, entries: Mapping[str, Any]) -> None:
        self._summary = _entries("summary", entries)

    @property
    def provenance(self) -> dict[str, Any]:
        """What made the record: resolved scenario, version, commit, libraries."""
        return self._provenance

    @provenance.setter
    def provenance(self, entries: Mapping[str, Any]) -> None:
        self._provenance = _entries("provenance", entries)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write HDF5 to ``path``: complete or not at all (see :func:`dynsim.system.files.replacing`).

        Raises
        ------
        RecordError
            The file cannot be written (no space, no permission); an older file at ``path`` is left as it was. Or the
            time axis runs backwards or is not finite.
        """
        path = Path(path)
        content = self.to_hdf5()
        with replacing(path, durable=True) as stream:
            stream.write(content)
        return path

    def to_hdf5(self) -> memoryview:
        """The bytes of the file that :meth:`save` writes."""
        return reader.encode(self._content())

    def _content(self) -> Content:
        return Content(
            time=self.time,
            signals=self.signals,
            summary=self.summary,
            provenance=self.provenance,
            complete=self.complete,
            axes=self.axes,
            events=self.events,
            scene=self.scene,
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, trust: bool = False) -> Record:
        """Read a record written by :meth:`save`.

        Parameters
        ----------
        trust : also read a file whose digest is missing or wrong: one that another program has written or changed.
            Its types, sizes and times are checked as ever.

        Raises
        ------
        RecordError
            No such file, damaged, not a dynsim record, or its digest is missing or wrong and it is not trusted; or it
            lies beside the file ``INCOMPLETE`` of a run that died while it was saved. The message has file and reason.
        """
        content = reader.read(Path(path), trust=trust)
        record = cls(content.time, provenance=content.provenance)
        record.signals.update(content.signals)
        record.summary.update(content.summary)
        record.complete = content.complete
        record.axes.update(content.axes)
        record.events.extend(content.events)
        record.scene = content.scene
        return record

    def to_dataframe(self, axis: str = TIME) -> pandas.DataFrame:
        """A pandas DataFrame of the signals on one time axis, see :func:`dynsim.record.export.to_dataframe`."""
        return export.to_dataframe(self._content(), axis)

    def to_xarray(self) -> xarray.Dataset:
        """An xarray Dataset of all signals, see :func:`dynsim.record.export.to_xarray`."""
        return export.to_xarray(self._content())


def _entries(kind: str, entries: Mapping[str, Any]) -> Entries:
    if not isinstance(entries, Mapping):
        raise RecordError(f"the {kind} of a record is a mapping of names to values, not {brief(entries)}")
    return Entries(f"entry of the {kind}", entries)
