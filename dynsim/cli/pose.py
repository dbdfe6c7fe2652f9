"""Command ``dynsim pose``: changes the start posture of a scenario in a browser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynsim.cli.app import ScenarioArgument, SetOption, VariantOption, parsed_overrides
from dynsim.cli.drawing import open_page, print_page
from dynsim.cli.output import console, print_line, print_warning
from dynsim.cli.teleop import HttpPortOption, OpenOption, UntilClosedOption, print_address, require
from dynsim.errors import DynsimError
from dynsim.system import interruption

if TYPE_CHECKING:
    from dynsim.record import Record
    from dynsim.scenario import Scenario
    from dynsim.teleop.posture import StartPosture

PrintOption = Annotated[
    bool, typer.Option("--print", help="Print positions, gaps and keys of the start posture as YAML, without a page.")
]
EXAMPLE = "Example: dynsim pose elbow_comparison --variant elbow_4"


def pose(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    http_port: HttpPortOption = 0,
    until_closed: UntilClosedOption = False,
    open_: OpenOption = True,
    print_: PrintOption = False,
) -> None:
    """Find a start posture in a browser, with live gaps and torques, and copy its keys as YAML.

    The page has a slider for each joint, moves the hand to a point, puts contact points onto their surfaces, and marks
    bodies below surfaces. The command writes no files; when it ends, it prints the keys of a changed posture.
    """
    from dynsim.scenario import load_scenario
    from dynsim.teleop.posture import open_posture

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    if print_:
        _print_start(open_posture(loaded))
        return
    require("live", "websockets")
    from dynsim.teleop.web.posing import LivePosture

    with console.status("loading the kernels; on first use, compiling them takes half a minute"):
        live = LivePosture(open_posture(loaded), loaded.variant or loaded.name)
        address = live.open(http_port)
    try:
        print_address(address, "Ctrl-C ends the command", open_=open_, action="Pose the robot")
        live.run(until_closed=until_closed)
    except KeyboardInterrupt:
        interruption.answered()
    finally:
        live.close()
    if live.posture.changed:
        print_line("Keys of the posture:")
        typer.echo("".join(live.posture.text().values()), nl=False)


def _print_start(posture: StartPosture) -> None:
    """Print the hand, contact points and bodies below surfaces as comments, and the keys of the posture."""
    frame = posture.frame()
    lines = [] if frame["hand"] is None else [f"hand at {frame['hand']} m"]
    for point in frame["points"]:
        force = "" if point["force"] is None else f", normal force {point['force']:.4g} N"
        disabled = "" if point["enabled"] else ", disabled"
        gap = 1e3 * round(point["gap"], 7) + 0.0
        lines.append(f"{point['name']} at {point['at']} m, gap {gap:+.4f} mm from {point['surface']}{force}{disabled}")
    below = [entry for entry in frame["near"] if entry["gap"] < entry["least"]]
    lines += [f"{entry['body']}: axis {-1e3 * entry['gap']:.4g} mm below {entry['surface']}" for entry in below]
    typer.echo("".join([*(f"# {line}\n" for line in lines), *frame["text"].values()]), nl=False)
    for note in filter(None, (posture.note, frame["rest"])):
        print_warning(note)


# Hides the plots and the time axis of a page with a single posture.
_NO_TIME = 'document.head.append(D.element("style", { textContent: "#side, footer { display: none !important; }" }));'


def view_starts(variants: Sequence[Scenario]) -> None:
    """Write a page with the start postures of the variants of a scenario, side by side, and open it."""
    from dynsim.draw.page import Inline, page
    from dynsim.teleop.posture import open_posture

    shown: dict[str, Record] = {}
    for loaded in variants:
        try:
            shown[loaded.variant or loaded.name] = open_posture(loaded).picture()
        except DynsimError as error:
            print_warning(f"no picture of the start: {error}")
    if not shown:
        return
    path = Path("results", variants[0].name, "start.html")
    path.parent.mkdir(parents=True, exist_ok=True)
    Inline(page(shown, scripts=[_NO_TIME])).save(path)
    print_page(path, quiet=False)
    open_page(path)
