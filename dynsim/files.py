"""Files that are complete or not there at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from dynsim.errors import RecordError


def check_writable(folder: Path) -> None:
    """Find out before a long simulation whether its files can be written to a folder; creates nothing.

    Raises
    ------
    RecordError
        A file is in the way, or there is no permission.
    """
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise RecordError(f"cannot write to {folder}: {existing} is a file, not a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise RecordError(f"cannot write to {folder}: no permission to write in {existing}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; renamed to ``path`` when the block ends well.

    Raises
    ------
    RecordError
        The file cannot be written (no space, no permission); an older file at ``path`` is left as it was.
    """
    temporary = path.with_name(path.name + ".tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise RecordError(f"cannot write {path}: {error.strerror or error}; nothing was changed there") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


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
    return write_text(path, json_text(data))


def json_text(data: Any) -> str:
    """JSON as dynsim writes it."""
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"
