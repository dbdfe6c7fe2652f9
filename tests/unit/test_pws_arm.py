"""Scenarios of a mobile arm: errors with key and line, resolved scenarios, arms from URDF files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import check_message

import dynsim
from dynsim.cli import main
from dynsim.record.joint_motion import joint_motion
from dynsim.scenario import build_model, scenario_from_resolved

GOOD = """duration_s: 0.2
plant:
  type: pws_arm
  base:
    track_m: 0.3
    caster_m: [0.15, 0, 0]
    wheel:
      radius_m: 0.05
      motor: {type: wang_minami}
  arm:
    type: serial_arm
    chain: [{axis: y, count: 2, mass_kg: 0.2, damping_N_m_s_per_rad: 0.5, motor: {type: wang_minami}}]
controller: {type: joint_pd, joints: {base.left: {times_s: [0, 0.2], angles_deg: [0, 90]}}}
"""
ARM = """<robot name="r"><link name="root"><inertial><mass value="2"/><origin xyz="0.1 0 0.05"/>
<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="upper"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="hinge" type="continuous"><parent link="root"/><child link="upper"/><axis xyz="0 1 0"/></joint>
</robot>"""


@pytest.fixture
def case(tmp_path: Path) -> Path:
    (tmp_path / "case.yaml").write_text(GOOD)
    return tmp_path / "case.yaml"


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Exit code of the command line."""
    monkeypatch.setattr(sys, "argv", ["dynsim", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("track_m: 0.3", "track_m: 0", ("5: plant.base.track_m = 0",)),
        ("track_m: 0.3", "inertia_kg_m2: [1, 0, 0, 1, 0, 5]", ("5: plant.base", "[1. 1. 5.]")),
        ("[0.15, 0, 0]", "[0, 0.1, 0]", ("6: plant.base.caster_m",)),
        ("[0.15, 0, 0]", "[0.1, 0, 0.2]", ("6: plant.base.caster_m",)),
        ("radius_m: 0.05", "radius_m: 0", ("8: plant.base.wheel.radius_m = 0",)),
        ("radius_m: 0.05", "inertia_axle_kg_m2: 1", ("8: plant.base.wheel.inertia_axle_kg_m2 = 1", "1")),
        ("type: serial_arm", "type: snake", ("11: plant.arm.type", "snake", "serial_arm, urdf_arm")),
        (
            "type: serial_arm",
            "base: {yaw_deg: 3}\n    type: serial_arm",
            ("11: plant.arm.base",),
        ),
    ],
)
def test_what_no_base_can_be_is_refused_in_one_line(case, old, new, names, monkeypatch, capsys):
    case.write_text(GOOD.replace(old, new))
    assert command(monkeypatch, "check", str(case)) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    check_message(said, f"case.yaml:{names[0]}", *names[1:])
    assert said.count("\n") == 1


def urdf(case: Path, text: str) -> Path:
    (case.parent / "arm.urdf").write_text(text)
    arm = "    type: urdf_arm\n    file: arm.urdf\n"
    case.write_text(GOOD[: GOOD.index("    type: serial_arm")] + arm)
    return case


@pytest.mark.parametrize(("old", "name"), [("upper", "base"), ("hinge", "base.left"), ("upper", "base.left")])
def test_a_name_of_the_base_in_a_file_is_refused(case, old, name, monkeypatch, capsys):
    urdf(case, ARM.replace(f'"{old}"', f'"{name}"'))
    assert command(monkeypatch, "check", str(case)) == 2
    said = capsys.readouterr().err
    check_message(said, "case.yaml:10: plant.arm", repr(name))


def test_the_base_carries_what_a_file_fixes_to_its_root(case):
    """A root may even have the name of the base, of which it becomes a part."""
    bare = build_model(dynsim.load_scenario(case)).robot.links[1].inertia
    for name in ("root", "base"):
        scenario = dynsim.load_scenario(urdf(case, ARM.replace('"root"', f'"{name}"')))
        robot = build_model(scenario).robot
        assert robot.bodies == ("base", "upper")
        whole = robot.links[1].inertia
        assert whole.mass == pytest.approx(bare.mass + 2.0, rel=1e-14)
        # On the default mount, 0.1 m above the floor.
        com = (bare.mass * bare.com + 2.0 * np.array([0.1, 0.0, 0.15])) / whole.mass
        np.testing.assert_allclose(whole.com, com, rtol=0, atol=1e-15)
        assert dynsim.simulate(scenario).complete


def test_a_resolved_scenario_gives_the_same_run(case):
    scenario = dynsim.load_scenario(case)
    record = dynsim.simulate(scenario)
    again = dynsim.simulate(scenario_from_resolved(scenario.resolved))
    for name in record:
        np.testing.assert_array_equal(again[name], record[name])


def test_wheels_and_joints_are_exported_with_their_rates(case):
    """Each by its name: the base has four coordinates and two rates, so that columns of q and v are not the same."""
    record = dynsim.simulate(dynsim.load_scenario(case, overrides={"record.rate_hz": 1000}))
    joints, time, position, velocity = joint_motion(record)
    assert joints == ["base.left", "base.right", "joint_1", "joint_2"]
    assert np.ptp(velocity, axis=0).min() > 1e-3
    middle = (position[2:] - position[:-2]) / (time[2:] - time[:-2])[:, None]
    np.testing.assert_allclose(middle[20:], velocity[1:-1][20:], rtol=0, atol=1e-2)


@pytest.mark.long  # draws dozens of figures
def test_compare_writes_figures(case, monkeypatch):
    case.write_text(f"{GOOD}variants:\n  a: {{}}\n  b: {{plant: {{base: {{mass_kg: 3}}}}}}\n")
    out = case.parent / "compare"
    assert command(monkeypatch, "compare", str(case), "-q", "--out", str(out)) == 0
    assert list(out.rglob("posture*.png"))


@pytest.mark.long
def test_run_writes_a_record_and_figures(case, monkeypatch):
    case.write_text(GOOD)
    out = case.parent / "run"
    assert command(monkeypatch, "run", str(case), "-q", "--out", str(out)) == 0
    assert list(out.rglob("posture*.png"))
    record = dynsim.Record.load(case.parent / "run" / "record.h5")
    scene: Any = record.scene
    assert [body.name for body in scene.bodies][-2:] == ["base.left.wheel", "base.right.wheel"]
    # Bodies stand where the record says the base is.
    pose = record["base_pose"]
    base_position = record["body_position"][:, [body.name for body in scene.bodies].index("base")]
    np.testing.assert_allclose(base_position[:, :2], pose[:, :2], rtol=0, atol=1e-6)
    hub = record["body_position"][:, -2]
    aside = 0.15 * np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], axis=1)
    np.testing.assert_allclose(hub[:, :2], pose[:, :2] + aside, rtol=0, atol=1e-6)
    np.testing.assert_allclose(hub[:, 2], 0.05, rtol=0, atol=1e-6)
