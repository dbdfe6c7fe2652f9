"""Declared contact points: with a radius, points that never touch, and disabled points."""

from __future__ import annotations

import numpy as np
import pytest
from support.messages import check_message, lines_with

from dynsim import build_model, load_scenario, simulate
from dynsim.compile.bracing import Brace
from dynsim.errors import SimulationStopped
from dynsim.scenario import build

ARM = """
duration_s: 0.5
plant:
  type: serial_arm
  link: {mass_kg: 0.3, length_m: 0.4, damping_N_m_s_per_rad: 0.3, motor: {type: wang_minami}}
  chain:
    - {axis: y, initial_deg: 60}
    - {axis: y, initial_deg: 57}
    - {axis: y, initial_deg: -75}
controller: {type: joint_pd, brace: optimal, min_N: 2}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 0.3, points: {elbow: {body: link_3, radius_m: 0.03}}}
initial: {on_surface: [elbow], equilibrium: true}
"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(ARM, encoding="utf-8")
    return path


def test_a_sphere_presses_where_it_touches(arm):
    """Its forces are those of a point below its centre, planned and in the run; its centre stays a radius up."""
    scenario = load_scenario(arm, overrides={"integrator.rtol": 1e-9, "integrator.atol": 1e-11})
    record = simulate(scenario)
    model, q = build_model(scenario), build.robot(scenario).initial
    assert model.point_position("link_3", [0, 0, 0], q)[2] == pytest.approx(0.03, abs=1e-12)
    R, _ = model.body_pose("link_3", q)
    lowest = Brace("link_3", R.T @ [0.0, 0.0, -0.03], np.array([0.0, 0.0, 1.0]), min_N=2.0)
    statics = model.brace_statics(q, np.zeros(3), np.zeros(3), {"elbow": lowest})
    np.testing.assert_allclose(record["torque"][0], statics.torques, rtol=0, atol=1e-6)
    assert record["contact_normal_force"][0, 0] == pytest.approx(statics.normal_forces["elbow"], abs=1e-6)
    assert np.abs(record["vdot"]).max() < 1e-6
    np.testing.assert_allclose(record["contact_gap"], 0.0, rtol=0, atol=1e-9)


def test_a_declared_brace_that_never_touches_is_said(arm):
    """Its least gap is in the summary, and a warning; a candidate that nobody declared says nothing."""
    aloft = {"controller.brace": None, "controller.min_N": 0.5, "initial": None, "plant.chain.1.initial_deg": 40}
    scenario = load_scenario(arm, overrides={**aloft, "contacts.candidates": "joints", "duration_s": 0.1})
    record = simulate(scenario)
    elbow, *others = record.summary["contacts"]
    assert elbow["closed_fraction"] == 0.0
    assert elbow["gap_min_m"] == record["contact_gap"][:, 0].min() > 0.01
    assert others
    assert not any("gap_min_m" in other for other in others)
    (warning,) = lines_with(record.summary["warnings"], "elbow", phrase="never")
    check_message(warning, "floor", f"{1e3 * elbow['gap_min_m']:.3g} mm", "initial.on_surface")


def test_a_brace_that_leaves_where_it_starts_is_not_said_never_to_touch(arm):
    """Weight pushes up: the elbow starts on the floor and leaves at once, without a force."""
    changed = {
        "controller": None,
        "initial.equilibrium": False,
        "plant.gravity_m_s2": [0, 0, 9.81],
        "duration_s": 0.05,
    }
    record = simulate(load_scenario(arm, overrides=changed))
    (text,) = lines_with(record.summary["warnings"], "elbow")
    check_message(text, "floor", "0 s", phrase="never")
    assert np.abs(record["contact_normal_force"]).max() == 0.0


def test_disabled_points_put_braced_and_free_in_one_posture(arm):
    free = {"contacts.points.elbow.enabled": False, "controller.brace": None, "controller.min_N": 0.5}
    braced, alone = (build.robot(load_scenario(arm, overrides=changed)) for changed in ({}, free))
    assert braced.initial.tobytes() == alone.initial.tobytes()
    assert not build.contacts(load_scenario(arm, overrides=free))


@pytest.mark.long  # a program of its own to compile
def test_a_glued_sphere_stays_a_radius_up(arm):
    glued = {
        "contacts.law": "bilateral",
        "controller.brace": None,
        "controller.min_N": 0.5,
        "initial.equilibrium": False,
    }
    record = simulate(load_scenario(arm, overrides={**glued, "controller.joints": {
        "joint_3": {"times_s": [0, 0.5], "angles_deg": [-75, -50]}}}))  # fmt: skip
    model = build_model(load_scenario(arm))
    heights = [model.point_position("link_3", [0, 0, 0], q)[2] for q in record["q"]]
    np.testing.assert_allclose(heights, 0.03, rtol=0, atol=1e-9)
    assert record.summary["energy_residual_relative"] < 1e-6


ALONE = """
duration_s: 2
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.75]}
  link: {mass_kg: 0.3, length_m: 0.45, motor: {type: wang_minami}}
  chain:
    - {axis: y, initial_deg: 120}
    - {axis: y, initial_deg: 30}
    - {axis: y, initial_deg: -60, length_m: 0.3}
controller: {type: joint_pd, sample_time_s: 0.005}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, friction: 2.5, points: {elbow: {body: link_3}}}
initial: {on_surface: [elbow], equilibrium: true}
"""


def test_an_elbow_that_is_alone_is_not_said_to_be_held_by_others(tmp_path):
    """It ends in the paradox, which the stop tells; there are no other braces that could hold it."""
    path = tmp_path / "alone.yaml"
    path.write_text(ALONE, encoding="utf-8")
    with pytest.raises(SimulationStopped) as raised:
        simulate(load_scenario(path))
    assert not lines_with(raised.value.record.summary["warnings"], "Painlevé")
