"""Layout of the figures of arms: no text leaves the canvas or overlaps another text, on a page and in a column."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest
from support.layout import layout_faults

import dynsim
from dynsim.draw.figures import arm
from dynsim.errors import RecordError, SimulationStopped
from dynsim.record import Record
from dynsim.scenario import load_scenario, shipped_scenarios, variant_names

SIZES = (7.2, 3.4)
# Durations of runs [s]: long enough for the first contacts, slip and a transient panel.
DURATION, SHORT = 4.0, 1.0
MOBILE = ("base", "overturning", "base_tracking")


def simulated(name: str, variant: str | None, duration: float) -> Record:
    changes = {"duration_s": duration, "metrics.settle_s": 0.25 * duration}
    scenario = load_scenario(name, variant)
    if scenario.duration_s < duration:
        changes = {}
    try:
        return dynsim.simulate(load_scenario(name, variant, changes))
    except SimulationStopped as stop:
        if stop.record is None:
            raise
        return stop.record


def faults(name: str, label: str, records: Record | Mapping[str, Record], size: float) -> list[str]:
    try:
        figure = dynsim.figure(records, name, size=size)
    except RecordError as error:
        if "no data" not in str(error):
            raise
        return []
    return [f"{name} of {label} at {size} in: {fault}" for fault in layout_faults(figure)]


def all_faults(records: Mapping[str, Record], *, every: bool) -> Iterator[str]:
    """Yield the faults of all figures at both sizes, or those of two variants at one size each."""
    few = len(records) > 1 and not every
    for k, (variant, record) in enumerate(list(records.items())[: 2 if few else None]):
        for size in SIZES[k : k + 1] if few else SIZES:
            for name in arm.FIGURES:
                yield from faults(name, variant, record, size)
    for size in SIZES if len(records) > 1 else ():
        for name in arm.COMPARISONS:
            yield from faults(name, "all", records, size)


def arms() -> list[str]:
    """Return the shipped scenarios of arms and mobile arms."""
    return [path.stem for path in shipped_scenarios() if not path.stem.startswith("snake")]


@pytest.fixture(scope="module")
def fixed() -> Record:
    return simulated("elbow_comparison_floor", "two_elbows", SHORT)


@pytest.fixture(scope="module")
def mobile() -> Record:
    return simulated("mobile_reach", None, SHORT)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", [name for name in arm.FIGURES if name not in MOBILE])
def test_labels_of_arm_figure_are_apart(fixed: Record, name: str, size: float) -> None:
    assert faults(name, "run", fixed, size) == []


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", ["posture", *MOBILE])
def test_labels_of_mobile_arm_figure_are_apart(mobile: Record, name: str, size: float) -> None:
    assert faults(name, "run", mobile, size) == []


@pytest.mark.parametrize("size", SIZES)
def test_labels_of_comparisons_of_arms_are_apart(size: float) -> None:
    records = {name: simulated("wall_push", name, SHORT) for name in ("weak_hold", "strong_hold")}
    assert [fault for name in arm.COMPARISONS for fault in faults(name, "all", records, size)] == []


@pytest.mark.parametrize(
    "every", [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", arms())
def test_labels_of_shipped_arm_figures_are_apart(name: str, every: bool) -> None:
    records = {variant or name: simulated(name, variant, DURATION) for variant in variant_names(name) or [None]}
    assert list(all_faults(records, every=every)) == []
