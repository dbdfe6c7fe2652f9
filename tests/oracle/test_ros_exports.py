"""Exports for ROS 2: trajectories against the checks of ros2_controllers, bags and robot descriptions."""

from __future__ import annotations

import itertools
import struct
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.messages import raises
from typer.testing import CliRunner

import dynsim
from dynsim.cli.commands import app
from dynsim.errors import RecordError
from dynsim.record import Record
from dynsim.record.joint_motion import RUN_UP, export_record
from dynsim.record.poses import poses_at
from dynsim.record.scene import HERE, WORLD, Body, Joint, Scene
from dynsim.scenario import load_scenario

rosbags = pytest.importorskip("rosbags")
pytest.importorskip("mcap")
FLOAT_EPSILON = float(np.finfo(np.float32).eps)


def controller_problems(trajectory: dict[str, object], joints: list[str]) -> list[str]:
    """Reasons for which joint_trajectory_controller rejects a trajectory with its default parameters.

    Its documentation: no partial joints goal, known names, points, strictly increasing times, one position and
    velocity per joint, and zero velocities at the end (``allow_nonzero_velocity_at_trajectory_end: false``).
    """
    names, points = trajectory["joint_names"], trajectory["points"]
    problems = [] if sorted(names) == sorted(joints) else ["joints do not match the controller"]
    if not points:
        return [*problems, "empty trajectory"]
    stamps = [1_000_000_000 * p["time_from_start"]["sec"] + p["time_from_start"]["nanosec"] for p in points]
    if any(later <= earlier for earlier, later in itertools.pairwise(stamps)):
        problems.append("times are not strictly increasing")
    if any(len(p[field]) != len(names) for p in points for field in ("positions", "velocities")):
        problems.append("wrong number of values")
    if any(abs(rate) > FLOAT_EPSILON for rate in points[-1]["velocities"]):
        problems.append("the last velocity is not zero")
    return problems


def followed(trajectory: dict[str, object], times: np.ndarray) -> np.ndarray:
    """Positions that the controller commands: cubic polynomials through positions and velocities of the points."""
    t = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in trajectory["points"]])
    q, v = (np.array([p[field] for p in trajectory["points"]]) for field in ("positions", "velocities"))
    k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    h = (t[k + 1] - t[k])[:, None]
    x = (times - t[k])[:, None] / h
    return (
        (1 + 2 * x) * (1 - x) ** 2 * q[k]
        + x * (1 - x) ** 2 * h * v[k]
        + x**2 * (3 - 2 * x) * q[k + 1]
        + x**2 * (x - 1) * h * v[k + 1]
    )


def moving(limit: float | None = None) -> Record:
    """Record that begins and ends in motion: one driven joint (up to 1 rad/s), one passive joint."""
    time = np.linspace(0.0, 1.0, 101)
    record = Record(time)
    q, v = np.stack([np.sin(time), 3.0 * time], axis=1), np.stack([np.cos(time), np.full(101, 3.0)], axis=1)
    record.add("q", q, "rad", labels=("driven", "passive"))
    record.add("v", v, "rad/s", labels=("driven", "passive"))
    record.add("torque", np.zeros((101, 1)), "N m", labels=("driven",))
    hinge = Joint("driven", "revolute", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), HERE, "q", ("driven",), -1.0, limit)
    record.scene = Scene((Body("link", WORLD, hinge),)) if limit else None
    return record


def exported(record: Record, folder: Path, **options: object) -> dict[str, object]:
    return YAML(typ="safe").load(export_record(record, folder / "t.yaml", "joint-trajectory", **options))


@pytest.mark.parametrize("rate", [None, 30.0, 1000.0])
def test_controller_accepts_a_trajectory_that_begins_and_ends_in_motion(tmp_path: Path, rate: float | None) -> None:
    trajectory = exported(moving(), tmp_path, rate=rate)
    assert controller_problems(trajectory, ["driven"]) == []
    # The ramps have constant acceleration; between them the controller follows the record.
    run_up, run_out = 1.0 / RUN_UP, np.cos(1.0) / RUN_UP
    x = np.linspace(0.0, run_up, 11)
    start = -0.5 * run_up
    np.testing.assert_allclose(followed(trajectory, x)[:, 0], start + 0.5 * RUN_UP * x**2, atol=1e-8)
    x = np.linspace(0.0, 1.0, 57)
    np.testing.assert_allclose(followed(trajectory, run_up + x)[:, 0], np.sin(x), atol=1e-7)
    x = np.linspace(0.0, run_out, 11)
    end = np.sin(1.0) + np.cos(1.0) * x - 0.5 * RUN_UP * x**2
    np.testing.assert_allclose(followed(trajectory, run_up + 1.0 + x)[:, 0], end, atol=1e-7)


def test_checks_of_the_controller_find_faults(tmp_path: Path) -> None:
    """The record without ramps is rejected for its last velocity; doubled points for their times."""
    good = exported(moving(), tmp_path)
    assert controller_problems({**good, "points": good["points"][:-1]}, ["driven"]) == ["the last velocity is not zero"]
    twice = {**good, "points": [p for p in good["points"] for _ in (0, 1)]}
    assert controller_problems(twice, ["driven"]) == ["times are not strictly increasing"]
    assert controller_problems(good, ["driven", "passive"]) == ["joints do not match the controller"]


def test_residual_velocity_below_the_threshold_of_rest_becomes_zero(tmp_path: Path) -> None:
    record = moving()
    record["v"][-1] = record["v"][0] = 9e-7
    trajectory = exported(record, tmp_path)
    assert len(trajectory["points"]) == len(record)
    assert controller_problems(trajectory, ["driven"]) == []


def test_trajectory_contains_selected_joints(tmp_path: Path) -> None:
    both = exported(moving(), tmp_path, joints=["passive", "driven"])
    assert controller_problems(both, ["passive", "driven"]) == []
    assert both["points"][-1]["positions"] == pytest.approx([3.0 + 2.25, np.sin(1.0) + 0.75 * np.cos(1.0)], abs=1e-8)
    with raises(RecordError, "elbow", "driven"):
        exported(moving(), tmp_path, joints=["elbow"])
    with raises(RecordError, "driven"):
        exported(moving(), tmp_path, joints=["driven", "driven"])
    passive = moving()
    passive.signals.pop("torque")
    passive.add("torque", np.zeros((101, 0)), "N m", labels=())
    with raises(RecordError, "--joints"):
        exported(passive, tmp_path)


def test_run_out_beyond_a_joint_limit_is_an_error(tmp_path: Path) -> None:
    assert controller_problems(exported(moving(limit=1.0), tmp_path), ["driven"]) == []
    with raises(RecordError, "driven", "0.9"):
        exported(moving(limit=0.9), tmp_path)


def test_times_that_are_equal_in_nanoseconds_are_an_error(tmp_path: Path) -> None:
    record = moving()
    record.time[:] *= 1e-9
    with raises(RecordError, "--rate"):
        exported(record, tmp_path)


def test_trajectory_is_a_valid_message_of_ros(tmp_path: Path) -> None:
    from rosbags.typesys import Stores, get_typestore

    store, trajectory = get_typestore(Stores.ROS2_JAZZY), exported(moving(), tmp_path)
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Duration"]
    empty = np.zeros(0)
    points = [
        kinds["trajectory_msgs/msg/JointTrajectoryPoint"](
            np.array(p["positions"]), np.array(p["velocities"]), empty, empty, stamp(**p["time_from_start"])
        )
        for p in trajectory["points"]
    ]
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, 0), "")
    kind = "trajectory_msgs/msg/JointTrajectory"
    message = kinds[kind](header, trajectory["joint_names"], points)
    back = store.deserialize_cdr(store.serialize_cdr(message, kind), kind)
    assert back.joint_names == ["driven"]
    assert back.points[-1].velocities.tolist() == [0.0]


def bag_of(record: Record, folder: Path) -> dict[str, list[object]]:
    """Messages by topic, written by the command and read by rosbags."""
    from rosbags.highlevel import AnyReader

    record.save(folder / "record.h5")
    done = CliRunner().invoke(app, ["export", str(folder / "record.h5"), "--format", "mcap"])
    assert done.exit_code == 0, done.output
    messages: dict[str, list[object]] = {}
    with AnyReader([folder / "record.mcap"]) as reader:
        for item, _, raw in reader.messages():
            messages.setdefault(item.topic, []).append(reader.deserialize(raw, item.msgtype))
    return messages


def test_floating_base_is_a_transform_and_fixed_frames_are_static(tmp_path: Path) -> None:
    """The satellite: joint states of its joints only, its pose in /tf, frames of the URDF file in /tf_static."""
    record = dynsim.simulate(load_scenario("free_flyer", None, {"duration_s": 0.2}))
    messages = bag_of(record, tmp_path)
    assert messages["/joint_states"][-1].name == ["rail", "shoulder", "elbow"]
    assert np.isfinite(messages["/joint_states"][-1].effort).all()
    frames = {t.child_frame_id: t for t in messages["/tf"][-1].transforms}
    assert set(frames) == {"bus", "carriage", "upper_arm", "forearm"}
    pose = frames["bus"].transform
    last = dict(zip(record.labels["q"], record["q"][-1], strict=True))
    assert frames["bus"].header.frame_id == "world"
    assert [pose.translation.x, pose.translation.y, pose.translation.z] == [last[f"root.{c}"] for c in "xyz"]
    turn = np.array([pose.rotation.w, pose.rotation.x, pose.rotation.y, pose.rotation.z])
    np.testing.assert_allclose(turn, [last[f"root.q{c}"] for c in "wxyz"], atol=1e-9)
    (static,) = messages["/tf_static"]
    fixed = {t.child_frame_id: t.header.frame_id for t in static.transforms}
    assert fixed == {"space": "world", "hand": "forearm", "finger_left": "forearm", "finger_right": "forearm"}
    links = {link.get("name") for link in ElementTree.fromstring(messages["/robot_description"][0].data).iter("link")}
    assert links == {"world", *frames, *fixed}


def test_frames_of_a_wheeled_base_lead_to_its_bodies(tmp_path: Path) -> None:
    pinocchio = pytest.importorskip("pinocchio")
    record = dynsim.simulate(load_scenario("mobile_reach", None, {"duration_s": 0.2}))
    messages = bag_of(record, tmp_path)
    frames = {t.child_frame_id: t for t in messages["/tf"][-1].transforms}
    assert frames["base"].header.frame_id == "world"
    poses = poses_at(
        record.scene,
        {name: dict(zip(record.labels[name], record[name][-1], strict=True)) for name in ("q", "base_pose")},
    )
    for k in record.scene.rows:
        name, at, turn = record.scene.bodies[k].name, np.zeros(3), np.eye(3)
        while name != "world":
            t = frames[name].transform
            step = pinocchio.Quaternion(t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z).toRotationMatrix()
            at = step @ at + [t.translation.x, t.translation.y, t.translation.z]
            turn, name = step @ turn, frames[name].header.frame_id
        np.testing.assert_allclose(at, poses[k, :3], atol=1e-12)
    # Joint states have the names of the description, so that its wheels turn.
    robot = pinocchio.buildModelFromXML(messages["/robot_description"][0].data)
    assert set(messages["/joint_states"][0].name) <= set(robot.names)


def test_effort_is_empty_if_no_joint_has_a_motor(tmp_path: Path) -> None:
    record = dynsim.simulate(load_scenario("single_pendulum", None, {"duration_s": 0.1}))
    states = bag_of(record, tmp_path)["/joint_states"]
    assert all(len(state.effort) == 0 and len(state.position) == 1 for state in states)


URDF = """<robot name="arm"><link name="base"/><link name="rod">
<inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Package ``robot`` with a mesh and a URDF file for each kind of reference to it."""
    folder = tmp_path / "ros" / "robot"
    (folder / "meshes").mkdir(parents=True)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    faces = b"".join(
        struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0)
        for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
    )
    (folder / "meshes" / "rod.stl").write_bytes(bytes(80) + struct.pack("<I", 4) + faces)
    for name, mesh in (("package", "package://robot/meshes/rod.stl"), ("relative", "meshes/rod.stl")):
        (folder / f"{name}.urdf").write_text(URDF.format(mesh=mesh))
        (folder / f"{name}.yaml").write_text(f"duration_s: 0.1\nplant: {{type: urdf_arm, file: {name}.urdf}}\n")
    return folder


def meshes_of(text: str) -> list[str]:
    return [mesh.get("filename") for mesh in ElementTree.fromstring(text).iter("mesh")]


@pytest.mark.parametrize("name", ["package", "relative"])
def test_meshes_of_bags_and_moved_urdf_files_resolve(name: str, package: Path, tmp_path: Path) -> None:
    mesh = package / "meshes" / "rod.stl"
    scenario = package / f"{name}.yaml"
    elsewhere = tmp_path / "elsewhere" / "arm.urdf"
    for target in (elsewhere, package / "copy.urdf"):
        done = CliRunner().invoke(app, ["export", str(scenario), "--format", "urdf", "--out", str(target)])
        assert done.exit_code == 0, done.output
    assert meshes_of(elsewhere.read_text()) == [f"file://{mesh}"]
    # Next to the original file the name is the original one.
    assert meshes_of((package / "copy.urdf").read_text()) == meshes_of((package / f"{name}.urdf").read_text())
    record = dynsim.simulate(load_scenario(scenario))
    description = bag_of(record, tmp_path)["/robot_description"][0].data
    assert meshes_of(description) == [f"file://{mesh}"]


def test_missing_mesh_is_named_in_a_warning(package: Path, tmp_path: Path) -> None:
    (package / "meshes" / "rod.stl").unlink()
    out = str(tmp_path / "arm.urdf")
    done = CliRunner().invoke(app, ["export", str(package / "relative.yaml"), "--format", "urdf", "--out", out])
    assert done.exit_code == 0, done.output
    assert "meshes/rod.stl" in done.output
    assert meshes_of(Path(out).read_text()) == ["meshes/rod.stl"]
