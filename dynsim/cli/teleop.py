"""Command ``dynsim teleop``: drives a scenario in real time from a browser."""

from __future__ import annotations

import itertools
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynsim.cli.app import (
    QuietOption,
    ScenarioArgument,
    SetOption,
    VariantOption,
    folder_option,
    option,
    parsed_overrides,
)
from dynsim.cli.drawing import open_address, write_view
from dynsim.cli.output import console, errors, print_line, print_written
from dynsim.errors import DynsimError
from dynsim.system import interruption
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.teleop.web.live import DriveReport

SpeedOption = Annotated[float, option("M/S", "Maximum speed of the hand or head [m/s].", min=1e-3, max=10.0)]
TurnOption = Annotated[float, option("RAD/S", "Maximum turning rate of the hand or head [rad/s].", min=1e-3, max=20.0)]
BaseSpeedOption = Annotated[float, option("M/S", "Maximum speed of the mobile base [m/s].", min=1e-3, max=10.0)]
LongestOption = Annotated[float, option("S", "Maximum duration [s].", min=1.0, max=36000.0)]
HttpPortOption = Annotated[int, option("N", "Local port of the web page; 0 picks a free one.", min=0, max=65535)]
UntilClosedOption = Annotated[
    bool, typer.Option("--until-closed", help="End also when the last browser window is closed.")
]
OpenOption = Annotated[bool, typer.Option("--open/--no-open", help="Open the web page in a browser.")]

# A delay with respect to real time is reported at the end if it exceeds this value [s].
LATE = 0.05


def teleop(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    out: Annotated[Path | None, folder_option("a new folder results/SCENARIO/drive_N")] = None,
    speed: SpeedOption = 0.1,
    turn: TurnOption = 0.5,
    base_speed: BaseSpeedOption = 0.3,
    longest: LongestOption = 600.0,
    http_port: HttpPortOption = 0,
    until_closed: UntilClosedOption = False,
    open_: OpenOption = True,
    quiet: QuietOption = False,
) -> None:
    """Drive a scenario live from a browser with keyboard, gamepad or touch.

    The robot moves only while the dead-man switch is held: space bar, shoulder button, or a finger on a stick. The
    drive is saved; `dynsim run FOLDER/scenario.yaml` repeats it bit for bit.
    """
    require("live", "websockets")
    from dynsim.engine.recording import RUN_FILES, save_drive
    from dynsim.scenario import load_scenario
    from dynsim.system.files import check_writable
    from dynsim.teleop.snake import SpeedLimits, begin
    from dynsim.teleop.web.live import LiveDrive

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    folder = out or new_folder(Path("results", loaded.name))
    check_writable(folder, RUN_FILES)
    with console.status("loading the kernels; on first use, compiling them takes half a minute"):
        session = begin(loaded, limits=SpeedLimits(speed, turn, base_speed), longest=longest)
    drive = LiveDrive(session, loaded.variant or loaded.name)
    try:
        address = drive.open(http_port)
        print_address(address, "Ctrl-C ends the drive and saves it", open_=open_)
        drive.run(until_closed=until_closed)
    except KeyboardInterrupt:
        # The user interrupted the drive before its first tick.
        interruption.answered()
        drive.report.ended = "interrupted"
    finally:
        drive.close()
    report = drive.report
    if session.ticks == 0:
        console.print(f"The drive ended before it began ({escaped(report.ended)}); nothing was saved", soft_wrap=True)
        return
    record = session.record() if report.stop is None or report.stop.record is None else report.stop.record
    save_drive(record, folder)
    interruption.heed()
    if not quiet:
        print_drive(report, session.ticks * session.period, folder)
    write_view({loaded.variant or loaded.name: record}, folder, quiet)
    if report.stop is not None:
        errors.print(f"results up to the stop are in {escaped(folder)} and are marked incomplete")
        raise report.stop


def require(extra: str, *packages: str) -> None:
    """Raise DynsimError if a package of an optional extra of dynsim is not installed."""
    for package in packages:
        if find_spec(package) is None:
            raise DynsimError(f"{package} is not installed: pip install 'dynsim[{extra}]'")


def print_address(address: str, ending: str, *, open_: bool, action: str = "Drive") -> None:
    """Print the address of the page, even with --quiet, because the user needs it."""
    print_line(f"{action} in a browser on this machine: {address}")
    console.print(ending, highlight=False)
    if open_:
        open_address(address)


def new_folder(parent: Path) -> Path:
    """Return the first of ``drive_1``, ``drive_2``, … that does not exist, so that no earlier drive is overwritten."""
    return next(folder for k in itertools.count(1) if not (folder := parent / f"drive_{k}").exists())


def print_drive(report: DriveReport, driven: float, folder: Path) -> None:
    """Print the timing of a drive of ``driven`` seconds, its folder, and how to repeat it."""
    late = sorted(report.late)
    middle, most = 1e3 * late[len(late) // 2], 1e3 * late[-1 - len(late) // 100]
    text = (
        f"Driven for {driven:.1f} s ({escaped(report.ended)}); "
        f"tick delay: median {middle:.1f} ms, 99th percentile {most:.1f} ms"
    )
    behind = f"; {report.lost:.1f} s behind real time" if report.lost > LATE else ""
    print_line(text + behind)
    print_written(folder)
    script = escaped(folder / "scenario.yaml")
    print_line(f"Repeat this drive: dynsim run {script}")
