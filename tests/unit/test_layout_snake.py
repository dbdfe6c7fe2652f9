"""Layout of the figures of snakes: no text leaves the canvas or overlaps another text, on a page and in a column."""

from __future__ import annotations

import pytest
from support import layout
from support.layout import SIZES, faults

from dynsim.draw.figures import snake
from dynsim.record import Record
from dynsim.scenario import variant_names

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
    return layout.simulated(name, variant, changes)


def runs(name: str) -> dict[str, Record]:
    """Return the records of all variants of a scenario, except runs that stop at the start."""
    records = {variant or name: simulated(name, variant, SCENARIOS[name]) for variant in variant_names(name) or [None]}
    return {variant: record for variant, record in records.items() if record is not None}


@pytest.mark.parametrize(
    ("name", "variant", "size"), [("snake_short", "backward", 7.2), ("snake_positioning_dynamic", "z", 3.4)]
)
def test_figures_of_one_run_have_no_layout_faults(name: str, variant: str, size: float) -> None:
    record = simulated(name, variant, 0.3)
    assert record is not None
    assert [fault for maker in snake.figures(record) for fault in faults(maker, variant, record, size)] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_figures_of_shipped_scenarios_have_no_layout_faults(name: str) -> None:
    """Figures of every variant and comparisons of all variants, on a page and in a column."""
    records = runs(name)
    assert records
    drawn = [(maker, variant, record) for variant, record in records.items() for maker in snake.figures(record)]
    drawn += [(maker, "comparison", records) for maker in snake.comparisons(records) if len(records) > 1]
    assert [fault for size in SIZES for job in drawn for fault in faults(*job, size)] == []
