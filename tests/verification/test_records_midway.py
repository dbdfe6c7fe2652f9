"""Records in the middle of a run: their last sample, and the one interval that all of their summary is of."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.errors import ScenarioError

G, MASS, HEIGHT = 9.81, 2.0, 0.2
# A mass falls to the floor and stays there until it is pulled off.
LANDS, LIFTS, PULL = math.sqrt(2.0 * HEIGHT / G), 0.7, 50.0
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
@pytest.mark.parametrize("time", [0.0195, 0.05, 0.3333])
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


def landed(record: dynsim.Record, end: float, until: float) -> None:
    """The summary is of the run up to ``end``, of which the mass stood on the floor until a time."""
    summary, (foot,) = record.summary, record.summary["contacts"]
    assert summary["duration_s"] == pytest.approx(end, abs=1e-9)
    assert foot["closed_fraction"] == pytest.approx((until - LANDS) / end, rel=1e-6)
    # With the impact, the floor has taken all the momentum that gravity gave.
    assert foot["normal_force_mean_N"] == pytest.approx(MASS * G * until / end, rel=1e-6)
    energy = MASS * G * HEIGHT
    assert foot["impact_loss_J"] == pytest.approx(energy, rel=1e-6)
    assert summary["impact_loss_J"] == pytest.approx(energy, rel=1e-6)
    assert foot["landings"] == 1
    assert foot["lift_offs"] == (until < end)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("passing", [True, False])
def test_samples_that_end_are_those_of_a_run_that_ends_there(tmp_path, method, passing):
    """However far the run goes on, and whatever is added to it or rewritten in it."""
    scenario = drop(tmp_path, method)
    simulation = dynsim.Simulation(scenario, duration=math.inf)
    simulation.advance(0.55)
    simulation.end_samples(0.6)
    if not passing:
        simulation.advance(0.6)
    else:
        simulation.advance(0.65)
        simulation.every(0.1, lambda s: s.set_wrench("link_1", [0.0, 0.0, 1.0]))
        simulation.advance(1.0)
    record, ends = simulation.record(), dynsim.simulate(drop(tmp_path, method, duration_s=0.6))
    landed(record, 0.6, 0.6)
    assert simulation.time == (1.0 if passing else 0.6)
    np.testing.assert_array_equal(record.time, ends.time)
    np.testing.assert_allclose(record["q"], ends["q"], rtol=0.0, atol=1e-12)
    assert [(event.kind, event.name) for event in record.events] == [(event.kind, event.name) for event in ends.events]
    assert set(record.summary) == set(ends.summary)
    assert "hand" not in record.summary["loads_work_J"]
    assert record.labels["work_loads"] == ends.labels["work_loads"]


def test_samples_that_have_ended_cannot_go_on(tmp_path):
    """The samples in between would be missing; a snapshot of before has them to come."""
    simulation = dynsim.Simulation(drop(tmp_path, "dopri5"))
    simulation.end_samples(0.6)
    simulation.advance(0.5)
    before = simulation.snapshot()
    simulation.advance(1.0)
    with raises(ScenarioError, "0.6 s"):
        simulation.end_samples(1.5)
    simulation.restore(before)
    simulation.end_samples(0.65)
    simulation.advance(1.0)
    landed(simulation.record(), 0.65, 0.65)


def test_samples_that_a_callback_ends(tmp_path):
    simulation, ended = dynsim.Simulation(drop(tmp_path, "dopri5")), []

    def end(s: dynsim.Simulation) -> None:
        if not ended:
            ended.append(s.time)
            s.end_samples(0.6)

    simulation.every(0.5, end, first=0.5)
    simulation.advance(1.9)
    landed(simulation.record(), 0.6, 0.6)


@pytest.mark.parametrize("trace", [None, 0])
@pytest.mark.parametrize("rate", [50, 3])
def test_a_run_between_two_samples_is_told_up_to_its_time(tmp_path, rate, trace):
    """At a low rate of samples, or none: at a time asked for, and where an event ends the run, a height above the floor
    that the mass passes at LIFTS + √(2 z/a)."""
    scenario, acceleration = drop(tmp_path, "dopri5", record__rate_hz=rate), PULL / MASS - G
    simulation = dynsim.Simulation(scenario, trace=trace)
    simulation.watch("joint_position", "joint_1", 0.25, direction=1, stop=True)
    simulation.advance(0.63)
    landed(simulation.record(), 0.63, 0.63)
    simulation.advance(2.0)
    stopped, record = LIFTS + math.sqrt(2.0 * 0.25 / acceleration), simulation.record()
    assert simulation.time == pytest.approx(stopped, abs=1e-5)
    landed(record, simulation.time, LIFTS)
    assert record.summary["loads_work_J"]["crane"] == pytest.approx(PULL * 0.25, rel=1e-4)


def test_the_events_of_a_ring_are_those_within_it(tmp_path):
    """Those after its last sample are of a time that its fractions are not of."""
    simulation = dynsim.Simulation(drop(tmp_path, "dopri5", record__rate_hz=5), trace=2)
    simulation.advance(0.75)
    record = simulation.record()
    (foot,) = record.summary["contacts"]
    np.testing.assert_allclose(record.time, [0.4, 0.6])
    assert (foot["closed_fraction"], foot["lift_offs"], record.events) == (1.0, 0, [])
    assert record.summary["duration_s"] == pytest.approx(0.2)
