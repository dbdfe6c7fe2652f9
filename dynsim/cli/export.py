"""Command ``dynsim export``: converts records and robots to the formats of other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, cast

import typer

from dynsim.cli.app import SetOption, TrustOption, VariantOption, parsed_overrides
from dynsim.cli.tables import console
from dynsim.errors import RecordError, ScenarioError
from dynsim.system.terminal import escaped


class ExportFormat(StrEnum):
    csv = "csv"
    joint_trajectory = "joint-trajectory"
    urdf_log = "urdf-log"
    mcap = "mcap"
    urdf = "urdf"
    mjcf = "mjcf"


ROBOT_SUFFIXES = {ExportFormat.urdf: ".urdf", ExportFormat.mjcf: ".mjcf.xml"}
EXAMPLE = "Example: dynsim export elbow_comparison --format mjcf"


def export(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Record of a run (record.h5); for urdf and mjcf, a scenario.")
    ],
    format_: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="Formats for a record: csv, joint-trajectory (ROS), urdf-log (JSON lines), mcap (ROS 2 messages). "
            "Formats for the robot of a scenario: urdf, mjcf (MuJoCo).",
        ),
    ],
    rate: Annotated[
        float | None,
        typer.Option("--rate", help="Resample the joint motion to this rate [Hz]; default: no resampling."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Output file; default: a file next to the record; for a scenario, NAME.urdf or NAME.mjcf.xml.",
        ),
    ] = None,
    variant: VariantOption = None,
    overrides: SetOption = None,
    trust: TrustOption = False,
) -> None:
    """Export a record (CSV, ROS, ROS 2) or a robot (URDF, MuJoCo)."""
    if format_ in ROBOT_SUFFIXES:
        if rate is not None or trust:
            raise ScenarioError(
                f"--rate and --trust require a record; --format {format_.value} exports the robot of a scenario"
            )
        target = _export_robot(source, format_, variant, parsed_overrides(overrides), out)
    else:
        if variant is not None or overrides:
            raise RecordError(
                f"--variant and --set require --format urdf or mjcf; --format {format_.value} exports a record"
            )
        target = _export_record(Path(source), format_, rate, out, trust)
    console.print(f"written: {escaped(target)}")


def _export_robot(
    source: str, format_: ExportFormat, variant: str | None, overrides: dict[str, object], out: Path | None
) -> Path:
    from dynsim.scenario import build, build_model, load_scenario
    from dynsim.system.files import write_text

    if Path(source).suffix == ".h5":
        raise ScenarioError(f"{source} is a record; --format {format_.value} needs a scenario (file or shipped name)")
    scenario = load_scenario(source, variant, overrides)
    model = build_model(scenario)
    target = out or Path(f"{scenario.name}{ROBOT_SUFFIXES[format_]}")
    if format_ is ExportFormat.urdf:
        write_text(target, model.to_urdf())
    else:
        write_text(target, model.to_mjcf(build.contacts(scenario), build.surfaces(scenario)))
    return target


def _export_record(path: Path, format_: ExportFormat, rate: float | None, out: Path | None, trust: bool) -> Path:
    from dynsim.record import Record
    from dynsim.record.joint_motion import SUFFIX, Format, export_record

    record = Record.load(path, trust=trust)
    if format_ is not ExportFormat.mcap:
        kind = cast(Format, format_.value)
        return export_record(record, out or path.with_suffix(SUFFIX[kind]), kind, rate=rate)
    from dynsim.record.mcap_file import write_mcap

    if rate is not None:
        raise RecordError(
            "--rate does not apply to mcap files, which contain the samples of the record; set record.rate_hz"
        )
    return write_mcap(record, out or path.with_suffix(".mcap"))
