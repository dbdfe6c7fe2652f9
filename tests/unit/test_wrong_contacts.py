"""Wrong keys of contacts, braces and surfaces: each is refused with file, line, key, value and fix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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
    with pytest.raises(DynsimError) as caught:
        check(dynsim.load_scenario(path))
    return str(caught.value).replace(f"{folder}/", "")


def test_without_a_fault_it_is_accepted(tmp_path: Path) -> None:
    assert check(dynsim.load_scenario(written(tmp_path))).contacts["elbow"] == pytest.approx([0.0, 0.0, 0.8])


@pytest.mark.parametrize(
    ("contacts", "said"),
    [
        ("friction: 0.5, static_friction: 0.2", "static_friction = 0.2: is less than friction 0.5"),
        (
            "slip_smoothing_m_s: 0.001",
            "slip_smoothing_m_s = 0.001: requires contacts.law: bilateral",
        ),
        (
            "pulling_friction: signed",
            "pulling_friction = 'signed': requires contacts.law: bilateral",
        ),
        ("restitution: 2", "restitution = 2: must be less than or equal to 1"),
        ("friction: -0.1", "friction = -0.1: must be greater than or equal to 0"),
        ("friction: rough", "friction = 'rough': must be a valid number"),
        ("stribeck_m_s: 0", "stribeck_m_s = 0: must be greater than 0"),
        ("candidates: foo", "candidates = 'foo': must be 'points', 'joints' or 'links'"),
    ],
)
def test_contacts(tmp_path: Path, contacts: str, said: str) -> None:
    assert refused(tmp_path, CONTACTS=f", {contacts}").startswith(f"case.yaml:8: contacts.{said}")


@pytest.mark.parametrize(
    ("law", "point", "said"),
    [
        (
            "unilateral",
            "friction: 0.5, static_friction: 0.2",
            "static_friction = 0.2: static_friction 0.2 is less than",
        ),
        ("unilateral", "restitution: -1", "restitution = -1: must be greater than or equal to 0"),
        (
            "bilateral",
            "restitution: 0.3",
            "restitution = 0.3: requires contacts.law: unilateral (here: bilateral)",
        ),
    ],
)
def test_points(tmp_path: Path, law: str, point: str, said: str) -> None:
    message = refused(tmp_path, LAW=law, POINT=f", {point}")
    assert message.startswith(f"case.yaml:8: contacts.points.elbow.{said}")


@pytest.mark.parametrize(
    ("controller", "said"),
    [
        ("brace: {elbow: -1}", "brace.elbow = -1: must be a normal force above 0 N"),
        ("brace: {elbow: true}", "brace.elbow = True: must be a normal force above 0 N"),
        ("brace: {elbow: .inf}", "brace.elbow = inf: must be a normal force above 0 N"),
        ("brace: best", "brace = 'best': must be `optimal`, or normal forces [N] by contact"),
        ("brace: [elbow]", "brace: must be `optimal`, or normal forces [N] by contact"),
        ("brace: {}", "brace: must be `optimal`, or normal forces [N] by contact"),
        ("brace: {elbo: 1}", "brace: no contact 'elbo'; those are: elbow"),
        ("brace: {elbow: 1}", "brace: the references take elbow +0.8 m off surface 'floor' at t = 0.000 s"),
        ("brace: optimal, feed_forward: gravity", "feed_forward = 'gravity': brace plans the whole dynamics"),
        ("min_N: 2", "min_N = 2: min_N is for brace: optimal"),
        (
            "joints: {joint_7: {times_s: [0, 1], angles_deg: [0, 0]}}",
            "joints: 'joint_7' is no joint with a motor; did you",
        ),
    ],
)
def test_braces(tmp_path: Path, controller: str, said: str) -> None:
    assert refused(tmp_path, CONTROLLER=f", {controller}").startswith(f"case.yaml:9: controller.{said}")


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
    with pytest.raises(DynsimError) as caught:
        check(dynsim.load_scenario(path, overrides={"surfaces.floor.point_m": [0.0, 0.0, 0.9]}))
    said = str(caught.value)
    assert "contacts.points.elbow: its point starts -0.1 m from surface 'floor'" in said
    assert "(also low -0.2 m from 'floor'" in said
    assert "hand" not in said


def test_braces_that_the_motors_cannot_press(tmp_path: Path) -> None:
    """A bent arm of a few volts leans on the floor with some newtons, and cannot press with a kilonewton."""
    path = written(tmp_path)
    bent = {"plant.chain.1.initial_deg": 40.0, "plant.chain.1.motor.voltage_limit_V": 20.0}
    model = dynsim.build_model(dynsim.load_scenario(path, overrides=bent))
    bent["surfaces.floor.point_m"] = model.point_position("link_3", [0, 0, 0], model.robot.initial).tolist()
    check(dynsim.load_scenario(path, overrides=bent | {"controller.brace": {"elbow": 1.0}}))
    scenario = dynsim.load_scenario(path, overrides=bent | {"controller.brace": {"elbow": 1000.0}})
    with pytest.raises(DynsimError, match=r"controller\.brace: at t = 0\.000 s no forces of elbow .*; ask for other"):
        check(scenario)


@pytest.mark.parametrize(
    ("thing", "said"),
    [
        ("{type: box, center_m: [0, 0, -5], edges_m: [1, -1, 1]}", "edges_m.1 = -1: must be greater than 0"),
        ("{type: box, center_m: [0, 0, -5], edges_m: [1, 1]}", "edges_m: has 2 entries; it must have at least 3"),
        ("{type: height_field, file: none.csv, spacing_m: [0.1, 0.1]}", "none.csv: no such file"),
        (
            "{type: height_field, file: ragged.csv, spacing_m: [0.1, 0.1]}",
            "ragged.csv:2: 3 values",
        ),
        (
            "{type: height_field, file: nan.npy, spacing_m: [0.1, 0.1]}",
            "nan.npy: height 2 of row 1 is nan",
        ),
    ],
)
def test_surfaces(tmp_path: Path, thing: str, said: str) -> None:
    (tmp_path / "ragged.csv").write_text("0,0,0,0\n0,0,0\n")
    heights = np.zeros((4, 4))
    heights[0, 1] = np.nan
    np.save(tmp_path / "nan.npy", heights)
    message = refused(tmp_path, THING=thing)
    assert message.startswith("case.yaml:7: surfaces.thing.")
    assert said in message


@pytest.mark.parametrize(
    ("law", "integrator", "said"),
    [
        ("unilateral", "method: time_stepping, theta: 0.3", "theta = 0.3: must be greater than or equal to 0.5"),
        ("unilateral", "theta: 0.7", "theta = 0.7: requires integrator.method: time_stepping (here: auto)"),
        (
            "unilateral",
            "method: time_stepping, solver: m_star",
            "solver = 'm_star': requires integrator.method: auto",
        ),
        (
            "bilateral",
            "method: time_stepping",
            "method = 'time_stepping': requires contacts.law: unilateral",
        ),
    ],
)
def test_time_stepping(tmp_path: Path, law: str, integrator: str, said: str) -> None:
    assert refused(tmp_path, LAW=law, INTEGRATOR=integrator).startswith(f"case.yaml:10: integrator.{said}")


def test_bodies_of_points_that_are_put_on_surfaces(tmp_path: Path) -> None:
    text = refused(tmp_path, "initial: {on_surface: [two]}\n", POINT="}, two: {body: link_33")
    assert text.startswith("case.yaml:8: contacts.points.two.body: no body 'link_33'; did you mean 'link_3'?")


def test_bodies_below_a_surface_at_the_start_are_warned_of(tmp_path: Path) -> None:
    """The floor is at the lower end of the arm, which stands upright; another plane has a link below it."""
    path = written(tmp_path, POINT=", enabled: false")
    assert check(dynsim.load_scenario(path)).warnings == []
    path = written(tmp_path, THING="{type: plane, point_m: [0, 0, 0.55]}", POINT=", enabled: false")
    (warning,) = check(dynsim.load_scenario(path)).warnings
    assert warning.startswith("link_1: below thing at the start, by up to 250 mm; surfaces hold only")


@pytest.mark.parametrize(
    ("initial", "said"),
    [
        ("{on_surface: []}", "on_surface: names no contact point; name some, set equilibrium or on_references: true"),
        ("{equilibrium: true, keep: [hand]}", "keep: has no effect without on_surface"),
        ("{on_surface: elbow}", "on_surface = 'elbow': must be a list, such as [a, b]"),
        ("{on_surface: [elbo]}", "on_surface: no contact 'elbo'; those are: elbow"),
        (
            "{on_surface: [elbow], keep: [arm]}",
            "keep: no joint 'arm'; joints: joint_1, joint_2, joint_3, joint_4, and hand",
        ),
    ],
)
def test_initial_postures(tmp_path: Path, initial: str, said: str) -> None:
    assert refused(tmp_path, f"initial: {initial}\n").startswith(f"case.yaml:11: initial.{said}")


def test_stops_are_told_in_the_units_of_the_scenario(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text(
        "duration_s: 0.1\nplant:\n  type: serial_arm\n"
        "  chain: [{axis: y, length_m: 0.3, limit_deg: [0, 90], initial_deg: -20}]\ncontacts: {law: unilateral}\n"
    )
    with pytest.raises(DynsimError, match=r"case\.yaml:2: joint_1: starts at -20° .*, beyond its stop at 0° "):
        check(dynsim.load_scenario(path))
