"""Table of a brace plan for the terminal."""

from __future__ import annotations

from rich.table import Table

from dynsim.cli.display import console, say
from dynsim.planner.answer import BracePlan, Size
from dynsim.system.terminal import escaped

# A brace that is in contact for less than this part of the time counts as lifted off.
LIFTED = 0.999


def print_plan(plan: BracePlan) -> None:
    """Print a row for each number of braces, then reasons for refused plans, and plans that were not found."""
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


def _borne(shift_m: float | None, friction: float | None) -> list[str]:
    """Errors that a refused plan bears, as far as they were tried."""
    texts = []
    if shift_m is not None:
        texts.append(f"surfaces that are {1e3 * shift_m:.2g} mm off" if shift_m else "none of the surfaces tried")
    if friction is not None:
        texts.append(f"friction that is {100 * friction:.2g} % off" if friction else "none of friction tried")
    return [f"of errors, each alone, up and down, bears {' and '.join(texts)}"] if texts else []


def _notes(size: Size) -> list[str]:
    notes = [f"refused, {size.reason}"] if size.planned is not None and size.reason else []
    if size.planned is None:
        notes.append(size.reason)
    if size.verdict is not None and not size.verdict.sound:
        notes.append(f"refused as planned with k_p = {size.k_p:g} V/rad: no errors of the scene were tried")
    for brace, share in ({} if size.nominal is None else size.nominal.closed).items():
        if share < LIFTED:
            notes.append(f"{brace} lifts off, for {100.0 * (1.0 - share):.2g} % of the time of the run as planned")
    if size.tolerance is not None:
        notes += _borne(*size.tolerance)
    notes += [f"{label} would be cheaper, but: {why}" for label, why in size.cheaper]
    return notes
