"""Inverse kinematics: position, orientation, braces, limits and hand paths, checked by forward kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from studies.planner_scenes import scene
from support.messages import raises
from support.turned_tool import TURNED

import dynsim
from dynsim.compile.hand_posture import hand_turn, hand_turns, turn_error
from dynsim.compile.references.inverse_kinematics import follow
from dynsim.errors import ModelError, UnreachableReference
from dynsim.model.base_pose import base_row
from dynsim.scenario import build
from dynsim.scenario.reading import scenario_from_resolved


@pytest.fixture(scope="module")
def arm() -> tuple[dynsim.Model, list]:  # type: ignore[type-arg]
    """A scene with a joint about a third axis, ten joints, stops at 120°; link 5 may lean on the floor."""
    data = scene(3)
    data["contacts"]["points"] = {"elbow": {"body": "link_5", "radius_m": 0.01}}
    scenario = scenario_from_resolved(data)
    return dynsim.build_model(scenario), build.contacts(scenario)


def test_hand_and_orientation_are_reached(arm) -> None:  # type: ignore[no-untyped-def]
    """Targets are the poses of random postures; the search starts near these."""
    model, _ = arm
    rng = np.random.default_rng(0)
    for _ in range(5):
        there = rng.uniform(-1.0, 1.0, model.n)
        target = model.point_position(*model.robot.hand, there)
        R, _ = model.body_pose(model.robot.hand[0], there)
        q = model.inverse_kinematics(target, there + rng.normal(0.0, 0.1, model.n), orientation=R)
        assert np.abs(model.point_position(*model.robot.hand, q) - target).max() < 1e-9
        assert np.abs(model.body_pose(model.robot.hand[0], q)[0] - R).max() < 1e-8


def test_braces_stay_on_their_surfaces_within_limits(arm) -> None:  # type: ignore[no-untyped-def]
    model, braces = arm
    start = np.array([0.0, 0.9, 0.5, 0.6, -0.3, -0.4, -0.3, 0.0, 0.5, 0.2])
    target = np.array([1.4, 0.1, 0.3])
    q = model.inverse_kinematics(target, start, braces=braces)
    position = model.point_position("link_5", [0.0, 0.0, 0.0], q)
    assert abs(position[2] - 0.01) < 1e-9
    assert np.abs(model.point_position(*model.robot.hand, q) - target).max() < 1e-9
    stops = np.array([(link.lower, link.upper) for link in model.robot.links])
    assert (q >= stops[:, 0]).all()
    assert (q <= stops[:, 1]).all()


def test_objects_do_not_change_hand_postures() -> None:
    """A free object has a joint with several coordinates, which does not belong to the chain of the hand."""
    data = scene(3)
    alone = dynsim.build_model(scenario_from_resolved(data))
    block = {"mass_kg": 1.0, "size_m": [0.1, 0.1, 0.1], "position_m": [3.0, 0.0, 1.0]}
    model = dynsim.build_model(scenario_from_resolved(data | {"objects": {"block": block}}))
    there = np.linspace(0.1, 0.5, alone.n)
    target, R = alone.point_position(*alone.robot.hand, there), alone.body_pose(alone.robot.hand[0], there)[0]
    start = model.robot.initial
    start[: alone.n] = there + 0.1
    q = model.inverse_kinematics(target, start, orientation=R)
    assert np.array_equal(q[alone.nq :], start[alone.nq :])
    expected = alone.inverse_kinematics(target, there + 0.1, orientation=R)
    np.testing.assert_allclose(q[: alone.nq], expected, rtol=0.0, atol=1e-12)


def test_orientation_is_kept_on_a_moving_base() -> None:
    """The arm compensates for the motion of the base, whose coordinates are wheels, x and y."""
    model = dynsim.build_model(dynsim.load_scenario("mobile_reach"))
    start = model.robot.initial
    target, turn = model.point_position(*model.robot.hand, start), hand_turn(model, start)
    first = base_row(model.robot)[0]
    base = start[first : first + 4] + np.array([[0.0, 0.0, 0.0, 0.0], [0.02, -0.02, -0.01, 0.0]])
    joints = [f"joint_{k}" for k in range(1, 11)]
    positions = follow(model, np.arange(2.0), np.array([target, target]), joints, start, 1e-8, None, base, (), turn)
    q = start.copy()
    q[first : first + 4] = base[1]
    q[[model.robot.position_index[model.joint_names.index(joint)] for joint in joints]] = positions[1]
    assert np.abs(q - start)[[first, first + 2]].min() > 1e-3
    np.testing.assert_allclose(model.point_position(*model.robot.hand, q), target, atol=1e-7)
    assert np.abs(hand_turn(model, q) - turn).max() < 1e-6


def test_what_is_out_of_reach_says_how_far(arm) -> None:  # type: ignore[no-untyped-def]
    model, _ = arm
    with raises(UnreachableReference, "6.67"):
        model.inverse_kinematics([9.0, 0.0, 0.0])
    with raises(ModelError, "orientation", "(3, 3)"):
        model.inverse_kinematics([1.0, 0.0, 0.3], orientation=np.ones((3, 3)))


def test_half_a_turn_has_an_axis() -> None:
    """The rotation vector of π about any axis, where the sine says nothing."""
    for axis in np.eye(3):
        R = 2.0 * np.outer(axis, axis) - np.eye(3)
        assert np.abs(np.abs(turn_error(np.eye(3), R)) - np.pi * axis).max() < 1e-7


def turned_arm(rpy_deg: list[float]) -> dynsim.Scenario:
    """The arm of the tests, whose hand goes along its path and keeps an orientation."""
    data = scene(7)
    data["controller"]["hand"]["orientation"] = {"rpy_deg": rpy_deg}
    posture = [0.1, -40.0, 60.0, 30.0, 20.0, 5.0, 10.0, 5.0, 20.0, 10.0]
    for link, angle in zip(data["plant"]["chain"], posture, strict=True):
        link["initial_deg"] = angle
    data |= {
        "surfaces": {},
        "contacts": {"law": "unilateral"},
        "loads": {},
        "duration_s": 2.0,
        "metrics": {"settle_s": 1.0},
    }
    data["controller"] |= {"k_p_V_per_rad": 2000.0, "k_d_V_s_per_rad": 60.0, "feed_forward": "dynamics"}
    start = dynsim.build_model(scenario_from_resolved(data)).point_position(
        "link_10", [0.0, 0.0, 0.2], np.deg2rad(posture)
    )
    path = data["controller"]["hand"]["path"]
    path["times_s"] = [0.0, 1.0, 2.0]
    path["points_m"] = [start.tolist(), (start + np.array([0.05, 0.02, -0.05])).tolist(), start.tolist()]
    return scenario_from_resolved(data)


def test_a_hand_path_keeps_the_orientation_that_it_asks_for() -> None:
    """References by inverse kinematics, and what the run and its summary say of the angle."""
    record = dynsim.simulate(turned_arm([0.0, 120.0, 10.0]))
    late = record.time > 1.0
    assert record["hand_turn_error"][late].max() < 5e-3
    assert record.summary["hand_turn_error_max_rad"] >= record.summary["hand_turn_error_rms_rad"]
    # By the poses of the bodies: R = Rz(10°) Ry(120°).
    y, z = np.deg2rad([120.0, 10.0])
    x_axis = np.array([np.cos(z) * np.cos(y), np.sin(z) * np.cos(y), -np.sin(y)])
    hand = record.labels["body_orientation"].index("link_10")
    w, i, j, k = record["body_orientation"][-1, hand]
    shown = np.array([1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + w * k), 2.0 * (i * k - w * j)])
    assert np.abs(shown - x_axis).max() < 1e-2


def test_an_orientation_out_of_reach_says_when() -> None:
    with raises(UnreachableReference, "controller.hand.orientation", "0.000 s"):
        dynsim.simulate(turned_arm([180.0, 0.0, 90.0]))


@pytest.mark.parametrize(("tool", "named"), [("flange", True), ("hand", False)])
def test_the_orientation_of_a_turned_frame_is_that_of_the_hand(tmp_path, tool, named) -> None:  # type: ignore[no-untyped-def]
    """A frame behind a turned fixed joint is the hand, by its name or by the key; dynsim used the frame of its body."""
    (tmp_path / "turned.urdf").write_text(TURNED.replace("TOOL", tool))
    plant = {"type": "urdf_arm", "file": str(tmp_path / "turned.urdf")} | ({"hand": {"body": tool}} if named else {})
    model = dynsim.build_model(scenario_from_resolved({"name": "turned", "duration_s": 1.0, "plant": plant}))
    there = np.array([0.4, 0.5, -0.3])
    turn = Rotation.from_euler("y", there.sum()) * Rotation.from_euler("xyz", [0.3, 0.6, -0.2])
    target = model.point_position(*model.robot.hand, there)
    q = model.inverse_kinematics(target, there + 0.1, orientation=turn.as_matrix())
    np.testing.assert_allclose(q, there, rtol=0.0, atol=1e-8)
    assert hand_turns(model, q[None], turn.as_matrix())[0] < 1e-7
