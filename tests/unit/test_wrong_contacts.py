"""Wrong keys of contacts, braces and surfaces: each is refused with file, line, key, value and fix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, raises

import dynsim
from dynsim.engine import check
from dynsim.errors import DynsimError, ModelError
from dynsim.library.controllers import joint_pd

SCENARIO = """\
duration_s: 0.05
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.3]}
  chain: [{axis: z, motor: {type: wang_minami}}, {axis: y, count: 3, length_m: 0.2, motor: {type: wang_minami}}]
metrics: {settle_s: 0.01}
surfaces: {floor: {type: plane}, thing: THING}
contacts: {law: LAW, points: {elbow: {body: link_3POINT}}CONTACTS}
controller: {type: joint_pdCONTROLLER}
integrator: {INTEGRATOR}
"""
PLANE = "{type: plane, point_m: [0, 0, -5]}"


def written(folder: Path, more: str = "", **parts: str) -> Path:
    """A scenario with these parts."""
    defaults = {"THING": PLANE, "LAW": "unilateral", "POINT": "", "CONTACTS": "", "CONTROLLER": "", "INTEGRATOR": ""}
    text = SCENARIO
    for name, part in (defaults | parts).items():
        text = text.replace(name, part)
    path = folder / "case.yaml"
    path.write_text(text + more)
    return path


def refused(folder: Path, more: str = "", **parts: str) -> str:
    """The message for it, without its folder."""
    path = written(folder, more, **parts)
    with raises(DynsimError) as caught:
        check(dynsim.load_scenario(path))
    return str(caught.value).replace(f"{folder}/", "")


def test_without_a_fault_it_is_accepted(tmp_path: Path) -> None:
    assert check(dynsim.load_scenario(written(tmp_path))).contacts["elbow"] == pytest.approx([0.0, 0.0, 0.8])


@pytest.mark.parametrize(
    ("contacts", "names"),
    [
        ("friction: 0.5, static_friction: 0.2", ("static_friction = 0.2", "friction (0.5)")),
        (
            "slip_smoothing_m_s: 0.001",
            ("slip_smoothing_m_s = 0.001", "contacts.law: bilateral", "unilateral"),
        ),
        (
            "pulling_friction: signed",
            ("pulling_friction = 'signed'", "contacts.law: bilateral", "unilateral"),
        ),
        ("restitution: 2", ("restitution = 2", "1")),
        ("friction: -0.1", ("friction = -0.1", "0")),
        ("friction: rough", ("friction = 'rough'",)),
        ("stribeck_m_s: 0", ("stribeck_m_s = 0",)),
        ("candidates: foo", ("candidates = 'foo'", "points", "joints", "links")),
    ],
)
def test_contacts(tmp_path: Path, contacts: str, names: tuple[str, ...]) -> None:
    check_message(refused(tmp_path, CONTACTS=f", {contacts}"), f"case.yaml:8: contacts.{names[0]}", *names[1:])


@pytest.mark.parametrize(
    ("law", "point", "names"),
    [
        (
            "unilateral",
            "friction: 0.5, static_friction: 0.2",
            ("static_friction = 0.2", "0.5"),
        ),
        ("unilateral", "restitution: -1", ("restitution = -1", "0")),
        (
            "bilateral",
            "restitution: 0.3",
            ("restitution = 0.3", "contacts.law: unilateral", "bilateral"),
        ),
    ],
)
def test_points(tmp_path: Path, law: str, point: str, names: tuple[str, ...]) -> None:
    message = refused(tmp_path, LAW=law, POINT=f", {point}")
    check_message(message, f"case.yaml:8: contacts.points.elbow.{names[0]}", *names[1:])


@pytest.mark.parametrize(
    ("controller", "names"),
    [
        ("brace: {elbow: -1}", ("brace.elbow = -1", "0 N")),
        ("brace: {elbow: true}", ("brace.elbow = True", "0 N")),
        ("brace: {elbow: .inf}", ("brace.elbow = inf", "0 N")),
        ("brace: best", ("brace = 'best'", "optimal")),
        ("brace: [elbow]", ("brace", "optimal")),
        ("brace: {}", ("brace", "optimal")),
        ("brace: {elbo: 1}", ("brace", "elbo", "elbow")),
        ("brace: {elbow: 1}", ("brace", "elbow", "+0.8 m", "floor", "0.000 s")),
        ("brace: optimal, feed_forward: gravity", ("feed_forward = 'gravity'", "brace")),
        ("min_N: 2", ("min_N = 2", "brace: optimal")),
        (
            "joints: {joint_7: {times_s: [0, 1], angles_deg: [0, 0]}}",
            ("joints", "joint_7", "joint_4"),
        ),
    ],
)
def test_braces(tmp_path: Path, controller: str, names: tuple[str, ...]) -> None:
    check_message(refused(tmp_path, CONTROLLER=f", {controller}"), f"case.yaml:9: controller.{names[0]}", *names[1:])


def test_optimal_braces_are_the_declared_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What could touch as well is no brace: it is in the air, and nothing keeps it on a surface."""
    pressing: list[str] = []

    def plan(model: object, times: np.ndarray, positions: np.ndarray, braces: dict[str, object], least: float) -> None:
        pressing.extend(braces)
        raise ModelError("seen")

    monkeypatch.setattr(joint_pd, "planned_voltages", plan)
    for candidates in ("joints", "links"):
        pressing.clear()
        contacts, controller = f", candidates: {candidates}", ", brace: optimal"
        assert "seen" in refused(tmp_path, CONTACTS=contacts, CONTROLLER=controller)
        assert pressing == ["elbow"]


def test_all_points_that_start_below_their_surface_are_named_at_once(tmp_path: Path) -> None:
    """The arm stands upright from z = 0.3 m: joint 3 at 0.8 m, its middle at 0.7 m, and the hand above."""
    points = "points: {elbow: {body: link_3}, low: {body: link_3, point_m: [0, 0, -0.1]}}"
    path = written(tmp_path)
    path.write_text(path.read_text().replace("points: {elbow: {body: link_3}}", f"{points}, candidates: joints"))
    with raises(DynsimError, "contacts.points.elbow", "-0.1 m", "floor", "low", "-0.2 m", "[elbow, low]") as caught:
        check(dynsim.load_scenario(path, overrides={"surfaces.floor.point_m": [0.0, 0.0, 0.9]}))
    assert "hand" not in str(caught.value)


def test_braces_that_the_motors_cannot_press(tmp_path: Path) -> None:
    """A bent arm of a few volts leans on the floor with some newtons, and cannot press with a kilonewton."""
    path = written(tmp_path)
    bent = {"plant.chain.1.initial_deg": 40.0, "plant.chain.1.motor.voltage_limit_V": 20.0}
    model = dynsim.build_model(dynsim.load_scenario(path, overrides=bent))
    bent["surfaces.floor.point_m"] = model.point_position("link_3", [0, 0, 0], model.robot.initial).tolist()
    check(dynsim.load_scenario(path, overrides=bent | {"controller.brace": {"elbow": 1.0}}))
    scenario = dynsim.load_scenario(path, overrides=bent | {"controller.brace": {"elbow": 1000.0}})
    with raises(DynsimError, "controller.brace", "0.000 s", "elbow", "voltage_limit_V"):
        check(scenario)


@pytest.mark.parametrize(
    ("thing", "names"),
    [
        ("{type: box, center_m: [0, 0, -5], edges_m: [1, -1, 1]}", ("edges_m.1 = -1", "0")),
        ("{type: box, center_m: [0, 0, -5], edges_m: [1, 1]}", ("edges_m", "2", "3")),
        ("{type: height_field, file: none.csv, spacing_m: [0.1, 0.1]}", ("file = ", "none.csv")),
        (
            "{type: height_field, file: ragged.csv, spacing_m: [0.1, 0.1]}",
            ("file = ", "ragged.csv:2", "3", "4"),
        ),
        (
            "{type: height_field, file: nan.npy, spacing_m: [0.1, 0.1]}",
            ("file = ", "nan.npy", "2", "1", "nan"),
        ),
    ],
)
def test_surfaces(tmp_path: Path, thing: str, names: tuple[str, ...]) -> None:
    (tmp_path / "ragged.csv").write_text("0,0,0,0\n0,0,0\n")
    heights = np.zeros((4, 4))
    heights[0, 1] = np.nan
    np.save(tmp_path / "nan.npy", heights)
    message = refused(tmp_path, THING=thing)
    check_message(message, f"case.yaml:7: surfaces.thing.{names[0]}", *names[1:])


@pytest.mark.parametrize(
    ("law", "integrator", "names"),
    [
        ("unilateral", "method: time_stepping, theta: 0.3", ("theta = 0.3", "0.5")),
        ("unilateral", "theta: 0.7", ("theta = 0.7", "integrator.method: time_stepping", "auto")),
        (
            "unilateral",
            "method: time_stepping, solver: m_star",
            ("solver = 'm_star'", "integrator.method: auto", "time_stepping"),
        ),
        (
            "bilateral",
            "method: time_stepping",
            ("method = 'time_stepping'", "contacts.law: unilateral", "bilateral"),
        ),
    ],
)
def test_time_stepping(tmp_path: Path, law: str, integrator: str, names: tuple[str, ...]) -> None:
    check_message(refused(tmp_path, LAW=law, INTEGRATOR=integrator), f"case.yaml:10: integrator.{names[0]}", *names[1:])


def test_bodies_of_points_that_are_put_on_surfaces(tmp_path: Path) -> None:
    text = refused(tmp_path, "initial: {on_surface: [two]}\n", POINT="}, two: {body: link_33")
    check_message(text, "case.yaml:8: contacts.points.two.body", "link_33", "link_3")


def test_bodies_below_a_surface_at_the_start_are_warned_of(tmp_path: Path) -> None:
    """The floor is at the lower end of the arm, which stands upright; another plane has a link below it."""
    path = written(tmp_path, POINT=", enabled: false")
    assert check(dynsim.load_scenario(path)).warnings == []
    path = written(tmp_path, THING="{type: plane, point_m: [0, 0, 0.55]}", POINT=", enabled: false")
    (warning,) = check(dynsim.load_scenario(path)).warnings
    check_message(warning, "link_1", "thing", "250 mm")


@pytest.mark.parametrize(
    ("initial", "names"),
    [
        ("{on_surface: []}", ("on_surface", "equilibrium", "on_references")),
        ("{equilibrium: true, keep: [hand]}", ("keep", "on_surface")),
        ("{on_surface: elbow}", ("on_surface = 'elbow'",)),
        ("{on_surface: [elbo]}", ("on_surface", "elbo", "elbow")),
        (
            "{on_surface: [elbow], keep: [arm]}",
            ("keep", "arm", "joint_1, joint_2, joint_3, joint_4", "hand"),
        ),
    ],
)
def test_initial_postures(tmp_path: Path, initial: str, names: tuple[str, ...]) -> None:
    check_message(refused(tmp_path, f"initial: {initial}\n"), f"case.yaml:11: initial.{names[0]}", *names[1:])


def test_stops_are_told_in_the_units_of_the_scenario(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text(
        "duration_s: 0.1\nplant:\n  type: serial_arm\n"
        "  chain: [{axis: y, length_m: 0.3, limit_deg: [0, 90], initial_deg: -20}]\ncontacts: {law: unilateral}\n"
    )
    with raises(DynsimError, "case.yaml:2", "joint_1", "-20°", "0°"):
        check(dynsim.load_scenario(path))
