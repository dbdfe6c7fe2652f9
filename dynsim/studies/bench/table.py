"""The result as tables for a terminal."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.table import Table

from dynsim.studies.bench import job, precision, variants
from dynsim.studies.bench.programs import (
    CONTENDERS,
    DYNSIM_DOPRI5,
    DYNSIM_RADAU5,
    MUJOCO_EULER,
    MUJOCO_IMPLICIT,
)


def format_table(result: dict[str, Any]) -> list[Table]:
    """The result as tables that fit 80 columns: microseconds, whole jobs, ratios."""
    sizes = result["right_hand_side"]
    times = _table("One right-hand side (Pinocchio: solve, MuJoCo: step), median µs", "links")
    for row in sizes:
        times.add_column(str(row["links"]), justify="right")
    for name in CONTENDERS:
        times.add_row(name, *(_number(row["median_us"].get(name)) for row in sizes))

    whole = _table("10 s of the published arm; largest errors against rtol 1e-11", "")
    whole.caption = "* another contact law, so its error is no measure"
    for heading in ("wall ms", "CPU ms", "hand mm", "rms mm", "current A"):
        whole.add_column(heading, justify="right")
    for case in job.CASES:
        whole.add_row(f"[bold]{case}[/bold]")
        by_program = {row["program"]: row for row in result["job"] if row["case"] == case}
        for program in (DYNSIM_DOPRI5, DYNSIM_RADAU5, MUJOCO_EULER, MUJOCO_IMPLICIT):
            row = by_program.get(program, {})
            whole.add_row(
                f"  {program}{'' if row.get('same_physics', True) else ' *'}",
                _number(row.get("wall_median_s"), 1e3),
                _number(row.get("cpu_median_s"), 1e3),
                _number(row.get("hand_error_max_m"), 1e3),
                _number(row.get("hand_error_rms_m"), 1e3),
                _number(row.get("current_error_max_A")),
            )

    ratios = _table(
        "Time (and hand error) of the peer over that of dynsim, by links and for the job (by radau5)", "peer"
    )
    for row in sizes:
        ratios.add_column(str(row["links"]), justify="right")
    ratios.add_column("job", justify="right")
    ratios.add_column("error", justify="right")
    task = ""
    for row in result["ratios"]:
        if "time_by_links" in row:
            ratios.add_row(row["peer"], *(_number(ratio) for ratio in row["time_by_links"].values()), "", "")
        elif row["dynsim"] == DYNSIM_RADAU5:
            if row["task"] != task:
                task = row["task"]
                ratios.add_row(f"[bold]{task.removeprefix('10 s job, ')}[/bold]")
            ratios.add_row(f"  {row['peer']}", *("" for _ in sizes), _number(row["time"]), _number(row["hand_error"]))

    work = _table("Work and precision: CPU ms and error at rtol 1e-6", "")
    work.caption = f"ratio: time of dopri5 over that of radau5 for an error of {precision.EQUAL_ERROR:g}"
    for method in precision.METHODS:
        work.add_column(method, justify="right")
        work.add_column("error", justify="right")
    work.add_column("ratio", justify="right")
    for scenario in dict.fromkeys(row["scenario"] for row in result["precision"]):
        rows = [row for row in result["precision"] if row["scenario"] == scenario]
        at = {row["method"]: row for row in rows if row["rtol"] == 1e-6}
        cells = [
            cell
            for method in precision.METHODS
            for cell in (_number(at[method]["cpu_minimum_s"], 1e3), f"{at[method]['error']:.0e}")
        ]
        equal = precision.work_at_equal_error(rows, "radau5", "dopri5", precision.EQUAL_ERROR)
        work.add_row(scenario, *cells, _number(equal))
    many = _table("Sweeps of 10 s of two elbows, wall s", "runs")
    jobs = sorted({row["jobs"] for row in result["sweeps"]})
    for count in jobs:
        many.add_column(f"{count} process{'es' if count > 1 else ''}", justify="right")
    for runs in dict.fromkeys(row["runs"] for row in result["sweeps"]):
        wall = {row["jobs"]: row["wall_s"] for row in result["sweeps"] if row["runs"] == runs}
        many.add_row(str(runs), *(_number(wall[count]) for count in jobs))

    elbows = _table("10 s jobs of all variants, least CPU ms", "")
    for method in variants.METHODS:
        elbows.add_column(method, justify="right")
    times_of = {(row["contacts"], row["variant"], row["method"]): row["cpu_minimum_s"] for row in result["variants"]}
    for contacts, variant in dict.fromkeys((row["contacts"], row["variant"]) for row in result["variants"]):
        least = (times_of.get((contacts, variant, method)) for method in variants.METHODS)
        elbows.add_row(f"{contacts}, {variant}", *(_number(seconds, 1e3) for seconds in least))
    return [times, whole, ratios, elbows, many, work]


def _table(title: str, first: str) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), title_justify="left", caption_justify="left")
    table.add_column(first, no_wrap=True)
    return table


def _number(value: float | None, scale: float = 1.0) -> str:
    """Three significant digits, or a dash for what was not measured."""
    if value is None:
        return "–"
    value *= scale
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"
