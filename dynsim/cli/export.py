"""Command ``dynsim export``: converts records and robots to the formats of other programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from dynsim.cli.app import SetOption, TrustOption, VariantOption, parsed_overrides
from dynsim.cli.output import console, print_line, print_warning
from dynsim.errors import DynsimError, RecordError, ScenarioError, first_few
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.model.description import Robot
    from dynsim.record.scene import Scene, Shape
    from dynsim.scenario import Scenario


class ExportFormat(StrEnum):
    csv = "csv"
    joint_trajectory = "joint-trajectory"
    urdf_log = "urdf-log"
    mcap = "mcap"
    urdf = "urdf"
    mjcf = "mjcf"


MUJOCO_TRIANGLES = 200_000
"""Maximum number of triangles of a mesh that MuJoCo reads."""
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
    joints: Annotated[
        str | None,
        typer.Option(
            "--joints",
            metavar="NAME,NAME",
            help="Joints to write, comma-separated; default: all joints, for joint-trajectory all with a motor.",
        ),
    ] = None,
    contacts: Annotated[
        bool,
        typer.Option(
            "--contacts",
            help="Let contact points and surfaces, and the solids of contacts.between, collide in MuJoCo (mjcf only).",
        ),
    ] = False,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Run the scenario in dynsim and in MuJoCo, and print the largest differences (mjcf only)."
        ),
    ] = False,
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
    if (contacts or check) and format_ is not ExportFormat.mjcf:
        raise ScenarioError(f"--contacts and --check require --format mjcf, got --format {format_.value}")
    if format_ in ROBOT_SUFFIXES:
        if rate is not None or trust or joints is not None:
            raise ScenarioError(
                "--rate, --joints and --trust require a record; "
                f"--format {format_.value} exports the robot of a scenario"
            )
        if Path(source).suffix == ".h5":
            raise ScenarioError(
                f"{source} is a record; --format {format_.value} needs a scenario (file or shipped name)"
            )
        from dynsim.scenario import load_scenario

        scenario = load_scenario(source, variant, parsed_overrides(overrides))
        target = out or Path(f"{scenario.name}{ROBOT_SUFFIXES[format_]}")
        if format_ is ExportFormat.urdf:
            _export_urdf(scenario, target)
        else:
            _export_mjcf(scenario, target, contacts, check)
    else:
        if variant is not None or overrides:
            raise RecordError(
                f"--variant and --set require --format urdf or mjcf; --format {format_.value} exports a record"
            )
        target = _export_record(Path(source), format_, rate, joints, out, trust)
    console.print(f"written: {escaped(target)}")


def _export_urdf(scenario: Scenario, target: Path) -> None:
    from dynsim.compile.model import Model
    from dynsim.engine.recording import pictured_parts
    from dynsim.record.scene import Scene
    from dynsim.scenario import build_model
    from dynsim.system.files import write_text

    robot = build_model(scenario).robot
    if omitted := [text for link in robot.links for text in link.omitted if not link.radius]:
        print_warning(f"{first_few(omitted)}: not exported")
    files = _addresses(pictured_parts(Scene(), scenario), _shapes(robot), target.parent)
    links = tuple(replace(link, shapes=_renamed(link.shapes, files)) for link in robot.links)
    write_text(target, Model(replace(robot, links=links, fixed_shapes=_renamed(robot.fixed_shapes, files))).to_urdf())


def _export_mjcf(scenario: Scenario, target: Path, touching: bool, check: bool) -> None:
    from dynsim.engine import mujoco_check
    from dynsim.engine.prepare import prepare
    from dynsim.scenario import build, build_model
    from dynsim.system.files import replacing, write_text

    model, gains, prepared = build_model(scenario), {}, None
    try:
        prepared = prepare(scenario)
    except DynsimError as error:
        if check:
            raise
        print_warning(f"the scenario cannot run, so that its controller is not exported: {error}")
    if prepared is not None and check:
        mujoco_check.mujoco_for(prepared)
    contacts = build.contacts(scenario, model.robot) if prepared is None else prepared.contacts
    if prepared is not None:
        model, control = prepared.model, prepared.control
        joints = [motor.joint for motor in model.robot.motors]
        gains = dict(zip(joints, zip(control.k_p.tolist(), control.k_d.tolist(), strict=True), strict=True))
        for text in mujoco_check.omissions(scenario, prepared, touching):
            print_warning(text)
    files, contents = _stl_files(scenario, _shapes(model.robot), f"{target.name.split('.')[0]}_meshes")
    pairs = build.solid_pairs(scenario, model.robot) if touching else []
    surfaces = build.surfaces(scenario)
    text = model.to_mjcf(contacts, surfaces, gains=gains, meshes=files, touching=touching, pairs=pairs)
    for name, content in contents.items():
        with replacing(target.parent / name) as stream:
            stream.write(content)
    write_text(target, text)
    if check and prepared is not None:
        from dynsim.engine import simulate

        for step, differences in mujoco_check.compare(prepared, simulate(scenario), target).items():
            print_line(f"largest differences from MuJoCo with steps of {1e3 * step:g} ms:")
            for d in differences:
                print_line(f"  {d.quantity} {d.value:.2e} {d.unit} ({escaped(d.label)}, t = {d.time:.4g} s)")


def _stl_files(scenario: Scenario, shapes: Iterable[Shape], folder: str) -> tuple[dict[str, str], dict[str, bytes]]:
    """Return paths by mesh, and contents by path, of STL files that MuJoCo can read; a warning lists other meshes."""
    from dynsim.draw.geometry.meshes import simplified, welded
    from dynsim.engine.recording import pictured_parts
    from dynsim.record.meshes import read_mesh, stl_bytes
    from dynsim.record.scene import Scene

    paths: dict[str, str] = {}
    contents: dict[str, bytes] = {}
    for name, path in _mesh_paths(pictured_parts(Scene(), scenario), shapes, "they are omitted").items():
        try:
            (mesh,) = simplified([welded(read_mesh(path))], MUJOCO_TRIANGLES)
        except (RecordError, ValueError) as error:
            print_warning(f"{error}; this mesh is omitted")
            continue
        paths[name] = f"{folder}/mesh_{len(paths) + 1}.stl"
        contents[paths[name]] = stl_bytes(mesh)
    return paths, contents


def _mesh_paths(scene: Scene, shapes: Iterable[Shape], otherwise: str) -> dict[str, Path]:
    """Return the mesh files that are found, by their name in the robot file; a warning lists the others."""
    from dynsim.draw.geometry.meshes import mesh_paths

    names = dict.fromkeys(shape.file for shape in shapes if shape.kind == "mesh")
    paths = mesh_paths(scene, names)
    if missing := [name for name in names if name not in paths]:
        print_warning(f"meshes not found: {first_few(missing)}; {otherwise}")
    return paths


def _shapes(robot: Robot) -> list[Shape]:
    return [*robot.fixed_shapes, *(shape for link in robot.links for shape in link.shapes)]


def _addresses(scene: Scene, shapes: Iterable[Shape], folder: Path | None = None) -> dict[str, str]:
    """Return the address ``file://PATH`` of each mesh file that is found, by its name in the robot file.

    Names that lead to the same file from a robot file in ``folder`` are omitted. A warning lists missing files.
    """
    from dynsim.draw.geometry.meshes import mesh_paths

    paths = _mesh_paths(scene, shapes, "their names are written unchanged")
    near = {} if folder is None else mesh_paths(replace(scene, mesh_folders=(str(folder.absolute()),)), paths)
    return {name: f"file://{path}" for name, path in paths.items() if name not in near or not path.samefile(near[name])}


def _renamed(shapes: Iterable[Shape], files: Mapping[str, str]) -> tuple[Shape, ...]:
    """Return the shapes with other names of mesh files."""
    return tuple(replace(shape, file=files.get(shape.file, shape.file)) for shape in shapes)


def _export_record(
    path: Path, format_: ExportFormat, rate: float | None, joints: str | None, out: Path | None, trust: bool
) -> Path:
    from dynsim.record import Record
    from dynsim.record.joint_motion import SUFFIX, Format, export_record

    record = Record.load(path, trust=trust)
    if format_ is not ExportFormat.mcap:
        kind = cast(Format, format_.value)
        names = None if joints is None else [name.strip() for name in joints.split(",")]
        return export_record(record, out or path.with_suffix(SUFFIX[kind]), kind, rate=rate, joints=names)
    from dynsim.record.mcap_file import write_mcap

    if rate is not None or joints is not None:
        raise RecordError(
            "--rate and --joints do not apply to mcap files, which contain the samples and joints of the record; set "
            "record.rate_hz"
        )
    if (scene := record.scene) is not None:
        files = _addresses(scene, (*scene.fixed, *(shape for body in scene.bodies for shape in body.shapes)))
        bodies = tuple(replace(body, shapes=_renamed(body.shapes, files)) for body in scene.bodies)
        record.scene = replace(scene, bodies=bodies, fixed=_renamed(scene.fixed, files))
    return write_mcap(record, out or path.with_suffix(".mcap"))
