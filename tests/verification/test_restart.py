"""Runs that go on from a state: ties keep their rests, and what time stepping leaves behind is accepted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynsim import Scenario, Simulation, State, load_scenario
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
    rest = whole.time >= HALFWAY - 1e-9
    again = Simulation(scenario, state=state)
    again.advance(scenario.duration_s)
    record = again.record()
    forces, expected = record["tie_force"], whole["tie_force"][rest]
    change = np.abs(np.diff(expected, axis=0)).max()
    assert np.abs(expected).max() > 20.0 * change
    np.testing.assert_allclose(forces, expected, atol=2.0 * change)
    # The first step does not extrapolate the accelerations of the last one: second order in the step.
    np.testing.assert_allclose(record["q"], whole["q"][rest], atol=100.0 * STEP**2)
    assert record.summary["warnings"] == []
    with pytest.raises(ModelError, match="2 values of tie_rest"):
        Simulation(scenario, state=replace(state, tie_rest=np.zeros(2)))


def test_a_state_that_does_not_say_how_far_ties_have_slid_is_said(tmp_path: Path):
    said = {}
    for kind in ("linear", "bound"):
        simulation = Simulation(tied(kind, tmp_path))
        simulation.advance(HALFWAY)
        again = Simulation(simulation.scenario, state=State.of(simulation.record()))
        again.advance(0.2)
        said[kind] = [text for text in again.record().summary["warnings"] if "how far ties have slid" in text]
    assert not said["linear"]
    assert said["bound"][0].startswith("tie: the state does not say")
