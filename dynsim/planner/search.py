"""Search over sets of braces, grown one brace at a time from the best smaller sets.

For each number of braces, sets are solved at one posture of the path without slip, the best of them at a few knots with
slip; the best of these get one more brace. A set without a solution is "not found", not "impossible": the solver starts
from postures of other sets.
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

# Sets of each size that go on from the cheap problem, and from the one with slip.
BEAM = 3
# Postures that a round begins with, and random ones that are tried for them.
POSTURES, DRAWS = 4, 60
# Standard deviation of their joints, drawn from so much to so much [rad]; of prismatic ones [m].
SPREAD, PRISMATIC_SPREAD = (0.3, 1.5), 0.2
# Sets of each size and round that whole paths are made for, and those that are made finer in the end.
PATHS, KEPT = 4, 3
# Sets of each size whose neighbours are tried along the whole path.
NEIGHBOURS = 5
# Beyond that ratio to the least cost of its size a neighbour is not followed.
PROMISING = 1.25
# Costs of one set that differ by less, as a share, are of one path, and paths beyond that ratio to the least are none
# that could become the best; so many of a set are made finer.
SAME_COST, NEAR, ALTERNATIVES = 1e-3, 1.1, 6
# Knots of whole paths, of closed ones and others; those of sets that are kept, and of the best, are doubled until there
# are about so many, or dense references cost as much as the knots but for this factor.
CLOSED_KNOTS, PATH_KNOTS, FINE_KNOTS, MOST_KNOTS, CONVERGED = 24, 17, 30, 60, 1.01

Set = tuple[Candidate, ...]
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Planned:
    """A set of braces with the best postures found for it along the whole path."""

    braces: Set
    times: Array
    local: Local
    dense: Dense

    @property
    def heat(self) -> float:
        """Along the dense references [W]."""
        return self.dense.heat


class PosturePath(NamedTuple):
    """Postures of a set at few knots, by their cost [W], and along the whole path: None, they do not reach."""

    coarse: float
    local: Local | None


@dataclass
class Tally:
    """What a search has done.

    Attributes
    ----------
    solves : local problems solved
    drawn, drawn_on : random postures tried, and those that could be put onto the path
    reached, missed : sets for which a posture was found, and those for which none was
    heats : by size, the best heat of each round along the path [W], by the knots; inf: none
    refused : sets that have a path, and why they are none of the answer
    """

    solves: int = 0
    drawn: int = 0
    drawn_on: int = 0
    reached: set[Set] = field(default_factory=set)
    missed: set[Set] = field(default_factory=set)
    heats: dict[int, list[float]] = field(default_factory=dict)
    refused: dict[Set, str] = field(default_factory=dict)


class Search:
    """A search with its problems, which are made once for each set."""

    def __init__(self, task: Task, tell: Tell | None = None) -> None:
        self.task, self.tally, self.kept = task, Tally(), KEPT
        self._tell = tell or (lambda text, share: None)
        self.single_heats: dict[Set, float] = {}
        # By size, the least heat of a whole path by its knots [W], of rounds and exchanges.
        self.least: dict[int, float] = {}
        self._rng = np.random.default_rng(task.options.seed)
        self.coarse = 4 if task.kind == "closed" else 3
        self.path = CLOSED_KNOTS if task.kind == "closed" else PATH_KNOTS

    def solve(
        self, braces: Set, start: Array, count: int, turns: int = 40, slip_scale: float = COARSE_SLIP_SCALE
    ) -> Local | None:
        """Local optimum from postures at other knots, or from one posture."""
        self.tally.solves += 1
        return solve(self.task.problem(braces, count, slip_scale), self.spread(start, count), turns)

    def spread(self, start: Array, count: int) -> Array:
        """Postures at so many knots, on lines between those given at others; (n,) or (K, n)."""
        known = np.atleast_2d(start)
        if len(known) == 1 or count == 1:
            return reals(np.tile(known[len(known) // 2], (count, 1)))
        times, wanted = self.task.times(len(known)), self.task.times(count)
        if self.task.kind == "closed":
            times, known = np.append(times, self.task.span), np.vstack([known, known[:1]])
        return reals(np.stack([np.interp(wanted, times, column) for column in known.T], axis=1))

    def _starts(self, first: bool) -> list[Array]:
        """Random postures with the hand in the middle of the path, clear of all surfaces; the initial one too."""
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
        """A random posture about the initial one, sometimes near it and sometimes far."""
        tables, rng = self.task.arm.tables, self._rng
        initial = self.task.arm.model.robot.initial[list(self.task.arm.columns)]
        spread = np.where(tables.prismatic, PRISMATIC_SPREAD, rng.uniform(*SPREAD))
        return np.clip(initial + spread * rng.normal(size=len(spread)), tables.lower, tables.upper)

    def never_clear(self) -> list[str]:
        """Points that come nearer to a surface than their clearance in each of some random postures."""
        problem, greatest = self.task.problem((), 1), np.full(len(self.task.clear), -np.inf)
        for _ in range(DRAWS):
            problem.evaluate(reals(self.draw())[None], np.zeros((1, 0)))
            greatest = np.maximum(greatest, problem.work.gap[0])
        points = self.task.clear.values()
        return [point.label for point, gap in zip(points, greatest, strict=True) if gap < point.margin]

    def run(self) -> dict[int, list[Planned]]:
        """The best sets of each size with whole paths, by heat along their dense references; sizes may be empty.

        Rounds are independent searches, each from postures of its own: how often they agree is what can be said of
        the distance to the optimum.
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
            self.least[size] = min((local.heat for local, _ in self._best(paths, size)), default=math.inf)
        planned: dict[int, list[Planned]] = {}
        for size in range(least, most + 1):
            self._tell("refining", (rounds + size / (most + 1)) / (rounds + 1))
            planned[size] = self._refined({braces: some for braces, some in paths.items() if len(braces) == size})
        return planned

    def _path(self, known: list[PosturePath], cost: float, braces: Set, Q: Array) -> float:
        """Heat of a whole path from postures at few knots [W], which is put among those known of its set.

        Costs of few knots that are nearly the same belong to one path; those that are far from the least to none.
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
        """Whole paths of the sets that the best ones become by a brace less, or by one more, until these are known.

        Along the path sets rank otherwise than at few knots, and few of them are near a posture that was drawn.
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
        """The best path of each set of a size, the best first."""
        best = [
            (min((path.local for path in some if path.local is not None), key=_cost), braces)
            for braces, some in paths.items()
            if len(braces) == size and any(path.local is not None for path in some)
        ]
        return sorted(best, key=lambda item: item[0].cost)

    def _round(self, number: int, most: int) -> dict[int, list[tuple[float, Set, Array]]]:
        """Sets of each size with cost and posture, the best first, from new starts."""
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
            # Sets that a brace more leads along the path may have none there of their own.
            front = [(braces, [Q[len(Q) // 2]]) for _, braces, Q in best[size]] or [
                (braces, [cheap[braces].Q]) for braces in sorted(cheap, key=lambda braces: cheap[braces].cost)[:BEAM]
            ]
        return best

    def _cheap(self, sets: Mapping[Set, list[Array]], best: bool) -> dict[Set, Local]:
        """Sets at one posture without slip, from postures: the best that these lead to, or any."""
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
        """The best of them at few knots with slip, the best first."""
        ranked = sorted(cheap.items(), key=lambda item: item[1].cost)[:count]
        solved = [
            (r.cost, braces, r.Q)
            for braces, local in ranked
            if (r := self.solve(braces, local.Q, self.coarse, 30)) is not None
        ]
        return sorted(solved, key=lambda item: item[0])

    def _grown(self, braces: Set) -> list[Set]:
        """Sets with one brace more."""
        sets = [
            tuple(brace for brace in self.task.candidates if brace in braces or brace == new)
            for new in self.task.candidates
            if new not in braces
        ]
        return [grown for grown in sets if _fits(grown)]

    def _swaps(self, braces: Set) -> list[Set]:
        """Sets with one brace exchanged for another candidate."""
        left = combinations(braces, len(braces) - 1)
        return list(dict.fromkeys(grown for some in left for grown in self._grown(some) if grown != braces))

    def _sets(self, size: int, front: Sequence[tuple[Set, list[Array]]]) -> dict[Set, list[Array]]:
        """Sets that grow from smaller ones, with postures to start from."""
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
        """A whole path from postures at few knots, first with blunt friction, past where sharp friction would stop.

        None too where it costs more than ``most`` there [W].
        """
        half = (self.path + 1) // 2
        local = self.solve(braces, Q, half, 30) or self._walked(braces, Q, half)
        if local is None or local.cost > most:
            return None
        return self.solve(braces, local.Q, self.path, 30, FINE_SLIP_SCALE) or local

    def _refined(self, paths: Mapping[Set, list[PosturePath]]) -> list[Planned]:
        """The best sets, their best paths at more knots, by the heat of their dense references."""
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
            self.tally.refused[braces] = "postures found, but none along the whole path"
        planned.sort(key=lambda plan: plan.heat)
        return [self._finest(plan, MOST_KNOTS) for plan in planned[:1]] + planned[1:]

    def _finer(self, braces: Set, coarse: Local, count: int) -> Planned | str:
        """A path at more knots with its dense references; in words why hand and surfaces are not kept between them."""
        local = self.solve(braces, coarse.Q, count, 20, FINAL_SLIP_SCALE) or coarse
        times = self.task.times(len(local.Q))
        dense = references(self.task, braces, times, local.Q)
        if isinstance(dense, str):
            return dense
        return touching_links(self.task, dense.times, dense.q) or Planned(braces, times, local, dense)

    def _finest(self, plan: Planned, most: int) -> Planned:
        """Twice the knots until the dense references cost what the knots do, or there are ``most`` of them."""
        while plan.heat > CONVERGED * plan.local.heat and len(plan.times) < most:
            finer = self._finer(plan.braces, plan.local, 2 * len(plan.times) - (self.task.kind != "closed"))
            if isinstance(finer, str) or finer.heat >= plan.heat:
                break
            plan = finer
        return plan

    def _walked(self, braces: Set, Q: Array, count: int) -> Local | None:
        """A path from a posture in its middle, knot after knot: where all at once does not reach."""
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
    """Whether each point leans on one surface only."""
    return len({brace.location for brace in braces}) == len(braces)


def _same(cost: float, other: float) -> bool:
    """Whether two paths of one set are the same, by their costs."""
    return abs(cost - other) <= SAME_COST * other
