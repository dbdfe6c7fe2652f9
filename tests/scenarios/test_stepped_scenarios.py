"""Time stepping in scenarios: convergence to the event-driven solution, and refused options."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, raises

import dynsim
from dynsim.engine.warnings import capped
from dynsim.errors import ScenarioError
from dynsim.record import Record

FALLING = """duration_s: 0.6
plant:
  type: serial_arm
  link: {mass_kg: 0.5, length_m: 0.3, radius_m: 0.01, damping_N_m_s_per_rad: 0.02}
  chain: [{axis: y}, {axis: y}]
  initial_deg: [60, 20]
surfaces: {floor: {type: plane, point_m: [0, 0, -0.2], normal: [0, 0, 1]}}
contacts: {law: unilateral, friction: 0.3, candidates: joints}
"""
EXACT = {"integrator.rtol": 1e-9, "integrator.atol": 1e-11}


@pytest.fixture
def falling(tmp_path: Path) -> Path:
    path = tmp_path / "falling.yaml"
    path.write_text(FALLING, encoding="utf-8")
    return path


def stepping(step: float, theta: float) -> dict[str, object]:
    return {"integrator.method": "time_stepping", "integrator.step_s": step, "integrator.theta": theta}


def errors(record: Record, exact: Record) -> np.ndarray:
    """Of the hand's position at the samples [m]."""
    return np.linalg.norm(record["hand_position"] - exact["hand_position"], axis=1)


def energy_lost(record: Record) -> float:
    """By friction, impacts and the steps themselves [J]."""
    steps = record["loss_scheme"][-1] if "loss_scheme" in record else 0.0
    return float(record["heat_friction"][-1] + record["loss_impact"][-1] + steps)


@pytest.mark.parametrize("theta", [0.5, 1.0])
def test_an_arm_that_falls_on_a_floor_lands_as_events_have_it(falling: Path, theta: float):
    """Hand, then elbow land and stay. An instant of landing is known to a step: errors within h times its speed."""
    exact = dynsim.simulate(dynsim.load_scenario(falling, overrides=EXACT))
    assert [event.kind for event in exact.events].count("landing") == 2
    for step in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        record = dynsim.simulate(dynsim.load_scenario(falling, overrides=stepping(step, theta)))
        assert errors(record, exact).max() <= 2.5 * step
        assert abs(energy_lost(record) - energy_lost(exact)) <= 10.0 * step
        solved = record.summary["time_stepping"]
        assert solved["contact_solves"] > 0.3 / step
        assert solved["capped_solves"] == 0
        assert solved["residual_max_m_s"] <= 1e-8
        assert 0.0 < solved["penetration_max_m"] <= 4.0 * step
        assert set(np.unique(record["contact_mode"])) <= {0.0, 1.0, 2.0}
        for contact in record.summary["contacts"]:
            assert contact["landings"] - contact["lift_offs"] == 1
            closed = contact["sticking_fraction"] + contact["sliding_fraction"]
            np.testing.assert_allclose(contact["closed_fraction"], closed)


def test_the_published_arm_on_a_real_floor_is_approached_at_first_order():
    """θ = 1 against events, whose elbows slip, lift off and land in the first 40 ms."""

    def load(more: dict[str, object]) -> dynsim.Scenario:
        return dynsim.load_scenario("elbow_comparison_floor", "two_elbows", overrides={"duration_s": 1.0, **more})

    exact = dynsim.simulate(load(EXACT))
    assert {event.kind for event in exact.events} >= {"slip_start", "lift_off", "landing"}
    mean = []
    for step in (2e-3, 1e-3, 5e-4, 2.5e-4):
        record = dynsim.simulate(load(stepping(step, 1.0)))
        mean.append(np.sqrt(np.mean(errors(record, exact) ** 2)))
        assert record.summary["time_stepping"]["capped_solves"] == 0
    rates = np.log2(np.divide(mean[:-1], mean[1:]))
    assert (rates > 0.8).all(), (mean, rates)
    assert (rates < 1.2).all(), (mean, rates)
    # θ = 1/2 is of second order but for the landing, which is known to a step: its error is less, and less smooth.
    finer = dynsim.simulate(load(stepping(2.5e-4, 0.5)))
    assert np.sqrt(np.mean(errors(finer, exact) ** 2)) < 0.6 * mean[-1]


def test_events_cannot_be_watched(falling: Path):
    simulation = dynsim.Simulation(dynsim.load_scenario(falling, overrides=stepping(1e-3, 0.5)))
    with raises(ScenarioError, "Simulation.watch", "integrator.method: auto", "every()"):
        simulation.watch("joint_position", "joint_1", 0.1)
    ticks: list[float] = []
    simulation.every(0.01, lambda s: ticks.append(s.time))
    simulation.advance(0.1)
    np.testing.assert_allclose(ticks, np.arange(0.0, 0.105, 0.01), atol=1e-12)


def test_what_it_does_not_do_is_refused(falling: Path):
    for more, names in (
        ({"integrator.solver": "m_star"}, ("integrator.solver = 'm_star'", "integrator.method: auto")),
        ({"contacts.law": "bilateral", "contacts.candidates": "points", "contacts.points.hand.body": "link_2",
          "surfaces.floor.point_m": [0, 0, 0.15]},
         ("integrator.method = 'time_stepping'", "contacts.law: unilateral", "bilateral")),
    ):  # fmt: skip
        with raises(ScenarioError, *names):
            dynsim.simulate(dynsim.load_scenario(falling, overrides=stepping(1e-3, 0.5) | more))


def test_joint_stops_are_counted(falling: Path):
    """A joint that falls on its limit: one hit, the energy of it, and closed from then on."""
    limited = {"plant.chain.0.limit_deg": [-90.0, 70.0], "surfaces.floor.point_m": [0, 0, -5.0], **EXACT}
    exact = dynsim.simulate(dynsim.load_scenario(falling, overrides=limited)).summary
    summary = dynsim.simulate(dynsim.load_scenario(falling, overrides=limited | stepping(1e-4, 0.5))).summary
    (wanted,), (stop,) = exact["joint_stops"], summary["joint_stops"]
    assert stop["hits"] == wanted["hits"]
    np.testing.assert_allclose(stop["closed_fraction"], wanted["closed_fraction"], atol=2e-3)
    np.testing.assert_allclose(stop["impact_loss_J"], wanted["impact_loss_J"], rtol=0.01)


def test_contact_problems_that_were_given_up_are_told(falling: Path, monkeypatch: pytest.MonkeyPatch):
    solved = {"contact_solves": 10, "capped_solves": 0, "residual_max_m_s": 1e-9}
    assert capped(solved) == []
    (text,) = capped(solved | {"capped_solves": 2, "residual_max_m_s": 3e-4})
    check_message(text, "2", "10", "3.0e-04 m/s", "integrator.step_s")
