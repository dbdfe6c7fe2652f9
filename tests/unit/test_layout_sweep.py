"""Layout of the figures of sweeps and plans: at both widths no text leaves the canvas or overlaps another text."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from support.layout import layout_faults

import dynsim
from dynsim.cli.sweep import drawn_table
from dynsim.draw.figures import plan as plan_figures
from dynsim.draw.figures import style
from dynsim.draw.figures import sweep as sweep_figures
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.plan import PlanPicture
from dynsim.draw.figures.sweep import Sweep
from dynsim.planner import pictures
from dynsim.scenario import read_scenario, shipped_scenarios, variant_names
from dynsim.scenario.quantities import quantity
from dynsim.studies.sweep import SweepRow, run_sweep
from dynsim.studies.sweep_plan import Axis, Law, Plan

SIZES = ("7.2", "3.4")
# The error of the hand is evaluated from the start.
SHORT = {"duration_s": 0.2, "metrics.settle_s": 0.0}
SHIPPED = Path(__file__).parents[2] / "results/sweeps"
FRICTION, VOLTAGE, MASS = "contacts.friction", "plant.link.motor.voltage_limit_V", "plant.link.mass_kg"


def faults(makers: Mapping[str, Callable[[Any], Figure | None]], of: Any, size: str) -> tuple[list[str], list[str]]:
    """The names of the drawn figures, and all faults of their layout."""
    names, overlaps = [], []
    with style.look(Look.of(size)):
        for name, make in makers.items():
            if (figure := make(of)) is None:
                continue
            style.literal(figure)
            figure.set_dpi(110)
            names.append(name)
            overlaps += [f"{name}: {fault}" for fault in layout_faults(figure)]
            assert figure.get_figwidth() == float(size)
    return names, overlaps


def run(scenario: str, folder: Path, variants: Sequence[str | None], *keys: str, samples: str = "", **values: Any):
    """The rows of a short sweep, with its plan."""
    laws, count = ((Law.parse(samples),), 12) if samples else ((), 1)
    plan = Plan(read_scenario(scenario), tuple(variants), values, tuple(map(Axis.parse, keys)), laws, count, 0)
    return run_sweep(plan, folder), plan


def shipped_table(key: str, folder: str) -> Sweep:
    """A sweep of four variants in the repository."""
    with (SHIPPED / folder / "sweep.csv").open() as stream:
        rows = [{name: _value(text) for name, text in row.items()} for row in csv.DictReader(stream)]
    scenario = dynsim.load_scenario("elbow_comparison", "two_elbows")
    return Sweep(scenario.name, rows, [key], [], variant_names("elbow_comparison"), (), {key: quantity(key, scenario)})


def _value(text: str) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text


@pytest.mark.parametrize("size", SIZES)
def test_shipped_sweep_of_the_voltage_has_no_faults(size: str) -> None:
    assert faults(sweep_figures.FIGURES, shipped_table(VOLTAGE, "voltage"), size) == (
        ["sweep_lines", "sweep_pareto"],
        [],
    )


@pytest.fixture(scope="module")
def masses(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """Random masses of ten links at two values of the friction."""
    folder = tmp_path_factory.mktemp("masses")
    samples = "plant.chain.*.mass_kg=normal(0.1,0.005)"
    rows, plan = run("link_tolerance", folder, [None], f"{FRICTION}=0.1,0.3", samples=samples, **SHORT)
    return drawn_table("link_tolerance", rows, plan)


@pytest.mark.parametrize("size", SIZES)
def test_random_masses_of_ten_links_have_no_faults(masses: Sweep, size: str) -> None:
    drawn = ["sweep_lines", "sweep_pareto", "sweep_samples", "sweep_tornado"]
    assert faults(sweep_figures.FIGURES, masses, size) == (drawn, [])


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[SweepRow], Plan]:
    """Two keys and four variants, of which some lack an elbow."""
    grid = f"{MASS}=0.05,0.1,0.2", f"{FRICTION}=0:0.4:3"
    return run("elbow_comparison", tmp_path_factory.mktemp("maps"), variant_names("elbow_comparison"), *grid, **SHORT)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "plotted", [(), ("elbow_4.normal_force_mean_N", "joint_3.current_rms_A", "joint_3.torque_max_N_m")]
)
def test_maps_of_four_variants_have_no_faults(maps: Any, size: str, plotted: tuple[str, ...]) -> None:
    names = ["sweep_map", *([] if plotted else ["sweep_pareto"])]
    assert faults(sweep_figures.FIGURES, drawn_table("elbow_comparison", *maps, plotted), size) == (names, [])


@cache
def planned(scenario: str, verify: bool, most: int, *candidates: str) -> PlanPicture:
    """The picture of a plan."""
    loaded = dynsim.load_scenario(scenario, next(iter(variant_names(scenario)), None))
    plan = dynsim.plan_braces(loaded, candidates=candidates, count=(0, most), starts=1, budget_s=0.0, verify=verify)
    assert plan.best is not None
    return pictures.picture(plan, pictures._records(plan).get(plan.best.variant))


@pytest.mark.parametrize("size", SIZES)
def test_plan_of_a_mobile_arm_has_no_faults(size: str) -> None:
    picture = planned("mobile_elbow_comparison", False, 1, "link_6", "link_8")
    assert len(picture.base) > 1
    assert faults(plan_figures.FIGURES, picture, size) == (["plan_posture", "plan_heat", "plan_single_braces"], [])


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [path.stem for path in shipped_scenarios()])
def test_sweeps_of_shipped_scenarios_have_no_faults(scenario: str, tmp_path: Path) -> None:
    """All variants, at two durations; the figures do not depend on the meaning of the numbers."""
    file = read_scenario(scenario)
    rows, plan = run(scenario, tmp_path, file.variants or [None], "duration_s=0.05,0.1", "record.rate_hz=100")
    table = drawn_table(scenario, rows, plan)
    if not table.metrics:
        table = replace(table, plotted=list(rows[0].numbers)[:2])
    for size in SIZES:
        for drawn in (table, replace(table, grid=table.grid[:1])):
            assert faults(sweep_figures.FIGURES, drawn, size)[1] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "most", "candidates"),
    [("pressing", 2, ("link_6:link_9",)), ("brace_on_shapes", 1, ()), ("mobile_elbow_comparison", 1, ("link_8",))],
)
def test_verified_plans_have_no_faults(scenario: str, most: int, candidates: tuple[str, ...]) -> None:
    picture = planned(scenario, True, most, *candidates)
    for size in SIZES:
        names, overlaps = faults(plan_figures.FIGURES, picture, size)
        assert {"plan_posture", "plan_heat", "plan_robustness"} <= set(names)
        assert overlaps == []
