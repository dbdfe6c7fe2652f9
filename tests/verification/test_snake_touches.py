"""Objects that touch the bodies of a dynamic snake: they are pushed, pressed and lifted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.messages import raises

from dynsim import Model, Record, load_scenario, simulate
from dynsim.compile.touching import gap_at
from dynsim.errors import DynsimError, SimulationStopped
from dynsim.scenario import build

G, MU = 9.81, 0.6
TOUCHING = {"contacts.between": [{"bodies": ["pipe", "links"]}]}


def columns(record: Record, signal: str, start: str, end: str = "") -> np.ndarray:
    """Columns of a signal whose labels start and end like this."""
    return record[signal][:, [x.startswith(start) and x.endswith(end) for x in record.labels[signal]]]


def between(record: Record, body: str) -> list[int]:
    """Contacts between a body and others."""
    labels = record.labels["contact_normal_force"]
    return [k for k, name in enumerate(labels) if "-" in name and body in name]


@pytest.mark.long
def test_wheels_push_a_box_with_its_friction():
    """A smooth box in front of the first pair: the force is µ m g; box and robot move by the same distance."""
    changes: dict[str, Any] = {
        "contacts.between": [{"bodies": ["box", "links"], "friction": 0.0}],
        "controller.paths": [{"type": "ramp", "start_s": 0.2, "duration_s": 1.8, "displacement": [0.08] + 5 * [0]}],
        "controller.commands": [],
        "objects": {"box": {"size_m": [0.1, 0.3, 0.1], "mass_kg": 0.5, "position_m": [0.115, 0, 0.05]}},
        "duration_s": 1.6,
    }
    record = simulate(load_scenario("snake_pick_up", "lifts", changes))
    steady = np.flatnonzero(record.time > 1.0)[[0, -1]]
    impulse, labels = np.diff(record["contact_impulse"][steady], axis=0)[0], record.labels["contact_impulse"]
    ground = sum(j for name, j in zip(labels, impulse, strict=True) if name.startswith("box") and "ground" in name)
    pushed, (faster,) = impulse[between(record, "box")].sum(), np.diff(columns(record, "v", "box.x")[steady, 0])
    assert pushed == pytest.approx(MU * ground + 0.5 * faster, rel=1e-6)
    assert pushed / np.diff(record.time[steady])[0] == pytest.approx(MU * 0.5 * G, rel=2e-3)
    base, box = (np.diff(x[steady])[0] for x in (record["base_pose"][:, 0], columns(record, "q", "box.x")[:, 0]))
    assert box > 0.02
    assert box == pytest.approx(base, rel=5e-3)
    assert record.summary["energy_residual_relative"] < 1e-12


@pytest.mark.long
def test_gripper_pushes_the_pipe_ahead():
    """Contact forces of the head are the friction of the ground, pipe and gripper move by the same distance."""
    record = simulate(load_scenario("snake_pick_up", "pushes"))
    steady = (record.time > 14.0) & (record.time < 20.5)
    labels = record.labels["contact_normal_force"]
    ground = [k for k, name in enumerate(labels) if name.startswith("pipe.")]
    carried = record["contact_normal_force"][steady][:, ground].sum(axis=1)
    force = record["contact_force"].reshape(len(record), len(labels), 3)[steady]
    pushed, braked = force[:, between(record, "pipe"), :].sum(axis=1), force[:, ground, :].sum(axis=1)
    assert np.abs(braked[:, 0] + MU * carried).max() < 1e-3 * carried.max()
    assert np.abs(pushed[:, 0]).mean() == pytest.approx(MU * carried.mean(), rel=5e-3)
    moved = columns(record, "q", "pipe.")
    assert moved[-1, 0] - 0.4 == pytest.approx(0.2, abs=5e-3)
    assert np.abs(moved[:, 1]).max() < 1e-3
    assert moved[:, 2].max() < 0.031
    assert record.summary["energy_residual_relative"] < 1e-12


@pytest.mark.long
def test_gripper_presses_on_the_pipe_before_it_lifts_it():
    record = simulate(load_scenario("snake_pick_up", "lifts", TOUCHING))
    force = record["contact_normal_force"][:, between(record, "pipe")]
    closed = (record.time > 12.0) & (record.time < 13.0)
    assert force[closed].sum(axis=1).min() > 1.0
    # The ground carries the pipe and the force of the gripper, which presses with a slope.
    ground = columns(record, "contact_normal_force", "pipe.")[closed].sum(axis=1)
    assert ground.min() > 0.2 * G + 1.0
    assert record["contact_gap"][:, between(record, "pipe")].min() > -1e-3
    assert record.summary["gripper"]["captures"] == ["pipe"]
    lifted = columns(record, "q", "pipe.")[:, 2] - 0.03
    assert lifted[-1] == pytest.approx(0.155, abs=5e-3)
    hanging = record.time > 22.0
    ties = np.linalg.norm(record["tie_force"][hanging][:, :3], axis=1)
    assert ties == pytest.approx(0.2 * G, rel=0.05)
    assert record.summary["energy_residual_relative"] < 1e-12


# The front of the gripper is a sphere, 25 mm ahead of the tip; grasp frames are that far in front of hub and knob.
GRASPS: dict[str, tuple[str, str, dict[str, Any], float]] = {
    "valve": (
        "snake_valve",
        "turns",
        {"objects.valve.grasp.position_m": [0, 0, -0.045], "controller.paths.0.displacement": [0.027, 0, 0, 0, 0, 0]},
        87.3,
    ),
    "door": (
        "snake_door",
        "push",
        {
            "objects.door.position_m": [0.4436, 0.175, 0.32],
            "objects.door.grasp.position_m": [-0.105, -0.175, 0.0311],
            "objects.door.hinge.point_m": [-0.105, 0.225, 0],
        },
        60.0,
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", GRASPS)
def test_gripper_touches_hinged_objects_and_moves_them(name):
    """It stops at the hub or knob, and moves the object by the same angle as without contact."""
    scenario, variant, changes, angle = GRASPS[name]
    touching = {"contacts.between": [{"bodies": [name, "links"]}]}
    record = simulate(load_scenario(scenario, variant, touching | changes))
    assert 1.0 < record["contact_normal_force"][:, between(record, name)].max() < 10.0
    assert record["contact_gap"][:, between(record, name)].min() > -1e-3
    assert np.degrees(columns(record, "q", name)[-1, 0]) == pytest.approx(angle, abs=0.5)
    assert record.summary["gripper"]["captures"] == [name]
    assert record.summary["energy_residual_relative"] < 1e-12


@pytest.mark.long
def test_gripper_that_is_stopped_by_a_hub_does_not_reach_its_grasp_frame():
    """The tip cannot touch the face of the hub, unlike without contact."""
    touching = {"contacts.between": [{"bodies": ["valve", "links"]}]}
    with raises(SimulationStopped, "too_far", "valve", "plant.gripper") as caught:
        simulate(load_scenario("snake_valve", "turns", touching))
    record = caught.value.record
    assert record is not None
    assert record["contact_normal_force"][-1, between(record, "valve")].sum() > 10.0
    # The solid of the head ends 25 mm in front of the tip; the head also turns on the rim of the hub.
    assert 0.022 < record["grasp_distance"][-1] < 0.035


def test_the_head_is_raised_without_objects():
    """The start of a run does not depend on bodies that touch."""
    starts = [
        build.robot_and_contacts(load_scenario("snake_pick_up", "lifts", changes))[0].initial
        for changes in ({}, TOUCHING)
    ]
    np.testing.assert_array_equal(*starts)
    first, second = (
        simulate(load_scenario("snake_pick_up", "lifts", {"duration_s": 0.01} | changes)) for changes in ({}, TOUCHING)
    )
    # Commands of several ticks at once round differently.
    np.testing.assert_allclose(first["q"], second["q"], rtol=0.0, atol=1e-12)


def test_bodies_of_a_snake_start_apart():
    """Wheels ignore the neighbours of their axles."""
    scenario = load_scenario("snake_pick_up", "lifts", {"contacts.between": [{"bodies": "self"}]})
    robot, contacts = build.robot_and_contacts(scenario)
    model = Model(robot)
    gaps = {c.name: gap_at(model, c, robot.initial) for c in contacts if c.surface_name == c.surface.carrier}
    assert any("wheel" in name for name in gaps)
    assert 0.03 < min(gaps.values()) < 0.05


def test_kinematic_snake_refuses_bodies_that_touch():
    with pytest.raises(DynsimError, match=r"contacts\.between.*plant\.level: dynamic"):
        load_scenario("snake_pick_up", "lifts", TOUCHING | {"plant.level": "kinematic"})
