"""Layout of the figures of snakes: no text leaves the canvas or overlaps another text, on a page and in a column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest
from support.layout import layout_faults

import dynsim
from dynsim.draw.figures import snake
from dynsim.errors import SimulationStopped
from dynsim.record import Record
from dynsim.scenario import load_scenario, variant_names

SIZES = (7.2, 3.4)
# Scenarios with the duration of their runs [s], if it is not that of the scenario: the gripper has to close.
SCENARIOS: dict[str, float | None] = {
    "snake_positioning": 2.0,
    "snake_positioning_dynamic": 3.0,
    "snake_joint_limits": 12.0,
    "snake_circle": 12.0,
    "snake_circle_backward": 60.0,
    "snake_short": None,
    "snake_door_arc": 14.0,
    "snake_door": 9.0,
    "snake_operator": None,
    "snake_valve": 10.0,
    "snake_pull": None,
    "snake_pick_up": 14.0,
    "snake_push": 2.0,
}


def simulated(name: str, variant: str | None, duration: float | None) -> Record | None:
    changes = {"record.rate_hz": 50} | ({} if duration is None else {"duration_s": duration})
    try:
        return dynsim.simulate(load_scenario(name, variant, changes))
    except SimulationStopped as stop:
        return stop.record


def runs(name: str) -> dict[str, Record]:
    """Return the records of all variants of a scenario; runs that stop at the start have none."""
    records = {variant or name: simulated(name, variant, SCENARIOS[name]) for variant in variant_names(name) or [None]}
    return {variant: record for variant, record in records.items() if record is not None}


def faults(jobs: Sequence[tuple[str, str, Record | Mapping[str, Record]]], sizes: Sequence[float]) -> list[str]:
    """Return the faults of figures: each has its name, a label of the records, and the records."""
    return [
        f"{name} of {label} at {size} in: {fault}"
        for size in sizes
        for name, label, records in jobs
        for fault in layout_faults(dynsim.figure(records, name, size=size))
    ]


@pytest.mark.parametrize(
    ("name", "variant", "size"), [("snake_short", "backward", 7.2), ("snake_positioning_dynamic", "z", 3.4)]
)
def test_figures_of_one_run_have_no_layout_faults(name: str, variant: str, size: float) -> None:
    record = simulated(name, variant, 0.3)
    assert record is not None
    assert faults([(maker, variant, record) for maker in snake.figures(record)], [size]) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_figures_of_shipped_scenarios_have_no_layout_faults(name: str) -> None:
    """Comparisons of all variants on a page and in a column, and figures of the first variant in a column."""
    records = runs(name)
    several = [(maker, "comparison", records) for maker in snake.comparisons(records)] if len(records) > 1 else []
    first = next(iter(records))
    assert faults([(maker, first, records[first]) for maker in snake.figures(records[first])], SIZES[1:]) == []
    assert faults(several, SIZES) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_figures_of_all_variants_have_no_layout_faults(name: str) -> None:
    jobs = [(maker, variant, record) for variant, record in runs(name).items() for maker in snake.figures(record)]
    assert faults(jobs, SIZES) == []
