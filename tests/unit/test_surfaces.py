"""Boxes and height fields in scenarios, joints and links as candidates, and errors of all these."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from support.messages import mentions, raises

import dynsim
from dynsim.compile.clearance import sinking
from dynsim.compile.protocols import BuildContext
from dynsim.compile.scene import GRID_LINES, robot_scene
from dynsim.compile.shapes import compile_shapes
from dynsim.draw.figures import posture
from dynsim.errors import ModelError, ScenarioError
from dynsim.library.surfaces import box, height_field
from dynsim.model.description import Quadric, vector
from dynsim.model.surfaces import Box, HeightField
from dynsim.record.scene import Scene
from dynsim.scenario import build

BASE = """duration_s: 0.02
plant:
  type: serial_arm
  chain: [{axis: z, length_m: 0}, {axis: y, count: 3, radius_m: 0.02}]
"""


@pytest.mark.parametrize(
    ("Q", "b", "names"),
    [
        (np.eye(2), np.zeros(3), ("(3, 3)", "(2, 2)", "(3,)")),
        (np.eye(3), np.zeros((3, 1)), ("(3, 3)", "(3, 1)")),
        (np.eye(3, k=1), np.zeros(3), ("Q", "(Q + Qᵀ)/2")),
    ],
)
def test_a_quadric_of_a_wrong_shape_is_refused(Q: Any, b: Any, names: tuple[str, ...]) -> None:
    with raises(ModelError, *names):
        Quadric(Q, b, 0.0)


def config(kind: Any, **keys: Any) -> Any:
    return kind.Config(type=kind.__name__.rpartition(".")[2], **keys)


def field_file(folder: Path, text: str, name: str = "hills.csv") -> str:
    file = folder / name
    file.write_text(text)
    return str(file)


GRID = "\n".join(",".join(f"{0.1 * x * y:.2f}" for x in range(5)) for y in range(4))


def test_a_box_is_turned_and_rounded():
    made = box.build(
        config(box, center_m=[1.0, 0.0, 0.0], edges_m=[2.0, 1.0, 0.4], rpy_deg=[0.0, 0.0, 90.0], edge_radius_m=0.1),
        BuildContext(1.0),
    )
    assert isinstance(made, Box)
    # Its long edge lies along y: faces at y = ±1 and x = 1 ± 0.5, and a corner at the rounding of √3 r from the core.
    places = np.array([[1.0, 1.3, 0.0], [0.2, 0.0, 0.0], [1.0, 0.0, 0.25]])
    np.testing.assert_allclose(made.gaps(places), [0.3, 0.3, 0.05])
    np.testing.assert_allclose(made.normal(np.array([1.0, 1.3, 0.0])), [0.0, 1.0, 0.0], atol=1e-15)
    corner = np.array([1.5, 1.0, 0.2])
    assert made.gap(corner) == pytest.approx(0.1 * (np.sqrt(3.0) - 1.0), rel=1e-12)
    np.testing.assert_allclose(made.normal(corner), np.full(3, 3.0**-0.5), rtol=1e-12)


def test_a_height_field_from_text_and_from_an_array(tmp_path):
    np.save(tmp_path / "hills.npy", np.array([[float(x) for x in row.split(",")] for row in GRID.split("\n")]))
    point = np.array([[1.0 + 0.5 * 3.0, -1.0 + 0.25 * 2.0, 2.0 + 0.6]])
    for file in (field_file(tmp_path, f"# heights\n{GRID}\n"), str(tmp_path / "hills.npy")):
        made = height_field.build(
            config(height_field, file=file, spacing_m=[0.5, 0.25], origin_m=[1.0, -1.0, 2.0]), BuildContext(1.0)
        )
        assert isinstance(made, HeightField)
        assert made.heights.shape == (4, 5)
        assert abs(made.gaps(point)[0]) <= 1e-13  # h = 0.1 · 3 · 2 at the fourth column of the third row


@pytest.mark.parametrize(
    ("text", "name", "names"),
    [
        ("1,2,3,4\n" * 3, "a.csv", ("a.csv", "3", "4")),
        ("1,2,3,4\n1,2,3\n", "a.csv", ("a.csv:2", "3", "4")),
        ("1,2,3,4\n1,2,x,4\n", "a.csv", ("a.csv:2", "'1,2,x,4'", "4")),
        ("# nothing\n", "a.csv", ("a.csv",)),
        (("1,2,3,4\n" * 3) + "1,2,3,1e9\n", "a.csv", ("4", "1e+09 m", "1e+06 m")),
        ("text", "a.npy", ("a.npy",)),
    ],
)
def test_wrong_files_of_heights_are_refused_with_their_place(tmp_path, text, name, names):
    file = field_file(tmp_path, text, name)
    scenario = tmp_path / "s.yaml"
    scenario.write_text(f"{BASE}surfaces:\n  hills:\n    type: height_field\n    file: {name}\n    spacing_m: [1, 1]\n")
    with raises(ScenarioError, "s.yaml:8: surfaces.hills.file", *names):
        dynsim.load_scenario(scenario)
    assert Path(file).exists()


def test_other_arrays_are_no_heights(tmp_path):
    for array in (np.zeros(4), np.zeros((4, 4), dtype=complex), np.full((4, 4), np.nan)):
        np.save(tmp_path / "a.npy", array)
        with raises(ValueError, "a.npy"):
            config(height_field, file=str(tmp_path / "a.npy"), spacing_m=[1.0, 1.0])
    with raises(ValueError, "b.npy"):
        config(height_field, file=str(tmp_path / "b.npy"), spacing_m=[1.0, 1.0])


def test_a_box_that_is_all_rounding_is_refused():
    with raises(ValueError, "0.2 m"):
        config(box, center_m=[0.0, 0.0, 0.0], edges_m=[2.0, 1.0, 0.4], edge_radius_m=0.3)


def scenario_of(folder: Path, contacts: str, surfaces: str = "{floor: {type: plane, point_m: [0, 0, -2]}}") -> Any:
    file = folder / "s.yaml"
    file.write_text(f"{BASE}surfaces: {surfaces}\ncontacts: {contacts}\n")
    return dynsim.load_scenario(file)


def test_candidates_need_the_unilateral_law(tmp_path):
    with raises(ScenarioError, "s.yaml:6: contacts.candidates", "contacts.law: unilateral"):
        scenario_of(tmp_path, "{candidates: joints}")


def names(folder: Path, kind: str, **keys: Any) -> list[str]:
    return [
        contact.name
        for contact in build.contacts(scenario_of(folder, f"{{law: unilateral, candidates: {kind}}}", **keys))
    ]


def test_joints_touch_each_surface_but_those_that_cannot_move_along_its_normal(tmp_path, caplog):
    """The first two joints are one point on the base: of the plane's normal nothing moves it, so it is named."""
    with caplog.at_level(logging.INFO, logger="dynsim"):
        assert names(tmp_path, "joints") == ["joint_3", "joint_4", "hand"]
    assert mentions(caplog.text, "contacts.candidates", "joint_1")
    two = "{floor: {type: plane, point_m: [0, 0, -2]}, ball: {type: sphere, center_m: [3, 0, 0], radius_m: 1}}"
    assert names(tmp_path, "joints", surfaces=two) == [
        f"{body}_{surface}" for surface in ("floor", "ball") for body in ("joint_3", "joint_4", "hand")
    ]


def test_declared_points_are_not_candidates_once_more(tmp_path, caplog):
    declared = "{law: unilateral, candidates: joints, points: {elbow: {body: link_3}}}"
    contacts = build.contacts(scenario_of(tmp_path, declared))
    assert [contact.name for contact in contacts] == ["elbow", "joint_4", "hand"]
    assert "contacts.candidates" not in caplog.text
    # A sphere about it would start a radius deep where the point starts on the floor.
    contacts = build.contacts(scenario_of(tmp_path, declared.replace("joints", "links")))
    assert [(contact.name, contact.radius) for contact in contacts] == [
        ("elbow", 0.0),
        ("joint_4", 0.02),
        ("link_4_end", 0.02),
    ]
    assert mentions(caplog.text, "WARNING", "contacts.candidates", "elbow")


FLAT = ["joint_3", "joint_4", "link_4_end"]
BENT = [*FLAT, "link_2", "link_3", "link_4"]


@pytest.mark.parametrize(
    ("surface", "expected"),
    [
        ("{type: plane, point_m: [0, 0, -2]}", FLAT),
        ("{type: sphere, center_m: [0, 0, -2], radius_m: 1}", BENT),
        ("{type: sphere, center_m: [0, 0, 0.1], radius_m: 3, inside: true}", FLAT),
        ("{type: cylinder, point_m: [0, 0, -2], axis: [1, 0, 0], radius_m: 1}", BENT),
        ("{type: box, center_m: [0, 0, -2], edges_m: [1, 1, 1]}", BENT),
    ],
)
def test_links_are_spheres_on_flat_surfaces_and_capsules_too_on_round_ones(tmp_path, surface, expected):
    assert names(tmp_path, "links", surfaces=f"{{floor: {surface}}}") == expected


def test_links_do_not_touch_quadrics_of_other_kinds(tmp_path):
    robot = build.robot(scenario_of(tmp_path, "{}"))
    ellipsoid = Quadric(np.diag([1.0, 2.0, 3.0]), np.zeros(3), -1.0)
    contacts = build.candidates("joints", robot, {"egg": ellipsoid}, [])
    assert compile_shapes(robot, contacts) is None
    with raises(ModelError, "joint_3", "egg"):
        compile_shapes(robot, build.candidates("links", robot, {"egg": ellipsoid}, []))


def test_scenes_keep_boxes_and_fields_and_figures_draw_them(tmp_path, monkeypatch):
    turned = config(box, center_m=[1.0, 0.0, 0.2], edges_m=[0.6, 0.4, 0.2], rpy_deg=[10.0, 20.0, 30.0])
    x = np.linspace(0.0, 2.0, 201)
    field = HeightField(np.array([0.0, -1.0]), np.array([0.01, 0.5]), np.tile(0.1 * np.sin(x), (5, 1)))
    surfaces = {"box": box.build(turned, BuildContext(1.0)), "hills": field}
    robot = build.robot(scenario_of(tmp_path, "{}"))
    scene = robot_scene(robot, [], surfaces)
    assert scene is not None
    assert Scene.from_json(scene.to_json()) == scene
    drawn = {drawn_surface.name: drawn_surface for drawn_surface in scene.surfaces}
    assert len(drawn["hills"].heights[0]) == GRID_LINES
    points = np.random.default_rng(3).uniform([0.0, -1.0, -0.5], [2.0, 1.0, 0.8], size=(200, 3))
    np.testing.assert_allclose(drawn["box"].value(points), surfaces["box"].gaps(points), atol=1e-12)
    np.testing.assert_allclose(drawn["hills"].value(points), points[:, 2] - 0.1 * np.sin(points[:, 0]), atol=2e-5)
    quads: list[np.ndarray] = []

    class Kept(posture.Poly3DCollection):  # type: ignore[misc]
        def __init__(self, shown: Any, **options: Any) -> None:
            quads.append(np.array(shown))
            super().__init__(shown, **options)

    monkeypatch.setattr(posture, "Poly3DCollection", Kept)
    axes = plt.figure().add_subplot(projection="3d")
    for surface, cells in (("box", 6), ("hills", 60 * 4)):
        posture._draw_surface(axes, drawn[surface], np.array([-1.0, -2.0, -1.0]), np.array([3.0, 2.0, 2.0]))
        assert quads[-1].shape == (cells, 4, 3)
    plt.close("all")
    # Its corners are sharp in the picture: there the distance is √3 − 1 of the rounding.
    assert np.abs(surfaces["box"].gaps(quads[0].reshape(-1, 3))).max() == pytest.approx(0.005 * (3.0**0.5 - 1.0))
    assert np.abs(field.gaps(quads[1].reshape(-1, 3))).max() <= 2e-5


def test_links_that_sink_into_a_box_or_a_field_are_found(tmp_path):
    """The hand lies 0.1 m deep in a box, and 0.05 m below a field."""
    model = build.build_model(scenario_of(tmp_path, "{}"))
    robot = model.robot
    q = robot.initial[None]
    position = model.point_position(*robot.hand, robot.initial)
    cube = Box(position - vector(0.0, 0.0, 0.4), np.eye(3), np.array([1.0, 1.0, 1.0]), 0.01)
    flat = HeightField(position[:2] - 2.0, np.array([1.0, 1.0]), np.full((5, 5), position[2] + 0.05))
    depths = {
        (penetration.body, penetration.surface): penetration.depth
        for penetration in sinking(robot, {"cube": cube, "flat": flat}, q)
    }
    last = robot.hand[0]
    assert depths[last, "cube"] >= 0.1 - 1e-9
    assert depths[last, "flat"] >= 0.05 - 1e-9


def test_a_carriage_without_mass_and_length_is_no_body_of_its_own(tmp_path):
    """Three joints at one place: only what has mass or extent touches there, with its own radius."""
    base = "duration_s: 1\nplant:\n  type: serial_arm\n  chain:\n"
    carriage = "    - {kind: prismatic, axis: z, length_m: 0, mass_kg: MASS, radius_m: 0.3}\n"
    rod = "    - {axis: y, initial_deg: 90, length_m: 0.4, radius_m: 0.02, mass_kg: 0.5}\n"
    floor = "surfaces: {floor: {type: plane, point_m: [0, 0, -2]}}\ncontacts: {law: unilateral, candidates: links}\n"
    file = tmp_path / "s.yaml"
    for mass, expected in (
        (0, [("joint_2", 0.02), ("link_2_end", 0.02)]),
        (1, [("joint_1", 0.3), ("link_2_end", 0.02)]),
    ):
        file.write_text(base + carriage.replace("MASS", str(mass)) + rod + floor)
        assert [(contact.name, contact.radius) for contact in build.contacts(dynsim.load_scenario(file))] == expected


def test_a_ball_on_the_axis_of_a_pipe_is_refused_by_name(tmp_path):
    """It has no nearest point there; the error was a division by zero."""
    text = """
duration_s: 1
plant: {type: serial_arm, chain: [{axis: y}]}
contacts: {law: unilateral}
surfaces: {pipe: {type: cylinder, point_m: [0, 0, 0], axis: [1, 0, 0], radius_m: 0.15, inside: true}}
objects: {ball: {mass_kg: 0.5, shape: sphere, radius_m: 0.05, position_m: [0, 0, HEIGHT]}}
"""
    file = tmp_path / "pipe.yaml"
    file.write_text(text.replace("HEIGHT", "0"))
    with raises(ModelError, "pipe.yaml", "ball.pipe"):
        dynsim.check(dynsim.load_scenario(file))
    file.write_text(text.replace("HEIGHT", "1e-6"))
    start = dynsim.check(dynsim.load_scenario(file))
    assert start.gaps["ball.pipe"] == pytest.approx(0.1 - 1e-6)
