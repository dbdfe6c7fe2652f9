"""Encoders of an arm with a sampled controller: resolution, delay, noise, rates by differences; refusals."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from support.messages import lines_with, raises

from dynsim import Simulation, check, load_scenario, simulate
from dynsim.engine import stopping
from dynsim.errors import ModelError, ScenarioError, SimulationStopped
from dynsim.integrators import run as ki
from dynsim.record import Record

PERIOD = 2e-3
RESOLUTION = np.radians(360.0 / 4096.0)
# Records take states at ticks from the dense output of the steps that end there.
ROUNDING = 1e-14
ARM = f"""
duration_s: 0.6
plant:
  type: serial_arm
  link: {{length_m: 0.3, mass_kg: 0.5, motor: {{type: wang_minami}}}}
  chain: [{{count: 2}}, {{kind: prismatic}}]
  gravity_m_s2: [0, 0, 0]
controller:
  type: joint_pd
  k_p_V_per_rad: 60
  k_d_V_s_per_rad: 2
  sample_time_s: {PERIOD}
  joints:
    joint_1: {{times_s: [0, 0.5], angles_deg: [0, 40]}}
    joint_2: {{times_s: [0, 0.5], angles_deg: [0, -30]}}
    joint_3: {{times_s: [0, 0.5], positions_m: [0, 0.1]}}
record: {{rate_hz: 500}}
metrics: {{settle_s: 0}}
"""


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(ARM)

    def of(encoders=None, **overrides) -> Record:
        sensors = {} if encoders is None else {"sensors.encoders": encoders}
        return simulate(load_scenario(path, None, sensors | {k.replace("__", "."): v for k, v in overrides.items()}))

    return of


def test_encoders_that_tell_all_at_once_change_nothing(run):
    """Bit for bit, where the law has no rates; with rates by differences they come half a period late."""
    no_rates = {"controller__k_d_V_s_per_rad": 0}
    plain, encoded = run(**no_rates), run({"resolution_deg": 0}, **no_rates)
    assert set(encoded) - set(plain) == {"q_measured"}
    for name in plain:
        assert plain[name].tobytes() == encoded[name].tobytes(), name
    np.testing.assert_allclose(encoded["q_measured"][:-1], encoded["q"][:-1], rtol=0.0, atol=ROUNDING)
    late = np.abs(run({"resolution_deg": 0})["q"] - run()["q"]).max()
    assert 0.0 < late < 2e-3


def test_what_is_told_is_rounded_to_the_resolution(run):
    record = run({"resolution_m": 1e-3})
    measured, true = record["q_measured"], record["q"]
    for joint, step in enumerate((RESOLUTION, RESOLUTION, 1e-3)):
        np.testing.assert_allclose(measured[:, joint] / step, np.rint(measured[:, joint] / step), atol=1e-9)
        error = np.abs(measured[:-1, joint] - true[:-1, joint])
        assert 0.3 * step < error.max() <= 0.5 * step * (1.0 + 1e-9)


@pytest.mark.parametrize("delay", [PERIOD, 5 * PERIOD, 2.5 * PERIOD])
def test_the_controller_sees_the_joints_of_a_delay_before(run, delay):
    """At a tick the last sample that has arrived; of half periods it is that of the tick before."""
    record = run({"resolution_deg": 0, "delay_s": delay})
    ticks = int(np.ceil(delay / PERIOD - 1e-9))
    np.testing.assert_allclose(record["q_measured"][ticks:-1], record["q"][: -1 - ticks], rtol=0.0, atol=ROUNDING)
    np.testing.assert_array_equal(record["q_measured"][:ticks], np.tile(record["q"][0], (ticks, 1)))


def test_slow_encoders_hold_their_last_sample(run):
    record = run({"resolution_deg": 0, "rate_hz": 100})
    held = np.arange(len(record)) // 5 * 5  # 100 Hz of 500
    np.testing.assert_allclose(record["q_measured"][:-1], record["q"][held][:-1], rtol=0.0, atol=ROUNDING)


def test_noise_has_its_deviation_and_comes_from_the_seed(run):
    """A hundredth of a degree, white: mean, deviation and the correlation of neighbours within four standard errors."""
    noisy = {"resolution_deg": 0, "noise_deg": 0.01, "noise_m": 1e-4}
    record, again = run(noisy, duration_s=3.0), run(noisy, duration_s=3.0)
    np.testing.assert_array_equal(record["q_measured"], again["q_measured"])
    other = run(noisy, duration_s=3.0, sensors__seed=1)
    assert (record["q_measured"] != other["q_measured"]).all()
    deviation = np.array([np.radians(0.01), np.radians(0.01), 1e-4])
    x = (record["q_measured"] - record["q"])[:-1] / deviation
    error = 1.0 / np.sqrt(len(x))
    assert np.abs(x.mean(axis=0)).max() < 4.0 * error
    assert np.abs(x.std(axis=0) - 1.0).max() < 4.0 * error / np.sqrt(2.0)
    assert np.abs((x[1:] * x[:-1]).mean(axis=0)).max() < 4.0 * error


def test_rates_are_differences_of_samples(run):
    """u = k_d (v_d − v̂) held from tick to tick, with v̂ = (q̂_k − q̂_(k−1))/T."""
    push = {"type": "samples", "body": "link_3", "times_s": [0, 0.6], "force_N": [[0, 0, 0], [5, 0, 0]]}
    still = {"controller__k_p_V_per_rad": 0, "controller__joints": {}}
    pushed = run({"rate_hz": 250}, loads__push=push, **still)
    measured = pushed["q_measured"]
    sampled = np.arange(len(measured)) // 2 * 2  # every second tick
    rate = (measured[sampled] - measured[np.maximum(sampled - 2, 0)]) / (2 * PERIOD)
    assert np.abs(rate).max() > 0.1
    np.testing.assert_allclose(pushed["voltage"], -2.0 * rate, atol=1e-9)


def test_a_snapshot_has_the_same_future(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(ARM)
    encoders = {"noise_deg": 0.05, "delay_s": 0.007}
    simulation = Simulation(load_scenario(path, None, {"sensors.encoders": encoders}))
    simulation.advance(0.2)
    before = simulation.snapshot()
    first = simulation.advance(0.4)
    simulation.restore(before)
    again = simulation.advance(0.4)
    np.testing.assert_array_equal(first.q, again.q)
    np.testing.assert_array_equal(first.current, again.current)


@pytest.mark.parametrize(
    ("changes", "line", "names"),
    [
        ({"controller.sample_time_s": None}, 2, ["sensors.encoders", "controller.sample_time_s"]),
        ({"controller": None}, 2, ["sensors.encoders"]),
        ({"sensors.motion_capture": {}}, 0, ["sensors.motion_capture", "sensors.encoders"]),
    ],
)
def test_sensors_that_nobody_reads_are_refused_where_they_stand(tmp_path, changes, line, names):
    path = tmp_path / "arm.yaml"
    path.write_text("sensors:\n  encoders: {delay_s: 0.01}\n" + ARM)
    at = f"arm.yaml:{line}" if line else "overrides"
    with raises(ModelError, at, *names):
        simulate(load_scenario(path, None, changes))


def test_encoders_of_a_plant_without_motors_tell_nothing(tmp_path):
    path = tmp_path / "pendulum.yaml"
    path.write_text(PENDULUM)
    scenario = load_scenario(path)
    assert lines_with(check(scenario).warnings, "sensors.encoders")
    assert simulate(scenario)["q_measured"].shape == (11, 0)


PENDULUM = """
duration_s: 0.05
plant: {type: serial_arm, chain: [{length_m: 0.3, mass_kg: 0.5}]}
controller: {type: joint_pd, sample_time_s: 0.002}
sensors: {encoders: {}}
"""


def test_a_run_that_ends_between_samples_has_one_at_its_end(run):
    """As every run; the time is no tick, no sample of the rate, and not where a step would have ended."""
    record = run({"resolution_deg": 0}, duration_s=0.0237, controller__joints={})
    assert record.time[-1] == record.summary["duration_s"] == 0.0237
    np.testing.assert_array_equal(record.time[:-1], np.arange(12) / 500.0)
    np.testing.assert_array_equal(record["q_measured"][-1], record["q_measured"][-2])


def test_pieces_of_a_run_that_ends_between_samples_are_the_run(run, tmp_path):
    encoders = {"resolution_deg": 0}
    record = run(encoders, duration_s=0.0237)
    scenario = load_scenario(tmp_path / "arm.yaml", None, {"sensors.encoders": encoders, "duration_s": 0.0237})
    simulation = Simulation(scenario, duration=math.inf)
    simulation.advance(0.0031)
    kept = simulation.snapshot()
    simulation.end_samples(0.0101)
    simulation.advance(0.0101)
    assert simulation.record().time[-1] == 0.0101
    simulation.restore(kept)
    simulation.end_samples(scenario.duration_s)
    simulation.advance(scenario.duration_s)
    pieces = simulation.record(scenario)
    for name in record:
        assert record[name].tobytes() == pieces[name].tobytes(), name
    with raises(ScenarioError, "0.01 s", re.compile(r"\b0\.0237\d* s")):
        simulation.end_samples(0.01)


def test_a_run_that_stops_before_its_first_tick_says_why(run, monkeypatch):
    """Where there are no forces at the start, encoders have told nothing yet."""

    def stop_at_once(prepared, *_):
        prepared.run.count[ki.STATUS] = ki.NOT_FINITE
        return prepared, None

    monkeypatch.setattr(stopping, "advance", stop_at_once)
    with pytest.raises(SimulationStopped) as stop:
        run({})
    assert len(stop.value.record) == 0
    assert stop.value.record["q_measured"].shape == (0, 3)
