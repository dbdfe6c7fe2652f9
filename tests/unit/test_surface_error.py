"""Surfaces whose errors the controller does not know, starts on references, units of waypoints, ends of splines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.compile.references.splines import clamped_cubic
from dynsim.errors import ModelError, ScenarioError
from dynsim.model.surfaces import Box, HeightField, Quadric
from dynsim.scenario import build
from dynsim.scenario.reading import scenario_from_resolved

MOTOR = {
    "type": "dc", "torque_constant_N_m_per_A": 0.2, "resistance_ohm": 1.0, "inductance_H": 1e-3,
    "rotor_inertia_kg_m2": 1e-4, "gear_ratio": 3.0,
}  # fmt: skip


def arm(**more: Any) -> dynsim.Scenario:
    """A boom that slides out, on a joint that pitches; a waypoint for each."""
    joints = {
        "joint_1": {"times_s": [0.0, 1.0], "angles_deg": [80.0, 85.0]},
        "joint_2": {"times_s": [0.0, 1.0], "positions_m": [0.1, 0.2]},
    }
    boom = {"kind": "prismatic", "axis": "z", "length_m": 0.2, "motor": MOTOR}
    data = {
        "name": "boom",
        "duration_s": 1.0,
        "plant": {"type": "serial_arm", "chain": [{"length_m": 0.5, "motor": MOTOR}, boom]},
        "controller": {"type": "joint_pd", "joints": joints},
        "surfaces": {"floor": {"type": "plane", "point_m": [0.0, 0.0, -0.1], "normal": [0.0, 0.0, 1.0]}},
        "contacts": {"law": "unilateral", "friction": 0.5, "points": {"tip": {"body": "link_2"}}},
    }
    return scenario_from_resolved(data | more)


@pytest.mark.parametrize(
    "surface",
    [
        Quadric(np.eye(3) / 0.4, np.array([0.1, 0.2, -0.3]), -0.1),
        Quadric(np.zeros((3, 3)), np.array([0.0, 0.6, 0.8]), 0.3),
        Box(np.array([0.1, 0.2, 0.3]), np.eye(3), np.array([0.5, 0.6, 0.7]), 0.05),
        HeightField(np.array([-1.0, -1.0]), np.array([0.5, 0.5]), np.arange(25.0).reshape(5, 5) / 50.0),
    ],
    ids=["sphere", "plane", "box", "field"],
)
def test_a_shifted_surface_is_the_same_elsewhere(surface: Quadric | Box | HeightField) -> None:
    """Distance and normal at x + s of the shifted one are those at x of the other, to rounding."""
    by, points = np.array([0.03, -0.02, 0.05]), np.random.default_rng(0).uniform(0.4, 0.9, size=(20, 3))
    moved = surface.shifted(by)
    assert np.abs(moved.gaps(points + by) - surface.gaps(points)).max() < 1e-12
    assert np.abs(moved.normals(points + by) - surface.normals(points)).max() < 1e-12


def test_the_controller_does_not_know_the_error() -> None:
    wrong = arm(surface_error={"shift_m": [0.0, 0.0, 0.005], "friction_factor": 1.2})
    there = build.contacts(wrong)[0]
    assert there.surface.gap(np.zeros(3)) == pytest.approx(0.095, abs=1e-12)
    assert there.friction == pytest.approx(0.6)
    law = {"static_friction": 0.7, "viscous_friction_s_per_m": 0.1}
    contacts = {"law": "unilateral", "friction": 0.5, "points": {"tip": {"body": "link_2"}}, **law}
    rubbed = build.contacts(arm(contacts=contacts, surface_error={"friction_factor": 1.2}))[0]
    factors = [rubbed.friction, rubbed.static_friction, rubbed.viscous_friction]
    assert factors == pytest.approx([0.6, 0.84, 0.12])
    assert build.contacts(arm())[0].surface.gap(np.zeros(3)) == pytest.approx(0.1, abs=1e-12)
    # Planned along what is believed: voltages are those without the error.
    planned = {"type": "joint_pd", "joints": arm().resolved["controller"]["joints"], "feed_forward": "dynamics"}
    believed = build.controller(arm(controller=planned), dynsim.build_model(arm()))
    actual = build.controller(
        arm(controller=planned, surface_error={"shift_m": [0.0, 0.0, 0.005]}), dynsim.build_model(arm())
    )
    assert np.array_equal(believed.reference.coefficients, actual.reference.coefficients)


def test_joints_start_where_their_waypoints_begin() -> None:
    robot = build.robot(arm(initial={"on_references": True}))
    assert robot.initial == pytest.approx([np.deg2rad(80.0), 0.1])
    record = dynsim.simulate(arm(initial={"on_references": True}))
    assert record["q"][0] == pytest.approx([np.deg2rad(80.0), 0.1])
    with raises(ModelError, "initial.on_references", "controller.joints"):
        build.robot(arm(initial={"on_references": True}, controller={"type": "joint_pd"}))


def test_waypoints_name_the_unit_of_their_joint() -> None:
    wrong = {"type": "joint_pd", "joints": {"joint_1": {"times_s": [0.0, 1.0], "positions_m": [0.0, 0.1]}}}
    with raises(ModelError, "joint_1", "revolute", "angles_deg"):
        dynsim.check(arm(controller=wrong))
    with raises(ScenarioError, "controller.joints.joint_1.angles_deg", "positions_m"):
        arm(controller={"type": "joint_pd", "joints": {"joint_1": {"times_s": [0.0, 1.0]}}})
    path = {"type": "line", "start_m": [0, 0, 0], "end_m": [0, 0, 1]}
    with pytest.raises(ScenarioError):
        arm(controller={"type": "joint_pd", "hand": {"path": path, "joints": []}})


def test_free_ends_of_a_spline_are_straight() -> None:
    """A natural spline through a line is that line; a level one is not."""
    knots, times = np.array([0.0, 0.4, 1.0, 1.5]), np.linspace(0.0, 1.5, 31)
    assert np.abs(clamped_cubic(knots, 2.0 * knots, times, level=False) - 2.0 * times).max() < 1e-14
    assert np.abs(clamped_cubic(knots, 2.0 * knots, times) - 2.0 * times).max() > 0.1
