"""Columnar signals over time, with units and provenance; HDF5 in and out.

A record knows nothing of the engine that made it: simulated and measured runs look the same.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.errors import RecordError
from dynsim.files import replacing
from dynsim.inputs import is_file

FORMAT = "dynsim-record-1"


@dataclass(frozen=True)
class Signal:
    """One quantity over time.

    Attributes
    ----------
    data : array, shape (T,) or (T, k) or (T, k, 3)
    unit : str
        SI unit as text, "1" for pure numbers.
    labels : tuple of str
        Names of the k columns, empty for a scalar signal.
    description : str
    """

    data: NDArray[Any]
    unit: str
    labels: tuple[str, ...] = ()
    description: str = ""


class Record:
    """Signals of one run on one time axis.

    ``record["q"]`` is the array, ``record.units["q"]`` its unit, ``record.labels["q"]`` its column names.
    ``summary`` holds the numbers of ``summary.json``; ``provenance`` says what made the record (resolved scenario,
    version, commit, libraries). ``complete`` is False when the run was interrupted or stopped.
    """

    def __init__(self, time: ArrayLike, *, provenance: Mapping[str, Any] | None = None) -> None:
        self.time: NDArray[np.float64] = np.asarray(time, dtype=np.float64)
        self.signals: dict[str, Signal] = {}
        self.summary: dict[str, Any] = {}
        self.provenance: dict[str, Any] = dict(provenance or {})
        self.complete = True

    def add(
        self, name: str, data: ArrayLike, unit: str, *, labels: tuple[str, ...] = (), description: str = ""
    ) -> None:
        """Add a signal; its first axis is time, its second (if any) is named by ``labels``."""
        array = np.asarray(data)
        if array.shape[:1] != self.time.shape:
            raise RecordError(f"signal {name!r} has {array.shape[:1]} samples, the record has {self.time.shape}")
        if array.ndim > 1 and len(labels) != array.shape[1]:
            raise RecordError(f"signal {name!r} has {array.shape[1]} columns and {len(labels)} labels")
        self.signals[name] = Signal(array, unit, tuple(labels), description)

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            return self.signals[name].data
        except KeyError:
            raise KeyError(f"no signal {name!r}; this record has: {', '.join(self.signals)}") from None

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def __iter__(self) -> Iterator[str]:
        return iter(self.signals)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def units(self) -> dict[str, str]:
        """Unit of every signal."""
        return {name: signal.unit for name, signal in self.signals.items()}

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Column names of every signal."""
        return {name: signal.labels for name, signal in self.signals.items()}

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write HDF5 to ``path``: complete or not at all (temporary name, then rename).

        Raises
        ------
        RecordError
            The file cannot be written (no space, no permission); an older file at ``path`` is left as it was.
        """
        path = Path(path)
        with replacing(path) as temporary:
            temporary.write_bytes(self.to_hdf5())
        return path

    def to_hdf5(self) -> memoryview:
        """The bytes of the file that :meth:`save` writes."""
        import h5py

        # Made in memory: HDF5 crashes the process when the disk is full while it closes a file.
        image = io.BytesIO()
        with h5py.File(image, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["complete"] = self.complete
            # Long texts as data sets: HDF5 attributes end at 64 kB.
            file["summary"] = json.dumps(self.summary)
            file["provenance"] = json.dumps(self.provenance, default=str)
            _write(file, "time", Signal(self.time, "s"))
            for name, signal in self.signals.items():
                _write(file, f"signals/{name}", signal)
        return image.getbuffer()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Record:
        """Read a record written by :meth:`save`.

        Raises
        ------
        RecordError
            No such file, or not a dynsim record.
        """
        import h5py

        path = Path(path)
        if not is_file(path, RecordError):
            raise RecordError(f"{path}: no such record")
        try:
            with h5py.File(path, "r") as file:
                if file.attrs.get("format") != FORMAT:
                    raise RecordError(f"{path}: an HDF5 file, but not a dynsim record ({FORMAT})")
                record = cls(file["time"][()], provenance=json.loads(file["provenance"].asstr()[()]))
                record.summary = json.loads(file["summary"].asstr()[()])
                record.complete = bool(file.attrs["complete"])
                for name, data in file["signals"].items() if "signals" in file else ():
                    attributes = data.attrs
                    record.signals[name] = Signal(
                        data[()], attributes["unit"], tuple(attributes["labels"]), attributes["description"]
                    )
        except OSError as error:
            raise RecordError(f"{path}: not a readable HDF5 file ({error})") from error
        except (KeyError, ValueError) as error:
            raise RecordError(f"{path}: a dynsim record that lacks parts ({error})") from error
        return record


def _write(file: Any, name: str, signal: Signal) -> None:
    # gzip only where it pays: it costs time on every run, and short records are small anyway.
    options = {"compression": "gzip", "compression_opts": 1} if signal.data.nbytes > 1 << 22 else {}
    data = file.create_dataset(name, data=signal.data, **options)
    data.attrs["unit"] = signal.unit
    data.attrs["labels"] = list(signal.labels)
    data.attrs["description"] = signal.description
