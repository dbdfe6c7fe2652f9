"""Scenarios exported to MuJoCo and run there: motors with their loops and limits, contacts, meshes, named omissions."""

from __future__ import annotations

import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, raises
from typer.testing import CliRunner

import dynsim
from dynsim.cli.commands import app
from dynsim.engine.mujoco_check import compare, omissions
from dynsim.engine.prepare import Prepared, prepare
from dynsim.errors import ModelError
from dynsim.record import Record
from dynsim.scenario import build, load_scenario

mujoco = pytest.importorskip("mujoco", minversion="4.0")

ARM = """
duration_s: {duration}
plant:
  type: serial_arm
  chain:
    - {{axis: y, length_m: 0.3, radius_m: 0.02, mass_kg: 1, motor: {motor}{more}}}
    - {{axis: z, length_m: 0.2, radius_m: 0.02, mass_kg: 0.5, motor: {motor}}}
controller:
  type: joint_pd
  {gains}joints:
    joint_1: {{times_s: [0, 0.2, 0.4], angles_deg: [0, 60, 20]}}
    joint_2: {{times_s: [0, 0.2, 0.4], angles_deg: [0, -40, 90]}}
contacts: {{law: {law}}}
record: {{rate_hz: 500}}
integrator: {{rtol: 1e-9}}
"""
DC = (
    "{type: dc, torque_constant_N_m_per_A: 0.05, resistance_ohm: 2, inductance_H: 1.0e-3, rotor_inertia_kg_m2: 1.0e-5, "
    "gear_ratio: 50"
)
SERVO = "{type: servo, voltage_V: 12, stall_torque_N_m: 8, no_load_speed_rad_per_s: 6, rotor_inertia_kg_m2: 0.01"
MOTORS = {
    "dc": (DC + "}", "k_p_V_per_rad: 100\n  k_d_V_s_per_rad: 2\n  "),
    "dc_planned": (DC + "}", "k_p_V_per_rad: 100\n  k_d_V_s_per_rad: 2\n  feed_forward: dynamics\n  "),
    "dc_velocity": (DC + "}", "k_p_V_per_rad: 0\n  k_d_V_s_per_rad: 20\n  "),
    "dc_limited": (DC + ", voltage_limit_V: 12}", "k_p_V_per_rad: 100\n  k_d_V_s_per_rad: 2\n  "),
    "servo": (SERVO + ", k_p_V_per_rad: 60, k_d_V_s_per_rad: 1}", ""),
    "servo_velocity": (SERVO + ", mode: velocity, k_v_V_s_per_rad: 20}", ""),
    "servo_limited": (SERVO + ", k_p_V_per_rad: 400}", ""),
    "servo_current": (SERVO + ", k_p_V_per_rad: 400, torque_limit_N_m: 5}", ""),
    "servo_velocity_current": (SERVO + ", mode: velocity, k_v_V_s_per_rad: 20, torque_limit_N_m: 5}", ""),
}


def arm(folder: Path, motor: str, law: str = "bilateral", more: str = "", duration: float = 0.4) -> Path:
    drive, gains = MOTORS[motor]
    file = folder / "arm.yaml"
    file.write_text(ARM.format(motor=drive, gains=gains, law=law, more=more, duration=duration))
    return file


def exported(
    file: Path | str, folder: Path, touching: bool = False, **options: object
) -> tuple[Prepared, Record, Path]:
    scenario = load_scenario(file, **options)
    prepared = prepare(scenario)
    control = prepared.control
    joints = [motor.joint for motor in prepared.model.robot.motors]
    gains = dict(zip(joints, zip(control.k_p, control.k_d, strict=True), strict=True))
    path = folder / "arm.xml"
    surfaces = build.surfaces(scenario)
    path.write_text(prepared.model.to_mjcf(prepared.contacts, surfaces, gains=gains, touching=touching))
    return prepared, dynsim.simulate(scenario), path


def worst(prepared: Prepared, record: Record, path: Path) -> list[dict[str, float]]:
    """Largest differences by quantity, with steps of 1 ms and of 0.1 ms."""
    return [{d.quantity: d.value for d in differences} for differences in compare(prepared, record, path).values()]


@pytest.mark.parametrize("motor", MOTORS)
def test_motors_and_loops_converge_to_those_of_dynsim(motor: str, tmp_path: Path) -> None:
    """A tenth of the step leaves a tenth of the difference: MuJoCo's methods have order one, the model is the same."""
    coarse, fine = worst(*exported(arm(tmp_path, motor), tmp_path))
    assert fine["position"] < 5e-4
    assert 5.0 < coarse["position"] / fine["position"] < 20.0
    for quantity in ("velocity", "energy"):
        assert coarse[quantity] > 5.0 * fine[quantity]


@pytest.mark.parametrize("motor", ["dc_limited", "servo_limited", "servo_current"])
def test_limits_of_motors_are_active_in_this_test(motor: str, tmp_path: Path) -> None:
    """Without its limits, the exported arm moves differently."""
    prepared, record, path = exported(arm(tmp_path, motor), tmp_path)
    text = path.read_text()
    free = re.sub(r'forcerange="[^"]*"', "", re.sub(r'(controller="[^"]*) 12.0"', r'\1 0.0"', text))
    free = re.sub(r'saturation="[^"]*"', "", free)
    assert free != text
    path.write_text(free)
    assert worst(prepared, record, path)[1]["position"] > 1e-2


def test_wrong_gain_is_detected(tmp_path: Path) -> None:
    prepared, record, path = exported(arm(tmp_path, "servo"), tmp_path)
    path.write_text(re.sub(r'kp="([\d.]+)"', lambda match: f'kp="{1.01 * float(match[1])}"', path.read_text()))
    assert worst(prepared, record, path)[1]["position"] > 1e-3


def test_divergence_and_missing_mujoco_are_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    prepared, record, path = exported(arm(tmp_path, "servo"), tmp_path)
    text = re.sub(r'forcerange="[^"]*"', "", re.sub(r'kp="[\d.]+"', 'kp="1e14"', path.read_text()))
    path.write_text(text.replace("implicitfast", "Euler"))
    with raises(ModelError, "MuJoCo", "1 ms"):
        compare(prepared, record, path)
    assert capfd.readouterr().err == ""
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with raises(ModelError, "--check", "mujoco>=4.0"):
        compare(prepared, record, path)


def test_joint_stops_and_dry_friction_are_stiff_in_mujoco(tmp_path: Path) -> None:
    more = ", friction_N_m: 0.5, limit_deg: [-10, 30]"
    prepared, record, path = exported(arm(tmp_path, "servo", "unilateral", more), tmp_path)
    assert record["q"][:, 0].max() == pytest.approx(np.radians(30.0), abs=1e-6)
    _, fine = worst(prepared, record, path)
    assert fine["position"] < 5e-3


@pytest.mark.parametrize("axes", ["world", "body"])
def test_loads_act_in_both_programs(axes: str, tmp_path: Path) -> None:
    file = arm(tmp_path, "servo")
    wrench = "point_m: [0.1, 0, 0.2], force_N: [0, 4, 2], torque_N_m: [1, 0, 1]"
    file.write_text(f"{file.read_text()}loads: {{push: {{type: constant, body: link_2, frame: {axes}, {wrench}}}}}\n")
    prepared, record, path = exported(file, tmp_path)
    coarse, fine = worst(prepared, record, path)
    assert fine["position"] < 5e-4
    assert 5.0 < coarse["position"] / fine["position"] < 20.0
    prepared.loads.clear()
    assert worst(prepared, record, path)[1]["position"] > 1e-2


def test_torque_source_follows_its_torque(tmp_path: Path) -> None:
    file = tmp_path / "arm.yaml"
    file.write_text(
        "duration_s: 0.5\nplant: {type: serial_arm, chain: [{axis: y, length_m: 0.5, mass_kg: 1, initial_deg: 90, "
        "motor: {type: torque, limit_N_m: 3}}]}\ncontroller: {type: joint_pd, torques: {joint_1: "
        "{times_s: [0, 0.25, 0.5], torques_N_m: [0, 5, 0]}}}\n"
    )
    prepared, record, path = exported(file, tmp_path)
    assert np.abs(record["torque"]).max() == pytest.approx(3.0)
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_path(str(path)))
    mujoco.mj_resetDataKeyframe(model, data, 0)
    assert data.ctrl.tolist() == [0.0]
    coarse, fine = worst(prepared, record, path)
    assert fine["position"] < 5e-4
    assert 5.0 < coarse["position"] / fine["position"] < 20.0


def test_key_frame_holds_the_start(tmp_path: Path) -> None:
    """The controls of the keyframe are the first references: a robot that holds does not move away."""
    _, _, path = exported("six_axis_arm", tmp_path, overrides={"duration_s": 0.1})
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    start = data.qpos.copy()
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - start).max() < 0.02


def test_contacts_push_and_slide_as_in_dynsim(tmp_path: Path) -> None:
    """Two braced elbows on a real floor; a block that rests on a slope and one that slides down."""
    options = {"overrides": {"duration_s": 0.5}}
    _, fine = worst(*exported("elbow_comparison_floor", tmp_path, True, variant="two_elbows", **options))
    assert fine["position"] < 1e-3
    for variant, bound in (("rests", 1e-5), ("slides", 2e-3)):
        prepared, record, path = exported("block_on_slope", tmp_path, True, variant=variant, **options)
        _, fine = worst(prepared, record, path)
        assert fine["position"] < bound
    # Nothing collides by default: the same block falls through the slope.
    _, fine = worst(*exported("block_on_slope", tmp_path, variant="rests", **options))
    assert fine["position"] > 0.5


def test_capsules_and_spheres_touch_at_their_radius(tmp_path: Path) -> None:
    """A falling link lands on the floor with its capsule, a ball with its sphere, each to within 0.1 mm."""
    file = tmp_path / "fall.yaml"
    file.write_text(
        "duration_s: 1\nplant: {type: serial_arm, base: {position_m: [0, 0, 0.3]}, chain: [{axis: y, length_m: 0.5, "
        "radius_m: 0.03, mass_kg: 1, initial_deg: 100, damping_N_m_s_per_rad: 0.5}]}\n"
        "objects: {ball: {mass_kg: 1, shape: sphere, radius_m: 0.1, position_m: [1, 1, 0.15]}}\n"
        "surfaces: {floor: {type: plane}}\ncontacts: {law: unilateral, friction: 0.5, candidates: links}\n"
    )
    _, record, path = exported(file, tmp_path, True)
    assert record["q"][-1][record.labels["q"].index("ball.z")] == pytest.approx(0.1, abs=1e-6)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.body("ball").xpos[2] == pytest.approx(0.1, abs=1e-4)
    at = model.joint("joint_1").qposadr[0]
    assert data.qpos[at] == pytest.approx(record["q"][-1][record.labels["q"].index("joint_1")], abs=1e-3)


def test_bodies_without_shapes_are_capsules(tmp_path: Path) -> None:
    _, _, path = exported(arm(tmp_path, "servo", duration=0.1), tmp_path)
    model = mujoco.MjModel.from_xml_path(str(path))
    kinds = [model.geom(k).type[0] for k in range(model.ngeom)]
    assert kinds == [mujoco.mjtGeom.mjGEOM_CAPSULE] * 2
    np.testing.assert_allclose(model.geom(0).size[:2], [0.02, 0.15])


URDF = """<robot name="arm"><link name="base"/><link name="rod">
<inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0.1 0.2 0.3" rpy="0 0 1.5707963267948966"/><geometry>
<mesh filename="rod.stl" scale="0.001 0.001 0.002"/></geometry></visual>
<visual><geometry><mesh filename="lost.stl"/></geometry></visual></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>"""


def test_meshes_are_stl_files_with_their_poses(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [300, 0, 0], [0, 200, 0], [0, 0, 100]], dtype=np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    (tmp_path / "rod.stl").write_bytes(bytes(80) + struct.pack("<I", 4) + rows)
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "arm.yaml").write_text("duration_s: 0.1\nplant: {type: urdf_arm, file: arm.urdf}\n")
    out = tmp_path / "out" / "arm.xml"
    done = CliRunner().invoke(app, ["export", str(tmp_path / "arm.yaml"), "--format", "mjcf", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "lost.stl" in done.output
    # The folder can be moved as a whole.
    moved = tmp_path / "moved"
    out.parent.rename(moved)
    model = mujoco.MjModel.from_xml_path(str(moved / "arm.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert (model.ngeom, model.nmesh) == (1, 1)
    actual = model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected = (corners * [0.001, 0.001, 0.002]) @ turn.T + [0.1, 0.2, 0.3]
    for point in expected:
        assert np.linalg.norm(actual - point, axis=1).min() < 1e-6
    assert model.body("rod").mass[0] == 1.0


def test_omissions_are_named(tmp_path: Path) -> None:
    def omitted(file: Path | str, touching: bool = False, **options: object) -> str:
        scenario = load_scenario(file, **options)
        return "\n".join(omissions(scenario, prepare(scenario), touching))

    assert "elbow_4, elbow_7" in omitted("elbow_comparison")
    assert "bilateral" in omitted("elbow_comparison", True)
    assert omitted("elbow_comparison_floor", True) == ""
    assert "pull" in omitted("block_on_slope", True, variant="pulled")
    assert "sample_time_s" in omitted("sampled_arm")
    assert "ground" in omitted("brace_on_shapes", True, variant="terrain")
    assert omitted(arm(tmp_path, "servo_current")) == ""
    tray = {"surfaces": {"tray": {"type": "plane", "on": "turret"}}, "contacts.law": "unilateral"}
    ball = {"ball": {"shape": "sphere", "radius_m": 0.02, "mass_kg": 0.1, "position_m": [0.0, 0.0, 5.0]}}
    assert "tray" in omitted("six_axis_arm", True, overrides=tray | {"objects": ball})


def test_command_checks_and_prints_differences_with_times(tmp_path: Path) -> None:
    file = arm(tmp_path, "dc", duration=0.2)
    out = tmp_path / "arm.xml"
    done = CliRunner().invoke(app, ["export", str(file), "--format", "mjcf", "--check", "--out", str(out)])
    assert done.exit_code == 0, done.output
    values = re.findall(r"position (\S+) rad \((joint_\d), t = ([\d.]+) s\)", done.output)
    assert len(values) == 2
    assert 0.0 < float(values[1][0]) < float(values[0][0]) < 1e-2
    assert len(re.findall(r"(?:velocity|energy) \S+ (?:rad/s|J) \(", done.output)) == 4
    assert mujoco.MjModel.from_xml_path(str(out)).nu == 2


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["single_pendulum", "--format", "urdf", "--check"], ("--check", "mjcf", "urdf")),
        (["record.h5", "--format", "mcap", "--contacts"], ("--contacts", "mjcf", "mcap")),
        (["sampled_arm", "--format", "mjcf", "--check", "--variant", "jogged"], ("--check",)),
    ],
)
def test_check_of_other_exports_is_refused(
    arguments: list[str], names: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["export", *arguments])
    assert done.exit_code != 0
    text = done.output + str(done.exception)
    check_message("\n".join(line for line in text.splitlines() if not line.startswith("warning: ")), *names)


ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| `(\w+)`(?:, (\w+))? \|((?: [\d.e+-]+ \|){4})$", re.MULTILINE)
ROWS = ROW.findall((ROOT / "docs" / "how-to" / "export.md").read_text(encoding="utf-8"))


def test_page_lists_scenarios() -> None:
    assert len(ROWS) >= 10


@pytest.mark.long
@pytest.mark.parametrize(("name", "variant", "numbers"), ROWS)
def test_differences_agree_with_the_page(name: str, variant: str, numbers: str, tmp_path: Path) -> None:
    coarse, fine = worst(*exported(name, tmp_path, True, variant=variant or None))
    actual = [coarse["position"], fine["position"], fine["velocity"], fine["energy"]]
    np.testing.assert_allclose(actual, [float(number) for number in numbers.split("|")[:4]], rtol=0.1)
