"""Command ``dynsim plan``: finds the points of an arm to brace, their places, the postures and the brace forces."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynsim.cli.app import (
    FigureFormat,
    FiguresOption,
    FormatOption,
    QuietOption,
    ScenarioArgument,
    SetOption,
    VariantOption,
    parsed_overrides,
)
from dynsim.cli.tables import plan_progress, say, say_written
from dynsim.errors import ScenarioError, UnreachableReference
from dynsim.system.terminal import escaped

EXAMPLE = "Example: dynsim plan pressing --count 0:3 --candidates link_3:link_9"


def plan(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    candidates: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Points that may be braced: links (their joints), link_3:link_9, frames, contact points, with "
            "commas; default: all links but the first two, and all contact points.",
        ),
    ] = "",
    along: Annotated[
        list[float] | None,
        typer.Option(metavar="SHARE", help="Also points at this share of the way along the links; may be repeated."),
    ] = None,
    radius: Annotated[
        float | None, typer.Option(metavar="M", min=0.0, help="Radius of the candidates [m]; default: their links'.")
    ] = None,
    count: Annotated[str, typer.Option(metavar="MIN:MAX", help="Numbers of braces.")] = "0:3",
    surface: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Surfaces to lean on, may be repeated; default: all.")
    ] = None,
    weight: Annotated[
        list[str] | None,
        typer.Option(
            metavar="peak=VALUE", help="Cost of the greatest torque of revolute joints beside the heat [W/(N m)]."
        ),
    ] = None,
    clearance: Annotated[
        float, typer.Option(metavar="M", min=0.0, help="Clearance of joints that are not braced [m].")
    ] = 0.01,
    min_force: Annotated[float, typer.Option(metavar="N", min=0.0, help="Least normal force of a brace [N].")] = 0.5,
    verify: Annotated[
        bool, typer.Option("--verify/--no-verify", help="Run the plans with errors of the scene.")
    ] = True,
    friction_error: Annotated[
        float, typer.Option(metavar="SHARE", min=0.0, max=0.99, help="Error of friction that plans shall bear.")
    ] = 0.2,
    surface_error: Annotated[
        float, typer.Option(metavar="M", min=0.0, help="Error of the surfaces' height that plans shall bear [m].")
    ] = 0.005,
    gains: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Gains k_p [V/rad] to choose from, with commas; default: 500 to 5."),
    ] = None,
    exhaustive: Annotated[
        bool, typer.Option("--exhaustive", help="Try all sets of candidates, not only those that grow from the best.")
    ] = False,
    starts: Annotated[int, typer.Option(metavar="N", min=1, help="Independent rounds of the search.")] = 8,
    seed: Annotated[int, typer.Option(metavar="S", help="Of its random postures.")] = 0,
    explain: Annotated[
        bool, typer.Option("--explain", help="Find the errors of the scene that refused plans do bear.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="For the files; default: results/SCENARIO/plan.")
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=0, help="Processes that verify; default: all cores.")] = 0,
    no_figures: FiguresOption = False,
    format_: FormatOption = FigureFormat.png,
    quiet: QuietOption = False,
) -> None:
    """Plan braces: which points, on which surfaces, in what posture along the hand's path, with what forces and gains.

    For each number of braces the set of least copper heat, run in whole dynamics with friction and surfaces that are
    not as planned. plan.yaml runs the plans, a variant each: dynsim run results/SCENARIO/plan/plan.yaml.
    """
    from dynsim.scenario import load_scenario

    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    folder = out or Path("results", loaded.name, loaded.variant, "plan")
    least, most = _numbers(count)
    peak = _weights(weight or [])
    names = [name.strip() for name in candidates.split(",") if name.strip()]
    if candidates and not names:
        raise ScenarioError(f"--candidates {escaped(candidates)}: names nothing; leave it out for the default")
    from dynsim.planner.answer import plan_braces
    from dynsim.planner.files import check_plan_folder, save_plan
    from dynsim.planner.verify import Tolerances
    from dynsim.studies.processes import cores

    check_plan_folder(folder)
    errors = (0.0, surface_error, -surface_error) if surface_error > 0.0 else (0.0,)
    factors = (1.0, 1.0 - friction_error, 1.0 + friction_error) if friction_error > 0.0 else (1.0,)
    chosen = Tolerances.gains if gains is None else _gains(gains)
    tolerances = Tolerances(friction=factors, shift_m=errors, gains=chosen)
    with plan_progress(quiet) as tell:
        result = plan_braces(
            loaded,
            candidates=names,
            along=along or (),
            radius_m=radius,
            count=(least, most),
            surfaces=surface or (),
            peak_W_per_N_m=peak,
            clearance_m=clearance,
            min_N=min_force,
            verify=verify,
            explain=explain,
            exhaustive=exhaustive,
            starts=starts,
            seed=seed,
            jobs=jobs or cores(),
            tolerances=tolerances,
            tell=tell,
        )
        tell("writing", 0.98)
        save_plan(result, folder, figures=not no_figures, kind=format_.value)
    if not quiet:
        from dynsim.cli.tables import print_plan

        print_plan(result)
        say_written(folder)
        if result.best is not None:
            say(f"To run the best: dynsim run {escaped(folder / 'plan.yaml')}")
    if result.best is None:
        raise UnreachableReference(f"no plan: {escaped(result.sizes[0].reason)}")


def _numbers(text: str) -> tuple[int, int]:
    """``0:3`` or ``2``."""
    first, colon, last = text.partition(":")
    try:
        least = int(first)
        return least, int(last) if colon else least
    except ValueError:
        raise ScenarioError(f"--count {escaped(text)}: must look like 0:3, or be one number") from None


def _weights(texts: list[str]) -> float:
    """The cost of the peak [W/(N m)]."""
    peak = 0.0
    for text in texts:
        key, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if key != "peak" or not 0.0 <= number < float("inf"):
            raise ScenarioError(f"--weight {escaped(text)}: must look like peak=0.5, zero or more [W/(N m)]")
        peak = number
    return peak


def _gains(text: str) -> tuple[float, ...]:
    """Gains from the largest on."""
    try:
        values = tuple(sorted((float(part) for part in text.split(",")), reverse=True))
    except ValueError:
        values = ()
    if not values or not all(0.0 < gain < float("inf") for gain in values):
        raise ScenarioError(f"--gains {escaped(text)}: must be positive numbers with commas, such as 500,100,20")
    return values
