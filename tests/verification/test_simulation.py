"""Stepped simulations: equality with a run in one go, rewritten references and wrenches, events, ticks, snapshots."""

from __future__ import annotations

import itertools
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import ellipkinc
from support.messages import check_message, raises

import dynsim
from dynsim.errors import ModelError, ScenarioError

G = 9.81
PENDULUM = """
duration_s: 5.0
plant:
  type: serial_arm
  chain: [{axis: y, mass_kg: 0.3, length_m: 1.0, radius_m: 0.001, initial_deg: 120}]
integrator: {method: METHOD, rtol: 1.0e-12, atol: 1.0e-14}
record: {rate_hz: 20}
"""
WHEEL = """
duration_s: 0.5
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain: [{axis: z, mass_kg: 0.8, length_m: 0.3, motor: {type: wang_minami}}]
controller:
  type: joint_pd
  k_p_V_per_rad: 20
  k_d_V_s_per_rad: 1
  joints: {joint_1: {times_s: [0, 0.4], angles_deg: [0, 60]}}SAMPLED
integrator: {rtol: 1.0e-11, atol: 1.0e-13}
record: {rate_hz: 200}
metrics: {settle_s: 0}
"""


def read(folder: Path, text: str) -> dynsim.Scenario:
    path = folder / "case.yaml"
    path.write_text(text)
    return dynsim.load_scenario(path)


def arm(**overrides: object) -> dynsim.Scenario:
    return dynsim.load_scenario("elbow_comparison", "two_elbows", {"duration_s": 2.0, **overrides})


def same(a: dynsim.Record, b: dynsim.Record) -> bool:
    return set(a) == set(b) and all(a[name].tobytes() == b[name].tobytes() for name in a)


@pytest.mark.parametrize("overrides", [{}, {"controller.sample_time_s": 2e-4, "duration_s": 0.1}])
def test_a_run_in_pieces_is_that_in_one_go_bit_for_bit(overrides):
    scenario = arm(**overrides)
    whole, simulation = dynsim.simulate(scenario), dynsim.Simulation(scenario)
    rng, t = np.random.default_rng(0), 0.0
    while not simulation.finished:
        t += rng.uniform(0.0, 0.1)
        state = simulation.advance(t)
        assert state.time == min(t, scenario.duration_s)
    record = simulation.record()
    assert same(whole, record)
    assert record.complete
    wall = ("integration_wall_s", "real_time_factor")
    assert [whole.summary[k] == record.summary[k] for k in whole.summary if k not in wall].count(False) == 0


def test_a_state_between_the_steps_is_that_of_the_record():
    scenario = arm()
    whole, simulation = dynsim.simulate(scenario), dynsim.Simulation(scenario)
    for k in (7, 100, 263):
        state = simulation.advance(whole.time[k])
        # The samples are projected onto the contacts as well.
        np.testing.assert_allclose(state.q, whole["q"][k], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(state.current, whole["current"][k], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_snapshot_has_the_same_future(method):
    """Of an implicit method also with the Jacobian, factors and stages that it keeps."""
    simulation = dynsim.Simulation(arm(**{"integrator.method": method}))
    simulation.advance(0.7123)
    snapshot = simulation.snapshot()
    simulation.set_wrench("link_10", force=[0.0, 0.0, 20.0])
    simulation.set_reference("joint_1", 0.4)
    other = simulation.advance(1.5)
    simulation.restore(snapshot)
    first = simulation.advance(2.0)
    untouched = dynsim.simulate(arm(**{"integrator.method": method}))
    assert np.abs(other.q - untouched["q"][300]).max() > 1e-3
    np.testing.assert_array_equal(first.q, untouched["q"][-1])
    assert same(simulation.record(), untouched)
    with raises(ScenarioError):
        dynsim.Simulation(dynsim.load_scenario("single_pendulum")).restore(snapshot)


def test_a_snapshot_knows_whether_the_base_follows_its_path():
    simulation = dynsim.Simulation(dynsim.load_scenario("mobile_path"))
    simulation.advance(0.01)
    snapshot = simulation.snapshot()
    assert "base_target" in simulation.record(pictured=False)
    simulation.set_reference(simulation.robot.base.wheels[0], 0.4)
    assert "base_target" not in simulation.record(pictured=False)
    simulation.restore(snapshot)
    assert "base_target" in simulation.record(pictured=False)


def test_steps_that_end_where_references_bend_are_the_same_ones():
    """In pieces of any length, and again from a snapshot between two bends."""
    scenario = dynsim.load_scenario("wall_push")
    whole = dynsim.simulate(scenario)
    assert whole.summary["method"] == "radau5"
    simulation = dynsim.Simulation(scenario)
    for until in (0.19, 0.2, 0.21, 1.17):
        simulation.advance(until)
    snapshot = simulation.snapshot()
    for until in (*np.arange(1.2, 4.6, 0.17), 5.0):
        simulation.advance(until)
    assert same(simulation.record(), whole)
    simulation.restore(snapshot)
    np.testing.assert_array_equal(simulation.advance(5.0).q, whole["q"][-1])


def test_going_on_from_a_record_is_going_on():
    scenario = arm()
    whole = dynsim.simulate(scenario)
    state = dynsim.State.of(whole, 200)
    assert state.time == 1.0
    simulation = dynsim.Simulation(scenario, state=state)
    state = simulation.advance(2.0)
    # Another sequence of steps, at the default tolerance.
    np.testing.assert_allclose(state.q, whole["q"][-1], rtol=0.0, atol=1e-6)
    record = simulation.record()
    assert record.time[0] == 1.0
    assert record.summary["energy_residual_relative"] < 1e-6
    spent = whole["energy_electrical"][-1] - whole["energy_electrical"][200]
    assert record["energy_electrical"][-1] == pytest.approx(spent, rel=1e-5)


def test_a_record_reaches_up_to_the_present_time_and_leaves_the_future_alone():
    scenario = arm()
    whole, simulation = dynsim.simulate(scenario), dynsim.Simulation(scenario)
    simulation.advance(1.0)
    record = simulation.record()
    np.testing.assert_array_equal(record.time, whole.time[:201])
    np.testing.assert_allclose(record["q"], whole["q"][:201], rtol=0.0, atol=1e-8)
    assert not record.complete
    simulation.advance(2.0)
    assert same(simulation.record(), whole)


FREE = """<robot name="brick"><link name="the_world"/><link name="brick"><inertial><mass value="2"/>
<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="root" type="KIND"><parent link="the_world"/><child link="brick"/><axis xyz="0 0 1"/></joint></robot>"""


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_bodies_without_a_fixed_base_can_be_pushed(tmp_path, kind):
    """A push through the centre of mass: x = F t²/2 m, and the work is F x."""
    (tmp_path / "brick.urdf").write_text(FREE.replace("KIND", kind))
    text = "duration_s: 1\nplant: {type: urdf_arm, file: brick.urdf, gravity_m_s2: [0, 0, 0]}\n"
    simulation = dynsim.Simulation(read(tmp_path, text))
    simulation.every(0.1, lambda s: None)
    simulation.set_wrench("brick", force=[3.0, 0.0, 0.0])
    state = simulation.advance(1.0)
    assert simulation.finished
    assert state.q[0] == pytest.approx(0.75, abs=1e-9)
    record = simulation.record()
    assert record.complete
    assert record.summary["loads_work_J"] == {"brick": pytest.approx(2.25, abs=1e-9)}
    with raises(ModelError, "'brick.x'", "brick"):
        simulation.set_wrench("brick.x", force=[1.0, 0.0, 0.0])


@pytest.mark.parametrize("method", ["dopri5", "time_stepping"])
def test_a_state_within_a_step_has_unit_quaternions(tmp_path, method):
    """A brick turns at 6 rad/s about z: its quaternion is that of the angle ω t, not a mean of two."""
    (tmp_path / "brick.urdf").write_text(FREE.replace("KIND", "floating"))
    text = "duration_s: 1\nplant: {type: urdf_arm, file: brick.urdf, gravity_m_s2: [0, 0, 0]}\nMETHOD"
    keys = (
        "contacts: {law: unilateral}\nintegrator: {method: time_stepping, step_s: 0.002}"
        if method == "time_stepping"
        else ""
    )
    scenario = read(tmp_path, text.replace("METHOD", keys))
    q, v = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 6.0])
    simulation = dynsim.Simulation(scenario, state=dynsim.State(0.0, q, v, np.zeros(0)))
    for t in (0.0313, 0.3001, 0.4129):
        turned = simulation.advance(t).q[3:]
        assert np.linalg.norm(turned) == pytest.approx(1.0, abs=1e-15)
        # Steps of time stepping turn by 2 atan(ω h/2): half the angle is (ω h)²/12 of itself off, 1.5e-5 in the end.
        np.testing.assert_allclose(turned, [math.cos(3.0 * t), 0.0, 0.0, math.sin(3.0 * t)], rtol=0.0, atol=2e-5)


def test_going_on_from_a_record_with_motors_that_have_no_circuit(tmp_path):
    servo = "{type: servo, voltage_V: 12, stall_torque_N_m: 8, no_load_speed_rad_per_s: 5, k_p_V_per_rad: 40}"
    scenario = read(
        tmp_path,
        WHEEL.replace("SAMPLED", "")
        .replace("{type: wang_minami}", servo)
        .replace("  k_p_V_per_rad: 20\n  k_d_V_s_per_rad: 1\n", ""),
    )
    whole = dynsim.simulate(scenario)
    simulation = dynsim.Simulation(scenario, state=dynsim.State.of(whole, 40))
    np.testing.assert_allclose(simulation.advance(0.5).q, whole["q"][-1], rtol=0.0, atol=1e-8)


def test_a_run_without_end_keeps_the_last_samples_and_holds_its_references():
    scenario = arm(duration_s=1.0)
    simulation = dynsim.Simulation(scenario, duration=math.inf, trace=100)
    at_end = simulation.advance(1.0).q
    simulation.advance(4.0)
    record = simulation.record()
    assert len(record) == 100
    assert record.time[-1] >= 3.99
    assert not record.complete
    assert record.summary["energy_residual_relative"] < 1e-6
    # The hand has followed its path, and now stands.
    assert np.abs(record["v"][-1]).max() < 1e-2
    assert np.abs(record["q"][-1] - at_end).max() < 0.2
    none = dynsim.Simulation(scenario, trace=0)
    none.advance(1.0)
    assert len(none.record()) == 0


FLIPPER = """
duration_s: 1.2
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.1]}
  chain:
    - {axis: y, length_m: 0.3, mass_kg: 0.5, initial_deg: 80, limit_deg: [60, 150]}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.4, points: {tip: {body: link_1, point_m: [0, 0, 0.3]}}}
integrator: {METHOD}
record: {rate_hz: 1000}
"""


@pytest.mark.parametrize("method", ["method: dopri5", "method: time_stepping, step_s: 0.001"])
def test_the_summary_of_a_ring_is_that_of_its_samples(tmp_path, method):
    """An arm falls to the floor, and is twice pulled off and up to its stop: the ring has the second time alone."""
    times, up = [0.0, 0.3, 0.31, 0.5, 0.51, 0.8, 0.81, 1.0, 1.01, 1.2], [0, 0, 6, 6, 0, 0, 6, 6, 0, 0]
    pull = f"loads: {{pull: {{type: samples, body: link_1, point_m: [0, 0, 0.3], times_s: {times}, "
    pull += f"force_N: {[[0, 0, force] for force in up]}}}}}\n"
    scenario = read(tmp_path, FLIPPER.replace("METHOD", method) + pull)
    whole, ring = dynsim.Simulation(scenario), dynsim.Simulation(scenario, trace=500)
    for simulation in (whole, ring):
        simulation.advance(1.2)
    record, every = ring.record(), whole.record()
    (stop,), (stop_of_all,) = record.summary["joint_stops"], every.summary["joint_stops"]
    (touch,), (touch_of_all,) = record.summary["contacts"], every.summary["contacts"]
    assert [stop["hits"], touch["landings"], touch["lift_offs"]] == [1, 1, 1]
    assert [stop_of_all["hits"], touch_of_all["landings"], touch_of_all["lift_offs"]] == [2, 3, 2]
    # Each mode and each stop is closed once: by half a sample more or less at each of its ends.
    sample, closed = 1.5 / len(record), record["contact_mode"][:, 0] > 0.0
    assert touch["closed_fraction"] == pytest.approx(closed.mean(), abs=sample)
    assert touch["closed_fraction"] == touch["sticking_fraction"] + touch["sliding_fraction"]
    assert stop["closed_fraction"] == pytest.approx((record["stop_force"][:, 0] > 0.0).mean(), abs=sample)
    assert touch["normal_force_max_N"] == record["contact_normal_force"].max()
    assert touch["penetration_max_m"] == pytest.approx(max(-record["contact_gap"].min(), 0.0), abs=1e-15)
    assert record.events == [event for event in every.events if event.time >= record.time[0]]
    # How the losses share out is not known of a ring.
    assert "impact_loss_J" not in stop
    assert "impact_loss_J" not in touch
    # A ring that has lost nothing is a whole run.
    long = dynsim.Simulation(scenario, trace=5000)
    long.advance(1.2)
    effort = ("integration_wall_s", "real_time_factor")
    assert {**long.record().summary, **dict.fromkeys(effort)} == {**every.summary, **dict.fromkeys(effort)}


def test_a_wrench_that_is_set_is_the_load_of_a_scenario(tmp_path):
    push = "{type: constant, body: link_1, point_m: [0, 0, 0.2], force_N: [0.5, 0.1, -0.2], torque_N_m: [0, 0.1, 0]}"
    load = f"\nloads: {{push: {push}}}\n"
    text = PENDULUM.replace("METHOD", "dopri5")
    record = dynsim.simulate(read(tmp_path, text + load))
    simulation = dynsim.Simulation(read(tmp_path, text))
    simulation.set_wrench("link_1", force=[0.5, 0.1, -0.2], torque=[0.0, 0.1, 0.0], point=[0.0, 0.0, 0.2])
    simulation.advance(5.0)
    stepped = simulation.record()
    np.testing.assert_allclose(stepped["q"], record["q"], rtol=0.0, atol=1e-10)
    assert record.summary["loads_work_J"]["push"] == pytest.approx(stepped.summary["loads_work_J"]["link_1"], abs=1e-10)
    stored = sum(record[name][-1] - record[name][0] for name in ("energy_kinetic", "energy_potential"))
    assert record["work_loads"][-1, 0] == pytest.approx(stored, abs=1e-9)
    assert abs(record["work_loads"][-1, 0]) > 0.01
    free = dynsim.simulate(read(tmp_path, text))
    assert np.abs(free["q"] - record["q"]).max() > 0.1


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("length", [1e-3, 0.3])
def test_a_short_push_is_not_stepped_over(tmp_path, method, length):
    """An impulse of 1 N m s on a rod that nothing else turns, in a run whose steps are otherwise seconds long."""
    spinning = "{type: serial_arm, chain: [{axis: z, length_m: 1.0, mass_kg: 1, radius_m: 0.1}]}"
    torque = 1.0 / length
    push = (
        f"{{type: samples, body: link_1, times_s: [2, {2 + length}], torque_N_m: [[0, 0, {torque}], [0, 0, {torque}]]}}"
    )
    text = f"duration_s: 4\nplant: {spinning}\nloads: {{kick: {push}}}\nintegrator: {{method: {method}}}\n"
    scenario = read(tmp_path, text)
    inertia = dynsim.build_model(scenario).mass_matrix([0.0])[0, 0]
    record = dynsim.simulate(scenario)
    assert record["v"][-1, 0] == pytest.approx(1.0 / inertia, rel=1e-9)
    assert record.summary["loads_work_J"]["kick"] == pytest.approx(0.5 / inertia, rel=1e-6)
    assert record["v"][-1, 0] * (2.0 - 0.5 * length) == pytest.approx(record["q"][-1, 0], rel=1e-9)


def test_ticks_are_not_lost_when_something_is_rewritten_beside_them():
    simulation, times = dynsim.Simulation(dynsim.load_scenario("single_pendulum")), []
    simulation.every(0.1, lambda s: times.append(s.time))
    for k in range(1, 100):
        simulation.advance(round(0.1 * k, 1))
        simulation.set_wrench("link_1", force=[0.0, 0.0, 0.1])
    np.testing.assert_allclose(times, 0.1 * np.arange(100), atol=1e-14)


def test_a_snapshot_taken_in_a_callback_does_not_call_again():
    simulation, times, kept = dynsim.Simulation(dynsim.load_scenario("single_pendulum")), [], []

    def call(s: dynsim.Simulation) -> None:
        times.append(s.time)
        if s.time == 0.2:
            kept.append(s.snapshot())

    simulation.every(0.1, call)
    simulation.advance(0.45)
    simulation.restore(kept[0])
    simulation.advance(0.35)
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2, 0.3, 0.4, 0.3], atol=1e-15)


def test_a_motor_given_back_after_the_end_of_its_reference_holds_there():
    scenario = arm(duration_s=1.0)
    held, given_back = (dynsim.Simulation(scenario, duration=3.0, trace=0) for _ in range(2))
    for simulation in (held, given_back):
        simulation.advance(1.2)
    given_back.release("joint_1")
    np.testing.assert_allclose(given_back.advance(3.0).q, held.advance(3.0).q, rtol=0.0, atol=1e-6)


def test_a_rewritten_reference_takes_hold_at_once_and_can_be_given_back(tmp_path):
    scenario = read(tmp_path, WHEEL.replace("SAMPLED", ""))
    simulation, whole = dynsim.Simulation(scenario), dynsim.simulate(scenario)
    before = simulation.advance(0.2).q[0]
    simulation.set_reference("joint_1", 2.0, rate=-1.0)
    assert simulation.state.q[0] == pytest.approx(before, abs=1e-9)
    away = simulation.advance(0.3).q[0]
    assert away > whole["q"][60, 0] + 0.2
    simulation.release("joint_1")
    simulation.advance(0.5)
    record = simulation.record()
    assert record["q"][:40].tobytes() == whole["q"][:40].tobytes()
    u = np.interp(0.25, record.time, record["voltage"][:, 0])
    k = 50
    assert u == pytest.approx(20.0 * (2.0 - 0.05 - record["q"][k, 0]) + 1.0 * (-1.0 - record["v"][k, 0]), abs=1e-6)
    simulation = dynsim.Simulation(scenario)
    simulation.set_command("joint_1", 3.0)
    simulation.advance(0.5)
    np.testing.assert_array_equal(simulation.record()["voltage"], 3.0)


def test_a_sampled_controller_is_its_closed_form(tmp_path):
    """x_{k+1} = e^{AT} x_k + ∫ e^{As} ds B u_k for x = (q, v, i), u_k = k_p (q_d − q_k) + k_d (v_d − v_k), 200 Hz."""
    scenario = read(tmp_path, WHEEL.replace("SAMPLED", "\n  sample_time_s: 0.005"))
    record = dynsim.simulate(scenario)
    model = dynsim.build_model(scenario)
    motor = model.robot.motors[0]
    k = motor.gear_ratio
    K, R, L = motor.torque_constant * k, motor.resistance, motor.inductance
    inertia = model.mass_matrix(model.robot.initial)[0, 0] + motor.rotor_inertia * k**2
    loss = model.damping[0]
    A = np.array([[0.0, 1.0, 0.0], [0.0, -loss / inertia, K / inertia], [0.0, -K / L, -R / L]])
    block = np.zeros((4, 4))
    block[:3, :3], block[2, 3] = A, 1.0 / L
    step = expm(0.005 * block)
    control = dynsim.scenario.build.controller(scenario, model)
    coefficients, spacing = control.reference.coefficients[:, 0], control.reference.grid[1]
    x, computed = np.array([model.robot.initial[0], 0.0, 0.0]), []
    for sample in range(101):
        computed.append(x)
        t = 0.005 * sample
        segment = min(int(t / spacing), len(coefficients) - 1)
        c = np.polynomial.Polynomial(coefficients[segment])
        u = 20.0 * (c(t - segment * spacing) - x[0]) + 1.0 * (c.deriv()(t - segment * spacing) - x[1])
        x = step[:3, :3] @ x + step[:3, 3] * u
    computed = np.array(computed)
    signals = np.stack([record["q"][:, 0], record["v"][:, 0], record["current"][:, 0]], axis=1)
    # A hundred tolerances of the integration, per size of the state.
    assert np.abs(signals - computed).max() < 1e-9 * np.abs(computed).max()
    continuous = dynsim.simulate(read(tmp_path, WHEEL.replace("SAMPLED", "")))
    assert np.abs(continuous["q"][:, 0] - computed[:, 0]).max() > 1e-4

    # The same law in Python, at the ticks of the caller.
    def law(simulation: dynsim.Simulation) -> None:
        t, state = simulation.time, simulation.state
        segment = min(int(t / spacing), len(coefficients) - 1)
        c = np.polynomial.Polynomial(coefficients[segment])
        error, rate = c(t - segment * spacing) - state.q[0], c.deriv()(t - segment * spacing) - state.v[0]
        simulation.set_command("joint_1", 20.0 * error + 1.0 * rate)

    simulation = dynsim.Simulation(read(tmp_path, WHEEL.replace("SAMPLED", "")))
    simulation.every(0.005, law)
    simulation.advance(0.5)
    np.testing.assert_allclose(simulation.record()["q"][:, 0], computed[:, 0], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_the_time_of_an_event_is_that_of_the_closed_form(tmp_path, method):
    """A rod let go at θ0 = 120° from hanging down is at θ after √(I/(m g l)) F(…): incomplete elliptic integrals."""
    scenario = read(tmp_path, PENDULUM.replace("METHOD", method))
    model = dynsim.build_model(scenario)
    inertia, lever = model.mass_matrix([0.0])[0, 0], 0.3 * 0.5
    omega = np.sqrt(G * lever / inertia)
    # The chain stands upright at q = 0 and hangs at q = π.
    modulus = math.sin(0.5 * (math.pi - math.radians(120.0)))

    def time_of(angle: float) -> float:
        """Down from rest to an angle on the way to the bottom, both from hanging [rad]."""
        phi = math.asin(min(math.sin(0.5 * angle) / modulus, 1.0))
        quarter, part = ellipkinc(0.5 * math.pi, modulus**2), ellipkinc(phi, modulus**2)
        return float((quarter - part) / omega)

    simulation = dynsim.Simulation(scenario)
    for level in (2.5, math.pi):
        simulation.watch("joint_position", "joint_1", level)
    simulation.watch("joint_rate", "joint_1", 0.0, direction=-1)
    simulation.advance(1.2)
    event_times = {(occurrence.kind, k): occurrence.time for k, occurrence in enumerate(simulation.happened)}
    times = [occurrence.time for occurrence in simulation.happened]
    assert times == sorted(times)
    assert times[0] == pytest.approx(time_of(math.pi - 2.5), abs=1e-10)
    assert times[1] == pytest.approx(time_of(0.0), abs=1e-10)
    # At rest on the other side after half a period, where the rate falls through zero; then down again.
    turned = next(time for (kind, _), time in event_times.items() if kind == "joint_rate")
    assert turned == pytest.approx(2.0 * time_of(0.0), abs=1e-9)
    record = simulation.record()
    assert [event.time for event in record.events] == times


THROW = """
duration_s: 2.0
plant: {type: serial_arm, chain: [{kind: prismatic, axis: z, mass_kg: 1.0, length_m: 0.1}]}
integrator: {method: METHOD}
"""


@pytest.mark.parametrize("above", [1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_level_just_below_the_top_of_a_throw_is_passed_twice(tmp_path, method, above):
    """At (v ∓ √(2 g a))/g, a below the top: within one step of a method whose steps are much longer."""
    scenario, speed = read(tmp_path, THROW.replace("METHOD", method)), 5.0
    begin = dynsim.State(0.0, np.zeros(1), np.array([speed]), np.zeros(0))
    level, half = speed**2 / (2.0 * G) - above, math.sqrt(2.0 * above / G)
    height = float(dynsim.simulate(scenario)["hand_position"][0, 2])
    # The rate at the level makes of rounding of the position one of the time.
    close = 1e-13 + 1e-14 / (G * half)
    simulation = dynsim.Simulation(scenario, state=begin)
    simulation.watch("joint_position", "joint_1", level)
    simulation.watch("hand_position", "z", height + level, direction=-1)
    simulation.advance(1.0)
    times = [(event.kind, event.time) for event in simulation.happened]
    rises, falls = speed / G - half, speed / G + half
    assert sorted(kind for kind, _ in times) == ["hand_position", "joint_position", "joint_position"]
    assert [time for kind, time in times if kind == "joint_position"] == pytest.approx([rises, falls], abs=close)
    assert [time for kind, time in times if kind == "hand_position"] == pytest.approx([falls], abs=close)
    stopped = dynsim.Simulation(scenario, state=begin)
    stopped.watch("joint_position", "joint_1", level, direction=1, stop=True)
    assert stopped.advance(2.0).time == pytest.approx(rises, abs=close)
    pieces = dynsim.Simulation(scenario, state=begin)
    pieces.watch("joint_position", "joint_1", level)
    pieces.watch("hand_position", "z", height + level, direction=-1)
    for t in np.linspace(0.1, 1.0, 7):
        pieces.advance(t)
    assert [(event.kind, event.time) for event in pieces.happened] == times


def test_events_have_a_direction_call_back_and_stop(tmp_path):
    scenario = read(tmp_path, PENDULUM.replace("METHOD", "dopri5"))
    simulation, seen = dynsim.Simulation(scenario), []
    simulation.watch("joint_position", "joint_1", math.pi, direction=-1, call=lambda s: seen.append(s.state))
    simulation.advance(5.0)
    assert len(seen) >= 2
    assert all(abs(state.q[0] - math.pi) < 1e-10 and state.v[0] < 0.0 for state in seen)
    simulation = dynsim.Simulation(scenario)
    simulation.watch("joint_position", "joint_1", math.pi, stop=True)
    state = simulation.advance(5.0)
    assert simulation.finished
    assert state.time < 1.0
    assert state.q[0] == pytest.approx(math.pi, abs=1e-10)
    assert simulation.record().time[-1] <= state.time
    assert simulation.advance(5.0).time == state.time


def test_an_event_of_a_contact_is_where_its_force_passes_zero():
    scenario = arm(duration_s=1.0)
    simulation, forces = dynsim.Simulation(scenario), []
    simulation.watch("contact_force", "elbow_4", 0.0, direction=-1)
    simulation.advance(1.0)
    (event, *_) = simulation.happened
    record = dynsim.simulate(arm(duration_s=1.0, **{"record.rate_hz": 20000}))
    force = record["contact_normal_force"][:, 0]
    k = int(np.flatnonzero((force[1:] < 0.0) & (force[:-1] >= 0.0))[0])
    assert record.time[k] <= event.time <= record.time[k + 1]
    forces.append(event)


def test_ticks_are_where_they_should_be_and_do_not_add_up_roundings():
    simulation, times = dynsim.Simulation(dynsim.load_scenario("single_pendulum")), []
    simulation.every(0.1, lambda s: times.append(s.time))
    simulation.every(0.3, lambda s: times.append(-s.time), first=0.2)
    simulation.advance(10.0)
    ours = [t for t in times if t >= 0.0]
    # Ticks at one time are one tick, so the last digit may be that of the other.
    np.testing.assert_allclose(ours, 0.1 * np.arange(len(ours)), rtol=4e-16)
    assert len(ours) == 101
    others = [-t for t in times if t < 0.0]
    np.testing.assert_allclose(others, 0.2 + 0.3 * np.arange(len(others)), rtol=4e-16)


@pytest.mark.parametrize(
    ("call", "error", "names"),
    [
        (lambda s: s.advance("x"), ScenarioError, ["'x'", "0 s"]),
        (lambda s: s.set_command("joint_1", "a"), ModelError, ["command", "['a']"]),
        (lambda s: s.advance(-1.0), ScenarioError, ["-1.0 s", "0 s"]),
        (lambda s: s.advance(math.nan), ScenarioError, ["nan s", "0 s"]),
        (lambda s: s.set_reference("joint_x", 0.0), ModelError, ["'joint_x'", "joint_1, joint_2"]),
        (lambda s: s.set_reference("joint_1", math.inf), ModelError, ["reference", "[[inf, 0.0]]"]),
        (lambda s: s.set_wrench("hand"), ModelError, ["'hand'", "link_1, link_2"]),
        (lambda s: s.set_wrench("link_1", force=[1.0]), ModelError, []),
        (lambda s: s.watch("angle", "joint_1"), ModelError, ["'angle'", "joint_position, joint_rate"]),
        (lambda s: s.watch("contact_gap", "toe"), ModelError, ["'toe'", "elbow_4, elbow_7"]),
        (lambda s: s.every(0.0, print), ScenarioError, ["1e-09 s", "0.0"]),
        (lambda s: s.every(1e-14, print), ScenarioError, ["1e-09 s", "1e-14"]),
        (lambda s: [s.every(1.0, print, first=9.0) for _ in range(61)], ScenarioError, ["60"]),
        (lambda s: (s.every(1.0, lambda t: t.advance(0.1)), s.advance(0.1)), ScenarioError, []),
        (lambda s: s.watch("joint_rate", "joint_1", math.nan), ModelError, ["level", "[nan]"]),
        (lambda s: s.restore(None), ScenarioError, ["None"]),
        (lambda s: s.restore(dynsim.Simulation(s.scenario).snapshot()), ScenarioError, []),
        (lambda s: dynsim.Simulation(s.scenario, trace=-1), ScenarioError, ["trace", "-1"]),
        (lambda s: dynsim.Simulation(s.scenario, state=7), ModelError, ["State", "7"]),
    ],
)
def test_wrong_calls_say_what_is_wrong(call, error, names):
    simulation = dynsim.Simulation(arm(duration_s=0.1))
    with raises(error, *names):
        call(simulation)


def test_states_of_other_robots_and_off_the_floor_are_refused():
    record = dynsim.simulate(dynsim.load_scenario("single_pendulum", overrides={"duration_s": 0.1}))
    with raises(ModelError, "1", "q", "serial_arm", "10"):
        dynsim.Simulation(arm(), state=dynsim.State.of(record))
    simulation = dynsim.Simulation(arm())
    state = simulation.state
    lifted = dynsim.State(0.0, state.q + 0.1, state.v, state.current)
    with raises(ModelError, "contacts.points.elbow_4", "floor", "elbow_7") as caught:
        dynsim.Simulation(arm(), state=lifted)
    assert "on_surface" not in str(caught.value)  # a state has a posture of its own
    with raises(ModelError, "snake", "kinematic"):
        dynsim.Simulation(dynsim.load_scenario("snake_circle"))


def test_a_state_starts_a_scenario_whose_own_posture_is_below_the_floor():
    sunk = arm(**{"controller": None, "plant.initial_deg": [0, 50, 90, -90, 45, 45, -90, 45, -45, 45]})
    with raises(ModelError, "contacts.points.elbow_4", "floor", "elbow_7", "on_surface"):
        dynsim.Simulation(sunk)
    state = dynsim.Simulation(arm()).state
    np.testing.assert_array_equal(dynsim.Simulation(sunk, state=state).state.q, state.q)


def real_arm(folder: Path, **overrides: object) -> dynsim.Scenario:
    """The published arm on a real floor."""
    text = (Path(__file__).parents[2] / "scenarios" / "elbow_comparison.yaml").read_text()
    for line in text.splitlines(keepends=True):
        if line.lstrip().startswith(("slip_smoothing_m_s", "pulling_friction")):
            text = text.replace(line, "")
    path = folder / "real.yaml"
    path.write_text(text.replace("law: bilateral", "law: unilateral"))
    return dynsim.load_scenario(path, "two_elbows", {"duration_s": 1.0, "contacts.friction": 0.3, **overrides})


def elbows(simulation: dynsim.Simulation) -> np.ndarray:
    """Their heights [m]."""
    q = simulation.state.q
    return np.array([simulation.model.point_position(body, np.zeros(3), q)[2] for body in ("link_4", "link_7")])


STEPPING = {"integrator.method": "time_stepping", "integrator.step_s": 1e-3}


@pytest.mark.parametrize(
    "integrator", [{}, STEPPING, pytest.param({"integrator.method": "radau5"}, marks=pytest.mark.slow)]
)
def test_a_snapshot_with_contacts_has_the_same_future(tmp_path, integrator):
    """Taken while points stick, and within a step; in between others land, slip and lift off."""
    simulation = dynsim.Simulation(real_arm(tmp_path, **integrator))
    simulation.advance(0.1237)
    snapshot = simulation.snapshot()

    def future() -> tuple[bytes, tuple]:
        simulation.set_wrench("link_7", force=[0.0, 0.0, 25.0])
        simulation.advance(0.3)
        simulation.set_wrench("link_7")
        return simulation.advance(0.8).q.tobytes(), simulation.happened

    first = future()
    simulation.restore(snapshot)
    assert future() == first
    if not integrator:
        assert {"lift_off", "landing"} <= {event.kind for event in first[1] if event.time > 0.13}


def test_a_wrench_that_is_rewritten_lifts_a_point_that_sticks(tmp_path):
    """Every millisecond, alternating: it leaves, and the floor never gives way."""
    simulation = dynsim.Simulation(real_arm(tmp_path))
    lowest, highest = [], []

    def push(s: dynsim.Simulation) -> None:
        up = math.sin(60.0 * s.time) > 0.0
        s.set_wrench("link_7", force=[0.0, 0.0, 25.0 if up else -5.0])
        lowest.append(elbows(s).min())
        highest.append(elbows(s)[1])

    simulation.every(1e-3, push)
    simulation.advance(1.0)
    assert min(lowest) > -1e-9
    assert max(highest) > 1e-4
    assert "lift_off" in [event.kind for event in simulation.happened if event.name == "elbow_7"]


def test_ticks_that_do_nothing_change_no_event(tmp_path):
    """Steps that end at ticks are shorter: events are where they were, to the tolerance of the integration."""
    runs = []
    for ticks in (False, True):
        simulation = dynsim.Simulation(real_arm(tmp_path, **{"integrator.rtol": 1e-9, "integrator.atol": 1e-11}))
        if ticks:
            simulation.every(7.3e-4, lambda s: None)
        simulation.advance(1.0)
        runs.append(simulation.happened)
    assert len(runs[0]) >= 2
    assert [(e.kind, e.name) for e in runs[0]] == [(e.kind, e.name) for e in runs[1]]
    np.testing.assert_allclose([e.time for e in runs[0]], [e.time for e in runs[1]], rtol=0, atol=1e-6)


@pytest.mark.parametrize("joints", [["joint_1"], ["joint_2"], ["joint_2", "joint_3"], ["joint_4", "joint_6"], None])
def test_brakes_close_and_open_on_an_arm_that_stands_on_the_floor(tmp_path, joints):
    """A braked joint does not move, the floor does not give way, nothing is pulled down or gains energy."""
    simulation = dynsim.Simulation(real_arm(tmp_path), trace=0)
    joints = list(simulation.robot.joint_names) if joints is None else joints
    index = [simulation.robot.joint_names.index(joint) for joint in joints]
    simulation.advance(0.05)
    simulation.set_wrench("link_7", force=[2.0, 1.0, -3.0])
    simulation.advance(0.0603)
    for joint in joints:
        simulation.set_brake(joint, True)
    held = simulation.state.q[index]
    for until in np.linspace(0.07, 0.4, 12):
        state = simulation.advance(until)
        np.testing.assert_allclose(state.q[index], held, rtol=0, atol=1e-13)
        assert elbows(simulation).min() > -1e-9
        assert np.isfinite(state.v).all()
    for joint in joints:
        simulation.set_brake(joint, False)
    assert elbows(simulation).min() > -1e-9
    simulation.advance(0.6)
    assert elbows(simulation).min() > -1e-9
    assert np.abs(simulation.state.q[index] - held).max() > 1e-9


def test_a_brake_that_closes_throws_a_point_off_the_floor_and_not_into_it(tmp_path):
    """The impulse of the brake and those of the floor together are those of one linear complementarity problem."""
    simulation = dynsim.Simulation(real_arm(tmp_path, **{"contacts.friction": 0.0}))
    simulation.advance(0.2)
    for joint, rate in (("joint_4", 3.0), ("joint_5", -3.0), ("joint_6", 2.0)):
        simulation.set_reference(joint, simulation.state.q[3], rate)
    simulation.advance(0.23)
    before = simulation.state
    model, armature = simulation.model, simulation.model.armature
    contacts = [body for body, height in zip(("link_4", "link_7"), elbows(simulation), strict=True) if height < 1e-9]
    J = np.array([model.point_position_and_jacobian(body, np.zeros(3), before.q)[1][2] for body in contacts])
    simulation.set_brake("joint_5", True)
    after = simulation.advance(0.23 + 1e-9)
    # e_j and the normals that press, by trying all sets.
    M = model.mass_matrix(before.q) + np.diag(armature)
    velocity = None
    for mask in range(1 << len(contacts)):
        rows = [k for k in range(len(contacts)) if mask >> k & 1]
        A = np.vstack([np.eye(10)[4], *J[rows]])
        impulse = np.linalg.solve(A @ np.linalg.solve(M, A.T), -A @ before.v)
        v = before.v + np.linalg.solve(M, A.T @ impulse)
        if (impulse[1:] >= -1e-12).all() and (J @ v >= -1e-9).all():
            velocity = v
            break
    assert abs(before.v[4]) > 1e-3
    np.testing.assert_allclose(after.v, velocity, rtol=0, atol=1e-5)


# By 13 knot distances the references of a run of this duration end a rounding before it.
ROUNDED = """
duration_s: 0.23151866400857443
plant:
  type: serial_arm
  link: {length_m: 0.3, mass_kg: 0.5, motor: {type: wang_minami}}
  chain: [{count: 2}]
controller: {type: joint_pd, joints: {joint_1: {times_s: [0, 0.05], angles_deg: [0, 4]}}}
record: {rate_hz: 500}
integrator: {method: dopri5}
metrics: {settle_s: 0}
"""


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_references_that_end_a_rounding_before_the_run_do_not_cut_its_last_step(tmp_path, method):
    path = tmp_path / "rounded.yaml"
    path.write_text(ROUNDED)
    scenario = dynsim.load_scenario(path, overrides={"integrator.method": method})
    simulation = dynsim.Simulation(scenario)
    assert simulation._prepared.control.end < scenario.duration_s
    simulation.advance(0.1)
    before = simulation.snapshot()
    simulation.advance(0.2)
    simulation.restore(before)
    simulation.advance(scenario.duration_s)
    whole, pieces = dynsim.simulate(scenario), simulation.record()
    assert whole.time[-1] == scenario.duration_s
    for name in whole:
        assert whole[name].tobytes() == pieces[name].tobytes(), name
    assert whole.summary["steps"] == pieces.summary["steps"]


LIFTED = """
duration_s: 0.3
plant:
  type: serial_arm
  chain: [{axis: y, mass_kg: 0.8, length_m: 0.3, initial_deg: 60, motor: {type: wang_minami}}]
controller:
  type: joint_pd
  feed_forward: PLAN
  joints: {joint_1: {times_s: [0, 0.2], angles_deg: [60, 75]}}SAMPLED
"""


@pytest.mark.parametrize("sampled", ["", "\n  sample_time_s: 0.001"])
@pytest.mark.parametrize("plan", ["gravity", "dynamics"])
def test_planned_voltages_hold_after_the_end_of_the_scenario(tmp_path, plan, sampled):
    """As references do: the arm stands where its path ends; its last voltage is that of its weight."""
    scenario = read(tmp_path, LIFTED.replace("PLAN", plan).replace("SAMPLED", sampled))
    simulation = dynsim.Simulation(scenario, duration=1.5)
    simulation.advance(1.5)
    record = simulation.record()
    assert np.degrees(record["q"][-1, 0]) == pytest.approx(75.0, abs=0.01)
    assert abs(record["v"][-1, 0]) < 1e-4


@pytest.mark.parametrize("sampled", ["", "\n  sample_time_s: 0.001"])
def test_a_rewritten_reference_has_no_planned_voltages(tmp_path, sampled):
    """Turning at a constant rate the plan is the back-EMF; a joint that is told to stand is free of it.

    Without gravity it comes to rest at its reference. Given back, it has the bits of its plan again.
    """
    text = WHEEL.replace("SAMPLED", "\n  feed_forward: dynamics" + sampled).replace(
        "duration_s: 0.5", "duration_s: 4.0"
    )
    scenario = read(
        tmp_path, text.replace("times_s: [0, 0.4], angles_deg: [0, 60]", "times_s: [0, 4], angles_deg: [0, 600]")
    )
    simulation = dynsim.Simulation(scenario)
    simulation.advance(1.0)
    before = simulation.snapshot()
    simulation.set_reference("joint_1", 2.0)
    assert simulation.advance(3.5).q[0] == pytest.approx(2.0, abs=1e-6)
    simulation.restore(before)
    simulation.set_reference("joint_1", 2.0)
    simulation.release("joint_1")
    untouched = dynsim.Simulation(scenario)
    untouched.advance(1.0)
    # The same restart, with nothing rewritten.
    untouched.release("joint_1")
    np.testing.assert_array_equal(simulation.advance(3.5).q, untouched.advance(3.5).q)


def test_the_target_of_the_hand_holds_where_the_references_do(tmp_path):
    """A path that goes on after the scenario: a quarter of a circle in 1 s, then the hand and its target stand."""
    scenario = arm(duration_s=1.0, **{"record.rate_hz": 100})
    simulation = dynsim.Simulation(scenario, duration=2.0)
    simulation.advance(2.0)
    record = simulation.record()
    whole = dynsim.simulate(scenario)
    assert record["target_position"][:101].tobytes() == whole["target_position"].tobytes()
    target = record["target_position"]
    assert np.abs(target[100] - target[90]).max() > 1e-3
    np.testing.assert_allclose(target[101:], np.tile(target[100], (100, 1)), rtol=0.0, atol=1e-12)


TWO_LINKS = """
duration_s: 1.0
plant:
  type: serial_arm
  chain:
  - {axis: y, initial_deg: 60, length_m: 0.5, mass_kg: 1.0, motor: {type: wang_minami}}
  - {axis: y, length_m: 0.4, mass_kg: 0.5, motor: {type: wang_minami}}
integrator: {method: METHOD}
"""
# Turns at 1 rad/s; at t = 0.1 s it passes 0.1 rad.
TURNING = """
duration_s: 1.0
plant: {type: serial_arm, gravity_m_s2: [0, 0, 0], chain: [{axis: z, mass_kg: 0.8, length_m: 0.3}]}
"""
DRIVEN_TO = """
controller:
  type: joint_pd
  k_p_V_per_rad: 200
  k_d_V_s_per_rad: 5
  joints: {joint_1: {times_s: [0, 1], angles_deg: [60, 90]}}SAMPLED
"""
OPERATED = """
controller:
  type: joint_pd
  k_p_V_per_rad: 200
  k_d_V_s_per_rad: 5
  operator: {joints: [joint_1, joint_2], rate_hz: 50, commands: [{at_s: 0.05, hand: [0, 0, 0.1]}]}
"""


def turning(folder: Path) -> dynsim.Simulation:
    scenario = read(folder, TURNING)
    return dynsim.Simulation(scenario, state=dynsim.State(0.0, np.zeros(1), np.ones(1), np.zeros(0)))


def swing(s: dynsim.Simulation) -> None:
    s.set_command("joint_1", 20.0 * math.sin(30.0 * s.time) - 2.0 * s.state.v[0] + (100.0 if s.time < 0.11 else 0.0))


def push(s: dynsim.Simulation) -> None:
    s.set_wrench("link_2", force=[0.0, 0.0, 10.0 * math.cos(20.0 * s.time)])


def assert_same_futures(simulation: dynsim.Simulation, kept: list, calls: list, until: float) -> None:
    """Of all snapshots, each with the number of calls before it; ``calls`` are filled by the callbacks."""
    end, happened, before = simulation.advance(until), simulation.happened, list(calls)
    record = simulation.record(pictured=False)
    assert kept
    for snapshot, number in list(kept):
        calls.clear()
        simulation.restore(snapshot)
        again = simulation.advance(until)
        np.testing.assert_array_equal(again.q, end.q)
        np.testing.assert_array_equal(again.v, end.v)
        assert calls == before[number:]
        assert simulation.happened == happened
        assert same(simulation.record(pictured=False), record)


@pytest.mark.parametrize(
    ("method", "order"),
    [
        *(("dopri5", order) for order in itertools.permutations(("keep", "swing", "push"))),
        ("radau5", ("swing", "keep", "push")),
        ("time_stepping", ("swing", "keep", "push")),
    ],
)
def test_a_snapshot_in_a_callback_knows_what_else_is_due(tmp_path, method, order):
    """In every order of callbacks; of two snapshots in one tick too."""
    law = "contacts: {law: unilateral}\n" if method == "time_stepping" else ""
    simulation = dynsim.Simulation(read(tmp_path, TWO_LINKS.replace("METHOD", method) + law))
    kept, calls = [], []

    def called(name: str, s: dynsim.Simulation) -> None:
        calls.append((name, s.time))
        if name != "keep":
            {"swing": swing, "push": push}[name](s)
        elif 0.09 < s.time < 0.13 and len(kept) < 4:
            kept.extend((s.snapshot(), len(calls)) for _ in range(2))

    for name in order:
        simulation.every(0.02, partial(called, name))
    assert_same_futures(simulation, kept, calls, 0.3)


def test_a_snapshot_at_an_event_knows_the_other_events_and_ticks_of_that_time(tmp_path):
    """Two guards with callbacks, one that is only logged, and two ticks, all at one time."""
    simulation, kept, calls = turning(tmp_path), [], []

    def called(name: str, s: dynsim.Simulation) -> None:
        calls.append((name, s.time))
        s.set_wrench("link_1", torque=[0.0, 0.0, 0.01 * len(name) * s.time])
        if 0.09 < s.time < 0.11:
            assert [event.kind for event in s.happened] == ["joint_position"] * 3
            kept.append((s.snapshot(), len(calls)))

    # A tick and an event are at one time within 1e-12 s.
    simulation.every(0.1, partial(called, "tick"), first=0.1 + 5e-13)
    simulation.every(0.1, partial(called, "other tick"), first=0.1 + 5e-13)
    simulation.watch("joint_position", "joint_1", 0.1, call=partial(called, "event"))
    simulation.watch("joint_position", "joint_1", 0.1, call=partial(called, "other event"))
    simulation.watch("joint_position", "joint_1", 0.1)
    assert_same_futures(simulation, kept, calls, 0.35)
    # Four, and after each of them those that were still to come.
    assert len(kept) == 4 + 3 + 2 + 1
    simulation.restore(kept[0][0])
    calls.clear()
    simulation.advance(simulation.time)
    assert [name for name, _ in calls] == ["other event"]
    simulation.advance(0.15)
    assert [name for name, _ in calls] == ["other event", "tick", "other tick"]


def test_what_a_callback_does_after_its_snapshot_is_not_in_it(tmp_path):
    simulation, kept = turning(tmp_path), []

    def keep(s: dynsim.Simulation) -> None:
        s.set_wrench("link_1", torque=[0.0, 0.0, 1.0])
        kept.append(s.snapshot())
        s.set_wrench("link_1", torque=[0.0, 0.0, -1.0])

    simulation.every(10.0, keep, first=0.1)
    assert simulation.advance(0.5).v[0] < 1.0
    simulation.restore(kept[0])
    assert simulation.advance(0.5).v[0] > 1.0
    assert len(kept) == 1


@pytest.mark.parametrize("trace", [None, 3])
def test_snapshots_in_callbacks_of_a_sampled_controller_with_encoders(tmp_path, trace):
    """Encoders, controller, then callbacks, which read the record, brake, give motors back, and end the samples."""
    # Gains with which ticks of 10 ms are stable.
    soft = DRIVEN_TO.replace("200", "20").replace("s_per_rad: 5", "s_per_rad: 0.2")
    controller = soft.replace("SAMPLED", "\n  sample_time_s: 0.01")
    encoders = "sensors: {seed: 3, encoders: {rate_hz: 200, delay_s: 0.004, noise_deg: 0.01}}\n"
    text = TWO_LINKS.replace("METHOD", "dopri5") + controller + encoders
    simulation, kept, calls = dynsim.Simulation(read(tmp_path, text), duration=2.0, trace=trace), [], []

    def keep(s: dynsim.Simulation) -> None:
        calls.append(("keep", s.time))
        if round(s.time / 0.1) in (3, 10) and len(kept) < 4:
            kept.append((s.snapshot(), len(calls)))

    def act(s: dynsim.Simulation) -> None:
        k = round(s.time / 0.1)
        calls.append(("act", s.time))
        if k == 3:
            s.record(pictured=False)
        if k in (1, 4):
            s.set_brake("joint_2", k == 1)
        if k == 2:
            s.set_reference("joint_1", 1.2, 0.1)
        if k == 5:
            s.release("joint_1")
        if k == 6:
            s.end_samples(1.05)
        push(s)

    for call in (keep, act, keep):
        simulation.every(0.1, call)
    assert_same_futures(simulation, kept, calls, 1.2)


def test_an_error_in_a_callback_leaves_the_others_due(tmp_path):
    simulation, calls = turning(tmp_path), []

    def fail(s: dynsim.Simulation) -> None:
        calls.append("fail")
        raise ZeroDivisionError

    simulation.every(10.0, fail, first=0.1)
    simulation.every(10.0, lambda s: calls.append(s.time), first=0.1)
    with pytest.raises(ZeroDivisionError):
        simulation.advance(0.5)
    assert simulation.time == 0.1
    snapshot = simulation.snapshot()
    assert simulation.advance(0.5).q[0] == pytest.approx(0.5, abs=1e-12)
    assert calls == ["fail", 0.1]
    simulation.restore(snapshot)
    simulation.advance(0.5)
    assert calls == ["fail", 0.1, 0.1]


def test_a_callback_cannot_restore_the_simulation_that_calls_it(tmp_path):
    simulation = turning(tmp_path)
    before = simulation.snapshot()
    simulation.watch("joint_position", "joint_1", 0.2)
    simulation.every(0.1, lambda s: s.restore(before))
    with raises(ScenarioError):
        simulation.advance(0.5)
    with raises(ScenarioError):
        simulation.restore(before)


def test_a_tick_added_in_a_callback_is_called_at_that_time(tmp_path):
    simulation, times, kept = turning(tmp_path), [], []

    def add(s: dynsim.Simulation) -> None:
        kept.append(s.snapshot())
        s.every(0.2, lambda s: times.append(s.time))
        s.watch("joint_position", "joint_1", 0.4, call=lambda s: times.append(s.state.q[0]))
        kept.append(s.snapshot())

    simulation.every(10.0, add, first=0.1)
    for _ in range(2):
        times.clear()
        simulation.advance(0.45)
        np.testing.assert_allclose(times, [0.1, 0.3, 0.4], atol=1e-12)
        simulation.restore(kept[1])
    with raises(ScenarioError):
        simulation.restore(kept[0])


RAIL = """
duration_s: 4.0
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain:
  - {kind: prismatic, axis: x, mass_kg: 1, length_m: 0.1, limit_m: [-0.5, 0.1],
     motor: {type: wang_minami, gear_ratio: 20}}
controller:
  type: joint_pd
  k_p_V_per_rad: 200
  k_d_V_s_per_rad: 5
  operator: {joints: [joint_1], commands: [{at_s: 0.5, hand: [SPEED, 0, 0]}, {at_s: 2.5, hand: [0, 0, 0]}]}
"""


def test_an_operator_says_what_of_its_way_was_not_carried_out(tmp_path):
    """Told to go 0.4 m along a rail that ends after 0.1 m; the other way there is room for all of it."""
    record = dynsim.simulate(read(tmp_path, RAIL.replace("SPEED", "0.2")))
    moved = record["target_position"][-1, 0] - record["target_position"][0, 0]
    assert 0.09 < moved <= 0.1
    said = [line for line in record.summary["warnings"] if line.startswith("operator:")]
    assert len(said) == 1
    check_message(said[0], f"{0.4 - moved:.3g} m", "0.4 m", "joint_1")
    record = dynsim.simulate(read(tmp_path, RAIL.replace("SPEED", "-0.2")))
    assert record["target_position"][-1, 0] - record["target_position"][0, 0] == pytest.approx(-0.4, abs=1e-9)
    assert not record.summary["warnings"]


def test_the_source_of_an_operator_cannot_take_a_snapshot(tmp_path):
    """Half of its tick would be lost; a record it may take."""
    scenario = read(tmp_path, TWO_LINKS.replace("METHOD", "dopri5") + OPERATED)
    simulations, asked = [], []

    class Source:
        def read(self, tick: int) -> np.ndarray:
            script = scenario_script.read(tick)
            if simulations and tick == 3:
                simulations[0].record(pictured=False)
                asked.append(tick)
                simulations[0].snapshot()
            return script

    scenario_script = dynsim.Simulation(scenario).operator.source
    simulations.append(dynsim.Simulation(scenario, operator=Source()))
    with raises(ScenarioError, "Simulation.every"):
        simulations[0].advance(0.5)
    assert asked == [3]


@pytest.mark.parametrize("until", [0.3, 0.6, 0.7])
def test_a_tick_a_rounding_after_the_time_asked_for_is_not_lost(until):
    """3 × 0.1 is beyond 0.3: the tick came in no piece of the run when something was rewritten there."""
    simulation, times = dynsim.Simulation(dynsim.load_scenario("single_pendulum")), []
    simulation.every(0.1, lambda s: times.append(s.time))
    simulation.advance(until)
    assert len(times) == round(until / 0.1) + 1
    simulation.set_wrench("link_1", force=[0.0, 0.0, 0.1])
    simulation.advance(1.0)
    np.testing.assert_allclose(times, 0.1 * np.arange(11), atol=1e-14)


def test_references_hold_at_their_end_in_whatever_pieces_a_run_is_advanced(tmp_path):
    """Also where every motor followed something else when a piece began."""
    text = TWO_LINKS.replace("METHOD", "dopri5") + DRIVEN_TO.replace("SAMPLED", "")
    ends = []
    for pieces in ([1.5], [0.15, 1.5]):
        simulation = dynsim.Simulation(read(tmp_path, text), duration=2.0)
        simulation.every(10.0, lambda s: s.set_reference("joint_1", 1.0), first=0.1)
        simulation.every(10.0, lambda s: s.release("joint_1"), first=0.2)
        ends.append([simulation.advance(until) for until in pieces][-1])
    np.testing.assert_array_equal(ends[0].q, ends[1].q)


def test_an_event_within_a_step_that_is_shortened_is_called_once_at_its_time(tmp_path):
    """q = t − t²: a long step passes the level and comes back; something is rewritten in between, at the top."""
    simulation, seen, kept = turning(tmp_path), [], []
    inertia = simulation.model.mass_matrix(np.zeros(1))[0, 0]
    simulation.set_wrench("link_1", torque=[0.0, 0.0, -2.0 * inertia])

    def call(s: dynsim.Simulation) -> None:
        seen.append(s.state)
        kept.append(s.snapshot())

    simulation.watch("joint_position", "joint_1", 0.2499, call=call)
    simulation.advance(0.5)
    assert len(seen) == 1
    simulation.record()
    simulation.set_wrench("link_1")
    assert simulation.time == 0.5
    assert simulation.state.q[0] == pytest.approx(0.25, abs=1e-12)
    (state,) = seen
    assert state.time == pytest.approx(0.49, abs=1e-9)
    assert state.q[0] == pytest.approx(0.2499, abs=1e-12)
    assert [event.time for event in simulation.happened] == [state.time]
    # It knows nothing of the step that was to end at 0.5 s.
    simulation.restore(kept[0])
    assert simulation.advance(1.0).q[0] == pytest.approx(0.0, abs=1e-9)
