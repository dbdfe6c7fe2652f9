"""Robots of the package example-robot-data: against Pinocchio, and braced in a run.

The package has no LBR iiwa; the xArm 7 is its arm of that build, seven joints about alternating axes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from importlib.metadata import files
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from support.messages import check_message
from support.urdf_in_pinocchio import assert_pinocchio_reads_the_same

from dynsim.compile.model import Model
from dynsim.engine import simulate
from dynsim.errors import ModelError
from dynsim.model.urdf.reader import read_tree, read_urdf
from dynsim.scenario import build_model, load_scenario

# Masses of 1 to 100 kg at distances of up to 2 m: sums of some hundred products, each rounded to 1e-16.
ROUNDING = 1e-11


def packaged() -> list[Path]:
    """All URDF files of the package."""
    return sorted(Path(str(f.locate())) for f in files("example-robot-data") or () if f.suffix == ".urdf")


@dataclass(frozen=True)
class Known:
    """A file of the package, what must be locked in it [deg or m], the braced link and a frame behind a fixed joint."""

    file: str
    brace: str
    frame: str
    joints: int
    initial_deg: dict[str, float]
    lock_deg: dict[str, float] = field(default_factory=dict)
    lock_m: dict[str, float] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        """Where the package has the file."""
        return next(path for path in packaged() if path.name == self.file)

    @property
    def lock(self) -> dict[str, float]:
        """Positions of the locked joints [rad or m]."""
        return {name: float(np.deg2rad(angle)) for name, angle in self.lock_deg.items()} | self.lock_m


FINGERS = {
    f"gripper_{side}_{part}_joint": angle
    for side in ("left", "right")
    for part, angle in (
        ("inner_double", -20.0),
        ("fingertip_1", 20.0),
        ("fingertip_2", 10.0),
        ("motor_single", 20.0),
        ("inner_single", 20.0),
        ("fingertip_3", 20.0),
    )
}
ROBOTS = {
    "panda": Known(
        "panda.urdf",
        "panda_link4",
        "panda_hand_tcp",
        8,
        {"panda_joint2": 60, "panda_joint4": -80, "panda_joint6": 90},
        lock_m={"panda_finger_joint2": 0.02},
    ),
    "ur5": Known("ur5_robot.urdf", "forearm_link", "tool0", 6, {"shoulder_lift_joint": -30, "elbow_joint": 70}),
    "xarm7": Known("xarm7.urdf", "link4", "link_eef", 7, {"joint2": 40, "joint4": 60}),
    "talos": Known(
        "talos_full_v2.urdf",
        "arm_left_4_link",
        "gripper_left_fingertip_1_link",
        32,
        {"arm_left_2_joint": 20, "arm_left_4_joint": -70},
        lock_deg=FINGERS,
    ),
}

# Of the files' joints, which contacts.law: unilateral alone has.
WITHOUT_FRICTION = {"friction_N_m": 0.0, "friction_N": 0.0}


@pytest.fixture(params=ROBOTS)
def known(request: pytest.FixtureRequest) -> Known:
    return ROBOTS[request.param]


def reduced(known: Known) -> Any:
    """Pinocchio's own model of the file, with its own way of locking joints."""
    model = pinocchio.buildModelFromUrdf(str(known.path))
    v = np.zeros(model.nv)
    for name, value in known.lock.items():
        v[model.joints[model.getJointId(name)].idx_v] = value
    at = pinocchio.integrate(model, pinocchio.neutral(model), v)
    return pinocchio.buildReducedModel(model, [model.getJointId(name) for name in known.lock], at)


def test_dynamics_and_frames_are_pinocchios(known: Known) -> None:
    ours, theirs = Model.from_urdf(known.path, known.lock), reduced(known)
    data = theirs.createData()
    assert ours.n == theirs.nv == known.joints
    order = [theirs.joints[theirs.getJointId(name)].idx_v for name in ours.joint_names]
    rng = np.random.default_rng(3)
    for _ in range(5):
        q, v = rng.uniform(-2, 2, (2, ours.n))
        q_theirs, v_theirs = np.zeros((2, ours.n))
        q_theirs[order], v_theirs[order] = q, v
        q_theirs = pinocchio.integrate(theirs, pinocchio.neutral(theirs), q_theirs)
        M = pinocchio.crba(theirs, data, q_theirs)
        M = (np.triu(M) + np.triu(M, 1).T)[np.ix_(order, order)]
        np.testing.assert_allclose(ours.mass_matrix(q), M, rtol=0, atol=ROUNDING * abs(M).max())
        bias = pinocchio.nonLinearEffects(theirs, data, q_theirs, v_theirs)[order]
        np.testing.assert_allclose(ours.bias_forces(q, v), bias, rtol=0, atol=ROUNDING * max(1.0, abs(bias).max()))
        pinocchio.framesForwardKinematics(theirs, data, q_theirs)
        for name in (known.brace, known.frame):
            pose = data.oMf[theirs.getFrameId(name)]
            for point in (np.zeros(3), np.array([0.1, -0.2, 0.3])):
                position = ours.point_position(name, point, q)
                np.testing.assert_allclose(position, pose.act(point), rtol=0, atol=ROUNDING)
    assert sum(link.inertia.mass for link in ours.robot.links) == pytest.approx(
        sum(inertia.mass for inertia in list(theirs.inertias)[1:]), rel=1e-14
    )


def test_written_and_read_again_it_is_the_same(known: Known, tmp_path: Path) -> None:
    before = Model.from_urdf(known.path, known.lock)
    (tmp_path / "again.urdf").write_text(before.to_urdf())
    after = Model.from_urdf(tmp_path / "again.urdf")
    assert after.joint_names == before.joint_names
    q, v = np.random.default_rng(4).uniform(-2, 2, (2, before.n))
    M, bias = before.mass_matrix(q), before.bias_forces(q, v)
    np.testing.assert_allclose(after.mass_matrix(q), M, rtol=0, atol=ROUNDING * abs(M).max())
    np.testing.assert_allclose(after.bias_forces(q, v), bias, rtol=0, atol=ROUNDING * max(1.0, abs(bias).max()))
    for frame in before.robot.frames:
        if frame.body is not None:
            for point in np.eye(3):
                expected = before.point_position(frame.name, point, q)
                np.testing.assert_allclose(after.point_position(frame.name, point, q), expected, rtol=0, atol=ROUNDING)


# What is refused of the package, and why.
REFUSED = {
    "alex_psyonic_hands.urdf": ("'Left_index_q2'", "'index_q1'"),
    "quadrotor_base.urdf": ("quadrotor_base.urdf",),
    "iris_simple.urdf": ("iris_simple.urdf",),
    "ur3.urdf": ("<link>",),
    "romeo_laas_small.urdf": ("urdf:235", "'LShoulderYaw_link'", "kg m²"),
    "romeo_small.urdf": ("urdf:547", "'RShoulderYawLink'", "kg m²"),
}


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*\\.(urdf|xacro)\\b.*:UserWarning")
def test_every_other_robot_of_the_package_is_read_as_pinocchio_reads_it() -> None:
    """Some 60 files of many makers. iCub has moments of −5e-20 kg m² by rounding."""
    read, refused = 0, {}
    for path in packaged():
        try:
            read_urdf(path)
            assert_pinocchio_reads_the_same(path)
        except ModelError as error:
            refused[path.name] = str(error)
        else:
            read += 1
    assert refused.keys() == REFUSED.keys(), refused
    for name, message in refused.items():
        check_message(message, *REFUSED[name])
    assert read > 60


def test_it_runs_with_a_brace(known: Known, tmp_path: Path) -> None:
    """A point of a link held on a plane through where it starts, motors that hold the arm, and a frame as the hand."""
    point = [0.05, 0.0, 0.02]
    scenario: dict[str, Any] = {
        "duration_s": 0.1,
        "plant": {
            "type": "urdf_arm",
            "file": str(known.path),
            "initial_deg": known.initial_deg,
            "lock_deg": known.lock_deg,
            "lock_m": known.lock_m,
            **WITHOUT_FRICTION,
            "hand": {"body": known.frame, "point_m": [0.0, 0.0, 0.01]},
            "motor": {
                "type": "dc",
                "torque_constant_N_m_per_A": 0.1,
                "resistance_ohm": 0.5,
                "inductance_H": 0.0005,
                "rotor_inertia_kg_m2": 5e-5,
                "gear_ratio": 100,
                "gear_damping_N_m_s_per_rad": 1e-4,
            },
        },
        "controller": {"type": "joint_pd", "k_p_V_per_rad": 500, "k_d_V_s_per_rad": 5},
        "contacts": {"points": {"brace": {"body": known.brace, "point_m": point}}},
    }
    path = tmp_path / "braced.yaml"
    path.write_text(json.dumps(scenario))
    # Where the point is before there is a surface.
    model = build_model(load_scenario(path, overrides={"contacts.points": {}}))
    start = model.point_position(known.brace, point, model.robot.initial)
    floor = {"floor": {"type": "plane", "point_m": start.tolist()}}
    record = simulate(load_scenario(path, overrides={"surfaces": floor}))
    # The default tolerances, rtol = 1e-6, close the ledger to some 1e-8 in a tenth of a second.
    assert abs(record.summary["energy_residual_relative"]) < 1e-6
    assert record.summary["constraint_drift_max_m"] < 1e-9
    assert np.abs(record["contact_normal_force"]).max() > 1.0
    hand = model.point_position(known.frame, [0.0, 0.0, 0.01], record["q"][-1])
    np.testing.assert_allclose(record["hand_position"][-1], hand, rtol=0, atol=1e-12)


# Robots that stand on legs, with the links of their feet.
FREE = {
    "solo": ("solo12.urdf", ["FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"]),
    "talos": ("talos_reduced.urdf", ["left_sole_link", "right_sole_link"]),
}


@dataclass(frozen=True)
class Free:
    """A robot of the package on a floating joint, in dynsim by its URDF and in Pinocchio by its free flyer."""

    path: Path
    feet: list[str]
    theirs: Any

    def transformed(self, ours: Model, q: Any, v: Any, vdot: Any) -> tuple[Any, ...]:
        """Pinocchio's q, v, v̇ and T, v_P = T v: its velocity of the root has the axes of the body."""
        w, x, y, z = q[3:7]
        R = pinocchio.Quaternion(w, x, y, z).matrix()
        order = [self.theirs.joints[self.theirs.getJointId(name)].idx_v for name in ours.joint_names[6:]]
        T = np.zeros((ours.n, ours.n))
        T[:3, :3], T[3:6, 3:6], T[order, range(6, ours.n)] = R.T, np.eye(3), 1.0
        angles = np.zeros(ours.n)
        angles[order] = q[7:]
        at = pinocchio.integrate(self.theirs, pinocchio.neutral(self.theirs), angles)
        at[:7] = *q[:3], x, y, z, w
        rates = T @ vdot
        rates[:3] -= np.cross(v[3:6], R.T @ v[:3])
        return at, T @ v, rates, T


@pytest.fixture(params=FREE)
def free(request: pytest.FixtureRequest, tmp_path: Path) -> Free:
    """The file with a floating joint between the world and its root link."""
    name, feet = FREE[request.param]
    path = next(path for path in packaged() if path.name == name)
    joint = f'''<link name="the_world"/><joint name="root" type="floating"><parent link="the_world"/>
        <child link="{read_tree(path).roots[0]}"/></joint></robot>'''
    (tmp_path / name).write_text(path.read_text().replace("</robot>", joint))
    return Free(tmp_path / name, feet, pinocchio.buildModelFromUrdf(str(path), pinocchio.JointModelFreeFlyer()))


def test_free_robots_are_pinocchios(free: Free, tmp_path: Path) -> None:
    ours, theirs = Model.from_urdf(free.path), free.theirs
    data = theirs.createData()
    assert ours.n == theirs.nv
    assert ours.nq == ours.n + 1
    (tmp_path / "again.urdf").write_text(ours.to_urdf())
    again = Model.from_urdf(tmp_path / "again.urdf")
    assert again.robot.position_names == ours.robot.position_names
    rng = np.random.default_rng(3)
    for _ in range(5):
        q, v, vdot = rng.uniform(-2, 2, ours.nq), *rng.uniform(-2, 2, (2, ours.n))
        q[3:7] /= np.linalg.norm(q[3:7])
        q_theirs, v_theirs, vdot_theirs, T = free.transformed(ours, q, v, vdot)
        M = pinocchio.crba(theirs, data, q_theirs)
        M = T.T @ (np.triu(M) + np.triu(M, 1).T) @ T
        tau = T.T @ pinocchio.rnea(theirs, data, q_theirs, v_theirs, vdot_theirs)
        pinocchio.framesForwardKinematics(theirs, data, q_theirs)
        for model in (ours, again):
            np.testing.assert_allclose(model.mass_matrix(q), M, rtol=0, atol=ROUNDING * abs(M).max())
            np.testing.assert_allclose(model.inverse_dynamics(q, v, vdot), tau, rtol=0, atol=ROUNDING * abs(tau).max())
            for foot in free.feet:
                position = data.oMf[theirs.getFrameId(foot)].translation
                np.testing.assert_allclose(model.point_position(foot, np.zeros(3), q), position, rtol=0, atol=ROUNDING)


def run_free(free: Free, tmp_path: Path, **contacts: Any) -> tuple[Model, Any]:
    motor = {
        "type": "dc",
        "torque_constant_N_m_per_A": 0.1,
        "resistance_ohm": 0.5,
        "inductance_H": 0.0005,
        "rotor_inertia_kg_m2": 1e-5,
        "gear_ratio": 30,
        "gear_damping_N_m_s_per_rad": 1e-5,
    }
    pose = {"position_m": [0.1, -0.2, 1.0], "rpy_deg": [10, -20, 120]}
    plant = {"type": "urdf_arm", "file": str(free.path), "motor": motor, "initial_pose": {"root": pose}}
    plant |= WITHOUT_FRICTION
    control = {"type": "joint_pd", "k_p_V_per_rad": 50, "k_d_V_s_per_rad": 1}
    scenario = {"duration_s": 0.2, "plant": plant, "controller": control, "integrator": {"rtol": 1e-8}, **contacts}
    path = tmp_path / "free.yaml"
    path.write_text(json.dumps(scenario))
    loaded = load_scenario(path)
    return build_model(loaded), simulate(loaded)


def check_motion(free: Free, model: Model, record: Any, points: dict[str, str]) -> None:
    """tau_P(q, v, v̇) is what motors, losses and contacts do, at every sample; the samples are of unit quaternions."""
    q, v = record["q"], record["v"]
    assert np.abs(np.linalg.norm(q[:, 3:7], axis=1) - 1.0).max() < 1e-15
    driven = [model.joint_names.index(name) for name in record.labels["torque"]]
    assert driven == list(range(6, model.n))
    # The record's torque is that of the shaft: without the rotor's inertia and the gear's loss.
    losses = np.array([link.damping for link in model.robot.links])
    for k in range(0, len(record), 10):
        at, rate, acceleration, T = free.transformed(model, q[k], v[k], record["vdot"][k])
        expected = T.T @ pinocchio.rnea(free.theirs, free.theirs.createData(), at, rate, acceleration)
        tau = -losses * v[k]
        tau[driven] += record["torque"][k]
        for c, name in enumerate(record.labels["contact_normal_force"]):
            tau += model.point_jacobian(points[name], np.zeros(3), q[k]).T @ record["contact_force"][k, c]
        # Contact forces carry the condition of the contacts' rows.
        np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-8 * max(1.0, abs(expected).max()))


def test_a_free_robot_falls_as_pinocchios_does(free: Free, tmp_path: Path) -> None:
    model, record = run_free(free, tmp_path)
    check_motion(free, model, record, {})
    robot, data = free.theirs, free.theirs.createData()
    heights = []
    for k in (0, -1):
        at, _, _, _ = free.transformed(model, record["q"][k], record["v"][k], record["vdot"][k])
        heights.append(pinocchio.centerOfMass(robot, data, at)[2])
    assert heights[1] - heights[0] == pytest.approx(-0.5 * 9.81 * 0.2**2, abs=1e-7)
    assert record["q"][0, 0:3] == pytest.approx([0.1, -0.2, 1.0])


def test_a_free_robot_with_its_feet_on_slopes(free: Free, tmp_path: Path) -> None:
    """Every foot on a plane through where it starts, with friction: drift, ledger, and Pinocchio's inverse dynamics."""
    start, _ = run_free(free, tmp_path)
    surfaces, points = {}, {}
    for k, foot in enumerate(free.feet):
        position = start.point_position(foot, np.zeros(3), start.robot.initial)
        surfaces[f"slope_{k}"] = {"type": "plane", "point_m": position.tolist(), "normal": [0.1 * k - 0.1, 0.2, 1.0]}
        points[f"foot_{k}"] = {"body": foot, "surface": f"slope_{k}"}
    model, record = run_free(free, tmp_path, surfaces=surfaces, contacts={"points": points, "friction": 0.2})
    check_motion(free, model, record, {name: point["body"] for name, point in points.items()})
    assert record.summary["constraint_drift_max_m"] < 1e-9
    assert abs(record.summary["energy_residual_relative"]) < 1e-6
    assert np.abs(record["contact_normal_force"]).max() > 1.0
