"""Collision shapes of the root link, which is fixed to the world, as partners of bodies that touch each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.messages import raises
from typer.testing import CliRunner

from dynsim import Record, load_scenario, simulate
from dynsim.cli.commands import app
from dynsim.draw.geometry.robot import contacts, robot_of
from dynsim.errors import DynsimError

G = 9.81
MOMENTS = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
MASS = f'<inertial><origin xyz="0 0 0.25"/><mass value="1"/>{MOMENTS}</inertial>'
BALL = {"shape": "sphere", "radius_m": 0.05, "mass_kg": 1}
ROD = {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.3, "mass_kg": 1}
LARGE = {"size_m": [1, 1, 1], "mass_kg": 1, "position_m": [1, 0, 0.9]}
OBJECTS = [{"bodies": ["stand", "objects"]}]


def collision(solid: str, xyz: str, rpy: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{solid}</geometry></collision>'


PILLAR = collision('<box size="0.1 0.1 0.5"/>', "1 0 0.25")
TABLE = collision('<box size="0.4 0.4 0.5"/>', "2 0 0.25")
DOME = collision('<sphere radius="0.2"/>', "3 0 0.2")
RAIL = collision('<cylinder radius="0.05" length="0.5"/>', "0.4 0 0.1", "1.5707963267948966 0 0")


def loaded(folder: Path, stand: str, between: list[dict[str, Any]], friction: float = 0.4, **more: Any):
    """Scenario of an arm of two capsules on a stand; the second joint is 0.55 m above the first."""
    text = f'<robot name="r"><link name="stand">{stand}</link><link name="foot"/>'
    limb = MASS + collision('<capsule radius="0.03" length="0.44"/>', "0 0 0.25")
    text += f'<link name="upper">{limb}</link><link name="lower">{limb}</link>'
    for parent, child, height in (("stand", "upper", 0.7), ("upper", "lower", 0.55)):
        text += f'<joint name="{child}_joint" type="continuous"><origin xyz="0 0 {height}"/><axis xyz="0 1 0"/>'
        text += f'<parent link="{parent}"/><child link="{child}"/></joint>'
    text += '<joint name="bolted" type="fixed"><parent link="stand"/><child link="foot"/></joint></robot>'
    (folder / "robot.urdf").write_text(text, encoding="utf-8")
    initial = {"upper_joint": 90, "lower_joint": 45}
    scenario = {
        "duration_s": 0.3,
        "plant": {"file": "robot.urdf", "initial_deg": initial, "damping_N_m_s_per_rad": 0.5, "type": "urdf_arm"},
        "contacts": {"law": "unilateral", "friction": friction, "between": between},
        "integrator": {"method": "time_stepping"},
    } | more
    (folder / "scene.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return load_scenario(folder / "scene.yaml")


def forces(record: Record, body: str) -> list[float]:
    """Normal forces of a body on the stand at the end that are not zero [N]."""
    values = zip(record.labels["contact_normal_force"], record["contact_normal_force"][-1], strict=True)
    return [float(force) for name, force in values if name.startswith(f"{body}-stand") and force > 0.0]


def test_objects_rest_on_shapes_of_the_root(tmp_path):
    objects = {
        "big": {"size_m": [0.3, 0.3, 0.1], "mass_kg": 2, "position_m": [1, 0, 0.55]},  # wider than the pillar
        "small": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [2, 0, 0.55]},
        "rod": ROD | {"position_m": [2, -0.1, 0.53], "rpy_deg": [0, 90, 0]},
        "ball": BALL | {"position_m": [2.1, 0.1, 0.55]},
        "top": BALL | {"position_m": [3, 0, 0.45]},
    }
    record = simulate(loaded(tmp_path, PILLAR + TABLE + DOME, OBJECTS, objects=objects))
    assert forces(record, "big") == pytest.approx([0.5 * G] * 4, rel=1e-6)
    assert forces(record, "small") == pytest.approx([0.25 * G] * 4, rel=1e-6)
    assert forces(record, "rod") == pytest.approx([0.5 * G] * 2, rel=1e-6)
    assert forces(record, "ball") + forces(record, "top") == pytest.approx([G, G], rel=1e-9)
    moving = [not label.endswith("_joint") for label in record.labels["v"]]
    assert np.abs(record["v"][-1, moving]).max() < 1e-9
    assert record.summary["energy_residual_relative"] < 1e-12


@pytest.mark.parametrize("method", ["time_stepping", "dopri5"])
@pytest.mark.parametrize(
    ("shape", "surface"),
    [
        (TABLE, {"type": "box", "center_m": [2, 0, 0.25], "edges_m": [0.4, 0.4, 0.5], "edge_radius_m": 1e-3}),
        (DOME, {"type": "sphere", "center_m": [3, 0, 0.2], "radius_m": 0.2}),
    ],
)
def test_a_shape_of_the_root_is_a_surface(tmp_path, shape, surface, method):
    """A ball falls on the shape, or on a surface of the same form, 2 cm from its centre."""
    x = surface["center_m"][0] + 0.02
    more = {"objects": {"ball": BALL | {"position_m": [x, 0.01, 0.6]}}, "duration_s": 0.35}
    more["integrator"] = {"method": method} | ({"rtol": 1e-10, "atol": 1e-12} if method == "dopri5" else {})
    own = simulate(loaded(tmp_path, shape, OBJECTS, **more))
    known = simulate(loaded(tmp_path, "", [], surfaces={"surface": surface}, **more))
    assert own.labels["contact_normal_force"] == ("ball-stand",)
    assert own["contact_normal_force"].max() > 5.0
    assert np.abs(own["q"][-1] - known["q"][-1]).max() < (1e-12 if method == "time_stepping" else 1e-7)


@pytest.mark.parametrize("method", ["time_stepping", "dopri5"])
def test_an_arm_leans_on_its_stand(tmp_path, method):
    """The lower link comes to rest on a rail of the stand; the moments about both joints vanish."""
    rail = collision('<cylinder radius="0.05" length="0.5"/>', "0.2 0 -0.1", "1.5707963267948966 0 0")
    scenario = loaded(tmp_path, rail, [{"bodies": "self"}], friction=0.0, duration_s=6.0, integrator={"method": method})
    record = simulate(scenario)
    labels = record.labels["contact_normal_force"]
    assert {name.split("_")[0] for name in labels} == {"lower-stand"}  # the upper link is on a joint of the stand
    upper, both = record["q"][-1].cumsum()
    along = np.array([[np.sin(a), np.cos(a)] for a in (upper, both)])
    elbow = 0.55 * along[0]
    weights = [(0.25 * along[0], np.array([0.0, -G])), (elbow + 0.25 * along[1], np.array([0.0, -G]))]
    normal, force = record["contact_normal"][-1][:, [0, 2]], record["contact_normal_force"][-1]
    touch = record["contact_position"][-1][:, [0, 2]] - [0.0, 0.7]
    pushes = [(at, f * n) for at, n, f in zip(touch, normal, force, strict=True)]
    assert force.sum() > 1.0

    def moment(pivot: np.ndarray, acting: list[tuple[np.ndarray, np.ndarray]]) -> float:
        return sum((at - pivot)[1] * f[0] - (at - pivot)[0] * f[1] for at, f in acting)

    assert moment(np.zeros(2), weights + pushes) == pytest.approx(0.0, abs=1e-3)
    assert moment(elbow, weights[1:] + pushes) == pytest.approx(0.0, abs=1e-3)


def test_forces_on_the_root_are_drawn_at_their_places(tmp_path):
    record = simulate(loaded(tmp_path, PILLAR, OBJECTS, objects={"ball": BALL | {"position_m": [1.02, 0.01, 0.55]}}))
    robot = robot_of(record)
    assert robot is not None
    (contact,) = contacts(robot)
    assert contact.normal[-1] == pytest.approx([0, 0, 1])
    assert contact.force[-1] == pytest.approx(G)
    assert contact.at is not None
    assert contact.at[-1] == pytest.approx([1.02, 0.01, 0.5], abs=1e-6)


@pytest.mark.long
def test_runs_with_the_root_are_saved_drawn_and_exported(tmp_path):
    """The root link has no pose in the record."""
    rail = [{"bodies": "self"}, *OBJECTS]
    loaded(tmp_path, PILLAR + RAIL, rail, objects={"ball": BALL | {"position_m": [1.02, 0.01, 0.55]}}, duration_s=0.02)
    out = tmp_path / "out"
    for arguments in (
        ["run", str(tmp_path / "scene.yaml"), "--out", str(out)],
        ["export", str(out / "record.h5"), "--format", "mcap", "--out", str(tmp_path / "log.mcap")],
    ):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
    assert "ball-stand" in (out / "summary.json").read_text(encoding="utf-8")
    for path in (out / "figures" / "posture.png", out / "view.html", tmp_path / "log.mcap"):
        assert path.stat().st_size > 1000


def test_check_lists_pairs_with_the_root(tmp_path):
    loaded(tmp_path, PILLAR, OBJECTS, objects={"ball": BALL | {"position_m": [1.02, 0.01, 0.6]}})
    result = CliRunner().invoke(app, ["check", str(tmp_path / "scene.yaml")])
    assert "gap of ball-stand" in result.stdout
    assert "+0.05 m" in result.stdout


@pytest.mark.parametrize(
    ("between", "more", "texts"),
    [
        ([{"bodies": ["foot", "box"]}], {}, ("'foot' is fixed to 'stand'", "use 'stand'")),
        ([{"bodies": ["stand", "box"]}], {"integrator": {"method": "dopri5"}}, ("box is a box", "time_stepping")),
        ([{"bodies": ["box", "stand"]}], {"objects": {"box": LARGE}}, ("box and stand overlap by 0.1 m", "position_m")),
    ],
)
def test_pairs_that_cannot_be_are_refused(tmp_path, between, more, texts):
    box = {"box": {"size_m": [0.1, 0.1, 0.1], "mass_kg": 1, "position_m": [1, 0, 0.9]}}
    with raises(DynsimError, "contacts.between", *texts):
        simulate(loaded(tmp_path, PILLAR, between, **({"objects": box} | more)))


def test_a_root_without_shapes_has_no_solid(tmp_path):
    ball = {"ball": BALL | {"position_m": [1, 0, 0.9]}}
    with raises(DynsimError, "'stand' has no solid", "<collision>"):
        simulate(loaded(tmp_path, "", OBJECTS, objects=ball))
