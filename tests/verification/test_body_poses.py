"""Poses of bodies from scene and joint positions, against the model and the snake's kinematics; their record size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.messages import raises
from support.random_robots import random_robot, random_rotation, random_unit

import dynsim.engine
from dynsim.compile.model import Model
from dynsim.compile.scene import robot_scene
from dynsim.dynamics.state import output_layout, state_layout
from dynsim.errors import ScenarioError
from dynsim.model.description import Inertia, Link, Robot
from dynsim.model.joints import ANGLE, Row, rows
from dynsim.model.joints.ball import ball, floating
from dynsim.model.joints.planar import planar, rolling
from dynsim.record import Record
from dynsim.record.poses import add_body_poses, point_positions, pose_columns
from dynsim.record.quaternion import rotated
from dynsim.record.scene import Body, Joint, Point, Scene, Shape
from dynsim.scenario import load_scenario

SINGLE = 3e-7
"""Tolerance of poses kept in single precision: rounding of numbers of about 1 [m; rotation matrices 1]."""


def posed(robot: Robot, q: np.ndarray) -> Record:
    record = Record(np.arange(len(q)) * 0.01)
    record.add("q", q, "rad or m", labels=robot.position_names)
    record.scene = robot_scene(robot, [], {})
    assert add_body_poses(record)
    return record


def matrix(quaternion: np.ndarray) -> np.ndarray:
    return np.stack([rotated(quaternion.astype(np.float64), axis) for axis in np.eye(3)], axis=1)


@pytest.mark.parametrize("seed", range(8))
def test_poses_are_those_of_the_model(seed: int):
    """Trees with revolute and prismatic joints, axes and placements at random."""
    robot = random_robot(np.random.default_rng(seed), 9)
    model = Model(robot)
    q = np.cumsum(np.random.default_rng(seed + 100).uniform(-0.4, 0.4, (40, model.n)), axis=0)
    record = posed(robot, q)
    assert record["body_position"].shape == (40, model.n, 3)
    size = 1.0 + np.abs(record["body_position"]).max()
    for t in (0, 17, 39):
        for k, link in enumerate(robot.links):
            R, p = model.body_pose(link.name, q[t])
            np.testing.assert_allclose(record["body_position"][t, k], p, atol=SINGLE * size)
            np.testing.assert_allclose(matrix(record["body_orientation"][t, k]), R, atol=3.0 * SINGLE)
        hand = point_positions(record, record.scene.hand, t)
        np.testing.assert_allclose(hand, model.point_position(*robot.hand, q[t]), atol=5.0 * SINGLE * size)


@pytest.mark.parametrize("mounted", [False, True], ids=["on the world", "on a body"])
@pytest.mark.parametrize("joint", [ball, floating, planar, rolling])
def test_poses_of_joints_with_several_rows_are_those_of_the_model(joint, mounted: bool):
    """Between two hinges, or the first hinge left out; quaternions of any length and sign."""
    rng = np.random.default_rng(5)

    def link(name: str, parent: str | None) -> Link:
        rotation, axis = random_rotation(rng), random_unit(rng)
        return Link(name, f"to {name}", parent, "revolute", axis, Inertia(1.0), R_PJ=rotation, p_PJ=rng.normal(size=3))

    first = (link("carrier", None),) if mounted else ()
    moving = joint(link("base", "carrier" if mounted else None))
    robot = Robot("r", (*first, *moving, link("arm", "base")), (), ("arm", rng.normal(size=3)))
    model = Model(robot)
    q = rng.normal(size=(30, model.nq))
    record = posed(robot, q)
    assert record.labels["body_position"] == tuple(body.name for body in robot.links)
    size = 1.0 + np.abs(record["body_position"]).max()
    for t in (0, 11, 29):
        for k, body in enumerate(robot.links):
            R, p = model.body_pose(body.name, q[t])
            np.testing.assert_allclose(record["body_position"][t, k], p, atol=SINGLE * size)
            np.testing.assert_allclose(matrix(record["body_orientation"][t, k]), R, atol=3.0 * SINGLE)
        hand = point_positions(record, record.scene.hand, t)
        np.testing.assert_allclose(hand, model.point_position(*robot.hand, q[t]), atol=5.0 * SINGLE * size)
    assert Scene.from_json(record.scene.to_json()) == record.scene


def test_only_the_body_of_a_joint_with_several_rows_has_its_shapes():
    seen = Link("base", "j", None, "revolute", np.eye(3)[2], Inertia(1.0), shapes=(Shape("sphere", (0.1,)),))
    for joint in (ball, floating, planar, rolling):
        links = joint(seen)
        assert [link.name for link in links if link.shapes] == ["base"]


def test_a_joint_that_scenes_have_no_kind_for_leaves_the_record_without_a_scene(monkeypatch: pytest.MonkeyPatch):
    """Rather than a pose by another motion."""
    monkeypatch.setitem(rows(), "screw", Row(10, ANGLE))
    nut = Link("nut", "screw", None, "screw", np.eye(3)[2], Inertia(1.0))
    robot = Robot("r", (nut,), (), ("nut", np.zeros(3)))
    assert robot_scene(robot, [], {}) is None
    assert robot_scene(replace(robot, links=(replace(nut, kind="revolute"),)), [], {}) is not None


def test_signs_of_quaternions_do_not_jump():
    """A joint that turns three times, and the same joint as a servo would report it, within one turn."""
    joint = Joint("j", "revolute", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "q", ("j",))
    angle = np.linspace(2.0, 2.0 + 6.0 * np.pi, 300)
    quaternions = []
    for q in (angle, (angle + np.pi) % (2.0 * np.pi) - np.pi):
        record = Record(np.arange(300.0))
        record.add("q", q[:, None], "rad", labels=("j",))
        record.scene = Scene((Body("b", -1, joint),))
        assert add_body_poses(record)
        quaternions.append(record["body_orientation"][:, 0])
        assert np.abs(np.diff(quaternions[-1], axis=0)).max() < 0.05
    np.testing.assert_allclose(quaternions[0], quaternions[1], atol=SINGLE)
    assert quaternions[0][0, 0] > 0.0


def test_a_joint_that_was_not_recorded_leaves_no_poses():
    joint = Joint("j", "revolute", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "q", ("j",))
    record = Record([0.0, 1.0])
    record.scene = Scene((Body("b", -1, joint),))
    assert not add_body_poses(record)
    record.add("q", np.zeros((2, 1)), "rad", labels=("other",))
    assert not add_body_poses(record)
    # Nor does one with instants of its own.
    record.add_axis("servo", [0.0, 0.1])
    record.add("q", np.zeros((2, 1)), "rad", labels=("j",), axis="servo")
    assert not add_body_poses(record)
    assert set(record) == {"q"}
    record.scene = None
    assert not add_body_poses(record)


def test_a_missed_sample_has_no_pose_and_the_next_has_one():
    joint = Joint("j", "revolute", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), "q", ("j",))
    record = Record([0.0, 1.0, 2.0])
    record.add("q", [[0.3], [np.nan], [0.5]], "rad", labels=("j",))
    record.scene = Scene((Body("b", -1, joint),), points=(Point("hand", "hand", 0, (0.0, 0.0, 2.0)),))
    assert add_body_poses(record)
    hand = point_positions(record, record.scene.hand)
    assert np.isnan(hand[1]).all()
    np.testing.assert_allclose(hand[2], [2.0 * np.sin(0.5), 0.0, 1.0 + 2.0 * np.cos(0.5)], atol=1e-6)
    np.testing.assert_allclose(record["body_orientation"][2, 0], [np.cos(0.25), 0.0, np.sin(0.25), 0.0], atol=1e-7)


def test_record_of_a_braced_arm_places_hand_and_contacts():
    record = dynsim.simulate(load_scenario("elbow_comparison", "two_elbows", {"duration_s": 0.2}))
    scene = record.scene
    np.testing.assert_allclose(point_positions(record, scene.hand), record["hand_position"], atol=3e-6)
    assert [point.name for point in scene.contacts] == list(record.labels["contact_gap"])
    for point in scene.contacts:
        surface = scene.surface(point.surface)
        assert max(abs(surface.gap(position)) for position in point_positions(record, point)) < 1e-6
    rod = scene.bodies[3].shapes[0]
    assert (rod.kind, rod.size, rod.position) == ("cylinder", (0.01, 0.3), (0.0, 0.0, 0.15))


def test_scene_of_the_snake_is_its_own_chain():
    record = dynsim.simulate(load_scenario("snake_circle", None, {"duration_s": 2.0, "record.rate_hz": 50}))
    names, posture = record.labels["body_position"], record["posture"]
    position = dict(zip(names, np.moveaxis(record["body_position"], 1, 0), strict=True))
    hand = point_positions(record, record.scene.hand)
    np.testing.assert_allclose(hand, posture[:, 0], atol=SINGLE)
    np.testing.assert_allclose(hand, record["w"][:, :3], atol=SINGLE)
    head, pairs = 6, record["grounded"].shape[1]
    for j, name in enumerate(record.labels["phi"][:head]):
        np.testing.assert_allclose(position[f"head_{name}"], posture[:, 1 + j], atol=SINGLE)
    for pair in range(1, pairs):
        np.testing.assert_allclose(position[f"pair{pair + 1}"], posture[:, head + 2 * pair - 1], atol=SINGLE)
    # The active wheel that turned most stands beside its axle, and has rolled as far as it turned.
    turned = record["rho"][-1] - record["rho"][0]
    most = int(np.abs(turned).argmax())
    wheel = position[f"wheel_rho{most + 1}"]
    track = 0.5 * (0.15 if most in (0, 2, 4) else 0.12)
    np.testing.assert_allclose(np.linalg.norm(wheel - posture[:, head + 2 * most], axis=1), track, atol=SINGLE)
    forward = matrix(record["body_orientation"][-1, names.index(f"pair{most + 1}")])[:, 0]
    travelled = (wheel[-1] - wheel[0]) @ forward
    assert abs(turned[most]) > 0.1
    assert 0.05 * turned[most] == pytest.approx(travelled, rel=0.1)


def test_size_of_a_record_counts_its_poses():
    assert [pose_columns(n) for n in (0, 1, 2, 3)] == [0, 4, 7, 11]
    tiny = load_scenario("elbow_comparison", "no_elbow", {"record.size_limit_GB": 1e-6})
    columns = state_layout(10, 10, 10, 0, 0).size + output_layout(10, 10, 0).size + 35
    with raises(ScenarioError, "record.rate_hz", "10 s", str(columns), "record.size_limit_GB"):
        dynsim.engine.check(tiny)
