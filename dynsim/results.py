"""Files of a run: complete or not there at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dynsim.files import replacing
from dynsim.record import Record
from dynsim.scenario import to_yaml


def write_text(path: Path, text: str) -> Path:
    """Write a text file under a temporary name, then rename.

    Raises
    ------
    RecordError
        The file cannot be written; an older one is left as it was.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def write_json(path: Path, data: Any) -> Path:
    """Write JSON, see :func:`write_text`."""
    return write_text(path, json.dumps(data, indent=2, ensure_ascii=False) + "\n")


def save_run(record: Record, folder: Path) -> None:
    """Write ``record.h5``, ``summary.json`` and the resolved ``scenario.yaml`` to a folder."""
    write_text(folder / "scenario.yaml", to_yaml(record.provenance["scenario"]))
    record.save(folder / "record.h5")
    write_json(folder / "summary.json", record.summary)
