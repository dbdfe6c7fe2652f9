"""Records on the command line: paths of files and folders of runs, and labels for several records."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dynsim.errors import RecordError

if TYPE_CHECKING:
    from dynsim.record import Record

# Names of the record in the folder of a run, and of the summary in the folder of a comparison.
RECORD, COMPARISON = "record.h5", "comparison.json"


def labelled(paths: Sequence[Path], *, trust: bool = False) -> dict[str, Record]:
    """Load records from files and folders, and return them by label: the variant, numbered if it occurs repeatedly.

    Raises
    ------
    RecordError
        As for :meth:`dynsim.record.Record.load`.
    """
    from dynsim.record import Record
    from dynsim.system.files import file_name

    records: dict[str, Record] = {}
    for path in record_files(paths):
        record = Record.load(path, trust=trust)
        name = file_name(record.summary.get("variant") or path.parent.name or path.stem)
        label = next(label for k in itertools.count(1) if (label := name if k == 1 else f"{name}_{k}") not in records)
        records[label] = record
    return records


def record_files(paths: Sequence[Path]) -> list[Path]:
    """Return the paths of records; replace each folder by the record in it, or by the records of its variants.

    Raises
    ------
    RecordError
        If a folder contains no records.
    """
    files = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        inside = [path / RECORD] if (path / RECORD).is_file() else _variant_records(path)
        if not inside:
            raise RecordError(
                f"{path}: no {RECORD} in this folder or its subfolders; pass a record, or the folder of a run"
            )
        files += inside
    return files


def _variant_records(folder: Path) -> list[Path]:
    """Return the records in the subfolders of a folder: variants in the order of the comparison, then all others."""
    files = sorted(folder.glob(f"*/{RECORD}"))
    try:
        order = list(json.loads((folder / COMPARISON).read_text(encoding="utf-8"))["variants"])
    except (OSError, ValueError, KeyError, TypeError):
        return files
    return sorted(files, key=lambda path: order.index(path.parent.name) if path.parent.name in order else len(order))
