"""Scenes of public reports about simulators, in our own words, against closed forms."""

from pathlib import Path

import numpy as np
import pytest

import dynsim
from dynsim.record import Record

G = 9.81
BYSTANDER = """
plant: {type: serial_arm, chain: [{length_m: 0.1, mass_kg: 0.1, axis: z}], base: {position_m: [5, 5, 5]}}
"""
BALL = "shape: sphere, radius_m: 0.05, mass_kg: 0.4"


def run(folder: Path, text: str, variant: str | None = None) -> Record:
    path = folder / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return dynsim.simulate(dynsim.load_scenario(path, variant))


def columns(record: Record, body: str) -> list[int]:
    """Columns of the velocity of a free body, (x, y, z, wx, wy, wz)."""
    return [record.labels["v"].index(f"{body}.{axis}") for axis in ("x", "y", "z", "wx", "wy", "wz")]


def test_a_motor_against_a_stop_draws_the_current_of_its_voltage_limit(tmp_path: Path):
    """The static torque is k i = k V / R; the stop balances it."""
    record = run(
        tmp_path,
        """
duration_s: 0.2
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain:
    - {axis: y, length_m: 0.3, mass_kg: 1, limit_deg: [0, 90], motor: {type: dc, torque_constant_N_m_per_A: 0.05,
       resistance_ohm: 2, inductance_H: 1.0e-4, rotor_inertia_kg_m2: 1.0e-6, gear_ratio: 1, voltage_limit_V: 10}}
controller: {type: joint_pd, k_p_V_per_rad: 40, k_d_V_s_per_rad: 0,
  joints: {joint_1: {times_s: [0, 0.1], angles_deg: [-28.6, -28.6]}}}
contacts: {law: unilateral}
""",
    )
    for signal, value in (("voltage", -10.0), ("current", -5.0), ("torque", -0.25), ("stop_force", 0.25)):
        assert record[signal][-1] == pytest.approx([value], rel=1e-9)


def test_a_servo_at_full_voltage_speeds_up_along_its_torque_curve(tmp_path: Path):
    """The torque falls linearly from stall to no-load speed: w = w_0 (1 - exp(-t / τ)), τ = J w_0 / M_stall."""
    record = run(
        tmp_path,
        """
duration_s: 3
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain:
    - {axis: z, length_m: 0.0, mass_kg: 10, com_m: [0, 0, 0], inertia_kg_m2: [0.5, 0, 0, 0.5, 0, 1.0],
       motor: {type: servo, voltage_V: 24, stall_torque_N_m: 33, no_load_speed_rad_per_s: 21, mode: velocity,
       k_v_V_s_per_rad: 50}}
controller: {type: joint_pd, joints: {joint_1: {times_s: [0, 30], angles_deg: [0, 51566], ends: free}}}
contacts: {law: unilateral}
""",
    )
    expected = 21.0 * (1.0 - np.exp(-record.time * 33.0 / 21.0))
    assert np.abs(record["v"][:, 0] - expected).max() < 1e-8


def test_references_beyond_both_limits_leave_the_joint_within_them(tmp_path: Path):
    record = run(
        tmp_path,
        """
duration_s: 3
plant:
  type: serial_arm
  chain:
    - {axis: y, length_m: 0.3, mass_kg: 1, limit_deg: [0, 90],
       motor: {type: servo, voltage_V: 24, stall_torque_N_m: 100, no_load_speed_rad_per_s: 10, k_p_V_per_rad: 500}}
controller: {type: joint_pd, joints: {joint_1: {times_s: [0, 1.5, 3], angles_deg: [0, 700, -200]}}}
contacts: {law: unilateral}
""",
    )
    assert -1e-9 < record["q"].min() < 1e-3
    assert np.pi / 2 - 1e-3 < record["q"].max() < np.pi / 2 + 1e-9
    assert {stop["hits"] for stop in record.summary["joint_stops"]} == {1}


def test_a_ball_on_a_slope_bounces_with_the_spin_of_its_friction_impulse(tmp_path: Path):
    """First impact: j_n = (1 + e) v_n; sticking needs 2/7 of the tangential velocity, less than µ j_n."""
    record = run(
        tmp_path,
        f"""
duration_s: 0.5
{BYSTANDER}
surfaces: {{slope: {{type: plane, normal: [0.3420201433256687, 0, 0.9396926207859084]}}}}
objects: {{ball: {{{BALL}, position_m: [0, 0, 0.4]}}}}
contacts: {{law: unilateral, friction: 0.6, restitution: 0.7}}
record: {{rate_hz: 1000}}
""",
    )
    tilt = np.deg2rad(20.0)
    normal, tangent = np.array([np.sin(tilt), 0, np.cos(tilt)]), np.array([np.cos(tilt), 0, -np.sin(tilt)])
    impact = np.sqrt(2.0 * (0.4 * np.cos(tilt) - 0.05) / np.cos(tilt) / G)
    before = np.array([0.0, 0.0, -G * impact])
    sliding = min(0.6 * 1.7 * abs(before @ normal), 2.0 / 7.0 * (before @ tangent))
    assert record.events[0].kind == "bounce"
    assert record.events[0].time == pytest.approx(impact, abs=1e-9)
    sample = int(np.searchsorted(record.time, impact + 0.002))
    velocity = record["v"][sample, columns(record, "ball")]
    after = velocity[:3] + np.array([0.0, 0.0, G * (record.time[sample] - impact)])
    assert after @ tangent == pytest.approx(before @ tangent - sliding, rel=1e-9)
    assert after @ normal == pytest.approx(-0.7 * (before @ normal), rel=1e-9)
    assert velocity[4] == pytest.approx(2.5 * sliding / 0.05, rel=1e-9)


@pytest.mark.parametrize(("restitution", "height"), [(1.0, 0.55), (0.5, 0.05), (0.0, 0.05)])
def test_a_dropped_ball_neither_gains_height_nor_sinks(tmp_path: Path, restitution: float, height: float):
    record = run(
        tmp_path,
        f"""
duration_s: 10
{BYSTANDER}
surfaces: {{floor: {{type: plane}}}}
objects: {{ball: {{{BALL}, position_m: [0, 0, 0.55]}}}}
contacts: {{law: unilateral, friction: 0, restitution: {restitution}}}
""",
    )
    z = record["q"][:, record.labels["q"].index("ball.z")]
    assert z[record.time > 8.0].max() == pytest.approx(height, abs=1e-5)
    assert z.min() > 0.05 - 1e-9
    lost = 0.4 * G * 0.5 if restitution < 1.0 else 0.0
    assert record.summary["impact_loss_J"] == pytest.approx(lost, abs=1e-9)


def test_a_ball_that_hits_an_edge_rolls_over_it_without_gain(tmp_path: Path):
    """Momentum about the rim is kept by an impact without restitution that sticks; energy only falls."""
    record = run(
        tmp_path,
        f"""
duration_s: 0.8
{BYSTANDER}
surfaces: {{table: {{type: box, center_m: [-0.5, 0, -0.05], edges_m: [1, 1, 0.1], edge_radius_m: 0.002}}}}
objects: {{ball: {{{BALL}, position_m: [0.01, 0, 0.3]}}}}
contacts: {{law: unilateral, friction: 0.5, restitution: 0}}
record: {{rate_hz: 2000}}
""",
    )
    assert [event.kind for event in record.events] == ["landing", "slip_start", "lift_off"]
    energy = record["energy_kinetic"] + record["energy_potential"]
    assert np.diff(energy).max() < 1e-8
    # The rim is an arc of 2 mm: the offset of the centre from that arc's centre is 12 mm in x, 52 mm in total.
    arm, drop = 0.052, 0.3 + 0.002 - np.sqrt(0.052**2 - 0.012**2)
    speed = np.sqrt(2.0 * G * drop)
    sample = int(np.searchsorted(record.time, record.events[0].time)) + 1
    velocity = record["v"][sample, columns(record, "ball")]
    inertia = 0.4 * 0.05**2 * 2.0 / 5.0
    contact = 0.05  # from the centre of the ball to the point of contact
    spin = 0.4 * speed * (0.012 / arm) * contact / (inertia + 0.4 * contact**2)
    assert velocity[4] == pytest.approx(spin, rel=0.02)


@pytest.mark.parametrize("variant", ["events", "stepping", "soft"])
def test_a_car_rolls_down_with_the_inertia_of_its_wheels(tmp_path: Path, variant: str):
    """a = g sin α M / (M + 4 I / r²), the wheels being discs of 0.5 kg."""
    record = run(
        tmp_path,
        f"""
duration_s: 1
{BYSTANDER}
surfaces: {{floor: {{type: plane, normal: [0.08715574274765817, 0, 0.9961946980917455]}}}}
objects:
  car:
    mass_kg: 4
    size_m: [0.6, 0.3, 0.08]
    position_m: [0.00697245941981, 0, 0.0796955758553562]
    rpy_deg: [0, 5, 0]
    wheels:
      fl: {{position_m: [0.2, 0.2, -0.03], radius_m: 0.05, mass_kg: 0.5}}
      fr: {{position_m: [0.2, -0.2, -0.03], radius_m: 0.05, mass_kg: 0.5}}
      rl: {{position_m: [-0.2, 0.2, -0.03], radius_m: 0.05, mass_kg: 0.5}}
      rr: {{position_m: [-0.2, -0.2, -0.03], radius_m: 0.05, mass_kg: 0.5}}
contacts: {{law: unilateral, friction: 0.7}}
variants:
  events: {{}}
  stepping: {{integrator: {{method: time_stepping}}}}
  soft: {{integrator: {{method: time_stepping}}, contacts: {{stiffness_N_per_m: 1.0e+5, damping_N_s_per_m: 200}}}}
""",
        variant,
    )
    x, _, z = record["v"][-1, columns(record, "car")[:3]]
    assert np.hypot(x, z) == pytest.approx(G * np.sin(np.deg2rad(5.0)) * 6.0 / (6.0 + 4.0 * 0.25) * 1.0, rel=1e-9)


@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-10])
def test_energy_of_a_chaotic_arm_follows_the_tolerance(tmp_path: Path, rtol: float):
    record = run(
        tmp_path,
        f"""
duration_s: 100
plant:
  type: serial_arm
  link: {{length_m: 1.0, mass_kg: 1.0}}
  chain: [{{axis: y}}, {{axis: y}}]
  initial_deg: [120, 40]
integrator: {{rtol: {rtol}}}
""",
    )
    energy = record["energy_kinetic"] + record["energy_potential"]
    assert np.abs(energy - energy[0]).max() / (2.0 * G * 1.5) < rtol


@pytest.mark.parametrize(("duration", "overturns"), [(2.0, True), (3.0, False)])
def test_braking_tips_a_base_over_its_wheels(tmp_path: Path, duration: float, overturns: bool):
    """The caster lifts when the deceleration exceeds g x / z, with the centre of mass x behind the axle and z high."""
    record = run(
        tmp_path,
        f"""
duration_s: 4
plant:
  type: pws_arm
  base: {{mass_kg: 8, com_m: [-0.05, 0, 0.3], mount: {{position_m: [0, 0, 0.5]}}, caster_m: [-0.15, 0, 0],
    wheel: {{radius_m: 0.05, mass_kg: 1.0e-6, motor: {{type: servo, voltage_V: 24, stall_torque_N_m: 20,
      no_load_speed_rad_per_s: 60, k_p_V_per_rad: 800, k_d_V_s_per_rad: 10}}}}}}
  arm: {{type: serial_arm, chain: [{{length_m: 0.3, mass_kg: 2, axis: y, motor: {{type: servo, voltage_V: 24,
    stall_torque_N_m: 60, no_load_speed_rad_per_s: 6, k_p_V_per_rad: 5000, k_d_V_s_per_rad: 5}}}}]}}
controller:
  type: joint_pd
  base: {{path: {{type: straight, distance_m: 1.2, duration_s: {duration}, start_s: 0.5}}}}
""",
    )
    limit = G * 0.4 / (8 * 0.3 + 2 * 0.65)
    share = np.linspace(0.5, 1.0, 100_001)
    braking = -(60 * share - 180 * share**2 + 120 * share**3) * 1.2 / duration**2
    first = share[np.argmax(braking > limit)]
    time = record.summary["base"]["overturns_at_s"]
    assert (braking.max() > limit) == overturns
    assert (time == pytest.approx(0.5 + first * duration, abs=0.03)) if overturns else time is None


def test_a_stalk_of_torsion_springs_returns_upright(tmp_path: Path):
    """A force at the tip bends it like a cantilever of springs; released, it comes to rest where it stood."""
    joints = "\n".join(
        f"  s{k}: {{type: torsion, body: link_{k + 1}, other: {f'link_{k}' if k else 'world'}, axis: [0, 1, 0], "
        "stiffness_N_m_per_rad: 2.0, damping_N_m_s_per_rad: 0.01, bound_N_m: 0.6}"
        for k in range(8)
    )
    record = run(
        tmp_path,
        f"""
duration_s: 8
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain: [{{count: 8, axis: y, length_m: 0.05, mass_kg: 0.01, radius_m: 0.005}}]
ties:
{joints}
loads: {{push: {{type: samples, body: link_8, point_m: [0, 0, 0.05], times_s: [0.2, 1, 4, 4.01],
  force_N: [[0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0, 0, 0]], interpolation: linear}}}}
contacts: {{law: unilateral}}
integrator: {{method: time_stepping, step_s: 5.0e-4}}
""",
    )
    # The angle at spring k is F (L - x_k) / stiffness.
    still = [0.1 * 0.05 * (8 - k) / 2.0 for k in range(8)]
    assert record["q"][np.searchsorted(record.time, 3.9)] == pytest.approx(still, rel=0.01)
    assert np.abs(record["q"][-1]).max() < 1e-3  # the vibration decays by the dampers
    assert np.abs(record["tie_force"]).max() < 0.6
