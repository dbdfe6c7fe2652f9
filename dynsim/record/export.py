"""Conversion of records to pandas tables and xarray data sets."""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dynsim.errors import MissingEntry, RecordError, brief
from dynsim.record.content import TIME, Content

if TYPE_CHECKING:
    import pandas
    import xarray


def to_dataframe(record: Content, axis: str) -> pandas.DataFrame:
    """Convert the signals on one time axis to a pandas DataFrame.

    Parameters
    ----------
    record : Content
        Content of a record.
    axis : str
        Name of the time axis.

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
    """
    pandas = _optional("pandas")
    axes = {TIME: record.time, **record.axes}
    if axis not in axes:
        raise MissingEntry(f"no time axis {brief(axis)}; this record has: {', '.join(axes)}")
    times = axes[axis]
    columns, names, units = [], [], {}
    for name, signal in record.signals.items():
        for column in () if signal.axis != axis else np.ndindex(signal.data.shape[1:]):
            parts = [name]
            if column:
                parts.append(signal.labels[column[0]])
                parts += [_components(signal.data.shape[2])[k] for k in column[1:]]
            names.append(".".join(parts))
            columns.append(signal.data[:, *column])
            units[names[-1]] = signal.unit
    frame = (
        pandas.concat([pandas.Series(column) for column in columns], axis=1, keys=names)
        if columns
        else pandas.DataFrame(index=range(len(times)))
    )
    frame.index = pandas.Index(times, name=f"{axis} [s]")
    frame.attrs["units"] = units
    return frame


def to_xarray(record: Content) -> xarray.Dataset:
    """Convert a record to an xarray Dataset.

    Returns
    -------
    xarray.Dataset
        Signals over ``time`` or over their own time axes, with the attributes ``units`` and ``long_name``. Signals with
        the same labels share a dimension, which is named after the first of them (``q_label``). The third axis is named
        ``axis`` (x, y, z) for vectors and ``axis_4`` (w, x, y, z) for quaternions. Summary, provenance, events and
        scene are attributes, as JSON.

    Raises
    ------
    RecordError
        If xarray is not installed.
    """
    xarray = _optional("xarray")
    dimensions: dict[tuple[str, ...], str] = {}
    coordinates: dict[str, Any] = {
        name: (name, times, {"units": "s"}) for name, times in {TIME: record.time, **record.axes}.items()
    }
    variables = {}
    for name, signal in record.signals.items():
        axes = [signal.axis]
        if signal.data.ndim > 1:
            label = dimensions.setdefault(signal.labels, f"{name}_label")
            coordinates[label] = list(signal.labels)
            axes.append(label)
        if signal.data.ndim > 2:
            count = signal.data.shape[2]
            axis = "axis" if count == 3 else f"axis_{count}"
            coordinates[axis] = list(_components(count))
            axes.append(axis)
        variables[name] = (axes, signal.data, {"units": signal.unit, "long_name": signal.description})
    attributes = {
        "complete": int(record.complete),
        "summary": json.dumps(record.summary),
        "provenance": json.dumps(record.provenance, default=str),
        "events": json.dumps(record.events, default=vars),
        "scene": "" if record.scene is None else record.scene.to_json(),
    }
    return xarray.Dataset(variables, coordinates, attributes)


def _components(count: int) -> Sequence[str]:
    """Return the names of the components of a vector or quaternion."""
    return {3: "xyz", 4: "wxyz"}.get(count) or [str(k) for k in range(count)]


def _optional(package: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise RecordError(f"{package} is not installed: pip install {package}") from error
