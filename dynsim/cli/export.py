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


OF_ROBOTS = {ExportFormat.urdf: ".urdf", ExportFormat.mjcf: ".mjcf.xml"}
EXAMPLE = "Example: dynsim export elbow_comparison --format mjcf"


def export(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="record.h5 of a run; for urdf and mjcf a scenario.")],
    format_: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="Of a record: csv, joint-trajectory (ROS), urdf-log (JSON lines), mcap (ROS 2 messages). "
            "Of a scenario's robot: urdf, mjcf (MuJoCo).",
        ),
    ],
    rate: Annotated[
        float | None, typer.Option("--rate", help="Resample joint motion [Hz]; default: the record's samples.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="File; default: beside the record, or NAME.urdf, NAME.mjcf.xml of a scenario."),
    ] = None,
    variant: VariantOption = None,
    overrides: SetOption = None,
    trust: TrustOption = False,
) -> None:
    """Write the motion of a record, or the robot of a scenario, for other programs."""
    if format_ in OF_ROBOTS:
        if rate is not None or trust:
            raise ScenarioError(f"--rate and --trust are for records; {format_.value} is of a scenario's robot")
        target = _export_robot(source, format_, variant, parsed_overrides(overrides), out)
    else:
        if variant is not None or overrides:
            raise RecordError(f"--variant and --set are for urdf and mjcf; {format_.value} is of a record")
        target = _export_record(Path(source), format_, rate, out, trust)
    console.print(f"written: {escaped(target)}")


def _export_robot(
    source: str, format_: ExportFormat, variant: str | None, overrides: dict[str, object], out: Path | None
) -> Path:
    from dynsim.scenario import build, build_model, load_scenario
    from dynsim.system.files import write_text

    if Path(source).suffix == ".h5":
        raise ScenarioError(f"{source}: is a record; {format_.value} is of a scenario: name its file, or a shipped one")
    scenario = load_scenario(source, variant, overrides)
    model = build_model(scenario)
    target = out or Path(f"{scenario.name}{OF_ROBOTS[format_]}")
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
        raise RecordError("--rate is for joint motion; an mcap file has the samples of the record: set record.rate_hz")
    return write_mcap(record, out or path.with_suffix(".mcap"))
