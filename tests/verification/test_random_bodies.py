"""Random scenes of bodies that touch each other keep to conservation laws, and their contact problems are solved."""

from __future__ import annotations

import pytest
from support.random_bodies import faults, result_of

from dynsim.integrators.stepping import tables as kt

# Seeds of the default tests: two scenes of each kind, and scenes that were wrong once.
FEW = {
    0: "", 1: "", 4: "", 7: "", 11: "",
    23: "a stack of crossed boxes, which touched along two lines only and rattled",
    34: "two boxes, which the face beyond an edge pushed apart by 0.1 m",
    37: "a stack without the crossings of edges above the border of a face",
    12541: "a stack whose contact problem needs a small proximal term",
    21161: "a problem solved to 5e-10 m/s only",
    22017: "a problem solved to 4e-10 m/s only",
    1988: "a turned box whose corners beyond the other one took the slots of places that touched: it rattled",
}  # fmt: skip
SCENES = 3000


@pytest.mark.parametrize("seed", FEW)
def test_few_random_scenes_of_bodies(seed):
    result = result_of(seed)
    assert not faults(result)
    assert result.solves > 0


@pytest.mark.slow
def test_many_random_scenes_of_bodies():
    results = [result_of(seed, problems=True) for seed in range(SCENES)]
    assert not [(result.seed, faults(result)) for result in results if faults(result)]
    hard = sum(result.above_fair for result in results)
    assert hard <= 1e-5 * sum(result.solves for result in results), f"problems above {kt.FAIR} m/s: {hard}"
