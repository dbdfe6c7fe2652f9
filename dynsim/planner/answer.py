"""Entry to the planner, and its result: the best sets for each number of braces with their verification."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dynsim.engine import named, simulate
from dynsim.errors import ScenarioError, first_few
from dynsim.planner import planned_scenario
from dynsim.planner.dense import Dense, nearest
from dynsim.planner.problem import Candidate, Options, Task, task
from dynsim.planner.search import Planned, Search, Tally
from dynsim.planner.verify import Corner, Tolerances, Verdict, Verifier
from dynsim.record import Record
from dynsim.scenario import Scenario, require_scenario
from dynsim.scenario.schema import Payload

# Two rounds agree if their heats differ by less than this share.
AGREE = 0.01
# Gains of plans that are not verified, and of those without braces.
K_P = 500.0
GAP = (
    "statistical: the best of independent rounds of a search by local optima, and how many of them came within 1 % of "
    "it; no bound is proved"
)

Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Size:
    """The answer for one number of braces.

    Attributes
    ----------
    planned : the set with its references; None: nothing was found, and ``reason`` says why
    verdict : of the corners; None where nothing was verified
    agreed, rounds : how many rounds of the search found this heat, of how many
    tolerance : error of the surfaces [m] and share of friction that do hold, each alone; None unless asked for, and
        where the run as planned is refused already
    cheaper : sets of less heat that were refused, and why
    """

    count: int
    planned: Planned | None
    verdict: Verdict | None = None
    agreed: int = 0
    rounds: int = 0
    reason: str = ""
    tolerance: tuple[float | None, float | None] | None = None
    cheaper: tuple[tuple[str, str], ...] = ()

    @property
    def braces(self) -> tuple[Candidate, ...]:
        return () if self.planned is None else self.planned.braces

    @property
    def dense(self) -> Dense:
        """References and statics of the plan that there is."""
        assert self.planned is not None
        return self.planned.dense

    @property
    def heat(self) -> float:
        """[W]; infinite where nothing was found."""
        return math.inf if self.planned is None else self.planned.heat

    @property
    def nominal(self) -> Corner | None:
        """The run as planned; None where nothing was verified."""
        return None if self.verdict is None else self.verdict.nominal

    @property
    def expected(self) -> float:
        """Heat by which numbers of braces rank [W]: of the run as planned, else the planned one."""
        nominal = self.nominal
        return self.heat if nominal is None or math.isnan(nominal.heat_W) else nominal.heat_W

    @property
    def survives(self) -> bool | None:
        """Whether all corners hold; None where nothing was verified."""
        return None if self.verdict is None else self.verdict.survives

    @property
    def k_p(self) -> float:
        """Gain [V/rad] that belongs to the plan."""
        return K_P if self.verdict is None else self.verdict.k_p

    @property
    def label(self) -> str:
        """Names of points and surfaces."""
        return ", ".join(brace.label for brace in self.braces) or "none"

    @property
    def variant(self) -> str:
        """Its variant of the planned scenario."""
        return f"braces_{self.count}"


@dataclass(frozen=True)
class BracePlan:
    """What :func:`plan_braces` has found.

    Attributes
    ----------
    task : the problem; sizes: the answer for each number of braces; tally: what the search has done
    singles : by candidate, least heat of a single brace at one posture [W], of those that were found
    ranked : by number of braces, sets with whole paths and their heat [W], the answer first
    """

    task: Task
    sizes: tuple[Size, ...]
    tally: Tally
    singles: dict[str, float]
    ranked: dict[int, list[tuple[str, float]]]

    def __repr__(self) -> str:
        best = self.best
        text = "nothing found" if best is None else f"best: {best.label}, {best.expected:.4g} W"
        return f"<BracePlan {self.task.scenario.title}: {len(self.sizes)} sizes, {text}>"

    @property
    def answered(self) -> list[Size]:
        """The sizes for which there is a plan."""
        return [size for size in self.sizes if size.planned is not None]

    @property
    def best(self) -> Size | None:
        """The least expected heat of those that survive, else of all; None where nothing was found."""
        return min(self.answered, key=lambda size: (size.survives is False, size.expected), default=None)

    def size(self, count: int) -> Size:
        """The answer for a number of braces.

        Raises
        ------
        ScenarioError
            That many were not asked for, or nothing was found for them.
        """
        for size in self.sizes:
            if size.count == count:
                if size.planned is None:
                    raise ScenarioError(f"no plan with {count} braces: {size.reason}")
                return size
        asked = ", ".join(str(size.count) for size in self.sizes)
        raise ScenarioError(f"no plan with {count} braces was asked for; sizes: {asked}")

    @cached_property
    def table(self) -> list[dict[str, Any]]:
        """A row for each size: numbers and words, for tables."""
        return [_row(self.task, size) for size in self.sizes]

    @property
    def pareto(self) -> list[tuple[int, float]]:
        """Numbers of braces, and expected heat [W], that no smaller number reaches."""
        points: list[tuple[int, float]] = []
        for size in self.answered:
            if not points or size.expected < points[-1][1]:
                points.append((size.count, size.expected))
        return points

    def scenario(self, count: int) -> Scenario:
        """The plan with so many braces as a scenario that runs."""
        size = self.size(count)
        return planned_scenario.scenario(self.task, size.braces, size.dense, size.k_p, size.variant)

    def record(self, count: int) -> Record:
        """The run of that scenario."""
        return simulate(self.scenario(count))

    @property
    def yaml(self) -> dict[str, Any]:
        """All plans as one scenario with a variant for each size, the best first."""
        best = self.best
        variants = {
            size.variant: planned_scenario.particular(self.task, size.braces, size.dense, size.k_p)
            for size in sorted(self.answered, key=lambda size: size is not best)
        }
        return {**planned_scenario.common(self.task), "variants": variants}

    @property
    def json(self) -> dict[str, Any]:
        """The content of ``plan.json``."""
        tally = self.tally
        return {
            "scenario": self.task.scenario.title,
            "friction": self.task.friction,
            "path": self.task.kind,
            "candidates": [candidate.label for candidate in self.task.candidates],
            "gap": GAP,
            "pareto": [{"count": count, "heat_W": heat} for count, heat in self.pareto],
            "best": None if self.best is None else self.best.count,
            "search": {
                "local_solves": tally.solves,
                "postures_drawn": tally.drawn,
                "postures_on_path": tally.drawn_on,
                "sets_reached": len(tally.reached),
                "sets_not_found": sorted(" + ".join(b.label for b in braces) for braces in tally.missed),
                "sets_refused": {" + ".join(b.label for b in braces): why for braces, why in tally.refused.items()},
                "single_braces_W": self.singles,
            },
            "sizes": [_size_json(self.task, size) for size in self.sizes],
        }


def _row(task: Task, size: Size) -> dict[str, Any]:
    """Numbers of one size for a table."""
    row: dict[str, Any] = {"count": size.count, "braces": size.label if size.planned else "not found"}
    if size.planned is None:
        return row | {"reason": size.reason}
    dense = size.planned.dense
    nominal = size.nominal or Corner(1.0, 0.0)
    distance, part, _ = nearest(task, size.braces, dense.times, dense.q)
    row |= {
        "heat_W": dense.heat,
        "simulated_W": _number(nominal.heat_W),
        "electrical_energy_J": _number(nominal.electrical_J),
        "joint_rate_max": _number(nominal.rate_max),
        "closed_least": min(nominal.closed.values(), default=None),
        "peak_torque_N_m": dense.peak_torque,
        "peak_force_N": dense.peak_force,
        "torque_share": _torque_share(task, dense),
        "normal_force_min_N": float(dense.forces.min()) if size.count else None,
        "normal_force_max_N": float(dense.forces.max()) if size.count else None,
        "clearance_m": _number(distance),
        "clearance_of": part,
        "joint_limit_distance": _number(_joint_room(task, dense)),
        "k_p_V_per_rad": size.k_p,
        "found_in_rounds": f"{size.agreed}/{size.rounds}",
        "survives": size.survives,
        "reason": size.reason,
    }
    if size.tolerance is not None:
        row |= {"holds_surface_m": size.tolerance[0], "holds_friction": size.tolerance[1]}
    return row


def _size_json(task: Task, size: Size) -> dict[str, Any]:
    """One size in ``plan.json``."""
    braces = [{"body": b.body, "point_m": list(b.point_m), "surface": b.surface, "name": b.name} for b in size.braces]
    entry: dict[str, Any] = {"count": size.count, "braces": braces}
    if size.planned is None:
        return entry | {
            "heat_W": None, "times_s": [], "q_rad": [], "forces_N": [], "survives": None, "reason": size.reason,
        }  # fmt: skip
    dense = size.planned.dense
    forces = np.array([np.interp(dense.times, dense.fine, column) for column in dense.forces.T]).T
    corners = () if size.verdict is None else size.verdict.corners
    distance, part, when = nearest(task, size.braces, dense.times, dense.q)
    return {
        **entry,
        "heat_W": dense.heat,
        "times_s": dense.times.tolist(),
        "q_rad": dense.q.tolist(),
        "joints": list(task.arm.joints),
        "forces_N": forces.tolist(),
        "survives": size.survives,
        "reason": size.reason,
        "k_p_V_per_rad": size.k_p,
        "heat_at_knots_W": size.planned.local.heat,
        "peak_torque_N_m": dense.peak_torque,
        "peak_force_N": dense.peak_force,
        "clearance": {"distance_m": _number(distance), "of": part, "at_s": when},
        "rounds": size.rounds,
        "rounds_that_found_it": size.agreed,
        "cheaper_refused": [{"braces": label, "reason": why} for label, why in size.cheaper],
        "corners": [_corner_json(corner) for corner in corners],
        **(
            {} if size.tolerance is None else {"holds": {"surface_m": size.tolerance[0], "friction": size.tolerance[1]}}
        ),
    }


def _corner_json(corner: Corner) -> dict[str, Any]:
    return {
        "friction_factor": corner.friction,
        "surface_shift_m": corner.shift_m,
        "heat_W": _number(corner.heat_W),
        "hand_rms_m": _number(corner.hand_rms_m),
        "electrical_energy_J": _number(corner.electrical_J),
        "joint_rate_max": _number(corner.rate_max),
        "hand_turn_rms_rad": _number(corner.turn_rms_rad),
        "closed_fraction": corner.closed,
        "reason": corner.reason,
    }


def _number(value: float) -> float | None:
    """JSON has no NaN and no infinity."""
    return float(value) if math.isfinite(value) else None


def _torque_share(task: Task, dense: Dense) -> float | None:
    """Greatest part of a motor's torque at rest that is used; None without limits."""
    share = np.abs(dense.torques) / task.arm.tables.greatest
    return _number(float(share.max())) if np.isfinite(task.arm.tables.greatest).any() else None


def _joint_room(task: Task, dense: Dense) -> float:
    """Least distance of a joint from its limits [rad or m]."""
    links = [task.arm.model.robot.links[i] for i in task.arm.links]
    lower, upper = np.array([link.lower for link in links]), np.array([link.upper for link in links])
    return float(min((dense.q - lower).min(), (upper - dense.q).min()))


def plan_braces(
    scenario: Scenario,
    *,
    candidates: Sequence[str] = (),
    along: Sequence[float] = (),
    radius_m: float | None = None,
    count: tuple[int, int] = (0, 3),
    surfaces: Sequence[str] = (),
    peak_W_per_N_m: float = 0.0,
    clearance_m: float = 0.01,
    min_N: float = 0.5,
    verify: bool = True,
    explain: bool = False,
    exhaustive: bool = False,
    starts: int = 8,
    seed: int = 0,
    jobs: int = 1,
    tolerances: Tolerances | None = None,
    tell: Tell | None = None,
) -> BracePlan:
    """Which points of an arm to brace, on which surfaces, in what posture along the hand's path, with what forces.

    Minimises the mean heat of the motors, Σ R i², over the path ``controller.hand.path`` of the scenario, see
    :mod:`dynsim.planner.arm`, for each number of braces; verified with friction and surfaces that are not as planned.

    Parameters
    ----------
    candidates : links (their joints), ``first:last``, frames, or contact points of the scenario; default: all links
        but the first two, and all contact points
    along : shares of the way along links that are candidates too
    radius_m : of candidates; default: that of their links
    count : least and greatest number of braces
    surfaces : that may be leaned on; default: all
    peak_W_per_N_m : cost of the greatest torque of revolute joints beside the heat; forces of prismatic ones have none
    clearance_m : of joints that are not braced
    min_N : least normal force of a brace
    verify : run the corners of ``tolerances`` and choose gains that bear them
    explain : of refused plans find the errors that do hold, by bisection
    exhaustive : all sets of candidates instead of those that grow from the best
    starts, seed : rounds of the search, and of its random postures
    jobs : processes that verify
    tell : called with what is done and how far it is, 0 to 1

    Raises
    ------
    ModelError
        The scenario has no arm with DC motors, no hand path, no surfaces, or not these candidates.
    ScenarioError
        Numbers that make no sense.
    """
    require_scenario(scenario)
    least, most = count
    if not 0 <= least <= most:
        raise ScenarioError(f"count = {least}:{most}: must be numbers of braces, the least first")
    for key, number, smallest in (("starts", starts, 1), ("seed", seed, 0), ("jobs", jobs, 1)):
        if number < smallest:
            raise ScenarioError(f"{key} = {number}: must be {smallest} or more")
    tolerances = tolerances or Tolerances()
    positive = {"radius_m": radius_m, "peak_W_per_N_m": peak_W_per_N_m, "clearance_m": clearance_m, "min_N": min_N}
    for key, value in (positive | {"shift_m": max(map(abs, tolerances.shift_m), default=0.0)}).items():
        if value is not None and not 0.0 <= value < math.inf:
            raise ScenarioError(f"{key} = {value}: must be a finite number, zero or more")
    if any(not 0.0 < share <= 1.0 for share in along):
        raise ScenarioError(f"along = {list(along)}: shares of the way along links, above 0 and at most 1")
    options = Options(
        tuple(candidates), tuple(along), radius_m, (least, most), tuple(surfaces), peak_W_per_N_m, clearance_m, min_N,
        starts, seed, exhaustive,
    )  # fmt: skip
    tell = tell or (lambda text, share: None)
    with named(scenario):
        problem = task(scenario, options)
        if problem.bare and most > 0:
            warnings.warn(_bare(problem.bare), stacklevel=2)
        if unplanned := [name for name, load in scenario.config.loads.items() if not isinstance(load, Payload)]:
            warnings.warn(_unplanned(unplanned), stacklevel=2)
        if not np.any(problem.arm.model.robot.gravity):
            raise ScenarioError("plant.gravity_m_s2 = [0, 0, 0]: without gravity an arm needs no braces")
        search = Search(problem, tell)
        ranked = search.run()
        sizes = [_answered(search, size, ranked[size]) for size in range(least, most + 1)]
        if verify:
            sizes = _verified(problem, search, sizes, ranked, tolerances, jobs, explain, tell)
    known = search.single_heats
    singles = {brace.label: known[brace,] for brace in problem.candidates if (brace,) in known}
    heats = {size.count: _ranked(size, ranked[size.count]) for size in sizes}
    return BracePlan(problem, tuple(sizes), search.tally, singles, heats)


def _bare(names: Sequence[str]) -> str:
    """Warning of candidates without a radius."""
    return (
        f"plan: candidates {', '.join(names)} have radius 0 (links of a URDF have none, whatever <visual> shows): "
        "braces would lay the axis itself onto the surface; give --radius, or name contacts.points with radius_m as "
        "--candidates"
    )


def _unplanned(names: Sequence[str]) -> str:
    """Warning of loads that are no payloads."""
    return (
        f"plan: loads.{first_few(names)}: planned without, as only payloads are part of a plan; simulated runs have "
        "them, and refuse plans that they make dearer: give a steady weight as `type: payload`"
    )


def _ranked(size: Size, planned: Sequence[Planned]) -> list[tuple[str, float]]:
    """Sets of a size with their heat, the answer first."""
    names = [(", ".join(b.label for b in plan.braces) or "none", plan.heat) for plan in planned]
    return sorted(names, key=lambda item: (item[0] != size.label, item[1]))


def _answered(search: Search, count: int, ranked: Sequence[Planned]) -> Size:
    """The best of a size, before verification; in words why there is none."""
    heats = search.tally.heats.get(count, [])
    if ranked:
        best = min([*heats, search.least.get(count, math.inf)])
        return Size(count, ranked[0], None, sum(heat <= best * (1.0 + AGREE) for heat in heats), len(heats))
    return Size(count, None, reason=_why(search, count), rounds=search.task.options.starts)


def _why(search: Search, count: int) -> str:
    """Why no plan of a size was found."""
    tally, options = search.tally, search.task.options
    if not tally.drawn_on:
        if within := search.never_clear():
            return (
                f"none of {tally.drawn} random postures could be brought onto the hand's path: {within[0]} is never "
                "clear of that surface; the base may stand too near to it, or within it"
            )
        return (
            f"none of {tally.drawn} random postures could be brought onto the hand's path, within joint limits and "
            "clear of the surfaces: it may be out of reach, or the orientation that it asks for"
        )
    refused = [why for braces, why in tally.refused.items() if len(braces) == count]
    if refused:
        return refused[0]
    if count > len({candidate.location for candidate in search.task.candidates}):
        return f"there are only {len({candidate.location for candidate in search.task.candidates})} candidates"
    missed = sum(len(braces) == count for braces in tally.missed)
    tried = missed + sum(len(braces) == count for braces in tally.reached)
    if tried == 0:
        return f"no set of {count - 1} braces was found that it could grow from"
    return (
        f"no posture was found for any of the {tried} sets tried: not found, which does not say impossible; more "
        f"--starts than {options.starts}, other --candidates or a smaller --min-force may help"
    )


def _verified(
    problem: Task,
    search: Search,
    sizes: Sequence[Size],
    ranked: dict[int, list[Planned]],
    tolerances: Tolerances,
    jobs: int,
    explain: bool,
    tell: Tell,
) -> list[Size]:
    """Sizes with their verdicts: where the best set is refused and another one survives, that one."""
    verifier = Verifier(problem, tolerances, jobs)
    open_ = {size.count: list(ranked[size.count]) for size in sizes if size.planned is not None}
    verdicts: dict[int, list[tuple[Planned, Verdict]]] = {count: [] for count in open_}
    turn = 0
    while open_:
        tell("verifying", min(turn / 3.0, 0.95))
        turn += 1
        batch = [(count, waiting[0]) for count, waiting in open_.items()]
        judged = verifier.verify([(planned.braces, planned.dense) for _, planned in batch])
        for (count, planned), verdict in zip(batch, judged, strict=True):
            verdicts[count].append((planned, verdict))
            open_[count].pop(0)
            if verdict.survives or not open_[count] or count == 0:
                del open_[count]
    answered = []
    for size in sizes:
        if size.planned is None:
            answered.append(size)
            continue
        tried = verdicts[size.count]
        chosen = next((k for k, (_, verdict) in enumerate(tried) if verdict.survives), 0)
        planned, verdict = tried[chosen]
        cheaper = tuple((", ".join(b.label for b in p.braces), v.reason) for p, v in tried[:chosen])
        tolerance = None
        if explain and not verdict.survives and verdict.sound:
            tell("bisecting", 0.95)
            tolerance = verifier.tolerance(planned.braces, planned.dense, verdict.k_p)
        answered.append(
            replace(size, planned=planned, verdict=verdict, reason=verdict.reason, tolerance=tolerance, cheaper=cheaper)
        )
    return answered
