"""A sweep: carries out its runs, continues from its journal, writes the table of results and statistics."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine.recording import commit, save_run
from dynsim.errors import RecordError, ScenarioError, SimulationInterrupted, brief
from dynsim.record.sensitivity import sensitivities, spread
from dynsim.studies.batch import BatchWork, Keep, run_all
from dynsim.studies.cluster import ClusterError
from dynsim.studies.outcome import RunResult
from dynsim.studies.sweep_plan import Plan, SweepPoint
from dynsim.studies.worker import WorkerError
from dynsim.system.files import check_writable, held_folder, json_text, replacing, write_text

# Columns of a table of runs: flat numbers of a summary, kinds of values, CSV text.


# Excluded: names, which have columns of their own, and computing times, which are not reproducible.
_NOT_OF_THE_RUN = ("scenario", "variant", "dynsim_version", "integration_wall_s", "real_time_factor")


def flat(summary: dict[str, Any]) -> dict[str, Any]:
    """A summary whose numbers of a mobile base and of motors stand beside the others, as ``base.…`` and ``JOINT.…``."""
    base = dict(summary.get("base", {}))
    for key in [key for key, value in base.items() if isinstance(value, dict)]:
        base.update({f"{key}.{name}": value for name, value in base.pop(key).items()})
    motors = {
        f"{motor['joint']}.{key}": value
        for motor in summary.get("motors", ())
        for key, value in motor.items()
        if key != "joint"
    }
    return summary | {f"base.{key}": value for key, value in base.items()} | motors


def is_text(value: Any) -> bool:
    """True for a text, which has no place in a column of numbers."""
    return isinstance(value, str)


def is_scalar(value: Any) -> bool:
    """True for a number, a text or nothing."""
    return value is None or isinstance(value, (int, float, str))


def is_finite(value: Any) -> bool:
    """True for a finite number of double precision."""
    return isinstance(value, (int, float)) and abs(value) <= sys.float_info.max


def numbers(summary: dict[str, Any]) -> dict[str, Any]:
    """All finite numbers of a summary that do not depend on the machine; those of contacts under ``CONTACT.…``."""
    values = flat(summary)
    for key, value in summary.items():
        if isinstance(value, dict) and key != "base":
            values |= {f"{key}.{name}": entry for name, entry in value.items()}
    for contact in summary.get("contacts", ()):
        values |= {f"{contact['name']}.{key}": value for key, value in contact.items()}
    return {key: value for key, value in values.items() if is_finite(value) and key not in _NOT_OF_THE_RUN}


def csv_table(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV of rows by column: all digits, an empty field for nothing."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


# The journal of a sweep: one line per finished run, from which an interrupted sweep is continued.


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
    numbers : of its summary, see :func:`dynsim.studies.sweep.numbers`
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


TABLES = ("sweep.csv", "sweep.parquet")
STATISTICS, RECORDS = "statistics.json", "records"


def run_sweep(
    plan: Plan,
    folder: Path,
    *,
    jobs: int = 1,
    keep_records: Keep = "none",
    resume: bool = False,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    ended: Callable[[SweepRow], None] | None = None,
) -> list[SweepRow]:
    """Carry out the runs of a plan; write plan, journal, records, tables and statistics of samples to a folder.

    Parameters
    ----------
    folder : for the files; the journal ``runs.jsonl`` has a line for every run that is done, as soon as it is
    jobs, keep_records, scheduler : see :func:`dynsim.studies.batch.simulate_batch`
    resume : take over what the folder's journal has of the same scenario; only lost runs and those not there are run
    progress : called with how many runs are done and how many of them have failed
    ended : called with every run that is done, also with those taken over

    Returns
    -------
    list of SweepRow
        In the order of the plan, the same whatever the jobs and the order in which they ended.

    Raises
    ------
    ScenarioError
        The folder holds a sweep and ``resume`` is not asked for, or one of another scenario; the first run of a
        variant is none (a key is misspelt), so that nothing is run.
    SimulationInterrupted
        Ctrl-C; tables of what was done are written.
    RecordError
        A file cannot be written, or one of the sweep that is gone on with is damaged; another process is at work there.
    WorkerError, ClusterError
        No process can be started; see :func:`dynsim.studies.cluster.run_on_cluster`.
    """
    points = list(plan.points())
    check_writable(folder, (PLAN, JOURNAL, *TABLES, STATISTICS))
    if keep_records != "none":
        check_writable(folder / RECORDS)
    # A key that no scenario has would fail in every run: the first of each variant tells.
    for point in {point.variant: point for point in reversed(points)}.values():
        plan.scenario(point)
    header = _header(plan)
    with held_folder(folder):
        earlier = earlier_rows(folder, header, resume, TABLES)
        rows = {point.run: earlier[point.identity].placed(point) for point in points if point.identity in earlier}
        left = [point for point in points if point.run not in rows]
        failed = sum(row.status != OK for row in rows.values())
        with _goes_on(folder):
            write_text(folder / PLAN, json_text(header))
            with SweepJournal(folder, rows.values()) as journal:

                def take(point: SweepPoint, result: RunResult) -> None:
                    nonlocal failed
                    # Before its row: a run that has one is not run again.
                    if result.record is not None:
                        save_run(result.record, folder / RECORDS / f"{point.run:06d}")
                    row = rows[point.run] = SweepRow.of(point, result)
                    journal.add(row)
                    failed += row.status != OK
                    if ended is not None:
                        ended(row)
                    if progress is not None:
                        progress(len(rows), failed)

                if progress is not None:
                    progress(len(rows), failed)
                if ended is not None:
                    for row in rows.values():
                        ended(row)
                work = BatchWork(plan.scenario, keep_records)
                interrupted = run_all(work, left, take, jobs=jobs, scheduler=scheduler)
            done = [rows[run] for run in sorted(rows)]
            write_tables(done, plan, folder)
            if plan.laws:
                write_text(folder / STATISTICS, json_text(statistics(done, plan)))
    if interrupted:
        raise SimulationInterrupted(f"interrupted when {len(done)} of {len(points)} runs were done; --resume goes on")
    return done


@contextmanager
def _goes_on(folder: Path) -> Iterator[None]:
    """A full disk, no process or no cluster costs none of the runs that are done."""
    try:
        yield
    except (RecordError, WorkerError, ClusterError) as error:
        raise type(error)(f"{error}; --resume goes on with the runs that are in {folder / JOURNAL}") from error


def _header(plan: Plan) -> dict[str, Any]:
    """What rows must share to stand in one table, and how these came about."""
    return {
        "dynsim_version": __version__,
        "commit": commit(),
        "scenario": plan.file.data,
        "overrides": dict(plan.overrides),
        "plan": {
            "variants": list(plan.variants),
            "grid": {axis.key: list(axis.values) for axis in plan.grid},
            "samples": {law.key: f"{law.name}{law.numbers}" for law in plan.laws},
            "count": plan.count,
            "seed": plan.seed,
            "runs": plan.runs,
        },
    }


def columns(rows: Sequence[SweepRow]) -> list[str]:
    """Columns of the table: of all rows, in the order in which the first that has one has it."""
    names = dict.fromkeys(name for row in rows for name in row.cells())
    # Failed runs have no numbers.
    return [*(name for name in names if name != "warnings"), "warnings"]


def write_tables(rows: Sequence[SweepRow], plan: Plan, folder: Path) -> None:
    """Write ``sweep.csv`` and, with pyarrow, ``sweep.parquet``: all digits, an empty field or null for no number.

    Raises
    ------
    RecordError
        A file cannot be written.
    """
    names = columns(rows)
    write_text(folder / TABLES[0], csv_table(names, [row.cells() for row in rows]))
    if has_parquet():
        _write_parquet(rows, names, folder / TABLES[1], plan)


def has_parquet() -> bool:
    """Whether pyarrow is there."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        return False
    return True


def _write_parquet(rows: Sequence[SweepRow], names: Sequence[str], path: Path, plan: Plan) -> None:
    import pyarrow
    from pyarrow import parquet

    cells = [row.cells() for row in rows]
    arrays = []
    for name in names:
        column = [row.get(name) for row in cells]
        if any(isinstance(value, float) for value in column):
            column = [float(value) if isinstance(value, int) else value for value in column]
        try:
            arrays.append(pyarrow.array(column))
        except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError, OverflowError):
            # A grid of numbers and texts.
            arrays.append(pyarrow.array([None if value is None else json.dumps(value) for value in column]))
    table = pyarrow.table(arrays, names=list(names))
    described = {"dynsim": json.dumps(json.loads(json_text(_header(plan))))}
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(table.replace_schema_metadata(described), sink)
    with replacing(path) as stream:
        stream.write(sink.getvalue().to_pybytes())


def statistics(rows: Sequence[SweepRow], plan: Plan) -> list[dict[str, Any]]:
    """For each variant and place of the grid: runs, those without numbers, and of each number that all others have

    its :class:`dynsim.record.sensitivity.Spread` and, where a line fits, what one standard deviation of each drawn key
    does to it (``effect``, with the half width of its interval) and how much of the variance the line explains.
    """
    groups: dict[str, list[SweepRow]] = {}
    for row in rows:
        grid = {axis.key: row.values[axis.key] for axis in plan.grid}
        groups.setdefault(json.dumps([row.variant, grid]), []).append(row)
    entries = []
    for name, group in groups.items():
        variant, grid = json.loads(name)
        good = [row for row in group if row.status == OK]
        shared = [key for key in good[0].numbers if all(key in row.numbers for row in good)] if len(good) > 1 else []
        drawn = np.array([[row.values[key] for key in plan.sampled] for row in good], dtype=float)
        table = {key: np.array([row.numbers[key] for row in good], dtype=float) for key in shared}
        entries.append(
            {
                "variant": variant,
                "grid": grid,
                "runs": len(group),
                "without_numbers": len(group) - len(good),
                "numbers": {key: _statistics_of(drawn, values, plan.sampled) for key, values in table.items()},
            }
        )
    return entries


def _statistics_of(drawn: np.ndarray, values: np.ndarray, keys: Sequence[str]) -> dict[str, Any]:
    fit = sensitivities(drawn, values)
    if fit is None:
        return asdict(spread(values))
    effect = dict(zip(keys, fit.effect.tolist(), strict=True))
    half_width = dict(zip(keys, fit.half_width.tolist(), strict=True))
    return asdict(spread(values)) | {"effect": effect, "half_width": half_width, "explained": fit.explained}
