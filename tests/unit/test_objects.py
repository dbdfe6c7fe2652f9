"""Objects beside a robot: bodies of their own trees, that rest, slide, turn on hinges, and are named in errors."""

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.errors import ModelError, ScenarioError
from dynsim.scenario import Scenario, ScenarioConfig, build

G = 9.81
ARM = {
    "type": "serial_arm",
    "link": {"mass_kg": 0.5, "length_m": 0.3},
    "chain": [{"axis": "y"}],
    "initial_deg": [180],
}


def scene(objects, duration=0.5, **changes):
    config = {
        "name": "scene",
        "duration_s": duration,
        "plant": ARM,
        "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -1.0]}},
        "contacts": {"law": "unilateral", "friction": 0.3},
        "integrator": {"method": "time_stepping", "step_s": 0.001},
        "objects": objects,
    }
    return Scenario("scene", "", ScenarioConfig.model_validate(config | changes))


# A point with a radius, far above the floor: with it, bodies with corners use the same compiled kernels as the snake.
WITH_A_TIP = {"law": "unilateral", "friction": 0.3, "points": {"tip": {"body": "link_1", "radius_m": 0.01}}}
BOX = {"mass_kg": 0.3, "size_m": [0.06, 0.08, 0.1], "position_m": [1.0, 0.0, -0.95]}


def test_a_box_at_rest_presses_with_its_weight_and_stays():
    record = dynsim.simulate(scene({"box": BOX}, contacts=WITH_A_TIP))
    assert record["contact_normal_force"][-1].sum() == pytest.approx(0.3 * G, rel=1e-9)
    columns = [record.labels["q"].index(f"box.{axis}") for axis in "xyz"]
    np.testing.assert_allclose(record["q"][-1, columns], BOX["position_m"], atol=1e-9)


def test_a_box_that_is_pulled_slides_as_a_block_does():
    """a = F/m − μ g, from rest."""
    pull = {"type": "constant", "body": "box", "force_N": [1.5, 0.0, 0.0]}
    box = BOX | {"size_m": [0.2, 0.2, 0.02], "position_m": [1, 0, -0.99]}
    record = dynsim.simulate(scene({"box": box}, loads={"pull": pull}, contacts=WITH_A_TIP))
    distance = record["q"][-1, record.labels["q"].index("box.x")] - 1.0
    assert distance == pytest.approx(0.5 * (1.5 / 0.3 - 0.3 * G) * 0.5**2, rel=2e-3)


@pytest.mark.parametrize("torque", [0.4, 0.9])
def test_a_valve_turns_where_the_torque_is_more_than_its_friction(torque):
    """(τ − τ_c)/I, I = 2 m r²/5; below τ_c it does not move at all."""
    valve = {"mass_kg": 2.0, "shape": "sphere", "radius_m": 0.1, "position_m": [0.5, 0.0, 0.4]}
    valve["hinge"] = {"axis": [1.0, 0.0, 0.0], "friction_N_m": 0.5}
    turn = {"type": "constant", "body": "valve", "torque_N_m": [torque, 0.0, 0.0]}
    record = dynsim.simulate(scene({"valve": valve}, duration=0.2, loads={"turn": turn}))
    angle = record["q"][-1, record.labels["q"].index("valve")]
    inertia = 0.4 * 2.0 * 0.1**2
    assert angle == pytest.approx(max(torque - 0.5, 0.0) / inertia * 0.5 * 0.2**2, rel=1e-6, abs=1e-12)


def test_the_arm_beside_an_object_moves_as_it_does_alone():
    """Trees that do not touch know nothing of each other."""
    alone = dynsim.simulate(scene({}, plant=ARM | {"initial_deg": [100]}))
    beside = dynsim.simulate(scene({"box": BOX}, plant=ARM | {"initial_deg": [100]}))
    np.testing.assert_allclose(beside["q"][:, 0], alone["q"][:, 0], atol=1e-12)
    np.testing.assert_allclose(beside["hand_position"], alone["hand_position"], atol=1e-12)


def test_a_box_beside_a_snake():
    scenario = dynsim.load_scenario(
        "snake_positioning",
        "x",
        {
            "plant.level": "dynamic",
            "duration_s": 0.2,
            "objects": {"box": {"mass_kg": 0.3, "size_m": [0.06, 0.06, 0.06], "position_m": [0.6, 0.0, 0.0299]}},
        },
    )
    robot = build.robot(scenario)
    assert [link.name for link in robot.links][-1] == "box"
    record = dynsim.simulate(scenario)
    assert record.scene is not None
    assert "box" in [body.name for body in record.scene.bodies]
    assert record["contact_normal_force"][-1].sum() == pytest.approx((10.0 + 0.3) * G, rel=5e-3)


def test_names_and_sizes_are_checked():
    with raises(ModelError, "objects.link_1"):
        dynsim.simulate(scene({"link_1": BOX}))
    for name in ("", "world"):
        with raises(ModelError, "objects", repr(name)):
            dynsim.simulate(scene({name: BOX}))
    for change, says in (({"radius_m": 0.1}, "radius_m"), ({"size_m": None}, "size_m"), ({"mass_kg": 0.0}, "mass_kg")):
        with pytest.raises((ScenarioError, ValueError), match=says):
            scene({"box": BOX | change})
    assert "objects" not in scene({}).resolved


def test_a_door_with_a_closer_swings_about_its_hinge():
    """θ = θ_r (1 − cos ω t), ω² = k/I, I = m (a² + b²)/12 + m d² about the hinge beside the door."""
    hinge = {"point_m": [0.0, -0.4, 0.0], "spring_N_m_per_rad": 2.0, "rest_deg": -30.0}
    door = {"mass_kg": 5.0, "size_m": [0.04, 0.8, 1.0], "position_m": [1.0, 0.4, 0.0], "hinge": hinge}
    record = dynsim.simulate(scene({"door": door}, duration=3.0))
    inertia = 5.0 * (0.04**2 + 0.8**2) / 12.0 + 5.0 * 0.4**2
    expected = np.radians(-30.0) * (1.0 - np.cos(np.sqrt(2.0 / inertia) * record.time))
    np.testing.assert_allclose(record["q"][:, record.labels["q"].index("door")], expected, atol=1e-6)
    assert record.summary["energy_residual_relative"] < 1e-12


def test_a_drawer_slides_along_its_rails():
    """x = x_0 (1 − cos ω t), x_0 = rest + m g sin 30°/k, on rails that go down by 30° after a turn about z."""
    slide = {"axis": [1.0, 0.0, 0.0], "spring_N_per_m": 50.0, "rest_m": 0.05}
    drawer = {"mass_kg": 2.0, "size_m": [0.3, 0.3, 0.1], "position_m": [1.0, 0.4, 0.0], "rpy_deg": [0, 30, 90]}
    record = dynsim.simulate(scene({"drawer": drawer | {"slide": slide}}, duration=2.0))
    expected = (0.05 + 2.0 * G * 0.5 / 50.0) * (1.0 - np.cos(5.0 * record.time))
    np.testing.assert_allclose(record["q"][:, record.labels["q"].index("drawer")], expected, atol=1e-5)


def test_friction_of_rails_holds_a_drawer_and_its_stop_ends_its_way():
    drawer = {"mass_kg": 2.0, "size_m": [0.3, 0.3, 0.1], "position_m": [1.0, 0.4, 0.0]}
    for force, end in ((4.0, 0.0), (30.0, 0.1)):
        pull = {"type": "constant", "body": "drawer", "force_N": [force, 0.0, 0.0]}
        slide = {"friction_N": 5.0, "limits_m": [0.0, 0.1]}
        record = dynsim.simulate(scene({"drawer": drawer | {"slide": slide}}, loads={"pull": pull}))
        assert record["q"][-1, record.labels["q"].index("drawer")] == pytest.approx(end, abs=1e-9)


PIPE = {
    "shape": "parts",
    "position_m": [1.0, 0.0, -0.98],
    "parts": {
        "run": {"mass_kg": 0.2, "shape": "cylinder", "radius_m": 0.02, "length_m": 0.2, "rpy_deg": [90, 0, 0]},
        "branch": {
            "mass_kg": 0.1,
            "shape": "cylinder",
            "radius_m": 0.02,
            "length_m": 0.1,
            "position_m": [0.05, 0.0, 0.0],
            "rpy_deg": [0, 90, 0],
        },
    },
}


def test_the_inertia_of_parts_is_that_of_many_points():
    """Of points spread over both cylinders: mass, centre and moments, to the accuracy of the sum."""
    body = build.robot(scene({"pipe": PIPE})).links[-1].inertia
    count, points, masses = 40, [], []
    for mass, length, along, offset in ((0.2, 0.2, 1, 0.0), (0.1, 0.1, 0, 0.05)):
        z = (np.arange(count) + 0.5) / count * length - 0.5 * length
        radius = 0.02 * np.sqrt((np.arange(count) + 0.5) / count)
        angle = 2.0 * np.pi * np.arange(count) / count
        r, a, h = (grid.ravel() for grid in np.meshgrid(radius, angle, z))
        columns = [r * np.cos(a), r * np.sin(a)]
        columns.insert(along, h)
        points.append(np.column_stack(columns) + np.array([offset, 0.0, 0.0]))
        masses.append(np.full(len(h), mass / len(h)))
    x, m = np.vstack(points), np.concatenate(masses)
    centre = m @ x / m.sum()
    apart = x - centre
    tensor = np.einsum(
        "k,kij->ij", m, np.einsum("ka,ka,ij->kij", apart, apart, np.eye(3)) - np.einsum("ki,kj->kij", apart, apart)
    )
    assert body.mass == pytest.approx(0.3)
    np.testing.assert_allclose(body.com, centre, atol=1e-9)
    np.testing.assert_allclose(body.tensor, tensor, rtol=2e-3, atol=1e-9)


def test_a_pipe_joint_lies_on_its_three_ends():
    record = dynsim.simulate(scene({"pipe": PIPE}, contacts=WITH_A_TIP))
    names = record.labels["contact_normal_force"]
    assert {"pipe.run1.floor", "pipe.run2.floor", "pipe.branch2.floor"} <= set(names)
    assert record["contact_normal_force"][-1].sum() == pytest.approx(0.3 * G, rel=1e-9)
    assert record["q"][-1, record.labels["q"].index("pipe.z")] == pytest.approx(-0.98, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"mass_kg": 1.0}, "mass_kg"),
        ({"radius_m": 0.1}, "radius_m"),
        ({"parts": None}, "parts"),
        ({"shape": "box"}, "parts"),
        ({"hinge": {}, "slide": {}}, "slide"),
        ({"slide": {"limits_m": [0.1, 0.1]}}, "limits_m"),
        ({"grasp": {"axis": [0, 0, 0]}}, "axis"),
    ],
)
def test_wrong_objects_are_refused_with_the_key(change, key):
    with pytest.raises(ValueError, match=key):
        scene({"pipe": PIPE | change})


@pytest.mark.parametrize("kind", ["joints", "links"])
def test_candidates_of_the_robot_are_none_of_objects(kind):
    """Their origins may be outside of them, or on a hinge."""
    door = {"mass_kg": 1.0, "size_m": [0.02, 0.4, 0.4], "position_m": [1, 0, 0], "hinge": {"point_m": [0, 0.2, 0]}}
    contacts = {"law": "unilateral", "friction": 0.3, "candidates": kind}
    touching = build.contacts(scene({"pipe": PIPE, "door": door}, contacts=contacts))
    assert {contact.name for contact in touching if contact.body in ("pipe", "door")} == {
        "pipe.run1.floor", "pipe.run2.floor", "pipe.branch1.floor", "pipe.branch2.floor",
    }  # fmt: skip


def test_a_tie_with_the_name_of_a_spring_is_refused():
    door = {"mass_kg": 1.0, "size_m": [0.02, 0.4, 0.4], "position_m": [1, 0, 0], "hinge": {"spring_N_m_per_rad": 1.0}}
    tie = {"type": "torsion", "body": "door", "other": "world", "axis": [0, 0, 1], "stiffness_N_m_per_rad": 1.0}
    with raises(ModelError, "ties.door.spring"):
        build.robot(scene({"door": door}, ties={"door.spring": tie}))
