"""Records in the middle of a run: their last sample, and tallies of the same time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dynsim

G, MASS, HEIGHT, LIFTS, PULL = 9.81, 2.0, 0.2, 0.7, 50.0
DROP = f"""
duration_s: 2.0
plant:
  type: serial_arm
  chain: [{{kind: prismatic, axis: z, length_m: 0, mass_kg: {MASS}, initial_m: START}}]
surfaces: {{floor: {{type: plane}}}}
contacts: {{law: unilateral, friction: 0.0, points: {{foot: {{body: link_1}}}}}}
loads:
  crane: {{type: samples, body: link_1, times_s: [{LIFTS}, 9], force_N: [[0, 0, {PULL}], [0, 0, {PULL}]]}}
integrator: {{method: METHOD}}
record: {{rate_hz: 50}}
"""
COASTS = f"""
duration_s: 2.0
plant: {{type: serial_arm, chain: [{{kind: prismatic, axis: x, length_m: 0, mass_kg: {MASS}, initial_m: 1}}]}}
contacts: {{law: unilateral}}
integrator: {{method: METHOD, step_max_s: 0.02}}
record: {{rate_hz: 50}}
"""
# It ends between two ticks.
ENCODED = """
duration_s: 0.0195
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0]}
  chain: [{axis: y, length_m: 0.3, mass_kg: 0.3, initial_deg: 90, motor: {type: wang_minami}}]
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.2, points: {tip: {body: link_1, point_m: [0, 0, 0.3]}}}
controller: {type: joint_pd, k_p_V_per_rad: 1, k_d_V_s_per_rad: 0, sample_time_s: 0.01}
sensors: {encoders: {resolution_deg: 0}}
"""


def drop(folder: Path, method: str, start: float = HEIGHT, **overrides: Any) -> dynsim.Scenario:
    """Of the mass; pulled up from LIFTS on."""
    return read(folder, DROP.replace("START", str(start)).replace("METHOD", method), **overrides)


def read(folder: Path, text: str, **overrides: Any) -> dynsim.Scenario:
    path = folder / "case.yaml"
    path.write_text(text)
    return dynsim.load_scenario(path, None, {key.replace("__", "."): value for key, value in overrides.items()})


@pytest.mark.parametrize("method", ["dopri5", "radau5", "time_stepping"])
def test_a_record_ends_with_a_sample_at_the_present_time(tmp_path, method):
    """Of a mass that coasts: steps of 0.02 s add up to a rounding before or after the times asked for."""
    scenario, lost = read(tmp_path, COASTS.replace("METHOD", method)), []
    start = dynsim.State(0.0, np.ones(1), np.array([0.1]), np.zeros(0))
    # Multiples of a step, and of 0.1 s as they are summed up.
    for time in [*np.round(np.arange(0.1, 2.0, 0.1), 3).tolist(), *np.cumsum(np.full(19, 0.1)).tolist()]:
        simulation = dynsim.Simulation(scenario, state=start, duration=2.0)
        simulation.advance(time)
        record = simulation.record()
        if len(record) != round(50 * time) + 1 or record.time[-1] != pytest.approx(time, abs=1e-12):
            lost.append(time)
        else:
            assert record["q"][-1, 0] == pytest.approx(1.0 + 0.1 * time, rel=1e-12)
    assert not lost


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_sample_where_a_load_bends_is_there(tmp_path, method):
    """The step to it ends some roundings before it."""
    simulation = dynsim.Simulation(drop(tmp_path, method))
    simulation.advance(LIFTS)
    assert simulation.record().time[-1] == pytest.approx(LIFTS, abs=1e-12)


@pytest.mark.parametrize("method", ["dopri5", "radau5", "time_stepping"])
@pytest.mark.parametrize("time", [0.05, 0.3333])
def test_a_mass_at_rest_is_closed_all_the_time(tmp_path, method, time):
    """In the middle of a step too, whose rows are there: m g, and impulses of that."""
    simulation = dynsim.Simulation(drop(tmp_path, method, 0.0))
    simulation.advance(time)
    (foot,) = simulation.record().summary["contacts"]
    assert foot["closed_fraction"] == pytest.approx(1.0, abs=1e-12)
    assert foot["normal_force_mean_N"] == pytest.approx(MASS * G, rel=1e-9)


def test_a_mass_at_rest_is_closed_all_the_time_beside_encoders(tmp_path):
    (tip,) = dynsim.simulate(read(tmp_path, ENCODED)).summary["contacts"]
    assert tip["closed_fraction"] == pytest.approx(1.0, abs=1e-12)


def test_a_glued_contact_pulls_all_the_time(tmp_path):
    """A hanging mass, in the middle of a step."""
    simulation = dynsim.Simulation(drop(tmp_path, "dopri5", 0.0, contacts__law="bilateral"))
    simulation.set_wrench("link_1", [0.0, 0.0, 2.0 * MASS * G])
    simulation.advance(0.0333)
    (foot,) = simulation.record().summary["contacts"]
    assert foot["pulling_fraction"] == pytest.approx(1.0, abs=1e-12)
