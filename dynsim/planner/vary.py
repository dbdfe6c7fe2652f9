"""Plans for several values of one or two scenario keys, such as the height of a surface or the position of a pad."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from dynsim.engine import named
from dynsim.errors import DynsimError, ModelError, ScenarioError, SimulationInterrupted, UnreachableReference
from dynsim.planner.answer import BracePlan, Searched, Tell, answered, check_arguments, searched, silent
from dynsim.planner.problem import Options
from dynsim.planner.verify import Verification
from dynsim.scenario import Scenario
from dynsim.studies.sweep_plan import Axis, Plan, SweepPoint
from dynsim.system import interruption

# Maximum number of keys; a figure has one axis, and one curve for each value of the second key.
MOST_KEYS = 2


@dataclass(frozen=True)
class Variation:
    """Plans for all combinations of values.

    Attributes
    ----------
    scenario : Scenario
        Scenario of the first combination.
    axes : tuple of Axis
        Keys and their values.
    points : tuple of SweepPoint
        Combinations of values, in the order of the plans.
    plans : tuple of BracePlan or str
        Plan of each combination, or the reason why there is none.
    interrupted : bool
        Whether an interrupt (Ctrl-C) ended the search or the verification.
    """

    scenario: Scenario
    axes: tuple[Axis, ...]
    points: tuple[SweepPoint, ...]
    plans: tuple[BracePlan | str, ...]
    interrupted: bool = False

    @cached_property
    def table(self) -> list[dict[str, Any]]:
        """Rows with the best plan of each combination, as in :attr:`BracePlan.table`, after the values."""
        return [{**point.values, **_best_row(plan)} for point, plan in zip(self.points, self.plans, strict=True)]

    @cached_property
    def chosen(self) -> tuple[Mapping[str, Any], BracePlan]:
        """Values and plan of least expected heat, preferably among plans that survive."""
        pairs = zip(self.points, self.plans, strict=True)
        known = [(point.values, plan) for point, plan in pairs if isinstance(plan, BracePlan)]
        heats = [
            (True, math.inf) if (b := plan.best) is None else (b.survives is False, b.expected) for _, plan in known
        ]
        return known[heats.index(min(heats))]

    def ended(self, why: str) -> int:
        """Return the number of values whose searches ended for a reason, see :class:`~dynsim.planner.search.Tally`."""
        return sum(plan.tally.ended == why for plan in self.plans if isinstance(plan, BracePlan))

    @property
    def limits(self) -> dict[str, float]:
        """Limits of all evaluated requirements, by key."""
        sizes = [size for plan in self.plans if isinstance(plan, BracePlan) for size in plan.answered]
        return {requirement.key: requirement.limit for size in sizes for requirement in size.requirements}

    @property
    def json(self) -> dict[str, Any]:
        """Content of ``vary.json``."""
        return {
            "scenario": self.scenario.title,
            "keys": {axis.key: list(axis.values) for axis in self.axes},
            "best": dict(self.chosen[0]),
            "interrupted": self.interrupted,
            "points": [
                {"values": dict(point.values)}
                | ({"reason": p} if isinstance(p, str) else {"ended": p.tally.ended, "sizes": p.table})
                for point, p in zip(self.points, self.plans, strict=True)
            ],
        }


def _best_row(plan: BracePlan | str) -> dict[str, Any]:
    """Return the table row of the best plan, or the reason why there is none."""
    if isinstance(plan, str) or plan.best is None:
        return {"reason": plan if isinstance(plan, str) else plan.sizes[0].reason}
    return plan.table[plan.sizes.index(plan.best)]


def vary_plans(runs: Plan, options: Options, verification: Verification, tell: Tell | None = None) -> Variation:
    """Plan braces for each combination of values, as :func:`dynsim.plan_braces`.

    All searches share the time budget: each value may use an equal part of the time that is left. After them, plans of
    neighbouring values are continued from each other's postures, forwards and backwards. Therefore heat changes little
    between neighbours unless the problem does. An interrupt (Ctrl-C) keeps the plans so far and ends the verification.

    Parameters
    ----------
    runs : Plan
        Scenario, and one or two keys with numbers.
    options : Options
        Options of the planner; all searches share the budget.
    verification : Verification
        Whether and how plans are verified.
    tell
        As for :func:`dynsim.plan_braces`.

    Returns
    -------
    Variation
        One plan for each combination.

    Raises
    ------
    ScenarioError
        If there are more than two keys, a value is not a number, or a value is invalid.
    ModelError, UnreachableReference
        If planning fails for all combinations.
    """
    tell = tell or silent
    check_arguments(options, verification)
    if len(runs.grid) > MOST_KEYS:
        raise ScenarioError(f"--vary: has {len(runs.grid)} keys; use at most {MOST_KEYS}")
    for axis in runs.grid:
        if not all(type(value) in (int, float) for value in axis.values):
            raise ScenarioError(f"--vary {axis.key}: must have numbers, such as {axis.key}=0:1:5")
    points = tuple(runs.points())
    scenarios = [runs.scenario(point) for point in points]
    cells = [tuple(axis.values.index(point.values[axis.key]) for axis in runs.grid) for point in points]
    known: dict[tuple[int, ...], Searched] = {}
    failed: dict[tuple[int, ...], DynsimError] = {}
    interrupted, until = False, time.monotonic() + options.budget_s
    try:
        for number, (cell, scenario) in enumerate(zip(cells, scenarios, strict=True)):
            stage, part = f"value {number + 1} of {len(points)}", 0.7 / len(points)
            left = max(until - time.monotonic(), 0.0) / (len(points) - number)
            try:
                with named(scenario):
                    known[cell] = searched(
                        scenario,
                        replace(options, budget_s=left),
                        lambda _, share: tell(stage, part * (number + share)),  # noqa: B023
                    )
            except (ModelError, UnreachableReference) as error:
                failed[cell] = error
            if interrupted := cell in known and known[cell].search.tally.ended == "interrupted":
                break
        for step, order in ((-1, cells), (1, cells[::-1])) if not interrupted else ():
            for cell in order:
                for k in range(len(cell)):
                    neighbour = (*cell[:k], cell[k] + step, *cell[k + 1 :])
                    with suppress(KeyError):
                        known[cell].add(known[neighbour])
    except (KeyboardInterrupt, SimulationInterrupted):
        if not known:
            raise
        interruption.answered()
        interrupted = True
    if not known:
        raise next(iter(failed.values()))
    plans: list[BracePlan | str] = []
    for number, cell in enumerate(cells):
        tell(f"verifying value {number + 1} of {len(points)}", 0.7 + 0.25 * number / len(points))
        if cell not in known:
            plans.append(str(failed.get(cell, "interrupted before this value had a plan")))
            continue
        with named(scenarios[number]):
            how = replace(verification, verify=verification.verify and not interrupted)
            plan = answered(known[cell], how, silent)
        interrupted = interrupted or plan.tally.ended == "interrupted"
        plans.append(plan)
    return Variation(scenarios[0], runs.grid, points, tuple(plans), interrupted)
