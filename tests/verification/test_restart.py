"""Runs that go on from a state: ties keep their rests, and what time stepping leaves behind is accepted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, raises

from dynsim import Scenario, Simulation, State, load_scenario
from dynsim.engine.trace import even_times
from dynsim.errors import ModelError

HALFWAY = 0.15
# Samples at the start of a run have the forces of its first step, others those of the step before: two steps of 1 ms.
STEP = 1e-3
TIED = """
name: tied
duration_s: 0.3
plant:
  type: serial_arm
  gravity_m_s2: [0.5, -9.81, 1.0]
  base: {position_m: [0, 0, 1]}
  chain:
    - {axis: [0.2, 1, 0], length_m: 0.3, mass_kg: 1, initial_deg: 40}
    - {axis: [0, 1, 0.3], length_m: 0.2, mass_kg: 0.5, initial_deg: 20}
objects:
  box: {mass_kg: 0.5, size_m: [0.1, 0.1, 0.1], position_m: [0.2, 0.3, 1], rpy_deg: [10, 20, 30]}
contacts: {law: unilateral}
integrator: {method: time_stepping, step_s: 0.001}
record: {rate_hz: 1000}
"""
LINEAR = (
    "{type: linear, body: link_2, other: box, axis: [0.1, 0.5, 1], point_m: [0, 0.01, 0.1], "
    "other_point_m: [0.01, 0.02, 0.03], stiffness_N_per_m: 80"
)
TORSION = "{type: torsion, body: link_1, other: box, axis: [0.3, 1, 0.2], stiffness_N_m_per_rad: 0.5"
TIES = {
    "linear": f"{LINEAR}}}",
    "bound": f"{LINEAR}, bound_N: 0.5}}",
    "torsion": f"{TORSION}}}",
    "torsion_bound": f"{TORSION}, bound_N_m: 0.05}}",
}


def tied(kind: str, folder: Path) -> Scenario:
    """An arm and a free box that a tie holds."""
    path = folder / "tied.yaml"
    path.write_text(f"{TIED}ties: {{tie: {TIES[kind]}}}\n")
    return load_scenario(path)


@pytest.mark.parametrize("kind", TIES)
def test_ties_go_on_from_the_state_as_they_were(kind: str, tmp_path: Path):
    """x_0 is that of the start of the scenario, and where a tie has slid to since, not the posture of the state."""
    scenario = tied(kind, tmp_path)
    simulation = Simulation(scenario)
    state = simulation.advance(HALFWAY)
    simulation.advance(scenario.duration_s)
    whole = simulation.record()
    later = whole.time >= HALFWAY - 1e-9
    again = Simulation(scenario, state=state)
    again.advance(scenario.duration_s)
    record = again.record()
    forces, expected = record["tie_force"], whole["tie_force"][later]
    change = np.abs(np.diff(expected, axis=0)).max()
    assert np.abs(expected).max() > 20.0 * change
    np.testing.assert_allclose(forces, expected, atol=2.0 * change)
    # The first step does not extrapolate the accelerations of the last one: second order in the step.
    np.testing.assert_allclose(record["q"], whole["q"][later], atol=100.0 * STEP**2)
    assert record.summary["warnings"] == []
    with raises(ModelError, "2", "tie_rest", "1"):
        Simulation(scenario, state=replace(state, tie_rest=np.zeros(2)))


def test_a_state_that_does_not_say_how_far_ties_have_slid_is_said(tmp_path: Path):
    said = {}
    for kind in ("linear", "bound"):
        simulation = Simulation(tied(kind, tmp_path))
        simulation.advance(HALFWAY)
        again = Simulation(simulation.scenario, state=State.of(simulation.record()))
        again.advance(0.2)
        said[kind] = lines_with(again.record().summary["warnings"], "tie")
    assert not said["linear"]
    check_message(said["bound"][0])


LANDED = """
name: landed
duration_s: 0.6
plant:
  type: serial_arm
  chain: [{axis: y, length_m: 0.3, mass_kg: 1, initial_deg: 40, limit_deg: [0, 60]}]
objects:
  ball: {shape: sphere, radius_m: 0.05, mass_kg: 0.3, position_m: [0.5, 0.4, 0.2]}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.3}
integrator: {method: time_stepping, step_s: 0.001}
"""


@pytest.mark.parametrize("until", [0.174, 0.2])
def test_a_run_goes_on_from_what_time_stepping_leaves(until: float, tmp_path: Path):
    """A ball that has sunk in as it landed, and a joint that has passed its stop by a step."""
    path = tmp_path / "landed.yaml"
    path.write_text(LANDED)
    scenario = load_scenario(path)
    simulation = Simulation(scenario)
    simulation.advance(until)
    before = simulation.record()
    simulation.advance(scenario.duration_s)
    again = Simulation(scenario, state=State.of(before))
    q = again.advance(scenario.duration_s).q
    # The state does not have what the landing lost, which is what depth is taken back with: it stays.
    depth = max(-float(before["contact_gap"][-1].min()), 0.0)
    np.testing.assert_allclose(q[1:4], simulation.state.q[1:4], atol=depth + 1e-6)
    beyond = max(before["q"][-1, 0] - np.radians(60.0), 0.0)
    assert q[0] == pytest.approx(simulation.state.q[0], abs=beyond + 1e-6)
    ending = State.of(before)
    deep = ending.q.copy()
    deep[0] = np.radians(61.0)
    with raises(ModelError, "joint_1", "61°", "60°", "state"):
        Simulation(scenario, state=replace(ending, q=deep))


LED = """
name: led
duration_s: 0.6
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  link: {mass_kg: 0.3, motor: {type: wang_minami}}
  chain:
    - {axis: z, length_m: 0.1, initial_deg: 10}
    - {axis: y, length_m: 0.3, initial_deg: 60}
    - {axis: y, length_m: 0.2, initial_deg: 40}
controller:
  type: joint_pd
  k_p_V_per_rad: 500
  k_d_V_s_per_rad: 20
  operator:
    joints: [joint_1, joint_2, joint_3]
    commands: [{at_s: 0.0, hand: [-0.05, 0.05, 0.08]}, {at_s: 0.4, hand: [0, 0, 0]}]
integrator: {method: dopri5}
record: {rate_hz: 500}
"""


def test_an_operator_goes_on_from_the_posture_and_the_time_of_a_state(tmp_path: Path):
    """The hand is led on from where it is, not back to where the scenario starts, and its script goes on, not anew."""
    path = tmp_path / "led.yaml"
    path.write_text(LED)
    scenario = load_scenario(path)
    simulation = Simulation(scenario)
    state = simulation.advance(0.3)
    simulation.advance(0.6)
    whole = simulation.record()
    again = Simulation(scenario, state=state)
    again.advance(0.6)
    record = again.record()
    later = whole.time >= 0.3 - 1e-9
    hand, expected = record["hand_position"], whole["hand_position"][later]
    led = float(np.linalg.norm(expected[-1] - whole["hand_position"][0]))
    assert led > 0.015
    # A state does not have the references: the hand is led on from where it is, without the error that it had.
    error = np.linalg.norm(whole["target_position"] - whole["hand_position"], axis=1).max()
    assert np.linalg.norm(hand - expected, axis=1).max() < 3.0 * error < 0.1 * led
    target = record["target_position"]
    np.testing.assert_allclose(target[0], hand[0], atol=1e-12)
    np.testing.assert_allclose(target - target[0], whole["target_position"][later] - whole["target_position"][later][0],
                               atol=error)  # fmt: skip


@pytest.mark.parametrize("start", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0, 500.0, 1000.0])
def test_samples_end_at_the_end_wherever_they_begin(start: float, rate: float) -> None:
    """0.2 s + 80/200 s rounds to more than 0.6 s; such a sample would never come. They are those of the whole run."""
    times = even_times(start, 0.6, rate)
    assert times[-1] == 0.6
    assert len(times) == 1 + round((0.6 - start) * rate)
    np.testing.assert_array_equal(times, even_times(0.0, 0.6, rate)[-len(times) :])


RUBBING = """
name: rubbing
duration_s: 0.2
plant:
  type: serial_arm
  chain: [{axis: y, length_m: 0.3, mass_kg: 1.0, initial_deg: 90, friction_N_m: 0.3}]
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.2, points: {tip: {body: link_1, point_m: [0, 0, 0.3]}}}
"""


@pytest.mark.parametrize("rate", [1e-16, 0.5])
@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_joint_that_rubs_starts_where_it_is_though_its_link_strikes(method: str, rate: float, tmp_path: Path) -> None:
    """A link that lies on the floor, at 90°, and is pushed into it: an impact comes before contact modes are chosen."""
    path = tmp_path / "rubbing.yaml"
    path.write_text(f"{RUBBING}integrator: {{method: {method}}}\n")
    scenario = load_scenario(path)
    state = State(time=0.0, q=np.array([np.pi / 2]), v=np.array([rate]), current=np.zeros(0))
    simulation = Simulation(scenario, state=state)
    simulation.advance(scenario.duration_s)
    record = simulation.record()
    np.testing.assert_allclose(record["q"], np.pi / 2, atol=1e-9)
    np.testing.assert_allclose(record["v"], 0.0, atol=1e-12)
