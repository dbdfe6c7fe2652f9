"""Command ``dynsim plan``: finds brace points, their positions, postures and contact forces."""

from __future__ import annotations

import math
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
from dynsim.errors import ScenarioError, SimulationInterrupted, UnreachableReference
from dynsim.system.terminal import escaped

if TYPE_CHECKING:
    from dynsim.planner.answer import BracePlan, Size
    from dynsim.planner.problem import Task
    from dynsim.planner.vary import Variation
    from dynsim.planner.verify import Requirement

# Number of values of ``--vary`` without a count.
VALUES = 5
EXAMPLE = "Example: dynsim plan pressing --count 0:3 --candidates link_3:link_9"


def plan(
    scenario: ScenarioArgument,
    variant: VariantOption = None,
    overrides: SetOption = None,
    require: Annotated[
        list[str] | None,
        option("KEY=VALUE", "Override one of the requirements, e.g. `rating_share=1`; repeatable."),
    ] = None,
    vary: Annotated[
        list[str] | None,
        option(
            "KEY=start:stop:count",
            "Plan for each value of one key: start:stop:count (default: 5 values) or a,b,c; two keys at most.",
        ),
    ] = None,
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
    phases: Annotated[
        str, option("MIN:MAX", "Smallest and largest number of brace sets along the path, one after the other.")
    ] = "1:1",
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
    starts: Annotated[int, option("N", "Number of rounds of each search.", min=1)] = 4,
    budget: Annotated[
        float, option("S", "Time after which no further search starts or continues [s]; 0: one search.", min=0.0)
    ] = 30.0,
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
    from dynsim.scenario import load_scenario, read_scenario

    look = Look.of(size, font, style, title=not no_title, caption=not no_caption)
    values = parsed_overrides(overrides) | parsed_overrides(require, "--require", "requirements.")
    loaded = load_scenario(scenario, variant, values)
    folder = out or Path("results", loaded.name, loaded.variant, "plan")
    least, most = _numbers("count", count, "0:3")
    fewest, largest = _numbers("phases", phases, "1:2")
    peak = _weights(weight or [])
    names = [name.strip() for name in candidates.split(",") if name.strip()]
    if candidates and not names:
        raise ScenarioError(
            f"--candidates {escaped(candidates)}: must list at least one candidate; omit it for the default"
        )
    from dynsim.planner.answer import plan_with
    from dynsim.planner.files import check_plan_folder, save_plan
    from dynsim.planner.problem import Options
    from dynsim.planner.vary import vary_plans
    from dynsim.planner.verify import Tolerances, Verification
    from dynsim.studies.processes import cores
    from dynsim.studies.sweep_plan import Axis, Plan

    axes = tuple(Axis.parse(text, "--vary", VALUES) for text in vary or ())
    check_plan_folder(folder, bool(axes))
    errors = (0.0, surface_error, -surface_error) if surface_error > 0.0 else (0.0,)
    factors = (1.0, 1.0 - friction_error, 1.0 + friction_error) if friction_error > 0.0 else (1.0,)
    chosen = Tolerances.gains if gains is None else _gains(gains)
    tolerances = Tolerances(friction=factors, shift_m=errors, gains=chosen)
    options = Options(
        tuple(names), tuple(along or ()), radius, (least, most), tuple(surface or ()), peak, clearance, min_force,
        starts, seed, budget, exhaustive, (fewest, largest),
    )  # fmt: skip
    verification = Verification(tolerances, verify, explain, jobs or cores())
    runs = Plan(read_scenario(scenario), (variant,), values, axes) if axes else None
    variation = None
    with plan_progress(quiet) as tell:
        if runs is None:
            result = plan_with(loaded, options, verification, tell)
        else:
            variation = vary_plans(runs, options, verification, tell)
            result = variation.chosen[1]
        tell("writing", 0.98)
        save_plan(result, folder, not no_figures, format_.value, look, variation)
    if not quiet:
        if variation is not None:
            print_variation(variation)
        print_plan(result, variation)
        print_written(folder)
        if result.best is not None:
            print_line(f"Run the best plan: dynsim run {escaped(folder / 'plan.yaml')}")
    if result.best is None:
        raise UnreachableReference(f"no plan: {escaped(result.sizes[0].reason)}")
    if result.tally.ended == "interrupted" or (variation is not None and variation.interrupted):
        raise typer.Exit(SimulationInterrupted.exit_code)


def _numbers(key: str, text: str, example: str) -> tuple[int, int]:
    """Parse the minimum and maximum of an option, such as ``example``, or a single number, such as ``2``."""
    first, colon, last = text.partition(":")
    try:
        least = int(first)
        return least, int(last) if colon else least
    except ValueError:
        raise ScenarioError(f"--{key} {escaped(text)}: must be MIN:MAX, such as {example}, or one number") from None


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
# Ratio of the heat of the run to the planned heat, and rms error of the hand beyond the surface error [m], above which
# there is a remark.
MORE, HAND_ERROR = 1.05, 5e-3
_SURVIVES = {True: "yes", False: "no", None: "not verified"}


def print_plan(plan: BracePlan, variation: Variation | None = None) -> None:
    """Print a table row for each number of braces, then the reasons why plans were rejected or not found.

    A line states that an interrupt or the budget ended the searches, of all values if there are several.
    Reasons that do not fit on the screen are only in ``plan.json``.
    """
    from dynsim.record.quantities import summary_quantity

    width, height = screen.size(console)
    table = screen.new_table(f"{plan.task.scenario.title}: braces")
    required = dict.fromkeys(summary_quantity(r.key).label for size in plan.sizes for r in size.requirements)
    heads = (
        "braces", "on", "heat [W]", "simulated [W]", "all energy [J]", "k_p [V/rad]", "forces [N]", "searches",
        *required, "survives",
    )  # fmt: skip
    for head in heads:
        table.add_column(escaped(head), justify="left" if head in ("on", "survives") else "right")
    for size in plan.sizes:
        fewer = plan.no_gain(size)
        table.add_row(*_cells(size, None if fewer is None else fewer.count, len(required)))
    console.print(table, width=min(width, console.width))
    if text := _ended(plan, variation):
        print_line(text)
    best = plan.best
    if best is not None:
        label = escaped(best.label) if best.braces else "no braces"
        print_line(f"best: {label}{' (rejected)' if best.survives is False else ''}")
    notes = [
        f"{size.count} brace{'' if size.count == 1 else 's'}: {escaped(text)}"
        for size in plan.sizes
        for text in [*_phases(plan.task, size), *_notes(size)]
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


def _ended(plan: BracePlan, variation: Variation | None) -> str:
    """Return a sentence if an interrupt or the budget ended the searches; otherwise an empty text."""
    ended, at = plan.tally.ended, ""
    if variation is not None:
        many, late = len(variation.points), variation.ended("budget")
        if variation.interrupted:
            best = [plan.best for plan in variation.plans if not isinstance(plan, str)]
            verified = sum(each is not None and each.nominal is not None for each in best)
            return f"interrupted: the best plans so far; {verified} of {many} values are verified"
        ended, at = "budget" if late else "agreed", f", for {late} of {many} values"
    if ended == "budget":
        return f"the time budget ended before two searches agreed for each number of braces{at}; increase --budget"
    return "interrupted: the best plans so far, without verification" if ended == "interrupted" else ""


def print_variation(variation: Variation) -> None:
    """Print the best plan for each combination of values."""
    from dynsim.record.quantities import rounded, summary_quantity

    keys = [axis.key for axis in variation.axes]
    drawn = {key: summary_quantity(key) for key in ("heat_W", *variation.limits)}
    table = screen.new_table(f"{variation.scenario.title}: best plan for each value")
    for head in (*keys, "braces", "on", *(q.label for q in drawn.values()), "survives"):
        table.add_column(escaped(head), justify="left" if head in ("on", "survives") else "right")
    for row in variation.table:
        numbers = [
            "–"
            if row.get(key) is None
            else rounded(q.scale * row[key], 3, "#") + " ✗" * (row.get(f"{key}_met") is False)
            for key, q in drawn.items()
        ]
        table.add_row(
            *(f"{row[key]:g}" for key in keys), str(row.get("count", "–")), escaped(row.get("braces", "no plan")),
            *numbers, _SURVIVES.get(row.get("survives"), "–") if "count" in row else "–",
        )  # fmt: skip
    console.print(table)
    values = ", ".join(f"{key} = {value:g}" for key, value in variation.chosen[0].items())
    print_line(f"least heat at {escaped(values)}:")


def _value(requirement: Requirement) -> str:
    """Return the value of a requirement with its margin, such as "0.42 (58 %)"."""
    from dynsim.record.quantities import rounded, summary_quantity

    value = summary_quantity(requirement.key).scale * requirement.value
    return f"{rounded(value, 3, '#')} ({100.0 * requirement.margin:.0f} %)"


def _cells(size: Size, no_gain_over: int | None, columns: int = 0) -> tuple[str, ...]:
    """Return a table row; plans have ``columns`` requirements."""
    if size.planned is None:
        return (str(size.count), "not found", *5 * ("–",), f"0/{size.searches}", *(columns + 1) * ("–",))
    if no_gain_over is not None:
        label = f"no gain over {no_gain_over} brace{'' if no_gain_over == 1 else 's'}"
        return (str(size.count), label, f"{size.heat:.4g}", *(columns + 6) * ("–",))
    dense, nominal = size.planned.dense, size.nominal
    forces = f"{dense.forces.min():.3g} … {dense.forces.max():.3g}" if size.count else "–"
    return (
        str(size.count),
        escaped(size.label),
        f"{size.heat:.4g}",
        "–" if nominal is None else f"{nominal.heat_W:.4g}",
        "–" if nominal is None else f"{nominal.electrical_energy_J:.4g}",
        f"{size.k_p:g}",
        forces,
        f"{size.agreed}/{size.searches}",
        *(_value(requirement) for requirement in size.requirements),
        _SURVIVES[size.survives],
    )


def _tolerated(shift_m: float | None, friction: float | None) -> list[str]:
    """Return a text about the errors that a rejected plan tolerates, within the tested range."""
    texts = []
    if shift_m is not None:
        texts.append(f"{1e3 * shift_m:.2g} mm surface error" if shift_m else "no tested surface error")
    if friction is not None:
        texts.append(f"{100 * friction:.2g} % friction error" if friction else "no tested friction error")
    return [f"tolerates, one at a time and in both directions: {' and '.join(texts)}"] if texts else []


def _phases(task: Task, size: Size) -> list[str]:
    """Return a text with the braces of each phase and its end; empty if the braces do not change."""
    if size.planned is None or not size.dense.schedule.borders:
        return []
    parts = [(phase.end, ", ".join(b.label for b in phase.braces)) for phase in task.phases(size.dense.schedule)]
    return ["; ".join(f"until {end:.3g} s {label or 'no braces'}" for end, label in parts)]


def _notes(size: Size) -> list[str]:
    notes = [f"rejected, {size.reason}"] if size.planned is not None and size.reason else []
    if size.planned is None:
        notes.append(size.reason)
    if size.nominal is not None and size.nominal.reason:
        notes.append(f"rejected as planned with k_p = {size.k_p:g} V/rad: errors were not tested")
    if size.nominal is not None and size.nominal.heat_W > MORE * size.heat:
        notes.append(f"the run needs {size.nominal.heat_W:.4g} W, {size.nominal.heat_W / size.heat:.2g} times the plan")
    if size.verdict is not None and size.verdict.hand_m > HAND_ERROR:
        notes.append(f"hand error of up to {1e3 * size.verdict.hand_m:.2g} mm rms beyond the error of the surfaces")
    if not math.isnan(size.bound):
        notes.append(f"changing braces more often along the paths found would need at least {size.bound:.4g} W")
    for brace, share in ({} if size.nominal is None else size.nominal.closed_fraction).items():
        if share < LIFTED:
            notes.append(f"{brace} lifts off for {100.0 * (1.0 - share):.2g} % of its time in the run without errors")
    if size.tolerance is not None:
        notes += _tolerated(*size.tolerance)
    notes += [f"{label} would need less heat, but: {why}" for label, why in size.cheaper]
    return notes
