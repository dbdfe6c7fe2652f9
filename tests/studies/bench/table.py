"""Tables of the benchmark for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rich import box
from rich.table import Table

from studies.bench import job, precision, snake
from studies.bench.programs import JOBS, RIGHT_HAND_SIDES

Row = Mapping[str, Any]

SNAKE_COLUMNS = {
    "µs/step": ("us_per_step", 1.0),
    "× real time": ("times_real_time", 1.0),
    "Δz mm": ("z_rms_m", 1e3),
    "Δβ mrad": ("beta_rms_rad", 1e3),
}
# The tolerances that fit; all are in the JSON.
_RTOLS = precision.RTOLS[::2]


def format_table(result: dict[str, Any]) -> list[Table]:
    """Return the result as tables that fit 80 columns; dashes for missing measurements."""
    columns: dict[str, Callable[[Row], str]] = {
        "CPU ms": lambda row: _number(row["cpu_median_s"], 1e3),
        "hand mm": lambda row: _number(row["hand_error_max_m"], 1e3),
        "rms mm": lambda row: _number(row["hand_error_rms_m"], 1e3),
        "current A": lambda row: _number(row["current_error_max_A"]),
        "same law": lambda row: "yes" if row["same_physics"] else "no",
    }
    return [
        _table(
            "One right-hand side (Pinocchio: solve, MuJoCo: step), median µs, by links",
            _cells(result["right_hand_side"], "program", "links", lambda row: _number(row["median_us"])),
            down=RIGHT_HAND_SIDES,
        ),
        *(
            _table(
                f"10 s, {case}; largest errors against rtol 1e-11",
                {
                    (row["program"], head): show(row)
                    for row in result["job"]
                    if row["case"] == case
                    for head, show in columns.items()
                },
                down=JOBS,
                across=columns,
            )
            for case in job.CASES
        ),
        _table(
            "10 s of all variants, radau5",
            {(row["variant"], "least CPU ms"): _number(row["cpu_minimum_s"], 1e3) for row in result["variants"]},
        ),
        _table(
            "The dynamic snake, six runs of 10 s; rms from the paper's Table III",
            {
                (row["program"], head): _number(row[key], scale)
                for row in result["snake"]
                for head, (key, scale) in SNAKE_COLUMNS.items()
            },
            down=snake.SNAKES,
            across=SNAKE_COLUMNS,
        ),
        _table(
            "Sweeps of 10 s of two elbows, wall s, by processes",
            _cells(result["sweeps"], "runs", "jobs", lambda row: _number(row["wall_s"])),
        ),
        *(
            _table(
                f"Work and precision of {method}: CPU ms and error by rtol",
                _cells(
                    (row for row in result["precision"] if row["method"] == method and row["rtol"] in _RTOLS),
                    "scenario",
                    "rtol",
                    lambda row: f"{_number(row['cpu_minimum_s'], 1e3)} / {row['error']:.0e}",
                ),
            )
            for method in dict.fromkeys(row["method"] for row in result["precision"])
        ),
    ]


def _cells(rows: Iterable[Row], down: str, across: str, show: Callable[[Row], str]) -> dict[tuple[str, str], str]:
    return {(str(row[down]), str(row[across])): show(row) for row in rows}


def _table(
    title: str,
    cells: Mapping[tuple[str, str], str],
    *,
    down: Iterable[str] | None = None,
    across: Iterable[str] | None = None,
) -> Table:
    """Return a table of cells by row and column; by default all rows and columns of the cells, in their order."""
    heads = list(across or dict.fromkeys(column for _, column in cells))
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), title_justify="left")
    table.add_column("", no_wrap=True)
    for head in heads:
        table.add_column(head, justify="right")
    for row in down or dict.fromkeys(row for row, _ in cells):
        table.add_row(row, *(cells.get((row, head), "–") for head in heads))
    return table


def _number(value: float, scale: float = 1.0) -> str:
    """Return a value with three significant digits."""
    value *= scale
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"
