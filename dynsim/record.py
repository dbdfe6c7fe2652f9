"""Columnar signals over time, with units and provenance; HDF5 in and out.

A record knows nothing of the engine that made it: simulated and measured runs look the same.
"""

from __future__ import annotations

import difflib
import importlib
import json
import os
from collections.abc import Iterator, KeysView, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim import record_file
from dynsim.errors import MissingEntry, RecordError, shown
from dynsim.files import replacing
from dynsim.record_file import FORMAT, Signal

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["FORMAT", "Record", "Signal"]

# Signals named in the repr.
_SHOWN = 6


class Entries(dict[str, Any]):
    """A mapping that says in words which entry it does not have."""

    def __init__(self, what: str, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self._what = what

    def __missing__(self, key: object) -> Any:
        raise MissingEntry(f"no {self._what} {shown(key)}; this record has: {', '.join(self) or 'none'}")


class Record:
    """Signals of one run on one time axis.

    ``record["q"]`` is the array, ``record.units["q"]`` its unit, ``record.labels["q"]`` its column names.
    ``summary`` holds the numbers of ``summary.json``; ``provenance`` says what made the record (resolved scenario,
    version, commit, libraries). ``complete`` is False when the run was interrupted or stopped.
    """

    def __init__(self, time: ArrayLike, *, provenance: Mapping[str, Any] | None = None) -> None:
        self.time: NDArray[np.float64] = np.asarray(time, dtype=np.float64)
        self.signals: dict[str, Signal] = {}
        self.summary = {}
        self.provenance = provenance or {}
        self.complete = True

    def add(
        self, name: str, data: ArrayLike, unit: str, *, labels: tuple[str, ...] = (), description: str = ""
    ) -> None:
        """Add a signal; its first axis is time, its second (if any) is named by ``labels``.

        Raises
        ------
        RecordError
            No real numbers, another number of samples than the record has, or of labels than columns.
        """
        signal = Signal(np.asarray(data), unit, tuple(labels), description)
        record_file.check_signal(name, signal, len(self.time))
        self.signals[name] = signal

    def __getitem__(self, name: str) -> NDArray[Any]:
        if not isinstance(name, str) or name not in self.signals:
            near = difflib.get_close_matches(str(name), self.signals, 1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise MissingEntry(f"no signal {shown(name)}{hint}; this record has: {', '.join(self.signals) or 'none'}")
        return self.signals[name].data

    def __repr__(self) -> str:
        scenario = self.provenance.get("scenario")
        names = [scenario.get("name"), scenario.get("variant")] if isinstance(scenario, Mapping) else []
        title = " / ".join(str(name) for name in names if name)
        span = f", {self.time[0]:g} to {self.time[-1]:g} s" if len(self) else ""
        first = ", ".join(list(self.signals)[:_SHOWN]) + (", …" if len(self.signals) > _SHOWN else "")
        parts = [f"{len(self)} samples{span}", f"{len(self.signals)} signals{f' ({first})' if first else ''}"]
        parts += [] if self.complete else ["incomplete"]
        return f"<Record {f'{title}: ' if title else ''}{', '.join(parts)}>"

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
        """Write HDF5 to ``path``: complete or not at all (see :func:`dynsim.files.replacing`).

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
        return record_file.encode(
            record_file.Content(self.time, self.signals, self.summary, self.provenance, self.complete)
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Record:
        """Read a record written by :meth:`save`. What lies in the file is checked, not believed.

        Raises
        ------
        RecordError
            No such file, damaged, or not a dynsim record; or it lies beside the file ``INCOMPLETE`` of a run that died
            while it was saved. The message has the file and the reason.
        """
        content = record_file.read(Path(path))
        record = cls(content.time, provenance=content.provenance)
        record.signals.update(content.signals)
        record.summary.update(content.summary)
        record.complete = content.complete
        return record

    def to_dataframe(self) -> pandas.DataFrame:
        """A pandas DataFrame: time [s] is the index, every column of every signal a column.

        Columns are called ``signal``, ``signal.label`` or, of vectors, ``signal.label.x``; their units are in
        ``attrs["units"]``.

        Raises
        ------
        RecordError
            pandas is not installed.
        """
        pandas = _optional("pandas")
        columns, names, units = [], [], {}
        for name, signal in self.signals.items():
            for column in np.ndindex(signal.data.shape[1:]):
                parts = [name]
                if column:
                    parts.append(signal.labels[column[0]])
                    parts += [_axes(signal.data.shape[2])[k] for k in column[1:]]
                names.append(".".join(parts))
                columns.append(signal.data[:, *column])
                units[names[-1]] = signal.unit
        frame = (
            pandas.concat([pandas.Series(column) for column in columns], axis=1, keys=names)
            if columns
            else pandas.DataFrame(index=range(len(self)))
        )
        frame.index = pandas.Index(self.time, name="time [s]")
        frame.attrs["units"] = units
        return frame

    def to_xarray(self) -> xarray.Dataset:
        """An xarray Dataset: signals over ``time``, with ``units`` and ``long_name`` as attributes.

        Signals with the same labels share a dimension, which is called after the first of them (``q_label``); the third
        axis of vectors is ``axis`` (x, y, z). Summary and provenance are attributes, as JSON.

        Raises
        ------
        RecordError
            xarray is not installed.
        """
        xarray = _optional("xarray")
        dimensions: dict[tuple[str, ...], str] = {}
        coordinates: dict[str, Any] = {"time": ("time", self.time, {"units": "s"})}
        variables = {}
        for name, signal in self.signals.items():
            axes = ["time"]
            if signal.data.ndim > 1:
                label = dimensions.setdefault(signal.labels, f"{name}_label")
                coordinates[label] = list(signal.labels)
                axes.append(label)
            if signal.data.ndim > 2:
                count = signal.data.shape[2]
                axis = "axis" if count == 3 else f"axis_{count}"
                coordinates[axis] = list(_axes(count))
                axes.append(axis)
            variables[name] = (axes, signal.data, {"units": signal.unit, "long_name": signal.description})
        attributes = {
            "complete": int(self.complete),
            "summary": json.dumps(self.summary),
            "provenance": json.dumps(self.provenance, default=str),
        }
        return xarray.Dataset(variables, coordinates, attributes)


def _axes(count: int) -> Sequence[str]:
    """Names of the components of a vector."""
    return "xyz" if count == 3 else [str(k) for k in range(count)]


def _optional(package: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise RecordError(f"{package} is not installed: pip install {package}") from error


def _entries(what: str, entries: Mapping[str, Any]) -> Entries:
    if not isinstance(entries, Mapping):
        raise RecordError(f"the {what} of a record is a mapping of names to values, not {shown(entries)}")
    return Entries(f"entry of the {what}", entries)
