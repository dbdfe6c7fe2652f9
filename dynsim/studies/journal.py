"""The journal of a sweep: one line per finished run, from which an interrupted sweep is continued."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any

from dynsim.errors import RecordError, ScenarioError, brief
from dynsim.studies.columns import is_finite, numbers
from dynsim.studies.outcome import RunResult
from dynsim.studies.sweep_plan import SweepPoint
from dynsim.system.files import json_text, write_text

PLAN, JOURNAL = "sweep.json", "runs.jsonl"
OK, FAILED, LOST = "ok", "failed", "lost"


@dataclass(frozen=True)
class SweepRow:
    """One run of the table: its numbers, or the reason for its failure.

    Attributes
    ----------
    run, variant, values : see :class:`dynsim.studies.sweep_plan.SweepPoint`
    status : ``ok``, ``failed`` (and would again) or ``lost`` with its process
    reason : why it failed
    numbers : of its summary, see :func:`dynsim.studies.columns.numbers`
    warnings : of its summary, in a line
    """

    run: int
    variant: str | None
    values: Mapping[str, Any]
    status: str
    reason: str
    numbers: Mapping[str, Any]
    warnings: str

    @classmethod
    def of(cls, point: SweepPoint, result: RunResult) -> SweepRow:
        """A result as a row."""
        status = OK if result.ok else LOST if result.lost else FAILED
        warnings = "; ".join(result.summary.get("warnings", ()))
        return cls(point.run, point.variant, point.values, status, result.reason, numbers(result.summary), warnings)

    @classmethod
    def read(cls, line: str) -> SweepRow:
        """A line of a journal as a row.

        Raises
        ------
        ValueError
            It is none.
        """
        data = json.loads(line)
        names = [field.name for field in fields(cls)]
        if not isinstance(data, dict) or set(data) != set(names):
            raise ValueError(f"is no run with {', '.join(names)}")
        row = cls(**data)
        fits = {
            "run": type(row.run) is int and row.run >= 0,
            "variant": row.variant is None or isinstance(row.variant, str),
            "values": isinstance(row.values, dict),
            "status": row.status in (OK, FAILED, LOST),
            "reason": isinstance(row.reason, str),
            "numbers": isinstance(row.numbers, dict) and all(map(is_finite, row.numbers.values())),
            "warnings": isinstance(row.warnings, str),
        }
        for name in names:
            if not fits[name]:
                raise ValueError(f"{name} = {brief(data[name])} is nothing that dynsim has written")
        return row

    def placed(self, point: SweepPoint) -> SweepRow:
        """This row, in the place that another plan has for it."""
        return SweepRow(point.run, point.variant, point.values, self.status, self.reason, self.numbers, self.warnings)

    @property
    def identity(self) -> str:
        """See :class:`dynsim.studies.sweep_plan.SweepPoint`."""
        return SweepPoint(self.run, self.variant, self.values).identity

    def cells(self) -> dict[str, Any]:
        """By column."""
        variant = {} if self.variant is None else {"variant": self.variant}
        ended = {"status": self.status, "reason": self.reason}
        return {"run": self.run, **variant, **self.values, **ended, **self.numbers, "warnings": self.warnings}


class SweepJournal:
    """The file, with rows that are known written anew, open for those that come.

    Raises
    ------
    RecordError
        It cannot be written.
    """

    def __init__(self, folder: Path, rows: Iterable[SweepRow]) -> None:
        self._path = folder / JOURNAL
        write_text(self._path, "".join(map(_line, rows)))
        # Without a buffer, which would be written once more at the end of a disk that is full.
        self._stream = self._path.open("ab", buffering=0)

    def __enter__(self) -> SweepJournal:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stream.close()

    def add(self, row: SweepRow) -> None:
        """Write a row.

        Raises
        ------
        RecordError
            It cannot be written; a part of its line may be there, which is not read again.
        """
        content = _line(row).encode("utf-8")
        try:
            while content:
                content = content[self._stream.write(content) or 0 :]
        except OSError as error:
            raise RecordError(f"cannot write {self._path}: {error.strerror}") from error


def _line(row: SweepRow) -> str:
    return json.dumps(vars(row)) + "\n"


def earlier_rows(folder: Path, header: Mapping[str, Any], resume: bool, tables: Iterable[str]) -> dict[str, SweepRow]:
    """Rows of a folder's journal by their identity, but for lost ones; ``header`` is what they must be of.

    Raises
    ------
    ScenarioError
        There is a sweep and ``resume`` is not asked for, or one of another scenario, other overrides or another dynsim.
    RecordError
        A file is damaged or missing.
    """
    journal = folder / JOURNAL
    if not journal.exists():
        left = [name for name in tables if (folder / name).exists()]
        if resume and left:
            raise RecordError(
                f"{journal}: is missing, though {left[0]} beside it is of a sweep; put it back, or remove {left[0]} "
                "to run everything again, or give another --out"
            )
        return {}
    if not resume:
        raise ScenarioError(f"{folder} holds a sweep: --resume goes on with it; or give another --out, or remove it")
    _check_header(folder / PLAN, header)
    # What is no text is found with its line; only a line that has an end was written to it.
    *lines, _ = _content(journal).split(b"\n")
    rows = {}
    for number, line in enumerate(lines, start=1):
        try:
            row = SweepRow.read(line.decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise RecordError(
                f"{journal}, line {number}: is damaged ({error}); remove that line, and --resume does its run again"
            ) from error
        if row.status != LOST:
            rows[row.identity] = row
    return rows


def _check_header(path: Path, header: Mapping[str, Any]) -> None:
    """Refuse a sweep of anything else."""
    fix = f"put it back, or remove {path.parent}, or give another --out"
    if not path.exists():
        raise RecordError(f"{path}: is missing, so that nobody knows what the runs beside it are of; {fix}")
    try:
        before = json.loads(_content(path))
    except (ValueError, RecursionError) as error:
        raise RecordError(f"{path}: is damaged ({error}); {fix}") from error
    now = json.loads(json_text(header))
    keys = ("scenario", "overrides", "dynsim_version", "commit")
    if not isinstance(before, dict) or not before.keys() >= set(keys):
        raise RecordError(f"{path}: is damaged, or not of a sweep (it has not all of {', '.join(keys)}); {fix}")
    for key in keys:
        if type(before[key]) is not type(now[key]) and None not in (before[key], now[key]):
            raise RecordError(f"{path}: is damaged ({key} = {brief(before[key])}); {fix}")
        if before[key] != now[key]:
            raise ScenarioError(
                f"{path.parent} holds a sweep of another {key}, which cannot be gone on with: give another --out"
            )


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}); change that, or give another --out") from error
