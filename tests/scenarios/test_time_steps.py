"""Time stepping in scenarios: event times, wheel friction, and step statistics in the summary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, raises
from support.stepping_systems import snake

import dynsim
from dynsim.engine.warnings import HALF_STEP_LIMIT, PENETRATION_LIMIT_M, SCHEME_LIMIT, coarse
from dynsim.errors import ModelError, ScenarioError
from dynsim.model.urdf.writer import write_urdf

G, H = 9.81, 1e-3
STEPS = {"integrator.method": "time_stepping", "integrator.step_s": H}
SLIDES = {"contacts.friction": 0.5, "duration_s": 0.5}


def with_steps(name: str, variant: str | None = None, **more: object) -> dynsim.Record:
    return dynsim.simulate(dynsim.load_scenario(name, variant, overrides={**STEPS, **more}))


def times(record: dynsim.Record, *kinds: str) -> list[float]:
    return [event.time for event in record.events if event.kind in kinds]


def test_a_block_that_is_pulled_starts_to_slip_when_it_should():
    """On a slope of 2 in 5 across which the pull is 8 N/s: √(T² + (m g sin α)²) = μ_s m g cos α."""
    record = with_steps("block_on_slope", "pulled")
    slope, weight = np.arctan(0.4), 3.0 * G
    starts = np.sqrt((0.5 * weight * np.cos(slope)) ** 2 - (weight * np.sin(slope)) ** 2) / 8.0
    assert [(event.kind, event.name) for event in record.events] == [("slip_start", "foot")]
    assert starts <= record.events[0].time <= starts + 2 * H
    assert record.summary["contacts"][0]["slip_starts"] == 1
    # Modes of the samples agree with it.
    slides = record.time[record["contact_mode"][:, 0] == 1]
    assert abs(slides[0] - record.events[0].time) <= 1.0 / 200.0


@pytest.mark.slow  # two programs to compile
def test_bounces_are_landings_and_lift_offs_when_events_have_them():
    record = with_steps("bouncing_link", "half")
    exact = dynsim.simulate(dynsim.load_scenario("bouncing_link", "half"))
    np.testing.assert_allclose(times(record, "landing")[:3], times(exact, "bounce")[:3], atol=3 * H)
    contact = record.summary["contacts"][0]
    assert len(times(record, "landing")) == contact["landings"] > 3
    assert len(times(record, "lift_off")) == contact["lift_offs"]
    kinds = [event.kind for event in record.events if "slip" not in event.kind]
    assert kinds == ["landing", "lift_off"] * (len(kinds) // 2) + ["landing"] * (len(kinds) % 2)


@pytest.mark.parametrize("step", [1e-3, 2.5e-4])
@pytest.mark.parametrize("friction", [0.0, 0.01, 0.3])
def test_a_joint_is_moved_back_to_the_stop_that_it_has_passed(friction, step, tmp_path: Path):
    """A link falls from 60° on its stop at 120°, m g l/2 (cos 60° − cos 120°) = 1.962 J, less the friction of 60°."""
    path = tmp_path / "stop.yaml"
    path.write_text(
        "duration_s: 3\n"
        "plant: {type: serial_arm, chain: [{axis: y, length_m: 0.5, mass_kg: 0.8, initial_deg: 60,\n"
        f"  friction_N_m: {friction}, limit_deg: [-170, 120]}}]}}\n"
        f"contacts: {{law: unilateral}}\nrecord: {{rate_hz: {1.0 / step}}}\n"
    )
    steps = {"integrator.method": "time_stepping", "integrator.step_s": step}
    record = dynsim.simulate(dynsim.load_scenario(path, overrides=steps))
    passed = record["q"][:, 0] - np.radians(120.0)
    deepest = int(passed.argmax())
    # A step whose midpoint is before the stop passes it. From then on the joint moves back, at up to 0.02 rad/s.
    assert 0.0 < passed[deepest] <= 1.5 * record["v"][:, 0].max() * step
    assert np.diff(passed[deepest:]).max() < 1e-12
    assert np.abs(record["v"][deepest + 1 :]).max() < 0.0201
    assert abs(passed[-1]) < 1e-9
    assert [event.kind for event in record.events if "stop_" in event.kind] == ["stop_hit"]
    # The energy of the hit, less the work of the way back.
    taken = 0.8 * G * 0.25 - friction * np.radians(60.0)
    assert record.summary["stop_loss_J"] == pytest.approx(taken, abs=(2.0 + friction) * passed[deepest])
    assert record.summary["energy_residual_relative"] < 1e-13
    (warning,) = record.summary["warnings"]
    check_message(warning, "joint_1", "integrator.step_s")
    weight = 0.8 * G * 0.25 * np.sin(np.radians(120.0))
    assert np.abs(record["stop_force"][-1]).max() == pytest.approx(weight, abs=friction + 1e-6)


@pytest.mark.parametrize("method", ["time_stepping", "dopri5"])
def test_a_state_beyond_a_stop_is_refused_by_every_method(method, tmp_path: Path):
    """Event-driven methods would move the joint to its stop at once, time stepping would leave it where it is."""
    path = tmp_path / "stop.yaml"
    path.write_text(
        "duration_s: 1\n"
        "plant: {type: serial_arm, chain: [{axis: y, length_m: 0.5, mass_kg: 1, limit_deg: [-170, 120]}]}\n"
        "contacts: {law: unilateral}\n"
    )
    scenario = dynsim.load_scenario(path, overrides={"integrator.method": method})
    for degrees in (120.0, 120.5):
        state = dynsim.State(0.0, np.radians([degrees]), np.zeros(1), np.zeros(0))
        if degrees == 120.0:
            dynsim.Simulation(scenario, state=state)
            continue
        with raises(ModelError, "joint_1", "120.5°", "120°"):
            dynsim.Simulation(scenario, state=state)


JAM = """
duration_s: 1
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain:
    - {axis: y, length_m: 0.3, mass_kg: 0.5, initial_deg: 90, damping_N_m_s_per_rad: 0.2,
       motor: {type: torque, limit_N_m: 50}}
controller: {type: joint_pd, torques: {joint_1: {times_s: [0, 0.5, 1], torques_N_m: [1, 0, -1]}}}
surfaces: {s: {type: plane, point_m: [0.3, 0, 0], normal: [0.9659258, 0, 0.2588190]}}
contacts:
  law: unilateral
  friction: 0.6
  points: {tip: {body: link_1, point_m: [0, 0, 0.3], surface: s}}
record: {rate_hz: 1000}
"""


def test_a_jam_takes_the_same_energy_whatever_the_step(tmp_path: Path):
    """μ tan 75° = 2.2: a tip that is wedged cannot be pushed out of its plane; 5.5e7 J of friction heat once."""
    path = tmp_path / "jam.yaml"
    path.write_text(JAM)
    heat = []
    for step in (1e-3, 5e-4, 1e-4):
        steps = {"integrator.method": "time_stepping", "integrator.step_s": step}
        summary = dynsim.simulate(dynsim.load_scenario(path, overrides=steps)).summary
        solved = summary["time_stepping"]
        assert solved["capped_solves"] == 0
        assert 0 < solved["dropped_solves"] < 0.25 * solved["contact_solves"]
        assert solved["residual_max_m_s"] <= 1e-10
        assert abs(summary["scheme_loss_J"]) < 1e-11
        assert summary["energy_residual_relative"] < 1e-12
        # The tip leaves for a moment in each step, so that each is a landing.
        heat.append(summary["friction_heat_J"] + summary["impact_loss_J"])
    np.testing.assert_allclose(heat, heat[-1], rtol=1e-2)
    assert heat[-1] > 0.06


def test_a_stop_is_hit_and_left(tmp_path: Path):
    """A pendulum swings against its stop after a quarter of its period, loses its speed, and is pulled away."""
    path = tmp_path / "stop.yaml"
    path.write_text(
        "duration_s: 1\n"
        "plant: {type: serial_arm, chain: [{axis: y, length_m: 0.5, mass_kg: 1, limit_deg: [-170, 190], "
        "initial_deg: 188}]}\n"
        "contacts: {law: unilateral}\n"
        "loads: {wind: {type: samples, body: link_1, point_m: [0, 0, 0.5], times_s: [0, 0.5, 0.500001, 1], "
        "force_N: [[-9, 0, 0], [-9, 0, 0], [9, 0, 0], [9, 0, 0]], interpolation: linear}}\n"
        "integrator: {method: time_stepping, step_s: 0.001}\n"
    )
    stepped = dynsim.simulate(dynsim.load_scenario(path))
    exact = dynsim.simulate(
        dynsim.load_scenario(path, overrides={"integrator.method": "dopri5", "integrator.step_s": None})
    )
    assert exact.events
    events = [(event.kind, event.name) for event in stepped.events]
    assert events == [(event.kind, event.name) for event in exact.events]
    # It is left once the joint is out again of what it sank in, h times the speed of the blow.
    late = np.subtract([event.time for event in stepped.events], [event.time for event in exact.events])
    assert (late >= 0.0).all()
    assert (late <= [2 * H, 10 * H]).all()
    assert stepped.summary["joint_stops"][0]["hits"] == exact.summary["joint_stops"][0]["hits"] == 1
    assert stepped.summary["energy_residual_relative"] < 1e-9


@pytest.mark.parametrize(("ratio", "axis"), [(0.2, [2.0, 0.0, 0.0]), (0.0, [1.0, 0.0, 0.3]), (0.2, [0.0, 1.0, 0.0])])
def test_wheels_roll_along_their_axis(ratio, axis):
    """On the slope, along x: μ ratio acts along the axis; with the axis across, μ holds the block."""
    grip = {"contacts.points.foot.grip": {"axis": axis, "ratio": ratio}}
    record = with_steps("block_on_slope", "slides", **SLIDES, **grip)
    slope = np.arctan(0.4)
    friction = 0.5 * (ratio if axis[0] else 1.0)
    acceleration = max(G * (np.sin(slope) - friction * np.cos(slope)), 0.0)
    moved = np.linalg.norm(record["q"][-1] - record["q"][0])
    np.testing.assert_allclose(moved, 0.5 * acceleration * 0.5**2, rtol=1e-9, atol=1e-9)
    # What is written out is read again.
    assert record.provenance["scenario"]["contacts"]["points"]["foot"]["grip"] == {"axis": axis, "ratio": ratio}


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (
            {"integrator.method": "dopri5", "integrator.step_s": None},
            ("contacts.points.foot.grip", "integrator.method: time_stepping", "dopri5"),
        ),
        ({"contacts.points.foot.grip.axis": [0, 0, 0]}, ("contacts.points.foot.grip.axis",)),
        ({"contacts.points.foot.grip.ratio": 1.5}, ("contacts.points.foot.grip.ratio = 1.5",)),
    ],
)
def test_grips_that_cannot_be(change, names):
    grip = {"contacts.points.foot.grip": {"axis": [1, 0, 0], "ratio": 0.1}}
    with raises(ScenarioError, *names):
        dynsim.load_scenario("block_on_slope", "slides", overrides={**STEPS, **grip, **change})


def test_a_snake_on_wheels(tmp_path: Path):
    """A free root, twelve servos and fourteen wheels, all from a scenario: it sets out along its wheels."""
    compiled, _ = snake()
    (tmp_path / "snake.urdf").write_text(write_urdf(compiled.robot))
    wheels = "".join(
        f"    wheel_{k}: {{body: link_{min(k, 12)}, point_m: [{0.05 * (k > 12)}, {0.02 * (-1) ** k}, -0.03], "
        "grip: {axis: [1, 0, 0], ratio: 0.05}}\n"
        for k in range(14)
    )
    path = tmp_path / "snake.yaml"
    path.write_text(
        "duration_s: 0.2\n"
        "plant:\n  type: urdf_arm\n  file: snake.urdf\n  initial_pose: {root: {position_m: [0, 0, 0.03]}}\n"
        "  motor: {type: servo, voltage_V: 12, stall_torque_N_m: 6, no_load_speed_rad_per_s: 8, "
        "k_p_V_per_rad: 60, k_d_V_s_per_rad: 1, rotor_inertia_kg_m2: 0.005, coulomb_friction_N_m: 0.05, "
        "coulomb_speed_rad_per_s: 0.05}\n"
        "loads: {pull: {type: constant, body: link_12, force_N: [2, 0, 0]}}\n"
        "surfaces: {floor: {type: plane}}\n"
        f"contacts:\n  law: unilateral\n  friction: 0.6\n  points:\n{wheels}"
        "integrator: {method: time_stepping, step_s: 0.001}\n"
    )
    record = dynsim.simulate(dynsim.load_scenario(path))
    summary = record.summary
    assert summary["energy_residual_relative"] < 1e-9
    assert summary["time_stepping"]["capped_solves"] == 0
    # 13 bodies of 0.3 kg, pulled by 2 N along the wheels against 0.05 · 0.6 of their weight.
    mass = 13 * 0.3
    distance = 0.5 * (2.0 - 0.03 * mass * G) / mass * 0.2**2
    np.testing.assert_allclose(record["hand_position"][-1, 0] - record["hand_position"][0, 0], distance, rtol=0.02)
    assert np.abs(record["hand_position"][:, 1]).max() < 1e-6


def test_steps_that_are_too_long_are_told():
    stepping = {
        "step_s": 1e-3,
        "scheme_loss_worst_J": -0.05,
        "half_step_energy_J": 0.04,
        "penetration_max_m": 3 * PENETRATION_LIMIT_M,
    }
    scheme, blurred, depth = coarse(stepping, 1.0)
    check_message(scheme, "0.05 J", "5 %", "integrator.step_s", "0.0002")
    check_message(blurred, "0.04 J", "4 %", "integrator.step_s", "0.0005")
    check_message(depth, "3 mm", "integrator.step_s", "0.0003")
    contacts = [{"name": "box-link_3", "penetration_max_m": 3e-3}, {"name": "tip", "penetration_max_m": 1e-3}]
    check_message(coarse(stepping, 1.0, contacts)[2], "3 mm", "box-link_3")
    stepping |= {
        "scheme_loss_worst_J": 0.5 * SCHEME_LIMIT,
        "half_step_energy_J": 0.5 * HALF_STEP_LIMIT,
        "penetration_max_m": 0.0,
    }
    assert coarse(stepping, 1.0) == []
    stepping |= {"scheme_loss_worst_J": -0.05, "scheme_gain_J": 0.05, "spring_rate_rad_per_s": 1e-3**0.5 / 1e-4}
    (gain,) = coarse(stepping, 1.0)
    check_message(gain, "0.05 J", "5 %", "0.1 %", "integrator.step_s", "0.0001")
    # Rounding of a logarithm made 0 of what is just below a power of ten.


def test_the_energy_of_a_run_is_known_to_what_half_a_step_of_its_power_says():
    """A hand is pushed up a wall until it slips; at 1 ms nothing of it is an impact, and it never leaves the wall."""
    exact = dynsim.simulate(dynsim.load_scenario("wall_push", "weak_hold"))
    known = exact.summary["electrical_energy_J"]
    for step, theta, warned in ((1e-3, 0.5, False), (5e-2, 1.0, True)):
        # Circuits faster than the step ring at theta 0.5, and the hand sticks and slips by that from 40 ms on.
        steps = {"integrator.step_s": step, "integrator.theta": theta}
        record = with_steps("wall_push", "weak_hold", **steps)
        error = abs(record.summary["electrical_energy_J"] - known)
        blurred = record.summary["time_stepping"]["half_step_energy_J"]
        assert error <= blurred <= 4.0 * error
        assert bool(lines_with(record.summary["warnings"], f"{blurred:.3g} J")) is warned
    record = with_steps("wall_push", "weak_hold")
    (contact,), (other,) = record.summary["contacts"], exact.summary["contacts"]
    assert record.summary["electrical_energy_J"] == pytest.approx(known, rel=5e-4)
    assert contact["normal_force_max_N"] == pytest.approx(other["normal_force_max_N"], rel=5e-3)
    assert contact["lift_offs"] == 0
    assert abs(contact["impact_loss_J"]) < 1e-5
    damped = with_steps("wall_push", "weak_hold", **{"integrator.theta": 1.0})
    assert abs(damped.summary["contacts"][0]["impact_loss_J"]) < 1e-5


def test_what_rests_is_told_nothing_of_its_steps():
    """Rounding is more than a hundredth of a turnover that is nothing but rounding itself."""
    record = with_steps("block_on_slope", "rests")
    worst = abs(record.summary["time_stepping"]["scheme_loss_worst_J"])
    assert worst > SCHEME_LIMIT * record.summary["energy_turnover_J"]
    assert record.summary["warnings"] == []
