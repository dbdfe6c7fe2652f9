"""Exported robots and records, read back by independent programs: MuJoCo, Pinocchio, MCAP."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, raises
from typer.testing import CliRunner

import dynsim
from dynsim import Model
from dynsim.cli.commands import app
from dynsim.model.description import WORLD as ROOT
from dynsim.model.description import Coupling, Inertia, Link, Robot, Tie
from dynsim.model.drives import Motor
from dynsim.model.joints.ball import ball, floating
from dynsim.model.joints.planar import planar
from dynsim.record.joint_motion import export_record
from dynsim.record.mcap_file import write_mcap
from dynsim.record.poses import poses_at
from dynsim.record.scene import Shape
from dynsim.record.urdf_text import scene_urdf
from dynsim.scenario import build, load_scenario

mujoco = pytest.importorskip("mujoco", minversion="4.0")
pinocchio = pytest.importorskip("pinocchio")

ARMS = ["elbow_comparison", "six_axis_arm", "thirty_links", "brace_on_cylinder", "wall_push", "block_on_slope"]
BOX = Inertia(1.2, np.array([0.02, -0.01, 0.1]), np.array([[0.03, 0.002, 0], [0.002, 0.04, -0.001], [0, -0.001, 0.02]]))


def in_mujoco(text: str) -> tuple[object, object]:
    model = mujoco.MjModel.from_xml_string(text)
    return model, mujoco.MjData(model)


def mass_matrix(model: object, data: object) -> np.ndarray:
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M


@pytest.mark.parametrize("name", ARMS)
def test_mujoco_has_the_mass_matrix_bias_and_accelerations_of_an_exported_arm(name: str) -> None:
    """M with rotors, h + g, and the accelerations of random torques with viscous losses: to 1e-9 of the largest."""
    scenario = load_scenario(name)
    model = dynsim.build_model(scenario)
    peer, data = in_mujoco(model.to_mjcf(build.contacts(scenario), build.surfaces(scenario)))
    order = [peer.joint(joint).dofadr[0] for joint in model.joint_names]
    assert peer.nv == model.n
    peer.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    rng = np.random.default_rng(1)
    inside = [
        (max(link.lower, -1.0), min(link.upper, 1.0)) if link.lower < link.upper else (0.0, 0.0)
        for link in model.robot.links
    ]
    for _ in range(5):
        q = np.array([rng.uniform(*limits) for limits in inside])
        v, tau = rng.uniform(-2.0, 2.0, (2, model.n))
        data.qpos[order], data.qvel[order], data.qfrc_applied[order] = q, v, tau
        mujoco.mj_forward(peer, data)
        M, h = model.mass_matrix(q) + np.diag(model.armature), model.bias_forces(q, v)
        assert_near(mass_matrix(peer, data)[np.ix_(order, order)], M)
        assert_near(data.qfrc_bias[order], h)
        assert_near(data.qacc[order], np.linalg.solve(M, tau - model.damping * v - h))
    hand = data.site("hand").xpos
    np.testing.assert_allclose(hand, model.joint_positions(q)[-1], atol=1e-12)
    for contact in build.contacts(scenario):
        body, point = model.robot.attach(contact.body, contact.point)
        np.testing.assert_allclose(
            data.site(f"contact_{contact.name}").xpos, model.point_position(body, point, q), atol=1e-12
        )


def assert_near(actual: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-9 * max(1.0, float(np.abs(expected).max())))


def test_the_initial_posture_motors_and_surfaces_are_those_of_the_scenario() -> None:
    scenario = load_scenario("brace_on_cylinder")
    model = dynsim.build_model(scenario)
    peer, data = in_mujoco(model.to_mjcf(build.contacts(scenario), build.surfaces(scenario)))
    mujoco.mj_resetDataKeyframe(peer, data, 0)
    order = [peer.joint(joint).qposadr[0] for joint in model.joint_names]
    np.testing.assert_array_equal(data.qpos[order], model.robot.initial)
    assert [peer.actuator(a).name for a in range(peer.nu)] == [motor.joint for motor in model.robot.motors]
    mujoco.mj_forward(peer, data)
    # Drawn, not touching: the brace starts on its cylinder.
    assert data.ncon == 0
    drawn = [peer.geom(g).name for g in range(peer.ngeom)]
    assert {f"surface_{name}" for name in build.surfaces(scenario)} <= set(drawn)


def tree() -> Robot:
    """A free body that carries a ball, a planar and a prismatic joint, all off their axes; two are coupled."""
    body = Link("torso", "free", None, "revolute", np.array([0.0, 0.0, 1.0]), BOX)
    arm = replace(body, name="arm", joint="shoulder", parent="torso", p_PJ=np.array([0.1, 0.2, 0.3]))
    plate = replace(arm, name="plate", joint="slab", axis=np.array([0.6, 0.0, 0.8]), p_PJ=np.array([-0.1, 0.0, 0.2]))
    rod = replace(plate, name="rod", joint="lift", parent="arm", kind="prismatic")
    tip = replace(rod, name="tip", joint="turn", parent="rod", kind="revolute", axis=np.array([0.0, 1.0, 0.0]))
    links = (*floating(body), *ball(arm), *planar(plate), rod, tip)
    return Robot("tree", links, (), ("tip", np.array([0.0, 0.0, 0.2])), couplings=(Coupling("turn", "lift", 2.0, 0.1),))


def test_compound_joints_move_in_mujoco_as_in_dynsim() -> None:
    """Free, ball and planar joints: coordinates and rates mean the same, poses, M and h agree."""
    robot = tree()
    model = Model(replace(robot, q0=robot.configuration({"lift": 0.2})))
    peer, data = in_mujoco(model.to_mjcf())
    assert (peer.nq, peer.nv, peer.neq) == (model.nq, model.n, 1)
    mujoco.mj_resetDataKeyframe(peer, data, 0)
    names = list(robot.position_names)
    rng = np.random.default_rng(2)
    q = rng.uniform(-1.0, 1.0, model.nq)
    for joint in ("free", "shoulder"):
        turn = [names.index(f"{joint}.q{c}") for c in "wxyz"]
        q[turn] /= np.linalg.norm(q[turn])
    v = rng.uniform(-1.0, 1.0, model.n)
    # Both count free, shoulder, lift, turn … depth first; dynsim in the order of its description.
    groups = {link.joint_of_rows or link.joint: [] for link in robot.links}
    for i, link in enumerate(robot.links):
        groups[link.joint_of_rows or link.joint].append(i)
    position, rate = {}, {}
    for name, rows in groups.items():
        position[name] = [k for k, label in enumerate(names) if label.split(".")[0] == name]
        rate[name] = rows
    at_q, at_v = np.zeros(model.nq, dtype=int), np.zeros(model.n, dtype=int)
    for name in groups:
        mine = name if name in ("free", "lift", "turn") else f"{name}.{'wx' if name == 'shoulder' else 'x'}"
        start = peer.joint(mine)
        at_q[position[name]] = start.qposadr[0] + np.arange(len(position[name]))
        at_v[rate[name]] = start.dofadr[0] + np.arange(len(rate[name]))
    data.qpos[at_q], data.qvel[at_v] = q, v
    mujoco.mj_forward(peer, data)
    for name in robot.bodies:
        R, p = model.body_pose(name, q)
        np.testing.assert_allclose(data.body(name).xpos, p, atol=1e-12)
        np.testing.assert_allclose(data.body(name).xmat.reshape(3, 3), R, atol=1e-12)
    assert_near(mass_matrix(peer, data)[np.ix_(at_v, at_v)], model.mass_matrix(q))
    assert_near(data.qfrc_bias[at_v], model.bias_forces(q, v))


def test_bodies_without_mass_or_with_a_point_mass_are_read() -> None:
    z = np.array([0.0, 0.0, 1.0])
    empty = Link("carrier", "a", None, "revolute", z, Inertia(0.0))
    point = Link("mass", "b", "carrier", "revolute", np.array([0.0, 1.0, 0.0]), Inertia(2.0, np.array([0.3, 0, 0])))
    model = Model(Robot("cross", (empty, point), (), ("mass", np.zeros(3))))
    peer, data = in_mujoco(model.to_mjcf())
    data.qpos[:] = q = np.array([0.3, 0.4])
    mujoco.mj_forward(peer, data)
    assert_near(mass_matrix(peer, data), model.mass_matrix(q))


def test_dry_friction_of_bearing_and_gear_is_that_of_the_joint_in_mujoco() -> None:
    motor = Motor("turn", 0.1, 1.0, 1e-3, 1e-5, 50.0, dry_friction=0.2)
    link = Link("rod", "turn", None, "revolute", np.array([0.0, 1.0, 0.0]), BOX, friction=0.3)
    peer, _ = in_mujoco(Model(Robot("one", (link,), (motor,), ("rod", np.zeros(3)))).to_mjcf())
    assert peer.dof_frictionloss[0] == pytest.approx(0.5)


def test_ties_are_refused_in_words() -> None:
    robot = tree()
    tie = Tie("rope", "tip", "plate", np.array([0.0, 0.0, 1.0]), 100.0)
    with raises(dynsim.DynsimError, "rope", "MJCF"):
        Model(replace(robot, q0=robot.configuration({}), ties=(tie,))).to_mjcf()


def test_wheels_that_roll_without_slip_are_refused_in_words() -> None:
    with raises(dynsim.DynsimError, "base", "left_wheel, right_wheel", "MJCF"):
        dynsim.build_model(load_scenario("mobile_reach")).to_mjcf()


@pytest.mark.parametrize("name", ["elbow_comparison", "six_axis_arm"])
def test_pinocchio_reads_an_exported_urdf_with_the_same_dynamics(name: str, tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    done = CliRunner().invoke(app, ["export", name, "--format", "urdf", "--out", str(file)])
    assert done.exit_code == 0, done.output
    model = dynsim.build_model(load_scenario(name))
    peer = pinocchio.buildModelFromUrdf(str(file))
    data = peer.createData()
    q, v = np.random.default_rng(3).uniform(-1.0, 1.0, (2, model.n))
    where = [peer.joints[peer.getJointId(joint)] for joint in model.joint_names]
    peer_q, peer_v = pinocchio.neutral(peer), np.zeros(peer.nv)
    for joint, angle, rate in zip(where, q, v, strict=True):
        peer_q[joint.idx_q : joint.idx_q + joint.nq] = [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        peer_v[joint.idx_v] = rate
    order = [joint.idx_v for joint in where]
    M = pinocchio.crba(peer, data, peer_q)
    M = np.triu(M) + np.triu(M, 1).T
    assert_near(M[np.ix_(order, order)], model.mass_matrix(q))
    assert_near(pinocchio.nonLinearEffects(peer, data, peer_q, peer_v)[order], model.bias_forces(q, v))


def test_looks_are_in_the_urdf_and_are_read_back() -> None:
    """Shapes come back where they were; a capsule, which URDF does not have, as a cylinder and two spheres."""
    turn = (0.8, 0.6, 0.0, 0.0)
    shapes = (
        Shape("box", (0.1, 0.2, 0.3), (0.01, 0.02, 0.03), turn, colour=(0.2, 0.4, 0.6, 1.0)),
        Shape("mesh", (1.0, 1.0, 1.0), file="package://arm/hand.stl"),
        Shape("capsule", (0.05, 0.4), (0.0, 0.1, 0.0), turn),
    )
    link = Link("rod", "turn", None, "revolute", np.array([0.0, 0.0, 1.0]), BOX, shapes=shapes)
    text = Model(Robot("one", (link,), (), ("rod", np.zeros(3)), fixed_shapes=(shapes[0],))).to_urdf()
    file = ElementTree.fromstring(text)
    assert [len(item.findall("visual")) for item in file.findall("link")] == [1, 5, 0]
    assert file.findall("link")[0].get("name") == ROOT


def test_the_shapes_of_an_arm_come_back_from_its_own_urdf(tmp_path: Path) -> None:
    model = dynsim.build_model(load_scenario("elbow_comparison"))
    file = tmp_path / "arm.urdf"
    file.write_text(model.to_urdf(), encoding="utf-8")
    back = Model.from_urdf(file).robot
    for link, own in zip(back.links, model.robot.links, strict=True):
        # The first link has no length.
        rods = [(own.radius, float(np.linalg.norm(own.tip)))] if own.tip.any() else []
        assert [(shape.kind, shape.size) for shape in link.shapes] == [("cylinder", rod) for rod in rods]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[dynsim.Record, Path]:
    """A record of the arm on a real floor, and its MCAP file by the command."""
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    folder = tmp_path_factory.mktemp("bag")
    record = dynsim.simulate(load_scenario("elbow_comparison_floor", "two_elbows", {"duration_s": 0.2}))
    record.save(folder / "record.h5")
    done = CliRunner().invoke(app, ["export", str(folder / "record.h5"), "--format", "mcap"])
    assert done.exit_code == 0, done.output
    return record, folder / "record.mcap"


def test_an_mcap_reader_with_its_own_decoder_has_the_numbers_of_the_record(bag: tuple[dynsim.Record, Path]) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    record, file = bag
    messages: dict[str, list[object]] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, message, content in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, content))
    states = [content for _, content in messages["/joint_states"]]
    assert tuple(states[0].name) == record.labels["q"]
    np.testing.assert_array_equal([s.position for s in states], record["q"])
    np.testing.assert_array_equal([s.velocity for s in states], record["v"])
    np.testing.assert_array_equal([s.effort for s in states], record["torque"])
    stamps = [s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in states]
    np.testing.assert_allclose(stamps, record.time, atol=1e-9)
    assert [time for time, _ in messages["/joint_states"]] == [round(1e9 * stamp) for stamp in stamps]
    forces = [[w.wrench.force.x, w.wrench.force.y, w.wrench.force.z] for _, w in messages["/contacts/elbow_4"]]
    np.testing.assert_array_equal(forces, record["contact_force"][:, record.labels["contact_force"].index("elbow_4")])
    # The tree of frames, followed by hand, leads to the bodies of the scene.
    poses = poses_at(record.scene, {"q": dict(zip(record.labels["q"], record["q"][-1], strict=True))})
    frames = {item.child_frame_id: item for item in messages["/tf"][-1][1].transforms}
    for body, pose in zip(record.scene.bodies, poses, strict=True):
        np.testing.assert_allclose(_position(frames, body.name), pose[:3], atol=1e-12)
    assert {"contact_elbow_4", "contact_elbow_7"} < set(frames)


def _position(frames: dict[str, object], name: str) -> np.ndarray:
    """World position of a frame's origin, by the chain of its parents."""
    point = np.zeros(3)
    while name != "world":
        t = frames[name].transform
        r = t.rotation
        point = pinocchio.Quaternion(r.w, r.x, r.y, r.z).toRotationMatrix() @ point
        point += [t.translation.x, t.translation.y, t.translation.z]
        name = frames[name].header.frame_id
    return point


SHAPES = """
duration_s: 0.5
plant:
  type: serial_arm
  base: {position_m: [0, 0, 5]}
  chain: [{axis: y, length_m: 0.6, radius_m: 0.03, mass_kg: 1.0, initial_deg: 60}]
objects: {ball: {mass_kg: 1, shape: sphere, radius_m: 0.2, position_m: [-0.0894427190999916, 0, 0.178885438199983]}}
surfaces:
  ramp: {type: plane, normal: [-0.5, 0, 1]}
  bar: {type: cylinder, point_m: [0.3, 0, 5.0], axis: [0, 1, 0], radius_m: 0.05}
contacts: {law: unilateral, friction: 0.8, candidates: links}
record: {rate_hz: 100}
"""


def test_wrenches_of_spheres_and_capsules_are_whole_in_their_frames(tmp_path: Path) -> None:
    """A ball rolls down a slope, a link falls onto a bar, which it touches between its ends.

    Of a ball the force has the moment r f = 2/7 m g r sin α about its centre; on a bar it acts on the bar's surface.
    """
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    scenario, file = tmp_path / "shapes.yaml", tmp_path / "shapes.mcap"
    scenario.write_text(SHAPES)
    record = dynsim.simulate(load_scenario(scenario))
    write_mcap(record, file)
    frames, wrenches = {}, {}
    with file.open("rb") as stream:
        for _, channel, _, content in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic == "/tf":
                frames |= {item.child_frame_id: item for item in content.transforms}
            elif channel.topic.startswith("/contacts/"):
                wrenches[content.header.frame_id] = content.wrench

    def of(vector: object) -> np.ndarray:
        return np.array([vector.x, vector.y, vector.z])

    name = "contact_ball.ramp"
    force, torque = of(wrenches[name].force), of(wrenches[name].torque)
    moment = np.cross(_position(frames, name) - record["q"][-1, 1:4], force) + torque
    np.testing.assert_allclose(moment, [0.0, -2.0 / 7.0 * 9.81 * 0.2 / np.sqrt(5.0), 0.0], atol=1e-5)
    assert of(wrenches["contact_link_1_bar"].force)[2] > 1.0
    x, _, z = _position(frames, "contact_link_1_bar") - [0.3, 0.0, 5.0]
    assert np.hypot(x, z) == pytest.approx(0.05, abs=1e-5)


def test_rosbags_reads_the_file_too(bag: tuple[dynsim.Record, Path]) -> None:
    from rosbags.highlevel import AnyReader

    record, file = bag
    with AnyReader([file]) as reader:
        kinds = {item.topic: item.msgtype for item in reader.connections}
        assert kinds == {
            "/joint_states": "sensor_msgs/msg/JointState",
            "/robot_description": "std_msgs/msg/String",
            "/tf": "tf2_msgs/msg/TFMessage",
            "/contacts/elbow_4": "geometry_msgs/msg/WrenchStamped",
            "/contacts/elbow_7": "geometry_msgs/msg/WrenchStamped",
        }
        actual = [
            reader.deserialize(raw, item.msgtype).position
            for item, _, raw in reader.messages()
            if item.topic == "/joint_states"
        ]
    np.testing.assert_array_equal(actual, record["q"])


def test_a_run_that_stopped_after_its_first_sample_is_a_bag_too(tmp_path: Path) -> None:
    """Figures and the page accept one sample; motion formats need two samples and raise an error otherwise."""
    pytest.importorskip("mcap")
    scenario = load_scenario("elbow_comparison_floor", "two_elbows")
    simulation = dynsim.Simulation(scenario)
    simulation.advance(1e-6)
    record = simulation.record(scenario)
    assert len(record) == 1
    assert write_mcap(record, tmp_path / "run.mcap").stat().st_size > 1000
    with raises(dynsim.errors.RecordError):
        export_record(record, tmp_path / "run.csv", "csv")


def test_the_description_in_the_bag_is_the_scene_in_pinocchio(bag: tuple[dynsim.Record, Path]) -> None:
    record, _ = bag
    peer = pinocchio.buildModelFromXML(scene_urdf(record.scene, "arm"))
    data = peer.createData()
    q = pinocchio.neutral(peer)
    for joint, angle in zip(record.labels["q"], record["q"][-1], strict=True):
        item = peer.joints[peer.getJointId(joint)]
        q[item.idx_q : item.idx_q + item.nq] = [angle] if item.nq == 1 else [np.cos(angle), np.sin(angle)]
    pinocchio.framesForwardKinematics(peer, data, q)
    poses = poses_at(record.scene, {"q": dict(zip(record.labels["q"], record["q"][-1], strict=True))})
    for body, pose in zip(record.scene.bodies, poses, strict=True):
        np.testing.assert_allclose(data.oMf[peer.getFrameId(body.name)].translation, pose[:3], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["record.h5", "--format", "mjcf"], ("record.h5", "mjcf")),
        (["elbow_comparison", "--format", "urdf", "--rate", "10"], ("--rate", "--trust", "urdf")),
        (["record.h5", "--format", "csv", "--variant", "a"], ("--variant", "--set", "urdf", "mjcf", "csv")),
        (["elbow_comparison", "--format", "mcap"], ("elbow_comparison",)),
    ],
)
def test_what_does_not_fit_is_refused_in_words(arguments: list[str], names: tuple[str, ...]) -> None:
    done = CliRunner().invoke(app, ["export", *arguments])
    assert done.exit_code != 0
    check_message(done.output + str(done.exception), *names)
