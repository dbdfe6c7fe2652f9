"""Command ``dynsim hw drive``: a pilot drives a simulation in real time and servos follow it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from dynsim.cli.app import QuietOption, ScenarioArgument, SetOption, parsed_overrides
from dynsim.cli.display import errors
from dynsim.cli.hardware import (
    Configure,
    Faults,
    Live,
    MapFile,
    PolicyOption,
    Rate,
    ReplayPort,
    Yes,
    console,
    print_timing,
    replayed,
    require_client_library,
    tell_dry_run,
    tell_replay,
)
from dynsim.cli.teleop import (
    BaseSpeedOption,
    HttpPortOption,
    LongestOption,
    OpenOption,
    SpeedOption,
    TurnOption,
    UntilClosedOption,
    VariantOption,
    new_folder,
    require_websockets,
    tell_address,
    tell_drive,
)
from dynsim.cli.view import write_view
from dynsim.errors import DynsimError
from dynsim.system import interruption
from dynsim.system.terminal import escaped

EXAMPLE = "Example: dynsim hw drive elbow_comparison --variant two_elbows --map arm --port virtual"
SERVOS = "servos"
"""Folder of the measured run, in that of the drive."""


def hw_drive(
    scenario: ScenarioArgument,
    map_file: MapFile,
    port: ReplayPort,
    variant: VariantOption = None,
    overrides: SetOption = None,
    rate: Rate = None,
    policy: PolicyOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Default: results/SCENARIO/drive_N, a new one.")
    ] = None,
    speed: SpeedOption = 0.1,
    turn: TurnOption = 0.5,
    base_speed: BaseSpeedOption = 0.3,
    longest: LongestOption = 600.0,
    http_port: HttpPortOption = 0,
    until_closed: UntilClosedOption = False,
    open_: OpenOption = True,
    live: Live = False,
    yes: Yes = False,
    configure: Configure = False,
    faults: Faults = None,
    quiet: QuietOption = False,
) -> None:
    """Drive a scenario from a browser as `dynsim teleop` does, with servos that follow the simulated joints.

    Verify, arm and move to the start as a replay does; every posture is checked against the map before it is followed.
    Ctrl-C once: controlled stop. Twice: torque off. The button of the page ends the drive regularly.
    """
    require_websockets()
    require_client_library()
    from dynsim.cli.dialog import confirm_replay
    from dynsim.engine.results import RUN_FILES
    from dynsim.hardware.errors import ServoMapError
    from dynsim.hardware.ports import VIRTUAL, bus_on
    from dynsim.hardware.replay.drive import check_drive
    from dynsim.hardware.replay.session import shown_by
    from dynsim.hardware.servo_map import load_servo_map
    from dynsim.hardware.virtual.faults import load_fault_script
    from dynsim.scenario import load_scenario
    from dynsim.system.files import check_writable
    from dynsim.teleop.session import SpeedLimits
    from dynsim.teleop.web.follower import DriveRequest
    from dynsim.teleop.web.servos import SimulationProcess

    if faults and port != VIRTUAL:
        raise ServoMapError("--faults is for virtual servos: --port virtual")
    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    servo_map = load_servo_map(map_file)
    script = load_fault_script(faults, servo_map.ids) if faults else None
    folder = out or new_folder(Path("results", loaded.name))
    check_writable(folder, RUN_FILES)
    limits = SpeedLimits(speed, turn, base_speed)
    request = DriveRequest(loaded, servo_map, limits, longest, http_port, until_closed, folder)
    moves = live or port == VIRTUAL
    result: Any = None
    with SimulationProcess(request) as process:
        with console.status("loading the kernels; the first time they are compiled, which takes half a minute"):
            ready = process.ready()
        motion = check_drive(
            ready.first,
            servo_map,
            process.feed,
            step=ready.step,
            longest=longest,
            rate=rate,
            scene=ready.still.scene,
        )
        if live and port != VIRTUAL:
            confirm_replay(console, servo_map, motion, port, asked=not yes, at_most=True)
        if moves:
            tell_address(ready.address, "Ctrl-C stops the robot, a second one releases it", open_=open_)
        posture = dict(zip(servo_map.joints, motion.start.tolist(), strict=True))
        error: DynsimError | None = None
        try:
            with shown_by({"standard output": sys.stdout}, folder / SERVOS) as lost:
                result = replayed(
                    motion,
                    servo_map,
                    bus_on(port, servo_map, script=script, posture=posture, in_wall_time=True),
                    folder / SERVOS,
                    lost,
                    quiet=quiet,
                    live=moves,
                    policy=policy,
                    write_eeprom=configure,
                    provenance={
                        "port": port,
                        "record": str(folder / "record.h5"),
                        "simulated": ready.still.provenance,
                    },
                )
        except DynsimError as stopped:
            error, result = stopped, getattr(stopped, "result", None)
        # What was driven is saved, whatever else the user asks for.
        interruption.keep()
        try:
            done = process.finish("ended" if error is None else f"the servos have stopped: {error}")
        except DynsimError as lost_drive:
            if error is None:
                raise
            errors.print(f"[red]error:[/] {escaped(str(lost_drive))}")
            raise error from None
        interruption.heed()
    if result is not None and not quiet:
        print_timing(result)
    if not moves and error is None:
        tell_dry_run(result)
        return
    if done.saved:
        _tell_files(loaded.variant or loaded.name, folder, result, quiet=quiet)
        if not quiet:
            tell_drive(done.report, done.driven, folder)
    if error is None and not quiet:
        tell_replay(result, "driven", folder / SERVOS, folder / "record.h5")
    if error is not None:
        if done.failure is not None:
            errors.print(f"[red]error:[/] the simulation: {escaped(str(done.failure))}")
        raise error
    if done.failure is not None:
        raise done.failure


def _tell_files(name: str, folder: Path, result: Any, *, quiet: bool) -> None:
    """The page with the measured robot beside the simulated one."""
    from dynsim.record import Record

    records = {name: Record.load(folder / "record.h5")}
    if result is not None and len(result.record):
        records["measured"] = result.record
    write_view(records, folder, quiet)
