"""The folder of a replay: what lies in it, and what an earlier one left there."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.stream import PART
from dynsim.system.files import INCOMPLETE, lock

MEASURED, SUMMARY, LOG = "measured.h5", "summary.json", "replay.log"
REGISTERS, REGISTERS_AFTER_FAULT = "registers.json", "registers_after_fault.json"
FILES = (PART, MEASURED, SUMMARY, LOG, REGISTERS, REGISTERS_AFTER_FAULT, INCOMPLETE)
MADE_OF_THEM = ("comparison.*", "figures")
"""What other commands put beside a measured record."""


def move_away(folder: Path) -> Path | None:
    """Move what an earlier replay left to a folder ``previous_1``, ``previous_2``, … within; None if there is nothing.

    Raises
    ------
    PortError
        Another replay is writing there.
    OSError
        Something cannot be moved.
    """
    found = [folder / name for name in FILES if os.path.lexists(folder / name)]
    if not found:
        return None
    if is_held(folder / PART):
        raise PortError(f"{folder}: another replay is writing there; give this one another folder (--out)")
    if folder / PART in found or folder / MEASURED in found:
        found += [path for pattern in MADE_OF_THEM for path in folder.glob(pattern)]
    place = _new_folder(folder)
    for path in found:
        path.rename(place / path.name)
    return place


def is_held(part: Path) -> bool:
    """Whether the process that writes a streamed record is alive. Raises OSError."""
    try:
        descriptor = os.open(part, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return not lock(descriptor, wait=False)
    finally:
        os.close(descriptor)


def _new_folder(folder: Path) -> Path:
    for number in itertools.count(1):
        place = folder / f"previous_{number}"
        try:
            place.mkdir()
        except FileExistsError:
            continue
        return place
    raise AssertionError
