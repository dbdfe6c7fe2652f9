"""Braced postures, hand paths with braces, planned voltages, and prescribed brace forces."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.compile.bracing import Brace, PressingBrace
from dynsim.compile.posture import gaps_and_rates
from dynsim.compile.references.inverse_kinematics import pressing
from dynsim.engine import check
from dynsim.errors import DynsimError
from dynsim.scenario import build

ELBOWS = ["elbow_4", "elbow_7"]
FORCES = {"elbow_4": 3.0, "elbow_7": 8.0}


def scenario(variant: str = "two_elbows", **overrides):
    return dynsim.load_scenario("elbow_comparison", variant=variant, overrides=overrides)


def real_floor(tmp_path, **overrides):
    """The published arm on a floor with unilateral contact."""
    text = dynsim.load_scenario("elbow_comparison", variant="two_elbows").source.read_text()
    for line in ("  slip_smoothing_m_s: 0.001 ", "  pulling_friction: signed "):
        assert line in text
        text = text.replace(line, "  # ")
    path = tmp_path / "real_floor.yaml"
    path.write_text(text.replace("law: bilateral", "law: unilateral"))
    return dynsim.load_scenario(path, variant="two_elbows", overrides=overrides)


OFF = [0, 40, 92, -80, 50, 45, -95, 45, -45, 45]


@pytest.mark.parametrize("keep", [[], ["joint_2", "joint_5"], ["hand"], ["hand", "joint_1"]])
def test_posture_on_the_surfaces_with_least_change(keep):
    """Gaps to 1e-12, what is kept stays, and no motion along the surfaces comes closer to the posture asked for."""
    asked = dynsim.build_model(scenario(**{"plant.initial_deg": OFF}))
    case = scenario(**{"plant.initial_deg": OFF, "initial": {"on_surface": ELBOWS, "keep": keep}})
    model = dynsim.build_model(case)
    q, q_0 = model.robot.initial, asked.robot.initial
    gaps, J = gaps_and_rates(model, build.contacts(case), q)
    assert np.abs(gaps).max() <= 1e-12
    assert np.abs(gaps_and_rates(model, build.contacts(case), q_0)[0]).max() > 1e-3
    free = np.array([name not in keep for name in model.joint_names])
    assert np.array_equal(q[~free], q_0[~free])
    if "hand" in keep:
        hand = model.robot.hand
        assert model.point_position(*hand, q) == pytest.approx(model.point_position(*hand, q_0), abs=1e-12)
        J = np.vstack([J, model.point_jacobian(*hand, q)])
    along = np.linalg.svd(J[:, free])[2][np.linalg.matrix_rank(J[:, free], tol=1e-9) :]
    assert np.abs(along @ (q - q_0)[free]).max() <= 1e-7


def test_joints_stay_within_their_limits_on_the_way_to_the_surfaces(tmp_path: Path) -> None:
    """A joint that would go beyond stays at its limit and the others reach the surface; or none do, which is said."""
    path = tmp_path / "arm.yaml"
    arm = """
name: arm
duration_s: 1
plant: {type: serial_arm, base: {position_m: [0, 0, 0.2]}, chain: [
  {axis: y, length_m: 0.4, mass_kg: 1, initial_deg: 60, limit_deg: [-90, 100]},
  {axis: y, length_m: 0.4, mass_kg: 1, initial_deg: 20, limit_deg: [-UPPER, UPPER]}]}
controller: {type: joint_pd}
initial: {on_surface: [tip]}
surfaces: {floor: {type: plane}}
contacts: {law: unilateral, points: {tip: {body: link_2, point_m: [0, 0, 0.4]}}}
"""
    path.write_text(arm.replace("UPPER", "170"), encoding="utf-8")
    free = dynsim.build_model(dynsim.load_scenario(path)).robot.initial
    assert np.degrees(free[1]) > 25.0
    path.write_text(arm.replace("UPPER", "25"), encoding="utf-8")
    case = dynsim.load_scenario(path)
    model = dynsim.build_model(case)
    assert np.degrees(model.robot.initial[1]) == pytest.approx(25.0)
    assert np.degrees(model.robot.initial[0]) <= 100.0
    assert np.abs(gaps_and_rates(model, build.contacts(case), model.robot.initial)[0]).max() <= 1e-12
    path.write_text(arm.replace("UPPER", "25").replace("[-90, 100]", "[-90, 62]"), encoding="utf-8")
    with raises(DynsimError, "tip", "joint_1, joint_2", re.compile(r"\b0\.\d+ m\b"), "initial"):
        dynsim.build_model(dynsim.load_scenario(path))


def test_candidates_are_put_on_their_surfaces_too():
    """Ends of links rest a radius above the floor; the axis of a link is no point that could be put anywhere."""
    start = {"plant.initial_deg": OFF, "surfaces.floor.point_m": [0, 0, -0.02]}
    case = dynsim.load_scenario(
        "elbow_comparison_links", overrides={**start, "initial": {"on_surface": ["joint_4", "joint_7"]}}
    )
    model = dynsim.build_model(case)
    for body in ("link_4", "link_7"):
        assert model.point_position(body, [0, 0, 0], model.robot.initial)[2] == pytest.approx(-0.01, abs=1e-12)
    pillar = {"type": "sphere", "center_m": [0, 0, -9], "radius_m": 1}
    with raises(DynsimError, "initial.on_surface", "'link_4'"):
        dynsim.build_model(
            dynsim.load_scenario(
                "elbow_comparison_links",
                overrides={"surfaces": {"floor": pillar}, "initial": {"on_surface": ["link_4"]}},
            )
        )


def test_posture_that_no_joint_can_reach_is_refused():
    everything = [f"joint_{k}" for k in range(1, 11)]
    with raises(DynsimError, "initial", "elbow_4, elbow_7", "0.1 m"):
        dynsim.build_model(
            scenario(**{"plant.initial_deg": OFF, "initial": {"on_surface": ELBOWS, "keep": everything}})
        )
    with raises(DynsimError, "initial.on_surface", "'elbow_5'", "elbow_4, elbow_7"):
        dynsim.build_model(scenario(initial={"on_surface": ["elbow_5"]}))


def test_the_whole_chain_follows_the_hand_with_its_braces_on_the_floor():
    chain = [f"joint_{k}" for k in range(1, 11)]
    case = scenario(duration_s=2.0, **{"controller.hand.joints": chain, "controller.hand.braces": ELBOWS})
    model = dynsim.build_model(case)
    control = build.controller(case, model)
    contacts = build.contacts(case)
    moved = np.zeros(10)
    for times, positions in control.positions(model.robot):
        target = control.target(times)
        for q, wanted in zip(positions[::4], target[::4], strict=True):  # at the knots
            assert np.abs(gaps_and_rates(model, contacts, q)[0]).max() <= 1e-9
            assert np.linalg.norm(model.point_position(*model.robot.hand, q) - wanted) <= 1e-9
            moved = np.maximum(moved, np.abs(q - model.robot.initial))
    assert (moved > 1e-6).sum() >= 4  # more joints than without braces: yaw and the last two


def test_planned_voltages_are_what_the_motion_takes():
    """Without feedback the arm follows its references, and each circuit is in balance: u = R i + L di/dt + K_m v."""
    gains = {"controller.k_p_V_per_rad": 0.0, "controller.k_d_V_s_per_rad": 0.0}
    case = scenario(duration_s=0.3, **gains, **{"controller.brace": FORCES})
    record = dynsim.simulate(case)
    model, control = dynsim.build_model(case), build.controller(case, dynsim.build_model(case))
    k = np.searchsorted(record.time, 0.2)
    powers = (record.time[k] % control.reference.grid[1]) ** np.arange(6)
    segment = int(record.time[k] / control.reference.grid[1] + 1e-9)
    planned = control.reference.voltage[segment] @ np.where(powers < 1e-12, np.eye(6)[0], powers)
    assert record["voltage"][k] == pytest.approx(planned, abs=1e-6)
    assert np.abs(planned).max() > 1.0
    assert len(model.robot.motors) == 10


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
def test_elbows_press_as_commanded(law, tmp_path):
    """Within 2 % (they are within 1e-4) after a second, glued floor and real one; and the hand follows better."""
    make = (lambda **more: real_floor(tmp_path, **more)) if law == "unilateral" else scenario
    short = {"duration_s": 3.0, "metrics.settle_s": 1.0}
    plain, pressed = (dynsim.simulate(make(**short, **more)) for more in ({}, {"controller.brace": FORCES}))
    late = pressed.time >= 1.0
    forces = pressed["contact_normal_force"][late]
    assert np.abs(forces / np.array([3.0, 8.0]) - 1.0).max() <= 1e-4
    assert np.abs(plain["contact_normal_force"][late] / np.array([3.0, 8.0]) - 1.0).max() > 0.02
    assert pressed.summary["hand_error_rms_m"] < 0.2 * plain.summary["hand_error_rms_m"]
    assert pressed.summary["electrical_energy_J"] > plain.summary["electrical_energy_J"]


def test_least_heat_keeps_both_elbows_on_the_real_floor(tmp_path):
    """No less than min_N, and no more heat than any commanded pair of forces nearby."""
    short = {"duration_s": 3.0, "metrics.settle_s": 1.0}
    best = dynsim.simulate(real_floor(tmp_path, **short, **{"controller.brace": "optimal"}))
    late = best.time >= 1.0
    assert best["contact_normal_force"][late].min() >= 0.5 * (1.0 - 1e-3)
    k = np.flatnonzero(late)[0]
    at = dict(zip(ELBOWS, best["contact_normal_force"][k], strict=True))
    heat = np.sum(1.1 * best["current"][k] ** 2)
    case = real_floor(tmp_path)
    model = dynsim.build_model(case)
    for change in (-0.2, 0.2):
        braces = {
            c.name: Brace(
                c.body,
                c.point,
                np.array([0.0, 0.0, 1.0]),
                friction=0.1,
                normal_force=at[c.name] + (change if c.name == "elbow_7" else 0.0),
                sliding=best["contact_slip_velocity"][k, i],
            )
            for i, c in enumerate(build.contacts(case))
        }
        statics = model.brace_statics(best["q"][k], best["v"][k], best["vdot"][k], braces)
        assert statics.heat > heat * (1.0 - 1e-3)


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        ({"controller.brace": {"elbow_9": 1.0}}, ["controller.brace", "'elbow_9'", "elbow_4, elbow_7"]),
        ({"controller.brace": {"elbow_4": -1.0}}, ["controller.brace.elbow_4 = -1.0", "0 N"]),
        (
            {"controller.brace": "optimal", "controller.feed_forward": "gravity"},
            ["controller.feed_forward = 'gravity'"],
        ),
        ({"controller.min_N": 1.0}, ["controller.min_N = 1.0", "brace: optimal"]),
    ],
)
def test_refused(overrides, names):
    model = dynsim.build_model(scenario())
    with raises(DynsimError, *names):
        build.controller(scenario(**overrides), model)


def test_plan_without_braces_that_is_too_fast_names_its_own_key():
    case = dynsim.load_scenario(
        "six_axis_arm", overrides={"controller.feed_forward": "dynamics", "plant.motor.voltage_limit_V": 0.05}
    )
    with raises(DynsimError, "controller.feed_forward: at t", "no motor torques", "voltage_limit_V") as error:
        dynsim.Simulation(case)
    assert "brace" not in str(error.value)


def test_a_brace_in_the_air_is_refused(tmp_path):
    """Nothing would carry what is planned for it."""
    raised = {"plant.base.position_m": [0.0, 0.0, 0.3], "controller.hand.path.center_m": [1.5, 1.5, 0.7]}
    case = real_floor(tmp_path, **{"controller.brace": FORCES}, **raised)
    with raises(DynsimError, "controller.brace", "elbow_4", "+0.3 m", "floor"):
        dynsim.simulate(case)


def mixed_forces(shares):
    """Torques (T, n), normal forces (T, c) and number of solved samples in one posture with shares of both elbows."""
    case = scenario()
    model = dynsim.build_model(case)
    contacts = build.contacts(case)
    braces = {c.name: PressingBrace(c, force) for c, force in zip(contacts, (3.0, None), strict=True)}
    times = np.linspace(0.0, 1.0, len(shares))
    q, still = np.tile(model.robot.initial, (len(times), 1)), np.zeros((len(times), model.n))
    planner, tables, every = pressing(model, times, q, still, braces)
    assert every is None
    return planner.least_heat(q, still, still, tables, np.array(shares))


def test_shares_mix_solutions_of_brace_sets():
    """Bound: rounding of a sum of three solutions, 1e-12 of the torques."""
    corners, _, solved = mixed_forces([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    torques, forces, _ = mixed_forces([[0.25, 0.75], [1.0, 0.5], [0.0, 0.25]])
    none, first, second, both = corners
    assert solved == 4
    assert np.abs(none - first).max() > 0.1
    wanted = [0.25 * both + 0.5 * second + 0.25 * none, 0.5 * (both + first), 0.25 * second + 0.75 * none]
    assert np.abs(torques - wanted).max() <= 1e-12 * np.abs(corners).max()
    assert forces[:, 0] == pytest.approx([0.75, 3.0, 0.0], abs=1e-12)


def test_share_of_a_brace_rises_and_falls_inside_its_intervals():
    times = np.linspace(0.0, 4.0, 81)
    share = PressingBrace(build.contacts(scenario())[0], None, ((0.0, 1.0), (2.0, 4.0))).share(times)
    assert share[[0, 18, 19, 20, 30, 40, 41, 42, 80]] == pytest.approx([1, 1, 0.5, 0, 0, 0, 0.5, 1, 1], abs=1e-12)
    assert np.array_equal(PressingBrace(build.contacts(scenario())[0]).share(times), np.ones(81))


def test_currents_do_not_jump_at_a_hand_over():
    """Half the sampling step halves the largest change of a current; with a jump it would stay.

    The ratio differs from 1/2 by less than the step over the ramp, 5 ms / 100 ms, times a factor of order 1.
    """
    changes, records = [], []
    for rate in (200.0, 400.0):
        records.append(dynsim.simulate(dynsim.load_scenario("hand_over", overrides={"record.rate_hz": rate})))
        late = records[-1].time >= 0.5  # at the start the currents grow from zero
        changes.append(np.abs(np.diff(records[-1]["current"][late], axis=0)).max())
    assert changes[1] / changes[0] == pytest.approx(0.5, abs=0.1)
    record = records[0]
    force = record["contact_normal_force"]
    before, after = (record.time > 0.5) & (record.time < 1.75), record.time > 2.25
    assert force[before, 0].min() > 2.0
    assert not force[before, 1].any()
    assert not force[after, 0].any()
    # Between the knots of the waypoints the references leave the floor by 0.01 mm, against which the joints are stiff.
    assert force[after, 1] == pytest.approx(1.5, rel=0.05)
    assert record["contact_gap"][-1, 0] > 0.05


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("hand_over", {"integrator.method": "time_stepping"}),
        ("hand_over", {"integrator.method": "radau5", "controller.sample_time_s": 0.0002}),
        ("elbow_comparison", {"controller.brace": {"elbow_4": {"during_s": [[0, 0.4]]}, "elbow_7": 8.0}}),
        ("mobile_elbow_comparison", {"controller.brace": {"elbow_4": {"during_s": [[0, 0.4]]}, "elbow_7": 8.0}}),
    ],
)
def test_braces_with_times_run_in_pieces_and_from_snapshots(name, overrides):
    """Plans are part of the references: pieces and a restored state give the run of `simulate`, bit for bit."""
    variant = None if name == "hand_over" else "two_elbows"
    case = dynsim.load_scenario(name, variant, {"duration_s": 1.0, **overrides})
    whole = dynsim.simulate(case)
    assert not any("sampled loop" in warning for warning in whole.summary["warnings"])
    simulation = dynsim.Simulation(case)
    simulation.advance(0.37)
    state = simulation.snapshot()
    simulation.advance(0.9)
    simulation.restore(state)
    simulation.advance(1.0)
    assert np.array_equal(simulation.record()["q"], whole["q"])
    assert np.array_equal(simulation.record()["current"], whole["current"])


def test_check_does_not_place_braces_that_press_later():
    """The second elbow starts 0.15 m above the floor on purpose; without its times it should be placed there."""
    start = check(dynsim.load_scenario("hand_over"))
    assert start.aloft == ""
    assert start.gaps["elbow_2"] == pytest.approx(0.15, abs=1e-5)
    assert "elbow_2" in check(dynsim.load_scenario("hand_over", overrides={"controller.brace": None})).aloft


def test_references_may_leave_a_surface_outside_the_times_of_a_brace():
    """Elbow 1 rises after 2.25 s, which is an error if it still has to press."""
    for during, time in ((None, "t = 4.000"), ([[0, 3]], "t = 2.980")):
        with raises(DynsimError, "controller.brace", "elbow_1", "during_s", time):
            dynsim.simulate(dynsim.load_scenario("hand_over", overrides={"controller.brace.elbow_1.during_s": during}))
