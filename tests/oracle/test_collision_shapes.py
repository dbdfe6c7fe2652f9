"""Solids from the collision shapes of URDF files: distances by Pinocchio and coal, exports and their reading back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import coal
import mujoco
import numpy as np
import pinocchio
import pytest
import yaml
from support.messages import raises
from typer.testing import CliRunner

from dynsim import build_model, load_scenario, simulate
from dynsim.cli.commands import app
from dynsim.compile.scene import drawn_surface
from dynsim.compile.solids import solids_of
from dynsim.compile.touching import touch
from dynsim.errors import DynsimError
from dynsim.model.surfaces import Box, Capsule
from dynsim.scenario import build
from dynsim.scenario.reading import Scenario
from dynsim.system.shipped import SHIPPED

ARM = SHIPPED / "robots" / "six_axis_arm.urdf"
COILED = {"shoulder_pitch": 20, "elbow_pitch": 149, "forearm_roll": 30, "wrist_pitch": 110, "tool_roll": 40}
SHAPES = {
    "box": ('<box size="0.1 0.2 0.3"/>', [0.1, 0.2, 0.3]),
    "sphere": ('<sphere radius="0.06"/>', [0.06]),
    "cylinder": ('<cylinder radius="0.05" length="0.3"/>', [0.05, 0.2]),
    "disc": ('<cylinder radius="0.05" length="0.02"/>', [0.05, 0.02]),
    "capsule": ('<capsule radius="0.05" length="0.3"/>', [0.05, 0.3]),
}
MASS = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'


def loaded(folder: Path, plant: dict[str, Any], **more: Any) -> Scenario:
    scenario = {
        "duration_s": 0.1,
        "plant": {"type": "urdf_arm", **plant},
        "contacts": {"law": "unilateral", "between": [{"bodies": "self"}]},
        "integrator": {"method": "time_stepping", "step_s": 1e-3},
    } | more
    (folder / "scene.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return load_scenario(folder / "scene.yaml")


def gaps(scenario: Scenario, q: np.ndarray) -> dict[frozenset[str], float]:
    """Smallest gap of each pair of bodies [m]."""
    model, least = build_model(scenario), dict[frozenset[str], float]()
    for contact in build.contacts(scenario):
        pair = frozenset((contact.body, contact.surface_name))
        least[pair] = min(touch(model, contact, q).gap, least.get(pair, np.inf))
    return least


def inside(cylinder: coal.Cylinder) -> tuple[coal.CollisionGeometry, float]:
    """Core of the solid inside a cylinder, and the radius about it."""
    radius, half = float(cylinder.radius), float(cylinder.halfLength)
    if half >= radius:
        return (coal.Capsule(radius, 2.0 * (half - radius)) if half > radius else coal.Sphere(radius)), 0.0
    edge = np.sqrt(2.0) * (radius - half)
    return coal.Box(edge, edge, 1e-12), half


def test_a_coiled_urdf_arm_has_the_gaps_of_pinocchio(tmp_path):
    scenario = loaded(tmp_path, {"file": str(ARM), "initial_deg": COILED})
    q = build_model(scenario).robot.initial
    peer = pinocchio.buildModelFromUrdf(str(ARM))
    shapes = pinocchio.buildGeomFromUrdf(peer, str(ARM), pinocchio.GeometryType.COLLISION)
    data, geometry = peer.createData(), shapes.createData()
    order = [peer.joints[peer.getJointId(name)].idx_q for name in build_model(scenario).joint_names]
    coordinates = np.zeros(peer.nq)
    coordinates[order] = q
    pinocchio.updateGeometryPlacements(peer, data, shapes, geometry, coordinates)
    request = coal.DistanceRequest()
    request.gjk_tolerance = 1e-12
    names = [str(name) for name in peer.names]
    bodies = {link.joint: link.name for link in build_model(scenario).robot.links} | {names[0]: "base"}
    expected: dict[frozenset[str], float] = {}
    for i in range(len(shapes.geometryObjects)):
        for j in range(len(shapes.geometryObjects)):
            a, b = (shapes.geometryObjects[k] for k in (i, j))
            pair = frozenset(bodies[names[solid.parentJoint]] for solid in (a, b))
            if i < j and len(pair) == 2:
                (first, left), (second, right) = inside(a.geometry), inside(b.geometry)
                at = [coal.Transform3s(geometry.oMg[k].rotation, geometry.oMg[k].translation) for k in (i, j)]
                far = coal.distance(first, at[0], second, at[1], request, coal.DistanceResult()) - left - right
                expected[pair] = min(far, expected.get(pair, np.inf))
    own = gaps(scenario, q)
    assert len(own) == 15  # ten pairs of links, and all links except the first against the base
    assert min(own.values()) < 0.03
    for pair, gap in own.items():
        assert gap == pytest.approx(expected[pair], abs=1e-9), sorted(pair)


def robot_file(folder: Path, arm: str = "", tool: str = "", stand: str = "") -> str:
    """Three links in a row; the tool is fixed to the last one."""
    joints = [("stand", "upper"), ("upper", "lower")]
    text = '<robot name="r"><link name="stand">' + stand + "</link>"
    text += (
        f'<link name="upper">{MASS}{arm}</link><link name="lower">{MASS}</link><link name="tool">{MASS}{tool}</link>'
    )
    for k, (parent, child) in enumerate(joints):
        text += f'<joint name="j{k}" type="continuous"><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>'
        text += f'<parent link="{parent}"/><child link="{child}"/></joint>'
    text += '<joint name="flange" type="fixed"><origin xyz="0.1 0 0.4" rpy="0.3 0.5 0.7"/>'
    text += '<parent link="lower"/><child link="tool"/></joint></robot>'
    (folder / "robot.urdf").write_text(text, encoding="utf-8")
    return str(folder / "robot.urdf")


def collision(solid: str) -> str:
    return f'<collision><origin xyz="0.01 0.02 0.2" rpy="0.2 0.4 0.6"/><geometry>{solid}</geometry></collision>'


@pytest.mark.parametrize("kind", SHAPES)
def test_solids_survive_export_and_reading_back(tmp_path, kind):
    text = collision(SHAPES[kind][0])
    original = build_model(loaded(tmp_path, {"file": robot_file(tmp_path, arm=text, tool=text, stand=text)})).robot
    (tmp_path / "again.urdf").write_text(build_model(load_scenario(tmp_path / "scene.yaml")).to_urdf())
    again = build_model(loaded(tmp_path, {"file": str(tmp_path / "again.urdf")})).robot
    before, after = solids_of(original), solids_of(again)
    assert list(before) == list(after) == ["upper", "lower", "stand"]
    for body in before:
        (solid,), (copy,) = before[body], after[body]
        assert type(solid) is type(copy)
        for key in (
            ("centre", "axes", "edges", "edge_radius") if isinstance(solid, Box) else ("start", "axis", "radius")
        ):
            np.testing.assert_allclose(getattr(solid, key), getattr(copy, key), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("kind", SHAPES)
def test_solids_of_shapes_are_inside_them(tmp_path, kind):
    robot = build_model(
        loaded(tmp_path, {"file": robot_file(tmp_path, arm=collision(SHAPES[kind][0]))}, contacts={"law": "unilateral"})
    )
    (solid,), size = solids_of(robot.robot)["upper"], SHAPES[kind][1]
    if isinstance(solid, Box):
        if kind == "box":
            assert solid.edges.tolist() == size
        else:
            radius, length = size
            assert solid.edges[2] == pytest.approx(length)
            # The corners of the plate touch the rim of the disc.
            core = 0.5 * solid.edges[:2] - solid.edge_radius
            assert np.hypot(*core) + solid.edge_radius == pytest.approx(radius)
    else:
        assert isinstance(solid, Capsule)
        assert [solid.radius, np.linalg.norm(solid.axis)][: len(size)] == pytest.approx(size)
        assert kind != "sphere" or not solid.axis.any()


def test_radius_of_the_scenario_replaces_the_shapes_of_the_file(tmp_path):
    file = robot_file(tmp_path, arm=collision(SHAPES["box"][0]))
    plant = {"file": file, "links": {"upper": {"radius_m": 0.03}}}
    (solid,) = solids_of(build_model(loaded(tmp_path, plant, contacts={"law": "unilateral"})).robot)["upper"]
    assert isinstance(solid, Capsule)
    assert (solid.radius, solid.axis.tolist()) == (0.03, [0.0, 0.0, 0.5])
    # The capsule is exported as the cylinder about it.
    (tmp_path / "again.urdf").write_text(build_model(load_scenario(tmp_path / "scene.yaml")).to_urdf())
    (again,) = solids_of(
        build_model(loaded(tmp_path, {"file": str(tmp_path / "again.urdf")}, contacts={"law": "unilateral"})).robot
    )["upper"]
    np.testing.assert_allclose([*again.start, *again.axis, again.radius], [0, 0, 0, 0, 0, 0.5, 0.03], atol=1e-15)


def test_radius_of_a_link_that_is_fixed_to_another_is_refused(tmp_path):
    plant = {"file": robot_file(tmp_path), "links": {"tool": {"radius_m": 0.03}}}
    with raises(DynsimError, "plant.links.tool.radius_m", "fixed to 'lower'", "plant.links.lower.radius_m"):
        build_model(loaded(tmp_path, plant))


def test_collision_meshes_are_left_out_with_a_notice(tmp_path, caplog):
    mesh = collision('<mesh filename="hull.stl"/>')
    ball = {"ball": {"shape": "sphere", "mass_kg": 1, "radius_m": 0.1, "position_m": [0, 0, 3]}}
    contacts = {"law": "unilateral", "between": [{"bodies": ["links", "ball"]}]}
    plant = {"file": robot_file(tmp_path, arm=mesh + collision('<box size="0.1 0.1 0.1"/>'))}
    assert len(build.contacts(loaded(tmp_path, plant, objects=ball, contacts=contacts)))
    assert "robot.urdf:1: <collision> of link 'upper' is the mesh hull.stl" in caplog.text
    plant, contacts["between"] = {"file": robot_file(tmp_path, arm=mesh)}, [{"bodies": ["upper", "ball"]}]
    with raises(DynsimError, "between", "'upper' has no solid", "is the mesh hull.stl", "radius_m"):
        build.contacts(loaded(tmp_path, plant, objects=ball, contacts=contacts))
    exported = CliRunner().invoke(
        app, ["export", str(tmp_path / "scene.yaml"), "--format", "urdf", "--out", str(tmp_path / "x")]
    )
    assert exported.exit_code == 0
    assert "mesh hull.stl" in exported.stderr
    assert "not exported" in exported.stderr
    # Shapes without a valid size are reported in the same words.
    plant = {"file": robot_file(tmp_path, arm=collision('<box size="0.1 -1 0.1"/>'))}
    with raises(DynsimError, "'upper' has no solid", "has no valid geometry"):
        build.contacts(loaded(tmp_path, plant, objects=ball, contacts=contacts))


def test_the_arm_of_a_file_comes_to_rest_on_itself(tmp_path):
    """Without motors the wrist falls on the upper arm; without the pair it passes through."""
    deepest = {}
    for between in ([{"bodies": "self"}], []):
        contacts = {"law": "unilateral", "between": between}
        plant = {"file": str(ARM), "initial_deg": {"elbow_pitch": 120, "wrist_pitch": 60}, "damping_N_m_s_per_rad": 2.0}
        plant["joints"] = {"elbow_pitch": {"limit_deg": [-180, 180]}}
        record = simulate(loaded(tmp_path, plant, contacts=contacts, duration_s=0.5))
        scenario = loaded(tmp_path, plant)
        deepest[bool(between)] = min(min(gaps(scenario, q).values()) for q in record["q"][::10])
    assert deepest[True] > -1e-3
    assert deepest[False] < -0.1


def in_mujoco(folder: Path, *options: str) -> tuple[Any, Any]:
    """The scenario of a folder in MuJoCo, in its initial posture."""
    target = folder / "scene.mjcf.xml"
    arguments = ["export", str(folder / "scene.yaml"), "--format", "mjcf", "--out", str(target), *options]
    assert CliRunner().invoke(app, arguments, catch_exceptions=False).exit_code == 0
    peer = mujoco.MjModel.from_xml_path(str(target))
    data = mujoco.MjData(peer)
    mujoco.mj_resetDataKeyframe(peer, data, 0)
    return peer, data


def touching_pairs(peer: Any, data: Any) -> dict[frozenset[str], float]:
    """Smallest distance of each pair of bodies that touch [m]; boxes are smaller by the margin."""
    least = dict[frozenset[str], float]()
    for contact in data.contact[: data.ncon]:
        bodies = frozenset(peer.body(peer.geom_bodyid[geom]).name for geom in contact.geom)
        margin = next(
            peer.pair_margin[k]
            for k in range(peer.npair)
            if {peer.pair_geom1[k], peer.pair_geom2[k]} == set(contact.geom)
        )
        least[bodies] = min(contact.dist - margin, least.get(bodies, np.inf))
    return least


def test_mujoco_finds_the_contacts_of_links_that_touch(tmp_path):
    contacts = {"law": "unilateral", "friction": 0.4, "between": [{"bodies": "self"}]}
    scenario = loaded(tmp_path, {"file": str(ARM), "initial_deg": COILED}, contacts=contacts)
    peer, data = in_mujoco(tmp_path, "--contacts")
    model = build_model(scenario)
    order = [peer.joint(joint).qposadr[0] for joint in model.joint_names]
    assert peer.npair == 20  # the flange has two shapes
    assert np.all(peer.pair_friction[:, :2] == 0.4)
    touched = 0
    for elbow in np.deg2rad([140.0, 149.0, 155.0, 160.0]):
        q = model.robot.initial.copy()
        q[model.joint_names.index("elbow_pitch")] = elbow
        data.qpos[order] = q
        mujoco.mj_forward(peer, data)
        expected = {pair: gap for pair, gap in gaps(scenario, q).items() if gap < 0.0}
        actual = touching_pairs(peer, data)
        touched += len(expected)
        assert actual.keys() == expected.keys()
        for pair, gap in expected.items():
            assert actual[pair] == pytest.approx(gap, abs=1e-6)
    assert touched >= 3


def test_objects_rest_on_each_other_in_mujoco_as_in_dynsim(tmp_path):
    objects = {
        "below": {"mass_kg": 2, "size_m": [0.3, 0.3, 0.1], "position_m": [1, 0, 0.05]},
        "box": {"mass_kg": 1, "size_m": [0.2, 0.2, 0.1], "position_m": [1, 0, 0.15]},
        "ball": {"mass_kg": 0.5, "shape": "sphere", "radius_m": 0.05, "position_m": [1, 0, 0.2499995]},
    }
    contacts = {"law": "unilateral", "friction": 0.4, "between": [{"bodies": ["objects", "objects"]}]}
    more = {"objects": objects, "contacts": contacts, "surfaces": {"floor": {"type": "plane"}}}
    loaded(tmp_path, {"file": robot_file(tmp_path)}, **more)
    peer, data = in_mujoco(tmp_path, "--contacts")
    mujoco.mj_forward(peer, data)
    # Four corners of the box and one point of the ball on bodies, four corners on the floor.
    assert data.ncon == 9
    for _ in range(200):
        mujoco.mj_step(peer, data)
    heights = {name: float(data.body(name).xpos[2]) for name in objects}
    assert heights == pytest.approx({"below": 0.05, "box": 0.15, "ball": 0.25}, abs=1e-4)
    peer, data = in_mujoco(tmp_path)
    mujoco.mj_forward(peer, data)
    assert (peer.npair, data.ncon) == (0, 0)


SURFACES: dict[str, dict[str, Any]] = {
    "plane": {"type": "plane", "point_m": [0.1, 0.2, 0.3], "normal": [1, 2, 3]},
    "sphere": {"type": "sphere", "center_m": [0.1, 0.2, 0.3], "radius_m": 0.2},
    "cylinder": {"type": "cylinder", "point_m": [0.1, 0.2, 0.3], "axis": [1, 2, 3], "radius_m": 0.2},
    "box": {"type": "box", "center_m": [0.1, 0.2, 0.3], "edges_m": [0.1, 0.2, 0.3], "rpy_deg": [10, 20, 30]},
}


@pytest.mark.parametrize("kind", SURFACES)
def test_a_surface_on_a_fixed_link_is_on_the_body_that_carries_it(tmp_path, kind):
    """The link ``tool`` is fixed to ``lower``, and the root link ``stand`` to the world."""
    surfaces = {name or "free": SURFACES[kind] | ({"on": name} if name else {}) for name in ("", "tool", "stand")}
    scenario = loaded(tmp_path, {"file": robot_file(tmp_path)}, surfaces=surfaces, contacts={"law": "unilateral"})
    known, (tool,) = build.surfaces(scenario), [f for f in build_model(scenario).robot.frames if f.name == "tool"]
    assert [known[name].carrier for name in surfaces] == [None, "lower", None]
    points = np.random.default_rng(0).normal(size=(50, 3))
    gaps, normals = known["free"].gaps(points), known["free"].normals(points)
    np.testing.assert_allclose(known["stand"].gaps(points), gaps, rtol=0.0, atol=1e-15)
    moved = tool.p + points @ tool.R.T
    np.testing.assert_allclose(known["tool"].gaps(moved), gaps, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(known["tool"].normals(moved), normals @ tool.R.T, rtol=0.0, atol=1e-9)
    assert drawn_surface("tool", known["tool"]).kind == kind


def test_a_ball_rests_on_a_tray_that_is_fixed_to_a_link(tmp_path):
    """A joint turns the tool so that the tray is level; the record draws the tray on the body of the tool."""
    file = Path(robot_file(tmp_path))
    file.write_text(file.read_text(encoding="utf-8").replace('rpy="0.3 0.5 0.7"', 'rpy="0 0.5 0"'), encoding="utf-8")
    plant = {"file": str(file), "motor": {"type": "wang_minami"}, "initial_deg": {"j1": float(np.rad2deg(-0.5))}}
    ball = {"shape": "sphere", "radius_m": 0.05, "mass_kg": 0.1}
    tray = {"type": "box", "center_m": [0.1, 0, 0.1], "edges_m": [0.2, 0.2, 0.02], "on": "tool"}
    more = {"surfaces": {"tray": tray}, "contacts": {"law": "unilateral"}, "controller": {"type": "joint_pd"}}
    model = build_model(loaded(tmp_path, plant, **more))
    at = model.point_position("tool", [0.1, 0.0, 0.16], model.robot.initial).tolist()
    record = simulate(loaded(tmp_path, plant, objects={"ball": ball | {"position_m": at}}, **more))
    assert record["contact_normal_force"][-1] == pytest.approx([0.1 * 9.81], rel=0.05)
    assert record.scene is not None
    assert [body.name for body in record.scene.bodies if any(shape.kind == "box" for shape in body.shapes)] == ["lower"]


def test_a_height_field_cannot_be_turned_with_a_link(tmp_path):
    np.savetxt(tmp_path / "hill.csv", np.zeros((4, 4)), delimiter=",")
    field = {"type": "height_field", "file": "hill.csv", "spacing_m": [0.1, 0.1], "on": "tool"}
    with raises(DynsimError, "surfaces.hill.on", "height field", "turned"):
        build.surfaces(loaded(tmp_path, {"file": robot_file(tmp_path)}, surfaces={"hill": field}))


def test_a_surface_on_a_link_collides_in_mujoco(tmp_path):
    ball = {"ball": {"shape": "sphere", "mass_kg": 1, "radius_m": 0.1, "position_m": [0.6, 0, 0.7]}}
    tray = {"tray": {"type": "box", "center_m": [0.6, 0, 0.05], "edges_m": [0.4, 0.4, 0.1], "on": "upper"}}
    more = {"objects": ball, "surfaces": tray, "contacts": {"law": "unilateral"}}
    loaded(tmp_path, {"file": robot_file(tmp_path)}, **more)
    peer, data = in_mujoco(tmp_path, "--contacts")
    mujoco.mj_forward(peer, data)
    (contact,) = data.contact[: data.ncon]
    assert contact.dist - peer.pair_margin[0] == pytest.approx(0.0, abs=1e-9)
    assert {peer.body(peer.geom_bodyid[geom]).name for geom in contact.geom} == {"upper", "ball"}
