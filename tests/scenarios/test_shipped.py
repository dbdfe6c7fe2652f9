"""Every shipped scenario is valid in all variants, and runs (shortened)."""

import math
from collections.abc import Iterator
from typing import Any

import pytest

import dynsim
from dynsim.engine import check
from dynsim.scenario import shipped_scenarios, variant_names

CASES = [(path.stem, variant) for path in shipped_scenarios() for variant in (variant_names(path) or [None])]


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_is_valid(name, variant):
    check(dynsim.load_scenario(name, variant))


def floats(value: Any) -> Iterator[float]:
    """Every float of a summary, however deep."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from floats(item)


@pytest.mark.parametrize("name", sorted({name for name, _ in CASES}))
def test_runs_shortened(name):
    record = dynsim.simulate(dynsim.load_scenario(name, overrides={"duration_s": 0.5, "metrics.settle_s": 0.1}))
    assert record.complete
    assert record.time[-1] == pytest.approx(0.5)
    numbers = list(floats(record.summary))
    assert len(numbers) > 10
    assert all(map(math.isfinite, numbers))
