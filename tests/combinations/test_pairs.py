"""Every feature with every other: scenes that contain each pair of levels run, and their records pass all checks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from combinations import covering, study
from combinations.covering import LEVELS, NUMBER, allowed, draw, pairs, refused_share
from combinations.factors import FACTORS, METHOD, REFUSALS, Refusal, matches, methods
from combinations.known import KNOWN, KNOWN_SEED
from combinations.running import M_STAR
from combinations.scenes import Scene, scene
from dynsim.engine.prepare import prepare
from dynsim.errors import DynsimError

SEED = 1
# Number of scenes of its cover, which takes seconds to find: this constant avoids the search at test collection.
PAIRS = 190
# Scenes of the default tests: the first of the cover that share their programs with other tests.
FEW = 30
# Scenes among these that the default tests run: the remaining scenes take seconds.
QUICK = {1, 2, 3, 4, 5, 6, 7, 8, 11}
# Scenes of other seeds that were wrong once: (seed, number).
FOUND = {
    "an equilibrium of a floating robot that moved without a warning": (271127, 188),
    "a joint at rest whose row nearly depended on those of an elbow: 25 kN held a motion": (271127, 108),
    "an elbow that began to slip, and events of other joints that stopped it each time": (271127, 335),
    "a search for forces that ended at the apex of a cone: friction of a joint nine times its bound": (271127, 384),
    "a joint that dipped beyond its stop within a step": (271127, 433),
    "a joint that hit its stop and left it at once, of which no event told": (271127, 454),
    "a joint at rest that shared a load with another one at its bound: 25 000 events in a millisecond": (271127, 343),
    "a warning of a state at the end of a refused step": (271127, 944),
    "impacts without the viscous part of friction, by the methods with events": (271127, 754),
    "velocity products of an impact that were extrapolated into the next step of time stepping": (271127, 881),
    "a joint that broke loose by itself, and other forces that jumped for the sign of a rounding": (271127, 900),
    "what settled after a landing turned a joint round, and its friction drove it": (271127, 995),
    "a joint that slid slowly and was stopped where another slip began, and others with it": (271127, 796),
    "an equilibrium that moved without a warning, because its rates were 1e-43": (271127, 1218),
    "two joints that hit each other off their stops for ever": (271127, 404),
    "an impact with two solutions, between which rounding chose": (271127, 1994),
    "a landing of time stepping that made energy by restitution and friction": (271127, 1228),
    "a force of least norm beyond the cone of a point that slid slowly": (271127, 1368),
    "a direction of slip that stayed frozen until the event at the end of the step": (271127, 2008),
    "accelerations that did not follow a new split of forces of nearly dependent rows": (271127, 1344),
    "a point that left and came down below its surface with another, and landed for ever": (271127, 1392),
    "two points that left in turns at one instant": (271127, 1894),
    "a joint at rest that got a row which nearly depended on those of feet and an elbow": (271127, 1485),
    "a joint at rest, an elbow that rolled off a crest, and rows that came to contradict each other": (271127, 1801),
    "a joint with a small share in rows that came to contradict each other as an elbow rolled": (271127, 2570),
    "a joint at rest, an elbow that rolled off a flat spot, and rows whose rates came to contradict each other first": (
        271127,
        3370,
    ),
    "an equilibrium on compliant wheels and feet that first had to deflect their tangents": (271127, 1548),
    "the same of an elbow in a pipe, whose tangents have little mobility": (271127, 2413),
    "joints at rest whose rows nearly depended on those of two points by rounding alone, by the dense solver": (
        271127,
        2728,
    ),
    "a joint at rest in a corner of the admissible forces: no split with the same motion had a margin": (271127, 1534),
    "joints at rest between contacts whose gaps contradicted each other from the landing on, let go for ever": (
        271127,
        4945,
    ),
    "a point beyond its static friction that hardly accelerated, and was held and broke loose for ever": (271127, 3158),
    "an equilibrium whose forces torque motors do not determine, so that each posture had others": (271127, 4859),
    "an equilibrium that had another share of forces with and without a point that only touches": (271127, 4749),
    "an arm between a rigid and a compliant brace, which an equilibrium turned until neither touched": (271127, 4663),
    "an elbow that slid slowly and took another direction of friction with each choice of modes": (271127, 3363),
    "a foot that began to slip with slip across it left, which turned its friction, and a joint driven back by it": (
        271127,
        4687,
    ),
    "a joint that turned round twice within a step, and was driven by its friction between": (271127, 7047),
    "an elbow that slid back and forth within a step, and was driven by its friction between": (271127, 5698),
    "a run that stopped in its first step, and an elbow that was said never to press in it": (271127, 5761),
    "friction of slow slip that left the surface as its normal turned within a step": (271127, 5589),
    "a paradox at the start, of which check knew nothing": (271127, 5731),
    "a last step of time stepping that ended with the run, which the checks took for a whole one": (271127, 7761),
    "a wheel that turned as its slip ended within a step, and was driven by its friction": (271127, 6350),
    "an equilibrium that pressed a spring against rigid links, which moved joints by a million": (271127, 8322),
    "an equilibrium that kept the displacement for a hand which opened on the way": (271127, 6126),
    "an equilibrium that lifts an elbow off its surface while feet are pressed in": (271127, 13119),
    "an equilibrium with an operator whose target moves from the first tick on": (271127, 6313),
    "a point that an impact left leaving slowly, kept on its surface where no forces could keep it": (271127, 5193),
    "no forces at feet and a root of which some slide, where an iteration diverged to NaN": (271127, 8213),
    "a glued elbow in a violent motion, whose friction turns faster at the stop than in the last sample": (
        271127,
        4746,
    ),
    "a glued arm that friction of pulling contacts drives to infinite rates": (271127, 6321),
    "the same, with motors": (271127, 7037),
    "a split of forces of nearly dependent rows that turned a joint at rest": (271127, 6947),
    "two points in the paradox, beside an object on four others": (271127, 7921),
}
# Scenes of the slow study.
TRIPLES = 1000
# Levels with which a few refused levels are completed to a whole scene.
TRIES = 2000


def test_the_cover_has_so_many_scenes() -> None:
    assert len(pairs(SEED)) == PAIRS


@pytest.mark.parametrize("seed", [SEED, pytest.param(2, marks=pytest.mark.long)])
def test_every_pair_that_is_not_refused_is_held_by_a_scene_of_each_kind_of_method(seed: int) -> None:
    cover = pairs(seed)
    for method in ("dopri5", "time_stepping"):
        held = np.zeros((len(LEVELS),) * 2, dtype=bool)
        for levels in cover:
            if method in methods(levels):
                numbers = sorted(NUMBER[factor, levels[factor]] for factor in FACTORS)
                held[np.ix_(numbers, numbers)] = True
        lacking = [
            (LEVELS[a], LEVELS[b])
            for a, b in np.argwhere(allowed(2, method) & ~held).tolist()
            if _possible(dict([LEVELS[a], LEVELS[b]]), method)
        ]
        assert not lacking


def test_at_most_15_percent_of_the_pairs_are_refused() -> None:
    assert refused_share() <= 0.15
    assert all(refusal.reason for refusal in REFUSALS)


def test_scenes_are_the_same_for_ever(tmp_path: Path) -> None:
    levels = draw(7, 5)
    assert levels == draw(7, 5)
    texts = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        texts.append(scene(levels, 5, folder).text())
    assert texts[0] == texts[1]


@pytest.mark.parametrize("refusal", [r for r in REFUSALS if r.error], ids=lambda r: r.name)
def test_what_is_refused_is_said(refusal: Refusal, tmp_path: Path) -> None:
    """Run the scene of an assignment with only this refusal; the message of dynsim matches the table."""
    for k in range(TRIES):
        levels = draw(SEED, k)
        levels.update({factor: refused[k % len(refused)] for factor, refused in refusal.levels if factor != METHOD})
        method = dict(refusal.levels).get(METHOD, ("dopri5",))[0]
        for tried in (method, "time_stepping"):
            others = [r for r in REFUSALS if r.holds({**levels, METHOD: tried})]
            if others == [refusal]:
                with pytest.raises(DynsimError) as raised:
                    _begin(levels, tried, tmp_path)
                assert matches(refusal, str(raised.value)), raised.value
                return
    pytest.fail("no assignment meets this refusal alone")


def _begin(levels: dict[str, str], method: str, folder: Path) -> None:
    prepare(scene(levels, SEED, folder).load(method, levels["solver"]))


def _possible(wanted: dict[str, str], method: str) -> bool:
    """Whether any whole assignment has these levels: they may be incompatible through a third factor."""
    random = np.random.default_rng(SEED)
    law = covering._law(method)
    return any(
        covering._filled(random, law, [NUMBER[item] for item in wanted.items()]) is not None for _ in range(TRIES)
    )


@pytest.mark.parametrize(
    "number", [pytest.param(number, marks=() if number in QUICK else pytest.mark.long) for number in range(FEW)]
)
def test_few_scenes(number: int, tmp_path: Path) -> None:
    _holds(number, tmp_path, takes=_shares_a_program)


@pytest.mark.parametrize(("name", "number"), [(name, number) for name in KNOWN for number in KNOWN[name].numbers])
def test_scenes_that_were_wrong_once(name: str, number: int, tmp_path: Path) -> None:
    _all_holds(KNOWN[name].assignment, KNOWN_SEED, number, tmp_path, thorough=False, takes=_shares_a_program)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "number"), FOUND.values(), ids=FOUND)
def test_fresh_scenes_that_were_wrong_once(seed: int, number: int, tmp_path: Path) -> None:
    # These scenes are older than the factor of bodies that touch each other.
    levels = study.assignment("none", seed, number) | {"between": "none"}
    _all_holds(levels, seed, number, tmp_path, thorough=False, takes=_shares_a_program)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(PAIRS))
def test_every_pair(number: int, tmp_path: Path) -> None:
    _holds(number, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(TRIPLES))
def test_triples(number: int, tmp_path: Path) -> None:
    _holds(number, tmp_path, cover="triples")


def _holds(number: int, folder: Path, cover: str = "pairs", **options: Any) -> None:
    _all_holds(study.assignment(cover, SEED, number), SEED, number, folder, **options)


def _all_holds(levels: dict[str, str], seed: int, number: int, folder: Path, **options: Any) -> None:
    outcome = study.look_at(levels, seed, number, folder, **options)
    assert not outcome.problems, "\n".join(
        [
            *(f"{kind}: {text}" for kind, text in outcome.problems),
            scene(levels, seed + number, folder).text(),
        ]
    )


def _shares_a_program(drawn: Scene, method: str, manner: str) -> bool:
    """Return whether the default tests of CONTRIBUTING.md compile its program."""
    if method == "time_stepping":
        return True
    if method == "auto" or manner == M_STAR:
        return False
    try:
        shapes = prepare(drawn.load(method)).system.shapes is not None
    except DynsimError:
        return True
    glued = drawn.levels["contact"] in ("nothing", "glued")
    return not shapes or (method == "radau5" and not glued)
