"""A sweep: its runs, a journal that outlives whatever ends it, and a table of parameters and numbers."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dynsim._version import __version__
from dynsim.engine.provenance import commit
from dynsim.engine.results import save_run
from dynsim.errors import RecordError, ScenarioError, SimulationInterrupted
from dynsim.studies.batch import Keep, RunResult, Work, run_all, shares_lanes
from dynsim.studies.columns import numbers
from dynsim.studies.plan import Plan, Point
from dynsim.studies.sweep_statistics import statistics
from dynsim.system.files import json_text, replacing, write_text

PLAN, JOURNAL = "sweep.json", "runs.jsonl"
TABLES = ("sweep.csv", "sweep.parquet")
STATISTICS = "statistics.json"
OK, FAILED, LOST = "ok", "failed", "lost"


@dataclass(frozen=True)
class Row:
    """One run of the table: its numbers, or why there are none.

    Attributes
    ----------
    run, variant, values : see :class:`dynsim.studies.plan.Point`
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
    def of(cls, point: Point, result: RunResult) -> Row:
        """A result as a row."""
        status = OK if result.ok else LOST if result.lost else FAILED
        warnings = "; ".join(result.summary.get("warnings", ()))
        return cls(point.run, point.variant, point.values, status, result.reason, numbers(result.summary), warnings)

    def cells(self) -> dict[str, Any]:
        """By column."""
        variant = {} if self.variant is None else {"variant": self.variant}
        ended = {"status": self.status, "reason": self.reason}
        return {"run": self.run, **variant, **self.values, **ended, **self.numbers, "warnings": self.warnings}


def run_sweep(
    plan: Plan,
    folder: Path,
    *,
    jobs: int = 1,
    keep_records: Keep = "none",
    resume: bool = False,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Run what a plan asks for and write plan, journal, records, tables and statistics of samples to a folder.

    Parameters
    ----------
    folder : for the files; the journal ``runs.jsonl`` has a line for every run that is done, as soon as it is
    jobs, keep_records, scheduler : see :func:`dynsim.studies.batch.simulate_batch`
    resume : take over what the folder's journal has of the same scenario; only lost runs and those not there are run
    progress : called with how many runs are done and how many of them have failed

    Returns
    -------
    list of Row
        In the order of the plan, the same whatever the jobs and the order in which they ended.

    Raises
    ------
    ScenarioError
        The folder holds a sweep and ``resume`` is not asked for, or one of another scenario; the first run of a
        variant is none (a key is misspelt), so that nothing is run.
    SimulationInterrupted
        Ctrl-C; tables of what was done are written.
    RecordError
        A file cannot be written.
    """
    points = list(plan.points())
    header = _header(plan)
    earlier = _earlier(folder, header, resume)
    rows = {point.run: _renumbered(earlier[point.identity], point) for point in points if point.identity in earlier}
    left = [point for point in points if point.run not in rows]
    # A key that no scenario has would fail in every run: the first of each variant tells.
    firsts = [plan.scenario(point) for point in {point.variant: point for point in reversed(left)}.values()]
    lanes = any(map(shares_lanes, firsts))
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / PLAN, json_text(header))
    failed = sum(row.status != OK for row in rows.values())

    with _journal(folder, rows.values()) as journal:

        def take(point: Point, result: RunResult) -> None:
            nonlocal failed
            row = rows[point.run] = Row.of(point, result)
            journal.write(_line(row))
            journal.flush()
            if result.record is not None:
                save_run(result.record, folder / "records" / f"{point.run:06d}")
            failed += row.status != OK
            if progress is not None:
                progress(len(rows), failed)

        if progress is not None:
            progress(len(rows), failed)
        interrupted = run_all(Work(plan.scenario, keep_records), left, take, lanes, jobs=jobs, scheduler=scheduler)
    done = [rows[run] for run in sorted(rows)]
    write_tables(done, plan, folder)
    if plan.laws:
        write_text(folder / STATISTICS, json_text(statistics(done, plan)))
    if interrupted:
        raise SimulationInterrupted(f"interrupted when {len(done)} of {len(points)} runs were done; --resume goes on")
    return done


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


def _earlier(folder: Path, header: Mapping[str, Any], resume: bool) -> dict[str, Row]:
    """Runs of the journal by their identity, but for lost ones."""
    journal, plan = folder / JOURNAL, folder / PLAN
    if not journal.exists():
        return {}
    if not resume:
        raise ScenarioError(f"{folder} holds a sweep: --resume goes on with it; or give another --out, or remove it")
    try:
        before = json.loads(plan.read_text("utf-8"))
        lines = journal.read_text("utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise RecordError(f"{folder}: its sweep cannot be read ({error}); remove it, or give another --out") from error
    now = json.loads(json_text(header))
    for key in ("scenario", "overrides", "dynsim_version", "commit"):
        if before.get(key) != now[key]:
            raise ScenarioError(
                f"{folder} holds a sweep of another {key}, which cannot be gone on with: give another --out"
            )
    rows = {}
    for line in lines:
        # A process that was killed may have left the last one unfinished.
        with suppress(ValueError, TypeError):
            row = Row(**json.loads(line))
            if row.status != LOST:
                rows[Point(row.run, row.variant, row.values).identity] = row
    return rows


def _renumbered(row: Row, point: Point) -> Row:
    """A row of an earlier plan, in the place that this one has for it."""
    return Row(point.run, point.variant, point.values, row.status, row.reason, row.numbers, row.warnings)


def _line(row: Row) -> str:
    return json.dumps(vars(row)) + "\n"


def _journal(folder: Path, rows: Iterable[Row]) -> Any:
    """The journal, with what is known written anew, open for what comes."""
    path = folder / JOURNAL
    write_text(path, "".join(map(_line, rows)))
    return path.open("a", encoding="utf-8")


def columns(rows: Sequence[Row]) -> list[str]:
    """Columns of the table: of all rows, in the order in which the first that has one has it."""
    names = dict.fromkeys(name for row in rows for name in row.cells())
    # Failed runs have no numbers.
    return [*(name for name in names if name != "warnings"), "warnings"]


def write_tables(rows: Sequence[Row], plan: Plan, folder: Path) -> None:
    """Write ``sweep.csv`` and, with pyarrow, ``sweep.parquet``: all digits, an empty field or null for no number.

    Raises
    ------
    RecordError
        A file cannot be written.
    """
    names = columns(rows)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        cells = row.cells()
        writer.writerow(["" if cells.get(name) is None else cells[name] for name in names])
    write_text(folder / TABLES[0], stream.getvalue())
    if has_parquet():
        _write_parquet(rows, names, folder / TABLES[1], plan)


def has_parquet() -> bool:
    """Whether pyarrow is there."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        return False
    return True


def _write_parquet(rows: Sequence[Row], names: Sequence[str], path: Path, plan: Plan) -> None:
    import pyarrow
    from pyarrow import parquet

    cells = [row.cells() for row in rows]
    arrays = []
    for name in names:
        column = [one.get(name) for one in cells]
        if any(isinstance(value, float) for value in column):
            column = [float(value) if isinstance(value, int) else value for value in column]
        try:
            arrays.append(pyarrow.array(column))
        except (pyarrow.ArrowInvalid, pyarrow.ArrowTypeError):
            # A grid of numbers and texts.
            arrays.append(pyarrow.array([None if value is None else json.dumps(value) for value in column]))
    table = pyarrow.table(arrays, names=list(names))
    described = {"dynsim": json.dumps(json.loads(json_text(_header(plan))))}
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(table.replace_schema_metadata(described), sink)
    with replacing(path) as stream:
        stream.write(sink.getvalue().to_pybytes())
