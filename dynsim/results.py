"""Files of a run: complete or not there at all."""

from __future__ import annotations

from pathlib import Path

from dynsim.files import json_text, replacing, write_text
from dynsim.record import Record
from dynsim.scenario import to_yaml


def save_run(record: Record, folder: Path) -> None:
    """Write ``record.h5``, ``summary.json`` and the resolved ``scenario.yaml`` to a folder: all three or none.

    Raises
    ------
    RecordError
        A file cannot be written; older ones are left as they were.
    """
    # Renamed only when all are written, so that no file of this run lies beside those of another.
    with replacing(folder / "record.h5") as file:
        file.write_bytes(record.to_hdf5())
        with replacing(folder / "summary.json") as file:
            file.write_text(json_text(record.summary), encoding="utf-8")
            write_text(folder / "scenario.yaml", to_yaml(record.provenance["scenario"]))
