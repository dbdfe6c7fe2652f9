"""Start postures on boxes, spheres and cylinders: the side on which ``initial.on_surface`` puts a point."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.compile.clearance import axis_gaps
from dynsim.compile.touching import gap_at
from dynsim.errors import ModelError
from dynsim.scenario import build
from dynsim.scenario.reading import scenario_from_resolved

LINK = {"mass_kg": 0.2, "length_m": 0.4, "radius_m": 0.015, "motor": {"type": "wang_minami"}}
CHAIN = [{"axis": "z", "length_m": 0.0}, {"axis": "y", "count": 4}]
ARM = {"type": "serial_arm", "link": LINK, "chain": CHAIN, "initial_deg": [0, 60, 60, -75, 60]}
ELBOW = {"elbow": {"body": "link_4", "radius_m": 0.02, "surface": "table"}}
TABLE = {"type": "box", "center_m": [0.7, 0.0, 0.0], "edges_m": [0.4, 0.4, 0.05]}
UNDER = [0, 110, -40, 60, 0]  # the arm reaches under the table; its elbow faces the underside


def scenario(table: dict[str, Any] = TABLE, **more: Any) -> dynsim.Scenario:
    """An arm with its elbow on a table; other sections replace these."""
    data = {
        "name": "sides",
        "duration_s": 0.05,
        "plant": ARM,
        "controller": {"type": "joint_pd"},
        "surfaces": {"table": table},
        "contacts": {"law": "unilateral", "points": ELBOW},
        "initial": {"on_surface": ["elbow"]},
    }
    return scenario_from_resolved(data | more)


def elbows(case: dynsim.Scenario) -> dict[str, np.ndarray]:
    """Normal of the surface at each listed point; all touch, no axis is inside a surface."""
    model = dynsim.build_model(case)
    q = model.robot.initial
    normals = {}
    for contact in build.robot_and_contacts(case)[1]:
        assert abs(gap_at(model, contact, q)) < 1e-11
        normals[contact.name] = contact.surface.normal(model.point_position(contact.body, contact.point, q))
    for link, surface, gap in axis_gaps(model.robot, build.surfaces(case), q[None]):
        assert gap.min() > -1e-6, (link.name, surface)
    return normals


@pytest.mark.parametrize("thickness", [0.002, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("top", [-0.15, -0.03, 0.01, 0.05, 0.2, 0.35])
def test_elbow_is_on_top_for_every_height_of_table(top: float, thickness: float) -> None:
    """The elbow starts at z = 0: above the table, inside it, or below it with the arm through the table."""
    height = top - thickness / 2
    table = TABLE | {"center_m": [0.7, 0.0, height], "edges_m": [0.4, 0.4, thickness], "edge_radius_m": thickness / 4}
    assert elbows(scenario(table))["elbow"][2] > 0.99


@pytest.mark.parametrize(
    "table",
    [
        {"type": "sphere", "center_m": [0.7, 0.0, 0.15], "radius_m": 0.2},
        {"type": "cylinder", "point_m": [0.7, 0.0, 0.1], "axis": [0, 1, 0], "radius_m": 0.2},
        {"type": "cylinder", "point_m": [0.7, 0.0, 0.1], "axis": [0, 1, 0.3], "radius_m": 0.15},
    ],
    ids=["sphere", "cylinder_across", "cylinder_inclined"],
)
def test_elbow_is_above_round_surfaces(table: dict[str, Any]) -> None:
    assert elbows(scenario(table))["elbow"][2] > 0.0


def test_elbow_stays_below_when_the_arm_comes_from_below() -> None:
    table = TABLE | {"center_m": [0.75, 0.0, 0.35]}
    assert elbows(scenario(table, plant=ARM | {"initial_deg": UNDER}))["elbow"][2] < -0.99


def test_plane_and_bowl_have_a_single_side() -> None:
    assert elbows(scenario({"type": "plane", "point_m": [0, 0, -0.1]}))["elbow"][2] == 1.0
    bowl = {"type": "sphere", "center_m": [0.7, 0.0, 2.9], "radius_m": 3, "inside": True}
    assert elbows(scenario(bowl))["elbow"][2] > 0.9


@pytest.mark.parametrize("shared", [True, False], ids=["one_table", "two_tables"])
def test_two_braces_are_on_top(shared: bool) -> None:
    chain = [{"axis": "z", "length_m": 0.0}, {"axis": "y", "count": 7}]
    plant = ARM | {"chain": chain, "initial_deg": [0, 60, 60, -75, 90, -75, -60, 60]}
    wide = TABLE | {"center_m": [1.1, 0.0, 0.0], "edges_m": [1.2, 0.4, 0.05]}
    near, far = TABLE | {"center_m": [0.65, 0.0, 0.0]}, TABLE | {"center_m": [1.3, 0.0, 0.0]}
    surfaces = {"table": wide} if shared else {"table": near, "far": far}
    second = {"body": "link_6", "radius_m": 0.02, "surface": "table" if shared else "far"}
    case = scenario(
        plant=plant,
        surfaces=surfaces,
        contacts={"law": "unilateral", "points": ELBOW | {"second": second}},
        initial={"on_surface": ["elbow", "second"]},
    )
    normals = elbows(case)
    assert normals["elbow"][2] > 0.99
    assert normals["second"][2] > 0.99


def test_gravity_and_controllers_do_not_change_the_side() -> None:
    expected = dynsim.build_model(scenario()).robot.initial
    sampled = {"type": "joint_pd", "sample_time_s": 0.001}
    for more in ({"plant": ARM | {"gravity_m_s2": [6.9, 0.0, -6.9]}}, {"controller": sampled}):
        assert elbows(scenario(**more))["elbow"][2] > 0.99
        assert np.array_equal(dynsim.build_model(scenario(**more)).robot.initial, expected)


@pytest.mark.parametrize("height", [0.3, 0.4, 0.47, 0.53, 0.58])
def test_arm_of_a_urdf_file_moves_from_every_table(height: float) -> None:
    """Only the height of the table differs, as in a sweep; the path starts at the hand."""
    keys = {
        "surfaces": {"table": {"type": "box", "center_m": [0.6, 0.0, 0.3], "edges_m": [0.6, 0.6, 0.06]}},
        "surfaces.table.center_m.2": height,
        "contacts": {"law": "unilateral", "points": {"pad": {"body": "wrist", "radius_m": 0.05, "surface": "table"}}},
        "initial": {"on_surface": ["pad"]},
        "controller.hand.path": {
            "type": "line",
            "frame": "start",
            "from_m": [0, 0, 0],
            "to_m": [0, 0, 0.05],
            "duration_s": 0.4,
        },
        "duration_s": 0.4,
    }
    keys["plant.initial_deg.wrist_pitch"] = -40.0
    case = dynsim.load_scenario("six_axis_arm", overrides=keys)
    assert elbows(case)["pad"][2] > 0.99
    record = dynsim.simulate(case)
    assert np.abs(record["target_position"][0] - record["hand_position"][0]).max() < 1e-12
    assert np.linalg.norm(record["target_position"][-1] - record["hand_position"][-1]) < 0.01


def test_hand_stays_when_the_elbow_changes_side() -> None:
    """The solver keeps the hand on the side that it selects."""
    case = scenario(initial={"on_surface": ["elbow"], "keep": ["hand"]})
    assert elbows(case)["elbow"][2] > 0.99
    model, unposed = dynsim.build_model(case), build.unposed(case)
    moved = [model.point_position(*unposed.hand, q) for q in (unposed.initial, model.robot.initial)]
    assert np.abs(moved[0] - moved[1]).max() < 1e-12


def test_arm_of_a_mobile_base_is_on_top() -> None:
    table = {"type": "box", "center_m": [0.863, 0.863, 0.02], "edges_m": [0.4, 1.0, 0.1], "rpy_deg": [0, 0, 45]}
    keys = {
        "surfaces": {"floor": {"type": "plane"}, "table": table},
        "contacts": {"law": "unilateral", "points": {"elbow_7": {"body": "link_7", "surface": "table"}}},
        "initial": {"on_surface": ["elbow_7"]},
    }
    case = dynsim.load_scenario("mobile_elbow_comparison", overrides={"plant.arm.link.radius_m": 0.01} | keys)
    model = dynsim.build_model(case)
    contact = next(each for each in build.robot_and_contacts(case)[1] if each.name == "elbow_7")
    normal = contact.surface.normal(model.point_position(contact.body, contact.point, model.robot.initial))
    assert normal[2] > 0.99


def test_pedestal_does_not_count_as_an_arm_inside() -> None:
    """The part of an arm inside the box on which it is mounted is ignored."""
    pedestal = {"type": "box", "center_m": [0.4, 0.0, -0.05], "edges_m": [1.4, 0.4, 0.12]}
    assert dynsim.build_model(scenario(pedestal)).robot.initial == pytest.approx(
        dynsim.build_model(scenario({"type": "plane", "point_m": [0.0, 0.0, 0.01]})).robot.initial, abs=1e-9
    )


def test_far_side_alone_is_an_error() -> None:
    """Limits stop the elbow below the table, with link 3 through it."""
    limited = [
        {"axis": "z", "length_m": 0.0},
        {"axis": "y", "limit_deg": [50, 80]},
        {"axis": "y", "limit_deg": [50, 80]},
    ]
    plant = ARM | {"chain": [*limited, {"axis": "y", "count": 2}], "initial_deg": [0, 60, 60, -75, 60]}
    with raises(ModelError, "initial.on_surface", "'elbow'", "far side", "'table'"):
        dynsim.build_model(scenario(TABLE | {"center_m": [0.75, 0.0, 0.2], "edges_m": [0.9, 0.4, 0.05]}, plant=plant))
