"""Figures of a record, or of several side by side: PNG files in a folder. Matplotlib is loaded on the first drawing."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from dynsim.errors import DynsimError, RecordError
from dynsim.record import Record

# Engine that made a record → module with ``draw`` and ``draw_comparison``.
MODULES = {"dynamics": "dynsim.figures.arm", "kinematic": "dynsim.figures.snake"}


def draw(record: Record, folder: Path) -> list[Path]:
    """Draw every figure that the record has data for.

    Returns
    -------
    list of Path
        The files written; empty for a record without samples.

    Raises
    ------
    RecordError
        Nobody draws records of this engine, the record lacks what the figures need, or a file cannot be written.
    """
    if not len(record):
        return []
    with _drawable():
        return list(_module(record).draw(record, Path(folder)))


def draw_comparison(records: Mapping[str, Record], folder: Path) -> list[Path]:
    """Draw variants over each other, in the order of ``records``; those without samples are left out.

    Raises
    ------
    RecordError
        See :func:`draw`; or the records come from different engines.
    """
    drawn = {name: record for name, record in records.items() if len(record)}
    modules = {_module(record) for record in drawn.values()}
    if not modules:
        return []
    if len(modules) > 1:
        raise RecordError("records of different engines cannot be drawn over each other")
    with _drawable():
        return list(modules.pop().draw_comparison(drawn, Path(folder)))


@contextmanager
def _drawable() -> Iterator[None]:
    """A record may come from anywhere: what it lacks is its fault, and said in a line."""
    try:
        yield
    except DynsimError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        text = " ".join(str(error).split())
        raise RecordError(f"the record cannot be drawn: {type(error).__name__}: {text}") from error


def _module(record: Record) -> ModuleType:
    engine = record.provenance.get("engine")
    if not isinstance(engine, str) or engine not in MODULES:
        raise RecordError(f"no figures for records of engine {engine!r}; known: {', '.join(MODULES)}")
    return importlib.import_module(MODULES[engine])
