"""Layout of the figures of arms: no text leaves the canvas or overlaps another text, on a page and in a column."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from support import layout
from support.layout import SIZES

from dynsim.draw.figures import arm
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.scenario import load_scenario, shipped_scenarios, variant_names

# Durations of runs [s]: long enough for the first contacts, slip and a transient panel.
DURATION, SHORT = 4.0, 1.0
MOBILE = ("base", "overturning", "base_tracking")


def simulated(name: str, variant: str | None, duration: float) -> Record:
    changes = {"duration_s": duration, "metrics.settle_s": 0.25 * duration}
    if load_scenario(name, variant).duration_s < duration:
        changes = {}
    record = layout.simulated(name, variant, changes)
    assert record is not None
    return record


def faults(name: str, label: str, records: Record | Mapping[str, Record], size: float) -> list[str]:
    """Return the faults of a figure, or an empty list if the records have no data for it."""
    try:
        return layout.faults(name, label, records, size)
    except RecordError as error:
        if "no data" not in str(error):
            raise
        return []


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


@pytest.mark.slow
@pytest.mark.parametrize("name", arms())
def test_labels_of_shipped_arm_figures_are_apart(name: str) -> None:
    """Figures of every variant and comparisons of all variants, on a page and in a column."""
    records = {variant or name: simulated(name, variant, DURATION) for variant in variant_names(name) or [None]}
    drawn = [(maker, variant, record) for variant, record in records.items() for maker in arm.FIGURES]
    drawn += [(maker, "all", records) for maker in arm.COMPARISONS if len(records) > 1]
    assert [fault for size in SIZES for job in drawn for fault in faults(*job, size)] == []
