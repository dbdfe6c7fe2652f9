"""Equilibrium start (``initial.equilibrium``): rest under weight, loads and braces, least heat, tipping, refusals.

Accelerations of the compiled right-hand side are compared with zero, the heat with numpy's least squares.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, raises, says

import dynsim
from dynsim import check, load_scenario, simulate
from dynsim.dynamics.tables import SLIDING, STICKING
from dynsim.engine.prepare import prepare
from dynsim.errors import ModelError
from dynsim.scenario import build

# Tolerances of accelerations [rad/s²] and of changes of currents [A]: rounding of the statics, at most 1e-9 of the
# forces, divided by the inertia of the lightest links.
STILL, STEADY = 1e-6, 1e-8
HOLD = {"initial": {"equilibrium": True}, "duration_s": 0.2, "controller.hand": None}


def still(scenario):
    """A record whose motion and currents do not change."""
    record = simulate(scenario)
    assert np.abs(record["vdot"]).max() < STILL
    assert np.abs(record["current"] - record["current"][0]).max(initial=0.0) < STEADY
    return record


@pytest.mark.parametrize(
    ("name", "variant"),
    [("elbow_comparison", "two_elbows"), ("elbow_comparison", "no_elbow"), ("pressing", "plain")],
)
def test_nothing_jumps_glued_free_and_on_a_real_floor(name, variant):
    record = still(load_scenario(name, variant, HOLD))
    # The statics agree with the simulation.
    forces = [value for key, value in record.summary["equilibrium"].items() if key.endswith("normal_force_N")]
    np.testing.assert_allclose(record["contact_normal_force"][0], forces, rtol=0, atol=1e-8)
    assert record["current"][0].any()


@pytest.mark.parametrize("variant", ["gravity", "optimal"])
def test_planned_voltages_are_the_start_themselves(variant):
    """No reference moves; with plain zero currents the same start jumps."""
    scenario = load_scenario("pressing", variant, HOLD)
    record = still(scenario)
    assert not prepare(scenario).balance.shift.any()
    jumps = simulate(load_scenario("pressing", variant, {**HOLD, "initial": None}))
    assert np.abs(jumps["vdot"]).max() > 1.0
    assert record["current"][0].any()


def test_glued_braces_have_the_least_heat():
    """Σ R i² over all normal forces is a linear least-squares problem."""
    scenario = load_scenario("elbow_comparison", "two_elbows", HOLD)
    prepared = prepare(scenario)
    model, q = prepared.model, prepared.model.robot.initial
    weight = model.bias_forces(q, np.zeros(model.n))
    rows = [
        contact.surface.normal(position) @ jacobian
        for contact in prepared.contacts
        for position, jacobian in [model.point_position_and_jacobian(contact.body, contact.point, q)]
    ]
    scale = np.array([np.sqrt(m.resistance) / m.joint_constant for m in model.robot.motors])
    forces, heat, *_ = np.linalg.lstsq((np.array(rows) * scale).T, scale * weight, rcond=None)
    assert prepared.balance.heat == pytest.approx(float(heat[0]), rel=1e-9)
    np.testing.assert_allclose(list(prepared.balance.normal_forces.values()), forces, rtol=1e-6)


def test_a_load_is_held_too():
    load = {
        "type": "constant",
        "body": "link_10",
        "frame": "body",
        "force_N": [1, 2, -3],
        "torque_N_m": [0.3, 0.1, -0.2],
    }
    still(load_scenario("elbow_comparison", "two_elbows", {**HOLD, "loads": {"push": load}}))
    still(load_scenario("pressing", "gravity", {**HOLD, "loads": {"push": load}}))


MIXED = """
duration_s: 0.3
plant:
  type: serial_arm
  link: {mass_kg: 0.4, length_m: 0.3}
  chain:
    - {axis: y, initial_deg: 40, motor: {type: wang_minami}}
    - {axis: y, initial_deg: 30, motor: {type: servo, voltage_V: 12, stall_torque_N_m: 8.4,
        no_load_speed_rad_per_s: 4.7, k_p_V_per_rad: 60, rotor_inertia_kg_m2: 0.01, coulomb_friction_N_m: 0.2}}
    - {axis: y, initial_deg: 10, motor: {type: torque}}
controller: {type: joint_pd, k_p_V_per_rad: [300], k_d_V_s_per_rad: 10}
initial: {equilibrium: true}
"""


@pytest.fixture
def mixed(tmp_path):
    path = tmp_path / "mixed.yaml"
    path.write_text(MIXED, encoding="utf-8")
    return path


def test_every_kind_of_drive_that_can_holds(mixed):
    record = still(load_scenario(mixed))
    weight = build.build_model(load_scenario(mixed)).bias_forces(record["q"][0], np.zeros(3))
    np.testing.assert_allclose(record["torque"][0], weight, rtol=0, atol=1e-9)
    # What follows a rewritten reference holds too.
    simulation = dynsim.Simulation(load_scenario(mixed))
    simulation.advance(0.1)
    for joint, angle in zip(simulation.robot.joint_names, np.radians([40.0, 30.0, 10.0]), strict=True):
        simulation.set_reference(joint, 0.0 if joint == "joint_3" else angle)
    simulation.advance(0.3)
    np.testing.assert_allclose(simulation.state.q, record["q"][0], rtol=0, atol=1e-9)


def test_sampled_commands_hold(mixed):
    still(load_scenario(mixed, overrides={"controller.sample_time_s": 0.001}))


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        ({"controller.k_p_V_per_rad": 0.0}, ["joint_1", "k_p = 0"]),
        ({"controller": None}, ["joint_1"]),
        ({"plant.chain.0.motor": None, "controller": {"type": "joint_pd"}}, ["joint_1"]),
        ({"plant.chain.2.motor.limit_N_m": 0.05}, ["joint_3", "0.05 N m"]),
        (
            {
                "plant.chain.1.motor.mode": "velocity",
                "plant.chain.1.motor.k_p_V_per_rad": 0,
                "plant.chain.1.motor.k_v_V_s_per_rad": 9,
            },
            ["joint_2"],
        ),
    ],
)  # fmt: skip
def test_what_cannot_hold_is_named(mixed, overrides, names):
    with raises(ModelError, "mixed.yaml", "initial.equilibrium", *names):
        simulate(load_scenario(mixed, overrides=overrides))


def test_a_path_that_begins_elsewhere_jumps_and_is_said():
    record = simulate(
        load_scenario("elbow_comparison", "two_elbows", {"initial": {"equilibrium": True}, "duration_s": 0.2})
    )
    (jumps,) = lines_with(record.summary["warnings"], phrase="start jumps")
    check_message(jumps, "initial.equilibrium", "joint_1", "-1.85°")
    changed = {"initial": {"equilibrium": True}, "duration_s": 0.2}
    assert jumps in check(load_scenario("elbow_comparison", "two_elbows", changed)).warnings
    # Still less than a start without currents.
    plain = simulate(load_scenario("elbow_comparison", "two_elbows", {"duration_s": 0.2}))
    assert np.abs(record["vdot"][0]).max() < np.abs(plain["vdot"][0]).max()


def test_an_operator_takes_over_from_the_start_at_rest():
    """Still until the first command, and no sag when it rewrites references: the hand follows the command."""
    operator = {"joints": ["joint_1", "joint_9", "joint_10"], "commands": [{"at_s": 0.1, "hand": [0.0, 0.0, 0.01]}]}
    controller = {"type": "joint_pd", "operator": operator}
    overrides = {"controller": controller, "initial": {"equilibrium": True}, "duration_s": 0.6}
    record = simulate(load_scenario("elbow_comparison", "two_elbows", overrides))
    before = record.time <= 0.1
    assert np.abs(record["vdot"][before]).max() < STILL
    displacement = record["hand_position"] - record["hand_position"][0]
    # Eased in at 0.5 m/s², the way of 0.5 s at 10 mm/s is 5 mm less 0.1.
    assert displacement[-1, 2] == pytest.approx(0.005, abs=0.6e-3)
    assert np.abs(displacement[:, :2]).max() < 0.5e-3
    assert displacement[:, 2].min() > -1e-5


MOBILE = {"duration_s": 0.6, "controller.hand": None, "metrics.settle_s": 0.4}


def mobile(variant="two_elbows", **overrides):
    return load_scenario("mobile_elbow_comparison", variant, {**MOBILE, **overrides})


def test_a_base_does_not_tip_for_a_jolt_of_the_start_alone():
    """A path that begins elsewhere tips it at once; the rest of the run is not reported as tipping.

    A start at rest does not tip, and the margin that check reports equals the margin of the run.
    """
    jolted = simulate(load_scenario("mobile_elbow_comparison", "two_elbows", {"duration_s": 2.5}))
    base, warnings = jolted.summary["base"], " ".join(jolted.summary["warnings"])
    assert base["overturns_at_s"] < 0.01
    assert base["overturns_settled_at_s"] is None
    assert says(warnings, "jolt")
    assert not says(warnings, "tips over")
    held = mobile(initial={"equilibrium": True})
    at_rest = still(held)
    base = at_rest.summary["base"]
    assert base["overturns_at_s"] is base["overturns_settled_at_s"] is None
    start = dynsim.check(held)
    assert start.tip_margin < 0.0 < start.tip_margin_braced
    assert start.tip_margin_braced == pytest.approx(base["tip_margin_min"], abs=1e-7)


def test_a_base_that_cannot_stand_tips_over_from_the_settled_time_on():
    scenario = mobile("no_elbow", initial={"equilibrium": True})
    record = still(scenario)
    assert record.summary["base"]["overturns_settled_at_s"] == 0.4
    assert lines_with(record.summary["warnings"], phrase="tips over")
    start = dynsim.check(scenario)
    assert start.tip_margin == pytest.approx(record["tip_margin"][0], abs=1e-9)
    assert start.tip_margin_braced is None


def test_what_has_no_motors_rests_on_friction_or_is_refused():
    """A block on a slope of 0.4: only friction holds it, so the statics without friction are not the last."""
    held = {"initial": {"equilibrium": True}, "duration_s": 0.1}
    record = still(load_scenario("block_on_slope", "rests", held))
    assert record["contact_mode"][0, 0] == 2
    with raises(ModelError, "initial.equilibrium", "joint_3", "foot"):
        simulate(load_scenario("block_on_slope", "slides", held))


# The tip is straight below a joint without a motor, so that only friction balances the weight about it. The least heat
# presses the tip no more than that friction needs.
ON_FRICTION = """
name: on_friction
duration_s: 0.1
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.32139380484326966]}
  link: {radius_m: 0.02, mass_kg: 0.4, length_m: 0.25, damping_N_m_s_per_rad: 0.01}
  chain:
    - {axis: y, initial_deg: 130}
    - {axis: y, initial_deg: 100, motor: {type: wang_minami}}
controller: {type: joint_pd}
initial: {equilibrium: true}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.2, points: {tip: {body: link_2, point_m: [0, 0, 0.25], surface: floor}}}
record: {rate_hz: 1000}
"""


def test_start_that_needs_friction_keeps_a_tenth_in_reserve(tmp_path):
    path = tmp_path / "on_friction.yaml"
    path.write_text(ON_FRICTION, encoding="utf-8")
    record = simulate(load_scenario(path, overrides={"integrator.method": "dopri5"}))
    assert (record["contact_mode"] == STICKING).all()
    assert np.abs(record["v"]).max() < 1e-9
    force, normal = record["contact_force"][0, 0], record["contact_normal_force"][0, 0]
    # Tolerance of the program of the statics.
    assert np.hypot(force[0], force[1]) == pytest.approx(0.9 * 0.2 * normal, rel=1e-6)
    assert not [warning for warning in record.summary["warnings"] if "initial.equilibrium" in warning]


def test_start_that_slips_on_the_edge_of_its_cone_is_reported():
    """Static friction of a slope's angle, to the tolerance of the statics; kinetic friction does not hold the block."""
    start = {"initial": {"equilibrium": True}, "duration_s": 0.01}
    record = simulate(load_scenario("block_on_slope", "slides", {**start, "contacts.static_friction": 0.4 - 4e-10}))
    assert record["contact_mode"][-1, 0] == SLIDING
    assert lines_with(record.summary["warnings"], "initial.equilibrium", "contacts.friction", re.compile(r"\bt = "))
    # All of the friction is needed here too, but rounding does not decide.
    holds = still(load_scenario("block_on_slope", "slides", {**start, "contacts.static_friction": 0.42}))
    assert not [warning for warning in holds.summary["warnings"] if "initial.equilibrium" in warning]


COMPLIANT = """
duration_s: 0.1
plant:
  type: serial_arm
  link: {mass_kg: 0.4, length_m: 0.3}
  base: {position_m: [0, 0, 0.15]}
  chain:
    - {axis: y, initial_deg: 120, motor: {type: wang_minami}}
    - {axis: y, initial_deg: -30, motor: {type: wang_minami}}
controller: {type: joint_pd, k_p_V_per_rad: 300, k_d_V_s_per_rad: 10}
surfaces: {floor: {type: plane}}
contacts:
  law: unilateral
  stiffness_N_per_m: 2.0e+4
  friction: 0.4
  points: {elbow: {body: link_2, surface: floor}}
objects:
  thing: {mass_kg: 0.5, size_m: [0.2, 0.1, 0.1], position_m: [2, 0, 0.05]}
initial: {equilibrium: true}
integrator: {method: time_stepping}
"""


@pytest.mark.parametrize(("plan", "counts"), [("feed_forward: gravity", False), ("brace: {elbow: 1.0}", True)])
def test_only_plans_that_leave_weight_to_a_compliant_contact_count_on_it(tmp_path, plan, counts):
    path = tmp_path / "compliant.yaml"
    arm = "".join(line for line in COMPLIANT.splitlines(True) if "thing" not in line and "objects" not in line)
    path.write_text(arm.replace("k_d_V_s_per_rad: 10}", f"k_d_V_s_per_rad: 10, {plan}}}"))
    said = lines_with(simulate(load_scenario(path)).summary["warnings"], "elbow", phrase="start jumps")
    assert bool(said) == counts


def test_compliant_contacts_start_pressed_in(tmp_path):
    """An arm on a compliant brace, and a box on four springs, whose shares rigid bodies do not determine.

    The force of each is its stiffness times its depth, all four carry the weight of the box, and nothing accelerates.
    """
    path = tmp_path / "compliant.yaml"
    path.write_text(COMPLIANT)
    record = simulate(load_scenario(path))
    assert np.abs(record["vdot"]).max() < STILL
    gap, force = record["contact_gap"][0], record["contact_normal_force"][0]
    np.testing.assert_allclose(force, 2e4 * np.maximum(-gap, 0.0), rtol=0, atol=1e-6)
    names = record.labels["contact_gap"]
    corners = [k for k, name in enumerate(names) if name.startswith("thing") and force[k] > 0.0]
    assert len(corners) == 4
    np.testing.assert_allclose(force[corners], 0.5 * 9.81 / 4.0, rtol=1e-6)
    assert force[names.index("elbow")] > 0.1
    np.testing.assert_allclose(record["q"][-1], record["q"][0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("stiffness", "moves"), [("2.0e+4", False), ("100", True)])
def test_a_start_that_pressing_moves_far_is_told(tmp_path, stiffness, moves):
    """Springs so soft that they press only centimetres deep move the joints of the arm; the warning has the number."""
    path = tmp_path / "soft.yaml"
    path.write_text(COMPLIANT.replace("2.0e+4", stiffness))
    record = simulate(load_scenario(path))
    (moved,) = np.degrees(record["q"][:1, :2]) - [120.0, -30.0]
    assert (np.abs(moved).max() > 1.0) == moves
    said = lines_with(record.summary["warnings"], "initial.equilibrium")
    assert len(said) == moves
    assert all(mentions(text, "joint_1", f"{moved[0]:.3g}°") for text in said)
    start = check(load_scenario(path))
    assert lines_with(start.warnings, "initial.equilibrium") == said
    np.testing.assert_allclose(start.hand, record["hand_position"][0], rtol=0, atol=1e-12)
    assert start.gaps["elbow"] == pytest.approx(record["contact_gap"][0, record.labels["contact_gap"].index("elbow")])


def compliant_arm(tmp_path, replacements, **overrides):
    """A start at rest of the arm of COMPLIANT without the box, which rests on the contacts that it presses in."""
    text = COMPLIANT.replace("objects:\n", "").replace(
        "  thing: {mass_kg: 0.5, size_m: [0.2, 0.1, 0.1], position_m: [2, 0, 0.05]}\n", ""
    )
    for old, new in replacements.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "arm.yaml"
    path.write_text(text, encoding="utf-8")
    record = simulate(load_scenario(path, overrides=overrides))
    assert np.abs(record["vdot"]).max() < STILL
    gap, force = record["contact_gap"][0], record["contact_normal_force"][0]
    elbow = record.labels["contact_gap"].index("elbow")
    assert force[elbow] == pytest.approx(2e4 * max(-gap[elbow], 0.0), abs=1e-6)
    return record


def test_forces_that_no_heat_determines_stay_as_they_are_pressed_in(tmp_path):
    """Torque motors have no heat: least heat does not determine how hard the elbow presses."""
    record = compliant_arm(
        tmp_path,
        {"{type: wang_minami}": "{type: torque, limit_N_m: 80}", ", k_p_V_per_rad: 300, k_d_V_s_per_rad: 10": ""},
    )
    assert record["contact_normal_force"][0, 0] > 0.1


def test_a_rigid_contact_opens_where_it_would_wedge_an_arm_that_presses_another_in(tmp_path):
    """Weight turns the first joint, which has no motor, until the spring of the elbow carries: moments about it vanish.

    A rigid stop above the first link begins closed; the elbow cannot be pressed in unless the stop opens.
    """
    stop = "tip: {body: link_1, point_m: [0, 0, 0.29], surface: ceiling}"
    replacements = {
        "- {axis: y, initial_deg: 120, motor: {type: wang_minami}}": "- {axis: y, initial_deg: 120}",
        "{type: plane}": "{type: plane}, ceiling: {type: plane, point_m: [0, 0, 0.005], normal: [0, 0, -1]}",
        "  stiffness_N_per_m: 2.0e+4\n": "",
        "friction: 0.4": "friction: 0.0",
        "surface: floor}": f"surface: floor, stiffness_N_per_m: 2.0e+4}}, {stop}",
    }
    record = compliant_arm(tmp_path, replacements)
    names = record.labels["contact_gap"]
    elbow, tip = names.index("elbow"), names.index("tip")
    first, second = record["q"][0, 0], record["q"][0, :2].sum()
    levers = 0.15 * np.sin(first) + 0.3 * np.sin(first) + 0.15 * np.sin(second)
    force = 0.4 * 9.81 * levers / (0.3 * np.sin(first))
    assert record["contact_normal_force"][0, elbow] == pytest.approx(force, rel=1e-9)
    assert record["contact_gap"][0, elbow] == pytest.approx(-force / 2e4, rel=1e-9)
    assert record["contact_gap"][0, tip] == pytest.approx(0.29 / 0.3 * force / 2e4, rel=1e-9)
    assert record["q"][0, 1] == pytest.approx(np.radians(-30.0), abs=1e-6)


def test_a_rigid_contact_keeps_a_compliant_one_from_being_pressed_in_deeper(tmp_path):
    """A rigid stop 20 µm below the floor of a compliant elbow: the spring carries what 20 µm are, the stop the rest."""
    replacements = {
        "  chain:\n": "  chain:\n    - {axis: z, length_m: 0, initial_deg: 20, motor: {type: wang_minami}}\n",
        "{type: plane}": "{type: plane}, lower: {type: plane, point_m: [0, 0, -2.0e-5]}",
        "  stiffness_N_per_m: 2.0e+4\n": "",
        "{body: link_2, surface: floor}": "{body: link_3, surface: floor, stiffness_N_per_m: 2.0e+4}, "
        "stop: {body: link_3, surface: lower}",
    }
    record = compliant_arm(tmp_path, replacements)
    np.testing.assert_allclose(record["contact_gap"][0], [-2e-5, 0.0], rtol=0, atol=1e-12)
    assert record["contact_normal_force"][0, 1] > 0.5
    assert record["q"][0, 0] == pytest.approx(np.radians(20.0), abs=1e-12)


GANTRY = """
duration_s: 0.01
plant:
  type: serial_arm
  link: {mass_kg: 1, length_m: 0.1}
  base: {position_m: [0, 0, 0.5]}
  chain:
    - {axis: x, kind: prismatic, length_m: 0, motor: {type: wang_minami}}
    - {axis: z, kind: prismatic, motor: {type: wang_minami}}
controller: {type: joint_pd, k_p_V_per_rad: 3000, k_d_V_s_per_rad: 100}
surfaces:
  floor: {type: plane, point_m: [0, 0, 0.5]}
  ball: {type: sphere, center_m: [-0.00005, 0, 0.6009987492], radius_m: 0.001}
contacts:
  law: unilateral
  stiffness_N_per_m: 2.0e+4
  points: {foot: {body: link_2, surface: floor}, tip: {body: link_2, point_m: [0, 0, 0.1], surface: ball}}
initial: {equilibrium: true}
integrator: {method: time_stepping}
"""


def test_a_contact_that_opens_leaves_no_displacement(tmp_path):
    """As its foot is pressed in, a gantry sinks off a small ball above it: nothing moves it along the floor."""
    path = tmp_path / "gantry.yaml"
    path.write_text(GANTRY, encoding="utf-8")
    record = simulate(load_scenario(path))
    assert np.abs(record["vdot"]).max() < STILL
    (foot, tip), depth = record["contact_normal_force"][0], -record["q"][0, 1]
    assert foot == pytest.approx(2e4 * depth, rel=1e-9)
    assert foot > 0.5
    assert tip == 0.0
    assert record["q"][0, 0] == pytest.approx(0.0, abs=1e-12)
