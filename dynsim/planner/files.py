"""Output files of a brace plan: plan.json, plan.yaml, plan_table.csv and .json, figures and view.html.

plan.yaml is a runnable scenario. :mod:`dynsim.planner.pictures` draws the figures and view.html.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynsim.planner.answer import BracePlan
from dynsim.planner.vary import Variation
from dynsim.record.csv_rows import csv_table
from dynsim.scenario import to_yaml
from dynsim.system.files import check_writable, replacing, write_json

if TYPE_CHECKING:
    from dynsim.draw.figures.look import Look

PLAN_FILES = ("plan.json", "plan.yaml", "plan_table.csv", "plan_table.json", "view.html")
VARIATION_FILES = ("vary.json", "vary_table.csv", "vary_table.json")


def check_plan_folder(folder: Path, varied: bool = False) -> None:
    """Raise an error before planning starts if the files of a plan cannot be written to the folder."""
    check_writable(folder, (*PLAN_FILES, *(VARIATION_FILES if varied else ())))


def _write_tables(path: Path, table: list[dict[str, Any]]) -> None:
    """Write a table as JSON and CSV; the suffix is appended to the path."""
    write_json(path.with_suffix(".json"), table)
    columns = list(dict.fromkeys(key for row in table for key in row))
    with replacing(path.with_suffix(".csv")) as stream:
        stream.write(csv_table(columns, table).encode())


def save_plan(
    plan: BracePlan,
    folder: Path,
    figures: bool = True,
    kind: str = "png",
    look: Look | None = None,
    variation: Variation | None = None,
) -> None:
    """Write the files of a plan, and of the plans for several values, and replace the files of an earlier plan.

    If no plan was found, only plan.json and the tables are written. Without ``figures``, the figures and view.html are
    omitted. Remaining files of an earlier plan are removed, because they would not match the new numbers.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = [folder / "view.html", *(folder / "figures").glob("plan_*")]
    write_json(folder / "plan.json", plan.json)
    _write_tables(folder / "plan_table", plan.table)
    for name in VARIATION_FILES:
        (folder / name).unlink(missing_ok=True)
    if variation is not None:
        write_json(folder / "vary.json", variation.json)
        _write_tables(folder / "vary_table", variation.table)
    for earlier in (folder / "plan.yaml", *drawn) if plan.best is None else drawn:
        earlier.unlink(missing_ok=True)
    if plan.best is None:
        return
    with replacing(folder / "plan.yaml") as stream:
        stream.write(to_yaml(plan.yaml).encode())
    if figures:
        from dynsim.planner.pictures import draw_plan

        draw_plan(plan, folder, kind, look, variation)
