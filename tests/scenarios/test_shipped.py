"""Every shipped scenario is valid in all variants, and runs (shortened)."""

import math

import pytest

import dynsim
from dynsim.engine import check
from dynsim.scenario import shipped_scenarios, variant_names

CASES = [(path.stem, variant) for path in shipped_scenarios() for variant in (variant_names(path) or [None])]


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_is_valid(name, variant):
    check(dynsim.load_scenario(name, variant))


@pytest.mark.parametrize("name", sorted({name for name, _ in CASES}))
def test_runs_shortened(name):
    record = dynsim.simulate(dynsim.load_scenario(name, overrides={"duration_s": 0.5, "metrics.settle_s": 0.1}))
    assert record.complete
    assert record.time[-1] == pytest.approx(0.5)
    assert all(math.isfinite(v) for v in record.summary.values() if isinstance(v, float))
