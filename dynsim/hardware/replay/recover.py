"""The record of a replay whose process died: made of the cycles that had reached the disk."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dynsim.errors import RecordError
from dynsim.hardware.replay.folder import MEASURED, SUMMARY, is_held
from dynsim.hardware.replay.measured import describe
from dynsim.hardware.replay.rows import Layout, Rows, measured_record, row_type
from dynsim.hardware.replay.states import State
from dynsim.hardware.replay.stream import PART, PART_FORMAT
from dynsim.record import Record
from dynsim.record.scene import Scene
from dynsim.system.files import json_text, replace_together

END_STATE = "not known: the program died"


def recover(folder: Path, out: Path | None = None) -> Record:
    """Make ``measured.h5`` and ``summary.json`` of a ``measured.part`` that was left over, and remove that.

    The record is marked incomplete. A summary that is there is of the same replay, which ended, and could not write its
    record: what it says of the end is kept. A measured record that is already there is of the same replay too (what an
    earlier one left is moved away before), and whole: it stays, and is all there is to do.

    Parameters
    ----------
    out : folder for record and summary, where there is none yet; ``folder`` then stays as it is, and may be read-only

    Raises
    ------
    RecordError
        There is neither a streamed nor a whole record, it is empty or cannot be read, or its replay is still running;
        the record cannot be written, or ``out`` has one.
    """
    part = folder / PART
    try:
        if part.is_file() and is_held(part):
            raise RecordError(f"{part}: the replay that writes it is still running")
        record = whole = _kept(folder / MEASURED)
        if not part.is_file() and not (whole and whole.complete):
            raise RecordError(f"{folder}: no {PART} there: nothing to recover")
        if record is None:
            record = _read(part)
            record.summary |= {"end_state": END_STATE} | _summary(folder / SUMMARY) | {"recovered": True}
        if out is not None:
            _save(record, out, new=True)
            return record
        if whole is None:
            _save(record, folder)
        part.unlink(missing_ok=True)
    except OSError as error:
        raise RecordError(f"{part}: cannot be recovered ({error.strerror})") from error
    return record


def _save(record: Record, folder: Path, *, new: bool = False) -> None:
    """Record and summary; where they are to be ``new``, none may be there."""
    folder.mkdir(parents=True, exist_ok=True)
    there = [name for name in (MEASURED, SUMMARY, PART) if new and (folder / name).exists()]
    if there:
        raise RecordError(f"{folder}: has {', '.join(there)} already; give another folder (--out)")
    summary = json_text(record.summary).encode("utf-8")
    replace_together(folder, {MEASURED: record.to_hdf5(), SUMMARY: summary})


def _kept(measured: Path) -> Record | None:
    """The record beside a streamed one, if it is whole."""
    with suppress(RecordError):
        return Record.load(measured)
    return None


def _summary(path: Path) -> dict[str, Any]:
    """What a replay that came to its end has said of it; empty where there is nothing, or nothing whole."""
    with suppress(FileNotFoundError, ValueError):
        found = json.loads(path.read_bytes())
        return found if isinstance(found, dict) else {}
    return {}


def _read(part: Path) -> Record:
    content = part.read_bytes()
    if not content:
        raise RecordError(f"{part}: is empty, the replay died before its first cycle: nothing to recover, remove it")
    line, _, data = content.partition(b"\n")
    try:
        header: dict[str, Any] = json.loads(line)
        layout = Layout(**header["layout"])
        kind = row_type(len(layout.joints))
        if header["format"] != PART_FORMAT or header["row"] != json.loads(json.dumps(kind.descr)):
            raise ValueError("another version of dynsim wrote it")
        scene = Scene.from_json(header["scene"]) if header["scene"] else None
    except (ValueError, TypeError, KeyError) as error:
        raise RecordError(f"{part}: is no streamed record of a replay ({error})") from error
    # The last row may have been cut off in the middle.
    rows = _sound(np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], dtype=kind))
    origins = rows["origin"][np.isfinite(rows["origin"])]
    origin = origins[0] if len(origins) else rows["time"][0] if len(rows) else 0.0
    record = describe(measured_record(rows, layout, float(origin)), scene, State)
    record.complete = False
    return record


def _sound(rows: Rows) -> Rows:
    """The rows before the first whose time is not after the one before it: a power cut may leave zeros at the end."""
    forward = np.diff(rows["time"], prepend=-np.inf) > 0
    broken = np.flatnonzero(~(forward & np.isfinite(rows["time"])))
    return rows[: broken[0]] if len(broken) else rows
