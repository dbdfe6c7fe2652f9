"""Robot files as their makers ship them: starts within limits, corrections from the scenario, extras, meshes."""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from support.messages import check_message, lines_with, mentions, raises, warns

from dynsim.compile.model import Model
from dynsim.draw.geometry.meshes import mesh_notes
from dynsim.engine import check, simulate
from dynsim.errors import DynsimError, ModelError, RecordError, ScenarioError
from dynsim.model.description import Inertia
from dynsim.model.urdf.reader import read_urdf, solid_inertia
from dynsim.record.meshes import mesh_path, read_mesh
from dynsim.record.scene import Shape
from dynsim.scenario import build_model, load_scenario

BODY = '<inertial><origin xyz="0 0 -0.1"/><mass value="1"/>{}</inertial>'
MOMENTS = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/>'
SHAPE = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/>{}</joint>'
# Knees and a pair of fingers, whose limits exclude zero.
KNEES = f"""<robot name="knees"><link name="base"/>
<link name="thigh">{BODY.format(MOMENTS)}{SHAPE}</link>
<link name="left">{BODY.format(MOMENTS)}</link><link name="right">{BODY.format(MOMENTS)}</link>
{JOINT.format("knee", "revolute", "base", "thigh", '<limit lower="-2.6" upper="-0.9" effort="20" velocity="10"/>')}
{JOINT.format("finger", "prismatic", "thigh", "left", '<limit lower="0.015" upper="0.037" effort="5" velocity="1"/>')}
{
    JOINT.format(
        "other",
        "prismatic",
        "thigh",
        "right",
        '<limit lower="-0.04" upper="-0.02" effort="5" velocity="1"/><mimic joint="finger" multiplier="-1"/>',
    )
}
</robot>"""


@pytest.fixture
def case(tmp_path: Path) -> Path:
    (tmp_path / "robot.urdf").write_text(KNEES)
    (tmp_path / "case.yaml").write_text("duration_s: 0.02\nplant: {type: urdf_arm, file: robot.urdf}\n")
    return tmp_path / "case.yaml"


def edited(case: Path, *changes: tuple[str, str]) -> Path:
    text = KNEES
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (case.parent / "robot.urdf").write_text(text)
    return case


def model(case: Path, overrides: dict[str, Any] | None = None) -> Model:
    return build_model(load_scenario(case, overrides=overrides or {}))


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
def test_joints_start_at_the_legal_position_nearest_to_zero(case: Path, law: str, caplog: pytest.LogCaptureFixture):
    """The leader moves so that its follower is within its limits too."""
    scenario = load_scenario(case, overrides={"contacts.law": law})
    start = check(scenario)
    assert start.nearest == {"knee": (pytest.approx(np.rad2deg(-0.9)), "deg"), "finger": (0.02, "m")}
    with caplog.at_level(logging.INFO, "dynsim"):
        record = simulate(scenario)
    assert record["q"][0].tolist() == [-0.9, 0.02, -0.02]
    (line,) = [message for message in caplog.messages if "within their limits" in message]
    assert mentions(line, "knee", "-51.5662 deg", "finger", "0.02 m")


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
def test_illegal_start_positions_are_listed_at_once(case: Path, law: str):
    start = {"plant.initial_deg": {"knee": 10}, "plant.initial_m": {"finger": 0.0}, "contacts.law": law}
    with raises(ModelError, "knee", "10°", "-51.566°", "finger", "0 m", "0.015 m"):
        check(load_scenario(case, overrides=start))


def test_a_serial_arm_starts_within_its_limits(tmp_path: Path):
    (tmp_path / "arm.yaml").write_text(
        "duration_s: 0.1\nplant: {type: serial_arm, chain: [{limit_deg: [20, 90]}, {kind: prismatic, "
        "limit_m: [-0.3, -0.1], initial_m: -0.2}, {limit_deg: [-90, -30]}]}\n"
    )
    start = check(load_scenario(tmp_path / "arm.yaml"))
    assert start.nearest == {"joint_1": (pytest.approx(20), "deg"), "joint_3": (pytest.approx(-30), "deg")}
    q = build_model(load_scenario(tmp_path / "arm.yaml", overrides={"plant.chain.0.initial_deg": 25})).robot.initial
    assert q == pytest.approx([np.deg2rad(25), -0.2, np.deg2rad(-30)])


def test_corrections_of_links_and_joints_replace_the_file(case: Path):
    overrides = {
        "plant.links": {"left": {"mass_kg": 2, "com_m": [0, 0.1, 0], "inertia_kg_m2": [2, 0.1, 0.2, 3, 0.3, 4]}},
        "plant.joints": {
            "knee": {"limit_deg": [-30, 30], "damping": 0.7, "friction": 0.2, "motor": {"type": "wang_minami"}},
            "finger": {"limit_m": [-1, 1], "damping": 3},
        },
        "plant.damping_N_s_per_m": 5,
        "contacts.law": "unilateral",
    }
    robot = model(case, overrides).robot
    thigh, left, right = robot.links
    assert (left.inertia.mass, left.inertia.com.tolist()) == (2.0, [0.0, 0.1, 0.0])
    assert left.inertia.tensor.tolist() == [[2, 0.1, 0.2], [0.1, 3, 0.3], [0.2, 0.3, 4]]
    assert (thigh.upper, thigh.damping, thigh.friction, thigh.velocity_limit) == (np.deg2rad(30), 0.7, 0.2, 10.0)
    assert (left.lower, left.damping, right.damping) == (-1.0, 3.0, 5.0)
    assert [motor.joint for motor in robot.motors] == ["knee"]
    assert right.inertia.mass == 1.0


@pytest.mark.parametrize(
    ("key", "value", "names"),
    [
        ("links.lift", {"mass_kg": 1}, ["plant.links.lift", "'left'"]),
        ("links.left", {"mass_kg": 1, "density_kg_m3": 1}, ["plant.links.left.density_kg_m3", "mass_kg"]),
        ("joints.kne", {"damping": 1}, ["plant.joints.kne", "'knee'"]),
        ("joints.knee", {"limit_m": [0, 1]}, ["plant.joints.knee.limit_m", "plant.joints.knee.limit_deg"]),
        ("joints.knee", {"limit_deg": [1, 0]}, ["plant.joints.knee.limit_deg", "below"]),
        ("base", "free", ["plant.base", "'floating'"]),
        ("inertia", "close", ["plant.inertia", "'nearest'"]),
    ],
)
def test_wrong_corrections_are_refused(case: Path, key: str, value: Any, names: list[str]):
    with raises(ScenarioError, *names):
        load_scenario(case, overrides={f"plant.{key}": value})


def test_corrections_can_be_swept(case: Path):
    for key, value in (("links.left.mass_kg", 3.0), ("joints.knee.damping", 0.4), ("inertia", "nearest")):
        masses = model(case, {f"plant.{key}": value}).robot.links
        assert masses[1].inertia.mass == (3.0 if key.startswith("links") else 1.0)
        assert masses[0].damping == (0.4 if key.startswith("joints") else 0.0)


def test_two_motors_of_a_joint_conflict(case: Path):
    motor = {"type": "wang_minami"}
    with raises(ScenarioError, "plant.joints.knee.motor", "plant.motors.knee"):
        load_scenario(case, overrides={"plant.motors.knee": motor, "plant.joints.knee.motor": motor})


FAULTS = (
    (MOMENTS, ""),
    ('lower="-2.6" upper="-0.9"', 'lower="1" upper="-1"'),
    ('<mass value="1"/>', '<mass value="1,5 "/>'),
    ('<axis xyz="0 1 0"/>', '<axis xyz="0, 1, 0"/>'),
    ('izz="0.001"', 'izz="0.9"'),
)


def test_all_problems_are_in_one_message_and_its_corrections_are_enough(case: Path):
    edited(case, *FAULTS)
    with pytest.raises(ModelError) as refused:
        model(case)
    lines = str(refused.value).splitlines()
    expected = [
        (2, "'thigh'", "<mass value='1,5 '>"),
        (2, "'thigh'", "plant.links.thigh.inertia_kg_m2"),
        (4, "'knee'", "plant.joints.knee.limit_deg"),
        (4, "'knee'", '"0 1 0"'),
        (3, "'left'", "plant.inertia: nearest", "plant.links.left.inertia_kg_m2"),
    ]
    assert len(lines) == len(expected)
    for line, (number, *names) in zip(lines, expected, strict=True):
        check_message(line, f"robot.urdf:{number}", *names)
    text = (case.parent / "robot.urdf").read_text()
    (case.parent / "robot.urdf").write_text(text.replace('"0, 1, 0"', '"0 1 0"'))
    plant = {
        "plant.links.thigh": {"density_kg_m3": 1000},
        "plant.joints.knee.limit_deg": [-90, 90],
        "plant.inertia": "nearest",
    }
    robot = model(case, plant).robot
    for warnings in (
        check(load_scenario(case, overrides=plant)).warnings,
        simulate(load_scenario(case, overrides=plant)).summary["warnings"],
    ):
        check_message(lines_with(warnings, "'left'")[0], "robot.urdf:3", "%")
    assert robot.links[0].inertia.mass == pytest.approx(6.0)
    assert robot.links[0].inertia.tensor.diagonal() == pytest.approx(0.5 * np.array([0.13, 0.10, 0.05]))


def test_nearest_inertia_is_possible_and_no_other_is_nearer():
    rng = np.random.default_rng(3)
    for _ in range(50):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        moments = rng.normal(size=3)
        stated = Inertia(1.0, np.zeros(3), axes @ np.diag(moments) @ axes.T)
        near = stated.nearest()
        near.check("body")
        change = np.linalg.norm(near.tensor - stated.tensor)
        for _ in range(40):
            # Any possible inertia: second moments that are not negative.
            half = rng.normal(size=(3, 3)) * rng.choice([0.1, 1.0])
            second = half @ half.T
            other = np.trace(second) * np.eye(3) - second
            for share in (1.0, 0.1, 0.01):
                mixed = (1.0 - share) * near.tensor + share * other
                assert np.linalg.norm(mixed - stated.tensor) >= change - 1e-12
    possible = Inertia(1.0, np.zeros(3), np.diag([2.0, 3.0, 4.0]))
    np.testing.assert_allclose(possible.nearest().tensor, possible.tensor, atol=1e-14)


@pytest.mark.parametrize(
    "change",
    [
        ('iyy="0.01"', 'iyy="0.01" iyx="0.0" izx="-0"'),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0" rpy="0 0 0"/>'),
        ('<robot name="knees">', '\n<!-- exported --><?xml version="1.0" encoding="UTF-8"?>\n<robot name="knees">'),
        ("</robot>", '<link name="base"/></robot>'),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><axis xyz="0 1 0"/>'),
    ],
)
def test_harmless_extras_are_warnings(case: Path, change: tuple[str, str]):
    plain = model(case).robot
    edited(case, change)
    with warns(UserWarning, "robot.urdf", "harmless extras"):
        read = read_urdf(case.parent / "robot.urdf")
    for ours, other in zip(read.links, plain.links, strict=True):
        assert np.array_equal(ours.inertia.tensor, other.inertia.tensor)
        assert np.array_equal(ours.axis, other.axis)


def test_extras_that_contradict_are_refused(case: Path):
    edited(case, ('iyy="0.01"', 'iyy="0.01" iyx="0.002"'))
    with raises(ModelError, "'thigh'", "iyx", "ixy"):
        model(case)


def test_a_floating_base_falls_and_can_be_placed(case: Path):
    overrides = {
        "plant.base": "floating",
        "plant.links.base": {"mass_kg": 2, "inertia_kg_m2": [0.1, 0, 0, 0.1, 0, 0.1]},
    }
    pose = {"plant.initial_pose": {"root": {"position_m": [0, 0, 3], "rpy_deg": [0, 0, 90]}}}
    record = simulate(load_scenario(case, overrides={**overrides, **pose}))
    assert record.labels["q"][:7] == tuple(f"root.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
    assert record["q"][0, 2] == 3.0
    robot = build_model(load_scenario(case, overrides=overrides)).robot
    assert robot.bodies[0] == "base"
    assert sum(link.inertia.mass for link in robot.links) == pytest.approx(5.0)
    (case.parent / "again.urdf").write_text(Model(robot).to_urdf())
    again = read_urdf(case.parent / "again.urdf")
    assert again.position_names == robot.position_names
    assert [link.inertia.mass for link in again.links] == [link.inertia.mass for link in robot.links]
    height = record["q"][:, 2]
    assert height[-1] == pytest.approx(3.0 - 0.5 * 9.81 * 0.02**2, abs=1e-12)


def test_a_file_without_joints_names_the_floating_base(case: Path):
    (case.parent / "robot.urdf").write_text(f'<robot name="box"><link name="box">{BODY.format(MOMENTS)}</link></robot>')
    with raises(ModelError, "robot.urdf", "plant.base: floating"):
        model(case)
    assert model(case, {"plant.base": "floating"}).n == 6


def test_two_floating_bases_conflict(case: Path):
    edited(
        case,
        ('type="revolute"', 'type="floating"'),
        ('<limit lower="-2.6" upper="-0.9" effort="20" velocity="10"/>', ""),
    )
    with raises(ModelError, "plant.base: floating", "'root'"):
        model(case, {"plant.base": "floating"})


def test_point_mass_on_axes_that_meet_is_named(case: Path):
    """The head of a public humanoid: its axes meet up to the digits of the file."""
    wrists = '<link name="head"><inertial><origin xyz="0.02 -0.11 0"/><mass value="1"/>'
    wrists += f"{MOMENTS.replace('0.01', '0').replace('0.001', '0')}</inertial></link>"
    joints = JOINT.format("pitch", "continuous", "left", "yoke", "")
    joints += JOINT.format("yaw", "continuous", "yoke", "head", "").replace("0 1 0", "1 0 0.000001")
    edited(case, ("</robot>", f'{wrists}<link name="yoke"/>{joints}</robot>'))
    with raises(ModelError, "pitch", "head", "inertia_kg_m2"):
        check(load_scenario(case))


def test_nearest_moments_of_a_rounded_and_of_a_misprinted_body():
    """Rounding by an exporter changes little; a lost decimal point changes much."""
    for moments, near, share in (
        ([0.00305, 0.0236, 0.0269], [0.0031333, 0.0236833, 0.0268167], 0.004),
        ([0.0026, 0.0023, 1.67], [0.5576333, 0.5573333, 1.1149667], 0.58),
    ):
        stated = Inertia(1.0, np.zeros(3), np.diag(moments))
        assert np.diag(stated.nearest().tensor) == pytest.approx(near, rel=1e-4)
        assert np.linalg.norm(np.subtract(near, moments)) / np.linalg.norm(moments) == pytest.approx(share, rel=0.02)


KNUCKLES = f"""<robot name="knuckles"><link name="base"/>
{
    JOINT.format(
        "left", "continuous", "base", "l", '<origin xyz="0 0 0.1" rpy="0 0.4 0"/><mimic joint="right" multiplier="-1"/>'
    )
}
<link name="l">{BODY.format(MOMENTS)}</link><link name="r">{BODY.format(MOMENTS)}</link>
{JOINT.format("right", "continuous", "base", "r", "")}
<link name="t">{BODY.format(MOMENTS)}</link>
{
    JOINT.format(
        "tip",
        "revolute",
        "r",
        "t",
        '<limit lower="-3" upper="3" effort="5" velocity="5"/>'
        '<origin xyz="0 0 0.1" rpy="0.2 0 0.3"/><mimic joint="right" multiplier="-1.5" offset="0.3"/>',
    ).replace("0 1 0", "0.2 -0.9 0.1")
}
</robot>"""


def test_followers_with_negative_multipliers_accelerate_as_in_pinocchio(case: Path):
    """The first acceleration is −Gᵀh/GᵀMG with Pinocchio's M and h of the tree without couplings."""
    (case.parent / "robot.urdf").write_text(KNUCKLES)
    record = simulate(load_scenario(case, overrides={"plant.initial_deg": {"right": 23}}))
    ratio = {"left": -1.0, "right": 1.0, "tip": -1.5}
    start = np.deg2rad(23) * np.array(list(ratio.values())) + [0.0, 0.0, 0.3]
    theirs = pinocchio.buildModelFromUrdf(str(case.parent / "robot.urdf"))
    rows = [theirs.joints[theirs.getJointId(name)].idx_v for name in ratio]
    turn, G = np.zeros(3), np.zeros(3)
    turn[rows], G[rows] = start, list(ratio.values())
    q, data = pinocchio.integrate(theirs, pinocchio.neutral(theirs), turn), theirs.createData()
    M = pinocchio.crba(theirs, data, q)
    h = pinocchio.nle(theirs, data, q, np.zeros(3))
    expected = -(G @ h) / (G @ (np.triu(M) + np.triu(M, 1).T) @ G)
    labels = list(record.labels["vdot"])
    assert {name: record["q"][0, labels.index(name)] for name in ratio} == pytest.approx(
        dict(zip(ratio, start, strict=True))
    )
    assert record["vdot"][0, labels.index("right")] == pytest.approx(expected, rel=1e-9)


# Meshes: a cube of 1 m, as binary STL.
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32)
FACES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
FACES += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]


def stl(header: bytes = b"", faces: int = 12, stated: int = 0, after: bytes = b"") -> bytes:
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[list(face)].ravel(), 0) for face in FACES[:faces])
    return header.ljust(80, b" ") + struct.pack("<I", stated or faces) + body + after


@pytest.mark.parametrize(
    "content", [stl(), stl(b"solid of a CAD program"), stl(after=b"\0made by a tool"), stl(after=b"\n")]
)
def test_length_of_an_stl_file_is_its_triangle_count(tmp_path: Path, content: bytes):
    (tmp_path / "cube.stl").write_bytes(content)
    assert len(read_mesh(tmp_path / "cube.stl").triangles) == 12


def test_a_short_stl_file_states_the_missing_triangles(tmp_path: Path):
    (tmp_path / "cube.stl").write_bytes(stl(faces=7, stated=12))
    with raises(RecordError, "cube.stl", "7 of 12"):
        read_mesh(tmp_path / "cube.stl")


def test_a_glb_file_is_named_as_glb(tmp_path: Path):
    (tmp_path / "cube.glb").write_bytes(b"glTF")
    with raises(RecordError, "cube.glb", "GLB", ".stl"):
        read_mesh(tmp_path / "cube.glb")


def test_mesh_search_uses_package_names_and_path_ends(tmp_path: Path):
    folder = tmp_path / "checkout" / "urdf"
    for path in ("checkout/meshes/cube.stl", "checkout/meshes/visual/cube.stl", "checkout/urdf/own.stl"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(stl())
    (tmp_path / "checkout" / "package.xml").write_text("<package><name>arm_description</name></package>")
    folder.mkdir(exist_ok=True)
    for file, path in (
        ("package://arm_description/meshes/cube.stl", "meshes/cube.stl"),
        ("package://renamed/meshes/visual/cube.stl", "meshes/visual/cube.stl"),
        ("model://renamed/meshes/cube.stl", "meshes/cube.stl"),
        ("/home/somebody/work/meshes/visual/cube.stl", "meshes/visual/cube.stl"),
        ("file:///home/somebody/own.stl", "urdf/own.stl"),
        ("own.stl", "urdf/own.stl"),
        ("package://arm_description/other/OWN.STL", "urdf/own.stl"),
    ):
        assert mesh_path(file, [folder]) == tmp_path / "checkout" / path, file
    assert mesh_path("package://arm_description/meshes/other.stl", [folder]) is None
    # Two files match equally well: the nearer one is used, and none if both are equally near.
    assert mesh_path("other/cube.stl", [folder]) is None
    assert (
        mesh_path("other/cube.stl", [folder.parent / "meshes" / "visual"]) == folder.parent / "meshes/visual/cube.stl"
    )


def test_check_names_meshes_that_are_missing_or_cannot_be_read(case: Path):
    shapes = "".join(
        f'<visual><geometry><mesh filename="package://x/{file}"/></geometry></visual>' for file in ("no.stl", "a.glb")
    )
    (case.parent / "a.glb").write_bytes(b"glTF")
    edited(case, (SHAPE, shapes))
    missing, unreadable = mesh_notes([check(load_scenario(case)).scene])
    assert mentions(missing, "no.stl")
    assert mentions(unreadable, "a.glb", "GLB")


@pytest.mark.parametrize(
    ("shape", "volume", "moments"),
    [
        (Shape("box", (0.1, 0.2, 0.3)), 0.006, (0.13 / 12, 0.10 / 12, 0.05 / 12)),
        (Shape("sphere", (0.1,)), 4e-3 / 3 * np.pi, (4e-3,) * 3),
        (Shape("cylinder", (0.1, 0.6)), 6e-3 * np.pi, (0.0325, 0.0325, 0.005)),
        (Shape("mesh", (0.1, 0.2, -0.3), file="cube.stl"), 0.006, (0.13 / 12, 0.10 / 12, 0.05 / 12)),
    ],
)
def test_density_gives_mass_and_moments_of_shapes(tmp_path: Path, shape: Shape, volume: float, moments: Any):
    (tmp_path / "cube.stl").write_bytes(stl())
    inertia = solid_inertia([shape], 500.0, tmp_path, "plant.links.a")
    assert inertia.mass == pytest.approx(500.0 * volume)
    np.testing.assert_allclose(inertia.tensor, np.diag(500.0 * volume * np.array(moments)), atol=1e-6)
    assert inertia.com == pytest.approx([0.05, 0.1, -0.15] if shape.kind == "mesh" else [0, 0, 0])


def test_density_of_a_capsule_agrees_with_its_parts(tmp_path: Path):
    """A capsule without length is a sphere; a turned one has turned moments."""
    ball = solid_inertia([Shape("capsule", (0.1, 0.0))], 1000.0, tmp_path, "a")
    sphere = solid_inertia([Shape("sphere", (0.1,))], 1000.0, tmp_path, "a")
    assert ball.mass == pytest.approx(sphere.mass)
    np.testing.assert_allclose(ball.tensor, sphere.tensor, rtol=1e-12, atol=1e-15)
    half = np.sqrt(0.5)
    turned = Shape("capsule", (0.1, 0.4), (1.0, 2.0, 3.0), (half, half, 0.0, 0.0))  # about x: its axis is along y
    upright = solid_inertia([Shape("capsule", (0.1, 0.4))], 1000.0, tmp_path, "a").tensor
    inertia = solid_inertia([turned], 1000.0, tmp_path, "a")
    np.testing.assert_allclose(inertia.tensor, upright[[0, 2, 1]][:, [0, 2, 1]], atol=1e-12)
    assert inertia.com == pytest.approx([1, 2, 3])


def test_density_of_an_open_mesh_is_refused(tmp_path: Path, case: Path):
    (case.parent / "open.stl").write_bytes(stl(faces=11))
    edited(case, (SHAPE, '<visual><geometry><mesh filename="open.stl"/></geometry></visual>'))
    with raises(DynsimError, "plant.links.thigh.density_kg_m3", "open.stl", "not closed"):
        model(case, {"plant.links.thigh": {"density_kg_m3": 1000}})
    with raises(DynsimError, "plant.links.left.density_kg_m3", "no shapes"):
        model(case, {"plant.links.left": {"density_kg_m3": 1000}})


def test_text_after_the_robot_is_listed_with_the_other_problems(case: Path):
    (case.parent / "robot.urdf").write_text(edited(case, FAULTS[0]).with_name("robot.urdf").read_text() + "\0")
    with pytest.raises(ModelError) as refused:
        model(case)
    assert len(str(refused.value).splitlines()) == 2
    assert lines_with(str(refused.value).splitlines(), "</robot>")
