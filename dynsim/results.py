"""Files of a run: complete or not there at all."""

from __future__ import annotations

from pathlib import Path

from dynsim.files import write_json, write_text
from dynsim.record import Record
from dynsim.scenario import to_yaml


def save_run(record: Record, folder: Path) -> None:
    """Write ``record.h5``, ``summary.json`` and the resolved ``scenario.yaml`` to a folder.

    Raises
    ------
    RecordError
        A file cannot be written.
    """
    write_text(folder / "scenario.yaml", to_yaml(record.provenance["scenario"]))
    record.save(folder / "record.h5")
    write_json(folder / "summary.json", record.summary)
