"""Command ``dynsim pose``: changes the start posture of a scenario in a browser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

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

EXAMPLE = "Example: dynsim pose elbow_comparison --variant elbow_4"


def pose(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    http_port: HttpPortOption = 0,
    until_closed: UntilClosedOption = False,
    open_: OpenOption = True,
) -> None:
    """Find a start posture in a browser, with live gaps and torques, and copy its keys as YAML.

    The page has a slider for each joint, moves the hand to a point, puts contact points onto their surfaces, and marks
    bodies below surfaces. The command writes no files; when it ends, it prints the keys of a changed posture.
    """
    require("live", "websockets")
    from dynsim.scenario import load_scenario
    from dynsim.teleop.posture import open_posture
    from dynsim.teleop.web.posing import LivePosture

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
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
