"""Runs that share lanes: what each has is what it has alone, in the order asked for, whatever becomes of the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import dynsim
from dynsim.engine.together import LANES, alone, can_share, simulate_together
from dynsim.errors import DynsimError, ModelError, SimulationStopped
from dynsim.record import Record
from dynsim.scenario import Scenario

# What is a difference of large numbers, or nothing but rounding.
SMALL = ("contact_gap", "work_constraint", "energy_residual")


def braced(variant: str = "two_elbows", **keys: Any) -> Scenario:
    short = {"duration_s": 0.2, "metrics.settle_s": 0.1, "record.rate_hz": 150}
    fixed = {"integrator.method": "rk4", "integrator.step_s": 5e-4}
    return dynsim.load_scenario("elbow_comparison", variant, overrides={**short, **fixed, **keys})


def record_of(result: Record | DynsimError) -> Record:
    assert isinstance(result, Record), result
    return result


def assert_alike(found: Record, expected: Record) -> None:
    assert list(found.units) == list(expected.units)
    np.testing.assert_array_equal(found.time, expected.time)
    for name in expected.units:
        scale = np.abs(expected[name]).max(initial=1.0 if name in SMALL else 1e-300)
        assert np.abs(found[name] - expected[name]).max(initial=0.0) <= 1e-10 * scale, name
    for key in ("steps", "rhs_evaluations", "projections", "warnings"):
        assert found.summary[key] == expected.summary[key]


@pytest.fixture(scope="module")
def frictions() -> list[Scenario]:
    """More than fit on lanes at once, four or eight, with parameters of every kind of their own."""
    return [
        braced(
            **{
                "contacts.friction": 0.02 * k,
                "plant.link.mass_kg": 0.1 + 0.002 * k,
                "controller.k_p_V_per_rad": 500.0 + 5.0 * k,
            }
        )
        for k in range(11)
    ]


def test_each_is_what_it_is_alone(frictions):
    results = simulate_together(frictions)
    assert len(results) == len(frictions)
    for k in (0, 3, LANES - 1, LANES + 2):
        assert_alike(record_of(results[k]), record_of(alone(frictions[k])))


def test_a_run_does_not_depend_on_those_beside_it(frictions):
    """To the bit: place, number and kind of neighbours are nothing to it."""
    among = simulate_together(frictions)
    for few in ([2], [5, 2], [10, 9, 2, 1]):
        record = record_of(simulate_together([frictions[k] for k in few])[few.index(2)])
        for name in record.units:
            np.testing.assert_array_equal(record[name], record_of(among[2])[name])


def test_runs_of_every_structure_in_their_order(frictions):
    """Other trees and braces, an adaptive run, one that cannot be prepared and one that diverges, among those alike."""
    odd = {
        1: braced("no_elbow"),
        2: braced(**{"integrator.method": "rk43", "integrator.step_s": None}),
        4: braced(**{"surfaces.floor.point_m": [0.0, 0.0, 0.3]}),
        5: braced(**{"integrator.step_s": 5e-3}),
    }
    scenarios = [odd.get(k, frictions[k]) for k in range(7)]
    assert [can_share(scenario) for scenario in scenarios] == [k != 2 for k in range(7)]
    results = simulate_together(scenarios)
    assert isinstance(results[4], ModelError)
    assert isinstance(results[5], SimulationStopped)
    assert results[5].record is not None
    for k in (0, 1, 2, 3, 6):
        assert_alike(record_of(results[k]), record_of(alone(scenarios[k])))
    with pytest.raises(SimulationStopped, match=str(results[5]).split(":")[0]):
        dynsim.simulate(scenarios[5])
