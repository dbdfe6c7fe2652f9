"""Table of a brace plan for the terminal."""

from __future__ import annotations

from rich.table import Table

from dynsim.cli.display import console, say
from dynsim.planner.answer import BracePlan, Size
from dynsim.system.terminal import escaped

# A brace that touches for less of the time has lifted off.
LIFTED = 0.999


def print_plan(plan: BracePlan) -> None:
    """A row for each number of braces, then what refused plans and what was not found."""
    table = Table(title=f"{escaped(plan.task.scenario.title)}: braces", title_justify="left")
    heads = (
        "braces", "on", "heat [W]", "simulated [W]", "all energy [J]", "k_p [V/rad]", "forces [N]", "rounds",
        "survives",
    )  # fmt: skip
    for head in heads:
        table.add_column(head, justify="left" if head in ("on", "survives") else "right")
    for size in plan.sizes:
        table.add_row(*_cells(size))
    console.print(table)
    if any(size.planned is not None and size.agreed == 0 for size in plan.sizes):
        say("rounds: how many of the search found that heat by themselves; none, where exchanging braces found it")
    best = plan.best
    if best is not None:
        say(f"best: {escaped(best.label)}{', though it is refused' if best.survives is False else ''}")
    for size in plan.sizes:
        for text in _notes(size):
            say(f"{size.count} brace{'' if size.count == 1 else 's'}: {escaped(text)}")
    missed, reached = len(plan.tally.missed), len(plan.tally.reached)
    if missed:
        say(f"no posture found for {missed} of {missed + reached} sets tried: not found, which does not say impossible")


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
        "–" if nominal is None else f"{nominal.electrical_J:.4g}",
        f"{size.k_p:g}",
        forces,
        f"{size.agreed}/{size.rounds}",
        survives,
    )


def _notes(size: Size) -> list[str]:
    notes = [f"refused, {size.reason}"] if size.planned is not None and size.reason else []
    if size.planned is None:
        notes.append(size.reason)
    for brace, share in ({} if size.nominal is None else size.nominal.closed).items():
        if share < LIFTED:
            notes.append(f"{brace} lifts off, for {100.0 * (1.0 - share):.2g} % of the time of the run as planned")
    if size.tolerance is not None:
        notes.append(
            f"bears {1e3 * size.tolerance[0]:.2g} mm of surface, and {100 * size.tolerance[1]:.2g} % of friction"
        )
    notes += [f"{label} would be cheaper, but: {why}" for label, why in size.cheaper]
    return notes
