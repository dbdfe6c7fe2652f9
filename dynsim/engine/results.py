"""Names and writing of the files of a run: record, summary and scenario, replaced together."""

from __future__ import annotations

from pathlib import Path

from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.scenario import to_yaml
from dynsim.system.files import discard, json_text, replace_together, write_text

RUN_FILES = ("record.h5", "summary.json", "scenario.yaml")
# Files that are made from records, and can be made again.
FIGURE_FORMATS = ("png", "pdf", "svg")
VIEW = "view.html"
FIGURES = (*(f"figures/*.{kind}" for kind in FIGURE_FORMATS), "figures/animation.gif", VIEW)
COMPARISON_FILES = ("comparison.json", "comparison.csv", *(f"compare_*.{kind}" for kind in FIGURE_FORMATS), VIEW)


def save_run(record: Record, folder: Path) -> None:
    """Write ``record.h5``, ``summary.json`` and the resolved ``scenario.yaml`` to a folder: all three or none.

    A process that dies while it exchanges them leaves a file ``INCOMPLETE`` there, which :meth:`Record.load` heeds.

    Raises
    ------
    RecordError
        A file cannot be written; older ones are left as they were.
    """
    contents: dict[str, bytes | memoryview] = {
        "record.h5": record.to_hdf5(),
        "summary.json": json_text(record.summary).encode("utf-8"),
        "scenario.yaml": to_yaml(record.provenance["scenario"]).encode("utf-8"),
    }
    # Figures of another record must not lie beside this one.
    discard(folder, FIGURES)
    replace_together(folder, contents)


def save_drive(record: Record, folder: Path) -> None:
    """:func:`save_run` of a live drive; if the record cannot be written, the script that reproduces it is kept.

    Raises
    ------
    RecordError
        Not all of it could be written; says whether the script was.
    """
    try:
        save_run(record, folder)
    except RecordError as error:
        script = folder / "scenario.yaml"
        try:
            write_text(script, to_yaml(record.provenance["scenario"]))
        except RecordError:
            raise error from None
        raise RecordError(f"{error}; the script is kept, and makes the record again: dynsim run {script}") from None
