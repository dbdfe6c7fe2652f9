"""Search over sets of braces, which grow from the best smaller sets by one brace at a time.

For each number of braces, all sets are solved at one posture of the path without slip, then the best sets are solved at
a few knots with slip. The best of these are extended by one more brace. A set without a solution is "not found", not
"impossible", because the solver starts from postures of other sets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import reals
from dynsim.model.description import Array
from dynsim.planner.arm import Local, solve
from dynsim.planner.dense import Dense, references, touching_links
from dynsim.planner.problem import COARSE_SLIP_SCALE, FINAL_SLIP_SCALE, FINE_SLIP_SCALE, Candidate, Task

# Number of sets with the same number of braces that continue to the next stage and to the next number of braces.
BEAM = 3
# Number of start postures per round, and maximum number of random postures tried to find them.
POSTURES, DRAWS = 4, 60
# Range of the standard deviation of random joint angles [rad], and standard deviation of prismatic joints [m].
SPREAD, PRISMATIC_SPREAD = (0.3, 1.5), 0.2
# Number of sets of each size that are solved along the whole path in each round, and number of sets of each size that
# are refined at the end.
PATHS, KEPT = 4, 3
# Number of sets of each size whose neighbours are tried along the whole path.
NEIGHBOURS = 5
# Maximum ratio of a neighbour's cost to the least cost of all sets of its size.
PROMISING = 1.25
# Relative difference below which two costs of a set belong to the same path; maximum ratio of a path's cost to the
# least cost up to which the path is refined further; maximum number of refined paths per set.
SAME_COST, NEAR, ALTERNATIVES = 1e-3, 1.1, 6
# Number of knots of closed paths and of other whole paths. The number of knots is doubled up to the third number for
# the sets that are kept, and up to the fourth for the best set, or until the dense references cost less than the last
# factor times the cost at the knots.
CLOSED_KNOTS, PATH_KNOTS, FINE_KNOTS, MOST_KNOTS, CONVERGED = 24, 17, 30, 60, 1.01

Set = tuple[Candidate, ...]
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Planned:
    """Set of braces with its best postures along the whole path."""

    braces: Set
    times: Array
    local: Local
    dense: Dense

    @property
    def heat(self) -> float:
        """Mean heat along the dense references [W]."""
        return self.dense.heat


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
        Best heat of each round along the path, at the knots [W], by number of braces; inf if no path was found.
    refused : dict
        Rejected sets, each with the reason.
    """

    solves: int = 0
    drawn: int = 0
    drawn_on: int = 0
    reached: set[Set] = field(default_factory=set)
    missed: set[Set] = field(default_factory=set)
    heats: dict[int, list[float]] = field(default_factory=dict)
    refused: dict[Set, str] = field(default_factory=dict)


class Search:
    """Search over brace sets for one task."""

    def __init__(self, task: Task, tell: Tell | None = None) -> None:
        self.task, self.tally, self.kept = task, Tally(), KEPT
        self._tell = tell or (lambda text, share: None)
        self.single_heats: dict[Set, float] = {}
        # Least heat of a whole path at its knots [W] over rounds and exchanges, by number of braces.
        self.least_heat: dict[int, float] = {}
        self._rng = np.random.default_rng(task.options.seed)
        self.coarse = 4 if task.kind == "closed" else 3
        self.path = CLOSED_KNOTS if task.kind == "closed" else PATH_KNOTS

    def solve(
        self, braces: Set, start: Array, count: int, turns: int = 40, slip_scale: float = COARSE_SLIP_SCALE
    ) -> Local | None:
        """Find the local optimum, starting from postures at other knots or from one posture."""
        self.tally.solves += 1
        return solve(self.task.problem(braces, count, slip_scale), self.spread(start, count), turns)

    def spread(self, start: Array, count: int) -> Array:
        """Interpolate postures, shape (n,) or (K, n), linearly at ``count`` knots."""
        known = np.atleast_2d(start)
        if len(known) == 1 or count == 1:
            return reals(np.tile(known[len(known) // 2], (count, 1)))
        times, wanted = self.task.times(len(known)), self.task.times(count)
        if self.task.kind == "closed":
            times, known = np.append(times, self.task.span), np.vstack([known, known[:1]])
        return reals(np.stack([np.interp(wanted, times, column) for column in known.T], axis=1))

    def _starts(self, first: bool) -> list[Array]:
        """Return random postures that are clear of all surfaces, with the hand at the middle of the path.

        The first round also tries the initial posture.
        """
        problem, postures = self.task.problem((), 1), list[Array]()
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
        """Run the search and return the best sets of each size, sorted by heat along their dense references.

        The list of a size may be empty. Rounds are independent searches from different postures. The number of rounds
        that agree is the only indication of how close the result is to the optimum.
        """
        least, most = self.task.options.count
        paths: dict[Set, list[PosturePath]] = {}
        rounds = self.task.options.starts
        for number in range(rounds):
            self._tell("searching", number / (rounds + 1))
            for size, ranked in self._round(number, most).items():
                heats = [self._path(paths.setdefault(item[1], []), *item) for item in ranked[:PATHS]]
                self.tally.heats.setdefault(size, []).append(min(heats, default=math.inf))
        self._exchange(paths, most)
        for size in range(most + 1):
            self.least_heat[size] = min((local.heat for local, _ in self._best(paths, size)), default=math.inf)
        planned: dict[int, list[Planned]] = {}
        for size in range(least, most + 1):
            self._tell("refining", (rounds + size / (most + 1)) / (rounds + 1))
            planned[size] = self._refined({braces: some for braces, some in paths.items() if len(braces) == size})
        return planned

    def _path(self, known: list[PosturePath], cost: float, braces: Set, Q: Array) -> float:
        """Solve a whole path from postures at few knots, add it to the known paths of its set, and return its heat [W].

        Nearly equal costs at few knots belong to the same path. A path whose cost is far above the least cost is
        ignored (inf).
        """
        if cost > NEAR * min((path.coarse for path in known), default=math.inf):
            return math.inf
        for path in known:
            if _same(path.coarse, cost):
                return math.inf if path.local is None else path.local.heat
        local = self._whole(braces, Q)
        known.append(PosturePath(cost, local))
        return math.inf if local is None else local.heat

    def _exchange(self, paths: dict[Set, list[PosturePath]], most: int) -> None:
        """Solve whole paths for the neighbours of the best sets, with one brace less or more, until no new sets remain.

        This is useful because the ranking of sets along the path differs from their ranking at few knots, and because
        few sets are close to a random posture.
        """
        changes = [*((size, -1) for size in range(most, 1, -1)), *((size, 1) for size in range(most))]
        changed, going_on = set[tuple[Set, int, float]](), True
        while going_on:
            going_on = False
            for size, change in changes:
                least = min((local.cost for local, _ in self._best(paths, size + change)), default=math.inf)
                for near, braces in self._best(paths, size)[:NEIGHBOURS]:
                    if (braces, change, near.cost) in changed:
                        continue
                    changed.add((braces, change, near.cost))
                    going_on = True
                    for other in self._grown(braces) if change > 0 else combinations(braces, size - 1):
                        local, known = self._whole(other, near.Q, PROMISING * least), paths.setdefault(other, [])
                        if local is not None and not any(_same(path.coarse, local.cost) for path in known):
                            known.append(PosturePath(local.cost, local))
                            least = min(least, local.cost)

    def _best(self, paths: Mapping[Set, list[PosturePath]], size: int) -> list[tuple[Local, Set]]:
        """Return the best path of each set with ``size`` braces, sorted by cost."""
        best = [
            (min((path.local for path in some if path.local is not None), key=_cost), braces)
            for braces, some in paths.items()
            if len(braces) == size and any(path.local is not None for path in some)
        ]
        return sorted(best, key=lambda item: item[0].cost)

    def _round(self, number: int, most: int) -> dict[int, list[tuple[float, Set, Array]]]:
        """Search from new start postures; return the sets of each size with cost and posture, sorted by cost."""
        starts = self._starts(first=number == 0)
        best: dict[int, list[tuple[float, Set, Array]]] = {}
        unbraced = [r for q in starts if (r := self.solve((), q, 1)) is not None]
        if not unbraced:
            return best
        unbraced.sort(key=_cost)
        best[0] = [(r.cost, (), r.Q) for r in unbraced]
        front: list[tuple[Set, list[Array]]] = [((), [*starts, unbraced[0].Q])]
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

    def _cheap(self, sets: Mapping[Set, list[Array]], best: bool) -> dict[Set, Local]:
        """Solve sets at one posture without slip from start postures; keep the best or a random solution of each."""
        reached: dict[Set, Local] = {}
        for braces, postures in sets.items():
            tried = [r for q in postures if (r := self.solve(braces, q, 1, 25)) is not None]
            if tried:
                chosen = min(tried, key=_cost) if best else tried[self._rng.integers(len(tried))]
                reached[braces] = chosen
                self.tally.missed.discard(braces)
                if len(braces) == 1:
                    self.single_heats[braces] = min(reached[braces].heat, self.single_heats.get(braces, math.inf))
                self.tally.reached.add(braces)
            elif braces not in self.tally.reached:
                self.tally.missed.add(braces)
        return reached

    def _slipping(self, cheap: Mapping[Set, Local], count: int) -> list[tuple[float, Set, Array]]:
        """Solve the best ``count`` sets at few knots with slip; return them sorted by cost."""
        ranked = sorted(cheap.items(), key=lambda item: item[1].cost)[:count]
        solved = [
            (r.cost, braces, r.Q)
            for braces, local in ranked
            if (r := self.solve(braces, local.Q, self.coarse, 30)) is not None
        ]
        return sorted(solved, key=lambda item: item[0])

    def _grown(self, braces: Set) -> list[Set]:
        """Return the sets with one more brace."""
        sets = [
            tuple(brace for brace in self.task.candidates if brace in braces or brace == new)
            for new in self.task.candidates
            if new not in braces
        ]
        return [grown for grown in sets if _fits(grown)]

    def _swaps(self, braces: Set) -> list[Set]:
        """Return the sets with one brace exchanged for another candidate."""
        left = combinations(braces, len(braces) - 1)
        return list(dict.fromkeys(grown for some in left for grown in self._grown(some) if grown != braces))

    def _sets(self, size: int, front: Sequence[tuple[Set, list[Array]]]) -> dict[Set, list[Array]]:
        """Return the sets that grow from smaller sets, with start postures."""
        sets: dict[Set, list[Array]] = {}
        if self.task.options.exhaustive:
            for chosen in combinations(self.task.candidates, size):
                if _fits(chosen):
                    sets[chosen] = [Q for _, postures in front for Q in postures][: 2 * BEAM]
            return sets
        for braces, postures in front:
            for grown in self._grown(braces):
                sets.setdefault(grown, []).extend(postures)
        return sets

    def _whole(self, braces: Set, Q: Array, most: float = math.inf) -> Local | None:
        """Solve a whole path from postures at few knots, first with smooth friction, which has fewer local optima.

        Returns None if there is no path, or if its cost with smooth friction exceeds ``most`` [W].
        """
        half = (self.path + 1) // 2
        local = self.solve(braces, Q, half, 30) or self._walked(braces, Q, half)
        if local is None or local.cost > most:
            return None
        return self.solve(braces, local.Q, self.path, 30, FINE_SLIP_SCALE) or local

    def _refined(self, paths: Mapping[Set, list[PosturePath]]) -> list[Planned]:
        """Refine the best paths of the best sets with more knots; return them sorted by heat along dense references."""
        whole = {braces: sorted((p.local for p in some if p.local), key=_cost) for braces, some in paths.items()}
        reached = {braces: some for braces, some in whole.items() if some}
        planned = []
        for braces in sorted(reached, key=lambda braces: reached[braces][0].cost)[: self.kept]:
            good, near = list[Planned](), math.inf
            for local in reached[braces][: 2 * ALTERNATIVES]:
                if len(good) == ALTERNATIVES or local.cost > near:
                    break
                plan = self._finer(braces, local, self.path)
                if isinstance(plan, str):
                    self.tally.refused.setdefault(braces, plan)
                else:
                    good.append(plan)
                    near = min(near, NEAR * plan.heat)
            if good:
                planned.append(self._finest(min(good, key=lambda plan: plan.heat), FINE_KNOTS))
                self.tally.refused.pop(braces, None)
        for braces in (braces for braces, some in paths.items() if some and braces not in reached):
            self.tally.refused[braces] = "no solution along the whole path, only single postures"
        planned.sort(key=lambda plan: plan.heat)
        return [self._finest(plan, MOST_KNOTS) for plan in planned[:1]] + planned[1:]

    def _finer(self, braces: Set, coarse: Local, count: int) -> Planned | str:
        """Solve a path with more knots and its dense references; if they are infeasible, return the reason as text."""
        local = self.solve(braces, coarse.Q, count, 20, FINAL_SLIP_SCALE) or coarse
        times = self.task.times(len(local.Q))
        dense = references(self.task, braces, times, local.Q)
        if isinstance(dense, str):
            return dense
        return touching_links(self.task, dense.times, dense.q) or Planned(braces, times, local, dense)

    def _finest(self, plan: Planned, most: int) -> Planned:
        """Double the number of knots, up to ``most``, until the dense references cost the same as the knots."""
        while plan.heat > CONVERGED * plan.local.heat and len(plan.times) < most:
            finer = self._finer(plan.braces, plan.local, 2 * len(plan.times) - (self.task.kind != "closed"))
            if isinstance(finer, str) or finer.heat >= plan.heat:
                break
            plan = finer
        return plan

    def _walked(self, braces: Set, Q: Array, count: int) -> Local | None:
        """Solve a path knot by knot, starting from a posture in the middle; used if solving all knots at once fails."""
        whole = self.task.problem(braces, count)
        targets, middle = whole.course.target, count // 2
        single = self.task.problem(braces, 1)
        out = np.zeros((count, self.task.arm.n))
        for knots in (range(middle, count), range(middle, -1, -1)):
            q = reals(np.atleast_2d(Q)[len(np.atleast_2d(Q)) // 2])[None]
            for k in knots:
                single.course.target[0] = targets[k]
                if single.retract(q, 60) > 1e-7:
                    return None
                out[k] = q[0]
        self.tally.solves += 1
        return solve(whole, out, 30)


def _cost(local: Local) -> float:
    return local.cost


def _fits(braces: Sequence[Candidate]) -> bool:
    """Return whether each point uses only one surface."""
    return len({brace.location for brace in braces}) == len(braces)


def _same(cost: float, other: float) -> bool:
    """Return whether two paths of a set have the same cost and therefore count as the same path."""
    return abs(cost - other) <= SAME_COST * other
