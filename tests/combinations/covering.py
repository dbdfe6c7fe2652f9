"""Few assignments of levels that contain each allowed pair, or triple, of levels; and random assignments.

A combination of levels counts separately for adaptive methods and for time stepping: if both support it, each has a
scene with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from combinations.factors import FACTORS, METHOD, REFUSALS, methods

# Candidate assignments for each accepted one, and how often a level is tried if assignments are refused.
CANDIDATES, ATTEMPTS = 10, 200
# One method for each kind with different refused features.
KINDS = ("dopri5", "time_stepping")

LEVELS = [(factor, level) for factor, levels in FACTORS.items() for level in levels]
NUMBER = {pair: k for k, pair in enumerate(LEVELS)}
CHOICES = [[NUMBER[factor, level] for level in levels] for factor, levels in FACTORS.items()]


class _Law:
    """Refusals of a kind of methods: a refusal applies if all its factors have one of its levels."""

    def __init__(self, method: str) -> None:
        kept = [r for r in REFUSALS if r.holds_for(method)]
        self._hit = np.zeros((len(kept), len(LEVELS)), dtype=np.int64)
        self._full = np.zeros(len(kept), dtype=np.int64)
        for row, refusal in zip(range(len(kept)), kept, strict=True):
            for factor, refused in refusal.levels:
                if factor != METHOD:
                    self._full[row] += 1
                    self._hit[row, [NUMBER[factor, level] for level in refused]] = 1

    def allows(self, chosen: Sequence[int]) -> bool:
        """Whether levels, at most one for each factor, can be combined."""
        return bool((self._hit[:, list(chosen)].sum(axis=1) < self._full).all())

    def open(self, chosen: Sequence[int], choices: Sequence[int]) -> list[int]:
        """Return the choices that can be added."""
        before = self._hit[:, list(chosen)].sum(axis=1)
        free = (before[:, None] + self._hit[:, list(choices)] < self._full[:, None]).all(axis=0)
        return [level for level, good in zip(choices, free.tolist(), strict=True) if good]


@cache
def _law(method: str) -> _Law:
    return _Law(method)


@cache
def pairs(seed: int) -> list[dict[str, str]]:
    """Return assignments that contain every allowed pair of levels of different factors."""
    return _covering(seed, 2)


@cache
def triples(seed: int) -> list[dict[str, str]]:
    """Return assignments that contain every allowed triple."""
    return _covering(seed, 3)


def draw(seed: int, number: int) -> dict[str, str]:
    """Return a random assignment by its number: always the same, in any order.

    The last factor is drawn after the others, which are thus the same as before it was added.
    """
    random = np.random.default_rng([seed, number])
    kind = KINDS[int(random.integers(len(KINDS)))]
    for _ in range(ATTEMPTS):
        levels = _filled(random, _law(kind), [], CHOICES[:-1])
        if levels is not None:
            return _named([*levels, int(random.choice(_law(kind).open(levels, CHOICES[-1])))])
    raise AssertionError("nearly all assignments are refused")


@cache
def allowed(size: int, method: str) -> NDArray[np.bool_]:
    """Return a mask of the combinations of ``size`` levels, in ascending order, that a method supports."""
    law = _law(method)
    taken = np.zeros((len(LEVELS),) * size, dtype=bool)
    for numbers in _combinations(size):
        taken[numbers] = law.allows(numbers)
    return taken


def refused_share() -> float:
    """Return the fraction of pairs that no method supports."""
    taken = np.logical_or.reduce([allowed(2, kind) for kind in KINDS])
    return 1.0 - taken.sum() / len(_combinations(2))


@cache
def _combinations(size: int) -> list[tuple[int, ...]]:
    from itertools import combinations, product

    return [numbers for chosen in combinations(CHOICES, size) for numbers in product(*chosen)]


def _covering(seed: int, size: int) -> list[dict[str, str]]:
    """Search greedily: of some random assignments with a missing combination, choose the one with most of them."""
    random = np.random.default_rng([seed, size])
    missing = {kind: allowed(size, kind).copy() for kind in KINDS}
    taken: list[dict[str, str]] = []
    for kind in KINDS:
        law, lacks = _law(kind), missing[kind]
        while True:
            left = np.argwhere(lacks)
            if not len(left):
                break
            wanted = left[int(random.integers(len(left)))].tolist()
            drawn = [
                levels for _ in range(CANDIDATES) if (levels := _filled(random, law, wanted, lacks=lacks)) is not None
            ]
            for _ in range(ATTEMPTS):
                if drawn:
                    break
                drawn = [levels for levels in [_filled(random, law, wanted)] if levels is not None]
            if not drawn:
                # No whole assignment has it: its levels are incompatible through a third factor.
                lacks[tuple(wanted)] = False
                continue
            best = max(drawn, key=lambda levels: int(lacks[np.ix_(*[levels] * size)].sum()))
            levels = _named(best)
            for other in KINDS:
                if other in methods(levels):
                    missing[other][np.ix_(*[best] * size)] = False
            taken.append(levels)
    return taken


def _named(chosen: Sequence[int]) -> dict[str, str]:
    return {factor: next(LEVELS[k][1] for k in chosen if LEVELS[k][0] == factor) for factor in FACTORS}


def _filled(
    random: Generator,
    law: _Law,
    wanted: Sequence[int],
    choices_of: Sequence[Sequence[int]] = CHOICES,
    lacks: NDArray[np.bool_] | None = None,
) -> list[int] | None:
    """Complete some levels to an assignment, preferring levels with many missing combinations; None if impossible."""
    chosen = list(wanted)
    there = {LEVELS[k][0] for k in chosen}
    left = [choices for choices in choices_of if LEVELS[choices[0]][0] not in there]
    for index in random.permutation(len(left)).tolist():
        choices = law.open(chosen, left[index])
        if not choices:
            return None
        choices = random.permutation(choices).tolist()
        if lacks is None:
            chosen.append(choices[0])
            continue
        gains = []
        for level in choices:
            both = lacks[level] | np.moveaxis(lacks, -1, 0)[level]
            if lacks.ndim == 3:
                both = both | lacks[:, level]
            gains.append(int(both[np.ix_(*[chosen] * (lacks.ndim - 1))].sum()) if chosen else 0)
        chosen.append(choices[int(np.argmax(gains))])
    return sorted(chosen)
