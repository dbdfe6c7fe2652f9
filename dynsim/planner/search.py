"""Search over sets of braces, which grow from the best smaller sets by one brace at a time.

For each number of braces, all sets are solved at one posture of the path without slip, then the best sets are solved at
a few knots with slip. The best of these are extended by one more brace. A set without a solution is "not found", not
"impossible", because the solver starts from postures of other sets.

Independent searches, each with several rounds, exchanges of braces and kicks of postures, are repeated until the best
heat of each number of braces was found twice.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np

from dynsim.compile.bracing import RAMP
from dynsim.jit.kernel import reals
from dynsim.model.description import Array
from dynsim.planner.arm import Local, Problem, solve
from dynsim.planner.dense import Dense, references
from dynsim.planner.problem import (
    COARSE_SLIP_SCALE,
    FINAL_SLIP_SCALE,
    FINE_SLIP_SCALE,
    BraceSchedule,
    BraceSet,
    Candidate,
    Task,
)
from dynsim.system import interruption

# Number of sets with the same number of braces that continue to the next stage and to the next number of braces.
BEAM = 3
# Number of start postures per round, and maximum number of random postures tried to find them.
POSTURES, DRAWS = 4, 60
# Range of the standard deviation of random joint angles [rad], and standard deviation of prismatic joints [m].
SPREAD, PRISMATIC_SPREAD = (0.3, 1.5), 0.2
# Number of sets of each size that are solved along the whole path in each round, and number of sets of each size that
# are refined at the end.
PATHS, KEPT = 4, 5
# Number of sets of each size whose neighbours are tried along the whole path.
NEIGHBOURS = 5
# Maximum ratio of a neighbour's cost to the least cost of all sets of its size.
PROMISING = 1.25
# Number of sets of each size whose postures are kicked, number of kicks in a row without success after which a set is
# left, and range of their standard deviation [rad or m].
KICKED, KICKS, KICK = 2, 16, (0.1, 1.2)
# Relative difference below which two costs of a set belong to the same path; maximum ratio of a path's cost to the
# least cost up to which the path is refined further; maximum number of refined paths per set.
SAME_COST, NEAR, ALTERNATIVES = 1e-3, 1.1, 6
# Relative difference of the heats along dense references below which two searches agree, number of searches that must
# agree, and minimum number of local problems. In small problems, two searches may agree on a frequent local optimum.
AGREE, TWICE, EFFORT = 0.02, 2, 2000
# Number of knots of closed paths and of other whole paths. For sets that may be the best, their number is doubled until
# it exceeds the third number, or the dense references cost less than the last factor times the cost at the knots.
CLOSED_KNOTS, PATH_KNOTS, MOST_KNOTS, CONVERGED = 24, 17, 100, 1.01
# Ratio of the heats along the dense references and at the knots above which fewer knots are tried, and number of sets
# of each size whose dense references are computed to compare searches.
BRANCHES, COMPARED = 1.1, 2

# Changing braces: number of segments of the path; number of sets per segment in schedules of two and of more phases;
# number of schedules that are optimised; shortest phase [s], for two hand-overs.
SEGMENTS, WIDEST, NARROW, OPTIMISED, SHORTEST = 4, 5, 3, 60, 4.0 * RAMP

Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Planned:
    """Set of braces, or schedule of sets, with its best postures along the whole path.

    ``finest``: more knots were tried; ``clearer``: the path keeps the clearance that the verification subtracts.
    """

    braces: BraceSet
    times: Array
    local: Local
    dense: Dense
    finest: bool = False
    clearer: bool = False

    @property
    def label(self) -> str:
        """Names of the braces, or "none"."""
        return self.dense.schedule.label

    @property
    def heat(self) -> float:
        """Mean heat along the dense references [W]."""
        return self.dense.heat

    @property
    def converged(self) -> bool:
        """Whether the dense references cost about the same as the knots."""
        return self.heat <= CONVERGED * self.local.heat


class PosturePath(NamedTuple):
    """Cost of a set at few knots [W], and its solution along the whole path, None if the path is out of reach."""

    coarse: float
    local: Local | None


@dataclass
class Tally:
    """Statistics of a search.

    Attributes
    ----------
    solves : int
        Number of local problems solved.
    drawn, drawn_on : int
        Number of random postures tried, and number of these that could be projected onto the path.
    reached, missed : set
        Sets for which a posture was found, and sets for which none was found.
    heats : dict
        Best heat of each search along its dense references [W], by number of braces; inf if no path was found.
    ended : str
        Reason why no more searches started: ``agreed``, ``budget`` or ``interrupted``.
    refused : dict
        Rejected sets, each with the reason.
    """

    solves: int = 0
    drawn: int = 0
    drawn_on: int = 0
    reached: set[BraceSet] = field(default_factory=set)
    missed: set[BraceSet] = field(default_factory=set)
    heats: dict[int, list[float]] = field(default_factory=dict)
    refused: dict[BraceSet | BraceSchedule, str] = field(default_factory=dict)
    ended: str = "agreed"

    def agreed(self, size: int) -> int:
        """Return the number of searches that found the best heat with a number of braces."""
        heats = self.heats.get(size, [])
        return sum(heat <= min(heats) * (1.0 + AGREE) for heat in heats if heat < math.inf)


class Search:
    """Search over brace sets for one task."""

    def __init__(self, task: Task, tell: Tell | None = None) -> None:
        self.task, self.tally, self.kept = task, Tally(), KEPT
        self._tell = tell or (lambda text, share: None)
        self.single_heats: dict[BraceSet, float] = {}
        # Mean over instants of the least instant heat over all whole paths [W], by number of braces.
        self.bounds: dict[int, float] = {}
        # Whole paths of each set in the present search, by their cost with smooth friction [W].
        self._smooth: dict[BraceSet, dict[float, Local]] = {}
        # Refined paths, or reasons why they are infeasible, by set and cost [W] of the path.
        self._refinements: dict[tuple[BraceSet | BraceSchedule, float], Planned | str] = {}
        self._rng = np.random.default_rng(task.options.seed)
        self._began, self._budget = time.monotonic(), max(task.options.budget_s, 1e-9)
        self.coarse = 4 if task.kind == "closed" else 3
        self.path = CLOSED_KNOTS if task.kind == "closed" else PATH_KNOTS

    def solve(
        self, braces: BraceSet | BraceSchedule, start: Array, count: int, turns: int = 40,
        slip_scale: float = COARSE_SLIP_SCALE, target: Array | None = None, most: float = math.inf,
    ) -> Local | None:  # fmt: skip
        """Find the local optimum, starting from postures at other knots or from one posture."""
        self.tally.solves += 1
        problem = self.task.problem(braces, count, slip_scale, target)
        return solve(problem, self.spread(start, count), turns, most=most)

    def spread(self, start: Array, count: int) -> Array:
        """Interpolate postures, shape (n,) or (K, n), linearly at ``count`` knots."""
        known = np.atleast_2d(start)
        if len(known) == 1 or count == 1:
            return reals(np.tile(known[len(known) // 2], (count, 1)))
        times, wanted = self.task.times(len(known)), self.task.times(count)
        if self.task.kind == "closed":
            times, known = np.append(times, self.task.span), np.vstack([known, known[:1]])
        return reals(np.stack([np.interp(wanted, times, column) for column in known.T], axis=1))

    def _starts(self, first: bool, target: Array | None = None) -> list[Array]:
        """Return random postures that are clear of all surfaces, with the hand at a target or the middle of the path.

        The first round also tries the initial posture.
        """
        problem, postures = self.task.problem((), 1, target=target), list[Array]()
        arm = self.task.arm
        initial = arm.model.robot.initial[list(arm.columns)]
        for draw in range(DRAWS):
            Q = reals(initial if first and draw == 0 else self.draw())[None]
            self.tally.drawn += 1
            if problem.retract(Q, 60) <= 1e-7:
                postures.append(Q[0])
                self.tally.drawn_on += 1
                if len(postures) == POSTURES:
                    break
        return postures

    def draw(self) -> Array:
        """Draw a random posture near the initial posture; its standard deviation is also random."""
        tables, rng = self.task.arm.tables, self._rng
        initial = self.task.arm.model.robot.initial[list(self.task.arm.columns)]
        spread = np.where(tables.prismatic, PRISMATIC_SPREAD, rng.uniform(*SPREAD))
        return np.clip(initial + spread * rng.normal(size=len(spread)), tables.lower, tables.upper)

    def never_clear(self) -> list[str]:
        """Return texts about points and pairs that violate their clearance in every one of some random postures."""
        problem, task = self.task.problem((), 1), self.task
        greatest = np.full(len(problem.points.body), -np.inf)
        for _ in range(DRAWS):
            problem.evaluate(reals(self.draw())[None], np.zeros((1, 0)))
            greatest = np.maximum(greatest, problem.work.gap[0])
        advice = "is always too close to that surface; move the base away from the surface"
        texts = [f"{point.label} {advice}" for point in task.clear.values()]
        texts += [f"{a} always touches {b}; add [{a}, {b}] to contacts.between.ignore" for a, b in task.arm.pairs]
        return [text for text, gap, least in zip(texts, greatest, problem.points.margin, strict=True) if gap < least]

    def run(self) -> dict[int, list[Planned]]:
        """Run searches and return the best sets of each size, sorted by heat along their dense references.

        The list of a size may be empty. Searches are independent, from different postures. They are repeated until two
        of them agree for each size, the time budget ends, or an interrupt (Ctrl-C) ends the search; the best paths so
        far are then used. Agreement is the only indication of how close the result is to the optimum.
        """
        (least, most), tally = self.task.options.count, self.tally
        sizes, number, self._began = range(least, most + 1), 0, time.monotonic()
        paths: dict[BraceSet, list[PosturePath]] = {}
        searched: dict[BraceSet, list[PosturePath]] = {}
        try:
            while True:
                agreed = sum(min(tally.agreed(size), TWICE) for size in sizes) / (TWICE * len(sizes))
                self._tell(f"search {number + 1}", 0.8 * max(agreed, min(self._elapsed / self._budget, 1.0)))
                self._search(searched, number, most)
                number += 1
                self._merge(searched, paths)
                searched = {}
                agree = number >= TWICE and all(self._agreed(size) for size in sizes)
                if self._late or (agree and tally.solves >= EFFORT):
                    tally.ended = "agreed" if agree else "budget"
                    break
        except KeyboardInterrupt:
            if searched:
                self._merge(searched, paths)
            if not any(path.local for some in paths.values() for path in some):
                raise
            interruption.answered()
            tally.ended = "interrupted"
        planned: dict[int, list[Planned]] = {}
        for size in sizes:
            try:
                planned[size] = self._planned(paths, size)
            except KeyboardInterrupt:
                if tally.ended == "interrupted":
                    raise
                interruption.answered()
                tally.ended = "interrupted"
                planned[size] = self._planned(paths, size)
        return planned

    def _planned(self, paths: Mapping[BraceSet, list[PosturePath]], size: int) -> list[Planned]:
        """Refine the paths with a number of braces; after an interrupt, braces that change are not searched."""
        self._tell("refining", 0.8 + 0.2 * size / (self.task.options.count[1] + 1))
        chosen: dict[BraceSet | BraceSchedule, list[PosturePath]] = {
            braces: some for braces, some in paths.items() if len(braces) == size
        }
        planned = [] if self.task.options.phases[0] > 1 else self._refined(chosen)
        if self.tally.ended != "interrupted" and (changing := self._changing(paths, size)):
            planned = sorted(planned + self._refined(changing), key=_heat)
        return planned

    def _merge(self, searched: Mapping[BraceSet, list[PosturePath]], paths: dict[BraceSet, list[PosturePath]]) -> None:
        """Add the paths of a search to the paths of all searches, and note its best heats."""
        heats = {
            size: min(map(self._dense_heat, self._best(searched, size)[:COMPARED]), default=math.inf)
            for size in range(self.task.options.count[1] + 1)
        }
        for size, heat in heats.items():
            self.tally.heats.setdefault(size, []).append(heat)
        for braces, some in searched.items():
            known = paths.setdefault(braces, [])
            known += [path for path in some if not any(_same(path.coarse, other.coarse) for other in known)]

    def _search(self, paths: dict[BraceSet, list[PosturePath]], number: int, most: int) -> None:
        """Run one search, which starts anew from random postures; add the paths of its sets."""
        rounds = self.task.options.starts
        self._smooth.clear()
        for k in range(number * rounds, (number + 1) * rounds):
            if number and self._late:
                return
            for ranked in self._round(k, most).values():
                for item in ranked[:PATHS]:
                    self._path(paths.setdefault(item[1], []), *item)
        changed: set[tuple[BraceSet, int, float]] = set()
        self._exchange(paths, most, changed, number > 0)
        self._kick(paths, most, number > 0)
        self._exchange(paths, most, changed, number > 0)

    def _kick(self, paths: dict[BraceSet, list[PosturePath]], most: int, limited: bool) -> None:
        """Solve the best paths of each size again from randomly displaced postures, until this stops to improve them.

        All knots are displaced by the same random angles of some joints.
        """
        n, rng = self.task.arm.n, self._rng
        for size in range(most + 1):
            for best, braces in self._best(paths, size)[:KICKED]:
                failed = 0
                while failed < KICKS and not (limited and self._late):
                    failed += 1
                    kick = rng.uniform(*KICK) * rng.normal(size=n) * (rng.random(n) < rng.uniform(0.2, 1.0))
                    local = self._whole(braces, best.Q + kick, best.cost)
                    if local is not None and local.cost < (1.0 - SAME_COST) * best.cost:
                        best, failed = local, 0
                        paths[braces].append(PosturePath(local.cost, local))

    def _agreed(self, size: int) -> bool:
        """Return whether enough searches found the best heat with a number of braces, or none found any path."""
        return self.tally.agreed(size) >= TWICE or min(self.tally.heats[size]) == math.inf

    @property
    def _elapsed(self) -> float:
        """Time since the start of the searches [s]."""
        return time.monotonic() - self._began

    @property
    def _late(self) -> bool:
        """Whether the time budget has ended."""
        return self._elapsed >= self._budget

    def _path(self, known: list[PosturePath], cost: float, braces: BraceSet, Q: Array) -> None:
        """Solve a whole path from postures at few knots, and add it to the known paths of its set.

        Nearly equal costs at few knots belong to the same path. A path whose cost is far above the least cost is
        ignored.
        """
        least = min((path.coarse for path in known), default=math.inf)
        if cost <= NEAR * least and not any(_same(path.coarse, cost) for path in known):
            known.append(PosturePath(cost, self._whole(braces, Q)))

    def _exchange(
        self,
        paths: dict[BraceSet, list[PosturePath]],
        most: int,
        changed: set[tuple[BraceSet, int, float]],
        limited: bool,
    ) -> None:
        """Solve whole paths for the neighbours of the best sets, with one brace less or more, until no new sets remain.

        This is useful because the ranking of sets along the path differs from their ranking at few knots, and because
        few sets are close to a random posture.
        """
        changes = [*((size, -1) for size in range(most, 1, -1)), *((size, 1) for size in range(most))]
        going_on = True
        while going_on:
            going_on = False
            for size, change in changes:
                least = min((local.cost for local, _ in self._best(paths, size + change)), default=math.inf)
                for near, braces in self._best(paths, size)[:NEIGHBOURS]:
                    if (braces, change, near.cost) in changed:
                        continue
                    if limited and self._late:
                        return
                    changed.add((braces, change, near.cost))
                    going_on = True
                    for other in self._grown(braces) if change > 0 else combinations(braces, size - 1):
                        local, known = self._whole(other, near.Q, PROMISING * least), paths.setdefault(other, [])
                        if local is not None and not any(_same(path.coarse, local.cost) for path in known):
                            known.append(PosturePath(local.cost, local))
                            least = min(least, local.cost)

    def _best(self, paths: Mapping[BraceSet, list[PosturePath]], size: int) -> list[tuple[Local, BraceSet]]:
        """Return the best path of each set with ``size`` braces, sorted by cost."""
        best = [
            (min((path.local for path in some if path.local is not None), key=_cost), braces)
            for braces, some in paths.items()
            if len(braces) == size and any(path.local is not None for path in some)
        ]
        return sorted(best, key=lambda item: item[0].cost)

    def _round(self, number: int, most: int) -> dict[int, list[tuple[float, BraceSet, Array]]]:
        """Search from new start postures; return the sets of each size with cost and posture, sorted by cost."""
        starts = self._starts(first=number == 0)
        best: dict[int, list[tuple[float, BraceSet, Array]]] = {}
        unbraced = [r for q in starts if (r := self.solve((), q, 1)) is not None]
        if not unbraced:
            return best
        unbraced.sort(key=_cost)
        best[0] = [(r.cost, (), r.Q) for r in unbraced]
        front: list[tuple[BraceSet, list[Array]]] = [((), [*starts, unbraced[0].Q])]
        for size in range(1, most + 1):
            cheap = self._cheap(self._sets(size, front), number % 2 == 0)
            slipping = self._slipping(cheap, 2 * BEAM)
            if slipping and not self.task.options.exhaustive:
                _, braces, Q = slipping[0]
                swaps = {grown: [Q] for grown in self._swaps(braces) if grown not in cheap}
                slipping += self._slipping(self._cheap(swaps, True), 2)
                slipping.sort(key=lambda item: item[0])
            best[size] = slipping[:BEAM]
            # If no set of this size has a path, the best single postures still serve as starts for larger sets.
            front = [(braces, [Q[len(Q) // 2]]) for _, braces, Q in best[size]] or [
                (braces, [cheap[braces].Q]) for braces in sorted(cheap, key=lambda braces: cheap[braces].cost)[:BEAM]
            ]
        return best

    def _cheap(
        self, sets: Mapping[BraceSet, list[Array]], best: bool, target: Array | None = None
    ) -> dict[BraceSet, Local]:
        """Solve sets at one posture without slip from start postures; keep the best or a random solution of each.

        The hand is at a target, or in the middle of the path.
        """
        reached: dict[BraceSet, Local] = {}
        for braces, postures in sets.items():
            tried = [r for q in postures if (r := self.solve(braces, q, 1, 25, target=target)) is not None]
            if tried:
                chosen = min(tried, key=_cost) if best else tried[self._rng.integers(len(tried))]
                reached[braces] = chosen
                self.tally.missed.discard(braces)
                if len(braces) == 1 and target is None:
                    self.single_heats[braces] = min(reached[braces].heat, self.single_heats.get(braces, math.inf))
                self.tally.reached.add(braces)
            elif braces not in self.tally.reached:
                self.tally.missed.add(braces)
        return reached

    def _slipping(self, cheap: Mapping[BraceSet, Local], count: int) -> list[tuple[float, BraceSet, Array]]:
        """Solve the best ``count`` sets at few knots with slip; return them sorted by cost."""
        ranked = sorted(cheap.items(), key=lambda item: item[1].cost)[:count]
        solved = [
            (r.cost, braces, r.Q)
            for braces, local in ranked
            if (r := self.solve(braces, local.Q, self.coarse, 30)) is not None
        ]
        return sorted(solved, key=lambda item: item[0])

    def _grown(self, braces: BraceSet) -> list[BraceSet]:
        """Return the sets with one more brace."""
        sets = [
            tuple(brace for brace in self.task.candidates if brace in braces or brace == new)
            for new in self.task.candidates
            if new not in braces
        ]
        return [grown for grown in sets if _fits(grown)]

    def _swaps(self, braces: BraceSet) -> list[BraceSet]:
        """Return the sets with one brace exchanged for another candidate."""
        left = combinations(braces, len(braces) - 1)
        return list(dict.fromkeys(grown for some in left for grown in self._grown(some) if grown != braces))

    def _sets(self, size: int, front: Sequence[tuple[BraceSet, list[Array]]]) -> dict[BraceSet, list[Array]]:
        """Return the sets that grow from smaller sets, with start postures."""
        sets: dict[BraceSet, list[Array]] = {}
        if self.task.options.exhaustive:
            for chosen in combinations(self.task.candidates, size):
                if _fits(chosen):
                    sets[chosen] = [Q for _, postures in front for Q in postures][: 2 * BEAM]
            return sets
        for braces, postures in front:
            for grown in self._grown(braces):
                sets.setdefault(grown, []).extend(postures)
        return sets

    def _whole(self, braces: BraceSet, Q: Array, most: float = math.inf) -> Local | None:
        """Solve a whole path from postures at few knots, first with smooth friction, which has fewer local optima.

        Returns None if there is no path, or if its cost with smooth friction exceeds ``most`` [W]. Nearly equal costs
        with smooth friction belong to the same path, which is solved once.
        """
        half, known = (self.path + 1) // 2, self._smooth.setdefault(braces, {})
        local = self.solve(braces, Q, half, 30, most=most) or (None if known else self._walked(braces, Q, half))
        if local is None or local.cost > most:
            return None
        for cost, path in known.items():
            if _same(cost, local.cost):
                return path
        path = self.solve(braces, local.Q, self.path, 30, FINE_SLIP_SCALE) or local
        known[local.cost] = path
        return path

    def _refined(self, paths: Mapping[BraceSet | BraceSchedule, list[PosturePath]]) -> list[Planned]:
        """Refine the best paths of the best sets with more knots; return them sorted by heat along dense references."""
        whole = {braces: sorted((p.local for p in some if p.local), key=_cost) for braces, some in paths.items()}
        reached = {braces: some for braces, some in whole.items() if some}
        planned = []
        for braces in sorted(reached, key=lambda braces: reached[braces][0].cost)[: self.kept]:
            good, near = list[Planned](), math.inf
            for local in reached[braces][:ALTERNATIVES]:
                if local.cost > near:
                    break
                plan = self._dense(braces, local)
                if isinstance(plan, str):
                    self.tally.refused.setdefault(braces, plan)
                else:
                    good.append(plan)
                    near = min(near, plan.heat)
            if good:
                planned.append(min(good, key=_heat))
                self.tally.refused.pop(braces, None)
        for braces in (braces for braces, some in paths.items() if some and braces not in reached):
            self.tally.refused[braces] = "no solution along the whole path, only single postures"
        planned.sort(key=_heat)
        least, finest = math.inf, list[Planned]()
        for plan in planned:
            # More knots hardly ever reduce the heat below the heat at the knots.
            finest.append(self.finest(plan) if plan.local.heat < least else plan)
            least = min(least, finest[-1].heat)
        return sorted(finest, key=_heat)

    def _dense(self, braces: BraceSet | BraceSchedule, local: Local) -> Planned | str:
        """Solve a whole path with twice the knots and its dense references, once; return the reason if this fails."""
        if (braces, local.cost) not in self._refinements:
            knots, plan = self.path, self._finer(braces, local, self._doubled(self.path))
            while (isinstance(plan, str) or plan.heat > BRANCHES * local.cost) and knots > self.path // 4:
                # Fewer knots are better if the postures of neighbouring knots are on different branches.
                fewer = self._finer(braces, local, knots)
                if not isinstance(fewer, str) and (isinstance(plan, str) or fewer.heat < plan.heat):
                    plan = fewer
                knots = (knots + 1) // 2
            self._refinements[braces, local.cost] = plan
        return self._refinements[braces, local.cost]

    def _dense_heat(self, path: tuple[Local, BraceSet]) -> float:
        """Return the heat of a path along its dense references [W]; inf if they are infeasible."""
        plan = self._dense(path[1], path[0])
        return math.inf if isinstance(plan, str) else plan.heat

    def _doubled(self, knots: int) -> int:
        """Return twice the number of knots of a path, without the end of a path that is not closed."""
        return 2 * knots - (self.task.kind != "closed")

    def _finer(self, braces: BraceSet | BraceSchedule, coarse: Local, count: int) -> Planned | str:
        """Solve a path with more knots and its dense references; if they are infeasible, return the reason as text."""
        local = self.solve(braces, coarse.Q, count, 20, FINAL_SLIP_SCALE) or coarse
        times = self.task.times(len(local.Q))
        dense = references(self.task, braces, times, local.Q)
        if isinstance(dense, str):
            return dense
        distance, bodies, when = self.task.nearest_pair(dense.times, dense.q)
        if distance < 0.0:
            return f"{bodies} touch each other at t = {when:.3g} s"
        return Planned(dense.schedule.braces, times, local, dense)

    def finest(self, plan: Planned) -> Planned:
        """Double the number of knots, until the dense references cost the same as the knots."""
        best = plan
        while not best.finest and not plan.converged and len(plan.times) < MOST_KNOTS:
            finer = self._finer(plan.dense.schedule, plan.local, self._doubled(len(plan.times)))
            if isinstance(finer, str):
                break
            plan = finer
            best = min(best, plan, key=_heat)
        return replace(best, finest=True)

    def clearer(self, plan: Planned, clearance_m: float) -> Planned | None:
        """Plan the same set again from its path with more clearance [m]; None if this was done or does not work."""
        if plan.clearer:
            return None
        again = Search(self.task.clearer(clearance_m))
        made = again._finer(plan.dense.schedule, plan.local, len(plan.times))
        return None if isinstance(made, str) else replace(again.finest(made), clearer=True)

    def continued(self, plan: Planned) -> Planned | None:
        """Return the plan of a similar problem, continued from its postures; None if this does not work.

        Plans whose braces change are not continued.
        """
        if plan.dense.schedule.borders:
            return None
        own = {(c.name, c.surface): c for c in self.task.candidates}
        braces = tuple(own[at] for brace in plan.braces if (at := (brace.name, brace.surface)) in own)
        if len(braces) < len(plan.braces):
            return None
        local = self.solve(braces, plan.local.Q, len(plan.times), 30, FINE_SLIP_SCALE)
        finer = None if local is None else self._finer(braces, local, len(plan.times))
        return None if isinstance(finer, str) else finer

    def _walked(self, braces: BraceSet, Q: Array, count: int) -> Local | None:
        """Solve a path knot by knot, starting from a posture in the middle; used if solving all knots at once fails."""
        whole = self.task.problem(braces, count)
        out = self._walk(whole, braces, np.atleast_2d(Q)[len(np.atleast_2d(Q)) // 2], count // 2)
        if out is None:
            return None
        self.tally.solves += 1
        return solve(whole, out, 30)

    def _walk(self, whole: Problem, braces: BraceSet | BraceSchedule, q: Array, start: int) -> Array | None:
        """Return postures at all knots, each projected from its neighbour, from posture q at knot ``start`` on."""
        course, single = whole.course, self.task.problem(braces, 1)
        out = np.zeros((len(course.target), self.task.arm.n))
        for knots in (range(start, len(out)), range(start, -1, -1)):
            row = reals(q)[None].copy()
            for k in knots:
                single.course.target[0], single.course.apart[0] = course.target[k], course.apart[k]
                single.course.guided[0] = course.guided[k]
                if single.retract(row, 60) > 1e-7:
                    return None
                out[k] = row[0]
        return out

    def _changing(
        self, paths: Mapping[BraceSet, list[PosturePath]], size: int
    ) -> dict[BraceSet | BraceSchedule, list[PosturePath]]:
        """Return paths with at most ``size`` braces at a time that change on the way, the best of each schedule.

        Segments of the path, with the best sets for one posture in their middle, are joined to schedules with borders
        between segments. Postures walk from the middles of the phases to all knots; the schedules with the least heat
        along these walks are optimised. Then borders move by one knot, as long as the cost decreases.
        """
        most, knots = self.task.options.phases[1], self.path
        if size == 0 or most < 2:
            return {}
        closed = self.task.kind == "closed"
        edges = np.linspace(0, knots - (not closed), SEGMENTS + 1).round().astype(int).tolist()
        middles = [(first + last) // 2 for first, last in pairwise(edges)]
        best = {braces: local for some in range(size + 1) for local, braces in self._best(paths, some)}
        profiles = {braces: self._profile(braces, local) for braces, local in best.items()}
        segments = []
        for middle in middles:
            postures = self._at(middle, size)
            for braces, local in best.items():
                k = round(middle * len(local.Q) / knots)
                heat = float(profiles[braces][min(middle, len(profiles[braces]) - 1)])
                if braces not in postures or heat < postures[braces][0]:
                    postures[braces] = heat, local.Q[k]
            ranked = sorted(postures.items(), key=lambda item: item[1][0])
            segments.append([(braces, q) for braces, (_, q) in ranked])
        walks = list[tuple[float, BraceSchedule, Array]]()
        for count in range(2, most + 1):
            for inner in combinations(range(1, SEGMENTS), count - 1):
                parts = list(pairwise((0, *inner, SEGMENTS)))
                borders = tuple(edges[k] / edges[-1] for k in inner)
                width = WIDEST if count == 2 else NARROW
                pools = [
                    {braces: (q, middles[m]) for m in range(*part) for braces, q in segments[m][:width]}
                    for part in parts
                ]
                for sets in product(*pools):
                    schedule = BraceSchedule(sets, borders)
                    if len(schedule) == size and self._changes(schedule):
                        starts = [pool[braces] for pool, braces in zip(pools, sets, strict=True)]
                        walks += self._walks(schedule, starts)
        walks.sort(key=lambda walk: walk[0])
        done = dict[BraceSchedule, PosturePath]()
        try:
            self._optimise(walks, done, edges[-1])
        except KeyboardInterrupt:
            interruption.answered()
            self.tally.ended = "interrupted"
        reached = {schedule: path.local for schedule, path in done.items() if path.local is not None}
        heats = [*profiles.values(), *(self._profile(schedule, local) for schedule, local in reached.items())]
        self.bounds[size] = float(np.mean(np.min(heats, axis=0))) if heats else math.nan
        return {schedule: [PosturePath(local.cost, local)] for schedule, local in reached.items()}

    def _optimise(
        self,
        walks: Sequence[tuple[float, BraceSchedule, Array]],
        done: dict[BraceSchedule, PosturePath],
        intervals: int,
    ) -> None:
        """Optimise the first schedules, then move the borders of the best; add all to ``done``."""
        for _, schedule, Q in walks[:OPTIMISED]:
            self._keep(done, schedule, Q)
        improved = True
        while improved:
            improved = False
            for schedule, path in sorted(done.items(), key=lambda item: item[1].coarse)[:KEPT]:
                for moved in self._moved(schedule, intervals):
                    if moved not in done and path.local is not None:
                        improved |= self._keep(done, moved, path.local.Q, path.coarse)

    def _changes(self, schedule: BraceSchedule) -> bool:
        """Return whether neighbouring phases have different sets and all phases have time for two hand-overs."""
        different = all(first != second for first, second in pairwise(schedule.sets))
        return different and all(p.end - p.start >= SHORTEST for p in self.task.phases(schedule))

    def _moved(self, schedule: BraceSchedule, intervals: int) -> list[BraceSchedule]:
        """Return the schedules with one border moved by one knot."""
        moved = []
        for k, border in enumerate(schedule.borders):
            for change in (-1, 1):
                borders = list(schedule.borders)
                borders[k] = (round(border * intervals) + change) / intervals
                other = BraceSchedule(schedule.sets, tuple(borders))
                if all(a < b for a, b in pairwise((0.0, *borders, 1.0))) and self._changes(other):
                    moved.append(other)
        return moved

    def _keep(
        self, done: dict[BraceSchedule, PosturePath], schedule: BraceSchedule, Q: Array, least: float = math.inf
    ) -> bool:
        """Optimise a schedule from postures at all knots, add it to ``done``; return whether it is below ``least``."""
        coarse = self.solve(schedule, Q, self.path)
        fine = None if coarse is None else self.solve(schedule, coarse.Q, self.path, 40, FINE_SLIP_SCALE)
        local = fine or coarse
        cost = math.inf if local is None else local.cost
        if schedule not in done or cost < done[schedule].coarse:
            done[schedule] = PosturePath(cost, local)
        return cost < (1.0 - SAME_COST) * least

    def _walks(
        self, schedule: BraceSchedule, starts: Sequence[tuple[Array, int]]
    ) -> list[tuple[float, BraceSchedule, Array]]:
        """Return the walk of least heat from postures at knots, with its heat [W]; empty if none reaches all knots."""
        whole, best = self.task.problem(schedule, self.path), list[tuple[float, BraceSchedule, Array]]()
        for q, start in starts:
            if (Q := self._walk(whole, schedule, q, start)) is not None:
                whole.freeze_inertia(Q)
                whole.forces(Q)
                best.append((whole.heat(), schedule, Q))
        return sorted(best, key=lambda walk: walk[0])[:1]

    def _profile(self, braces: BraceSet | BraceSchedule, local: Local) -> Array:
        """Return the heat between the knots of a whole path [W], at the number of intervals of all whole paths."""
        problem = self.task.problem(braces, len(local.Q), FINE_SLIP_SCALE)
        problem.freeze_inertia(local.Q)
        problem.forces(local.Q)
        heat, knot = problem.work.torque**2 @ self.task.arm.tables.heat, problem.course.knot
        means = np.array([heat[knot == k].mean() for k in np.unique(knot)])
        count = self.path - (self.task.kind != "closed")
        return np.asarray(means[np.arange(count) * len(means) // count])

    def _at(self, knot: int, size: int) -> dict[BraceSet, tuple[float, Array]]:
        """Return the sets of at most ``size`` braces that are best in one posture at a knot, with heat and posture."""
        target = self.task.problem((), self.path).course.target[knot]
        best: dict[BraceSet, tuple[float, Array]] = {}
        front: list[tuple[BraceSet, list[Array]]] = [((), self._starts(False, target))]
        for number in range(1, size + 1):
            cheap = self._cheap(self._sets(number, front), True, target)
            reached = sorted(
                ((local.cost, braces, local.Q[0]) for braces, local in cheap.items()), key=lambda item: item[0]
            )
            best |= {braces: (cost, q) for cost, braces, q in reached}
            front = [(braces, [q]) for _, braces, q in reached[:NEIGHBOURS]]
        return best


def _cost(local: Local) -> float:
    return local.cost


def _heat(plan: Planned) -> float:
    return plan.heat


def _fits(braces: Sequence[Candidate]) -> bool:
    """Return whether each point uses only one surface."""
    return len({brace.location for brace in braces}) == len(braces)


def _same(cost: float, other: float) -> bool:
    """Return whether two paths of a set have the same cost and therefore count as the same path."""
    return abs(cost - other) <= SAME_COST * other
