"""[WM] on elbows that "prevent from overturning": the study of it, against statics by hand."""

from __future__ import annotations

import numpy as np
import pytest
from studies import overturning as study
from support.messages import mentions

from dynsim import load_scenario, simulate
from dynsim.scenario import variant_names

G = 9.81


def moments(base: dict) -> tuple[float, float]:
    """Mass of the base with its wheels, and its first moment ahead of the axle [kg, kg m]."""
    return base["mass_kg"] + 2.0 * base["wheel"]["mass_kg"], base["mass_kg"] * base["com_m"][0]


def lever_margin(x: float, y: float, track: float, caster: float) -> float:
    """Distance of a point from the nearest side of the support triangle over its inradius, by lines and normals."""
    corners = np.array([[0.0, 0.5 * track], [0.0, -0.5 * track], [caster, 0.0]])
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    inward = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / lengths[:, None]
    inradius = track * caster / lengths.sum()
    return float((inward * (np.array([x, y]) - corners)).sum(axis=1).min() / inradius)


@pytest.mark.parametrize(
    ("margin", "expected"),
    [
        ([1.0, 0.5, 0.2, 0.1], []),
        ([1.0, -0.5, 0.2, 0.1], [(1.0, 2.0)]),
        ([-1.0, 0.5, -0.2, -0.1], [(0.0, 1.0), (2.0, None)]),
        ([-1.0, -0.5, -0.2, -0.1], [(0.0, None)]),
    ],
)
def test_spells_below_zero(margin: list[float], expected: list) -> None:
    assert study.below_zero(np.arange(4.0), np.array(margin)) == expected


def test_elbows_keep_the_published_arm_from_overturning() -> None:
    configurations = {name: study.configuration(study.SCENARIO, name) for name in variant_names(study.SCENARIO)}
    settled = [
        configurations[name]["tip_margin_min_settled"] for name in ("two_elbows", "elbow_7", "elbow_4", "no_elbow")
    ]
    assert settled == sorted(settled, reverse=True)
    assert settled[2] > 0.0 > settled[3]
    for name, row in configurations.items():
        # With every elbow configuration the jump of the references tips the base within a blink ...
        first, *later = row["margin_below_zero_s"]
        assert first[0] == pytest.approx(row["overturns_at_s"], abs=2.0 / study.START["record.rate_hz"])
        assert first[1] - first[0] < 0.005
        # ... and only without elbows it stays tipped, jump or no jump.
        assert bool(later) == (name == "no_elbow")
        assert (row["overturns_at_s_arm_held"] is None) == (name != "no_elbow")
        assert all(end is None for _, end in later)


@pytest.mark.parametrize("variant", ["no_elbow", "elbow_7"])
def test_another_base_tips_where_the_lever_rule_says(variant: str) -> None:
    """What the arm does to a base that holds does not depend on that base: one record tells about all others."""
    base = study.shipped_base()
    record = simulate(load_scenario(study.SCENARIO, variant, study.SWEEP))
    left, right, caster = record["wheel_load"][record.time >= 2.0].T
    mass, first = moments(base)
    force = left + right + caster - mass * G
    pitch = caster * base["caster_m"][0] - first * G
    roll = 0.5 * base["track_m"] * (left - right)
    for heavy, track, ahead in ((8.0, 0.3, 0.15), (4.0, 0.15, 0.25), (2.0, 0.5, 0.15)):
        mass, first = moments(base | {"mass_kg": heavy})
        total = force + mass * G
        places = np.stack([(pitch + first * G) / total, roll / total], axis=1)
        expected = min(lever_margin(x, y, track, ahead) for x, y in places)
        row = study.point(heavy, track, ahead, variant)
        assert row["tip_margin_min_settled"] == pytest.approx(expected, abs=2e-3)
        assert row["stands"] == (expected > 0.0)


def test_a_base_that_cannot_be_is_a_row_with_its_reason() -> None:
    row = study.point(4.0, 0.3, 0.0, "no_elbow")
    assert mentions(row["reason"], "plant.base.caster_m")
    assert row["stands"] is None


def test_the_sweep_takes_two_of_three_against_each_other() -> None:
    points = study.points()
    assert len(points) == len(set(points))
    shipped = (4.0, 0.3, 0.15)
    assert shipped in points
    assert all(sum(a != b for a, b in zip(point, shipped, strict=True)) <= 2 for point in points)
    numbers = [len(values) for _, values in study.AXES.values()]
    pairs = numbers[0] * numbers[1] + numbers[0] * numbers[2] + numbers[1] * numbers[2]
    # The lines through the shipped base are in two planes, the base itself in three.
    assert len(points) == pairs - sum(numbers) + 1
