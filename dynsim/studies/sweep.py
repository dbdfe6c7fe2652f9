"""Sweeps: simulate the runs of a plan, resume from the journal, and write the table of results and its statistics."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine.recording import commit, save_run
from dynsim.errors import RecordError, ScenarioError, SimulationInterrupted, brief
from dynsim.record.csv_rows import csv_table
from dynsim.record.sensitivity import sensitivities, spread
from dynsim.studies.batch import BatchWork, Keep, run_all
from dynsim.studies.cluster import ClusterError
from dynsim.studies.outcome import RunResult
from dynsim.studies.processes import WorkerError
from dynsim.studies.sweep_plan import Plan, SweepPoint
from dynsim.system.files import check_writable, held_folder, json_text, replacing, write_text

# Entries that do not count as numbers of a run: names, which have separate columns, computing times, which are not
# reproducible, and numbers of the model, which do not depend on the motion.
_EXCLUDED = ("scenario", "variant", "dynsim_version", "integration_wall_s", "real_time_factor", "model")
# Lists whose entries are named after their parts; the keys of an entry that contain the names.
_NAMED = {
    "motors": ("joint",),
    "contacts": ("name",),
    "joint_stops": ("joint", "stop"),
    "sinking": ("body", "surface"),
    "hand_error_causes": ("cause",),
    "final_position_error_causes": ("cause",),
}


def flat(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return all entries of a summary in one mapping by dotted key: ``base.…``, ``JOINT.…``, ``CONTACT.…``."""
    sections = {key: value for key, value in summary.items() if isinstance(value, (dict, list))}
    values = {key: value for key, value in summary.items() if key not in sections}
    order: list[str] = [key for key in ("base", "motors") if key in sections]
    order += sorted(sections.keys() - order, key=lambda key: (key in _NAMED, list(sections).index(key)))
    return values | dict(entry for key in order for entry in _entries(key, sections[key]))


def _entries(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list) and key in _NAMED:
        for entry in value:
            name = ".".join(entry[part] for part in _NAMED[key])
            name = f"{name}_stop" if key == "joint_stops" else f"{key}.{name}" if key.endswith("_causes") else name
            yield from _entries(name, {part: number for part, number in entry.items() if part not in _NAMED[key]})
    elif isinstance(value, list) and all(isinstance(entry, str) for entry in value):
        yield key, "; ".join(value)
    elif isinstance(value, (dict, list)):
        entries = value if isinstance(value, dict) else dict(enumerate(value))
        for part, entry in entries.items():
            yield from _entries(f"{key}.{part}", entry)
    else:
        yield key, value


def is_finite(value: Any) -> bool:
    """Return whether a value is a number that is finite in double precision."""
    return isinstance(value, (int, float)) and abs(value) <= sys.float_info.max


def numbers(summary: dict[str, Any]) -> dict[str, Any]:
    """Return all finite numbers of a summary that do not depend on the machine, by the keys of :func:`flat`."""
    counted = {key: value for key, value in summary.items() if key not in _EXCLUDED}
    return {key: value for key, value in flat(counted).items() if is_finite(value)}


# The journal of a sweep has one line per completed run; an interrupted sweep is resumed from it.
PLAN, JOURNAL = "sweep.json", "runs.jsonl"
OK, FAILED, LOST = "ok", "failed", "lost"


@dataclass(frozen=True)
class SweepRow(SweepPoint):
    """One run of the table: its numbers, or the reason for its failure.

    Attributes
    ----------
    status : str
        ``ok``, ``failed`` (the failure is reproducible) or ``lost`` (its process died).
    reason : str
        Reason for the failure.
    numbers : mapping of str to float
        Numbers in the summary of the run, see :func:`dynsim.studies.sweep.numbers`.
    warnings : str
        Warnings in the summary of the run, one per line.
    """

    status: str
    reason: str
    numbers: Mapping[str, Any]
    warnings: str

    @classmethod
    def of(cls, point: SweepPoint, result: RunResult) -> SweepRow:
        """Create the row of a result."""
        status = OK if result.ok else LOST if result.lost else FAILED
        warnings = "\n".join(result.summary.get("warnings", ()))
        return cls(
            **vars(point), status=status, reason=result.reason, numbers=numbers(result.summary), warnings=warnings
        )

    @classmethod
    def read(cls, line: str) -> SweepRow:
        """Parse a line of a journal.

        Raises
        ------
        ValueError
            If the line is not a valid row.
        """
        data = json.loads(line)
        names = [field.name for field in fields(cls)]
        if not isinstance(data, dict) or set(data) != set(names):
            raise ValueError(f"expected the keys {', '.join(names)}")
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
                raise ValueError(f"invalid {name} = {brief(data[name])}")
        return row

    def placed(self, point: SweepPoint) -> SweepRow:
        """Return this row with the run number, variant and values of a point of another plan."""
        return replace(self, **vars(point))

    def cells(self) -> dict[str, Any]:
        """Return the cells of the row by column."""
        variant = {} if self.variant is None else {"variant": self.variant}
        ended = {"status": self.status, "reason": self.reason}
        return {
            "run": self.run,
            **variant,
            **self.values,
            **ended,
            **self.numbers,
            "warnings": self.warnings.replace("\n", "; "),
        }


class SweepJournal:
    """Journal file of a sweep; it is rewritten with the known rows and then stays open for further rows.

    Raises
    ------
    RecordError
        If the file cannot be written.
    """

    def __init__(self, folder: Path, rows: Iterable[SweepRow]) -> None:
        self._path = folder / JOURNAL
        write_text(self._path, "".join(map(_line, rows)))
        # Use no buffer, because closing the file on a full disk would try to write the buffer again.
        self._stream = self._path.open("ab", buffering=0)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def add(self, row: SweepRow) -> None:
        """Append a row.

        Raises
        ------
        RecordError
            If the row cannot be written; a part of its line may remain, which is ignored when the journal is read.
        """
        content = _line(row).encode("utf-8")
        try:
            while content:
                content = content[self._stream.write(content) or 0 :]
        except OSError as error:
            raise RecordError(f"cannot write {self._path}: {error.strerror}") from error


def _line(row: SweepRow) -> str:
    return json.dumps(vars(row)) + "\n"


def earlier_rows(folder: Path, header: Mapping[str, Any], resume: bool) -> dict[str, SweepRow]:
    """Return the rows of the journal in a folder by identity, except rows of lost runs.

    Parameters
    ----------
    folder : Path
        Folder of the sweep.
    header : mapping
        Header of the new sweep, which the header of an existing sweep must match.
    resume : bool
        Whether an existing sweep may be resumed.

    Raises
    ------
    ScenarioError
        If the folder contains a sweep and ``resume`` is False, or if it contains a sweep with another scenario, other
        overrides or another version of dynsim.
    RecordError
        If a file is damaged or missing.
    """
    journal = folder / JOURNAL
    if not journal.exists():
        left = [name for name in TABLES if (folder / name).exists()]
        if resume and left:
            raise RecordError(
                f"{journal} is missing, although {left[0]} next to it belongs to a sweep; restore it, delete {left[0]} "
                "to run everything again, or choose another --out"
            )
        return {}
    if not resume:
        raise ScenarioError(f"{folder} already contains a sweep; add --resume, choose another --out, or delete it")
    _check_header(folder / PLAN, header)
    # Decode the file line by line, so that an error contains the line number. A last line without a line end was not
    # written completely.
    *lines, _ = _content(journal).split(b"\n")
    rows = {}
    for number, line in enumerate(lines, start=1):
        try:
            row = SweepRow.read(line.decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise RecordError(
                f"{journal}, line {number}: damaged ({error}); delete this line, and --resume will repeat its run"
            ) from error
        if row.status != LOST:
            rows[row.identity] = row
    return rows


def _check_header(path: Path, header: Mapping[str, Any]) -> None:
    """Raise if the folder contains a different sweep."""
    fix = f"restore it, delete {path.parent}, or choose another --out"
    if not path.exists():
        raise RecordError(f"{path} is missing, so the runs in its folder cannot be identified; {fix}")
    try:
        before = json.loads(_content(path))
    except (ValueError, RecursionError) as error:
        raise RecordError(f"{path}: damaged ({error}); {fix}") from error
    now = json.loads(json_text(header))
    keys = ("scenario", "overrides", "dynsim_version", "commit")
    if not isinstance(before, dict) or not before.keys() >= set(keys):
        raise RecordError(f"{path}: damaged, or not from a sweep (it must have {', '.join(keys)}); {fix}")
    for key in keys:
        if type(before[key]) is not type(now[key]) and None not in (before[key], now[key]):
            raise RecordError(f"{path}: damaged ({key} = {brief(before[key])}); {fix}")
        if before[key] != now[key]:
            raise ScenarioError(
                f"the sweep in {path.parent} differs in {key} and cannot be resumed; choose another --out"
            )


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); fix its permissions or choose another --out"
        ) from error


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
    progress: Callable[[int, int], None] = lambda completed, failed: None,
    ended: Callable[[SweepRow], None] = lambda row: None,
) -> list[SweepRow]:
    """Simulate the runs of a plan, and write plan, journal, records, tables and sample statistics to a folder.

    Parameters
    ----------
    plan : Plan
        Runs of the sweep.
    folder : Path
        Output folder; each run is appended to the journal ``runs.jsonl`` as soon as it is done.
    jobs, keep_records, scheduler
        See :func:`dynsim.studies.batch.simulate_batch`.
    resume : bool, optional
        If True, take completed runs of the same scenario from the journal in the folder, and simulate only missing and
        lost runs.
    progress : callable, optional
        Called with the number of completed runs and the number of failed runs.
    ended : callable, optional
        Called with the row of every completed run, including those taken from the journal.

    Returns
    -------
    list of SweepRow
        Rows in the order of the plan, independent of the number of jobs and the order of completion.

    Raises
    ------
    ScenarioError
        If the folder contains a sweep and ``resume`` is False, or if it contains a sweep of another scenario. Also if
        the first run of a variant is invalid (for example because of a misspelt key); this is checked before anything
        is simulated.
    SimulationInterrupted
        On Ctrl-C.
    RecordError
        If a file cannot be written, a file of the resumed sweep is damaged, or another process is using the folder.
    WorkerError, ClusterError
        If no worker process can be started, or on the errors of :func:`dynsim.studies.cluster.run_on_cluster`.

    Notes
    -----
    Tables and statistics of the completed runs are also written if an exception ends the sweep early.
    """
    points = list(plan.points())
    check_writable(folder, (PLAN, JOURNAL, *TABLES, STATISTICS))
    if keep_records != "none":
        check_writable(folder / RECORDS)
    # A misspelt key would fail in every run, so the first run of each variant is checked in advance.
    for point in {point.variant: point for point in reversed(points)}.values():
        _ = plan.scenario(point) if point.run else plan.first
    header = _header(plan)
    with held_folder(folder):
        earlier = earlier_rows(folder, header, resume)
        rows = {point.run: earlier[point.identity].placed(point) for point in points if point.identity in earlier}
        left = [point for point in points if point.run not in rows]
        failed = sum(row.status != OK for row in rows.values())
        with _resumable(folder):
            write_text(folder / PLAN, json_text(header))
            with closing(SweepJournal(folder, rows.values())) as journal:

                def take(point: SweepPoint, result: RunResult) -> None:
                    nonlocal failed
                    # The record is saved before the row is written, because a run that has a row is not repeated.
                    if result.record is not None:
                        save_run(result.record, folder / RECORDS / f"{point.run:06d}")
                    row = rows[point.run] = SweepRow.of(point, result)
                    journal.add(row)
                    failed += row.status != OK
                    ended(row)
                    progress(len(rows), failed)

                progress(len(rows), failed)
                for row in rows.values():
                    ended(row)
                work = BatchWork(plan.scenario, keep_records)
                try:
                    interrupted = run_all(work, left, take, jobs=jobs, scheduler=scheduler)
                except BaseException:
                    with suppress(RecordError):
                        _write_results(rows, plan, folder)
                    raise
            done = _write_results(rows, plan, folder)
    if interrupted:
        raise SimulationInterrupted(f"interrupted after {len(done)} of {len(points)} runs; continue with --resume")
    return done


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Add to errors that completed runs are kept.

    A full disk, or a process or cluster that cannot be started, only stops the sweep.
    """
    try:
        yield
    except (RecordError, WorkerError, ClusterError) as error:
        raise type(error)(f"{error}; completed runs are in {folder / JOURNAL}; continue with --resume") from error


def _write_results(rows: Mapping[int, SweepRow], plan: Plan, folder: Path) -> list[SweepRow]:
    """Write the tables and statistics of the completed runs, and return their rows in the order of the plan."""
    done = [rows[run] for run in sorted(rows)]
    write_tables(done, plan, folder)
    if plan.laws:
        write_text(folder / STATISTICS, json_text(statistics(done, plan)))
    return done


def _header(plan: Plan) -> dict[str, Any]:
    """Return the data that all rows of a table must share, together with the plan of the sweep."""
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
    """Return the columns of the table, which are the columns of all rows in order of first occurrence."""
    names = dict.fromkeys(name for row in rows for name in row.cells())
    # Failed runs have no numbers.
    return [*(name for name in names if name != "warnings"), "warnings"]


def write_tables(rows: Sequence[SweepRow], plan: Plan, folder: Path) -> None:
    """Write ``sweep.csv`` and, with pyarrow, ``sweep.parquet``, in full precision; missing numbers are empty or null.

    Raises
    ------
    RecordError
        If a file cannot be written.
    """
    names = columns(rows)
    write_text(folder / TABLES[0], csv_table(names, [row.cells() for row in rows]))
    if has_parquet():
        _write_parquet(rows, names, folder / TABLES[1], plan)


def has_parquet() -> bool:
    """Return whether pyarrow is installed."""
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
            # This column has both numbers and texts, from a grid.
            arrays.append(pyarrow.array([None if value is None else json.dumps(value) for value in column]))
    table = pyarrow.table(arrays, names=list(names))
    described = {"dynsim": json.dumps(json.loads(json_text(_header(plan))))}
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(table.replace_schema_metadata(described), sink)
    with replacing(path) as stream:
        stream.write(sink.getvalue().to_pybytes())


def statistics(rows: Sequence[SweepRow], plan: Plan) -> list[dict[str, Any]]:
    """Return statistics for each variant and grid point.

    Each entry contains the number of runs, the number of failed runs, and a :class:`dynsim.record.sensitivity.Spread`
    for every number that all successful runs have. If a linear model can be fitted, it also has the change of the
    number per standard deviation of each sampled key (``effect``, with the half-width of its confidence interval) and
    the fraction of the variance that the model explains.
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
