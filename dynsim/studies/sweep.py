"""A sweep: carries out its runs, continues from its journal, writes the table of results and statistics."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine.provenance import commit
from dynsim.engine.results import save_run
from dynsim.errors import RecordError, SimulationInterrupted
from dynsim.record.sensitivity import sensitivities, spread
from dynsim.studies.batch import BatchWork, Keep, run_all
from dynsim.studies.cluster import ClusterError
from dynsim.studies.columns import csv_table
from dynsim.studies.journal import JOURNAL, OK, PLAN, SweepJournal, SweepRow, earlier_rows
from dynsim.studies.outcome import RunResult
from dynsim.studies.sweep_plan import Plan, SweepPoint
from dynsim.studies.worker import WorkerError
from dynsim.system.files import check_writable, held_folder, json_text, replacing, write_text

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
