"""Command ``dynsim plan``: finds brace points, their positions, postures and contact forces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynsim.cli import screen
from dynsim.cli.app import (
    FigureFormat,
    FiguresOption,
    FontOption,
    FormatOption,
    NoCaptionOption,
    NoTitleOption,
    QuietOption,
    ScenarioArgument,
    SetOption,
    SizeOption,
    StyleOption,
    VariantOption,
    folder_option,
    option,
    parsed_overrides,
)
from dynsim.cli.output import console, plan_progress, print_line, print_written
from dynsim.errors import ScenarioError, UnreachableReference
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.planner.answer import BracePlan, Size

EXAMPLE = "Example: dynsim plan pressing --count 0:3 --candidates link_3:link_9"


def plan(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    candidates: Annotated[
        str,
        option(
            "LIST",
            "Points that may become braces, comma-separated: links (at their joint), ranges (link_3:link_9), "
            "frames or contact points; default: all links except the first two, and all contact points.",
        ),
    ] = "",
    along: Annotated[
        list[float] | None,
        option("SHARE", "Also use the point at this fraction of each link's length, 0 to 1; repeatable."),
    ] = None,
    radius: Annotated[float | None, option("M", "Brace radius [m]; default: the radius of the link.", min=0.0)] = None,
    count: Annotated[str, option("MIN:MAX", "Smallest and largest number of braces.")] = "0:3",
    surface: Annotated[list[str] | None, option("NAME", "Surface that may be used; repeatable; default: all.")] = None,
    weight: Annotated[
        list[str] | None, option("peak=VALUE", "Extra cost of the largest torque of revolute joints [W/(N m)].")
    ] = None,
    clearance: Annotated[
        float, option("M", "Minimum distance of unbraced joints from surfaces, of links from objects [m].", min=0.0)
    ] = 0.01,
    min_force: Annotated[float, option("N", "Minimum normal force on each brace [N].", min=0.0)] = 0.5,
    verify: Annotated[
        bool, typer.Option("--verify/--no-verify", help="Re-simulate plans with errors in friction and surface height.")
    ] = True,
    friction_error: Annotated[
        float, option("SHARE", "Relative friction error that plans must tolerate.", min=0.0, max=0.99)
    ] = 0.2,
    surface_error: Annotated[float, option("M", "Surface height error that plans must tolerate [m].", min=0.0)] = 0.005,
    gains: Annotated[
        str | None, option("LIST", "Candidate gains k_p [V/rad], comma-separated; default: 500 to 5.")
    ] = None,
    exhaustive: Annotated[bool, typer.Option("--exhaustive", help="Try every set of candidates (slow).")] = False,
    starts: Annotated[int, option("N", "Number of independent search rounds.", min=1)] = 8,
    seed: Annotated[int, option("S", "Seed for the random starting postures.")] = 0,
    explain: Annotated[
        bool, typer.Option("--explain", help="For rejected plans, find the largest error they tolerate.")
    ] = False,
    out: Annotated[Path | None, folder_option("results/SCENARIO/plan")] = None,
    jobs: Annotated[int, option("N", "Number of worker processes; default 0: one per core.", min=0)] = 0,
    no_figures: FiguresOption = False,
    format_: FormatOption = FigureFormat.png,
    size: SizeOption = None,
    font: FontOption = None,
    style: StyleOption = None,
    no_title: NoTitleOption = False,
    no_caption: NoCaptionOption = False,
    quiet: QuietOption = False,
) -> None:
    """Find where an arm should brace: points, surfaces, posture along the hand path, contact forces and gains.

    For each number of braces, the command finds the set with the least motor heat and re-simulates it with errors in
    friction and surface height. It writes plan.yaml with one variant per plan; run this file with `dynsim run
    results/SCENARIO/plan/plan.yaml`.
    """
    from dynsim.draw.figures.look import Look
    from dynsim.scenario import load_scenario

    look = Look.of(size, font, style, title=not no_title, caption=not no_caption)
    loaded = load_scenario(scenario, variant, parsed_overrides(overrides))
    folder = out or Path("results", loaded.name, loaded.variant, "plan")
    least, most = _numbers(count)
    peak = _weights(weight or [])
    names = [name.strip() for name in candidates.split(",") if name.strip()]
    if candidates and not names:
        raise ScenarioError(
            f"--candidates {escaped(candidates)}: must list at least one candidate; omit it for the default"
        )
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
        save_plan(result, folder, figures=not no_figures, kind=format_.value, look=look)
    if not quiet:
        print_plan(result)
        print_written(folder)
        if result.best is not None:
            print_line(f"Run the best plan: dynsim run {escaped(folder / 'plan.yaml')}")
    if result.best is None:
        raise UnreachableReference(f"no plan: {escaped(result.sizes[0].reason)}")


def _numbers(text: str) -> tuple[int, int]:
    """Parse the minimum and maximum number of braces, such as ``0:3``, or a single number, such as ``2``."""
    first, colon, last = text.partition(":")
    try:
        least = int(first)
        return least, int(last) if colon else least
    except ValueError:
        raise ScenarioError(f"--count {escaped(text)}: must be MIN:MAX, such as 0:3, or one number") from None


def _weights(texts: list[str]) -> float:
    """Parse the values of ``--weight`` and return the cost of the peak torque [W/(N m)]."""
    peak = 0.0
    for text in texts:
        key, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if key != "peak" or not 0.0 <= number < float("inf"):
            raise ScenarioError(
                f"--weight {escaped(text)}: must look like peak=0.5, with a value of at least 0 [W/(N m)]"
            )
        peak = number
    return peak


def _gains(text: str) -> tuple[float, ...]:
    """Parse comma-separated gains and return them in descending order."""
    try:
        values = tuple(sorted((float(part) for part in text.split(",")), reverse=True))
    except ValueError:
        values = ()
    if not values or not all(0.0 < gain < float("inf") for gain in values):
        raise ScenarioError(f"--gains {escaped(text)}: must be comma-separated positive numbers, such as 500,100,20")
    return values


# Table of a brace plan. A brace counts as lifted off if it is in contact for less than this fraction of the time.
LIFTED = 0.999


def print_plan(plan: BracePlan) -> None:
    """Print a table row for each number of braces, then the reasons why plans were rejected or not found.

    Reasons that do not fit on the screen are only in ``plan.json``.
    """
    width, height = screen.size(console)
    table = screen.new_table(f"{plan.task.scenario.title}: braces")
    heads = (
        "braces", "on", "heat [W]", "simulated [W]", "all energy [J]", "k_p [V/rad]", "forces [N]", "rounds",
        "survives",
    )  # fmt: skip
    for head in heads:
        table.add_column(head, justify="left" if head in ("on", "survives") else "right")
    for size in plan.sizes:
        table.add_row(*_cells(size))
    console.print(table, width=min(width, console.width))
    if any(size.planned is not None and size.agreed == 0 for size in plan.sizes):
        print_line("rounds: search rounds that found this heat independently; 0 if it was found by exchanging braces")
    best = plan.best
    if best is not None:
        label = escaped(best.label) if best.braces else "no braces"
        print_line(f"best: {label}{' (rejected)' if best.survives is False else ''}")
    notes = [
        f"{size.count} brace{'' if size.count == 1 else 's'}: {escaped(text)}"
        for size in plan.sizes
        for text in _notes(size)
    ]
    # Three lines are above the notes, and two below.
    left = height - screen.lines(console, [table]) - 5
    fitting = [note for k, note in enumerate(notes) if screen.lines(console, notes[: k + 1]) <= left]
    for note in fitting:
        print_line(note)
    if len(fitting) < len(notes):
        print_line(f"… and {len(notes) - len(fitting)} more notes in plan.json")
    missed, reached = len(plan.tally.missed), len(plan.tally.reached)
    if missed:
        print_line(
            f"no posture found for {missed} of {missed + reached} sets tried; this does not prove that none exists"
        )


def _cells(size: Size) -> tuple[str, ...]:
    if size.planned is None:
        return str(size.count), "not found", "–", "–", "–", "–", "–", f"0/{size.rounds}", "–"
    dense, nominal = size.planned.dense, size.nominal
    forces = f"{dense.forces.min():.3g} … {dense.forces.max():.3g}" if size.count else "–"
    survives = {True: "yes", False: "no", None: "not verified"}[size.survives]
    return (
        str(size.count),
        escaped(size.label),
        f"{size.heat:.4g}",
        "–" if nominal is None else f"{nominal.heat_W:.4g}",
        "–" if nominal is None else f"{nominal.electrical_energy_J:.4g}",
        f"{size.k_p:g}",
        forces,
        f"{size.agreed}/{size.rounds}",
        survives,
    )


def _tolerated(shift_m: float | None, friction: float | None) -> list[str]:
    """Return a text about the errors that a rejected plan tolerates, within the tested range."""
    texts = []
    if shift_m is not None:
        texts.append(f"{1e3 * shift_m:.2g} mm surface error" if shift_m else "no tested surface error")
    if friction is not None:
        texts.append(f"{100 * friction:.2g} % friction error" if friction else "no tested friction error")
    return [f"tolerates, one at a time and in both directions: {' and '.join(texts)}"] if texts else []


def _notes(size: Size) -> list[str]:
    notes = [f"rejected, {size.reason}"] if size.planned is not None and size.reason else []
    if size.planned is None:
        notes.append(size.reason)
    if size.verdict is not None and not size.verdict.sound:
        notes.append(f"rejected as planned with k_p = {size.k_p:g} V/rad: errors were not tested")
    for brace, share in ({} if size.nominal is None else size.nominal.closed_fraction).items():
        if share < LIFTED:
            notes.append(f"{brace} lifts off for {100.0 * (1.0 - share):.2g} % of the time in the run without errors")
    if size.tolerance is not None:
        notes += _tolerated(*size.tolerance)
    notes += [f"{label} would need less heat, but: {why}" for label, why in size.cheaper]
    return notes
