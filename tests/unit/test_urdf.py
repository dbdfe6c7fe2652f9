"""Reading and writing of URDF: agreement with Pinocchio, round trip, locked joints, errors that name bad files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.messages import raises, warns

from dynsim.compile.model import Model
from dynsim.errors import ModelError
from dynsim.model.description import Inertia, Link, Robot
from dynsim.model.joints.ball import ball, floating
from dynsim.model.joints.planar import planar, rolling
from dynsim.model.urdf.reader import read_urdf
from dynsim.model.urdf.writer import write_urdf

ARM = Path(__file__).parents[2] / "scenarios" / "robots" / "six_axis_arm.urdf"
# A text round trip through roll, pitch, yaw costs a few roundings per joint; quantities here are of order 1 to 100.
ROUNDING = 1e-12


def rotation(rng: np.random.Generator) -> np.ndarray:
    """A random rotation; now and then one with pitch = ±90°, where roll and yaw are not unique."""
    if rng.random() < 0.3:
        half_turns = rng.integers(0, 4, 3)
        R = np.eye(3)
        for axis, k in enumerate(half_turns):
            c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][k]
            turn = np.roll(np.roll(np.array([[1, 0, 0], [0, c, -s], [0, s, c]], float), axis, 0), axis, 1)
            R = R @ turn
        return R
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Q * np.linalg.det(Q)


def random_robot(seed: int, n: int) -> Robot:
    """A tree with random joints, placements and inertia tensors of clouds of point masses."""
    rng = np.random.default_rng(seed)
    links = []
    for i in range(n):
        cloud, masses = rng.normal(size=(5, 3)) * 0.2, rng.uniform(0.1, 1.0, 5)
        com = masses @ cloud / masses.sum()
        arms = cloud - com
        tensor = np.einsum("k,kij->ij", masses, [np.eye(3) * (r @ r) - np.outer(r, r) for r in arms])
        axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
        kind = "prismatic" if rng.random() < 0.3 else "revolute"
        limited = rng.random() < 0.5
        links.append(
            Link(
                name=f"body_{i}",
                joint=f"joint_{n - i}",  # the order of names is not the order of links
                parent=None if i == 0 else f"body_{rng.integers(max(0, i - 3), i)}",
                kind=kind,
                axis=axis / np.linalg.norm(axis),
                inertia=Inertia(float(masses.sum()), com, tensor),
                R_PJ=rotation(rng),
                p_PJ=rng.normal(size=3) * 0.3,
                damping=float(rng.integers(0, 2) * rng.uniform()),
                lower=-1.5 if limited else -np.inf,
                upper=2.5 if limited else np.inf,
                velocity_limit=3.5 if rng.random() < 0.5 else np.inf,
                effort_limit=40.0 if rng.random() < 0.5 else np.inf,
            )
        )
    return Robot("random tree", tuple(links), (), (f"body_{rng.integers(n)}", rng.normal(size=3)))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 12))
def test_round_trip_keeps_the_dynamics(seed: int, n: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    robot = random_robot(seed, n)
    path = tmp_path_factory.mktemp("urdf") / "robot.urdf"
    path.write_text(write_urdf(robot))
    again = read_urdf(path)
    assert again.name == robot.name
    for link, copy in zip(robot.links, again.links, strict=True):
        for name in (
            "name", "joint", "parent", "kind", "damping", "lower", "upper", "velocity_limit", "effort_limit",
        ):  # fmt: skip
            assert getattr(copy, name) == getattr(link, name)
    assert again.hand[0] == robot.hand[0]

    rng = np.random.default_rng(seed)
    before, after = Model(robot), Model(again)
    q, v = rng.uniform(-2, 2, n), rng.uniform(-2, 2, n)
    M, h = before.mass_matrix(q), before.bias_forces(q, v)
    np.testing.assert_allclose(after.mass_matrix(q), M, rtol=0, atol=ROUNDING * max(1.0, abs(M).max()))
    np.testing.assert_allclose(after.bias_forces(q, v), h, rtol=0, atol=ROUNDING * max(1.0, abs(h).max()))
    for body, point in ((robot.links[-1].name, [0.1, 0.2, 0.3]), robot.hand):
        point_again = again.hand[1] if body == robot.hand[0] and point is robot.hand[1] else point
        np.testing.assert_allclose(
            after.point_position(body, point_again, q),
            before.point_position(body, point, q),
            rtol=0,
            atol=ROUNDING * 10,
        )


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 12))
def test_locked_joints_are_pinocchios_reduced_model(
    seed: int, n: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    robot, rng = random_robot(seed, n), np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("urdf") / "robot.urdf"
    path.write_text(write_urdf(robot))
    names = rng.permutation(robot.joint_names)[: rng.integers(1, n)]
    lock = {str(name): float(rng.uniform(-1.4, 2.4)) for name in names}
    ours, free = Model.from_urdf(path, lock), pinocchio.buildModelFromUrdf(str(path))

    def at(model: pinocchio.Model, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Pinocchio's configuration (two numbers for an endless joint) and velocity for values by joint."""
        v = np.zeros(model.nv)
        for name, value in values.items():
            v[model.joints[model.getJointId(name)].idx_v] = value
        return pinocchio.integrate(model, pinocchio.neutral(model), v), v

    theirs = pinocchio.buildReducedModel(free, [free.getJointId(name) for name in lock], at(free, lock)[0])
    assert set(ours.joint_names) == set(theirs.names) - {"universe"}
    order = [theirs.joints[theirs.getJointId(name)].idx_v for name in ours.joint_names]
    q, v, a = rng.uniform(-2, 2, (3, ours.n))
    (q_, _), (_, v_), (_, a_) = (at(theirs, dict(zip(ours.joint_names, x, strict=True))) for x in (q, v, a))
    tau = pinocchio.rnea(theirs, theirs.createData(), q_, v_, a_)[order]
    torques = ours.inverse_dynamics(q, v, a)
    np.testing.assert_allclose(torques, tau, rtol=0, atol=ROUNDING * max(1.0, abs(tau).max()))
    # The links of locked joints are frames of what carries them, at the same place as in the free arm.
    free_q = [lock.get(name, dict(zip(ours.joint_names, q, strict=True)).get(name, 0.0)) for name in robot.joint_names]
    for link in robot.links:
        if next((f.body for f in ours.robot.frames if f.name == link.name), link.name) is not None:
            expected = Model(robot).point_position(link.name, [0.1, 0.2, 0.3], free_q)
            position = ours.point_position(link.name, [0.1, 0.2, 0.3], q)
            np.testing.assert_allclose(position, expected, rtol=0, atol=ROUNDING * 10)


def moving(name: str, parent: str | None = None, **options: object) -> Link:
    """A body of 1 kg whose joint is turned and displaced; its kind is that of the rows it is made of."""
    R = rotation(np.random.default_rng(len(name)))
    inertia = Inertia(1.0, np.array([0.1, 0.2, 0.3]), np.diag([0.2, 0.3, 0.4]))
    axis = np.array([0.6, 0.0, 0.8])
    return Link(name, f"{name}_joint", parent, "revolute", axis, inertia, R, np.array([0.3, 0.2, 0.1]), **options)  # type: ignore[arg-type]


def test_floating_and_planar_joints_are_written_whole(tmp_path: Path) -> None:
    """Also in the middle of a tree; what is read has the same rows, names, axes and dynamics."""
    links = (*floating(moving("root")), moving("arm", "root"), *planar(moving("table", "arm")), moving("pole", "table"))
    robot = Robot("free", (*links, *floating(moving("cup", "pole"))), (), ("cup", np.array([0.1, 0.0, 0.2])))
    text = write_urdf(robot)
    assert text.count("<joint") - text.count('type="fixed"') == 5
    assert [text.count(f'type="{kind}"') for kind in ("floating", "planar")] == [2, 1]
    (tmp_path / "free.urdf").write_text(text)
    again = read_urdf(tmp_path / "free.urdf")
    for link, copy in zip(robot.links, again.links, strict=True):
        for name in ("name", "joint", "parent", "kind", "joint_of_rows"):
            assert getattr(copy, name) == getattr(link, name)
        np.testing.assert_allclose(copy.axis, link.axis, rtol=0, atol=1e-15)
    rng = np.random.default_rng(1)
    before, after = Model(robot), Model(again)
    q, v = rng.uniform(-2, 2, before.nq), rng.uniform(-2, 2, before.n)
    bias = before.bias_forces(q, v)
    np.testing.assert_allclose(after.bias_forces(q, v), bias, rtol=0, atol=ROUNDING * abs(bias).max())


@pytest.mark.parametrize(
    ("links", "names"),
    [
        (ball(moving("root")), ("root_joint", "ball_x, ball_y, ball_z")),
        (rolling(moving("root")), ("root_joint", "roll, turn")),
        (planar(moving("root", damping=0.1)), ("root_joint", "planar")),
        ((dataclasses.replace(moving("root"), kind="screw"),), ("root_joint", "screw")),
    ],
)
def test_joints_that_urdf_does_not_have_are_refused(links: tuple[Link, ...], names: tuple[str, ...]) -> None:
    with raises(ModelError, *names):
        write_urdf(Robot("free", links, (), ("root", np.zeros(3))))


def test_a_free_root_is_merged_carries_frames_and_cannot_be_locked(tmp_path: Path) -> None:
    path = tmp_path / "free.urdf"
    tool = f'<link name="tool">{INERTIAL}</link>'
    fixed = (
        '<joint name="flange" type="fixed"><origin xyz="0 0 1"/><parent link="tip"/><child link="tool"/></joint>'
        '<joint name="stand" type="fixed"><origin xyz="0 0 2"/><parent link="base"/><child link="post"/></joint>'
    )
    free = joint("floating").replace('link="base"', 'link="post"')
    path.write_text(f'<robot name="free">{BASE}<link name="post"/>{TIP}{tool}{fixed}{free}</robot>')
    model = Model.from_urdf(path)
    assert model.robot.position_names == tuple(f"hinge.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
    assert model.robot.links[-1].inertia.mass == 2.0
    np.testing.assert_allclose(model.point_position("tool", [0, 0, 0], model.robot.initial), [0, 0, 3])
    with raises(ModelError, "urdf:1", "hinge", "floating"):
        read_urdf(path, {"hinge": 0.0})


def test_writing_what_was_read_gives_the_same_text(tmp_path: Path) -> None:
    first = Model.from_urdf(ARM).to_urdf()
    (tmp_path / "copy.urdf").write_text(first)
    assert Model.from_urdf(tmp_path / "copy.urdf").to_urdf() == first


def test_shipped_arm_agrees_with_pinocchio() -> None:
    model, theirs = Model.from_urdf(ARM), pinocchio.buildModelFromUrdf(str(ARM))
    data = theirs.createData()
    assert model.joint_names == tuple(theirs.names)[1:]
    rng = np.random.default_rng(2)
    for _ in range(5):
        q, v, a = rng.uniform(-2, 2, (3, 6))
        M = np.triu(pinocchio.crba(theirs, data, q))
        np.testing.assert_allclose(np.triu(model.mass_matrix(q)), M, rtol=0, atol=ROUNDING * abs(M).max())
        tau = pinocchio.rnea(theirs, data, q, v, a)
        np.testing.assert_allclose(model.inverse_dynamics(q, v, a), tau, rtol=0, atol=ROUNDING * abs(tau).max())
        np.testing.assert_allclose(model.forward_dynamics(q, v, tau), a, rtol=0, atol=1e-10)
        pinocchio.framesForwardKinematics(theirs, data, q)
        tool = data.oMf[theirs.getFrameId("tool")].translation
        np.testing.assert_allclose(model.point_position(*model.robot.hand, q), tool, rtol=0, atol=ROUNDING)
    # 0.165 + 0.205 + 0.45 + 0.24 + 0.18 + 0.085 + 0.03 + 0.13 m straight up
    np.testing.assert_allclose(model.point_position(*model.robot.hand, np.zeros(6)), [0, 0, 1.485], atol=ROUNDING)


def test_shipped_arm_is_read_as_written() -> None:
    robot = read_urdf(ARM)
    assert robot.name == "six_axis_arm"
    assert robot.joint_names == (
        "base_yaw",
        "shoulder_pitch",
        "elbow_pitch",
        "forearm_roll",
        "wrist_pitch",
        "tool_roll",
    )
    assert robot.hand[0] == "flange"
    np.testing.assert_allclose(robot.hand[1], [0, 0, 0.16], atol=1e-15)
    # The gripper, fixed to the flange, is part of the last body: 0.35 kg + 0.9 kg.
    assert robot.links[-1].inertia.mass == pytest.approx(1.25)
    assert robot.links[1].damping == 12.0
    assert (robot.links[1].lower, robot.links[1].upper) == (-2.26893, 2.26893)
    assert (robot.links[0].effort_limit, robot.links[0].velocity_limit) == (220.0, 3.4907)
    assert robot.motors == ()


BASE = '<link name="base"/>'
INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
TIP = f'<link name="tip">{INERTIAL}</link>'


def joint(kind: str, inside: str = "", *, name: str = "hinge", child: str = "tip") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="base"/><child link="{child}"/>{inside}</joint>'


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (TIP + joint("floating", '<dynamics damping="1"/>'), ["hinge", "floating", "<dynamics>"]),
        (TIP + joint("planar", '<axis xyz="0 0 1"/><limit lower="0" upper="1"/>'), ["planar", "hinge", "<limit>"]),
        (TIP + joint("planar"), ["hinge", "planar", "<axis>"]),
        (TIP + joint("hyper"), ["hinge", "hyper", "continuous"]),
        (TIP + joint("continuous", '<mimic joint="other"/>'), ["hinge", "other"]),
        (TIP + joint("revolute"), ["hinge", "revolute", "<limit>"]),
        (TIP + joint("fixed"), []),
        (TIP + joint("continuous", '<axis xyz="0 0 a"/>'), ["hinge", "0 0 a"]),
        (TIP + joint("continuous", '<axis xyz="0 0 0"/>'), ["hinge", "axis"]),
        (TIP.replace('"1"', '"heavy"') + joint("continuous"), ["tip", "heavy"]),
        (TIP.replace('"1"', '"-1"') + joint("continuous"), ["tip", "-1", "kg"]),
        (TIP.replace('"0.1"', '"nan"') + joint("continuous"), ["tip", "nan"]),
        (TIP + joint("continuous", child="tup"), ["hinge", "tup"]),
        (TIP + '<link name="loose"/>' + joint("continuous"), ["'base', 'loose'"]),
        (TIP + joint("continuous") + joint("continuous", name="second"), ["second", "tip"]),
        (
            '<link name="a"/><link name="b"/>'
            '<joint name="there" type="fixed"><parent link="a"/><child link="b"/></joint>'
            '<joint name="back" type="continuous"><parent link="b"/><child link="a"/></joint>',
            ["there"],
        ),
        ("<link", ["XML"]),
    ],
)
def test_bad_files_name_file_and_joint(content: str, names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "bad.urdf"
    path.write_text(f'<robot name="bad">{BASE}{content}</robot>')
    with raises(ModelError, "bad.urdf", *names) as caught:
        read_urdf(path)
    message = str(caught.value)
    assert "\n" not in message


def test_other_files_are_refused(tmp_path: Path) -> None:
    with raises(ModelError, "missing.urdf"):
        read_urdf(tmp_path / "missing.urdf")
    with raises(ModelError, str(tmp_path)):
        read_urdf(tmp_path)
    (tmp_path / "empty.urdf").write_text("")
    with raises(ModelError, "empty.urdf"):
        read_urdf(tmp_path / "empty.urdf")
    (tmp_path / "scene.xml").write_text("<mujoco/>")
    with raises(ModelError, "scene.xml", "<mujoco>", "<robot>"):
        read_urdf(tmp_path / "scene.xml")


def test_friction_of_a_joint_is_dry_friction_and_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "rubbing.urdf"
    path.write_text(f'<robot name="r">{BASE}{TIP}{joint("continuous", """<dynamics friction="0.2"/>""")}</robot>')
    robot = read_urdf(path)
    assert (robot.links[0].friction, robot.links[0].damping) == (0.2, 0.0)
    path.write_text(write_urdf(robot))
    assert read_urdf(path).links[0].friction == 0.2


def test_frames_behind_fixed_joints_are_names_of_places() -> None:
    model = Model.from_urdf(ARM)
    q = np.random.default_rng(5).uniform(-2, 2, 6)
    x, y, z = point = [0.01, 0.02, 0.03]
    # gripper_mount is 0.03 m and tool_frame 0.13 m further along z of the flange, neither turned.
    for frame, height in (("gripper", 0.03), ("tool", 0.16)):
        there = [x, y, z + height]
        expected = model.point_position("flange", there, q)
        position, jacobian = model.point_position_and_jacobian(frame, point, q)
        np.testing.assert_allclose(position, expected, rtol=0, atol=1e-15)
        np.testing.assert_allclose(jacobian, model.point_jacobian("flange", there, q), rtol=0, atol=1e-15)
    with raises(ModelError, "base"):
        model.point_position("base", point, q)
    with raises(ModelError, "tol", "'tool'", "gripper, tool"):
        model.point_position("tol", point, q)


@pytest.mark.parametrize(
    ("lock", "names"),
    [
        ({"elbow": 0.0}, ("'elbow'", "'elbow_pitch'")),
        ({"tool_frame": 0.0}, ("six_axis_arm.urdf:228", "tool_frame")),
        ({"elbow_pitch": float("nan")}, ("elbow_pitch = nan",)),
    ],
)
def test_wrong_locks(lock: dict[str, float], names: tuple[str, ...]) -> None:
    with raises(ModelError, *names):
        read_urdf(ARM, lock)
    with raises(ModelError, "six_axis_arm.urdf"):
        read_urdf(ARM, dict.fromkeys(read_urdf(ARM).joint_names, 0.0))


def test_writing_keeps_the_hand_and_does_not_name_joints_twice(tmp_path: Path) -> None:
    """A controlled point of the scenario is not where the file had its hand; a moving joint has a frame's name."""
    path = tmp_path / "robot.urdf"
    frame = (
        '<link name="{0}"/><joint name="mount_{0}" type="fixed"><origin xyz="0 0 0.5" rpy="0 1 0"/><parent link="tip"/>'
    )
    frames = "".join(f'{frame.format(name)}<child link="{name}"/></joint>' for name in ("hand", "tool"))
    hinge = joint("continuous", name="tool_frame")
    path.write_text(f'<robot name="r">{BASE}{TIP}{hinge}{frames}</robot>')
    robot = read_urdf(path)
    path.write_text(write_urdf(robot))
    for before, after in zip(robot.frames, read_urdf(path).frames, strict=True):
        if before.name == "hand":
            np.testing.assert_allclose(after.R, before.R, rtol=0, atol=ROUNDING)
    robot = dataclasses.replace(robot, hand=("tip", np.array([0.1, 0.0, 0.2])))
    path.write_text(write_urdf(robot))
    again = read_urdf(path)
    assert (again.hand[0], again.hand[1].tolist()) == ("tip", [0.1, 0.0, 0.2])
    assert {frame.name: frame.p.tolist() for frame in again.frames} == {
        "base": [0, 0, 0], "tool": [0, 0, 0.5], "hand": [0.1, 0, 0.2]
    }  # fmt: skip


def test_locks_beyond_the_limits_are_said() -> None:
    with warns(UserWarning, "elbow_pitch", "3", "-2.61799", "2.61799"):
        read_urdf(ARM, {"elbow_pitch": 3.0})


def test_tolerance_of_moments_follows_the_size_of_the_body() -> None:
    """Moments that rounding has made negative are those of a point or a rod; such that matter are refused."""
    turn = rotation(np.random.default_rng(1))
    for mass, size in ((1e-6, 1e-4), (1.0, 0.1), (1e4, 10.0)):
        small, large = mass * 1e-12, mass * size**2
        for fine in (
            np.zeros((3, 3)),
            np.diag([-5e-20 * mass, 0.0, 1e-20 * mass]),
            turn @ np.diag([-0.9 * small, 0.0, 0.0]) @ turn.T,
            turn @ np.diag([0.0, large, large * (1 + 0.9e-9)]) @ turn.T,
        ):
            Inertia(mass, tensor=fine).check("body")
        for bad in (
            np.diag([-2 * small, 0.0, 0.0]),
            np.diag([0.0, 0.0, 2 * small]),
            np.diag([-1e-3, 1.0, 1.0]) * large,
            np.diag([1.0, 1.0, 2.01]) * large,
            np.array([[1.0, 1e-3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) * large,
        ):
            with pytest.raises(ModelError, match="body: "):
                Inertia(mass, tensor=bad).check("body")
    with pytest.raises(ModelError):
        Inertia(0.0, tensor=np.diag([-1e-20, 0.0, 0.0])).check("body")


def test_hand_is_the_tip_of_the_deepest_chain(tmp_path: Path) -> None:
    """A finger that moves beats a tool that does not; without a frame at the tip it is the body's own origin."""
    finger = f'<link name="finger">{INERTIAL}</link>' + (
        '<joint name="grip" type="continuous"><origin xyz="1 0 0"/><parent link="tip"/><child link="finger"/></joint>'
    )
    tool = '<link name="tool"/><joint name="t" type="fixed"><origin xyz="0 0 {}"/><parent link="{}"/>{}</joint>'
    path = tmp_path / "robot.urdf"

    def hand(content: str) -> tuple[str, list[float]]:
        path.write_text(f'<robot name="r">{BASE}{TIP}{joint("continuous")}{content}</robot>')
        body, point = read_urdf(path).hand
        return body, point.tolist()

    assert hand("") == ("tip", [0, 0, 0])
    # Of equals the first link of the file counts, whatever the order of its joints.
    twins = f'<link name="left">{INERTIAL}</link><link name="right">{INERTIAL}</link>' + "".join(
        joint("continuous", name=f"to_{side}", child=side).replace('"base"', '"tip"') for side in ("right", "left")
    )
    assert hand(twins) == ("left", [0, 0, 0])
    assert hand(tool.format(0.5, "tip", '<child link="tool"/>')) == ("tip", [0, 0, 0.5])
    assert hand(finger + tool.format(0.5, "tip", '<child link="tool"/>')) == ("finger", [0, 0, 0])
    assert hand(finger + tool.format(0.5, "tip", '<child link="hand"/>').replace("tool", "hand")) == (
        "tip",
        [0, 0, 0.5],
    )
