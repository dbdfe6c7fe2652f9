"""Dry joint friction with sampled commands and with contacts, and points that nothing presses.

Each test is a scene whose answer is known: in closed form, by symmetry, or by time stepping, which solves one contact
problem a step and knows no modes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from support.messages import lines_with

from dynsim import Simulation, load_scenario, simulate
from dynsim.dynamics.tables import OPEN, SLIDING, STICKING
from dynsim.record import Record

STEPS = "time_stepping"
EVENTS = [pytest.param("dopri5", id="dopri5"), pytest.param("radau5", id="radau5")]

SAMPLED = """
name: sampled
duration_s: 0.05
plant:
  type: serial_arm
  link: {friction_N_m: 0.1, motor: {type: wang_minami}}
  chain: [{initial_deg: 100}, {initial_deg: 30}]
controller: {type: joint_pd, sample_time_s: 0.001, k_p_V_per_rad: 20, k_d_V_s_per_rad: 0.5}
contacts: {law: unilateral}
record: {rate_hz: 1000}
"""


def run(folder: Path, text: str, **overrides: object) -> Record:
    """Record of a scenario; keys of ``overrides`` with ``__`` for dots."""
    path = folder / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return simulate(load_scenario(path, None, {key.replace("__", "."): value for key, value in overrides.items()}))


@pytest.mark.parametrize("sensors", [None, {"encoders": {}}], ids=["ideal", "encoders"])
@pytest.mark.parametrize("method", ["dopri5", "radau5", "auto", STEPS])
def test_sampled_arm_with_dry_friction_starts_in_its_posture(tmp_path: Path, method: str, sensors: object):
    record = run(tmp_path, SAMPLED, integrator__method=method, sensors=sensors)
    np.testing.assert_allclose(np.degrees(record["q"][0]), [100.0, 30.0], rtol=0, atol=1e-12)
    assert np.abs(np.diff(record["q"], axis=0)).max() < 0.01
    if sensors is None:
        # By dopri5 at rtol 1e-9: 0.00590287 J. Time stepping is of first order, 0.3 % here.
        assert record.summary["electrical_energy_J"] == pytest.approx(0.0059029, rel=0.01 if method == STEPS else 1e-5)


def test_brake_closed_at_the_first_tick_keeps_the_posture(tmp_path: Path):
    path = tmp_path / "scene.yaml"
    path.write_text(SAMPLED, encoding="utf-8")
    simulation = Simulation(load_scenario(path, None, {"integrator.method": "dopri5"}))
    simulation.set_brake("joint_2", closed=True)
    simulation.advance(0.01)
    q = np.degrees(simulation.record()["q"])
    np.testing.assert_allclose(q[0], [100.0, 30.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(q[:, 1], 30.0, rtol=0, atol=1e-9)


# The load of the second joint swings beyond its friction of 0.1 N m to both sides.
BRAKED = """
name: braked
duration_s: 0.6
plant:
  type: serial_arm
  link: {friction_N_m: 0.1, mass_kg: 0.3, length_m: 0.3, damping_N_m_s_per_rad: 0.02}
  chain: [{axis: y, initial_deg: 60}, {axis: y, initial_deg: 30}]
contacts: {law: unilateral}
record: {rate_hz: 200}
"""


@pytest.mark.parametrize("method", ["dopri5", "radau5", STEPS])
def test_braked_joint_neither_slips_nor_rubs(tmp_path: Path, method: str):
    """Friction of a braked joint came to its bound and gave way, though the joint did not move."""
    path = tmp_path / "scene.yaml"
    path.write_text(BRAKED, encoding="utf-8")
    simulation = Simulation(load_scenario(path, None, {"integrator.method": method}))
    simulation.set_brake("joint_2", closed=True)
    simulation.advance(0.4)
    record = simulation.record()
    assert np.ptp(record["q"][:, 0]) > 1.0
    assert np.ptp(record["q"][:, 1]) == 0.0
    assert (record["joint_friction"][:, 1] == 0.0).all()
    assert not [event for event in record.events if event.name == "joint_2"]
    simulation.set_brake("joint_2", closed=False)
    simulation.advance(0.6)
    friction = simulation.record()["joint_friction"][-20:, 1]
    assert np.abs(friction).max() == pytest.approx(0.1)


@pytest.mark.parametrize("off", [2e-10, 6e-10, 9e-10])
def test_joint_that_rests_next_to_its_stop_is_held_at_the_stop(tmp_path: Path, off: float):
    """Held where it was, up to 1e-9 m from the stop that it touches, friction contradicted the stop and ended runs."""
    text = f"""
name: stopped
duration_s: 0.01
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 9.81]
  chain: [{{kind: prismatic, axis: z, length_m: 0.1, mass_kg: 0.2, initial_m: {0.05 - off!r},
    limit_m: [-0.05, 0.05], friction_N: 0.3}}]
contacts: {{law: unilateral}}
"""
    record = run(tmp_path, text, integrator__method="dopri5")
    assert not record.events
    # Projection is to 1e-13 m.
    np.testing.assert_allclose(record["q"][:, 0], 0.05, rtol=0, atol=1e-12)
    np.testing.assert_allclose(record["stop_force"] + record["joint_friction"], -0.2 * 9.81, rtol=1e-9)


# One joint moves the tip at 75° to the normal of a plane that it touches. At μ tan 75° > 1 friction could hold it there
# whatever the torque; nothing presses it any more when the torque has changed its sign.
FLAT = """
name: flat
duration_s: {duration}
plant:
  type: serial_arm
  gravity_m_s2: [0, 0, 0]
  chain:
    - {{axis: y, length_m: 0.3, mass_kg: 0.5, initial_deg: 90, friction_N_m: {dry}, damping_N_m_s_per_rad: 0.2,
       motor: {{type: torque, limit_N_m: 50}}}}
controller:
  type: joint_pd
  torques: {{joint_1: {{times_s: [0, 0.5, 1], torques_N_m: [1, 0, -1]}}}}
surfaces: {{s: {{type: plane, point_m: [0.3, 0, 0], normal: [0.9659258262890683, 0, 0.25881904510252074]}}}}
contacts: {{law: unilateral, friction: 0.6, points: {{tip: {{body: link_1, point_m: [0, 0, 0.3], surface: s}}}}}}
record: {{rate_hz: 1000}}
"""


@pytest.mark.parametrize("dry", [0.0, 0.05])
@pytest.mark.parametrize("method", EVENTS)
def test_stuck_point_leaves_when_nothing_presses_it(tmp_path: Path, method: str, dry: float):
    """The torque is the spline −3 s + 4 s³ at s = t − 0.5, and the joint breaks loose where that is −dry."""
    leaves = 0.5 + (brentq(lambda s: 4.0 * s**3 - 3.0 * s + dry, 0.0, 0.1) if dry else 0.0)
    record = run(tmp_path, FLAT.format(duration=0.6, dry=dry), integrator__method=method)
    events = {event.kind: event.time for event in record.events if event.name == "tip"}
    # The guard is an acceleration, zero to 1e-8 of the largest one.
    assert events == {"lift_off": pytest.approx(leaves, abs=1e-7)}
    assert record["contact_normal_force"][record.time > 0.52].max() == 0.0


@pytest.mark.long
@pytest.mark.parametrize("dry", [0.0, 0.05])
def test_point_that_leaves_at_a_flat_angle_moves_as_by_time_stepping(tmp_path: Path, dry: float):
    text = FLAT.format(duration=0.8, dry=dry)
    events, steps = (run(tmp_path, text, integrator__method=method) for method in ("dopri5", STEPS))
    # Steps of 1 ms, of first order at the lift-off.
    assert steps["q"][-1, 0] == pytest.approx(events["q"][-1, 0], rel=5e-3)
    assert steps["v"][-1, 0] == pytest.approx(events["v"][-1, 0], rel=5e-3)


# Two points on surfaces at 45°, 5 cm and 15 cm beyond the centre of mass of a free body. The load along the body is
# shared in halves, 4 N each, and its moment pulls the far point with 0.8 N off its surface.
WEDGE = """
name: wedge
duration_s: 0.05
plant:
  type: serial_arm
  gravity_m_s2: [-8, 0, -1.6]
  chain:
    - {kind: prismatic, axis: x, length_m: 0, mass_kg: 0}
    - {kind: prismatic, axis: z, length_m: 0, mass_kg: 0}
    - {axis: y, length_m: 0.3, mass_kg: 1, initial_deg: 90}
surfaces:
  a: {type: plane, point_m: [0.2, 0, 0], normal: [1, 0, 1]}
  b: {type: plane, point_m: [0.3, 0, 0], normal: [1, 0, 1]}
contacts:
  law: unilateral
  friction: 2
  points:
    near: {body: link_3, point_m: [0, 0, 0.2], surface: a}
    far: {body: link_3, point_m: [0, 0, 0.3], surface: b}
"""


def test_warning_names_a_point_that_sticks_although_nothing_presses_it(tmp_path: Path):
    record = run(tmp_path, WEDGE, integrator__method="dopri5")
    np.testing.assert_allclose(record["contact_normal_force"][-1], np.sqrt(0.5) * np.array([5.2 + 1.2, 3.2]), rtol=1e-9)
    assert lines_with(record.summary["warnings"], "far", "100.0 %", phrase="not unique")
    # A load that presses both points leaves forces open, not the motion.
    pressed = run(tmp_path, WEDGE.replace("-8, 0, -1.6", "-8, 0, 0"), integrator__method="dopri5")
    assert (pressed["contact_mode"] == STICKING).all()
    assert not lines_with(pressed.summary["warnings"], phrase="not unique")


def elbow_on(surface: str, friction: float, dry: float) -> str:
    """A six-joint arm with dry friction whose elbow rests on a surface, while two joints follow references."""
    pitch, length = [115, 125, 60, 40, 70], 0.25
    relative = np.diff([0, *pitch])
    elbow = np.zeros(3)
    for angle in np.radians(np.cumsum(relative[:2])):
        across = np.sin(angle) * np.array([np.cos(np.radians(10)), np.sin(np.radians(10))])
        elbow += length * np.array([*across, np.cos(angle)])
    radius = 0.3
    below, above = ([*elbow[:2].tolist(), float(elbow[2] + z)] for z in (-radius, radius))
    shape = {
        "plane": f"{{type: plane, point_m: {elbow.tolist()}, normal: [0.1, 0.05, 1]}}",
        "sphere": f"{{type: sphere, center_m: {below}, radius_m: {radius}}}",
        "cylinder": f"{{type: cylinder, point_m: {below}, axis: [0.3, 1, 0], radius_m: {radius}}}",
        "bowl": f"{{type: sphere, center_m: {above}, radius_m: {radius}, inside: true}}",
    }[surface]
    chain = "".join(f"    - {{axis: y, initial_deg: {angle}}}\n" for angle in relative)
    return f"""
name: elbow_on_{surface}
duration_s: 0.4
plant:
  type: serial_arm
  link: {{length_m: {length}, mass_kg: 0.4, radius_m: 0.02, damping_N_m_s_per_rad: 0.05, friction_N_m: {dry},
    motor: {{type: wang_minami}}}}
  chain:
    - {{axis: z, length_m: 0, mass_kg: 0.2, initial_deg: 10}}
{chain}controller:
  type: joint_pd
  k_p_V_per_rad: 300
  k_d_V_s_per_rad: 12
  joints:
    joint_1: {{times_s: [0, 0.4], angles_deg: [10, 25]}}
    joint_2: {{times_s: [0, 0.4], angles_deg: [115, 120]}}
initial: {{on_surface: [elbow], equilibrium: true}}
surfaces: {{s: {shape}}}
contacts: {{law: unilateral, friction: {friction}, points: {{elbow: {{body: link_4, surface: s}}}}}}
record: {{rate_hz: 1000}}
"""


def test_elbow_and_two_joints_start_to_move_at_once(tmp_path: Path):
    """At 10.25 ms the best split of the friction ends. The elbow and joints 1 and 2 move, the others stay at rest.

    Released one after the other they end in det J M⁻¹F < 0, which stopped runs as Painlevé's paradox.
    """
    text = elbow_on("plane", 0.05, 0.1)
    events, steps = (
        run(tmp_path, text, duration_s=0.014, integrator__method=method, integrator__step_s=step)
        for method, step in (("dopri5", None), (STEPS, 1e-5))
    )
    starts = [event for event in events.events if event.kind == "slip_start" and event.time < 0.0104]
    assert {event.name for event in starts} == {"elbow", "joint_1", "joint_2"}
    np.testing.assert_allclose([event.time for event in starts], 0.01025, rtol=0, atol=5e-6)
    for record in (events, steps):
        moving = np.abs(record["v"][12]) > 1e-9
        assert moving.tolist() == [True, True, False, False, False, False]
        assert record["contact_mode"][12, 0] == SLIDING
    # First order of steps of 10 µs.
    np.testing.assert_allclose(events["contact_normal_force"][12], steps["contact_normal_force"][12], rtol=1e-3)


# Six joints with dry friction, whose elbow rests on a sphere and whose tip rests on a plane. As joint 1 starts to turn
# the elbow is pressed no more, and joints start to move with it.
TWO_SUPPORTS = """
name: two_supports
duration_s: 0.02
plant:
  type: serial_arm
  link: {length_m: 0.25, damping_N_m_s_per_rad: 0.05, friction_N_m: 0.163259, motor: {type: wang_minami}}
  chain:
    - {axis: z, length_m: 0, mass_kg: 0.2, initial_deg: -2.76443}
    - {axis: x, mass_kg: 0.565019, initial_deg: 110}
    - {axis: y, mass_kg: 0.244264, initial_deg: 10}
    - {axis: y, mass_kg: 0.298156, initial_deg: -45}
    - {axis: y, mass_kg: 0.280916, initial_deg: 43}
    - {axis: y, mass_kg: 0.478627, initial_deg: -38}
controller:
  type: joint_pd
  k_p_V_per_rad: 62.3591
  k_d_V_s_per_rad: 11.5139
  joints:
    joint_1: {times_s: [0, 0.3], angles_deg: [-2.76443, -10.9168]}
    joint_2: {times_s: [0, 0.3], angles_deg: [110, 109.386]}
surfaces:
  s: {type: sphere, center_m: [0.0208731, -0.467828, -0.469711], radius_m: 0.3}
  s2: {type: plane, point_m: [-0.108103, -0.887171, -0.324426], normal: [-0.0710373, -0.0276265, 1]}
contacts:
  law: unilateral
  friction: 0.3
  points: {elbow: {body: link_4, surface: s}, tip: {body: link_6, surface: s2}}
initial: {on_surface: [elbow, tip], equilibrium: true}
record: {rate_hz: 1000}
"""


def test_joints_start_to_move_as_an_elbow_leaves(tmp_path: Path):
    """At full friction the joints seemed to rest, by accelerations next to zero; then all stuck again, for ever."""
    events, steps = (
        run(tmp_path, TWO_SUPPORTS, integrator__method=method, integrator__step_s=step)
        for method, step in (("dopri5", None), (STEPS, 1e-4))
    )
    leaves = [event.time for event in events.events if event.kind == "lift_off"]
    assert leaves == [pytest.approx(0.013724, abs=1e-6)]
    # Of first order in the steps of 0.1 ms: 6e-4 here.
    np.testing.assert_allclose(events["v"][-1], steps["v"][-1], rtol=0, atol=5e-3 * np.abs(steps["v"][-1]).max())


@pytest.mark.long
@pytest.mark.parametrize("surface", ["plane", "sphere", "cylinder", "bowl"])
@pytest.mark.parametrize("friction", [0.05, 0.1, 0.2, 0.3, 0.5])
def test_elbow_and_resting_joints_move_as_by_time_stepping(tmp_path: Path, surface: str, friction: float):
    """Runs of such scenes stopped as Painlevé's paradox, or as chatter."""
    for dry in (0.02, 0.1, 0.3):
        text = elbow_on(surface, friction, dry)
        runs = [run(tmp_path, text, integrator__method=method) for method in ("dopri5", STEPS)]
        events, steps = (record.summary["electrical_energy_J"] for record in runs)
        # Time stepping is of first order while joints rub; with steps of 1 ms at most 1.4e-4 here. In one scene the
        # sliding elbow shares its force with joints at rest, so that its friction is a choice, and so is the motion:
        # by time stepping 0.3 % less, for steps of 0.1 ms too, and the warning says so.
        shares = (surface, friction, dry) == ("bowl", 0.05, 0.3)
        assert steps == pytest.approx(events, rel=4e-3 if shares else 2e-4)
        assert not shares or lines_with(runs[0].summary["warnings"], "elbow", phrase="moves otherwise")


# A push grows slowly at an elbow that creeps over a box, while joints rest, slip and rest again.
CREEP = """
name: creeping_elbow
duration_s: 0.95
plant:
  type: serial_arm
  link:
    radius_m: 0.0285
    friction_N_m: 0.2034
    motor: {type: dc, torque_constant_N_m_per_A: 0.04687, resistance_ohm: 1.474, inductance_H: 8.446e-05,
      rotor_inertia_kg_m2: 4.41e-05, gear_ratio: 100, gear_damping_N_m_s_per_rad: 8.747e-06, voltage_limit_V: 24,
      peak_current_A: 7.15, coulomb_friction_N_m: 0.06832}
  chain:
    - {axis: z, length_m: 0, mass_kg: 0.5815, initial_deg: -1.679}
    - {axis: y, length_m: 0.3113, mass_kg: 0.1484, initial_deg: 105.76}
    - {axis: z, length_m: 0.2207, mass_kg: 0.2854, initial_deg: 3.642}
    - {axis: y, length_m: 0.2798, mass_kg: 0.4424, initial_deg: 8.855}
    - {axis: y, length_m: 0.1711, mass_kg: 0.58, initial_deg: -68.58}
controller: {type: joint_pd, k_p_V_per_rad: 748.5, k_d_V_s_per_rad: 38.77}
surfaces:
  s: {type: box, center_m: [0.7662, -0.01972, -0.3934], edges_m: [0.389, 0.4654, 0.2649], rpy_deg: [0, 0, -39.31]}
contacts: {law: unilateral, friction: 0.1848, points: {elbow: {body: link_5, surface: s}}}
initial: {on_surface: [elbow]}
loads:
  tool: {type: payload, body: link_5, point_m: [0, 0, 0.1711], mass_kg: 0.3637, radius_m: 0.03}
  push: {type: samples, body: link_5, times_s: [0.5748, 1.1495, 1.7243],
    force_N: [[0, 0, 0], [6.634, -1.45, 0.763], [0, 0, 0]]}
record: {rate_hz: 100}
"""


@pytest.mark.long
def test_elbow_that_creeps_beside_resting_joints_keeps_its_forces(tmp_path: Path):
    """Such a run stopped at 0.9003 s, where no forces seemed to agree with Coulomb's law."""
    events, steps = (run(tmp_path, CREEP, integrator__method=method) for method in ("dopri5", STEPS))
    assert events.time[-1] == pytest.approx(0.95)
    assert steps.summary["electrical_energy_J"] == pytest.approx(events.summary["electrical_energy_J"], rel=1e-2)


# A plate with an arm on it falls onto a slope and rests on a foot of each, the joint between at its stop. If both feet
# stick, that joint cannot turn either: dry friction, stop and feet share forces in two ways.
PLATE_ON_TWO_FEET = """
name: plate
duration_s: 0.6
plant:
  type: urdf_arm
  file: plate.urdf
  initial_pose:
    root: {position_m: [0, 0, 0.45], rpy_deg: [-33.97236522683579, -20.250416579536683, -11.350365005671776]}
surfaces: {ramp: {type: plane, normal: [0.3, 0.2, 1], point_m: [0, 0, -0.02]}, floor: {type: plane}}
contacts:
  law: unilateral
  points:
    corner: {body: plate, point_m: [0.17664854503435728, -0.1926696722499561, -0.003297931292976654], surface: floor,
      friction: 0.6750320362111808, restitution: 0.3}
    arm_foot: {body: arm, point_m: [-0.0676006756783731, 0.16344847243547678, -0.053920206499389736], radius_m: 0.02,
      surface: ramp, friction: 0.4275153818026888, static_friction: 0.5985215345237642, restitution: 0.3}
    plate_foot: {body: plate, point_m: [0.035115196085399564, -0.10058033620298722, -0.013983361998443397],
      surface: ramp, friction: 0.6266830781310992}
integrator: {rtol: 1.0e-9, atol: 1.0e-11}
record: {rate_hz: 1000}
"""
PLATE_URDF = """<robot name="plate_and_arm">
  <link name="world"/>
  <link name="plate"><inertial><origin xyz="0.011564602077909138 0.018949026680163447 -0.0093355945324286"/>
    <mass value="2"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.018551451341330696 0.09639068310852632 0.06721990416580462"/>
    <mass value="0.5"/><inertia ixx="0.004" ixy="0" ixz="0" iyy="0.005" iyz="0" izz="0.003"/></inertial></link>
  <joint name="root" type="floating"><parent link="world"/><child link="plate"/></joint>
  <joint name="hinge" type="revolute"><parent link="plate"/><child link="arm"/><origin xyz="0 0 0.1"/>
    <axis xyz="-0.9365477163197146 0.3939383568003809 -0.5240866279019979"/>
    <limit lower="-0.4" upper="0.3" effort="100" velocity="100"/><dynamics damping="0.01" friction="0.05"/></joint>
</robot>"""


@pytest.mark.parametrize("method", [pytest.param("dopri5", marks=pytest.mark.long), "radau5"])
def test_joint_at_its_stop_shares_forces_with_feet_that_stick(tmp_path: Path, method: str):
    """Splits did not know the stop, which kept half of the torque, and friction 10 times its bound: the run stopped, as
    foot and joint began and ceased to slip every 0.2 µs."""
    (tmp_path / "plate.urdf").write_text(PLATE_URDF, encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(PLATE_ON_TWO_FEET, encoding="utf-8")
    scenario = load_scenario(tmp_path / "scene.yaml", None, {"integrator.method": method})
    start = Simulation(scenario).state
    v = [-0.72260532, -0.07269526, 0.44573297, 1.01726545, -3.94269556, 4.55450325, 0.0]
    simulation = Simulation(scenario, state=replace(start, v=np.array(v)))
    simulation.advance(0.6)
    record = simulation.record()
    # Ten bounces, two landings, and what the joint does.
    assert len(record.events) < 30
    held = record.time > 0.575
    assert held.sum() > 20
    assert (record["contact_mode"][held, 1:] == STICKING).all()
    assert np.abs(record["joint_friction"][held]).max() <= 0.05 * (1.0 + 1e-9)
    assert record["stop_force"][held].min() > 0.5
    normal, force = record["contact_normal_force"][held], record["contact_force"][held]
    friction = np.sqrt(np.maximum((force**2).sum(axis=2) - normal**2, 0.0))
    assert (friction[:, 1:] <= np.array([0.5985215345237642, 0.6266830781310992]) * normal[:, 1:] * (1.0 + 1e-9)).all()
    # Together they carry what moves the plate and its arm.
    model, normal_of_ramp = simulation.model, np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    feet = scenario.config.contacts.points
    for k in np.flatnonzero(held)[::5]:
        q, rates = record["q"][k], record["v"][k]
        supplied = np.zeros(7)
        supplied[6] = record["stop_force"][k, 0] + record["joint_friction"][k, 0] - 0.01 * rates[6]
        for c, foot in ((1, feet["arm_foot"]), (2, feet["plate_foot"])):
            R, _ = model.body_pose(foot.body, q)
            touching = np.array(foot.point_m) - foot.radius_m * R.T @ normal_of_ramp
            supplied += model.point_jacobian(foot.body, touching, q).T @ record["contact_force"][k, c]
        needed = model.inverse_dynamics(q, rates, record["vdot"][k])
        np.testing.assert_allclose(supplied, needed, rtol=0.0, atol=1e-7)


# A free body on two feet, the right one 1e-10 m above the floor, the left one 9e-10 m: close enough to touch.
ROCKER_ON_TWO_FEET = """
name: rocker
duration_s: 0.001
plant:
  type: urdf_arm
  file: rocker.urdf
  initial_pose: {root: {position_m: [0, 0, 0.1000000005], rpy_deg: [0, 2.291831e-7, 0]}}
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  friction: 0
  points:
    left: {body: rocker, point_m: [-0.1, 0, -0.1], surface: floor}
    right: {body: rocker, point_m: [0.1, 0, -0.1], surface: floor}
record: {rate_hz: 10000}
"""
ROCKER_URDF = """<robot name="rocker"><link name="world"/><link name="rocker"><inertial><mass value="1"/>
  <inertia ixx="0.05" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
  <joint name="root" type="floating"><parent link="world"/><child link="rocker"/></joint></robot>"""


@pytest.mark.parametrize("method", EVENTS)
def test_foot_moved_below_the_floor_by_another_lands_once(tmp_path: Path, method: str):
    """As the left foot is brought onto the floor, the right one, which leaves, goes 5e-10 m below it, and does not rise
    so far before it falls back. It seemed to land there every 1e-13 s, until the run stopped."""
    (tmp_path / "rocker.urdf").write_text(ROCKER_URDF, encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(ROCKER_ON_TWO_FEET, encoding="utf-8")
    scenario = load_scenario(tmp_path / "scene.yaml", None, {"integrator.method": method})
    # The right foot leaves with 2e-5 m/s, the left one is at rest.
    rates = np.array([0.0, 0.0, 1e-5, 0.0, -1e-4, 0.0])
    simulation = Simulation(scenario, state=replace(Simulation(scenario).state, v=rates))
    simulation.advance(0.001)
    record = simulation.record()
    assert record["contact_mode"][0].tolist() == [SLIDING, OPEN]
    assert (record["contact_mode"][1:] == SLIDING).all()
    assert [(event.kind, event.name) for event in record.events] == [("landing", "right")]
    # It turns about the left foot: (I + m a²) dω/dt = −m g a, with a = 0.1 m to either foot.
    acceleration = 0.2 * 9.81 * 0.1 / (0.05 + 0.1**2)
    assert record.events[0].time == pytest.approx(2.0 * 2e-5 / acceleration, rel=1e-3)
