"""Command ``dynsim teleop``: drives a scenario in real time from a browser."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynsim.cli.app import QuietOption, ScenarioArgument, SetOption, VariantOption, folder_option, parsed_overrides
from dynsim.cli.drawing import open_address, write_view
from dynsim.cli.tables import console, errors, say, say_written
from dynsim.errors import DynsimError
from dynsim.system import interruption
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.teleop.web.live import DriveReport

SpeedOption = Annotated[float, typer.Option(metavar="M/S", min=1e-3, max=10.0, help="Fastest hand or head.")]
TurnOption = Annotated[float, typer.Option(metavar="RAD/S", min=1e-3, max=20.0, help="Fastest turn.")]
BaseSpeedOption = Annotated[float, typer.Option(metavar="M/S", min=1e-3, max=10.0, help="Fastest mobile base.")]
LongestOption = Annotated[float, typer.Option(metavar="S", min=1.0, max=36000.0, help="Longest drive.")]
HttpPortOption = Annotated[
    int, typer.Option(metavar="N", min=0, max=65535, help="Of the page on this machine; 0: a free one.")
]
UntilClosedOption = Annotated[
    bool, typer.Option("--until-closed", help="End when the last browser is closed, not only by button or Ctrl-C.")
]
OpenOption = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")]

# Ticks later than this are reported at the end [s].
LATE = 0.05


def teleop(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    out: Annotated[Path | None, folder_option("results/SCENARIO/drive_N, a new one")] = None,
    speed: SpeedOption = 0.1,
    turn: TurnOption = 0.5,
    base_speed: BaseSpeedOption = 0.3,
    longest: LongestOption = 600.0,
    http_port: HttpPortOption = 0,
    until_closed: UntilClosedOption = False,
    open_: OpenOption = True,
    quiet: QuietOption = False,
) -> None:
    """Drive a scenario from a browser: keyboard, gamepad or sticks on the screen.

    Velocities count only while the dead-man's key is held: space, a shoulder button, or a finger on a stick. The drive
    is saved with a scenario that repeats it: `dynsim run FOLDER/scenario.yaml` gives the same record, bit for bit.
    """
    require_websockets()
    from dynsim.engine.recording import RUN_FILES, save_drive
    from dynsim.scenario import load_scenario
    from dynsim.system.files import check_writable
    from dynsim.teleop.snake import SpeedLimits, begin
    from dynsim.teleop.web.live import LiveDrive

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    folder = out or new_folder(Path("results", loaded.name))
    check_writable(folder, RUN_FILES)
    with console.status("loading the kernels; the first time they are compiled, which takes half a minute"):
        session = begin(loaded, limits=SpeedLimits(speed, turn, base_speed), longest=longest)
    drive = LiveDrive(session, loaded.variant or loaded.name)
    try:
        address = drive.open(http_port)
        tell_address(address, "Ctrl-C ends the drive and saves it", open_=open_)
        drive.run(until_closed=until_closed)
    except KeyboardInterrupt:
        # Before the first tick.
        interruption.answered()
        drive.report.ended = "interrupted"
    finally:
        drive.close()
    report = drive.report
    if session.ticks == 0:
        console.print(f"The drive is over ({escaped(report.ended)}) before it began; nothing is saved", soft_wrap=True)
        return
    record = session.record() if report.stop is None or report.stop.record is None else report.stop.record
    save_drive(record, folder)
    interruption.heed()
    if not quiet:
        tell_drive(report, session.ticks * session.period, folder)
    write_view({loaded.variant or loaded.name: record}, folder, quiet)
    if report.stop is not None:
        errors.print(f"what was simulated until then is in {escaped(folder)}, marked incomplete")
        raise report.stop


def require_websockets() -> None:
    """Raises DynsimError where the package is not installed."""
    try:
        import websockets  # noqa: F401
    except ModuleNotFoundError:
        raise DynsimError("a live drive needs websockets: pip install 'dynsim[live]'") from None


def tell_address(address: str, ending: str, *, open_: bool) -> None:
    """Say where to drive; also with --quiet: nobody could drive without it."""
    say(f"To be driven in a browser on this machine: {address}")
    console.print(ending, highlight=False)
    if open_:
        open_address(address)


def new_folder(parent: Path) -> Path:
    """The first of ``drive_1``, ``drive_2``, … that is not there: a drive cannot be made again by driving."""
    return next(folder for k in itertools.count(1) if not (folder := parent / f"drive_{k}").exists())


def tell_drive(report: DriveReport, driven: float, folder: Path) -> None:
    """How a drive of so many seconds went, where it is, and how it is repeated."""
    late = sorted(report.late)
    middle, most = 1e3 * late[len(late) // 2], 1e3 * late[-1 - len(late) // 100]
    text = f"Driven for {driven:.1f} s ({escaped(report.ended)}); ticks late by {middle:.1f} ms, 99 % by {most:.1f} ms"
    behind = f"; {report.lost:.1f} s behind real time" if report.lost > LATE else ""
    say(text + behind)
    say_written(folder)
    script = escaped(folder / "scenario.yaml")
    say(f"The same drive again: dynsim run {script}")
