"""Report of shared forces: of contacts, or of a contact and joints at rest, where one can replace another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with

import dynsim
from dynsim.dynamics.tables import OPEN, SLIDING, STICKING
from dynsim.engine.force_indeterminacy import sharing
from dynsim.scenario import build, scenario_from_resolved

ARM = """\
duration_s: 1
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.3]}
  chain: [YAW{axis: y, count: COUNT, length_m: 0.3, mass_kg: 1}]
surfaces: {floor: {type: plane, point_m: [0, 0, -5]}}
contacts:
  law: unilateral
  points: {a: {body: link_FIRST}, b: {body: link_LAST}, tip: {body: link_LAST, point_m: [0, 0, 0.2]}}
"""
YAW = "{axis: z, length_m: 0.05, mass_kg: 1}, "


def shared(
    folder: Path,
    modes: list[int],
    *,
    yaw: bool = False,
    count: int = 6,
    rests: list[int] | None = None,
    stiffness: float = 0.0,
) -> list[str]:
    """Names of those that share at a generic posture; ``rests``: joints that dry friction keeps at rest."""
    last = count + yaw
    path, text = folder / "case.yaml", ARM.replace("YAW", YAW if yaw else "").replace("COUNT", str(count))
    path.write_text(text.replace("FIRST", str(last - 2)).replace("LAST", str(last)))
    changes = {"integrator.method": "time_stepping", "contacts.stiffness_N_per_m": stiffness} if stiffness else {}
    scenario = dynsim.load_scenario(path, overrides=changes)
    model = dynsim.build_model(scenario)
    q = np.random.default_rng(3).uniform(-0.5, 0.5, (1, model.n))
    resting = np.isin(np.arange(model.n), rests or [])[None]
    touching, joints = sharing(model, build.contacts(scenario, model.robot), q, np.array([modes], dtype=float), resting)
    return [*touching, *joints]


@pytest.mark.parametrize("modes", [[STICKING, OPEN, OPEN], [SLIDING, OPEN, OPEN], [OPEN, OPEN, OPEN]])
def test_one_contact_shares_with_none(tmp_path: Path, modes: list[int]) -> None:
    """Not even where its rows are zero (across a planar arm), or depend on each other (two joints before it)."""
    assert shared(tmp_path, modes) == []
    assert shared(tmp_path, modes, count=3) == []


def test_points_of_two_bodies_of_a_planar_arm_do_not_share(tmp_path: Path) -> None:
    """Two bodies with two joints between them: the four rows in the plane are independent, those across it are zero."""
    assert shared(tmp_path, [STICKING, STICKING, OPEN]) == []


def test_with_one_yaw_joint_points_share_what_is_across_the_arm(tmp_path: Path) -> None:
    assert shared(tmp_path, [STICKING, STICKING, OPEN], yaw=True) == ["a", "b"]
    assert shared(tmp_path, [STICKING, SLIDING, OPEN], yaw=True) == []


def test_points_of_one_body_share_what_is_along_it_and_the_third_does_not(tmp_path: Path) -> None:
    assert shared(tmp_path, [OPEN, STICKING, STICKING]) == ["b", "tip"]
    assert shared(tmp_path, [STICKING, STICKING, STICKING], count=8) == ["b", "tip"]


def test_a_sliding_point_shares_with_joints_at_rest_that_it_holds(tmp_path: Path) -> None:
    """The first body's end moves with the first joint alone, the next one's with both: both must rest to hold it."""
    assert shared(tmp_path, [SLIDING, OPEN, OPEN], count=4, rests=[0]) == ["a", "joint_1"]
    assert shared(tmp_path, [SLIDING, OPEN, OPEN], count=4, rests=[1, 2, 3]) == []
    assert shared(tmp_path, [SLIDING, OPEN, OPEN], count=5, rests=[0, 1]) == ["a", "joint_1", "joint_2"]
    assert shared(tmp_path, [SLIDING, OPEN, OPEN], count=5, rests=[0]) == []
    assert shared(tmp_path, [OPEN, OPEN, OPEN], count=4, rests=[0, 1, 2, 3]) == []


def test_joints_that_have_the_names_of_contacts_are_no_contacts(tmp_path: Path) -> None:
    """A snake's wheels: the joint of each has the name of its contact."""
    path, text = tmp_path / "case.yaml", ARM.replace("YAW", "").replace("COUNT", "4")
    path.write_text(text.replace("FIRST", "2").replace("LAST", "4").replace("{a: ", "{joint_2: "))
    scenario = dynsim.load_scenario(path)
    model = dynsim.build_model(scenario)
    q, rests = np.full((1, model.n), 0.3), np.array([[True, False, False, False]])
    touching, joints = sharing(
        model, build.contacts(scenario, model.robot), q, np.array([[SLIDING, OPEN, OPEN]]), rests
    )
    assert (touching, joints) == (["joint_2"], ["joint_1"])


def test_a_compliant_contact_shares_only_friction(tmp_path: Path) -> None:
    """Its depth determines its normal force, so that no joint at rest can take that over."""
    assert shared(tmp_path, [SLIDING, OPEN, OPEN], count=4, rests=[0], stiffness=1e4) == []
    assert shared(tmp_path, [OPEN, STICKING, STICKING], stiffness=1e4) == []
    assert shared(tmp_path, [STICKING, STICKING, OPEN], yaw=True, stiffness=1e4) == ["a", "b"]


PLATE = """\
<robot name="plate"><link name="world"/><link name="plate"><inertial>
<origin xyz="0.02 0.01 0.05"/><mass value="2"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial></link>
<joint name="root" type="floating"><parent link="world"/><child link="plate"/></joint></robot>
"""
FEET = {"f0": (0.2, 0.15, 0.3), "f1": (0.2, -0.15, 0.2), "f2": (-0.2, 0.15, 0.25), "f3": (-0.2, -0.15, 0.35)}


@pytest.mark.parametrize("method", ["dopri5", "radau5", "time_stepping"])
@pytest.mark.parametrize("feet", [4, 3])
def test_feet_that_slide_on_one_plate_share_and_leave_the_motion_open(tmp_path: Path, method: str, feet: int) -> None:
    """Of four normal forces on one rigid body three are determined, and the friction of the four feet differs."""
    (tmp_path / "plate.urdf").write_text(PLATE)
    points = {
        name: {"body": "plate", "point_m": [x, y, -0.05], "friction": friction}
        for name, (x, y, friction) in list(FEET.items())[:feet]
    }
    config = {
        "duration_s": 0.1,
        "plant": {
            "type": "urdf_arm",
            "file": str(tmp_path / "plate.urdf"),
            "initial_pose": {"root": {"position_m": [0, 0, 0.05]}},
        },
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {"law": "unilateral", "points": points},
        "integrator": {"method": method},
    }
    scenario = scenario_from_resolved(config)
    start = dynsim.Simulation(scenario).state
    moving = np.array([1.0, 0.3, 0.0, 0.0, 0.0, 4.0])
    simulation = dynsim.Simulation(scenario, state=dynsim.State(0.0, start.q, moving, start.current))
    simulation.advance(0.1)
    warnings = lines_with(simulation.record().summary["warnings"], phrase="shared")
    assert len(warnings) == (feet == 4)
    for text in warnings:
        check_message(text, "f0, f1, f2, f3", phrase="moves otherwise")


def test_a_contact_that_leaves_what_joints_at_rest_share_with_it_leaves_the_motion_open(tmp_path: Path) -> None:
    """A tip comes to rest on a ceiling and leaves it at 0.142 s; time stepping, which splits otherwise, keeps it."""
    link = {"length_m": 0.25, "mass_kg": 0.3, "com_m": [0.02, 0.01, 0.1], "damping_N_m_s_per_rad": 0.01}
    chain = [
        {**link, "axis": [0, 0, 1], "friction_N_m": 0.1212},
        {**link, "axis": [-0.2729, 1.4381, -0.7874], "friction_N_m": 0.2265, "motor": {"type": "torque"}},
        {**link, "axis": [1, 0, 0], "friction_N_m": 0.0286, "motor": {"type": "torque"}},
    ]
    times = [0.0, 0.1, 0.2]
    torques = {"joint_2": [0.0164, -0.2729, 0.3113], "joint_3": [-0.6336, -0.3512, 0.61]}
    config = {
        "duration_s": 0.16,
        "plant": {"type": "serial_arm", "chain": chain},
        "controller": {
            "type": "joint_pd",
            "torques": {joint: {"times_s": times, "torques_N_m": values} for joint, values in torques.items()},
        },
        "surfaces": {
            "ceiling": {
                "type": "plane",
                "point_m": [0.13929, 0.29507, 0.51059],
                "normal": [-0.229875, -0.486957, -0.842633],
            }
        },
        "contacts": {
            "law": "unilateral",
            "friction": 0.594,
            "static_friction": 0.772,
            "points": {"tip": {"body": "link_3", "point_m": [0.02, 0, 0.2], "surface": "ceiling"}},
        },
        "integrator": {"method": "dopri5"},
        "record": {"rate_hz": 200},
    }
    record = dynsim.simulate(scenario_from_resolved(config))
    assert [event.kind for event in record.events if event.name == "tip"] == ["landing", "lift_off"]
    (warning,) = lines_with(record.summary["warnings"], phrase="shared")
    check_message(warning, "tip", phrase="moves otherwise")
