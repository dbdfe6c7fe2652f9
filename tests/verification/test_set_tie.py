"""Ties that callers change: a mass that hangs in a gripper of six ties, which hardens, slips and lets go."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim import Simulation
from dynsim.errors import ModelError
from dynsim.library.plants.snake import GripperConfig
from dynsim.scenario import Scenario, ScenarioConfig

G, MASS, K = 9.81, 0.3, 5e3
PLACE = [1.0, 0.0, 0.5]


def hanging(duration: float = 3.0, mass: float = MASS, **changes: Any) -> Scenario:
    """A box that six ties hold against the world, at its centre."""
    ties: dict[str, Any] = {}
    for name, axis in zip("xyz", np.eye(3).tolist(), strict=True):
        ends = {"body": "box", "other": "world", "axis": axis}
        linear = {"type": "linear", "other_point_m": PLACE, "stiffness_N_per_m": K, "damping_N_s_per_m": 20.0}
        ties[name] = ends | linear | {"bound_N": 20.0}
        turning = {"type": "torsion", "stiffness_N_m_per_rad": 5.0, "damping_N_m_s_per_rad": 0.05, "bound_N_m": 0.8}
        ties[f"r{name}"] = ends | turning
    config = {
        "name": "hanging",
        "duration_s": duration,
        "plant": {"type": "serial_arm", "chain": [{"axis": "y", "length_m": 0.3, "mass_kg": 0.5, "initial_deg": 180}]},
        "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -1.0]}},
        "contacts": {"law": "unilateral", "friction": 0.3},
        "integrator": {"method": "time_stepping", "step_s": 0.001},
        "objects": {"box": {"mass_kg": mass, "size_m": [0.06, 0.06, 0.06], "position_m": PLACE}},
        "ties": ties,
    }
    return Scenario("hanging", "", ScenarioConfig.model_validate(config | changes))


def height(simulation: Simulation) -> float:
    """Of the box above where it started [m]."""
    state = simulation.state
    return float(state.q[-5] - PLACE[2])


def test_a_hung_mass_sinks_by_its_weight_over_the_stiffness() -> None:
    record = dynsim.simulate(hanging())
    sunk = PLACE[2] - record["q"][-1, record.labels["q"].index("box.z")]
    assert sunk == pytest.approx(MASS * G / K, rel=1e-4)
    assert record["tie_force"][-1, record.labels["tie_force"].index("z")] == pytest.approx(MASS * G, rel=1e-6)


def test_an_overloaded_tie_slides_at_its_bound_and_does_not_snap_back() -> None:
    """2.5 kg fall with g − F/m once the bound is reached; when the load is gone the spring keeps F/k at the most."""
    simulation = Simulation(hanging(duration=0.6, mass=2.5))
    rates = [float(simulation.advance(time).v[-4]) for time in (0.1, 0.2)]
    assert simulation.tie_force["z"] == pytest.approx(20.0, rel=1e-9)
    assert rates[1] - rates[0] == pytest.approx(-(G - 20.0 / 2.5) * 0.1, rel=1e-6)
    simulation.set_wrench("box", [0.0, 0.0, 2.5 * G])
    simulation.advance(0.6)
    # It goes on until the bound has stopped it, and comes back by what the spring has kept.
    lowest = float(simulation.record()["q"][:, -5].min() - PLACE[2])
    assert height(simulation) - lowest < 1.5 * 20.0 / K


def test_what_is_added_to_a_spring_is_not_deflected_and_what_is_taken_takes_its_force() -> None:
    simulation = Simulation(hanging(duration=8.0))
    simulation.advance(2.0)
    sunk = MASS * G / K
    simulation.set_tie("z", stiffness=2.0 * K)
    simulation.advance(4.0)
    assert height(simulation) == pytest.approx(-sunk, rel=1e-4)
    # Half of the deflection was that of the spring before: the rest moved by ½ m g/k.
    simulation.set_tie("z", stiffness=0.5 * K)
    simulation.advance(8.0)
    assert height(simulation) == pytest.approx(-0.5 * sunk - 2.0 * sunk, rel=1e-4)
    record = simulation.record()
    assert np.abs(record["energy_residual"]).max() < 1e-12


def test_ties_end_and_begin_where_the_bodies_are() -> None:
    simulation = Simulation(hanging(duration=2.0))
    simulation.advance(1.0)
    for tie in simulation.robot.ties:
        simulation.set_tie(tie.name, holds=False)
    simulation.advance(1.1)
    fallen = height(simulation)
    assert fallen == pytest.approx(-MASS * G / K - 0.5 * G * 0.1**2, rel=1e-3)
    assert simulation.tie_force["z"] == 0.0
    for tie in simulation.robot.ties:
        simulation.set_tie(tie.name, holds=True)
    simulation.advance(1.101)
    # It begins without a force of its spring; the damper has the speed of the fall.
    assert abs(simulation.tie_force["z"]) <= 20.0 * G * 0.11 + K * G * 0.11 * 1e-3
    simulation.advance(2.0)
    assert height(simulation) < fallen
    record = simulation.record()
    assert np.abs(record["energy_residual"]).max() < 1e-10


@pytest.mark.parametrize("step", [1e-3, 5e-4])
def test_a_tie_that_begins_on_a_moving_body_has_no_deflection_there(step: float) -> None:
    """x = v/ω sin ω t of a spring that begins at x = 0, to second order of the step."""
    simulation = Simulation(hanging(duration=2.0, integrator={"method": "time_stepping", "step_s": step}))
    for tie in simulation.robot.ties:
        simulation.set_tie(tie.name, holds=False)
    simulation.set_wrench("box", [0.3, 0.0, MASS * G])
    speed = float(simulation.advance(0.4).v[-6])
    simulation.set_wrench("box", [0.0, 0.0, MASS * G])
    begun = float(simulation.state.q[-7])
    simulation.set_tie("x", holds=True, stiffness=30.0, damping=0.0)
    rate, times = np.sqrt(30.0 / MASS), np.linspace(0.41, 0.9, 50)
    moved = [float(simulation.advance(time).q[-7]) - begun for time in times]
    np.testing.assert_allclose(moved, speed / rate * np.sin(rate * (times - 0.4)), atol=2.0 * speed * step**2 * rate)


def test_a_snapshot_knows_ties_that_were_changed() -> None:
    simulation = Simulation(hanging(duration=1.0))
    simulation.advance(0.3)
    simulation.set_tie("z", stiffness=2.0 * K)
    simulation.set_tie("x", holds=False)
    kept = simulation.snapshot()
    first = simulation.advance(1.0)
    simulation.restore(kept)
    simulation.set_tie("y", holds=False)
    simulation.advance(0.5)
    simulation.restore(kept)
    again = simulation.advance(1.0)
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(first.v, again.v)


def test_wrong_changes_are_refused() -> None:
    simulation = Simulation(hanging())
    with raises(ModelError, "'w'", "x, rx"):
        simulation.set_tie("w", holds=False)
    for values in ({"stiffness": -1.0}, {"stiffness": 0.0, "damping": 0.0}, {"stiffness": float("nan")}):
        with pytest.raises(ModelError):
            simulation.set_tie("z", **values)


def test_a_tie_that_does_not_hold_at_the_start_has_no_force() -> None:
    scenario = hanging(duration=0.2)
    ties = {name: tie.model_copy(update={"holds": False}) for name, tie in scenario.config.ties.items()}
    free = Scenario("free", "", scenario.config.model_copy(update={"ties": ties}))
    record = dynsim.simulate(free)
    assert record["q"][-1, record.labels["q"].index("box.z")] == pytest.approx(PLACE[2] - 0.5 * G * 0.2**2, rel=1e-9)
    assert not record["tie_force"].any()


def test_a_gripper_has_six_ties_of_an_object() -> None:
    ties = GripperConfig().gripper(0.1).ties("box")
    assert [tie.name for tie in ties] == [f"gripper.box.{name}" for name in ("x", "y", "z", "rx", "ry", "rz")]
    assert not any(tie.holds for tie in ties)


def test_a_tie_that_ends_and_begins_without_a_step_between_has_a_new_rest() -> None:
    simulation = Simulation(hanging(duration=2.0))
    simulation.advance(1.0)
    simulation.set_tie("z", holds=False)
    simulation.set_tie("z", holds=True)
    simulation.advance(2.0)
    assert height(simulation) == pytest.approx(-2.0 * MASS * G / K, rel=1e-3)
    assert np.abs(simulation.record()["energy_residual"]).max() < 1e-12


def test_a_pushing_tie_in_the_air_keeps_its_contact() -> None:
    scenario = hanging(duration=1.0)
    ties = dict(scenario.config.ties)
    ties["z"] = ties["z"].model_copy(update={"pushes": True, "bound_N": None, "rest_m": -0.03})
    simulation = Simulation(Scenario("hanging", "", scenario.config.model_copy(update={"ties": ties})))
    simulation.set_tie("z", stiffness=4.0 * K, damping=100.0)
    simulation.advance(1.0)
    assert height(simulation) == pytest.approx(-0.03 - MASS * G / (4.0 * K), abs=1e-5)
