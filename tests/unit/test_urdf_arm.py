"""An arm from a URDF file in a scenario: units of its joints, limits, locks, frames and free bodies."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, raises

from dynsim.engine import check, simulate
from dynsim.errors import ModelError, ScenarioError
from dynsim.model.urdf.reader import rotation
from dynsim.record import Record
from dynsim.scenario import build_model, load_scenario

# A car of 1 kg on a rail along x, and an arm of 1 kg hinged to it at its centre of mass: neither disturbs the other.
SLIDE = """<robot name="r"><link name="base"/>
<link name="car"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="car"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="20" velocity="0.5"/></joint>
<joint name="hinge" type="continuous"><parent link="car"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""
SCENARIO = """duration_s: 0.5
plant: {type: urdf_arm, file: slide.urdf, gravity_m_s2: [9.81, 0, 0]}
integrator: {rtol: 1.0e-10, atol: 1.0e-12}
record: {rate_hz: 1000}
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    (tmp_path / "slide.urdf").write_text(SLIDE)
    (tmp_path / "case.yaml").write_text(SCENARIO)
    return tmp_path / "case.yaml"


def run(scenario: Path, overrides: dict[str, Any]) -> Record:
    return simulate(load_scenario(scenario, overrides=overrides))


def test_joints_start_and_lose_in_the_units_of_their_kind(scenario: Path):
    plant = {
        "initial_deg": {"hinge": 90},
        "initial_m": {"slide": 0.2},
        "damping_N_m_s_per_rad": 0.5,
        "damping_N_s_per_m": 3,
        "friction_N_m": 0.2,
        "friction_N": 4,
    }
    overrides = {f"plant.{key}": value for key, value in plant.items()}
    robot = build_model(load_scenario(scenario, overrides=overrides)).robot
    assert robot.initial == pytest.approx([0.2, np.pi / 2])
    assert [(link.damping, link.friction) for link in robot.links] == [(3.0, 4.0), (0.5, 0.2)]
    for key, joint in (("initial_deg", "slide"), ("initial_m", "hinge")):
        with raises(ScenarioError, f"plant.{key}.{joint} = 1"):
            load_scenario(scenario, overrides={f"plant.{key}.{joint}": 1})


def test_a_missing_file_is_told_with_its_line(scenario: Path):
    scenario.write_text(SCENARIO.replace("slide.urdf", "slde.urdf"))
    with raises(ScenarioError, "case.yaml:2", "plant.file", "slde.urdf"):
        load_scenario(scenario)


def test_dry_friction_of_the_file_holds_at_rest(scenario: Path):
    """Gravity pulls the car of 1 kg and the arm along the rail with 19.62 N."""
    text = SLIDE.replace("<limit lower", '<dynamics friction="30"/><limit lower')
    (scenario.parent / "slide.urdf").write_text(text)
    with raises(ModelError, "slide", "contacts.law: unilateral"):
        run(scenario, {})
    real = {"contacts.law": "unilateral", "duration_s": 0.4}  # its stop is at 1 m
    assert np.abs(run(scenario, real)["q"][:, 0]).max() < 1e-12
    for friction in (0, 10):
        record = run(scenario, {**real, "plant.friction_N": friction})
        assert record["q"][-1, 0] == pytest.approx(0.5 * (9.81 - friction / 2) * 0.4**2, rel=1e-6)


def test_signals_are_in_the_units_of_both_kinds(scenario: Path):
    units = run(scenario, {"plant.motors": {"slide": {"type": "wang_minami"}}}).units
    assert [units[name] for name in ("q", "v", "vdot")] == ["rad or m", "rad/s or m/s", "rad/s² or m/s²"]
    assert units["torque"] == "N"


def test_passed_limits_are_warned_of_with_joint_time_and_amount(scenario: Path):
    warnings = run(scenario, {}).summary["warnings"]
    # Falling along the rail: x = g t²/2 is 1 m at 0.4515 s and 1.226 m at 0.5 s; v = g t is 0.5 m/s at 0.05097 s and
    # 4.905 m/s at the end. The first sample after it counts.
    position, velocity = (warning.split(";")[0] for warning in warnings)
    check_message(position, "slide", "1 m", "0.226 m", "0.452 s")
    # 4.405 m/s is rounded either way.
    check_message(velocity.replace("4.41", "4.4"), "slide", "0.5 m/s", "4.4 m/s", "0.051 s")


def test_passed_effort_is_warned_of(scenario: Path):
    # Held against gravity, the motor swings in to 2 kg · 11 m/s² = 22 N; the limit is 20 N.
    overrides = {
        "plant.gravity_m_s2": [11.0, 0, 0],
        "plant.motors": {"slide": {"type": "wang_minami"}},
        "controller": {"type": "joint_pd", "k_p_V_per_rad": 5000, "k_d_V_s_per_rad": 500},
    }
    record = run(scenario, overrides)
    amount = np.abs(record["torque"][:, 0]).max() - 20.0
    assert 1.5 < amount < 4.0
    assert lines_with(record.summary["warnings"], "slide", "20 N", f"{amount:.3g} N", re.compile(r"t = 0\.\d+ s"))


def test_within_limits_and_at_a_rounded_limit_nothing_is_said(scenario: Path):
    weightless = {"plant.gravity_m_s2": [0.0, 0, 0]}
    assert run(scenario, weightless).summary["warnings"] == []
    text = SLIDE.replace('upper="1"', 'upper="0.1999999"')
    (scenario.parent / "slide.urdf").write_text(text)
    assert run(scenario, {**weightless, "plant.initial_m": {"slide": 0.2}}).summary["warnings"] == []


def test_zero_velocity_and_effort_mean_no_limit(scenario: Path):
    (scenario.parent / "slide.urdf").write_text(SLIDE.replace('effort="20" velocity="0.5"', 'effort="0" velocity="0"'))
    link = build_model(load_scenario(scenario)).robot.links[0]
    assert (link.velocity_limit, link.effort_limit) == (np.inf, np.inf)


# On the arm: a bracket, turned by 90° about y and fixed at 0.3 m, and on it a flap that mimics the hinge.
BRACKET = """<link name="bracket"/><joint name="mount" type="fixed"><origin xyz="0 0 0.3" rpy="0 1.5707963267948966 0"/>
<parent link="arm"/><child link="bracket"/></joint>
<link name="flap"><inertial><mass value="0.5"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="flap_hinge" type="continuous"><parent link="bracket"/><child link="flap"/><axis xyz="0 1 0"/>
<mimic joint="hinge"/></joint></robot>"""


@pytest.fixture
def bracket(scenario: Path) -> Path:
    text = SLIDE.replace("</robot>", BRACKET)
    (scenario.parent / "slide.urdf").write_text(text)
    return scenario


def test_the_mass_of_a_motor_is_in_the_frame_of_the_link_before_its_joint(bracket: Path):
    """Also if that link is fixed to a body and turned: it acts as a payload there."""
    motor = {"type": "torque", "mass_kg": 1.5, "mass_point_m": [0.1, 0.2, 0.3]}
    with_motor = build_model(load_scenario(bracket, overrides={"plant.motors": {"flap_hinge": motor}}))
    payload = {"type": "payload", "body": "bracket", "mass_kg": 1.5, "point_m": [0.1, 0.2, 0.3]}
    with_payload = build_model(load_scenario(bracket, overrides={"loads.motor": payload}))
    q = np.array([0.1, 0.7, 0.7])
    assert with_motor.mass_matrix(q) == pytest.approx(with_payload.mass_matrix(q), rel=1e-12)
    assert with_motor.bias_forces(q, q) == pytest.approx(with_payload.bias_forces(q, q), rel=1e-12)


def test_coupled_joints_are_locked_by_the_scenario(bracket: Path):
    assert build_model(load_scenario(bracket)).joint_names == ("slide", "hinge", "flap_hinge")
    model = build_model(load_scenario(bracket, overrides={"plant.lock_deg": {"flap_hinge": 30}}))
    assert model.joint_names == ("slide", "hinge")
    assert model.robot.links[1].inertia.mass == 1.5
    # The bracket's x is the arm's −z: of 0.2 m along the flap's x, cos 30° go down and sin 30° back along x.
    position = model.point_position("flap", [0.2, 0, 0], [0, 0])
    assert position == pytest.approx([-0.1, 0, 0.3 - 0.2 * np.cos(np.pi / 6)], abs=1e-15)
    assert mentions(run(bracket, {"plant.lock_deg": {"flap_hinge": 30}}).summary["warnings"][0], "slide", "1 m")


def test_locked_positions_are_in_the_units_of_their_kind(bracket: Path):
    overrides = {"plant.lock_deg": {"flap_hinge": 0}, "plant.lock_m": {"slide": 0.25}}
    model = build_model(load_scenario(bracket, overrides=overrides))
    assert model.joint_names == ("hinge",)
    assert model.robot.links[0].p_PJ.tolist() == [0.25, 0, 0]


@pytest.mark.parametrize(
    ("keys", "names"),
    [
        ("lock_deg: {flap_hing: 0}", ["case.yaml:3", "plant.lock_deg.flap_hing", "'flap_hinge'"]),
        ("lock_m: {flap_hinge: 0}", ["case.yaml:3", "flap_hinge", "revolute", "plant.lock_deg"]),
        ("lock_deg: {slide: 0}", ["case.yaml:3", "slide", "prismatic", "plant.lock_m"]),
        ("lock_deg: {mount: 0}", ["case.yaml:3", "plant.lock_deg.mount"]),
        ("lock_deg: {hinge: 0}, initial_deg: {hinge: 0}", ["case.yaml:3", "plant.initial_deg.hinge", "plant.lock_deg"]),
        (
            "lock_deg: {hinge: 0}, motors: {hinge: {type: wang_minami}}",
            ["case.yaml:3", "plant.motors.hinge", "plant.lock_deg"],
        ),
        ("lock_deg: {hinge: .nan}", ["case.yaml:3", "plant.lock_deg.hinge = nan"]),
        ("motors: {hing: {type: wang_minami}}", ["case.yaml:3", "plant.motors.hing", "'hinge'"]),
    ],
)
def test_joints_of_the_scenario_are_checked_with_their_lines(bracket: Path, keys: str, names: list[str]):
    text = SCENARIO.replace("file: slide.urdf, gravity_m_s2: [9.81, 0, 0]}", f"file: slide.urdf,\n  {keys}}}")
    bracket.write_text(text)
    with raises(ScenarioError, *names):
        load_scenario(bracket)


def test_contacts_and_hand_may_be_in_frames(bracket: Path):
    """A point of the bracket is held to a wall as the same point of the arm is; the hand is there too."""
    common = {"plant.lock_deg": {"flap_hinge": 0}, "surfaces.wall": {"type": "plane", "point_m": [0, 0, 0.2]}}
    records = []
    # The bracket's x is the arm's −z, its z the arm's x: (0.1, 0, 0.4) there is (0.4, 0, 0.2) on the arm.
    for body, point in (("bracket", [0.1, 0, 0.4]), ("arm", [0.4, 0, 0.2])):
        at = {"body": body, "point_m": point}
        overrides = {**common, "plant.hand": at, "contacts.points.brace": {**at, "surface": "wall"}}
        records.append(run(bracket, overrides))
    first, second = records
    assert first.summary["constraint_drift_max_m"] < 1e-9
    # The points differ by a rounding.
    for name in ("q", "hand_position", "contact_normal_force"):
        np.testing.assert_allclose(first[name], second[name], rtol=1e-9, atol=1e-9)


def test_names_that_are_no_place_are_refused(bracket: Path):
    lock = {"plant.lock_deg": {"flap_hinge": 0}}
    with raises(ModelError, "plant.hand.body", "braket", "bracket"):
        build_model(load_scenario(bracket, overrides={**lock, "plant.hand": {"body": "braket"}}))
    with raises(ModelError, "plant.hand.body", "base"):
        build_model(load_scenario(bracket, overrides={**lock, "plant.hand": {"body": "base"}}))
    point = {"contacts.points.brace": {"body": "braket"}, "surfaces.floor": {"type": "plane"}}
    with raises(ModelError, "contacts.points.brace.body", "braket", "bracket"):
        check(load_scenario(bracket, overrides={**lock, **point}))


INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
# A body that floats with an arm on it, and one that slides and turns in a plane whose normal is left open.
FREE = f"""<robot name="free"><link name="base"/>
<link name="body">{INERTIAL}</link><link name="puck">{INERTIAL}</link><link name="arm">{INERTIAL}</link>
<joint name="root" type="floating"><origin xyz="0 0 1"/><parent link="base"/><child link="body"/></joint>
<joint name="slide" type="planar"><parent link="base"/><child link="puck"/><axis xyz="%s"/></joint>
<joint name="hinge" type="continuous"><parent link="body"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""


@pytest.fixture
def free(tmp_path: Path) -> Path:
    (tmp_path / "slide.urdf").write_text(FREE % "0 0 1")
    (tmp_path / "case.yaml").write_text(SCENARIO)
    return tmp_path / "case.yaml"


def test_free_bodies_start_in_the_poses_of_the_scenario(free: Path):
    poses = {
        "root": {"position_m": [1, 2, 3], "rpy_deg": [30, -60, 170]},
        "slide": {"position_m": [0.5, -0.25, 0], "rpy_deg": [0, 0, 100]},
    }
    overrides = {"plant.initial_pose": poses, "plant.initial_deg": {"hinge": 20}}
    model = build_model(load_scenario(free, overrides=overrides))
    q = model.robot.initial
    R, p = model.body_pose("body", q)
    np.testing.assert_allclose(p, [1, 2, 4], atol=1e-15)
    np.testing.assert_allclose(R, rotation(*np.deg2rad([30, -60, 170])), atol=1e-15)
    R, p = model.body_pose("puck", q)
    np.testing.assert_allclose(p, [0.5, -0.25, 0], atol=1e-15)
    np.testing.assert_allclose(R, rotation(0, 0, np.deg2rad(100)), atol=1e-15)
    assert dict(zip(model.robot.position_names, q, strict=True))["hinge"] == pytest.approx(np.deg2rad(20))


def test_a_pose_in_a_plane_that_is_not_horizontal(free: Path):
    (free.parent / "slide.urdf").write_text(FREE % "0 1 0")
    pose = {"position_m": [0.5, 0, -0.25], "rpy_deg": [0, 35, 0]}
    model = build_model(load_scenario(free, overrides={"plant.initial_pose": {"slide": pose}}))
    R, p = model.body_pose("puck", model.robot.initial)
    np.testing.assert_allclose(p, [0.5, 0, -0.25], atol=1e-15)
    np.testing.assert_allclose(R, rotation(0, np.deg2rad(35), 0), atol=1e-15)


@pytest.mark.parametrize(
    ("key", "value", "names"),
    [
        ("initial_pose.hinge", {}, ("hinge", "revolute", "plant.initial_deg")),
        ("initial_pose.roof", {}, ("roof", "root")),
        ("initial_pose.root", {"rpy_deg": [0, 0]}, ("plant.initial_pose.root.rpy_deg", "2", "3")),
        ("initial_m.slide", 1, ("slide", "planar", "plant.initial_pose.slide")),
        ("lock_deg.root", 1, ("root", "floating", "plant.initial_pose.root")),
        ("motors.root", {"type": "wang_minami"}, ("root", "floating")),
    ],
)
def test_free_bodies_have_no_motor_angle_or_distance(free: Path, key: str, value: Any, names: tuple[str, ...]):
    with raises(ScenarioError, f"plant.{key}", *names):
        load_scenario(free, overrides={f"plant.{key}": value})


@pytest.mark.parametrize(
    ("pose", "name"),
    [
        ({"position_m": [0, 0, 0.1]}, "plant.initial_pose.slide.position_m"),
        ({"rpy_deg": [0, 10, 0]}, "plant.initial_pose.slide.rpy_deg"),
    ],
)
def test_a_pose_off_the_plane_is_refused(free: Path, pose: dict[str, Any], name: str):
    with raises(ModelError, name, "[0.0, 0.0, 1.0]"):
        build_model(load_scenario(free, overrides={"plant.initial_pose": {"slide": pose}}))


def test_the_motor_of_all_joints_is_not_that_of_free_bodies(free: Path):
    plant = {"plant.motor": {"type": "wang_minami"}, "plant.damping_N_m_s_per_rad": 0.5, "plant.damping_N_s_per_m": 3}
    robot = build_model(load_scenario(free, overrides=plant)).robot
    assert [motor.joint for motor in robot.motors] == ["hinge"]
    assert {link.joint: link.damping for link in robot.links if link.damping} == {"hinge": 0.5}


def test_the_record_names_coordinates_and_rates(free: Path):
    record = run(free, {"plant.motors": {"hinge": {"type": "wang_minami"}}})
    assert record.labels["q"][:10] == (
        *(f"root.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")),
        *(f"slide.{name}" for name in ("x", "y", "angle")),
    )
    assert (record.units["q"], record.units["v"]) == ("rad or m or 1", "rad/s or m/s")
    assert record.labels["v"][:6] == tuple(f"root.{name}" for name in ("x", "y", "z", "wx", "wy", "wz"))
    # Gravity 9.81 along x moves the floating body and the puck alike.
    fallen = 0.5 * 9.81 * 0.5**2
    assert record["q"][-1, [0, 7]] == pytest.approx([fallen, fallen], abs=1e-8)


def test_limits_behind_a_free_body_are_looked_at_in_their_own_coordinate(free: Path):
    limited = '<axis xyz="0 1 0"/><limit lower="-0.1" upper="0.2" velocity="0.4" effort="50"/></joint></robot>'
    text = (FREE % "0 0 1").replace('"hinge" type="continuous"', '"hinge" type="revolute"')
    (free.parent / "slide.urdf").write_text(text.replace('<axis xyz="0 1 0"/></joint></robot>', limited))
    overrides = {"plant.initial_deg": {"hinge": 18}, "plant.initial_pose": {"root": {"position_m": [5, 5, 5]}}}
    with raises(ModelError, "hinge", "18°", "11.459°"):
        run(free, overrides)


def test_motors_hold_and_the_hand_is_led_behind_a_free_body(free: Path):
    """A far heavier body that floats: its arm, of one hinge, follows a path; the columns of q are not those of v."""
    heavy = (FREE % "0 0 1").replace(
        '<mass value="1"/><inertia ixx="1" iyy="1" izz="1"',
        '<mass value="1e9"/><inertia ixx="1e9" iyy="1e9" izz="1e9"',
        1,
    )
    (free.parent / "slide.urdf").write_text(heavy)
    base = {
        "plant.gravity_m_s2": [0, 0, 0],
        "plant.hand": {"body": "arm", "point_m": [1, 0, 0]},
        "plant.motor": {"type": "wang_minami"},
        "plant.initial_deg": {"hinge": 20},
        "integrator": {},
    }
    held = run(free, {**base, "controller": {"type": "joint_pd"}})
    assert np.ptp(held["q"][:, 10]) < 1e-6
    # The hinge's angle about y: down by it.
    a, b = np.deg2rad([20, 26])
    line = {"type": "line", "from_m": [np.cos(a), 0, 1 - np.sin(a)], "to_m": [np.cos(b), 0, 1 - np.sin(b)]}
    path = {**line, "start_s": 0, "duration_s": 0.4}
    hand = {"path": path, "joints": ["hinge"], "tolerance_m": 0.01}
    led = run(free, {**base, "controller": {"type": "joint_pd", "hand": hand, "k_p_V_per_rad": 5000}})
    assert led["q"][-1, 10] == pytest.approx(b, abs=0.01)
