"""Record of a run: signals over time with units, events, scene, summary and provenance; loaded from and saved as HDF5.

A record does not depend on the engine that created it: records of simulated and measured runs have the same form.
"""

from __future__ import annotations

import bisect
import difflib
import html
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
from dynsim.record.quaternion import Array
from dynsim.record.scene import Scene
from dynsim.system.arguments import names_wrong_types
from dynsim.system.files import replacing

if TYPE_CHECKING:
    import pandas
    import xarray


def table(title: str, rows: Iterable[tuple[object, ...]], more: str = "") -> str:
    """Return an HTML table with a title, for display in notebooks.

    Parameters
    ----------
    title : str
        Title of the table.
    rows : iterable of tuple
        Rows; the first cell is the heading of its row.
    more : str, optional
        HTML to append unchanged.
    """
    lines = "".join(
        f'<tr><th style="text-align:left">{html.escape(str(first))}</th>'
        + "".join(f'<td style="text-align:left">{html.escape(str(cell))}</td>' for cell in cells)
        + "</tr>"
        for first, *cells in rows
    )
    return f"<div><b>{html.escape(title)}</b><table>{lines}</table>{more}</div>"


# Maximum number of signals listed in the repr.
_SHOWN = 6


class Entries(dict[str, Any]):
    """Mapping that raises an error listing the existing keys if a key is missing."""

    def __init__(self, kind: str, entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self._kind = kind

    def __missing__(self, key: object) -> Any:
        raise MissingEntry(f"no {self._kind} {brief(key)}; this record has: {', '.join(self) or 'none'}")


@names_wrong_types
class Record(Content):
    """Results of one run: signals with units, events, scene and provenance.

    ``record["q"]`` is the array of a signal, and ``record.times("q")`` returns its sample times; iteration yields the
    signal names, and ``len(record)`` is the number of samples on the main time axis.

    Parameters
    ----------
    time : array_like, shape (T,)
        Times of the samples [s].
    provenance : mapping, optional
        Origin of the record: resolved scenario, version, commit, libraries.

    Attributes
    ----------
    time : (T,) ndarray
        Times of the main time axis [s].
    axes : dict of str to (K,) ndarray
        Additional time axes [s], for signals that are sampled at other times.
    signals : dict of str to Signal
        Signals by name.
    events : list of Event
        Events, sorted by time.
    scene : Scene or None
        Geometry for figures and viewers, if known.
    complete : bool
        False if the run was interrupted or stopped early.

    Raises
    ------
    RecordError
        If ``provenance`` is not a mapping.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("elbow_comparison", variant="two_elbows", overrides={"duration_s": 0.1})
    >>> record = dynsim.simulate(scenario)
    >>> record["q"].shape, record.units["q"], record.labels["q"][0]
    ((21, 10), 'rad', 'joint_1')
    >>> record.complete, record.title
    (True, 'elbow_comparison / two_elbows')
    """

    def __init__(self, time: ArrayLike, *, provenance: Mapping[str, Any] | None = None) -> None:
        self.time: Array = np.asarray(time, dtype=np.float64)
        self.signals: dict[str, Signal] = {}
        self.summary = {}
        self.provenance = provenance or {}
        self.complete = True
        self.axes: dict[str, Array] = {}
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
        """Add a signal.

        Parameters
        ----------
        name : str
            Name of the signal; an existing signal of this name is replaced.
        data : array_like, shape (T,), (T, k) or (T, k, m)
            Real numbers; the first axis is time.
        unit : str
            SI unit, "1" for dimensionless numbers.
        labels : tuple of str, optional
            Names of the k columns.
        description : str, optional
            Short description.
        axis : str, optional
            Name of the time axis; default: the main time axis. :meth:`add_axis` adds other axes.

        Raises
        ------
        RecordError
            If a time axis already has this name, the time axis does not exist, the data are not real numbers, or the
            number of samples or labels is wrong.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 0.5, 1.0])
        >>> record.add("q", [[0.1, 0.2], [0.1, 0.3], [0.1, 0.4]], "rad", labels=("shoulder", "elbow"))
        >>> record["q"].shape
        (3, 2)
        """
        if name in self.axes:
            raise RecordError(f"signal {name!r}: a time axis already has this name")
        signal = Signal(np.asarray(data), unit, tuple(labels), description, axis)
        samples = {TIME: len(self.time), **{axis: len(times) for axis, times in self.axes.items()}}
        check_signal(name, signal, samples)
        self.signals[name] = signal

    def add_axis(self, name: str, times: ArrayLike) -> None:
        """Add a time axis for signals that are sampled at other times.

        Parameters
        ----------
        name : str
            Name of the time axis.
        times : array_like, shape (K,)
            Times [s], not decreasing.

        Raises
        ------
        RecordError
            If the name is already in use, or the times are not finite or run backwards.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 0.5, 1.0])
        >>> record.add_axis("camera", [0.2, 0.7])
        >>> record.add("marker", [1.0, 1.1], "m", axis="camera")
        """
        check_name("time axis", name)
        if name == TIME or name in self.axes or name in self.signals:
            raise RecordError(f"the name {name!r} is already used by a time axis or a signal")
        axis = np.asarray(times, dtype=np.float64)
        check_time(axis, f"time axis {name!r}")
        self.axes[name] = axis

    def times(self, name: str) -> Array:
        """Return the sample times of a signal.

        Parameters
        ----------
        name : str
            Name of the signal.

        Returns
        -------
        (T,) ndarray
            Times [s].

        Raises
        ------
        MissingEntry
            If the record has no such signal.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 0.5, 1.0])
        >>> record.add("voltage", [12.0, 11.9, 11.8], "V")
        >>> record.times("voltage")
        array([0. , 0.5, 1. ])
        """
        axis = self._signal(name).axis
        return self.time if axis == TIME else self.axes[axis]

    def add_event(
        self, time: float, kind: str, name: str = "", *, value: float | None = None, description: str = ""
    ) -> None:
        """Add an event; events are kept sorted by time.

        Parameters
        ----------
        time : float
            Time [s].
        kind : str
            Kind of the event, such as "contact opens".
        name : str, optional
            Name of the contact, joint or other part that the event concerns; default: the whole run.
        value : float, optional
            Associated number in SI units; NaN counts as None.
        description : str, optional
            Short description.

        Raises
        ------
        RecordError
            If the time is not finite.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 1.0])
        >>> record.add_event(0.4, "contact opens", "elbow_4")
        >>> record.events[0].name
        'elbow_4'
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
        hint = "" if self.scene is None else "<p><code>dynsim.view.show(record)</code> shows it in 3D.</p>"
        return table(repr(self)[1:-1], rows, hint)

    def keys(self) -> KeysView[str]:
        """Return the names of the signals.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 1.0])
        >>> record.add("voltage", [12.0, 11.9], "V")
        >>> list(record.keys())
        ['voltage']
        """
        return self.signals.keys()

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def __iter__(self) -> Iterator[str]:
        return iter(self.signals)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def title(self) -> str:
        """Scenario and variant, or the robot of a measured run; "" if neither is known."""
        names, robot = [self.scenario_name, self._scenario.get("variant")], self.provenance.get("robot")
        return " / ".join(str(name) for name in names if name) or (f"{robot}, measured" if robot else "")

    @property
    def scenario_name(self) -> str:
        """Name of the scenario; "" if unknown."""
        return str(self._scenario.get("name") or "")

    @property
    def measured(self) -> bool:
        """Whether the record was measured on servos."""
        return "scenario" not in self.provenance or "q_goal" in self

    @property
    def settle_time(self) -> float:
        """Time before which tracking errors are not evaluated [s]; 0 if unknown."""
        metrics = self._scenario.get("metrics")
        return float(metrics.get("settle_s", 0.0)) if isinstance(metrics, Mapping) else 0.0

    @property
    def _scenario(self) -> Mapping[str, Any]:
        """Scenario in the provenance of the record; empty if unknown."""
        scenario = self.provenance.get("scenario")
        return scenario if isinstance(scenario, Mapping) else {}

    @property
    def units(self) -> dict[str, str]:
        """Unit of every signal."""
        return Entries("signal", {name: signal.unit for name, signal in self.signals.items()})

    def unit_of(self, signal: str, label: str) -> str:
        """Return the unit of one column of a signal.

        A signal of revolute and prismatic joints has the unit "rad or m", for example; the scene has the kinds of the
        joints.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 1.0])
        >>> record.add("q", [[0.0], [1.0]], "rad", labels=("elbow",))
        >>> record.unit_of("q", "elbow")
        'rad'
        """
        unit = self.units[signal]
        bodies = () if self.scene is None or " or " not in unit else self.scene.bodies
        kind = next((body.joint.kind for body in bodies if label in body.joint.labels), "")
        units = {"revolute": ("rad", "rad/s", "N m"), "prismatic": ("m", "m/s", "N")}.get(kind, ())
        return next((own for own in unit.split(" or ") if own in units), unit)

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Column names of every signal."""
        return Entries("signal", {name: signal.labels for name, signal in self.signals.items()})

    @property
    def summary(self) -> dict[str, Any]:
        """Entries of ``summary.json``."""
        return self._summary

    @summary.setter
    def summary(self, entries: Mapping[str, Any]) -> None:
        self._summary = _entries("summary", entries)

    @property
    def provenance(self) -> dict[str, Any]:
        """Origin of the record: resolved scenario, version, commit, libraries."""
        return self._provenance

    @provenance.setter
    def provenance(self, entries: Mapping[str, Any]) -> None:
        self._provenance = _entries("provenance", entries)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the record to an HDF5 file atomically.

        Parameters
        ----------
        path : str or path-like
            File to write; an existing file is replaced.

        Returns
        -------
        Path
            The written file.

        Raises
        ------
        RecordError
            If the file cannot be written (no space, no permission); an existing file then remains unchanged. The same
            error is raised if a time axis is not finite or runs backwards.

        Examples
        --------
        >>> import dynsim, pathlib, tempfile
        >>> record = dynsim.Record([0.0, 1.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = record.save(pathlib.Path(folder) / "record.h5")
        >>> path.name
        'record.h5'
        """
        path = Path(path)
        content = self.to_hdf5()
        with replacing(path, durable=True) as stream:
            stream.write(content)
        return path

    def to_hdf5(self) -> memoryview:
        """Return the bytes of the file that :meth:`save` writes.

        Returns
        -------
        memoryview
            Content of the file.

        Raises
        ------
        RecordError
            If a time axis is not finite or runs backwards, or a text cannot be stored in HDF5.

        Examples
        --------
        >>> import dynsim
        >>> bytes(dynsim.Record([0.0, 1.0]).to_hdf5()[1:4])
        b'HDF'
        """
        return reader.encode(self)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, trust: bool = False) -> Record:
        """Read a record written by :meth:`save`.

        Parameters
        ----------
        path : str or path-like
            File to read.
        trust : bool, optional
            Accept a file whose digest is missing or wrong (written or changed by another program). Types, sizes and
            times are checked in any case.

        Returns
        -------
        Record
            The record.

        Raises
        ------
        RecordError
            If the file does not exist, is damaged or is not a record; if its digest is missing or wrong and ``trust``
            is False; or if the file ``INCOMPLETE`` next to it shows that a run crashed while saving. The message
            contains file and reason.

        Examples
        --------
        >>> import dynsim, pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = dynsim.Record([0.0, 1.0]).save(pathlib.Path(folder) / "record.h5")
        ...     record = dynsim.Record.load(path)
        >>> len(record)
        2
        """
        content = reader.read(Path(path), trust=trust)
        record = cls(content.time, provenance=content.provenance)
        for name in ("signals", "summary", "complete", "axes", "events", "scene"):
            setattr(record, name, getattr(content, name))
        return record

    def to_dataframe(self, axis: str = TIME) -> pandas.DataFrame:
        """Convert the signals on one time axis to a pandas DataFrame.

        Parameters
        ----------
        axis : str, optional
            Name of the time axis; default: the main time axis.

        Returns
        -------
        pandas.DataFrame
            Time [s] is the index. Columns are named ``signal``, ``signal.label`` or, for vectors, ``signal.label.x``;
            their units are in ``attrs["units"]``.

        Raises
        ------
        RecordError
            If pandas is not installed.
        MissingEntry
            If the record has no such time axis.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 1.0])
        >>> record.add("q", [[0.1, 0.2], [0.1, 0.3]], "rad", labels=("shoulder", "elbow"))
        >>> list(record.to_dataframe().columns)
        ['q.shoulder', 'q.elbow']
        """
        return export.to_dataframe(self, axis)

    def to_xarray(self) -> xarray.Dataset:
        """Convert all signals to an xarray Dataset.

        Returns
        -------
        xarray.Dataset
            Signals over their time axes, with units and descriptions as attributes; signals with the same labels share
            a dimension. See :func:`dynsim.record.export.to_xarray`.

        Raises
        ------
        RecordError
            If xarray is not installed.

        Examples
        --------
        >>> import dynsim
        >>> record = dynsim.Record([0.0, 1.0])
        >>> record.add("q", [[0.1, 0.2], [0.1, 0.3]], "rad", labels=("shoulder", "elbow"))
        >>> dict(record.to_xarray().sizes)
        {'time': 2, 'q_label': 2}
        """
        return export.to_xarray(self)


def _entries(kind: str, entries: Mapping[str, Any]) -> Entries:
    if not isinstance(entries, Mapping):
        raise RecordError(f"the {kind} of a record must be a mapping of names to values, got {brief(entries)}")
    return Entries(f"entry of the {kind}", entries)
