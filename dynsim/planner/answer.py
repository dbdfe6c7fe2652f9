"""Entry point of the brace planner, and its result: the best verified brace set for each number of braces."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from dynsim.engine import named, simulate
from dynsim.errors import ScenarioError, SimulationInterrupted, first_few
from dynsim.planner import planned_scenario
from dynsim.planner.dense import Dense, nearest
from dynsim.planner.problem import BraceSchedule, Candidate, Options, Task, task, without_objects
from dynsim.planner.requirements import check, check_ratings, with_requirements
from dynsim.planner.search import SEGMENTS, Planned, Search, Tally
from dynsim.planner.verify import Corner, Requirement, Tolerances, Verdict, Verification, Verifier
from dynsim.record import Record
from dynsim.scenario import Scenario, require_scenario
from dynsim.scenario.reading import largest_magnitude
from dynsim.scenario.schema import Payload
from dynsim.system import interruption
from dynsim.system.arguments import names_wrong_types

# Sets whose planned heat is at most this multiple of the least heat of their size are ranked by their runs.
RIVAL = 1.25
# Clearance that plans keep beyond the error of the surfaces if a link touches [m].
SPARE = 3e-3
# Gain k_p of plans that are not verified or have no braces [V/rad].
K_P = 500.0
GAP = (
    "statistical: best local optimum of independent searches, and number of searches within 2 % of it; "
    "not a proven bound"
)

Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Size:
    """Best plan for one number of braces.

    Attributes
    ----------
    count : int
        Number of braces.
    planned : Planned or None
        Brace set with its references; None if no plan was found (see ``reason``).
    verdict : Verdict or None
        Result of the verification; None if the plan was not verified.
    agreed, searches : int
        Number of searches that found the least heat within 2 %, and total number of searches.
    reason : str
        Reason why no plan was found or why the plan was rejected; otherwise empty.
    tolerance : tuple of float or None
        Tolerated error of the surface height [m] and tolerated relative error of friction, each determined alone. None
        if not requested, or if the nominal run is already rejected.
    cheaper : tuple
        Brace sets with less heat that were rejected, each with the reason.
    bound : float
        Mean over instants of the least heat at each instant over all paths with at most this number of braces [W]. More
        changes of braces along these paths cannot save more. NaN if changing braces were not requested.
    """

    count: int
    planned: Planned | None
    verdict: Verdict | None = None
    agreed: int = 0
    searches: int = 0
    reason: str = ""
    tolerance: tuple[float | None, float | None] | None = None
    cheaper: tuple[tuple[str, str], ...] = ()
    bound: float = math.nan

    @property
    def braces(self) -> tuple[Candidate, ...]:
        """Braces of the plan; empty without a plan."""
        return () if self.planned is None else self.planned.braces

    @property
    def dense(self) -> Dense:
        """References and statics of the plan, which must exist."""
        assert self.planned is not None
        return self.planned.dense

    @property
    def heat(self) -> float:
        """Planned mean heat [W]; infinite without a plan."""
        return math.inf if self.planned is None else self.planned.heat

    @property
    def nominal(self) -> Corner | None:
        """Nominal run; None if the plan was not verified."""
        return None if self.verdict is None else self.verdict.nominal

    @property
    def expected(self) -> float:
        """Heat used to rank plans [W]: simulated heat of the nominal run if verified, otherwise the planned heat."""
        nominal = self.nominal
        return self.heat if nominal is None or math.isnan(nominal.heat_W) else nominal.heat_W

    @property
    def survives(self) -> bool | None:
        """Whether all corner cases are accepted and all requirements met; None if the plan was not verified."""
        verdict = self.verdict
        return None if verdict is None or not (verdict.corners or verdict.reason) else verdict.survives

    @property
    def requirements(self) -> tuple[Requirement, ...]:
        """Results of the requirements of the scenario."""
        return () if self.verdict is None else self.verdict.requirements

    @property
    def k_p(self) -> float:
        """Gain k_p of the plan [V/rad]."""
        return K_P if self.verdict is None else self.verdict.k_p

    @property
    def label(self) -> str:
        """Names of the brace points and surfaces, or "none"."""
        return "none" if self.planned is None else self.planned.label

    @property
    def variant(self) -> str:
        """Name of this plan's variant in the planned scenario."""
        return f"braces_{self.count}"


@dataclass(frozen=True)
class BracePlan:
    """Result of :func:`plan_braces`: one plan per number of braces.

    Attributes
    ----------
    task : Task
        Planning problem.
    sizes : tuple of Size
        Best plan for each number of braces.
    tally : Tally
        Statistics of the search.
    singles : dict of str to float
        Least heat with a single brace at one posture [W], by candidate.
    ranked : dict of int to list
        Brace sets that were solved along the whole path, with their heat [W], by number of braces, starting with the
        chosen set.
    tolerances : Tolerances
        Errors and limits of the verification.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("pressing")
    >>> plan = dynsim.plan_braces(scenario, candidates=["link_6"], count=(0, 1), budget_s=0.0, verify=False)
    >>> plan
    <BracePlan pressing (plain): 2 sizes, best: link_6 on floor, 19.82 W>
    >>> [(count, round(heat)) for count, heat in plan.pareto]
    [(0, 473), (1, 20)]
    """

    task: Task
    sizes: tuple[Size, ...]
    tally: Tally
    singles: dict[str, float]
    ranked: dict[int, list[tuple[str, float]]]
    tolerances: Tolerances = field(default_factory=Tolerances)

    def __repr__(self) -> str:
        best = self.best
        text = "nothing found" if best is None else f"best: {best.label}, {best.expected:.4g} W"
        return f"<BracePlan {self.task.scenario.title}: {len(self.sizes)} sizes, {text}>"

    @property
    def answered(self) -> list[Size]:
        """Entries of all numbers of braces for which a plan was found."""
        return [size for size in self.sizes if size.planned is not None]

    @property
    def best(self) -> Size | None:
        """Plan of least expected heat, preferably among verified plans that survive; None if no plan was found."""
        return min(self.answered, key=lambda size: (size.survives is False, size.expected), default=None)

    def size(self, count: int) -> Size:
        """Return the plan for a number of braces.

        Parameters
        ----------
        count : int
            Number of braces.

        Returns
        -------
        Size
            Brace set, references, gains and verification.

        Raises
        ------
        ScenarioError
            If this number was not requested, or no plan was found for it.

        Examples
        --------
        >>> import dynsim
        >>> scenario = dynsim.load_scenario("pressing")
        >>> plan = dynsim.plan_braces(scenario, candidates=["link_6"], count=(1, 1), budget_s=0.0, verify=False)
        >>> plan.size(1).label
        'link_6 on floor'
        """
        for size in self.sizes:
            if size.count == count:
                if size.planned is None:
                    raise ScenarioError(f"no plan with {count} braces: {size.reason}")
                return size
        asked = ", ".join(str(size.count) for size in self.sizes)
        raise ScenarioError(f"no plan with {count} braces was requested, only with: {asked}")

    @cached_property
    def table(self) -> list[dict[str, Any]]:
        """Rows with the main results for each number of braces; the keys contain the units."""
        return [
            _row(self.task, size) | {"no_gain_over": None if (fewer := self.no_gain(size)) is None else fewer.count}
            for size in self.sizes
        ]

    def no_gain(self, size: Size) -> Size | None:
        """Return the best plan with fewer braces if it needs no more heat than this plan; otherwise None."""
        fewer = [each for each in self.answered if each.count < size.count and each.survives is not False]
        best = min(fewer, key=lambda each: each.expected, default=None)
        return best if best is not None and best.expected <= size.expected else None

    @property
    def pareto(self) -> list[tuple[int, float]]:
        """Numbers of braces whose expected heat is lower than for all smaller numbers, each with this heat [W]."""
        points: list[tuple[int, float]] = []
        for size in self.answered:
            if not points or size.expected < points[-1][1]:
                points.append((size.count, size.expected))
        return points

    def scenario(self, count: int) -> Scenario:
        """Return the plan with a number of braces as a runnable scenario.

        Parameters
        ----------
        count : int
            Number of braces.

        Returns
        -------
        Scenario
            Scenario with posture, references, brace forces and gains of the plan.

        Raises
        ------
        ScenarioError
            If this number was not requested, or no plan was found for it.

        Examples
        --------
        >>> import dynsim
        >>> scenario = dynsim.load_scenario("pressing")
        >>> plan = dynsim.plan_braces(scenario, candidates=["link_6"], count=(1, 1), budget_s=0.0, verify=False)
        >>> plan.scenario(1)
        <Scenario pressing_plan (braces_1): serial_arm, joint_pd, 10 s, contacts link_6>
        """
        size = self.size(count)
        return planned_scenario.scenario(self.task, size.braces, size.dense, size.k_p, size.variant)

    def record(self, count: int) -> Record:
        """Simulate the plan with a number of braces and return its record.

        Parameters
        ----------
        count : int
            Number of braces.

        Returns
        -------
        Record
            Record of the nominal run.

        Raises
        ------
        ScenarioError
            If this number was not requested, or no plan was found for it.
        SimulationStopped
            If the run ends early.

        Examples
        --------
        >>> import dynsim
        >>> scenario = dynsim.load_scenario("pressing")
        >>> plan = dynsim.plan_braces(scenario, candidates=["link_6"], count=(1, 1), budget_s=0.0, verify=False)
        >>> record = plan.record(1)
        >>> record["q"].shape, round(record.summary["joule_heat_J"])
        ((2001, 10), 198)
        """
        return simulate(self.scenario(count))

    @property
    def yaml(self) -> dict[str, Any]:
        """All plans as one scenario with one variant per number of braces, starting with the best plan."""
        best = self.best
        variants = {
            size.variant: planned_scenario.plan_sections(self.task, size.braces, size.dense, size.k_p)
            for size in sorted(self.answered, key=lambda size: size is not best)
        }
        return {**planned_scenario.shared_sections(self.task), "variants": variants}

    @property
    def json(self) -> dict[str, Any]:
        """Content of ``plan.json``."""
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
                "ended": tally.ended,
                "local_solves": tally.solves,
                "postures_drawn": tally.drawn,
                "postures_on_path": tally.drawn_on,
                "sets_reached": len(tally.reached),
                "sets_not_found": sorted(" + ".join(b.label for b in braces) for braces in tally.missed),
                "sets_refused": {
                    BraceSchedule.of(braces).label.replace(", ", " + "): why for braces, why in tally.refused.items()
                },
                "single_braces_W": self.singles,
            },
            "sizes": [_size_json(self.task, size) for size in self.sizes],
        }


def _row(task: Task, size: Size) -> dict[str, Any]:
    """Return the table row for one number of braces."""
    row: dict[str, Any] = {"count": size.count, "braces": size.label if size.planned else "not found"}
    if size.planned is None:
        return row | {"reason": size.reason}
    dense = size.planned.dense
    nominal = size.nominal or Corner(1.0, 0.0)
    distance, part, _ = nearest(task, dense.schedule, dense.times, dense.q)
    greatest = task.arm.tables.greatest
    share = (np.abs(dense.torques) / greatest).max()
    links = [task.arm.model.robot.links[i] for i in task.arm.links]
    lower, upper = np.array([(link.lower, link.upper) for link in links]).T
    row |= {
        "heat_W": dense.heat,
        "simulated_W": _number(nominal.heat_W),
        "electrical_energy_J": _number(nominal.electrical_energy_J),
        "joint_rate_max": _number(nominal.joint_rate_max),
        "hand_error_m": None if size.verdict is None else _number(size.verdict.hand_m),
        "closed_least": min(nominal.closed_fraction.values(), default=None),
        "peak_torque_N_m": dense.peak_torque,
        "peak_force_N": dense.peak_force,
        "torque_share": _number(share) if np.isfinite(greatest).any() else None,
        "normal_force_min_N": float(dense.forces.min()) if size.count else None,
        "normal_force_max_N": float(dense.forces.max()) if size.count else None,
        "clearance_m": _number(distance),
        "clearance_of": part,
        "joint_limit_distance": _number(min((dense.q - lower).min(), (upper - dense.q).min())),
        "k_p_V_per_rad": size.k_p,
        "found_in_searches": f"{size.agreed}/{size.searches}",
        "survives": size.survives,
        "reason": size.reason,
    }
    for r in size.requirements:
        row |= {r.key: _number(r.value), f"{r.key}_margin": _number(r.margin), f"{r.key}_met": r.met}
    if size.tolerance is not None:
        row |= {"holds_surface_m": size.tolerance[0], "holds_friction": size.tolerance[1]}
    return row


def _size_json(task: Task, size: Size) -> dict[str, Any]:
    """Return the entry for one number of braces in ``plan.json``."""
    braces = [{"body": b.body, "point_m": list(b.point_m), "surface": b.surface, "name": b.name} for b in size.braces]
    entry: dict[str, Any] = {"count": size.count, "braces": braces}
    if size.planned is None:
        return entry | {
            "heat_W": None, "times_s": [], "q_rad": [], "forces_N": [], "survives": None, "reason": size.reason,
        }  # fmt: skip
    dense = size.planned.dense
    forces = np.array([np.interp(dense.times, dense.fine, column) for column in dense.forces.T]).T
    corners = () if size.verdict is None else size.verdict.corners
    distance, part, when = nearest(task, dense.schedule, dense.times, dense.q)
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
        "phases": [
            {"from_s": start, "to_s": end, "braces": [brace.label for brace in braces]}
            for start, end, braces in task.phases(dense.schedule)
        ],
        "bound_W": _number(size.bound),
        "heat_at_knots_W": size.planned.local.heat,
        "peak_torque_N_m": dense.peak_torque,
        "peak_force_N": dense.peak_force,
        "clearance": {"distance_m": _number(distance), "of": part, "at_s": when},
        "searches": size.searches,
        "searches_that_found_it": size.agreed,
        "cheaper_refused": [{"braces": label, "reason": why} for label, why in size.cheaper],
        "corners": [
            {key: _number(value) if isinstance(value, float) else value for key, value in vars(corner).items()}
            for corner in corners
        ],
        "requirements": [vars(r) | {"value": _number(r.value), "margin": _number(r.margin)} for r in size.requirements],
        **(
            {} if size.tolerance is None else {"holds": {"surface_m": size.tolerance[0], "friction": size.tolerance[1]}}
        ),
    }


def _number(value: float) -> float | None:
    """Return a number for JSON; NaN and infinity, which JSON lacks, become None."""
    return float(value) if math.isfinite(value) else None


@names_wrong_types
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
    phases: tuple[int, int] = (1, 1),
    starts: int = 4,
    budget_s: float = 30.0,
    seed: int = 0,
    jobs: int = 1,
    tolerances: Tolerances | None = None,
    tell: Tell | None = None,
) -> BracePlan:
    """Find the brace points, surfaces, postures and forces of least motor heat along the hand path.

    For each number of braces, the planner minimises the mean heat of the motors, Σ R i², over the path
    ``controller.hand.path`` of the scenario (see :mod:`dynsim.planner.arm`). The plans are then simulated with errors
    in friction and surface height.

    Parameters
    ----------
    scenario : Scenario
        Scenario with an arm, surfaces and a hand path; its posture and braces are ignored.
    candidates : sequence of str, optional
        Points that may become braces: links (at their joint), ranges ``first:last`` of links, frames, or contact
        points; default: all links except the first two, and all contact points.
    along : sequence of float, optional
        Fractions of the link length, above 0 and at most 1, at which there are additional candidates.
    radius_m : float, optional
        Radius of the candidates [m]; default: the radius of the link.
    count : tuple of int, optional
        Minimum and maximum number of braces.
    surfaces : sequence of str, optional
        Surfaces that braces may use; default: all.
    peak_W_per_N_m : float, optional
        Additional cost of the maximum torque of revolute joints [W/(N m)]; forces of prismatic joints have no such
        cost.
    clearance_m : float, optional
        Minimum distance of unbraced joints from surfaces, and of links from objects [m].
    min_N : float, optional
        Minimum normal force of each brace [N].
    verify : bool, optional
        If True, simulate the corner cases of ``tolerances``, and choose gains that tolerate them.
    explain : bool, optional
        If True, find by bisection the largest error that rejected plans tolerate.
    exhaustive : bool, optional
        If True, try every set of candidates instead of growing sets from the best smaller sets (slow).
    phases : tuple of int, optional
        Minimum and maximum number of brace sets along the path, one after the other; a path there and back uses them in
        reverse order on the way back.
    starts : int, optional
        Number of rounds of each search.
    budget_s : float, optional
        Time after which no further search starts or continues [s]; 0: one search. Searches end when the best heat of
        each number of braces was found twice.
    seed : int, optional
        Seed of the random start postures.
    jobs : int, optional
        Number of worker processes for the verification.
    tolerances : Tolerances, optional
        Errors and limits of the verification, see :class:`dynsim.planner.verify.Tolerances`.
    tell : callable, optional
        Called with the current stage (str) and the progress, 0 to 1 (float).

    Returns
    -------
    BracePlan
        One plan per number of braces.

    Raises
    ------
    ModelError
        If the scenario has no arm with DC motors, no hand path or no surfaces, or a candidate does not exist.
    ScenarioError
        If an argument is out of range, or gravity is zero.

    Examples
    --------
    >>> import dynsim
    >>> scenario = dynsim.load_scenario("pressing")
    >>> plan = dynsim.plan_braces(scenario, candidates=["link_6"], count=(0, 1), budget_s=0.0, verify=False)
    >>> plan.best.label, round(plan.best.heat, 1)
    ('link_6 on floor', 19.8)
    """
    require_scenario(scenario)
    options = Options(
        tuple(candidates), tuple(along), radius_m, count, tuple(surfaces), peak_W_per_N_m, clearance_m, min_N, starts,
        seed, budget_s, exhaustive, phases,
    )  # fmt: skip
    return plan_with(scenario, options, Verification(tolerances or Tolerances(), verify, explain, jobs), tell)


def plan_with(scenario: Scenario, options: Options, verification: Verification, tell: Tell | None = None) -> BracePlan:
    """Return :func:`plan_braces` with the arguments as options."""
    check_arguments(options, verification)
    tell = tell or silent
    with named(scenario):
        return answered(searched(scenario, options, tell), verification, tell)


def silent(text: str, share: float) -> None:
    """Ignore the progress."""


def check_arguments(options: Options, verification: Verification) -> None:
    """Raise ScenarioError if an option of the planner is out of range."""
    least, most = options.count
    if not 0 <= least <= most:
        raise ScenarioError(f"count = {least}:{most}: the minimum must not exceed the maximum, and both must be ≥ 0")
    fewest, largest = options.phases
    if not 1 <= fewest <= largest <= SEGMENTS:
        raise ScenarioError(f"phases = {fewest}:{largest}: must be 1 to {SEGMENTS}, with minimum ≤ maximum")
    whole = ("starts", options.starts, 1), ("seed", options.seed, 0), ("jobs", verification.jobs, 1)
    for key, number, smallest in whole:
        if number < smallest:
            raise ScenarioError(f"{key} = {number}: must be at least {smallest}")
    positive = {
        "radius_m": options.radius_m, "peak_W_per_N_m": options.peak, "clearance_m": options.clearance_m,
        "min_N": options.min_N, "budget_s": options.budget_s,
        "shift_m": verification.tolerances.most_shift,
    }  # fmt: skip
    for key, value in positive.items():
        limit = largest_magnitude(key)
        if value is not None and not 0.0 <= value <= limit:
            raise ScenarioError(f"{key} = {value}: must be between 0 and {limit:g}")
    if any(not 0.0 < share <= 1.0 for share in options.along):
        raise ScenarioError(
            f"along = {list(options.along)}: must be fractions of the link length, above 0 and at most 1"
        )


@dataclass(frozen=True)
class Searched:
    """Search of one problem, and the best plans of each number of braces, sorted by heat."""

    search: Search
    ranked: dict[int, list[Planned]]

    def add(self, other: Searched) -> None:
        """Continue the plans of a similar problem, from their postures, and keep those with less heat."""
        for count, plans in self.ranked.items():
            for plan in map(self.search.continued, other.ranked[count]):
                if plan is None:
                    continue
                others = [p for p in plans if p.dense.schedule != plan.dense.schedule]
                if all(plan.heat < p.heat for p in plans if p.dense.schedule == plan.dense.schedule):
                    plans[:] = sorted([*others, plan], key=lambda p: p.heat)


def searched(scenario: Scenario, options: Options, tell: Tell) -> Searched:
    """Search the plans of a scenario, see :func:`plan_braces`."""
    problem = task(scenario, options)
    if problem.without_radius and options.count[1] > 0:
        warnings.warn(
            f"plan: candidates {', '.join(problem.without_radius)} have radius 0 (links from URDF have no radius, "
            "even with <visual>); braces would put the joint axis on the surface; set --radius, or list "
            "contacts.points with radius_m in --candidates",
            stacklevel=3,
        )
    if objects := tuple(scenario.config.objects):
        warnings.warn(
            f"plan: objects.{first_few(objects)}: not in plan.yaml and not in the simulated runs, because planned "
            "voltages require a motor on every joint; for the planner, objects are obstacles at their initial pose "
            "(with contacts.between, those that it lists)",
            stacklevel=3,
        )
    loads = without_objects(scenario).config.loads
    if unplanned := [name for name, load in loads.items() if not isinstance(load, Payload)]:
        warnings.warn(
            f"plan: loads.{first_few(unplanned)}: ignored by the planner, which supports only payloads; simulated "
            "runs include these loads and reject plans whose heat they raise; define a constant weight as "
            "`type: payload`",
            stacklevel=3,
        )
    if not np.any(problem.arm.model.robot.gravity):
        raise ScenarioError("plant.gravity_m_s2 = [0, 0, 0]: must not be zero; braces are useless without gravity")
    check_ratings(problem)
    search = Search(problem, tell)
    return Searched(search, search.run())


def answered(known: Searched, verification: Verification, tell: Tell) -> BracePlan:
    """Choose the plan of each number of braces, see :func:`plan_braces`."""
    search, ranked = known.search, known.ranked
    problem, (least, most) = search.task, search.task.options.count
    required = problem.scenario.config.requirements
    tolerances = with_requirements(verification.tolerances, required)
    sizes = [_answered(search, size, ranked[size]) for size in range(least, most + 1)]
    verify = verification.verify and search.tally.ended != "interrupted"
    if verify or required is not None:
        try:
            how = replace(verification, tolerances=tolerances, verify=verify)
            sizes = _verified(search, sizes, ranked, how, tell)
        except (KeyboardInterrupt, SimulationInterrupted):
            # The plans are kept without their runs.
            interruption.answered()
            search.tally.ended = "interrupted"
    heats = search.single_heats
    singles = {brace.label: heats[brace,] for brace in problem.candidates if (brace,) in heats}
    sets = {size.count: _ranked(size, ranked[size.count]) for size in sizes}
    return BracePlan(problem, tuple(sizes), search.tally, singles, sets, tolerances)


def _ranked(size: Size, planned: Sequence[Planned]) -> list[tuple[str, float]]:
    """Return the sets with the same number of braces and their heat, starting with the chosen set."""
    names = [(plan.label, plan.heat) for plan in planned]
    return sorted(names, key=lambda item: (item[0] != size.label, item[1]))


def _answered(search: Search, count: int, ranked: Sequence[Planned]) -> Size:
    """Return the best plan for a number of braces before verification, or the reason why there is no plan."""
    if ranked:
        size = Size(count, ranked[0], bound=search.bounds.get(count, math.nan))
        return _counted(search.tally, size)
    return Size(count, None, reason=_failure(search, count), searches=len(search.tally.heats.get(count, [])))


def _counted(tally: Tally, size: Size) -> Size:
    """Return the plan with the numbers of searches that agree and of all searches; a single search changes braces."""
    if size.dense.schedule.borders:
        return replace(size, agreed=1, searches=1)
    return replace(size, agreed=tally.agreed(size.count), searches=len(tally.heats.get(size.count, [])))


def _failure(search: Search, count: int) -> str:
    """Return the reason why no plan was found for a number of braces."""
    tally, options = search.tally, search.task.options
    if tally.ended == "interrupted":
        return "interrupted before a plan was found"
    if not tally.drawn_on:
        if within := search.never_clear():
            return f"none of {tally.drawn} random postures could be projected onto the hand path: {within[0]}"
        return (
            f"none of {tally.drawn} random postures could be projected onto the hand path within joint limits and "
            "clear of the surfaces; the path or its orientation may be out of reach"
        )
    refused = [why for braces, why in tally.refused.items() if len(braces) == count]
    if refused:
        return refused[0]
    if options.phases[0] > 1:
        return "no plan with changing braces was found; try --phases 1:2, other --candidates or a slower path"
    points = len({candidate.location for candidate in search.task.candidates})
    if count > points:
        return f"only {points} candidates exist"
    missed = sum(len(braces) == count for braces in tally.missed)
    tried = missed + sum(len(braces) == count for braces in tally.reached)
    if tried == 0:
        return f"no set of {count - 1} braces was found from which the search could start"
    return (
        f"no posture was found for any of the {tried} sets tried, but one may exist; try more than {options.starts} "
        "--starts, other --candidates or a smaller --min-force"
    )


def _verified(
    search: Search, sizes: Sequence[Size], ranked: dict[int, list[Planned]], how: Verification, tell: Tell
) -> list[Size]:
    """Choose the set whose run needs the least heat for each number of braces, among the sets that survive.

    If a set is rejected because a link touches, it is planned again with the clearance that the errors require.
    If plans are not verified, only the requirements of the scenario are checked that need no simulation.
    """
    tolerances, verify = how.tolerances, how.verify
    require = partial(check, search.task, tolerances)
    verifier = Verifier(search.task, tolerances, how.jobs, require)
    open_ = {size.count: list(ranked[size.count]) for size in sizes if size.planned is not None}
    tell("verifying", 0.0)
    rival = RIVAL if verify else 0.0
    rivals = [
        (count, search.finest(plan))
        for count, plans in open_.items()
        for plan in plans
        if plan.heat <= rival * plans[0].heat
    ]
    open_ = {count: [plan for plan in plans if plan.heat > rival * plans[0].heat] for count, plans in open_.items()}
    nominal = verifier.nominal([(plan.braces, plan.dense) for _, plan in rivals])
    # Runs that ended early come last.
    order = sorted(zip(rivals, nominal, strict=True), key=lambda run: (np.isnan(run[1].heat_W), run[1].heat_W))
    for (count, plan), _ in reversed(order):
        open_[count].insert(0, plan)
    verdicts: dict[int, list[tuple[Planned, Verdict]]] = {count: [] for count in open_}
    turn = 0
    while open_:
        tell("verifying", min((turn + 1) / 4.0, 0.95))
        turn += 1
        batch = [(count, search.finest(waiting.pop(0))) for count, waiting in open_.items()]
        pairs = [(planned.braces, planned.dense) for _, planned in batch]
        judged = verifier.verify(pairs) if verify else [Verdict(K_P, (), require(*each, K_P, ())) for each in pairs]
        for (count, planned), verdict in zip(batch, judged, strict=True):
            verdicts[count].append((planned, verdict))
            if verdict.kind == "touch":
                again = search.clearer(planned, tolerances.most_shift + SPARE)
                open_[count][:0] = [] if again is None else [again]
            if not verdict.reason or not open_[count]:
                del open_[count]
    answered = []
    for size in sizes:
        if size.planned is None:
            answered.append(size)
            continue
        tried = verdicts[size.count]
        chosen = next((k for k, (_, verdict) in enumerate(tried) if not verdict.reason), 0)
        planned, verdict = tried[chosen]
        cheaper = tuple((p.label, v.reason) for p, v in tried[:chosen] if p.dense.schedule != planned.dense.schedule)
        tolerance = None
        if how.explain and verdict.reason and verdict.sound:
            tell("bisecting", 0.95)
            tolerance = verifier.tolerance(planned.braces, planned.dense, verdict.k_p)
        made = replace(size, planned=planned, verdict=verdict, reason=verdict.reason, tolerance=tolerance)
        answered.append(_counted(search.tally, replace(made, cheaper=cheaper)))
    return answered
